"""Read numbers, times and images of a LeRobot episode's table, and cameras in `meta/info.json`.

The format has no fields for intrinsics and poses. DROID's data sets call them camera_intrinsics and
camera_extrinsics, and so are they called here, in the `info` of the camera's feature.
"""

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.calibration_files import lens_of
from drake_pose.camera.episode import Stream
from drake_pose.camera.models import PinholeCamera, check_pose
from drake_pose.camera.picture_files import (
    decode_colours,
    import_reader,
    path_inside,
    read_picture,
    upper_bits,
)
from drake_pose.errors import SceneError, listed

Features = Mapping[str, Mapping[str, Any]]
"""Features of a data set by name, as in `meta/info.json`."""


def read_numbers(table: Any, key: str, where: str) -> Array:
    """Return a column (n, m) of numbers or of lists of m numbers; missing rows are nan.

    ``table``: the table (pyarrow.Table). ``key``: name of the column. ``where``: the table's file,
    for messages. Raises SceneError: the column has other content, or rows of different lengths.
    """
    column = table[key]
    if import_reader("pyarrow", Path(where)).types.is_temporal(column.type):
        column = column.cast("int64")
    try:
        rows = [
            None if row is None else np.ravel(np.array(row, np.float64))
            for row in column.to_pylist()
        ]
    except (ValueError, TypeError) as error:
        raise SceneError(
            f"{where}: column '{key}' holds {column.type}, but numbers are expected ({error})"
        ) from error
    sizes = [1 if row is None else len(row) for row in rows]
    width = next((len(row) for row in rows if row is not None), 1)
    for k, row in enumerate(rows):
        if row is not None and len(row) != width:
            raise SceneError(
                f"{where}: column '{key}' has {sizes[k]} numbers in row {k} (counted from 0), but "
                f"{width} in the rows before"
            )
    found = [np.full(width, np.nan) if row is None else row for row in rows]
    return np.array(found).reshape(len(rows), width)


def row_times(table: Any, rate_hz: float | None, where: str, warnings: list[str]) -> Array:
    """Return the times (n,) [s] of a table's rows.

    They are those of the column `timestamp`, whose unit follows from the rate: s, ms, us or ns, or
    rows, if it counts them. If the column is missing or stands still, they are `frame_index`
    divided by the rate.

    Args:
        table: the table (pyarrow.Table).
        rate_hz: rows per second (`fps`); None: unknown, and the unit is s.
        where: the table's file, for messages.
        warnings: list to which warnings are appended.

    Raises SceneError: there are neither times nor a rate.
    """
    count, names = table.num_rows, table.column_names
    times = np.full(count, np.nan)
    if "timestamp" in names:
        times = read_numbers(table, "timestamp", where)[:, 0]
    step = float(np.nanmedian(np.diff(times))) if np.isfinite(times).sum() > 1 else 0.0
    if not np.isfinite(times).any() or (count > 1 and step == 0.0):
        # Seconds since 1970 as float32 have steps of 128 s.
        why = "stands still or is no number" if "timestamp" in names else "is missing"
        if rate_hz is None:
            raise SceneError(
                f"{where}: the column 'timestamp' {why}, and meta/info.json has no fps; it has: "
                f"{', '.join(names)}"
            )
        is_counted = "frame_index" in names
        frames = read_numbers(table, "frame_index", where)[:, 0] if is_counted else range(count)
        warnings.append(
            f"{where}: the column 'timestamp' {why}: the times are "
            f"{'frame_index' if is_counted else 'the row numbers'} divided by {rate_hz:g} Hz (fps)"
        )
        return np.asarray(frames, np.float64) / rate_hz
    if rate_hz is None or step <= 0.0:
        return times
    if rate_hz > 1.25 and np.array_equal(times, times[0] + np.arange(count)):
        warnings.append(f"{where}: 'timestamp' counts rows and is divided by {rate_hz:g} Hz (fps)")
        return times / rate_hz
    ratio = step * rate_hz
    power = 3 * round(math.log10(ratio) / 3)
    units = {3: "ms", 6: "microseconds", 9: "ns"}
    if power in units and abs(math.log10(ratio) - power) < 0.5:
        warnings.append(
            f"{where}: 'timestamp' is taken to be in {units[power]}: it grows by {step:g} a row at "
            f"{rate_hz:g} Hz (fps)"
        )
        return times * 10.0**-power
    if not 0.8 < ratio < 1.25:
        warnings.append(
            f"{where}: the rows' times are {step:.4g} s apart, but at {rate_hz:g} Hz (fps) they "
            f"would be {1.0 / rate_hz:.4g} s; the times are used"
        )
    return times


def find_states(features: Features) -> list[str]:
    """Return the features that are measured joint positions, in their order; [] if there are none.

    They are `observation.state` or `state`, or else all features that begin with one of these and a
    dot, or else those that are named after joints, such as `observation.joint_positions`, with the
    grippers. Features named after joints come first if the state is Cartesian or has no names.
    Actions, velocities, efforts and commands are never positions.
    """
    others = (
        r"action|velocit|q?vel$|efforts?$|torque|acc|currents?$|command|cmd|target|desired|goal|"
        r"leader|next|index|task|timestamp|env|reward|done|success|force|error"
    )
    numeric = [
        key
        for key, one in features.items()
        if len(shape_of(one)) < 3
        and re.match(r"float|double|u?int", str(one.get("dtype", "")))
        and not any(re.match(others, word) for word in re.split(r"[._/\s]", key.lower()))
    ]
    states = ("observation.state", "state", "observation.states", "states", "observations.state")
    dotted = {key: key.replace("/", ".") for key in numeric}
    plain = [key for one in states for key in numeric if dotted[key] == one][:1]
    grouped = [k for k in numeric if dotted[k].startswith(tuple(f"{one}." for one in states))]
    joints = [key for key in numeric if re.search(r"joint|qpos|servo|motor", key.lower())]
    if joints:
        hand = [key for key in numeric if re.search(r"gripper|finger", key.lower())]
        joints = [key for key in numeric if key in {*joints, *hand} and key not in plain]
    if plain and joints:
        # The state is Cartesian if its names are coordinates of a pose, or none of its own.
        feature = features[plain[0]]
        names = feature_names(plain[0], {**feature, "shape": shape_of(feature) or [1]})
        words = r"(?:.*[_. ])?(?:[xyzw]|[rq][xyzw]|roll|pitch|yaw|gripper|pad|state)(?:_?\d+)?"
        if names[0] == "joint_0" or all(re.fullmatch(words, one.lower()) for one in names):
            return joints
    return plain or grouped or joints


def describe(features: Features) -> str:
    """Return the names of features with their types and shapes, for messages."""
    texts = [f"{k} ({one.get('dtype')} {one.get('shape', '')})" for k, one in features.items()]
    return listed(texts, 20) or "none"


def shape_of(feature: Mapping[str, Any]) -> list[int]:
    """Return a feature's shape in `meta/info.json`; [] if it has none."""
    shape = feature.get("shape")
    return [int(one) for one in shape] if isinstance(shape, list) else [int(shape)] if shape else []


def feature_names(key: str, feature: Mapping[str, Any]) -> list[str]:
    """Return names of a vector feature's entries: those of the data set, if there are as many.

    Otherwise they are the last part of the key, or "joint", and a number from 0; a single entry has
    no number.

    ``key``: the feature's key. ``feature``: the feature in `meta/info.json`: its shape and, if any,
    its names, which may be nested lists or a mapping of lists.
    """
    size, names = int(np.prod(feature["shape"])), feature.get("names")
    if isinstance(names, dict):
        names = [one if isinstance(one, list) else name for name, one in names.items()]
    while names and isinstance(names[0], list):
        names = [name for part in names for name in part]
    if names and len(names) == size:
        return [str(name) for name in names]
    last = key.replace("/", ".").rpartition(".")[2]
    last = "joint" if last in ("state", "states") else last
    return [f"{last}_{k}" for k in range(size)] if size > 1 else [last]


def column_names(keys: Sequence[str], widths: Iterable[int], features: Features) -> tuple[str, ...]:
    """Return unique names of the numbers of several features.

    A name that occurs in several features begins with its feature's key, and one that still occurs
    twice ends with its index. ``widths``: each feature's count of numbers in a row.
    """
    pairs = zip(keys, widths, strict=True)
    parts = [feature_names(key, {**features[key], "shape": [width]}) for key, width in pairs]
    every = [name for part in parts for name in part]
    names = []
    for key, part in zip(keys, parts, strict=True):
        own = key.removeprefix("observation.")
        names += [f"{own}.{n}" if every.count(n) > part.count(n) else n for n in part]
    return tuple(n if names.count(n) == 1 else f"{n}_{k}" for k, n in enumerate(names))


def is_picture(key: str, feature: Mapping[str, Any]) -> bool:
    """Return whether a feature holds colour images: of type image or video, or arrays (H, W, 3)."""
    shape = shape_of(feature)
    metadata = {**feature, **(feature.get("info") or {})}
    if any("is_depth" in field and value is True for field, value in metadata.items()):
        return False
    if "depth" in key.lower() and len(shape) == 3 and 1 in (shape[0], shape[-1]):
        return False
    kind = str(feature.get("dtype", ""))
    is_array = len(shape) == 3 and not {3, 4}.isdisjoint((shape[0], shape[-1]))
    return kind in ("video", "image") or (is_array and kind.startswith(("uint8", "float")))


def stored_picture(
    root: Path, file: Path, key: str, cell: Any, shape: Sequence[int], number: int, k: int
) -> Picture:
    """Return the image (H, W, 3) of row k of a table, red, green, blue.

    Args:
        root: folder of the data set.
        file: the table, for messages.
        key: the images' feature.
        cell: the row's cell (pyarrow): a file, the path of one, or an array; None: the table has no
            such column, and images are in the format's folders.
        shape: shape of an image in `meta/info.json`; empty: unknown.
        number: number of the episode.

    Raises SceneError: it is missing, damaged, or outside the data set.
    """
    where = Path(f"{file}: '{key}', row {k}")
    if cell is not None:
        kind = str(cell.type)
        if kind.startswith(("list", "fixed_size_list", "large_list")):
            return _array_picture(_array(cell, shape, f"{file}: '{key}'"), str(where))
        cell = cell.as_py()
        if isinstance(cell, dict):
            cell = cell.get("bytes") or cell.get("path")
        if isinstance(cell, bytes):
            return decode_colours(cell, where)
        if not isinstance(cell, str):
            raise SceneError(
                f"{where}: holds {kind if cell is not None else 'nothing'}, but an image file, "
                "its path, or an array of height x width x 3 is expected"
            )
    folders = [
        root / "images" / name / f"episode{mark}{number:06d}"
        for name in dict.fromkeys((key, key.rpartition(".")[2]))
        for mark in "_-"
    ]
    if cell is None:
        tried = [
            folder / f"frame{folder.name[len('episode')]}{k:06d}{end}"
            for folder in folders
            for end in (".png", ".jpg")
        ]
    else:
        path = PurePath(cell.replace("\\", "/"))
        if path.is_absolute():  # It is often that of the recorder's machine.
            own = root.absolute()
            path = path.relative_to(own if path.is_relative_to(own) else path.anchor)
        tried = [path_inside(root, str(path), str(where)), file.parent / path]
        if "images" in path.parts:
            tried.append(root.joinpath(*path.parts[path.parts.index("images") :]))
        tried += [root / "images" / path, *(folder / path.name for folder in folders)]
    for place in tried:
        if place.is_file():
            return read_picture(place)
    raise SceneError(f"{where}: no such image file; tried: {', '.join(map(str, tried))}")


def _array(cell: Any, given: Sequence[int], where: str) -> Array:
    """Return a cell of nested lists (pyarrow) as an array, in the shape of the lists.

    A flat list has the shape that the data set states, ``given``. Raises SceneError, begun by
    ``where``: rows differ in length.
    """
    values, sizes = cell.values, [1, len(cell.values)]
    while str(values.type).partition("<")[0].endswith("list"):
        values = values.flatten()
        sizes.append(len(values))
    if 0 in sizes or any(b % a for a, b in itertools.pairwise(sizes)):
        raise SceneError(f"{where}: rows of an image differ in length")
    shape = [b // a for a, b in itertools.pairwise(sizes)]
    is_stated = len(shape) == 1 and math.prod(given) == len(values)
    flat = np.asarray(values.to_numpy(zero_copy_only=False))
    return flat.reshape(given if is_stated else shape)


def _array_picture(values: Any, where: str) -> Picture:
    """Return an image (H, W, 3) of an array (H, W), (H, W, c) or (c, H, W), c being 1, 3 or 4.

    Floating-point numbers up to 1 are fractions of 255. Raises SceneError, begun by ``where``: the
    array has another shape, or its numbers are no intensities.
    """
    layers = values[:, :, None] if values.ndim == 2 else values
    if layers.ndim == 3 and layers.shape[2] not in (1, 3, 4) and layers.shape[0] in (1, 3, 4):
        layers = np.moveaxis(layers, 0, 2)
    if layers.ndim != 3 or layers.shape[2] not in (1, 3, 4) or layers.dtype.kind not in "uif":
        raise SceneError(
            f"{where}: is an array of {layers.dtype} of shape {values.shape}, but height x width x "
            "3 or 3 x height x width numbers are expected"
        )
    if layers.dtype == np.uint16:
        layers = upper_bits(layers, where)
    if layers.dtype.kind == "f":
        layers = layers * (255.0 if np.nanmax(layers) <= 1.0 else 1.0)
    if not np.isfinite(layers).all() or layers.min() < 0 or layers.max() > 255:
        raise SceneError(
            f"{where}: has numbers from {layers.min():g} to {layers.max():g}, but intensities from "
            "0 to 255 or from 0 to 1 are expected"
        )
    picture = np.rint(layers).astype(np.uint8)
    if picture.shape[2] == 1:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    return np.ascontiguousarray(picture[:, :, :3])


def camera_fields(camera: PinholeCamera, link: str | None = None) -> dict[str, Any]:
    """Return the fields of a camera for its feature's `info`.

    camera_intrinsics is the camera matrix [pixel], pixel centres at integers; camera_extrinsics is
    X_WC (4 x 4) [m], x right, y down, z forward, in the robot's base or in ``link``.
    """
    fx, fy, cx, cy = camera.focal_x, camera.focal_y, camera.center_x, camera.center_y
    return {
        "camera_intrinsics": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "camera_extrinsics": camera.X_WC.tolist(),
        **({} if link is None else {"camera_link": link}),
    }


def with_fields(camera: Stream, fields: Mapping[str, Any], where: str) -> Stream:
    """Return a recorded camera with the intrinsics and pose in its feature's fields, if any.

    ``camera``: the recorded camera. ``fields``: fields of its feature and of the feature's `info`,
    as of `camera_fields`. ``where``: the file, for messages. Raises CameraError: a field is
    invalid, or there is a pose without intrinsics.
    """
    matrix, pose = fields.get("camera_intrinsics"), fields.get("camera_extrinsics")
    if matrix is None and pose is None:
        return camera
    where = f"{where}: camera '{camera.name}'"
    lens = lens_of([camera.width, camera.height], matrix, (), "none", f"{where}: camera_intrinsics")
    X_WC = np.eye(4) if pose is None else check_pose(pose, "camera_extrinsics", where)
    found, link = lens.camera(camera.name, X_WC), fields.get("camera_link")
    return replace(camera, camera=found, link=link, is_posed=pose is not None)
