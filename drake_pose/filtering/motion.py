"""How a state moves from one step to the next: (6), linear or not."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import expm

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError
from drake_pose.filtering.linearisation import (
    Function,
    Linear,
    differences,
    linear_over,
    values_alone,
)
from drake_pose.filtering.state import Belief, StateLayout


class MotionModel(Protocol):
    """What a filter must know about a step: (6)."""

    @property
    def noise(self) -> Array:
        """(n, n) U, the covariance of what a step adds."""

    @property
    def period(self) -> float | None:
        """The time that a step takes [s]; None: rates are per step, whatever time it takes."""

    def predict(self, x: Array) -> tuple[Array, Array]:
        """The state (n,) a step after x, and its Jacobian (n, n)."""


@dataclass(frozen=True, eq=False)
class LinearMotion:
    """The ``MotionModel`` x -> transition x: (n, n); noise and period as of the protocol."""

    transition: Array
    noise: Array
    period: float | None

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Its value (n,) and the transition."""
        return self.transition @ x, self.transition


@dataclass(frozen=True, eq=False)
class FunctionMotion:
    """The ``MotionModel`` of any function of the state, for example a plant's dynamics.

    Args:
        function: x (n,) to the state (n,) a period later.
        noise: (n, n) the covariance of what a step adds.
        period: the time that a step takes [s].
        jacobian: x (n,) to (n, n); None: by differences.
    """

    function: Function
    noise: Array
    period: float | None
    jacobian: Function | None = None

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Its value (n,) and Jacobian (n, n)."""
        value = np.asarray(self.function(x), dtype=np.float64)
        if self.jacobian is not None:
            return value, np.asarray(self.jacobian(x), dtype=np.float64)
        return value, differences(self.function, x, np.zeros(value.shape, dtype=np.bool_))


def constant_velocity(
    layout: StateLayout,
    rate_changes: Mapping[str, float],
    period: float,
    memory: float = math.inf,
) -> LinearMotion:
    """Rates that wander, per second: what is predicted for a time does not depend on the period.

    Args:
        rate_changes: for each moving element the standard deviation of what its rate changes by in
            a second, if nothing fades [unit/s]; four times as much in sixteen seconds.
        period: the time that a step takes [s].
        memory: rates fade to 1 / e of themselves in this time [s].

    Raises:
        UnknownNameError: a name does not move.
        SettingsError: a period or memory that is not positive; an element is missing, or its
            deviation is negative or not finite.
    """
    if not (0.0 < period < math.inf and memory > 0.0):
        raise SettingsError(f"period {period} and memory {memory} of a motion must be positive")
    deviations = np.sqrt(np.diag(layout.process_noise(rate_changes)))
    # The exact step of d rate = -rate / memory dt + noise (Van Loan).
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
    """Refuse (SettingsError) models of a filter that are none, or whose sizes do not fit."""
    n = len(layout)
    needed = {
        "observation": (observation, ("names", "variances", "wraps", "predict", "mirrors")),
        "motion": (motion, ("noise", "period", "predict")),
    }
    for name, (model, parts) in needed.items():
        missing = [part for part in parts if not hasattr(model, part)]
        if missing:
            raise SettingsError(
                f"a filter's {name} is a model with {', '.join(parts)}; "
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
                f"{name}: {size} finite numbers, not an array of {np.shape(array)}; the state has "
                f"{n} elements, and {m} numbers are measured"
            )


def step_from(motion: MotionModel, belief: Belief, spread: bool) -> Linear:
    """A step made linear: at a belief's mean, or over the belief."""
    if isinstance(motion, LinearMotion):
        nothing = np.zeros(len(belief.mean))
        return Linear(nothing, nothing, motion.transition)
    if spread:
        still = np.zeros(len(belief.mean), dtype=np.bool_)
        return linear_over(motion.predict, belief, still, values_alone(motion))
    return Linear(belief.mean, *motion.predict(belief.mean))
