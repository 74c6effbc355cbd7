"""Nodes drawn as bits at poses of one's own choice, whole rows of a mask at once."""

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.search.grid.node_poses import Pictures
from drake_pose.search.grid.pair_kernel import unite_masks
from drake_pose.silhouette.bits.bit_kernel import draw_bits


def draw_node(
    pictures: Pictures, node: int, samples: np.ndarray, X_WN: np.ndarray, masks: np.ndarray
) -> np.ndarray:
    """Add a node's pictures to masks.

    Args:
        pictures: with bands.
        node: the node.
        samples: (n,) the samples it takes.
        X_WN: (n, 4, 4) its poses there.
        masks: (n, W) uint64, changed in place.

    Returns:
        (n, 3) int64 the areas in the silhouettes, in the bands and beyond, summed over the views.
    """
    starts, views = pictures.part_starts, len(pictures.views)
    total = np.zeros((len(X_WN), 3), dtype=np.int64)
    pairs = np.column_stack([np.arange(len(X_WN)), samples]).astype(np.int32)
    in_place = np.tile(np.eye(4), (len(pictures.body.sampled.values[node]), 1, 1))
    all_of_them = np.zeros(len(X_WN), dtype=np.bool_)
    for index, view in enumerate(pictures.bit_views):
        celled = pictures.body.celled_outline(node, pictures.views[index].camera, coarse=True)
        _, areas, runs, words = draw_bits(celled, view, X_WN, in_place, pairs, np.inf, all_of_them)
        runs[:, :, 0] += np.array([starts[index], starts[views + index]])
        _spread_runs(masks, runs, words)
        total += areas
    return total


@compiled
def _spread_runs(masks: np.ndarray, runs: np.ndarray, words: np.ndarray) -> None:
    """Write each row's runs (n, K, 3) into masks (n, W)."""
    for i in range(masks.shape[0]):
        unite_masks(masks[i], runs[i : i + 1], words)
