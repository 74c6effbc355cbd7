"""Experiment A on the grid: what is drawn, counted and shown."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drake_pose.papers.kameda import (
    beam_experiment_search,
    causes_of_wrong_angles,
    draw_values,
    experiment_camera,
    experiment_search,
    run_experiment,
)
from drake_pose.papers.kameda_figures import (
    PAPER,
    edge_lines,
    grid_figures,
    grid_table,
    noisy_edges,
    settle_by_edges,
)
from drake_pose.papers.kameda_pictures import (
    chest_ranks,
    ratio_within,
    save_pictures,
)
from drake_pose.search import PoseEstimate
from drake_pose.search.inner_edges import edges_of_labels
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer


@pytest.fixture(scope="module")
def search():
    return experiment_search()


@pytest.fixture(scope="module")
def result(search):
    return run_experiment(search, images=5, seed=5)


@pytest.fixture(scope="module")
def beam_result():
    return run_experiment(beam_experiment_search(), images=6, seed=5)


def test_the_camera_is_the_papers():
    camera, side = experiment_camera(), experiment_camera(0.5 * np.pi)
    assert (camera.width, camera.height, camera.pixels_per_metre) == (700, 700, 226.0)
    # The world's y is the picture's right, z its up, x comes towards the camera; from the side,
    # what comes towards the front goes left.
    axes = np.vstack([np.zeros(3), np.eye(3)])
    for one, expected in (
        (camera, [[0, 0], [226, 0], [0, -226]]),
        (side, [[-226, 0], [0, 0], [0, -226]]),
    ):
        pixels, depths = one.project(axes)
        np.testing.assert_allclose(pixels[1:] - pixels[0], expected, atol=1e-9)
    assert depths[2] < depths[0]


def test_drawn_angles_are_multiples_of_20_degrees_inside_table_2_or_between(search):
    model = search.tree.model
    on_grid, between = (
        draw_values(search, angles, np.random.default_rng(1)) for angles in ("grid", "continuous")
    )
    for node, values in zip(search.tree.nodes, on_grid, strict=True):
        for index, value in zip(node.positions, values, strict=True):
            assert model.lower[index] - 1e-9 <= value <= model.upper[index] + 1e-9
            if model.position_kinds[index] == "angle":
                assert math.degrees(value) / 20 == pytest.approx(round(math.degrees(value) / 20))
    # The root's place is known.
    np.testing.assert_array_equal(between[0][:3], 0.0)
    off = [abs(math.degrees(v) / 20 - round(math.degrees(v) / 20)) for v in between[0][3:]]
    assert max(off) > 0.01


def test_the_figures_are_what_drake_draws(result):
    """E_total, recomputed from Drake's own label images of the true and the found pose."""
    renderer = LabelRenderer(result.search.tree.model, result.cameras[0])
    for trial in result.trials:
        if trial.result.found:
            q_true, _ = result.search.tree.positions_from(trial.true_values)
            true, found = renderer.mask(q_true), renderer.mask(trial.result.q)
            # The two renderers differ by at most 0.2 % of a mask each.
            expected = (true ^ found).sum() / true.sum()
            assert trial.result.E_total == pytest.approx(expected, abs=0.004)


def test_json_has_the_keys_of_the_paper_and_the_same_seed_the_same_figures(search, result):
    figures = grid_figures(result)
    assert set(PAPER) | {"median_seconds"} <= set(figures)
    assert figures["images"] == 5
    E_total = [trial.result.E_total for trial in result.trials]
    assert figures["mean_e_total"] == pytest.approx(np.mean(E_total))
    assert figures["min_runs"] == min(trial.result.statistics.runs for trial in result.trials)
    again = run_experiment(search, images=1, seed=5)
    for one, other in zip(result.trials, again.trials, strict=False):
        np.testing.assert_array_equal(one.result.q, other.result.q)


def test_poses_not_found_are_counted_apart(search, result):
    nothing = PoseEstimate.nothing(search.tree, stopped_by="end")
    lost = [replace(one, result=nothing) for one in result.trials[:2]]
    figures = grid_figures(replace(result, trials=(*lost, *result.trials[2:])))
    assert figures["not_found"] == 2
    found = [trial.result.E_total for trial in result.trials[2:]]
    assert figures["mean_e_total"] == pytest.approx(np.mean(found))


def test_the_beam_search_matches_every_silhouette_exactly_and_names_the_truth(beam_result):
    """Without being told r, in one run over poses that the paper's search mostly misses."""
    figures = grid_figures(beam_result)
    assert figures["exact"] == figures["proved"] == figures["truth_in_set"] == 6
    assert figures["method"] == "beam"
    for trial in beam_result.trials:
        values = np.concatenate(trial.true_values)
        joints = trial.result.pose_set.joints
        assert all(joint.holds(value) for joint, value in zip(joints, values, strict=True))


def test_columns_stand_side_by_side(result, beam_result):
    table = grid_table([[result], [beam_result]])
    headings = ["figure", "paper", "the paper's method", "beam search"]
    assert [column.header for column in table.columns] == headings
    assert table.row_count > grid_table([[result]]).row_count >= len(PAPER)


def test_pictures_are_written(result, beam_result, tmp_path):
    """Of the paper's search and of ours."""
    files = save_pictures(replace(result, trials=result.trials[:1]), tmp_path / "paper")
    assert all(file.stat().st_size > 5000 for file in files)
    names = {file.name for file in files}
    assert {"figure_11_runs_of_step_3.png", "figure_12_chest_candidates.png"} < names
    assert ("figure_12_not_matched.png" in names) == (not result.trials[0].exact)
    several = [one for one in beam_result.trials if one.result.pose_set.family_count > 1][:1]
    few = replace(beam_result, trials=(*beam_result.trials[:1], *several))
    names = {file.name for file in save_pictures(few, tmp_path / "beam")}
    assert "figure_11_milliseconds.png" in names
    assert ("families_1.png" in names) == bool(several)


def at(search, **degrees):
    """The nodes' values where all angles are 0 but those given."""
    model = search.tree.model
    q = np.zeros(len(model.position_names))
    for name, value in degrees.items():
        q[model.position_index(name)] = np.radians(value)
    return search.tree.values_from_positions(q)


def test_a_hand_before_the_belly_is_hidden_from_behind(search):
    camera = experiment_camera()
    behind = replace(camera, X_WC=np.diag([-1.0, -1.0, 1.0, 1.0]) @ camera.X_WC)
    arm = {"right_upper_arm_x": -15, "right_upper_arm_y": 60, "right_forearm_x": -60}
    true, found = at(search, **arm), at(search, **arm, right_hand_x=20)
    before = causes_of_wrong_angles(search.sampled, camera, true, found)
    assert (before.hidden, before.inner_edges) == (False, True)
    after = causes_of_wrong_angles(search.sampled, behind, true, found)
    assert (after.hidden, after.inner_edges) == (True, False)
    assert causes_of_wrong_angles(search.sampled, camera, true, true) == (False, False)


def test_the_chests_rank_is_that_of_areas_counted_in_masks(search, result):
    ranks, lengths = chest_ranks(replace(result, trials=result.trials[:1]))
    trial, nodes = result.trials[0], [node.name for node in search.tree.nodes]
    head, chest = nodes.index("head"), nodes.index("chest")

    def masks(values):
        X_CN = result.cameras[0].X_CW @ search.tree.node_poses(values)
        outlines = search.sampled.surfaces.at(values)
        return [draw_mask([outlines[i]], X_CN[[i]], result.cameras[0]) for i in (head, chest)], (
            draw_mask(outlines, X_CN, result.cameras[0])
        )

    (true_head, true_chest), silhouette = masks(trial.true_values)
    covered = []
    for values in search.sampled.values[chest]:
        posed = list(trial.true_values)
        posed[chest] = values
        (_, mask), _ = masks(posed)
        if (mask & ~silhouette).sum() <= search.settings.outside_limit:
            covered.append(int((mask & silhouette & ~true_head).sum()))
    own = int((true_chest & silhouette & ~true_head).sum())
    assert lengths[0] == pytest.approx(len(covered), abs=1)
    better = sum(one > own + 3 for one in covered)
    worse = sum(one < own - 3 for one in covered)
    assert 1 + better <= ranks[0] <= len(covered) - worse
    assert (ratio_within(ranks, ranks[0] - 1), ratio_within(ranks, ranks[0])) == (0.0, 1.0)


@pytest.mark.slow
def test_edges_settle_what_the_silhouette_leaves_open():
    result = run_experiment(beam_experiment_search(), images=20, seed=2026)
    # Few poses, so that all are judged, and one silhouette that leaves nothing open.
    few = [one for one in result.trials if 1 < one.result.pose_set.size < 100]
    alone = [one for one in result.trials if one.result.pose_set.size == 1]
    counts = settle_by_edges(replace(result, trials=(*few, *alone[:1])))
    noisy = settle_by_edges(replace(result, trials=tuple(few)), noise=0.2)
    for one in (counts, noisy):
        assert one["ambiguous"] == one["edges_keep_truth"] == len(few) > 1
        assert one["edges_settle_rightly"] == one["edges_settle"]
    assert 0 < noisy["edges_settle"] <= counts["edges_settle"] <= counts["edges_narrow"]
    # With edges to the pixel nothing that can be settled is left open.
    assert counts["edges_settle"] + counts["edges_undecidable"] == counts["ambiguous"]
    assert noisy["edges_undecidable"] == counts["edges_undecidable"]
    assert str(counts["edges_keep_truth"]) in edge_lines(counts)


def test_noise_loses_moves_and_adds_edges():
    segments = np.zeros((80, 80), dtype=np.int64)
    segments[:, 40:] = 1
    edges = edges_of_labels(segments, np.ones((80, 80), dtype=np.bool_))
    noisy = noisy_edges(edges, 0.3, np.random.default_rng(0))
    near = np.abs(np.nonzero(noisy.edges)[1] - 39) <= 1
    assert 0.4 < near.sum() / 80 < 0.9
    assert (~near).any()
    assert (noisy.errors.missing, noisy.errors.wrong) == (0.3, 0.075)
    assert noisy_edges(edges, 0.9, np.random.default_rng(0)).edges[:, 38:41].sum() < near.sum()
