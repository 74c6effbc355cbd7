"""Cameras registered in pictures of the robot or of a standing scene: summary and warnings."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import describe_camera
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError, RegistrationError, listed, weighted
from drake_pose.files.folder import OVERLAY, write_file
from drake_pose.files.overlay import EXCESS_RGB, encode_png
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.diagnosis import pose_finding
from drake_pose.jobs.registration.inputs import RegistrationInputs, on_link
from drake_pose.jobs.registration.result import AS_GIVEN, describe_parameters, describe_pose
from drake_pose.jobs.registration.words import describe_drift, describe_error, lost_frames_warning
from drake_pose.registration.camera_motion import PictureMotion, find_camera_motion
from drake_pose.registration.diagnosis import DIAGNOSIS
from drake_pose.registration.findings import Finding
from drake_pose.registration.picture_acceptance import PictureRegistration, PictureStart
from drake_pose.registration.picture_registration import fit_pictures, register_pictures
from drake_pose.registration.picture_search import rotation_between
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.recording import Recording, choose_pictures, posed_pictures
from drake_pose.registration.register import RegistrationBody, evenly_spaced
from drake_pose.registration.shared_fit import SHARED
from drake_pose.registration.standing_object import CalibrationTarget, find_target_frames
from drake_pose.registration.track_registration import (
    TrackRegistration,
    carrying_links,
    register_tracks,
)


def watch_cameras(inputs: RegistrationInputs) -> RegistrationInputs:
    """Return an episode's inputs with its cameras' motions, and warnings of drift and shake.

    A camera whose background moves with one link of the robot, and is not given on another, is
    added to `links`. A scene of masks is returned as it is.

    Raises RegistrationError: as ``carrying_links``.
    """
    motions, links, warnings = dict[str, PictureMotion](), {**inputs.links}, list[str]()
    refused = dict[str, RegistrationError]()
    for camera in inputs.searched_cameras if inputs.recordings else ():
        name, recording = camera.name, inputs.recordings[camera.name]
        if name in links:
            continue
        motion = find_camera_motion(recording.read, len(recording.names), camera)
        motions[name] = motion
        carrying = tuple[str, ...]()
        # Where more of a picture's corners is found again, the camera stands still.
        if motion.found_again < 0.5:
            body = RegistrationBody(inputs.tree, inputs.visible_nodes)
            with suppress(RegistrationError):
                carrying = carrying_links(body, camera, recording)
        if len(carrying) == 1:
            links |= {name: carrying[0]}
            warnings.append(
                f"camera '{name}' moves with the robot: its background moves as from link "
                f"'{carrying[0]}', on which it was registered (--on {carrying[0]} --camera {name} "
                "does so without a search)"
            )
            continue
        if carrying or motion.found_again < LOST:
            refused[name] = RegistrationError(_say_riding(inputs, name, carrying))
            continue
        for pixels, what, how in (
            (motion.drift, "drifts", "shifts slowly"),
            (motion.shake, "shakes", "shifts from picture to picture"),
        ):
            if pixels:
                degrees = math.degrees(turn_of(camera, pixels))
                warnings.append(
                    f"camera '{camera.name}' {what}: its background {how} by {pixels:.1f} pixels, "
                    f"a turn by {degrees:.2f} degrees or the like; the pose found is a mean; fix "
                    "the camera, or give fewer pictures (--frame)"
                )
    warnings = [*inputs.warnings, *warnings]
    return replace(inputs, motions=motions, links=links, riding=refused, warnings=tuple(warnings))


LOST = 0.05
"""Where a smaller fraction of a picture's corners is found in others, the camera is moved."""


def _say_riding(inputs: RegistrationInputs, name: str, carrying: Sequence[str]) -> str:
    """Return why a camera that moves with the robot is not registered.

    name: of the camera. carrying: names of the links that may carry it; (): any that moves may.
    """
    moving = [one.name for one in inputs.tree.nodes[1:] if one.parent >= 0]
    named = carrying or moving
    why = "too little is found again in its pictures to tell which"
    if carrying:
        why = "its pictures do not tell them apart"
    return (
        f"camera '{name}' moves with the robot: next to nothing of its background stays where it "
        f"is. It rides on link {' or '.join(named)}; {why}: name it (--on LINK --camera {name}). "
        "Nothing was written"
    )


def turn_of(camera: PinholeCamera, pixels: float) -> float:
    """Return the camera's turn [rad] that shifts the middle of its pictures by `pixels`."""
    return pixels / float(np.mean(camera.kernel_parameters()[1:3]))


def require_unmoved(camera: PinholeCamera, recording: Recording, motion: PictureMotion) -> None:
    """Refuse a camera that was nudged while it took pictures: no pose holds for all of them.

    Raises RegistrationError: names the pictures, and the frames of each part without a nudge.
    """
    names, nudges = recording.names, motion.nudges
    if not nudges:
        return
    texts = []
    for nudge in nudges:
        at = "" if recording.times is None else f"at {recording.times[nudge.after]:.2f} s, "
        degrees = math.degrees(float(np.linalg.norm(nudge.rotation)))
        texts.append(
            f"{at}between pictures {names[nudge.before]} and {names[nudge.after]}, which shifted "
            f"its background by {nudge.pixels:.1f} pixels, as a turn by {degrees:.2f} degrees does"
        )
    begins = [0, *(nudge.after for nudge in nudges)]
    ends = [*(nudge.before for nudge in nudges), len(names) - 1]
    parts = [f"--frame {names[a]}:{names[b]}" for a, b in zip(begins, ends, strict=True)]
    raise RegistrationError(
        f"camera '{camera.name}' moved {'; and '.join(texts)}: no pose holds for all pictures; "
        f"take each part by itself, with --camera {camera.name} and {', '.join(parts[:-1])} or "
        f"{parts[-1]}. Nothing was written"
    )


def register_recordings(
    body: RegistrationBody,
    inputs: RegistrationInputs,
    cameras: Sequence[PinholeCamera],
    refused: dict[str, RegistrationError],
    focal: Collection[str] = (),
    offset_joints: Sequence[str] = (),
    before: Mapping[str, PictureRegistration] | None = None,
    near: Mapping[str, Array] | None = None,
) -> Iterator[PictureRegistration]:
    """Register cameras of an episode, one after another.

    Args:
        body: the robot's surfaces.
        inputs: the episode, with the cameras' motions.
        cameras: those of the searched cameras that are registered.
        refused: output: by camera, the error if it was moved, or if no pose explains its pictures.
        focal: names of cameras whose focal length is fitted; an unknown focal length always is.
        offset_joints: names of joints whose offsets are fitted.
        before: earlier registrations by camera, from which fits start; None: poses are searched.
        near: by camera, X_WC (4, 4) as found in another episode. A fit starts at the pose; if it
            fails, the pose is searched. None: all poses are searched.
    """
    for camera in cameras:
        name, recording = camera.name, inputs.recordings[camera.name]
        prior, guessed = SHARED.focal_deviation if name in focal else 0.0, False
        if name in inputs.assumed_focal:
            prior, guessed = SHARED.guessed_focal_deviation, True
        try:
            require_unmoved(camera, recording, inputs.motions[name])
            if before is not None:
                start = PictureStart.of(before[name])
                result = fit_pictures(body, start, recording, prior, offset_joints)
            else:
                X_WC = (near or {}).get(name)
                begun = camera if X_WC is None else replace(camera, X_WC=X_WC)
                result = register_pictures(
                    body, begun, recording, prior, offset_joints, guessed, X_WC is not None
                )
        except RegistrationError as error:
            refused[name] = error
        else:
            yield result


def say_refused(why: RegistrationError) -> str:
    """Return the message of a camera's error, for a result in which other cameras are written."""
    return str(why).replace(" Nothing was written", "")


def describe_pictures(result: PictureRegistration | None, found: bool = False) -> dict[str, Any]:
    """Return a camera's part of summary.json on its masks and clock.

    Args:
        result: the registration from pictures; None: it was registered from masks.
        found: whether those masks were segmented from pictures; used with None only.
    """
    if result is None:
        masks = "found" if found else "given"
        return {"masks": masks, "time_offset_s": None, "time_offset_sd_s": None}
    offset, X_WC, runner_up = result.time_offset, result.found.camera.X_WC, None
    drifting = offset if offset is not None and offset.drift else None
    if result.runner_up is not None:
        X_CW, margin = result.runner_up
        other = np.linalg.inv(X_CW)
        runner_up = {
            "X_WC": other.tolist(),
            "distance_mm": 1e3 * float(np.linalg.norm(other[:3, 3] - X_WC[:3, 3])),
            "rotation_deg": math.degrees(rotation_between(X_CW, result.found.camera.X_CW)),
            "margin_sd": margin,
        }
    return {
        "masks": "found",
        **describe_lens_and_clock(result),
        "time_drift": drifting and drifting.drift,
        "time_drift_sd": drifting and drifting.drift_deviation,
        "time_offset_scores": [] if offset is None else offset.scores.round(4).tolist(),
        "explained": result.fit.explained,
        "p_value": result.evidence.p_value,
        "contour": result.fit.contour,
        "runner_up": runner_up,
    }


def describe_lens_and_clock(result: PictureRegistration | TrackRegistration) -> dict[str, Any]:
    """Return entries on the focal length [pixel] and the time offset [s]; None: not estimated."""
    offset, focal = result.time_offset, result.found.camera.focal_x
    determined = offset if offset is not None and offset.determined else None
    return {
        "time_offset_s": determined and determined.value,
        "time_offset_sd_s": determined and determined.deviation,
        "focal_px": focal,
        "focal_sd_px": result.focal_deviation * focal if result.focal_deviation else None,
    }


def picture_warnings(result: PictureRegistration | TrackRegistration, assumed: bool) -> list[str]:
    """Return warnings of an unknown focal length, a drifting clock and an unknown time offset.

    assumed: whether the focal length was not given.
    """
    name, focal, texts = result.found.camera.name, result.found.camera.focal_x, list[str]()
    if assumed:
        text = (
            f"camera '{name}': no focal length is given: it was estimated as "
            f"{focal:.0f} pixels (standard deviation {result.focal_deviation * focal:.0f}); give "
            "it in the camera file if it is known"
        )
        texts.append(weighted(text, "note"))
    clock = result.time_offset
    if clock is not None and clock.drift:
        texts.append(describe_drift(name, clock.drift, clock.drift_deviation))
    if clock is not None and not clock.determined:
        texts.append(
            f"camera '{name}': its pictures do not determine its time offset to the joint log, "
            "because the robot moves too little or too slowly; add a faster motion"
        )
    return texts


def describe_tracks(result: TrackRegistration, kinematics: TreeKinematics) -> dict[str, Any]:
    """Return a camera's part of summary.json on its points, clock, focal length and offsets."""
    return {
        "masks": "none",
        "mean_iou": None,
        "points": len(np.unique(result.seen.points)),
        "sightings": len(result.seen.uv),
        "sightings_that_fit": float(result.inliers.mean()),
        "explained": result.explained,
        "explained_by_chance": result.chance,
        **describe_lens_and_clock(result),
        **describe_parameters(result.offsets, (), kinematics),
    }


def track_warnings(result: TrackRegistration, assumed: bool) -> list[str]:
    """Return warnings of likely joint offsets, and of what was estimated or is not determined.

    assumed: whether the focal length was not given.
    """
    name, texts = result.found.camera.name, picture_warnings(result, assumed)
    if result.likely:
        texts.append(
            f"camera '{name}': offsets of {listed(result.likely)} explain the pictures much "
            "better: estimate them, too (--zeros all). The camera's pose is the one that fits with "
            "them; the joint positions were left as they are"
        )
    loose = [offset.name for offset in result.offsets if not offset.determined]
    if loose:
        texts.append(
            f"the offsets of {listed(loose)} are not determined by what camera '{name}' sees, and "
            "were not changed: they move the whole scene, or the camera, as another pose would"
        )
    return texts


def register_on_link(
    inputs: RegistrationInputs, settings: RegistrationSettings, camera: PinholeCamera
) -> TrackRegistration:
    """Register a camera on the link ``settings.on`` from things that stand still in its pictures.

    Raises RegistrationError: as ``register_tracks``.
    """
    body = RegistrationBody(inputs.tree, inputs.visible_nodes)
    base = inputs.tree.node_index((inputs.visible_nodes or ())[0])
    focal = settings.focal or camera.name in inputs.assumed_focal
    recording = inputs.recordings[camera.name]
    return register_tracks(
        body, settings.on or "", base, camera, recording, focal, inputs.offset_joints
    )


def describe_found(
    result: PictureRegistration | TrackRegistration, link: str | None = None
) -> dict[str, Any]:
    """Return the part of an audit's summary.json on a camera; link: that carries it, if any."""
    found, name = result.found, "X_WC" if link is None else "X_LC"
    if isinstance(result, TrackRegistration):
        how = {"link": link, **describe_lens_and_clock(result), "explained": result.explained}
    else:
        how = describe_pictures(result)
    return {
        **how,
        **describe_pose(name, found.camera.X_WC, found),
        "camera": describe_camera(found.camera, link),
        "covariance": found.covariance.tolist(),
    }


def by_link(
    inputs: RegistrationInputs, settings: RegistrationSettings
) -> list[tuple[RegistrationInputs, RegistrationSettings]]:
    """Return inputs and settings of the cameras that stand still, and of each that rides on a link.

    Cameras of `riding` are left out. With ``settings.on`` all are on that link.

    Raises DrakePoseError: as ``on_link``.
    """
    if settings.on is not None or not (inputs.links or inputs.riding):
        return [(inputs, settings)]
    moving = {*inputs.links, *inputs.riding}
    standing = [one.name for one in inputs.searched_cameras if one.name not in moving]
    groups = [(inputs.of_cameras(standing), settings)] if standing else []
    return groups + [on_link(inputs, name, settings) for name in inputs.links]


def find_in_pictures(
    target: CalibrationTarget, inputs: RegistrationInputs, camera: PinholeCamera, most: int = 24
) -> tuple[Sequence[PosedFrame], list[str]]:
    """Return frames of a camera with the target's silhouettes, and a warning of lost pictures.

    most: maximum number of pictures in which the target is sought.

    Raises CameraError: the focal length is unknown; RegistrationError: as ``find_target_frames``.
    """
    name, recording = camera.name, inputs.recordings[camera.name]
    if name in inputs.assumed_focal:
        raise CameraError(
            f"camera '{name}': its focal length is unknown, but pictures of a target determine a "
            "distance only with it; calibrate the camera"
        )
    rows, _ = choose_pictures(target.body(np.eye(4)), camera, recording, most)
    frames = find_target_frames(target, camera, posed_pictures(recording, rows, 0.0))
    found = {frame.name for frame in frames}
    lost = [recording.names[k] for k in rows if recording.names[k] not in found]
    return frames, [lost_frames_warning(name, lost, recording.names, "target")] if lost else []


def given_on_link(
    inputs: RegistrationInputs, camera: str, link: str | None
) -> PinholeCamera | None:
    """Return a camera, by name, as given on a link; None: no X_LC on this link is given."""
    is_given = inputs.links.get(camera) == link
    return next((k for k in inputs.given_on_links if is_given and k.name == camera), None)


def compare_on_link(result: TrackRegistration, given: PinholeCamera) -> Finding:
    """Return the difference of a given pose on a link from the registered one as a finding."""
    shifts = result.points_in(given) - result.points_in(result.found.camera)
    pixels = float(np.sqrt(np.nanmedian((shifts**2).sum(axis=1))))
    return pose_finding(given, result.found, pixels)


def describe_given(result: TrackRegistration, given: PinholeCamera) -> str:
    """Return in words how far a camera's given pose on its link is from the registered one."""
    off = compare_on_link(result, given)
    differs = "and found differ" if off.p_value <= DIAGNOSIS.significance else "is as found"
    return f"as given {differs}: {describe_error(off, 'is off')}, by {off.pixels:.1f} pixels"


def draw_tracks(
    folder: Path, result: TrackRegistration, given: PinholeCamera | None = None, prefix: str = ""
) -> None:
    """Draw inlier points in blue and outliers in orange, in up to six pictures.

    folder: the result folder. given: the camera at its given pose on the link; None: none is given.
    With it, the points as seen from there (blue) and from the pose found (orange) are drawn, too.
    prefix: of the files' names, before the frame's.
    """
    found, frames, blue = result.found.camera, result.found.frames, (0, 114, 178)
    worst = sorted(range(len(frames)), key=lambda k: frames[k].inlier_ratio)
    for k in evenly_spaced(worst, 6):
        name, rows, uv = frames[k].frame, result.seen.frames == k, result.seen.uv
        fits, off = rows & result.inliers, rows & ~result.inliers
        drawn = {OVERLAY: ((uv[fits], blue), (uv[off], EXCESS_RGB))}
        if given is not None:
            was, now = (result.points_in(one)[fits] for one in (given, found))
            drawn[AS_GIVEN] = ((was, blue), (now, EXCESS_RGB))
        for kind, groups in drawn.items():
            picture = result.pictures[name].copy()
            for points, colour in groups:
                for u, v in points[np.abs(points).max(axis=1) < 1e4].round().astype(int).tolist():
                    cv2.circle(picture, (u, v), 4, colour, 2, cv2.LINE_AA)
            write_file(folder, f"{kind}/{found.name}/{prefix}{name}.png", encode_png(picture))
