"""Table of the cameras of all audited episodes, and camera files of cameras that did not move."""

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

FoundCamera = Mapping[str, Any]
"""A camera found by an audit, as in ``found_cameras`` of its summary.json; keys used here: X_WC (4,
4), covariance (6, 6; rotation first, rad and m), translation_sd_mm, focal_sd_px (None if not
estimated) and camera (its entry of a camera file)."""

COLUMNS = (
    "scene", "camera", "frames", "agreeing", "x", "y", "z", "sd_mm", "sd_deg", "off_mm", "off_deg",
    "time_offset_s", "time_offset_sd_s", "joints", "moved_mm", "moved_deg", "moved", "camera_file",
)  # fmt: skip
"""Columns of episodes.csv. x, y, z: position of the camera in the world [m]; off: distance from its
given pose, if that is an error; joints: joints with errors; moved: distance from the pose in
earlier episodes, and whether that is significant; camera_file: file with the cameras' poses,
combined from all episodes in which they did not move."""


def episodes_table(episodes: Mapping[str, Mapping[str, Any]]) -> tuple[str, dict[str, str]]:
    """Return the text of episodes.csv, and the texts of camera files (YAML) by name.

    A camera has moved if its pose differs significantly from the combined pose of the episodes
    since its last move. A new camera file begins at each episode in which a camera has moved. There
    are no camera files ({}) without audited episodes.

    Args:
        episodes: totals of audits (`batch.Outcome`) by scene, in the order of the job; scenes
            without ``cameras`` are skipped.
    """
    rows = list[list[Any]]()
    files: list[dict[str, _CombinedPose]] = [{}]
    for scene, totals in episodes.items():
        named = totals.get("findings", ())
        joints = " ".join(one["name"] for one in named if one["what"] == "joint")
        stand, moves = files[-1], dict[str, tuple[Any, ...]]()
        for name, one in totals.get("cameras", {}).items():
            moves[name] = stand[name].moved(one) if name in stand else (None,) * 3
        if any(moved == "yes" for *_, moved in moves.values()):
            # Cameras that have not moved keep their combined pose.
            files.append({k: v for k, v in stand.items() if moves.get(k, "-")[-1] != "yes"})
        for name, move in moves.items():
            one = totals["cameras"][name]
            if name not in files[-1]:
                files[-1][name] = _CombinedPose(one)
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


class _CombinedPose:
    """Combined pose of a static camera from several episodes: the information-weighted mean.

    Errors of episodes are correlated by an unknown amount, for instance by joint offsets.
    Covariance intersection with equal weights (Julier and Uhlmann, 1997) gives a covariance that is
    consistent for any correlation: with n equal episodes it is that of one. Only sums are stored,
    since a batch may have thousands of episodes.

    ``one``: the camera in its first episode, about whose pose the others are averaged; it is not
    yet added.
    """

    def __init__(self, one: FoundCamera) -> None:
        self._first, self._surest = np.array(one["X_WC"]), one
        self._count, self._is_focal = 0, False
        self._information, self._weighted = np.zeros((6, 6)), np.zeros(6)

    def add(self, one: FoundCamera) -> None:
        """Add the camera, as found in another episode, to the combined pose."""
        information = np.linalg.inv(np.array(one["covariance"]))
        self._information += information
        self._weighted += information @ pose_difference(np.array(one["X_WC"]), self._first)
        self._count += 1
        self._is_focal = self._is_focal or bool(one["focal_sd_px"])
        self._surest = min(self._surest, one, key=lambda k: float(k["translation_sd_mm"]))

    def pose(self) -> tuple[Array, Array]:
        """Return the combined X_WC (4, 4) and its covariance (6, 6), rotation first [rad, m]."""
        inverse, X_WC = np.linalg.inv(self._information), self._first.copy()
        mean = inverse @ self._weighted
        X_WC[:3, :3] = Rotation.from_rotvec(mean[:3]).as_matrix() @ X_WC[:3, :3]
        X_WC[:3, 3] += mean[3:]
        return X_WC, np.asarray(self._count * inverse)

    def moved(self, one: FoundCamera) -> tuple[float, float, str]:
        """Return distance [mm] and angle [deg] of a pose from the combined one, and "yes" or "no".

        "yes": the camera has moved, since the difference is significant.
        """
        X_WC, covariance = self.pose()
        off = pose_difference(np.array(one["X_WC"]), X_WC)
        distance = squared_distance(off, covariance + np.array(one["covariance"]))
        shift, turn = 1e3 * np.linalg.norm(off[3:]), np.degrees(np.linalg.norm(off[:3]))
        is_moved = float(chdtrc(len(off), distance)) < DIAGNOSIS.significance
        return float(shift), float(turn), "yes" if is_moved else "no"

    def entry(self) -> dict[str, Any]:
        """Return the camera's entry of a camera file.

        If focal lengths were estimated, it is the entry of the episode with the smallest standard
        deviation, since estimated focal length and distance are correlated.
        """
        own: dict[str, Any] = self._surest["camera"]
        return own if self._is_focal else own | {"X_WC": self.pose()[0].tolist()}
