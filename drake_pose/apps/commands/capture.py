"""The command `drake-pose capture`: estimate with the bundled person, who is followed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_pose.apps.commands.cluster_options import SchedulerOption, WatchersOption, workers_of
from drake_pose.apps.commands.estimate import run_estimate
from drake_pose.apps.commands.estimate_options import (
    CameraOption,
    FrameOption,
    JsonOption,
    OutOption,
    OverlayOption,
    PackageOption,
    ReplayOption,
    ResumeOption,
    SceneArgument,
    TrackOption,
    TruthOption,
)
from drake_pose.apps.commands.live import (
    FitShapeOption,
    SecondsOption,
    ShapeOption,
    ToleranceOption,
    run_live_capture,
)
from drake_pose.apps.commands.terminal import errors_as_messages, usage_errors
from drake_pose.apps.options import parse_packages
from drake_pose.apps.settings import EstimateSettings

PersonOption = Annotated[
    Path | None,
    typer.Option(help="A person with landmarks.yaml beside it. Default: the bundled one."),
]


def capture(
    scene: SceneArgument,
    out: OutOption,
    model: PersonOption = None,
    package: PackageOption = None,
    camera: CameraOption = None,
    frame: FrameOption = None,
    truth: TruthOption = None,
    track: TrackOption = True,
    resume: ResumeOption = False,
    overlay: OverlayOption = True,
    replay: ReplayOption = True,
    seconds: SecondsOption = None,
    shape: ShapeOption = None,
    fit_shape: FitShapeOption = True,
    tolerance: ToleranceOption = None,
    workers: WatchersOption = 0,
    scheduler: SchedulerOption = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.CAPTURE."""
    with usage_errors():
        packages = parse_packages(package or ())
    if workers and scheduler is not None:
        raise typer.BadParameter("give --workers or --scheduler, not both")
    # The name of SOURCES; its module would make every command's start slow.
    if (scene / "sources.yaml").is_file():
        if camera or frame or truth or resume or not track:
            raise typer.BadParameter(
                "--camera, --frame, --truth, --no-track and --resume are for a folder of masks; "
                f"{scene} has a sources.yaml"
            )
        with errors_as_messages(), workers_of(workers, scheduler) as client:
            open_sensors = None
            if client is not None:
                from drake_pose.apps.cluster.remote_views import opener

                # Workers may have another working folder.
                scene, open_sensors = scene.absolute(), opener(client, tolerance)
            run_live_capture(
                scene, out, model, seconds=seconds, shape=shape, fit_shape=fit_shape,
                tolerance=tolerance, replay=replay, json=json, open_sensors=open_sensors,
                packages=packages,
            )  # fmt: skip
        return
    if seconds or shape or not fit_shape or tolerance or workers or scheduler:
        raise typer.BadParameter(f"{scene} has no sources.yaml, which that option is for")
    with errors_as_messages():
        from drake_pose.apps.estimate.capture import bundled_person

        model = model or bundled_person()
    settings = EstimateSettings(
        cameras=tuple(camera or ()), frames=tuple(frame or ()), method="person", track=track,
        packages=packages,
    )  # fmt: skip
    run_estimate(
        scene, model, out, settings, truth=truth, resume=resume, overlay=overlay, replay=replay,
        json=json,
    )  # fmt: skip
