"""Shimada's synthetic hand: sequences, accuracy of the filters, pictures and the command."""

import json

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import HAND_STATE, LENGTHS, MEASURED, HandObservation
from drake_pose.papers.pictures import save_hands, save_hypotheses
from drake_pose.papers.shimada import (
    CASES,
    OBLIQUENESS,
    PICTURES,
    experiment_filter,
    result_table,
    run_experiment,
    run_hypotheses_experiment,
)
from drake_pose.papers.shimada_sequences import (
    FRAMES,
    experiment_settings,
    make_sequence,
    run_sequence,
    true_states,
)
from tests.cli import run_command

LENGTH = HAND_STATE.indices(LENGTHS)


@pytest.fixture(scope="module")
def result():
    return run_experiment(6, 3, experiment_settings(), "full")


@pytest.fixture(scope="module")
def hypotheses():
    return run_hypotheses_experiment(20, 0, experiment_settings("sequential", 1))


def reproduce(*words, code=0):
    """Return the command's JSON, or its error text."""
    made = run_command(["reproduce", "shimada", *words])
    assert made.exit_code == code, made.output
    return json.loads(made.stdout) if "--json" in words else made.stderr


@pytest.mark.parametrize("yaw", [0.0, OBLIQUENESS])
def test_true_motion_satisfies_table_1(yaw):
    rows = experiment_filter()[0].inequalities
    generator = np.random.default_rng(0)
    for r_13 in CASES.values():
        for _ in range(50):
            states = true_states(r_13, generator.uniform(-0.6, 0.6, 6), yaw)
            assert states.shape == (FRAMES, len(HAND_STATE))
            margins = states @ rows.phi.T - rows.b
            worst = np.unravel_index(np.argmax(margins), margins.shape)
            assert margins[worst] <= 1e-9, rows.rows[worst[1]]


def test_first_guess_is_table_2():
    generator = np.random.default_rng(0)
    for _ in range(20):
        sequence = make_sequence(35.0, "full", HandObservation(), generator)
        error = np.abs(sequence.guess.mean - sequence.states[0])
        assert error[:2].max() <= 5
        assert error[LENGTH].max() <= 0.010
        assert error[6:14].max() <= np.radians(15)
        assert np.sum(sequence.guess.mean[2:6] ** 2) == pytest.approx(1.0)
        assert np.sum(sequence.states[0, 2:6] ** 2) == pytest.approx(1.0)
        turn = 2 * np.arccos(min(1.0, abs(sequence.guess.mean[2:6] @ sequence.states[0, 2:6])))
        assert turn <= np.radians(15.01)
        variances = np.diag(sequence.guess.covariance)
        np.testing.assert_allclose(variances[LENGTH], 800e-6)
        np.testing.assert_allclose(variances[6:14], np.radians(40) ** 2)


def test_noise_has_the_variances_given_to_the_filter():
    observation = HandObservation()
    generator = np.random.default_rng(1)
    normalised = []
    for _ in range(10):
        sequence = make_sequence(40.0, "full", observation, generator)
        for x, y in zip(sequence.states, sequence.measurements, strict=True):
            error = y - observation.predict(x)[0]
            error[observation.wraps] = (
                np.remainder(error[observation.wraps] + np.pi, 2 * np.pi) - np.pi
            )
            normalised.append(error / np.sqrt(observation.variances))
    seen = np.array(normalised)[:, : MEASURED.index("scale")]
    assert np.nanstd(seen) == pytest.approx(1.0, abs=0.02)


def test_lines_hide_the_knuckles_and_the_wrist():
    sequence = make_sequence(35.0, "lines", HandObservation(), np.random.default_rng(2))
    hidden = np.isnan(sequence.measurements).all(axis=0)
    names = {name for name, gone in zip(MEASURED, hidden, strict=True) if gone}
    knuckles = {f"point_{i}{j}_{a}" for i in (1, 2) for j in (0, 1, 2) for a in "xy"}
    assert names == {"wrist_x", "wrist_y"} | knuckles
    scale = sequence.measurements[:, MEASURED.index("scale")]
    assert scale[0] == 1.0
    assert np.isnan(scale[1:]).all()


@pytest.mark.slow
def test_lengths_converge_with_drakes_pictures(tmp_path):
    """In a diagram of plant, renderer, sensor and filter, from unlabelled silhouettes."""
    result = run_experiment(2, 5, experiment_settings(), PICTURES)
    for key, figures in ((key, result.as_json()[key]) for key in CASES):
        assert figures["lost"] == 0
        assert figures["length_error_largest"] < 0.05
        assert figures["inside_2sigma_all"] > 0.9
        assert figures["angle_rmse"] < 3.0
        assert figures["silhouette_difference"] < 0.045
        assert figures["mirrored"] > 0
        trial, generator = result.trials[key][0], np.random.default_rng([5, 0, int(CASES[key])])
        drawn = make_sequence(CASES[key], "lines", HandObservation(), generator)
        np.testing.assert_array_equal(trial.truths, drawn.states)
        first = np.abs(drawn.guess.mean - drawn.states[0])[LENGTH].mean()
        assert np.abs(trial.means[-1] - drawn.states[-1])[LENGTH].mean() < 0.2 * first
    save_hands(result, tmp_path)
    assert {file.stem for file in tmp_path.iterdir()} == set(CASES)


def test_each_case_converges_to_its_true_lengths_inside_table_1(result):
    figures = result.as_json()
    rows = experiment_filter()[0].inequalities
    for key, r_13 in CASES.items():
        trials = result.trials[key]
        truths = [trial.truths[-1] for trial in trials]
        assert truths[0][HAND_STATE.index("length_13")] == r_13 / 1000
        ends = [trial.means[-1] for trial in trials]
        errors = 1000 * np.mean(np.abs(np.subtract(ends, truths)[:, LENGTH]), axis=1)
        assert np.mean(errors) < 0.7
        assert figures[key]["length_error_mean"] == pytest.approx(np.mean(errors))
        assert figures[key]["lost"] == 0
        assert figures[key]["angle_rmse"] < 3.0
        assert figures[key]["inside_2sigma"] > 0.8
        assert all((rows.b - trial.means @ rows.phi.T).min() > -1e-6 for trial in trials)
    assert (figures["runs"], figures["truncation"]) == (6, "joint")
    assert result_table(result).row_count >= 7


@pytest.mark.parametrize(
    ("bad", "word"),
    [({"runs": 0}, "runs"), ({"observed": "x"}, "observed")],
)
def test_bad_arguments_are_named(bad, word):
    with pytest.raises(SettingsError, match=word):
        run_experiment(**{"runs": 1, "seed": 0, "settings": experiment_settings()} | bad)


def test_single_linearisation_converges_but_is_overconfident():
    """One linearisation per frame, as in equations (19) and (20)."""
    words = ("--iterations", "1", "--truncation", "sequential", "--json")
    figures = reproduce("--runs", "3", *words)
    assert (figures["iterations"], figures["observed"]) == (1, "lines")
    ours = run_experiment(3, 0, experiment_settings()).as_json()
    for key in CASES:
        assert ours[key]["lost"] == 0
        assert figures[key]["length_error_mean"] > 1.5 * ours[key]["length_error_mean"]
        assert figures[key]["nees_inside"] < ours[key]["nees_inside"]


def test_pictures_and_hypotheses_exclude_each_other():
    assert "--hypotheses" in reproduce("--pictures", "--hypotheses", code=2)


def test_hypotheses_have_one_continuous_history(hypotheses):
    assert len(hypotheses.histories) > 20
    weights = np.zeros((20, 56))
    for one in hypotheses.histories:
        assert np.array_equal(np.diff(one.frames), np.ones(len(one.frames) - 1))
        assert len(one.means) == len(one.frames)
        assert np.isnan(one.weights[-1]) == bool(one.reason)
        weights[one.run, one.frames] += np.nan_to_num(one.weights)
    assert weights[:, 1:] == pytest.approx(1.0)


def test_inequalities_reject_hypotheses_that_explain_the_measurements(hypotheses):
    later = [one for one in hypotheses.histories if one.reason == "constraint" and one.lived]
    assert len(later) >= 3
    assert np.mean([one.wrong for one in later]) > 0.6
    rows = hypotheses.inequalities
    beyond = []
    for one in later:
        k = rows.rows.index(one.row)
        assert one.c < -4
        assert rows.phi[k] @ one.means[-2] <= rows.b[k] + 1e-9
        beyond.append(rows.phi[k] @ one.means[-1] > rows.b[k])
    # A later row is evaluated after the truncation by earlier ones.
    assert np.mean(beyond) > 0.6


def test_drawn_hypothesis_is_wrong_and_distinct(hypotheses, tmp_path):
    removed, survivor = hypotheses.example()
    assert removed.wrong
    assert removed.lived >= 2
    assert survivor.frames[0] < removed.frames[-1] < survivor.frames[-1]
    before = int(removed.frames[-1]) - 1
    assert np.degrees(np.abs(removed.at(before) - survivor.at(before))[6:14]).max() > 8
    assert save_hypotheses(hypotheses, tmp_path)
    assert (tmp_path / "figure_09.png").stat().st_size > 20000


def test_iterated_filter_merges_mirrored_hypotheses(tmp_path):
    """With iterated linearisations mirrored predictions converge to the same estimate."""
    words = ("--hypotheses", "--runs", "2", "--truncation", "joint", "--iterations", "20")
    figures = reproduce(*words, "--json")
    assert figures["rejected_later_than_made"] == 0
    assert figures["became_another"] > 0
    assert "nothing to draw" in reproduce(*words, "--out", str(tmp_path / "out"))
    papers = reproduce("--hypotheses", "--runs", "1", "--json")
    assert (papers["truncation"], papers["iterations"]) == ("sequential", 1)


@pytest.mark.slow
def test_recorded_hands_are_tracked(shared_data):
    """Hands of other measures, rendered by another program, with angles by encoders."""
    found = run_sequence(shared_data / "hand_sequences" / "wave")
    figures = found.figures
    assert (figures["frames"], figures["lost"]) == (80, 0)
    assert figures["flexion_error_median"] < 10.0
    # .07 to .11 for first poses that differ by .001 rad.
    assert figures["silhouette_difference"] < 0.15
    assert "deviations are too small" in found.warning()
    figures = run_sequence(shared_data / "hand_sequences" / "count").figures
    assert figures["lost"] == 0
    assert 0 < figures["rejected_by_an_inequality"] <= figures["mirrored"]
