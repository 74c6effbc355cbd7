import numpy as np
import pytest

from drake_pose.filtering.hand import HAND_STATE
from drake_pose.filtering.state import Belief, Linear
from drake_pose.filtering.truncated_filter import (
    FilterState,
    Hypothesis,
    normalise,
    reduce_mixture,
)
from drake_pose.filtering.update import (
    RepeatedView,
    anchored_observation,
    begin_repeated_view,
    make_measurement,
    next_view,
    update,
)
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_sequences import make_sequence

CHANCE = 1e-9


@pytest.fixture(scope="module")
def hand():
    f, observation = experiment_filter()
    sequence = make_sequence(35.0, "full", observation, np.random.default_rng(0))
    return f, observation, sequence


def test_static_view_continues_while_only_noise_changes(hand):
    _, observation, sequence = hand
    y = sequence.measurements[3]
    noise = np.sqrt(observation.variances)
    generator = np.random.default_rng(1)
    view = next_view(None, make_measurement(observation, y), CHANCE)
    assert view[1] == 1
    for count in range(2, 500):
        again = y + noise * generator.normal(size=len(y))
        view = next_view(view, make_measurement(observation, again), CHANCE)
        assert view[1] == count
    assert next_view(view, make_measurement(observation, y + 4 * noise), CHANCE)[1] == 1
    assert next_view(view, make_measurement(observation, y), 0.0)[1] == 1
    # The threshold is a p-value for any number of measurements; newly visible ones begin a view.
    few = np.where(np.arange(len(y)) < 4, y, np.nan)
    first = next_view(None, make_measurement(observation, few), CHANCE)
    for other, is_new in ((few + 3.5 * noise, False), (few + 9 * noise, True), (y, True)):
        found = next_view(first, make_measurement(observation, other), CHANCE)
        assert found[1] == (1 if is_new else 2)
    # A full turn of an angle is no change.
    turned = y + 2 * np.pi * observation.wraps
    assert next_view(view, make_measurement(observation, turned), CHANCE)[1] == view[1] + 1


class Parabola:
    """h = x^2 / 2 + x, whose linearisation error at 0 is x^2 / 2."""

    names = ("h",)
    variances = np.array([1e-4])
    wraps = np.zeros(1, dtype=bool)

    def predict(self, x):
        return np.array([0.5 * x[0] ** 2 + x[0]]), np.array([[x[0] + 1.0]])

    def mirrors(self, belief):
        return []


def test_curvature_is_the_mean_square_linearisation_error():
    deviation = 0.3
    belief = Belief(np.zeros(1), np.array([[deviation**2]]))
    draws = np.random.default_rng(0).normal(size=200000) * deviation
    expected = np.mean((0.5 * draws**2) ** 2)
    view = begin_repeated_view(Parabola(), belief, belief, np.zeros(1))
    assert view.belief.covariance[1, 1] == pytest.approx(expected, rel=0.03)


def test_repeated_frames_determine_only_state_plus_offset():
    """Compared with the closed form: prior, offset and mean noise as one normal distribution."""
    prior = Belief(np.zeros(1), np.array([[0.09]]))
    repeated = begin_repeated_view(Parabola(), prior, prior, np.zeros(1))
    tangent = anchored_observation(Parabola(), repeated.tangent)
    C = repeated.belief.covariance[1, 1]
    frames, y = 1000, 0.4
    for _ in range(frames):
        repeated = RepeatedView(
            repeated.tangent,
            update(repeated.belief, make_measurement(tangent, np.array([y]))).belief,
        )
    noise = Parabola.variances[0] / frames + C
    assert repeated.state().covariance[0, 0] == pytest.approx(1 / (1 / 0.09 + 1 / noise), rel=1e-6)
    assert repeated.state().mean[0] == pytest.approx(y * 0.09 / (0.09 + noise), rel=1e-6)
    total = np.ones(2) @ repeated.belief.covariance @ np.ones(2)
    assert total == pytest.approx(Parabola.variances[0] / frames, rel=1e-2)


def test_anchored_jacobian_equals_central_differences(hand):
    _, observation, sequence = hand
    x = sequence.states[5]
    tangent = anchored_observation(observation, x)
    n, m = len(x), len(observation.names)
    z = np.r_[sequence.states[6], np.random.default_rng(0).normal(size=m)]
    h, H = tangent.predict(z)
    step = np.random.default_rng(1).normal(size=n + m) * 1e-3
    np.testing.assert_allclose(tangent.predict(z + step)[0] - h, H @ step, atol=1e-9)
    h0, _ = observation.predict(x)
    np.testing.assert_allclose(tangent.predict(np.r_[x, np.zeros(m)])[0], h0)


def test_offsets_do_not_change_in_a_step_of_the_motion(hand):
    f, observation, sequence = hand
    guess = f.start(sequence.guess).best
    repeated = begin_repeated_view(observation, guess, guess, guess.mean)
    A, U = HAND_STATE.transition(), f.predict(f.start(sequence.guess)).hypotheses[0].free.covariance
    n = len(HAND_STATE)
    moved = repeated.after_step(Linear(np.zeros(n), np.zeros(n), A), U)
    np.testing.assert_allclose(moved.state().mean, A @ guess.mean)
    np.testing.assert_allclose(moved.state().covariance, A @ guess.covariance @ A.T + U)
    np.testing.assert_allclose(moved.belief.mean[n:], repeated.belief.mean[n:])
    np.testing.assert_array_equal(moved.belief.covariance, moved.belief.covariance.T)


def at(place, log_weight, deviation=1.0):
    belief = Belief(np.array([place, 0.0]), np.diag([deviation**2, 1.0]))
    return Hypothesis(belief, belief, log_weight, log_weight - 2.0)


def gains(hypotheses):
    """Return log_evidence - log_weight of each hypothesis, which normalisation preserves."""
    return [one.log_evidence - one.log_weight for one in hypotheses]


@pytest.mark.parametrize("common", [0.0, -800.0, 800.0])
def test_normalised_weights_sum_to_one_and_keep_their_ratios(common):
    found = normalise([at(0.0, common - 1.0), at(1.0, common + 2.0), at(2.0, common)])
    assert [one.belief.mean[0] for one in found] == [1.0, 2.0, 0.0]
    expected = np.exp([2.0, 0.0, -1.0])
    np.testing.assert_allclose([one.weight for one in found], expected / expected.sum())
    np.testing.assert_allclose(gains(found), -2.0)


def test_merged_hypotheses_keep_moments_and_weights():
    """Those that are the same merge, then the lightest with what is nearest, down to the cap."""
    some = [at(0.0, 0.0, 2.0), at(0.2, -1.0, 2.0), at(9.0, -2.0), at(5.0, -9.0), at(-3.0, -3.0)]
    kept, rejected = reduce_mixture(some, 3, 7)
    assert [(one.step, one.reason) for one in rejected] == [(7, "twin"), (7, "cap")]
    assert [one.hypothesis.belief.mean[0] for one in rejected] == [0.2, 5.0]
    before, after = (FilterState(0, tuple(each)).overall for each in (normalise(some), kept))
    np.testing.assert_allclose(after.mean, before.mean)
    np.testing.assert_allclose(after.covariance, before.covariance, atol=1e-12)
    assert sum(one.weight for one in kept) == pytest.approx(1.0)
    np.testing.assert_allclose(gains(kept), -2.0)
    # Differences are relative to the standard deviations.
    small = [at(place, 0.0, 1e-3) for place in (0.0, 0.2e-3, 0.9e-3)]
    assert len(reduce_mixture(small, 4, 7)[0]) == 2
