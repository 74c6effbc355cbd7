"""Gestures, their commands, and motions made of key poses."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.errors import SettingsError
from drake_pose.person.date import walking
from drake_pose.person.date.skeleton import registered_positions


def stance(heading_deg=0.0, ahead=0.0, left=0.0, feet_ahead=None, nod_deg=0.0):
    """Stance of a person whose rest is at (1, 2), facing +y: ahead is +y, left is -x."""
    R = Rotation.from_euler("ZY", [heading_deg + 90.0, nod_deg], degrees=True).as_matrix()
    feet = ahead if feet_ahead is None else feet_ahead
    head_W = np.array([1.0 - left, 2.0 + ahead, 1.6])
    feet_W = np.array([[0.9 - left, 2.1 + feet, 0.05], [1.1 - left, 1.9 + feet, 0.05]])
    return walking.stance_of(R[:, 1], head_W, feet_W)


REST = stance()


def commands(stances, rest=REST):
    last, found = (0, 0), []
    for one in stances:
        last = walking.recognise_command(one, rest, last)
        found.append(last)
    return found


def test_gestures_give_table_1s_commands():
    turns = [stance(), stance(40.0), stance(), stance(-40.0, nod_deg=40.0), stance(nod_deg=90.0)]
    walks = [stance(ahead=0.3), stance(), stance(ahead=-0.3)]
    found = commands([*turns, *walks, stance(-40.0, ahead=0.3), stance()])
    turn = [0, 1, 0, -1, 0, 0, 0, 0, -1, 0]
    walk = [0, 0, 0, 0, 0, 1, 0, -1, 1, 0]
    assert found == list(zip(turn, walk, strict=True))


def test_made_gestures_are_recognised(skeleton):
    """Each gesture gives its command, and walking gestures step on the spot."""
    motion = walking.make_gestures(skeleton, 20)
    features = np.array([skeleton.features(q) for q in motion.q])
    stances = [
        walking.stance_of(skeleton.head_rotation(q)[:, 0], head, feet)
        for q, head, feet in zip(motion.q, features[:, 0], features[:, 3:], strict=True)
    ]
    told, names = commands(stances, stances[23]), np.array(motion.names)
    assert list(dict.fromkeys(motion.names)) == [walking.REGISTERED, *walking.COMMANDS]
    asked = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]
    for name, command in zip([walking.REGISTERED, *walking.COMMANDS], asked, strict=True):
        rows = np.flatnonzero(names == name)
        assert len(rows) == (24 if name == walking.REGISTERED else 20)
        assert told[rows[len(rows) // 2]] == command
        lifted = np.ptp(features[rows, 3:, 2], axis=0)
        assert ((lifted > 0.1) == name.startswith("walk")).all()
        assert told[rows[-1]] == (0, 0)
    # One foot stands while the other is lifted.
    np.testing.assert_allclose(features[:, 3:, 2].min(axis=1), features[23, 3, 2], atol=0.03)


def spot_walk(lifts, seconds=0.1):
    steps, found = np.zeros(3), []
    for lift in lifts:
        steps = walking.count_steps(lift, steps, seconds)
        found.append(bool(steps[2] >= 2.0))
    return found


def test_alternating_feet_are_walking_on_the_spot():
    step = np.array([0.0, 0.1, 0.1, 0.0])
    assert spot_walk([*step, *-step, *step]) == [False] * 5 + [True] * 7
    # Walking ends `pause` after the last step.
    found = spot_walk([*step, *-step, *([0.0] * 12)])
    assert found[5:14] == [True] * 9
    assert not any(found[16:])


def test_other_lifts_are_not_walking_on_the_spot():
    for lifts in (
        [0.2] * 30,  # One foot held up.
        [0.1, 0.0] * 15,  # The same foot.
        np.random.default_rng(0).normal(0.0, 0.01, 60),
        ([0.1] + [0.0] * 12 + [-0.1] + [0.0] * 12) * 3,  # Too slow.
        [math.nan] * 10,
    ):
        assert not any(spot_walk(lifts))


def test_command_has_hysteresis():
    degrees = [20.0, 26.0, 20.0, 16.0, 14.0, 20.0, -24.0, -26.0, -16.0, 16.0]
    assert [c[0] for c in commands(stance(d) for d in degrees)] == [0, 1, 1, 1, 0, 0, 0, -1, -1, 0]
    metres = [0.15, 0.2, 0.12, 0.09, 0.15, -0.2, -0.12, 0.12, 0.3]
    found = [c[1] for c in commands(stance(ahead=m) for m in metres)]
    assert found == [0, 1, 1, 0, 0, -1, -1, 0, 1]


def test_leaning_stepping_aside_or_being_lost_stops():
    for head, feet in ((0.4, 0.0), (0.0, -0.4), (0.3, -0.3)):
        assert commands([stance(ahead=head, feet_ahead=feet)]) == [(0, 0)]
    assert commands([stance(ahead=0.4), np.full(5, np.nan)]) == [(0, 1), (0, 0)]
    # Facing backwards is a turn, however the angle wraps.
    assert commands([stance(175.0)]) + commands([stance(-175.0, left=0.5)]) == [(1, 0), (-1, 0)]


@pytest.mark.parametrize("command", [(1, 1), (-1, 1), (0, -1), (1, -1), (1, 0)])
def test_path_equals_that_of_many_small_steps(command):
    pose, count = np.array([0.3, -0.2, 0.7]), 20_000
    small, step = pose.copy(), 1.5 / count
    for _ in range(count):
        ahead = np.array([math.cos(small[2]), math.sin(small[2])])
        small[:2] += command[1] * walking.WALK.speed * step * ahead
        small[2] += command[0] * walking.WALK.turn_rate * step
    found = walking.apply_command(pose, command, 1.5, np.empty((0, 3)))
    np.testing.assert_allclose(found, small, atol=1e-4)


def test_walls_and_obstacles_are_not_walked_through():
    pose, obstacles = np.array([-4.0, 0.05, 0.0]), np.array([[0.0, 0.0, 0.5]])
    nearest = math.inf
    for _ in range(700):
        pose = walking.apply_command(pose, (0, 1), 1 / 30, obstacles)
        nearest = min(nearest, float(np.hypot(*pose[:2])))
    assert nearest == pytest.approx(0.5 + walking.WALK.body_radius, abs=1e-9)
    assert pose[0] == pytest.approx(walking.WALK.half_size - walking.WALK.body_radius)


def test_motions_pass_through_their_key_poses_on_the_floor(person, skeleton):
    """All motions in turn, between registered poses."""
    motion = walking.make_motion(skeleton, 240, 3)
    names, index = np.array(motion.names), skeleton.model.position_index
    assert list(dict.fromkeys(motion.names)) == [walking.REGISTERED, *walking.MOTIONS]
    assert motion.names[:12] == motion.names[-12:] == (walking.REGISTERED,) * 12
    assert motion.names[12] != walking.REGISTERED != motion.names[-13]
    free = np.ones(len(skeleton.lower), dtype=bool)
    free[skeleton.head_positions] = False
    for row in (0, -1):
        expected = registered_positions(skeleton)[free]
        np.testing.assert_allclose(motion.q[row][free], expected, atol=1e-12)
    for name, poses in walking.MOTIONS.items():
        rows = np.flatnonzero(names == name)
        assert len(rows) == pytest.approx(216 * (len(poses) + 1) / 16, abs=1.0)
        # Each key pose is reached, times a size of 0.85 to 1.15, within the limits.
        for k, pose in enumerate(poses, 1):
            row = motion.q[rows[round(len(rows) * k / (len(poses) + 1)) - 1]]
            for joint, degrees in pose.items():
                low, high = (person.lower[index(joint)], person.upper[index(joint)])
                ends = np.clip(np.radians(degrees) * np.array([0.8, 1.2]), low, high)
                assert min(ends) - 0.1 <= row[index(joint)] <= max(ends) + 0.1, (name, joint)
    # The time between key poses is the same, and joints are slow at each.
    steps = np.abs(np.diff(motion.q[names == "turn"][:, index("head_y")]))
    assert steps[0] < 0.5 * steps.max() > 2.0 * steps[-1]
    feet = np.array([skeleton.features(q)[3:, 2].min() for q in motion.q])
    np.testing.assert_allclose(feet, 0.04, atol=1e-9)
    places = motion.q[:, skeleton.head_positions[:2]]
    reach = np.ptp(places, axis=0)
    np.testing.assert_allclose(reach, 0.4, atol=0.01)
    assert np.abs(places.mean(axis=0)).max() < 0.11
    assert (motion.q >= skeleton.lower - 1e-12).all()
    whole, part = (
        walking.make_motion(skeleton, 120, 3),
        walking.make_motion(skeleton, walking.FEWEST_FRAMES, 3),
    )
    np.testing.assert_array_equal(part.q, whole.q[: walking.FEWEST_FRAMES])
    with pytest.raises(SettingsError, match="40 frames"):
        walking.make_motion(skeleton, walking.FEWEST_FRAMES - 1, 0)
