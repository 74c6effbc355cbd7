"""Motion models of a filter: x' = f(x) + w with w ~ N(0, U), linear or not.

Equation numbers in this subpackage are those of Shimada, Shirai, Kuno and Miura; (6) is the
prediction of the state.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import expm
from scipy.special import ndtr

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError
from drake_pose.filtering.inequalities import Inequalities
from drake_pose.filtering.state import (
    Belief,
    Function,
    Linear,
    StateLayout,
    function_without_jacobian,
    linearise_over,
    numerical_jacobian,
)


class MotionModel(Protocol):
    """The motion of a state over one step, as a filter needs it: (6)."""

    @property
    def noise(self) -> Array:
        """(n, n) process noise covariance U of one step."""

    @property
    def period(self) -> float | None:
        """Duration of a step [s]; None: rates are per step, whatever its duration."""

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return the state (n,) one step after x, and the Jacobian (n, n) of the step."""


@dataclass(frozen=True, eq=False)
class LinearMotion:
    """A linear ``MotionModel`` x -> transition x.

    ``transition``: (n, n) state transition matrix A. ``noise``, ``period``: see ``MotionModel``.
    """

    transition: Array
    noise: Array
    period: float | None

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return ``transition @ x`` (n,) and the transition (n, n)."""
        return self.transition @ x, self.transition


@dataclass(frozen=True, eq=False)
class FunctionMotion:
    """A ``MotionModel`` from any function of the state, for example a plant's dynamics.

    ``function``: maps the state x (n,) to the state (n,) one step later. ``noise``, ``period``: see
    ``MotionModel``. ``jacobian``: maps x (n,) to the function's Jacobian (n, n); None: central
    differences.
    """

    function: Function
    noise: Array
    period: float | None
    jacobian: Function | None = None

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return the function's value (n,) at x and its Jacobian (n, n)."""
        value = np.asarray(self.function(x), dtype=np.float64)
        if self.jacobian is not None:
            return value, np.asarray(self.jacobian(x), dtype=np.float64)
        no_angles = np.zeros(value.shape, dtype=np.bool_)
        return value, numerical_jacobian(self.function, x, no_angles, 1.0)


def constant_velocity(
    layout: StateLayout, rate_changes: Mapping[str, float], period: float, memory: float = math.inf
) -> LinearMotion:
    """Return a constant-velocity model whose rates are driven by white noise.

    Each rate v obeys dv = -v / memory dt + noise. The discretisation is exact (Van Loan), so the
    prediction over a given time does not depend on the period.

    Args:
        layout: the elements of the state; constants do not change.
        rate_changes: by moving element, the standard deviation of the change of its rate in one
            second without decay [unit/s]. It grows with the square root of time: over 16 s it is 4
            times as large.
        period: duration of a step [s].
        memory: time constant of the rates' exponential decay [s]; infinite: no decay.

    Raises:
        UnknownNameError: a name in ``rate_changes`` is not a moving element.
        SettingsError: the period or the memory is not positive, or a moving element's standard
            deviation is missing, negative or not finite.
    """
    if not (0.0 < period < math.inf and memory > 0.0):
        raise SettingsError(f"period {period} and memory {memory} of a motion must be positive")
    deviations = np.sqrt(np.diag(layout.process_noise(rate_changes)))
    # Van Loan's discretisation of dv = -v / memory dt + noise.
    F, Q = np.array([[0.0, 1.0], [0.0, -1.0 / memory]]), np.diag([0.0, 1.0])
    power = expm(period * np.block([[-F, Q], [np.zeros((2, 2)), F.T]]))
    step = power[2:, 2:].T
    noise = step @ power[:2, 2:]
    m, A, U = len(layout.moving), np.eye(len(layout)), np.zeros((len(layout), len(layout)))
    for i in range(m):
        pair = np.ix_([i, m + i], [i, m + i])
        A[pair], U[pair] = step, deviations[m + i] ** 2 * noise
    return LinearMotion(A, 0.5 * (U + U.T), period)


def require_models(layout: StateLayout, observation: object, motion: object) -> None:
    """Check that an observation and a motion are models whose sizes fit a state layout.

    Raises SettingsError: a model lacks an attribute of its protocol, or an array has the wrong
    shape or is not finite.
    """
    n = len(layout)
    needed = {
        "observation": (observation, ("names", "variances", "wraps", "predict", "mirrors")),
        "motion": (motion, ("noise", "period", "predict")),
    }
    for name, (model, parts) in needed.items():
        missing = [part for part in parts if not hasattr(model, part)]
        if missing:
            raise SettingsError(
                f"a filter's {name} model needs {', '.join(parts)}; "
                f"{type(model).__name__} has no {', '.join(missing)}"
            )
    m = len(observation.names)  # type: ignore[attr-defined]
    sizes = {
        "the observation's variances": (observation.variances, (m,)),  # type: ignore[attr-defined]
        "the observation's wraps": (observation.wraps, (m,)),  # type: ignore[attr-defined]
        "the motion's noise": (motion.noise, (n, n)),  # type: ignore[attr-defined]
    }
    if isinstance(motion, LinearMotion):
        sizes["the motion's transition"] = (motion.transition, (n, n))
    for name, (array, size) in sizes.items():
        if np.shape(array) != size or not np.isfinite(array).all():
            raise SettingsError(
                f"{name}: expected {size} finite numbers, got shape {np.shape(array)}; the state "
                f"has {n} elements and the observation {m} measurements"
            )


def step_from(motion: MotionModel, belief: Belief, over_belief: bool) -> Linear:
    """Return a step linearised at a belief's mean, or over the belief (``linearise_over``).

    A ``LinearMotion`` is returned as it is.
    """
    if isinstance(motion, LinearMotion):
        nothing = np.zeros(len(belief.mean))
        return Linear(nothing, nothing, motion.transition)
    if over_belief:
        no_angles = np.zeros(len(belief.mean), dtype=np.bool_)
        return linearise_over(motion.predict, belief, no_angles, function_without_jacobian(motion))
    return Linear(belief.mean, *motion.predict(belief.mean))


def stopped_rates(belief: Belief, limits: Inequalities, moving: int) -> Array:
    """Return the (n, n) covariance of rates that limits may have stopped or reversed.

    What moves beyond a limit in a predicted belief has been stopped by it. How is not known, so
    that all of the rate is in doubt, with the probability of this.

    ``moving``: number of moving elements, whose rates follow them in the state.
    """
    P, margins = belief.covariance, limits.margins(belief.mean)
    across = np.zeros_like(limits.phi)
    across[:, moving : 2 * moving] = limits.phi[:, :moving]
    of_place, of_rate = (np.einsum("ki,ij,kj->k", one, P, one) for one in (limits.phi, across))
    deviation = np.sqrt(np.maximum(of_place, np.finfo(np.float64).tiny))
    size = np.maximum((across**2).sum(axis=1), np.finfo(np.float64).eps)
    weight = ndtr(-margins / deviation) * ((across @ belief.mean) ** 2 + of_rate) / size**2
    return np.asarray((weight[:, None] * across).T @ across)
