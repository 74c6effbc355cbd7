"""The page report.html of an audit: errors, their sizes, and minimum detectable offsets."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import listed
from drake_pose.files.folder import OVERLAY, REPORT, write_file
from drake_pose.files.overlay import draw_shapes, encode_png
from drake_pose.files.report_page import overlay_picture, page_template
from drake_pose.jobs.registration.inputs import RegistrationInputs
from drake_pose.jobs.registration.result import AS_GIVEN, NORMAL, body_drawer
from drake_pose.registration.findings import Diagnosis, Finding
from drake_pose.silhouette.pictures.scene_checks import frame_ranges


def write_audit_page(
    folder: Path,
    inputs: RegistrationInputs,
    found: Diagnosis,
    summary: Mapping[str, Any],
    overlay: bool,
    most_pictures: int = 8,
) -> None:
    """Write report.html of an audit, and pictures of the robot as given and as found.

    Args:
        folder: the result folder.
        inputs: inputs of the audit.
        found: the diagnosis.
        summary: content of summary.json.
        overlay: whether pictures are drawn; the page shows pictures that exist in any case.
        most_pictures: maximum number of frames with pictures, for each camera.
    """
    if overlay:
        _draw_outlines(folder, inputs, found, most_pictures)
    frames = [frame.frame for frame in found.frames]
    pictures = {
        kind: [
            picture
            for camera in inputs.scene.cameras
            for frame in sorted(frames, key=found.outliers.__contains__, reverse=True)
            if (picture := overlay_picture(folder, camera, frame, None, kind)) is not None
        ][: most_pictures * len(inputs.scene.cameras)]
        for kind in (AS_GIVEN, OVERLAY)
    }
    kinds = dict(zip(inputs.model.position_names, inputs.model.position_kinds, strict=True))
    text = page_template("drake_pose.jobs.registration", "audit_template.html.j2").render(
        summary=summary,
        answer=audit_answer(summary, kinds),
        kind="audit",
        title=Path(str(summary["scene"])).resolve().name,
        model=Path(str(summary["model"])).name,
        corrections=[correction_row(finding) for finding in summary["findings"]],
        cameras=[*_camera_rows(summary)],
        joints=_joint_rows(inputs.tree, kinds, summary),
        pairs=pictures[AS_GIVEN],
        overlays=pictures[OVERLAY],
    )
    write_file(folder, REPORT, text)


def audit_answer(summary: Mapping[str, Any], kinds: Mapping[str, str]) -> str:
    """Return the result in a few sentences.

    Args:
        summary: content of summary.json.
        kinds: kind of each position by name: "angle", "length" or "quaternion".
    """
    findings = summary["findings"]
    common = [finding for finding in findings if finding["what"] != "frame"]
    outliers = [finding["name"] for finding in findings if finding["what"] == "frame"]
    texts = []
    if len(common) == 1:
        texts.append(f"Error found: {common[0]['text']}.")
    elif common:
        named = listed([f"{finding['what']} '{finding['name']}'" for finding in common])
        texts.append(f"{len(common)} errors found: {named}.")
    if outliers:
        count, named = summary["frame_count"], frame_ranges(outliers, list(summary["frames"]))
        one_or_more = "is an outlier" if len(outliers) == 1 else "are outliers"
        texts.append(f"{len(outliers)} of {count} frames {one_or_more}: {named}.")
    if texts:
        return " ".join(texts)
    offsets, detectable = summary["minimum_detectable"], list[str]()
    for kind in ("angle", "length"):
        known = [x for name, x in offsets.items() if x is not None and kinds[name] == kind]
        detectable += [detectable_offset(max(known), kind)] if known else []
    if not detectable:
        return "No error found, but no joint offset could have been detected."
    hidden = [name for name, offset in offsets.items() if offset is None]
    but = f", except those of {listed(hidden)}" if hidden else ""
    return (
        f"No error found: joint offsets above {' or '.join(detectable)} would have been detected"
        f"{but}."
    )


def undetectable_offsets(offsets: Mapping[str, float | None], kinds: Mapping[str, str]) -> str:
    """Return in words which offsets would not have been named; "": there are no `offsets`.

    offsets: by joint, as ``minimum_detectable`` of summary.json. kinds: as of `audit_answer`.
    """
    known = [f"{k} {detectable_offset(x, kinds[k])}" for k, x in offsets.items() if x is not None]
    texts = [f"not detectable: joint offsets below {', '.join(known)}"] if known else []
    if hidden := [name for name, offset in offsets.items() if offset is None]:
        texts.append(f"not detectable at any size, as the masks hardly show them: {listed(hidden)}")
    return "; ".join(texts)


def detectable_offset(offset: float, kind: str) -> str:
    """Return a joint offset, in deg or m as in summary.json, as text in deg or mm to two digits.

    kind: "angle" or "length".
    """
    return f"{offset:.2g} deg" if kind == "angle" else f"{1e3 * offset:.2g} mm"


def correction_row(finding: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry of ``findings`` of summary.json, with ``parts`` for the page's tables.

    Each part has two texts: an angle or a shift with a known standard deviation, and its 95 %
    interval.

    finding: the entry.
    """
    parts = []
    for key in (key for key in finding if key.startswith(("angle_deg", "shift_"))):
        # The standard deviation of "shift_mm" is "shift_sd_mm".
        name, _, unit = key.rpartition("_")
        deviation = finding.get(f"{name}_sd_{unit}")
        if not deviation or not np.isfinite(deviation):
            continue
        value, unit = finding[key], unit.replace("percent", "%")
        low, high = value - NORMAL * deviation, value + NORMAL * deviation
        parts.append((f"{value:+z.2f} {unit}", f"{low:+z.2f} to {high:+z.2f} {unit}"))
    return {**finding, "parts": parts}


def _camera_rows(summary: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of the page's table of the cameras that were compared.

    "frames" is the number of frames, "given" the mean inlier ratio at the given values, "freed"
    that with each frame fitted by itself (None: unknown), and "off" the camera's errors common to
    all frames.
    """
    every = summary["frames"].values()
    for name in dict.fromkeys(name for one in every for name in one["fits"]):
        frames = [one for one in every if name in one["fits"]]
        freed = [one["fits_when_freed"][name] for one in frames if name in one["fits_when_freed"]]
        yield {
            "name": name,
            "frames": len(frames),
            "given": float(np.mean([frame["fits"][name] for frame in frames])),
            "freed": float(np.mean(freed)) if freed else None,
            "off": _errors_of(("camera", "clock", "rate", "moved"), name, summary),
        }


def _joint_rows(
    tree: PoseTree, kinds: Mapping[str, str], summary: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return the rows of the page's table of joints.

    In each row "off" has the joint's errors common to all frames. If there are none, "detectable"
    is the joint's minimum detectable offset as text.

    ``tree``: the robot's pose tree; each of its joints in `kinds` has a row. ``kinds``: kind of
    each position by name: "angle", "length" or "quaternion". ``summary``: content of summary.json.
    """
    rows = []
    for name in (name for name in TreeKinematics(tree).names if name in kinds):
        off, detectable = _errors_of(("joint", "sign", "log", "link"), name, summary), "–"
        if not off and name in summary["minimum_detectable"]:
            offset = summary["minimum_detectable"][name]
            detectable = "none" if offset is None else detectable_offset(offset, kinds[name])
        elif not off:
            detectable = "not known"
        rows.append({"name": name, "off": off, "detectable": detectable})
    return rows


def _errors_of(kinds: Sequence[str], name: str, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the errors common to all frames of a joint or camera, as `correction_row` does.

    kinds: kinds of errors, see ``Finding``. name: of the joint or camera. summary: content of
    summary.json.
    """
    return [
        correction_row(finding)
        for finding in summary["findings"]
        if finding["what"] != "frame"
        and finding["cause"] in kinds
        and finding["cause_name"] == name
    ]


def _draw_outlines(folder: Path, inputs: RegistrationInputs, found: Diagnosis, most: int) -> None:
    """Draw the robot as given and as found in at most `most` frames with errors of joints.

    Pictures are written to the folder AS_GIVEN in the result folder, the largest errors first.
    """
    names = TreeKinematics(inputs.tree).names
    common = [one for one in found.common if corrected(np.zeros(len(names)), names, one)]
    draw, count = body_drawer(inputs.tree, inputs.visible_nodes), 0
    for frame in sorted(found.frames, key=lambda one: -one.pixels):
        of_frame = [] if frame.finding is None or frame.finding in found.common else [frame.finding]
        findings = [*common, *(x for x in of_frame if corrected(np.zeros(len(names)), names, x))]
        if not findings or count == most:
            continue
        count, name, seen = count + 1, frame.frame, inputs.read(frame.frame)
        values = seen.values
        for finding in findings:
            (values,) = corrected(values, names, finding)
        for camera in (camera for camera in inputs.known_cameras if camera.name in seen.masks):
            given = seen.of(camera.name)
            bodies = [draw(camera, replace(given, values=v)) >= 0 for v in (seen.values, values)]
            of = "of this frame" if of_frame else "of all frames"
            title = f"{camera.name}  frame {name}  joints {of}"
            picture = draw_shapes(given.mask, bodies, ("as given", "as found"), title)
            write_file(folder, f"{AS_GIVEN}/{camera.name}/{name}.png", encode_png(picture))


def corrected(values: Array, names: Sequence[str], finding: Finding) -> tuple[Array, ...]:
    """Return the joint values (m,) corrected by a finding, in a tuple; (): it corrects no joint.

    ``values``: (m,) joint values [rad or m]. ``names``: (m,) names of the joints. ``finding``: its
    kind and joints tell the correction.
    """
    added = dict(finding.joints)
    if finding.kind == "joint":
        added = {finding.name: finding.angle if finding.angle_sd > 0.0 else finding.shift}
    elif finding.kind == "sign" and finding.name in names and "to be added" not in finding.text:
        added = {finding.name: -2.0 * values[names.index(finding.name)]}
    known = {name: value for name, value in added.items() if name in names}
    if not known:
        return ()
    result = np.array(values, dtype=np.float64)
    for name, value in known.items():
        result[names.index(name)] += value
    return (result,)
