"""Tracking of a pose tree by its contour, with a search where that does not explain what is seen.

A ``Tracker`` feeds the contours of masks and pictures to a ``TruncatedFilter``. It has no level of
errors of its own. Masks are *explained* if no more of the contours is unlikely than noise makes so.
Where they are not, it searches: a pose from the search replaces the track if it explains the frame
better at ``judge.LEVEL``, and unless the motion excludes it or it is the only one that explains the
frame. Otherwise a better pose that the motion excludes shows that the body is hidden: the track is
predicted.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, ndtri

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import require_positive
from drake_pose.filtering.contour_observation import (
    CONTOUR,
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
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.judge import LEVEL
from drake_pose.search import (
    TRACKED,
    MultiStartSearch,
    PoseEstimate,
    PoseSearch,
    View,
    covariance_pose_set,
)
from drake_pose.silhouette.pictures.masks import count_edge_pixels


@dataclass(frozen=True)
class TrackingSettings:
    """Settings of a ``Tracker``.

    Args:
        angle_acceleration: standard deviation of the acceleration of joint angles [rad/s^2].
        length_acceleration: of the root's position and of sliding joints [m/s^2].
        log_scale_acceleration: of the log scale, if unknown [1/s^2].
        memory: time constant of the decay of rates [s]; occluded limbs come to rest.
        rounds: largest number of comparisons of contours with masks in a frame.
        root_moves: whether the root's position in the world is estimated.
        scale_unknown: whether the scale of the one parallel camera is estimated, and may drift.
        rest_time: time constant with which unobserved joints return to their prior (the middle of
            their limits, or that of a couplings file) [s]. It also decides which way joints bend
            where the silhouette is the same for both. None: no prior.
        standstill: a frame's iteration ends when the pose changes by less [rad, m].
        start_angle, start_length, start_log_scale: standard deviations of a search's pose, in
            angles [rad], the root's position and other lengths [m], and the log scale.
        search_pause: time between two searches in masks that are not explained, unless other masks
            come [s]. It doubles while the search finds nothing better than the track.

    Raises:
        SettingsError: a number is not positive.
    """

    angle_acceleration: float = 15.0
    length_acceleration: float = 5.0
    log_scale_acceleration: float = 0.1
    memory: float = 0.15
    rounds: int = 16
    root_moves: bool = False
    scale_unknown: bool = False
    rest_time: float | None = None
    standstill: float = 1e-3
    start_angle: float = 0.2
    start_length: float = 0.03
    start_log_scale: float = 0.1
    search_pause: float = 0.5

    def __post_init__(self) -> None:
        require_positive(**{k: one for k, one in vars(self).items() if not isinstance(one, bool)})


@dataclass(frozen=True, eq=False)
class Track:
    """A track after a frame.

    Attributes:
        state: belief of the pose tree's state.
        measurement: of the contour at the final state; None: no edge was near the contour.
        lost: whether noise does not explain the contours, or the distance of a part in pictures,
            or no edge was near in a frame with evidence. A frame without evidence keeps the value.
        colours: colour histograms of the body; None before the first picture.
        noise: least distance of an explained frame so far, see ``ContourMeasurement`` [pixel].
        pose: in the frame, with J and area; None: it was not judged.
    """

    state: FilterState
    measurement: ContourMeasurement | None
    lost: bool
    colours: Floats | None = None
    noise: float = math.inf
    pose: PoseEstimate | None = None


Tiles = tuple[float, Array, Array]
"""Side of a tile [pixel], and costs and lengths of edges in tiles (cameras, 64, 64) of a frame, see
``ContourObservation.tile_costs``."""


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The state of a ``Tracker`` after a frame.

    Attributes:
        track: the track; None before the first pose.
        spread: (n,) standard deviations of the state that the last search left to poses that look
            the same, or that the masks' defects leave [rad or m].
        matches: number of searches so far.
        is_kept: whether the track is the best known pose, not a prediction through masks that a
            pose which the motion excludes explains better.
        doubt: what was seen in the last search's frame; None: the masks were explained since.
        wait, waited: number of frames until the search is repeated, and since the last one.
    """

    track: Track | None = None
    spread: Array | None = None
    matches: int = 0
    is_kept: bool = True
    doubt: Tiles | None = None
    wait: int = 0
    waited: int = 0

    @cached_property
    def belief(self) -> Belief | None:
        """The track's mean (n,) and covariance (n, n), with ``spread``; None without a track."""
        if self.track is None or self.spread is None:
            return None if self.track is None else self.track.state.best
        best = self.track.state.best
        return Belief(best.mean, best.covariance + np.diag(self.spread**2))


class _Seen(NamedTuple):
    """A frame as a tracker compares it."""

    observation: ContourObservation  # The body with its root where it is known to be.
    masks: Sequence[Mask | None]  # For each camera (H, W) or None.
    # For each camera (H, W, 3 or 4) or None; None: no pictures.
    pictures: Sequence[Picture | None] | None
    evidence: ContourEvidence  # Without colours.
    views: Sequence[View]  # The cameras that have a mask, with it.
    root_position: Array | None  # (3,) of the root in the world [m]; None: as in the tree.
    begin: float  # Time at which the processing of the frame started [s].

    @property
    def is_bare(self) -> bool:
        """Whether there is neither a mask nor a picture."""
        return all(one is None for one in (*self.masks, *(self.pictures or ())))


class Tracker:
    """Tracks a pose tree from frame to frame, inside its limits, and searches where that fails.

    All state is in a ``TrackerState``.

    Args:
        tree: the body.
        cameras: all cameras of the sequence.
        period: time between two frames [s].
        settings: None: TrackingSettings().
        search: finds poses where the track does not explain the masks; None: there is none.
        search_time: time limit of a ``MultiStartSearch`` [s]; None: the search's own. A search that
            reaches it is repeated if its pose does not explain the masks.

    Attributes:
        observation: the body and the cameras.
        filter: the filter of the body's state.

    Raises:
        SettingsError: there is no camera, the period is not positive, or the tree has no free
            value.
    """

    def __init__(
        self,
        tree: PoseTree,
        cameras: Sequence[Camera],
        period: float,
        settings: TrackingSettings | None = None,
        search: PoseSearch | None = None,
        search_time: float | None = None,
    ) -> None:
        require_positive(period=period)
        own = self.settings = settings or TrackingSettings()
        if search_time is not None and isinstance(search, MultiStartSearch):
            search = search.with_time_limit(search_time)
        self._search, self._period = search, period
        prior_weight = 0.0 if own.rest_time is None else period / own.rest_time
        self.observation = ContourObservation(
            tree, cameras, own.root_moves, own.scale_unknown, prior_weight
        )
        layout = self.observation.layout
        scale = {name: period**2 * self.acceleration(name) for name in layout.moving}
        size, none = len(layout), np.zeros(0)
        # Each frame has its own observation model.
        nothing = LinearObservation((), none, none > 0, np.zeros(size), none, np.zeros((0, size)))
        self.filter = TruncatedFilter(
            layout,
            nothing,
            self.observation.inequalities(),
            LinearMotion(
                layout.transition(math.exp(-period / own.memory)), layout.process_noise(scale), None
            ),
            # Measurements of different frames are not comparable, so there are no static views.
            FilterSettings(hypothesis_cap=1, linearisation="tangent", iterations=20),
        )
        kinds = (own.start_log_scale, own.start_angle, own.start_length)
        self._start_deviations = np.array([self._of_kind(name, *kinds) for name in layout.moving])

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
        deviations = np.r_[self._start_deviations, rates]
        return Track(self.filter.start(Belief(x, np.diag(deviations**2))), None, False)

    def predict(self, track: Track) -> Track:
        """Return the track one period later, without evidence."""
        return replace(track, state=self.filter.predict(track.state), measurement=None)

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

    def follow(
        self,
        track: Track,
        masks: Sequence[Mask | None],
        first: bool = False,
        pictures: Sequence[Picture | None] | None = None,
    ) -> Track:
        """Return the track after the next frame, without a search.

        Args:
            track: after the last frame, or ``start``.
            masks: for each camera (H, W) or None.
            first: whether ``track`` was started in this very frame, so that it is not predicted.
            pictures: for each camera (H, W, 3 or 4) or None; None: no pictures. The colours along
                the contour are used for cameras without a mask; they are learned from each frame,
                at first at the start.

        Raises SettingsError: the number or size of masks or pictures does not fit the cameras.
        """
        evidence = self.observation.gather_evidence(masks, pictures)
        return self._follow(
            track, _Seen(self.observation, masks, pictures, evidence, (), None, 0.0), first
        )

    def _follow(self, track: Track, seen: _Seen, first: bool) -> Track:
        """Return the track after a frame; the arguments are of ``follow``."""
        observation, pictures = seen.observation, seen.pictures
        prediction = track.state if first else self.filter.predict(track.state)
        colours = track.colours
        if pictures is not None and colours is None:
            colours = observation.uninformed_histograms()
            if all(mask is None for mask in seen.masks):
                colours = observation.update_histograms(
                    pictures, prediction.best.mean, colours, True
                )
        evidence = seen.evidence._replace(colours=colours)
        state, measurement = self._fit(observation, evidence, prediction)
        if measurement is None:
            return Track(state, None, track.lost or not seen.is_bare, colours, track.noise)
        if measurement.distance > max(track.noise, CONTOUR.deviation):
            # Noise does not grow.
            judged = observation.measure(evidence, state.best.mean, track.noise, len(LINES.steps))
            measurement = measurement if judged is None else judged
        found = Track(state, measurement, not measurement.is_explained, colours, track.noise)
        if not found.lost:
            found = replace(found, noise=min(track.noise, measurement.distance))
        elif evidence.has_pictures or self._search is not None:
            state, remaining = self._fit(observation, evidence, prediction, found)
            # If most parts are hidden in pictures, search lines are unreliable.
            few = evidence.has_pictures and measurement.hidden_parts.mean() > 0.5
            if remaining is None or few:
                state, remaining = prediction, measurement
            elif evidence.has_pictures:
                # The shift that hidden parts cause is added to the covariance.
                moved = found.state.best.mean - state.best.mean
                wide = state.best.covariance + np.outer(moved, moved)
                started = self.filter.start(Belief(found.state.best.mean, wide))
                state = replace(started, step=state.step)
            found = replace(found, state=state, measurement=remaining)
        if pictures is not None and colours is not None:
            shown = np.array([mask is None for mask in seen.masks])
            hidden = measurement.hidden_parts & shown[:, None]
            colours = observation.update_histograms(
                pictures, found.state.best.mean, colours, excluded_parts=hidden
            )
        return replace(found, colours=colours)

    def _fit(
        self,
        observation: ContourObservation,
        evidence: ContourEvidence,
        prediction: FilterState,
        found: Track | None = None,
    ) -> tuple[FilterState, ContourMeasurement | None]:
        """Return state and measurement in a frame after ``prediction``; None: no edge is near.

        ``found``: what was found with all parts; those that are not seen are left out.
        """
        moving, state, at = len(observation.layout.moving), prediction, 0
        distance, hidden = None, None
        if found is not None and found.measurement is not None:
            state, at = found.state, len(LINES.steps)
            distance, hidden = found.measurement.distance, found.measurement.hidden_parts
        measurement = observation.measure(evidence, state.best.mean, distance, at, hidden)
        # With pictures the number of comparisons is limited, and the finest search lines must have
        # been reached. With masks the last comparison is made at the final state.
        last = at + (len(LINES.steps) if evidence.has_pictures else self.settings.rounds - 1)
        while measurement is not None:
            before, at = state.best.mean, at + 1
            state = self.filter.update(prediction, measurement.y, measurement)
            change = np.abs((state.best.mean - before)[:moving]).max()
            still = at > 1 and change < self.settings.standstill
            if evidence.has_pictures:
                still &= search_line_step(at - 1) == LINES.steps[-1]
            if still or (evidence.has_pictures and at > last):
                break
            measurement = observation.measure(
                evidence, state.best.mean, measurement.distance, at, hidden
            )
            if at > last:
                break
        return state, measurement

    def update(
        self,
        last: TrackerState,
        views: Sequence[View],
        root_position: Array | None = None,
        pictures: Mapping[str, Picture] | None = None,
        start: Array | None = None,
    ) -> tuple[TrackerState, PoseEstimate]:
        """Return the state after the next frame, and the pose.

        Args:
            last: the state after the previous frame; TrackerState() before the first.
            views: the cameras' masks; may be empty if there are pictures.
            root_position: (3,) known position of the root in the world [m]; None: as in the tree.
            pictures: pictures (H, W, 3 or 4) by name of the camera; the colours along the contour
                are used for cameras without a mask. None: no pictures.
            start: (nq,) approximate positions in this frame, if known; the search is then used only
                if the masks do not fit them, and its pose only if it explains the masks.

        Returns:
            The new state, and the pose. ``stopped_by`` is TRACKED if the pose was tracked. If a
                pose that the motion excludes explains the masks better, or there is no evidence,
                ``found`` is false and the pose is the prediction, or ``start`` if given. A track
                lost in pictures without masks is continued with ``found`` false until its contour
                fits again.

        Raises SettingsError: masks or pictures do not fit the cameras.
        """
        begin, own, before = time.perf_counter(), self.observation, last.track
        if root_position is not None:
            own = own.with_root_position(root_position)
        names, given = [one.name for one in own.cameras], {one.camera.name: one for one in views}
        masks = [given[name].mask if name in given else None for name in names]
        shown = [pictures.get(name) for name in names] if pictures else None
        evidence = own.gather_evidence(masks, shown)
        seen = _Seen(own, masks, shown, evidence, views, root_position, begin)
        track = None if before is None else self._judged(self._follow(before, seen, False), seen)
        spread, begun = last.spread, None
        if start is not None and (track is None or track.lost or seen.is_bare):
            begun, spread = self._start_near(own.state(start), before), None
            track = self._judged(self._follow(begun, seen, True), seen)
        # Whether the last search saw defective masks, and could not tell poses apart in them.
        is_open = last.doubt is not None and spread is not None
        if track is not None and not (track.lost or seen.is_bare or (views and is_open)):
            return TrackerState(track, spread, last.matches), self._pose(track)
        if views:
            return self._search_again(replace(last, track=track), before, begun, seen)
        if track is None:
            nowhere = self._judged(self.start(own.state(own.tree.model.default_positions)), seen)
            return last, self._pose(nowhere, False)
        # The next masks are searched at once if they are not explained.
        return replace(last, track=track, waited=last.wait), self._pose(track, False)

    def with_intervals(self, state: TrackerState, pose: PoseEstimate) -> PoseEstimate:
        """Return a tracked pose with the joints' intervals from this frame's contours alone.

        ``state`` and ``pose`` are what ``update`` returned for the frame. Without a measurement the
        pose is returned unchanged.
        """
        track, own = state.track, self.observation
        if track is None or track.measurement is None:
            return pose
        covariance = own.covariance(track.measurement, pose.area, state.spread)
        found = covariance_pose_set(own.tree, pose, covariance, len(own.cameras))
        return replace(pose, pose_set=found)

    def _search_again(
        self, state: TrackerState, before: Track | None, begun: Track | None, seen: _Seen
    ) -> tuple[TrackerState, PoseEstimate]:
        """Return state and pose in masks that the track does not explain, or that end a doubt.

        ``state``: the last state, with the track in this frame; None: there was none. ``before``:
        the track in the last frame. ``begun``: as it starts at positions that are known, or None.
        """
        worse, doubt, track, now = ndtri(1.0 - LEVEL), state.doubt, state.track, None
        expected = begun
        if track is not None:
            now = self._tiles(track, seen, doubt)
            if begun is None and before is not None:
                expected = self.predict(before)
            if track.lost and doubt is not None and state.waited + 1 < state.wait:
                # Costs that rise and edges that come are other masks.
                changes = (vuong_statistic(*both) for both in zip(now[1:], doubt[1:], strict=True))
                if max(changes) <= worse:
                    state = replace(state, waited=state.waited + 1)
                    return self._kept(state, expected, seen)
        assert self._search is not None
        matched = self._search.match(seen.views, seen.root_position)
        pause = round(self.settings.search_pause / self._period)
        wait = max(1, pause, 2 * state.wait)
        known = replace(
            state, matches=state.matches + 1, is_kept=True, doubt=now, wait=wait, waited=0
        )
        if not matched.found:
            if track is None:
                return TrackerState(matches=known.matches), matched
            return self._kept(known, expected, seen)
        other, spread = self._candidate(matched, before, seen)
        others = self._tiles(other, seen, now)
        if track is not None and now is not None:
            if vuong_statistic(now[1], others[1]) <= worse:
                if not track.lost:
                    known = TrackerState(track, spread, known.matches)
                return self._kept(known, expected, seen)
            assert expected is not None
            if not self._is_possible(other, matched, expected.state.best, state.spread):
                return self._kept(replace(known, is_kept=False), expected, seen)
        if not other.lost:
            return TrackerState(other, spread, known.matches), self._pose(other)
        if spread is not None and state.spread is not None:
            # What look the same in one frame with defects may look different in the next.
            spread = np.maximum(spread, state.spread)
        return replace(known, track=other, spread=spread, doubt=others), self._pose(other)

    def _kept(
        self, state: TrackerState, expected: Track | None, seen: _Seen
    ) -> tuple[TrackerState, PoseEstimate]:
        """Return a state and its pose; what was ``expected`` in place of a track not kept."""
        track = state.track
        if not state.is_kept and expected is not None:
            track = self._judged(expected, seen)
        assert track is not None
        return replace(state, track=track), self._pose(track, state.is_kept)

    def _tiles(self, track: Track, seen: _Seen, last: Tiles | None) -> Tiles:
        """Return the tiles of a frame with a track, as large as those of ``last``."""
        # The errors of tiles are regarded as independent, as in ``ViewsFit.tile_costs``.
        areas = [np.count_nonzero(view.mask) for view in seen.views]
        side = last[0] if last else max(1.0, 0.2 * math.sqrt(float(np.mean(areas))))
        x = track.state.best.mean
        return side, *seen.observation.tile_costs(seen.evidence, x, side)

    def _start_near(self, x: Array, last: Track | None) -> Track:
        """Return the track that starts at x (n,), with angles in the last track's turns."""
        if last is not None:
            x = self.observation.unwrapped(x, last.state.best.mean)
        return self.start(x)

    def _candidate(
        self, matched: PoseEstimate, last: Track | None, seen: _Seen
    ) -> tuple[Track, Array | None]:
        """Return a search's pose, tracked in its frame or as it is if that fits better.

        ``matched``: the search's pose, which is found. ``last``: the track before this frame; None:
        there is none. Returns the track, and ``TrackerState.spread``.
        """
        own = seen.observation
        start = self._start_near(own.state(matched.q, matched.X_WB, matched.scale), last)
        x = start.state.best.mean
        # A search does not know the number of full turns of an angle.
        turns = [
            2.0 * np.pi * np.round((now - then) / (2.0 * np.pi))
            for now, then in zip(own.node_values(x), matched.node_values, strict=True)
        ]
        matched = matched.turned(own.tree, turns)
        best = self._judged(self._follow(start, seen, True), seen)
        # The pose was refined from the search's, so that the search's pose set still applies.
        pose = replace(self._pose(best), pose_set=matched.pose_set)
        if matched.E_total < pose.E_total:
            measured, pose = own.measure(seen.evidence, x), matched
            lost = measured is None or not measured.is_explained
            # The unrefined pose keeps the colours learned in this frame.
            best = self._judged(
                replace(start, measurement=measured, lost=lost, colours=best.colours), seen
            )
        known, spread = matched.pose_set, None
        if known is not None and (best.lost or known.mode_count > 1):
            spread = own.spread(known.joints, np.concatenate(matched.node_values), best.lost)
        return replace(best, pose=pose), spread

    def _is_possible(
        self, other: Track, matched: PoseEstimate, expected: Belief, spread: Array | None
    ) -> bool:
        """Return whether a search's pose may replace a track that was ``expected`` elsewhere.

        The motion does not exclude it, at LEVEL, or it explains the frame, and the joints that
        moved too far are determined. ``spread``: of the track.
        """
        count = len(self._start_deviations)
        off = (other.state.best.mean - expected.mean)[:count]
        wide = self._start_deviations**2 + (0.0 if spread is None else spread[:count] ** 2)
        C = expected.covariance[:count, :count] + np.diag(wide)
        if off @ np.linalg.solve(C, off) <= chdtri(count, LEVEL):
            return True
        if other.lost or matched.pose_set is None:
            return not other.lost
        near = np.abs(off) <= ndtri(1.0 - 0.5 * LEVEL) * np.sqrt(np.diag(C))
        values = np.concatenate(matched.node_values)
        unknown = self.observation.spread(matched.pose_set.joints, values, True)
        return unknown is None or bool(np.all(near | (unknown[:count] == 0.0)))

    def _judged(self, track: Track, seen: _Seen) -> Track:
        """Return a track in a frame with its pose.

        It is also lost if body and masks differ in more than noise of their edges makes so, at
        LEVEL: pieces of contour as long as errors are correlated are off by |r|, r normal.
        """
        own, x, measured = seen.observation, track.state.best.mean, track.measurement
        J, area = math.inf, 0.0
        if seen.views:
            J, area = own.difference(x, [(view.camera, view.mask) for view in seen.views])
        elif measured is not None:
            # Pictures alone: the contours' length times their distance from edges.
            drawn = [own.draw(x, camera) for camera in own.cameras]
            J = sum(map(count_edge_pixels, drawn)) * measured.distance
            area = sum(map(np.count_nonzero, drawn))
        q, X_WB = own.positions(x)
        pose = PoseEstimate(
            found=True, q=q, X_WB=X_WB, node_values=own.node_values(x), J=float(J),
            area=max(float(area), 1.0), stopped_by=TRACKED,
            seconds=time.perf_counter() - seen.begin, root_position=own.root_position(x),
            scale=own.scale(x),
        )  # fmt: skip
        is_noise = True
        if measured is not None and seen.views:
            mean, scatter = math.sqrt(2.0 / math.pi), math.sqrt(1.0 - 2.0 / math.pi)
            pieces = measured.length / CONTOUR.correlation
            most = mean * pieces + ndtri(1.0 - LEVEL) * scatter * math.sqrt(pieces)
            off = J / (CONTOUR.correlation * max(CONTOUR.deviation, measured.distance))
            is_noise = pose.explained and off <= most
        return replace(track, lost=track.lost or not is_noise, pose=pose)

    def _pose(self, track: Track, found: bool = True) -> PoseEstimate:
        """Return the pose of a judged track; ``found``: whether it is reliable."""
        assert track.pose is not None
        return replace(track.pose, found=found)
