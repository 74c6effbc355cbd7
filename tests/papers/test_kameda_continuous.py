import itertools
import json

import numpy as np
import pytest

from drake_pose.commands.main import app
from drake_pose.errors import SettingsError
from drake_pose.papers.kameda.continuous import (
    OFFSET_MISMATCH,
    WIDTH_MISMATCH,
    change_body,
    continuous_search,
    continuous_table,
    experiment_cameras,
    run_continuous_experiment,
)
from tests.cli import CliRunner


@pytest.fixture(scope="module")
def search():
    return continuous_search()


@pytest.fixture(scope="module")
def result(search):
    return run_continuous_experiment(search, images=2, seed=7, views=2)


def test_cameras_are_spread_over_half_a_turn():
    for views in (1, 2, 4):
        axes = [camera.X_WC[:3, 2] for camera in experiment_cameras(views)]
        for before, after in itertools.pairwise(axes):
            assert before @ after == pytest.approx(np.cos(np.pi / views))
        origins = [camera.project(np.zeros((1, 3)))[0][0] for camera in experiment_cameras(views)]
        np.testing.assert_allclose(origins, np.tile(origins[0], (views, 1)))
    with pytest.raises(SettingsError, match="views"):
        experiment_cameras(0)


@pytest.mark.slow
def test_figures_come_from_the_trials(result):
    figures = result.as_json()
    assert figures["images"] == 2
    assert figures["views"] == 2
    assert figures["interval_confidence"] == 0.95
    E_total = [trial.result.E_total for trial in result.trials]
    assert figures["mean_e_total"] == pytest.approx(np.mean(E_total))
    assert figures["median_e_total"] < 0.01
    assert figures["median_determined_error_deg"] < 0.5
    assert figures["interval_coverage"] > 0.8
    for trial in result.trials:
        found = np.concatenate(trial.result.node_values)
        np.testing.assert_allclose(trial.errors, np.degrees(np.abs(found - trial.true_values)))
        # The root's place is known, all else is searched for.
        assert np.count_nonzero(~trial.searched) == 3
        assert not (trial.determined & ~trial.searched).any()
    assert continuous_table({"one": result, "other": result}).row_count == 11


@pytest.mark.slow
def test_the_same_every_time(search, result):
    again = run_continuous_experiment(search, images=1, seed=7, views=2)
    np.testing.assert_array_equal(again.trials[0].result.q, result.trials[0].result.q)


def test_another_body_has_other_measures(search):
    values = [0.3 * np.ones(len(node.value_names)) for node in search.tree.nodes]
    X_WN, outlines = search.tree.node_poses(values), search.sampled.surfaces.at(values)
    moved, surfaces = change_body(search.tree, X_WN, outlines, np.random.default_rng(2))
    np.testing.assert_array_equal(moved[:, :3, :3], X_WN[:, :3, :3])
    for i, node in enumerate(search.tree.nodes):
        sizes = [np.ptp(outline.vertices, axis=0) for outline in (outlines[i], surfaces[i])]
        assert np.all(np.abs(sizes[1] / sizes[0] - 1.0) < WIDTH_MISMATCH + 1e-9)
        assert np.abs(sizes[1] / sizes[0] - 1.0).max() > 1e-4
        if node.parent >= 0:
            before = X_WN[i, :3, 3] - X_WN[node.parent, :3, 3]
            after = moved[i, :3, 3] - moved[node.parent, :3, 3]
            share = np.linalg.norm(after) / np.linalg.norm(before)
            assert abs(share - 1.0) <= OFFSET_MISMATCH + 1e-9
            np.testing.assert_allclose(after, share * before, atol=1e-12)


def test_continuous_angles_mean_the_same_with_and_without_a_number_of_cameras(monkeypatch):
    asked = []

    def run(*arguments):
        asked.append(arguments)
        return {}

    monkeypatch.setattr("drake_pose.commands.papers.kameda._run_beside", run)
    monkeypatch.setattr("drake_pose.commands.papers.kameda._print_continuous", lambda *_: None)
    for words in ([], ["--views", "1"]):
        arguments = ["reproduce", "kameda", "--angles", "continuous", "--images", "3", *words]
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == 0, done.output
    assert asked == [(3, 0, 1, False)] * 2


@pytest.mark.slow
def test_the_command_prints_both_bodies():
    arguments = ["reproduce", "kameda", "--angles", "continuous", "--views", "2", "--mismatch"]
    done = CliRunner().invoke(app, [*arguments, "--images", "1", "--json"])
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert not figures["mismatch"]
    assert figures["another_body"]["mismatch"]
    assert figures["another_body"]["median_e_total"] > figures["median_e_total"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--mismatch"], "continuous"),
        (["--views", "2"], "continuous"),
        (["--views", "1"], "continuous"),
        (["--views", "0", "--angles", "continuous"], "views"),
        (["--angles", "continuous", "--method", "paper"], "grid"),
        (["--angles", "continuous", "--outside-limit", "200"], "grid"),
    ],
)
def test_wrong_options_are_refused(arguments, word):
    done = CliRunner().invoke(app, ["reproduce", "kameda", "--images", "1", *arguments])
    assert done.exit_code == 2
    assert word in done.output
