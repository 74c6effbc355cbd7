"""Kameda's experiments: drawn poses, figures, tables, pictures and the command."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from drake_pose.commands.main import app
from drake_pose.errors import SettingsError
from drake_pose.files.overlay import MISSING_RGB
from drake_pose.papers.kameda import (
    beam_experiment_search,
    causes_of_wrong_angles,
    continuous_figures,
    continuous_table,
    draw_values,
    experiment_camera,
    experiment_search,
    experiment_tree,
    grid_figures,
    run_experiment,
)
from drake_pose.papers.pictures import save_poses
from drake_pose.search import MultiStartSearch, PoseEstimate
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.cli import CliRunner


def reproduce(*options):
    return CliRunner().invoke(app, ["reproduce", "kameda", *options])


@pytest.fixture(scope="module")
def search():
    return experiment_search()


@pytest.fixture(scope="module")
def result(search):
    return run_experiment(search, images=5, seed=5)


@pytest.fixture(scope="module")
def beam_result():
    return run_experiment(beam_experiment_search(), images=6, seed=5)


def test_camera_is_the_papers():
    camera, side = experiment_camera(), experiment_camera(0.5 * np.pi)
    assert (camera.width, camera.height, camera.pixels_per_metre) == (700, 700, 226.0)
    # World y is the picture's right, z its up, and x points to the camera; seen from the side, x
    # points left.
    axes = np.vstack([np.zeros(3), np.eye(3)])
    for one, expected in (
        (camera, [[0, 0], [226, 0], [0, -226]]),
        (side, [[-226, 0], [0, 0], [0, -226]]),
    ):
        pixels, depths = one.project(axes)
        np.testing.assert_allclose(pixels[1:] - pixels[0], expected, atol=1e-9)
    assert depths[2] < depths[0]


def test_drawn_angles_are_multiples_of_20_degrees_or_continuous_inside_table_2(search):
    model = search.tree.model
    on_grid, between = (
        draw_values(search, angles, np.random.default_rng(1)) for angles in ("grid", "continuous")
    )
    for node, values in zip(search.tree.nodes, on_grid, strict=True):
        for index, value in zip(node.positions, values, strict=True):
            assert model.lower[index] - 1e-9 <= value <= model.upper[index] + 1e-9
            if model.position_kinds[index] == "angle":
                assert math.degrees(value) / 20 == pytest.approx(round(math.degrees(value) / 20))
    # The root's position is known.
    np.testing.assert_array_equal(between[0][:3], 0.0)
    off = [abs(math.degrees(v) / 20 - round(math.degrees(v) / 20)) for v in between[0][3:]]
    assert max(off) > 0.01


def test_figures_match_drakes_label_images(result):
    """E_total, recomputed from Drake's own label images of the true and the found pose."""
    renderer = LabelRenderer(result.search.tree.model, result.cameras[0])
    for trial in result.trials:
        if trial.result.found:
            q_true, _ = result.search.tree.positions_from(trial.true_values)
            true, found = renderer.mask(q_true), renderer.mask(trial.result.q)
            # The two renderers differ by at most 0.2 % of a mask each.
            expected = (true ^ found).sum() / true.sum()
            assert trial.result.E_total == pytest.approx(expected, abs=0.004)


def test_poses_not_found_are_counted_separately(search, result):
    nothing = PoseEstimate.nothing(search.tree, stopped_by="end")
    lost = [replace(one, result=nothing) for one in result.trials[:2]]
    figures = grid_figures(replace(result, trials=(*lost, *result.trials[2:])))
    assert figures["not_found"] == 2
    found = [trial.result.E_total for trial in result.trials[2:]]
    assert figures["mean_e_total"] == pytest.approx(np.mean(found))


def test_beam_search_matches_every_silhouette_and_its_set_has_the_true_pose(beam_result):
    """Without a threshold r, for poses that the paper's search mostly misses."""
    figures = grid_figures(beam_result)
    assert figures["exact"] == figures["proved"] == figures["truth_in_set"] == 6
    assert figures["method"] == "beam"
    for trial in beam_result.trials:
        values = np.concatenate(trial.true_values)
        joints = trial.result.pose_set.joints
        assert all(joint.holds(value) for joint, value in zip(joints, values, strict=True))


def test_pictures_show_the_outcomes(result, beam_result, tmp_path):
    save_poses(beam_result, tmp_path / "beam")
    names = {file.stem for file in (tmp_path / "beam").iterdir()}
    assert "figure_12_not_matched" not in names
    right = [trial.pose_equal for trial in beam_result.trials]
    assert ("figure_07_pose_right" in names) == any(right)
    save_poses(result, tmp_path / "paper")
    missed = sum(trial.result.found and not trial.exact for trial in result.trials)
    picture = cv2.imread(str(tmp_path / "paper" / "figure_12_not_matched.png"))
    # Each pose differs from its silhouette: blue of the silhouette only, orange of the body only.
    assert missed > 0
    for row in np.array_split(picture, min(missed, 4)):
        assert (row[..., ::-1] == MISSING_RGB).all(axis=-1).sum() > 200


def at(search, **degrees):
    """Return the nodes' values with the given angles [deg], all others 0."""
    model = search.tree.model
    q = np.zeros(len(model.position_names))
    for name, value in degrees.items():
        q[model.position_index(name)] = np.radians(value)
    return search.tree.values_from_positions(q)


def test_hand_before_the_belly_is_hidden_from_behind(search):
    camera = experiment_camera()
    behind = replace(camera, X_WC=np.diag([-1.0, -1.0, 1.0, 1.0]) @ camera.X_WC)
    arm = {"right_upper_arm_x": -15, "right_upper_arm_y": 60, "right_forearm_x": -60}
    true, found = at(search, **arm), at(search, **arm, right_hand_x=20)
    before = causes_of_wrong_angles(search.sampled, camera, true, found)
    assert (before.hidden, before.inner_edges) == (False, True)
    after = causes_of_wrong_angles(search.sampled, behind, true, found)
    assert (after.hidden, after.inner_edges) == (True, False)
    assert causes_of_wrong_angles(search.sampled, camera, true, true) == (False, False)


def test_cameras_are_spread_over_180_degrees():
    before, after = run_experiment(experiment_search(), 1, 7, views=2).cameras
    assert before.X_WC[:3, 2] @ after.X_WC[:3, 2] == pytest.approx(0.0)
    origins = [camera.project(np.zeros((1, 3)))[0] for camera in (before, after)]
    np.testing.assert_allclose(origins[0], origins[1])
    for bad in ({"views": 0}, {"images": 0}):
        with pytest.raises(SettingsError, match=next(iter(bad))):
            run_experiment(experiment_search(), **{"images": 1, "seed": 0} | bad)


@pytest.mark.slow
def test_figures_of_continuous_angles():
    result = run_experiment(MultiStartSearch(experiment_tree(), exact_masks=True), 2, 7, views=2)
    figures = continuous_figures(result)
    assert (figures["images"], figures["views"], figures["interval_confidence"]) == (2, 2, 0.95)
    E_total = [trial.result.E_total for trial in result.trials]
    assert figures["mean_e_total"] == pytest.approx(np.mean(E_total))
    assert figures["median_e_total"] < 0.01
    errors, known = [], []
    for trial in result.trials:
        true = np.concatenate(trial.true_values)
        off = np.degrees(np.abs(np.concatenate(trial.result.node_values) - true))
        # The root's position is known, all other values are searched.
        errors += off[3:].tolist()
        known += off[3:][list(trial.result.pose_set.determined)[3:]].tolist()
        # Intervals take the same fraction of processor time as of wall-clock time.
        part = trial.more_seconds / (trial.seconds + trial.more_seconds)
        assert part == pytest.approx(trial.result.interval_seconds / trial.result.seconds)
    assert figures["median_error_deg"] == pytest.approx(np.median(errors))
    assert figures["median_determined_error_deg"] == pytest.approx(np.median(known), abs=1e-9)
    assert figures["determined"] == pytest.approx(len(known) / len(errors))
    assert np.median(known) < 0.5
    assert figures["interval_coverage"] > 0.8
    assert continuous_table(result).row_count == 11


@pytest.mark.slow
def test_both_methods_find_the_hand(tmp_path):
    """In one of two pictures; E_total is compared with Drake's label image of the found pose."""
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
        # J is the area of the symmetric difference.
        assert 1 - iou - 0.005 <= figures["mean_e_total"] <= (1 - iou) / iou + 0.005
        assert len(list(folder.rglob("overlay/*/0000.png"))) == 1
    assert ours["mean_e_total"] < min(0.172, paper["mean_e_total"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--experiment", "D"), ("--experiment", "A", "B", "C")),
        (("--experiment", "B", "--seed", "1"), ("--seed", "--experiment A")),
        (("--views", "1"), ("continuous",)),
        (("--views", "0", "--angles", "continuous"), ("views",)),
        (("--angles", "continuous", "--method", "paper"), ("grid",)),
        (("--angles", "odd"), ("--angles", "grid", "continuous")),
    ],
)
def test_incompatible_options_are_refused(options, words):
    refused = reproduce("--images", "1", *options)
    assert refused.exit_code == 2
    for word in words:
        assert word in refused.stderr
