"""The free values of a pose tree as a filter's state: limits, prior, poses and silhouettes."""

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
    JointPrior,
    couplings_file,
    from_bounds,
    load_couplings,
    load_joint_prior,
    stack,
    warn_if_unlimited,
)
from drake_pose.filtering.state import StateLayout
from drake_pose.fit.parameters import BodyParameters
from drake_pose.fit.surfaces import MANY, simplify_rigid_parts
from drake_pose.search import slide_root
from drake_pose.silhouette.outline import PackedSurfaces, TreeSurfaces
from drake_pose.silhouette.scoring import draw_packed

Self = TypeVar("Self", bound="BodyState")

ROOT_SHIFT = ("root_shift_x", "root_shift_y", "root_shift_z")
"""Shift of the root in the world from its place in the pose tree [m]."""

LOG_SCALE = "log_scale"
"""Natural logarithm of the image scale relative to the parallel camera's."""

_ROOT = (*ROOT_SHIFT, LOG_SCALE)


class BodyState:
    """The free values of a pose tree as a filter's state x (n,), with cameras that observe them.

    A state holds the free values [rad or m], root shift and log scale, then the rates of all these.

    Args:
        root_moves: whether the root's position in the world is part of the state.
        scale_unknown: whether the scale of the one parallel camera is part of the state.
        prior_weight: weight of the joints' prior in each measurement.

    Attributes:
        layout: the tree's free values, then ROOT_SHIFT and LOG_SCALE, and their rates.
        prior: prior of the joints over the state's moving elements: the model's couplings file, and
            for other limited joints a normal distribution with the mean and variance of a uniform
            one between their limits.

    Raises:
        SettingsError: there is no camera, the tree has no free value, or a scale is unknown and
            there is not exactly one camera, a parallel one.
    """

    def __init__(
        self,
        tree: PoseTree,
        cameras: Sequence[Camera],
        root_moves: bool = False,
        scale_unknown: bool = False,
        prior_weight: float = 0.0,
    ) -> None:
        if not cameras:
            raise SettingsError("a body's state needs one camera or more")
        if scale_unknown and (len(cameras) != 1 or not isinstance(cameras[0], ParallelCamera)):
            raise SettingsError("an unknown scale needs exactly one camera, a parallel one")
        self.tree, self.cameras = tree, tuple(cameras)
        self._kinematics = TreeKinematics(tree)
        surfaces = TreeSurfaces(tree)
        self._whole = PackedSurfaces(surfaces)
        # Contours are compared with reduced surfaces, silhouettes are drawn with all triangles.
        # Beside bands of skin 160 triangles show a rigid part to a fraction of a pixel.
        compared = simplify_rigid_parts(surfaces, 160 if surfaces.bends else MANY)
        self._body = BodyParameters(self._kinematics, compared.rigid, surfaces=compared)
        free = self._kinematics.lower < self._kinematics.upper
        names = [n for n, is_free in zip(self._kinematics.names, free, strict=True) if is_free]
        root = (*(ROOT_SHIFT if root_moves else ()), *((LOG_SCALE,) if scale_unknown else ()))
        self.layout = StateLayout((*names, *root), ())
        if not len(self.layout):
            raise SettingsError(f"{tree.model.path}: its pose tree has no free value")
        self._root_moves = root_moves
        known = [*self._kinematics.names, *_ROOT]
        self._element_names = [*self.layout.moving]
        self._state_index = self.layout.indices(self._element_names)
        self._parameter_index = np.array(
            [known.index(name) for name in self._element_names], np.intp
        )
        self._values = self._kinematics.flatten(tree.default_values())
        self._known_shift = np.zeros(3)
        self.prior = self._joint_prior()
        phi, information = self.prior.phi, prior_weight / self.prior.deviation**2
        self._prior_information = (
            phi.T @ (information[:, None] * phi),
            phi.T @ (information * self.prior.mean),
        )

    def _joint_prior(self) -> JointPrior:
        """Return ``prior``."""
        kinematics = self._kinematics
        lower, upper = kinematics.lower, kinematics.upper
        limited = kinematics.is_angle & ~kinematics.covers_full_turn & (lower < upper)
        if self.tree.placements[0].rotation is not None:
            # The root's rotation is not a joint.
            limited &= kinematics.value_nodes > 0
        names, index = self._element_names, self._parameter_index
        file = couplings_file(self.tree.model.path)
        listed = JointPrior(np.zeros((0, len(names))), np.zeros(0), np.zeros(0))
        if file.is_file():
            listed = load_joint_prior(file, names)
        valued = np.flatnonzero((index < len(lower)) & ~listed.phi.any(axis=0))
        at = valued[limited[index[valued]]]
        low, high = lower[index[at]], upper[index[at]]
        return JointPrior(
            np.vstack([listed.phi, np.eye(len(names))[at]]),
            np.r_[listed.mean, 0.5 * (low + high)],
            np.r_[listed.deviation, (high - low) / math.sqrt(12.0)],
        )

    def is_angle(self, name: str) -> bool:
        """Return whether the element ``name`` is an angle; else it is a length or LOG_SCALE."""
        if name in _ROOT:
            return False
        return bool(self._kinematics.is_angle[self._kinematics.names.index(name)])

    def inequalities(self) -> Inequalities:
        """Return the limits of all free values, and inequalities of the model's couplings file.

        Angles that turn around have no limits. Inequalities that use other elements are left out.
        Warn (UserWarning) if there are none.

        Raises ModelError: the couplings file cannot be read.
        """
        kinematics, names, model = self._kinematics, self._element_names, self.tree.model
        lower, upper = (
            np.r_[limits, np.full(len(_ROOT), end)][self._parameter_index]
            for end, limits in ((-np.inf, kinematics.lower), (np.inf, kinematics.upper))
        )
        parts = [from_bounds(names, lower, upper)]
        file = couplings_file(model.path)
        if file.is_file():
            parts.append(load_couplings(file, model.position_names).restricted_to(names))
        return warn_if_unlimited(stack(parts, names), str(model.path))

    def with_root_position(self: Self, root_position: Array) -> Self:
        """Return a copy whose root is at another known position (3,) in the world [m]."""
        other = copy.copy(self)
        other._known_shift = np.asarray(root_position, dtype=np.float64) - self._root(self._values)
        return other

    def _root(self, values: Array) -> Array:
        """Return the position (3,) of the root in the tree [m] at the tree's values (m,)."""
        return self._kinematics.poses(values)[0, :3, 3]

    def node_values(self, x: Array) -> tuple[Array, ...]:
        """Return each node's values (k_i,) at a state (n,), wrapped into the limits.

        The state itself is not wrapped where an angle that turns around passes its limits.
        """
        return self._kinematics.split(self._kinematics.within_limits(self._split(x)[0]))

    def _split(self, x: Array) -> tuple[Array, Array]:
        """Return the tree's values (m,), and root shift and log scale (4,), of a state (n,)."""
        parameters = np.r_[self._values, np.zeros(len(_ROOT))]
        parameters[self._parameter_index] = x[self._state_index]
        count = len(self._values)
        parameters[count : count + 3] += self._known_shift
        return parameters[:count], parameters[count:]

    def scale(self, x: Array) -> float:
        """Return the image scale at a state (n,) relative to the camera's."""
        return math.exp(self._split(x)[1][3])

    def root_position(self, x: Array) -> Array:
        """Return the root's position (3,) in the world at a state (n,), body unscaled [m]."""
        values, root = self._split(x)
        p_WR = self._root(values) + root[:3]
        return p_WR if root[3] == 0.0 else slide_root(self._parallel(), p_WR, math.exp(-root[3]))

    def _parallel(self) -> ParallelCamera:
        """Return the camera whose scale is unknown."""
        camera = self.cameras[0]
        assert isinstance(camera, ParallelCamera)
        return camera

    def positions(self, x: Array) -> tuple[Array, Array]:
        """Return the plant's q (nq,) and X_WB (4, 4) at a state (n,), for the unscaled body.

        Raises ModelError: the base joints cannot reach the root's pose.
        """
        values = self.node_values(x)
        if np.any(self._split(x)[1]):
            return self.tree.positions_with_root_at(values, self.root_position(x))
        return self.tree.positions_from(values)

    def state(self, q: Array, X_WB: Array | None = None, scale: float = 1.0) -> Array:
        """Return the state (n,) at rest of a pose of the plant.

        If the root does not move, its position in the pose is ignored.

        ``q``: (nq,) plant positions. ``X_WB``: (4, 4) pose of the plant's world in the world; None:
        identity. ``scale``: image scale relative to the camera's.
        """
        values = self._kinematics.flatten(self.tree.values_from_positions(q, X_WB))
        root = np.append(self._known_shift, math.log(scale))
        if self._root_moves:
            model = self.tree.model
            link = model.link_index(self.tree.nodes[0].name)
            X_BR = PlantKinematics(model).pose_at(link, q)
            p_WR = (X_BR if X_WB is None else X_WB @ X_BR)[:3, 3]
            if scale != 1.0:
                p_WR = slide_root(self._parallel(), p_WR, scale)
            root[:3] = p_WR - self._root(values)
        return self.state_of(np.r_[values, root])

    def turned(self, x: Array, rotation: Array) -> Array:
        """Return the state x (n,) with the root rotated about its own origin.

        ``rotation``: (3, 3) in the world. Raises SettingsError: the root does not turn freely.
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
        """Return the squared Mahalanobis distance of a state (n,) from the joints' prior."""
        off = self.prior.phi @ x[self._state_index] - self.prior.mean
        return float(np.sum((off / self.prior.deviation) ** 2))

    def unwrapped(self, x: Array, last: Array) -> Array:
        """Return the state x (n,) with periodic angles in the turns nearest to ``last`` (n,)."""
        values = self._split(x)[0]
        turns = self._kinematics.nearest_turns(values, self._split(last)[0]) - values
        turned = x.copy()
        turned[self._state_index] += np.r_[turns, np.zeros(len(_ROOT))][self._parameter_index]
        return turned

    def difference(self, x: Array, views: Iterable[tuple[Camera, Mask]]) -> tuple[int, int]:
        """Compare the silhouettes of the body at a state x (n,) with masks.

        ``views``: pairs of a camera and its mask (H, W). Returns the number of pixels that differ,
        and the number of mask pixels, over all masks.
        """
        wrong, area = 0, 0
        for camera, mask in views:
            wrong += int(np.count_nonzero(self.draw(x, camera) != mask))
            area += int(np.count_nonzero(mask))
        return wrong, area

    def draw(self, x: Array, camera: Camera) -> Mask:
        """Return the silhouette (H, W) of the body at a state x (n,) in a camera's image."""
        X_WN = self._body.place(self.parameters(x)).X_WN
        # A band of skin bends by a fraction of an angle, so that full turns would change it.
        values = self._kinematics.within_limits(self._split(x)[0])
        return draw_packed(self._whole.at(values), camera.X_CW @ X_WN, camera)

    def parameters(self, x: Array) -> Array:
        """Return the parameters (m + 4,) of a state (n,): tree values, root shift and log scale."""
        return np.concatenate(self._split(x))

    def state_of(self, parameters: Array) -> Array:
        """Return the state (n,) at rest of parameters (m + 4,): the inverse of ``parameters``."""
        held = parameters.copy()
        held[len(self._values) : len(self._values) + 3] -= self._known_shift
        x = np.zeros(len(self.layout))
        x[self._state_index] = held[self._parameter_index]
        return x

    def node_poses(self, x: Array) -> Array:
        """Return X_WN (nodes, 4, 4) at a state (n,), scaled by its log scale."""
        return self._body.place(self.parameters(x)).X_WN
