"""One person in a recorded scene with several cameras: masks in, poses and joint centres out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_pose.apps.motion_files import (
    JOINT_CENTRES,
    MOT,
    TRC,
    centres_as_csv,
    centres_as_trc,
    joint_centres,
    positions_as_mot,
)
from drake_pose.apps.replay import make_replay
from drake_pose.apps.result_folder import REPLAY, PoseRow, ResultFolder
from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.body.landmarks import load_landmarks
from drake_pose.errors import MaskError, SceneError
from drake_pose.multiview.person_capture import (
    PersonCapture,
    PersonCaptureSettings,
    capture_person,
)
from drake_pose.silhouette import Scene, draw_mask, load_scene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PERSON = "person_shape.urdf"

# A camera is suspicious where its pictures agree so much less than the others'.
_SUSPICIOUS = 0.15
_USUAL_RATE_HZ = 30.0


@dataclass(frozen=True, eq=False)
class SceneCapture:
    """A captured scene.

    Args:
        summary: the content of summary.json.
        warnings: what the user should know.
    """

    summary: Mapping[str, Any]
    warnings: tuple[str, ...]


def capture_scene(
    path: Path,
    out: Path,
    model_path: Path | None = None,
    replay: bool = True,
    on_frame: Callable[[int], None] | None = None,
) -> SceneCapture:
    """Captures a scene and writes the result's folder.

    Args:
        path: the scene's folder.
        out: the result's folder, empty or not there.
        model_path: a person with landmarks.yaml beside it; the bundled one with shape joints where
            not given.
        replay: whether replay.html is written.
        on_frame: called after each frame that is read to be followed, with 1.

    Raises:
        SceneError: fewer than two cameras, or cameras nobody knows.
        ModelError: the model is no person with landmarks.
        OutputError: the result cannot be written.
    """
    scene = load_scene(path)
    if len(scene.cameras) < 2 or scene.scale_unknown:
        raise SceneError(f"{path}: a person is captured by two calibrated cameras or more")
    model = load_model(model_path or bundled_model("person").with_name(PERSON), check=False)
    landmarks = load_landmarks(model.path)
    folder = ResultFolder(out, model.position_names, with_base=False)
    reader = _Reader(scene)
    begin = time.perf_counter()
    captured = capture_person(
        model.pose_tree(),
        scene.cameras,
        reader,
        len(scene.frames),
        PersonCaptureSettings(is_sequence=scene.sequence),
        None if on_frame is None else lambda _: on_frame(1),
    )
    seconds = (time.perf_counter() - begin) / len(scene.frames)
    agreement = _agreement(scene, reader, captured)
    errors = [one.error for one in agreement.frames]
    folder.open()
    for frame, q, error in zip(scene.frames, captured.q, errors, strict=True):
        folder.add(PoseRow(frame, q, None, error, seconds))
    folder.close()
    rate = scene.frame_rate_hz or _USUAL_RATE_HZ
    places = joint_centres(model, landmarks, captured.q)
    folder.write(JOINT_CENTRES, centres_as_csv(scene.frames, list(landmarks), places).encode())
    if scene.sequence:
        folder.write(TRC, centres_as_trc(list(landmarks), places, rate).encode())
        folder.write(MOT, positions_as_mot(model, captured.q, rate).encode())
    known = captured.q[np.isfinite(captured.q).all(axis=1)]
    if replay and len(known):
        cameras = list(scene.cameras.values())
        bases = [RigidTransform()] * len(known)
        page = make_replay(model, known, bases, cameras, 1.0 / rate if scene.sequence else 1.0)
        folder.write(REPLAY, page.encode())
    warnings = (*reader.dropped.values(), *agreement.warnings())
    summary = _summary(path, model, scene, captured, agreement, warnings, seconds)
    folder.write_summary(summary)
    return SceneCapture(summary, warnings)


class _Reader:
    """Reads masks; one that cannot be read is left out, and said once."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.dropped: dict[tuple[str, str], str] = {}

    def __call__(self, index: int) -> dict[str, Mask]:
        """The masks of a frame by camera."""
        frame = self._scene.frames[index]
        masks = {}
        for camera in self._scene.cameras_of(frame):
            if (camera, frame) in self.dropped:
                continue
            try:
                masks[camera] = self._scene.read(camera, frame)
            except MaskError as error:
                self.dropped[camera, frame] = f"frame {frame} does without '{camera}': {error}"
        return masks


@dataclass(frozen=True, eq=False)
class _FrameAgreement:
    """How a frame's silhouettes agree. error: E_total; ious: by camera."""

    error: float
    ious: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class _Agreement:
    """How all silhouettes agree."""

    frames: tuple[_FrameAgreement, ...]

    def of_cameras(self) -> dict[str, dict[str, float | int]]:
        """By camera: in how many frames it was used, and its mean intersection over union."""
        found: dict[str, list[float]] = {}
        for frame in self.frames:
            for camera, iou in frame.ious.items():
                found.setdefault(camera, []).append(iou)
        return {
            camera: {"frames": len(ious), "mean_iou": float(np.mean(ious))}
            for camera, ious in found.items()
        }

    def warnings(self) -> tuple[str, ...]:
        """Which cameras are suspicious."""
        means = {name: float(one["mean_iou"]) for name, one in self.of_cameras().items()}
        if len(means) < 3:
            return ()
        usual = float(np.median(list(means.values())))
        return tuple(
            f"camera '{name}' agrees badly (IoU {mean:.2f}, the median is {usual:.2f}): has it "
            "moved since it was calibrated, or are its masks poor?"
            for name, mean in means.items()
            if mean < usual - _SUSPICIOUS
        )


def _agreement(scene: Scene, reader: _Reader, captured: PersonCapture) -> _Agreement:
    """Compares all masks with the captured person, of the girth that was found."""
    tree, frames = captured.tree, []
    for index, q in enumerate(captured.q):
        if not np.isfinite(q).all():
            frames.append(_FrameAgreement(float("nan"), {}))
            continue
        X_WN = tree.node_poses(tree.values_from_positions(q))
        wrong, area = 0, 0
        ious: dict[str, float] = {}
        for name, mask in reader(index).items():
            camera = scene.cameras[name]
            body = draw_mask(captured.outlines, camera.X_CW @ X_WN, camera)
            either = int(np.count_nonzero(mask | body))
            both = int(np.count_nonzero(mask & body))
            wrong, area = wrong + either - both, area + int(np.count_nonzero(mask))
            ious[name] = both / either if either else 1.0
        frames.append(_FrameAgreement(wrong / area if area else float("nan"), ious))
    return _Agreement(tuple(frames))


def _summary(
    path: Path,
    model: ArticulatedModel,
    scene: Scene,
    captured: PersonCapture,
    agreement: _Agreement,
    warnings: tuple[str, ...],
    seconds: float,
) -> dict[str, Any]:
    """The content of summary.json."""
    ious = [iou for frame in agreement.frames for iou in frame.ious.values()]
    shape = captured.shape
    lengths = {}
    if shape is not None:
        names = [name for node in captured.tree.nodes for name in node.value_names]
        lengths = {
            name: float(value)
            for name, value, wanted in zip(names, shape.values, shape.is_shape, strict=True)
            if wanted
        }
    return {
        "scene": str(path),
        "model": model.path.name,
        "frame_count": len(scene.frames),
        "found_count": int(np.isfinite(captured.q).all(axis=1).sum()),
        "mean_iou": float(np.mean(ious)) if ious else None,
        "mean_E_total": float(np.nanmean([f.error for f in agreement.frames])) if ious else None,
        "seconds_a_frame": seconds,
        "cameras": agreement.of_cameras(),
        "lengths_m": lengths,
        "girths": {} if shape is None else shape.girths,
        "frames": {
            frame: {"share": float(share), "E_total": one.error, "cameras": list(one.ious)}
            for frame, share, one in zip(
                scene.frames, captured.shares, agreement.frames, strict=True
            )
        },
        "warnings": list(warnings),
    }
