"""Is this model fit for use, and if not, why: the facts behind ``drake-pose check FILE``."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.link_graph import build_link_graph
from drake_pose.body.meshes import TriangleMesh, is_watertight
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.parsing import limit_kinds
from drake_pose.body.pose_tree import PoseTree
from drake_pose.errors import DrakePoseError

_SYMMETRY_TOLERANCE = 0.03
_LEVELS = 12
# Seven, so that a square or hexagonal cross-section does not pass for round.
_SECTORS = 7


@dataclass(frozen=True)
class JointReport:
    """One position: its name, kind, and limits in degrees (angles) or metres (lengths).

    ``follows``: the joint that it follows, and how in rad and m; empty: none.
    """

    name: str
    kind: str
    lower: float
    upper: float
    follows: str = ""


@dataclass(frozen=True)
class NodeReport:
    """One node of the pose tree."""

    name: str
    parent: str
    joints: tuple[JointReport, ...]
    triangles: int
    watertight: bool


@dataclass(frozen=True)
class ModelReport:
    """What was found in a model file: the plant's nodes, surprises, and what forbids its use."""

    path: Path
    name: str
    nodes: tuple[NodeReport, ...]
    warnings: tuple[str, ...]
    errors: tuple[str, ...]

    @property
    def usable(self) -> bool:
        """True where there is no error."""
        return not self.errors


def describe_model(
    path: Path | str, *, package_paths: Mapping[str, Path | str] | None = None
) -> ModelReport:
    """Read a model and report on it; problems of the model become ``errors``, never exceptions."""
    path = Path(path)
    try:
        model = load_model(path, package_paths=package_paths)
        tree = model.pose_tree()
    except DrakePoseError as error:
        return ModelReport(path, "", (), (), (str(error),))
    return ModelReport(
        path=path,
        name=model.name,
        nodes=tuple(_node_report(tree, index) for index in range(len(tree.nodes))),
        warnings=model_warnings(model, tree),
        errors=(),
    )


def _node_report(tree: PoseTree, index: int) -> NodeReport:
    """The facts of one node."""
    model, node = tree.model, tree.nodes[index]
    led = {one.follower for one in tree.placements[index].follows}
    follows = {
        one.follower: f"{one.multiplier:g} {model.position_names[one.leader]} {one.offset:+g}"
        for one in tree.followers
        if one.follower in led
    }
    joints = []
    for position in (*node.positions, *follows):
        name = model.position_names[position]
        kind = model.position_kinds[position]
        scale = 180.0 / math.pi if kind == "angle" else 1.0
        lower, upper = model.lower[position] * scale, model.upper[position] * scale
        limits = float(lower), float(upper)
        joints.append(JointReport(name, kind, *limits, follows.get(position, "")))
    return NodeReport(
        name=node.name,
        parent=tree.nodes[node.parent].name if node.parent >= 0 else "world",
        joints=tuple(joints),
        triangles=len(node.mesh.triangles),
        watertight=is_watertight(node.mesh),
    )


def model_warnings(
    model: ArticulatedModel, tree: PoseTree, given: Iterable[str] = ()
) -> tuple[str, ...]:
    """Everything worth knowing before a model is used, at most ten warnings of a kind.

    ``given`` names the positions that are held as the user wants.
    """
    warnings = list(model.warnings)
    constraints = model.plant.num_constraints() - len(model.couplings)
    if constraints:
        warnings.append(
            f"{constraints} constraints between joints or links are written in the file; they are "
            "not enforced: every joint is searched by itself"
        )
    searched = {position for node in tree.nodes for position in node.positions} - {*tree.held}
    for follower, leader, *_ in model.couplings:
        if {follower, leader} <= searched:
            one, other = (model.position_names[k] for k in (follower, leader))
            warnings.append(
                f"joint '{one}' is written to follow joint '{other}' (<mimic>): not enforced, it "
                "is searched by itself, because other joints move their links, too"
            )
    if tree.unobserved_positions and tree.root == "world":
        warnings.append(
            "these joints move nothing that is seen and keep their default values: "
            + ", ".join(tree.unobserved_positions)
        )
    slides = [
        model.position_names[position]
        for position, value in tree.held.items()
        if np.isinf(model.upper[position] - model.lower[position])
        and value == model.default_positions[position]
    ]
    if slides := [name for name in slides if name not in set(given)]:
        warnings.append(
            "these joints have no limits: they say where the object stands and keep their default "
            "values, and a root position moves it: " + ", ".join(slides)
        )
    warnings += [
        f"link '{node.name}' is not watertight: its silhouette may have gaps"
        for node in tree.nodes
        if not node.mesh.is_empty and not is_watertight(node.mesh)
    ]
    return tuple(limit_kinds(warnings + _symmetry_warnings(model)))


def _symmetry_warnings(model: ArticulatedModel) -> list[str]:
    """Joints that turn a leaf of the plant about its own axis of symmetry: they cannot be seen."""
    graph = build_link_graph(model, None)
    warnings = []
    for edge in graph.edges:
        group = graph.groups[edge.outer]
        last = not any(other.inner == edge.outer for other in graph.edges)
        if not last or edge.joint_map is None or group.mesh.is_empty:
            continue
        for column, position in enumerate(edge.positions):
            if model.position_kinds[position] != "angle":
                continue
            values = np.zeros((2, len(edge.positions)))
            values[1, column] = math.pi / 2.0
            X = edge.joint_map.transforms(values)
            if _is_symmetric(group.mesh, np.linalg.inv(X[0]) @ X[1]):
                warnings.append(
                    f"joint '{model.position_names[position]}' turns link '{group.name}' about the "
                    "link's own axis of symmetry: no silhouette can show its angle"
                )
    return warnings


def _is_symmetric(mesh: TriangleMesh, X_turn: Array) -> bool:
    """Whether a surface looks the same from all around the axis of a quarter turn X_turn."""
    axis = np.array([X_turn[2, 1], X_turn[0, 2], X_turn[1, 0]])
    axis -= (X_turn[1, 2], X_turn[2, 0], X_turn[0, 1])
    axis /= np.linalg.norm(axis)
    center = np.linalg.lstsq(np.eye(3) - X_turn[:3, :3], X_turn[:3, 3], rcond=None)[0]
    side = np.linalg.svd(axis[None])[2][1]
    # At each height the largest distance from the axis is the same in every direction.
    points = _sample_surface(mesh, 40_000) - center
    height, x, y = points @ axis, points @ side, points @ np.cross(axis, side)
    radius = np.hypot(x, y)
    level = (height - height.min()) / max(float(np.ptp(height)), 1e-12) * _LEVELS
    sector = (np.arctan2(y, x) + np.pi) / (2.0 * np.pi) * _SECTORS
    outline = np.zeros((_LEVELS, _SECTORS))
    row = np.clip(level.astype(int), 0, _LEVELS - 1)
    column = np.clip(sector.astype(int), 0, _SECTORS - 1)
    np.maximum.at(outline, (row, column), radius)
    return bool(np.ptp(outline, axis=1).max() < _SYMMETRY_TOLERANCE * radius.max())


def _sample_surface(mesh: TriangleMesh, count: int) -> Array:
    """Points (count, 3) [m] spread evenly at random over a surface, the same ones each time."""
    corner, along, across = mesh.vertices[mesh.triangles].swapaxes(0, 1)
    along, across = along - corner, across - corner
    areas = np.cumsum(np.linalg.norm(np.cross(along, across), axis=1))
    random = np.random.default_rng(0).random((count, 3))
    hit = np.searchsorted(areas, random[:, 0] * areas[-1])
    # Beyond the third side a parallelogram's half is folded back.
    beyond = random[:, 1:].sum(axis=1) > 1.0
    u, v = np.where(beyond, 1.0 - random[:, 1:].T, random[:, 1:].T)[..., None]
    return np.asarray(corner[hit] + u * along[hit] + v * across[hit])
