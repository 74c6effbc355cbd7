"""One person before several cameras: followed by silhouettes or colours, compared, warned of."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.body import landmark_positions, load_landmarks
from drake_pose.errors import MaskError, SceneError
from drake_pose.files.records import FrameRecord, record_modes
from drake_pose.files.writer import Drawn, OnStage, ResultWriter
from drake_pose.jobs.estimate.inputs import EstimateInputs, draw_parts
from drake_pose.person.camera_faults import CameraFault
from drake_pose.person.capture import (
    CheckedCapture,
    PersonCapture,
    capture_by_colour,
    capture_checked,
)
from drake_pose.person.figures import ReadFrame, ViewFaults
from drake_pose.person.rig_faults import RigFault
from drake_pose.search import PoseEstimate
from drake_pose.silhouette.pictures.masks import count_edge_pixels
from drake_pose.silhouette.pictures.scene_checks import (
    describe_unreadable,
    frame_ranges,
    require_readable,
)

FOLLOWED = "followed"
"""FrameRecord.stopped_by of a frame in which a person was followed."""


def follow_person(
    inputs: EstimateInputs, result: ResultWriter, overlay: bool, on_stage: OnStage | None
) -> tuple[EstimateInputs, Iterator[tuple[FrameRecord, Drawn]]]:
    """Follows the person through all frames, which are compared with their masks and drawn then.

    A resumed recording is followed as a whole again, if frames are missing.

    Returns:
        What is estimated then, and its frames; once they are written, warnings stand in the result.

    Raises:
        ModelError: the model has no landmarks of a person.
        SceneError: none of the masks can be read, or fewer than two are there of the first picture.
        SettingsError: in no frame two cameras see a person.
    """
    if result.records.keys() >= set(inputs.frames):
        return inputs, iter(())
    asked = {*inputs.frames, *result.records}
    inputs = replace(inputs, frames=tuple(one for one in inputs.scene.frames if one in asked))
    reader = _Reader(inputs, on_stage)
    begin = time.perf_counter()
    if inputs.scene.images:
        captured, read, faults, distances = _follow_colours(inputs, reader)
    else:
        checked = capture_checked(
            inputs.model.pose_tree(), inputs.scene.cameras, reader, len(inputs.frames),
            inputs.tracked, reader.count_followed,
        )  # fmt: skip
        captured, read = checked.captured, checked.read
        faults = describe_faults(checked, inputs.frames)
        distances = np.full(len(inputs.frames), np.nan)
    reader.on_stage = None
    seconds = (time.perf_counter() - begin) / len(inputs.frames)
    result.records.clear()
    result.begin()
    if captured.shape is not None:
        known = captured.shape.known
        result.more |= {"lengths_m": known.lengths, "radius_scales": known.radius_scales}

    def finished() -> Iterator[tuple[FrameRecord, Drawn]]:
        values = [captured.tree.values_from_positions(q) for q in captured.q]
        nodes = [np.array(own) for own in zip(*values, strict=True)]
        for index, X_WN in enumerate(captured.tree.node_poses_batch(nodes)):
            own = X_WN, read(index), reader, float(distances[index])
            yield _finish(inputs, captured, index, *own, seconds, overlay)
        unread = describe_unreadable(reader.refused, inputs.scene.frames)
        doubts = describe_alternatives(captured, inputs.frames)
        result.warnings += (*unread, *faults, *doubts)

    return inputs, finished()


def _follow_colours(
    inputs: EstimateInputs, reader: "_Reader"
) -> tuple[PersonCapture, ReadFrame, tuple[str, ...], Array]:
    """A sequence of pictures of which few have masks: distances (frames,) of contours [pixel]."""
    scene, frames = inputs.scene, inputs.frames
    masked = [k for k, frame in enumerate(frames) if len(scene.cameras_of(frame)) > 1]
    if frames[0] not in inputs.starts and 0 not in masked:
        raise SceneError(
            f"{scene.path}: a person is found by the masks of two cameras or more, but the first "
            f"frame, '{frames[0]}', has fewer: add them (drake-pose masks), or --start FILE.csv"
        )
    tree = inputs.model.pose_tree()
    masked = [k for k in masked if len(reader(k)) > 1]
    checked: CheckedCapture | None = None
    faults: tuple[str, ...] = ()
    if masked:
        checked = capture_checked(tree, scene.cameras, lambda k: reader(masked[k]), len(masked))
        faults = describe_faults(checked, [frames[k] for k in masked])
    captured, distances = capture_by_colour(
        tree, scene.cameras, len(frames), lambda index: inputs.pictures(frames[index]),
        {frames.index(frame): q for frame, q in inputs.starts.items()},
        {} if checked is None else {k: checked.read(place) for place, k in enumerate(masked)},
        None if checked is None else checked.captured, reader.count_followed,
    )  # fmt: skip
    lost = [frame for frame, q in zip(frames, captured.q, strict=True) if np.isnan(q).any()]
    if lost:
        text = (
            f"frame {frame_ranges(lost, frames)}: the person is lost, too little of the contour "
            "fits the colours; masks of two cameras in such a frame, or its row in --start "
            "FILE.csv, say where the person is"
        )
        faults += (text,)
    return captured, reader, faults, distances


class _Reader:
    """Reads the masks of a frame by camera; one that cannot be read is left out, and said once."""

    def __init__(self, inputs: EstimateInputs, on_stage: OnStage | None) -> None:
        self._scene, self._frames = inputs.scene, inputs.frames
        self.on_stage = on_stage
        self.refused: dict[tuple[str, str], str] = {}
        self._read_count = self._followed = 0

    def __call__(self, index: int) -> dict[str, Mask]:
        """The masks of a frame, counted from 0, by camera."""
        frame, masks = self._frames[index], {}
        for camera in self._scene.cameras_of(frame):
            if (camera, frame) not in self.refused:
                try:
                    masks[camera] = self._scene.read(camera, frame, may_be_empty=True)
                except MaskError as error:
                    self.refused[camera, frame] = str(error)
        require_readable(self.refused, self._scene)
        self._read_count += 1
        # All masks are read once before anything else is done.
        count, again = len(self._frames), self._read_count - len(self._frames)
        if again <= 0:
            self._tell("reading", self._read_count, count)
        elif not self._followed:
            self._tell("finding and measuring the person", again, None)
        elif self._followed >= count:
            self._tell("comparing the cameras", again, None)
        return masks

    def count_followed(self, _: int) -> None:
        """Called after each frame in which the person was followed."""
        self._followed += 1
        self._tell("following", self._followed, len(self._frames))

    def _tell(self, what: str, done: int, of: int | None) -> None:
        if self.on_stage is not None:
            self.on_stage(what, done, of)


def _finish(
    inputs: EstimateInputs,
    captured: PersonCapture,
    index: int,
    X_WN: Array,
    masks: Mapping[str, Mask],
    reader: ReadFrame,
    distance: float,
    seconds: float,
    overlay: bool,
) -> tuple[FrameRecord, Drawn]:
    """A frame with the captured person, of the radius scale that was found, the nodes at X_WN.

    Args:
        X_WN: (nodes, 4, 4).
        distance: see above.
    """
    scene, frame, q = inputs.scene, inputs.frames[index], captured.q[index]
    shown: dict[str, NDArray[np.generic]] = inputs.pictures(frame) if overlay else {}
    # A camera that was left out is shown, too, so that one sees why.
    if overlay and len(masks) < len(scene.cameras_of(frame)):
        shown |= reader(index)
    if overlay:
        shown |= masks
    found, by_colour = bool(np.isfinite(q).all()), not masks and np.isfinite(distance)
    names = {} if not found else scene.cameras if by_colour else {**masks, **shown}
    parts = draw_parts(captured.outlines, X_WN, [scene.cameras[name] for name in names])
    wrong, area = np.nan, 1.0
    if found and by_colour:
        # Without masks, E_total is the strip between both contours over the body's area.
        bodies = [own >= 0 for own in parts.values()]
        area = float(sum(map(np.count_nonzero, bodies))) or 1.0
        wrong = sum(map(count_edge_pixels, bodies)) * distance
    pose = PoseEstimate(found, q, np.eye(4), (), wrong, area, stopped_by=FOLLOWED, seconds=seconds)
    answers = ((q, captured.deviations[index]), *captured.alternatives.get(index, ()))
    known = record_modes(inputs.model, answers if found else answers[:1])
    return inputs.finish(
        frame, pose, masks, parts, shown, share=float(captured.inlier_ratios[index]), **known
    )


def describe_faults(checked: CheckedCapture, frames: Sequence[str]) -> tuple[str, ...]:
    """All that was wrong with a recording whose frames have these names."""
    return (
        *describe_views(checked.views, frames),
        *describe_fit(checked.captured.inlier_ratios.tolist()),
        *describe_rig(checked.rig),
        *(describe_camera(one, frames) for one in checked.cameras),
    )


def describe_views(views: ViewFaults, frames: Sequence[str]) -> tuple[str, ...]:
    """Warnings of who was in view or was not; one of others, who walk through all views at once."""

    def listed(*several: Sequence[int]) -> str:
        return frame_ranges({frames[k] for own in several for k in own}, frames)

    found = []
    if views.nobody:
        found.append(
            f"frame {listed(views.nobody)}: fewer than two cameras see the person; no pose"
        )
    found += [
        f"camera '{camera}' sees nobody in frame {listed(indices)}, where others see the person: "
        "left out there"
        for camera, indices in views.blind.items()
    ]
    if views.others:
        text = (
            f"frame {listed(*views.others.values())}: somebody else is in view of "
            f"{_cameras(list(views.others))}; the one who is seen longest and largest is followed"
        )
        if views.merged:
            text += (
                f"; in {_cameras(list(views.merged))} both are one silhouette (frame "
                f"{listed(*views.merged.values())})"
            )
        found.append(text)
    return tuple(found)


def describe_fit(shares: Sequence[float], usual_from: float = 0.6) -> tuple[str, ...]:
    """A warning of a person of whose contours too little fits in the frames with a pose.

    ``usual_from``: the least fraction of the contours that fits where the person is in the masks.
    """
    usual = float(np.median([share for share in shares if share > 0.0] or [1.0]))
    if usual > usual_from:
        return ()
    text = (
        f"only {100.0 * usual:.0f} % of the contours fit in the median frame, where 90 % are "
        "usual: do the masks show one person, and are cameras.yaml and the folders' names right?"
    )
    return (text,)


def describe_alternatives(captured: PersonCapture, frames: Sequence[str]) -> tuple[str, ...]:
    """Warnings of frames that another pose explains as well, and where it differs."""
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
                f"frame {frames[k]}: another pose explains the silhouettes as well (mode "
                f"{number} in modes.csv): {', '.join(far)} up to {1e3 * off.max():.0f} mm "
                "elsewhere; look at the overlays, or add a camera"
            )
    return tuple(found)


def describe_rig(rig: RigFault | None) -> tuple[str, ...]:
    """Warnings of a calibration that the silhouettes contradict as a whole."""
    if rig is None:
        return ()
    worst = min(rig.filled, key=lambda name: rig.filled[name])
    what = ": are cameras.yaml, the folders' names or the masks wrong?"
    if rig.exchanged:
        what = (
            f" until the masks of {_cameras(rig.exchanged)} are exchanged: done for this result; "
            "correct the folders' names, or those in cameras.yaml"
        )
    elif rig.mirrored:
        what = (
            f" until the masks of {_cameras(rig.mirrored)} are mirrored, left for right: done for "
            "this result, as cameras.yaml is taken for right; if the cameras were calibrated from "
            "mirrored pictures, left and right are exchanged in it: calibrate again"
        )
    filled = f"{100.0 * rig.filled[worst]:.0f} % of camera '{worst}'"
    return (f"no body fills all silhouettes ({filled}){what}",)


def describe_camera(fault: CameraFault, frames: Sequence[str]) -> str:
    """What is said of a camera that contradicts the others."""
    motion = fault.motion
    since = "" if fault.first == 0 else f" since frame {frames[fault.first]}"
    action = f"left out{since}" if fault.is_left_out else "used all the same"
    whose = _cameras([fault.name, *fault.alternatives], "or")
    if not fault.is_explained:
        return (
            f"{whose} contradicts the others{since}: {100.0 * motion.inlier_ratio_before:.0f} % of "
            "its contours fit what they see, "
            f"{100.0 * fault.others_inlier_ratio:.0f} % of theirs do; "
            f"{action}. Are its masks poor, mirrored or another camera's, or has it moved far?"
        )
    right, down = motion.shift
    return (
        f"{whose} has moved{since} after it was calibrated: what the others see lies "
        f"{motion.pixels:.1f} pixels off in its pictures ({abs(right):.1f} to the "
        f"{'right' if right > 0 else 'left'}, {abs(down):.1f} {'down' if down > 0 else 'up'}, "
        f"turned by {np.degrees(motion.turn):.1f} degrees), {100.0 * motion.metres:.0f} cm at "
        f"the person; {action}: calibrate it again"
    )


def _cameras(names: Sequence[str], word: str = "and") -> str:
    """Cameras as text."""
    *most, last = [f"'{name}'" for name in names]
    if not most:
        return f"camera {last}"
    return f"{'camera' if word == 'or' else 'cameras'} {', '.join(most)} {word} {last}"
