"""Robot arms before a camera that may stand anywhere, and damaged silhouettes of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.body.model import load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.jobs.estimate.inputs import make_tree
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.results.settings import EstimateSettings
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

Mask = NDArray[np.bool_]

_WIDTH, _HEIGHT, _FOCAL = 640, 480, 600.0
_DISTANCE = (1.0, 1.7)
_MIDDLE = np.array([0.0, 0.0, 0.35])
_MIDDLE_SD = 0.1
# A silhouette of fewer pixels is of an arm that is hardly in the picture: another pose is drawn.
_LEAST_PIXELS = 3000
# After so many poses of which too little is seen, another camera is drawn.
_TRIES = 30
_MOST_MORPHED = 2
_HOLES = 0.03
_HOLE_RADII = (3, 9)
_XARM = "cmeel.prefix/share/example-robot-data/robots/xarm_description/urdf/xarm7.urdf"
# Each: its axis, the box's sides and length [m].
_BOXES = (
    ("0 0 1", 0.16, 0.11, 0.2),
    ("0 1 0", 0.11, 0.1, 0.35),
    ("0 0 1", 0.09, 0.13, 0.1),
    ("0 1 0", 0.08, 0.07, 0.3),
    ("0 1 0", 0.05, 0.1, 0.15),
)


def arm_files(data: Path | None, folder: Path) -> dict[str, Path]:
    """Model files of arms, by name.

    Args:
        data: a folder of scenes; None: there is none.
        folder: where a file may be written.

    Returns:
        those that are there: two of the scenes' and the xArm7 of example-robot-data; else an arm of
        boxes.
    """
    places = []
    if data is not None:
        places.append(("LBR Med 7", data / "arm_two_views" / "med7" / "med7.urdf"))
        places.append(("Franka Panda", data / "franka_one_view" / "panda" / "panda.urdf"))
    with suppress(PackageNotFoundError):
        places.append(("xArm7", Path(str(distribution("example-robot-data").locate_file(_XARM)))))
    found = {name: path for name, path in places if path.is_file()}
    return found or {"boxes": write_box_arm(folder / "boxes.urdf")}


def write_box_arm(path: Path) -> Path:
    """Writes an arm of five boxes; returns its file."""
    parts, parent, height = ['<robot name="boxes"><link name="world"/>'], "world", 0.0
    for k, (axis, width, depth, length) in enumerate(_BOXES):
        parts.append(
            f'<link name="box{k}"><visual><origin xyz="0.01 0 {length / 2}"/><geometry>'
            f'<box size="{width} {depth} {length}"/></geometry></visual></link>'
            f'<joint name="joint{k}" type="revolute"><parent link="{parent}"/>'
            f'<child link="box{k}"/><origin xyz="0 0 {height}"/><axis xyz="{axis}"/>'
            '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
        )
        parent, height = f"box{k}", length
    path.write_text("".join(parts) + "</robot>")
    return path


def load_arm(path: Path) -> RegistrationBody:
    """An arm that stands in the world as its model file has it."""
    return RegistrationBody(make_tree(load_model(path, check=False), EstimateSettings(), None))


def draw_arm(
    body: RegistrationBody, count: int, rng: np.random.Generator
) -> tuple[PinholeCamera, list[PosedFrame]]:
    """An arm in random poses inside its limits, before a camera from any side, turned anyhow.

    Args:
        body: the arm.
        count: how many frames.
        rng: the source of chance.

    Returns:
        the camera with its true pose, and the frames with exact masks.
    """
    while True:
        camera = _random_camera(rng)
        renderer = LabelRenderer(body.tree.model, camera)
        frames: list[PosedFrame] = []
        for _ in range(count + _TRIES):
            values = random_values(body, rng)
            q, X_WB = body.tree.positions_from(body.kinematics.split(values))
            mask = renderer.mask(q, X_WB)
            if np.count_nonzero(mask) >= _LEAST_PIXELS:
                frames.append(PosedFrame(f"{len(frames):04d}", values, mask))
            if len(frames) == count:
                return camera, frames


def random_values(body: RegistrationBody, rng: np.random.Generator) -> NDArray[np.float64]:
    """Positions (m,) inside the joints' limits; those that have none turn all around."""
    lower, upper = body.kinematics.lower, body.kinematics.upper
    return rng.uniform(
        np.where(np.isfinite(lower), lower, -np.pi), np.where(np.isfinite(upper), upper, np.pi)
    )


def _random_camera(rng: np.random.Generator) -> PinholeCamera:
    away = rng.normal(size=3)
    away /= np.linalg.norm(away)
    right = np.cross(rng.normal(size=3), -away)
    right /= np.linalg.norm(right)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([right, np.cross(-away, right), -away])
    X_WC[:3, 3] = _MIDDLE + rng.normal(0.0, _MIDDLE_SD, 3) + rng.uniform(*_DISTANCE) * away
    centre = (_WIDTH / 2 - 0.5, _HEIGHT / 2 - 0.5)
    return PinholeCamera("camera", _WIDTH, _HEIGHT, _FOCAL, _FOCAL, *centre, X_WC)


def damage(frames: Sequence[PosedFrame], rng: np.random.Generator) -> list[PosedFrame]:
    """Each mask eroded or dilated by up to two pixels, with holes of 3 % of its area."""
    return [PosedFrame(frame.name, frame.values, _damage(frame.mask, rng)) for frame in frames]


def _damage(mask: Mask, rng: np.random.Generator) -> Mask:
    size = int(rng.integers(-_MOST_MORPHED, _MOST_MORPHED + 1))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(size) + 1,) * 2)
    drawn = (cv2.dilate if size > 0 else cv2.erode)(mask.astype(np.uint8), disc)
    rows, columns = np.nonzero(drawn)
    left = (1.0 - _HOLES) * len(rows)
    while np.count_nonzero(drawn) > left:
        k = int(rng.integers(len(rows)))
        cv2.circle(drawn, (int(columns[k]), int(rows[k])), int(rng.integers(*_HOLE_RADII)), 0, -1)
    return drawn.astype(np.bool_)
