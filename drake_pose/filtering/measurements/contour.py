"""The contour of any model in any number of masks, as a measurement of its pose."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body import PoseTree
from drake_pose.body.tree.link_graph import PlantKinematics
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera import Camera
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.state import Belief, StateLayout
from drake_pose.filtering.truncation.inequalities import Inequalities, from_bounds, say_if_unlimited
from drake_pose.matching.fit.camera_sums import REACH, Views
from drake_pose.matching.fit.contour_fit import (
    Comparison,
    Noise,
    compare_views,
    pack_views,
    project,
)
from drake_pose.matching.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.matching.fit.kernel import COMPARED, FITTING, SQUARES, WEIGHT
from drake_pose.matching.fit.levenberg_marquardt import Round
from drake_pose.matching.fit.parameters import BodyParameters
from drake_pose.matching.fit.surfaces import MANY, few_triangles
from drake_pose.silhouette import Outline, TreeSurfaces, draw_mask

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROOT_SHIFT = ("root_shift_x", "root_shift_y", "root_shift_z")
"""Where the root is in the world, beside where its tree holds it [m]."""

# Geman and McClure's weight has half its influence at about this many deviations.
_ROBUST_WIDTH = 2.5
# A pixel of contour has weight one.
_PLAIN = Noise(deviation=1.0, correlation=0.5)
# Directions about which so small a share of the most is told are not told about.
_NOTHING = 1e-12


@dataclass(frozen=True)
class ContourSettings:
    """How a contour is measured.

    Args:
        spacing: of the contour's points [pixel].
        deviation: how far a mask's edge is from the body's own contour at least [pixel]; where
            the mask and the model agree less than that, their disagreement is taken.
        correlation: how much of a contour [pixel] errs together: its points count as one.
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

    The distances of hundreds of contour points are summed to normal equations, and these are as
    many numbers with noise 1 as there are directions of the state that they tell something about.

    Attributes:
        names: (k) of the numbers.
        y: (k,) what was measured, 0 at ``at``.
        H: (k, n) the slope.
        at: (n,) the state.
        share: of the contour that the model shows, what has an edge beside it.
        distance: root mean square of their distances, robustly weighted [pixel].
    """

    names: tuple[str, ...]
    y: Array
    H: Array
    at: Array
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
        self._outlines = tuple(self._surfaces.rigid)
        # Skin, which bends, keeps all of its triangles.
        bends = self._surfaces.bends
        compared = self._outlines if bends else few_triangles(self._surfaces, MANY)
        self._body = BodyParameters(self._kinematics, compared, surfaces=self._surfaces)
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
        X_WN = self._body.place(self._theta(x)).X_WN
        return draw_mask(self._outlines_at(x), camera.X_CW @ X_WN, camera)

    def _outlines_at(self, x: Array) -> tuple[Outline, ...]:
        if not self._surfaces.bends:
            return self._outlines
        return tuple(self._surfaces.at(self.node_values(x)))

    def look(self, masks: Sequence[Mask | None]) -> Views:
        """What masks say: the points of their edges, found once for all measurements of a frame.

        Args:
            masks: (H, W) of each camera, in their order; None where there is no picture.

        Raises:
            SettingsError: masks that do not fit the cameras.
        """
        if len(masks) != len(self.cameras):
            raise SettingsError(f"{len(self.cameras)} masks expected, got {len(masks)}")
        edges = []
        for camera, mask in zip(self.cameras, masks, strict=True):
            if mask is not None and mask.shape != (camera.height, camera.width):
                raise SettingsError(
                    f"camera '{camera.name}': mask of {mask.shape[1]} x {mask.shape[0]} pixels, "
                    f"{camera.width} x {camera.height} expected"
                )
            edges.append(
                NO_EDGE if mask is None else find_edge_points(mask, 0.5 * self.settings.spacing)
            )
        return pack_views(self.cameras, edges)

    def measure(
        self, seen: Views, x: Array, distance: float | None = None
    ) -> ContourMeasurement | None:
        """Compare the model's contour at a state with the edges of masks.

        Args:
            seen: what the masks say.
            x: (n,) the state.
            distance: about how far they are apart [pixel], of the measurement before; None: as far
                as is looked.

        Returns:
            The measurement; None where no edge is near the contour in any mask.
        """
        width = self.settings.reach / REACH
        if distance is not None:
            width = min(width, _ROBUST_WIDTH * max(self.settings.deviation, distance))
        found = self._compare(seen, x, width)
        return None if found is None else self._compress(x, *found)

    def _compare(self, seen: Views, x: Array, width: float) -> tuple[Comparison, float] | None:
        """Contours compared with so wide a scale [pixel], and how far they are apart [pixel]."""
        step = Round(width, self.settings.spacing)
        compared = compare_views(self._body, seen, self._theta(x), step, _PLAIN, pixels=1.0)
        squares, weight = compared.sums[:, :, [SQUARES, WEIGHT]].sum(axis=(0, 1))
        return None if weight <= 0.0 else (compared, math.sqrt(squares / weight))

    def _theta(self, x: Array) -> Array:
        """All parameters of the body at a state (n,)."""
        values, shift = self._split(x)
        return np.concatenate([values, shift, [0.0]])

    def _compress(self, x: Array, compared: Comparison, distance: float) -> ContourMeasurement:
        """What the contours say as no more numbers than the state has elements, with noise 1."""
        settings = self.settings
        H, g = project(compared, len(self._body.names))
        index = self._parameter_index
        scale = max(settings.deviation, distance)
        # Both contours say the same: together they count as one.
        worth = 0.5 / (scale**2 * settings.correlation)
        size, turns = np.linalg.eigh(worth * H[np.ix_(index, index)])
        told = size > _NOTHING * max(float(size[-1]), 1e-300)
        root, turns = np.sqrt(size[told]), turns[:, told]
        slope = np.zeros((len(root), len(self.layout)))
        slope[:, self._state_index] = root[:, None] * turns.T
        contour = compared.sums[:, :-1].sum(axis=(0, 1))
        return ContourMeasurement(
            names=tuple(f"contour_{k}" for k in range(len(root))),
            y=-worth * (turns.T @ g[index]) / root,
            H=slope,
            at=x,
            share=float(contour[FITTING] / max(contour[COMPARED], 1e-9)),
            distance=distance,
        )
