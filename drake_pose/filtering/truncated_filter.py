"""Several explanations of the same measurements, weighed against each other."""

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Literal, get_args

import numpy as np

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError
from drake_pose.filtering.inequalities import Inequalities, inner_point
from drake_pose.filtering.linearisation import Linear, require_slope
from drake_pose.filtering.motion import LinearMotion, MotionModel, require_models, step_from
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
    Measurement,
    ObservationModel,
    Truncate,
    Updated,
    make_measurement,
    update,
)
from drake_pose.filtering.views import (
    RepeatedView,
    StaticView,
    anchored,
    begin_repeated_view,
    moved,
    next_view,
)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation.

    Attributes:
        belief: mean and covariance, inside the limits.
        free: what is believed without the present limits; the next step is predicted from it.
        log_weight: logarithm of its weight among all.
        log_evidence: the same without what the present limits say of it.
        born: the step it was made at by mirroring; 0 for the first.
        place: which of those made at that step it is: both tell it from all others.
        active: names of the rows that cut its belief in the last step.
        sites: of the last truncation, where the next one begins; see ``Truncated``.
        tangent: (n,) where the first frame of the present view was linearised.
        repeated: what is believed within a view that lasts; None in its first frame.
    """

    belief: Belief
    free: Belief
    log_weight: float = 0.0
    log_evidence: float = 0.0
    born: int = 0
    place: int = 0
    active: tuple[str, ...] = ()
    sites: Array = field(default_factory=lambda: np.zeros((0, 2)))
    tangent: Array = field(default_factory=lambda: np.zeros(0))
    repeated: RepeatedView | None = None

    @property
    def weight(self) -> float:
        """Between 0 and 1."""
        return math.exp(self.log_weight)


@dataclass(frozen=True)
class Rejection:
    """A hypothesis that was given up.

    Attributes:
        hypothesis: as it was then; for a constraint its belief is that without the limits.
        reason: "constraint", "weight", "twin" or "cap".
        row: the violated inequality's name, for a constraint.
        c: its c_k (24), for a constraint.
    """

    step: int
    hypothesis: Hypothesis
    reason: str
    row: str = ""
    c: float = math.nan


def normalise(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The same with weights that add up to 1, the heaviest first."""
    ordered = sorted(hypotheses, key=lambda h: -h.log_weight)
    logs = np.array([h.log_weight for h in ordered])
    total = logs[0] + math.log(np.exp(logs - logs[0]).sum())
    return [
        replace(h, log_weight=h.log_weight - total, log_evidence=h.log_evidence - total)
        for h in ordered
    ]


def merge_twins(
    hypotheses: Sequence[Hypothesis], distance: float, step: int
) -> tuple[list[Hypothesis], list[Rejection]]:
    """Keep the heavier of any two nearer than so many deviations, with the weight of both."""
    kept: list[Hypothesis] = []
    rejected = []
    for candidate in hypotheses:
        for place, other in enumerate(kept):
            scale = np.maximum(other.belief.deviations(), 1e-12)
            if np.abs((candidate.belief.mean - other.belief.mean) / scale).max() < distance:
                both = float(np.logaddexp(other.log_weight, candidate.log_weight))
                gain = both - other.log_weight
                kept[place] = replace(
                    other, log_weight=both, log_evidence=other.log_evidence + gain
                )
                rejected.append(Rejection(step, candidate, "twin"))
                break
        else:
            kept.append(candidate)
    return kept, rejected


def prune(
    hypotheses: Sequence[Hypothesis], cap: int, smallest_weight: float, step: int
) -> tuple[list[Hypothesis], list[Rejection]]:
    """Keep at most ``cap``, and none lighter than ``smallest_weight``; always the heaviest."""
    ordered = normalise(hypotheses)
    kept = [h for h in ordered[1:cap] if h.weight >= smallest_weight]
    rejected = [
        Rejection(step, h, "weight" if h.weight < smallest_weight else "cap")
        for place, h in enumerate(ordered)
        if place and h not in kept
    ]
    return normalise([ordered[0], *kept]), rejected


Truncation = Literal["joint", "sequential", "clip", "none"]
Linearisation = Literal["spread", "tangent"]
Branch = tuple[Hypothesis, Updated]
TRUNCATIONS: tuple[Truncation, ...] = get_args(Truncation)
LINEARISATIONS: tuple[Linearisation, ...] = get_args(Linearisation)


@dataclass(frozen=True)
class FilterSettings:
    """How a ``TruncatedFilter`` works.

    The defaults are for any system: they were chosen on a planar arm of three links of unknown
    lengths (``tests/benchmarks/filters.py``), and are about as sure as they are right there, also
    where elbow and tip alone are seen. What the hand of Shimada et al. needs is in
    ``papers.shimada.experiment_settings``.

    Args:
        truncation: "joint" (all rows at once), "sequential" (the paper's), "clip" (only the mean
            is moved inside) or "none".
        linearisation: "spread" (over all that is believed: what a tangent leaves out counts as
            noise) or "tangent" (at one point, the paper's).
        iterations: linearisations of an update at most; 1 for the paper's. More of them are nearer
            to the most probable state where that is sharp, and too sure where it is not.
        persistence: what a line leaves out of a measurement stays the same for about this time, so
            that further frames do not average it away [s]; for "spread".
        hypothesis_cap: how many hypotheses are kept at most; 1 for none but the best.
        smallest_weight: lighter hypotheses are given up.
        novelty: a measurement shows nothing new if noise alone would make it differ as much
            from the one that began the view with more than this probability, such as 1e-9, see
            ``views``. 0: every frame is new, as in the paper; so it is always with "sequential"
            and "clip".
        twin_distance: hypotheses that are closer in every element are one [deviations].
        tolerance: of the joint truncation [deviations].
        rough_iterations: linearisations of hypotheses that are compared before they are kept.
        rejected_below: a hypothesis is given up whose c_k (24) of a row is below this.

    Raises:
        SettingsError: a value out of its range.
    """

    truncation: Truncation = "joint"
    linearisation: Linearisation = "spread"
    iterations: int = 1
    persistence: float = 0.15
    hypothesis_cap: int = 4
    smallest_weight: float = 1e-4
    novelty: float = 0.0
    twin_distance: float = 0.3
    tolerance: float = 1e-3
    rough_iterations: int = 3
    rejected_below: float = -4.0

    def __post_init__(self) -> None:
        if self.truncation not in TRUNCATIONS:
            raise SettingsError(
                f"truncation must be one of {', '.join(TRUNCATIONS)}, not '{self.truncation}'"
            )
        if self.linearisation not in LINEARISATIONS:
            raise SettingsError(
                f"linearisation must be one of {', '.join(LINEARISATIONS)}, not "
                f"'{self.linearisation}'"
            )
        if not 0.0 <= self.persistence < math.inf:
            raise SettingsError(f"persistence must be 0 or more, not {self.persistence}")
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
    view: StaticView | None = None

    @property
    def best(self) -> Belief:
        """The belief of the heaviest hypothesis."""
        return self.hypotheses[0].belief

    @property
    def overall(self) -> Belief:
        """Mean and covariance of all hypotheses together: wide where they disagree."""
        weights = np.array([one.weight for one in self.hypotheses])
        means = np.array([one.belief.mean for one in self.hypotheses])
        mean = weights @ means / weights.sum()
        within = sum(one.weight * one.belief.covariance for one in self.hypotheses)
        between = (weights[:, None] * (means - mean)).T @ (means - mean)
        return Belief(mean, (within + between) / weights.sum())


def _require_class(given: object, kind: type, said: str) -> None:
    if not isinstance(given, kind):
        raise SettingsError(f"{said} {kind.__name__}, not {type(given).__name__}")


class TruncatedFilter:
    """A Kalman filter of nonlinear measurements whose belief stays inside linear inequalities.

    Shimada, Shirai, Kuno and Miura, sections 4 and 5, with differences, each of which can be set
    back: all rows are truncated at once; measurements are linearised over the truncated belief; and
    with "joint" the next step is predicted from the belief without its limits, which would else
    count again in every step and make it ever surer.

    Args:
        inequalities: the rows, over any elements of the state.
        motion: how the state moves in a step, see ``constant_velocity``.

    Attributes:
        novelty: of the settings, or 0 where the truncation keeps no views.

    Raises:
        SettingsError: contradictory rows, named; a noise that is indefinite; models or settings of
            another kind or shape.
        UnknownNameError: a row is about an element that the state lacks.
    """

    def __init__(
        self,
        layout: StateLayout,
        observation: ObservationModel,
        inequalities: Inequalities,
        motion: MotionModel,
        settings: FilterSettings | None = None,
    ) -> None:
        for given, kind in ((layout, StateLayout), (inequalities, Inequalities)):
            _require_class(given, kind, "a filter takes")
        self.layout = layout
        self.observation = observation
        self.motion = motion
        require_models(layout, observation, motion)
        self.inequalities = inequalities.for_columns(layout.names)
        inner_point(self.inequalities)
        noise = make_belief(np.zeros(len(layout)), motion.noise, layout, "the motion's noise")
        self._U = noise.covariance
        self._rows = join_rows(self.inequalities)
        self._checked = False
        self._set(FilterSettings() if settings is None else settings)

    def _set(self, settings: FilterSettings) -> None:
        _require_class(settings, FilterSettings, "a filter's settings are")
        self.settings = settings
        # What is truncated and fed back has no offsets to keep.
        feeds_back = settings.truncation in ("sequential", "clip")
        self.novelty = 0.0 if feeds_back else settings.novelty
        self._spread = 0.0
        if settings.linearisation == "spread":
            # A step of unknown time counts as one of 30 in a second.
            self._spread = max(1.0, settings.persistence / (self.motion.period or 1 / 30))
        is_free = settings.truncation == "none" or not self.inequalities
        self._limits: Truncate | None = None if is_free else self._truncate

    def with_settings(self, settings: FilterSettings) -> "TruncatedFilter":
        """The same filter with other settings; states of one are states of the other."""
        if settings is self.settings:
            return self
        other = copy(self)
        other._set(settings)
        return other

    def start(self, belief: Belief) -> FilterState:
        """The state before the first measurement, truncated (but for "none").

        The first call compares the models' Jacobians with differences, at the belief's mean.

        Raises:
            SettingsError: a belief that does not fit, or is indefinite; a Jacobian that is wrong.
        """
        _require_class(belief, Belief, "a filter starts at a")
        checked = make_belief(belief.mean, belief.covariance, self.layout)
        truncated = self._cut(checked, np.zeros((0, 2)))
        if not self._checked:
            names, seen, motion = self.layout.names, self.observation, self.motion
            require_slope(
                seen.predict, truncated.mean, seen.names, names, seen.wraps, "the observation"
            )
            if not isinstance(motion, LinearMotion):
                still = np.zeros(len(names), dtype=np.bool_)
                require_slope(motion.predict, truncated.mean, names, names, still, "the motion")
            self._checked = True
        return FilterState(0, (self._finish(Hypothesis(checked, checked), checked, truncated),))

    def predict(self, state: FilterState) -> FilterState:
        """One step of the motion: (6), for every hypothesis."""
        stepped = []
        for h in state.hypotheses:
            # Linear where the state can be, also for what is believed without limits.
            step = self._step(h.belief)
            repeated = h.repeated.moved(step, self._U) if h.repeated else None
            free = repeated.state() if repeated else moved(h.free, step, self._U)
            belief = moved(h.belief, step, self._U)
            stepped.append(replace(h, belief=belief, free=free, repeated=repeated))
        return replace(state, hypotheses=tuple(stepped), rejections=())

    def predicted(self, belief: Belief) -> Belief:
        """A belief after one step of the motion: (6)."""
        return moved(belief, self._step(belief), self._U)

    def _step(self, belief: Belief) -> Linear:
        return step_from(self.motion, belief, self._spread > 0)

    def corrected(self, prediction: Belief, y: Array, variances: Array, start: Array) -> Array:
        """(n,) the mean of a prediction after a measurement, without hypotheses: a rough state.

        Args:
            start: (n,) where to linearise first; y (m,) and variances as for ``update``.
        """
        seen = make_measurement(self.observation, y, variances)
        few = min(self.settings.iterations, self.settings.rough_iterations)
        rough = update(prediction, seen, few, start, False, self._limits, spread=self._spread)
        return rough.truncated.mean

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
        seen = make_measurement(observation or self.observation, y, variances)
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
        merged, twins = merge_twins(normalise(finished), self.settings.twin_distance, step)
        kept, pruned = prune(merged, settings.hypothesis_cap, settings.smallest_weight, step)
        best = alive[leader][1]
        return FilterState(
            step, tuple(kept), (*rejected, *twins, *pruned), best.distance, best.count, view
        )

    def _branches(
        self, hypothesis: Hypothesis, seen: Measurement, step: int, places: Iterator[int]
    ) -> list[Branch]:
        """A hypothesis updated at its prediction, and at each mirrored one, which are counted."""
        own = replace(hypothesis, repeated=None)
        iterations = self.settings.iterations
        starts = [(own, own.belief.mean)]
        if self.settings.hypothesis_cap > 1:
            for start in seen.model.mirrors(own.belief):
                starts.append((replace(own, born=step, place=next(places)), start))
        # A belief that is as wide as its mirror is far would hold both: each begins at its place.
        alone = self._spread > 0 and len(starts) == 1
        if self._spread > 0 and not alone:
            iterations = max(iterations, self.settings.rough_iterations)
        return [
            (
                h,
                update(
                    h.free,
                    seen,
                    iterations,
                    None if alone else start,
                    tempered=h is own,
                    truncate=self._limits,
                    sites=h.sites,
                    spread=self._spread,
                ),
            )
            for h, start in starts
        ]

    def _repeat(self, hypothesis: Hypothesis, seen: Measurement) -> Branch:
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
            if c[k] < self.settings.rejected_below:
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
        return truncate_joint(belief, self._rows, self.settings.tolerance, sites)
