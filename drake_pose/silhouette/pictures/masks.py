"""Mask files (two-valued PNG pictures), and measures of agreement between masks."""

import io
import zlib
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from drake_pose.camera.picture_files import read_binary_mask
from drake_pose.errors import MaskError


def read_mask(
    path: str | Path,
    width: int | None = None,
    height: int | None = None,
    *,
    may_be_empty: bool = False,
) -> np.ndarray:
    """Return the mask (H, W) of a PNG picture with black (0) and one other colour, the object's.

    ``width``, ``height``: required size [pixel]; None: any. ``may_be_empty``: whether a picture
    without an object is accepted. Raises MaskError, which names the file: it cannot be read, is no
    complete PNG picture, has the wrong size, is empty or full, or has more than two colours.
    """
    size = width, height
    return read_binary_mask(Path(path), MaskError, size, may_be_empty=may_be_empty)


def write_mask(path: str | Path, mask: np.ndarray) -> None:
    """Write a mask (H, W) as ``encode_mask`` does; MaskError names an unwritable file."""
    try:
        Path(path).write_bytes(encode_mask(mask))
    except OSError as error:
        raise MaskError(f"{path}: cannot write the mask: {error.strerror}") from error


def encode_mask(mask: np.ndarray) -> bytes:
    """Return a mask (H, W) as the content of a black and white PNG file, white on the object."""
    stream = io.BytesIO()
    # One bit per pixel is read three times as fast as one byte; run-length coding suits areas.
    image = Image.fromarray(np.asarray(mask, dtype=np.bool_))
    image.save(stream, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return stream.getvalue()


def intersection_over_union(first: np.ndarray, second: np.ndarray) -> float:
    """Return the intersection over union of two masks (H, W) bool; 1 if both are empty."""
    return _overlap(first, second)[2]


def _overlap(first: np.ndarray, second: np.ndarray) -> tuple[int, int, float]:
    """Return where two masks (H, W) differ, the first's area [pixel], and the IoU (1: empty)."""
    first_area, second_area, intersection = (
        int(np.count_nonzero(area)) for area in (first, second, first & second)
    )
    union = first_area + second_area - intersection
    return union - intersection, first_area, intersection / union if union else 1.0


def compare_masks(
    masks: Mapping[str, np.ndarray], bodies: Mapping[str, np.ndarray]
) -> tuple[float, dict[str, float]]:
    """Return E_total and intersection over union by camera of silhouettes and ``bodies``.

    Both are (H, W) bool by camera. E_total is the area where they differ, divided by the
    silhouettes' area, both summed over the cameras; NaN without a silhouette.
    """
    found = {camera: _overlap(mask, bodies[camera]) for camera, mask in masks.items()}
    differing, area = (sum(one[k] for one in found.values()) for k in (0, 1))
    E_total = differing / area if area else float("nan")
    return E_total, {camera: iou for camera, (_, _, iou) in found.items()}


def count_edge_pixels(mask: np.ndarray) -> int:
    """Return the number of pixels on the edge of a mask (H, W) bool."""
    # The edge is removed by erosion with the four neighbours.
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    inner = cv2.erode(mask.view(np.uint8), cross)
    return int(np.count_nonzero(mask)) - int(np.count_nonzero(inner))


def signed_distances(mask: np.ndarray) -> np.ndarray:
    """Return (H, W) float32 distances [pixel] to the edge of a mask; positive outside.

    The edge runs half-way between pixels. The image border is not an edge of the mask.
    """
    inside = np.asarray(mask, dtype=np.uint8)
    if inside.all():
        return np.full(mask.shape, -float(max(mask.shape)), dtype=np.float32)
    within = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beyond = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.where(inside > 0, 0.5 - within, beyond - 0.5).astype(np.float32)
