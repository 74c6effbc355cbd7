"""The commands `drake-pose reproduce kameda`, `shimada`, `date` and `all`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from drake_pose.commands.options import SPREAD, Json, Out, Pictures, Resume, Seed, within
from drake_pose.commands.terminal import (
    UsageError,
    count_progress,
    output_console,
    print_json,
    say,
    warn,
)

if TYPE_CHECKING:
    from rich.console import RenderableType

    from drake_pose.papers.tables import Count

# What is about the grid of angles, which continuous ones have none of.
_OF_GRID = (
    "seeds", "method", "outside_limit", "outside_weight", "candidates", "interval", "edges",
    "edge_noise", "body_scale", "out",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class KamedaOptions:
    """Options of experiment A, of which some are refused where they mean nothing."""

    seed: Annotated[int | None, within(0)] = None
    """Seed of the random poses. Default: 0."""
    seeds: Annotated[int | None, within(1)] = None
    """Run this many seeds, and show how far the figures spread. Default: 1."""
    method: Literal["paper", "beam"] | None = None
    """paper: the paper's alone; beam: beam search beside it. Default: paper."""
    angles: Literal["grid", "continuous"] | None = None
    """grid: true angles and samples are multiples of 20 degrees, as in the paper; continuous: any
    true angles, and poses are refined between the samples. Default: grid."""
    outside_limit: Annotated[float | None, within(0.0), Parameter(metavar="R")] = None
    """The paper's r: area of a segment that may lie outside [pixel]. Default: 200."""
    outside_weight: Annotated[float | None, within(0.0), Parameter(metavar="W")] = None
    """Run the paper's method once more, its lists ordered by e - W * (area outside): not in the
    paper, but 10 meets most of its figures. Default: 0."""
    candidates: Annotated[int | None, within(1), Parameter(metavar="K")] = None
    """The paper's K: candidates kept for each segment. Default: 5."""
    interval: Annotated[float | None, within(1.0, 90.0)] = None
    """Sampling interval [deg]. Default: 20."""
    views: Annotated[int | None, within(1)] = None
    """With --angles continuous: number of cameras. Default: 1."""
    body_scale: Annotated[float | None, within(0.1, 1.0)] = None
    """Scale of the body. With 0.84 its segments have the mean area of the paper's. Default: 1."""
    mismatch: bool | None = None
    """With --angles continuous: also a body whose widths and joints differ from the model's."""
    edges: bool | None = None
    """With --method beam: resolve ambiguous silhouettes by the edges inside them (some seconds for
    each)."""
    edge_noise: Annotated[float | None, within(0.0, 0.9)] = None
    """With --edges: this share of them is missing, the others are a pixel off, and a quarter as
    many are wrong. Default: 0."""
    renderer: Literal["drake", "own"] | None = None
    """Who draws the silhouettes. drake: Drake's renderer, and they count as equal within what two
    renderers differ by; own: the code that scores them, to the pixel. Default: drake."""
    out: Pictures = None


def kameda(
    *,
    experiment: Literal["A", "B", "C"] = "A",
    images: Annotated[int, within(1)] = 219,
    options: Annotated[KamedaOptions | None, SPREAD] = None,
    json: Json = False,
) -> None:
    """Kameda, Minoh and Ikeda: poses of a woman (A), real silhouettes of a man (B), a hand (C).

    The pose is searched given nothing but the position of the head (A), an ankle (B) or the wrist
    (C). The table shows the paper's figures beside ours.

        drake-pose reproduce kameda --images 20

    Args:
        experiment: A: random poses, drawn; B: six pictures of a person; C: two pictures of a hand.
        images: Number of silhouettes; of B and C all that there are or fewer.
    """
    one = options or KamedaOptions()
    if experiment != "A":
        _refuse(one, [f.name for f in fields(one) if f.name != "out"], "--experiment A")
        _kameda_pictures(experiment, images, one.out, json)
        return
    if one.edges and one.method != "beam":
        raise UsageError("--edges needs --method beam")
    if one.edge_noise and not one.edges:
        raise UsageError("--edge-noise needs --edges")
    if one.angles == "continuous":
        _refuse(one, _OF_GRID, "--angles grid")
        _kameda_continuous(images, one, json)
    else:
        _refuse(one, ("views", "mismatch"), "--angles continuous")
        _kameda_grid(images, one, json)


def _refuse(options: KamedaOptions, names: Sequence[str], needed: str) -> None:
    """Refuses options that were given and mean nothing here."""
    for name in names:
        if getattr(options, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} needs {needed}")


def _kameda_grid(images: int, options: KamedaOptions, json: bool) -> None:
    """Experiment A as the paper has it; the search that was asked for is the last column."""
    with _experiment(options.out) as count:
        from drake_pose.papers.kameda import (
            PAPER_IMAGES,
            beam_experiment_search,
            experiment_search,
            run_experiment,
        )
        from drake_pose.papers.kameda_figures import (
            edge_lines,
            grid_figures,
            grid_table,
            settle_by_edges,
        )
        from drake_pose.papers.kameda_pictures import save_pictures
        from drake_pose.search import PoseSearch

        interval, first = options.interval or 20.0, options.seed or 0
        renderer, scale = options.renderer or "drake", options.body_scale or 1.0
        limit = 200.0 if options.outside_limit is None else options.outside_limit
        paper = (limit, options.candidates or 5, interval)
        searches: dict[str, PoseSearch] = {"paper_method": experiment_search(*paper)}
        if options.outside_weight:
            weighted = experiment_search(*paper, options.outside_weight)
            searches["outside_weight_method"] = weighted
        if options.method == "beam":
            searches["beam"] = beam_experiment_search(interval, renderer)
        results = {}
        for name, search in searches.items():
            # The paper's search beside ours makes no more than the paper's own images.
            fewer = options.method == "beam" and name != "beam"
            number = min(images, PAPER_IMAGES) if fewer else images
            seeds = range(first, first + (options.seeds or 1))
            results[name] = [
                run_experiment(search, number, seed, count, renderer=renderer, body_scale=scale)
                for seed in seeds
            ]
        *beside, leading = results
        asked, settled = results[leading][0], {}
        if options.edges:
            settled = settle_by_edges(asked, count, options.edge_noise or 0.0)
        if options.out is not None:
            save_pictures(asked, options.out)
    others = {name: grid_figures(*results[name]) for name in beside}
    figures = {**grid_figures(*results[leading]), **settled, **others}
    _show(figures, [grid_table(list(results.values()))], json)
    if settled and not json:
        say(edge_lines(settled))


def _kameda_continuous(images: int, options: KamedaOptions, json: bool) -> None:
    """Experiment A with angles between the samples, and a second time with another body."""
    with _experiment(None) as count:
        from drake_pose.papers.kameda import continuous_search, run_experiment
        from drake_pose.papers.kameda_figures import continuous_figures, continuous_table

        search, seed, views = continuous_search(), options.seed or 0, options.views or 1
        own = run_experiment(
            search, images, seed, count, views, renderer=options.renderer or "drake"
        )
        results = {"the model itself": own}
        figures = continuous_figures(results["the model itself"])
        if options.mismatch:
            other = run_experiment(search, images, seed, count, views, mismatch=True)
            results["another body"] = other
            figures["another_body"] = continuous_figures(other)
    _show(figures, [continuous_table(results)], json)


def _kameda_pictures(experiment: str, images: int, out: Path | None, json: bool) -> None:
    """Experiments B and C: both methods on the stored pictures."""
    with _experiment(out) as count:
        from drake_pose.papers.kameda_real_pictures import METHODS, real_table, run_real_experiment

        figures = run_real_experiment(experiment, images, out, count)
    for method, name in METHODS.items():
        for text in figures[method]["warnings"]:
            warn(f"{name}: {text}")
    _show({**figures["beam"], "paper_method": figures["paper"]}, [real_table(figures)], json)


@dataclass(frozen=True, kw_only=True)
class ShimadaOptions:
    """Options of the experiments with hands, of which some go without others."""

    runs: Annotated[int | None, within(1)] = None
    """Number of sequences for each of r_13 = 35 and 40. Default: 50; with --pictures 10."""
    seed: Seed = 0
    truncation: Literal["sequential", "joint", "clip", "none", "all"] | None = None
    """sequential is the paper's, default with --hypotheses; else joint; or all."""
    observed: Literal["lines", "lines_wrist", "full"] | None = None
    """What is measured. lines: axes of segments, fingertips and the palm's outline, as in the
    paper; lines_wrist: the wrist's place, too; full: all points. Default: lines."""
    iterations: Annotated[int | None, within(1)] = None
    """Linearisations of an update at most; the paper's filter has 1. Default: 20; with --hypotheses
    1."""
    hypotheses: bool = False
    """Another experiment, figure 9: fingers bend through the image plane; which hypotheses are
    made, and what rejects the wrong ones."""
    pictures: bool = False
    """Silhouettes by Drake's renderer instead of numbers with noise."""
    sequence: tuple[Path, ...] = ()
    """With --pictures: recorded silhouettes of a right hand, cut off at the wrist, in one view of
    unknown scale, instead (a scene with sequence: true); repeat for several."""
    noise: float = 1.0
    """So many times the noise of the numbers, which the filter is told."""
    acceleration: float = 1.0
    """So many times the accelerations that the filter expects."""
    out: Pictures = None


def shimada(
    *, options: Annotated[ShimadaOptions | None, SPREAD] = None, json: Json = False
) -> None:
    """Shimada, Shirai, Kuno and Miura: joint angles and lengths of a synthetic hand, one camera.

    A two-finger hand moves, turns and flexes for 55 frames, measured with noise. A Kalman filter
    starts from wrong angles and lengths and corrects both, its belief truncated by the limits and
    couplings of the paper's table 1. The paper's own experiment is one of numbers (section 6); with
    --pictures Drake's renderer shows the hand, and silhouettes are all that is seen (figure 17).

        drake-pose reproduce shimada --runs 20 --out results/shimada
        drake-pose reproduce shimada --pictures --out results/figure_17
        drake-pose reproduce shimada --pictures --sequence SCENE --out results/figure_17_hand
    """
    one = options or ShimadaOptions()
    is_all = one.truncation == "all"
    if is_all and (one.hypotheses or one.out is not None):
        raise UsageError("--truncation all goes without --hypotheses and --out")
    if one.pictures and (one.hypotheses or one.observed or one.noise != 1.0):
        raise UsageError("--pictures goes without --hypotheses, --observed and --noise")
    if one.hypotheses and (one.noise, one.acceleration) != (1.0, 1.0):
        raise UsageError("--hypotheses goes without --noise and --acceleration")
    if one.sequence and (not one.pictures or one.runs or is_all):
        raise UsageError("--sequence goes with --pictures, without --runs or truncation all")
    run = _shimada_hypotheses if one.hypotheses else _shimada_moving
    with _experiment(one.out) as count:
        figures, table, warnings = (_shimada_sequences if one.sequence else run)(one, count)
    for text in warnings:
        warn(text)
    _show(figures, [table], json)


_Shown = tuple[Mapping[str, Any], "RenderableType", Sequence[str]]
"""Figures, their table, and warnings."""


def _shimada_moving(one: ShimadaOptions, count: Count) -> _Shown:
    """The paper's moving hands, once for each truncation."""
    from drake_pose.filtering.truncated_filter import TRUNCATIONS
    from drake_pose.papers.shimada import PICTURES, result_table, run_experiment
    from drake_pose.papers.shimada_pictures import save_pictures

    names = TRUNCATIONS if one.truncation == "all" else (one.truncation or "joint",)
    runs, seen = one.runs or (10 if one.pictures else 50), one.observed or "lines"
    filtered = (count, one.iterations, one.noise, one.acceleration)
    measured = PICTURES if one.pictures else seen
    results = [run_experiment(runs, one.seed, name, measured, *filtered) for name in names]
    if one.out is not None:
        save_pictures(results[0], one.out)
    figures: dict[str, Any] = {
        name: result.as_json() for name, result in zip(names, results, strict=True)
    }
    is_all = one.truncation == "all"
    return figures if is_all else figures[names[0]], result_table(*results), ()


def _shimada_sequences(one: ShimadaOptions, count: Count) -> _Shown:
    """Figures 17 and 18 of recorded hands."""
    from drake_pose.papers.shimada import experiment_settings
    from drake_pose.papers.shimada_pictures import save_sequence
    from drake_pose.papers.shimada_sequences import run_sequence, sequence_table

    settings, results = experiment_settings(one.truncation or "joint", one.iterations), []
    for folder in one.sequence:
        results.append(run_sequence(folder, settings, one.acceleration, count))
        if one.out is not None:
            save_sequence(results[-1], one.out)
    figures = {result.name: result.as_json() for result in results}
    return figures, sequence_table(results), [result.warning() for result in results]


def _shimada_hypotheses(one: ShimadaOptions, count: Count) -> _Shown:
    """Figure 9."""
    from drake_pose.papers.shimada_hypotheses import run_hypotheses_experiment
    from drake_pose.papers.shimada_pictures import save_hypotheses

    filtered = (one.truncation or "sequential", one.observed or "lines", count, one.iterations or 1)
    fates = run_hypotheses_experiment(one.runs or 50, one.seed, *filtered)
    if one.out is not None and not save_hypotheses(fates, one.out):
        say("drake-pose: no wrong hypothesis was rejected by an inequality: nothing to draw")
    return fates.as_json(), fates.table(), ()


def date(
    *,
    cameras: Annotated[int, within(3)] = 9,
    frames: Annotated[int, within(40)] = 240,
    seed: Seed = 0,
    method: Literal["silhouette", "paper"] = "silhouette",
    renderer: Literal["drake", "own"] = "drake",
    walk: bool = False,
    out: Pictures = None,
    json: Json = False,
) -> None:
    """Date, Yoshimatsu, Arita and Taniguchi: a moving person before many calibrated cameras.

    A simulated person walks, reaches, leans, crouches, turns and crosses the arms. Compared are the
    paper's inverse kinematics alone, the paper's search for elbows and knees, and one fit to all
    silhouettes at once. Times are those of one core, without rendering.

        drake-pose reproduce date --cameras 5 --frames 120 --out results/date

    Args:
        cameras: Number of cameras, including the one at the face; the paper has 9.
        frames: Number of frames; fewer than 120 do not show all motions.
        method: Whose figures lead. paper: the paper's, all as printed (rectangles on one circle,
            the waist by 0.55, 0.225, 0.225, feet nearest to their last places), alone; silhouette:
            a fit to all silhouettes beside it.
        renderer: Who draws the person. drake: Drake's renderer; own: this project's, in flat
            colours (the face camera's pictures are Drake's).
        walk: Another experiment, section 6.2 and figure 8: the gestures of its table 1 walk an
            avatar through a place. Always captured by the paper's method.
    """
    with _experiment(out) as count:
        from drake_pose.papers.date import run_experiment
        from drake_pose.papers.date_walk import run_walk_through, save_pictures

        if walk:
            walked = run_walk_through(cameras, seed, count, renderer=renderer)
            if out is not None:
                walked.save(out)
            _show(walked.figures, [walked.table()], json)
            return
        result = run_experiment(cameras, frames, seed, method, count, renderer=renderer)
        if out is not None:
            save_pictures(result, out)
    _show(result.as_json(), [*result.tables(), result.costs()], json)


def reproduce_all(*, out: Out, short: bool = False, resume: Resume = False) -> None:
    """Run the experiments of the three papers, and make one page about them, report.html.

    An experiment that is finished is kept: after Ctrl-C, --resume goes on with the others.

        drake-pose reproduce all --out results/papers

    Args:
        short: A few images and runs only, to see that it works.
    """
    with _experiment(out, resume) as count:
        from drake_pose.papers.all_experiments import reproduce_all as run

        page = run(out, short, count, lambda text: say(f"drake-pose: {text}"))
    say(f"drake-pose: wrote {page}")


@contextmanager
def _experiment(out: Path | None, resume: bool = False) -> Iterator[Count]:
    """Claims an empty folder for results; the value begins a progress bar, ending the last."""
    from drake_pose.files.folder import claimed

    with ExitStack() as bars, nullcontext() if out is None else claimed(out, resume):

        def count(what: str, total: int) -> Callable[[int], None]:
            bars.close()
            return bars.enter_context(count_progress(what, total))

        yield count


def _show(figures: Mapping[str, Any], shown: Sequence[RenderableType], json: bool) -> None:
    """Prints what came out."""
    if json:
        print_json(figures)
    else:
        output_console().print(*shown)
