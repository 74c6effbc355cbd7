"""Register a camera on a robot's link from pictures of a scene that stands still."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr, stdtrit

from drake_pose.arrays import Array, Picture
from drake_pose.body import inverse_transforms
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, listed
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.judge import LEVEL
from drake_pose.registration.hand_eye import (
    EpipolarSearch,
    LinkPoses,
    TrackFit,
    TrackProblem,
    fit_tracks,
    gauge_constants,
    intrinsics_effect,
    jackknife,
    poses_differ,
    rotation_spread,
)
from drake_pose.registration.joint_offsets import KinematicParameter
from drake_pose.registration.picture_matches import Matches, Sightings, match_pictures
from drake_pose.registration.recording import Recording, TimeOffset, choose_pictures
from drake_pose.registration.register import FrameMisfit, RegisteredCamera, RegistrationBody
from drake_pose.registration.shared_fit import SHARED


class TrackRegistrationSettings(NamedTuple):
    """Settings of a registration from a standing scene; chosen as those of `TrackSettings`.

    Args:
        pictures, moving: maximum numbers of slow and of fast pictures that are used.
        least: minimum number of matches in all pairs of pictures.
        chance_rotations: number of rotations searched with joint positions of other moments.
        least_gain: minimum explained fraction, over that with joint positions of other moments.
        time_sd, focal_sd: prior standard deviations of the time offset [s], and of the logarithm of
            an unknown focal length.
        focals: tried values of an unknown focal length [focal length of the camera model].
        times: tried time offsets [s].
        least_turn: minimum rotation of the link about a second axis, see `rotation_spread` [deg].
        least_motion: minimum standard deviation of the link's position [mm].
        max_sd: maximum standard deviation of a determined pose along any axis [rad and m].
        better: ratio of the residuals without and with joint offsets from which these are likely.
    """

    pictures: int = 16
    moving: int = 6
    least: int = 100
    chance_rotations: int = 1000
    least_gain: float = 2.0
    time_sd: float = 0.2
    focal_sd: float = 0.2
    focals: tuple[float, ...] = (0.65, 0.8, 1.0, 1.25)
    times: tuple[float, ...] = (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)
    least_turn: float = 2.0
    least_motion: float = 5.0
    max_sd: float = 0.04
    better: float = 1.5


STANDING_SCENE = TrackRegistrationSettings()


@dataclass(frozen=True, eq=False)
class TrackRegistration:
    """A camera on a link, registered from what stands still in its pictures."""

    # The camera at X_LC. Its frames have no silhouettes: E_total and IoU are nan, and the inlier
    # ratio is that of the points.
    found: RegisteredCamera
    time_offset: TimeOffset | None  # Of the camera's clock; None: the log has no times.
    focal_deviation: float  # Relative standard deviation of the focal length; 0: it was given.
    offsets: tuple[KinematicParameter, ...]  # Of the joints whose offsets were asked for.
    # Names of joints whose offsets explain the pictures much better, if no offsets were asked for;
    # the camera's covariance then includes their effect.
    likely: tuple[str, ...]
    explained: float  # Fraction of matches that the pose explains.
    chance: float  # The largest such fraction of any pose with joint positions of other moments.
    seen: Sightings  # N sightings of points, by index of the frames of `found`.
    inliers: NDArray[np.bool_]  # (n,) which sightings are inliers.
    pictures: dict[str, Picture]  # (H, W, 3) by frame name.
    # (p, 3) places of the points in the world [m], and (frames, 4, 4) poses of the link.
    points: Array
    link_poses: Array

    def points_in(self, camera: PinholeCamera) -> Array:
        """Return where a camera at a pose X_LC would see each sighting's point (n, 2) [pixel]."""
        X_CW = inverse_transforms(self.link_poses @ camera.X_WC)[self.seen.frames]
        p_WP = self.points[self.seen.points]
        p_CP = np.einsum("nij,nj->ni", X_CW[:, :3, :3], p_WP) + X_CW[:, :3, 3]
        return camera.with_pose(np.eye(4)).project(p_CP)[0]


def register_tracks(
    body: RegistrationBody,
    link: str,
    base: int,
    camera: PinholeCamera,
    recording: Recording,
    focal: bool = False,
    offset_joints: Sequence[str] = (),
) -> TrackRegistration:
    """Estimate the pose of a camera on a link from its pictures of an unknown scene.

    Args:
        body: the robot, whose pose tree starts at the link.
        link: the link's name.
        base: index of a node of this tree that stands still.
        camera: its intrinsics; its pose is not used.
        recording: the camera's pictures and the joint log.
        focal: whether the focal length is fitted.
        offset_joints: names of the joints whose offsets are fitted.

    Raises RegistrationError: too little is matched, no pose explains it, or the link's motion does
        not determine the pose; the message says what would help.
    """
    settings, names = STANDING_SCENE, body.kinematics.names
    slow, fast = choose_pictures(body, camera, recording, settings.pictures, moving=settings.moving)
    rows = sorted({*slow, *fast})
    link_poses = recorded_link_poses(body, base, recording, rows)
    pictures, timed = [recording.read(k) for k in rows], recording.times is not None
    matches, seen = match_pictures(pictures)
    asked = np.array([name in offset_joints for name in names])
    lens_sds = [settings.focal_sd * focal, settings.time_sd * timed]
    sds = np.concatenate([lens_sds, SHARED.constant_deviation * asked])
    problem = TrackProblem(camera, link_poses, seen, sds)
    _require_motion(camera, link, link_poses(np.zeros(1 + len(names))))
    _require_matches(camera, matches, len(rows))
    poses, constants, explained, chance = search_pose(problem, matches, focal, timed)
    if explained < settings.least_gain * chance:
        search, values = EpipolarSearch(camera, matches), recording.values_at(0.0)[rows]
        others = explaining_links(body, base, values, search, settings.chance_rotations)
        gain, name = (others[0][0], body.tree.nodes[others[0][1]].name) if others else (0.0, "")
        _refuse_unexplained(camera, link, len(matches.uv), explained, chance, gain, name)
    problem, fit, covariance, alike, likely = _fit_scene(body, link, problem, poses, constants)
    scale = float(np.exp(fit.constants[0]))
    placed = replace(
        camera, focal_x=scale * camera.focal_x, focal_y=scale * camera.focal_y
    ).with_pose(fit.X_LC)
    J = np.kron(np.eye(2), fit.X_LC[:3, :3])
    misfits = _misfits([recording.names[k] for k in rows], seen, fit)
    found = RegisteredCamera(
        placed, J @ covariance[:6, :6] @ J.T, misfits, np.array(alike).reshape(-1, 4, 4)
    )
    deviations, clock = np.sqrt(np.diag(covariance)), None
    if timed:
        is_known = deviations[7] < SHARED.determined * settings.time_sd
        deviation = float(deviations[7]) if is_known else np.inf
        clock = TimeOffset(float(fit.constants[1]), deviation, np.zeros((0, 2)))
    return TrackRegistration(
        found,
        clock,
        float(deviations[6]),
        describe_offsets(names, offset_joints, problem, fit, deviations),
        likely,
        explained,
        chance,
        seen,
        fit.inliers,
        dict(zip((misfit.frame for misfit in misfits), pictures, strict=True)),
        fit.points,
        problem.link_poses(fit.constants[1:]),
    )


def search_pose(
    problem: TrackProblem, matches: Matches, focal: bool, timed: bool
) -> tuple[list[Array], Array, float, float]:
    """Search the pose, and where asked the focal length and the time offset, in all matches.

    Returns poses X_LC (4, 4), best first; the constants (2 + m,) of the best one, as of
    ``TrackFit``; and `explained` and `chance` of ``TrackRegistration``.
    """
    settings, camera = STANDING_SCENE, problem.camera
    constants = np.zeros(len(problem.prior_sds))
    X_WL = problem.link_poses(constants[1:])
    searches = []
    for scale in settings.focals if focal else (1.0,):
        focal_x, focal_y = scale * camera.focal_x, scale * camera.focal_y
        search = EpipolarSearch(replace(camera, focal_x=focal_x, focal_y=focal_y), matches)
        searches.append((search.search(X_WL), scale, search))
    candidates, scale, search = max(searches, key=lambda item: item[0][0][0])
    constants[0] = math.log(scale)
    (explained, X_LC), *others = candidates
    for time in settings.times if timed else ():
        gain, X = search.refine(
            problem.link_poses(np.append(time, constants[2:])), candidates[0][1]
        )
        if gain > explained:
            explained, X_LC, constants[1] = gain, X, time
    chance = _by_chance(search, X_WL, settings.chance_rotations)
    poses = [X for gain, X in others if gain > 0.7 * explained]
    return [X_LC, *poses[:2]], constants, explained, chance


def _fit_scene(
    body: RegistrationBody,
    link: str,
    problem: TrackProblem,
    poses: Sequence[Array],
    constants: Array,
) -> tuple[TrackProblem, TrackFit, Array, list[Array], tuple[str, ...]]:
    """Fit from poses X_LC (4, 4), best first, and constants (2 + m,).

    Returns what was fitted; the fit; the covariance (7 + k, 7 + k) as of ``TrackFit``; other poses
    (4, 4) that fit as well; and `likely` of ``TrackRegistration``.

    Raises RegistrationError: the pose is not determined.
    """

    def require(covariance: Array) -> None:
        X_WL = problem.link_poses(fit.constants[1:])
        _require_determined(problem.camera, link, X_WL, fit.X_LC, covariance, likely)

    asked, likely = bool((problem.prior_sds[2:] > 0.0).any()), tuple[str, ...]()
    problem, fit = _fit_determined(problem, poses[0], constants)
    require(fit.covariance)
    if not asked:
        likely, problem, fit = _with_likely_offsets(body, problem, fit)
    covariance = jackknife(problem, fit) + intrinsics_effect(problem, fit)
    require(covariance)
    others = [fit_tracks(problem, X, constants) for X in poses[1:]]
    as_good = (other.X_LC for other in others if other.sigma < 1.1 * fit.sigma)
    alike = [X_LC for X_LC in as_good if poses_differ(X_LC, fit.X_LC)]
    return problem, fit, covariance, alike, likely


def recorded_link_poses(
    body: RegistrationBody, base: int, recording: Recording, rows: Sequence[int]
) -> LinkPoses:
    """Return a function of (1 + m,) constants: a time offset [s], and an offset for each value.

    It returns the link's poses (pictures, 4, 4) at pictures `rows`, in the frame of node `base`.
    """
    logged_values = recording.values_at(0.0)[rows]

    def poses(constants: Array) -> Array:
        values = recording.values_at(float(constants[0]))[rows]
        # The log may end before the last picture's time.
        values = np.where(np.isfinite(values), values, logged_values) + constants[1:]
        return inverse_transforms(np.array([body.kinematics.poses(row)[base] for row in values]))

    return poses


def explaining_links(
    body: RegistrationBody, base: int | None, values: Array, search: EpipolarSearch, rotations: int
) -> list[tuple[float, int, Array, Array]]:
    """Return how well cameras on the links that move explain matches, the best first.

    Args:
        body: the robot; its pose tree's first link is left out.
        base: index of a node that stands still; None: the tree starts in the world.
        values: (pictures, m) of the pose tree.
        search: in the pictures.
        rotations: number of rotations that are tried.

    Returns for each link the explained fraction of the matches, the link's node, its poses
    (pictures, 4, 4) in the base's frame, and the camera's pose X_LC (4, 4) on it. Links that stand
    still on an earlier one are left out.
    """
    X_WN = np.array([body.kinematics.poses(row) for row in values])
    if base is not None:
        X_WN = inverse_transforms(X_WN[:, [base]]) @ X_WN
    found = list[tuple[float, int, Array, Array]]()
    for k in range(0 if base is None else 1, X_WN.shape[1]):
        X_WL = X_WN[:, k]
        offsets = [inverse_transforms(one[2]) @ X_WL for one in found]
        moves = all(np.ptp(X, axis=0).max() > 1e-6 for X in offsets)
        if moves and np.ptp(X_WL, axis=0).max() > 0.01:
            gain, X_LC = search.search(X_WL, rotations)[0]
            found.append((gain, k, X_WL, X_LC))
    return sorted(found, key=lambda one: -one[0])


def carrying_links(
    body: RegistrationBody, camera: PinholeCamera, recording: Recording, rotations: int = 500
) -> tuple[str, ...]:
    """Return the links that may carry a camera whose background moves with the robot.

    A link's motion must explain the motion of the pictures much better than the link's motion at
    other moments does, and no other link's may explain it significantly better (``fit.judge``). Of
    a hand and its fingers, which move little on it, only the hand is returned.

    Args:
        body: the robot, whose pose tree starts in the world.
        camera: its intrinsics; its pose is not used.
        recording: the camera's pictures and the joint log.
        rotations: number of rotations that are searched for each link.

    Returns the names of the links, the likeliest first; (): the camera does not ride on any, or too
    little is matched between its pictures.

    Raises RegistrationError: as ``choose_pictures``.
    """
    settings, nodes = STANDING_SCENE, body.tree.nodes
    slow, fast = choose_pictures(body, camera, recording, settings.pictures, moving=settings.moving)
    rows = sorted({*slow, *fast})
    matches, _ = match_pictures([recording.read(k) for k in rows])
    if len(matches.uv) < settings.least:
        return ()
    search = EpipolarSearch(camera, matches)
    found = explaining_links(body, None, recording.values_at(0.0)[rows], search, rotations)
    if not found:
        return ()
    explained, _, X_WL, X_LC = found[0]
    if explained < settings.least_gain * _by_chance(search, X_WL, rotations):
        return ()
    own, most = search.explained(X_WL, X_LC), float(ndtri(1.0 - LEVEL))
    likely = [
        k
        for _, k, X_WN, X_NC in found
        if vuong_statistic(own, search.explained(X_WN, X_NC)) <= most
    ]

    def is_finger(k: int) -> bool:
        """Return whether another candidate carries node k, beyond a link that branches."""
        branches = False
        while (above := nodes[k].parent) >= 0:
            branches = branches or sum(node.parent == above for node in nodes) > 1
            if branches and above in likely:
                return True
            k = above
        return False

    return tuple(nodes[k].name for k in likely if not is_finger(k))


def _by_chance(search: EpipolarSearch, X_WL: Array, rotations: int) -> float:
    """Return the largest explained fraction with the link's poses of other pictures.

    X_WL: (pictures, 4, 4) the link's poses, which are shifted by quarters of the pictures.
    """
    shifts = {max(1, round(part * len(X_WL))) for part in (0.25, 0.5, 0.75)}
    shifted = [np.roll(X_WL, shift, axis=0) for shift in shifts]
    return max(search.search(X, rotations)[0][0] for X in shifted)


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


def _refuse_unexplained(
    camera: PinholeCamera,
    link: str,
    matches: int,
    explained: float,
    chance: float,
    elsewhere: float,
    other: str,
) -> NoReturn:
    """Raise RegistrationError because joint positions of other moments explain about as much.

    matches: their number. explained, chance: see ``TrackRegistration``. elsewhere, other: fraction
    that the best other link explains, and its name.
    """
    hint = f"Does the camera ride on link '{link}' (name the one that does: --camera NAME)"
    if elsewhere > STANDING_SCENE.least_gain * max(chance, 0.5 * explained):
        hint = f"On link '{other}' a pose explains {elsewhere:.0%}: give it (--on {other}). Else"
    raise RegistrationError(
        f"camera '{camera.name}': no pose on link '{link}' explains how its pictures move: the "
        f"best one explains {explained:.0%} of {matches} matched points, where "
        f"joint positions of other moments explain {chance:.0%}; twice as much is "
        f"needed. {hint}, does the scene stand still, are the joint positions those of these "
        "pictures, are the pictures not mirrored, and is the focal length about right? If the "
        "camera sees little but the gripper, give a --target. Nothing was written"
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
            f"mm (root mean squares): its pictures do not determine "
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

    X_WL: (pictures, 4, 4) the link's poses. X_LC, covariance: (4, 4) and (7 + k, 7 + k), as of
    ``TrackFit``. likely: names of joints whose offsets are likely.

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
    """Fit with the joint offsets that the pictures determine; the others are held at 0.

    X_LC, constants: (4, 4) and (2 + m,) the start. The returned problem has prior standard
    deviations of 0 for the offsets that are held.
    """
    sds = problem.prior_sds.copy()
    sds[2:][gauge_constants(problem, X_LC, constants)[2:]] = 0.0
    while True:
        problem = problem._replace(prior_sds=sds)
        fit = fit_tracks(problem, X_LC, np.where(sds > 0.0, constants, 0.0))
        deviations = np.sqrt(np.diag(fit.covariance)[8:].clip(min=0.0))
        ratios = deviations / np.where(sds[2:] > 0.0, sds[2:], np.inf)
        if not len(ratios) or ratios.max() <= SHARED.determined:
            return problem, fit
        sds = sds.copy()
        sds[2 + int(np.argmax(ratios))] = 0.0


def _with_likely_offsets(
    body: RegistrationBody, problem: TrackProblem, fit: TrackFit
) -> tuple[tuple[str, ...], TrackProblem, TrackFit]:
    """Return names of joints whose offsets explain the pictures much better, with their fit.

    Without such joints the problem and the fit are returned as they are.
    """
    sds = problem.prior_sds.copy()
    sds[2:] = np.where(body.kinematics.is_angle, SHARED.constant_deviation, 0.0)
    free = problem._replace(prior_sds=sds)
    free, other = _fit_determined(free, fit.X_LC, fit.constants)
    if fit.sigma < STANDING_SCENE.better * other.sigma:
        return (), problem, fit
    deviations = np.sqrt(np.diag(jackknife(free, other)))[8:]
    significant = np.abs(other.constants[2:]) > 2.0 * np.maximum(deviations, 1e-9)
    return tuple(np.array(body.kinematics.names)[significant].tolist()), free, other


def _misfits(
    names: Sequence[str], seen: Sightings, fit: TrackFit, least: float = 0.5
) -> tuple[FrameMisfit, ...]:
    """Return how well each frame's points fit; an inlier ratio under `least` makes an outlier."""
    count = np.bincount(seen.frames, minlength=len(names))
    good = np.bincount(seen.frames[fit.inliers], minlength=len(names))
    ratios = good / np.maximum(count, 1)
    return tuple(
        FrameMisfit(name, math.nan, math.nan, float(ratio), bool(ratio >= least))
        for name, ratio in zip(names, ratios, strict=True)
    )


def describe_offsets(
    names: Sequence[str],
    asked: Sequence[str],
    problem: TrackProblem,
    fit: TrackFit,
    deviations: Array,
) -> tuple[KinematicParameter, ...]:
    """Return the offsets of the joints `asked`, by name, tested at SHARED.level for all of them.

    names: of the pose tree's values. deviations: (7 + k,) standard deviations, as of ``TrackFit``.
    """
    freedom, parameters = min(11, max(1, len(np.unique(problem.seen.frames)) // 2 - 1)), []
    for name in asked:
        k = 2 + list(names).index(name)
        if not problem.prior_sds[k]:
            unknown = math.inf, -math.inf, math.inf, False
            parameters.append(KinematicParameter(name, 0.0, *unknown))
            continue
        value, deviation = float(fit.constants[k]), float(deviations[6 + k])
        width = float(stdtrit(freedom, 1.0 - 0.5 * SHARED.level)) * deviation
        p_value = 2.0 * float(stdtr(freedom, -abs(value) / deviation))
        interval, differs = (value - width, value + width), p_value < SHARED.level / len(asked)
        parameters.append(KinematicParameter(name, value, deviation, *interval, differs))
    return tuple(parameters)
