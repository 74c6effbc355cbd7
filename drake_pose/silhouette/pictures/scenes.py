"""Scenes: a folder of cameras and recorded masks."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from drake_pose.camera.files import load_cameras
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import SceneError, UnknownNameError
from drake_pose.regular_files import read_regular
from drake_pose.silhouette.pictures.masks import read_mask
from drake_pose.silhouette.pictures.scene_files import (
    Leftovers,
    SceneFiles,
    find_images,
    find_masks,
    natural_key,
)
from drake_pose.silhouette.pictures.video_pictures import VIDEOS, VideoPictures
from drake_pose.yaml_files import read_yaml

_FIELDS = ("sequence", "frame_rate_hz")

# An uncalibrated camera looks along the world's -x: the picture's right is y, its up is z.
_LOOKING_BACK = np.array(
    [[0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_ANY_SCALE = 1000.0
_UNKNOWN = "camera"


@dataclass(frozen=True)
class Scene:
    """A folder of masks, and the cameras that took them.

    Args:
        cameras: in the camera file's order.
        frames: in natural order, 2 before 10; a frame may lack some cameras.
        masks: the mask file of (camera, frame).
        sequence: whether the frames follow each other in time.
        scale_unknown: whether the cameras are uncalibrated: each is a parallel camera that looks
            along the world's -x, and its pixels_per_metre and what it looks at are to be found.
        leftovers: what lies in the folder and is not used.
        images: the files, pictures or videos, of (camera, frame) of a sequence that has masks of
            few frames, or none: where a camera has no mask the body is tracked by its colours.
            Empty where there is a mask for every picture.
    """

    path: Path
    cameras: Mapping[str, Camera]
    frames: tuple[str, ...]
    masks: Mapping[tuple[str, str], Path]
    sequence: bool = False
    frame_rate_hz: float | None = None
    scale_unknown: bool = False
    leftovers: Leftovers = field(default_factory=Leftovers)
    images: Mapping[tuple[str, str], Path] = field(default_factory=dict)
    _videos: dict[Path, VideoPictures] = field(default_factory=dict, repr=False, compare=False)

    def cameras_of(self, frame: str) -> tuple[str, ...]:
        """The names of the cameras with a mask of a frame; UnknownNameError for no such frame."""
        names = tuple(camera for camera in self.cameras if (camera, frame) in self.masks)
        if not names and frame not in self.frames:
            raise UnknownNameError("frame", frame, self.frames, str(self.path))
        return names

    def mask_path(self, camera: str, frame: str) -> Path:
        """The mask file of a camera's frame; UnknownNameError where there is none."""
        if camera not in self.cameras:
            raise UnknownNameError("camera", camera, self.cameras, str(self.path))
        if (camera, frame) not in self.masks:
            known = sorted(name for owner, name in self.masks if owner == camera)
            raise UnknownNameError("frame", frame, known, f"{self.path}: camera '{camera}'")
        return self.masks[camera, frame]

    def read(self, camera: str, frame: str, *, may_be_empty: bool = False) -> np.ndarray:
        """The mask (H, W) of a camera's frame, which may be asked to show somebody.

        Raises:
            UnknownNameError: when there is no such camera, or it has no such frame.
            MaskError: when the file is not a mask of the camera's size.
        """
        path = self.mask_path(camera, frame)
        size = self.cameras[camera]
        return read_mask(path, size.width, size.height, may_be_empty=may_be_empty)

    def read_image(self, camera: str, frame: str) -> np.ndarray:
        """The picture (H, W, 3), red, green, blue, of a camera's frame.

        Raises:
            UnknownNameError: when there is no such camera, or it has no such picture.
            SceneError: when the file is no picture of the camera's size.
        """
        if (camera, frame) not in self.images:
            known = sorted(name for owner, name in self.images if owner == camera)
            raise UnknownNameError("frame", frame, known, f"{self.path}: camera '{camera}'")
        file, size = self.images[camera, frame], self.cameras[camera]
        if file.suffix.lower() in VIDEOS:
            if file not in self._videos:
                self._videos[file] = VideoPictures(file)
            picture = self._videos[file].read(int(frame))
        else:
            picture = _read_picture(file)
        if picture.shape[:2] != (size.height, size.width):
            raise SceneError(
                f"{file}: is {picture.shape[1]} x {picture.shape[0]} pixels, but camera "
                f"'{camera}' has {size.width} x {size.height}"
            )
        return picture


def _read_picture(file: Path) -> np.ndarray:
    """A picture (H, W, 3), red, green, blue, of a file."""
    try:
        data = np.frombuffer(read_regular(file), np.uint8)
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {error}") from error
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        raise SceneError(f"{file}: is no picture that can be read")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def load_scene(path: str | Path, cameras: Mapping[str, Camera] | None = None) -> Scene:
    """Reads what a scene's folder holds; masks are read when they are asked for.

    The folder has ``cameras.yaml``, ``masks/<camera>/<frame>.png`` and perhaps ``scene.yaml``
    (``sequence: true|false``, ``frame_rate_hz``). A sequence may have pictures
    ``images/<camera>/<frame>.png`` or ``.jpg``, or a video ``videos/<camera>.mp4``, where it has no
    masks. A single camera's masks may lie in ``masks/<frame>.png``; without a camera file they were
    taken by an uncalibrated camera, or by several where the pictures' sizes differ. Masks of
    cameras that are not in the camera file are left over, see ``Scene.leftovers``. Given
    ``cameras`` are used instead of the folder's.

    Raises:
        SceneError: names the folder and what is missing or wrong in it.
        CameraError: when the camera file is wrong.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder; a scene has cameras.yaml and masks")
    sequence, frame_rate_hz = _read_settings(folder / "scene.yaml")
    if cameras is None:
        if not os.path.lexists(folder / "cameras.yaml"):
            cameras, files = _unknown_cameras(folder)
            return Scene(folder, cameras, files.frames, files.masks, sequence, frame_rate_hz, True)
        cameras = load_cameras(folder / "cameras.yaml")
    files = find_masks(folder, cameras) if _has_masks(folder) else SceneFiles({}, ())
    images = find_images(folder, cameras, files.frames) if sequence else {}
    if not (images or _has_masks(folder)):
        files = find_masks(folder, cameras)
    videos = [file for file in images.values() if file.suffix.lower() in VIDEOS]
    if videos and frame_rate_hz is None:
        frame_rate_hz = VideoPictures(videos[0]).rate_hz
    if all(key in files.masks for key in images):
        images = {}
    frames = sorted({*files.frames, *(frame for _, frame in images)}, key=natural_key)
    return Scene(
        folder,
        dict(cameras),
        tuple(frames) if images else files.frames,
        files.masks,
        sequence,
        frame_rate_hz,
        leftovers=files.leftovers,
        images=images,
    )


def _has_masks(folder: Path) -> bool:
    return (folder / "masks").is_dir()


def _unknown_cameras(folder: Path) -> tuple[dict[str, Camera], SceneFiles]:
    """Returns a camera for every size of picture, and the masks."""
    if not (folder / "masks").is_dir() or not any((folder / "masks").glob("*.png")):
        raise SceneError(
            f"{folder}: has no cameras.yaml, so its cameras must be given; only masks that lie in "
            "masks/<frame>.png need none"
        )
    found = find_masks(folder, [_UNKNOWN])
    sizes = {frame: read_mask(file).shape[::-1] for (_, frame), file in found.masks.items()}
    several = len(set(sizes.values())) > 1
    names = {
        size: f"{_UNKNOWN}_{size[0]}x{size[1]}" if several else _UNKNOWN for size in sizes.values()
    }
    cameras: dict[str, Camera] = {
        name: ParallelCamera(
            name, width, height, _ANY_SCALE, (width - 1) / 2, (height - 1) / 2, _LOOKING_BACK
        )
        for (width, height), name in names.items()
    }
    masks = {(names[sizes[frame]], frame): file for (_, frame), file in found.masks.items()}
    return cameras, SceneFiles(masks, found.frames)


def _read_settings(path: Path) -> tuple[bool, float | None]:
    """Returns sequence and frame_rate_hz of a scene.yaml, which may be missing."""
    if not path.exists():
        return False, None
    content = read_yaml(path, SceneError)
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected a mapping with {', '.join(_FIELDS)}")
    unknown = [str(field)[:40] for field in content if field not in _FIELDS]
    if unknown:
        raise SceneError(
            f"{path}: unknown field {', '.join(unknown)}; a scene has: {', '.join(_FIELDS)}"
        )
    sequence = content.get("sequence", False)
    if not isinstance(sequence, bool):
        raise SceneError(f"{path}: sequence must be true or false")
    rate = content.get("frame_rate_hz")
    if rate is None:
        return sequence, None
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0.0 < rate < math.inf:
        raise SceneError(f"{path}: frame_rate_hz must be a finite positive number")
    return sequence, float(rate)
