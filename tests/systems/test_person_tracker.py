import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.pose_tracker import PersonBelief, PersonPoseTracker
from drake_pose.person.views import edge_spacing, see_silhouette
from drake_pose.systems.cameras import build_camera_rig
from drake_pose.systems.person import PersonTracker, build_silhouette_capture
from tests.person.persons_in_view import posed, see, stepping
from tests.systems.bench import Bench

# Index of the frame in which another person appears; the tracked one walks.
OTHER_COMES = 5


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


def test_a_moving_person_is_tracked(person, cameras, tracker):
    start = posed(person, left_upper_arm_z=40, right_upper_arm_z=-40)
    end = posed(
        person, left_upper_arm_z=53, right_upper_arm_z=-40, left_thigh_x=-13, left_shin_x=13
    )
    path = PiecewisePolynomial.FirstOrderHold([0.0, 0.1], np.column_stack([start, end]))
    rig = build_camera_rig(person, cameras, path).diagram
    capture = build_silhouette_capture(tracker, cameras, {}, 1 / 30, source=rig)
    diagram = capture.diagram
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.101)
    run = Bench(diagram, simulator.get_context())
    assert run["inlier_ratio"][0] > 0.8
    np.testing.assert_allclose(run["estimated_positions"][:3], end[:3], atol=0.02)
    for name in ("left_upper_arm_z", "right_upper_arm_z", "left_thigh_x", "left_shin_x"):
        index = person.position_index(name)
        off = run["estimated_positions"][index] - end[index]
        assert np.degrees(off) == pytest.approx(0.0, abs=4.0), name


@pytest.mark.slow
def test_a_lost_person_keeps_the_last_positions_and_is_found_again(person, cameras, tracker):
    run = Bench(PersonTracker(tracker, list(cameras.values()), 0.1))

    def show(x, time, blind=()):
        shown = {name: one for name, one in cameras.items() if name not in blind}
        masks = see(person, shown, [posed(person, x=x)])[0]
        run.advance(run.context.get_time() + 0.1, **views(cameras, masks), time=[time])
        names = ("estimated_positions", "last_positions", "inlier_ratio", "visible")
        return [run[name] for name in names]

    none = tuple(cameras)
    unknown, _, ratio, seen = show(0.0, np.nan, none)
    assert np.isnan(unknown).all()
    assert not ratio.any()
    assert not seen.any()
    assert np.isnan(run["time"][0])
    found, last, ratio, seen = show(0.0, 1.0)
    assert found[0] == pytest.approx(0.0, abs=0.02)
    assert ratio[0] > 0.8
    assert seen.tolist() == [1, 1, 1, 1]
    # Pictures with the same time stamp are not new.
    np.testing.assert_array_equal(show(0.0, 1.0, none)[0], found)
    lost, kept, ratio, seen = show(0.0, 1.1, none)
    assert np.isnan(lost).all()
    np.testing.assert_array_equal(kept, last)
    assert not ratio.any()
    assert not seen.any()
    # The person is back a step away, and one camera is covered: the search takes some frames.
    for time in (1.4, 1.5, 1.6, 1.7):
        found, _, _, seen = show(0.15, time, none[:1])
    assert found[0] == pytest.approx(0.15, abs=0.03)
    assert seen.tolist() == [0, 1, 1, 1]


@pytest.fixture(scope="module")
def poses(person):
    return np.array([stepping(person, 0.25 * k, 0.02 * k - 0.2, 0.1) for k in range(12)])


@pytest.fixture(scope="module")
def alone(person, cameras, poses):
    return see(person, cameras, poses)


@pytest.fixture(scope="module")
def watch(cameras, tracker):
    """Return a function that maps masks (T,) to outputs (T, n) by port."""
    names = ("estimated_positions", "others", "deviations", "visible")

    def watch(frames):
        run = Bench(PersonTracker(tracker, list(cameras.values()), 0.1, with_deviations=True))
        found = []
        for k, masks in enumerate(frames):
            run.advance(0.1 * k + 0.05, **views(cameras, masks), time=[0.1 * k])
            found.append([run[name] for name in names])
        return dict(zip(names, map(np.array, zip(*found, strict=True)), strict=True))

    return watch


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
def test_another_person_hardly_changes_the_estimate(person, cameras, watch, poses, alone):
    other = [stepping(person, 0.2 * k, 0.7, 1.4 - 0.02 * k) for k in range(12)]
    frames = see(person, cameras, np.array(other))
    both = [
        own if k < OTHER_COMES else {name: mask | own[name] for name, mask in frame.items()}
        for k, (own, frame) in enumerate(zip(alone, frames, strict=True))
    ]
    single, double = watch(alone), watch(both)
    assert not single["others"].any()
    assert double["others"][:, 0].tolist() == [0.0] * OTHER_COMES + [1.0] * 7
    np.testing.assert_array_equal(double["visible"], 1.0)
    off, off_alone = (
        np.degrees(np.abs(one["estimated_positions"] - poses)[:, 3:]) for one in (double, single)
    )
    # Nothing is claimed of the frames in which another pose fits as well.
    assert np.isfinite(off).all(axis=1).sum() >= 9
    medians = [np.nanmedian(one[1:7], axis=1) for one in (off, off_alone)]
    assert np.nanmax(medians[0]) < np.nanmax(medians[1]) + 2.0
    places = np.linalg.norm((double["estimated_positions"] - poses)[:, :3], axis=1)
    assert np.nanmax(places) < 0.02


def test_deviations_match_the_errors(watch, poses, alone):
    nobody = {name: np.zeros_like(mask) for name, mask in alone[0].items()}
    found = watch([nobody, *alone[:5], nobody])
    assert np.isnan(found["deviations"][[0, -1]]).all()
    # In the first frame with a person, another pose fits nearly as well.
    off = np.abs(found["estimated_positions"][2:-1] - poses[1:5])
    known = found["deviations"][2:-1]
    assert (known > 0.0).all()
    # 95 % of normal errors are below 1.96 standard deviations.
    assert np.mean(off < 1.96 * known) > 0.8
    assert np.median(off / known) > 0.02


def test_invalid_arguments_are_refused(cameras, tracker):
    several = list(cameras.values())
    with pytest.raises(SettingsError, match="two or more"):
        PersonTracker(tracker, several[:1], 0.1)
    with pytest.raises(SettingsError, match="period"):
        PersonTracker(tracker, several, 0.0)
