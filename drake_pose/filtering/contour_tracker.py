"""A filter that follows any body through masks, by its contour."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.errors import SettingsError
from drake_pose.filtering.body_state import GROWTH
from drake_pose.filtering.contour import ContourMeasurement, ContourObservation, Seen
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncated_filter import (
    FilterSettings,
    FilterState,
    TruncatedFilter,
)
from drake_pose.filtering.update import LinearObservation
from drake_pose.fit.colours import Histograms

# A frame's pose that changes by less is settled [rad, m].
_STANDSTILL = 1e-3
# In the first two frames by masks no rate is known, and the pose may be far off: it is given so
# many times as many rounds to settle.
_FIRST_ROUNDS = 4
# Standard deviations at the start: angles [rad], the root's position and other lengths [m], and the
# logarithm of an unknown scale.
_START_ANGLE, _START_LENGTH, _START_GROWTH = 0.2, 0.03, 0.1
# The track is lost when the contour and the masks' edge are further apart than this [pixel], or a
# smaller share of the contour has an edge beside it.
_LOST_DISTANCE, _LOST_SHARE = 12.0, 0.6

LOST_COLOUR_DISTANCE = 1.5
"""And where a part's contour is further than this from that of a picture [pixel]: lines are looked
at so closely that a wrong pose cannot put them much further off. Such a part teaches no colours."""


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
    colours: Histograms | None = None


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
            layout.process_noise(scale),
            # A frame's numbers are not those of the frame before: there are no views to keep.
            FilterSettings(hypothesis_cap=1, novelty=0.0),
            layout.transition(math.exp(-period / self.settings.memory)),
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
        if name == GROWTH:
            return growth
        return angle if self.observation.is_angle(name) else length

    def start(self, x: Array) -> Track:
        """Begin at a state (n,), for example the matcher's, as sure of it as the settings say."""
        return Track(self.filter.start(self.start_belief(x)), None, False)

    def start_belief(self, x: Array) -> Belief:
        """What is believed of a state (n,) before inequalities and pictures: what settings say."""
        layout = self.observation.layout
        starts = (_START_GROWTH, _START_ANGLE, _START_LENGTH)
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
        self, observation: ContourObservation, seen: Seen, prediction: FilterState
    ) -> tuple[FilterState, ContourMeasurement | None]:
        """A frame's state, and the measurement there; None: the frame says nothing."""
        moving, state = len(observation.layout.moving), prediction
        measurement = observation.measure(seen, state.best.mean)
        rounds = self.settings.rounds
        if prediction.step <= 1 and not seen.has_pictures:
            rounds *= _FIRST_ROUNDS
        for k in range(rounds):
            if measurement is None:
                break
            before = state.best.mean
            state = self.filter.update(prediction, measurement.y, measurement)
            still = k > 0 and np.abs((state.best.mean - before)[:moving]).max() < _STANDSTILL
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
        whole = measurement.distance > _LOST_DISTANCE
        whole |= measurement.share < _LOST_SHARE
        return (measurement.part_distances > LOST_COLOUR_DISTANCE) | whole

    def _unsure(
        self,
        observation: ContourObservation,
        seen: Seen,
        prediction: FilterState,
        state: FilterState,
        measurement: ContourMeasurement,
        astray: Mask,
    ) -> FilterState:
        """Where all lines lead to, as unsure as if those of parts that are astray were not seen."""
        found, rest = state.best.mean, None
        if not astray.all():
            rounds = self.settings.rounds
            rest = observation.measure(seen, found, measurement.distance, rounds, astray)
        expected = prediction if rest is None else self.filter.update(prediction, rest.y, rest)
        moved = found - expected.best.mean
        belief = Belief(found, expected.best.covariance + np.outer(moved, moved))
        return replace(self.filter.start(belief), step=state.step)
