"""The command `drake-pose reproduce shimada`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_pose.apps.commands.estimate_options import JsonOption
from drake_pose.apps.commands.terminal import errors_as_messages, print_json

_ALL = "all"


def shimada(
    runs: Annotated[
        int, typer.Option(min=1, help="Number of sequences for each of r_13 = 35 and 40.")
    ] = 50,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random sequences.")] = 0,
    truncation: Annotated[
        str,
        typer.Option(help="sequential (the paper's), joint, clip, none; or all of these."),
    ] = "joint",
    observed: Annotated[
        str,
        typer.Option(
            help="What is measured. full: all points and lines; lines: the knuckles are hidden."
        ),
    ] = "full",
    static: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="FRAMES",
            help="Another experiment: one unchanging view for this many frames, then new views.",
        ),
    ] = None,
    start: Annotated[
        str,
        typer.Option(help="With --static: guess (the view first) or learned (first the sequence)."),
    ] = "guess",
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for plots. Default: none are written."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.SHIMADA."""
    if static is not None and out is not None:
        raise typer.BadParameter("makes no plots; leave --out away", param_hint="--static")
    if truncation == _ALL and (static is not None or out is not None):
        raise typer.BadParameter("all goes without --static and --out", param_hint="--truncation")
    with errors_as_messages():
        from drake_pose.apps.commands.report import count_progress, output_console
        from drake_pose.apps.experiments.shimada.experiment import (
            CASES,
            ComparedTruncations,
            ExperimentResult,
            compare_truncations,
            run_experiment,
        )
        from drake_pose.apps.experiments.shimada.pictures import save_pictures
        from drake_pose.apps.experiments.shimada.static_view import (
            MARKS,
            StaticResult,
            run_static_experiment,
        )
        from drake_pose.apps.results.folder import require_empty
        from drake_pose.filtering.kalman.truncated_filter import TRUNCATIONS

        result: ExperimentResult | ComparedTruncations | StaticResult
        if static is not None:
            marks = (*(mark for mark in MARKS if mark < static), static)
            with count_progress("views", runs) as advance:
                result = run_static_experiment(
                    runs, seed, truncation, observed, start, marks, advance
                )
        elif truncation == _ALL:
            with count_progress("sequences", runs * len(CASES) * len(TRUNCATIONS)) as advance:
                result = compare_truncations(runs, seed, observed, advance)
        else:
            if out is not None:
                require_empty(out)
            with count_progress("sequences", runs * len(CASES)) as advance:
                result = run_experiment(runs, seed, truncation, observed, advance)
            if out is not None:
                save_pictures(result, out)
        if json:
            print_json(result.as_json())
        else:
            output_console().print(result.table())
