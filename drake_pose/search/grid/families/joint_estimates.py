"""What poses of the grid say about each joint: determined, or free."""

from collections.abc import Sequence

import numpy as np

from drake_pose.search.estimates import JointEstimate
from drake_pose.search.scoring import SampledTree

_ROUNDING = 1e-6


def grid_steps(grid: np.ndarray) -> np.ndarray:
    """The spacing of each column (k,) of a node's grid (n, k); infinite where it has one value.

    A grid that is no product of its columns has the spacing of its nearest neighbours.
    """
    columns = [np.unique(np.round(column, 9)) for column in grid.T]
    if np.prod([len(column) for column in columns], initial=1.0) == len(grid):
        return np.array([np.diff(column).min(initial=np.inf) for column in columns])
    gaps = np.linalg.norm(grid[:, None] - grid[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    return np.full(grid.shape[1], float(np.median(gaps.min(axis=1))))


def estimate_joints(
    sampled: SampledTree,
    samples: Sequence[np.ndarray],
    about: Sequence[np.ndarray],
    *,
    complete: bool = True,
) -> tuple[JointEstimate, ...]:
    """Report each value of a tree.

    A value is determined if it spans no more than one step of its grid; half a step is then
    added on both sides, because the truth may lie between the grid's values.

    Args:
        samples: for each node (n,) those of its samples that occur.
        about: for each node the values (k,) of the answer; angles that turn around are given in
            the turn nearest to them.
        complete: whether these are all; else nothing is determined but what cannot move.

    Returns:
        One report for each value, node after node.
    """
    reports = []
    for i, node in enumerate(sampled.tree.nodes):
        lower, upper = sampled.tree.value_bounds(i)
        around = sampled.tree.turns_around(i)
        steps = grid_steps(sampled.values[i])
        for k, name in enumerate(node.value_names):
            values = np.unique(np.round(sampled.values[i][samples[i], k], 12))
            if around[k]:
                values = _joined(values, float(about[i][k]), float(steps[k]))
            known = complete or np.isinf(steps[k])
            determined = bool(known and np.ptp(values) <= steps[k] * (1.0 + _ROUNDING))
            margin = 0.5 * steps[k] if determined else 0.0
            low, high = float(values[0] - margin), float(values[-1] + margin)
            if not around[k]:
                low, high = max(low, float(lower[k])), min(high, float(upper[k]))
            reports.append(JointEstimate(name, i, determined, low, high, values, bool(around[k])))
    return tuple(reports)


def _joined(values: np.ndarray, about: float, step: float) -> np.ndarray:
    """Angles of one turn, rising from the widest gap between them."""
    full = 2.0 * np.pi
    gaps = np.diff(values, append=values[0] + full)
    widest = int(np.argmax(gaps))
    if len(values) == 1 or gaps[widest] <= step * (1.0 + _ROUNDING):
        return values
    first = (widest + 1) % len(values)
    risen = np.concatenate([values[first:], values[:first] + full])
    turns = np.round((about - 0.5 * (risen[0] + risen[-1])) / full)
    return np.asarray(risen + full * turns)
