"""Levenberg and Marquardt's method inside limits, for frames that share some of their unknowns.

The scale of the cost shrinks from round to round, so first everything within reach pulls and in the
end only what fits (graduated non-convexity, Blake and Zisserman 1987). Frames couple through what
they share alone: each frame's own unknowns are eliminated first (Schur complement).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e2
# A scale begins with no more than this.
_NEXT_DAMPING = 0.1
# Steps that gain a smaller share of the cost end a round.
_STANDSTILL = 1e-3


@dataclass(frozen=True)
class Round:
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
    evaluate: Callable[[Array, Array, Round], Equations],
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    rounds: Sequence[Round],
    settings: StepSettings | None = None,
) -> Minimum:
    """The unknowns with the least cost near where they start, inside their limits.

    Args:
        evaluate: the equations at own (frames, p) and shared (q,) unknowns.
        own, shared: to start from.
        limits: lower and upper (p + q,), own unknowns first.
        rounds: one after another.
        settings: how steps are made.
    """
    settings = settings or StepSettings()
    lower, upper = limits
    p = own.shape[1]
    own, shared = np.clip(own, lower[:p], upper[:p]), np.clip(shared, lower[p:], upper[p:])
    damping, evaluations, cost = settings.damping, 0, np.inf
    for part in rounds:
        equations = evaluate(own, shared, part)
        evaluations, cost = evaluations + 1, equations.cost
        for _ in range(part.iterations):
            trial = _stepped(equations, own, shared, limits, damping, settings)
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


def _stepped(
    equations: Equations,
    own: Array,
    shared: Array,
    limits: tuple[Array, Array],
    damping: float,
    settings: StepSettings,
) -> tuple[Array, Array]:
    """Own and shared unknowns after a damped step that stays inside the limits."""
    lower, upper = limits
    p = own.shape[1]
    g_shared = equations.g[:, p:].sum(axis=0)
    S = equations.H[:, p:, p:].sum(axis=0)
    S = S + np.diag(_damping(np.diag(S), damping, settings))
    s = g_shared.copy()
    backs = []
    for H, g, x in zip(equations.H, equations.g, own, strict=True):
        free = np.flatnonzero(~_leaving(x, g[:p], lower[:p], upper[:p]))
        block = H[np.ix_(free, free)]
        block = block + np.diag(_damping(np.diag(block), damping, settings))
        solved = np.linalg.solve(block, np.column_stack([-g[free], H[free, p:]]))
        offset, gain = solved[:, 0], solved[:, 1:]
        S -= H[p:, free] @ gain
        s += H[p:, free] @ offset
        backs.append((free, offset, gain))
    change = np.zeros(len(shared))
    free = np.flatnonzero(~_leaving(shared, g_shared, lower[p:], upper[p:]))
    if len(free):
        change[free] = np.linalg.solve(S[np.ix_(free, free)], -s[free])
    steps = np.zeros(own.shape)
    for step, (index, offset, gain) in zip(steps, backs, strict=True):
        step[index] = offset - gain @ change
    # Shared unknowns are held back with the frames that they move.
    longest = max(float(np.abs(steps).max(initial=0.0)), float(np.abs(change).max(initial=0.0)))
    share = min(1.0, settings.longest / max(longest, 1e-300))
    return (
        np.clip(own + share * steps, lower[:p], upper[:p]),
        np.clip(shared + share * change, lower[p:], upper[p:]),
    )


def _leaving(x: Array, g: Array, lower: Array, upper: Array) -> Mask:
    """Which unknowns stand at a limit and would leave it."""
    return np.asarray(((x <= lower) & (g > 0.0)) | ((x >= upper) & (g < 0.0)))


def _damping(diagonal: Array, damping: float, settings: StepSettings) -> Array:
    """What is added to a diagonal."""
    even = settings.even_damping * (diagonal.mean() if len(diagonal) else 0.0)
    return np.asarray(damping * diagonal + even + 1e-9)
