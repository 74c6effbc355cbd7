"""The command `drake-pose reproduce shimada`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from drake_pose.commands.options import Json, Pictures, Seed, within
from drake_pose.commands.terminal import (
    UsageError,
    count_progress,
    output_console,
    print_json,
    say,
)

if TYPE_CHECKING:
    from drake_pose.papers.shimada.experiment import ComparedTruncations, ExperimentResult
    from drake_pose.papers.shimada.hypotheses import HypothesesResult
    from drake_pose.papers.shimada.static_view import StaticResult

_ALL = "all"


def shimada(
    *,
    runs: Annotated[int, within(1)] = 50,
    seed: Seed = 0,
    truncation: Literal["sequential", "joint", "clip", "none", "all"] | None = None,
    observed: Literal["lines", "full"] | None = None,
    iterations: Annotated[int | None, within(1)] = None,
    static: Annotated[int | None, within(1), Parameter(metavar="FRAMES")] = None,
    start: Literal["guess", "learned"] = "guess",
    hypotheses: bool = False,
    out: Pictures = None,
    json: Json = False,
) -> None:
    """Shimada, Shirai, Kuno and Miura: joint angles and lengths of a synthetic hand, one camera.

    A two-finger hand moves, turns and flexes for 55 frames, measured with noise. A Kalman filter
    starts from wrong angles and lengths and corrects both, its belief truncated by the limits and
    couplings of the paper's table 1.

        drake-pose reproduce shimada --runs 20 --out results/shimada

    Args:
        runs: Number of sequences for each of r_13 = 35 and 40.
        truncation: sequential (the paper's), joint, clip, none; or all of these. Default: joint;
            with --hypotheses sequential.
        observed: What is measured. lines: the knuckles are hidden, as in the paper; full: all
            points. Default: lines; with --static full.
        iterations: Linearisations of an update at most; the paper's filter has 1. Default: 20,
            fewer where the update stands still before; with --hypotheses 1.
        static: Another experiment: one unchanging view for this many frames, then new views.
        start: With --static: guess (the view first) or learned (first the sequence).
        hypotheses: Another experiment, figure 9: fingers bend through the image plane; which
            hypotheses are made, and what rejects the wrong ones.
    """
    if static is not None and out is not None:
        raise UsageError("--static makes no plots; leave --out away")
    if static is not None and hypotheses:
        raise UsageError("--hypotheses is another experiment than --static")
    if truncation == _ALL and (static is not None or hypotheses or out is not None):
        raise UsageError("--truncation all goes without --static, --hypotheses and --out")
    truncation = truncation or ("sequential" if hypotheses else "joint")
    observed = observed or ("lines" if static is None else "full")
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
