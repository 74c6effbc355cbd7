"""A camera, and its clock, from pictures and a joint log: found, fitted, and as sure as it is.

Frames in which the robot hardly moves carry the search, for there a clock that is off does little
harm. Then the pictures' clock is tried against the log's, the pose held; and pose, offset and, if
asked for, focal length are fitted together on those frames and the ones that move most.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.background import Explained, Light
from drake_pose.fit.covariance import excess
from drake_pose.fit.problem import TIME_OFFSET
from drake_pose.fit.surfaces import hull_of_few
from drake_pose.registration.picture_search import (
    ABOUT,
    CONTOURS,
    SEARCHED,
    PictureFit,
    PictureSearch,
    PosedPicture,
    choose_frames,
    evidence,
    node_places,
    see_picture,
)
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import (
    FrameMisfit,
    RegisteredCamera,
    RegistrationBody,
    frame_misfits,
)
from drake_pose.registration.shared_fit import SharedFit, agreeing_share
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.workers import map_ordered

# Rates are told by positions so much before and after [s].
_RATE_STEP = 0.05
# A robot whose parts move by less does not tell where a camera is [m].
_LEAST_MOTION = 0.05
# Frames that move most are fitted beside those of the search.
_MOVING = 8
# The slower share of all frames carries the search, if clocks may differ.
_SLOW = 0.6
# So many poses are fitted. A pose explains pictures in which so much of the contours fits, and
# edges along them are so much stronger than by chance. Right ones have .5 and more, .17 and more;
# the best wrong ones .3 and .13, one with a free focal length .6 and .17.
_LOOKS, _LEAST_RATIO, _LEAST_CONTOUR = 3, 0.42, 0.16
# And it explains so much of what changes: right ones .2 and more, one that few frames bore out .09.
_LEAST_EXPLAINED = 0.12
# The evidence for right ones is 1.2 and more, for the best wrong ones .9.
_LEAST_EVIDENCE = 1.05
# No pose is one of which less is known [of its distance from the body; rad]. Right ones are known
# to a hundredth; mirrored pictures are explained about as well from behind, known to a twentieth.
_MOST_SD = 0.04
# Poses are as good that explain less by no more deviations.
_SIGNIFICANCE = 1.96
# Offsets of clocks that are tried [s]; what was fitted is fitted again where an offset moved more
# than so much, or a zero, so often at most.
_OFFSETS, _AGAIN, _TURNED, _MOST_FITS = np.linspace(-1.0, 1.0, 81), 0.02, np.radians(0.3), 4
# A clock may drift that seems to by so many deviations, which what it spoils makes large, and by so
# much over all pictures [s]: it is fitted anew, so often at most. It does that is then so many
# deviations from going right.
_LIKELY, _LEAST_DRIFT, _DRIFT_FITS, _DRIFTS = 1.0, 0.005, 5, 4.0
# An offset is not told whose standard deviation is larger [s].
_UNTOLD = 0.1


@dataclass(frozen=True, eq=False)
class Recording:
    """Pictures of one camera, and the joints at their moments.

    Args:
        names: (n,) of the pictures.
        values_at: (n, m) values of the pose tree so much later [s] than the pictures' times; one
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
        """(n, m) how fast the values change [rad/s or m/s]; None: nobody knows."""
        if self.times is None:
            return None
        ahead, behind = (self.values_at(offset + by) for by in (_RATE_STEP, -_RATE_STEP))
        return np.asarray(np.nan_to_num((ahead - behind) / (2.0 * _RATE_STEP)))

    def picture(self, name: str) -> Picture:
        """A picture (H, W, 3) by its name."""
        return self.read(self.names.index(name))

    def mirrored(self) -> Recording:
        """The same with left and right exchanged in all pictures."""
        return replace(self, read=lambda k: np.ascontiguousarray(self.read(k)[:, ::-1]))

    def with_zeros(self, zeros: Array) -> Recording:
        """The same with (m,) added to all values."""
        return replace(self, values_at=lambda offset: self.values_at(offset) + zeros)

    def with_drift(self, drift: float, since: float) -> Recording:
        """The same where the joints' clock runs so much faster [s/s], and is right at a time."""
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


@dataclass(frozen=True, eq=False)
class PictureRegistration:
    """A camera that was found in its pictures.

    Args:
        found: the camera.
        frames: its frames, with masks and odds, at the joints' values of their moments.
        pictures: of these frames, by name.
        fit: that found it.
        offset: of its clock; None: the joints have no times.
        focal_deviation: over the focal length; 0: it was held.
        recording: it was found in, the joints' clock drifting no more.
        zeros: (m,) that were added to the frames' values where masks and odds were found.
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
    try:
        return _register(body, camera, recording, focal, zeros)
    except _Unexplained as error:
        try:
            _register(body, camera.mirrored(), recording.mirrored(), focal, zeros)
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
    focal: bool,
    zeros: Sequence[str],
) -> PictureRegistration:
    """As register_pictures, the pictures being as they are."""
    chosen, moving = choose_pictures(body, camera, recording)
    begin = posed_pictures(recording, chosen, 0.0)
    search = PictureSearch(body, camera, begin)
    looks = map_ordered(search.approach, search.search()[:_LOOKS])
    near = sorted((one for one in looks if one is not None), key=lambda one: -evidence(*one[1]))
    if not near:
        raise _Unexplained(camera, "no pose shows the body in two pictures")
    level, start = search.compared, near[0][0]
    pieces = level.pieces(start.X_CW)
    # Once more, for those that are on their way to the best.
    close = [
        one.X_CW for one, _ in near[1:] if excess(pieces, level.pieces(one.X_CW)) <= _SIGNIFICANCE
    ]
    again = map_ordered(search.approach, close)
    alike = [one[0].X_CW for one in again if one is not None]
    alternatives = level.distinct([start.X_CW, *alike])[1:]
    both, offset, scores = [*chosen, *moving], 0.0, np.zeros((0, 2))
    if recording.times is not None:
        offset, scores = _scan(body, start, recording, both)
    begun = _Begun(start, both, TimeOffset(offset, np.inf, scores), alternatives)
    return _fit(body, begun, recording, focal, zeros)


def refit_pictures(
    body: RegistrationBody,
    one: PictureRegistration,
    recording: Recording,
    zeros: Sequence[str] = (),
) -> PictureRegistration:
    """As register_pictures, of a camera that was found already, its focal length held.

    recording: as it is, whose joints' clock may drift.
    """
    both = [recording.names.index(frame.name) for frame in one.frames]
    told = one.offset or TimeOffset(0.0, np.inf, np.zeros((0, 2)))
    others = [np.linalg.inv(X) for X in one.found.alternatives]
    begun = _Begun(one.found.camera, both, told, others)
    return _fit(body, begun, recording, False, zeros)


class _Begun(NamedTuple):
    """A search that is done: the camera, frames that are fitted, the clock, other poses X_CW."""

    camera: PinholeCamera
    rows: Sequence[int]
    clock: TimeOffset
    alternatives: Sequence[Array]


class _Settled(NamedTuple):
    """A fit that moves no more.

    recording: its joints' clock drifts no more; begun: with the camera and the clock that were
    found, but for the offset's deviation; zeros: (m,) that were added to the frames' values;
    ratios: (frames,) of the contours, what fits; agree: those that do; covariance: (u, u) of all
    that they share.
    """

    best: PictureFit
    recording: Recording
    begun: _Begun
    zeros: Array
    ratios: Array
    agree: NDArray[np.bool_]
    covariance: Array


def _fit(
    body: RegistrationBody,
    begun: _Begun,
    recording: Recording,
    focal: bool,
    zeros: Sequence[str],
) -> PictureRegistration:
    """What a search has begun, fitted until clock and zeros move no more."""
    steady = settled = _settle(body, begun, recording, focal, zeros)
    if recording.times is None:
        return _describe(settled, focal)
    since, span = _mean_time(recording, begun.rows), float(np.ptp(recording.times))
    for left in range(_DRIFT_FITS, -1, -1):
        clock = settled.begun.clock
        more, deviation = _drift(settled, since)
        settled = settled._replace(
            begun=settled.begun._replace(clock=replace(clock, drift_deviation=deviation))
        )
        if abs(more) < max(_LIKELY * deviation, _LEAST_DRIFT / span) or not left:
            break
        again = settled.begun._replace(clock=replace(clock, drift=clock.drift + more))
        settled = _settle(body, again, recording, focal, zeros)
    clock = settled.begun.clock
    told = abs(clock.drift) > _DRIFTS * clock.drift_deviation
    return _describe(settled if told else steady, focal)


def _settle(
    body: RegistrationBody,
    begun: _Begun,
    recording: Recording,
    focal: bool,
    zeros: Sequence[str],
) -> _Settled:
    """A fit with the drift of the clock that has begun."""
    camera, offset, names = begun.camera, begun.clock.value, body.kinematics.names
    constants = ((TIME_OFFSET,) if recording.times is not None else ()) + tuple(zeros)
    turned, left = np.zeros(len(names)), _MOST_FITS if zeros else 2
    as_now = recording.with_drift(begun.clock.drift, _mean_time(recording, begun.rows))
    while True:
        frames, left = posed_pictures(as_now.with_zeros(turned), begun.rows, offset), left - 1
        best = PictureSearch(body, camera, frames).fit(camera, constants, focal)
        if best is None:
            raise _Unexplained(camera, "the body leaves the pictures")
        camera, by = best.camera, _constant(best, TIME_OFFSET)
        assumed, turn = turned, np.array([_constant(best, name) for name in names])
        offset, turned = offset + by, turned + turn
        if not left or (abs(by) < _AGAIN and np.abs(turn).max() < _TURNED):
            done = begun._replace(camera=camera, clock=replace(begun.clock, value=offset))
            ratios = best.fit.inlier_ratios(best.found)
            agree = best.fit.agreeing(ratios)
            covariance = np.sum(best.fit.covariances(best.found, agree), axis=0)
            return _Settled(best, as_now, done, assumed, ratios, agree, covariance)


def _drift(settled: _Settled, since: float) -> tuple[float, float]:
    """How much faster the joints' clock runs yet [s/s], and the standard deviation of that."""
    fit, recording, agree = settled.best.fit, settled.recording, settled.agree
    assert recording.times is not None
    rows = [recording.names.index(frame.name) for frame in fit.seen[0].frames]
    later = (recording.times[rows] - since)[agree]
    return fit.growth(settled.best.found, TIME_OFFSET, later, agree, settled.covariance)


def _mean_time(recording: Recording, rows: Sequence[int]) -> float:
    """Of some pictures [s]."""
    return 0.0 if recording.times is None else float(recording.times[list(rows)].mean())


def choose_pictures(
    body: RegistrationBody, camera: PinholeCamera, recording: Recording, count: int = SEARCHED
) -> tuple[list[int], list[int]]:
    """The frames that carry a search, so many at most, and those that move most beside them.

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
    if spread < _LEAST_MOTION:
        raise RegistrationError(
            f"camera '{camera.name}': the robot hardly moves, by {1e3 * spread:.0f} mm at most, so "
            "its pictures do not tell it from what is behind it; give an episode in which it moves"
        )
    rates = recording.rates_at(0.0)
    if rates is None:
        return known[choose_frames(places, count)].tolist(), []
    ahead = node_places(body, values[known] + _RATE_STEP * rates[known])
    speed = np.linalg.norm(ahead - places, axis=2).mean(axis=1)
    slow = np.flatnonzero(speed <= np.quantile(speed, _SLOW))
    if len(slow) < count:
        slow = np.arange(len(known))
    chosen = slow[choose_frames(places[slow], count)]
    rest = np.setdiff1d(np.argsort(-speed)[: max(_MOVING, len(known) // 4)], chosen)
    moving = rest[choose_frames(places[rest], _MOVING)] if len(rest) else rest
    return known[chosen].tolist(), known[moving].tolist()


def posed_pictures(recording: Recording, which: Sequence[int], offset: float) -> list[PosedPicture]:
    """Some frames with their pictures; those whose joints are not logged are left out."""
    values, rates = recording.values_at(offset), recording.rates_at(offset)
    return [
        PosedPicture(
            recording.names[k], values[k], recording.read(k), None if rates is None else rates[k]
        )
        for k in which
        if np.isfinite(values[k]).all()
    ]


def _scan(
    body: RegistrationBody, camera: PinholeCamera, recording: Recording, which: Sequence[int]
) -> tuple[float, Array]:
    """The offset at which a camera explains its pictures best, and what all that were tried do."""
    frames = posed_pictures(recording, which, 0.0)
    level = PictureSearch(body, camera, frames).compared
    names = [one.name for one in frames]
    rows = [recording.names.index(name) for name in names]
    scores = np.full(len(_OFFSETS), np.nan)
    for k, offset in enumerate(_OFFSETS):
        values = recording.values_at(float(offset))[rows]
        if np.isfinite(values).all():
            X_WN = np.array([body.kinematics.poses(one) for one in values])
            scores[k] = level.told(camera.X_CW, X_WN)[Explained.GAIN]
    k = int(np.nanargmax(scores))
    offset = float(_OFFSETS[k])
    if 0 < k < len(scores) - 1 and np.isfinite(scores[k - 1 : k + 2]).all():
        low, middle, high = scores[k - 1 : k + 2]
        bend = low - 2.0 * middle + high
        if bend < 0.0:
            offset += 0.5 * float((low - high) / bend) * float(_OFFSETS[1] - _OFFSETS[0])
    told = np.isfinite(scores)
    return offset, np.column_stack([_OFFSETS[told], scores[told] / max(scores[k], 1e-9)])


def _constant(fitted: PictureFit, name: str) -> float:
    """A constant of all frames, 0 where it was not fitted."""
    names = fitted.fit.names
    return float(fitted.found.shared[names.index(name)]) if name in names else 0.0


def _describe(settled: _Settled, focal: bool) -> PictureRegistration:
    """What was found; RegistrationError: it does not explain the pictures."""
    best, recording, begun, zeros, ratios, agree, covariance = settled
    fit, (seen,) = best.fit, best.fit.seen
    ratio = float(ratios[agree].mean())
    told = evidence(best.explained, best.contour)
    if (
        best.explained < _LEAST_EXPLAINED
        or ratio < _LEAST_RATIO
        or best.contour < _LEAST_CONTOUR
        or told < _LEAST_EVIDENCE
    ):
        raise _Unexplained(
            begun.camera,
            f"at best {max(best.explained, 0.0):.0%} of what changes is explained "
            f"({_LEAST_EXPLAINED:.0%} at least), {ratio:.0%} of the contours fit "
            f"({_LEAST_RATIO:.0%} at least), and edges along them are stronger than elsewhere by "
            f"{best.contour:.2f} ({_LEAST_CONTOUR} at least); the first, and {CONTOURS:g} times "
            f"the last, are {told:.2f} together ({_LEAST_EVIDENCE} at least)",
        )
    deviations = np.sqrt(np.diag(covariance))
    pose = fit.camera_covariances(best.found, covariance)[0]
    found = RegisteredCamera(
        best.camera, pose, frame_misfits(seen, best.camera.X_CW, ratios, agree),
        np.array([np.linalg.inv(X) for X in begun.alternatives]).reshape(-1, 4, 4),
    )  # fmt: skip
    distance = float(np.linalg.norm(best.camera.X_WC[:3, 3] - seen.middle))
    if found.translation_sd > _MOST_SD * distance or found.rotation_sd > _MOST_SD:
        raise _Unexplained(
            begun.camera,
            f"the best, {distance:.1f} m away, has a standard deviation of "
            f"{1e3 * found.translation_sd:.0f} mm and {np.degrees(found.rotation_sd):.1f} degrees",
        )
    clock = None
    if TIME_OFFSET in fit.names:
        deviation = float(deviations[fit.names.index(TIME_OFFSET)])
        clock = replace(begun.clock, deviation=deviation if deviation < _UNTOLD else np.inf)
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


class _Unexplained(RegistrationError):
    """No pose explains a camera's pictures."""

    def __init__(self, camera: PinholeCamera, why: str) -> None:
        super().__init__(
            f"camera '{camera.name}': no pose explains its pictures: {why}. Does the camera stand "
            "still, does the robot move much in view of it, are the joint positions of these "
            "pictures' moments (none dropped, none repeated), in the model's zeros and signs, and "
            "is the focal length about right? Nothing was written"
        )


# At most so many pictures are judged, so many at once.
_MOST, _AT_ONCE = 300, 20
# A picture shows the body where it should cover this share of it.
_SHOWN = 0.01
# A frame contradicts the others whose contours fit less, and that overlaps less than so many times
# what those of the fit do: dark and blurred contours fit badly where the body is right, too.
_OVERLAPS = 0.9


@dataclass(frozen=True, eq=False)
class JudgedPictures:
    """What all pictures show of a body whose camera was found in some of them.

    Args:
        frames: those that show it, with masks.
        misfits: of these.
        lost: frames in which nothing is seen of a body that should be.
    """

    frames: tuple[PosedFrame, ...]
    misfits: tuple[FrameMisfit, ...]
    lost: tuple[str, ...]


def judge_pictures(
    body: RegistrationBody, one: PictureRegistration, found: RegisteredCamera
) -> JudgedPictures:
    """Which of a recording's pictures contradict the others; of many, some spread over all.

    Args:
        one: what was found in some of them.
        found: the camera, where it is known to be by now.
    """
    count = len(one.recording.names)
    rows = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int)).tolist()
    fitted = one.fit.fit
    overlaps = [frame.iou for frame in one.found.frames if frame.agrees]
    least = agreeing_share(fitted.inlier_ratios(one.fit.found)), _OVERLAPS * np.median(overlaps)
    frames, misfits, lost = list[PosedFrame](), list[FrameMisfit](), list[str]()
    for k in range(0, len(rows), _AT_ONCE):
        seen = list[PosedFrame]()
        for name, frame in _see(body, one, found, rows[k : k + _AT_ONCE]):
            if frame is None:
                lost.append(name)
            else:
                seen.append(frame)
        if seen:
            misfits += _misfits(body, found, seen, least)
            # Odds fill the memory.
            frames += [
                replace(frame, values=frame.values - one.zeros, odds=None, rates=None)
                for frame in seen
            ]
    return JudgedPictures(tuple(frames), tuple(misfits), tuple(lost))


def _see(
    body: RegistrationBody,
    one: PictureRegistration,
    found: RegisteredCamera,
    rows: Sequence[int],
) -> list[tuple[str, PosedFrame | None]]:
    """Pictures that should show the body, with masks; None: nothing is seen of it."""
    known, camera = one.fit.background, found.camera
    outlines = hull_of_few(body.very_few, ABOUT)
    offset = 0.0 if one.offset is None else one.offset.value

    def see(posed: PosedPicture) -> tuple[str, PosedFrame | None] | None:
        covered = draw_mask(outlines, camera.X_CW @ body.kinematics.poses(posed.values), camera)
        if covered.mean() < _SHOWN:
            return None
        light = Light.between(posed.picture, known.colours)
        return posed.name, see_picture(posed, known, light, covered)

    pictures = posed_pictures(one.recording.with_zeros(one.zeros), rows, offset)
    return [told for told in map_ordered(see, pictures) if told is not None]


def _misfits(
    body: RegistrationBody,
    found: RegisteredCamera,
    seen: Sequence[PosedFrame],
    least: tuple[float, float],
) -> list[FrameMisfit]:
    """How well frames fit; those agree that fit, or overlap, no less."""
    whole = PosedFrames(body.kinematics, body.all, found.camera, seen)
    fit = SharedFit([whole], [found.camera.X_CW], widths=False)
    ratios, X_CW = fit.inlier_ratios(fit.start), found.camera.X_CW
    told = frame_misfits(whole, X_CW, ratios, ratios >= least[0])
    return [replace(one, agrees=one.agrees or one.iou >= least[1]) for one in told]
