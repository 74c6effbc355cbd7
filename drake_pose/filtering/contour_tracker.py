"""Tracking of a pose tree by its contour in masks and pictures of any number of cameras.

``ContourObservation`` turns a frame into a linear measurement of the state, by comparing the
model's contour with edges. ``ContourTracker`` feeds these to a ``TruncatedFilter``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.errors import SettingsError, require_positive
from drake_pose.filtering.body_state import LOG_SCALE, BodyState
from drake_pose.filtering.motion import LinearMotion
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncated_filter import FilterSettings, FilterState, TruncatedFilter
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
from drake_pose.fit.kernel import REACH, Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage


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
    # Directions of the state with less than this fraction of the largest information are dropped.
    negligible: float = 1e-12


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

    The distances of hundreds of contour points are summed to normal equations. Their factorisation
    gives one scalar measurement with variance 1 for each observable direction of the state.
    """

    y: Array  # (k,) measured values; the predicted value at ``at`` is 0.
    inlier_ratio: float  # Fraction of the visible model contour with an edge nearby.
    distance: float  # Robustly weighted root mean square distance of contour and edges [pixel].
    # (nodes,) the same by part, in pictures [pixel]; 0 where evidence is too weak.
    part_distances: Array
    compared: Comparison  # The comparison of the contours at ``at``.


class ContourObservation(BodyState):
    """Turns masks and pictures into measurements of a tree's state, with ``fit.colours``."""

    def gather_evidence(
        self,
        masks: Sequence[Mask | None],
        pictures: Sequence[Picture | None] | None = None,
        colours: Floats | None = None,
    ) -> ContourEvidence:
        """Return the evidence of a frame; edge points are found once for all its measurements.

        Args:
            masks: for each of ``cameras`` (H, W) or None.
            pictures: for each camera (H, W, 3 or 4) or None; used for cameras without a mask. None:
                no pictures.
            colours: colour histograms of the body; None: pictures are not used.

        Raises SettingsError: the number or size of masks or pictures does not fit the cameras.
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

        Args:
            pictures: for each camera (H, W, 3 or 4) or None.
            x: (n,) the state in this frame.
            colours: the histograms before this frame.
            pose_is_known: whether the state is certain, so that the old histograms are discarded.
            excluded_parts: (nodes,) parts whose histograms stay unchanged; None: none.

        Raises SettingsError: a picture does not fit its camera.
        """
        checked = [
            None if picture is None else check_picture(camera, picture)
            for camera, picture in zip(self.cameras, pictures, strict=True)
        ]
        placed = self._body.place(self.parameters(x))
        known = update_histograms(placed, self.cameras, checked, colours, pose_is_known)
        if excluded_parts is not None:
            known[:, excluded_parts] = colours[:, excluded_parts]
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
            excluded_parts: (nodes,) parts that are not measured in pictures; None: none.

        Returns the measurement; None if no edge is near the contour in any mask or picture.
        """
        width = CONTOUR.reach / REACH
        if distance is not None:
            width = min(width, CONTOUR.robust_width * max(CONTOUR.deviation, distance))
        found = self._compare(evidence, x, width, iteration)
        if found is None:
            return None
        shown = np.array([picture is not None for picture in evidence.pictures])
        if excluded_parts is not None:
            off = np.ix_(shown, excluded_parts)
            found[0].A[off], found[0].b[off] = 0.0, 0.0
        return self._compress(x, *found, part_distances(found[0].sums[shown]))

    def _compare(
        self, evidence: ContourEvidence, x: Array, width: float, iteration: int
    ) -> tuple[Comparison, float] | None:
        """Compare the contours of the body at a state x (n,) with a frame.

        ``width``: scale of the robust cost [pixel]. ``iteration``: number of measurements made
        before. Returns the comparison, and the weighted RMS distance [pixel]; None: no edge is
        near.
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
        self, x: Array, compared: Comparison, distance: float, parts: Array
    ) -> ContourMeasurement:
        """Return a comparison at a state as at most n independent measurements of variance 1.

        Args:
            x: (n,) the state.
            compared: the comparison of the contours there.
            distance: root mean square distance of the contours [pixel].
            parts: ``ContourMeasurement.part_distances``.
        """
        H, g = normal_equations(compared, len(self._body.names))
        index = self._parameter_index
        scale = max(CONTOUR.deviation, distance)
        # Residuals are computed from both contours, so each gets half of the weight.
        weight = 0.5 / (scale**2 * CONTOUR.correlation)
        prior_curvature, prior_slope = self._prior_information
        slopes = weight * g[index] + prior_curvature @ x[self._state_index] - prior_slope
        curvature = weight * H[np.ix_(index, index)] + prior_curvature
        size, turns = np.linalg.eigh(curvature)
        observable = size > CONTOUR.negligible * max(float(size[-1]), 1e-300)
        root, turns = np.sqrt(size[observable]), turns[:, observable]
        slope = np.zeros((len(root), len(self.layout)))
        slope[:, self._state_index] = root[:, None] * turns.T
        contour = compared.sums[:, :-1].sum(axis=(0, 1))
        return ContourMeasurement(
            names=tuple(f"contour_{k}" for k in range(len(root))),
            variances=np.ones(len(root)),
            wraps=np.zeros(len(root), dtype=np.bool_),
            h=np.zeros(len(root)),
            y=-(turns.T @ slopes) / root,
            H=slope,
            at=x,
            inlier_ratio=float(contour[Sum.FITTING] / max(contour[Sum.COMPARED], 1e-9)),
            distance=distance,
            part_distances=parts,
            compared=compared,
        )

    def covariance(self, measured: ContourMeasurement, area: float) -> Array:
        """Return the covariance (m, m) of the tree's values from one frame's measurement alone.

        It is 0 for values that are not free. Errors of surfaces, masks and cameras are correlated,
        see ``fit.covariance``.

        ``measured``: the measurement. ``area``: total area of all silhouettes [pixel].
        """
        unit = error_unit(math.sqrt(area / len(self.cameras)))
        index, size = self._parameter_index, len(self._body.names)
        is_angle = np.array([self.is_angle(name) for name in self._element_names])
        moves = measured.compared.placement.dense(size)[:, index]
        cameras = pack_cameras(self.cameras)
        errors = distances(self._body.outlines, cameras, measured.compared, moves, unit)
        sizes = estimate_sizes(errors, is_angle)
        covariance, count = np.zeros((size, size)), len(self._kinematics.names)
        covariance[np.ix_(index, index)] = values_covariance(
            errors, sizes, np.arange(len(index)), is_angle
        )
        return covariance[:count, :count]


@dataclass(frozen=True)
class TrackingSettings:
    """Settings of a ``ContourTracker`` and of ``MatchAndTrack``.

    Args:
        angle_acceleration: standard deviation of the acceleration of joint angles [rad/s^2].
        length_acceleration: of the root's position and of sliding joints [m/s^2].
        log_scale_acceleration: of the log scale, if unknown [1/s^2].
        memory: time constant of the decay of rates [s]; occluded limbs come to rest.
        rounds: largest number of contour comparisons in a frame.
        root_moves: whether the root's position in the world is estimated.
        scale_unknown: whether the scale of the one parallel camera is estimated, and may drift.
        rest_time: time constant with which unobserved joints return to their prior (the middle of
            their limits, or that of a couplings file) [s]. It also decides which way joints bend
            where the silhouette is the same for both. None: no prior.
        standstill: a frame's iteration ends when the pose changes by less [rad, m].
        first_rounds: factor on ``rounds`` in the first two frames with masks, when rates are
            unknown.
        start_angle, start_length, start_log_scale: standard deviations at the start of angles
            [rad], of the root's position and other lengths [m], and of the log scale.
        lost_distance: a track is lost if the distance of its contour from the edges is larger
            [pixel].
        lost_inlier_ratio: a track is lost if a smaller fraction of its contour has an edge nearby.
        lost_colour_distance: a part is lost if the distance of its contour in pictures is larger
            [pixel]. Search lines are so short that even wrong poses have small distances. The
            colours of a lost part are not learned.
        patience: time for which a track without explanation is predicted before the best pose of a
            search replaces it, however bad [s].
        search_pause: time between two searches meanwhile [s].
        retries: number of frames in which a search that reached its time limit is repeated.

    Raises:
        SettingsError: a number is not positive.
    """

    angle_acceleration: float = 15.0
    length_acceleration: float = 5.0
    log_scale_acceleration: float = 0.1
    memory: float = 0.15
    rounds: int = 4
    root_moves: bool = False
    scale_unknown: bool = False
    rest_time: float | None = None
    standstill: float = 1e-3
    first_rounds: int = 4
    start_angle: float = 0.2
    start_length: float = 0.03
    start_log_scale: float = 0.1
    lost_distance: float = 12.0
    lost_inlier_ratio: float = 0.6
    lost_colour_distance: float = 1.5
    patience: float = 1.0
    search_pause: float = 0.2
    retries: int = 5

    def __post_init__(self) -> None:
        require_positive(**{k: one for k, one in vars(self).items() if not isinstance(one, bool)})


@dataclass(frozen=True, eq=False)
class Track:
    """The state of a ``ContourTracker`` after a frame.

    Attributes:
        state: belief of the pose tree's state.
        measurement: of the contour at the final state; None: no edge was near the contour.
        lost: whether the contour is too far from the edges, or that of a part in pictures, or no
            edge was near it in a frame with evidence. A frame without evidence keeps the value.
        colours: colour histograms of the body; None before the first picture.
    """

    state: FilterState
    measurement: ContourMeasurement | None
    lost: bool
    colours: Floats | None = None


class ContourTracker:
    """Tracks a pose tree's state from frame to frame, inside its limits.

    Args:
        observation: the body and the cameras.
        period: time between two frames [s].
        settings: None: TrackingSettings().

    Raises:
        SettingsError: the period is not positive.
    """

    def __init__(
        self,
        observation: ContourObservation,
        period: float,
        settings: TrackingSettings | None = None,
    ) -> None:
        require_positive(period=period)
        self.observation, self.settings = observation, settings or TrackingSettings()
        layout = observation.layout
        scale = {name: period**2 * self.acceleration(name) for name in layout.moving}
        size, none = len(layout), np.zeros(0)
        # Each frame has its own observation model.
        nothing = LinearObservation((), none, none > 0, np.zeros(size), none, np.zeros((0, size)))
        self.filter = TruncatedFilter(
            layout,
            nothing,
            observation.inequalities(),
            LinearMotion(
                layout.transition(math.exp(-period / self.settings.memory)),
                layout.process_noise(scale),
                None,
            ),
            # Measurements of different frames are not comparable, so there are no static views.
            FilterSettings(hypothesis_cap=1, linearisation="tangent", iterations=20),
        )
        self._period = period

    def acceleration(self, name: str) -> float:
        """Return the acceleration's standard deviation of ``name``, in its unit or 1 per s^2."""
        s = self.settings
        return self._of_kind(
            name, s.log_scale_acceleration, s.angle_acceleration, s.length_acceleration
        )

    def _of_kind(self, name: str, log_scale: float, angle: float, length: float) -> float:
        """Return ``log_scale``, ``angle`` or ``length``, whichever the element ``name`` is."""
        if name == LOG_SCALE:
            return log_scale
        return angle if self.observation.is_angle(name) else length

    def start(self, x: Array) -> Track:
        """Return the track that starts at x (n,) with ``start_belief``, truncated by the limits."""
        return Track(self.filter.start(self.start_belief(x)), None, False)

    def start_belief(self, x: Array) -> Belief:
        """Return the initial belief with mean x (n,), before limits and measurements."""
        layout, settings = self.observation.layout, self.settings
        starts = (settings.start_log_scale, settings.start_angle, settings.start_length)
        # Standard deviation of a rate [unit/step] that accelerates during ``memory``.
        picked_up = self.settings.memory * self._period
        deviations = [
            *(self._of_kind(name, *starts) for name in layout.moving),
            *(picked_up * self.acceleration(name) for name in layout.moving),
        ]
        return Belief(x, np.diag(np.square(deviations)))

    def follow(
        self,
        track: Track,
        masks: Sequence[Mask | None],
        first: bool = False,
        root_position: Array | None = None,
        pictures: Sequence[Picture | None] | None = None,
    ) -> Track:
        """Return the track after the next frame.

        Args:
            track: after the last frame, or ``start``.
            masks: for each camera (H, W) or None.
            first: whether ``track`` was started in this very frame, so that it is not predicted.
            root_position: (3,) known position of the root in the world [m]; None: as in the tree.
            pictures: for each camera (H, W, 3 or 4) or None; None: no pictures. The colours along
                the contour are used for cameras without a mask; they are learned from each frame,
                at first at the start.

        Raises SettingsError: the number or size of masks or pictures does not fit the cameras.
        """
        observation = self.observation
        if root_position is not None:
            observation = observation.with_root_position(root_position)
        prediction = track.state if first else self.filter.predict(track.state)
        colours = track.colours
        if pictures is not None and colours is None:
            colours = observation.uninformed_histograms()
            if all(mask is None for mask in masks):
                colours = observation.update_histograms(
                    pictures, prediction.best.mean, colours, True
                )
        evidence = observation.gather_evidence(masks, pictures, colours)
        state, measurement = self._fit(observation, evidence, prediction)
        if measurement is None:
            shown = any(one is not None for one in (*masks, *(pictures or ())))
            return Track(state, None, track.lost or shown, colours)
        whole = measurement.distance > self.settings.lost_distance
        whole |= measurement.inlier_ratio < self.settings.lost_inlier_ratio
        lost_parts = (measurement.part_distances > self.settings.lost_colour_distance) | whole
        if pictures is not None and colours is not None and not lost_parts.all():
            colours = observation.update_histograms(
                pictures, state.best.mean, colours, excluded_parts=lost_parts
            )
        if evidence.has_pictures and lost_parts.any():
            state = self._widened(observation, evidence, prediction, state, measurement, lost_parts)
        return Track(state, measurement, bool(lost_parts.any()), colours)

    def _fit(
        self, observation: ContourObservation, evidence: ContourEvidence, prediction: FilterState
    ) -> tuple[FilterState, ContourMeasurement | None]:
        """Return state and measurement in a frame after ``prediction``; None: no edge is near."""
        moving, state = len(observation.layout.moving), prediction
        measurement = observation.measure(evidence, state.best.mean)
        rounds = self.settings.rounds
        if prediction.step <= 1 and not evidence.has_pictures:
            rounds *= self.settings.first_rounds
        for k in range(rounds):
            if measurement is None:
                break
            before = state.best.mean
            state = self.filter.update(prediction, measurement.y, measurement)
            still = (
                k > 0
                and np.abs((state.best.mean - before)[:moving]).max() < self.settings.standstill
            )
            # With masks the last comparison is made at the final state. With pictures the number of
            # comparisons is limited, and the finest search lines must have been reached.
            if evidence.has_pictures:
                is_finest = search_line_step(k) == LINES.steps[-1]
                still = k + 1 == rounds or (still and is_finest)
            if still:
                break
            measurement = observation.measure(
                evidence, state.best.mean, measurement.distance, k + 1
            )
        return state, measurement

    def _widened(
        self,
        observation: ContourObservation,
        evidence: ContourEvidence,
        prediction: FilterState,
        state: FilterState,
        measurement: ContourMeasurement,
        lost_parts: Mask,
    ) -> FilterState:
        """Return ``state`` with the uncertainty it has without the lost parts' measurements.

        ``state`` and ``measurement`` are those of ``_fit`` from ``prediction``; ``lost_parts`` is
        (nodes,). The shift that lost parts cause is added to the covariance. If more than half of
        the parts are lost, return the prediction: their search lines are unreliable.
        """
        found, remaining = state.best.mean, None
        if 2 * np.count_nonzero(lost_parts) > len(lost_parts):
            return prediction
        if not lost_parts.all():
            rounds = self.settings.rounds
            remaining = observation.measure(
                evidence, found, measurement.distance, rounds, lost_parts
            )
        expected = prediction
        if remaining is not None:
            expected = self.filter.update(prediction, remaining.y, remaining)
        moved = found - expected.best.mean
        belief = Belief(found, expected.best.covariance + np.outer(moved, moved))
        return replace(self.filter.start(belief), step=state.step)
