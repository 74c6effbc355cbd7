"""What `drake-pose capture` does with a folder that has a sources.yaml."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drake_pose.commands.terminal import (
    FAILED,
    errors_as_messages,
    finite,
    print_json,
    say,
    warn,
)

if TYPE_CHECKING:
    from rich.table import Table

    from drake_pose.jobs.live.capture import LiveResult
    from drake_pose.jobs.live.scene import LiveScene
    from drake_pose.systems.person.live_capture import LiveSensors

_PANEL = "Live capture (sources.yaml)"
_PAPER_PANEL = "--method paper"

SecondsOption = Annotated[
    float | None,
    typer.Option(
        min=0.01, callback=finite, help=r"Stop after this time \[s].", rich_help_panel=_PANEL
    ),
]
ShapeOption = Annotated[
    Path | None,
    typer.Option(
        metavar="RESULT",
        help="Take lengths and girths from this result of capture with the same person.",
        rich_help_panel=_PANEL,
    ),
]
FitShapeOption = Annotated[
    bool,
    typer.Option(
        "--fit-shape/--no-fit-shape",
        help="Fit lengths and girths to the first frames; or keep the model's.",
        rich_help_panel=_PANEL,
    ),
]
ToleranceOption = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        callback=finite,
        help="Largest difference of time stamps of simultaneous pictures. Default: half the time "
        "between two pictures of a camera, or 0.9 of it if cameras are live.",
        rich_help_panel=_PANEL,
    ),
]


FaceCameraOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="The camera before the face, which tells where the person looks; needs --faces.",
        rich_help_panel=_PAPER_PANEL,
    ),
]
FacesOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="Pictures of the person's face, and directions.csv: picture,turn,nod [deg].",
        rich_help_panel=_PAPER_PANEL,
    ),
]


def run_live_capture(
    folder: Path,
    out: Path,
    model: Path | None,
    *,
    seconds: float | None = None,
    shape: Path | None = None,
    fit_shape: bool = True,
    tolerance: float | None = None,
    replay: bool = True,
    json: bool = False,
    open_sensors: Callable[[LiveScene], LiveSensors] | None = None,
    packages: Mapping[str, Path] | None = None,
) -> None:
    """Captures as the pictures come, tells what happens, and prints what came out."""
    with errors_as_messages():
        from drake_pose.commands.report import FrameProgress
        from drake_pose.jobs.live.capture import LiveSettings, capture_live
        from drake_pose.jobs.live.scene import hush_opencv, load_live_scene

        hush_opencv()
        settings = LiveSettings(seconds, shape, fit_shape, replay, packages or {})
        scene = load_live_scene(folder)

        def sensors() -> LiveSensors:
            return (
                scene.open_sensors(tolerance=tolerance)
                if open_sensors is None
                else open_sensors(scene)
            )

        with FrameProgress() as progress:

            def show(count: int, found: bool) -> None:
                progress.show_stage("frames", count, None)

            result = capture_live(scene, out, model, settings, sensors, warn, show)
        _print_result(result, json)


def run_paper_capture(
    folder: Path,
    out: Path,
    model: Path | None,
    *,
    seconds: float | None = None,
    tolerance: float | None = None,
    replay: bool = True,
    json: bool = False,
    face_camera: str | None = None,
    faces: Path | None = None,
    packages: Mapping[str, Path] | None = None,
) -> None:
    """Captures by the paper's stages, tells what happens, and prints what came out."""
    if (face_camera is None) != (faces is None):
        raise typer.BadParameter("--face-camera and --faces go together")
    with errors_as_messages():
        from drake_pose.commands.report import FrameProgress
        from drake_pose.errors import SceneError
        from drake_pose.jobs.live.capture import LiveSettings
        from drake_pose.jobs.live.paper_capture import FaceFolder, capture_paper
        from drake_pose.jobs.live.scene import hush_opencv, is_live_scene, load_live_scene

        if folder.is_dir() and not is_live_scene(folder):
            raise SceneError(
                f"{folder}: has no sources.yaml; the paper's method looks for skin in colour "
                "pictures, which masks do not show: name the pictures and those of the empty room "
                "there"
            )
        hush_opencv()
        settings = LiveSettings(seconds, replay=replay, packages=packages or {})
        scene = load_live_scene(folder)
        face = None if face_camera is None or faces is None else FaceFolder(face_camera, faces)
        if any(one.live for one in scene.specifications.values()):
            say("drake-pose: stand upright before the cameras, both arms spread to the sides")
        with FrameProgress() as progress:
            result = capture_paper(
                scene,
                out,
                model,
                settings,
                face,
                lambda: scene.open_sensors(tolerance=tolerance),
                warn,
                lambda count, _: progress.show_stage("frames", count, None),
            )
        _print_result(result, json)


def empty_room(
    folder: Annotated[Path, typer.Argument(help="Folder with cameras.yaml and sources.yaml.")],
    pictures: Annotated[int, typer.Option(min=1, help="Number of pictures of each camera.")] = 30,
) -> None:
    """See help_texts.EMPTY_ROOM."""
    with errors_as_messages():
        from drake_pose.jobs.live.empty_room import take_empty_room
        from drake_pose.jobs.live.scene import hush_opencv

        hush_opencv()
        for camera, place in take_empty_room(folder, pictures).items():
            say(f"drake-pose: {camera}: {pictures} pictures of the empty room in {place}")


def _print_result(result: LiveResult, json: bool) -> None:
    """Says what came out, and fails where that is nothing."""
    from drake_pose.commands.report import output_console, print_estimate

    estimate = result.estimate
    for text in result.troubles:
        warn(text)
    if result.interrupted:
        say("drake-pose: ended by Ctrl-C; all frames are kept")
    if json:
        print_json(estimate.summary)
    elif estimate.rows:
        print_estimate(estimate)
        output_console().print(_source_table(estimate.summary["sources"]))
    if not estimate.rows:
        say("drake-pose: error: no camera gave a picture")
        raise typer.Exit(FAILED)
    if not estimate.found_count:
        say("drake-pose: error: nobody was found in any frame")
        raise typer.Exit(FAILED)


def _source_table(sources: Mapping[str, Any]) -> Table:
    """A row a camera: what became of its pictures, and when it stopped and returned."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("camera", "pictures used", "unusable", "too late", "stopped and returned")
    for name, source in sources.items():
        changes = [
            f"{one['what']} at {one['time']:.2f} s" if one["time"] is not None else "gave none"
            for one in source["changes"]
        ]
        numbers = [str(source[what]) for what in ("used", "dropped", "late")]
        table.add_row(escape(name), *numbers, ", ".join(changes))
    return table
