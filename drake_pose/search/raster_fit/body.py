"""A pose tree ready for refinement: its parameters, the poses and motions of its surfaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_pose.body.tree.joint_kernel import PackedBand, PackedSteps, place_band
from drake_pose.body.tree.node_skin import NodeSkin
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import Motions, PackedTree, TreeKinematics, find_motions
from drake_pose.compiled import compiled, copy_into
from drake_pose.errors import SettingsError
from drake_pose.silhouette.areas.bending import TreeSurfaces
from drake_pose.silhouette.areas.outline import Outline, edge_records
from drake_pose.silhouette.contours.contour_body import move_surface

_EXTRA = 4


class PackedBands(NamedTuple):
    """All bands of a body one after the other; what is not told here is as in PackedBand.

    starts: (bands + 1, 4) int64 where each band's joints, levels, vertices and triangles begin;
    values: (bands, 2) int64 where its node's values begin and end; triangles: (t, 3) int32 indices
    into the band's own vertices.
    """

    starts: np.ndarray
    values: np.ndarray
    triangles: np.ndarray
    sizes: np.ndarray
    inverted: np.ndarray
    coefficient_starts: np.ndarray
    coefficients: np.ndarray
    levels: np.ndarray
    which: np.ndarray
    points: np.ndarray
    turned: np.ndarray


class Surfaces(NamedTuple):
    """What the poses of a body's surfaces are made of.

    tree: the pose tree; bands: its bands; nodes: (surfaces,) int64 the node of each surface, bands
    last; firsts: (bands, 2) int64 each band's first vertex and triangle among those of all
    surfaces; rooted: (nodes,) bool which go with the first root; turning: (m,) bool which of the
    tree's values move any of these.
    """

    tree: PackedTree
    bands: PackedBands
    nodes: np.ndarray
    firsts: np.ndarray
    rooted: np.ndarray
    turning: np.ndarray


def pack_bands(skins: Mapping[int, NodeSkin], columns: Sequence[np.ndarray]) -> PackedBands:
    """The bands in arrays.

    Args:
        skins: by node.
        columns: for each node the indices of its values.
    """
    packed = [skin.packed for skin in skins.values()]
    triangles = [np.zeros((0, 3), dtype=np.int32), *(skin.triangles for skin in skins.values())]
    counts = [
        (len(band.steps.sizes), len(band.levels), len(band.which), len(skin.triangles))
        for band, skin in zip(packed, skins.values(), strict=True)
    ]
    rows = np.cumsum([0, *(len(band.steps.coefficients) for band in packed)])
    values = [(columns[node][0], columns[node][-1] + 1) for node in skins]
    empty = np.zeros(0, dtype=np.int64)
    return PackedBands(
        starts=np.cumsum([(0, 0, 0, 0), *counts], axis=0).astype(np.int64),
        values=np.array(values, dtype=np.int64).reshape(-1, 2),
        triangles=np.concatenate(triangles),
        sizes=np.concatenate([empty, *(band.steps.sizes for band in packed)]),
        inverted=np.concatenate(
            [empty.astype(np.bool_), *(band.steps.inverted for band in packed)]
        ),
        coefficient_starts=np.concatenate(
            [empty, *(b.steps.starts + n for b, n in zip(packed, rows, strict=False))]
        ),
        coefficients=np.vstack([np.zeros((0, 16)), *(band.steps.coefficients for band in packed)]),
        levels=np.concatenate([np.zeros(0), *(band.levels for band in packed)]),
        which=np.concatenate([empty, *(band.which for band in packed)]),
        points=np.vstack([np.zeros((0, 3)), *(band.points for band in packed)]),
        turned=np.array([bool(band.turned[0]) for band in packed], dtype=np.bool_),
    )


@compiled
def place_nodes(surfaces: Surfaces, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses X_WN (nodes, 4, 4), scaled where the body has grown, and twists (m + 4, 7).

    Args:
        surfaces: the body.
        parameters: (m + 4,) the tree's values, the first root's shift and the logarithm of growth.
    """
    count = parameters.shape[0] - 4
    X_WN, turns = find_motions(surfaces.tree, parameters[:count])
    twists = np.zeros((count + 4, 7))
    copy_into(twists, turns)
    size = np.exp(parameters[count + 3])
    p_WR = X_WN[0, :3, 3].copy()
    shift = parameters[count : count + 3]
    center = p_WR + shift - size * p_WR
    for node in range(X_WN.shape[0]):
        if surfaces.rooted[node]:
            for i in range(3):
                for j in range(3):
                    X_WN[node, i, j] *= size
                X_WN[node, i, 3] = center[i] + size * X_WN[node, i, 3]
    for k in range(count):
        if surfaces.turning[k]:
            for i in range(3):
                a, b = (i + 1) % 3, (i + 2) % 3
                turned = twists[k, a] * center[b] - twists[k, b] * center[a]
                twists[k, 3 + i] = size * turns[k, 3 + i] - turned
    for i in range(3):
        twists[count + i, 3 + i] = 1.0
        twists[count + 3, 3 + i] = -(p_WR[i] + shift[i])
    twists[count + 3, 6] = 1.0
    return X_WN, twists


@compiled
def place_surfaces(
    surfaces: Surfaces,
    parameters: np.ndarray,
    bent: np.ndarray,
    points: np.ndarray,
    planes: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Poses X_WS (surfaces, 4, 4) and the twists (m + 4, 7); bends the bands.

    Args:
        surfaces: the body.
        parameters: (m + 4,).
        bent: (m + 4,) the parameters at which the bands are now; written.
        points, planes: those of a ContourBody of all surfaces; written.
    """
    bands = surfaces.bands
    for b in range(bands.values.shape[0]):
        first, end = bands.values[b]
        changed = False
        for k in range(first, end):
            changed = changed or parameters[k] != bent[k]
            bent[k] = parameters[k]
        if changed:
            s, level, v, t = bands.starts[b]
            s_end, level_end, v_end, t_end = bands.starts[b + 1]
            placed = np.empty((1, v_end - v, 3))
            band = PackedBand(
                PackedSteps(
                    bands.sizes[s:s_end], bands.inverted[s:s_end],
                    bands.coefficient_starts[s:s_end],
                    bands.coefficients,
                ), bands.levels[level:level_end], bands.which[v:v_end],
                bands.points[v:v_end], bands.turned[b : b + 1],
            )  # fmt: skip
            place_band(band, parameters[first:end].copy().reshape(1, end - first), placed)
            move_surface(
                points[surfaces.firsts[b, 0] :],
                planes[surfaces.firsts[b, 1] :],
                bands.triangles[t:t_end],
                placed[0],
            )
    X_WN, twists = place_nodes(surfaces, parameters)
    X_WS = np.empty((surfaces.nodes.shape[0], 4, 4))
    for s in range(X_WS.shape[0]):
        copy_into(X_WS[s], X_WN[surfaces.nodes[s]])
    return X_WS, twists


@dataclass(frozen=True, eq=False)
class Freedom:
    """The parameters that may change, and what they move; see Movements.

    Attributes:
        columns: (k,) int64 indices of the parameters.
        nodes: the nodes that they move.
        movers, own, mover_starts, moved: as in Movements.
    """

    columns: np.ndarray
    nodes: tuple[int, ...]
    movers: np.ndarray
    own: np.ndarray
    mover_starts: np.ndarray
    moved: np.ndarray


class RefinementBody:
    """A pose tree ready for refinement, made once and matched to many pictures.

    The parameters are the tree's m values and, after them, the shift of the first root along the
    world's axes [m] and the logarithm of the body's growth about it.

    Bands of skin are surfaces of their own, after those of the nodes.

    Attributes:
        tree: the pose tree.
        kinematics: its kinematics.
        outlines: the surfaces, each in its node's frame; bands as they are at rest.
        surface_nodes: (surfaces,) the node of each.
        skins: the nodes' bands of skin, by node, in the order of the surfaces.
        surfaces: what their poses are made of.
        weights: (v,) how far each vertex goes with its own node's values; 1 but in bands.
        lower, upper: (m + 4,) limits of the parameters; infinite where an angle turns around.

    Args:
        tree: the pose tree.
    """

    def __init__(self, tree: PoseTree) -> None:
        self.tree = tree
        self.kinematics = TreeKinematics(tree)
        self.skins = {i: node.skin for i, node in enumerate(tree.nodes) if node.skin is not None}
        bands = tuple(
            Outline(skin.mesh.vertices, skin.triangles, edge_records(skin.triangles))
            for skin in self.skins.values()
        )
        self.outlines = (*TreeSurfaces(tree).rigid, *bands)
        self.surface_nodes = np.array([*range(len(tree.nodes)), *self.skins])
        vertices = np.cumsum([0, *(len(outline.vertices) for outline in self.outlines)])
        triangles = np.cumsum([0, *(len(outline.triangles) for outline in self.outlines)])
        self.weights = np.ones(vertices[-1])
        for first, skin in zip(vertices[len(tree.nodes) :], self.skins.values(), strict=False):
            weights = 1.0 - skin.weights if skin.turned else skin.weights
            self.weights[first : first + len(weights)] = weights
        unlimited = np.full(_EXTRA, np.inf)
        self.lower = np.concatenate([self.kinematics.lower, -unlimited])
        self.upper = np.concatenate([self.kinematics.upper, unlimited])
        nodes = self.kinematics.value_nodes
        self._columns = [np.flatnonzero(nodes == node) for node in range(len(tree.nodes))]
        # What the parameters move does not depend on the pose.
        middle = np.clip(0.0, self.kinematics.lower, self.kinematics.upper)
        self._moves = self.kinematics.motions(middle, translation=True, scale=True).moves
        rooted = self._moves[:, -1].copy()
        self.surfaces = Surfaces(
            tree=self.kinematics.packed,
            bands=pack_bands(self.skins, self._columns),
            nodes=self.surface_nodes,
            firsts=np.column_stack([vertices, triangles])[len(tree.nodes) : -1].astype(np.int64),
            rooted=rooted,
            turning=np.asarray(self._moves[rooted, :-_EXTRA].any(axis=0)),
        )

    def parameters(
        self, node_values: Sequence[np.ndarray], root_position: np.ndarray | None = None
    ) -> np.ndarray:
        """The parameters (m + 4,) of a pose of the body's own size.

        Args:
            node_values: each node's values.
            root_position: (3,) where the first root is [m]; None: where the tree says.
        """
        parameters = np.zeros(len(self.lower))
        parameters[:-_EXTRA] = self.kinematics.flatten(node_values)
        if root_position is not None:
            parameters[-_EXTRA:-1] = root_position - self.poses(parameters)[0, :3, 3]
        return parameters

    def node_values(self, parameters: np.ndarray) -> tuple[np.ndarray, ...]:
        """Each node's values."""
        return self.kinematics.split(parameters[:-_EXTRA])

    def nearest_turns(self, parameters: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """The same pose's parameters, angles in the turn nearest to others (m + 4,).

        Without others, where answers are given: see ``TreeKinematics.nearest_turns``.
        """
        values = None if near is None else near[:-_EXTRA]
        turned = self.kinematics.nearest_turns(parameters[:-_EXTRA], values)
        return np.concatenate([turned, parameters[-_EXTRA:]])

    def columns(self, node: int) -> np.ndarray:
        """The indices of a node's values among the parameters."""
        return self._columns[node]

    def freedom(self, nodes: Sequence[int] | None = None, extra: Sequence[int] = ()) -> Freedom:
        """The values of some nodes that are not held, and some of the four parameters after them.

        Args:
            nodes: None for all.
            extra: 0, 1, 2 for the shift, 3 for growth.

        Raises:
            SettingsError: if ``extra`` names no parameter.
        """
        if not set(extra) <= set(range(_EXTRA)):
            raise SettingsError(f"extra parameters are 0, 1, 2 (shift) and 3 (growth), not {extra}")
        kinematics = self.kinematics
        chosen = kinematics.upper > kinematics.lower
        if nodes is not None:
            chosen &= np.isin(kinematics.value_nodes, list(nodes))
        columns = np.flatnonzero(chosen)
        columns = np.concatenate([columns, len(chosen) + np.array(sorted(extra), dtype=np.int64)])
        moves = self._moves[self.surface_nodes][:, columns]
        owners = np.concatenate([kinematics.value_nodes, np.full(_EXTRA, -1)])[columns]
        surfaces, movers = np.nonzero(moves)
        return Freedom(
            columns=columns,
            nodes=tuple(np.flatnonzero(self._moves[:, columns].any(axis=1)).tolist()),
            movers=movers.astype(np.int64),
            own=owners[movers] == self.surface_nodes[surfaces],
            mover_starts=np.cumsum([0, *moves.sum(axis=1)]),
            moved=np.asarray(moves.any(axis=1)),
        )

    def poses(self, parameters: np.ndarray) -> np.ndarray:
        """Poses X_WN (nodes, 4, 4), scaled where the body has grown."""
        return place_nodes(self.surfaces, parameters)[0]

    def motions(self, parameters: np.ndarray) -> Motions:
        """Poses X_WN, scaled where the body has grown, and motions of all parameters."""
        return Motions(*place_nodes(self.surfaces, parameters), self._moves)
