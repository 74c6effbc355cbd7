"""Sums over cameras: what a group of cameras says of a body at once, and its way between processes.

The normal equations are a sum over cameras, so whoever has some cameras' edges can add up what they
say, and the sums of all groups are what all cameras say.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from drake_pose.arrays import Array
from drake_pose.fit.evidence import EdgePoints, Evidence, pack_evidence
from drake_pose.fit.kernel import compare_contours
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement
from drake_pose.silhouette.areas.outline import PackedOutlines

# Cameras and nodes of a request.
_HEADER = struct.Struct("<2q")
_LOWER = np.tril_indices(12)
_SUMS = 6
_A_NODE = len(_LOWER[0]) + 12 + _SUMS


class Views(NamedTuple):
    """What all cameras say of one frame, as the kernel takes it.

    cameras: X_CW (c, 4, 4) and kernel parameters (c, 8); evidence: their silhouettes' edges.
    """

    cameras: tuple[Array, Array]
    evidence: Evidence


class CameraSum(NamedTuple):
    """What some cameras together say of each node's affine motion x (12,): x^T A x - 2 b^T x.

    A: (nodes, 12, 12), lower triangles; b: (nodes, 12); sums: (nodes + 1, 6) as of
    `compare_contours`.
    """

    A: Array
    b: Array
    sums: Array


AddUp = Callable[[Placement, AnnealingStage], CameraSum]
"""Compares a body's contours with all cameras' edges, wherever these are, and adds up."""


class SumRequest(NamedTuple):
    """A body's place, to be compared with cameras' edges that are elsewhere.

    names: of the cameras; times: (c,) the time stamps of their pictures [s]; cameras: X_CW
    (c, 4, 4) and kernel parameters (c, 8); weights: (c, 4) as of `compare_contours`; packed: the
    body's surfaces; X_WN: (nodes, 4, 4).
    """

    names: Sequence[str]
    times: Array
    cameras: tuple[Array, Array]
    weights: Array
    packed: PackedOutlines
    X_WN: Array


class EdgeKeeper(Protocol):
    """Keeps the edges of some cameras' pictures, and compares contours with them elsewhere."""

    def ask(self, request: SumRequest) -> bool:
        """Begins to compare and add up; False where it cannot."""

    def answer(self) -> CameraSum | None:
        """Waits for what was asked for; None where it does not come, or the edges are gone."""


def compare_placed(
    packed: PackedOutlines, X_WN: Array, views: Views, weights: Array
) -> tuple[Array, Array, Array]:
    """A, b and sums of each camera; arguments as of `compare_contours`."""
    A, b, sums, *_ = compare_contours(packed, X_WN, *views, weights, 0, 1.0, False)
    return A, b, sums


def add_cameras(A: Array, b: Array, sums: Array) -> CameraSum:
    """The sum of what each camera says, as of `compare_placed`."""
    return CameraSum(A.sum(axis=0), b.sum(axis=0), sums.sum(axis=0))


def add_sums(parts: Sequence[CameraSum], nodes: int) -> CameraSum:
    """The sum of groups of cameras; none at all say nothing."""
    total = no_cameras(nodes)
    for part in parts:
        for into, one in zip(total, part, strict=True):
            into += one
    return total


def no_cameras(nodes: int) -> CameraSum:
    """What no camera says of this many nodes."""
    return CameraSum(np.zeros((nodes, 12, 12)), np.zeros((nodes, 12)), np.zeros((nodes + 1, _SUMS)))


def pack_sum(total: CameraSum) -> bytes:
    """Packs a sum without loss; of the symmetric matrices the lower triangles."""
    A, b, sums = total
    rows = np.concatenate([A[:, _LOWER[0], _LOWER[1]], b, sums[:-1]], axis=1)
    return np.concatenate([rows.ravel(), sums[-1]]).astype("<f8").tobytes()


def unpack_sum(data: bytes) -> CameraSum:
    """The sum that was packed."""
    numbers = np.frombuffer(data, "<f8")
    rows = numbers[:-_SUMS].reshape(-1, _A_NODE)
    A = np.zeros((len(rows), 12, 12))
    lower, b, sums = np.split(rows, [len(_LOWER[0]), len(_LOWER[0]) + 12], axis=1)
    A[:, _LOWER[0], _LOWER[1]] = lower
    # Kernels are compiled for arrays that lie in one piece and can be written.
    return CameraSum(A, b.copy(), np.vstack([sums, numbers[-_SUMS:]]))


def pack_request(request: SumRequest, numbers: Sequence[int]) -> bytes:
    """Packs a request without the surfaces; numbers: (c,) of its cameras for who is asked."""
    X_CW, parameters = request.cameras
    parts = (
        np.asarray(numbers, np.float64), request.times, X_CW, parameters, request.weights,
        request.X_WN,
    )  # fmt: skip
    header = _HEADER.pack(len(request.times), len(request.X_WN))
    return header + np.concatenate([np.ravel(one) for one in parts]).astype("<f8").tobytes()


def answer_request(
    data: bytes, packed: PackedOutlines, find_edge: Callable[[int, float], EdgePoints | None]
) -> CameraSum | None:
    """The sum that a packed request asks for; None where edges are not there.

    Args:
        data: of pack_request.
        packed: the body's surfaces.
        find_edge: the edge of a camera's picture, by the camera's number and the time stamp [s].
    """
    count, nodes = _HEADER.unpack_from(data)
    sizes = np.cumsum([count, count, 16 * count, 8 * count, 4 * count])
    numbers, times, X_CW, parameters, weights, X_WN = np.split(
        np.frombuffer(data, "<f8", offset=_HEADER.size).astype(np.float64), sizes
    )
    found = [find_edge(int(k), float(t)) for k, t in zip(numbers, times, strict=True)]
    edges = [edge for edge in found if edge is not None]
    if len(edges) < count:
        return None
    cameras = X_CW.reshape(-1, 4, 4), parameters.reshape(-1, 8)
    views = Views(cameras, pack_evidence(edges))
    return add_cameras(
        *compare_placed(packed, X_WN.reshape(nodes, 4, 4), views, weights.reshape(-1, 4))
    )


def pack_surfaces(packed: PackedOutlines) -> bytes:
    """Packs a body's surfaces."""
    stream = io.BytesIO()
    np.savez(stream, **packed._asdict())
    return stream.getvalue()


def unpack_surfaces(data: bytes) -> PackedOutlines:
    """The surfaces that were packed."""
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return PackedOutlines(**{name: arrays[name] for name in PackedOutlines._fields})
