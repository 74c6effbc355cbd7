"""Scenes: folders of calibrated cameras with masks, pictures or videos."""

import os
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.camera_files import load_camera_file, load_cameras
from drake_pose.camera.episode import JointLog
from drake_pose.camera.episode_files import read_sequence, require_recording
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.camera.picture_files import (
    Video,
    find_recorded_files,
    frame_key,
    frame_number,
    in_order,
    natural_key,
    picture_size,
    read_picture,
)
from drake_pose.camera.sources import picture_times
from drake_pose.errors import (
    SceneError,
    SettingsError,
    UnknownNameError,
    require_at_least,
    require_known,
)
from drake_pose.silhouette.pictures.masks import read_mask

CAMERA_FILE, SCENE_FILE = "cameras.yaml", "scene.yaml"
USUAL_RATE_HZ = 30.0
"""Default frame rate of a sequence [frames/s]."""


@dataclass(frozen=True)
class Scene:
    """A folder of masks and the cameras that took them.

    Args:
        path: the folder.
        cameras: cameras by name, in the camera file's order.
        frames: frame names in natural order (2 before 10); a frame may lack some cameras.
        masks: mask file by (camera, frame).
        sequence: whether the frames are consecutive in time.
        frame_rate_hz: frame rate of a sequence [frames/s]; None: unknown.
        scale_unknown: whether the cameras are uncalibrated. Each is then a parallel camera along
            the world's -x whose scale and position are unknown.
        images: picture or video file by (camera, frame), for a sequence with masks of few or no
            frames. A frame without a mask is tracked by colours. Empty if every picture has a mask.
        unknown_folders: folders of masks that belong to no camera.
        warnings: faults of the folder that are not fatal.
        readers: functions that return a camera's picture (H, W, 3) by frame, for cameras of videos
            and episodes.
        times: (frames,) recorded times [s], NaN where unknown.
        joints: the robot's recorded joint positions, by time or by frame; None: not recorded.
    """

    path: Path
    cameras: Mapping[str, Camera]
    frames: tuple[str, ...]
    masks: Mapping[tuple[str, str], Path]
    sequence: bool = False
    frame_rate_hz: float | None = None
    scale_unknown: bool = False
    images: Mapping[tuple[str, str], Path] = field(default_factory=dict)
    unknown_folders: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    readers: Mapping[str, Callable[[str], np.ndarray]] = field(default_factory=dict)
    times: Array = field(default_factory=lambda: np.empty(0), compare=False)
    joints: JointLog | None = None
    _packed: dict[tuple[Path, int, int], tuple[Sequence[int], bytes]] = field(
        default_factory=dict, repr=False, compare=False
    )
    _latest: dict[str, tuple[str, np.ndarray]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def cameras_of(self, frame: str) -> tuple[str, ...]:
        """Return the names of cameras with a mask of a frame; UnknownNameError: no such frame."""
        names = tuple(camera for camera in self.cameras if (camera, frame) in self.masks)
        if not names and frame not in self.frames:
            raise UnknownNameError("frame", frame, self.frames, str(self.path))
        return names

    def of_cameras(self, wanted: Sequence[str]) -> "Scene":
        """Return the scene of the wanted cameras; if none is named, of all cameras with files.

        Raises UnknownNameError: there is no such camera.
        """
        require_known("camera", wanted, self.cameras, str(self.path))
        used = set(wanted) or {name for name, _ in (*self.masks, *self.images)}
        return replace(
            self,
            cameras={name: camera for name, camera in self.cameras.items() if name in used},
            masks={key: file for key, file in self.masks.items() if key[0] in used},
            images={key: file for key, file in self.images.items() if key[0] in used},
        )

    def frames_with_files(self, wanted: Sequence[str]) -> tuple[str, ...]:
        """Return the wanted frames, ranges ``FIRST:LAST`` or all, that have a mask or a picture.

        Raises SceneError: no such frame has a file; UnknownNameError: there is no such frame.
        """
        with_files = {frame for _, frame in (*self.masks, *self.images)}
        selected = select_frames(self.frames, wanted, str(self.path))
        if with_files.isdisjoint(selected):
            names = ", ".join(self.cameras)
            raise SceneError(f"{self.path}: no mask of camera {names} in those frames")
        return tuple(frame for frame in selected if frame in with_files)

    def every(self, step: int, wanted: Sequence[str]) -> "tuple[Scene, tuple[str, ...]]":
        """Return the scene with every ``step``-th frame, and those of its frames that are wanted.

        The first wanted frame is kept. The frame rate of a sequence is divided by ``step``. With a
        step of 1, ``wanted`` is returned as given.

        ``wanted``: names of frames, or ranges ``FIRST:LAST``; empty: all.

        Raises SettingsError: the step is below 1; UnknownNameError: there is no such frame.
        """
        require_at_least(1, every=step)
        selected = select_frames(self.frames, wanted, str(self.path))
        if step == 1 or not selected:
            return self, tuple(wanted)
        pick = slice(self.frames.index(selected[0]) % step, None, step)
        kept = self.frames[pick]
        known, rate = set(kept), (self.frame_rate_hz or USUAL_RATE_HZ) / step
        scene = replace(
            self,
            frames=kept,
            times=self.times[pick],
            masks={key: file for key, file in self.masks.items() if key[1] in known},
            images={key: file for key, file in self.images.items() if key[1] in known},
            frame_rate_hz=rate if self.sequence else self.frame_rate_hz,
        )
        return scene, tuple(frame for frame in selected if frame in known)

    def read(self, camera: str, frame: str, *, may_be_empty: bool = False) -> np.ndarray:
        """Return the mask (H, W) of a camera's frame.

        ``may_be_empty``: whether a mask without an object is accepted.

        Raises UnknownNameError: there is no such camera, or it has no such frame; MaskError: the
        file is not a mask of the camera's size, or has no object.
        """
        path, size = self._file(self.masks, camera, frame), self.cameras[camera]
        key = path, size.width, size.height
        if (packed := self._packed.get(key)) is None:
            mask = read_mask(path, size.width, size.height, may_be_empty=may_be_empty)
            left, top, width, height = box = cv2.boundingRect(mask.view(np.uint8))
            if width:
                # The object's box is kept, in about a kilobyte: decoding the PNG again takes ten
                # times as long.
                bits = np.packbits(mask[top : top + height, left : left + width])
                self._packed[key] = box, zlib.compress(bits.tobytes(), level=1)
            return mask
        (left, top, width, height), data = packed
        bits = np.unpackbits(np.frombuffer(zlib.decompress(data), np.uint8), count=width * height)
        mask = np.zeros((size.height, size.width), dtype=np.bool_)
        mask[top : top + height, left : left + width] = bits.reshape(height, width)
        return mask

    def read_image(self, camera: str, frame: str) -> np.ndarray:
        """Return the picture (H, W, 3), RGB, of a camera's frame.

        Raises UnknownNameError: there is no such camera, or it has no such picture; SceneError: the
        file is not a picture of the camera's size.
        """
        file, size = self._file(self.images, camera, frame), self.cameras[camera]
        if self._latest.get(camera, ("",))[0] == frame:
            return self._latest[camera][1].copy()
        read = self.readers.get(camera)
        picture = read_picture(file) if read is None else read(frame)
        if picture.shape[:2] != (size.height, size.width):
            raise SceneError(
                f"{file}: is {picture.shape[1]} x {picture.shape[0]} pixels, but camera "
                f"'{camera}' has {size.width} x {size.height}"
            )
        # Return a copy, since callers draw over the picture.
        self._latest[camera] = frame, picture
        return picture.copy()

    def require_images(self, frames: Collection[str]) -> None:
        """Check that the pictures of these frames can be read, before the work on them begins.

        Of PNG and JPEG files size and structure are checked, others are decoded.

        Raises SceneError: the file is not a picture of the camera's size.
        """
        for (name, frame), file in self.images.items():
            own = self.cameras[name]
            if frame in frames and (
                name in self.readers or picture_size(file) != (own.width, own.height)
            ):
                self.read_image(name, frame)

    def _file(self, files: Mapping[tuple[str, str], Path], camera: str, frame: str) -> Path:
        """Return the file of a camera's frame in ``files``; UnknownNameError: there is none."""
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
    """Read the content of a scene's folder; masks and pictures are read on demand.

    The folder has

    - ``cameras.yaml``,
    - ``masks/<camera>/<frame>.png``,
    - optionally ``scene.yaml`` with ``sequence: true|false`` and ``frame_rate_hz``,
    - for a sequence with masks of few or no frames, ``images/<camera>/<frame>.png`` or ``.jpg``, or
      ``videos/<camera>.mp4``.

    Masks of a single camera may lie in ``masks/<frame>.png``. Without a camera file, such masks
    belong to one uncalibrated camera for each size of picture.

    Args:
        path: the folder.
        cameras: cameras by name that replace those of the folder; None: those of ``cameras.yaml``.
        wanted: names of cameras; if all of them have a pose X_WC, other cameras of the file may
            lack it. Empty: all cameras of the file need a pose.
        sequence: whether the scene is a sequence if scene.yaml does not say.

    Raises:
        SceneError: something is missing or invalid; the message names the folder.
        CameraError: the camera file is invalid.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder; a scene has cameras.yaml and masks")
    require_recording(folder)
    sequence, frame_rate_hz = read_sequence(folder / SCENE_FILE, sequence)
    if cameras is None:
        if not os.path.lexists(folder / CAMERA_FILE):
            cameras, masks = _unknown_cameras(folder)
            frames = in_order(frame for _, frame in masks)
            return Scene(folder, cameras, frames, masks, sequence, frame_rate_hz, True)
        file = load_camera_file(folder / CAMERA_FILE) if wanted else None
        if file is not None and {*file.unplaced, *file.links}.isdisjoint(wanted):
            cameras = file.cameras
        else:
            cameras = load_cameras(folder / CAMERA_FILE)
    has_masks = (folder / "masks").is_dir()
    masks, unknown_folders, warnings = find_masks(folder, cameras) if has_masks else ({}, (), ())
    known = {int(frame): frame for _, frame in masks if frame.isdecimal()}
    recorded = {name: find_recorded_files(folder, name) for name in cameras if sequence}
    images: dict[tuple[str, str], Path] = {}
    videos: dict[str, Video] = {}
    for name, files in recorded.items():
        if isinstance(files, Path):
            videos[name] = Video(files)
            count = range(len(videos[name].times))
            files = {known.get(k, f"{k:06d}"): files for k in count}
        images |= {(name, frame): file for frame, file in (files or {}).items()}
    if not (images or has_masks):
        raise SceneError(f"{folder}: has no folder masks/<camera>/<frame>.png")
    rate_hz, drifts = common_rate(videos)
    if all(key in masks for key in images):
        images = {}
    frames = in_order(frame for _, frame in (*masks, *images))
    first, stamped = next(iter(images), ("", ""))[0], dict[str, float]()
    if first in videos:
        stamped = {str(k): time for k, time in enumerate(videos[first].times.tolist())}
    elif first:
        files = {frame: file for (name, frame), file in images.items() if name == first}
        try:
            stamped = picture_times(files, frame_rate_hz)
        except SceneError as error:
            drifts = (*drifts, f"{error}; the times of the pictures are not known")
    times = {frame_key(frame): time for frame, time in stamped.items()}
    return Scene(
        folder,
        dict(cameras),
        frames,
        masks,
        sequence,
        frame_rate_hz or rate_hz,
        images=images,
        unknown_folders=unknown_folders,
        # A sequence with pictures may lack masks, so that is no reason for a warning.
        warnings=drifts if images else warnings,
        readers={name: partial(_read_frame, video) for name, video in videos.items()},
        times=np.array([times.get(frame_key(frame), np.nan) for frame in frames]),
    )


def _read_frame(video: Video, frame: str) -> Picture:
    """Return a video's picture (H, W, 3) of a frame, which is named by its number."""
    return video.read(int(frame))


def _unknown_cameras(folder: Path) -> tuple[dict[str, Camera], dict[tuple[str, str], Path]]:
    """Return uncalibrated cameras by name, and mask files by (camera, frame).

    There is one parallel camera for each size of the masks ``folder/masks/<frame>.png``.

    Raises SceneError: there is no such mask.
    """
    if not any((folder / "masks").glob("*.png")):
        raise SceneError(
            f"{folder}: has no cameras.yaml, so its cameras must be given; only masks that lie in "
            "masks/<frame>.png need none"
        )
    found, _, _ = find_masks(folder, ["camera"])
    sizes = {frame: read_mask(file).shape[::-1] for (_, frame), file in found.items()}
    several = len(set(sizes.values())) > 1
    cameras: dict[str, Camera] = {}
    names = {}
    # Looking along the world's -x: the image's right is y and its up is z. The scale is arbitrary.
    X_WC = np.array(
        [[0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0, 0, 0, 1]]
    )
    for frame, (width, height) in sizes.items():
        names[frame] = name = f"camera_{width}x{height}" if several else "camera"
        centre = (width - 1) / 2, (height - 1) / 2
        cameras[name] = ParallelCamera(name, width, height, 1000.0, *centre, X_WC)
    return cameras, {(names[frame], frame): file for (_, frame), file in found.items()}


def common_rate(
    videos: Mapping[str, Video], max_ratio: float = 1.01
) -> tuple[float | None, tuple[str, ...]]:
    """Return the common frame rate of videos [frames/s], and warnings.

    The rate is None if no video has one. There is a warning if videos are truncated, or a picture
    or more apart at the end of the shortest.

    ``videos``: videos by camera. ``max_ratio``: largest ratio of the highest to the lowest rate.
    Raises SceneError: the ratio is larger.
    """
    warnings = [text for video in videos.values() for text in video.warnings]
    rates = {name: video.rate_hz for name, video in videos.items() if video.rate_hz is not None}
    if not rates:
        return None, tuple(warnings)
    slow = min(rates, key=lambda name: rates[name])
    fast = max(rates, key=lambda name: rates[name])
    ratio = rates[fast] / rates[slow]
    drift = min(len(video.times) for video in videos.values()) * (ratio - 1.0)
    text = (
        f"{videos[slow].path} has {rates[slow]:.5g} pictures a second, {videos[fast].path} "
        f"{rates[fast]:.5g}: pictures of equal number must be synchronised, but at the end they "
        f"are {drift:.0f} pictures apart; bring the videos to one rate (ffmpeg -i VIDEO -r RATE "
        "NEW)"
    )
    if ratio > max_ratio:
        raise SceneError(text)
    return next(iter(rates.values())), (*warnings, *([text] if drift >= 1.0 else []))


def select_frames(known: Sequence[str], wanted: Sequence[str], where: str) -> tuple[str, ...]:
    """Return the names of the wanted frames in the scene's order.

    ``known``: names of all frames, in the scene's order. ``wanted``: names, or ranges
    ``FIRST:LAST`` with both ends included; empty: all frames. A number stands for the frame with
    that number, with or without leading zeros. ``where``: the scene, for messages.

    Raises UnknownNameError: there is no such frame; SettingsError: a range ends before it begins.
    """
    places = {frame: k for k, frame in enumerate(known)}

    def place(name: str) -> int:
        """Return the index of a frame."""
        if name in places:
            return places[name]
        number = frame_number(name)
        same = [k for k, frame in enumerate(known) if frame_number(frame) == number]
        if number is None or len(same) != 1:
            raise UnknownNameError("frame", name, known, where)
        return same[0]

    chosen: set[int] = set()
    for text in wanted:
        first, colon, last = (text, "", "") if text in places else text.partition(":")
        ends = place(first), place(last if colon else first)
        if ends[1] < ends[0]:
            raise SettingsError(f"--frame: the range '{text}' ends before it begins")
        chosen.update(range(ends[0], ends[1] + 1))
    return tuple(frame for k, frame in enumerate(known) if k in chosen or not wanted)


def find_masks(
    folder: Path, cameras: Iterable[str]
) -> tuple[dict[tuple[str, str], Path], tuple[str, ...], tuple[str, ...]]:
    """Find ``masks/<camera>/<frame>.png``, or ``masks/<frame>.png`` of a single camera.

    Hidden files are ignored. If several cameras have masks, frames of equal number are the same,
    with or without leading zeros.

    ``cameras``: names of the cameras.

    Returns mask files by (camera, frame); folders that belong to no camera; warnings about unused
    files.

    Raises SceneError: a folder cannot be read, or no camera has masks.
    """
    names, root = list(cameras), folder / "masks"
    if not root.is_dir():
        raise SceneError(f"{folder}: has no folder masks/<camera>/<frame>.png")
    flat, foreign = _list_masks(root)
    found = {one[:-1]: _list_masks(root / one[:-1]) for one in foreign if one.endswith("/")}
    known = {name: found[name][0] for name in names if name in found}
    unknown_folders = {name: len(files) for name, (files, _) in found.items() if name not in names}
    if flat and not any(known.values()):
        if len(names) != 1:
            raise SceneError(
                f"{root}: masks that lie in no camera's folder need exactly one camera, but there "
                f"are {len(names)}: {', '.join(names)}"
            )
        known, flat = {names[0]: flat}, []
    others = {name: found[name][1] for name in names if name in found}
    if not any(known.values()):
        text = f"{root}: holds no mask <camera>/<frame>.png of: {', '.join(names)}"
        if unknown_folders:
            text += f"; folder {', '.join(unknown_folders)} belongs to no camera of the camera file"
        if files := [f"{name}/{file}" for name, own in others.items() for file in own]:
            text += f"; {files[0]} is {'a folder' if files[0].endswith('/') else 'no PNG picture'}"
        raise SceneError(text)
    others[""] = [one for one in foreign if not one.endswith("/")] + [path.name for path in flat]
    masks, doubled = _join_frames(known)
    unused, warnings = [name for name in names if not known.get(name)], list[str]()
    lower = {name.lower(): name for name in unused}
    for name, count in unknown_folders.items():
        close = get_close_matches(name.lower(), lower, n=1)
        advice = f"is it '{lower[close[0]]}'?" if close else "calibrate it"
        warnings.append(
            f"masks/{name}: no camera '{name}' in cameras.yaml; its {count} masks are left out: "
            f"{advice}"
        )
    warnings += [
        f"camera '{name}' of cameras.yaml has no masks in masks/{name} and is left out"
        for name in unused
    ]
    warnings += doubled
    for name, left in others.items():
        if left:
            more = f" and {len(left) - 1} more" if len(left) > 1 else ""
            warnings.append(
                f"{f'masks/{name}' if name else 'masks'}: {left[0]}{more} left out: masks are PNG "
                "pictures in masks/<camera>"
            )
    return masks, tuple(unknown_folders), tuple(warnings)


def _visible(folder: Path) -> list[os.DirEntry[str]]:
    """Return a folder's entries sorted by name, without hidden ones."""
    try:
        with os.scandir(folder) as entries:
            visible = [entry for entry in entries if not entry.name.startswith(".")]
    except OSError as error:
        raise SceneError(f"{folder}: cannot be read: {error.strerror}") from error
    for entry in visible:
        # Python decodes bytes of other encodings to surrogates, which cannot be written to files.
        if any("\ud800" <= character <= "\udfff" for character in entry.name):
            raise SceneError(f"{folder}: the name {entry.name!r} is not UTF-8 text; rename it")
    return sorted(visible, key=lambda entry: entry.name)


def _list_masks(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the PNG files of a folder, and the names of its other entries, folders' with a "/"."""
    names = [f"{entry.name}/" if entry.is_dir() else entry.name for entry in _visible(folder)]
    pictures = [name for name in names if name.lower().endswith(".png")]
    return [folder / name for name in pictures], [n for n in names if n not in pictures]


def _join_frames(
    files: Mapping[str, Sequence[Path]],
) -> tuple[dict[tuple[str, str], Path], list[str]]:
    """Merge the cameras' frames; a frame is named by its longest spelling.

    If several cameras have masks, frames of equal number are the same. ``files``: by camera, named
    by frame. Returns mask files by (camera, frame), and warnings about duplicates.
    """
    spellings = {file.stem for own_files in files.values() for file in own_files}
    several = sum(map(bool, files.values())) > 1
    first: dict[object, str] = {}
    name_of = {
        stem: first.setdefault(natural_key(stem) if several else stem, stem)
        for stem in sorted(spellings, key=lambda stem: (-len(stem), stem))
    }
    masks: dict[tuple[str, str], Path] = {}
    warnings = []
    for camera, own_files in files.items():
        by_frame: dict[str, list[Path]] = {}
        for file in sorted(own_files, key=lambda file: (-len(file.stem), file.name)):
            by_frame.setdefault(name_of[file.stem], []).append(file)
        for frame in in_order(by_frame):
            used, *duplicates = by_frame[frame]
            masks[camera, frame] = used
            if duplicates:
                names = ", ".join(file.name for file in duplicates)
                warnings.append(
                    f"camera '{camera}', frame {frame}: {used.name} is used; {names} is a duplicate"
                )
    return masks, warnings
