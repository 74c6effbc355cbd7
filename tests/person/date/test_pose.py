"""Inverse kinematics and the search on circles, against known poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import circle_of_cameras
from drake_pose.person.date import pose
from drake_pose.person.date.skeleton import LIMBS
from tests.person.date.test_skeleton import drawn_pose
from tests.person.persons_in_view import SIDES, posed, see


class TestReach:
    @pytest.mark.parametrize("name", LIMBS)
    def test_end_reaches_its_target_in_small_steps_inside_the_limits(self, skeleton, name):
        generator, limb = np.random.default_rng(2), skeleton.limbs[name]
        for _ in range(5):
            true = drawn_pose(skeleton, generator, 0.6)
            start, end = np.array(true), skeleton.limb_points(true, name)[2]
            start[limb.positions] += generator.uniform(-0.3, 0.3, 4)
            start = skeleton.clip(start)
            found = pose.move_limb(skeleton, start, name, end)
            assert np.linalg.norm(skeleton.limb_points(found, name)[2] - end) < 2e-3
            np.testing.assert_array_equal(found, skeleton.clip(found))
            others = np.delete(np.arange(len(found)), limb.positions)
            np.testing.assert_array_equal(found[others], start[others])


class TestCircle:
    @pytest.mark.parametrize("name", LIMBS)
    def test_circle_angles_are_the_papers(self, person, skeleton, name):
        # The person faces +x with slightly bent limbs: 0 is behind the arm and in front of the leg.
        bends = {"forearm_x": -40, "shin_x": 60, "thigh_x": -30}
        q = posed(person, **{f"{side}_{k}": a for k, a in bends.items() for side in SIDES})
        (root, middle, end), limb = skeleton.limb_points(q, name), skeleton.limbs[name]
        turns, outward = np.array([0.0, 90.0, 180.0, 270.0]), np.array([0.0, limb.side, 0.0])
        zero, aside, half, _ = places = pose.joint_circle(limb, root, end, outward, turns)
        center = places.mean(axis=0)
        radius = np.linalg.norm(zero - center)
        assert (aside - center)[1] * limb.side > 0.9 * radius
        assert (zero - half)[0] * (1.0 if limb.is_leg else -1.0) > 1.4 * radius
        assert (middle - center) @ (zero - center) > 0.9 * radius**2
        for joint, length in zip((root, end), limb.lengths, strict=True):
            np.testing.assert_allclose(np.linalg.norm(places - joint, axis=1), length)

    def test_unreachable_end_straightens_the_limb(self, skeleton):
        limb, end, outward = skeleton.limbs["left_arm"], np.array([0, 0, -2.0]), np.eye(3)[1]
        places = pose.joint_circle(limb, np.zeros(3), end, outward, np.array([0.0, 90.0]))
        expected = [0, 0, -2.0 * limb.lengths[0] / sum(limb.lengths)]
        np.testing.assert_allclose(places, [expected] * 2, atol=1e-12)


@pytest.fixture(scope="module")
def seen(person):
    """Cameras, and a function that returns their regions of a pose."""
    cameras = circle_of_cameras(8, size=(320, 240), face_camera=False)

    def seen(q):
        return list(cameras.values()), list(see(person, cameras, q[None])[0].values())

    return seen


class TestPose:
    def test_waist_is_below_the_head_by_the_formula(self, person, skeleton, seen):
        """And positions satisfy the limits, wherever the features are."""
        q = posed(person, left_thigh_x=-20, left_shin_x=30, right_shin_x=10)
        features, head, views = skeleton.features(q), q[skeleton.head_angles], seen(q)
        feet = features[3:, 2]
        formula = [*features[0, :2], 0.55 * features[0, 2] + 0.225 * feet[0] + 0.225 * feet[1]]
        _, limbs = pose.estimate_pose(skeleton, q, features, head, *views, search=False)
        hips = 0.5 * (limbs["left_leg"][0] + limbs["right_leg"][0])
        np.testing.assert_allclose(hips, formula, atol=1e-9)
        generator = np.random.default_rng(7)
        for _ in range(3):
            off, angles = generator.normal(0, 0.3, (5, 3)), generator.normal(0, 2, 2)
            found, _ = pose.estimate_pose(skeleton, q, features + off, angles, *views)
            np.testing.assert_array_equal(found, skeleton.clip(found))

    @pytest.mark.parametrize("name", LIMBS)
    def test_limb_angles_reproduce_the_joints_inside_the_limits(self, skeleton, name):
        """By the limb's kinematics anywhere on the circle; inside the limits at the true place."""
        generator = np.random.default_rng(5)
        limb = skeleton.limbs[name]
        for _ in range(5):
            q = drawn_pose(skeleton, generator)
            root, middle, end = skeleton.limb_points(q, name)
            R_WT, _ = skeleton.trunk_pose(q)
            across = (end - root) / np.linalg.norm(end - root)
            turns = Rotation.from_rotvec(np.linspace(0.0, 5.0, 6)[:, None] * across)
            middles = root + turns.apply(middle - root)
            angles, beyond = pose.limb_angles(limb, R_WT, root, middles, end, q[limb.positions])
            assert beyond[0] < 1e-6
            excess = np.abs(angles - np.clip(angles, limb.lower, limb.upper)).max(axis=1)
            np.testing.assert_allclose(beyond, excess, atol=1e-6)
            for place, found in zip(middles, angles, strict=True):
                turned = np.array(q)
                turned[limb.positions] = found
                points = skeleton.limb_points(turned, name)
                np.testing.assert_allclose(points, [root, place, end], atol=1e-6)
