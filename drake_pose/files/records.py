"""Estimates of frames, and the files poses.csv, joints.csv, modes.csv and summary.json.

A frame is finished when it has a row in poses.csv; an interrupted job keeps its finished frames.
"""

import hashlib
import math
import platform
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, PoseTree, nearest_turn
from drake_pose.errors import OutputError, SettingsError, weight_of, weighted
from drake_pose.files.folder import POSES, cannot_write, read_summary, write_file
from drake_pose.files.settings import SceneSettings, percent
from drake_pose.input_files import csv_text, digest, read_csv, read_number, read_regular
from drake_pose.search import JointEstimate, PoseSet, mimic_joints
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.version import VERSION

BASE_COLUMNS = ("base_x", "base_y", "base_z", "base_qw", "base_qx", "base_qy", "base_qz")
"""Columns of X_WB, the plant's world in the scene's world: position [m] and unit quaternion."""

FIT_COLUMNS = ("error", "seconds")
"""Last columns of poses.csv: E_total and the search's wall time [s]."""

BADLY_EXPLAINED = 0.25
"""E_total from which a pose is reported to fit its pictures badly."""

Joints = Mapping[str, Mapping[str, Any]]
"""Estimates by the name of a value of the pose tree: ``determined``, ``low`` and ``high`` as in
JointEstimate [deg or m], and ``value``, which is None where several modes are combined."""


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """Estimate of one frame: its row of poses.csv and its part of summary.json.

    Fields that the method does not estimate are None or empty.
    """

    frame: str
    q: Array  # (nq,) positions [rad or m]; NaN if no pose was found.
    base: Array | None  # (7,) BASE_COLUMNS; None if the model's own joints place it in the world.
    # Area where body and silhouettes differ, divided by the silhouettes' area; None if no pose was
    # found.
    E_total: float | None
    seconds: float  # The search's wall time [s].
    # E_total of the first whole pose, before it was refined or estimated again.
    first_E_total: float | None = None
    runs: int | None = None  # Number of times the search placed a segment, or compared contours.
    # Why the search ended: "end", "exact" or "run_limit"; "tracked" if the pose was
    # tracked, "followed" if a person was.
    stopped_by: str | None = None
    # Kameda's r in each view: allowed area of a segment outside the mask [pixel].
    outside_limit: Sequence[float] | None = None
    # Estimate minus ground truth by position [deg or m], as far as that is known.
    joint_errors: Mapping[str, float] = field(default_factory=dict)
    camera_scale: float | None = None  # Estimated scale of a parallel camera [pixel/m].
    explained: bool = True  # Whether the pose fits the silhouettes at least roughly.
    # Interval of each value of the pose tree, over all modes.
    joints: Joints = field(default_factory=dict)
    # The same for each of the first modes; a mode is a set of poses that fit equally well.
    modes: Sequence[Joints] = ()
    mode_count: int | None = None  # Number of modes; None if the search does not count them.
    # Intersection over union of silhouette and body by camera, of the cameras used.
    ious: Mapping[str, float] = field(default_factory=dict)
    # Inlier ratio of the contours, by length; only with the method person.
    inlier_ratio: float | None = None
    # Digest of the mask file by camera (``mask_digests``).
    masks: Mapping[str, str] = field(default_factory=dict)

    @property
    def found(self) -> bool:
        """Whether a pose was found in this frame."""
        return self.E_total is not None

    @staticmethod
    def from_json(
        frame: str, values: Mapping[str, Any], q: Array, base: Array | None = None
    ) -> "FrameRecord":
        """Return a frame's record from the content of `as_json` and its row of poses.csv.

        The row: q (nq,) [rad or m], and BASE_COLUMNS (7,), None if it has none.
        """
        known = {name: value for name, value in values.items() if name != "found"}
        return FrameRecord(frame, q, base, **known)

    def as_json(self) -> dict[str, Any]:
        """Return plain JSON values, without the columns of poses.csv."""
        values = {k: v for k, v in vars(self).items() if k not in ("frame", "q", "base")}
        return {"found": self.found, **values}


@dataclass(frozen=True)
class SceneEstimate:
    """The estimate of a scene."""

    position_names: tuple[str, ...]  # (nq,) in the plant's order.
    position_kinds: tuple[str, ...]  # (nq,) "angle" [rad], "length" [m] or "quaternion".
    records: Mapping[str, FrameRecord]  # Estimates by frame, in the scene's order.
    summary: Mapping[str, Any]  # Content of summary.json.
    folder: Path | None  # The result folder; None if nothing was written.
    warnings: tuple[str, ...] = ()  # Messages for the user.

    @property
    def found_count(self) -> int:
        """Number of frames in which a pose was found."""
        return sum(record.found for record in self.records.values())


def base_cells(X_WB: Array) -> Array:
    """Return the BASE_COLUMNS (7,) of a pose (4, 4): position [m] and unit quaternion."""
    rotation = RotationMatrix.ProjectToRotationMatrix(X_WB[:3, :3])
    return np.concatenate([X_WB[:3, 3], rotation.ToQuaternion().wxyz()])


def base_pose(base: Array | None) -> Array:
    """Return the pose X_WB (4, 4) of BASE_COLUMNS (7,); the identity for None."""
    if base is None:
        return np.eye(4)
    # Rounding in the file leaves the quaternion not quite normalised.
    rotation = RotationMatrix(Quaternion(base[3:] / np.linalg.norm(base[3:])))
    return np.asarray(RigidTransform(rotation, base[:3]).GetAsMatrix4())


class PoseTable:
    """Reads and writes poses.csv in a result folder; ``with_base``: it has BASE_COLUMNS."""

    def __init__(self, folder: Path, position_names: Sequence[str], with_base: bool) -> None:
        self._folder, self._count, self._with_base = folder, len(position_names), with_base
        base = BASE_COLUMNS if with_base else ()
        self.header = ["frame", *position_names, *base, *FIT_COLUMNS]

    def write(self, records: Iterable[FrameRecord]) -> None:
        """Write the whole table, one row for each record."""
        cells = [self._cells(record) for record in records]
        write_file(self._folder, POSES, csv_text([self.header, *cells]))

    def append(self, record: FrameRecord) -> None:
        """Append a row to the file."""
        path = self._folder / POSES
        try:
            with path.open("a", newline="", encoding="utf-8") as file:
                file.write(csv_text([self._cells(record)]))
        except OSError as error:
            raise cannot_write(path, error) from error

    def read(self, known: Mapping[str, Mapping[str, Any]] | None = None) -> list[FrameRecord]:
        """Return the records of an interrupted job, in the file's order; [] without poses.csv.

        ``known``: ``frames`` of its summary.json, content of `FrameRecord.as_json` by frame. Other
        frames' records have the values of poses.csv only. Raises OutputError: the table cannot be
        read, or belongs to another model.
        """
        path = self._folder / POSES
        if not path.is_file():
            return []
        header, lines = read_csv(path, OutputError, whole_lines=True)
        if header != self.header:
            raise OutputError(f"{path}: was written for another model; choose another folder")
        records = []
        for line, (frame, *cells) in lines:
            try:
                numbers = np.array([read_number(cell) for cell in cells])
            except ValueError:
                raise OutputError(
                    f"{path}: line {line} is damaged, so it cannot be resumed"
                ) from None
            error, seconds = numbers[-2:].tolist()
            found = math.isfinite(error)
            base = numbers[self._count : -2] if self._with_base and found else None
            own = {"E_total": error if found else None, "seconds": seconds}
            values = (known or {}).get(frame, own)
            records.append(FrameRecord.from_json(frame, values, numbers[: self._count], base))
        return records

    def _cells(self, record: FrameRecord) -> list[str]:
        """Return the cells of a record's row; unknown numbers are empty."""
        base = np.full(len(BASE_COLUMNS), np.nan) if record.base is None else record.base
        error = math.nan if record.E_total is None else record.E_total
        numbers = [*record.q, *(base if self._with_base else ()), error]
        cells = [f"{number:.9g}" if np.isfinite(number) else "" for number in numbers]
        return [record.frame, *cells, f"{record.seconds:.4f}"]


def user_units(model: ArticulatedModel) -> Array:
    """Return the factors (nq,) that turn positions into user units: degrees and metres."""
    return np.array([math.degrees(1.0) if k == "angle" else 1.0 for k in model.position_kinds])


def measured_positions(model: ArticulatedModel, records: Sequence[FrameRecord]) -> Array:
    """Return each record's q minus its joint_errors (frames, nq) [rad or m]; nan if unknown."""
    names, q = model.position_names, np.array([record.q for record in records])
    errors = [[record.joint_errors.get(name, np.nan) for name in names] for record in records]
    measured = q - np.array(errors).reshape(q.shape) / user_units(model)
    # Errors are differences to the nearest turn, so that the result may lie beyond the limits.
    limited = model.periodic & ~model.is_unlimited_angle & np.isfinite(model.upper - model.lower)
    middle = 0.5 * np.add(model.lower, model.upper, where=limited, out=np.zeros(len(names)))
    return nearest_turn(measured, middle, limited)


def record_pose_set(pose_set: PoseSet | None, tree: PoseTree) -> dict[str, Any]:
    """Return FrameRecord's fields ``joints``, ``modes`` and ``mode_count`` by name; {} for None.

    ``pose_set``: all poses of a frame, found by a search with the pose tree ``tree``.
    """
    if pose_set is None:
        return {}
    kinds = dict(zip(tree.model.position_names, tree.model.position_kinds, strict=True))
    followers = [one.follower for one in tree.followers]

    def record(joints: Sequence[JointEstimate], values: Sequence[float | None]) -> Joints:
        """Return the estimates of joints and their followers; values [rad or m] in this order."""
        estimates = {}
        for joint, value in zip((*joints, *mimic_joints(tree, joints)), values, strict=True):
            unit = 1.0 if kinds.get(joint.name) == "length" else math.degrees(1.0)
            shown = None if value is None else unit * value
            if joint.name not in tree.assumed:
                ends = joint.determined, joint.low, joint.high
                estimates[joint.name] = _entry(*ends, unit, shown)
        return estimates

    modes = [
        record(one.joints, [*np.concatenate(one.node_values).tolist(), *one.q[followers].tolist()])
        for one in pose_set.modes
    ]
    unknown = [None] * (len(pose_set.joints) + len(followers))
    joints = record(pose_set.joints, unknown)
    return {"joints": joints, "modes": modes, "mode_count": pose_set.mode_count}


def _entry(
    determined: bool, low: float, high: float, unit: float = 1.0, value: float | None = None
) -> dict[str, Any]:
    """Return a joint's entry of `Joints`; ``low`` and ``high`` are multiplied by ``unit``."""
    ends = {"low": float(unit * low), "high": float(unit * high)}
    return {"determined": determined, **ends, "value": value}


def record_deviations(model: ArticulatedModel, q: Array, deviations: Array) -> Joints:
    """Return the 95 % interval of each position by name, clipped to its limits; no ``value``.

    A position is determined if its interval, before clipping, is less than half of its range.
    It is not if its deviation is unknown: the interval is then the whole range. Positions with an
    infinite interval are left out; the result is {} if q is not finite.

    ``model``: the model of the positions. ``q``: (nq,) positions [rad or m]. ``deviations``: (nq,)
    standard deviations [rad or m]; nan where unknown.
    """
    if not np.isfinite(q).all():
        return {}
    # Of a normal distribution, 95 % lie within 1.96 standard deviations.
    half = 1.96 * np.where(np.isfinite(deviations), deviations, np.inf)
    # A position that turns freely has no limits, only a period.
    lower = np.where(model.is_unlimited_angle, q - math.pi, model.lower)
    upper = np.where(model.is_unlimited_angle, q + math.pi, model.upper)
    low, high = np.maximum(q - half, lower), np.minimum(q + half, upper)
    determined = 2.0 * half < 0.5 * (model.upper - model.lower)
    unit = user_units(model)
    return {
        model.position_names[k]: _entry(bool(determined[k]), low[k], high[k], unit[k])
        for k in np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    }


def record_modes(model: ArticulatedModel, answers: Sequence[tuple[Array, Array]]) -> dict[str, Any]:
    """Return FrameRecord's fields of one pose, or of several that fit a frame equally well.

    They are ``joints`` (the union of the intervals); for several also ``modes`` and ``mode_count``.

    ``model``: the model of the positions. ``answers``: positions and deviations of each pose, as in
    `record_deviations`, best first.
    """
    of_modes = [record_deviations(model, *one) for one in answers]
    if len(of_modes) < 2:
        return {"joints": of_modes[0]}
    joints = {
        name: _entry(
            all(one[name]["determined"] for one in of_modes),
            min(one[name]["low"] for one in of_modes),
            max(one[name]["high"] for one in of_modes),
        )
        for name in of_modes[0]
        if all(name in one for one in of_modes)
    }
    modes = [
        {
            name: {**joint, "value": float(user_units(model)[k] * q[k])}
            for name, joint in one.items()
            for k in [model.position_index(name)]
        }
        for (q, _), one in zip(answers, of_modes, strict=True)
    ]
    return {"joints": joints, "modes": modes, "mode_count": len(of_modes)}


def joint_table(records: Iterable[FrameRecord]) -> str:
    """Return the text of joints.csv: intervals of joints over all modes, by frame [deg or m]."""
    rows = [
        (record.frame, name, *_ends(joint), record.mode_count)
        for record in records
        for name, joint in record.joints.items()
    ]
    return csv_text([("frame", "joint", "determined", "low", "high", "modes"), *rows])


def mode_table(records: Iterable[FrameRecord]) -> str:
    """Return the text of modes.csv: a row for each frame, mode (1: best) and joint [deg or m]."""
    rows = [
        (record.frame, number, name, f"{one['value']:.6g}", *_ends(one))
        for record in records
        for number, mode in enumerate(record.modes, start=1)
        for name, one in mode.items()
    ]
    return csv_text([("frame", "mode", "joint", "value", "determined", "low", "high"), *rows])


def _ends(joint: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return the cells determined, low and high of a joint's entry of `Joints`."""
    return "yes" if joint["determined"] else "no", f"{joint['low']:.6g}", f"{joint['high']:.6g}"


def next_summary(begin: float, period: float = 2.0, work_ratio: float = 20.0) -> float:
    """Return the time.monotonic() [s] at which an unfinished job writes its summary again.

    These summaries are for jobs that are killed; every other end of a job writes its own.

    ``begin``: time at which writing of the present summary, now finished, began [s]. ``period``:
    minimum time between two summaries [s]. ``work_ratio``: minimum ratio of the time between two
    summaries to the time of writing one.
    """
    now = time.monotonic()
    return now + max(period, work_ratio * (now - begin))


def describe_job(
    scene: Path, model: Path, settings: SceneSettings, cameras: Path | None = None
) -> dict[str, Any]:
    """Return ``scene``, ``model``, ``settings`` and ``sha256`` as plain JSON values.

    ``sha256`` has the digests of the files ``model`` and ``cameras``. The digest of an unreadable
    file is None. ``scene`` is the scene's folder, ``cameras`` a camera file used instead of its
    cameras.yaml, or None.
    """
    return {
        "scene": str(scene),
        "model": str(model),
        "settings": settings.as_json(),
        "sha256": {
            "model": file_digest(model),
            "cameras": file_digest(cameras or scene / "cameras.yaml"),
        },
    }


def mask_digests(scene: Scene, cameras: Iterable[str], frame: str) -> dict[str, str]:
    """Return digests (16 hex digits) of a frame's masks by camera; unreadable ones are left out."""
    found = {}
    for camera in cameras:
        path = scene.masks.get((camera, frame))
        if path is not None:
            with suppress(OSError):
                found[camera] = digest(path)[:16]
    return found


def read_earlier_summary(
    folder: Path | None, job: Mapping[str, Any], resume: bool
) -> Mapping[str, Any] | None:
    """Return the summary.json in a result folder, checked to be of the same job, if ``resume``.

    Without ``resume`` nothing is read, and the result is None.

    ``folder``: the result folder; None if there is none. ``job``: the present job, from
    `describe_job`. Raises SettingsError: no folder is given; OutputError: the summary cannot be
    read, or model file, camera file or settings (other than ``frames``) differ.
    """
    if not resume:
        return None
    if folder is None:
        raise SettingsError("resume needs the folder of the result")
    recorded = read_summary(folder)
    for name in ("model", "cameras"):
        if recorded.get("sha256", {}).get(name) != job["sha256"][name]:
            raise OutputError(
                f"{folder}: was made with another {name} file, so it cannot be resumed; "
                "choose another folder"
            )
    before = recorded.get("settings", {})
    for name, value in job["settings"].items():
        if name != "frames" and before.get(name) != value:
            raise OutputError(
                f"{folder}: was made with {name} = {before.get(name)}, not {value}, so it cannot "
                "be resumed; choose another folder, or give the same options"
            )
    return recorded


def summarize(
    job: Mapping[str, Any],
    records: Mapping[str, FrameRecord],
    complete: bool,
    more: Mapping[str, Any] | None = None,
    warnings: Iterable[str] = (),
) -> dict[str, Any]:
    """Return the content of summary.json.

    Args:
        job: from `describe_job`.
        records: finished frames by name.
        complete: whether all frames are finished.
        more: further entries, of the method; None: none.
        warnings: messages for the user.
    """
    ious = [iou for record in records.values() for iou in record.ious.values()]
    errors = [record.E_total for record in records.values() if record.E_total is not None]
    seconds = [record.seconds for record in records.values()]
    joint_errors: dict[str, list[float]] = {}
    for record in records.values():
        for name, error in record.joint_errors.items():
            joint_errors.setdefault(name, []).append(abs(error))
    return {
        "complete": complete,
        "frame_count": len(records),
        "found_count": sum(record.found for record in records.values()),
        "mean_E_total": float(np.mean(errors)) if errors else None,
        "mean_iou": float(np.mean(ious)) if ious else None,
        "compared_count": sum(bool(record.ious) for record in records.values()),
        "median_seconds": float(np.median(seconds)) if seconds else None,
        "joint_errors": {
            name: {"mean": float(np.mean(off)), "largest": float(np.max(off))}
            for name, off in joint_errors.items()
        },
        "cameras": describe_cameras(records),
        **(more or {}),
        **describe_warnings(warnings),
        **job,
        "versions": versions(),
        "frames": {name: record.as_json() for name, record in records.items()},
    }


def describe_warnings(warnings: Iterable[str]) -> dict[str, list[str]]:
    """Return warnings, each once, and their weights (`weight_of`) as parts of summary.json."""
    texts = list(dict.fromkeys(warnings))
    return {"warnings": texts, "warning_weights": [weight_of(text) for text in texts]}


def describe_cameras(records: Mapping[str, FrameRecord]) -> dict[str, dict[str, float]]:
    """Return ``frames``, the number of compared frames, and ``mean_iou`` of each camera by name."""
    found: dict[str, list[float]] = {}
    for record in records.values():
        for camera, iou in record.ious.items():
            found.setdefault(camera, []).append(iou)
    return {
        camera: {"frames": len(ious), "mean_iou": float(np.mean(ious))}
        for camera, ious in found.items()
    }


def camera_warnings(
    records: Mapping[str, FrameRecord], known: Sequence[str] = (), suspicious: float = 0.15
) -> tuple[str, ...]:
    """Return a warning for each of three or more cameras whose IoU is much lower than the others'.

    ``records``: estimates by frame. ``known``: earlier warnings; cameras that these name get no
    other one. ``suspicious``: minimum difference of the mean IoU to the cameras' median.
    """
    means = {name: float(one["mean_iou"]) for name, one in describe_cameras(records).items()}
    if len(means) < 3:
        return ()
    usual = float(np.median(list(means.values())))
    return tuple(
        f"camera '{name}' fits badly (IoU {mean:.2f}, median of the cameras {usual:.2f}); check "
        "whether it has moved since its calibration, and its masks"
        for name, mean in means.items()
        if mean < usual - suspicious and not any(f"'{name}'" in text for text in known)
    )


def frame_warnings(records: Mapping[str, FrameRecord]) -> tuple[str, ...]:
    """Return warnings of the frames (keys) without a pose, and with a search ended by a limit.

    Frames without a pose of the method person are not named.
    """
    found: dict[str, list[str]] = {}
    for frame, record in records.items():
        # The method person explains frames without a pose itself.
        if not record.found and record.inlier_ratio is None:
            found.setdefault("no pose was found; check masks and pictures", []).append(frame)
        elif record.found and record.stopped_by == "run_limit":
            text = "the search was stopped by its limit of runs"
            found.setdefault(text, []).append(frame)
    known = list(records)
    return tuple(
        f"frame {frame_ranges(frames, known)} ({len(frames)} of {len(known)}): {text}"
        for text, frames in found.items()
    )


def poor_fit_warnings(
    records: Mapping[str, FrameRecord],
    model: ArticulatedModel,
    held: Iterable[str],
    at_limit: float = 1e-3,
) -> tuple[str, ...]:
    """Return one warning of all frames with an E_total of BADLY_EXPLAINED or more; () if none has.

    Args:
        records: estimates by frame; those of the method person are not evaluated.
        model: the model of the positions; joints at their limits are named.
        held: names of positions that were held.
        at_limit: distance below which a joint is at a limit, as a fraction of its range.
    """
    # The method person evaluates the contours instead: masks may show other people as well.
    errors = {
        frame: one.E_total
        for frame, one in records.items()
        if one.E_total is not None and one.inlier_ratio is None
    }
    bad = [frame for frame, error in errors.items() if error >= BADLY_EXPLAINED]
    if not bad:
        return ()
    several = f"of {len(errors)}, " if len(bad) > 1 else ""
    error = percent(float(np.median([errors[frame] for frame in bad])))
    q, span = np.array([records[frame].q for frame in bad]), model.upper - model.lower
    with np.errstate(invalid="ignore"):
        near = np.minimum(q - model.lower, model.upper - q) <= at_limit * span
    is_one = (near.mean(axis=0) > 0.5) & (span > 0.0) & (span < 2.0 * np.pi)
    at_limits = [model.position_names[k] for k in np.flatnonzero(is_one)][:3]
    advice = ["the cameras (exchanged? moved?)", "the model and its scale", "its limits"]
    if at_limits:
        advice[-1] += f" ({', '.join(at_limits)} at a limit)"
    if names := ", ".join(held):
        advice.append(f"the held positions ({names})")
    return (
        weighted(
            f"frame {frame_ranges(bad, list(records))} ({several}E_total {error}): the pose fits "
            "the pictures badly and may be wrong; check the overlays, the masks, "
            f"{', '.join(advice)} and the position of the root",
            "wrong",
        ),
    )


@cache
def versions() -> dict[str, str]:
    """Return the versions of drake_pose, Python and the packages that affect results."""
    found = {"drake_pose": VERSION, "python": platform.python_version()}
    for package in ("drake", "numpy", "numba", "opencv-python-headless"):
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def file_digest(path: Path) -> str | None:
    """Return the SHA-256 of a file; None if it cannot be read."""
    try:
        return hashlib.sha256(read_regular(path)).hexdigest()
    except OSError:
        return None
