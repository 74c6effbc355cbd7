"""Score and segment a body that moves with a camera, in front of a world that changes.

In the pictures of a camera on the wrist, a gripper moves only by its fingers' joints. Each pixel of
a frame is of a kind: one of a few groups of colours, and whether its colour is about its median
over the frames. Silhouettes at the right pose separate the kinds: a gripper keeps its colours in
all frames where the world does not, or has other colours than a table that keeps its own. The
gripper's edges, too, are the same in all frames with similar finger positions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.fit.background import (
    MODEL,
    KnownBackground,
    Window,
    apply_gain,
    colour_deviations,
    colour_slopes,
    estimate_gain,
    grown,
    largest,
    likeness,
    log_frequencies,
)
from drake_pose.fit.colours import COLOURS, colour_numbers
from drake_pose.fit.explain_kernel import PixelSums


class RidingSettings(NamedTuple):
    """Settings for a body that moves with the camera; chosen on simulated wrists of three arms."""

    share: float = 0.2  # Approximate fraction of the picture that the body covers.
    groups: int = 12  # Number of groups of colours.
    edge: float = 6.0  # Gradient of an edge of full strength, 1 [of 255 per pixel].
    # Of the mean strength of edges along the contours, beside the explained fraction.
    weight: float = 2.0
    # Strength of a lasting edge that is as likely on a contour as elsewhere.
    threshold: float = 0.2
    full_gain: float = 0.35  # Mean gain of a pixel at which the explained fraction is 1 [nat].


RIDING = RidingSettings()


@dataclass(frozen=True, eq=False)
class RidingPictures:
    """Small images of a camera that moves, and of a body that moves with it."""

    pictures: Floats  # (f, H, W, 3) images after photometric correction [0 to 255].
    gains: tuple[Floats, ...]  # (3, 4) photometric gain of each image, see ``estimate_gain``.
    colours: Floats  # (H, W, 3) median colours of all images [0 to 255].
    deviations: Floats  # (H, W) standard deviations of the body's colours [of 255].
    alike: Array  # (f, f) similarity of the body's poses in two frames; 1: the same, 0: none.

    @staticmethod
    def estimate(pictures: Picture, alike: Array) -> "RidingPictures":
        """Estimate colours and gains; pictures: (f, H, W, 3) RGB; alike: as of the class."""
        floats = pictures.astype(np.float32)
        reference = np.median(floats, axis=0)

        def changes(images: Floats) -> Floats:
            """Return the median difference (H, W) of images (f, H, W, 3) from the reference."""
            return np.asarray(np.median(largest(np.abs(images - reference)), axis=0))

        first = changes(floats)
        # The body is among the pixels that change least.
        still = first <= np.quantile(first, 0.5 * RIDING.share)
        gains = tuple(
            estimate_gain(image[still][:, None], reference[still][:, None]) for image in floats
        )
        corrected = np.array([apply_gain(*pair) for pair in zip(floats, gains, strict=True)])
        noise = 1.4826 * float(np.quantile(changes(corrected), 0.25 * RIDING.share))
        return RidingPictures(
            corrected, gains, reference, colour_deviations(reference, noise), alike
        )

    @cached_property
    def sums(self) -> PixelSums:
        """Kinds of pixels and edges of the images; other sums of ``explain`` are not used."""
        count, (height, width) = len(self.pictures), self.deviations.shape
        sample = np.ascontiguousarray(self.pictures.reshape(-1, 3)[:: max(1, count * height // 60)])
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 10, 1.0)
        cv2.setRNGSeed(0)
        groups = min(RIDING.groups, len(sample))
        labels = np.zeros((len(sample), 1), np.int32)
        _, _, centres = cv2.kmeans(sample, groups, labels, stop, 1, cv2.KMEANS_PP_CENTERS)
        kinds = np.empty((height, width, count), np.uint8)
        for f, picture in enumerate(self.pictures):
            squares = ((picture[:, :, None] - centres) ** 2).sum(axis=-1)
            repeats = largest(np.abs(picture - self.colours)) / self.deviations
            kinds[:, :, f] = 2 * squares.argmin(axis=-1) + (repeats < MODEL.match_deviations)
        counts = np.bincount(kinds.ravel(), minlength=2 * groups).astype(np.float64)
        edges = self._lasting_edges() - np.float32(RIDING.threshold)
        none = np.zeros((1, 1, 1), np.float32)
        return PixelSums(none, none[None], none[0], edges, kinds, counts)

    @property
    def max_gain(self) -> float:
        """About the largest log-likelihood gain of silhouettes [nat]."""
        return RIDING.full_gain * self.pictures[..., 0].size

    def mirrored(self) -> "RidingPictures":
        """Return the pictures with left and right exchanged."""
        flipped = (np.flip(image, axis) for image, axis in ((self.pictures, 2), (self.colours, 1)))
        pictures, colours = map(np.ascontiguousarray, flipped)
        deviations = np.ascontiguousarray(np.flip(self.deviations, 1))
        return RidingPictures(pictures, self.gains, colours, deviations, self.alike)

    def contour_terms(self, size: float, weight: float) -> tuple[float, float]:
        """Return a length and a weight as ``Backgrounds.contour_terms`` does; `weight` is not used.

        The length is so large that the sum of the edges counts in place of their mean.
        """
        length = 1e9
        return length, length * RIDING.weight / size

    def changed_frames(self) -> None:
        """Return None: all pixels change, so that changes do not locate the body."""

    def known(self, pictures: Sequence[Picture], covered: Mask, small: Mask) -> "RidingColours":
        """Return the body's colours, see ``RidingColours.of``; `small` is not used."""
        return RidingColours.of(self, pictures, covered)

    def _lasting_edges(self) -> Floats:
        """Return (2, f, H, W) the strength of edges across u and v that last over the images.

        The edges' doubled angles are averaged over images in which the body is posed alike: an edge
        lasts even if the world behind it is brighter than the body in one image, darker in another.
        """
        doubled = []
        for picture in self.pictures:
            u, v = (slope.sum(axis=-1) / 3.0 for slope in colour_slopes(picture))
            size = np.hypot(u, v) + np.float32(1e-6)
            strength = np.minimum(1.0, size / RIDING.edge) / size**2
            doubled.append([strength * (u * u - v * v), strength * 2.0 * u * v])
        tensors, alike = np.array(doubled, np.float32), self.alike
        best = np.zeros((2, *self.pictures.shape[:3]), np.float32)
        for weights in (np.ones_like(alike), alike):
            shares = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
            cos, sin = np.einsum("fg,gchw->cfhw", shares, tensors)
            whole = np.hypot(cos, sin)
            # The mean of n random directions has a length of 1 / sqrt(n); it tells nothing.
            size = (whole - np.sqrt((shares**2).sum(axis=1))[:, None, None]).clip(min=0.0)
            # An edge crosses an axis unless the gradient along the other one is much larger.
            for k, sign in enumerate((1.0, -1.0)):
                length = np.where(sign * cos > -0.5 * whole, size, 0.0)
                best[k] = np.maximum(best[k], length)
        kernel = np.ones((3, 3), np.uint8)
        return np.array([[cv2.dilate(image, kernel) for image in images] for images in best])


@dataclass(frozen=True, eq=False)
class RidingColours(KnownBackground):
    """Colours of a body that moves with the camera, whose pose is approximately known.

    `colours` and `deviations` are those of the body, not of a background; `unseen` is nowhere true.

    Args:
        matches: fractions of the pixels beside the body and on it that match `colours`.
    """

    matches: tuple[float, float]

    @staticmethod
    def of(riding: RidingPictures, pictures: Sequence[Picture], covered: Mask) -> "RidingColours":
        """Estimate the colours.

        ``riding``: estimates from the same frames, at any picture size. ``pictures``: RGB images
        (H, W, 3) of the f frames. ``covered``: (f, H, W) approximate silhouettes of the body.
        """
        size = covered.shape[:0:-1]
        colours, deviations = (
            np.asarray(cv2.resize(k, size), np.float32) for k in (riding.colours, riding.deviations)
        )
        corrected = np.array([apply_gain(*p) for p in zip(pictures, riding.gains, strict=True)])
        inside, outside = ~grown(~covered, MODEL.margin), ~grown(covered, MODEL.margin)
        # A pixel that fingers cover in some frames only has their mean colour there.
        count = inside.sum(axis=0)[..., None]
        mean = (corrected * inside[..., None]).sum(axis=0) / np.maximum(count, 1)
        colours = np.where(count > 1, mean, colours).astype(np.float32)
        match = largest(np.abs(corrected - colours)) / deviations < MODEL.match_deviations
        numbers = np.array(
            [colour_numbers(np.clip(image, 0.0, 255.0).astype(np.uint8)) for image in corrected]
        )
        rates, frequencies = [], []
        for region in (outside, inside):
            rates.append(float(np.clip(match[region].mean() if region.any() else 0.5, 0.05, 0.95)))
            counts = np.bincount(numbers[region], minlength=COLOURS)
            frequencies.append(log_frequencies(counts.astype(np.float64)))
        unseen = np.zeros(covered.shape[1:], np.bool_)
        return RidingColours(
            colours, deviations, unseen, frequencies[1], frequencies[0], (rates[0], rates[1])
        )

    def foreground(
        self, picture: Picture, gain: Floats, window: Window = (slice(None), slice(None))
    ) -> tuple[Floats, Floats]:
        """Return (h, w) and (H, W) log-odds as the base class does; only their size differs."""
        corrected = apply_gain(picture, gain)
        numbers = colour_numbers(np.clip(corrected, 0.0, 255.0).astype(np.uint8))
        ratio = likeness(largest(np.abs(corrected - self.colours)) / self.deviations)
        beside, on = (np.log(m * ratio + (1.0 - m)) for m in self.matches)
        whole = np.asarray(self.on[numbers] - self.beside[numbers] + on - beside)
        return whole[window], whole


def silhouette_gains(sums: PixelSums, covered: Mask, squares: int = 16) -> Array:
    """Return silhouettes' log-likelihood gain about the kinds of pixels, by square tiles [nat].

    The result is (squares, squares), with `squares` tiles along the picture's longer side.

    sums: with the kinds, see ``RidingPictures.sums``. covered: (f, H, W) silhouettes.
    """
    _, height, width = covered.shape
    inside = np.bincount(sums.kinds[np.moveaxis(covered, 0, -1)], minlength=len(sums.counts))
    logs = [
        np.log((pixels + 0.5) / (pixels.sum() + 0.5 * len(pixels)))
        for pixels in (inside, sums.counts - inside, sums.counts)
    ]
    kinds = np.moveaxis(sums.kinds, -1, 0)
    gains = (np.where(covered, logs[0][kinds], logs[1][kinds]) - logs[2][kinds]).sum(axis=0)
    side, tiles = max(width, height) / squares, np.zeros((squares, squares))
    v, u = np.mgrid[:height, :width]
    np.add.at(tiles, ((v / side).astype(int), (u / side).astype(int)), gains)
    return tiles
