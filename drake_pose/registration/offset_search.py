"""Search joint offsets together with a camera's pose, on one level of an image pyramid.

With joints off by 20 degrees no pose alone explains the pictures. Offsets are therefore searched
from base to tip: the base and the first links determine the pose roughly, and each further link its
own joint. Scores need no derivatives and no masks, so large errors do no harm.
"""

from collections.abc import Callable, Sequence

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.registration.pyramid_level import PyramidLevel


def search_offsets(
    level: PyramidLevel,
    poses: Callable[[Array], Array],
    X_CW: Array,
    start: Array,
    joints: Sequence[int],
    *,
    sweeps: int = 2,
    within: float = 0.45,
    steps: int = 11,
    evaluations: int = 300,
    first_step: float = 0.1,
    deviation: float = 0.2,
    weight: float = 0.002,
) -> tuple[Array, Array]:
    """Improve a camera's pose and joint offsets by their score.

    Each sweep scans each joint's offset, from base to tip, and then improves all unknowns together
    by Nelder and Mead's simplex search; the first sweep does so after each joint.

    Args:
        level: the pictures.
        poses: returns the nodes' poses (f, nodes, 4, 4) in the level's f pictures from offsets
            (m,) [rad or m].
        X_CW: (4, 4) the pose from which the search starts.
        start: (m,) the offsets from which it starts [rad or m].
        joints: indices of the offsets that are searched, from base to tip; all are angles.
        sweeps: number of sweeps; 0: one simplex search alone.
        within, steps: bound and number of the scanned offsets [rad].
        evaluations: maximum number of scores of a simplex search of all unknowns.
        first_step: size of the first simplex in rotation and offsets [rad].
        deviation, weight: standard deviation of an offset [rad], and by how much the score
            falls at that offset. A joint that hardly shows stays near 0.

    Returns the pose X_CW (4, 4), and the offsets (m,).
    """
    from scipy.optimize import minimize  # Slow to import, and seldom needed.

    offsets = start.copy()

    def score(X: Array, tried: Array) -> float:
        prior = weight * float(((tried / deviation) ** 2).sum())
        return level.with_poses(poses(tried)).score(X) - prior

    def improve(free: Sequence[int], most: int, size: float) -> float:
        """Improve the pose and some offsets from a first simplex, and return their score."""
        nonlocal X_CW, offsets
        about, at = X_CW, offsets
        columns = size * np.array([1.0, 1.0, 1.0, 0.4, 0.4, 0.6, *np.ones(len(free))])

        def place(x: Array) -> tuple[Array, Array]:
            turned = at.copy()
            turned[list(free)] += x[6:]
            return level.moved(about, x[:6]), np.clip(turned, -within, within)

        simplex = np.vstack([0.0 * columns, np.diag(columns)])
        options = {"maxfev": most, "initial_simplex": simplex, "xatol": 0.0, "fatol": 0.0}
        found = minimize(
            lambda x: -score(*place(x)), np.zeros(len(columns)), method="Nelder-Mead",
            options=options | {"adaptive": True},
        )  # fmt: skip
        X_CW, offsets = place(found.x)
        return -float(found.fun)

    best = score(X_CW, offsets)
    for sweep in range(sweeps):
        for k, joint in enumerate(joints):
            for value in np.linspace(-within, within, steps):
                tried = offsets.copy()
                tried[joint] = value
                if (found := score(X_CW, tried)) > best:
                    best, offsets = found, tried
            if sweep == 0:
                best = improve(joints[: k + 1], evaluations // 3, first_step)
        best = improve(joints, evaluations, first_step)
    improve(joints, evaluations, -0.5 * first_step)
    return X_CW, offsets


def joints_like_cameras(kinematics: TreeKinematics, values: Array, shown: Mask) -> tuple[str, ...]:
    """Return names of joints whose offset looks like a rotation of the camera about the robot.

    Such a joint, usually the first, moves all parts that move at all, about an axis that is fixed
    in the world. Only static parts then separate its offset from the camera's pose.

    ``kinematics``: of the body's pose tree. ``values``: (f, m) values in f frames [rad or m].
    ``shown``: (nodes,) which nodes are visible.
    """
    motions = [kinematics.motions(one) for one in values]
    count = len(kinematics.names)
    twists = np.array([one.twists[:count] for one in motions])
    still = np.ptp(twists, axis=0).max(axis=1) < 1e-6
    moves = motions[0].moves[shown][:, :count]
    # Nodes that no value moves between the frames are static.
    changing = np.ptp(values, axis=0) > 1e-3
    moving = moves[:, changing].any(axis=1)
    return tuple(
        name
        for k, name in enumerate(kinematics.names)
        if still[k] and moving.any() and moves[moving, k].all()
    )
