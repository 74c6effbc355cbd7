"""Estimates of one person with several cameras, and their warnings."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from drake_pose.arrays import Mask
from drake_pose.body import landmark_positions, load_landmarks
from drake_pose.errors import MaskError, weighted
from drake_pose.files.records import FrameRecord, record_modes
from drake_pose.files.writer import Drawn, OnStage, ResultWriter
from drake_pose.jobs.estimate.inputs import EstimateInputs, draw_parts
from drake_pose.person.capture import PersonCapture, capture_checked
from drake_pose.person.faults import CameraFault, RigFault
from drake_pose.person.figures import ViewFaults
from drake_pose.search import PoseEstimate
from drake_pose.silhouette.pictures.scene_checks import (
    describe_unreadable,
    frame_ranges,
    require_readable,
)

FOLLOWED = "followed"
"""FrameRecord.stopped_by of the frames of the method person."""


def follow_person(
    inputs: EstimateInputs, result: ResultWriter, overlay: bool, on_stage: OnStage
) -> tuple[EstimateInputs, Iterator[tuple[FrameRecord, Drawn]]]:
    """Estimate a person in all frames.

    A resumed recording with missing frames is estimated again as a whole.

    Args:
        inputs: the inputs.
        result: writer of the result; gets lengths, radius scales, and finally warnings.
        overlay: whether overlays are drawn.
        on_stage: called with the progress of each stage.

    Returns the inputs with all frames to be written, and an iterator of their records and overlays.
    If all frames are finished already: the given inputs, and an empty iterator.

    Raises:
        ModelError: the model has no landmarks of a person.
        SceneError: no mask can be read.
        SettingsError: in no frame two cameras see a person.
    """
    if result.records.keys() >= set(inputs.frames):
        return inputs, iter(())
    asked = {*inputs.frames, *result.records}
    inputs = replace(inputs, frames=tuple(one for one in inputs.scene.frames if one in asked))
    reader = _Reader(inputs, on_stage)
    begin = time.perf_counter()
    checked = capture_checked(
        inputs.model.pose_tree(), inputs.scene.cameras, reader, len(inputs.frames),
        inputs.tracked, reader.count_followed,
    )  # fmt: skip
    captured = checked.captured
    reader.on_stage = lambda *_: None
    seconds = (time.perf_counter() - begin) / len(inputs.frames)
    result.records.clear()
    result.begin()
    if captured.shape is not None:
        shape = captured.shape
        result.more |= {"lengths_m": shape.lengths, "radius_scales": shape.radius_scales}

    def finished() -> Iterator[tuple[FrameRecord, Drawn]]:
        """Yield record and overlays of each frame, then add the warnings to the result."""
        values = [captured.tree.values_from_positions(q) for q in captured.q]
        nodes = [np.array(own) for own in zip(*values, strict=True)]
        for index, X_WN in enumerate(captured.tree.node_poses_batch(nodes)):
            frame, q, masks = inputs.frames[index], captured.q[index], checked.read(index)
            shown = masks if overlay else {}
            # Overlays show cameras that were left out as well.
            if overlay and len(masks) < len(inputs.scene.cameras_of(frame)):
                shown = {**reader(index), **masks}
            found = bool(np.isfinite(q).all())
            seen = [inputs.scene.cameras[name] for name in ({**masks, **shown} if found else {})]
            parts = draw_parts(captured.outlines, X_WN, seen, by_part=overlay)
            pose = PoseEstimate(
                found, q, np.eye(4), (), np.nan, 1.0, stopped_by=FOLLOWED, seconds=seconds
            )
            answers = ((q, captured.deviations[index]), *captured.alternatives.get(index, ()))
            known = record_modes(inputs.model, answers if found else answers[:1])
            ratio = float(captured.inlier_ratios[index])
            yield inputs.record_frame(frame, pose, masks, parts, shown, inlier_ratio=ratio, **known)
        frames = inputs.frames
        result.warnings += (
            *describe_unreadable(reader.refused, inputs.scene.frames),
            *describe_views(checked.views, frames),
            *describe_fit(captured.inlier_ratios.tolist()),
            *describe_rig(checked.rig),
            *(describe_camera(one, frames) for one in checked.cameras),
            *describe_alternatives(captured, frames),
        )

    return inputs, finished()


class _Reader:
    """Reads the masks of frames; masks that cannot be read are left out and recorded.

    Attributes:
        on_stage: called with the progress of each stage.
        refused: why a mask cannot be read, by camera and frame.
    """

    def __init__(self, inputs: EstimateInputs, on_stage: OnStage) -> None:
        self._scene, self._frames = inputs.scene, inputs.frames
        self.on_stage = on_stage
        self.refused: dict[tuple[str, str], str] = {}
        self._read_count = self._followed = 0

    def __call__(self, index: int) -> dict[str, Mask]:
        """Return the readable masks (H, W) of the frame of this index by camera."""
        frame, masks = self._frames[index], {}
        for camera in self._scene.cameras_of(frame):
            if (camera, frame) not in self.refused:
                try:
                    masks[camera] = self._scene.read(camera, frame, may_be_empty=True)
                except MaskError as error:
                    self.refused[camera, frame] = str(error)
        require_readable(self.refused, self._scene)
        self._read_count += 1
        # The first pass over all frames reads the masks; later calls belong to later stages.
        count, again = len(self._frames), self._read_count - len(self._frames)
        if again <= 0:
            self.on_stage("reading", self._read_count, count)
        elif not self._followed:
            self.on_stage("finding and measuring the person", again, None)
        elif self._followed >= count:
            self.on_stage("comparing the cameras", again, None)
        return masks

    def count_followed(self, _: int) -> None:
        """Count a frame in which the person was tracked; its index is not used."""
        self._followed += 1
        self.on_stage("tracking", self._followed, len(self._frames))


def describe_views(views: ViewFaults, frames: Sequence[str]) -> tuple[str, ...]:
    """Return warnings of frames, by name, without the person or with other people in view."""

    def listed(*several: Sequence[int]) -> str:
        """Return a text of the names of frames, given as sequences of indices."""
        return frame_ranges({frames[k] for own in several for k in own}, frames)

    found = []
    if views.no_person:
        found.append(
            f"frame {listed(views.no_person)}: fewer than two cameras see the person, so there is "
            "no pose; add a camera, or check the masks"
        )
    found += [
        f"camera '{camera}' sees no person in frame {listed(indices)}, where others see one, "
        "and is left out there; check its masks"
        for camera, indices in views.blind.items()
    ]
    if views.others:
        text = (
            f"frame {listed(*views.others.values())}: somebody else is in view of "
            f"{_cameras(list(views.others))}; the person in view longest and largest is tracked"
        )
        if views.merged:
            text += (
                f"; in {_cameras(list(views.merged))} both share a silhouette (frame "
                f"{listed(*views.merged.values())})"
            )
        found.append(text)
    return tuple(found)


def describe_fit(inlier_ratios: Sequence[float], usual_from: float = 0.6) -> tuple[str, ...]:
    """Return a warning if the contours fit badly in the frames with a pose.

    ``inlier_ratios``: (frames,) inlier ratio of the contours; 0 without a pose. ``usual_from``:
    minimum inlier ratio if the masks show the person.
    """
    usual = float(np.median([ratio for ratio in inlier_ratios if ratio > 0.0] or [1.0]))
    if usual > usual_from:
        return ()
    text = (
        f"only {100.0 * usual:.0f} % of the contours fit in the median frame, where 90 % are "
        "usual; check that the masks show one person, cameras.yaml, and the folders' names"
    )
    return (text,)


def describe_alternatives(captured: PersonCapture, frames: Sequence[str]) -> tuple[str, ...]:
    """Return warnings of frames, by name, that another pose fits equally well: its landmarks."""
    model, found = captured.tree.model, []
    marks = load_landmarks(model.path)
    for k, alternatives in sorted(captured.alternatives.items()):
        for number, (q, _) in enumerate(alternatives, start=2):
            if not np.isfinite(captured.q[k]).all():
                continue
            here, there = (landmark_positions(model, marks, one) for one in (captured.q[k], q))
            off = np.linalg.norm(np.subtract(here, there), axis=1)
            far = [name for name, one in zip(marks, off, strict=True) if one > 0.5 * off.max()]
            found.append(
                f"frame {frames[k]}: another pose fits the silhouettes equally well (mode {number} "
                f"in modes.csv), with {', '.join(far)} up to {1e3 * off.max():.0f} mm elsewhere; "
                "check the overlays, or add a camera"
            )
    return tuple(found)


def describe_rig(rig: RigFault | None) -> tuple[str, ...]:
    """Return a warning of a calibration with which no body fits all silhouettes; () for None."""
    if rig is None:
        return ()
    worst = min(rig.filled, key=lambda name: rig.filled[name])
    what = "; check cameras.yaml, the folders' names and the masks"
    if rig.exchanged:
        what = (
            f" unless the masks of {_cameras(rig.exchanged)} are exchanged, which was done for "
            "this result; correct the folders' names, or those in cameras.yaml"
        )
    elif rig.mirrored:
        what = (
            f" unless the masks of {_cameras(rig.mirrored)} are mirrored left to right, which was "
            "done for this result; mirror the masks, or, if the cameras were calibrated from "
            "mirrored pictures, calibrate again"
        )
    filled = f"{100.0 * rig.filled[worst]:.0f} % of camera '{worst}'"
    return (weighted(f"no body fills all silhouettes ({filled}){what}", "wrong"),)


def describe_camera(fault: CameraFault, frames: Sequence[str]) -> str:
    """Return the warning of a camera that moved or is inconsistent; ``frames`` are all names."""
    motion = fault.motion
    since = "" if fault.first == 0 else f" since frame {frames[fault.first]}"
    action = f"left out{since}" if fault.is_left_out else "still used"
    whose = _cameras([fault.name, *fault.alternatives], "or")
    if not fault.is_explained:
        return (
            f"{whose} is inconsistent with the others{since}: "
            f"{100.0 * motion.inlier_ratio_before:.0f} % of its contours fit the body, "
            f"{100.0 * fault.others_inlier_ratio:.0f} % of theirs; it is {action}. Check whether "
            "its masks are poor, mirrored or another camera's, and whether it has moved"
        )
    right, down = motion.shift
    return (
        f"{whose} has moved{since} after its calibration: the body that the others see is off by "
        f"{motion.pixels:.1f} pixels in its pictures ({abs(right):.1f} to the "
        f"{'right' if right > 0 else 'left'}, {abs(down):.1f} {'down' if down > 0 else 'up'}, "
        f"rotated by {np.degrees(motion.turn):.1f} degrees), {100.0 * motion.metres:.0f} cm at "
        f"the person; it is {action}; calibrate it again"
    )


def _cameras(names: Sequence[str], word: str = "and") -> str:
    """Return a text such as ``cameras 'a', 'b' and 'c'``, or ``camera 'a' or 'b'`` (``word``)."""
    *most, last = [f"'{name}'" for name in names]
    if not most:
        return f"camera {last}"
    return f"{'camera' if word == 'or' else 'cameras'} {', '.join(most)} {word} {last}"
