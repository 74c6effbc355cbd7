"""What benchmarks share: arms before a camera anywhere, damaged silhouettes of them, a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from drake_pose.body.model import load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.searches import make_tree
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_WIDTH, _HEIGHT, _FOCAL = 640, 480, 600.0
_DISTANCE = (1.0, 1.7)
_MIDDLE, _MIDDLE_SD = np.array([0.0, 0.0, 0.35]), 0.1
# A silhouette of fewer pixels is of an arm that is hardly in the picture: another pose is drawn.
_LEAST_PIXELS = 3000
# After so many poses of which too little is seen, another camera is drawn.
_TRIES = 30
_MOST_MORPHED, _HOLES, _HOLE_RADII = 2, 0.03, (3, 9)
_ARMS = {
    "LBR Med 7": "arm_two_views/med7/med7.urdf",
    "Franka Panda": "franka_one_view/panda/panda.urdf",
}
_XARM = "cmeel.prefix/share/example-robot-data/robots/xarm_description/urdf/xarm7.urdf"
# Each: its axis, the box's sides and length [m].
_BOXES = (
    ("0 0 1", 0.16, 0.11, 0.2),
    ("0 1 0", 0.11, 0.1, 0.35),
    ("0 0 1", 0.09, 0.13, 0.1),
    ("0 1 0", 0.08, 0.07, 0.3),
    ("0 1 0", 0.05, 0.1, 0.15),
)


def print_table(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table whose first column is left-aligned, the others right."""
    table = Table(title=title)
    for k, heading in enumerate(headings):
        table.add_column(heading, justify="right" if k else "left")
    for row in rows:
        table.add_row(*row)
    Console(width=150).print(table)


def arm_files(data: Path | None, folder: Path) -> dict[str, Path]:
    """Model files of arms that are there: scenes', the xArm7's; else a box arm's, in a folder."""
    places = {} if data is None else {name: data / path for name, path in _ARMS.items()}
    with suppress(PackageNotFoundError):
        places["xArm7"] = Path(str(distribution("example-robot-data").locate_file(_XARM)))
    found = {name: path for name, path in places.items() if path.is_file()}
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
    """An arm in random poses, before a camera from any side, turned anyhow; masks are exact."""
    while True:
        camera = _random_camera(rng)
        frames: list[PosedFrame] = []
        for _ in range(count + _TRIES):
            values = random_values(body, rng)
            mask = segments(body, camera, values) >= 0
            if np.count_nonzero(mask) >= _LEAST_PIXELS:
                frames.append(PosedFrame(f"{len(frames):04d}", values, mask))
            if len(frames) == count:
                return camera, frames


def segments(body: RegistrationBody, camera: PinholeCamera, values: Array) -> NDArray[np.int16]:
    """(H, W) segments of the arm, below 0 where it is not."""
    q, X_WB = body.tree.positions_from(body.kinematics.split(values))
    return np.asarray(LabelRenderer(body.tree.model, camera).segments(q, X_WB))


def random_values(body: RegistrationBody, rng: np.random.Generator) -> Array:
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


def damaged(mask: Mask, rng: np.random.Generator) -> Mask:
    """A mask eroded or dilated by up to two pixels, with holes of 3 % of its area."""
    size = int(rng.integers(-_MOST_MORPHED, _MOST_MORPHED + 1))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(size) + 1,) * 2)
    drawn = (cv2.dilate if size > 0 else cv2.erode)(mask.astype(np.uint8), disc)
    rows, columns = np.nonzero(drawn)
    left = (1.0 - _HOLES) * len(rows)
    while np.count_nonzero(drawn) > left:
        k = int(rng.integers(len(rows)))
        cv2.circle(drawn, (int(columns[k]), int(rows[k])), int(rng.integers(*_HOLE_RADII)), 0, -1)
    return drawn.astype(np.bool_)
