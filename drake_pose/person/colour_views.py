"""What cameras' pictures say of a person where there is no silhouette: colours along lines.

Lines are as wide as the fit's scale; colours count on both sides of the edge that is seen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.fit.camera_sums import AddUp, CameraSum
from drake_pose.fit.colour_lines import COLOURS, compare_lines, learn_colours
from drake_pose.fit.colours import NO_REGION, Picture, check_picture
from drake_pose.fit.contour_fit import (
    Comparison,
    ContourFit,
    pack_cameras,
    pixels_per_metre,
)
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
# By camera (nodes, 3, COLOURS): what is known of the colours on a body's parts and beside them.
KnownColours = Mapping[str, NDArray[np.float32]]

# Lengths [m] are those seen at the body's root. Of lines along the contour; colours are counted so
# far inside of the edge, and outside of it, from offset to offset.
_SPACING, _WIDTHS, _COUNTED = 0.015, (0.05, 0.10), 0.006
# Lines on which the edge seems to be further from the contour than this teach nothing.
_AGREEING = 0.03
# The share of a frame's colours in what is known after it.
_RATE = 0.1
# From offset to offset of a line, as a share of the fit's scale: the window is as wide as that.
_STEP = 0.2
# In small pictures colours are counted so far inside and outside all the same, and edges that are
# so far off are believed [pixel].
_LEAST_WIDTHS, _LEAST_AGREEING = (6.0, 12.0), 2.5


class ColourViews:
    """Pictures (H, W, 3 or 4) of a moment, to be compared with a person of whom colours are known.

    Args:
        cameras, pictures: by name; only cameras that have a picture are kept.
        known: a camera that is not in it says nothing.

    Raises:
        SettingsError: pictures that do not fit the cameras.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        pictures: Sequence[Picture],
        known: KnownColours,
    ) -> None:
        self.cameras = tuple(cameras)
        self.pictures = [
            check_picture(camera, picture)
            for camera, picture in zip(cameras, pictures, strict=True)
        ]
        self.known = known
        self._packed = pack_cameras(cameras)

    def compare(self, fit: ContourFit, placement: Placement, step: AnnealingStage) -> Comparison:
        """What each camera says of a body where it stands."""
        count, nodes = len(self.cameras), len(placement.X_WN)
        weights = fit.weights(self._packed, placement, replace(step, spacing=_SPACING))
        A, b = np.zeros((count, nodes, 12, 12)), np.zeros((count, nodes, 12))
        sums = np.zeros((count, nodes + 1, 6))
        for c, camera in enumerate(self.cameras):
            if camera.name in self.known:
                compare_lines(
                    placement.packed, placement.X_WN, self._camera(c), self.pictures[c],
                    self.known[camera.name], weights[c], max(1, round(_STEP * weights[c, 1])),
                    A[c], b[c], sums[c],
                )  # fmt: skip
        return Comparison(A, b, sums, placement)

    def add_up(self, fit: ContourFit) -> AddUp:
        """What compares a body with all pictures and adds up."""

        def total(placement: Placement, step: AnnealingStage) -> CameraSum:
            return self.compare(fit, placement, step).total

        return total

    def learned(
        self, fit: ContourFit, values: Array, regions: Mapping[str, Mask] | None = None
    ) -> KnownColours:
        """What is known of the colours after this moment, of the pose tree's values (m,).

        Args:
            regions: (H, W) the person by camera, where known; other cameras of which nothing is
                known yet learn on both sides of the contour.
        """
        placement = fit.body.place(values)
        scales = pixels_per_metre(self._packed, placement.X_WN[0, :3, 3])
        learned = dict(self.known)
        for c, camera in enumerate(self.cameras):
            region = (regions or {}).get(camera.name)
            known = learned.get(camera.name)
            size = float(scales[c])
            surely = known is None or region is not None
            histograms = (
                np.zeros((len(placement.X_WN), 3, COLOURS), dtype=np.float32)
                if known is None
                else known.copy()
            )
            learn_colours(
                placement.packed, placement.X_WN, self._camera(c), self.pictures[c], histograms,
                max(2.0, _SPACING * size),
                np.maximum(np.multiply(_WIDTHS, size), _LEAST_WIDTHS),
                1.0 if surely else _RATE,
                math.inf if surely else max(_AGREEING * size, _LEAST_AGREEING),
                max(1, round(_COUNTED * size)),
                NO_REGION if region is None else np.ascontiguousarray(region),
            )  # fmt: skip
            learned[camera.name] = histograms
        return learned

    def _camera(self, c: int) -> tuple[Array, Array]:
        return self._packed[0][c], self._packed[1][c]
