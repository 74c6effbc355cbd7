"""The robust refinement against finite differences, and what damage does to it."""

import numpy as np
import pytest

from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.errors import SettingsError
from drake_pose.matching import View
from drake_pose.matching.fit.robust_fit import (
    RobustFit,
    RobustPass,
    RobustPose,
    few_triangles,
    unlike,
)
from drake_pose.matching.fit.robust_kernel import add_body_contour, add_silhouette_edge
from drake_pose.silhouette import TreeSurfaces
from tests.matching.arms import arm_cameras, arm_tree, draw_pose, draw_view

FINE = RobustPass((0.05, 0.025, 0.0125), 8, 0.0125)


@pytest.fixture(scope="module")
def kinematics(tmp_path_factory: pytest.TempPathFactory) -> TreeKinematics:
    return TreeKinematics(arm_tree(tmp_path_factory.mktemp("arm")))


def make_fit(kinematics: TreeKinematics, views: list[View]) -> RobustFit:
    return RobustFit(kinematics, few_triangles(TreeSurfaces(kinematics.tree)), views)


def views_at(kinematics: TreeKinematics, values: np.ndarray) -> list[View]:
    return [draw_view(kinematics.tree, values, camera) for camera in arm_cameras()]


def test_derivative_of_the_body_contours_cost() -> None:
    """A cloud of points moving in a smooth field of distances: g is half c^2 times the gradient."""
    rows, columns = np.mgrid[:80, :90].astype(np.float64)
    distances = (np.hypot(rows - 40.0, columns - 45.0) - 25.0).astype(np.float32)
    generator = np.random.default_rng(1)
    uv = np.array([45.0, 40.0]) + generator.uniform(-30, 30, (40, 2))
    outwards = uv - np.array([45.0, 40.0])
    normals = outwards / np.linalg.norm(outwards, axis=1)[:, None]
    motion = generator.normal(size=(40, 2, 3))
    # Along the normal only, as the refinement assumes of a contour.
    motion = normals[:, :, None] * (normals[:, :, None] * motion).sum(axis=1, keepdims=True)
    scale, lengths = 4.0, generator.uniform(0.5, 2.0, 40)

    def cost(step: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        H, g = np.zeros((3, 3)), np.zeros(3)
        value = add_body_contour(
            distances, uv + motion @ step, normals, lengths, motion, scale, H, g
        )
        return value, H, g

    _, H, g = cost(np.zeros(3))
    gradient = [(cost(0.02 * axis)[0] - cost(-0.02 * axis)[0]) / 0.04 for axis in np.eye(3)]
    np.testing.assert_allclose(2.0 * g / scale**2, gradient, rtol=0.03, atol=0.02)
    assert (np.linalg.eigvalsh(H + np.tril(H, -1).T) >= -1e-9).all()


def test_derivative_of_the_silhouette_edges_cost() -> None:
    """Points of an edge that each see one moving straight contour."""
    generator = np.random.default_rng(2)
    edge = np.column_stack([np.arange(0.0, 60.0, 2.0), generator.uniform(18.0, 26.0, 30)])
    up = np.tile([0.0, 1.0], (30, 1))
    uv = np.column_stack([np.arange(0.0, 60.0, 0.5), np.full(120, 20.0)])
    normals = np.tile([0.0, 1.0], (120, 1))
    motion = np.zeros((120, 2, 2))
    motion[:, 1, 0], motion[:, 1, 1] = 1.0, uv[:, 0] / 60.0

    def cost(step: np.ndarray) -> tuple[float, np.ndarray]:
        g = np.zeros(2)
        moved = uv + motion @ step
        value = add_silhouette_edge(edge, up, 2.0, moved, normals, motion, 3.0, np.zeros((2, 2)), g)
        return value, g

    _, g = cost(np.zeros(2))
    gradient = [(cost(0.01 * axis)[0] - cost(-0.01 * axis)[0]) / 0.02 for axis in np.eye(2)]
    np.testing.assert_allclose(2.0 * g / 9.0, gradient, rtol=0.02, atol=0.02)


def test_a_stretch_without_counterpart_costs_its_length_and_pulls_at_nothing() -> None:
    distances = np.full((50, 50), 40.0, dtype=np.float32)
    distances += np.arange(50, dtype=np.float32)
    uv, normals = np.array([[20.0, 20.0]]), np.array([[1.0, 0.0]])
    H, g = np.zeros((1, 1)), np.zeros(1)
    motion = np.array([[[1.0], [0.0]]])
    cost = add_body_contour(distances, uv, normals, np.array([3.0]), motion, 1.0, H, g)
    assert cost == pytest.approx(3.0, rel=1e-3)
    assert abs(g[0]) < 1e-4


def test_refinement_finds_the_pose_nearby(kinematics: TreeKinematics) -> None:
    generator = np.random.default_rng(3)
    errors = []
    for _ in range(5):
        truth = draw_pose(kinematics.tree, generator)
        fit = make_fit(kinematics, views_at(kinematics, truth))
        start = np.clip(
            truth + generator.normal(0.0, 0.08, len(truth)), kinematics.lower, kinematics.upper
        )
        found = fit.refine(start, FINE)
        assert found.cost < fit.cost(start, FINE.scales[-1], FINE.spacing)
        errors.append(np.abs(found.values - truth).max())
    assert np.median(errors) < np.radians(1.5)


def test_an_occluder_does_not_drag_the_pose(kinematics: TreeKinematics) -> None:
    truth = np.array([0.3, 0.5, 0.2, 0.8, -0.4])
    views = views_at(kinematics, truth)
    for view in views:
        rows, columns = np.nonzero(view.mask)
        row, column = int(np.median(rows)), int(np.median(columns))
        view.mask[row - 12 : row + 12, column - 6 : column + 30] = False
    fit = make_fit(kinematics, views)
    found = fit.refine(truth + np.array([0.05, -0.05, 0.04, 0.05, -0.05]), FINE)
    assert np.abs(found.values - truth).max() < np.radians(3.0)


def test_limits_and_held_values(kinematics: TreeKinematics) -> None:
    truth = np.array([0.3, 0.5, 0.2, 0.8, -0.4])
    fit = make_fit(kinematics, views_at(kinematics, truth))
    outside = kinematics.upper + 0.5
    found = fit.refine(outside, FINE, held=(1,))
    assert found.values[1] == outside[1]
    free = [0, 2, 3, 4]
    assert (found.values[free] <= kinematics.upper[free]).all()
    assert (found.values[free] >= kinematics.lower[free]).all()


def test_unlike_keeps_the_best_of_those_alike() -> None:
    poses = [RobustPose(np.array([x, 0.0]), cost) for x, cost in ((0, 3), (0.01, 1), (1, 2))]
    assert [pose.cost for pose in unlike(poses, 5)] == [1, 2]
    assert [pose.cost for pose in unlike(poses, 1)] == [1]


@pytest.mark.parametrize(
    ("name", "value"), [("scales", ()), ("scales", (0.0,)), ("iterations", 0), ("spacing", 0.0)]
)
def test_settings_out_of_range(name: str, value: object) -> None:
    with pytest.raises(SettingsError, match=name):
        RobustPass(**{"scales": (1.0,), "iterations": 1, "spacing": 1.0, name: value})
