"""Read DROID's raw folders: `trajectory.h5` and a video of each ZED camera.

They are written by `robot_env.py` and `camera_utils/camera_readers/zed_camera.py` of
droid-dataset/droid.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Picture
from drake_pose.camera.episode import Episode, EpisodeCamera, JointLog, ascending_indices
from drake_pose.camera.models import PinholeCamera
from drake_pose.camera.picture_files import TimedVideo, import_reader
from drake_pose.errors import CameraError, SceneError, listed
from drake_pose.input_files import pointer_hint, read_regular, require_regular

TRAJECTORY = "trajectory.h5"
"""File by which DROID episodes are recognised."""


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
            shapes = [one.shape for one in (arm, gripper, start, end)]
            if arm.ndim != 2 or len({shape[:1] for shape in shapes}) > 1:
                raise SceneError(
                    f"{where}: truncated or damaged: joint_positions, gripper_position, read_start "
                    f"and read_end have the shapes {', '.join(map(str, shapes))}, but n x 7 and "
                    "three times n are expected"
                )
            times = 1e-3 * 0.5 * (start + end)
            kept, warnings = ascending_indices(times, f"{where}: rows")
            names = (*(f"joint{k + 1}" for k in range(arm.shape[1])), "gripper_position")
            own = JointLog(names, times[kept], np.column_stack([arm, gripper])[kept])
            for video in sorted(folder.glob("*.mp4")):
                cameras += _zed_cameras(file, video, warnings)
    except (OSError, ValueError, LookupError, TypeError, RuntimeError) as error:
        hint = pointer_hint(where)
        raise SceneError(f"{where}: truncated or damaged: {error}{hint}") from error
    if not cameras:
        files = sorted(one for one in (path / "recordings").rglob("*") if one.is_file())
        found = listed([str(one.relative_to(path)) for one in files]) or "no recordings"
        raise SceneError(
            f"{folder}: has no <serial>.mp4; export files of recordings/SVO as MP4 first "
            f"(svo_to_mp4.py of DROID); the folder has {found}"
        )
    return Episode.checked(path, cameras, joints or own, warnings)


def _dataset(file: Any, name: str, where: Path) -> Array:
    """Return the numbers of a table of an open HDF5 file; SceneError (``where``): it is missing."""
    found = file
    for part in name.split("/"):
        inside = [*found] if hasattr(found, "keys") else ["a table"]
        if part not in inside:
            raise SceneError(f"{where}: has no {name}; {found.name} has: {', '.join(inside)}")
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
        late.append(
            f"camera '{serial}' is on the hand (camera_type 0): it moves with the arm; register "
            f"finds it on its link (--on LINK --camera {serial})"
        )
    warnings += [*video.warnings, *late]
    sides = ("_left", "_right") if video.width > stereo * video.height else ("",)
    width, cameras = video.width // len(sides), []
    for k, side in enumerate(sides):
        name, camera, pose = f"{serial}{side}", None, None
        # A video of one camera is that of the left one.
        given = f"{serial}{side or '_left'}"
        matrix = file.get(f"observation/camera_intrinsics/{given}")
        rows = file.get(f"observation/camera_extrinsics/{given}")
        if rows is not None and matrix is None:
            warnings.append(
                f"camera '{name}': its recorded extrinsics are not used, as {file.filename} has no "
                f"camera_intrinsics/{given}: give both in a camera file (--cameras), or estimate "
                "the pose: drake-pose register"
            )
        if matrix is not None:
            if rows is not None and not is_on_hand:
                pose = recorded_pose(rows[()], name, warnings)
            X_WC = np.eye(4) if pose is None else pose
            try:
                fx, _, cx, _, fy, cy = np.ravel(matrix[()])[:6].tolist()
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
            picture = video.read(int(kept[number]))
            return np.ascontiguousarray(picture[:, begin : begin + width])

        size, is_posed = (width, video.height), pose is not None
        cameras.append(
            EpisodeCamera(name, *size, times[kept], camera, None, recorded, is_posed=is_posed)
        )
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
