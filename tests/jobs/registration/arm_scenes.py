"""Recorded scenes of a small arm at known joint positions, rendered by Drake."""

import csv
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_pose.body import load_model
from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.camera.models import Camera
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.inputs import RegistrationInputs, read_inputs
from tests.jobs.scenes import edit_camera, write_masks
from tests.registration.arm_pictures import errors
from tests.search.arms import LINKS, arm_cameras, arm_urdf

JOINTS = tuple(f"{name}_turn" for name, *_ in LINKS)


@dataclass(frozen=True)
class ArmScene:
    """A scene's folder, the robot's file, the table of joint positions, and the true cameras."""

    folder: Path
    model: Path
    joints: Path
    cameras: dict[str, Camera]

    def read(self) -> RegistrationInputs:
        """Return the inputs of a registration."""
        return read_inputs(self.folder, self.model, self.joints, None, RegistrationSettings())

    def copy(self, place: Path) -> "ArmScene":
        """Return a copy in another folder, which may be changed."""
        shutil.copytree(self.folder, place / "scene")
        joints = shutil.copy(self.joints, place / "joints.csv")
        return ArmScene(place / "scene", self.model, Path(joints), self.cameras)

    def register(self, out: Path, with_joints: bool = True) -> list[str]:
        """Return the command line of a registration."""
        joints = ["--joints", self.joints] if with_joints else []
        given = [self.folder, "--model", self.model, "--out", out, *joints]
        return ["register", *map(str, given)]

    def add_to(self, name: str, value: float) -> list[list[str]]:
        """Add a value to a joint's positions in all frames, and return the table."""
        header, *rows = self.rows()
        column = header.index(name)
        for row in rows:
            row[column] = str(float(row[column]) + value)
        self.write_rows([header, *rows])
        return [header, *rows]

    def rows(self) -> list[list[str]]:
        """Return the table with its header."""
        with self.joints.open(newline="") as file:
            return list(csv.reader(file))

    def write_rows(self, rows: Sequence[Sequence[object]]) -> None:
        """Write the table."""
        with self.joints.open("w", newline="") as file:
            csv.writer(file).writerows(rows)

    def edit_cameras(self, name: str, **fields: object) -> None:
        """Change fields of a camera in the scene's camera file."""
        edit_camera(self.folder / "cameras.yaml", name, **fields)


def write_arm_scene(folder: Path, count: int = 5, seed: int = 4) -> ArmScene:
    """Write random poses seen by two cameras; in the camera file only `right` has an X_WC."""
    scene = ArmScene(
        folder / "scene",
        folder / "arm.urdf",
        folder / "joints.csv",
        {camera.name: camera for camera in arm_cameras()},
    )
    scene.folder.mkdir()
    scene.model.write_text(arm_urdf())
    model, rng = load_model(scene.model), np.random.default_rng(seed)
    limits = np.radians([limit for _, _, _, limit, _, _ in LINKS])
    poses = rng.uniform(limits[:, 0], limits[:, 1], size=(count, len(limits)))
    save_cameras(scene.folder / "cameras.yaml", scene.cameras)
    write_masks(scene.folder, model, load_cameras(scene.folder / "cameras.yaml").values(), poses)
    scene.write_rows([["frame", *JOINTS], *([k, *q] for k, q in enumerate(poses))])
    scene.edit_cameras("left", X_WC=None)
    return scene


def pose_errors(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Return the errors of a pose (4, 4): translation [mm] and rotation [deg]."""
    metres, radians = errors(found, true)
    return 1e3 * metres, float(np.degrees(radians))
