"""One episode, as every reader gives it, and what is wrong with its times."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drake_pose.arrays import Array, Indices, Picture
from drake_pose.camera.models import Lens, PinholeCamera
from drake_pose.camera.picture_files import frame_key
from drake_pose.errors import SceneError, UnknownNameError


@dataclass(frozen=True, eq=False)
class JointLog:
    """Joint positions as a robot logged them, in the units that it has.

    Args:
        names: as the log has them.
        times: (n,) ascending [s]; None where only frames say what the rows are of.
        positions: (n, m) as logged; nan where there is no reading.
        frames: (n,) names or numbers of the rows' frames; empty where only times say.
    """

    names: tuple[str, ...]
    times: Array | None
    positions: Array
    frames: tuple[str, ...] = ()

    def at(self, times: Array) -> Array:
        """(k, m) positions at times (k,) [s], linear between rows.

        They are nan where the log has begun or ended by more than half a usual step.

        Raises SceneError: its rows have frames alone.
        """
        if self.times is None:
            raise SceneError("the joint log's rows are of frames and have no times [s]")
        wanted = np.asarray(times, dtype=np.float64)
        slack = 0.5 * float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0
        inside = (wanted >= self.times[0] - slack) & (wanted <= self.times[-1] + slack)
        found = np.full((len(wanted), len(self.names)), np.nan)
        for k, column in enumerate(self.positions.T):
            found[inside, k] = np.interp(wanted[inside], self.times, column)
        return found

    def of_frames(self, frames: Iterable[str]) -> Array:
        """(k, m) positions in frames by name, 7 being 0007; nan where no row is of a frame.

        Raises SceneError: its rows have times alone.
        """
        if not self.frames:
            raise SceneError("the joint log's rows have times and are of no frames")
        rows = dict(zip(map(frame_key, self.frames), self.positions, strict=True))
        missing = np.full(len(self.names), np.nan)
        return np.array([rows.get(frame_key(frame), missing) for frame in frames])


@dataclass(frozen=True, eq=False)
class EpisodeCamera:
    """The pictures of one camera.

    Args:
        times: (n,) of the pictures [s], ascending; nan where nothing tells them.
        camera: of the pictures that `read` gives, as far as the recording knows; where it rides on
            a link X_WC holds its pose in that, else nobody knows its pose.
        link: what it rides on, as the recording calls it.
        recorded: gives picture k (H, W, 3) as recorded.
        frames: (n,) the pictures' names, where they have some.
        lens: takes out the pictures' distortion.
    """

    name: str
    width: int
    height: int
    times: Array
    camera: PinholeCamera | None
    link: str | None
    recorded: Callable[[int], Picture]
    frames: tuple[str, ...] = ()
    lens: Lens | None = None

    def read(self, k: int) -> Picture:
        """Picture k (H, W, 3), red, green, blue, free of distortion.

        Raises SceneError: there is none, it cannot be read, or it is of another size.
        """
        where, last = f"camera '{self.name}'", len(self.times) - 1
        if not 0 <= k <= last:
            raise SceneError(f"{where} has no picture {k}, but 0 to {last}")
        picture = self.recorded(k)
        if picture.shape != (self.height, self.width, 3):
            raise SceneError(
                f"{where}, picture {k}: has {picture.shape[1]} x {picture.shape[0]} pixels (width "
                f"x height), but the first one {self.width} x {self.height}"
            )
        return picture if self.lens is None else self.lens.undistort(picture)


@dataclass(frozen=True, eq=False)
class Episode:
    """What was recorded in one episode, and what is wrong with it but leaves enough to go on."""

    path: Path
    cameras: Mapping[str, EpisodeCamera]
    joints: JointLog | None
    warnings: tuple[str, ...] = ()

    @classmethod
    def checked(
        cls,
        path: Path,
        cameras: Iterable[EpisodeCamera],
        joints: JointLog | None,
        said: Iterable[str] = (),
    ) -> "Episode":
        """An episode with warnings of what is odd in its times and positions, after those given.

        Raises SceneError: no camera, no row, or pictures that nothing puts beside rows.
        """
        found, warnings = {camera.name: camera for camera in cameras}, list(said)
        if not found:
            raise SceneError(f"{path}: holds no camera's pictures {'; '.join(warnings)}".rstrip())
        for name, camera in found.items():
            warnings += _gaps(camera.times, f"camera '{name}'", "picture")
        if joints is None:
            return cls(path, found, None, (*warnings, f"{path}: holds no joint positions"))
        if not joints.positions.size:
            raise SceneError(f"{path}: the joint log holds no row, or no joint")
        is_number = np.isfinite(joints.positions)
        joints = replace(joints, positions=np.where(is_number, joints.positions, np.nan))
        warnings += [
            f"the joint log: '{name}' is no number in {(~column).sum()} of {len(column)} rows, the "
            f"first of which is {np.argmin(column)} (counted from 0)"
            for name, column in zip(joints.names, is_number.T, strict=True)
            if not column.all()
        ]
        if joints.times is not None:
            warnings += _gaps(joints.times, "the joint log", "row")
        for camera in found.values():
            warnings += _compare(path, camera, joints)
        return cls(path, found, joints, tuple(warnings))

    def camera(self, name: str) -> EpisodeCamera:
        """A camera by its name; UnknownNameError, which lists all, where there is none."""
        if name not in self.cameras:
            raise UnknownNameError("camera", name, self.cameras, str(self.path))
        return self.cameras[name]


def ascending(times: Array, what: str, most: float = 0.1) -> tuple[Indices, list[str]]:
    """Which time stamps (n,) come after all before them, and a warning of the others.

    most: fraction of others above which the clock cannot be trusted.

    Raises SceneError: there is none, or too many others, so that the clock cannot be trusted.
    """
    stamps = np.where(np.isfinite(times), times, np.nan)
    before = np.fmax.accumulate(np.concatenate([[-np.inf], stamps]))[:-1]
    is_later = stamps > before
    late = np.flatnonzero(~is_later)
    if not len(stamps):
        raise SceneError(f"{what}: holds nothing")
    if not len(late):
        return np.arange(len(stamps)), []
    text = (
        f"{what}: number {late[0]} (counted from 0) has the time {times[late[0]]:.6f} s, which "
        f"does not come after {before[late[0]]:.6f} s before it"
    )
    if len(late) > most * len(stamps):
        raise SceneError(
            f"{text}, nor do {len(late)} of {len(stamps)} in all: the clock runs backwards or "
            "stands still; put right the times, or cut the recording where it was set"
        )
    return np.flatnonzero(is_later), [f"{text}; {len(late)} of {len(stamps)} such are left out"]


def _gaps(times: Array, what: str, one: str, gap: float = 1.5) -> list[str]:
    """Steps in time that are longer than the usual one times `gap`."""
    if len(times) < 2:
        return [f"{what}: has one {one} only"]
    steps = np.diff(times)
    usual, k = float(np.median(steps)), int(np.argmax(steps))
    if not steps[k] > gap * usual:
        return []
    return [
        f"{what}: {(steps > gap * usual).sum()} of {len(steps)} steps are longer than {gap:g} "
        f"times the usual {usual:.4g} s, the longest {steps[k]:.4g} s after {one} {k}: {one}s were "
        "dropped, or their rate varies"
    ]


def _compare(path: Path, camera: EpisodeCamera, joints: JointLog) -> list[str]:
    """What is wrong between a camera's pictures and the rows of joint positions."""
    count, where = len(camera.times), f"camera '{camera.name}'"
    if joints.frames and camera.frames:
        known, seen = ({*map(frame_key, one.frames)} for one in (joints, camera))
        text = (
            f"{where}: {len(seen - known)} of {count} pictures have no row in the joint log, and "
            f"{len(known - seen)} of {len(known)} rows no picture"
        )
        if not known & seen:
            raise SceneError(f"{path}: {text}: frames must be called alike in both")
        return [text] if known != seen else []
    if joints.times is None or np.isnan(camera.times).all():
        raise SceneError(
            f"{path}: nothing tells which of the joint log's rows belong to the pictures of {where}"
            ": rows and pictures both need times [s] (a folder of images its timestamps.csv, or "
            "frame_rate_hz in scene.yaml), or the log a column 'frame'"
        )
    outside = int(np.isnan(joints.at(camera.times)).all(axis=1).sum())
    (first, last), (begin, end) = camera.times[[0, -1]], joints.times[[0, -1]]
    span = f"({first:.3f} to {last:.3f} s; the log's are {begin:.3f} to {end:.3f} s)"
    if outside == count:
        return [f"{where}: its clock is not the joint log's: no picture is of its time {span}"]
    is_short = last - first < 0.75 * (end - begin)
    text = f"{where}: {outside} of {count} pictures are before or after the log {span}"
    short = f"{where}: its pictures end, or begin, while the log goes on {span}"
    return [text] if outside else [short] if is_short else []
