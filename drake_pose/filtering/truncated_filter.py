"""The filter: predict, linearise at every hypothesis, update, truncate, weigh."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError
from drake_pose.filtering.factors import check_moments, factor_of
from drake_pose.filtering.hypotheses import (
    Hypothesis,
    Rejection,
    merge_twins,
    normalise,
    prune,
)
from drake_pose.filtering.inequalities import Inequalities, inner_point
from drake_pose.filtering.state import Belief, StateLayout, make_belief
from drake_pose.filtering.truncation import (
    Truncated,
    clip,
    join_rows,
    truncate_joint,
    truncate_sequential,
)
from drake_pose.filtering.update import (
    ObservationModel,
    Updated,
    check_measurement,
    update,
)
from drake_pose.filtering.views import AnchoredObservation, View, next_view

Array = NDArray[np.float64]
Truncation = Literal["joint", "sequential", "clip", "none"]
TRUNCATIONS: tuple[Truncation, ...] = ("joint", "sequential", "clip", "none")


@dataclass(frozen=True)
class FilterSettings:
    """How a ``TruncatedFilter`` works.

    Args:
        truncation: "joint" (all rows at once), "sequential" (the paper's), "clip" (only the mean
            is moved inside) or "none".
        iterations: linearisations of an update at most; 1 for the paper's.
        hypothesis_cap: how many hypotheses are kept at most; 1 for none but the best.
        reject_below: a hypothesis beyond a row by more is given up: c_k (24) below this.
        smallest_weight: lighter hypotheses are given up.
        twin_distance: hypotheses closer than this in every element are one [deviations].
        tolerance: of the joint truncation.
        novelty: a measurement within this many deviations (root mean square, 6 is sensible) of
            the one that began the view shows nothing new: the frames of a view then count as
            their mean and are truncated once. 0: every frame is new, as in the paper.

    Raises:
        SettingsError: a value out of its range.
    """

    truncation: Truncation = "joint"
    iterations: int = 20
    hypothesis_cap: int = 4
    reject_below: float = -4.0
    smallest_weight: float = 1e-4
    twin_distance: float = 0.3
    tolerance: float = 1e-5
    novelty: float = 0.0

    def __post_init__(self) -> None:
        if self.truncation not in TRUNCATIONS:
            raise SettingsError(
                f"truncation must be one of {', '.join(TRUNCATIONS)}, not '{self.truncation}'"
            )
        if self.iterations < 1 or self.hypothesis_cap < 1:
            raise SettingsError("iterations and hypothesis_cap must be 1 or more")
        if not 0 <= self.novelty < np.inf:
            raise SettingsError(f"novelty must be 0 or more, not {self.novelty}")
        if not (self.reject_below < 0 and 0 <= self.smallest_weight < 1 and self.tolerance > 0):
            raise SettingsError(
                "reject_below must be negative, smallest_weight in [0, 1), tolerance positive"
            )


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

    After Shimada, Shirai, Kuno and Miura, sections 4 and 5: prediction at constant velocity,
    update linearised at the prediction and at its mirrored twins (30), truncation. Differences,
    each of which can be set back: the update iterates; all rows are truncated at once; what the
    rows said about elements that never change is counted once, not in every step.

    Args:
        layout: what the state means.
        observation: what is measured.
        inequalities: the rows, over any elements of the state.
        process_noise: (n, n) U of (6).
        settings: how to work.

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
    ) -> None:
        self.layout = layout
        self.observation = observation
        self.settings = settings or FilterSettings()
        self.inequalities = inequalities.for_columns(layout.names)
        inner_point(self.inequalities)
        _, self._U = check_moments(np.zeros(len(layout)), process_noise)
        factor_of(self._U)
        self._A = layout.transition()
        self._rows = join_rows(self.inequalities)
        constant = layout.indices(layout.constant)
        moving = np.setdiff1d(self._rows.used, constant)
        columns = np.searchsorted(self._rows.used, moving)
        # Directions among constants: their rows say the same in every step.
        changing = np.abs(self._rows.directions[:, columns]).sum(axis=1) > 0
        self._lasting: NDArray[np.bool_] = np.logical_not(changing)

    def start(self, belief: Belief) -> FilterState:
        """The state before the first measurement, truncated (but for "none").

        Raises:
            SettingsError: a belief that does not fit, or is indefinite.
        """
        checked = make_belief(belief.mean, belief.covariance)
        if checked.mean.size != len(self.layout):
            raise SettingsError(
                f"the belief has {checked.mean.size} elements, the state {len(self.layout)}"
            )
        return FilterState(0, (self._truncate(Hypothesis(checked))[0],))

    def predict(self, state: FilterState) -> FilterState:
        """One step at constant velocity: (6), for every hypothesis."""
        moved = []
        for hypothesis in state.hypotheses:
            P = self._A @ hypothesis.belief.covariance @ self._A.T + self._U
            belief = Belief(self._A @ hypothesis.belief.mean, 0.5 * (P + P.T))
            moved.append(replace(hypothesis, belief=belief))
        return replace(state, hypotheses=tuple(moved), rejections=())

    def update(self, state: FilterState, y: Array) -> FilterState:
        """Use a measurement of the predicted moment: section 5, steps 2 to 6.

        Args:
            state: the prediction.
            y: (m,) NaN where occluded.

        Raises:
            SettingsError: the measurement does not fit.
        """
        step = state.step + 1
        y = check_measurement(y, self.observation)
        view = next_view(state.view, y, self.observation, self.settings.novelty)
        if view.count > 1:
            branches = [self._repeat(h, y, view.count) for h in state.hypotheses]
        else:
            branches = [b for h in state.hypotheses for b in self._branches(h, y, step)]
        alive, rejected = self._reject(branches, step)
        truncated = [self._finish(h, updated, view.count == 1) for h, updated in alive]
        best_updates = {id(h): u for h, (_, u) in zip(truncated, alive, strict=True)}
        leader = best_updates[id(max(truncated, key=lambda h: h.log_weight))]
        merged, twins = merge_twins(normalise(truncated), self.settings.twin_distance, step)
        kept, pruned = prune(
            merged, self.settings.hypothesis_cap, self.settings.smallest_weight, step
        )
        rejections = (*rejected, *twins, *pruned)
        return FilterState(step, tuple(kept), rejections, leader.distance, leader.count, view)

    def inside(self, belief: Belief) -> Belief:
        """A belief truncated for giving out: within a view the filter's own is not, see novelty."""
        return self._truncate(Hypothesis(belief))[0].belief

    def _branches(
        self, hypothesis: Hypothesis, y: Array, step: int
    ) -> list[tuple[Hypothesis, Updated]]:
        """A hypothesis updated at its prediction, and at each mirrored one."""
        prediction = hypothesis.belief
        iterations = self.settings.iterations
        first = update(prediction, y, self.observation, iterations)
        found = [(hypothesis, first)]
        if self.settings.hypothesis_cap == 1:
            return found
        for start in self.observation.mirrors(prediction):
            other = update(prediction, y, self.observation, iterations, start)
            found.append((replace(hypothesis, born=step), other))
        return found

    def _repeat(self, hypothesis: Hypothesis, y: Array, count: int) -> tuple[Hypothesis, Updated]:
        """A hypothesis updated by a further frame of the same view."""
        anchor = hypothesis.anchor or AnchoredObservation(self.observation, hypothesis.belief)
        updated = update(hypothesis.belief, y, anchor.for_frame(count))
        return replace(hypothesis, anchor=anchor), updated

    def _reject(
        self, branches: Sequence[tuple[Hypothesis, Updated]], step: int
    ) -> tuple[list[tuple[Hypothesis, Updated]], list[Rejection]]:
        """Section 5, step 5: give up what lies far beyond a row, but never all."""
        if len(branches) == 1 or self.settings.truncation == "none" or not self.inequalities:
            return list(branches), []
        alive, rejected, worst_c = [], [], []
        phi = self.inequalities.phi
        for hypothesis, updated in branches:
            P = updated.belief.covariance
            s = np.sqrt(np.maximum(np.einsum("ki,ki->k", phi @ P, phi), 1e-300))
            c = self.inequalities.margins(updated.belief.mean) / s
            k = int(np.argmin(c))
            worst_c.append(c[k])
            if c[k] < self.settings.reject_below:
                name = self.inequalities.rows[k]
                rejected.append(Rejection(step, hypothesis.born, "constraint", name, float(c[k])))
            else:
                alive.append((hypothesis, updated))
        if not alive:
            keep = int(np.argmax(worst_c))
            return [branches[keep]], rejected[:keep] + rejected[keep + 1 :]
        return alive, rejected

    def _finish(self, hypothesis: Hypothesis, updated: Updated, is_new: bool) -> Hypothesis:
        if not is_new:
            # The rows have cut this view's belief already; they would cut it ever narrower.
            weight = hypothesis.log_weight + updated.log_likelihood
            return replace(hypothesis, belief=updated.belief, log_weight=weight)
        hypothesis = replace(hypothesis, anchor=None)
        truncated, result = self._truncate(replace(hypothesis, belief=updated.belief))
        gain = updated.log_likelihood + (result.log_probability if result else 0.0)
        return replace(truncated, log_weight=hypothesis.log_weight + gain)

    def _truncate(self, hypothesis: Hypothesis) -> tuple[Hypothesis, Truncated | None]:
        mean, P = hypothesis.belief.mean, hypothesis.belief.covariance
        if self.settings.truncation == "none" or not self.inequalities:
            return hypothesis, None
        sites = hypothesis.sites
        if self.settings.truncation == "joint":
            contained = sites if sites.size else None
            result = truncate_joint(mean, P, self._rows, contained, self.settings.tolerance)
            sites = np.where(self._lasting[:, None], result.sites, 0.0)
        elif self.settings.truncation == "sequential":
            result = truncate_sequential(mean, P, self.inequalities)
        else:
            result = clip(mean, P, self.inequalities)
        active = tuple(self.inequalities.rows[k] for k in np.flatnonzero(result.active))
        belief = Belief(result.mean, result.covariance)
        return replace(hypothesis, belief=belief, sites=sites, active=active), result
