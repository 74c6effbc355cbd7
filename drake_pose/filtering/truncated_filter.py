"""The filter: predict, linearise at every hypothesis, update, truncate, weigh."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Literal, get_args

import numpy as np

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError
from drake_pose.filtering.hypotheses import (
    Hypothesis,
    Rejection,
    View,
    anchored,
    begin_repeated_view,
    merge_twins,
    next_view,
    normalise,
    prune,
)
from drake_pose.filtering.inequalities import Inequalities, inner_point
from drake_pose.filtering.state import Belief, StateLayout, make_belief
from drake_pose.filtering.truncated_normal import (
    Truncated,
    clip,
    join_rows,
    truncate_joint,
    truncate_sequential,
    unlimited,
)
from drake_pose.filtering.update import (
    Evidence,
    ObservationModel,
    Truncate,
    Updated,
    make_evidence,
    update,
)

Truncation = Literal["joint", "sequential", "clip", "none"]
Branch = tuple[Hypothesis, Updated]
TRUNCATIONS: tuple[Truncation, ...] = get_args(Truncation)

# Hypotheses closer than this in every element are one [deviations]; of the joint truncation.
_TWIN_DISTANCE, _TOLERANCE = 0.3, 1e-3
_ROUGH_ITERATIONS = 3
# A hypothesis is given up that lies beyond a row by more: whose c_k (24) is below this.
_REJECT_BELOW = -4.0


@dataclass(frozen=True)
class FilterSettings:
    """How a ``TruncatedFilter`` works.

    Args:
        truncation: "joint" (all rows at once), "sequential" (the paper's), "clip" (only the mean
            is moved inside) or "none".
        iterations: linearisations of an update at most; 1 for the paper's.
        hypothesis_cap: how many hypotheses are kept at most; 1 for none but the best.
        smallest_weight: lighter hypotheses are given up.
        novelty: a measurement shows nothing new if noise alone would make it differ as much
            from the one that began the view with more than this probability, see ``views``. 0:
            every frame is new, as in the paper; so it is always with "sequential" and "clip".

    Raises:
        SettingsError: a value out of its range.
    """

    truncation: Truncation = "joint"
    iterations: int = 20
    hypothesis_cap: int = 4
    smallest_weight: float = 1e-4
    novelty: float = 1e-9

    def __post_init__(self) -> None:
        if self.truncation not in TRUNCATIONS:
            raise SettingsError(
                f"truncation must be one of {', '.join(TRUNCATIONS)}, not '{self.truncation}'"
            )
        if self.iterations < 1 or self.hypothesis_cap < 1:
            raise SettingsError("iterations and hypothesis_cap must be 1 or more")
        if not 0 <= self.novelty < 1:
            raise SettingsError(f"novelty must be in [0, 1), not {self.novelty}")
        if not 0 <= self.smallest_weight < 1:
            raise SettingsError(f"smallest_weight must be in [0, 1), not {self.smallest_weight}")


@dataclass(frozen=True, eq=False)
class FilterState:
    """What a filter believes after a step.

    Attributes:
        step: how many measurements have been used.
        hypotheses: the heaviest first, at least one.
        rejections: what was given up in the last step.
        distance, count: of the best hypothesis' last update; see ``Updated``.
        view: what has been seen since the last new view.
    """

    step: int
    hypotheses: tuple[Hypothesis, ...]
    rejections: tuple[Rejection, ...] = ()
    distance: float = 0.0
    count: int = 0
    view: View | None = None

    @property
    def best(self) -> Belief:
        """The belief of the heaviest hypothesis."""
        return self.hypotheses[0].belief


class TruncatedFilter:
    """An extended Kalman filter whose belief stays inside linear inequalities.

    Shimada, Shirai, Kuno and Miura, sections 4 and 5, with differences, each of which can be set
    back: all rows are truncated at once; the update iterates, linearised where the truncated belief
    lies; and with "joint" the next step is predicted from the belief without its limits, which
    would else count again in every step and make it ever surer.

    Args:
        inequalities: the rows, over any elements of the state.
        process_noise: (n, n) U of (6).
        transition: (n, n) A of (6); constant velocity (8) if not given.

    Attributes:
        novelty: of the settings, or 0 where the truncation keeps no views.

    Raises:
        SettingsError: contradictory rows, named; or a process noise that is indefinite.
        UnknownNameError: a row is about an element that the state lacks.
    """

    def __init__(
        self,
        layout: StateLayout,
        observation: ObservationModel,
        inequalities: Inequalities,
        process_noise: Array,
        settings: FilterSettings | None = None,
        transition: Array | None = None,
    ) -> None:
        self.layout = layout
        self.observation = observation
        self.settings = settings or FilterSettings()
        self.inequalities = inequalities.for_columns(layout.names)
        inner_point(self.inequalities)
        noise = make_belief(np.zeros(len(layout)), process_noise, layout, "the process noise")
        self._U = noise.covariance
        self._A = layout.transition() if transition is None else transition
        self._rows = join_rows(self.inequalities)
        # What is truncated and fed back has no offsets to keep.
        feeds_back = self.settings.truncation in ("sequential", "clip")
        self.novelty = 0.0 if feeds_back else self.settings.novelty
        is_free = self.settings.truncation == "none" or not self.inequalities
        self._limits: Truncate | None = None if is_free else self._truncate

    def start(self, belief: Belief) -> FilterState:
        """The state before the first measurement, truncated (but for "none").

        Raises:
            SettingsError: a belief that does not fit, or is indefinite.
        """
        checked = make_belief(belief.mean, belief.covariance, self.layout)
        truncated = self._cut(checked, np.zeros((0, 2)))
        return FilterState(0, (self._finish(Hypothesis(checked, checked), checked, truncated),))

    def predict(self, state: FilterState) -> FilterState:
        """One step at constant velocity: (6), for every hypothesis."""
        moved = []
        for h in state.hypotheses:
            repeated = h.repeated.moved(self._A, self._U) if h.repeated else None
            free = repeated.state() if repeated else self.predicted(h.free)
            belief = self.predicted(h.belief)
            moved.append(replace(h, belief=belief, free=free, repeated=repeated))
        return replace(state, hypotheses=tuple(moved), rejections=())

    def predicted(self, belief: Belief) -> Belief:
        """A belief after one step at constant velocity: (6)."""
        return belief.moved(self._A, self._U)

    def corrected(self, prediction: Belief, y: Array, variances: Array, start: Array) -> Array:
        """(n,) the mean of a prediction after a measurement, without hypotheses: a rough state.

        Args:
            start: (n,) where to linearise first; y (m,) and variances as for ``update``.
        """
        seen = make_evidence(self.observation, y, variances)
        few = min(self.settings.iterations, _ROUGH_ITERATIONS)
        return update(prediction, seen, few, start, False, self._limits).truncated.mean

    def update(
        self,
        state: FilterState,
        y: Array,
        observation: ObservationModel | None = None,
        variances: Array | None = None,
    ) -> FilterState:
        """Use a measurement y (m,), NaN where occluded: section 5, steps 2 to 6.

        Args:
            observation: what is measured, if not what the filter was made for.
            variances: (m,) of this measurement's noise, or its covariance (m, m), finite where it
                is; None: the model's.

        Raises:
            SettingsError: the measurement does not fit.
        """
        step, settings = state.step + 1, self.settings
        seen = make_evidence(observation or self.observation, y, variances)
        view = next_view(state.view, seen, self.novelty)
        if view.count > 1:
            branches = [self._repeat(h, seen) for h in state.hypotheses]
        else:
            places = count()
            branches = [b for h in state.hypotheses for b in self._branches(h, seen, step, places)]
        alive, rejected = self._reject(branches, step)
        finished = [
            self._finish(h, done.belief, done.truncated, done.log_likelihood) for h, done in alive
        ]
        leader = max(range(len(finished)), key=lambda i: finished[i].log_weight)
        merged, twins = merge_twins(normalise(finished), _TWIN_DISTANCE, step)
        kept, pruned = prune(merged, settings.hypothesis_cap, settings.smallest_weight, step)
        best = alive[leader][1]
        return FilterState(
            step, tuple(kept), (*rejected, *twins, *pruned), best.distance, best.count, view
        )

    def _branches(
        self, hypothesis: Hypothesis, seen: Evidence, step: int, places: Iterator[int]
    ) -> list[Branch]:
        """A hypothesis updated at its prediction, and at each mirrored one, which are counted."""
        own = replace(hypothesis, repeated=None)
        starts = [(own, own.belief.mean)]
        if self.settings.hypothesis_cap > 1:
            for start in seen.model.mirrors(own.belief):
                starts.append((replace(own, born=step, place=next(places)), start))
        return [
            (
                h,
                update(
                    h.free,
                    seen,
                    self.settings.iterations,
                    start,
                    tempered=h is own,
                    truncate=self._limits,
                    sites=h.sites,
                ),
            )
            for h, start in starts
        ]

    def _repeat(self, hypothesis: Hypothesis, seen: Evidence) -> Branch:
        """A hypothesis updated by a further frame of the same view."""
        repeated = hypothesis.repeated
        if repeated is None:
            repeated = begin_repeated_view(
                seen.model, hypothesis.free, hypothesis.belief, hypothesis.tangent
            )
        tangent = seen._replace(model=anchored(seen.model, repeated.tangent))
        updated = update(repeated.belief, tangent)
        repeated = replace(repeated, belief=updated.belief)
        belief = repeated.state()
        truncated = self._cut(belief, hypothesis.sites)
        updated = replace(updated, belief=belief, truncated=truncated)
        return replace(hypothesis, repeated=repeated), updated

    def _reject(
        self, branches: Sequence[Branch], step: int
    ) -> tuple[list[Branch], list[Rejection]]:
        """Section 5, step 5: give up what lies far beyond a row, but never all."""
        if len(branches) == 1 or self._limits is None:
            return list(branches), []
        alive, rejected, worst_c = [], [], []
        for hypothesis, result in branches:
            c = result.truncated.c
            k = int(np.argmin(c))
            worst_c.append(c[k])
            if c[k] < _REJECT_BELOW:
                name = self.inequalities.rows[k]
                gone = replace(hypothesis, belief=result.belief)
                rejected.append(Rejection(step, gone, "constraint", name, float(c[k])))
            else:
                alive.append((hypothesis, result))
        if not alive:
            keep = int(np.argmax(worst_c))
            return [branches[keep]], rejected[:keep] + rejected[keep + 1 :]
        return alive, rejected

    def _finish(
        self, hypothesis: Hypothesis, free: Belief, result: Truncated, log_likelihood: float = 0.0
    ) -> Hypothesis:
        """The hypothesis after its update, weighed by the measurement and by the limits."""
        active = tuple(self.inequalities.rows[k] for k in np.flatnonzero(result.active))
        belief = Belief(result.mean, result.covariance)
        evidence = hypothesis.log_evidence + log_likelihood
        weight = evidence + result.log_probability
        if self.settings.truncation != "joint":
            # The paper's: the next step is predicted from the truncated belief.
            free, evidence = belief, weight
        return replace(
            hypothesis,
            belief=belief,
            free=free,
            log_weight=weight,
            log_evidence=evidence,
            active=active,
            sites=result.sites,
            tangent=hypothesis.tangent if hypothesis.repeated else belief.mean,
        )

    def _cut(self, belief: Belief, sites: Array) -> Truncated:
        """A belief truncated by the limits, if there are any."""
        return unlimited(belief) if self._limits is None else self._limits(belief, sites)

    def _truncate(self, belief: Belief, sites: Array) -> Truncated:
        if self.settings.truncation == "sequential":
            return truncate_sequential(belief, self.inequalities)
        if self.settings.truncation == "clip":
            return clip(belief, self.inequalities)
        return truncate_joint(belief, self._rows, _TOLERANCE, sites)
