"""Pictures and masks in files: whole ones only, in one form; and the order of frames' names."""

import io
import re
import warnings
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.models import LARGEST_SIDE
from drake_pose.errors import DrakePoseError
from drake_pose.regular_files import read_regular

SUFFIXES = (".png", ".jpg", ".jpeg")

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_DAMAGE = (
    OSError, SyntaxError, ValueError, Image.DecompressionBombError, Image.DecompressionBombWarning
)  # fmt: skip
# A lossy picture of a mask is white from here on.
_HALF = 128
_NUMBER = re.compile("([0-9]+)")
# No file's name is longer; Python refuses to read numbers of thousands of digits.
_LONGEST_NAME = 256


def natural_key(name: str) -> tuple[tuple[str, int], ...]:
    """What names are sorted by: texts and the numbers in them in turn, so that 2 precedes 10."""
    texts = _NUMBER.split(name)
    return tuple(zip(texts[::2], [*map(int, texts[1::2]), -1], strict=True))


def in_order(frames: Iterable[str]) -> tuple[str, ...]:
    """Frames in natural order, each once."""
    return tuple(sorted(set(frames), key=lambda name: (natural_key(name), name)))


def frame_number(frame: str) -> int | None:
    """Returns the number that a frame's name is, or None."""
    is_number = frame.isascii() and frame.isdigit() and len(frame) < _LONGEST_NAME
    return int(frame) if is_number else None


def frame_key(cell: str) -> int | str:
    """A frame's number, which a table may have written as 3.0, or its name."""
    number = frame_number(cell.removesuffix(".0"))
    return cell if number is None else number


def read_picture(path: Path, error_type: type[DrakePoseError]) -> Picture:
    """Reads a PNG or JPEG picture (H, W, 3) red, green, blue; the error names the file."""
    return decode_colours(_read(path, error_type), path, error_type)


def decode_colours(data: bytes, path: Path, error_type: type[DrakePoseError]) -> Picture:
    """A picture (H, W, 3) red, green, blue of a file's content; the error as read_picture_file."""
    _check_content(data, path, error_type)
    picture = decode_picture(data, cv2.IMREAD_COLOR, path, error_type)
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
    data = read_picture_file(path, error_type, only_png=not lossy)
    picture = decode_picture(data, cv2.IMREAD_UNCHANGED, path, error_type)
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
    if data.startswith(_JPEG):
        mask, is_one_colour = mask_of_picture(picture), True
    else:
        mask, is_one_colour = _split_colours(np.ascontiguousarray(layers))
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
        if path.suffix.lower() in SUFFIXES:
            if path.stem in files:
                raise error_type(f"{path}: the folder has frame {path.stem} twice; remove one")
            files[path.stem] = path
    return files


def _split_colours(picture: NDArray[np.integer]) -> tuple[Mask, bool]:
    """Where a picture (H, W) or (H, W, channels) is not black, and if that is all of one colour."""
    mask = cv2.inRange(picture, (0, 0, 0, 0), (0, 0, 0, 0)) == 0
    first = np.atleast_1d(picture[np.unravel_index(mask.argmax(), mask.shape)])
    colour = tuple(float(value) for value in first)
    same = cv2.countNonZero(cv2.inRange(picture, colour, colour))
    return mask, not mask.any() or same == np.count_nonzero(mask)


def mask_of_picture(picture: Picture) -> Mask:
    """The mask (H, W) of a picture (H, W) or (H, W, 3) that compression blurred: what is light."""
    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    return np.asarray(grey >= _HALF, dtype=np.bool_)


def read_picture_file(
    path: Path, error_type: type[DrakePoseError], *, only_png: bool = False
) -> bytes:
    """A whole PNG or JPEG file's content, as far as its frame tells; the error names the file.

    So are pictures refused whose pixels would fill the memory.
    """
    data = _read(path, error_type)
    _check_content(data, path, error_type, only_png)
    return data


def _read(path: Path, error_type: type[DrakePoseError]) -> bytes:
    try:
        return read_regular(path)
    except OSError as error:
        raise error_type(f"{path}: cannot read the picture: {error.strerror}") from error


def _check_content(
    data: bytes, path: Path, error_type: type[DrakePoseError], only_png: bool = False
) -> None:
    """Raises what read_picture_file raises of a file's content."""
    is_jpeg = data.startswith(_JPEG) and not only_png
    if is_jpeg and not data.rstrip(b"\0").endswith(_JPEG_END):
        raise error_type(f"{path}: the JPEG picture is cut short")
    # OpenCV's decoders differ from version to version in what they make of half a picture.
    if not (is_jpeg or data.startswith(_PNG)):
        raise error_type(f"{path}: not a PNG picture")
    try:
        # Pillow warns of what it takes for a bomb, and raises at twice as many pixels alone.
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as picture:
                width, height = picture.size
                picture.verify()
    except _DAMAGE as error:
        # What cannot be identified at all is told by its address in the memory.
        why = "" if isinstance(error, UnidentifiedImageError) else f": {error}"
        raise error_type(f"{path}: the picture is cut short, damaged or too large{why}") from error
    if max(width, height) > LARGEST_SIDE:
        raise error_type(
            f"{path}: {width} x {height} pixels are too many: at most {LARGEST_SIDE} a side"
        )


def decode_picture(data: bytes, how: int, path: Path, error_type: type[DrakePoseError]) -> Picture:
    """A picture as OpenCV gives it, of read_picture_file; the error names a file that is none."""
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except cv2.error:
        picture = None
    if picture is None:
        raise error_type(f"{path}: not a whole PNG or JPEG picture")
    return np.asarray(picture)
