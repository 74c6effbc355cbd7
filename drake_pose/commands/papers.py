"""The commands `drake-pose reproduce kameda`, `shimada`, `date` and `all`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from drake_pose.commands.common import (
    SPREAD,
    Json,
    Out,
    Pictures,
    Resume,
    Seed,
    UsageError,
    count_progress,
    output_console,
    print_json,
    say,
    warn,
    within,
)

if TYPE_CHECKING:
    from rich.console import RenderableType

    from drake_pose.papers.tables import Count
    from drake_pose.search import PoseSearch


@dataclass(frozen=True, kw_only=True)
class KamedaOptions:
    """Options of experiment A of Kameda et al."""

    seed: Annotated[int | None, within(0)] = None
    """Seed of the random poses. Default: 0."""
    seeds: Annotated[int | None, within(1)] = None
    """Number of seeds; with several the spread of the results is shown. Default: 1."""
    method: Literal["paper", "beam"] | None = None
    """paper: the published search alone; beam: compare it with beam search. Default: paper."""
    angles: Literal["grid", "continuous"] | None = None
    """grid: true angles and samples are multiples of 20 degrees, as in the paper; continuous: true
    angles are arbitrary, and poses are refined between the samples. Default: grid."""
    outside_limit: Annotated[float | None, within(0.0), Parameter(metavar="R")] = None
    """The paper's r: area of a segment that may lie outside the mask [pixel]. Default: 200."""
    candidates: Annotated[int | None, within(1), Parameter(metavar="K")] = None
    """The paper's K: number of candidates kept for each segment. Default: 5."""
    interval: Annotated[float | None, within(1.0, 90.0)] = None
    """Sampling interval [deg]. Default: 20."""
    views: Annotated[int | None, within(1)] = None
    """With --angles continuous: number of cameras. Default: 1."""
    out: Pictures = None

    def refuse(self, needed: str, *but: str) -> None:
        """Raise a UsageError if an option was given, because it needs another one.

        Args:
            needed: the other option, for the message.
            but: names of the fields that may be given.
        """
        for field in fields(self):
            if field.name not in but and getattr(self, field.name) is not None:
                raise UsageError(f"--{field.name.replace('_', '-')} needs {needed}")


def kameda(
    *,
    experiment: Literal["A", "B", "C"] = "A",
    images: Annotated[int, within(1)] = 219,
    options: Annotated[KamedaOptions | None, SPREAD] = None,
    json: Json = False,
) -> None:
    """Kameda, Minoh and Ikeda: poses of a woman (A), of a man in real pictures (B), of a hand (C).

    The pose is searched from one silhouette and the position of the head (A), an ankle (B) or the
    wrist (C). The table shows the published results beside ours.

        drake-pose reproduce kameda --images 20

    Args:
        experiment: A: rendered silhouettes of random poses; B: six pictures of a man; C: two
            pictures of a hand.
        images: Maximum number of silhouettes.
    """
    one = options or KamedaOptions()
    is_continuous = one.angles == "continuous"
    first, seeds = one.seed or 0, one.seeds or 1
    if experiment != "A":
        one.refuse("--experiment A", "out")
    elif is_continuous:
        one.refuse("--angles grid", "angles", "seed", "views")
    elif one.views is not None:
        raise UsageError("--views needs --angles continuous")
    warnings: list[str] = []
    with _experiment(one.out) as count:
        from drake_pose.papers import kameda as poses
        from drake_pose.papers.kameda_pictures import save_pictures
        from drake_pose.search import MultiStartSearch

        if experiment != "A":
            real = poses.run_real_experiment(experiment, images, one.out, count)
            figures, table = {**real["beam"], "paper_method": real["paper"]}, poses.real_table(real)
            for method, name in poses.METHODS.items():
                warnings += [f"{name}: {text}" for text in real[method]["warnings"]]
        elif is_continuous:
            search = MultiStartSearch(poses.experiment_tree(), exact_masks=True)
            result = poses.run_experiment(search, images, first, count, one.views or 1)
            figures, table = poses.continuous_figures(result), poses.continuous_table(result)
        else:
            limit = 200.0 if one.outside_limit is None else one.outside_limit
            interval = one.interval or 20.0
            # For the comparison the published search runs on as many images as in the paper.
            is_beam = one.method == "beam"
            few = min(images, int(poses.PAPER["images"])) if is_beam else images
            paper = poses.experiment_search(limit, one.candidates or 5, interval)
            searches: list[tuple[PoseSearch, int]] = [(paper, few)]
            if is_beam:
                searches.append((poses.beam_experiment_search(interval), images))
            runs = [
                [poses.run_experiment(search, number, first + k, count) for k in range(seeds)]
                for search, number in searches
            ]
            figures, table = poses.grid_figures(*runs[-1]), poses.grid_table(runs)
            if is_beam:
                figures["paper_method"] = poses.grid_figures(*runs[0])
            if one.out is not None:
                save_pictures(runs[-1][0], one.out)
    _show(figures, [table], json, warnings)


@dataclass(frozen=True, kw_only=True)
class ShimadaOptions:
    """Options of the experiments with hands; some exclude each other."""

    runs: Annotated[int | None, within(1)] = None
    """Number of sequences for each of r_13 = 35 and 40. Default: 50, with --pictures 10."""
    seed: Seed = 0
    truncation: Literal["sequential", "joint", "clip", "none", "all"] | None = None
    """Truncation of the belief by the inequalities; sequential is the published one, all compares
    all of them. Default: joint, with --hypotheses sequential."""
    observed: Literal["lines", "lines_wrist", "full"] | None = None
    """Measurements. lines: axes of segments, fingertips and the palm's contour, as in the paper;
    lines_wrist: also the wrist's position; full: all points. Default: lines."""
    iterations: Annotated[int | None, within(1)] = None
    """Maximum number of linearisations in an update; the published filter has 1. Default: 20, with
    --hypotheses 1."""
    hypotheses: bool = False
    """Run the experiment of figure 9 instead: fingers bend through the image plane. Shows which
    hypotheses are created, and what rejects the wrong ones."""
    pictures: bool = False
    """Measure silhouettes drawn by Drake's renderer instead of noisy numbers."""
    sequence: tuple[Path, ...] = ()
    """With --pictures: use recorded silhouettes instead, of a right hand cut off at the wrist, in
    one view of unknown scale (a scene with sequence: true); repeat for several."""
    noise: float = 1.0
    """Factor of the measurement noise; the filter knows it."""
    acceleration: float = 1.0
    """Factor of the accelerations that the filter expects."""
    out: Pictures = None


def shimada(
    *, options: Annotated[ShimadaOptions | None, SPREAD] = None, json: Json = False
) -> None:
    """Shimada, Shirai, Kuno and Miura: joint angles and lengths of a synthetic hand, one camera.

    A two-finger hand moves, turns and flexes for 55 frames, measured with noise. A Kalman filter
    starts from wrong angles and lengths and corrects both; its belief is truncated by the limits
    and couplings of the paper's table 1. The published experiment measures numbers (section 6);
    with --pictures the measurements are silhouettes from Drake's renderer (figure 17).

        drake-pose reproduce shimada --runs 20 --out results/shimada
        drake-pose reproduce shimada --pictures --out results/figure_17
        drake-pose reproduce shimada --pictures --sequence SCENE --out results/figure_17_hand
    """
    one = options or ShimadaOptions()
    is_all = one.truncation == "all"
    if is_all and (one.hypotheses or one.out is not None):
        raise UsageError("--truncation all excludes --hypotheses and --out")
    if one.pictures and (one.hypotheses or one.observed or one.noise != 1.0):
        raise UsageError("--pictures excludes --hypotheses, --observed and --noise")
    if one.hypotheses and (one.noise, one.acceleration) != (1.0, 1.0):
        raise UsageError("--hypotheses excludes --noise and --acceleration")
    if one.sequence and (not one.pictures or one.runs or is_all):
        raise UsageError("--sequence needs --pictures and excludes --runs and --truncation all")
    figures: Mapping[str, Any]
    with _experiment(one.out) as count:
        from drake_pose.filtering.truncated_filter import TRUNCATIONS
        from drake_pose.papers import shimada, shimada_pictures, shimada_sequences

        if one.sequence:
            settings = shimada.experiment_settings(one.truncation or "joint", one.iterations)
            hands = []
            for folder in one.sequence:
                hand = shimada_sequences.run_sequence(folder, settings, one.acceleration, count)
                hands.append(hand)
                if one.out is not None:
                    shimada_pictures.save_sequence(hand, one.out)
            figures = {hand.name: hand.as_json() for hand in hands}
            table = shimada_sequences.sequence_table(hands)
            warnings = [hand.warning() for hand in hands]
        elif one.hypotheses:
            truncation, observed = one.truncation or "sequential", one.observed or "lines"
            hypotheses = shimada.run_hypotheses_experiment(
                one.runs or 50, one.seed, truncation, observed, count, one.iterations or 1
            )
            figures, table, warnings = hypotheses.as_json(), hypotheses.table(), []
            if one.out is not None and not shimada_pictures.save_hypotheses(hypotheses, one.out):
                warnings = ["no wrong hypothesis was rejected by an inequality: nothing to draw"]
        else:
            names = TRUNCATIONS if is_all else (one.truncation or "joint",)
            runs = one.runs or (10 if one.pictures else 50)
            measured = shimada.PICTURES if one.pictures else one.observed or "lines"
            filtered = (count, one.iterations, one.noise, one.acceleration)
            results = [
                shimada.run_experiment(runs, one.seed, name, measured, *filtered) for name in names
            ]
            if one.out is not None:
                shimada_pictures.save_pictures(results[0], one.out)
            every: dict[str, Any] = {
                name: result.as_json() for name, result in zip(names, results, strict=True)
            }
            figures = every if is_all else every[names[0]]
            table, warnings = shimada.result_table(*results), []
    _show(figures, [table], json, warnings)


def date(
    *,
    cameras: Annotated[int, within(3)] = 9,
    frames: Annotated[int, within(40)] = 240,
    seed: Seed = 0,
    method: Literal["silhouette", "paper"] = "silhouette",
    walk: bool = False,
    out: Pictures = None,
    json: Json = False,
) -> None:
    """Date, Yoshimatsu, Arita and Taniguchi: a moving person before many calibrated cameras.

    A simulated person walks, reaches, leans, crouches, turns and crosses the arms. The table
    compares the published inverse kinematics, the published search for elbows and knees, and one
    fit to all silhouettes at once. Times are for one core, without rendering.

        drake-pose reproduce date --cameras 5 --frames 120 --out results/date

    Args:
        cameras: Number of cameras, including the one before the face; the paper has 9.
        frames: Number of frames; fewer than 120 do not show all motions.
        method: paper: the published method alone, with its rules as printed (rectangles on one
            circle, waist weights 0.55, 0.225 and 0.225, feet nearest to their last positions);
            silhouette: compare it with a fit to all silhouettes.
        walk: Run the experiment of section 6.2 and figure 8 instead: the gestures of table 1 walk
            an avatar through a place. Captured by the published method.
    """
    with _experiment(out) as count:
        from drake_pose.papers import date as people

        if walk:
            figures, pictures = people.run_walk_through(cameras, seed, count)
            if out is not None:
                people.save_walk(pictures, out)
            _show(figures, [people.walk_table(figures)], json)
            return
        result = people.run_experiment(cameras, frames, seed, method, count)
        if out is not None:
            people.save_pictures(result, out)
    _show(result.as_json(), [*result.tables(), result.costs()], json)


def reproduce_all(*, out: Out, short: bool = False, resume: Resume = False) -> None:
    """Run the experiments of the three papers and write one page about them, report.html.

    Finished experiments are kept: after Ctrl-C, --resume continues with the others.

        drake-pose reproduce all --out results/papers

    Args:
        short: Use only a few images and runs, to see whether it works.
    """
    with _experiment(out, resume) as count:
        from drake_pose.papers.all_experiments import reproduce_all as run

        page = run(out, short, count, lambda text: say(f"drake-pose: {text}"))
    say(f"drake-pose: wrote {page}")


@contextmanager
def _experiment(out: Path | None, resume: bool = False) -> Iterator[Count]:
    """Lock the folder for results, unless it is None; yields a function that starts a progress bar.

    That function gets a label and the number of all items, removes the bar before, and returns a
    function to be called with the number of finished items. ``resume``: as in `claimed`.
    """
    from drake_pose.files.folder import claimed

    with ExitStack() as bars, nullcontext() if out is None else claimed(out, resume):

        def count(what: str, total: int) -> Callable[[int], None]:
            bars.close()
            return bars.enter_context(count_progress(what, total))

        yield count


def _show(
    figures: Mapping[str, Any],
    shown: Sequence[RenderableType],
    json: bool,
    warnings: Sequence[str] = (),
) -> None:
    """Print warnings to stderr, and results to stdout.

    Args:
        figures: all results, printed if ``json`` is True.
        shown: tables of the main results, printed otherwise.
        json: whether JSON is printed.
        warnings: messages for the user.
    """
    for text in warnings:
        warn(text)
    if json:
        print_json(figures)
    else:
        output_console().print(*shown)
