"""Score poses of a body against images of a static camera, without masks.

At given body positions the body covers a pixel in some frames; in the others the pixel shows one of
at most three background colours. With s the likelihood ratio of a pixel's colour under a background
to any colour, the likelihoods of a pixel in one frame are

    background visible: 0.92 s + 0.08        body visible: 0.25 s + 0.75

because a background changes now and then, and a body may resemble its background. Log-likelihoods
are summed over the frames for the best background of each pixel (``fit.explain_kernel``).

Once the pose is approximately known, so are the background of each pixel and the log-odds that the
pixel shows the body. Search lines across the contour then locate its edge (``fit.colours``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.ndimage import convolve1d

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.fit.colours import COLOURS, Colour, colour_numbers
from drake_pose.fit.explain_kernel import PixelSums
from drake_pose.workers import map_ordered


@dataclass(frozen=True)
class BackgroundModel:
    """Colour distributions of a body and of its background.

    Args:
        visible_match, covered_match: fraction of pixels that look like their background where the
            background is visible, and where the body covers it.
        log_peak: logarithm of the likelihood ratio of a background's own colour to any colour.
        known_factor: factor of this ratio where a pixel's background is known.
        core_deviations: colours within this many standard deviations are as likely as the
            background's own.
        match_deviations: colours within this many standard deviations belong to the background.
        shake: standard deviation of the image shift caused by camera shake [pixel].
        spread, reach: compression adds noise to the surroundings of what differs from the
            background: this fraction of the largest difference within `reach` pixels. Chosen on
            simulated videos (H.264, AV1) and on DROID's; 0: none.
        min_noise: minimum standard deviation of a colour [of 255].
        margin: half width of the strip along a contour in which either side may be visible [pixel].
        max_log_odds: log-odds are clipped to this magnitude.
        base_frequency: added to relative colour frequencies, so that an unobserved colour stays
            possible.
        max_frequency: maximum of a relative colour frequency (1: all colours equally frequent).
    """

    visible_match: float = 0.92
    covered_match: float = 0.25
    log_peak: float = 4.0
    known_factor: float = 20.0
    core_deviations: float = 1.5
    match_deviations: float = 3.0
    shake: float = 0.15
    spread: float = 0.06
    reach: int = 4
    min_noise: float = 1.5
    margin: int = 3
    max_log_odds: float = 8.0
    base_frequency: float = 0.1
    max_frequency: float = 60.0


MODEL = BackgroundModel()

Window = tuple[slice, slice]
"""Rows and columns of a picture."""


def estimate_gain(picture: Picture | Floats, reference: Floats, rounds: int = 4) -> Floats:
    """Return the photometric gain that maps an image's colours to those of a reference image.

    A robust line is fitted to each channel, on about 80 sampled columns. Slopes are limited to the
    range 0.5 to 2.

    Args:
        picture: (H, W, 3) image.
        reference: (H, W, 3) reference image.
        rounds: number of fits; each uses the pixels that deviate from the previous one by no more
            than three median deviations plus 2 [of 255].

    Returns (3, 4) slopes and offsets of the channels, as ``cv2.transform`` takes them.
    """
    gain = np.zeros((3, 4), np.float32)
    step = max(1, picture.shape[1] // 80)
    for channel in range(3):
        both = (one[::step, ::step, channel].ravel() for one in (picture, reference))
        x, y = (np.asarray(one, np.float32) for one in both)
        keep = np.ones(len(x), bool)
        for _ in range(rounds):
            mean_x, mean_y = x[keep].mean(), y[keep].mean()
            off_x = x[keep] - mean_x
            slope = float(off_x @ (y[keep] - mean_y)) / max(float(off_x @ off_x), 1e-6)
            slope = min(max(slope, 0.5), 2.0)
            deviation = np.abs(slope * (x - mean_x) + mean_y - y)
            keep = deviation <= 2.0 * (1.5 * np.median(deviation) + 1.0)
        gain[channel, [channel, 3]] = slope, mean_y - slope * mean_x
    return gain


def apply_gain(picture: Picture | Floats, gain: Floats) -> Floats:
    """Return an image (H, W, 3) as float32 with a gain (3, 4) of ``estimate_gain``; not clipped."""
    return np.asarray(cv2.transform(picture.astype(np.float32), gain))


@dataclass(frozen=True, eq=False)
class Backgrounds:
    """Possible backgrounds of a body, in small images of a static camera."""

    pictures: Floats  # (f, H, W, 3) images after photometric correction.
    gains: tuple[Floats, ...]  # (3, 4) photometric gain of each image, see ``estimate_gain``.
    colours: Floats  # (3, H, W, 3) background colours, the most frequent first; they may coincide.
    deviations: Floats  # (H, W) standard deviations of a background's colours.

    @staticmethod
    def estimate(pictures: Picture) -> "Backgrounds":
        """Estimate the backgrounds of a static camera's images (f, H, W, 3) red, green, blue."""
        floats = pictures.astype(np.float32)
        reference = _median(floats)
        gains = tuple(map_ordered(lambda one: estimate_gain(one, reference), floats))
        even = np.array([apply_gain(*one) for one in zip(floats, gains, strict=True)])
        deviation = _median(largest(np.abs(even - reference)))
        deviations = colour_deviations(reference, 1.4826 * float(np.median(deviation)))
        return Backgrounds(even, gains, _find_colours(even, deviations), deviations)

    def mirrored(self) -> "Backgrounds":
        """Return the backgrounds of the images with left and right exchanged."""
        sums, gains = self.sums, self.gains
        visible, covered, uncovered, edges, pictures, colours, deviations = (
            np.ascontiguousarray(np.flip(one, axis))
            for one, axis in (
                (sums.visible, 1), (sums.covered, 1), (sums.uncovered, 1), (sums.edges, 3),
                (self.pictures, 2), (self.colours, 2), (self.deviations, 1),
            )
        )  # fmt: skip
        other = Backgrounds(pictures, gains, colours, deviations)
        vars(other)["sums"] = PixelSums(visible, covered, uncovered, edges)
        return other

    @cached_property
    def sums(self) -> PixelSums:
        """Log-likelihoods and edges of the images, for ``explain``."""
        size, count = self.deviations.shape, len(self.colours)
        visible = np.zeros((*size, count), np.float32)
        covered = np.empty((*size, len(self.pictures), count), np.float32)
        edges = np.empty((2, *self.pictures.shape[:3]), np.float32)
        noise = float(self.deviations.min())

        def score(f: int) -> Floats:
            """Fill in the sums of one frame, and return log-likelihoods of its backgrounds."""
            picture = self.pictures[f]
            likeness = [self._likeness(picture, one) for one in self.colours]
            stacked = np.stack(likeness, axis=-1)
            log_visible = np.log(MODEL.visible_match * stacked + (1.0 - MODEL.visible_match))
            covered[:, :, f] = (
                np.log(MODEL.covered_match * stacked + (1.0 - MODEL.covered_match)) - log_visible
            )
            u, v = (largest(np.abs(one)) for one in colour_slopes(picture))
            # Strength saturates at four standard deviations of the noise. An edge crosses an axis
            # unless the gradient along the other axis is much larger.
            strength = np.minimum(1.0, np.hypot(u, v) / (4.0 * noise))
            for k, (across, along) in enumerate(((u, v), (v, u))):
                own = np.where(along <= 1.7 * across, strength, 0.0)
                edges[k, f] = cv2.dilate(own, np.ones((3, 3), np.uint8))
            return np.asarray(log_visible)

        for log_visible in map_ordered(score, range(len(self.pictures))):
            visible += log_visible
        return PixelSums(visible, covered, largest(visible), edges - edges.mean())

    @cached_property
    def max_gain(self) -> float:
        """Upper bound of the log-likelihood gain over all sets of covered frames."""
        sums = self.sums
        best = largest(sums.visible + np.maximum(sums.covered, 0.0).sum(axis=2))
        return float(np.maximum(best - sums.uncovered, 0.0).sum())

    def changed_frames(self) -> Floats:
        """Return (H, W) the number of frames that differ from the most frequent background.

        A frame counts as a number between 0.5 and 1, by how much it differs, or not at all.
        """
        counts = np.zeros(self.pictures.shape[1:3], np.float32)
        for picture in self.pictures:
            likeness = self._likeness(picture, self.colours[0])
            difference = cv2.blur(1.0 - likeness / np.float32(np.exp(MODEL.log_peak)), (3, 3))
            counts += np.where(difference > 0.5, difference, 0.0)
        return counts

    def _likeness(self, picture: Floats, colours: Floats) -> Floats:
        """Return the likelihood ratios (H, W), see ``likeness``, under a background (H, W, 3)."""
        return likeness(largest(np.abs(picture - colours)) / self.deviations)

    def shows_background(self, covered: Mask) -> Mask:
        """Return (f, H, W) whether a frame shows the likeliest background of a pixel.

        The colour must be within MODEL.match_deviations of that background's, and the pixel more
        than MODEL.margin from the approximate silhouettes ``covered`` (f, H, W).
        """
        likelihoods = self.sums.visible.copy()
        for f, own in enumerate(covered):
            likelihoods += np.where(own[:, :, None], self.sums.covered[:, :, f], np.float32(0.0))
        best = likelihoods.argmax(axis=2)[None, :, :, None]
        colours = np.take_along_axis(self.colours, best, axis=0)[0]
        off = [largest(np.abs(picture - colours)) / self.deviations for picture in self.pictures]
        return (np.array(off) < MODEL.match_deviations) & ~grown(covered, MODEL.margin)


@dataclass(frozen=True, eq=False)
class KnownBackground:
    """The background of a body whose pose is approximately known."""

    colours: Floats  # (H, W, 3) colours of the background.
    deviations: Floats  # (H, W) their standard deviations.
    unseen: Mask  # (H, W) whether no frame shows the background at a pixel.
    # on, beside: (COLOURS,) logarithms of the relative frequencies of colours on the body, and
    # beside it (0: as frequent as if all colours were equally frequent).
    on: Floats
    beside: Floats

    @staticmethod
    def estimate(
        pictures: Sequence[Picture],
        gains: Sequence[Floats],
        showing: Mask,
        covered: Mask,
        at_once: int = 4,
    ) -> "KnownBackground":
        """Estimate the background from images of a static camera, of any size.

        Args:
            pictures: images (H, W, 3) of the f frames.
            gains: (3, 4) photometric gain of each image.
            showing: (f, h, w) whether a frame shows the background, at a lower resolution.
            covered: (f, H, W) approximate silhouettes of the body.
            at_once: number of frames in memory with corrected colours.
        """
        height, width = covered.shape[1:]
        total, count = np.zeros((height, width, 3), np.float32), np.zeros((height, width))
        on, beside = (np.zeros(COLOURS) for _ in range(2))
        inside, near = ~grown(~covered, MODEL.margin), grown(covered, MODEL.margin)
        samples = []

        def look(f: int) -> tuple[Floats, Mask, Array, Array]:
            """Return a frame's even colours, where it shows the background, and two histograms."""
            even = apply_gain(pictures[f], gains[f])
            shown = showing[f].astype(np.uint8)
            shown = cv2.resize(shown, (width, height), interpolation=cv2.INTER_NEAREST)
            numbers = colour_numbers(np.clip(even, 0.0, 255.0).astype(np.uint8))
            counts = (np.bincount(numbers[own], minlength=COLOURS) for own in (inside[f], ~near[f]))
            return even, shown.astype(np.bool_) & ~near[f], *counts

        for k in range(0, len(covered), at_once):
            some = range(k, min(k + at_once, len(covered)))
            for even, shows, own_on, own_beside in map_ordered(look, some):
                cv2.accumulate(even, total, mask=shows.view(np.uint8))
                count += shows
                on += own_on
                beside += own_beside
                rows = np.flatnonzero(shows)[::37]
                samples.append((rows, even.reshape(-1, 3)[rows]))
        colours = (total / np.maximum(count, 1.0)[..., None]).astype(np.float32)
        differences = [largest(np.abs(own - colours.reshape(-1, 3)[rows])) for rows, own in samples]
        noise = np.concatenate([*differences, np.zeros(1, np.float32)])
        deviations = colour_deviations(colours, 1.4826 * float(np.median(noise)))
        return KnownBackground(
            colours, deviations, count == 0, log_frequencies(on), log_frequencies(beside)
        )

    def part(self, part: tuple[slice, slice]) -> "KnownBackground":
        """Return the background in some rows and columns."""
        return replace(
            self,
            colours=self.colours[part],
            deviations=self.deviations[part],
            unseen=self.unseen[part],
        )

    def resized(self, width: int, height: int) -> "KnownBackground":
        """Return the background in pictures of another size [pixel]."""
        size, unseen = (width, height), self.unseen.view(np.uint8)
        return replace(
            self,
            colours=np.asarray(
                cv2.resize(self.colours, size, interpolation=cv2.INTER_AREA), np.float32
            ),
            deviations=np.asarray(
                cv2.resize(self.deviations, size, interpolation=cv2.INTER_AREA), np.float32
            ),
            unseen=cv2.resize(unseen, size, interpolation=cv2.INTER_NEAREST).astype(np.bool_),
        )

    def foreground(self, picture: Picture, gain: Floats, window: Window) -> tuple[Floats, Floats]:
        """Return (h, w) and (H, W) log-odds that each pixel of an image shows the body.

        In the first, each pixel counts as it is; it yields complete masks. The second allows for
        the noise of compressed images near large differences, which would shift contours outwards.

        ``picture``: (H, W, 3) image. ``gain``: (3, 4) its photometric gain. ``window``: h rows and
        w columns of the first log-odds.
        """
        even = apply_gain(picture, gain)
        numbers = colour_numbers(np.clip(even, 0.0, 255.0).astype(np.uint8))
        on, beside = self.on[numbers], self.beside[numbers]
        difference = largest(np.abs(even - self.colours))
        near = np.float32(MODEL.spread) * cv2.dilate(difference, _disc(MODEL.reach))

        def log_odds(deviations: Floats, part: Window) -> Floats:
            ratio = likeness(difference[part] / deviations[part]) * np.float32(MODEL.known_factor)
            log_visible = np.log(MODEL.visible_match * ratio + (1.0 - MODEL.visible_match))
            return np.asarray(on[part] - np.where(self.unseen[part], beside[part], log_visible))

        tolerant = np.hypot(self.deviations, near)
        return log_odds(self.deviations, window), log_odds(tolerant, (slice(None), slice(None)))


def foreground_picture(foreground: Floats) -> Picture:
    """Return an image (H, W, 3) that encodes the log-odds (H, W) that pixels show the body.

    They are clipped to MODEL.max_log_odds; their histogram index as a colour grows linearly with
    them. ``foreground_of_colours`` has the tables to decode the image.
    """
    limit = MODEL.max_log_odds
    fraction = (np.clip(foreground, -limit, limit) + limit) / (2.0 * limit)
    number = np.rint(fraction * (COLOURS - 1)).astype(np.uint16)
    channels = (number >> 8, (number >> 4) & 15, number & 15)
    return np.stack([(one << 4).astype(np.uint8) for one in channels], axis=-1)


def foreground_of_colours(nodes: int) -> Floats:
    """Return (nodes, 3, COLOURS) tables with which `compare_lines` decodes a foreground_picture.

    For each of a number of nodes, row ``Colour.FOREGROUND`` has the odds that each colour encodes;
    the other rows are 0.
    """
    tables = np.zeros((nodes, len(Colour), COLOURS), np.float32)
    tables[:, Colour.FOREGROUND] = np.exp(
        np.linspace(-MODEL.max_log_odds, MODEL.max_log_odds, COLOURS)
    )
    return tables


def window_around(covered: Mask, by: int) -> Window:
    """Return the rows and columns that the True pixels of (H, W) span, and ``by`` more around."""
    left, top, width, height = cv2.boundingRect(covered.view(np.uint8))
    rows, columns = (slice(max(k - by, 0), k + n + by) for k, n in ((top, height), (left, width)))
    return rows, columns


def mask_reach(covered: Mask, reach: float = 0.1) -> int:
    """Return how far masks may exceed a silhouette (H, W) [pixel], by its size or MODEL.margin."""
    return max(MODEL.margin, round(reach * float(np.sqrt(np.count_nonzero(covered)))))


def mask_of_foreground(
    foreground: Floats,
    covered: Mask,
    tolerant: Floats,
    *,
    smooth: float = 0.7,
    rim: int = 2,
    least: float = -1.0,
) -> Mask:
    """Return a mask (H, W) of the pixels that more likely show the body than the background.

    Args:
        foreground: (H, W) log-odds.
        covered: (H, W) approximate silhouette of the body; the mask stays within ``mask_reach``.
        tolerant: (H, W) log-odds that allow for the noise of compressed images; they decide in the
            mask's rim.
        smooth: standard deviation of the Gaussian that smooths the log-odds [pixel].
        rim: width of the rim [pixel].
        least: pixels of the rim stay whose tolerant log-odds are larger. Chosen on simulated arms:
            masks in PNG files stay as they are, those in videos lose their halo.
    """
    near = grown(covered[None], mask_reach(covered))[0]
    found = ((cv2.GaussianBlur(foreground, (0, 0), smooth) > 0.0) & near).astype(np.uint8)
    found = cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    found = cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    # Beside the body, an encoder spreads differences over a pixel or two.
    inner = cv2.erode(found, _disc(rim))
    found = np.where(cv2.GaussianBlur(tolerant, (0, 0), smooth) > least, found, inner)
    return np.asarray(found, bool)


def largest(channels: Floats) -> Floats:
    """Return the maximum over the last axis of (..., 3), ten times faster than numpy does."""
    red, green, blue = np.moveaxis(channels, -1, 0)
    return np.maximum(np.maximum(red, green), blue)


def _in_strips(of_rows: Callable[[slice], Floats], height: int, rows: int = 8) -> list[Floats]:
    """Return what a function returns of each strip of ``rows`` rows, which fit in the cache."""
    return map_ordered(of_rows, [slice(k, k + rows) for k in range(0, height, rows)])


def _median(pictures: Floats) -> Floats:
    """Return the median over the first axis of (f, H, ...)."""
    height = pictures.shape[1]
    return np.concatenate(
        _in_strips(lambda rows: np.asarray(np.median(pictures[:, rows], axis=0)), height)
    )


def colour_slopes(picture: Floats) -> tuple[Floats, Floats]:
    """Return the gradients of an image along u and along v, each (H, W, 3) [per pixel]."""
    u, v = (cv2.Sobel(picture, cv2.CV_32F, *by, scale=0.125) for by in ((1, 0), (0, 1)))
    return np.asarray(u), np.asarray(v)


def colour_deviations(picture: Floats, noise: float) -> Floats:
    """Return (H, W) standard deviations of a background's colours (H, W, 3) [of 255].

    They combine the noise, at least MODEL.min_noise, and shake, in proportion to the gradient.
    """
    gradient = largest(np.hypot(*colour_slopes(picture)))
    white = max(MODEL.min_noise, noise)
    return np.sqrt(white**2 + (MODEL.shake * gradient) ** 2).astype(np.float32)


def _disc(radius: int) -> Picture:
    """Return a disc (n, n) of ones whose radius is given [pixel], for ``cv2.dilate``."""
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2), np.uint8)


def grown(masks: Mask, by: int) -> Mask:
    """Return masks (f, H, W) dilated by a disc whose radius is ``by`` pixels."""
    disc = _disc(by)
    grown = map_ordered(lambda one: cv2.dilate(one.view(np.uint8), disc), masks)
    return np.array(grown).view(np.bool_)


def likeness(deviations: Floats) -> Floats:
    """Return likelihood ratios background to any colour, of deviations in standard deviations."""
    beyond = np.maximum(deviations - MODEL.core_deviations, 0.0)
    return np.asarray(np.exp(MODEL.log_peak - 0.5 * beyond**2), np.float32)


def log_frequencies(numbers: Array) -> Floats:
    """Return (COLOURS,) log relative colour frequencies, smoothed over neighbouring colours.

    Args:
        numbers: (COLOURS,) number of pixels of each colour.
    """
    counts = numbers.reshape((16,) * 3)
    for axis in range(3):
        counts = convolve1d(counts, [0.25, 0.5, 0.25], axis, mode="nearest")
    times = COLOURS * counts.ravel() / max(float(counts.sum()), 1.0)
    return np.log(np.minimum(times, MODEL.max_frequency) + MODEL.base_frequency).astype(np.float32)


def _find_colours(pictures: Floats, deviations: Floats) -> Floats:
    """Return (3, H, W, 3) the colours shared by most frames, then by most of the remaining frames.

    The colours of all pairs of frames are compared.

    ``pictures``: (f, H, W, 3) images after photometric correction. ``deviations``: (H, W) standard
    deviations of a background's colours.
    """

    def find(rows: slice) -> Floats:
        own, count = pictures[:, rows], len(pictures)
        deviation = np.zeros((count, count, *own.shape[1:3]), np.float32)
        for f, picture in enumerate(own):
            deviation[f, f:] = largest(np.abs(own[f:] - picture)) / deviations[rows]
            deviation[f:, f] = deviation[f, f:]
        close = deviation < MODEL.match_deviations
        # Among colours with equally many supporters prefer the closer ones.
        support = np.where(close, np.float32(1.0) - np.float32(0.01) * deviation, np.float32(0.0))
        remaining, found = np.ones(own.shape[:3], bool), list[Floats]()
        for _ in range(3):
            totals = np.einsum("fghw,ghw->fhw", support, remaining.astype(np.float32))
            best = np.where(remaining, totals, -1.0).argmax(axis=0)
            shared = np.take_along_axis(close, best[None, None], axis=0)[0] & remaining
            number = shared.sum(axis=0)[..., None]
            mean = (own * shared[..., None]).sum(axis=0) / np.maximum(number, 1)
            found.append(np.where(number > 0, mean, found[0] if found else mean).astype(np.float32))
            remaining &= ~shared
        return np.array(found)

    return np.concatenate(_in_strips(find, pictures.shape[1]), axis=1)
