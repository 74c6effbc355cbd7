"""What people who capture motion read: joint centres as CSV and TRC, positions as MOT, BVH."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.landmarks import (
    Landmark,
    landmark_positions,
    landmarks_file,
    load_landmarks,
)
from drake_pose.body.model import ArticulatedModel
from drake_pose.csv_files import csv_text
from drake_pose.results.bvh import motion_as_bvh
from drake_pose.results.folder import BVH, JOINT_CENTRES, MOT, TRC, write_file
from drake_pose.results.poses import BASE_COLUMNS, PoseRow, base_cells, base_pose
from drake_pose.results.records import user_units

Array = NDArray[np.float64]


def write_motion(
    folder: Path,
    model: ArticulatedModel,
    frames: Sequence[str],
    rows: Sequence[PoseRow],
    rate_hz: float | None,
) -> list[str]:
    """Writes joint_centres.csv; of a sequence TRC, MOT and BVH files too; returns warnings.

    Joint centres need a landmarks.yaml beside the model. The files of a sequence hold every frame
    from the first to the last of the rows.

    Args:
        frames: the scene's, in order.
        rate_hz: frames a second; None: they do not follow each other.

    Raises:
        ModelError: the landmarks cannot be read.
        OutputError: a file cannot be written.
    """
    has_landmarks = landmarks_file(model.path).is_file()
    landmarks = load_landmarks(model.path) if has_landmarks else {}
    if not any(row.found for row in rows):
        return []
    by_frame = {row.frame: row for row in rows}
    frames = frames[frames.index(rows[0].frame) : frames.index(rows[-1].frame) + 1]
    lost = PoseRow("", np.full(len(model.position_names), np.nan), None, np.nan, np.nan)
    q = np.array([by_frame.get(frame, lost).q for frame in frames])
    X_WB = None
    if any(row.base is not None for row in rows):
        X_WB = np.array([base_pose(by_frame.get(frame, lost).base) for frame in frames])
    if landmarks:
        names, centres = list(landmarks), joint_centres(model, landmarks, q, X_WB)
        write_file(folder, JOINT_CENTRES, centres_as_csv(frames, names, centres))
        if rate_hz is not None:
            write_file(folder, TRC, centres_as_trc(names, centres, rate_hz))
    if rate_hz is None:
        return []
    write_file(folder, MOT, positions_as_mot(model, q, rate_hz, X_WB))
    text, filled = motion_as_bvh(model, q, X_WB, rate_hz)
    write_file(folder, BVH, text)
    if not filled:
        return []
    return [
        f"{BVH}: {filled} of {len(frames)} frames have no pose and repeat the last known one; the "
        "other files leave them out"
    ]


def joint_centres(
    model: ArticulatedModel, landmarks: Mapping[str, Landmark], q: Array, X_WB: Array | None = None
) -> Array:
    """The landmarks (frames, n, 3) in the scene's world [m] at q (frames, nq); nan where q is.

    X_WB: (frames, 4, 4) poses of the plant's world in the scene's; None: the same world.
    """
    places = np.full((len(q), len(landmarks), 3), np.nan)
    for k in np.flatnonzero(np.isfinite(q).all(axis=1)):
        base = None if X_WB is None else X_WB[k]
        places[k] = landmark_positions(model, landmarks, q[k], base)
    return places


def centres_as_csv(frames: Sequence[str], names: Sequence[str], places: Array) -> str:
    """joint_centres.csv: frame, joint, x, y, z [m] of places (frames, joints, 3); without nan."""
    cells = [
        [frame, name, *(f"{number:.4f}" for number in place)]
        for frame, row in zip(frames, places, strict=True)
        if np.isfinite(row).all()
        for name, place in zip(names, row, strict=True)
    ]
    return csv_text([["frame", "joint", "x", "y", "z"], *cells])


def centres_as_trc(names: Sequence[str], places: Array, rate_hz: float, name: str = TRC) -> str:
    """A TRC file of joint centres: millimetres, y up as its readers expect (our z), 1-based frames.

    Args:
        places: (frames, joints, 3) in the world, z up [m]; nan is written as an empty field.
        rate_hz: frames a second.
        name: the file's own name, which the format repeats.
    """
    count = len(places)
    head = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate",
            "OrigDataStartFrame", "OrigNumFrames"]  # fmt: skip
    values = [f"{rate_hz:g}", f"{rate_hz:g}", count, len(names), "mm", f"{rate_hz:g}", 1, count]
    axes = [f"{axis}{k}" for k in range(1, len(names) + 1) for axis in "XYZ"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "\t".join(head),
        "\t".join(str(value) for value in values),
        "\t".join(["Frame#", "Time", *(cell for joint in names for cell in (joint, "", ""))]),
        "\t".join(["", "", *axes]),
        "",
    ]
    # x forward, y left, z up becomes x forward, y up, z right: a turn, so nothing is mirrored.
    turned = 1e3 * np.stack([places[..., 0], places[..., 2], -places[..., 1]], axis=-1)
    for k, row in enumerate(turned.reshape(count, -1)):
        cells = ["" if np.isnan(number) else f"{number:.3f}" for number in row]
        lines.append("\t".join([str(k + 1), f"{k / rate_hz:.6f}", *cells]))
    return "\n".join(lines) + "\n"


def positions_as_mot(
    model: ArticulatedModel, q: Array, rate_hz: float, X_WB: Array | None = None
) -> str:
    """A MOT file of a model's positions: degrees and metres; frames without a pose are left out.

    Args:
        q: (frames, nq) positions [rad or m].
        rate_hz: frames a second.
        X_WB: (frames, 4, 4) poses of the plant's world in the scene's, written as the columns
            base_x ... base_qz [m and unit quaternion]; None: the same world.
    """
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    names, columns = list(model.position_names), [known / rate_hz, q[known] * user_units(model)]
    if X_WB is not None:
        names += BASE_COLUMNS
        columns.append(np.array([base_cells(X) for X in X_WB[known]]))
    head = [
        "positions",
        "version=1",
        f"nRows={len(known)}",
        f"nColumns={1 + len(names)}",
        "inDegrees=yes",
        "endheader",
        "\t".join(["time", *names]),
    ]
    text = StringIO()
    np.savetxt(text, np.column_stack(columns), "%.6f", "\t", header="\n".join(head), comments="")
    return text.getvalue()
