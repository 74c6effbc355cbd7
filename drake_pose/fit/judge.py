"""Judge estimates by their data: is it evidence or chance, and what else would look the same.

A camera is fitted to some frames. In others, the silhouette that the joint positions of each row
imply at the fitted pose is compared with each picture. If the rows belong to the pictures, a
picture agrees better with its own row than with others. Rows that are correlated in time agree with
their neighbours, too, so whole blocks of rows are exchanged (a block permutation test).
"""

from math import factorial, perm
from typing import NamedTuple

import numpy as np
from scipy.special import betainc, ndtri

from drake_pose.arrays import Array, Floats, Mask
from drake_pose.camera.models import pose_matrix

LEVEL = 0.01
"""Significance level of all tests that decide what is true."""


class PairedEvidence(NamedTuple):
    """Result of a block permutation test, see ``paired_evidence``."""

    gain: float  # Mean gain of the frames with their own rows.
    wrong_gain: float  # Mean gain of the frames with the rows of other frames.
    p_value: float  # Probability of at least this gain if the rows do not belong to the frames.
    least: float  # Smallest p-value that as few frames can have.
    frames: int  # Number of frames.
    needed: int  # Number of frames, as correlated as these, with which LEVEL can be reached.

    @property
    def holds(self) -> bool:
        """Whether the rows belong to the frames, at LEVEL, and the body explains their pixels."""
        return self.p_value <= LEVEL and self.gain > 0.0

    def __str__(self) -> str:
        if self.least > LEVEL:
            return (
                f"{self.frames} frames are too few to tell whether the joint positions are theirs: "
                f"{self.needed} frames that are as different are needed"
            )
        if self.gain <= 0.0:
            return "without the body the frames are explained better than with it"
        return (
            "with the joint positions of other frames, frames agree "
            f"{'less' if self.holds else 'about as well'}: p-value {self.p_value:.2g}, at most "
            f"{LEVEL:g} is expected"
        )


def paired_gains(silhouettes: Mask, log_odds: Array | Floats) -> Array:
    """Return the log-likelihood gains (n, n) of n pictures with the silhouettes of n rows.

    Args:
        silhouettes: (n, H, W) the body at the joint positions of each row.
        log_odds: (n, H, W) of each picture's pixels to show the body; +1 and -1 for a mask.
    """
    count = len(silhouettes)
    covered = silhouettes.reshape(count, -1).astype(np.float32)
    return np.asarray(log_odds.reshape(count, -1).astype(np.float32) @ covered.T, np.float64)


def paired_evidence(gains: Array, rows: Array, *, draws: int = 5000) -> PairedEvidence:
    """Test whether frames agree better with their own rows than with those of other frames.

    The rows are shifted cyclically, and cut into blocks twice as long as their correlation time.
    The blocks are permuted, and each may be reversed. With rows and frames that are independent
    random processes, correlated over up to a sixth of the recording, p-values of LEVEL or less had
    a frequency of 1 to 4 %.

    Args:
        gains: (n, n) gain of frame i with the joint positions of row j; 0 for frames to which the
            camera was fitted.
        rows: (n, d) joint positions, or places of the links, in the order of time.
        draws: number of random permutations.
    """
    count, length = len(rows), correlation_length(rows)
    length = length if length == 1 else 2 * length
    tested = np.count_nonzero(gains.any(axis=1)) / max(count, 1)

    def smallest(frames: int) -> float:
        """Return the smallest p-value of a number of frames: one over that of permutations."""
        blocks = min(max(1, frames // length), 12)
        several = factorial(blocks) * 2.0**blocks * frames
        if length == 1:
            several = perm(min(frames, 60), round(tested * min(frames, 60)))
        return max(1.0 / several, 1.0 / (draws + 1.0))

    needed = next((k for k in range(2, 200) if smallest(k) <= LEVEL), 200)
    own = float(np.trace(gains)) / max(count, 1)
    mean = (float(gains.sum()) / max(count, 1) - own) / max(count - 1, 1)
    if count < 2 or not tested:
        return PairedEvidence(own, mean, 1.0, 1.0, count, needed)
    cuts = np.array_split(np.arange(count), max(1, count // length))
    rng, orders = np.random.default_rng(0), np.empty((draws, count), np.int64)
    for k in range(draws):
        shifted, turned = np.roll(np.arange(count), rng.integers(count)), rng.random(len(cuts))
        orders[k] = np.concatenate(
            [shifted[cuts[b]][:: 1 if turned[b] < 0.5 else -1] for b in rng.permutation(len(cuts))]
        )
    other = (orders != np.arange(count)).any(axis=1)
    reached = gains[np.arange(count), orders[other]].mean(axis=1) >= own - 1e-9 * abs(own)
    least = smallest(count)
    p_value = least + (1.0 - least) * float(reached.mean())
    return PairedEvidence(own, mean, p_value, least, count, needed)


def held_out(rows: Array) -> Mask:
    """Return which frames (n,) a fit leaves for its judgement: every second block of rows.

    Frames beside fitted ones show nearly the same, so that they agree with a wrong pose, too.
    Blocks are twice as long as the rows' correlation time, and at most half of all rows.

    ``rows``: (n, d) as of ``paired_evidence``.
    """
    length = correlation_length(rows)
    length = 1 if length == 1 else min(2 * length, (len(rows) + 1) // 2)
    return np.arange(len(rows)) // length % 2 == 1


def correlation_length(rows: Array) -> int:
    """Return the lag from which rows (n, d) in the order of time are no longer correlated.

    It is the first lag at which their mean autocorrelation is below 1/e; at most n.
    """
    off = rows - rows.mean(axis=0)
    variance = float((off**2).sum())
    for lag in range(1, len(rows)):
        scale = len(rows) / (len(rows) - lag)  # Each lag has fewer products.
        if scale * float((off[lag:] * off[:-lag]).sum()) < variance / np.e:
            return lag
    return max(1, len(rows))


def is_noise(length: Array | float, off: Array | float, correlation: float) -> Mask:
    """Return whether no more of contours is farther off than noise is with probability LEVEL.

    Pieces of contour as long as ``correlation`` are independent, so that the number of those that
    are off has a binomial distribution.

    ``length``: of contours, scalar or (...). ``off``: of what is farther off [any unit].
    """
    pieces, beyond = np.rint(length / correlation), np.floor(np.asarray(off) / correlation)
    tail = betainc(np.maximum(beyond, 1.0), np.maximum(pieces - beyond, 0.0) + 1.0, LEVEL)
    return np.asarray((beyond < 1.0) | (tail > LEVEL))


def largest_difference(length: float, deviation: float, correlation: float) -> float:
    """Return the area [pixel^2] between two contours that noise exceeds with probability LEVEL.

    ``length``, ``deviation``, ``correlation``: of a contour and its noise [pixel].
    """
    pieces = length / correlation
    # Mean and standard deviation of |r|, r normal.
    mean, scatter = np.sqrt(2.0 / np.pi), np.sqrt(1.0 - 2.0 / np.pi)
    most = mean * pieces + ndtri(1.0 - LEVEL) * scatter * np.sqrt(pieces)
    return float(correlation * deviation * most)


def opposite_side(X_CW: Array, middle: Array) -> Array:
    """Return X_CW (4, 4) opposite, as far from `middle` (3,), from where mirror images are seen."""
    X = np.diag([-1.0, 1.0, -1.0, 1.0]) @ X_CW
    X[2, 3] += 2.0 * float(X_CW[2, :3] @ middle + X_CW[2, 3])
    return X


def depth_twin(X_CW: Array, points: Array) -> Array:
    """Return the pose X_CW (4, 4) at which a nearly plane set of points looks the same.

    The set is reversed in depth (Necker's cube): its points are mirrored at the plane across the
    ray to their centroid, and at the plane in which they spread most. Under weak perspective points
    of a plane then keep their places in the picture.

    ``points``: (n, 3) of the parts that move, in all frames together, in the world [m].
    """
    middle = points.mean(axis=0)
    u = np.linalg.eigh(np.cov((points - middle).T))[1][:, 0]  # They spread least along this axis.
    p_C = X_CW[:3, :3] @ middle + X_CW[:3, 3]
    ray = p_C / np.linalg.norm(p_C)
    D, S = (np.eye(3) - 2.0 * np.outer(one, one) for one in (ray, u))
    R = D @ X_CW[:3, :3] @ S
    return pose_matrix(R, p_C - R @ middle)
