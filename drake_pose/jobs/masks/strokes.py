"""Boxes and lines that a user gives, and the masks that GrabCut makes of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drake_pose.errors import SceneError, SettingsError
from drake_pose.jobs.masks.found import FoundMask, FoundMasks
from drake_pose.jobs.masks.sources import Source
from drake_pose.silhouette.segmentation.grab_cut import Strokes, cut_out
from drake_pose.yaml_files import read_yaml

Marks = Mapping[tuple[str, str], Strokes]

_FIELDS = ("box", "object", "background", "width")
ANY_CAMERA = "camera"
"""What a file of strokes calls a camera that has no name."""

# A mask that is nearly all of its box, or nearly none, was not told from its surroundings.
_ALL, _NONE = 0.95, 0.03


def read_strokes(path: Path) -> dict[tuple[str, str], Strokes]:
    """Reads what is marked in pictures.

    The file has by camera and frame ``box: [x, y, width, height]``, ``object`` and ``background``,
    lists of lines of points ``[x, y]``, and the lines' ``width`` [pixel].

    Raises:
        SceneError: names the file, the camera and frame, and the field.
    """
    content = read_yaml(path, SceneError)
    found: dict[tuple[str, str], Strokes] = {}
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected cameras, frames, and what is marked in them")
    for camera, frames in content.items():
        if not isinstance(frames, dict):
            raise SceneError(f"{path}: camera '{camera}': expected frames")
        for frame, entry in frames.items():
            where = f"{path}: camera '{camera}', frame '{frame}'"
            name = "" if camera == ANY_CAMERA else str(camera)
            found[name, str(frame)] = read_entry(entry, where)
    return found


def dump_strokes(marks: Marks) -> str:
    """The text of a file of strokes, which read_strokes reads back."""
    content: dict[str, dict[str, Any]] = {}
    for (camera, frame), strokes in marks.items():
        entry: dict[str, Any] = {} if strokes.box is None else {"box": list(strokes.box)}
        for name in ("object", "background"):
            if lines := getattr(strokes, name):
                entry[name] = [[list(point) for point in line] for line in lines]
        content.setdefault(camera or ANY_CAMERA, {})[frame] = {**entry, "width": strokes.width}
    return yaml.safe_dump(content, default_flow_style=None, sort_keys=False)


def read_entry(entry: Any, where: str) -> Strokes:
    """What is marked in one picture."""
    if not isinstance(entry, dict) or not entry:
        raise SceneError(f"{where}: expected {', '.join(_FIELDS)}")
    unknown = [str(name)[:40] for name in entry if name not in _FIELDS]
    if unknown:
        raise SceneError(f"{where}: unknown field {unknown[0]}; there are {', '.join(_FIELDS)}")
    box = None if entry.get("box") is None else _numbers(entry["box"], 4, f"{where}: box")
    lines = {
        name: tuple(
            tuple(_numbers(point, 2, f"{where}: {name}") for point in _list(line, where, name))
            for line in _list(entry.get(name, []), where, name)
        )
        for name in ("object", "background")
    }
    (width,) = _numbers([entry.get("width", Strokes().width)], 1, f"{where}: width")
    if width <= 0.0:
        raise SceneError(f"{where}: width must be positive")
    return Strokes(
        box,
        lines["object"],
        lines["background"],
        width,
    )


def _list(value: Any, where: str, name: str) -> list[Any]:
    if not isinstance(value, list):
        raise SceneError(f"{where}: {name} must be a list of lines of points [x, y]")
    return value


def _numbers(value: Any, count: int, what: str) -> tuple[float, ...]:
    """So many finite numbers."""
    good = isinstance(value, list) and len(value) == count
    if not good or not all(
        isinstance(one, int | float) and not isinstance(one, bool) and math.isfinite(one)
        for one in value
    ):
        raise SceneError(f"{what}: expected {count} number{'s' if count > 1 else ''}")
    return tuple(float(one) for one in value)


def cut_marked(source: Source, box: tuple[float, ...] | None, marks: Marks) -> FoundMasks:
    """The masks of all pictures in which something is marked.

    Args:
        source: pictures or videos.
        box: a box in all pictures in which nothing else is marked; None: those get no mask.
        marks: by camera and frame.

    Raises:
        SceneError: something is marked in a picture that there is not.
        SettingsError: what is marked tells no object from its surroundings.
    """
    left = set(marks)
    for camera in source.names:
        for frame, where, picture in source.read(camera):
            strokes = marks.get((camera, frame))
            left.discard((camera, frame))
            if strokes is None and box is None:
                empty = np.zeros(picture.shape[:2], dtype=np.bool_)
                yield FoundMask(camera, frame, where, empty, picture, "nothing is marked in it")
                continue
            strokes = strokes or Strokes(box)
            try:
                mask = cut_out(picture, strokes)
            except SettingsError as error:
                raise SettingsError(f"{where}: {error}") from error
            yield FoundMask(camera, frame, where, mask, picture, "", _doubts(mask.sum(), strokes))
    if left:
        camera, frame = min(left)
        raise SceneError(
            f"{source.path}: has no picture of camera '{camera or ANY_CAMERA}', frame '{frame}', "
            "which strokes are given for"
        )


def _doubts(area: int, strokes: Strokes) -> tuple[str, ...]:
    """What is suspicious of a mask's area [pixel]."""
    if strokes.box is None:
        return ()
    share = area / (strokes.box[2] * strokes.box[3])
    if share > _ALL:
        return (f"the mask is {share:.0%} of its box: mark some of the background in it (strokes)",)
    if 0.0 < share < _NONE:
        return (f"the mask is {share:.1%} of its box: mark some of the object in it (strokes)",)
    return ()
