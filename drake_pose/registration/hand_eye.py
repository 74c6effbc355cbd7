"""Where a camera is on a robot's hand, and an object in the world, from the object's poses.

Each picture gives some poses of the object in the camera, one of which is about right. Of two
pictures the hand's motion A and the object's B in the camera go with A X = X B, where X is the
camera's pose on the hand: both turn by the same angle, and A's axis is B's, turned by X (Park and
Martin 1994). Three pictures whose motions turn about two axes tell X.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_pose.body.tree.joint_map import inverse_transforms

Array = NDArray[np.float64]

# The angles by which hand and object turn differ by no more [rad].
_SAME_ANGLE = np.radians(20.0)
# So many threes of pictures are looked at, and of each so many of the object's poses.
_THREES, _MOST_OF_ONE = 24, 500


class HandEye(NamedTuple):
    """Cameras on a hand, and where an object stands.

    X_LC: (n, 4, 4) the cameras' poses in the hand's frame; X_WT: (n, 4, 4) the object's.
    """

    X_LC: Array
    X_WT: Array


def turns_between(R_WL: Array) -> Array:
    """(3,) how far a hand turns about its three main axes, from picture to picture [rad].

    Root mean squares of the turns between all pairs of its rotations R_WL (n, 3, 3), the largest
    first. Where the second one is 0 the hand turns about one axis alone.
    """
    pairs = list(combinations(range(len(R_WL)), 2))
    if not pairs:
        return np.zeros(3)
    i, j = np.array(pairs).T
    turns = Rotation.from_matrix(np.swapaxes(R_WL[i], 1, 2) @ R_WL[j]).as_rotvec()
    spread = np.sqrt(np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1].clip(min=0.0))
    return np.asarray(spread)


def hand_eye_starts(X_WL: Array, X_CT: Sequence[Array], turns: Array, seed: int = 0) -> HandEye:
    """What three pictures each say, those that turn the hand most first.

    Args:
        X_WL: (frames, 4, 4) the hand's poses.
        X_CT: for each frame (k, 4, 4) poses of the object in the camera, one of them about right.
        turns: (t, 4, 4) motions in the object's frame after which it looks alike.
        seed: of the draw of threes, where there are many.
    """
    threes = list(combinations(range(len(X_WL)), 3))
    if len(threes) > _THREES:
        drawn = np.random.default_rng(seed).permutation(len(threes))
        # Threes of which nothing is told are drawn too often otherwise.
        threes = [threes[k] for k in drawn[: 4 * _THREES]]
    told = [turns_between(X_WL[list(three), :3, :3])[1] for three in threes]
    chosen = [threes[k] for k in np.argsort(told)[::-1][:_THREES]]
    turned = [(one[:, None] @ turns).reshape(-1, 4, 4) for one in X_CT]
    # The object's frame is as it is in the first one, however it looks.
    found = [_of_three(X_WL[[i, j, k]], (X_CT[i], turned[j], turned[k])) for i, j, k in chosen]
    return HandEye(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _of_three(X_WL: Array, X_CT: Sequence[Array]) -> HandEye:
    """What three pictures say: for those of the object's poses that turn as the hand does."""
    pairs = ((0, 1), (0, 2), (1, 2))
    A = np.array([np.linalg.inv(X_WL[j]) @ X_WL[i] for i, j in pairs])
    a = Rotation.from_matrix(A[:, :3, :3]).as_rotvec()
    offs = [
        np.abs(_angles(X_CT[i], X_CT[j]) - angle)
        for (i, j), angle in zip(pairs, np.linalg.norm(a, axis=1), strict=True)
    ]
    off = np.maximum(np.maximum(offs[0][:, :, None], offs[1][:, None]), offs[2][None])
    kept = np.argsort(off, axis=None)[: min(_MOST_OF_ONE, np.count_nonzero(off <= _SAME_ANGLE))]
    rows = np.unravel_index(kept, off.shape)
    poses = np.stack([one[row] for one, row in zip(X_CT, rows, strict=True)], axis=1)
    B = np.stack([poses[:, j] @ inverse_transforms(poses[:, i]) for i, j in pairs], axis=1)
    b = Rotation.from_matrix(B[:, :, :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 3, 3)
    # Rotations R with a = R b in least squares.
    R_LC = _nearest_rotations(np.einsum("pi,npj->nij", a, b))
    M = np.broadcast_to((A[:, :3, :3] - np.eye(3)).reshape(9, 3), (len(kept), 9, 3))
    t = (np.einsum("nij,npj->npi", R_LC, B[:, :, :3, 3]) - A[:, :3, 3]).reshape(-1, 9)
    X_LC = np.tile(np.eye(4), (len(kept), 1, 1))
    X_LC[:, :3, :3] = R_LC
    X_LC[:, :3, 3] = np.einsum("nij,nj->ni", np.linalg.pinv(M, rcond=1e-3), t)
    return HandEye(X_LC, _mean_poses(X_WL @ X_LC[:, None] @ poses))


def _angles(X: Array, others: Array) -> Array:
    """(n, m) by how much poses (n, 4, 4) are turned from others (m, 4, 4) [rad]."""
    traces = np.einsum("nij,mij->nm", X[:, :3, :3], others[:, :3, :3])
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))


def _mean_poses(X: Array) -> Array:
    """(n, 4, 4) the means of poses (n, k, 4, 4): places, and rotations nearest to the mean's."""
    mean = X.mean(axis=1)
    mean[:, :3, :3] = _nearest_rotations(mean[:, :3, :3])
    return np.asarray(mean)


def _nearest_rotations(M: Array) -> Array:
    """(n, 3, 3) the rotations nearest to matrices (n, 3, 3)."""
    U, _, V = np.linalg.svd(M)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ V))[:, None]
    return np.asarray(U @ V)
