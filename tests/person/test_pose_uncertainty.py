from dataclasses import replace

import numpy as np
import pytest

from drake_pose.body import TriangleMesh
from drake_pose.camera.models import circle_of_cameras
from drake_pose.fit.contour_fit import ContourFit, pack_views
from drake_pose.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.person.pose_tracker import pose_uncertainty
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.scoring import draw_mask
from tests.person.persons_in_view import posed

STEP = AnnealingStage(0.03, 0.05)


class World:
    def __init__(self, person):
        self.person, self.fit = person, ContourFit(person.pose_tree())
        self.cameras = list(circle_of_cameras(6, size=(320, 240), face_camera=False).values())
        self.names = self.fit.kinematics.names

    def values(self, **degrees):
        order = [self.person.position_index(name) for name in self.names]
        return posed(self.person, **degrees)[order]

    def views(self, values, outlines=None):
        X_WN = self.fit.kinematics.poses(values)
        outlines = self.fit.outlines if outlines is None else outlines
        masks = [draw_mask(outlines, camera.X_CW @ X_WN, camera) for camera in self.cameras]
        return pack_views(self.cameras, [find_edge_points(mask, 4.0) for mask in masks])

    def deviations(self, values, views, **more):
        covariance, *_ = pose_uncertainty(self.fit, self.fit.compare(views, values, STEP), **more)
        return dict(zip(self.names, np.sqrt(np.diag(covariance)), strict=True))


@pytest.fixture(scope="module")
def world(person):
    return World(person)


POSE = {
    "left_upper_arm_z": 50.0, "right_upper_arm_z": -60.0, "left_forearm_x": -70.0,
    "right_forearm_x": -50.0, "left_thigh_x": -30.0, "left_shin_x": 50.0, "right_shin_x": 15.0,
}  # fmt: skip


def deformed(outlines, generator, size):
    """Shift and stretch every part at random, with this standard deviation [m]."""
    found = []
    for outline in outlines:
        middle = outline.vertices.mean(axis=0)
        wide = np.sqrt(((outline.vertices - middle) ** 2).mean(axis=0))
        growth = 1.0 + generator.normal(0.0, size, 3) / wide
        vertices = middle + growth * (outline.vertices - middle)
        vertices = vertices + generator.normal(0.0, size, 3)
        found.append(outline_from_mesh(TriangleMesh(vertices, outline.triangles)))
    return tuple(found)


class TestUncertainty:
    @pytest.mark.parametrize("size", [0.0, 0.003])
    def test_true_values_are_within_two_standard_deviations(self, world, size):
        generator = np.random.default_rng(3)
        ratios, surfaces = [], []
        for _ in range(6):
            pose = {name: angle * generator.uniform(0.7, 1.3) for name, angle in POSE.items()}
            true = world.values(**pose, head_y=generator.uniform(-20, 20))
            views = world.views(true, deformed(world.fit.outlines, generator, size))
            values = world.fit.fit(views, true, [STEP] * 6).values
            covariance, _, surface = pose_uncertainty(
                world.fit, world.fit.compare(views, values, STEP)
            )
            ratios.append((values - true) / np.sqrt(np.diag(covariance)))
            surfaces.append(surface)
        inside = (np.abs(ratios) < 2.0).mean()
        assert 0.8 < inside <= 1.0
        assert 0.2 < np.mean(np.square(ratios)) < 2.0
        if size:
            assert 0.3 * size < np.median(surfaces) < 3.0 * size
        else:
            assert np.median(surfaces) < 0.002

    def test_unobservable_values_have_the_variance_of_their_limits(self, world):
        values = world.values(**POSE)
        empty = pack_views(world.cameras, [NO_EDGE] * len(world.cameras))
        found = world.deviations(values, empty)
        kinematics = world.fit.kinematics
        for k, name in enumerate(world.names):
            if kinematics.is_angle[k]:
                span = min(kinematics.upper[k] - kinematics.lower[k], 2.0 * np.pi)
                assert found[name] == pytest.approx(span / np.sqrt(12.0), rel=1e-6)
        # Turning a hanging, stretched arm about its axis does not change the silhouettes.
        stretched = world.values(left_upper_arm_z=20.0)
        bent = world.values(left_upper_arm_z=20.0, left_forearm_x=-90.0)
        twists = [
            world.deviations(pose, world.views(pose))["left_upper_arm_y"]
            for pose in (stretched, bent)
        ]
        assert twists[0] > 1.5 * twists[1]

    def test_uncertainty_of_held_values_propagates(self, world):
        values = world.values(**POSE)
        edges = world.views(values)
        held = np.array([name == "left_upper_arm_z" for name in world.names])
        exact = world.deviations(values, edges, held=held)
        assert exact["left_upper_arm_z"] == 0.0
        rough = world.deviations(values, edges, held=held, held_covariance=np.array([[0.2**2]]))
        assert rough["left_upper_arm_z"] == pytest.approx(0.2)
        assert rough["left_upper_arm_y"] > 1.5 * exact["left_upper_arm_y"]
        assert rough["right_shin_x"] < 1.5 * exact["right_shin_x"]

    def test_noise_is_estimated_from_the_residuals(self, world):
        values = world.values(**POSE)
        views = world.views(values)
        noise = replace(world.fit.noise, deviation=2.0 * world.fit.noise.deviation)
        bold = ContourFit(world.person.pose_tree(), noise=noise)
        modest, assumed = (
            np.diag(pose_uncertainty(fit, fit.compare(views, values, STEP))[0])
            for fit in (world.fit, bold)
        )
        assert (np.abs(np.log(modest / assumed)) < 2.0 * np.log(1.5)).all()
