"""Pictures of a camera that stands still as evidence of a body's pose, without masks.

A body at known positions covers each pixel in some frames; in the others one background shows, or
one of a few, as where something was put down. For a background and a frame, with s the likelihood
ratio of the colour under that background to any colour, likelihoods are

    background shows: .92 s + .08        body shows: .25 s + .75

as backgrounds change now and then, and a body may look like what is behind it. The sum of their
logarithms over the frames, of the best background, scores a set of frames in which the body covers
the pixel (``PixelSums``, ``explain``).

Once a pose is about known, so are the background of each pixel and the probability that a pixel
shows the
body: lines across the contour then measure where its edge is (``fit.colours``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import convolve1d

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.compiled import compiled
from drake_pose.fit.colours import COLOURS, Colour, colour_numbers
from drake_pose.silhouette.outline import PackedOutlines
from drake_pose.silhouette.span_kernel import fill_rows, find_spans, make_rows


@dataclass(frozen=True)
class BackgroundModel:
    """How colours of a body and of what is behind it are distributed.

    Args:
        shown, like_body: the fraction of pixels that look like their background where it shows, and
            where the body covers it.
        log_peak: logarithm of the likelihood ratio of a background's own colour to any colour.
        known_times: this ratio is larger by this factor where it is known which background lies
            behind a pixel.
        exact: colours within this many standard deviations are as likely as the background's own.
        same: colours within this many standard deviations belong to the background.
        shaken: standard deviation of a colour per gradient there [pixel], as cameras shake.
        min_noise: the least standard deviation of a colour [of 255].
        near: half the width of the strip along a contour where either side may show [pixel].
        max_log_odds: log-odds are clipped to this.
        unseen, max_frequent: colours are at least and at most this many times as frequent as any.
    """

    shown: float = 0.92
    like_body: float = 0.25
    log_peak: float = 4.0
    known_times: float = 20.0
    exact: float = 1.5
    same: float = 3.0
    shaken: float = 0.15
    min_noise: float = 1.5
    near: int = 3
    max_log_odds: float = 8.0
    unseen: float = 0.1
    max_frequent: float = 60.0


MODEL = BackgroundModel()


def estimate_gain(picture: Picture | Floats, reference: Floats, rounds: int = 4) -> Floats:
    """(3, 4) gains and offsets of a picture's channels (H, W, 3) that make a reference's light.

    A line is fitted to each channel, without outliers. Gains are between a half and two. Pictures
    are sampled about 160 pixels wide.
    """
    light = np.zeros((3, 4), np.float32)
    step = max(1, picture.shape[1] // 160)
    for channel in range(3):
        both = (one[::step, ::step, channel].ravel() for one in (picture, reference))
        x, y = (np.asarray(one, np.float32) for one in both)
        keep = np.ones(len(x), bool)
        for _ in range(rounds):
            mean_x, mean_y = x[keep].mean(), y[keep].mean()
            off_x = x[keep] - mean_x
            gain = float(off_x @ (y[keep] - mean_y)) / max(float(off_x @ off_x), 1e-6)
            gain = min(max(gain, 0.5), 2.0)
            off = np.abs(gain * (x - mean_x) + mean_y - y)
            keep = off <= 2.0 * (1.5 * np.median(off) + 1.0)
        light[channel, [channel, 3]] = gain, mean_y - gain * mean_x
    return light


def apply_gain(picture: Picture | Floats, light: Floats) -> Floats:
    """A picture (H, W, 3) in the reference's light."""
    return np.asarray(cv2.transform(picture.astype(np.float32), light))


class PixelSums(NamedTuple):
    """Scores of sets of frames in which a body covers a pixel.

    shown: (H, W, 3) log-likelihoods of three backgrounds where no frame is covered. more:
    (H, W, f, 3) what a covered frame adds. none: (H, W) the best of shown. edges: (2, f, H, W)
    strengths of edges across u and v in each frame, beyond chance.
    """

    shown: Floats
    more: Floats
    none: Floats
    edges: Floats


@dataclass(frozen=True, eq=False)
class Backgrounds:
    """What may be behind a body, in small pictures of a camera that stands still.

    Args:
        pictures: (f, H, W, 3) in even light.
        gains: (3, 4) of each picture, see ``estimate_gain``.
        colours: (3, H, W, 3) backgrounds, the most frequent first; they may be alike.
        deviations: (H, W) of a background's colours.
    """

    pictures: Floats
    gains: tuple[Floats, ...]
    colours: Floats
    deviations: Floats

    @staticmethod
    def of(pictures: Picture) -> "Backgrounds":
        """The backgrounds of pictures (f, H, W, 3) red, green, blue."""
        floats = pictures.astype(np.float32)
        reference = np.median(floats, axis=0)
        gains = tuple(estimate_gain(one, reference) for one in floats)
        even = np.array([apply_gain(*one) for one in zip(floats, gains, strict=True)])
        off = np.median(_largest(np.abs(even - reference)), axis=0)
        deviations = _deviations(reference, 1.4826 * float(np.median(off)))
        return Backgrounds(even, gains, _find_colours(even, deviations), deviations)

    @cached_property
    def sums(self) -> PixelSums:
        """What ``explain`` adds up."""
        size, count = self.deviations.shape, len(self.colours)
        total = np.zeros((*size, count), np.float32)
        more = np.empty((*size, len(self.pictures), count), np.float32)
        edges = np.empty((2, *self.pictures.shape[:3]), np.float32)
        noise = float(self.deviations.min())
        for f, picture in enumerate(self.pictures):
            likeness = [_likeness(picture, one, self.deviations) for one in self.colours]
            stacked = np.stack(likeness, axis=-1)
            shown = np.log(MODEL.shown * stacked + (1.0 - MODEL.shown))
            more[:, :, f] = np.log(MODEL.like_body * stacked + (1.0 - MODEL.like_body)) - shown
            total += shown
            u, v = (_largest(np.abs(one)) for one in _slopes(picture))
            # Edges stronger than four standard deviations of the noise count alike. An edge runs
            # across an axis where the slope along the other one is not much more.
            strength = np.minimum(1.0, np.hypot(u, v) / (4.0 * noise))
            for k, (across, along) in enumerate(((u, v), (v, u))):
                own = np.where(along <= 1.7 * across, strength, 0.0)
                edges[k, f] = cv2.dilate(own, np.ones((3, 3), np.uint8))
        return PixelSums(total, more, _largest(total), edges - edges.mean())

    @cached_property
    def possible(self) -> float:
        """The most that any sets of frames could explain."""
        sums = self.sums
        best = _largest(sums.shown + np.maximum(sums.more, 0.0).sum(axis=2))
        return float(np.maximum(best - sums.none, 0.0).sum())

    def changes(self) -> Floats:
        """(H, W) in how many frames a pixel does not look like its most frequent background."""
        found = np.zeros(self.pictures.shape[1:3], np.float32)
        for picture in self.pictures:
            likeness = _likeness(picture, self.colours[0], self.deviations)
            share = cv2.blur(1.0 - likeness / np.float32(np.exp(MODEL.log_peak)), (3, 3))
            found += np.where(share > 0.5, share, 0.0)
        return found

    def showing(self, covered: Mask) -> Mask:
        """(f, H, W) which frames show the likeliest background of a pixel.

        covered: (f, H, W) where the body is known to be, about.
        """
        told = self.sums.shown.copy()
        for f, own in enumerate(covered):
            np.add(told, self.sums.more[:, :, f], out=told, where=own[..., None])
        best = told.argmax(axis=-1)[None, ..., None]
        colours = np.take_along_axis(self.colours, best, axis=0)[0]
        off = _largest(np.abs(self.pictures - colours)) / self.deviations
        return np.asarray((off < MODEL.same) & ~_grown(covered, MODEL.near))


@dataclass(frozen=True, eq=False)
class KnownBackground:
    """What is behind a body whose pose is about known.

    Args:
        colours: (H, W, 3) of the background.
        deviations: (H, W) of them.
        unseen: (H, W) where no frame shows it.
        on, beside: (COLOURS,) logarithms of how frequent colours are on the body, and beside it,
            over how frequent they are among all that there can be.
    """

    colours: Floats
    deviations: Floats
    unseen: Mask
    on: Floats
    beside: Floats

    @staticmethod
    def of(
        pictures: Sequence[Picture], gains: Sequence[Floats], showing: Mask, covered: Mask
    ) -> "KnownBackground":
        """That of pictures (H, W, 3) of any size.

        Args:
            gains: of each.
            showing: (f, h, w) which of them show the background, in smaller pictures.
            covered: (f, H, W) where the body is about.
        """
        height, width = covered.shape[1:]
        total, count = np.zeros((height, width, 3), np.float32), np.zeros((height, width))
        on, beside = (np.zeros(COLOURS) for _ in range(2))
        inside, near = ~_grown(~covered, MODEL.near), _grown(covered, MODEL.near)
        small, means = [], []
        for f, (picture, light) in enumerate(zip(pictures, gains, strict=True)):
            even = apply_gain(picture, light)
            shown = showing[f].astype(np.uint8)
            shown = cv2.resize(shown, (width, height), interpolation=cv2.INTER_NEAREST)
            shows = shown.astype(np.bool_) & ~near[f]
            cv2.accumulate(even, total, mask=shows.view(np.uint8))
            count += shows
            numbers = colour_numbers(np.clip(even, 0.0, 255.0).astype(np.uint8))
            on += np.bincount(numbers[inside[f]], minlength=COLOURS)
            beside += np.bincount(numbers[~near[f]], minlength=COLOURS)
            rows = np.flatnonzero(shows)[::37]
            small.append((rows, even.reshape(-1, 3)[rows]))
        colours = (total / np.maximum(count, 1.0)[..., None]).astype(np.float32)
        means = [_largest(np.abs(own - colours.reshape(-1, 3)[rows])) for rows, own in small]
        off = np.concatenate([*means, np.zeros(1, np.float32)])
        deviations = _deviations(colours, 1.4826 * float(np.median(off)))
        return KnownBackground(
            colours, deviations, count == 0, _log_frequencies(on), _log_frequencies(beside)
        )

    def foreground(self, picture: Picture, light: Floats) -> Floats:
        """(H, W) log-odds that each pixel of a picture shows the body."""
        even = apply_gain(picture, light)
        numbers = colour_numbers(np.clip(even, 0.0, 255.0).astype(np.uint8))
        likeness = _likeness(even, self.colours, self.deviations) * np.float32(MODEL.known_times)
        shown = np.log(MODEL.shown * likeness + (1.0 - MODEL.shown))
        return np.asarray(self.on[numbers] - np.where(self.unseen, self.beside[numbers], shown))


def foreground_picture(foreground: Floats) -> Picture:
    """Encode log-odds (H, W) as a picture (H, W, 3); ``foreground_of_colours`` decodes it."""
    most = MODEL.max_log_odds
    share = (np.clip(foreground, -most, most) + most) / (2.0 * most)
    number = np.rint(share * (COLOURS - 1)).astype(np.uint16)
    channels = (number >> 8, (number >> 4) & 15, number & 15)
    return np.stack([(one << 4).astype(np.uint8) for one in channels], axis=-1)


def foreground_of_colours(nodes: int) -> Floats:
    """Tables (nodes, 3, COLOURS) that decode a ``foreground_picture`` for `compare_lines`."""
    known = np.zeros((nodes, len(Colour), COLOURS), np.float32)
    known[:, Colour.FOREGROUND] = np.exp(
        np.linspace(-MODEL.max_log_odds, MODEL.max_log_odds, COLOURS)
    )
    return known


def mask_of_foreground(
    foreground: Floats, covered: Mask, smooth: float = 0.7, reach: float = 0.1
) -> Mask:
    """Where log-odds (H, W) are for the body.

    Args:
        foreground: (H, W) log-odds.
        covered: (H, W) where the body is about.
        smooth: standard deviation of the Gaussian that smooths the log-odds [pixel].
        reach: a mask ends within this distance of where the body is about [root of its area].
    """
    limit = max(MODEL.near, round(reach * float(np.sqrt(np.count_nonzero(covered)))))
    near = _grown(covered[None], limit)[0]
    found = ((cv2.GaussianBlur(foreground, (0, 0), smooth) > 0.0) & near).astype(np.uint8)
    found = cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)), bool)


def _largest(channels: Floats) -> Floats:
    """(...) the largest of three numbers (..., 3), ten times faster than numpy finds it."""
    red, green, blue = np.moveaxis(channels, -1, 0)
    return np.maximum(np.maximum(red, green), blue)


def _slopes(picture: Floats) -> tuple[Floats, Floats]:
    """(H, W, 3) how colours change along u and v [a pixel]."""
    u, v = (cv2.Sobel(picture, cv2.CV_32F, *by, scale=0.125) for by in ((1, 0), (0, 1)))
    return np.asarray(u), np.asarray(v)


def _deviations(picture: Floats, noise: float) -> Floats:
    """(H, W) of the colours of a background (H, W, 3)."""
    gradient = _largest(np.hypot(*_slopes(picture)))
    white = max(MODEL.min_noise, noise)
    return np.sqrt(white**2 + (MODEL.shaken * gradient) ** 2).astype(np.float32)


def _grown(masks: Mask, by: int) -> Mask:
    """(f, H, W) masks that are larger on all sides by a number of pixels."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by + 1,) * 2)
    return np.array([cv2.dilate(one.astype(np.uint8), disc) for one in masks]).astype(np.bool_)


def _likeness(pictures: Floats, colours: Floats, deviations: Floats) -> Floats:
    """(..., H, W) likelihood ratios of colours (..., H, W, 3) under a background to any colour."""
    off = _largest(np.abs(pictures - colours)) / deviations
    beyond = np.maximum(off - MODEL.exact, 0.0)
    return np.asarray(np.exp(MODEL.log_peak - 0.5 * beyond**2), np.float32)


def _log_frequencies(numbers: Array) -> Floats:
    """(COLOURS,) logarithms of how frequent colours are of (COLOURS,) pixels; neighbours share."""
    counts = numbers.reshape(16, 16, 16)
    for axis in range(3):
        counts = convolve1d(counts, [0.25, 0.5, 0.25], axis, mode="nearest")
    times = COLOURS * counts.ravel() / max(float(counts.sum()), 1.0)
    return np.log(np.minimum(times, MODEL.max_frequent) + MODEL.unseen).astype(np.float32)


def _find_colours(pictures: Floats, deviations: Floats, rows: int = 8) -> Floats:
    """(3, H, W, 3) the colours that most frames share, then those that most of the others do.

    Colours of all pairs of frames are compared, in strips of rows that stay in the cache.
    """
    strips = []
    for k in range(0, pictures.shape[1], rows):
        own, count = pictures[:, k : k + rows], len(pictures)
        off = np.zeros((count, count, *own.shape[1:3]), np.float32)
        for f, picture in enumerate(own):
            off[f, f:] = _largest(np.abs(own[f:] - picture)) / deviations[k : k + rows]
            off[f:, f] = off[f, f:]
        close = off < MODEL.same
        # Of equal numbers the closer ones.
        support = np.where(close, np.float32(1.0) - np.float32(0.01) * off, np.float32(0.0))
        left, found = np.ones(own.shape[:3], bool), list[Floats]()
        for _ in range(3):
            told = np.einsum("fghw,ghw->fhw", support, left.astype(np.float32))
            best = np.where(left, told, -1.0).argmax(axis=0)
            shared = np.take_along_axis(close, best[None, None], axis=0)[0] & left
            number = shared.sum(axis=0)[..., None]
            mean = (own * shared[..., None]).sum(axis=0) / np.maximum(number, 1)
            found.append(np.where(number > 0, mean, found[0] if found else mean).astype(np.float32))
            left &= ~shared
        strips.append(np.array(found))
    return np.concatenate(strips, axis=1)


class Explained(IntEnum):
    """What ``explain`` sums up.

    GAIN: the log-likelihood beyond that of no body. CONTOUR: the edges' strength beyond chance
    along the outlines. OUTLINE: their length [pixel]. AREA: the bodies' [pixel].
    """

    GAIN = 0
    CONTOUR = 1
    OUTLINE = 2
    AREA = 3


@compiled
def explain(
    packed: PackedOutlines,
    X_CN: Array,
    still: Mask,
    camera: Array,
    sums: PixelSums,
    side: float,
    squares: int,
    always_covered: float = 0.3,
) -> tuple[Array, Array]:
    """What a body explains of pictures, by sums over the pixels.

    Bits of a word for each pixel say in which frames the body covers it. The words' edges are the
    body's outline in each frame.

    Args:
        packed: the nodes' surfaces.
        X_CN: (f, nodes, 3, 4) where they stand in the frames.
        still: (nodes,) which nodes stand at one place in all frames: they are their own background,
            so that only their outline counts.
        camera: (8,) kernel parameters.
        sums: of the pictures.
        side, squares: the gain is also told by (squares, squares) squares of a side [pixel]; 0:
            it is not.
        always_covered: factor of the gain of pixels that the body covers in all frames, whose
            background is not known.

    Returns:
        (4,) sums by ``Explained``; (squares, squares) the gain in each square.
    """
    height, width = sums.none.shape
    frames, one = X_CN.shape[0], np.uint64(1)
    told, pieces = np.zeros(4), np.zeros((squares, squares))
    words = np.zeros((height, width), dtype=np.uint64)
    rows, crossings = make_rows(packed, camera)
    top, bottom = height, 0
    for f in range(frames):
        for node in range(X_CN.shape[1]):
            crossings = fill_rows(packed, node, node + 1, X_CN[f], camera, crossings, rows)
            top, bottom = min(top, rows.reach[0]), max(bottom, rows.reach[1])
            # Higher bits are those of what stands still.
            bit = one << np.uint64(f + frames if still[node] else f)
            for row in range(rows.reach[0], rows.reach[1]):
                for k in range(find_spans(row, crossings, rows.counts, rows.changes, rows.spans)):
                    for column in range(rows.spans[k, 0], rows.spans[k, 1]):
                        words[row, column] |= bit
    every = (one << np.uint64(frames)) - one
    for row in range(top, bottom):
        for column in range(width):
            word = words[row, column]
            if word == 0:
                continue
            covered = word & every
            if covered != 0:
                a, b, c = sums.shown[row, column]
                left, f = covered, 0
                while left != 0:
                    if left & one:
                        told[Explained.AREA] += 1.0
                        a += sums.more[row, column, f, 0]
                        b += sums.more[row, column, f, 1]
                        c += sums.more[row, column, f, 2]
                    left >>= one
                    f += 1
                gain = max(a, b, c) - sums.none[row, column]
                if covered == every:
                    gain = always_covered * max(gain, 0.0)
                told[Explained.GAIN] += gain
                if squares > 0:
                    pieces[int(row / side) % squares, int(column / side) % squares] += gain
            left_of = words[row, column - 1] if column > 0 else word
            right_of = words[row, column + 1] if column < width - 1 else word
            above = words[row - 1, column] if row > 0 else word
            below = words[row + 1, column] if row < height - 1 else word
            across_u, across_v = word & ~(left_of & right_of), word & ~(above & below)
            left, f = across_u | across_v, 0
            while left != 0:
                if left & one:
                    strength = -np.inf
                    if across_u >> np.uint64(f) & one:
                        strength = sums.edges[0, f % frames, row, column]
                    if across_v >> np.uint64(f) & one:
                        strength = max(strength, sums.edges[1, f % frames, row, column])
                    told[Explained.CONTOUR] += strength
                    told[Explained.OUTLINE] += 1.0
                left >>= one
                f += 1
    return told, pieces
