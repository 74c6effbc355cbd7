"""A pose tree's values as a state: what moves, its limits, and where it puts a body."""

import copy
import math
from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body import PlantKinematics, PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.filtering.inequalities import (
    Inequalities,
    UsualPose,
    couplings_file,
    from_bounds,
    load_couplings,
    load_usual_pose,
    say_if_unlimited,
    stack,
)
from drake_pose.filtering.state import StateLayout
from drake_pose.fit.parameters import BodyParameters
from drake_pose.fit.surfaces import MANY, simplify_rigid_parts
from drake_pose.search import slide_root
from drake_pose.silhouette.outline import PackedSurfaces, TreeSurfaces
from drake_pose.silhouette.scoring import draw_packed

Self = TypeVar("Self", bound="BodyState")

ROOT_SHIFT = ("root_shift_x", "root_shift_y", "root_shift_z")
"""Where the root is in the world, beside where its tree holds it [m]."""

LOG_SCALE = "log_scale"
"""The logarithm of how much larger the body is seen than a parallel camera's scale says."""

_ROOT = (*ROOT_SHIFT, LOG_SCALE)


class BodyState:
    """The values of a pose tree that are free to move, as a state, seen by cameras.

    Args:
        moves: whether the root may be elsewhere than where the tree holds it.
        grows: whether the scale of the one parallel camera is unknown.
        rest: with so much weight each measurement also says that joints are held as usual.

    Attributes:
        layout: the state: the tree's values that are free to move, then ROOT_SHIFT and LOG_SCALE,
            and their rates.
        usual: how joints are usually held, about the state's moving elements: what the model's
            couplings file says, and about the middle of their limits, as evenly spread as these are
            wide, where it says nothing.

    Raises:
        SettingsError: no camera; the tree has no value to estimate; or a scale is unknown and there
            is not one parallel camera.
    """

    def __init__(
        self,
        tree: PoseTree,
        cameras: Sequence[Camera],
        moves: bool = False,
        grows: bool = False,
        rest: float = 0.0,
    ) -> None:
        if not cameras:
            raise SettingsError("a contour needs one camera or more")
        if grows and (len(cameras) != 1 or not isinstance(cameras[0], ParallelCamera)):
            raise SettingsError("a scale can be tracked only in one parallel camera's masks")
        self.tree, self.cameras = tree, tuple(cameras)
        self._kinematics = TreeKinematics(tree)
        surfaces = TreeSurfaces(tree)
        self._whole = PackedSurfaces(surfaces)
        # Few triangles are compared; what is drawn has all of them. Beside bands of skin 160 show
        # a rigid part to a fraction of a pixel.
        compared = simplify_rigid_parts(surfaces, 160 if surfaces.bends else MANY)
        self._body = BodyParameters(self._kinematics, compared.rigid, surfaces=compared)
        free = self._kinematics.lower < self._kinematics.upper
        names = [n for n, is_free in zip(self._kinematics.names, free, strict=True) if is_free]
        root = (*(ROOT_SHIFT if moves else ()), *((LOG_SCALE,) if grows else ()))
        self.layout = StateLayout((*names, *root), ())
        if not len(self.layout):
            raise SettingsError(f"{tree.model.path}: all values of its tree are held")
        self._moves = moves
        known = [*self._kinematics.names, *_ROOT]
        self._seen_names = [*self.layout.moving]
        self._state_index = self.layout.indices(self._seen_names)
        self._parameter_index = np.array([known.index(name) for name in self._seen_names], np.intp)
        self._values = self._kinematics.flatten(tree.default_values())
        self._known_shift = np.zeros(3)
        self.usual = self._find_usual()
        phi, information = self.usual.phi, rest / self.usual.deviation**2
        self._rest = phi.T @ (information[:, None] * phi), phi.T @ (information * self.usual.mean)

    def _find_usual(self) -> UsualPose:
        kinematics = self._kinematics
        lower, upper = kinematics.lower, kinematics.upper
        limited = kinematics.is_angle & ~kinematics.turns_around & (lower < upper)
        if self.tree.placements[0].rotation is not None:
            # How the root is turned is no joint's.
            limited &= kinematics.value_nodes > 0
        names, index = self._seen_names, self._parameter_index
        file = couplings_file(self.tree.model.path)
        told = UsualPose(np.zeros((0, len(names))), np.zeros(0), np.zeros(0))
        if file.is_file():
            told = load_usual_pose(file, names)
        valued = np.flatnonzero((index < len(lower)) & ~told.phi.any(axis=0))
        at = valued[limited[index[valued]]]
        low, high = lower[index[at]], upper[index[at]]
        return UsualPose(
            np.vstack([told.phi, np.eye(len(names))[at]]),
            np.r_[told.mean, 0.5 * (low + high)],
            np.r_[told.deviation, (high - low) / math.sqrt(12.0)],
        )

    def is_angle(self, name: str) -> bool:
        """Whether an element is an angle [rad], else it is a length [m]."""
        if name in _ROOT:
            return False
        return bool(self._kinematics.is_angle[self._kinematics.names.index(name)])

    def inequalities(self) -> Inequalities:
        """The limits of all values, and the couplings of the model's file if it has one.

        Angles that can take every direction have no limits.

        Raises:
            ModelError: the couplings file cannot be read.
        """
        kinematics, names, model = self._kinematics, self._seen_names, self.tree.model
        lower, upper = (
            np.r_[limits, np.full(len(_ROOT), end)][self._parameter_index]
            for end, limits in ((-np.inf, kinematics.lower), (np.inf, kinematics.upper))
        )
        parts = [from_bounds(names, lower, upper)]
        file = couplings_file(model.path)
        if file.is_file():
            parts.append(load_couplings(file, model.position_names).only_of(names))
        return say_if_unlimited(stack(parts, names), str(model.path))

    def with_root_position(self: Self, root_position: Array) -> Self:
        """The same with the root at another known position (3,) in the world [m]."""
        other = copy.copy(self)
        other._known_shift = np.asarray(root_position, dtype=np.float64) - self._root(self._values)
        return other

    def _root(self, values: Array) -> Array:
        """(3,) where the tree holds its root [m]."""
        return self._kinematics.poses(values)[0, :3, 3]

    def node_values(self, x: Array) -> tuple[Array, ...]:
        """Each node's values (k_i,) of a state (n,), inside the limits.

        The state itself goes on where an angle that can take every direction passes its limits.
        """
        return self._kinematics.split(self._kinematics.within_limits(self._split(x)[0]))

    def _split(self, x: Array) -> tuple[Array, Array]:
        """The tree's values (m,), and the root's shift and growth (4,), of a state (n,)."""
        parameters = np.r_[self._values, np.zeros(len(_ROOT))]
        parameters[self._parameter_index] = x[self._state_index]
        count = len(self._values)
        parameters[count : count + 3] += self._known_shift
        return parameters[:count], parameters[count:]

    def scale(self, x: Array) -> float:
        """So many times the pixels a metre that it was given with the camera has."""
        return math.exp(self._split(x)[1][3])

    def root_position(self, x: Array) -> Array:
        """(3,) where the root is in the world, the body in its own size [m]."""
        values, root = self._split(x)
        p_WR = self._root(values) + root[:3]
        return p_WR if root[3] == 0.0 else slide_root(self._parallel(), p_WR, math.exp(-root[3]))

    def _parallel(self) -> ParallelCamera:
        """The camera whose scale is unknown."""
        camera = self.cameras[0]
        assert isinstance(camera, ParallelCamera)
        return camera

    def positions(self, x: Array) -> tuple[Array, Array]:
        """The plant's q (nq,) and X_WB (4, 4) of a state (n,), the body in its own size.

        Raises:
            ModelError: the base joints cannot hold the root where it is.
        """
        values = self.node_values(x)
        if np.any(self._split(x)[1]):
            return self.tree.positions_with_root_at(values, self.root_position(x))
        return self.tree.positions_from(values)

    def state(self, q: Array, X_WB: Array | None = None, scale: float = 1.0) -> Array:
        """(n,) a state at rest of positions (nq,), the plant's world at X_WB (4, 4) and a scale."""
        values = self._kinematics.flatten(self.tree.values_from_positions(q, X_WB))
        root = np.append(self._known_shift, math.log(scale))
        if self._moves:
            model = self.tree.model
            link = model.link_index(self.tree.nodes[0].name)
            X_BR = PlantKinematics(model).pose_at(link, q)
            p_WR = (X_BR if X_WB is None else X_WB @ X_BR)[:3, 3]
            if scale != 1.0:
                p_WR = slide_root(self._parallel(), p_WR, scale)
            root[:3] = p_WR - self._root(values)
        return self.state_of(np.r_[values, root])

    def turned(self, x: Array, rotation: Array) -> Array:
        """(n,) the state whose root is turned about its origin by (3, 3) in the world.

        Raises:
            SettingsError: the tree's root does not turn freely.
        """
        placed = self.tree.placements[0]
        if placed.rotation is None or not self.tree.turns_root_freely:
            raise SettingsError("only a pose tree whose root turns freely can be turned")
        parameters = self.parameters(x)
        R_WR = rotation @ self._kinematics.poses(self._split(x)[0])[0, :3, :3]
        parameters[:3] = placed.rotation.values_from(placed.X_PA[:3, :3].T @ R_WR)
        turned = x.copy()
        turned[self._state_index] = self.state_of(parameters)[self._state_index]
        return turned

    def prior_distance(self, x: Array) -> float:
        """The squared Mahalanobis distance of a state (n,) to how joints are usually held."""
        off = self.usual.phi @ x[self._state_index] - self.usual.mean
        return float(np.sum((off / self.usual.deviation) ** 2))

    def continued(self, x: Array, last: Array) -> Array:
        """The same pose (n,), angles that turn around in the turns nearest to the last state's."""
        values = self._split(x)[0]
        turns = self._kinematics.nearest_turns(values, self._split(last)[0]) - values
        turned = x.copy()
        turned[self._state_index] += np.r_[turns, np.zeros(len(_ROOT))][self._parameter_index]
        return turned

    def difference(self, x: Array, seen: Iterable[tuple[Camera, Mask]]) -> tuple[int, int]:
        """How many pixels differ between a state's body (n,) and masks, and how many these have."""
        wrong, area = 0, 0
        for camera, mask in seen:
            wrong += int(np.count_nonzero(self.draw(x, camera) != mask))
            area += int(np.count_nonzero(mask))
        return wrong, area

    def draw(self, x: Array, camera: Camera) -> Mask:
        """(H, W) what a camera would see of the body at a state (n,)."""
        X_WN = self._body.place(self.parameters(x)).X_WN
        # A band of skin bends by a share of an angle: full turns beyond its limits would show.
        values = self._kinematics.within_limits(self._split(x)[0])
        return draw_packed(self._whole.at(values), camera.X_CW @ X_WN, camera)

    def parameters(self, x: Array) -> Array:
        """The tree's values, the root's shift and the logarithm of growth (m + 4,) of a state."""
        return np.concatenate(self._split(x))

    def state_of(self, parameters: Array) -> Array:
        """(n,) a state at rest of parameters (m + 4,): the inverse of ``parameters``."""
        held = parameters.copy()
        held[len(self._values) : len(self._values) + 3] -= self._known_shift
        x = np.zeros(len(self.layout))
        x[self._state_index] = held[self._parameter_index]
        return x

    def node_poses(self, x: Array) -> Array:
        """X_WN (nodes, 4, 4) at a state (n,), scaled by its growth."""
        return self._body.place(self.parameters(x)).X_WN
