"""Covariances as products of a factor with its transpose: they stay positive when rows cut them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_pose.errors import SettingsError

Array = NDArray[np.float64]


def check_moments(mean: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """A mean (n,) and covariance (n, n) as arrays, the covariance made exactly symmetric.

    Raises:
        SettingsError: sizes that do not fit, NaN, infinity, asymmetry, or a negative variance.
    """
    q = np.array(mean, dtype=np.float64)
    Q = np.array(covariance, dtype=np.float64, order="C")
    if q.ndim != 1 or Q.shape != (q.size, q.size):
        raise SettingsError(
            f"mean {q.shape} and covariance {Q.shape} do not fit: give (n,) and (n, n)"
        )
    if not (np.isfinite(q).all() and np.isfinite(Q).all()):
        raise SettingsError("the mean or the covariance holds NaN or infinity")
    scale = np.sqrt(np.abs(np.diag(Q)))
    if (np.abs(Q - Q.T) > 1e-6 * np.outer(scale, scale) + 1e-300).any():
        raise SettingsError("the covariance is not symmetric")
    return q, 0.5 * (Q + Q.T)


def factor_of(covariance: Array) -> Array:
    """(n, n) L with L L^T = covariance; variances of zero are allowed.

    Raises:
        SettingsError: the covariance is indefinite: it has a clearly negative variance.
    """
    return factor_and_kind(covariance)[0]


def factor_and_kind(covariance: Array) -> tuple[Array, bool]:
    """``factor_of``, and whether the covariance is positive definite.

    Raises:
        SettingsError: the covariance is indefinite.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64), True
    except np.linalg.LinAlgError:
        pass
    # Semidefinite: scaled to correlations, so that small variances are not lost beside large ones.
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    if values[0] < -1e-8 or (np.diag(covariance) < 0).any():
        raise SettingsError(
            "the covariance is indefinite: a combination of elements has a negative variance "
            f"(lowest eigenvalue of the correlations {values[0]:.3g})"
        )
    root = (safe[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0))
    return np.ascontiguousarray(root), False


def covariance_from(factor: Array, definite: bool = True) -> Array:
    """(n, n) L L^T, exactly symmetric.

    Args:
        factor: (n, k) L.
        definite: whether the product shall be positive definite also after rounding; then the
            variances may grow by a few units of the last place.
    """
    product = factor @ factor.T
    product = 0.5 * (product + product.T)
    growth = 1e-15
    while definite and growth < 1e-9 and not factor_exists(product):
        product[np.diag_indices_from(product)] *= 1.0 + growth
        growth *= 10.0
    return product


def factor_exists(covariance: Array) -> bool:
    """Whether Cholesky's factorisation of a symmetric matrix exists."""
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return False
    return True
