"""Files with poses of cameras alone, in the formats of the tools that write them."""

import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.camera.camera_files import intrinsics_of, load_camera_file, load_cameras
from drake_pose.camera.exchange import ros_camera_info, ros_transforms
from drake_pose.camera.models import PinholeCamera, inverse_pose
from drake_pose.camera.pose_files import END_EFFECTOR
from drake_pose.errors import CameraError

X = np.eye(4)
X[:3, :3] = Rotation.from_euler("xyz", [-2.3, 0.1, 2.2]).as_matrix()
X[:3, 3] = [0.71, -0.97, 1.13]
CAMERA = PinholeCamera("left", 1280, 720, 640.0, 642.0, 639.5, 359.5, X)
PLACE = dict(zip("xyz", X[:3, 3].tolist(), strict=True))
QUATERNION = Rotation.from_matrix(X[:3, :3]).as_quat().tolist()
Q = dict(zip(("qx", "qy", "qz", "qw"), QUATERNION, strict=True))
TURN = dict(zip("xyzw", QUATERNION, strict=True))
RVEC = Rotation.from_matrix(X[:3, :3]).as_rotvec().tolist()
SIX = [*X[:3, 3].tolist(), *Rotation.from_matrix(X[:3, :3]).as_euler("xyz").tolist()]
# ROS: a camera's link has x forward, y left and z up.
X_LINK = X.copy()
X_LINK[:3, :3] = X[:3, :3] @ np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
LINK_Q = Rotation.from_matrix(X_LINK[:3, :3]).as_quat().tolist()
FRAMES = {"robot_base_frame": "base_link", "robot_effector_frame": "tool0"}
EASY = {"eye_on_hand": False, "tracking_base_frame": "camera_color_optical_frame", **FRAMES}
MOVED = {"translation": PLACE, "rotation": TURN}
SAME = {"translation": dict.fromkeys("xyz", 0.0), "rotation": dict.fromkeys("xyz", 0.0) | {"w": 1}}
LAUNCH = """<launch>
  <!-- xyz="0 0 0" rpy="0 0 0" -->
  <node pkg="tf2_ros" type="static_transform_publisher" name="camera_link_broadcaster"
      args="{}   {} {} {}" />
</launch>
"""


def easy(rotation=QUATERNION, **parameters):
    pose = PLACE | dict(zip(Q, rotation, strict=True))
    return {"parameters": EASY | parameters, "transformation": pose}


def launch(rotation, child, period="", parent="base"):
    words = " ".join(f"{x:.17g}" for x in [*X[:3, 3], *rotation])
    return LAUNCH.format(words, parent, child, period)


def transform(parent, child, moved):
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": moved}


@pytest.fixture
def scene(tmp_path):
    """Intrinsics of one camera, as the recording's cameras.yaml has them."""
    file = tmp_path / "intrinsics.yaml"
    file.write_text(ros_camera_info(CAMERA))
    return file


def load(path, content, intrinsics, recording=None):
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    known = intrinsics_of(path.with_name("cameras.yaml"), intrinsics)
    return load_camera_file(path, known=known, recording=recording)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("easy.yaml", easy()),
        ("easy.yaml", EASY | {"transformation": PLACE | Q}),
        (
            "easy.calib",
            {"parameters": EASY | {"calibration_type": "eye_on_base"}, "transform": MOVED},
        ),
        ("easy.yaml", easy(LINK_Q, tracking_base_frame="camera_link")),
        ("pose.launch", launch(QUATERNION, "cam_optical")),
        ("pose.launch", launch(LINK_Q, "camera_link")),
        ("pose.launch", launch(SIX[:2:-1], "cam_optical", "100")),
        (
            "pose.launch.py",
            "Node(package='tf2_ros', executable='static_transform_publisher', arguments=["
            + ", ".join(f"'{x!r}'" for x in [*X[:3, 3].tolist(), *QUATERNION])
            + ", 'base', 'cam_optical'])",
        ),
        ("pose.launch.xml", ros_transforms([CAMERA], {"left": "base"})),
        (
            "tf.yaml",
            {
                "transforms": [
                    transform("base", "mount", MOVED),
                    transform("mount", "camera_optical_frame", SAME),
                ]
            },
        ),
        ("six.json", {"left": SIX}),
        ("six.json", {"left": [*SIX[:3], *np.degrees(SIX[3:]).tolist()]}),
        ("seven.yaml", {"left": [*SIX[:3], *QUATERNION]}),
        ("matrix.yaml", {"left": X.tolist()}),
        ("matrix.yaml", {"left": {"X_WC": X.tolist()}}),
        ("matrix.yaml", {"left": {"T_base_cam": X[:3].tolist()}}),
        ("matrix.yaml", {"left": {"T_cam2base": X.ravel().tolist()}}),
        ("matrix.yaml", {"left": {"T_cam_base": inverse_pose(X).tolist()}}),
        ("matrix.yaml", {"left": {"world_to_camera": inverse_pose(X).tolist()}}),
        ("matrix.yaml", {"T_base_camera": X.round(3).tolist()}),
        (
            "parts.yaml",
            {"left": {"position": SIX[:3], "quat_wxyz": [QUATERNION[3], *QUATERNION[:3]]}},
        ),
        ("parts.yaml", {"left": {"translation": SIX[:3], "rotation": X[:3, :3].tolist()}}),
        ("parts.yaml", {"left": {"tvec": SIX[:3], "rvec": RVEC}}),
        ("parts.yaml", {"left": PLACE | dict(zip(("roll", "pitch", "yaw"), SIX[3:], strict=True))}),
        ("parts.yaml", {"left": {"xyz": SIX[:3], "rpy_deg": np.degrees(SIX[3:]).tolist()}}),
        ("parts.yaml", {"left": {"xyz": SIX[:3], "rpy": SIX[3:]}}),
    ],
)
def test_poses_without_intrinsics_are_read(tmp_path, scene, name, content):
    found = load(tmp_path / name, content, scene)
    rounded = 1e-3 if name == "matrix.yaml" and "T_base_camera" in content else 1e-9
    (camera,) = found.cameras.values()
    np.testing.assert_allclose(camera.X_WC, X, atol=rounded)
    assert (camera.name, camera.focal_x, camera.width) == ("left", 640.0, 1280)
    assert not found.links
    assert not found.unplaced


def test_a_camera_on_the_hand_has_its_link(tmp_path, scene):
    for name, content, link in (
        ("easy.yaml", easy(eye_on_hand=True), "tool0"),
        ("easy.yaml", easy(eye_on_hand=True, robot_effector_frame=""), END_EFFECTOR),
        ("pose.launch", launch(QUATERNION, "cam_optical", parent="tool0"), "tool0"),
    ):
        assert load(tmp_path / name, content, scene).links == {"left": link}


def test_files_of_many_episodes_give_the_recordings_own(tmp_path):
    """KarlP/droid and DROID-3D: keyed by episode ID and serial number, or one line each."""
    own, serial = "AUTOLab+0d4edc83+2023-10-27-20h-12m-58s", "22008760"
    recording = tmp_path / "episode"
    recording.mkdir()
    roles = {"uuid": own, "ext1_cam_serial": serial, "ext2_cam_serial": "24400334"}
    (recording / f"metadata_{own}.json").write_text(json.dumps(roles))
    other = [*np.add(SIX[:3], 1.0).tolist(), *SIX[3:]]
    poses = {
        "RAIL+1+2023": {serial: other, f"{serial}_quality_metric": 0.9},
        own: {serial: SIX, f"{serial}_metric_type": "iou", "relative_path": "AUTOLab/success"},
    }
    lenses = {
        "RAIL+1+2023": {serial: [1.0, 2.0, 3.0, 4.0]},
        own: {serial: [530.0, 640.0, 531.0, 360.0]},
    }
    (tmp_path / "intrinsics.json").write_text(json.dumps(lenses))
    (tmp_path / "cam2base_extrinsics.json").write_text(json.dumps(poses))
    known = intrinsics_of(recording / "cameras.yaml", tmp_path / "intrinsics.json")
    found = load_cameras(tmp_path / "cam2base_extrinsics.json", known, recording)
    np.testing.assert_allclose(found[serial].X_WC, X, atol=1e-9)
    assert (found[serial].focal_y, found[serial].center_x) == (531.0, 640.0)
    with pytest.raises(CameraError, match="has 2 entries, from RAIL"):
        load_cameras(tmp_path / "cam2base_extrinsics.json", known, tmp_path)

    view = {"T0_ext1_in_world": inverse_pose(X).tolist(), "T1_ext2_in_world": np.eye(4).tolist()}
    lines = [{"episode_uuid": "RAIL+1+2023", **view}, {"episode_uuid": own, **view}]
    left = {"fx": 530.0, "fy": 531.0, "cx": 640.0, "cy": 360.0, "width": 1280, "height": 720}
    cameras = {"ext1": {"serial": serial, "left": left, "stereo_baseline_m": 0.12}}
    calibrated = [
        {"episode_uuid": "RAIL+1+2023", "cameras": {}},
        {"episode_uuid": own, "cameras": cameras},
    ]
    for name, records in (("extrinsics", lines), ("camera_intrinsics", calibrated)):
        (tmp_path / f"{name}.jsonl").write_text("\n".join(map(json.dumps, records)) + "\n")
    known = intrinsics_of(recording / "cameras.yaml", tmp_path / "camera_intrinsics.jsonl")
    again = load_cameras(tmp_path / "extrinsics.jsonl", known, recording)
    np.testing.assert_allclose(again[serial].X_WC, X, atol=1e-9)
    assert again[serial].focal_y == 531.0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"left": SIX}, ["has poses (left)", "--intrinsics FILE"]),
        (easy(), ["camera_color_optical_frame"]),
        ({"left": [*SIX[:3], 0.5, 0.5, 0.5, 0.9]}, ["camera 'left'", "length 1.25"]),
        ({"left": {"X_WC": (2.0 * X).tolist()}}, ["a pinhole camera needs width"]),
        ({"left": {"t": SIX[:3], "R": (1.2 * X[:3, :3]).tolist()}}, ["not a rotation"]),
        ({"left": {"speed": 3}}, ["easy_handeye", "cam2base_extrinsics.json", "NAME: POSE"]),
    ],
)
def test_what_is_wanted_is_said(tmp_path, content, words):
    with pytest.raises(CameraError) as caught:
        load(tmp_path / "cameras.json", content, None)
    for word in words:
        assert word in str(caught.value)


def test_a_pose_of_no_camera_is_refused(tmp_path):
    intrinsics = tmp_path / "two.yaml"
    entry = {"width": 1280, "height": 720, "fx": 640, "fy": 642, "cx": 639.5, "cy": 359.5}
    intrinsics.write_text(yaml.safe_dump({"left": entry, "right": entry}))
    with pytest.raises(CameraError, match="cameras are left, right: name them alike") as caught:
        load(tmp_path / "easy.yaml", easy(), intrinsics)
    assert "--camera NAME" in str(caught.value)


def test_what_was_assumed_is_said(tmp_path, scene):
    for content, text in (
        ({"left": SIX}, "roll, pitch, yaw [rad]"),
        ({"left": [*SIX[:3], *QUATERNION]}, "read as x, y, z, w"),
        ({"left": X.tolist()}, ""),
    ):
        found = load(tmp_path / "poses.yaml", content, scene)
        assert bool(found.warnings) == bool(text)
        assert text in "".join(found.warnings)
