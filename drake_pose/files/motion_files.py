"""Motion files of a result folder: joint centres as CSV and TRC, positions as MOT."""

from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body import (
    ArticulatedModel,
    Landmark,
    landmark_positions,
    landmarks_file,
    load_landmarks,
)
from drake_pose.files.folder import JOINT_CENTRES, MOT, TRC, write_file
from drake_pose.files.records import BASE_COLUMNS, FrameRecord, base_cells, base_pose, user_units
from drake_pose.input_files import csv_text


def write_motion(
    folder: Path,
    model: ArticulatedModel,
    frames: Sequence[str],
    records: Sequence[FrameRecord],
    rate_hz: float | None,
) -> None:
    """Write joint_centres.csv, and for a sequence TRC and MOT files.

    Joint centres (also in TRC) need a landmarks.yaml beside the model. Files of a sequence hold all
    frames from the first to the last record; frames without a record count as frames without a
    pose. If no record has a pose, no file is written.

    Args:
        folder: the result folder.
        model: the model of the positions.
        frames: names of the scene's frames, in order.
        records: estimates of some or all of the frames, in order.
        rate_hz: frame rate [Hz]; None if the frames are not a sequence: only joint_centres.csv is
            written.

    Raises ModelError: the landmarks cannot be read; OutputError: a file cannot be written.
    """
    has_landmarks = landmarks_file(model.path).is_file()
    landmarks = load_landmarks(model.path) if has_landmarks else {}
    if not any(record.found for record in records):
        return
    known = {record.frame: record for record in records}
    frames = frames[frames.index(records[0].frame) : frames.index(records[-1].frame) + 1]
    lost = FrameRecord("", np.full(len(model.position_names), np.nan), None, None, np.nan)
    own = [known.get(frame, lost) for frame in frames]
    q, X_WB = np.array([record.q for record in own]), None
    if any(record.base is not None for record in records):
        X_WB = np.array([base_pose(record.base) for record in own])
    if landmarks:
        names, centres = list(landmarks), joint_centres(model, landmarks, q, X_WB)
        write_file(folder, JOINT_CENTRES, centres_as_csv(frames, names, centres))
        if rate_hz is not None:
            write_file(folder, TRC, centres_as_trc(names, centres, rate_hz))
    if rate_hz is not None:
        write_file(folder, MOT, positions_as_mot(model, q, rate_hz, X_WB))


def joint_centres(
    model: ArticulatedModel, landmarks: Mapping[str, Landmark], q: Array, X_WB: Array | None = None
) -> Array:
    """Return landmark positions (frames, n, 3) in the scene's world [m]; nan where q is.

    ``landmarks``: n by name. ``q``: (frames, nq) [rad or m]. ``X_WB``: (frames, 4, 4) poses of the
    plant's world in the scene's; None: identity.
    """
    places = np.full((len(q), len(landmarks), 3), np.nan)
    for k in np.flatnonzero(np.isfinite(q).all(axis=1)):
        base = None if X_WB is None else X_WB[k]
        places[k] = landmark_positions(model, landmarks, q[k], base)
    return places


def centres_as_csv(frames: Sequence[str], names: Sequence[str], places: Array) -> str:
    """Return the text of joint_centres.csv: a row for each frame and joint, in the order given.

    ``places``: (frames, joints, 3) [m]; frames with a nan are left out.
    """
    cells = [
        [frame, name, *(f"{number:.4f}" for number in place)]
        for frame, row in zip(frames, places, strict=True)
        if np.isfinite(row).all()
        for name, place in zip(names, row, strict=True)
    ]
    return csv_text([["frame", "joint", "x", "y", "z"], *cells])


def centres_as_trc(names: Sequence[str], places: Array, rate_hz: float) -> str:
    """Return the text of a TRC file of joint centres: millimetres, y up, frames counted from 1.

    ``names``: (joints,) names of the markers. ``places``: (frames, joints, 3) positions in the
    world, z up [m]; nan becomes an empty field. ``rate_hz``: frame rate [Hz].
    """
    count = len(places)
    head = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate",
            "OrigDataStartFrame", "OrigNumFrames"]  # fmt: skip
    values = [f"{rate_hz:g}", f"{rate_hz:g}", count, len(names), "mm", f"{rate_hz:g}", 1, count]
    axes = [f"{axis}{k}" for k in range(1, len(names) + 1) for axis in "XYZ"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{TRC}",
        "\t".join(head),
        "\t".join(str(value) for value in values),
        "\t".join(["Frame#", "Time", *(cell for joint in names for cell in (joint, "", ""))]),
        "\t".join(["", "", *axes]),
        "",
    ]
    # A rotation: x forward, y left, z up becomes x forward, y up, z right.
    turned = 1e3 * np.stack([places[..., 0], places[..., 2], -places[..., 1]], axis=-1)
    for k, row in enumerate(turned.reshape(count, -1)):
        cells = ["" if np.isnan(number) else f"{number:.3f}" for number in row]
        lines.append("\t".join([str(k + 1), f"{k / rate_hz:.6f}", *cells]))
    return "\n".join(lines) + "\n"


def positions_as_mot(
    model: ArticulatedModel, q: Array, rate_hz: float, X_WB: Array | None = None
) -> str:
    """Return the text of a MOT file of positions in degrees and metres, with columns by name.

    Args:
        model: the model of the positions.
        q: (frames, nq) positions [rad or m]; frames with a nan have no row.
        rate_hz: frame rate [Hz].
        X_WB: (frames, 4, 4) poses of the plant's world in the scene's world, for BASE_COLUMNS
            [m and unit quaternion]; None: no such columns.
    """
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    names, columns = list(model.position_names), [known / rate_hz, q[known] * user_units(model)]
    if X_WB is not None:
        names += BASE_COLUMNS
        columns.append(np.array([base_cells(X) for X in X_WB[known]]))
    head = [
        "positions", "version=1", f"nRows={len(known)}", f"nColumns={1 + len(names)}",
        "inDegrees=yes", "endheader", "\t".join(["time", *names]),
    ]  # fmt: skip
    text = StringIO()
    np.savetxt(text, np.column_stack(columns), "%.6f", "\t", header="\n".join(head), comments="")
    return text.getvalue()
