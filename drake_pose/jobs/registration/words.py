"""Errors and doubts of a registration or an audit, in words."""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np
from pydrake.multibody.tree import BodyIndex
from scipy.special import ndtri

from drake_pose.errors import RegistrationError, weighted
from drake_pose.files.settings import percent
from drake_pose.fit.base_edges import joint_rotation
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.judge import LEVEL
from drake_pose.jobs.registration.diagnosis import last_before_change
from drake_pose.registration.findings import Finding, FrameDiagnosis
from drake_pose.registration.joint_offsets import JointCalibration
from drake_pose.registration.online_registration import pose_difference, squared_distance
from drake_pose.registration.posed_frames import (
    LAST_SPACING,
    PosedFrame,
    PosedFrames,
    joints_like_cameras,
)
from drake_pose.registration.register import (
    SEARCH,
    RegisteredCamera,
    RegistrationBody,
    TargetPose,
    evenly_spaced,
)
from drake_pose.registration.shared_fit import OFFSET_UNITS, SHARED, SharedFit
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.scoring import draw_mask


def shift_unit(kind: str) -> tuple[str, float]:
    """Return the unit in which reports state the shift of findings of a kind, and a factor.

    The factor converts ``Finding.shift``, which is in m, s or pixels, or relative.
    """
    units = dict.fromkeys(("focal", "length", "rate"), ("percent", 100.0))
    return (units | {"center": ("px", 1.0), "clock": ("ms", 1e3)}).get(kind, ("mm", 1e3))


def describe_error(finding: Finding, verb: str = "off") -> str:
    """Return in words what is wrong, by how much, with standard deviations, and alternatives.

    ``finding``: of kind "joint", "length", "camera", "base", "focal", "center", "clock" or "rate".
    ``verb``: before the amount, such as "off" or "is off"; used for kinds "camera", "base" and
    "center" only.
    """
    if finding.kind == "clock":
        word = "later" if finding.shift > 0.0 else "earlier"
        return (
            f"camera '{finding.name}': its pictures show joint positions that are logged "
            f"{1e3 * abs(finding.shift):.0f} +- {1e3 * finding.shift_sd:.0f} ms {word} than their "
            "times"
        )
    if finding.kind == "rate":
        return describe_drift(finding.name, finding.shift, finding.shift_sd)
    name = "the base" if finding.kind == "base" else f"{finding.kind} '{finding.name}'"
    name = f"the {finding.name}" if finding.kind in ("focal", "center") else name
    name = f"link '{finding.name}'" if finding.kind == "length" else name
    if finding.alternatives:
        name += f" (or {', '.join(finding.alternatives)}: the masks do not distinguish them)"
    angle, angle_sd = np.degrees([finding.angle, finding.angle_sd]).tolist()
    unit, factor = shift_unit(finding.kind)
    shift, shift_sd = factor * finding.shift, factor * finding.shift_sd
    if finding.kind == "joint":
        reading = (angle, angle_sd, "deg") if finding.angle_sd > 0.0 else (shift, shift_sd, unit)
        return f"{name} {describe_reading(*reading)}"
    if finding.kind in ("focal", "length"):
        # The shift is the correction, so a positive one means too short.
        word, many = "short" if shift > 0.0 else "long", finding.name.startswith("focal lengths")
        verb = "are" if many else "is"
        return f"{name} {verb} {abs(shift):.1f} +- {shift_sd:.1f} {unit} too {word}"
    parts = []
    if finding.angle_sd > 0.0:
        parts.append(f"{angle:.2f} +- {angle_sd:.2f} degrees")
    if finding.shift_sd > 0.0:
        at = f" ({1e3 * finding.at_body:.1f} mm at the robot)" if finding.at_body else ""
        parts.append(f"{shift:.1f} +- {shift_sd:.1f} {unit}{at}")
    return f"{name}{':' if verb == 'off' else ''} {verb} by {' and '.join(parts)}"


def describe_common_finding(finding: Finding) -> str:
    """Return a finding common to all inlier frames in words, without a final full stop."""
    pixels = f", which moves outlines by {finding.pixels:.1f} pixels" if finding.pixels else ""
    link = f"link '{finding.link}' is not where the log says"
    if finding.kind == "sign":
        return (
            f"joint '{finding.name}' is logged with the other sign (reverse its column): {link}, "
            f"{finding.text}{pixels}"
        )
    if finding.kind == "log":
        return f"{link}: joint '{finding.name}' differs from the log, {finding.text}{pixels}"
    if finding.kind == "link":
        return f"{link}: {finding.text}"
    if finding.kind == "refused":
        return finding.text
    if finding.kind == "reading":
        return f"{finding.name}{pixels}"
    if finding.kind == "moved" and not finding.link:
        angle = f"{math.degrees(finding.angle):.2f} degrees"
        return f"camera '{finding.name}' {finding.text}, as by turns of {angle}{pixels}"
    if finding.kind == "moved":
        off = describe_error(replace(finding, kind=finding.link), "is off")
        what = "the base" if finding.link == "base" else f"camera '{finding.name}'"
        return f"{what} was moved {finding.text}, {off}{pixels}"
    # The text of a camera's finding names another reading of its pose.
    return f"{describe_error(finding)} in all frames that agree{pixels}{finding.text}"


def describe_frame_finding(frame: FrameDiagnosis, found: Finding) -> str:
    """Return the error of an outlier frame in words.

    frame: its diagnosis. found: its finding.
    """
    pixels = f"which moves outlines by {found.pixels:.1f} pixels"
    if found.kind == "unexplained":
        worst = min(frame.fitted_ratios, key=lambda name: frame.fitted_ratios[name])
        return found.text or (
            f"no positions near the given ones explain it: in camera '{worst}' "
            f"{percent(frame.fitted_ratios[worst])} of the contours fit at best"
        )
    most = math.radians(10.0)
    if found.kind == "joint" and abs(found.angle) > most:
        # Fits of single frames are good up to this angle: a larger estimate is not stated.
        word = "low" if found.angle > 0.0 else "high"
        return f"joint '{found.name}' reads more than 10 degrees too {word}, {pixels}"
    if found.kind == "joints":
        named = sorted(found.joints.items(), key=lambda item: -abs(item[1]))
        joints = ", ".join(name for name, _ in named[:3])
        more = f" ({joints} most)" if joints else ""
        return f"has other joint positions than given{more}, {pixels}"
    return f"{describe_error(found, 'is off')}, {pixels}"


def describe_reading(value: float, deviation: float, unit: str) -> str:
    """Return in words that a joint's encoder reads too high or too low.

    ``value``, ``deviation``: the joint offset, to be added to readings, and its standard deviation
    [`unit`]. ``unit``: "deg" or "mm".
    """
    word, digits = "low" if value > 0.0 else "high", 2 if unit == "deg" else 1
    size = f"{abs(value):.{digits}f} +- {deviation:.{digits}f}"
    return f"reads {size} {'degrees' if unit == 'deg' else unit} too {word}"


def describe_drift(camera: str, drift: float, deviation: float) -> str:
    """Return in words that the joint log's clock runs faster or slower than a camera's.

    Args:
        camera: its name.
        drift, deviation: how much faster the log's clock runs, and its standard deviation [s/s].
    """
    word = "faster" if drift > 0.0 else "slower"
    return (
        f"camera '{camera}': the joint log's clock runs {100.0 * abs(drift):.2f} +- "
        f"{100.0 * deviation:.2f} percent {word} than its pictures': is the pictures' rate "
        "correct, and were none dropped?"
    )


def lost_frames_warning(
    camera: str, lost: Sequence[str], names: Sequence[str], what: str = "robot"
) -> str:
    """Return a warning of pictures without the robot where it should be.

    Args:
        camera: its name.
        lost: names of the pictures without the robot.
        names: names of all pictures, in order.
        what: what is not visible.
    """
    return (
        f"camera '{camera}': the {what} is not visible where it should be in frames "
        f"{frame_ranges(lost, names)}: is something in front of it, or do the joint positions "
        "belong to other pictures?"
    )


def fit_of_inliers(
    body: RegistrationBody, found: RegisteredCamera, frames: Sequence[PosedFrame], most: int = 24
) -> SharedFit | None:
    """Return a fit of a camera's inlier frames, at its pose; None: there are none.

    ``body``: the robot's surfaces. ``found``: the registered camera. ``frames``: its frames.
    ``most``: maximum number of inlier frames that are used.
    """
    names = {frame.frame for frame in found.frames if frame.is_inlier}
    sample = evenly_spaced([frame for frame in frames if frame.name in names], most)
    if not sample:
        return None
    posed = PosedFrames(body.kinematics, body.full, found.camera, sample, LAST_SPACING)
    return SharedFit([posed], [found.camera.X_CW])


def likely_offset_warnings(body: RegistrationBody, camera: str, fit: SharedFit) -> list[str]:
    """Return a warning of the likeliest joint offset that would explain all frames' residuals.

    The list is empty if no offset is likely.

    ``body``: the robot's surfaces. ``camera``: its name. ``fit``: of `fit_of_inliers`.
    """
    all_frames = np.ones(len(fit.views[0].frames), bool)
    likely = fit.likely_offsets(
        fit.fit(SHARED.stages_with_constants[-1:], fit.start, all_frames), all_frames
    )
    turns = dict(zip(body.kinematics.names, body.kinematics.is_angle, strict=True))
    for name, estimate in likely.items():
        unit, factor = ("deg", math.degrees(1.0)) if turns[name] else ("mm", 1e3)
        reading = describe_reading(factor * estimate[0], factor * estimate[1], unit)
        return [
            f"camera '{camera}': its frames are explained better if joint '{name}' "
            f"{reading}; while joint offsets are unknown, the camera's error may exceed its "
            "standard deviation: estimate them with --zeros all"
        ]
    return []


def odd_link_warnings(
    body: RegistrationBody,
    camera: str,
    fit: SharedFit,
    without: Collection[str],
    *,
    max_ratio: float = 0.75,
    min_fraction: float = 0.04,
) -> list[str]:
    """Return a warning of each link whose contour hardly fits while those of other links do.

    Args:
        body, camera, fit: as of `likely_offset_warnings`.
        without: names of links that were left out; links welded to their parents are not judged.
        max_ratio: maximum fitting fraction of a named link's contour, over the links' median. In
            masks by Drake's renderer links as modelled have 0.93 or more, a link with another
            gripper 0.61 at most, with a box of its own size 0.64 at most.
        min_fraction: minimum length of a judged link's contour [length of all contours].
    """
    lengths, fitting = fit.matched_lengths(fit.start).T
    ratios = fitting / np.maximum(lengths, 1e-9)
    shown = lengths >= min_fraction * max(float(lengths.sum()), 1e-9)
    is_odd = shown & (ratios < max_ratio * np.median(ratios[shown]))
    if not is_odd.any():
        return []
    others = shown & ~is_odd
    ratio = float(fitting[others].sum() / lengths[others].sum())
    if ratio < 0.5:  # As with masks that are too wide everywhere.
        return []
    elsewhere = percent(ratio)
    texts, model = [], body.tree.model
    joints = [model.plant.get_joint(index) for index in model.plant.GetJointIndices()]
    cut = [joint.parent_body() for joint in joints if joint.child_body().name() in without]
    for k in np.flatnonzero(is_odd):
        node = body.tree.nodes[k].name
        # The gripper is welded to the last link, as a rule.
        group = model.plant.GetBodiesWeldedTo(
            model.plant.get_body(BodyIndex(model.link_index(node)))
        )
        if any(body.index() == other.index() for body in group for other in cut):
            continue
        fixed = [model.link_names[int(body.index())] for body in group]
        welded = [name for name in fixed if name in model.link_meshes]
        outermost = min(welded, key=lambda name: len(model.carried_by(name)), default=node)
        more = "" if outermost == node else f" (with {outermost})"
        texts.append(
            f"camera '{camera}': {percent(float(ratios[k]))} of the contour of link "
            f"'{node}'{more} fits, elsewhere {elsewhere}: is another gripper or tool mounted, a "
            "camera or a cable, is a joint before it misread (drake-pose audit tells), or are the "
            f"pictures distorted? --without {outermost} leaves it out, with what it carries"
        )
    return texts


def frames_of_other_rows(
    body: RegistrationBody, found: RegisteredCamera, frames: Sequence[PosedFrame], most: int = 24
) -> list[str]:
    """Return the outlier frames that the joint positions of another frame explain better.

    A frame's mask is compared with the body at the positions of at most ``most`` frames. With
    those that explain it best, its contours must cost less at LEVEL, over all that were tried, and
    as much of them must fit as in the worst inlier frame: a bad mask fits no positions.

    ``body``: the robot's surfaces. ``found``: the registered camera. ``frames``: its frames.
    """
    named = list[str]()
    least = min((k.inlier_ratio for k in found.frames if k.is_inlier), default=1)
    rows = [one.values for one in evenly_spaced(frames, most)]
    for frame in (one for one in frames if one.name in found.outliers):
        tried = [frame, *(replace(frame, values=row) for row in rows)]
        posed = PosedFrames(body.kinematics, body.full, found.camera, tried, LAST_SPACING)
        fit = SharedFit([posed], [found.camera.X_CW])
        costs = fit.tile_costs(fit.start, max(1.0, SEARCH.tile_side * posed.size))
        best = 1 + int(np.argmin(costs[1:].sum(axis=(1, 2))))
        chance = LEVEL / len(rows)
        if vuong_statistic(costs[0], costs[best]) > ndtri(1.0 - chance) and (
            fit.inlier_ratios(fit.start)[best] >= least
        ):
            named.append(frame.name)
    return named


def outlier_warnings(
    found: RegisteredCamera, from_pictures: bool = False, misplaced: Collection[str] = ()
) -> list[str]:
    """Return warnings of a camera's outlier frames.

    from_pictures: whether the camera was registered from pictures. misplaced: outlier frames of
        `frames_of_other_rows`; the masks of others are suspected.

    Raises RegistrationError: half of the masks or more are outliers. In pictures this is a warning:
        the frames of the fit agree, and the others may be dark or blurred.
    """
    name, frames = found.camera.name, [frame.frame for frame in found.frames]
    wrong = found.outliers
    if not wrong:
        return []
    right = [frame for frame in frames if frame not in wrong]
    last, moved = last_before_change([frame in wrong for frame in frames]), ""
    if last is not None:
        moved = f" Were camera or base moved after frame '{frames[last]}'?"
    told = f"{len(wrong)} of {len(frames)}: {frame_ranges(wrong, frames)}"
    if 2 * len(right) <= len(frames) and not from_pictures:
        raise RegistrationError(
            f"camera '{name}': half of the frames or more are outliers, {told}.{moved} Either "
            f"these are wrong, or the others, {frame_ranges(right, frames)}, agree by chance: is "
            "this the robot's model, with covers and tools, and are the joint positions those of "
            "the pictures and in the model's zeros (--zeros all)? If the others are right, give a "
            "scene of them alone. Nothing was written"
        )
    texts = [f"camera '{name}': {len(wrong)} of {len(frames)} frames are outliers and did not "
             f"count: {frame_ranges(wrong, frames)}"]  # fmt: skip
    doubted = [frame for frame in wrong if frame not in misplaced]
    if doubted and math.isnan(found.frames[0].E_total):
        texts.append("few points of the scene fit there: did things move?")
    elif doubted:
        what = "what hides the robot there" if from_pictures else "their masks"
        texts.append(
            f"no other frame's joint positions explain {frame_ranges(doubted, frames)}: check "
            f"{what} first"
        )
    if misplaced:
        texts.append(
            f"the joint positions of other frames explain {frame_ranges(misplaced, frames)} "
            "better: are their joint positions those of the pictures?"
        )
    text = "; ".join(texts) + moved
    if 2 * len(right) > len(frames):
        return [text]
    return [
        weighted(
            f"{text} FEWER THAN HALF OF THE FRAMES AGREE, {len(right)} of {len(frames)}: "
            f"{frame_ranges(right, frames)}; the pose rests on these alone and may be wrong: "
            "correct the others, or add frames",
            "wrong",
        )
    ]


def zero_warnings(
    body: RegistrationBody, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> list[str]:
    """Return a warning of a joint that turns a camera, and whose zero silhouettes do not show.

    ``found``: a camera that was registered with the logged zeros. ``frames``: of the camera.
    """
    values, camera = np.array([one.values for one in frames]), found.camera
    shown = np.array([len(one.vertices) > 0 for one in body.full])
    for name in joints_like_cameras(body.kinematics, values, shown):
        joint = body.kinematics.names.index(name)
        if not body.kinematics.is_angle[joint]:
            continue
        X = joint_rotation(body.kinematics, values[0], joint, OFFSET_UNITS[0])
        off = pose_difference(X @ camera.X_WC, camera.X_WC)
        if squared_distance(off, found.covariance) < 1.0:
            text = (
                f"camera '{camera.name}': it is known relative to the zero of joint '{name}', on "
                "which all depends that is seen and not round: if this joint reads a degree too "
                "high, the camera is turned by a degree about its axis. The standard deviations "
                f"allow for half a degree; --zeros {name} allows for more"
            )
            return [weighted(text, "note")]
    return []


def mode_warnings(
    body: RegistrationBody, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> list[str]:
    """Return a warning of other poses that fit a camera equally well; empty: there are none.

    It names the joint that tells them apart best, if it alone is moved from the first frame to an
    end of its range, or by up to half a turn: there the silhouettes at the two most similar poses
    differ most.

    frames: of the camera; empty: no joint is named.
    """
    camera, kinematics = found.camera, body.kinematics
    if not len(found.alternatives):
        return []
    advice, best = "add frames with other joint positions", 0.0
    cameras = [camera.with_pose(X) for X in (camera.X_WC, *found.alternatives)]
    ends = np.clip([kinematics.lower, kinematics.upper], -np.pi, np.pi)
    for end, k in product(ends, range(len(kinematics.names))) if frames else ():
        values = frames[0].values.copy()
        values[k] = end[k]
        X_WN = kinematics.poses(values)
        masks = [draw_mask(body.coarse, one.X_CW @ X_WN, one) for one in cameras]
        if not all(mask.any() for mask in masks):
            continue
        difference = min(
            2.0 * np.count_nonzero(a != b) / (np.count_nonzero(a) + np.count_nonzero(b))
            for a, b in combinations(masks, 2)
        )
        if difference > best:
            turns, best = kinematics.is_angle[k], difference
            to = f"{math.degrees(end[k]):.0f} degrees" if turns else f"{end[k]:.3f} m"
            advice = (
                f"add frames in which joint '{kinematics.names[k]}' moves: at {to}, and else as in "
                f"frame '{frames[0].name}', their silhouettes differ by {percent(best)}"
            )
    return [
        f"camera '{camera.name}': {len(found.alternatives)} other poses fit equally well (modes in "
        f"summary.json); {advice}"
    ]


def parameter_warnings(found: JointCalibration) -> list[str]:
    """Return warnings of joint offsets and link scales that are uncertain.

    There is a warning if no parameter is significant, or for each parameter that only static parts
    separate from a camera's pose; and for each that is not determined.
    """
    requested = [(f"joint '{offset.name}': its offset", offset) for offset in found.offsets]
    requested += [(f"link '{scale.name}': its length", scale) for scale in found.link_scales]
    if requested and not any(parameter.significant for _, parameter in requested):
        text = (
            "none of the requested joint offsets and link lengths is significant beside other "
            "errors (of each other, focal length, principal point, masks): no corrected URDF is "
            "written"
        )
        uncertain: list[str] = [weighted(text, "note")]
    else:
        uncertain = [
            f"{what} is good to {np.degrees(one.deviation):.2g} degrees only, and turns the camera "
            f"about the robot (correlated with {', '.join(one.gauge)}): edges of static parts "
            "separate the two. Check in the overlays whether the base fits, or give a camera with "
            "its pose"
            for what, one in requested
            if one.determined and one.gauge
        ]
    return uncertain + [
        f"{what} is not determined by these silhouettes and was not changed"
        + (
            f" (correlated with {', '.join(parameter.gauge)}, which allow for it in their standard "
            "deviations)"
            if parameter.gauge
            else ""
        )
        + "; add frames with other joint positions, or a view of a part that does not move with it"
        for what, parameter in requested
        if not parameter.determined
    ]


def target_warnings(pose: TargetPose) -> list[str]:
    """Return warnings of symmetries of the calibration target."""
    texts = []
    if len(pose.symmetry_axes):
        axes = "; ".join(", ".join(f"{x:.3f}" for x in axis) for axis in pose.symmetry_axes)
        texts.append(
            f"the target is round about an axis ({axes} in its frame), so its rotation about it is "
            "not determined"
        )
    if len(pose.alternatives):
        texts.append(
            f"the target looks the same in {len(pose.alternatives)} other poses, see its modes in "
            "summary.json"
        )
    return [weighted(f"{text}; the camera's pose does not depend on it", "note") for text in texts]


def few_frames_warning(found: RegisteredCamera) -> str:
    """Return the warning of a camera with too few frames to prove its pose (``fit.judge``)."""
    needed = 6 if found.evidence is None else found.evidence.needed
    return (
        f"camera '{found.camera.name}': its pose rests on how well its {len(found.frames)} frames "
        f"fit; to prove that joint positions and masks belong together takes {needed}"
    )


def common_outlier_warnings(
    registered: Iterable[RegisteredCamera],
    *,
    from_pictures: bool = False,
    misplaced: Collection[str] = (),
) -> list[str]:
    """Return warnings that compare several cameras' inliers.

    They name frames that are outliers in all cameras, or in one camera but not in another. If the
    cameras were registered from masks, they name pairs of cameras that have common frames, but no
    common inlier frame.

    misplaced: frames of `frames_of_other_rows`, in any camera.
    """
    seen, right = dict[str, list[str]](), dict[str, list[str]]()
    for found in registered:
        seen[found.camera.name] = [frame.frame for frame in found.frames]
        right[found.camera.name] = [frame.frame for frame in found.frames if frame.is_inlier]
    frames = list(dict.fromkeys(frame for own in seen.values() for frame in own))
    wrong = dict[tuple[str, str], list[str]]()
    reason = "something hides the robot there" if from_pictures else "their masks are not"
    for frame in frames:
        cameras = [name for name, own in seen.items() if frame in own]
        outliers = [name for name in cameras if frame not in right[name]]
        places = [f"camera '{name}', but not in another one that sees them" for name in outliers]
        why = f"their joint positions are right, {reason}"
        if outliers == cameras:
            places = ["all cameras that see them"]
            why = "check their masks, then their joint positions, or leave these frames out"
        if frame in misplaced:
            why = "the joint positions of other frames explain them better: correct theirs"
        for place in places if len(cameras) > 1 else ():
            wrong.setdefault((place, why), []).append(frame)
    texts = [
        f"cameras '{a}' and '{b}' rest on no common frame: '{a}' on "
        f"{frame_ranges(right[a], frames)}, '{b}' on {frame_ranges(right[b], frames)}: if cameras "
        "or base were moved in between, their poses do not belong together"
        for a, b in combinations(seen, 2)
        if {*seen[a]} & {*seen[b]} and not {*right[a]} & {*right[b]} and not from_pictures
    ]
    return texts + [
        f"frames {frame_ranges(own, frames)} are outliers in {place}: {why}"
        for (place, why), own in wrong.items()
    ]
