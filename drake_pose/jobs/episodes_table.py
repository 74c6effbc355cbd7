"""The page of a batch; and the cameras of its audited episodes, and the poses that they share."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from markupsafe import Markup
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from drake_pose.arrays import Array
from drake_pose.errors import listed
from drake_pose.files.page import BLUE, NORMAL, Figure, Page, Table, bad, p_value, plot, share
from drake_pose.input_files import csv_text
from drake_pose.registration.diagnosis import DIAGNOSIS
from drake_pose.registration.online_registration import pose_difference, squared_distance

FoundCamera = Mapping[str, Any]
"""A camera found by an audit, as in ``found_cameras`` of its summary.json; keys used here: X_WC (4,
4; of a camera on a link X_LC), covariance (6, 6; rotation first, rad and m), translation_sd_mm,
focal_sd_px (None if not estimated) and camera (its entry of a camera file)."""

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
    episodes: Mapping[str, Mapping[str, Any]],
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return files about audited episodes by name, and which cameras moved.

    The files are episodes.csv and camera files; {} without audited episodes. Sentences say for each
    camera which episodes share a pose and since when it has moved.

    An episode shares the pose of the episode before unless it differs significantly from all
    episodes with that pose combined; else the most likely of the poses before; else it has a new
    one. A new camera file begins at each episode in which a camera has moved.

    ``episodes``: totals of audits (`batch.Outcome`) by scene, in the order of the job; scenes
    without ``cameras`` are skipped.
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
            # Poses in the world or on a link are compared with those in the same frame only.
            in_order = [k for k in dict.fromkeys((last, *own)) if k and k.link == one.get("link")]
            last = last if last in in_order else None
            shared: _CombinedPose | None = None
            p_value: float | None = None
            if in_order:
                p_values = [k.compare(one)[2] for k in in_order]
                best = 0 if p_values[0] >= DIAGNOSIS.significance else int(np.argmax(p_values))
                p_value = p_values[best]
                shared = in_order[best] if p_value >= DIAGNOSIS.significance else None
            if shared is None:
                own.append(shared := _CombinedPose(one))
            shift, turn = (None, None) if last is None else last.compare(one)[:2]
            is_moved = "" if last is None else "no" if shared is last else "yes"
            moves[name] = (shift, turn, is_moved, own.index(shared) + 1, p_value)
            now[name] = shared
        rides = (before[k].link != one.get("link") for k, one in found.items() if k in before)
        if any(move[2] == "yes" for move in moves.values()) or any(rides):
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
    made = {"episodes.csv": csv_text([COLUMNS, *rows])}
    for k, file in enumerate(files, 1):
        entries = {name: one.entry() for name, one in file.items()}
        made[f"cameras_{k}.yaml"] = yaml.safe_dump(entries)
    return made, _describe_moves(rows)


def batch_page(
    folder: Path, content: Mapping[str, Any], episodes: Mapping[str, Mapping[str, Any]]
) -> Page:
    """Return the page of a batch.

    ``folder``: the batch's folder, with its files. ``content``: that of batch.json. ``episodes``:
    totals (`batch.Outcome`) by scene.
    """
    scenes: Mapping[str, Mapping[str, Any]] = content["scenes"]
    rows, named = list[list[str]](), dict[str, list[str]]()
    for name, one in scenes.items():
        errors = [f"{error['what']} {error['name']}" for error in one.get("findings") or ()]
        for error in errors:
            named.setdefault(error, []).append(name)
        good = one.get("agreeing_count") if "findings" in one else one.get("found_count")
        told = bad(listed(errors)) if errors else "no error found"
        if "findings" not in one:
            told = f"E_total {share(one['mean_E_total'], 'unknown')}"
        if failed := [error["error"] for error in one["errors"]]:
            told = bad("; ".join(failed))
        link = Markup('<a href="{0}/report.html">{0}</a>').format(name) if good else name
        rows.append([link, one["state"], f"{good or 0} of {one['frame_count']}", told])
    finished = sum(one["state"] == "finished" for one in scenes.values())
    good = "consistent" if any("findings" in one for one in scenes.values()) else "with a pose"
    texts = [f"{finished} of {len(scenes)} scenes finished."]
    texts += [f"In {len(of)} of them: {error}." for error, of in list(named.items())[:3]]
    moves = [f"{text[0].upper()}{text[1:]}." for text in content["moves"][:4]]
    return Page(
        folder.name, f"Batch of {len(scenes)} scenes", " ".join((*texts, *moves)), {}, {
            "Scenes": [Table(["scene", "state", f"frames {good}", "result"], rows)],
            "episodes": [_displacements(episodes)],
        }, ["Open a scene's page by its name below."],
    )  # fmt: skip


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
                    f"episode {row[0]} (p-value {p_value(row[columns['p_value']])})"
                    if row[columns["pose"]] == max(numbers[: own.index(row) + 1])
                    and row[columns["pose"]] not in numbers[: own.index(row)]
                    else f"camera '{camera}' moved back to pose {row[columns['pose']]} by "
                    f"{turn:.2f} degrees and {shift:.1f} mm before episode {row[0]}"
                )
        for number in sorted({*numbers}) if len({*numbers}) > 1 else ():
            sharing = [str(row[0]) for row in own if row[columns["pose"]] == number]
            sentences.append(f"camera '{camera}', pose {number}: {listed(sharing)}")
    return tuple(sentences)


def _displacements(episodes: Mapping[str, Mapping[str, Any]]) -> list[Figure]:
    """Return plots of the cameras' displacements and joint offsets over the episodes.

    Displacements are those from the first episode. ``episodes``: totals by scene.
    """
    scenes = [name for name, totals in episodes.items() if totals.get("cameras")]
    ends, first = dict[str, Array](), dict[str, Array]()
    for k, scene in enumerate(scenes):
        found = dict[str, tuple[float, float]]()
        for name, one in episodes[scene]["cameras"].items():
            X_WC = np.array(one["X_WC"])
            name += f" on {one['link']}" if one.get("link") else ""
            off = pose_difference(X_WC, first.setdefault(name, X_WC))
            turn, shift = np.degrees(np.linalg.norm(off[:3])), 1e3 * np.linalg.norm(off[3:])
            found[f"{name}: shift [mm]"] = float(shift), one["translation_sd_mm"]
            found[f"{name}: turn [deg]"] = float(turn), one["rotation_sd_deg"]
        for name, (unit, value, sd) in episodes[scene].get("joint_offsets", {}).items():
            found[f"{name}: joint offset [{unit}]"] = value, sd
        for title, (value, sd) in found.items():
            own = ends.setdefault(title, np.full((len(scenes), 3), np.nan))
            own[k] = value + NORMAL * sd * np.array([-1.0, 0.0, 1.0])
    return [
        (
            plot([("estimate", y)], scenes, title, bands=[(BLUE, low, high)], joined=False),
            "Blue: 95 % interval.", title,
        )
        for title, (low, y, high) in ((title, own.T) for title, own in ends.items())
        if len(scenes) > 1
    ]  # fmt: skip


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
        self._first, self._surest, self.link = np.array(one["X_WC"]), one, one.get("link")
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
        name = "X_LC" if "link" in own else "X_WC"
        return own if self._is_focal else own | {name: self.pose()[0].tolist()}
