"""Tracking of a pose tree by its contour, with a search where that fails.

``ContourTracker`` feeds the contours of masks and pictures to a ``TruncatedFilter``;
``MatchAndTrack`` begins a track by a search, and searches again after a loss.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import require_positive
from drake_pose.filtering.contour_observation import (
    LOG_SCALE,
    ContourEvidence,
    ContourMeasurement,
    ContourObservation,
)
from drake_pose.filtering.motion import LinearMotion
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncated_filter import FilterSettings, FilterState, TruncatedFilter
from drake_pose.filtering.update import LinearObservation
from drake_pose.fit.colours import LINES, search_line_step
from drake_pose.search import (
    TRACKED,
    UNEXPLAINED,
    MultiStartSearch,
    PoseEstimate,
    PoseSearch,
    View,
    covariance_pose_set,
)
from drake_pose.silhouette.pictures.masks import count_edge_pixels


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

    ``observation``: the body and the cameras. ``period``: time between two frames [s].
    ``settings``: None: TrackingSettings().

    Raises SettingsError: the period is not positive.
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
        """Return the standard deviation of an element's acceleration [unit/s^2]."""
        own = self.settings
        return self._of_kind(
            name, own.log_scale_acceleration, own.angle_acceleration, own.length_acceleration
        )

    def _of_kind(self, name: str, log_scale: float, angle: float, length: float) -> float:
        """Return ``log_scale``, ``angle`` or ``length``, whichever the element ``name`` is."""
        if name == LOG_SCALE:
            return log_scale
        return angle if self.observation.is_angle(name) else length

    def start(self, x: Array) -> Track:
        """Return the track that starts at the mean x (n,), truncated by the limits."""
        moving = self.observation.layout.moving
        # Standard deviation of a rate [unit/step] that accelerates during ``memory``.
        picked_up = self.settings.memory * self._period
        rates = [picked_up * self.acceleration(name) for name in moving]
        settings = self.settings
        kinds = (settings.start_log_scale, settings.start_angle, settings.start_length)
        deviations = [*(self._of_kind(name, *kinds) for name in moving), *rates]
        belief = Belief(x, np.diag(np.square(deviations)))
        return Track(self.filter.start(belief), None, False)

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

    def delayed(self, track: Track) -> Track:
        """Return the track after a frame whose pictures may be late by up to a period.

        The belief is widened by what the motion of a period moves the measurement.
        """
        measured, belief = track.measurement, track.state.best
        if measured is None:
            return track
        count = len(self.observation.layout.moving)
        moved = np.zeros(len(belief.mean))
        moved[:count] = belief.mean[count : 2 * count]
        shift = belief.covariance @ (measured.H.T @ (measured.H @ moved))
        wide = Belief(belief.mean, belief.covariance + np.outer(shift, shift))
        return replace(track, state=replace(self.filter.start(wide), step=track.state.step))

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


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The state of ``MatchAndTrack`` after a frame."""

    track: Track | None = None  # The contour track; None before the first pose.
    reference: float = 0.0  # E_total after the last match; a track with a much larger one is lost.
    matches: int = 0  # Number of searches so far.
    # Number of consecutive frames, up to this one, that no pose explains; the track is predicted
    # through them.
    unexplained: int = 0
    # Number of following frames in which the search is repeated because it reached its time limit.
    retries: int = 0


def make_tracker(
    tree: PoseTree, cameras: Sequence[Camera], period: float, settings: TrackingSettings
) -> ContourTracker:
    """Return a tracker of a pose tree's contour; ``period``: time between two frames [s].

    Raises SettingsError: there is no camera, the period is not positive, or the tree has no free
    value.
    """
    prior_weight = 0.0 if settings.rest_time is None else period / settings.rest_time
    observation = ContourObservation(
        tree, cameras, settings.root_moves, settings.scale_unknown, prior_weight
    )
    return ContourTracker(observation, period, settings)


@dataclass(frozen=True, eq=False)
class _GivenFrame:
    """The evidence of a frame."""

    views: Sequence[View]  # The cameras that have a mask, with it; for the search.
    # (3,) the root's known position in the world [m]; None: as in the tree.
    root_position: Array | None
    observation: ContourObservation  # The body with its root there.
    masks: list[Mask | None]  # For each camera (H, W) or None.
    # For each camera (H, W, 3 or 4) or None; None: no pictures.
    pictures: list[Picture | None] | None
    begin: float  # Time at which the processing of the frame started [s].


class MatchAndTrack:
    """Tracks a body from frame to frame, and searches for it where tracking fails.

    A frame that no pose explains, because the body is hidden or there is no evidence, leaves the
    track predicted: its standard deviations grow, and the frame's pose is not found. A pose from
    the search replaces the prediction only if it explains the masks about as well as earlier poses
    did, or after ``TrackingSettings.patience``.

    Args:
        search: used in the first frame and when the track is lost; it has the pose tree.
        cameras: all cameras of the sequence.
        period: time between two frames [s].
        settings: None: TrackingSettings().
        search_time: time limit of a ``MultiStartSearch`` [s]; None: the search's own. A search that
            reaches it is repeated in the next frames.

    Raises:
        SettingsError: there is no camera, the period is not positive, or the tree has no free
            value.
    """

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera],
        period: float,
        settings: TrackingSettings | None = None,
        search_time: float | None = None,
    ) -> None:
        self.settings, self._period = settings or TrackingSettings(), period
        if search_time is not None and isinstance(search, MultiStartSearch):
            search = search.with_time_limit(search_time)
        self._search = search
        self.tracker = make_tracker(search.tree, cameras, period, self.settings)

    def next(
        self,
        last: TrackerState,
        views: Sequence[View],
        root_position: Array | None = None,
        pictures: Mapping[str, Picture] | None = None,
        start: Array | None = None,
    ) -> tuple[TrackerState, PoseEstimate]:
        """Process the next frame.

        Args:
            last: the state after the previous frame; TrackerState() before the first.
            views: the cameras' masks; may be empty if there are pictures.
            root_position: (3,) known position of the root in the world [m]; None: as in the tree.
            pictures: pictures (H, W, 3 or 4) by name of the camera; the colours along the contour
                are used for cameras without a mask. None: no pictures.
            start: (nq,) approximate positions in this frame, if known; the search is then used only
                if the masks do not fit them.

        Returns:
            The new state, and the pose. ``stopped_by`` is TRACKED if the pose was tracked. If no
                pose explains the masks, or there is no evidence, ``found`` is false and the pose is
                the prediction, or ``start`` if given. A track lost in pictures without masks is
                continued with ``found`` false until its contour fits again.

        Raises SettingsError: masks or pictures do not fit the cameras.
        """
        begin, observation = time.perf_counter(), self.tracker.observation
        names = [camera.name for camera in observation.cameras]
        given = {view.camera.name: view.mask for view in views}
        if root_position is not None:
            observation = observation.with_root_position(root_position)
        masks = [given.get(name) for name in names]
        shown = [pictures.get(name) for name in names] if pictures else None
        frame = _GivenFrame(views, root_position, observation, masks, shown, begin)
        tracked: tuple[Track, PoseEstimate] | None = None
        if last.track is not None:
            track = self._follow(last.track, frame, False)
            tracked = track, self._result(track, frame)
            if not self._is_lost(*tracked, last.reference, frame):
                if last.retries and views:
                    return self._match(last, tracked, frame, None)
                return TrackerState(track, last.reference, last.matches), tracked[1]
        if start is not None:
            started = self._begin(start, last, frame)
            if started[1].found or not views:
                return started
        if not views:
            if tracked is None:
                default = self._search.tree.model.default_positions
                nowhere = self.tracker.observation.state(default)
                result = self._result(self.tracker.start(nowhere), frame)
                return last, replace(result, found=False)
            # With unexplained = 0 the next frame with evidence is searched at once.
            return replace(last, track=tracked[0], unexplained=0), replace(tracked[1], found=False)
        return self._match(last, tracked, frame, start)

    def with_intervals(self, state: TrackerState, pose: PoseEstimate) -> PoseEstimate:
        """Return a tracked pose with the joints' intervals from this frame's contours alone.

        ``state`` and ``pose`` are what ``next`` returned for the frame. Without a measurement the
        pose is returned unchanged.
        """
        track = state.track
        if track is None or track.measurement is None:
            return pose
        observation = self.tracker.observation
        own = observation.covariance(track.measurement, pose.area)
        pictures = len(observation.cameras)
        return replace(pose, pose_set=covariance_pose_set(self._search.tree, pose, own, pictures))

    def _match(
        self,
        last: TrackerState,
        tracked: tuple[Track, PoseEstimate] | None,
        frame: _GivenFrame,
        start: Array | None,
    ) -> tuple[TrackerState, PoseEstimate]:
        """Return the better of the tracked pose, if any, and the search's, and the state after it.

        If neither explains the masks, return the given start or the prediction, as not found.

        ``last``: the state after the previous frame. ``tracked``: the track and its pose in this
        frame; None: there was no track. ``start``: (nq,) approximate positions in this frame; None:
        unknown.
        """
        settings, last_track = self.settings, last.track
        unexplained = last.unexplained + 1
        pause = max(1, round(settings.search_pause / self._period))
        found, matches = [] if tracked is None else [tracked], last.matches
        retries = max(0, last.retries - 1)
        if last_track is None or last.retries or unexplained % pause == 1 % pause:
            matches += 1
            matched = self._search.match(frame.views, frame.root_position)
            found += self._search_candidates(matched, last_track, frame)
            if matched.stopped_by != "time_limit":
                retries = 0
            elif not last.retries:
                retries = settings.retries
            if not found and last_track is None and start is None:
                return TrackerState(None, 0.0, matches, 0, retries), matched
        limit = self._limit(last.reference)
        explained = [one for one in found if last_track is None or one[1].E_total <= limit]
        if not explained and unexplained * self._period > settings.patience:
            explained = found
        if start is not None and (last_track is None or not explained):
            # Measured positions are kept if no pose explains the masks.
            explained = [one for one in found if one[1].E_total <= self._limit(0.0)]
        if explained:
            track, result = min(explained, key=lambda pair: pair[1].E_total)
            return TrackerState(track, result.E_total, matches, 0, retries), result
        if start is not None:
            track = self.tracker.start(self._state(start, last, frame))
        else:
            assert last_track is not None
            none = [None] * len(frame.masks)
            track = self.tracker.follow(last_track, none, False, frame.root_position)
        result = replace(self._result(track, frame), found=False)
        return TrackerState(track, last.reference, matches, unexplained, retries), result

    def _search_candidates(
        self, matched: PoseEstimate, last: Track | None, frame: _GivenFrame
    ) -> list[tuple[Track, PoseEstimate]]:
        """Return the pose of a search, tracked in its frame and as it is; empty if not found.

        ``matched``: the search's pose. ``last``: the track before this frame, whose turns the
        angles take; None: there is none.
        """
        if not matched.found:
            return []
        x = frame.observation.state(matched.q, matched.X_WB, matched.scale)
        if last is not None:
            # A search does not know the number of full turns of an angle.
            x = frame.observation.unwrapped(x, last.state.best.mean)
            node_values = frame.observation.node_values(x)
            turns = [
                2.0 * np.pi * np.round((now - then) / (2.0 * np.pi))
                for now, then in zip(node_values, matched.node_values, strict=True)
            ]
            matched = matched.turned(self._search.tree, turns)
        first = self.tracker.start(x)
        refined = self._follow(first, frame, True)
        # The pose was refined from the search's, so that the search's pose set still applies.
        tracked = replace(self._result(refined, frame), pose_set=matched.pose_set)
        # The unrefined pose may fit better; it keeps the colours learned in this frame.
        return [(refined, tracked), (replace(first, colours=refined.colours), matched)]

    def _begin(
        self, start: Array, last: TrackerState, frame: _GivenFrame
    ) -> tuple[TrackerState, PoseEstimate]:
        """Return the state and pose of a track that starts at positions ``start`` (nq,).

        ``last``: the state after the previous frame. The pose is not ``found`` if it is lost.
        """
        track = self._follow(self.tracker.start(self._state(start, last, frame)), frame, True)
        result = self._result(track, frame)
        reference = result.E_total if frame.views else UNEXPLAINED
        found = not self._is_lost(track, result, reference, frame)
        return TrackerState(track, reference, last.matches), replace(result, found=found)

    def _state(self, start: Array, last: TrackerState, frame: _GivenFrame) -> Array:
        """Return the state (n,) at positions ``start`` (nq,), angles in the last track's turns."""
        x = frame.observation.state(start)
        if last.track is None:
            return x
        return frame.observation.unwrapped(x, last.track.state.best.mean)

    def _follow(self, track: Track, frame: _GivenFrame, first: bool) -> Track:
        """Return the track after a frame; ``first``: it begins in this frame."""
        return self.tracker.follow(track, frame.masks, first, frame.root_position, frame.pictures)

    def _is_lost(
        self, track: Track, result: PoseEstimate, reference: float, frame: _GivenFrame
    ) -> bool:
        """Return whether evidence is missing, the track left the contour, or E_total is high.

        ``reference``: E_total after the last match.
        """
        explains = not frame.views or result.E_total <= self._limit(reference)
        is_bare = all(one is None for one in (*frame.masks, *(frame.pictures or ())))
        return is_bare or track.lost or not explains

    @staticmethod
    def _limit(reference: float) -> float:
        """Return the largest E_total of a pose that explains the masks, given ``reference``."""
        return min(1.5 * reference + 0.1, UNEXPLAINED)

    def _difference(self, track: Track, frame: _GivenFrame) -> tuple[float, float]:
        """Return the area where body and evidence differ, and the silhouettes' area [pixel].

        With masks these are areas of pixels. With pictures alone the first is the length of the
        body's contours times their distance from edges (infinite without a measurement), and the
        second the area of the drawn body.
        """
        observation, x = frame.observation, track.state.best.mean
        if frame.views:
            return observation.difference(x, [(view.camera, view.mask) for view in frame.views])
        J, area = 0.0, 0.0
        if track.measurement is None:
            return math.inf, 1.0
        for camera in observation.cameras:
            drawn = observation.draw(x, camera)
            area += int(np.count_nonzero(drawn))
            J += count_edge_pixels(drawn) * track.measurement.distance
        return J, max(area, 1.0)

    def _result(self, track: Track, frame: _GivenFrame) -> PoseEstimate:
        """Return a track's pose as an estimate that is ``found``, with J and area in a frame."""
        observation, x = frame.observation, track.state.best.mean
        q, X_WB = observation.positions(x)
        J, area = self._difference(track, frame)
        return PoseEstimate(
            found=True, q=q, X_WB=X_WB, node_values=observation.node_values(x), J=float(J),
            area=float(area), stopped_by=TRACKED, seconds=time.perf_counter() - frame.begin,
            root_position=observation.root_position(x), scale=observation.scale(x),
        )  # fmt: skip
