"""A whole recording of one person, whose proportions need not be known: masks in, poses out.

The person is found afresh in a few frames; from the one that fits best the others are followed,
forwards and backwards. Where the model has shape joints, the first frames give the person's own
lengths and girths, and everything is followed once more with these.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.fit.evidence import EdgePoints
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.person.search import SearchSettings
from drake_pose.person.shape import PersonShape, fit_shape, shape_noise, shape_values
from drake_pose.person.silhouette_tracker import (
    SilhouetteTracker,
    TrackerSettings,
    TrackState,
)
from drake_pose.person.silhouette_view import SilhouetteView, see_silhouette
from drake_pose.silhouette.areas.outline import Outline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
ReadFrame = Callable[[int], Mapping[str, Mask]]
_Seen = tuple[list[Camera], list[SilhouetteView]]

EDGE_POINTS = 120.0
"""A picture's height over the usual spacing of its region's edge points."""

# A fresh start of which more fits needs no other to be compared with.
_SURE = 0.97


def _lenient() -> TrackerSettings:
    """A model that is only like the person fits to within centimetres."""
    ends = (AnnealingStage(0.07, 0.05), AnnealingStage(0.05, 0.05), AnnealingStage(0.04, 0.04))
    return TrackerSettings(
        rounds=(AnnealingStage(0.10, 0.06), *ends),
        search=SearchSettings(
            (
                AnnealingStage(0.20, 0.06),
                AnnealingStage(0.15, 0.06),
                AnnealingStage(0.10, 0.06),
                *ends,
            )
        ),
    )


@dataclass(frozen=True)
class PersonCaptureSettings:
    """How a recording is captured.

    Args:
        tracker: how the person is followed.
        is_sequence: whether frames follow each other; else each is found afresh.
        starts: in how many of the frames a sequence is begun, for the best to be taken.
        shape_span: the shape is fitted to frames among this many first ones.
        shape_frames: how many of them.
    """

    tracker: TrackerSettings = field(default_factory=_lenient)
    is_sequence: bool = True
    starts: int = 4
    shape_span: int = 40
    shape_frames: int = 10

    def __post_init__(self) -> None:
        for name in ("starts", "shape_span", "shape_frames"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be 1 or more, not {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class PersonCapture:
    """A captured recording.

    Args:
        q: (frames, nq) the plant's positions; nan where nobody was seen in time.
        shares: (frames,) of the contours' lengths, what fits; 0 where nobody was seen.
        shape: the person's; None where the model has no shape joints.
        outlines: the simplified surfaces of the tree's nodes, as wide as the person.
        tree: the pose tree.
        deviations: (frames, nq) standard deviations of the positions [rad or m], as far as the
            pictures and the limits tell; nan where nobody was seen in time.
    """

    q: Array
    shares: Array
    shape: PersonShape | None
    outlines: tuple[Outline, ...]
    tree: PoseTree
    deviations: Array


def capture_person(
    tree: PoseTree,
    cameras: Mapping[str, Camera],
    read: ReadFrame,
    count: int,
    settings: PersonCaptureSettings | None = None,
    on_frame: Callable[[int], None] | None = None,
    pauses: Collection[int] = (),
) -> PersonCapture:
    """Captures a recording.

    Args:
        tree: of a model with the landmarks of a person, best with shape joints:
            urdf/person/person_shape.urdf.
        cameras: by name.
        read: gives the masks (H, W) of a frame, counted from 0, by camera; one may be missing.
        count: how many frames there are.
        settings: how.
        on_frame: called with each frame that is finished.
        pauses: the frames before which the person was out of sight, and may have gone anywhere.

    Raises:
        ModelError: the model has no landmarks of trunk, arms and legs.
        SettingsError: there is no frame, or in none of those looked at two cameras see a person.
    """
    if count < 1:
        raise SettingsError("a recording needs one frame or more")
    settings = settings or PersonCaptureSettings()
    recording = _Recording(cameras, read, frozenset(pauses))
    tracker, shape, states = _measured(tree, recording, count, settings)
    deviations = np.full((count, len(tree.model.position_names)), np.nan)

    def finish(frame: int, state: TrackState | None, seen: _Seen) -> None:
        if state is not None:
            lengths = None if shape is None else shape.covariance
            sure = tracker.uncertainty(state.values, *seen, lengths)
            deviations[frame] = tracker.deviations(sure.covariance)
        if on_frame is not None:
            on_frame(frame)

    followed = _follow_all(tracker, recording, range(count), settings, states, finish)
    empty = np.full(len(tree.model.position_names), np.nan)
    found = [followed.get(k) for k in range(count)]
    return PersonCapture(
        np.array([empty if one is None else tracker.positions(one.values) for one in found]),
        np.array([0.0 if one is None else one.share for one in found]),
        shape,
        tracker.fit.outlines,
        tree,
        deviations,
    )


class _Recording:
    """A recording's frames as the tracker needs them."""

    def __init__(
        self, cameras: Mapping[str, Camera], read: ReadFrame, pauses: frozenset[int]
    ) -> None:
        self._cameras, self._read, self.pauses = cameras, read, pauses

    def see(self, frame: int) -> _Seen:
        """The cameras that have a picture, and what each says."""
        masks = self._read(frame)
        cameras = [self._cameras[name] for name in masks]
        views = [
            see_silhouette(mask, max(2.0, camera.height / EDGE_POINTS))
            for camera, mask in zip(cameras, masks.values(), strict=True)
        ]
        return cameras, views

    def edges(self, frame: int) -> tuple[list[Camera], list[EdgePoints]]:
        """The cameras and the regions' edges."""
        cameras, views = self.see(frame)
        return cameras, [view.edge for view in views]


def _measured(
    tree: PoseTree, recording: _Recording, count: int, settings: PersonCaptureSettings
) -> tuple[SilhouetteTracker, PersonShape | None, dict[int, TrackState]]:
    """What follows a person of the shape that the first frames give, the shape, and poses there."""
    fit = ContourFit(tree, noise=shape_noise())
    is_shape = shape_values(tree)
    tracker = SilhouetteTracker(fit, settings.tracker, is_shape)
    if not is_shape.any():
        return tracker, None, {}
    span = min(count, settings.shape_span)
    rough = _follow_all(tracker, recording, range(span), settings, None)
    wanted = np.unique(np.linspace(0, span - 1, settings.shape_frames).astype(int))
    poses = {int(k): one.values for k in wanted if (one := rough[int(k)]) is not None}
    used = list(poses)
    shape = fit_shape(fit, [recording.edges(k) for k in used], np.array(list(poses.values())))
    worn = ContourFit(tree, shape.outlines, shape_noise())
    tracker = SilhouetteTracker(worn, settings.tracker, is_shape, shape.values)
    states = {k: tracker.start(pose) for k, pose in zip(used, shape.poses, strict=True)}
    return tracker, shape, states


def _follow_all(
    tracker: SilhouetteTracker,
    recording: _Recording,
    frames: range,
    settings: PersonCaptureSettings,
    known: Mapping[int, TrackState] | None,
    finish: Callable[[int, TrackState | None, _Seen], None] | None = None,
) -> dict[int, TrackState | None]:
    """The states of all frames, begun where the person is known or fits best."""
    found: dict[int, TrackState | None] = {}

    def follow(state: TrackState | None, frame: int, is_pause: bool = False) -> TrackState | None:
        seen = recording.see(frame)
        found[frame] = tracker.follow(state, *seen)
        if is_pause and state is not None:
            anew = tracker.follow(None, *seen)
            found[frame] = max(found[frame], anew, key=lambda one: one.share if one else 0.0)
        if finish is not None:
            finish(frame, found[frame], seen)
        return found[frame]

    if not settings.is_sequence:
        for frame in frames:
            follow(None, frame)
        return found
    if known:
        begin = min(known)
        state = known[begin]
    else:
        begin, state = _best_start(tracker, recording, frames, settings.starts)
    forwards: TrackState | None = state
    backwards: TrackState | None = state
    for frame in range(begin, frames.stop):
        forwards = follow(forwards, frame, frame > begin and frame in recording.pauses)
    for frame in range(begin - 1, frames.start - 1, -1):
        backwards = follow(backwards, frame, frame + 1 in recording.pauses)
    return found


def _best_start(
    tracker: SilhouetteTracker, recording: _Recording, frames: range, starts: int
) -> tuple[int, TrackState]:
    """The frame in which a fresh start fits best, and the state there."""
    best: tuple[int, TrackState] | None = None
    for frame in np.unique(np.linspace(frames.start, frames.stop - 1, starts).astype(int)):
        cameras, views = recording.see(int(frame))
        state = tracker.follow(None, cameras, views)
        if state is not None and (best is None or state.share > best[1].share):
            best = int(frame), state
            if state.share > _SURE:
                break
    if best is None:
        raise SettingsError(
            f"in none of {starts} frames two cameras saw a person: give masks that show one"
        )
    return best
