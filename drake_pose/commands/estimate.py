"""What the commands `drake-pose estimate` and `drake-pose capture` do alike."""

from __future__ import annotations

from pathlib import Path

import typer

from drake_pose.commands.terminal import (
    FAILED,
    errors_as_messages,
    print_result,
    say,
)
from drake_pose.results.settings import EstimateSettings


def run_estimate(
    scene: Path,
    model: Path,
    out: Path,
    settings: EstimateSettings,
    *,
    truth: Path | None = None,
    resume: bool = False,
    overlay: bool = True,
    replay: bool = True,
    json: bool = False,
) -> None:
    """Estimates a scene with a progress bar, and prints what came out."""
    with errors_as_messages(out):
        from drake_pose.commands.report import FrameProgress, print_estimate
        from drake_pose.jobs.estimate.compile_ahead import compiling_ahead
        from drake_pose.jobs.estimate.scene import estimate_scene

        with compiling_ahead(), FrameProgress() as progress:
            result = estimate_scene(
                scene, model, out, settings, truth=truth, resume=resume, replay=replay,
                overlay=overlay, on_frame=progress, on_stage=progress.show_stage,
            )  # fmt: skip
        print_result(result, json, print_estimate)
        if result.found_count == 0:
            say("drake-pose: error: no pose was found in any frame")
            raise typer.Exit(FAILED)
