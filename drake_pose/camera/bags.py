"""Read episodes from bags of ROS 1 and ROS 2 (sqlite3 and mcap), by the library rosbags."""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Picture
from drake_pose.camera.calibration_files import lens_of
from drake_pose.camera.episode import Episode, JointLog, Stream, ascending_indices
from drake_pose.camera.models import pose_matrix
from drake_pose.camera.picture_files import (
    decode_colours,
    import_reader,
    naming_damage,
    path_inside,
    upper_bits,
)
from drake_pose.camera.pose_files import above
from drake_pose.errors import CameraError, SceneError
from drake_pose.input_files import read_regular

BAGS = (".bag", ".mcap", ".db3")
"""Suffixes of bags."""

# Bytes per pixel, and OpenCV's conversion to red, green, blue. Encodings of 16 bits, such as
# mono16, have twice the bytes of those of 8.
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
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "nv12": (1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (1, cv2.COLOR_YUV2RGB_NV21),
}

_DAMAGED = "not a whole bag of ROS 1 or 2; ros2 bag reindex (or rosbag reindex) repairs one"

# Other names of encodings. Types of OpenCV tell no order of colours: OpenCV's own is assumed.
_ALIASES = {"8uc1": "mono8", "8uc3": "bgr8", "8uc4": "bgra8", "16uc3": "bgr16", "16uc4": "bgra16"}
_ALIASES |= {"uyvy": "yuv422", "yuyv": "yuv422_yuy2", "yuy2": "yuv422_yuy2"}

# A message: its times in the header (0: none) and in the bag [ns], and its content, which is the
# frame's name for an image and the positions (m,) for joints.
_Row = tuple[int, int, Any]


def open_bag(path: Path, joints: JointLog | None) -> Episode:
    """Open a bag: a file of ROS 1, or a folder, mcap or db3 file of ROS 2.

    A camera's name is its topic without slashes and `image_raw` (`/hand/image_raw` becomes `hand`).
    The times of images and joint positions are those of the message headers, see `_clock_shifts`.
    Joints published separately are interpolated at the times of the publisher with most messages.
    A camera whose frame is attached to others by `/tf_static` is mounted on the last of these.

    ``joints``: joint log to use instead of the bag's; None: the bag's, if it has any. Raises
    SceneError: the bag is unreadable, truncated, has no images, or names files outside its folder.
    """
    if (metadata := path / "metadata.yaml").is_file():
        text = read_regular(metadata).decode("utf-8", "replace")
        listed = re.search(r"relative_file_paths:((?:\s*- .*)+)", text)
        for name in re.findall(r"- +['\"]?(.+?)['\"]?\s*$", listed[1] if listed else "", re.M):
            if not (path / PurePath(name).name).is_file():
                path_inside(path, name, f"{metadata}: relative_file_paths")
    pictures, states, infos, parents, ignored, kinds = _scan(path)
    warnings = [
        f"{f'pictures of {topic} are' if topic in pictures else f'{topic} is'} left out: {why}"
        for topic, why in ignored.items()
        if why != "depths"
    ]
    # Positions without names are named only if they are the only ones.
    is_alone = len(states) == 1
    for topic, count in [key for key in states if isinstance(key[1], int)]:
        rows, text = states.pop((topic, count)), "left out; record the names"
        if is_alone:
            states[topic, tuple(f"joint_{k}" for k in range(count))] = rows
            text = (
                "taken for joints in the model's order, if it has as many; record the names, or "
                "give a joint map"
            )
        warnings.append(f"{topic}: its JointState has no names: its {count} positions are {text}")
    shifts, texts = _clock_shifts(pictures, states)
    warnings += texts
    if joints is None and states:
        joints, merge_warnings = _merge_joints(states, shifts)
        warnings += merge_warnings
    cameras: dict[str, Stream] = {}
    # If a camera was recorded twice, prefer the uncompressed topic.
    for topic in sorted(pictures, key=lambda topic: (topic.endswith("/compressed"), topic)):
        parts = topic.strip("/").split("/")
        while len(parts) > 1 and parts[-1] in ("compressed", "image_raw", "image"):
            parts.pop()
        if (name := "_".join(parts)) in cameras:
            continue
        try:
            camera = _read_camera(path, topic, pictures[topic], shifts[topic], infos, warnings)
        except SceneError as error:
            warnings.append(f"camera '{name}' is left out: {error}")
            continue
        # Follow static frames to the link that carries the camera, and its pose there.
        frame = pictures[topic][0][2]
        link, X_LC = above(parents, frame) if frame in parents else (None, np.eye(4))
        mounted = camera.camera and camera.camera.with_pose(X_LC)
        cameras[name] = replace(camera, name=name, camera=mounted, link=link, is_posed=bool(link))
    lacking = (
        f"{path}: has no joint positions; give a table of them (--joints). Wanted is a topic of "
        f"sensor_msgs/JointState with names and positions; the topics are: {_topics(kinds)}"
    )
    return Episode.checked(path, cameras.values(), joints, warnings, lacking)


def _topics(kinds: Mapping[str, str]) -> str:
    """Return topics with the types of their messages, for messages."""
    return ", ".join(f"{topic} ({kind})" for topic, kind in kinds.items()) or "none"


def _scan(path: Path) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Read a bag once, without decoding images.

    Returns:
        Rows of images by topic; rows of joint positions by (topic, names of the joints), without
        names by (topic, their number); the last CameraInfo message by topic; (parent frame's name,
        pose (4, 4) in it [m]) of each static frame by name; the reason why a topic is ignored, by
        topic; and the type of message by topic.

    Raises SceneError: the bag is damaged, or has no images.
    """
    pictures, states = defaultdict[str, list[_Row]](list), defaultdict[Any, list[_Row]](list)
    infos, parents, ignored = {}, {}, dict[str, str]()
    orders: dict[tuple[str, frozenset[str]], tuple[str, ...]] = {}
    sensors = "Image", "CompressedImage", "JointState", "CameraInfo"
    with naming_damage(path, _DAMAGED), _make_reader(path) as reader:
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
                    shift, q = frame.transform.translation, frame.transform.rotation
                    R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
                    X = pose_matrix(R, [shift.x, shift.y, shift.z])
                    parent = frame.header.frame_id.strip("/")
                    parents[frame.child_frame_id.strip("/")] = parent, X
                continue
            stamp = message.header.stamp
            stamps = stamp.sec * 10**9 + stamp.nanosec, log_time
            if kind == "CameraInfo":
                infos[topic] = message
                continue
            if kind != "JointState":
                coding = (message.encoding if kind == "Image" else message.format).lower()
                if any(one in coding for one in ("16uc1", "32fc1", "compresseddepth")):
                    ignored[topic] = "depths"
                elif kind == "Image" and _encoding(coding) is None:
                    known = ", ".join((*_ENCODINGS, *_ALIASES))
                    ignored[topic] = f"'{coding}' is not one of {known}, or of these with 16 bits"
                else:
                    pictures[topic].append((*stamps, message.header.frame_id.strip("/")))
                continue
            names, positions = tuple(message.name), np.array(message.position, dtype=np.float64)
            if names and len(positions) == len(names) == len(set(names)):
                # The order of names may change from message to message.
                order = orders.setdefault((topic, frozenset(names)), names)
                row = positions if order == names else positions[[names.index(n) for n in order]]
                states[topic, order].append((*stamps, row))
            elif len(positions) and not names:
                states[topic, len(positions)].append((*stamps, positions))
            else:
                ignored.setdefault(
                    topic,
                    f"a JointState has {len(positions)} positions for {len(set(names))} different "
                    f"names of {len(names)}",
                )
    if not pictures:
        found = _topics(kinds | ignored)
        raise SceneError(f"{path}: has no pictures of cameras; its topics are: {found}")
    with_states = {topic for topic, _ in states}
    ignored = {topic: why for topic, why in ignored.items() if topic not in with_states}
    return pictures, states, infos, parents, ignored, kinds


def _encoding(coding: str) -> tuple[int, int | None, bool] | None:
    """Return bytes per pixel, OpenCV's conversion, and whether values have 16 bits; None: unknown.

    ``coding``: name of the encoding in lower case.
    """
    coding = _ALIASES.get(coding, coding)
    if coding in _ENCODINGS:
        return (*_ENCODINGS[coding], False)
    eight = f"{coding.removesuffix('16')}8"
    if not coding.endswith("16") or eight not in _ENCODINGS:
        return None
    size, how = _ENCODINGS[eight]
    return 2 * size, how, True


def _clock_shifts(
    pictures: Mapping[str, Sequence[_Row]],
    states: Mapping[Any, Sequence[_Row]],
    *,
    differs: float = 1.0,
    max_fraction: float = 0.1,
) -> tuple[dict[Any, int | None], list[str]]:
    """Return what is added to the stamps in the headers of each stream [ns], and warnings.

    The result is 0 where the headers have the clock of the joints, and None where too many headers
    have no stamp, so that the times in the bag are used. Headers of another clock are moved by the
    median difference of the times in the bag.

    ``pictures``, ``states``: rows by topic, and by (topic, names). ``differs``: clocks differ if
    headers lag behind the times in the bag by this much more or less than those of the joints [s]:
    more than recorders delay messages. ``max_fraction``: maximum fraction of a stream's messages
    whose headers may have no stamp; they are left out.
    """
    streams: dict[Any, Sequence[_Row]] = {**states, **pictures}
    lags: dict[Any, float | None] = {}
    for key, rows in streams.items():
        stamps = np.array([row[:2] for row in rows])
        stamped = stamps[stamps[:, 0] > 0]
        lag = 1e-9 * (stamped[:, 1] - stamped[:, 0])
        is_stamped = len(stamps) - len(stamped) <= max_fraction * len(stamps)
        lags[key] = float(np.median(lag)) if is_stamped else None
        # Times in the bag that do not follow the headers tell nothing.
        if len(lag) and np.median(np.abs(lag - np.median(lag))) > differs:
            lags[key] = np.nan
    first = max(states or streams, key=lambda key: len(streams[key]))
    # A stream that has the bag's times only needs those of the others, too.
    joint_lag = lags[first] if None not in lags.values() else None
    shifts, warnings = dict[Any, int | None](), list[str]()
    for key, one in lags.items():
        what = f"{key}: pictures" if key in pictures else f"{key[0]}: rows of {key[1][0]}"
        shifts[key] = None
        if one is None:
            warnings.append(f"{what}: headers without time stamps: using the times of recording")
            continue
        off = one - (joint_lag or 0.0)
        shifts[key] = round(1e9 * off) if abs(off) > differs else 0
        if shifts[key]:
            other = "the bag" if joint_lag is None else first if first in pictures else first[0]
            warnings.append(
                f"{what}: by the times of recording, the clock of the headers is {off:.6g} s "
                f"behind that of {other}: this is added"
            )
    return shifts, warnings


def _make_reader(path: Path) -> Any:
    """Return a reader of a bag; message types that it does not define are the usual ones."""
    types = import_reader("rosbags.typesys", path)
    typestore = types.get_typestore(types.Stores.LATEST)
    return import_reader("rosbags.highlevel", path).AnyReader([path], default_typestore=typestore)


def _times(rows: Sequence[_Row], shift: int | None) -> Array:
    """Return the times (n,) [s] of n messages; nan where the header has no stamp.

    ``shift``: added to the stamps in the headers [ns]; None: use the times in the bag.
    """
    stamps = np.array([row[:2] for row in rows])
    if shift is None:
        return np.asarray(1e-9 * stamps[:, 1])
    return np.where(stamps[:, 0] > 0, 1e-9 * (stamps[:, 0] + shift), np.nan)


def _merge_joints(
    groups: Mapping[tuple[str, tuple[str, ...]], Sequence[_Row]], shifts: Mapping[Any, int | None]
) -> tuple[JointLog, list[str]]:
    """Return all joints at the times of the publisher with most rows, and warnings.

    If several publish the same joint, the one with more rows is used. ``groups``: rows by (topic,
    names of the joints), at least one. ``shifts``: see `_clock_shifts`.
    """
    warnings: list[str] = []
    base: JointLog | None = None
    columns: dict[str, Array] = {}
    owners: dict[str, str] = {}
    for (topic, names), rows in sorted(groups.items(), key=lambda one: -len(one[1])):
        times = _times(rows, shifts[topic, names])
        kept, late = ascending_indices(times, f"{topic}: rows of {names[0]}")
        warnings += late
        log = JointLog(names, times, np.array([row[2] for row in rows])).only(kept)
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
    path: Path,
    topic: str,
    rows: Sequence[_Row],
    shift: int | None,
    infos: Mapping[str, Any],
    warnings: list[str],
) -> Stream:
    """Return the camera of a topic; its name is the topic, and its pose the identity.

    It has no ``camera`` if the bag has no calibration for images of its size.

    ``shift``: see `_clock_shifts`. ``infos``: CameraInfo messages by topic. ``warnings``: appended
    to.

    Raises SceneError: the first image is damaged, times run backwards, or the lens is unknown.
    """
    times = _times(rows, shift)
    # The camera is left out if its clock is useless.
    ascending_indices(times, f"{topic}: pictures")
    source = _TopicPictures(path, topic, [row[1] for row in rows])
    height, width = source.read(0).shape[:2]
    if source.encoding.startswith(("8uc3", "8uc4", "16uc")):
        warnings.append(
            f"{topic}: its encoding {source.encoding} does not tell the order of colours: blue, "
            "green, red is assumed"
        )
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
        is_rectified = "rect" in base.rpartition("/")[2]
        K, D, P = (_field(info, one) for one in ("k", "d", "p"))
        # Rectified images have no distortion, and their camera matrix is in P, or in K if P is 0.
        K = P.reshape(3, 4)[:, :3] if is_rectified and P.any() else K
        plain = is_rectified or not D.any()
        model, D = ("none", np.zeros(4)) if plain else (info.distortion_model, D)
        try:
            lens = lens_of((width, height), K, D, model, topic)
        except CameraError as error:
            raise SceneError(f"{error}; record rectified pictures") from error
        camera = lens.camera(topic, np.eye(4))
        lens = lens if lens.distortion.any() else None
    return Stream(topic, width, height, times, camera, None, source.read, (), lens)


def _field(info: Any, name: str) -> Array:
    """Return the numbers of a CameraInfo's field, given in lower case; ROS 1 has upper case."""
    return np.asarray(getattr(info, name, getattr(info, name.upper(), None)), dtype=np.float64)


class _TopicPictures:
    """Images of a topic, best read in sequence; any other than the next one needs a seek.

    Args:
        path: the bag.
        topic: topic of the images.
        log_times: (n,) times in the bag [ns] of the topic's messages, in the bag's order.

    Attributes:
        encoding: encoding of the image that was read last, in lower case.
    """

    def __init__(self, path: Path, topic: str, log_times: Sequence[int]) -> None:
        self._path, self._topic, self._times = path, topic, list(log_times)
        self._reader: Any = None
        self._messages: Iterator[Any] = iter(())
        self._next = -1  # Number of the image that the next message has.
        self.encoding = ""

    def read(self, k: int) -> Picture:
        """Return image k, from 0 in the bag's order, (H, W, 3) red, green, blue.

        Raises SceneError: it is damaged, or the bag's index is wrong.
        """
        wanted, where = self._times[k], f"{self._path}: {self._topic}, picture {k}"
        with naming_damage(self._path, _DAMAGED):
            if self._reader is None:
                self._reader = _make_reader(self._path)
                self._reader.open()
            skipped = 0
            if k != self._next:
                own = [one for one in self._reader.connections if one.topic == self._topic]
                self._messages = self._reader.messages(own, start=wanted)
                # Messages may have the same time in the bag.
                skipped = k - self._times.index(wanted)
            self._next = -1
            for one, time, data in islice(self._messages, skipped, skipped + 1):
                if time == wanted:
                    self._next = k + 1
                    message = self._reader.deserialize(data, one.msgtype)
                    is_file = one.msgtype.endswith("CompressedImage")
                    self.encoding = (message.format if is_file else message.encoding).lower()
                    return (_decode_file if is_file else _decode)(message, where)
        raise SceneError(f"{where}: is not where the bag's index says; reindex the bag")


def _decode_file(message: Any, where: str) -> Picture:
    """Return the image (H, W, 3), red, green, blue, of a CompressedImage, whatever its format says.

    ``where``: start of error messages. Raises SceneError: it is damaged, or no PNG or JPEG.
    """
    coding, _, rest = message.format.lower().partition(";")
    try:
        picture = decode_colours(bytes(message.data), Path(where))
    except SceneError as error:
        raise SceneError(f"{error} (its format is '{message.format}')") from None
    # A mosaic is usually converted to bgr8 first, which the format then ends with.
    mosaic = _encoding(coding.strip()) if coding.startswith("bayer") else None
    if mosaic is None or not rest.endswith(("compressed", coding)):
        return picture
    return np.asarray(cv2.cvtColor(picture[:, :, 0], mosaic[1] or 0), dtype=np.uint8)


def _decode(message: Any, where: str) -> Picture:
    """Return the image (H, W, 3) of an Image with a known encoding, red, green, blue.

    Raises SceneError, begun by ``where``: it has too few bytes, or 16 bits whose upper ones are not
    used.
    """
    known = _encoding(message.encoding.lower())
    if known is None:
        raise SceneError(f"{where}: its encoding changes to {message.encoding}")
    size, how, is_deep = known
    height, width, step = message.height, message.width, message.step
    # These have a plane of colours of half the height below the intensities.
    lines = height * 3 // 2 if how in (cv2.COLOR_YUV2RGB_NV12, cv2.COLOR_YUV2RGB_NV21) else height
    if not (len(message.data) >= lines * step > 0 and step >= width * size):
        raise SceneError(f"{where}: has fewer bytes than {width} x {height} pixels need")
    rows = np.frombuffer(message.data, np.uint8, lines * step)
    used = rows.reshape(lines, step)[:, : width * size]
    if is_deep:
        order = ">u2" if message.is_bigendian else "<u2"
        used = upper_bits(np.ascontiguousarray(used).view(order), where)
        size //= 2
    used = used.reshape(lines, width, size)
    return np.ascontiguousarray(used if how is None else cv2.cvtColor(used, how))
