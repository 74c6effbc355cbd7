"""The commands `drake-pose capture` and `drake-pose empty-room`: a person, followed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from drake_pose.commands.estimate import estimate, print_estimate
from drake_pose.commands.options import (
    SPREAD,
    Json,
    Out,
    Overlay,
    Replay,
    Resume,
    Truth,
    within,
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
from drake_pose.files.settings import CaptureSettings, EstimateSettings, changed
from drake_pose.jobs.live.settings import CaptureMethod, LiveSettings

if TYPE_CHECKING:
    from rich.table import Table


def capture(
    scene: Path,
    /,
    *,
    out: Out,
    model: Path | None = None,
    method: CaptureMethod = "person",
    settings: Annotated[CaptureSettings | None, SPREAD] = None,
    live: Annotated[LiveSettings | None, SPREAD] = None,
    truth: Truth = None,
    resume: Resume = False,
    overlay: Overlay = True,
    replay: Replay = True,
    json: Json = False,
) -> None:
    """Capture the motion of one person before several calibrated cameras, from masks or live.

    Nothing need be known of the person: lengths and girths are fitted to the first frames. This is
    estimate with the bundled person as the model, of a sequence of frames unless scene.yaml has
    sequence: false. Pictures or videos need masks of the first frame alone, in two cameras or more;
    with --start no mask. If the folder has sources.yaml beside cameras.yaml, frames are captured as
    they come, from live cameras in real time, until Ctrl-C.

        drake-pose capture STUDIO --out results/person --seconds 60

    Args:
        scene: Folder with cameras.yaml and masks, pictures or videos; or with a sources.yaml.
        model: A person with landmarks.yaml beside it. Default: the bundled one.
        method: person: by all silhouettes at once; paper: by skin seen in colour pictures, and a
            search for elbows and knees, all as Date et al. print it.
    """
    settings, live = settings or CaptureSettings(), live or LiveSettings()
    of_masks = bool(truth or resume or set(changed(settings)) - {"packages"})
    # The name of SOURCES; its module would make every command's start slow.
    has_sources = (scene / "sources.yaml").is_file()
    of_person = bool(live.shape or not live.fit_shape)
    if method != "person" and (of_masks or of_person):
        raise UsageError(
            "--camera, --frame, --every, --truth, --start, --no-track, --resume, --shape "
            "and --no-fit-shape are for --method person"
        )
    if method == "person" and live.faces is not None:
        raise UsageError("--face-camera and --faces are for --method paper")
    if has_sources and of_masks:
        raise UsageError(
            "--camera, --frame, --every, --truth, --start, --no-track and --resume are for a "
            f"folder of masks or pictures; {scene} has a sources.yaml"
        )
    if method == "person" and not has_sources and live != LiveSettings():
        raise UsageError(f"{scene} has no sources.yaml, which that option is for")
    if method == "person" and not has_sources:
        from drake_pose.jobs.estimate.inputs import bundled_person

        given = {one.name: getattr(settings, one.name) for one in fields(settings)}
        estimate(
            scene, model=model or bundled_person(), out=out,
            settings=EstimateSettings(method="person", **given),
            truth=truth, resume=resume, overlay=overlay, replay=replay, json=json,
        )  # fmt: skip
        return
    from drake_pose.jobs.live.capture import capture_live
    from drake_pose.jobs.live.scene import hush_opencv, load_live_scene

    hush_opencv()
    studio = load_live_scene(scene)
    live = replace(live, replay=replay, packages=settings.packages)
    if method != "person" and any(one.live for one in studio.specifications.values()):
        say("drake-pose: stand upright before the cameras, both arms spread to the sides")
    with FrameProgress() as progress:

        def show(count: int, _: bool) -> None:
            progress.show_stage("frames", count, None)

        result = capture_live(studio, out, model, live, warn, show, method)
    for text in result.troubles:
        warn(text)
    if result.interrupted:
        say("drake-pose: ended by Ctrl-C; all frames are kept")
    found = result.estimate
    if json:
        print_json(found.summary)
    elif found.rows:
        print_estimate(found)
        output_console().print(_source_table(found.summary["sources"]))
    if not found.rows:
        raise SceneError("no camera gave a picture")
    if not found.found_count:
        raise SceneError("nobody was found in any frame")


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
