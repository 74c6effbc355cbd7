"""Mirrored pictures: a checkerboard looks like a board in a mirror too, but moves the wrong way."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.calibration.board import Detection
from drake_pose.camera.calibration.initial_poses import Detections, pair_pose
from drake_pose.camera.calibration.intrinsics import LensEstimate, estimate_lens
from drake_pose.errors import CameraError

Array = NDArray[np.float64]

_BETTER = 0.25


def find_mirrored(
    points: Array, detections: Detections, lenses: Mapping[str, LensEstimate], name: str
) -> bool:
    """Whether a camera agrees with the others once its pictures are turned left to right.

    Args:
        points: (n, 3) the board's corners in its frame [m].
        detections: by camera, then by frame.
        lenses: by camera.
        name: the camera in doubt.
    """
    lens = lenses[name].lens
    size = (lens.width, lens.height)
    turned = {frame: _turned(points, s, lens.width) for frame, s in detections[name].items()}
    try:
        estimate = estimate_lens(name, points, turned, size)
    except CameraError:
        return False
    as_seen, as_turned = [], []
    for other in detections:
        if other == name:
            continue
        here = pair_pose(points, detections, lenses, other, name)
        there = pair_pose(
            points, {**detections, name: turned}, {**lenses, name: estimate}, other, name
        )
        if here is not None and there is not None:
            as_seen.append(here[1])
            as_turned.append(there[1])
    return bool(np.median(as_turned) < _BETTER * np.median(as_seen))


def _turned(points: Array, detection: Detection, width: int) -> Detection:
    """The detection that the picture turned left to right would give.

    The corners' numbers are turned too: up and down exchanged on the board, since the colours of
    a board of an even number of columns fit only so; with an odd number, left and right.
    """
    uv = np.column_stack([width - 1.0 - detection.uv[:, 0], detection.uv[:, 1]])
    columns = len(np.unique(points[:, 0]))
    rows = len(np.unique(points[:, 1]))
    row, column = np.divmod(detection.corners, columns)
    # Squares are one more than corners: an odd number of corners means an even number of squares.
    if rows % 2 == 0:
        row_new, column_new = rows - 1 - row, column
    else:
        row_new, column_new = row, columns - 1 - column
    corners = row_new * columns + column_new
    order = np.argsort(corners)
    return Detection(corners[order], uv[order])
