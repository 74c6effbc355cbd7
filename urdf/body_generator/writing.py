"""Texts of links, joints and .obj files, for models whose colours are in the URDF."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from .model import DECIMALS, INERTIA_NAMES, TINY_MASS, mass_properties
from .shapes import Shell, vertex_normals

WORLD_REACH = 10.0  # limit of the root's position along each axis of the world [m]
# World axes: x forward, y left, z up. Link axes: x left, y up, z forward.
ROOT_TURN = (float(np.pi / 2.0), 0.0, float(np.pi / 2.0))


@dataclass(frozen=True)
class Joint:
    """A joint of one axis, or a fixed one.

    Attributes:
        name, parent, child: names of the joint and of its links.
        kind: "revolute", "prismatic" or "fixed".
        axis: (3,) in the child's frame.
        limits: lower and upper [deg or m].
        xyz: (3,) origin of the child's frame in the parent's [m].
        rpy: (3,) roll, pitch and yaw of the child's frame in the parent's [rad].
    """

    name: str
    parent: str
    child: str
    kind: str = "fixed"
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    limits: tuple[float, float] = (0.0, 0.0)
    xyz: ArrayLike = (0.0, 0.0, 0.0)
    rpy: ArrayLike = (0.0, 0.0, 0.0)

    def text(self) -> str:
        """Return the URDF element."""
        text = (
            f'  <joint name="{self.name}" type="{self.kind}">\n'
            f'    <parent link="{self.parent}"/>\n    <child link="{self.child}"/>\n'
            f'    <origin xyz="{numbers(self.xyz)}" rpy="{exactly(self.rpy)}"/>\n'
        )
        if self.kind != "fixed":
            turning = self.kind == "revolute"
            lower, upper = (float(v) for v in (np.radians(self.limits) if turning else self.limits))
            bounds = f'lower="{lower!r}" upper="{upper!r}"'
            text += (
                f'    <axis xyz="{numbers(self.axis)}"/>\n'
                f'    <limit {bounds} effort="{100 if turning else 1000}" velocity="20"/>\n'
            )
        return text + "  </joint>\n"


def numbers(values: ArrayLike) -> str:
    """Return numbers for the URDF, to 8 decimals and 6 digits, without minus zero."""
    return " ".join(f"{value + 0.0:.6g}" for value in np.round(np.asarray(values), 8))


def exactly(values: ArrayLike) -> str:
    """Return numbers for the URDF with all their digits."""
    return " ".join(repr(float(value) + 0.0) for value in np.asarray(values))


def root_joints(turning: Sequence[Joint]) -> str:
    """Return the joints that carry the root: three prismatic ones, a change of axes, then others.

    Args:
        turning: the root's revolute joints; the first one's parent is "root_axes_link".
    """
    text, parent = '  <link name="world"/>\n', "world"
    for index, axis in enumerate("xyz"):
        name = f"position_{axis}"
        direction = (float(index == 0), float(index == 1), float(index == 2))
        reach = (-WORLD_REACH, WORLD_REACH)
        joint = Joint(name, parent, f"{name}_link", "prismatic", direction, reach)
        text += joint.text() + bare_link(f"{name}_link")
        parent = f"{name}_link"
    text += Joint("root_axes", parent, "root_axes_link", rpy=ROOT_TURN).text()
    return text + bare_link("root_axes_link") + joint_chain(turning)


def joint_chain(joints: Sequence[Joint]) -> str:
    """Return successive joints with bare links between them, but none after the last joint."""
    text = ""
    for index, joint in enumerate(joints):
        text += joint.text()
        if index < len(joints) - 1:
            text += bare_link(joint.child)
    return text


def bare_link(name: str) -> str:
    """Return a link without geometry, of negligible mass."""
    moments = " ".join(f'{axis}="{1e-6 if axis[1] == axis[2] else 0}"' for axis in INERTIA_NAMES)
    return (
        f'  <link name="{name}">\n    <inertial>\n      <mass value="{TINY_MASS}"/>\n'
        f"      <inertia {moments}/>\n    </inertial>\n  </link>\n"
    )


def solid_link(name: str, visuals: Mapping[str, Sequence[Shell]], mass: float) -> str:
    """Return a link with the inertia of a uniform density.

    Args:
        name: of the link.
        visuals: shells by .obj file; the shells of a file share one material.
        mass: of the link [kg].
    """
    shells = [shell for part in visuals.values() for shell in part]
    centre, inertia = mass_properties(shells, mass)
    rows, columns = np.triu_indices(3)
    moments = " ".join(
        f'{label}="{numbers([inertia[i, j]])}"'
        for label, i, j in zip(INERTIA_NAMES, rows, columns, strict=True)
    )
    text = (
        f'  <link name="{name}">\n    <inertial>\n'
        f'      <origin xyz="{numbers(centre)}" rpy="0 0 0"/>\n'
        f'      <mass value="{mass:.4f}"/>\n      <inertia {moments}/>\n    </inertial>\n'
    )
    for file, part in visuals.items():
        text += (
            f'    <visual>\n      <geometry>\n        <mesh filename="meshes/{file}.obj"/>\n'
            f'      </geometry>\n      <material name="{part[0].materials[0]}"/>\n    </visual>\n'
        )
    return text + "  </link>\n"


def materials_text(colours: Mapping[str, tuple[float, float, float]]) -> str:
    """Return the URDF's materials; colours in 0..1."""
    return "".join(
        f'  <material name="{name}">\n    <color rgba="{numbers(colour)} 1"/>\n  </material>\n'
        for name, colour in colours.items()
    )


def obj_text(shells: Sequence[Shell]) -> str:
    """Return a Wavefront OBJ without materials, with one normal per vertex."""
    positions, normals, faces, start = [], [], [], 1
    for shell in shells:
        vertices = np.round(shell.vertices, DECIMALS) + 0.0
        positions += [
            f"v {x:.{DECIMALS}f} {y:.{DECIMALS}f} {z:.{DECIMALS}f}" for x, y, z in vertices
        ]
        unit = np.round(vertex_normals(vertices, shell.triangles), 3) + 0.0
        normals += [f"vn {x:.3f} {y:.3f} {z:.3f}" for x, y, z in unit]
        faces += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in shell.triangles + start]
        start += len(vertices)
    return "\n".join([*positions, *normals, *faces]) + "\n"


def write_meshes(folder: Path, visuals: Mapping[str, Sequence[Shell]]) -> None:
    """Write each file's shells into folder/meshes."""
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    for file, shells in visuals.items():
        (meshes / f"{file}.obj").write_text(obj_text(shells), encoding="ascii")
