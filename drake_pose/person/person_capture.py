"""A whole recording of one person, whose proportions need not be known: poses out.

By masks: found in a few frames, followed both ways from the best; shape joints are fitted, then all
again. Where only a few frames have masks the person's colours in pictures say the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.fit.colours import OwnColours
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.fit.evidence import EdgePoints
from drake_pose.person.persons_in_view import ReadFrame
from drake_pose.person.pose_tracker import PersonPoseTracker, TrackState
from drake_pose.person.search import LENIENT
from drake_pose.person.shape import NOISE, PersonShape, fit_shape, shape_values
from drake_pose.person.views import (
    ColourViews,
    FrameViews,
    KnownColours,
    SilhouetteView,
    edge_spacing,
    see_silhouette,
)
from drake_pose.silhouette.areas.outline import Outline

# In how many of the frames a sequence is begun, for the best to be taken, and of what more fits
# needs no other to be compared with.
_STARTS, _SURE = 4, 0.97
# The shape is fitted to some frames among this many first ones.
_SHAPE_SPAN, _SHAPE_FRAMES = 40, 10


@dataclass(frozen=True, eq=False)
class PersonCapture:
    """A captured recording.

    Args:
        q: (frames, nq) the plant's positions; nan where nobody was seen in time.
        shares: (frames,) of the contours' lengths, what fits; 0 where nobody was seen.
        shape: the person's; None where the model has no shape joints.
        outlines: the simplified surfaces of the tree's nodes, as wide as the person.
        deviations: (frames, nq) standard deviations of q [rad or m] by pictures and limits; nan.
    """

    q: Array
    shares: Array
    shape: PersonShape | None
    outlines: tuple[Outline, ...]
    tree: PoseTree
    deviations: Array

    @staticmethod
    def begun(count: int, shape: PersonShape | None, fit: ContourFit) -> PersonCapture:
        """Of so many frames, of which nothing is known yet."""
        q = np.full((count, len(fit.tree.model.position_names)), np.nan)
        return PersonCapture(q, np.zeros(count), shape, fit.outlines, fit.tree, q.copy())

    def note(
        self,
        frame: int,
        tracker: PersonPoseTracker,
        state: TrackState,
        seen: FrameViews | ColourViews,
    ) -> None:
        """Notes where the person is in a frame, and how sure that is by what was seen."""
        lengths = None if self.shape is None else self.shape.covariance
        self.q[frame], self.shares[frame] = tracker.positions(state.values), state.share
        self.deviations[frame] = tracker.deviations(state.values, seen, lengths)


def capture_person(
    tree: PoseTree,
    cameras: Mapping[str, Camera],
    read: ReadFrame,
    frames: Sequence[int],
    count: int | None = None,
    is_sequence: bool = True,
    on_frame: Callable[[int], None] | None = None,
) -> PersonCapture:
    """Captures a recording.

    Args:
        tree: of a model with the landmarks of a person, best with shape joints:
            urdf/person/person_shape.urdf.
        read: gives the masks of a frame.
        frames: those in which the person is seen, of `count`; before one that does not follow the
            last he may have gone anywhere.
        is_sequence: whether frames follow each other; else each is found afresh.
        on_frame: called after each frame.

    Raises:
        ModelError: the model has no landmarks of trunk, arms and legs.
        SettingsError: there is no frame, or in none of those looked at two cameras see a person.
    """
    if not len(frames):
        raise SettingsError("a recording needs one frame or more")
    capture = _Capture(tree, cameras, read, is_sequence)
    shape, states = capture.measure(frames)
    tracker = capture.tracker
    captured = PersonCapture.begun(count or len(frames), shape, tracker.fit)

    def finish(frame: int, state: TrackState | None, seen: FrameViews) -> None:
        if state is not None:
            captured.note(frame, tracker, state, seen)
        if on_frame is not None:
            on_frame(frame)

    capture.follow_all(frames, states, finish)
    return captured


class _Capture:
    """A recording, and what follows the person in it."""

    def __init__(
        self, tree: PoseTree, cameras: Mapping[str, Camera], read: ReadFrame, is_sequence: bool
    ) -> None:
        self._cameras, self._read, self._is_sequence = cameras, read, is_sequence
        self.tracker = PersonPoseTracker(ContourFit(tree, noise=NOISE), LENIENT, shape_values(tree))
        # The frames that the shape is measured in are seen three times: by camera regions as bits
        # along the rows, and edges.
        self._kept: dict[int, dict[str, tuple[NDArray[np.uint8], EdgePoints]]] = {}

    def _see(self, frame: int) -> FrameViews:
        if frame in self._kept:
            cameras, views = [self._cameras[name] for name in self._kept[frame]], []
            for camera, (bits, edge) in zip(cameras, self._kept[frame].values(), strict=True):
                region = np.unpackbits(bits, axis=1, count=camera.width).view(np.bool_)
                views.append(SilhouetteView(region, edge))
            return FrameViews(cameras, views)
        masks = self._read(frame)
        cameras = [self._cameras[name] for name in masks]
        pairs = zip(cameras, masks.values(), strict=True)
        return FrameViews(cameras, [see_silhouette(one, edge_spacing(c)) for c, one in pairs])

    def measure(self, frames: Sequence[int]) -> tuple[PersonShape | None, dict[int, TrackState]]:
        """The shape that the first frames give, which the tracker has from now on; and states."""
        fit = self.tracker.fit
        is_shape = shape_values(fit.tree)
        if not is_shape.any():
            return None, {}
        first = frames[:_SHAPE_SPAN]
        for frame in first:
            self._kept[frame] = {
                camera.name: (np.packbits(view.region, axis=1), view.edge)
                for camera, view in self._see(frame).pairs
            }
        rough = self.follow_all(first, {})
        poses = {k: one.values for k in spread_over(first, _SHAPE_FRAMES) if (one := rough[k])}
        looks = [self._see(k) for k in poses]
        views = [(one.cameras, [view.edge for view in one.views]) for one in looks]
        shape = fit_shape(fit, views, np.array(list(poses.values())))
        worn, plan = ContourFit(fit.kinematics, shape.outlines, NOISE), self.tracker.plan
        self.tracker = PersonPoseTracker(worn, LENIENT, is_shape, shape.values, plan)
        states = zip(poses, shape.poses, strict=True)
        return shape, {k: self.tracker.start(pose) for k, pose in states}

    def follow_all(
        self,
        frames: Sequence[int],
        known: Mapping[int, TrackState],
        finish: Callable[[int, TrackState | None, FrameViews], None] | None = None,
    ) -> dict[int, TrackState | None]:
        """The states of all frames, begun where the person is known or fits best."""
        found: dict[int, TrackState | None] = {}

        def follow(state: TrackState | None, frame: int, last: int) -> TrackState | None:
            seen = self._see(frame)
            found[frame] = self.tracker.follow(state, seen)
            if state is not None and abs(frame - last) > 1:
                anew = self.tracker.follow(None, seen)
                found[frame] = max(found[frame], anew, key=lambda one: one.share if one else 0.0)
            if finish is not None:
                finish(frame, found[frame], seen)
            return found[frame]

        if not self._is_sequence:
            for frame in frames:
                follow(None, frame, frame)
            return found
        begin = min(known) if known else None
        begin, start = self._best_start(frames) if begin is None else (begin, known[begin])
        place = list(frames).index(begin)
        for way in (frames[place:], frames[:place][::-1]):
            state: TrackState | None = start
            last = begin
            for frame in way:
                state, last = follow(state, frame, last), frame
        return found

    def _best_start(self, frames: Sequence[int]) -> tuple[int, TrackState]:
        """The frame in which a fresh start fits best, and the state there."""
        best: tuple[int, TrackState] | None = None
        for frame in spread_over(frames, _STARTS):
            state = self.tracker.follow(None, self._see(frame))
            if state is not None and (best is None or state.share > best[1].share):
                best = frame, state
                if state.share > _SURE:
                    break
        if best is None:
            raise SettingsError(
                f"in none of {_STARTS} frames two cameras saw a person: give masks that show one"
            )
        return best


def spread_over(frames: Sequence[int], count: int) -> list[int]:
    """This many frames of all, evenly."""
    picked = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return [frames[int(k)] for k in picked]


ReadPictures = Callable[[int], Mapping[str, Picture]]


def capture_by_colour(
    tree: PoseTree,
    cameras: Mapping[str, Camera],
    count: int,
    pictures: ReadPictures,
    starts: Mapping[int, Array],
    masked: Mapping[int, Mapping[str, Mask]],
    known: PersonCapture | None,
    on_frame: Callable[[int], None] | None = None,
) -> tuple[PersonCapture, Array]:
    """Captures a recording of few masks: these or given positions start it, also after a loss.

    Args:
        pictures: gives a frame's (H, W, 3), by camera, of `count` frames.
        starts: the plant's positions (nq,) by frame, where they are about known.
        masked: the masks by camera of the frames that have some.
        known: what these say, which also gives shape joints; None: there are none, and shape
            joints stay where the first start has them.

    Returns:
        The capture, nan where the person is lost; and (frames,) the distance of the contours, root
        mean square over cameras [pixel], nan in frames that were not followed by colour.
    """
    shape = None if known is None else known.shape
    fit = ContourFit(tree, None if known is None else known.outlines, NOISE)
    tracker = PersonPoseTracker(
        fit, LENIENT, shape_values(tree), None if shape is None else shape.values
    )
    places = {frame: k for k, frame in enumerate(masked)}
    captured, distances = PersonCapture.begun(count, shape, fit), np.full(count, np.nan)
    state: TrackState | None = None
    colours: KnownColours = {}
    own: OwnColours | None = None
    for frame in range(count):
        seen = pictures(frame)
        views = ColourViews([cameras[name] for name in seen], list(seen.values()), colours)
        place = places.get(frame)
        if known is not None and place is not None and np.isfinite(known.q[place]).all():
            values, last = tracker.values(known.q[place]), state
            state = tracker.start(values)
            if last is not None and not last.is_lost:
                state = replace(state, step=values - last.values)
            captured.q[frame], captured.shares[frame] = known.q[place], known.shares[place]
            captured.deviations[frame] = known.deviations[place]
            colours = views.learned(fit, values, masked[frame])
            shown = zip(views.cameras, views.pictures, strict=True)
            X_WN = fit.kinematics.poses(values)
            own = OwnColours.learned(colours.values(), fit.outlines, X_WN, shown)
        else:
            state, views = _followed(tracker, state, views, starts.get(frame), own)
            if state is not None and state.is_lost:
                captured.shares[frame] = state.share
                state = replace(state, step=np.zeros(len(state.values)))
            elif state is not None:
                colours = views.learned(fit, state.values)
                captured.note(frame, tracker, state, views)
                distances[frame] = tracker.distance_by_colour(state.values, views)
        if on_frame is not None:
            on_frame(frame)
    return captured, distances


def _followed(
    tracker: PersonPoseTracker,
    state: TrackState | None,
    views: ColourViews,
    start: Array | None,
    own: OwnColours | None,
) -> tuple[TrackState | None, ColourViews]:
    """The next frame by its pictures, or from a start (nq,) where the person is lost."""
    if state is not None:
        state = tracker.follow_by_colour(state, views, own)
    if start is not None and (state is None or state.is_lost):
        began = tracker.start(tracker.values(start))
        if not views.known:
            learned = views.learned(tracker.fit, began.values)
            views = ColourViews(views.cameras, views.pictures, learned)
        state = tracker.follow_by_colour(began, views)
    return state, views
