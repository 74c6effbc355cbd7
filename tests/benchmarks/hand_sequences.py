"""Benchmark of hands in sequences of one camera that nobody knows.

Run as ``python -m tests.benchmarks.hand_sequences DATA [SEQUENCE ...]``; DATA is the
folder ``hand_sequences``. Of each sequence: how far the four fingers' flexions are off, how many of
them lie within the 95 % intervals that are given (two standard deviations), how far the lengths of
palm and fingers are off, E_total, and the processor's time.
"""

from __future__ import annotations

import csv
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.formats.packages import bundled_model
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.scene import estimate_scene
from tests.benchmarks.scenes import print_table

Array = NDArray[np.float64]

FINGERS = ("index", "middle", "ring", "little")
FLEXIONS = tuple(
    f"{finger}_{joint}_flexion" for finger in FINGERS for joint in ("mcp", "pip", "dip")
)


class HandOutcome(NamedTuple):
    """How one sequence was estimated.

    (frames, 12) errors of FLEXIONS, whether the truth lies in the interval given and its width
    [deg], nan where there is none; (4, 3) estimated over true length of palm, first and second bone
    of FINGERS; E_total in the mean, explanations in the median, milliseconds of the processor a
    frame, the fit of the body included.
    """

    errors: Array
    inside: NDArray[np.bool_]
    widths: Array
    lengths: Array
    E_total: float
    families: int
    milliseconds: float


def measure_sequence(folder: Path) -> HandOutcome:
    """Estimates a sequence and compares it with joint_angles.csv, and lengths.json above it."""
    model = bundled_model("hand").with_name("right_hand.urdf")
    begin = time.process_time()
    found = estimate_scene(folder, model, None, EstimateSettings(), overlay=False)
    seconds = time.process_time() - begin
    with (folder / "joint_angles.csv").open(encoding="utf-8", newline="") as file:
        truth = {int(row["frame"]): row for row in csv.DictReader(file)}
    index = [found.position_names.index(name) for name in FLEXIONS]
    values = np.array(
        [[float(truth[int(row.frame)][name]) for name in FLEXIONS] for row in found.rows]
    )
    ends = np.full((*values.shape, 2), np.nan)
    for k, row in enumerate(found.rows):
        joints = found.records[row.frame].joints
        for i, name in enumerate(FLEXIONS):
            if name in joints:
                ends[k, i] = joints[name].low, joints[name].high
    scales = [found.records[row.frame].camera_scale or np.nan for row in found.rows]
    true_scale = np.median([float(row["scale_px_per_m"]) for row in truth.values()])
    lengths = json.loads((folder.parent / "lengths.json").read_text(encoding="utf-8"))["lengths"]
    counts = [found.records[row.frame].family_count or 1 for row in found.rows]
    return HandOutcome(
        errors=np.degrees([row.q[index] for row in found.rows]) - values,
        inside=(ends[..., 0] <= values) & (values <= ends[..., 1]),
        widths=ends[..., 1] - ends[..., 0],
        lengths=_compare(found.summary, lengths) * float(np.median(scales) / true_scale),
        E_total=float(np.mean([row.error for row in found.rows])),
        families=int(np.median(counts)),
        milliseconds=1e3 * seconds / len(found.rows),
    )


def _compare(summary: Mapping[str, Any], true: Mapping[str, Any]) -> Array:
    """(4, 3) estimated over true lengths, as if both were as large in the picture."""
    own = summary.get("lengths")
    ratios = np.full((len(FINGERS), 3), np.nan)
    if own is None:
        return ratios
    for ratio, finger in zip(ratios, FINGERS, strict=True):
        parts = [own[f"{finger}_{part}"] for part in ("proximal", "middle", "distal")]
        ratio[:] = np.array(parts) / [true["wrist_to_base"][finger], *true[finger][:2]]
    return ratios


def _row(folder: Path) -> tuple[str, ...]:
    one = measure_sequence(folder)
    print(folder.name, file=sys.stderr)
    return (
        folder.name,
        f"{np.median(np.abs(one.errors)):.1f}",
        f"{np.abs(one.errors).mean():.1f}",
        f"{one.inside.mean():.0%}",
        f"{np.nanmedian(one.widths):.0f}",
        f"{np.median(np.abs(one.lengths - 1.0)):.0%}",
        *(f"{ratio:.2f}" for ratio in np.median(one.lengths, axis=0)),
        f"{one.E_total:.1%}",
        str(one.families),
        f"{one.milliseconds:.0f}",
    )


def main() -> None:
    """Print what each sequence comes to."""
    data = Path(sys.argv[1])
    names = sys.argv[2:] or sorted(path.parent.name for path in data.glob("*/scene.yaml"))
    headings = (
        *("sequence", "flexions off, median", "mean", "inside", "intervals", "lengths off"),
        *("palm", "1st bone", "2nd", "E_total", "families", "ms a frame"),
    )
    rows = [_row(data / name) for name in names]
    print_table("Hands in sequences, camera unknown", headings, rows)


if __name__ == "__main__":
    main()
