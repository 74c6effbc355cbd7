"""Register a camera and its clock from pictures and a joint log.

The search uses frames in which the robot hardly moves, so that a time offset does little harm. With
the pose held, time offsets between the pictures' clock and the log's are then scanned. Finally
pose, time offset and, if requested, focal length and joint offsets are fitted together to these
frames and the fastest ones.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
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
    """Pictures of one camera, and a joint log.

    Args:
        names: names of the n pictures.
        values_at: returns the pose tree's values (n, m) at the pictures' times plus an offset [s],
            one for all pictures or (n,); NaN for times without a log.
        read: returns picture k (H, W, 3).
        times: (n,) times of the pictures [s]; None: the log has no times, and the values do not
            depend on the offset.
    """

    names: tuple[str, ...]
    values_at: Callable[[float | Array], Array]
    read: Callable[[int], Picture]
    times: Array | None

    def rates_at(self, offset: float) -> Array | None:
        """Return the values' velocities (n, m) [rad/s or m/s] at an offset [s]; None: unknown."""
        if self.times is None:
            return None
        step = PICTURES.rate_step
        ahead, behind = (self.values_at(offset + by) for by in (step, -step))
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

    def with_drift(self, drift: float, since: float) -> "Recording":
        """Return the recording with a log clock faster by a drift [s/s], right at `since` [s]."""
        if not drift or self.times is None:
            return self
        later = drift * (self.times - since)
        return replace(self, values_at=lambda offset: self.values_at(offset + later))


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """Time offset of a camera: how much later than the pictures' times their joints are logged.

    Args:
        value, deviation: the offset at the frames' mean time, and its standard deviation [s];
            infinite if the pictures do not determine it.
        scores: (k, 2) scanned offsets [s], and their scores over the best one's.
        drift, drift_deviation: growth of the offset and its standard deviation [s/s]; the drift is
            0 where it is not significant, and its deviation infinite where it was not fitted.
    """

    value: float
    deviation: float
    scores: Array
    drift: float = 0.0
    drift_deviation: float = np.inf

    @property
    def determined(self) -> bool:
        """Whether the pictures determine it."""
        return bool(np.isfinite(self.deviation))


NO_CLOCK = TimeOffset(0.0, np.inf, np.zeros((0, 2)))
"""The offset of pictures without information about it."""


@dataclass(frozen=True, eq=False)
class PictureRegistration:
    """A camera registered from its pictures.

    Args:
        found: the camera.
        frames: its frames, with masks and foreground log-odds, at the logged joint values.
        pictures: the pictures of these frames, by name.
        fit: the final fit.
        time_offset: of the camera's clock; None: the log has no times.
        focal_deviation: relative standard deviation of the focal length; 0: it was not fitted.
        recording: the recording, with the drift of its clock removed.
        joint_offsets: (m,) added to the frames' values for their masks and log-odds.
    """

    found: RegisteredCamera
    frames: tuple[PosedFrame, ...]
    pictures: dict[str, Picture]
    fit: PictureFit
    time_offset: TimeOffset | None
    focal_deviation: float
    recording: Recording
    joint_offsets: Array


def register_pictures(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    focal: bool = False,
    offset_joints: Sequence[str] = (),
) -> PictureRegistration:
    """Estimate a camera's pose and time offset from pictures of a moving robot.

    Args:
        body: the robot's surfaces and pose tree.
        camera: the camera; its pose is not used.
        recording: the camera's pictures and the joint log.
        focal: whether the focal length is fitted.
        offset_joints: joints whose offsets are fitted. Their significance is not tested here
            (``calibrate_joints`` does), but masks follow them.

    Raises RegistrationError: there are too few pictures with joint positions, the robot does not
        move, or no pose explains the pictures; the message says so if mirrored pictures fit.
    """
    chosen = choose_pictures(body, camera, recording)
    try:
        return _register(body, camera, recording, chosen, focal, offset_joints)
    except RegistrationError as error:
        mirrored = camera.mirrored(), recording.mirrored()
        try:
            _register(body, *mirrored, chosen, focal, offset_joints)
        except RegistrationError:
            raise error from None
        raise RegistrationError(
            f"camera '{camera.name}': its pictures are mirrored: a pose explains them only with "
            "left and right exchanged. Mirror them again. Nothing was written"
        ) from error


def _register(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    frames: tuple[list[int], list[int]],
    focal: bool,
    offset_joints: Sequence[str],
    most: int = 3,
) -> PictureRegistration:
    """As register_pictures, without a test for mirrored pictures.

    frames: indices as of choose_pictures. most: maximum number of pose hypotheses that are fitted.
    """
    chosen, moving = frames
    search = PictureSearch(body, camera, posed_pictures(recording, chosen, 0.0))
    fitted = map_ordered(search.coarse_fit, search.search()[:most])
    near = sorted((one for one in fitted if one is not None), key=lambda one: -evidence(*one[1]))
    if not near:
        raise _unexplained(camera, "no pose shows the body in two pictures")
    level, start = search.compared, near[0][0]
    gains = level.tile_gains(start.X_CW)
    # Hypotheses that explain about as much are fitted again: they may converge to the best one.
    close = [
        one.X_CW
        for one, _ in near[1:]
        if vuong_statistic(gains, level.tile_gains(one.X_CW)) <= 1.96
    ]
    again = map_ordered(search.coarse_fit, close)
    alike = [one[0].X_CW for one in again if one is not None]
    alternatives = level.distinct([start.X_CW, *alike])[1:]
    both, clock = [*chosen, *moving], NO_CLOCK
    if recording.times is not None:
        clock = scan_time_offsets(body, start, recording, both)
    found = PictureStart(start, both, clock, alternatives)
    return fit_pictures(body, found, recording, focal, offset_joints)


class PictureStart(NamedTuple):
    """Result of a search.

    camera: at its approximate pose. rows: indices of the recording's pictures to fit. clock: the
    time offset. alternatives: other poses X_CW (4, 4) that explain the pictures about as well.
    """

    camera: PinholeCamera
    rows: Sequence[int]
    clock: TimeOffset
    alternatives: Sequence[Array]

    @classmethod
    def of(cls, one: PictureRegistration) -> "PictureStart":
        """Return a start from an earlier registration."""
        rows = [one.recording.names.index(frame.name) for frame in one.frames]
        others = [np.linalg.inv(X) for X in one.found.alternatives]
        return cls(one.found.camera, rows, one.time_offset or NO_CLOCK, others)


def fit_pictures(
    body: RegistrationBody,
    start: PictureStart,
    recording: Recording,
    focal: bool = False,
    offset_joints: Sequence[str] = (),
    *,
    most_fits: int = 5,
    min_drift: float = 0.005,
    drift_sds: float = 4.0,
) -> PictureRegistration:
    """Fit a camera with its clock from a search result.

    Args:
        start: the search result.
        recording: the recording as it is, with any drift of its clock.
        focal: whether the focal length is fitted.
        offset_joints: joints whose offsets are fitted.
        most_fits: maximum number of fits of the drift. A fit is repeated if the estimated drift
            changed by more than its standard deviation and more than `min_drift`.
        min_drift: minimum change of the offset over the recording [s].
        drift_sds: a drift is significant beyond this many standard deviations.

    Raises RegistrationError: no pose explains the pictures.
    """
    scanned_drift = start.clock.drift
    without = start._replace(clock=replace(start.clock, drift=0.0))
    fit = partial(_fit_until_stable, body, recording, focal, offset_joints)
    steady = best, as_now, start, assumed = fit(without)
    if recording.times is None:
        return _describe(*steady, focal)
    if scanned_drift:
        clock = replace(without.clock, drift=scanned_drift)
        best, as_now, start, assumed = fit(without._replace(clock=clock))
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
        clock = replace(clock, drift=clock.drift + more)
        best, as_now, start, assumed = fit(start._replace(clock=clock))
    drifts = abs(start.clock.drift) > drift_sds * start.clock.drift_deviation
    return _describe(*((best, as_now, start, assumed) if drifts else steady), focal)


def _fit_until_stable(
    body: RegistrationBody,
    recording: Recording,
    focal: bool,
    offset_joints: Sequence[str],
    start: PictureStart,
) -> tuple[PictureFit, Recording, PictureStart, Array]:
    """Fit a camera with a known drift, and repeat with new masks until offsets settle.

    A fit is repeated, at most three times, if the time offset changed by 20 ms or more or a joint
    offset by 0.3 degrees or more; without joint offsets at most once.

    start: the camera near its pose, and the clock, whose drift is held.

    Returns:
        the fit; the recording without drift; the start with the fitted camera and time offset; and
        the joint offsets (m,) that the frames were segmented with.
    """
    camera, offset, names = start.camera, start.clock.value, body.kinematics.names
    constants = ((TIME_OFFSET,) if recording.times is not None else ()) + tuple(offset_joints)
    joint_offsets, left = np.zeros(len(names)), 4 if offset_joints else 2
    as_now = recording.with_drift(start.clock.drift, _mean_time(recording, start.rows))
    while True:
        left -= 1
        frames = posed_pictures(as_now.with_offsets(joint_offsets), start.rows, offset)
        best = PictureSearch(body, camera, frames).fit(camera, constants, focal)
        if best is None:
            raise _unexplained(camera, "the body leaves the pictures")
        found = dict(zip(best.fit.names, best.found.shared.tolist(), strict=True))
        camera, by = best.camera, found.get(TIME_OFFSET, 0.0)
        assumed, turn = joint_offsets, np.array([found.get(name, 0.0) for name in names])
        most = SHARED.max_constant
        offset, joint_offsets = offset + by, np.clip(joint_offsets + turn, -most, most)
        if not left or (abs(by) < 0.02 and np.abs(turn).max() < np.radians(0.3)):
            done = start._replace(camera=camera, clock=replace(start.clock, value=offset))
            return best, as_now, done, assumed


def _mean_time(recording: Recording, rows: Sequence[int]) -> float:
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
    """Choose the frames of a search, and the fastest others.

    Args:
        count, moving: maximum number of search frames, and of fast frames.
        slow_fraction: search frames are among the slower ones, up to this quantile of the speed.
        min_motion: minimum motion of any part [m].

    Returns:
        the indices of both, most dissimilar frames first; no fast ones without velocities.

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


def posed_pictures(
    recording: Recording, indices: Sequence[int], offset: float
) -> list[PosedPicture]:
    """Return pictures, by their indices, that have logged values at a time offset [s]."""
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
    """Return the time offset that explains pictures best, for a camera at a known pose.

    Offsets from -1 to 1 s are scanned, then drifts of the log's clock. Standard deviations are not
    estimated (infinite).

    Args:
        indices: of the pictures that are used.
        rates: scanned drifts [s/s].
        start_within: for a drift both clocks start together within this time [s].
        much_better: minimum ratio of a drift's score to that of the best constant offset.
    """
    offsets = np.linspace(-1.0, 1.0, 81)
    frames = posed_pictures(recording, indices, 0.0)
    level = PictureSearch(body, camera, frames).compared
    names = [one.name for one in frames]
    rows = [recording.names.index(name) for name in names]

    def gains_at(clock: Recording, tried: Array) -> Array:
        """Return log-likelihood gains (k,) at k time offsets [s]; NaN without logged joints."""
        found = np.full(len(tried), np.nan)
        for k, offset in enumerate(tried):
            values = clock.values_at(float(offset))[rows]
            if np.isfinite(values).all():
                X_WN = np.array([body.kinematics.poses(one) for one in values])
                found[k] = level.statistics(camera.X_CW, X_WN)[Explained.GAIN]
        return found

    scores = gains_at(recording, offsets)
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
            gains = gains_at(recording.with_drift(rate, first), starts)
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
    joint_offsets: Array,
    focal: bool,
    *,
    min_explained: float = 0.12,
    min_ratio: float = 0.42,
    min_contour: float = 0.16,
    min_evidence: float = 1.05,
    max_sd: float = 0.04,
    max_clock_sd: float = 0.1,
) -> PictureRegistration:
    """Return the registration of a fit, if it explains the pictures.

    The first four arguments are what `_fit_until_stable` returns.

    Args:
        min_explained: minimum explained fraction; correct poses have 0.2 or more, a wrong one that
            few frames supported 0.09.
        min_ratio: minimum mean inlier ratio; correct poses have 0.5 or more, the best wrong ones
            0.3, one with a fitted focal length 0.6.
        min_contour: minimum strength of edges along contours beyond chance; correct poses have 0.17
            or more, the best wrong ones 0.13, one with a fitted focal length 0.17.
        min_evidence: minimum of both together; correct poses have 1.2 or more, wrong ones 0.9.
        max_sd: maximum standard deviation of the pose [distance from the body; rad]. Correct poses
            have 0.01; mirrored pictures fit a pose from behind, with 0.05.
        max_clock_sd: a time offset with a larger standard deviation is not determined [s].

    Raises RegistrationError: a criterion is not met.
    """
    fit, (posed,) = best.fit, best.fit.views
    ratio = float(best.ratios[best.inliers].mean())
    score = evidence(best.explained, best.contour)
    least = (min_explained, min_ratio, min_contour, min_evidence)
    if (np.array([best.explained, ratio, best.contour, score]) < least).any():
        raise _unexplained(
            start.camera,
            f"the best one explains {max(best.explained, 0.0):.0%} of all changes (minimum "
            f"{min_explained:.0%}), {ratio:.0%} of the contours fit (minimum {min_ratio:.0%}), and "
            f"edges along them are stronger than elsewhere by {best.contour:.2f} (minimum "
            f"{min_contour}); the first plus {PICTURES.contour_weight:g} times the last is "
            f"{score:.2f} (minimum {min_evidence})",
        )
    deviations = np.sqrt(np.diag(best.covariance))
    pose = fit.camera_covariances(best.found, best.covariance)[0]
    found = RegisteredCamera(
        best.camera, pose, frame_misfits(posed, best.camera.X_CW, best.ratios, best.inliers),
        np.array([np.linalg.inv(X) for X in start.alternatives]).reshape(-1, 4, 4),
    )  # fmt: skip
    distance = float(np.linalg.norm(best.camera.X_WC[:3, 3] - posed.middle))
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
        tuple(replace(frame, values=frame.values - joint_offsets) for frame in posed.frames),
        {one.name: recording.picture(one.name) for one in posed.frames},
        best,
        clock,
        float(deviations[fit.per_camera - 1]) if focal else 0.0,
        recording,
        joint_offsets,
    )


def _unexplained(camera: PinholeCamera, why: str) -> RegistrationError:
    """Return the error for pictures that no pose explains; why: words in its message."""
    return RegistrationError(
        f"camera '{camera.name}': no pose explains its pictures: {why}. Does the camera stand "
        "still, does the robot move much in its view, are the joint positions those at the "
        "pictures' times (no picture dropped or repeated), in the model's zeros and signs, and is "
        "the focal length about right? Nothing was written"
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
    """Evaluate all pictures of a recording with a registered camera.

    Args:
        body: the robot's surfaces.
        one: the registration from some of them.
        found: the camera at its final pose.
        most, at_once: maximum number of pictures, evenly spaced, and of those in memory together.
        shown: minimum fraction of the picture that the body covers; other pictures are skipped.
        min_overlap: a frame is an inlier, too, if its intersection over union is at least this
            fraction of the fit's median: dark and blurred contours fit badly even in correct poses.

    Returns:
        the frames that show the body, with masks and logged values; the misfit of each; and the
        names of frames in which the body is not visible although it covers enough of the picture.
    """
    count = len(one.recording.names)
    rows = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    overlaps = [frame.iou for frame in one.found.frames if frame.is_inlier]
    min_iou = min_overlap * float(np.median(overlaps))
    least = inlier_threshold(one.fit.ratios)
    known, camera = one.fit.background, found.camera
    outlines = simplify_or_hull(body.coarse, PICTURES.triangles[-1])
    offset = 0.0 if one.time_offset is None else one.time_offset.value

    def segment(posed: PosedPicture) -> tuple[str, PosedFrame | None] | None:
        covered = draw_mask(outlines, camera.X_CW @ body.kinematics.poses(posed.values), camera)
        if covered.mean() < shown:
            return None
        gain = estimate_gain(posed.picture, known.colours)
        return posed.name, segment_picture(posed, known, gain, covered)

    frames, misfits, lost = list[PosedFrame](), list[FrameMisfit](), list[str]()
    for k in range(0, len(rows), at_once):
        pictures = posed_pictures(
            one.recording.with_offsets(one.joint_offsets), rows[k : k + at_once], offset
        )
        named = [each for each in map_ordered(segment, pictures) if each is not None]
        lost += [name for name, frame in named if frame is None]
        posed_frames = [frame for _, frame in named if frame is not None]
        if posed_frames:
            full = PosedFrames(body.kinematics, body.full, camera, posed_frames)
            fit = SharedFit([full], [camera.X_CW], fit_biases=False)
            ratios = fit.inlier_ratios(fit.start)
            misfits += [
                replace(each, is_inlier=each.is_inlier or each.iou >= min_iou)
                for each in frame_misfits(full, camera.X_CW, ratios, ratios >= least)
            ]
            # Log-odds are dropped to save memory.
            frames += [
                replace(frame, values=frame.values - one.joint_offsets, foreground=None, rates=None)
                for frame in posed_frames
            ]
    return tuple(frames), tuple(misfits), tuple(lost)
