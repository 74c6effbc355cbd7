"""Linear inequalities phi^T x <= b on a state, each with a name: (14) to (18) of Shimada et al."""

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from pydrake.common.yaml import yaml_load_typed
from scipy.optimize import linprog

from drake_pose.arrays import Array
from drake_pose.body import ParsedModel
from drake_pose.errors import ModelError, SettingsError, UnknownNameError


@dataclass(frozen=True, eq=False)
class Inequalities:
    """A stack of rows phi_k^T x <= b_k (18).

    Attributes:
        columns: (n) the names of the elements of x.
        rows: (K) what each row says, for messages and logs.
        phi: (K, n) the rows, read-only.
        b: (K,) the bounds, read-only.
    """

    columns: tuple[str, ...]
    rows: tuple[str, ...]
    phi: Array
    b: Array

    def __len__(self) -> int:
        return len(self.rows)

    def margins(self, x: ArrayLike) -> Array:
        """(K,) b - phi x: how far x (n,) is from each bound, negative where it is beyond."""
        return self.b - self.phi @ np.asarray(x, dtype=np.float64)

    def take(self, indices: Iterable[int]) -> "Inequalities":
        """The rows of these indices, in that order."""
        chosen = list(indices)
        rows = [self.rows[index] for index in chosen]
        return make_inequalities(self.columns, rows, self.phi[chosen], self.b[chosen])

    def for_columns(self, columns: Sequence[str]) -> "Inequalities":
        """The same rows for a state with these elements, for example one with rates too.

        Raises:
            UnknownNameError: a row uses an element that is not there.
        """
        known = list(columns)
        phi = np.zeros((len(self), len(known)))
        for index, name in enumerate(self.columns):
            if name in known:
                phi[:, known.index(name)] = self.phi[:, index]
            elif self.phi[:, index].any():
                row = self.rows[int(np.flatnonzero(self.phi[:, index])[0])]
                raise UnknownNameError("element", name, known, f"the state (row '{row}')")
        return make_inequalities(known, self.rows, phi, self.b)

    def only_of(self, columns: Sequence[str]) -> "Inequalities":
        """The rows that use none but these elements, for a state that has these."""
        absent = [i for i, name in enumerate(self.columns) if name not in columns]
        kept = np.flatnonzero(~self.phi[:, absent].any(axis=1))
        rows = tuple(self.rows[k] for k in kept)
        return Inequalities(self.columns, rows, self.phi[kept], self.b[kept]).for_columns(columns)


def make_inequalities(
    columns: Sequence[str], rows: Sequence[str], phi: ArrayLike, b: ArrayLike
) -> Inequalities:
    """Inequalities from columns (n), names of rows (K), phi (K, n) and bounds (K,).

    Raises:
        SettingsError: sizes that do not fit, a number that is not finite, or a row of zeros.
    """
    matrix = np.array(phi, dtype=np.float64).reshape(-1, len(columns))
    bounds = np.array(b, dtype=np.float64).ravel()
    if not len(rows) == len(matrix) == len(bounds):
        raise SettingsError(
            f"{len(rows)} names, {len(matrix)} rows and {len(bounds)} bounds: give one of each"
        )
    for name, row, bound in zip(rows, matrix, bounds, strict=True):
        if not (np.isfinite(row).all() and np.isfinite(bound)):
            raise SettingsError(f"inequality '{name}': a number is not finite; leave the row out")
        if not row.any():
            raise SettingsError(f"inequality '{name}': all factors are zero; leave the row out")
    matrix.setflags(write=False)
    bounds.setflags(write=False)
    return Inequalities(tuple(columns), tuple(rows), matrix, bounds)


def two_sided(
    columns: Sequence[str],
    name: str,
    phi: ArrayLike,
    lower: float,
    upper: float,
) -> Inequalities:
    """Bounds lower <= phi^T x <= upper as two rows, or as one where the other bound is infinite.

    Raises:
        SettingsError: the bounds are crossed or NaN, or phi is zero.
    """
    if np.isnan(lower) or np.isnan(upper) or lower > upper:
        raise SettingsError(
            f"inequality '{name}': lower bound {lower:g} and upper bound {upper:g} are crossed; "
            "give the lower one first"
        )
    row = np.asarray(phi, dtype=np.float64)
    sides = []
    if np.isfinite(lower):
        sides.append((f"{name} >= {lower:.6g}", -row, -lower))
    if np.isfinite(upper):
        sides.append((f"{name} <= {upper:.6g}", row, upper))
    return make_inequalities(
        columns,
        [side[0] for side in sides],
        np.reshape([side[1] for side in sides], (-1, len(columns))),
        [side[2] for side in sides],
    )


def stack(parts: Sequence[Inequalities], columns: Sequence[str] | None = None) -> Inequalities:
    """All rows of several sets, over the union of their columns or those given.

    Raises:
        UnknownNameError: a row uses an element that is not among the given columns.
    """
    union = dict.fromkeys(name for part in parts for name in part.columns)
    names = list(union if columns is None else columns)
    fitted = [part.for_columns(names) for part in parts]
    return make_inequalities(
        names,
        [row for part in fitted for row in part.rows],
        np.concatenate([part.phi for part in fitted] or [np.zeros((0, len(names)))]),
        np.concatenate([part.b for part in fitted] or [np.zeros(0)]),
    )


def from_bounds(
    names: Sequence[str], lower: ArrayLike, upper: ArrayLike, columns: Sequence[str] | None = None
) -> Inequalities:
    """Bounds lower <= x <= upper, element by element; infinite bounds make no row.

    Raises:
        SettingsError: bounds are crossed.
        UnknownNameError: a name is not among the columns.
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    unit = np.eye(len(names))
    parts = [
        two_sided(names, name, unit[i], float(low[i]), float(high[i]))
        for i, name in enumerate(names)
    ]
    return stack(parts, names if columns is None else columns)


def from_model(model: ParsedModel) -> Inequalities:
    """Every finite position limit of a model [rad or m]: (14), and with shape joints (16).

    A joint that turns freely has no limit to give, nor one whose limits meet after a full turn. A
    model without any limit gives an empty set.
    """
    meet = np.abs(model.upper - model.lower - 2.0 * np.pi) < 1e-9
    full_turn = model.turns_freely | (model.periodic & meet)
    lower = np.where(full_turn, -np.inf, model.lower)
    upper = np.where(full_turn, np.inf, model.upper)
    return from_bounds(model.position_names, lower, upper)


def say_if_unlimited(inequalities: Inequalities, where: str) -> Inequalities:
    """The same; a warning where there are none, which is allowed: nothing is truncated then."""
    if not len(inequalities):
        warnings.warn(
            f"{where}: no joint has a limit; nothing will be truncated", UserWarning, stacklevel=3
        )
    return inequalities


def row_from_terms(columns: Sequence[str], terms: Mapping[str, float], where: str) -> NDArray:
    """(n,) the factors of a row given by names.

    Raises:
        UnknownNameError: a name is not among the columns.
    """
    row = np.zeros(len(columns))
    for name, factor in terms.items():
        if name not in columns:
            raise UnknownNameError("joint", name, columns, where)
        row[list(columns).index(name)] += factor
    return row


def inner_point(inequalities: Inequalities) -> Array:
    """(n,) a point inside all rows, far from each if that is possible.

    The linear program that finds the largest ball inside; where there is none its dual names the
    rows that clash.

    Raises:
        SettingsError: no point satisfies all rows with room to spare; the message names the rows
            that exclude each other.
    """
    count, n = inequalities.phi.shape
    if count == 0:
        return np.zeros(n)
    norms = np.linalg.norm(inequalities.phi, axis=1)
    unit_phi, unit_b = inequalities.phi / norms[:, None], inequalities.b / norms
    solution = linprog(
        c=np.r_[np.zeros(n), -1.0],
        A_ub=np.c_[unit_phi, np.ones(count)],
        b_ub=unit_b,
        # A radius above 1 buys nothing and may be unbounded.
        bounds=[(None, None)] * n + [(None, 1.0)],
        method="highs",
    )
    if solution.x is None:
        raise SettingsError(f"the inequalities cannot be checked: {solution.message}")
    radius = float(solution.x[-1])
    # Rows are scaled to unit length, so a radius is a length in the space of states.
    if radius > 1e-12 * max(1.0, float(np.abs(unit_b).max())):
        return solution.x[:n]
    weights = np.abs(solution.ineqlin.marginals)
    clashing = [inequalities.rows[i] for i in np.flatnonzero(weights > 1e-9)]
    verb = "exclude each other" if radius < 0 else "leave no room between them"
    raise SettingsError(
        f"the inequalities {verb}: {'; '.join(clashing)}. Loosen or remove one of them"
    )


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


def _read(file: Path, largest: int = 1 << 20) -> Couplings:
    try:
        if file.stat().st_size > largest:
            raise ModelError(f"{file}: larger than {largest} bytes, which is no couplings")
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
