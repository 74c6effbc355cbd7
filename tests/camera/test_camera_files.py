"""Camera files: written and read back, Drake's, and exports to ROS and MuJoCo."""

import cv2
import mujoco
import numpy as np
import pytest
import yaml
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraConfig

from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.camera.exchange import (
    camera_from_drake,
    camera_to_config,
    dump_scenario,
    mujoco_cameras,
    ros_camera_info,
)
from drake_pose.camera.models import ParallelCamera, PinholeCamera, circle_of_cameras
from drake_pose.errors import CameraError

EYE = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
SIDES = "width: 64, height: 48, center_x: 31.5, center_y: 23.5"
LENS = f"{SIDES}, focal_x: 60, focal_y: 61"
GOOD = f"{{{LENS}, X_WC: {EYE}}}"


def write(folder, text):
    path = folder / "cameras.yaml"
    path.write_text(text)
    return path


def test_round_trip_is_exact(tmp_path):
    X_WC = PLACE.GetAsMatrix4()
    written = {
        "z": PinholeCamera("z", 64, 48, 60.0, 1e-7, 1 / 3, 23.5, X_WC, near=1e-3),
        "b": ParallelCamera("b", 700, 701, 226.0, 350.0, -12.25, X_WC),
    }
    save_cameras(tmp_path / "c.yaml", written)
    read = load_cameras(tmp_path / "c.yaml")
    assert list(read) == ["z", "b"]
    for name, camera in read.items():
        assert type(camera) is type(written[name])
        np.testing.assert_array_equal(camera.kernel_parameters(), written[name].kernel_parameters())
        np.testing.assert_array_equal(camera.X_WC, written[name].X_WC)


def test_pixel_centers_may_follow_drake(tmp_path):
    for kind in ("focal_x: 60, focal_y: 61", "projection: parallel, pixels_per_metre: 1e2"):
        text = f"{{{kind}, pixel_centers: drake, {SIDES}, X_WC: {EYE}}}"
        camera = load_cameras(write(tmp_path, f"7: {text}"))["7"]
        assert (camera.center_x, camera.center_y) == (31.0, 23.0)
    assert isinstance(camera, ParallelCamera)
    assert camera.pixels_per_metre == 100.0


def test_bad_files_are_refused(tmp_path):
    for text, message in (
        (f"cam: {{{GOOD[1:-1]}, pixel_centers: middle}}", "'cam'.*integers.*drake.*'middle'"),
        ("", "is no camera file. Tried: .*OpenCV"),
        ("cam: 3", "no camera file: it has cam. Tried: .*this program's cameras.yaml .no focal_x"),
        ("cam: [", "not a YAML file"),
        (f"cam: {GOOD}\ncam: {GOOD}", "given twice"),
        (f"1: {GOOD}\n'1': {GOOD}", "given twice"),
        (f"../up: {GOOD}", "camera name"),
        (f"cam: {GOOD}\nother: 3", "'other': expected a mapping from field names"),
        (f"cam: {{{SIDES}, focal_x: 60, X_WC: {EYE}}}", "'cam'.*needs focal_y"),
        (f"cam: {{{SIDES}, projection: parallel, X_WC: {EYE}}}", "'cam'.*needs pixels_per_metre"),
        (GOOD.join(["cam: ", ""]).replace("focal_x", "fx: 1, focal_x"), "'cam'.*unknown field fx"),
        ("cam: {projection: fisheye}", "'cam'.*projection"),
        (f"cam: {GOOD}".replace("width: 64", "width: .nan"), "'cam'.*width"),
        (f"cam: {GOOD}".replace("[0, 1, 0, 0]", "[0, -1, 0, 0]"), "'cam'.*X_WC.*reflection"),
        (f"cam: {GOOD}".replace("[0, 0, 0, 1]", "[0, 0, 1]"), "'cam'.*X_WC.*4 x 4"),
        (f"cam: {{{LENS}, link: hand}}", "'cam'.*link's name"),
        (f"cam: {{{LENS}, X_LC: {EYE}}}", "'cam'.*link's name"),
        (f"cam: {{{LENS}, link: hand, X_LC: {EYE}, X_WC: {EYE}}}", "'cam'.*no X_WC"),
        ("[" * 5000, "YAML|deeply"),
        ("<launch", "not a XML file"),
        ("cameras: [1]", "mapping from names"),
        ("cameras: {a: 3}", "'a'.*fields of a CameraConfig"),
        ("cameras: {a: {name: c}, b: {name: c}}", "'c' is given twice"),
        ("One: {cameras: {a: {}}}\nTwo: {cameras: {a: {}}}", "several scenarios"),
    ):
        path = write(tmp_path, text)
        with pytest.raises(CameraError, match=message) as caught:
            load_cameras(path)
        assert str(path) in str(caught.value)
        assert len(str(caught.value)) < 1000


def test_unreadable_and_unwritable_files_are_refused(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x80")
    (tmp_path / "large.yaml").write_text("# " + "x" * (1 << 21))
    with (tmp_path / "huge.json").open("wb") as file:
        file.truncate((1 << 31) + 1)
    files = {"missing.yaml": "missing", ".": "folder", "huge.json": "larger"}
    files |= {"binary.yaml": "no camera file", "large.yaml": "larger"}
    for name, reason in files.items():
        with pytest.raises(CameraError, match=reason) as caught:
            load_cameras(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
    camera = PinholeCamera("a", 64, 48, 60.0, 60.0, 31.0, 23.0, np.eye(4))
    with pytest.raises(CameraError, match="nowhere"):
        save_cameras(tmp_path / "nowhere" / "c.yaml", [camera])


FRONT = """
name: front
width: 320
height: 200
focal: !FovDegrees {y: 40}
clipping_near: 0.2
z_near: 0.3
X_PB:
  base_frame: world
  translation: [1, 2, 3]
  rotation: !Rpy {deg: [-100, 10, 30]}
X_BC: {translation: [0.01, 0, 0]}
renderer_class: !RenderEngineVtkParams {}
label: true
"""


def indented(text, by):
    return "".join(f"{' ' * by}{line}\n" for line in text.strip().splitlines())


SCENARIO = f"""
directives:
- add_model: {{name: arm, file: package://drake_models/arm.urdf}}
model_drivers: {{arm: !IiwaDriver {{hand_model_name: wsg}}}}
cameras:
  first:
{indented(FRONT, 4)}
  side: {{focal: !FocalLength {{x: 500}}, center_x: 300.5}}
  plain:
"""


def require_same(camera, config):
    """Assert that a camera is what Drake makes of a CameraConfig."""
    color, _ = config.MakeCameras()
    X_PB = config.X_PB.GetDeterministicValue()
    expected = camera_from_drake(camera.name, color.core(), X_PB)
    np.testing.assert_allclose(camera.kernel_parameters(), expected.kernel_parameters())
    np.testing.assert_allclose(camera.X_WC, expected.X_WC, atol=1e-12)


@pytest.mark.parametrize("above", ["", "any:\n", "cameras:\n  a:\n", "Demo:\n  cameras:\n    a:\n"])
def test_a_camera_config_is_recognised_at_any_level(above, tmp_path):
    path = write(tmp_path, above + indented(FRONT, 2 * above.count("\n")))
    (front,) = load_cameras(path).values()
    assert isinstance(front, PinholeCamera)
    require_same(front, yaml_load_typed(schema=CameraConfig, data=FRONT))


def test_scenarios_are_read_and_written_ones_read_back_and_by_drake(tmp_path):
    cameras = load_cameras(write(tmp_path, SCENARIO))
    assert list(cameras) == ["front", "side", "plain"]
    np.testing.assert_array_equal(cameras["side"].kernel_parameters()[1:4], [500.0, 500.0, 300.0])
    require_same(cameras["plain"], CameraConfig())
    X_WC, written = PLACE.GetAsMatrix4(), circle_of_cameras(5, size=(320, 240))
    written["odd"] = PinholeCamera("odd", 64, 48, 60.0, 1.5, 1 / 3, 23.5, X_WC, near=300.0)
    (tmp_path / "scenario.yaml").write_text(dump_scenario(written))
    read = load_cameras(tmp_path / "scenario.yaml")
    assert list(read) == list(written)
    for name, camera in read.items():
        expected = written[name].kernel_parameters()
        np.testing.assert_allclose(camera.kernel_parameters(), expected, rtol=1e-14)
        np.testing.assert_allclose(camera.X_WC, written[name].X_WC, atol=1e-14)
        # Drake reads the written cameras.
        require_same(written[name], camera_to_config(written[name]))
    assert "label: true" in (tmp_path / "scenario.yaml").read_text()
    outside = PinholeCamera("off", 10, 10, 5.0, 5.0, -3.0, 5.0, np.eye(4))
    with pytest.raises(CameraError, match=r"'off'.*principal point"):
        dump_scenario([outside])


def test_invalid_camera_configs_are_refused(tmp_path):
    for old, new, message in (
        ("base_frame: world", "base_frame: 'iiwa::link7'", "'front' rides on link 'link7'"),
        ("!Rpy {deg: [-100, 10, 30]}", "!Uniform {}", "'front'.* stochastic"),
        ("width: 320", "widht: 320", "invalid CameraConfig.*widht"),
        ("!FovDegrees {y: 40}", "{}", "'front': invalid CameraConfig.*FocalLength"),
        ("!FovDegrees {y: 40}", "[500]", r"'front': invalid CameraConfig: .*fields, not \[500\]"),
        ("name: front", "name: ../up", "camera name"),
        ("X_BC: {", "X_BC: {base_frame: hand, ", "base_frame"),
    ):
        with pytest.raises(CameraError, match=message) as raised:
            load_cameras(write(tmp_path, f"front:\n{indented(FRONT.replace(old, new), 2)}"))
        assert "cameras.yaml" in str(raised.value)


PLACE = RigidTransform(Quaternion(np.array([0.5, -0.7, 0.4, 0.3]) / np.sqrt(0.99)), [0.3, -0.2, 1])
CAMERA = PinholeCamera("head left", 64, 48, 60.0, 70.0, 25.3, 30.1, PLACE.GetAsMatrix4())


def visible_points():
    """Return (n, 3) world points that the camera sees."""
    p_C = np.array([[0.0, 0.0, 1.0], [0.1, 0.2, 2.0], [-0.3, 0.1, 1.5], [0.2, -0.4, 3.0]])
    return p_C @ CAMERA.X_WC[:3, :3].T + CAMERA.X_WC[:3, 3]


def test_a_ros_camera_info_projects_like_the_camera():
    info = yaml.safe_load(ros_camera_info(CAMERA))
    names = "camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"
    K, D, R, P = (np.reshape(info[k]["data"], (info[k]["rows"], info[k]["cols"])) for k in names)
    assert (info["image_width"], info["image_height"]) == (64, 48)
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(P, np.column_stack([K, np.zeros(3)]))
    X_CW = np.linalg.inv(CAMERA.X_WC)
    turn, shift = cv2.Rodrigues(X_CW[:3, :3])[0], X_CW[:3, 3]
    uv, _ = cv2.projectPoints(visible_points(), turn, shift, K, D)
    np.testing.assert_allclose(uv[:, 0], CAMERA.project(visible_points())[0], atol=1e-9)


def test_mujoco_projects_to_the_same_pixels(tmp_path):
    (tmp_path / "cameras.xml").write_text(mujoco_cameras([CAMERA]))
    text = f'<mujoco><worldbody><include file="{tmp_path}/cameras.xml"/></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.camera("head left").id == 0
    assert model.cam_resolution[0].tolist() == [64, 48]
    scene, camera = mujoco.MjvScene(model, 10), mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, scene)
    # The frustum of MuJoCo's renderer, and its camera's pose.
    view = scene.camera[0]
    x, y, z = ((visible_points() - data.cam_xpos[0]) @ data.cam_xmat[0].reshape(3, 3)).T
    left = view.frustum_center - view.frustum_width
    u = 64 * (view.frustum_near * x / -z - left) / (2.0 * view.frustum_width)
    height = view.frustum_top - view.frustum_bottom
    v = 48 * (view.frustum_top - view.frustum_near * y / -z) / height
    # MuJoCo's pixels start at the image corner, half a pixel before the first centre.
    expected = CAMERA.project(visible_points())[0]
    np.testing.assert_allclose(np.column_stack([u, v]) - 0.5, expected, atol=1e-3)
