"""Silhouettes' difference to a part of a pixel, with its derivative.

A mask's pixel is taken as the square about its centre. Along lines between a picture's rows of
pixel centres the body's spans are cut out exactly, so that the covered share of every pixel is
exact across and sampled down; the area that body or mask covers, but not both, is then a
differentiable function of the pose but where contours pass each other. It grows as the contour
moves outwards where the mask ends before it, and shrinks where the mask goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.camera import Camera
from drake_pose.compiled import compiled
from drake_pose.errors import SettingsError
from drake_pose.silhouette.areas.outline import Outline, pack
from drake_pose.silhouette.areas.scoring import prefix_sums
from drake_pose.silhouette.contours.contour_points import ContourPoints, sample_contour
from drake_pose.silhouette.contours.contour_segments import (
    Segments,
    find_crossings,
    find_line_spans,
    find_segments,
)


@dataclass(frozen=True, eq=False)
class SubPixelDifference:
    """The area J that body or mask covers, but not both.

    Attributes:
        J: the area inside the picture [pixel].
        points: points of the contour, as ``find_contour_points``, where the lines cross it.
        slopes: (n,) how fast J grows as each point moves along its normal [pixel]: the derivative
            of J by parameters is ``slopes @ normal_jacobian(points, ...)``.
    """

    J: float
    points: ContourPoints
    slopes: np.ndarray


def sub_pixel_difference(
    outlines: Sequence[Outline],
    X_CN: np.ndarray,
    camera: Camera,
    mask: np.ndarray,
    lines: int = 4,
) -> SubPixelDifference:
    """Returns the difference of a body's silhouette and a mask.

    Args:
        outlines: the body's surfaces.
        X_CN: (nodes, 4, 4) their poses in the camera.
        camera: the camera.
        mask: (H, W) bool.
        lines: how many lines cut each row of pixels.

    Raises:
        SettingsError: when ``lines`` is below 1.
    """
    if lines < 1:
        raise SettingsError(f"lines must be 1 or more, not {lines}")
    packed = pack(tuple(outlines))
    parameters = camera.kernel_parameters()
    segments = find_segments(packed, np.ascontiguousarray(X_CN, dtype=np.float64), parameters)
    spacing = 1.0 / lines
    first = 0.5 * spacing - 0.5
    points = ContourPoints(*sample_contour(packed, segments, parameters, first, spacing, False))
    columns = np.clip(np.rint(points.uv[:, 0]), 0, camera.width - 1).astype(np.int64)
    rows = np.clip(np.rint(points.uv[:, 1]), 0, camera.height - 1).astype(np.int64)
    return SubPixelDifference(
        J=_area_apart(segments, prefix_sums(mask), lines),
        points=points,
        slopes=np.where(mask[rows, columns], -1.0, 1.0) * points.lengths,
    )


@compiled
def _area_apart(segments: Segments, prefixes: np.ndarray, lines: int) -> float:
    """The area that body or mask covers, but not both [pixel].

    Args:
        segments: the body's projected contour edges.
        prefixes: (H, W + 1) the mask's prefix sums.
        lines: how many lines cut each row of pixels.
    """
    height, width = prefixes.shape[0], prefixes.shape[1] - 1
    spacing = 1.0 / lines
    starts, places, owners = find_crossings(
        segments, 0, 0.5 * spacing - 0.5, spacing, height * lines
    )
    spans = np.empty((segments.ends.shape[0] + 1, 2), dtype=np.int64)
    area = 0.0
    for row in range(height):
        area += prefixes[row, width]
    for line in range(height * lines):
        row = line // lines
        for k in range(find_line_spans(segments, 0, starts, places, owners, line, spans)):
            for end in range(2):
                # From the picture's left edge, where the first pixel's square begins.
                place = min(max(places[spans[k, end]] + 0.5, 0.0), float(width))
                pixel = min(int(place), width - 1)
                inside = prefixes[row, pixel + 1] - prefixes[row, pixel]
                shared = prefixes[row, pixel] + inside * (place - pixel)
                area += (2 * end - 1) * spacing * (place - 2.0 * shared)
    return area
