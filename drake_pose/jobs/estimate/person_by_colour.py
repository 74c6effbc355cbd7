"""One person in a sequence of pictures of which few have masks: followed by colour."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.errors import SceneError
from drake_pose.jobs.estimate.capture_warnings import describe_faults
from drake_pose.jobs.estimate.inputs import Inputs
from drake_pose.jobs.estimate.scene_checks import SceneWarning, frame_ranges
from drake_pose.person.recordings.colour_capture import ColourRecording, capture_by_colour
from drake_pose.person.recordings.person_capture import PersonCapture
from drake_pose.person.recordings.persons_in_view import ReadFrame
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.silhouette.pictures.mask_agreement import edge_area


@dataclass(frozen=True, eq=False)
class FollowedPerson:
    """A person who was followed through all frames.

    Args:
        captured: poses and shape.
        read: gives the masks that were used, by camera.
        faults: what the user should know.
        distances: (frames,) as of `ColourCapture`; None: there are masks of all frames.
    """

    captured: PersonCapture
    read: ReadFrame
    faults: tuple[SceneWarning, ...]
    distances: NDArray[np.float64] | None = None

    def error_by_colour(self, index: int, cameras: Sequence[Camera]) -> float:
        """E_total of a frame without masks: the strip between both contours, over the body's area.

        nan where there is none.
        """
        captured, q = self.captured, self.captured.q[index]
        if self.distances is None or not np.isfinite(q).all():
            return float("nan")
        X_WN = captured.tree.node_poses(captured.tree.values_from_positions(q))
        bodies = [draw_mask(captured.outlines, camera.X_CW @ X_WN, camera) for camera in cameras]
        area = sum(int(np.count_nonzero(body)) for body in bodies)
        edge = sum(edge_area(body) for body in bodies)
        return float(edge * self.distances[index] / max(area, 1))


def read_pictures(inputs: Inputs, frame: str) -> dict[str, NDArray[np.uint8]]:
    """The pictures (H, W, 3) of a frame by camera."""
    scene = inputs.scene
    return {
        camera.name: scene.read_image(camera.name, frame)
        for camera in inputs.cameras
        if (camera.name, frame) in scene.images
    }


def follow_by_colour(
    inputs: Inputs, read: ReadFrame, on_frame: Callable[[int], None]
) -> FollowedPerson:
    """Follows the person through a sequence of pictures.

    Args:
        inputs: what is estimated.
        read: gives the masks of a frame, counted from 0, by camera.
        on_frame: hears of every frame in which the person was followed.

    Raises:
        SceneError: nothing says where the person is at first, or masks contradict the cameras.
        SettingsError: in none of the frames with masks two cameras see a person.
    """
    scene, frames = inputs.scene, inputs.frames
    masked = tuple(k for k, frame in enumerate(frames) if len(scene.cameras_of(frame)) > 1)
    if frames[0] not in inputs.starts and 0 not in masked:
        raise SceneError(
            f"{scene.path}: a person is found by the masks of two cameras or more, but the first "
            f"frame, '{frames[0]}', has fewer: add them (drake-pose masks), or --start FILE.csv"
        )
    order = {frame: k for k, frame in enumerate(frames)}
    recording = ColourRecording(
        {camera.name: camera for camera in inputs.cameras},
        len(frames),
        read,
        lambda index: read_pictures(inputs, frames[index]),
        {order[frame]: q for frame, q in inputs.starts.items()},
    )
    found = capture_by_colour(inputs.model.pose_tree(), recording, masked, on_frame=on_frame)
    faults: tuple[SceneWarning, ...] = ()
    if found.checked is not None:
        faults = describe_faults(found.checked, [frames[k] for k in found.masked])
    lost = [frame for frame, q in zip(frames, found.captured.q, strict=True) if np.isnan(q).any()]
    if lost:
        text = (
            f"frame {frame_ranges(lost, frames)}: the person is lost, too little of the contour "
            "fits the colours; masks of two cameras in such a frame, or its row in --start "
            "FILE.csv, say where the person is"
        )
        faults += (SceneWarning("lost", text, (), tuple(lost)),)
    return FollowedPerson(found.captured, read, faults, found.distances)
