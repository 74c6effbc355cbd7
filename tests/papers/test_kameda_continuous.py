"""Experiment A with angles between the samples, and another body."""

import itertools
import json

import numpy as np
import pytest

from drake_pose.commands.main import app
from drake_pose.errors import SettingsError
from drake_pose.papers.kameda import (
    OFFSET_MISMATCH,
    WIDTH_MISMATCH,
    change_body,
    continuous_search,
    experiment_search,
    run_experiment,
)
from drake_pose.papers.kameda_figures import continuous_figures, continuous_table
from tests.cli import CliRunner


@pytest.fixture(scope="module")
def result():
    return run_experiment(continuous_search(), 2, 7, views=2)


def test_cameras_are_spread_over_half_a_turn():
    cameras = run_experiment(experiment_search(), 1, 7, views=3, renderer="own").cameras
    for before, after in itertools.pairwise(cameras):
        assert before.X_WC[:3, 2] @ after.X_WC[:3, 2] == pytest.approx(np.cos(np.pi / 3))
        origins = [camera.project(np.zeros((1, 3)))[0] for camera in (before, after)]
        np.testing.assert_allclose(origins[0], origins[1])
    for bad in ({"views": 0}, {"images": 0}):
        with pytest.raises(SettingsError, match=next(iter(bad))):
            run_experiment(experiment_search(), **bad)


@pytest.mark.slow
def test_figures_come_from_the_trials(result):
    figures = continuous_figures(result)
    assert (figures["images"], figures["views"], figures["interval_confidence"]) == (2, 2, 0.95)
    E_total = [trial.result.E_total for trial in result.trials]
    assert figures["mean_e_total"] == pytest.approx(np.mean(E_total))
    assert figures["median_e_total"] < 0.01
    errors, known = [], []
    for trial in result.trials:
        true = np.concatenate(trial.true_values)
        off = np.degrees(np.abs(np.concatenate(trial.result.node_values) - true))
        # The root's place is known, all else is searched for.
        errors += off[3:].tolist()
        known += off[3:][list(trial.result.pose_set.determined)[3:]].tolist()
    assert figures["median_error_deg"] == pytest.approx(np.median(errors))
    assert figures["median_determined_error_deg"] == pytest.approx(np.median(known), abs=1e-9)
    assert figures["determined"] == pytest.approx(len(known) / len(errors))
    assert np.median(known) < 0.5
    assert figures["interval_coverage"] > 0.8
    assert continuous_table({"one": result, "other": result}).row_count == 12


def test_another_body_has_other_measures():
    search = experiment_search()
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


@pytest.mark.slow
def test_the_command_prints_both_bodies():
    arguments = ["reproduce", "kameda", "--angles", "continuous", "--views", "2", "--mismatch"]
    done = CliRunner().invoke(app, [*arguments, "--images", "1", "--json"])
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert not figures["mismatch"]
    assert figures["another_body"]["mismatch"]
    assert figures["another_body"]["median_e_total"] > figures["median_e_total"]
