"""Read episodes of LeRobot data sets, versions 2.0, 2.1 and 3.0."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.episode import Episode, JointLog, Stream
from drake_pose.camera.lerobot_tables import (
    column_names,
    describe,
    find_states,
    is_picture,
    read_numbers,
    row_times,
    shape_of,
    stored_picture,
    with_fields,
)
from drake_pose.camera.picture_files import Video, import_reader, naming_damage, path_inside
from drake_pose.camera.servo_readings import find_motors
from drake_pose.errors import SceneError, UnknownNameError, listed
from drake_pose.input_files import read_regular

INFO = Path("meta", "info.json")
"""File by which LeRobot data sets are recognised."""


Metadata = Mapping[int, Mapping[str, Any]]
"""Each episode's metadata, from column to value, by its number; {}: it has none."""


class _Rows(NamedTuple):
    """The rows of an episode that is read."""

    path: Path  # Folder of the data set.
    info: Mapping[str, Any]  # Content of `meta/info.json`.
    metadata: Metadata
    number: int  # Number of the episode.
    table: Any  # Its table (pyarrow.Table).
    file: Path  # The table's file.
    stamps: Array  # (n,) times of the rows [s].
    warnings: list[str]  # Is appended to.


def open_lerobot(path: Path, joints: JointLog | None, episode: int | None) -> Episode:
    """Open an episode of a LeRobot data set, which may be incomplete.

    Times are counted from the start of the episode.

    ``path``: folder of the data set. ``joints``: joint log to use instead of the data set's, see
    `find_states`; None: that, if any. ``episode``: number of the episode; None: the only one that
    is present.

    Raises SceneError: files are unreadable or do not match `meta/info.json`, or several episodes
    are present and none was chosen; UnknownNameError: the episode is not present.
    """
    parquet, warnings = import_reader("pyarrow.parquet", path), list[str]()
    with naming_damage(
        path, "not a LeRobot data set of version 2 or 3, or a file of it is damaged"
    ):
        info = _read_info(path)
        metadata, features = _episode_rows(path, info, parquet), info["features"]
        number = _choose_episode(path, info, metadata, episode)
        file = _file(path, info, metadata, number)
        table = _read_table(file, info, number, parquet, warnings)
        stamps = row_times(table, _rate(info), str(file), warnings)
        rows = _Rows(path, info, metadata, number, table, file, stamps, warnings)
        warnings += [
            f"{path}: '{key}' is not used, as the data set has no intrinsics: give both in a "
            "camera file (--cameras), or estimate the pose: drake-pose register"
            for key in features
            if "extrinsics" in key
        ]
        cameras, names = [], list[str]()
        pictures = [key for key, one in features.items() if is_picture(key, one)]
        if not pictures:
            raise SceneError(
                f"{path / INFO}: has no feature of colour pictures (dtype video or image, or "
                f"arrays of height x width x 3); it has: {describe(features)}"
            )
        for key in pictures:
            name = camera_name(key)
            names.append(key if name in names else name)
            try:
                camera = _read_camera(rows, key)
            except SceneError as error:
                warnings.append(f"camera '{names[-1]}' is left out: {error}")
                continue
            fields = {**features[key], **(features[key].get("info") or {})}
            camera = replace(camera, name=names[-1])
            cameras.append(with_fields(camera, fields, str(path / INFO)))
        own, lacking = None, ""
        if joints is None:
            own, lacking = _read_joints(rows)
        cameras, own, joints = _from_start(rows, cameras, own, joints)
    return Episode.checked(path, cameras, joints or own, warnings, lacking)


def camera_name(key: str) -> str:
    """Return the usual name of the camera with a key in the features of `meta/info.json`."""
    name = key.replace("/", ".").removeprefix("observation.").removeprefix("images.")
    return name if "/" not in key else name.replace(".", "_")


def _read_info(path: Path) -> Mapping[str, Any]:
    """Return the content of `meta/info.json`.

    Raises SceneError: it is no JSON, has no features, names files outside the data set, or is of
    another version.
    """
    file = path / INFO
    with naming_damage(file, "is damaged: it is no JSON"):
        info = json.loads(read_regular(file))
    features = info.get("features") if isinstance(info, dict) else None
    if not isinstance(features, dict) or not all(
        isinstance(one, dict) for one in features.values()
    ):
        found = listed([*info], 20) if isinstance(info, dict) else type(info).__name__
        raise SceneError(
            f"{file}: has no 'features', which name the columns and videos of the data set; it "
            f"has: {found or 'nothing'}"
        )
    for key in ("data_path", "video_path"):
        path_inside(path, str(info.get(key) or ""), f"{file}: {key}")
    for key in features:
        path_inside(path, key, f"{file}: features")
    version = str(info.get("codebase_version", "")).removeprefix("v")
    if not version:
        # The metadata of episodes are in tables since version 3.
        version = "3.0" if any(path.glob("meta/episodes/*/*.parquet")) else "2.1"
    if not version.startswith(("2.", "3.")):
        raise SceneError(
            f"{file}: a LeRobot data set of version v{version}, but only 2.0, 2.1 and 3.0 are "
            "supported: convert it with LeRobot's scripts"
        )
    return {**info, "codebase_version": version}


def _rate(info: Mapping[str, Any]) -> float | None:
    """Return the rows per second of `meta/info.json`; None: it has none that is positive."""
    try:
        rate = float(info.get("fps") or 0.0)
    except (TypeError, ValueError):
        return None
    return rate if np.isfinite(rate) and rate > 0.0 else None


def _episode_rows(
    path: Path, info: Mapping[str, Any], parquet: Any
) -> dict[int, Mapping[str, Any]]:
    """Return the metadata of the episodes.

    They are in `meta/episodes/*/*.parquet` (version 3) or `meta/episodes.jsonl` (version 2).
    Without either file the episodes are numbered from 0 to `total_episodes` - 1.

    ``parquet``: the module pyarrow.parquet. Raises SceneError: the metadata are damaged.
    """
    rows: dict[int, Mapping[str, Any]] = {}
    for file in sorted(path.glob("meta/episodes/*/*.parquet")):
        # Skip the statistics, which are most of the columns.
        with naming_damage(file, "is damaged: not a whole table with episode_index"):
            columns = parquet.read_schema(file).names
            used = [one for one in columns if one.startswith(("episode_index", "data/", "videos/"))]
            found = parquet.read_table(file, columns=used).to_pylist()
            rows |= {int(row["episode_index"]): row for row in found}
    lines = path / "meta" / "episodes.jsonl"
    if not rows and lines.is_file():
        for k, line in enumerate(read_regular(lines).decode("utf-8", "replace").splitlines(), 1):
            with naming_damage(lines, f"is damaged: line {k} is no JSON with episode_index"):
                rows |= {int(json.loads(line)["episode_index"]): {}} if line.strip() else {}
    if not rows:
        count = len([*path.glob("data/**/*.parquet")])
        rows = {k: {} for k in range(_count(path, info, "total_episodes", count))}
    return rows


def _count(path: Path, info: Mapping[str, Any], field: str, default: int) -> int:
    """Return a number of `meta/info.json`; ``default`` if there is none.

    Raises SceneError: it is no whole number.
    """
    found = info.get(field)
    try:
        return default if found is None else int(found)
    except (ValueError, TypeError) as error:
        raise SceneError(f"{path / INFO}: {field} must be a number, not {found!r}") from error


def _file(
    path: Path, info: Mapping[str, Any], metadata: Metadata, number: int, key: str = ""
) -> Path:
    """Return the file of an episode's data, or of the video of a camera; it may be missing.

    The words in the templates of `meta/info.json` may be those of either version. Without a
    template it is the version's own. ``number``: of the episode. ``key``: the camera's feature; "":
    the data. Raises SceneError: the template has an unknown word, or one whose value is not known.
    """
    is_v3, which = info["codebase_version"].startswith("3."), "video_path" if key else "data_path"
    # The templates of versions 2 and 3.
    own = [
        "data/chunk-{chunk_index:03d}/episode_{episode_index:06d}.parquet",
        "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    ]
    if key:
        own = [
            "videos/chunk-{chunk_index:03d}/{video_key}/episode_{episode_index:06d}.mp4",
            "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        ]
    given = info.get(which)
    templates = [str(given).replace("\\", "/")] if given else own[::-1] if is_v3 else own
    size = _count(path, info, "chunks_size", 1000) or 1000
    chunk, row, where = number // size, metadata[number], f"videos/{key}" if key else "data"
    values: dict[str, Any] = dict.fromkeys(("video_key", "image_key", "camera_key", "key"), key)
    values |= dict.fromkeys(("episode_index", "episode_id", "episode"), number)
    values |= dict.fromkeys(("episode_chunk", "chunk"), chunk)
    values["chunk_index"] = row.get(f"{where}/chunk_index", chunk)
    # In version 2 each episode has its own file, numbered on or from 0 in each chunk.
    indices = [row.get(f"{where}/file_index", number), number % size]
    files, lacking = list[Path](), ""
    for template in templates:
        if is_v3 and "{file_index" in template and f"{where}/file_index" not in row:
            lacking = (
                f"{path}: the file of episode {number} is not known: its {which} is '{template}', "
                f"and the column {where}/file_index of meta/episodes/*/*.parquet is missing: copy "
                "the whole folder meta"
            )
            continue
        try:
            names = [template.format(**values, file_index=index) for index in indices]
        except (LookupError, ValueError, AttributeError) as error:
            raise SceneError(
                f"{path / INFO}: the {which} '{template}' cannot be filled in ({error}); known "
                f"words are {', '.join(values)}, file_index"
            ) from error
        files += [path_inside(path, name, f"{path / INFO}: {which}") for name in names]
    found = next((file for file in files if file.is_file()), None)
    if found is None and lacking:
        raise SceneError(lacking)
    return found or files[0]


def _choose_episode(
    path: Path, info: Mapping[str, Any], metadata: Metadata, wanted: int | None
) -> int:
    """Return the number of the wanted episode, or of the only one whose data are present.

    ``wanted``: None: the only one. Raises UnknownNameError: the data of the wanted episode are not
    present; SceneError: none was wanted, and the data of none or of several episodes are present.
    """
    numbers = list(metadata)
    candidates = numbers if wanted is None else [one for one in numbers if one == wanted]
    present = [one for one in candidates if _file(path, info, metadata, one).is_file()]
    if len(present) == 1:
        return present[0]
    present = [one for one in numbers if _file(path, info, metadata, one).is_file()]
    names = listed([*map(str, present)], 20)
    if wanted is not None and present:
        raise UnknownNameError("episode", str(wanted), [names], str(path))
    expected = f"; expected, for one, {_file(path, info, metadata, numbers[0])}" if numbers else ""
    raise SceneError(
        f"{path}: choose an episode (--episode N); of {len(numbers)} these are present: "
        f"{names or 'none' + expected}"
    )


def _read_table(
    file: Path, info: Mapping[str, Any], number: int, parquet: Any, warnings: list[str]
) -> Any:
    """Return the table (pyarrow.Table) of an episode in a ``file``; ``parquet`` is the module.

    ``number``: of the episode. ``warnings``: appended to. Raises SceneError: the table is damaged,
    or has no row of the episode.
    """
    with naming_damage(file, "is damaged: not a whole table"):
        schema = parquet.read_schema(file)
        available = schema.names
        used = [key for key in available if key in {*info["features"], "timestamp", "frame_index"}]
        if "episode_index" not in available:
            table, others = parquet.read_table(file, columns=used), np.empty(0)
        elif str(schema.field("episode_index").type).startswith(("list", "fixed", "large")):
            # Rows of lists of one number cannot be filtered while reading.
            # The column is usually a feature, too.
            table = parquet.read_table(file, columns=list(dict.fromkeys([*used, "episode_index"])))
            others = read_numbers(table, "episode_index", str(file))[:, 0]
            table = table.filter((others == number).tolist())
        else:
            filters = [("episode_index", "=", number)]
            table = parquet.read_table(file, columns=used, filters=filters)
            if not table.num_rows:
                found = parquet.read_table(file, columns=["episode_index"])
                others = read_numbers(found, "episode_index", str(file))[:, 0]
        if table.num_rows:
            return table
        others = np.unique(others)
        if len(others) == 1 and "episode" in str(info.get("data_path") or "episode"):
            warnings.append(
                f"{file}: its column episode_index is {others[0]:g}, not {number}; all its rows "
                "are used"
            )
            return parquet.read_table(file, columns=used)
    found = listed([f"{one:g}" for one in others], 20)
    raise SceneError(
        f"{file}: is empty: it has no row of episode {number}"
        + (f"; its column episode_index has {found}" if found else "")
    )


def _read_joints(rows: _Rows) -> tuple[JointLog | None, str]:
    """Return the joint log of an episode, None if there is none, and what is wrong with it."""
    path, table, file = rows.path, rows.table, rows.file
    features = rows.info["features"]
    keys = [key for key in find_states(features) if key in table.column_names]
    if not keys:
        actions = [key for key in features if key.startswith("action")]
        lacking = (
            f"{path}: has no joint positions; give a table of them (--joints). Wanted is a feature "
            "observation.state, state, or one named after joints, with rows of numbers in "
            f"{file.name}; the data set has: {describe(features)}; the table has: "
            f"{listed(table.column_names, 20)}"
        )
        if actions:
            lacking += (
                f"; '{actions[0]}' is not used: it holds what was commanded, not what was measured"
            )
        return None, lacking
    values = [read_numbers(table, key, str(file)) for key in keys]
    names = column_names(keys, [one.shape[1] for one in values], features)
    servos, texts = find_motors(path, str(rows.info.get("robot_type") or ""), names)
    rows.warnings.extend(texts)
    return JointLog(names, rows.stamps, np.column_stack(values), servos=servos), ""


def _read_camera(rows: _Rows, key: str) -> Stream:
    """Return a camera of an episode: of a video with its times, or of images with the rows' times.

    ``key``: the camera's feature. Raises SceneError: the camera's images are missing or damaged.
    """
    feature, table = rows.info["features"][key], rows.table
    if feature.get("dtype") == "video":
        video = _file(rows.path, rows.info, rows.metadata, rows.number, key)
        if video.is_file():
            return _video_camera(rows, key, video)
        if key not in table.column_names:
            raise SceneError(f"{video} is missing")
    column = table[key] if key in table.column_names else None

    def recorded(k: int) -> Picture:
        cell = None if column is None else column[k]
        return stored_picture(rows.path, rows.file, key, cell, shape_of(feature), rows.number, k)

    height, width = recorded(0).shape[:2]
    return Stream(key, width, height, rows.stamps, None, None, recorded)


def _video_camera(rows: _Rows, key: str, file: Path) -> Stream:
    """Return the camera of a video, restricted to an episode; times start at 0 with the episode.

    Images up to half a period before the start belong to the episode, and those after the end less
    this do not. A video with as many images as rows, which begins at another time than the
    metadata say, has the rows' images in order.

    ``key``: the camera's feature. ``file``: the video. Raises SceneError: the video is unreadable,
    or has no image in the episode.
    """
    row, count, warnings = rows.metadata[rows.number], rows.table.num_rows, rows.warnings
    video, name = Video(file), key.removeprefix("observation.").removeprefix("images.")
    where = f"videos/{key}"
    ends = [f"{where}/{end}_timestamp" for end in ("from", "to")]
    spans = np.array([[0.0, np.inf]])
    span = spans[0]
    if all(isinstance(row.get(end), int | float) for end in ends):
        places = [f"{where}/chunk_index", f"{where}/file_index"]
        same = [
            one
            for one in rows.metadata.values()
            if all(one.get(place) == row.get(place) for place in places)
        ]
        spans = np.array([[float(one[end]) for end in ends] for one in same])
        span = np.array([float(row[end]) for end in ends])
    steps = np.diff(video.times)
    rate = _rate(rows.info) or (1.0 / float(np.median(steps)) if len(steps) else 1.0)
    half = 0.5 / rate
    begin = float(spans[:, 0].min())
    total = (float(spans[:, 1].max()) - begin) * rate
    for first, expected in ((float(span[0]), count), (begin, total)):
        late = float(video.times[0]) - first
        if abs(late) > half and abs(len(video.times) - expected) < 0.5:
            warnings.append(
                f"camera '{name}': {file} begins at {video.times[0]:.3f} s, not at {first:.3f} s, "
                "but has as many pictures as the table has rows: they are paired in their order"
            )
            span = span + late
            break
    first, last = np.searchsorted(video.times, span - half).tolist()
    if first == last:
        raise SceneError(
            f"{file}: has pictures from {video.times[0]:.3f} to {video.times[-1]:.3f} s, but the "
            f"episode is from {span[0]:.3f} to {span[1]:.3f} s"
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
    return Stream(name, video.width, video.height, times, None, None, recorded)


def _from_start(
    rows: _Rows, cameras: Sequence[Stream], own: JointLog | None, given: JointLog | None
) -> tuple[list[Stream], JointLog | None, JointLog | None]:
    """Return cameras and joint logs of an episode, their times counted from its start.

    The rows' times begin elsewhere, such as 1970, if they end after all videos. The times of videos
    begin with the episode.

    ``cameras``: the cameras; those of stored images have the times ``stamps``. ``own``: the data
    set's own log, with the times ``stamps``; None: none. ``given``: the user's log; None: none. It
    is moved, too, if it is from the rows' times.
    """
    stamps, known = rows.stamps, rows.stamps[np.isfinite(rows.stamps)]
    period = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    videos = [one.times for one in cameras if one.times is not stamps]
    start, last = float(known[0]), float(known[-1])
    end = max((float(times[-1]) for times in videos), default=last - start)
    if start <= 0.5 * period or last <= end + 1.5 * period:
        return [*cameras], own, given
    rows.warnings.append(
        f"{rows.file}: the rows' times begin at {start:.6g} s, so they are counted from the first "
        "row"
    )
    moved = [
        one if any(one.times is times for times in videos) else replace(one, times=stamps - start)
        for one in cameras
    ]
    own = own and replace(own, times=stamps - start)
    if given is not None and given.times is not None and given.times[-1] > 0.5 * start:
        given = replace(given, times=given.times - start)
    return moved, own, given
