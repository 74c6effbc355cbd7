"""A recording of one camera: pictures with a joint log, its clock, and the frames of a search."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from drake_pose.arrays import Array, Indices, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.explain_kernel import Explained
from drake_pose.fit.judge import held_out
from drake_pose.registration.picture_search import (
    PictureSearch,
    PosedPicture,
    choose_frames,
    node_places,
)
from drake_pose.registration.pyramid_level import PICTURES
from drake_pose.registration.register import RegistrationBody
from drake_pose.workers import map_ordered


@dataclass(frozen=True, eq=False)
class Recording:
    """Pictures of one camera, and a joint log."""

    names: tuple[str, ...]  # Names of the n pictures.
    # Returns the pose tree's values (n, m) [rad or m] at the pictures' times plus a time offset
    # [s], a number or (n,); NaN at times that are not logged.
    values_at: Callable[[float | Array], Array]
    read: Callable[[int], Picture]  # Returns picture k (H, W, 3).
    # (n,) times of the pictures [s]; None: the log has no times, and the values do not depend on
    # the offset.
    times: Array | None

    def rates_at(self, offset: float) -> Array | None:
        """Return the values' velocities (n, m) [rad/s or m/s] at an offset [s]; None: unknown."""
        if self.times is None:
            return None
        step = PICTURES.rate_step
        ahead, behind = self.values_at(offset + step), self.values_at(offset - step)
        return np.asarray(np.nan_to_num((ahead - behind) / (2.0 * step)))

    def picture(self, name: str) -> Picture:
        """Return a picture (H, W, 3) by its name."""
        return self.read(self.names.index(name))

    def mirrored(self) -> "Recording":
        """Return the same recording with all pictures mirrored left to right."""
        return replace(self, read=lambda k: np.ascontiguousarray(self.read(k)[:, ::-1]))

    def with_offsets(self, joint_offsets: Array) -> "Recording":
        """Return the same recording with offsets (m,) [rad or m] added to all values."""
        return replace(self, values_at=lambda offset: self.values_at(offset) + joint_offsets)

    def without(self, rows: Indices) -> "Recording":
        """Return the same recording without joint positions at the pictures with indices `rows`."""

        def values_at(offset: float | Array) -> Array:
            values = self.values_at(offset).copy()
            values[rows] = np.nan
            return values

        return replace(self, values_at=values_at)

    def with_drift(self, drift: float, since: float) -> "Recording":
        """Return the recording with time offsets that grow by `drift` [s/s], from 0 at `since` [s].

        Without times, or with a drift of 0, it is returned as it is.
        """
        if not drift or self.times is None:
            return self
        later = drift * (self.times - since)
        return replace(self, values_at=lambda offset: self.values_at(offset + later))


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """Time offset of a camera: log time minus picture time of the same joint positions.

    Args:
        value, deviation: the offset at the frames' mean time, and its standard deviation [s];
            infinity: the pictures do not determine it.
        scores: (k, 2) scanned offsets [s], and their scores over the best score.
        drift, drift_deviation: growth of the offset with time, and its standard deviation [s/s].
            The drift is 0 if it is not significant; the deviation is infinity if none was fitted.
    """

    value: float
    deviation: float
    scores: Array
    drift: float = 0.0
    drift_deviation: float = np.inf

    @property
    def determined(self) -> bool:
        """Whether the pictures determine the offset."""
        return bool(np.isfinite(self.deviation))


NO_CLOCK = TimeOffset(0.0, np.inf, np.zeros((0, 2)))
"""The time offset if it is not determined."""


def mean_time(recording: Recording, rows: Sequence[int]) -> float:
    """Return the mean time [s] of the pictures with indices `rows`; 0 if the log has no times."""
    return 0.0 if recording.times is None else float(recording.times[list(rows)].mean())


def choose_pictures(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    count: int = PICTURES.search_frames,
    *,
    moving: int = 8,
    slow_fraction: float = 0.6,
    min_motion: float = 0.05,
) -> tuple[list[int], list[int]]:
    """Choose slow frames for a search, and fast frames, whose pictures determine the time offset.

    Args:
        body: the robot's surfaces.
        camera: names the camera in messages.
        recording: the pictures and the joint log.
        count, moving: maximum number of slow frames, and of fast frames.
        slow_fraction: quantile of the speed up to which a frame is slow.
        min_motion: minimum motion of the link that moves most, over the whole recording [m].

    Returns the pictures' indices of the slow and of the fast frames, the most dissimilar first.
    Without logged times no frame counts as fast.

    Raises RegistrationError: too few pictures have joint positions, or the robot does not move.
    """
    values = recording.values_at(0.0)
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(known) < 3:
        raise RegistrationError(
            f"camera '{camera.name}': {len(known)} of its {len(values)} pictures have joint "
            "positions at their times; three or more with different poses are needed: do pictures "
            "and joints belong to one episode and one clock?"
        )
    places = node_places(body, values[known])
    spread = float(np.linalg.norm(np.ptp(places, axis=0), axis=1).max())
    if spread < min_motion:
        raise RegistrationError(
            f"camera '{camera.name}': the robot hardly moves, by {1e3 * spread:.0f} mm at most, so "
            "pictures do not separate it from the background; give an episode in which it moves"
        )
    rates = recording.rates_at(0.0)
    if rates is None:
        return known[choose_frames(places, count)].tolist(), []
    ahead = node_places(body, values[known] + PICTURES.rate_step * rates[known])
    speed = np.linalg.norm(ahead - places, axis=2).mean(axis=1)
    slow = np.flatnonzero(speed <= np.quantile(speed, slow_fraction))
    if len(slow) < count:
        slow = np.arange(len(known))
    chosen = slow[choose_frames(places[slow], count)]
    rest = np.setdiff1d(np.argsort(-speed)[: max(moving, len(known) // 4)], chosen)
    fast = rest[choose_frames(places[rest], moving)] if len(rest) else rest
    return known[chosen].tolist(), known[fast].tolist()


def left_out(body: RegistrationBody, recording: Recording) -> Indices:
    """Return indices of the pictures that judge a fit, and do not enter it, see ``held_out``."""
    values = recording.values_at(0.0)
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    return known[held_out(node_places(body, values[known]).reshape(len(known), -1))]


def stuck_pictures(recording: Recording, least: int = 5, noise: int = 2) -> str:
    """Return in words which pictures are the same although the joints move; "": there are few.

    ``least``: minimum number of successive pictures that are the same. ``noise``: maximum
    difference of two that are [of 255]; encoders change copies by this much.
    """
    same, before = [0], recording.read(0)
    for k in range(1, len(recording.names)):
        picture = recording.read(k)
        is_same = cv2.absdiff(picture, before).max() <= noise
        same.append(same[-1] + 1 if is_same else 0)
        before = picture
    last = int(np.argmax(same))
    if same[last] < least:
        return ""
    names = recording.names[last - same[last]], recording.names[last]
    return f"pictures '{names[0]}' to '{names[1]}' are the same picture: is the recording stuck?"


def posed_pictures(
    recording: Recording, indices: Sequence[int], offset: float, known: Sequence[PosedPicture] = ()
) -> list[PosedPicture]:
    """Return pictures of `indices` with logged values at a time offset [s], or `known` ones."""
    values, rates = recording.values_at(offset), recording.rates_at(offset)
    pictures = {frame.name: frame.picture for frame in known}

    def posed(k: int) -> PosedPicture:
        name = recording.names[k]
        picture = pictures[name] if name in pictures else recording.read(k)
        return PosedPicture(name, values[k], picture, None if rates is None else rates[k])

    return [posed(k) for k in indices if np.isfinite(values[k]).all()]


def scan_time_offsets(
    search: PictureSearch,
    camera: PinholeCamera,
    recording: Recording,
    *,
    rates: Sequence[float] = (-0.2, -0.15, -0.1, -0.05, 0.05, 0.1, 0.15, 0.2, 0.25),
    start_within: float = 0.3,
    much_better: float = 1.01,
) -> TimeOffset:
    """Return the time offset that explains pictures best, for a camera at a known pose.

    Offsets from -1 to 1 s are scanned, then drifts of the log's clock. Standard deviations are not
    estimated (infinity).

    Args:
        search: a search in the pictures that are used.
        camera: at its pose.
        recording: the pictures' recording, with the same joint offsets as the search.
        rates: scanned drifts [s/s].
        start_within: with a drift, maximum time offset at the recording's first picture [s].
        much_better: minimum score of a drift over that of the best constant offset.
    """
    offsets = np.linspace(-1.0, 1.0, 81)
    level = search.compared
    rows = [recording.names.index(frame.name) for frame in search.frames]

    def gains_at(clock: Recording, tried: Array) -> Array:
        """Return log-likelihood gains (k,) at k time offsets [s]; NaN without logged joints."""
        several = [clock.values_at(offset)[rows] for offset in tried.tolist()]

        def gain(values: Array) -> float:
            if not np.isfinite(values).all():
                return np.nan
            return float(level.statistics(camera.X_CW, search.nodes_at(values))[Explained.GAIN])

        return np.array(map_ordered(gain, several))

    scores = gains_at(recording, offsets)
    peak = int(np.nanargmax(scores))
    offset, drift = float(offsets[peak]), 0.0
    if 0 < peak < len(scores) - 1 and np.isfinite(scores[peak - 1 : peak + 2]).all():
        low, middle, high = scores[peak - 1 : peak + 2]
        bend = low - 2.0 * middle + high
        if bend < 0.0:
            offset += 0.5 * float((low - high) / bend) * float(offsets[1] - offsets[0])
    constant_score, best_score = scores[peak], much_better * scores[peak]
    if recording.times is not None:
        first, mean = float(recording.times[0]), mean_time(recording, rows)
        starts = np.linspace(-start_within, start_within, 13)
        for rate in rates:
            gains = gains_at(recording.with_drift(rate, first), starts)
            if np.isfinite(gains).any() and (gain := float(np.nanmax(gains))) > best_score:
                best_score, drift = gain, rate
                offset = float(starts[int(np.nanargmax(gains))]) + rate * (mean - first)
    known = np.isfinite(scores)
    tried = np.column_stack([offsets[known], scores[known] / max(constant_score, 1e-9)])
    return TimeOffset(offset, np.inf, tried, drift)
