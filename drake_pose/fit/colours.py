"""Pictures as evidence of a body's pose: what is known of its colours, and how lines are looked at.

Nothing is kept here between frames: who follows a body keeps the histograms, and gets new ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.fit.colour_lines import COLOURS, ODDS, ON, compare_lines, learn_colours
from drake_pose.fit.contour_fit import Comparison, Noise, camera_weights, pack_cameras
from drake_pose.fit.kernel import COMPARED, SQUARES, WEIGHT
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.areas.scoring import draw_labels

Histograms = NDArray[np.float32]
"""(cameras, nodes, 3, COLOURS) what is known of a body's colours in each camera's pictures."""


NO_REGION = np.zeros((0, 0), dtype=np.bool_)
"""Where nobody knows where the body is seen: as `learn_colours` takes it."""

# Rarer colours are not a part's own [a share of all]; fewer pixels say nothing of a part.
_RARE, _FEW = 4e-4, 100
# A part is no closer to a contour than this [pixel], and is judged by no less of it [pixel].
_CLOSE, _TELLING = 0.7, 20.0
# What a part's lines say of their own noise is trusted no further than this [pixel]: of a part that
# is far off they have to say where it is.
_NOISIEST = 2.0


# From offset to offset of lines, in one round after the other [pixel]; the last is that of all
# further rounds.
_STEPS = (4, 2, 1)
COLOUR_SPACING, COLOUR_CORRELATION = 2.0, 5.0
"""Of lines along the contour, so many pixels where the step is one; and how much of a contour errs
together [pixel]: its lines count as one."""
# Colours are counted so far inside of the contour, and outside of it [pixel].
_WIDTHS = (16.0, 30.0)
# The share of a frame's colours in what is known after it. Lines on which the edge seems to be
# further from the contour [pixel] teach nothing: something else is there.
_RATE, _AGREEING = 0.1, 2.5


def colour_numbers(pixels: Picture) -> NDArray[np.intp]:
    """(...) the colours of pixels (..., 3 or 4), as histograms count them."""
    red, green, blue = np.moveaxis(pixels[..., :3].astype(np.intp) >> 4, -1, 0)
    return (red * 16 + green) * 16 + blue


@dataclass(frozen=True, eq=False)
class OwnColours:
    """What parts look like to whichever camera, learned where the body is known to be.

    Args:
        known: (nodes, COLOURS) which colours are a part's own.
        usual: (nodes,) the share of its pixels that had them there; nan: it was not seen.
    """

    known: NDArray[np.bool_]
    usual: Array

    @staticmethod
    def learned(
        histograms: Iterable[NDArray[np.float32]],
        outlines: Sequence[Outline],
        X_WN: Array,
        views: Iterable[tuple[Camera, Picture]],
    ) -> OwnColours:
        """Those of cameras' histograms, of a body of these surfaces at X_WN (nodes, 4, 4)."""
        known = np.any([one[:, ON] > _RARE for one in histograms], axis=0)
        own = OwnColours(known, np.ones(len(known)))
        return OwnColours(known, own._shares(outlines, X_WN, views))

    def shown(
        self, outlines: Sequence[Outline], X_WN: Array, views: Iterable[tuple[Camera, Picture]]
    ) -> Array:
        """(nodes,) how many times the usual share shows: of the median, as light changes all."""
        shares = self._shares(outlines, X_WN, views) / self.usual
        return np.asarray(shares / max(float(np.nanmedian([*shares, 1.0])), 1e-9))

    def _shares(
        self, outlines: Sequence[Outline], X_WN: Array, views: Iterable[tuple[Camera, Picture]]
    ) -> Array:
        counts = np.zeros((2, len(outlines)))
        for camera, picture in views:
            labels = draw_labels(outlines, range(1, 1 + len(outlines)), camera.X_CW @ X_WN, camera)
            seen = labels > 0
            parts = labels[seen] - 1
            np.add.at(counts[0], parts, self.known[parts, colour_numbers(picture[seen])])
            np.add.at(counts[1], parts, 1.0)
        return np.where(counts[1] < _FEW, np.nan, counts[0] / np.maximum(counts[1], 1.0))


def step_of_lines(number: int) -> int:
    """From offset to offset of lines in a round, counted from 0 [pixel]."""
    return _STEPS[min(number, len(_STEPS) - 1)]


def no_colours(cameras: int, nodes: int) -> Histograms:
    """What is known of a body that was never seen: nothing."""
    known = np.zeros((cameras, nodes, 3, COLOURS), dtype=np.float32)
    known[:, :, ODDS] = 1.0
    return known


def check_picture(camera: Camera, picture: Picture) -> Picture:
    """A picture as kernels take it: a copy where it cannot be written or lies in pieces.

    Raises:
        SettingsError: it is not (H, W, 3) or (H, W, 4) bytes of the camera's size.
    """
    shape = (camera.height, camera.width)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] not in (3, 4):
        raise SettingsError(
            f"camera '{camera.name}': a picture of red, green and blue bytes expected, got "
            f"{picture.shape} {picture.dtype}"
        )
    if picture.shape[:2] != shape:
        raise SettingsError(
            f"camera '{camera.name}': picture of {picture.shape[1]} x {picture.shape[0]} pixels, "
            f"{camera.width} x {camera.height} expected"
        )
    return np.require(picture, requirements=["C", "W"])


def add_pictures(
    compared: Comparison,
    cameras: Sequence[Camera],
    pictures: Sequence[Picture | None],
    histograms: Histograms,
    step: AnnealingStage,
    noise: Noise,
    pixels: int,
) -> None:
    """Adds what pictures say to what silhouettes say, in place.

    Args:
        compared: of all cameras.
        cameras: the cameras.
        pictures: of each; None: no lines are looked at in it.
        histograms: what is known of the colours.
        step: the scale of the residuals, and the spacing of lines [pixel].
        noise: what a pixel of contour is worth [pixel].
        pixels: from offset to offset along lines.
    """
    placed = compared.placement
    packed = pack_cameras(cameras)
    weights = camera_weights(packed, placed, step, noise, 1.0)
    for c, picture in enumerate(pictures):
        if picture is not None:
            compare_lines(
                placed.packed, placed.X_WN, (packed[0][c], packed[1][c]), picture, histograms[c],
                weights[c], pixels, compared.A[c], compared.b[c], compared.sums[c],
                compared.wide[c],
            )  # fmt: skip


def weigh_parts(compared: Comparison, deviation: float, pictures: Sequence[Picture | None]) -> None:
    """Gives parts whose lines scatter more than those of others less weight, in place.

    A part has few lines that err independently: its variance is taken half way, on a scale of
    logarithms, between its own and that of all.

    Args:
        compared: of all cameras.
        deviation: the least of lines [pixel].
        pictures: of each camera; None: its silhouettes are not weighed.
    """
    shown = [c for c, picture in enumerate(pictures) if picture is not None]
    squares, weight = (compared.sums[shown, :-1, k] for k in (SQUARES, WEIGHT))
    overall = max(deviation**2, float(squares.sum() / max(float(weight.sum()), 1e-12)))
    own = np.clip(squares / np.maximum(weight, 1e-12), deviation**2, _NOISIEST**2)
    share = np.sqrt(overall / own)
    compared.A[shown] *= share[..., None, None]
    compared.b[shown] *= share[..., None]


def part_distances(sums: Array) -> Array:
    """(nodes,) how far each part is from the contour that colours show [pixel].

    What covers a part in one camera says nothing against it where another sees it: the mean over
    cameras is that of one over the distances' squares. 0: of the part too little is said.

    Args:
        sums: (cameras, nodes + 1, 6) of pictures, as of `compare_contours`.
    """
    squares, weight, length = (sums[:, :-1, k] for k in (SQUARES, WEIGHT, COMPARED))
    own = np.maximum(_CLOSE**2, squares / np.maximum(weight, 1e-12))
    told = length.sum(axis=0)
    distances = np.sqrt(told / np.maximum((length / own).sum(axis=0), 1e-12))
    return np.where(told >= _TELLING, distances, 0.0)


def learned(
    placed: Placement,
    cameras: Sequence[Camera],
    pictures: Sequence[Picture | None],
    histograms: Histograms,
    surely: bool = False,
) -> Histograms:
    """What is known of the colours after a frame.

    Args:
        placed: the body where it stands.
        cameras: the cameras.
        pictures: of each; None: it teaches nothing.
        histograms: what was known before.
        surely: whether the pose is known, so that all lines teach and old colours are forgotten.
    """
    known = histograms.copy()
    packed = pack_cameras(cameras)
    rate, agreeing = (1.0, math.inf) if surely else (_RATE, _AGREEING)
    for c, picture in enumerate(pictures):
        if picture is not None:
            learn_colours(
                placed.packed, placed.X_WN, (packed[0][c], packed[1][c]), picture, known[c],
                COLOUR_SPACING, np.array(_WIDTHS), rate, agreeing, 0, NO_REGION,
            )  # fmt: skip
    return known
