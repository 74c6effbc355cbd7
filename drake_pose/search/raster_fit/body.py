"""A pose tree ready for refinement: parameters, their limits, and what moves with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import Motions, TreeKinematics
from drake_pose.errors import SettingsError
from drake_pose.search.raster_fit.placing import Surfaces, pack_bands, place_nodes
from drake_pose.silhouette.areas.bending import TreeSurfaces
from drake_pose.silhouette.areas.outline import Outline, edge_records

_EXTRA = 4


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
