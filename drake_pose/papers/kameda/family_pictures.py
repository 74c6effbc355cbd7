"""Pictures of pose families side by side: what the silhouettes leave open."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_pose.body.parsed_model import ParsedModel
from drake_pose.results.overlay import paint_agreement
from drake_pose.search.estimates import PoseFamily, PoseSet, View
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

_MARGIN = 20
_MOST_NAMES = 5
_BACKGROUND = (1.0, 1.0, 1.0)


def save_families(
    path: Path, model: ParsedModel, answer: PoseSet, views: Sequence[View], most: int = 6
) -> Path:
    """Draw the families side by side, a column each.

    For every camera the first row shows the segments of the family's representative in colours,
    the second where its body and the silhouette agree. Below stand the joints that are free in
    the family.

    Args:
        path: the PNG file.
        model: the model.
        answer: the families.
        views: the silhouettes.
        most: how many families are drawn, the best first.

    Returns:
        The file written.
    """
    families = answer.families[:most]
    renderers = [LabelRenderer(model, view.camera) for view in views]
    size = (3.2 * len(families), 3.2 * 2 * len(views) + 1.4)
    figure = Figure(figsize=size)
    axes = figure.subplots(2 * len(views), len(families), squeeze=False)
    for column, family in zip(axes.T, families, strict=True):
        for i, (view, renderer) in enumerate(zip(views, renderers, strict=True)):
            segments = renderer.segments(family.q, family.X_WB)
            _show(column[2 * i], column[2 * i + 1], view.mask, segments)
        column[0].set_title(_title(family), fontsize=9)
        column[-1].set_xlabel(_free_names(family), fontsize=8)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(_heading(answer, len(families)), fontsize=10)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    return path


def _show(coloured: Axes, compared: Axes, mask: np.ndarray, segments: np.ndarray) -> None:
    """Fill the two panels of one family in one view."""
    rows, columns = np.nonzero(mask | (segments >= 0))
    window = (
        slice(max(0, rows.min() - _MARGIN), rows.max() + 1 + _MARGIN),
        slice(max(0, columns.min() - _MARGIN), columns.max() + 1 + _MARGIN),
    )
    mask, segments = mask[window], segments[window]
    colours = matplotlib.colormaps["tab20"](np.arange(segments.max() + 2) % 20)[:, :3]
    coloured.imshow(np.where(segments[..., None] >= 0, colours[segments], _BACKGROUND))
    compared.imshow(paint_agreement(mask, segments >= 0, segments))


def _title(family: PoseFamily) -> str:
    poses = "1 pose" if family.size == 1 else f"{family.size:,.0f} poses"
    return f"J = {family.J:.0f} pixels, {poses}"


def _free_names(family: PoseFamily) -> str:
    names = [joint.name for joint in family.joints if not joint.determined]
    if not names:
        return "every joint determined"
    more = len(names) - _MOST_NAMES
    shown = names[:_MOST_NAMES] + ([f"and {more} more"] if more > 0 else [])
    return "free:\n" + "\n".join(shown)


def _heading(answer: PoseSet, shown: int) -> str:
    found = "all found" if answer.complete else "the search left some out"
    return (
        f"{shown} of {answer.family_count} families within {answer.tolerance:.0f} pixels of the "
        f"best ({found})\ngrey: agreement, blue: missing, orange: excess"
    )
