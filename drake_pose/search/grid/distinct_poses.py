"""The best poses of a search on the grid that do not look alike."""

import numpy as np

from drake_pose.search.grid.node_poses import Pictures
from drake_pose.search.scoring import Scoring

# How many times the poses asked for are looked at in one go, and scored in full.
_LOOKED_AT = 8
_SCORED = 2
# Of nodes: masks (n, nodes, W) uint64, areas (n, nodes), and what adds nothing (n, nodes) bool.
_Looks = tuple[np.ndarray, np.ndarray, np.ndarray]


def choose_distinct(
    scoring: Scoring, pictures: Pictures, samples: np.ndarray, count: int, alike: float
) -> np.ndarray:
    """The best poses (m, nodes), best first, of some (n, nodes), about the best first.

    No two look alike in pictures with bands: in each node so much of their union in common.
    """
    chosen = samples[:0]
    looks = _draw(pictures, chosen, scoring.sampled.poses(chosen))
    chunk, most = _LOOKED_AT * count, _SCORED * count
    for begin in range(0, len(samples), chunk):
        more = samples[begin : begin + chunk]
        drawn = _draw(pictures, more, scoring.sampled.poses(more))
        masks, areas, hidden = (np.concatenate(both) for both in zip(looks, drawn, strict=True))
        kept = _find_different((masks, areas, hidden), len(chosen), most, alike)
        chosen = np.concatenate([chosen, more])[kept]
        looks = masks[kept], areas[kept], hidden[kept]
        if len(chosen) >= most:
            break
    J = scoring.J(chosen)
    return np.asarray(chosen[np.argsort(J, kind="stable")[:count]])


def _draw(pictures: Pictures, samples: np.ndarray, X_WN: np.ndarray) -> _Looks:
    """What all nodes look like at samples (n, nodes) and poses (n, nodes, 4, 4)."""
    poses, nodes = X_WN.shape[:2]
    by_node = np.zeros((nodes, poses, int(pictures.part_starts[-1])), dtype=np.uint64)
    drawn = [
        pictures.draw_node(node, samples[:, node], X_WN[:, node], by_node[node])
        for node in range(nodes)
    ]
    masks, areas = by_node.swapaxes(0, 1), np.stack(drawn, axis=1)
    # What the others of its pose cover twice and once tells what a node alone adds.
    once, twice = np.zeros_like(masks[:, 0]), np.zeros_like(masks[:, 0])
    for node in range(nodes):
        twice |= once & masks[:, node]
        once |= masks[:, node]
    hidden = (areas[:, :, 2] == 0) & ~np.any(masks & ~twice[:, None], axis=2)
    return masks, areas.sum(axis=2), hidden


def _find_different(looks: _Looks, known: int, count: int, alike: float) -> np.ndarray:
    """The first poses that do not look like one before, (m,) int64, at most ``count``."""
    masks, areas, hidden = looks
    chosen = list(range(known))
    for i in range(known, len(masks)):
        if len(chosen) == count:
            break
        common = np.bitwise_count(masks[i] & masks[chosen]).sum(axis=2, dtype=np.int64)
        union = areas[i] + areas[chosen] - common
        same = (common >= alike * union) | (hidden[i] & hidden[chosen])
        if not same.all(axis=1).any():
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)
