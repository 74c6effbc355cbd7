"""What a fit needs of a silhouette: the points of its edge, with normals."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.compiled import compiled


class EdgePoints(NamedTuple):
    """Points of a silhouette's edge in one picture, from top to bottom.

    Attributes:
        uv: (n, 2) [pixel].
        normals: (n, 2) unit normals out of the silhouette.
        lengths: (n,) the length of edge that each stands for [pixel].
        middle: (2,) the silhouette's middle [pixel]; nan where it is empty.
    """

    uv: Array
    normals: Array
    lengths: Array
    middle: Array


NO_EDGE = EdgePoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.full(2, np.nan))
"""Of a picture in which nothing is seen, or of none."""


class Evidence(NamedTuple):
    """The edges of one frame's silhouettes, camera after camera.

    Attributes:
        uv: (n, 2) [pixel], v ascending in each camera.
        normals: (n, 2) unit normals out of the silhouettes.
        lengths: (n,) the length of edge that each point stands for [pixel].
        starts: (cameras + 1,) int64 where each camera's points begin.
    """

    uv: Array
    normals: Array
    lengths: Array
    starts: NDArray[np.int64]


class Observation(NamedTuple):
    """What cameras see of a body in one frame, and what is known of its joints then.

    Attributes:
        edges: of its silhouettes, camera after camera.
        values: (k,) known values of the first k parameters of a ``Problem``, such as encoders'
            readings [rad or m]; the others are 0.
        foreground: of each camera a picture (H, W, 3) whose colours are log-odds
            (``fit.background``), or None; empty: of none.
        rates: (m,) velocities of the pose tree's values [rad/s or m/s]; None: not known.
    """

    edges: Evidence
    values: Array = np.zeros(0)
    foreground: tuple[Picture | None, ...] = ()
    rates: Array | None = None


def pack_evidence(edges: Sequence[EdgePoints]) -> Evidence:
    """The edges of each camera's silhouette in one; one without points says nothing."""
    return Evidence(
        np.concatenate([np.zeros((0, 2)), *(edge.uv for edge in edges)]),
        np.concatenate([np.zeros((0, 2)), *(edge.normals for edge in edges)]),
        np.concatenate([np.zeros(0), *(edge.lengths for edge in edges)]),
        np.cumsum([0, *(len(edge.uv) for edge in edges)]),
    )


def widened(evidence: Evidence, widths: Array) -> Evidence:
    """The edges of silhouettes that are wider (c,) on all sides [pixel], or narrower."""
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
    """Points of a silhouette's edge, holes included; the picture's border is no edge.

    Args:
        region: (H, W) the silhouette.
        spacing: from point to point [pixel].
        chord: the edge's direction is that of a chord over this many pixels to both sides.
    """
    contours, _ = cv2.findContours(region.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    chains = [chain.reshape(-1, 2) for chain in contours if len(chain) > 2 * chord + 1]
    if not chains:
        return NO_EDGE
    starts = np.cumsum([0, *(len(chain) for chain in chains)])
    moments = [cv2.moments(chain) for chain in chains]
    # Holes run the other way round, but OpenCV's moments are positive for them, too.
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
    """Points, normals and lengths along closed chains of pixels (n, 2)."""
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
            # OpenCV runs with the region to the left: outwards is to the right, y down.
            n0, n1 = -dv / size, du / size
            normals[found, 0], normals[found, 1] = n0, n1
            # The outermost pixels' centres lie half a pixel inside of the edge, along the rows or
            # the columns: whichever cross it.
            inside = 0.5 * max(abs(n0), abs(n1))
            uv[found, 0], uv[found, 1] = x + inside * n0, y + inside * n1
            lengths[found] = size / (2 * chord) * count / points
            found += 1
    return uv[:found], normals[:found], lengths[:found]
