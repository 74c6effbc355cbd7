"""The contour of any model in any number of masks, as a measurement of its pose."""

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.link_graph import PlantKinematics
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.state import Belief, StateLayout
from drake_pose.filtering.truncation.couplings import (
    UsualPose,
    couplings_file,
    load_couplings,
    load_usual_pose,
)
from drake_pose.filtering.truncation.inequalities import (
    Inequalities,
    from_bounds,
    say_if_unlimited,
    stack,
)
from drake_pose.fit.camera_sums import REACH, Views
from drake_pose.fit.colours import (
    ColourSettings,
    Histograms,
    Picture,
    add_pictures,
    check_picture,
    learned,
    no_colours,
    part_distances,
    weigh_parts,
)
from drake_pose.fit.contour_fit import (
    Comparison,
    Noise,
    compare_views,
    pack_views,
    project,
)
from drake_pose.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.fit.kernel import COMPARED, FITTING, SQUARES, WEIGHT
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import BodyParameters
from drake_pose.fit.surfaces import MANY, few_rigid_triangles
from drake_pose.search.starts.root_placement import slide_root
from drake_pose.silhouette.areas.bending import PackedSurfaces, TreeSurfaces
from drake_pose.silhouette.areas.scoring import draw_packed

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROOT_SHIFT = ("root_shift_x", "root_shift_y", "root_shift_z")
"""Where the root is in the world, beside where its tree holds it [m]."""

GROWTH = "log_growth"
"""The logarithm of how much larger the body is seen than a parallel camera's scale says."""

_ROOT = (*ROOT_SHIFT, GROWTH)

# Geman and McClure's weight has half its influence at about this many deviations.
_ROBUST_WIDTH = 2.5
# A pixel of contour has weight one.
_PLAIN = Noise(deviation=1.0, correlation=0.5)
# So many triangles show a rigid part beside bands of skin to a fraction of a pixel.
_WITH_SKIN = 160
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


class Seen(NamedTuple):
    """What a frame shows.

    views: the edges of masks; pictures: of cameras without a mask, else None; colours: what is
    known of the body's colours before the frame.
    """

    views: Views
    pictures: tuple[Picture | None, ...]
    colours: Histograms | None

    @property
    def has_pictures(self) -> bool:
        """Whether there is one to be compared."""
        return self.colours is not None and any(one is not None for one in self.pictures)


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
        part_distances: (nodes,) of each part in the pictures [pixel]; 0 where they say too little.
    """

    names: tuple[str, ...]
    y: Array
    H: Array
    at: Array
    share: float
    distance: float
    part_distances: Array

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
        grows: whether the scale of the one parallel camera is unknown.
        constant: names of values that never change, such as shape joints.
        settings: how the contour is measured.
        rest: each measurement also says, with so much weight, that joints are held as usual; 0:
            nothing is said.
        colours: how pictures are compared.

    Attributes:
        layout: the state: the tree's values that are free to move, then ROOT_SHIFT and GROWTH,
            their rates, and the constants.
        usual: how joints are usually held, about the state's moving elements, then its constants:
            what the model's couplings file says, and about the middle of their limits, as evenly
            spread as these are wide, where it says nothing.

    Raises:
        SettingsError: no camera; the tree has no value to estimate; or a scale is unknown and there
            is not one parallel camera.
        UnknownNameError: a constant is no value of the tree.
    """

    def __init__(
        self,
        tree: PoseTree,
        cameras: Sequence[Camera],
        moves: bool = False,
        grows: bool = False,
        constant: Sequence[str] = (),
        settings: ContourSettings | None = None,
        rest: float = 0.0,
        colours: ColourSettings | None = None,
    ) -> None:
        if not cameras:
            raise SettingsError("a contour needs one camera or more")
        if grows and (len(cameras) != 1 or not isinstance(cameras[0], ParallelCamera)):
            raise SettingsError("a scale can be tracked only in one parallel camera's masks")
        self.tree, self.cameras = tree, tuple(cameras)
        self.settings = settings or ContourSettings()
        self.colours = colours or ColourSettings()
        self._kinematics = TreeKinematics(tree)
        surfaces = TreeSurfaces(tree)
        self._whole = PackedSurfaces(surfaces)
        # Few triangles are compared; what is drawn has all of them.
        compared = few_rigid_triangles(surfaces, _WITH_SKIN if surfaces.bends else MANY)
        self._body = BodyParameters(self._kinematics, compared.rigid, surfaces=compared)
        free = self._kinematics.lower < self._kinematics.upper
        names = [n for n, is_free in zip(self._kinematics.names, free, strict=True) if is_free]
        moving = [name for name in names if name not in constant]
        for name in constant:
            if name not in names:
                raise UnknownNameError("value", name, names, f"the tree of {tree.model.path}")
        root = (*(ROOT_SHIFT if moves else ()), *((GROWTH,) if grows else ()))
        self.layout = StateLayout((*moving, *root), tuple(constant))
        if not len(self.layout):
            raise SettingsError(f"{tree.model.path}: all values of its tree are held")
        self._moves = moves
        known = [*self._kinematics.names, *_ROOT]
        seen = [*self.layout.moving, *self.layout.constant]
        self._state_index = self.layout.indices(seen)
        self._parameter_index = np.array([known.index(name) for name in seen], dtype=np.intp)
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
        names, index = [*self.layout.moving, *self.layout.constant], self._parameter_index
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
        lower = np.r_[self._kinematics.lower, np.full(len(_ROOT), -np.inf)]
        upper = np.r_[self._kinematics.upper, np.full(len(_ROOT), np.inf)]
        turns = np.r_[self._kinematics.is_angle, np.zeros(len(_ROOT), dtype=bool)]
        free = turns & (upper - lower >= 2 * np.pi - 1e-9)
        lower[free], upper[free] = -np.inf, np.inf
        index = self._parameter_index
        names = [*self.layout.moving, *self.layout.constant]
        model = self.tree.model
        parts = [from_bounds(names, lower[index], upper[index])]
        file = couplings_file(model.path)
        if file.is_file():
            parts.append(load_couplings(file, model.position_names).only_of(names))
        return say_if_unlimited(stack(parts, names), str(model.path))

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
        """(n,) a state at rest.

        Args:
            q: (nq,) the plant's positions.
            X_WB: (4, 4) where the plant's world is; None: where the world is.
            scale: so many times the pixels a metre that it was given with the camera has.
        """
        values = self._kinematics.flatten(self.tree.values_from_positions(q, X_WB))
        root = np.append(np.zeros(3), math.log(scale))
        if self._moves:
            model = self.tree.model
            p_BR = PlantKinematics(model).pose_at(model.link_index(self.tree.nodes[0].name), q)[
                :, 3
            ]
            p_WR = p_BR[:3] if X_WB is None else (X_WB @ p_BR)[:3]
            if scale != 1.0:
                p_WR = slide_root(self._parallel(), p_WR, scale)
            root[:3] = p_WR - self._root(values) - self._known_shift
        x = np.zeros(len(self.layout))
        x[self._state_index] = np.r_[values, root][self._parameter_index]
        return x

    def turned(self, x: Array, rotation: Array) -> Array:
        """(n,) the state whose root is turned about its origin by (3, 3) in the world.

        Raises:
            SettingsError: the tree's root does not turn freely.
        """
        placed = self.tree.placements[0]
        if placed.rotation is None or not self.tree.turns_root_freely:
            raise SettingsError("only a pose tree whose root turns freely can be turned")
        values = self._split(x)[0]
        R_WR = rotation @ self._kinematics.poses(values)[0, :3, :3]
        other = x.copy()
        changed = values.copy()
        changed[:3] = placed.rotation.values_from(placed.X_PA[:3, :3].T @ R_WR)
        count = len(values)
        inside = self._parameter_index < count
        other[self._state_index[inside]] = changed[self._parameter_index[inside]]
        return other

    def strain(self, x: Array) -> float:
        """How far joints are from how they are usually held, in all [deviations^2]."""
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
        return draw_packed(self._whole.at(self.node_values(x)), camera.X_CW @ X_WN, camera)

    def look(
        self,
        masks: Sequence[Mask | None],
        pictures: Sequence[Picture | None] | None = None,
        colours: Histograms | None = None,
    ) -> Seen:
        """What a frame shows: the points of masks' edges, found once for all its measurements.

        Args:
            masks: (H, W) of each camera, in their order; None where there is none.
            pictures: (H, W, 3 or 4) of each camera; None where there is none. They are compared
                where there is no mask.
            colours: what is known of the body's colours; None: nothing, and pictures say nothing.

        Raises:
            SettingsError: masks or pictures that do not fit the cameras.
        """
        if len(masks) != len(self.cameras):
            raise SettingsError(f"{len(self.cameras)} masks expected, got {len(masks)}")
        if pictures is not None and len(pictures) != len(self.cameras):
            raise SettingsError(f"{len(self.cameras)} pictures expected, got {len(pictures)}")
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
        compared = [
            None if picture is None or mask is not None else check_picture(camera, picture)
            for camera, mask, picture in zip(
                self.cameras, masks, pictures or [None] * len(masks), strict=True
            )
        ]
        return Seen(pack_views(self.cameras, edges), tuple(compared), colours)

    def is_finest(self, number: int) -> bool:
        """Whether no later measurement of a frame looks at pictures more closely than this one."""
        return self.colours.step(number) == self.colours.steps[-1]

    def no_colours(self) -> Histograms:
        """What is known of a body's colours that was never seen."""
        return no_colours(len(self.cameras), len(self._body.outlines))

    def learn(
        self,
        pictures: Sequence[Picture | None],
        x: Array,
        colours: Histograms,
        surely: bool = False,
        without: Mask | None = None,
    ) -> Histograms:
        """What is known of the body's colours after a frame.

        Args:
            pictures: of each camera; None where there is none.
            x: (n,) the state in the frame.
            colours: what was known before.
            surely: whether the pose is known, so that old colours are forgotten.
            without: (nodes,) parts of which nothing is learned.

        Raises:
            SettingsError: pictures that do not fit the cameras.
        """
        checked = [
            None if picture is None else check_picture(camera, picture)
            for camera, picture in zip(self.cameras, pictures, strict=True)
        ]
        placed = self._body.place(self.parameters(x))
        known = learned(placed, self.cameras, checked, colours, self.colours, surely)
        if without is not None:
            known[:, without] = colours[:, without]
        return known

    def measure(
        self,
        seen: Seen,
        x: Array,
        distance: float | None = None,
        number: int = 0,
        without: Mask | None = None,
    ) -> ContourMeasurement | None:
        """Compare the model's contour at a state with a frame.

        Args:
            seen: what the frame shows.
            x: (n,) the state.
            distance: about how far they are apart [pixel], of the measurement before; None: as far
                as is looked.
            number: how many measurements of the frame were made before: lines in pictures are
                looked at more closely from one to the next.
            without: (nodes,) parts of which the pictures say nothing.

        Returns:
            The measurement; None where no edge is near the contour in any mask or picture.
        """
        width = self.settings.reach / REACH
        if distance is not None:
            width = min(width, _ROBUST_WIDTH * max(self.settings.deviation, distance))
        found = self._compare(seen, x, width, number)
        if found is None:
            return None
        shown = np.array([picture is not None for picture in seen.pictures])
        if without is not None:
            off = np.ix_(shown, without)
            found[0].A[off], found[0].b[off] = 0.0, 0.0
        return self._compress(x, *found, part_distances(found[0].sums[shown]))

    def _compare(
        self, seen: Seen, x: Array, width: float, number: int
    ) -> tuple[Comparison, float] | None:
        """Contours compared with so wide a scale [pixel], and how far they are apart [pixel]."""
        step = AnnealingStage(width, self.settings.spacing)
        compared = compare_views(self._body, seen.views, self.parameters(x), step, _PLAIN, 1.0)
        if seen.colours is not None and seen.has_pictures:
            pixels = self.colours.step(number)
            # Coarse lines are so wide that they would say the same.
            lines = AnnealingStage(width, self.colours.spacing * min(pixels, 2))
            correlation = _PLAIN.correlation * self.colours.correlation / self.settings.correlation
            noise = replace(_PLAIN, correlation=correlation)
            add_pictures(compared, self.cameras, seen.pictures, seen.colours, lines, noise, pixels)
            weigh_parts(compared, self.settings.deviation, seen.pictures)
        squares, weight = compared.sums[:, :, [SQUARES, WEIGHT]].sum(axis=(0, 1))
        return None if weight <= 0.0 else (compared, math.sqrt(squares / weight))

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

    def _compress(
        self, x: Array, compared: Comparison, distance: float, parts: Array
    ) -> ContourMeasurement:
        """What the contours say as no more numbers than the state has elements, with noise 1."""
        settings = self.settings
        H, g = project(compared, len(self._body.names))
        index = self._parameter_index
        scale = max(settings.deviation, distance)
        # Both contours say the same: together they count as one.
        worth = 0.5 / (scale**2 * settings.correlation)
        rest_curvature, rest_slope = self._rest
        slopes = worth * g[index] + rest_curvature @ x[self._state_index] - rest_slope
        curvature = worth * H[np.ix_(index, index)] + rest_curvature
        size, turns = np.linalg.eigh(curvature)
        told = size > _NOTHING * max(float(size[-1]), 1e-300)
        root, turns = np.sqrt(size[told]), turns[:, told]
        slope = np.zeros((len(root), len(self.layout)))
        slope[:, self._state_index] = root[:, None] * turns.T
        contour = compared.sums[:, :-1].sum(axis=(0, 1))
        return ContourMeasurement(
            names=tuple(f"contour_{k}" for k in range(len(root))),
            y=-(turns.T @ slopes) / root,
            H=slope,
            at=x,
            share=float(contour[FITTING] / max(contour[COMPARED], 1e-9)),
            distance=distance,
            part_distances=parts,
        )
