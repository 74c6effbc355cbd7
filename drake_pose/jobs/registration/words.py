"""Errors found by a registration or an audit, in words."""

import math
from dataclasses import replace

import numpy as np

from drake_pose.files.settings import percent
from drake_pose.registration.findings import Finding, FrameDiagnosis


def shift_unit(kind: str) -> tuple[str, float]:
    """Return the unit in which reports state the shift of findings of a kind, and a factor.

    The factor converts ``Finding.shift``, which is in m, s or pixels, or relative.
    """
    units = {"focal": ("percent", 100.0), "center": ("px", 1.0), "clock": ("ms", 1e3)}
    return (units | {"rate": ("percent", 100.0)}).get(kind, ("mm", 1e3))


def describe_error(finding: Finding, verb: str = "off") -> str:
    """Return in words what is wrong, by how much, with standard deviations, and alternatives.

    ``finding``: of kind "joint", "camera", "base", "focal", "center", "clock" or "rate". ``verb``:
    before the amount, such as "off" or "is off"; used for kinds "camera", "base" and "center" only.
    """
    if finding.kind == "clock":
        word = "later" if finding.shift > 0.0 else "earlier"
        return (
            f"camera '{finding.name}': its pictures show joint positions that are logged "
            f"{1e3 * abs(finding.shift):.0f} +- {1e3 * finding.shift_sd:.0f} ms {word} than their "
            "times"
        )
    if finding.kind == "rate":
        return describe_drift(finding.name, finding.shift, finding.shift_sd)
    name = "the base" if finding.kind == "base" else f"{finding.kind} '{finding.name}'"
    name = f"the {finding.name}" if finding.kind in ("focal", "center") else name
    if finding.alternatives:
        name += f" (or {', '.join(finding.alternatives)}: the masks do not distinguish them)"
    angle, angle_sd = np.degrees([finding.angle, finding.angle_sd]).tolist()
    unit, factor = shift_unit(finding.kind)
    shift, shift_sd = factor * finding.shift, factor * finding.shift_sd
    if finding.kind == "joint":
        reading = (angle, angle_sd, "deg") if finding.angle_sd > 0.0 else (shift, shift_sd, unit)
        return f"{name} {describe_reading(*reading)}"
    if finding.kind == "focal":
        # The shift is the correction, so a positive one means too short.
        word, many = "short" if shift > 0.0 else "long", finding.name.startswith("focal lengths")
        verb = "are" if many else "is"
        return f"{name} {verb} {abs(shift):.1f} +- {shift_sd:.1f} {unit} too {word}"
    parts = []
    if finding.angle_sd > 0.0:
        parts.append(f"{angle:.2f} +- {angle_sd:.2f} degrees")
    if finding.shift_sd > 0.0:
        at = f" ({1e3 * finding.at_body:.1f} mm at the robot)" if finding.at_body else ""
        parts.append(f"{shift:.1f} +- {shift_sd:.1f} {unit}{at}")
    return f"{name}{':' if verb == 'off' else ''} {verb} by {' and '.join(parts)}"


def describe_common_finding(finding: Finding) -> str:
    """Return a finding common to all inlier frames in words, without a final full stop."""
    pixels = f", which moves outlines by {finding.pixels:.1f} pixels" if finding.pixels else ""
    link = f"link '{finding.link}' is not where the log says"
    if finding.kind == "sign":
        return (
            f"joint '{finding.name}' is logged with the other sign (reverse its column): {link}, "
            f"{finding.text}{pixels}"
        )
    if finding.kind == "log":
        return f"{link}: joint '{finding.name}' differs from the log, {finding.text}{pixels}"
    if finding.kind == "link":
        return f"{link}: {finding.text}"
    if finding.kind == "refused":
        return finding.text
    if finding.kind == "reading":
        return f"{finding.name}{pixels}"
    if finding.kind == "moved" and not finding.link:
        angle = f"{math.degrees(finding.angle):.2f} degrees"
        return f"camera '{finding.name}' {finding.text}, as by turns of {angle}{pixels}"
    if finding.kind == "moved":
        off = describe_error(replace(finding, kind=finding.link), "is off")
        what = "the base" if finding.link == "base" else f"camera '{finding.name}'"
        return f"{what} was moved {finding.text}, {off}{pixels}"
    # The text of a camera's finding names another reading of its pose.
    return f"{describe_error(finding)} in all frames that agree{pixels}{finding.text}"


def describe_frame_finding(frame: FrameDiagnosis, found: Finding) -> str:
    """Return the error of an outlier frame in words.

    frame: its diagnosis. found: its finding.
    """
    pixels = f"which moves outlines by {found.pixels:.1f} pixels"
    if found.kind == "unexplained":
        worst = min(frame.fitted_ratios, key=lambda name: frame.fitted_ratios[name])
        return (
            f"no positions near the given ones explain it: in camera '{worst}' "
            f"{percent(frame.fitted_ratios[worst])} of the contours fit at best"
        )
    most = math.radians(10.0)
    if found.kind == "joint" and abs(found.angle) > most:
        # Fits of single frames are good up to this angle: a larger estimate is not stated.
        word = "low" if found.angle > 0.0 else "high"
        return f"joint '{found.name}' reads more than 10 degrees too {word}, {pixels}"
    if found.kind == "joints":
        named = sorted(found.joints.items(), key=lambda item: -abs(item[1]))
        joints = ", ".join(name for name, _ in named[:3])
        more = f" ({joints} most)" if joints else ""
        return f"has other joint positions than given{more}, {pixels}"
    return f"{describe_error(found, 'is off')}, {pixels}"


def describe_reading(value: float, deviation: float, unit: str) -> str:
    """Return in words that a joint's encoder reads too high or too low.

    ``value``, ``deviation``: the joint offset, to be added to readings, and its standard deviation
    [`unit`]. ``unit``: "deg" or "mm".
    """
    word, digits = "low" if value > 0.0 else "high", 2 if unit == "deg" else 1
    size = f"{abs(value):.{digits}f} +- {deviation:.{digits}f}"
    return f"reads {size} {'degrees' if unit == 'deg' else unit} too {word}"


def describe_drift(camera: str, drift: float, deviation: float) -> str:
    """Return in words that the joint log's clock runs faster or slower than a camera's.

    Args:
        camera: its name.
        drift, deviation: how much faster the log's clock runs, and its standard deviation [s/s].
    """
    word = "faster" if drift > 0.0 else "slower"
    return (
        f"camera '{camera}': the joint log's clock runs {100.0 * abs(drift):.2f} +- "
        f"{100.0 * deviation:.2f} percent {word} than its pictures': is the pictures' rate "
        "correct, and were none dropped?"
    )
