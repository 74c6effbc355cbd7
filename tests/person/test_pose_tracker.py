from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import qmc

from drake_pose.arrays import halton_sequence
from drake_pose.body import bundled_model, load_model
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.person.date.walking import make_motion
from drake_pose.person.pose_tracker import NOISE, PersonPoseTracker
from drake_pose.person.search import LENIENT, crowding_weights
from drake_pose.person.views import FrameViews, see_silhouette
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.person.persons_in_view import posed, see


class World:
    def __init__(self, person):
        self.person, self.ring = person, circle_of_cameras(5, size=(320, 240), face_camera=False)
        self.cameras = list(self.ring.values())
        self.tracker = PersonPoseTracker(ContourFit(person.pose_tree()))

    def pose(self, **degrees):
        return posed(self.person, **degrees)

    def frame(self, q, left_out=0):
        """The views of all cameras but the first `left_out`."""
        views = [see_silhouette(mask, 4.0) for mask in see(self.person, self.ring, [q])[0].values()]
        return FrameViews(self.cameras[left_out:], views[left_out:])

    def follow(self, belief, frame):
        return self.tracker.update(self.tracker.predict(belief), frame)

    def off(self, values, q):
        """The largest error of a joint centre [mm]."""
        return joint_error(self.tracker, values, q)


def joint_error(tracker, values, q):
    """The largest distance of joint centres at values and at positions [mm]."""
    places = [
        tracker.plan.landmarks.positions(tracker.fit.kinematics.poses(v))
        for v in (values, tracker.values(q))
    ]
    return 1e3 * np.linalg.norm(places[0] - places[1], axis=1).max()


@pytest.fixture(scope="module")
def world(person):
    return World(person)


WALKING = {
    "left_upper_arm_x": 25.0, "right_upper_arm_x": -25.0, "left_forearm_x": -25.0,
    "right_forearm_x": -25.0, "left_thigh_x": -25.0, "right_thigh_x": 20.0, "left_shin_x": 10.0,
    "right_shin_x": 35.0, "left_upper_arm_z": 10.0, "right_upper_arm_z": -10.0,
}  # fmt: skip


class TestTracker:
    def test_positions_and_values_are_inverse(self, world):
        q = world.pose(**WALKING, head_y=120)
        np.testing.assert_allclose(world.tracker.positions(world.tracker.values(q)), q, atol=1e-12)
        turned = world.tracker.values(q)
        turned[world.tracker.plan.heading] += 2 * np.pi
        np.testing.assert_allclose(world.tracker.positions(turned), q, atol=1e-12)

    def test_person_is_found_and_tracked_although_a_camera_drops_out(self, world):
        q = world.pose(**WALKING)
        state = world.tracker.update(None, world.frame(q))
        assert world.off(state.values, q) < 40.0
        for k in range(1, 6):
            q = world.pose(**{name: (1 - 0.2 * k) * a for name, a in WALKING.items()}, head_y=5 * k)
            state = world.follow(state, world.frame(q, left_out=int(k >= 3)))
            assert world.off(state.values, q) < 30.0, k

    @pytest.mark.parametrize("frame", [30, 54], ids=["legs exchanged", "turned about"])
    def test_similar_pose_is_not_chosen(self, person, frame):
        """Walking before nine cameras, where another pose fits nearly as well."""
        q = make_motion(load_skeleton(person), 120, 0).q[frame]
        ring = circle_of_cameras(9, face_camera=False)
        masks = [LabelRenderer(person, camera).mask(q) for camera in ring.values()]
        tracker = PersonPoseTracker(ContourFit(person.pose_tree(), noise=NOISE), LENIENT)
        seen = FrameViews([*ring.values()], [see_silhouette(mask, 4.0) for mask in masks])
        assert joint_error(tracker, tracker.update(None, seen).values, q) < 30.0

    def test_perturbed_track_recovers_without_a_registered_pose(self, world):
        q = world.pose(**WALKING, head_y=-70)
        state, fit = world.tracker.start(world.tracker.values(q)), world.tracker.fit
        wrong = state.values + np.random.default_rng(5).normal(0.0, 0.7, len(state.values))
        state, frame = replace(state, values=np.clip(wrong, fit.lower, fit.upper)), world.frame(q)
        for _ in range(15):
            state = world.follow(state, frame)
        assert world.off(state.values, q) < 25.0

    def test_stretched_arms_are_not_bent_the_wrong_way(self, world):
        # A stretched arm, slightly bent backwards and twisted, has almost the same silhouette.
        q = world.pose(left_upper_arm_z=80.0, right_upper_arm_z=-80.0)
        state = world.tracker.update(None, world.frame(q))
        assert world.off(state.values, q) < 25.0

    def test_lost_arm_is_searched_again(self, world):
        lifted = world.pose(**{**WALKING, "left_upper_arm_z": 110.0, "left_forearm_x": -20.0})
        state = world.tracker.start(world.tracker.values(world.pose(**WALKING)))
        frame = world.frame(lifted)
        for _ in range(4):
            state = world.follow(state, frame)
        assert world.off(state.values, lifted) < 25.0

    def test_empty_silhouettes(self, world):
        empty = see_silhouette(np.zeros((240, 320), dtype=bool), 4.0)
        frame = FrameViews(world.cameras, [empty] * len(world.cameras))
        assert world.tracker.update(None, frame) is None
        values = world.tracker.values(world.pose())
        state = world.follow(world.tracker.start(values), frame)
        assert state.inlier_ratio == 0.0
        np.testing.assert_allclose(state.values, values, atol=1e-6)

    def test_turned_about_start_is_judged_before_it_is_used(self, world):
        q = world.pose(**WALKING)
        turned = world.tracker.values(q)
        turned[world.tracker.plan.heading] += np.pi
        state, frame = world.tracker.start(turned), world.frame(q)
        assert state.is_lost
        state = world.follow(state, frame)
        assert (world.off(state.values, q) < 25.0, state.is_lost) == (True, False)

    @pytest.mark.parametrize("hidden", ["left", "bottom"])
    def test_person_is_found_again_within_two_frames_of_full_view(self, world, hidden):
        """Half of every silhouette is missing at first, as if it were not there."""
        q = world.pose(**WALKING)
        masks = see(world.person, world.ring, [q])[0].values()
        halves = []
        for mask in masks:
            middle = int(np.flatnonzero(mask.any(axis=0 if hidden == "left" else 1)).mean())
            half = mask.copy()
            half[:, :middle] &= hidden != "left"
            half[middle:] &= hidden != "bottom"
            halves.append(see_silhouette(half, 4.0))
        state, frame = None, FrameViews(world.cameras, halves)
        for _ in range(5):
            state = world.follow(state, frame) if state else world.tracker.update(None, frame)
        for _ in range(2):
            state = world.follow(state, world.frame(q))
        assert (world.off(state.values, q) < 25.0, state.is_lost) == (True, False)

    def test_motion_fades_away(self, world):
        start = world.tracker.start(world.tracker.values(world.pose()))
        moving = replace(start, step=np.ones(len(start.values)))
        moved = [world.tracker.predict(moving, n).values[0] for n in (1.0, 2.0, 50.0)]
        assert 0.5 < moved[0] < moved[1] < moved[2] < 2.0
        twice = world.tracker.predict(world.tracker.predict(moving))
        np.testing.assert_allclose(twice.values[0], moved[1])


class TestPlan:
    def test_limb_values_move_the_limb_only_and_satisfy_the_limits(self, world):
        plan = world.tracker.plan
        for name, limb in plan.limbs.items():
            side, kind = name.split("_")
            upper, lower = ("upper_arm", "forearm") if kind == "arm" else ("thigh", "shin")
            moved = np.array(plan.kinematics.names)[limb.values].tolist()
            assert set(moved) == {*(f"{side}_{upper}_{a}" for a in "xyz"), f"{side}_{lower}_x"}
            stretched = limb.poses[:, moved.index(f"{side}_{lower}_x")] == 0.0
            assert 0.1 < stretched.mean() < 0.2
            assert (limb.poses >= plan.kinematics.lower[limb.values]).all()
            assert (limb.poses <= plan.kinematics.upper[limb.values]).all()

    def test_crowded_points_have_smaller_weights(self):
        samples = np.zeros((1, 3, 3))
        samples[0, 2, 0] = 1.0
        np.testing.assert_allclose(crowding_weights(samples), [[1 / 6, 1 / 6, 1 / 3]])

    def test_model_without_landmarks_is_refused(self):
        hand = load_model(bundled_model("two_finger_hand"), check=False)
        with pytest.raises(ModelError, match="landmarks"):
            PersonPoseTracker(ContourFit(hand.pose_tree()))


@pytest.mark.slow
def test_stills_of_a_motion_are_not_mistaken_for_similar_poses(person):
    """In one of thirty stills a wrong pose has an inlier ratio of 97 %."""
    cameras = list(circle_of_cameras(3, size=(640, 480)).values())
    renderers = [LabelRenderer(person, camera) for camera in cameras]
    fit = ContourFit(person.pose_tree(), noise=NOISE)
    tracker = PersonPoseTracker(fit, LENIENT)
    for q in make_motion(load_skeleton(person), 240, 0).q[::8]:
        views = [see_silhouette(renderer.mask(q), 4.0) for renderer in renderers]
        found = tracker.update(None, FrameViews(cameras, views))
        assert joint_error(tracker, found.values, q) < 60.0


def test_haltons_sequence_is_scipys():
    expected = qmc.Halton(9, scramble=False).random(300)
    np.testing.assert_allclose(halton_sequence(300, 9), expected, rtol=0, atol=1e-15)
