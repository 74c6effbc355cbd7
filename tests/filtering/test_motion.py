"""Motion models, compared with closed forms and Monte Carlo."""

import numpy as np
import pytest
from scipy.stats import norm

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.inequalities import make_inequalities
from drake_pose.filtering.motion import (
    FunctionMotion,
    LinearMotion,
    constant_velocity,
    step_from,
    stopped_rates,
)
from drake_pose.filtering.state import Belief, StateLayout
from drake_pose.filtering.truncated_filter import TruncatedFilter
from tests.filtering.segment import END, FREE, LAYOUT, START, STEP, end_of, make_filter


def test_rates_are_a_random_walk_or_an_ornstein_uhlenbeck_process():
    layout, s, T = StateLayout(("angle", "shift"), ("length",)), 0.5, 0.1
    free = constant_velocity(layout, {"angle": s, "shift": 2.0}, T)
    pair = np.ix_([0, 2], [0, 2])
    np.testing.assert_allclose(free.transition[pair], [[1.0, T], [0.0, 1.0]])
    np.testing.assert_allclose(
        free.noise[pair], s**2 * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    )
    np.testing.assert_allclose(free.noise[1::2, 1::2], 16.0 * free.noise[::2, ::2][:2, :2])
    assert not free.noise[[0, 4]][:, [1, 4]].any()
    assert (free.transition[4] == [0, 0, 0, 0, 1]).all()
    assert free.period == T
    tau = 0.4
    decaying = constant_velocity(layout, {"angle": s, "shift": 1.0}, T, tau)
    e = np.exp(-T / tau)
    np.testing.assert_allclose(decaying.transition[pair], [[1.0, tau * (1.0 - e)], [0.0, e]])
    both = 0.5 * tau**2 * (1.0 - e) ** 2
    place = tau**2 * (T - 2.0 * tau * (1.0 - e) + 0.5 * tau * (1.0 - e**2))
    expected = s**2 * np.array([[place, both], [both, 0.5 * tau * (1.0 - e**2)]])
    np.testing.assert_allclose(decaying.noise[pair], expected)


def swing(x):
    """Return a pendulum's state after a step."""
    return np.array([x[0] + 0.3 * x[1], x[1] - 0.3 * 9.8 * np.sin(x[0]) / x[2], x[2]])


def swing_slope(x):
    rate = [-0.3 * 9.8 * np.cos(x[0]) / x[2], 1.0, 0.3 * 9.8 * np.sin(x[0]) / x[2] ** 2]
    return np.array([[1.0, 0.3, 0.0], rate, [0.0, 0.0, 1.0]])


def test_a_function_is_linearised_at_the_mean_or_over_the_belief():
    """The latter has the moments of 100,000 draws."""
    own, given = (FunctionMotion(swing, 0.0 * np.eye(3), 0.3, one) for one in (None, swing_slope))
    for motion in (own, given):
        at = step_from(motion, START, False)
        np.testing.assert_allclose(at.slope, swing_slope(START.mean), atol=1e-7)
        np.testing.assert_allclose(at.value, swing(START.mean))
    over = [step_from(motion, START, True) for motion in (own, given)]
    np.testing.assert_allclose(over[0].value, over[1].value)
    draws = np.random.default_rng(0).multivariate_normal(START.mean, START.covariance, 100_000)
    ends = swing(draws.T).T
    found = make_filter(motion=own).predict_belief(START)
    scale = ends.std(axis=0)
    np.testing.assert_allclose(found.mean / scale, ends.mean(axis=0) / scale, atol=0.05)
    gaps = (found.covariance - np.cov(ends.T)) / np.outer(scale, scale)
    assert np.abs(gaps).max() < 0.06
    linear = step_from(STEP, START, True)
    np.testing.assert_array_equal(linear.slope, STEP.transition)
    np.testing.assert_array_equal(linear.value - linear.slope @ linear.at, 0.0)


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_limits_stop_rates_with_the_probability_to_be_beyond(scale):
    """Along the limit by all of the rate's mean square; along others not at all."""
    layout = StateLayout(("a", "b"), ("c",))
    mean = np.array([1.0, 0.2, 3.0, -1.0, 7.0])
    root = np.random.default_rng(0).normal(size=(5, 5))
    belief = Belief(mean, root @ root.T)
    phi = scale * np.array([[1.0, -2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]])
    b = scale * np.array([1.5, 9.0])
    limits = make_inequalities(layout.names, ["r", "c"], phi, b)
    along, u = phi[0] / np.linalg.norm(phi[0]), np.array([0.0, 0.0, 1.0, -2.0, 0.0]) / np.sqrt(5.0)
    deviation = np.sqrt(along @ belief.covariance @ along)
    beyond = norm.sf(1.5 / np.sqrt(5.0), along @ mean, deviation)
    square = (u @ mean) ** 2 + u @ belief.covariance @ u
    found = stopped_rates(belief, limits, 2)
    np.testing.assert_allclose(found, beyond * square * np.outer(u, u), atol=1e-12)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: constant_velocity(LAYOUT, {"angle": 1.0}, 0.0), "period 0"),
        (lambda: constant_velocity(LAYOUT, {"angle": 1.0}, np.inf), "period inf"),
        (lambda: constant_velocity(LAYOUT, {"angle": 1.0}, 1.0, 0.0), "memory 0"),
        (lambda: constant_velocity(LAYOUT, {"elbow": 1.0}, 0.1), "'elbow'"),
        (lambda: TruncatedFilter(LAYOUT, END, FREE, STEP.noise), "ndarray has no noise"),
        (lambda: TruncatedFilter(LAYOUT, end_of, FREE, STEP), "function has no names"),
        (lambda: make_filter(motion=LinearMotion(np.eye(2), STEP.noise, 0.1)), "transition"),
        (lambda: make_filter(motion=LinearMotion(np.eye(3), np.eye(2), 0.1)), "noise: expected"),
        (lambda: make_filter(motion=LinearMotion(np.eye(3), np.inf * np.eye(3), 0.1)), "finite"),
    ],
)
def test_invalid_arguments_are_refused_by_name(make, word):
    with pytest.raises((SettingsError, UnknownNameError), match=word):
        make()
