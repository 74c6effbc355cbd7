"""Exports of `register --export`, read by the programs they are for."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.sensors import CameraConfig

from drake_pose.camera.camera_files import load_camera_file
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import CameraError, SettingsError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.result import export_texts, write_exports


def drake_cameras(path):
    """Return the cameras of a Scenario, read by Drake."""
    text = path.read_text()
    return {
        name: yaml_load_typed(schema=CameraConfig, data=yaml_dump(content))
        for name, content in yaml_load(data=text)["cameras"].items()
    }


def test_a_camera_on_a_link_stands_there_in_mujoco_and_drake(tmp_path, arm_scene):
    """At joint positions of which the camera's pose in the world depends."""
    cameras, links = arm_scene.cameras, {"left": "hand"}
    write_exports(tmp_path, ["mujoco", "drake"], arm_scene.read(), cameras.values(), links)
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(arm_scene.model))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    spec = mujoco.MjSpec.from_file(str(arm_scene.model))
    spec.compiler.fusestatic, spec.compiler.boundmass, spec.compiler.boundinertia = False, 1, 1
    text = f'<mujoco><worldbody><include file="{tmp_path}/mujoco.xml"/></worldbody></mujoco>'
    exported = mujoco.MjSpec.from_string(text)
    for body in exported.worldbody.bodies:
        spec.body(body.name).add_frame().attach_body(body, "of_", "")
    model = spec.compile()
    data = mujoco.MjData(model)
    for k in range(model.njnt):
        plant.GetJointByName(model.joint(k).name).set_angle(context, 0.3 + 0.1 * k)
        data.joint(k).qpos[:] = 0.3 + 0.1 * k
    mujoco.mj_forward(model, data)
    X_WC = (
        plant.GetFrameByName("hand").CalcPoseInWorld(context).GetAsMatrix4() @ cameras["left"].X_WC
    )
    place = data.camera("of_left")
    np.testing.assert_allclose(place.xpos, X_WC[:3, 3], atol=1e-9)
    np.testing.assert_allclose(place.xmat.reshape(3, 3) * [1, -1, -1], X_WC[:3, :3], atol=1e-9)
    X_PB = drake_cameras(tmp_path / "drake.yaml")["left"].X_PB
    frame = plant.GetFrameByName(X_PB.base_frame)
    X_WP = frame.CalcPoseInWorld(context).GetAsMatrix4()
    X_WB = X_WP @ X_PB.GetDeterministicValue().GetAsMatrix4()
    np.testing.assert_allclose(X_WB, X_WC, atol=1e-9)
    for name in ("mujoco.xml", "drake.yaml"):
        read = load_camera_file(tmp_path / name)
        assert read.links == links
        np.testing.assert_allclose(read.cameras["left"].X_WC, cameras["left"].X_WC, atol=1e-9)


def test_transforms_start_at_the_link_at_the_world_s_origin(tmp_path, arm_scene):
    path = tmp_path / "arm.urdf"
    base = (
        '<link name="base"><visual><geometry><sphere radius="0.05"/></geometry></visual></link>'
        '<joint name="fixed" type="fixed"><parent link="world"/><child link="base"/></joint>'
    )
    text = arm_scene.model.read_text().replace('<parent link="world"/>', '<parent link="base"/>')
    path.write_text(text.replace('<link name="world"/>', f'<link name="world"/>{base}'))
    inputs = replace(arm_scene, model=path).read()
    cameras = arm_scene.cameras
    write_exports(tmp_path / "here", ["ros", "drake"], inputs, cameras.values(), {})
    launch = (tmp_path / "here" / "ros" / "static_transforms.launch.xml").read_text()
    assert launch.count("--frame-id base ") == 2
    links = {"left": "hand"}
    write_exports(tmp_path / "there", ["ros", "drake"], inputs, cameras.values(), links)
    launch = (tmp_path / "there" / "ros" / "static_transforms.launch.xml").read_text()
    assert launch.count("--frame-id hand ") == 1
    configs = drake_cameras(tmp_path / "there" / "drake.yaml")
    assert [one.X_PB.base_frame for one in configs.values()] == ["hand", None]


def test_unsupported_exports_are_refused_before_work():
    flat = ParallelCamera("flat", 64, 48, 50.0, 31.5, 23.5, np.eye(4))
    for name in ("ros", "mujoco", "drake"):
        with pytest.raises(CameraError, match=r"'flat'.*parallel"):
            export_texts([name], [flat], "world", {})
    export_texts([], [flat], "world", {})
    with pytest.raises(SettingsError, match="no export 'gazebo'; there is: ros"):
        RegistrationSettings(exports=("gazebo",))
