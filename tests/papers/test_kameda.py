"""Kameda's experiments: drawn poses, figures, tables, pictures and the command."""

import json
import math
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.papers.kameda import (
    REAL_EXPERIMENTS,
    Causes,
    beam_experiment_search,
    causes_of_wrong_angles,
    continuous_figures,
    continuous_table,
    draw_values,
    experiment_camera,
    experiment_search,
    experiment_tree,
    grid_figures,
    grid_table,
    run_experiment,
)
from drake_pose.search import MultiStartSearch, PoseEstimate
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.cli import run_command


def reproduce(*options):
    return run_command(["reproduce", "kameda", *options])


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
    assert depths[2] < depths[0] == 5.0


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
        assert trial.inside
        if trial.result.found:
            q_true, _ = result.search.tree.positions_from(trial.true_values)
            true, found = renderer.mask(q_true), renderer.mask(trial.result.q)
            # The two renderers differ by at most 0.2 % of a mask each.
            expected = (true ^ found).sum() / true.sum()
            assert trial.result.E_total == pytest.approx(expected, abs=0.004)


def test_figures_are_counts_and_means_over_poses(search, result):
    nothing = PoseEstimate.nothing(search.tree, stopped_by="end")
    lost = [replace(one, result=nothing, inside=False) for one in result.trials[:2]]
    rest = [
        replace(one, tolerance=10.0 * k, result=replace(one.result, J=10.0 * k + k % 2, first_J=J))
        for k, (one, J) in enumerate(zip(result.trials[2:], (None, 1e6, 1.0), strict=True))
    ]
    rest[1] = replace(rest[1], causes=Causes(True, False))
    rest[2] = replace(rest[2], causes=Causes(False, False), seconds=7.0)
    trials = [*lost, *rest]
    figures = grid_figures(replace(result, trials=tuple(trials)))
    assert [one.exact for one in trials] == [False, False, True, False, True]
    assert [one.pose_equal for one in trials] == [False, False, True, False, False]
    E_total = [one.result.J / one.result.area for one in rest]
    runs, seconds = ([f(one) for one in trials] for f in (lambda t: t.result.runs,
                                                         lambda t: t.seconds))  # fmt: skip
    expected = {
        "images": 5, "not_found": 2, "exact": 2, "pose_equal": 1, "wrong_hidden": 1,
        "wrong_inner_edges": 0, "wrong_alike": 1, "improved": 1, "min_runs": min(runs),
        "mean_e_total": np.mean(E_total), "mean_runs": np.mean(runs), "tolerance": 20.0,
        "median_seconds": np.median(seconds), "p95_seconds": np.percentile(seconds, 95),
        "leaving_the_picture": 2 + sum(not one.inside for one in rest), "method": "paper",
        "mean_runs_without_worst_seven": np.mean(runs),
    }  # fmt: skip
    assert {key: figures[key] for key in expected} == pytest.approx(expected)
    many = replace(result, trials=tuple(trials * 2))
    without = np.sort(runs * 2)[:-7].mean()
    assert grid_figures(many)["mean_runs_without_worst_seven"] == pytest.approx(without)
    table = grid_table([result, many])
    assert [column.header for column in table.columns][1:] == ["paper", "the paper's method"]


def test_beam_search_matches_every_silhouette_and_its_set_has_the_true_pose(beam_result):
    """Without a threshold r, for poses that the paper's search mostly misses."""
    figures = grid_figures(beam_result)
    assert figures["exact"] == figures["proved"] == figures["truth_in_set"] == 6
    assert figures["method"] == "beam"
    for trial in beam_result.trials:
        values = np.concatenate(trial.true_values)
        joints = trial.result.pose_set.joints
        assert 0.0 < trial.seconds + trial.more_seconds < time.process_time()
        assert all(joint.holds(value) for joint, value in zip(joints, values, strict=True))


def test_the_real_forearm_points_up_and_its_hand_shows_either_side(tmp_path):
    given = REAL_EXPERIMENTS["C"].settings(tmp_path)
    turns = {"y": (-180.0, 180.0), "x": (-30.0, 30.0), "z": (-30.0, 30.0)}
    assert (given.root, given.root_rotation) == ("forearm", turns)


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


class Known(MultiStartSearch):
    """A search that is told the joints' values, and errs by 1, 2, ... degrees."""

    def match(self, views):
        self.count = getattr(self, "count", 0) + 1
        generator = np.random.default_rng(7)
        values = [draw_values(self, "continuous", generator) for _ in range(self.count)][-1]
        off = [value + np.radians(self.count) * (np.ptp(grid, axis=0) > 0.0)
               for value, grid in zip(values, self.sampled.values, strict=True)]  # fmt: skip
        joints = [
            SimpleNamespace(determined=k % 3 > 0, holds=lambda x, k=k: k % 2 == 0)
            for k in range(sum(map(len, values)))
        ]
        known = SimpleNamespace(joints=joints) if self.count < 3 else None
        return PoseEstimate.of_values(
            self.tree, off, 30.0 * self.count, 1000.0, stopped_by="end", seconds=4.0,
            interval_seconds=1.0, pose_set=known,
        )  # fmt: skip


def test_figures_of_continuous_angles():
    search = Known(experiment_tree(), exact_masks=True)
    result = run_experiment(search, 3, 7, views=2)
    figures = continuous_figures(result)
    before, after = result.cameras
    assert before.X_WC[:3, 2] @ after.X_WC[:3, 2] == pytest.approx(0.0)
    searched = np.concatenate([np.ptp(one, axis=0) > 0.0 for one in search.sampled.values])
    known = np.flatnonzero(searched & (np.arange(len(searched)) % 3 > 0))
    expected = {
        "images": 3, "views": 2, "interval_confidence": 0.95, "seed": 7, "median_error_deg": 2.0,
        "mean_e_total": 0.06, "median_e_total": 0.06, "median_determined_error_deg": 1.5,
        "determined": 2 * len(known) / (3 * searched.sum()),
        "interval_coverage": np.mean(known % 2 == 0),
    }  # fmt: skip
    assert {key: figures[key] for key in expected} == pytest.approx(expected)
    for trial in result.trials:
        # Intervals take the same fraction of processor time as of wall-clock time.
        assert trial.more_seconds == pytest.approx(trial.seconds / 3.0)
        assert trial.causes is None
    assert figures["mean_interval_seconds"] == pytest.approx(figures["mean_seconds"] / 3.0)
    assert continuous_table(result).row_count == 11
    for bad in ({"views": 0}, {"images": 0}):
        with pytest.raises(SettingsError, match=next(iter(bad))):
            run_experiment(search, **{"images": 1, "seed": 0} | bad)


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
    ("options", "word"),
    [
        ("--experiment D", "--experiment"), ("--experiment B --seed 1", "--experiment A"),
        ("--views 1", "continuous"), ("--views 0 --angles continuous", "views"),
        ("--angles continuous --method paper", "grid"), ("--angles odd", "--angles"),
    ],
)  # fmt: skip
def test_incompatible_options_are_refused(options, word):
    refused = reproduce("--images", "1", *options.split())
    assert (refused.exit_code, word in refused.stderr) == (2, True)
