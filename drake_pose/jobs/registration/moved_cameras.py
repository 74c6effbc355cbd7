"""Split recordings where their camera was moved, and register the parts as separate cameras.

The parts have a common clock, focal length and joint offsets.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count, pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.jobs.registration.diagnosis import compare_camera
from drake_pose.jobs.registration.inputs import RegistrationInputs
from drake_pose.registration.camera_motion import (
    CameraPart,
    PictureMotion,
    find_camera_motion,
)
from drake_pose.registration.findings import Finding
from drake_pose.registration.picture_acceptance import PictureRegistration, PictureStart
from drake_pose.registration.picture_registration import (
    fit_pictures,
    register_near,
    register_pictures,
)
from drake_pose.registration.recording import (
    NO_CLOCK,
    Recording,
    choose_pictures,
    mean_time,
)
from drake_pose.registration.register import RegistrationBody
from drake_pose.registration.shared_fit import SHARED


def split_moved_cameras(inputs: RegistrationInputs) -> RegistrationInputs:
    """Return the inputs of an episode with a camera for each part in which it was not moved.

    The first part keeps the camera's name; the others have the name and a number, such as `left_2`.
    Drift and shake only give warnings. Masks, and cameras on a link, are left as they are.
    """
    if inputs.target is not None or not inputs.recordings:
        return inputs
    searched, parts = list[PinholeCamera](), dict[str, CameraPart]()
    warnings, scene = list[str](), dict(inputs.scene.cameras)
    for camera in inputs.searched_cameras:
        recording = inputs.recordings[camera.name]
        motion = find_camera_motion(recording.read, len(recording.names), camera)
        warnings += motion_warnings(camera, recording, motion)
        split = _parts(camera.name, recording, motion, {*inputs.recordings, *parts})
        parts |= split
        scene |= {name: replace(camera, name=name) for name in split}
        # The longest part is registered first; the others start from it.
        lengths = {name: one.pictures.stop - one.pictures.start for name, one in split.items()}
        searched += [replace(camera, name=k) for k in sorted(split, key=lambda k: -lengths[k])]
    given = [
        replace(camera, name=name)
        for camera in inputs.given_cameras
        for name, part in parts.items()
        if part.of == camera.name
    ]
    assumed = {name for name, part in parts.items() if part.of in inputs.assumed_focal}
    recordings = {k: inputs.recordings[part.of].part(part.pictures) for k, part in parts.items()}
    return replace(
        inputs, scene=replace(inputs.scene, cameras=scene), searched_cameras=tuple(searched),
        given_cameras=tuple(given), assumed_focal=frozenset(assumed), recordings=recordings,
        parts=parts, warnings=(*inputs.warnings, *warnings),
    )  # fmt: skip


def _parts(
    name: str, recording: Recording, motion: PictureMotion, taken: Collection[str]
) -> dict[str, CameraPart]:
    """Return the parts of a camera's recording, in order, by the name of the camera in each.

    name: of the camera. taken: names of other cameras.
    """
    free = (f"{name}_{k}" for k in count(2) if f"{name}_{k}" not in taken)
    begins = [0, *(nudge.after for nudge in motion.nudges)]
    ends = [*(nudge.before + 1 for nudge in motion.nudges), len(recording.names)]
    R, parts = np.eye(3), dict[str, CameraPart]()
    for k, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        since, until = None, None
        if recording.times is not None:
            since, until = recording.times[[begin, end - 1]].tolist()
        if k:
            R = R @ Rotation.from_rotvec(-motion.nudges[k - 1].rotation).as_matrix()
        parts[next(free) if k else name] = CameraPart(
            name, slice(begin, end), R, since, until, not motion.nudges, motion.drift, motion.shake
        )
    return parts


def motion_warnings(
    camera: PinholeCamera, recording: Recording, motion: PictureMotion
) -> list[str]:
    """Return warnings of a camera's nudges, drift and shake; empty: it stands still."""

    def as_turn(pixels: float) -> str:
        """Return a shift of the background in words, with the camera's turn that gives it."""
        degrees = np.degrees(pixels / np.mean(camera.kernel_parameters()[1:3]))
        return f"{pixels:.1f} pixels, a turn by {degrees:.2f} degrees or the like"

    texts, who = [], f"camera '{camera.name}'"
    for nudge in motion.nudges:
        before, after = recording.names[nudge.before], recording.names[nudge.after]
        names = f"between pictures {before} and {after}"
        when = (
            names
            if recording.times is None
            else f"at {recording.times[nudge.after]:.2f} s, {names}"
        )
        degrees = np.degrees(np.linalg.norm(nudge.rotation))
        texts.append(
            f"{who} moved {when}: its background shifted by {nudge.pixels:.1f} pixels, as by a "
            f"turn of {degrees:.2f} degrees; the pictures before and after are used as two cameras"
        )
    if motion.drift:
        texts.append(
            f"{who} drifts: its background shifts slowly by {as_turn(motion.drift)}; the pose "
            "found is a mean; fix the camera, or give fewer pictures (--frame)"
        )
    if motion.shake:
        texts.append(
            f"{who} shakes: from picture to picture its background shifts by "
            f"{as_turn(motion.shake)}; the pose found is a mean; fix the camera"
        )
    return texts


def register_recordings(
    body: RegistrationBody,
    inputs: RegistrationInputs,
    cameras: Sequence[PinholeCamera],
    warnings: list[str],
    refused: dict[str, RegistrationError],
    focal: Collection[str] = (),
    offset_joints: Sequence[str] = (),
    before: Mapping[str, PictureRegistration] | None = None,
    near: Mapping[str, tuple[Array, float]] | None = None,
) -> Iterator[PictureRegistration]:
    """Register cameras of an episode, one after another.

    Args:
        body: the robot's surfaces.
        inputs: the episode, with the recordings' parts.
        cameras: those of the searched cameras that are registered.
        warnings: output: a warning is added for each part that no pose explains, if another part of
            the same recording is registered.
        refused: output: by recorded camera, the error if no pose explains any of its parts.
        focal: names of cameras whose focal length is fitted; an unknown focal length always is.
        offset_joints: names of joints whose offsets are fitted.
        before: earlier registrations by camera, from which fits start; None: poses are searched.
        near: by camera, X_WC (4, 4) as found in another episode, and the fraction explained by
            chance there. A fit starts at the pose; if it fails, the pose is searched. None: all
            poses are searched.

    Raises RegistrationError: no pose explains the pictures of any camera.
    """
    done, errors = dict[str, PictureRegistration](), dict[str, RegistrationError]()
    recorded = {name: part.of for name, part in inputs.parts.items()}
    for camera in cameras:
        name, recording = camera.name, inputs.recordings[camera.name]
        earlier_parts = [other for other in done if recorded[other] == recorded[name]]
        prior, guessed = SHARED.focal_deviation if name in focal else 0.0, False
        if name in inputs.assumed_focal:
            prior, guessed = SHARED.guessed_focal_deviation, True
        try:
            if earlier_parts:
                R = inputs.parts[earlier_parts[0]].rotation.T @ inputs.parts[name].rotation
                result = _register_part(body, name, recording, done[earlier_parts[0]], R)
            elif before is not None:
                start = PictureStart.of(before[name])
                result = fit_pictures(body, start, recording, prior, offset_joints)
            elif near is not None and name in near:
                X_WC, by_chance = near[name]
                begun = replace(camera, X_WC=X_WC)
                result = register_near(body, begun, recording, by_chance, prior, offset_joints)
            else:
                result = register_pictures(body, camera, recording, prior, offset_joints, guessed)
        except RegistrationError as error:
            errors[name] = error
            continue
        done[name] = result
        yield result
    for name, why in errors.items():
        if not done:
            raise why
        if recorded[name] in {recorded[other] for other in done}:
            warnings.append(f"this part of the recording is left out: {say_refused(why)}")
        else:
            refused.setdefault(recorded[name], why)


def say_refused(why: RegistrationError) -> str:
    """Return the message of a camera's error, for a result in which other cameras are written."""
    return str(why).replace(" Nothing was written", "")


def motion_findings(
    body: RegistrationBody, inputs: RegistrationInputs, found: Mapping[str, PictureRegistration]
) -> list[Finding]:
    """Return the drifts, shakes and nudges of an episode's cameras as findings of kind "moved".

    found: the registered cameras by name.
    """
    findings = list[Finding]()
    for name, part in inputs.parts.items():
        camera = inputs.scene.cameras[name]
        for pixels, what in ((part.drift, "drifts"), (part.shake, "shakes")):
            if pixels and part.of == name:
                angle = pixels / float(np.mean(camera.kernel_parameters()[1:3]))
                findings.append(
                    Finding("moved", name, angle, 0.0, 0.0, 0.0, pixels, 0.0, text=what)
                )
    for (name, part), (other, later) in pairwise(inputs.parts.items()):
        if part.of == later.of and name in found and other in found:
            before, here = found[name].found, found[other]
            after = replace(here.found, covariance=before.covariance + here.found.covariance)
            values = np.array([frame.values + here.joint_offsets for frame in here.frames])
            difference = compare_camera(body, before.camera, after, values, False)
            when = f"after picture {inputs.recordings[name].names[-1]}"
            when = when if later.since is None else f"at {later.since:.2f} s"
            findings.append(replace(difference, kind="moved", name=part.of, text=when))
    return findings


def _register_part(
    body: RegistrationBody,
    name: str,
    recording: Recording,
    first: PictureRegistration,
    R: np.ndarray,
) -> PictureRegistration:
    """Register a camera in a part of its recording, starting at its pose in another part.

    Clock, focal length and joint offsets are those of the other part.

    Args:
        body: the robot's surfaces.
        name, recording: of the camera in this part.
        first: the registration of the other part.
        R: (3, 3) approximate rotation of the camera from that part to this one, in its frame there.

    Raises RegistrationError: no pose near the start explains the pictures.
    """
    before, offsets = first.recording, first.joint_offsets
    clock = first.time_offset or NO_CLOCK
    since = mean_time(before, [before.names.index(frame.name) for frame in first.frames])
    X = first.found.camera.X_WC.copy()
    X[:3, :3] @= R
    camera = replace(first.found.camera, name=name, X_WC=X)
    rows = [row for some in choose_pictures(body, camera, recording) for row in some]
    with_drift = recording.with_drift(clock.drift, since)
    known = with_drift.at_offset(clock.value).with_offsets(offsets)
    start = PictureStart(camera, rows, NO_CLOCK, (), first.by_chance)
    result = fit_pictures(body, start, known)
    return replace(
        result, frames=tuple(replace(k, values=k.values - offsets) for k in result.frames),
        time_offset=first.time_offset and replace(clock, scores=clock.scores[:0]),
        focal_deviation=first.focal_deviation, recording=with_drift, joint_offsets=offsets,
    )  # fmt: skip
