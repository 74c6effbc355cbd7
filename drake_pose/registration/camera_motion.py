"""Detect in a camera's pictures that it does not stand still: it was nudged, drifts or shakes.

Corners of the background are tracked from one reference picture into the others. The motion that
most corners share is the background's shift. Robot, people and shadows move fewer corners. A step
of the shift is a nudge, a slow change a drift, and a scatter a shake.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Floats, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.workers import map_ordered


@dataclass(frozen=True)
class MotionSettings:
    """How the motion of a background is measured, and what counts as a motion of the camera.

    Chosen on recordings of DROID and LeRobot, and on drawn rooms with nudges of 1 to 13 pixels.

    Args:
        width: maximum width of the pictures in which corners are tracked [pixel].
        most: number of pictures that are compared, evenly spaced, before a nudge is bracketed.
        tiles: number of tiles along a picture's width; each gives its best corner.
        near: maximum distance of a corner from where the common motion puts it, for that fit [pixel
            of the tracked pictures].
        close: the same to count corners, and maximum motion of a corner that stands still [pixel of
            the tracked pictures].
        least_corners: minimum number of tracked corners.
        least_share: minimum fraction of the tracked corners that follow the common motion.
        static_share: minimum number of corners that stand still in a static background, over the
            number that follow the common motion. With an object of many corners that fills a
            quarter of the picture the ratio is 0.17, with a camera nudged by 1.6 pixels 0.02.
        least_step: minimum root mean square shift of a nudge or drift, and minimum shake [pixel of
            the tracked pictures].
        noises: minimum shift of a nudge or drift [standard deviations of the shifts about their
            median].
        abrupt: minimum fraction of a nudge's shift that happens between the pictures next to it.
        most_during: maximum number of compared pictures that are taken during a nudge.
        most_nudges: a camera that was nudged more often shakes.
        around: maximum number of compared pictures on each side of a nudge whose shifts' medians
            are compared.
    """

    width: int = 640
    most: int = 60
    tiles: int = 20
    near: float = 1.0
    close: float = 0.4
    least_corners: int = 16
    least_share: float = 0.3
    static_share: float = 0.12
    least_step: float = 0.5
    noises: float = 5.0
    abrupt: float = 0.75
    most_during: int = 3
    most_nudges: int = 4
    around: int = 8


MOTION = MotionSettings()


class Nudge(NamedTuple):
    """A camera's sudden motion.

    Args:
        before, after: indices of the last picture before and of the first one after it.
        pixels: root mean square shift of the background [pixel].
        rotation: (3,) rotation vector of the background's directions in the camera's frame, as if
            the camera had only turned [rad].
    """

    before: int
    after: int
    pixels: float
    rotation: Array


class PictureMotion(NamedTuple):
    """The motion of a camera that should stand still."""

    nudges: tuple[Nudge, ...]  # Sudden motions, in order.
    drift: float = 0.0  # Largest slow shift of the background between two nudges [pixel]; 0: none.
    # Median distance of the background's shift from its running median [pixel]; 0: none.
    shake: float = 0.0
    # Fraction of one picture's corners that is found again in others, their median.
    found_again: float = 1.0


def find_camera_motion(
    read: Callable[[int], Picture], count: int, camera: PinholeCamera
) -> PictureMotion:
    """Return how a camera moved while it took pictures.

    ``read``: returns picture k (H, W, 3). ``count``: number of pictures, in the order of their
    times. ``camera``: its intrinsics; its pose is not used.
    """
    if count < 4:
        return PictureMotion(())
    rows = np.linspace(0, count - 1, min(count, MOTION.most)).round().astype(int)
    rows = np.unique([*range(3), *rows.tolist(), *range(count - 3, count)])
    tracker = BackgroundTracker(read, int(rows[len(rows) // 2]), camera)
    shifts, again = np.split(tracker.shifts(rows.tolist()), [4], axis=1)
    found_again, known = float(np.median(again)), np.isfinite(shifts).all(axis=1)
    # Where the background is often hidden or lost, nothing is known of the camera's motion.
    if known.sum() < max(4, 0.5 * len(rows)):
        return PictureMotion((), found_again=found_again)
    rows, shifts = rows[known], shifts[known]
    steps = find_steps(shifts, tracker.least)
    steps = steps if len(steps) <= MOTION.most_nudges else []
    begins, ends = [0, *(k for _, k in steps)], [*(k for k, _ in steps), len(rows) - 1]
    parts = [shifts[a : b + 1] for a, b in zip(begins, ends, strict=True)]
    levels = [np.median(part, axis=0) for part in parts]
    nudges = []
    for (last, first), (before_level, after_level) in zip(steps, pairwise(levels), strict=True):
        shift = after_level - before_level
        near = 0.3 * float(np.linalg.norm(shift))
        before, after = _bracket(read, camera, int(rows[last]), int(rows[first]), near)
        pixels = float(np.linalg.norm(shift)) / tracker.scale
        nudges.append(Nudge(before, after, pixels, tracker.rotation(shift)))
    drift, shake = (max(sizes) for sizes in zip(*map(_drift_and_shake, parts), strict=True))
    least = tracker.least
    return PictureMotion(
        tuple(nudges),
        drift / tracker.scale if drift >= max(least, MOTION.noises * shake) else 0.0,
        shake / tracker.scale if shake >= least else 0.0,
        found_again,
    )


def find_steps(shifts: Array, least: float) -> list[tuple[int, int]]:
    """Find steps of a sampled vector.

    Args:
        shifts: (n, d) samples.
        least: minimum norm of a step, in the samples' unit; it must exceed their noise, too.

    Returns:
        for each step, in order, the indices of the last sample before it and the first after it.
    """
    count, around = len(shifts), MOTION.around
    for taken in range(MOTION.most_during + 1):
        # Samples that were taken during the step belong to neither side.
        best, step_at = 0.0, (0, 0)
        for first in range(2 + taken, count - 1):
            last = first - taken - 1
            before, after = shifts[max(0, last - around + 1) : last + 1], shifts[first:][:around]
            before_median, after_median = np.median(before, axis=0), np.median(after, axis=0)
            step = float(np.linalg.norm(after_median - before_median))
            off = np.linalg.norm(
                np.concatenate([before - before_median, after - after_median]), axis=1
            )
            near = max(off[len(before) - 1], off[len(before)]) < (1.0 - MOTION.abrupt) * step
            noise = 1.4826 * float(np.median(off))
            if near and step > max(best, least, MOTION.noises * noise):
                best, step_at = step, (last, first)
        if best:
            last, first = step_at
            later = [(first + a, first + b) for a, b in find_steps(shifts[first:], least)]
            return [*find_steps(shifts[: last + 1], least), step_at, *later]
    return []


def _drift_and_shake(shifts: Array) -> tuple[float, float]:
    """Return the largest change of samples' (n, d) running median, and their median distance."""
    half = MOTION.around // 2
    smooth = np.array(
        [np.median(shifts[max(0, k - half) : k + half + 1], axis=0) for k in range(len(shifts))]
    )
    change = float(np.linalg.norm(smooth - smooth[0], axis=1).max())
    return change, float(np.median(np.linalg.norm(shifts - smooth, axis=1)))


def _bracket(
    read: Callable[[int], Picture], camera: PinholeCamera, low: int, high: int, near: float
) -> tuple[int, int]:
    """Return the last picture before a nudge, and the first one after it.

    Args:
        read, camera: as of `find_camera_motion`.
        low, high: indices of a picture before the nudge, and of one after it.
        near: maximum shift between pictures on the same side [pixel of the tracked pictures].
    """

    def bisect(reference: int, low: int, high: int, from_low: bool) -> tuple[int, int]:
        """Bracket the end of the pictures near a reference, which is low or high."""
        tracker = BackgroundTracker(read, reference, camera)
        while high - low > 1:
            k = (low + high) // 2
            is_near = float(np.linalg.norm(tracker.shifts([k])[:, :4])) < near
            low, high = (k, high) if is_near == from_low else (low, k)
        return low, high

    low, top = bisect(low, low, high, from_low=True)
    return low, bisect(high, low, high, from_low=False)[1] if top < high else high


class BackgroundTracker:
    """Measures the shift of the background between a reference picture and others.

    Attributes:
        scale: width of the tracked pictures over that of the camera's.
        least: minimum size of a step that counts [pixel of the tracked pictures].

    Args:
        read: returns picture k (H, W, 3).
        reference: index of the reference picture.
        camera: its intrinsics.
    """

    def __init__(
        self, read: Callable[[int], Picture], reference: int, camera: PinholeCamera
    ) -> None:
        self._read, self.least = read, MOTION.least_step
        self.scale = min(1.0, MOTION.width / camera.width)
        size = max(8, round(self.scale * camera.width)), max(8, round(self.scale * camera.height))
        self._camera = camera.resized(*size)
        # The root mean square distance of a picture's pixels from its centre.
        self._radius = float(np.hypot(*size)) / np.sqrt(12.0)
        self._reference = self._even(read(reference))
        self._corners = _spread_corners(self._reference)

    def _even(self, picture: Picture) -> NDArray[np.uint8]:
        """Return a grey picture (h, w) with local brightness and contrast made equal everywhere."""
        size = self._camera.width, self._camera.height
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        small: Floats = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        small = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0))
        side = (2 * (size[0] // 40) + 1,) * 2
        off = small - cv2.blur(small, side)
        spread = np.sqrt(cv2.blur(off * off, side))
        return np.clip(128.0 + 40.0 * off / (spread + 4.0), 0.0, 255.0).astype(np.uint8)

    def shifts(self, rows: Sequence[int], at_once: int = 8) -> Array:
        """Return the shifts (n, 5) of pictures, see `_shift`; at_once: pictures in memory."""
        shifts = list[Array]()
        for k in range(0, len(rows), at_once):
            shifts += map_ordered(self._shift, map(self._read, rows[k : k + at_once]))
        return np.array(shifts)

    def _shift(self, picture: Picture) -> Array:
        """Return the shift (5,) of a picture's background [pixel of the tracked pictures].

        It is the motion of the picture's centre along u and along v; and the rotation and the
        relative growth, each times a picture's root mean square radius. nan: not determined. The
        last entry is the fraction of the reference picture's corners that is found again.
        """
        unknown, corners = np.append(np.full(4, np.nan), 1.0), self._corners
        if len(corners) < MOTION.least_corners:
            return unknown
        tracked, is_tracked = _track(self._reference, self._even(picture), corners)
        unknown[4] = again = is_tracked.mean()
        points, moved = corners[is_tracked], tracked[is_tracked]
        if len(points) < MOTION.least_corners:
            return unknown
        centre = np.array([self._camera.center_x, self._camera.center_y])
        points, moved = points - centre, moved - centre
        matrix, follows = cv2.estimateAffinePartial2D(
            points, moved, method=cv2.RANSAC, ransacReprojThreshold=MOTION.near, maxIters=500
        )
        if matrix is None:
            return unknown
        misfits = np.linalg.norm(points @ matrix[:, :2].T + matrix[:, 2] - moved, axis=1)
        still = np.count_nonzero(np.linalg.norm(moved - points, axis=1) < MOTION.close)
        follow = np.count_nonzero(misfits < MOTION.close)
        if still >= max(MOTION.static_share * follow, MOTION.least_corners / 2):
            return np.array([0.0, 0.0, 0.0, 0.0, again])
        if np.count_nonzero(follows) < MOTION.least_share * len(points):
            return unknown
        # RANSAC fits two corners, which are noisy: all corners that follow are fitted again. If a
        # camera turns, corners farther out are shifted more (the last two columns).
        (x, y), zero = points.T, np.zeros(len(points))
        fx, fy = self._camera.kernel_parameters()[1:3]
        perspective = [x * x / fx**2, x * y / fy**2], [x * y / fx**2, y * y / fy**2]
        rows = np.array(
            [[x, -y, zero + 1.0, zero, *perspective[0]], [y, x, zero, zero + 1.0, *perspective[1]]]
        )
        for _ in range(3):
            used = rows[..., misfits < MOTION.near].transpose(0, 2, 1).reshape(-1, len(rows[0]))
            fit = np.linalg.lstsq(used, moved[misfits < MOTION.near].T.ravel(), rcond=None)[0]
            misfits = np.linalg.norm(np.einsum("cjn,j->nc", rows, fit) - moved, axis=1)
        turn, grow = np.arctan2(fit[1], fit[0]), np.hypot(*fit[:2]) - 1.0
        return np.array([*fit[2:4], self._radius * turn, self._radius * grow, again])

    def rotation(self, shift: Array) -> Array:
        """Return the rotation vector (3,) of directions [rad] that gives a shift (4,)."""
        (fx, fy), turn = self._camera.kernel_parameters()[1:3], shift[2] / self._radius
        return np.array([-shift[1] / fy, shift[0] / fx, turn])


def _spread_corners(picture: NDArray[np.uint8]) -> Floats:
    """Return the best corners (n, 2) of a picture (h, w), at most one of each tile [pixel]."""
    side = max(4, picture.shape[1] // MOTION.tiles)
    strength = cv2.cornerMinEigenVal(picture, 7)
    corners, best = [], []
    for v in range(0, picture.shape[0] - side + 1, side):
        for u in range(0, picture.shape[1] - side + 1, side):
            tile = strength[v : v + side, u : u + side]
            row, column = divmod(int(tile.argmax()), side)
            corners.append((u + column, v + row))
            best.append(float(tile[row, column]))
    keep = np.array(best) > 0.1 * np.median(best)
    return np.array(corners, np.float32)[keep]


def _track(
    picture: NDArray[np.uint8], other: NDArray[np.uint8], corners: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the places (n, 2) of a picture's corners in another, and which corners were found.

    A corner (n, 2) [pixel] is found if it can be tracked back. Pictures are (h, w) and grey.
    """
    window, levels, start = (15, 15), 3, corners[:, None]
    found, there, _ = cv2.calcOpticalFlowPyrLK(
        picture, other, start, np.empty_like(start), winSize=window, maxLevel=levels
    )
    again, back, _ = cv2.calcOpticalFlowPyrLK(
        other, picture, found, np.empty_like(start), winSize=window, maxLevel=levels
    )
    is_found = np.concatenate([np.asarray(there), np.asarray(back)], axis=1).all(axis=1)
    near = np.abs(np.asarray(again) - start).max(axis=(1, 2)) < MOTION.close
    return np.asarray(found, np.float32)[:, 0], is_found & near
