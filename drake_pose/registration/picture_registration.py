"""A camera, and its clock, from pictures and a joint log: found, fitted, and as sure as it is.

Frames in which the robot hardly moves carry the search, for there a clock that is off does little
harm. Then the pictures' clock is tried against the log's, the pose held; and pose, offset and, if
asked for, focal length are fitted together on those frames and the ones that move most.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.background import Explained, estimate_gain
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.problem import TIME_OFFSET
from drake_pose.fit.surfaces import simplify_or_hull
from drake_pose.registration.picture_search import (
    PICTURES,
    PictureFit,
    PictureSearch,
    PosedPicture,
    choose_frames,
    evidence,
    node_places,
    segment_picture,
)
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import (
    FrameMisfit,
    RegisteredCamera,
    RegistrationBody,
    frame_misfits,
)
from drake_pose.registration.shared_fit import SHARED, SharedFit, inlier_threshold
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.workers import map_ordered


@dataclass(frozen=True, eq=False)
class Recording:
    """Pictures of one camera, and the joints at their moments.

    Args:
        names: (n,) of the pictures.
        values_at: (n, m) values of the pose tree at the pictures' times plus an offset [s]: one
            for all, or (n,).
        read: gives picture k (H, W, 3).
        times: (n,) of the pictures [s]; None: the joints have none, and the values are the same
            whatever the offset.
    """

    names: tuple[str, ...]
    values_at: Callable[[float | Array], Array]
    read: Callable[[int], Picture]
    times: Array | None

    def rates_at(self, offset: float) -> Array | None:
        """(n, m) how fast the values change [rad/s or m/s]; None: unknown."""
        if self.times is None:
            return None
        step = PICTURES.rate_step
        ahead, behind = (self.values_at(offset + by) for by in (step, -step))
        return np.asarray(np.nan_to_num((ahead - behind) / (2.0 * step)))

    def picture(self, name: str) -> Picture:
        """A picture (H, W, 3) by its name."""
        return self.read(self.names.index(name))

    def mirrored(self) -> "Recording":
        """The same with left and right exchanged in all pictures."""
        return replace(self, read=lambda k: np.ascontiguousarray(self.read(k)[:, ::-1]))

    def with_offsets(self, zeros: Array) -> "Recording":
        """The same with (m,) added to all values."""
        return replace(self, values_at=lambda offset: self.values_at(offset) + zeros)

    def with_drift(self, drift: float, since: float) -> "Recording":
        """The same where the joints' clock runs faster by a drift [s/s], and is right at a time."""
        if not drift or self.times is None:
            return self
        later = drift * (self.times - since)
        return replace(self, values_at=lambda offset: self.values_at(offset + later))


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """By how much later than the pictures' times their joints are in the log.

    Args:
        value, deviation: [s]; the deviation is infinite where the pictures do not tell.
        drift, drift_deviation: by how much more in each second [s/s]; 0 where that is not told from
            chance. The value is that of the frames' mean time.
        scores: (k, 2) offsets that were tried [s], and what they explain, over the best.
    """

    value: float
    deviation: float
    scores: Array
    drift: float = 0.0
    drift_deviation: float = np.inf

    @property
    def determined(self) -> bool:
        """Whether the pictures tell it."""
        return bool(np.isfinite(self.deviation))


NO_CLOCK = TimeOffset(0.0, np.inf, np.zeros((0, 2)))
"""Of pictures whose offset is unknown."""


@dataclass(frozen=True, eq=False)
class PictureRegistration:
    """A camera that was found in its pictures.

    Args:
        found: the camera.
        frames: its frames, with masks and log-odds, at the joints' values of their moments.
        pictures: of these frames, by name.
        fit: that found it.
        offset: of its clock; None: the joints have no times.
        focal_deviation: over the focal length; 0: it was held.
        recording: it was found in, the joints' clock drifting no more.
        zeros: (m,) that were added to the frames' values where masks and log-odds were found.
    """

    found: RegisteredCamera
    frames: tuple[PosedFrame, ...]
    pictures: dict[str, Picture]
    fit: PictureFit
    offset: TimeOffset | None
    focal_deviation: float
    recording: Recording
    zeros: Array


def register_pictures(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    focal: bool = False,
    zeros: Sequence[str] = (),
) -> PictureRegistration:
    """Finds where a camera stands that has seen a body move.

    Args:
        camera: its pose is not used.
        focal: whether its focal length is only about known.
        zeros: joints whose zeros are only about known. What is found is not told apart from chance
            here (``calibrate_joints`` does that), but masks follow it.

    Raises RegistrationError: too few pictures with joint positions, a body that does not move, or
        no pose that explains the pictures; says so where one explains them mirrored.
    """
    chosen = choose_pictures(body, camera, recording)
    try:
        return _register(body, camera, recording, chosen, focal, zeros)
    except RegistrationError as error:
        mirrored = camera.mirrored(), recording.mirrored()
        try:
            _register(body, *mirrored, chosen, focal, zeros)
        except RegistrationError:
            raise error from None
        raise RegistrationError(
            f"camera '{camera.name}': its pictures are mirrored, left and right exchanged: a pose "
            "explains them that way round only. Mirror them again. Nothing was written"
        ) from error


def _register(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    frames: tuple[list[int], list[int]],
    focal: bool,
    zeros: Sequence[str],
    looks: int = 3,
) -> PictureRegistration:
    """As register_pictures, the pictures being as they are, from some of them.

    looks: number of poses that are fitted.
    """
    chosen, moving = frames
    search = PictureSearch(body, camera, posed_pictures(recording, chosen, 0.0))
    fitted = map_ordered(search.coarse_fit, search.search()[:looks])
    near = sorted((one for one in fitted if one is not None), key=lambda one: -evidence(*one[1]))
    if not near:
        raise _unexplained(camera, "no pose shows the body in two pictures")
    level, start = search.compared, near[0][0]
    pieces = level.pieces(start.X_CW)
    # Once more, for those that are as good, but for chance, and on their way to the best.
    close = [
        one.X_CW for one, _ in near[1:] if vuong_statistic(pieces, level.pieces(one.X_CW)) <= 1.96
    ]
    again = map_ordered(search.coarse_fit, close)
    alike = [one[0].X_CW for one in again if one is not None]
    alternatives = level.distinct([start.X_CW, *alike])[1:]
    both, clock = [*chosen, *moving], NO_CLOCK
    if recording.times is not None:
        clock = scan_time_offsets(body, start, recording, both)
    return fit_pictures(
        body, PictureStart(start, both, clock, alternatives), recording, focal, zeros
    )


class PictureStart(NamedTuple):
    """A search that is done: the camera, frames that are fitted, the clock, other poses X_CW."""

    camera: PinholeCamera
    rows: Sequence[int]
    clock: TimeOffset
    alternatives: Sequence[Array]

    @classmethod
    def of(cls, one: PictureRegistration) -> "PictureStart":
        """A camera that was found already."""
        rows = [one.recording.names.index(frame.name) for frame in one.frames]
        others = [np.linalg.inv(X) for X in one.found.alternatives]
        return cls(one.found.camera, rows, one.offset or NO_CLOCK, others)


def fit_pictures(
    body: RegistrationBody,
    start: PictureStart,
    recording: Recording,
    focal: bool = False,
    zeros: Sequence[str] = (),
    *,
    most_fits: int = 5,
    min_drift: float = 0.005,
    drift_sds: float = 4.0,
) -> PictureRegistration:
    """What a search has begun, fitted until clock and zeros move no more.

    Args:
        recording: as it is, whose joints' clock may drift.
        focal: whether the focal length is only about known.
        zeros: joints whose zeros are only about known.
        most_fits: how often a drift is fitted anew that is more than its deviation, which what it
            spoils makes large, and more than min_drift over all pictures [s].
        drift_sds: a clock drifts if it does so by more standard deviations.

    Raises RegistrationError: no pose explains the pictures.
    """
    at_rate = start.clock.drift
    without = start._replace(clock=replace(start.clock, drift=0.0))
    steady = best, as_now, start, assumed = _fit_until_stable(
        body, without, recording, focal, zeros
    )
    if recording.times is None:
        return _describe(*steady, focal)
    if at_rate:
        clock = replace(without.clock, drift=at_rate)
        start = without._replace(clock=clock)
        best, as_now, start, assumed = _fit_until_stable(body, start, recording, focal, zeros)
    since, span = _mean_time(recording, start.rows), float(np.ptp(recording.times))
    for left in range(most_fits, -1, -1):
        rows = [recording.names.index(frame.name) for frame in best.fit.views[0].frames]
        later = (recording.times[rows] - since)[best.inliers]
        more, deviation = best.fit.fit_slope(
            best.found, TIME_OFFSET, later, best.inliers, best.covariance
        )
        clock = replace(start.clock, drift_deviation=deviation)
        start = start._replace(clock=clock)
        if abs(more) < max(deviation, min_drift / span) or not left:
            break
        start = start._replace(clock=replace(clock, drift=clock.drift + more))
        best, as_now, start, assumed = _fit_until_stable(body, start, recording, focal, zeros)
    told = abs(start.clock.drift) > drift_sds * start.clock.drift_deviation
    return _describe(*((best, as_now, start, assumed) if told else steady), focal)


def _fit_until_stable(
    body: RegistrationBody,
    start: PictureStart,
    recording: Recording,
    focal: bool,
    zeros: Sequence[str],
) -> tuple[PictureFit, Recording, PictureStart, Array]:
    """A fit with the drift of the clock that has begun.

    It is fitted again, so often at most, where an offset moved by 20 ms or a zero by 0.3 degrees.

    Returns:
        the fit; the recording, whose joints' clock drifts no more; the camera and the clock that
        were found, but for the offset's deviation; (m,) what was added to the frames' values.
    """
    camera, offset, names = start.camera, start.clock.value, body.kinematics.names
    constants = ((TIME_OFFSET,) if recording.times is not None else ()) + tuple(zeros)
    turned, left = np.zeros(len(names)), 4 if zeros else 2
    as_now = recording.with_drift(start.clock.drift, _mean_time(recording, start.rows))
    while True:
        frames, left = posed_pictures(as_now.with_offsets(turned), start.rows, offset), left - 1
        best = PictureSearch(body, camera, frames).fit(camera, constants, focal)
        if best is None:
            raise _unexplained(camera, "the body leaves the pictures")
        found = dict(zip(best.fit.names, best.found.shared.tolist(), strict=True))
        camera, by = best.camera, found.get(TIME_OFFSET, 0.0)
        assumed, turn = turned, np.array([found.get(name, 0.0) for name in names])
        most = SHARED.max_constant
        offset, turned = offset + by, np.clip(turned + turn, -most, most)
        if not left or (abs(by) < 0.02 and np.abs(turn).max() < np.radians(0.3)):
            done = start._replace(camera=camera, clock=replace(start.clock, value=offset))
            return best, as_now, done, assumed


def _mean_time(recording: Recording, rows: Sequence[int]) -> float:
    """Of some pictures [s]."""
    return 0.0 if recording.times is None else float(recording.times[list(rows)].mean())


def choose_pictures(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    count: int = PICTURES.search_frames,
    *,
    moving: int = 8,
    slow_share: float = 0.6,
    min_motion: float = 0.05,
) -> tuple[list[int], list[int]]:
    """The frames that carry a search, and those that move most beside them.

    Args:
        count, moving: maximum number of the former, and of the latter.
        slow_share: the slower share of all frames carries the search, if clocks may differ.
        min_motion: a robot whose parts move by less [m] does not tell where a camera is.

    Raises RegistrationError: too few pictures with joint positions, or a body that does not move.
    """
    values = recording.values_at(0.0)
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(known) < 3:
        raise RegistrationError(
            f"camera '{camera.name}': {len(known)} of its {len(values)} pictures have joint "
            "positions of their moments; three and more are needed, in which the robot stands "
            "otherwise: are pictures and joints of one episode and of one clock?"
        )
    places = node_places(body, values[known])
    spread = float(np.linalg.norm(np.ptp(places, axis=0), axis=1).max())
    if spread < min_motion:
        raise RegistrationError(
            f"camera '{camera.name}': the robot hardly moves, by {1e3 * spread:.0f} mm at most, so "
            "its pictures do not tell it from what is behind it; give an episode in which it moves"
        )
    rates = recording.rates_at(0.0)
    if rates is None:
        return known[choose_frames(places, count)].tolist(), []
    ahead = node_places(body, values[known] + PICTURES.rate_step * rates[known])
    speed = np.linalg.norm(ahead - places, axis=2).mean(axis=1)
    slow = np.flatnonzero(speed <= np.quantile(speed, slow_share))
    if len(slow) < count:
        slow = np.arange(len(known))
    chosen = slow[choose_frames(places[slow], count)]
    rest = np.setdiff1d(np.argsort(-speed)[: max(moving, len(known) // 4)], chosen)
    fast = rest[choose_frames(places[rest], moving)] if len(rest) else rest
    return known[chosen].tolist(), known[fast].tolist()


def posed_pictures(
    recording: Recording, indices: Sequence[int], offset: float
) -> list[PosedPicture]:
    """Some frames with their pictures; those whose joints are not logged are left out."""
    values, rates = recording.values_at(offset), recording.rates_at(offset)
    return [
        PosedPicture(
            recording.names[k], values[k], recording.read(k), None if rates is None else rates[k]
        )
        for k in indices
        if np.isfinite(values[k]).all()
    ]


def scan_time_offsets(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    indices: Sequence[int],
    *,
    rates: Sequence[float] = (-0.2, -0.15, -0.1, -0.05, 0.05, 0.1, 0.15, 0.2, 0.25),
    start_within: float = 0.3,
    much_better: float = 1.01,
) -> TimeOffset:
    """The offset at which a camera explains its pictures best, and what all that were tried do.

    Tried are offsets from -1 to 1 s; then rates at which the joints' clock runs faster.

    Args:
        rates: [s/s].
        start_within: at these both clocks start together but for this time [s].
        much_better: a rate explains this many times as much as the best offset does.
    """
    offsets = np.linspace(-1.0, 1.0, 81)
    frames = posed_pictures(recording, indices, 0.0)
    level = PictureSearch(body, camera, frames).compared
    names = [one.name for one in frames]
    rows = [recording.names.index(name) for name in names]

    def told(clock: Recording, tried: Array) -> Array:
        found = np.full(len(tried), np.nan)
        for k, offset in enumerate(tried):
            values = clock.values_at(float(offset))[rows]
            if np.isfinite(values).all():
                X_WN = np.array([body.kinematics.poses(one) for one in values])
                found[k] = level.told(camera.X_CW, X_WN)[Explained.GAIN]
        return found

    scores = told(recording, offsets)
    k = int(np.nanargmax(scores))
    offset, drift = float(offsets[k]), 0.0
    if 0 < k < len(scores) - 1 and np.isfinite(scores[k - 1 : k + 2]).all():
        low, middle, high = scores[k - 1 : k + 2]
        bend = low - 2.0 * middle + high
        if bend < 0.0:
            offset += 0.5 * float((low - high) / bend) * float(offsets[1] - offsets[0])
    best, most = scores[k], much_better * scores[k]
    if recording.times is not None:
        first, mean = float(recording.times[0]), _mean_time(recording, rows)
        starts = np.linspace(-start_within, start_within, 13)
        for rate in rates:
            gains = told(recording.with_drift(rate, first), starts)
            if np.isfinite(gains).any() and (gain := float(np.nanmax(gains))) > most:
                most, drift = gain, rate
                offset = float(starts[int(np.nanargmax(gains))]) + rate * (mean - first)
    known = np.isfinite(scores)
    tried = np.column_stack([offsets[known], scores[known] / max(best, 1e-9)])
    return TimeOffset(offset, np.inf, tried, drift)


def _describe(
    best: PictureFit,
    recording: Recording,
    start: PictureStart,
    zeros: Array,
    focal: bool,
    *,
    min_explained: float = 0.12,
    min_ratio: float = 0.42,
    min_contour: float = 0.16,
    min_evidence: float = 1.05,
    max_sd: float = 0.04,
    max_clock_sd: float = 0.1,
) -> PictureRegistration:
    """What was found.

    Args:
        min_explained: share of what changes that is explained: right poses .2 and more, one that
            few frames bore out .09.
        min_ratio: of the contours, what fits: right poses .5 and more, the best wrong ones .3, one
            with a free focal length .6.
        min_contour: by how much edges along contours are stronger than by chance: right poses .17
            and more, the best wrong ones .13, one with a free focal length .17.
        min_evidence: of both: right poses 1.2 and more, the best wrong ones .9.
        max_sd: of a pose [its distance from the body; rad]: right ones are known to a hundredth;
            mirrored pictures are explained about as well from behind, known to a twentieth.
        max_clock_sd: an offset is not told whose standard deviation is larger [s].

    Raises RegistrationError: it does not explain the pictures.
    """
    fit, (seen,) = best.fit, best.fit.views
    ratio = float(best.ratios[best.inliers].mean())
    told = evidence(best.explained, best.contour)
    if (
        best.explained < min_explained
        or ratio < min_ratio
        or best.contour < min_contour
        or told < min_evidence
    ):
        raise _unexplained(
            start.camera,
            f"at best {max(best.explained, 0.0):.0%} of what changes is explained "
            f"({min_explained:.0%} at least), {ratio:.0%} of the contours fit "
            f"({min_ratio:.0%} at least), and edges along them are stronger than elsewhere by "
            f"{best.contour:.2f} ({min_contour} at least); the first, and "
            f"{PICTURES.contour_weight:g} times the last, are {told:.2f} together "
            f"({min_evidence} at least)",
        )
    deviations = np.sqrt(np.diag(best.covariance))
    pose = fit.camera_covariances(best.found, best.covariance)[0]
    found = RegisteredCamera(
        best.camera, pose, frame_misfits(seen, best.camera.X_CW, best.ratios, best.inliers),
        np.array([np.linalg.inv(X) for X in start.alternatives]).reshape(-1, 4, 4),
    )  # fmt: skip
    distance = float(np.linalg.norm(best.camera.X_WC[:3, 3] - seen.middle))
    if found.translation_sd > max_sd * distance or found.rotation_sd > max_sd:
        raise _unexplained(
            start.camera,
            f"the best, {distance:.1f} m away, has a standard deviation of "
            f"{1e3 * found.translation_sd:.0f} mm and {np.degrees(found.rotation_sd):.1f} degrees",
        )
    clock = None
    if TIME_OFFSET in fit.names:
        deviation = float(deviations[fit.names.index(TIME_OFFSET)])
        clock = replace(start.clock, deviation=deviation if deviation < max_clock_sd else np.inf)
    return PictureRegistration(
        found,
        tuple(replace(frame, values=frame.values - zeros) for frame in seen.frames),
        {one.name: recording.picture(one.name) for one in seen.frames},
        best,
        clock,
        float(deviations[fit.per_camera - 1]) if focal else 0.0,
        recording,
        zeros,
    )


def _unexplained(camera: PinholeCamera, why: str) -> RegistrationError:
    """That no pose explains a camera's pictures."""
    return RegistrationError(
        f"camera '{camera.name}': no pose explains its pictures: {why}. Does the camera stand "
        "still, does the robot move much in view of it, are the joint positions of these "
        "pictures' moments (none dropped, none repeated), in the model's zeros and signs, and "
        "is the focal length about right? Nothing was written"
    )


def evaluate_pictures(
    body: RegistrationBody,
    one: PictureRegistration,
    found: RegisteredCamera,
    *,
    most: int = 300,
    at_once: int = 20,
    shown: float = 0.01,
    min_overlap: float = 0.9,
) -> tuple[tuple[PosedFrame, ...], tuple[FrameMisfit, ...], tuple[str, ...]]:
    """Which of a recording's pictures contradict the others; of many, some spread over all.

    Args:
        one: what was found in some of them.
        found: the camera, where it is known to be by now.
        most, at_once: maximum number of pictures, and of those in memory together.
        shown: a picture shows the body where it should cover this share of it.
        min_overlap: dark and blurred contours fit badly where the body is right, too: a frame
            agrees, too, that overlaps this fraction of what those of the fit do in the median.

    Returns:
        the frames that show it, with masks; their misfits; names of frames in which nothing is seen
        of a body that should be.
    """
    count = len(one.recording.names)
    rows = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    overlaps = [frame.iou for frame in one.found.frames if frame.is_inlier]
    min_iou = min_overlap * float(np.median(overlaps))
    least = inlier_threshold(one.fit.ratios)
    known, camera = one.fit.background, found.camera
    outlines = simplify_or_hull(body.coarse, PICTURES.triangles[-1])
    offset = 0.0 if one.offset is None else one.offset.value

    def see(posed: PosedPicture) -> tuple[str, PosedFrame | None] | None:
        covered = draw_mask(outlines, camera.X_CW @ body.kinematics.poses(posed.values), camera)
        if covered.mean() < shown:
            return None
        light = estimate_gain(posed.picture, known.colours)
        return posed.name, segment_picture(posed, known, light, covered)

    frames, misfits, lost = list[PosedFrame](), list[FrameMisfit](), list[str]()
    for k in range(0, len(rows), at_once):
        pictures = posed_pictures(
            one.recording.with_offsets(one.zeros), rows[k : k + at_once], offset
        )
        told = [each for each in map_ordered(see, pictures) if each is not None]
        lost += [name for name, frame in told if frame is None]
        seen = [frame for _, frame in told if frame is not None]
        if seen:
            whole = PosedFrames(body.kinematics, body.full, camera, seen)
            fit = SharedFit([whole], [camera.X_CW], fit_biases=False)
            ratios = fit.inlier_ratios(fit.start)
            misfits += [
                replace(each, is_inlier=each.is_inlier or each.iou >= min_iou)
                for each in frame_misfits(whole, camera.X_CW, ratios, ratios >= least)
            ]
            # Odds fill the memory.
            frames += [
                replace(frame, values=frame.values - one.zeros, foreground=None, rates=None)
                for frame in seen
            ]
    return tuple(frames), tuple(misfits), tuple(lost)
