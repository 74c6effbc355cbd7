"""Which frames, cameras or joints contradict the rest in a scene: read, found, told, written.

In an episode each camera is found in its pictures as a registration finds it, and its clock; these
give masks without the given cameras. A given camera that stands far from there is named; frames are
then compared with the one that was found. One that stands near is compared as a scene's is.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.camera.camera_files import describe_camera
from drake_pose.camera.models import Camera
from drake_pose.errors import SceneError
from drake_pose.files.folder import write_summary, writes_folder
from drake_pose.files.records import mask_digests, user_units
from drake_pose.files.settings import percent
from drake_pose.jobs.estimate.measurements import say_left_out
from drake_pose.jobs.registration.audit_page import write_audit_page
from drake_pose.jobs.registration.diagnosis import (
    compare_camera,
    compare_clock,
    lost_frames_warning,
)
from drake_pose.jobs.registration.inputs import RegistrationInputs, read_inputs
from drake_pose.jobs.registration.large_errors import SceneComparison
from drake_pose.jobs.registration.result import (
    describe_pictures,
    describe_pose,
    describe_run,
    write_comparisons,
    write_overlays,
)
from drake_pose.jobs.registration.settings import AuditSettings
from drake_pose.jobs.registration.words import (
    describe_common_finding,
    describe_frame_finding,
    shift_unit,
)
from drake_pose.registration.diagnosis import DIAGNOSIS
from drake_pose.registration.findings import Diagnosis, Finding
from drake_pose.registration.picture_registration import (
    PictureRegistration,
    PictureStart,
    evaluate_pictures,
    fit_pictures,
    register_pictures,
)
from drake_pose.registration.posed_frames import MultiViewFrame, PosedFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.workers import use_workers

OnFrame = Callable[[int], None]
"""Called with the number of frames that are done."""


@dataclass(frozen=True, eq=False)
class SceneAudit:
    """What contradicts the rest in a scene; summary: what summary.json holds."""

    audit: Diagnosis
    summary: Mapping[str, Any]
    warnings: tuple[str, ...]
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
    on_frame: OnFrame | None = None,
) -> SceneAudit:
    """Finds which frames, cameras or joints contradict the rest, in time linear in the frames.

    Args:
        scene: the folder with cameras.yaml and masks; or an episode of pictures, in which the
            robot, and masks of it, are found without the cameras that are audited.
        model: the robot's model file. It stands in the world as the file has it.
        joints: joint positions by frame, of an episode by time, too (CSV) [rad or m]. None: the
            recording's own.
        out: folder for the result, new or empty; None writes nothing.
        cameras: a camera file in place of the scene's or episode's own.
        on_frame: called after each frame.

    Raises:
        DrakePoseError: names the file, camera, frame or joint at fault.
    """
    settings, begin = settings or AuditSettings(), time.perf_counter()
    table, own, folder = (None if one is None else Path(one) for one in (joints, cameras, out))
    with use_workers(settings.workers):
        inputs = read_inputs(Path(scene), Path(model), table, own, settings)
        pictures = _Pictures()
        if inputs.recordings:
            given, (inputs, pictures) = inputs, _find_cameras(inputs)
            compared = SceneComparison(inputs, on_frame).run()
            zeros = [one.name for one in compared.found.common if one.kind == "joint"]
            if zeros:
                # Masks were found with these as they are, and lean on them.
                inputs, pictures = _find_cameras(given, pictures, zeros)
                compared = SceneComparison(inputs).run()
        else:
            compared = SceneComparison(inputs, on_frame).run()
    found, unseen = compared.found, compared.unseen
    found = replace(found, common=(*pictures.findings, *found.common))
    seconds = time.perf_counter() - begin
    warnings = [*inputs.warnings, *compared.warnings, *_doubts(inputs, found, unseen)]
    names = [camera.name for camera in inputs.known_cameras]
    units = zip(inputs.model.position_names, user_units(inputs.model), strict=True)
    noticed = {
        name: unit * found.minimum_detectable[name]
        for name, unit in units
        if name in found.minimum_detectable
    }
    center = found.center
    summary = {
        "contradictions": _describe_contradictions(found),
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
        "found_cameras": {
            name: describe_pictures(one)
            | describe_pose("X_WC", one.found.camera.X_WC, one.found)
            | {
                "camera": describe_camera(one.found.camera),
                "covariance": one.found.covariance.tolist(),
            }
            for name, one in pictures.found.items()
        },
        "minimum_detectable": {
            k: one if math.isfinite(one) else None for k, one in noticed.items()
        },
        "principal_point_px": center and dict(zip(("offset", "sd"), center, strict=True)),
        "error_sizes_px": {
            name: float(getattr(found.sizes, name)) for name in ("surface", "mask", "camera")
        },
        **describe_run(inputs, settings, warnings, seconds),
        "unseen": list(unseen),
    }
    if folder is not None:
        _write_result(folder, inputs, found, pictures, overlay, summary)
    return SceneAudit(found, summary, tuple(warnings), folder)


@dataclass(frozen=True, eq=False)
class _Pictures:
    """What was found in an episode's pictures; nothing, of a scene of masks.

    Args:
        found: by camera.
        findings: cameras that are far from where their pictures show them, and clocks.
        names: by frame of the inputs, its camera and its name there.
    """

    found: Mapping[str, PictureRegistration] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    names: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def _find_cameras(
    inputs: RegistrationInputs,
    before: _Pictures | None = None,
    zeros: Sequence[str] = (),
    near: float = 0.08,
) -> tuple[RegistrationInputs, _Pictures]:
    """Finds each camera of an episode in its pictures, and masks in all of these.

    Args:
        before: a look that found the cameras about.
        zeros: joints whose zeros are not trusted.
        near: a camera is compared as it is given that shows the body nearer than this to where it
            is seen [root of the silhouettes' area].

    Raises:
        SceneError: no camera has a pose.
        RegistrationError: no pose of a camera explains its pictures.
    """
    path = inputs.scene.path
    if not inputs.given_cameras:
        raise SceneError(
            f"{path}: no camera has an X_WC that could be audited; give a camera file "
            "(--cameras FILE), or find out where they stand: drake-pose register"
        )
    alone, body = (
        len(inputs.given_cameras) == 1,
        RegistrationBody(inputs.tree, inputs.visible_nodes),
    )
    warnings = say_left_out(inputs.recordings, [one.name for one in inputs.given_cameras])
    held, findings, pictures = list[Camera](), list[Finding](), dict[str, PictureRegistration]()
    names, frames = dict[str, tuple[str, str]](), list[MultiViewFrame]()
    for given in inputs.given_cameras:
        name, recording = given.name, inputs.recordings[given.name]
        if before is None:
            one = register_pictures(body, given, recording, offset_joints=zeros)
        else:
            one = fit_pictures(
                body, PictureStart.of(before.found[name]), recording, offset_joints=zeros
            )
        pictures[name] = one
        values = np.array([frame.values + one.joint_offsets for frame in one.frames])
        off = compare_camera(body, given, one.found, values, alone)
        is_near = off.pixels < near * one.fit.fit.views[0].size
        held.append(given if is_near else one.found.camera)
        findings += [] if is_near or off.p_value > DIAGNOSIS.significance else [off]
        findings += compare_clock(body, one, recording)
        seen, _, lost = evaluate_pictures(body, one, one.found)
        for frame in seen:
            known = frame.name if alone else f"{name}-{frame.name}"
            names[known] = name, frame.name
            frames.append(MultiViewFrame(known, frame.values, {name: frame.mask}))
        if lost:
            warnings.append(lost_frames_warning(name, lost, recording.names))
    far = {one.name for one in findings if one.kind == "camera"}
    looked = replace(
        inputs,
        scene=replace(inputs.scene, frames=tuple(names)),
        warnings=(*inputs.warnings, *warnings),
        known_cameras=tuple(held),
        given_cameras=tuple(one for one in inputs.given_cameras if one.name in far),
        audited_frames=tuple(names),
        frames=tuple(frames),
    )
    return looked, _Pictures(pictures, tuple(findings), names)


def _doubts(inputs: RegistrationInputs, found: Diagnosis, unseen: Sequence[str]) -> list[str]:
    """What a user should know of the frames, and of the file of cameras."""
    warnings = list[str]()
    if found.center is not None:
        (x, y), (x_sd, y_sd) = found.center
        advice = (
            "does the file have a CameraInfo's numbers? Write pixel_centers: drake beside them"
            if x < 0.0
            else "does it say pixel_centers: drake of numbers that count pixel centres at integers?"
        )
        warnings.append(
            f"{inputs.camera_file}: the principal points are off by ({x:.2f}, {y:.2f}) +- "
            f"({x_sd:.2f}, {y_sd:.2f}) pixels, half a pixel: {advice}"
        )
    if unseen:
        named = frame_ranges(unseen, inputs.scene.frames)
        warnings.append(f"frame {named}: the masks show nothing: there is nothing to compare")
    count, agreeing = len(found.frames), len(found.frames) - len(found.outliers)
    wrong_log = any(one.kind in ("sign", "log") for one in found.common)
    if 2 * agreeing < count and not wrong_log:
        warnings.append(
            f"{agreeing} of {count} frames agree with each other: which of them are "
            "right is told by their being near to what is given, not by their number"
        )
    return warnings


def _write_result(
    path: Path,
    inputs: RegistrationInputs,
    found: Diagnosis,
    pictures: _Pictures,
    overlay: bool,
    summary: Mapping[str, Any],
) -> None:
    """Summary and page, and the robot at its encoders' positions over what is at fault."""
    named, shown = found.outliers if overlay else (), {}
    for frame in named if pictures.names else ():
        camera_name, name = pictures.names[frame]
        shown[frame] = inputs.recordings[camera_name].picture(name)
    for camera in inputs.known_cameras if named else ():
        name, titled = camera.name, []
        for one in map(inputs.read, named):
            if name in one.masks:
                fits = percent(summary["frames"][one.name]["fits"][name])
                title = f"{name}  frame {one.name}  CONTRADICTS the others  {fits} fits"
                titled.append((PosedFrame(one.name, one.values, one.masks[name]), title))
        write_overlays(path, inputs.tree, camera, titled, inputs.visible_nodes, shown)
    for given in inputs.given_cameras if overlay else ():
        own = pictures.found[given.name]
        write_comparisons(path, inputs, own.frames, given, own.found, own.pictures)
    write_summary(path, summary)
    write_audit_page(path, inputs, found, summary, overlay)


def _describe_contradictions(found: Diagnosis) -> list[dict[str, Any]]:
    """What contradicts the rest, worst first: joints, cameras and the base, then frames."""
    told = [(one, one.kind, one.name, describe_common_finding(one)) for one in found.common]
    told += [
        (
            one.finding,
            "frame",
            one.frame,
            f"frame '{one.frame}': {describe_frame_finding(one, one.finding)}",
        )
        for one in sorted(found.frames, key=lambda one: -one.pixels)
        if one.finding is not None and one.finding not in found.common
    ]
    described = []
    for one, what, name, text in told:
        unit, factor = shift_unit(one.kind)
        described.append(
            {
                "what": what,
                "name": name,
                "text": text,
                "cause": one.kind,
                "cause_name": one.name,
                "angle_deg": float(np.degrees(one.angle)),
                "angle_sd_deg": float(np.degrees(one.angle_sd)),
                f"shift_{unit}": factor * one.shift,
                f"shift_sd_{unit}": factor * one.shift_sd,
                "pixels": one.pixels,
                "p_value": one.p_value,
                "rivals": list(one.alternatives),
                "joints": dict(one.joints),
            }
        )
    return described
