"""The skeleton of a person's model, against Drake."""

import numpy as np
import pytest

from drake_pose.body import bundled_model, landmark_positions, load_landmarks, load_model
from drake_pose.errors import ModelError
from drake_pose.person.date.skeleton import FEATURES, LIMBS, load_skeleton, registered_positions
from tests.body.models import link_poses


def drawn_pose(skeleton, generator, share=0.5):
    """Random positions within the middle `share` of the limits."""
    middle = 0.5 * (skeleton.lower + skeleton.upper)
    q = middle + share * generator.uniform(-0.5, 0.5, len(middle)) * (
        skeleton.upper - skeleton.lower
    )
    q[skeleton.head_positions] = generator.uniform([-1, -1, 1.4], [1, 1, 1.7])
    return q


def test_limb_points_match_drake_and_ends_are_inside_hands_and_feet(person, skeleton):
    generator, landmarks = np.random.default_rng(0), load_landmarks(person.path)
    for _ in range(5):
        q = drawn_pose(skeleton, generator, 1.0)
        true = dict(zip(landmarks, landmark_positions(person, landmarks, q), strict=True))
        np.testing.assert_allclose(skeleton.trunk_pose(q)[1], true["neck"], atol=1e-12)
        np.testing.assert_allclose(skeleton.head_rotation(q), link_poses(person, q)["head"][:3, :3])
        hips = 0.5 * (true["left_hip"] + true["right_hip"])
        R_WT, neck = skeleton.trunk_pose(q)
        np.testing.assert_allclose(R_WT @ skeleton.waist_T + neck, hips, atol=1e-12)
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


def test_registered_arms_are_spread_and_limbs_have_their_lengths(person, skeleton):
    q = registered_positions(skeleton, 30.0)
    arms = [person.position_index(f"{side}_upper_arm_z") for side in ("left", "right")]
    np.testing.assert_allclose(np.degrees(q[arms]), [30.0, -30.0])
    assert np.count_nonzero(q) == 2
    for name, limb in skeleton.limbs.items():
        points = skeleton.limb_points(q, name)
        np.testing.assert_allclose(limb.lengths, np.linalg.norm(np.diff(points, axis=0), axis=1))
        assert limb.side * points[0][1] > 0.05
        assert ((0.03 < limb.half_widths) & (limb.half_widths < 0.1)).all()


def test_other_models_are_refused():
    with pytest.raises(ModelError, match="trunk"):
        load_skeleton(load_model(bundled_model("man"), check=False))


def test_measured_features_change_the_skeleton_by_a_bounded_distance(studio):
    skeleton = studio.skeleton
    q = studio.posed(left_forearm_x=-40, head_y=30)
    places = skeleton.features(q) + np.array([0.01, 0.0, 0.02])
    places[3] = np.nan
    places[4] += [0.0, 3.0, 0.0]
    other = skeleton.with_features(q, places)
    moved = other.features(q)
    np.testing.assert_allclose(moved[:3], places[:3], atol=1e-12)
    np.testing.assert_allclose(moved[3], skeleton.features(q)[3], atol=1e-12)
    assert np.linalg.norm(moved[4] - skeleton.features(q)[4]) == pytest.approx(0.05)
    assert other.limbs["left_arm"].lengths != skeleton.limbs["left_arm"].lengths
