"""The layout of a filter's state, beliefs about it, and functions linearised over them.

A state is (moving elements, their rates, constants). Equation numbers are those of Shimada, Shirai,
Kuno and Miura.

A tangent describes a function at one point. Where a belief is wide compared with the function's
curvature, a filter of tangents becomes overconfident. ``linearise_over`` takes the slope between
points sqrt(3) standard deviations apart on either side of the mean, and returns the covariance of
the second-order remainder, which counts as noise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.errors import SettingsError, UnknownNameError, require_known


def factor_of(covariance: Array, names: Sequence[str] = (), subject: str = "the belief") -> Array:
    """Return L (n, n) with L L^T = covariance; the covariance may be singular.

    ``covariance``: (n, n), symmetric and positive semidefinite. ``names``: (n) names of the
    elements, for messages; their indices if empty. ``subject``: begins messages.

    Raises SettingsError: the covariance is indefinite; the message names the element that
    contributes most to the negative eigenvalue.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        pass
    # Semidefinite. Correlations keep small variances from being lost beside large ones.
    scale = np.sqrt(np.abs(np.diag(covariance)))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if values[0] < -1e-8:
        k = int(np.argmax(np.abs(vectors[:, 0])))
        raise SettingsError(
            f"{subject}: the covariance is indefinite; the lowest eigenvalue of its correlations "
            f"is {values[0]:.3g}, to which '{names[k] if names else k}' contributes most"
        )
    root = (scale[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0))
    return np.ascontiguousarray(root)


def covariance_from(factor: Array) -> Array:
    """Return L L^T (n, n) of L (n, k) = ``factor``, symmetric and if possible positive definite.

    The diagonal is inflated by up to 1.1e-10, relative, until a Cholesky factorisation succeeds.
    """
    product = factor @ factor.T
    product = 0.5 * (product + product.T)
    inflation = 1e-15
    while inflation < 1e-9:
        try:
            np.linalg.cholesky(product)
            break
        except np.linalg.LinAlgError:
            product[np.diag_indices_from(product)] *= 1.0 + inflation
            inflation *= 10.0
    return product


@dataclass(frozen=True)
class StateLayout:
    """The elements of a state: moving ones, their rates, and constants.

    ``moving``: (m) names of the elements that have a rate. ``constant``: (k) names of the elements
    that do not change, for example lengths.

    Raises SettingsError: a name occurs twice.
    """

    moving: tuple[str, ...]
    constant: tuple[str, ...]

    def __post_init__(self) -> None:
        repeated = [name for name in self.names if self.names.count(name) > 1]
        if repeated:
            raise SettingsError(f"the state's element '{repeated[0]}' is given twice")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(n) moving elements, their rates as ``rate_<name>``, constants; n = 2 m + k."""
        rates = tuple(f"rate_{name}" for name in self.moving)
        return (*self.moving, *rates, *self.constant)

    def __len__(self) -> int:
        return 2 * len(self.moving) + len(self.constant)

    def index(self, name: str) -> int:
        """Return the index of an element in the state.

        Raises:
            UnknownNameError: the state has no element of this name.
        """
        if name not in self.names:
            raise UnknownNameError("element", name, self.names, "the state")
        return self.names.index(name)

    def indices(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Return the indices of elements in the state; raises as ``index``."""
        return np.array([self.index(name) for name in names], dtype=np.intp)

    def transition(self, decay: float = 1.0) -> Array:
        """Return A (n, n) of (8): a constant-velocity step with rates per step.

        ``decay``: factor on the rates in a step; 1 in (8). ``constant_velocity`` has rates per
        second.
        """
        m = len(self.moving)
        A = np.eye(len(self))
        A[:m, m : 2 * m] = decay * np.eye(m)
        A[m : 2 * m, m : 2 * m] = decay * np.eye(m)
        return A

    def process_noise(self, accelerations: Mapping[str, float]) -> Array:
        """Return U (n, n) of (6) from accelerations that are constant during each step.

        Constants have no noise.

        ``accelerations``: by moving element, the standard deviation of its acceleration
        [unit/step^2].

        Raises UnknownNameError: a name is not a moving element; SettingsError: a moving element's
        standard deviation is missing, negative or not finite.
        """
        m = len(self.moving)
        U = np.zeros((len(self), len(self)))
        require_known("moving element", accelerations, self.moving, "the state")
        for i, name in enumerate(self.moving):
            deviation = accelerations.get(name, -1.0)
            if not 0 <= deviation < np.inf:
                raise SettingsError(
                    f"'{name}' needs the standard deviation of its acceleration, 0 or more"
                )
            pair = [i, m + i]
            U[np.ix_(pair, pair)] = deviation**2 * np.array([[0.25, 0.5], [0.5, 1.0]])
        return U


@dataclass(frozen=True, eq=False)
class Belief:
    """A normal distribution of the state: mean (n,) and covariance (n, n)."""

    mean: Array
    covariance: Array

    @cached_property
    def root(self) -> Array:
        """(n, n) L with L L^T = covariance."""
        return factor_of(self.covariance)

    def deviations(self) -> Array:
        """Return the standard deviations (n,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def make_belief(
    mean: ArrayLike,
    covariance: ArrayLike,
    layout: StateLayout | None = None,
    subject: str = "the belief",
) -> Belief:
    """Return a belief from a mean and a covariance, after checking both.

    Args:
        mean: (n,).
        covariance: (n, n); made exactly symmetric.
        layout: the state's elements, for messages; None: elements are named by their indices.
        subject: begins messages.

    Raises SettingsError: the shapes do not fit, a number is not finite, or the covariance is not
    symmetric or is indefinite.
    """
    q = np.array(mean, dtype=np.float64)
    Q = np.array(covariance, dtype=np.float64, order="C")
    if q.ndim != 1 or Q.shape != (q.size, q.size):
        raise SettingsError(
            f"mean {q.shape} and covariance {Q.shape} do not fit; expected (n,) and (n, n)"
        )
    if layout is not None and q.size != len(layout):
        raise SettingsError(
            f"{subject} has a mean {q.shape} and a covariance {Q.shape}; the state has "
            f"{len(layout)} elements"
        )
    names = layout.names if layout else [str(k) for k in range(q.size)]
    bad = np.flatnonzero(~np.isfinite(q) | ~np.isfinite(np.diag(Q)))
    if not bad.size:
        bad = np.flatnonzero(~np.isfinite(Q).all(axis=1))
    if bad.size:
        raise SettingsError(
            f"{subject}: the mean or the covariance of '{names[bad[0]]}' is NaN or infinity"
        )
    scale = np.sqrt(np.abs(np.diag(Q)))
    if (np.abs(Q - Q.T) > 1e-6 * np.outer(scale, scale) + 1e-300).any():
        raise SettingsError(f"{subject}: the covariance is not symmetric")
    belief = Belief(q, 0.5 * (Q + Q.T))
    factor_of(belief.covariance, names, subject)
    return belief


def mix(weights: Array, beliefs: Sequence[Belief]) -> Belief:
    """Return mean and covariance of a mixture of beliefs with weights (k,) that sum to 1."""
    means = np.array([one.mean for one in beliefs])
    mean = weights @ means
    within = np.einsum("k,kij->ij", weights, np.array([one.covariance for one in beliefs]))
    return Belief(mean, within + (weights[:, None] * (means - mean)).T @ (means - mean))


Function = Callable[[Array], Array]
"""Maps x (n,) to values (m,)."""

FunctionWithJacobian = Callable[[Array], tuple[Array, Array]]
"""Maps x (n,) to values (m,) and their Jacobian (m, n)."""


class Linear(NamedTuple):
    """A linearised function: value + slope (x - at), with an error of covariance ``remainder``."""

    at: Array  # (n,) point of linearisation.
    value: Array  # (m,) value there.
    slope: Array  # (m, n) derivative, or slope over a belief.
    # (m, m) covariance of the linearisation error; None: not estimated.
    remainder: Array | None = None
    # (m, n, n) second derivatives along the columns of the belief's root; None: not estimated.
    bends: Array | None = None


def wrapped_difference(values: Array, expected: Array, is_angle: Mask) -> Array:
    """Return values - expected (..., m), wrapped to [-pi, pi) where ``is_angle`` (m,) [rad]."""
    residual = values - expected
    residual[..., is_angle] = np.remainder(residual[..., is_angle] + np.pi, 2 * np.pi) - np.pi
    return residual


def function_without_jacobian(model: object) -> Function | None:
    """Return the attribute ``function`` of a model without a Jacobian of its own; else None.

    ``model``: an ``ObservationModel`` or ``MotionModel``. Models that have ``function`` and
    ``jacobian = None``, such as ``FunctionMotion``, differentiate numerically.
    """
    function: Function | None = getattr(model, "function", None)
    return function if getattr(model, "jacobian", model) is None else None


def linearise_over(
    function: FunctionWithJacobian, belief: Belief, is_angle: Mask, values: Function | None = None
) -> Linear:
    """Return a function linearised over a belief by 2 n + 1 evaluations.

    Mean and covariance are exact for a polynomial of degree two. Values that are NaN at one of the
    points keep the tangent at the mean.

    Args:
        function: maps x (n,) to values (m,) and their Jacobian (m, n).
        belief: over which to linearise.
        is_angle: (m,) which values are angles [rad].
        values: the function without its Jacobian, if that is expensive: its values at n (n - 1) / 2
            more points then replace the Jacobians at the sigma points. None: use the Jacobians.
    """
    distance, root, n = np.sqrt(3.0), belief.root, len(belief.mean)
    tangent = np.zeros((len(is_angle), n))
    value, tangent = function(belief.mean) if values is None else (values(belief.mean), tangent)
    value = np.asarray(value, dtype=np.float64)

    def end_of(step: Array) -> tuple[Array, Array]:
        """Return the change of the values from the mean to mean + step, and the Jacobian there."""
        x = belief.mean + step
        end, slope = function(x) if values is None else (values(x), tangent)
        return wrapped_difference(np.array(end, dtype=np.float64), value, is_angle), slope

    ends = [[end_of(sign * distance * column) for column in root.T] for sign in (1.0, -1.0)]
    plus, minus = (np.array([one for one, _ in side]) for side in ends)
    # Slopes (m, n) along the root's columns, shift of the mean (m,), second derivatives (m, n, n).
    S, mean_shift = (plus - minus).T / (2.0 * distance), (plus + minus).sum(axis=0) / 6.0
    C = np.zeros((len(value), n, n))
    if values is None:
        for i, ((_, one), (_, other)) in enumerate(zip(*ends, strict=True)):
            C[:, i] = (one - other) @ root / (2.0 * distance)
        C = 0.5 * (C + C.transpose(0, 2, 1))
    else:
        # Steps that change no value, such as those of rates, need no second derivatives.
        moved = np.flatnonzero((plus != 0.0).any(axis=1) | (minus != 0.0).any(axis=1))
        for i in moved.tolist():
            C[:, i, i] = (plus[i] + minus[i]) / 3.0
            for j in moved[moved < i]:
                both, _ = end_of(distance * (root[:, i] + root[:, j]))
                C[:, i, j] = C[:, j, i] = (both - plus[i] - plus[j]) / 3.0
    deviations = belief.deviations()
    is_finite = np.isfinite(S).all(axis=1) & np.isfinite(C).all(axis=(1, 2))
    if values is not None and not (is_finite.all() and (deviations > 0.0).all()):
        tangent = function(belief.mean)[1]
    S[~is_finite], mean_shift[~is_finite], C[~is_finite] = (tangent @ root)[~is_finite], 0.0, 0.0
    # Directions without variance keep the tangent.
    scale = np.where(deviations > 0, deviations, 1.0)
    correction = np.linalg.lstsq((root / scale[:, None]).T, (S - tangent @ root).T, rcond=1e-12)[0]
    flat, slope = C.reshape(len(C), -1), tangent + correction.T / scale
    return Linear(belief.mean, value + mean_shift, slope, 0.5 * flat @ flat.T, C)


def numerical_jacobian(function: Function, x: Array, is_angle: Mask, size: float) -> Array:
    """Return the Jacobian (m, n) of a function at x (n,) by central differences.

    Args:
        function: maps x (n,) to values (m,).
        x: where to differentiate.
        is_angle: (m,) which values are angles [rad].
        size: factor on the step 6e-6 max(abs(x), 1), which is optimal for smooth functions.
    """
    columns = []
    for k, step in enumerate(size * 6e-6 * np.maximum(np.abs(x), 1.0)):
        ends = [x.copy(), x.copy()]
        ends[0][k] += step
        ends[1][k] -= step
        plus, minus = (np.array(function(end), dtype=np.float64) for end in ends)
        columns.append(wrapped_difference(plus, minus, is_angle) / (2.0 * step))
    return np.stack(columns, axis=1)


def require_jacobian(
    function: FunctionWithJacobian,
    x: Array,
    names: Sequence[str],
    elements: Sequence[str],
    is_angle: Mask,
    subject: str,
) -> None:
    """Check the shapes and the Jacobian of a function at x (n,); values that are NaN are skipped.

    Args:
        function: maps x to values (m,) and their Jacobian (m, n).
        x: (n,) where to check.
        names: (m) names of the values.
        elements: (n) names of the state's elements.
        is_angle: (m,) which values are angles [rad].
        subject: begins messages.

    Raises SettingsError: a shape is wrong, or an entry of the Jacobian differs from central
    differences; the message names the value and the element.
    """
    m, n = len(names), len(elements)
    value, slope = function(x)
    if np.shape(value) != (m,) or np.shape(slope) != (m, n):
        raise SettingsError(
            f"{subject} gives values {np.shape(value)} and a Jacobian {np.shape(slope)}; expected "
            f"({m},) and ({m}, {n}) for {m} values and {n} elements of the state"
        )
    if not m:
        return
    fine, coarse = (
        numerical_jacobian(lambda z: function(z)[0], x, is_angle, size) for size in (1.0, 4.0)
    )
    # Two step sizes bound the error of the numerical Jacobian.
    row = np.abs(fine).max(axis=1, keepdims=True)
    allowed = 1e-4 * (np.abs(slope) + np.abs(fine)) + 1e-6 * (1.0 + row) + 4 * np.abs(fine - coarse)
    known = np.isfinite(value) & np.isfinite(fine - coarse).all(axis=1)
    # The negation also catches a Jacobian that is not finite where the value is.
    wrong = known[:, None] & ~(np.abs(slope - fine) < allowed)
    if wrong.any():
        i, k = np.argwhere(wrong)[0]
        raise SettingsError(
            f"{subject}: the Jacobian of '{names[i]}' by '{elements[k]}' is {slope[i, k]:.6g}, "
            f"differences give {fine[i, k]:.6g}: correct it, or leave it to differences "
            "(FunctionObservation, FunctionMotion)"
        )
