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


def describe_error(one: Finding, verb: str = "off") -> str:
    """Return in words what is wrong, by how much, with standard deviations, and alternatives.

    Args:
        one: of kind "joint", "camera", "base", "focal", "center", "clock" or "rate".
        verb: before the amount, such as "off" or "is off"; used for kinds "camera", "base" and
            "center" only.
    """
    if one.kind == "clock":
        word = "later" if one.shift > 0.0 else "earlier"
        return (
            f"camera '{one.name}': its pictures show joint positions that are logged "
            f"{1e3 * abs(one.shift):.0f} +- {1e3 * one.shift_sd:.0f} ms {word} than their times"
        )
    if one.kind == "rate":
        return describe_drift(one.name, one.shift, one.shift_sd)
    name = "the base" if one.kind == "base" else f"{one.kind} '{one.name}'"
    name = f"the {one.name}" if one.kind in ("focal", "center") else name
    if one.alternatives:
        name += f" (or {', '.join(one.alternatives)}: the masks do not distinguish them)"
    angle, angle_sd = np.degrees([one.angle, one.angle_sd]).tolist()
    unit, factor = shift_unit(one.kind)
    shift, shift_sd = factor * one.shift, factor * one.shift_sd
    if one.kind == "joint":
        reading = (angle, angle_sd, "deg") if one.angle_sd > 0.0 else (shift, shift_sd, unit)
        return f"{name} {describe_reading(*reading)}"
    if one.kind == "focal":
        # The shift is the correction, so a positive one means too short.
        word, many = "short" if shift > 0.0 else "long", one.name.startswith("focal lengths")
        verb = "are" if many else "is"
        return f"{name} {verb} {abs(shift):.1f} +- {shift_sd:.1f} {unit} too {word}"
    parts = []
    if one.angle_sd > 0.0:
        parts.append(f"{angle:.2f} +- {angle_sd:.2f} degrees")
    if one.shift_sd > 0.0:
        at = f" ({1e3 * one.at_body:.1f} mm at the robot)" if one.at_body else ""
        parts.append(f"{shift:.1f} +- {shift_sd:.1f} {unit}{at}")
    return f"{name}{':' if verb == 'off' else ''} {verb} by {' and '.join(parts)}"


def describe_common_finding(one: Finding) -> str:
    """Return a finding common to all inlier frames in words, without a final full stop."""
    pixels = f", which moves outlines by {one.pixels:.1f} pixels" if one.pixels else ""
    link = f"link '{one.link}' is not where the log says"
    if one.kind == "sign":
        return (
            f"joint '{one.name}' is logged with the other sign (reverse its column): {link}, "
            f"{one.text}{pixels}"
        )
    if one.kind == "log":
        return f"{link}: joint '{one.name}' differs from the log, {one.text}{pixels}"
    if one.kind == "link":
        return f"{link}: {one.text}"
    if one.kind == "refused":
        return one.text
    if one.kind == "reading":
        return f"{one.name}{pixels}"
    if one.kind == "moved" and not one.link:
        if one.shift_sd:
            return f"{describe_error(replace(one, kind='camera'), f'moved {one.text}')}{pixels}"
        angle = f"{math.degrees(one.angle):.2f} degrees"
        return f"camera '{one.name}' {one.text}, as by turns of {angle}{pixels}"
    if one.kind == "moved":
        off = describe_error(replace(one, kind=one.link), "is off")
        what = "the base" if one.link == "base" else f"camera '{one.name}'"
        return f"{what} was moved {one.text}, {off}{pixels}"
    # Of a camera the text names another reading of its pose.
    return f"{describe_error(one)} in all frames that agree{pixels}{one.text}"


def describe_frame_finding(one: FrameDiagnosis, found: Finding) -> str:
    """Return the error of an outlier frame in words.

    one: the frame's diagnosis. found: its finding.
    """
    pixels = f"which moves outlines by {found.pixels:.1f} pixels"
    if found.kind == "unexplained":
        worst = min(one.fitted_ratios, key=lambda name: one.fitted_ratios[name])
        return (
            f"no positions near the given ones explain it: in camera '{worst}' "
            f"{percent(one.fitted_ratios[worst])} of the contours fit at best"
        )
    most = math.radians(10.0)
    if found.kind == "joint" and abs(found.angle) > most:
        # Fits of single frames reach this far; larger estimates are no measurement.
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

    Args:
        value, deviation: the joint offset, to be added to readings, and its standard deviation
            [`unit`].
        unit: "deg" or "mm".
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
