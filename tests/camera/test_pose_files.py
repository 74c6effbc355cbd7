"""Files with poses of cameras alone, in the formats of the tools that write them."""

import codecs
import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.camera.camera_files import CameraFile, intrinsics_of, load_camera_file, load_cameras
from drake_pose.camera.exchange import (
    dump_scenario,
    mujoco_cameras,
    ros_camera_info,
    ros_transforms,
)
from drake_pose.camera.models import PinholeCamera, inverse_pose
from drake_pose.camera.pose_files import END_EFFECTOR, choose_frames
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
ANGLES = dict(zip(("roll", "pitch", "yaw"), SIX[3:], strict=True))
# ROS: a camera's link has x forward, y left and z up.
X_LINK = X.copy()
X_LINK[:3, :3] = X[:3, :3] @ np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
LINK_Q = Rotation.from_matrix(X_LINK[:3, :3]).as_quat().tolist()
EASY = {
    "eye_on_hand": False, "tracking_base_frame": "camera_color_optical_frame",
    "robot_base_frame": "base_link", "robot_effector_frame": "tool0",
}  # fmt: skip
MOVED = {"translation": PLACE, "rotation": TURN}
SAME = {"translation": dict.fromkeys("xyz", 0.0), "rotation": dict.fromkeys("xyz", 0.0) | {"w": 1}}
LAUNCH = """<launch><!-- xyz="0 0 0" -->
  <node pkg="tf2_ros" type="static_transform_publisher" name="broadcaster" args="{}  {} {} {}" />
</launch>"""
PUBLISHER = (
    "executable='static_transform_publisher'",
    f"arguments=[{', '.join(repr(str(x)) for x in SIX[:3])}, {str(QUATERNION)[1:-1]}, "
    "'base', \"cam\"]",
)
ECHO = f"""[INFO] [17.2]: Waiting for transform base ->  cam: Invalid frame ID
At time 17.5
- Translation: {np.round(SIX[:3], 4).tolist()}
- Rotation: in Quaternion (xyzw) {np.round(QUATERNION, 4).tolist()}
- Rotation: in RPY (radian) {np.round(SIX[3:], 3).tolist()}
"""
PLAIN = {"rotation_matrix": X[:3, :3].tolist(), "translation_vector": SIX[:3]}
POST = np.eye(4)
POST[:3, 3] = [0.2, 0.0, 0.5]
ON_POST = inverse_pose(POST) @ X
VIEWER = (
    f'pos="{" ".join(map(str, SIX[:3]))}" '
    f'xyaxes="{" ".join(map(str, (X * [1, -1, -1, 1])[:3, :2].T.ravel()))}"'
)


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


def saved(save, *arrays, **named):
    """Return the bytes of arrays as NumPy writes them."""
    file = io.BytesIO()
    save(file, *arrays, **named)
    return file.getvalue()


def urdf(*joints):
    """Return a URDF of joints (parent, child, pose and, unless it is fixed, type)."""
    text = ""
    for parent, child, pose, *kind in joints:
        xyz, rpy = pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
        origin = " ".join(f'{k}="{x} {y} {z}"' for k, (x, y, z) in {"xyz": xyz, "rpy": rpy}.items())
        ends = f'<parent link="{parent}"/><child link="{child}"/><origin {origin}/>'
        text += f'<joint name="{child}_joint" type="{(kind or ["fixed"])[0]}">{ends}</joint>'
    return f'<?xml version="1.0"?>\n<robot name="arm">{text}</robot>'


def mjcf(camera, body="<body><geom/>{}</body>"):
    return f"<mujoco><worldbody>{body.format(f'<camera {camera}/>')}</worldbody></mujoco>"


def load(path, content, intrinsics, recording=None):
    if not isinstance(content, str | bytes):
        content = (json.dumps if path.suffix == ".json" else yaml.safe_dump)(content)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    known = intrinsics_of(path.with_name("cameras.yaml"), intrinsics)
    return load_camera_file(path, known=known, recording=recording)


FORMS = {
    "six": SIX, "six, deg": [*SIX[:3], *np.degrees(SIX[3:]).tolist()],
    "seven": [*SIX[:3], *QUATERNION], "matrix": X.tolist(), "X_WC": {"X_WC": X.tolist()},
    "3 x 4": {"T_base_cam": X[:3].tolist()}, "flat": {"T_cam2base": X.ravel().tolist()},
    "inverse": {"T_cam_base": inverse_pose(X).tolist()},
    "view": {"world_to_camera": inverse_pose(X).tolist()},
    "wxyz": {"position": SIX[:3], "quat_wxyz": [QUATERNION[3], *QUATERNION[:3]]},
    "R, t": {"translation": SIX[:3], "rotation": X[:3, :3].tolist()},
    "R by names": {"t": PLACE, "rotation": ANGLES},
    "rvec": {"tvec": SIX[:3], "rvec": RVEC},
    "angles": PLACE | ANGLES,
    "rpy_deg": {"xyz": SIX[:3], "rpy_deg": np.degrees(SIX[3:]).tolist()},
    "rpy": {"xyz": SIX[:3], "rpy": SIX[3:]},
}  # fmt: skip
FRAMES = [transform("base", "mount", MOVED), transform("mount", "camera_optical_frame", SAME)]
REALSENSE = urdf(
    ("base", "camera_link", X_LINK), ("camera_link", "camera_depth_optical_frame", POST),
    ("camera_link", "camera_color_optical_frame", inverse_pose(X_LINK) @ X),
)  # fmt: skip
FILES = [
    *((f"{name}.json", {"left": form}) for name, form in FORMS.items()), ("easy.yaml", easy()),
    ("easy.yaml", EASY | {"transformation": PLACE | Q}),
    ("easy.calib", {"parameters": EASY | {"calibration_type": "eye_on_base"}, "transform": MOVED}),
    ("easy.yaml", easy(LINK_Q, tracking_base_frame="camera_link")),
    ("pose.launch", launch(QUATERNION, "cam_optical")),
    ("pose.launch", launch(LINK_Q, "camera_link")),
    ("pose.launch", launch(SIX[:2:-1], "cam_optical", "100")),
    ("pose.launch.xml", ros_transforms([CAMERA], {"left": "base"})),
    ("tf.yaml", {"transforms": FRAMES}),
    ("notepad.json", codecs.BOM_UTF8 + json.dumps({"left": SIX}).encode()),
    ("rounded.yaml", {"T_base_camera": X.round(3).tolist()}), ("rounded.txt", 2 * ECHO),
    ("one.npy", saved(np.save, X)), ("frames.npy", saved(np.save, np.repeat(X[None], 9, 0))),
    ("named.npz", saved(np.savez, left=X)), ("first.npz", saved(np.savez, X[:3])),
    ("cv2.npz", saved(np.savez, R_cam2base=X[:3, :3], t_cam2base=X[:3, 3:])),
    ("front.txt", saved(np.savetxt, X)),
    ("front.csv", saved(np.savetxt, X[:3], delimiter=",", header="X_WC of left")),
    ("agibot.json", 3 * [{"extrinsic": PLAIN}]), ("list.json", [{"camera": "left", **PLAIN}]),
    ("list.json", [X.tolist()]),
    ("list.json", [{"cam_id": "a", "pose": POST.tolist()}, {"cam_id": "left", "pose": SIX}]),
    ("post.urdf", urdf(("base", "post", POST), ("post", "cam_optical", ON_POST))),
    ("link.urdf", urdf(("base", "post", POST), ("post", "camera", inverse_pose(POST) @ X_LINK))),
    ("realsense.urdf", REALSENSE), ("mujoco.xml", mujoco_cameras([CAMERA])),
    ("viewer.xml", mjcf(VIEWER)),
    ("fovy.xml", mjcf(f'name="left" {VIEWER} resolution="1280 720" fovy="58.71550708"')),
    *(
        ("pose.launch.py", f"LaunchDescription([Node(package='tf2_ros', {', '.join(words)})])")
        for words in (PUBLISHER, PUBLISHER[::-1])
    ),
]  # fmt: skip
WRIST = mjcf('name="left"', '<body name="tool0"><joint/><body>{}</body></body>')
CV2 = saved(np.savez, R_cam2gripper=X[:3, :3], t_cam2gripper=X[:3, 3])
ON_LINKS = [
    ("easy.yaml", easy(eye_on_hand=True), "tool0"),
    ("easy.yaml", easy(eye_on_hand=True, robot_effector_frame=""), END_EFFECTOR),
    ("pose.launch", launch(QUATERNION, "cam_optical", parent="tool0"), "tool0"),
    ("cv2.npz", CV2, END_EFFECTOR),
    ("mujoco.xml", mujoco_cameras([CAMERA], {"left": "tool0"}), "tool0"),
    ("arm.xml", WRIST, "tool0"),
    ("drake.yaml", dump_scenario([CAMERA], {"left": "tool0"}), "tool0"),
    ("a.urdf", urdf(("base", "tool0", X, "revolute"), ("tool0", "cam_optical", X)), "tool0"),
]


@pytest.mark.parametrize(("name", "content", "link"), [*((*file, "") for file in FILES), *ON_LINKS])
def test_poses_are_read(tmp_path, scene, name, content, link):
    """In the world, or on a link."""
    found = load(tmp_path / name, content, scene)
    (camera,) = found.cameras.values()
    atol = 1e-3 if name.startswith("rounded") else 1e-9
    X_C = np.diag([1, -1, -1, 1]) if content is WRIST else X
    np.testing.assert_allclose(camera.X_WC, X_C, atol=atol)
    assert (camera.name, camera.width) == ("left", 1280)
    assert camera.focal_x == pytest.approx(640.0)
    assert (found.links, found.unplaced) == ({"left": link} if link else {}, ())


def test_files_of_many_episodes_give_the_recordings_own(tmp_path):
    """KarlP/droid and DROID-3D: keyed by episode ID and serial number, or one line each."""
    own, serial = "AUTOLab+0d4edc83+2023-10-27-20h-12m-58s", "22008760"
    recording = tmp_path / "episode"
    recording.mkdir()
    roles = {"uuid": own, "ext1_cam_serial": serial, "ext2_cam_serial": "24400334"}
    (recording / f"metadata_{own}.json").write_text(json.dumps(roles))
    other = {serial: [*np.add(SIX[:3], 1.0).tolist(), *SIX[3:]], f"{serial}_quality_metric": 0.9}
    right = {serial: SIX, f"{serial}_metric_type": "iou", "relative_path": "AUTOLab/success"}
    poses = {"RAIL+1+2023": other, own: right}
    lenses = {
        "RAIL+1+2023": {serial: [1.0, 2.0, 3.0, 4.0]}, own: {serial: [530.0, 640.0, 531.0, 360.0]}
    }  # fmt: skip
    files = {"camera_intrinsics.json": json.dumps(lenses), "extrinsics.json": json.dumps(poses)}
    view = {"T0_ext1_in_world": inverse_pose(X).tolist(), "T1_ext2_in_world": np.eye(4).tolist()}
    lines = [{"episode_uuid": "RAIL+1+2023", **view}, {"episode_uuid": own, **view}]
    left = {"fx": 530.0, "fy": 531.0, "cx": 640.0, "cy": 360.0, "width": 1280, "height": 720}
    cameras = {"ext1": {"serial": serial, "left": left, "stereo_baseline_m": 0.12}}
    calibrated = [{"episode_uuid": "RAIL+1+2023", "cameras": {}}]
    calibrated += [{"episode_uuid": own, "cameras": cameras}]
    for name, records in (("extrinsics", lines), ("camera_intrinsics", calibrated)):
        files[f"{name}.jsonl"] = "\n".join(map(json.dumps, records)) + "\n"
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    for suffix in ("json", "jsonl"):
        given = tmp_path / f"camera_intrinsics.{suffix}", tmp_path / f"extrinsics.{suffix}"
        known = intrinsics_of(recording / "cameras.yaml", given[0])
        found = load_cameras(given[1], known, recording)[serial]
        np.testing.assert_allclose(found.X_WC, X, atol=1e-9)
        assert (found.focal_y, found.center_x) == (531.0, 640.0)
        with pytest.raises(CameraError, match="has 2 entries, from RAIL"):
            load_cameras(given[1], known, tmp_path)


def test_what_is_wanted_is_said(tmp_path):
    for content, words in (
        ({"left": SIX}, ["has poses (left)", "--intrinsics FILE"]),
        (easy(), ["camera_color_optical_frame"]),
        ({"left": [*SIX[:3], 0.5, 0.5, 0.5, 0.9]}, ["camera 'left'", "length 1.25"]),
        ([{"extrinsic": PLAIN}, {"pose": X_LINK.tolist()}], ["2 poses without the names"]),
        ({"left": {"t": SIX[:3], "R": (1.2 * X[:3, :3]).tolist()}}, ["not a rotation"]),
        ({"rvecs": [[0.1, 0.2, 0.3], [1.0, 1.1, 1.2]]}, ["it has rvecs. Tried"]),
        ({"left": {"speed": 3}}, ["it has left. Tried", "easy_handeye", "NAME: POSE"]),
        (mjcf('name="a" mode="targetbody" target="b"'), ["camera 'a': its mode targetbody"]),
    ):
        with pytest.raises(CameraError) as caught:
            load(tmp_path / "cameras.json", content, None)
        for word in words:
            assert word in str(caught.value)


@pytest.mark.parametrize("kind", ["npz", "opencv.json", "urdf"])
def test_the_recording_says_size_and_name_of_its_camera(tmp_path, kind):
    (tmp_path / "masks" / "front").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "masks" / "front" / "0.png"), np.zeros((720, 1280), np.uint8))
    K, path = [[640.0, 0.0, 639.5], [0.0, 642.0, 359.5], [0.0, 0.0, 1.0]], tmp_path / f"a.{kind}"
    X_CW = inverse_pose(X)
    turned = {"camera_matrix": K, "R": X_CW[:3, :3].tolist(), "T": X_CW[:3, 3].tolist()}
    given = {"camera_matrix": K, "dist_coeffs": np.zeros(5), "T_base_cam": X}
    contents = {"npz": saved(np.savez, **given), "opencv.json": json.dumps(turned).encode()}
    path.write_bytes(contents.get(kind, urdf(("base", "front", X)).encode()))
    front = load_cameras(path, lambda: CameraFile({"front": CAMERA}, ()), tmp_path)["front"]
    np.testing.assert_allclose(front.X_WC, X, atol=1e-9)
    assert (front.name, front.width, front.focal_y) == ("front", 1280, 642)


def test_a_pose_of_no_camera_is_refused(tmp_path):
    intrinsics = tmp_path / "two.yaml"
    entry = {"width": 1280, "height": 720, "fx": 640, "fy": 642, "cx": 639.5, "cy": 359.5}
    intrinsics.write_text(yaml.safe_dump({"left": entry, "right": entry}))
    with pytest.raises(CameraError, match="cameras are left, right: name them alike"):
        load(tmp_path / "easy.yaml", easy(), intrinsics)


def test_each_camera_has_the_best_of_its_frames():
    """Whatever the order in the file; equally good ones are refused."""
    for frames, cameras, chosen in (
        ("cam_link cam cam_color_optical_frame", "cam b", {"cam": "cam"}),
        ("a_depth_optical_frame a_rgb_frame a_link", "cam", {"cam": "a_rgb_frame"}),
        ("a_link a_infra1_optical_frame b", "A b", {"A": "a_infra1_optical_frame", "b": "b"}),
        ("7 7_left 7_right", "7_left 7_right", {"7_left": "7_left", "7_right": "7_right"}),
        ("7_left 7_link", "7", {"7": "7_left"}),
        ("a_link b_link", "cam", {}),
        ("a_link", "A a_base", {}),
        ("a_left_optical_frame a_right_optical_frame", "a", None),
        ("c_frame a_depth_link a_link", "a c", None),
    ):
        for given in (frames.split(), frames.split()[::-1]):
            if chosen is None:
                with pytest.raises(CameraError, match="equally good names of camera 'a'"):
                    choose_frames(given, cameras.split(), Path())
            else:
                assert choose_frames(given, cameras.split(), Path()) == chosen


def test_what_was_assumed_is_said(tmp_path, scene):
    for content, text in (
        ({"left": SIX}, "roll, pitch, yaw [rad]"),
        ({"left": [*SIX[:3], *QUATERNION]}, "read as x, y, z, w"),
        ({"left": [*SIX[:3], 7.0, 0.0, 0.0]}, "roll, pitch, yaw [deg]"),
        ({"left": {"t": SIX[:3], "rotation": RVEC}}, "rotation vector [rad]"),
        *(({"left": FORMS[form]}, "") for form in ("matrix", "R by names", "wxyz", "rvec")),
        *(({"left": {"t": SIX[:3], "rotation": turn}}, "") for turn in (TURN, Q)),
        (ECHO, "as tf2_echo BASE CAMERA prints"),
    ):
        found = load(tmp_path / "poses.yaml", content, scene)
        assert bool(found.warnings) == bool(text)
        assert text in "".join(found.warnings)
