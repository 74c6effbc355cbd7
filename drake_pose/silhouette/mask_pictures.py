"""Masks from COCO annotation files: polygons and run lengths.

A polygon's coordinates are continuous: pixel 0 spans 0..1. A pixel belongs to the polygon that
contains its centre. OpenCV's ``fillPoly`` adds every pixel that the border touches, which is half a
pixel too many.
"""

import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import LARGEST_SIDE
from drake_pose.errors import MaskError
from drake_pose.input_files import read_regular


@dataclass(frozen=True)
class AnnotatedPicture:
    """A picture of a COCO file with its annotations.

    Attributes:
        file: file name of the picture, as in the COCO file.
        width, height: size [pixel].
        annotations: class name and COCO entry of each annotation.
    """

    file: str
    width: int
    height: int
    annotations: Sequence[tuple[str, Mapping[str, Any]]] = ()

    def draw(self, classes: Container[str]) -> Mask:
        """Return the union (H, W) of annotations of ``classes``; ValueError: one has no area."""
        mask = np.zeros((self.height, self.width), dtype=np.bool_)
        for name, entry in self.annotations:
            if name not in classes:
                continue
            try:
                mask |= _draw(entry["segmentation"], self.height, self.width)
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
                where = f"annotation {entry.get('id')} of image {entry['image_id']}"
                raise ValueError(f"{where}: {what}") from error
        return mask


@dataclass(frozen=True)
class Annotations:
    """The content of a COCO file."""

    path: Path
    pictures: tuple[AnnotatedPicture, ...]  # The pictures, in the file's order.
    names: Mapping[str, str]  # Class names by class number.
    warnings: tuple[str, ...] = ()  # What was left out.

    @property
    def classes(self) -> tuple[str, ...]:
        """The names of all classes that have an area."""
        return tuple(
            dict.fromkeys(name for picture in self.pictures for name, _ in picture.annotations)
        )


def read_coco(path: Path) -> Annotations:
    """Read a COCO file; MaskError names the file and the invalid annotation."""
    try:
        content = json.loads(read_regular(path, 1 << 30))
    except OSError as error:
        raise MaskError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise MaskError(f"{path}: is not a JSON file: {error}") from error
    if not isinstance(content, dict) or not {"images", "annotations"} <= set(content):
        raise MaskError(f"{path}: is not a COCO file: it needs images and annotations")
    try:
        return _annotations(content, path)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise MaskError(f"{path}: is not a valid COCO file: {what}") from error


def _annotations(content: Mapping[str, Any], path: Path) -> Annotations:
    """Return the annotations in the JSON content of a COCO file.

    ``path``: the file, for warnings.

    Raises KeyError, TypeError, ValueError, AttributeError or IndexError for invalid content.
    """
    names = {entry["id"]: str(entry["name"]) for entry in content.get("categories", ())}
    of_image: dict[Any, list[tuple[str, Mapping[str, Any]]]] = {}
    for entry in content["images"]:
        if entry["id"] in of_image:
            raise ValueError(f"image {entry['id']} is given twice")
        of_image[entry["id"]] = []
    without = 0
    for entry in content["annotations"]:
        image = entry["image_id"]
        if image not in of_image:
            raise ValueError(
                f"annotation {entry.get('id')} is of image {image}, which does not exist"
            )
        if entry.get("segmentation"):
            category = entry["category_id"]
            of_image[image].append((names.get(category, str(category)), entry))
        else:
            without += 1
    pictures = tuple(
        AnnotatedPicture(
            _file_name(entry["file_name"]),
            _side(entry["width"]),
            _side(entry["height"]),
            of_image[entry["id"]],
        )
        for entry in content["images"]
    )
    text = f"{path}: {without} annotations have a box, but no segmentation: left out"
    numbers = {str(key): name for key, name in names.items()}
    return Annotations(path, pictures, numbers, (text,) if without else ())


def _file_name(value: Any) -> str:
    """Return a picture's file name; ValueError if it is invalid."""
    if not isinstance(value, str) or not value.isprintable():
        raise ValueError(f"{value!r} is not a name of a picture file")
    return value


def _side(value: Any) -> int:
    """Return a picture's width or height [pixel]; ValueError if it is invalid."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= LARGEST_SIDE:
        raise ValueError(
            f"a picture's width and height must be whole numbers of 1 to {LARGEST_SIDE} pixels"
        )
    return value


def _draw(segmentation: Any, height: int, width: int) -> Mask:
    """Return the area (H, W) of a COCO segmentation in a picture of height x width pixels.

    ``segmentation``: a mapping with size and counts (run lengths), or a list of polygons x0, y0,
    x1, y1, ... [pixel].
    """
    if isinstance(segmentation, dict):
        if list(segmentation["size"]) != [height, width]:
            raise ValueError(
                f"is of a picture of another size, {segmentation['size']} (height, width)"
            )
        return decode_run_lengths(segmentation["counts"], height, width)
    mask = np.zeros((height, width), dtype=np.bool_)
    for polygon in segmentation:
        mask |= fill_polygon(np.asarray(polygon, dtype=np.float64).reshape(-1, 2), height, width)
    return mask


def fill_polygon(corners: Array, height: int, width: int) -> Mask:
    """Return the pixels (H, W) whose centres lie in a polygon by the even-odd rule.

    ``corners``: (n, 2) x, y [pixel]; the centre of pixel (row, column) is column + 0.5, row + 0.5.
    ``height``, ``width``: size of the picture [pixel]. Raises ValueError: there are fewer than
    three corners, or one is not finite.
    """
    if len(corners) < 3 or not np.isfinite(corners).all():
        raise ValueError("a polygon needs three or more finite corners (x, y)")
    # Each edge toggles the pixels to its right.
    toggled = np.zeros((height, width + 1), dtype=np.bool_)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        ends = np.ceil(np.sort([y0, y1]) - 0.5).clip(0, height).astype(int)
        rows = np.arange(*ends)
        if len(rows):
            x = x0 + (rows + 0.5 - y0) * (x1 - x0) / (y1 - y0)
            toggled[rows, np.ceil(x - 0.5).clip(0, width).astype(int)] ^= True
    return np.logical_xor.accumulate(toggled[:, :width], axis=1)


def decode_run_lengths(counts: Sequence[int] | str, height: int, width: int) -> Mask:
    """Return the area (H, W) of COCO run lengths in a picture of height x width pixels.

    ``counts``: lengths of alternate runs of 0 and 1, column after column, or COCO's compressed
    text.

    Raises ValueError: the run lengths do not fill the picture; MaskError: pycocotools is not
    installed.
    """
    try:
        from pycocotools import mask as coco
    except ImportError as error:
        raise MaskError(
            "run lengths of COCO are read by pycocotools: pip install 'drake_pose[coco]'"
        ) from error
    packed: dict[str, Any] = {"size": [height, width]}
    if isinstance(counts, str):
        packed["counts"] = counts.encode()
    else:
        if any(isinstance(run, bool) or not isinstance(run, int) or run < 0 for run in counts):
            raise ValueError("run lengths must be whole numbers, none negative")
        if sum(counts) != height * width:
            raise ValueError(
                f"the run lengths fill {sum(counts)} pixels of a picture of {width} x {height} "
                "(width x height)"
            )
        packed = coco.frPyObjects(packed | {"counts": list(counts)}, height, width)
    mask = coco.decode(packed)
    # pycocotools leaves the rest of the mask uninitialised if the text ends too early.
    if isinstance(counts, str) and coco.encode(mask)["counts"] != packed["counts"]:
        raise ValueError(
            f"the run lengths do not fill a picture of {width} x {height} (width x height)"
        )
    return np.asarray(mask, dtype=np.bool_)
