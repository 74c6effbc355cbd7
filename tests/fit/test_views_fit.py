"""The fit of one instant's silhouettes, and what damage does to it."""

import numpy as np
import pytest

from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.errors import SettingsError
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import few_triangles
from drake_pose.search.continuous.views_fit import FittedPose, ViewsFit, distinct
from drake_pose.silhouette.areas.bending import TreeSurfaces
from tests.search.arms import arm_cameras, arm_tree, draw_pose, draw_view

FINE = tuple(AnnealingStage(scale, 0.0125, 8) for scale in (0.05, 0.025, 0.0125))


@pytest.fixture(scope="module")
def kinematics(tmp_path_factory):
    return TreeKinematics(arm_tree(tmp_path_factory.mktemp("arm")))


def make_fit(kinematics, views):
    return ViewsFit(kinematics, few_triangles(TreeSurfaces(kinematics.tree)), views)


def views_at(kinematics, values):
    return [draw_view(kinematics.tree, values, camera) for camera in arm_cameras()]


def test_refinement_finds_the_pose_nearby(kinematics):
    generator = np.random.default_rng(3)
    errors = []
    for _ in range(5):
        truth = draw_pose(kinematics.tree, generator)
        fit = make_fit(kinematics, views_at(kinematics, truth))
        start = np.clip(
            truth + generator.normal(0.0, 0.08, len(truth)), kinematics.lower, kinematics.upper
        )
        found = fit.refine(start, FINE)
        assert found.cost < fit.cost(start, FINE[-1])
        errors.append(np.abs(found.values - truth).max())
    assert np.median(errors) < np.radians(1.5)


def test_an_occluder_does_not_drag_the_pose(kinematics):
    truth = np.array([0.3, 0.5, 0.2, 0.8, -0.4])
    views = views_at(kinematics, truth)
    for view in views:
        rows, columns = np.nonzero(view.mask)
        row, column = int(np.median(rows)), int(np.median(columns))
        view.mask[row - 12 : row + 12, column - 6 : column + 30] = False
    fit = make_fit(kinematics, views)
    found = fit.refine(truth + np.array([0.05, -0.05, 0.04, 0.05, -0.05]), FINE)
    assert np.abs(found.values - truth).max() < np.radians(3.0)


def test_limits_and_held_values(kinematics):
    truth = np.array([0.3, 0.5, 0.2, 0.8, -0.4])
    fit = make_fit(kinematics, views_at(kinematics, truth))
    outside = kinematics.upper + 0.5
    found = fit.refine(outside, FINE, held=(1,))
    assert found.values[1] == outside[1]
    free = [0, 2, 3, 4]
    assert (found.values[free] <= kinematics.upper[free]).all()
    assert (found.values[free] >= kinematics.lower[free]).all()


def test_distinct_keeps_the_best_of_those_alike():
    poses = [FittedPose(np.array([x, 0.0]), cost) for x, cost in ((0, 3), (0.01, 1), (1, 2))]
    assert [pose.cost for pose in distinct(poses, 5)] == [1, 2]
    assert [pose.cost for pose in distinct(poses, 1)] == [1]


@pytest.mark.parametrize(("name", "value"), [("scale", 0.0), ("iterations", 0), ("spacing", 0.0)])
def test_settings_out_of_range(name, value):
    with pytest.raises(SettingsError, match=name):
        AnnealingStage(**{"scale": 1.0, "iterations": 1, "spacing": 1.0, name: value})
