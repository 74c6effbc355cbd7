"""The multi-start search on arms and chains, with exact and damaged masks."""

import numpy as np
import pytest
from scipy import ndimage

from drake_pose.search import MultiStartSearch, View
from drake_pose.search.multi_start import without_specks
from drake_pose.search.refinement import RefinementProblem
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.workers import use_workers
from tests.search.arms import arm_cameras, damaged_views, draw_pose, draw_view, is_held, split
from tests.search.bodies import front_camera, swinging_chain


@pytest.fixture(scope="module")
def search(tree):
    return MultiStartSearch(tree)


@pytest.fixture(scope="module")
def pose(tree):
    return draw_pose(tree, np.random.default_rng(20))


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    return MultiStartSearch(swinging_chain(tmp_path_factory.mktemp("chain"), 3).pose_tree())


def clean_views(tree, values):
    return [draw_view(tree, values, camera) for camera in arm_cameras()]


def all_values(result):
    return np.concatenate(result.node_values)


def worst_place(tree, result, values):
    """Return the greatest position error of a link's origin or the hand's end [m]."""
    ends = []
    for one in (all_values(result), values):
        X_WN = tree.node_poses(split(tree, one))
        ends.append(np.vstack([X_WN[:, :3, 3], X_WN[-1, :3, 3] + 0.15 * X_WN[-1, :3, 2]]))
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).max())


def recount(tree, result, views):
    """Return J by its definition (1): the number of pixels that differ."""
    drawn = [draw_view(tree, all_values(result), view.camera) for view in views]
    return sum(int((one.mask ^ view.mask).sum()) for one, view in zip(drawn, views, strict=True))


def random_values(tree, seed):
    return split(tree, draw_pose(tree, np.random.default_rng(seed)))


def chain_view(tree, values):
    camera = front_camera(200, shift=0.37)
    outlines = TreeSurfaces(tree).at(values)
    return View(camera, draw_mask(outlines, camera.X_CW @ tree.node_poses(values), camera))


def test_exact_masks_give_an_accurate_pose_with_intervals(tree, search, pose):
    views = clean_views(tree, pose)
    result = search.match(views)
    assert result.explained
    assert result.stopped_by == "end"
    assert result.J == recount(tree, result, views)
    assert result.E_total < 0.01
    assert worst_place(tree, result, pose) < 0.005
    answer = result.pose_set
    assert is_held(answer, pose)
    np.testing.assert_array_equal(answer.modes[0].q, result.q)
    assert answer.modes[0].J == result.J
    assert sum(answer.determined) >= 4
    plain = search.without_alternatives().match(views)
    assert plain.pose_set is None
    assert plain.E_total < 0.02


def test_poses_between_the_samples_are_found(chain):
    rng, tree = np.random.default_rng(4), chain.tree
    errors, inside = [], []
    for _ in range(6):
        values = split(tree, draw_pose(tree, rng))
        view = chain_view(tree, values)
        found = chain.match([view])
        q, _ = tree.positions_from(found.node_values)
        np.testing.assert_allclose(found.q, q)
        assert found.J == np.count_nonzero(chain_view(tree, found.node_values).mask != view.mask)
        errors.append(np.degrees(np.abs(all_values(found) - np.concatenate(values))))
        pairs = zip(found.pose_set.joints, np.concatenate(values), strict=True)
        inside += [joint.holds(value) for joint, value in pairs if joint.determined]
        modes = found.pose_set.modes
        assert (modes[0].J, len(modes)) == (found.J, found.pose_set.mode_count)
        for mode in modes:
            assert mode.J <= found.J + found.pose_set.tolerance
            np.testing.assert_allclose(mode.q, tree.positions_from(mode.node_values)[0])
            assert mode.joints[0].holds(mode.node_values[0][0])
    assert np.median(errors) < 1.0
    assert len(inside) >= 12
    assert np.mean(inside) > 0.85


def test_no_value_is_determined_if_the_model_does_not_fit(chain):
    view = chain_view(
        chain.tree, split(chain.tree, draw_pose(chain.tree, np.random.default_rng(6)))
    )
    assert any(joint.determined for joint in chain.match([view]).pose_set.joints)
    spoilt = view.mask.copy()
    spoilt[5:60, 5:60] = True
    joints = chain.match([View(view.camera, spoilt)]).pose_set.joints
    assert not any(joint.determined for joint in joints)


def test_exact_search_accepts_exact_masks_and_gives_up_on_others(chain):
    view = chain_view(
        chain.tree, split(chain.tree, draw_pose(chain.tree, np.random.default_rng(3)))
    )
    problem = RefinementProblem(chain.exact.body, [view])
    found = chain.exact.find(problem, None, np.inf)
    assert problem.J(found.parameters) == found.J <= found.first_J
    assert found.J <= chain.exact.settings.exact * problem.border_length
    assert chain.exact.find(problem, None, 0.0) is None, "the time is up"
    moved = np.roll(view.mask, 60, axis=1)
    other = RefinementProblem(chain.exact.body, [View(view.camera, moved)])
    assert chain.exact.find(other, None, np.inf) is None


@pytest.mark.slow
def test_damaged_masks_of_misfitting_arms_give_accurate_poses(tree, search):
    places, held = [], []
    for seed in range(8):
        values = draw_pose(tree, np.random.default_rng(100 + seed))
        result = search.match(damaged_views(tree, values, seed))
        places.append(worst_place(tree, result, values))
        fractions = [
            np.mean([one.holds(v) for one, v in zip(mode.joints, values, strict=True)])
            for mode in result.pose_set.modes
        ]
        held.append(max(fractions))
    # Flips keep the hand in place, but move the links between.
    assert np.median(places) < 0.02
    assert np.mean(held) >= 0.85


def test_results_do_not_depend_on_the_number_of_workers(tree, search, pose):
    views, found = damaged_views(tree, pose, 3), []
    for workers in (1, 3):
        with use_workers(workers):
            found.append(search.match(views))
    np.testing.assert_array_equal(found[0].q, found[1].q)
    assert (found[0].runs, found[0].first_J) == (found[1].runs, found[1].first_J)
    for one, other in zip(*(result.pose_set.joints for result in found), strict=True):
        assert (one.low, one.high) == (other.low, other.high)


def test_a_zero_time_limit_returns_a_pose(tree, pose):
    views = clean_views(tree, pose)
    search = MultiStartSearch(tree, time_limit=9.0).with_time_limit(0.0).with_time_limit(9.0)
    result = search.match(views)
    assert (result.found, result.stopped_by) == (True, "time_limit")
    assert result.J == recount(tree, result, views)
    assert result.seconds < 2.0


def test_masks_that_no_pose_explains_are_reported(search):
    camera = arm_cameras()[0]
    for where in (np.s_[:, :], np.s_[100:101, 150:151], np.s_[:12, :]):
        mask = np.zeros((camera.height, camera.width), dtype=bool)
        mask[where] = True
        result = search.match([View(camera, mask)])
        assert (result.found, result.explained) == (True, False)


def test_what_a_straight_cut_may_hide_is_no_evidence(tree, search):
    camera, held = arm_cameras()[0], []
    for seed, side in enumerate(2 * [np.s_[:, 160:], np.s_[:, :160]]):
        values = draw_pose(tree, np.random.default_rng(900 + seed))
        whole = draw_view(tree, values, camera).mask
        mask = whole.copy()
        mask[side] = False  # A crop, or what stands before half of the arm.
        if np.count_nonzero(mask) > 0.15 * np.count_nonzero(whole):
            joints = search.match([View(camera, mask)]).pose_set.joints
            told = zip(joints, values, strict=True)
            held += [one.holds(value) for one, value in told if one.determined]
    assert len(held) > 5
    assert np.mean(held) > 0.9


def test_salt_noise_does_not_spoil_the_pose(tree, search, pose):
    generator = np.random.default_rng(8)
    views = clean_views(tree, pose)
    for view in views:
        view.mask[generator.random(view.mask.shape) < 0.1] = True
    result = search.match(views)
    assert worst_place(tree, result, pose) < 0.02
    # J is that of the given silhouettes, with the noise.
    assert result.J == recount(tree, result, views)


@pytest.mark.parametrize("seed", range(12))
def test_specks_are_removed_by_a_median_where_they_are_many(seed):
    """Specks are components and holes of at most six pixels; many are 2 % of the mask."""
    generator = np.random.default_rng(seed)
    mask = np.zeros((60, 80), bool)
    mask[10:50, 15:60] = True
    for side in (mask, ~mask):
        place = np.argwhere(side & (generator.random(mask.shape) < (0.0005, 0.003, 0.03)[seed % 3]))
        for row, column in place:
            height, width = generator.integers(1, 4, 2)
            mask[row : row + height, column : column + width] ^= True
    if seed == 11:
        mask = np.eye(60, dtype=bool)[::-3, ::3]
    specks = 0
    for side in (mask, ~mask):
        labels = ndimage.label(np.pad(side, 1, constant_values=side is not mask))[0]
        areas = np.bincount(labels.ravel())[1:]
        specks += areas[areas <= 6].sum()
    found, smooth = without_specks(mask), ndimage.median_filter(mask, 5, mode="nearest")
    if specks > 0.02 * mask.sum() and smooth.any():
        np.testing.assert_array_equal(found, smooth)
    else:
        assert found is mask
