"""Register a camera and its clock from pictures and a joint log.

The search uses frames in which the robot hardly moves, so that a time offset does little harm. With
the pose held, time offsets between the pictures' clock and the log's are then scanned. Finally
pose, time offset and, if requested, focal length and joint offsets are fitted together to these
frames and the fastest ones.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.base_edges import BASE, joint_rotation, locate_base
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.problem import TIME_OFFSET
from drake_pose.registration.picture_acceptance import (
    PictureRegistration,
    PictureStart,
    accept_fit,
    best_first,
    coarse_fits,
    depth_reversed,
    opposite_pose,
    unexplained_error,
)
from drake_pose.registration.picture_search import (
    PictureFit,
    PictureSearch,
    PosedPicture,
    RoughPose,
    ratio_margin,
    rotation_between,
)
from drake_pose.registration.posed_frames import joints_like_cameras
from drake_pose.registration.pyramid_level import PICTURES
from drake_pose.registration.recording import (
    NO_CLOCK,
    Recording,
    choose_pictures,
    left_out,
    mean_time,
    posed_pictures,
    scan_time_offsets,
    stuck_pictures,
)
from drake_pose.registration.register import SEARCH, RegistrationBody
from drake_pose.registration.shared_fit import SHARED
from drake_pose.workers import map_ordered


def register_pictures(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    focal: float = 0.0,
    offset_joints: Sequence[str] = (),
    guessed_lens: bool = False,
    near: bool = False,
) -> PictureRegistration:
    """Estimate a camera's pose and time offset from pictures of a moving robot.

    Args:
        body: the robot's surfaces and pose tree.
        camera: the camera.
        recording: the camera's pictures and the joint log.
        focal: prior standard deviation of the focal length's logarithm; 0: it is not fitted.
        offset_joints: joints whose offsets are fitted. Their significance is not tested here
            (``calibrate_joints`` does), but masks follow them.
        guessed_lens: whether the camera's focal length is a guess: others are tried, and ratios of
            the pixels' sides in pictures of unusual proportions.
        near: whether a fit from the camera's pose is tried before a search.

    Raises RegistrationError: there are too few pictures with joint positions, the robot does not
        move, or no pose explains the pictures; the message says so if mirrored pictures fit.
    """
    slow, fast = choose_pictures(body, camera, recording)
    some = choose_pictures(body, camera, recording.without(left_out(body, recording)))
    task = _Task(body, camera, recording, some, slow + fast, focal, offset_joints, guessed_lens)
    begun = PictureSearch(body, camera, posed_pictures(recording, some[0], 0.0))
    if near:
        with suppress(RegistrationError):
            return _fit(task, RoughPose(begun, camera, 0.0, {}))
    return _register(task, begun)


class _Task(NamedTuple):
    """Arguments of ``register_pictures``, and indices as of ``choose_pictures``.

    frames: of the pictures that are searched and judged with. every: of those of the last fit.
    """

    body: RegistrationBody
    camera: PinholeCamera
    recording: Recording
    frames: tuple[list[int], list[int]]
    every: list[int]
    focal: float
    offset_joints: Sequence[str]
    guessed_lens: bool

    def fit(self, start: PictureStart) -> PictureRegistration:
        """Fit and judge a camera from a start, then fit it to the pictures of the judge, too.

        Raises RegistrationError: no pose explains the pictures.
        """
        fit = partial(
            fit_pictures, self.body, recording=self.recording, focal=self.focal,
            offset_joints=self.offset_joints,
        )  # fmt: skip
        again = PictureStart.of(fit(start))
        return fit(again._replace(rows=self.every, runner_up=start.runner_up))


def _register(
    task: _Task,
    begun: PictureSearch,
    searches: Sequence[tuple[int, int]] = ((1200, 0), (1700, 150)),
    well: float = 0.75,
) -> PictureRegistration:
    """As register_pictures.

    Args:
        task: the arguments.
        begun: a search in the pictures.
        searches: number of rotations and minimum width of the pictures [pixel] of a first search,
            and of a second one where no pose is accepted. Larger pictures show thin links.
        well: where a smaller fraction of the contours fits, mirrored pictures are searched, too.
    """
    poses, near, mirrored = list[Array](), list[RoughPose](), list[RoughPose]()
    refused = unexplained_error(task.camera, "no pose shows the body in two pictures.")
    for rotations, width in searches:
        more = begun.search(rotations=rotations, least_width=width)
        poses += more
        near += _fit_near(begun, more, task)
        if width and not task.offset_joints:
            search = begun.mirrored()
            mirrored += _fit_near(
                search, search.search(rotations=rotations, least_width=width, others=0)
            )
            # In mirrored pictures a pose may be found more easily; the right one is opposite.
            near += filter(None, map(opposite_pose, mirrored))
        if not near:
            continue
        near = best_first(near)
        near = best_first([*near, *filter(None, [depth_reversed(near[0])])])
        mirrored += filter(None, [opposite_pose(near[0])])
        try:
            found = _fit(task, near[0], *_other_poses(near, poses))
        except RegistrationError as error:
            _require_unmirrored(task, near[0], mirrored)
            refused = error
            continue
        if found.fit.ratios.mean() < well:
            # A wrong pose in mirrored pictures need not be opposite the right one.
            search = near[0].search.mirrored()
            mirrored += _fit_near(search, search.search(others=0))
        _require_unmirrored(task, near[0], mirrored, found)
        return found
    stuck = stuck_pictures(task.recording)
    raise RegistrationError(f"{stuck} {refused}") if stuck else refused


def _fit(
    task: _Task,
    pose: RoughPose,
    alternatives: Sequence[Array] = (),
    runner_up: tuple[Array, float] | None = None,
) -> PictureRegistration:
    """Return the registration from a roughly fitted pose.

    alternatives, runner_up: as of ``PictureStart``.

    Raises RegistrationError: the pose does not explain the pictures.
    """
    rows, offsets, clock = [*task.frames[0], *task.frames[1]], pose.search.joint_offsets, NO_CLOCK
    corrected = task.recording.with_offsets(offsets)
    fitted = pose.search.with_frames(posed_pictures(corrected, rows, 0.0, pose.search.frames))
    if task.recording.times is not None:
        clock = scan_time_offsets(fitted, pose.camera, corrected)
    start = PictureStart(pose.camera, rows, clock, alternatives, offsets, fitted, runner_up)
    return task.fit(start)


def _require_unmirrored(
    task: _Task,
    best: RoughPose,
    mirrored: Sequence[RoughPose],
    found: PictureRegistration | None = None,
    *,
    least: float = -3.0,
) -> None:
    """Raise a RegistrationError if a pose in mirrored pictures is accepted, and fits better.

    Args:
        best: the roughly fitted pose in the pictures as they are.
        mirrored: those in mirrored pictures.
        found: the registration from `best`; None: it was refused.
        least: the best of `mirrored` is fitted to the end if it is better than `best` by more than
            this margin (``ratio_margin``). Where `best` was right the margin was -5 to -20; while
            the time offset is unknown it says little.
    """
    rivals = [(ratio_margin(one.ratios, best.ratios), one) for one in mirrored]
    margin, rival = max(rivals, key=lambda one: one[0], default=(-np.inf, best))
    if margin <= least:
        return
    recording, camera = task.recording.mirrored(), task.camera.mirrored()
    try:
        other = _fit(task._replace(recording=recording, camera=camera), rival)
    except RegistrationError:
        return
    if found is None or ratio_margin(other.ratios, found.ratios) > SEARCH.significance:
        raise RegistrationError(
            f"camera '{task.camera.name}': its pictures are mirrored: a pose explains them only "
            "with left and right exchanged. Mirror them again. Nothing was written"
        )


def _other_poses(
    near: Sequence[RoughPose], poses: Sequence[Array], apart: float = 0.1
) -> tuple[list[Array], tuple[Array, float] | None]:
    """Return other poses that fit about as well as the best one, and the runner-up.

    Args:
        near: roughly fitted poses, the best first.
        poses: all poses X_CW (4, 4) of the search.
        apart: minimum rotation between the best and the runner-up [rad]. Fits of the latter start
            eight times as far away: from 0.5 rad many lead to the best one.

    Returns:
        Poses X_CW (4, 4); and the runner-up as of ``PictureStart``.
    """
    best = near[0]
    level, X_CW = best.search.compared, best.camera.X_CW
    gains = level.tile_gains(X_CW)
    # Hypotheses that explain about as much are fitted again: they may converge to the best one.
    close = [
        one
        for one in near[1:]
        if vuong_statistic(gains, one.search.compared.tile_gains(one.camera.X_CW))
        <= SEARCH.significance
    ]
    again = coarse_fits([one.search for one in close], [one.camera.X_CW for one in close])
    far = [one for one in poses if rotation_between(one, X_CW) > 8.0 * apart][:2]
    others = best_first([*again, *near[1:], *coarse_fits([best.search] * len(far), far)])
    others = [one for one in others if rotation_between(one.camera.X_CW, X_CW) > apart]
    margins = [
        (one.camera.X_CW, ratio_margin(best.ratios, one.ratios)) for one in [*again, *others]
    ]
    alike = [other for other, margin in margins if margin <= SEARCH.significance]
    runner_up = margins[len(again)] if others else None
    return level.distinct([X_CW, *alike])[1:], runner_up


def _fit_near(
    search: PictureSearch, poses: Sequence[Array], task: _Task | None = None
) -> list[RoughPose]:
    """Return cameras roughly fitted from the first PICTURES.fitted poses X_CW (4, 4), best first.

    search: the search; those returned have joint offsets added, or another lens, if `task` asks.
    """
    poses = poses[: PICTURES.fitted]
    if task and task.guessed_lens:
        search, poses = _scan_lenses(search, poses)
    searches = [search] * len(poses)
    if task and task.offset_joints:
        both = map_ordered(partial(search.fit_offsets, task.offset_joints), poses)
        searches, poses = [one for one, _ in both], [X_CW for _, X_CW in both]
    return coarse_fits(searches, poses)


def _scan_lenses(
    search: PictureSearch,
    found: Sequence[Array],
    factors: Sequence[float] = (0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0),
) -> tuple[PictureSearch, list[Array]]:
    """Improve poses with other focal lengths and aspect ratios of the pixels.

    ``search``: a search with a camera whose focal length is a guess. ``found``: poses X_CW (4, 4)
    that it found. ``factors``: of the focal length. Returns a search with the camera that scores
    best, and the poses improved with it, best first.
    """
    results = []
    for squeezed in squeezed_cameras(search.camera):
        for factor in factors:
            focal_x, focal_y = factor * squeezed.focal_x, factor * squeezed.focal_y
            camera = replace(squeezed, focal_x=focal_x, focal_y=focal_y)
            own = search.with_camera(camera)
            # A longer focal length shows a body that is as much farther away at the same size.
            starts = [np.vstack([X[:2], X[2] * [1, 1, 1, factor], X[3]]) for X in found]
            scores, improved = own.compared.improve(starts, evaluations=150, turn=0.06)
            results.append((scores[0], own, improved))
    return max(results, key=lambda one: one[0])[1:]


def squeezed_cameras(camera: PinholeCamera, tolerance: float = 0.01) -> tuple[PinholeCamera, ...]:
    """Return a camera with square pixels, and with those of pictures squeezed to its size.

    Pictures of unusual proportions are often made of ones of 4:3 or 16:9. A camera whose pictures
    have the proportions of a sensor is returned alone.

    tolerance: relative difference of proportions that count as the same.
    """
    shape = camera.width / camera.height
    sensors = np.array([4 / 3, 16 / 9, 16 / 10, 3 / 2, 5 / 4])
    if (np.abs(sensors / shape - 1.0) < tolerance).any():
        return (camera,)
    squeezed = (replace(camera, focal_y=one / shape * camera.focal_x) for one in (4 / 3, 16 / 9))
    return (camera, *squeezed)


def fit_pictures(
    body: RegistrationBody,
    start: PictureStart,
    recording: Recording,
    focal: float,
    offset_joints: Sequence[str],
    *,
    most_fits: int = 5,
    min_drift: float = 0.005,
    drift_sds: float = 4.0,
) -> PictureRegistration:
    """Fit a camera with its clock from a search result.

    Args:
        start: the search result.
        recording: the recording as it is, with any drift of its clock.
        focal: prior standard deviation of the focal length's logarithm; 0: it is not fitted.
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
        return accept_fit(body, *steady, focal)
    if scanned_drift:
        clock = replace(without.clock, drift=scanned_drift)
        best, as_now, start, assumed = fit(without._replace(clock=clock))
    since, span = mean_time(recording, start.rows), float(np.ptp(recording.times))
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
    return accept_fit(body, *((best, as_now, start, assumed) if drifts else steady), focal)


def _fit_until_stable(
    body: RegistrationBody,
    recording: Recording,
    focal: float,
    offset_joints: Sequence[str],
    start: PictureStart,
) -> tuple[PictureFit, Recording, PictureStart, Array]:
    """Fit a camera with a known drift, and repeat with new masks until offsets settle.

    A fit is repeated, at most three times, if the time offset changed by 20 ms or more or a joint
    offset by 0.3 degrees or more; without joint offsets at most once.

    start: the camera near its pose, and the clock, whose drift is held.

    Returns the fit; the recording without drift; the start with the fitted camera and time offset;
    and the joint offsets (m,) that the frames were segmented with.
    """
    camera, offset, names = start.camera, start.clock.value, body.kinematics.names
    constants = ((TIME_OFFSET,) if recording.times is not None else ()) + tuple(offset_joints)
    joint_offsets, left = np.zeros(len(names)), 4 if offset_joints else 2
    if offset_joints and start.joint_offsets is not None:
        joint_offsets = start.joint_offsets
    as_now = recording.with_drift(start.clock.drift, mean_time(recording, start.rows))
    search = start.search
    to_turn = bool(offset_joints)
    while True:
        left -= 1
        frames = posed_pictures(as_now, start.rows, offset, () if search is None else search.frames)
        if search is None:
            search = PictureSearch(body, camera, frames)
        search = search.with_camera(camera).with_frames(frames)
        best = search.with_offsets(joint_offsets).fit(camera, constants, focal)
        if best is None or not best.ratios.any():
            raise unexplained_error(camera, "the body leaves the pictures.")
        found = dict(zip(best.fit.names, best.found.shared.tolist(), strict=True))
        camera, by = best.camera, found.get(TIME_OFFSET, 0.0)
        assumed, turn = joint_offsets, np.array([found.get(name, 0.0) for name in names])
        most = SHARED.max_constant
        offset, joint_offsets = offset + by, np.clip(joint_offsets + turn, -most, most)
        if to_turn and left:
            posed = search.with_offsets(joint_offsets)
            camera, angle = _turn_to_base(body, camera, posed.frames, offset_joints)
            joint_offsets, turn = joint_offsets - angle, turn - angle
            to_turn = bool(angle.any())
        if not left or (abs(by) < 0.02 and np.abs(turn).max() < np.radians(0.3)):
            clock = replace(start.clock, value=offset)
            done = start._replace(camera=camera, clock=clock, joint_offsets=joint_offsets)
            return best, as_now, done, assumed


def _turn_to_base(
    body: RegistrationBody,
    camera: PinholeCamera,
    frames: Sequence[PosedPicture],
    offset_joints: Sequence[str],
) -> tuple[PinholeCamera, Array]:
    """Turn a camera about the first joint's axis to where the robot's base fits its pictures.

    Args:
        body: the robot's surfaces and pose tree.
        camera: the camera at its fitted pose.
        frames: f pictures with the values of the fit.
        offset_joints: joints whose offsets are fitted. Without one whose offset looks like a
            rotation of the camera, the camera stays. It stays, too, where the angle is not
            determined, or small.

    Returns:
        the camera; and (m,) the angle that it turned [rad], at the joint whose offset falls by it.
    """
    turned = np.zeros(len(body.kinematics.names))
    found = base_rotation(body, camera, frames, offset_joints)
    if found is None or found[2] > BASE.max_deviation or abs(found[1]) < BASE.min_turn:
        return camera, turned
    joint, turned[found[0]] = found[:2]
    X_WW = joint_rotation(body.kinematics, frames[0].values, joint, turned[joint])
    return camera.with_pose(np.linalg.inv(camera.X_CW @ X_WW)), turned


def base_rotation(
    body: RegistrationBody,
    camera: PinholeCamera,
    frames: Sequence[PosedPicture],
    offset_joints: Sequence[str],
) -> tuple[int, float, float] | None:
    """Return by how much a camera is turned about the first joint's axis, see ``locate_base``.

    Args:
        body: the robot's surfaces and pose tree.
        camera: the camera at its pose.
        frames: f pictures with the values that the camera was fitted with.
        offset_joints: joints whose offsets are fitted.

    Returns index of the joint, the angle and its standard deviation [rad]; None: no offset of these
    joints looks like a rotation of the camera.
    """
    kinematics, values = body.kinematics, np.array([one.values for one in frames])
    shown = np.array([len(one.vertices) > 0 for one in body.full])
    like_cameras = joints_like_cameras(kinematics, values, shown)
    joint = next((kinematics.names.index(k) for k in like_cameras if k in offset_joints), None)
    if joint is None:
        return None
    pictures = [one.picture for one in frames]
    return joint, *locate_base(kinematics, body.full, camera, pictures, values, joint)


def offsets_in_pictures(
    body: RegistrationBody, found: Mapping[str, PictureRegistration], offset_joints: Sequence[str]
) -> tuple[dict[str, float], dict[str, tuple[float, float]], dict[str, PinholeCamera]]:
    """Return joint offsets of registrations in pictures, all cameras together.

    Args:
        body: the robot's surfaces and pose tree.
        found: registrations by camera.
        offset_joints: joints whose offsets are fitted.

    Returns mean offsets by name [rad or m]; of these, those that look like a rotation of a camera,
    as edges of static parts show them, with standard deviations; and the cameras, turned to these
    offsets. All are empty without registrations.
    """
    if not found:
        return {}, {}, {}
    names, kinematics = body.kinematics.names, body.kinematics
    offsets, measured = dict[str, Array](), dict[str, list[tuple[str, float, float]]]()
    for name, one in found.items():
        own = dict(zip(one.fit.fit.names, one.fit.found.shared, strict=True))
        offsets[name] = one.joint_offsets + [own.get(joint, 0.0) for joint in names]
        frames = [
            PosedPicture(k.name, k.values + offsets[name], one.pictures[k.name]) for k in one.frames
        ]
        rotation = base_rotation(body, one.found.camera, frames, offset_joints)
        if rotation is not None:
            joint, angle, deviation = rotation
            several = measured.setdefault(names[joint], [])
            several.append((name, float(offsets[name][joint]) - angle, deviation))
    start = dict(zip(names, np.mean([*offsets.values()], axis=0).tolist(), strict=True))
    static, cameras = dict[str, tuple[float, float]](), dict[str, PinholeCamera]()
    for joint_name, several in measured.items():
        weights = np.array([deviation**-2 for _, _, deviation in several])
        deviation = float(weights.sum() ** -0.5) if weights.any() else np.inf
        value = float(np.average([one for _, one, _ in several], weights=weights + 1e-30))
        static[joint_name] = value, deviation
        joint = names.index(joint_name)
        start[joint_name] = start[joint_name] if deviation <= BASE.max_deviation else 0.0
        for name, _, _ in several:
            by = float(offsets[name][joint]) - start[joint_name]
            camera, values = found[name].found.camera, found[name].frames[0].values
            X_CW = camera.X_CW @ joint_rotation(kinematics, values, joint, by)
            cameras[name] = camera.with_pose(np.linalg.inv(X_CW))
    return start, static, cameras
