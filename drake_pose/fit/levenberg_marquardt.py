"""Levenberg and Marquardt's method inside limits, for frames that share some of their unknowns.

(H + d diag(H) + e mean(diag(H)) I) x = -g; unknowns at a limit that x would leave are held.

The scale of the cost shrinks from round to round, so first everything within reach pulls and in the
end only what fits (graduated non-convexity, Blake and Zisserman 1987). Frames couple through what
they share: each frame's own unknowns are eliminated first (Schur complement). Those of frames that
follow one another may also couple by a motion, which is linear in them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from drake_pose.arrays import Array
from drake_pose.compiled import compiled
from drake_pose.errors import SettingsError


@dataclass(frozen=True)
class AnnealingStage:
    """A part of a fit at one scale; lengths in m, or in the fit's unit of length.

    Args:
        scale: the distance at which a point of a contour loses three quarters of its pull.
        spacing: of the points of the body's contour.
        iterations: maximum number of steps; a single one is taken untried.
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
        damping: fraction of the diagonal that is added to it at first.
        even_damping: fraction of the diagonal's mean that is added: unobservable unknowns stay.
        least_damping, most_damping: limits of the damping; a step that needs more ends the round.
        next_damping: no round begins with more damping.
        standstill: a step that lowers the cost by a smaller share of it ends the round.
    """

    longest: float = 0.35
    damping: float = 1e-3
    even_damping: float = 1e-4
    least_damping: float = 1e-4
    most_damping: float = 1e2
    next_damping: float = 0.1
    standstill: float = 1e-3


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
class LinearPrior:
    """Normal priors of linear combinations of all frames' own unknowns x (frames p,).

    Attributes:
        rows: (k, frames p) of which rows x has the prior.
        mean: (k,) its mean.
        information: (k,) one over its variance.
    """

    rows: csr_array
    mean: Array
    information: Array

    def added_to(self, equations: Equations, own: Array) -> Equations:
        """Equations with the slope and cost at own unknowns; the curvature is no frame's own."""
        off = self.rows @ own.ravel() - self.mean
        g = equations.g.copy()
        g[:, : own.shape[1]] += (self.rows.T @ (self.information * off)).reshape(own.shape)
        return Equations(equations.H, g, equations.cost + float(self.information @ off**2))

    def curvature(self) -> csc_array:
        """(frames p, frames p)."""
        return csc_array(self.rows.T @ diags_array(self.information) @ self.rows)


def minimise(
    evaluate: Callable[[Array, Array, AnnealingStage], Equations],
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    rounds: Sequence[AnnealingStage],
    settings: StepSettings | None = None,
    coupling: LinearPrior | None = None,
) -> tuple[Array, Array, float, int]:
    """The unknowns with the least cost near where they start, inside their limits.

    Args:
        evaluate: the equations at own (frames, p) and shared (q,) unknowns; what a coupling says is
            added to them.
        own, shared: to start from.
        limits: lower and upper (p + q,), own unknowns first.
        rounds: one after another.
        settings: how steps are made.
        coupling: what is known of the own unknowns of several frames together.

    Returns:
        own and shared unknowns; the cost at the last evaluation, which is before the last step
        where that was taken untried; and the number of evaluations.
    """
    settings = settings or StepSettings()
    curvature = None if coupling is None else coupling.curvature()

    def evaluated(own: Array, shared: Array, part: AnnealingStage) -> Equations:
        found = evaluate(own, shared, part)
        return found if coupling is None else coupling.added_to(found, own)

    lower, upper = limits
    p = own.shape[1]
    own, shared = np.clip(own, lower[:p], upper[:p]), np.clip(shared, lower[p:], upper[p:])
    damping, evaluations, cost = settings.damping, 0, np.inf
    for part in rounds:
        equations = evaluated(own, shared, part)
        evaluations, cost = evaluations + 1, equations.cost
        for _ in range(part.iterations):
            trial = damped_step(equations, own, shared, limits, damping, settings, curvature)
            if part.iterations == 1:
                own, shared = trial
                break
            tried = evaluated(*trial, part)
            evaluations += 1
            if tried.cost < cost:
                gain = 1.0 - tried.cost / cost
                (own, shared), equations, cost = trial, tried, tried.cost
                damping = max(0.2 * damping, settings.least_damping)
                if gain < settings.standstill:
                    break
            else:
                damping *= 10.0
                if damping > settings.most_damping:
                    break
        damping = min(damping, settings.next_damping)
    return own, shared, float(cost), evaluations


def damped_step(
    equations: Equations,
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    damping: float,
    settings: StepSettings,
    curvature: csc_array | None = None,
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
    slopes = g[:, :p].ravel(), g[:, p:].sum(axis=0)
    free = _is_free(own, slopes[0].reshape(frames, p), lower[:p], upper[:p]).ravel()
    loose = _is_free(shared, slopes[1], lower[p:], upper[p:])
    mixed = H[:, :p, p:].reshape(frames * p, -1)[np.ix_(free, loose)]
    factors = splu(csc_array((whole + diags_array(damped))[free][:, free]))
    solved = factors.solve(np.column_stack([-slopes[0][free], mixed]))
    S = H[:, p:, p:].sum(axis=0)[np.ix_(loose, loose)]
    if len(S):
        S[np.diag_indices(len(S))] += shares[0] * np.diag(S) + shares[1] * np.diag(S).mean()
    change, steps = np.zeros(len(shared)), np.zeros(frames * p)
    slope = slopes[1][loose] + mixed.T @ solved[:, 0]
    change[loose] = np.linalg.solve(S - mixed.T @ solved[:, 1:], -slope)
    steps[free] = solved[:, 0] - solved[:, 1:] @ change[loose]
    return steps.reshape(frames, p), change


def _is_free(x: Array, g: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Whether unknowns do not stand at a limit that they would leave."""
    return np.asarray(~((x <= lower) & (g > 0.0) | (x >= upper) & (g < 0.0)))


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
    S = np.zeros((q, q + 1))
    for frame in range(frames):
        for k in range(q):
            S[k, q] -= g[frame, p + k]
            for column in range(q):
                S[k, column] += H[frame, p + k, p + column]
    is_held = _damp(S, shared, lower[p:], upper[p:], shares)
    # Of each frame its own unknowns' equations, those of the shared ones beside them: [A C -g].
    M = np.empty((frames, p, p + q + 1))
    for frame in range(frames):
        for row in range(p):
            for column in range(p + q):
                M[frame, row, column] = H[frame, row, column]
            M[frame, row, p + q] = -g[frame, row]
        _damp(M[frame], own[frame], lower[:p], upper[:p], shares)
        eliminate(M[frame])
        for k in range(q):
            for row in range(p):
                for column in range(0 if is_held[k] else q + 1):
                    S[k, column] -= H[frame, p + k, row] * M[frame, row, p + column]
    eliminate(S)
    steps = np.empty((frames, p))
    for frame in range(frames):
        for row in range(p):
            steps[frame, row] = M[frame, row, p + q]
            for k in range(q):
                steps[frame, row] -= M[frame, row, p + k] * S[k, q]
    return steps, S[:, q].copy()


@compiled
def _damp(
    M: Array, x: Array, lower: Array, upper: Array, shares: tuple[float, float]
) -> NDArray[np.bool_]:
    """Adds to the diagonal of [H ... -g] shares of each element and of the mean, in place.

    Returns which unknowns stand at a limit that they would leave: they are to be 0 instead.
    """
    n, last = len(x), M.shape[1] - 1
    is_held = np.empty(n, dtype=np.bool_)
    total, free = 0.0, 0
    for k in range(n):
        leaves_below, leaves_above = M[k, last] < 0.0, M[k, last] > 0.0
        is_held[k] = (x[k] <= lower[k] and leaves_below) or (x[k] >= upper[k] and leaves_above)
        if not is_held[k]:
            total += M[k, k]
            free += 1
    for k in range(n):
        if is_held[k]:
            M[k] = 0.0
            M[k, k] = 1.0
        else:
            M[k, k] += shares[0] * M[k, k] + shares[1] * total / free + 1e-9
    return is_held


@compiled
def eliminate(M: Array) -> None:
    """Makes [A B] (n, n + k) into [1 A^-1 B], A positive definite: Gauss and Jordan's elimination.

    LAPACK gains nothing on matrices this small, and takes long to be compiled in.
    """
    n, columns = M.shape
    for k in range(n):
        share = 1.0 / M[k, k]
        for column in range(k, columns):
            M[k, column] *= share
        for row in range(n):
            share = M[row, k]
            if row != k and share != 0.0:
                for column in range(k, columns):
                    M[row, column] -= share * M[k, column]
