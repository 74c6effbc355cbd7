"""The command `drake-pose reproduce kameda`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from drake_pose.commands.options import SPREAD, Json, Pictures, within
from drake_pose.commands.terminal import (
    UsageError,
    count_progress,
    output_console,
    print_json,
    say,
    warn,
)

if TYPE_CHECKING:
    from drake_pose.papers.kameda.continuous import ContinuousResult
    from drake_pose.papers.kameda.experiment import ExperimentResult
    from drake_pose.search.scoring import PoseSearch

# What is about the grid of angles, which continuous ones have none of.
_OF_GRID = (
    "seeds", "method", "outside_limit", "outside_weight", "candidates", "interval", "edges",
    "edge_noise", "out",
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
    mismatch: bool | None = None
    """With --angles continuous: also a body whose widths and joints differ from the model's."""
    edges: bool | None = None
    """With --method beam: resolve ambiguous silhouettes by the edges inside them (some seconds for
    each)."""
    edge_noise: Annotated[float | None, within(0.0, 0.9)] = None
    """With --edges: this share of them is missing, the others are a pixel off, and a quarter as
    many are wrong. Default: 0."""
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
        _run_on_pictures(experiment, images, one.out, json)
        return
    if one.edges and one.method != "beam":
        raise UsageError("--edges needs --method beam")
    if one.edge_noise and not one.edges:
        raise UsageError("--edge-noise needs --edges")
    seed = one.seed or 0
    if one.angles == "continuous":
        _refuse(one, _OF_GRID, "--angles grid")
        results = _run_beside(images, seed, one.views or 1, bool(one.mismatch))
        _print_continuous(results, json)
        return
    _refuse(one, ("views", "mismatch"), "--angles continuous")
    runs = GridRuns(
        images, seed, one.seeds or 1, one.method or "paper", one.interval or 20.0,
        200.0 if one.outside_limit is None else one.outside_limit, one.candidates or 5,
        one.outside_weight or 0.0,
    )  # fmt: skip
    _run_on_grid(runs, (one.edge_noise or 0.0) if one.edges else None, one.out, json)


def _refuse(options: KamedaOptions, names: Sequence[str], needed: str) -> None:
    """Refuses options that were given and mean nothing here."""
    for name in names:
        if getattr(options, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} needs {needed}")


def _run_on_pictures(experiment: str, images: int, out: Path | None, json: bool) -> None:
    """Run both methods on the stored pictures, and print what they found; shows progress."""
    from drake_pose.papers.kameda.real_pictures import (
        METHODS,
        picture_names,
        real_table,
        run_real_experiment,
    )
    from drake_pose.results.folder import require_empty

    if out is not None:
        require_empty(out)
    frames = picture_names(experiment)[:images]
    results = []
    for method, name in METHODS.items():
        folder = None if out is None else out / method
        with count_progress(f"pictures, {name}", len(frames)) as advance:
            results.append(run_real_experiment(experiment, method, frames, folder, advance))
    for result in results:
        for text in result.warnings:
            warn(f"{METHODS[result.method]}: {text}")
    if json:
        paper, ours = (result.as_json() for result in results)
        print_json({**ours, "paper_method": paper})
    else:
        output_console().print(real_table(results))


def _run_beside(images: int, seed: int, views: int, mismatch: bool) -> dict[str, ContinuousResult]:
    """Run the experiment, and with a mismatch a second time with another body; shows progress.

    Args:
        images, seed, views: as in ``run_continuous_experiment``.
        mismatch: whether to run the second.

    Returns:
        The figures, by what was in the pictures.
    """
    from drake_pose.papers.kameda.continuous import (
        continuous_search,
        run_continuous_experiment,
    )

    search = continuous_search()
    results = {}
    for heading, other in {"the model itself": False, "another body": True}.items():
        if mismatch or not other:
            with count_progress(f"silhouettes of {heading}", images) as advance:
                results[heading] = run_continuous_experiment(
                    search, images, seed, views, other, advance
                )
    return results


def _print_continuous(results: Mapping[str, ContinuousResult], json: bool) -> None:
    """Print the figures of ``_run_beside`` as a table or as JSON."""
    from drake_pose.papers.kameda.continuous import continuous_table

    if json:
        first, *others = (result.as_json() for result in results.values())
        print_json({**first, "another_body": others[0]} if others else first)
    else:
        output_console().print(continuous_table(results))


def _run_on_grid(runs: GridRuns, edges: float | None, out: Path | None, json: bool) -> None:
    """Run the searches on a grid and print or draw what they found.

    edges: the noise of the edges inside the silhouettes; None: they are not used.
    """
    from drake_pose.papers.kameda.inner_edges import edge_lines, settle_by_edges
    from drake_pose.papers.kameda.pictures import save_pictures
    from drake_pose.papers.kameda.table import experiment_table
    from drake_pose.results.folder import require_empty

    if out is not None:
        require_empty(out)
    columns = runs.run()
    leading = columns[-1][0]
    settled: dict[str, int] = {}
    if edges is not None:
        with count_progress("silhouettes, edges", runs.images) as advance:
            settled = settle_by_edges(leading, advance, edges)
    if out is not None:
        save_pictures(leading, out)
    if json:
        print_json({**_figures(columns[-1]), **settled, **_beside(columns[:-1])})
        return
    output_console().print(experiment_table(columns))
    if settled:
        say(edge_lines(settled))


def _figures(results: Sequence[ExperimentResult]) -> dict[str, object]:
    """The figures of the first seed, and of several the spread."""
    from drake_pose.papers.kameda.table import spread_over_seeds

    figures: dict[str, object] = dict(results[0].as_json())
    return {**figures, "spread": spread_over_seeds(results)} if len(results) > 1 else figures


def _beside(columns: Sequence[Sequence[ExperimentResult]]) -> dict[str, object]:
    """The figures of the searches beside the one that was asked for."""
    names = ("paper_method", "outside_weight_method")
    return {name: _figures(column) for name, column in zip(names, columns, strict=False)}


@dataclass(frozen=True)
class GridRuns:
    """What is run on the grid of angles: every search with every seed.

    Args:
        images: silhouettes for each seed.
        seed: the first.
        seeds: how many.
        method: "paper", or "beam" for the beam search as well.
        interval: [deg].
        outside_limit: the paper's r [pixel].
        candidates: the paper's K.
        outside_weight: above 0 the paper's method is run once more with it.
    """

    images: int
    seed: int
    seeds: int
    method: str
    interval: float
    outside_limit: float
    candidates: int
    outside_weight: float

    def run(self) -> list[list[ExperimentResult]]:
        """The runs of each search, the one that was asked for last; shows progress."""
        from drake_pose.papers.kameda import experiment

        paper = (self.outside_limit, self.candidates, self.interval)
        searches = {"the paper's method": experiment.experiment_search(*paper)}
        if self.outside_weight > 0.0:
            weighted = experiment.experiment_search(*paper, self.outside_weight)
            searches[f"outside weight {self.outside_weight:g}"] = weighted
        images = self.images
        if self.method == "beam":
            images = min(images, experiment.PAPER_IMAGES)
        columns = [self._run_seeds(name, one, images) for name, one in searches.items()]
        if self.method == "beam":
            beam = experiment.beam_experiment_search(self.interval)
            columns.append(self._run_seeds("beam search", beam, self.images))
        return columns

    def _run_seeds(self, name: str, search: PoseSearch, images: int) -> list[ExperimentResult]:
        from drake_pose.papers.kameda.experiment import run_experiment

        results: list[ExperimentResult] = []
        with count_progress(f"silhouettes, {name}", images * self.seeds) as advance:
            for seed in range(self.seed, self.seed + self.seeds):
                before = len(results) * images

                def count(done: int, before: int = before) -> None:
                    advance(before + done)

                results.append(run_experiment(search, images, seed, count))
        return results
