import math

import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.systems.framework import DiagramBuilder

from drake_pose.body import bundled_model, load_model
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.person.date.walking import WALK
from drake_pose.systems.person import (
    Walker,
    add_garden,
    garden_obstacles,
    view_from_behind,
    walker_transform,
)
from tests.person.persons_in_view import posed
from tests.systems.bench import Bench

PERIOD = 1 / 30
# Lift of the thigh during three steps [rad], left positive.
SPOT = [0.8 * math.sin(math.pi * k / 8) for k in range(1, 24)]


def standing(person, x=0.0, head_deg=0.0, **degrees):
    return posed(person, x, head_y=head_deg, **degrees)


def run(person, stances):
    """Return the walker's pose and the command after each stance of 1 s."""
    walker, found = Bench(Walker(person, PERIOD)), []
    for k, q in enumerate(stances):
        walker.advance(k + 1 - 0.5 * PERIOD, positions=q)
        found.append([walker["walker_pose"], walker["command"]])
    return found


def test_on_spot_requires_steps_for_a_command(person):
    """Neither standing ahead nor steps at the rest position alone are a command."""
    walker = Bench(Walker(person, PERIOD, on_spot=True))
    frames = [(0.0, 0.0), *[(0.3, 0.0)] * 20, *[(0.3, s) for s in SPOT], *[(0.0, s) for s in SPOT]]
    found = []
    for k, (ahead, lifted) in enumerate(frames):
        side, bend = "left" if lifted > 0 else "right", math.degrees(abs(lifted))
        lift = {f"{side}_thigh_x": -bend, f"{side}_shin_x": 2 * bend}
        walker.advance((k + 0.5) * PERIOD, positions=standing(person, ahead, **lift))
        found.append(walker["command"][1])
    assert not any(found[:21])
    assert found[20 + len(SPOT)] == 1
    assert found[-1] == 0


def test_gestures_walk_and_turn(person):
    lost = np.full(len(person.position_names), np.nan)
    seen = [standing(person, *one) for one in ((0.1,), (0.4,), (0.1, 40.0), (-0.2,))]
    stances = [*seen[:3], lost, seen[3]]
    found = run(person, stances)
    assert [tuple(command) for _, command in found] == [(0, 0), (0, 1), (1, 0), (0, 0), (0, -1)]
    ways = np.diff([pose for pose, _ in found], axis=0)
    np.testing.assert_allclose(ways[0], [WALK.speed, 0.0, 0.0], atol=0.05)
    np.testing.assert_allclose(ways[1], [0.0, 0.0, WALK.turn_rate], atol=0.05)
    np.testing.assert_allclose(ways[2], 0.0, atol=0.05)
    heading = found[2][0][2]
    back = -WALK.speed * np.array([math.cos(heading), math.sin(heading), 0.0])
    np.testing.assert_allclose(ways[3], back, atol=0.06)


def test_a_corrected_face_direction_turns_the_rest_stance(person):
    """There is no command to turn, and ahead is where the person faces now."""
    stances = [standing(person, 0.0, 179.0), standing(person), standing(person, 0.4)]
    found = run(person, stances)
    assert [tuple(command) for _, command in found] == [(0, 0), (0, 0), (0, 1)]


def test_a_person_at_rest_is_shown_at_the_walkers_pose():
    pose, rest = np.array([3.0, -2.0, 1.1]), np.array([0.4, 9.0, 9.0, 0.5, 0.7])
    X_PR = walker_transform(pose, rest)
    np.testing.assert_allclose(X_PR.multiply([0.5, 0.7, 0.0]), [3.0, -2.0, 0.0], atol=1e-12)
    ahead = X_PR.multiply([0.5 + math.cos(0.4), 0.7 + math.sin(0.4), 0.0])
    np.testing.assert_allclose(ahead, [3.0 + math.cos(1.1), -2.0 + math.sin(1.1), 0.0], atol=1e-12)


@pytest.fixture(scope="module")
def garden():
    """Shape and position of each drawn object in the garden, by name."""
    inspector = add_garden(DiagramBuilder()).model_inspector()
    return {
        inspector.GetName(one).rpartition("::")[2]: (
            inspector.GetShape(one),
            inspector.GetPoseInFrame(one).translation(),
        )
        for one in inspector.GetAllGeometryIds(Role.kPerception)
    }


def test_obstacles_equal_the_drawn_objects_and_the_start_is_free(garden):
    obstacles = garden_obstacles()
    assert len(obstacles) == 20
    assert np.abs(obstacles[:, :2]).max() < WALK.half_size
    distance = np.linalg.norm(obstacles[:, :2] - WALK.start[:2], axis=1) - obstacles[:, 2]
    assert distance.min() > 2 * WALK.body_radius
    for name, radius in (("trunk_3", 0.18), ("ball_1", 0.5), ("basin", 1.3), ("gate_0_left", 0.15)):
        _, place = garden[name]
        assert [*place[:2], radius] in obstacles.tolist()


def test_the_view_is_from_behind_and_above_inside_the_walls():
    ranges = WALK.half_size, WALK.half_size, math.pi
    for x, y, heading in np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3)) * ranges:
        eye, target = view_from_behind(np.array([x, y, heading]))
        assert np.abs(eye[:2]).max() < WALK.half_size
        assert eye[2] > target[2] > 0.5
        forward, ground = np.array([math.cos(heading), math.sin(heading)]), np.array([x, y])
        ahead = target[:2] - ground
        np.testing.assert_allclose(ahead, np.linalg.norm(ahead) * forward, atol=1e-12)
        back = ground - eye[:2]
        if np.abs([ground, ground - 4.0 * forward]).max() < WALK.half_size - 0.5:
            np.testing.assert_allclose(back, np.linalg.norm(back) * forward, atol=1e-12)
            assert 2.0 < np.linalg.norm(back) < 4.0


def test_invalid_periods_and_bodies_are_refused(person):
    with pytest.raises(SettingsError, match="period"):
        Walker(person, 0.0)
    arm = load_model(bundled_model("hand"), check=False)
    with pytest.raises(UnknownNameError, match="head"):
        Walker(arm, PERIOD)
