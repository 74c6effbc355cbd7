"""Masks of COCO annotation files, which pycocotools draws."""

import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from drake_pose.arrays import Mask
from drake_pose.camera.models import LARGEST_SIDE
from drake_pose.errors import MaskError
from drake_pose.input_files import read_regular


@dataclass(frozen=True)
class AnnotatedPicture:
    """A picture of a COCO file with its annotations."""

    file: PurePosixPath  # The picture's file, as in the COCO file.
    # height, width: size [pixel].
    height: int
    width: int
    areas: list[tuple[str, Any]]  # Class name and segmentation of each annotation.

    def draw(self, classes: Container[str]) -> Mask:
        """Return the union (H, W) of the areas of ``classes``; ValueError: one is damaged."""
        mask = np.zeros((self.height, self.width), dtype=np.bool_)
        for name, area in self.areas:
            if name in classes:
                mask |= draw_area(area, self.height, self.width)
        return mask


@dataclass(frozen=True)
class Annotations:
    """The content of a COCO file."""

    path: Path
    pictures: Sequence[AnnotatedPicture]  # The pictures, in the file's order.
    names: Mapping[str, str]  # Class names by class number.
    boxes: int  # Number of annotations that have a box, but no area.

    @property
    def classes(self) -> set[str]:
        """The names of all classes that have an area."""
        return {name for picture in self.pictures for name, _ in picture.areas}


def read_coco(path: Path) -> Annotations:
    """Read a COCO file; MaskError names the file and what is invalid."""
    try:
        content = json.loads(read_regular(path, 1 << 30))
        names = {one["id"]: str(one["name"]) for one in content.get("categories", ())}
        images = content["images"]
        pictures = {one["id"]: _picture(one) for one in images}
        if len(pictures) < len(images):
            raise ValueError("an image is given twice")
        drawn = [one for one in content["annotations"] if one.get("segmentation")]
        for one in drawn:
            number = one["category_id"]
            area = (names.get(number, str(number)), one["segmentation"])
            pictures[one["image_id"]].areas.append(area)
    except OSError as error:
        raise MaskError(f"{path}: cannot be read: {error.strerror}") from error
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise MaskError(
            f"{path}: is not a COCO file, which has images and their annotations: {what}"
        ) from error
    numbers = {str(number): name for number, name in names.items()}
    boxes = len(content["annotations"]) - len(drawn)
    return Annotations(path, tuple(pictures.values()), numbers, boxes)


def _picture(image: Mapping[str, Any]) -> AnnotatedPicture:
    """Return the picture of a COCO file's image; KeyError, TypeError, ValueError: it is invalid."""
    file, height, width = (image[key] for key in ("file_name", "height", "width"))
    if not all(isinstance(side, int) and 1 < side <= LARGEST_SIDE for side in (height, width)):
        raise ValueError(f"width and height must be whole numbers of 2 to {LARGEST_SIDE} pixels")
    if not str(file).isprintable():
        raise ValueError(f"{file!r} is not a name of a picture file")
    return AnnotatedPicture(PurePosixPath(file), height, width, [])


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
