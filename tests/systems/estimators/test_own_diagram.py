"""A user's diagram: a finalized plant, RgbdSensors and the matcher."""

import math

import numpy as np
import pytest
from pydrake.geometry import Box, MakeRenderEngineVtk, RenderEngineVtkParams
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraConfig, RgbdSensor

from drake_pose.body import ArticulatedModel
from drake_pose.errors import CameraError, UnknownNameError
from drake_pose.search import PaperSearch, PaperSearchSettings
from drake_pose.systems.cameras import cameras_from_drake
from drake_pose.systems.silhouette_matcher import SilhouetteMatcher, SilhouetteTracker
from tests.search.bodies import front_camera, swinging_chain

TRUTH = np.radians([30.0, -60.0, 0.0])
X_WC = RigidTransform(front_camera().X_WC)


class Station:
    """A chain before a wall that its cameras also see."""

    def __init__(self, folder) -> None:
        self.builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(self.builder, 0.0)
        plant = self.plant
        self.instances = swinging_chain(folder, 3).add_to(plant, self.scene_graph)
        X_WV, wall = RigidTransform([-1.0, 0.0, 0.0]), Box(0.1, 9.0, 9.0)
        plant.RegisterVisualGeometry(plant.world_body(), X_WV, wall, "wall", np.full(4, 0.5))
        plant.Finalize()
        self.scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))

    def model(self) -> ArticulatedModel:
        return ArticulatedModel.from_plant(self.plant, self.scene_graph, self.instances)

    def add_sensor(self, name: str, link: str, X_PB: RigidTransform) -> RgbdSensor:
        config = CameraConfig(name=name, width=200, height=200, renderer_name="vtk")
        config.focal = CameraConfig.FocalLength(x=900.0, y=900.0)
        body = self.plant.GetBodyByName(link)
        frame = self.plant.GetBodyFrameIdOrThrow(body.index())
        sensor = RgbdSensor(frame, X_PB, *config.MakeCameras())
        self.builder.AddNamedSystem(f"rgbd_sensor_{name}", sensor)
        images = sensor.query_object_input_port()
        self.builder.Connect(self.scene_graph.get_query_output_port(), images)
        return sensor


@pytest.mark.parametrize("system", [SilhouetteMatcher, SilhouetteTracker])
def test_a_plant_and_its_sensor_suffice(tmp_path, system):
    station = Station(tmp_path)
    sensor = station.add_sensor("front", "world", X_WC)
    settings = PaperSearchSettings(interval=math.radians(30.0), outside_limit=6.0)
    search = PaperSearch(station.model().pose_tree(), settings)
    matcher = station.builder.AddSystem(system(search, cameras_from_drake(station.builder), 0.1))
    image = matcher.GetInputPort("label_image")
    station.builder.Connect(sensor.label_image_output_port(), image)
    simulator = Simulator(station.builder.Build())
    plant = station.plant
    plant.SetPositions(plant.GetMyMutableContextFromRoot(simulator.get_mutable_context()), TRUTH)
    simulator.Initialize()
    simulator.get_system().ExecuteForcedEvents(simulator.get_mutable_context())
    own = matcher.GetMyContextFromRoot(simulator.get_context())
    # The wall has a label too, and fills the image.
    assert matcher.GetOutputPort("E_total").Eval(own)[0] < 0.02
    found = matcher.GetOutputPort("estimated_positions").Eval(own)
    np.testing.assert_allclose(found, TRUTH, atol=math.radians(1.0))


def test_cameras_from_drake_equal_the_sensors(tmp_path):
    station = Station(tmp_path)
    with pytest.raises(CameraError, match="no RgbdSensor"):
        cameras_from_drake(station.builder)
    station.add_sensor("front", "world", X_WC)
    station.add_sensor("hand", "segment_2", RigidTransform())
    diagram = station.builder.Build()
    with pytest.raises(CameraError, match="'hand' is attached to link 'segment_2', which moves"):
        cameras_from_drake(diagram)
    with pytest.raises(UnknownNameError, match="no camera 'back'"):
        cameras_from_drake(diagram, ["back"])
    (camera,) = cameras_from_drake(diagram, ["front"]).values()
    assert camera.name == "front"
    # The centre of Drake's image, whose pixel centres are at i + 0.5.
    assert (camera.center_x, camera.center_y, camera.focal_x) == (99.0, 99.0, 900.0)
    np.testing.assert_allclose(camera.X_WC, X_WC.GetAsMatrix4(), atol=1e-12)
