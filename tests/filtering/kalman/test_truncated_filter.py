import numpy as np
import pytest
from scipy.stats import multivariate_normal

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.inequalities import from_bounds, stack, two_sided
from drake_pose.filtering.motion import LinearMotion
from drake_pose.filtering.state import Belief, StateLayout, covariance_from, factor_of, make_belief
from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.filtering.truncated_normal import truncate_joint
from drake_pose.filtering.update import make_measurement, update

ONE_TURN = from_bounds(["angle"], [0], [1])
BEYOND_IT = two_sided(["angle"], "stop", [1.0], 2.0, np.inf)
NAN = np.full((3, 3), np.nan)
LAYOUT = StateLayout(("angle",), ("length",))
NAMES = LAYOUT.names  # angle, rate_angle, length


class Segment:
    """A segment in the image plane, with its end at length * (cos, sin) of the angle.

    With ``depth_only`` its end's height alone is seen: length * cos(angle), the same at -angle.
    """

    def __init__(self, depth_only=False, deviation=0.01):
        self.depth_only = depth_only
        self.names = ("u",) if depth_only else ("u", "v")
        self.variances = np.full(len(self.names), deviation**2)
        self.wraps = np.zeros(len(self.names), dtype=bool)

    def predict(self, x):
        angle, _, length = x
        h = length * np.array([np.cos(angle), np.sin(angle)])
        H = np.zeros((2, 3))
        H[:, 0] = length * np.array([-np.sin(angle), np.cos(angle)])
        H[:, 2] = np.cos(angle), np.sin(angle)
        return h[: len(self.names)], H[: len(self.names)]

    def mirrors(self, belief):
        """Return the state with the angle mirrored, if only the height is measured."""
        if not self.depth_only or abs(belief.mean[0]) < 0.02:
            return []
        mirrored = belief.mean.copy()
        mirrored[0] *= -1
        return [mirrored]


class Linear:
    names = ("a", "b")
    variances = np.array([0.5, 2.0])
    wraps = np.zeros(2, dtype=bool)
    H = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -1.0]])
    calls = 0

    def predict(self, x):
        self.calls += 1
        return self.H @ x, self.H

    def mirrors(self, belief):
        return []


def random_belief(seed):
    generator = np.random.default_rng(seed)
    A = generator.normal(size=(3, 3))
    return make_belief(generator.normal(size=3), A @ A.T + 0.1 * np.eye(3))


TOGETHER = np.array([[0.3, 0.25], [0.25, 0.3]])


@pytest.mark.parametrize("R", [None, TOGETHER], ids=["each by itself", "together"])
@pytest.mark.parametrize("iterations", [1, 10])
def test_linear_update_equals_the_information_form(iterations, R):
    """With independent or correlated noise."""
    noise = np.diag(Linear.variances) if R is None else R
    H, y = Linear.H, np.array([1.0, -2.0])
    for seed in range(5):
        prior, model = random_belief(seed), Linear()
        result = update(prior, make_measurement(model, y, R), iterations)
        # For a linear measurement the second iteration changes nothing.
        assert R is not None or model.calls <= 2
        information = np.linalg.inv(prior.covariance) + H.T @ np.linalg.inv(noise) @ H
        vector = np.linalg.solve(prior.covariance, prior.mean) + H.T @ np.linalg.solve(noise, y)
        mean, covariance = np.linalg.solve(information, vector), np.linalg.inv(information)
        np.testing.assert_allclose(result.belief.mean, mean, atol=1e-9)
        np.testing.assert_allclose(result.belief.covariance, covariance, atol=1e-9)
        expected = multivariate_normal.logpdf(y, H @ prior.mean, H @ prior.covariance @ H.T + noise)
        assert result.log_likelihood == pytest.approx(expected)


def test_occluded_measurements_are_ignored():
    prior = random_belief(1)
    one = update(prior, make_measurement(Linear(), np.array([1.0, np.nan])))
    assert one.count == 1
    nothing = update(prior, make_measurement(Linear(), np.full(2, np.nan)))
    np.testing.assert_allclose(nothing.belief.covariance, prior.covariance, atol=1e-12)
    np.testing.assert_allclose(nothing.belief.mean, prior.mean)


def test_iteration_finds_the_posterior_mode():
    model = Segment()
    prior = Belief(np.array([0.2, 0.0, 1.0]), np.diag([1.0, 0.1, 0.3]))
    y = np.array([0.3, 1.1])

    def cost(x):
        r = (y - model.predict(x)[0]) / 0.01
        return r @ r + (x - prior.mean) ** 2 @ (1 / np.diag(prior.covariance))

    seen = make_measurement(model, y)
    result = update(prior, seen, iterations=20)
    best = cost(result.belief.mean)
    generator = np.random.default_rng(0)
    for size in (1e-1, 1e-2, 1e-3):
        for step in generator.normal(size=(200, 3)) * size:
            assert cost(result.belief.mean + step) > best - 1e-3
    assert cost(update(prior, seen).belief.mean) > best + 10
    # Annealing leads to the same mode.
    untempered = update(prior, seen, iterations=20, tempered=False)
    np.testing.assert_allclose(untempered.belief.mean, result.belief.mean, atol=1e-6)
    assert result.distance == pytest.approx(best, rel=1e-3)


def test_covariances_stay_positive_definite_for_nearly_exact_measurements():
    model = Segment(deviation=1e-9)
    belief = Belief(np.array([0.2, 0.0, 1.0]), np.diag([1e4, 1e2, 1e4]))
    seen = make_measurement(model, np.array([np.cos(0.3), np.sin(0.3)]))
    for _ in range(20):
        belief = update(belief, seen, 10).belief
        np.testing.assert_array_equal(belief.covariance, belief.covariance.T)
        assert np.linalg.eigvalsh(belief.covariance).min() > -1e-12
        assert (belief.deviations() > 0).all()


def make_filter(model=None, rows=None, noise=None, **settings):
    rows = rows or from_bounds(["angle", "length"], [0.0, 0.5], [1.5, 1.5])
    noise = LAYOUT.process_noise({"angle": 0.02}) if noise is None else noise
    motion = LinearMotion(LAYOUT.transition(), noise, None)
    return TruncatedFilter(LAYOUT, model or Segment(), rows, motion, FilterSettings(**settings))


@pytest.mark.parametrize("truncation", ["joint", "sequential"])
def test_estimates_stay_inside_the_limits_except_without_truncation(truncation):
    """A segment swings against its limit; noise would move the estimate beyond."""
    generator = np.random.default_rng(3)
    hand = make_filter(Segment(deviation=0.2), truncation=truncation)
    plain = make_filter(Segment(deviation=0.2), truncation="none")
    start = Belief(np.array([0.3, 0.0, 1.0]), np.diag([0.5, 0.01, 0.2]))
    states = [hand.start(start), plain.start(start)]
    beyond = 0
    for _ in range(60):
        y = np.array([1.0, 0.0]) + 0.2 * generator.normal(size=2)
        states = [f.update(f.predict(s), y) for f, s in zip((hand, plain), states, strict=True)]
        assert (hand.inequalities.margins(states[0].best.mean) > -1e-9).all()
        beyond += (plain.inequalities.margins(states[1].best.mean) < 0).any()
    assert beyond > 10
    assert states[0].hypotheses[0].active


def test_weights_sum_to_one_and_the_cap_holds():
    rows = from_bounds(["angle", "length"], [-1.5, 0.9], [1.5, 1.1])
    f = make_filter(Segment(depth_only=True, deviation=0.002), rows, hypothesis_cap=2)
    state = f.start(Belief(np.array([0.3, 0.0, 1.0]), np.diag([0.2, 1e-3, 1e-6])))
    for _ in range(10):
        state = f.update(f.predict(state), np.array([np.cos(0.4)]))
        assert sum(h.weight for h in state.hypotheses) == pytest.approx(1.0)
        assert len(state.hypotheses) <= 2
    assert len(state.hypotheses) == 2
    angles = sorted(h.belief.mean[0] for h in state.hypotheses)
    np.testing.assert_allclose(angles, [-0.4, 0.4], atol=0.05)
    # Both hypotheses are equally likely, so their mixture is wide.
    assert state.overall.deviations()[0] > 0.3 > 5 * state.best.deviations()[0]
    assert make_filter(hypothesis_cap=1).update(state, np.full(2, np.nan)).hypotheses


def test_mirrored_hypotheses_beyond_a_limit_are_rejected():
    """Section 5: the mirrored angle is negative, far beyond the limit at zero."""
    rows = from_bounds(["angle", "length"], [0.0, 0.9], [1.5, 1.1])
    paper = {"truncation": "sequential", "linearisation": "tangent", "iterations": 1}
    f = make_filter(Segment(depth_only=True, deviation=0.002), rows, **paper)
    state = f.start(Belief(np.array([0.4, 0.0, 1.0]), np.diag([0.02, 1e-3, 1e-6])))
    state = f.update(f.predict(state), np.array([np.cos(0.4)]))
    (gone,) = state.rejections
    assert (gone.reason, gone.row, gone.hypothesis.born) == ("constraint", "angle >= 0", 1)
    assert gone.c < -4.0
    assert gone.hypothesis.belief.mean[0] == pytest.approx(-0.4, abs=0.05)
    assert state.best.mean[0] == pytest.approx(0.4, abs=0.05)


def test_limits_of_a_constant_count_once():
    """Without measurements the belief about the length does not change with the steps."""
    f = make_filter(rows=from_bounds(["length"], [0.9], [1.1]))
    start = Belief(np.array([0.0, 0.0, 1.05]), np.diag([0.1, 0.01, 0.04]))
    state = f.start(start)
    once = truncate_joint(start, f.inequalities)
    for _ in range(30):
        state = f.update(f.predict(state), np.full(2, np.nan))
    assert state.best.mean[2] == pytest.approx(once.mean[2], abs=1e-6)
    assert state.best.covariance[2, 2] == pytest.approx(once.covariance[2, 2], rel=1e-4)
    paper = make_filter(rows=from_bounds(["length"], [0.9], [1.1]), truncation="sequential")
    shrinking = paper.start(start)
    for _ in range(30):
        shrinking = paper.update(paper.predict(shrinking), np.full(2, np.nan))
    assert shrinking.best.covariance[2, 2] < 0.5 * once.covariance[2, 2]


@pytest.mark.parametrize("rank", [1, 3, 5])
def test_covariance_from_is_positive_definite_and_equals_the_product(rank):
    """Also if the product is singular after rounding."""
    factor = np.random.default_rng(rank).normal(size=(5, rank))
    found = covariance_from(factor)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(found, factor @ factor.T, atol=1e-12)
    assert (np.diag(np.linalg.cholesky(found)) > 0.0).all()
    # The inverse: factor_of accepts semidefinite covariances.
    root = factor_of(factor @ factor.T, ())
    np.testing.assert_allclose(root @ root.T, factor @ factor.T, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: make_measurement(Linear(), np.zeros(3)), "has 2 measurements"),
        (lambda: make_measurement(Linear(), np.array([0, np.inf])), "'b' is infinite"),
        (lambda: make_measurement(Linear(), np.ones(2), np.array([1, -1])), "'b' must be positive"),
        (lambda: make_measurement(Linear(), np.ones(2), np.ones(3)), "has 2 measurements"),
        (lambda: make_belief([np.nan, 0], np.eye(2)), "'0' is NaN"),
        (lambda: make_belief([0, 0], [[1, np.inf], [np.inf, 1]]), "NaN or infinity"),
        (lambda: make_belief([0, 0], [[1, 0.5], [0, 1]]), "symmetric"),
        (lambda: make_belief([0, 0], np.eye(3)), "fit"),
        (lambda: make_belief([0, 0], [[1, 2], [2, 1]]), "indefinite"),
        (lambda: make_filter().start(Belief(np.zeros(3), NAN)), "'angle' is NaN"),
        (lambda: make_filter().start(Belief(np.ones(3), np.diag([1.0, 1, -1]))), "'length'"),
        (lambda: make_filter(truncation="x"), "truncation"),
        (lambda: make_filter(iterations=0), "iterations"),
        (lambda: make_filter(novelty=1.0), "novelty"),
        (lambda: LAYOUT.process_noise({"angle": -1.0}), "'angle'"),
        (lambda: LAYOUT.process_noise({}), "'angle'"),
        (lambda: LAYOUT.process_noise({"length": 1.0}), "length"),
        (lambda: StateLayout(("a", "a"), ()), "'a'"),
        (lambda: make_filter(noise=-np.eye(3)), "motion's noise: the covariance is indefinite"),
        (lambda: make_filter(rows=stack([ONE_TURN, BEYOND_IT])), "stop"),
        (lambda: make_filter(rows=from_bounds(["elbow"], [0], [1])), "elbow"),
    ],
)
def test_invalid_arguments_are_refused_by_name(make, word):
    with pytest.raises((SettingsError, UnknownNameError), match=word):
        make()
