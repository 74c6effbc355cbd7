"""One recorded episode, as all readers return it, and checks of its time stamps."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from drake_pose.arrays import Array, Indices, Mask, Picture
from drake_pose.camera.models import Lens, PinholeCamera
from drake_pose.camera.picture_files import frame_key
from drake_pose.camera.servo_readings import Column, Encoding, JointReadings, Servos
from drake_pose.errors import SceneError, require_known


@dataclass(frozen=True, eq=False)
class JointLog:
    """Joint positions by time or by frame: as a robot logged them, or in a model's joints."""

    names: tuple[str, ...]  # Names of the joints.
    times: Array | None  # (n,) ascending times [s]; None: rows are identified by frames only.
    # (n, m) positions, nan where there is no reading; in the log's units, or in rad and m.
    positions: Array
    # (n,) names or numbers of the rows' frames; empty: rows are identified by times only.
    frames: tuple[str, ...] = ()
    # Motors of the robot that LeRobot recorded; None: another recorder.
    servos: Servos | None = None
    # Of a log in a model's joints, see `map_joints`: by name of each measured joint, the linear map
    # from its column; the columns' readings, without those of a joint map; the angles' unit; in how
    # many rows a reading is at an end of its range; assumptions and anomalies.
    columns: Mapping[str, Column] = field(default_factory=dict)
    readings: tuple[JointReadings, ...] = ()
    unit: Encoding | None = None
    clipped: Mask | None = None
    warnings: tuple[str, ...] = ()
    is_estimate: bool = False  # Whether it is the poses.csv of an estimate.
    # (n, 7) poses of the base in the columns of such a file, if it moved.
    bases: Array | None = None

    @property
    def not_logged(self) -> tuple[str, ...]:
        """Names of a model's joints without a column."""
        return tuple(name for name in self.names if name not in self.columns)

    def only(self, rows: Indices) -> "JointLog":
        """Return the log of k rows, given by their indices (k,)."""
        return replace(
            self,
            times=None if self.times is None else self.times[rows],
            positions=self.positions[rows],
            frames=tuple(self.frames[k] for k in rows) if self.frames else (),
        )

    def at(self, times: Array) -> Array:
        """Return (k, m) positions of all joints at times (k,) [s], interpolated linearly.

        Times more than half the median step outside the log give nan.

        Raises SceneError: the log has no times.
        """
        if self.times is None:
            raise SceneError("the joint log's rows have frames, but no times [s]")
        wanted = np.asarray(times, dtype=np.float64)
        slack = 0.5 * float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0
        inside = (wanted >= self.times[0] - slack) & (wanted <= self.times[-1] + slack)
        found = np.full((len(wanted), len(self.names)), np.nan)
        for k, column in enumerate(self.positions.T):
            found[inside, k] = np.interp(wanted[inside], self.times, column)
        return found

    def of_frames(self, frames: Iterable[str]) -> Array:
        """Return (k, m) positions of all joints in k frames; frames without a row give nan.

        ``frames``: names or numbers; 7, 7.0, 0007 are the same. Raises SceneError: the log has
        none.
        """
        if not self.frames:
            raise SceneError("the joint log's rows have times, but no frames")
        missing = np.full(len(self.names), np.nan)
        return np.array([self.by_frame.get(frame_key(frame), missing) for frame in frames])

    @cached_property
    def by_frame(self) -> dict[int | str, Array]:
        """The positions (m,) of all joints by frame, see `frame_key`."""
        return dict(zip(map(frame_key, self.frames), self.positions, strict=True))


@dataclass(frozen=True, eq=False)
class Stream:
    """The n images of one camera of an episode, with their times."""

    name: str  # Name of the camera.
    # width, height: size of the images [pixel].
    width: int
    height: int
    times: Array  # (n,) ascending times of the images [s]; nan if unknown.
    # Calibrated camera of the undistorted images; None: none was recorded. Its X_WC is the pose in
    # ``link`` or the robot's base; unknown, unless ``is_posed``.
    camera: PinholeCamera | None
    # Link on which the camera is mounted, named as in the recording; None: unknown.
    link: str | None
    # Returns image k (H, W, 3) as recorded, with distortion.
    read_recorded: Callable[[int], Picture]
    frames: tuple[str, ...] = ()  # (n,) names of the images; empty: they have none.
    lens: Lens | None = None  # Lens that undistorts the images; None: they have no distortion.
    is_posed: bool = False  # Whether X_WC was recorded, in the robot's base or in ``link``.

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images (n,); six-digit numbers if they have none."""
        return self.frames or tuple(f"{k:06d}" for k in range(len(self.times)))

    def only(self, kept: Indices) -> "Stream":
        """Return the stream of k images, given by their indices (k,)."""
        if len(kept) == len(self.times):
            return self
        frames = tuple(self.frames[k] for k in kept) if self.frames else ()
        read = self.read_recorded
        return replace(
            self, times=self.times[kept], frames=frames, read_recorded=lambda k: read(int(kept[k]))
        )

    def pinhole(self) -> PinholeCamera:
        """Return the camera; without one, its focal length is 0.65 of the pictures' width."""
        if self.camera is not None:
            return replace(self.camera, name=self.name)
        focal, centre = 0.65 * self.width, (0.5 * (self.width - 1), 0.5 * (self.height - 1))
        return PinholeCamera(self.name, self.width, self.height, focal, focal, *centre, np.eye(4))

    def read(self, k: int) -> Picture:
        """Return image k (H, W, 3), red, green, blue, without distortion.

        Raises SceneError: there is no such image, it is unreadable, or it has another size.
        """
        where, last = f"camera '{self.name}'", len(self.times) - 1
        if not 0 <= k <= last:
            raise SceneError(f"{where} has no picture {k}, but 0 to {last}")
        picture = self.read_recorded(k)
        if picture.shape != (self.height, self.width, 3):
            raise SceneError(
                f"{where}, picture {k}: has {picture.shape[1]} x {picture.shape[0]} pixels (width "
                f"x height), but the first one {self.width} x {self.height}"
            )
        return picture if self.lens is None else self.lens.undistort(picture)


@dataclass(frozen=True, eq=False)
class Episode:
    """A recorded episode.

    Attributes:
        path: folder or file of the recording.
        cameras: cameras by name.
        joints: joint log; None if there is none.
        warnings: problems of the recording that do not prevent its use.
    """

    path: Path
    cameras: Mapping[str, Stream]
    joints: JointLog | None
    warnings: tuple[str, ...] = ()

    @classmethod
    def checked(
        cls,
        path: Path,
        cameras: Iterable[Stream],
        joints: JointLog | None,
        reader_warnings: Iterable[str] = (),
        lacking: str = "",
    ) -> "Episode":
        """Return an episode with warnings of its reader and about its times and positions.

        Images without names, and rows, whose times do not ascend are left out. Infinite positions
        become nan.

        Args:
            path: folder or file of the recording.
            cameras: the cameras.
            joints: joint log; None: there is none, which is a warning.
            reader_warnings: warnings of the reader.
            lacking: what the recording has instead of joint positions, and what is wanted; "": no
                more is known. It is the last warning if there is no log.

        Raises SceneError: there is no camera or no row, or images cannot be associated with rows.
        """
        found, warnings = dict[str, Stream](), list(reader_warnings)
        for camera in cameras:
            what, late = f"camera '{camera.name}'", list[str]()
            if not camera.frames and np.isfinite(camera.times).any():
                kept, late = ascending_indices(camera.times, f"{path}: {what}: pictures")
                camera = camera.only(kept)
            warnings += [*late, *_gap_warnings(camera.times, what, "picture")]
            found[camera.name] = camera
        if not found:
            why = f": {'; '.join(warnings)}" if warnings else ""
            raise SceneError(f"{path}: has no camera's pictures{why}")
        if joints is None:
            lacking = lacking or f"{path}: has no joint positions; give a table of them (--joints)"
            return cls(path, found, None, (*warnings, lacking))
        if not joints.positions.size:
            raise SceneError(f"{path}: the joint log has no row, or no joint")
        if joints.times is not None:
            kept, late = ascending_indices(joints.times, f"{path}: rows")
            joints, warnings = joints.only(kept), warnings + late
        is_number = np.isfinite(joints.positions)
        if not is_number.any():
            raise SceneError(
                f"{path}: the joint log has {len(joints.positions)} rows, but no number: "
                f"{', '.join(joints.names)} are all missing or infinite"
            )
        joints = replace(joints, positions=np.where(is_number, joints.positions, np.nan))
        warnings += [
            f"the joint log: '{name}' is not a number in {(~column).sum()} of {len(column)} rows, "
            f"first in row {np.argmin(column)} (counted from 0)"
            for name, column in zip(joints.names, is_number.T, strict=True)
            if not column.all()
        ]
        if joints.times is not None:
            warnings += _gap_warnings(joints.times, "the joint log", "row")
        for camera in found.values():
            warnings += _comparison_warnings(path, camera, joints)
        return cls(path, found, joints, tuple(warnings))

    def camera(self, name: str) -> Stream:
        """Return a camera by name.

        Raises UnknownNameError: there is no such camera.
        """
        require_known("camera", (name,), self.cameras, str(self.path))
        return self.cameras[name]


def ascending_indices(
    times: Array, what: str, max_fraction: float = 0.1
) -> tuple[Indices, list[str]]:
    """Return the indices of time stamps later than all before them, and warnings.

    There is one warning if others were left out, else none; nan is left out, too.

    ``times``: (n,) time stamps [s]. ``what``: what has these times, for messages. ``max_fraction``:
    maximum fraction of all time stamps that may be left out. Raises SceneError: there are no time
    stamps, or more than this fraction are out of order.
    """
    stamps = np.where(np.isfinite(times), times, np.nan)
    before = np.fmax.accumulate(np.concatenate([[-np.inf], stamps]))[:-1]
    is_later = stamps > before
    late = np.flatnonzero(~is_later)
    if not len(stamps):
        raise SceneError(f"{what}: is empty")
    if not len(late):
        return np.arange(len(stamps)), []
    text = (
        f"{what}: number {late[0]} (counted from 0) has the time {times[late[0]]:.6f} s, which "
        f"does not come after {before[late[0]]:.6f} s before it"
    )
    if len(late) > max_fraction * len(stamps):
        raise SceneError(
            f"{text}, nor do {len(late)} of {len(stamps)} in all: the clock runs backwards or "
            "stands still; correct the times, or split the recording where the clock was set"
        )
    return np.flatnonzero(is_later), [f"{text}; {len(late)} of {len(stamps)} are left out"]


def _gap_warnings(times: Array, what: str, one: str, gap: float = 1.5) -> list[str]:
    """Return a warning if there are long time steps or fewer than two times, else [].

    ``times``: (n,) ascending times [s]. ``what``: what has these times, for messages. ``one``: noun
    of a single time, "picture" or "row". ``gap``: a step is long if it exceeds the median step by
    this factor.
    """
    if len(times) < 2:
        return [f"{what}: has one {one} only"]
    steps = np.diff(times)
    usual, k = float(np.median(steps)), int(np.argmax(steps))
    if not steps[k] > gap * usual:
        return []
    return [
        f"{what}: {(steps > gap * usual).sum()} of {len(steps)} steps are longer than {gap:g} "
        f"times the median {usual:.4g} s, the longest {steps[k]:.4g} s after {one} {k}: {one}s "
        "were dropped, or their rate varies"
    ]


def _comparison_warnings(path: Path, camera: Stream, joints: JointLog) -> list[str]:
    """Return a warning if a camera's images and the joint log's rows do not match, else [].

    They are compared by frames if both have them, else by times: images outside the log's time
    span, or else a span of images shorter than 3/4 of the log's.

    ``path``: the recording, for messages. Raises SceneError: no frame is in both, or they have
    neither frames nor times in common.
    """
    count, where = len(camera.times), f"camera '{camera.name}'"
    if joints.frames and camera.frames:
        logged, pictured = ({*map(frame_key, one.frames)} for one in (joints, camera))
        text = (
            f"{where}: {len(pictured - logged)} of {count} pictures have no row in the joint log, "
            f"and {len(logged - pictured)} of {len(logged)} rows no picture"
        )
        if not logged & pictured:
            raise SceneError(f"{path}: {text}: frames must have the same names in both")
        return [text] if logged != pictured else []
    if joints.times is None or np.isnan(camera.times).all():
        raise SceneError(
            f"{path}: cannot match the joint log's rows to the pictures of {where}: either rows "
            "and pictures both need times [s] (for a folder of images: timestamps.csv, or "
            "frame_rate_hz in scene.yaml), or the log needs a column 'frame'"
        )
    clock = JointLog(("time",), joints.times, joints.times[:, None])
    outside = int(np.isnan(clock.at(camera.times)).sum())
    (first, last), (begin, end) = camera.times[[0, -1]], joints.times[[0, -1]]
    span = f"({first:.3f} to {last:.3f} s; the log's are {begin:.3f} to {end:.3f} s)"
    if outside == count:
        return [f"{where}: its clock differs from the joint log's: no picture is within it {span}"]
    is_short = last - first < 0.75 * (end - begin)
    text = f"{where}: {outside} of {count} pictures are before or after the log {span}"
    short = f"{where}: its pictures cover only a part of the log {span}"
    ratio = (end - begin) / (last - first) if last > first and end > begin else 1.0
    for unit, scale in (("ms", 1e3), ("microseconds", 1e6), ("ns", 1e9)):
        short += f": are its times in {unit}?" if 0.7 < ratio / scale < 1.4 else ""
        text += f": are the pictures' times in {unit}?" if 0.7 < 1.0 / ratio / scale < 1.4 else ""
    return [text] if outside else [short] if is_short else []
