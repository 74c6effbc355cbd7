"""summary.json: what was asked, what came out, and whether an interrupted job can go on."""

from __future__ import annotations

import hashlib
import platform
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body import ArticulatedModel
from drake_pose.errors import OutputError, SettingsError
from drake_pose.files.folder import read_summary
from drake_pose.files.options import percent
from drake_pose.files.records import FrameRecord, PoseRow
from drake_pose.files.settings import SceneSettings
from drake_pose.regular_files import digest, read_regular
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.version import VERSION

BADLY_EXPLAINED = 0.25
"""From this E_total on, a pose explains its pictures badly."""

# A joint stands at a limit if it is so near to it, as a share of its range.
_AT_LIMIT = 1e-3
# A camera is suspicious where its pictures agree so much less than the others'.
_SUSPICIOUS = 0.15
# Of a mask's digest this many digits are kept.
_DIGITS = 16
_LIMITS = {"run_limit": "run limit", "time_limit": "time limit"}
# Summaries are written so often [s]. Of much it takes a while: this many times as long is spent on
# the work itself.
_SUMMARY_PERIOD, _SUMMARY_SHARE = 2.0, 20.0
_PACKAGES = ("drake", "numpy", "numba", "opencv-python-headless")


def next_summary(begin: float) -> float:
    """When a summary is due again, by time.monotonic(), that now is written and was begun then [s].

    Whatever ends a job writes its summary; this is for a job that is killed.
    """
    now = time.monotonic()
    return now + max(_SUMMARY_PERIOD, _SUMMARY_SHARE * (now - begin))


def describe_job(
    scene: Path, model: Path, settings: SceneSettings, cameras: Path | None = None
) -> dict[str, Any]:
    """What is estimated from what and how, as plain JSON values, with the files' SHA-256.

    Args:
        cameras: a camera file in place of the scene's own.
    """
    return {
        "scene": str(scene),
        "model": str(model),
        "settings": settings.as_json(),
        "sha256": {
            "model": file_digest(model),
            "cameras": file_digest(cameras or scene / "cameras.yaml"),
        },
    }


def mask_digests(scene: Scene, cameras: Iterable[str], frame: str) -> dict[str, str]:
    """What tells the mask files of a frame from others, by camera; none where it cannot be read."""
    found = {}
    for camera in cameras:
        path = scene.masks.get((camera, frame))
        if path is not None:
            with suppress(OSError):
                found[camera] = digest(path)[:_DIGITS]
    return found


def open_job(folder: Path | None, job: Mapping[str, Any], resume: bool) -> Mapping[str, Any] | None:
    """The summary of the job that is resumed; None where it is a new one.

    Raises:
        SettingsError: nothing says which job is to be resumed.
        OutputError: that one had other files or settings, but for the frames.
    """
    if not resume:
        return None
    if folder is None:
        raise SettingsError("resume needs the folder of the result that is to be resumed")
    recorded = read_summary(folder)
    for name in ("model", "cameras"):
        if recorded.get("sha256", {}).get(name) != job["sha256"][name]:
            raise OutputError(
                f"{folder}: was made with another {name} file, so it cannot be resumed; "
                "name another folder"
            )
    before = recorded.get("settings", {})
    for name, value in job["settings"].items():
        if name != "frames" and before.get(name) != value:
            raise OutputError(
                f"{folder}: was made with {name} = {before.get(name)}, not {value}, so it cannot "
                "be resumed; name another folder, or give the same options"
            )
    return recorded


def summarize(
    job: Mapping[str, Any],
    records: Mapping[str, FrameRecord],
    complete: bool,
    more: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The content of summary.json: a job of describe_job, finished frames, more of the method."""
    ious = [iou for record in records.values() for iou in record.ious.values()]
    errors = [record.E_total for record in records.values() if record.E_total is not None]
    seconds = [record.seconds for record in records.values()]
    return {
        "complete": complete,
        "frame_count": len(records),
        "found_count": sum(record.found for record in records.values()),
        "mean_E_total": float(np.mean(errors)) if errors else None,
        "mean_iou": float(np.mean(ious)) if ious else None,
        "compared_count": sum(bool(record.ious) for record in records.values()),
        "median_seconds": float(np.median(seconds)) if seconds else None,
        "joint_errors": _joint_errors(records),
        "cameras": describe_cameras(records),
        **(more or {}),
        **job,
        "versions": versions(),
        "frames": {name: record.as_json() for name, record in records.items()},
    }


def describe_cameras(records: Mapping[str, FrameRecord]) -> dict[str, dict[str, float]]:
    """By camera: in how many frames it was compared, and its mean intersection over union."""
    found: dict[str, list[float]] = {}
    for record in records.values():
        for camera, iou in record.ious.items():
            found.setdefault(camera, []).append(iou)
    return {
        camera: {"frames": len(ious), "mean_iou": float(np.mean(ious))}
        for camera, ious in found.items()
    }


def camera_warnings(
    records: Mapping[str, FrameRecord], known: Sequence[str] = ()
) -> tuple[str, ...]:
    """Which of three cameras or more, `known` ones aside, agree much less than the others."""
    means = {name: float(one["mean_iou"]) for name, one in describe_cameras(records).items()}
    if len(means) < 3:
        return ()
    usual = float(np.median(list(means.values())))
    return tuple(
        f"camera '{name}' agrees badly (IoU {mean:.2f}, the median is {usual:.2f}): has it moved "
        "since it was calibrated, or are its masks poor?"
        for name, mean in means.items()
        if mean < usual - _SUSPICIOUS and not any(f"'{name}'" in text for text in known)
    )


def frame_warnings(records: Mapping[str, FrameRecord]) -> tuple[str, ...]:
    """One warning of all frames without a pose, and of all whose search was stopped."""
    found: dict[str, list[str]] = {}
    for frame, record in records.items():
        # Why a person is not found is said where one is followed.
        if not record.found and record.share is None:
            found.setdefault("no pose was found", []).append(frame)
        elif record.found and record.stopped_by in _LIMITS:
            text = f"the search was stopped by the {_LIMITS[record.stopped_by]}"
            found.setdefault(text, []).append(frame)
    known = list(records)
    return tuple(
        f"frame {frame_ranges(frames, known)} ({len(frames)} of {len(known)}): {text}"
        for text, frames in found.items()
    )


def poor_fit_warnings(
    rows: Iterable[PoseRow],
    records: Mapping[str, FrameRecord],
    model: ArticulatedModel,
    held: Iterable[str],
) -> tuple[str, ...]:
    """One warning where poses explain their pictures badly; `held` positions were not searched."""
    # A followed person is judged by the contours (describe_fit): others in view are in the masks.
    judged = [row for row in rows if row.found and records[row.frame].share is None]
    bad = [row for row in judged if row.error >= BADLY_EXPLAINED]
    if not bad:
        return ()
    several = f"of {len(judged)}, " if len(bad) > 1 else ""
    error = percent(float(np.median([row.error for row in bad])))
    q, span = np.array([row.q for row in bad]), model.upper - model.lower
    with np.errstate(invalid="ignore"):
        near = np.minimum(q - model.lower, model.upper - q) <= _AT_LIMIT * span
    is_one = (near.mean(axis=0) > 0.5) & (span > 0.0) & (span < 2.0 * np.pi)
    at_limits = [model.position_names[k] for k in np.flatnonzero(is_one)][:3]
    advice = ["the cameras (exchanged? moved?)", "the model and its scale", "its limits"]
    if at_limits:
        advice[-1] += f" ({', '.join(at_limits)} at a limit)"
    if names := ", ".join(held):
        advice.append(f"what is held ({names})")
    listed = frame_ranges([row.frame for row in bad], list(records))
    return (
        f"frame {listed} ({several}E_total {error}): the pose explains the pictures badly, so it "
        f"may be wrong; look at the overlays, the masks, {', '.join(advice)} and where the root is",
    )


def _joint_errors(records: Mapping[str, FrameRecord]) -> dict[str, dict[str, float]]:
    """Mean and greatest absolute error of each position over the frames [deg or m]."""
    by_name: dict[str, list[float]] = {}
    for record in records.values():
        for name, error in record.joint_errors.items():
            by_name.setdefault(name, []).append(abs(error))
    return {
        name: {"mean": float(np.mean(errors)), "greatest": float(np.max(errors))}
        for name, errors in by_name.items()
    }


@cache
def versions() -> dict[str, str]:
    """The versions of drake_pose, Python and the packages that matter."""
    found = {"drake_pose": VERSION, "python": platform.python_version()}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def file_digest(path: Path) -> str | None:
    """SHA-256 of a file; None where it cannot be read."""
    try:
        return hashlib.sha256(read_regular(path)).hexdigest()
    except OSError:
        return None
