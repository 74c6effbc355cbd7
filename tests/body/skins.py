"""A limb of two prisms with flat ends and a band of skin about the joint between them."""

from pathlib import Path

import numpy as np

from drake_pose.body import ArticulatedModel, load_model

HALF = 0.03
LENGTH = 0.2
REACH = 0.06


def tube_obj(rings: int = 7, half: float = 0.999 * HALF, reach: float = REACH) -> str:
    """A closed square tube along z about the origin, its rings evenly spread, as an OBJ."""
    heights = np.linspace(-reach, reach, rings)
    corners = half * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    points = [(x, y, z) for z in heights for x, y in corners]
    points += [(0.0, 0.0, -reach), (0.0, 0.0, reach)]
    faces = []
    for ring in range(rings - 1):
        for k in range(4):
            a, b = 4 * ring + k, 4 * ring + (k + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    low, high, last = 4 * rings, 4 * rings + 1, 4 * (rings - 1)
    for k in range(4):
        faces += [((k + 1) % 4, k, low), (last + k, last + (k + 1) % 4, high)]
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in points]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]) + "\n"


def prism(name: str, middle: float) -> str:
    """A link with one prism along z."""
    size = f"{2 * HALF} {2 * HALF} {LENGTH}"
    return (
        f'<link name="{name}"><visual><origin xyz="0 0 {middle}"/><geometry><box size="{size}"/>'
        "</geometry></visual></link>"
    )


def hinge(name: str, parent: str, child: str, axis: str, z: float, limit: float = 2.5) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 {z}"/><axis xyz="{axis}"/>'
        f'<limit lower="{-limit}" upper="{limit}" effort="1" velocity="1"/></joint>'
    )


# Downwards: upper, by an elbow of one axis to lower, by a wrist of three to hand.
LIMB_URDF = "".join(
    [
        '<robot name="limb"><link name="world"/>',
        prism("upper", -LENGTH / 2),
        prism("lower", -LENGTH / 2),
        prism("hand", -LENGTH / 2),
        '<link name="wrist_1"/><link name="wrist_2"/>',
        hinge("shoulder", "world", "upper", "0 1 0", 0.3),
        hinge("elbow", "upper", "lower", "1 0 0", -LENGTH),
        hinge("wrist_x", "lower", "wrist_1", "1 0 0", -LENGTH),
        hinge("wrist_z", "wrist_1", "wrist_2", "0 0 1", 0.0),
        hinge("wrist_y", "wrist_2", "hand", "0 1 0", 0.0),
        "</robot>",
    ]
)


def band_entry(parent: str, child: str, **changes: object) -> str:
    """One entry of a skin file."""
    entry: dict[str, object] = {
        "parent": parent,
        "child": child,
        "mesh": "tube.obj",
        "axis": [0, 0, -1],
        "begin": -REACH,
        "end": REACH,
        "colour": [0.8, 0.6, 0.5],
    }
    entry |= changes
    return "- {" + ", ".join(f"{k}: {v}" for k, v in entry.items() if v is not None) + "}\n"


def write_limb(folder: Path, skin: str | None = None, text: str = LIMB_URDF) -> Path:
    """Write the limb with a skin file; "" for none. Returns the URDF."""
    (folder / "tube.obj").write_text(tube_obj())
    path = folder / "limb.urdf"
    path.write_text(text)
    if skin is None:
        skin = "bands:\n" + band_entry("upper", "lower") + band_entry("lower", "hand")
    if skin:
        (folder / "limb.skin.yaml").write_text(skin)
    return path


def load_limb(folder: Path, skin: str | None = None) -> ArticulatedModel:
    """Write the limb and load it."""
    return load_model(write_limb(folder, skin), check=False)
