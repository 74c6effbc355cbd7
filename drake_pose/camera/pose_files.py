"""Read poses of cameras: matrices, translations with rotations, and frames of ROS and MuJoCo.

A parser takes the content of a file, and returns the file's cameras or why it has another format.
"""

import math
import re
import shlex
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.camera.models import (
    Camera,
    Lens,
    PinholeCamera,
    check_pose,
    inverse_pose,
    numbers,
    pose_matrix,
)
from drake_pose.errors import CameraError, listed

END_EFFECTOR = "end effector"
"""Link of a camera on the robot's end effector whose file does not name the link."""


class Entry(NamedTuple):
    """One camera of a file."""

    # (4, 4) pose of its optical frame (x right, y down, z forward) in the world or, if it rides on
    # a link, in the link's frame [m]; None: unknown.
    X: Array | None = None
    link: str = ""  # Link on which it rides, or END_EFFECTOR; "": it stands in the world.
    # How the file was read where it does not say so itself, for a warning; "": it does.
    assumed: str = ""
    camera: Camera | None = None  # Its intrinsics, for undistorted images; None: unknown.
    lens: Lens | None = None  # Its lens, for images as taken; None: unknown, or no distortion.


class Content(NamedTuple):
    """Content of a camera file."""

    path: Path
    value: Any  # Plain values, arrays, or an XML element; None: `fault` says why there are none.
    text: str
    fault: str = ""
    episode_ids: frozenset[str] = frozenset()  # Names of the recording in files of many episodes.
    # Width and height [pixel] of the recording's pictures by camera, where they are known.
    sizes: Mapping[str, tuple[int, int]] = {}

    @property
    def mapping(self) -> dict[Any, Any]:
        """The value; empty if it is no mapping."""
        return self.value if isinstance(self.value, dict) else {}

    def root(self, *tags: str) -> ElementTree.Element | None:
        """Return the XML element if it has one of the tags."""
        is_xml = isinstance(self.value, ElementTree.Element)
        return self.value if is_xml and self.value.tag in tags else None


Parsed = dict[str, Entry] | str
"""The cameras of a file by name, or why the file has not a parser's format."""

Parser = Callable[[Content], Parsed]


def plain_key(key: Any) -> str:
    """Return a key in lower case, without all but letters and digits."""
    return re.sub(r"[^a-z0-9]", "", str(key).lower())


def pose_of(value: Any, where: str) -> Entry | None:
    """Return the pose in plain values; None: they are none.

    ``value``: a matrix (4 x 4 or 3 x 4), [x, y, z, roll, pitch, yaw], [x, y, z, qx, qy, qz, qw], a
    mapping with a translation and a rotation, or one with a pose below a name of poses. ``where``:
    start of error messages. Raises CameraError: it is not a rigid transform.
    """
    if isinstance(value, dict):
        keys = {plain_key(key): one for key, one in value.items()}
        return _moved_and_turned(keys, where) or _named_pose(keys, where)
    found = numbers(value)
    if found is None or found.size not in (6, 7, 12, 16):
        return None
    if [side for side in np.shape(value) if side > 1][1:] not in ([], [4]):
        return None
    if found.size < 12:
        turn = _rotation("rpy" if found.size == 6 else "quaternion", found[3:], where)
        return None if turn is None else _rigid(turn[0], found[:3], where, turn[1])
    matrix = np.eye(4)
    matrix[: found.size // 4] = found.reshape(-1, 4)
    return Entry(check_pose(matrix, "the pose", where, most=ROUNDED))


ROUNDED = 0.01
"""Maximum deviation of R R^T from the identity in files of poses, which may have few decimals."""


def _rigid(R: Array, p: Array, where: str, assumed: str) -> Entry:
    """Return the pose of a rotation (3, 3) and a translation (3,) [m]."""
    return Entry(check_pose(pose_matrix(R, p), "the pose", where, most=ROUNDED), assumed=assumed)


_HAND = "gripper|hand|flange|tool|tcp|eef?|endeffector|wrist"
_BASE, _CAMERA, _END = f"(world|base|robot|{_HAND})", "cam(era)?", "(transform|matrix|pose)?"
_INVERSE = re.compile(
    f"[txh]?(cw|w2c|{_BASE}(to|2){_CAMERA}|{_CAMERA}t?{_BASE}|viewmatrix|extrinsiccv){_END}"
)
_POSE = re.compile(
    f"[txh]?(wc|c2w|{_CAMERA}(to|2){_BASE}|{_BASE}t?{_CAMERA}|({_CAMERA})?(pose|extrinsics?)){_END}"
    "|transform|transformation|matrix|calibration"
)


def _named_pose(keys: Mapping[str, Any], where: str) -> Entry | None:
    """Return the first pose of a mapping, by plain keys, whose key says what it is; or None.

    T_base_cam and cam_to_base are the camera's pose in the base, T_cam_base and base_to_cam the
    inverse. A gripper or its like in place of the base means that the camera is on END_EFFECTOR.
    """
    # The results of cv2.calibrateHandEye are R_cam2gripper and t_cam2gripper.
    pairs = {
        key[1:]: {"r": one, "t": keys["t" + key[1:]]}
        for key, one in keys.items()
        if key.startswith("r") and "t" + key[1:] in keys
    }
    for key, one in {**keys, **pairs}.items():
        is_inverse = _INVERSE.fullmatch(key)
        found = pose_of(one, where) if is_inverse or _POSE.fullmatch(key) else None
        if found is not None and found.X is not None:
            X = inverse_pose(found.X) if is_inverse else found.X
            return found._replace(X=X, link=END_EFFECTOR if re.search(_HAND, key) else "")
    return None


_MOVES = ("translation", "translationvector", "position", "pos", "trans", "xyz", "tvec", "t", "p",
          "location")  # fmt: skip
_TURNS = ("rotation", "rotationmatrix", "r", "rot", "mat", "orientation", "rvec", "rotvec",
          "rotationvector", "rpy", "rpydeg", "euler", "eulerangles", "eulerdeg", "q", "quat",
          "quaternion", "quatwxyz", "quaternionwxyz", "quatxyzw", "quaternionxyzw")  # fmt: skip


def _moved_and_turned(keys: Mapping[str, Any], where: str) -> Entry | None:
    """Return the pose of a mapping, by plain keys, with a translation and a rotation; or None."""
    places = [_together(keys, ("x", "y", "z")), *(keys.get(key) for key in _MOVES)]
    for place in places:
        if isinstance(place, dict):
            place = _together(place, ("x", "y", "z")) or place
        p = numbers(place)
        if p is None or p.size != 3:
            continue
        turns = [("", keys)] if {"qx", "roll"} & {*keys} else []
        for key, value in [*turns, *((key, keys.get(key)) for key in _TURNS)]:
            if (turn := _rotation(key, value, where)) is not None:
                return _rigid(turn[0], p, where, turn[1])
    return None


def _together(keys: Mapping[Any, Any], names: Sequence[str]) -> list[Any] | None:
    """Return the values of a mapping's keys by their names; None: one is missing."""
    plain = {plain_key(key): value for key, value in keys.items()}
    return [plain[name] for name in names] if {*names} <= {*plain} else None


def _rotation(key: str, value: Any, where: str) -> tuple[Array, str] | None:
    """Return the rotation (3, 3) below a plain key, and what was assumed about it; None: none.

    A quaternion is read as x, y, z, w, ROS' order, unless the key says wxyz. Three numbers are
    roll, pitch and yaw about fixed axes, in degrees if the key says so or one is more than a turn
    in radians, or else a rotation vector [rad].
    """
    is_said = key.endswith(("wxyz", "xyzw"))
    if isinstance(value, dict):
        q = _together(value, ("qx", "qy", "qz", "qw")) or _together(value, ("x", "y", "z", "w"))
        angles = _together(value, ("roll", "pitch", "yaw"))
        is_said = is_said or bool(q or angles)
        key, value = (key, q or value) if angles is None else (f"rpy{key}", angles)
    found = numbers(value)
    if found is None or found.size not in (3, 4, 9):
        return None
    if found.size == 9:
        return found.reshape(3, 3), ""
    if found.size == 4:
        length = float(np.linalg.norm(found))
        if abs(length - 1.0) > 2.0 * ROUNDED:
            raise CameraError(f"{where}: its quaternion has the length {length:.3g}, not 1")
        R = Rotation.from_quat(np.roll(found, -1) if key.endswith("wxyz") else found).as_matrix()
        return R, "" if is_said else "its quaternion is read as x, y, z, w"
    is_vector = key in ("rvec", "rotvec", "rotationvector")
    in_degrees = not is_vector and ("deg" in key or float(np.abs(found).max()) > 2.0 * math.pi)
    if in_degrees or key.startswith(("rpy", "euler")):
        R = Rotation.from_euler("xyz", found, degrees=in_degrees).as_matrix()
        unit = "deg" if in_degrees else "rad"
        return R, "" if is_said else f"its angles are read as roll, pitch, yaw [{unit}]"
    R = Rotation.from_rotvec(found).as_matrix()
    return R, "" if is_vector else "its rotation is read as a rotation vector [rad]"


def static_publishers(content: Content) -> Parsed:
    """Read a launch file (XML or Python) of ROS with static transforms.

    Arguments of ``static_transform_publisher`` may be in order (x, y, z, then yaw, pitch, roll or a
    quaternion x, y, z, w, parent, child) or named (--x, --qx, --frame-id ...).
    """
    name = "static_transform_publisher"
    texts, found, quaternion = list[str](), list[dict[str, Any]](), ("qx", "qy", "qz", "qw")
    if (launch := content.root("launch")) is not None:
        nodes = [one for one in launch.iter("node") if name in (one.get("type"), one.get("exec"))]
        texts = [node.get("args", "") for node in nodes]
    elif "LaunchDescription" in content.text or "Node(" in content.text:
        blocks = [one for one in content.text.split("Node(") if name in one]
        lists = [re.search(r"arguments\s*=\s*\[(.*?)\]", one, re.DOTALL) for one in blocks]
        texts = [one[1].replace(",", " ") for one in lists if one is not None]
    for text in texts:
        try:
            given = shlex.split(text)
            if "--frame-id" in given:
                keys, given = [key.lstrip("-") for key in given[::2]], given[1::2]
            else:
                turns = quaternion if _floats(given[6]) else ("yaw", "pitch", "roll")
                keys = [*"xyz", *turns, "frame-id", "child-frame-id"]
            named = dict(zip(keys, given, strict=False))
            turns = quaternion if "qw" in named else ("roll", "pitch", "yaw")
            moved = {key: float(named.get(key, 0.0)) for key in (*"xyz", *turns)}
            ends = {"frame_id": named["frame-id"], "child_frame_id": named["child-frame-id"]}
        except (ValueError, LookupError):
            continue
        found.append({**ends, "transform": moved})
    return transforms(content._replace(value=found)) if found else f"no {name}"


def transforms(content: Content) -> Parsed:
    """Read TransformStamped messages: one, a list, `transforms`, or by any names.

    The cameras are the frames to which no other is attached.
    """
    messages = content.mapping.get("transforms", content.value)
    if isinstance(messages, dict):
        messages = [messages, *messages.values()]
    frames, poses = dict[str, tuple[str, Array]](), dict[str, Entry]()
    for one in messages if isinstance(messages, list) else ():
        child = one.get("child_frame_id", one.get("child_frame")) if isinstance(one, dict) else None
        pose = None if child is None else pose_of(one, f"{content.path}: frame '{child}'")
        if pose is not None and pose.X is not None:
            header = one["header"] if isinstance(one.get("header"), dict) else one
            parent = header.get("frame_id", one.get("parent_frame", ""))
            frames[str(child)], poses[str(child)] = (str(parent).lstrip("/"), pose.X), pose
    inner, found = {parent for parent, _ in frames.values()}, dict[str, Entry]()
    for name in [name for name in frames if name not in inner]:
        root, X = above(frames, name)
        hand = re.search(
            r"tool|flange|hand|gripper|effector|wrist|tcp|(^|_)ee(_|$)", root, re.IGNORECASE
        )
        pose = poses[name]._replace(X=X, link=root if hand else "")
        found[name] = optical(name, pose, is_turned=name.endswith("_link"))
    return found or "no child_frame_id"


def above(frames: Mapping[str, tuple[str, Array]], name: str) -> tuple[str, Array]:
    """Return the last frame above a frame, and the pose (4, 4) of the frame in it.

    frames: parent and pose of each frame in it, by name.
    """
    (parent, X), seen = frames[name], {name}
    while parent in frames and parent not in seen:
        seen.add(parent)
        parent, X_PF = frames[parent]
        X = X_PF @ X
    return parent, X


def optical(frame: str, one: Entry, is_turned: bool) -> Entry:
    """Return a camera at its optical frame, given the pose of a frame by its name.

    is_turned: whether the frame is that of a link. REP 103 of ROS: its x axis points forward and z
    up; "optical" is in the name of frames with z forward.
    """
    if not is_turned or one.X is None:
        return one
    X = one.X.copy()
    X[:3, :3] = X[:3, :3] @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    text = (
        f"frame '{frame}' is read as ROS' link of a camera, x forward and z up; its lens may "
        "stand some millimetres beside it"
    )
    return one._replace(X=X, assumed="; ".join(filter(None, [one.assumed, text])))


def urdf(content: Content) -> Parsed:
    """Read the frames of a URDF model, on fixed joints, whose names say camera or optical.

    A frame may have the name of the recording's camera instead. A camera below a joint that moves
    rides on that joint's link.
    """
    robot = content.root("robot")
    if robot is None:
        return "no <robot>"
    frames, moving = dict[str, tuple[str, Array]](), set[str]()
    for joint in robot.findall("joint"):
        parts = {one.tag: one.attrib for one in joint}
        parent, child = (parts.get(end, {}).get("link", "") for end in ("parent", "child"))
        xyz, rpy = (_floats(parts.get("origin", {}).get(k, "0 0 0")) for k in ("xyz", "rpy"))
        if not len(xyz) == len(rpy) == 3:
            raise CameraError(
                f"{content.path}: joint '{joint.get('name')}' has an origin that is no numbers: "
                "expand a xacro file first (xacro FILE > arm.urdf)"
            )
        if joint.get("type") == "fixed":
            turn = Rotation.from_euler("xyz", rpy).as_matrix()
            frames[child] = parent, pose_matrix(turn, xyz)
        else:
            moving.add(child)
    words = re.compile("camera|optical|(^|_)cam(_|$)", re.IGNORECASE)
    named = [name for name in frames if words.search(name) or name in content.sizes]
    inner = {frames[name][0] for name in named}
    seen = [name for name in named if "optical" in name or not words.search(name)]
    found = dict[str, Entry]()
    for name in seen or [name for name in named if name not in inner]:
        root, X = above(frames, name)
        text = f"link '{name}' is read as the frame of the lens, x right, y down, z forward"
        entry = Entry(X, root if root in moving else "", "" if words.search(name) else text)
        is_turned = "optical" not in name and words.search(name) is not None
        found[name] = optical(name, entry, is_turned=is_turned)
    return found or "no camera or optical in the name of a link on a fixed joint"


def _floats(text: str) -> list[float]:
    """Return the numbers of a text, between spaces or commas; empty if they are none."""
    try:
        return [float(one) for one in text.replace(",", " ").split()]
    except ValueError:
        return []


def mujoco(content: Content) -> Parsed:
    """Read the ``<camera>`` elements of a model of MuJoCo, or of a file to be included in one.

    A camera inside a body is on the link of that name, unless the model holds the body still. Its
    intrinsics are ``resolution`` with ``focalpixel`` and ``principalpixel``, or with ``fovy``.
    """
    found = dict[str, Entry]()

    def read(body: ElementTree.Element, X_WB: Array, link: str) -> None:
        for one in body:
            name = one.get("name", f"{content.path.stem}_{len(found)}")
            if one.tag == "camera":
                found[name] = _mujoco_camera(name, one, X_WB, link, str(content.path))
            elif one.tag == "body":
                is_free = is_part or any(part.tag in ("joint", "freejoint") for part in one)
                pose = _mujoco_pose(one, f"{content.path}: body '{name}'")
                read(one, np.eye(4) if is_free else X_WB @ pose, name if is_free else link)
            elif one.tag in ("worldbody", "frame"):
                read(one, X_WB @ _mujoco_pose(one, str(content.path)), link)

    root = content.root("mujoco", "mujocoinclude")
    if root is not None:
        is_part = root.tag == "mujocoinclude"
        read(root, np.eye(4), "")
    return found or "no <camera>"


def _mujoco_pose(one: ElementTree.Element, where: str) -> Array:
    """Return the pose (4, 4) of an element of MuJoCo in its parent."""
    if {"euler", "axisangle", "zaxis"} & {*one.attrib}:
        raise CameraError(f"{where}: its rotation must be quat or xyaxes")
    turn = {"quat_wxyz": _floats(one.get("quat", "1 0 0 0"))}
    if len(axes := _floats(one.get("xyaxes", ""))) == 6:
        x, y = (axis / np.linalg.norm(axis) for axis in np.reshape(axes, (2, 3)))
        turn = {"rotation": np.column_stack([x, y, np.cross(x, y)]).tolist()}
    found = pose_of({"pos": _floats(one.get("pos", "0 0 0")), **turn}, where)
    if found is None or found.X is None:
        raise CameraError(f"{where}: pos must be three numbers, quat four, xyaxes six")
    return found.X


def _mujoco_camera(name: str, one: ElementTree.Element, X_WB: Array, link: str, path: str) -> Entry:
    """Return a camera of MuJoCo in a body whose pose in the world, or link, is X_WB (4, 4)."""
    where = f"{path}: camera '{name}'"
    if (mode := one.get("mode", "fixed")) != "fixed":
        raise CameraError(f"{where}: its mode {mode} moves it; give its pose with mode fixed")
    X = X_WB @ _mujoco_pose(one, where) @ np.diag([1.0, -1.0, -1.0, 1.0])
    size = [int(side) for side in _floats(one.get("resolution", ""))]
    focal, shift = _floats(one.get("focalpixel", "")), _floats(one.get("principalpixel", "0 0"))
    for fovy in [] if focal else _floats(one.get("fovy", "")):
        focal = [0.5 * size[-1] / math.tan(0.5 * math.radians(fovy))] * 2 if size else []
    if not len(size) == len(focal) == len(shift) == 2:
        return Entry(X, link)
    centre = (0.5 * (np.array(size) - 1.0) - shift).tolist()
    camera = PinholeCamera(name, size[0], size[1], focal[0], focal[1], centre[0], centre[1], X)
    return Entry(X, link, camera=camera)


def tf2_echo(content: Content) -> Parsed:
    """Read what ``tf2_echo BASE CAMERA`` prints: `Translation` and `in Quaternion`, repeatedly."""
    number = r"[^\[\n]*\[([^\]]*)\]"
    moves = re.findall(f"Translation:{number}", content.text)
    turns = re.findall(f"in Quaternion{number}", content.text)
    if not moves or len(moves) != len(turns):
        return "no Translation"
    text = "is read as the camera's pose in the base, as tf2_echo BASE CAMERA prints it"
    poses = [
        pose_of([*_floats(place), *_floats(turn)], str(content.path))
        for place, turn in zip(moves, turns, strict=True)
    ]
    return standing([one for one in poses if one is not None], content.path, text)


def standing(poses: Sequence[Entry], path: Path, assumed: str = "") -> Parsed:
    """Return the one camera of poses without a name, such as one for each frame.

    path: the file, whose name is the camera's. Raises CameraError: the poses differ by more than
    their rounding.
    """
    matrices = np.array([one.X for one in poses if one.X is not None])
    spread = float(np.ptp(matrices, axis=0).max()) if len(matrices) else 0.0
    if spread > 0.1 * ROUNDED:
        raise CameraError(
            f"{path}: has {len(matrices)} poses without the names of cameras, which differ by up "
            f"to {spread:.3g}: give one pose, or each below its camera's name (NAME: POSE); a "
            "camera that rides on a link has one pose there (link, X_LC)"
        )
    if not len(matrices):
        return "no pose"
    return {path.stem: poses[-1]._replace(assumed=assumed or poses[-1].assumed)}


def short_name(frame: str) -> str:
    """Return a frame's name without ends such as ``_color_optical_frame``, ROS' of one camera."""
    ends = r"(_(color|rgb|depth|infra\d?|left|right))?(_optical)?(_frame|_link|_base)$"
    return re.sub(ends, "", frame)


def choose_frames(frames: Iterable[str], cameras: Sequence[str], path: Path) -> dict[str, str]:
    """Return the frame of a file that means each camera, by the camera's name.

    A frame means the camera of its name; or that of DROID's left lens, ``<serial>_left`` for
    ``<serial>`` and the reverse; or the only one of the same ``short_name``. If all frames have one
    short name, they mean the only camera. Of several frames of a camera, one by the first of these
    rules is chosen, then one of colours, then an optical one.

    Raises CameraError, naming ``path``: several frames of a camera are equally good.
    """
    found = dict[str, list[tuple[list[bool], str]]]()
    short = {frame: plain_key(short_name(frame)) for frame in frames}
    for frame, key in short.items():
        exact = [x for x in (frame, f"{frame}_left", frame.removesuffix("_left")) if x in cameras]
        alike = exact[:1] or [one for one in cameras if plain_key(short_name(one)) == key]
        if not alike and len({*short.values()}) == 1:
            alike = [*cameras]
        if len(alike) == 1:
            kinds = [frame in cameras, bool(exact), "color" in frame or "rgb" in frame]
            found.setdefault(alike[0], []).append(([*kinds, "optical" in frame], frame))
    for camera, ranked in found.items():
        best = [frame for kinds, frame in ranked if kinds == max(ranked)[0]]
        if len(best) > 1:
            raise CameraError(
                f"{path}: {listed(best)} are equally good names of camera '{camera}': keep one"
            )
    return {camera: max(ranked)[1] for camera, ranked in found.items()}
