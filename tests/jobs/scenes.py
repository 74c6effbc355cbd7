"""A tiny body and recorded scenes of it, drawn by Drake's renderer."""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drake_pose.body import ArticulatedModel, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import Camera, PinholeCamera, look_at
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.cli import Result, run_to_end
from tests.written_files import write_mask

LINK = """
  <link name="{name}">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 {z}"/><geometry><box size="{size}"/></geometry></visual>
  </link>"""

JOINT = """
  <joint name="{name}" type="revolute">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 {z}"/>
    <axis xyz="1 0 0"/><limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>
  </joint>"""

URDF = (
    '<robot name="crane"><link name="world"/>'
    '<joint name="bolt" type="fixed"><parent link="world"/><child link="base"/></joint>'
    + LINK.format(name="base", z=0.0, size="0.3 0.5 0.2")
    + LINK.format(name="boom", z=0.25, size="0.1 0.12 0.5")
    + LINK.format(name="jib", z=0.2, size="0.1 0.08 0.4")
    + JOINT.format(name="lift", parent="base", child="boom", z=0.1, lower=-1.6, upper=1.6)
    + JOINT.format(name="luff", parent="boom", child="jib", z=0.5, lower=-2.2, upper=0.1)
    + "</robot>"
)

NAMES = ("lift", "luff")
ANGLES = ((20.0, -40.0), (-40.0, -80.0), (60.0, 0.0))
"""(frames, 2) joint angles [deg], multiples of 20."""


@dataclass(frozen=True)
class TinyScene:
    """A scene's folder, its model file, and the true positions by frame [rad]."""

    folder: Path
    model: Path
    truth: dict[str, np.ndarray]

    def estimate(self, out: Path) -> list[str]:
        """Return the words of an estimate command."""
        given = [self.folder, "--model", self.model, "--out", out]
        return ["estimate", *map(str, given)]


def camera(name: str, turn_deg: float = 0.0) -> PinholeCamera:
    """Return a camera 3 m from the body, rotated about the vertical axis."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    X_WC = look_at([3.0 * c, 3.0 * s, 0.3], [0.0, 0.0, 0.3])
    return PinholeCamera(name, 200, 160, 160.0, 160.0, 99.5, 79.5, X_WC)


def write_scene(
    folder: Path, angles: Sequence[Sequence[float]] = ANGLES, cameras: Sequence[str] = ("front",)
) -> TinyScene:
    """Write the model and a scene with the given joint angles (frames, 2) [deg]."""
    folder.mkdir(parents=True, exist_ok=True)
    model_path = folder.parent / "crane.urdf"
    model_path.write_text(URDF)
    model = load_model(model_path)
    turns = {"front": 0.0, "side": 50.0}
    rig = [camera(name, turns[name]) for name in cameras]
    save_cameras(folder / "cameras.yaml", rig)
    write_masks(folder, model, rig, np.radians(angles))
    return TinyScene(
        folder, model_path, {f"{k:04d}": np.radians(row) for k, row in enumerate(angles)}
    )


def write_masks(
    folder: Path, model: ArticulatedModel, cameras: Iterable[Camera], poses: Iterable[np.ndarray]
) -> None:
    """Write the masks of cameras of a model at positions (nq,), drawn by Drake."""
    poses = list(poses)
    for camera in cameras:
        renderer, masks = LabelRenderer(model, camera), folder / "masks" / camera.name
        masks.mkdir(parents=True)
        for k, q in enumerate(poses):
            write_mask(masks / f"{k:04d}.png", renderer.mask(q))


def write_truth(scene: TinyScene, path: Path | None = None) -> Path:
    """Write the true positions as joint_angles.csv, with frames as plain numbers."""
    path = path or scene.folder / "joint_angles.csv"
    return write_joints(path, NAMES, {str(int(frame)): q for frame, q in scene.truth.items()})


def write_joints(path: Path, names: Sequence[str], values: Mapping[str, Iterable[object]]) -> Path:
    """Write a table of joint positions by frame."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", *names])
        writer.writerows([frame, *q] for frame, q in values.items())
    return path


def run_estimate(
    scene: TinyScene, out: Path, *more: object, status: int = 0
) -> tuple[Result, dict[str, Any]]:
    """Run an estimate; return its output and its summary.json."""
    result = run_to_end(*scene.estimate(out), *more, status=status)
    return result, json.loads((out / "summary.json").read_text())


def edit_camera(path: Path, name: str, to: Path | None = None, **fields: object) -> Path:
    """Change fields of a camera in its file or a copy; None removes a field."""
    content = yaml.safe_load(path.read_text())
    changed = {**content[name], **fields}
    content[name] = {key: value for key, value in changed.items() if value is not None}
    to = to or path
    to.write_text(yaml.safe_dump(content, sort_keys=False))
    return to


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
