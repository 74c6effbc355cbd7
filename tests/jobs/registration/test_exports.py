"""Exports of `register --export`, read by the programs they are for."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import cv2
import mujoco
import numpy as np
import pytest
import yaml
from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed
from pydrake.systems.sensors import CameraConfig

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import CameraError, SettingsError
from drake_pose.files.replay import make_recording
from drake_pose.jobs.registration.result import check_exports, write_exports
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.registration.posed_frames import MultiViewFrame

TEXTS = ("ros", "mujoco", "drake")


@pytest.fixture(scope="module")
def written(arm_scene, tmp_path_factory):
    """Exports of the arm's two true cameras."""
    folder = tmp_path_factory.mktemp("exports")
    inputs = arm_scene.read()
    write_exports(folder, TEXTS, inputs, arm_scene.cameras.values(), {}, {})
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
    write_exports(tmp_path / "here", ["ros", "drake"], inputs, cameras.values(), {}, {})
    launch = (tmp_path / "here" / "ros" / "static_transforms.launch.xml").read_text()
    assert launch.count("--frame-id base ") == 2
    links = {"left": "hand"}
    write_exports(tmp_path / "there", ["ros", "drake"], inputs, cameras.values(), links, {})
    launch = (tmp_path / "there" / "ros" / "static_transforms.launch.xml").read_text()
    assert launch.count("--frame-id hand ") == 1
    configs = drake_cameras(tmp_path / "there" / "drake.yaml")
    assert [one.X_PB.base_frame for one in configs.values()] == ["hand", None]


def test_rerun_recording_has_robot_cameras_and_masks(arm_scene, tmp_path):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    tree = load_model(arm_scene.model, check=False).pose_tree()
    camera, kinematics = arm_scene.cameras["left"], TreeKinematics(tree)
    values = np.full((2, len(kinematics.names)), 0.3)
    masks = np.zeros((2, camera.height, camera.width), bool)
    masks[1, 100:120, 30:70] = True
    frames = [MultiViewFrame(f"{k:04d}", values[k], {"left": masks[k]}) for k in range(2)]
    picture = np.full((camera.height, camera.width, 3), 77, np.uint8)
    path = tmp_path / "rerun.rrd"
    path.write_bytes(make_recording(tree, [camera], frames, {"left": {"0001": picture}}))
    told = {}
    for chunk in RrdReader(path).stream():
        batch, own = chunk.to_record_batch(), told.setdefault(chunk.entity_path, {})
        for key in (key for key in batch.schema.names if ":" in key):
            own.setdefault(key, []).extend(batch[key].to_pylist())
    assert {f"/world/body/{node.name}" for node in tree.nodes} <= set(told)
    for node, X_WN in zip(tree.nodes, kinematics.poses(values[0]), strict=True):
        own = told[f"/world/body/{node.name}"]
        assert len(own["Mesh3D:triangle_indices"][0]) == len(node.mesh.triangles)
        np.testing.assert_allclose(
            own["Transform3D:translation"][0][0], X_WN[:3, 3], rtol=0, atol=1e-6
        )
        # rerun's matrices are in column order.
        R_WN = np.reshape(own["Transform3D:mat3x3"][0][0], (3, 3)).T
        np.testing.assert_allclose(R_WN, X_WN[:3, :3], atol=1e-6)
    np.testing.assert_allclose(
        told["/world/left"]["Transform3D:translation"][0][0], camera.X_WC[:3, 3], atol=1e-6
    )
    lens = told["/world/left/picture"]
    assert lens["Pinhole:image_from_camera"][0][0][6:8] == [160.0, 120.0]
    blob = np.array(lens["EncodedImage:blob"][0][0], np.uint8)
    assert cv2.imdecode(blob, cv2.IMREAD_COLOR).mean() == pytest.approx(77, abs=1)
    shown = told["/world/left/picture/mask"]["SegmentationImage:buffer"]
    assert [np.array(one[0], np.uint8).sum() for one in shown] == [0, 800]
    assert [one[0] for one in told["/frame"]["TextLog:text"]] == ["0000", "0001"]


def test_unsupported_exports_are_refused_before_work():
    flat = ParallelCamera("flat", 64, 48, 50.0, 31.5, 23.5, np.eye(4))
    for name in TEXTS:
        with pytest.raises(CameraError, match=r"'flat'.*parallel"):
            check_exports([name], [flat])
    check_exports([], [flat])
    with pytest.raises(SettingsError, match="no export 'gazebo'; there is: ros"):
        RegistrationSettings(exports=("gazebo",))
