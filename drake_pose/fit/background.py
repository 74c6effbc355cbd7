"""Pictures of a camera that stands still as evidence of a body's pose, without masks.

A body at known positions covers each pixel in some frames; in the others one background shows. So a
pixel's colours over the frames say how well a set of frames fits in which the body covers it. A
pixel may have a few backgrounds, as where something was put down. For a background and a frame,
with s how much likelier the colour is under that background than any colour, likelihoods are

    background shows: .92 s + .08        body shows: .25 s + .75

as backgrounds change now and then, and a body may look like what is behind it. The sum of their
logarithms over the frames, of the best background, is what a pixel says of a set (``PixelSums``).

Once a pose is about known, which background lies behind each pixel is, too, and so are the odds of
each pixel of a frame to show the body: lines across the contour then say where its edge is
(``fit.colour_lines``), as they do in pictures whose colours are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.fit.background_kernel import PixelSums
from drake_pose.fit.colour_lines import COLOURS, ODDS

_BACKGROUNDS = 3
# Shares of what looks like its background where that shows, and where the body does.
_SHOWN, _LIKE_BODY = 0.92, 0.25
# The logarithm of how much likelier a background's own colour is than any colour.
_LOG_PEAK = 4.0
# Where one of a few backgrounds is known to be behind a pixel, its own colour is so many times
# likelier still: what looks like it to the noise is hardly ever a body of about the same colour.
_KNOWN_TIMES = 20.0
# Deviations within which a colour is as good as its background's, and is counted among it.
_EXACT, _SAME = 1.5, 3.0
# Beside noise, a colour is off by this share of the gradient there, as cameras shake; and noise is
# no less than this [of 255].
_SHAKEN, _LEAST_NOISE = 0.15, 1.5
# Edges are as strong as they count from so many deviations of noise on; they run across an axis
# where their slope along the other one is no more than so many times that along it.
_STRONG, _ALIGNED = 4.0, 1.7
# Logarithms of odds beyond this are as good as this.
_MOST_ODDS = 8.0
# For masks odds are smoothed so far [pixel]; and a mask ends so far at most from where the body
# should be [root of its area].
_SMOOTH, _REACH = 0.7, 0.1
# So near to its contour a body may be on either side [pixel].
_NEAR = 3
# Backgrounds are looked for in so many rows at once, which stay in the processor's cache.
_ROWS = 8
# Of a background's pixels every how manieth tells its noise.
_SAMPLE = 37
# Colours that a body or a background was not seen to have are as likely as this share of any.
_UNSEEN_COLOUR = 0.1
# So many times as likely as any colour is one at most.
_MOST_FREQUENT = 60.0
# Light is evened in so many rounds, without pixels that are off by more deviations; gains beyond
# these are none. It is told in pictures about so wide [pixel].
_LIGHT_ROUNDS, _LIGHT_OUTLIERS, _GAINS, _LIGHT_WIDTH = 4, 2.0, (0.5, 2.0), 160


class Light(NamedTuple):
    """By which gain and offset (3,) each a picture's channels have a reference's light."""

    gain: Floats
    offset: Floats

    @staticmethod
    def between(picture: Picture | Floats, reference: Floats) -> Light:
        """That of a picture (H, W, 3), without what differs otherwise."""
        light = Light(np.ones(3, np.float32), np.zeros(3, np.float32))
        step = max(1, picture.shape[1] // _LIGHT_WIDTH)
        for channel in range(3):
            both = (one[::step, ::step, channel].ravel() for one in (picture, reference))
            x, y = (np.asarray(one, np.float32) for one in both)
            keep = np.ones(len(x), bool)
            for _ in range(_LIGHT_ROUNDS):
                mean_x, mean_y = x[keep].mean(), y[keep].mean()
                off_x = x[keep] - mean_x
                gain = float(off_x @ (y[keep] - mean_y)) / max(float(off_x @ off_x), 1e-6)
                gain = min(max(gain, _GAINS[0]), _GAINS[1])
                off = np.abs(gain * (x - mean_x) + mean_y - y)
                keep = off <= _LIGHT_OUTLIERS * (1.5 * np.median(off) + 1.0)
            light.gain[channel], light.offset[channel] = gain, mean_y - gain * mean_x
        return light

    def evened(self, picture: Picture | Floats) -> Floats:
        """A picture (H, W, 3) in the reference's light."""
        by = np.column_stack([np.diag(self.gain), self.offset])
        return np.asarray(cv2.transform(picture.astype(np.float32), by))


@dataclass(frozen=True, eq=False)
class Backgrounds:
    """What may be behind a body, in small pictures of a camera that stands still.

    Args:
        pictures: (f, H, W, 3) in even light.
        reference: (H, W, 3) the light that they have.
        lights: of each picture.
        colours: (3, H, W, 3) backgrounds, the most frequent first; they may be alike.
        deviations: (H, W) of a background's colours.
    """

    pictures: Floats
    reference: Floats
    lights: tuple[Light, ...]
    colours: Floats
    deviations: Floats

    @staticmethod
    def of(pictures: Picture) -> Backgrounds:
        """The backgrounds of pictures (f, H, W, 3) red, green, blue."""
        floats = pictures.astype(np.float32)
        reference = np.median(floats, axis=0)
        lights = tuple(Light.between(one, reference) for one in floats)
        even = np.array([by.evened(one) for by, one in zip(lights, floats, strict=True)])
        off = np.median(_largest(np.abs(even - reference)), axis=0)
        deviations = _deviations(reference, 1.4826 * float(np.median(off)))
        return Backgrounds(even, reference, lights, _find_colours(even, deviations), deviations)

    @cached_property
    def sums(self) -> PixelSums:
        """What a pose explains is summed from."""
        total, more = self._told
        return PixelSums(total, more, _largest(total), self._edges())

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
            share = cv2.blur(1.0 - likeness / np.float32(np.exp(_LOG_PEAK)), (3, 3))
            found += np.where(share > 0.5, share, 0.0)
        return found

    def showing(self, covered: Mask) -> Mask:
        """(f, H, W) which frames show the likeliest background of a pixel.

        covered: (f, H, W) where the body is known to be, about.
        """
        total, more = self._told
        told = total.copy()
        for f, own in enumerate(covered):
            np.add(told, more[:, :, f], out=told, where=own[..., None])
        best = told.argmax(axis=-1)[None, ..., None]
        colours = np.take_along_axis(self.colours, best, axis=0)[0]
        off = _largest(np.abs(self.pictures - colours)) / self.deviations
        return np.asarray((off < _SAME) & ~_grown(covered, _NEAR))

    @cached_property
    def _told(self) -> tuple[Floats, Floats]:
        """Log-likelihoods where each background shows in all frames (H, W, 3), as in ``PixelSums``.

        And what the body adds in each (H, W, f, 3).
        """
        frames, height, width = self.pictures.shape[:3]
        total = np.zeros((height, width, _BACKGROUNDS), np.float32)
        more = np.empty((height, width, frames, _BACKGROUNDS), np.float32)
        for f, picture in enumerate(self.pictures):
            likeness = [_likeness(picture, one, self.deviations) for one in self.colours]
            stacked = np.stack(likeness, axis=-1)
            shown = np.log(_SHOWN * stacked + (1.0 - _SHOWN))
            more[:, :, f] = np.log(_LIKE_BODY * stacked + (1.0 - _LIKE_BODY)) - shown
            total += shown
        return total, more

    def _edges(self) -> Floats:
        """(2, f, H, W) how strong edges across u and v are in each frame, beyond chance."""
        noise = float(self.deviations.min())
        found = np.empty((2, *self.pictures.shape[:3]), np.float32)
        for f, picture in enumerate(self.pictures):
            u, v = (_largest(np.abs(one)) for one in _slopes(picture))
            strength = np.minimum(1.0, np.hypot(u, v) / (_STRONG * noise))
            for k, (across, along) in enumerate(((u, v), (v, u))):
                own = np.where(along <= _ALIGNED * across, strength, 0.0)
                found[k, f] = cv2.dilate(own, np.ones((3, 3), np.uint8))
        return found - found.mean()


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
        pictures: Sequence[Picture], lights: Sequence[Light], showing: Mask, covered: Mask
    ) -> KnownBackground:
        """That of pictures (H, W, 3) of any size.

        Args:
            lights: of each.
            showing: (f, h, w) which of them show the background, in smaller pictures.
            covered: (f, H, W) where the body is about.
        """
        height, width = covered.shape[1:]
        total, count = np.zeros((height, width, 3), np.float32), np.zeros((height, width))
        on, beside = (np.zeros(COLOURS) for _ in range(2))
        inside, near = ~_grown(~covered, _NEAR), _grown(covered, _NEAR)
        small, means = [], []
        for f, (picture, light) in enumerate(zip(pictures, lights, strict=True)):
            even = light.evened(picture)
            shows = (
                cv2.resize(
                    showing[f].astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST
                ).astype(np.bool_)
                & ~near[f]
            )
            cv2.accumulate(even, total, mask=shows.view(np.uint8))
            count += shows
            numbers = _numbers(even)
            on += np.bincount(numbers[inside[f]], minlength=COLOURS)
            beside += np.bincount(numbers[~near[f]], minlength=COLOURS)
            rows = np.flatnonzero(shows)[::_SAMPLE]
            small.append((rows, even.reshape(-1, 3)[rows]))
        colours = (total / np.maximum(count, 1.0)[..., None]).astype(np.float32)
        means = [_largest(np.abs(own - colours.reshape(-1, 3)[rows])) for rows, own in small]
        off = np.concatenate([*means, np.zeros(1, np.float32)])
        deviations = _deviations(colours, 1.4826 * float(np.median(off)))
        return KnownBackground(
            colours, deviations, count == 0, _log_frequencies(on), _log_frequencies(beside)
        )

    def odds(self, picture: Picture, light: Light) -> Floats:
        """(H, W) logarithms of the odds that each pixel of a picture shows the body."""
        even = light.evened(picture)
        numbers = _numbers(even)
        likeness = _likeness(even, self.colours, self.deviations) * np.float32(_KNOWN_TIMES)
        shown = np.log(_SHOWN * likeness + (1.0 - _SHOWN))
        return np.asarray(self.on[numbers] - np.where(self.unseen, self.beside[numbers], shown))


def odds_picture(odds: Floats) -> Picture:
    """A picture (H, W, 3) whose colours stand for log odds (H, W), see ``odds_of_colours``."""
    share = (np.clip(odds, -_MOST_ODDS, _MOST_ODDS) + _MOST_ODDS) / (2.0 * _MOST_ODDS)
    number = np.rint(share * (COLOURS - 1)).astype(np.uint16)
    channels = (number >> 8, (number >> 4) & 15, number & 15)
    return np.stack([(one << 4).astype(np.uint8) for one in channels], axis=-1)


def odds_of_colours(nodes: int) -> Floats:
    """(nodes, 3, COLOURS) what the colours of an ``odds_picture`` say, as of `compare_lines`."""
    known = np.zeros((nodes, 3, COLOURS), np.float32)
    known[:, ODDS] = np.exp(np.linspace(-_MOST_ODDS, _MOST_ODDS, COLOURS))
    return known


def mask_of_odds(odds: Floats, covered: Mask) -> Mask:
    """Where odds (H, W) are for the body.

    Args:
        covered: (H, W) where the body is about; the mask ends not far from there.
    """
    reach = max(_NEAR, round(_REACH * float(np.sqrt(np.count_nonzero(covered)))))
    near = _grown(covered[None], reach)[0]
    found = ((cv2.GaussianBlur(odds, (0, 0), _SMOOTH) > 0.0) & near).astype(np.uint8)
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
    white = max(_LEAST_NOISE, noise)
    return np.sqrt(white**2 + (_SHAKEN * gradient) ** 2).astype(np.float32)


def _grown(masks: Mask, by: int) -> Mask:
    """(f, H, W) masks larger by so many pixels on all sides."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by + 1,) * 2)
    return np.array([cv2.dilate(one.astype(np.uint8), disc) for one in masks]).astype(np.bool_)


def _likeness(pictures: Floats, colours: Floats, deviations: Floats) -> Floats:
    """(..., H, W) how much likelier colours (..., H, W, 3) are under a background than any."""
    off = _largest(np.abs(pictures - colours)) / deviations
    return np.asarray(np.exp(_LOG_PEAK - 0.5 * np.maximum(off - _EXACT, 0.0) ** 2), np.float32)


def _numbers(picture: Floats) -> NDArray[np.uint16]:
    """(H, W) the colours of pixels (H, W, 3), as histograms count them."""
    steps = np.clip(picture, 0.0, 255.0).astype(np.uint8) >> 4
    places = np.array([[256.0, 16.0, 1.0]])
    return np.asarray(cv2.transform(steps.astype(np.float32), places), np.uint16)


def _log_frequencies(numbers: Array) -> Floats:
    """(COLOURS,) logarithms of how frequent colours are of (COLOURS,) pixels; neighbours share."""
    counts = numbers.reshape(16, 16, 16)
    for axis in range(3):
        ends = [(1, 1) if k == axis else (0, 0) for k in range(3)]
        padded = np.pad(counts, ends, mode="edge")
        low, middle, high = (np.take(padded, range(k, k + 16), axis=axis) for k in range(3))
        counts = 0.25 * low + 0.5 * middle + 0.25 * high
    times = COLOURS * counts.ravel() / max(float(counts.sum()), 1.0)
    return np.log(np.minimum(times, _MOST_FREQUENT) + _UNSEEN_COLOUR).astype(np.float32)


def _find_colours(pictures: Floats, deviations: Floats) -> Floats:
    """(3, H, W, 3) the colours that most frames share, then those that most of the others do."""
    rows = range(0, pictures.shape[1], _ROWS)
    strips = [(pictures[:, k : k + _ROWS], deviations[k : k + _ROWS]) for k in rows]
    return np.concatenate([_find_strip(*one) for one in strips], axis=1)


def _find_strip(pictures: Floats, deviations: Floats) -> Floats:
    """As _find_colours, of a few rows, by how near the colours of all pairs of frames are."""
    count = len(pictures)
    off = np.zeros((count, count, *deviations.shape), np.float32)
    for f, picture in enumerate(pictures):
        off[f, f:] = _largest(np.abs(pictures[f:] - picture)) / deviations
        off[f:, f] = off[f, f:]
    close = off < _SAME
    # Of equal numbers the closer ones.
    support = np.where(close, np.float32(1.0) - np.float32(0.01) * off, np.float32(0.0))
    left, found = np.ones(pictures.shape[:3], bool), list[Floats]()
    for _ in range(_BACKGROUNDS):
        told = np.einsum("fghw,ghw->fhw", support, left.astype(np.float32))
        best = np.where(left, told, -1.0).argmax(axis=0)
        shared = np.take_along_axis(close, best[None, None], axis=0)[0] & left
        number = shared.sum(axis=0)[..., None]
        mean = (pictures * shared[..., None]).sum(axis=0) / np.maximum(number, 1)
        found.append(np.where(number > 0, mean, found[0] if found else mean).astype(np.float32))
        left &= ~shared
    return np.array(found)
