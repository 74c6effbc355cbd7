"""The contour of any model in any number of masks, as a measurement of its pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.errors import SettingsError
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
    """How a contour is measured.

    Args:
        spacing: distance between two points of the contour [pixel].
        deviation: standard deviation of a mask's edge about the body's own contour, at least
            [pixel].
        correlation: length of contour whose errors are alike; its points count as one [pixel].
        reach: distance from the model's contour in which a mask's edge is looked for [pixel].
        robust_width: deviations at which Geman and McClure's weight has half its influence.
        negligible: directions with less than this fraction of the largest information are dropped.
    """

    spacing: float = 3.0
    deviation: float = 0.7
    correlation: float = 12.0
    reach: float = 40.0
    robust_width: float = 2.5
    negligible: float = 1e-12


CONTOUR = ContourSettings()


# A pixel of contour has weight one.
_PLAIN = Noise(deviation=1.0, correlation=0.5)


class ContourEvidence(NamedTuple):
    """What a frame shows.

    views: the edges of masks; pictures: of cameras without a mask, else None; colours: what is
    known of the body's colours before the frame.
    """

    views: Views
    pictures: tuple[Picture | None, ...]
    colours: Floats | None

    @property
    def has_pictures(self) -> bool:
        """Whether there is one to be compared."""
        return self.colours is not None and any(one is not None for one in self.pictures)


@dataclass(frozen=True, eq=False)
class ContourMeasurement(LinearObservation):
    """What masks say of a pose near one state, made for one frame.

    The distances of hundreds of contour points are summed to normal equations, and these are as
    many numbers with noise 1 as there are directions of the state that they tell something about.

    Attributes:
        y: (k,) what was measured, 0 at ``at``.
        share: of the contour that the model shows, what has an edge beside it.
        distance: root mean square of their distances, robustly weighted [pixel].
        part_distances: (nodes,) of each part in the pictures [pixel]; 0 where they say too little.
        compared: the contours, as they were compared at ``at``.
    """

    y: Array
    share: float
    distance: float
    part_distances: Array
    compared: Comparison


class ContourObservation(BodyState):
    """Turns masks and pictures into measurements of a pose tree's values."""

    def look(
        self,
        masks: Sequence[Mask | None],
        pictures: Sequence[Picture | None] | None = None,
        colours: Floats | None = None,
    ) -> ContourEvidence:
        """What a frame shows: the points of masks' edges, found once for all its measurements.

        Args:
            masks: (H, W) of each camera, in their order; None where there is none.
            pictures: (H, W, 3 or 4) of each camera; None where there is none. They are compared
                where there is no mask.
            colours: what is known of the body's colours; None: nothing, and pictures say nothing.

        Raises:
            SettingsError: masks or pictures that do not fit the cameras.
        """
        pictures = [None] * len(masks) if pictures is None else pictures
        for what, given in (("masks", masks), ("pictures", pictures)):
            if len(given) != len(self.cameras):
                raise SettingsError(f"{len(self.cameras)} {what} expected, got {len(given)}")
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

    def is_finest(self, number: int) -> bool:
        """Whether no later measurement of a frame looks at pictures more closely than this one."""
        return search_line_step(number) == search_line_step(number + 9)

    def no_colours(self) -> Floats:
        """What is known of a body's colours that was never seen."""
        return uninformed_histograms(len(self.cameras), len(self._body.outlines))

    def learn(
        self,
        pictures: Sequence[Picture | None],
        x: Array,
        colours: Floats,
        surely: bool = False,
        without: Mask | None = None,
    ) -> Floats:
        """What is known of the body's colours after a frame.

        Args:
            pictures: of each camera; None where there is none.
            x: (n,) the state in the frame.
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
        known = update_histograms(placed, self.cameras, checked, colours, surely)
        if without is not None:
            known[:, without] = colours[:, without]
        return known

    def measure(
        self,
        seen: ContourEvidence,
        x: Array,
        distance: float | None = None,
        number: int = 0,
        without: Mask | None = None,
    ) -> ContourMeasurement | None:
        """Compare the model's contour at a state with a frame.

        Args:
            distance: about how far they are apart [pixel], of the measurement before; None: as far
                as is looked.
            number: how many measurements of the frame were made before: lines in pictures are
                looked at more closely from one to the next.
            without: (nodes,) parts of which the pictures say nothing.

        Returns:
            The measurement; None where no edge is near the contour in any mask or picture.
        """
        width = CONTOUR.reach / REACH
        if distance is not None:
            width = min(width, CONTOUR.robust_width * max(CONTOUR.deviation, distance))
        found = self._compare(seen, x, width, number)
        if found is None:
            return None
        shown = np.array([picture is not None for picture in seen.pictures])
        if without is not None:
            off = np.ix_(shown, without)
            found[0].A[off], found[0].b[off] = 0.0, 0.0
        return self._compress(x, *found, part_distances(found[0].sums[shown]))

    def _compare(
        self, seen: ContourEvidence, x: Array, width: float, number: int
    ) -> tuple[Comparison, float] | None:
        """Contours compared with so wide a scale [pixel], and how far they are apart [pixel]."""
        step = AnnealingStage(width, CONTOUR.spacing)
        placed = self._body.place(self.parameters(x))
        weights = camera_weights(seen.views.cameras, placed, step, _PLAIN, 1.0)
        compared = compare_views(seen.views, placed, weights)
        if seen.colours is not None and seen.has_pictures:
            pixels = search_line_step(number)
            # Coarse lines are so wide that they would say the same.
            lines = AnnealingStage(width, LINES.spacing * min(pixels, 2))
            correlation = _PLAIN.correlation * LINES.correlation / CONTOUR.correlation
            noise = replace(_PLAIN, correlation=correlation)
            add_pictures(compared, self.cameras, seen.pictures, seen.colours, lines, noise, pixels)
            weigh_parts(compared, CONTOUR.deviation, seen.pictures)
        squares, weight = compared.sums[:, :, [Sum.SQUARES, Sum.WEIGHT]].sum(axis=(0, 1))
        return None if weight <= 0.0 else (compared, math.sqrt(squares / weight))

    def _compress(
        self, x: Array, compared: Comparison, distance: float, parts: Array
    ) -> ContourMeasurement:
        """What the contours say as no more numbers than the state has elements, with noise 1."""
        H, g = normal_equations(compared, len(self._body.names))
        index = self._parameter_index
        scale = max(CONTOUR.deviation, distance)
        # Both contours say the same: together they count as one.
        worth = 0.5 / (scale**2 * CONTOUR.correlation)
        rest_curvature, rest_slope = self._rest
        slopes = worth * g[index] + rest_curvature @ x[self._state_index] - rest_slope
        curvature = worth * H[np.ix_(index, index)] + rest_curvature
        size, turns = np.linalg.eigh(curvature)
        told = size > CONTOUR.negligible * max(float(size[-1]), 1e-300)
        root, turns = np.sqrt(size[told]), turns[:, told]
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
            share=float(contour[Sum.FITTING] / max(contour[Sum.COMPARED], 1e-9)),
            distance=distance,
            part_distances=parts,
            compared=compared,
        )

    def covariance(self, measured: ContourMeasurement, area: float) -> Array:
        """(m, m) of the tree's values where they were measured, as if the instant stood alone.

        Surfaces, masks and cameras err together, see ``fit.covariance``; area: of all silhouettes.
        """
        unit = error_unit(math.sqrt(area / len(self.cameras)))
        index, size = self._parameter_index, len(self._body.names)
        is_angle = np.array([self.is_angle(name) for name in self._seen_names])
        moves = measured.compared.placement.dense(size)[:, index]
        cameras = pack_cameras(self.cameras)
        seen = distances(self._body.outlines, cameras, measured.compared, moves, unit)
        sizes = estimate_sizes(seen, is_angle)
        covariance, count = np.zeros((size, size)), len(self._kinematics.names)
        covariance[np.ix_(index, index)] = values_covariance(
            seen, sizes, np.arange(len(index)), is_angle
        )
        return covariance[:count, :count]


@dataclass(frozen=True)
class TrackingSettings:
    """How a body may move, and how its contour is followed.

    Args:
        angle_acceleration: standard deviation of every joint's acceleration [rad/s^2].
        length_acceleration: of the root's, and of joints that slide [m/s^2].
        growth_acceleration: of the logarithm of a scale that is unknown [1/s^2].
        memory: time in which a rate that is not seen fades [s]: a hidden limb comes to rest.
        rounds: how often the contour is compared anew in each frame; in the first two by masks up
            to four times as often, as long as the pose changes.
        root_moves: whether the root may be elsewhere than where the tree holds it.
        scale_unknown: whether the scale of the one parallel camera is unknown, and may drift.
        rest_time: in about this time joints that are not seen come to the middle of their limits
            [s]; it also tells which way they bend where the picture is the same for both. None:
            they stay where they are.
        standstill: a frame's pose that changes by less is settled [rad, m].
        first_rounds: factor of ``rounds`` in the first two frames by masks, whose rates are not
            known yet.
        start_angle, start_length, start_growth: standard deviations at the start, of angles [rad],
            of the root's position and other lengths [m], of the logarithm of an unknown scale.
        lost_distance: a track is lost whose contour is farther from the masks' edge [pixel].
        lost_inlier_ratio: a track is lost if a smaller fraction of its contour has an edge near.
        lost_colour_distance: a part is lost whose contour is farther from a picture's [pixel]:
            search lines are so short that a wrong pose cannot put them much further off. Such a
            part teaches no colours.
        patience: a track that no pose explains is predicted for this time before the best pose
            that a search finds replaces it [s].
        search_pause: meanwhile the search is asked once in this time [s].
        retries: number of frames in which a search that a time limit has ended is asked again.

    Raises:
        SettingsError: a number that is not positive.
    """

    angle_acceleration: float = 15.0
    length_acceleration: float = 5.0
    growth_acceleration: float = 0.1
    memory: float = 0.15
    rounds: int = 4
    root_moves: bool = False
    scale_unknown: bool = False
    rest_time: float | None = None
    standstill: float = 1e-3
    first_rounds: int = 4
    start_angle: float = 0.2
    start_length: float = 0.03
    start_growth: float = 0.1
    lost_distance: float = 12.0
    lost_inlier_ratio: float = 0.6
    lost_colour_distance: float = 1.5
    patience: float = 1.0
    search_pause: float = 0.2
    retries: int = 5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not isinstance(value, bool) and not 0 < value < math.inf:
                raise SettingsError(f"{name} must be positive, not {value}")


@dataclass(frozen=True, eq=False)
class Track:
    """Where a tracker is after a frame.

    Attributes:
        measurement: of the contour at the end; None where no mask was given.
        lost: whether the contour is far from the masks' edge, or a part's from that which colours
            show.
        colours: what is known of the body's colours; None: no picture was seen yet.
    """

    state: FilterState
    measurement: ContourMeasurement | None
    lost: bool
    colours: Floats | None = None


class ContourTracker:
    """Follows a pose tree's values from mask to mask, inside the limits.

    Args:
        observation: the body and its cameras.
        period: time between two frames [s].

    Raises:
        SettingsError: a period that is not positive.
    """

    def __init__(
        self,
        observation: ContourObservation,
        period: float,
        settings: TrackingSettings | None = None,
    ) -> None:
        if not 0 < period < math.inf:
            raise SettingsError(f"the tracker's period must be positive, not {period}")
        self.observation, self.settings = observation, settings or TrackingSettings()
        layout = observation.layout
        scale = {name: period**2 * self.acceleration(name) for name in layout.moving}
        size, none = len(layout), np.zeros(0)
        # Frames bring their own measurements.
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
            # A frame's numbers are not those of the frame before: there are no views to keep.
            FilterSettings(hypothesis_cap=1, linearisation="tangent", iterations=20),
        )
        self._period = period

    def acceleration(self, name: str) -> float:
        """Of what moves [rad/s^2, m/s^2 or 1/s^2]."""
        s = self.settings
        return self._of_kind(
            name, s.growth_acceleration, s.angle_acceleration, s.length_acceleration
        )

    def _of_kind(self, name: str, growth: float, angle: float, length: float) -> float:
        """One of three numbers: that of what a moving element is."""
        if name == LOG_SCALE:
            return growth
        return angle if self.observation.is_angle(name) else length

    def start(self, x: Array) -> Track:
        """Begin at a state (n,), for example the matcher's, as sure of it as the settings say."""
        return Track(self.filter.start(self.start_belief(x)), None, False)

    def start_belief(self, x: Array) -> Belief:
        """What is believed of a state (n,) before inequalities and pictures: what settings say."""
        layout, settings = self.observation.layout, self.settings
        starts = (settings.start_growth, settings.start_angle, settings.start_length)
        # What a limb picks up while its rate is remembered.
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
        """The next frame.

        Args:
            masks: (H, W) of each camera; None where there is none.
            first: the frame that the start was made for: nothing has moved since.
            root_position: (3,) where the root is known to be now, if not where the tree holds it
                [m].
            pictures: (H, W, 3 or 4) of each camera; None where there is none. The colours along the
                contour stand in where there is no mask. What they are is learned from every
                frame, and at first where the start was.

        Raises:
            SettingsError: masks or pictures that do not fit the cameras.
        """
        observation = self.observation
        if root_position is not None:
            observation = observation.with_root_position(root_position)
        prediction = track.state if first else self.filter.predict(track.state)
        colours = track.colours
        if pictures is not None and colours is None:
            colours = observation.no_colours()
            if all(mask is None for mask in masks):
                colours = observation.learn(pictures, prediction.best.mean, colours, True)
        seen = observation.look(masks, pictures, colours)
        state, measurement = self._fit(observation, seen, prediction)
        if measurement is None:
            shown = any(one is not None for one in (*masks, *(pictures or ())))
            return Track(state, None, track.lost or shown, colours)
        astray = self._astray(measurement)
        if pictures is not None and colours is not None and not astray.all():
            colours = observation.learn(pictures, state.best.mean, colours, without=astray)
        if seen.has_pictures and astray.any():
            state = self._unsure(observation, seen, prediction, state, measurement, astray)
        return Track(state, measurement, bool(astray.any()), colours)

    def _fit(
        self, observation: ContourObservation, seen: ContourEvidence, prediction: FilterState
    ) -> tuple[FilterState, ContourMeasurement | None]:
        """A frame's state, and the measurement there; None: the frame says nothing."""
        moving, state = len(observation.layout.moving), prediction
        measurement = observation.measure(seen, state.best.mean)
        rounds = self.settings.rounds
        if prediction.step <= 1 and not seen.has_pictures:
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
            # The contour is compared where the state is, or as good as that: lines in pictures are
            # compared no more often than there are rounds.
            if seen.has_pictures:
                still = k + 1 == rounds or (still and observation.is_finest(k))
            if still:
                break
            measurement = observation.measure(seen, state.best.mean, measurement.distance, k + 1)
        return state, measurement

    def _astray(self, measurement: ContourMeasurement) -> Mask:
        """(nodes,) parts that are not where pictures show them; all where the whole body is not."""
        whole = measurement.distance > self.settings.lost_distance
        whole |= measurement.share < self.settings.lost_inlier_ratio
        return (measurement.part_distances > self.settings.lost_colour_distance) | whole

    def _unsure(
        self,
        observation: ContourObservation,
        seen: ContourEvidence,
        prediction: FilterState,
        state: FilterState,
        measurement: ContourMeasurement,
        astray: Mask,
    ) -> FilterState:
        """Where all lines lead to, as unsure as if those of parts that are astray were not seen.

        Where more than half of the parts are astray, what is predicted: lines lead anywhere.
        """
        found, rest = state.best.mean, None
        if 2 * np.count_nonzero(astray) > len(astray):
            return prediction
        if not astray.all():
            rounds = self.settings.rounds
            rest = observation.measure(seen, found, measurement.distance, rounds, astray)
        expected = prediction if rest is None else self.filter.update(prediction, rest.y, rest)
        moved = found - expected.best.mean
        belief = Belief(found, expected.best.covariance + np.outer(moved, moved))
        return replace(self.filter.start(belief), step=state.step)
