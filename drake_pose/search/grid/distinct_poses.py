"""The best poses of a search on the grid that do not look alike."""

from dataclasses import dataclass

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.search.grid.node_poses import Pictures
from drake_pose.search.scoring import Scoring

# How many times the poses asked for are looked at in one go, and scored in full.
_LOOKED_AT = 8
_SCORED = 2
# Of nodes: masks (n, nodes, W) uint64, areas (n, nodes), and what adds nothing (n, nodes) bool.
_Looks = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class GridPoses:
    """Whole poses on the sampling grid, smallest J first; no two of them look alike.

    Args:
        samples: (m, nodes) int, the index of each node's sample in its grid.
        X_WN: (m, nodes, 4, 4).
        J: (m,) the objective (1) [pixel].
        area: the silhouettes' area [pixel].
    """

    samples: np.ndarray
    node_values: tuple[tuple[np.ndarray, ...], ...]
    X_WN: np.ndarray
    J: np.ndarray
    area: float

    def __len__(self) -> int:
        return len(self.J)


def check_choice(count: int, alike: float) -> None:
    """Raises SettingsError if count is below 1 or alike is not positive."""
    if count < 1:
        raise SettingsError(f"count must be 1 or more, not {count}")
    if not alike > 0.0:
        raise SettingsError(f"alike must be positive, not {alike}")


class Gathering:
    """Collects the poses that a search comes by."""

    def __init__(self) -> None:
        self._samples: list[np.ndarray] = []
        self._errors: list[np.ndarray] = []

    def add(self, samples: np.ndarray, errors: np.ndarray) -> None:
        """Take in the samples (n, nodes) of poses, and about their E_total (n,)."""
        self._samples.append(np.asarray(samples))
        self._errors.append(np.asarray(errors, dtype=np.float64))

    def choose(self, scoring: Scoring, pictures: Pictures, count: int, alike: float) -> GridPoses:
        """The best poses that do not look alike in pictures with bands, ``count`` at most."""
        nodes = len(scoring.sampled.values)
        samples = self._different_samples(nodes)
        chosen = np.empty((0, nodes), dtype=samples.dtype)
        looks = _draw(pictures, chosen, scoring.sampled.poses(chosen))
        chunk = _LOOKED_AT * count
        for begin in range(0, len(samples), chunk):
            more = samples[begin : begin + chunk]
            drawn = _draw(pictures, more, scoring.sampled.poses(more))
            masks, areas, hidden = (np.concatenate(both) for both in zip(looks, drawn, strict=True))
            kept = _find_different((masks, areas, hidden), len(chosen), _SCORED * count, alike)
            chosen = np.concatenate([chosen, more])[kept]
            looks = masks[kept], areas[kept], hidden[kept]
            if len(chosen) >= _SCORED * count:
                break
        X_WN = scoring.sampled.poses(chosen)
        J = scoring.J(X_WN, chosen)
        best = np.argsort(J, kind="stable")[:count]
        return GridPoses(
            samples=chosen[best],
            node_values=tuple(tuple(scoring.sampled.values_at(pose)) for pose in chosen[best]),
            X_WN=X_WN[best],
            J=J[best],
            area=scoring.silhouette_area,
        )

    def _different_samples(self, nodes: int) -> np.ndarray:
        """All poses, each once, (n, nodes), the smallest errors first."""
        if not self._samples:
            return np.empty((0, nodes), dtype=np.int32)
        samples, errors = np.concatenate(self._samples), np.concatenate(self._errors)
        samples = samples[np.argsort(errors, kind="stable")]
        first = np.unique(samples, axis=0, return_index=True)[1]
        return np.asarray(samples[np.sort(first)])


def _draw(pictures: Pictures, samples: np.ndarray, X_WN: np.ndarray) -> _Looks:
    """What all nodes look like at samples (n, nodes) and poses (n, nodes, 4, 4)."""
    poses, nodes = X_WN.shape[:2]
    by_node = np.zeros((nodes, poses, int(pictures.part_starts[-1])), dtype=np.uint64)
    drawn = [
        pictures.draw_node(node, samples[:, node], X_WN[:, node], by_node[node])
        for node in range(nodes)
    ]
    masks, areas = by_node.swapaxes(0, 1), np.stack(drawn, axis=1)
    return masks, areas.sum(axis=2), _find_hidden(masks, areas[:, :, 2])


def _find_hidden(masks: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Which nodes (n, nodes) bool add nothing to what the others of their pose cover."""
    once, twice = np.zeros_like(masks[:, 0]), np.zeros_like(masks[:, 0])
    for node in range(masks.shape[1]):
        twice |= once & masks[:, node]
        once |= masks[:, node]
    return (far == 0) & ~np.any(masks & ~twice[:, None], axis=2)


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
