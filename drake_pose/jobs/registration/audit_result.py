"""What an audit writes: what contradicts the rest, in words and numbers, and its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body.model import ArticulatedModel
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.jobs.registration.settings import AuditSettings
from drake_pose.registration.contradictions import Audit, Finding, FrameAudit
from drake_pose.registration.per_frame_fit import SeenFrame
from drake_pose.results.folder import OVERLAY, ResultFolder
from drake_pose.results.overlay import draw_overlay, encode_png
from drake_pose.results.summary import file_digest, versions
from drake_pose.results.texts import percent
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

# As many joints are named in words.
_NAMED = 3


def describe_contradictions(found: Audit) -> list[dict[str, Any]]:
    """What contradicts the rest, worst first: joints, cameras and the base, then frames."""
    common = [
        {"what": one.kind, "name": one.name, "text": _say_common(one), **_numbers(one)}
        for one in found.common
    ]
    frames = [
        {"what": "frame", "name": one.frame, "text": _say_frame(one), **_numbers(one.finding)}
        for one in sorted(found.frames, key=lambda one: -one.pixels)
        if one.finding is not None
    ]
    return common + frames


def summarize(
    found: Audit,
    paths: tuple[Path, Path, Path, Path | None],
    settings: AuditSettings,
    warnings: Sequence[str],
    seconds: float,
) -> dict[str, Any]:
    """The content of summary.json.

    Args:
        found: what was found.
        paths: scene, model, table of joint positions, and a camera file in place of the scene's.
        settings: the settings.
        warnings: what the user should know.
        seconds: how long it took.
    """
    scene, model, joints, cameras = paths
    return {
        "contradictions": describe_contradictions(found),
        "frame_count": len(found.frames),
        "agreeing_count": len(found.frames) - len(found.contradicting),
        "seconds": seconds,
        "frames": {one.frame: _describe_frame(one) for one in found.frames},
        "error_sizes_px": {
            name: float(size)
            for name, size in found.sizes._asdict().items()
            if name not in ("noise", "repeated")
        },
        "warnings": list(warnings),
        "scene": str(scene),
        "model": str(model),
        "joints": str(joints),
        "cameras": str(cameras or scene / "cameras.yaml"),
        "settings": settings.as_json(),
        "sha256": {
            "model": file_digest(model),
            "cameras": file_digest(cameras or scene / "cameras.yaml"),
            "joints": file_digest(joints),
        },
        "versions": versions(),
    }


def write_result(
    path: Path,
    model: ArticulatedModel,
    tree: PoseTree,
    pictures: Sequence[tuple[Camera, SeenFrame]],
    summary: Mapping[str, Any],
) -> None:
    """Writes the result folder.

    Args:
        path: the folder.
        model: the robot.
        tree: its pose tree.
        pictures: what is drawn: the robot at its encoders' positions over each mask.
        summary: from summarize, written last.

    Raises:
        OutputError: the folder is not empty, or cannot be written.
    """
    folder = ResultFolder(path, (), False)
    kinematics = TreeKinematics(tree)
    renderers: dict[str, LabelRenderer] = {}
    for camera, frame in pictures:
        renderer = renderers.setdefault(camera.name, LabelRenderer(model, camera))
        q, X_WB = tree.positions_from(kinematics.split(frame.values))
        segments = renderer.segments(q, X_WB)
        fits = summary["frames"][frame.name]["fits"][camera.name]
        title = f"{camera.name}  frame {frame.name}  CONTRADICTS the others  {percent(fits)} fits"
        picture = draw_overlay(frame.masks[camera.name], segments >= 0, segments, [title])
        folder.write(f"{OVERLAY}/{camera.name}/{frame.name}.png", encode_png(picture))
    folder.write_summary(summary)


def _numbers(one: Finding) -> dict[str, Any]:
    """A finding's numbers: lengths in mm, angles in degrees."""
    return {
        "cause": one.kind,
        "cause_name": one.name,
        "angle_deg": float(np.degrees(one.angle)),
        "angle_sd_deg": float(np.degrees(one.angle_sd)),
        "shift_mm": 1e3 * one.shift,
        "shift_sd_mm": 1e3 * one.shift_sd,
        "pixels": one.pixels,
        "chance": one.p_value,
        "rivals": list(one.rivals),
        "joints": dict(one.joints),
    }


def _describe_frame(one: FrameAudit) -> dict[str, Any]:
    return {
        "agrees": one.finding is None,
        "fits": dict(one.given),
        "fits_when_freed": dict(one.fitted),
        "pixels": one.pixels,
    }


def _say_common(one: Finding) -> str:
    """A contradiction of all frames in words."""
    rivals = f" (or {', '.join(one.rivals)}: the masks cannot tell)" if one.rivals else ""
    return f"{_name(one)}{rivals}: off {_amount(one)} in all frames that agree, {_pixels(one)}"


def _say_frame(one: FrameAudit) -> str:
    """A frame that contradicts the others in words."""
    found = one.finding
    assert found is not None
    if found.kind == "unexplained":
        worst = min(one.fitted, key=lambda name: one.fitted[name])
        return (
            f"frame '{one.frame}': no positions near those given explain it: in camera '{worst}' "
            f"{percent(one.fitted[worst])} of the contours fit at best"
        )
    if found.kind == "joints":
        named = sorted(found.joints.items(), key=lambda item: -abs(item[1]))
        joints = ", ".join(name for name, _ in named[:_NAMED])
        more = f" ({joints} most)" if joints else ""
        return f"frame '{one.frame}': is of other positions: joints are off{more}, {_pixels(found)}"
    rivals = f" (or {', '.join(found.rivals)}: the masks cannot tell)" if found.rivals else ""
    return f"frame '{one.frame}': {_name(found)}{rivals} is off {_amount(found)}, {_pixels(found)}"


def _name(one: Finding) -> str:
    return "the base" if one.kind == "base" else f"{one.kind} '{one.name}'"


def _amount(one: Finding) -> str:
    """By how much, with standard deviations."""
    parts = []
    if one.angle_sd > 0.0:
        parts.append(f"{np.degrees(one.angle):.2f} +- {np.degrees(one.angle_sd):.2f} degrees")
    if one.shift_sd > 0.0:
        parts.append(f"{1e3 * one.shift:.1f} +- {1e3 * one.shift_sd:.1f} mm")
    return "by " + " and ".join(parts)


def _pixels(one: Finding) -> str:
    return f"outlines by {one.pixels:.1f} pixels"
