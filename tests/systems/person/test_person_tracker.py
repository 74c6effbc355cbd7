import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import edge_spacing, see_silhouette
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.colour_images import picture_to_colour_image
from drake_pose.systems.person.live_capture import build_person_capture
from drake_pose.systems.person.person_tracker import PersonTracker
from tests.person.persons_in_view import see, stepping

# Who is followed walks; in this frame another one comes into view, and stays.
OTHER_COMES = 5


@pytest.fixture(scope="module")
def cameras():
    return circle_of_cameras(4, size=(320, 240), face_camera=False)


def test_moving_person_is_followed_and_shown(person, cameras):
    start = np.zeros(len(person.position_names))
    start[person.position_index("position_z")] = 1.55
    start[person.position_index("left_upper_arm_z")] = np.radians(40.0)
    start[person.position_index("right_upper_arm_z")] = np.radians(-40.0)
    end = start.copy()
    end[person.position_index("left_upper_arm_z")] = np.radians(80.0)
    end[person.position_index("left_thigh_x")] = np.radians(-40.0)
    end[person.position_index("left_shin_x")] = np.radians(40.0)
    path = PiecewisePolynomial.FirstOrderHold([0.0, 0.3], np.column_stack([start, end]))
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    diagram = build_person_capture(person, cameras, path, 1 / 30, meshcat)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.301)
    context = simulator.get_context()
    assert diagram.GetOutputPort("share").Eval(context)[0] > 0.8
    found = diagram.GetOutputPort("estimated_positions").Eval(context)
    for name in ("left_upper_arm_z", "right_upper_arm_z", "left_thigh_x", "left_shin_x"):
        index = person.position_index(name)
        assert np.degrees(found[index]) == pytest.approx(np.degrees(end[index]), abs=8.0), name
    assert found[:3] == pytest.approx(end[:3], abs=0.02)
    assert meshcat.HasPath("/drake/avatar") or meshcat.HasPath("avatar")


@pytest.mark.slow
def test_person_is_lost_kept_in_mind_and_found_again(person, cameras):
    tracker = PersonPoseTracker(ContourFit(person.pose_tree()))
    system = PersonTracker(tracker, list(cameras.values()), 0.1)
    simulator = Simulator(system)
    context = simulator.get_context()
    q = np.zeros(len(person.position_names))
    q[person.position_index("position_z")] = 1.55

    def show(x, time, blind=()):
        q[person.position_index("position_x")] = x
        for name, camera in cameras.items():
            view = None
            if name not in blind:
                mask = LabelRenderer(person, camera).mask(q)
                view = see_silhouette(mask, edge_spacing(camera))
            system.GetInputPort(f"silhouette_{name}").FixValue(context, view)
        system.GetInputPort("time").FixValue(context, [time])
        simulator.AdvanceTo(context.get_time() + 0.1)
        names = ("estimated_positions", "last_positions", "share", "seen")
        return [system.GetOutputPort(name).Eval(context).copy() for name in names]

    none = tuple(cameras)
    unknown, _, share, seen = show(0.0, np.nan, none)
    assert np.isnan(unknown).all()
    assert not share[0]
    assert not seen.any()
    assert np.isnan(system.GetOutputPort("time").Eval(context)[0])
    found, last, share, seen = show(0.0, 1.0)
    assert found[0] == pytest.approx(0.0, abs=0.02)
    assert share[0] > 0.8
    assert seen.tolist() == [1, 1, 1, 1]
    # The same time stamp: nothing new, whatever the pictures show.
    again, _, _, _ = show(0.0, 1.0, none)
    np.testing.assert_array_equal(again, found)
    lost, kept, share, seen = show(0.0, 1.1, none)
    assert np.isnan(lost).all()
    np.testing.assert_array_equal(kept, last)
    assert share[0] == 0.0
    assert not seen.any()
    # Back, a step away, and one camera is blind: the search goes on for some frames.
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
def both(person, cameras, alone):
    other = np.array([stepping(person, 0.2 * k, 0.7, 1.4 - 0.02 * k) for k in range(12)])
    frames = see(person, cameras, other)
    for frame in frames[:OTHER_COMES]:
        for mask in frame.values():
            mask[:] = False
    return [
        {name: mask | own[name] for name, mask in frame.items()}
        for own, frame in zip(alone, frames, strict=True)
    ]


@pytest.fixture(scope="module")
def watch(person, cameras):
    """What comes out for masks (T,), by port: (T, n)."""
    tracker = PersonPoseTracker(ContourFit(person.pose_tree()))
    names = ("estimated_positions", "others", "deviations", "seen")

    def watch(frames):
        system = PersonTracker(tracker, list(cameras.values()), 0.1, with_deviations=True)
        simulator = Simulator(system)
        context = simulator.get_context()
        found = []
        for k, masks in enumerate(frames):
            for name, camera in cameras.items():
                view = see_silhouette(masks[name], edge_spacing(camera))
                system.GetInputPort(f"silhouette_{name}").FixValue(context, view)
            system.GetInputPort("time").FixValue(context, [0.1 * k])
            simulator.AdvanceTo(0.1 * k + 0.05)
            found.append([system.GetOutputPort(name).Eval(context).copy() for name in names])
        return dict(zip(names, map(np.array, zip(*found, strict=True)), strict=True))

    return watch


@pytest.mark.slow
def test_the_one_is_followed_as_if_alone(watch, poses, alone, both):
    single, double = watch(alone), watch(both)
    assert not single["others"].any()
    assert double["others"][:, 0].tolist() == [0.0] * OTHER_COMES + [1.0] * 7
    np.testing.assert_array_equal(double["seen"], 1.0)
    off, off_alone = (
        np.degrees(np.abs(one["estimated_positions"] - poses)[:, 3:]) for one in (double, single)
    )
    assert np.median(off, axis=1).max() < np.median(off_alone, axis=1).max() + 2.0
    places = np.linalg.norm((double["estimated_positions"] - poses)[:, :3], axis=1)
    assert places.max() < 0.02


def test_deviations_tell_how_sure_each_position_is(watch, poses, alone):
    nobody = {name: np.zeros_like(mask) for name, mask in alone[0].items()}
    found = watch([nobody, *alone[:5], nobody])
    deviations = found["deviations"]
    assert np.isnan(deviations[[0, -1]]).all()
    off = np.abs(found["estimated_positions"] - np.vstack([poses[:1], poses[:6]]))[1:-1]
    known = deviations[1:-1]
    assert (known > 0.0).all()
    # Of normal errors 95 % are less than 1.96 deviations.
    assert np.mean(off < 1.96 * known) > 0.8
    assert np.median(off / known) > 0.02


def test_arguments_are_checked(person, cameras):
    tracker = PersonPoseTracker(ContourFit(person.pose_tree()))
    with pytest.raises(SettingsError, match="two or more"):
        PersonTracker(tracker, list(cameras.values())[:1], 0.1)
    with pytest.raises(SettingsError, match="period"):
        PersonTracker(tracker, list(cameras.values()), 0.0)


def test_a_person_who_is_set_is_followed_by_colour_images(person, cameras):
    tracker = PersonPoseTracker(ContourFit(person.pose_tree()))
    names = list(cameras)
    system = PersonTracker(
        tracker, list(cameras.values()), 0.1, with_deviations=True, color_cameras=names
    )
    simulator = Simulator(system)
    context = simulator.get_context()
    q = np.zeros(len(person.position_names))
    q[person.position_index("position_z")] = 1.55
    system.set_person(context, tracker.start(tracker.values(q)))
    renderers = {name: LabelRenderer(person, camera) for name, camera in cameras.items()}
    patches = np.random.default_rng(4).integers(0, 120, (12, 16, 3))
    room = patches.repeat(20, axis=0).repeat(20, axis=1)

    def show(is_covered=False):
        for name, renderer in renderers.items():
            mask = renderer.mask(q)
            picture = np.where(mask[..., None], (240, 150, 60), room).astype(np.uint8)
            if is_covered:
                picture[:] = 60
            image = picture_to_colour_image(picture)
            system.GetInputPort(f"color_image_{name}").FixValue(context, image)
        simulator.AdvanceTo(context.get_time() + 0.1)
        return system.GetOutputPort("estimated_positions").Eval(context)

    for k in range(4):
        q[person.position_index("left_upper_arm_z")] = np.radians(4.0 * k)
        q[person.position_index("position_x")] = 0.02 * k
        found = show()
    assert found[person.position_index("position_x")] == pytest.approx(0.06, abs=0.01)
    arm = found[person.position_index("left_upper_arm_z")]
    assert np.degrees(arm) == pytest.approx(12.0, abs=4.0)
    assert system.GetOutputPort("seen").Eval(context).all()
    deviations = system.GetOutputPort("deviations").Eval(context)
    assert np.all((deviations >= 0.0) & (deviations < np.pi))
    plant = person.plant
    plant_context = plant.CreateDefaultContext()
    plant.SetPositions(plant_context, found)
    expected = plant.get_body_poses_output_port().Eval(plant_context)
    poses = system.GetOutputPort("body_poses").Eval(context)
    assert len(poses) == plant.num_bodies()
    for pose, one in zip(poses, expected, strict=True):
        assert pose.IsNearlyEqualTo(one, 1e-9)
    assert np.isnan(show(is_covered=True)).all()
    # The last poses are still there to be shown.
    assert system.GetOutputPort("body_poses").Eval(context)[-1].IsNearlyEqualTo(poses[-1], 1e-9)
    found = show()
    assert found[person.position_index("position_x")] == pytest.approx(0.06, abs=0.01)


def test_a_colour_image_of_no_camera_is_refused(person, cameras):
    tracker = PersonPoseTracker(ContourFit(person.pose_tree()))
    with pytest.raises(UnknownNameError, match="elsewhere"):
        PersonTracker(tracker, list(cameras.values()), 0.1, color_cameras=["elsewhere"])
