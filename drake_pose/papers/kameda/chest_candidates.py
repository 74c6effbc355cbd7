"""What the lists' length K cuts off: where the true chest stands in its list of candidates.

The paper gives it as the cause of the silhouettes that are not matched (6.1, figure 12).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.papers.kameda.experiment import ExperimentResult, Trial
from drake_pose.search.estimates import View
from drake_pose.search.grid.families.search import samples_at
from drake_pose.search.kameda.search import PaperSearch
from drake_pose.search.scoring import Scoring
from drake_pose.silhouette.areas.scoring import draw_mask

CHEST = "chest"


def chest_ranks(result: ExperimentResult) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where the true chest stands in its list of candidates, the head where it truly is.

    Args:
        result: of the paper's search; its r and its order, but no K.

    Returns:
        By image the true chest's rank, from 1; 0: it is not in the list, as it leaves the
        silhouette by more than r. And the lists' lengths.
    """
    search = result.search
    assert isinstance(search, PaperSearch)
    chest = [node.name for node in search.tree.nodes].index(CHEST)
    ranks, lengths = [], []
    for trial in result.trials:
        true = samples_at(search.sampled, trial.true_values)
        assert true is not None, "drawn from the grid"
        order = _chest_list(search, trial, true, result.camera, chest)
        place = np.flatnonzero(order == true[chest])
        ranks.append(int(place[0]) + 1 if len(place) else 0)
        lengths.append(len(order))
    return np.array(ranks), np.array(lengths)


def share_within(ranks: NDArray[np.int64], lengths: Sequence[int]) -> list[float]:
    """The share of images whose true chest is among the first K, for every K given."""
    return [float(((ranks > 0) & (ranks <= K)).mean()) for K in lengths]


def _chest_list(
    search: PaperSearch, trial: Trial, true: NDArray[np.int64], camera: Camera, chest: int
) -> NDArray[np.int64]:
    """Steps 3 to 5 for the chest with all ancestors where they truly are: samples, best first."""
    sampled, settings = search.sampled, search.settings
    X_WN = search.tree.node_poses(trial.true_values)
    outlines = sampled.surfaces.at(trial.true_values)
    mask = draw_mask(outlines, camera.X_CW @ X_WN, camera)
    scoring = Scoring(sampled, [View(camera, mask)])
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
