"""A Kalman filter inside linear inequalities that keeps several weighted hypotheses.

Shimada, Shirai, Kuno and Miura, sections 4 and 5: prediction, update from each hypothesis and its
mirrored ones, truncation, rejection, and weighting of the remaining hypotheses.
"""

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Literal, get_args

import numpy as np

from drake_pose.arrays import Array, Indices
from drake_pose.errors import SettingsError, require_at_least, require_choice
from drake_pose.filtering.inequalities import Inequalities, inner_point
from drake_pose.filtering.motion import (
    LinearMotion,
    MotionModel,
    require_models,
    step_from,
    stopped_rates,
)
from drake_pose.filtering.state import (
    Belief,
    Linear,
    StateLayout,
    make_belief,
    mix,
    require_jacobian,
)
from drake_pose.filtering.truncated_normal import (
    Truncated,
    merge_rows,
    truncate_joint,
    truncate_sequential,
    untruncated,
)
from drake_pose.filtering.update import (
    Measurement,
    ObservationModel,
    RepeatedView,
    Truncate,
    Updated,
    after_step,
    anchored_observation,
    begin_repeated_view,
    make_measurement,
    next_view,
    slices,
    update,
)

# Hypotheses lighter than the first are dropped; a merger that costs less than the second, a
# Kullback-Leibler divergence, changes nothing that matters.
_LIGHT, _SAME = 1e-6, 0.02


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One hypothesis of the state."""

    belief: Belief  # Mean and covariance inside the limits.
    free: Belief  # The belief without the limits of this step; the next step is predicted from it.
    log_weight: float = 0.0  # Logarithm of its weight among all hypotheses.
    log_evidence: float = 0.0  # ``log_weight`` without the probability of the limits in this step.
    born: int = 0  # Step in which it was made by mirroring; 0 for the first.
    number: int = 0  # Index among the hypotheses made in that step; unique together with ``born``.
    # Texts of the inequalities that changed its belief in the last step.
    active: tuple[str, ...] = ()
    # Of the last truncation, where the next one starts; see ``Truncated``.
    sites: Array = field(default_factory=lambda: np.zeros((0, 2)))
    # (n,) state at which the first frame of the current view was linearised.
    tangent: Array = field(default_factory=lambda: np.zeros(0))
    # Belief within a static view from its second frame on; None in its first.
    repeated: RepeatedView | None = None

    @property
    def weight(self) -> float:
        """Its weight, between 0 and 1."""
        return math.exp(self.log_weight)

    def merged_with(self, lighter: "Hypothesis") -> "Hypothesis":
        """Return this hypothesis with the moments and the weight of both."""
        logs = np.array(
            [[one.log_weight, one.log_evidence] for one in (self, lighter)], dtype=np.float64
        )
        total = np.logaddexp(*logs)
        weight, evidence = np.exp(logs - total).T
        return replace(
            self,
            belief=mix(weight, (self.belief, lighter.belief)),
            free=mix(evidence, (self.free, lighter.free)),
            log_weight=float(total[0]),
            log_evidence=float(total[1]),
        )


@dataclass(frozen=True)
class Rejection:
    """A hypothesis that was removed."""

    step: int  # Number of the step.
    hypothesis: Hypothesis  # As it was then; for "constraint" with the belief before truncation.
    reason: str  # "constraint", "twin" (a duplicate) or "cap".
    row: str = ""  # Text of the violated inequality, for "constraint".
    # Margin c_k (24) of the mean from this inequality [standard deviations], for "constraint".
    c: float = math.nan


def normalise(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses with weights that sum to 1, sorted by weight, descending."""
    ordered = sorted(hypotheses, key=lambda h: -h.log_weight)
    logs = np.array([h.log_weight for h in ordered])
    total = logs[0] + math.log(np.exp(logs - logs[0]).sum())
    return [
        replace(h, log_weight=h.log_weight - total, log_evidence=h.log_evidence - total)
        for h in ordered
    ]


def reduce_mixture(
    hypotheses: Sequence[Hypothesis], cap: int, step: int
) -> tuple[list[Hypothesis], list[Rejection]]:
    """Merge hypotheses until at most ``cap`` are left; return these and the rejections.

    Those two are merged next whose merger changes the mixture least: the product of the lighter
    weight and their difference, the Kullback-Leibler divergence by which Runnalls (2007) bounds the
    change for equal weights. Moments and weights are preserved. Hypotheses with a difference below
    ``_SAME`` are merged also below the cap. ``step``: number of the step, for the rejections: the
    lighter one is a "twin" if they differ as little, else "cap".
    """
    kept, rejected = normalise(hypotheses), []
    means = np.array([one.belief.mean for one in kept])
    covariances = np.array([one.belief.covariance for one in kept])
    weights = np.maximum([one.weight for one in kept], np.finfo(np.float64).tiny)
    scale = np.sqrt(np.einsum("kii->ki", covariances).max(axis=0))
    scale[scale == 0.0] = 1.0

    def log_determinants(blocks: Array) -> Array:
        """Return the log determinants (k,) of covariances (k, n, n); singular ones have one."""
        relative = blocks / np.outer(scale, scale) + 1e-12 * np.eye(len(scale))
        return np.asarray(np.linalg.slogdet(relative)[1])

    def differences(i: int, others: Indices) -> Array:
        """Return the differences (k,) of hypothesis i from ``others`` (k,)."""
        off = 0.5 * (means[others] - means[i])
        both = 0.5 * (covariances[i] + covariances[others]) + off[:, :, None] * off[:, None, :]
        return log_determinants(both) - 0.5 * (logs[i] + logs[others])

    count = len(kept)
    logs, apart = log_determinants(covariances), np.full((count, count), np.inf)
    for i in range(count - 1):
        apart[i, i + 1 :] = differences(i, np.arange(i + 1, count))
    while count > 1:
        lighter = np.minimum.outer(weights, weights)
        cost = apart if apart.min() < _SAME else apart * np.where(lighter > 0.0, lighter, np.inf)
        i, j = (int(k) for k in np.unravel_index(np.argmin(cost), cost.shape))
        if count <= cap and apart[i, j] >= _SAME:
            break
        heavy, light = (kept[k] for k in ((i, j) if weights[i] >= weights[j] else (j, i)))
        rejected.append(Rejection(step, light, "twin" if apart[i, j] < _SAME else "cap"))
        kept[i] = heavy.merged_with(light)
        means[i], covariances[i] = kept[i].belief.mean, kept[i].belief.covariance
        weights[i], weights[j], count = weights[i] + weights[j], 0.0, count - 1
        logs[i] = log_determinants(covariances[i : i + 1])[0]
        apart[j], apart[:, j], others = np.inf, np.inf, np.flatnonzero(weights)
        others = others[others != i]
        apart[np.minimum(i, others), np.maximum(i, others)] = differences(i, others)
    return normalise([kept[i] for i in np.flatnonzero(weights)]), rejected


Truncation = Literal["joint", "sequential", "none"]
Linearisation = Literal["spread", "tangent"]
Branch = tuple[Hypothesis, Updated]
"""A hypothesis before an update, and its belief after it."""
TRUNCATIONS: tuple[Truncation, ...] = get_args(Truncation)
LINEARISATIONS: tuple[Linearisation, ...] = get_args(Linearisation)


@dataclass(frozen=True)
class FilterSettings:
    """Settings of a ``TruncatedFilter``.

    The defaults were chosen on a planar arm of three links of unknown lengths
    (``tests/benchmarks/filters.py``). There the estimated covariance about matches the errors, also
    if only elbow and tip are visible. ``papers.shimada.experiment_settings`` has the settings for
    the hand of Shimada et al.

    Args:
        truncation: "joint" (all rows at once), "sequential" (the paper's) or "none".
        linearisation: "spread" (over the belief, with the remainder's covariance as noise; see
            ``linearise_over``) or "tangent" (at one point, the paper's).
        iterations: largest number of linearisations of an update; 1 in the paper. More come closer
            to a sharp maximum of the posterior, and are overconfident where it is not sharp.
        persistence: correlation time of the linearisation error of a measurement, so that frames in
            this time do not average it away [s]; for "spread".
        hypothesis_cap: largest number of hypotheses; 1: only the best. With "spread" those are
            split over which the measurement is too curved.
        novelty: p-value below which a measurement differs from the first of its static view and
            begins a new one, for example 1e-9; see ``views``. 0: each frame is a new view, as in
            the paper, and always with "sequential".
        rough_iterations: largest number of linearisations for rough states, and smallest for
            mirrored hypotheses with "spread".
        rejected_below: a hypothesis with a smaller c_k (24) of any row is removed [standard
            deviations].

    Raises:
        SettingsError: a value is out of range.
    """

    truncation: Truncation = "joint"
    linearisation: Linearisation = "spread"
    iterations: int = 1
    persistence: float = 0.15
    hypothesis_cap: int = 8
    novelty: float = 0.0
    rough_iterations: int = 3
    rejected_below: float = -4.0

    def __post_init__(self) -> None:
        require_choice("truncation", self.truncation, TRUNCATIONS)
        require_choice("linearisation", self.linearisation, LINEARISATIONS)
        require_at_least(1, iterations=self.iterations, hypothesis_cap=self.hypothesis_cap)
        if not 0.0 <= self.persistence < math.inf:
            raise SettingsError(f"persistence must be 0 or more, not {self.persistence}")
        if not 0 <= self.novelty < 1:
            raise SettingsError(f"novelty must be in [0, 1), not {self.novelty}")


@dataclass(frozen=True, eq=False)
class FilterState:
    """The state of a filter after a step."""

    step: int  # Number of measurements used.
    hypotheses: tuple[Hypothesis, ...]  # Sorted by weight, descending; at least one.
    rejections: tuple[Rejection, ...] = ()  # Hypotheses removed in the last step.
    # distance, count: squared Mahalanobis distance and number of measurements of the best
    # hypothesis' last update; see ``Updated``.
    distance: float = 0.0
    count: int = 0
    view: tuple[Array, int] | None = None  # The current static view, see ``next_view``.

    @property
    def best(self) -> Belief:
        """The belief of the heaviest hypothesis."""
        return self.hypotheses[0].belief

    @property
    def overall(self) -> Belief:
        """Mean and covariance of the mixture of all hypotheses."""
        weights = np.array([one.weight for one in self.hypotheses])
        return mix(weights / weights.sum(), [one.belief for one in self.hypotheses])

    @property
    def estimate(self) -> Belief:
        """The best mean, and the covariance of its error over all hypotheses."""
        mean, overall = self.best.mean, self.overall
        off = mean - overall.mean
        return Belief(mean, overall.covariance + np.outer(off, off))


def _require_class(given: object, kind: type, subject: str) -> None:
    """Raise SettingsError, which begins with ``subject``, unless an object is a ``kind``."""
    if not isinstance(given, kind):
        raise SettingsError(f"{subject} {kind.__name__}, not {type(given).__name__}")


class TruncatedFilter:
    """A Kalman filter for nonlinear measurements whose belief stays inside linear inequalities.

    It follows Shimada, Shirai, Kuno and Miura, sections 4 and 5, with three differences, each of
    which ``FilterSettings`` can undo. All rows are truncated at once. Measurements are linearised
    over the truncated belief. With "joint" the next step is predicted from the belief without its
    limits: these would otherwise count again in each step and make the filter overconfident.

    Args:
        layout: the elements of the state.
        observation: the measurement of the state, if ``update`` gets none.
        inequalities: limits of any elements of the state.
        motion: the state's motion over one step.
        settings: None: FilterSettings().

    Attributes:
        novelty: of the settings, or 0 if the truncation does not support static views.

    Raises:
        SettingsError: rows exclude each other, the process noise is indefinite, or a model or
            settings have the wrong type or shape.
        UnknownNameError: an inequality uses an element that the state lacks.
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
        self._rows = merge_rows(self.inequalities)
        self._checked = False
        self._set(FilterSettings() if settings is None else settings)

    def _set(self, settings: FilterSettings) -> None:
        """Store settings and what follows from them."""
        _require_class(settings, FilterSettings, "a filter's settings are")
        self.settings = settings
        # Offsets of a static view cannot be kept if the truncated belief is fed back.
        feeds_back = settings.truncation == "sequential"
        self.novelty = 0.0 if feeds_back else settings.novelty
        self._remainder_weight = 0.0
        if settings.linearisation == "spread":
            # A step of unknown duration counts as 1/30 s.
            self._remainder_weight = max(1.0, settings.persistence / (self.motion.period or 1 / 30))
        is_free = settings.truncation == "none" or not self.inequalities
        self._limits: Truncate | None = None if is_free else self._truncate

    def with_settings(self, settings: FilterSettings) -> "TruncatedFilter":
        """Return the same filter with other settings; it can continue from states of this one."""
        if settings is self.settings:
            return self
        other = copy(self)
        other._set(settings)
        return other

    def start(self, belief: Belief) -> FilterState:
        """Return the state of one hypothesis before the first measurement.

        Its belief is the given one, truncated unless ``FilterSettings.truncation`` is "none".

        The first call compares the models' Jacobians with central differences at the belief's mean.

        Raises:
            SettingsError: the belief has the wrong size or is indefinite, or a Jacobian is wrong.
        """
        _require_class(belief, Belief, "a filter starts at a")
        checked = make_belief(belief.mean, belief.covariance, self.layout)
        truncated = self._cut(checked, np.zeros((0, 2)))
        if not self._checked:
            names, model, motion = self.layout.names, self.observation, self.motion
            require_jacobian(
                model.predict, truncated.mean, model.names, names, model.wraps, "the observation"
            )
            if not isinstance(motion, LinearMotion):
                no_angles = np.zeros(len(names), dtype=np.bool_)
                require_jacobian(
                    motion.predict, truncated.mean, names, names, no_angles, "the motion"
                )
            self._checked = True
        return FilterState(
            0, (self._finish(Hypothesis(checked, checked), checked, truncated, 0.0),)
        )

    def predict(self, state: FilterState) -> FilterState:
        """Return the state whose hypotheses have made one step of the motion: (6)."""
        stepped = []
        for h in state.hypotheses:
            # Linearised inside the limits, also for the belief without limits.
            step = self._step(h.belief)
            U = self._U
            if self._remainder_weight and self._limits:
                moving = len(self.layout.moving)
                U = U + stopped_rates(after_step(h.belief, step, U), self.inequalities, moving)
            repeated = h.repeated.after_step(step, U) if h.repeated else None
            free = repeated.state() if repeated else after_step(h.free, step, U)
            belief = after_step(h.belief, step, U)
            stepped.append(replace(h, belief=belief, free=free, repeated=repeated))
        return replace(state, hypotheses=tuple(stepped), rejections=())

    def predict_belief(self, belief: Belief) -> Belief:
        """Return a belief after one step of the motion: (6)."""
        return after_step(belief, self._step(belief), self._U)

    def _step(self, belief: Belief) -> Linear:
        """Return the motion linearised at a belief, or over it with "spread"."""
        return step_from(self.motion, belief, self._remainder_weight > 0)

    def estimate_roughly(
        self, prediction: Belief, y: Array, variances: Array, start: Array
    ) -> Array:
        """Return a rough state (n,): the truncated mean of ``prediction`` after a measurement.

        ``prediction``: the belief before the measurement. ``y``, ``variances``: as in ``update``.
        ``start``: (n,) where to linearise first.
        """
        measurement = make_measurement(self.observation, y, variances)
        few = min(self.settings.iterations, self.settings.rough_iterations)
        limits, weight = self._limits, self._remainder_weight
        rough = update(prediction, measurement, few, start, False, limits, remainder_weight=weight)
        return rough.truncated.mean

    def update(
        self,
        state: FilterState,
        y: Array,
        observation: ObservationModel | None = None,
        variances: Array | None = None,
    ) -> FilterState:
        """Return the state after a measurement: section 5, steps 2 to 6.

        Each hypothesis is updated, in a new view also from its mirrored states, and truncated.
        Hypotheses far beyond a limit are rejected, duplicates merged, and light ones removed.

        Args:
            state: the predicted state.
            y: (m,) measurement, NaN where occluded.
            observation: the measurement's model; None: that of the filter.
            variances: noise variances (m,) or covariance (m, m) of this measurement, finite where y
                is; None: the model's.

        Raises:
            SettingsError: the measurement does not fit the model.
        """
        step, settings = state.step + 1, self.settings
        measurement = make_measurement(observation or self.observation, y, variances)
        view = next_view(state.view, measurement, self.novelty)
        if view[1] > 1:
            branches = [self._repeat(h, measurement) for h in state.hypotheses]
        else:
            numbers = count()
            branches = [
                b for h in state.hypotheses for b in self._branches(h, measurement, step, numbers)
            ]
            branches = self._split(branches, measurement)
        alive, rejected = self._reject(branches, step)
        finished = [
            self._finish(h, done.belief, done.truncated, done.log_likelihood) for h, done in alive
        ]
        leader = max(range(len(finished)), key=lambda i: finished[i].log_weight)
        if self._remainder_weight:
            least = finished[leader].log_weight + math.log(_LIGHT)
            finished = [one for one in finished if one.log_weight > least]
        kept, merged = reduce_mixture(finished, settings.hypothesis_cap, step)
        best = alive[leader][1]
        return FilterState(step, tuple(kept), (*rejected, *merged), best.distance, best.count, view)

    def _branches(
        self, hypothesis: Hypothesis, measurement: Measurement, step: int, numbers: Iterator[int]
    ) -> list[Branch]:
        """Update a predicted hypothesis, linearised at its own mean and at each mirrored one.

        ``hypothesis``: the prediction. ``measurement``: of a new view. ``step``: number of the
        step. ``numbers``: counts the mirrored hypotheses of this step.

        Returns one branch for the hypothesis, then one for each mirrored state.
        """
        own = replace(hypothesis, repeated=None)
        starts = [(own, own.belief.mean)]
        if self.settings.hypothesis_cap > 1:
            for start in measurement.model.mirrors(own.belief):
                starts.append((replace(own, born=step, number=next(numbers)), start))
        # A belief wide enough to include its mirrored state would mix the two, so that each is
        # linearised at its own start.
        alone = self._remainder_weight > 0 and len(starts) == 1
        return [
            (h, self._linearise(h, measurement, None if alone else start, h is own))
            for h, start in starts
        ]

    def _linearise(
        self, h: Hypothesis, measurement: Measurement, start: Array | None, tempered: bool = True
    ) -> Updated:
        """Update a predicted hypothesis, linearised at ``start``; None: over its belief."""
        iterations, weight = self.settings.iterations, self._remainder_weight
        if weight and start is not None:
            iterations = max(iterations, self.settings.rough_iterations)
        done = update(
            h.free, measurement, iterations, start, tempered, self._limits, h.sites, weight
        )
        if start is None and done.bend > 1.0 and iterations < self.settings.rough_iterations:
            iterations = self.settings.rough_iterations
            return update(
                h.free, measurement, iterations, None, True, self._limits, h.sites, weight
            )
        return done

    def _split(self, branches: list[Branch], measurement: Measurement) -> list[Branch]:
        """Split hypotheses over which the measurement is too curved for one normal distribution.

        That is, the variance of the linearisation error exceeds that of the noise.
        The heaviest is split first, into slices across the direction that matters most. They cover
        all of it: also look-alikes that a linearisation at its mean would not find. (Alspach and
        Sorenson's Gaussian sum filter, 1972, with as many parts as the measurement requires.)
        """
        cap, done = self.settings.hypothesis_cap, list(branches)
        while cap > 1 and len(done) < 5 * cap:
            logs = np.array([
                h.log_evidence + one.log_likelihood + one.truncated.log_probability
                for h, one in done
            ])  # fmt: skip
            curved = np.array([one.bend > 1.0 for _, one in done])
            curved &= logs > logs.max() + math.log(_LIGHT)
            if not curved.any():
                break
            h, wide = done.pop(int(np.argmax(np.where(curved, logs, -np.inf))))
            for log_weight, part in slices(h.free, wide):
                own = replace(h, free=part, log_evidence=h.log_evidence + log_weight)
                done.append((own, self._linearise(own, measurement, None)))
        return done

    def _repeat(self, hypothesis: Hypothesis, measurement: Measurement) -> Branch:
        """Update a predicted hypothesis by a measurement of another frame of its static view.

        The measurement is linearised where the view's first frame was. Returns the hypothesis with
        the view's belief, and the update.
        """
        repeated = hypothesis.repeated
        if repeated is None:
            repeated = begin_repeated_view(
                measurement.model, hypothesis.free, hypothesis.belief, hypothesis.tangent
            )
        tangent = measurement._replace(
            model=anchored_observation(measurement.model, repeated.tangent)
        )
        updated = update(repeated.belief, tangent)
        repeated = replace(repeated, belief=updated.belief)
        belief = repeated.state()
        truncated = self._cut(belief, hypothesis.sites)
        updated = replace(updated, belief=belief, truncated=truncated)
        return replace(hypothesis, repeated=repeated), updated

    def _reject(
        self, branches: Sequence[Branch], step: int
    ) -> tuple[list[Branch], list[Rejection]]:
        """Remove branches whose mean is far beyond a row, but never all: section 5, step 5.

        Returns:
            The branches that are kept, and the rejections, with the number ``step``.
        """
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
        self, hypothesis: Hypothesis, free: Belief, result: Truncated, log_likelihood: float
    ) -> Hypothesis:
        """Return a hypothesis after its update, weighted by the likelihood and by the limits.

        ``hypothesis``: before the update. ``free``: the updated belief without limits. ``result``:
        the updated belief inside the limits. ``log_likelihood``: of the measurement.
        """
        active = tuple(self.inequalities.rows[k] for k in np.flatnonzero(result.active))
        belief = Belief(result.mean, result.covariance)
        evidence = hypothesis.log_evidence + log_likelihood
        weight = evidence + result.log_probability
        if self.settings.truncation != "joint":
            # As in the paper, the next step is predicted from the truncated belief.
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
        """Truncate a belief by the limits, if there are any; ``sites`` (S, 2) start the EP."""
        return untruncated(belief) if self._limits is None else self._limits(belief, sites)

    def _truncate(self, belief: Belief, sites: Array) -> Truncated:
        """Truncate a belief by the limits in the settings' way; ``sites`` (S, 2) start "joint"."""
        if self.settings.truncation == "sequential":
            return truncate_sequential(belief, self.inequalities)
        return truncate_joint(belief, self._rows, start=sites)
