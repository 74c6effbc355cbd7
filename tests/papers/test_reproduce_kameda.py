"""Experiments B and C, and what the command `reproduce kameda` refuses."""

import itertools
import json

import numpy as np
import pytest

from drake_pose.commands.main import app
from drake_pose.errors import SceneError, SettingsError
from drake_pose.jobs.demo import stored_scene
from drake_pose.papers.kameda import (
    OFFSET_MISMATCH,
    WIDTH_MISMATCH,
    change_body,
    continuous_search,
    experiment_search,
    run_experiment,
)
from drake_pose.papers.kameda_figures import continuous_figures, continuous_table
from drake_pose.papers.kameda_real_pictures import REAL_EXPERIMENTS
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.cli import CliRunner


def reproduce(*options):
    return CliRunner().invoke(app, ["reproduce", "kameda", *options])


def test_a_folder_that_holds_something_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    refused = reproduce("--experiment", "C", "--out", str(tmp_path))
    assert refused.exit_code == 1
    assert "not empty" in refused.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_the_pictures_are_there():
    frames = [load_scene(stored_scene(one.scene)).frames for one in REAL_EXPERIMENTS.values()]
    assert frames[0] == ("0000", "0010", "0020", "0030", "0040", "0049")
    assert len(frames[1]) == 2
    with pytest.raises(SceneError, match="'none'"):
        stored_scene("none")


@pytest.mark.slow
def test_both_methods_find_the_hand(tmp_path):
    """One of two pictures; E_total is compared with Drake's label image of the pose found."""
    made = reproduce("--experiment", "C", "--images", "1", "--out", str(tmp_path / "c"), "--json")
    assert made.exit_code == 0, made.output
    ours = json.loads(made.stdout)
    paper = ours["paper_method"]
    assert (ours["images"], paper["images"], ours["paper_images"]) == (1, 1, 3)
    assert (ours["method"], paper["method"]) == ("beam", "paper")
    assert ours["paper_mean_e_total"] == 0.172
    for figures in (ours, paper):
        assert figures["not_found"] == 0
        assert figures["mean_e_total"] == figures["e_total"]["0000"]
        folder = tmp_path / "c" / figures["method"]
        record = json.loads((folder / "summary.json").read_text())["frames"]["0000"]
        (iou,) = record["ious"].values()
        # Of an area J of their difference, whichever of the two bodies it lies outside of.
        assert 1 - iou - 0.005 <= figures["mean_e_total"] <= (1 - iou) / iou + 0.005
        assert len(list(folder.rglob("overlay/*/0000.png"))) == 1
    assert ours["mean_e_total"] < min(0.172, paper["mean_e_total"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--experiment", "D"), ("--experiment", "A", "B", "C")),
        (("--experiment", "B", "--seed", "1"), ("--seed", "--experiment A")),
        (("--experiment", "C", "--outside-limit", "9"), ("--outside-limit", "--experiment A")),
        (("--mismatch",), ("continuous",)),
        (("--views", "1"), ("continuous",)),
        (("--views", "0", "--angles", "continuous"), ("views",)),
        (("--angles", "continuous", "--method", "paper"), ("grid",)),
        (("--angles", "continuous", "--outside-limit", "200"), ("grid",)),
        (("--angles", "odd"), ("--angles", "grid", "continuous")),
        (("--edges",), ("--method beam",)),
        (("--edge-noise", "0.1", "--method", "beam"), ("--edges",)),
    ],
)
def test_what_means_nothing_is_refused(options, words):
    refused = reproduce("--images", "1", *options)
    assert refused.exit_code == 2
    for word in words:
        assert word in refused.stderr


def test_the_searches_stand_beside_the_one_that_was_asked_for():
    words = ("--images", "1", "--seeds", "2", "--renderer", "own", "--json")
    made = reproduce(*words, "--outside-weight", "10")
    assert made.exit_code == 0, made.output
    weighted = json.loads(made.stdout)
    paper = weighted["paper_method"]
    assert (weighted["outside_weight"], paper["outside_weight"]) == (10.0, 0.0)
    for one in (weighted, paper):
        assert one["spread"]["mean_runs"]["min"] <= one["mean_runs"]
        assert not {"seed", "images", "total_seconds"} & set(one["spread"])


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
