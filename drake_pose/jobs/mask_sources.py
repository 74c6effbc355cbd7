"""Sources of masks by camera: folders of pictures, videos, COCO files and recorded episodes."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.camera.camera_files import CameraFile, load_camera_file
from drake_pose.camera.episode import Stream
from drake_pose.camera.episode_files import open_episode, recording_format, video_camera
from drake_pose.camera.picture_files import (
    SUFFIXES,
    VIDEOS,
    Video,
    in_order,
    list_pictures,
    read_binary_mask,
    read_picture,
    threshold_mask,
)
from drake_pose.errors import SceneError
from drake_pose.silhouette.pictures.masks import AnnotatedPicture, is_coco, read_coco
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, common_rate


@dataclass(frozen=True)
class Source:
    """Pictures or annotations of all cameras.

    A single camera without a name is "".
    """

    path: Path  # Folder or file of the source.
    camera_file: Path | None = None  # The camera file; None if there is none.
    cameras: CameraFile | None = None  # Content of the camera file; None if there is none.
    # Picture files by camera and frame.
    pictures: Mapping[str, Mapping[str, Path]] = field(default_factory=dict)
    # Cameras of videos and of recorded episodes.
    streams: Mapping[str, Stream] = field(default_factory=dict)
    # Pictures of COCO files, each after the name of the folder that its COCO file lies in ("": the
    # source's); then there are no other pictures.
    annotated: Sequence[tuple[str, AnnotatedPicture]] = ()
    rate_hz: float | None = None  # Pictures per second of the streams; None: unknown.
    warnings: tuple[str, ...] = ()  # Faults that do not prevent the use of the source.
    _sizes: dict[str, tuple[int, ...]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return (*self.pictures, *self.streams)

    def read(self, camera: str, *, as_masks: bool = False) -> Iterator[tuple[str, str, Any]]:
        """Yield each frame of a camera: name, origin for messages, and picture (H, W, 3) uint8 RGB.

        ``as_masks``: the pictures show masks, which are returned instead, (H, W) bool.

        Raises SceneError: a picture cannot be read, is no mask, or differs in size from its camera.
        """
        read = partial(read_binary_mask, may_be_empty=True, lossy=True)
        for frame, path in self.pictures.get(camera, {}).items():
            picture = read(path) if as_masks else read_picture(path)
            self.check_size(camera, picture.shape, str(path))
            yield frame, str(path), picture
        if (stream := self.streams.get(camera)) is not None:
            for k, frame in enumerate(stream.names):
                picture, where = stream.read(k), f"{self.path}: camera '{camera}', picture {k}"
                self.check_size(camera, picture.shape, where)
                yield frame, where, threshold_mask(picture, where) if as_masks else picture

    def check_size(self, camera: str, shape: tuple[int, ...], where: str) -> None:
        """Raise SceneError if a picture's size is not its camera's, or that of its first picture.

        Pictures of a camera without a name may have any size. ``shape``: (height, width, ...).
        ``where``: the picture's origin, for messages.
        """
        own = None if self.cameras is None else self.cameras.cameras[camera]
        size, whose = shape[:2], f"camera '{camera}' had before"
        if own is not None:
            size, whose = (own.height, own.width), f"camera '{camera}' of {self.camera_file} has"
        elif camera:
            size = self._sizes.setdefault(camera, size)
        if shape[:2] != size:
            raise SceneError(
                f"{where}: has {shape[1]} x {shape[0]} pixels (width x height), but {whose} "
                f"{size[1]} x {size[0]}"
            )

    def annotated_pictures(self) -> dict[str, dict[str, AnnotatedPicture]]:
        """Return the pictures of the COCO files by camera and frame, frames in natural order.

        With a camera file, the camera is the last folder in the picture's path that is a camera's
        name, else the COCO file's folder (in ``annotated``), else the only camera, else the one
        with whose name the picture's name begins. Without, it is the COCO file's folder, else the
        last folder in the picture's path, or "" if all pictures lie in one folder.

        Raises SceneError: the camera is unknown, or a frame occurs twice.
        """
        known = [] if self.cameras is None else list(self.cameras.cameras)
        places = {folder or one.file.parent for folder, one in self.annotated}
        found: dict[str, dict[str, AnnotatedPicture]] = {}
        for folder, one in self.annotated:
            file, frame = one.file, one.file.stem
            camera = folder or (file.parent.name or None if len(places) > 1 else "")
            if known:
                names = [*reversed(file.parent.parts), folder, *(known if len(known) == 1 else [])]
                camera = next((name for name in names if name in known), None)
            if camera is None:
                begun = [re.fullmatch(f"({re.escape(name)})[-_. ]+(.+)", frame) for name in known]
                camera, frame = next((one.groups() for one in begun if one), (None, frame))
            if camera is None:
                raise SceneError(
                    f"{one.source}: picture '{one.name}': no folder of its path is a camera"
                    f"{f' of {self.camera_file}: ' + ', '.join(known) if known else ''}; the "
                    "paths must be <camera>/<frame>.png"
                )
            before = found.setdefault(camera, {}).setdefault(frame, one)
            if before is not one:
                raise SceneError(
                    f"{one.source}: camera '{camera}' has frame {frame} twice: '{before.name}' and "
                    f"'{one.name}'; export each picture once (without augmentation), and give "
                    "each camera a folder"
                )
        return {name: {frame: own[frame] for frame in in_order(own)} for name, own in found.items()}


def open_source(path: Path, camera_file: Path | None, episode: int | None) -> Source:
    """Return a source of masks; pictures and videos are not read yet.

    ``path``: one of: a folder with ``images/<camera>/<frame>.png`` or ``.jpg`` (cameras without
    such a folder: ``videos/<camera>.mp4``), the same without ``images`` and ``videos``, or, without
    both, in ``masks``; the pictures of a single camera need no folder of their own; a picture,
    video or COCO file; an episode of a LeRobot data set, of DROID, or a bag. ``camera_file``:
    camera file; None: the folder's cameras.yaml, if it exists. ``episode``: number of the episode
    in a LeRobot data set; None: the only one.

    Raises SceneError: the message names what is missing or ambiguous; CameraError: the camera file
    cannot be used; MaskError: a COCO file cannot be used.
    """
    if not path.exists():
        raise SceneError(f"{path}: there is no such folder or file")
    if camera_file is None and path.is_dir() and (path / CAMERA_FILE).is_file():
        camera_file = path / CAMERA_FILE
    cameras = None if camera_file is None else load_camera_file(camera_file)
    try:
        if episode is not None or recording_format(path) in ("lerobot", "droid", "bag"):
            recorded = open_episode(path, episode=episode)
            steps = np.diff(next(iter(recorded.cameras.values())).times)
            rate = 1.0 / float(np.median(steps)) if len(steps) else None
            found = Source(path, streams=recorded.cameras, rate_hz=rate, warnings=recorded.warnings)
        elif not path.is_file():
            found = _open_folder(path)
        elif (kind := path.suffix.lower()) == ".json":
            found = Source(path, annotated=[("", one) for one in read_coco(path)])
        elif kind in VIDEOS:
            found = _of_videos(path, {"": path})
        elif kind in SUFFIXES:
            found = Source(path, pictures={"": {path.stem: path}})
        else:
            raise SceneError(f"{path}: is not a picture, video or COCO file")
    except OSError as error:
        raise SceneError(f"{error.filename or path}: cannot be read: {error.strerror}") from error
    if not (found.names or found.annotated):
        raise SceneError(
            f"{path}: has no pictures images/<camera>/<frame>.png or .jpg, no videos "
            "videos/<camera>.mp4, no COCO file (.json), and is not a data set or bag"
        )
    pictures, streams = found.pictures, found.streams
    if cameras is not None:
        known = list(cameras.cameras)
        for name in found.names:
            if name not in (*known, ""):
                raise SceneError(
                    f"{path}: the pictures of '{name}' belong to no camera of {camera_file}, which "
                    f"has {', '.join(known)}; remove them, or calibrate that camera"
                )
        if "" in found.names and len(known) > 1:
            raise SceneError(
                f"{path}: its pictures are not in a camera's folder, but {camera_file} has "
                f"{len(known)} cameras: {', '.join(known)}; name the folder after one of them"
            )
        pictures = {name or known[0]: files for name, files in pictures.items()}
        streams = {name or known[0]: one for name, one in streams.items()}
    return replace(
        found, camera_file=camera_file, cameras=cameras, pictures=pictures, streams=streams
    )


def _of_videos(
    path: Path, files: Mapping[str, Path], pictures: Mapping[str, Mapping[str, Path]] | None = None
) -> Source:
    """Return the source of videos and pictures by camera; SceneError: a video is unreadable."""
    videos = {name: Video(file) for name, file in files.items()}
    streams = {name: video_camera(name, video) for name, video in videos.items()}
    rate, warnings = common_rate(videos)
    return Source(path, pictures=pictures or {}, streams=streams, rate_hz=rate, warnings=warnings)


def _open_folder(path: Path) -> Source:
    """Return the source of a folder: its pictures, videos or COCO files by camera, "" without one.

    Raises SceneError: the folder's pictures and videos are ambiguous; MaskError: a COCO file cannot
    be used.
    """
    places = [path / name for name in ("images", "videos") if (path / name).is_dir()]
    # Without pictures to segment, masks of another tool are read.
    roots = places or [path / "masks" if (path / "masks").is_dir() else path]
    # CVAT and Label Studio put COCO files beside or before the folder of pictures.
    beside = [folder for folder in (path, path / "annotations") if folder not in roots]
    no_cameras = ("background", "overlay", "masks", "images", "videos", "annotations")
    folders = [("", root) for root in (*roots, *beside) if root.is_dir()] + [
        (entry.name, entry)
        for root in roots
        for entry in sorted(root.iterdir())
        if entry.is_dir() and not entry.name.startswith(".") and entry.name not in no_cameras
    ]
    pictures: dict[str, dict[str, Path]] = {}
    videos: dict[str, Path] = {}
    annotated: list[tuple[str, AnnotatedPicture]] = []
    for name, folder in folders:
        if folder not in beside and (files := list_pictures(folder)):
            pictures[name] = files
        for file in sorted(folder.iterdir()):
            kind = "" if file.name.startswith(".") else file.suffix.lower()
            if kind == ".json" and (folder not in beside or is_coco(file)):
                # Roboflow writes a COCO file into the folder of each part of a data set.
                own = "" if name in ("train", "valid", "test") else name
                annotated += [(own, one) for one in read_coco(file)]
            elif kind in VIDEOS and folder in roots:
                if file.stem in videos:
                    raise SceneError(f"{file}: is a second video of '{file.stem}'; remove one")
                videos[file.stem] = file
    # The pictures beside COCO files are those that were annotated.
    if annotated:
        return Source(path, annotated=annotated)
    # As in scenes, a folder of pictures takes precedence over a video of the same camera.
    videos = {name: file for name, file in videos.items() if name not in pictures}
    if "" in pictures and (videos or len(pictures) > 1):
        raise SceneError(
            f"{roots[0]}: has pictures beside videos or folders of pictures; move them into a "
            "camera's folder"
        )
    return _of_videos(path, videos, pictures)
