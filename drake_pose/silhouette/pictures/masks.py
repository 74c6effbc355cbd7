"""Mask files, two-valued PNG pictures, and how masks agree."""

import io
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
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
    """Reads a mask (H, W): a PNG picture of black (0) and one other value or colour, the object.

    ``may_be_empty``: whether a picture that shows nothing is as good as any.

    Raises MaskError: names the file; when it cannot be read, is no whole PNG picture, is not of
    ``width`` and ``height`` [pixel], is empty or full, or has more than two values.
    """
    size = width, height
    return read_binary_mask(Path(path), MaskError, size, may_be_empty=may_be_empty)


def write_mask(path: str | Path, mask: np.ndarray) -> None:
    """Writes a mask (H, W) as encode_mask does; MaskError names an unwritable file."""
    try:
        Path(path).write_bytes(encode_mask(mask))
    except OSError as error:
        raise MaskError(f"{path}: cannot write the mask: {error.strerror}") from error


def encode_mask(mask: np.ndarray) -> bytes:
    """Returns a mask (H, W) as the content of a black and white PNG file, white on the object."""
    stream = io.BytesIO()
    # A bit a pixel is read in a third of the time of a byte. Areas are runs, which need no search.
    image = Image.fromarray(np.asarray(mask, dtype=np.bool_))
    image.save(stream, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return stream.getvalue()


@dataclass(frozen=True)
class MaskAgreement:
    """How a frame's silhouettes and body agree.

    Args:
        wrong: the area where they differ [pixel].
        area: the silhouettes' [pixel].
        ious: intersection over union by camera.
    """

    wrong: int
    area: int
    ious: Mapping[str, float]

    @property
    def E_total(self) -> float:
        """The area where they differ over the silhouettes' area; NaN without a silhouette."""
        return self.wrong / self.area if self.area else float("nan")


def intersection_over_union(one: np.ndarray, other: np.ndarray) -> float:
    """Of two masks (H, W) bool; 1 where both are empty."""
    return _overlap(one, other)[2]


def _overlap(one: np.ndarray, other: np.ndarray) -> tuple[int, int, float]:
    """The area where two masks differ, that of the first [pixel], and intersection over union."""
    own, others, both = (int(np.count_nonzero(area)) for area in (one, other, one & other))
    either = own + others - both
    return either - both, own, both / either if either else 1.0


def compare_masks(
    masks: Mapping[str, np.ndarray], bodies: Mapping[str, np.ndarray]
) -> MaskAgreement:
    """Compares masks (H, W) bool with the body's, both by camera."""
    found = {camera: _overlap(mask, bodies[camera]) for camera, mask in masks.items()}
    return MaskAgreement(
        sum(wrong for wrong, _, _ in found.values()),
        sum(area for _, area, _ in found.values()),
        {camera: iou for camera, (_, _, iou) in found.items()},
    )


def count_edge_pixels(mask: np.ndarray) -> int:
    """How many pixels of a mask (H, W) bool lie on its edge."""
    # What a mask loses to a pixel's neighbours is its edge.
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    inner = cv2.erode(mask.view(np.uint8), cross)
    return int(np.count_nonzero(mask)) - int(np.count_nonzero(inner))


def signed_distances(mask: np.ndarray) -> np.ndarray:
    """(H, W) float32 distance from the edge of a mask, half way between pixels; positive outside.

    The picture's edge is no edge of the mask.
    """
    inside = np.asarray(mask, dtype=np.uint8)
    if inside.all():
        return np.full(mask.shape, -float(max(mask.shape)), dtype=np.float32)
    within = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beyond = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.where(inside > 0, 0.5 - within, beyond - 0.5).astype(np.float32)
