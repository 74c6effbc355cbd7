"""The report on a model file behind ``drake-pose check FILE``: its parts, warnings and errors."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.link_graph import build_link_graph
from drake_pose.body.meshes import TriangleMesh, is_watertight
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.parsing import summarise_warnings
from drake_pose.body.pose_tree import PoseTree
from drake_pose.errors import DrakePoseError, listed, weighted


@dataclass(frozen=True)
class ModelReport:
    """What a model file holds, what may be unexpected, and what forbids its use."""

    path: Path  # The model file.
    name: str  # The model's name; "" if the model cannot be used.
    # One dictionary for each node of the pose tree: ``name``, ``parent`` (its name, or "world"),
    # ``triangles`` (number of them), ``watertight`` (bool), ``joints``. A joint has ``name``,
    # ``kind`` (as ``position_kinds``), ``lower`` and ``upper`` limit [deg or m], and ``follows``:
    # multiplier, leader and offset [rad or m] as a text ("": none).
    nodes: tuple[dict[str, Any], ...]
    warnings: tuple[str, ...]  # What may be unexpected.
    errors: tuple[str, ...]  # Why the model cannot be used.

    @property
    def usable(self) -> bool:
        """Whether there is no error."""
        return not self.errors


def describe_model(
    path: Path | str, *, package_paths: Mapping[str, Path | str] | None = None
) -> ModelReport:
    """Return a report on a model file; a problem of the model becomes an entry of ``errors``.

    ``package_paths``: folders by package name, as for ``load_model``.
    """
    path = Path(path)
    try:
        model = load_model(path, package_paths=package_paths)
        tree = model.pose_tree()
    except DrakePoseError as error:
        return ModelReport(path, "", (), (), (str(error),))
    nodes, moved = [], {one.follower for one in tree.followers}
    enforced = moved | {one.leader for one in tree.followers}
    follows = {
        follower: f"{multiplier:g} {model.position_names[leader]} {offset:+g}"
        for follower, leader, multiplier, offset in model.couplings
        if follower in enforced
    }
    for node, placement in zip(tree.nodes, tree.placements, strict=True):
        following = moved & {one.follower for one in placement.follows}
        joints = []
        for position in (*node.positions, *sorted(following)):
            scale = 180.0 / math.pi if model.position_kinds[position] == "angle" else 1.0
            joint = {
                "name": model.position_names[position],
                "kind": model.position_kinds[position],
                "lower": float(model.lower[position] * scale),
                "upper": float(model.upper[position] * scale),
                "follows": follows.get(position, ""),
            }
            joints.append(joint)
        described = {
            "name": node.name,
            "parent": tree.nodes[node.parent].name if node.parent >= 0 else "world",
            "joints": joints,
            "triangles": len(node.mesh.triangles),
            "watertight": is_watertight(node.mesh),
        }
        nodes.append(described)
    return ModelReport(path, model.name, tuple(nodes), model_warnings(model, tree), ())


def model_warnings(model: ArticulatedModel, tree: PoseTree) -> tuple[str, ...]:
    """Return the warnings about a model and its pose tree, at most ten of each kind."""
    warnings = list(model.warnings)
    constraints = model.plant.num_constraints() - len(model.couplings)
    if constraints:
        warnings.append(
            f"{constraints} constraints between joints or links are written in the file; they are "
            "not enforced: each joint is searched independently; hold dependent joints (--hold), "
            "or write their dependence as <mimic>"
        )
    searched = {position for node in tree.nodes for position in node.positions} - {*tree.held}
    for follower, leader, *_ in model.couplings:
        if {follower, leader} <= searched:
            first, second = (model.position_names[k] for k in (follower, leader))
            warnings.append(
                f"joint '{first}' is written to follow joint '{second}' (<mimic>): not enforced, "
                "the joint is searched independently, because other joints move their links, too; "
                "hold it (--hold) if its position is known"
            )
    if tree.unobserved_positions and tree.root == "world":
        warnings.append(
            "these joints move no visual geometry and keep their default values; add geometry to "
            "their links to estimate them: " + ", ".join(tree.unobserved_positions)
        )
    poses = tree.node_poses(tree.default_values())
    pairs = zip(tree.nodes, poses, strict=True)
    placed = [(node.mesh.vertices, X) for node, X in pairs if not node.mesh.is_empty]
    corners = [vertices @ X[:3, :3].T + X[:3, 3] for vertices, X in placed]
    size = float(np.ptp(np.concatenate(corners), axis=0).max()) if corners else 1.0
    largest = 50.0  # Plausible extent [m]; the smallest is 1 / largest.
    if not 1.0 / largest <= size <= largest:
        warnings.append(
            f"the body is {size:.3g} m long from end to end; check that its lengths and the scale "
            "of its meshes are in metres"
        )
    warnings += tree.warnings
    leaky = [
        f"'{node.name}'"
        for node in tree.nodes
        if not node.mesh.is_empty and not is_watertight(node.mesh)
    ]
    if leaky:
        text = f"the meshes of {listed(leaky)} are not watertight: silhouettes may have gaps"
        warnings.append(weighted(f"{text}; close the meshes", "note"))
    return tuple(summarise_warnings(warnings + _symmetry_warnings(model)))


def _symmetry_warnings(model: ArticulatedModel) -> list[str]:
    """Return warnings about joints that rotate an outermost link about its axis of symmetry."""
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
                    "link's own axis of symmetry: no silhouette can show its angle; do not use it, "
                    "or hold it (--hold)"
                )
    return warnings


def _is_symmetric(
    mesh: TriangleMesh, X_turn: Array, levels: int = 12, sectors: int = 7, tolerance: float = 0.03
) -> bool:
    """Return whether a surface is rotationally symmetric about the axis of a quarter turn.

    The largest distance from the axis is compared between sectors, at each of several levels along
    the axis.

    ``mesh``: the surface. ``X_turn``: (4, 4) a quarter turn about the axis, in the mesh's frame.
    ``levels``: number of levels along the axis. ``sectors``: number of sectors about the axis; with
    seven sectors no square passes for round. ``tolerance``: largest difference between sectors, as
    a fraction of the largest distance.
    """
    axis = np.array([X_turn[2, 1], X_turn[0, 2], X_turn[1, 0]])
    axis -= (X_turn[1, 2], X_turn[2, 0], X_turn[0, 1])
    axis /= np.linalg.norm(axis)
    center = np.linalg.lstsq(np.eye(3) - X_turn[:3, :3], X_turn[:3, 3], rcond=None)[0]
    side = np.linalg.svd(axis[None])[2][1]
    # Points uniformly at random over the surface, with a fixed seed.
    corner, edge_u, edge_v = mesh.vertices[mesh.triangles].swapaxes(0, 1)
    edge_u, edge_v = edge_u - corner, edge_v - corner
    areas = np.cumsum(np.linalg.norm(np.cross(edge_u, edge_v), axis=1))
    random = np.random.default_rng(0).random((40_000, 3))
    chosen = np.searchsorted(areas, random[:, 0] * areas[-1])
    # Fold the outer half of each parallelogram back into its triangle.
    is_outer = random[:, 1:].sum(axis=1) > 1.0
    u, v = np.where(is_outer, 1.0 - random[:, 1:].T, random[:, 1:].T)[..., None]
    points = corner[chosen] + u * edge_u[chosen] + v * edge_v[chosen] - center
    height, x, y = points @ axis, points @ side, points @ np.cross(axis, side)
    radius = np.hypot(x, y)
    level = (height - height.min()) / max(float(np.ptp(height)), 1e-12) * levels
    sector = (np.arctan2(y, x) + np.pi) / (2.0 * np.pi) * sectors
    outline = np.zeros((levels, sectors))
    row = np.clip(level.astype(int), 0, levels - 1)
    column = np.clip(sector.astype(int), 0, sectors - 1)
    np.maximum.at(outline, (row, column), radius)
    return bool(np.ptp(outline, axis=1).max() < tolerance * radius.max())
