"""Label images in and positions out through Drake's LCM systems."""

import math
from pathlib import Path

import numpy as np
from drake import lcmt_image_array, lcmt_robot_state
from pydrake.lcm import DrakeLcm, Subscriber
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem
from pydrake.systems.sensors import ImageToLcmImageArrayT, LcmImageArrayToImages, PixelType

from drake_pose.search.kameda import PaperSearch
from drake_pose.search.settings import PaperSearchSettings
from drake_pose.silhouette.pictures.label_images import mask_to_label_image
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.bodies import RobotStateMessage
from drake_pose.systems.estimators.silhouette_matcher import SilhouetteTracker
from tests.search.bodies import forked_body, front_camera

PERIOD = 1 / 30


def test_label_images_and_estimates_travel_by_lcm(tmp_path: Path) -> None:
    body = forked_body(tmp_path)
    camera = front_camera(200, shift=0.2)
    renderer = LabelRenderer(body, camera)
    lcm = DrakeLcm("memq://")

    sending = DiagramBuilder()
    packer = sending.AddSystem(ImageToLcmImageArrayT(do_compress=True))
    packer.DeclareImageInputPort[PixelType.kLabel16I](name="label")
    sender = sending.AddSystem(
        LcmPublisherSystem.Make("IMAGES", lcmt_image_array, lcm, use_cpp_serializer=True)
    )
    sending.Connect(packer.get_output_port(), sender.get_input_port())
    sending.ExportInput(packer.get_input_port(0), "label_image")
    camera_diagram = sending.Build()
    camera_context = camera_diagram.CreateDefaultContext()

    builder = DiagramBuilder()
    builder.AddSystem(LcmInterfaceSystem(lcm))
    subscriber = builder.AddSystem(
        LcmSubscriberSystem.Make("IMAGES", lcmt_image_array, lcm, use_cpp_serializer=True)
    )
    images = builder.AddSystem(LcmImageArrayToImages())
    settings = PaperSearchSettings(interval=math.radians(20), outside_limit=60.0)
    search = PaperSearch(body.pose_tree(), settings)
    tracker = builder.AddSystem(SilhouetteTracker(search, [camera], PERIOD))
    message = builder.AddSystem(RobotStateMessage(body.position_names))
    publisher = builder.AddSystem(
        LcmPublisherSystem.Make("ESTIMATE", lcmt_robot_state, lcm, publish_period=PERIOD)
    )
    builder.Connect(subscriber.get_output_port(), images.get_input_port())
    builder.Connect(images.GetOutputPort("label_image"), tracker.GetInputPort("label_image"))
    builder.Connect(tracker.GetOutputPort("estimated_positions"), message.get_input_port())
    builder.Connect(message.get_output_port(), publisher.get_input_port())
    simulator = Simulator(builder.Build())
    heard = Subscriber(lcm, "ESTIMATE", lcmt_robot_state)

    # Before any message there is nothing to see, which is no error.
    simulator.AdvanceTo(0.5 * PERIOD)
    lcm.HandleSubscriptions(0)
    np.testing.assert_allclose(heard.message.joint_position, body.default_positions, atol=1e-6)
    q = np.array([0.1, 0.4, -0.4])
    for k in range(1, 8):
        q = q + 0.01
        image = mask_to_label_image(renderer.mask(q))
        camera_diagram.GetInputPort("label_image").FixValue(camera_context, image)
        camera_diagram.ForcedPublish(camera_context)
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        lcm.HandleSubscriptions(0)
    # A message of the same time as an update holds what was known before it.
    assert heard.message.joint_name == list(body.position_names)
    assert heard.message.utime == round(1e6 * 7 * PERIOD)
    np.testing.assert_allclose(heard.message.joint_position, q, atol=math.radians(4.0))
    context = tracker.GetMyContextFromRoot(simulator.get_context())
    assert tracker.GetOutputPort("pose_estimate").Eval(context).found
