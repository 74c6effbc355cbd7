"""The command `drake-pose reproduce shimada`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_pose.commands.estimate_options import JsonOption, PicturesOption
from drake_pose.commands.terminal import errors_as_messages, print_json, say

if TYPE_CHECKING:
    from drake_pose.papers.shimada.experiment import ComparedTruncations, ExperimentResult
    from drake_pose.papers.shimada.hypotheses import HypothesesResult
    from drake_pose.papers.shimada.static_view import StaticResult

_ALL = "all"


RunsOption = Annotated[
    int, typer.Option(min=1, help="Number of sequences for each of r_13 = 35 and 40.")
]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of the random sequences.")]
TruncationOption = Annotated[
    str | None,
    typer.Option(
        help="sequential (the paper's), joint, clip, none; or all of these. Default: joint; with "
        "--hypotheses sequential."
    ),
]
ObservedOption = Annotated[
    str | None,
    typer.Option(
        help="What is measured. lines: the knuckles are hidden, as in the paper; full: all points. "
        "Default: lines; with --static full."
    ),
]
IterationsOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Linearisations of an update at most; the paper's filter has 1. Default: 20, fewer "
        "where the update stands still before; with --hypotheses 1.",
    ),
]
StaticOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="FRAMES",
        help="Another experiment: one unchanging view for this many frames, then new views.",
    ),
]
HypothesesOption = Annotated[
    bool,
    typer.Option(
        "--hypotheses",
        help="Another experiment, figure 9: fingers bend through the image plane; which "
        "hypotheses are made, and what rejects the wrong ones.",
    ),
]
StartOption = Annotated[
    str,
    typer.Option(help="With --static: guess (the view first) or learned (first the sequence)."),
]


def shimada(
    runs: RunsOption = 50,
    seed: SeedOption = 0,
    truncation: TruncationOption = None,
    observed: ObservedOption = None,
    iterations: IterationsOption = None,
    static: StaticOption = None,
    start: StartOption = "guess",
    hypotheses: HypothesesOption = False,
    out: PicturesOption = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.SHIMADA."""
    if static is not None and out is not None:
        raise typer.BadParameter("makes no plots; leave --out away", param_hint="--static")
    if static is not None and hypotheses:
        raise typer.BadParameter("is another experiment than --static", param_hint="--hypotheses")
    if truncation == _ALL and (static is not None or hypotheses or out is not None):
        raise typer.BadParameter(
            "all goes without --static, --hypotheses and --out", param_hint="--truncation"
        )
    if truncation is None:
        truncation = "sequential" if hypotheses else "joint"
    if observed is None:
        observed = "lines" if static is None else "full"
    with errors_as_messages():
        from drake_pose.commands.report import output_console

        result: ExperimentResult | ComparedTruncations | StaticResult | HypothesesResult
        if hypotheses:
            result = _run_hypotheses(runs, seed, truncation, observed, iterations or 1, out)
        elif static is not None:
            result = _run_static(runs, seed, truncation, observed, static, start, iterations)
        elif truncation == _ALL:
            result = _compare_truncations(runs, seed, observed, iterations)
        else:
            result = _run_experiment(runs, seed, truncation, observed, iterations, out)
        if json:
            print_json(result.as_json())
        else:
            output_console().print(result.table())


def _run_static(
    runs: int,
    seed: int,
    truncation: str,
    observed: str,
    frames: int,
    start: str,
    iterations: int | None,
) -> StaticResult:
    """One unchanging view for this many frames."""
    from drake_pose.commands.report import count_progress
    from drake_pose.papers.shimada.static_view import MARKS, run_static_experiment

    marks = (*(mark for mark in MARKS if mark < frames), frames)
    with count_progress("views", runs) as advance:
        return run_static_experiment(
            runs, seed, truncation, observed, start, marks, advance, iterations
        )


def _run_hypotheses(
    runs: int, seed: int, truncation: str, observed: str, iterations: int, out: Path | None
) -> HypothesesResult:
    """What becomes of each hypothesis, and a picture of two."""
    from drake_pose.commands.report import count_progress
    from drake_pose.papers.shimada.hypotheses import run_hypotheses_experiment
    from drake_pose.papers.shimada.pictures import save_hypotheses
    from drake_pose.results.folder import require_empty

    if out is not None:
        require_empty(out)
    with count_progress("sequences", runs) as advance:
        result = run_hypotheses_experiment(runs, seed, truncation, observed, advance, iterations)
    if out is not None and not save_hypotheses(result, out):
        say("drake-pose: no wrong hypothesis was rejected by an inequality: nothing to draw")
    return result


def _compare_truncations(
    runs: int, seed: int, observed: str, iterations: int | None
) -> ComparedTruncations:
    """The same sequences with each truncation."""
    from drake_pose.commands.report import count_progress
    from drake_pose.filtering.kalman.truncated_filter import TRUNCATIONS
    from drake_pose.papers.shimada.experiment import CASES, compare_truncations

    with count_progress("sequences", runs * len(CASES) * len(TRUNCATIONS)) as advance:
        return compare_truncations(runs, seed, observed, advance, iterations)


def _run_experiment(
    runs: int,
    seed: int,
    truncation: str,
    observed: str,
    iterations: int | None,
    out: Path | None,
) -> ExperimentResult:
    """The paper's experiment, and its plots."""
    from drake_pose.commands.report import count_progress
    from drake_pose.papers.shimada.experiment import CASES, run_experiment
    from drake_pose.papers.shimada.pictures import save_pictures
    from drake_pose.results.folder import require_empty

    if out is not None:
        require_empty(out)
    with count_progress("sequences", runs * len(CASES)) as advance:
        result = run_experiment(runs, seed, truncation, observed, advance, iterations)
    if out is not None:
        save_pictures(result, out)
    return result
