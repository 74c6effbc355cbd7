"""A camera on an arm's hand that sees the arm's base, drawn by Drake's renderer."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import yaml

from drake_pose.body.model import load_model
from drake_pose.camera.files import dump_cameras
from drake_pose.camera.models import PinholeCamera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.masks import write_mask
from tests.jobs.registration.arm_scenes import ArmScene
from tests.search.arms import LINKS, arm_urdf

# A step and a post on a plate: it looks different from all sides.
BASE = """<link name="base">
  <visual><geometry><box size="0.26 0.16 0.04"/></geometry></visual>
  <visual><origin xyz="0.09 0.03 0.06"/><geometry><box size="0.08 0.1 0.1"/></geometry></visual>
  <visual><origin xyz="-0.1 -0.05 0.08"/><geometry><box size="0.03 0.03 0.14"/></geometry></visual>
</link>"""
WELD = """<joint name="weld" type="fixed"><parent link="world"/><child link="base"/>
  <origin xyz="0.05 0 -0.03" rpy="0 0 0.3"/></joint>"""
# No looks of its own: it is where the camera is screwed on.
FLANGE = """<link name="flange"/><joint name="screw" type="fixed"><parent link="hand"/>
  <child link="flange"/><origin xyz="0 0 0.05" rpy="0 0 0.5"/></joint>"""
X_LC = np.array(
    [[0.0, -0.98, 0.199, 0.05], [1.0, 0.0, 0.0, -0.02], [0.0, 0.199, 0.98, 0.08], [0, 0, 0, 1.0]]
)
# All of the base is within these.
CORNERS = np.array([[x, y, z] for x in (-0.12, 0.22) for y in (-0.15, 0.15) for z in (-0.05, 0.12)])
X_LC[:3, :3] = np.linalg.svd(X_LC[:3, :3])[0] @ np.linalg.svd(X_LC[:3, :3])[2]


def write_hand_camera(folder: Path, count: int = 6, seed: int = 3) -> ArmScene:
    """Poses of the arm at which the camera on its hand has its base in the picture."""
    scene = ArmScene(folder / "scene", folder / "arm.urdf", folder / "joints.csv", {})
    urdf = arm_urdf().replace('<link name="world"/>', f'<link name="world"/>{BASE}{WELD}')
    urdf = urdf.replace("</robot>", f"{FLANGE}</robot>")
    scene.model.write_text(urdf)
    (folder / "base.urdf").write_text(
        f'<robot name="base"><link name="world"/>{BASE}{WELD}</robot>'
    )
    plant = load_model(scene.model, check=False).plant
    base, context = load_model(folder / "base.urdf", check=False), plant.CreateDefaultContext()
    camera = PinholeCamera("wrist", 320, 240, 200.0, 200.0, 159.5, 119.5, X_LC)
    rng = np.random.default_rng(seed)
    masks = scene.folder / "masks" / "wrist"
    masks.mkdir(parents=True)
    rows: list[list[object]] = []
    while len(rows) < count:
        # The arm is bent over its base, at which the hand looks back.
        q = rng.uniform([-2.0, -0.4, -0.6, 1.2, 0.3], [2.0, 0.4, 0.6, 2.0, 1.5])
        plant.SetPositions(context, q)
        X_WL = plant.GetBodyByName("flange").EvalPoseInWorld(context).GetAsMatrix4()
        placed = camera.with_pose(X_WL @ X_LC)
        uv, _ = placed.project(CORNERS)
        if np.all((uv > 2.0) & (uv < [317.0, 237.0])) and np.ptp(uv, axis=0).max() > 60.0:
            write_mask(
                masks / f"{len(rows):04d}.png", LabelRenderer(base, placed).mask(np.zeros(0))
            )
            rows.append([len(rows), *q])
    content = yaml.safe_load(dump_cameras([camera]))
    del content["wrist"]["X_WC"]
    (scene.folder / "cameras.yaml").write_text(yaml.safe_dump(content))
    with scene.joints.open("w", newline="") as file:
        csv.writer(file).writerows([["frame", *(f"{one[0]}_turn" for one in LINKS)], *rows])
    return scene
