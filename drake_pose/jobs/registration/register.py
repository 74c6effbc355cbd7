"""A scene and joint positions in, the cameras' poses out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body.model import OBJECT_POSITIONS
from drake_pose.camera.models import Camera
from drake_pose.files.folder import require_empty
from drake_pose.files.options import percent
from drake_pose.files.summary import BADLY_EXPLAINED
from drake_pose.jobs.registration.inputs import Inputs, read_inputs
from drake_pose.jobs.registration.misfit import (
    Search,
    check_focal_length,
    require_determined,
    require_explained,
)
from drake_pose.jobs.registration.refit import corrected_urdf, find_zeros, refit_poses
from drake_pose.jobs.registration.result import (
    describe_camera,
    describe_parameters,
    describe_run,
    write_result,
)
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.registration.joint_zeros import JointCalibration
from drake_pose.registration.object_search import ObjectSearch
from drake_pose.registration.posed_frames import PosedFrames
from drake_pose.registration.register import (
    CameraSearch,
    ObjectPose,
    RegisteredCamera,
    RegistrationBody,
    suggest_pose,
)
from drake_pose.registration.start_poses import E_total, areas
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE

OnCamera = Callable[[int], None]
"""Called with the number of cameras that are done."""


@dataclass(frozen=True, eq=False)
class SceneRegistration:
    """Where a scene's cameras stand.

    Args:
        cameras: all cameras of the scene whose pose is known now, in its order.
        registered: those that were found, with how well they fit, by name.
        summary: what summary.json holds.
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
        scene: the folder with cameras.yaml, in which X_WC may be missing, and masks.
        model: the robot's model file. It stands in the world as the file has it.
        joints: joint positions by frame (CSV) [rad or m]. None: they are estimated from the cameras
            whose X_WC is known, and fitted together with those that are found.
        out: folder for the result, new or empty; None writes nothing.
        on_camera: called after each camera.

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
    search = _Search(inputs, settings)
    warnings = [*inputs.warnings, *_check_held(inputs, search.body)]
    warnings += search.run(on_camera)
    inputs, registered = replace(inputs, tree=search.body.tree), search.registered
    start = time.perf_counter()
    urdf, parameters = None, dict[str, dict[str, Any]](zeros={}, lengths={})
    if inputs.positions.is_estimate:
        registered, inputs, body = refit_poses(inputs, search.body, registered)
        for found in registered.values():
            require_explained(CameraSearch(body), found, inputs.of(found.camera.name))
    # Cameras that see one object are found one after another, but it stands in one place.
    several = inputs.standing is not None and len(registered) > 1
    if settings.zeros or settings.lengths or settings.focal or several:
        registered, corrected, zeros = find_zeros(inputs, settings, search.body, registered)
        parameters = describe_parameters(zeros, search.body.kinematics)
        warnings += _say_zeros(zeros)
        urdf = corrected_urdf(inputs, zeros, folder)
        inputs = corrected
    more = (time.perf_counter() - start) / len(registered)
    described = search.describe(registered, more, parameters)
    cameras = {
        name: registered[name].camera if name in registered else camera
        for name, camera in inputs.scene.cameras.items()
        if name not in inputs.left_out
    }
    summary = _summarize(paths, settings, described, warnings)
    if folder is not None:
        write_result(folder, inputs, cameras, registered, summary, overlay, urdf)
    return SceneRegistration(cameras, registered, summary, tuple(warnings), folder)


def _summarize(
    paths: tuple[Path, Path, Path | None],
    settings: RegistrationSettings,
    cameras: Mapping[str, dict[str, Any]],
    warnings: Sequence[str],
) -> dict[str, Any]:
    """The content of summary.json: a single camera's part stands at the top as well."""
    scene, model, joints = paths
    files = {"model": model, "cameras": scene / CAMERA_FILE, "joints": joints}
    seconds = sum(one["seconds"] for one in cameras.values())
    return {
        **(next(iter(cameras.values())) if len(cameras) == 1 else {}),
        **describe_run(scene, files, settings, warnings, seconds),
        "cameras": dict(cameras),
    }


class _Search:
    """The search for each camera by itself.

    An object whose place is not known is found with the first camera, and then stands there.
    """

    def __init__(self, inputs: Inputs, settings: RegistrationSettings) -> None:
        self._inputs, self._settings = inputs, settings
        self.body = RegistrationBody(inputs.tree, inputs.seen, girths=inputs.positions.girths)
        self.registered = dict[str, RegisteredCamera]()
        self.seconds = dict[str, float]()
        self.suggestions = dict[str, dict[str, Any] | None]()

    def run(self, on_camera: OnCamera | None) -> list[str]:
        """Finds all cameras; returns warnings.

        Raises:
            RegistrationError: no pose of a camera explains its masks.
        """
        inputs, standing, seen = self._inputs, self._inputs.standing, None
        search: Search = CameraSearch(self.body) if standing is None else ObjectSearch(standing)
        measured, warnings = not inputs.positions.is_estimate, list[str]()
        for camera in inputs.searched:
            start, frames = time.perf_counter(), inputs.of(camera.name)
            found = search.register(camera, frames)
            if measured:
                require_explained(search, found, frames)
            if standing is not None:
                require_determined(found)
                if found.seen_object is not None:
                    seen, self.body = found.seen_object, standing.body(found.seen_object.X_WT)
                    search = CameraSearch(self.body)
                    warnings += _say_object(seen)
                found = replace(found, seen_object=seen)
            if measured:
                warnings += check_focal_length(self.body, found, frames)
            self.registered[camera.name] = found
            self.suggestions[camera.name] = self._suggestion(found)
            self.seconds[camera.name] = time.perf_counter() - start
            warnings += _warnings_of(found)
            if on_camera is not None:
                on_camera(len(self.registered))
        return warnings + say_common(self.registered.values())

    def describe(
        self, registered: Mapping[str, RegisteredCamera], more: float, parameters: Mapping[str, Any]
    ) -> dict[str, dict[str, Any]]:
        """The cameras' parts of the summary, each of which took so long more [s]."""
        return {
            name: dict(parameters)
            | describe_camera(
                one, self.seconds[name] + more, self.suggestions[name], self._settings.on
            )
            for name, one in registered.items()
        }

    def _suggestion(self, found: RegisteredCamera) -> dict[str, Any] | None:
        """Joint positions that would tell a camera's poses apart; None: one pose, not asked for."""
        if not self._settings.suggest or not len(found.alternatives):
            return None
        poses = [found.camera.X_WC, *found.alternatives]
        told = suggest_pose(self.body, found.camera, poses, self._settings.keep_out)
        if told is None:
            return None
        values = zip(self.body.kinematics.names, told[0].tolist(), strict=True)
        positions = {name: value for name, value in values if name not in OBJECT_POSITIONS}
        return {"positions": positions, "difference": told[1]}


def _say_zeros(found: JointCalibration) -> list[str]:
    """What a user should know of zeros and lengths."""
    asked = [(f"joint '{one.name}': its zero", one) for one in found.zeros]
    asked += [(f"link '{one.name}': its length", one) for one in found.lengths]
    texts = []
    for what, one in asked:
        if not one.determined:
            goes_with = f" it goes with {', '.join(one.gauge)};" if one.gauge else ""
            texts.append(
                f"{what} is not determined by these silhouettes and was left as it is;{goes_with} "
                "frames in which the robot stands otherwise, or a part of it that does not move "
                "with this one, would tell it"
            )
    return texts


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


def _check_held(inputs: Inputs, body: RegistrationBody) -> list[str]:
    """Says so where a camera whose X_WC is given does not see the robot where it stands."""
    texts = []
    for camera in inputs.held:
        frames = inputs.of(camera.name)
        if not frames:
            continue
        posed = PosedFrames(body.kinematics, body.all, camera, frames)
        left = float(np.median(E_total(areas(posed, camera.X_CW[None], np.inf)[0])))
        if left >= BADLY_EXPLAINED:
            texts.append(
                f"camera '{camera.name}' is held at its X_WC, but the robot is not seen there: "
                f"body and silhouettes differ by {percent(left)} of the silhouettes' area; is its "
                "world another than the robot's base? It is found anew with "
                f"--camera {camera.name}"
            )
    return texts
