"""The free values of a pose tree as a filter's state, measured by contours in masks and pictures.

``ContourObservation`` turns a frame into a linear measurement of the state, by comparing the
model's contour with edges.
"""

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from drake_pose.arrays import Array, Floats, Mask, Picture
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
from drake_pose.filtering.update import LinearObservation
from drake_pose.fit.colours import (
    LINES,
    add_pictures,
    check_picture,
    part_distances,
    search_line_step,
    uninformed_histograms,
    update_histograms,
    weigh_parts,
)
from drake_pose.fit.contour_fit import (
    Comparison,
    Noise,
    Views,
    camera_weights,
    compare_views,
    normal_equations,
    pack_cameras,
    pack_views,
)
from drake_pose.fit.covariance import distances, error_unit, estimate_sizes, values_covariance
from drake_pose.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.fit.judge import LEVEL, is_noise
from drake_pose.fit.kernel import REACH, Sum, compare_contours
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import BodyParameters
from drake_pose.fit.surfaces import MANY, simplify_rigid_parts
from drake_pose.search import JointEstimate, slide_root
from drake_pose.silhouette.outline import PackedSurfaces, TreeSurfaces
from drake_pose.silhouette.scoring import draw_packed

ROOT_SHIFT = ("root_shift_x", "root_shift_y", "root_shift_z")
"""Shift of the root in the world from its place in the pose tree [m]."""

LOG_SCALE = "log_scale"
"""Natural logarithm of the image scale relative to the parallel camera's."""

_ROOT = (*ROOT_SHIFT, LOG_SCALE)


@dataclass(frozen=True)
class ContourSettings:
    """Settings of contour measurements."""

    spacing: float = 3.0  # Distance between two contour points [pixel].
    # Smallest standard deviation of a mask's edge about the body's contour [pixel].
    deviation: float = 0.7
    # Contour length over which errors are correlated; its points count as one [pixel].
    correlation: float = 12.0
    reach: float = 40.0  # Largest distance between the model's contour and a mask's edge [pixel].
    robust_width: float = 2.5  # Scale of the Geman-McClure weight [standard deviations].


CONTOUR = ContourSettings()


# Weight 1 per pixel of contour.
_PLAIN = Noise(deviation=1.0, correlation=0.5)


class ContourEvidence(NamedTuple):
    """The evidence of a frame.

    Attributes:
        views: the cameras, and the edge points of their masks.
        pictures: for each camera, the picture if there is no mask, else None.
        colours: colour histograms of the body before this frame; None: pictures are not used.
    """

    views: Views
    pictures: tuple[Picture | None, ...]
    colours: Floats | None

    @property
    def has_pictures(self) -> bool:
        """Whether a picture can be compared."""
        return self.colours is not None and any(one is not None for one in self.pictures)


@dataclass(frozen=True, eq=False)
class ContourMeasurement(LinearObservation):
    """The measurement that a frame's contours give, linearised at one state.

    Normal equations of hundreds of contour points are factorised into one scalar measurement with
    variance 1 for each observable direction of the state.
    """

    y: Array  # (k,) measured values; the predicted value at ``at`` is 0.
    distance: float  # Robustly weighted root mean square distance of contour and edges [pixel].
    length: float  # Mean length of the contours of body and masks [pixel].
    # Whether no more of the contours of body and masks is unlikely than noise makes so, at LEVEL,
    # most of the contour in pictures fits, and no part is hidden there.
    is_explained: bool
    # (cameras, nodes) parts of whose contour in a mask more is unlikely, or whose distance in
    # pictures is.
    hidden_parts: Mask
    compared: Comparison  # The comparison of the contours at ``at``.


class ContourObservation:
    """The free values of a pose tree as a filter's state x (n,), measured by contours in cameras.

    Masks and pictures (with ``fit.colours``) give measurements of it. It holds the free values [rad
    or m], root shift and log scale, then the rates of all these.

    Args:
        root_moves: whether the root's position in the world is part of the state.
        scale_unknown: whether the scale of the one parallel camera is part of the state.
        prior_weight: weight of the joints' prior in each measurement.

    Attributes:
        layout: the tree's free values, then ROOT_SHIFT and LOG_SCALE, and their rates.
        prior: of the joints over the state's moving elements: the model's couplings file, and for
            other limited joints normal with the mean and variance of uniform between the limits.

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
        self._moving = slice(len(self.layout.moving))
        index = [known.index(name) for name in self.layout.moving]
        self._parameter_index = np.array(index, np.intp)
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
        names, index = self.layout.moving, self._parameter_index
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
        kinematics, names, model = self._kinematics, self.layout.moving, self.tree.model
        lower, upper = (
            np.r_[limits, np.full(len(_ROOT), end)][self._parameter_index]
            for end, limits in ((-np.inf, kinematics.lower), (np.inf, kinematics.upper))
        )
        parts = [from_bounds(names, lower, upper)]
        file = couplings_file(model.path)
        if file.is_file():
            parts.append(load_couplings(file, model.position_names).restricted_to(names))
        return warn_if_unlimited(stack(parts, names), str(model.path))

    def seen_by(
        self, cameras: Sequence[Camera], root_position: Array | None
    ) -> "ContourObservation":
        """Return a copy whose cameras see other parts of the same pictures.

        ``root_position``: (3,) known position of the root in the world [m]; None: as in the tree.
        """
        other = copy.copy(self)
        other.cameras = tuple(cameras)
        if root_position is not None:
            other._known_shift = np.asarray(root_position, np.float64) - self._root(self._values)
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
        parameters[self._parameter_index] = x[self._moving]
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
        return p_WR if root[3] == 0.0 else slide_root(self.cameras[0], p_WR, math.exp(-root[3]))

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
                p_WR = slide_root(self.cameras[0], p_WR, scale)
            root[:3] = p_WR - self._root(values)
        return self.state_of(np.r_[values, root])

    def turned(self, x: Array, rotation: Array) -> Array:
        """Return the state x (n,) with its root rotated by ``rotation`` (3, 3) in the world.

        Raises SettingsError: the root does not turn freely.
        """
        placed = self.tree.placements[0]
        if placed.rotation is None or not self.tree.turns_root_freely:
            raise SettingsError("only a pose tree whose root turns freely can be turned")
        parameters = self.parameters(x)
        R_WR = rotation @ self._kinematics.poses(self._split(x)[0])[0, :3, :3]
        parameters[:3] = placed.rotation.values_from(placed.X_PA[:3, :3].T @ R_WR)
        turned = x.copy()
        turned[self._moving] = self.state_of(parameters)[self._moving]
        return turned

    def prior_distance(self, x: Array) -> float:
        """Return the squared Mahalanobis distance of a state (n,) from the joints' prior."""
        off = self.prior.phi @ x[self._moving] - self.prior.mean
        return float(np.sum((off / self.prior.deviation) ** 2))

    def unwrapped(self, x: Array, last: Array) -> Array:
        """Return the state x (n,) with periodic angles in the turns nearest to ``last`` (n,)."""
        values = self._split(x)[0]
        turns = self._kinematics.nearest_turns(values, self._split(last)[0]) - values
        turned = x.copy()
        turned[self._moving] += np.r_[turns, np.zeros(len(_ROOT))][self._parameter_index]
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
        x[self._moving] = held[self._parameter_index]
        return x

    def node_poses(self, x: Array) -> Array:
        """Return X_WN (nodes, 4, 4) at a state (n,), scaled by its log scale."""
        return self._body.place(self.parameters(x)).X_WN

    def gather_evidence(
        self,
        masks: Sequence[Mask | None],
        pictures: Sequence[Picture | None] | None = None,
        colours: Floats | None = None,
    ) -> ContourEvidence:
        """Return the evidence of a frame; edge points are found once for all its measurements.

        ``masks``, ``pictures``: for each of ``cameras`` (H, W), (H, W, 3 or 4) or None; pictures
        are used for cameras without a mask. ``colours``: colour histograms of the body; None:
        pictures are not used. Raises SettingsError: masks or pictures do not fit the cameras.
        """
        pictures = [None] * len(masks) if pictures is None else pictures
        for kind, given in (("masks", masks), ("pictures", pictures)):
            if len(given) != len(self.cameras):
                raise SettingsError(f"{len(self.cameras)} {kind} expected, got {len(given)}")
        edges, compared = [], []
        for camera, mask, picture in zip(self.cameras, masks, pictures, strict=True):
            if mask is not None and mask.shape != (camera.height, camera.width):
                raise SettingsError(
                    f"camera '{camera.name}': mask of {mask.shape[1]} x {mask.shape[0]} pixels, "
                    f"{camera.width} x {camera.height} expected"
                )
            edges.append(NO_EDGE if mask is None else find_edge_points(mask, 0.5 * CONTOUR.spacing))
            compared.append(
                None if picture is None or mask is not None else check_picture(camera, picture)
            )
        return ContourEvidence(pack_views(self.cameras, edges), tuple(compared), colours)

    def uninformed_histograms(self) -> Floats:
        """Return the colour histograms of a body without observations."""
        return uninformed_histograms(len(self.cameras), len(self._body.outlines))

    def update_histograms(
        self,
        pictures: Sequence[Picture | None],
        x: Array,
        colours: Floats,
        pose_is_known: bool = False,
        excluded_parts: Mask | None = None,
    ) -> Floats:
        """Return the body's colour histograms updated by a frame.

        ``pictures``: for each camera (H, W, 3 or 4) or None. ``x``: (n,) the state in this frame.
        ``colours``: before it. ``pose_is_known``: whether the state is certain, so that the old
        histograms are discarded. ``excluded_parts``: (cameras, nodes) that stay unchanged. Raises
        SettingsError: a picture does not fit its camera.
        """
        checked = [
            None if picture is None else check_picture(camera, picture)
            for camera, picture in zip(self.cameras, pictures, strict=True)
        ]
        placed = self._body.place(self.parameters(x))
        known = update_histograms(placed, self.cameras, checked, colours, pose_is_known)
        if excluded_parts is not None:
            known[excluded_parts] = colours[excluded_parts]
        return known

    def measure(
        self,
        evidence: ContourEvidence,
        x: Array,
        distance: float | None = None,
        iteration: int = 0,
        excluded_parts: Mask | None = None,
    ) -> ContourMeasurement | None:
        """Compare the model's contour at a state with a frame.

        Args:
            evidence: the frame.
            x: (n,) the state.
            distance: root mean square distance found by the previous measurement [pixel]; None:
                edges are searched in the whole reach.
            iteration: number of measurements of this frame made before; search lines in pictures
                become finer with it.
            excluded_parts: (cameras, nodes) parts that are not measured; None: none.

        Returns the measurement; None if no edge is near in any mask or picture.
        """
        width = CONTOUR.reach / REACH
        if distance is not None:
            width = min(width, CONTOUR.robust_width * max(CONTOUR.deviation, distance))
        found = self._compare(evidence, x, width, iteration)
        if found is None:
            return None
        shown = np.array([picture is not None for picture in evidence.pictures])
        if excluded_parts is not None:
            found[0].A[excluded_parts], found[0].b[excluded_parts] = 0.0, 0.0
        return self._compress(x, *found, shown)

    def _compare(
        self, evidence: ContourEvidence, x: Array, width: float, iteration: int
    ) -> tuple[Comparison, float] | None:
        """Compare the contours of the body at a state x (n,) with a frame; as of ``measure``.

        ``width``: scale of the robust cost [pixel]. Returns the comparison, and the weighted RMS
        distance [pixel].
        """
        step = AnnealingStage(width, CONTOUR.spacing)
        placed = self._body.place(self.parameters(x))
        weights = camera_weights(evidence.views.cameras, placed, step, _PLAIN, 1.0)
        compared = compare_views(evidence.views, placed, weights)
        if evidence.colours is not None and evidence.has_pictures:
            pixels = search_line_step(iteration)
            # Coarse search lines are so wide that denser ones would be redundant.
            lines = AnnealingStage(width, LINES.spacing * min(pixels, 2))
            correlation = _PLAIN.correlation * LINES.correlation / CONTOUR.correlation
            noise = replace(_PLAIN, correlation=correlation)
            add_pictures(
                compared, self.cameras, evidence.pictures, evidence.colours, lines, noise, pixels
            )
            weigh_parts(compared, CONTOUR.deviation, evidence.pictures)
        squares, weight = compared.sums[:, :, [Sum.SQUARES, Sum.WEIGHT]].sum(axis=(0, 1))
        return None if weight <= 0.0 else (compared, math.sqrt(squares / weight))

    def _compress(
        self, x: Array, compared: Comparison, distance: float, shown: Mask
    ) -> ContourMeasurement:
        """Return a comparison at a state as at most n independent measurements of variance 1.

        ``x``: (n,) the state. ``compared``: the comparison of the contours there. ``distance``:
        their root mean square [pixel]. ``shown``: (cameras,) which have a picture and no mask.
        """
        H, g = normal_equations(compared, len(self._body.names))
        index, scale = self._parameter_index, max(CONTOUR.deviation, distance)
        # Residuals are computed from both contours, so each gets half of the weight.
        weight = 0.5 / (scale**2 * CONTOUR.correlation)
        prior_curvature, prior_slope = self._prior_information
        slopes = weight * g[index] + prior_curvature @ x[self._moving] - prior_slope
        curvature = weight * H[np.ix_(index, index)] + prior_curvature
        size, turns = np.linalg.eigh(curvature)
        # Directions whose information is zero up to rounding are dropped.
        observable = size > max(float(size[-1]), 1e-300) * len(size) * np.finfo(np.float64).eps
        root, turns = np.sqrt(size[observable]), turns[:, observable]
        far = part_distances(compared.sums[shown]) > ndtri(1.0 - LEVEL) * CONTOUR.deviation
        lines = compared.sums[shown].sum(axis=(0, 1))
        length = compared.sums[..., Sum.COMPARED]
        off = length - compared.sums[..., Sum.FITTING]
        masked = length[~shown].sum(), off[~shown].sum()
        is_seen = not far.any() and 2.0 * lines[Sum.FITTING] >= lines[Sum.COMPARED]
        slope = np.zeros((len(root), len(self.layout)))
        slope[:, self._moving] = root[:, None] * turns.T
        return ContourMeasurement(
            names=tuple(f"contour_{k}" for k in range(len(root))),
            variances=np.ones(len(root)),
            wraps=np.zeros(len(root), dtype=np.bool_),
            h=np.zeros(len(root)),
            y=-(turns.T @ slopes) / root,
            H=slope,
            at=x,
            distance=distance,
            length=0.5 * float(compared.sums[~shown, :, Sum.COMPARED].sum()),
            is_explained=bool(is_seen and is_noise(*masked, CONTOUR.correlation)),
            hidden_parts=np.where(
                shown[:, None], far, ~is_noise(length, off, CONTOUR.correlation)[:, :-1]
            ),
            compared=compared,
        )

    def tile_costs(self, evidence: ContourEvidence, x: Array, side: float) -> tuple[Array, Array]:
        """Return costs of masks at a state x (n,), and lengths of their edges, by image tile.

        Both are (cameras, 64, 64) [pixel]; a cost is about the length of contour that does not fit.
        ``evidence``: the frame. ``side``: of a tile [pixel]; indices are taken modulo 64.
        """
        step = AnnealingStage(CONTOUR.robust_width * CONTOUR.deviation, CONTOUR.spacing)
        placed, views = self._body.place(self.parameters(x)), evidence.views
        weights = camera_weights(views.cameras, placed, step, _PLAIN, 1.0)
        surfaces = placed.packed, placed.X_WN
        costs = compare_contours(*surfaces, *views, weights, 64, side, False)[3]
        edges, lengths = views.evidence, np.zeros_like(costs)
        camera = np.searchsorted(edges.starts, np.arange(len(edges.uv)), "right") - 1
        column, row = (edges.uv // side).astype(np.intp).T % 64
        np.add.at(lengths, (camera, row, column), edges.lengths)
        return np.asarray(costs) / step.scale**2, lengths

    def spread(
        self, joints: Sequence[JointEstimate], values: Array, is_hidden: bool
    ) -> Array | None:
        """Return (n,) standard deviations of the state in what a search left undetermined.

        They are those of uniform distributions over its intervals, about the pose. None: all values
        are determined.

        ``joints``: of the tree's m values. ``values``: (m,) the pose [rad or m]. ``is_hidden``:
        whether intervals are the limits, as parts may be hidden.
        """
        low, high = np.array([[one.low, one.high] for one in joints]).T
        if is_hidden:
            low, high = self._kinematics.local_limits(values)
        third = ((high - values) ** 3 - (low - values) ** 3) / np.maximum(3.0 * (high - low), 1e-12)
        third[[one.determined for one in joints]] = 0.0
        spread = self.state_of(np.r_[np.sqrt(third), self._known_shift, 0.0])
        return spread if spread.any() else None

    def covariance(
        self, measured: ContourMeasurement, area: float, spread: Array | None = None
    ) -> Array:
        """Return the covariance (m, m) of the tree's values from one frame's measurement alone.

        It is 0 for values that are not free; errors are correlated, see ``fit.covariance``.

        ``area``: of all silhouettes [pixel]. ``spread``: (n,) further deviations of the state.
        """
        unit = error_unit(math.sqrt(area / len(self.cameras)))
        index, size = self._parameter_index, len(self._body.names)
        is_angle = np.array([self.is_angle(name) for name in self.layout.moving])
        moves = measured.compared.placement.dense(size)[:, index]
        cameras = pack_cameras(self.cameras)
        errors = distances(self._body.outlines, cameras, measured.compared, moves, unit)
        sizes = estimate_sizes(errors, is_angle)
        covariance, count = np.zeros((size, size)), len(self._kinematics.names)
        covariance[np.ix_(index, index)] = values_covariance(
            errors, sizes, np.arange(len(index)), is_angle
        )
        if spread is not None:
            covariance[index, index] += spread[self._moving] ** 2
        return covariance[:count, :count]
