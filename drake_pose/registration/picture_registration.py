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

import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.base_edges import BASE, joint_rotation, locate_base
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.explain_kernel import Explained
from drake_pose.fit.problem import TIME_OFFSET
from drake_pose.registration.offset_search import joints_like_cameras
from drake_pose.registration.picture_acceptance import (
    ACCEPTANCE,
    PictureRegistration,
    PictureStart,
    accept_fit,
    p_value_of,
    unexplained_error,
)
from drake_pose.registration.picture_search import PictureFit, PictureSearch, PosedPicture
from drake_pose.registration.pyramid_level import evidence
from drake_pose.registration.recording import (
    NO_CLOCK,
    Recording,
    TimeOffset,
    choose_pictures,
    mean_time,
    posed_pictures,
)
from drake_pose.registration.register import RegistrationBody
from drake_pose.registration.shared_fit import SHARED
from drake_pose.workers import map_ordered


def register_pictures(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    focal: float = 0.0,
    offset_joints: Sequence[str] = (),
    guessed_lens: bool = False,
) -> PictureRegistration:
    """Estimate a camera's pose and time offset from pictures of a moving robot.

    Args:
        body: the robot's surfaces and pose tree.
        camera: the camera; its pose is not used.
        recording: the camera's pictures and the joint log.
        focal: prior standard deviation of the focal length's logarithm; 0: it is not fitted.
        offset_joints: joints whose offsets are fitted. Their significance is not tested here
            (``calibrate_joints`` does), but masks follow them.
        guessed_lens: whether the camera's focal length is a guess: others are tried, and ratios of
            the pixels' sides in pictures of unusual proportions.

    Raises RegistrationError: there are too few pictures with joint positions, the robot does not
        move, or no pose explains the pictures; the message says so if mirrored pictures fit.
    """
    chosen = choose_pictures(body, camera, recording)
    return _register(body, camera, recording, chosen, focal, offset_joints, guessed_lens)


def register_near(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    by_chance: float,
    focal: float = 0.0,
    offset_joints: Sequence[str] = (),
) -> PictureRegistration:
    """As register_pictures, but begin at the camera's pose, and search only if it does not fit.

    by_chance: what a search explained by chance in other pictures of this camera.
    """
    try:
        rows = [row for some in choose_pictures(body, camera, recording) for row in some]
        search = PictureSearch(body, camera, posed_pictures(recording, rows, 0.0))
        clock = NO_CLOCK
        if recording.times is not None:
            clock = scan_time_offsets(search, camera, recording)
        exchanged = search.with_frames(exchange_values(search.frames))
        here = exchanged.compared.explained(camera.X_CW)[0]
        start = PictureStart(camera, rows, clock, (), max(by_chance, here), None, search)
        return fit_pictures(body, start, recording, focal, offset_joints)
    except RegistrationError:
        return register_pictures(body, camera, recording, focal, offset_joints)


def _register(
    body: RegistrationBody,
    camera: PinholeCamera,
    recording: Recording,
    frames: tuple[list[int], list[int]],
    focal: float,
    offset_joints: Sequence[str],
    guessed_lens: bool = False,
    most: int = 3,
    is_mirrored: bool = False,
    before: Sequence[tuple[PictureSearch, PinholeCamera]] = (),
) -> PictureRegistration:
    """As register_pictures.

    Args:
        frames: indices as of choose_pictures.
        most: maximum number of pose hypotheses that are fitted.
        is_mirrored: whether these are pictures that were mirrored for a second search.
        before: what a first search found, none of which was accepted; empty: this is the first.
    """
    chosen, moving = frames
    pictures = posed_pictures(recording, chosen, 0.0)
    how = PictureSearch(body, camera, pictures), offset_joints, most, guessed_lens
    near = [*before] or _search(*how)
    if not near:
        raise unexplained_error(camera, "no pose shows the body in two pictures")
    by_chance = explained_by_chance(near[0][0])
    p_value = p_value_of(_explained(*near[0])[0], by_chance)
    again = bool(before) or p_value > ACCEPTANCE.max_p_value
    if again:
        # Other starts in larger pictures, which show thin links, may lead to a pose that the first
        # missed, as they did in 2 of 3 drawn rooms with an SO-100.
        more = _search(*how, rotations=1700, least_width=150)
        near = sorted([*near, *more], key=lambda one: -evidence(*_explained(*one)))
        by_chance = max(by_chance, explained_by_chance(near[0][0], least_width=150))
    search, start = near[0]
    if explained_as_mirrored(search, start):
        explained = _explained(search, start)[0]
        error = unexplained_error(
            camera,
            f"the best one explains {max(explained, 0.0):.0%} of all changes, and one in mirrored "
            "pictures explains more",
        )
        if is_mirrored:
            raise error
        both = camera.mirrored(), recording.mirrored()
        with suppress(RegistrationError):
            _register(body, *both, frames, focal, offset_joints, guessed_lens, most, True)
            error = RegistrationError(
                f"camera '{camera.name}': its pictures are mirrored: a pose explains them only "
                "with left and right exchanged. Mirror them again. Nothing was written"
            )
        raise error
    gains = search.compared.tile_gains(start.X_CW)
    # Hypotheses that explain about as much are fitted again: they may converge to the best one.
    close = [
        (each, one.X_CW)
        for each, one in near[1:]
        if vuong_statistic(gains, each.compared.tile_gains(one.X_CW)) <= 1.96
    ]
    fits = _coarse_fits([each for each, _ in close], [X_CW for _, X_CW in close])
    alike = [one.X_CW for _, one in fits]
    alternatives = search.compared.distinct([start.X_CW, *alike])[1:]
    rows, clock, offsets = [*chosen, *moving], NO_CLOCK, search.joint_offsets
    posed = posed_pictures(recording.with_offsets(offsets), rows, 0.0, search.frames)
    fitted = search.with_frames(posed)
    if recording.times is not None:
        clock = scan_time_offsets(fitted, start, recording.with_offsets(offsets))
    found = PictureStart(start, rows, clock, alternatives, by_chance, offsets, fitted)
    try:
        return fit_pictures(body, found, recording, focal, offset_joints)
    except RegistrationError:
        if again:
            raise
    rest = frames, focal, offset_joints, guessed_lens, most, is_mirrored, near
    return _register(body, camera, recording, *rest)


def _search(
    search: PictureSearch,
    offset_joints: Sequence[str],
    most: int,
    guessed_lens: bool = False,
    rotations: int = 1200,
    least_width: int = 0,
) -> list[tuple[PictureSearch, PinholeCamera]]:
    """Return searches with their cameras roughly fitted, best first.

    Args:
        search: the search; those returned have joint offsets added, or another lens.
        offset_joints, most, guessed_lens: as of `_register`.
        rotations, least_width: as of ``PictureSearch.search``.
    """
    poses = search.search(rotations=rotations, least_width=least_width)[:most]
    if guessed_lens:
        search, poses = _scan_lenses(search, poses)
    searches = [search] * len(poses)
    if offset_joints:
        both = map_ordered(partial(search.fit_offsets, offset_joints), poses)
        searches, poses = [one for one, _ in both], [X_CW for _, X_CW in both]
    return _coarse_fits(searches, poses)


def _explained(search: PictureSearch, camera: PinholeCamera) -> tuple[float, float]:
    """Return what a search's pictures explain at a camera's pose, see ``PyramidLevel``."""
    return search.compared.explained(camera.X_CW)


def _coarse_fits(
    searches: Sequence[PictureSearch], X_CW: Sequence[Array]
) -> list[tuple[PictureSearch, PinholeCamera]]:
    """Return searches with their cameras roughly fitted from poses (4, 4), best first.

    Poses at which the body leaves the pictures are left out.
    """
    fitted = map_ordered(lambda one: one[0].coarse_fit(one[1]), zip(searches, X_CW, strict=True))
    both = zip(searches, fitted, strict=True)
    near = sorted(((a, b) for a, b in both if b is not None), key=lambda one: -evidence(*one[1][1]))
    return [(search, camera) for search, (camera, _) in near]


def explained_by_chance(
    search: PictureSearch,
    *,
    rounds: Sequence[tuple[int, int, int, float]] = (
        (64, 80, 24, 0.25),
        (64, 30, 30, 0.15),
        (80, 12, 50, 0.1),
        (160, 4, 80, 0.06),
    ),
    rotations: int = 600,
    least_width: int = 0,
) -> float:
    """Return the fraction that a search explains with the joint positions of other pictures.

    Args:
        search: a search with the pictures' own joint positions.
        rounds, rotations, least_width: as of ``PictureSearch.search``. With a third of the usual
            hypotheses the fractions have the same distribution: over 15 drawn rooms their
            logarithms differ by 0.04 in the mean, with a standard deviation of 0.17.
    """
    exchanged = search.with_frames(exchange_values(search.frames))
    best = exchanged.search(rounds, rotations, least_width)[:1]
    found = _coarse_fits([exchanged] * len(best), best)
    return max((exchanged.compared.explained(one.X_CW)[0] for _, one in found), default=0.0)


def exchange_values(pictures: Sequence[PosedPicture], shift: int = 5) -> list[PosedPicture]:
    """Return pictures with the values of others: each gets those `shift` places ahead."""
    count = len(pictures)
    return [
        replace(one, values=pictures[(k + min(shift, count // 2)) % count].values, rates=None)
        for k, one in enumerate(pictures)
    ]


def explained_as_mirrored(
    search: PictureSearch,
    camera: PinholeCamera,
    *,
    evaluations: int = 250,
    turn: float = 0.25,
    starts: int = 6,
    threshold: float = 1.96,
) -> bool:
    """Return whether a search's pictures are explained significantly better if mirrored.

    From behind, a distant body has the mirror image of its silhouette. So mirrored pictures are
    explained by a camera on the opposite side of the body, though less well, as near parts are
    shown larger. That of the mirrored pictures is compared with the given one.

    Args:
        search: a search in the pictures.
        camera: at its pose in the pictures as they are.
        evaluations, turn: of each local search, see ``PyramidLevel.improve``.
        starts: number of local searches.
        threshold: minimum Vuong statistic of the mirrored pictures' advantage.
    """
    mirrored, level = search.mirrored(), search.compared
    X_CW = level.opposite(camera.X_CW)
    _, improved = mirrored.compared.improve([X_CW] * starts, evaluations, turn)
    opposite = mirrored.coarse_fit(improved[0])
    if opposite is None:
        return False
    gains = mirrored.compared.tile_gains(opposite[0].X_CW)[:, ::-1]
    return vuong_statistic(gains, level.tile_gains(camera.X_CW)) > threshold


def _scan_lenses(
    search: PictureSearch,
    found: Sequence[Array],
    factors: Sequence[float] = (0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0),
) -> tuple[PictureSearch, list[Array]]:
    """Improve poses with other focal lengths and aspect ratios of the pixels.

    Args:
        search: a search with a camera whose focal length is a guess.
        found: poses X_CW (4, 4) that it found.
        factors: of the focal length.

    Returns:
        a search with the camera that scores best, and the poses improved with it, best first.
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
    focal: float = 0.0,
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
        return accept_fit(*steady, focal)
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
    return accept_fit(*((best, as_now, start, assumed) if drifts else steady), focal)


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

    Returns:
        the fit; the recording without drift; the start with the fitted camera and time offset; and
        the joint offsets (m,) that the frames were segmented with.
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
        if best is None:
            raise unexplained_error(camera, "the body leaves the pictures")
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

    Returns:
        index of the joint, the angle and its standard deviation [rad]; None: no offset of these
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
    body: RegistrationBody,
    found: Mapping[str, PictureRegistration],
    offset_joints: Sequence[str],
) -> tuple[dict[str, float], dict[str, tuple[float, float]], dict[str, PinholeCamera]]:
    """Return joint offsets of registrations in pictures, all cameras together.

    Args:
        body: the robot's surfaces and pose tree.
        found: registrations by camera.
        offset_joints: joints whose offsets are fitted.

    Returns:
        mean offsets by name [rad or m]; of these, those that look like a rotation of a camera, as
        edges of static parts show them, with standard deviations; and the cameras, turned to these
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
    estimated (infinite).

    Args:
        search: a search in the pictures that are used.
        camera: at its pose.
        recording: their recording, with the same joint offsets.
        rates: scanned drifts [s/s].
        start_within: for a drift both clocks start together within this time [s].
        much_better: minimum ratio of a drift's score to that of the best constant offset.
    """
    offsets = np.linspace(-1.0, 1.0, 81)
    level = search.compared
    rows = [recording.names.index(one.name) for one in search.frames]

    def gains_at(clock: Recording, tried: Array) -> Array:
        """Return log-likelihood gains (k,) at k time offsets [s]; NaN without logged joints."""
        several = [clock.values_at(offset)[rows] for offset in tried.tolist()]

        def gain(values: Array) -> float:
            if not np.isfinite(values).all():
                return np.nan
            return float(level.statistics(camera.X_CW, search.nodes_at(values))[Explained.GAIN])

        return np.array(map_ordered(gain, several))

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
        first, mean = float(recording.times[0]), mean_time(recording, rows)
        starts = np.linspace(-start_within, start_within, 13)
        for rate in rates:
            gains = gains_at(recording.with_drift(rate, first), starts)
            if np.isfinite(gains).any() and (gain := float(np.nanmax(gains))) > most:
                most, drift = gain, rate
                offset = float(starts[int(np.nanargmax(gains))]) + rate * (mean - first)
    known = np.isfinite(scores)
    tried = np.column_stack([offsets[known], scores[known] / max(best, 1e-9)])
    return TimeOffset(offset, np.inf, tried, drift)
