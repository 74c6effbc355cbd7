"""Read episodes of LeRobot data sets, versions 2.0, 2.1 and 3.0."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.episode import Episode, EpisodeCamera, JointLog, ascending_indices
from drake_pose.camera.motor_calibration import find_motors
from drake_pose.camera.picture_files import TimedVideo, decode_colours, import_reader
from drake_pose.errors import SceneError, UnknownNameError, listed
from drake_pose.regular_files import read_regular

INFO = Path("meta", "info.json")
"""File by which LeRobot data sets are recognised."""


def open_lerobot(path: Path, joints: JointLog | None, episode: int | None) -> Episode:
    """Open an episode of a LeRobot data set, which may be incomplete.

    Args:
        path: folder of the data set.
        joints: joint log to use instead of `observation.state` (or `state`); None: that, if any.
        episode: number of the episode; None: the only one that is present.

    Raises:
        SceneError: files are unreadable or do not match `meta/info.json`, or several episodes are
            present and none was chosen.
        UnknownNameError: the episode is not present.
    """
    parquet, state = import_reader("pyarrow.parquet", path), "observation.state"
    try:
        info = json.loads(read_regular(path / INFO))
        rows = _episode_rows(path, info, parquet)
        number, features = _choose_episode(path, info, rows, episode), info["features"]
        states = [key for key in features if key.startswith(f"{state}.")]
        states = [key for key in (state, "state") if key in features][:1] or states
        pictures = [key for key, one in features.items() if one["dtype"] in ("video", "image")]
        stored = [key for key in pictures if features[key]["dtype"] == "image"]
        file, wanted = _file(path, info, rows, number), ["timestamp", *states, *stored]
        filters = [("episode_index", "=", number)]
        table = parquet.read_table(file, columns=wanted, filters=filters)
        columns = {key: table[key].to_pylist() for key in wanted}
        times = np.array(columns["timestamp"], dtype=np.float64).ravel()
        kept, warnings = ascending_indices(times, f"{file}: episode {number}")
        warnings += [
            f"{path}: '{key}' is not used, as the data set has no intrinsics: give both in a "
            "camera file (--cameras), or estimate the pose: drake-pose register"
            for key in features
            if "extrinsics" in key
        ]
        if joints is None and states:
            values = [np.array(columns[key], dtype=np.float64) for key in states]
            positions = np.column_stack([one.reshape(len(times), -1) for one in values])
            names = [name for key in states for name in _names(key, features[key])]
            # Append the index to duplicate names.
            names = [n if names.count(n) == 1 else f"{n}_{k}" for k, n in enumerate(names)]
            servos, texts = find_motors(path, str(info.get("robot_type") or ""), names)
            warnings += texts
            joints = JointLog(tuple(names), times[kept], positions[kept], servos=servos)
        cameras = []
        for key in pictures:
            metadata = {**features[key], **(features[key].get("info") or {})}
            if any("is_depth" in field and value is True for field, value in metadata.items()):
                continue
            name = key.removeprefix("observation.").removeprefix("images.")
            if key in stored:
                read = _stored_pictures([columns[key][k]["bytes"] for k in kept], file)
                height, width = read(0).shape[:2]
                cameras.append(EpisodeCamera(name, width, height, times[kept], None, None, read))
                continue
            video = _file(path, info, rows, number, key)
            if not video.is_file():
                warnings.append(f"camera '{name}' is left out: {video} is missing")
                continue
            span = np.array([0.0, np.inf])
            if rows is not None:
                ends = ("from_timestamp", "to_timestamp")
                span = np.array([float(rows[number][f"videos/{key}/{end}"]) for end in ends])
            half = 0.5 / float(info["fps"])
            cameras.append(_video_camera(name, video, span, half, len(times), warnings))
    # Python and pyarrow raise these errors on damaged or incomplete files.
    except (
        OSError, ValueError, LookupError, TypeError, AttributeError, NotImplementedError
    ) as error:  # fmt: skip
        raise SceneError(
            f"{path}: not a LeRobot data set of version 2 or 3, or a file of it is damaged "
            f"({type(error).__name__}: {error})"
        ) from error
    return Episode.checked(path, cameras, joints, warnings)


_Rows = Mapping[int, Mapping[str, Any]] | None
"""Metadata of each episode in version 3 of the format, from column name to value, by the episode's
number; None: version 2, which has none."""


def _episode_rows(path: Path, info: Mapping[str, Any], parquet: Any) -> _Rows:
    """Return the rows of `meta/episodes`, from column name to value, by the episode's number.

    The result is None for version 2 of the format, which has no such rows.

    Args:
        path: folder of the data set.
        info: content of `meta/info.json`.
        parquet: the module pyarrow.parquet.

    Raises:
        SceneError: the data set has another version.
    """
    version = str(info["codebase_version"])
    if not version.startswith(("v2.", "v3.")):
        raise SceneError(
            f"{path / INFO}: a LeRobot data set of version {version}, but only 2.0, 2.1 and 3.0 "
            "are supported: convert it with LeRobot's scripts"
        )
    if version.startswith("v2."):
        return None
    rows: dict[int, dict[str, Any]] = {}
    for file in sorted(path.glob("meta/episodes/*/*.parquet")):
        # Skip the statistics, which are most of the columns.
        columns = parquet.read_schema(file).names
        used = [name for name in columns if name.startswith(("episode_index", "data/", "videos/"))]
        found = parquet.read_table(file, columns=used).to_pylist()
        rows |= {row["episode_index"]: row for row in found}
    return rows


def _file(path: Path, info: Mapping[str, Any], rows: _Rows, number: int, key: str = "") -> Path:
    """Return the file of an episode's data, or of a camera's video; it may be missing.

    Args:
        path: folder of the data set.
        info: content of `meta/info.json`.
        rows: metadata by episode, see ``_episode_rows``; None: version 2.
        number: number of the episode.
        key: the camera's key in the features; "": the data.
    """
    chunk = number // int(info.get("chunks_size", 1000))
    values = {"video_key": key, "episode_index": number, "episode_chunk": chunk}
    if rows is not None:
        where = f"videos/{key}" if key else "data"
        for name in ("chunk_index", "file_index"):
            values[name] = rows[number][f"{where}/{name}"]
    return path / info["video_path" if key else "data_path"].format(**values)


def _choose_episode(path: Path, info: Mapping[str, Any], rows: _Rows, wanted: int | None) -> int:
    """Return the number of the wanted episode, or of the only one whose data are present.

    Args:
        path: folder of the data set.
        info: content of `meta/info.json`.
        rows: metadata by episode, see ``_episode_rows``; None: version 2.
        wanted: number of the wanted episode; None: the only one.

    Raises:
        UnknownNameError: the data of the wanted episode are not present.
        SceneError: none was wanted, and the data of none or of several episodes are present.
    """
    numbers = list(rows or range(int(info["total_episodes"])))
    candidates = numbers if wanted is None else [one for one in numbers if one == wanted]
    present = [one for one in candidates if _file(path, info, rows, one).is_file()]
    if len(present) == 1:
        return present[0]
    present = [one for one in numbers if _file(path, info, rows, one).is_file()]
    names = listed([*map(str, present)], 20)
    if wanted is not None:
        raise UnknownNameError("episode", str(wanted), [names] if names else [], str(path))
    raise SceneError(
        f"{path}: choose an episode (--episode N); of {len(numbers)} these are present: "
        f"{names or 'none'}"
    )


def _names(key: str, feature: Mapping[str, Any]) -> list[str]:
    """Return names of a vector feature's entries: those of the data set, if there are as many.

    Otherwise they are the last part of the key, or "joint", and a number from 0; a single entry has
    no number.

    Args:
        key: the feature's key, `observation.state` or one that begins with it.
        feature: the feature in `meta/info.json`: its shape and, if any, its names, which may be
            nested lists or a mapping of lists.
    """
    size, names = int(np.prod(feature["shape"])), feature.get("names")
    if isinstance(names, dict):
        names = [one if isinstance(one, list) else name for name, one in names.items()]
    while names and isinstance(names[0], list):
        names = [name for part in names for name in part]
    if names and len(names) == size:
        return [str(name) for name in names]
    last = key.removeprefix("observation.state").lstrip(".") or "joint"
    return [f"{last}_{k}" for k in range(size)] if size > 1 else [last]


def _stored_pictures(stored: Sequence[bytes], file: Path) -> Callable[[int], Picture]:
    """Return a function that returns image k (H, W, 3) of a table of PNG or JPEG images.

    Args:
        stored: content of the image files.
        file: the table, for messages.
    """
    return lambda k: decode_colours(stored[k], file, SceneError)


def _video_camera(
    name: str, file: Path, span: Array, half: float, count: int, warnings: list[str]
) -> EpisodeCamera:
    """Return the camera of a video, restricted to a time span; times start at 0 with the span.

    Args:
        name: name of the camera.
        file: the video.
        span: (2,) start and end of the episode in the video [s].
        half: half a period between images [s]; images up to this much before the start belong to
            the episode, and those after the end less this do not.
        count: number of rows of the episode.
        warnings: list to which warnings are appended.

    Raises:
        SceneError: the video is unreadable, or has no image in the span.
    """
    video = TimedVideo(file)
    first, last = np.searchsorted(video.times, span - half).tolist()
    if first == last:
        raise SceneError(
            f"{file}: ends at {video.times[-1]:.3f} s, but the episode is from {span[0]:.3f} s on"
        )
    warnings += video.warnings
    if last - first != count:
        warnings.append(
            f"camera '{name}': has {last - first} pictures for {count} rows: pictures were dropped "
            "or repeated, so times may drift"
        )

    def recorded(k: int) -> Picture:
        return video.read(first + k)

    times = video.times[first:last] - span[0]
    return EpisodeCamera(name, video.width, video.height, times, None, None, recorded)
