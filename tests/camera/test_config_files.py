"""Cameras in Drake's own YAML, against Drake's own cameras of the same files."""

import numpy as np
import pytest
from pydrake.common.yaml import yaml_load_typed
from pydrake.systems.sensors import CameraConfig

from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.drake import (
    camera_from_drake,
    camera_to_config,
    dump_scenario,
    save_scenario,
)
from drake_pose.camera.models import ParallelCamera, PinholeCamera, circle_of_cameras
from drake_pose.errors import CameraError

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


def write(folder, text):
    path = folder / "cameras.yaml"
    path.write_text(text)
    return path


def require_same(camera, config):
    """A camera is what Drake itself makes of a CameraConfig."""
    color, _ = config.MakeCameras()
    X_PB = config.X_PB.GetDeterministicValue()
    expected = camera_from_drake(camera.name, color.core(), X_PB)
    np.testing.assert_allclose(camera.kernel_parameters(), expected.kernel_parameters())
    np.testing.assert_allclose(camera.X_WC, expected.X_WC, atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [FRONT, f"any:\n{indented(FRONT, 2)}", f"cameras:\n  any:\n{indented(FRONT, 4)}",
     f"Demo:\n  cameras:\n    any:\n{indented(FRONT, 6)}"],
)  # fmt: skip
def test_a_config_is_known_wherever_it_stands(text, tmp_path):
    cameras = load_cameras(write(tmp_path, text))
    assert list(cameras) == ["front"]
    assert isinstance(cameras["front"], PinholeCamera)
    require_same(cameras["front"], yaml_load_typed(schema=CameraConfig, data=FRONT))


def test_a_scenario(tmp_path):
    cameras = load_cameras(write(tmp_path, SCENARIO))
    assert list(cameras) == ["front", "side", "plain"]
    side, plain = cameras["side"], cameras["plain"]
    assert isinstance(side, PinholeCamera)
    assert isinstance(plain, PinholeCamera)
    assert (side.focal_x, side.focal_y, side.center_x) == (500.0, 500.0, 300.0)
    require_same(plain, CameraConfig())


def test_round_trip(tmp_path):
    written = circle_of_cameras(5, size=(320, 240))
    rng = np.random.default_rng(0)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    X_WC = np.eye(4)
    X_WC[:3, :3], X_WC[:3, 3] = R * np.linalg.det(R), rng.normal(size=3)
    written["odd"] = PinholeCamera("odd", 64, 48, 60.0, 1.5, 1 / 3, 23.5, X_WC, near=300.0)
    save_scenario(tmp_path / "scenario.yaml", written)
    read = load_cameras(tmp_path / "scenario.yaml")
    assert list(read) == list(written)
    for name, camera in read.items():
        expected = written[name].kernel_parameters()
        np.testing.assert_allclose(camera.kernel_parameters(), expected, rtol=1e-14)
        np.testing.assert_allclose(camera.X_WC, written[name].X_WC, atol=1e-14)
        # Drake makes cameras of what was written.
        require_same(written[name], camera_to_config(written[name]))
    assert "label: true" in dump_scenario(written)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("base_frame: world", "base_frame: 'iiwa::link7'", "'front'.*'iiwa::link7'.*in the world"),
        ("!Rpy {deg: [-100, 10, 30]}", "!Uniform {}", "'front': X_PB is drawn by lot"),
        ("[1, 2, 3]", "!UniformVector {min: [0, 0, 0], max: [1, 1, 1]}", "drawn by lot"),
        ("width: 320", "width: -3", "width must be"),
        ("width: 320", "widht: 320", "no CameraConfig.*widht"),
        ("{y: 40}", "{y: 0}", "focal"),
        ("!FovDegrees {y: 40}", "{}", "'front': no CameraConfig.*FocalLength"),
        ("!FovDegrees {y: 40}", "[500]", r"'front': no CameraConfig: .*fields, not \[500\]"),
        ("[1, 2, 3]", "[1, 2]", "no CameraConfig"),
        ("[1, 2, 3]", "[1, .nan, 3]", "not finite"),
        ("clipping_near: 0.2", "clipping_near: 0", "near"),
        ("name: front", "name: ../up", "camera's name"),
        ("label: true", "label: true\nX_WC: 3", "needs center_x"),
    ],
)
def test_what_a_camera_cannot_be(old, new, message, tmp_path):
    with pytest.raises(CameraError, match=message) as raised:
        load_cameras(write(tmp_path, f"front:\n{indented(FRONT.replace(old, new), 2)}"))
    assert "cameras.yaml" in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cameras: [1]", "mapping from names"),
        ("cameras: {}", "mapping from names"),
        ("cameras: {a: 3}", "'a'.*fields of a CameraConfig"),
        ("cameras: {a: {name: c}, b: {name: c}}", "'c' is given twice"),
        ("One: {cameras: {a: {}}}\nTwo: {cameras: {a: {}}}", "several scenarios .One, Two."),
    ],
)
def test_scenarios_that_cannot_be_read(text, message, tmp_path):
    with pytest.raises(CameraError, match=message):
        load_cameras(write(tmp_path, text))


def test_cameras_that_drake_does_not_know():
    parallel = ParallelCamera("above", 10, 10, 5.0, 5.0, 5.0, np.eye(4))
    with pytest.raises(CameraError, match=r"'above'.*parallel"):
        dump_scenario([parallel])
    outside = PinholeCamera("off", 10, 10, 5.0, 5.0, -3.0, 5.0, np.eye(4))
    with pytest.raises(CameraError, match=r"'off'.*principal point"):
        dump_scenario([outside])
