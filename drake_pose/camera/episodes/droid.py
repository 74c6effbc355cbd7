"""Episodes as DROID recorded them: `trajectory.h5` and a video of each ZED camera.

Source: `robot_env.py` and `camera_utils/camera_readers/zed_camera.py` of droid-dataset/droid.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.episodes.episode import Episode, EpisodeCamera, JointLog, ascending
from drake_pose.camera.models import PinholeCamera
from drake_pose.camera.video_files import TimedVideo, import_reader
from drake_pose.errors import SceneError
from drake_pose.regular_files import read_regular, require_regular

TRAJECTORY = "trajectory.h5"
_STATE, _STAMPS = "observation/robot_state", "observation/timestamp"
_MILLISECOND = 1e-3
# Two pictures side by side are more than so many times as wide as high; no single one is.
_STEREO = 2.5
# The size of the pictures that the intrinsics are of: the cameras' HD720.
_HD720 = (1280, 720)


def open_droid(path: Path, joints: JointLog | None) -> Episode:
    """Opens a folder with `trajectory.h5` and `recordings/MP4/<serial>.mp4`.

    Picture k is that of row k, at the time stamp that it has there; or at that of
    `<serial>_timestamps.json`, where it lies beside the video. The arm's joints are joint1 to
    joint7 [rad]; gripper_position is 0 where it is open and 1 where it is closed.

    Args:
        joints: in place of its own.

    Raises SceneError: names what is missing or damaged.
    """
    h5py = import_reader("h5py", path)
    where, folder = path / TRAJECTORY, path / "recordings" / "MP4"
    cameras: list[EpisodeCamera] = []
    try:
        require_regular(where)
        with h5py.File(where) as file:
            arm, gripper, start, end = (
                _dataset(file, name, where)
                for name in (
                    *(f"{_STATE}/joint_positions", f"{_STATE}/gripper_position"),
                    *(f"{_STAMPS}/robot_state/read_start", f"{_STAMPS}/robot_state/read_end"),
                )
            )
            times = _MILLISECOND * 0.5 * (start + end)
            kept, warnings = ascending(times, f"{where}: rows")
            names = (*(f"joint{k + 1}" for k in range(arm.shape[1])), "gripper_position")
            own = JointLog(names, times[kept], np.column_stack([arm, gripper])[kept])
            for video in sorted(folder.glob("*.mp4")):
                cameras += _of_video(file, video, warnings)
    except (OSError, ValueError, LookupError, RuntimeError) as error:
        raise SceneError(f"{where}: cut short or damaged: {error}") from error
    if not cameras:
        raise SceneError(
            f"{folder}: holds no <serial>.mp4; a recordings/SVO of the cameras' own format has to "
            "be exported as MP4 first (svo_to_mp4.py of DROID)"
        )
    return Episode.checked(path, cameras, joints or own, warnings)


def _dataset(file: Any, name: str, where: Path) -> Array:
    """A table of the file; SceneError, which says what is there instead, where there is none."""
    found = file
    for part in name.split("/"):
        if part not in found:
            raise SceneError(f"{where}: has no {name}; {found.name} has: {', '.join(found)}")
        found = found[part]
    return np.asarray(found[()], dtype=np.float64)


def _of_video(file: Any, path: Path, warnings: list[str]) -> list[EpisodeCamera]:
    """The camera of a video, or both of a stereo one, whose pictures are side by side."""
    video, serial = TimedVideo(path), path.stem.removesuffix("-stereo")
    times = _picture_times(file, path, serial, len(video.times), warnings)
    kept, late = ascending(times, f"{path}: pictures")
    hand = file.get(f"observation/camera_type/{serial}")
    if hand is not None and not np.any(hand[()]):
        late.append(f"camera '{serial}' is the hand's (camera_type 0): it rides on the arm")
    warnings += [*video.warnings, *late]
    sides = ("_left", "_right") if video.width > _STEREO * video.height else ("",)
    width, cameras = video.width // len(sides), []
    for k, side in enumerate(sides):
        name, camera = f"{serial}{side}", None
        if (
            matrix := file.get(f"observation/camera_intrinsics/{serial}{side or '_left'}")
        ) is not None:
            fx, _, cx, _, fy, cy = np.ravel(matrix[()])[:6].tolist()
            camera = PinholeCamera(name, *_HD720, fx, fy, cx, cy, np.eye(4))
            camera = camera.resized(width, video.height)

        def recorded(number: int, begin: int = k * width) -> Picture:
            picture = video.read(int(kept[number]))
            return np.ascontiguousarray(picture[:, begin : begin + width])

        size = width, video.height
        cameras.append(EpisodeCamera(name, *size, times[kept], camera, None, recorded))
    return cameras


def _picture_times(file: Any, path: Path, serial: str, count: int, warnings: list[str]) -> Array:
    """When each of a video's pictures was taken [s], as far as there are time stamps."""
    stamps = _STAMPS + "/cameras"
    kinds = ("estimated_capture", "frame_received", "read_end")
    known = [kind for kind in kinds if f"{stamps}/{serial}_{kind}" in file] or [kinds[0]]
    read = [_dataset(file, f"{stamps}/{serial}_{kind}", path) for kind in known]
    times, source = read[0], TRAJECTORY
    beside = path.with_name(f"{path.stem}_timestamps.json")
    if beside.exists():
        # These are times of receipt: what the camera took until then is told by the rows.
        delay = np.median(read[1] - times) if known[:2] == [*kinds[:2]] else 0.0
        times, source = np.array(json.loads(read_regular(beside))) - delay, beside.name
    if len(times) != count:
        warnings.append(
            f"{path}: has {count} pictures, but {source} {len(times)} times: they are taken one by "
            "one from the first on, which may be off by as many, and the rest is left out"
        )
    return _MILLISECOND * times[:count]
