"""Small symmetric matrices without a library's threads, which cost more than they save here."""

import math

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled
from drake_pose.filtering.factors import lower_or_root, outer_product

Array = NDArray[np.float64]


@compiled
def lower_factor(S: Array) -> tuple[Array, bool]:
    """Cholesky's L (m, m) of S = L L^T, and whether S is positive definite."""
    m = S.shape[0]
    L = np.zeros((m, m))
    for i in range(m):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return L, False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return L, True


@compiled
def fuse(P: Array, H: Array, noise: Array, innovation: Array) -> tuple[Array, float, float, bool]:
    """A linear measurement of a normal distribution.

    Args:
        P: (n, n) covariance.
        H: (m, n) what is measured.
        noise: (m,) its variances.
        innovation: (m,) measured minus expected.

    Returns:
        The dual step H^T S^-1 innovation (n,), P times which is the mean's step;
        innovation^T S^-1 innovation; log det S; and whether S = H P H^T + R is positive definite.
    """
    n, m = P.shape[0], H.shape[0]
    S = H @ P @ H.T
    for k in range(m):
        S[k, k] += noise[k]
    L, definite = lower_factor(S)
    dual = np.zeros(n)
    if not definite:
        return dual, 0.0, 0.0, False
    z = innovation.copy()
    log_determinant, distance = 0.0, 0.0
    for k in range(m):
        for j in range(k):
            z[k] -= L[k, j] * z[j]
        z[k] /= L[k, k]
        distance += z[k] * z[k]
        log_determinant += 2.0 * math.log(L[k, k])
    for k in range(m - 1, -1, -1):
        for j in range(k + 1, m):
            z[k] -= L[j, k] * z[j]
        z[k] /= L[k, k]
        for i in range(n):
            dual[i] += H[k, i] * z[k]
    return dual, distance, log_determinant, True


@compiled
def joseph(P: Array, H: Array, noise: Array) -> tuple[Array, bool]:
    """(n, n) (I - K H) P (I - K H)^T + K R K^T: positive also where rounding is not kind."""
    n, m = P.shape[0], H.shape[0]
    HP = H @ P
    S = HP @ H.T
    for k in range(m):
        S[k, k] += noise[k]
    L, definite = lower_factor(S)
    if not definite:
        return P.copy(), False
    gain = HP
    for k in range(m):
        for j in range(k):
            for i in range(n):
                gain[k, i] -= L[k, j] * gain[j, i]
        for i in range(n):
            gain[k, i] /= L[k, k]
    for k in range(m - 1, -1, -1):
        for j in range(k + 1, m):
            for i in range(n):
                gain[k, i] -= L[j, k] * gain[j, i]
        for i in range(n):
            gain[k, i] /= L[k, k]
    rest = np.eye(n) - gain.T @ H
    return outer_product(rest @ lower_or_root(P)) + outer_product(gain.T * np.sqrt(noise)), True
