"""A scene and joint positions in, the cameras' poses out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body.model import OBJECT_POSITIONS
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.jobs.estimate.fit_checks import BADLY_EXPLAINED
from drake_pose.jobs.estimate.scene_checks import frame_ranges
from drake_pose.jobs.registration.adjustment import adjust_bundle
from drake_pose.jobs.registration.inputs import (
    RegistrationInputs,
    read_inputs,
)
from drake_pose.jobs.registration.misfit import (
    Search,
    check_focal_length,
    require_determined,
    require_explained,
)
from drake_pose.jobs.registration.result import describe_camera, summarize, write_result
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.jobs.registration.zeros import (
    corrected_urdf,
    describe_lengths,
    describe_zeros,
    find_zeros,
    say_zeros,
)
from drake_pose.registration.joint_zeros import JointCalibration
from drake_pose.registration.object_search import ObjectSearch
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import (
    CameraSearch,
    ObjectPose,
    RegisteredCamera,
    RegistrationBody,
)
from drake_pose.registration.start_poses import E_total, areas
from drake_pose.registration.suggestions import suggest_pose
from drake_pose.results.folder import require_empty
from drake_pose.results.texts import percent

OnCamera = Callable[[int], None]
"""Called with the number of cameras that are done."""


@dataclass(frozen=True, eq=False)
class SceneRegistration:
    """Where a scene's cameras stand.

    Args:
        cameras: all cameras of the scene whose pose is known now, in its order.
        registered: those that were found, with how well they fit, by name.
        summary: what summary.json holds.
        warnings: what the user should know.
        folder: the result folder, if one was written.
    """

    cameras: Mapping[str, Camera]
    registered: Mapping[str, RegisteredCamera]
    summary: Mapping[str, Any]
    warnings: tuple[str, ...]
    folder: Path | None


def register_scene(
    scene: Path | str,
    model: Path | str,
    joints: Path | str | None = None,
    out: Path | str | None = None,
    settings: RegistrationSettings | None = None,
    *,
    overlay: bool = True,
    on_camera: OnCamera | None = None,
) -> SceneRegistration:
    """Finds where a scene's cameras stand; no guess is needed.

    Args:
        scene: the scene's folder: cameras.yaml, in which X_WC may be missing, and
            masks/<camera>/<frame>.png.
        model: the robot's model file. It stands in the world as the file has it.
        joints: joint positions by frame, a CSV file with the column frame and one for each joint
            [rad or m]. None: they are estimated from the cameras whose X_WC is known, and fitted
            together with those that are found.
        out: folder for the result, new or empty; None writes nothing.
        settings: which cameras and frames.
        overlay: whether overlays are written.
        on_camera: hears of every camera that is done.

    Raises:
        RegistrationError: no pose of a camera explains its masks. Nothing is written then.
        DrakePoseError: names the file, camera, frame or joint at fault.
    """
    settings = settings or RegistrationSettings()
    paths = Path(scene), Path(model), None if joints is None else Path(joints)
    folder = None if out is None else Path(out)
    if folder is not None:
        require_empty(folder)
    inputs = read_inputs(*paths, settings)
    body = RegistrationBody(inputs.tree, inputs.seen, girths=inputs.girths)
    warnings = [*inputs.warnings, *_check_held(inputs, body)]
    registered, described, body = _search(inputs, body, settings, warnings, on_camera)
    inputs = replace(inputs, tree=body.tree)
    urdf = None
    if inputs.is_estimate:
        registered, described, inputs, body = _adjust(inputs, body, registered, described)
    # Cameras that see one object are found one after another, but it stands in one place.
    several = inputs.standing is not None and len(registered) > 1
    if settings.zeros or settings.lengths or settings.focal or several:
        start = time.perf_counter()
        registered, corrected, zeros = find_zeros(inputs, settings, body, registered)
        seconds = (time.perf_counter() - start) / len(registered)
        described = _describe_again(registered, described, body, zeros, seconds)
        warnings += say_zeros(zeros)
        urdf = corrected_urdf(inputs, zeros, folder)
        inputs = corrected
    cameras = _placed_cameras(inputs, registered)
    summary = summarize(paths, settings, described, warnings)
    if folder is not None:
        write_result(folder, inputs, cameras, registered, summary, overlay, urdf)
    return SceneRegistration(cameras, registered, summary, tuple(warnings), folder)


def _search(
    inputs: RegistrationInputs,
    body: RegistrationBody,
    settings: RegistrationSettings,
    warnings: list[str],
    on_camera: OnCamera | None,
) -> tuple[dict[str, RegisteredCamera], dict[str, dict[str, Any]], RegistrationBody]:
    """Each camera by itself, its part of the summary, and the body; warnings are added to.

    An object whose place is not known is found with the first camera, and then stands there.

    Raises:
        RegistrationError: no pose of a camera explains its masks.
    """
    standing, seen = inputs.standing, None
    search: Search = CameraSearch(body) if standing is None else ObjectSearch(standing)
    registered, described = dict[str, RegisteredCamera](), dict[str, dict[str, Any]]()
    for camera in inputs.searched:
        start = time.perf_counter()
        found = search.register(camera, inputs.frames[camera.name])
        if not inputs.is_estimate:
            require_explained(search, found, inputs.frames[camera.name])
        if standing is not None:
            require_determined(found)
            if found.seen_object is not None:
                seen, body = found.seen_object, standing.body(found.seen_object.X_WT)
                search = CameraSearch(body)
                warnings += _say_object(seen)
            found = replace(found, seen_object=seen)
        if not inputs.is_estimate:
            warnings += check_focal_length(body, found, inputs.frames[camera.name])
        registered[camera.name] = found
        next_pose = _suggestion(body, found, settings)
        seconds = time.perf_counter() - start
        described[camera.name] = describe_camera(found, seconds, next_pose, settings.on)
        warnings += _warnings_of(found)
        if on_camera is not None:
            on_camera(len(registered))
    warnings += say_common(registered.values())
    return registered, described, body


def _say_object(seen: ObjectPose) -> list[str]:
    """What a user should know of an object whose place was found."""
    texts = []
    if len(seen.round_about):
        axes = "; ".join(", ".join(f"{x:.3f}" for x in axis) for axis in seen.round_about)
        texts.append(
            f"the target looks alike at every angle about an axis ({axes} in its frame), so how it "
            "is turned about it is not determined; where the camera is does not depend on it"
        )
    if len(seen.alternatives):
        texts.append(
            f"the target looks alike in {len(seen.alternatives)} other poses, see families of the "
            "target in summary.json; where the camera is does not depend on it"
        )
    return texts


def _adjust(
    inputs: RegistrationInputs,
    body: RegistrationBody,
    registered: Mapping[str, RegisteredCamera],
    described: Mapping[str, dict[str, Any]],
) -> tuple[
    dict[str, RegisteredCamera], dict[str, dict[str, Any]], RegistrationInputs, RegistrationBody
]:
    """The cameras fitted together with the positions that were estimated, and all that follows.

    Raises:
        RegistrationError: even so they do not explain their masks.
    """
    start = time.perf_counter()
    adjusted, inputs, body = adjust_bundle(inputs, body, registered)
    for found in adjusted.values():
        require_explained(CameraSearch(body), found, inputs.frames[found.camera.name])
    seconds = (time.perf_counter() - start) / len(adjusted)
    again = {
        name: describe_camera(found, described[name]["seconds"] + seconds)
        for name, found in adjusted.items()
    }
    return adjusted, again, inputs, body


def _suggestion(
    body: RegistrationBody, found: RegisteredCamera, settings: RegistrationSettings
) -> dict[str, Any] | None:
    """Joint positions that would tell a camera's poses apart; None: one pose, or not asked for."""
    if not settings.suggest or not len(found.alternatives):
        return None
    poses = [found.camera.X_WC, *found.alternatives]
    told = suggest_pose(body, found.camera, poses, settings.keep_out)
    if told is None:
        return None
    values = zip(body.kinematics.names, told.values.tolist(), strict=True)
    return {
        "positions": {name: value for name, value in values if name not in OBJECT_POSITIONS},
        "difference": told.difference,
    }


def _placed_cameras(
    inputs: RegistrationInputs, registered: Mapping[str, RegisteredCamera]
) -> dict[str, Camera]:
    """All cameras of the scene whose pose is known now."""
    return {
        name: registered[name].camera if name in registered else camera
        for name, camera in inputs.scene.cameras.items()
        if name not in inputs.left_out
    }


def _describe_again(
    registered: Mapping[str, RegisteredCamera],
    before: Mapping[str, dict[str, Any]],
    body: RegistrationBody,
    zeros: JointCalibration,
    seconds: float,
) -> dict[str, dict[str, Any]]:
    """The cameras' parts of the summary with zeros and lengths, which took so long more [s]."""
    told = {"zeros": describe_zeros(zeros, body.kinematics), "lengths": describe_lengths(zeros)}
    return {
        name: {
            **describe_camera(
                found,
                before[name]["seconds"] + seconds,
                before[name]["suggestion"],
                before[name].get("link"),
            ),
            **told,
        }
        for name, found in registered.items()
    }


def say_common(registered: Iterable[RegisteredCamera]) -> list[str]:
    """Whose fault it is where several cameras see a frame that contradicts the others."""
    agrees: dict[str, dict[str, bool]] = {}
    for found in registered:
        for one in found.frames:
            agrees.setdefault(one.frame, {})[found.camera.name] = one.agrees
    frames = list(agrees)
    positions, masks = [], dict[str, list[str]]()
    for frame, cameras in agrees.items():
        wrong = [name for name, right in cameras.items() if not right]
        if len(cameras) > 1 and len(wrong) == len(cameras):
            positions.append(frame)
        elif len(wrong) < len(cameras):
            for name in wrong:
                masks.setdefault(name, []).append(frame)
    texts = []
    if positions:
        texts.append(
            f"frames {frame_ranges(positions, frames)} contradict the others in all cameras that "
            "see them: their joint positions are not those of the pictures"
        )
    texts += [
        f"frames {frame_ranges(wrong, frames)} contradict the others in camera '{name}', but not "
        "in another one that sees them: their joint positions are right, their masks are not"
        for name, wrong in masks.items()
    ]
    return texts


def _warnings_of(found: RegisteredCamera) -> list[str]:
    """What a user should know of a camera that was found."""
    name, frames = found.camera.name, [frame.frame for frame in found.frames]
    wrong, texts = found.contradictions, []
    if wrong:
        right = len(frames) - len(wrong)
        listed = frame_ranges(wrong, frames)
        text = (
            f"camera '{name}': {len(wrong)} of {len(frames)} frames contradict the others and did "
            f"not count: {listed}; are their joint positions those of the pictures?"
        )
        if 2 * right < len(frames):
            supporting = frame_ranges([one for one in frames if one not in wrong], frames)
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


def _check_held(inputs: RegistrationInputs, body: RegistrationBody) -> list[str]:
    """Says so where a camera whose X_WC is given does not see the robot where it stands."""
    texts = []
    for camera in inputs.held:
        frames = inputs.frames[camera.name]
        if not frames:
            continue
        left = float(np.median(_misfits(body, camera, frames)))
        if left >= BADLY_EXPLAINED:
            texts.append(
                f"camera '{camera.name}' is held at its X_WC, but the robot is not seen there: "
                f"body and silhouettes differ by {percent(left)} of the silhouettes' area; is its "
                "world another than the robot's base? It is found anew with "
                f"--camera {camera.name}"
            )
    return texts


def _misfits(
    body: RegistrationBody, camera: PinholeCamera, frames: Sequence[PosedFrame]
) -> np.ndarray:
    """(frames,) E_total at the camera's own pose."""
    posed = PosedFrames(body.kinematics, body.all, camera, frames)
    return E_total(areas(posed, camera.X_CW[None], np.inf)[0])
