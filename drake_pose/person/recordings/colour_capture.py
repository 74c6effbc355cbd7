"""A recording of one person of whom only a few frames have masks: pictures say the rest.

Masks or given positions start it, also after a loss; the person's colours are followed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.fit.colours import Picture
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.colour_views import ColourViews, KnownColours
from drake_pose.person.pose_tracker import PersonPoseTracker, TrackState
from drake_pose.person.recordings.checked_capture import CheckedCapture, capture_checked
from drake_pose.person.recordings.person_capture import PersonCapture
from drake_pose.person.recordings.persons_in_view import ReadFrame
from drake_pose.person.search import LENIENT
from drake_pose.person.shape import NOISE, shape_values

Array = NDArray[np.float64]
ReadPictures = Callable[[int], Mapping[str, Picture]]

# Silhouettes of fewer cameras do not tell where a person is.
_FEWEST = 2


@dataclass(frozen=True, eq=False)
class ColourCapture:
    """A captured recording.

    Args:
        captured: all frames; nan where the person is lost.
        checked: what the frames with masks say, counted among themselves; None: there are none.
        masked: the frames with masks of two cameras or more, counted from 0.
        distances: (frames,) root mean square between the person's contour and the colours' over
            all cameras [pixel]; nan in frames that were not followed by colour.
    """

    captured: PersonCapture
    checked: CheckedCapture | None
    masked: tuple[int, ...]
    distances: Array


def capture_by_colour(
    tree: PoseTree,
    cameras: Mapping[str, Camera],
    count: int,
    masked: tuple[int, ...],
    masks: ReadFrame,
    pictures: ReadPictures,
    starts: Mapping[int, Array],
    on_frame: Callable[[int], None] | None = None,
) -> ColourCapture:
    """Captures a recording of few masks.

    Args:
        tree: of a model with the landmarks of a person. Its shape joints are fitted to the frames
            with masks; without any they stay where the first start has them.
        count: how many frames there are; `masked` have masks.
        masks, pictures: give a frame's, by camera; pictures are (H, W, 3).
        starts: the plant's positions (nq,) by frame, where they are about known.
        on_frame: called after each frame.

    Raises:
        ModelError: the model has no landmarks of trunk, arms and legs.
        SettingsError: in none of the frames with masks two cameras see a person.
    """
    masked = tuple(k for k in masked if len(masks(k)) >= _FEWEST)
    checked = None
    if masked:
        checked = capture_checked(tree, cameras, lambda k: masks(masked[k]), len(masked))
    follower = _Follower(tree, count, checked, masked)
    for frame in range(count):
        seen = pictures(frame)
        follower.follow(frame, [cameras[k] for k in seen], list(seen.values()), starts.get(frame))
        if on_frame is not None:
            on_frame(frame)
    return ColourCapture(follower.captured, checked, masked, follower.distances)


class _Follower:
    """Follows the person through a recording."""

    def __init__(
        self,
        tree: PoseTree,
        count: int,
        checked: CheckedCapture | None,
        masked: tuple[int, ...],
    ) -> None:
        self._checked = checked
        self._places = {frame: k for k, frame in enumerate(masked)}
        own = None if checked is None else checked.captured
        shape = None if own is None else own.shape
        fit = ContourFit(tree, None if own is None else own.outlines, NOISE)
        rest = None if shape is None else shape.values
        self._tracker = PersonPoseTracker(fit, LENIENT, shape_values(tree), rest)
        self._state: TrackState | None = None
        self._known: KnownColours = {}
        size = count, len(tree.model.position_names)
        unknown = np.full(size, np.nan)
        self.captured = PersonCapture(
            unknown, np.zeros(size[0]), shape, fit.outlines, tree, unknown.copy()
        )
        self.distances = np.full(size[0], np.nan)

    def follow(
        self,
        frame: int,
        cameras: Sequence[Camera],
        pictures: Sequence[Picture],
        start: Array | None,
    ) -> None:
        """The next frame; start: where the person is about known to be."""
        tracker = self._tracker
        views = ColourViews(cameras, pictures, self._known)
        if self._follow_masks(frame, views):
            return
        if self._state is not None:
            self._state = tracker.follow_by_colour(self._state, views)
        if start is not None and (self._state is None or self._state.is_lost):
            began = tracker.start(tracker.values(start))
            if not self._known:
                learned = views.learned(tracker.fit, began.values)
                views = ColourViews(cameras, views.pictures, learned)
            self._state = tracker.follow_by_colour(began, views)
        if self._state is None:
            return
        captured, values = self.captured, self._state.values
        captured.shares[frame] = self._state.share
        if self._state.is_lost:
            self._state = replace(self._state, step=np.zeros(len(values)))
            return
        self._known = views.learned(tracker.fit, values)
        lengths = None if captured.shape is None else captured.shape.covariance
        captured.q[frame] = tracker.positions(values)
        captured.deviations[frame] = tracker.deviations(values, views, lengths)
        self.distances[frame] = tracker.distance_by_colour(values, views)

    def _follow_masks(self, frame: int, views: ColourViews) -> bool:
        """Takes what masks said of a frame; False where they did not say where the person is."""
        place = self._places.get(frame)
        if self._checked is None or place is None:
            return False
        own, captured = self._checked.captured, self.captured
        if not np.isfinite(own.q[place]).all():
            return False
        values, last = self._tracker.values(own.q[place]), self._state
        self._state = self._tracker.start(values)
        if last is not None and not last.is_lost:
            self._state = replace(self._state, step=values - last.values)
        captured.q[frame], captured.shares[frame] = own.q[place], own.shares[place]
        captured.deviations[frame] = own.deviations[place]
        self._known = views.learned(self._tracker.fit, values, self._checked.read(place))
        return True
