"""What is known of each frame and joint: poses.csv, joints.csv, families.csv, summary.json.

Frames that have a row in poses.csv are finished: they survive whatever ends the job.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from drake_pose.body import ArticulatedModel, PoseTree, nearest_turn
from drake_pose.csv_files import csv_text, read_csv
from drake_pose.errors import OutputError
from drake_pose.files.folder import POSES, cannot_write, write_file
from drake_pose.search import JointEstimate, PoseSet, following_joints

BASE_COLUMNS = ("base_x", "base_y", "base_z", "base_qw", "base_qx", "base_qy", "base_qz")
"""Columns of the plant's world in the scene's world: position [m] and unit quaternion."""

FIT_COLUMNS = ("error", "seconds")
"""The last columns: E_total and the search's wall time [s]."""
JOINT_COLUMNS = ("frame", "joint", "determined", "low", "high", "families")
"""A row for each frame and joint, over all families [deg or m]."""
FAMILY_COLUMNS = ("frame", "family", "joint", "value", "determined", "low", "high")
"""A row for each frame, family and joint; family 1 holds the answer [deg or m]."""

# Of a normal distribution, 95 % lie within this many standard deviations.
_NORMAL_95 = 1.96


@dataclass(frozen=True, eq=False)
class PoseRow:
    """One row of poses.csv.

    Args:
        q: (nq,) positions [rad or m]; NaN where no pose was found.
        base: (7,) BASE_COLUMNS; None where the model's own joints place it in the world.
        error: E_total; NaN where no pose was found.
        seconds: the search's wall time [s].
    """

    frame: str
    q: np.ndarray
    base: np.ndarray | None
    error: float
    seconds: float

    @property
    def found(self) -> bool:
        """Whether a pose was found."""
        return bool(np.isfinite(self.error))


def base_cells(X_WB: np.ndarray) -> np.ndarray:
    """BASE_COLUMNS (7,) of a pose (4, 4): position [m] and unit quaternion."""
    rotation = RotationMatrix.ProjectToRotationMatrix(X_WB[:3, :3])
    return np.concatenate([X_WB[:3, 3], rotation.ToQuaternion().wxyz()])


def base_pose(base: np.ndarray | None) -> np.ndarray:
    """The pose (4, 4) that BASE_COLUMNS (7,) describe; the identity where there are none."""
    if base is None:
        return np.eye(4)
    # The quaternion was rounded when it was written.
    rotation = RotationMatrix(Quaternion(base[3:] / np.linalg.norm(base[3:])))
    return np.asarray(RigidTransform(rotation, base[:3]).GetAsMatrix4())


class PoseTable:
    """The table of a result's folder, with or without the base's pose."""

    def __init__(self, folder: Path, position_names: Sequence[str], with_base: bool) -> None:
        self._folder, self._count, self._with_base = folder, len(position_names), with_base
        base = BASE_COLUMNS if with_base else ()
        self.header = ["frame", *position_names, *base, *FIT_COLUMNS]

    def write(self, rows: Iterable[PoseRow]) -> None:
        """Write all rows, at once."""
        cells = [self._cells(row) for row in rows]
        write_file(self._folder, POSES, csv_text([self.header, *cells]))

    def append(self, row: PoseRow) -> None:
        """Write one more row; it is on the disk when this returns."""
        path = self._folder / POSES
        try:
            with path.open("a", newline="", encoding="utf-8") as file:
                file.write(csv_text([self._cells(row)]))
        except OSError as error:
            raise cannot_write(path, error) from error

    def read(self) -> list[PoseRow]:
        """The rows of an interrupted job; none where there is no table.

        Raises:
            OutputError: it cannot be read, or is another model's.
        """
        path = self._folder / POSES
        if not path.is_file():
            return []
        header, lines = read_csv(path, OutputError, whole_lines=True)
        if header != self.header:
            raise OutputError(f"{path}: was written for another model; name another folder")
        rows = []
        for line, (frame, *cells) in lines:
            try:
                numbers = np.array([float(cell or "nan") for cell in cells])
            except ValueError:
                raise OutputError(
                    f"{path}: line {line} is damaged, so it cannot be resumed"
                ) from None
            error, seconds = numbers[-2:].tolist()
            base = numbers[self._count : -2] if self._with_base and np.isfinite(error) else None
            rows.append(PoseRow(frame, numbers[: self._count], base, error, seconds))
        return rows

    def _cells(self, row: PoseRow) -> list[str]:
        base = np.full(len(BASE_COLUMNS), np.nan) if row.base is None else row.base
        numbers = [*row.q, *(base if self._with_base else ()), row.error]
        cells = [f"{number:.9g}" if np.isfinite(number) else "" for number in numbers]
        return [row.frame, *cells, f"{row.seconds:.4f}"]


@dataclass(frozen=True)
class JointRecord:
    """What is known of one value of the pose tree, as JointEstimate [deg or m].

    From low to high it may be, or was seen; value is that of a family, None over all families.
    """

    determined: bool
    low: float
    high: float
    value: float | None = None


@dataclass(frozen=True)
class FrameRecord:
    """What the search said about one frame.

    Args:
        E_total: J over the silhouettes' area; None where no pose was found.
        seconds: the search's wall time [s].
        first_E_total: before the re-estimation.
        runs: how often step 3 was run.
        stopped_by: why the search ended: "end", "exact", "run_limit" or "time_limit";
            "tracked" where the pose was tracked, "followed" where a person was.
        outside_limit: r in each view [pixel].
        joint_errors: estimate minus truth by position [deg or m], where the truth is known.
        camera_scale: pixels a metre of a parallel camera whose scale was found.
        explained: whether the pose explains the silhouettes at least roughly.
        joints: what is known of each value of the pose tree, by name.
        families: the same in the first families of poses that look the same.
        family_count: how many families there are; None where the search does not say.
        ious: by camera that was used, intersection over union of silhouette and body.
        masks: by camera, what tells the mask's file from another (``mask_digests``).
        share: of the contours' lengths, what fits; by the method person alone.
    """

    found: bool
    E_total: float | None
    seconds: float
    first_E_total: float | None = None
    runs: int | None = None
    stopped_by: str | None = None
    outside_limit: tuple[float, ...] | None = None
    joint_errors: Mapping[str, float] = field(default_factory=dict)
    camera_scale: float | None = None
    explained: bool = True
    joints: Mapping[str, JointRecord] = field(default_factory=dict)
    families: tuple[Mapping[str, JointRecord], ...] = ()
    family_count: int | None = None
    ious: Mapping[str, float] = field(default_factory=dict)
    share: float | None = None
    masks: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def of(row: PoseRow, **more: Any) -> FrameRecord:
        """The record of a frame's row; ``more``: other fields."""
        return FrameRecord(row.found, row.error if row.found else None, row.seconds, **more)

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> FrameRecord:
        """Returns the record that as_json described."""

        def joints(known: Mapping[str, Any]) -> dict[str, JointRecord]:
            return {name: JointRecord(**fields) for name, fields in known.items()}

        limits = values.get("outside_limit")
        read = {
            "outside_limit": None if limits is None else tuple(limits),
            "joints": joints(values.get("joints", {})),
            "families": tuple(map(joints, values.get("families", ()))),
        }
        return FrameRecord(**{**values, **read})

    def as_json(self) -> dict[str, Any]:
        """Returns plain JSON values."""
        # dataclasses.asdict copies every number by itself, a third of a second a thousand frames.
        families = [_plain_joints(own) for own in self.families]
        return {**vars(self), "joints": _plain_joints(self.joints), "families": families}


def _plain_joints(joints: Mapping[str, JointRecord]) -> dict[str, dict[str, Any]]:
    return {name: dict(vars(one)) for name, one in joints.items()}


@dataclass(frozen=True)
class SceneEstimate:
    """The estimate of a scene: poses, the search's records, summary.json, folder and warnings.

    Position kinds are "angle" [rad], "length" [m] or "quaternion", in the plant's order.
    """

    position_names: tuple[str, ...]
    position_kinds: tuple[str, ...]
    rows: tuple[PoseRow, ...]
    records: Mapping[str, FrameRecord]
    summary: Mapping[str, Any]
    folder: Path | None
    warnings: tuple[str, ...] = ()

    @property
    def found_count(self) -> int:
        """In how many frames a pose was found."""
        return sum(record.found for record in self.records.values())


def user_units(model: ArticulatedModel) -> np.ndarray:
    """What each position (nq,) is multiplied by to be told: radians become degrees."""
    return np.array([math.degrees(1.0) if k == "angle" else 1.0 for k in model.position_kinds])


def measured_positions(
    model: ArticulatedModel, q: np.ndarray, records: Iterable[FrameRecord]
) -> np.ndarray:
    """What was measured (frames, nq) [rad or m] where q was found; nan where nothing was."""
    names = model.position_names
    errors = [[record.joint_errors.get(name, np.nan) for name in names] for record in records]
    measured = q - np.array(errors).reshape(q.shape) / user_units(model)
    # Errors are of the nearest turn, which may lie beyond the limits.
    limited = model.periodic & ~model.turns_freely & np.isfinite(model.upper - model.lower)
    middle = 0.5 * np.add(model.lower, model.upper, where=limited, out=np.zeros(len(names)))
    return nearest_turn(measured, middle, limited)


def record_pose_set(pose_set: PoseSet | None, tree: PoseTree) -> dict[str, Any]:
    """FrameRecord's fields of what is known of each joint, over all families and in each."""
    if pose_set is None:
        return {}
    model = tree.model
    kinds = dict(zip(model.position_names, model.position_kinds, strict=True))

    def record(
        joints: Sequence[JointEstimate], values: Sequence[float | None]
    ) -> dict[str, JointRecord]:
        records = {}
        joints = (*joints, *following_joints(tree, joints))
        for joint, value in zip(joints, values, strict=True):
            unit = 1.0 if kinds.get(joint.name) == "length" else math.degrees(1.0)
            records[joint.name] = JointRecord(
                joint.determined,
                unit * joint.low,
                unit * joint.high,
                None if value is None else unit * value,
            )
        return records

    followers = [one.follower for one in tree.followers]
    families = [
        record(
            one.joints,
            [*np.concatenate(one.node_values).tolist(), *one.q[followers].tolist()],
        )
        for one in pose_set.families
    ]
    count = len(pose_set.joints) + len(followers)
    return {
        "joints": record(pose_set.joints, [None] * count),
        "families": tuple(families),
        "family_count": pose_set.family_count,
    }


def record_deviations(
    model: ArticulatedModel, q: np.ndarray, deviations: np.ndarray
) -> dict[str, JointRecord]:
    """Each position within 95 % and its limits, determined where that is less than half its range.

    Positions q (nq,) and deviations (nq,) are in rad or m; nan: nothing is known.
    """
    if not np.isfinite(q).all():
        return {}
    half = _NORMAL_95 * np.where(np.isfinite(deviations), deviations, np.inf)
    # An interval about half a turn goes on beyond it.
    lower = np.where(model.turns_freely, q - math.pi, model.lower)
    upper = np.where(model.turns_freely, q + math.pi, model.upper)
    low, high = np.maximum(q - half, lower), np.minimum(q + half, upper)
    determined = 2.0 * half < 0.5 * (model.upper - model.lower)
    unit = user_units(model)
    return {
        model.position_names[k]: JointRecord(
            bool(determined[k]), float(unit[k] * low[k]), float(unit[k] * high[k])
        )
        for k in np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    }


def joint_table(records: Mapping[str, FrameRecord]) -> str:
    """Returns the text of joints.csv."""
    rows = [
        (frame, name, *_ends(joint), record.family_count)
        for frame, record in records.items()
        for name, joint in record.joints.items()
    ]
    return csv_text([JOINT_COLUMNS, *rows])


def family_table(records: Mapping[str, FrameRecord]) -> str:
    """Returns the text of families.csv."""
    rows = [
        (frame, number, name, "" if one.value is None else f"{one.value:.6g}", *_ends(one))
        for frame, record in records.items()
        for number, family in enumerate(record.families, start=1)
        for name, one in family.items()
    ]
    return csv_text([FAMILY_COLUMNS, *rows])


def _ends(joint: JointRecord) -> tuple[str, str, str]:
    return "yes" if joint.determined else "no", f"{joint.low:.6g}", f"{joint.high:.6g}"
