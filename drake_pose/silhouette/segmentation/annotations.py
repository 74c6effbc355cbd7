"""Masks of other tools in JSON files: COCO and labelme."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.checks import LARGEST_SIDE
from drake_pose.errors import MaskError
from drake_pose.regular_files import read_regular
from drake_pose.silhouette.segmentation.polygons import decode_runs, fill_polygon

Mask = NDArray[np.bool_]

# A larger file is not read.
_LARGEST_FILE = 1 << 30
# A circle is drawn with so many corners.
_CORNERS = 90


@dataclass(frozen=True)
class AnnotatedPicture:
    """The areas that a file describes in one picture.

    Args:
        file: the picture's path as the file has it.
        width, height: the picture's [pixel].
        areas: the classes' names, each with what draws its area (H, W).
    """

    file: str
    width: int
    height: int
    areas: Sequence[tuple[str, Callable[[], Mask]]] = ()

    def draw(self, classes: Container[str]) -> Mask:
        """The areas of some classes together (H, W), which may be none.

        Raises:
            ValueError: an area that cannot be drawn.
        """
        mask = np.zeros((self.height, self.width), dtype=np.bool_)
        for name, area in self.areas:
            if name in classes:
                mask |= area()
        return mask


@dataclass(frozen=True)
class Annotations:
    """What a file of annotations holds.

    Args:
        path: the file.
        pictures: in the file's order.
        names: what a class may be called beside its name: its number in COCO, by that text.
        warnings: what was left out.
    """

    path: Path
    pictures: tuple[AnnotatedPicture, ...]
    names: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def classes(self) -> tuple[str, ...]:
        """The names of all classes that have an area."""
        return tuple(dict.fromkeys(name for one in self.pictures for name, _ in one.areas))


def read_annotations(path: Path) -> Annotations:
    """Reads a file of annotations: COCO, with many pictures, or labelme, with one.

    Raises:
        MaskError: names the file, and the annotation at fault.
    """
    content = _read_json(path)
    if not isinstance(content, dict):
        raise MaskError(f"{path}: neither COCO nor labelme: expected a JSON object")
    try:
        if "shapes" in content:
            return _read_labelme(content, path)
        if "annotations" in content and "images" in content:
            return _read_coco(content, path)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        kind = "labelme" if "shapes" in content else "COCO"
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise MaskError(f"{path}: is no {kind} file as it should be: {what}") from error
    raise MaskError(
        f"{path}: neither COCO (images, annotations) nor labelme (shapes); write one of these"
    )


def _read_json(path: Path) -> Any:
    """A JSON file's content."""
    try:
        data = read_regular(path, _LARGEST_FILE)
    except OSError as error:
        raise MaskError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MaskError(f"{path}: is no JSON file: {error}") from error


def _read_coco(content: Mapping[str, Any], path: Path) -> Annotations:
    """The pictures of a COCO file."""
    names = {entry["id"]: str(entry["name"]) for entry in content.get("categories", ())}
    areas: dict[Any, list[tuple[str, Callable[[], Mask]]]] = {}
    sizes = {}
    for entry in content["images"]:
        if entry["id"] in sizes:
            raise ValueError(f"image {entry['id']} is given twice")
        sizes[entry["id"]] = _check_size(entry["width"], entry["height"])
        areas[entry["id"]] = []
    without = 0
    for entry in content["annotations"]:
        image = entry["image_id"]
        if image not in sizes:
            raise ValueError(
                f"annotation {entry.get('id')} is of image {image}, which is not there"
            )
        if not entry.get("segmentation"):
            without += 1
            continue
        name = names.get(entry["category_id"], str(entry["category_id"]))
        areas[image].append((name, _coco_area(entry, *sizes[image])))
    pictures = tuple(
        AnnotatedPicture(str(entry["file_name"]), *sizes[entry["id"]], areas[entry["id"]])
        for entry in content["images"]
    )
    text = f"{path}: {without} annotations have a box, but no segmentation: left out"
    numbers = {str(key): name for key, name in names.items()}
    return Annotations(path, pictures, numbers, (text,) if without else ())


def _coco_area(entry: Mapping[str, Any], width: int, height: int) -> Callable[[], Mask]:
    """What draws the area of an annotation."""
    where = f"annotation {entry.get('id')} of image {entry['image_id']}"
    segmentation = entry["segmentation"]

    def draw() -> Mask:
        try:
            if isinstance(segmentation, dict):
                if list(segmentation["size"]) != [height, width]:
                    raise ValueError(
                        f"is of a picture of another size, {segmentation['size']} (height, width)"
                    )
                return decode_runs(segmentation["counts"], height, width)
            mask = np.zeros((height, width), dtype=np.bool_)
            for polygon in segmentation:
                corners = np.asarray(polygon, dtype=np.float64)
                mask |= fill_polygon(corners.reshape(-1, 2), height, width)
            return mask
        except (KeyError, TypeError, ValueError) as error:
            what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
            raise ValueError(f"{where}: {what}") from error

    return draw


def _read_labelme(content: Mapping[str, Any], path: Path) -> Annotations:
    """The picture of a labelme file."""
    width, height = _check_size(content["imageWidth"], content["imageHeight"])
    areas: list[tuple[str, Callable[[], Mask]]] = []
    others: dict[str, int] = {}
    for k, shape in enumerate(content["shapes"]):
        kind = shape.get("shape_type") or "polygon"
        draw = _LABELME.get(kind)
        if draw is None:
            others[kind] = others.get(kind, 0) + 1
            continue
        areas.append((str(shape["label"]), _labelme_area(draw, shape, k, width, height)))
    # labelme on Windows writes its paths.
    file = str(content.get("imagePath") or path.with_suffix(".png").name).replace("\\", "/")
    warnings = tuple(
        f"{path}: {count} shapes of the kind {kind} have no area: left out"
        for kind, count in others.items()
    )
    picture = AnnotatedPicture(file, width, height, areas)
    return Annotations(path, (picture,), {}, warnings)


def _labelme_area(
    draw: Callable[[Mapping[str, Any], int, int], Mask],
    shape: Mapping[str, Any],
    number: int,
    width: int,
    height: int,
) -> Callable[[], Mask]:
    """What draws a shape; its errors name it."""

    def named() -> Mask:
        try:
            return draw(shape, width, height)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ValueError(f"shape {number} ('{shape.get('label')}'): {error}") from error

    return named


def _points(shape: Mapping[str, Any], count: int | None = None) -> NDArray[np.float64]:
    """A shape's points (n, 2)."""
    points = np.asarray(shape["points"], dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or (count is not None and len(points) != count):
        raise ValueError(f"needs {count or 'three'} points (x, y){'' if count else ' or more'}")
    return points


def _polygon(shape: Mapping[str, Any], width: int, height: int) -> Mask:
    return fill_polygon(_points(shape), height, width)


def _rectangle(shape: Mapping[str, Any], width: int, height: int) -> Mask:
    (x0, y0), (x1, y1) = _points(shape, 2)
    return fill_polygon(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), height, width)


def _circle(shape: Mapping[str, Any], width: int, height: int) -> Mask:
    """Its points are the middle, and one on the circle."""
    middle, other = _points(shape, 2)
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    return fill_polygon(middle + np.hypot(*(other - middle)) * directions, height, width)


def _bitmap(shape: Mapping[str, Any], width: int, height: int) -> Mask:
    """Its points are the first and the last pixel, its mask a PNG picture of what is between."""
    (x0, y0), _ = np.rint(_points(shape, 2)).astype(int)
    try:
        data = base64.b64decode(shape["mask"], validate=True)
        part = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except (binascii.Error, cv2.error) as error:
        raise ValueError("its mask is no PNG picture") from error
    if (
        part is None
        or x0 < 0
        or y0 < 0
        or x0 + part.shape[1] > width
        or y0 + part.shape[0] > height
    ):
        raise ValueError("its mask is no PNG picture, or reaches beyond the picture")
    mask = np.zeros((height, width), dtype=np.bool_)
    mask[y0 : y0 + part.shape[0], x0 : x0 + part.shape[1]] = part > 0
    return mask


_LABELME: Mapping[str, Callable[[Mapping[str, Any], int, int], Mask]] = {
    "polygon": _polygon,
    "rectangle": _rectangle,
    "circle": _circle,
    "mask": _bitmap,
}


def _check_size(width: Any, height: Any) -> tuple[int, int]:
    """A picture's width and height."""
    for side in (width, height):
        if isinstance(side, bool) or not isinstance(side, int) or not 1 <= side <= LARGEST_SIDE:
            raise ValueError(
                f"a picture's width and height must be whole numbers of 1 to {LARGEST_SIDE} pixels"
            )
    return width, height
