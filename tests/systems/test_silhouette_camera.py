"""SilhouetteCamera, compared with Drake's RgbdSensor in the same diagram."""

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
from drake_pose.camera.models import ParallelCamera, PinholeCamera, look_at
from drake_pose.errors import ModelError
from drake_pose.silhouette.pictures.label_renderer import (
    EMPTY,
    DeformableSkin,
    LabelRenderer,
    label_data,
)
from drake_pose.systems.cameras import SilhouetteCamera
from tests.benchmarks.silhouette_camera import arm_model, measure_camera


def camera_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> PinholeCamera:
    return PinholeCamera("front", 320, 240, 270.0, 272.0, 155.3, 119.5, look_at(eye, target))


@pytest.mark.parametrize("name", ["arm", "man"])
def test_labels_equal_an_rgbd_sensors(name, tmp_path):
    if name == "arm":
        model, camera = arm_model(tmp_path), camera_at((2.0, 0.3, 0.6), (0.0, 0.0, 0.6))
    else:
        model = load_model(bundled_model("man"), check=False)
        camera = camera_at((2.3, 0.5, 0.3), (0.0, 0.0, 0.0))
    figures = measure_camera(model, camera, poses=15)
    assert len(model.link_meshes) == 15
    assert figures.worst <= 0.002
    assert figures.mean <= 0.0006
    # The speed is measured in tests/benchmarks; this only checks that no renderer is used.
    assert figures.ours < figures.drakes


def test_labels_of_a_parallel_camera_equal_the_label_renderers():
    model = load_model(bundled_model("man"), check=False)
    camera = ParallelCamera("side", 240, 240, 110.0, 119.5, 119.5, look_at([0, 3, 0], [0, 0, 0]))
    system = SilhouetteCamera(model.plant, model.scene_graph, camera)
    context = system.CreateDefaultContext()
    plant_context = model.plant.CreateDefaultContext()
    rng = np.random.default_rng(1)
    renderer = LabelRenderer(model, camera)
    for _ in range(5):
        q = model.lower + rng.random(len(model.lower)) * np.minimum(model.upper - model.lower, 1.0)
        q[[model.position_index(f"position_{axis}") for axis in "xyz"]] = 0.0
        model.plant.SetPositions(plant_context, q)
        poses = model.plant.get_body_poses_output_port().Eval(plant_context)
        system.GetInputPort("body_poses").FixValue(context, poses)
        labels = label_data(system.GetOutputPort("label_image").Eval(context))
        expected = renderer.label_image(q)
        body = np.count_nonzero(expected != EMPTY)
        assert body > 1000
        assert np.count_nonzero(labels != expected) <= 0.002 * body


def two_balls() -> tuple[MultibodyPlant, SceneGraph, DiagramBuilder]:
    """A free body `carrier` with a ball behind it, and a ball welded to the world."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    inertia = SpatialInertia(1.0, np.zeros(3), UnitInertia.SolidSphere(0.1))
    carrier = plant.AddRigidBody("carrier", inertia)
    colour = np.ones(4)
    plant.RegisterVisualGeometry(
        plant.world_body(), RigidTransform([1.0, 0.0, 0.0]), Sphere(0.2), "ball", colour
    )
    labelled = PerceptionProperties()
    labelled.AddProperty("phong", "diffuse", Rgba(1.0, 1.0, 1.0, 1.0))
    labelled.AddProperty("label", "id", RenderLabel(77))
    geometry = plant.RegisterVisualGeometry(
        carrier, RigidTransform([0.5, 0.1, 0.0]), Sphere(0.1), "seen", colour
    )
    scene_graph.RemoveRole(plant.get_source_id(), geometry, Role.kPerception)
    scene_graph.AssignRole(plant.get_source_id(), geometry, labelled)
    plant.Finalize()
    return plant, scene_graph, builder


def test_a_camera_moves_with_its_parent_body():
    plant, scene_graph, builder = two_balls()
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
    carrier = plant.GetBodyByName("carrier")
    camera = camera_at((0.0, 0.0, 0.05), (1.0, 0.0, 0.0))
    color, depth, X_BC = camera_to_drake(camera, renderer_name="vtk", depth_range=(0.01, 60.0))
    frame = plant.GetBodyFrameIdOrThrow(carrier.index())
    sensor = builder.AddSystem(RgbdSensor(frame, X_BC, color, depth))
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    system = builder.AddSystem(SilhouetteCamera(plant, scene_graph, camera, carrier))
    builder.Connect(plant.get_body_poses_output_port(), system.GetInputPort("body_poses"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    ours, drakes = (one.GetMyContextFromRoot(context) for one in (system, sensor))
    context.SetTime(0.25)
    for turn in (0.0, 0.2):
        X_WB = RigidTransform(RotationMatrix.MakeZRotation(turn), [0.1, -0.1, 0.0])
        plant.SetFreeBodyPose(plant.GetMyMutableContextFromRoot(context), carrier, X_WB)
        labels = label_data(system.GetOutputPort("label_image").Eval(ours))
        expected = label_data(sensor.label_image_output_port().Eval(drakes))
        assert set(np.unique(expected)) == {0, 77, EMPTY}
        assert np.count_nonzero(labels != expected) <= 0.002 * np.count_nonzero(expected != EMPTY)
        pose = system.GetOutputPort("body_pose_in_world").Eval(ours)
        np.testing.assert_allclose(pose.GetAsMatrix4(), (X_WB @ X_BC).GetAsMatrix4(), atol=1e-12)
    assert system.GetOutputPort("image_time").Eval(ours) == [0.25]


def test_geometry_that_cannot_be_drawn_is_refused():
    camera = camera_at((2.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    plant, scene_graph, _ = two_balls()
    with pytest.raises(ModelError, match="registered"):
        SilhouetteCamera(plant, SceneGraph(), camera)
    unfinished = MultibodyPlant(0.0)
    unfinished.RegisterAsSourceForSceneGraph(scene_graph)
    with pytest.raises(ModelError, match="finalized"):
        SilhouetteCamera(unfinished, scene_graph, camera)
    unfinished.Finalize()
    with pytest.raises(ModelError, match="no visual geometry"):
        SilhouetteCamera(unfinished, scene_graph, camera)
    woman = load_model(bundled_model("woman"), check=False)
    DeformableSkin(ModelSkin(woman), scene_graph, {})
    with pytest.raises(ModelError, match="deformable"):
        SilhouetteCamera(plant, scene_graph, camera)


def test_poses_that_are_not_finite_are_refused():
    plant, scene_graph, _ = two_balls()
    system = SilhouetteCamera(plant, scene_graph, camera_at((2.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    context = system.CreateDefaultContext()
    port = system.GetInputPort("body_poses")
    world, unknown = RigidTransform(), RigidTransform([np.nan, 0.0, 0.0])
    for poses, words in (([world, unknown], "'carrier' is not finite"), ([world], "1 poses")):
        port.FixValue(context, poses)
        with pytest.raises(ModelError, match=words):
            system.GetOutputPort("label_image").Eval(context)
