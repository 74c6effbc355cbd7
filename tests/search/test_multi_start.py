"""The multi-start search on arms drawn by the tests, clean and damaged, and on bad input."""

import numpy as np
import pytest

from drake_pose.search.estimates import View
from drake_pose.search.multi_start import MultiStartSearch, without_specks
from drake_pose.workers import working
from tests.search.arms import (
    arm_cameras,
    arm_tree,
    damaged_views,
    draw_pose,
    draw_view,
    is_held,
    split,
)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return arm_tree(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def search(tree):
    return MultiStartSearch(tree)


@pytest.fixture(scope="module")
def pose(tree):
    return draw_pose(tree, np.random.default_rng(20))


def clean_views(tree, values):
    return [draw_view(tree, values, camera) for camera in arm_cameras()]


def all_values(result):
    return np.concatenate(result.node_values)


def joint_ends(tree, values):
    """Where every link begins, and the hand ends [m]."""
    X_WN = tree.node_poses(split(tree, values))
    return np.vstack([X_WN[:, :3, 3], X_WN[-1, :3, 3] + 0.15 * X_WN[-1, :3, 2]])


def worst_place(tree, result, values):
    """How far any of these is from where it should be [m]."""
    gaps = joint_ends(tree, all_values(result)) - joint_ends(tree, values)
    return float(np.linalg.norm(gaps, axis=1).max())


def recount(tree, result, views):
    """J by its definition (1): pixels that differ."""
    drawn = [draw_view(tree, all_values(result), view.camera) for view in views]
    return sum(int((one.mask ^ view.mask).sum()) for one, view in zip(drawn, views, strict=True))


def test_continuous_pose_is_found_and_said_to_be_known(tree, search, pose):
    views = clean_views(tree, pose)
    result = search.match(views)
    assert result.found
    assert result.explained
    assert result.stopped_by == "end"
    assert result.J == recount(tree, result, views)
    assert result.E_total < 0.03
    assert worst_place(tree, result, pose) < 0.01
    answer = result.pose_set
    assert answer is not None
    assert is_held(answer, pose)
    np.testing.assert_array_equal(answer.families[0].q, result.q)
    assert answer.families[0].J == result.J
    assert sum(answer.determined) >= 4


@pytest.mark.slow
def test_damaged_and_ill_fitting_arms(tree, search):
    places, held = [], []
    for seed in range(8):
        values = draw_pose(tree, np.random.default_rng(100 + seed))
        result = search.match(damaged_views(tree, values, seed))
        places.append(worst_place(tree, result, values))
        assert result.pose_set is not None
        held.append(
            max(
                np.mean([one.holds(v) for one, v in zip(family.joints, values, strict=True)])
                for family in result.pose_set.families
            )
        )
    # Flips leave the hand where it is, but not what is between.
    assert np.median(places) < 0.02
    assert np.mean(held) >= 0.85


def test_the_same_every_time(tree, search, pose):
    views = damaged_views(tree, pose, 3)
    with working(1):
        first = search.match(views)
    with working(3):
        again = search.match(views)
    np.testing.assert_array_equal(first.q, again.q)
    assert first.statistics == again.statistics
    assert first.pose_set is not None
    assert again.pose_set is not None
    for one, other in zip(first.pose_set.joints, again.pose_set.joints, strict=True):
        assert (one.low, one.high) == (other.low, other.high)


def test_no_time_at_all(tree, pose):
    views = clean_views(tree, pose)
    result = MultiStartSearch(tree, time_limit=0.0).match(views)
    assert result.found
    assert result.stopped_by == "time_limit"
    assert result.J == recount(tree, result, views)
    assert result.seconds < 2.0


@pytest.mark.parametrize(
    "where",
    [np.s_[:, :], np.s_[100:101, 150:151], np.s_[:12, :]],
    ids=["all", "one pixel", "strip"],
)
def test_a_mask_that_no_pose_explains(search, where):
    (camera, _) = arm_cameras()
    mask = np.zeros((camera.height, camera.width), dtype=bool)
    mask[where] = True
    result = search.match([View(camera, mask)])
    assert result.found
    assert not result.explained
    assert result.E_total > 0.5


def test_body_cut_off_by_the_pictures_edge(tree, search, pose):
    """What would lie outside the picture does not count against a pose."""
    views = []
    for camera, columns in zip(arm_cameras(320, 240), (slice(0, 250), slice(60, 320)), strict=True):
        whole = draw_view(tree, pose, camera)
        first, last = columns.start, columns.stop
        part = type(camera)(
            camera.name, last - first, 170, camera.focal_x, camera.focal_y,
            camera.center_x - first, camera.center_y, camera.X_WC,
        )  # fmt: skip
        views.append(View(part, np.ascontiguousarray(whole.mask[:170, columns])))
        assert whole.mask[170].any()
    result = search.match(views)
    assert result.J == recount(tree, result, views)
    assert result.E_total < 0.05
    assert worst_place(tree, result, pose) < 0.02


def test_salt_noise(tree, search, pose):
    generator = np.random.default_rng(8)
    views = clean_views(tree, pose)
    for view in views:
        view.mask[generator.random(view.mask.shape) < 0.1] = True
    result = search.match(views)
    assert worst_place(tree, result, pose) < 0.02
    # J is still that of the silhouettes as they were given.
    assert result.J == recount(tree, result, views)


def shape():
    rows, columns = np.mgrid[:120, :150]
    mask = np.hypot(rows - 60, columns - 70) < 35
    mask[58:62, 20:140] = True
    return mask


def test_clean_masks_stay_as_they_are():
    mask = shape()
    mask[5, 5] = True
    np.testing.assert_array_equal(without_specks(mask), mask)


def test_salt_and_pepper_go():
    generator = np.random.default_rng(1)
    for salt, pepper in ((0.1, 0.0), (0.1, 0.1)):
        chance = generator.random((120, 150))
        noisy = (shape() | (chance < salt)) & (chance < 1.0 - pepper)
        cleaned = without_specks(noisy)
        assert (cleaned ^ shape()).sum() < 0.05 * shape().sum()
        assert (noisy ^ shape()).sum() > 0.2 * shape().sum()


def test_a_mask_of_nothing_but_specks_is_not_emptied():
    mask = np.zeros((50, 60), dtype=bool)
    mask[10, 10] = mask[30, 40] = True
    np.testing.assert_array_equal(without_specks(mask), mask)
