"""Read episodes from bags of ROS 1 and ROS 2 (sqlite3 and mcap), by the library rosbags."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Indices, Picture
from drake_pose.camera.calibration_files import lens_of
from drake_pose.camera.episode import Episode, EpisodeCamera, JointLog, ascending_indices
from drake_pose.camera.models import Lens
from drake_pose.camera.picture_files import decode_colours, import_reader
from drake_pose.errors import CameraError, DrakePoseError, SceneError

BAGS = (".bag", ".mcap", ".db3")
"""Suffixes of bags."""

# Bytes per pixel, and OpenCV's conversion to red, green, blue.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
}

# A message: its times in the header (0: none) and in the bag [ns], and its content, which is the
# frame's name for an image and the positions (m,) for joints.
_Row = tuple[int, int, Any]


def open_bag(path: Path, joints: JointLog | None) -> Episode:
    """Open a bag: a file of ROS 1, or a folder, mcap or db3 file of ROS 2.

    A camera's name is its topic without slashes and `image_raw` (`/hand/image_raw` becomes `hand`).
    The times of images and joint positions are those of the message headers. Joints published
    separately are interpolated at the times of the publisher with most messages. A camera whose
    frame is attached to others by `/tf_static` is mounted on the last of these.

    Args:
        joints: joint log to use instead of the bag's; None: the bag's, if it has any.

    Raises:
        SceneError: the bag is unreadable, truncated, or has no images.
    """
    pictures, states, infos, parents, ignored = _scan(path)
    warnings = [f"{topic} is left out: {why}" for topic, why in ignored.items() if why != "depths"]
    if joints is None and states:
        joints, merge_warnings = _merge_joints(states)
        warnings += merge_warnings
    cameras: dict[str, EpisodeCamera] = {}
    # If a camera was recorded twice, prefer the uncompressed topic.
    for topic in sorted(pictures, key=lambda topic: (topic.endswith("/compressed"), topic)):
        parts = topic.strip("/").split("/")
        while len(parts) > 1 and parts[-1] in ("compressed", "image_raw", "image"):
            parts.pop()
        if (name := "_".join(parts)) in cameras:
            continue
        try:
            camera = _read_camera(path, topic, pictures[topic], infos, warnings)
        except SceneError as error:
            warnings.append(f"camera '{name}' is left out: {error}")
            continue
        # Follow static frames to the link that carries the camera, and its pose there.
        frame, link, X_LC, visited = pictures[topic][0][2], None, np.eye(4), set[str]()
        while frame in parents and frame not in visited:
            visited.add(frame)
            link, X_LF = parents[frame]
            X_LC, frame = X_LF @ X_LC, link
        mounted = camera.camera and camera.camera.with_pose(X_LC)
        cameras[name] = replace(camera, name=name, camera=mounted, link=link)
    return Episode.checked(path, cameras.values(), joints, warnings)


def _scan(path: Path) -> tuple[Any, Any, Any, Any, Any]:
    """Read a bag once, without decoding images.

    Returns:
        Rows of images by topic; rows of joint positions by (topic, names of the joints); the last
        CameraInfo message by topic; (parent frame's name, pose (4, 4) in it [m]) of each static
        frame by name; and the reason why a topic of images is ignored, by topic.

    Raises:
        SceneError: the bag is damaged, or has no images.
    """
    pictures, states = defaultdict[str, list[_Row]](list), defaultdict[Any, list[_Row]](list)
    infos, parents, ignored = {}, {}, {}
    sensors = "Image", "CompressedImage", "JointState", "CameraInfo"
    with _translate_errors(path), _make_reader(path) as reader:
        wanted = [
            one
            for one in reader.connections
            if one.msgtype in {f"sensor_msgs/msg/{name}" for name in sensors}
            or (one.msgtype == "tf2_msgs/msg/TFMessage" and one.topic.endswith("/tf_static"))
        ]
        kinds = {one.topic: one.msgtype for one in reader.connections}
        for one, log_time, data in reader.messages(wanted) if wanted else ():
            topic, kind = one.topic, one.msgtype.rpartition("/")[2]
            message = reader.deserialize(data, one.msgtype)
            if kind == "TFMessage":
                for frame in message.transforms:
                    X, shift, q = np.eye(4), frame.transform.translation, frame.transform.rotation
                    X[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
                    X[:3, 3] = shift.x, shift.y, shift.z
                    parent = frame.header.frame_id.strip("/")
                    parents[frame.child_frame_id.strip("/")] = parent, X
                continue
            stamp = message.header.stamp
            stamps = stamp.sec * 10**9 + stamp.nanosec, log_time
            if kind == "CameraInfo":
                infos[topic] = message
            elif kind != "JointState":
                coding = (message.encoding if kind == "Image" else message.format).lower()
                if any(one in coding for one in ("16uc1", "32fc1", "compresseddepth")):
                    ignored[topic] = "depths"
                elif kind == "Image" and coding not in _ENCODINGS:
                    ignored[topic] = f"{coding} is not one of {', '.join(_ENCODINGS)}"
                else:
                    pictures[topic].append((*stamps, message.header.frame_id.strip("/")))
            elif len(message.name) and len(message.position) == len(message.name):
                states[topic, tuple(message.name)].append((*stamps, np.array(message.position)))
    if not pictures:
        topics = ", ".join(f"{topic} ({kind})" for topic, kind in (kinds | ignored).items())
        raise SceneError(f"{path}: has no pictures of cameras; its topics are: {topics or 'none'}")
    return pictures, states, infos, parents, ignored


def _make_reader(path: Path) -> Any:
    """Return a reader of a bag; message types that it does not define are the usual ones."""
    types = import_reader("rosbags.typesys", path)
    typestore = types.get_typestore(types.Stores.LATEST)
    return import_reader("rosbags.highlevel", path).AnyReader([path], default_typestore=typestore)


@contextmanager
def _translate_errors(path: Path) -> Iterator[None]:
    """Convert any error that rosbags raises on a truncated or damaged bag to a SceneError."""
    try:
        yield
    except DrakePoseError:
        raise
    except Exception as error:  # The decompressors' errors have no common base class.
        raise SceneError(
            f"{path}: not a whole bag of ROS 1 or 2 ({type(error).__name__}: {error}); a truncated "
            "bag can be repaired by 'rosbag reindex' or 'ros2 bag reindex'"
        ) from error


def _ordered_times(rows: Sequence[_Row], what: str, warnings: list[str]) -> tuple[Array, Indices]:
    """Return ascending times (k,) [s], and indices (k,) of their rows; other rows are left out.

    The times are those of the headers, or those of the bag if no header has one.

    Args:
        rows: the n messages.
        what: name of the rows, for messages.
        warnings: list to which warnings are appended.

    Raises:
        SceneError: too many rows are out of order, see ``ascending_indices``.
    """
    stamps = np.array([row[:2] for row in rows])
    clock = 0 if stamps[:, 0].any() else 1
    if clock:
        warnings.append(f"{what}: headers without time stamps: using the times of recording")
    times = 1e-9 * stamps[:, clock]
    kept, late = ascending_indices(times, what)
    warnings += late
    return times[kept], kept


def _merge_joints(
    groups: Mapping[tuple[str, tuple[str, ...]], Sequence[_Row]],
) -> tuple[JointLog, list[str]]:
    """Return all joints at the times of the publisher with most rows, and warnings.

    If several publish the same joint, the one with more rows is used.

    Args:
        groups: rows by (topic, names of the joints), at least one.
    """
    warnings: list[str] = []
    base: JointLog | None = None
    columns: dict[str, Array] = {}
    owners: dict[str, str] = {}
    for (topic, names), rows in sorted(groups.items(), key=lambda one: -len(one[1])):
        times, kept = _ordered_times(rows, f"{topic}: rows of {names[0]}", warnings)
        log = JointLog(names, times, np.array([row[2] for row in rows])[kept])
        base = base or log
        assert base.times is not None
        if again := [name for name in names if owners.setdefault(name, topic) != topic]:
            warnings.append(
                f"{topic}: also has joint {', '.join(again)} of {owners[again[0]]}, which is used "
                "because it has more rows"
            )
        columns = dict(zip(names, log.at(base.times).T, strict=True)) | columns
    assert base is not None
    ordered = tuple(dict.fromkeys(name for _, names in groups for name in names))
    positions = np.column_stack([columns[name] for name in ordered])
    return JointLog(ordered, base.times, positions), warnings


def _read_camera(
    path: Path, topic: str, rows: Sequence[_Row], infos: Mapping[str, Any], warnings: list[str]
) -> EpisodeCamera:
    """Return the camera of a topic; its name is the topic, and its pose the identity.

    It has no ``camera`` if the bag has no calibration for images of its size.

    Args:
        path: the bag.
        topic: topic of the images.
        rows: rows of the images.
        infos: CameraInfo messages by topic.
        warnings: list to which warnings are appended.

    Raises:
        SceneError: the first image is damaged, times run backwards, or the lens is unknown.
    """
    times, kept = _ordered_times(rows, f"{topic}: pictures", warnings)
    source = _TopicPictures(path, topic, np.array([row[1] for row in rows])[kept])
    height, width = source.read(0).shape[:2]
    base = topic.removesuffix("/compressed")
    beside = f"{base.rpartition('/')[0]}/camera_info"
    info, camera, lens = infos.get(beside, infos.get(f"{base}/camera_info")), None, None
    if info is None or not np.any(_field(info, "k")):
        warnings.append(f"{topic}: no calibration in {beside}: its lens is unknown; calibrate it")
    elif (info.width, info.height) != (width, height):
        warnings.append(
            f"{topic}: its calibration is for {info.width} x {info.height} pixels, but its images "
            f"have {width} x {height}: its lens is unknown; calibrate it"
        )
    else:
        lens = _lens(info, is_rectified="rect" in base.rpartition("/")[2], where=topic)
        camera = lens.camera(topic, np.eye(4))
        lens = lens if lens.distortion.any() else None
    return EpisodeCamera(topic, width, height, times, camera, None, source.read, (), lens)


def _field(info: Any, name: str) -> Array:
    """Return the numbers of a CameraInfo's field.

    Args:
        info: the CameraInfo message.
        name: name of the field in lower case; ROS 1 has it in upper case.
    """
    return np.asarray(getattr(info, name, getattr(info, name.upper(), None)), dtype=np.float64)


def _lens(info: Any, *, is_rectified: bool, where: str) -> Lens:
    """Return the lens of a CameraInfo.

    The distortion applies to raw images. Rectified images have no distortion, and their camera
    matrix is in P, or in K if P is 0.

    Args:
        info: the CameraInfo message.
        is_rectified: whether the images are rectified.
        where: start of error messages.

    Raises:
        SceneError: the distortion model is unknown.
    """
    size, K, D, P = (info.width, info.height), *(_field(info, one) for one in ("k", "d", "p"))
    K = P.reshape(3, 4)[:, :3] if is_rectified and P.any() else K
    plain = is_rectified or not D.any()
    model, D = ("none", np.zeros(4)) if plain else (info.distortion_model, D)
    try:
        return lens_of(size, K, D, model, where)
    except CameraError as error:
        raise SceneError(f"{error}; record rectified pictures") from error


class _TopicPictures:
    """Images of a topic, best read in sequence; any other than the next one needs a seek.

    Args:
        path: the bag.
        topic: topic of the images.
        log_times: (n,) times in the bag [ns] of the images, by which they are found.
    """

    def __init__(self, path: Path, topic: str, log_times: Indices) -> None:
        self._path, self._topic, self._log_times = path, topic, log_times
        self._reader: Any = None
        self._messages: Iterator[Any] = iter(())
        self._next = -1

    def read(self, k: int) -> Picture:
        """Return image k, from 0 in the order of ``log_times``, (H, W, 3) red, green, blue.

        Raises:
            SceneError: it is damaged, or the bag's index is wrong.
        """
        wanted, where = int(self._log_times[k]), f"{self._path}: {self._topic}, picture {k}"
        with _translate_errors(self._path):
            if self._reader is None:
                self._reader = _make_reader(self._path)
                self._reader.open()
            if k != self._next:
                own = [one for one in self._reader.connections if one.topic == self._topic]
                self._messages = self._reader.messages(own, start=wanted)
            for one, log_time, data in self._messages:
                if log_time == wanted:
                    self._next = k + 1
                    message = self._reader.deserialize(data, one.msgtype)
                    if one.msgtype.endswith("CompressedImage"):
                        return decode_colours(bytes(message.data), Path(where), SceneError)
                    size, how = _ENCODINGS[message.encoding.lower()]
                    height, width, step = message.height, message.width, message.step
                    if not (len(message.data) >= height * step > 0 and step >= width * size):
                        raise SceneError(
                            f"{where}: has fewer bytes than {width} x {height} pixels need"
                        )
                    rows = np.frombuffer(message.data, np.uint8, height * step)
                    used = rows.reshape(height, step)[:, : width * size]
                    used = used.reshape(height, width, size)
                    return np.ascontiguousarray(used if how is None else cv2.cvtColor(used, how))
        raise SceneError(f"{where}: is not where the bag's index says; reindex the bag")
