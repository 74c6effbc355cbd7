"""Capture of a person from silhouettes, and the walker that follows commands."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.date.walking import WALK
from drake_pose.person.pose_tracker import PersonBelief, PersonPoseTracker
from drake_pose.person.views import FrameViews, edge_spacing, see_silhouette
from drake_pose.silhouette.segmentation import person_region
from drake_pose.systems.cameras import build_camera_rig, picture_to_colour_image
from drake_pose.systems.person import (
    PersonTracker,
    Walker,
    add_garden,
    build_silhouette_capture,
    garden_obstacles,
    view_from_behind,
    walker_transform,
)
from tests.person.persons_in_view import posed, see, stepping
from tests.systems.bench import Bench


@pytest.fixture(scope="module")
def cameras():
    return circle_of_cameras(4, size=(320, 240), face_camera=False)


@pytest.fixture(scope="module")
def tracker(person):
    return PersonPoseTracker(ContourFit(person.pose_tree()))


def views(cameras, masks):
    """Return the tracker's inputs from masks by camera; a camera may lack one."""
    seen = {name: see_silhouette(mask, edge_spacing(cameras[name])) for name, mask in masks.items()}
    return {f"silhouette_{name}": seen.get(name) for name in cameras}


def test_a_diagram_equals_the_plain_functions(studio):
    period = 1.0 / 32.0  # A power of two, so that all times between frames are exactly equal.
    cameras = dict(list(studio.ring.items())[::3])
    backgrounds = {name: studio.backgrounds[name] for name in cameras}
    tracker = PersonPoseTracker(ContourFit(studio.model.pose_tree()))
    path = [studio.posed(left_upper_arm_z=40.0 + 4.0 * k, right_thigh_x=-5.0 * k) for k in range(3)]
    capture = build_silhouette_capture(tracker, cameras, backgrounds, period)
    assert list(capture.stages) == ["region", "edge"]
    assert not capture.diagram.HasOutputPort("deviations")
    run, estimator = Bench(capture.diagram), capture.estimator
    own = estimator.GetMyMutableContextFromRoot(run.context)
    assert estimator.known_person(own) is None
    lost = replace(tracker.start(tracker.values(path[1])), inlier_ratio=0.1)
    estimator.set_person(own, lost)
    assert np.isnan(run["estimated_positions"]).all()
    assert estimator.known_person(own).inlier_ratio == 0.1
    state = tracker.start(tracker.values(path[0]), is_known=True)
    estimator.set_person(own, state)
    np.testing.assert_allclose(run["estimated_positions"], path[0])
    for k, q in enumerate(path):
        shots = {name: studio.picture(q, name) for name in cameras}
        images = {f"color_image_{n}": picture_to_colour_image(p) for n, p in shots.items()}
        run.advance((k + 0.5) * period, **images)
        for stage in capture.stages:
            capture.evaluate(run.context, stage)
        seen = [
            see_silhouette(person_region(shot, backgrounds[name]), edge_spacing(cameras[name]))
            for name, shot in shots.items()
        ]
        state = tracker.update(tracker.predict(state), FrameViews(list(cameras.values()), seen))
        positions = tracker.positions(state.values)
        np.testing.assert_array_equal(run["estimated_positions"], positions)
        known = estimator.known_person(own)
        for name in ("inlier_ratio", "usual_misfit", "troubled_frames", "step"):
            np.testing.assert_array_equal(getattr(known, name), getattr(state, name))
    elbow = studio.model.position_index("left_upper_arm_z")
    assert np.degrees(positions[elbow] - q[elbow]) == pytest.approx(0.0, abs=3.0)


def test_a_moving_person_is_tracked(person, cameras, tracker):
    start = posed(person, left_upper_arm_z=40, right_upper_arm_z=-40)
    end = posed(
        person, left_upper_arm_z=53, right_upper_arm_z=-40, left_thigh_x=-13, left_shin_x=13
    )
    path = PiecewisePolynomial.FirstOrderHold([0.0, 0.1], np.column_stack([start, end]))
    rig = build_camera_rig(person, cameras, path).diagram
    capture = build_silhouette_capture(tracker, cameras, {}, 1 / 30, source=rig)
    simulator = Simulator(capture.diagram)
    simulator.AdvanceTo(0.101)
    run = Bench(capture.diagram, simulator.get_context())
    assert run["inlier_ratio"][0] > 0.8
    off = run["estimated_positions"] - end
    np.testing.assert_allclose(off[:3], 0.0, atol=0.02)
    for name in ("left_upper_arm_z", "right_upper_arm_z", "left_thigh_x", "left_shin_x"):
        assert abs(off[person.position_index(name)]) < np.radians(4.0), name


@pytest.mark.slow
def test_a_lost_person_keeps_the_last_positions_and_is_found_again(person, cameras, tracker):
    run = Bench(PersonTracker(tracker, list(cameras.values()), 0.1))

    def show(x, time, blind=()):
        shown = {name: one for name, one in cameras.items() if name not in blind}
        masks = see(person, shown, [posed(person, x=x)])[0]
        run.advance(run.context.get_time() + 0.1, **views(cameras, masks), time=[time])
        return run["estimated_positions"], run["visible"].tolist()

    none = tuple(cameras)
    unknown, seen = show(0.0, np.nan, none)
    assert np.isnan([*unknown, *run["time"]]).all()
    assert (seen, run["inlier_ratio"]) == ([0, 0, 0, 0], [0.0])
    found, seen = show(0.0, 1.0)
    assert found[0] == pytest.approx(0.0, abs=0.02)
    assert run["inlier_ratio"] > 0.8
    assert seen == [1, 1, 1, 1]
    last = run["last_positions"]
    # Pictures with the same time stamp are not new.
    np.testing.assert_array_equal(show(0.0, 1.0, none)[0], found)
    lost, seen = show(0.0, 1.1, none)
    assert np.isnan(lost).all()
    np.testing.assert_array_equal(run["last_positions"], last)
    assert (seen, run["inlier_ratio"]) == ([0, 0, 0, 0], [0.0])
    # The person is back a step away, and one camera is covered: the search takes some frames.
    for time in (1.4, 1.5, 1.6, 1.7):
        found, seen = show(0.15, time, none[:1])
    assert found[0] == pytest.approx(0.15, abs=0.03)
    assert seen == [0, 1, 1, 1]


@pytest.fixture(scope="module")
def poses(person):
    return np.array([stepping(person, 0.25 * k, 0.02 * k - 0.2, 0.1) for k in range(12)])


@pytest.fixture(scope="module")
def alone(person, cameras, poses):
    return see(person, cameras, poses)


def watch(cameras, tracker, frames):
    """Return outputs (T, n) by port for masks (T,)."""
    run, found = Bench(PersonTracker(tracker, list(cameras.values()), 0.1, True)), []
    names = ("estimated_positions", "others", "deviations", "visible")
    for k, masks in enumerate(frames):
        run.advance(0.1 * k + 0.05, **views(cameras, masks), time=[0.1 * k])
        found.append([run[name] for name in names])
    return dict(zip(names, map(np.array, zip(*found, strict=True)), strict=True))


class Walking(PersonPoseTracker):
    """Finds the person one step further in each frame, and records the expected step."""

    def update(self, belief, seen):
        self.expected.append(belief.ahead)
        step = np.full(len(belief.values), 0.01)
        return PersonBelief(belief.values + step, step)


def test_motion_continues_through_skipped_frames(person, cameras, alone):
    """Pictures with the same time stamp, or NaN, are not new."""
    tracker = Walking(ContourFit(person.pose_tree()))
    tracker.expected, seen = [], views(cameras, alone[0])
    run = Bench(PersonTracker(tracker, cameras, 0.1))
    first = tracker.values(posed(person))
    run.system.set_person(run.context, PersonBelief(first, np.full(len(first), 0.02)))
    values = []
    for stamp in (4.0, 4.1, np.nan, 4.2, 4.2, 4.4, 9.0):
        run.update(time=[stamp], **seen)
        values.append(run["estimated_positions"])
        assert run["time"] == ([stamp] if np.isfinite(stamp) else [4.1])
    assert tracker.expected == pytest.approx([1.0, 1.0, 1.0, 2.0, 46.0])
    is_new = np.abs(np.diff(values, axis=0)).max(axis=1) > 0.0
    assert is_new.tolist() == [True, False, True, False, True, True]


@pytest.mark.slow
def test_another_person_hardly_changes_the_estimate(person, cameras, tracker, poses, alone):
    """The other one appears in the sixth frame; the tracked one walks."""
    other = [stepping(person, 0.2 * k, 0.7, 1.4 - 0.02 * k) for k in range(12)]
    both = [dict(one) for one in alone]
    for own, frame in list(zip(both, see(person, cameras, np.array(other)), strict=True))[5:]:
        own.update({name: mask | own[name] for name, mask in frame.items()})
    single, double = (watch(cameras, tracker, one) for one in (alone, both))
    assert not single["others"].any()
    assert double["others"][:, 0].tolist() == [0.0] * 5 + [1.0] * 7
    np.testing.assert_array_equal(double["visible"], 1.0)
    off, off_alone = (np.abs(one["estimated_positions"] - poses) for one in (double, single))
    # Nothing is claimed of the frames in which another pose fits as well.
    assert np.isfinite(off).all(axis=1).sum() >= 9
    medians = [np.nanmedian(one[1:7, 3:], axis=1) for one in (off, off_alone)]
    assert np.nanmax(medians[0]) < np.nanmax(medians[1]) + np.radians(2.0)
    assert np.nanmax(off[:, :3]) < 0.02


def test_deviations_match_the_errors(cameras, tracker, poses, alone):
    nobody = {name: np.zeros_like(mask) for name, mask in alone[0].items()}
    found = watch(cameras, tracker, [nobody, *alone[:5], nobody])
    assert np.isnan(found["deviations"][[0, -1]]).all()
    assert found["visible"].any(axis=1).tolist() == [False] + 5 * [True] + [False]
    off = np.abs(found["estimated_positions"][2:-1] - poses[1:5])
    known = found["deviations"][2:-1]
    assert (known > 0.0).all()
    # 95 % of normal errors are below 1.96 standard deviations.
    assert np.mean(off < 1.96 * known) > 0.8
    assert np.median(off / known) > 0.02


# The walker.

PERIOD = 1 / 30


def standing(person, x=0.0, head_deg=0.0, **degrees):
    return posed(person, x, head_y=head_deg, **degrees)


def walk(person, stances):
    """Return the walker's pose and the command after each stance of 1 s."""
    walker, found = Bench(Walker(person, PERIOD)), []
    for k, q in enumerate(stances):
        walker.advance(k + 1 - 0.5 * PERIOD, positions=q)
        found.append([walker["walker_pose"], walker["command"]])
    return found


def test_gestures_walk_and_turn(person):
    lost = np.full(len(person.position_names), np.nan)
    seen = [standing(person, *one) for one in ((0.1,), (0.4,), (0.1, 40.0), (-0.2,))]
    found = walk(person, [*seen[:3], lost, seen[3]])
    assert [tuple(command) for _, command in found] == [(0, 0), (0, 1), (1, 0), (0, 0), (0, -1)]
    ways = np.diff([pose for pose, _ in found], axis=0)
    np.testing.assert_allclose(ways[0], [WALK.speed, 0.0, 0.0], atol=0.05)
    np.testing.assert_allclose(ways[1], [0.0, 0.0, WALK.turn_rate], atol=0.05)
    np.testing.assert_allclose(ways[2], 0.0, atol=0.05)
    heading = found[2][0][2]
    back = -WALK.speed * np.array([math.cos(heading), math.sin(heading), 0.0])
    np.testing.assert_allclose(ways[3], back, atol=0.06)
    # A face that turns by more than 100 degrees was wrong: there is no command to turn, and ahead
    # is where the person faces now.
    stances = [standing(person, 0.0, 179.0), standing(person), standing(person, 0.4)]
    assert [tuple(one) for _, one in walk(person, stances)] == [(0, 0), (0, 0), (0, 1)]


def test_on_spot_requires_steps_for_a_command(person):
    """Neither standing ahead nor steps at the rest position alone are a command."""
    walker, found = Bench(Walker(person, PERIOD, on_spot=True)), []
    # Lift of the thigh during three steps [rad], left positive.
    spot = [0.8 * math.sin(math.pi * k / 8) for k in range(1, 24)]
    frames = [(0.0, 0.0), *[(0.3, 0.0)] * 20, *[(0.3, s) for s in spot], *[(0.0, s) for s in spot]]
    for k, (ahead, lifted) in enumerate(frames):
        side, bend = "left" if lifted > 0 else "right", math.degrees(abs(lifted))
        lift = {f"{side}_thigh_x": -bend, f"{side}_shin_x": 2 * bend}
        walker.advance((k + 0.5) * PERIOD, positions=standing(person, ahead, **lift))
        found.append(walker["command"][1])
    assert not any(found[:21])
    assert found[20 + len(spot)] == 1
    assert found[-1] == 0


def test_a_person_at_rest_is_shown_at_the_walkers_pose():
    pose, rest = np.array([3.0, -2.0, 1.1]), np.array([0.4, 9.0, 9.0, 0.5, 0.7])
    X_PR = walker_transform(pose, rest)
    np.testing.assert_allclose(X_PR.multiply([0.5, 0.7, 0.0]), [3.0, -2.0, 0.0], atol=1e-12)
    ahead = X_PR.multiply([0.5 + math.cos(0.4), 0.7 + math.sin(0.4), 0.0])
    np.testing.assert_allclose(ahead, [3.0 + math.cos(1.1), -2.0 + math.sin(1.1), 0.0], atol=1e-12)


def test_obstacles_equal_the_drawn_objects_and_the_start_is_free():
    inspector, obstacles = add_garden(DiagramBuilder()).model_inspector(), garden_obstacles()
    places = {
        inspector.GetName(one).rpartition("::")[2]: inspector.GetPoseInFrame(one).translation()
        for one in inspector.GetAllGeometryIds(Role.kPerception)
    }
    assert len(obstacles) == 20
    assert np.abs(obstacles[:, :2]).max() < WALK.half_size
    distance = np.linalg.norm(obstacles[:, :2] - WALK.start[:2], axis=1) - obstacles[:, 2]
    assert distance.min() > 2 * WALK.body_radius
    for name, radius in (("trunk_3", 0.18), ("ball_1", 0.5), ("basin", 1.3), ("gate_0_left", 0.15)):
        assert [*places[name][:2], radius] in obstacles.tolist()


def test_the_view_is_from_behind_and_above_inside_the_walls():
    """From 3.2 m behind and 2.1 m above to 1.5 m ahead and 1.1 m above."""
    for x, y, heading in np.random.default_rng(1).uniform(-1.0, 1.0, (100, 3)) * [9.0, 9.0, 3.0]:
        eye, target = view_from_behind(np.array([x, y, heading]))
        forward = np.array([math.cos(heading), math.sin(heading)])
        np.testing.assert_allclose(target, [*([x, y] + 1.5 * forward), 1.1])
        behind, inside = [x, y] - 3.2 * forward, WALK.half_size - 0.3
        np.testing.assert_allclose(eye, [*np.clip(behind, -inside, inside), 2.1])


def test_invalid_arguments_are_refused(person, cameras, tracker):
    several, hand = list(cameras.values()), load_model(bundled_model("hand"), check=False)
    for make, given, word in (
        (PersonTracker, (tracker, several[:1], 0.1), "two or more"),
        (PersonTracker, (tracker, several, 0.0), "period"),
        (build_silhouette_capture, (tracker, cameras, {}), "'camera_0' has no background"),
        (Walker, (person, 0.0), "period"),
        (Walker, (hand, PERIOD), "head"),
    ):
        with pytest.raises((SettingsError, UnknownNameError), match=word):
            make(*given)
