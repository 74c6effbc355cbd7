"""What people who capture motion read: joint centres as CSV and TRC, positions as MOT, BVH."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.landmarks import (
    Landmark,
    landmark_positions,
    landmarks_file,
    load_landmarks,
)
from drake_pose.body.model import ArticulatedModel
from drake_pose.results.bvh import motion_as_bvh
from drake_pose.results.folder import (
    BASE_COLUMNS,
    BVH,
    JOINT_CENTRES,
    MOT,
    TRC,
    PoseRow,
    ResultFolder,
    base_cells,
    base_pose,
    csv_text,
)
from drake_pose.silhouette.pictures.scenes import Scene

Array = NDArray[np.float64]


def write_motion(
    folder: ResultFolder,
    model: ArticulatedModel,
    scene: Scene,
    rows: Sequence[PoseRow],
    rate_hz: float,
) -> list[str]:
    """Writes joint_centres.csv; of a sequence TRC, MOT and BVH files too; returns warnings.

    Joint centres need a landmarks.yaml beside the model. The files of a sequence hold every frame
    of the scene from the first to the last of the rows, `rate_hz` frames a second.

    Raises:
        ModelError: the landmarks cannot be read.
        OutputError: a file cannot be written.
    """
    has_landmarks = landmarks_file(model.path).is_file()
    landmarks = load_landmarks(model.path) if has_landmarks else {}
    if not any(row.found for row in rows):
        return []
    places = [scene.frames.index(row.frame) for row in rows]
    frames = scene.frames[places[0] : places[-1] + 1]
    q = np.full((len(frames), len(model.position_names)), np.nan)
    X_WB = np.tile(np.eye(4), (len(frames), 1, 1))
    for place, row in zip(places, rows, strict=True):
        q[place - places[0]], X_WB[place - places[0]] = row.q, base_pose(row.base)
    bases = X_WB if folder.with_base else None
    if landmarks:
        centres = joint_centres(model, landmarks, q, bases)
        folder.write(JOINT_CENTRES, centres_as_csv(frames, list(landmarks), centres).encode())
        if scene.sequence:
            folder.write(TRC, centres_as_trc(list(landmarks), centres, rate_hz).encode())
    if not scene.sequence:
        return []
    folder.write(MOT, positions_as_mot(model, q, rate_hz, bases).encode())
    text, filled = motion_as_bvh(model, q, bases, rate_hz)
    folder.write(BVH, text.encode())
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
    for k, positions in enumerate(q):
        if np.isfinite(positions).all():
            base = None if X_WB is None else X_WB[k]
            places[k] = landmark_positions(model, landmarks, positions, base)
    return places


def centres_as_csv(frames: Sequence[str], names: Sequence[str], places: Array) -> str:
    """joint_centres.csv: frame, joint, x, y, z [m] of places (frames, joints, 3); without nan."""
    return csv_text(
        ["frame", "joint", "x", "y", "z"],
        [
            [frame, name, *(f"{number:.4f}" for number in place)]
            for frame, row in zip(frames, places, strict=True)
            if np.isfinite(row).all()
            for name, place in zip(names, row, strict=True)
        ],
    )


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
    scale = np.array([np.degrees(1.0) if kind == "angle" else 1.0 for kind in model.position_kinds])
    names, values = list(model.position_names), q * scale
    if X_WB is not None:
        names += BASE_COLUMNS
        bases = np.full((len(q), len(BASE_COLUMNS)), np.nan)
        bases[known] = [base_cells(X) for X in X_WB[known]]
        values = np.hstack([values, bases])
    lines = [
        "positions",
        "version=1",
        f"nRows={len(known)}",
        f"nColumns={1 + len(names)}",
        "inDegrees=yes",
        "endheader",
        "\t".join(["time", *names]),
    ]
    for k in known:
        cells = [f"{number:.6f}" for number in values[k]]
        lines.append("\t".join([f"{k / rate_hz:.6f}", *cells]))
    return "\n".join(lines) + "\n"
