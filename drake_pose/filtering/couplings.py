"""Couplings of joints, from a YAML file beside the model: (15) and (17) of Shimada et al.

Beside inequalities the file may say how joints are usually held, which excludes nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load_typed

from drake_pose.arrays import Array
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.errors import ModelError, SettingsError
from drake_pose.filtering.inequalities import (
    Inequalities,
    from_model,
    inner_point,
    row_from_terms,
    say_if_unlimited,
    stack,
    two_sided,
)

_LARGEST_FILE = 1 << 20
_UNITS = {"": 1.0, "rad": 1.0, "m": 1.0, "deg": math.pi / 180.0, "mm": 1e-3}


@dataclass
class Difference:
    """``lower <= first - second <= upper`` or ``|first - second| <= within``.

    Attributes:
        within, lower, upper: bounds in ``unit``; what is not given does not bound.
        unit: "deg", "mm", "rad", "m", or nothing (the model's own, rad or m).
    """

    first: str = ""
    second: str = ""
    within: float = math.inf
    lower: float = -math.inf
    upper: float = math.inf
    unit: str = ""


@dataclass
class GeneralRow:
    """lower <= sum of factor x joint <= upper.

    Attributes:
        terms: a factor for each joint.
        lower, upper: bounds in ``unit``; what is not given does not bound.
        unit: as in ``Difference``.
    """

    name: str = ""
    terms: dict[str, float] = field(default_factory=dict)
    lower: float = -math.inf
    upper: float = math.inf
    unit: str = ""


@dataclass
class UsualRow:
    """The sum of factor x joint is usually about mean.

    Attributes:
        terms: a factor for each joint.
        mean, deviation: its mean and standard deviation in ``unit``.
        unit: as in ``Difference``.
    """

    name: str = ""
    terms: dict[str, float] = field(default_factory=dict)
    mean: float = math.nan
    deviation: float = math.nan
    unit: str = ""


@dataclass
class Couplings:
    """The content of a couplings file."""

    differences: list[Difference] = field(default_factory=list)
    rows: list[GeneralRow] = field(default_factory=list)
    usual: list[UsualRow] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class UsualPose:
    """How a body is usually held: phi (k, n) times a state x is normal, mean and deviation (k,)."""

    phi: Array
    mean: Array
    deviation: Array


def load_couplings(path: Path | str, columns: Sequence[str]) -> Inequalities:
    """Read the couplings of a YAML file.

    The file has a list ``differences`` (fields of ``Difference``), a list ``rows`` (fields of
    ``GeneralRow``), or both; and it may have a list ``usual``, see ``load_usual_pose``::

        differences:
          - {first: flexion_12, second: flexion_13, within: 10, unit: deg}
        rows:
          - {name: curl, terms: {flexion_11: 1, flexion_12: 1}, upper: 150, unit: deg}

    Raises:
        ModelError: the file cannot be read; the message names it and what is wrong.
        UnknownNameError: a row names a joint that does not exist.
    """
    file = Path(path)
    content = _read(file)
    rows = [_difference(one, f"{file}: ") for one in content.differences]
    rows += [(f"{file}: row '{one.name}'", one) for one in content.rows]
    parts = []
    for where, row in rows:
        bounds = (row.lower, row.upper)
        lower, upper = (_unit(row.unit, where) * bound for bound in bounds)
        if not np.isfinite(bounds).any():
            raise ModelError(f"{where}: nothing is bounded; give within, lower or upper")
        phi = row_from_terms(columns, row.terms, where)
        try:
            parts.append(two_sided(columns, row.name, phi, lower, upper))
        except SettingsError as error:
            raise ModelError(f"{where}: {error}") from error
    return stack(parts, columns)


def _difference(one: Difference, file: str) -> tuple[str, GeneralRow]:
    """A difference as a general row, and where it stands."""
    name = f"{one.first} - {one.second}"
    where = f"{file}'{name}'"
    if one.first == one.second:
        raise ModelError(f"{where}: give two different joints as first and second")
    lower, upper = one.lower, one.upper
    if math.isfinite(one.within):
        if math.isfinite(lower) or math.isfinite(upper):
            raise ModelError(f"{where}: give either within, or lower and upper")
        lower, upper = -one.within, one.within
    return where, GeneralRow(name, {one.first: 1.0, one.second: -1.0}, lower, upper, one.unit)


def load_usual_pose(path: Path | str, columns: Sequence[str]) -> UsualPose:
    """Read how a body is usually held from its couplings file.

    The file may have a list ``usual`` (fields of ``UsualRow``)::

        usual:
          - {name: knuckle, terms: {flexion_11: 1}, mean: 30, deviation: 25, unit: deg}

    Rows about other elements than ``columns`` are left out.

    Raises:
        ModelError: the file cannot be read; the message names it and what is wrong.
    """
    file = Path(path)
    phi, moments = [], []
    for row in _read(file).usual:
        where = f"{file}: usual '{row.name}'"
        unit = _unit(row.unit, where)
        if not (math.isfinite(row.mean) and 0 < row.deviation < math.inf):
            raise ModelError(f"{where}: give a mean, and a deviation that is positive")
        if not any(row.terms.values()):
            raise ModelError(f"{where}: its terms name no joint with a factor")
        if set(row.terms) <= set(columns):
            phi.append(row_from_terms(columns, row.terms, where))
            moments.append((unit * row.mean, unit * row.deviation))
    mean, deviation = np.reshape(moments, (-1, 2)).T
    return UsualPose(np.reshape(phi, (-1, len(columns))), mean, deviation)


def couplings_file(model_file: Path) -> Path:
    """Where a model's couplings are looked for: ``hand.couplings.yaml`` beside ``hand.urdf``."""
    return model_file.with_name(f"{model_file.name.split('.')[0]}.couplings.yaml")


def model_inequalities(model: ParsedModel) -> Inequalities:
    """All that is known of a model's positions: its limits, and its couplings file if there is one.

    Raises:
        ModelError: the couplings file cannot be read.
        UnknownNameError: it names a joint that does not exist.
        SettingsError: the rows exclude each other; the message names them.
    """
    parts = [from_model(model)]
    file = couplings_file(model.path)
    if file.is_file():
        parts.append(load_couplings(file, model.position_names))
    whole = stack(parts, model.position_names)
    inner_point(whole)
    return say_if_unlimited(whole, str(model.path))


def _read(file: Path) -> Couplings:
    try:
        if file.stat().st_size > _LARGEST_FILE:
            raise ModelError(f"{file}: larger than {_LARGEST_FILE} bytes, which is no couplings")
        content = yaml_load_typed(schema=Couplings, data=file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelError(f"{file}: cannot read the couplings: {error.strerror}") from error
    except (yaml.YAMLError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise ModelError(
            f"{file}: not a couplings file ({' '.join(str(error).split())}); it has lists "
            "'differences', 'rows' and 'usual'"
        ) from error
    return content


def _unit(unit: str, where: str) -> float:
    if unit not in _UNITS:
        known = ", ".join(key for key in _UNITS if key)
        raise ModelError(f"{where}: unit '{unit}' is unknown; use one of {known}")
    return _UNITS[unit]
