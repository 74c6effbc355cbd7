"""A scene, its cameras and joint positions in; which of them contradict the rest, out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.files import load_cameras
from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError, SceneError
from drake_pose.jobs.estimate.inputs import make_tree, select_cameras, select_seen_frames
from drake_pose.jobs.estimate.scene_checks import check_scene, frame_ranges, texts_of
from drake_pose.jobs.registration.audit_result import summarize, write_result
from drake_pose.jobs.registration.known_positions import KnownPositions, read_known_positions
from drake_pose.jobs.registration.settings import AuditSettings
from drake_pose.registration.contradictions import Audit, audit_frames
from drake_pose.registration.per_frame_fit import PerFrameFit, SeenFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.results.folder import require_empty
from drake_pose.results.settings import EstimateSettings
from drake_pose.results.summary import mask_digests
from drake_pose.silhouette.pictures.scenes import Scene, load_scene

OnFrame = Callable[[int], None]
"""Called with the number of frames that are done."""

# So many frames tell how large silhouettes are, and where the body is.
_SAMPLE = 20


@dataclass(frozen=True)
class AuditInputs:
    """What is audited.

    Args:
        scene: the recorded scene.
        model: the robot.
        tree: its pose tree, as it stands in the world.
        cameras: the cameras.
        frames: the frames' names.
        positions: where all joints are in each frame.
        warnings: what the user should know of the input.
    """

    scene: Scene
    model: ArticulatedModel
    tree: PoseTree
    cameras: tuple[Camera, ...]
    frames: tuple[str, ...]
    positions: KnownPositions
    warnings: tuple[str, ...]

    def read(self, frame: str) -> SeenFrame:
        """A frame's positions, and its masks by camera, but for those that show nothing."""
        masks = {}
        for camera in self.cameras:
            if (camera.name, frame) in self.scene.masks:
                mask = self.scene.read(camera.name, frame, may_be_empty=True)
                if mask.any():
                    masks[camera.name] = mask
        return SeenFrame(frame, self.positions.of(frame, self.cameras[0].name), masks)


@dataclass(frozen=True, eq=False)
class SceneAudit:
    """What contradicts the rest in a scene.

    Args:
        audit: what was found.
        summary: what summary.json holds.
        warnings: what the user should know.
        folder: the result folder, if one was written.
    """

    audit: Audit
    summary: Mapping[str, Any]
    warnings: tuple[str, ...]
    folder: Path | None


def audit_scene(
    scene: Path | str,
    model: Path | str,
    joints: Path | str,
    out: Path | str | None = None,
    settings: AuditSettings | None = None,
    *,
    cameras: Path | str | None = None,
    overlay: bool = True,
    on_frame: OnFrame | None = None,
) -> SceneAudit:
    """Finds which frames, cameras or joints contradict the rest, in time linear in the frames.

    Args:
        scene: the scene's folder: cameras.yaml and masks/<camera>/<frame>.png.
        model: the robot's model file. It stands in the world as the file has it.
        joints: joint positions by frame, a CSV file with the column frame and one for each joint
            [rad or m].
        out: folder for the result, new or empty; None writes nothing.
        settings: which cameras and frames.
        cameras: a camera file in place of the scene's own.
        overlay: whether overlays of what contradicts are written.
        on_frame: hears of every frame that is done.

    Raises:
        DrakePoseError: names the file, camera, frame or joint at fault.
    """
    settings = settings or AuditSettings()
    folder = None if out is None else Path(out)
    if folder is not None:
        require_empty(folder)
    paths = Path(scene), Path(model), Path(joints)
    own = None if cameras is None else Path(cameras)
    inputs = _read_inputs(paths, own, settings)
    begin = time.perf_counter()
    found, unseen = _audit(inputs, on_frame)
    seconds = time.perf_counter() - begin
    warnings = list(inputs.warnings)
    if unseen:
        named = frame_ranges(unseen, inputs.scene.frames)
        warnings.append(f"frame {named}: the masks show nothing: there is nothing to compare")
    agreeing = len(found.frames) - len(found.contradicting)
    if 2 * agreeing < len(found.frames):
        warnings.append(
            f"{agreeing} of {len(found.frames)} frames agree with each other: which of them are "
            "right is told by their being near to what is given, not by their number"
        )
    summary = summarize(found, (*paths, own), settings, warnings, seconds)
    summary["unseen"] = unseen
    names = [camera.name for camera in inputs.cameras]
    for frame, record in summary["frames"].items():
        record["masks"] = mask_digests(inputs.scene, names, frame)
    if folder is not None:
        write_result(folder, inputs.model, inputs.tree, _overlaid(inputs, found, overlay), summary)
    return SceneAudit(found, summary, tuple(warnings), folder)


def _read_inputs(
    paths: tuple[Path, Path, Path], camera_file: Path | None, settings: AuditSettings
) -> AuditInputs:
    scene_path, model_path, joints_path = paths
    cameras = None if camera_file is None else load_cameras(camera_file)
    checked = check_scene(load_scene(scene_path, cameras))
    scene = checked.scene
    if scene.scale_unknown:
        raise SceneError(
            f"{scene_path}: has no cameras.yaml; an audit needs to know where the cameras are: "
            "drake-pose register finds that"
        )
    chosen = select_cameras(scene, settings.cameras)
    frames = select_seen_frames(scene, chosen, settings.frames)
    model = load_model(model_path, package_paths=settings.packages)
    tree = make_tree(model, EstimateSettings(hold=settings.hold), None)
    positions = read_known_positions(joints_path, TreeKinematics(tree))
    warnings = [*texts_of(*checked.warnings), *model.warnings, *positions.warnings]
    if positions.are_one_pose(positions.of(frame, chosen[0].name) for frame in frames):
        warnings.append(
            "all frames show the robot in one pose, to a degree: errors of a joint's zero and of a "
            "camera that are the same in all frames can hardly be told apart"
        )
    return AuditInputs(scene, model, tree, chosen, frames, positions, tuple(warnings))


def _audit(inputs: AuditInputs, on_frame: OnFrame | None) -> tuple[Audit, list[str]]:
    """What was found, and the frames of which no mask shows anything."""
    body = RegistrationBody(inputs.tree)
    picks = np.linspace(0, len(inputs.frames) - 1, min(len(inputs.frames), _SAMPLE)).round()
    sample = [inputs.read(inputs.frames[int(k)]) for k in picks]
    fit = PerFrameFit(body.kinematics, (body.few, body.all), inputs.cameras, sample)
    fitted, unseen = [], []
    for done, frame in enumerate(inputs.frames):
        seen = inputs.read(frame)
        if seen.masks:
            fitted.append(fit.fit(seen))
        else:
            unseen.append(frame)
        if on_frame is not None:
            on_frame(done + 1)
    if not fitted:
        raise MaskError(f"{inputs.scene.path}: no mask shows the body; it must be white in them")
    return audit_frames(fit, fitted), unseen


def _overlaid(
    inputs: AuditInputs, found: Audit, overlay: bool
) -> Sequence[tuple[Camera, SeenFrame]]:
    """The pictures that are drawn: those of the frames that contradict the others."""
    if not overlay:
        return []
    cameras = {camera.name: camera for camera in inputs.cameras}
    return [
        (cameras[name], frame)
        for frame in map(inputs.read, found.contradicting)
        for name in frame.masks
    ]
