"""Measurement updates, compared with closed forms in numpy and with brute force."""

import math

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.inequalities import from_bounds
from drake_pose.filtering.state import Belief, Linear
from drake_pose.filtering.truncated_normal import truncate_joint
from drake_pose.filtering.update import (
    FunctionObservation,
    LinearObservation,
    RepeatedView,
    after_step,
    anchored_observation,
    begin_repeated_view,
    make_measurement,
    next_view,
    slices,
    update,
)
from tests.filtering.segment import END, START, end_of, end_slope

H = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -1.0]])
LINEAR = LinearObservation(
    ("a", "b"), np.array([0.5, 2.0]), np.zeros(2, dtype=bool), np.ones(3), H @ np.ones(3), H
)
TOGETHER = np.array([[0.3, 0.25], [0.25, 0.3]])


def random_belief(seed):
    generator = np.random.default_rng(seed)
    A = generator.normal(size=(3, 3))
    return Belief(generator.normal(size=3), A @ A.T + 0.1 * np.eye(3))


@pytest.mark.parametrize("R", [None, TOGETHER, np.array([0.1, 4.0])], ids=["own", "(2, 2)", "(2,)"])
@pytest.mark.parametrize("iterations", [1, 10])
def test_linear_update_equals_the_information_form(iterations, R):
    noise = np.diag(LINEAR.variances) if R is None else np.diag(R) if R.ndim == 1 else R
    y = np.array([1.0, -2.0])
    for seed in range(3):
        prior = random_belief(seed)
        result = update(prior, make_measurement(LINEAR, y, R), iterations)
        information = np.linalg.inv(prior.covariance) + H.T @ np.linalg.inv(noise) @ H
        vector = np.linalg.solve(prior.covariance, prior.mean) + H.T @ np.linalg.solve(noise, y)
        mean, covariance = np.linalg.solve(information, vector), np.linalg.inv(information)
        np.testing.assert_allclose(result.belief.mean, mean, atol=1e-9)
        np.testing.assert_allclose(result.belief.covariance, covariance, atol=1e-9)
        S = H @ prior.covariance @ H.T + noise
        expected = multivariate_normal.logpdf(y, H @ prior.mean, S)
        assert result.log_likelihood == pytest.approx(expected)
        off = y - H @ prior.mean
        assert result.distance == pytest.approx(off @ np.linalg.solve(S, off))
        assert (result.count, result.bend) == (2, 0.0)


def test_hidden_measurements_are_ignored():
    prior, R = random_belief(1), np.array([[0.3, np.nan], [np.nan, np.nan]])
    given = make_measurement(LINEAR, np.ones(2), R)
    np.testing.assert_array_equal(given.y, [1.0, np.nan])
    np.testing.assert_array_equal(given.covariance, [[0.3, 0.0], [0.0, 2.0]])
    one, other = (update(prior, make_measurement(LINEAR, np.array([1.0, y]), np.diag([0.3, v])))
                  for y, v in ((np.nan, 2.0), (0.0, 1e12)))  # fmt: skip
    np.testing.assert_allclose(update(prior, given).belief.mean, one.belief.mean)
    np.testing.assert_allclose(one.belief.mean, other.belief.mean, atol=1e-9)
    assert (one.count, other.count) == (1, 2)
    nothing = update(prior, make_measurement(LINEAR, np.full(2, np.nan)), 5, remainder_weight=2.0)
    np.testing.assert_array_equal(nothing.belief.covariance, prior.covariance)
    assert (nothing.count, nothing.distance, nothing.log_likelihood) == (0, 0.0, 0.0)


def test_covariances_stay_definite_for_nearly_exact_measurements():
    sharp = FunctionObservation(("u", "v"), 1e-9, end_of, end_slope)
    belief = Belief(np.array([0.2, 0.0, 1.0]), np.diag([1e4, 1e2, 1e4]))
    seen = make_measurement(sharp, np.array([np.cos(0.3), np.sin(0.3)]))
    for _ in range(20):
        belief = update(belief, seen, 10).belief
        np.testing.assert_array_equal(belief.covariance, belief.covariance.T)
        assert np.linalg.eigvalsh(belief.covariance).min() > -1e-12
        assert (belief.deviations() > 0).all()


def test_iteration_finds_the_posterior_mode():
    prior, y = Belief(np.array([0.2, 0.0, 1.0]), np.diag([1.0, 0.1, 0.3])), np.array([0.3, 1.1])

    def cost(x):
        r = (y - end_of(x)) / 0.01
        return r @ r + (x - prior.mean) ** 2 @ (1 / np.diag(prior.covariance))

    at = []
    model = FunctionObservation(("u", "v"), 0.01, lambda x: (at.append(x), end_of(x))[1], end_slope)
    seen = make_measurement(model, y)
    result = update(prior, seen, iterations=20)
    # Noise is inflated at first, and reduced by a factor from step to step.
    misfit = (y - end_of(prior.mean)) / 0.01
    temperature = misfit @ misfit / 2.0 / 9.0
    assert len(at) == 2 + math.ceil(math.log(temperature) / math.log(6.0))
    cool = update(prior, make_measurement(END, y, np.full(2, temperature * 1e-4)))
    np.testing.assert_allclose(at[1], cool.belief.mean)
    best = cost(result.belief.mean)
    for size in (1e-1, 1e-2, 1e-3):
        for step in np.random.default_rng(0).normal(size=(100, 3)) * size:
            assert cost(result.belief.mean + step) > best - 1e-3
    assert cost(update(prior, seen).belief.mean) > best + 10
    untempered = update(prior, seen, iterations=20, tempered=False)
    np.testing.assert_allclose(untempered.belief.mean, result.belief.mean, atol=1e-6)
    assert result.distance == pytest.approx(best, rel=1e-3)
    # A start is where the first linearisation is, not where the belief is.
    at.clear()
    there = update(prior, seen, 20, np.array([1.2, 0.0, 1.1]), tempered=False)
    np.testing.assert_array_equal(at[0], [1.2, 0.0, 1.1])
    np.testing.assert_allclose(there.belief.mean, result.belief.mean, atol=1e-6)


def test_steps_beyond_the_eighth_are_halved_as_tangents_may_oscillate():
    """Newton's method for |x|^(1/3) = 0 overshoots, and never ends; halved steps do."""
    cube = FunctionObservation(("h",), 1e-3, lambda x: np.cbrt(x))
    far = Belief(np.array([0.1]), np.array([[1e6]]))
    seen, ends = make_measurement(cube, np.zeros(1)), []
    for iterations in (8, 9, 10, 11):
        ends.append(update(far, seen, iterations, tempered=False).belief.mean[0])
    np.testing.assert_allclose(np.divide(ends[1:], ends[:-1]), [-2.0, -0.5, -0.5], rtol=0.01)


class Parabola:
    """h = x^2 / 2 + x, whose linearisation error at 0 is x^2 / 2; of the first element."""

    names = ("h",)
    variances = np.array([1e-4])
    wraps = np.zeros(1, dtype=bool)

    def predict(self, x):
        return np.array([0.5 * x[0] ** 2 + x[0]]), np.r_[x[0] + 1.0, 0.0 * x[1:]][None]


def test_linearised_over_a_belief_the_error_counts_as_noise():
    prior, y = Belief(np.array([0.2, 1.0]), np.array([[0.09, 0.03], [0.03, 0.04]])), np.array([0.5])
    result = update(prior, make_measurement(Parabola(), y), remainder_weight=3.0)
    p, slope = 0.09, 1.2
    noise = 1e-4 + 3.0 * 0.5 * p**2
    gain = prior.covariance[:, 0] * slope / (slope**2 * p + noise)
    off = y[0] - (0.5 * 0.2**2 + 0.2 + 0.5 * p)
    np.testing.assert_allclose(result.belief.mean, prior.mean + gain * off)
    expected = prior.covariance - np.outer(gain, slope * prior.covariance[0])
    np.testing.assert_allclose(result.belief.covariance, expected)
    assert result.bend == pytest.approx(0.5 * p**2 / 1e-4)
    # One standard deviation along the axis that is bent.
    np.testing.assert_allclose(np.abs(result.direction), [1.0 / 0.3, 0.0], atol=1e-9)
    # Inside limits it is linearised over what is left.
    rows = from_bounds(["x", "y"], [-np.inf, -np.inf], [0.1, np.inf])

    def cut(belief, sites):
        return truncate_joint(belief, rows, start=sites)

    inside = update(prior, make_measurement(Parabola(), y), truncate=cut, remainder_weight=3.0)
    left = cut(prior, np.zeros((0, 2)))
    assert inside.bend == pytest.approx(0.5 * left.covariance[0, 0] ** 2 / 1e-4)
    assert inside.truncated.mean[0] < 0.1 < inside.belief.mean[0]


def test_slices_mix_to_the_belief_and_are_straight():
    prior, y = Belief(np.array([0.2, 1.0]), np.array([[0.09, 0.03], [0.03, 0.04]])), np.array([0.5])
    for deviation, width in ((1e-3, 0.2), (0.1, None), (1.0, 0.7)):
        wide = update(
            prior, make_measurement(Parabola(), y, np.array([deviation**2])), remainder_weight=1.0
        )
        a = wide.direction
        logs, parts = zip(*slices(prior, wide), strict=True)
        weights = np.exp(logs)
        assert weights.sum() == pytest.approx(1.0)
        means = np.array([one.mean for one in parts])
        np.testing.assert_allclose(weights @ means, prior.mean, atol=1e-12)
        second = parts[0].covariance + (weights * (means - prior.mean).T) @ (means - prior.mean)
        # The tails beyond 2.5 standard deviations are left out.
        np.testing.assert_allclose(second, prior.covariance, atol=4e-3)
        along = np.sqrt(a @ parts[0].covariance @ a)
        if width is None:
            # As wide as the noise allows, after the update.
            width = np.sqrt(a @ wide.truncated.covariance @ a) / wide.bend**0.25
            assert 0.2 < width < 0.7
        assert along == pytest.approx(width, rel=1e-6)
        np.testing.assert_allclose(np.diff(means @ a), 1.5 * width)
        assert np.abs(means @ a - prior.mean @ a).max() >= 2.5 * np.sqrt(1.0 - width**2) - 1e-9


def test_a_static_view_continues_while_only_noise_changes():
    names, chance = tuple("abcd"), 1e-9
    model = FunctionObservation(names, [1.0, 2.0, 0.1, 0.1], lambda x: x, angles=["d"])
    deviations, y = np.sqrt(model.variances), np.array([5.0, -3.0, 0.0, 3.1])
    generator, view = np.random.default_rng(1), next_view(None, make_measurement(model, y), chance)
    assert view[1] == 1
    for count in range(2, 200):
        again = y + deviations * generator.normal(size=4)
        view = next_view(view, make_measurement(model, again), chance)
        assert view[1] == count
    np.testing.assert_array_equal(view[0], y)

    def number(seen, view=view, significance=chance):
        return next_view(view, make_measurement(model, seen), significance)[1] - view[1] + 1

    # Both frames have noise; the difference is compared with a p-value for any number of values.
    turned = y + 2.0 * np.pi * model.wraps
    hidden = np.where(np.arange(4) < 2, y, np.nan)
    assert number(turned) == 2
    for seen, degrees in ((turned, 4), (hidden, 2)):
        limit = np.sqrt(2.0 * chi2.isf(chance, degrees) / degrees)
        for factor, is_new in ((0.999, False), (1.001, True)):
            assert (number(seen + limit * factor * deviations) == 2) != is_new
    assert next_view(view, make_measurement(model, y), 0.0)[1] == 1
    first = next_view(None, make_measurement(model, hidden), chance)
    assert next_view(first, make_measurement(model, y), chance)[1] == 1, "newly visible"
    assert next_view(first, make_measurement(model, np.full(4, np.nan)), chance)[1] == 1
    assert next_view(first, make_measurement(LINEAR, np.zeros(2)), chance)[1] == 1


def test_repeated_frames_determine_only_state_plus_offset():
    """Compared with the closed form: prior, offset and mean noise as one normal distribution."""
    prior = Belief(np.zeros(1), np.array([[0.09]]))
    repeated = begin_repeated_view(Parabola(), prior, prior, np.zeros(1))
    # The mean square of x^2 / 2.
    C = repeated.belief.covariance[1, 1]
    assert C == pytest.approx(0.75 * 0.09**2)
    tangent = anchored_observation(Parabola(), repeated.tangent)
    frames, y = 300, 0.4
    for _ in range(frames):
        after = update(repeated.belief, make_measurement(tangent, np.array([y]))).belief
        repeated = RepeatedView(repeated.tangent, after)
    noise = 1e-4 / frames + C
    assert repeated.state().covariance[0, 0] == pytest.approx(1 / (1 / 0.09 + 1 / noise), rel=1e-6)
    assert repeated.state().mean[0] == pytest.approx(y * 0.09 / (0.09 + noise), rel=1e-6)
    # At another tangent.
    value, slope = anchored_observation(END, START.mean).predict(np.arange(5.0))
    H = end_slope(START.mean)
    expected = end_of(START.mean) + H @ (np.arange(3.0) - START.mean) + [3.0, 4.0]
    np.testing.assert_allclose(value, expected)
    np.testing.assert_allclose(slope, np.hstack([H, np.eye(2)]))


def test_a_step_of_the_motion_moves_a_view_but_not_its_offsets():
    """The whole belief moves by the block matrix (A, 0; 0, I)."""
    root = np.random.default_rng(3).normal(size=(5, 5))
    view = RepeatedView(START.mean, Belief(np.arange(5.0), root @ root.T))
    at, value, A = np.ones(3), np.array([2.0, 0.0, 1.0]), np.eye(3) + np.eye(3, k=1)
    U, remainder = np.diag([1.0, 2.0, 3.0]), 0.1 * np.eye(3)
    moved = view.after_step(Linear(at, value, A, remainder), U)
    whole, more = np.eye(5), np.zeros((5, 5))
    whole[:3, :3], more[:3, :3] = A, U + remainder
    np.testing.assert_allclose(moved.belief.covariance, whole @ root @ root.T @ whole.T + more)
    np.testing.assert_allclose(moved.belief.mean, [*(value + A @ (np.arange(3.0) - at)), 3.0, 4.0])
    state = after_step(view.state(), Linear(at, value, A), U)
    np.testing.assert_allclose(state.covariance + remainder, moved.state().covariance)
    np.testing.assert_allclose(state.mean, moved.state().mean)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: make_measurement(LINEAR, np.zeros(3)), "has 2 measurements"),
        (lambda: make_measurement(LINEAR, np.array([0, np.inf])), "'b' is infinite"),
        (lambda: make_measurement(LINEAR, np.ones(2), np.array([1, 0])), "'b' must be positive"),
        (lambda: make_measurement(LINEAR, np.ones(2), np.ones(3)), "has 2 measurements"),
        (lambda: make_measurement(LINEAR, np.ones(2), np.inf * np.eye(2)), "'a' is infinite"),
        (lambda: update(START, make_measurement(END, np.ones(2), -np.eye(2) * 9)), "positive"),
        (lambda: FunctionObservation(("u", "v"), [0.1, 0.0], end_of), "positive"),
        (lambda: FunctionObservation(("u", "v"), [0.1] * 3, end_of), "2 measurements"),
        (lambda: FunctionObservation(("u", "v"), 0.1, end_of, angles=["w"]), "'w'"),
        (lambda: FunctionObservation("uv", 0.05, end_of), "different names, not 'uv'"),
        (lambda: FunctionObservation(("u", "u"), 0.05, end_of), "different names"),
    ],
)
def test_invalid_arguments_are_refused_by_name(make, word):
    with pytest.raises((SettingsError, UnknownNameError), match=word):
        make()


def test_functions_are_observed_with_angles_and_given_or_own_jacobians():
    names = ("angle", "length")
    model = FunctionObservation(
        names, 0.1, lambda x: np.array([np.arctan2(np.sin(x[0]), np.cos(x[0])), x[2]]),
        angles=["angle"],
    )  # fmt: skip
    assert model.wraps.tolist() == [True, False]
    np.testing.assert_allclose(model.variances, [0.01, 0.01])
    # Also where the angle wraps.
    slope = model.predict(np.array([np.pi, 0.0, 1.0]))[1]
    np.testing.assert_allclose(slope, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-9)
    found = update(
        Belief(np.array([np.pi, 0.0, 1.0]), START.covariance),
        make_measurement(model, np.array([-np.pi + 0.1, 1.0])),
    )
    assert found.belief.mean[0] == pytest.approx(np.pi + 0.08, abs=0.001)
    np.testing.assert_array_equal(END.predict(START.mean)[1], end_slope(START.mean))
    assert not END.mirrors(START)
