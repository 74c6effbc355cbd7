"""Writes the URDF, the .obj files and the .mtl file of a bundled human body."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from . import extremities, head, limbs, torso
from .measures import Build, Measures, joint_positions
from .shapes import Shell, vertex_normals

Shape = Callable[[Measures, Build], list[Shell]]
Limits = tuple[tuple[str, float, float], ...]

# Link -> (parent, kind of segment, joint axes in order of rotation with limits [deg]):
# Kameda, Minoh and Ikeda, table 2.
SEGMENTS: dict[str, tuple[str, str, Limits]] = {
    "head": ("", "head", (("y", -90, 90), ("z", -30, 30), ("x", -30, 30))),
    "chest": ("head", "chest", (("y", -60, 60), ("z", -30, 30), ("x", -30, 30))),
    "right_upper_arm": ("chest", "upper_arm", (("x", -180, 20), ("z", -90, 20), ("y", -20, 90))),
    "right_forearm": ("right_upper_arm", "forearm", (("x", -160, 0),)),
    "right_hand": ("right_forearm", "hand", (("y", -90, 90), ("z", -45, 40), ("x", -10, 30))),
    "left_upper_arm": ("chest", "upper_arm", (("x", -180, 20), ("z", -20, 90), ("y", -90, 20))),
    "left_forearm": ("left_upper_arm", "forearm", (("x", -160, 0),)),
    "left_hand": ("left_forearm", "hand", (("y", -90, 90), ("z", -40, 45), ("x", -10, 30))),
    "waist": ("chest", "waist", (("y", -50, 50), ("z", -30, 30), ("x", -20, 20))),
    "right_thigh": ("waist", "thigh", (("y", -50, 20), ("z", -40, 0), ("x", -100, 10))),
    "right_shin": ("right_thigh", "shin", (("x", 0, 120),)),
    "right_foot": ("right_shin", "foot", (("x", -40, 40), ("y", -40, 0), ("z", -20, 50))),
    "left_thigh": ("waist", "thigh", (("y", -20, 50), ("z", 0, 40), ("x", -100, 10))),
    "left_shin": ("left_thigh", "shin", (("x", 0, 120),)),
    "left_foot": ("left_shin", "foot", (("x", -40, 40), ("y", 0, 40), ("z", -50, 20))),
}
SHAPES: dict[str, Shape] = {
    "head": head.head,
    "chest": torso.chest,
    "waist": torso.waist,
    "upper_arm": limbs.upper_arm,
    "forearm": limbs.forearm,
    "hand": extremities.hand,
    "thigh": limbs.thigh,
    "shin": limbs.shin,
    "foot": extremities.foot,
}
AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
INERTIA_NAMES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
WORLD_REACH = 10.0  # limit of the root's position along each axis of the world [m]
TINY_MASS = 0.001  # of the links between two axes of one joint [kg]
DECIMALS = 5  # of the coordinates in the .obj files: 0.01 mm


def link_shells(link: str, measures: Measures, build: Build) -> list[Shell]:
    """Return the closed shells of a link in its frame; right links mirror the left ones."""
    shells = SHAPES[SEGMENTS[link][1]](measures, build)
    return [shell.mirrored() for shell in shells] if link.startswith("right_") else shells


def link_origin(link: str, measures: Measures) -> np.ndarray:
    """Return where a link joins its parent in the standing body (3,) [m]."""
    origin = joint_positions(measures)[SEGMENTS[link][1]].copy()
    if link.startswith("right_"):
        origin[0] = -origin[0]
    return origin


def obj_text(shells: Sequence[Shell], build: Build) -> str:
    """Return a Wavefront OBJ with one normal per vertex and the faces grouped by material."""
    lines = [f"mtllib {build.name}.mtl"]
    normals: list[str] = []
    faces: dict[str, list[str]] = {}
    start = 1
    for shell in shells:
        vertices = np.round(shell.vertices, DECIMALS) + 0.0
        lines += [f"v {x:.{DECIMALS}f} {y:.{DECIMALS}f} {z:.{DECIMALS}f}" for x, y, z in vertices]
        unit = np.round(vertex_normals(vertices, shell.triangles), 3) + 0.0
        normals += [f"vn {x:.3f} {y:.3f} {z:.3f}" for x, y, z in unit]
        for material, (a, b, c) in zip(shell.materials, shell.triangles + start, strict=True):
            faces.setdefault(str(material), []).append(f"f {a}//{a} {b}//{b} {c}//{c}")
        start += len(vertices)
    lines += normals
    for material, records in faces.items():
        lines += [f"usemtl {material}", *records]
    return "\n".join(lines) + "\n"


def mtl_text(build: Build) -> str:
    """Return the material library."""
    blocks = [
        f"newmtl {name}\nKd {r:.3f} {g:.3f} {b:.3f}\n" for name, (r, g, b) in build.colours.items()
    ]
    return "\n".join(blocks)


def mass_properties(shells: Sequence[Shell], mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Return centre of mass (3,) [m] and inertia about it (3, 3) [kg m^2] at uniform density.

    Overlaps of the shells count twice, which is negligible here.
    """
    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for shell in shells:
        corners = shell.vertices[shell.triangles]
        share = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
        total = corners.sum(axis=1)
        volume += share.sum()
        first += (share[:, None] * total).sum(axis=0) / 4.0
        outer = np.einsum("nij,nik->njk", corners, corners) + np.einsum("nj,nk->njk", total, total)
        second += np.einsum("n,njk->jk", share, outer) / 20.0
    centre = first / volume
    moments = second / volume - np.outer(centre, centre)
    return centre, mass * (np.trace(moments) * np.eye(3) - moments)


def _numbers(values: ArrayLike) -> str:
    """Return numbers for the URDF, to 8 decimals and 6 digits, without minus zero."""
    return " ".join(f"{value + 0.0:.6g}" for value in np.round(np.asarray(values), 8))


def _joint(
    name: str, parent: str, child: str, axis: str, limits: tuple[float, float], xyz: str
) -> str:
    """Return a revolute joint; limits in degrees."""
    lower, upper = (float(limit) for limit in np.radians(limits))
    return (
        f'  <joint name="{name}" type="revolute">\n'
        f'    <parent link="{parent}"/>\n    <child link="{child}"/>\n'
        f'    <origin xyz="{xyz}" rpy="0 0 0"/>\n    <axis xyz="{AXES[axis]}"/>\n'
        f'    <limit lower="{lower!r}" upper="{upper!r}" effort="100" velocity="20"/>\n'
        "  </joint>\n"
    )


def _tiny_link(name: str) -> str:
    """Return a link without geometry, of negligible mass."""
    inertia = " ".join(f'{axis}="{1e-6 if axis[1] == axis[2] else 0}"' for axis in INERTIA_NAMES)
    return (
        f'  <link name="{name}">\n    <inertial>\n      <mass value="{TINY_MASS}"/>\n'
        f"      <inertia {inertia}/>\n    </inertial>\n  </link>\n"
    )


def _root_joints() -> str:
    """Return the three prismatic joints that carry the root, and the change of axes after them.

    World axes: x forward, y left, z up. Link axes: x left, y up, z forward.
    """
    text, parent = "", "world"
    for axis in "xyz":
        name = f"position_{axis}"
        text += (
            f'  <joint name="{name}" type="prismatic">\n'
            f'    <parent link="{parent}"/>\n    <child link="{name}_link"/>\n'
            f'    <axis xyz="{AXES[axis]}"/>\n'
            f'    <limit lower="{-WORLD_REACH}" upper="{WORLD_REACH}" effort="1000"'
            ' velocity="20"/>\n  </joint>\n'
        )
        text += _tiny_link(f"{name}_link")
        parent = f"{name}_link"
    quarter = repr(float(np.pi / 2.0))
    text += (
        '  <joint name="root_axes" type="fixed">\n'
        f'    <parent link="{parent}"/>\n    <child link="root_axes_link"/>\n'
        f'    <origin xyz="0 0 0" rpy="{quarter} 0 {quarter}"/>\n  </joint>\n'
    )
    return text + _tiny_link("root_axes_link")


def _link(link: str, shells: Sequence[Shell], build: Build) -> str:
    """Return a link with its mesh and inertia."""
    mass = build.mass * build.mass_fractions[SEGMENTS[link][1]]
    centre, inertia = mass_properties(shells, mass)
    rows, columns = np.triu_indices(3)
    moments = " ".join(
        f'{name}="{_numbers([inertia[i, j]])}"'
        for name, i, j in zip(INERTIA_NAMES, rows, columns, strict=True)
    )
    return (
        f'  <link name="{link}">\n    <inertial>\n'
        f'      <origin xyz="{_numbers(centre)}" rpy="0 0 0"/>\n'
        f'      <mass value="{mass:.4f}"/>\n      <inertia {moments}/>\n    </inertial>\n'
        f'    <visual>\n      <geometry>\n        <mesh filename="meshes/{link}.obj"/>\n'
        "      </geometry>\n    </visual>\n  </link>\n"
    )


def urdf_text(shells: dict[str, list[Shell]], measures: Measures, build: Build) -> str:
    """Return the URDF of the whole body."""
    text = f'<?xml version="1.0"?>\n<!-- Written by make_{build.name}.py: do not edit. -->\n'
    text += f'<robot name="{build.name}">\n  <link name="world"/>\n' + _root_joints()
    for link, (parent, _, axes) in SEGMENTS.items():
        offset = link_origin(link, measures) - (
            link_origin(parent, measures) if parent else link_origin(link, measures)
        )
        before = parent or "root_axes_link"
        for index, (axis, lower, upper) in enumerate(axes):
            last = index == len(axes) - 1
            child = link if last else f"{link}_{axis}_link"
            xyz = _numbers(np.round(offset, 6)) if index == 0 else "0 0 0"
            text += _joint(f"{link}_{axis}", before, child, axis, (lower, upper), xyz)
            text += _link(link, shells[link], build) if last else _tiny_link(child)
            before = child
    return text + "</robot>\n"


def write_body(folder: Path, measures: Measures, build: Build) -> None:
    """Write <name>.urdf and meshes/ into a folder, which is made if missing."""
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    shells = {link: link_shells(link, measures, build) for link in SEGMENTS}
    for link in SEGMENTS:
        (meshes / f"{link}.obj").write_text(obj_text(shells[link], build), encoding="ascii")
    (meshes / f"{build.name}.mtl").write_text(mtl_text(build), encoding="ascii")
    urdf = folder / f"{build.name}.urdf"
    urdf.write_text(urdf_text(shells, measures, build), encoding="ascii")
