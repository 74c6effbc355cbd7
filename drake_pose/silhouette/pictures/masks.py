"""Mask files: two-valued PNG pictures and COCO files. Measures of agreement between masks."""

import io
import json
import re
import zlib
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np
from PIL import Image

from drake_pose.arrays import Mask
from drake_pose.camera.models import LARGEST_SIDE
from drake_pose.camera.picture_files import read_binary_mask
from drake_pose.errors import MaskError, SceneError
from drake_pose.input_files import read_regular


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
    try:
        return read_binary_mask(Path(path), (width, height), may_be_empty=may_be_empty)
    except SceneError as error:
        raise MaskError(str(error)) from None


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


LARGEST_COCO = 1 << 30
"""Largest size of a COCO file [byte]."""


@dataclass(frozen=True)
class AnnotatedPicture:
    """A picture of a COCO file with its annotations."""

    source: Path  # The COCO file.
    name: str  # Name of the picture's file in the COCO file.
    file: PurePosixPath  # The file that was annotated, see `original_files`.
    # height, width: size [pixel].
    height: int
    width: int
    # Name and number of the class, and segmentation (empty: a box alone), of each annotation.
    areas: list[tuple[str, str, Any]]

    def draw(self, classes: Container[str]) -> Mask:
        """Return the union (H, W) of the areas of named classes; ValueError: one is damaged."""
        mask = np.zeros((self.height, self.width), dtype=np.bool_)
        for name, _, area in self.areas:
            if name in classes and area:
                mask |= draw_area(area, self.height, self.width)
        return mask


def is_coco(path: Path) -> bool:
    """Return whether a JSON file has annotations of pictures, as COCO files do."""
    content = read_regular(path, LARGEST_COCO)
    return b'"annotations"' in content and b'"images"' in content


def read_coco(path: Path) -> list[AnnotatedPicture]:
    """Read the pictures of a COCO file; MaskError names the file and what is invalid."""
    try:
        content = json.loads(read_regular(path, LARGEST_COCO))
        names = {one["id"]: str(one["name"]) for one in content.get("categories", ())}
        pictures: dict[Any, AnnotatedPicture] = {}
        originals = original_files(content["images"])
        for one, original in zip(content["images"], originals, strict=True):
            if one["id"] in pictures:
                raise ValueError(f"image {one['id']} is given twice")
            file, height, width = (one[key] for key in ("file_name", "height", "width"))
            if not all(isinstance(k, int) and 1 < k <= LARGEST_SIDE for k in (height, width)):
                raise ValueError(
                    f"width and height must be whole numbers of 2 to {LARGEST_SIDE} pixels"
                )
            if not (original.name and str(original).isprintable()):
                raise ValueError(f"{file!r} is not a name of a picture file")
            pictures[one["id"]] = AnnotatedPicture(path, str(file), original, height, width, [])
        for one in content["annotations"]:
            number = one["category_id"]
            area = (names.get(number, str(number)), str(number), one.get("segmentation"))
            pictures[one["image_id"]].areas.append(area)
    except OSError as error:
        raise MaskError(f"{path}: cannot be read: {error.strerror}") from error
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise MaskError(
            f"{path}: is not a COCO file, which has images and their annotations: {what}"
        ) from error
    return list(pictures.values())


def original_files(images: Iterable[Mapping[str, Any]]) -> list[PurePosixPath]:
    """Return the files that were given to the tool that wrote a COCO file's ``images``.

    Paths may be Windows', URLs, or the parameter ``d`` of Label Studio's URLs. Label Studio puts
    eight random hexadecimal digits and a hyphen (or two underscores) before each name; Roboflow
    puts the suffix and a hash behind it, `0000_jpg.rf.<hash>.jpg`, and keeps the name in ``extra``.
    """
    files = []
    for one in images:
        name: str = one["file_name"]
        url = urlsplit(name)
        local = re.search(r"(?:^|&)d=([^&]+)", url.query)
        text = local[1] if local else url.path if url.netloc else name
        parts = unquote(text).replace("\\", "/").split("/")
        extra = one.get("extra")
        if isinstance(extra, dict) and extra.get("name"):
            parts[-1:] = str(extra["name"]).replace("\\", "/").split("/")
        file = PurePosixPath(*(part for part in parts if part != ".." and not part.endswith(":")))
        if exported := re.fullmatch(r"(.+)_([A-Za-z]{3,4})\.rf\.[^.]+", file.stem):
            file = file.with_name(f"{exported[1]}.{exported[2]}")
        files.append(file)
    while True:
        prefixes = [re.match("[0-9a-f]{8}(?:-|__)(?=.+[.])", file.name) for file in files]
        found = {prefix[0] for prefix in prefixes if prefix}
        if len(found) < len(files) or not re.search("[a-f]", "".join(found)):
            return files
        files = [file.with_name(re.split("-|__", file.name, maxsplit=1)[1]) for file in files]


def draw_area(area: Any, height: int, width: int) -> Mask:
    """Return the area (H, W) of a COCO segmentation in a picture of height x width pixels.

    ``area``: a list of polygons x0, y0, x1, y1, ... [pixel], or a mapping with size and counts:
    lengths of alternate runs of 0 and 1, column after column, or COCO's compressed text.

    Raises ValueError, TypeError or KeyError: the area is damaged; MaskError: pycocotools is not
    installed.
    """
    try:
        from pycocotools import mask as coco
    except ImportError as error:
        raise MaskError(
            "the areas of a COCO file are drawn by pycocotools: pip install 'drake_pose[coco]'"
        ) from error
    if isinstance(area, list):
        for polygon in area:
            corners = np.array(polygon, dtype=np.float64)
            if corners.size < 6 or corners.size % 2 or not (abs(corners) <= LARGEST_SIDE).all():
                raise ValueError("a polygon needs three or more corners x, y near the picture")
        drawn = coco.decode(coco.merge(coco.frPyObjects(area, height, width)))
        return np.asarray(drawn, dtype=np.bool_)
    if list(area["size"]) != [height, width]:
        raise ValueError(f"is of a picture of another size, {area['size']} (height, width)")
    counts = area["counts"]
    if isinstance(counts, str):
        drawn = coco.decode({"size": [height, width], "counts": counts.encode()})
        # pycocotools leaves the rest of the mask uninitialised if the text ends too early.
        fills = coco.encode(drawn)["counts"] == counts.encode()
    else:
        fills = all(type(run) is int and run >= 0 for run in counts)
        fills = fills and sum(counts) == height * width
        drawn = coco.decode(coco.frPyObjects(area, height, width)) if fills else None
    if not fills:
        raise ValueError(f"its run lengths do not fill {width} x {height} pixels (width x height)")
    return np.asarray(drawn, dtype=np.bool_)
