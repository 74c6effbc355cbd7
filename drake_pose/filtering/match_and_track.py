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
    PoseEstimate,
    PoseSearch,
    View,
    covariance_pose_set,
)
from drake_pose.silhouette.pictures.masks import edge_area


@dataclass(frozen=True, eq=False)
class Followed:
    """What is known after a frame.

    Attributes:
        track: of the body; None before the first match, and where none was found.
        reference: E_total after the last match; a track that explains much less is lost.
        matches: how often the search has been asked.
    """

    track: Track | None = None
    reference: float = 0.0
    matches: int = 0


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


class MatchAndTrack:
    """Follows a body from frame to frame, and asks a search where it cannot.

    Args:
        search: asked in the first frame, and when the track is lost.
        period: time between two frames [s].

    Raises:
        SettingsError: no camera, a period that is not positive, or a tree without free values.
    """

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera],
        period: float,
        settings: TrackingSettings | None = None,
    ) -> None:
        self.settings = settings or TrackingSettings()
        self._search = search
        self.tracker = make_tracker(search.tree, cameras, period, self.settings)

    def next(
        self,
        last: Followed,
        views: Sequence[View],
        root_position: Array | None = None,
        pictures: Mapping[str, Picture] | None = None,
        start: Array | None = None,
    ) -> tuple[Followed, PoseEstimate]:
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
            the track is lost, and there is neither a mask nor a start, no pose is found; it is
            followed all the same, and found again if the contour fits again.

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
            if not self._is_lost(*tracked, last.reference, bool(views)):
                return Followed(track, last.reference, last.matches), tracked[1]
        if start is not None:
            begun = self._begin(start, last, frame)
            # A start that the masks contradict is no better than none.
            if begun[1].found or not views:
                return begun
        if not views:
            return self._go_on(last, tracked, frame)
        return self._match(last, tracked, frame)

    def with_intervals(self, followed: Followed, pose: PoseEstimate) -> PoseEstimate:
        """A frame's pose that was tracked, with what its contours alone say of each joint."""
        track = followed.track
        if track is None or track.measurement is None:
            return pose
        observation = self.tracker.observation
        own = observation.covariance(track.measurement, pose.area)
        pictures = len(observation.cameras)
        return replace(pose, pose_set=covariance_pose_set(self._search.tree, pose, own, pictures))

    def _match(
        self, last: Followed, tracked: tuple[Track, PoseEstimate] | None, frame: _GivenFrame
    ) -> tuple[Followed, PoseEstimate]:
        """The best of what was tracked, if anything, and of what the search finds."""
        matched = self._search.match(frame.views, frame.root_position)
        found = [] if tracked is None else [tracked]
        if matched.found:
            x = frame.observation.state(matched.q, matched.X_WB, matched.scale)
            if last.track is not None:
                # A search does not know how often an angle has turned round.
                x = frame.observation.continued(x, last.track.state.best.mean)
                matched = self._turned(matched, frame.observation.node_values(x))
            first = self.tracker.start(x)
            followed = self._follow(first, frame, True)
            # The first look of a track is at what the search found, whose families are its own.
            looked = replace(self._result(followed, frame), pose_set=matched.pose_set)
            # The searched pose may fit better: the colours of this frame are learned all the same.
            found += [(followed, looked), (replace(first, colours=followed.colours), matched)]
        if not found:
            return Followed(None, 0.0, last.matches + 1), matched
        track, result = min(found, key=lambda pair: pair[1].E_total)
        return Followed(track, result.E_total, last.matches + 1), result

    def _begin(
        self, start: Array, last: Followed, frame: _GivenFrame
    ) -> tuple[Followed, PoseEstimate]:
        """A track that begins where the body is known to be."""
        x = frame.observation.state(start)
        if last.track is not None:
            x = frame.observation.continued(x, last.track.state.best.mean)
        track = self._follow(self.tracker.start(x), frame, True)
        result = self._result(track, frame)
        reference = result.E_total if frame.views else UNEXPLAINED
        found = not self._is_lost(track, result, reference, bool(frame.views))
        return Followed(track, reference, last.matches), replace(result, found=found)

    def _go_on(
        self, last: Followed, tracked: tuple[Track, PoseEstimate] | None, frame: _GivenFrame
    ) -> tuple[Followed, PoseEstimate]:
        """What is known where neither a track nor a mask nor a start says where the body is."""
        if tracked is None:
            default = self._search.tree.model.default_positions
            nowhere = self.tracker.observation.state(default)
            result = self._result(self.tracker.start(nowhere), frame)
            return last, replace(result, found=False)
        return Followed(tracked[0], last.reference, last.matches), replace(tracked[1], found=False)

    def _follow(self, track: Track, frame: _GivenFrame, first: bool) -> Track:
        """The tracker's next frame; first: it is the one that the track begins in."""
        return self.tracker.follow(track, frame.masks, first, frame.root_position, frame.pictures)

    def _turned(self, matched: PoseEstimate, node_values: Sequence[Array]) -> PoseEstimate:
        """A pose in the turns of a track that goes on."""
        turns = [
            2.0 * np.pi * np.round((now - then) / (2.0 * np.pi))
            for now, then in zip(node_values, matched.node_values, strict=True)
        ]
        return matched.turned(self._search.tree, turns)

    def _is_lost(
        self, track: Track, result: PoseEstimate, reference: float, has_masks: bool
    ) -> bool:
        """Whether a track left the contour, or its E_total grew by half and .1 since its match."""
        limit = 1.5 * reference + 0.1
        return track.lost or (has_masks and result.E_total > min(limit, UNEXPLAINED))

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
            J += edge_area(drawn) * track.measurement.distance
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
