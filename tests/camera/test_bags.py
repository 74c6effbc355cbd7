"""Bags written by rosbags, of ROS 1 and both kinds of ROS 2."""

import re
import shutil
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.episode_files import open_episode
from drake_pose.errors import SceneError
from tests.camera.recordings import SIDE, K, number_of, numbered

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

    def image(self, topic, time, picture, coding, logged=0.0, big=0):
        padded = np.pad(picture.reshape(len(picture), -1), ((0, 0), (0, 5)))
        height, width = (SIDE, SIDE) if picture.shape[1] != 4 else picture.shape[:2]
        fields = {"height": height, "width": width, "encoding": coding, "is_bigendian": big}
        fields |= {"header": self.header(time, "lens"), "step": padded.shape[1]}
        self.write(topic, "sensor_msgs/msg/Image", logged, data=padded.ravel(), **fields)

    def compressed(self, topic, time, number, kind="jpeg", data=None):
        if data is None:
            data = cv2.imencode(".jpg", numbered(number)[:, :, ::-1])[1].ravel()
        fields = {"header": self.header(time, "lens"), "format": kind, "data": data}
        self.write(topic, "sensor_msgs/msg/CompressedImage", time, **fields)

    def joints(self, topic, time, logged=None, bare=False, **positions):
        fields = {"header": self.header(time), "name": [] if bare else [*positions]}
        fields |= {"position": np.array([*positions.values()]), "velocity": NONE, "effort": NONE}
        logged = time if logged is None else logged
        self.write(topic, "sensor_msgs/msg/JointState", logged, **fields)

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
    recorded = [hand.read_recorded(k) for k in order]
    np.testing.assert_array_equal(recorded, [numbered(k) for k in order])
    undistorted = cv2.undistort(numbered(5), K, np.array(PLUMB), None, hand.lens.undistorted_matrix)
    np.testing.assert_array_equal(hand.read(5), undistorted)
    assert hand.link == "hand"
    np.testing.assert_allclose(hand.camera.X_WC, pose(1) @ pose(2), rtol=0, atol=1e-9)
    assert (joints.names, joints.positions.shape) == (("elbow", "wrist", "finger"), (60, 3))
    np.testing.assert_allclose(joints.positions[:, 0], 0.5 * np.arange(60))
    finger = joints.positions[1:58, 2]
    np.testing.assert_allclose(finger, 0.02 * np.arange(1, 58), rtol=0, atol=1e-5)
    warnings = "\n".join(episode.warnings)
    assert "/other: also has joint elbow of /joint_states" in warnings
    assert "/side/compressed: no calibration in /camera_info" in warnings
    assert "depth" not in warnings


def yuv_of(picture):
    """Return intensities and colour differences (H, W, 3) of an image by ITU-R BT.601."""
    red, green, blue = np.moveaxis(picture / 255.0, 2, 0)
    Y = 16 + 65.481 * red + 128.553 * green + 24.966 * blue
    U = 128 - 37.797 * red - 74.203 * green + 112.0 * blue
    V = 128 + 112.0 * red - 93.786 * green - 18.214 * blue
    return np.rint(np.dstack([Y, U, V])).astype(np.uint8)


def test_images_of_all_encodings_are_decoded(tmp_path):
    bag, picture = Bag(tmp_path, "mcap"), numbered(5)
    grey, reverse = np.full((SIDE, SIDE), 140, np.uint8), picture[:, :, ::-1]
    Y, U, V = np.moveaxis(yuv_of(picture), 2, 0)
    U, V = (one.reshape(SIDE, -1, 2)[:, :, 0] for one in (U, V))
    colours, mosaic = np.dstack([U, V]).reshape(SIDE, SIDE), picture[:, :, 1]
    uyvy, yuyv = np.dstack([colours, Y]), np.dstack([Y, colours])
    plain = {
        "rgb8": picture, "bgr8": reverse, "bgra8": np.dstack([reverse, grey]), "mono8": grey,
        "8UC3": reverse, "8UC4": np.dstack([reverse, Y]), "8UC1": mosaic, "rgb": grey,
        "yuv422": uyvy, "uyvy": uyvy, "yuv422_yuy2": yuyv, "yuyv": yuyv,
        "nv12": np.vstack([Y, colours[::2]]), "16UC1": np.dstack([grey, grey]),
        "mono16": np.dstack([grey, grey // 20]),
    }  # fmt: skip
    patterns = {f"bayer_{pattern}8": pattern for pattern in ("rggb", "bggr", "gbrg", "grbg")}
    with bag.writer:
        bag.joints("/joint_states", 0.0, x=0.0)
        for coding, pixels in plain.items():
            bag.image(f"/{coding}", 0.0, pixels, coding)
        bag.image("/narrow", 0.0, picture, "bgra8")
        for coding, pattern in patterns.items():
            place = np.tile(np.reshape(["rgb".index(c) for c in pattern], (2, 2)), (32, 32))
            pixels = np.take_along_axis(picture, place[:, :, None], axis=2)[:, :, 0]
            bag.image(f"/{coding}", 0.0, pixels, coding)
        for big, kind in enumerate(("<u2", ">u2")):
            wide = (257 * reverse.astype(np.uint16)).astype(kind)
            green = wide[:, :, 1].copy().view(np.uint8)
            bag.image(f"/bgr{big}", 0.0, wide.view(np.uint8), "bgr16", big=big)
            bag.image(f"/mono{big}", 0.0, green, "mono16", big=big)
            bag.image(f"/bayer{big}", 0.0, green, "bayer_rggb16", big=big)
    episode = open_episode(bag.path)
    for name in ("rgb8", "bgr8", "bgra8", "8UC3", "8UC4", "bgr0", "bgr1"):
        np.testing.assert_array_equal(episode.camera(name).read(0), picture)
    np.testing.assert_array_equal(episode.camera("mono8").read(0), np.dstack([grey] * 3))
    for name in ("8UC1", "mono0", "mono1"):
        np.testing.assert_array_equal(episode.camera(name).read(0)[:, :, 2], mosaic)
    for name in patterns:
        found = episode.camera(name).read(0).astype(int)
        assert np.abs(found - picture)[2 : SIDE // 4 - 2, 2:-2].max() < 3, name
    for name in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12"):
        found = episode.camera(name).read(0).astype(int)
        assert np.abs(found - picture)[:, 2:-2].max() < 5, name
    bayer = [episode.camera(f"bayer{big}").read(0) for big in (0, 1)]
    np.testing.assert_array_equal(*bayer)
    green = cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2RGB)[5:60, 5:60, 1]
    np.testing.assert_array_equal(bayer[0][5:60, 5:60, 1], green)
    assert not {"16UC1", "rgb", "mono16"} & set(episode.cameras)
    warnings = "\n".join(episode.warnings)
    assert "/rgb is left out: 'rgb' is not one of rgb8, bgr8" in warnings
    assert "/mono16, picture 0: has 16 bits per pixel, but no value above 1932 of 65535" in warnings
    assert "/narrow, picture 0: has fewer bytes than" in warnings
    assert "/16UC1" not in warnings
    guesses = [text for text in episode.warnings if "does not tell the order of colours" in text]
    assert [text.partition(":")[0] for text in guesses] == ["/8UC3", "/8UC4"]


def test_formats_of_compressed_pictures(tmp_path):
    bag = Bag(tmp_path, "mcap")
    formats = ["jpeg", *(f"{one}; jpeg compressed bgr8" for one in ("rgb8", "bgr8", "bayer_rggb8"))]
    mosaic = numbered(3)[:, :, 1]
    with bag.writer:
        bag.joints("/joint_states", 0.0, x=0.0)
        for k, kind in enumerate(formats):
            bag.compressed(f"/a{k}/compressed", 0.0, 3, kind)
        data = cv2.imencode(".png", mosaic)[1].ravel()
        bag.compressed("/raw/compressed", 0.0, 3, "bayer_rggb8; png compressed", data)
        bag.compressed("/film/compressed", 0.0, 3, "h264", np.zeros(99, np.uint8))
    episode = open_episode(bag.path)
    assert [number_of(episode.camera(f"a{k}").read(0)) for k in range(4)] == [3] * 4
    expected = cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2RGB)
    np.testing.assert_array_equal(episode.camera("raw").read(0), expected)
    assert "camera 'film' is left out" in (text := "\n".join(episode.warnings))
    assert "not a PNG or JPEG picture (its format is 'h264')" in text


def test_positions_without_names_and_names_in_any_order(tmp_path):
    for case in ("bare", "two", "both", "order", "none"):
        folder = tmp_path / case
        folder.mkdir()
        bag = Bag(folder, "mcap")
        with bag.writer:
            for k in range(COUNT):
                bag.image("/a", 0.1 * k, numbered(k), "rgb8", logged=0.1 * k)
                if case in ("bare", "two", "both"):
                    bag.joints("/joint_states", 0.1 * k, bare=True, a=0.1 * k, b=-1.0)
                if case == "two":
                    bag.joints("/others", 0.1 * k, bare=True, a=1.0, b=2.0, c=3.0)
                if case == "both":
                    bag.joints("/named", 0.1 * k, elbow=0.1 * k, wrist=-1.0)
                if case == "order":
                    pair = [("elbow", 0.1 * k), ("wrist", -1.0)][:: 1 - 2 * (k % 2)]
                    bag.joints("/joint_states", 0.1 * k, **dict(pair))
        episode = open_episode(bag.path)
        texts, joints = "\n".join(episode.warnings), episode.joints
        if case in ("two", "none"):
            assert joints is None
            assert "Wanted is a topic of sensor_msgs/JointState with names" in texts
            assert ("/others: its JointState has no names: its 3" in texts) == (case == "two")
            continue
        expected = ("joint_0", "joint_1") if case == "bare" else ("elbow", "wrist")
        assert joints.names == expected
        np.testing.assert_allclose(joints.positions, [[0.1 * k, -1.0] for k in range(COUNT)])
        taken = "2 positions are taken for joints in the model's order" in texts
        assert taken == (case == "bare")
        assert ("2 positions are left out" in texts) == (case == "both")


@pytest.mark.parametrize(
    ("camera", "joint", "later", "text"),
    [
        (0.0, 0.0, 0.0, ""),
        (0.4, 0.0, 0.4, ""),
        (-1e9, 0.0, 0.02, r"the clock of the headers is 1e\+09 s behind that of /joint_states"),
        (5.0, 0.0, 0.02, "/a: pictures: by .* is -4.98 s behind that of /joint_states: this is ad"),
        (-1e9, -1e9, 0.0, ""),
        (np.nan, 0.0, 0.02, "/a: pictures: headers without time stamps"),
        (np.nan, -1e9, 0.02, "/joint_states: rows of x: by the times of .* behind that of the bag"),
        (0.0, np.nan, 0.0, "/joint_states: rows of x: headers without time stamps"),
    ],
)
def test_clocks_of_headers_are_moved_by_the_times_of_recording(
    tmp_path, camera, joint, later, text
):
    bag = Bag(tmp_path, "mcap")
    with bag.writer:
        for k in range(COUNT):
            bag.image("/a", 0.1 * k + camera, numbered(k), "rgb8", logged=0.1 * k + 0.02)
            bag.joints("/joint_states", 0.1 * k + joint, logged=0.1 * k, x=0.1 * k)
    episode = open_episode(bag.path)
    one, texts = episode.camera("a"), "\n".join(episode.warnings)
    found = episode.joints.at(one.times)[:5, 0]
    np.testing.assert_allclose(found, 0.1 * np.arange(5) + later, rtol=0, atol=1e-6)
    assert re.search(text, texts), texts
    assert bool(text) == ("clock" in texts or "without time stamps" in texts)
    assert [number_of(one.read(k)) for k in (3, 1)] == [3, 1]


def test_files_outside_the_folder_are_not_opened(tmp_path):
    bag = Bag(tmp_path, "mcap")
    with bag.writer:
        bag.image("/a", 0.0, numbered(1), "rgb8")
    text, file = (bag.path / "metadata.yaml").read_text(), next(bag.path.glob("*.mcap"))
    # A path of the recorder's machine is that of the file in this folder.
    (bag.path / "metadata.yaml").write_text(text.replace(file.name, f"../bags/{file.name}"))
    assert list(open_episode(bag.path).cameras) == ["a"]
    file.rename(tmp_path / file.name)
    with pytest.raises(SceneError, match=r"metadata\.yaml: relative_file_paths: '\.\./bags/.* lea"):
        open_episode(bag.path)


def test_lenses_are_those_of_their_camera_infos(tmp_path):
    bag, P = Bag(tmp_path, "mcap"), [50, 0, 30, 0, 0, 51, 29, 0, 0, 0, 1, 0]
    kinds = {
        "rational": ("rational_polynomial", (-0.3, 0.1, 1e-3, -2e-3, 0.01, 0.05, 0.02, 0.003)),
        "fish": ("equidistant", (0.1, -0.02, 0.003, -0.001)),
        "other": ("thin_prism", (0.1, -0.02, 0.003, -0.001)),
    }
    with bag.writer:
        bag.joints("/joint_states", 0.0, x=0.0)
        for name, (model, D) in kinds.items():
            bag.info(f"/{name}/camera_info", model, D, P)
            bag.image(f"/{name}/image_raw", 0.0, numbered(1), "rgb8")
        bag.image("/fish/image_rect", 0.0, numbered(1), "rgb8")
    episode = open_episode(bag.path)
    for name in ("rational", "fish"):
        lens = episode.camera(name).lens
        assert (lens.fisheye, lens.distortion.tolist()) == (name == "fish", [*kinds[name][1]])
        np.testing.assert_array_equal(lens.matrix, K)
        undistorted = lens.undistort(numbered(1))
        np.testing.assert_array_equal(episode.camera(name).read(0), undistorted)
    rectified = episode.camera("fish_image_rect")
    assert (rectified.camera.focal_x, rectified.camera.center_y, rectified.lens) == (50, 29, None)
    text = "camera 'other' is left out: /other/image_raw: distortion_model 'thin_prism'"
    assert any(text in one for one in episode.warnings)


@pytest.mark.parametrize("kind", KINDS)
def test_odd_and_truncated_bags(tmp_path, kind):
    bag, years = Bag(tmp_path, kind), 3e8 if kind == "mcap" else 0.0
    with bag.writer:
        for k in range(COUNT):
            # Few headers without stamps are left out, as are those that come late.
            time = (
                np.nan
                if kind == "sqlite3" or (kind, k) == ("mcap", 5)
                else 0.1 * (k if k != 5 else 4)
            )
            bag.image("/a", time, numbered(k), "rgb8", logged=0.1 * k)
            # Messages of equal times in the bag are told apart by their order.
            bag.image("/b", 0.1 * k, numbered(k), "rgb8", logged=0.0 if k < 9 else 1.0)
            bag.joints("/joint_states", 0.1 * k - years, x=1.0)
        bag.image("/a", 0.1 * COUNT, numbered(9), "odd", logged=0.1 * COUNT)
    episode = open_episode(bag.path)
    warnings, one = "\n".join(episode.warnings), episode.camera("a")
    kept = [k for k in range(COUNT) if k != 5 or kind == "sqlite3"]
    np.testing.assert_allclose(one.times - 1.7e9, 0.1 * np.array(kept), rtol=0, atol=1e-6)
    assert [number_of(one.read(k)) for k in range(len(kept))] == kept
    order = [*range(COUNT), 3, 3, 11, 0, 10]
    assert [number_of(episode.camera("b").read(k)) for k in order] == order
    assert ("/a: pictures: headers without time stamps" in warnings) == (kind == "sqlite3")
    assert "pictures of /a are left out: 'odd' is not one of rgb8" in warnings
    assert ("camera 'a': pictures: number 5" in warnings) == (kind != "sqlite3")
    assert ("its clock differs from the joint log's" in warnings) == (kind == "mcap")
    file = next(p for p in (bag.path, *bag.path.glob("*")) if p.suffix in (".bag", ".db3", ".mcap"))
    assert list(open_episode(file).cameras) == ["a", "b"]
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    with pytest.raises(SceneError, match=r"not a whole bag.*reindex"):
        open_episode(bag.path)


def test_bags_without_images_and_folders_of_several_are_refused(tmp_path):
    bag = Bag(tmp_path, "mcap")
    with bag.writer:
        bag.image("/depth", 0.0, np.zeros((4, 4, 2), np.uint8), "16UC1")
        bag.joints("/joint_states", 0.0, x=0.0)
    with pytest.raises(SceneError, match=r"no pictures .*: /depth \(depths\), /joint_states \(sen"):
        open_episode(bag.path)
    for name in ("one.mcap", "two.mcap"):
        shutil.copy(next(bag.path.glob("*.mcap")), tmp_path / name)
    with pytest.raises(SceneError, match=r"has 2 bags and no metadata\.yaml: .* one\.mcap, two"):
        open_episode(tmp_path)
