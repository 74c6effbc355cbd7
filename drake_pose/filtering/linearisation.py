"""Linearisation of a function at a point, or over a belief.

A tangent describes a function at one point. Where a belief is wide compared with the function's
curvature, a filter of tangents becomes overconfident. ``linearise_over`` takes the slope between
points sqrt(3) standard deviations apart on either side of the mean, and returns the covariance of
the second-order remainder, which counts as noise.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.errors import SettingsError
from drake_pose.filtering.state import Belief

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
    value, tangent = function(belief.mean)

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
    for i, ((_, plus_slope), (_, minus_slope)) in enumerate(zip(*ends, strict=True)):
        C[:, i] = (plus_slope - minus_slope) @ root / (2.0 * distance)
        if values is not None:
            C[:, i, i] = (plus[i] + minus[i]) / 3.0
            for j in range(i):
                both, _ = end_of(distance * (root[:, i] + root[:, j]))
                C[:, i, j] = C[:, j, i] = (both - plus[i] - plus[j]) / 3.0
    is_finite = np.isfinite(S).all(axis=1) & np.isfinite(C).all(axis=(1, 2))
    S[~is_finite], mean_shift[~is_finite], C[~is_finite] = (tangent @ root)[~is_finite], 0.0, 0.0
    # Directions without variance keep the tangent.
    deviations = belief.deviations()
    scale = np.where(deviations > 0, deviations, 1.0)
    correction = np.linalg.lstsq((root / scale[:, None]).T, (S - tangent @ root).T, rcond=1e-12)[0]
    flat = (0.5 * (C + C.transpose(0, 2, 1))).reshape(len(C), -1)
    return Linear(
        belief.mean, value + mean_shift, tangent + correction.T / scale, 0.5 * flat @ flat.T
    )


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
    measured = np.isfinite(value)[:, None] & np.isfinite(allowed)
    # The negation also catches a Jacobian that is NaN where the value is finite.
    wrong = measured & ~(np.abs(slope - fine) <= allowed)
    if wrong.any():
        i, k = np.argwhere(wrong)[0]
        raise SettingsError(
            f"{subject}: the Jacobian of '{names[i]}' by '{elements[k]}' is {slope[i, k]:.6g}, "
            f"differences give {fine[i, k]:.6g}: correct it, or leave it to differences "
            "(FunctionObservation, FunctionMotion)"
        )
