"""Pictures of experiment A in the manner of the paper's figures 7 to 12, and of pose families."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from drake_pose.body.parsed_model import ParsedModel
from drake_pose.files.overlay import paint_agreement
from drake_pose.papers.kameda import Causes, ExperimentResult, Trial, experiment_camera
from drake_pose.papers.tables import draw_panels, save_figure
from drake_pose.search import PaperSearch, PoseFamily, PoseSet, Scoring, View, samples_at
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

_EXAMPLES, _SETS, _MOST_NAMES = 4, 3, 5
_MARGIN = 20
_BACKGROUND = (1.0, 1.0, 1.0)
_PANELS = (
    "true pose", "estimate", "silhouettes", "true pose from the side", "estimate from the side",
)  # fmt: skip
_COLOURS = "grey: agreement, blue: missing, orange: excess"
_KINDS: dict[str, tuple[str, Callable[[Trial], bool]]] = {
    "figure_07_exact_and_pose_right": (
        "silhouette matched exactly, every angle right (figure 7)",
        lambda trial: trial.pose_equal,
    ),
    "figure_08_hidden": (
        "silhouette matched exactly by another pose: a wrong segment is hidden (figure 8)",
        lambda trial: trial.causes is not None and trial.causes.hidden,
    ),
    "figure_09_inner_edges": (
        "silhouette matched exactly by another pose: edges inside it differ (figure 9)",
        lambda trial: trial.causes == Causes(hidden=False, inner_edges=True),
    ),
    "figure_10_improved_by_re_estimation": (
        "improved by re-estimation (figure 10)",
        lambda trial: trial.improved,
    ),
    "figure_12_not_matched": (
        "not matched exactly (figure 12)",
        lambda trial: trial.result.found and not trial.exact,
    ),
}


def save_pictures(result: ExperimentResult, folder: Path) -> list[Path]:
    """Draw examples of outcomes, the effort's histogram, poses as good; returns the PNG files."""
    figures = {}
    for name, (title, belongs) in _KINDS.items():
        trials = [trial for trial in result.trials if belongs(trial)][:_EXAMPLES]
        if trials:
            figures[name] = _draw_examples(title, trials, result)
    if isinstance(result.search, PaperSearch):
        runs = np.array([trial.result.statistics.runs for trial in result.trials])
        figures["figure_11_runs_of_step_3"] = _draw_histogram(runs, 100, "runs of step 3")
        K = result.search.settings.candidate_limit
        figures["figure_12_chest_candidates"] = _draw_chest_ranks(result, K)
    else:
        times = np.array([1e3 * trial.seconds for trial in result.trials])
        label = "processor time of the search [ms]"
        figures["figure_11_milliseconds"] = _draw_histogram(times, 200, label)
    files = [save_figure(figure, folder / f"{name}.png") for name, figure in figures.items()]
    several = [
        (trial, answer)
        for trial in result.trials
        if (answer := trial.result.pose_set) is not None and answer.family_count > 1
    ]
    for k, (trial, answer) in enumerate(several[:_SETS], start=1):
        path, model = folder / f"families_{k}.png", result.search.tree.model
        files.append(save_families(path, model, answer, [result.view(trial)]))
    return files


def _draw_examples(title: str, trials: list[Trial], result: ExperimentResult) -> Figure:
    """True poses and estimates as the camera sees them, their silhouettes, and the side."""
    tree = result.search.tree
    front, side = (
        LabelRenderer(tree.model, camera)
        for camera in (result.cameras[0], experiment_camera(0.5 * np.pi))
    )
    names = [node.name for node in tree.nodes]
    # Links without a surface would use up colours.
    order = [names.index(name) if name in names else 0 for name in front.link_names.values()]
    columns = []
    for trial in trials:
        both = tree.positions_from(trial.true_values)[0], trial.result.q
        true, found = _crop([front.segments(q) for q in both])
        aside = _crop([side.segments(q) for q in both])
        drawn = [_coloured(one, order) for one in (true, found, *aside)]
        drawn.insert(2, paint_agreement(true >= 0, found >= 0))
        columns.append(drawn)
    results = [trial.result for trial in trials]
    titles = [f"E_total {one.E_total:.2%}, {one.statistics.runs} runs" for one in results]
    return draw_panels(columns, titles, _PANELS, title=f"{title}\n{_COLOURS}")


def _coloured(segments: NDArray[Any], order: Sequence[int]) -> NDArray[np.float64]:
    """Segments (H, W), -1 for none, in colours (H, W, 3) by their places in an order."""
    colours = matplotlib.colormaps["tab20"](np.array(order) % 20)[:, :3]
    return np.where(segments[..., None] >= 0, colours[segments], _BACKGROUND)


def _crop(pictures: list[np.ndarray]) -> list[np.ndarray]:
    """Cut pictures of segments (H, W) to the square about what any of them shows."""
    rows, columns = np.nonzero(np.logical_or.reduce([picture >= 0 for picture in pictures]))
    side = _MARGIN + max(np.ptp(rows), np.ptp(columns))
    square = []
    for picture in pictures:
        framed = np.pad(picture, side, constant_values=-1)
        top = (rows.min() + rows.max() - side) // 2 + side
        left = (columns.min() + columns.max() - side) // 2 + side
        square.append(framed[top : top + side, left : left + side])
    return square


def _draw_histogram(values: np.ndarray, end: int, label: str) -> Figure:
    """How often values (n,) occur; what is beyond the end is counted there."""
    figure = Figure(figsize=(6, 4))
    axis = figure.subplots()
    axis.hist(np.minimum(values, end), bins=np.linspace(0, end, 21).tolist(), color="0.4")
    axis.set(xlabel=f"{label} ({end}: {end} or more)", ylabel="images")
    axis.set_title(f"{len(values)} images, mean {values.mean():.1f}, minimum {values.min():.0f}")
    return figure


def _draw_chest_ranks(result: ExperimentResult, limit: int) -> Figure:
    """In how many images the true chest is among the first K of its list, against K."""
    ranks, lengths = chest_ranks(result)
    Ks = range(1, max(2, int(lengths.max())) + 1)
    figure = Figure(figsize=(6, 4))
    axis = figure.subplots()
    axis.semilogx(Ks, [ratio_within(ranks, K) for K in Ks], color="0.2")
    axis.axvline(limit, color="0.6", linestyle="--", label=f"K = {limit}")
    axis.set(xlabel="K, candidates of the chest that are kept", ylim=(0.0, 1.03))
    axis.set_ylabel("images with the true chest among them")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    axis.legend(loc="lower right")
    axis.set_title(
        f"{len(ranks)} images, {np.median(lengths):.0f} candidates (median); "
        f"among the first {limit}: {ratio_within(ranks, limit):.0%}",
        fontsize=10,
    )
    return figure


def chest_ranks(result: ExperimentResult) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """By image the true chest's rank in its list of candidates, from 1, and the lists' lengths.

    The head is true; there is no K (6.1, figure 12). 0: the chest leaves the silhouette by over r.
    """
    search = result.search
    assert isinstance(search, PaperSearch)
    chest = [node.name for node in search.tree.nodes].index("chest")
    ranks, lengths = [], []
    for trial in result.trials:
        true = samples_at(search.sampled, trial.true_values)
        assert true is not None, "drawn from the grid"
        order = _chest_list(search, result.view(trial), trial, true, chest)
        place = np.flatnonzero(order == true[chest])
        ranks.append(int(place[0]) + 1 if len(place) else 0)
        lengths.append(len(order))
    return np.array(ranks), np.array(lengths)


def ratio_within(ranks: NDArray[np.int64], limit: int) -> float:
    """The ratio of images whose true chest is among the first of its list, up to a limit."""
    return float(((ranks > 0) & (ranks <= limit)).mean())


def _chest_list(
    search: PaperSearch, view: View, trial: Trial, true: NDArray[np.int64], chest: int
) -> NDArray[np.int64]:
    """Steps 3 to 5 for the chest with all ancestors where they truly are: samples, best first."""
    settings = search.settings
    X_WN = search.tree.node_poses(trial.true_values)
    scoring = Scoring(search.sampled, [view])
    done: list[int] = []
    parent = search.tree.nodes[chest].parent
    while parent >= 0:
        done.insert(0, parent)
        parent = search.tree.nodes[parent].parent
    uncovered = scoring.uncovered(done, true, X_WN)
    poses = scoring.candidate_poses(chest, X_WN[done[-1]])
    outside, covered = scoring.candidate_areas(chest, np.arange(len(poses)), poses, uncovered)
    inside = np.flatnonzero((outside <= (settings.outside_limit or 0.0)).all(axis=0))
    worth = covered[inside] - settings.outside_weight * outside[:, inside].sum(axis=0)
    return inside[np.argsort(-worth, kind="stable")]


def save_families(
    path: Path, model: ParsedModel, answer: PoseSet, views: Sequence[View], most: int = 6
) -> Path:
    """Draw the best families as columns of a PNG file: what the silhouettes leave open.

    Rows for every camera: the representative's segments, and where body and silhouette agree;
    below, the joints that are free in the family.
    """
    families = answer.families[:most]
    renderers = [LabelRenderer(model, view.camera) for view in views]
    columns, titles = [], []
    for family in families:
        column = []
        for view, renderer in zip(views, renderers, strict=True):
            segments = renderer.segments(family.q, family.X_WB)
            places = np.nonzero(view.mask | (segments >= 0))
            window = tuple(
                slice(max(0, one.min() - _MARGIN), one.max() + 1 + _MARGIN) for one in places
            )
            mask, segments = view.mask[window], segments[window]
            column.append(_coloured(segments, range(segments.max() + 2)))
            column.append(paint_agreement(mask, segments >= 0, segments))
        columns.append(column)
        poses = "1 pose" if family.size == 1 else f"{family.size:,.0f} poses"
        titles.append(f"J = {family.J:.0f} pixels, {poses}")
    found = "all found" if answer.complete else "the search left some out"
    title = (
        f"{len(families)} of {answer.family_count} families within {answer.tolerance:.0f} pixels "
        f"of the best ({found})\n{_COLOURS}"
    )
    below = [_free_names(family) for family in families]
    return save_figure(draw_panels(columns, titles, below=below, title=title), path)


def _free_names(family: PoseFamily) -> str:
    names = [joint.name for joint in family.joints if not joint.determined]
    if not names:
        return "every joint determined"
    more = len(names) - _MOST_NAMES
    return "\n".join(["free:", *names[:_MOST_NAMES], *([f"and {more} more"] if more > 0 else [])])
