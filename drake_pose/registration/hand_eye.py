"""Closed-form hand-eye starts: A X_LC = X_LC B from the poses of a link and a target.

With link L, camera C, target T and world W, X_WL X_LC X_CT = X_WT is the same in every frame. Two
frames i, j give A = X_WLj^-1 X_WLi and B = X_CTj X_CTi^-1.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body import inverse_transforms


def rotation_spread(R_WL: Array) -> Array:
    """Return how far a link rotates about its three principal axes [rad], descending.

    These are root mean squares over all pairs of the rotations R_WL (n, 3, 3). If the second value
    is 0, the link rotates about one axis only, and the hand-eye pose is not observable.
    """
    pairs = list(combinations(range(len(R_WL)), 2))
    if not pairs:
        return np.zeros(3)
    i, j = np.array(pairs).T
    turns = Rotation.from_matrix(np.swapaxes(R_WL[i], 1, 2) @ R_WL[j]).as_rotvec()
    by_axis = np.sqrt(np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1].clip(min=0.0))
    return np.asarray(by_axis)


def hand_eye_starts(X_WL: Array, X_CT: Sequence[Array], turns: Array, triples: int = 24) -> Array:
    """Return pairs of X_LC and X_WT (n, 2, 4, 4) from triples of frames.

    The triple with the largest rotation of the link comes first. There may be no pair (n = 0).

    Args:
        X_WL: (frames, 4, 4) the link's poses, of three frames or more.
        X_CT: for each frame (k, 4, 4) candidate poses of the target in the camera; k may vary.
        turns: (t, 4, 4) motions in frame T that leave the target's shape unchanged, with the
            identity.
        triples: maximum number of triples. Among four times as many random ones, those with the
            largest rotation about a second axis are used.
    """
    threes = list(combinations(range(len(X_WL)), 3))
    if len(threes) > triples:
        drawn = np.random.default_rng(0).permutation(len(threes))
        # Random triples include many without rotation; the best quarter is kept.
        threes = [threes[k] for k in drawn[: 4 * triples]]
    rotation = [rotation_spread(X_WL[list(three), :3, :3])[1] for three in threes]
    chosen = [threes[k] for k in np.argsort(rotation)[::-1][:triples]]
    turned = [(one[:, None] @ turns).reshape(-1, 4, 4) for one in X_CT]
    # The first frame's candidates fix which of the symmetric poses is called X_WT.
    found = [_of_three(X_WL[[i, j, k]], (X_CT[i], turned[j], turned[k])) for i, j, k in chosen]
    return np.concatenate(found)


def _of_three(
    X_WL: Array, X_CT: Sequence[Array], most: int = 500, angle: float = float(np.radians(20.0))
) -> Array:
    """Solve A X_LC = X_LC B for each combination of three frames' candidate poses.

    Args:
        X_WL: (3, 4, 4) the link's poses.
        X_CT: for each of the three frames (k, 4, 4) candidate poses.
        most: maximum number of combinations, those with the most similar angles of A and B first.
        angle: maximum difference of the rotation angles of A and B [rad].

    Returns (n, 2, 4, 4) X_LC and X_WT, the latter the mean of three frames.
    """
    pairs = ((0, 1), (0, 2), (1, 2))
    A = np.array([np.linalg.inv(X_WL[j]) @ X_WL[i] for i, j in pairs])
    a = Rotation.from_matrix(A[:, :3, :3]).as_rotvec()
    offs = []
    for (i, j), turned in zip(pairs, np.linalg.norm(a, axis=1), strict=True):
        traces = np.einsum("nij,mij->nm", X_CT[i][:, :3, :3], X_CT[j][:, :3, :3])
        offs.append(np.abs(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)) - turned))
    off = np.maximum(np.maximum(offs[0][:, :, None], offs[1][:, None]), offs[2][None])
    kept = np.argsort(off, axis=None)[: min(most, np.count_nonzero(off <= angle))]
    rows = np.unravel_index(kept, off.shape)
    poses = np.stack([one[row] for one, row in zip(X_CT, rows, strict=True)], axis=1)
    B = np.stack([poses[:, j] @ inverse_transforms(poses[:, i]) for i, j in pairs], axis=1)
    b = Rotation.from_matrix(B[:, :, :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 3, 3)
    # Least-squares rotation for a = R_LC b, with the rotation vectors a of A and b of B.
    R_LC = _nearest_rotations(np.einsum("pi,npj->nij", a, b))
    M = np.broadcast_to((A[:, :3, :3] - np.eye(3)).reshape(9, 3), (len(kept), 9, 3))
    t = (np.einsum("nij,npj->npi", R_LC, B[:, :, :3, 3]) - A[:, :3, 3]).reshape(-1, 9)
    X_LC = np.tile(np.eye(4), (len(kept), 1, 1))
    X_LC[:, :3, :3] = R_LC
    X_LC[:, :3, 3] = np.einsum("nij,nj->ni", np.linalg.pinv(M, rcond=1e-3), t)
    X_WT = (X_WL @ X_LC[:, None] @ poses).mean(axis=1)
    X_WT[:, :3, :3] = _nearest_rotations(X_WT[:, :3, :3])
    return np.stack([X_LC, X_WT], axis=1)


def _nearest_rotations(M: Array) -> Array:
    """Return the rotations (n, 3, 3) nearest to matrices M (n, 3, 3)."""
    U, _, V = np.linalg.svd(M)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ V))[:, None]
    return np.asarray(U @ V)
