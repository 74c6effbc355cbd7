"""Where a band of skin is at given joint values.

A vertex of weight w lies where it would lie if it belonged to the child and the joints had gone
only w of their way: p_A(values) = X_AB(w values) p_B, with A the parent's frame, B the child's and
p_B its place at rest. For one joint that is the blend of dual quaternions; for several it never
collapses or jumps, however far they turn.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.tree.joint_map import ChainStep, chain_transforms
from drake_pose.errors import SettingsError

if TYPE_CHECKING:
    from drake_pose.body.tree.skin_kernel import PackedBand

# For derivatives by complex steps: so small that nothing but rounding is left of the error.
_STEP = 1e-30


@dataclass(frozen=True, eq=False)
class NodeSkin:
    """The band of skin between a node and its parent, in the node's frame N.

    Attributes:
        mesh: the closed band at rest (all joints at zero).
        weights: (v,) float64 read-only in 0..1: how far each vertex goes with the link that is
            farther from the plant's world: the node, or its parent where ``turned``.
        colour: (r, g, b) in 0..1.
        turned: whether the tree is turned over here, so that the node is the one nearer to the
            plant's world. The band is the same.
        steps: the joints from the node's parent to the node.
    """

    mesh: TriangleMesh
    weights: NDArray[np.float64]
    colour: tuple[float, float, float]
    turned: bool
    steps: tuple[ChainStep, ...]

    @property
    def triangles(self) -> NDArray[np.int32]:
        """(m, 3) int32, read-only, indices into the vertices, the same at all values."""
        return self.mesh.triangles

    def vertices(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The vertices (n, v, 3) [m] in the node's frame at its values (n, k) [rad or m]."""
        from drake_pose.body.tree.skin_kernel import place_band  # Slow to import: it needs numba.

        values = self._checked(values)
        placed = np.empty((len(values), len(self.weights), 3))
        place_band(self.packed, values, placed)
        return placed

    def derivatives(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """How the vertices move in the node's frame: (n, v, 3, k), [m/rad] or [m/m].

        Args:
            values: (n, k) the node's values [rad or m].
        """
        from drake_pose.body.tree.skin_kernel import place_band  # Slow to import: it needs numba.

        values = self._checked(values)
        moved = np.empty((len(values), len(self.weights), 3, values.shape[1]))
        placed = np.empty(moved.shape[:3], dtype=np.complex128)
        for column in range(values.shape[1]):
            stepped = values.astype(np.complex128)
            stepped[:, column] += 1j * _STEP
            place_band(self.packed, stepped, placed)
            moved[..., column] = placed.imag / _STEP
        return moved

    @cached_property
    def packed(self) -> "PackedBand":
        """The band in the kernel's arrays."""
        from drake_pose.body.tree.skin_kernel import pack_band  # Slow to import: it needs numba.

        points = self.mesh.vertices
        if self.turned:
            count = sum(step.joint_map.position_count for step in self.steps)
            X_PN = chain_transforms(self.steps, np.zeros((1, count)))[0]
            points = points @ X_PN[:3, :3].T + X_PN[:3, 3]
        return pack_band(self.steps, self.weights, points, turned=self.turned)

    def _checked(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values, after a check of their width."""
        count = sum(step.joint_map.position_count for step in self.steps)
        values = np.ascontiguousarray(values, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != count:
            raise SettingsError(f"values of shape (n, {count}) expected, got {values.shape}")
        return values


def join_surfaces(
    rigid: TriangleMesh, skin: NodeSkin | None, values: NDArray[np.float64]
) -> TriangleMesh:
    """A node's whole surface in its frame at its values (k,): rigid part, then band."""
    if skin is None:
        return rigid
    bent = skin.vertices(np.asarray(values)[None])[0]
    return TriangleMesh(
        np.concatenate([rigid.vertices, bent]),
        np.concatenate([rigid.triangles, skin.triangles + len(rigid.vertices)]),
    )
