"""Read images, masks and videos from files, and order frames by name."""

import io
import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import reduce
from importlib import import_module
from pathlib import Path, PurePath
from typing import Any

import av
import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.models import LARGEST_SIDE
from drake_pose.errors import DrakePoseError, SceneError
from drake_pose.input_files import pointer_hint, read_regular, require_regular

SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg")
"""Suffixes of image and video files."""


def natural_key(name: str) -> tuple[tuple[str, int], ...]:
    """Return a sort key of texts and numbers, by which 2 precedes 10."""
    texts = re.split("([0-9]+)", name)
    return tuple(zip(texts[::2], [*map(int, texts[1::2]), -1], strict=True))


def in_order(frames: Iterable[str]) -> tuple[str, ...]:
    """Return unique frames in natural order."""
    return tuple(sorted(set(frames), key=lambda name: (natural_key(name), name)))


def frame_number(frame: str) -> int | None:
    """Return the number that a frame's name consists of; None if it has other characters."""
    # File names are shorter; Python refuses to parse numbers with thousands of digits.
    is_number = frame.isascii() and frame.isdigit() and len(frame) < 256
    return int(frame) if is_number else None


def frame_key(cell: str) -> int | str:
    """Return the number in a table's cell for a frame, such as 3, 003 or 3.0, or else its name."""
    number = frame_number(cell.removesuffix(".0"))
    return cell if number is None else number


def read_picture(path: Path) -> Picture:
    """Return a PNG or JPEG image (H, W, 3) red, green, blue.

    Raises SceneError: the file is unreadable; the message names it.
    """
    try:
        return decode_colours(_read(path), path)
    except SceneError as error:
        if hint := pointer_hint(path):
            raise SceneError(f"{error}{hint}") from None
        raise


def decode_colours(data: bytes, path: Path) -> Picture:
    """Return an image (H, W, 3) red, green, blue from the ``data`` of a PNG or JPEG file.

    Raises SceneError, which names the file at ``path``: the content is invalid.
    """
    picture = _decode(data, cv2.IMREAD_COLOR, path)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def picture_size(path: Path) -> tuple[int, int] | None:
    """Return width and height [pixel] of a PNG or JPEG image, without decoding its pixels.

    The file is as whole as `read_picture` asks. None: a check needs the pixels, or the file's EXIF
    data may turn the image. Raises SceneError, which names the file: it is unreadable.
    """
    data = _read(path)
    size = _require_whole(data, path)
    is_deep_png = data[24:25] == b"\x10" and data.startswith(b"\x89PNG")
    return None if is_deep_png or b"eXIf" in data or b"Exif\0" in data else size


def read_binary_mask(
    path: Path,
    size: tuple[int | None, int | None] = (None, None),
    *,
    may_be_empty: bool = False,
    lossy: bool = False,
) -> Mask:
    """Return a mask (H, W) from a PNG image of black and one other colour on the object.

    Args:
        path: the file.
        size: required width and height [pixel]; None: any.
        may_be_empty: accept a mask without any object.
        lossy: accept JPEG files, too; their pixels of 128 or brighter are the object.

    Raises SceneError: the file is unreadable, damaged, of another size, empty or full, or has more
    than two values; the message names it.
    """
    data = _read(path)
    picture = _decode(data, cv2.IMREAD_UNCHANGED, path, only_png=not lossy)
    found = picture.shape[1], picture.shape[0]
    expected = size[0] or found[0], size[1] or found[1]
    if found != expected:
        raise SceneError(
            f"{path}: the mask has {found[0]} x {found[1]} pixels (width x height), but its camera "
            f"has {expected[0]} x {expected[1]}"
        )
    layers = cv2.split(picture)
    if len(layers) == 4:
        # The alpha channel is left out if it is constant, and used alone if only it varies.
        varies = [bool((one != one[0, 0]).any()) for one in layers]
        layers = layers[:3] if not varies[3] else layers if any(varies[:3]) else layers[3:]
    if data.startswith(b"\xff\xd8"):
        mask, is_one_colour = threshold_mask(picture, str(path)), True
    else:
        mask = reduce(np.bitwise_or, layers) != 0
        areas = [one[mask] for one in layers]
        is_one_colour = not mask.any() or all(one.min() == one.max() for one in areas)
    if mask.all():
        raise SceneError(f"{path}: the mask is full (no black pixel): it shows no background")
    if not (may_be_empty or mask.any()):
        raise SceneError(f"{path}: the mask is empty (all black): it shows no object")
    if not is_one_colour:
        values = len(np.unique(np.stack(layers, axis=-1).reshape(-1, len(layers)), axis=0))
        raise SceneError(
            f"{path}: the mask has {values} values, but must have two, black and one other on the "
            "object: threshold it first (or give the camera's source a background instead of masks)"
        )
    return np.asarray(mask, dtype=np.bool_)


def list_pictures(folder: Path) -> dict[str, Path]:
    """Return a folder's PNG and JPEG files by frame, the name without suffix, sorted by name.

    Raises SceneError: a frame occurs twice, with different suffixes.
    """
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        # Skip hidden files, such as those of macOS.
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            if path.stem in files:
                raise SceneError(f"{path}: the folder has frame {path.stem} twice; remove one")
            files[path.stem] = path
    return files


def find_pictures(folder: Path, camera: str) -> dict[str, Path]:
    """Return the image files of a camera's folder by frame, sorted by name, at least one.

    Raises SceneError: there is no such folder or no image, or a frame occurs twice.
    """
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder of camera '{camera}'s pictures")
    files = list_pictures(folder)
    if not files:
        raise SceneError(f"{folder}: has no picture <frame>.png or .jpg of camera '{camera}'")
    return files


def find_recorded_files(folder: Path, camera: str) -> dict[str, Path] | Path | None:
    """Return a camera's images in a recording's folder: files by frame, a video's path, or None.

    These are the files in images/<camera>, or else videos/<camera>.mp4 or another video suffix.
    Raises SceneError: a frame occurs twice.
    """
    if (own := folder / "images" / camera).is_dir():
        return list_pictures(own)
    videos = (folder / "videos" / f"{camera}{suffix}" for suffix in VIDEOS)
    return next((file for file in videos if file.is_file()), None)


def threshold_mask(picture: Picture, where: str) -> Mask:
    """Return the mask (H, W) of the pixels with grey values of 128 or more.

    ``picture``: (H, W) grey values or (H, W, 3) colours of a lossily compressed mask. Raises
    SceneError, begun by ``where``: over a tenth of the grey values are between 64 and 192.
    """
    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    between = float(((grey > 64) & (grey < 192)).mean())
    if between > 0.1:
        raise SceneError(
            f"{where}: {between:.0%} of it is neither dark nor light, so it is a picture and not a "
            "mask: segment the object first (drake-pose masks --background, or a network)"
        )
    return np.asarray(grey >= 128, dtype=np.bool_)


def _read(path: Path) -> bytes:
    """Return a file's content, or raise the error."""
    try:
        return read_regular(path)
    except OSError as error:
        raise SceneError(f"{path}: cannot read the picture: {error.strerror}") from error


def _decode(data: bytes, how: int, path: Path, *, only_png: bool = False) -> Picture:
    """Return a complete PNG or JPEG image as OpenCV decodes it: blue, green, red, or grey values.

    ``data``, ``path``, ``only_png``: as of `_require_whole`, whose errors are
    raised. ``how``: OpenCV's reading mode, which determines the shape.
    """
    _require_whole(data, path, only_png=only_png)
    is_deep = how == cv2.IMREAD_COLOR and data[24:25] == b"\x10" and data[:1] != b"\xff"
    how |= cv2.IMREAD_ANYDEPTH if is_deep else 0
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except cv2.error:
        decoded = None
    if decoded is None:
        raise SceneError(f"{path}: not a whole PNG or JPEG picture")
    return upper_bits(decoded, str(path)) if is_deep else np.asarray(decoded)


def _require_whole(data: bytes, path: Path, *, only_png: bool = False) -> tuple[int, int]:
    """Return width and height of a complete PNG or JPEG image [pixel]; pixels are not decoded.

    ``only_png``: refuse JPEG. Raises SceneError, which names ``path``: the content is no such
    image, damaged, or so large that it would fill the memory.
    """
    is_jpeg = data.startswith(b"\xff\xd8") and not only_png
    if is_jpeg and not data.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise SceneError(f"{path}: the JPEG picture is truncated")
    # Check completeness here, because OpenCV's versions differ in decoding truncated images.
    if not (is_jpeg or data.startswith(b"\x89PNG\r\n\x1a\n")):
        raise SceneError(f"{path}: not a PNG{'' if only_png else ' or JPEG'} picture")
    try:
        # Pillow only warns of decompression bombs up to twice its limit: raise there, too.
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as picture:
                width, height = picture.size
                picture.verify()
    except (
        OSError, SyntaxError, ValueError, Image.DecompressionBombError,
        Image.DecompressionBombWarning,
    ) as error:  # fmt: skip
        # Pillow's message for an unidentified image only has a memory address.
        why = "" if isinstance(error, UnidentifiedImageError) else f": {error}"
        raise SceneError(f"{path}: the picture is truncated, damaged or too large{why}") from error
    if max(width, height) > LARGEST_SIDE:
        raise SceneError(
            f"{path}: {width} x {height} pixels are too many: at most {LARGEST_SIDE} a side"
        )
    return width, height


def upper_bits(picture: Any, where: str) -> Picture:
    """Return the upper 8 bits of an image's 16-bit values, in the same shape.

    Raises SceneError, begun by ``where``: the values use fewer than 13 bits, so that the result
    would be black.
    """
    brightest = int(picture.max())
    if 0 < brightest < 1 << 12:
        raise SceneError(
            f"{where}: has 16 bits per pixel, but no value above {brightest} of 65535: scale its "
            "values to the whole range, or save the picture with 8 bits"
        )
    return np.asarray(picture >> 8, dtype=np.uint8)


def path_inside(folder: Path, name: str, key: str) -> Path:
    """Return the path of a file that a recording names by its path from the recording's folder.

    ``key``: the key that has the name, and its file, for messages. Raises SceneError: the path is
    absolute or has a part "..", so that a file outside the folder would be opened.
    """
    if PurePath(name).is_absolute() or ".." in PurePath(name.replace("\\", "/")).parts:
        raise SceneError(
            f"{key}: '{name}' leads out of {folder}, and no other file is opened: give a path "
            "from that folder without '..', or put the files there"
        )
    return folder / name


@contextmanager
def naming_damage(path: Path, what: str) -> Iterator[None]:
    """Convert any error that a library raises on a damaged file to a SceneError.

    ``path``: the file. ``what``: what is wrong with it, for the message.
    """
    try:
        yield
    except DrakePoseError:
        raise
    except Exception as error:  # The libraries' errors have no common base class.
        text = f"{path}: {what} ({type(error).__name__}: {error}){pointer_hint(path)}"
        raise SceneError(text) from error


def import_reader(library: str, path: Path) -> Any:
    """Import a library of the extra `episodes` for a file; SceneError: it is not installed."""
    try:
        return import_module(library)
    except ImportError as error:
        package = library.partition(".")[0]
        raise SceneError(
            f"{path}: needs {package} to be read: pip install 'drake_pose[episodes]' ({error})"
        ) from error


class Video:
    """Images of a video with their times, decoded by PyAV.

    The next image costs one decoding; any other one is decoded from the preceding keyframe.

    Attributes:
        path: the file.
        times: (n,) ascending times of the images [s]. Those of MP4, MOV, Matroska and WebM are the
            file's presentation times, so the first one may be later than 0. The clocks of AVI and
            MPEG begin anywhere: their times are relative to the first image.
        promised: number of images according to the file; more than there are if it is truncated.
        rate_hz: images per second according to the file; None if unknown.
        width, height: size of the images [pixel].
        warnings: problems of the file.

    Raises:
        SceneError: it is not a video, has no image, or is truncated and unreadable.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._errors = path, (av.error.FFmpegError, OSError)
        try:
            require_regular(path)
            self._container = av.open(str(path))
            self._stream = self._container.streams.video[0]
        except (*self._errors, IndexError) as error:
            raise SceneError(
                f"{path}: not a video that PyAV can read, or its index is missing ({error}); copy "
                f"or record it again{pointer_hint(path)}"
            ) from error
        self._packets = list(self._scan())
        if not self._packets:
            raise SceneError(f"{path}: no picture has a time; ffmpeg -i {path.name} NEW.mp4 helps")
        self._stamps = np.array([pts for pts, _ in sorted(self._packets)])
        self._keys = np.array([pts for pts, is_key in sorted(self._packets) if is_key] or [0])
        seconds = float(self._stream.time_base or 1)
        is_timeline = {"mp4", "webm"} & {*self._container.format.name.split(",")}
        self.times = (self._stamps - (0 if is_timeline else self._stamps[0])) * seconds
        self.promised = self._stream.frames or len(self.times)
        rate = self._stream.guessed_rate
        self.rate_hz = float(rate) if rate else None
        self.warnings: list[str] = []
        if self.promised > len(self.times):
            text = f"it ends after {len(self.times)} of {self.promised} pictures"
            self.warnings.append(f"{path}: is truncated: {text}")
        self._frames: Iterator[Any] = iter(())
        self._last: int | None = None
        self.height, self.width = self.read(0).shape[:2]

    def _scan(self) -> Iterator[tuple[int, bool]]:
        """Yield each complete image's time stamp [stream's time base], and whether a keyframe."""
        try:
            for packet in self._container.demux(self._stream):
                if packet.pts is not None and not (packet.is_corrupt or packet.is_discard):
                    yield packet.pts, packet.is_keyframe
        except self._errors:
            return  # Use the images so far; ``promised`` reveals that some are missing.

    def _decode(self) -> Iterator[Any]:
        """Yield PyAV's frames from the current position; truncated packets are skipped."""
        for packet in self._container.demux(self._stream):
            if not packet.is_corrupt:
                yield from packet.decode()

    def read(self, number: int) -> Picture:
        """Return an image (H, W, 3) by its number from 0, red, green, blue.

        Raises SceneError: it is missing or damaged.
        """
        if not 0 <= number < len(self._stamps):
            cut = "is truncated: it " if self.promised > len(self._stamps) else ""
            raise SceneError(f"{self.path}: {cut}has pictures 0 to {len(self._stamps) - 1} only")
        wanted = int(self._stamps[number])
        key = int(self._keys[max(0, int(np.searchsorted(self._keys, wanted, side="right")) - 1)])
        previous = int(self._stamps[number - 1]) if number else None
        follows = self._last is not None and (self._last == previous or key <= self._last < wanted)
        try:
            # Retry from the start, in case the file's keyframe flags are wrong.
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
        raise SceneError(f"{self.path}: picture {number} cannot be decoded: {reason}")
