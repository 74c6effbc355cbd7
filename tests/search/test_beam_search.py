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
    MultiStartSearch,
    PaperSearch,
    View,
    examine,
    renderer_tolerance,
)
from drake_pose.search.beam_search import Stage
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.search.bodies import front_camera, swinging_chain
from tests.search.grid_problems import ProblemMaker


def search_of(maker, examination=None, **settings):
    return BeamSearch(maker.tree, BeamSearchSettings(**maker.grid, **settings), examination)


@pytest.mark.parametrize("count", [1, 2])
def test_finds_the_minimum_that_brute_force_finds(maker, count):
    matcher, generator = search_of(maker), np.random.default_rng(3)
    for on_grid in (False, False, True):
        problem = maker.make(generator, views=count, on_grid=on_grid)
        result = matcher.match(problem.views)
        assert result.J == problem.best[1] == problem.objective(result.node_values)
        assert result.J <= result.first_J
        assert (result.stopped_by == "exact") == (result.J <= renderer_tolerance(problem.views))
        assert result.pose_set is None


def test_finds_the_minimum_for_a_mask_that_no_pose_explains(maker):
    mask = maker.make(np.random.default_rng(4), views=1, noise=0.1).views[0].mask
    mask[40:50, 5:15] = True
    problem = maker.problem(mask)
    result = search_of(maker).match(problem.views)
    assert (result.stopped_by, result.J) == ("end", problem.best[1])


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    tree = swinging_chain(tmp_path_factory.mktemp("chain"), 3).pose_tree()
    return ProblemMaker(tree, side=100, interval=0.4)


def test_area_outside_the_image_costs_nothing(chain):
    camera = ParallelCamera("cut", 40, 25, 100.0, 19.637, 19.637, front_camera().X_WC)
    values = [grid[2] for grid in chain.body.sampled.values]
    view = View(camera, chain.draw(values, camera))
    assert view.mask.sum() < chain.draw(values, chain.cameras[0]).sum()
    assert search_of(chain).match([view]).stopped_by == "exact"


def test_matches_with_a_given_root_position(tmp_path, chain):
    values = [np.array([0.4])] * 3
    view = chain.show(values).views[0]
    position = chain.tree.node_poses(values)[0, :3, 3]
    rotation = RootRotation.limited([("x", -60, 60)])
    model = swinging_chain(tmp_path, 3)
    tree = model.pose_tree(root="segment_0", root_position=np.zeros(3), root_rotation=rotation)
    settings = BeamSearchSettings(interval=0.4)
    result = BeamSearch(tree, settings, ExaminationSettings()).match([view], position)
    assert result.J <= 2.0
    assert result.pose_set.complete
    (poses, *_) = BeamSearch(tree, settings).best_poses([view], position)
    np.testing.assert_array_equal(np.concatenate(poses), np.concatenate(result.node_values))


@pytest.mark.parametrize("limit", [{"time_limit": 0.0}, {"research_hypotheses": 0}])
def test_limits_return_a_pose_of_the_grid(maker, limit):
    problem = maker.make(np.random.default_rng(9), views=1, noise=0.02)
    result = search_of(maker, **limit).match(problem.views)
    assert result.stopped_by == ("time_limit" if "time_limit" in limit else "end")
    assert result.J == problem.objective(result.node_values)


@pytest.mark.parametrize(
    ("kind", "culprit", "values"),
    [
        (BeamSearchSettings, "interval", {"interval": 0.0}),
        (BeamSearchSettings, "stages", {"stages": ()}),
        (BeamSearchSettings, "research_hypotheses", {"research_hypotheses": -1}),
        (BeamSearchSettings, "time_limit", {"time_limit": -1.0}),
        (partial(Stage, 0, 0.3, 5), "hypotheses", {}),
        (partial(Stage, 1, -0.1, 5), "outside_fraction", {}),
        (partial(Stage, 1, 0.3, 0), "outside_weight", {}),
        (ExaminationSettings, "tolerance", {"tolerance": -1.0}),
        (ExaminationSettings, "poses", {"proof_poses": 0}),
        (ExaminationSettings, "time_limit", {"time_limit": -1.0}),
        (ExaminationSettings, "time_limit", {"time_limit": float("nan")}),
    ],
)
def test_settings_out_of_range_are_refused(kind, culprit, values):
    with pytest.raises(SettingsError, match=culprit):
        kind(**values)


def test_bad_views_and_poses_are_refused(chain):
    for kind in (BeamSearch, MultiStartSearch, PaperSearch):
        with pytest.raises(SettingsError, match="at least one view"):
            kind(chain.tree).match([])
    search, problem = search_of(chain), chain.make(np.random.default_rng(7), views=1, on_grid=True)
    found = search.match(problem.views)
    moved = replace(found, node_values=tuple(value + 0.1 for value in found.node_values))
    with pytest.raises(SettingsError, match="grid"):
        examine(search.body, problem.views, moved, ExaminationSettings())


@pytest.mark.parametrize("side", [60, 480])
def test_label_images_are_matched_within_the_renderer_tolerance(tmp_path, side):
    """Label images are from Drake's VTK renderer; the scored areas are computed differently."""
    model = swinging_chain(tmp_path, 4)
    maker = ProblemMaker(model.pose_tree(), interval=0.4)
    matcher = search_of(maker, ExaminationSettings())
    camera = PinholeCamera(
        "front", side, side, 10.0 * side, 10.0 * side, 0.4 * side, 0.5 * side, front_camera().X_WC
    )
    renderer, generator, differ = LabelRenderer(model, camera), np.random.default_rng(3), 0
    for _ in range(8):
        values = [grid[generator.integers(len(grid))] for grid in matcher.sampled.values]
        view = View(camera, renderer.mask(np.concatenate(values)))
        apart = np.count_nonzero(maker.draw(values, camera) != view.mask)
        differ += apart > 0
        assert apart <= renderer_tolerance([view])
        result = matcher.match([view])
        assert (result.stopped_by, result.lower_bound) == ("exact", result.J)
        assert result.J <= apart
        assert result.pose_set.complete
        assert result.pose_set.contains(values)
    assert differ or side < 480


def test_with_zero_tolerance_only_equal_masks_are_exact(chain):
    matcher = search_of(chain, tolerance=0.0)
    view = chain.show([grid[1] for grid in matcher.sampled.values]).views[0]
    assert matcher.match([view]).stopped_by == "exact"
    view.mask[5, 5] = True
    result = matcher.match([view])
    assert (result.stopped_by, result.J) == ("end", 1.0)
    assert search_of(chain, tolerance=1.0).match([view]).stopped_by == "exact"


def test_a_proved_pose_is_the_optimum_of_the_grid(maker):
    examined = search_of(maker, ExaminationSettings(proof_poses=10**6, mode_poses=10**6))
    assert examined.without_alternatives().examination is None
    generator = np.random.default_rng(5)
    for noise, views in itertools.product((0.0, 0.003, 0.03), (1, 2)):
        problem = maker.make(generator, views=views, noise=noise, on_grid=noise == 0.0)
        result, best = examined.match(problem.views), problem.best[1]
        assert result.proved_optimal
        assert result.J == result.lower_bound == best == problem.objective(result.node_values)
        assert not result.budget_spent
        assert result.E_total == best / sum(view.mask.sum() for view in problem.views)
        q, X_WB = maker.tree.positions_from(result.node_values)
        np.testing.assert_array_equal(result.q, q)
        np.testing.assert_array_equal(result.X_WB, X_WB)
        assert result.pose_set.complete
        assert result.pose_set.size == len(problem.within(best + result.pose_set.tolerance))


@pytest.mark.parametrize("limit", [{}, {"proof_poses": 1}, {"time_limit": 0.0}])
def test_examination_replaces_a_worse_pose_or_reports_its_limit(maker, limit):
    """A limit leaves a valid lower bound and no false proof."""
    search, generator, proved = search_of(maker), np.random.default_rng(12), []
    for number in range(6):
        problem = maker.make(generator, views=1, noise=0.01 * (number % 2), on_grid=number == 2)
        found = search.match(problem.views)
        start = int(np.argsort(problem.Js)[3 * number])
        values = search.sampled.values_at(problem.choices[start])
        worse = replace(found, node_values=values, J=float(problem.Js[start]))
        given = ExaminationSettings(mode_poses=1 if limit else 10**6, **limit)
        proof = examine(search.body, problem.views, worse, given)
        assert proof.lower_bound <= problem.best[1] <= proof.J <= worse.J
        assert proof.J == problem.objective(proof.node_values)
        assert proof.budget_spent != proof.proved_optimal
        assert proof.pose_set.complete or not any(proof.pose_set.determined)
        if not limit:
            assert proof.J == problem.best[1] == proof.pose_set.modes[0].J
        proved.append(proof.proved_optimal)
    assert all(proved) != bool(limit)


def look_alike(first, second, overlap):
    """Return whether two poses are alike, by definition, from masks (nodes, views, H, W)."""
    for node in range(len(first)):
        is_visible = [
            (pose[node] & ~np.delete(pose, node, axis=0).any(axis=0)).any()
            for pose in (first, second)
        ]
        one, other = first[node], second[node]
        if any(is_visible) and (one & other).sum() < overlap * (one | other).sum():
            return False
    return True


@pytest.mark.parametrize("count", [1, 2])
def test_best_poses_start_with_the_best_and_differ_pairwise(maker, count):
    problem = maker.make(np.random.default_rng(1), views=count)
    search = search_of(maker)
    poses = search.best_poses(problem.views, count=6, overlap=0.7)
    Js = [problem.objective(pose) for pose in poses]
    assert len(poses) == 6
    assert Js[0] == search.match(problem.views).J
    assert Js == sorted(Js)
    nodes = range(len(maker.tree.nodes))
    masks = [np.array([maker.draw_node(i, pose, count) for i in nodes]) for pose in poses]
    for one, other in itertools.combinations(masks, 2):
        assert not look_alike(one, other, 0.7)
    # Above an overlap of one all poses differ, and the best are kept.
    everything = search.best_poses(problem.views, count=10, overlap=2.0)
    Js = [problem.objective(pose) for pose in everything]
    assert len({tuple(np.concatenate(values)) for values in everything}) == 10
    assert Js[:3] == np.sort(problem.Js)[:3].tolist()
    assert len(search.best_poses(problem.views, time_limit=0.0)) >= 1
