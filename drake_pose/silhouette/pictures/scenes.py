"""Scenes: a folder of cameras and recorded masks."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from drake_pose.camera.camera_files import load_camera_file, load_cameras
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.camera.picture_files import VIDEOS, VideoPictures, in_order, read_picture
from drake_pose.errors import SceneError, SettingsError, UnknownNameError
from drake_pose.silhouette.pictures.masks import read_mask
from drake_pose.silhouette.pictures.scene_files import (
    MaskFiles,
    common_rate,
    find_images,
    find_masks,
    select_frames,
)
from drake_pose.yaml_files import read_yaml

_FIELDS = ("sequence", "frame_rate_hz")
CAMERA_FILE, SCENE_FILE = "cameras.yaml", "scene.yaml"
USUAL_RATE_HZ = 30.0
"""Frames a second of a sequence that does not say."""

# An uncalibrated camera looks along the world's -x: the picture's right is y, its up is z.
_LOOKING_BACK = np.array(
    [[0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_ANY_SCALE = 1000.0
# The fastest of zlib's levels. Masks are kept in a kilobyte or two each, once they were read: a PNG
# takes ten times as long to be decoded, and most masks are looked at more than once.
_LEVEL = 1
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
        images: the files, pictures or videos, of (camera, frame) of a sequence that has masks of
            few frames, or none: where a camera has no mask the body is tracked by its colours.
            Empty where there is a mask for every picture.
        readers: by camera what gives its pictures (H, W, 3) by frame, where no file of its own is.
        strangers: folders of masks that belong to no camera.
        warnings: what is wrong with the folder, but leaves enough to go on.
    """

    path: Path
    cameras: Mapping[str, Camera]
    frames: tuple[str, ...]
    masks: Mapping[tuple[str, str], Path]
    sequence: bool = False
    frame_rate_hz: float | None = None
    scale_unknown: bool = False
    images: Mapping[tuple[str, str], Path] = field(default_factory=dict)
    strangers: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    readers: Mapping[str, Callable[[str], np.ndarray]] = field(default_factory=dict)
    _videos: dict[Path, VideoPictures] = field(default_factory=dict, repr=False, compare=False)
    _packed: dict[tuple[Path, int, int], bytes] = field(
        default_factory=dict, repr=False, compare=False
    )
    _latest: dict[str, tuple[str, np.ndarray]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def cameras_of(self, frame: str) -> tuple[str, ...]:
        """The names of the cameras with a mask of a frame; UnknownNameError for no such frame."""
        names = tuple(camera for camera in self.cameras if (camera, frame) in self.masks)
        if not names and frame not in self.frames:
            raise UnknownNameError("frame", frame, self.frames, str(self.path))
        return names

    def of_cameras(self, wanted: Sequence[str]) -> Scene:
        """What the wanted cameras see; all that have masks where none is named.

        Raises UnknownNameError where there is no such camera.
        """
        for name in wanted:
            if name not in self.cameras:
                raise UnknownNameError("camera", name, self.cameras, str(self.path))
        used = set(wanted) or {name for name, _ in (*self.masks, *self.images)}
        return replace(
            self,
            cameras={name: camera for name, camera in self.cameras.items() if name in used},
            masks={key: file for key, file in self.masks.items() if key[0] in used},
            images={key: file for key, file in self.images.items() if key[0] in used},
        )

    def seen_frames(self, wanted: Sequence[str]) -> tuple[str, ...]:
        """The wanted frames, as select_frames has them, that a camera has seen.

        Raises:
            SceneError: there is none.
            UnknownNameError: there is no such frame.
        """
        seen = {frame for _, frame in (*self.masks, *self.images)}
        asked = select_frames(self.frames, wanted, str(self.path))
        if seen.isdisjoint(asked):
            names = ", ".join(self.cameras)
            raise SceneError(f"{self.path}: no mask of camera {names} in those frames")
        return tuple(frame for frame in asked if frame in seen)

    def every(self, step: int, wanted: Sequence[str]) -> tuple[Scene, tuple[str, ...]]:
        """Every step-th frame alone, from the first wanted one on, and which of these are wanted.

        Its frames follow each other at the true period, step times as long. Raises SettingsError
        for a step below 1, UnknownNameError where there is no such frame.
        """
        if step < 1:
            raise SettingsError(f"every must be 1 or more, not {step}")
        asked = select_frames(self.frames, wanted, str(self.path))
        if step == 1 or not asked:
            return self, tuple(wanted)
        kept = self.frames[self.frames.index(asked[0]) % step :: step]
        known, rate = set(kept), (self.frame_rate_hz or USUAL_RATE_HZ) / step
        scene = replace(
            self,
            frames=kept,
            masks={key: file for key, file in self.masks.items() if key[1] in known},
            images={key: file for key, file in self.images.items() if key[1] in known},
            frame_rate_hz=rate if self.sequence else self.frame_rate_hz,
        )
        return scene, tuple(frame for frame in asked if frame in known)

    def mask_path(self, camera: str, frame: str) -> Path:
        """The mask file of a camera's frame; UnknownNameError where there is none."""
        return self._file(self.masks, camera, frame)

    def read(self, camera: str, frame: str, *, may_be_empty: bool = False) -> np.ndarray:
        """The mask (H, W) of a camera's frame, which may be asked to show somebody.

        Raises:
            UnknownNameError: when there is no such camera, or it has no such frame.
            MaskError: when the file is not a mask of the camera's size.
        """
        path, size = self.mask_path(camera, frame), self.cameras[camera]
        key = path, size.width, size.height
        if (packed := self._packed.get(key)) is None:
            mask = read_mask(path, size.width, size.height, may_be_empty=may_be_empty)
            if mask.any():
                self._packed[key] = zlib.compress(np.packbits(mask).tobytes(), _LEVEL)
            return mask
        bits = np.frombuffer(zlib.decompress(packed), np.uint8)
        mask = np.unpackbits(bits, count=size.width * size.height).view(np.bool_)
        return mask.reshape(size.height, size.width)

    def read_image(self, camera: str, frame: str) -> np.ndarray:
        """The picture (H, W, 3), red, green, blue, of a camera's frame.

        Raises:
            UnknownNameError: when there is no such camera, or it has no such picture.
            SceneError: when the file is no picture of the camera's size.
        """
        file, size = self._file(self.images, camera, frame), self.cameras[camera]
        if self._latest.get(camera, ("",))[0] == frame:
            return self._latest[camera][1].copy()
        if camera in self.readers:
            picture = self.readers[camera](frame)
        elif file.suffix.lower() in VIDEOS:
            if file not in self._videos:
                self._videos[file] = VideoPictures(file)
            picture = self._videos[file].read(int(frame))
        else:
            picture = read_picture(file, SceneError)
        if picture.shape[:2] != (size.height, size.width):
            raise SceneError(
                f"{file}: is {picture.shape[1]} x {picture.shape[0]} pixels, but camera "
                f"'{camera}' has {size.width} x {size.height}"
            )
        # What is tracked in a picture is drawn over it next.
        self._latest[camera] = frame, picture
        return picture.copy()

    def _file(self, files: Mapping[tuple[str, str], Path], camera: str, frame: str) -> Path:
        if camera not in self.cameras:
            raise UnknownNameError("camera", camera, self.cameras, str(self.path))
        if (camera, frame) not in files:
            known = sorted(name for owner, name in files if owner == camera)
            raise UnknownNameError("frame", frame, known, f"{self.path}: camera '{camera}'")
        return files[camera, frame]


def load_scene(
    path: str | Path,
    cameras: Mapping[str, Camera] | None = None,
    wanted: Sequence[str] = (),
    sequence: bool = False,
) -> Scene:
    """Reads what a scene's folder holds; masks are read when they are asked for.

    The folder has ``cameras.yaml``, ``masks/<camera>/<frame>.png`` and perhaps ``scene.yaml``
    (``sequence: true|false``, ``frame_rate_hz``). A sequence may have pictures
    ``images/<camera>/<frame>.png`` or ``.jpg``, or a video ``videos/<camera>.mp4``, where it has no
    masks. A single camera's masks may lie in ``masks/<frame>.png``; without a camera file they were
    taken by an uncalibrated camera, or by several where the pictures' sizes differ. Given
    ``cameras`` are used instead of the folder's. Where all the ``wanted`` ones have an X_WC, others
    may lack it. ``sequence``: whether it is one where scene.yaml does not say.

    Raises:
        SceneError: names the folder and what is missing or wrong in it.
        CameraError: when the camera file is wrong.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder; a scene has cameras.yaml and masks")
    sequence, frame_rate_hz = read_sequence(folder / SCENE_FILE, sequence)
    if cameras is None:
        if not os.path.lexists(folder / CAMERA_FILE):
            cameras, masks = _unknown_cameras(folder)
            frames = in_order(frame for _, frame in masks)
            return Scene(folder, cameras, frames, masks, sequence, frame_rate_hz, True)
        cameras = _load_wanted(folder / CAMERA_FILE, wanted)
    has_masks = (folder / "masks").is_dir()
    files = find_masks(folder, cameras) if has_masks else MaskFiles({})
    images = {}
    if sequence:
        images = find_images(folder, cameras, in_order(frame for _, frame in files.masks))
    if not (images or has_masks):
        files = find_masks(folder, cameras)
    is_video = {name: file for (name, _), file in images.items() if file.suffix.lower() in VIDEOS}
    rate_hz, drifts = common_rate(is_video)
    if all(key in files.masks for key in images):
        images = {}
    return Scene(
        folder,
        dict(cameras),
        in_order(frame for _, frame in (*files.masks, *images)),
        files.masks,
        sequence,
        frame_rate_hz or rate_hz,
        images=images,
        strangers=files.strangers,
        # Of pictures with few masks it is no fault that masks are missing.
        warnings=drifts if images else files.warnings,
    )


def _load_wanted(path: Path, wanted: Sequence[str]) -> Mapping[str, Camera]:
    """All cameras of a file, of which those that are not wanted need no place."""
    if wanted:
        file = load_camera_file(path)
        if {*file.unplaced, *file.links}.isdisjoint(wanted):
            return file.cameras
    return load_cameras(path)


def _unknown_cameras(folder: Path) -> tuple[dict[str, Camera], dict[tuple[str, str], Path]]:
    """Returns a camera for every size of picture, and the masks."""
    if not any((folder / "masks").glob("*.png")):
        raise SceneError(
            f"{folder}: has no cameras.yaml, so its cameras must be given; only masks that lie in "
            "masks/<frame>.png need none"
        )
    found = find_masks(folder, [_UNKNOWN]).masks
    sizes = {frame: read_mask(file).shape[::-1] for (_, frame), file in found.items()}
    several = len(set(sizes.values())) > 1
    cameras: dict[str, Camera] = {}
    names = {}
    for frame, (width, height) in sizes.items():
        names[frame] = name = f"{_UNKNOWN}_{width}x{height}" if several else _UNKNOWN
        cameras[name] = ParallelCamera(
            name, width, height, _ANY_SCALE, (width - 1) / 2, (height - 1) / 2, _LOOKING_BACK
        )
    return cameras, {(names[frame], frame): file for (_, frame), file in found.items()}


def read_sequence(path: Path, sequence: bool = False) -> tuple[bool, float | None]:
    """Whether frames follow each other, and at what rate [Hz], by a scene.yaml that may be missing.

    Args:
        sequence: what holds where it does not say.

    Raises SceneError: it cannot be read, or says something else.
    """
    if not os.path.lexists(path):
        return sequence, None
    content = read_yaml(path, SceneError)
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected a mapping with {', '.join(_FIELDS)}")
    unknown = [str(field)[:40] for field in content if field not in _FIELDS]
    if unknown:
        raise SceneError(
            f"{path}: unknown field {', '.join(unknown)}; a scene has: {', '.join(_FIELDS)}"
        )
    sequence = content.get("sequence", sequence)
    if not isinstance(sequence, bool):
        raise SceneError(f"{path}: sequence must be true or false")
    rate = content.get("frame_rate_hz")
    if rate is None:
        return sequence, None
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0.0 < rate < math.inf:
        raise SceneError(f"{path}: frame_rate_hz must be a finite positive number")
    return sequence, float(rate)
