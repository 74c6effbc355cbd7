"""What masks are made of: folders of pictures, videos, and files of annotations, by camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2

from drake_pose.camera.files import CameraFile, load_camera_file
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import SUFFIXES, read_picture
from drake_pose.camera.sources.frame_source import Picture, SourceSpecification
from drake_pose.camera.sources.recorded import VideoSource, find_picture_files
from drake_pose.errors import SceneError
from drake_pose.silhouette.pictures.video_pictures import VIDEOS
from drake_pose.silhouette.segmentation.annotations import Annotations, read_annotations

CAMERAS = "cameras.yaml"
SCENE = "scene.yaml"
UNNAMED = ""
"""The only camera's name, where nothing names it: its masks lie in no folder of their own."""

_JSON = ".json"


@dataclass(frozen=True)
class Source:
    """Where the pictures of all cameras are, or what other tools say of them.

    Args:
        path: what was given.
        camera_file: the cameras' file, None where there is none.
        cameras: what it says; None where there is none.
        pictures: by camera and frame, the files; none where there are videos.
        videos: by camera.
        annotated: the files of annotations, each with the camera whose folder it lies in.
    """

    path: Path
    camera_file: Path | None
    cameras: CameraFile | None
    pictures: Mapping[str, Mapping[str, Path]]
    videos: Mapping[str, Path]
    annotated: Sequence[tuple[str | None, Annotations]] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(self.pictures) or tuple(self.videos)

    def camera(self, name: str) -> Camera | None:
        """A camera; None where its file is not given."""
        return None if self.cameras is None else self.cameras.cameras[name]

    def count(self) -> int | None:
        """How many pictures there are; None where nobody knows, as in videos."""
        return sum(map(len, self.pictures.values())) if not self.videos else None

    def read(self, camera: str) -> Iterator[tuple[str, str, Picture]]:
        """The frames of a camera: name, where it is from, and the picture (H, W, 3).

        Raises:
            SceneError: a picture that cannot be read, or has another size than its camera.
        """
        if camera in self.videos:
            yield from self._read_video(camera)
        for frame, path in self.pictures.get(camera, {}).items():
            picture = read_picture(path, SceneError)
            self.check_size(camera, picture.shape[1], picture.shape[0], str(path))
            yield frame, str(path), picture

    def check_size(self, camera: str, width: int, height: int, where: str) -> None:
        """Refuses what is not of the size that a camera is calibrated for.

        Raises:
            SceneError: names what it is.
        """
        own = self.camera(camera)
        if own is not None and (width, height) != (own.width, own.height):
            raise SceneError(
                f"{where}: has {width} x {height} pixels (width x height), but camera '{camera}' "
                f"of {self.camera_file} has {own.width} x {own.height}"
            )

    def frame_rate_hz(self) -> float | None:
        """Of the videos, where there are any that say so."""
        for path in self.videos.values():
            capture = cv2.VideoCapture(str(path))
            rate = float(capture.get(cv2.CAP_PROP_FPS))
            capture.release()
            if rate > 0.0:
                return rate
        return None

    def _read_video(self, camera: str) -> Iterator[tuple[str, str, Picture]]:
        path = self.videos[camera]
        capture = cv2.VideoCapture(str(path))
        size = [
            int(capture.get(one)) for one in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        ]
        capture.release()
        if min(size) < 1:
            raise SceneError(f"{path}: not a video that OpenCV can read")
        self.check_size(camera, size[0], size[1], str(path))
        # With a background its pictures are no masks to the source.
        source = VideoSource(
            SourceSpecification(camera, "video", str(path), size[0], size[1], background="none")
        )
        try:
            while (taken := source.read()) is not None:
                yield taken.frame, f"{path}: frame {taken.frame}", taken.picture.astype("uint8")
        finally:
            source.close()
        if source.problems:
            raise SceneError("; ".join(source.problems))


def open_source(path: Path, camera_file: Path | None = None) -> Source:
    """Finds out what there is.

    A folder has ``images/<camera>/<frame>.png`` or ``.jpg``, ``videos/<camera>.mp4``, or the same
    without ``images`` and ``videos``, or in ``masks`` where there is neither; with a single camera
    the pictures may lie in it. In place of pictures there may be labelme's ``<frame>.json``. A file
    is a picture, a video, or annotations of COCO or labelme.

    Args:
        path: the folder or file.
        camera_file: the cameras; the folder's ``cameras.yaml`` where not given, if it has one.

    Raises:
        SceneError: names what is missing, or in doubt.
        CameraError: the camera file is wrong.
        MaskError: a file of annotations is wrong.
    """
    if not path.exists():
        raise SceneError(f"{path}: there is no such folder or file")
    if camera_file is None and path.is_dir() and (path / CAMERAS).is_file():
        camera_file = path / CAMERAS
    cameras = None if camera_file is None else load_camera_file(camera_file)
    try:
        pictures, videos, annotations = _find(path)
    except OSError as error:
        raise SceneError(f"{error.filename or path}: cannot be read: {error.strerror}") from error
    if not (pictures or videos or annotations):
        raise SceneError(
            f"{path}: holds no pictures images/<camera>/<frame>.png or .jpg, no videos "
            "videos/<camera>.mp4, and no annotations of COCO or labelme (.json)"
        )
    found = [name for name in (*pictures, *videos) if name is not None]
    if cameras is not None:
        found = _name_by_file(path, camera_file, cameras, found, [*pictures, *videos])
    single = found[0] if cameras is not None and len(found) == 1 else UNNAMED
    return Source(
        path,
        camera_file,
        cameras,
        {single if name is None else name: files for name, files in pictures.items()},
        {single if name is None else name: file for name, file in videos.items()},
        annotations,
    )


def _name_by_file(
    path: Path,
    camera_file: Path | None,
    cameras: CameraFile,
    found: Sequence[str],
    all_names: Sequence[str | None],
) -> list[str]:
    """The cameras' names, where a camera file says them.

    Raises:
        SceneError: a folder or video belongs to no camera, or nothing says to which.
    """
    for name in found:
        if name not in cameras.cameras:
            raise SceneError(
                f"{path}: the pictures of '{name}' belong to no camera of {camera_file}, which has "
                f"{', '.join(cameras.cameras)}; take them out, or calibrate that camera"
            )
    if None in all_names:
        if len(cameras.cameras) > 1:
            raise SceneError(
                f"{path}: its pictures lie in no camera's folder, but {camera_file} has "
                f"{len(cameras.cameras)} cameras: {', '.join(cameras.cameras)}"
            )
        return list(cameras.cameras)
    return list(found)


_Found = tuple[
    dict[str | None, dict[str, Path]],
    dict[str | None, Path],
    list[tuple[str | None, Annotations]],
]


def _find(path: Path) -> _Found:
    """Pictures, videos and annotations by camera; None: nothing names it."""
    if path.is_file():
        kind = path.suffix.lower()
        if kind == _JSON:
            return {}, {}, [(None, read_annotations(path))]
        if kind in VIDEOS:
            return {}, {None: path}, []
        if kind in SUFFIXES:
            return {None: {path.stem: path}}, {}, []
        raise SceneError(f"{path}: is no picture, video or file of annotations")
    places = [path / name for name in ("images", "videos") if (path / name).is_dir()]
    if len(places) > 1:
        raise SceneError(f"{path}: has images and videos; name one of them: {places[0]}")
    # Where there is nothing to find objects in, masks that another tool put there are meant.
    beside = path / "masks"
    root = places[0] if places else beside if beside.is_dir() else path
    pictures: dict[str | None, dict[str, Path]] = {}
    annotations: list[tuple[str | None, Annotations]] = []
    for name, folder in _folders(root):
        files = [file for file in sorted(folder.iterdir()) if not file.name.startswith(".")]
        kinds = {file.suffix.lower() for file in files}
        if kinds & set(SUFFIXES):
            pictures[name] = find_picture_files(folder, name or UNNAMED)
        annotations += [
            (name, read_annotations(file)) for file in files if file.suffix.lower() == _JSON
        ]
    videos: dict[str | None, Path] = {}
    for file in sorted(root.iterdir()):
        if file.suffix.lower() in VIDEOS:
            if file.stem in videos:
                raise SceneError(f"{file}: there is a second video of camera '{file.stem}'")
            videos[file.stem] = file
    # Annotations lie beside the pictures that they are of.
    if annotations:
        return {}, {}, annotations
    if None in pictures and len(pictures) > 1:
        raise SceneError(
            f"{root}: has pictures beside folders of pictures; put them in a camera's folder"
        )
    if pictures and videos:
        raise SceneError(f"{root}: has pictures and videos; give one of them")
    return pictures, videos, annotations


def _folders(root: Path) -> Iterator[tuple[str | None, Path]]:
    """A folder itself, then those in it that are not hidden."""
    yield None, root
    for entry in sorted(root.iterdir()):
        if entry.is_dir() and not entry.name.startswith(".") and entry.name not in _NOT_CAMERAS:
            yield entry.name, entry


_NOT_CAMERAS = ("background", "overlay", "masks", "images", "videos")


def cameras_of_annotations(source: Source) -> Iterable[tuple[str, str, Annotations, int]]:
    """Of each annotated picture: camera, frame, the file, and which of its pictures it is.

    The camera is the last folder of the picture's path in the file that is a camera's name, or that
    in which the file of annotations lies.

    Raises:
        SceneError: nothing tells the camera, or a frame is there twice.
    """
    known = None if source.cameras is None else list(source.cameras.cameras)
    listed = [
        (folder, marks, k, PurePosixPath(one.file))
        for folder, marks in source.annotated
        for k, one in enumerate(marks.pictures)
    ]
    several = len({folder or file.parent for folder, _, _, file in listed}) > 1
    seen: set[tuple[str, str]] = set()
    for folder, marks, k, file in listed:
        names = [*reversed(file.parent.parts), *([folder] if folder else [])]
        if known is not None:
            camera = next((name for name in names if name in known), None)
            camera = known[0] if camera is None and len(known) == 1 else camera
        else:
            camera = folder or (file.parent.name or None if several else UNNAMED)
        if camera is None:
            raise SceneError(
                f"{marks.path}: picture '{file}': no folder of its path is a camera"
                f"{'' if known is None else f' of {source.camera_file}: ' + ', '.join(known)}; the "
                "paths must be <camera>/<frame>.png"
            )
        if (camera, file.stem) in seen:
            raise SceneError(f"{marks.path}: camera '{camera}' has frame {file.stem} twice")
        seen.add((camera, file.stem))
        yield camera, file.stem, marks, k
