"""Limbs of a person's pose tree, likelihoods of fits, and poses that look alike."""

import numpy as np
import pytest
from scipy.stats import qmc

from drake_pose.arrays import halton_sequence
from drake_pose.body import bundled_model, load_model
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.fit.kernel import Sum
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.search import crowding_weights
from drake_pose.person.views import FrameViews, see_silhouette
from tests.person.persons_in_view import SIDES, posed, see
from tests.person.test_pose_tracker import WALKING, joint_error


@pytest.fixture(scope="module")
def tracker(person):
    return PersonPoseTracker(ContourFit(person.pose_tree()))


def test_limb_values_move_the_limb_only_and_satisfy_the_limits(tracker):
    plan, rng = tracker.plan, np.random.default_rng(0)
    kinematics = plan.kinematics
    rest = kinematics.flatten(kinematics.tree.default_values())
    places = plan.landmarks.positions(kinematics.poses(rest))
    for name, limb in plan.limbs.items():
        side, kind = name.split("_")
        upper, lower = ("upper_arm", "forearm") if kind == "arm" else ("thigh", "shin")
        moved = np.array(kinematics.names)[limb.values].tolist()
        assert set(moved) == {*(f"{side}_{upper}_{a}" for a in "xyz"), f"{side}_{lower}_x"}
        stretched = limb.poses[:, moved.index(f"{side}_{lower}_x")] == 0.0
        assert stretched.mean() == pytest.approx(0.125, abs=0.005)
        np.testing.assert_array_equal(limb.poses[0], rest[limb.values])
        assert (limb.poses >= kinematics.lower[limb.values]).all()
        assert (limb.poses <= kinematics.upper[limb.values]).all()
        spread = np.ptp(limb.poses, axis=0) / (kinematics.upper - kinematics.lower)[limb.values]
        assert (spread > 0.95).all()
        assert not plan.is_posture[limb.values].any()
        # Points from the root over the middle joint to the end and beyond, at poses of the plan.
        for k in rng.integers(0, len(limb.poses), 4):
            values = rest.copy()
            values[limb.values] = limb.poses[k]
            X_WN = kinematics.poses(values)
            R_WB, root = plan.frame(limb, X_WN)
            points = plan.samples(limb, X_WN)
            np.testing.assert_allclose(limb.samples_B[k] @ R_WB.T + root, points, atol=1e-9)
            a, b, c = plan.landmarks.positions(X_WN)[limb.joints]
            np.testing.assert_allclose(root, places[limb.joints[0]], atol=1e-12)
            expected = [a + s * (b - a) if s < 1 else b + (s - 1) * (c - b) for s in plan.along]
            np.testing.assert_allclose(points, expected, atol=1e-12)
    assert kinematics.names[plan.heading] == "head_y"
    tilting = {kinematics.names[k] for k in np.flatnonzero(plan.tilts)}
    assert tilting == {"head_x", "neck_base_x", "neck_base_z"}


def test_crowded_points_have_smaller_weights():
    samples = np.zeros((1, 3, 3))
    samples[0, 1, 0], samples[0, 2, 0] = 0.079, 1.0
    np.testing.assert_allclose(crowding_weights(samples), [[1 / 6, 1 / 6, 1 / 3]])
    samples[0, 1, 0] = 0.081
    np.testing.assert_allclose(crowding_weights(samples), [[1 / 3, 1 / 3, 1 / 3]])


def test_misfit_is_the_cost_over_what_noise_gives(tracker):
    """Independent errors at intervals of the correlation length: chi-squared over its mean."""
    sums = np.zeros((2, 6))
    sums[:, Sum.COMPARED], sums[:, Sum.COST] = (40.0, 0.0), (30.0, 5.0)
    misfit, deviation = tracker.search.misfit(sums)
    count = 20.0 / np.mean(tracker.fit.noise.correlation)
    np.testing.assert_allclose(misfit, [30.0 / count, 5.0])
    np.testing.assert_allclose(deviation, np.sqrt([2.0 / count, 2.0]))


def test_similar_poses_exchange_limbs_or_turn_about(tracker, person):
    """A limb lies as near to where the other one was as any of its poses, by brute force."""
    plan, rng = tracker.plan, np.random.default_rng(0)
    poses_of = tracker.fit.kinematics.poses
    values = tracker.values(posed(person, **WALKING, head_x=10.0, neck_base_x=15.0))
    X_WN = poses_of(values)
    found = tracker.search.similar_poses(values)
    for other, kinds in zip(found, (("arm",), ("leg",), ("arm", "leg")), strict=True):
        for side, far in (SIDES, SIDES[::-1]):
            for kind in kinds:
                limb, there = plan.limbs[f"{side}_{kind}"], plan.limbs[f"{far}_{kind}"]
                points = plan.samples(there, X_WN)

                def distance(at, limb=limb, points=points):
                    away = plan.samples(limb, poses_of(at)) - points
                    return np.linalg.norm(away, axis=1).max()

                tried = np.tile(other, (100, 1))
                tried[:, limb.values] = limb.poses[rng.choice(len(limb.poses), 100)]
                assert distance(other) <= min(map(distance, tried)) + 1e-9
        same = np.ones(len(values), dtype=bool)
        for name, limb in plan.limbs.items():
            same[limb.values] = not name.endswith(kinds)
        if len(kinds) == 1:
            np.testing.assert_array_equal(other[same], values[same])
    # Turned about its own axis, the leaning trunk leans to its other side.
    turned = found[2]
    middles = [tracker.trunk_middle(one) for one in (turned, values)]
    np.testing.assert_allclose(*middles, atol=1e-9)
    assert turned[plan.heading] == pytest.approx(values[plan.heading] + np.pi)
    np.testing.assert_array_equal(turned[plan.tilts], -values[plan.tilts])


def test_better_fits_have_the_advantage_and_look_alikes_are_one(tracker, person):
    ring = circle_of_cameras(3, size=(160, 120), face_camera=False)
    q = posed(person, **WALKING)
    views = [see_silhouette(mask, 2.0) for mask in see(person, ring, [q])[0].values()]
    frame, search = FrameViews(list(ring.values()), views), tracker.search
    good = search.refine(tracker.values(q), frame)
    bad = search.refine(tracker.values(posed(person, left_upper_arm_z=100.0)), frame)
    assert joint_error(tracker, good.values, q) < 40.0
    assert search.distinct([bad, good])[0] is good
    better = search.advantage(good, bad, frame)
    assert better == pytest.approx(-search.advantage(bad, good, frame))
    assert better > 1.0
    assert search.advantage(good, bad, frame, good.values) > better
    assert search.advantage(good, bad, frame, bad.values) < better
    assert len(search.distinct([good, good])) == 1
    empty = see_silhouette(np.zeros((120, 160), dtype=bool), 2.0)
    assert search.find_starts(FrameViews(list(ring.values()), [empty, empty, views[2]])) == []


def test_model_without_landmarks_is_refused():
    hand = load_model(bundled_model("two_finger_hand"), check=False)
    with pytest.raises(ModelError, match="landmarks"):
        PersonPoseTracker(ContourFit(hand.pose_tree()))


def test_haltons_sequence_is_scipys():
    expected = qmc.Halton(9, scramble=False).random(300)
    np.testing.assert_allclose(halton_sequence(300, 9), expected, rtol=0, atol=1e-15)
