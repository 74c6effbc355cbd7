"""A refined pose improved by placing its parts anew, and what else is as good as it.

Variable neighbourhood descent (Mladenovic and Hansen 1997): a part is placed anew or mirrored in
depth, or seen by one camera half of the body mirrored with left and right exchanged; what comes
near the pose's J is refined, and the pose moves there where that is better. The search ends where
no part is left near which an error is that it was not tried with. What was found on the way and is
nearly as good is kept: it belongs to the answer as long as the silhouettes do not tell.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.search.refinement import Freedom, Pass, RefinementProblem, descend
from drake_pose.search.starts.part_placement import Part, PartSearch

# From nodes mirrored or placed anew to the local optimum: what is far after a pass is left.
_FAR_PASSES = (Pass(4, 4, 30.0, 100.0),)
_REFLECTED_PASSES = (Pass(8, 4, 30.0, 100.0), Pass(6, 3, 6.0, 30.0))
_NEAR_PASSES = (Pass(5, 3, 6.0, 30.0),)
_FINE_PASSES = (Pass(6, 2, 2.0, 5.0),)
_END_PASSES = (Pass(6, 1, 1.0, 0.5, slack=0.4),)
_WHOLE_PASSES = (Pass(3, 3, 6.0, 50.0), Pass(3, 2, 2.0, 5.0))
# What has no more J than this above what may be, as a share of the border's length, with its own
# parameters refined alone, is refined with all.
_SPARE = 0.015
# How many placements of a part, the best after the first pass, are refined on.
_PURSUED = 2
# Poses are refined on after the first pass, after the second, and kept, whose J is above the best
# one's by no more than these shares of the border's length.
_HOPEFUL, _NEAR, _KEPT = 0.15, 0.03, 0.03
# Mirrored poses with no more than this above are mended, by at most this many tries.
_MENDED, _MENDINGS = 0.35, 6
# What is nearly as good is refined with all of the body before it is judged.
_EQUAL = 0.01
# What is better by a smaller share is the same, not quite refined.
_BETTER = 0.003
# Errors that differ by a smaller share are the same.
_SAME_ERROR = 0.1
# How many placements of a part are refined.
_PROPOSALS = 3
# Parts with less wrong area near them are left alone until all are tried [share of the area].
_LEAST_ERROR = 0.001
# How often a part is tried at most before all are, and as often again then.
_ROUNDS = 2


class _Other(NamedTuple):
    """Another placement: its J, the parameters that are placed and where, and their freedom."""

    J: float
    freedom: Freedom
    values: np.ndarray


class NeighbourhoodSearch:
    """Searches about a pose for placements of parts; ``reflections``: half of the body, too."""

    def __init__(
        self, problem: RefinementProblem, search: PartSearch, *, reflections: bool = True
    ) -> None:
        self.problem, self.search = problem, search
        # What is mirrored in the depth of one camera another one sees.
        mirrored = search.reflections if reflections and len(problem.views) == 1 else ()
        self._parts = (*search.parts, *mirrored)
        self._freedoms = [
            problem.body.freedom(None if part.exchanged else (*part.nodes, *part.held))
            for part in self._parts
        ]
        self._sizes = np.array([len(part.nodes) for part in self._parts])
        self._seen = np.full(len(self._parts), np.inf)
        self._tried = np.zeros(len(self._parts), dtype=np.int64)
        self._others: list[_Other] = []

    def improve(
        self,
        parameters: np.ndarray,
        enough: float,
        deadline: float = np.inf,
        *,
        everywhere: bool = False,
        tries: int | None = None,
    ) -> tuple[np.ndarray, float]:
        """Better parameters than those (m + 4,) of a refined pose, and their J.

        Args:
            enough: J with which it ends [pixel].
            deadline: it ends when ``time.perf_counter`` says so.
            everywhere: try each part at least once.
            tries: it ends after this many; None: no limit.
        """
        J = float(self.problem.J(parameters))
        rounds = _ROUNDS * (2 if everywhere else 1)
        same = _BETTER * self.problem.border_length
        least = _LEAST_ERROR * self.problem.area
        last = np.inf if tries is None else int(self._tried.sum()) + tries
        while J > enough and self._tried.sum() < last and time.perf_counter() < deadline:
            errors = self._errors_near(parameters, J)
            # A part is worth another try only where the error near it is not the one it left.
            worth = ((errors >= least) | everywhere) & (self._tried < rounds)
            worth &= np.abs(errors - self._seen) > np.maximum(_SAME_ERROR * errors, same)
            if not worth.any():
                break
            # Half a body is mirrored after its parts.
            parts = len(self.search.parts)
            if worth[:parts].any():
                worth[parts:] = False
            chosen = int(np.argmax(np.where(worth, errors / self._sizes, -1.0)))
            self._tried[chosen] += 1
            better, better_J = self._try(parameters, J, chosen, bool(errors[chosen] >= least))
            if better_J < J:
                parameters, J = better, better_J
                errors = self._errors_near(parameters, J)
            self._seen[chosen] = errors[chosen]
        return parameters, J

    def others(self, parameters: np.ndarray, limit: float, same: float) -> list[np.ndarray]:
        """Other poses than the best (m + 4,) up to a limit of J, refined to the end, best first.

        ``same``: poses none of whose values differ by more are one [rad or m].
        """
        problem = self.problem
        known, kept = [parameters], []
        spare = _SPARE * problem.border_length
        everything = problem.body.freedom()

        def is_known(pose: np.ndarray, poses: Sequence[np.ndarray]) -> bool:
            # A pose is not another one for a full turn.
            gaps = [problem.body.nearest_turns(pose, other) - other for other in poses]
            return any(float(np.abs(gap).max()) <= same for gap in gaps)

        for other in sorted(self._others, key=lambda one: one.J):
            start = parameters.copy()
            start[other.freedom.columns] = other.values
            if is_known(start, known):
                continue
            refined, _, _ = descend(problem, start, other.freedom, _END_PASSES)
            J = float(problem.J(refined))
            if limit < J <= limit + spare and not is_known(refined, known):
                refined, _, _ = descend(problem, refined, everything, _END_PASSES)
                J = float(problem.J(refined))
            if J <= limit and not is_known(refined, known):
                kept.append((J, refined))
                known.append(refined)
            known.append(start)
        kept.sort(key=lambda pair: pair[0])
        return [pose for _, pose in kept]

    def _errors_near(self, parameters: np.ndarray, J: float) -> np.ndarray:
        """For each part the area (parts,) wrong within its reach [pixel]."""
        errors = self.search.errors_near(self.problem, parameters)
        return np.append(errors, np.full(len(self._parts) - len(errors), J))

    def _starts(self, parameters: np.ndarray, part: Part, erring: bool) -> list[np.ndarray]:
        """Poses to refine from; where no error is near, a part is only mirrored."""
        search = self.search
        starts = [search.mirror(parameters, part, view) for view in self.problem.views]
        if part.exchanged or not erring:
            return starts
        return starts + search.propose(self.problem, parameters, part, _PROPOSALS)

    def _try(
        self, parameters: np.ndarray, J: float, chosen: int, erring: bool
    ) -> tuple[np.ndarray, float]:
        """The best pose that a part leads to, and its J; what is nearly as good is kept."""
        problem, length = self.problem, self.problem.border_length
        part, freedom = self._parts[chosen], self._freedoms[chosen]
        still = problem.still(parameters, freedom.moved)
        rough = []
        for start in self._starts(parameters, part, erring):
            if part.exchanged:
                refined, apart = self._settle_reflected(start, J, freedom)
            else:
                refined, apart, _ = descend(problem, start, freedom, _FAR_PASSES, still)
            if apart <= J + _HOPEFUL * length:
                rough.append((apart, refined))
        rough.sort(key=lambda pair: pair[0])
        found: list[tuple[float, np.ndarray]] = []
        for _, start in rough[:_PURSUED]:
            refined, apart, _ = descend(problem, start, freedom, _NEAR_PASSES, still)
            if apart <= J + _NEAR * length:
                refined, _, _ = descend(problem, refined, freedom, _FINE_PASSES, still)
                found.append((float(problem.J(refined)), refined))
        columns = freedom.columns
        self._others += [
            _Other(other_J, freedom, other[columns])
            for other_J, other in found
            if other_J <= J + _KEPT * length
        ]
        least, best = min(found, key=lambda pair: pair[0], default=(np.inf, parameters))
        if least > J + _EQUAL * length:
            return parameters, np.inf
        whole, _, _ = descend(problem, best, problem.body.freedom(), _WHOLE_PASSES)
        whole_J = float(problem.J(whole))
        best, least = (whole, whole_J) if whole_J < least else (best, least)
        if least > J - _BETTER * length:
            return parameters, np.inf
        self._others.append(_Other(J, freedom, parameters[columns]))
        return best, least

    def _settle_reflected(
        self, start: np.ndarray, J: float, freedom: Freedom
    ) -> tuple[np.ndarray, float]:
        """A mirrored pose refined, single parts that could not be mirrored placed anew, and its J.

        Limits keep parts from being mirrored; without another place for them the whole mirrored
        body would be given up.
        """
        problem, length = self.problem, self.problem.border_length
        refined, apart, _ = descend(problem, start, freedom, _REFLECTED_PASSES)
        near = J + _NEAR * length
        if near < apart <= J + _MENDED * length:
            refined, _, _ = descend(problem, refined, freedom, _WHOLE_PASSES)
            mending = NeighbourhoodSearch(problem, self.search, reflections=False)
            refined, apart = mending.improve(refined, near, tries=_MENDINGS)
        return refined, apart
