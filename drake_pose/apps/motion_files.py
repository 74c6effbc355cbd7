"""Files that people who capture motion read: joint centres as CSV and TRC, positions as MOT."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from drake_pose.body import ArticulatedModel
from drake_pose.body.landmarks import Landmark, landmark_positions

Array = NDArray[np.float64]

JOINT_CENTRES = "joint_centres.csv"
TRC, MOT = "joint_centres.trc", "positions.mot"


def joint_centres(model: ArticulatedModel, landmarks: Mapping[str, Landmark], q: Array) -> Array:
    """The landmarks (frames, n, 3) in the world [m] at positions q (frames, nq); nan where q is."""
    places = np.full((len(q), len(landmarks), 3), np.nan)
    for k, positions in enumerate(q):
        if np.isfinite(positions).all():
            places[k] = landmark_positions(model, landmarks, positions)
    return places


def centres_as_csv(frames: Sequence[str], names: Sequence[str], places: Array) -> str:
    """joint_centres.csv: frame, joint, x, y, z [m]; frames without a pose are left out.

    Args:
        frames: the frames' names.
        names: the joints'.
        places: (frames, joints, 3) in the world [m].
    """
    lines = ["frame,joint,x,y,z"]
    for frame, row in zip(frames, places, strict=True):
        if np.isfinite(row).all():
            for name, (x, y, z) in zip(names, row, strict=True):
                lines.append(f"{frame},{name},{x:.4f},{y:.4f},{z:.4f}")
    return "\n".join(lines) + "\n"


def centres_as_trc(names: Sequence[str], places: Array, rate_hz: float, name: str = TRC) -> str:
    """A TRC file of joint centres: millimetres, y up as its readers expect (our z), 1-based frames.

    Args:
        names: the joints'.
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


def positions_as_mot(model: ArticulatedModel, q: Array, rate_hz: float) -> str:
    """A MOT file of a model's positions: degrees and metres; frames without a pose are left out.

    Args:
        model: the model.
        q: (frames, nq) positions [rad or m].
        rate_hz: frames a second.
    """
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    scale = np.array([1.0 if kind == "length" else 180.0 / np.pi for kind in model.position_kinds])
    lines = [
        "positions",
        "version=1",
        f"nRows={len(known)}",
        f"nColumns={1 + len(scale)}",
        "inDegrees=yes",
        "endheader",
        "\t".join(["time", *model.position_names]),
    ]
    for k in known:
        cells = [f"{number:.6f}" for number in q[k] * scale]
        lines.append("\t".join([f"{k / rate_hz:.6f}", *cells]))
    return "\n".join(lines) + "\n"
