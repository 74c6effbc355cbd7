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


def linear_over(function: WithSlope, belief: Belief, turning: Mask) -> Linear:
    """A function made linear over a belief: 2 n + 1 calls.

    Exact in mean and covariance for a function of degree two. A value that is NaN at one of the
    points has the tangent at the mean.

    Args:
        turning: (m,) which values are angles [rad].
    """
    reach = np.sqrt(3.0)
    value, tangent = function(belief.mean)
    root = belief.root
    spread, bend, curvature = [], [], []
    for column in root.T:
        (far, far_slope), (near, near_slope) = (
            function(belief.mean + sign * reach * column) for sign in (1.0, -1.0)
        )
        sides = [difference(np.array(end), value, turning) for end in (far, near)]
        spread.append((sides[0] - sides[1]) / (2.0 * reach))
        bend.append((sides[0] + sides[1]) / 6.0)
        curvature.append((far_slope - near_slope) @ root / (2.0 * reach))
    # (m, n) along the columns; (m,) how far the mean lies off; (m, n, n) second derivatives.
    S, mean_bend, C = np.array(spread).T, np.sum(bend, axis=0), np.stack(curvature, axis=1)
    whole = np.isfinite(S).all(axis=1) & np.isfinite(C).all(axis=(1, 2))
    S[~whole], mean_bend[~whole], C[~whole] = (tangent @ root)[~whole], 0.0, 0.0
    # Where the belief has no width the tangent stays.
    deviations = belief.deviations()
    scale = np.where(deviations > 0, deviations, 1.0)
    off = np.linalg.lstsq((root / scale[:, None]).T, (S - tangent @ root).T, rcond=1e-12)[0]
    flat = (0.5 * (C + C.transpose(0, 2, 1))).reshape(len(C), -1)
    return Linear(belief.mean, value + mean_bend, tangent + off.T / scale, 0.5 * flat @ flat.T)


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
