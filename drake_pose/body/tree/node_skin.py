"""Gives the bands that a model declares to the nodes of a pose tree, and poses them for Drake."""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.surfaces.skin_file import SkinBand, skin_file
from drake_pose.body.tree.joint_map import ChainStep, chain_transforms, inverse_transforms
from drake_pose.body.tree.link_graph import LinkGraph, PlantKinematics, build_link_graph
from drake_pose.body.tree.skin_motion import NodeSkin
from drake_pose.errors import ModelError


def find_skin(
    model: ParsedModel,
    graph: LinkGraph,
    parent: int,
    group: int,
    steps: tuple[ChainStep, ...],
) -> NodeSkin | None:
    """The band between two groups that are a node's parent and the node; None where there is none.

    Args:
        model: the model.
        graph: its links and joints.
        parent, group: the two groups.
        steps: the joints from the one to the other.
    """
    for band in model.skin:
        ends = (graph.group_of(band.parent), graph.group_of(band.child))
        if ends not in ((parent, group), (group, parent)):
            continue
        turned = ends != (parent, group)
        mesh = band.mesh.transformed(_pose_in_group(model, graph, band.child))
        if turned:
            count = sum(step.joint_map.position_count for step in steps)
            mesh = mesh.transformed(_inverse_at_rest(steps, count))
        return NodeSkin(mesh, band.weights, band.colour, turned, steps)
    return None


def require_placed(
    model: ParsedModel, graph: LinkGraph, pairs: Collection[tuple[int, int]]
) -> None:
    """Refuse a model with a band that no node of the tree carries.

    Args:
        model: the model.
        graph: its links and joints.
        pairs: the groups of each node's parent and the node.

    Raises:
        ModelError: names the band.
    """
    for band in model.skin:
        ends = (graph.group_of(band.parent), graph.group_of(band.child))
        if ends not in pairs and ends[::-1] not in pairs:
            raise ModelError(
                f"{skin_file(model.path)}: band '{band.parent}' - '{band.child}': these are not "
                "neighbours; a band joins two links with geometry that have joints, and no other "
                "link with geometry, between them"
            )


def _pose_in_group(model: ParsedModel, graph: LinkGraph, link: str) -> NDArray[np.float64]:
    """The pose (4, 4) of a link in the frame of its group."""
    kinematics = PlantKinematics(model)
    body = graph.groups[graph.group_of(link)].body
    return inverse_transforms(kinematics.pose(body)) @ kinematics.pose(model.link_index(link))


def _inverse_at_rest(steps: tuple[ChainStep, ...], count: int) -> NDArray[np.float64]:
    """The inverse of a chain's transform (4, 4) with all its positions at zero."""
    rest: NDArray[np.float64] = chain_transforms(steps, np.zeros((1, count)))[0]
    return inverse_transforms(rest)


class ModelSkin:
    """The bands of a model in the frame of the plant's world, as Drake and Meshcat want them.

    Attributes:
        bands: the bands, as the model declares them.

    Args:
        model: the model.

    Raises:
        ModelError: a band does not join two neighbours.
    """

    def __init__(self, model: ParsedModel) -> None:
        self.bands: tuple[SkinBand, ...] = model.skin
        self._model = model
        self._kinematics = PlantKinematics(model)
        graph = build_link_graph(model, None)
        self._parts: list[tuple[int, tuple[int, ...], NodeSkin]] = []
        for band in model.skin:
            steps, positions = _chain(model, graph, band)
            ends = (graph.group_of(band.parent), graph.group_of(band.child))
            skin = find_skin(model, graph, *ends, steps)
            if skin is not None:
                self._parts.append((graph.groups[ends[1]].body, positions, skin))

    @property
    def meshes(self) -> tuple[TriangleMesh, ...]:
        """The bands at rest, each in its child's frame."""
        return tuple(band.mesh for band in self.bands)

    def vertices(self, q: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Each band's vertices (v, 3) [m] in the plant's world at positions q (nq,)."""
        placed = []
        for body, positions, skin in self._parts:
            X_BN = self._kinematics.pose_at(body, q)
            p_N = skin.vertices(q[None, list(positions)])[0]
            placed.append(p_N @ X_BN[:3, :3].T + X_BN[:3, 3])
        return placed


def _chain(
    model: ParsedModel, graph: LinkGraph, band: SkinBand
) -> tuple[tuple[ChainStep, ...], tuple[int, ...]]:
    """The joints outwards from a band's parent to its child, and their positions."""
    inner, outer = graph.group_of(band.parent), graph.group_of(band.child)
    steps: list[ChainStep] = []
    positions: list[int] = []
    group = outer
    while group != inner:
        edge = next((edge for edge in graph.edges if edge.outer == group), None)
        if edge is None or edge.joint_map is None:
            raise ModelError(
                f"{skin_file(model.path)}: band '{band.parent}' - '{band.child}': no joints lead "
                "outwards from the one to the other; are they exchanged?"
            )
        steps.insert(0, ChainStep(edge.joint_map, inverted=False))
        positions = [*edge.positions, *positions]
        group = edge.inner
    return tuple(steps), tuple(positions)
