"""The page of an audit: what contradicts the rest, by how much, and what would go unnoticed."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.files.folder import OVERLAY, REPORT, write_file
from drake_pose.files.overlay import draw_shapes, encode_png
from drake_pose.files.report_page import overlay_picture, page_template
from drake_pose.jobs.registration.inputs import Inputs
from drake_pose.jobs.registration.result import AS_GIVEN, body_drawer
from drake_pose.registration.findings import Diagnosis, Finding

OnePicture = tuple[str, str, list[Finding]]
"""A frame, what is wrong there in a few words, and what is corrected in it."""


def write_audit_page(
    folder: Path,
    inputs: Inputs,
    found: Diagnosis,
    summary: Mapping[str, Any],
    overlay: bool = True,
    most_pictures: int = 8,
) -> None:
    """Writes report.html of an audit, and the outlines that it shows, as given and as found.

    Args:
        overlay: whether outlines are drawn; those that lie in the folder are shown in any case.
        most_pictures: how many frames have pictures, of each camera.
    """
    if overlay:
        _draw_outlines(folder, inputs, found, most_pictures)
    frames = [one.frame for one in found.frames]
    pictures = {
        kind: [
            one
            for camera in inputs.scene.cameras
            for frame in sorted(frames, key=found.contradicting.__contains__, reverse=True)
            if (one := overlay_picture(folder, camera, frame, None, kind)) is not None
        ][: most_pictures * len(inputs.scene.cameras)]
        for kind in (AS_GIVEN, OVERLAY)
    }
    text = page_template("drake_pose.jobs.registration", "audit_template.html.j2").render(
        summary=summary,
        title=Path(str(summary["scene"])).resolve().name,
        model=Path(str(summary["model"])).name,
        corrections=[correction_row(one) for one in summary["contradictions"]],
        cameras=[_camera_row(name, summary) for name in _cameras(summary)],
        joints=_joint_rows(inputs, summary),
        pairs=pictures[AS_GIVEN],
        overlays=pictures[OVERLAY],
    )
    write_file(folder, REPORT, text)


def correction_row(one: Mapping[str, Any], normal: float = 1.96) -> dict[str, Any]:
    """What is off as the page shows it: its correction, each part with its 95 % interval.

    ``normal``: standard deviations to either side that an interval has.
    """
    parts = []
    for key in (key for key in one if key.startswith(("angle_deg", "shift_"))):
        if "_sd_" in key or not (deviation := one[_sd_key(key)]) or not np.isfinite(deviation):
            continue
        value, unit = one[key], key.rpartition("_")[2].replace("percent", "%")
        low, high = value - normal * deviation, value + normal * deviation
        parts.append((f"{value:+.3g} {unit}", f"{low:+.3g} to {high:+.3g} {unit}"))
    return {**one, "parts": parts}


def _sd_key(key: str) -> str:
    name, _, unit = key.rpartition("_")
    return f"{name}_sd_{unit}"


def _cameras(summary: Mapping[str, Any]) -> list[str]:
    """The cameras that were compared."""
    return list(dict.fromkeys(name for one in summary["frames"].values() for name in one["fits"]))


def _camera_row(name: str, summary: Mapping[str, Any]) -> dict[str, Any]:
    """Of a camera: how well its frames fit as given and when freed, and what is off."""
    frames = [one for one in summary["frames"].values() if name in one["fits"]]
    freed = [one["fits_when_freed"][name] for one in frames if name in one["fits_when_freed"]]
    return {
        "name": name,
        "frames": len(frames),
        "given": float(np.mean([one["fits"][name] for one in frames])),
        "freed": float(np.mean(freed)) if freed else None,
        "off": _off(("camera", "clock", "rate", "moved"), name, summary),
    }


def _joint_rows(inputs: Inputs, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Of a joint: what is off in it, or from which offset on that would have been noticed."""
    kinds = dict(zip(inputs.model.position_names, inputs.model.position_kinds, strict=True))
    names = [one for one in TreeKinematics(inputs.tree).names if one in kinds]
    return [
        {
            "name": name,
            "unit": "deg" if kinds[name] == "angle" else "m",
            "off": _off(("joint", "sign", "log", "link"), name, summary),
            "asked": name in summary["minimum_detectable"],
            "minimum_detectable": summary["minimum_detectable"].get(name),
        }
        for name in names
    ]


def _off(kinds: Sequence[str], name: str, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What is off by this name in all frames."""
    told = [one for one in summary["contradictions"] if one["what"] != "frame"]
    return [
        correction_row(one) for one in told if one["cause"] in kinds and one["cause_name"] == name
    ]


def _draw_outlines(folder: Path, inputs: Inputs, found: Diagnosis, most: int) -> None:
    """Draws the robot at positions as given and as found, where joints explain what is off."""
    names = TreeKinematics(inputs.tree).names
    common = [one for one in found.common if corrected(np.zeros(len(names)), names, one)]
    draw, chosen = body_drawer(inputs.tree, inputs.seen), list[OnePicture]()
    for one in sorted(found.frames, key=lambda one: -one.pixels):
        own = [] if one.finding is None or one.finding in found.common else [one.finding]
        told = [*common, *(x for x in own if corrected(np.zeros(len(names)), names, x))]
        if told and len(chosen) < most:
            chosen.append((one.frame, "of this frame" if own else "of all frames", told))
    for frame, of, told in chosen:
        seen = inputs.read(frame)
        values = seen.values
        for finding in told:
            (values,) = corrected(values, names, finding)
        for camera in (one for one in inputs.held if one.name in seen.masks):
            given = seen.of(camera.name)
            bodies = [draw(camera, replace(given, values=v)) >= 0 for v in (seen.values, values)]
            title = f"{camera.name}  frame {frame}  joints {of}"
            picture = draw_shapes(given.mask, bodies, ("as given", "as found"), title)
            write_file(folder, f"{AS_GIVEN}/{camera.name}/{frame}.png", encode_png(picture))


def corrected(values: Array, names: Sequence[str], one: Finding) -> tuple[Array, ...]:
    """Joint values (m,) with what a finding adds to them; empty: it says no joint's value."""
    added = dict(one.joints)
    if one.kind == "joint":
        added = {one.name: one.angle if one.angle_sd > 0.0 else one.shift}
    elif one.kind == "sign" and one.name in names and "to be added" not in one.text:
        added = {one.name: -2.0 * values[names.index(one.name)]}
    known = {name: value for name, value in added.items() if name in names}
    if not known:
        return ()
    moved = np.array(values, dtype=np.float64)
    for name, value in known.items():
        moved[names.index(name)] += value
    return (moved,)
