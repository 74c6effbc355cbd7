"""Small models for the tests of drake_pose.body, as texts and as files."""

from pathlib import Path

import trimesh

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


# A floating trunk; an arm of two joints through a link without geometry, then a prismatic hand.
FLOATING_URDF = urdf(
    link("trunk"),
    link("between", ""),
    link("arm"),
    link("hand"),
    link("welded", SPHERE),
    link("leg"),
    link("toe", ""),
    joint("shoulder_x", "revolute", "trunk", "between", axis="1 0 0"),
    joint("shoulder_y", "revolute", "between", "arm", axis="0 1 0"),
    joint("slide", "prismatic", "arm", "hand", axis="0 1 1", limits='lower="-0.2" upper="0.3"'),
    joint("fix", "fixed", "hand", "welded", limits=None),
    joint("hip", "continuous", "trunk", "leg", axis="1 1 0", limits=None),
    joint("toe_joint", "revolute", "leg", "toe"),
)

# The same kind of body on three prismatic and three revolute joints instead.
JOINTED_BASE_URDF = urdf(
    *(link(name, "") for name in ("bx", "by", "bz", "ry", "rz")),
    link("head"),
    link("chest"),
    link("arm"),
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
    link("base"),
    link("upper"),
    link("lower"),
    joint("mount", "fixed", "world", "base", limits=None),
    joint("a1", "revolute", "base", "upper", axis="0 0 1"),
    joint("a2", "revolute", "upper", "lower", axis="0 1 0"),
)


def _sdf_link(name: str) -> str:
    return (
        f'<link name="{name}"><pose>0.1 0.2 0.3 0.4 0.5 0.6</pose><visual name="v"><geometry>'
        "<box><size>0.1 0.2 0.3</size></box></geometry></visual></link>"
    )


def _limits(lower: float, upper: float) -> str:
    return f"<limit><lower>{lower}</lower><upper>{upper}</upper><effort>0</effort></limit>"


# Every other joint type: universal, ball, screw, and a revolute one whose parent is outermost.
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


def cube_obj(*, normals: bool) -> str:
    """A cube of edge 1 whose every triangle has its own vertices."""
    cube = trimesh.creation.box()
    cube.unmerge_vertices()
    return str(trimesh.exchange.obj.export_obj(cube, include_normals=normals))
