"""Pictures, masks and videos in files; and the order of frames' names."""

import io
import re
import warnings
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.models import LARGEST_SIDE
from drake_pose.errors import DrakePoseError, SceneError
from drake_pose.regular_files import read_regular, require_regular

SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg")
"""How names of pictures and of videos end."""


def natural_key(name: str) -> tuple[tuple[str, int], ...]:
    """What names are sorted by: texts and the numbers in them in turn, so that 2 precedes 10."""
    texts = re.split("([0-9]+)", name)
    return tuple(zip(texts[::2], [*map(int, texts[1::2]), -1], strict=True))


def in_order(frames: Iterable[str]) -> tuple[str, ...]:
    """Frames in natural order, each once."""
    return tuple(sorted(set(frames), key=lambda name: (natural_key(name), name)))


def frame_number(frame: str) -> int | None:
    """Returns the number that a frame's name is, or None."""
    # No file's name is longer; Python refuses to read numbers of thousands of digits.
    is_number = frame.isascii() and frame.isdigit() and len(frame) < 256
    return int(frame) if is_number else None


def frame_key(cell: str) -> int | str:
    """A frame's number, which a table may have written as 3.0, or its name."""
    number = frame_number(cell.removesuffix(".0"))
    return cell if number is None else number


def read_picture(path: Path, error_type: type[DrakePoseError]) -> Picture:
    """Reads a PNG or JPEG picture (H, W, 3) red, green, blue; the error names the file."""
    return decode_colours(_read(path, error_type), path, error_type)


def decode_colours(data: bytes, path: Path, error_type: type[DrakePoseError]) -> Picture:
    """A picture (H, W, 3) red, green, blue of a file's content; the error names the file."""
    picture = _decode(data, cv2.IMREAD_COLOR, path, error_type)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_two_colours(
    path: Path,
    error_type: type[DrakePoseError],
    size: tuple[int | None, int | None] = (None, None),
    *,
    may_be_empty: bool = False,
    lossy: bool = False,
) -> Mask:
    """Reads a mask (H, W): a PNG picture of black and one other colour, the object.

    Args:
        size: width and height that it must have [pixel]; None: any.
        may_be_empty: whether a picture that shows nothing is as good as any.
        lossy: whether a JPEG, whose values its compression blurs, will do: dark, and light.

    The error names the file; when it cannot be read, is damaged, of another size, empty or full, or
    has more than two values.
    """
    data = _read(path, error_type)
    picture = _decode(data, cv2.IMREAD_UNCHANGED, path, error_type, only_png=not lossy)
    found = picture.shape[1], picture.shape[0]
    expected = size[0] or found[0], size[1] or found[1]
    if found != expected:
        raise error_type(
            f"{path}: the mask has {found[0]} x {found[1]} pixels (width x height), but its camera "
            f"has {expected[0]} x {expected[1]}"
        )
    layers = picture[:, :, None] if picture.ndim == 2 else picture
    if layers.shape[2] == 4 and (layers[:, :, 3] == layers[0, 0, 3]).all():
        layers = layers[:, :, :3]  # an alpha channel that says nothing
    elif layers.shape[2] == 4 and (layers[:, :, :3] == layers[0, 0, :3]).all():
        layers = layers[:, :, 3:]  # one that says all
    if data.startswith(b"\xff\xd8"):
        mask, is_one_colour = mask_of_picture(picture, str(path), error_type), True
    else:
        layers = np.ascontiguousarray(layers)
        mask = cv2.inRange(layers, (0, 0, 0, 0), (0, 0, 0, 0)) == 0
        first = np.atleast_1d(layers[np.unravel_index(mask.argmax(), mask.shape)])
        colour = tuple(float(value) for value in first)
        same = cv2.countNonZero(cv2.inRange(layers, colour, colour))
        is_one_colour = not mask.any() or same == np.count_nonzero(mask)
    if mask.all():
        raise error_type(f"{path}: the mask is full (no black pixel): no background to be seen")
    if not (may_be_empty or mask.any()):
        raise error_type(f"{path}: the mask is empty (all black): no object to be seen")
    if not is_one_colour:
        values = len(np.unique(layers.reshape(-1, layers.shape[2]), axis=0))
        raise error_type(
            f"{path}: the mask has {values} values, but must have two: black, and one other on the "
            "object; threshold it first (or give a camera's source a background instead of masks)"
        )
    return np.asarray(mask, dtype=np.bool_)


def list_pictures(folder: Path, error_type: type[DrakePoseError]) -> dict[str, Path]:
    """A folder's picture files by frame, in the order of the names; the error: a frame twice."""
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        # Hidden ones are such as those that macOS leaves behind.
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            if path.stem in files:
                raise error_type(f"{path}: the folder has frame {path.stem} twice; remove one")
            files[path.stem] = path
    return files


def find_pictures(folder: Path, camera: str) -> dict[str, Path]:
    """The pictures of a camera's folder as list_pictures has them; SceneError: there is none."""
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder of camera '{camera}'s pictures")
    files = list_pictures(folder, SceneError)
    if not files:
        raise SceneError(f"{folder}: holds no picture <frame>.png or .jpg of camera '{camera}'")
    return files


def recorded_files(folder: Path, camera: str) -> dict[str, Path] | Path | None:
    """A camera's pictures in the folder of a recording, wherever one is read.

    The files of images/<camera> by frame; where there is no such folder the video
    videos/<camera>.mp4; None: it has neither.

    Raises SceneError: a frame is there twice.
    """
    if (own := folder / "images" / camera).is_dir():
        return list_pictures(own, SceneError)
    videos = (folder / "videos" / f"{camera}{suffix}" for suffix in VIDEOS)
    return next((file for file in videos if file.is_file()), None)


def mask_of_picture(picture: Picture, where: str, error_type: type[DrakePoseError]) -> Mask:
    """The mask (H, W) of a picture (H, W) or (H, W, 3) that compression blurred: what is light.

    The error names the picture by ``where``: much is neither dark nor light.
    """
    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    between = float(((grey > 64) & (grey < 192)).mean())
    if between > 0.1:
        raise error_type(
            f"{where}: {between:.0%} of it is neither dark nor light: no mask but a picture, in "
            "which the object is to be found first (drake-pose masks --background, --box, --model)"
        )
    return np.asarray(grey >= 128, dtype=np.bool_)


def _read(path: Path, error_type: type[DrakePoseError]) -> bytes:
    try:
        return read_regular(path)
    except OSError as error:
        raise error_type(f"{path}: cannot read the picture: {error.strerror}") from error


def _decode(
    data: bytes,
    how: int,
    path: Path,
    error_type: type[DrakePoseError],
    *,
    only_png: bool = False,
) -> Picture:
    """A whole PNG or JPEG picture as OpenCV gives it; the error names a file that is none.

    So are pictures refused whose pixels would fill the memory.
    """
    is_jpeg = data.startswith(b"\xff\xd8") and not only_png
    if is_jpeg and not data.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise error_type(f"{path}: the JPEG picture is cut short")
    # OpenCV's decoders differ from version to version in what they make of half a picture.
    if not (is_jpeg or data.startswith(b"\x89PNG\r\n\x1a\n")):
        raise error_type(f"{path}: not a PNG picture")
    try:
        # Pillow warns of what it takes for a bomb, and raises at twice as many pixels alone.
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as picture:
                width, height = picture.size
                picture.verify()
    except (
        OSError, SyntaxError, ValueError, Image.DecompressionBombError,
        Image.DecompressionBombWarning,
    ) as error:  # fmt: skip
        # What cannot be identified at all is told by its address in the memory.
        why = "" if isinstance(error, UnidentifiedImageError) else f": {error}"
        raise error_type(f"{path}: the picture is cut short, damaged or too large{why}") from error
    if max(width, height) > LARGEST_SIDE:
        raise error_type(
            f"{path}: {width} x {height} pixels are too many: at most {LARGEST_SIDE} a side"
        )
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except cv2.error:
        decoded = None
    if decoded is None:
        raise error_type(f"{path}: not a whole PNG or JPEG picture")
    # Of 16 bits OpenCV keeps the upper eight: 12-bit values would turn black.
    if how == cv2.IMREAD_COLOR and data[24:25] == b"\x10" and not is_jpeg:
        deep = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        brightest = 0 if deep is None else int(deep.max())
        if 0 < brightest < 1 << 12:
            raise error_type(
                f"{path}: 16 bits a pixel, but no value above {brightest} of 65535: its values "
                "have fewer bits; scale them to the whole range, or save the picture in 8 bits"
            )
    return np.asarray(decoded)


def import_reader(library: str, path: Path) -> Any:
    """A library of the extra `episodes`; SceneError, which names both and the file, without it."""
    try:
        return import_module(library)
    except ImportError as error:
        package = library.partition(".")[0]
        raise SceneError(
            f"{path}: is read by {package}: pip install 'drake_pose[episodes]' ({error})"
        ) from error


class VideoPictures:
    """The pictures of a video, counted from 0; SceneError where it cannot be read.

    By OpenCV; AV1, which OpenCV's packages do not decode, as TimedVideo.

    Attributes:
        time: of the picture that was read last [s].
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise SceneError(f"{path}: no such video file")
        self._path, self._capture, self._next = path, cv2.VideoCapture(str(path)), 0
        self.time = 0.0
        if not self._capture.isOpened():
            raise SceneError(f"{path}: not a video that OpenCV can read")
        codec = int(self._capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little")
        self._timed = TimedVideo(path) if codec.upper() == b"AV01" else None

    @property
    def count(self) -> int:
        """How many pictures there are, as the file says."""
        return int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))

    @property
    def rate_hz(self) -> float | None:
        """Pictures a second, where the file says."""
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return rate if rate > 0.0 else None

    def read(self, number: int) -> Picture:
        """A picture (H, W, 3), red, green, blue; SceneError where the video ends before it."""
        if self._timed is not None:
            timed = self._timed.read(number)
            self.time = float(self._timed.times[number])
            return timed
        if number < self._next:
            self._capture.release()
            self._capture, self._next = cv2.VideoCapture(str(self._path)), 0
        # Not every video can be wound to a picture: those between are passed over.
        while self._next < number and self._capture.grab():
            self._next += 1
        found, picture = self._capture.read()
        if self._next < number or not found:
            what = f"is cut short: it ends after {self._next} pictures, but says {self.count}"
            what = what if number < self.count else f"has no picture {number}"
            raise SceneError(
                f"{self._path}: {what}; leave the rest out (--frame), or make it whole: ffmpeg -i "
                f"{self._path.name} -c copy NEW"
            )
        self._next += 1
        self.time = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC)
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


class TimedVideo:
    """The pictures of a video with their times, each read from the keyframe before it, by PyAV.

    The next picture costs one decoding; any other those from the last keyframe before it.

    Attributes:
        times: (n,) of the pictures that the file holds, from the first one on, ascending [s].
        width, height: [pixel].
        warnings: what is wrong with it.

    Raises SceneError: it is no video, has no picture, is cut short so that it cannot be read, or
    PyAV is missing.
    """

    def __init__(self, path: Path) -> None:
        av = import_reader("av", path)
        self._path, self._errors = path, (av.error.FFmpegError, OSError)
        try:
            require_regular(path)
            self._container = av.open(str(path))
            self._stream = self._container.streams.video[0]
        except (*self._errors, IndexError) as error:
            raise SceneError(
                f"{path}: not a video that PyAV can read, or its index is cut off ({error}); copy "
                "or record it again"
            ) from error
        self._packets = list(self._scan())
        if not self._packets:
            raise SceneError(f"{path}: no picture has a time; ffmpeg -i {path.name} NEW.mp4 helps")
        self._stamps = np.array([pts for pts, _ in sorted(self._packets)])
        self._keys = np.array([pts for pts, is_key in sorted(self._packets) if is_key] or [0])
        seconds = float(self._stream.time_base)
        self.times = (self._stamps - self._stamps[0]) * seconds
        self._promised = self._stream.frames or len(self.times)
        self.warnings: list[str] = []
        if self._promised > len(self.times):
            text = f"it ends after {len(self.times)} of {self._promised} pictures"
            self.warnings.append(f"{path}: is cut short: {text}")
        self._frames: Iterator[Any] = iter(())
        self._last: int | None = None
        self.height, self.width = self.read(0).shape[:2]

    def _scan(self) -> Iterator[tuple[int, bool]]:
        """The time stamp of each whole picture that is to be shown, and if it is a keyframe."""
        try:
            for packet in self._container.demux(self._stream):
                if packet.pts is not None and not (packet.is_corrupt or packet.is_discard):
                    yield packet.pts, packet.is_keyframe
        except self._errors:
            return  # What is there is used; _promised says that there was more.

    def _decode(self) -> Iterator[Any]:
        """The pictures from where the file was wound to; a packet that is cut off has none."""
        for packet in self._container.demux(self._stream):
            if not packet.is_corrupt:
                yield from packet.decode()

    def read(self, number: int) -> Picture:
        """A picture (H, W, 3), red, green, blue; SceneError: there is none, or it is damaged."""
        if not 0 <= number < len(self._stamps):
            cut = "is cut short: it " if self._promised > len(self._stamps) else ""
            raise SceneError(f"{self._path}: {cut}has pictures 0 to {len(self._stamps) - 1} only")
        wanted = int(self._stamps[number])
        key = int(self._keys[max(0, int(np.searchsorted(self._keys, wanted, side="right")) - 1)])
        previous = int(self._stamps[number - 1]) if number else None
        follows = self._last is not None and (self._last == previous or key <= self._last < wanted)
        try:
            # From the start where the file's keyframes are not what it says.
            for start in ((None,) if follows else ()) + (key, int(self._stamps[0])):
                if start is not None:
                    self._container.seek(start, stream=self._stream)
                    self._frames = self._decode()
                for frame in self._frames:
                    self._last = frame.pts
                    if frame.pts == wanted:
                        turned = np.rot90(frame.to_ndarray(format="rgb24"), frame.rotation // 90)
                        return np.ascontiguousarray(turned)
                    if frame.pts > wanted:
                        break
            reason = "it is not where its time stamp says"
        except self._errors as error:
            reason = str(error)
        self._last = None
        raise SceneError(f"{self._path}: picture {number} cannot be decoded: {reason}")
