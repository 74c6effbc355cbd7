"""The command `drake-pose reproduce kameda`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_pose.apps.commands.estimate_options import JsonOption, PicturesOption
from drake_pose.apps.commands.terminal import (
    errors_as_messages,
    finite,
    print_json,
    say,
    usage_errors,
)
from drake_pose.apps.settings import EstimateSettings

if TYPE_CHECKING:
    from drake_pose.apps.experiments.kameda.continuous import ContinuousResult

# What is about the grid of angles, which continuous ones have none of.
_OF_GRID = ("method", "outside_limit", "candidates", "interval", "edges", "out")


ImagesOption = Annotated[int, typer.Option(min=1, help="Number of silhouettes.")]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of the random poses.")]
MethodOption = Annotated[
    str, typer.Option(help="paper: the paper's alone; beam: beam search beside it.")
]
AnglesOption = Annotated[
    str,
    typer.Option(
        help="grid: true angles and samples are multiples of 20 degrees, as in the paper; "
        "continuous: any true angles, and poses are refined between the samples."
    ),
]
OutsideLimitOption = Annotated[
    float,
    typer.Option(
        min=0.0,
        callback=finite,
        help=r"The paper's r: area of a segment that may lie outside \[pixel].",
        metavar="R",
    ),
]
CandidatesOption = Annotated[
    int,
    typer.Option(min=1, help="The paper's K: candidates kept for each segment.", metavar="K"),
]
IntervalOption = Annotated[
    float,
    typer.Option(min=1.0, max=90.0, callback=finite, help=r"Sampling interval \[deg]."),
]
ViewsOption = Annotated[
    int, typer.Option(min=1, help="With --angles continuous: number of cameras.")
]
MismatchOption = Annotated[
    bool,
    typer.Option(
        "--mismatch",
        help="With --angles continuous: also a body whose widths and joints differ from the "
        "model's.",
    ),
]
EdgesOption = Annotated[
    bool,
    typer.Option(
        "--edges",
        help="With --method beam: resolve ambiguous silhouettes by the edges inside them (some "
        "seconds for each).",
    ),
]


def kameda(
    context: typer.Context,
    images: ImagesOption = 219,
    seed: SeedOption = 0,
    method: MethodOption = "paper",
    angles: AnglesOption = "grid",
    outside_limit: OutsideLimitOption = 200.0,
    candidates: CandidatesOption = 5,
    interval: IntervalOption = 20.0,
    views: ViewsOption = 1,
    mismatch: MismatchOption = False,
    edges: EdgesOption = False,
    out: PicturesOption = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.KAMEDA."""
    with usage_errors():
        EstimateSettings(method=method)
    if angles not in ("grid", "continuous"):
        raise typer.BadParameter("must be grid or continuous", param_hint="--angles")
    if edges and method != "beam":
        raise typer.BadParameter("needs --method beam", param_hint="--edges")
    others = _OF_GRID if angles == "continuous" else ("views", "mismatch")
    for name in others:
        if str(getattr(context.get_parameter_source(name), "name", "")) == "COMMANDLINE":
            needed = "grid" if angles == "continuous" else "continuous"
            raise typer.BadParameter(
                f"needs --angles {needed}", param_hint=f"--{name.replace('_', '-')}"
            )
    if angles == "grid":
        with errors_as_messages():
            paper = (outside_limit, candidates)
            _run_on_grid(images, seed, method, interval, paper, edges, out, json)
        return
    with errors_as_messages():
        _print_continuous(_run_beside(images, seed, views, mismatch), json)


def _run_beside(images: int, seed: int, views: int, mismatch: bool) -> dict[str, ContinuousResult]:
    """Run the experiment, and with a mismatch a second time with another body; shows progress.

    Args:
        images, seed, views: as in ``run_continuous_experiment``.
        mismatch: whether to run the second.

    Returns:
        The figures, by what was in the pictures.
    """
    from drake_pose.apps.commands.report import count_progress
    from drake_pose.apps.experiments.kameda.continuous import (
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
    from drake_pose.apps.commands.report import output_console
    from drake_pose.apps.experiments.kameda.continuous import continuous_table

    if json:
        first, *others = (result.as_json() for result in results.values())
        print_json({**first, "another_body": others[0]} if others else first)
    else:
        output_console().print(continuous_table(results))


def _run_on_grid(
    images: int,
    seed: int,
    method: str,
    interval: float,
    paper: tuple[float, int],
    edges: bool,
    out: Path | None,
    json: bool,
) -> None:
    """Run the searches on a grid, the paper's with its r and K."""
    from drake_pose.apps.commands.report import count_progress, output_console
    from drake_pose.apps.experiments.kameda.experiment import (
        PAPER_IMAGES,
        beam_experiment_search,
        experiment_search,
        run_experiment,
    )
    from drake_pose.apps.experiments.kameda.inner_edges import edge_lines, settle_by_edges
    from drake_pose.apps.experiments.kameda.pictures import save_pictures
    from drake_pose.apps.experiments.kameda.table import experiment_table
    from drake_pose.apps.results.folder import require_empty

    if out is not None:
        require_empty(out)
    paper_images = images if method == "paper" else min(images, PAPER_IMAGES)
    with count_progress("silhouettes, the paper's method", paper_images) as advance:
        search = experiment_search(*paper, interval)
        results = [run_experiment(search, paper_images, seed, advance)]
    beside: dict[str, object] = {}
    if method == "beam":
        beside["paper_method"] = results[0].as_json()
        with count_progress("silhouettes, beam search", images) as advance:
            beam = beam_experiment_search(interval)
            results.append(run_experiment(beam, images, seed, advance))
    settled: dict[str, int] = {}
    if edges:
        with count_progress("silhouettes, edges", images) as advance:
            settled = settle_by_edges(results[-1], advance)
    if out is not None:
        save_pictures(results[-1], out)
    if json:
        print_json({**results[-1].as_json(), **settled, **beside})
        return
    output_console().print(experiment_table(results))
    if settled:
        say(edge_lines(settled))
