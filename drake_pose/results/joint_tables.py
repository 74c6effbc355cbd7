"""What is known of each joint, as rows for people and programs: joints.csv and families.csv."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from drake_pose.body.model import ArticulatedModel
from drake_pose.results.folder import csv_text
from drake_pose.results.summary import FrameRecord, JointRecord
from drake_pose.search.estimates import JointEstimate, PoseSet

JOINT_COLUMNS = ("frame", "joint", "determined", "low", "high", "families")
"""A row for each frame and joint, over all families [deg or m]."""
FAMILY_COLUMNS = ("frame", "family", "joint", "value", "determined", "low", "high")
"""A row for each frame, family and joint; family 1 holds the answer [deg or m]."""

# Of a normal distribution, 95 % lie within this many standard deviations.
_NORMAL_95 = 1.96


def record_pose_set(
    pose_set: PoseSet | None, kinds: Mapping[str, str]
) -> tuple[dict[str, JointRecord], tuple[dict[str, JointRecord], ...]]:
    """What is known of each joint over all families, and in each; None: nothing.

    `kinds` is "length" for each position that is one, by name; all others are angles.
    """
    if pose_set is None:
        return {}, ()
    families = []
    for family in pose_set.families:
        values = [float(value) for node in family.node_values for value in node]
        families.append(_record(family.joints, kinds, values))
    return _record(pose_set.joints, kinds, None), tuple(families)


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
    records = {}
    for k in np.flatnonzero(np.isfinite(low) & np.isfinite(high)):
        unit = math.degrees(1.0) if model.position_kinds[k] == "angle" else 1.0
        records[model.position_names[k]] = JointRecord(
            bool(determined[k]), float(unit * low[k]), float(unit * high[k])
        )
    return records


def _record(
    joints: Sequence[JointEstimate], kinds: Mapping[str, str], values: Sequence[float] | None
) -> dict[str, JointRecord]:
    records = {}
    for index, joint in enumerate(joints):
        unit = 1.0 if kinds.get(joint.name) == "length" else math.degrees(1.0)
        value = None if values is None else unit * values[index]
        records[joint.name] = JointRecord(
            joint.determined, unit * joint.low, unit * joint.high, value
        )
    return records


def joint_table(records: Mapping[str, FrameRecord]) -> str:
    """Returns the text of joints.csv."""
    return csv_text(
        JOINT_COLUMNS,
        [
            [frame, name, *_ends(joint), record.family_count]
            for frame, record in records.items()
            for name, joint in record.joints.items()
        ],
    )


def family_table(records: Mapping[str, FrameRecord]) -> str:
    """Returns the text of families.csv."""
    return csv_text(
        FAMILY_COLUMNS,
        [
            [frame, number, name, "" if one.value is None else _number(one.value), *_ends(one)]
            for frame, record in records.items()
            for number, family in enumerate(record.families, start=1)
            for name, one in family.items()
        ],
    )


def _ends(joint: JointRecord) -> list[str]:
    known = "yes" if joint.determined else "no"
    return [known, _number(joint.low), _number(joint.high)]


def _number(value: float) -> str:
    return f"{value:.6g}"
