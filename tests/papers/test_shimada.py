"""Shimada's synthetic hand: accuracy of the filters, hypotheses, and the command."""

import json

import numpy as np
import pytest
from scipy.stats import chi2

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import HAND_STATE, LENGTHS, HandObservation
from drake_pose.papers.pictures import save_hands
from drake_pose.papers.shimada import (
    CASES,
    PICTURES,
    experiment_filter,
    result_table,
    run_experiment,
)
from drake_pose.papers.shimada_sequences import experiment_settings, make_sequence
from tests.cli import run_command
from tests.papers.hands import followed_hypotheses

LENGTH = HAND_STATE.indices(LENGTHS)


@pytest.fixture(scope="module")
def result():
    return run_experiment(3, 3, experiment_settings(), "full")


@pytest.fixture(scope="module")
def hypotheses():
    return followed_hypotheses()


def reproduce(*words, code=0):
    """Return the command's JSON, or its error text."""
    made = run_command(["reproduce", "shimada", *words])
    assert made.exit_code == code, made.output
    return json.loads(made.stdout) if "--json" in words else made.stderr


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
    figures, rows = result.as_json(), experiment_filter()[0].inequalities
    for key, r_13 in CASES.items():
        trials, own = result.trials[key], figures[key]
        assert all(
            trial.truths[-1, HAND_STATE.index("length_13")] == r_13 / 1000 for trial in trials
        )
        assert own["length_error_mean"] < 0.7
        assert own["bound_length_error_mean"] < own["length_error_mean"]
        assert (own["lost"], own["angle_rmse"] < 3.0, own["inside_2sigma"] > 0.8) == (0, True, True)
        assert all((rows.b - trial.means @ rows.phi.T).min() > -1e-6 for trial in trials)
    assert (figures["runs"], figures["truncation"], figures["seed"]) == (3, "joint", 3)
    assert result_table(result).row_count >= 7


def test_figures_are_statistics_of_runs_and_frames(result):
    """Recomputed run by run and frame by frame."""
    for key, trials in result.trials.items():
        found, watched = result.as_json()[key], [*LENGTH, *range(6, 14)]
        lengths, ends, angles, inside, nees, bounds = [], [], [], [], [], []
        for one in trials:
            off = one.means - one.truths
            lengths.append(1000.0 * np.mean([abs(off[-1, k]) for k in LENGTH]))
            angles += [np.degrees(np.sqrt(np.mean(row[6:14] ** 2))) for row in off]
            ends.append(angles[-1])
            inside.append(
                [abs(row) < 2.0 * sd for row, sd in zip(off, one.deviations, strict=True)]
            )
            C = one.states[-1].best.covariance[np.ix_(LENGTH, LENGTH)]
            nees.append(off[-1, LENGTH] @ np.linalg.solve(C, off[-1, LENGTH]))
            bounds.append(1000.0 * np.abs(one.bound - one.truths[-1])[LENGTH].mean())
        inside, largest = np.array(inside)[:, :, watched], max(
            abs(one.means[-1, k] / one.truths[-1, k] - 1.0) for one in trials for k in LENGTH
        )  # fmt: skip
        low, high = chi2(6).ppf([0.025, 0.975])
        times = np.concatenate([one.milliseconds for one in trials])
        expected = {
            "length_error_mean": np.mean(lengths),
            "length_error_p95": np.percentile(lengths, 95),
            "bound_length_error_mean": np.mean(bounds),
            "angle_rmse": np.sqrt(np.mean(np.square(angles))),
            "angle_rmse_at_end": np.sqrt(np.mean(np.square(ends))),
            "inside_2sigma": inside[:, -1].mean(),
            "inside_2sigma_all": inside.mean(),
            "nees_inside": np.mean([low < one < high for one in nees]),
            "length_error_largest": largest,
            "ms_per_update": np.median(times),
            "ms_per_update_p95": np.percentile(times, 95),
            "lost": 0,
            "rejected_by_an_inequality": sum(one.rejected for one in trials),
            "mirrored": sum(
                sum(len(state.rejections) for state in one.states)
                + len(one.states[-1].hypotheses) - 1 for one in trials
            ),
        }  # fmt: skip
        assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-6)
        assert 0.02 < np.median(times) < 1000.0


@pytest.mark.parametrize(("bad", "word"), [({"runs": 0}, "runs"), ({"observed": "x"}, "observed")])
def test_bad_arguments_are_named(bad, word):
    with pytest.raises(SettingsError, match=word):
        run_experiment(**{"runs": 1, "seed": 0, "settings": experiment_settings()} | bad)


def test_pictures_and_hypotheses_exclude_each_other():
    assert "--hypotheses" in reproduce("--pictures", "--hypotheses", code=2)


def test_hypotheses_have_one_continuous_history(hypotheses):
    assert len(hypotheses.histories) > 12
    weights, heaviest = np.zeros((12, 56)), {}
    for one in hypotheses.histories:
        assert np.array_equal(np.diff(one.frames), np.ones(len(one.frames) - 1))
        assert len(one.means) == len(one.frames)
        assert np.isnan(one.weights[-1]) == bool(one.reason)
        assert one.lived == np.count_nonzero(np.isfinite(one.weights))
        weights[one.run, one.frames] += np.nan_to_num(one.weights)
        for frame, weight in zip(one.frames, one.weights, strict=True):
            if weight > heaviest.get((one.run, frame), (0.0,))[0]:
                heaviest[one.run, frame] = weight, one.at(frame)
    assert weights[:, 1:] == pytest.approx(1.0)
    # Errors are those of the last valid frame, and of the heaviest hypothesis at the end.
    for one in hypotheses.histories:
        truths, end = hypotheses.sequences[one.run].states, one.frames[-1]
        last = one.frames[max(one.lived - 1, 0)]
        kept = heaviest[one.run, end][1]
        for state, frame, error in ((one.at(last), last, one.error), (kept, end, one.kept_error)):
            off = np.degrees(state - truths[frame - 1])[6:14]
            assert error == pytest.approx(np.sqrt((off**2).mean()))
        assert one.wrong == (one.error > one.kept_error)
    figures, reasons = hypotheses.as_json(), [one.reason for one in hypotheses.histories]
    later = [one for one in hypotheses.histories if one.reason == "constraint" and one.lived]
    coupled = [one for one in later if " - " in one.row and "flexion" in one.row]
    lost = np.count_nonzero(np.array(hypotheses.final_errors) > 20.0)
    expected = {
        "mirrored": len(reasons) - 12, "became_another": reasons.count("twin"),
        "too_many": reasons.count("cap"), "alive_at_the_end": reasons.count(""),
        "rejected_by_an_inequality": reasons.count("constraint"),
        "rejected_later_than_made": len(later), "of_these_wrong": sum(one.wrong for one in later),
        "of_these_by_coupled_joints": len(coupled), "lost": lost, "runs": 12,
        "frames_lived_median": np.median([one.lived for one in later]),
        "angle_error_at_end": np.median(hypotheses.final_errors),
    }  # fmt: skip
    assert {name: figures[name] for name in expected} == pytest.approx(expected)
    assert hypotheses.table().row_count == 11


def test_inequalities_reject_hypotheses_that_explain_the_measurements(hypotheses):
    later = [one for one in hypotheses.histories if one.reason == "constraint" and one.lived]
    assert len(later) >= 2
    assert np.mean([one.wrong for one in later]) > 0.6
    rows = hypotheses.inequalities
    beyond = []
    for one in later:
        k = rows.rows.index(one.row)
        assert one.c < -4
        assert rows.phi[k] @ one.means[-2] <= rows.b[k] + 1e-9
        beyond.append(rows.phi[k] @ one.means[-1] > rows.b[k])
    # A later row is evaluated after the truncation by earlier ones.
    assert np.mean(beyond) > 0.5


def test_iterated_filter_merges_mirrored_hypotheses(tmp_path):
    """With iterated linearisations mirrored predictions converge to the same estimate."""
    words = ("--hypotheses", "--runs", "2", "--truncation", "joint", "--iterations", "20")
    figures = reproduce(*words, "--json")
    assert figures["rejected_later_than_made"] == 0
    assert figures["became_another"] > 0
    assert "nothing to draw" in reproduce(*words, "--out", str(tmp_path / "out"))
    papers = reproduce("--hypotheses", "--runs", "1", "--json")
    assert (papers["truncation"], papers["iterations"]) == ("sequential", 1)
