"""Writes hand.urdf (left), right_hand.urdf, their meshes and couplings; see --help."""

import argparse
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from body_generator.shapes import Shell
    from body_generator.skin import LinkBand
    from body_generator.writing import Joint
    from hand.hand_shapes import HandMeasures

# ANSUR II, 2012 [m]: half the sum of the women's and the men's mean (Gordon et al. 2014).
MEASURES = {
    "handlength": 0.18720,
    "handbreadth": 0.08325,
    "wristcircumference": 0.16535,
    "forearmcircumferenceflexed": 0.28710,
    "bicepscircumferenceflexed": 0.33185,
    "radialestylionlength": 0.25460,
}
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
TOWARDS_LITTLE = (0.0, 0.0, -1.0)
Limits = tuple[float, float]
DENSITY = 1100.0  # [kg/m^3]
COLOURS = {"skin": (0.87, 0.67, 0.56)}
# Joint limits [deg]; the README states their sources.
ROOT_LIMITS = {"z": (-180, 180), "x": (-90, 90), "y": (-180, 180)}
WRIST_LIMITS = {"flexion": (-70, 80), "deviation": (-20, 35)}
ABDUCTION_LIMITS = {"index": (-15, 30), "middle": (-20, 20), "ring": (-15, 25), "little": (-15, 45)}
FLEXION_LIMITS = {"mcp": (-30, 90), "pip": (-10, 110), "dip": (-10, 90)}
THUMB_LIMITS = {
    "cmc_flexion": (-40, 40),
    "cmc_abduction": (-35, 40),
    "mcp_flexion": (-10, 55),
    "ip_flexion": (-50, 80),
}
# Pose of the thumb's metacarpal in the palm at zero angles [deg]: turned away from the index finger
# in the palm's plane, raised out of it, and turned about its own axis.
THUMB_REST = (40.0, 20.0, 55.0)
COUPLINGS = """# Loose couplings, written by make_hand.py; the README tells their sources.
differences:
  - {first: index_mcp_flexion, second: middle_mcp_flexion, within: 70, unit: deg}
  - {first: middle_mcp_flexion, second: ring_mcp_flexion, within: 50, unit: deg}
  - {first: ring_mcp_flexion, second: little_mcp_flexion, within: 60, unit: deg}
  - {first: middle_pip_flexion, second: ring_pip_flexion, within: 70, unit: deg}
  - {first: ring_pip_flexion, second: little_pip_flexion, within: 70, unit: deg}
rows:
"""
# Half length of the bands of skin along each joint, over the hand's length; their largest distance
# from the joint's axis, over the hand's breadth.
BAND_LENGTHS = {"wrist": 0.17, "finger": 0.055}
BAND_REACHES = {"wrist": 0.42, "finger": 0.15}
DISTAL_BAND = 30.0  # |DIP - 2/3 PIP| [deg]
# Usual flexions of fingers, mean and standard deviation [deg]; the README states the source.
USUAL_FLEXION = {"mcp": (32, 25), "pip": (45, 26)}
USUAL_DISTAL = 10.0  # of DIP - 2/3 PIP
USUAL_CURL = (10, 30)  # PIP - MCP
USUAL_NEIGHBOURS = 25.0  # between the flexions of neighbouring fingers
GAPS = (("index", "middle", 30.0), ("middle", "ring", 28.0), ("ring", "little", 50.0))
LEAST_GAP = -8.0  # fingers may lean on each other, but not cross [deg]


def main() -> None:
    """Read the command line and write both hands."""
    here = Path(__file__).resolve().parent
    sys.path.insert(0, str(here.parent))
    from body_generator.skin import write_skin
    from hand.hand_shapes import HandMeasures

    parser = argparse.ArgumentParser(description=__doc__)
    published = MEASURES["handlength"]
    parser.add_argument("--handlength", type=float, default=published, help="in metres")
    parser.add_argument("--out", type=Path, default=here, help="folder to write into")
    options = parser.parse_args()
    measures = HandMeasures(**MEASURES).scaled_to(options.handlength)
    options.out.mkdir(parents=True, exist_ok=True)
    bands = hand_bands(measures)
    for name, side in (("hand", "left"), ("right_hand", "right")):
        write_hand(options.out, name, side, measures)
        sided = [
            replace(band, file=f"{side}_{band.file}", mirrored=side == "right") for band in bands
        ]
        write_skin(options.out, name, "make_hand.py", sided)


def write_hand(folder: Path, name: str, side: str, measures: "HandMeasures") -> None:
    """Write one hand's URDF, meshes and couplings."""
    from body_generator.writing import (
        joint_chain,
        materials_text,
        root_joints,
        solid_link,
        write_meshes,
    )

    shells = {
        link: shell if side == "left" else shell.mirrored()
        for link, shell in hand_shells(measures).items()
    }
    chains = hand_joints(measures)
    if side == "right":
        chains = [[mirrored_joint(joint) for joint in chain] for chain in chains]
    text = '<?xml version="1.0"?>\n<!-- Written by make_hand.py: do not edit. -->\n'
    text += f'<robot name="{name}">\n' + materials_text(COLOURS) + root_joints(root_turns())

    def link(part: str) -> str:
        """Return a part's link."""
        mass = DENSITY * volume(shells[part])
        return solid_link(part, {f"{side}_{part}": [shells[part]]}, mass)

    text += link("forearm")
    for chain in chains:
        text += joint_chain(chain) + link(chain[-1].child)
    (folder / f"{name}.urdf").write_text(text + "</robot>\n", encoding="ascii")
    write_meshes(folder, {f"{side}_{part}": [shell] for part, shell in shells.items()})
    (folder / f"{name}.couplings.yaml").write_text(couplings_text(), encoding="ascii")


def hand_shells(measures: "HandMeasures") -> "dict[str, Shell]":
    """Return the left hand's surfaces by link."""
    from hand import hand_shapes as shapes

    shells = {"forearm": shapes.forearm(measures), "palm": shapes.palm(measures)}
    for part in ("metacarpal", "proximal", "distal"):
        shells[f"thumb_{part}"] = getattr(shapes, f"thumb_{part}")(measures)
    for finger in shapes.FINGERS:
        for part in ("proximal", "middle", "distal"):
            shells[f"{finger}_{part}"] = getattr(shapes, part)(finger, measures)
    return shells


def hand_bands(measures: "HandMeasures") -> "list[LinkBand]":
    """Return the left hand's bands of skin: at every joint except the thumb's root."""
    from body_generator.bands import Band, band_shell
    from body_generator.skin import LinkBand

    shells = hand_shells(measures)
    bands = []
    for chain in hand_joints(measures):
        parent, child = chain[0].parent, chain[-1].child
        if np.any([joint.rpy for joint in chain]):
            # The thumb's root is inside the palm.
            continue
        half = BAND_LENGTHS["wrist" if child == "palm" else "finger"] * measures.handlength
        reach = BAND_REACHES["wrist" if child == "palm" else "finger"] * measures.handbreadth
        band = Band(AXES["y"], -half, half, reach, "skin", rings=6, around=12)
        offset = -np.sum([joint.xyz for joint in chain], axis=0)
        shell = band_shell(band, [shells[parent].moved(offset), shells[child]])
        colour = COLOURS["skin"]
        bands.append(LinkBand(parent, child, f"{child}_skin", band, shell, False, colour))
    return bands


def hand_joints(measures: "HandMeasures") -> "list[list[Joint]]":
    """Return the left hand's joints beyond the forearm, a list for each visible link."""
    from body_generator.writing import Joint
    from hand import hand_shapes as shapes

    wrist = hinge("wrist_flexion", "forearm", "wrist_link", WRIST_LIMITS["flexion"])
    limits = WRIST_LIMITS["deviation"]
    sideways = Joint("wrist_deviation", "wrist_link", "palm", "revolute", TOWARDS_LITTLE, limits)
    chains = [[wrist, sideways], *thumb_joints(measures)]
    for finger in shapes.FINGERS:
        chains += finger_joints(finger, measures)
    return chains


def root_turns() -> "list[Joint]":
    """Return the joints that rotate the forearm in the world."""
    from body_generator.writing import Joint

    joints, before = [], "root_axes_link"
    for axis, limits in ROOT_LIMITS.items():
        child = "forearm" if axis == "y" else f"forearm_{axis}_link"
        joints.append(Joint(f"forearm_{axis}", before, child, "revolute", AXES[axis], limits))
        before = child
    return joints


def hinge(name: str, parent: str, child: str, limits: Limits, y: float = 0.0) -> "Joint":
    """Return a joint that flexes towards the palm, y [m] along its parent."""
    from body_generator.writing import Joint

    return Joint(name, parent, child, "revolute", AXES["x"], limits, (0.0, y, 0.0))


def thumb_joints(measures: "HandMeasures") -> "list[list[Joint]]":
    """Return the left thumb's joints."""
    from body_generator.writing import Joint
    from hand import hand_shapes as shapes

    rest = Rotation.from_euler("ZXY", THUMB_REST, degrees=True).as_euler("xyz")
    flexion = Joint(
        "thumb_cmc_flexion",
        "palm",
        "thumb_cmc_link",
        "revolute",
        AXES["x"],
        THUMB_LIMITS["cmc_flexion"],
        shapes.thumb_base(measures),
        np.round(rest, 9),
    )
    names = ("thumb_cmc_abduction", "thumb_cmc_link", "thumb_metacarpal")
    abduction = Joint(*names, "revolute", AXES["z"], THUMB_LIMITS["cmc_abduction"])
    lengths = shapes.thumb_lengths(measures)
    return [
        [flexion, abduction],
        *[
            [hinge(f"thumb_{joint}", parent, child, THUMB_LIMITS[joint], y)]
            for joint, parent, child, y in (
                ("mcp_flexion", "thumb_metacarpal", "thumb_proximal", lengths[0]),
                ("ip_flexion", "thumb_proximal", "thumb_distal", lengths[1]),
            )
        ],
    ]


def finger_joints(finger: str, measures: "HandMeasures") -> "list[list[Joint]]":
    """Return a left finger's joints."""
    from body_generator.writing import Joint
    from hand import hand_shapes as shapes

    away = AXES["z"] if finger in ("index", "middle") else TOWARDS_LITTLE
    lengths = shapes.finger_lengths(finger, measures)
    proximal, middle, distal = (f"{finger}_{part}" for part in ("proximal", "middle", "distal"))
    base = f"{finger}_mcp_link"
    abduction = Joint(
        f"{finger}_mcp_abduction",
        "palm",
        base,
        "revolute",
        away,
        ABDUCTION_LIMITS[finger],
        shapes.knuckle(finger, measures),
    )
    name, limits = f"{finger}_{{}}_flexion", FLEXION_LIMITS
    return [
        [abduction, hinge(name.format("mcp"), base, proximal, limits["mcp"])],
        [hinge(name.format("pip"), proximal, middle, limits["pip"], lengths[0])],
        [hinge(name.format("dip"), middle, distal, limits["dip"], lengths[1])],
    ]


def mirrored_joint(joint: "Joint") -> "Joint":
    """Return the right hand's joint, for which the same angle means the same movement."""
    flip, turn = np.array([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, -1.0])
    axis = tuple(float(value) for value in turn * joint.axis + 0.0)
    return replace(joint, axis=axis, xyz=flip * joint.xyz, rpy=turn * joint.rpy)


def volume(shell: "Shell") -> float:
    """Return the volume inside a closed surface [m^3]."""
    corners = shell.vertices[shell.triangles]
    cross = np.cross(corners[:, 1], corners[:, 2])
    return abs(float(np.einsum("ij,ij->", corners[:, 0], cross))) / 6.0


def couplings_text() -> str:
    """Return the couplings, which are the same for both hands."""
    rows = [
        f"  - {{name: {finger}_distal,"
        f" terms: {{{finger}_dip_flexion: 3, {finger}_pip_flexion: -2}},"
        f" lower: {-3 * DISTAL_BAND:g}, upper: {3 * DISTAL_BAND:g}, unit: deg}}"
        for finger in ABDUCTION_LIMITS
    ]
    for first, second, most in GAPS:
        # Index and middle abduct away from the little finger, ring and little towards it.
        terms = {
            ("index", "middle"): "index_mcp_abduction: 1, middle_mcp_abduction: -1",
            ("middle", "ring"): "middle_mcp_abduction: 1, ring_mcp_abduction: 1",
            ("ring", "little"): "little_mcp_abduction: 1, ring_mcp_abduction: -1",
        }[(first, second)]
        rows.append(
            f"  - {{name: {first}_to_{second}, terms: {{{terms}}},"
            f" lower: {LEAST_GAP:g}, upper: {most:g}, unit: deg}}"
        )
    rows += [
        f"  - {{name: {finger}_{joint}_forwards, terms: {{{finger}_{joint}_flexion: 1}},"
        " lower: 0, unit: deg}"
        for finger in ABDUCTION_LIMITS
        for joint in FLEXION_LIMITS
    ]
    return COUPLINGS + "\n".join([*rows, "usual:", *usual_rows()]) + "\n"


def usual_rows() -> list[str]:
    """Return the usual flexions of fingers as rows of the couplings."""
    rows = []

    def add(name: str, terms: str, mean: float, deviation: float) -> None:
        """Add a row."""
        moments = f"mean: {mean:g}, deviation: {deviation:g}"
        rows.append(f"  - {{name: {name}, terms: {{{terms}}}, {moments}, unit: deg}}")

    for finger in ABDUCTION_LIMITS:
        mcp, pip, dip = (f"{finger}_{joint}_flexion" for joint in FLEXION_LIMITS)
        add(mcp, f"{mcp}: 1", *USUAL_FLEXION["mcp"])
        add(pip, f"{pip}: 1", *USUAL_FLEXION["pip"])
        add(f"{finger}_curl", f"{pip}: 1, {mcp}: -1", *USUAL_CURL)
        add(f"{finger}_tip", f"{dip}: 1, {pip}: {-2 / 3:.6f}", 0.0, USUAL_DISTAL)
    for first, second in pairwise(ABDUCTION_LIMITS):
        for joint in ("mcp", "pip"):
            terms = f"{first}_{joint}_flexion: 1, {second}_{joint}_flexion: -1"
            add(f"{first}_as_{second}_{joint}", terms, 0.0, USUAL_NEIGHBOURS)
    return rows


if __name__ == "__main__":
    main()
