"""A camera on an arm's hand that sees another object in the world, drawn by Drake's renderer."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.body.model import load_model
from drake_pose.camera.files import dump_cameras
from drake_pose.camera.models import PinholeCamera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.masks import write_mask
from tests.jobs.registration.arm_scenes import ArmScene
from tests.jobs.registration.hand_camera import FLANGE, X_LC
from tests.search.arms import LINKS, arm_urdf

# Six joints, whose last three axes meet.
SIX = (
    ("turret", 0.0, "0 0 1", (-170, 170), (0.15, 0.15), 0.3),
    ("upper", 0.3, "0 1 0", (-100, 120), (0.1, 0.12), 0.4),
    ("fore", 0.4, "0 1 0", (-140, 140), (0.09, 0.08), 0.2),
    ("roll", 0.2, "0 0 1", (-180, 180), (0.07, 0.08), 0.18),
    ("bend", 0.18, "0 1 0", (-120, 120), (0.06, 0.05), 0.08),
    ("hand", 0.08, "0 0 1", (-180, 180), (0.05, 0.09), 0.08),
)
BOX = '<visual><geometry><box size="0.2 0.12 0.08"/></geometry></visual>'
BRACKET = """<visual><geometry><box size="0.2 0.12 0.03"/></geometry></visual>
  <visual><origin xyz="-0.07 0.02 0.07"/><geometry><box size="0.05 0.08 0.12"/></geometry></visual>
  <visual><origin xyz="0.06 -0.04 0.04"/>
    <geometry><cylinder radius="0.02" length="0.06"/></geometry></visual>"""
CAN = '<visual><geometry><cylinder radius="0.06" length="0.18"/></geometry></visual>'


@dataclass(frozen=True)
class TargetScene:
    """A scene, the target's model file, and where the target stands."""

    arm: ArmScene
    target: Path
    X_WT: np.ndarray


def write_target_scene(
    folder: Path,
    looks: str = BRACKET,
    links: Sequence[tuple] = LINKS,
    count: int = 8,
    seed: int = 0,
    size: tuple[int, int] = (640, 480),
    moving: int | None = None,
) -> TargetScene:
    """Random poses of an arm at which the camera on its hand has all of the target in the picture.

    Args:
        folder: where files are written.
        looks: of the target.
        links: of the arm.
        count: so many frames.
        seed: of all draws.
        size: width and height of the pictures.
        moving: the only joint that moves; None: all.
    """
    scene = ArmScene(folder / "scene", folder / "arm.urdf", folder / "joints.csv", {})
    scene.model.parent.mkdir(exist_ok=True)
    scene.model.write_text(arm_urdf(links).replace("</robot>", f"{FLANGE}</robot>"))
    target = folder / "target.urdf"
    target.write_text(f'<robot name="thing"><link name="thing">{looks}</link></robot>')
    arm, thing = load_model(scene.model, check=False), load_model(target, check=False)
    vertices = thing.link_meshes["thing"].vertices
    rng = np.random.default_rng(seed)
    X_WT = np.eye(4)
    turn = rng.uniform([-0.3, -0.3, -3.0], [0.3, 0.3, 3.0])
    X_WT[:3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
    X_WT[:3, 3] = rng.uniform([0.45, -0.2, 0.0], [0.6, 0.2, 0.1])
    width, height = size
    focal = 0.625 * width
    camera = PinholeCamera(
        "wrist", width, height, focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5, X_LC
    )
    masks = scene.folder / "masks" / "wrist"
    masks.mkdir(parents=True)
    limits = np.radians([limit for _, _, _, limit, *_ in links])
    context, rows, rest = arm.plant.CreateDefaultContext(), list[list[object]](), None
    q_thing = thing.plant.GetDefaultPositions()
    while len(rows) < count:
        q = rng.uniform(limits[:, 0], limits[:, 1])
        if rest is not None and moving is not None:
            q = np.where(np.arange(len(q)) == moving, q, rest)
        arm.plant.SetPositions(context, q)
        X_WL = arm.plant.GetBodyByName("flange").EvalPoseInWorld(context).GetAsMatrix4()
        placed = camera.with_pose(np.linalg.inv(X_WT) @ X_WL @ X_LC)
        uv, depth = placed.project(vertices)
        inside = np.all((uv > 2.0) & (uv < np.array(size) - 3.0))
        if depth.min() > 0.15 and depth.max() < 1.2 and inside:
            mask = LabelRenderer(thing, placed).mask(q_thing)
            write_mask(masks / f"{len(rows):04d}.png", mask)
            rows.append([len(rows), *q])
            rest = q
    content = yaml.safe_load(dump_cameras([camera]))
    del content["wrist"]["X_WC"]
    (scene.folder / "cameras.yaml").write_text(yaml.safe_dump(content))
    with scene.joints.open("w", newline="") as file:
        csv.writer(file).writerows([["frame", *(f"{one[0]}_turn" for one in links)], *rows])
    return TargetScene(scene, target, X_WT)


def damage_masks(folder: Path, seed: int, wrong: str | None = None) -> None:
    """Masks up to two pixels wider or narrower, with holes of 3 %; and one of another moment.

    Args:
        folder: of the masks, which are written anew.
        seed: of all draws.
        wrong: the file whose mask is mirrored.
    """
    rng = np.random.default_rng(seed)
    for path in sorted(folder.glob("*.png")):
        mask = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0).astype(np.uint8)
        width = int(rng.integers(-2, 3))
        ball = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(width) + 1,) * 2)
        mask = (cv2.dilate if width > 0 else cv2.erode)(mask, ball)
        area, at = np.count_nonzero(mask), np.argwhere(mask)
        while np.count_nonzero(mask) > 0.97 * area:
            v, u = at[rng.integers(len(at))].tolist()
            cv2.circle(mask, (u, v), int(rng.integers(2, 6)), 0, -1)
        if path.name == wrong:
            mask = np.ascontiguousarray(mask[::-1, ::-1])
        write_mask(path, mask > 0)
