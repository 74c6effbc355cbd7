"""Read episodes of LeRobot data sets (versions 2.0, 2.1 and 3.0) and of DROID.

DROID's raw folders, `trajectory.h5` and a video of each ZED camera, are written by `robot_env.py`
and `camera_utils/camera_readers/zed_camera.py` of droid-dataset/droid.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Picture
from drake_pose.camera.episode import Episode, EpisodeCamera, JointLog, ascending_indices
from drake_pose.camera.models import PinholeCamera
from drake_pose.camera.picture_files import TimedVideo, decode_colours, import_reader
from drake_pose.errors import SceneError, UnknownNameError, listed
from drake_pose.regular_files import read_regular, require_regular

INFO = Path("meta", "info.json")
TRAJECTORY = "trajectory.h5"
"""Files by which LeRobot data sets and DROID episodes are recognised."""


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
            joints = JointLog(tuple(names), times[kept], positions[kept])
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


def open_droid(path: Path, joints: JointLog | None) -> Episode:
    """Open a folder with `trajectory.h5` and `recordings/MP4/<serial>.mp4`.

    Image k belongs to row k. Its time is the row's time stamp, or that in
    `<serial>_timestamps.json` beside the video. The arm's joints are joint1 to joint7 [rad];
    gripper_position is 0 for open and 1 for closed.

    Args:
        path: the folder.
        joints: joint log to use instead of the trajectory's; None: the trajectory's.

    Raises:
        SceneError: names the file that is missing or damaged.
    """
    h5py = import_reader("h5py", path)
    where, folder = path / TRAJECTORY, path / "recordings" / "MP4"
    state, stamps = "observation/robot_state", "observation/timestamp/robot_state"
    cameras: list[EpisodeCamera] = []
    try:
        require_regular(where)
        with h5py.File(where) as file:
            arm, gripper, start, end = (
                _dataset(file, name, where)
                for name in (
                    *(f"{state}/joint_positions", f"{state}/gripper_position"),
                    *(f"{stamps}/read_start", f"{stamps}/read_end"),
                )
            )
            times = 1e-3 * 0.5 * (start + end)
            kept, warnings = ascending_indices(times, f"{where}: rows")
            names = (*(f"joint{k + 1}" for k in range(arm.shape[1])), "gripper_position")
            own = JointLog(names, times[kept], np.column_stack([arm, gripper])[kept])
            for video in sorted(folder.glob("*.mp4")):
                cameras += _zed_cameras(file, video, warnings)
    except (OSError, ValueError, LookupError, RuntimeError) as error:
        raise SceneError(f"{where}: truncated or damaged: {error}") from error
    if not cameras:
        raise SceneError(
            f"{folder}: has no <serial>.mp4; export files of recordings/SVO as MP4 first "
            "(svo_to_mp4.py of DROID)"
        )
    return Episode.checked(path, cameras, joints or own, warnings)


def _dataset(file: Any, name: str, where: Path) -> Array:
    """Return the numbers of a table in an HDF5 file; SceneError if it is missing.

    Args:
        file: the open file (h5py.File).
        name: path of the table in the file.
        where: the file's path, for messages.
    """
    found = file
    for part in name.split("/"):
        if part not in found:
            raise SceneError(f"{where}: has no {name}; {found.name} has: {', '.join(found)}")
        found = found[part]
    return np.asarray(found[()], dtype=np.float64)


def _zed_cameras(
    file: Any,
    path: Path,
    warnings: list[str],
    *,
    stereo: float = 2.5,
    calibrated: tuple[int, int] = (1280, 720),
) -> list[EpisodeCamera]:
    """Return the camera of a video, or both cameras of a side-by-side stereo video.

    Args:
        file: the open trajectory (h5py.File).
        path: the video, `<serial>.mp4` or `<serial>-stereo.mp4`.
        warnings: list to which warnings are appended.
        stereo: minimum ratio of width to height of a stereo video.
        calibrated: width and height of the images to which the intrinsics apply: HD720 [pixel].
    """
    video, serial = TimedVideo(path), path.stem.removesuffix("-stereo")
    times = _picture_times(file, path, serial, len(video.times), warnings)
    kept, late = ascending_indices(times, f"{path}: pictures")
    hand = file.get(f"observation/camera_type/{serial}")
    is_on_hand = hand is not None and not np.any(hand[()])
    if is_on_hand:
        late.append(f"camera '{serial}' is on the hand (camera_type 0): it moves with the arm")
    warnings += [*video.warnings, *late]
    sides = ("_left", "_right") if video.width > stereo * video.height else ("",)
    width, cameras = video.width // len(sides), []
    for k, side in enumerate(sides):
        name, camera, pose = f"{serial}{side}", None, None
        # A video of one camera is that of the left one.
        given = f"{serial}{side or '_left'}"
        matrix = file.get(f"observation/camera_intrinsics/{given}")
        if matrix is not None:
            fx, _, cx, _, fy, cy = np.ravel(matrix[()])[:6].tolist()
            rows = file.get(f"observation/camera_extrinsics/{given}")
            if rows is not None and not is_on_hand:
                pose = recorded_pose(rows[()], name, warnings)
            X_WC = np.eye(4) if pose is None else pose
            camera = PinholeCamera(name, *calibrated, fx, fy, cx, cy, X_WC)
            camera = camera.resized(width, video.height)

        def recorded(number: int, begin: int = k * width) -> Picture:
            picture = video.read(int(kept[number]))
            return np.ascontiguousarray(picture[:, begin : begin + width])

        size, is_posed = (width, video.height), pose is not None
        cameras.append(
            EpisodeCamera(name, *size, times[kept], camera, None, recorded, is_posed=is_posed)
        )
    return cameras


def recorded_pose(
    rows: Any, name: str, warnings: list[str], moved: float = 0.005, turned: float = 0.005
) -> Array | None:
    """Return the pose X_WC (4, 4) of a still camera, W being the robot's base, as DROID records it.

    DROID's rows are the position [m], and the angles of rotations about the fixed axes x, y and z
    in this order [rad]. The result is the rows' median.

    Args:
        rows: (n, 6) rows; an array of another shape, or with values that are not finite, is ignored
            with a warning.
        name: the camera's name, for messages.
        warnings: list to which warnings are appended.
        moved, turned: range of a row's positions [m] and angles [rad] above which a warning says
            that the camera moved.
    """
    values = np.asarray(rows, dtype=np.float64)
    values = values.reshape(-1, 6) if values.shape[-1:] == (6,) and values.size else values
    if values.shape[1:] != (6,) or not np.isfinite(values).all():
        warnings.append(
            f"camera '{name}': its recorded extrinsics are not x, y, z, roll, pitch, yaw in each "
            "row and are ignored; give X_WC in a camera file (--cameras)"
        )
        return None
    # Angles near half a turn change their sign from row to row.
    values = np.column_stack([values[:, :3], np.unwrap(values[:, 3:], axis=0)])
    spread = np.ptp(values, axis=0)
    if spread[:3].max() > moved or spread[3:].max() > turned:
        warnings.append(
            f"camera '{name}': its recorded extrinsics vary by {1e3 * spread[:3].max():.0f} mm and "
            f"{np.degrees(spread[3:].max()):.1f} degrees; their median is used"
        )
    middle = np.median(values, axis=0)
    X_WC = np.eye(4)
    X_WC[:3, :3] = Rotation.from_euler("xyz", middle[3:]).as_matrix()
    X_WC[:3, 3] = middle[:3]
    return X_WC


def _picture_times(file: Any, path: Path, serial: str, count: int, warnings: list[str]) -> Array:
    """Return the times [s] of a video's first images; at most ``count``, fewer if some are missing.

    They are those in `<video>_timestamps.json`, minus the camera's median delay, if that file
    exists, or else those of the trajectory's rows: of capture, reception or reading, by the first
    that there is.

    Args:
        file: the open trajectory (h5py.File).
        path: the video.
        serial: serial number of the camera.
        count: number of images of the video.
        warnings: list to which warnings are appended.
    """
    stamps = "observation/timestamp/cameras"
    kinds = ("estimated_capture", "frame_received", "read_end")
    available = [kind for kind in kinds if f"{stamps}/{serial}_{kind}" in file] or [kinds[0]]
    read = [_dataset(file, f"{stamps}/{serial}_{kind}", path) for kind in available]
    times, source = read[0], TRAJECTORY
    beside = path.with_name(f"{path.stem}_timestamps.json")
    if beside.exists():
        # These are reception times: subtract the camera's delay, known from the rows.
        delay = np.median(read[1] - times) if available[:2] == [*kinds[:2]] else 0.0
        times, source = np.array(json.loads(read_regular(beside))) - delay, beside.name
    if len(times) != count:
        warnings.append(
            f"{path}: has {count} pictures, but {source} has {len(times)} times: they are paired "
            "from the first on and the rest is left out, so pairs may be shifted by the difference"
        )
    return 1e-3 * times[:count]  # Stamps are milliseconds.
