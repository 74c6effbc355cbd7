"""Score and segment a body that rides along with a camera, before a world that changes.

Its own joints alone pose a gripper in the picture of a camera on the wrist. Pixels are of kinds:
groups of colours, each with or without the colour that the pixel has in most frames. Silhouettes of
a right pose tell kinds apart: a gripper repeats its colours where the world does not, or it has
other colours than a bare table, which repeats its own. And the gripper's edges last in frames in
which it is posed alike, whatever is behind it.
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
    """Settings for a body that rides along; chosen on simulated wrists of three arms.

    Args:
        share: fraction of the picture that such a body covers, roughly.
        groups: number of groups of colours.
        edge: gradient of an edge of full strength [of 255 per pixel].
        weight: of the edges along the contours, over what the silhouettes tell.
        threshold: strength of a lasting edge that is as likely on a contour as elsewhere.
        full_gain: gain of a pixel at which the silhouettes tell as much as they can [nat].
    """

    share: float = 0.2
    groups: int = 12
    edge: float = 6.0
    weight: float = 2.0
    threshold: float = 0.2
    full_gain: float = 0.35


RIDING = RidingSettings()


@dataclass(frozen=True, eq=False)
class RidingPictures:
    """Small images of a camera that moves, with a body that rides along.

    Args:
        pictures: (f, H, W, 3) images after photometric correction.
        gains: (3, 4) photometric gain of each image, see ``estimate_gain``.
        colours: (H, W, 3) median colours.
        deviations: (H, W) standard deviations of the body's colours.
        alike: (f, f) between 0 and 1 how similarly the body is posed in two frames.
    """

    pictures: Floats
    gains: tuple[Floats, ...]
    colours: Floats
    deviations: Floats
    alike: Array

    @staticmethod
    def estimate(pictures: Picture, alike: Array) -> "RidingPictures":
        """Estimate colours and gains; pictures: (f, H, W, 3) red, green, blue."""
        floats = pictures.astype(np.float32)
        reference = np.median(floats, axis=0)

        def changes(several: Floats) -> Floats:
            return np.asarray(np.median(largest(np.abs(several - reference)), axis=0))

        first = changes(floats)
        # What rides along is among the pixels that change least.
        still = first <= np.quantile(first, 0.5 * RIDING.share)
        gains = tuple(
            estimate_gain(one[still][:, None], reference[still][:, None]) for one in floats
        )
        even = np.array([apply_gain(*one) for one in zip(floats, gains, strict=True)])
        noise = 1.4826 * float(np.quantile(changes(even), 0.25 * RIDING.share))
        return RidingPictures(even, gains, reference, colour_deviations(reference, noise), alike)

    @cached_property
    def sums(self) -> PixelSums:
        """Kinds and edges of the images, for ``explain``."""
        count, (height, width) = len(self.pictures), self.deviations.shape
        some = np.ascontiguousarray(self.pictures.reshape(-1, 3)[:: max(1, count * height // 60)])
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 10, 1.0)
        cv2.setRNGSeed(0)
        groups = min(RIDING.groups, len(some))
        labels = np.zeros((len(some), 1), np.int32)
        _, _, centres = cv2.kmeans(some, groups, labels, stop, 1, cv2.KMEANS_PP_CENTERS)
        kinds = np.empty((height, width, count), np.uint8)
        for f, picture in enumerate(self.pictures):
            off = ((picture[:, :, None] - centres) ** 2).sum(axis=-1)
            repeats = largest(np.abs(picture - self.colours)) / self.deviations
            kinds[:, :, f] = 2 * off.argmin(axis=-1) + (repeats < MODEL.match_deviations)
        counts = np.bincount(kinds.ravel(), minlength=2 * groups).astype(np.float64)
        edges = self._lasting_edges() - np.float32(RIDING.threshold)
        none = np.zeros((1, 1, 1), np.float32)
        return PixelSums(none, none[None], none[0], edges, kinds, counts)

    @property
    def max_gain(self) -> float:
        """About the most that silhouettes tell about the kinds."""
        return RIDING.full_gain * self.pictures[..., 0].size

    def mirrored(self) -> "RidingPictures":
        """Return the pictures with left and right exchanged."""
        flipped = (np.flip(one, axis) for one, axis in ((self.pictures, 2), (self.colours, 1)))
        pictures, colours = map(np.ascontiguousarray, flipped)
        deviations = np.ascontiguousarray(np.flip(self.deviations, 1))
        return RidingPictures(pictures, self.gains, colours, deviations, self.alike)

    def contour_terms(self, size: float, weight: float) -> tuple[float, float]:
        """As of ``Backgrounds``, but edges count by their sum; weight: is not used."""
        longer = 1e9
        return longer, longer * RIDING.weight / size

    def changed_frames(self) -> None:
        """Return None: all pixels change, and changes do not locate the body."""

    def known(self, pictures: Sequence[Picture], covered: Mask, small: Mask) -> "RidingColours":
        """Return the body's colours, see ``RidingColours.of``; small: is not used."""
        return RidingColours.of(self, pictures, covered)

    def _lasting_edges(self) -> Floats:
        """Return (2, f, H, W) the strength of edges across u and v that last between images.

        The mean over images posed alike is taken of the edges' doubled angles: an edge lasts even
        if what is behind it is brighter now, and then darker.
        """
        tensors = []
        for picture in self.pictures:
            u, v = (one.sum(axis=-1) / 3.0 for one in colour_slopes(picture))
            size = np.hypot(u, v) + np.float32(1e-6)
            strength = np.minimum(1.0, size / RIDING.edge) / size**2
            tensors.append([strength * (u * u - v * v), strength * 2.0 * u * v])
        every, alike = np.array(tensors, np.float32), self.alike
        best = np.zeros((2, *self.pictures.shape[:3]), np.float32)
        for weights in (np.ones_like(alike), alike):
            part = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
            cos, sin = np.einsum("fg,gchw->cfhw", part, every)
            whole = np.hypot(cos, sin)
            # The mean of n random directions has a length of 1 / sqrt(n); it tells nothing.
            size = (whole - np.sqrt((part**2).sum(axis=1))[:, None, None]).clip(min=0.0)
            # An edge crosses an axis unless the gradient along the other one is much larger.
            for k, sign in enumerate((1.0, -1.0)):
                own = np.where(sign * cos > -0.5 * whole, size, 0.0)
                best[k] = np.maximum(best[k], own)
        kernel = np.ones((3, 3), np.uint8)
        return np.array([[cv2.dilate(one, kernel) for one in own] for own in best])


@dataclass(frozen=True, eq=False)
class RidingColours(KnownBackground):
    """Colours of a body that rides along, whose pose is approximately known.

    Args:
        matches: fractions of the pixels beside the body and on it that match `colours`, which are
            here the body's own.
    """

    matches: tuple[float, float]

    @staticmethod
    def of(riding: RidingPictures, pictures: Sequence[Picture], covered: Mask) -> "RidingColours":
        """Estimate the colours.

        Args:
            riding: the same frames at any size.
            pictures: images (H, W, 3) of the f frames.
            covered: (f, H, W) approximate silhouettes of the body.
        """
        size = covered.shape[:0:-1]
        colours, deviations = (
            np.asarray(cv2.resize(k, size), np.float32) for k in (riding.colours, riding.deviations)
        )
        even = np.array([apply_gain(*one) for one in zip(pictures, riding.gains, strict=True)])
        inside, outside = ~grown(~covered, MODEL.margin), ~grown(covered, MODEL.margin)
        # Fingers have their own colour where they are in some frames only.
        often = inside.sum(axis=0)[..., None]
        own_colours = (even * inside[..., None]).sum(axis=0) / np.maximum(often, 1)
        colours = np.where(often > 1, own_colours, colours).astype(np.float32)
        match = largest(np.abs(even - colours)) / deviations < MODEL.match_deviations
        numbers = np.array(
            [colour_numbers(np.clip(one, 0.0, 255.0).astype(np.uint8)) for one in even]
        )
        rates, frequencies = [], []
        for own in (outside, inside):
            rates.append(float(np.clip(match[own].mean() if own.any() else 0.5, 0.05, 0.95)))
            counts = np.bincount(numbers[own], minlength=COLOURS)
            frequencies.append(log_frequencies(counts.astype(np.float64)))
        unseen = np.zeros(covered.shape[1:], np.bool_)
        return RidingColours(
            colours, deviations, unseen, frequencies[1], frequencies[0], (rates[0], rates[1])
        )

    def foreground(
        self, picture: Picture, gain: Floats, window: Window = (slice(None), slice(None))
    ) -> tuple[Floats, Floats]:
        """Return log-odds that each pixel of an image shows the body, as the base class does."""
        even = apply_gain(picture, gain)
        numbers = colour_numbers(np.clip(even, 0.0, 255.0).astype(np.uint8))
        ratio = likeness(largest(np.abs(even - self.colours)) / self.deviations)
        beside, on = (np.log(m * ratio + (1.0 - m)) for m in self.matches)
        found = np.asarray(self.on[numbers] - self.beside[numbers] + on - beside)
        return found[window], found


def silhouette_gains(sums: PixelSums, covered: Mask, squares: int = 16) -> Array:
    """Return by square tiles what silhouettes (f, H, W) tell about the kinds [nat].

    The result is (squares, squares), with `squares` tiles along the picture's longer side.
    """
    _, height, width = covered.shape
    inside = np.bincount(sums.kinds[np.moveaxis(covered, 0, -1)], minlength=len(sums.counts))
    logs = [
        np.log((own + 0.5) / (own.sum() + 0.5 * len(own)))
        for own in (inside, sums.counts - inside, sums.counts)
    ]
    kinds = np.moveaxis(sums.kinds, -1, 0)
    gains = (np.where(covered, logs[0][kinds], logs[1][kinds]) - logs[2][kinds]).sum(axis=0)
    side, tiles = max(width, height) / squares, np.zeros((squares, squares))
    v, u = np.mgrid[:height, :width]
    np.add.at(tiles, ((v / side).astype(int), (u / side).astype(int)), gains)
    return tiles
