"""Bags written by rosbags, of ROS 1 and both kinds of ROS 2."""

from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.episode_files import open_episode
from drake_pose.errors import SceneError
from tests.camera.recordings import (
    GRID,
    SIDE,
    K,
    distorted,
    number_of,
    numbered,
    shade,
)

COUNT, START = 12, 1_700_000_000 * 10**9
PLUMB = (-0.2, 0.05, 1e-3, -2e-3, 0.0)
KINDS = ("ros1", "sqlite3", "mcap")
NONE = np.zeros(0)


class Bag:
    """Writes sensor messages into a bag; times are in [s] after START."""

    def __init__(self, folder, kind):
        from rosbags import rosbag1, rosbag2, typesys

        self.is1, stores = kind == "ros1", typesys.Stores
        self.path = folder / ("a.bag" if self.is1 else kind)
        self.store = typesys.get_typestore(stores.ROS1_NOETIC if self.is1 else stores.LATEST)
        self.topics: dict[str, Any] = {}
        if self.is1:
            text, name = "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
            self.store.register(typesys.get_types_from_msg(text, name))
            self.writer: Any = rosbag1.Writer(self.path)
        else:
            plugin = rosbag2.StoragePlugin[kind.upper()]
            self.writer = rosbag2.Writer(self.path, version=9, storage_plugin=plugin)

    def new(self, kind, /, **fields):
        return self.store.types[kind](**fields)

    def header(self, time, frame=""):
        stamp = START + round(1e9 * time) if np.isfinite(time) else 0
        parts = {"sec": stamp // 10**9, "nanosec": stamp % 10**9}
        own = {"seq": 0} if self.is1 else {}
        stamped = self.new("builtin_interfaces/msg/Time", **parts)
        return self.new("std_msgs/msg/Header", stamp=stamped, frame_id=frame, **own)

    def write(self, topic, kind, logged, **fields):
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.is1 else self.store.serialize_cdr
        data = pack(self.new(kind, **fields), kind)
        self.writer.write(self.topics[topic], START + round(1e9 * logged), data)

    def image(self, topic, time, picture, coding, logged=0.0):
        height, width = picture.shape[:2]
        padded = np.pad(picture.reshape(height, -1), ((0, 0), (0, 5)))
        fields = {"height": height, "width": width, "encoding": coding, "is_bigendian": 0}
        fields |= {"header": self.header(time, "lens"), "step": padded.shape[1]}
        self.write(topic, "sensor_msgs/msg/Image", logged, data=padded.ravel(), **fields)

    def compressed(self, topic, time, number, kind="jpeg"):
        data = cv2.imencode(".jpg", numbered(number)[:, :, ::-1])[1].ravel()
        fields = {"header": self.header(time, "lens"), "format": kind, "data": data}
        self.write(topic, "sensor_msgs/msg/CompressedImage", time, **fields)

    def joints(self, topic, time, **positions):
        fields = {"header": self.header(time), "name": [*positions], "velocity": NONE}
        fields |= {"position": np.array([*positions.values()], dtype=float), "effort": NONE}
        self.write(topic, "sensor_msgs/msg/JointState", time, **fields)

    def info(self, topic, model, D, P=(0.0,) * 12):
        sides = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        region = self.new("sensor_msgs/msg/RegionOfInterest", do_rectify=False, **sides)
        fields = {"header": self.header(0.0), "height": SIDE, "width": SIDE, "roi": region}
        fields |= {"distortion_model": model, "binning_x": 0, "binning_y": 0}
        for name, one in {"d": D, "k": K.ravel(), "r": np.eye(3).ravel(), "p": P}.items():
            fields[name.upper() if self.is1 else name] = np.array(one, dtype=float)
        self.write(topic, "sensor_msgs/msg/CameraInfo", 0.0, **fields)

    def mount(self, parent, child, X):
        q = Rotation.from_matrix(X[:3, :3]).as_quat()
        named = dict(zip("xyz", X[:3, 3], strict=True)), dict(zip("xyzw", q, strict=True))
        p = self.new("geometry_msgs/msg/Vector3", **named[0])
        q = self.new("geometry_msgs/msg/Quaternion", **named[1])
        pose = self.new("geometry_msgs/msg/Transform", translation=p, rotation=q)
        fields = {"header": self.header(0.0, parent), "child_frame_id": child, "transform": pose}
        one = self.new("geometry_msgs/msg/TransformStamped", **fields)
        self.write("/tf_static", "tf2_msgs/msg/TFMessage", 0.0, transforms=[one])


def pose(seed):
    X = np.eye(4)
    X[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    X[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return X


@pytest.mark.parametrize("kind", KINDS)
def test_hand_camera_and_joints_of_two_publishers(tmp_path, kind):
    bag = Bag(tmp_path, kind)
    with bag.writer:
        bag.info("/hand/camera_info", "plumb_bob", PLUMB)
        bag.mount("hand", "mount", pose(1))
        bag.mount("mount", "lens", pose(2))
        for k in range(COUNT):
            bag.image("/hand/image_raw", 0.1 * k, numbered(k), "rgb8", logged=0.1 * k + 0.03)
            bag.compressed("/hand/image_raw/compressed", 0.1 * k, k)
            bag.compressed("/side/compressed", 0.1 * k + 0.01, k + 100)
            bag.compressed("/depth/compressed", 0.1 * k, k, "16UC1; compressedDepth png")
        for k in range(60):
            bag.joints("/joint_states", 0.02 * k, elbow=0.5 * k, wrist=-0.5 * k)
            if k % 3 == 0:
                bag.joints("/joint_states", 0.02 * k + 0.007, finger=0.02 * k + 0.007)
            if k % 2 == 0:
                bag.joints("/other", 0.02 * k, elbow=99.0)
    episode = open_episode(bag.path)
    assert list(episode.cameras) == ["hand", "side"]
    hand, side, joints = episode.camera("hand"), episode.camera("side"), episode.joints
    np.testing.assert_allclose(hand.times, 1.7e9 + 0.1 * np.arange(COUNT), rtol=0, atol=1e-6)
    np.testing.assert_allclose(side.times - hand.times, 0.01, rtol=0, atol=1e-6)
    order = [*range(COUNT), 3, 3, 11, 0, 1]
    assert [number_of(side.read(k)) - 100 for k in order] == order
    np.testing.assert_array_equal(
        [hand.read_recorded(k) for k in order], [numbered(k) for k in order]
    )
    undistorted = cv2.undistort(numbered(5), K, np.array(PLUMB), None, hand.lens.undistorted_matrix)
    np.testing.assert_array_equal(hand.read(5), undistorted)
    assert hand.link == "hand"
    np.testing.assert_allclose(hand.camera.X_WC, pose(1) @ pose(2), rtol=0, atol=1e-9)
    assert (joints.names, joints.positions.shape) == (("elbow", "wrist", "finger"), (60, 3))
    np.testing.assert_allclose(joints.positions[:, 0], 0.5 * np.arange(60))
    np.testing.assert_allclose(
        joints.positions[1:58, 2], 0.02 * np.arange(1, 58), rtol=0, atol=1e-5
    )
    warnings = "\n".join(episode.warnings)
    assert "/other: also has joint elbow of /joint_states" in warnings
    assert "/side/compressed: no calibration in /camera_info" in warnings
    assert "depth" not in warnings


def test_images_of_all_encodings_are_decoded(tmp_path):
    bag, red, grey = Bag(tmp_path, "sqlite3"), numbered(0), np.full((SIDE, SIDE), 140, np.uint8)
    with bag.writer:
        bag.joints("/joint_states", 0.0, x=0.0)
        bag.image("/rgb", 0.0, red, "rgb8")
        bag.image("/bgr", 0.0, red[:, :, ::-1], "bgr8")
        bag.image("/bgra", 0.0, np.dstack([red[:, :, ::-1], grey]), "bgra8")
        bag.image("/mono", 0.0, grey, "mono8")
        for pattern in ("rggb", "bggr", "gbrg", "grbg"):
            place = np.tile(np.reshape(["rgb".index(c) for c in pattern], (2, 2)), (32, 32))
            mosaic = np.take_along_axis(red, place[:, :, None], axis=2)[:, :, 0]
            bag.image(f"/{pattern}", 0.0, mosaic, f"bayer_{pattern}8")
        bag.image("/strange", 0.0, grey, "bayer_rggb16")
        bag.image("/deep", 0.0, np.dstack([grey, grey]), "mono16")
        bag.image("/depth", 0.0, np.dstack([grey, grey]), "16UC1")
    episode = open_episode(bag.path)
    for name in ("rgb", "bgr", "bgra"):
        np.testing.assert_array_equal(episode.camera(name).read(0), red)
    np.testing.assert_array_equal(episode.camera("mono").read(0), np.dstack([grey] * 3))
    for pattern in ("rggb", "bggr", "gbrg", "grbg"):
        found = episode.camera(pattern).read(0).astype(int)
        assert np.abs(found - red)[2 : SIDE // 4 - 2, 2:-2].max() < 3, pattern
    assert not {"depth", "strange", "deep"} & set(episode.cameras)
    warnings = "\n".join(episode.warnings)
    assert "/strange is left out: bayer_rggb16 is not one of rgb8, bgr8" in warnings
    assert "/deep is left out: mono16 is not one of rgb8, bgr8" in warnings
    assert "/depth" not in warnings


def test_images_are_undistorted_by_their_lens_models(tmp_path):
    bag, P = Bag(tmp_path, "mcap"), [50, 0, 30, 0, 0, 51, 29, 0, 0, 0, 1, 0]
    rational = (-0.3, 0.1, 1e-3, -2e-3, 0.01, 0.05, 0.02, 0.003)
    fisheye = (0.1, -0.02, 0.003, -0.001)
    with bag.writer:
        bag.joints("/joint_states", 0.0, x=0.0)
        for name, model, D, is_fisheye in (
            ("rational", "rational_polynomial", rational, False),
            ("fish", "equidistant", fisheye, True),
            ("other", "thin_prism", fisheye, True),
        ):
            bag.info(f"/{name}/camera_info", model, D, P)
            bag.image(f"/{name}/image_raw", 0.0, distorted(D, is_fisheye), "mono8")
        bag.image("/fish/image_rect", 0.0, numbered(1), "rgb8")
    episode = open_episode(bag.path)
    for name in ("rational", "fish"):
        one, found = episode.camera(name).camera, episode.camera(name).read(0)[:, :, 0]
        rays = (GRID[:, 0] - [one.center_x, one.center_y]) / [one.focal_x, one.focal_y]
        difference = np.abs(found.astype(int) - shade(rays))
        assert difference[2:-2, 2:-2].max() < 4, name
    rectified = episode.camera("fish_image_rect")
    assert (rectified.camera.focal_x, rectified.camera.center_y, rectified.lens) == (50, 29, None)
    text = "camera 'other' is left out: /other/image_raw: distortion_model 'thin_prism'"
    assert any(text in one for one in episode.warnings)


@pytest.mark.parametrize("kind", KINDS)
def test_odd_and_truncated_bags(tmp_path, kind):
    bag, years = Bag(tmp_path, kind), 3e8 if kind == "mcap" else 0.0
    with bag.writer:
        for k in range(COUNT):
            time = np.nan if kind == "sqlite3" else 0.1 * (k if k != 5 else 4)
            bag.image("/a", time, numbered(k), "rgb8", logged=0.1 * k)
            bag.joints("/joint_states", 0.1 * k - years, x=1.0)
    episode = open_episode(bag.path)
    warnings, one = "\n".join(episode.warnings), episode.camera("a")
    kept = [k for k in range(COUNT) if k != 5 or kind == "sqlite3"]
    np.testing.assert_allclose(one.times - 1.7e9, 0.1 * np.array(kept), rtol=0, atol=1e-6)
    assert [number_of(one.read(k)) for k in range(len(kept))] == kept
    assert ("/a: pictures: headers without time stamps" in warnings) == (kind == "sqlite3")
    assert ("/a: pictures: number 5" in warnings) == (kind != "sqlite3")
    assert ("its clock differs from the joint log's" in warnings) == (kind == "mcap")
    file = next(p for p in (bag.path, *bag.path.glob("*")) if p.suffix in (".bag", ".db3", ".mcap"))
    assert list(open_episode(file).cameras) == ["a"]
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    with pytest.raises(SceneError, match=r"not a whole bag.*reindex"):
        open_episode(bag.path)


def test_a_bag_without_images_lists_its_topics(tmp_path):
    bag = Bag(tmp_path, "mcap")
    with bag.writer:
        bag.image("/depth", 0.0, np.zeros((4, 4, 2), np.uint8), "16UC1")
        bag.joints("/joint_states", 0.0, x=0.0)
    with pytest.raises(
        SceneError, match=r"no pictures .*: /depth \(depths\), /joint_states \(sens"
    ):
        open_episode(bag.path)
