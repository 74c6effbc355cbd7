"""Searches with a mimic joint: the gripper's fingers are one unknown."""

import itertools
import math

import numpy as np
import pytest

from drake_pose.search import (
    BeamSearch,
    BeamSearchSettings,
    ExaminationSettings,
    MultiStartSearch,
    PaperSearch,
    PaperSearchSettings,
    Scoring,
    View,
)
from drake_pose.search.branch_and_bound import branch_and_bound
from drake_pose.search.sampled_body import SampledBody
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

from .arms import arm_cameras, gripper

GRID = {"interval": math.radians(15.0), "length_interval": 0.02}
ON_GRID = np.array([math.radians(15.0), math.radians(-30.0), 0.04, 0.04])


def gripper_views(model, q):
    """Return two views of the gripper, drawn by Drake."""
    return [View(camera, LabelRenderer(model, camera).mask(q)) for camera in arm_cameras()]


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gripper")
    return {follows: gripper(folder, follows=follows) for follows in (True, False)}


def test_multi_start_search_finds_one_value_for_both_fingers(models):
    matcher = MultiStartSearch(models[True].pose_tree())
    for q in ([0.3, -0.5, 0.04, 0.04], [-0.4, 0.7, 0.01, 0.01]):
        found = matcher.match(gripper_views(models[True], np.array(q)))
        np.testing.assert_allclose(found.q, q, atol=0.02)
        np.testing.assert_allclose(found.q[2:], q[2:], atol=1e-3)
        assert found.q[2] == found.q[3]
        intervals = found.pose_set.position_intervals(matcher.tree)
        np.testing.assert_array_equal(intervals[:, 2], intervals[:, 3])
        names = [joint.name for joint in found.pose_set.joints]
        assert names == ["mast_joint", "hand_joint", "left_joint"]


def test_grid_searches_find_the_pose_and_prove_it(models):
    for follows, model in models.items():
        tree, views = model.pose_tree(), gripper_views(model, ON_GRID)
        for search in (
            PaperSearch(tree, PaperSearchSettings(**GRID)),
            BeamSearch(tree, BeamSearchSettings(**GRID), ExaminationSettings()),
        ):
            found = search.match(views)
            np.testing.assert_allclose(found.q, ON_GRID, atol=1e-9)
        assert found.proved_optimal
        assert found.pose_set.complete
        assert len(found.pose_set.joints) == (3 if follows else 4)


def test_poses_within_a_limit_equal_those_of_brute_force(models):
    body = SampledBody(models[True].pose_tree(), BeamSearchSettings(**GRID))
    tree = body.sampled.tree
    assert [tree.nodes[tree.source(i)].name for i in range(4)] == ["mast", "hand", "left", "left"]
    views = gripper_views(models[False], np.array([0.2, -0.4, 0.05, 0.03]))
    grids = [range(len(values)) for values in body.sampled.values]
    samples = np.array([pose for pose in itertools.product(*grids) if pose[2] == pose[3]])
    Js = Scoring(body.sampled, views).J(samples)
    limit = float(np.sort(Js)[40])
    found = branch_and_bound(body, views, limit)
    assert found.complete
    assert found.graph.size == np.count_nonzero(Js <= limit)
    assert all(
        found.graph.contains(one) == (J <= limit) for one, J in zip(samples, Js, strict=True)
    )
