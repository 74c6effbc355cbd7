"""Pictures of experiment A in the manner of the paper's figures 7 to 12."""

from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from drake_pose.papers.kameda.chest_candidates import chest_ranks, share_within
from drake_pose.papers.kameda.experiment import (
    ExperimentResult,
    Trial,
    side_camera,
)
from drake_pose.papers.kameda.family_pictures import save_families
from drake_pose.search.estimates import View
from drake_pose.search.kameda.search import PaperSearch
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

_EXAMPLES = 4
_SETS = 3
_MARGIN = 20
_BACKGROUND = (1.0, 1.0, 1.0)
_PANELS = (
    "true pose", "estimate", "silhouettes", "true pose from the side", "estimate from the side",
)  # fmt: skip

_KINDS: dict[str, tuple[str, Callable[[Trial], bool]]] = {
    "figure_07_exact_and_pose_right": (
        "silhouette matched exactly, every angle right (figure 7)",
        lambda trial: trial.pose_equal,
    ),
    "figure_08_09_exact_but_another_pose": (
        "silhouette matched exactly by another pose (figures 8 and 9)",
        lambda trial: trial.exact and not trial.pose_equal,
    ),
    "figure_10_improved_by_re_estimation": (
        "improved by re-estimation (figure 10)",
        lambda trial: trial.result.found and trial.result.E_total < trial.result.first_E_total,
    ),
    "figure_12_not_matched": (
        "not matched exactly (figure 12)",
        lambda trial: trial.result.found and not trial.exact,
    ),
}


def save_pictures(result: ExperimentResult, folder: Path) -> list[Path]:
    """Draw examples of each kind of outcome, a histogram of the effort, and poses as good.

    Args:
        result: the experiment.
        folder: where the PNG files go; made if it is not there.

    Returns:
        The files written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    renderers = [
        LabelRenderer(result.search.tree.model, camera) for camera in (result.camera, side_camera())
    ]
    files = []
    for name, (title, belongs) in _KINDS.items():
        trials = [trial for trial in result.trials if belongs(trial)][:_EXAMPLES]
        if trials:
            path = folder / f"{name}.png"
            files.append(_save_examples(path, title, trials, result, renderers))
    if isinstance(result.search, PaperSearch):
        runs = np.array([trial.result.statistics.runs for trial in result.trials])
        path = folder / "figure_11_runs_of_step_3.png"
        files.append(_save_histogram(path, runs, 100, "runs of step 3"))
        K = result.search.settings.candidate_limit
        return [*files, _save_chest_ranks(folder / "figure_12_chest_candidates.png", result, K)]
    milliseconds = np.array([1e3 * trial.seconds for trial in result.trials])
    path = folder / "figure_11_milliseconds.png"
    files.append(_save_histogram(path, milliseconds, 200, "processor time of the search [ms]"))
    return files + _save_sets(folder, result)


def _save_sets(folder: Path, result: ExperimentResult) -> list[Path]:
    """Draw poses that look the same, where there are several families of them."""
    files: list[Path] = []
    model = result.search.tree.model
    for trial in result.trials:
        answer = trial.result.pose_set
        if answer is not None and answer.family_count > 1 and len(files) < _SETS:
            X_CN = result.camera.X_CW @ result.search.tree.node_poses(trial.true_values)
            outlines = result.search.sampled.surfaces.at(trial.true_values)
            view = View(result.camera, draw_mask(outlines, X_CN, result.camera))
            path = folder / f"families_{len(files) + 1}.png"
            files.append(save_families(path, model, answer, [view]))
    return files


def _save_examples(
    path: Path,
    title: str,
    trials: list[Trial],
    result: ExperimentResult,
    renderers: list[LabelRenderer],
) -> Path:
    """Draw true poses and estimates as the camera sees them, their silhouettes, and the side."""
    tree = result.search.tree
    names = [node.name for node in tree.nodes]
    # Links without a surface would use up colours.
    order = [names.index(name) if name in names else 0 for name in renderers[0].link_names.values()]
    colours = matplotlib.colormaps["tab20"](np.array(order) % 20)[:, :3]
    figure = Figure(figsize=(3 * len(trials), 15))
    axes = figure.subplots(5, len(trials), squeeze=False)
    for column, trial in zip(axes.T, trials, strict=True):
        q_true, _ = tree.positions_from(trial.true_values)
        pictures, side = (
            _crop([renderer.segments(q) for q in (q_true, trial.result.q)])
            for renderer in renderers
        )
        for axis, segments in zip(column[[0, 1, 3, 4]], [*pictures, *side], strict=True):
            axis.imshow(np.where(segments[..., None] >= 0, colours[segments], _BACKGROUND))
        column[2].imshow(_compare(pictures[0] >= 0, pictures[1] >= 0))
        column[0].set_title(
            f"E_total {trial.E_total:.2%}, {trial.result.statistics.runs} runs", fontsize=9
        )
    for axis, label in zip(axes[:, 0], _PANELS, strict=True):
        axis.set_ylabel(label)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(f"{title}\ngrey: agreement, blue: missing, orange: excess", fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    return path


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


def _compare(true: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    picture = np.ones((*true.shape, 3))
    picture[true & estimate] = 0.6
    picture[true & ~estimate] = (0.0, 0.45, 0.70)
    picture[~true & estimate] = (0.90, 0.62, 0.0)
    return picture


def _save_chest_ranks(path: Path, result: ExperimentResult, limit: int) -> Path:
    """Draw in how many images the true chest is among the first K of its list, against K."""
    ranks, lengths = chest_ranks(result)
    Ks = np.arange(1, max(2, int(lengths.max())) + 1)
    figure = Figure(figsize=(6, 4))
    axis = figure.subplots()
    axis.semilogx(Ks, share_within(ranks, Ks.tolist()), color="0.2")
    axis.axvline(limit, color="0.6", linestyle="--", label=f"K = {limit}")
    axis.set_xlabel("K, candidates of the chest that are kept")
    axis.set_ylabel("images with the true chest among them")
    axis.set_ylim(0.0, 1.03)
    axis.xaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    axis.legend(loc="lower right")
    share = share_within(ranks, [limit])[0]
    axis.set_title(
        f"{len(ranks)} images, {np.median(lengths):.0f} candidates (median); "
        f"among the first {limit}: {share:.0%}",
        fontsize=10,
    )
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    return path


def _save_histogram(path: Path, values: np.ndarray, end: int, label: str) -> Path:
    """Draw how often values (n,) occur; what is beyond the end is counted there."""
    figure = Figure(figsize=(6, 4))
    axis = figure.subplots()
    axis.hist(np.minimum(values, end), bins=np.linspace(0, end, 21).tolist(), color="0.4")
    axis.set_xlabel(f"{label} ({end}: {end} or more)")
    axis.set_ylabel("images")
    title = f"{len(values)} images, mean {values.mean():.1f}, minimum {values.min():.0f}"
    axis.set_title(title)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    return path
