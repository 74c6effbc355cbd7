"""Skeleton, inverse kinematics and the search on circles, against Drake and known poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import bundled_model, landmark_positions, load_landmarks, load_model
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import ModelError
from drake_pose.person.date.pose import (
    correlation,
    estimate_pose,
    joint_circle,
    limb_angles,
    move_limb,
    move_upper_body,
    reach,
    rectangles,
)
from drake_pose.person.date.skeleton import FEATURES, LIMBS, load_skeleton
from tests.body.models import link_poses
from tests.person.persons_in_view import SIDES, posed, see


def drawn_pose(skeleton, generator, share=0.5):
    """Random positions within the middle `share` of the limits."""
    middle = 0.5 * (skeleton.lower + skeleton.upper)
    q = middle + share * generator.uniform(-0.5, 0.5, len(middle)) * (
        skeleton.upper - skeleton.lower
    )
    q[skeleton.head_positions] = generator.uniform([-1, -1, 1.4], [1, 1, 1.7])
    return q


class TestSkeleton:
    def test_limb_points_match_drake_and_ends_are_inside_hands_and_feet(self, person, skeleton):
        generator, landmarks = np.random.default_rng(0), load_landmarks(person.path)
        for _ in range(5):
            q = drawn_pose(skeleton, generator, 1.0)
            true = dict(zip(landmarks, landmark_positions(person, landmarks, q), strict=True))
            np.testing.assert_allclose(skeleton.trunk_pose(q)[1], true["neck"], atol=1e-12)
            for name in LIMBS:
                side, kind = name.split("_")
                joints = ("shoulder", "elbow") if kind == "arm" else ("hip", "knee")
                points = skeleton.limb_points(q, name)
                expected = [true[f"{side}_{joint}"] for joint in joints]
                np.testing.assert_allclose(points[:2], expected, atol=1e-12)
            poses = link_poses(person, q)
            for link, place in zip(FEATURES, skeleton.features(q), strict=True):
                p_L = (np.linalg.inv(poses[link]) @ [*place, 1.0])[:3]
                vertices = person.link_meshes[link].vertices
                assert (vertices.min(axis=0) < p_L).all()
                assert (p_L < vertices.max(axis=0)).all()

    def test_other_models_are_refused(self):
        with pytest.raises(ModelError, match="trunk"):
            load_skeleton(load_model(bundled_model("man"), check=False))


class TestReach:
    @pytest.mark.parametrize("name", LIMBS)
    def test_end_reaches_its_target_in_small_steps_inside_the_limits(self, skeleton, name):
        generator, limb = np.random.default_rng(2), skeleton.limbs[name]
        for _ in range(10):
            true = drawn_pose(skeleton, generator, 0.6)
            start, end = np.array(true), skeleton.limb_points(true, name)[2]
            start[limb.positions] += generator.uniform(-0.3, 0.3, 4)
            start = skeleton.clip(start)
            found = move_limb(skeleton, start, name, end)
            assert np.linalg.norm(skeleton.limb_points(found, name)[2] - end) < 2e-3
            np.testing.assert_array_equal(found, skeleton.clip(found))
            others = np.delete(np.arange(len(found)), limb.positions)
            np.testing.assert_array_equal(found[others], start[others])
            part = limb.lower_node, limb.end_L
            some, distance = reach(skeleton, start, limb.positions, part, end + 0.2, 5)
            assert 0 < np.abs(some - start).max() <= 5 * np.radians(2.0) + 1e-12
            left = np.linalg.norm(skeleton.limb_points(some, name)[2] - end - 0.2)
            assert distance == pytest.approx(left)

    @pytest.mark.parametrize("face_known", [True, False])
    def test_both_hands_reach_their_targets(self, person, skeleton, face_known):
        before = posed(person, left_upper_arm_z=20, right_upper_arm_z=-20)
        after = posed(
            person, left_upper_arm_z=45, left_forearm_x=-40, right_upper_arm_x=-50,
            right_upper_arm_z=-25, right_forearm_x=-30, neck_base_x=6,
        )  # fmt: skip
        features = skeleton.features(after)
        found = move_upper_body(skeleton, before, features, face_known=face_known)
        hands = skeleton.features(found)[1:3]
        assert np.linalg.norm(hands - features[1:3], axis=1).max() < 5e-3
        same = found[skeleton.head_angles] == before[skeleton.head_angles]
        assert same.all() == face_known


class TestCircle:
    @pytest.mark.parametrize("name", LIMBS)
    def test_circle_keeps_the_segments_lengths(self, skeleton, name):
        generator = np.random.default_rng(3)
        limb = skeleton.limbs[name]
        for _ in range(20):
            q = drawn_pose(skeleton, generator)
            root, middle, end = skeleton.limb_points(q, name)
            outward = root - skeleton.trunk_pose(q)[1]
            places = joint_circle(limb, root, end, outward, np.array([0.0, 45.0, 200.0, -100.0]))
            for point in places:
                assert np.linalg.norm(point - root) == pytest.approx(limb.lengths[0])
                assert np.linalg.norm(point - end) == pytest.approx(limb.lengths[1])
            # The middle joint lies in the plane of the circle.
            across = (end - root) / np.linalg.norm(end - root)
            np.testing.assert_allclose((places - middle) @ across, 0.0, atol=1e-9)

    @pytest.mark.parametrize("name", LIMBS)
    def test_circle_angles_are_the_papers(self, person, skeleton, name):
        # The person faces +x with slightly bent limbs: 0 is behind the arm and in front of the leg.
        bends = {"forearm_x": -40, "shin_x": 60, "thigh_x": -30}
        q = posed(person, **{f"{side}_{k}": a for k, a in bends.items() for side in SIDES})
        root, middle, end = skeleton.limb_points(q, name)
        limb = skeleton.limbs[name]
        degrees = np.array([0.0, 90.0, 180.0, 270.0])
        zero, aside, half, _ = places = joint_circle(
            limb, root, end, np.array([0.0, limb.side, 0.0]), degrees
        )
        center = places.mean(axis=0)
        radius = np.linalg.norm(zero - center)
        assert (aside - center)[1] * limb.side > 0.9 * radius
        assert (zero - half)[0] * (1.0 if limb.is_leg else -1.0) > 1.4 * radius
        assert (middle - center) @ (zero - center) > 0.9 * radius**2

    def test_unreachable_end_straightens_the_limb_and_rectangles_have_their_widths(self, skeleton):
        limb, end, outward = skeleton.limbs["left_arm"], np.array([0, 0, -2.0]), np.eye(3)[1]
        places = joint_circle(limb, np.zeros(3), end, outward, np.array([0.0, 90.0]))
        expected = [0, 0, -2.0 * limb.lengths[0] / sum(limb.lengths)]
        np.testing.assert_allclose(places, [expected] * 2, atol=1e-12)
        root, middle, end = np.zeros(3), np.array([0.0, 0.3, 0.0]), np.array([0.4, 0.3, 0.0])
        points = rectangles(root, middle[None], end, np.array([0.05, 0.02]))[0]
        assert np.abs(points[:, 2]).max() == 0.0
        first, second = points[:60], points[60:]
        assert np.abs(first[:, 0]).max() == pytest.approx(0.05)
        assert np.abs(second[:, 1] - 0.3).max() == pytest.approx(0.02)
        np.testing.assert_allclose(first.mean(axis=0), [0, 0.15, 0], atol=1e-12)

    def test_correlation_is_the_fraction_inside(self):
        cameras = list(circle_of_cameras(2, face_camera=False).values())
        generator = np.random.default_rng(4)
        samples = generator.uniform([-2.5, -2.5, 0], [2.5, 2.5, 2], (3, 200, 3))
        regions = [generator.uniform(size=(480, 640)) < 0.4 for _ in cameras]
        expected = np.zeros(3)
        for camera, region in zip(cameras, regions, strict=True):
            for n in range(3):
                uv, depth = camera.project(samples[n])
                uv = np.floor(uv[depth > camera.near] + 0.5).astype(int)
                ok = (uv >= 0).all(axis=1) & (uv < [640, 480]).all(axis=1)
                expected[n] += region[uv[ok, 1], uv[ok, 0]].mean() / 2
        np.testing.assert_allclose(correlation(samples, cameras, regions), expected)
        empty = np.zeros((480, 640), bool)
        alone = correlation(samples, cameras[:1], regions[:1])
        np.testing.assert_allclose(correlation(samples, cameras, [regions[0], empty]), alone)


class TestAngles:
    def test_straight_arm_is_not_turned_about_itself(self, skeleton):
        """Its rotation is the smallest one from the old direction of the arm to the new one."""
        limb, last = skeleton.limbs["left_arm"], np.array([0.2, 0.4, 0.5, 0.0])
        q = np.zeros(len(skeleton.lower))
        q[limb.positions] = last
        root, R_WT = skeleton.limb_points(q, "left_arm")[0], skeleton.trunk_pose(q)[0]
        across = np.array([0.0, 0.7, -0.2])
        middle = root + across * limb.lengths[0] / sum(limb.lengths)
        found = limb_angles(limb, R_WT, root, middle[None], root + across, last)[0][0]
        axes = "".join("XYZ"[axis] for axis in limb.axes[:3])
        before, after = Rotation.from_euler(axes, [last[:3], found[:3]])
        old = R_WT @ before.apply(limb.middle_U)
        needed = np.arccos(old @ across / np.linalg.norm(old) / np.linalg.norm(across))
        assert (before.inv() * after).magnitude() < needed + 0.1


@pytest.fixture(scope="module")
def seen(person):
    """Cameras, and a function that returns their regions of a pose."""
    cameras = circle_of_cameras(8, size=(320, 240), face_camera=False)

    def seen(q):
        return list(cameras.values()), list(see(person, cameras, q[None])[0].values())

    return seen


class TestPose:
    def test_waist_is_below_the_head_by_the_formula(self, person, skeleton, seen):
        q = posed(person, left_thigh_x=-20, left_shin_x=30, right_shin_x=10)
        features, head = skeleton.features(q), q[skeleton.head_angles]
        feet = features[3:, 2]
        formula = [*features[0, :2], 0.55 * features[0, 2] + 0.225 * feet[0] + 0.225 * feet[1]]
        _, limbs = estimate_pose(skeleton, q, features, head, *seen(q), search=False)
        hips = 0.5 * (limbs["left_leg"][0] + limbs["right_leg"][0])
        np.testing.assert_allclose(hips, formula, atol=1e-9)

    def test_search_finds_elbows_that_inverse_kinematics_misses(self, person, skeleton, seen):
        true = posed(
            person, left_upper_arm_z=75, left_upper_arm_y=-20, left_forearm_x=-85,
            right_upper_arm_z=-75, right_upper_arm_y=20, right_forearm_x=-85,
        )  # fmt: skip
        last = posed(person, left_upper_arm_z=15, right_upper_arm_z=-15)
        features, head, views = skeleton.features(true), true[skeleton.head_angles], seen(true)
        errors = []
        for search in (True, False):
            _, limbs = estimate_pose(skeleton, last, features, head, *views, search=search)
            true_limbs = {name: skeleton.limb_points(true, name) for name in LIMBS[:2]}
            off = [limbs[name][1] - points[1] for name, points in true_limbs.items()]
            errors.append(np.linalg.norm(off, axis=1).max())
        assert errors[0] < min(0.07, 0.6 * errors[1])

    @pytest.mark.parametrize("name", LIMBS)
    def test_limb_angles_reproduce_the_joints_inside_the_limits(self, skeleton, name):
        """By the limb's kinematics anywhere on the circle; inside the limits at the true place."""
        generator = np.random.default_rng(5)
        limb = skeleton.limbs[name]
        for _ in range(20):
            q = drawn_pose(skeleton, generator)
            root, middle, end = skeleton.limb_points(q, name)
            R_WT, _ = skeleton.trunk_pose(q)
            across = (end - root) / np.linalg.norm(end - root)
            turns = Rotation.from_rotvec(np.linspace(0.0, 5.0, 6)[:, None] * across)
            middles = root + turns.apply(middle - root)
            angles, beyond = limb_angles(limb, R_WT, root, middles, end, q[limb.positions])
            assert beyond[0] < 1e-6
            excess = np.abs(angles - np.clip(angles, limb.lower, limb.upper)).max(axis=1)
            np.testing.assert_allclose(beyond, excess, atol=1e-6)
            for place, found in zip(middles, angles, strict=True):
                turned = np.array(q)
                turned[limb.positions] = found
                points = skeleton.limb_points(turned, name)
                np.testing.assert_allclose(points, [root, place, end], atol=1e-6)

    def test_positions_satisfy_the_limits(self, person, skeleton, seen):
        generator = np.random.default_rng(7)
        true = posed(person, left_upper_arm_z=40)
        views = seen(true)
        for _ in range(5):
            features = skeleton.features(true) + generator.normal(0, 0.3, (5, 3))
            found, _ = estimate_pose(skeleton, true, features, generator.normal(0, 2, 2), *views)
            np.testing.assert_array_equal(found, skeleton.clip(found))
