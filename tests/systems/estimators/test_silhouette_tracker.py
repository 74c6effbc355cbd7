import math

import cv2
import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, GeometryInstance, PerceptionProperties, RenderLabel, SceneGraph
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import ImageRgba8U
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.errors import UnknownNameError
from drake_pose.filtering.tracking.contour_tracker import TrackingSettings
from drake_pose.search.kameda import PaperSearch
from drake_pose.search.settings import PaperSearchSettings
from drake_pose.silhouette.pictures.label_images import label_image_to_mask, mask_to_label_image
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.estimators.diagrams import add_simulated_cameras, build_simulated_matching
from drake_pose.systems.estimators.silhouette_matcher import TRACK, SilhouetteTracker
from drake_pose.systems.pictures.silhouette_camera import SilhouetteCamera
from tests.filtering.measurements.test_contour import pinhole
from tests.search.bodies import forked_body, front_camera

PERIOD = 1 / 30


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    return forked_body(tmp_path_factory.mktemp("body"))


@pytest.fixture(scope="module")
def search(body):
    settings = PaperSearchSettings(interval=math.radians(20), outside_limit=60.0)
    return PaperSearch(body.pose_tree(), settings)


def motion():
    """(20, 3) positions; a cut after the twelfth."""
    t = np.arange(20)[:, None] / 40
    swing = 0.25 * np.sin(2 * np.pi * t * np.array([1.0, 1.3, 0.8]) + np.array([0.0, 1.0, 2.0]))
    centre = np.where(t < 12 / 40, [[0.1, 0.4, -0.4]], [[-0.3, 1.7, -1.7]])
    return centre + swing


def test_plant_and_camera_to_tracked_positions(body, search):
    """In one diagram: Drake's renderer, the search at first and after a cut, the filter between."""
    truth = motion()
    trajectory = PiecewisePolynomial.ZeroOrderHold(
        PERIOD * (np.arange(21) - 0.3), np.vstack([truth, truth[-1:]]).T
    )
    camera = front_camera(200, shift=0.2)
    built = build_simulated_matching(
        search, [camera], trajectory, PERIOD, tracking=TrackingSettings()
    )
    tracker = built.matcher
    assert isinstance(tracker, SilhouetteTracker)
    simulator = Simulator(built.diagram)
    tracks, deviations, positions = [], [], []
    for k in range(len(truth)):
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        context = tracker.GetMyContextFromRoot(simulator.get_context())
        tracks.append(tracker.GetOutputPort("track").Eval(context))
        deviations.append(tracker.GetOutputPort("position_deviations").Eval(context))
        positions.append(tracker.GetOutputPort("estimated_positions").Eval(context))
    tracks = np.array(tracks)
    tracked, matches = (tracks[:, TRACK.index(name)] for name in ("tracked", "matches"))
    np.testing.assert_array_equal(tracked[:12], [0.0] + 11 * [1.0])
    assert tracked[12] == 0
    assert (matches[:12] == 1).all()
    assert matches[12] == 2
    assert matches[-1] <= 3
    errors = np.array(positions) - truth
    assert np.median(np.degrees(np.abs(errors).max(axis=1))) < 3.5
    assert np.mean(np.abs(errors) < 2 * np.array(deviations)) > 0.9
    assert (tracks[:, TRACK.index("distance")] < 1.0).all()


def test_velocities_and_body_poses_are_those_of_the_plant(body, search):
    camera = front_camera(200, shift=0.2)
    # Rates that fade, as they do by default, are too small in steady motion.
    settings = TrackingSettings(memory=5.0)
    tracker = SilhouetteTracker(search, [camera], PERIOD, tracking=settings)
    renderer = LabelRenderer(body, camera)
    seen = SilhouetteCamera(body.plant, body.scene_graph, camera)
    context = tracker.CreateDefaultContext()
    state = tracker.GetOutputPort("estimated_state")
    np.testing.assert_array_equal(state.Eval(context)[:3], body.default_positions)
    assert np.isnan(state.Eval(context)[3:]).all()
    speed = np.array([0.9, -0.6, 0.75])  # [rad/s]
    for k in range(12):
        q = np.array([-0.1, 0.5, -0.3]) + speed * PERIOD * k
        tracker.GetInputPort("label_image").FixValue(context, mask_to_label_image(renderer.mask(q)))
        tracker.ExecuteForcedEvents(context)
    estimate = state.Eval(context)
    found = tracker.GetOutputPort("estimated_positions").Eval(context)
    np.testing.assert_array_equal(estimate[:3], found)
    np.testing.assert_allclose(estimate[3:], speed, atol=0.15)

    poses = tracker.GetOutputPort("body_poses").Eval(context)
    for pose, expected in zip(poses, renderer.link_poses(found), strict=True):
        np.testing.assert_allclose(pose.GetAsMatrix4(), expected, atol=1e-12)
    # What is estimated can be looked at: the port fits a camera's.
    camera_context = seen.CreateDefaultContext()
    seen.GetInputPort("body_poses").FixValue(camera_context, poses)
    mask = label_image_to_mask(seen.GetOutputPort("label_image").Eval(camera_context))
    assert np.count_nonzero(mask != renderer.mask(found)) <= 0.002 * mask.sum()


def test_a_copied_context_goes_on_as_the_first_did(body, search):
    """All that the tracker remembers is in the context."""
    camera = front_camera(200, shift=0.2)
    tracker = SilhouetteTracker(search, [camera], PERIOD)
    renderer = LabelRenderer(body, camera)
    truth = motion()
    context = tracker.CreateDefaultContext()
    assert np.isnan(tracker.GetOutputPort("position_deviations").Eval(context)).all()

    def step(context, q):
        image = mask_to_label_image(renderer.mask(q))
        tracker.GetInputPort("label_image").FixValue(context, image)
        tracker.ExecuteForcedEvents(context)

    for q in truth[:3]:
        step(context, q)
    copy = context.Clone()
    for one in (context, copy):
        for q in truth[3:6]:
            step(one, q)
    for name in ("estimated_positions", "position_deviations", "track"):
        port = tracker.GetOutputPort(name)
        np.testing.assert_array_equal(port.Eval(context), port.Eval(copy))


def room(scene_graph, folder):
    """A wall of coloured patches behind the body."""
    patches = np.random.default_rng(8).integers(0, 256, (32, 32, 3)).astype(np.uint8)
    cv2.imwrite(str(folder / "wall.png"), patches.repeat(32, axis=0).repeat(32, axis=1))
    source = scene_graph.RegisterSource("room")
    wall = GeometryInstance(RigidTransform([-1.0, 0.0, 0.0]), Box(0.1, 6.0, 6.0), "wall")
    properties = PerceptionProperties()
    properties.AddProperty("phong", "diffuse_map", str(folder / "wall.png"))
    properties.AddProperty("label", "id", RenderLabel.kDontCare)
    wall.set_perception_properties(properties)
    scene_graph.RegisterAnchoredGeometry(source, wall)


def test_colour_images_of_a_sensor_are_enough(body, search, tmp_path):
    """In one diagram: RgbdSensors' colour images; measured positions in the first frame alone."""
    truth = motion()[:12]
    breaks = PERIOD * (np.arange(13) - 0.3)
    trajectory = PiecewisePolynomial.ZeroOrderHold(breaks, np.vstack([truth, truth[-1:]]).T)
    camera = pinhole("front", 3.0, side=480, focal=1000.0, height=0.05)
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    add_simulated_cameras(builder, scene_graph, body, [camera], trajectory)
    room(scene_graph, tmp_path)
    tracker = builder.AddSystem(
        SilhouetteTracker(search, [camera], PERIOD, color_cameras=["front"])
    )
    sensor = builder.GetSubsystemByName("camera_front")
    builder.Connect(sensor.color_image_output_port(), tracker.GetInputPort("color_image"))
    measured = builder.ExportInput(tracker.GetInputPort("measured_positions"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    positions, tracks, deviations = [], [], []
    for k, q in enumerate(truth):
        known = q if k == 0 else np.full(len(q), np.nan)
        diagram.get_input_port(measured).FixValue(root, known)
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        context = tracker.GetMyContextFromRoot(root)
        positions.append(tracker.GetOutputPort("estimated_positions").Eval(context))
        tracks.append(tracker.GetOutputPort("track").Eval(context))
        deviations.append(tracker.GetOutputPort("position_deviations").Eval(context))
    tracks = np.array(tracks)
    np.testing.assert_array_equal(tracks[:, TRACK.index("matches")], 0.0)
    np.testing.assert_array_equal(tracks[1:, TRACK.index("tracked")], 1.0)
    errors = np.abs(np.array(positions) - truth)
    assert np.degrees(np.median(errors.max(axis=1))) < 2.0
    assert np.mean(errors < 2 * np.array(deviations)) > 0.9


def test_a_covered_lens_loses_the_track_and_a_measured_position_brings_it_back(body, search):
    camera = front_camera(200, shift=0.2)
    tracker = SilhouetteTracker(search, [camera], PERIOD, color_cameras=["front"])
    renderer, truth = LabelRenderer(body, camera), motion()[0]
    picture = np.where(renderer.mask(truth)[..., None], [230, 130, 40, 255], [60, 140, 60, 255])
    context = tracker.CreateDefaultContext()
    lit, dark = ImageRgba8U(200, 200), ImageRgba8U(200, 200)
    lit.mutable_data[:] = picture.astype(np.uint8)
    found = []
    for image, measured in ((lit, truth), (dark, truth * np.nan), (lit, truth)):
        tracker.GetInputPort("color_image").FixValue(context, AbstractValue.Make(image))
        tracker.GetInputPort("measured_positions").FixValue(context, measured)
        tracker.ExecuteForcedEvents(context)
        found.append(tracker.GetOutputPort("pose_estimate").Eval(context).found)
    assert found == [True, False, True]
    # Nobody asked the search, for which there was no mask.
    assert tracker.GetOutputPort("track").Eval(context)[TRACK.index("matches")] == 0


def test_a_color_camera_that_is_none_is_named(search):
    with pytest.raises(UnknownNameError, match=r"side.*front"):
        SilhouetteTracker(search, [front_camera()], PERIOD, color_cameras=["side"])
