"""A robot arm of boxes and damaged masks of it; a gripper; a crane that makes full turns."""

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.body import ArticulatedModel, PoseTree, TriangleMesh, load_model
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.search import PoseSet, View
from drake_pose.silhouette.outline import Outline, outline_from_mesh
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.scoring import draw_mask
from tests.body.models import joint, link, urdf, write
from tests.jobs import scenes

# For each link: name, joint's distance along the parent [m], axis and limits [deg], and the box's
# sides and length [m].
LINKS = (
    ("turret", 0.0, "0 0 1", (-150, 150), (0.16, 0.11), 0.2),
    ("shoulder", 0.2, "0 1 0", (-110, 110), (0.11, 0.1), 0.35),
    ("roll", 0.35, "0 0 1", (-150, 150), (0.09, 0.13), 0.1),
    ("elbow", 0.1, "0 1 0", (-120, 120), (0.08, 0.07), 0.3),
    ("hand", 0.3, "0 1 0", (-90, 90), (0.05, 0.1), 0.15),
)


def arm_urdf(links: Sequence[tuple] = LINKS) -> str:
    """Return the URDF of the arm, fixed to the world."""
    parts, parent = [], "world"
    for name, z, axis, (low, high), (width, depth), length in links:
        visual = (
            f'<visual><origin xyz="0.01 0 {length / 2}"/><geometry>'
            f'<box size="{width} {depth} {length}"/></geometry></visual>'
        )
        limits = f'lower="{np.radians(low)}" upper="{np.radians(high)}"'
        at = {"origin": f'xyz="0 0 {z}"', "axis": axis, "limits": limits}
        parts += [link(name, visual), joint(f"{name}_turn", "revolute", parent, name, **at)]
        parent = name
    return f'<robot name="arm"><link name="world"/>{"".join(parts)}</robot>'


def arm_tree(folder: Path) -> PoseTree:
    """Return the arm's pose tree; ``folder``: where its URDF is written."""
    path = folder / "arm.urdf"
    path.write_text(arm_urdf())
    return load_model(path, check=False).pose_tree()


def arm_cameras(width: int = 320, height: int = 240) -> tuple[PinholeCamera, ...]:
    """Return two cameras 2.2 m away, 70 degrees apart, that look at the arm's centre."""
    cameras = []
    for name, turn in (("left", -35.0), ("right", 35.0)):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        X_WC = np.eye(4)
        X_WC[:3, :3] = np.array([[-s, 0.0, -c], [c, 0.0, -s], [0.0, -1.0, 0.0]])
        X_WC[:3, 3] = [2.2 * c, 2.2 * s, 0.45]
        focal = 0.9 * width
        centre = (width / 2 - 0.5, height / 2 - 0.5)
        cameras.append(PinholeCamera(name, width, height, focal, focal, *centre, X_WC))
    return tuple(cameras)


def draw_view(
    tree: PoseTree,
    values: np.ndarray,
    camera: Camera,
    outlines: Sequence[Outline] | None = None,
    seen_by: Camera | None = None,
) -> View:
    """Return the silhouette at values (m,), drawn by ``seen_by`` if that is given."""
    outlines = outlines or [outline_from_mesh(node.mesh) for node in tree.nodes]
    X_WN = tree.node_poses(split(tree, values))
    real = seen_by or camera
    return View(camera, draw_mask(outlines, real.X_CW @ X_WN, real))


def is_held(answer: PoseSet, values: np.ndarray) -> bool:
    """Return whether the intervals of a single mode contain all values (m,) of a pose."""
    return any(
        all(joint.holds(float(v)) for joint, v in zip(mode.joints, values, strict=True))
        for mode in answer.modes
    )


def split(tree: PoseTree, values: np.ndarray) -> list[np.ndarray]:
    """Split values (m,) into those of each node."""
    counts = np.cumsum([len(node.value_names) for node in tree.nodes])[:-1]
    return np.split(np.asarray(values, dtype=np.float64), counts)


def draw_pose(tree: PoseTree, generator: np.random.Generator) -> np.ndarray:
    """Draw values (m,) uniformly within the limits."""
    bounds = [tree.value_bounds(i) for i in range(len(tree.nodes))]
    return generator.uniform(
        np.concatenate([low for low, _ in bounds]), np.concatenate([high for _, high in bounds])
    )


def damaged_views(
    tree: PoseTree, values: np.ndarray, seed: int, width: int = 640, height: int = 480
) -> list[View]:
    """Return damaged masks of an arm with scaled links, in cameras with pose errors.

    In all views the region around one joint is missing. In each view a disc is added at the edge,
    and the edge is ragged.
    """
    generator = np.random.default_rng(seed)
    outlines = []
    for node in tree.nodes:
        middle = node.mesh.vertices.mean(axis=0)
        scale = np.exp(generator.normal(0.0, 0.015))
        vertices = middle + scale * (node.mesh.vertices - middle)
        outlines.append(outline_from_mesh(TriangleMesh(vertices, node.mesh.triangles)))
    joints = tree.node_poses(split(tree, values))[:, :3, 3]
    lost, views = joints[[generator.integers(len(joints))]], []
    for camera in arm_cameras(width, height):
        turn = generator.normal(0.0, 1.0, 3) / camera.focal_x
        X_CC = np.eye(4)
        X_CC[:3, :3] = Rotation.from_rotvec(turn * [1.0, 1.0, 3.0]).as_matrix()
        moved = camera.with_pose(camera.X_WC @ X_CC)
        mask = draw_view(tree, values, camera, outlines, moved).mask.astype(np.uint8)
        size = math.sqrt(mask.sum())
        _draw_disc(mask, camera.project(lost)[0][0], 0.12 * size, 0)
        edge = np.argwhere(mask > cv2.erode(mask, np.ones((3, 3), np.uint8)))
        _draw_disc(mask, edge[generator.integers(len(edge)), ::-1], 0.06 * size, 1)
        views.append(View(camera, _ragged(mask, generator)))
    return views


def _draw_disc(mask: np.ndarray, uv: np.ndarray, radius: float, value: int) -> None:
    cv2.circle(mask, (round(uv[0]), round(uv[1])), round(radius), value, -1)


def _ragged(mask: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return the mask with its edge displaced by a smooth random field of 0.7 pixels."""
    inside, outside = (cv2.distanceTransform(m, cv2.DIST_L2, 5) for m in (mask, 1 - mask))
    field = cv2.GaussianBlur(generator.standard_normal(mask.shape), (0, 0), 3.0)
    return np.asarray(inside - outside + 0.7 / field.std() * field > 0.0)


def _box(middle: str, size: str) -> str:
    return f'<visual><origin xyz="{middle}"/><geometry><box size="{size}"/></geometry></visual>'


def gripper(folder: Path, *, follows: bool) -> ArticulatedModel:
    """Return the gripper; ``follows``: whether the right finger mimics the left one."""
    mast, hand = ({"axis": "1 0 0", "limits": f'lower="-{r}" upper="{r}"'} for r in (1.2, 1.5))
    finger = {"limits": 'lower="0" upper="0.08"', "origin": 'xyz="0 0 .06"'}
    mimic = '<mimic joint="left_joint"/>' if follows else ""
    text = urdf(
        link("mast", _box("0 0 .15", ".05 .05 .3")),
        link("hand", _box("0 0 .03", ".06 .24 .06")),
        link("left", _box("0 .01 .05", ".03 .02 .1")),
        link("right", _box("0 -.01 .05", ".03 .02 .1")),
        joint("mast_joint", "revolute", "world", "mast", origin="", **mast),
        joint("hand_joint", "revolute", "mast", "hand", origin='xyz="0 0 .3"', **hand),
        joint("left_joint", "prismatic", "hand", "left", axis="0 1 0", **finger),
        joint("right_joint", "prismatic", "hand", "right", axis="0 -1 0", more=mimic, **finger),
    )
    return load_model(write(folder, text, f"gripper_{follows}.urdf"), check=False)


def crane(folder: Path, luff: str = 'lower="-6.2831853" upper="6.2831853"') -> ArticulatedModel:
    """Return a boom with a continuous joint, and a jib with limits two turns apart, as in a UR5."""
    path = folder / "turning.urdf"
    path.write_text(
        '<robot name="crane"><link name="world"/>'
        + scenes.LINK.format(name="boom", z=0.25, size="0.1 0.16 0.5")
        + scenes.LINK.format(name="jib", z=0.2, size="0.1 0.08 0.4")
        + '<joint name="swing" type="continuous"><parent link="world"/><child link="boom"/>'
        '<origin xyz="0 0 0.3"/><axis xyz="1 0 0"/></joint>'
        '<joint name="luff" type="revolute"><parent link="boom"/><child link="jib"/>'
        '<origin xyz="0 0 0.5"/><axis xyz="1 0 0"/>'
        f'<limit {luff} effort="1" velocity="1"/></joint></robot>'
    )
    return load_model(path, check=False)


def views_of(model: ArticulatedModel, q: Sequence[float]) -> list[View]:
    """Return the view of Drake's renderer from the front at positions q [rad]."""
    front = scenes.camera("front")
    return [View(front, LabelRenderer(model, front).mask(np.asarray(q)))]
