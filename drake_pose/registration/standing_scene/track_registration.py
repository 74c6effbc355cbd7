"""Register a camera on a robot's link from pictures of a scene that stands still."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import stdtr, stdtrit

from drake_pose.arrays import Array, Picture
from drake_pose.body import inverse_transforms
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, listed
from drake_pose.registration.hand_eye import rotation_spread
from drake_pose.registration.joint_offsets import KinematicParameter
from drake_pose.registration.picture_registration import TimeOffset, choose_pictures
from drake_pose.registration.recording import Recording
from drake_pose.registration.register import FrameMisfit, RegisteredCamera, RegistrationBody
from drake_pose.registration.standing_scene.hand_eye_tracks import (
    EpipolarSearch,
    TrackFit,
    TrackProblem,
    fit_tracks,
    gauge_constants,
    intrinsics_effect,
    jackknife,
    poses_differ,
)
from drake_pose.registration.standing_scene.picture_matches import (
    Matches,
    Sightings,
    match_pictures,
)


class TrackRegistrationSettings(NamedTuple):
    """Settings of a registration from a standing scene; chosen as those of `TrackSettings`.

    Args:
        pictures, moving: maximum numbers of slow and of fast pictures that are used.
        least: minimum number of matches in all pairs of pictures.
        chance_rotations: number of rotations searched with joints of other moments.
        least_gain: a pose explains at least this many times what joints of other moments explain.
        joint_sd, time_sd, focal_sd: prior standard deviations of joint offsets [rad or m], of the
            time offset [s], and of the logarithm of an unknown focal length.
        focals: focal lengths from which the search for an unknown one starts [given one].
        times: time offsets from which it starts [s].
        least_turn: minimum rotation of the link about a second axis [deg].
        least_motion: minimum standard deviation of the link's position [mm].
        determined: maximum standard deviation of a determined constant, over the prior's.
        max_sd: maximum standard deviation of a determined pose along any axis [rad, m].
        better: joint offsets that lower the residuals by this factor are likely.
    """

    pictures: int = 16
    moving: int = 6
    least: int = 100
    chance_rotations: int = 1000
    least_gain: float = 2.0
    joint_sd: float = 0.2
    time_sd: float = 0.2
    focal_sd: float = 0.2
    focals: tuple[float, ...] = (0.65, 0.8, 1.0, 1.25)
    times: tuple[float, ...] = (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)
    least_turn: float = 2.0
    least_motion: float = 5.0
    determined: float = 0.2
    max_sd: float = 0.04
    better: float = 1.5


STANDING_SCENE = TrackRegistrationSettings()


@dataclass(frozen=True, eq=False)
class TrackRegistration:
    """A camera on a link, registered from what stands still in its pictures.

    Args:
        found: the camera at X_LC. Its frames have no silhouettes: E_total and IoU are nan, and the
            inlier ratio is that of the points.
        time_offset: of the camera's clock; None: the log has no times.
        focal_deviation: relative standard deviation of the focal length; 0: it was given.
        offsets: of the joints that were asked for.
        likely: names of joints whose offsets explain the pictures much better, if none were asked
            for; the camera's covariance then includes their effect.
        explained, chance: fraction of matches that the pose explains, and the largest one that a
            pose explains with joints of other moments.
        seen: the points' sightings, by index of the frames of `found`.
        inliers: (n,) which sightings fit.
        pictures: the pictures by frame.
    """

    found: RegisteredCamera
    time_offset: TimeOffset | None
    focal_deviation: float
    offsets: tuple[KinematicParameter, ...]
    likely: tuple[str, ...]
    explained: float
    chance: float
    seen: Sightings
    inliers: NDArray[np.bool_]
    pictures: dict[str, Picture]


def register_tracks(
    body: RegistrationBody,
    link: str,
    base: int,
    camera: PinholeCamera,
    recording: Recording,
    focal: bool = False,
    offset_joints: Sequence[str] = (),
) -> TrackRegistration:
    """Estimate the pose of a camera on a link from its pictures; nothing in them need be known.

    Args:
        body: the robot, whose pose tree starts at the link.
        link: the link's name.
        base: index of a node of this tree that stands still.
        camera: its pose is not used.
        recording: the camera's pictures and the joint log.
        focal: whether the focal length is fitted.
        offset_joints: joints whose offsets are fitted.

    Raises RegistrationError: too little is matched, no pose explains it, or the link's motion does
        not determine the pose; the message says what would help.
    """
    settings, names = STANDING_SCENE, body.kinematics.names
    slow, fast = choose_pictures(body, camera, recording, settings.pictures, moving=settings.moving)
    rows = sorted({*slow, *fast})
    link_poses = _link_poses(body, base, recording, rows)
    _require_motion(camera, link, link_poses(np.zeros(1 + len(names))))
    pictures = [recording.read(k) for k in rows]
    matches, seen = match_pictures(pictures)
    _require_matches(camera, matches, len(rows))
    nothing = np.zeros(2 + len(names))
    start = _search(camera, matches, link_poses, nothing, focal, recording.times is not None)
    _require_explained(camera, link, start)
    asked = np.array([name in offset_joints for name in names])
    sds = np.concatenate(
        [
            [settings.focal_sd * focal, settings.time_sd * (recording.times is not None)],
            settings.joint_sd * asked,
        ]
    )
    problem = TrackProblem(camera, link_poses, seen, sds)
    problem, fit = _fit_determined(problem, start.X_LC[0], start.constants)
    _require_determined(camera, link, link_poses(fit.constants[1:]), fit.X_LC, fit.covariance)
    covariance = jackknife(problem, fit) + intrinsics_effect(problem, fit)
    others = [fit_tracks(problem, X, start.constants) for X in start.X_LC[1:]]
    alike = [
        one.X_LC
        for one in others
        if one.sigma < 1.1 * fit.sigma and poses_differ(one.X_LC, fit.X_LC)
    ]
    likely: tuple[str, ...] = ()
    if not asked.any():
        likely, effect = _likely_offsets(body, problem, fit)
        covariance[:6, :6] += np.outer(effect, effect)
    _require_determined(camera, link, link_poses(fit.constants[1:]), fit.X_LC, covariance, likely)
    scale = float(np.exp(fit.constants[0]))
    placed = replace(
        camera, focal_x=scale * camera.focal_x, focal_y=scale * camera.focal_y
    ).with_pose(fit.X_LC)
    J = np.kron(np.eye(2), fit.X_LC[:3, :3])
    misfits = _misfits([recording.names[k] for k in rows], seen, fit)
    found = RegisteredCamera(
        placed, J @ covariance[:6, :6] @ J.T, misfits, np.array(alike).reshape(-1, 4, 4)
    )
    deviations = np.sqrt(np.diag(covariance))
    return TrackRegistration(
        found,
        _time_offset(recording, float(fit.constants[1]), float(deviations[7])),
        float(deviations[6]),
        _describe_offsets(names, offset_joints, problem, fit, deviations),
        likely,
        start.explained,
        start.chance,
        seen,
        fit.inliers,
        dict(zip((one.frame for one in misfits), pictures, strict=True)),
    )


def _link_poses(
    body: RegistrationBody, base: int, recording: Recording, rows: Sequence[int]
) -> Callable[[Array], Array]:
    """Return a function of a time offset [s] and offsets of all values, (1 + m,) in all.

    It returns the link's poses (pictures, 4, 4) with the node `base` as the world.
    """
    at_once = recording.values_at(0.0)[rows]

    def poses(constants: Array) -> Array:
        values = recording.values_at(float(constants[0]))[rows]
        # The log may end before the last picture's time.
        values = np.where(np.isfinite(values), values, at_once) + constants[1:]
        return inverse_transforms(np.array([body.kinematics.poses(one)[base] for one in values]))

    return poses


class _Start(NamedTuple):
    """Result of the search.

    X_LC: poses (4, 4), best first; constants: (2 + m,) of the best one; explained and chance: see
    ``TrackRegistration``; matches: number of matches.
    """

    X_LC: list[Array]
    constants: Array
    explained: float
    chance: float
    matches: int


def _search(
    camera: PinholeCamera,
    matches: Matches,
    link_poses: Callable[[Array], Array],
    nothing: Array,
    focal: bool,
    timed: bool,
) -> _Start:
    """Search the pose, the time offset (if `timed`) and the focal length (if `focal`).

    nothing: (2 + m,) the constants 0.
    """
    settings, X_WL = STANDING_SCENE, link_poses(nothing[1:])
    scales = settings.focals if focal else (1.0,)
    tried = []
    for scale in scales:
        scaled = replace(camera, focal_x=scale * camera.focal_x, focal_y=scale * camera.focal_y)
        search = EpipolarSearch(scaled, matches)
        tried.append((search.search(X_WL), scale, search))
    found, scale, search = max(tried, key=lambda one: one[0][0][0])
    (explained, X_LC), constants = found[0], nothing.copy()
    constants[0] = math.log(scale)
    for time in settings.times if timed else ():
        at = constants.copy()
        at[1] = time
        gain, X = search.refine(link_poses(at[1:]), X_LC)
        if gain > explained:
            explained, best, constants = gain, X, at
            found = [(gain, best), *found[1:]]
    n = len(X_WL)
    shifts = {max(1, round(part * n)) for part in (0.25, 0.5, 0.75)}
    chance = max(
        search.search(np.roll(X_WL, shift, axis=0), settings.chance_rotations)[0][0]
        for shift in shifts
    )
    poses = [X for gain, X in found if gain > 0.7 * explained]
    return _Start(poses[:3], constants, explained, chance, len(matches.uv))


def _require_matches(camera: PinholeCamera, matches: Matches, count: int) -> None:
    """Raise RegistrationError if too little is matched between `count` pictures."""
    pairs = len(np.unique(matches.frames, axis=0))
    if len(matches.uv) < STANDING_SCENE.least or pairs < 3:
        raise RegistrationError(
            f"camera '{camera.name}': between its {count} pictures {len(matches.uv)} points of the "
            f"scene were matched, in {pairs} pairs of pictures; {STANDING_SCENE.least} in three "
            "pairs are needed. Is the scene without texture, dark or blurred, or does the camera "
            "see little but the gripper? Put printed pages or objects where the camera looks, move "
            "slowly, or give a --target or masks. Nothing was written"
        )


def _require_explained(camera: PinholeCamera, link: str, start: _Start) -> None:
    """Raise RegistrationError if joints of other moments explain about as much."""
    if start.explained < STANDING_SCENE.least_gain * start.chance:
        raise RegistrationError(
            f"camera '{camera.name}': no pose on link '{link}' explains how its pictures move: the "
            f"best one explains {start.explained:.0%} of {start.matches} matched points, where "
            f"joint positions of other moments explain {start.chance:.0%}; twice as much is "
            f"needed. Does the camera ride on link '{link}' "
            f"(name the one that does: --camera NAME), does the scene stand still, are the "
            "joint positions those of these pictures, are the pictures not mirrored, and is the "
            "focal length about right? Nothing was written"
        )


def _require_motion(camera: PinholeCamera, link: str, X_WL: Array) -> None:
    """Refuse motions of the link that determine no camera's pose on it, before any work.

    Raises RegistrationError: states how far the link turns and moves.
    """
    turns = np.degrees(rotation_spread(X_WL[:, :3, :3]))
    moved = 1e3 * float(np.linalg.norm(X_WL[:, :3, 3].std(axis=0)))
    if turns[1] < STANDING_SCENE.least_turn or moved < STANDING_SCENE.least_motion:
        raise RegistrationError(
            f"camera '{camera.name}': between its pictures link '{link}' turns by {turns[0]:.0f} "
            f"degrees about one axis and by {turns[1]:.1f} about others, and moves by {moved:.0f} "
            f"mm (standard deviations): its pictures do not determine "
            + ("its position along that axis" if moved >= STANDING_SCENE.least_motion else "scale")
            + ". Rotate the wrist by 20 degrees or more about at least two axes, and move it by "
            "100 mm, while the camera sees the same objects. Nothing was written"
        )


def _require_determined(
    camera: PinholeCamera,
    link: str,
    X_WL: Array,
    X_LC: Array,
    covariance: Array,
    likely: Sequence[str] = (),
) -> None:
    """Refuse a pose with too large standard deviations, and name the direction.

    covariance: as of ``TrackFit``. likely: joints whose offsets are likely.

    Raises RegistrationError: states direction, standard deviation, and how the link turned.
    """
    worst = []
    for what, part in (("rotation about", slice(0, 3)), ("position along", slice(3, 6))):
        variances, axes = np.linalg.eigh(covariance[part, part])
        if (sd := math.sqrt(variances[-1])) > STANDING_SCENE.max_sd:
            axis = X_LC[:3, :3] @ axes[:, -1]
            axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
            size = f"{math.degrees(sd):.1f} degrees" if part.start == 0 else f"{1e3 * sd:.0f} mm"
            known = "more than 1000 mm" if part.start and sd > 1.0 else size
            worst.append(
                f"its {what} ({', '.join(f'{x:.2f}' for x in axis)}) of link '{link}' (standard "
                f"deviation {known})"
            )
    if worst:
        turns = np.degrees(rotation_spread(X_WL[:, :3, :3]))
        if likely:
            raise RegistrationError(
                f"camera '{camera.name}': with the joint positions as logged its pictures do not "
                f"determine {' and '.join(worst)}: offsets of {listed(likely)} explain the "
                "pictures much better: estimate them, too (--zeros all). Nothing was written"
            )
        raise RegistrationError(
            f"camera '{camera.name}': its pictures do not determine {' and '.join(worst)}: between "
            f"them the link turns by {turns[0]:.0f} degrees about one axis, by {turns[1]:.1f} and "
            f"{turns[2]:.1f} about the others. Rotate the wrist by 20 degrees or more about at "
            "least two axes while the camera sees the same objects. Nothing was written"
        )


def _fit_determined(
    problem: TrackProblem, X_LC: Array, constants: Array
) -> tuple[TrackProblem, TrackFit]:
    """Fit with those joint offsets that the pictures determine; the others are held at 0.

    X_LC, constants: from which the fit starts.
    """
    sds = problem.prior_sds.copy()
    sds[2:][gauge_constants(problem, X_LC, constants)[2:]] = 0.0
    while True:
        problem = problem._replace(prior_sds=sds)
        fit = fit_tracks(problem, X_LC, np.where(sds > 0.0, constants, 0.0))
        deviations = np.sqrt(np.diag(fit.covariance)[8:].clip(min=0.0))
        ratios = deviations / np.where(sds[2:] > 0.0, sds[2:], np.inf)
        if not len(ratios) or ratios.max() <= STANDING_SCENE.determined:
            return problem, fit
        sds = sds.copy()
        sds[2 + int(np.argmax(ratios))] = 0.0


def _likely_offsets(
    body: RegistrationBody, problem: TrackProblem, fit: TrackFit
) -> tuple[tuple[str, ...], Array]:
    """Return the joints whose offsets explain the pictures much better, and their effect.

    The effect (6,) is how X_LC would change, as a twist along the camera's axes.
    """
    sds = problem.prior_sds.copy()
    sds[2:] = np.where(body.kinematics.is_angle, STANDING_SCENE.joint_sd, 0.0)
    free = problem._replace(prior_sds=sds)
    free, other = _fit_determined(free, fit.X_LC, fit.constants)
    if fit.sigma < STANDING_SCENE.better * other.sigma:
        return (), np.zeros(6)
    deviations = np.sqrt(np.diag(jackknife(free, other)))[8:]
    off = np.abs(other.constants[2:]) > 2.0 * np.maximum(deviations, 1e-9)
    by = inverse_transforms(fit.X_LC) @ other.X_LC
    return (
        tuple(name for name, one in zip(body.kinematics.names, off, strict=True) if one),
        np.concatenate([Rotation.from_matrix(by[:3, :3]).as_rotvec(), by[:3, 3]]),
    )


def _misfits(
    names: Sequence[str], seen: Sightings, fit: TrackFit, least: float = 0.5
) -> tuple[FrameMisfit, ...]:
    """Return how well each frame's points fit; frames with under `least` inliers are outliers."""
    count = np.bincount(seen.frames, minlength=len(names))
    good = np.bincount(seen.frames[fit.inliers], minlength=len(names))
    ratios = good / np.maximum(count, 1)
    return tuple(
        FrameMisfit(name, math.nan, math.nan, float(ratio), bool(ratio >= least))
        for name, ratio in zip(names, ratios, strict=True)
    )


def _time_offset(recording: Recording, value: float, deviation: float) -> TimeOffset | None:
    """Return the time offset [s]; None: the log has no times."""
    if recording.times is None:
        return None
    known = deviation < STANDING_SCENE.determined * STANDING_SCENE.time_sd
    return TimeOffset(value, deviation if known else np.inf, np.zeros((0, 2)))


def _describe_offsets(
    names: Sequence[str],
    asked: Sequence[str],
    problem: TrackProblem,
    fit: TrackFit,
    deviations: Array,
    level: float = 0.05,
) -> tuple[KinematicParameter, ...]:
    """Return the offsets of the joints that were asked for, tested at a level for all of them."""
    freedom, found = max(1, len(np.unique(problem.seen.frames)) // 2 - 1), []
    freedom = min(freedom, 11)
    for name in asked:
        k = 2 + list(names).index(name)
        if not problem.prior_sds[k]:
            ends = (-math.inf, math.inf)
            found.append(KinematicParameter(name, 0.0, math.inf, *ends, False))
            continue
        value, deviation = float(fit.constants[k]), float(deviations[6 + k])
        width = float(stdtrit(freedom, 1.0 - 0.5 * level)) * deviation
        p_value = 2.0 * float(stdtr(freedom, -abs(value) / deviation))
        found.append(
            KinematicParameter(
                name, value, deviation, value - width, value + width, p_value < level / len(asked)
            )
        )
    return tuple(found)
