"""Pictures of experiment A, as the paper's figures 7 to 12, and of modes of poses."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from drake_pose.body import ParsedModel
from drake_pose.files.overlay import paint_agreement
from drake_pose.papers.kameda import Causes, RandomPose, RandomPoses, experiment_camera
from drake_pose.papers.tables import draw_panels, save_figure
from drake_pose.search import PaperSearch, PoseSet, Scoring, View, samples_at
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

_COLOURS = "grey: agreement, blue: missing, orange: excess"


def save_pictures(
    result: RandomPoses, folder: Path, examples: int = 4, most_sets: int = 3
) -> list[Path]:
    """Draw examples of each outcome, a histogram of the effort, and sets of equally good poses.

    Args:
        result: a run of experiment A.
        folder: where the files are written.
        examples: largest number of poses per outcome.
        most_sets: largest number of pose sets.

    Returns the PNG files.
    """
    matched = "silhouette matched exactly"
    kinds: dict[str, tuple[str, Callable[[RandomPose], bool]]] = {
        "figure_07_exact_and_pose_right": (
            f"{matched}, every angle right (figure 7)",
            lambda trial: trial.pose_equal,
        ),
        "figure_08_hidden": (
            f"{matched} by another pose: a wrong segment is hidden (figure 8)",
            lambda trial: trial.causes is not None and trial.causes.hidden,
        ),
        "figure_09_inner_edges": (
            f"{matched} by another pose: edges inside it differ (figure 9)",
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
    figures = {}
    for name, (title, is_kind) in kinds.items():
        trials = [trial for trial in result.trials if is_kind(trial)][:examples]
        if trials:
            figures[name] = _draw_examples(title, trials, result)
    if isinstance(result.search, PaperSearch):
        runs = np.array([trial.result.runs for trial in result.trials])
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
        if (answer := trial.result.pose_set) is not None and answer.mode_count > 1
    ]
    for k, (trial, answer) in enumerate(several[:most_sets], start=1):
        path, model = folder / f"modes_{k}.png", result.search.tree.model
        files.append(save_modes(path, model, answer, [result.view(trial)]))
    return files


def _draw_examples(title: str, trials: list[RandomPose], result: RandomPoses) -> Figure:
    """Draw trials of a run, true and estimated, from camera and side; between them agreement."""
    tree = result.search.tree
    front, side = (
        LabelRenderer(tree.model, camera)
        for camera in (result.cameras[0], experiment_camera(0.5 * np.pi))
    )
    names = [node.name for node in tree.nodes]
    # Segments are coloured by node, because links without a surface would use up colours.
    order = [names.index(name) if name in names else 0 for name in front.link_names.values()]
    columns = []
    for trial in trials:
        both = tree.positions_from(trial.true_values)[0], trial.result.q
        true, found = _crop([front.segments(q) for q in both])
        from_side = _crop([side.segments(q) for q in both])
        drawn = [_coloured(one, order) for one in (true, found, *from_side)]
        drawn.insert(2, paint_agreement(true >= 0, found >= 0))
        columns.append(drawn)
    results = [trial.result for trial in trials]
    titles = [f"E_total {one.E_total:.2%}, {one.runs} runs" for one in results]
    labels = ["true pose", "estimate", "silhouettes"]
    labels += [f"{label} from the side" for label in labels[:2]]
    return draw_panels(columns, titles, labels, title=f"{title}\n{_COLOURS}")


def _coloured(segments: NDArray[Any], order: Sequence[int]) -> NDArray[np.float64]:
    """Return the picture (H, W, 3) of segments (H, W): i in colour number order[i], -1 white."""
    colours = matplotlib.colormaps["tab20"](np.array(order) % 20)[:, :3]
    return np.where(segments[..., None] >= 0, colours[segments], 1.0)


def _crop(pictures: list[np.ndarray], margin: int = 20) -> list[np.ndarray]:
    """Cut segments (H, W), -1 for none, to a square around all they show, plus `margin` [pixel]."""
    rows, columns = np.nonzero(np.logical_or.reduce([picture >= 0 for picture in pictures]))
    side = margin + max(np.ptp(rows), np.ptp(columns))
    square = []
    for picture in pictures:
        framed = np.pad(picture, side, constant_values=-1)
        top = (rows.min() + rows.max() - side) // 2 + side
        left = (columns.min() + columns.max() - side) // 2 + side
        square.append(framed[top : top + side, left : left + side])
    return square


def _draw_histogram(values: np.ndarray, end: int, label: str) -> Figure:
    """Draw a histogram of values (n,), named by `label`; its last bin counts those over `end`."""
    figure = Figure(figsize=(6, 4))
    axis = figure.subplots()
    axis.hist(np.minimum(values, end), bins=np.linspace(0, end, 21).tolist(), color="0.4")
    axis.set(xlabel=f"{label} ({end}: {end} or more)", ylabel="images")
    axis.set_title(f"{len(values)} images, mean {values.mean():.1f}, minimum {values.min():.0f}")
    return figure


def _draw_chest_ranks(result: RandomPoses, limit: int) -> Figure:
    """Draw the fraction of images with the true chest in the first K, over K; `limit` is marked."""
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


def chest_ranks(result: RandomPoses) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rank of the true chest among the chest's candidates, and the candidates' number.

    Both are (images,). The head is at its true pose, and K is unlimited (6.1, figure 12). Ranks
    count from 1; 0: the true chest leaves the silhouette by more than r. `result` must be of the
    paper's search.
    """
    search = result.search
    assert isinstance(search, PaperSearch)
    nodes, limit = search.tree.nodes, search.settings.outside_limit or 0.0
    chest = [node.name for node in nodes].index("chest")
    ancestors: list[int] = []
    parent = nodes[chest].parent
    while parent >= 0:
        ancestors.insert(0, parent)
        parent = nodes[parent].parent
    ranks, lengths = [], []
    for trial in result.trials:
        true = samples_at(search.sampled, trial.true_values)
        assert true is not None, "drawn from the grid"
        # Steps 3 to 5 of section 5.1 for the chest.
        X_WN = search.tree.node_poses(trial.true_values)
        scoring = Scoring(search.sampled, [result.view(trial)])
        uncovered = scoring.uncovered(ancestors, true, X_WN)
        poses = scoring.candidate_poses(chest, X_WN[ancestors[-1]])
        outside, covered = scoring.candidate_areas(chest, np.arange(len(poses)), poses, uncovered)
        inside = np.flatnonzero((outside <= limit).all(axis=0))
        order = inside[np.argsort(-covered[inside], kind="stable")]
        place = np.flatnonzero(order == true[chest])
        ranks.append(int(place[0]) + 1 if len(place) else 0)
        lengths.append(len(order))
    return np.array(ranks), np.array(lengths)


def ratio_within(ranks: NDArray[np.int64], limit: int) -> float:
    """Return the fraction of images whose `chest_ranks` (images,) are from 1 to `limit`."""
    return float(((ranks > 0) & (ranks <= limit)).mean())


def save_modes(
    path: Path,
    model: ParsedModel,
    answer: PoseSet,
    views: Sequence[View],
    most: int = 6,
    margin: int = 20,
    most_names: int = 5,
) -> Path:
    """Draw the best modes of a pose set as columns of a PNG file.

    For each camera: the segments of the mode's representative, and where body and silhouette agree.
    Below: the joints that are free in the mode.

    Args:
        path: of the PNG file, which is returned.
        model: body of the poses.
        answer: pose set with one mode or more.
        views: cameras and their silhouettes.
        most: largest number of modes.
        margin: around the body [pixel].
        most_names: largest number of joints named below a mode.
    """
    modes = answer.modes[:most]
    renderers = [LabelRenderer(model, view.camera) for view in views]
    columns, titles = [], []
    for mode in modes:
        column = []
        for view, renderer in zip(views, renderers, strict=True):
            segments = renderer.segments(mode.q, mode.X_WB)
            places = np.nonzero(view.mask | (segments >= 0))
            window = tuple(
                slice(max(0, one.min() - margin), one.max() + 1 + margin) for one in places
            )
            mask, segments = view.mask[window], segments[window]
            column.append(_coloured(segments, range(segments.max() + 2)))
            column.append(paint_agreement(mask, segments >= 0, segments))
        columns.append(column)
        poses = "1 pose" if mode.size == 1 else f"{mode.size:,.0f} poses"
        titles.append(f"J = {mode.J:.0f} pixels, {poses}")
    found = "all found" if answer.complete else "the search left some out"
    title = (
        f"{len(modes)} of {answer.mode_count} modes within {answer.tolerance:.0f} pixels "
        f"of the best ({found})\n{_COLOURS}"
    )
    below = []
    for mode in modes:
        names = [joint.name for joint in mode.joints if not joint.determined]
        more = len(names) - most_names
        lines = ["free:", *names[:most_names], *([f"and {more} more"] if more > 0 else [])]
        below.append("\n".join(lines) if names else "every joint determined")
    return save_figure(draw_panels(columns, titles, below=below, title=title), path)
