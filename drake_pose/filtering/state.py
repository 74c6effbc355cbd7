"""What a state vector means, how it moves, and what is believed of it: (5), (6) and (8).

Shimada, Shirai, Kuno and Miura; A of (8) is a step at constant velocity, U of (6) its noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError, UnknownNameError


def factor_of(covariance: Array, names: Sequence[str] = (), what: str = "the belief") -> Array:
    """(n, n) L with L L^T = covariance; variances of zero are allowed.

    Raises:
        SettingsError: the covariance is indefinite; it says what has it, and which element it is.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        pass
    # Semidefinite: scaled to correlations, so that small variances are not lost beside large ones.
    scale = np.sqrt(np.abs(np.diag(covariance)))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if values[0] < -1e-8:
        k = int(np.argmax(np.abs(vectors[:, 0])))
        raise SettingsError(
            f"{what}: the covariance is indefinite; the lowest eigenvalue of its correlations is "
            f"{values[0]:.3g}, and '{names[k] if names else k}' has the largest part in it"
        )
    root = (scale[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0))
    return np.ascontiguousarray(root)


def covariance_from(factor: Array) -> Array:
    """(n, n) L L^T of (n, k) L: symmetric, and positive definite after rounding if it can be."""
    product = factor @ factor.T
    product = 0.5 * (product + product.T)
    growth = 1e-15
    while growth < 1e-9:
        try:
            np.linalg.cholesky(product)
            break
        except np.linalg.LinAlgError:
            product[np.diag_indices_from(product)] *= 1.0 + growth
            growth *= 10.0
    return product


@dataclass(frozen=True)
class StateLayout:
    """The elements of a state: what moves, its rates, and what never changes.

    Args:
        moving: (m) names of what moves at constant velocity but for noise.
        constant: (k) names of what never changes, for example lengths.

    Raises:
        SettingsError: a name is given twice.
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
        """Where an element stands.

        Raises:
            UnknownNameError: there is none of that name.
        """
        if name not in self.names:
            raise UnknownNameError("element", name, self.names, "the state")
        return self.names.index(name)

    def indices(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Where these elements stand."""
        return np.array([self.index(name) for name in names], dtype=np.intp)

    def transition(self, fading: float = 1.0) -> Array:
        """(n, n) A of (8): a step at constant velocity, rates per step; see ``constant_velocity``.

        ``fading`` is left of a rate, 1 in (8).
        """
        m = len(self.moving)
        A = np.eye(len(self))
        A[:m, m : 2 * m] = fading * np.eye(m)
        A[m : 2 * m, m : 2 * m] = fading * np.eye(m)
        return A

    def process_noise(self, accelerations: Mapping[str, float]) -> Array:
        """(n, n) U of (6): an acceleration that is constant during each step; 0 for constants.

        Args:
            accelerations: standard deviation for each moving element [unit per step^2].

        Raises:
            UnknownNameError: a name does not move.
            SettingsError: an element is missing, or its deviation is negative or not finite.
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
                    f"'{name}' needs the standard deviation of what changes its rate, 0 or more"
                )
            pair = [i, m + i]
            U[np.ix_(pair, pair)] = deviation**2 * np.array([[0.25, 0.5], [0.5, 1.0]])
        return U


@dataclass(frozen=True, eq=False)
class Belief:
    """A normal distribution over a state: mean (n,) and covariance (n, n)."""

    mean: Array
    covariance: Array

    @cached_property
    def root(self) -> Array:
        """(n, n) L with L L^T = covariance."""
        return factor_of(self.covariance)

    def deviations(self) -> Array:
        """(n,) standard deviations."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def make_belief(
    mean: ArrayLike,
    covariance: ArrayLike,
    layout: StateLayout | None = None,
    what: str = "the belief",
) -> Belief:
    """A belief from a mean (n,) and covariance (n, n), checked, and made exactly symmetric.

    Raises:
        SettingsError: sizes that do not fit, NaN, infinity, asymmetry, or a covariance that is
            indefinite; where the layout is given, it names the element.
    """
    q = np.array(mean, dtype=np.float64)
    Q = np.array(covariance, dtype=np.float64, order="C")
    if q.ndim != 1 or Q.shape != (q.size, q.size):
        raise SettingsError(
            f"mean {q.shape} and covariance {Q.shape} do not fit: give (n,) and (n, n)"
        )
    if layout is not None and q.size != len(layout):
        raise SettingsError(
            f"{what} has a mean {q.shape} and a covariance {Q.shape}; the state has "
            f"{len(layout)} elements"
        )
    names = layout.names if layout else [str(k) for k in range(q.size)]
    bad = np.flatnonzero(~np.isfinite(q) | ~np.isfinite(np.diag(Q)))
    if not bad.size:
        bad = np.flatnonzero(~np.isfinite(Q).all(axis=1))
    if bad.size:
        raise SettingsError(
            f"{what}: the mean or the covariance of '{names[bad[0]]}' is NaN or infinity"
        )
    scale = np.sqrt(np.abs(np.diag(Q)))
    if (np.abs(Q - Q.T) > 1e-6 * np.outer(scale, scale) + 1e-300).any():
        raise SettingsError(f"{what}: the covariance is not symmetric")
    belief = Belief(q, 0.5 * (Q + Q.T))
    factor_of(belief.covariance, names, what)
    return belief
