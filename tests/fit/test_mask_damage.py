"""The damage that tests do to silhouettes is what it says, and as large."""

import numpy as np

from drake_pose.search.estimates import View
from tests.search.arms import arm_cameras
from tests.search.mask_damage import MaskDamage, damage_views, nudge_camera

NOTHING = MaskDamage(missing=0, occluder=0, shadow=0, holes=0, raggedness=0, shift=0)


def discs():
    """Two views of a flat cloud of points about the middle of both pictures."""
    views = []
    for camera in arm_cameras():
        rows, columns = np.mgrid[: camera.height, : camera.width]
        views.append(View(camera, np.hypot(rows - 120, columns - 160) < 60))
    return views, np.random.default_rng(1).normal([0.0, 0.0, 0.45], 0.1, (50, 3))


def test_nothing_is_done_where_nothing_is_asked_for():
    views, points = discs()
    for before, after in zip(
        views, damage_views(views, points, NOTHING, np.random.default_rng(2)), strict=True
    ):
        np.testing.assert_array_equal(before.mask, after.mask)


def test_each_kind_of_damage():
    views, points = discs()
    area = views[0].mask.sum()
    kinds = {"missing": -1, "occluder": -1, "shadow": 1, "holes": -1}
    for name, sign in kinds.items():
        damage = MaskDamage(**{**vars(NOTHING), name: 5 if name == "holes" else 1.0})
        changes = []
        for seed in range(5):
            after = damage_views(views, points, damage, np.random.default_rng(seed))
            added = [(new.mask & ~old.mask).sum() for old, new in zip(views, after, strict=True)]
            lost = [(old.mask & ~new.mask).sum() for old, new in zip(views, after, strict=True)]
            assert sum(lost if sign > 0 else added) == 0
            changes += added if sign > 0 else lost
        assert 0 < np.mean(changes) < 0.3 * area


def test_ragged_edges_wander_by_so_many_pixels():
    views, points = discs()
    damage = MaskDamage(**{**vars(NOTHING), "raggedness": 1.5})
    (after, _) = damage_views(views, points, damage, np.random.default_rng(3))
    # The mean distance of a normal variable is 0.8 of its standard deviation.
    changed = (after.mask ^ views[0].mask).sum() / (2 * np.pi * 60)
    assert 0.6 < changed / (0.8 * 1.5) < 1.4


def test_a_nudged_camera_moves_its_picture_by_so_many_pixels():
    (camera, _) = arm_cameras()
    point = np.array([[0.1, -0.2, 0.4]])
    generator = np.random.default_rng(4)
    moved = [
        nudge_camera(camera, 2.0, generator).project(point)[0] - camera.project(point)[0]
        for _ in range(200)
    ]
    np.testing.assert_allclose(np.std(moved, axis=0).ravel(), [2.0, 2.0], rtol=0.2)
