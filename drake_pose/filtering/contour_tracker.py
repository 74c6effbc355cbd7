"""Tracking of a pose tree by its contour, with a search where that does not explain what is seen.

Masks are *explained* if noise explains all that does not fit. Where they are not, a ``Tracker``
searches: a pose from the search replaces the track if it explains the frame better at
``judge.LEVEL``, unless the motion excludes it and it is not the only one that explains the frame.
A better pose that the motion excludes shows that the body is hidden: the track is predicted.
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
from drake_pose.fit.judge import LEVEL, largest_difference
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

    def pose_if(self, found: bool) -> PoseEstimate:
        """Return the pose; ``found``: whether it is reliable."""
        assert self.pose is not None
        return replace(self.pose, found=found)


Tiles = tuple[int, float, Array, Array]
"""Of a frame: number of cut masks; side of a tile [pixel]; costs and lengths of edges in tiles
(cameras, 64, 64), see ``ContourObservation.tile_costs``."""


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The state of a ``Tracker`` after a frame.

    Attributes:
        track: the track; None before the first pose.
        spread: (n,) further standard deviations of what the last search left open [rad or m].
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
        best = None if self.track is None else self.track.state.best
        if best is None or self.spread is None:
            return best
        return Belief(best.mean, best.covariance + np.diag(self.spread**2))


class _Seen(NamedTuple):
    """A frame as a tracker compares it."""

    observation: ContourObservation  # The body with its root where it is known to be.
    masks: Sequence[Mask | None]  # For each camera (H, W) or None.
    pictures: Sequence[Picture | None] | None  # Likewise (H, W, 3 or 4); None: no pictures.
    evidence: ContourEvidence  # Without colours.
    views: Sequence[View]  # The cameras that have a mask, with it; of cut masks what they show.
    whole: Sequence[View]  # The same, as given.
    root_position: Array | None  # (3,) of the root in the world [m]; None: as in the tree.
    begin: float  # Time at which the processing of the frame started [s].

    @property
    def cuts(self) -> int:
        """Number of masks that are cut."""
        return sum(one.cut() is not one for one in self.whole)

    @property
    def is_cut(self) -> bool:
        """Whether only what straight cuts of masks left is compared."""
        return self.views is not self.whole

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
        accelerations: (m,) standard deviation of each moving element's acceleration [unit/s^2].

    Raises:
        SettingsError: there is no camera, the period is not positive, or no value is free.
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
        layout, is_angle = self.observation.layout, self.observation.is_angle
        kinds = [0 if one == LOG_SCALE else 1 + is_angle(one) for one in layout.moving]
        accelerations = own.log_scale_acceleration, own.length_acceleration, own.angle_acceleration
        self.accelerations = np.array(accelerations)[kinds]
        starts = np.array([own.start_log_scale, own.start_length, own.start_angle])[kinds]
        # Standard deviation of a rate [unit/step] that accelerates during ``memory``.
        self._start_deviations = np.r_[starts, own.memory * period * self.accelerations]
        scale = dict(zip(layout.moving, period**2 * self.accelerations, strict=True))
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

    def start(self, x: Array) -> Track:
        """Return the track that starts at the mean x (n,), truncated by the limits."""
        covariance = np.diag(self._start_deviations**2)
        return Track(self.filter.start(Belief(x, covariance)), None, False)

    def predict(self, track: Track) -> Track:
        """Return the track one period later, without evidence."""
        return replace(track, state=self.filter.predict(track.state), measurement=None)

    def delayed(self, track: Track) -> Track:
        """Return the track widened by what a period moves the measurement: pictures may be late."""
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

        ``track``: after the last frame, or ``start``. ``masks``: for each camera (H, W) or None.
        ``first``: whether the track was started in this very frame. ``pictures``: for each camera
        (H, W, 3 or 4) or None; colours along the contour are used for cameras without a mask, and
        learned from each frame. Raises SettingsError: masks or pictures do not fit the cameras.
        """
        evidence = self.observation.gather_evidence(masks, pictures)
        return self._follow(
            track, _Seen(self.observation, masks, pictures, evidence, (), (), None, 0.0), first
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
            views: the cameras' masks; may be empty.
            root_position: (3,) known position of the root in the world [m]; None: as in the tree.
            pictures: (H, W, 3 or 4) by name of the camera, of cameras without a mask; None: none.
            start: (nq,) approximate positions in this frame, if known; the search is then used only
                if the masks do not fit them, and its pose only if it explains the masks.

        Returns:
            The new state, and the pose. ``stopped_by`` is TRACKED if the pose was tracked. If a
                pose that the motion excludes explains the masks better, or there is no evidence,
                ``found`` is false and the pose is the prediction, or ``start`` if given. In
                pictures ``found`` is false until the contour fits again.

        Raises SettingsError: masks or pictures do not fit the cameras.
        """
        before, spread, begun, track = last.track, last.spread, None, None
        seen = self._see(views, views, pictures, root_position)
        sights, own = [seen], seen.observation
        if before is not None:
            track, _ = self._look(before, sights, False)
        # Whether the last search saw defective or cut masks, in which poses look alike.
        is_open = last.doubt is not None and last.spread is not None
        if (track is None or track.lost) and seen.cuts:
            sights.append(self._see([one.cut() for one in views], views, pictures, root_position))
            if before is not None:
                track, seen = self._look(before, sights[1:], False)
        if start is not None and (track is None or track.lost or seen.is_bare):
            begun, spread = self._start_near(own.state(start), before), None
            track, seen = self._look(begun, sights, True)
        is_open &= begun is None and bool(views)
        if track is not None and not (track.lost or seen.is_bare or is_open):
            return TrackerState(track, spread, last.matches), track.pose_if(True)
        if views:
            return self._search_again(replace(last, track=track), before, begun, sights)
        if track is None:
            nowhere = self.start(own.state(own.tree.model.default_positions))
            return last, self._judged(nowhere, seen).pose_if(False)
        # The next masks are searched at once if they are not explained.
        return replace(last, track=track, waited=last.wait), track.pose_if(False)

    def with_intervals(self, state: TrackerState, pose: PoseEstimate) -> PoseEstimate:
        """Return a tracked pose with the joints' intervals from this frame's contours alone.

        ``state`` and ``pose``: of ``update``. Without a measurement the pose is as it was.
        """
        track, own = state.track, self.observation
        if track is None or track.measurement is None:
            return pose
        covariance = own.covariance(track.measurement, pose.area, state.spread)
        found = covariance_pose_set(own.tree, pose, covariance, len(own.cameras))
        return replace(pose, pose_set=found)

    def _search_again(
        self, state: TrackerState, before: Track | None, begun: Track | None, sights: list[_Seen]
    ) -> tuple[TrackerState, PoseEstimate]:
        """Return state and pose in masks that the track does not explain, or that end a doubt.

        ``state``: the last state, with the track in this frame. ``before``: that in the last frame.
        ``begun``: as it starts at known positions. ``sights``: the frame, whole and cut.
        """
        worse, doubt, track, now = ndtri(1.0 - LEVEL), state.doubt, state.track, None
        expected, seen, cuts = begun, sights[-1], sights[0].cuts
        if track is not None:
            now = self._tiles(track, seen, doubt)
            if begun is None and before is not None:
                expected = self.predict(before)
            if doubt is not None and cuts >= doubt[0] + (not track.lost and not cuts):
                # Costs that rise, and edges that come, are other masks.
                rise, come = (vuong_statistic(*k) for k in ((now[2], doubt[2]), (now[3], doubt[3])))
                fall = -rise if state.spread is not None or not state.is_kept else 0.0
                if max(rise, come, fall) <= worse and state.waited + 1 < state.wait:
                    state = replace(state, waited=state.waited + 1)
                    return self._kept(state, expected, seen)
        assert self._search is not None
        matched = self._search.match(seen.whole, seen.root_position)
        pause = round(self.settings.search_pause / self._period)
        # Searches are as rare as they were fruitless.
        wait = max(1, pause, 2 * state.wait if state.waited + 1 >= state.wait else 0)
        known = TrackerState(track, state.spread, state.matches + 1, True, now, wait)
        if not matched.found:
            if track is None:
                return TrackerState(matches=known.matches), matched
            return self._kept(known, expected, seen)
        other, spread = self._candidate(matched, before, sights)
        others = self._tiles(other, seen, now)
        if track is not None and now is not None:
            if vuong_statistic(now[2], others[2]) <= worse:
                if not (track.lost or cuts):
                    known = TrackerState(track, spread, known.matches)
                return self._kept(known, expected, seen)
            assert expected is not None
            if not self._is_possible(other, matched, expected.state.best, state.spread):
                return self._kept(replace(known, is_kept=False), expected, seen)
        if not (other.lost or (cuts and spread is not None)):
            return TrackerState(other, spread, known.matches), other.pose_if(True)
        if spread is not None and state.spread is not None:
            # What look the same in one frame with defects may look different in the next.
            spread = np.maximum(spread, state.spread)
        return replace(known, track=other, spread=spread, doubt=others), other.pose_if(True)

    def _kept(
        self, state: TrackerState, expected: Track | None, seen: _Seen
    ) -> tuple[TrackerState, PoseEstimate]:
        """Return a state and its pose; what was ``expected`` in place of a track not kept."""
        track = state.track
        if not state.is_kept and expected is not None:
            track = self._judged(expected, seen)
        assert track is not None
        return replace(state, track=track), track.pose_if(state.is_kept)

    def _tiles(self, track: Track, seen: _Seen, last: Tiles | None) -> Tiles:
        """Return the tiles of a frame with a track, as large as those of ``last``."""
        area = float(np.mean([np.count_nonzero(view.mask) for view in seen.views]))
        side, x = last[1] if last else max(1.0, 0.2 * math.sqrt(area)), track.state.best.mean
        return seen.cuts, side, *seen.observation.tile_costs(seen.evidence, x, side)

    def _start_near(self, x: Array, last: Track | None) -> Track:
        """Return the track that starts at x (n,), with angles in the last track's turns."""
        if last is not None:
            x = self.observation.unwrapped(x, last.state.best.mean)
        return self.start(x)

    def _candidate(
        self, matched: PoseEstimate, last: Track | None, sights: list[_Seen]
    ) -> tuple[Track, Array | None]:
        """Return a search's pose, tracked in its frame or as it is if that fits better.

        ``last``: as ``before`` of ``_search_again``. Returns track, and ``TrackerState.spread``.
        """
        own = sights[0].observation
        start = self._start_near(own.state(matched.q, matched.X_WB, matched.scale), last)
        x = start.state.best.mean
        # A search does not know the number of full turns of an angle.
        turns = [
            2.0 * np.pi * np.round((now - then) / (2.0 * np.pi))
            for now, then in zip(own.node_values(x), matched.node_values, strict=True)
        ]
        matched = matched.turned(own.tree, turns)
        best, seen = self._look(start, sights, True)
        # The pose was refined from the search's, so that the search's pose set still applies.
        pose = replace(best.pose_if(True), pose_set=matched.pose_set)
        if matched.E_total < pose.E_total:
            measured, pose = seen.observation.measure(seen.evidence, x), matched
            lost = measured is None or not measured.is_explained
            # The unrefined pose keeps the colours learned in this frame.
            best = self._judged(
                replace(start, measurement=measured, lost=lost, colours=best.colours), seen
            )
        known, spread = matched.pose_set, None
        hides = best.lost or seen.is_cut
        if known is not None and (hides or seen.cuts or known.mode_count > 1):
            spread = own.spread(known.joints, np.concatenate(matched.node_values), hides)
        return replace(best, pose=pose), spread

    def _is_possible(
        self, other: Track, matched: PoseEstimate, expected: Belief, spread: Array | None
    ) -> bool:
        """Return whether a search's pose may replace a track that was ``expected`` elsewhere.

        The motion does not exclude it, or it alone explains the frame. ``spread``: of the track.
        """
        count = len(self.accelerations)
        off = (other.state.best.mean - expected.mean)[:count]
        wide = self._start_deviations**2 + (0.0 if spread is None else spread**2)
        C = (expected.covariance + np.diag(wide))[:count, :count]
        if off @ np.linalg.solve(C, off) <= chdtri(count, LEVEL):
            return True
        if other.lost or matched.pose_set is None:
            return not other.lost
        near = np.abs(off) <= ndtri(1.0 - 0.5 * LEVEL) * np.sqrt(np.diag(C))
        values = np.concatenate(matched.node_values)
        unknown = self.observation.spread(matched.pose_set.joints, values, True)
        return unknown is None or bool(np.all(near | (unknown[:count] == 0.0)))

    def _look(self, track: Track, sights: list[_Seen], first: bool) -> tuple[Track, _Seen]:
        """Return a track after a frame as it explains the first or next of ``sights``, and that."""
        for seen in sights:
            found = self._judged(self._follow(track, seen, first), seen)
            if not found.lost:
                break
        return found, seen

    def _see(
        self,
        views: Sequence[View],
        whole: Sequence[View],
        pictures: Mapping[str, Picture] | None,
        root_position: Array | None,
    ) -> _Seen:
        """Return a frame as it is compared; the arguments are of ``update`` and ``_Seen``."""
        begin, given = time.perf_counter(), {one.camera.name: one for one in views}
        seen = [given.get(one.name, one) for one in self.observation.cameras]
        masks = [one.mask if isinstance(one, View) else None for one in seen]
        cameras = [one.camera if isinstance(one, View) else one for one in seen]
        shown = [pictures.get(one.name) for one in cameras] if pictures else None
        own = self.observation.seen_by(cameras, root_position)
        evidence = own.gather_evidence(masks, shown)
        return _Seen(own, masks, shown, evidence, views, whole, root_position, begin)

    def _judged(self, track: Track, seen: _Seen) -> Track:
        """Return a track in a frame with its pose.

        It is also lost if body and masks differ in more than noise of their edges explains.
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
            deviation = max(CONTOUR.deviation, measured.distance)
            most = largest_difference(measured.length, deviation, CONTOUR.correlation)
            is_noise = pose.explained and J <= most
        return replace(track, lost=track.lost or not is_noise, pose=pose)
