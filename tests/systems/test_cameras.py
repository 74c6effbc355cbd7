"""Simulated cameras compared with Drake's sensors, and the player of recorded masks."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydrake.geometry import (
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderEngineVtkParams,
    RenderLabel,
    Rgba,
    Role,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import RgbdSensor

from drake_pose.body import ModelSkin, bundled_model, load_model
from drake_pose.camera.exchange import camera_to_drake
from drake_pose.camera.models import ParallelCamera, PinholeCamera, circle_of_cameras, look_at
from drake_pose.errors import CameraError, ModelError, UnknownNameError
from drake_pose.silhouette.pictures.label_renderer import (
    EMPTY,
    DeformableSkin,
    LabelRenderer,
    label_data,
)
from drake_pose.silhouette.pictures.scenes import load_scene
from drake_pose.systems.cameras import (
    MaskPlayer,
    SilhouetteCamera,
    build_camera_rig,
    cameras_from_drake,
)
from tests.benchmarks.silhouette_camera import arm_model, measure_camera
from tests.person.persons_in_view import posed
from tests.systems.bench import Bench


def test_a_rigs_masks_equal_the_label_renderers(person):
    cameras = circle_of_cameras(2, size=(160, 120))
    rig, standing = build_camera_rig(person, cameras), posed(person, z=1.5, left_upper_arm_z=75)
    context = rig.diagram.CreateDefaultContext()
    rig.set_positions(context, standing)
    for name, camera in cameras.items():
        mask = rig.mask(context, name)
        assert mask.any()
        assert np.array_equal(mask, LabelRenderer(person, camera).mask(standing))
        picture = rig.picture(context, name)
        assert picture.shape == (120, 160, 3)
        near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        # The background has one colour: 0.55, 0.58 and 0.62 of 255.
        assert np.abs(picture[~near] - np.array([140.25, 147.9, 158.1])).max() < 1.0
    with pytest.raises(UnknownNameError, match="camera_9"):
        rig.picture(context, "camera_9")
    with pytest.raises(CameraError, match="at least one"):
        build_camera_rig(person, {})
    parallel = ParallelCamera("flat", 9, 9, 1.0, 4.0, 4.0, np.eye(4))
    with pytest.raises(CameraError, match="'flat'"):
        build_camera_rig(person, {"flat": parallel})


def test_the_mask_player_plays_frame_by_frame(tiny_scene, tmp_path):
    """The first and the last frame also before and after; what is not given is NaN or empty."""
    scene = replace(load_scene(tiny_scene.folder), frame_rate_hz=30.0)
    (camera,), frames = scene.cameras.values(), scene.frames
    values = {frames[1]: np.arange(3.0)}
    system = MaskPlayer(scene, [camera], positions=values, root_positions=values)
    run, period = Bench(system), system.period
    assert period == 1 / 30
    assert not system.color_cameras
    for time, frame in ((-1.0, 0), (0.0, 0), (0.9, 0), (1.0, 1), (1.9999, 1), (2.0, 2), (9.0, 2)):
        run.context.SetTime(time * period)
        assert run["frame_index"] == [frame]
        labels = run["label_image"].data[..., 0]
        np.testing.assert_array_equal(labels == 1, scene.read(camera.name, frames[frame]))
        for port in ("measured_positions", "root_position"):
            expected = np.arange(3.0) if frame == 1 else np.full(3, np.nan)
            np.testing.assert_array_equal(run[port], expected)
    assert not MaskPlayer(scene, [camera]).HasOutputPort("root_position")
    # The player has a port for each camera; of cameras without a mask all is background.
    other = camera.with_pose(np.eye(4))
    other = type(other)(**{**vars(other), "name": "other"})
    both = Bench(MaskPlayer(scene, [camera, other], frames[1:]))
    assert (both["label_image_other"].data == EMPTY).all()
    seen = both[f"label_image_{camera.name}"].data[..., 0] == 1
    np.testing.assert_array_equal(seen, scene.read(camera.name, frames[1]))
    # Pictures are blue, and only of one frame.
    cv2.imwrite(str(tmp_path / "1.png"), np.full((camera.height, camera.width, 3), (200, 0, 0)))
    filmed = replace(scene, images={(camera.name, frames[1]): tmp_path / "1.png"})
    run = Bench(MaskPlayer(filmed, [camera, other]))
    assert run.system.color_cameras == (camera.name,)
    assert not run[f"color_image_{camera.name}"].size()
    run.context.SetTime(period)
    assert (run[f"color_image_{camera.name}"].data == (0, 0, 200, 255)).all()


def camera_at(eye, target) -> PinholeCamera:
    return PinholeCamera("front", 320, 240, 270.0, 272.0, 155.3, 119.5, look_at(eye, target))


@pytest.mark.parametrize("name", ["arm", "man"])
def test_labels_equal_an_rgbd_sensors(name, tmp_path):
    if name == "arm":
        model, camera = arm_model(tmp_path), camera_at((2.0, 0.3, 0.6), (0.0, 0.0, 0.6))
    else:
        model = load_model(bundled_model("man"), check=False)
        camera = camera_at((2.3, 0.5, 0.3), (0.0, 0.0, 0.0))
    figures = measure_camera(model, camera, poses=8)
    assert len(model.link_meshes) == 15
    assert figures.worst <= 0.002
    assert figures.mean <= 0.0006
    assert figures.ours < figures.drakes


class TwoBalls:
    """A free body `carrier` with a ball before it, and a ball welded to the world."""

    def __init__(self):
        self.builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(self.builder, 0.0)
        inertia = SpatialInertia(1.0, np.zeros(3), UnitInertia.SolidSphere(0.1))
        self.carrier, ahead = plant.AddRigidBody("carrier", inertia), RigidTransform([1.0, 0, 0])
        plant.RegisterVisualGeometry(plant.world_body(), ahead, Sphere(0.2), "ball", np.ones(4))
        labelled = PerceptionProperties()
        labelled.AddProperty("phong", "diffuse", Rgba(1.0, 1.0, 1.0, 1.0))
        labelled.AddProperty("label", "id", RenderLabel(77))
        place, source = RigidTransform([0.5, 0.1, 0.0]), plant.get_source_id()
        seen = plant.RegisterVisualGeometry(self.carrier, place, Sphere(0.1), "seen", np.ones(4))
        scene_graph.RemoveRole(source, seen, Role.kPerception)
        scene_graph.AssignRole(source, seen, labelled)
        plant.Finalize()
        scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
        self.plant, self.scene_graph = plant, scene_graph

    def add_sensor(self, name, body, X_PB=None) -> tuple[RgbdSensor, RigidTransform]:
        camera = camera_at((0.0, 0.0, 0.05), (1.0, 0.0, 0.0))
        color, depth, X_BC = camera_to_drake(camera, renderer_name="vtk", depth_range=(0.01, 60.0))
        frame, X_BC = self.plant.GetBodyFrameIdOrThrow(body.index()), X_PB or X_BC
        sensor = RgbdSensor(frame, X_BC, color, depth)
        self.builder.AddNamedSystem(f"rgbd_sensor_{name}", sensor)
        query = sensor.query_object_input_port()
        self.builder.Connect(self.scene_graph.get_query_output_port(), query)
        return sensor, X_BC


def test_a_camera_moves_with_its_parent_body():
    balls = TwoBalls()
    plant, carrier = balls.plant, balls.carrier
    camera = camera_at((0.0, 0.0, 0.05), (1.0, 0.0, 0.0))
    sensor, X_BC = balls.add_sensor("front", carrier)
    system = balls.builder.AddSystem(SilhouetteCamera(plant, balls.scene_graph, camera, carrier))
    balls.builder.Connect(plant.get_body_poses_output_port(), system.GetInputPort("body_poses"))
    context = balls.builder.Build().CreateDefaultContext()
    ours = Bench(system, system.GetMyContextFromRoot(context))
    context.SetTime(0.25)
    for turn in (0.0, 0.2):
        X_WB = RigidTransform(RotationMatrix.MakeZRotation(turn), [0.1, -0.1, 0.0])
        plant.SetFreeBodyPose(plant.GetMyMutableContextFromRoot(context), carrier, X_WB)
        labels, own = label_data(ours["label_image"]), sensor.GetMyContextFromRoot(context)
        expected = label_data(sensor.label_image_output_port().Eval(own))
        assert set(np.unique(expected)) == {0, 77, EMPTY}
        assert np.count_nonzero(labels != expected) <= 0.002 * np.count_nonzero(expected != EMPTY)
        assert ours["body_pose_in_world"].IsNearlyEqualTo(X_WB @ X_BC, 1e-12)
    assert ours["image_time"] == [0.25]


def test_geometry_and_poses_that_cannot_be_drawn_are_refused():
    camera, balls, unfinished = camera_at((2, 0, 0), (0, 0, 0)), TwoBalls(), MultibodyPlant(0.0)
    with pytest.raises(ModelError, match="registered"):
        SilhouetteCamera(balls.plant, SceneGraph(), camera)
    unfinished.RegisterAsSourceForSceneGraph(balls.scene_graph)
    with pytest.raises(ModelError, match="finalized"):
        SilhouetteCamera(unfinished, balls.scene_graph, camera)
    unfinished.Finalize()
    with pytest.raises(ModelError, match="no visual geometry"):
        SilhouetteCamera(unfinished, balls.scene_graph, camera)
    run = Bench(SilhouetteCamera(balls.plant, balls.scene_graph, camera))
    world, unknown = RigidTransform(), RigidTransform([np.nan, 0.0, 0.0])
    for poses, words in (([world, unknown], "'carrier' is not finite"), ([world], "1 poses")):
        with pytest.raises(ModelError, match=words):
            run.give(body_poses=poses)["label_image"]
    woman = load_model(bundled_model("woman"), check=False)
    DeformableSkin(ModelSkin(woman), balls.scene_graph, {})
    with pytest.raises(ModelError, match="deformable"):
        SilhouetteCamera(balls.plant, balls.scene_graph, camera)


def test_cameras_from_drake_equal_the_sensors():
    balls, X_WC = TwoBalls(), RigidTransform([0.3, 0.1, 2.0])
    with pytest.raises(CameraError, match="no RgbdSensor"):
        cameras_from_drake(balls.builder)
    balls.add_sensor("front", balls.plant.world_body(), X_WC)
    balls.add_sensor("hand", balls.carrier)
    outer = DiagramBuilder()
    outer.AddSystem(balls.builder.Build())
    diagram = outer.Build()
    with pytest.raises(CameraError, match="'hand' is attached to link 'carrier', which moves"):
        cameras_from_drake(diagram)
    with pytest.raises(UnknownNameError, match="no camera 'back'"):
        cameras_from_drake(diagram, ["back"])
    (camera,) = cameras_from_drake(diagram, ["front"]).values()
    assert vars(camera) | {"X_WC": 0} == vars(camera_at((0, 0, 0.05), (1, 0, 0))) | {"X_WC": 0}
    np.testing.assert_allclose(camera.X_WC, X_WC.GetAsMatrix4(), atol=1e-12)
