"""The layout of a filter's state, its linear motion and process noise, and beliefs about it.

A state is (moving elements, their rates, constants). Equation numbers are those of Shimada, Shirai,
Kuno and Miura.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError, UnknownNameError


def factor_of(covariance: Array, names: Sequence[str] = (), subject: str = "the belief") -> Array:
    """Return L (n, n) with L L^T = covariance; the covariance may be singular.

    Args:
        covariance: (n, n), symmetric and positive semidefinite.
        names: (n) names of the elements, for messages; their indices if empty.
        subject: begins messages.

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

    The diagonal is inflated by up to about 1e-9, relative, until a Cholesky factorisation succeeds.
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

    Args:
        moving: (m) names of the elements that have a rate.
        constant: (k) names of the elements that do not change, for example lengths.

    Raises:
        SettingsError: a name occurs twice.
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

        Args:
            decay: factor on the rates in a step; 1 in (8). ``constant_velocity`` has rates per
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

        Args:
            accelerations: by moving element, the standard deviation of its acceleration
                [unit/step^2].

        Raises:
            UnknownNameError: a name is not a moving element.
            SettingsError: a moving element's standard deviation is missing, negative or not finite.
        """
        m = len(self.moving)
        U = np.zeros((len(self), len(self)))
        for name in accelerations:
            if name not in self.moving:
                raise UnknownNameError("moving element", name, self.moving, "the state")
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
