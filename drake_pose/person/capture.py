"""Capture of a recording of one person of unknown proportions, robust to faults of the recording.

`capture_person` finds the person in a few frames, tracks forwards and backwards from the best one,
fits the shape joints, and tracks all frames again. `capture_checked` cuts other persons out of the
masks first, leaves out a camera that disagrees with the others, and then captures the recording
once more.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit, PoseFit
from drake_pose.fit.evidence import EdgePoints, find_edge_points
from drake_pose.person.faults import (
    CameraComparison,
    CameraFault,
    FrameEdges,
    RigFault,
    find_rig_fault,
    first_moved_frame,
    is_explained,
    require_person,
)
from drake_pose.person.figures import PersonRecording, ReadFrame, ViewFaults
from drake_pose.person.pose_tracker import (
    NOISE,
    PersonBelief,
    PersonPoseTracker,
    PersonShape,
    fit_shape,
    shape_values,
    tracker_of_person,
)
from drake_pose.person.search import SIGNIFICANT
from drake_pose.person.views import FrameViews, SilhouetteView, edge_spacing, see_silhouette
from drake_pose.silhouette.outline import Outline

SHAPE_FRAMES = 40
"""Number of first frames from which a person's shape is fitted."""


@dataclass(frozen=True, eq=False)
class PersonCapture:
    """A captured recording."""

    q: Array  # (frames, nq) the plant's positions [rad, m]; nan where no person was found.
    inlier_ratios: Array  # (frames,) inlier ratio of the contours; 0 where no person was seen.
    shape: PersonShape | None  # The person's; None where the model has no shape joints.
    # Simplified surfaces of the tree's nodes with the person's radius scales.
    outlines: tuple[Outline, ...]
    tree: PoseTree
    # (frames, nq) standard deviations of q [rad, m] by pictures and limits, or nan.
    deviations: Array
    # (q, deviations) of distinct alternative poses that fit as well, by frame. Only frames in which
    # the person was searched have any.
    alternatives: dict[int, tuple[tuple[Array, Array], ...]] = field(default_factory=dict)

    @staticmethod
    def empty(count: int, shape: PersonShape | None, fit: ContourFit) -> "PersonCapture":
        """Return a capture of `count` frames without poses: nan, or 0 for the inlier ratio."""
        q = np.full((count, len(fit.tree.model.position_names)), np.nan)
        return PersonCapture(q, np.zeros(count), shape, fit.outlines, fit.tree, q.copy())

    def store(
        self, frame: int, tracker: PersonPoseTracker, state: PersonBelief, seen: FrameViews
    ) -> None:
        """Store pose and deviations of a tracker's state, fitted to views `seen`, in a row."""
        lengths = None if self.shape is None else self.shape.covariance
        self.q[frame] = tracker.positions(state.values)
        self.inlier_ratios[frame] = state.inlier_ratio
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
    """Capture a recording.

    Args:
        tree: of a model with a person's landmarks, best with shape joints, as
            urdf/person/person_shape.urdf has.
        cameras: by name.
        read: returns the masks of a frame.
        frames: indices, in order, of the frames in which the person is seen. After a gap the
            person is also searched anew.
        count: number of frames of the whole recording, rows of the result; None: that of `frames`.
        is_sequence: whether frames follow each other; if not, each is searched by itself.
        on_frame: called after each frame with its index.

    Raises ModelError: the model has no landmarks of trunk, arms and legs; SettingsError: there are
    no frames, or two cameras see a person in none of those tried.
    """
    if not len(frames):
        raise SettingsError("a recording needs one frame or more")
    capture = _Capture(tree, cameras, read, is_sequence)
    shape, states = capture.measure_shape(frames)
    tracker = capture.tracker
    captured = PersonCapture.empty(count or len(frames), shape, tracker.fit)

    def finish(frame: int, state: PersonBelief | None, seen: FrameViews) -> None:
        if state is not None:
            captured.store(frame, tracker, state, seen)
        if on_frame is not None:
            on_frame(frame)

    capture.follow_all(frames, states, finish)
    captured.alternatives.update(capture.alternatives)
    return captured


class _Capture:
    """A recording with the tracker that follows the person in it; arguments as `capture_person`.

    Attributes:
        tracker: has the person's shape as far as known; the methods replace it.
        alternatives: as in `PersonCapture`, of the frames searched so far.
    """

    def __init__(
        self, tree: PoseTree, cameras: Mapping[str, Camera], read: ReadFrame, is_sequence: bool
    ) -> None:
        self._cameras, self._read, self._is_sequence = cameras, read, is_sequence
        self.tracker = tracker_of_person(tree, None)
        self._bare = self.tracker.fit
        # Whether the model has shape joints to be fitted.
        self._has_shape = bool(shape_values(tree).any())
        self.alternatives: dict[int, tuple[tuple[Array, Array], ...]] = {}
        # Frames used for the shape are needed three times. By frame and camera: the region, packed
        # to bits along the rows, and its edge.
        self._kept: dict[int, dict[str, tuple[NDArray[np.uint8], EdgePoints]]] = {}

    def _see(self, frame: int) -> FrameViews:
        """Return the views of a frame, from memory if they were kept."""
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

    def measure_shape(
        self, frames: Sequence[int]
    ) -> tuple[PersonShape | None, dict[int, PersonBelief]]:
        """Fit the shape to ten of the first frames, and give it to the tracker.

        Returns the shape, and the tracker states in the fitted frames by frame; None and {} where
        the model has no shape joints.
        """
        if not self._has_shape:
            return None, {}
        frames = frames[:SHAPE_FRAMES]
        for frame in frames:
            self._kept[frame] = {
                camera.name: (np.packbits(view.region, axis=1), view.edge)
                for camera, view in self._see(frame).pairs
            }
        chosen = spread_over(frames, 10)
        if self._is_sequence:
            rough = self.follow_all(frames, {})
            poses = {k: one.values for k in chosen if (one := rough[k])}
        else:
            explained = {k: self.find_explanations(k) for k in chosen}
            poses = {k: own[0][0].values for k, own in explained.items() if own}
        shape, self.tracker = self._fit_shape(list(poses), list(poses.values()))
        states = zip(poses, shape.poses, strict=True)
        return shape, {k: self.tracker.start(pose, is_known=True) for k, pose in states}

    def _fit_shape(
        self, frames: Sequence[int], poses: Sequence[Array]
    ) -> tuple[PersonShape, PersonPoseTracker]:
        """Fit the shape to frames (indices) from initial poses (m,); return it, and its tracker."""
        fit, observed = self._bare, [self._see(k) for k in frames]
        views = [(one.cameras, [view.edge for view in one.views]) for one in observed]
        shape = fit_shape(fit, views, np.array(poses))
        return shape, tracker_of_person(fit.kinematics, shape, self.tracker.plan)

    def find_explanations(self, frame: int) -> list[tuple[PoseFit, PersonPoseTracker]]:
        """Return distinct poses that explain a frame, with trackers of their shapes, best first.

        The list is empty if no person is visible. Explanations that are not worse than the best one
        by more than noise are stored in `alternatives`.
        """
        seen = self._see(frame)

        def shaped(values: Array) -> tuple[PoseFit, PersonPoseTracker]:
            shape, tracker = self._fit_shape([frame], [values])
            refined = tracker.search.refine(shape.poses[0], seen)
            return tracker.search.improve_limbs(refined, seen), tracker

        found = self.tracker.find_explanations(seen, None, shaped if self._has_shape else None)
        if found:
            best, tracker = found[0]
            self.alternatives[frame] = tuple(
                (own.positions(fit.values), own.deviations(fit.values, seen))
                for fit, own in found[1:]
                if tracker.search.advantage(best, fit, seen, own=own.search) <= SIGNIFICANT
            )
        return found

    def follow_all(
        self,
        frames: Sequence[int],
        known: Mapping[int, PersonBelief],
        finish: Callable[[int, PersonBelief | None, FrameViews], None] | None = None,
    ) -> dict[int, PersonBelief | None]:
        """Track the person; return the state of each frame, None where no person is found.

        A sequence is tracked from its first known frame, or the best-fitting one of a few, forwards
        to the end, then from there backwards. Otherwise each frame is refined from its known state,
        or searched by itself.

        ``frames``: indices in order. ``known``: beliefs by frame that are known before; {}: none.
        ``finish``: called with index, belief and views of each frame that is done, if not None.
        """
        found: dict[int, PersonBelief | None] = {}

        def follow(state: PersonBelief | None, frame: int, last: int) -> PersonBelief | None:
            """Find and keep the state of a frame, from the state of the frame `last` before it."""
            seen = self._see(frame)
            if state is None:
                found[frame] = self._search_frame(frame, known.get(frame))
            else:
                found[frame] = self.tracker.update(
                    self.tracker.predict(state, abs(frame - last)), seen
                )
            if finish is not None:
                finish(frame, found[frame], seen)
            return found[frame]

        if not self._is_sequence:
            for frame in frames:
                follow(None, frame, frame)
            return found
        begin, start = (min(known), known[min(known)]) if known else self._best_start(frames)
        index = list(frames).index(begin)
        # Forwards from the start, then backwards.
        for ordered in (frames[index:], frames[:index][::-1]):
            state: PersonBelief | None = start
            last = begin
            for frame in ordered:
                state, last = follow(state, frame, last), frame
        return found

    def _search_frame(self, frame: int, known: PersonBelief | None) -> PersonBelief | None:
        """Return a still's belief, refined from `known` or searched; None: no person."""
        if known is None:
            explained = self.find_explanations(frame)
            if not explained:
                return None
            fit, own = explained[0]
            if own is self.tracker:
                return replace(self.tracker.start(fit.values), inlier_ratio=fit.inlier_ratio)
            known = self.tracker.start(self.tracker.with_held(fit.values))
        seen, search = self._see(frame), self.tracker.search
        fit = search.improve_limbs(search.refine(known.values, seen), seen)
        return replace(self.tracker.start(fit.values), inlier_ratio=fit.inlier_ratio)

    def _best_start(self, frames: Sequence[int]) -> tuple[int, PersonBelief]:
        """Return the index and the belief of the first of three frames without alternatives.

        If all have some, it is the frame that is explained best. The tracker gets the shape that
        fits it. Raises SettingsError: two cameras see a person in none of the frames tried.
        """
        found = {}
        for frame in spread_over(frames, 3):
            if explained := self.find_explanations(frame):
                found[frame] = explained[0]
                if not self.alternatives[frame]:
                    break
        if not found:
            raise SettingsError(
                "two cameras see no person in any of the frames tried: give masks that show one"
            )
        clear = [k for k in found if not self.alternatives[k]]
        best = clear[0] if clear else max(found, key=lambda k: found[k][0].closeness)
        fit, self.tracker = found[best]
        return best, self.tracker.start(fit.values, is_known=True)


def spread_over(frames: Sequence[int], count: int) -> list[int]:
    """Return `count` of the frames, evenly spread; all if there are fewer."""
    picked = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return [frames[int(k)] for k in picked]


@dataclass(frozen=True, eq=False)
class CheckedCapture:
    """A captured recording and its faults."""

    captured: PersonCapture  # All frames; nan where fewer than two cameras see the person.
    views: ViewFaults  # What else was in view, or was not.
    # Cameras that disagree with the others, evaluated once more at the end.
    cameras: tuple[CameraFault, ...]
    # The fault of the rig as a whole, if no single camera explains it; undone if identified.
    rig: RigFault | None
    read: ReadFrame  # Returns the masks that were used.


def capture_checked(
    tree: PoseTree,
    cameras: Mapping[str, Camera],
    read: ReadFrame,
    count: int,
    is_sequence: bool,
    on_frame: Callable[[int], None] | None,
) -> CheckedCapture:
    """Capture a recording as `capture_person` does, and find its faults.

    A camera at fault is left out from its first faulty frame on, unless another may be at fault
    instead or fewer than three others remain, and the recording is captured again. Faults of the
    rig, which the visual hulls of three frames show, are undone if they are identified.

    Args:
        tree, cameras, read, is_sequence: as of `capture_person`.
        count: number of frames, all of which are read.
        on_frame: called after each frame with the person, in the first capture only.

    Raises:
        CameraError: the person is smaller or taller than people are.
        MaskError: the masks show the background.
        ModelError: the model has no landmarks of trunk, arms and legs.
        SettingsError: two cameras see a person in no frame.
    """
    recording = require_person(PersonRecording(cameras, read, count, is_sequence), count)
    rig = find_rig_fault(cameras, [recording.read(k) for k in spread_over(recording.seen, 3)])
    if rig is not None and rig.is_identified:
        undo = rig.undo
        undone = PersonRecording(cameras, lambda k: undo(read(k)), count, is_sequence)
        recording = require_person(undone, count)
    found: list[CameraFault] = []
    while True:
        # Only the first capture reports frames, because callers count them.
        report = None if found else on_frame
        captured = capture_person(
            tree, cameras, recording.read, recording.seen, count, is_sequence, report
        )
        comparison = _CaptureComparison(tree, cameras, recording, captured)
        found = [comparison.reevaluate(one) for one in found]
        fault = comparison.find()
        if fault is None:
            break
        others = len(recording.cameras_at(fault.first)) - 1
        fault = replace(fault, is_left_out=others >= 3 and not fault.alternatives)
        found.append(fault)
        if not fault.is_left_out:
            break
        recording.leave_out(fault.name, fault.first)
    if found and rig is not None and not rig.is_identified:
        rig = None
    return CheckedCapture(captured, recording.faults(), tuple(found), rig, recording.read)


class _CaptureComparison(CameraComparison):
    """Compares the cameras of a captured recording with each other.

    ``tree``, ``cameras``: as of `capture_person`. ``recording``: the masks. ``captured``: poses of
    the recording; frames without a pose are not compared.
    """

    def __init__(
        self,
        tree: PoseTree,
        cameras: Mapping[str, Camera],
        recording: PersonRecording,
        captured: PersonCapture,
    ) -> None:
        held, noise = shape_values(tree), None if captured.shape is None else NOISE
        super().__init__(ContourFit(tree, captured.outlines, noise), cameras, held)
        self._recording = recording
        found = np.flatnonzero(np.isfinite(captured.q).all(axis=1)).tolist()
        flatten = self._fit.kinematics.flatten
        self._values = {k: flatten(tree.values_from_positions(captured.q[k])) for k in found}

    def find(self) -> CameraFault | None:
        """Return the camera that disagrees most with the others, and since when; None: none does.

        Cameras are compared in ten frames: in all of them, and in the last third.
        """
        picked = spread_over(list(self._values), 10)
        views = []
        for frame in picked:
            masks = self._recording.read(frame).items()
            edges = {name: self._edge(name, mask) for name, mask in masks}
            views.append(FrameEdges(edges, self._values[frame]))
        fault = self.find_fault(views)
        if fault is None or not fault.is_explained:
            # A camera that moved in the middle of the recording disagrees in the last part only.
            fault = self.find_fault(views[-(len(views) + 2) // 3 :]) or fault
        if fault is None:
            return None
        own = [k for k, view in enumerate(views) if fault.name in view.edges]
        poses = [self.pose_without(views[k], fault.name)[0] for k in own]
        since = self._first_frame(fault, [views[k].edges[fault.name] for k in own], poses)
        # It may have moved at any time between two compared frames.
        first = 0 if since == 0 else picked[own[min(since, len(own)) - 1]] + 1
        return replace(fault, first=first)

    def reevaluate(self, fault: CameraFault) -> CameraFault:
        """Return a left-out camera's fault with motion and first frame estimated again.

        The recording must have been captured without the camera since then.
        """
        seen = {k: self._recording.read(k, with_all=True).get(fault.name) for k in self._values}
        frames = [k for k, mask in seen.items() if mask is not None]
        edges = [self._edge(fault.name, mask) for mask in seen.values() if mask is not None]
        poses = [self._values[frame] for frame in frames]
        # The first estimate may be some frames too early, which blurs the motion.
        for _ in range(2):
            late = [k for k, frame in enumerate(frames) if frame >= fault.first]
            if not late:
                break
            motion = self.motion(fault.name, [edges[k] for k in late], [poses[k] for k in late])
            explained = is_explained(motion, fault.others_inlier_ratio)
            fault = replace(fault, motion=motion, is_explained=explained)
            since = min(self._first_frame(fault, edges, poses), len(frames) - 1)
            fault = replace(fault, first=frames[since])
        return fault

    def _first_frame(
        self, fault: CameraFault, edges: Sequence[EdgePoints], poses: Sequence[Array]
    ) -> int:
        """Return the index of the first picture in which a camera is at fault; their number: none.

        Its inlier ratio after the motion counts as at least 0.7 of the others' ratio. ``edges``,
        ``poses``: edge points in its picture, and pose (m,), by frame.
        """
        camera = self._cameras[fault.name]
        before, after = (
            [self.inlier_ratio(one, e, values) for e, values in zip(edges, poses, strict=True)]
            for one in (camera, camera.with_pose(fault.motion.X_WC))
        )
        least = 0.7 * fault.others_inlier_ratio
        return first_moved_frame(before, [max(one, least) for one in after])

    def _edge(self, name: str, mask: Mask) -> EdgePoints:
        """Return the edge points of a camera's mask."""
        return find_edge_points(mask, edge_spacing(self._cameras[name]))
