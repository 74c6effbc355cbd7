"""episodes.csv: of all audited episodes where cameras were found, their clocks, and who moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.stats import chi2

from drake_pose.csv_files import csv_text
from drake_pose.registration.contradictions import SIGNIFICANCE
from drake_pose.registration.online_registration import pose_difference, squared_distance

COLUMNS = (
    "scene", "camera", "frames", "agreeing", "x", "y", "z", "sd_mm", "sd_deg", "off_mm", "off_deg",
    "time_offset_s", "time_offset_sd_s", "joints", "moved_mm", "moved_deg", "moved",
)  # fmt: skip
"""Of the table. x, y, z: the camera in the world [m]; off: from where it is given, where that is
named; joints: those that are named; moved: since the episode before with a camera of this name."""


def episodes_table(episodes: Mapping[str, Mapping[str, Any]]) -> str | None:
    """The table (CSV) of scenes' totals by name, in the order of the job; None: none is an episode.

    A camera has moved whose pose differs from that of the episode before it significantly.
    """
    rows, before = [], dict[str, Mapping[str, Any]]()
    for scene, totals in episodes.items():
        named = totals.get("contradictions", ())
        joints = " ".join(one["name"] for one in named if one["what"] == "joint")
        for name, one in totals.get("cameras", {}).items():
            shifted, turned, moved = _moved(before[name], one) if name in before else (None,) * 3
            before[name] = one
            place = [row[3] for row in one["X_WC"][:3]]
            rows.append(
                (scene, name, totals["frame_count"], totals["agreeing_count"], *place,
                 one["translation_sd_mm"], one["rotation_sd_deg"], one["off_mm"], one["off_deg"],
                 one["time_offset_s"], one["time_offset_sd_s"], joints, shifted, turned, moved)
            )  # fmt: skip
    return csv_text([COLUMNS, *rows]) if rows else None


def _moved(one: Mapping[str, Any], other: Mapping[str, Any]) -> tuple[float, float, str]:
    """How far a camera's pose is from another [mm, degrees], and whether it has moved."""
    X, Y = np.array(one["X_WC"]), np.array(other["X_WC"])
    off = pose_difference(Y, X)
    covariance = np.array(one["covariance"]) + np.array(other["covariance"])
    p_value = float(chi2.sf(squared_distance(off, covariance), len(off)))
    shift, turn = 1e3 * np.linalg.norm(off[3:]), np.degrees(np.linalg.norm(off[:3]))
    return float(shift), float(turn), "yes" if p_value < SIGNIFICANCE else "no"
