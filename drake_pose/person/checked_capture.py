"""A recording captured in spite of its faults: others in view, nobody in view, a moved camera.

Others are cut out of the masks first. After the capture a camera that contradicts the rest is
left out, and all is captured once more.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, MaskError, SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.fit.evidence import EdgePoints, find_edge_points
from drake_pose.person.camera_faults import (
    CameraFault,
    CameraJudge,
    FrameView,
    is_explained,
    moved_since,
)
from drake_pose.person.figures import RigFault, find_rig_fault
from drake_pose.person.person_capture import PersonCapture, capture_person, spread_over
from drake_pose.person.persons_in_view import PersonRecording, ReadFrame, ViewFaults
from drake_pose.person.shape import NOISE, shape_values
from drake_pose.person.views import edge_spacing

# Cameras are compared in this many frames, and carved out of their silhouettes in so many.
_COMPARED, _CARVED = 10, 3
# Pictures of which less fits than this share of the others' do not agree.
_AGREES = 0.7
# Nobody is seen as small or as tall [m], not even in part; else lengths are in another unit.
_SMALLEST, _TALLEST = 0.1, 3.0
# In more of the masks nobody fills the whole picture; it is the background that does.
_INVERTED = 0.5
# A person is followed by this many cameras or more after one was left out.
_LEAST_LEFT = 3


@dataclass(frozen=True, eq=False)
class CheckedCapture:
    """A captured recording.

    Args:
        captured: the capture of all frames; nan where fewer than two cameras see the person.
        cameras: those that contradict the others, measured at the end once more.
        rig: what the silhouettes say against the calibration as a whole, if no single camera
            explains it; undone where it can be.
        read: gives the masks that were used.
    """

    captured: PersonCapture
    views: ViewFaults
    cameras: tuple[CameraFault, ...]
    rig: RigFault | None
    read: ReadFrame


def capture_checked(
    tree: PoseTree,
    cameras: Mapping[str, Camera],
    read: ReadFrame,
    count: int,
    is_sequence: bool = True,
    on_frame: Callable[[int], None] | None = None,
) -> CheckedCapture:
    """Captures a recording like `capture_person`, whose arguments it has, and finds its faults.

    Raises:
        CameraError: the person is as tall as nobody is.
        MaskError: the masks show the background.
        ModelError: the model has no landmarks of trunk, arms and legs.
        SettingsError: there is no frame in which two cameras see a person.
    """
    recording = _record(cameras, read, count, is_sequence)
    carved = [recording.read(k) for k in spread_over(recording.seen, _CARVED)]
    rig = find_rig_fault(cameras, carved)
    if rig is not None and rig.is_undone:
        undo = rig.undo
        recording = _record(cameras, lambda k: undo(read(k)), count, is_sequence)
    found: list[CameraFault] = []
    while True:
        # All frames are finished once only, as those who count them are told of it.
        tell = None if found else on_frame
        captured = capture_person(
            tree, cameras, recording.read, recording.seen, count, is_sequence, tell
        )
        judge = _Judge(tree, cameras, recording, captured)
        found = [judge.dated(one) for one in found]
        fault = judge.find()
        if fault is None:
            break
        left = len(recording.cameras_at(fault.first)) - 1
        fault = replace(fault, is_left_out=left >= _LEAST_LEFT and not fault.rivals)
        found.append(fault)
        if not fault.is_left_out:
            break
        recording.leave_out(fault.name, fault.first)
    if found and rig is not None and not rig.is_undone:
        rig = None
    return CheckedCapture(captured, recording.faults(), tuple(found), rig, recording.read)


def _record(
    cameras: Mapping[str, Camera], read: ReadFrame, count: int, is_sequence: bool
) -> PersonRecording:
    """A recording in which somebody is seen who may be a person."""
    recording = PersonRecording(cameras, read, count, is_sequence)
    if not recording.seen:
        raise SettingsError(
            f"in none of {count} frames two cameras see a person: give masks that show one"
        )
    if recording.covering > _INVERTED:
        raise MaskError(
            f"in {100.0 * recording.covering:.0f} % of the masks the largest figure reaches all "
            "four sides of the picture: the person must be white before a black background"
        )
    if not _SMALLEST < recording.height < _TALLEST:
        raise CameraError(
            f"a person {recording.height:.3g} m tall by the cameras' calibration: X_WC must be in "
            "metres and the camera's pose in the world, not its inverse; focal lengths in pixels"
        )
    return recording


class _Judge(CameraJudge):
    """Compares the cameras with each other by what was captured."""

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
        """The camera that contradicts the others in all frames or in the last, and since when."""
        picked = spread_over(list(self._values), _COMPARED)
        views = []
        for frame in picked:
            masks = self._recording.read(frame).items()
            edges = {name: self._edge(name, mask) for name, mask in masks}
            views.append(FrameView(edges, self._values[frame]))
        fault = self.find_fault(views)
        if fault is None or not fault.is_explained:
            # A camera that moved in the middle is another one before and after that.
            fault = self.find_fault(views[-(len(views) + 2) // 3 :]) or fault
        if fault is None:
            return None
        own = [k for k, view in enumerate(views) if fault.name in view.edges]
        poses = [self.pose_without(views[k], fault.name)[0] for k in own]
        since = self._since(fault, [views[k].edges[fault.name] for k in own], poses)
        # Between two compared frames it may have moved at any time.
        first = 0 if since == 0 else picked[own[min(since, len(own)) - 1]] + 1
        return replace(fault, first=first)

    def dated(self, fault: CameraFault) -> CameraFault:
        """A camera that was left out, measured once more by what the others captured without it."""
        seen = {k: self._recording.read(k, with_all=True).get(fault.name) for k in self._values}
        frames = [k for k, mask in seen.items() if mask is not None]
        edges = [self._edge(fault.name, mask) for mask in seen.values() if mask is not None]
        poses = [self._values[frame] for frame in frames]
        # The first guess may be some frames too early, which blurs the motion.
        for _ in range(2):
            late = [k for k, frame in enumerate(frames) if frame >= fault.first]
            if not late:
                break
            motion = self.motion(fault.name, [edges[k] for k in late], [poses[k] for k in late])
            explained = is_explained(motion, fault.others_share)
            fault = replace(fault, motion=motion, is_explained=explained)
            since = min(self._since(fault, edges, poses), len(frames) - 1)
            fault = replace(fault, first=frames[since])
        return fault

    def _since(
        self, fault: CameraFault, edges: Sequence[EdgePoints], poses: Sequence[Array]
    ) -> int:
        """Since which of some pictures a camera is at fault."""
        camera = self._cameras[fault.name]
        before, after = (
            [self.share(one, e, values) for e, values in zip(edges, poses, strict=True)]
            for one in (camera, camera.with_pose(fault.motion.X_WC))
        )
        least = _AGREES * fault.others_share
        return moved_since(before, [max(one, least) for one in after])

    def _edge(self, name: str, mask: Mask) -> EdgePoints:
        return find_edge_points(mask, edge_spacing(self._cameras[name]))
