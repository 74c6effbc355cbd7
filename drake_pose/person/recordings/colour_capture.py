"""A recording of one person of whom only a few frames have masks: pictures say the rest.

From masks, best of the first frame, come the person's shape, pose and colours; the next frames are
followed by these colours. After a loss the next masks, or positions that are given, go on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.fit.colours import Picture
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.colour_views import ColourViews, KnownColours
from drake_pose.person.recordings.checked_capture import CheckedCapture, capture_checked
from drake_pose.person.recordings.person_capture import (
    PersonCapture,
    PersonCaptureSettings,
    ReadFrame,
)
from drake_pose.person.shape import PersonShape, shape_noise, shape_values
from drake_pose.person.silhouette_tracker import SilhouetteTracker, TrackState

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
        distances: (frames,) between the person's contour and the one that colours show, as a root
            mean square over all cameras [pixel]; nan in frames that were not followed by colour.
    """

    captured: PersonCapture
    checked: CheckedCapture | None
    masked: tuple[int, ...]
    distances: Array


@dataclass(frozen=True, eq=False)
class ColourRecording:
    """What is there of a recording.

    Args:
        cameras: by name.
        count: how many frames there are.
        masks: gives the masks (H, W) of a frame, counted from 0, by camera; none in most.
        pictures: gives the pictures (H, W, 3) of a frame by camera.
        starts: the plant's positions (nq,) by frame, where they are about known.
    """

    cameras: Mapping[str, Camera]
    count: int
    masks: ReadFrame
    pictures: ReadPictures
    starts: Mapping[int, Array]


def capture_by_colour(
    tree: PoseTree,
    recording: ColourRecording,
    masked: tuple[int, ...],
    settings: PersonCaptureSettings | None = None,
    on_frame: Callable[[int], None] | None = None,
) -> ColourCapture:
    """Captures a recording of few masks.

    Args:
        tree: of a model with the landmarks of a person. Its shape joints are fitted to the frames
            with masks; without any they stay where the first start has them.
        recording: masks, pictures and starts.
        masked: the frames that have masks.
        settings: how.
        on_frame: called with each frame that is finished.

    Raises:
        ModelError: the model has no landmarks of trunk, arms and legs.
        SettingsError: in none of the frames with masks two cameras see a person.
    """
    settings = settings or PersonCaptureSettings()
    masked = tuple(k for k in masked if len(recording.masks(k)) >= _FEWEST)
    checked = None
    if masked:
        checked = capture_checked(
            tree, recording.cameras, lambda k: recording.masks(masked[k]), len(masked), settings
        )
    follower = _Follower(tree, recording, settings, checked, masked)
    for frame in range(recording.count):
        follower.follow(frame)
        if on_frame is not None:
            on_frame(frame)
    return ColourCapture(follower.captured(), checked, masked, follower.distances)


class _Follower:
    """Follows the person through a recording."""

    def __init__(
        self,
        tree: PoseTree,
        recording: ColourRecording,
        settings: PersonCaptureSettings,
        checked: CheckedCapture | None,
        masked: tuple[int, ...],
    ) -> None:
        self._tree, self._recording, self._checked = tree, recording, checked
        self._places = {frame: k for k, frame in enumerate(masked)}
        own = None if checked is None else checked.captured
        self._shape: PersonShape | None = None if own is None else own.shape
        fit = ContourFit(tree, None if own is None else own.outlines, shape_noise())
        rest = None if self._shape is None else self._shape.values
        self._tracker = SilhouetteTracker(fit, settings.tracker, shape_values(tree), rest)
        self._state: TrackState | None = None
        self._known: KnownColours = {}
        size = recording.count, len(tree.model.position_names)
        self._q, self._deviations = np.full(size, np.nan), np.full(size, np.nan)
        self._shares, self.distances = np.zeros(size[0]), np.full(size[0], np.nan)

    def follow(self, frame: int) -> None:
        """The next frame."""
        recording = self._recording
        pictures = recording.pictures(frame)
        cameras = [recording.cameras[name] for name in pictures]
        views = ColourViews(cameras, list(pictures.values()), self._known)
        if self._follow_masks(frame, views):
            return
        last = self._state
        if last is not None:
            self._state = self._tracker.follow_by_colour(last, views)
        start = recording.starts.get(frame)
        if start is not None and (self._state is None or self._tracker.is_lost(self._state)):
            began = self._tracker.start(self._tracker.values(start))
            if not self._known:
                views = ColourViews(
                    cameras, views.pictures, views.learned(self._tracker.fit, began.values)
                )
            self._state = self._tracker.follow_by_colour(began, views)
        if self._state is None:
            return
        self._shares[frame] = self._state.share
        if self._tracker.is_lost(self._state):
            self._state = replace(self._state, step=np.zeros(len(self._state.step)))
            return
        values = self._state.values
        self._known = views.learned(self._tracker.fit, values)
        lengths = None if self._shape is None else self._shape.covariance
        sure = self._tracker.uncertainty_by_colour(values, views, lengths)
        self._q[frame] = self._tracker.positions(values)
        self._deviations[frame] = self._tracker.deviations(sure.covariance)
        self.distances[frame] = self._tracker.distance_by_colour(values, views)

    def _follow_masks(self, frame: int, views: ColourViews) -> bool:
        """Takes what masks said of a frame; False where they did not say where the person is."""
        place = self._places.get(frame)
        if self._checked is None or place is None:
            return False
        own = self._checked.captured
        if not np.isfinite(own.q[place]).all():
            return False
        values, last = self._tracker.values(own.q[place]), self._state
        state = self._tracker.start(values)
        if last is not None and not self._tracker.is_lost(last):
            state = replace(state, step=values - last.values)
        self._state = state
        self._q[frame], self._deviations[frame] = own.q[place], own.deviations[place]
        self._shares[frame] = own.shares[place]
        self._known = views.learned(self._tracker.fit, values, self._checked.read(place))
        return True

    def captured(self) -> PersonCapture:
        """All frames."""
        return PersonCapture(
            self._q, self._shares, self._shape, self._tracker.fit.outlines, self._tree,
            self._deviations,
        )  # fmt: skip
