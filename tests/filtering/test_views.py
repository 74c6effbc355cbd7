import numpy as np
import pytest

from drake_pose.apps.shimada import experiment_filter
from drake_pose.apps.shimada_motion import make_sequence
from drake_pose.errors import SettingsError
from drake_pose.filtering import FilterSettings
from drake_pose.filtering.hand_observation import HAND_STATE, LENGTHS, MEASURED
from drake_pose.filtering.views import AnchoredObservation, next_view

LENGTH_INDICES = HAND_STATE.indices(LENGTHS)


def stare(novelty, frames, runs, moving_after=False):
    """NEES per degree of freedom and mean error [pixel] of the lengths after a static view."""
    f, observation = experiment_filter(FilterSettings(novelty=novelty, hypothesis_cap=1))
    nees, errors = [], []
    for run in range(runs):
        sequence = make_sequence(35.0, "full", observation, np.random.default_rng([1, run]))
        generator = np.random.default_rng([2, run])
        x = sequence.states[0].copy()
        x[14:28] = 0
        h, _ = observation.predict(x)
        state = f.start(sequence.guess)
        for t in range(frames):
            y = h + np.sqrt(observation.variances) * generator.normal(size=len(h))
            y[MEASURED.index("scale")] = 1.0 if t == 0 else np.nan
            state = f.update(f.predict(state) if t else state, y)
        if moving_after:
            for y in sequence.measurements[1:]:
                state = f.update(f.predict(state), y)
        error = (state.best.mean - x)[LENGTH_INDICES]
        covariance = state.best.covariance[np.ix_(LENGTH_INDICES, LENGTH_INDICES)]
        nees.append(error @ np.linalg.solve(covariance, error) / len(error))
        errors.append(1000 * np.abs(error).mean())
    return np.mean(nees), np.mean(errors)


def test_staring_does_not_make_sure():
    nees, _ = stare(6.0, frames=300, runs=3)
    assert nees < 2.0
    flawed, _ = stare(0.0, frames=300, runs=2)
    assert flawed > 20.0


def test_after_staring_new_views_still_correct_the_lengths():
    _, before = stare(6.0, frames=150, runs=3)
    nees, after = stare(6.0, frames=150, runs=3, moving_after=True)
    assert after < 0.5 < before
    assert nees < 3.0


def test_a_view_lasts_while_only_noise_changes():
    _, observation = experiment_filter()
    sequence = make_sequence(35.0, "full", observation, np.random.default_rng(0))
    y = sequence.measurements[3]
    noise = np.sqrt(observation.variances)
    generator = np.random.default_rng(1)
    view = next_view(None, y, observation, 6.0)
    assert view.count == 1
    for count in range(2, 30):
        view = next_view(view, y + noise * generator.normal(size=len(y)), observation, 6.0)
        assert view.count == count
    assert next_view(view, y + 8 * noise, observation, 6.0).count == 1
    assert next_view(view, y, observation, 0.0).count == 1
    # An angle that jumps by a full turn has not changed.
    turned = y + 2 * np.pi * observation.wraps
    assert next_view(view, turned, observation, 6.0).count == view.count + 1


def test_something_that_was_hidden_makes_a_new_view():
    _, observation = experiment_filter()
    sequence = make_sequence(35.0, "full", observation, np.random.default_rng(0))
    y = sequence.measurements[3]
    hidden = y.copy()
    hidden[5] = np.nan
    view = next_view(None, hidden, observation, 6.0)
    assert next_view(view, y, observation, 6.0).count == 1


def test_all_frames_of_a_view_together_tell_what_their_mean_does():
    """Sum of the frames' information = 1 / (R / k + C) in every element."""
    f, observation = experiment_filter()
    sequence = make_sequence(35.0, "full", observation, np.random.default_rng(0))
    belief = f.start(sequence.guess).best
    anchored = AnchoredObservation(observation, belief)
    R = observation.variances
    total = np.zeros(len(R))
    for count in range(2, 50):
        total += 1 / anchored.for_frame(count).variances
    C = anchored._curvature
    expected = 1 / (R / 49 + C) - 1 / (R + C)
    np.testing.assert_allclose(total, expected, rtol=1e-6, atol=1e-9 * np.max(1 / R))
    assert (C[2:18] > 0).all()


def test_a_negative_novelty_is_refused():
    with pytest.raises(SettingsError, match="novelty"):
        FilterSettings(novelty=-1.0)
