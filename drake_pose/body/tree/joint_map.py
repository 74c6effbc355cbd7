"""A joint's values to transforms: measured from Drake's plant once, then evaluated on arrays.

Every entry of the transform of the supported joints is, in each position separately, a combination
of 1, cos q, sin q and q, so the plant at four values of each position determines it for all values.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import ModelError

_SAMPLES = np.array([0.0, np.pi / 2.0, np.pi, -np.pi / 2.0])


def inverse_transforms(X: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses of rigid transforms (..., 4, 4)."""
    inverse = np.zeros_like(X)
    R_transposed = np.swapaxes(X[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = R_transposed
    inverse[..., :3, 3] = -(R_transposed @ X[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


@dataclass(frozen=True)
class JointMap:
    """The pose X_AC(values) of a joint's outer link frame C in its inner link frame A.

    ``coefficients``: (4^k, 16), a row for each product of basis functions of the k positions.
    """

    coefficients: NDArray[np.float64]
    position_count: int

    @staticmethod
    def measure(
        pose: Callable[[NDArray[np.float64]], NDArray[np.float64]], position_count: int, name: str
    ) -> "JointMap":
        """Determine the map from X_AC (4, 4) of the plant at given values (k,), k at most three.

        Raises ModelError, which names the joint, where it does not move as this class assumes.
        """
        samples = np.array(list(itertools.product(_SAMPLES, repeat=position_count)))
        samples = samples.reshape(-1, position_count)
        measured = np.array([pose(values).reshape(16) for values in samples])
        inverse = np.linalg.inv(_basis(_SAMPLES))
        kronecker: NDArray[Any] = np.eye(1)
        for _ in range(position_count):
            kronecker = np.kron(kronecker, inverse)
        joint_map = JointMap(kronecker @ measured, position_count)
        probe = np.array([0.7, -1.1, 2.3])[:position_count]
        error = np.abs(joint_map.transforms(probe[None])[0] - pose(probe)).max()
        if error > 1e-9:
            raise ModelError(f"joint '{name}' moves in a way that drake_pose does not know")
        return joint_map

    def transforms(self, values: NDArray[Any]) -> NDArray[Any]:
        """X_AC (n, 4, 4) at values (n, k) [rad or m], which may be complex."""
        products = np.ones((len(values), 1))
        for column in range(self.position_count):
            basis = _basis(values[:, column])
            products = (products[:, :, None] * basis[:, None, :]).reshape(len(values), -1)
        X = (products @ self.coefficients).reshape(-1, 4, 4)
        X[:, 3] = (0.0, 0.0, 0.0, 1.0)
        return X


@dataclass(frozen=True)
class ChainStep:
    """One joint on the way from a node's parent to the node; walked inwards if inverted."""

    joint_map: JointMap
    inverted: bool


def chain_transforms(steps: Sequence[ChainStep], values: NDArray[Any]) -> NDArray[Any]:
    """X (n, 4, 4) over several joints in turn, at their values (n, k), which may be complex."""
    X: NDArray[Any] = np.broadcast_to(np.eye(4), (len(values), 4, 4))
    start = 0
    for step in steps:
        stop = start + step.joint_map.position_count
        X_step = step.joint_map.transforms(values[:, start:stop])
        X = X @ (inverse_transforms(X_step) if step.inverted else X_step)
        start = stop
    return X


def _basis(values: NDArray[Any]) -> NDArray[Any]:
    """The basis functions (n, 4): 1, cos q, sin q, q."""
    return np.stack([np.ones_like(values), np.cos(values), np.sin(values), values], axis=-1)
