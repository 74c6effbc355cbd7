"""Cameras on an arm's hand that see its base or a calibration target, rendered by Drake."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.body import load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import PinholeCamera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.jobs.registration.arm_scenes import ArmScene
from tests.search.arms import LINKS, arm_urdf
from tests.written_files import write_mask

# A step and a post on a plate: it looks different from all sides.
BASE = """<link name="base">
  <visual><geometry><box size="0.26 0.16 0.04"/></geometry></visual>
  <visual><origin xyz="0.09 0.03 0.06"/><geometry><box size="0.08 0.1 0.1"/></geometry></visual>
  <visual><origin xyz="-0.1 -0.05 0.08"/><geometry><box size="0.03 0.03 0.14"/></geometry></visual>
</link>
<joint name="weld" type="fixed"><parent link="world"/><child link="base"/>
  <origin xyz="0.05 0 -0.03" rpy="0 0 0.3"/></joint>"""
# The camera's mount, without geometry.
FLANGE = """<link name="flange"/><joint name="screw" type="fixed"><parent link="hand"/>
  <child link="flange"/><origin xyz="0 0 0.05" rpy="0 0 0.5"/></joint>"""
X_LC = np.array(
    [[0.0, -0.98, 0.199, 0.05], [1.0, 0.0, 0.0, -0.02], [0.0, 0.199, 0.98, 0.08], [0, 0, 0, 1.0]]
)
X_LC[:3, :3] = np.linalg.svd(X_LC[:3, :3])[0] @ np.linalg.svd(X_LC[:3, :3])[2]
# Six joints; the last three axes intersect.
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


@dataclass(frozen=True)
class TargetScene:
    """A scene, the model file of the target, and the target's true pose."""

    arm: ArmScene
    target: Path
    X_WT: np.ndarray

    def register(self, out: Path) -> list[str]:
        """Return the command line of a registration of the camera on the flange."""
        return [*self.arm.register(out), "--on", "flange", "--target", str(self.target)]


def write_hand_scene(
    folder: Path,
    looks: str | None = BRACKET,
    links: Sequence[tuple] = LINKS,
    count: int = 8,
    seed: int = 0,
    width: int = 320,
    moving: int | None = None,
) -> TargetScene:
    """Write random poses of an arm with a camera on its hand that sees all of base or target.

    Args:
        looks: geometry of a target at a random pose; None: the camera sees the arm's base.
        moving: index of the only joint that moves; None: all move.
    """
    arm = ArmScene(folder / "scene", folder / "arm.urdf", folder / "joints.csv", {})
    base = BASE if looks is None else ""
    urdf = arm_urdf(links).replace("</robot>", f"{FLANGE}</robot>")
    arm.model.write_text(urdf.replace('<link name="world"/>', f'<link name="world"/>{base}'))
    target, rng, X_WT = folder / "target.urdf", np.random.default_rng(seed), np.eye(4)
    inside = f'<link name="world"/>{base}' if base else f'<link name="thing">{looks}</link>'
    target.write_text(f'<robot name="thing">{inside}</robot>')
    limits = np.radians([limit for _, _, _, limit, *_ in links]).T
    if looks is None:
        # The arm is bent over its base, and the hand looks back at it.
        limits = np.array([[-2.0, -0.4, -0.6, 1.2, 0.3], [2.0, 0.4, 0.6, 2.0, 1.5]])
    else:
        turn = rng.uniform([-0.3, -0.3, -3.0], [0.3, 0.3, 3.0])
        X_WT[:3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
        X_WT[:3, 3] = rng.uniform([0.45, -0.2, 0.0], [0.6, 0.2, 0.1])
    robot, thing = load_model(arm.model, check=False), load_model(target, check=False)
    seen = thing.link_meshes["thing" if base == "" else "base"].vertices
    if base:
        weld = thing.plant.GetBodyByName("base")
        X = weld.EvalPoseInWorld(thing.plant.CreateDefaultContext()).GetAsMatrix4()
        seen = seen @ X[:3, :3].T + X[:3, 3]
    size = np.array([width, 0.75 * width])
    middle = 0.5 * size - 0.5
    camera = PinholeCamera(
        "wrist", width, int(size[1]), 0.625 * width, 0.625 * width, *middle.tolist(), X_LC
    )
    context, q_seen = robot.plant.CreateDefaultContext(), thing.plant.GetDefaultPositions()
    masks, rows = arm.folder / "masks" / "wrist", list[list[object]]()
    masks.mkdir(parents=True)
    while len(rows) < count:
        q = rng.uniform(*limits)
        if rows and moving is not None:
            q = np.where(np.arange(len(q)) == moving, q, rows[0][1:])
        robot.plant.SetPositions(context, q)
        X_WL = robot.plant.GetBodyByName("flange").EvalPoseInWorld(context).GetAsMatrix4()
        placed = camera.with_pose(np.linalg.inv(X_WT) @ X_WL @ X_LC)
        uv, depth = placed.project(seen)
        near = 0.15 < depth.min() and depth.max() < 1.2
        if near and np.all((uv > 2.0) & (uv < size - 3.0)) and np.ptp(uv, axis=0).max() > 60.0:
            mask = LabelRenderer(thing, placed).mask(q_seen)
            write_mask(masks / f"{len(rows):04d}.png", mask)
            rows.append([len(rows), *q])
    save_cameras(arm.folder / "cameras.yaml", [camera])
    arm.edit_cameras("wrist", X_WC=None)
    arm.write_rows([["frame", *(f"{one[0]}_turn" for one in links)], *rows])
    return TargetScene(arm, target, X_WT)


def paint_pictures(folder: Path, seed: int = 0) -> None:
    """Replace a scene's masks by pictures of a light grey target in front of changing clutter.

    Each picture has noise with a standard deviation of 4 of 255.
    """
    rng = np.random.default_rng(seed)
    (folder / "images" / "wrist").mkdir(parents=True)
    for path in sorted((folder / "masks" / "wrist").glob("*.png")):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0
        patches = rng.uniform(20.0, 160.0, (12, 16, 3))
        clutter = cv2.resize(patches, mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
        soft = cv2.GaussianBlur(mask.astype(float), (0, 0), 0.7)[..., None]
        picture = soft * np.array([215.0, 205.0, 200.0]) + (1.0 - soft) * clutter
        noisy = picture + rng.normal(0.0, 4.0, picture.shape)
        cv2.imwrite(str(folder / "images" / "wrist" / path.name), np.clip(noisy, 0, 255))
    shutil.rmtree(folder / "masks")
