"""Writes two_finger_hand.urdf and its couplings; see --help.

The hand of Shimada, Shirai, Kuno and Miura (equations 5, 9 and 10, table 1). Every length is a
prismatic shape joint, so that table 1's limits are those of the URDF. A pixel of the paper is a
millimetre here.
"""

import argparse
import math
from pathlib import Path

NAME = "two_finger_hand"
ANGLE_LIMITS = {"spread_1": (-20, 0), "spread_2": (0, 20), "flexion": (0, 90)}  # [deg]
LENGTH_LIMITS = {1: (55, 70), 2: (30, 50), 3: (25, 50)}  # r_i1, r_i2, r_i3 [mm]
# Table 1 does not bound the palm; these limits keep it positive and of a hand's size.
PALM_LIMITS = {"palm_width": (40, 120), "palm_height": (50, 130), "palm_thickness": (10, 50)}
FINGER_RADIUS = 0.008
DIFFERENCES = (
    ("flexion_12", "flexion_13", "within: 10, unit: deg"),
    ("flexion_22", "flexion_23", "within: 10, unit: deg"),
    ("flexion_11", "flexion_21", "within: 35, unit: deg"),
    ("length_11", "length_12", "lower: 0, upper: 30, unit: mm"),
    ("length_21", "length_22", "lower: 0, upper: 30, unit: mm"),
    ("length_12", "length_13", "within: 10, unit: mm"),
    ("length_22", "length_23", "within: 10, unit: mm"),
    ("length_11", "length_21", "within: 5, unit: mm"),
    ("length_12", "length_22", "within: 5, unit: mm"),
    ("length_13", "length_23", "within: 5, unit: mm"),
)
INERTIAL = (
    '    <inertial><mass value="0.02"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" '
    'ixy="0" ixz="0" iyz="0"/></inertial>'
)


def link(name: str, visual: str = "") -> list[str]:
    """Return a link's lines; every link has a mass, so that Drake can simulate the hand."""
    return [f'  <link name="{name}">', INERTIAL, *([visual] if visual else []), "  </link>"]


def joint(
    kind: str,
    name: str,
    parent: str,
    child: str,
    axis: str,
    limits: tuple[float, float],
    xyz: str = "0 0 0",
) -> list[str]:
    """Return a joint's lines; limits in rad or m."""
    return [
        f'  <joint name="{name}" type="{kind}">',
        f'    <parent link="{parent}"/><child link="{child}"/>',
        f'    <origin xyz="{xyz}"/><axis xyz="{axis}"/>',
        f'    <limit lower="{limits[0]:.12g}" upper="{limits[1]:.12g}" effort="1" velocity="10"/>',
        "  </joint>",
    ]


def radians(limits: tuple[float, float]) -> tuple[float, float]:
    """Convert limits from degrees to radians."""
    return (math.radians(limits[0]), math.radians(limits[1]))


def metres(limits: tuple[float, float]) -> tuple[float, float]:
    """Convert limits from millimetres to metres."""
    return (limits[0] / 1000, limits[1] / 1000)


def half_segment(j: int, sign: int) -> str:
    """Return a capsule of segment j's least length, from its joint along x or back from its end.

    The two capsules slide over each other. No length is twice the least one, so they cover the
    whole segment at every length.
    """
    length = LENGTH_LIMITS[j][0] / 1000
    return (
        f'    <visual><origin xyz="{sign * length / 2:.6g} 0 0" rpy="0 {math.pi / 2:.12g} 0"/>'
        f'<geometry><drake:capsule radius="{FINGER_RADIUS}" length="{length}"/></geometry></visual>'
    )


def finger(i: int) -> list[str]:
    """Return finger i (equations 9 and 10): spread about y at the wrist, three flexions about z.

    The base is at p_i0 = (palm height, 0, +-palm width / 4) in the turned frame. A joint moves one
    link only, so each finger repeats the palm's height and a quarter of its width as joints of its
    own; callers must set them consistently.
    """
    side = "1" if i == 1 else "-1"
    lines = link(f"spread_{i}")
    limits = radians(ANGLE_LIMITS[f"spread_{i}"])
    lines += joint("revolute", f"spread_{i}", "palm", f"spread_{i}", "0 1 0", limits)
    low, high = metres(PALM_LIMITS["palm_width"])
    for name, axis, span in (
        (f"base_height_{i}", "1 0 0", metres(PALM_LIMITS["palm_height"])),
        (f"base_side_{i}", f"0 0 {side}", (low / 4, high / 4)),
    ):
        parent = f"spread_{i}" if name.startswith("base_height") else f"base_height_{i}"
        lines += link(name)
        lines += joint("prismatic", name, parent, name, axis, span)
    parent = f"base_side_{i}"
    for j in (1, 2, 3):
        child = f"segment_{i}{j}"
        lines += link(child, half_segment(j, 1))
        limits = radians(ANGLE_LIMITS["flexion"])
        lines += joint("revolute", f"flexion_{i}{j}", parent, child, "0 0 1", limits)
        parent = f"end_{i}{j}"
        lines += link(parent, half_segment(j, -1))
        limits = metres(LENGTH_LIMITS[j])
        lines += joint("prismatic", f"length_{i}{j}", child, parent, "1 0 0", limits)
    return lines


def palm() -> list[str]:
    """Return the palm: a box of default size, and shape joints for its three sizes."""
    lines = link(
        "palm",
        '    <visual><origin xyz="0.04 0 0"/><geometry><box size="0.08 0.02 0.07"/></geometry>'
        "</visual>",
    )
    for name, axis in (
        ("palm_width", "0 0 1"),
        ("palm_height", "1 0 0"),
        ("palm_thickness", "0 1 0"),
    ):
        lines += link(name)
        lines += joint("prismatic", name, "palm", name, axis, metres(PALM_LIMITS[name]))
    return lines


def main() -> None:
    """Write the two files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent)
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    lines = ['<?xml version="1.0"?>', "<!-- Written by make_two_finger_hand.py. -->"]
    lines.append(f'<robot name="{NAME}" xmlns:drake="http://drake.mit.edu">')
    lines += [*palm(), *finger(1), *finger(2), "</robot>"]
    (folder / f"{NAME}.urdf").write_text("\n".join(lines) + "\n")
    rows = [f"  - {{first: {a}, second: {b}, {bounds}}}" for a, b, bounds in DIFFERENCES]
    header = ["# Table 1's couplings; written by make_two_finger_hand.py.", "differences:"]
    (folder / f"{NAME}.couplings.yaml").write_text("\n".join([*header, *rows]) + "\n")


if __name__ == "__main__":
    main()
