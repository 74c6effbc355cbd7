"""Levenberg-Marquardt with limits, for frames that share some of their unknowns.

Each step x solves

    (H + d diag(H) + e mean(diag(H)) I) x = -g

with the damping d and a constant e; an unknown at a limit that x would leave is fixed. Steps are
accepted if the cost decreases.

The scale of the cost shrinks from stage to stage, so at first all matched points pull and in the
end only the inliers (graduated non-convexity, Blake and Zisserman 1987). Frames are coupled by
shared unknowns: each frame's own unknowns are eliminated first (Schur complement). Own unknowns of
successive frames may also be coupled by a linear motion prior.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from drake_pose.arrays import Array
from drake_pose.compiled import compiled
from drake_pose.errors import require_at_least, require_positive


@dataclass(frozen=True)
class AnnealingStage:
    """Part of a fit with a constant scale; lengths in m, or in the fit's unit of length."""

    scale: float  # Distance at which a point's weight drops to a quarter.
    spacing: float  # Distance between sampled points of the body's contour.
    # Maximum number of steps; a single step is taken without checking the cost.
    iterations: int = 1

    def __post_init__(self) -> None:
        require_positive(scale=self.scale, spacing=self.spacing)
        require_at_least(1, iterations=self.iterations)


@dataclass(frozen=True)
class StepSettings:
    """Settings of the steps.

    The damping is divided by 5 after a step that reduces the cost, and else multiplied by 10.
    """

    max_step: float = 0.35  # Maximum change of an unknown per step [rad, m or a logarithm].
    damping: float = 1e-3  # Initial fraction of the diagonal that is added to it.
    # Fraction of the diagonal's mean that is added; it fixes unobservable unknowns.
    uniform_damping: float = 1e-4
    # min_damping, max_damping: limits of the damping; a step that needs more ends the stage.
    min_damping: float = 1e-4
    max_damping: float = 1e2
    max_start_damping: float = 0.1  # Maximum damping at the start of a stage.
    min_decrease: float = 1e-3  # A step that reduces the cost by a smaller fraction ends the stage.


@dataclass(frozen=True, eq=False)
class Equations:
    """The normal equations H dx = -g of frames at given unknowns."""

    # (frames, u, u) contribution of each frame; u = p own unknowns of the frame, then q shared
    # ones. The shared parts of all frames add up.
    H: Array
    g: Array  # (frames, u) likewise.
    cost: float  # Cost of all frames.


@dataclass(frozen=True, eq=False)
class LinearPrior:
    """Normal priors of linear combinations of all frames' own unknowns x (frames p,)."""

    rows: csr_array  # (k, frames p) the combinations: rows x has the prior.
    mean: Array  # (k,) means.
    information: Array  # (k,) inverse variances.

    def augment(self, equations: Equations, own: Array) -> Equations:
        """Return equations at ``own`` (frames, p) with the prior's gradient and cost; H stays."""
        residual = self.rows @ own.ravel() - self.mean
        g = equations.g.copy()
        g[:, : own.shape[1]] += (self.rows.T @ (self.information * residual)).reshape(own.shape)
        return Equations(equations.H, g, equations.cost + float(self.information @ residual**2))

    def curvature(self) -> csc_array:
        """Return the prior's information matrix (frames p, frames p)."""
        return csc_array(self.rows.T @ diags_array(self.information) @ self.rows)


def minimise(
    evaluate: Callable[[Array, Array, AnnealingStage], Equations],
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    stages: Sequence[AnnealingStage],
    settings: StepSettings | None = None,
    coupling: LinearPrior | None = None,
) -> tuple[Array, Array, float, int]:
    """Minimise the cost within limits, from an initial guess.

    Args:
        evaluate: returns the equations at own (frames, p) and shared (q,) unknowns and a stage,
            without the coupling.
        own, shared: (frames, p) and (q,) initial guess; it is moved into the limits.
        limits: lower and upper (p + q,), own unknowns first.
        stages: the stages in order, coarse to fine.
        settings: settings of the steps; None: ``StepSettings()``.
        coupling: prior that couples the own unknowns of several frames; None: none.

    Returns (frames, p) own and (q,) shared unknowns; their cost, or that before the last step if
    the last stage has a single one, which is taken without checking the cost; and the number of
    evaluations.
    """
    settings = settings or StepSettings()
    curvature = None if coupling is None else coupling.curvature()

    def evaluated(own: Array, shared: Array, stage: AnnealingStage) -> Equations:
        found = evaluate(own, shared, stage)
        return found if coupling is None else coupling.augment(found, own)

    lower, upper = limits
    p = own.shape[1]
    own, shared = np.clip(own, lower[:p], upper[:p]), np.clip(shared, lower[p:], upper[p:])
    damping, evaluations, cost = settings.damping, 0, np.inf
    for stage in stages:
        equations = evaluated(own, shared, stage)
        evaluations, cost = evaluations + 1, equations.cost
        for _ in range(stage.iterations):
            trial = damped_step(equations, own, shared, limits, damping, settings, curvature)
            if stage.iterations == 1:
                own, shared = trial
                break
            tried = evaluated(*trial, stage)
            evaluations += 1
            if tried.cost < cost:
                gain = 1.0 - tried.cost / cost
                (own, shared), equations, cost = trial, tried, tried.cost
                damping = max(0.2 * damping, settings.min_damping)
                if gain < settings.min_decrease:
                    break
            else:
                damping *= 10.0
                if damping > settings.max_damping:
                    break
        damping = min(damping, settings.max_start_damping)
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
    """Return own (frames, p) and shared (q,) unknowns after a damped step within the limits.

    Args:
        equations: equations at the unknowns.
        own, shared: (frames, p) and (q,) current unknowns.
        limits: lower and upper (p + q,).
        damping: fraction of the diagonal that is added to it.
        settings: maximum step and uniform damping; its other damping settings are not used.
        curvature: (frames p, frames p) information matrix of a coupling; None: the own unknowns of
            different frames are independent.
    """
    lower, upper = limits
    p = own.shape[1]
    fractions = damping, settings.uniform_damping
    if curvature is None:
        own_steps, shared_step = _solve_frames(
            equations.H, equations.g, own, shared, lower, upper, fractions
        )
    else:
        own_steps, shared_step = _solve_coupled(
            equations, own, shared, limits, fractions, curvature
        )
    # All steps are shortened by the same factor, so shared and own unknowns stay consistent.
    largest = max(
        float(np.abs(own_steps).max(initial=0.0)), float(np.abs(shared_step).max(initial=0.0))
    )
    factor = min(1.0, settings.max_step / max(largest, 1e-300))
    return (
        np.clip(own + factor * own_steps, lower[:p], upper[:p]),
        np.clip(shared + factor * shared_step, lower[p:], upper[p:]),
    )


def _solve_coupled(
    equations: Equations,
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    fractions: tuple[float, float],
    curvature: csc_array,
) -> tuple[Array, Array]:
    """Return damped steps (frames, p) of coupled own unknowns, and (q,) of shared ones.

    Unknowns at a limit that they would leave are fixed; others may step beyond a limit.

    Args:
        equations: equations without the coupling's H, but with its g.
        own, shared: (frames, p) and (q,) current unknowns.
        limits: lower and upper (p + q,).
        fractions: fractions of each diagonal element and of the diagonal's mean that are added.
        curvature: (frames p, frames p) information matrix of the coupling.
    """
    lower, upper = limits
    frames, p = own.shape
    H, g = equations.H, equations.g
    whole = csc_array(block_diag(list(H[:, :p, :p])) + curvature)
    diagonal = whole.diagonal()
    damped = fractions[0] * diagonal + fractions[1] * diagonal.mean() + 1e-9
    slopes = g[:, :p].ravel(), g[:, p:].sum(axis=0)
    free = _is_free(own, slopes[0].reshape(frames, p), lower[:p], upper[:p]).ravel()
    loose = _is_free(shared, slopes[1], lower[p:], upper[p:])
    mixed = H[:, :p, p:].reshape(frames * p, -1)[np.ix_(free, loose)]
    factors = splu(csc_array((whole + diags_array(damped))[free][:, free]))
    solved = factors.solve(np.column_stack([-slopes[0][free], mixed]))
    S = H[:, p:, p:].sum(axis=0)[np.ix_(loose, loose)]
    if len(S):
        S[np.diag_indices(len(S))] += fractions[0] * np.diag(S) + fractions[1] * np.diag(S).mean()
    shared_step, own_steps = np.zeros(len(shared)), np.zeros(frames * p)
    slope = slopes[1][loose] + mixed.T @ solved[:, 0]
    shared_step[loose] = np.linalg.solve(S - mixed.T @ solved[:, 1:], -slope)
    own_steps[free] = solved[:, 0] - solved[:, 1:] @ shared_step[loose]
    return own_steps.reshape(frames, p), shared_step


def _is_free(x: Array, g: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Return whether each unknown can move: it is not at a limit that it would leave.

    Args:
        x, g: (..., k) unknowns, and gradient of the cost, against which they move.
        lower, upper: (k,) limits.
    """
    return np.asarray(~((x <= lower) & (g > 0.0) | (x >= upper) & (g < 0.0)))


@compiled
def _solve_frames(
    H: Array,
    g: Array,
    own: Array,
    shared: Array,
    lower: Array,
    upper: Array,
    fractions: tuple[float, float],
) -> tuple[Array, Array]:
    """Return damped steps of own (frames, p) and shared (q,) unknowns.

    Unknowns at a limit that they would leave are fixed; others may step beyond a limit.

    Args:
        H, g: (frames, u, u) and (frames, u) normal equations H dx = -g of each frame, u = p + q:
            its own unknowns first, then the shared ones.
        own, shared: (frames, p) and (q,) current unknowns.
        lower, upper: (p + q,) limits.
        fractions: fractions of each diagonal element and of the diagonal's mean that are added.
    """
    frames, p = own.shape
    q = len(shared)
    S = np.zeros((q, q + 1))
    for frame in range(frames):
        for k in range(q):
            S[k, q] -= g[frame, p + k]
            for column in range(q):
                S[k, column] += H[frame, p + k, p + column]
    is_held = _damp(S, shared, lower[p:], upper[p:], fractions)
    # Per frame, the equations of its own unknowns with the shared columns beside them: [A C -g].
    M = np.empty((frames, p, p + q + 1))
    for frame in range(frames):
        for row in range(p):
            for column in range(p + q):
                M[frame, row, column] = H[frame, row, column]
            M[frame, row, p + q] = -g[frame, row]
        _damp(M[frame], own[frame], lower[:p], upper[:p], fractions)
        eliminate(M[frame])
        for k in range(q):
            for row in range(p):
                for column in range(0 if is_held[k] else q + 1):
                    S[k, column] -= H[frame, p + k, row] * M[frame, row, p + column]
    eliminate(S)
    own_steps = np.empty((frames, p))
    for frame in range(frames):
        for row in range(p):
            own_steps[frame, row] = M[frame, row, p + q]
            for k in range(q):
                own_steps[frame, row] -= M[frame, row, p + k] * S[k, q]
    return own_steps, S[:, q].copy()


@compiled
def _damp(
    M: Array, x: Array, lower: Array, upper: Array, fractions: tuple[float, float]
) -> NDArray[np.bool_]:
    """Damp the equations [H ... -g] (n, columns) in place, and fix unknowns at limits.

    ``x``, ``lower``, ``upper``: (n,). ``fractions``: of each diagonal element and of the diagonal's
    mean that are added. Returns (n,) whether an unknown is fixed at a limit that it would leave.
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
            M[k, k] += fractions[0] * M[k, k] + fractions[1] * total / free + 1e-9
    return is_held


@compiled
def eliminate(M: Array) -> None:
    """Replace M = [A B] (n, n + k) by [I A^-1 B] in place, by Gauss-Jordan elimination.

    A must be positive definite. LAPACK is not faster on such small matrices, and slow to compile
    in.
    """
    n, columns = M.shape
    for k in range(n):
        factor = 1.0 / M[k, k]
        for column in range(k, columns):
            M[k, column] *= factor
        for row in range(n):
            factor = M[row, k]
            if row != k and factor != 0.0:
                for column in range(k, columns):
                    M[row, column] -= factor * M[k, column]
