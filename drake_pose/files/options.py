"""Texts of options and of job files to plain values, and a share as people read it.

Other forms of a text raise a SettingsError.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cyclopts import Parameter, Token

from drake_pose.errors import SettingsError

Axis = Literal["x", "y", "z"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
RotationLimits = dict[Axis, tuple[float, float]]
Corner = tuple[float, float, float]
"""x, y, z [m]."""


@dataclass(frozen=True)
class FromText:
    """A setting's converter: parses one text, or where the option may be repeated all of them."""

    parse: Callable[[Any], Any]
    repeated: bool = False

    def __call__(self, hint: object, tokens: Sequence[Token]) -> Any:
        """Returns the value; a SettingsError begins with the option's name."""
        texts = [token.value for token in tokens]
        try:
            return self.parse(texts if self.repeated else texts[0])
        except SettingsError as error:
            raise SettingsError(f"{tokens[0].keyword}: {error}") from None


def from_text(
    parse: Callable[[Any], Any], metavar: str, *, name: str | None = None, repeated: bool = False
) -> Parameter:
    """Returns how an option is read whose text ``parse`` understands."""
    return Parameter(
        name,
        converter=FromText(parse, repeated),
        metavar=metavar,
        accepts_keys=False,
        allow_leading_hyphen=True,
        n_tokens=-1 if repeated else 1,
    )


def within(low: float, high: float = math.inf) -> Parameter:
    """Returns the check of an option: a finite number in this range."""

    def check(hint: object, value: float | None) -> None:
        if value is not None and not (math.isfinite(value) and low <= value <= high):
            wanted = f"{low:g} or more" if high == math.inf else f"{low:g} to {high:g}"
            raise ValueError(f"It must be {wanted}.")

    return Parameter(validator=check)


def parse_number(text: str) -> float:
    """Returns a finite number."""
    try:
        number = float(text)
    except ValueError:
        raise SettingsError(f"'{text}' is not a number") from None
    if not math.isfinite(number):
        raise SettingsError(f"'{text}' is not a finite number")
    return number


def parse_assignments(texts: Iterable[str]) -> dict[str, float]:
    """Returns the values of ``NAME=NUMBER`` texts by name."""
    values: dict[str, float] = {}
    for text in texts:
        name, equals, number = text.rpartition("=")
        if not equals or not name:
            raise SettingsError(f"'{text}' must have the form NAME=NUMBER")
        if name in values:
            raise SettingsError(f"'{name}' is given twice")
        values[name] = parse_number(number)
    return values


def parse_packages(texts: Iterable[str]) -> dict[str, Path]:
    """Returns the absolute folders of ``NAME=FOLDER`` texts by package."""
    folders: dict[str, Path] = {}
    for text in texts:
        name, equals, folder = text.partition("=")
        if not (name and equals and folder):
            raise SettingsError(f"'{text}' must have the form NAME=FOLDER")
        if name in folders:
            raise SettingsError(f"'{name}' is given twice")
        if not Path(folder).is_dir():
            raise SettingsError(f"{name}: there is no folder {folder}")
        folders[name] = Path(folder).absolute()
    return folders


def parse_numbers(text: str, count: int) -> tuple[float, ...]:
    """Returns so many numbers of a text ``A,B,...``."""
    parts = text.split(",")
    if len(parts) != count:
        raise SettingsError(f"'{text}' must be {count} numbers with commas between them")
    return tuple(map(parse_number, parts))


def parse_boxes(texts: Iterable[str]) -> tuple[tuple[Corner, Corner], ...]:
    """Returns the least and the largest corner of each text ``X,Y,Z:X,Y,Z`` of two corners [m]."""
    boxes = []
    for text in texts:
        corners = text.split(":")
        if [len(corner.split(",")) for corner in corners] != [3, 3]:
            raise SettingsError(f"'{text}' must have the form X,Y,Z:X,Y,Z")
        (ax, ay, az), (bx, by, bz) = (parse_numbers(corner, 3) for corner in corners)
        low = (min(ax, bx), min(ay, by), min(az, bz))
        boxes.append((low, (max(ax, bx), max(ay, by), max(az, bz))))
    return tuple(boxes)


def parse_root_position(text: str) -> Corner | tuple[Path, str] | Literal["unknown"]:
    """Returns a position ``X,Y,Z`` [m], file and joint of ``FILE.csv:JOINT``, or ``unknown``."""
    if text == "unknown":
        return "unknown"
    if text.count(",") == 2:
        x, y, z = parse_numbers(text, 3)
        return x, y, z
    file, colon, joint = text.rpartition(":")
    if not (colon and file and joint):
        raise SettingsError(
            f"'{text}' must be X,Y,Z in metres, FILE.csv:JOINT for one position a frame, or unknown"
        )
    return Path(file), joint


def parse_root_rotation(text: str) -> Literal["fixed", "free"] | RotationLimits:
    """Returns ``fixed``, ``free``, or limits about the root's axes [deg], in order of rotation.

    The limits' text is like ``y=-180:180,z=-10:10``.
    """
    if text == "fixed":
        return "fixed"
    if text == "free":
        return "free"
    limits: RotationLimits = {}
    for part in text.split(","):
        letter, equals, span = part.strip().partition("=")
        lower_text, colon, upper_text = span.partition(":")
        axis = next((axis for axis in AXES if axis == letter), None)
        if axis is None or axis in limits or not (equals and colon):
            raise SettingsError(
                f"'{text}' must be fixed, free, or limits in degrees about the axes x, y, z in "
                "the order of rotation, like y=-180:180,z=-10:10"
            )
        lower, upper = parse_number(lower_text), parse_number(upper_text)
        if lower > upper:
            raise SettingsError(f"{axis}: the lower limit {lower:g} exceeds the upper {upper:g}")
        limits[axis] = (lower, upper)
    return limits


def percent(share: float | None) -> str:
    """Returns a share in percent, or a dash."""
    return "-" if share is None else f"{100.0 * share:.2f} %"
