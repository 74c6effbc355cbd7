"""Episodes of LeRobot data sets, versions 2.0, 2.1 (a file an episode) and 3.0 (many in a file)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.episodes.episode import Episode, EpisodeCamera, JointLog, ascending
from drake_pose.camera.picture_files import decode_colours
from drake_pose.camera.video_files import TimedVideo, import_reader
from drake_pose.errors import SceneError, UnknownNameError
from drake_pose.regular_files import read_regular

INFO = Path("meta", "info.json")
_STATE, _TIME, _EPISODE = "observation.state", "timestamp", "episode_index"
# What a damaged file, or one that lacks something, makes Python and pyarrow raise.
_UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, NotImplementedError)
# Episodes that are listed before "and more".
_LISTED = 20


@dataclass(frozen=True)
class _DataSet:
    """A data set: what `meta/info.json` says, and of version 3 the row of each episode."""

    path: Path
    info: Mapping[str, Any]
    rows: Mapping[int, Mapping[str, Any]] | None

    def file(self, template: str, number: int, key: str = "") -> Path:
        """The file of an episode's data, or of a camera's pictures."""
        chunk = number // int(self.info.get("chunks_size", 1000))
        values = {"video_key": key, "episode_index": number, "episode_chunk": chunk}
        if self.rows is not None:
            where = f"videos/{key}" if key else "data"
            for name in ("chunk_index", "file_index"):
                values[name] = self.rows[number][f"{where}/{name}"]
        return self.path / self.info[template].format(**values)

    def span(self, number: int, key: str) -> tuple[float, float]:
        """From when until when an episode lasts in the file of a camera's pictures [s]."""
        if self.rows is None:
            return 0.0, np.inf
        begin, end = (self.rows[number][f"videos/{key}/{one}_timestamp"] for one in ("from", "to"))
        return float(begin), float(end)

    def choose(self, wanted: int | None) -> int:
        """The episode that is asked for, or the only one of which the data are here."""
        numbers = list(self.rows or range(int(self.info["total_episodes"])))
        asked = numbers if wanted is None else [one for one in numbers if one == wanted]
        here = [one for one in asked if self.file("data_path", one).is_file()]
        if len(here) == 1:
            return here[0]
        here = [one for one in numbers if self.file("data_path", one).is_file()]
        more = [f"{len(here) - _LISTED} more"] if len(here) > _LISTED else []
        listed = [*map(str, here[:_LISTED]), *more]
        if wanted is not None:
            raise UnknownNameError("episode", str(wanted), listed, str(self.path))
        raise SceneError(
            f"{self.path}: say which episode (--episode N): of {len(numbers)} these are here: "
            f"{', '.join(listed) or 'none'}"
        )


def open_lerobot(path: Path, joints: JointLog | None, episode: int | None) -> Episode:
    """Opens an episode of a data set, which may be here in part.

    Args:
        joints: in place of its `observation.state`.
        episode: its number; None: the only one that is here.

    Raises:
        SceneError: files cannot be read or are not as `meta/info.json` says, or several episodes
            are here and none was asked for.
        UnknownNameError: the episode is not here.
    """
    parquet = import_reader("pyarrow.parquet", path)
    try:
        data = _read_meta(path, parquet)
        number, features = data.choose(episode), data.info["features"]
        states = [key for key in features if key == _STATE or key.startswith(f"{_STATE}.")]
        states = [_STATE] if _STATE in states else states
        pictures = [key for key, one in features.items() if one["dtype"] in ("video", "image")]
        own = [key for key in pictures if features[key]["dtype"] == "image"]
        file, wanted = data.file("data_path", number), [_TIME, *states, *own]
        rows = parquet.read_table(file, columns=wanted, filters=[(_EPISODE, "=", number)])
        columns = {key: rows[key].to_pylist() for key in wanted}
        times = np.array(columns[_TIME], dtype=np.float64).ravel()
        kept, warnings = ascending(times, f"{file}: episode {number}")
        if joints is None and states:
            values = [np.array(columns[key], dtype=np.float64) for key in states]
            table = np.column_stack([one.reshape(len(times), -1) for one in values])
            names = [name for key in states for name in _names(key, features[key])]
            joints = JointLog(_unique(names), times[kept], table[kept])
        cameras = []
        for key in (key for key in pictures if not _is_depth(features[key])):
            name = key.removeprefix("observation.").removeprefix("images.")
            if key in own:
                stored = [columns[key][k]["bytes"] for k in kept]
                cameras.append(_of_images(name, stored, times[kept], file))
            elif (video := data.file("video_path", number, key)).is_file():
                half = 0.5 / float(data.info["fps"])
                span = np.array(data.span(number, key))
                cameras.append(_of_video(name, video, span, half, len(times), warnings))
            else:
                warnings.append(f"camera '{name}' is left out: {video} is not here")
    except _UNREADABLE as error:
        raise SceneError(
            f"{path}: not a LeRobot data set of version 2 or 3, or a file of it is damaged "
            f"({type(error).__name__}: {error})"
        ) from error
    return Episode.checked(path, cameras, joints, warnings)


def _read_meta(path: Path, parquet: Any) -> _DataSet:
    """What a data set says of itself."""
    info = json.loads(read_regular(path / INFO))
    version = str(info["codebase_version"])
    if not version.startswith(("v2.", "v3.")):
        raise SceneError(
            f"{path / INFO}: a LeRobot data set of version {version}, but 2.0, 2.1 and 3.0 are "
            "read: convert it by LeRobot's own scripts"
        )
    if version.startswith("v2."):
        return _DataSet(path, info, None)
    rows: dict[int, dict[str, Any]] = {}
    for file in sorted(path.glob("meta/episodes/*/*.parquet")):
        # Statistics are most of the columns, and of no use here.
        known = parquet.read_schema(file).names
        used = [name for name in known if name.startswith((_EPISODE, "data/", "videos/"))]
        rows |= {row[_EPISODE]: row for row in parquet.read_table(file, columns=used).to_pylist()}
    return _DataSet(path, info, rows)


def _names(key: str, feature: Mapping[str, Any]) -> list[str]:
    """The names of a vector's entries, which may be lists in each other; else numbers."""
    size, names = int(np.prod(feature["shape"])), feature.get("names")
    if isinstance(names, dict):
        names = [one if isinstance(one, list) else name for name, one in names.items()]
    while names and isinstance(names[0], list):
        names = [name for part in names for name in part]
    if names and len(names) == size:
        return [str(name) for name in names]
    last = key.removeprefix(_STATE).lstrip(".") or "joint"
    return [f"{last}_{k}" for k in range(size)] if size > 1 else [last]


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    """Names, with their places where several are the same."""
    return tuple(n if names.count(n) == 1 else f"{n}_{k}" for k, n in enumerate(names))


def _is_depth(feature: Mapping[str, Any]) -> bool:
    """Whether pictures are depths."""
    said = {**feature, **(feature.get("info") or {})}
    return any("is_depth" in key and value is True for key, value in said.items())


def _of_images(name: str, stored: list[bytes], times: Array, file: Path) -> EpisodeCamera:
    """A camera whose pictures are in the table itself, as PNG or JPEG."""

    def recorded(k: int) -> Picture:
        return decode_colours(stored[k], file, SceneError)

    height, width = recorded(0).shape[:2]
    return EpisodeCamera(name, width, height, times, None, None, recorded)


def _of_video(
    name: str, file: Path, span: Array, half: float, count: int, warnings: list[str]
) -> EpisodeCamera:
    """A camera whose pictures are those of a video's span [s], begun half a period earlier."""
    video = TimedVideo(file)
    first, last = np.searchsorted(video.times, span - half).tolist()
    if first == last:
        raise SceneError(
            f"{file}: ends at {video.times[-1]:.3f} s, but the episode is from {span[0]:.3f} s on"
        )
    warnings += video.warnings
    if last - first != count:
        warnings.append(
            f"camera '{name}': has {last - first} pictures of {count} rows: some were dropped or "
            "repeated, so that they may drift apart"
        )

    def recorded(k: int) -> Picture:
        return video.read(first + k)

    times = video.times[first:last] - span[0]
    return EpisodeCamera(name, video.width, video.height, times, None, None, recorded)
