"""summary.json: what was asked, what came out, and whether an interrupted job can go on."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.errors import OutputError
from drake_pose.regular_files import digest, read_regular
from drake_pose.results.settings import EstimateSettings
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.version import VERSION

# A camera is suspicious where its pictures agree so much less than the others'.
_SUSPICIOUS = 0.15
# Of a mask's digest this many digits are kept.
_DIGITS = 16
_PACKAGES = ("drake", "numpy", "numba", "opencv-python-headless")


@dataclass(frozen=True)
class JointRecord:
    """What is known of one value of the pose tree, as JointEstimate [deg or m].

    From low to high it may be, or was seen; value is that of a family, None over all families.
    """

    determined: bool
    low: float
    high: float
    value: float | None = None


@dataclass(frozen=True)
class FrameRecord:
    """What the search said about one frame.

    Args:
        E_total: J over the silhouettes' area; None where no pose was found.
        seconds: the search's wall time [s].
        first_E_total: before the re-estimation.
        runs: how often step 3 was run.
        stopped_by: why the search ended: "end", "exact", "run_limit" or "time_limit";
            "tracked" where the pose was tracked, "followed" where a person was.
        outside_limit: r in each view [pixel].
        joint_errors: estimate minus truth by position [deg or m], where the truth is known.
        camera_scale: pixels a metre of a parallel camera whose scale was found.
        explained: whether the pose explains the silhouettes at least roughly.
        joints: what is known of each value of the pose tree, by name.
        families: the same in the first families of poses that look the same.
        family_count: how many families there are; None where the search does not say.
        ious: by camera that was used, intersection over union of silhouette and body.
        masks: by camera, what tells the mask's file from another (``mask_digests``).
        share: of the contours' lengths, what fits; by the method person alone.
    """

    found: bool
    E_total: float | None
    seconds: float
    first_E_total: float | None = None
    runs: int | None = None
    stopped_by: str | None = None
    outside_limit: tuple[float, ...] | None = None
    joint_errors: Mapping[str, float] = field(default_factory=dict)
    camera_scale: float | None = None
    explained: bool = True
    joints: Mapping[str, JointRecord] = field(default_factory=dict)
    families: tuple[Mapping[str, JointRecord], ...] = ()
    family_count: int | None = None
    ious: Mapping[str, float] = field(default_factory=dict)
    share: float | None = None
    masks: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> FrameRecord:
        """Returns the record that as_json described."""
        limits = values.get("outside_limit")
        families = [_joint_records(family) for family in values.get("families", ())]
        return FrameRecord(
            **{
                **values,
                "outside_limit": None if limits is None else tuple(limits),
                "joints": _joint_records(values.get("joints", {})),
                "families": tuple(families),
            }
        )

    def as_json(self) -> dict[str, Any]:
        """Returns plain JSON values."""
        return asdict(self)


def _joint_records(values: Mapping[str, Any]) -> dict[str, JointRecord]:
    return {name: JointRecord(**fields) for name, fields in values.items()}


def describe_job(scene: Path, model: Path, settings: EstimateSettings) -> dict[str, Any]:
    """What is estimated from what and how, as plain JSON values, with the files' SHA-256."""
    return {
        "scene": str(scene),
        "model": str(model),
        "settings": settings.as_json(),
        "sha256": {
            "model": file_digest(model),
            "cameras": file_digest(scene / "cameras.yaml"),
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


def check_same_job(job: Mapping[str, Any], recorded: Mapping[str, Any], folder: Path) -> None:
    """Refuses (OutputError) to resume a job with other files or settings, but other frames."""
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


def versions() -> dict[str, str]:
    """The versions of drake_pose, Python and the packages that matter."""
    found = {"drake_pose": VERSION, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def file_digest(path: Path) -> str | None:
    """SHA-256 of a file; None where it cannot be read."""
    try:
        return hashlib.sha256(read_regular(path)).hexdigest()
    except OSError:
        return None
