"""One person before several cameras: followed by all silhouettes at once, then compared."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError
from drake_pose.jobs.estimate.capture_warnings import describe_faults
from drake_pose.jobs.estimate.inputs import Inputs
from drake_pose.jobs.estimate.person_by_colour import (
    FollowedPerson,
    follow_by_colour,
    read_pictures,
)
from drake_pose.jobs.estimate.result import OnFrame, OnStage, ResultWriter
from drake_pose.jobs.estimate.scene_checks import (
    SceneWarning,
    describe_unreadable,
    require_readable,
    texts_of,
)
from drake_pose.person.recordings.checked_capture import capture_checked
from drake_pose.person.recordings.person_capture import PersonCapture
from drake_pose.results.folder import PoseRow
from drake_pose.results.joint_tables import record_deviations
from drake_pose.results.summary import FrameRecord
from drake_pose.silhouette.areas.scoring import draw_labels
from drake_pose.silhouette.pictures.mask_agreement import compare_masks

Mask = NDArray[np.bool_]

FOLLOWED = "followed"
"""FrameRecord.stopped_by of a frame in which a person was followed."""


def follow_person(
    result: ResultWriter,
    track: bool,
    overlay: bool,
    on_frame: OnFrame | None,
    on_stage: OnStage | None,
) -> None:
    """Follows the person through all frames, and writes them.

    A recording is followed as a whole: when it is resumed, frames that were finished before are
    followed once more with those that are missing.

    Args:
        result: what is estimated, and where the frames go to.
        track: whether the frames of a sequence follow each other.
        overlay: whether overlays are written.
        on_frame: hears of every frame that is compared and written.
        on_stage: hears of what is done before that.

    Raises:
        ModelError: the model has no landmarks of a person.
        SceneError: none of the masks can be read, or fewer than two are there of the first picture.
        SettingsError: in no frame two cameras see a person.
    """
    inputs = result.inputs_of_all()
    reader = _Reader(inputs, on_stage)
    count = len(inputs.frames)
    begin = time.perf_counter()
    if inputs.scene.images:
        followed = follow_by_colour(inputs, reader, reader.count_followed)
    else:
        followed = _follow_masks(inputs, reader, track)
    reader.on_stage = None
    seconds = (time.perf_counter() - begin) / count
    result.begin_again(inputs)
    shape = followed.captured.shape
    if shape is not None:
        result.more |= {"lengths_m": shape.known.lengths, "girths": shape.known.girths}
    if on_frame is not None:
        on_frame(0, count, "", None)
    for index, frame in enumerate(inputs.frames):
        _finish_frame(inputs, result, followed, reader, index, seconds, overlay)
        if on_frame is not None:
            on_frame(index + 1, count, frame, result.records[frame])
    result.warn(texts_of(*reader.warnings(), *followed.faults))


def _follow_masks(inputs: Inputs, reader: _Reader, track: bool) -> FollowedPerson:
    """The person in frames of masks."""
    checked = capture_checked(
        inputs.model.pose_tree(),
        reader.cameras,
        reader,
        len(inputs.frames),
        inputs.scene.sequence and track,
        reader.count_followed,
    )
    return FollowedPerson(checked.captured, checked.read, describe_faults(checked, inputs.frames))


class _Reader:
    """Reads the masks of a frame by camera; one that cannot be read is left out, and said once."""

    def __init__(self, inputs: Inputs, on_stage: OnStage | None) -> None:
        self.cameras: Mapping[str, Camera] = {camera.name: camera for camera in inputs.cameras}
        self._inputs = inputs
        self.on_stage = on_stage
        self._read_count = 0
        self._followed = 0
        self._refused: dict[tuple[str, str], str] = {}

    def __call__(self, index: int) -> dict[str, Mask]:
        """The masks of a frame, counted from 0, by camera."""
        scene, frame = self._inputs.scene, self._inputs.frames[index]
        masks = {}
        for camera in scene.cameras_of(frame):
            if camera not in self.cameras or (camera, frame) in self._refused:
                continue
            try:
                masks[camera] = scene.read(camera, frame, may_be_empty=True)
            except MaskError as error:
                self._refused[camera, frame] = str(error)
        require_readable(self._refused, scene)
        self._read_count += 1
        self._tell_stage()
        return masks

    def _tell_stage(self) -> None:
        """Says what a mask is read for: all are read once before anything else is done."""
        count = len(self._inputs.frames)
        if self.on_stage is None:
            return
        if self._read_count <= count:
            self.on_stage("reading", self._read_count, count)
        elif not self._followed:
            self.on_stage("finding and measuring the person", self._read_count - count, None)
        elif self._followed >= count:
            self.on_stage("comparing the cameras", self._read_count - count, None)

    def count_followed(self, _: int) -> None:
        """Hears of every frame in which the person was followed."""
        self._followed += 1
        if self.on_stage is not None:
            self.on_stage("following", self._followed, len(self._inputs.frames))

    def warnings(self) -> tuple[SceneWarning, ...]:
        """Which masks were left out, and why."""
        return describe_unreadable(self._refused, self._inputs.scene)


def _finish_frame(
    inputs: Inputs,
    result: ResultWriter,
    followed: FollowedPerson,
    reader: _Reader,
    index: int,
    seconds: float,
    overlay: bool,
) -> None:
    """Compares a frame's masks with the captured person, of the girth that was found."""
    frame, captured = inputs.frames[index], followed.captured
    masks, q = followed.read(index), captured.q[index]
    shown: Mapping[str, NDArray[Any]] = masks
    # A camera that was left out is shown, too, so that one sees why.
    if len(masks) < len(inputs.scene.cameras_of(frame)):
        shown = {**reader(index), **shown}
    if overlay and inputs.scene.images:
        shown = {**read_pictures(inputs, frame), **shown}
    found = bool(np.isfinite(q).all())
    segments = _draw_parts(inputs, captured, q if found else None, shown)
    bodies = {name: one > 0 for name, one in segments.items()}
    agreement = compare_masks(masks, bodies)
    error = agreement.E_total if masks else followed.error_by_colour(index, inputs.cameras)
    row = PoseRow(frame, q, None, error if found else float("nan"), seconds)
    record = FrameRecord(
        found=row.found,
        E_total=row.error if row.found else None,
        seconds=seconds,
        stopped_by=FOLLOWED,
        joint_errors=result.joint_errors(frame, q, row.found),
        joints=record_deviations(inputs.model, q, captured.deviations[index]),
        ious=agreement.ious if row.found else {},
        share=float(captured.shares[index]),
    )
    if overlay:
        for name, picture in shown.items():
            result.write_overlay(name, row, picture, bodies[name], segments[name])
    result.finish_frame(row, record)


def _draw_parts(
    inputs: Inputs, captured: PersonCapture, q: NDArray[np.float64] | None, wanted: Iterable[str]
) -> dict[str, NDArray[np.int16]]:
    """Which part of the person each pixel of the wanted cameras shows, from 1 on; 0: none."""
    X_WN = None
    if q is not None:
        X_WN = captured.tree.node_poses(captured.tree.values_from_positions(q))
    labels = range(1, 1 + len(captured.outlines))
    segments: dict[str, NDArray[np.int16]] = {}
    for camera in inputs.cameras:
        if camera.name in wanted:
            segments[camera.name] = np.zeros((camera.height, camera.width), dtype=np.int16)
            if X_WN is not None:
                X_CN = camera.X_CW @ X_WN
                segments[camera.name] = draw_labels(captured.outlines, labels, X_CN, camera)
    return segments
