"""The contour of any model in any number of masks, as a measurement of its pose."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body import PoseTree
from drake_pose.body.tree.link_graph import PlantKinematics
from drake_pose.body.tree.tree_kinematics import Motions, TreeKinematics
from drake_pose.camera import Camera
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.measurements.contour_edges import find_edges
from drake_pose.filtering.state import Belief, StateLayout
from drake_pose.filtering.truncation.inequalities import Inequalities, from_bounds, say_if_unlimited
from drake_pose.matching.fit.pose_jacobian import normal_jacobian
from drake_pose.silhouette import Outline, TreeSurfaces, draw_mask
from drake_pose.silhouette.contours.contour_points import find_contour_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROOT_SHIFT = ("root_shift_x", "root_shift_y", "root_shift_z")
"""Where the root is in the world, beside where its tree holds it [m]."""

# Geman and McClure's weight has half its influence at about this many deviations.
_ROBUST_WIDTH = 2.5
_MEDIAN_TO_DEVIATION = 1.4826


@dataclass(frozen=True)
class ContourSettings:
    """How a contour is measured.

    Args:
        spacing: of the contour's points [pixel].
        deviation: how far a mask's edge is from the body's own contour at least [pixel]; where
            the mask and the model agree less than that, their disagreement is taken.
        correlation: so much of a contour [pixel] errs together: its points count as one.
        reach: how far from the model's contour the mask's edge is looked for [pixel].

    Raises:
        SettingsError: a number that is not positive.
    """

    spacing: float = 3.0
    deviation: float = 0.7
    correlation: float = 12.0
    reach: float = 40.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < math.inf:
                raise SettingsError(f"{name} must be positive, not {value}")


@dataclass(frozen=True, eq=False)
class ContourMeasurement:
    """What masks say of a pose near one state: an ``ObservationModel``, linear, made for one frame.

    The distances of hundreds of contour points are rotated into as many numbers as the state has
    elements, with noise 1, which lose nothing.

    Attributes:
        names: (k) of the numbers.
        y: (k,) what was measured, 0 at ``at``.
        H: (k, n) the slope.
        at: (n,) the state.
        points: how many points of the contour were used.
        share: their share of the contour that the model shows.
        distance: root mean square of their distances, robustly weighted [pixel].
    """

    names: tuple[str, ...]
    y: Array
    H: Array
    at: Array
    points: int
    share: float
    distance: float

    @property
    def variances(self) -> Array:
        """(k,) 1."""
        return np.ones(len(self.y))

    @property
    def wraps(self) -> NDArray[np.bool_]:
        """(k,) no number is an angle."""
        return np.zeros(len(self.y), dtype=np.bool_)

    def predict(self, x: Array) -> tuple[Array, Array]:
        """H (x - at) (k,), and H."""
        return self.H @ (x - self.at), self.H

    def mirrors(self, belief: Belief) -> list[Array]:
        """None."""
        return []


class ContourObservation:
    """Turns masks into measurements of a pose tree's values.

    Args:
        tree: the body's pose tree.
        cameras: the calibrated cameras.
        moves: whether the root may be elsewhere than where the tree holds it.
        constant: names of values that never change, such as shape joints.
        settings: how the contour is measured.

    Attributes:
        layout: the state: the tree's values that are free to move, then ROOT_SHIFT, their rates,
            and the constants.

    Raises:
        SettingsError: no camera; or the tree has no value to estimate.
        UnknownNameError: a constant is no value of the tree.
    """

    def __init__(
        self,
        tree: PoseTree,
        cameras: Sequence[Camera],
        moves: bool = False,
        constant: Sequence[str] = (),
        settings: ContourSettings | None = None,
    ) -> None:
        if not cameras:
            raise SettingsError("a contour needs one camera or more")
        self.tree, self.cameras = tree, tuple(cameras)
        self.settings = settings or ContourSettings()
        self._kinematics = TreeKinematics(tree)
        self._surfaces = TreeSurfaces(tree)
        # Points are found faster in outlines that are known already.
        self._outlines = tuple(self._surfaces.rigid)
        free = self._kinematics.lower < self._kinematics.upper
        names = [n for n, is_free in zip(self._kinematics.names, free, strict=True) if is_free]
        moving = [name for name in names if name not in constant]
        for name in constant:
            if name not in names:
                raise UnknownNameError("value", name, names, f"the tree of {tree.model.path}")
        self.layout = StateLayout((*moving, *(ROOT_SHIFT if moves else ())), tuple(constant))
        if not len(self.layout):
            raise SettingsError(f"{tree.model.path}: all values of its tree are held")
        self._moves = moves
        known = [*self._kinematics.names, *ROOT_SHIFT]
        seen = [*self.layout.moving, *self.layout.constant]
        self._state_index = self.layout.indices(seen)
        self._parameter_index = np.array([known.index(name) for name in seen], dtype=np.intp)
        self._values = self._kinematics.flatten(tree.default_values())
        self._known_shift = np.zeros(3)

    def is_angle(self, name: str) -> bool:
        """Whether an element is an angle [rad], else it is a length [m]."""
        if name in ROOT_SHIFT:
            return False
        return bool(self._kinematics.is_angle[self._kinematics.names.index(name)])

    def inequalities(self) -> Inequalities:
        """The limits of all values; angles that can take every direction have none."""
        lower = np.r_[self._kinematics.lower, np.full(3, -np.inf)]
        upper = np.r_[self._kinematics.upper, np.full(3, np.inf)]
        turns = np.r_[self._kinematics.is_angle, np.zeros(3, dtype=bool)]
        free = turns & (upper - lower >= 2 * np.pi - 1e-9)
        lower[free], upper[free] = -np.inf, np.inf
        index = self._parameter_index
        names = [*self.layout.moving, *self.layout.constant]
        rows = from_bounds(names, lower[index], upper[index])
        return say_if_unlimited(rows, str(self.tree.model.path))

    def with_root_position(self, root_position: Array) -> "ContourObservation":
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
        """The tree's values (m,) and the root's shift (3,) of a state (n,)."""
        parameters = np.r_[self._values, np.zeros(3)]
        parameters[self._parameter_index] = x[self._state_index]
        count = len(self._values)
        return parameters[:count], parameters[count:] + self._known_shift

    def positions(self, x: Array) -> tuple[Array, Array]:
        """The plant's q (nq,) and X_WB (4, 4) of a state (n,).

        Raises:
            ModelError: the base joints cannot hold the root where it is.
        """
        values, shift = self._split(x)
        tree = self.tree
        if np.any(shift):
            tree = tree.with_root_position(self._root(values) + shift)
        return tree.positions_from(self.node_values(x))

    def state(self, q: Array, X_WB: Array | None = None) -> Array:
        """(n,) a state at rest at the plant's positions q (nq,)."""
        values = self._kinematics.flatten(self.tree.values_from_positions(q, X_WB))
        shift = np.zeros(3)
        if self._moves:
            model = self.tree.model
            p_BR = PlantKinematics(model).pose_at(model.link_index(self.tree.root), q)[:, 3]
            p_WR = p_BR if X_WB is None else X_WB @ p_BR
            shift = p_WR[:3] - self._root(values) - self._known_shift
        x = np.zeros(len(self.layout))
        x[self._state_index] = np.r_[values, shift][self._parameter_index]
        return x

    def continued(self, x: Array, last: Array) -> Array:
        """The same pose (n,), angles that turn around in the turns nearest to the last state's."""
        values = self._split(x)[0]
        turns = self._kinematics.nearest_turns(values, self._split(last)[0]) - values
        turned = x.copy()
        turned[self._state_index] += np.r_[turns, np.zeros(3)][self._parameter_index]
        return turned

    def draw(self, x: Array, camera: Camera) -> Mask:
        """(H, W) what a camera would see of the body at a state (n,)."""
        motions = self._motions(x)
        return draw_mask(self._outlines_at(x), camera.X_CW @ motions.X_WN, camera)

    def measure(self, masks: Sequence[Mask | None], x: Array) -> ContourMeasurement | None:
        """Compare the model's contour at a state with masks.

        Args:
            masks: (H, W) of each camera, in their order; None where there is no picture.
            x: (n,).

        Returns:
            The measurement; None where no edge is near the contour in any mask.

        Raises:
            SettingsError: masks that do not fit the cameras.
        """
        if len(masks) != len(self.cameras):
            raise SettingsError(f"{len(self.cameras)} masks expected, got {len(masks)}")
        motions, outlines = self._motions(x), self._outlines_at(x)
        rows, distances, lengths, shown = [], [], [], 0.0
        for camera, mask in zip(self.cameras, masks, strict=True):
            if mask is None:
                continue
            if mask.shape != (camera.height, camera.width):
                raise SettingsError(
                    f"camera '{camera.name}': mask of {mask.shape[1]} x {mask.shape[0]} pixels, "
                    f"{camera.width} x {camera.height} expected"
                )
            X_CN = camera.X_CW @ motions.X_WN
            points = find_contour_points(outlines, X_CN, camera, self.settings.spacing)
            distance = find_edges(mask, points.uv, points.normals, self.settings.reach)
            near = np.isfinite(distance)
            shown += float(points.lengths.sum())
            rows.append(normal_jacobian(points, motions, camera)[near])
            distances.append(distance[near])
            lengths.append(points.lengths[near])
        if not rows or not sum(map(len, distances)):
            return None
        return self._compress(
            x, np.vstack(rows), np.concatenate(distances), np.concatenate(lengths), shown
        )

    def _motions(self, x: Array) -> Motions:
        values, shift = self._split(x)
        motions = self._kinematics.motions(values, translation=True)
        if not np.any(shift):
            return motions
        X_WN, twists = motions.X_WN.copy(), motions.twists.copy()
        X_WN[motions.moves[:, -1], :3, 3] += shift
        # Turns are about axes that have moved along.
        twists[: len(values), 3:6] -= np.cross(twists[: len(values), :3], shift)
        return Motions(X_WN, twists, motions.moves)

    def _outlines_at(self, x: Array) -> tuple[Outline, ...]:
        if not self._surfaces.bends:
            return self._outlines
        return tuple(self._surfaces.at(self.node_values(x)))

    def _compress(
        self, x: Array, J: Array, distances: Array, lengths: Array, shown: float
    ) -> ContourMeasurement:
        """Weigh the points, and rotate them into as many numbers as there are elements."""
        settings = self.settings
        scale = _MEDIAN_TO_DEVIATION * float(np.median(np.abs(distances)))
        scale = max(settings.deviation, scale)
        robust = 1.0 / (1.0 + (distances / (_ROBUST_WIDTH * scale)) ** 2) ** 2
        weights = robust * lengths / (scale**2 * settings.correlation)
        root = np.sqrt(weights)
        Q, R = np.linalg.qr(root[:, None] * J[:, self._parameter_index])
        H = np.zeros((len(R), len(self.layout)))
        H[:, self._state_index] = R
        mean_square = float(np.sum(weights * distances**2) / np.sum(weights))
        return ContourMeasurement(
            names=tuple(f"contour_{k}" for k in range(len(R))),
            y=Q.T @ (root * distances),
            H=H,
            at=x,
            points=len(distances),
            share=float(lengths.sum()) / shown,
            distance=math.sqrt(mean_square),
        )
