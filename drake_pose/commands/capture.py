"""The commands `drake-pose capture` and `drake-pose empty-room`: a person, followed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from drake_pose.commands.estimate import estimate, print_estimate
from drake_pose.commands.options import (
    SPREAD,
    CaptureWorkers,
    Json,
    Out,
    Overlay,
    Replay,
    Resume,
    Scheduler,
    Seconds,
    Shape,
    Truth,
    within,
    workers_of,
)
from drake_pose.commands.terminal import (
    FrameProgress,
    UsageError,
    output_console,
    print_json,
    say,
    warn,
)
from drake_pose.errors import SceneError
from drake_pose.results.settings import CaptureSettings, EstimateSettings, changed

if TYPE_CHECKING:
    from rich.table import Table

    from drake_pose.jobs.live.capture import LiveResult, LiveSettings


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """Options of a capture that are for a sources.yaml."""

    seconds: Seconds = None
    """Stop after this time [s]. Live capture (sources.yaml) only."""
    shape: Shape = None
    fit_shape: Annotated[bool, Parameter(negative="--no-fit-shape")] = True
    """Fit lengths and girths to the first frames; or keep the model's. Live capture only."""
    tolerance: Annotated[float | None, within(0.0), Parameter(metavar="SECONDS")] = None
    """Largest difference of time stamps of simultaneous pictures. Default: half the time between
    two pictures of a camera, or 0.9 of it if cameras are live."""
    workers: CaptureWorkers = 0
    scheduler: Scheduler = None
    face_camera: Annotated[str | None, Parameter(metavar="NAME")] = None
    """With --method paper: the camera before the face, which tells where the person looks; needs
    --faces."""
    faces: Annotated[Path | None, Parameter(metavar="FOLDER")] = None
    """With --method paper: pictures of the person's face, and directions.csv:
    picture,turn,nod [deg]."""

    @property
    def of_paper(self) -> bool:
        """Whether one is given that is for --method paper alone."""
        return self.face_camera is not None or self.faces is not None

    @property
    def of_person(self) -> bool:
        """Whether one is given that is for --method person alone."""
        return bool(self.shape or not self.fit_shape or self.workers or self.scheduler)


def capture(
    scene: Path,
    /,
    *,
    out: Out,
    model: Path | None = None,
    method: Literal["person", "paper"] = "person",
    settings: Annotated[CaptureSettings | None, SPREAD] = None,
    live: Annotated[LiveOptions | None, SPREAD] = None,
    truth: Truth = None,
    resume: Resume = False,
    overlay: Overlay = True,
    replay: Replay = True,
    json: Json = False,
) -> None:
    """Capture the motion of one person before several calibrated cameras, from masks or live.

    Nothing need be known of the person: lengths and girths are fitted to the first frames. This is
    estimate with the bundled person as the model. Pictures or videos need masks of the first frame
    alone, in two cameras or more; with --start no mask. If the folder has sources.yaml beside
    cameras.yaml, frames are captured as they come, from live cameras in real time, until Ctrl-C.

        drake-pose capture STUDIO --out results/person --seconds 60

    Args:
        scene: Folder with cameras.yaml and masks, pictures or videos; or with a sources.yaml.
        model: A person with landmarks.yaml beside it. Default: the bundled one.
        method: person: by all silhouettes at once; paper: by skin seen in colour pictures, and a
            search for elbows and knees, as Date et al. published it.
    """
    settings, live = settings or CaptureSettings(), live or LiveOptions()
    of_masks = bool(truth or resume or set(changed(settings)) - {"packages"})
    # The name of SOURCES; its module would make every command's start slow.
    has_sources = (scene / "sources.yaml").is_file()
    _check(scene, method, of_masks, has_sources, live)
    if method == "person" and not has_sources:
        from drake_pose.jobs.estimate.person_choice import bundled_person

        given = {one.name: getattr(settings, one.name) for one in fields(settings)}
        estimate(
            scene, model=model or bundled_person(), out=out,
            settings=EstimateSettings(method="person", **given),
            truth=truth, resume=resume, overlay=overlay, replay=replay, json=json,
        )  # fmt: skip
        return
    from drake_pose.jobs.live.capture import LiveSettings

    how = LiveSettings(live.seconds, live.shape, live.fit_shape, replay, settings.packages)
    _print_result(_capture_live(scene, out, model, method, how, live), json)


def _check(scene: Path, method: str, of_masks: bool, has_sources: bool, live: LiveOptions) -> None:
    """Refuses options that do not go together."""
    if method == "paper" and (of_masks or live.of_person):
        raise UsageError(
            "--camera, --frame, --truth, --start, --no-track, --resume, --shape, --no-fit-shape, "
            "--workers and --scheduler are for --method person"
        )
    if method == "person" and live.of_paper:
        raise UsageError("--face-camera and --faces are for --method paper")
    if (live.face_camera is None) != (live.faces is None):
        raise UsageError("--face-camera and --faces go together")
    if has_sources and of_masks:
        raise UsageError(
            "--camera, --frame, --truth, --start, --no-track and --resume are for a folder of "
            f"masks or pictures; {scene} has a sources.yaml"
        )
    if method == "person" and not has_sources and live != LiveOptions():
        raise UsageError(f"{scene} has no sources.yaml, which that option is for")


def empty_room(folder: Path, /, *, pictures: Annotated[int, within(1)] = 30) -> None:
    """Take pictures of the empty room with the cameras of a sources.yaml.

    Live capture finds the person as what differs from these pictures. Leave the room first, and
    take them again when the light changes or a camera moves.

        drake-pose empty-room STUDIO

    Args:
        folder: Folder with cameras.yaml and sources.yaml.
        pictures: Number of pictures of each camera.
    """
    from drake_pose.jobs.live.scene import hush_opencv, take_empty_room

    hush_opencv()
    for camera, place in take_empty_room(folder, pictures).items():
        say(f"drake-pose: {camera}: {pictures} pictures of the empty room in {place}")


def _capture_live(
    folder: Path,
    out: Path,
    model: Path | None,
    method: str,
    settings: LiveSettings,
    live: LiveOptions,
) -> LiveResult:
    """Captures as the pictures come, here or on workers, or by the paper's stages."""
    from drake_pose.jobs.live.capture import capture_live
    from drake_pose.jobs.live.paper_capture import FaceFolder, capture_paper
    from drake_pose.jobs.live.scene import hush_opencv, is_live_scene, load_live_scene
    from drake_pose.systems.person.live_capture import LiveSensors

    if method == "paper" and folder.is_dir() and not is_live_scene(folder):
        raise SceneError(
            f"{folder}: has no sources.yaml; the paper's method looks for skin in colour pictures, "
            "which masks do not show: name the pictures and those of the empty room there"
        )
    hush_opencv()
    with workers_of(live.workers, live.scheduler) as client, FrameProgress() as progress:
        # Workers may have another working folder.
        scene = load_live_scene(folder if client is None else folder.absolute())

        def sensors() -> LiveSensors:
            if client is None:
                return scene.open_sensors(tolerance=live.tolerance)
            from drake_pose.jobs.cluster.remote_views import opener

            return opener(client, live.tolerance)(scene)

        def show(count: int, _: bool) -> None:
            progress.show_stage("frames", count, None)

        if method == "person":
            return capture_live(scene, out, model, settings, sensors, warn, show)
        face = None
        if live.face_camera is not None and live.faces is not None:
            face = FaceFolder(live.face_camera, live.faces)
        if any(one.live for one in scene.specifications.values()):
            say("drake-pose: stand upright before the cameras, both arms spread to the sides")
        return capture_paper(
            scene, out, model, settings, face,
            lambda: scene.open_sensors(tolerance=live.tolerance), warn, show,
        )  # fmt: skip


def _print_result(result: LiveResult, json: bool) -> None:
    """Says what came out, and fails where that is nothing."""
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
        raise SceneError("no camera gave a picture")
    if not estimate.found_count:
        raise SceneError("nobody was found in any frame")


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
