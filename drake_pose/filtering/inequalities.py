"""Named linear inequalities phi^T x <= b on a state: (14) to (18) of Shimada et al.

They come from joint limits and from a couplings file beside the model, which can also hold a prior
of the joints.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_pose.arrays import Array
from drake_pose.body import ParsedModel
from drake_pose.errors import ModelError, SettingsError, UnknownNameError, require_known
from drake_pose.input_files import read_yaml, typed_entry


@dataclass(frozen=True, eq=False)
class Inequalities:
    """Inequalities phi_k^T x <= b_k, k = 1 ... K: (18)."""

    columns: tuple[str, ...]  # (n) names of the elements of x.
    rows: tuple[str, ...]  # (K) text of each inequality, for messages and logs.
    phi: Array  # (K, n) coefficients, read-only.
    b: Array  # (K,) bounds, read-only.

    def __len__(self) -> int:
        return len(self.rows)

    def margins(self, x: ArrayLike) -> Array:
        """Return b - phi x (K,) at x (n,): negative where an inequality is violated."""
        return self.b - self.phi @ np.asarray(x, dtype=np.float64)

    def for_columns(self, columns: Sequence[str]) -> "Inequalities":
        """Return the same inequalities over other columns, for example with rates added.

        Raises UnknownNameError: an inequality uses an element that is not among the columns.
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

    def restricted_to(self, columns: Sequence[str]) -> "Inequalities":
        """Return the inequalities that use only elements among ``columns``, over these columns."""
        absent = [i for i, name in enumerate(self.columns) if name not in columns]
        kept = np.flatnonzero(~self.phi[:, absent].any(axis=1))
        rows = tuple(self.rows[k] for k in kept)
        return Inequalities(self.columns, rows, self.phi[kept], self.b[kept]).for_columns(columns)


def make_inequalities(
    columns: Sequence[str], rows: Sequence[str], phi: ArrayLike, b: ArrayLike
) -> Inequalities:
    """Return checked inequalities phi x <= b.

    Args:
        columns: (n) names of the elements of x.
        rows: (K) text of each inequality, for messages.
        phi: (K, n) coefficients.
        b: (K,) bounds.

    Raises SettingsError: the sizes do not fit, a number is not finite, or a row of phi is zero.
    """
    matrix = np.array(phi, dtype=np.float64).reshape(-1, len(columns))
    bounds = np.array(b, dtype=np.float64).ravel()
    if not len(rows) == len(matrix) == len(bounds):
        raise SettingsError(
            f"{len(rows)} names, {len(matrix)} rows and {len(bounds)} bounds: give as many of each"
        )
    for name, row, bound in zip(rows, matrix, bounds, strict=True):
        if not (np.isfinite(row).all() and np.isfinite(bound)):
            raise SettingsError(f"inequality '{name}': a number is not finite; leave it out")
        if not row.any():
            raise SettingsError(f"inequality '{name}': all coefficients are zero; leave it out")
    matrix.setflags(write=False)
    bounds.setflags(write=False)
    return Inequalities(tuple(columns), tuple(rows), matrix, bounds)


def two_sided(
    columns: Sequence[str], name: str, phi: ArrayLike, lower: float, upper: float
) -> Inequalities:
    """Return lower <= phi^T x <= upper as two inequalities; infinite bounds are left out.

    ``columns``: (n) names of the elements of x. ``name``: begins the text of both inequalities.
    ``phi``: (n,) coefficients. Raises SettingsError: lower > upper, a bound is NaN, or phi is zero.
    """
    if np.isnan(lower) or np.isnan(upper) or lower > upper:
        raise SettingsError(
            f"inequality '{name}': the lower bound {lower:g} must not exceed the upper {upper:g}"
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
    """Return the rows of all ``parts`` as one set of inequalities.

    ``columns``: names of its elements; None: the union of the parts' columns.

    Raises UnknownNameError: a row uses an element that is not among ``columns``.
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
    """Return lower <= x <= upper for each named element; infinite bounds are left out.

    ``names``: (k) elements with bounds. ``lower``, ``upper``: (k,) bounds. ``columns``: elements of
    the state; ``names`` if not given.

    Raises SettingsError: a lower bound exceeds its upper bound; UnknownNameError: a name is not
    among the columns.
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    unit = np.eye(len(names))
    parts = [
        two_sided(names, name, unit[i], float(low[i]), float(high[i]))
        for i, name in enumerate(names)
    ]
    return stack(parts, names if columns is None else columns)


def from_model(model: ParsedModel) -> Inequalities:
    """Return the finite position limits of a model [rad or m]: (14), and (16) for shape joints.

    Joints that turn freely, or whose limits span exactly a full turn, have no limits. The set may
    be empty.
    """
    meet = np.abs(model.upper - model.lower - 2.0 * np.pi) < 1e-9
    full_turn = model.is_unlimited_angle | (model.periodic & meet)
    lower = np.where(full_turn, -np.inf, model.lower)
    upper = np.where(full_turn, np.inf, model.upper)
    return from_bounds(model.position_names, lower, upper)


def warn_if_unlimited(inequalities: Inequalities, where: str) -> Inequalities:
    """Return the inequalities; if there are none, warn (UserWarning) with the file ``where``."""
    if not len(inequalities):
        warnings.warn(
            f"{where}: no joint has a limit, so that nothing is truncated",
            UserWarning,
            stacklevel=3,
        )
    return inequalities


def row_from_terms(columns: Sequence[str], terms: Mapping[str, float], where: str) -> NDArray:
    """Return the coefficients (n,) of an inequality; elements without a term have 0.

    ``terms``: coefficients by name of an element. Raises UnknownNameError, with ``where`` for the
    place: a name is not among the columns.
    """
    row = np.zeros(len(columns))
    require_known("joint", terms, columns, where)
    for name, factor in terms.items():
        row[list(columns).index(name)] += factor
    return row


def inner_point(inequalities: Inequalities) -> Array:
    """Return a point (n,) that satisfies all inequalities, if possible far from each bound.

    It is the centre of the largest ball inside the rows (at most of radius 1), by a linear program.
    If there is none, the program's dual names the rows that exclude each other.

    Raises SettingsError: no point lies strictly inside all rows; the message names the conflicting
    rows.
    """
    count, n = inequalities.phi.shape
    if count == 0:
        return np.zeros(n)
    norms = np.linalg.norm(inequalities.phi, axis=1)
    unit_phi, unit_b = inequalities.phi / norms[:, None], inequalities.b / norms
    from scipy.optimize import linprog  # Slow to import, and seldom needed.

    solution = linprog(
        c=np.r_[np.zeros(n), -1.0],
        A_ub=np.c_[unit_phi, np.ones(count)],
        b_ub=unit_b,
        # Without a limit the radius may be unbounded.
        bounds=[(None, None)] * n + [(None, 1.0)],
        method="highs",
    )
    radius = float(solution.x[-1])
    if radius > 1e-12 * max(1.0, float(np.abs(unit_b).max())):
        return solution.x[:n]
    weights = np.abs(solution.ineqlin.marginals)
    clashing = [inequalities.rows[i] for i in np.flatnonzero(weights > 1e-9)]
    verb = "exclude each other" if radius < 0 else "leave no interior"
    raise SettingsError(
        f"the inequalities {verb}: {'; '.join(clashing)}. Loosen or remove one of them"
    )


_UNITS = {"": 1.0, "rad": 1.0, "m": 1.0, "deg": math.pi / 180.0, "mm": 1e-3}


@dataclass
class Difference:
    """An entry of ``differences``: bounds of first - second.

    Either ``|first - second| <= within`` or ``lower <= first - second <= upper``.

    Attributes:
        first, second: names of two joints.
        within, lower, upper: bounds in ``unit``; infinite where not given.
        unit: "deg", "mm", "rad", "m", or "" (the model's own, rad or m).
    """

    first: str = ""
    second: str = ""
    within: float = math.inf
    lower: float = -math.inf
    upper: float = math.inf
    unit: str = ""


@dataclass
class GeneralRow:
    """An entry of ``rows``: lower <= sum of coefficient x joint <= upper."""

    name: str = ""  # Begins the text of the inequality.
    terms: dict[str, float] = field(default_factory=dict)  # Coefficient by joint.
    # lower, upper: bounds in ``unit``; infinite where not given.
    lower: float = -math.inf
    upper: float = math.inf
    unit: str = ""  # As in ``Difference``.


@dataclass
class PriorRow:
    """An entry of ``usual``: the sum of coefficient x joint is normally distributed."""

    name: str = ""  # For messages.
    terms: dict[str, float] = field(default_factory=dict)  # Coefficient by joint.
    # mean, deviation: mean and standard deviation in ``unit``.
    mean: float = math.nan
    deviation: float = math.nan
    unit: str = ""  # As in ``Difference``.


@dataclass
class Couplings:
    """The schema of a couplings file."""

    # differences, rows: inequalities (``load_couplings``).
    differences: list[Difference] = field(default_factory=list)
    rows: list[GeneralRow] = field(default_factory=list)
    usual: list[PriorRow] = field(default_factory=list)  # The joints' prior (``load_joint_prior``).


@dataclass(frozen=True, eq=False)
class JointPrior:
    """A normal prior of a state x: phi x is normally distributed, with independent components."""

    phi: Array  # (k, n) coefficients.
    # mean, deviation: (k,) mean and standard deviation of phi x.
    mean: Array
    deviation: Array


def load_couplings(path: Path | str, columns: Sequence[str]) -> Inequalities:
    """Read the inequalities of a couplings file (YAML).

    The file has a list ``differences`` (fields of ``Difference``), a list ``rows`` (fields of
    ``GeneralRow``), or both; a list ``usual`` is read by ``load_joint_prior``::

        differences:
          - {first: flexion_12, second: flexion_13, within: 10, unit: deg}
        rows:
          - {name: curl, terms: {flexion_11: 1, flexion_12: 1}, upper: 150, unit: deg}

    ``path``: the couplings file. ``columns``: (n) names of the elements that the inequalities are
    over. Raises ModelError: the file cannot be read or an entry is invalid; UnknownNameError: an
    entry names an unknown joint.
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
    """Return the place of a difference for messages, and the difference as a general row.

    The place begins with ``file``. Raises ModelError: both joints are the same, or ``within`` is
    given with ``lower`` or ``upper``.
    """
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


def load_joint_prior(path: Path | str, columns: Sequence[str]) -> JointPrior:
    """Read the joints' prior from a couplings file.

    The file may have a list ``usual`` (fields of ``PriorRow``)::

        usual:
          - {name: knuckle, terms: {flexion_11: 1}, mean: 30, deviation: 25, unit: deg}

    Entries that use other elements than ``columns`` (n) are skipped.

    Raises ModelError: the file cannot be read or an entry is invalid.
    """
    file = Path(path)
    phi, moments = [], []
    for row in _read(file).usual:
        where = f"{file}: usual '{row.name}'"
        unit = _unit(row.unit, where)
        if not (math.isfinite(row.mean) and 0 < row.deviation < math.inf):
            raise ModelError(f"{where}: give a finite mean and a positive deviation")
        if not any(row.terms.values()):
            raise ModelError(f"{where}: its terms name no joint with a coefficient")
        if set(row.terms) <= set(columns):
            phi.append(row_from_terms(columns, row.terms, where))
            moments.append((unit * row.mean, unit * row.deviation))
    mean, deviation = np.reshape(moments, (-1, 2)).T
    return JointPrior(np.reshape(phi, (-1, len(columns))), mean, deviation)


def couplings_file(model_file: Path) -> Path:
    """Return the path of a model's couplings file: ``hand.couplings.yaml`` beside ``hand.urdf``."""
    return model_file.with_name(f"{model_file.name.split('.')[0]}.couplings.yaml")


def model_inequalities(model: ParsedModel) -> Inequalities:
    """Return a model's position limits, and the inequalities of its couplings file if there is one.

    Warn (UserWarning) if there are none.

    Raises:
        ModelError: the couplings file cannot be read.
        UnknownNameError: the couplings file names an unknown joint.
        SettingsError: inequalities exclude each other; the message names them.
    """
    parts = [from_model(model)]
    file = couplings_file(model.path)
    if file.is_file():
        parts.append(load_couplings(file, model.position_names))
    whole = stack(parts, model.position_names)
    inner_point(whole)
    return warn_if_unlimited(whole, str(model.path))


def _read(file: Path) -> Couplings:
    """Read a couplings file; ModelError if that fails."""
    return typed_entry(read_yaml(file, ModelError), Couplings, str(file), ModelError)


def _unit(unit: str, where: str) -> float:
    """Return the factor from a unit to rad or m; ModelError, which begins with ``where``."""
    if unit not in _UNITS:
        known = ", ".join(key for key in _UNITS if key)
        raise ModelError(f"{where}: unit '{unit}' is unknown; use one of {known}")
    return _UNITS[unit]
