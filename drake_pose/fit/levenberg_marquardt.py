"""Levenberg and Marquardt's method inside limits, for frames that share some of their unknowns.

(H + d diag(H) + e mean(diag(H)) I) x = -g; unknowns at a limit that x would leave are held.

The scale of the cost shrinks from round to round, so first everything within reach pulls and in the
end only what fits (graduated non-convexity, Blake and Zisserman 1987). Frames couple through what
they share: each frame's own unknowns are eliminated first (Schur complement). Those of frames that
follow one another may also couple by a motion, which is linear in them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from drake_pose.compiled import compiled
from drake_pose.errors import SettingsError

Array = NDArray[np.float64]

_LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e2
# A scale begins with no more than this.
_NEXT_DAMPING = 0.1
# Steps that gain a smaller share of the cost end a round.
_STANDSTILL = 1e-3


@dataclass(frozen=True)
class AnnealingStage:
    """A part of a fit at one scale; lengths in m, or in the unit that the fit is told.

    Args:
        scale: the distance at which a point of a contour loses three quarters of its pull.
        spacing: of the points of the body's contour.
        iterations: at most so many steps; with one it is taken untried.
    """

    scale: float
    spacing: float
    iterations: int = 1

    def __post_init__(self) -> None:
        for name in ("scale", "spacing"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"{name} must be positive, not {getattr(self, name)}")
        if self.iterations < 1:
            raise SettingsError(f"iterations must be 1 or more, not {self.iterations}")


@dataclass(frozen=True)
class StepSettings:
    """How steps are made.

    Args:
        longest: no unknown changes by more in a step [rad, m or a logarithm].
        damping: a share of the diagonal, added to it, at first.
        even_damping: a share of the mean of the diagonal, which keeps what does not show where it
            is.
    """

    longest: float = 0.35
    damping: float = 1e-3
    even_damping: float = 1e-4


@dataclass(frozen=True, eq=False)
class Equations:
    """The normal equations H dx = -g of frames at some values.

    Attributes:
        H: (frames, u, u) with each frame's own unknowns first, then the shared ones.
        g: (frames, u).
        cost: what the steps shall lessen.
    """

    H: Array
    g: Array
    cost: float


@dataclass(frozen=True, eq=False)
class Coupling:
    """Linear combinations of all frames' own unknowns x (frames p,), and what is known of them.

    Attributes:
        rows: (k, frames p).
        mean: (k,) of what they amount to.
        information: (k,) one over the variance.
    """

    rows: csr_array
    mean: Array
    information: Array

    def slope_and_cost(self, own: Array) -> tuple[Array, float]:
        """(frames, p) half the slope at own unknowns (frames, p), and the cost."""
        off = self.rows @ own.ravel() - self.mean
        slope = self.rows.T @ (self.information * off)
        return slope.reshape(own.shape), float(self.information @ off**2)

    def curvature(self) -> csc_array:
        """(frames p, frames p)."""
        return csc_array(self.rows.T @ diags_array(self.information) @ self.rows)


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a minimisation ended.

    Attributes:
        own: (frames, p) each frame's own unknowns.
        shared: (q,) those of all frames.
        cost: at the last evaluation: before the last step, if that was taken untried.
        evaluations: how often the equations were asked for.
    """

    own: Array
    shared: Array
    cost: float
    evaluations: int


def minimise(
    evaluate: Callable[[Array, Array, AnnealingStage], Equations],
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    rounds: Sequence[AnnealingStage],
    settings: StepSettings | None = None,
    coupling: Coupling | None = None,
) -> Minimum:
    """The unknowns with the least cost near where they start, inside their limits.

    Args:
        evaluate: the equations at own (frames, p) and shared (q,) unknowns; what a coupling says is
            added to them.
        own, shared: to start from.
        limits: lower and upper (p + q,), own unknowns first.
        rounds: one after another.
        settings: how steps are made.
        coupling: what is known of the own unknowns of several frames together.
    """
    settings = settings or StepSettings()
    if coupling is not None:
        evaluate = _coupled(evaluate, coupling)
    curvature = None if coupling is None else coupling.curvature()
    lower, upper = limits
    p = own.shape[1]
    own, shared = np.clip(own, lower[:p], upper[:p]), np.clip(shared, lower[p:], upper[p:])
    damping, evaluations, cost = settings.damping, 0, np.inf
    for part in rounds:
        equations = evaluate(own, shared, part)
        evaluations, cost = evaluations + 1, equations.cost
        for _ in range(part.iterations):
            trial = _stepped(equations, own, shared, limits, damping, settings, curvature)
            if part.iterations == 1:
                own, shared = trial
                break
            tried = evaluate(*trial, part)
            evaluations += 1
            if tried.cost < cost:
                gain = 1.0 - tried.cost / cost
                (own, shared), equations, cost = trial, tried, tried.cost
                damping = max(0.2 * damping, _LEAST_DAMPING)
                if gain < _STANDSTILL:
                    break
            else:
                damping *= 10.0
                if damping > _MOST_DAMPING:
                    break
        damping = min(damping, _NEXT_DAMPING)
    return Minimum(own, shared, float(cost), evaluations)


def _coupled(
    evaluate: Callable[[Array, Array, AnnealingStage], Equations], coupling: Coupling
) -> Callable[[Array, Array, AnnealingStage], Equations]:
    """The same equations with a coupling's slope and cost; its curvature is no frame's own."""

    def evaluate_coupled(own: Array, shared: Array, step: AnnealingStage) -> Equations:
        found = evaluate(own, shared, step)
        slope, cost = coupling.slope_and_cost(own)
        g = found.g.copy()
        g[:, : own.shape[1]] += slope
        return Equations(found.H, g, found.cost + cost)

    return evaluate_coupled


def _stepped(
    equations: Equations,
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    damping: float,
    settings: StepSettings,
    curvature: csc_array | None,
) -> tuple[Array, Array]:
    """Own and shared unknowns after a damped step that stays inside the limits."""
    lower, upper = limits
    p = own.shape[1]
    shares = damping, settings.even_damping
    if curvature is None:
        steps, change = _solved(equations.H, equations.g, own, shared, lower, upper, shares)
    else:
        steps, change = _solved_together(equations, own, shared, limits, shares, curvature)
    # Shared unknowns are held back with the frames that they move.
    longest = max(float(np.abs(steps).max(initial=0.0)), float(np.abs(change).max(initial=0.0)))
    share = min(1.0, settings.longest / max(longest, 1e-300))
    return (
        np.clip(own + share * steps, lower[:p], upper[:p]),
        np.clip(shared + share * change, lower[p:], upper[p:]),
    )


def _solved_together(
    equations: Equations,
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    shares: tuple[float, float],
    curvature: csc_array,
) -> tuple[Array, Array]:
    """As _solved, of frames whose own unknowns couple by a curvature."""
    lower, upper = limits
    frames, p = own.shape
    H, g = equations.H, equations.g
    whole = csc_array(block_diag(list(H[:, :p, :p])) + curvature)
    diagonal = whole.diagonal()
    damped = shares[0] * diagonal + shares[1] * diagonal.mean() + 1e-9
    ends = np.tile(lower[:p], frames), np.tile(upper[:p], frames)
    free = _free(own.ravel(), g[:, :p].ravel(), *ends)
    loose = _free(shared, g[:, p:].sum(axis=0), lower[p:], upper[p:])
    mixed = H[:, :p, p:].reshape(frames * p, -1)[np.ix_(free, loose)]
    factors = splu(csc_array((whole + diags_array(damped))[free][:, free]))
    solved = factors.solve(np.column_stack([-g[:, :p].ravel()[free], mixed]))
    S = H[:, p:, p:].sum(axis=0)[np.ix_(loose, loose)]
    if len(loose):
        S[np.diag_indices(len(loose))] += shares[0] * np.diag(S) + shares[1] * np.diag(S).mean()
    change, steps = np.zeros(len(shared)), np.zeros(frames * p)
    slope = g[:, p:].sum(axis=0)[loose] + mixed.T @ solved[:, 0]
    change[loose] = np.linalg.solve(S - mixed.T @ solved[:, 1:], -slope)
    steps[free] = solved[:, 0] - solved[:, 1:] @ change[loose]
    return steps.reshape(frames, p), change


@compiled
def _solved(
    H: Array,
    g: Array,
    own: Array,
    shared: Array,
    lower: Array,
    upper: Array,
    shares: tuple[float, float],
) -> tuple[Array, Array]:
    """Damped steps of own (frames, p) and shared unknowns (q,), none of them out of a limit."""
    frames, p = own.shape
    q = len(shared)
    S, s = np.zeros((q, q)), np.zeros(q)
    for frame in range(frames):
        for k in range(q):
            s[k] += g[frame, p + k]
            for column in range(q):
                S[k, column] += H[frame, p + k, p + column]
    loose = _free(shared, s, lower[p:], upper[p:])
    _damp(S, shares)
    steps = np.zeros((frames, p))
    gains = np.zeros((frames, p, q))
    for frame in range(frames):
        free = _free(own[frame], g[frame, :p], lower[:p], upper[:p])
        block, right = np.empty((len(free), len(free))), np.empty((len(free), q + 1))
        for row in range(len(free)):
            right[row, 0] = -g[frame, free[row]]
            for column in range(q):
                right[row, column + 1] = H[frame, free[row], p + column]
            for column in range(len(free)):
                block[row, column] = H[frame, free[row], free[column]]
        _damp(block, shares)
        solve_in_place(block, right)
        for row in range(len(free)):
            steps[frame, free[row]] = right[row, 0]
            for k in range(q):
                gains[frame, free[row], k] = right[row, k + 1]
                s[k] += H[frame, p + k, free[row]] * right[row, 0]
                for column in range(q):
                    S[k, column] -= H[frame, p + k, free[row]] * right[row, column + 1]
    block, right = np.empty((len(loose), len(loose))), np.empty((len(loose), 1))
    for row in range(len(loose)):
        right[row, 0] = -s[loose[row]]
        for column in range(len(loose)):
            block[row, column] = S[loose[row], loose[column]]
    solve_in_place(block, right)
    change = np.zeros(q)
    for k in range(len(loose)):
        change[loose[k]] = right[k, 0]
    for frame in range(frames):
        for row in range(p):
            for k in range(q):
                steps[frame, row] -= gains[frame, row, k] * change[k]
    return steps, change


@compiled
def solve_in_place(A: Array, B: Array) -> None:
    """Puts A^-1 B (n, m) in place of B, by elimination with pivots; A (n, n) is lost.

    LAPACK gains nothing on matrices this small, and takes long to be compiled in.
    """
    n = len(A)
    for k in range(n):
        pivot = k
        for row in range(k + 1, n):
            if abs(A[row, k]) > abs(A[pivot, k]):
                pivot = row
        if pivot != k:
            for column in range(n):
                A[k, column], A[pivot, column] = A[pivot, column], A[k, column]
            for column in range(B.shape[1]):
                B[k, column], B[pivot, column] = B[pivot, column], B[k, column]
        for row in range(k + 1, n):
            share = A[row, k] / A[k, k]
            for column in range(k + 1, n):
                A[row, column] -= share * A[k, column]
            for column in range(B.shape[1]):
                B[row, column] -= share * B[k, column]
    for k in range(n - 1, -1, -1):
        for column in range(B.shape[1]):
            for row in range(k + 1, n):
                B[k, column] -= A[k, row] * B[row, column]
            B[k, column] /= A[k, k]


@compiled
def _free(x: Array, g: Array, lower: Array, upper: Array) -> NDArray[np.int64]:
    """The unknowns but those that stand at a limit and would leave it."""
    indices, count = np.empty(len(x), np.int64), 0
    for k in range(len(x)):
        if not ((x[k] <= lower[k] and g[k] > 0.0) or (x[k] >= upper[k] and g[k] < 0.0)):
            indices[count] = k
            count += 1
    return indices[:count]


@compiled
def _damp(H: Array, shares: tuple[float, float]) -> None:
    """Adds a share of each element of the diagonal, and a share of its mean, to the diagonal."""
    if len(H):
        even = 0.0
        for k in range(len(H)):
            even += shares[1] * H[k, k] / len(H)
        for k in range(len(H)):
            H[k, k] += shares[0] * H[k, k] + even + 1e-9
