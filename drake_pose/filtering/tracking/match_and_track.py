"""A body in a sequence: matched first, tracked by its contour, matched again after a loss."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body import PoseTree
from drake_pose.camera import Camera
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.tracking.contour_tracker import ContourTracker, Track, TrackingSettings
from drake_pose.matching import MatchResult, PoseSearch
from drake_pose.matching.result import UNEXPLAINED, PlacedMatch, View

Array = NDArray[np.float64]

TRACKED = "tracked"
"""``MatchResult.stopped_by`` of a pose that no search found."""


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
    """The tracker of a pose tree's contour.

    Args:
        tree: the body's pose tree.
        cameras: the cameras.
        period: time between two frames [s].
        settings: how the body may move, and what is unknown.

    Raises:
        SettingsError: no camera, a period that is not positive, or a tree without free values.
    """
    rest = 0.0 if settings.rest_time is None else period / settings.rest_time
    observation = ContourObservation(
        tree, cameras, settings.root_moves, settings.scale_unknown, rest=rest
    )
    return ContourTracker(observation, period, settings)


class MatchAndTrack:
    """Follows a body from frame to frame, and asks a search where it cannot.

    Args:
        search: asked in the first frame, and when the track is lost.
        cameras: the calibrated cameras.
        period: time between two frames [s].
        settings: how the body may move, and when its track is lost.

    Attributes:
        tracker: follows the contour.

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
        self, last: Followed, views: Sequence[View], root_position: Array | None = None
    ) -> tuple[Followed, MatchResult]:
        """The next frame.

        Args:
            last: what was known after the frame before.
            views: of one camera or more, at least one.
            root_position: (3,) where the root is known to be now [m].

        Returns:
            What is known now, and the pose. ``stopped_by`` is TRACKED where it was tracked.
        """
        begin = time.perf_counter()
        tracked: tuple[Track, MatchResult] | None = None
        if last.track is not None:
            track = self.tracker.follow(last.track, self._masks(views), False, root_position)
            tracked = track, self._result(track, views, root_position, begin)
            if not self._is_lost(*tracked, last.reference):
                return Followed(track, last.reference, last.matches), tracked[1]
        matched = self._search.match(views, root_position)
        found = [] if tracked is None else [tracked]
        if matched.found:
            observation = self._observation(root_position)
            scale = matched.scale if isinstance(matched, PlacedMatch) else 1.0
            x = observation.state(matched.q, matched.X_WB, scale)
            if last.track is not None:
                # A search does not know how often an angle has turned round.
                x = observation.continued(x, last.track.state.best.mean)
                matched = self._turned(matched, observation.node_values(x))
            start = self.tracker.start(x)
            followed = self.tracker.follow(start, self._masks(views), True, root_position)
            found += [
                (followed, self._result(followed, views, root_position, begin)),
                (start, matched),
            ]
        if not found:
            return Followed(None, 0.0, last.matches + 1), matched
        track, result = min(found, key=lambda pair: pair[1].E_total)
        return Followed(track, result.E_total, last.matches + 1), result

    def _turned(self, matched: MatchResult, node_values: Sequence[Array]) -> MatchResult:
        """A pose in the turns of a track that goes on."""
        turns = [
            2.0 * np.pi * np.round((now - then) / (2.0 * np.pi))
            for now, then in zip(node_values, matched.node_values, strict=True)
        ]
        return matched.turned(self._search.tree, turns)

    def _masks(self, views: Sequence[View]) -> list[NDArray[np.bool_] | None]:
        seen = {view.camera.name: view.mask for view in views}
        return [seen.get(camera.name) for camera in self.tracker.observation.cameras]

    def _observation(self, root_position: Array | None) -> ContourObservation:
        observation = self.tracker.observation
        if root_position is None:
            return observation
        return observation.with_root_position(root_position)

    def _is_lost(self, track: Track, result: MatchResult, reference: float) -> bool:
        limit = self.settings.lost_growth * reference + self.settings.lost_margin
        return track.lost or result.E_total > min(limit, UNEXPLAINED)

    def _result(
        self, track: Track, views: Sequence[View], root_position: Array | None, begin: float
    ) -> MatchResult:
        """The pose of a track, drawn into the views to see how well it explains them."""
        observation, x = self._observation(root_position), track.state.best.mean
        q, X_WB = observation.positions(x)
        J, area = 0, 0
        for view in views:
            J += int(np.count_nonzero(observation.draw(x, view.camera) != view.mask))
            area += int(np.count_nonzero(view.mask))
        E_total = J / area
        return PlacedMatch(
            found=True,
            q=q,
            X_WB=X_WB,
            node_values=observation.node_values(x),
            J=float(J),
            E_total=E_total,
            first_E_total=E_total,
            runs=0,
            outside_limit=(),
            untried={},
            stopped_by=TRACKED,
            seconds=time.perf_counter() - begin,
            root_position=observation.root_position(x),
            scale=observation.scale(x),
        )
