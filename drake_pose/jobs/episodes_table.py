"""Table of the cameras of all audited episodes, the poses that they share, and their files."""

import io
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from drake_pose.arrays import Array
from drake_pose.errors import listed
from drake_pose.input_files import csv_text
from drake_pose.registration.diagnosis import DIAGNOSIS
from drake_pose.registration.online_registration import pose_difference, squared_distance

FoundCamera = Mapping[str, Any]
"""A camera found by an audit, as in ``found_cameras`` of its summary.json; keys used here: X_WC (4,
4), covariance (6, 6; rotation first, rad and m), translation_sd_mm, focal_sd_px (None if not
estimated) and camera (its entry of a camera file)."""

COLUMNS = (
    "scene", "camera", "frames", "agreeing", "x", "y", "z", "sd_mm", "sd_deg", "off_mm", "off_deg",
    "time_offset_s", "time_offset_sd_s", "joints", "moved_mm", "moved_deg", "moved", "pose",
    "p_value", "camera_file",
)  # fmt: skip
"""Columns of episodes.csv. x, y, z: position of the camera in the world [m]; off: distance from its
given pose, if that is an error; joints: joints with errors; moved: distance from the pose in the
episode before, and whether that is significant; pose: number of the camera's pose, equal in all
episodes that share it; p_value: probability of a distance as large from this pose by chance;
camera_file: file with the cameras' poses, combined from all episodes that share them."""


def episodes_table(
    episodes: Mapping[str, Mapping[str, Any]], is_drawn: bool = False
) -> tuple[dict[str, str | bytes], tuple[str, ...]]:
    """Return files about audited episodes by name, and which cameras moved.

    The files are episodes.csv, camera files, and of two episodes or more episodes.png, displacement
    and joint offsets over the episodes; {} without audited episodes. Sentences say for each camera
    which episodes share a pose and since when it has moved.

    An episode shares the pose of the episode before unless it differs significantly from all
    episodes with that pose combined; else the most likely of the poses before; else it has a new
    one. A new camera file begins at each episode in which a camera has moved.

    ``episodes``: totals of audits (`batch.Outcome`) by scene, in the order of the job; scenes
    without ``cameras`` are skipped. ``is_drawn``: whether the picture is drawn.
    """
    rows = list[list[Any]]()
    poses, files = dict[str, list[_CombinedPose]](), list[dict[str, _CombinedPose]]([{}])
    for scene, totals in episodes.items():
        named = totals.get("findings", ())
        joints = " ".join(one["name"] for one in named if one["what"] == "joint")
        before, now, found = files[-1], dict(files[-1]), totals.get("cameras", {})
        moves = dict[str, tuple[Any, ...]]()
        for name, one in found.items():
            own, last = poses.setdefault(name, []), before.get(name)
            shared, p_value = _shared_pose(one, own, last)
            if shared is None:
                own.append(shared := _CombinedPose(one))
            shift, turn = (None, None) if last is None else last.compare(one)[:2]
            is_moved = "" if last is None else "no" if shared is last else "yes"
            moves[name] = (shift, turn, is_moved, own.index(shared) + 1, p_value)
            now[name] = shared
        if any(move[2] == "yes" for move in moves.values()):
            files.append(now)
        files[-1] = now
        for name, move in moves.items():
            one = found[name]
            now[name].add(one)
            place = [row[3] for row in one["X_WC"][:3]]
            rows.append(
                [scene, name, totals["frame_count"], totals["agreeing_count"], *place,
                 one["translation_sd_mm"], one["rotation_sd_deg"], one["off_mm"], one["off_deg"],
                 one["time_offset_s"], one["time_offset_sd_s"], joints, *move,
                 f"cameras_{len(files)}.yaml"]
            )  # fmt: skip
    if not rows:
        return {}, ()
    made: dict[str, str | bytes] = {"episodes.csv": csv_text([COLUMNS, *rows])}
    for k, file in enumerate(files, 1):
        entries = {name: one.entry() for name, one in file.items()}
        made[f"cameras_{k}.yaml"] = yaml.safe_dump(entries)
    if is_drawn and len({row[0] for row in rows}) > 1:
        moved = {row[0] for row in rows if row[COLUMNS.index("moved")] == "yes"}
        made["episodes.png"] = _draw(episodes, moved)
    return made, _describe_moves(rows)


def _shared_pose(
    one: FoundCamera, poses: Sequence["_CombinedPose"], last: "_CombinedPose | None"
) -> tuple["_CombinedPose | None", float | None]:
    """Return the pose that a camera shares, and its distance's p-value; None: a new one.

    ``poses``: its poses in earlier episodes. ``last``: the previous episode's, if any.
    """
    if last is None:
        return None, None
    in_order = [last, *(k for k in poses if k is not last)]
    p_values = [k.compare(one)[2] for k in in_order]
    best = 0 if p_values[0] >= DIAGNOSIS.significance else int(np.argmax(p_values))
    is_shared = p_values[best] >= DIAGNOSIS.significance
    return (in_order[best] if is_shared else None), p_values[best]


def _describe_moves(rows: Sequence[Sequence[Any]]) -> tuple[str, ...]:
    """Return sentences about each camera's poses over the episodes, given the table's rows."""
    sentences, columns = list[str](), {name: k for k, name in enumerate(COLUMNS)}
    for camera in dict.fromkeys(row[columns["camera"]] for row in rows):
        own = [row for row in rows if row[columns["camera"]] == camera]
        numbers = [row[columns["pose"]] for row in own]
        if len(own) < 2:
            continue
        if len({*numbers}) == 1:
            sentences.append(f"camera '{camera}' has one pose in all {len(own)} episodes")
        for row in own:
            if row[columns["moved"]] == "yes":
                shift, turn = (row[columns[key]] for key in ("moved_mm", "moved_deg"))
                sentences.append(
                    f"camera '{camera}' moved by {turn:.2f} degrees and {shift:.1f} mm before "
                    f"episode {row[0]} (p-value {row[columns['p_value']]:.1g})"
                    if row[columns["pose"]] == max(numbers[: own.index(row) + 1])
                    and row[columns["pose"]] not in numbers[: own.index(row)]
                    else f"camera '{camera}' moved back to pose {row[columns['pose']]} by "
                    f"{turn:.2f} degrees and {shift:.1f} mm before episode {row[0]}"
                )
        for number in sorted({*numbers}) if len({*numbers}) > 1 else ():
            sharing = [str(row[0]) for row in own if row[columns["pose"]] == number]
            sentences.append(f"camera '{camera}', pose {number}: {listed(sharing)}")
    return tuple(sentences)


def _draw(
    episodes: Mapping[str, Mapping[str, Any]], moved: Collection[str], normal: float = 1.96
) -> bytes:
    """Return a picture (PNG) of the cameras' displacements and joint offsets over the episodes.

    Displacements are those from the first episode; bars are 95 % intervals.

    ``episodes``: totals by scene. ``moved``: names of the scenes before which a camera has moved,
    which get a line. ``normal``: half the width of a 95 % interval in standard deviations.
    """
    scenes = [name for name, totals in episodes.items() if totals.get("cameras")]
    curves = dict[tuple[str, str], list[tuple[int, float, float]]]()
    first = dict[str, Array]()
    for k, scene in enumerate(scenes):
        for name, one in episodes[scene]["cameras"].items():
            X_WC = np.array(one["X_WC"])
            off = pose_difference(X_WC, first.setdefault(name, X_WC))
            size = float(1e3 * np.linalg.norm(off[3:]))
            turn = float(np.degrees(np.linalg.norm(off[:3])))
            curves.setdefault(("shift [mm]", name), []).append((k, size, one["translation_sd_mm"]))
            curves.setdefault(("turn [deg]", name), []).append((k, turn, one["rotation_sd_deg"]))
        for name, (unit, value, sd) in episodes[scene].get("joint_offsets", {}).items():
            curves.setdefault((f"joint offset [{unit}]", name), []).append((k, value, sd))
    titles = list(dict.fromkeys(title for title, _ in curves))
    from matplotlib.figure import Figure  # Slow to import, and few jobs draw.

    figure = Figure(figsize=(8.0, 0.4 + 1.9 * len(titles)), dpi=120, layout="constrained")
    figure.suptitle("Difference from the first episode; dashed: a camera moved", fontsize=9)
    for axes, title in zip(np.atleast_1d(figure.subplots(len(titles), 1)), titles, strict=True):
        for (kind, name), points in curves.items():
            if kind == title:
                x, y, sd = np.array(points).T
                axes.errorbar(x, y, normal * sd, fmt="o-", markersize=3, linewidth=0.8, label=name)
        for scene in moved:
            axes.axvline(scenes.index(scene) - 0.5, color="#d55e00", linestyle="--", linewidth=1.0)
        axes.set_ylabel(title, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.legend(fontsize=7, loc="upper left")
        step = max(1, len(scenes) // 12)
        axes.set_xlim(-0.5, len(scenes) - 0.5)
        axes.set_xticks(range(0, len(scenes), step), scenes[::step])
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


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

    def compare(self, one: FoundCamera) -> tuple[float, float, float]:
        """Return a pose's distance [mm] and angle [deg] from the combined one, and its p-value."""
        X_WC, covariance = self.pose()
        off = pose_difference(np.array(one["X_WC"]), X_WC)
        distance = squared_distance(off, covariance + np.array(one["covariance"]))
        shift, turn = 1e3 * np.linalg.norm(off[3:]), np.degrees(np.linalg.norm(off[:3]))
        return float(shift), float(turn), float(chdtrc(len(off), distance))

    def entry(self) -> dict[str, Any]:
        """Return the camera's entry of a camera file.

        If focal lengths were estimated, it is the entry of the episode with the smallest standard
        deviation, since estimated focal length and distance are correlated.
        """
        own: dict[str, Any] = self._surest["camera"]
        return own if self._is_focal else own | {"X_WC": self.pose()[0].tolist()}
