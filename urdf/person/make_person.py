"""Writes person.urdf, person_shape.urdf, their meshes, couplings and landmarks; see --help."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from body_generator.shapes import Shell
    from body_generator.writing import Joint
    from person.person_shapes import Figure

COLOURS = {
    "skin": (0.85, 0.65, 0.53),
    "eyes": (0.15, 0.10, 0.08),
    "brows": (0.21, 0.13, 0.09),
    "lips": (0.68, 0.36, 0.34),
    "shirt": (0.12, 0.45, 0.50),
    "trousers": (0.17, 0.19, 0.25),
}
# Part -> (parent, axes in order of rotation with limits [deg]), on the left side. 23 degrees of
# freedom with the head's position: Date et al., figure 5. The README states the limits' sources.
Limits = tuple[tuple[str, float, float], ...]
HEAD: Limits = (("y", -180, 180), ("x", -60, 90))
NECK_BASE: Limits = (("x", -50, 75), ("z", -45, 45))
LIMBS: dict[str, tuple[str, Limits]] = {
    "upper_arm": ("trunk", (("x", -180, 60), ("z", -45, 180), ("y", -70, 90))),
    "forearm": ("upper_arm", (("x", -150, 0),)),
    "hand": ("forearm", ()),
    "thigh": ("trunk", (("y", -45, 45), ("z", -30, 45), ("x", -120, 30))),
    "shin": ("thigh", (("x", 0, 150),)),
    "foot": ("shin", ()),
}
# Joints of person_shape.urdf alone, on the left side.
WAIST: Limits = (("y", -45, 45), ("z", -35, 35), ("x", -60, 30))
CLAVICLE: Limits = (("z", -10, 20), ("y", -20, 20))
WELDED: dict[str, Limits] = {"hand": (("z", -80, 70), ("x", -20, 30)), "foot": (("x", -20, 50),)}
WAIST_HEIGHT = 0.6  # of the waist under the neck's base, as a fraction of the way to the hips
STERNUM = (0.02, 0.0, 0.0)  # left clavicle's inner end from the neck's base [m]
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
DOWN = (0.0, -1.0, 0.0)
# Shape joints of person_shape.urdf: largest deviation of each length from the average [m].
STRETCHES = {
    "neck": 0.03,
    "trunk": 0.07,
    "shoulder": 0.02,
    "hip": 0.02,
    "upper_arm": 0.045,
    "forearm": 0.04,
    "thigh": 0.06,
    "shin": 0.06,
}
BELLY = 0.80  # end of the upper half's copy of the belly, as a fraction of the trunk
SIDE_DIFFERENCE = 10  # largest difference of left and right [mm]
PAIRED = ("shoulder", "hip", "upper_arm", "forearm", "thigh", "shin")


def main() -> None:
    """Read the command line and write the models."""
    here = Path(__file__).resolve().parent
    sys.path.insert(0, str(here.parent))
    from person.person_shapes import PARTS

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stature", type=float, help="in metres; everything in proportion")
    for name, text in (("lengths", "along"), ("girths", "across")):
        parser.add_argument(
            f"--{name}",
            nargs="+",
            default=[],
            metavar="PART=FACTOR",
            help=f"factors {text} these parts: {', '.join(PARTS)}",
        )
    parser.add_argument("--out", type=Path, default=here, help="folder to write into")
    options = parser.parse_args()
    try:
        figure = average_figure(
            options.stature,
            factors(options.lengths, tuple(PARTS)),
            factors(options.girths, tuple(PARTS)),
        )
    except ValueError as error:
        parser.error(str(error))
    write_person(options.out, figure)


def factors(words: Sequence[str], known: Sequence[str]) -> dict[str, float]:
    """Return words of the form part=factor as a mapping.

    Raises:
        ValueError: a word of another form, an unknown part, or a factor outside 0.5..2.
    """
    found = {}
    for word in words:
        part, _, factor = word.partition("=")
        if part not in known:
            raise ValueError(f"'{word}': unknown part; use PART=FACTOR with one of {known}")
        found[part] = float(factor)
        if not 0.5 <= found[part] <= 2.0:
            raise ValueError(f"'{word}': give a factor from 0.5 to 2")
    return found


def average_figure(
    stature: float | None = None,
    lengths: dict[str, float] | None = None,
    girths: dict[str, float] | None = None,
) -> "Figure":
    """Return the person half-way between the bundled woman and man, in other proportions."""
    from body_generator.measures import Build, Measures
    from body_generator.persons import MAN, WOMAN
    from person.person_shapes import Figure, Proportions

    mean = {name: 0.5 * (value + MAN.measures[name]) for name, value in WOMAN.measures.items()}
    shares = {
        name: 0.5 * (share + MAN.mass_fractions[name])
        for name, share in WOMAN.mass_fractions.items()
    }
    measures = Measures(**mean)
    mass = 0.5 * (WOMAN.mass + MAN.mass)
    if stature is not None:
        mass *= (stature / measures.stature) ** 3
        measures = measures.scaled_to(stature)
    build = Build(
        name="person",
        bust=False,
        jaw=0.86,
        chin=1.1,
        brow=0.0015,
        natural_waist=0.92,
        ponytail=False,
        muscle=1.2,
        mass=mass,
        mass_fractions={**shares, "trunk": shares["chest"] + shares["waist"]},
        colours=COLOURS,
    )
    return Figure(measures, build, Proportions(lengths or {}, girths or {}))


def write_person(folder: Path, figure: "Figure") -> None:
    """Write both URDFs, their meshes, the couplings and the landmarks."""
    from body_generator.writing import write_meshes

    folder.mkdir(parents=True, exist_ok=True)
    for name, stretchable in (("person", False), ("person_shape", True)):
        links, meshes = link_texts(figure, stretchable)
        text = urdf_text(figure, name, links, stretchable)
        (folder / f"{name}.urdf").write_text(text, encoding="ascii")
        write_meshes(folder, meshes)
    (folder / "person_shape.couplings.yaml").write_text(couplings_text(), encoding="ascii")
    (folder / "landmarks.yaml").write_text(landmarks_text(figure), encoding="ascii")


def sided(part: str) -> list[str]:
    """Return the names of a part's links: one on each side for limbs."""
    return [f"left_{part}", f"right_{part}"] if part in LIMBS else [part]


def link_texts(
    figure: "Figure", stretchable: bool
) -> "tuple[dict[str, str], dict[str, list[Shell]]]":
    """Return each link's element, and the shells of each .obj file."""
    from body_generator.writing import solid_link
    from person.person_shapes import PARTS

    texts, meshes = {}, {}
    for part in PARTS:
        mass = figure.build.mass * figure.build.mass_fractions[part]
        for link in sided(part):
            whole = figure.shells(part)
            pieces = {link: (link, whole)}
            if stretchable and part in STRETCHES:
                start, end = cut_in_two(figure, part, whole)
                pieces = {link: (f"{link}_start", start), f"{link}_end": (f"{link}_end", end)}
            for name, (file, by_material) in pieces.items():
                many = len(by_material) > 1
                files = {
                    f"{file}_{material}" if many else file: on_side(shells, link)
                    for material, shells in by_material.items()
                }
                texts[name] = solid_link(name, files, mass / len(pieces))
                meshes.update(files)
    return texts, meshes


def on_side(shells: "list[Shell]", link: str) -> "list[Shell]":
    """Return the shells of a left or middle link; mirrored for links on the right side."""
    return [shell.mirrored() for shell in shells] if link.startswith("right_") else shells


def cut_in_two(
    figure: "Figure", part: str, whole: "dict[str, list[Shell]]"
) -> "tuple[dict[str, list[Shell]], dict[str, list[Shell]]]":
    """Return the shells of a part's two halves by material; they overlap where they join."""
    from person.person_shapes import PARTS, cut, halves

    end = float(figure.offset(part, PARTS[part][1])[1])
    if part == "trunk":
        # The upper half has a copy of the belly, so that no gap opens when the hips move down.
        belly = [cut(shell, BELLY * end, np.inf) for shell in whole["trousers"]]
        return {**whole, "trousers": belly}, {"trousers": whole["trousers"]}
    start, last = {}, {}
    for material, shells in whole.items():
        pairs = [halves(shell, end) for shell in shells]
        start[material] = [pair[0] for pair in pairs]
        last[material] = [pair[1] for pair in pairs]
    return start, last


def urdf_text(figure: "Figure", name: str, links: dict[str, str], stretchable: bool) -> str:
    """Return a URDF."""
    from body_generator.writing import joint_chain, materials_text, root_joints

    text = '<?xml version="1.0"?>\n<!-- Written by make_person.py: do not edit. -->\n'
    text += f'<robot name="{name}">\n' + materials_text(COLOURS)
    text += root_joints(turns("head", "root_axes_link", "head", HEAD)) + links["head"]

    def add(chain: "list[Joint]", part: str, link: str) -> str:
        """Return a chain of joints and its last link, in two halves where it stretches."""
        if not (stretchable and part in STRETCHES):
            return joint_chain(chain) + links[link]
        axis = mirrored_if_right(figure.axis(part), link)
        own = [slide(f"{link}_stretch", link, f"{link}_end", axis, part)]
        if part == "trunk":
            down = WAIST_HEIGHT * figure.offset("trunk", "thigh")[1] * np.array(AXES["y"])
            waist = turns("waist", link, "waist_link", WAIST, down)
            own = [*waist, moved(own[0], parent="waist_link", xyz=-down)]
        return joint_chain(chain) + links[link] + joint_chain(own) + links[f"{link}_end"]

    chain = turns("neck_base", "head", "trunk", NECK_BASE, figure.offset("head", "chest"))
    if stretchable:
        chain = slide_before(chain, "neck_stretch", DOWN, "neck")
    text += add(chain, "trunk", "trunk")
    for part, (parent, axes) in LIMBS.items():
        for link in sided(part):
            text += add(limb_joints(figure, part, parent, axes, link, stretchable), part, link)
    return text + "</robot>\n"


def limb_joints(
    figure: "Figure", part: str, parent: str, axes: Limits, link: str, stretchable: bool
) -> "list[Joint]":
    """Return the joints that carry a limb's link."""
    from body_generator.writing import Joint

    side = link.removesuffix(part)
    before = parent if parent == "trunk" else f"{side}{parent}"
    offset = mirrored_if_right(figure.offset(parent, part), link)
    if stretchable and parent in STRETCHES and part != "upper_arm":
        before = f"{before}_end"
    if stretchable:
        axes = axes or WELDED[part]
    if side == "right_":
        axes = mirrored(axes)
    if not axes:
        return [Joint(f"{link}_weld", before, link, xyz=offset)]
    chain = turns(link, before, link, axes, offset)
    place = {"upper_arm": "shoulder", "thigh": "hip"}.get(part)
    if stretchable and place is not None:
        outwards = tuple(mirrored_if_right(np.array(AXES["x"]), link))
        chain = slide_before(chain, f"{side}{place}_stretch", outwards, place)
    if stretchable and part == "upper_arm":
        inner = mirrored_if_right(np.array(STERNUM), link)
        turning, bare = mirrored(CLAVICLE) if side == "right_" else CLAVICLE, f"{side}clavicle_link"
        clavicle = turns(f"{side}clavicle", before, bare, turning, inner)
        chain = [*clavicle, moved(chain[0], parent=bare, xyz=offset - inner), *chain[1:]]
    return chain


def mirrored(axes: Limits) -> Limits:
    """Return axes with their limits, mirrored from the left to the right side."""
    return tuple((a, low, high) if a == "x" else (a, -high, -low) for a, low, high in axes)


def turns(
    name: str, parent: str, child: str, axes: Limits, xyz: Sequence[float] = (0.0, 0.0, 0.0)
) -> "list[Joint]":
    """Return successive revolute joints between two links."""
    from body_generator.writing import Joint

    joints = []
    for index, (axis, low, high) in enumerate(axes):
        end = child if index == len(axes) - 1 else f"{name}_{axis}_link"
        origin = xyz if index == 0 else (0.0, 0.0, 0.0)
        joints.append(
            Joint(f"{name}_{axis}", parent, end, "revolute", AXES[axis], (low, high), origin)
        )
        parent = end
    return joints


def slide(name: str, parent: str, child: str, axis: Sequence[float], length: str) -> "Joint":
    """Return a shape joint, which is 0 at the average length."""
    from body_generator.writing import Joint

    reach = STRETCHES[length]
    direction = tuple(float(value) for value in axis)
    return Joint(name, parent, child, "prismatic", direction, (-reach, reach))


def slide_before(
    chain: "list[Joint]", name: str, axis: Sequence[float], length: str
) -> "list[Joint]":
    """Return a chain of joints with a shape joint before it."""
    first = chain[0]
    link = f"{name}_link"
    before = moved(slide(name, first.parent, link, axis, length), xyz=first.xyz)
    return [before, moved(first, parent=link, xyz=(0.0, 0.0, 0.0)), *chain[1:]]


def moved(joint: "Joint", **changes: object) -> "Joint":
    """Return a joint with some fields changed."""
    return replace(joint, **changes)


def mirrored_if_right(vector: np.ndarray, link: str) -> np.ndarray:
    """Return a vector (3,), mirrored for links of the right side."""
    return vector * [-1.0, 1.0, 1.0] if link.startswith("right_") else vector


def couplings_text() -> str:
    """Return the couplings of person_shape.urdf: both sides are nearly equal."""
    rows = [
        f"  - {{first: left_{name}_stretch, second: right_{name}_stretch,"
        f" within: {SIDE_DIFFERENCE}, unit: mm}}"
        for name in PAIRED
    ]
    header = ["# Left and right lengths are nearly alike; written by make_person.py."]
    return "\n".join([*header, "differences:", *rows]) + "\n"


def landmarks_text(figure: "Figure") -> str:
    """Return the landmarks of both models."""
    from body_generator.measures import joint_positions

    m = figure.measures
    joints = joint_positions(m)
    crown = figure.stretch("head") @ np.array([0.0, m.stature - joints["head"][1], 0.0])
    lines = [
        "# Anatomical joint centres in the links' frames; written by make_person.py.",
        "landmarks:",
        f"  head_top: {{link: head, point: [0, {crown[1]:.5f}, 0]}}",
        "  neck: {link: trunk, point: [0, 0, 0]}",
    ]
    for name, link in (
        ("shoulder", "upper_arm"),
        ("elbow", "forearm"),
        ("wrist", "hand"),
        ("hip", "thigh"),
        ("knee", "shin"),
        ("ankle", "foot"),
    ):
        lines += [
            f"  {side}_{name}: {{link: {side}_{link}, point: [0, 0, 0]}}"
            for side in ("left", "right")
        ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
