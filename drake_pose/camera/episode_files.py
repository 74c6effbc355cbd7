"""Open recorded episodes of any format; read folders with a joint table, and DROID's.

DROID's raw folders have `trajectory.h5` and a video of each ZED camera. They are written by
`robot_env.py` and `camera_utils/camera_readers/zed_camera.py` of droid-dataset/droid.
"""

import json
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Picture
from drake_pose.camera.bags import BAGS, open_bag
from drake_pose.camera.camera_files import CameraFile, intrinsics_of, load_camera_file
from drake_pose.camera.episode import Episode, JointLog, Stream, ascending_indices
from drake_pose.camera.lerobot import INFO, open_lerobot
from drake_pose.camera.models import Camera, Lens, PinholeCamera, pose_matrix
from drake_pose.camera.picture_files import (
    VIDEOS,
    Video,
    find_pictures,
    find_recorded_files,
    frame_key,
    import_reader,
    naming_damage,
    read_picture,
)
from drake_pose.camera.pose_files import choose_frames
from drake_pose.camera.sources import CAMERAS, TIME_STAMPS, picture_times
from drake_pose.errors import CameraError, SceneError, SettingsError, listed
from drake_pose.input_files import (
    named_fields,
    read_csv,
    read_number,
    read_regular,
    read_yaml,
    require_regular,
)

JOINT_TABLE = "joint_angles.csv"
"""Name of the joint table in a recording's folder."""

TRAJECTORY = "trajectory.h5"
"""File by which DROID episodes are recognised."""


def read_joint_table(path: Path) -> tuple[JointLog, list[str]]:
    """Return a joint log from a CSV table, and warnings about rows that were left out.

    The table has a column `time` [s] or `frame`, or both, and one column per joint. Empty cells
    become nan.

    Raises SceneError: the table is unreadable or empty, has neither column or no joint, a duplicate
    column or frame, a cell that is not a number, or times that run backwards.
    """
    header, rows = read_csv(path, SceneError)
    columns = dict(zip(header, zip(*(cells for _, cells in rows), strict=True), strict=False))
    names = tuple(name for name in header if name not in ("time", "frame"))
    if len(names) in (0, len(header)) or len(set(header)) < len(header) or not rows:
        raise SceneError(
            f"{path}: expected one column 'time' [s] or 'frame', one for each joint, and rows, but "
            f"it has {len(rows)} rows of: {', '.join(header)}"
        )
    frames = columns.pop("frame", ())
    if len(counts := Counter(map(frame_key, frames))) < len(frames):
        raise SceneError(f"{path}: has frame {counts.most_common(1)[0][0]} more than once")
    values = {name: np.empty(len(rows)) for name in columns}
    for name, cells in columns.items():
        for k, cell in enumerate(cells):
            try:
                values[name][k] = read_number(cell)
            except ValueError:
                raise SceneError(
                    f"{path}: line {rows[k][0]}, column '{name}': '{cell[:40]}' is not a number"
                ) from None
    positions = np.column_stack([values[name] for name in names])
    log = JointLog(names, values.get("time"), positions, frames)
    if log.times is None:
        return log, []
    kept, warnings = ascending_indices(log.times, f"{path}: rows")
    return log.only(kept), warnings


def open_folder(path: Path, joints: JointLog | None) -> Episode:
    """Open a folder with `videos/<camera>.mp4` or `images/<camera>/<frame>.png`, and a joint table.

    The cameras are those of the folders, the videos and `cameras.yaml`, which may be missing.

    ``joints``: joint log to use instead of the folder's `joint_angles.csv`; None: that, if it
    exists. Raises SceneError: images or the table are unusable; CameraError: the camera file is
    unusable.
    """
    warnings: list[str] = []
    if joints is None and (path / JOINT_TABLE).exists():
        joints, warnings = read_joint_table(path / JOINT_TABLE)
    calibration = CameraFile({}, ())
    if (path / CAMERAS).exists():
        calibration = load_camera_file(path / CAMERAS, distorted=True)
    names = [*calibration.cameras]
    names += [one.name for one in sorted(path.glob("images/*")) if one.is_dir()]
    names += [one.stem for one in sorted(path.glob("videos/*")) if one.suffix.lower() in VIDEOS]
    cameras = []
    recorded = {name: find_recorded_files(path, name) for name in dict.fromkeys(names)}
    for name, files in recorded.items():
        if isinstance(files, dict):
            files = files or find_pictures(path / "images" / name, name)
            camera, camera_warnings = _image_camera(name, files, path / "scene.yaml", joints)
        elif files is not None:
            video = Video(files)
            camera, camera_warnings = video_camera(name, video), video.warnings
            if joints is not None and joints.times is not None and joints.frames:
                times = _times_of_rows(joints, camera.frames)
                camera = camera if np.isnan(times).all() else replace(camera, times=times)
        else:
            warnings.append(f"camera '{name}' of {CAMERAS} has no pictures; it is left out")
            continue
        warnings += camera_warnings
        if name not in calibration.cameras:
            warnings.append(
                f"camera '{name}' has no entry in {CAMERAS}: its lens is unknown; calibrate it"
            )
        cameras.append(add_calibration(camera, calibration, path / CAMERAS))
    if joints is not None and joints.times is not None and not joints.frames:
        is_video = [isinstance(recorded[one.name], Path) for one in cameras]
        if all(is_video) and not any(
            joints.times[0] <= one.times[-1] and one.times[0] <= joints.times[-1] for one in cameras
        ):
            spans = ", ".join(f"'{one.name}' {_span(one.times)}" for one in cameras)
            warnings.append(
                f"no picture is within the joint log, {_span(joints.times)}; pictures: {spans}: "
                "both are counted from their starts"
            )
            cameras = [replace(one, times=one.times - one.times[0]) for one in cameras]
            joints = replace(joints, times=joints.times - joints.times[0])
    return Episode.checked(path, cameras, joints, warnings)


def video_camera(name: str, video: Video) -> Stream:
    """Return a camera by a video; its frames are named as in a scene: 000000, 000001 and so on."""
    frames = tuple(f"{k:06d}" for k in range(len(video.times)))
    size = video.width, video.height
    return Stream(name, *size, video.times, None, None, video.read, frames)


def _span(times: Array) -> str:
    """Return the first and last of times [s], for messages."""
    return f"{times[0]:.3f} to {times[-1]:.3f} s"


def _times_of_rows(joints: JointLog, frames: Sequence[str]) -> Array:
    """Return the times (n,) [s] of the joint log's rows of n frames; nan where there is no row."""
    assert joints.times is not None
    clock = JointLog(("time",), None, joints.times[:, None], joints.frames)
    return clock.of_frames(frames)[:, 0]


def _image_camera(
    name: str, files: Mapping[str, Path], scene: Path, joints: JointLog | None
) -> tuple[Stream, list[str]]:
    """Return a camera by its image files by frame, and warnings about incomplete frames.

    The times of its images are those of their folder's `timestamps.csv`, or else those of the same
    frames in the joint log, or else follow from the frame rate in scene.yaml, or else are nan.

    ``scene``: path of the scene.yaml, which may be missing. Raises SceneError: a file is unusable.
    """
    warnings, stamps = list[str](), next(iter(files.values())).with_name(TIME_STAMPS)
    is_logged = joints is not None and joints.times is not None and bool(joints.frames)
    timed = picture_times(files, None if is_logged else read_sequence(scene)[1])
    if lacking := sorted(timed.keys() ^ files.keys()):
        warnings.append(
            f"{stamps}: {len(lacking)} frames have no picture, or no time, and are left out; the "
            f"first is {lacking[0]}"
        )
    frames = tuple(frame for frame in timed if frame in files)
    times = np.array([timed[frame] for frame in frames])
    kept = np.arange(len(frames))
    if np.isfinite(times).any():
        kept, late = ascending_indices(times, str(stamps))
        warnings += late
    elif joints is not None and is_logged:
        times = _times_of_rows(joints, frames)
    height, width = read_picture(files[frames[0]]).shape[:2]

    def recorded(k: int) -> Picture:
        return read_picture(files[frames[k]])

    return Stream(name, width, height, times, None, None, recorded, frames).only(kept), warnings


def read_sequence(path: Path, sequence: bool = False) -> tuple[bool, float | None]:
    """Return whether frames are a sequence, and their rate [Hz] or None, by a scene.yaml.

    ``path``: the file, which may be missing. ``sequence``: whether frames are a sequence if the
    file does not say. Raises SceneError: the file is unreadable or has other content.
    """
    if not os.path.lexists(path):
        return sequence, None
    fields = ("sequence", "frame_rate_hz")
    content = named_fields(read_yaml(path, SceneError), fields, str(path), SceneError)
    sequence = content.get("sequence", sequence)
    if not isinstance(sequence, bool):
        raise SceneError(f"{path}: sequence must be true or false")
    rate = content.get("frame_rate_hz")
    if rate is None:
        return sequence, None
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0.0 < rate < math.inf:
        raise SceneError(f"{path}: frame_rate_hz must be a finite positive number")
    return sequence, float(rate)


def add_calibration(camera: Stream, calibration: CameraFile, path: Path) -> Stream:
    """Return a recorded camera with its intrinsics, pose, link and lens of a camera file.

    A camera without entry in the file is returned as it is. ``path``: the file, for messages.
    Raises CameraError: the calibration does not fit the images.
    """
    found, where = calibration.cameras.get(camera.name), f"{path}: camera '{camera.name}'"
    if found is None:
        return camera
    if not isinstance(found, PinholeCamera):
        raise CameraError(f"{where}: is parallel, but pictures need a pinhole camera")
    if (found.width, found.height) != (camera.width, camera.height):
        raise CameraError(
            f"{where}: has {found.width} x {found.height} pixels (width x height), but its "
            f"pictures {camera.width} x {camera.height}: give the calibration of these pictures"
        )
    link, lens = calibration.links.get(camera.name), calibration.lenses.get(camera.name)
    is_posed = camera.name not in calibration.unplaced
    return replace(camera, camera=found, link=link, lens=lens, is_posed=is_posed)


def recorded_intrinsics(
    cameras: Sequence[Stream], path: Path, intrinsics: Path | None
) -> CameraFile:
    """Return an episode's cameras with intrinsics, by their names in the episode.

    Those of a file for pictures of another size but the same shape are scaled.

    ``cameras``: the cameras that are used. ``path``: the episode's folder or file. ``intrinsics``:
    a camera file; None: the episode's cameras.yaml, or else its recorded ones.
    """
    read = intrinsics_of(path / CAMERAS, intrinsics, distorted=True)()
    if read is None:
        own = {one.name: one.camera for one in cameras if one.camera is not None}
        lenses = {one.name: one.lens for one in cameras if one.lens is not None}
        return CameraFile(dict(own), tuple(own), lenses=lenses)
    found, lenses, streams = dict[str, Camera](), dict[str, Lens](), {c.name: c for c in cameras}
    pinholes = {k: v for k, v in read.cameras.items() if isinstance(v, PinholeCamera)}
    meant = choose_frames(pinholes, [*streams], intrinsics or path / CAMERAS)
    for name, frame in meant.items():
        given, size = pinholes[frame], (streams[name].width, streams[name].height)
        if frame in read.lenses:
            lenses[name] = read.lenses[frame]
        elif abs(size[0] * given.height - size[1] * given.width) <= max(size):
            given = given.resized(*size)
        found[name] = replace(given, name=name)
    return CameraFile(found, tuple(found), lenses=lenses)


def recording_format(path: Path) -> Literal["lerobot", "droid", "bag", "folder", ""]:
    """Return the format of a recording, by the first of these names; "" for none, such as masks.

    "lerobot": the folder has `meta/info.json`. "droid": it has `trajectory.h5` or is that file.
    "bag": it has a bag's suffix or `metadata.yaml`. "folder": it has `images` or `videos`. "bag":
    it has a file with a bag's suffix.
    """
    inside = sorted(one.name for one in path.iterdir()) if path.is_dir() else []
    if (path / INFO).exists():
        return "lerobot"
    if path.name == TRAJECTORY or TRAJECTORY in inside:
        return "droid"
    if path.suffix in BAGS or "metadata.yaml" in inside:
        return "bag"
    if {"images", "videos"} & set(inside):
        return "folder"
    return "bag" if any(name.endswith(BAGS) for name in inside) else ""


def require_recording(path: Path) -> None:
    """Raise SceneError, naming subfolders, if a folder has no masks and is no recording."""
    inside = sorted(one for one in path.iterdir() if one.is_dir()) if path.is_dir() else []
    found = [
        one.name for one in (path, *inside) if (one / "masks").is_dir() or recording_format(one)
    ]
    if not found or found[0] != path.name:
        raise SceneError(
            f"{path}: has no folder masks/<camera>/<frame>.png, and no pictures, videos, data set "
            "or bag" + (f"; give one of its subfolders: {listed(found)}" if found else "")
        )


def open_episode(
    path: str | Path, *, joints: str | Path | None = None, episode: int | None = None
) -> Episode:
    """Open an episode of any of the formats in `tutorials/file_formats.md`.

    ``path``: folder or file of the recording. ``joints``: CSV table of joint positions to use
    instead of the recording's own; None: its own, if it has any. ``episode``: number of the episode
    in a LeRobot data set; None: the only one that is present.

    Raises SceneError: names what was found and expected, what is damaged or missing, or a missing
    library of the extra `episodes`; UnknownNameError: the data set does not contain the episode;
    SettingsError: a number was given for a recording with a single episode; CameraError: a camera
    file is unusable.
    """
    path = Path(path)
    expected = (
        f"expected a LeRobot data set ({INFO}), a folder of DROID ({TRAJECTORY}), a bag (.bag, "
        ".mcap, .db3, or a folder with metadata.yaml), or a folder with videos/<camera>.mp4 or "
        "images/<camera>/<frame>.png"
    )
    if not path.exists():
        raise SceneError(f"{path}: no such folder or file; {expected}")
    log, warnings = (None, []) if joints is None else read_joint_table(Path(joints))
    kind = recording_format(path)
    if episode is not None and kind != "lerobot":
        raise SettingsError(
            f"--episode {episode}: {path} is a single episode, not a LeRobot data set"
        )
    inside = sorted(one.name for one in path.iterdir()) if path.is_dir() else []
    bags = [path]
    if path.is_dir() and "metadata.yaml" not in inside:
        bags = [path / name for name in inside if name.endswith(BAGS)]
    if kind in ("", "folder") and any((path / "data").rglob("*.parquet")):
        raise SceneError(
            f"{path}: has the tables of a LeRobot data set, but no {INFO}, which says what they "
            "hold: copy the data set's folder meta"
        )
    if kind == "bag" and len(bags) > 1:
        raise SceneError(
            f"{path}: has {len(bags)} bags and no metadata.yaml: give one of them, "
            f"{listed([one.name for one in bags])}, or write the file (ros2 bag reindex)"
        )
    if not kind:
        what = ", ".join(inside[:8]) if path.is_dir() else "a file of another kind"
        raise SceneError(f"{path}: is not an episode: {what or 'empty'}; {expected}")
    found = {
        "lerobot": lambda: open_lerobot(path, log, episode),
        "droid": lambda: open_droid(path.parent if path.is_file() else path, log),
        "bag": lambda: open_bag(bags[0], log),
        "folder": lambda: open_folder(path, log),
    }[kind]()
    return replace(found, warnings=(*warnings, *found.warnings))


def open_droid(path: Path, joints: JointLog | None) -> Episode:
    """Open a folder with `trajectory.h5` and `recordings/MP4/<serial>.mp4`.

    Image k belongs to row k. Its time is the row's time stamp, or that in
    `<serial>_timestamps.json` beside the video. The arm's joints are joint1 to joint7 [rad];
    gripper_position is 0 for open and 1 for closed.

    ``path``: the folder. ``joints``: joint log to use instead of the trajectory's; None: the
    trajectory's. Raises SceneError: names the file that is missing or damaged.
    """
    h5py = import_reader("h5py", path)
    where, folder = path / TRAJECTORY, path / "recordings" / "MP4"
    state, stamps = "observation/robot_state", "observation/timestamp/robot_state"
    cameras, warnings = list[Stream](), list[str]()
    with naming_damage(where, "truncated or damaged"):
        require_regular(where)
        with h5py.File(where) as file:
            arm, gripper, start, end = (
                _dataset(file, name, where)
                for name in (
                    *(f"{state}/joint_positions", f"{state}/gripper_position"),
                    *(f"{stamps}/read_start", f"{stamps}/read_end"),
                )
            )
            shapes = [one.shape for one in (arm, gripper, start, end)]
            if arm.ndim != 2 or len({shape[:1] for shape in shapes}) > 1:
                raise SceneError(
                    f"{where}: truncated or damaged: joint_positions, gripper_position, read_start "
                    f"and read_end have the shapes {', '.join(map(str, shapes))}, but n x 7 and "
                    "three times n are expected"
                )
            times = 1e-3 * 0.5 * (start + end)
            names = (*(f"joint{k + 1}" for k in range(arm.shape[1])), "gripper_position")
            own = JointLog(names, times, np.column_stack([arm, gripper]))
            for video in sorted(folder.glob("*.mp4")):
                cameras += _zed_cameras(file, video, warnings)
    if not cameras:
        files = sorted(one for one in (path / "recordings").rglob("*") if one.is_file())
        found = listed([str(one.relative_to(path)) for one in files]) or "no recordings"
        raise SceneError(
            f"{folder}: has no <serial>.mp4; export files of recordings/SVO as MP4 first "
            f"(svo_to_mp4.py of DROID); the folder has {found}"
        )
    return Episode.checked(path, cameras, joints or own, warnings)


def _dataset(file: Any, name: str, where: Path) -> Array:
    """Return the numbers of a table of an open HDF5 file.

    Raises SceneError (``where``): it is missing, or in another file.
    """
    found = file
    for part in name.split("/"):
        inside = [*found] if hasattr(found, "keys") else ["a table"]
        if part not in inside:
            raise SceneError(f"{where}: has no {name}; {found.name} has: {', '.join(inside)}")
        if other := getattr(found.get(part, getlink=True), "filename", None):
            raise SceneError(
                f"{where}: {found.name.rstrip('/')}/{part} is a link to {other}, and no other "
                "file is opened: copy the table into this one"
            )
        found = found[part]
    if getattr(found, "external", None) or getattr(found, "is_virtual", False):
        raise SceneError(f"{where}: the numbers of {name} are in other files: copy them into it")
    return np.asarray(found[()], dtype=np.float64)


def _zed_cameras(
    file: Any,
    path: Path,
    warnings: list[str],
    *,
    stereo: float = 2.5,
    calibrated: tuple[int, int] = (1280, 720),
) -> list[Stream]:
    """Return the camera of a video, or both cameras of a side-by-side stereo video.

    ``file``: the open trajectory (h5py.File). ``path``: the video, `<serial>.mp4` or
    `<serial>-stereo.mp4`. ``warnings``: appended to. ``stereo``: minimum ratio of width to height
    of a stereo video. ``calibrated``: size of images to which intrinsics apply: HD720 [pixel].
    """
    video, serial = Video(path), path.stem.removesuffix("-stereo")
    times = _picture_times(file, path, serial, len(video.times), warnings)

    def table(name: str) -> Array | None:
        name = f"observation/{name}"
        return _dataset(file, name, Path(file.filename)) if name in file else None

    hand = table(f"camera_type/{serial}")
    is_on_hand = hand is not None and not hand.any()
    if is_on_hand:
        warnings.append(
            f"camera '{serial}' is on the hand (camera_type 0): it moves with the arm; register "
            f"finds it on its link (--on LINK --camera {serial})"
        )
    warnings += video.warnings
    sides = ("_left", "_right") if video.width > stereo * video.height else ("",)
    width, cameras = video.width // len(sides), []
    for k, side in enumerate(sides):
        name, camera, pose = f"{serial}{side}", None, None
        # A video of one camera is that of the left one.
        given = f"{serial}{side or '_left'}"
        matrix = table(f"camera_intrinsics/{given}")
        rows = table(f"camera_extrinsics/{given}")
        if rows is not None and matrix is None:
            warnings.append(
                f"camera '{name}': its recorded extrinsics are not used, as {file.filename} has no "
                f"camera_intrinsics/{given}: give both in a camera file (--cameras), or estimate "
                "the pose: drake-pose register"
            )
        if matrix is not None:
            if rows is not None and not is_on_hand:
                pose = recorded_pose(rows, name, warnings)
            X_WC = np.eye(4) if pose is None else pose
            try:
                fx, _, cx, _, fy, cy = np.ravel(matrix)[:6].tolist()
                camera = PinholeCamera(name, *calibrated, fx, fy, cx, cy, X_WC)
                camera = camera.resized(width, video.height)
            except (ValueError, TypeError, CameraError) as error:
                pose = None
                warnings.append(
                    f"camera '{name}': {file.filename}: camera_intrinsics/{given} is no camera "
                    f"matrix and is ignored ({error}); give its intrinsics in a camera file "
                    "(--cameras)"
                )

        def recorded(number: int, begin: int = k * width) -> Picture:
            return np.ascontiguousarray(video.read(number)[:, begin : begin + width])

        size, is_posed = (width, video.height), pose is not None
        cameras.append(Stream(name, *size, times, camera, None, recorded, is_posed=is_posed))
    return cameras


def recorded_pose(rows: Any, name: str, warnings: list[str], moved: float = 0.005) -> Array | None:
    """Return the pose X_WC (4, 4) of a still camera, W being the robot's base, as DROID records it.

    DROID's rows are the position [m], and the angles of rotations about the fixed axes x, y and z
    in this order [rad]. The result is the rows' median.

    Args:
        rows: (n, 6) rows; an array of another shape, or with values that are not finite, is ignored
            with a warning.
        name: the camera's name, for messages.
        warnings: list to which warnings are appended.
        moved: range of positions [m] or angles [rad] above which a warning says that the camera
            moved.
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
    if spread.max() > moved:
        warnings.append(
            f"camera '{name}': its recorded extrinsics vary by {1e3 * spread[:3].max():.0f} mm and "
            f"{np.degrees(spread[3:].max()):.1f} degrees; their median is used"
        )
    middle = np.median(values, axis=0)
    return pose_matrix(Rotation.from_euler("xyz", middle[3:]).as_matrix(), middle[:3])


def _picture_times(file: Any, path: Path, serial: str, count: int, warnings: list[str]) -> Array:
    """Return the times [s] of a video's first images; at most ``count``, fewer if some are missing.

    They are those in `<video>_timestamps.json`, minus the camera's median delay, if that file
    exists, or else those of the trajectory's rows: of capture, reception or reading, by the first
    that there is.

    ``file``: the open trajectory (h5py.File). ``path``: the video. ``serial``: the camera's serial
    number. ``warnings``: appended to.
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
        try:
            stamped = np.array(json.loads(read_regular(beside)), dtype=np.float64)
        except (OSError, ValueError, TypeError) as error:
            raise SceneError(f"{beside}: is no list of times [ms]: {error}") from error
        times, source = np.ravel(stamped) - delay, beside.name
    if len(times) != count:
        warnings.append(
            f"{path}: has {count} pictures, but {source} has {len(times)} times: they are paired "
            "from the first on and the rest is left out, so pairs may be shifted by the difference"
        )
    return 1e-3 * times[:count]  # Stamps are milliseconds.
