"""The command `drake-pose capture`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_pose.apps.estimate_options import JsonOption, ReplayOption, SceneArgument
from drake_pose.apps.terminal import FAILED, errors_as_messages, print_json, say, warn


def capture(
    scene: SceneArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the result.")],
    model: Annotated[
        Path | None,
        typer.Option(help="A person with landmarks.yaml beside it; the bundled one if not given."),
    ] = None,
    replay: ReplayOption = True,
    json: JsonOption = False,
) -> None:
    """See help_texts.CAPTURE."""
    with errors_as_messages():
        from drake_pose.apps.capture import capture_scene
        from drake_pose.apps.report import count_progress, percent
        from drake_pose.silhouette import load_scene

        done = 0
        with count_progress("frames", len(load_scene(scene).frames)) as advance:

            def count(frames: int) -> None:
                nonlocal done
                done += frames
                advance(done)

            result = capture_scene(scene, out, model, replay, count)
        for text in result.warnings:
            warn(text)
        summary = result.summary
        if json:
            print_json(summary)
        else:
            say(
                f"drake-pose: {summary['found_count']} of {summary['frame_count']} frames, mean "
                f"intersection over union {percent(summary['mean_iou'])}; result in {out}"
            )
        if not summary["found_count"]:
            raise typer.Exit(FAILED)
