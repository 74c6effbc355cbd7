"""Of all audited episodes: where cameras were found, their clocks, who moved, and camera files."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from drake_pose.arrays import Array
from drake_pose.csv_files import csv_text
from drake_pose.registration.diagnosis import DIAGNOSIS
from drake_pose.registration.online_registration import pose_difference, squared_distance

Found = Mapping[str, Any]

COLUMNS = (
    "scene", "camera", "frames", "agreeing", "x", "y", "z", "sd_mm", "sd_deg", "off_mm", "off_deg",
    "time_offset_s", "time_offset_sd_s", "joints", "moved_mm", "moved_deg", "moved", "camera_file",
)  # fmt: skip
"""Of the table. x, y, z: the camera in the world [m]; off: from where it is given, where that is
named; joints: those that are named; moved: from where the episodes before have a camera of this
name; camera_file: holds the cameras as all episodes have them that saw them stand there."""


def episodes_table(episodes: Mapping[str, Mapping[str, Any]]) -> tuple[str, dict[str, str]]:
    """The table (CSV) of all audited episodes' cameras, and camera files (YAML) by name.

    A camera has moved if its pose differs significantly from the pose that the episodes since its
    last move have together. A new camera file begins with each episode in which one has moved.

    Args:
        episodes: totals of scenes by name, in the order of the job; those without cameras are no
            audited episodes. No camera file: there is none.
    """
    rows = list[list[Any]]()
    files: list[dict[str, _Standing]] = [{}]
    for scene, totals in episodes.items():
        named = totals.get("contradictions", ())
        joints = " ".join(one["name"] for one in named if one["what"] == "joint")
        stand, moves = files[-1], dict[str, tuple[Any, ...]]()
        for name, one in totals.get("cameras", {}).items():
            moves[name] = stand[name].moved(one) if name in stand else (None,) * 3
        if any(moved == "yes" for *_, moved in moves.values()):
            # Who stands still has one pose in all files.
            files.append({k: v for k, v in stand.items() if moves.get(k, "-")[-1] != "yes"})
        for name, move in moves.items():
            one = totals["cameras"][name]
            if name not in files[-1]:
                files[-1][name] = _Standing(one)
            files[-1][name].add(one)
            place = [row[3] for row in one["X_WC"][:3]]
            rows.append(
                [scene, name, totals["frame_count"], totals["agreeing_count"], *place,
                 one["translation_sd_mm"], one["rotation_sd_deg"], one["off_mm"], one["off_deg"],
                 one["time_offset_s"], one["time_offset_sd_s"], joints, *move,
                 f"cameras_{len(files)}.yaml"]
            )  # fmt: skip
    texts = {
        f"cameras_{k}.yaml": yaml.safe_dump({name: one.entry() for name, one in file.items()})
        for k, file in enumerate(files, 1)
        if rows
    }
    return csv_text([COLUMNS, *rows]), texts


class _Standing:
    """The pose of a camera that several episodes saw in one place: their weighted mean.

    Errors of episodes are correlated, as a joint offset's are, by an unknown amount. Covariance
    intersection (Julier and Uhlmann, 1997, equal weights) gives a covariance that holds all the
    same: that of one episode if all are equal. Sums are kept: a batch has thousands of episodes.
    """

    def __init__(self, one: Found) -> None:
        self._first, self._surest = np.array(one["X_WC"]), one
        self._count, self._is_focal = 0, False
        self._information, self._weighted = np.zeros((6, 6)), np.zeros(6)

    def add(self, one: Found) -> None:
        """Counts what another episode says."""
        information = np.linalg.inv(np.array(one["covariance"]))
        self._information += information
        self._weighted += information @ pose_difference(np.array(one["X_WC"]), self._first)
        self._count += 1
        self._is_focal = self._is_focal or bool(one["focal_sd_px"])
        self._surest = min(self._surest, one, key=lambda k: float(k["translation_sd_mm"]))

    def pose(self) -> tuple[Array, Array]:
        """X_WC (4, 4) and its covariance (6, 6)."""
        inverse, X_WC = np.linalg.inv(self._information), self._first.copy()
        mean = inverse @ self._weighted
        X_WC[:3, :3] = Rotation.from_rotvec(mean[:3]).as_matrix() @ X_WC[:3, :3]
        X_WC[:3, 3] += mean[3:]
        return X_WC, np.asarray(self._count * inverse)

    def moved(self, one: Found) -> tuple[float, float, str]:
        """How far a pose is from here [mm, degrees], and whether the camera has moved."""
        X_WC, covariance = self.pose()
        off = pose_difference(np.array(one["X_WC"]), X_WC)
        distance = squared_distance(off, covariance + np.array(one["covariance"]))
        shift, turn = 1e3 * np.linalg.norm(off[3:]), np.degrees(np.linalg.norm(off[:3]))
        is_moved = float(chdtrc(len(off), distance)) < DIAGNOSIS.significance
        return float(shift), float(turn), "yes" if is_moved else "no"

    def entry(self) -> dict[str, Any]:
        """The camera in a file; where its focal length was found, as the surest episode has it.

        For its distance goes with that.
        """
        own: dict[str, Any] = self._surest["camera"]
        return own if self._is_focal else own | {"X_WC": self.pose()[0].tolist()}
