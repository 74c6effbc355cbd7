"""The filter, compared with other filters, integration on a grid, and Monte Carlo."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.inequalities import from_bounds, stack, two_sided
from drake_pose.filtering.motion import FunctionMotion, LinearMotion
from drake_pose.filtering.state import Belief, StateLayout, mix
from drake_pose.filtering.truncated_filter import (
    FilterSettings,
    FilterState,
    Hypothesis,
    TruncatedFilter,
    normalise,
    reduce_mixture,
)
from drake_pose.filtering.truncated_normal import truncate_joint
from drake_pose.filtering.update import FunctionObservation
from tests.filtering.segment import (
    END,
    FREE,
    LAYOUT,
    START,
    STEP,
    Depth,
    draw,
    end_of,
    end_slope,
    follow,
    make_filter,
)

SLOPE = np.array([[1.0, 0.0, 0.5], [0.0, 0.0, -1.0]])
LINEAR = FunctionObservation(("a", "b"), [0.1, 0.3], lambda x: SLOPE @ x, lambda x: SLOPE)
PAPER = {"truncation": "sequential", "linearisation": "tangent"}


@pytest.mark.parametrize(
    ("observation", "settings"), [(LINEAR, {}), (END, {"linearisation": "tangent"})]
)
def test_without_limits_it_is_the_extended_kalman_filter(observation, settings):
    """Also if nothing, or only one value, is measured."""
    _, measured = draw(np.random.default_rng(1), observation)
    measured[5, 0], measured[8] = np.nan, np.nan
    x, P, A = START.mean, START.covariance, STEP.transition
    for t, (y, belief) in enumerate(
        zip(measured, follow(make_filter(observation, **settings), measured), strict=True)
    ):
        if t:
            x, P = A @ x, A @ P @ A.T + STEP.noise
        seen = np.isfinite(y)
        H = observation.jacobian(x)[seen]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(observation.variances[seen]))
        x, P = x + K @ (y - observation.function(x))[seen], P - K @ H @ P
        np.testing.assert_allclose(belief.mean, x, atol=1e-8)
        np.testing.assert_allclose(belief.covariance, P, atol=1e-8)


def test_nees_is_one_for_linearisation_over_the_belief():
    """By Monte Carlo: true states drawn from the initial belief, with a curved measurement."""
    wide = Belief(START.mean, np.diag([0.6, 0.3, 0.3]) ** 2)
    nees = {"spread": [], "tangent": []}
    for seed in range(60):
        states, measured = draw(np.random.default_rng(seed), END, 15, wide)
        for linearisation, values in nees.items():
            beliefs = follow(make_filter(linearisation=linearisation), measured, wide)
            for x, belief in zip(states, beliefs, strict=True):
                error = belief.mean - x
                values.append(error @ np.linalg.solve(belief.covariance, error) / 3)
    means = {name: np.mean(values) for name, values in nees.items()}
    assert means["spread"] == pytest.approx(1.0, abs=0.15)
    assert means["tangent"] > means["spread"] + 0.1


def test_a_ring_of_look_alikes_has_its_mixture():
    """Only the distance of a point is measured: the posterior is a ring, cut by limits."""
    layout = StateLayout((), ("x", "y"))
    far = FunctionObservation(("distance",), 0.1, lambda x: np.array([np.hypot(*x)]))
    still = LinearMotion(np.eye(2), np.zeros((2, 2)), 0.1)
    start = Belief(np.array([0.4, 0.1]), np.diag([0.7, 0.7]) ** 2)
    limits, settings = from_bounds(["x"], [-0.5], [2.0]), FilterSettings(hypothesis_cap=16)
    f = TruncatedFilter(layout, far, limits, still, settings)
    state = f.start(start)
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 2.0, 200), np.linspace(-2, 2, 320)), -1)
    log = -0.5 * (((grid - start.mean) / 0.7) ** 2).sum(axis=-1)
    for _ in range(3):
        state = f.update(state, np.array([1.0]))
        log -= 0.5 * ((np.hypot(*np.moveaxis(grid, -1, 0)) - 1.0) / 0.1) ** 2
    weights = np.exp(log).ravel()
    grid = grid.reshape(-1, 2)
    overall = state.overall
    np.testing.assert_allclose(overall.mean, np.average(grid, 0, weights), atol=0.05)
    np.testing.assert_allclose(overall.covariance, np.cov(grid.T, aweights=weights), atol=0.04)
    off = state.estimate.mean - overall.mean
    np.testing.assert_array_equal(state.estimate.mean, state.best.mean)
    np.testing.assert_allclose(state.estimate.covariance, overall.covariance + np.outer(off, off))
    logs = [one.log_weight for one in state.hypotheses]
    assert logs == sorted(logs, reverse=True)
    assert min(logs) > max(logs) + math.log(1e-6)
    assert 2 < len(logs) <= 16


def test_limits_stop_rates():
    """A joint that moves beyond its limit has been stopped; its rate is no longer known."""
    f = make_filter(rows=from_bounds(["angle"], [-0.2], [1.5]))
    for angle, is_free in ((0.5, True), (1.49, False)):
        before = f.start(Belief(np.array([angle, 3.0, 1.0]), np.diag([0.02, 0.1, 0.1]) ** 2))
        known = f.predict(before).best.deviations()[1]
        assert known < 0.5 if is_free else known == pytest.approx(3.0, rel=0.1)


LIMITS = from_bounds(["angle", "length"], [0.0, 0.5], [1.5, 1.5])


@pytest.mark.parametrize("truncation", ["joint", "sequential"])
def test_estimates_stay_inside_the_limits_except_without_truncation(truncation):
    """A segment swings against its limit; noise would move the estimate beyond."""
    generator, noisy = np.random.default_rng(3), FunctionObservation(("u", "v"), 0.2, end_of)
    filters = [make_filter(noisy, LIMITS, truncation=one) for one in (truncation, "none")]
    start = Belief(np.array([0.3, 0.0, 1.0]), np.diag([0.5, 0.01, 0.2]))
    states, beyond = [f.start(start) for f in filters], 0
    for _ in range(40):
        y = np.array([1.0, 0.0]) + 0.2 * generator.normal(size=2)
        states = [f.update(f.predict(s), y) for f, s in zip(filters, states, strict=True)]
        inside, free = (
            f.inequalities.margins(s.best.mean) for f, s in zip(filters, states, strict=True)
        )
        assert (inside > -1e-9).all()
        beyond += (free < 0).any()
    assert beyond > 5
    assert states[0].hypotheses[0].active == ("angle >= 0",)
    assert not states[1].hypotheses[0].active


def at_depth(rows, deviations, **settings):
    """Return the states after each of 6 measurements of the depth of a segment at 0.4 rad."""
    f = make_filter(
        Depth(),
        rows,
        LinearMotion(LAYOUT.transition(), 1e-4 * np.diag([1, 4, 0]), None),
        **settings,
    )
    state, found = f.start(Belief(np.array([0.35, 0.0, 1.0]), np.diag(deviations) ** 2)), []
    for _ in range(6):
        state = f.update(f.predict(state), np.array([np.cos(0.4)]))
        found.append(state)
    return found


def test_mirrored_hypotheses_are_equally_likely_and_capped():
    rows = from_bounds(["angle", "length"], [-1.5, 0.9], [1.5, 1.1])
    for cap in (1, 2):
        states = at_depth(rows, [0.5, 0.03, 1e-3], hypothesis_cap=cap, linearisation="tangent")
        for state in states:
            assert sum(h.weight for h in state.hypotheses) == pytest.approx(1.0)
            assert len(state.hypotheses) <= cap
        assert len(state.hypotheses) == cap
        angles = sorted(h.belief.mean[0] for h in state.hypotheses)
        np.testing.assert_allclose(angles, [-0.4, 0.4][-cap:], atol=0.05)
    first = states[0].hypotheses
    assert sorted((one.born, one.number) for one in first) == [(0, 0), (1, 0)]
    # Their mixture is wide.
    assert state.overall.deviations()[0] > 0.3 > 5 * state.best.deviations()[0]


def test_mirrored_hypotheses_beyond_a_limit_are_rejected():
    """Section 5: the mirrored angle is negative, far beyond the limit at zero."""
    rows = from_bounds(["angle", "length"], [0.0, 0.9], [1.5, 1.1])
    state = at_depth(rows, [0.14, 0.03, 1e-3], **PAPER)[0]
    (gone,) = state.rejections
    assert (gone.step, gone.reason, gone.row) == (1, "constraint", "angle >= 0")
    assert (gone.hypothesis.born, gone.hypothesis.number) == (1, 0)
    assert gone.c < -4.0
    assert gone.hypothesis.belief.mean[0] == pytest.approx(-0.4, abs=0.05)
    assert state.best.mean[0] == pytest.approx(0.4, abs=0.05)
    kept = at_depth(rows, [0.14, 0.03, 1e-3], rejected_below=gone.c - 0.1, **PAPER)[0]
    assert not kept.rejections
    # If all are beyond, the nearest stays.
    narrow = from_bounds(["angle"], [1.2], [1.5])
    all_beyond = at_depth(narrow, [0.14, 0.03, 1e-3], **PAPER)[0]
    assert len(all_beyond.hypotheses) == 1
    assert all_beyond.best.mean[0] == pytest.approx(1.2, abs=0.05)
    assert [one.hypothesis.born for one in all_beyond.rejections] == [1]


def test_limits_of_a_constant_count_once():
    """Without measurements the belief about the length does not change with the steps."""
    start = Belief(np.array([0.0, 0.0, 1.05]), np.diag([0.1, 0.01, 0.04]))
    rows, ends = from_bounds(["length"], [0.9], [1.1]), []
    for settings in ({}, PAPER):
        f = make_filter(rows=rows, **settings)
        state = f.start(start)
        for _ in range(30):
            state = f.update(f.predict(state), np.full(2, np.nan))
        ends.append(state.best)
    once = truncate_joint(start, rows.for_columns(LAYOUT.names))
    assert ends[0].mean[2] == pytest.approx(once.mean[2], abs=1e-6)
    assert ends[0].covariance[2, 2] == pytest.approx(once.covariance[2, 2], rel=1e-4)
    # As in the paper, they count in each step.
    assert ends[1].covariance[2, 2] < 0.5 * once.covariance[2, 2]


@pytest.mark.parametrize("truncation", ["joint", "sequential"])
def test_a_static_view_keeps_its_offsets_unless_the_truncation_feeds_back(truncation):
    f = make_filter(rows=LIMITS, novelty=1e-9, truncation=truncation)
    y, state = end_of(START.mean), f.start(START)
    for _ in range(100):
        state = f.update(f.predict(state), y)
    assert f.novelty == (1e-9 if truncation == "joint" else 0.0)
    is_kept = truncation == "joint"
    assert state.view[1] == (100 if is_kept else 1)
    assert (state.hypotheses[0].repeated is not None) == is_kept
    moved = f.update(f.predict(state), y + 1.0)
    assert moved.view[1] == 1
    assert moved.hypotheses[0].repeated is None
    # The linearisation error does not average away.
    anew = follow(make_filter(rows=LIMITS, truncation=truncation, persistence=0.0), [y] * 100)[-1]
    if is_kept:
        assert state.best.deviations()[2] > anew.deviations()[2]


def test_persistence_counts_the_linearisation_error_for_as_many_frames():
    """A step of unknown duration counts as 1/30 s."""
    y, wide = end_of(START.mean), Belief(START.mean, 9.0 * START.covariance)

    def variance(persistence, period=0.1):
        motion = replace(STEP, period=period)
        f = make_filter(motion=motion, persistence=persistence, hypothesis_cap=1)
        return f.update(f.start(wide), y).best.covariance[2, 2]

    assert variance(0.0) == variance(0.1) < variance(0.2) < variance(0.4)
    assert variance(4 / 30, None) == pytest.approx(variance(0.4))


def test_other_settings_continue_from_the_same_state():
    y = end_of(START.mean)
    one, other = make_filter(), make_filter(**PAPER)
    state = one.update(one.start(START), y)
    assert one.with_settings(one.settings) is one
    changed = one.with_settings(other.settings)
    found, expected = (f.update(f.predict(state), y).best for f in (changed, other))
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert np.abs(found.covariance - one.update(one.predict(state), y).best.covariance).max() > 0


def test_a_rough_estimate_is_the_mean_after_a_few_linearisations():
    y, noise = end_of([0.9, 0.0, 1.2]), END.variances
    for settings in ({"iterations": 9, "rough_iterations": 2}, {"iterations": 2}):
        f = make_filter(rows=LIMITS, linearisation="tangent", **settings)
        found = f.estimate_roughly(START, y, noise, np.array([0.2, 0.0, 0.9]))
        twice, start = START, np.array([0.2, 0.0, 0.9])
        for _ in range(2):
            H = end_slope(start)
            K = START.covariance @ H.T @ np.linalg.inv(H @ START.covariance @ H.T + np.diag(noise))
            start = START.mean + K @ (y - end_of(start) - H @ (START.mean - start))
            twice = Belief(start, START.covariance - K @ H @ START.covariance)
            start = truncate_joint(twice, f.inequalities).mean
        np.testing.assert_allclose(found, start, atol=1e-6)


def hypothesis(generator, log_weight):
    root = generator.normal(size=(2, 2))
    belief = Belief(generator.normal(size=2), root @ root.T + 0.1 * np.eye(2))
    return Hypothesis(belief, belief, log_weight, log_weight - 2.0)


def difference(one, other):
    """Return the Kullback-Leibler divergence that bounds the change by a merger of equal weight."""
    both = mix(np.array([0.5, 0.5]), (one.belief, other.belief)).covariance
    own = [np.linalg.slogdet(h.belief.covariance)[1] for h in (one, other)]
    return np.linalg.slogdet(both)[1] - 0.5 * sum(own)


def scaled(one, size, common):
    belief = Belief(size * one.belief.mean, size**2 * one.belief.covariance)
    logs = {k: getattr(one, k) + common for k in ("log_weight", "log_evidence")}
    return replace(one, belief=belief, free=belief, **logs)


@pytest.mark.parametrize(("size", "common"), [(1.0, 0.0), (1e-7, -800.0), (9.0, 800.0)])
def test_mixtures_are_reduced_by_the_cheapest_mergers(size, common):
    """Compared with brute force; moments and weights are kept, at any scale of the state."""
    for seed in range(4):
        generator = np.random.default_rng(seed)
        some = [hypothesis(generator, log) for log in generator.uniform(-4.0, 0.0, 7)]
        near = Belief(some[0].belief.mean + 0.02, some[0].belief.covariance)
        some.append(replace(some[0], belief=near, free=near))
        kept, rejected = reduce_mixture([scaled(one, size, common) for one in some], 3, 7)
        rest, reasons = normalise(some), []
        assert sum(one.weight for one in rest) == pytest.approx(1.0)
        while len(rest) > 3 or reasons == []:
            pairs = [(i, j) for i in range(len(rest)) for j in range(i)]
            apart = {pair: difference(*(rest[k] for k in pair)) for pair in pairs}
            cost = {p: apart[p] * min(rest[k].weight for k in p) for p in pairs}
            cost = apart if min(apart.values()) < 0.02 else cost
            pair = min(cost, key=cost.get)
            light, heavy = sorted((rest[k] for k in pair), key=lambda one: one.log_weight)
            reasons.append("twin" if apart[pair] < 0.02 else "cap")
            rest = [one for k, one in enumerate(rest) if k not in pair]
            rest.append(heavy.merged_with(light))
        assert [(one.step, one.reason) for one in rejected] == [(7, one) for one in reasons]
        assert reasons[0] == "twin"
        for one, other in zip(kept, normalise(rest), strict=True):
            np.testing.assert_allclose(one.belief.mean, size * other.belief.mean)
            np.testing.assert_allclose(one.belief.covariance, size**2 * other.belief.covariance)
            assert one.log_weight == pytest.approx(other.log_weight)
            assert one.log_evidence == pytest.approx(other.log_weight - 2.0)
        before, after = (FilterState(0, tuple(each)).overall for each in (normalise(some), kept))
        np.testing.assert_allclose(after.mean, size * before.mean)
        np.testing.assert_allclose(after.covariance, size**2 * before.covariance, atol=1e-12)


ONE_TURN = from_bounds(["angle"], [0], [1])
BEYOND_IT = two_sided(["angle"], "stop", [1.0], 2.0, np.inf)
WRONG_SLOPE = FunctionObservation(("u", "v"), 1.0, end_of, lambda x: -end_slope(x))
WRONG_STEP = FunctionMotion(np.sin, STEP.noise, 0.1, lambda x: np.eye(3))
SHORT_STEP = FunctionMotion(lambda x: x[:2], STEP.noise, 0.1)
NEGATIVE = LinearMotion(np.eye(3), -np.eye(3), 0.1)
NAN = Belief(np.zeros(3), np.full((3, 3), np.nan))


@pytest.mark.parametrize(
    ("act", "word"),
    [
        (lambda: make_filter(WRONG_SLOPE).start(START), "observation: .* of 'u' by 'angle'"),
        (lambda: make_filter(motion=WRONG_STEP).start(START), "motion: .* of 'angle' by 'angle'"),
        (lambda: make_filter(motion=SHORT_STEP).start(START), r"the motion gives values \(2,\)"),
        (lambda: TruncatedFilter(LAYOUT, END, FREE, STEP, {}), "FilterSettings, not dict"),
        (lambda: TruncatedFilter(("angle",), END, FREE, STEP), "StateLayout, not tuple"),
        (lambda: TruncatedFilter(LAYOUT, END, [], STEP), "Inequalities, not list"),
        (lambda: make_filter().start((START.mean, START.covariance)), "a Belief, not tuple"),
        (lambda: make_filter().start(Belief(np.zeros(2), np.eye(2))), "3 elements"),
        (lambda: make_filter().start(NAN), "'angle' is NaN"),
        (lambda: make_filter(truncation="x"), "truncation"),
        (lambda: make_filter(linearisation="straight"), "spread, tangent"),
        (lambda: make_filter(iterations=0), "iterations"),
        (lambda: make_filter(hypothesis_cap=0), "hypothesis_cap"),
        (lambda: make_filter(persistence=-1.0), "persistence"),
        (lambda: make_filter(persistence=math.inf), "persistence"),
        (lambda: make_filter(novelty=1.0), "novelty"),
        (lambda: make_filter(novelty=-1e-9), "novelty"),
        (lambda: make_filter(motion=NEGATIVE), "motion's noise: the covariance is indefinite"),
        (lambda: make_filter(rows=stack([ONE_TURN, BEYOND_IT])), "stop"),
        (lambda: make_filter(rows=from_bounds(["elbow"], [0], [1])), "elbow"),
    ],
)
def test_invalid_arguments_are_refused_by_name(act, word):
    with pytest.raises((SettingsError, UnknownNameError), match=word):
        act()
