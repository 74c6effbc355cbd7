"""Refinement of a pose to a local optimum of the silhouettes' difference.

Levenberg and Marquardt's method on the distances between the body's contour and the silhouette's
border (see ``kernel``), with limits: a parameter that would leave its limits is held
there for the step. Passes look at few lines of the raster first and let far distances count, then
at all lines and near distances only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.errors import SettingsError
from drake_pose.search.raster_fit.body import Freedom
from drake_pose.search.raster_fit.lines import Border
from drake_pose.search.raster_fit.problem import RefinementProblem

_AT_LIMIT = 1e-9
# Steps smaller than this [rad or m] end a pass.
_STANDSTILL = 5e-4
# A share of the diagonal, which keeps the equations solvable.
_RELATIVE_DAMPING = 1e-3


@dataclass(frozen=True)
class Pass:
    """One part of a refinement.

    Args:
        iterations: at most so many steps.
        stride: every so many rows and columns are looked at.
        scale: distances beyond it lose weight [pixel].
        damping: added to the diagonal of the normal equations [pixel^3/rad^2]: what the silhouettes
            hardly show hardly moves.
        longest_step: steps are shortened so that no parameter changes by more [rad or m].
        slack: distances up to this along a line hardly count, those beyond it by what they are
            more; 0: all count [pixel].
    """

    iterations: int
    stride: int
    scale: float
    damping: float
    longest_step: float = 0.25
    slack: float = 0.0

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.stride < 1:
            raise SettingsError(
                f"a pass needs 1 iteration and a stride of 1 or more, not {self.iterations} and "
                f"{self.stride}"
            )
        if not 0.0 <= self.slack <= 0.5:
            raise SettingsError(f"slack must lie between 0 and 0.5 pixel, not {self.slack}")
        for name in ("scale", "damping", "longest_step"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"{name} must be positive, not {getattr(self, name)}")


COARSE_PASSES = (Pass(8, 4, 50.0, 300.0), Pass(8, 4, 10.0, 100.0))
"""From far: several nodes may be off by their own width."""

FINE_PASSES = (Pass(5, 2, 6.0, 30.0), Pass(6, 2, 3.0, 10.0), Pass(8, 1, 2.0, 5.0))
"""From near, to the local optimum."""

LAST_PASSES = (Pass(5, 2, 2.0, 5.0), Pass(15, 1, 1.0, 0.5, slack=0.4))
"""To the optimum itself, where directions count that the silhouettes hardly show.

A pixel is wrong where the contour is more than half a pixel from the border on its line. What is
less says nothing: the border lies anywhere between two pixel centres, alike likely. The mean of
least squares leaves the share 0.02 to 0.03 of the border's pixels wrong; drawn into the bounds that
all lines set together, a pose leaves 0.005 to 0.015 and is half as far from the true one, as an
estimate from bounds is where noise is uniform. 0.4 instead of 0.5 keeps it from resting on bounds.
"""


def descend(
    problem: RefinementProblem,
    parameters: np.ndarray,
    freedom: Freedom,
    passes: Sequence[Pass],
    still: Sequence[Border] | None = None,
) -> tuple[np.ndarray, float, int]:
    """Refine some parameters.

    Args:
        problem: the body and the silhouettes.
        parameters: (m + 4,) to start from.
        freedom: which of them may change.
        passes: one after another.
        still: the border in each view of what they do not move; None: made here.

    Returns:
        The parameters with the least difference met in the last pass, that difference as far as
        its lines show it [pixel], and the number of steps.
    """
    lower = problem.body.lower[freedom.columns]
    upper = problem.body.upper[freedom.columns]
    steps = 0
    least = np.inf
    still = problem.still(parameters, freedom.nodes) if still is None else still
    for part in passes:
        best, least = parameters, np.inf
        for iteration in range(part.iterations + 1):
            offset = iteration % part.stride
            equations = problem.equations(
                parameters, freedom, part.stride, offset, part.scale, still, part.slack
            )
            if equations.apart < least:
                best, least = parameters, equations.apart
            if iteration == part.iterations:
                break
            current = parameters[freedom.columns]
            step = limited_step(
                equations.H, equations.g, current, lower, upper, part.damping, part.longest_step
            )
            steps += 1
            parameters = parameters.copy()
            parameters[freedom.columns] = np.clip(current + step, lower, upper)
            if np.abs(step).max(initial=0.0) < _STANDSTILL:
                break
        parameters = best
    return parameters, least, steps


@compiled
def limited_step(
    H: np.ndarray,
    g: np.ndarray,
    current: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    damping: float,
    longest: float,
) -> np.ndarray:
    """The damped step (k,) of normal equations H step = -g that stays inside limits.

    Args:
        H, g: (k, k) and (k,).
        current, lower, upper: (k,) where the parameters are, and their limits.
        damping: added to the diagonal.
        longest: no parameter changes by more.
    """
    count = len(current)
    step = np.zeros(count)
    active = np.arange(count)
    while len(active) > 0:
        step[:] = 0.0
        step[active] = _solve(H, g, active, damping)
        step *= min(1.0, longest / max(np.abs(step).max(), 1e-300))
        leaving = (step < 0.0) & (current <= lower + _AT_LIMIT)
        leaving |= (step > 0.0) & (current >= upper - _AT_LIMIT)
        if not leaving.any():
            break
        step[leaving] = 0.0
        active = active[~leaving[active]]
    return step


@compiled
def _solve(H: np.ndarray, g: np.ndarray, active: np.ndarray, damping: float) -> np.ndarray:
    """Solves the damped equations of some parameters (n,) by Cholesky's decomposition."""
    count = len(active)
    L, x = np.empty((count, count)), np.empty(count)
    for i in range(count):
        for j in range(i + 1):
            total = H[active[i], active[j]]
            if i == j:
                total += damping + _RELATIVE_DAMPING * total
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(max(total, 1e-12)) if i == j else total / L[j, j]
    for i in range(count):
        x[i] = -g[active[i]]
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return x
