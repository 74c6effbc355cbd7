"""Edge points of silhouettes, with normals, as the evidence of a fit."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.compiled import compiled


class EdgePoints(NamedTuple):
    """Points of a silhouette's edge in one image, from top to bottom."""

    uv: Array  # (n, 2) points [pixel].
    normals: Array  # (n, 2) unit normals, pointing out of the silhouette.
    lengths: Array  # (n,) length of edge that each point represents [pixel].
    middle: Array  # (2,) centroid of the largest contour [pixel]; nan if there is no edge.


NO_EDGE = EdgePoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.full(2, np.nan))
"""The edge of an empty silhouette."""


class Evidence(NamedTuple):
    """Edges of the silhouettes of one frame, ordered by camera."""

    uv: Array  # (n, 2) points [pixel], v ascending in each camera.
    normals: Array  # (n, 2) unit normals, pointing out of the silhouettes.
    lengths: Array  # (n,) length of edge that each point represents [pixel].
    starts: NDArray[np.int64]  # (cameras + 1,) index of each camera's first point.


class Observation(NamedTuple):
    """Evidence of one frame, and known joint values.

    Attributes:
        edges: edges of the silhouettes.
        values: (k,) known values of the first k parameters of a ``Problem``, such as encoder
            readings [rad or m]; the remaining parameters are 0.
        foreground: per camera an image (H, W, 3) that encodes the log-odds that a pixel shows the
            body (``foreground_picture``), or None; empty: no camera has one.
        rates: (m,) velocities of the pose tree's values [rad/s or m/s]; None: unknown, so that a
            time offset has no effect.
    """

    edges: Evidence
    values: Array = np.zeros(0)
    foreground: tuple[Picture | None, ...] = ()
    rates: Array | None = None


def pack_evidence(edges: Sequence[EdgePoints]) -> Evidence:
    """Return the edges of all cameras' silhouettes, one per camera, in one tuple of arrays."""
    return Evidence(
        np.concatenate([np.zeros((0, 2)), *(edge.uv for edge in edges)]),
        np.concatenate([np.zeros((0, 2)), *(edge.normals for edge in edges)]),
        np.concatenate([np.zeros(0), *(edge.lengths for edge in edges)]),
        np.cumsum([0, *(len(edge.uv) for edge in edges)]),
    )


def offset_edges(evidence: Evidence, widths: Array) -> Evidence:
    """Return edges moved outwards along their normals, sorted by v again.

    Args:
        evidence: edges of c silhouettes.
        widths: (c,) distance for each camera [pixel]; negative: inwards.
    """
    counts = np.diff(evidence.starts)
    uv = evidence.uv + np.repeat(widths, counts)[:, None] * evidence.normals
    order = np.concatenate(
        [
            begin + np.argsort(uv[begin:end, 1], kind="stable")
            for begin, end in zip(evidence.starts[:-1], evidence.starts[1:], strict=True)
        ]
    )
    return Evidence(uv[order], evidence.normals[order], evidence.lengths[order], evidence.starts)


def find_edge_points(region: Mask, spacing: float, chord: int = 3) -> EdgePoints:
    """Return points of a silhouette's edge, including holes; the image border is not an edge.

    The result is NO_EDGE if no contour has more than 2 chord + 1 pixels.

    ``region``: (H, W) the silhouette. ``spacing``: distance between points along the edge [pixel].
    ``chord``: the edge's direction is that of a chord to this many pixels on both sides.
    """
    contours, _ = cv2.findContours(region.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    chains = [chain.reshape(-1, 2) for chain in contours if len(chain) > 2 * chord + 1]
    if not chains:
        return NO_EDGE
    starts = np.cumsum([0, *(len(chain) for chain in chains)])
    moments = [cv2.moments(chain) for chain in chains]
    # Holes have the opposite orientation, but OpenCV's moments are positive for them, too.
    largest = max(moments, key=lambda one: one["m00"])
    area = max(largest["m00"], 1e-9)
    uv, normals, lengths = _sample(
        np.concatenate(chains), starts, spacing, region.shape[1], region.shape[0], chord
    )
    order = np.argsort(uv[:, 1])
    return EdgePoints(
        uv[order],
        normals[order],
        lengths[order],
        np.array([largest["m10"] / area, largest["m01"] / area]),
    )


@compiled
def _sample(
    pixels: NDArray[np.int32],
    starts: NDArray[np.int64],
    spacing: float,
    width: int,
    height: int,
    chord: int,
) -> tuple[Array, Array, Array]:
    """Return points (n, 2), outward normals (n, 2) and lengths (n,) along closed chains of pixels.

    Args:
        pixels: (n, 2) pixels of all chains.
        starts: (chains + 1,) index of each chain's first pixel.
        spacing: distance between points [pixel].
        width, height: size of the image [pixel].
        chord: number of pixels on both sides that give the direction of the edge.
    """
    capacity = int(2 * len(pixels) / spacing) + 2 * len(starts)
    uv, normals, lengths = np.empty((capacity, 2)), np.empty((capacity, 2)), np.empty(capacity)
    found = 0
    for c in range(len(starts) - 1):
        begin, count = starts[c], starts[c + 1] - starts[c]
        points = max(1, round(1.1 * count / spacing))
        for k in range(points):
            i = (k * count) // points
            x, y = pixels[begin + i]
            if x == 0 or y == 0 or x == width - 1 or y == height - 1:
                continue
            before = pixels[begin + (i - chord) % count]
            after = pixels[begin + (i + chord) % count]
            du, dv = float(after[0] - before[0]), float(after[1] - before[1])
            size = np.sqrt(du * du + dv * dv)
            if size < 0.5 * chord:
                continue
            # OpenCV's chains have the region on their left, so the outward normal points right.
            n0, n1 = -dv / size, du / size
            normals[found, 0], normals[found, 1] = n0, n1
            # The outermost pixel centres lie half a pixel inside the edge, along the rows or the
            # columns, whichever cross it.
            inside = 0.5 * max(abs(n0), abs(n1))
            uv[found, 0], uv[found, 1] = x + inside * n0, y + inside * n1
            lengths[found] = size / (2 * chord) * count / points
            found += 1
    return uv[:found], normals[:found], lengths[:found]
