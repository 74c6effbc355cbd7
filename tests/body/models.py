"""Small models for the tests of drake_pose.body, as texts and as files."""

from pathlib import Path

import numpy as np
import trimesh

from drake_pose.body import ArticulatedModel, load_model

BOX = '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
SPHERE = '<visual><geometry><sphere radius="0.1"/></geometry></visual>'


def link(name: str, visual: str = BOX) -> str:
    return f'<link name="{name}">{visual}</link>'


def joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    *,
    axis: str = "0 0 1",
    limits: str | None = 'lower="-1" upper="1"',
    origin: str = 'xyz="0.1 0.2 0.3" rpy="0.3 -0.2 0.5"',
    more: str = "",
) -> str:
    limit = "" if limits is None else f'<limit effort="1" velocity="1" {limits}/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin {origin}/><axis xyz="{axis}"/>{limit}{more}</joint>'
    )


def urdf(*parts: str) -> str:
    return f'<robot name="thing">{"".join(parts)}</robot>'


def write(folder: Path, text: str, name: str = "thing.urdf") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def random_urdf(rng: np.random.Generator, count: int = 9) -> str:
    """Links on random joints, some without geometry, some joints following others."""
    parts = [
        link(f"l{i}", ("", BOX, SPHERE)[rng.integers(3)] if i % 4 else BOX) for i in range(count)
    ]
    leaders = rng.permutation(count)
    for i in range(count):
        parent = "world" if i == 0 else f"l{rng.integers(i)}"
        kind = ("revolute", "revolute", "prismatic", "continuous", "fixed")[rng.integers(5)]
        if i == 0 and rng.random() < 0.3:
            continue  # A floating base.
        # Joints follow such as come later in a random order: no two are coupled twice.
        leader = rng.integers(1, count)
        more = ""
        if rng.random() < 0.4 and leaders[leader] > leaders[i] and kind != "fixed":
            factor, offset = rng.choice([-1.0, -0.5, 0.5, 1.0]), rng.uniform(-0.1, 0.1)
            more = f'<mimic joint="j{leader}" multiplier="{factor}" offset="{offset}"/>'
        x, y, z, *turn = rng.uniform(-0.5, 0.5, 6)
        where = f'xyz="{x} {y} {z}" rpy="{turn[0]} {turn[1]} {turn[2]}"'
        axis, limits = f"{turn[1]} {turn[2]} 1", 'lower="-1" upper="1"'
        parts.append(
            joint(f"j{i}", kind, parent, f"l{i}", axis=axis, limits=limits, origin=where, more=more)
        )
    return urdf(*parts)


# A floating trunk; an arm of two joints through a link without geometry, then a prismatic hand.
FLOATING_URDF = urdf(
    *(link("trunk"), link("between", ""), link("arm"), link("hand"), link("welded", SPHERE)),
    *(link("leg"), link("toe", "")),
    joint("shoulder_x", "revolute", "trunk", "between", axis="1 0 0"),
    joint("shoulder_y", "revolute", "between", "arm", axis="0 1 0"),
    joint("slide", "prismatic", "arm", "hand", axis="0 1 1", limits='lower="-0.2" upper="0.3"'),
    joint("fix", "fixed", "hand", "welded", limits=None),
    joint("hip", "continuous", "trunk", "leg", axis="1 1 0", limits=None),
    joint("toe_joint", "revolute", "leg", "toe"),
)

# A similar body on three prismatic and three revolute joints.
JOINTED_BASE_URDF = urdf(
    *(link(name, "") for name in ("bx", "by", "bz", "ry", "rz")),
    *map(link, ("head", "chest", "arm")),
    joint("x", "prismatic", "world", "bx", axis="1 0 0", limits='lower="-10" upper="10"'),
    joint("y", "prismatic", "bx", "by", axis="0 1 0", limits='lower="-10" upper="10"', origin=""),
    joint("z", "prismatic", "by", "bz", axis="0 0 1", limits='lower="-10" upper="10"', origin=""),
    joint("head_y", "revolute", "bz", "ry", axis="0 1 0", origin='rpy="1 2 3"'),
    joint("head_z", "revolute", "ry", "rz", axis="0 0 1", origin=""),
    joint("head_x", "revolute", "rz", "head", axis="1 0 0", origin=""),
    joint("neck", "revolute", "head", "chest", axis="1 0 0"),
    joint("shoulder", "revolute", "chest", "arm", axis="0 1 0"),
)

# An arm welded to the world.
WELDED_URDF = urdf(
    *map(link, ("base", "upper", "lower")),
    joint("mount", "fixed", "world", "base", limits=None),
    joint("a1", "revolute", "base", "upper", axis="0 0 1"),
    joint("a2", "revolute", "upper", "lower", axis="0 1 0"),
)


# A driven finger, a finger that follows it, its tip, which follows by half, and a nail on the tip;
# last a follower that cannot be enforced, because other joints move it, too.
HAND_LINKS = (link("world", ""), *map(link, ("palm", "one", "two", "tip", "nail", "far")))
HAND_JOINTS = (
    joint("wrist", "revolute", "world", "palm", axis="0 1 0"),
    joint("lead", "revolute", "palm", "one", axis="1 0 0", limits='lower="0" upper="0.8"'),
    joint("mirror", "revolute", "palm", "two", axis="1 1 0", limits='lower="-0.6" upper="0.1"',
          more='<mimic joint="lead" multiplier="-1" offset="0.1"/>'),
    joint("bend", "revolute", "two", "tip", axis="0 1 0",
          more='<mimic joint="mirror" multiplier="0.5" offset="-0.05"/>'),
    joint("scratch", "revolute", "tip", "nail", axis="0 0 1"),
    joint("far", "prismatic", "nail", "far", axis="0 0 1", more='<mimic joint="lead"/>'),
)  # fmt: skip
HAND = urdf(*HAND_LINKS, *HAND_JOINTS)


def _sdf_link(name: str) -> str:
    return (
        f'<link name="{name}"><pose>0.1 0.2 0.3 0.4 0.5 0.6</pose><visual name="v"><geometry>'
        "<box><size>0.1 0.2 0.3</size></box></geometry></visual></link>"
    )


def _limits(lower: float, upper: float) -> str:
    return f"<limit><lower>{lower}</lower><upper>{upper}</upper><effort>0</effort></limit>"


# The other joint types: universal, ball, screw, and a revolute one whose parent is the outer link.
JOINTS_SDF = f"""<sdf version="1.9"><model name="m">
{"".join(_sdf_link(name) for name in "abcdef")}
<joint name="w" type="fixed"><parent>world</parent><child>a</child></joint>
<joint name="u" type="universal"><parent>a</parent><child>b</child>
<pose>0.1 0 0.2 0.3 0.2 0.1</pose>
<axis><xyz>1 0 0</xyz>{_limits(-1, 1)}</axis><axis2><xyz>0 1 0</xyz>{_limits(-1, 1)}</axis2></joint>
<joint name="ball" type="ball"><parent>b</parent><child>c</child><pose>0 0.1 0 0 0 1</pose></joint>
<joint name="screw" type="screw"><parent>c</parent><child>d</child>
<axis><xyz>0 1 1</xyz>{_limits(-3, 3)}</axis><screw_thread_pitch>0.1</screw_thread_pitch></joint>
<joint name="back" type="revolute"><parent>e</parent><child>d</child>
<axis><xyz>1 0 1</xyz>{_limits(-1, 2)}</axis></joint>
<joint name="turn" type="continuous"><parent>e</parent><child>f</child>
<axis><xyz>0 0 1</xyz></axis></joint>
</model></sdf>"""


def link_poses(model: ArticulatedModel, q: np.ndarray) -> dict[str, np.ndarray]:
    """The pose (4, 4) of each link in the world, by Drake's plant."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, q)
    poses = model.plant.get_body_poses_output_port().Eval(context)
    return {name: poses[k].GetAsMatrix4() for k, name in enumerate(model.link_names)}


def cube_obj(*, normals: bool) -> str:
    """A cube of edge 1 whose every triangle has its own vertices."""
    cube = trimesh.creation.box()
    cube.unmerge_vertices()
    return str(trimesh.exchange.obj.export_obj(cube, include_normals=normals))


# A limb of prisms with flat ends, and skin bands about the joints between them.
HALF = 0.03
LENGTH = 0.2
REACH = 0.06


def tube_obj(rings: int = 7, half: float = 0.999 * HALF, reach: float = REACH) -> str:
    """A closed square tube along z about the origin, with evenly spaced rings, as an OBJ file."""
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
    shape = f'<geometry><box size="{2 * HALF} {2 * HALF} {LENGTH}"/></geometry>'
    return link(name, f'<visual><origin xyz="0 0 {middle}"/>{shape}</visual>')


def hinge(name: str, parent: str, child: str, axis: str, z: float) -> str:
    ends = {"limits": 'lower="-2.5" upper="2.5"', "origin": f'xyz="0 0 {z}"'}
    return joint(name, "revolute", parent, child, axis=axis, **ends)


# Downwards: upper, an elbow of one axis, lower, a wrist of three axes, hand.
LIMB_URDF = urdf(
    *(link(name, "") for name in ("world", "wrist_1", "wrist_2")),
    *(prism(name, -LENGTH / 2) for name in ("upper", "lower", "hand")),
    hinge("shoulder", "world", "upper", "0 1 0", 0.3),
    hinge("elbow", "upper", "lower", "1 0 0", -LENGTH),
    hinge("wrist_x", "lower", "wrist_1", "1 0 0", -LENGTH),
    hinge("wrist_z", "wrist_1", "wrist_2", "0 0 1", 0.0),
    hinge("wrist_y", "wrist_2", "hand", "0 1 0", 0.0),
)


def band_entry(parent: str, child: str, **changes: object) -> str:
    """One entry of a skin file."""
    entry: dict[str, object] = {"parent": parent, "child": child, "mesh": "tube.obj"}
    entry |= {"axis": [0, 0, -1], "begin": -REACH, "end": REACH, "colour": [0.8, 0.6, 0.5]}
    entry |= changes
    return "- {" + ", ".join(f"{k}: {v}" for k, v in entry.items() if v is not None) + "}\n"


def write_limb(folder: Path, skin: str | None = None, text: str = LIMB_URDF) -> Path:
    """Write the limb with a skin file ("": none) and return the URDF's path."""
    (folder / "tube.obj").write_text(tube_obj())
    path = folder / "limb.urdf"
    path.write_text(text)
    if skin is None:
        skin = "bands:\n" + band_entry("upper", "lower")
        # An axis may have any length.
        skin += band_entry("lower", "hand", axis=[0, 0, -2])
    if skin:
        (folder / "limb.skin.yaml").write_text(skin)
    return path


def load_limb(folder: Path, skin: str | None = None) -> ArticulatedModel:
    """Write the limb and load it."""
    return load_model(write_limb(folder, skin), check=False)
