"""Covariances as products of a factor with its transpose: they stay positive when rows cut them."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_pose.compiled import compiled
from drake_pose.errors import SettingsError

Array = NDArray[np.float64]

_NOT_FINITE, _ASYMMETRIC = 1, 2


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
    flaw = _symmetrise(q, Q)
    if flaw == _NOT_FINITE:
        raise SettingsError("the mean or the covariance holds NaN or infinity")
    if flaw == _ASYMMETRIC:
        raise SettingsError("the covariance is not symmetric")
    return q, Q


@compiled
def _symmetrise(q: Array, Q: Array) -> int:
    """Make Q (n, n) exactly symmetric, in place; says what is wrong with it, or 0."""
    for i in range(len(q)):
        if not math.isfinite(q[i]):
            return _NOT_FINITE
        for j in range(len(q)):
            if not math.isfinite(Q[i, j]):
                return _NOT_FINITE
    for i in range(len(q)):
        for j in range(i):
            scale = math.sqrt(abs(Q[i, i])) * math.sqrt(abs(Q[j, j]))
            if abs(Q[i, j] - Q[j, i]) > 1e-6 * scale + 1e-300:
                return _ASYMMETRIC
            Q[i, j] = Q[j, i] = 0.5 * (Q[i, j] + Q[j, i])
    return 0


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
    return (safe[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0)), False


def is_definite(covariance: Array) -> bool:
    """Whether Cholesky's factorisation of a symmetric matrix exists."""
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return False
    return True


@compiled
def margins_in_deviations(mean: Array, Q: Array, phi: Array, b: Array) -> tuple[Array, int]:
    """(K,) (b - phi mean) / sqrt(phi^T Q phi), infinite without variance; and what clashes.

    The second is the first row without variance that is not satisfied, or -1.
    """
    count, n = phi.shape
    c = np.full(count, np.inf)
    beyond = -1
    for k in range(count):
        margin, variance, size, reach = b[k], 0.0, 0.0, abs(b[k])
        for i in range(n):
            if phi[k, i] == 0.0:
                continue
            margin -= phi[k, i] * mean[i]
            size += abs(phi[k, i]) * math.sqrt(abs(Q[i, i]))
            reach += abs(phi[k, i] * mean[i])
            for j in range(n):
                if phi[k, j] != 0.0:
                    variance += phi[k, i] * Q[i, j] * phi[k, j]
        # What rounding makes of a variance of zero.
        if variance > 1e-30 + 1e-23 * size * size:
            c[k] = margin / math.sqrt(variance)
        elif margin < -1e-9 * reach and beyond < 0:
            beyond = k
    return c, beyond


@compiled
def is_inside(mean: Array, phi: Array, b: Array) -> bool:
    """Whether phi mean <= b, but for rounding."""
    for k in range(len(b)):
        margin, reach = b[k], abs(b[k])
        for i in range(len(mean)):
            if phi[k, i] != 0.0:
                margin -= phi[k, i] * mean[i]
                reach += abs(phi[k, i] * mean[i])
        if margin < -1e-10 * reach:
            return False
    return True


@compiled
def outer_product(A: Array) -> Array:
    """A A^T (n, n), exactly symmetric."""
    n, m = A.shape
    out = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(m):
                total += A[i, k] * A[j, k]
            out[i, j] = total
            out[j, i] = total
    return out


@compiled
def lower_or_root(P: Array) -> Array:
    """(n, n) a root of a semidefinite P: Cholesky's with zeros where nothing is left."""
    n = P.shape[0]
    L = np.zeros((n, n))
    for j in range(n):
        total = P[j, j]
        for k in range(j):
            total -= L[j, k] * L[j, k]
        if total <= 1e-14 * P[j, j]:
            continue
        L[j, j] = math.sqrt(total)
        for i in range(j + 1, n):
            value = P[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value / L[j, j]
    return L


def covariance_from(factor: Array, definite: bool = True) -> Array:
    """(n, n) L L^T, exactly symmetric.

    Args:
        factor: (n, k) L.
        definite: whether the product shall be positive definite also after rounding; then the
            variances may grow by a few units of the last place.
    """
    product = outer_product(np.ascontiguousarray(factor))
    growth = 1e-15
    while definite and growth < 1e-9 and not is_definite(product):
        product[np.diag_indices_from(product)] *= 1.0 + growth
        growth *= 10.0
    return product


@compiled
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
