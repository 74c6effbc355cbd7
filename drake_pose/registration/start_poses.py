"""Camera poses from which a fit can begin: all rotations, each with the body in the pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.registration.posed_frames import PosedFrames
from drake_pose.silhouette.areas.scoring import score_bodies
from drake_pose.workers import map_ordered

T = TypeVar("T")

# Alexa's constants: psi is the positive root of x^4 = x + 4.
_PHI, _PSI = np.sqrt(2.0), 1.533751168755204288118041
# The bounds are met in so many steps of Gauss and Newton's method, the last ones robust ones.
_PLACING_STEPS, _ROBUST_FROM = 5, 2
# A side that is off by so much of the silhouettes' size says a quarter of what it would.
_ROBUST_SCALE = 0.5
# Points are no nearer to the camera than this share of the bodies' extent.
_NEAREST = 0.05


def apart_from_before(items: Iterable[T], differ: Callable[[T, T], bool]) -> list[T]:
    """Those of some items that differ from all that were kept before them."""
    kept: list[T] = []
    for item in items:
        if all(differ(item, one) for one in kept):
            kept.append(item)
    return kept


def spread_rotations(count: int) -> Array:
    """(count, 3, 3) rotations spread evenly (super-Fibonacci spirals, Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    t = s / count
    d = 2.0 * np.pi * s
    r, R = np.sqrt(t), np.sqrt(1.0 - t)
    a, b = d / _PHI, d / _PSI
    q = np.stack([r * np.sin(a), r * np.cos(a), R * np.sin(b), R * np.cos(b)], axis=-1)
    return Rotation.from_quat(q).as_matrix()


def place_by_bounds(frames: PosedFrames, R_CW: Array) -> Array:
    """(n, 3) p_CW at which the body's bounds in the pictures are those of the silhouettes.

    A side of a silhouette that the picture's border cuts off says nothing, and sides that are far
    off say little (Geman and McClure's weights).

    Args:
        R_CW: (n, 3, 3) the camera's rotations.
    """
    bodies = [np.einsum("nij,pj->npi", R_CW, points) for points in frames.points]
    bounds, shown = zip(*[_bounds(frame.mask) for frame in frames.frames], strict=True)
    middles = R_CW @ frames.middle
    p_CW = _place_by_sizes(frames, bodies, bounds) - middles
    for k in range(_PLACING_STEPS):
        H, g = np.zeros((len(R_CW), 3, 3)), np.zeros((len(R_CW), 3))
        for body, bound, sides in zip(bodies, bounds, shown, strict=True):
            add_bound_equations(
                frames, body + p_CW[:, None], (bound, sides), k >= _ROBUST_FROM, H, g
            )
        H += 1e-3 / 3.0 * np.einsum("nii->n", H)[:, None, None] * np.eye(3) + 1e-9 * np.eye(3)
        step = -np.linalg.solve(H, g[..., None])[..., 0]
        length = np.maximum(np.linalg.norm(step, axis=1), 1e-12)
        depth = np.maximum((p_CW + middles)[:, 2], _NEAREST * frames.extent)
        p_CW += step * np.minimum(1.0, 0.5 * depth / length)[:, None]
        p_CW[:, 2] = np.maximum(p_CW[:, 2], 0.5 * frames.extent - middles[:, 2])
    return p_CW


def _place_by_sizes(frames: PosedFrames, bodies: Sequence[Array], bounds: Sequence[Array]) -> Array:
    """(n, 3) where the bodies' middle is in the camera, as if all of it were equally far."""
    f, c = frames.intrinsics
    spans = np.mean([np.ptp(body[:, :, :2], axis=1) for body in bodies], axis=0)
    size = np.mean([bound[1] - bound[0] for bound in bounds], axis=0)
    depth = np.linalg.norm(spans * f, axis=1) / max(float(np.linalg.norm(size)), 1.0)
    middle = np.mean([bound.mean(axis=0) for bound in bounds], axis=0)
    return np.column_stack([(middle - c) / f * depth[:, None], depth])


def add_bound_equations(
    frames: PosedFrames,
    p_C: Array,
    bound: tuple[Array, NDArray[np.bool_]],
    robust: bool,
    H: Array,
    g: Array,
) -> None:
    """Adds the normal equations of a frame's bounds to H (n, 3, 3) and g (n, 3).

    Args:
        p_C: (n, points, 3) the body in the camera.
        bound: the silhouette's bounds, and which of them count.
        robust: whether what is far off says little.
    """
    f, c = frames.intrinsics
    rows = np.arange(len(p_C))
    z = np.maximum(p_C[..., 2], _NEAREST * frames.extent)
    uv = p_C[..., :2] / z[..., None] * f + c
    for side, axis in np.argwhere(bound[1]):
        i = (uv[..., axis].argmax if side else uv[..., axis].argmin)(axis=1)
        off = uv[rows, i, axis] - bound[0][side, axis]
        J = np.zeros((len(p_C), 3))
        J[:, axis] = f[axis] / z[rows, i]
        J[:, 2] = -(uv[rows, i, axis] - c[axis]) / z[rows, i]
        if robust:
            weight = (1.0 + (off / (_ROBUST_SCALE * frames.size)) ** 2) ** -2
        else:
            weight = np.ones(len(p_C))
        H += weight[:, None, None] * J[:, :, None] * J[:, None, :]
        g += (weight * off)[:, None] * J


def _bounds(mask: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """(2, 2) least and largest u, v of a silhouette's edge, and which of them the border leaves."""
    v, u = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    bounds = np.array([[u[0] - 0.5, v[0] - 0.5], [u[-1] + 0.5, v[-1] + 0.5]])
    height, width = mask.shape
    seen = np.array([[u[0] > 1, v[0] > 1], [u[-1] < width - 2, v[-1] < height - 2]])
    return bounds, seen


def areas(frames: PosedFrames, X_CW: Array, side: float) -> Array:
    """The areas of body, silhouette and what both share, in frames seen from some poses.

    Args:
        X_CW: (n, 4, 4) the world's poses in the camera.
        side: the root of the silhouettes' area in the pictures that are compared [pixel], if the
            camera's are not smaller.

    Returns:
        (n, frames, 3) [pixel].
    """
    camera = frames.smaller(side)
    found = np.empty((len(X_CW), len(frames.frames), 3))

    def score(k: int) -> None:
        X_CN, sums = X_CW[:, None] @ frames.X_WN[k][None], frames.sums(k, camera)
        found[:, k, [0, 2]] = score_bodies(frames.outlines, X_CN, camera, sums[None])
        found[:, k, 1] = sums[:, -1].sum()

    map_ordered(score, range(len(frames.frames)))
    return found


def E_total(found: Array) -> Array:
    """(...) the area that is in body or silhouette alone, over the silhouette's; found (..., 3)."""
    body, mask, both = np.moveaxis(found, -1, 0)
    return np.asarray((body + mask - 2.0 * both) / np.maximum(mask, 1.0))


def intersection_over_union(found: Array) -> Array:
    """(...) of body and silhouette; found (..., 3) of areas."""
    body, mask, both = np.moveaxis(found, -1, 0)
    return np.asarray(both / np.maximum(body + mask - both, 1.0))
