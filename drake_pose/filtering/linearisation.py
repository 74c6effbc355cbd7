"""A function made linear: at one point, or over all that is believed.

A tangent says how a function runs at one point. Over a belief that is wide beside the function's
curvature it promises more than it holds: a filter of tangents becomes surer than it is right. Over
a belief the slope is that between points sqrt(3) deviations apart on either side, and what the
line leaves out, by second derivatives, counts as noise.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.errors import SettingsError
from drake_pose.filtering.state import Belief

Function = Callable[[Array], Array]
"""Of x (n,), with values (m,)."""

WithSlope = Callable[[Array], tuple[Array, Array]]
"""The same, with its Jacobian (m, n)."""


class Linear(NamedTuple):
    """value (m,) + slope (m, n) (x - at (n,)), and the covariance (m, m) of what that leaves out.

    The covariance is None where nothing is said of it.
    """

    at: Array
    value: Array
    slope: Array
    rest: Array | None = None


def difference(values: Array, expected: Array, turning: Mask) -> Array:
    """Measured minus expected, angles [rad] between -pi and pi."""
    residual = values - expected
    residual[..., turning] = np.remainder(residual[..., turning] + np.pi, 2 * np.pi) - np.pi
    return residual


def values_alone(model: object) -> Function | None:
    """The function of a model whose Jacobian is by differences; None for any other."""
    function: Function | None = getattr(model, "function", None)
    return function if getattr(model, "jacobian", model) is None else None


def linear_over(
    function: WithSlope, belief: Belief, turning: Mask, values: Function | None = None
) -> Linear:
    """A function made linear over a belief: 2 n + 1 calls.

    Exact in mean and covariance for a function of degree two. A value that is NaN at one of the
    points has the tangent at the mean.

    Args:
        turning: (m,) which values are angles [rad].
        values: the function without its Jacobian, where that costs many calls: its values at
            another n (n - 1) / 2 points are taken in the Jacobian's place.
    """
    reach, root, n = np.sqrt(3.0), belief.root, len(belief.mean)
    value, tangent = function(belief.mean)

    def end_of(step: Array) -> tuple[Array, Array]:
        """How far the values at a step are from the mean's, and the Jacobian there."""
        x = belief.mean + step
        end, slope = function(x) if values is None else (values(x), tangent)
        return difference(np.array(end, dtype=np.float64), value, turning), slope

    ends = [[end_of(sign * reach * column) for column in root.T] for sign in (1.0, -1.0)]
    far, near = (np.array([one for one, _ in side]) for side in ends)
    # (m, n) along the columns; (m,) how far the mean lies off; (m, n, n) second derivatives.
    S, mean_bend = (far - near).T / (2.0 * reach), (far + near).sum(axis=0) / 6.0
    C = np.zeros((len(value), n, n))
    for i, ((_, far_slope), (_, near_slope)) in enumerate(zip(*ends, strict=True)):
        C[:, i] = (far_slope - near_slope) @ root / (2.0 * reach)
        if values is not None:
            C[:, i, i] = (far[i] + near[i]) / 3.0
            for j in range(i):
                both, _ = end_of(reach * (root[:, i] + root[:, j]))
                C[:, i, j] = C[:, j, i] = (both - far[i] - far[j]) / 3.0
    whole = np.isfinite(S).all(axis=1) & np.isfinite(C).all(axis=(1, 2))
    S[~whole], mean_bend[~whole], C[~whole] = (tangent @ root)[~whole], 0.0, 0.0
    # Where the belief has no width the tangent stays.
    deviations = belief.deviations()
    scale = np.where(deviations > 0, deviations, 1.0)
    turn = np.linalg.lstsq((root / scale[:, None]).T, (S - tangent @ root).T, rcond=1e-12)[0]
    flat = (0.5 * (C + C.transpose(0, 2, 1))).reshape(len(C), -1)
    return Linear(belief.mean, value + mean_bend, tangent + turn.T / scale, 0.5 * flat @ flat.T)


def differences(function: Function, x: Array, turning: Mask, size: float = 1.0) -> Array:
    """(m, n) the Jacobian of a function at x by central differences.

    Args:
        size: of the steps: 1 for the best of smooth functions in double precision.
    """
    columns = []
    for k, step in enumerate(size * 6e-6 * np.maximum(np.abs(x), 1.0)):
        ends = [x.copy(), x.copy()]
        ends[0][k] += step
        ends[1][k] -= step
        far, near = (np.array(function(end), dtype=np.float64) for end in ends)
        columns.append(difference(far, near, turning) / (2.0 * step))
    return np.stack(columns, axis=1)


def require_slope(
    function: WithSlope, x: Array, names: Sequence[str], elements: Sequence[str], turning: Mask,
    what: str,
) -> None:  # fmt: skip
    """Refuse a function whose shapes or Jacobian are wrong at x (n,); NaN is left out.

    Args:
        names: (m) of its values; elements: (n) of the state.
        what: it is, for messages.

    Raises:
        SettingsError: it names the value and the element.
    """
    m, n = len(names), len(elements)
    value, slope = function(x)
    if np.shape(value) != (m,) or np.shape(slope) != (m, n):
        raise SettingsError(
            f"{what} gives values {np.shape(value)} and a Jacobian {np.shape(slope)}; of {m} "
            f"values and {n} elements of the state they are ({m},) and ({m}, {n})"
        )
    if not m:
        return
    fine, coarse = (differences(lambda z: function(z)[0], x, turning, size) for size in (1.0, 4.0))
    # Steps of two sizes tell how much the differences themselves err.
    row = np.abs(fine).max(axis=1, keepdims=True)
    allowed = 1e-4 * (np.abs(slope) + np.abs(fine)) + 1e-6 * (1.0 + row) + 4 * np.abs(fine - coarse)
    measured = np.isfinite(value)[:, None] & np.isfinite(allowed)
    # A Jacobian that is NaN beside a finite value is as wrong as a number that is off.
    wrong = measured & ~(np.abs(slope - fine) <= allowed)
    if wrong.any():
        i, k = np.argwhere(wrong)[0]
        raise SettingsError(
            f"{what}: the Jacobian of '{names[i]}' by '{elements[k]}' is {slope[i, k]:.6g}, "
            f"differences give {fine[i, k]:.6g}: mend it, or leave it to differences "
            "(FunctionObservation, FunctionMotion)"
        )
