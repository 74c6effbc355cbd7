"""Compare the beam search with brute force over whole grids, and check its proofs and limits."""

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from drake_pose.body import RootRotation
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.search import (
    BeamSearch,
    BeamSearchSettings,
    ExaminationSettings,
    View,
    examine,
    renderer_tolerance,
    samples_at,
)
from drake_pose.search.beam_search import Stage
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.search.bodies import box_link, front_camera, joint, load_body, swinging_chain
from tests.search.grid_problems import show_pose

INTERVAL = 0.4


def search(tree, **settings):
    return BeamSearch(tree, BeamSearchSettings(interval=INTERVAL, **settings))


@pytest.mark.parametrize("count", [1, 2])
def test_finds_the_minimum_that_brute_force_finds(maker, count):
    matcher = search(maker.tree)
    generator = np.random.default_rng(3)
    for _ in range(2):
        problem = maker.make(generator, views=count, noise=0.0, on_grid=False)
        result = matcher.match(problem.views)
        assert result.found
        assert result.J == problem.best[1]
        exact = matcher.match(maker.show([grid[1] for grid in matcher.sampled.values]).views)
        assert (exact.stopped_by, exact.J, exact.E_total) == ("exact", 0.0, 0.0)


def test_finds_the_minimum_for_a_mask_that_no_pose_explains(maker):
    problem = maker.make(np.random.default_rng(4), views=1, noise=0.1, on_grid=False)
    problem.views[0].mask[40:50, 5:15] = True
    result = search(maker.tree).match(problem.views)
    assert result.stopped_by == "end"
    assert result.J == maker.problem(problem.views).best[1]


def test_finds_prismatic_and_revolute_positions(tmp_path):
    model = load_body(
        tmp_path,
        box_link("rail", 30, 4),
        joint("slide", "prismatic", "world", "rail", (-0.2, 0.2), axis="0 1 0"),
        box_link("arm", 4, 14, y=1.0, z=-6.0),
        joint("swing", "revolute", "rail", "arm", (-1.0, 1.0), y=12.0),
    )
    tree = model.pose_tree()
    matcher = BeamSearch(tree, BeamSearchSettings(interval=0.25, length_interval=0.05))
    camera = front_camera(90, shift=0.137)
    view = show_pose(matcher.sampled, [np.array([0.15]), np.array([-0.5])], camera)
    result = matcher.match([view])
    assert result.J == 0.0
    np.testing.assert_allclose(result.q, [0.15, -0.5], atol=1e-9)


def test_area_outside_the_image_costs_nothing(tmp_path):
    tree = swinging_chain(tmp_path, 3).pose_tree()
    matcher = search(tree)
    camera = ParallelCamera("cut", 40, 25, 100.0, 19.637, 19.637, front_camera().X_WC)
    values = [grid[2] for grid in matcher.sampled.values]
    view = show_pose(matcher.sampled, values, camera)
    whole = show_pose(matcher.sampled, values, front_camera(100, shift=0.137))
    assert view.mask.sum() < whole.mask.sum()
    assert matcher.match([view]).stopped_by == "exact"


def test_matches_with_a_given_root_position(tmp_path):
    model = swinging_chain(tmp_path, 3)
    still = model.pose_tree()
    values = [np.array([INTERVAL])] * 3
    X_WE = still.node_poses(values)[0]
    rotation = RootRotation.limited([("x", -60, 60)])
    tree = model.pose_tree(root="segment_0", root_position=np.zeros(3), root_rotation=rotation)
    view = show_pose(search(still).sampled, values, front_camera(100, shift=0.137))
    result = search(tree).match([view], root_position=X_WE[:3, 3])
    assert result.J <= 2.0


def test_time_limit_returns_a_pose_and_is_reported(maker):
    problem = maker.make(np.random.default_rng(9), views=1, noise=0.0, on_grid=False)
    result = search(maker.tree, time_limit=0.0).match(problem.views)
    assert result.found
    assert np.isfinite(result.q).all()
    assert result.stopped_by == "time_limit"
    samples = samples_at(maker.body.sampled, result.node_values)
    assert samples is not None
    assert result.J == problem.Js[(problem.choices == samples).all(axis=1)]


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (BeamSearchSettings, {"interval": 0.0}),
        (BeamSearchSettings, {"stages": ()}),
        (BeamSearchSettings, {"research_hypotheses": -1}),
        (BeamSearchSettings, {"time_limit": -1.0}),
        (partial(Stage, 0, 0.3, 5), {}),
        (partial(Stage, 1, -0.1, 5), {}),
        (partial(Stage, 1, 0.3, 0), {}),
        (ExaminationSettings, {"tolerance": -1.0}),
        (ExaminationSettings, {"proof_poses": 0}),
        (ExaminationSettings, {"time_limit": -1.0}),
        (ExaminationSettings, {"time_limit": float("nan")}),
    ],
)
def test_settings_out_of_range_are_refused(kind, values):
    with pytest.raises(SettingsError, match=r"positive|or more|must hold|needs 1"):
        kind(**values)


@pytest.mark.parametrize("side", [60, 240, 480])
def test_label_images_are_matched_within_the_renderer_tolerance(tmp_path, side):
    """Label images are from Drake's VTK renderer; the scored areas are computed differently."""
    model = swinging_chain(tmp_path, 4)
    matcher = BeamSearch(
        model.pose_tree(), BeamSearchSettings(interval=INTERVAL), ExaminationSettings()
    )
    eye = front_camera().X_WC
    camera = PinholeCamera(
        "front", side, side, 10.0 * side, 10.0 * side, 0.4 * side, 0.5 * side, eye
    )
    renderer, generator, differ = LabelRenderer(model, camera), np.random.default_rng(3), 0
    for _ in range(8):
        values = [grid[generator.integers(len(grid))] for grid in matcher.sampled.values]
        view = View(camera, renderer.mask(np.concatenate(values)))
        own = show_pose(matcher.sampled, values, camera)
        apart = np.count_nonzero(own.mask != view.mask)
        differ += apart > 0
        assert apart <= renderer_tolerance([view])
        result = matcher.match([view])
        assert result.stopped_by == "exact"
        assert result.J <= apart
        assert result.lower_bound == result.J
        assert result.pose_set is not None
        assert result.pose_set.complete
        assert result.pose_set.contains(values)
    assert differ or side < 480


def test_with_zero_tolerance_only_equal_masks_are_exact(tmp_path):
    matcher = search(swinging_chain(tmp_path, 3).pose_tree(), tolerance=0.0)
    camera = front_camera(100, shift=0.137)
    view = show_pose(matcher.sampled, [grid[1] for grid in matcher.sampled.values], camera)
    assert matcher.match([view]).stopped_by == "exact"
    view.mask[5, 5] = True
    result = matcher.match([view])
    assert result.stopped_by == "end"
    assert result.J == 1.0
    assert search(matcher.tree, tolerance=1.0).match([view]).stopped_by == "exact"


def search_of(maker, examination):
    return BeamSearch(maker.tree, BeamSearchSettings(interval=INTERVAL), examination)


def test_a_proved_pose_is_the_optimum_of_the_grid(maker):
    examined = search_of(maker, ExaminationSettings(proof_poses=10**6, mode_poses=10**6))
    generator = np.random.default_rng(5)
    for noise, views in itertools.product((0.0, 0.003, 0.01, 0.03), (1, 2)):
        problem = maker.make(generator, views=views, noise=noise, on_grid=noise == 0.0)
        result = examined.match(problem.views)
        best = problem.best[1]
        assert result.proved_optimal
        assert result.J == result.lower_bound == best
        assert not result.budget_spent
        samples = samples_at(maker.body.sampled, result.node_values)
        assert samples is not None
        assert tuple(samples.tolist()) in problem.within(best)
        area = sum(int(view.mask.sum()) for view in problem.views)
        assert result.E_total == pytest.approx(best / area)
        q, X_WB = maker.tree.positions_from(result.node_values)
        np.testing.assert_array_equal(result.q, q)
        np.testing.assert_array_equal(result.X_WB, X_WB)
        answer = result.pose_set
        assert answer is not None
        assert answer.complete
        assert answer.size == len(problem.within(best + answer.tolerance))


def test_examination_replaces_a_worse_pose(maker):
    search = search_of(maker, None)
    generator = np.random.default_rng(8)
    for noise in (0.0, 0.01) * 3:
        problem = maker.make(generator, views=1, noise=noise, on_grid=noise == 0.0)
        found = search.match(problem.views)
        assert found.pose_set is None
        assert found.proved_optimal == (found.J == 0)
        wrong = int(generator.integers(len(problem.Js)))
        values = tuple(maker.body.sampled.values_at(problem.choices[wrong]))
        bad = replace(found, node_values=values, J=float(problem.Js[wrong]))
        mended = examine(search.body, problem.views, bad, ExaminationSettings())
        assert mended.proved_optimal
        assert mended.J == problem.best[1] < bad.J
        samples = samples_at(maker.body.sampled, mended.node_values)
        assert samples is not None
        assert tuple(samples.tolist()) in problem.within(mended.J)


def test_examination_refuses_a_pose_off_the_grid(maker):
    search = search_of(maker, None)
    problem = maker.make(np.random.default_rng(7), views=1, noise=0.0, on_grid=True)
    result = search.match(problem.views)
    values = tuple(value + 0.1 for value in result.node_values)
    moved = replace(result, node_values=values)
    with pytest.raises(SettingsError, match="not on the body's sampling grid"):
        examine(search.body, problem.views, moved, ExaminationSettings())


@pytest.mark.parametrize("limit", [{"proof_poses": 1}, {"time_limit": 0.0}])
def test_limits_give_a_valid_lower_bound_and_no_false_proof(maker, limit):
    search = search_of(maker, None)
    generator = np.random.default_rng(12)
    proved = []
    for number in range(12):
        problem = maker.make(generator, views=1, noise=0.01, on_grid=False)
        start = int(np.argsort(problem.Js)[number])
        values = search.sampled.values_at(problem.choices[start])
        found = replace(search.match(problem.views), node_values=values, J=float(problem.Js[start]))
        settings = ExaminationSettings(mode_poses=1, **limit)
        proof = examine(search.body, problem.views, found, settings)
        assert proof.lower_bound <= problem.best[1] <= proof.J <= found.J
        assert proof.J in problem.Js
        assert proof.budget_spent or proof.proved_optimal
        assert proof.pose_set.complete or not any(proof.pose_set.determined)
        proved.append(proof.proved_optimal)
    assert not all(proved)
