"""Audit a scene or an episode: find errors of joints, cameras, clocks, and outlier frames.

In an episode each camera is first registered from its pictures, with its clock. This gives masks
that do not depend on the given pose. If the given pose differs significantly from the registered
pose, that is a finding, and frames are compared with the registered pose; otherwise with the given.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import DrakePoseError, RegistrationError, listed, noted_warnings
from drake_pose.files.folder import read_summary, write_summary, writes_folder
from drake_pose.files.records import mask_digests, user_units
from drake_pose.files.settings import AuditSettings, percent
from drake_pose.jobs.registration.diagnosis import base_motion, compare_camera, compare_clock
from drake_pose.jobs.registration.inputs import RegistrationInputs, on_link, read_inputs
from drake_pose.jobs.registration.large_errors import SceneComparison, SceneFit
from drake_pose.jobs.registration.pages import audit_answer, audit_page
from drake_pose.jobs.registration.positions import still_joints
from drake_pose.jobs.registration.result import (
    describe_run,
    write_comparisons,
    write_corrections,
    write_overlays,
)
from drake_pose.jobs.registration.tracks import (
    compare_on_link,
    describe_found,
    draw_tracks,
    given_on_link,
    register_on_link,
    register_recordings,
    say_refused,
    track_warnings,
    turn_of,
    watch_cameras,
)
from drake_pose.jobs.registration.words import (
    describe_common_finding,
    describe_frame_finding,
    lost_frames_warning,
    shift_unit,
)
from drake_pose.registration.diagnosis import DIAGNOSIS
from drake_pose.registration.findings import Diagnosis, Finding, FrameDiagnosis
from drake_pose.registration.picture_acceptance import PictureRegistration, evaluate_pictures
from drake_pose.registration.posed_frames import MultiViewFrame, PosedFrame
from drake_pose.registration.register import RegisteredCamera, RegistrationBody
from drake_pose.registration.track_registration import TrackRegistration
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.workers import use_workers


@dataclass(frozen=True, eq=False)
class SceneAudit:
    """The audit of a scene.

    Args:
        audit: the diagnosis of all frames, with the findings.
        summary: contents of summary.json.
        warnings: for the user.
        answer: the result in a few sentences.
        folder: the result's folder; None: nothing was written.
    """

    audit: Diagnosis
    summary: Mapping[str, Any]
    warnings: tuple[str, ...]
    answer: str
    folder: Path | None


@writes_folder
def audit_scene(
    scene: Path | str,
    model: Path | str,
    joints: Path | str | None = None,
    out: Path | str | None = None,
    settings: AuditSettings | None = None,
    *,
    cameras: Path | str | None = None,
    overlay: bool = True,
    on_frame: Callable[[int], None] | None = None,
    near: Path | None = None,
) -> SceneAudit:
    """Find errors common to all frames, and outlier frames; the time is linear in their number.

    Args:
        scene: a folder with masks and cameras.yaml; or an episode of pictures, in which the robot
            is found without the poses of the audited cameras.
        model: the robot's model file, with the robot placed in the world as in the file.
        joints: joint positions by frame, or by time for an episode (CSV) [rad or m]. None: the
            recording's own.
        out: folder for the result, new or empty; None: nothing is written.
        settings: what is audited, and how.
        cameras: a camera file in place of the scene's or episode's own.
        overlay: whether overlays are drawn.
        on_frame: called after each frame, with the number of frames that are done.
        near: result folder of the audit of another episode. Cameras are first sought near the poses
            found there, then everywhere. None: all are sought everywhere.

    Raises:
        DrakePoseError: names the wrong file, camera, frame or joint.
    """
    settings, begin = settings or AuditSettings(), time.perf_counter()
    table, file, folder = (None if one is None else Path(one) for one in (joints, cameras, out))
    with use_workers(settings.workers), noted_warnings() as noted:
        inputs = watch_cameras(read_inputs(Path(scene), Path(model), table, file, settings))
        noted += (*inputs.warnings, *still_joints(inputs.mapped, inputs.model))
        pictures, tracks = _Pictures(), dict[str, TrackRegistration]()
        frames, findings, of_links = list[FrameDiagnosis](), list[Finding](), list[str]()
        standing = [one.name for one in inputs.searched_cameras if one.name not in inputs.links]
        compared, refused, given = None, {**inputs.riding}, inputs
        if inputs.links or inputs.riding:
            tracks, frames, findings, of_links = _find_on_links(inputs, settings, refused)
            given = inputs.of_cameras([name for name in standing if name not in inputs.riding])
        if not inputs.recordings:
            compared = SceneComparison(inputs, on_frame).run()
        elif given.searched_cameras and (given.given_cameras or not given.given_on_links):
            inputs, pictures, compared = _compare_standing(given, near, on_frame, refused)
    if not pictures.found and not tracks and inputs.recordings:
        raise next(iter(refused.values()))
    found, empty = (compared.found, compared.empty_frames) if compared else (Diagnosis((), ()), ())
    common = [Finding("refused", name, text=say_refused(why)) for name, why in refused.items()]
    common += [*pictures.findings, *findings, *found.common]
    found = replace(found, common=tuple(common), frames=(*found.frames, *frames))
    warnings = [*inputs.warnings, *of_links, *(compared.warnings if compared else ())]
    warnings += _audit_warnings(inputs, found, empty)
    warnings += [
        f"camera '{name}' was not audited: no pose of it is given; drake-pose register finds it"
        for name in standing
        if inputs.recordings and name not in {*pictures.found, *refused}
    ]
    units = zip(inputs.model.position_names, user_units(inputs.model), strict=True)
    names = [camera.name for camera in inputs.known_cameras]
    least, center = found.minimum_detectable, found.center
    results: dict[str, PictureRegistration | TrackRegistration] = {**pictures.found, **tracks}
    summary = {
        "findings": _describe_findings(found),
        "frame_count": len(found.frames),
        "agreeing_count": len(found.frames) - len(found.outliers),
        "frames": {
            one.frame: {
                "agrees": one.finding is None,
                "fits": dict(one.given_ratios),
                "fits_when_freed": dict(one.fitted_ratios),
                "pixels": one.pixels,
                "masks": mask_digests(inputs.scene, names, one.frame),
            }
            for one in found.frames
        },
        "found_cameras": {k: describe_found(v, given.links.get(k)) for k, v in results.items()},
        "minimum_detectable": {
            name: unit * least[name] if math.isfinite(least[name]) else None
            for name, unit in units
            if name in least
        },
        "principal_point_px": center and dict(zip(("offset", "sd"), center, strict=True)),
        **describe_run(inputs, settings, warnings, time.perf_counter() - begin),
        "unseen": list(empty),
    }
    kinds = dict(zip(inputs.model.position_names, inputs.model.position_kinds, strict=True))
    if folder is not None:
        for name, result in tracks.items() if overlay else ():
            of = given_on_link(given, name, given.links[name])
            draw_tracks(folder, result, of, prefix=f"{name}-")
        _write_result(folder, inputs, found, pictures, overlay, summary, kinds)
    return SceneAudit(found, summary, tuple(warnings), audit_answer(summary, kinds), folder)


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Results from an episode's pictures; empty for a scene of masks.

    Args:
        found: registrations by camera.
        findings: errors of cameras and clocks.
        names: camera, and picture's name in its recording, by name of each audited frame.
    """

    found: Mapping[str, PictureRegistration] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    names: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def _find_on_links(
    inputs: RegistrationInputs, settings: AuditSettings, refused: dict[str, RegistrationError]
) -> tuple[dict[str, TrackRegistration], list[FrameDiagnosis], list[Finding], list[str]]:
    """Register each camera of an episode that rides on a link, and compare it with its given pose.

    refused: output: by camera, the error if no pose explains its pictures.

    Returns the registrations by camera; for each of their pictures the fraction of its points that
    fits, as a diagnosis; the findings: poses that differ from the given ones; and warnings.
    """
    tracks, frames = dict[str, TrackRegistration](), list[FrameDiagnosis]()
    findings, warnings = list[Finding](), list[str]()
    for name, link in inputs.links.items():
        own, asked = on_link(inputs, name, settings)
        try:
            result = tracks[name] = register_on_link(own, asked, own.searched_cameras[0])
        except RegistrationError as error:
            refused[name] = error
            continue
        given = given_on_link(inputs, name, link)
        difference = None if given is None else compare_on_link(result, given)
        if difference is not None and difference.p_value <= DIAGNOSIS.significance:
            findings.append(difference)
        if name in {one.name for one in inputs.given_cameras}:
            text = f"camera '{name}' has an X_WC, but moves with link '{link}': give link and X_LC"
            findings.append(Finding("reading", text))
        warnings += track_warnings(result, name in inputs.assumed_focal)
        for one in result.found.frames:
            ratios = {name: one.inlier_ratio}
            text = f"{percent(one.inlier_ratio)} of its points fit"
            off = None if one.is_inlier else Finding("unexplained", name, text=text)
            frames.append(FrameDiagnosis(f"{name}-{one.frame}", ratios, ratios, 0.0, off))
    return tracks, frames, findings, warnings


def _compare_standing(
    given: RegistrationInputs,
    near: Path | None,
    on_frame: Callable[[int], None] | None,
    refused: dict[str, RegistrationError],
) -> tuple[RegistrationInputs, _Pictures, SceneFit | None]:
    """Find an episode's cameras that stand still, and compare its frames with them.

    refused: output: by camera, the error if no pose explains its pictures.

    Returns the inputs of the found cameras, their registrations, and what was compared; None: no
    camera is found.
    """
    inputs, pictures = _find_cameras(given, refused, near=near)
    compared = SceneComparison(inputs, on_frame).run() if pictures.found else None
    common = compared.found.common if compared else ()
    offset_joints = [k.name for k in common if k.kind == "joint"]
    if offset_joints:
        # Masks were segmented with wrong offsets, so they are made again.
        inputs, pictures = _find_cameras(given, refused, pictures, offset_joints)
        compared = SceneComparison(inputs).run() if pictures.found else None
    if compared is not None:
        # Edges of masks cut from pictures can err alike in all frames, so cameras are judged by
        # the pictures' likelihood alone.
        kept = tuple(one for one in compared.found.common if one.kind not in ("camera", "base"))
        compared = replace(compared, found=replace(compared.found, common=kept))
    return inputs, pictures, compared


def _find_cameras(
    inputs: RegistrationInputs,
    refused: dict[str, RegistrationError],
    before: _Pictures | None = None,
    offset_joints: Sequence[str] = (),
    near: Path | None = None,
) -> tuple[RegistrationInputs, _Pictures]:
    """Register each camera of an episode from its pictures, and segment all pictures.

    Args:
        inputs: the episode, with given cameras.
        refused: output: by camera, the error if no pose explains its pictures.
        before: an earlier result, from which fits start; None: poses are searched.
        offset_joints: names of the joints whose offsets are fitted.
        near: as of ``audit_scene``.

    Returns:
        the inputs as a scene of masks, and the registrations. In the inputs each picture is a frame
        of its camera only, `known_cameras` have the poses that frames are compared with, and
        `given_cameras` are the cameras whose given pose is a finding.
    """
    # Without any given pose, cameras are compared at the poses found.
    given_cameras = inputs.given_cameras or inputs.searched_cameras
    alone = len(given_cameras) == 1
    body = RegistrationBody(inputs.tree, inputs.visible_nodes)
    warnings = list[str]()
    if not inputs.given_cameras:
        warnings.append(
            f"no X_WC is given of camera {listed([one.name for one in given_cameras])}: it was "
            "searched, and joints, clock and frames are compared with the pose found"
        )
    compared, findings = list[Camera](), list[Finding]()
    names, frames = dict[str, tuple[str, str]](), list[MultiViewFrame]()
    misplaced = list[tuple[PinholeCamera, RegisteredCamera]]()
    searched = [one for one in given_cameras if before is None or one.name in before.found]
    pictures = {
        one.found.camera.name: one
        for one in register_recordings(
            body,
            inputs,
            searched,
            refused,
            offset_joints=offset_joints,
            before=None if before is None else before.found,
            near=None if near is None else _found_poses(near),
        )
    }
    for camera in inputs.searched_cameras:
        motion = inputs.motions[camera.name]
        for pixels, what in ((motion.drift, "drifts"), (motion.shake, "shakes")):
            if pixels:
                angle = turn_of(camera, pixels)
                findings.append(Finding("moved", camera.name, angle, pixels=pixels, text=what))
    for given in (camera for camera in given_cameras if camera.name in pictures):
        name, recording, result = given.name, inputs.recordings[given.name], pictures[given.name]
        values = np.array([frame.values + result.joint_offsets for frame in result.frames])
        known = given if inputs.given_cameras else result.found.camera
        difference = compare_camera(body, known, result.found, values, alone)
        if difference.p_value <= DIAGNOSIS.significance:
            findings.append(difference)
            misplaced.append((given, result.found))
            known = result.found.camera
        compared.append(known)
        findings += compare_clock(body, result, recording)
        segmented, _, lost = evaluate_pictures(body, result, result.found)
        for frame in segmented:
            frame_name = frame.name if alone else f"{name}-{frame.name}"
            names[frame_name] = name, frame.name
            frames.append(MultiViewFrame(frame_name, frame.values, {name: frame.mask}))
        warnings += [lost_frames_warning(name, lost, recording.names)] if lost else []
    base = base_motion(misplaced) if len(misplaced) == len(compared) else None
    if base is not None:
        off = [one for one in findings if one.kind == "camera"]
        base = replace(base, pixels=max(one.pixels for one in off))
        findings = [base, *(one for one in findings if one not in off)]
    updated = replace(
        inputs,
        scene=replace(inputs.scene, frames=tuple(names)),
        warnings=(*inputs.warnings, *warnings),
        known_cameras=tuple(compared),
        given_cameras=tuple(given for given, _ in misplaced),
        audited_frames=tuple(names),
        frames=tuple(frames),
    )
    return updated, _Pictures(pictures, tuple(findings), names)


def _found_poses(folder: Path) -> dict[str, Array]:
    """Return, by camera, X_WC (4, 4) as found by an audit.

    The result is empty if the folder has no result.
    """
    try:
        found = read_summary(folder)["found_cameras"]
        return {name: np.array(one["X_WC"]) for name, one in found.items() if "X_WC" in one}
    except (DrakePoseError, KeyError):
        return {}


def _audit_warnings(
    inputs: RegistrationInputs, found: Diagnosis, empty_frames: Sequence[str]
) -> list[str]:
    """Return warnings about the camera file, empty masks, and few inlier frames.

    Args:
        found: the diagnosis of all other frames.
        empty_frames: names of frames whose masks are all empty.
    """
    warnings = list[str]()
    if found.center is not None:
        (x, y), (x_sd, y_sd) = found.center
        advice = (
            "are these a CameraInfo's numbers? Then add pixel_centers: drake"
            if x < 0.0
            else "does it say pixel_centers: drake, but count pixel centres at integers?"
        )
        warnings.append(
            f"{inputs.camera_file}: the principal points are off by ({x:.2f}, {y:.2f}) +- "
            f"({x_sd:.2f}, {y_sd:.2f}) pixels, half a pixel: {advice}"
        )
    if empty_frames:
        named = frame_ranges(empty_frames, inputs.scene.frames)
        warnings.append(f"frame {named}: the masks are empty, so nothing is compared; check them")
    count, inliers = len(found.frames), len(found.frames) - len(found.outliers)
    wrong_log = any(finding.kind in ("sign", "log") for finding in found.common)
    if 2 * inliers < count and not wrong_log:
        warnings.append(
            f"only {inliers} of {count} frames agree with each other: they count as right because "
            "they are near the given values, not because of their number; check the others' masks "
            "and joint positions"
        )
    return warnings


def _write_result(
    path: Path,
    inputs: RegistrationInputs,
    found: Diagnosis,
    pictures: _Pictures,
    overlay: bool,
    summary: Mapping[str, Any],
    kinds: Mapping[str, str],
) -> None:
    """Write summary, page, overlays of outlier frames, and comparisons of wrong cameras.

    Args:
        path: the result folder.
        inputs: as audited, after `_find_cameras` for an episode.
        found: the diagnosis.
        pictures: results from an episode's pictures; empty for a scene of masks.
        overlay: whether overlays and comparisons are drawn.
        summary: contents of summary.json.
        kinds: kind of each position by name.
    """
    shown = dict[str, Picture]()
    outliers = [one for one in found.outliers if one in inputs.scene.frames] if overlay else []
    for frame in outliers if pictures.names else ():
        camera_name, name = pictures.names[frame]
        shown[frame] = inputs.recordings[camera_name].picture(name)
    for camera in inputs.known_cameras if outliers else ():
        name, titled = camera.name, []
        for view in map(inputs.read, outliers):
            if name in view.masks:
                fits = percent(summary["frames"][view.name]["fits"][name])
                title = f"{name}  frame {view.name}  OUTLIER  {fits} fits"
                titled.append((PosedFrame(view.name, view.values, view.masks[name]), title))
        write_overlays(path, inputs.tree, camera, titled, inputs.visible_nodes, shown)
    wrong = [one for one in inputs.given_cameras if one.name in pictures.found]
    for given in wrong if overlay else ():
        registration = pictures.found[given.name]
        write_comparisons(
            path, inputs, registration.frames, given, registration.found, registration.pictures
        )
    if overlay:
        write_corrections(path, inputs, found)
    write_summary(path, summary)
    joints = {name: kinds[name] for name in TreeKinematics(inputs.tree).names if name in kinds}
    audit_page(path, summary, joints).write(path)


def _describe_findings(found: Diagnosis) -> list[dict[str, Any]]:
    """Return all findings as ``findings`` of summary.json.

    Findings common to all frames come first, then those of frames, the largest error first.
    """
    rows = [(one, one.kind, one.name, describe_common_finding(one)) for one in found.common]
    rows += [
        (off, "frame", one.frame, f"frame '{one.frame}': {describe_frame_finding(one, off)}")
        for one in sorted(found.frames, key=lambda one: -one.pixels)
        if (off := one.finding) is not None and off not in found.common
    ]
    described = []
    for finding, what, name, text in rows:
        unit, factor = shift_unit(finding.kind)
        described.append(
            {
                "what": what,
                "name": name,
                "text": text,
                "cause": finding.kind,
                "cause_name": finding.name,
                "angle_deg": float(np.degrees(finding.angle)),
                "angle_sd_deg": float(np.degrees(finding.angle_sd)),
                f"shift_{unit}": factor * finding.shift,
                f"shift_sd_{unit}": factor * finding.shift_sd,
                "pixels": finding.pixels,
                "p_value": finding.p_value,
                "alternatives": list(finding.alternatives),
                "joints": dict(finding.joints),
            }
        )
    return described
