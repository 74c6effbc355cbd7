"""A ready diagram: a simulated body and camera, and what finds where the camera stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, SceneGraph
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink
from pydrake.systems.sensors import RgbdSensor
from pydrake.trajectories import Trajectory

from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.online_registration import OnlineRegistration
from drake_pose.systems.estimators.camera_registration import CameraRegistration
from drake_pose.systems.estimators.diagrams import add_simulated_cameras


@dataclass(frozen=True)
class RegistrationDiagram:
    """A diagram that registers a simulated camera, and the parts of it that one asks afterwards.

    Args:
        diagram: the whole diagram.
        registration: the system in it that finds the camera.
        sensor: the simulated camera; ``sensor.SetX_PB(context, X_WC)`` moves it.
        status_log: logs ``status`` once a period.
    """

    diagram: Diagram
    registration: CameraRegistration
    sensor: RgbdSensor
    status_log: VectorLogSink


def build_simulated_registration(
    registration: OnlineRegistration,
    camera: PinholeCamera,
    true_positions: Trajectory | np.ndarray,
    period: float,
    meshcat: Meshcat | None = None,
) -> RegistrationDiagram:
    """Wire a simulated body and camera to the registration, which is not told the camera's pose.

    Args:
        registration: the body, the camera's intrinsics, and settings.
        camera: where the sensor is.
        true_positions: the body's positions (nq,), constant or over time; they are measured without
            an error.
        period: time between two images, and two updates [s].
        meshcat: where to show the body; nowhere where not given.

    Returns:
        The diagram.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    system = builder.AddNamedSystem("camera_registration", CameraRegistration(registration, period))
    model = registration.body.tree.model
    truth, images = add_simulated_cameras(builder, scene_graph, model, [camera], true_positions)
    builder.Connect(images[0], system.GetInputPort("label_image"))
    builder.Connect(truth, system.GetInputPort("measured_positions"))
    if meshcat is not None:
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    status_log = LogVectorOutput(system.GetOutputPort("status"), builder, publish_period=period)
    diagram = builder.Build()
    sensor = diagram.GetSubsystemByName(f"camera_{camera.name}")
    return RegistrationDiagram(diagram, system, sensor, status_log)
