"""Tiny bodies of boxes whose areas can be counted by hand, and a camera of 100 pixels a metre."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from drake_pose.body import ArticulatedModel, load_model
from drake_pose.camera.models import ParallelCamera

# The camera looks along -x: the picture's right is the world's y, its up the world's z.
_X_WC = np.array(
    [[0.0, 0.0, -1.0, 5.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def front_camera(side: int = 100, name: str = "front", shift: float = 0.0) -> ParallelCamera:
    """Return a camera with the world's origin at the image centre, plus a shift [pixel].

    A shift is needed where silhouettes of two computations are compared: edges through pixel
    centres, such as those of boxes at multiples of 30 degrees, would depend on rounding.
    """
    centre = side / 2 - 0.5 + shift
    return ParallelCamera(name, side, side, 100.0, centre, centre, _X_WC)


def near_camera(side: int = 480) -> ParallelCamera:
    """Return a front camera with 300 pixels per metre: segments are 36 to 72 pixels long."""
    return replace(front_camera(side, shift=0.2), pixels_per_metre=300.0)


def box_link(name: str, width: float, height: float, y: float = 0.0, z: float = 0.0) -> str:
    """Return a link with one box; sizes and centre in pixels of ``front_camera``, which are cm."""
    return f"""<link name="{name}"><visual><origin xyz="0 {y / 100} {z / 100}"/><geometry>
    <box size="0.02 {width / 100} {height / 100}"/></geometry></visual></link>"""


def joint(
    name: str, kind: str, parent: str, child: str, limits: tuple[float, float],
    axis: str = "1 0 0", y: float = 0.0, z: float = 0.0,
) -> str:  # fmt: skip
    """Return a joint at (y, z) in its parent [pixel, which is cm]."""
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="0 {y / 100} {z / 100}"/><axis xyz="{axis}"/>
    <limit lower="{limits[0]}" upper="{limits[1]}" effort="1" velocity="1"/></joint>"""


def load_body(folder: Path, *parts: str) -> ArticulatedModel:
    """Load the body of these links and joints, with a link named world."""
    path = folder / "body.urdf"
    path.write_text(f'<robot name="body"><link name="world"/>{"".join(parts)}</robot>')
    return load_model(path, check=False)


def swinging_chain(folder: Path, segments: int) -> ArticulatedModel:
    """Return a chain of unequal boxes that turn in the image plane about their upper ends."""
    parts = []
    parent, y, z = "world", 0.0, 15.0
    for i in range(segments):
        name = f"segment_{i}"
        length, width = 16 - 2 * i, 7 - i
        # The box is off its axis, so that different angles give different silhouettes.
        parts.append(box_link(name, width, length, y=1.0, z=-length / 2))
        parts.append(joint(f"turn_{i}", "revolute", parent, name, (-1.5, 1.8), y=y, z=z))
        parent, y, z = name, 0.0, -(length - 2)
    return load_body(folder, *parts)


def forked_body(folder: Path) -> ArticulatedModel:
    """Return a trunk with two arms of different lengths: three nodes, two of them leaves."""
    return load_body(
        folder,
        box_link("trunk", 10, 24, z=-12.0),
        joint("trunk_turn", "revolute", "world", "trunk", (-0.8, 0.8), z=12.0),
        box_link("left", 4, 15, y=1.0, z=-7.0),
        joint("left_turn", "revolute", "trunk", "left", (-0.2, 2.2), y=4.0, z=-2.0),
        box_link("right", 5, 12, y=-1.0, z=-5.0),
        joint("right_turn", "revolute", "trunk", "right", (-2.2, 0.2), y=-4.0, z=-2.0),
    )
