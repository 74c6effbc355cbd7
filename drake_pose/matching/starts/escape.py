"""A refined pose improved by placing its parts anew, until nothing near an error is left to try."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.matching.raster_fit.passes import Pass, descend
from drake_pose.matching.raster_fit.problem import RefinementProblem
from drake_pose.matching.starts.part_placement import PartSearch

# How many placements of a part, the best after the first pass, are refined on.
_PURSUED = 2
_PART_PASSES = (Pass(4, 4, 30.0, 100.0), Pass(4, 3, 6.0, 50.0))
_WHOLE_PASSES = (Pass(3, 3, 6.0, 50.0),)
OTHER_PASSES = (Pass(5, 4, 20.0, 100.0), Pass(5, 3, 6.0, 30.0), Pass(6, 2, 2.0, 5.0))
"""From nodes mirrored or placed anew to the local optimum."""


@dataclass(frozen=True)
class EscapeSettings:
    """Parameters of the search for better placements of parts.

    Args:
        proposals: how many placements of a part are refined.
        least_error: parts with less wrong area near them are left alone [share of the area].
        rounds: how often a part is tried at most.

    Raises:
        SettingsError: if a value is out of its range.
    """

    proposals: int = 3
    least_error: float = 0.001
    rounds: int = 2

    def __post_init__(self) -> None:
        if self.proposals < 1 or self.rounds < 0:
            raise SettingsError("proposals must be 1 or more, and rounds 0 or more")
        if not self.least_error >= 0.0:
            raise SettingsError(f"least_error must be 0 or more, not {self.least_error}")


def escape(
    problem: RefinementProblem,
    search: PartSearch,
    parameters: np.ndarray,
    enough: float,
    settings: EscapeSettings,
    deadline: float = np.inf,
) -> tuple[np.ndarray, int]:
    """Improve a refined pose.

    Args:
        problem: the silhouettes.
        search: finds placements.
        parameters: (m + 4,) the pose.
        enough: J with which it ends [pixel].
        settings: the parameters.
        deadline: it ends when ``time.perf_counter`` says so.

    Returns:
        The parameters and their J.
    """
    J = problem.J(parameters)
    tried = np.zeros(len(search.parts), dtype=np.int64)
    seen = np.full(len(search.parts), np.inf)
    everything = problem.body.freedom()
    while J > enough and time.perf_counter() < deadline:
        errors = search.errors_near(problem, parameters)
        # A part is worth another try only where the error near it is not the one it left.
        worth = (errors >= settings.least_error * problem.area) & (tried < settings.rounds)
        worth &= np.abs(errors - seen) > 0.1 * errors
        if not worth.any():
            break
        rank = np.where(worth, errors / np.array([len(p.nodes) for p in search.parts]), -1.0)
        chosen = int(np.argmax(rank))
        better, better_J = _try_part(problem, search, parameters, chosen, settings.proposals)
        tried[chosen] += 1
        if better_J < J:
            if better_J < J - settings.least_error * problem.area:
                better, _, _ = descend(problem, better, everything, _WHOLE_PASSES)
                better_J = min((problem.J(better), better_J))
            parameters, J = better, problem.J(better)
            errors = search.errors_near(problem, parameters)
        seen[chosen] = errors[chosen]
    return parameters, J


def _try_part(
    problem: RefinementProblem,
    search: PartSearch,
    parameters: np.ndarray,
    chosen: int,
    proposals: int,
) -> tuple[np.ndarray, float]:
    """The best refined placement of a part, and its J."""
    part, body = search.parts[chosen], problem.body
    freedom = body.freedom(search.moving(part))
    still = None if part.held else problem.still(parameters, part.nodes)
    rough = []
    for placed in search.propose(problem, parameters, part, proposals, still):
        refined, apart, _ = descend(problem, placed, freedom, _PART_PASSES[:1], still)
        rough.append((apart, refined))
    rough.sort(key=lambda pair: pair[0])
    best, least = parameters, np.inf
    for _, placed in rough[:_PURSUED]:
        refined, apart, _ = descend(problem, placed, freedom, _PART_PASSES[1:], still)
        if apart < least:
            best, least = refined, apart
    if not np.isfinite(least):
        return parameters, np.inf
    return best, float(problem.J(best))


def reflect(
    problem: RefinementProblem, search: PartSearch, parameters: np.ndarray
) -> tuple[np.ndarray, float]:
    """Improve a refined pose seen by one camera by mirroring much of the body in depth.

    Args:
        problem: the silhouettes.
        search: knows what is mirrored together.
        parameters: (m + 4,) the pose.

    Returns:
        The parameters and their J.
    """
    best, least = parameters, float(problem.J(parameters))
    for reflection in search.reflections if len(problem.views) == 1 else ():
        freedom = problem.body.freedom((*reflection.nodes, *reflection.held))
        start = search.reflect(best, reflection, problem.views[0])
        refined, _, _ = descend(problem, start, freedom, OTHER_PASSES)
        J = float(problem.J(refined))
        if J < least:
            best, least = refined, J
    return best, least
