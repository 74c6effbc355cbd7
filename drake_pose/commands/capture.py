"""The command `drake-pose capture`: estimate with the bundled person, who is followed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_pose.commands.cluster_options import SchedulerOption, WatchersOption, workers_of
from drake_pose.commands.estimate import run_estimate
from drake_pose.commands.estimate_options import (
    CameraOption,
    FrameOption,
    JsonOption,
    OutOption,
    OverlayOption,
    PackageOption,
    ReplayOption,
    ResumeOption,
    SceneArgument,
    StartOption,
    TrackOption,
    TruthOption,
)
from drake_pose.commands.live import (
    FaceCameraOption,
    FacesOption,
    FitShapeOption,
    SecondsOption,
    ShapeOption,
    ToleranceOption,
    run_live_capture,
    run_paper_capture,
)
from drake_pose.commands.terminal import errors_as_messages, usage_errors
from drake_pose.results.options import parse_packages
from drake_pose.results.settings import EstimateSettings

if TYPE_CHECKING:
    from distributed import Client

    from drake_pose.jobs.live.scene import LiveScene
    from drake_pose.systems.person.live_capture import LiveSensors

PersonOption = Annotated[
    Path | None,
    typer.Option(help="A person with landmarks.yaml beside it. Default: the bundled one."),
]
MethodOption = Annotated[
    str,
    typer.Option(
        help="person: by all silhouettes at once; paper: by skin seen in colour pictures, and a "
        "search for elbows and knees, as Date et al. published it."
    ),
]


def capture(
    scene: SceneArgument,
    out: OutOption,
    model: PersonOption = None,
    method: MethodOption = "person",
    package: PackageOption = None,
    camera: CameraOption = None,
    frame: FrameOption = None,
    truth: TruthOption = None,
    start: StartOption = None,
    track: TrackOption = True,
    resume: ResumeOption = False,
    overlay: OverlayOption = True,
    replay: ReplayOption = True,
    seconds: SecondsOption = None,
    shape: ShapeOption = None,
    fit_shape: FitShapeOption = True,
    tolerance: ToleranceOption = None,
    face_camera: FaceCameraOption = None,
    faces: FacesOption = None,
    workers: WatchersOption = 0,
    scheduler: SchedulerOption = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.CAPTURE."""
    with usage_errors():
        packages = parse_packages(package or ())
    if workers and scheduler is not None:
        raise typer.BadParameter("give --workers or --scheduler, not both")
    of_masks = bool(camera or frame or truth or start or resume or not track)
    of_person = of_masks or shape or not fit_shape or workers or scheduler
    _check_method(method, bool(of_person), bool(face_camera or faces))
    if method == "paper":
        run_paper_capture(
            scene, out, model, seconds=seconds, tolerance=tolerance, replay=replay, json=json,
            face_camera=face_camera, faces=faces, packages=packages,
        )  # fmt: skip
        return
    of_sources = seconds or shape or not fit_shape or tolerance or workers or scheduler
    if _has_sources(scene, of_masks, bool(of_sources)):
        with errors_as_messages(), workers_of(workers, scheduler) as client:
            # Workers may have another working folder.
            run_live_capture(
                scene if client is None else scene.absolute(), out, model, seconds=seconds,
                shape=shape, fit_shape=fit_shape, tolerance=tolerance, replay=replay, json=json,
                open_sensors=_opener(client, tolerance), packages=packages,
            )  # fmt: skip
        return
    with errors_as_messages():
        from drake_pose.jobs.estimate.capture import bundled_person

        model = model or bundled_person()
    settings = EstimateSettings(
        cameras=tuple(camera or ()), frames=tuple(frame or ()), method="person", track=track,
        packages=packages, start=start,
    )  # fmt: skip
    run_estimate(
        scene, model, out, settings, truth=truth, resume=resume, overlay=overlay, replay=replay,
        json=json,
    )  # fmt: skip


def _opener(
    client: Client | None, tolerance: float | None
) -> Callable[[LiveScene], LiveSensors] | None:
    """What opens the sensors on the workers; None: they are opened here."""
    if client is None:
        return None
    from drake_pose.jobs.cluster.remote_views import opener

    return opener(client, tolerance)


def _has_sources(scene: Path, of_masks: bool, of_sources: bool) -> bool:
    """Whether a folder says where its cameras' pictures come from; refuses the other's options."""
    # The name of SOURCES; its module would make every command's start slow.
    has_sources = (scene / "sources.yaml").is_file()
    if has_sources and of_masks:
        raise typer.BadParameter(
            "--camera, --frame, --truth, --start, --no-track and --resume are for a folder of "
            f"masks or pictures; {scene} has a sources.yaml"
        )
    if of_sources and not has_sources:
        raise typer.BadParameter(f"{scene} has no sources.yaml, which that option is for")
    return has_sources


def _check_method(method: str, is_of_person: bool, is_of_paper: bool) -> None:
    """Refuses a method that there is not, and options of the other one."""
    if method not in ("person", "paper"):
        raise typer.BadParameter("must be person or paper", param_hint="--method")
    if method == "paper" and is_of_person:
        raise typer.BadParameter(
            "--camera, --frame, --truth, --start, --no-track, --resume, --shape, --no-fit-shape, "
            "--workers and --scheduler are for --method person"
        )
    if method == "person" and is_of_paper:
        raise typer.BadParameter("--face-camera and --faces are for --method paper")
