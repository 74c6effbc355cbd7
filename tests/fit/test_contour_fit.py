"""Matches, weights, and fits of one pose."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.camera.models import ParallelCamera, circle_of_cameras
from drake_pose.fit.contour_fit import (
    ContourFit,
    Noise,
    PoseFit,
    Prior,
    camera_weights,
    compare_views,
    pack_cameras,
    pack_views,
    pixels_per_metre,
)
from drake_pose.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.fit.kernel import Sum, assemble_normal_equations, match_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

STEPS = (
    AnnealingStage(0.08, 0.06),
    AnnealingStage(0.04, 0.06),
    AnnealingStage(0.02, 0.05),
    AnnealingStage(0.02, 0.05),
)


@pytest.fixture(scope="module")
def fit(person):
    return ContourFit(person.pose_tree())


def standing_pose(person, **degrees):
    q = np.zeros(len(person.position_names))
    q[person.position_index("position_z")] = 1.55
    for name, angle in degrees.items():
        q[person.position_index(name)] = np.radians(angle)
    return q


def test_matched_points_against_brute_force():
    generator = np.random.default_rng(3)

    def cloud(count):
        uv, angle = generator.uniform(0, 60, (count, 2)), generator.uniform(0, 2 * np.pi, count)
        return uv[np.argsort(uv[:, 1])], np.column_stack([np.cos(angle), np.sin(angle)])

    (uv, normals), (edge_uv, edge_normals) = cloud(70), cloud(90)
    of_point = match_points(uv, normals, edge_uv, edge_normals, 9.0)
    of_edge = match_points(edge_uv, edge_normals, uv, normals, 9.0)
    distance = np.linalg.norm(uv[:, None] - edge_uv[None], axis=2)
    distance[(normals @ edge_normals.T < 0.3) | (distance >= 9.0)] = np.inf
    for found, expected in ((of_point, distance), (of_edge, distance.T)):
        wanted = np.where(np.isinf(expected.min(axis=1)), -1, expected.argmin(axis=1))
        np.testing.assert_array_equal(found, wanted)


def test_normal_equations_match_dense_products():
    generator = np.random.default_rng(0)
    half = generator.normal(size=(2, 12, 12))
    A = np.einsum("nij,nkj->nik", half, half)
    b, motions = generator.normal(size=(2, 12)), generator.normal(size=(5, 12))
    owners, parameters = np.array([0, 2, 1, 3, 4]), np.array([0, 1, 1, 2, 3])
    H, g = assemble_normal_equations(
        np.tril(A), b, motions, np.array([0, 2, 5]), owners, parameters, 4
    )
    expected_H, expected_g = np.zeros((4, 4)), np.zeros(4)
    for node, rows in ((0, [0, 1]), (1, [2, 3, 4])):
        J = np.zeros((12, 4))
        for row in rows:
            J[:, parameters[row]] += motions[owners[row]]
        expected_H += J.T @ A[node] @ J
        expected_g -= J.T @ b[node]
    np.testing.assert_allclose(H, expected_H, rtol=1e-9)
    np.testing.assert_allclose(g, expected_g, rtol=1e-9)


@pytest.mark.parametrize("pixels", [40.0, np.array([40.0, 90.0])])
def test_a_pixel_of_contour_has_the_weight_one(fit, pixels):
    (pinhole,) = circle_of_cameras(1, face_camera=False).values()
    cameras = pack_cameras([pinhole, replace(pinhole, focal_x=2.0 * pinhole.focal_x)])
    placement, step = fit.body.place(np.zeros(len(fit.lower))), AnnealingStage(0.1, 0.05)
    weights = camera_weights(cameras, placement, step, Noise.per_pixel(pixels), pixels)
    expected = np.column_stack(np.broadcast_arrays(1.0 / pixels, 0.1 * pixels, 0.05 * pixels, 1.0))
    np.testing.assert_allclose(weights, np.broadcast_to(expected, (2, 4)))
    # In units of a metre, errors in pixels grow with the focal length; fine scales are clipped.
    fine = AnnealingStage(1e-6, 1e-6)
    near, far = camera_weights(cameras, placement, fine, Noise(0.01, 0.1))
    np.testing.assert_allclose(near[0] / far[0], 2.0)
    np.testing.assert_allclose(near[3] / far[3], 2.0**3)
    np.testing.assert_allclose([near[1:3], far[1:3]], [[1.5, 1.0]] * 2)
    half = camera_weights(cameras, placement, fine, Noise(0.02, 0.2))
    np.testing.assert_allclose(near[3] / half[0, 3], 8.0)


def test_pixels_per_metre_match_projections():
    (pinhole,) = circle_of_cameras(1, face_camera=False).values()
    parallel = ParallelCamera("parallel", 640, 480, 250.0, 320.0, 240.0, pinhole.X_WC)
    place = np.array([0.1, -0.2, 1.3])
    for camera in (pinhole, parallel):
        (size,) = pixels_per_metre(pack_cameras([camera]), place)
        ends = place + 1e-3 * np.outer([-1.0, 1.0], camera.X_WC[:3, 0])
        assert np.diff(camera.project(ends)[0][:, 0])[0] / 2e-3 == pytest.approx(size, rel=1e-6)


def test_scores_are_fractions_of_both_contours():
    sums = np.random.default_rng(1).uniform(size=(3, 6))
    found = PoseFit(np.zeros(1), sums, 0.0, 1)
    total = sums.sum(axis=0)
    assert found.inlier_ratio == pytest.approx(total[Sum.FITTING] / total[Sum.COMPARED])
    assert found.closeness == pytest.approx(total[Sum.CLOSE] / total[Sum.COMPARED])
    nothing = PoseFit(np.zeros(1), 0.0 * sums, 0.0, 1)
    assert nothing.inlier_ratio == nothing.closeness == 0.0


def test_pose_is_recovered_from_drakes_masks(person, fit):
    true = standing_pose(
        person, left_upper_arm_z=50, left_forearm_x=-60, right_upper_arm_x=-70,
        right_forearm_x=-30, left_thigh_x=-40, left_shin_x=50, neck_base_x=20,
    )  # fmt: skip
    cameras = list(circle_of_cameras(4, size=(320, 240), face_camera=False).values())
    edges = [find_edge_points(LabelRenderer(person, camera).mask(true), 4.0) for camera in cameras]
    order = [person.position_index(name) for name in fit.kinematics.names]
    start = true[order] + np.random.default_rng(1).normal(0.0, 0.08, len(order))
    prior, views = Prior(start, np.full(len(start), 1.0 / 0.3**2)), pack_views(cameras, edges)
    found = fit.fit(views, start, (*STEPS, *STEPS), prior)
    off = fit.kinematics.poses(found.values) - fit.kinematics.poses(true[order])
    assert 1e3 * np.linalg.norm(off[:, :3, 3], axis=1).max() < 12.0
    assert found.inlier_ratio > 0.9
    assert (found.values >= fit.lower).all()
    assert (found.values <= fit.upper).all()

    def compare(placement, stage):
        return compare_views(views, placement, fit.weights(views.cameras, placement, stage))

    again = fit.fit(compare, start, (*STEPS, *STEPS), prior)
    np.testing.assert_array_equal(again.values, found.values)
    # Costs in tiles of the image add up to the cost.
    tiles = fit.tile_costs(views, found.values, STEPS[-1], 20.0)
    sums = fit.compare(views, found.values, STEPS[-1]).sums
    np.testing.assert_allclose(tiles.sum(axis=(1, 2)), sums[:, :, Sum.COST].sum(axis=1))
    assert 5 < np.count_nonzero(tiles[0]) < 100


def test_fixed_values_and_unobserved_values_stay(person, fit):
    camera = circle_of_cameras(1, size=(160, 120), face_camera=False)["camera_0"]
    start, nothing = np.zeros(len(fit.lower)), pack_views([camera], [NO_EDGE])
    found = fit.fit(nothing, start, STEPS)
    np.testing.assert_allclose(found.values, start, atol=1e-9)
    assert (found.inlier_ratio, found.evaluations) == (0.0, len(STEPS))
    # A prior pulls, within the limits.
    prior = Prior(start + 0.03, np.full(len(start), 100.0))
    found = fit.fit(nothing, start, [AnnealingStage(0.1, 0.1, 20)], prior)
    expected = np.clip(start + 0.03, fit.lower, fit.upper)
    np.testing.assert_allclose(found.values, expected, atol=2e-3)
    cost = 100.0 * ((found.values - prior.mean) ** 2).sum()
    assert found.cost == pytest.approx(cost)
    edge = find_edge_points(LabelRenderer(person, camera).mask(standing_pose(person)), 4.0)
    order = [person.position_index(name) for name in fit.kinematics.names]
    start = standing_pose(person)[order] + 0.05
    held = np.arange(len(start)) % 2 == 0
    found = fit.fit(pack_views([camera], [edge]), start, STEPS, None, held)
    clipped = np.clip(start, fit.lower, fit.upper)
    np.testing.assert_array_equal(found.values[held], start[held])
    assert np.abs(found.values - clipped)[~held].max() > 1e-3
