"""A body in a sequence: matched first, tracked by its contour, matched again after a loss."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.filtering.contour_tracker import (
    ContourObservation,
    ContourTracker,
    Track,
    TrackingSettings,
)
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


@dataclass(frozen=True, eq=False)
class TrackerState:
    """What is known after a frame.

    Attributes:
        track: of the body; None before the first match, and where none was found.
        reference: E_total after the last match; a track that explains much less is lost.
        matches: how often the search has been asked.
        unexplained: number of frames, up to this one, that no pose explained: the track is
            predicted through them.
        retries: number of frames to come in which the search is asked again, since a time limit
            ended it.
    """

    track: Track | None = None
    reference: float = 0.0
    matches: int = 0
    unexplained: int = 0
    retries: int = 0


def make_tracker(
    tree: PoseTree, cameras: Sequence[Camera], period: float, settings: TrackingSettings
) -> ContourTracker:
    """The tracker of a pose tree's contour, with a period between two frames [s].

    Raises:
        SettingsError: no camera, a period that is not positive, or a tree without free values.
    """
    rest = 0.0 if settings.rest_time is None else period / settings.rest_time
    observation = ContourObservation(
        tree, cameras, settings.root_moves, settings.scale_unknown, rest=rest
    )
    return ContourTracker(observation, period, settings)


@dataclass(frozen=True, eq=False)
class _GivenFrame:
    """What is given of a frame, by camera, the root where it is now, and when it began [s]."""

    views: Sequence[View]
    root_position: Array | None
    observation: ContourObservation
    masks: list[Mask | None]
    pictures: list[Picture | None] | None
    begin: float

    @property
    def is_blind(self) -> bool:
        """Whether nothing is seen in the frame."""
        return all(one is None for one in (*self.masks, *(self.pictures or ())))


class MatchAndTrack:
    """Follows a body from frame to frame, and asks a search where it cannot.

    A frame that no pose explains, because the body is hidden or nothing is seen, does not move the
    track: it is predicted, its deviations grow, and the pose of the frame is not found. A pose that
    the search finds replaces the prediction only where it explains the masks about as well as poses
    did before, or where nothing has done so for ``TrackingSettings.patience``.

    Args:
        search: asked in the first frame, and when the track is lost.
        period: time between two frames [s].
        search_time: longest search [s]; None: as the search says. What a limit cuts short is
            searched again in the next frames.

    Raises:
        SettingsError: no camera, a period that is not positive, or a tree without free values.
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
        """The next frame.

        Args:
            views: the cameras' masks; there may be none where there are pictures.
            root_position: (3,) where the root is known to be now [m].
            pictures: (H, W, 3 or 4) by camera; the colours along the contour stand in where a
                camera has no mask.
            start: (nq,) about where the body is now, if it is known: the search is asked only where
                masks contradict it.

        Returns:
            What is known now, and the pose. ``stopped_by`` is TRACKED where it was tracked. Where
            no pose explains the masks, or nothing is seen, ``found`` is false and the pose is what
            is predicted, or the start where there is one. Where the track is lost in pictures
            without masks, no pose is found; it is followed all the same, and found again if the
            contour fits again.

        Raises:
            SettingsError: masks or pictures that do not fit the cameras.
        """
        begin, observation = time.perf_counter(), self.tracker.observation
        names = [camera.name for camera in observation.cameras]
        seen = {view.camera.name: view.mask for view in views}
        if root_position is not None:
            observation = observation.with_root_position(root_position)
        masks = [seen.get(name) for name in names]
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
            begun = self._begin(start, last, frame)
            if begun[1].found or not views:
                return begun
        if not views:
            return self._go_on(last, tracked, frame)
        return self._match(last, tracked, frame, start)

    def with_intervals(self, followed: TrackerState, pose: PoseEstimate) -> PoseEstimate:
        """A frame's pose that was tracked, with what its contours alone say of each joint."""
        track = followed.track
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
        """The best of what was tracked, if anything, and of what the search finds.

        Where neither explains the masks: the start that was given, or what is predicted.
        """
        settings, followed = self.settings, last.track
        unexplained = last.unexplained + 1
        pause = max(1, round(settings.search_pause / self._period))
        found, matches = [] if tracked is None else [tracked], last.matches
        retries = max(0, last.retries - 1)
        if followed is None or last.retries or unexplained % pause == 1 % pause:
            matches += 1
            matched = self._search.match(frame.views, frame.root_position)
            found += self._looked(matched, followed, frame)
            if matched.stopped_by != "time_limit":
                retries = 0
            elif not last.retries:
                retries = settings.retries
            if not found and followed is None and start is None:
                return TrackerState(None, 0.0, matches, 0, retries), matched
        limit = self._limit(last.reference)
        explained = [one for one in found if followed is None or one[1].E_total <= limit]
        if not explained and unexplained * self._period > settings.patience:
            explained = found
        if start is not None and (followed is None or not explained):
            # Measured positions are no worse for masks that nothing explains.
            explained = [one for one in found if one[1].E_total <= self._limit(0.0)]
        if explained:
            track, result = min(explained, key=lambda pair: pair[1].E_total)
            return TrackerState(track, result.E_total, matches, 0, retries), result
        if start is not None:
            track = self.tracker.start(self._state(start, last, frame))
        else:
            assert followed is not None
            track = self._follow(followed, frame, False, blind=True)
        result = replace(self._result(track, frame), found=False)
        return TrackerState(track, last.reference, matches, unexplained, retries), result

    def _looked(
        self, matched: PoseEstimate, last: Track | None, frame: _GivenFrame
    ) -> list[tuple[Track, PoseEstimate]]:
        """A pose that the search found, as it is and followed in its frame; none if none was."""
        if not matched.found:
            return []
        x = frame.observation.state(matched.q, matched.X_WB, matched.scale)
        if last is not None:
            # A search does not know how often an angle has turned round.
            x = frame.observation.continued(x, last.state.best.mean)
            matched = self._turned(matched, frame.observation.node_values(x))
        first = self.tracker.start(x)
        followed = self._follow(first, frame, True)
        # The first look of a track is at what the search found, whose modes are its own.
        looked = replace(self._result(followed, frame), pose_set=matched.pose_set)
        # The searched pose may fit better: the colours of this frame are learned all the same.
        return [(followed, looked), (replace(first, colours=followed.colours), matched)]

    def _begin(
        self, start: Array, last: TrackerState, frame: _GivenFrame
    ) -> tuple[TrackerState, PoseEstimate]:
        """A track that begins where the body is known to be."""
        track = self._follow(self.tracker.start(self._state(start, last, frame)), frame, True)
        result = self._result(track, frame)
        reference = result.E_total if frame.views else UNEXPLAINED
        found = not self._is_lost(track, result, reference, frame)
        return TrackerState(track, reference, last.matches), replace(result, found=found)

    def _state(self, start: Array, last: TrackerState, frame: _GivenFrame) -> Array:
        """The tracker's state (n,) at positions (nq,), angles in the turns of the last track."""
        x = frame.observation.state(start)
        if last.track is None:
            return x
        return frame.observation.continued(x, last.track.state.best.mean)

    def _go_on(
        self, last: TrackerState, tracked: tuple[Track, PoseEstimate] | None, frame: _GivenFrame
    ) -> tuple[TrackerState, PoseEstimate]:
        """What is known where neither a track nor a mask nor a start says where the body is."""
        if tracked is None:
            default = self._search.tree.model.default_positions
            nowhere = self.tracker.observation.state(default)
            result = self._result(self.tracker.start(nowhere), frame)
            return last, replace(result, found=False)
        # The search is asked at once where something is seen again.
        return replace(last, track=tracked[0], unexplained=0), replace(tracked[1], found=False)

    def _follow(self, track: Track, frame: _GivenFrame, first: bool, blind: bool = False) -> Track:
        """The next frame; first: it is the one that the track begins in; blind: it is not seen."""
        if blind:
            masks = [None] * len(frame.masks)
            return self.tracker.follow(track, masks, first, frame.root_position)
        return self.tracker.follow(track, frame.masks, first, frame.root_position, frame.pictures)

    def _turned(self, matched: PoseEstimate, node_values: Sequence[Array]) -> PoseEstimate:
        """A pose in the turns of a track that goes on."""
        turns = [
            2.0 * np.pi * np.round((now - then) / (2.0 * np.pi))
            for now, then in zip(node_values, matched.node_values, strict=True)
        ]
        return matched.turned(self._search.tree, turns)

    def _is_lost(
        self, track: Track, result: PoseEstimate, reference: float, frame: _GivenFrame
    ) -> bool:
        """Whether nothing is seen, or a track left the contour, or explains too little."""
        explains = not frame.views or result.E_total <= self._limit(reference)
        return frame.is_blind or track.lost or not explains

    @staticmethod
    def _limit(reference: float) -> float:
        """The largest E_total of a pose that explains the masks, by that after the last match."""
        return min(1.5 * reference + 0.1, UNEXPLAINED)

    def _difference(self, track: Track, frame: _GivenFrame) -> tuple[float, float]:
        """The area where the body differs from what is seen, and the body's [pixel]."""
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
        """The pose of a track, and how well it explains what is seen."""
        observation, x = frame.observation, track.state.best.mean
        q, X_WB = observation.positions(x)
        J, area = self._difference(track, frame)
        return PoseEstimate(
            found=True,
            q=q,
            X_WB=X_WB,
            node_values=observation.node_values(x),
            J=float(J),
            area=float(area),
            stopped_by=TRACKED,
            seconds=time.perf_counter() - frame.begin,
            root_position=observation.root_position(x),
            scale=observation.scale(x),
        )
