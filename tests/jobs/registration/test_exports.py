"""Exports of `register --export`, read by the programs they are for."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import yaml
from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed
from pydrake.systems.sensors import CameraConfig

from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import CameraError, SettingsError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.result import check_exports, write_exports

TEXTS = ("ros", "mujoco", "drake")


@pytest.fixture(scope="module")
def written(arm_scene, tmp_path_factory):
    """Exports of the arm's two true cameras."""
    folder = tmp_path_factory.mktemp("exports")
    inputs = arm_scene.read()
    write_exports(folder, TEXTS, inputs, arm_scene.cameras.values(), {})
    return folder


def drake_cameras(path):
    """Return the cameras of a Scenario, read by Drake."""
    text = path.read_text()
    return {
        name: yaml_load_typed(schema=CameraConfig, data=yaml_dump(content))
        for name, content in yaml_load(data=text)["cameras"].items()
    }


def test_drake_and_load_cameras_read_the_scenario(written, arm_scene):
    cameras, configs = load_cameras(written / "drake.yaml"), drake_cameras(written / "drake.yaml")
    assert list(cameras) == list(configs) == list(arm_scene.cameras)
    for name, camera in arm_scene.cameras.items():
        np.testing.assert_allclose(
            cameras[name].kernel_parameters(), camera.kernel_parameters(), rtol=1e-12
        )
        X_PB = configs[name].X_PB.GetDeterministicValue().GetAsMatrix4()
        np.testing.assert_allclose(X_PB, camera.X_WC, atol=1e-12)
        color, _ = configs[name].MakeCameras()
        assert color.core().intrinsics().center_x() == pytest.approx(camera.center_x + 0.5)


def test_mujoco_and_ros_have_all_cameras(written, arm_scene):
    text = f'<mujoco><worldbody><include file="{written}/mujoco.xml"/></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    launch = ElementTree.parse(written / "ros" / "static_transforms.launch.xml").getroot()
    assert len(launch) == model.ncam == len(arm_scene.cameras)
    for node, (name, camera) in zip(launch, arm_scene.cameras.items(), strict=True):
        place = data.camera(name)
        np.testing.assert_allclose(place.xpos, camera.X_WC[:3, 3], atol=1e-12)
        R_WC = place.xmat.reshape(3, 3) * [1.0, -1.0, -1.0]
        np.testing.assert_allclose(R_WC, camera.X_WC[:3, :3], atol=1e-9)
        info = yaml.safe_load((written / "ros" / f"{name}.yaml").read_text())
        assert info["camera_matrix"]["data"][2] == camera.center_x
        assert "--frame-id world " in node.get("args")


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
    for name in TEXTS:
        with pytest.raises(CameraError, match=r"'flat'.*parallel"):
            check_exports([name], [flat])
    check_exports([], [flat])
    with pytest.raises(SettingsError, match="no export 'gazebo'; there is: ros"):
        RegistrationSettings(exports=("gazebo",))
