"""Mask files: two-valued PNG pictures, black background."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from drake_pose.camera.checks import LARGEST_SIDE
from drake_pose.camera.picture_files import check_png, split_colours
from drake_pose.errors import MaskError
from drake_pose.regular_files import read_regular


def read_mask(
    path: str | Path,
    width: int | None = None,
    height: int | None = None,
    *,
    may_be_empty: bool = False,
) -> np.ndarray:
    """Reads a mask (H, W): a PNG picture of black (0) and one other value or colour, the object.

    ``may_be_empty``: whether a picture that shows nothing is as good as any.

    Raises:
        MaskError: names the file; when it cannot be read, is no whole PNG picture, is not of
            ``width`` and ``height`` [pixel], is empty or full, or has more than two values.
    """
    path = Path(path)
    try:
        data = read_regular(path)
    except OSError as error:
        raise MaskError(f"{path}: cannot read the mask: {error.strerror}") from error
    found = check_png(data, path, MaskError)
    if max(found) > LARGEST_SIDE:
        raise MaskError(f"{path}: {found[0]} x {found[1]} pixels are too many")
    expected = (found[0] if width is None else width, found[1] if height is None else height)
    if found != expected:
        raise MaskError(
            f"{path}: the mask has {found[0]} x {found[1]} pixels (width x height), but its camera "
            f"has {expected[0]} x {expected[1]}"
        )
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise MaskError(f"{path}: the PNG picture is damaged")
    return _to_mask(picture, path, may_be_empty)


def write_mask(path: str | Path, mask: np.ndarray) -> None:
    """Writes a mask (H, W) as a grey PNG, 255 on the object; MaskError names an unwritable file."""
    try:
        Path(path).write_bytes(encode_mask(mask))
    except OSError as error:
        raise MaskError(f"{path}: cannot write the mask: {error.strerror}") from error


def encode_mask(mask: np.ndarray) -> bytes:
    """Returns a mask (H, W) as the content of a grey PNG file, 255 on the object."""
    return cv2.imencode(".png", np.where(mask, 255, 0).astype(np.uint8))[1].tobytes()


def _to_mask(picture: np.ndarray, path: Path, may_be_empty: bool) -> np.ndarray:
    """Returns the mask of a decoded picture (H, W) or (H, W, channels)."""
    layers = picture[:, :, None] if picture.ndim == 2 else picture
    if layers.shape[2] == 4 and (layers[:, :, 3] == layers[0, 0, 3]).all():
        layers = layers[:, :, :3]  # an alpha channel that says nothing
    elif layers.shape[2] == 4 and (layers[:, :, :3] == layers[0, 0, :3]).all():
        layers = layers[:, :, 3:]  # one that says all
    mask, is_one_colour = split_colours(np.ascontiguousarray(layers))
    if not mask.any():
        if may_be_empty:
            return mask
        raise MaskError(f"{path}: the mask is empty (all black): no object to be seen")
    if mask.all():
        raise MaskError(f"{path}: the mask is full (no black pixel): no background to be seen")
    if not is_one_colour:
        values = len(np.unique(layers.reshape(-1, layers.shape[2]), axis=0))
        raise MaskError(
            f"{path}: the mask has {values} values, but must have two: black, and one other on the "
            "object; threshold it first"
        )
    return mask
