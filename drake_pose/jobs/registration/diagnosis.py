"""Check registered cameras, clocks and frames, and word what is wrong with them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from drake_pose.arrays import Array
from drake_pose.body import TARGET_POSITIONS
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError, RegistrationError, weighted
from drake_pose.files.records import BADLY_EXPLAINED
from drake_pose.files.settings import percent
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.jobs.registration.readings import MIRRORED, likeliest_reading, other_rows
from drake_pose.registration.diagnosis import DIAGNOSIS
from drake_pose.registration.findings import Finding
from drake_pose.registration.joint_offsets import calibrate_joints
from drake_pose.registration.online_registration import pose_difference, squared_distance
from drake_pose.registration.picture_acceptance import PictureRegistration
from drake_pose.registration.posed_frames import (
    MultiViewFrame,
    PosedFrame,
    PosedFrames,
    placed_points,
)
from drake_pose.registration.recording import Recording
from drake_pose.registration.register import (
    SEARCH,
    CameraSearch,
    E_total,
    RegisteredCamera,
    RegistrationBody,
    evenly_spaced,
    fits_better,
    frame_misfits,
    overlap_areas,
)
from drake_pose.registration.shared_fit import SharedFit
from drake_pose.registration.standing_object import TargetSearch
from drake_pose.silhouette.scoring import require_visible

Search = CameraSearch | TargetSearch
"""Finds a camera; `rough()` gives a faster search."""


def lack_of_evidence(
    search: Search, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> str | None:
    """Return in words why a pose does not show that joint positions and masks belong together.

    A pose for which other frames are no evidence (``fit.judge``) must fit significantly better than
    the same masks with joint positions drawn at random, at the pose that fits these best.

    Args:
        search: searches roughly with other joint positions.
        found: the camera at the pose that is judged.
        frames: the frames that it was registered from.

    Returns the reason; None: they belong together.
    """
    evidence = found.evidence
    if evidence is not None:
        # A single wrong frame of as few as needed hides the evidence.
        if not evidence.holds and evidence.frames > evidence.needed:
            return (
                "the joint positions of other frames fit them about as well as their own (p-value "
                f"{evidence.p_value:.2g})"
            )
        # Half of the frames and more that fit no common pose are outliers, which are named.
        if not found.agrees and not (evidence.holds and 2 * len(found.outliers) >= len(frames)):
            return "half of the frames fit as well at another pose of their own"
        if evidence.holds:
            left = float(np.median([frame.E_total for frame in found.frames if frame.is_inlier]))
            if left < BADLY_EXPLAINED:
                return None
            return f"the joints move as in them, but {percent(left)} of their area is off"
    with suppress(RegistrationError):
        chance = search.rough().register(found.camera, with_random_rows(search.kinematics, frames))
        if not fits_better(found.costs, chance.costs):
            return "joint positions drawn at random fit them about as well"
    return None


def require_explained(
    search: Search, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> None:
    """Refuse a pose that is not evidence, see `lack_of_evidence`.

    Causes with which some of the masks fit significantly better, and as well as with any other, are
    named in the error.

    Args:
        search: searches again, roughly, with alternative causes of the misfit.
        found: the camera at the pose that is checked.
        frames: the frames that it was registered from.

    Raises RegistrationError: states what is lacking, and alternative causes, or what to check.
    """
    lack = lack_of_evidence(search, found, frames)
    if lack is None:
        return
    tried = dict[str, Array]()
    for text, camera, changed in _readings(found.camera, frames):
        with suppress(RegistrationError):
            costs = search.rough().register(camera, changed).costs
            tried[text] = costs[..., ::-1] if text == MIRRORED else costs
    best = min(tried.values(), key=np.sum, default=np.zeros(0))
    given = tried.pop("", best)
    as_good = [text for text, costs in tried.items() if not fits_better(best, costs)]
    better = [text for text in as_good if fits_better(tried[text], given)]
    advice = "; ".join(better) or (
        "are these masks of this robot or object, are the joint positions those of these frames, "
        "in radians and with the signs and zeros of the model's file, do focal length and "
        "principal point belong to this camera, are the pictures undistorted?"
    )
    raise unexplained_error(found.camera.name, f"{lack}; {advice}")


def unexplained_error(camera: str, why: str) -> RegistrationError:
    """Return the error for a camera, by name, whose masks no pose explains."""
    return RegistrationError(
        f"camera '{camera}': no pose explains its masks: {why}. Nothing was written"
    )


def mirrored_cameras(
    search: CameraSearch,
    found: Mapping[str, RegisteredCamera],
    frames: Mapping[str, Sequence[PosedFrame]],
) -> dict[str, RegistrationError]:
    """Return an error for each camera whose masks fit significantly better when mirrored.

    If the masks of all cameras together do, there is one for each camera.

    Args:
        search: of the body.
        found: cameras at their poses, by name, whether these are evidence or not.
        frames: their frames.
    """
    costs = {name: search.mirrored_costs(one, frames[name]) for name, one in found.items()}
    together = (np.concatenate([k[m].ravel() for k in costs.values()]) for m in (1, 0))
    all_are = bool(costs) and fits_better(*together)
    return {
        name: unexplained_error("', '".join(costs) if all_are else name, MIRRORED)
        for name, (given, mirrored) in costs.items()
        if all_are or fits_better(mirrored, given)
    }


def _readings(
    camera: PinholeCamera, frames: Sequence[PosedFrame], most: int = 5
) -> Iterator[tuple[str, PinholeCamera, list[PosedFrame]]]:
    """Yield readings of at most `most` masks: the cause in words, the camera, and the frames.

    The first reading is that of the files, whose words are empty.
    """
    rows = evenly_spaced(range(len(frames)), most)
    sample = [frames[k] for k in rows]
    yield "", camera, sample
    yield MIRRORED, camera.mirrored(), [frame.mirrored() for frame in sample]
    for text, others in other_rows(frames):
        yield text, camera, [replace(frames[k], values=others[k].values) for k in rows]


def with_random_rows(kinematics: TreeKinematics, frames: Sequence[PosedFrame]) -> list[PosedFrame]:
    """Return frames with joint positions drawn within the limits, a turn or a metre at most."""
    most = np.where(kinematics.is_angle, np.pi, 0.5)
    # A calibration target stands still.
    most[np.isin(kinematics.names, TARGET_POSITIONS)] = 0.0
    lower, upper = np.maximum(kinematics.lower, -most), np.minimum(kinematics.upper, most)
    rng = np.random.default_rng(0)
    return [replace(one, values=rng.uniform(lower, np.maximum(lower, upper))) for one in frames]


def require_seen_by(
    body: RegistrationBody, cameras: Sequence[Camera], frames: Sequence[MultiViewFrame]
) -> None:
    """Refuse a camera that cannot show the robot in any frame for which it has a mask.

    Cameras without a mask in `frames` are accepted.

    Raises CameraError: see ``require_visible``.
    """
    for camera in cameras:
        with_mask = [frame for frame in frames if camera.name in frame.masks]
        refused = list[CameraError]()
        for frame in with_mask:
            try:
                require_visible(
                    body.medium, camera.X_CW @ body.kinematics.poses(frame.values), camera
                )
            except CameraError as error:
                refused.append(error)
        if with_mask and len(refused) == len(with_mask):
            raise refused[0]


def known_camera_warnings(
    body: RegistrationBody, camera: PinholeCamera, frames: Sequence[PosedFrame]
) -> list[str]:
    """Return a warning if the robot is not visible where a camera with known X_WC should see it.

    The list is empty if the robot is visible, or if there are no frames.

    frames: of this camera.
    """
    if not frames:
        return []
    posed = PosedFrames(body.kinematics, body.full, camera, frames)
    left = float(np.median(E_total(overlap_areas(posed, camera.X_CW[None], np.inf)[0])))
    if left < BADLY_EXPLAINED:
        return []
    text = (
        f"camera '{camera.name}' is held at its X_WC, but the robot is not seen there: body and "
        f"silhouettes differ by {percent(left)} of the silhouettes' area; is its world another "
        f"than the robot's base? Register it anew with --camera {camera.name}"
    )
    return [weighted(text, "wrong")]


def require_determined(found: RegisteredCamera, max_sd: float = 0.04) -> None:
    """Refuse a pose on a link whose standard deviation about or along any axis exceeds a limit.

    max_sd: the limit, of rotation [rad] and of translation [m].

    Raises RegistrationError: states the standard deviations.
    """
    turn, shift = (
        math.sqrt(float(np.linalg.eigvalsh(part)[-1]))
        for part in (found.covariance[:3, :3], found.covariance[3:, 3:])
    )
    if turn > max_sd or shift > max_sd:
        raise RegistrationError(
            f"camera '{found.camera.name}': its frames do not determine its pose on the link: "
            f"standard deviations of {math.degrees(turn):.1f} degrees and {1e3 * shift:.0f} mm "
            "along some axes; add frames between which the link turns by 20 degrees or more about "
            "at least two axes. Nothing was written"
        )


def check_focal_length(
    body: RegistrationBody,
    found: RegisteredCamera,
    frames: Sequence[PosedFrame],
    *,
    off_by: float = 0.03,
    wrong_by: float = 0.06,
) -> tuple[RegisteredCamera, float, list[str]]:
    """Compare a camera's focal length with that estimated from its masks.

    Args:
        body: the robot's surfaces.
        found: the registered camera, with one misfit for each of `frames`.
        frames: its frames, of which the inliers are used.
        off_by: minimum difference of the focal lengths' logarithms for a warning, which is also
            four standard deviations or more. Published focal lengths of recorded arms differ by 2 %
            at most.
        wrong_by: difference of the logarithms from which the camera gets the estimated focal
            length.

    Returns the camera; the relative standard deviation of an estimated focal length, 0 for a given
    one; and a list of one warning or none. Between `off_by` and `wrong_by` the camera's pose and
    focal length stay as they are. Its covariance is then that of a pose with a fitted focal length,
    plus the squared difference between the two poses.
    """
    given = found.camera
    inliers = [frame for frame, fit in zip(frames, found.frames, strict=True) if fit.is_inlier]
    sample = evenly_spaced(inliers, 60)
    if len(sample) < 2:
        return found, 0.0, []
    posed = PosedFrames(body.kinematics, body.full, given, sample)
    fit = SharedFit([posed], [given.X_CW], camera_unknowns=len(POSE_NAMES) + 1)
    camera = fit.cameras(fit.fit((*SEARCH.fine, *SEARCH.last)))[0]
    if abs(math.log(camera.focal_x / given.focal_x)) < 0.6 * off_by:
        return found, 0.0, []
    fitted = calibrate_joints(body, [found], [inliers], (), focal=True)
    camera, deviation = fitted.cameras[0], float(fitted.focal_deviations[0])
    log_ratio = math.log(camera.focal_x / given.focal_x)
    if abs(log_ratio) < max(off_by, 4.0 * deviation):
        return found, 0.0, []
    text = " A wrong focal length gives a wrong distance; calibrate it"
    if abs(log_ratio) <= wrong_by:
        shift = pose_difference(camera.X_WC, given.X_WC)
        checked = replace(found, covariance=fitted.covariances[0] + np.outer(shift, shift))
        is_new = 0.0
    else:
        posed = PosedFrames(body.kinematics, body.full, camera, frames)
        fit = SharedFit([posed], [camera.X_CW])
        ratios = fit.inlier_ratios(fit.start)
        misfits = frame_misfits(posed, camera.X_CW, ratios, fit.inliers(ratios))
        checked = replace(found, camera=camera, covariance=fitted.covariances[0], frames=misfits)
        # The fit holds on to the focal length it starts from, so it is repeated from a new one.
        checked, again, _ = check_focal_length(body, checked, frames)
        deviation = is_new = again or deviation
        text = " The camera was written with the focal length that was found"
        camera = checked.camera
    text = (
        f"camera '{given.name}': its pictures determine a focal length of {camera.focal_x:.0f} "
        f"pixels (standard deviation {deviation * camera.focal_x:.0f}), but {given.focal_x:.0f} is "
        f"given; is it that of this camera, and of pictures of this size?{text}"
    )
    return checked, is_new, [text]


def compare_camera(
    body: RegistrationBody,
    given: PinholeCamera,
    found: RegisteredCamera,
    values: Array,
    alone: bool,
) -> Finding:
    """Return the difference of a given pose from the registered one as a finding.

    Args:
        body: the robot's surfaces.
        given: the camera at its given pose.
        found: the same camera at its registered pose.
        values: (f, m) the pose tree's values in the compared frames [rad or m].
        alone: whether it is the only camera, so that the base may have moved instead.
    """
    middle = placed_points(body.coarse, body.kinematics.poses(values[0])).mean(axis=0)
    distance = float(np.linalg.norm(found.camera.X_WC[:3, 3] - middle))
    text, reading = "", likeliest_reading(given.X_WC, found.camera.X_WC, distance)
    if reading is not None:
        words, angle, shift = reading
        text = (
            f"; its X_WC seems to be {words}: read so, it is off by {np.degrees(angle):.2f} "
            f"degrees and {1e3 * shift:.1f} mm"
        )
    pixels = _picture_shift(body, (given, values), (found.camera, values))
    others = ("base",) if alone and not text else ()
    return replace(pose_finding(given, found, pixels), alternatives=others, text=text)


def pose_finding(given: PinholeCamera, found: RegisteredCamera, pixels: float) -> Finding:
    """Return the difference of a camera's given pose from the registered one as a finding.

    pixels: by how much it moves what the camera sees.
    """
    difference = pose_difference(found.camera.X_WC, given.X_WC)
    turn, shift = (float(np.linalg.norm(part)) for part in np.split(difference, 2))
    p_value = float(chdtrc(len(difference), squared_distance(difference, found.covariance)))
    sds = found.rotation_sd, found.translation_sd
    return Finding("camera", given.name, turn, shift, *sds, pixels, p_value)


def compare_clock(
    body: RegistrationBody,
    result: PictureRegistration,
    recording: Recording,
    clock_sd: float = 0.002,
) -> list[Finding]:
    """Return significant findings "clock" (time offset) and "rate" (drift) of a camera's clock.

    Args:
        body: the robot's surfaces.
        result: the camera's registration; its time offset may be unknown.
        recording: the recording as given, without a correction of its clock.
        clock_sd: standard deviation of the offset between well synchronised clocks [s].
    """
    clock, camera = result.time_offset, result.found.camera
    if clock is None or not clock.determined:
        return []
    rows = [recording.names.index(frame.name) for frame in result.frames]
    given, found = recording.values_at(0.0)[rows], result.recording.values_at(clock.value)[rows]
    known = np.isfinite(given).all(axis=1)
    pixels = _picture_shift(body, (camera, given[known]), (camera, found[known]))
    if pixels < DIAGNOSIS.min_common_pixels:
        return []
    value, deviation = clock.value, clock.deviation
    if clock.drift and recording.times is not None:
        # Report the offset at the first picture, not at the mean time.
        since = float(recording.times[rows].mean() - recording.times[0])
        value -= clock.drift * since
        deviation = math.hypot(deviation, clock.drift_deviation * since)
    findings = []
    for kind, size, sd, least in (
        ("clock", value, deviation, clock_sd),
        ("rate", clock.drift, clock.drift_deviation, 0.0),
    ):
        p_value = float(chdtrc(1, size**2 / (sd**2 + least**2)))
        if p_value < DIAGNOSIS.significance:
            findings.append(Finding(kind, camera.name, 0.0, size, 0.0, sd, pixels, p_value))
    return findings


def _picture_shift(
    body: RegistrationBody, one: tuple[PinholeCamera, Array], other: tuple[PinholeCamera, Array]
) -> float:
    """Return the root mean square distance of the body's points between pictures [pixel].

    Distances are clipped at a picture's diagonal.

    one, other: a camera, and values (f, m) of the body's pose tree in the same f frames.
    """
    pixels = []
    for camera, values in (one, other):
        points = [placed_points(body.coarse, body.kinematics.poses(row)) for row in values]
        pixels.append(camera.project(np.concatenate(points))[0])
    squares = ((pixels[0] - pixels[1]) ** 2).sum(axis=1)
    most = math.hypot(one[0].width, one[0].height)
    return float(np.sqrt(np.fmin(squares, most**2).mean()))


def last_before_change(wrong: Sequence[bool]) -> int | None:
    """Return the index of the last frame before frames change from inliers to outliers, or back.

    ``wrong``: for each frame, whether it is an outlier. Returns the index; None: there is not
    exactly one change, or there are fewer than two outliers or inliers.
    """
    turns = np.flatnonzero(np.diff(np.array(wrong, int)))
    if len(turns) != 1 or min(sum(wrong), len(wrong) - sum(wrong)) < 2:
        return None
    return int(turns[0])


def base_motion(placed: Sequence[tuple[Camera, RegisteredCamera]]) -> Finding | None:
    """Return the base's motion that explains the motions of all cameras; None: none does.

    One camera alone does not tell a motion of the base from its own. The finding's shift is that
    of the world's origin; its pixels and p-value are 0.

    The cameras' motions differ by four standard deviations, 0.25 degrees and 3 mm at most.
    ``placed``: cameras at their given poses, and as registered.
    """
    motions = [given.X_WC @ found.camera.X_CW for given, found in placed]
    rotation_sd = max((found.rotation_sd for _, found in placed), default=0.0)
    shift_sd = max((found.translation_sd for _, found in placed), default=0.0)
    differences = [pose_difference(motion, motions[0]) for motion in motions[1:]]
    most = 4.0 * rotation_sd + np.radians(0.25), 4.0 * shift_sd + 0.003
    if not differences or any(
        np.linalg.norm(difference[:3]) > most[0] or np.linalg.norm(difference[3:]) > most[1]
        for difference in differences
    ):
        return None
    motion = pose_difference(motions[0], np.eye(4))
    size = float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))
    return Finding("base", "base", *size, rotation_sd, shift_sd)
