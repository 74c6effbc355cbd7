"""Covariances as products of a factor with its transpose: they stay positive when rows cut them."""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from drake_pose.errors import SettingsError

Array = NDArray[np.float64]


def check_moments(mean: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
    """A mean (n,) and covariance (n, n) as arrays, the covariance made exactly symmetric.

    Raises:
        SettingsError: sizes that do not fit, NaN, infinity, asymmetry, or a negative variance.
    """
    q = np.array(mean, dtype=np.float64)
    Q = np.array(covariance, dtype=np.float64)
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
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
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
    return (safe[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0))


def is_definite(covariance: Array) -> bool:
    """Whether Cholesky's factorisation of a symmetric matrix exists."""
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return False
    return True


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
    while definite and growth < 1e-9 and not is_definite(product):
        product[np.diag_indices_from(product)] *= 1.0 + growth
        growth *= 10.0
    return product


@njit(cache=True, nogil=True, error_model="numpy")
def apply_site(mean: Array, factor: Array, direction: Array, tau: float, nu: float) -> float:
    """Multiply a belief by exp(-tau s^2 / 2 + nu s), s = direction^T x, in place.

    Args:
        mean: (n,) changed in place.
        factor: (n, k) L of the covariance L L^T, changed in place.
        direction: (n,).
        tau: precision; 1 + tau var(s) must be positive.
        nu: precision times value.

    Returns:
        The logarithm of the product's integral.
    """
    n, k = factor.shape
    projected = np.zeros(k)
    for i in range(n):
        if direction[i] != 0.0:
            for j in range(k):
                projected[j] += direction[i] * factor[i, j]
    variance, value = 0.0, 0.0
    for j in range(k):
        variance += projected[j] * projected[j]
    for i in range(n):
        value += direction[i] * mean[i]
    denominator = 1.0 + tau * variance
    exponent = 0.5 * (2.0 * value * nu + variance * nu * nu - tau * value * value) / denominator
    if variance > 0.0 and (tau != 0.0 or nu != 0.0):
        shift = (nu - tau * value) / denominator
        shrink = (1.0 - 1.0 / math.sqrt(denominator)) / variance
        for i in range(n):
            gain = 0.0
            for j in range(k):
                gain += factor[i, j] * projected[j]
            mean[i] += gain * shift
            for j in range(k):
                factor[i, j] -= shrink * gain * projected[j]
    return exponent - 0.5 * math.log(denominator)
