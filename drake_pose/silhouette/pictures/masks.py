"""Mask files, two-valued PNG pictures, and how masks agree."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from drake_pose.camera.picture_files import read_two_colours
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
    return read_two_colours(Path(path), MaskError, size, may_be_empty=may_be_empty)


def write_mask(path: str | Path, mask: np.ndarray) -> None:
    """Writes a mask (H, W) as a grey PNG, 255 on the object; MaskError names an unwritable file."""
    try:
        Path(path).write_bytes(encode_mask(mask))
    except OSError as error:
        raise MaskError(f"{path}: cannot write the mask: {error.strerror}") from error


def encode_mask(mask: np.ndarray) -> bytes:
    """Returns a mask (H, W) as the content of a grey PNG file, 255 on the object."""
    return cv2.imencode(".png", np.where(mask, 255, 0).astype(np.uint8))[1].tobytes()


# A pixel's neighbours: what a mask loses to them is its edge.
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True)
class MaskAgreement:
    """How a frame's silhouettes and body agree: intersection over union by camera, and E_total.

    E_total: the area where they differ over the silhouettes' area; NaN without a silhouette.
    """

    E_total: float
    ious: Mapping[str, float]


def intersection_over_union(one: np.ndarray, other: np.ndarray) -> float:
    """Of two masks (H, W) bool; 1 where both are empty."""
    own, others, both = map(np.count_nonzero, (one, other, one & other))
    either = int(own + others - both)
    return int(both) / either if either else 1.0


def compare_masks(
    masks: Mapping[str, np.ndarray], bodies: Mapping[str, np.ndarray]
) -> MaskAgreement:
    """Compares masks (H, W) bool with the body's, both by camera."""
    wrong, area = 0, 0
    ious: dict[str, float] = {}
    for camera, mask in masks.items():
        wrong += int(np.count_nonzero(mask ^ bodies[camera]))
        area += int(np.count_nonzero(mask))
        ious[camera] = intersection_over_union(mask, bodies[camera])
    return MaskAgreement(wrong / area if area else float("nan"), ious)


def edge_area(mask: np.ndarray) -> int:
    """How many pixels of a mask (H, W) bool lie on its edge."""
    inner = cv2.erode(mask.view(np.uint8), _CROSS)
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
