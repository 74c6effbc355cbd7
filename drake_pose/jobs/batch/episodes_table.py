"""Of all audited episodes: where cameras were found, their clocks, who moved, and camera files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from drake_pose.csv_files import csv_text
from drake_pose.registration.contradictions import SIGNIFICANCE
from drake_pose.registration.online_registration import pose_difference, squared_distance

Array = NDArray[np.float64]
Found = Mapping[str, Any]

COLUMNS = (
    "scene", "camera", "frames", "agreeing", "x", "y", "z", "sd_mm", "sd_deg", "off_mm", "off_deg",
    "time_offset_s", "time_offset_sd_s", "joints", "moved_mm", "moved_deg", "moved", "camera_file",
)  # fmt: skip
"""Of the table. x, y, z: the camera in the world [m]; off: from where it is given, where that is
named; joints: those that are named; moved: from where the episodes before have a camera of this
name; camera_file: holds the cameras as all episodes have them that saw them stand there."""


class EpisodesTable(NamedTuple):
    """The table (CSV), and camera files (YAML) by name."""

    text: str
    camera_files: dict[str, str]


def episodes_table(episodes: Mapping[str, Mapping[str, Any]]) -> EpisodesTable | None:
    """What scenes' totals by name say, in the order of the job; None: none is an episode.

    A camera has moved whose pose differs significantly from that which the episodes since it moved
    before have together. A new camera file begins with each episode in which one has.
    """
    rows = list[list[Any]]()
    files: list[dict[str, list[Found]]] = [{}]
    for scene, totals in episodes.items():
        named = totals.get("contradictions", ())
        joints = " ".join(one["name"] for one in named if one["what"] == "joint")
        stand, moves = files[-1], dict[str, tuple[Any, ...]]()
        for name, one in totals.get("cameras", {}).items():
            moves[name] = _moved(stand[name], one) if name in stand else (None,) * 3
        if any(moved == "yes" for *_, moved in moves.values()):
            # Who stands still has one pose in all files.
            files.append({k: v for k, v in stand.items() if moves.get(k, "-")[-1] != "yes"})
        for name, move in moves.items():
            one = totals["cameras"][name]
            files[-1].setdefault(name, []).append(one)
            place = [row[3] for row in one["X_WC"][:3]]
            rows.append(
                [scene, name, totals["frame_count"], totals["agreeing_count"], *place,
                 one["translation_sd_mm"], one["rotation_sd_deg"], one["off_mm"], one["off_deg"],
                 one["time_offset_s"], one["time_offset_sd_s"], joints, *move, _file(len(files))]
            )  # fmt: skip
    if not rows:
        return None
    texts = {
        _file(k): yaml.safe_dump({name: _together(ones) for name, ones in file.items()})
        for k, file in enumerate(files, 1)
    }
    return EpisodesTable(csv_text([COLUMNS, *rows]), texts)


def _file(number: int) -> str:
    return f"cameras_{number}.yaml"


def _moved(before: Sequence[Found], one: Found) -> tuple[float, float, str]:
    """How far a camera's pose is from that of others [mm, degrees], and whether it has moved."""
    X_WC, covariance = _fused(before)
    off = pose_difference(np.array(one["X_WC"]), X_WC)
    distance = squared_distance(off, covariance + np.array(one["covariance"]))
    shift, turn = 1e3 * np.linalg.norm(off[3:]), np.degrees(np.linalg.norm(off[:3]))
    is_moved = float(chi2.sf(distance, len(off))) < SIGNIFICANCE
    return float(shift), float(turn), "yes" if is_moved else "no"


def _together(ones: Sequence[Found]) -> dict[str, Any]:
    """A camera's entry in a file, as all episodes have it that saw it in one place.

    Where its focal length was found, with which its distance goes, as the surest of them has it.
    """
    surest = min(ones, key=lambda one: float(one["translation_sd_mm"]))
    own: dict[str, Any] = surest["camera"]
    is_focal = any(one["focal_sd_px"] for one in ones)
    return own if is_focal else own | {"X_WC": _fused(ones)[0].tolist()}


def _fused(ones: Sequence[Found]) -> tuple[Array, Array]:
    """X_WC (4, 4) and its covariance (6, 6), of what several episodes say, by their information.

    What errs in one, as a joint's zero does, errs in the others, nobody knows how much alike: by
    covariance intersection (Julier and Uhlmann, 1997, equal weights) the covariance holds all the
    same, and is that of one episode where all are as sure.
    """
    first = np.array(ones[0]["X_WC"])
    informations = [np.linalg.inv(np.array(one["covariance"])) for one in ones]
    offs = [pose_difference(np.array(one["X_WC"]), first) for one in ones]
    covariance = np.linalg.inv(np.mean(informations, axis=0))
    weighted = [A @ off for A, off in zip(informations, offs, strict=True)]
    mean, X_WC = covariance @ np.mean(weighted, axis=0), first.copy()
    X_WC[:3, :3] = Rotation.from_rotvec(mean[:3]).as_matrix() @ first[:3, :3]
    X_WC[:3, 3] += mean[3:]
    return X_WC, covariance
