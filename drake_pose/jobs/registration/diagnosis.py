"""What is wrong with cameras, clocks, joints and frames, what else explains them, and its words."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
from scipy.special import chdtrc

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError, RegistrationError
from drake_pose.files.records import BADLY_EXPLAINED
from drake_pose.files.settings import percent
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.registration.diagnosis import DIAGNOSIS
from drake_pose.registration.findings import Finding, FrameDiagnosis
from drake_pose.registration.joint_offsets import JointCalibration, calibrate_joints
from drake_pose.registration.online_registration import pose_difference, squared_distance
from drake_pose.registration.picture_registration import PictureRegistration, Recording
from drake_pose.registration.posed_frames import (
    MultiViewFrame,
    PosedFrame,
    PosedFrames,
    placed_points,
)
from drake_pose.registration.register import (
    LAST_SPACING,
    SEARCH,
    CameraSearch,
    E_total,
    RegisteredCamera,
    RegistrationBody,
    TargetPose,
    evenly_spaced,
    overlap_areas,
)
from drake_pose.registration.shared_fit import SHARED, SharedFit
from drake_pose.registration.standing_object import TargetSearch
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.scoring import require_visible

Search = CameraSearch | TargetSearch
"""What finds a camera, and may find it again with other settings."""


def explain_misfit(found: RegisteredCamera, min_inlier_ratio: float = 0.65) -> str | None:
    """What is wrong with a pose that does not explain the masks; None where it does.

    min_inlier_ratio: of the two frames that fit best. A robot that is the masks' leaves 0.83 and
    more, with holes and tools; mirrored masks, another robot's or exchanged frames 0.6 at most.
    """
    agreeing = [frame for frame in found.frames if frame.is_inlier]
    left = _left(found)
    ratio = float(np.mean(np.sort([frame.inlier_ratio for frame in found.frames])[-2:]))
    if len(found.frames) > 1 and len(agreeing) < 2:
        return (
            f"no two of its {len(found.frames)} frames agree on one; at best frame "
            f"'{agreeing[0].frame}' fits alone"
        )
    if left < BADLY_EXPLAINED and ratio >= min_inlier_ratio:
        return None
    return (
        f"body and silhouettes differ by {percent(left)} of the silhouettes' area at best, and of "
        f"the contours {percent(ratio)} fit"
    )


def _left(found: RegisteredCamera) -> float:
    """E_total in the median of the frames that agree."""
    return float(np.median([frame.E_total for frame in found.frames if frame.is_inlier]))


def require_explained(
    search: Search,
    found: RegisteredCamera,
    frames: Sequence[PosedFrame],
    much_better: float = 0.6,
) -> None:
    """Refuses a pose that does not explain even those frames that agree best.

    much_better: an alternative is named that leaves less than this fraction of what was left.

    Raises RegistrationError: says how much remains, what would fit, and what to look at.
    """
    misfit = explain_misfit(found)
    if misfit is None:
        return
    search, better = search.rough(), []
    for text, camera, seen in _alternatives(found.camera, frames):
        try:
            other = search.register(camera, seen)
        except RegistrationError:
            continue
        if explain_misfit(other) is None and _left(other) < much_better * _left(found):
            better.append(text)
    advice = "; ".join(better) or (
        "are these masks of this robot or object, are the joint positions those of these frames, "
        "in radians and with the signs and zeros of the model's file, are focal length and "
        "principal point the camera's, are the pictures free of distortion?"
    )
    raise RegistrationError(
        f"camera '{found.camera.name}': no pose explains its masks: {misfit}; {advice} "
        "Nothing was written"
    )


def _alternatives(
    camera: PinholeCamera, frames: Sequence[PosedFrame], most: int = 5
) -> Iterator[tuple[str, PinholeCamera, list[PosedFrame]]]:
    """What else may be the case: a text, and the camera and some frames as they would be then."""
    some = evenly_spaced(frames, most)
    turned = [
        PosedFrame(frame.name, frame.values, np.ascontiguousarray(frame.mask[:, ::-1]))
        for frame in some
    ]
    text = (
        "they fit when they are mirrored: turn the pictures back, or change the sign of all joint "
        "positions."
    )
    yield text, camera.mirrored(), turned
    if len(frames) > 2:
        pairs = list(pairwise(frames))[:most]
        for which, moved in (
            ("next", [PosedFrame(a.name, b.values, a.mask) for a, b in pairs]),
            ("previous", [PosedFrame(b.name, a.values, b.mask) for a, b in pairs]),
        ):
            yield f"they fit with the joint positions of the {which} frame.", camera, moved
    for factor in (0.5, 0.7, 1.4, 2.0):
        focal_x, focal_y = factor * camera.focal_x, factor * camera.focal_y
        text = (
            f"they fit with focal lengths near {focal_x:.0f}, {focal_y:.0f} pixels: calibrate it."
        )
        yield text, replace(camera, focal_x=focal_x, focal_y=focal_y), some


def require_seen_by(
    body: RegistrationBody, cameras: Sequence[Camera], frames: Sequence[MultiViewFrame]
) -> None:
    """Refuses a camera that cannot show the robot in any of some frames that it has masks of.

    Raises CameraError: as an estimate does.
    """
    for camera in cameras:
        own, refused = [one for one in frames if camera.name in one.masks], list[CameraError]()
        for frame in own:
            try:
                require_visible(
                    body.medium, camera.X_CW @ body.kinematics.poses(frame.values), camera
                )
            except CameraError as error:
                refused.append(error)
        if own and len(refused) == len(own):
            raise refused[0]


def say_held(
    body: RegistrationBody, camera: PinholeCamera, frames: Sequence[PosedFrame]
) -> list[str]:
    """Says so where a camera whose X_WC is given does not see the robot where it stands."""
    if not frames:
        return []
    posed = PosedFrames(body.kinematics, body.full, camera, frames)
    left = float(np.median(E_total(overlap_areas(posed, camera.X_CW[None], np.inf)[0])))
    if left < BADLY_EXPLAINED:
        return []
    return [
        f"camera '{camera.name}' is held at its X_WC, but the robot is not seen there: "
        f"body and silhouettes differ by {percent(left)} of the silhouettes' area; is "
        "its world another than the robot's base? It is found anew with "
        f"--camera {camera.name}"
    ]


def require_determined(found: RegisteredCamera, max_sd: float = 0.04) -> None:
    """Refuses a pose on a link whose standard deviation is larger [rad, m] along some axis.

    Raises RegistrationError: says how unsure it is.
    """
    turn, shift = (
        math.sqrt(float(np.linalg.eigvalsh(part)[-1]))
        for part in (found.covariance[:3, :3], found.covariance[3:, 3:])
    )
    if turn > max_sd or shift > max_sd:
        raise RegistrationError(
            f"camera '{found.camera.name}': its frames do not determine where it is on the link: "
            f"standard deviations of {math.degrees(turn):.1f} degrees and {1e3 * shift:.0f} mm "
            "along some axes; add frames between which the link turns by 20 degrees and more about "
            "at least two axes. Nothing was written"
        )


def check_focal_length(
    body: RegistrationBody,
    found: RegisteredCamera,
    frames: Sequence[PosedFrame],
    *,
    off_by: float = 0.03,
    off_by_sds: float = 4.0,
    wrong_by: float = 0.06,
    most: int = 60,
) -> tuple[Array, list[str]]:
    """Compares a camera's focal length with that which the masks themselves tell.

    Args:
        body, found, frames: the body, the camera, and what it sees.
        off_by, off_by_sds: it is off if its logarithm is by more, and by more standard deviations.
            Published focal lengths of recorded arms differ by 2 % at most.
        wrong_by: it is too wrong for a calibration if it is off by more.
        most: number of frames that tell whether this need be looked at closely.

    Returns:
        The camera's covariance, and a warning where it may be a little off: then it may as well
        stand where it would with the other one, and its covariance says so.

    Raises:
        RegistrationError: it is wrong, and with it the camera's distance.
    """
    given = found.camera
    counted = [frame for frame, fit in zip(frames, found.frames, strict=True) if fit.is_inlier]
    few = evenly_spaced(counted, most)
    if len(few) < 2:
        return found.covariance, []
    seen = PosedFrames(body.kinematics, body.full, given, few)
    fit = SharedFit([seen], [given.X_CW], camera_unknowns=len(POSE_NAMES) + 1)
    camera = fit.cameras(fit.fit((*SEARCH.fine, *SEARCH.last)))[0]
    if abs(math.log(camera.focal_x / given.focal_x)) < 0.6 * off_by:
        return found.covariance, []
    told = calibrate_joints(body, [found], [counted], (), focal=True)
    camera, deviation = told.cameras[0], float(told.focal_deviations[0])
    off = math.log(camera.focal_x / given.focal_x)
    if abs(off) < max(off_by, off_by_sds * deviation):
        return found.covariance, []
    text = (
        f"camera '{given.name}': its pictures tell a focal length of {camera.focal_x:.0f} "
        f"pixels (standard deviation {deviation * camera.focal_x:.0f}), but it is given as "
        f"{given.focal_x:.0f}; is it that of this camera, and of pictures of this size? "
        "With a wrong one the camera stands at a wrong distance; calibrate it"
    )
    if abs(off) > wrong_by:
        raise RegistrationError(f"{text}. Nothing was written")
    by = pose_difference(camera.X_WC, given.X_WC)
    return told.covariances[0] + np.outer(by, by), [text]


def compare_camera(
    body: RegistrationBody,
    given: PinholeCamera,
    found: RegisteredCamera,
    values: Array,
    alone: bool,
) -> Finding:
    """By how much a camera stands elsewhere than it was found.

    Args:
        values: (f, m) where the body is in some frames.
        alone: whether it is the only one, so that the base may have moved as well.
    """
    off = pose_difference(found.camera.X_WC, given.X_WC)
    p_value = float(chdtrc(len(off), squared_distance(off, found.covariance)))
    return Finding(
        "camera", given.name, float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:])),
        found.rotation_sd, found.translation_sd,
        _picture_shift(body, (given, values), (found.camera, values)), p_value,
        ("base",) if alone else (),
    )  # fmt: skip


def compare_clock(
    body: RegistrationBody,
    one: PictureRegistration,
    recording: Recording,
    clock_sd: float = 0.002,
) -> list[Finding]:
    """Whether a camera's clock is off the joint log's, or drifts.

    Args:
        recording: as it is.
        clock_sd: standard deviation of clocks that are as good as right [s].
    """
    clock, camera = one.time_offset, one.found.camera
    if clock is None or not clock.determined:
        return []
    rows = [recording.names.index(frame.name) for frame in one.frames]
    given, found = recording.values_at(0.0)[rows], one.recording.values_at(clock.value)[rows]
    known = np.isfinite(given).all(axis=1)
    pixels = _picture_shift(body, (camera, given[known]), (camera, found[known]))
    if pixels < DIAGNOSIS.min_joint_pixels:
        return []
    value, deviation = clock.value, clock.deviation
    if clock.drift and recording.times is not None:
        # A clock that runs faster is later in the middle than when it starts.
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
    """How far points of a body are from each other in two pictures, root mean square [pixel].

    What lies outside the pictures counts as a picture's diagonal at most.

    one, other: the cameras, and values (f, m) of the body.
    """
    places = []
    for camera, values in (one, other):
        points = [placed_points(body.coarse, body.kinematics.poses(row)) for row in values]
        places.append(camera.project(np.concatenate(points))[0])
    squares = ((places[0] - places[1]) ** 2).sum(axis=1)
    most = math.hypot(one[0].width, one[0].height)
    return float(np.sqrt(np.fmin(squares, most**2).mean()))


def shift_unit(kind: str) -> tuple[str, float]:
    """The unit of the shift of a kind of finding in reports, and its factor."""
    units = {"focal": ("percent", 100.0), "center": ("px", 1.0), "clock": ("ms", 1e3)}
    return (units | {"rate": ("percent", 100.0)}).get(kind, ("mm", 1e3))


def say_off(one: Finding, verb: str = "off") -> str:
    """What is off, and what explains it as well; by how much, with standard deviations.

    verb: `off` or `is off`, of what is neither too high nor too long.
    """
    if one.kind == "clock":
        word = "later" if one.shift > 0.0 else "earlier"
        return (
            f"camera '{one.name}': its pictures show the joints of {1e3 * abs(one.shift):.0f} +- "
            f"{1e3 * one.shift_sd:.0f} ms {word} by the joint log's clock"
        )
    if one.kind == "rate":
        return say_drift(one.name, one.shift, one.shift_sd)
    name = "the base" if one.kind == "base" else f"{one.kind} '{one.name}'"
    name = f"the {one.name}" if one.kind in ("focal", "center") else name
    if one.alternatives:
        name += f" (or {', '.join(one.alternatives)}: the masks cannot tell)"
    angle, angle_sd = np.degrees([one.angle, one.angle_sd]).tolist()
    unit, factor = shift_unit(one.kind)
    shift, shift_sd = factor * one.shift, factor * one.shift_sd
    if one.kind == "joint":
        reading = (angle, angle_sd, "deg") if one.angle_sd > 0.0 else (shift, shift_sd, unit)
        return f"{name} {say_reading(*reading)}"
    if one.kind == "focal":
        # As for readings, the shift is what must be added.
        word, many = "short" if shift > 0.0 else "long", one.name.startswith("focal lengths")
        verb = "are" if many else "is"
        return f"{name} {verb} {abs(shift):.1f} +- {shift_sd:.1f} {unit} too {word}"
    parts = []
    if one.angle_sd > 0.0:
        parts.append(f"{angle:.2f} +- {angle_sd:.2f} degrees")
    if one.shift_sd > 0.0:
        at = f" ({1e3 * one.at_body:.1f} mm at the robot)" if one.at_body else ""
        parts.append(f"{shift:.1f} +- {shift_sd:.1f} {unit}{at}")
    return f"{name}{':' if verb == 'off' else ''} {verb} by {' and '.join(parts)}"


def say_common_finding(one: Finding) -> str:
    """What is off in all frames that agree, or since some frame, in words."""
    pixels = f", outlines by {one.pixels:.1f} pixels" if one.pixels else ""
    link = f"link '{one.link}' is not where the log says"
    if one.kind == "sign":
        return (
            f"joint '{one.name}' is logged with the other sign: {link}, {one.text}{pixels}: turn "
            "the sign of its column round"
        )
    if one.kind == "log":
        return f"{link}: joint '{one.name}' is another than in the log, {one.text}{pixels}"
    if one.kind == "link":
        return f"{link}: {one.text}"
    if one.kind == "reading":
        return f"{one.name}{pixels}"
    if one.kind == "moved":
        off = say_off(replace(one, kind=one.link), "is off")
        what = "the base" if one.link == "base" else f"camera '{one.name}'"
        return f"{what} was moved {one.text}, {off}{pixels}"
    return f"{say_off(one)} in all frames that agree{pixels}"


def say_frame(one: FrameDiagnosis, found: Finding) -> str:
    """What contradicts the others in a frame, in words."""
    pixels = f"outlines by {found.pixels:.1f} pixels"
    if found.kind == "unexplained":
        worst = min(one.fitted_ratios, key=lambda name: one.fitted_ratios[name])
        return (
            f"no positions near those given explain it: in camera '{worst}' "
            f"{percent(one.fitted_ratios[worst])} of the contours fit at best"
        )
    most = math.radians(10.0)
    if found.kind == "joint" and abs(found.angle) > most:
        # So far fits of single frames reach; what they say of more is no size.
        word = "low" if found.angle > 0.0 else "high"
        return f"joint '{found.name}' reads more than 10 degrees too {word}, {pixels}"
    if found.kind == "joints":
        named = sorted(found.joints.items(), key=lambda item: -abs(item[1]))
        joints = ", ".join(name for name, _ in named[:3])
        more = f" ({joints} most)" if joints else ""
        return f"is of other positions: joints are off{more}, {pixels}"
    return f"{say_off(found, 'is off')}, {pixels}"


def say_reading(value: float, deviation: float, unit: str) -> str:
    """That a joint's encoder reads too high or too low.

    Args:
        value: what must be added to its readings, and deviation: its standard deviation, in
            unit: `deg` or `mm`.
    """
    word, digits = "low" if value > 0.0 else "high", 2 if unit == "deg" else 1
    size = f"{abs(value):.{digits}f} +- {deviation:.{digits}f}"
    return f"reads {size} {'degrees' if unit == 'deg' else unit} too {word}"


def say_likely_offsets(
    body: RegistrationBody, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> list[str]:
    """That joint offsets would explain what all frames of a camera have in common."""
    agreeing = {one.frame for one in found.frames if one.is_inlier}
    some = evenly_spaced([one for one in frames if one.name in agreeing], 24)
    if not some:
        return []
    seen = PosedFrames(body.kinematics, body.full, found.camera, some, LAST_SPACING)
    fit = SharedFit([seen], [found.camera.X_CW])
    agree = np.ones(len(some), bool)
    likely = fit.likely_offsets(fit.fit(SHARED.stages_with_constants[-1:], fit.start, agree), agree)
    turns = dict(zip(body.kinematics.names, body.kinematics.is_angle, strict=True))
    for name, one in likely.items():
        unit, factor = ("deg", math.degrees(1.0)) if turns[name] else ("mm", 1e3)
        reading = say_reading(factor * one[0], factor * one[1], unit)
        return [
            f"camera '{found.camera.name}': its frames are explained better if joint '{name}' "
            f"{reading}; until the offsets of joints are known the camera may be off by more than "
            "its standard deviation: find them with --zeros all"
        ]
    return []


def say_drift(camera: str, drift: float, deviation: float) -> str:
    """By how much the joint log's clock runs faster than a camera's [s/s]."""
    word = "faster" if drift > 0.0 else "slower"
    return (
        f"camera '{camera}': the joint log's clock runs {100.0 * abs(drift):.2f} +- "
        f"{100.0 * deviation:.2f} percent {word} than its pictures': is their rate as it is said, "
        "and were none dropped?"
    )


def say_lost(camera: str, lost: Sequence[str], names: Sequence[str], what: str = "robot") -> str:
    """That pictures show nothing of a robot that they should; names: of all its pictures."""
    return (
        f"camera '{camera}': nothing of the {what} is seen where it should be in frames "
        f"{frame_ranges(lost, names)}: is something before it, or are the joint positions not "
        "those of the pictures?"
    )


def last_before_change(wrong: Sequence[bool], least: int = 2) -> int | None:
    """The last frame before a moment from or until which all frames contradict the others.

    Args:
        wrong: of each frame, whether it contradicts.
        least: number of frames that do, and of those that do not; None where they are fewer.
    """
    turns = np.flatnonzero(np.diff(np.array(wrong, int)))
    if len(turns) != 1 or min(sum(wrong), len(wrong) - sum(wrong)) < least:
        return None
    return int(turns[0])


def say_outliers(found: RegisteredCamera, from_pictures: bool = False) -> list[str]:
    """What a user should know of a camera's frames that contradict, and of other poses.

    Raises RegistrationError: half of the masks or more contradict the others. In pictures those of
        the fit agree, and the others may be dark or blurred.
    """
    name, frames = found.camera.name, [frame.frame for frame in found.frames]
    wrong, texts, moved = found.outliers, [], ""
    last = last_before_change([one in wrong for one in frames])
    if last is not None:
        moved = f" Were camera or base moved after frame '{frames[last]}'?"
    if wrong:
        right = len(frames) - len(wrong)
        text = (
            f"camera '{name}': {len(wrong)} of {len(frames)} frames contradict the others and did "
            f"not count: {frame_ranges(wrong, frames)}; are their joint positions those of the "
            f"pictures?{moved}"
        )
        if 2 * right <= len(frames):
            supporting = frame_ranges([one for one in frames if one not in wrong], frames)
            if not from_pictures:
                raise RegistrationError(
                    f"camera '{name}': half of the frames or more contradict the others, "
                    f"{len(wrong)} of {len(frames)}: {frame_ranges(wrong, frames)}.{moved} Either "
                    f"these are wrong or those that agree, {supporting}, do by chance: is the "
                    "model this robot's, with its covers and tools, and are joint positions those "
                    "of the pictures and in the model's zeros (--zeros all)? To trust those that "
                    "agree give a scene of them alone. Nothing was written"
                )
            text += (
                f" FEWER THAN HALF OF THE FRAMES AGREE, {right} of {len(frames)}: {supporting}; "
                "the pose rests on these alone and may be wrong: mend the others, or add frames"
            )
        texts.append(text)
    if len(found.alternatives):
        texts.append(
            f"camera '{name}': {len(found.alternatives)} other poses fit no worse, as far as can "
            "be told; which is the camera's nobody knows: see registration.yaml and the overlays, "
            "and add frames in which the robot stands otherwise"
        )
    return texts


def say_zeros(found: JointCalibration) -> list[str]:
    """What a user should know of zeros and lengths."""
    asked = [(f"joint '{one.name}': its zero", one) for one in found.offsets]
    asked += [(f"link '{one.name}': its length", one) for one in found.link_scales]
    if asked and not any(one.significant for _, one in asked):
        return [
            "none of the zeros and lengths that were asked for is significant beside what else may "
            "be off (the others, focal length, principal point, masks): no corrected URDF is made"
        ]
    with_cameras = [
        f"{what} goes with {', '.join(one.gauge)}; parts that stand still alone tell them apart, "
        "and pictures show those badly: the camera may be turned with it about the robot. Look "
        "whether the robot's base fits in the overlays, or give masks or a second camera"
        for what, one in asked
        if one.determined and one.gauge
    ]
    return with_cameras + [
        f"{what} is not determined by these silhouettes and was left as it is;"
        + (f" it goes with {', '.join(one.gauge)};" if one.gauge else "")
        + " frames in which the robot stands otherwise, or a part of it that does not move with "
        "this one, would tell it"
        for what, one in asked
        if not one.determined
    ]


def say_object(seen: TargetPose) -> list[str]:
    """What a user should know of an object whose place was found."""
    texts = []
    if len(seen.symmetry_axes):
        axes = "; ".join(", ".join(f"{x:.3f}" for x in axis) for axis in seen.symmetry_axes)
        texts.append(
            f"the target looks alike at every angle about an axis ({axes} in its frame), so how it "
            "is turned about it is not determined; where the camera is does not depend on it"
        )
    if len(seen.alternatives):
        texts.append(
            f"the target looks alike in {len(seen.alternatives)} other poses, see modes of the "
            "target in summary.json; where the camera is does not depend on it"
        )
    return texts


def say_common(registered: Iterable[RegisteredCamera], *, from_pictures: bool = False) -> list[str]:
    """Whose fault it is where several cameras see a frame that contradicts the others."""
    is_inlier: dict[str, dict[str, bool]] = {}
    sets, looked_at = dict[str, list[str]](), dict[str, set[str]]()
    for found in registered:
        for one in found.frames:
            is_inlier.setdefault(one.frame, {})[found.camera.name] = one.is_inlier
        sets[found.camera.name] = [one.frame for one in found.frames if one.is_inlier]
        looked_at[found.camera.name] = {one.frame for one in found.frames}
    frames, masks = list(is_inlier), dict[str, list[str]]()
    positions = [k for k, own in is_inlier.items() if len(own) > 1 and not any(own.values())]
    for frame, own in is_inlier.items():
        for name in (name for name, right in own.items() if any(own.values()) and not right):
            masks.setdefault(name, []).append(frame)
    why = "something hides the robot there" if from_pictures else "their masks are not"
    texts = [
        f"cameras '{a}' and '{b}' rest on no common frame: '{a}' on {frame_ranges(own, frames)}, "
        f"'{b}' on {frame_ranges(other, frames)}: if cameras or base were moved between, their "
        "poses are of two moments and do not belong together"
        for (a, own), (b, other) in combinations(sets.items(), 2)
        if looked_at[a] & looked_at[b] and not {*own} & {*other} and not from_pictures
    ]
    if positions:
        texts.append(
            f"frames {frame_ranges(positions, frames)} contradict the others in all cameras that "
            "see them: their joint positions are not those of the pictures"
        )
    texts += [
        f"frames {frame_ranges(wrong, frames)} contradict the others in camera '{name}', but not "
        f"in another one that sees them: their joint positions are right, {why}"
        for name, wrong in masks.items()
    ]
    return texts
