"""Read files with poses of cameras but without their intrinsics.

Such are the results of easy_handeye (ROS 1 and 2) and MoveIt's hand-eye calibration, launch files
and messages of static transforms, DROID's calibrations of its episodes (KarlP/droid, DROID-3D), and
plain mappings from a camera's name to its pose. A pose is a matrix, a position with Euler angles,
or a translation with a quaternion, a rotation vector, Euler angles or a matrix.
"""

import json
import math
import re
import shlex
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.camera.models import check_pose, inverse_pose
from drake_pose.errors import CameraError, listed
from drake_pose.input_files import read_regular

END_EFFECTOR = "end effector"
"""Link of a camera on the robot's end effector whose file does not name the link."""


class RecordedPose(NamedTuple):
    """Pose of a camera's optical frame (x right, y down, z forward)."""

    X: Array  # (4, 4) pose in the world, or in the link's frame [m].
    link: str = ""  # Link on which the camera rides; "": it stands in the world.
    # How the file was read where it does not say so itself, for a warning; "": it does.
    assumed: str = ""


def recorded_poses(
    content: Any, path: Path, episode_ids: Collection[str] = ()
) -> dict[str, RecordedPose]:
    """Return the poses of the cameras in a file, by name; empty if it is not such a file.

    ``content``: content of the file as plain values, as from ``read_camera_content``. ``path``: the
    file, for messages and a camera without a name. ``episode_ids``: names by which the recording
    may be known in a file of many episodes.

    Raises CameraError: a rotation is none, or it is unclear which of many episodes is meant.
    """
    if isinstance(content, dict) and isinstance(content.get("transforms"), list):
        content = content["transforms"]
    if isinstance(content, list):
        if not any(isinstance(one, dict) and "T0_ext1_in_world" in one for one in content):
            return _transforms(content, path)
        # Despite their names, these map the world to the camera.
        keys = {"ext1": "T0_ext1_in_world", "ext2": "T1_ext2_in_world"}
        content = {
            str(one.get("episode_uuid", number)): {
                name: {"world_to_camera": one[key]} for name, key in keys.items() if key in one
            }
            for number, one in enumerate(content)
        }
    if not isinstance(content, dict):
        return {}
    # Fields of this program's and Drake's cameras, which have intrinsics beside the pose.
    own = {"width", "focal_x", "pixels_per_metre", "focal", "X_PB", "X_LC", "projection"}
    if any(isinstance(one, dict) and own & {*one} for one in (content, *content.values())):
        return {}
    if _is_transform(content):
        return _transforms([content], path)
    if (alone := _pose_of(content, f"{path}")) is not None:
        # The words of easy_handeye.
        more = content.get("parameters")
        words = content | (more if isinstance(more, dict) else {})
        on_hand = words.get("eye_on_hand") is True or words.get("calibration_type") == "eye_in_hand"
        link = str(words.get("robot_effector_frame") or END_EFFECTOR) if on_hand else ""
        name = str(words.get("tracking_base_frame") or words.get("camera_name") or path.stem)
        return {name: _optical(name, alone._replace(link=link))}
    found = _poses_by_name(content, path)
    if found:
        return found
    entries = {str(key): one for key, one in content.items() if isinstance(one, dict)}
    groups = episode_entry(entries, path, episode_ids)
    return _poses_by_name(groups, path) if groups else {}


def episode_entry(
    entries: Mapping[str, Mapping[Any, Any]], path: Path, episode_ids: Collection[str]
) -> Mapping[Any, Any] | None:
    """Return the entry of one episode of a file that is keyed by episodes; None: it has none.

    ``entries``: entries of the file by key. ``path``: the file, for messages. ``episode_ids``:
    names by which the recording may be known. Raises CameraError: there are several, and none
    belongs to the recording.
    """
    held = {
        key: one
        for key, one in entries.items()
        if any(
            _looks_posed(value)
            # Four numbers, as DROID's intrinsics.
            or (isinstance(value, list) and len(value) == 4 and _numbers(value) is not None)
            for value in one.values()
        )
    }
    own = [key for key in held if key in episode_ids]
    if len(own) == 1 or len(held) == 1:
        return held[(own or [*held])[0]]
    if not held:
        return None
    known = f"this recording's are {listed(sorted(episode_ids))}" if episode_ids else (
        "this recording has no metadata_<episode ID>.json that says which is its own"
    )  # fmt: skip
    raise CameraError(
        f"{path}: has {len(held)} entries, from {next(iter(held))} on; {known}: keep only the "
        "entry of the episode in the file"
    )


def read_launch(text: str) -> list[dict[str, Any]] | None:
    """Return the static transforms of a launch file (XML or Python) as TransformStamped messages.

    The result is None if the text is not such a file. Arguments of ``static_transform_publisher``
    may be in order (x, y, z, then yaw, pitch, roll or a quaternion x, y, z, w, parent, child) or
    named (--x, --qx, --frame-id ...).
    """
    if "static_transform_publisher" not in text:
        return None
    words, found, quaternion = list[list[str]](), list[dict[str, Any]](), ("qx", "qy", "qz", "qw")
    if text.lstrip().startswith("<"):
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError:
            return None
        for node in root.iter("node"):
            if "static_transform_publisher" in (node.get("type"), node.get("exec")):
                words.append(shlex.split(node.get("args", "")))
    else:
        for block in text.split("static_transform_publisher")[1:]:
            own = re.search(r"arguments\s*=\s*\[(.*?)\]", block, re.DOTALL)
            pairs = re.findall(r"[\"']([^\"']*)[\"']|([-+.\deE]+)", own[1]) if own else []
            words.append([quoted or number for quoted, number in pairs])
    for given in words:
        named = {k.lstrip("-"): v for k, v in zip(given[::2], given[1::2], strict=False)}
        try:
            if "frame-id" in named:
                ends = named["frame-id"], named["child-frame-id"]
            else:
                is_number = re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", given[6], re.IGNORECASE)
                keys = [*"xyz", *(quaternion if is_number else ("yaw", "pitch", "roll"))]
                named = dict(zip(keys, given, strict=False))
                ends = given[len(keys)], given[len(keys) + 1]
            turn = {key: float(named[key]) for key in quaternion if key in named}
            rpy = [float(named.get(key, 0.0)) for key in ("roll", "pitch", "yaw")]
            place = {key: float(named.get(key, 0.0)) for key in "xyz"}
        except (ValueError, LookupError):
            continue
        moved = {"translation": place, **({"rotation": turn} if turn else {"rpy": rpy})}
        frames = {"header": {"frame_id": ends[0]}, "child_frame_id": ends[1]}
        found.append({**frames, "transform": moved})
    return found


def _is_transform(entry: Any) -> bool:
    """Return whether an entry names its child frame, as TransformStamped does."""
    return isinstance(entry, dict) and bool({"child_frame_id", "child_frame"} & {*entry})


def _transforms(entries: Sequence[Any], path: Path) -> dict[str, RecordedPose]:
    """Return the poses of the frames that no other one is attached to, by the frame's name."""
    frames = dict[str, tuple[str, Array, str]]()
    for k, entry in enumerate(entries):
        if not isinstance(entry, dict):
            return {}
        one = _pose_of(entry, f"{path}: entry {k}")
        if one is None:
            continue
        header = entry.get("header")
        parent = header.get("frame_id", "") if isinstance(header, dict) else ""
        parent = parent or entry.get("parent_frame") or entry.get("frame_id", "")
        child = entry.get("child_frame_id") or entry.get("child_frame") or entry.get("name")
        frames[str(child or f"{path.stem}_{k}")] = str(parent).lstrip("/"), one.X, one.assumed
    inner = {parent for parent, *_ in frames.values()}
    found = dict[str, RecordedPose]()
    for name, (parent, X, assumed) in frames.items():
        if name in inner:
            continue
        above = [name]
        while parent in frames and parent not in above:
            above.append(parent)
            parent, X_PX, _ = frames[parent]
            X = X_PX @ X
        # A hand or tool, by its name; else the base.
        hand = r"tool|flange|hand|gripper|effector|wrist|tcp|(^|_)ee(_|$)"
        found[name] = _optical(
            name, RecordedPose(X, parent if re.search(hand, parent, re.IGNORECASE) else "", assumed)
        )
    return found


def _optical(frame: str, one: RecordedPose) -> RecordedPose:
    """Return the pose of the optical frame, given that of a frame by its name.

    REP 103 of ROS: the x axis of a camera's link points forward and z up; "optical" is in the name
    of frames with z forward.
    """
    if not frame.endswith("_link"):
        return one
    X = one.X.copy()
    X[:3, :3] = X[:3, :3] @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    text = (
        f"frame '{frame}' is read as ROS' link of a camera, x forward and z up; its lens may "
        "stand some millimetres beside it"
    )
    return RecordedPose(X, one.link, "; ".join(filter(None, [one.assumed, text])))


def _poses_by_name(content: Mapping[Any, Any], path: Path) -> dict[str, RecordedPose]:
    """Return the poses of a mapping from names to poses; other entries are left out."""
    found = dict[str, RecordedPose]()
    for key, value in content.items():
        name = str(key)
        if _is_transform(value):
            found |= _transforms([value], path)
        elif (one := _pose_of(value, f"{path}: camera '{name}'")) is not None:
            found[name] = one
    return found


def _plain(key: Any) -> str:
    """Return a key in lower case, without all but letters and digits."""
    return re.sub(r"[^a-z0-9]", "", str(key).lower())


def _looks_posed(value: Any) -> bool:
    """Return whether a value is a pose, right or wrong."""
    try:
        return _pose_of(value, "") is not None
    except CameraError:
        return True


def _numbers(value: Any, keys: Sequence[str] = ()) -> Array | None:
    """Return the numbers (n,) of nested lists or of a mapping's keys; None: there are no such."""
    if isinstance(value, dict):
        plain = {_plain(key): one for key, one in value.items()}
        value = [plain[key] for key in keys if key in plain]
        if not keys or len(value) != len(keys):
            return None
    found = finite_numbers(value)
    return found if found is not None and len(found) else None


def finite_numbers(value: Any) -> Array | None:
    """Return the finite numbers (n,), by rows, of an array or of small nested lists; or None."""
    if not isinstance(value, list | tuple | np.ndarray) or not _is_small(value, 3):
        return None
    try:
        found = np.asarray(value, dtype=np.float64).ravel()
    except (ValueError, TypeError):
        return None
    return found if np.isfinite(found).all() else None


def _is_small(value: Any, depth: int) -> bool:
    """Return whether nested lists have few levels and entries; aliases of YAML may hold billions.

    ``value``: the lists; anything else is small. ``depth``: maximum number of levels. A list may
    have several times as many entries as a pose.
    """
    if not isinstance(value, list | tuple):
        return True
    return depth > 0 and len(value) <= 100 and all(_is_small(one, depth - 1) for one in value)


def _pose_of(value: Any, where: str) -> RecordedPose | None:
    """Return a pose in any of the forms of this module; None: it is none.

    where: start of error messages. Raises CameraError: a rotation is none.
    """
    if not isinstance(value, dict):
        numbers = _numbers(value)
        if numbers is None or numbers.size not in (6, 7, 12, 16):
            return None
        if numbers.size in (12, 16):
            matrix = np.eye(4)
            matrix[: numbers.size // 4] = numbers.reshape(-1, 4)
            if abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
                return None
            return _rigid(matrix[:3, :3], matrix[:3, 3], where)
        if numbers.size == 7:
            R, assumed = _quaternion(numbers[3:], "", where)
        else:
            R, unit = _euler(numbers[3:], "")
            assumed = f"its six numbers are read as x, y, z [m], roll, pitch, yaw [{unit}]"
        return _rigid(R, numbers[:3], where)._replace(assumed=assumed)
    keys = {_plain(key): one for key, one in value.items()}
    if (found := _moved_and_turned(keys, where)) is not None:
        return found
    for key, one in keys.items():
        is_inverse = _is_inverse(key)
        inner = None if is_inverse is None else _pose_of(one, where)
        if inner is None:
            continue
        return inner._replace(X=inverse_pose(inner.X)) if is_inverse else inner
    return None


def _is_inverse(key: str) -> bool | None:
    """Return whether a plain key names the pose of the world in the camera.

    False: it names the pose of the camera in the world; None: no pose. T_base_cam and cam_to_base
    are the camera's pose in the base, T_cam_base and base_to_cam the inverse.
    """
    base, camera, end = "(world|base|robot)", "cam(era)?", "(transform|matrix|pose)?$"
    inverse = f"cw|w2c|{base}(to|2){camera}|{camera}t?{base}|viewmatrix|extrinsiccv"
    pose = f"wc|c2w|{camera}(to|2){base}|{base}t?{camera}|({camera})?(pose|extrinsics?)"
    if re.match(f"^[txh]?({inverse}){end}", key):
        return True
    plain = "transform|transformation|matrix|calibration"
    return False if re.match(f"^([txh]?({pose}){end}|({plain})$)", key) else None


def _moved_and_turned(keys: Mapping[str, Any], where: str) -> RecordedPose | None:
    """Return the pose of a mapping, by plain keys, with a translation and a rotation; or None."""
    moves = ("translation", "position", "pos", "trans", "xyz", "tvec", "t", "p", "location")
    translation = _numbers(dict(keys), ("x", "y", "z"))
    for key in moves:
        if key in keys and translation is None:
            translation = _numbers(keys[key], ("x", "y", "z"))
    if translation is None or translation.size != 3:
        return None
    for key in ("qx", "roll", "rotation", "rotationmatrix", "r", "rot", "mat", "orientation",
                "rvec", "rotvec", "rotationvector", "rpy", "euler", "eulerangles", "eulerdeg",
                "rpydeg", "q", "quat", "quaternion", "quatwxyz", "quaternionwxyz", "quatxyzw",
                "quaternionxyzw"):  # fmt: skip
        if key in keys:
            value = dict(keys) if key in ("qx", "roll") else keys[key]
            turned = _rotation(key, value, where)
            if turned is not None:
                return _rigid(turned[0], translation, where)._replace(assumed=turned[1])
    return None


def _rotation(key: str, value: Any, where: str) -> tuple[Array, str] | None:
    """Return the rotation (3, 3) under a plain key, and what was assumed about it; None: none."""
    for names in (("qx", "qy", "qz", "qw"), ("x", "y", "z", "w")):
        if isinstance(value, dict) and (numbers := _numbers(value, names)) is not None:
            return _quaternion(numbers, "xyzw", where)
    if (
        isinstance(value, dict)
        and (numbers := _numbers(value, ("roll", "pitch", "yaw"))) is not None
    ):
        return _euler(numbers, key)[0], ""
    numbers = _numbers(value)
    if numbers is None:
        return None
    if numbers.size == 9:
        return numbers.reshape(3, 3), ""
    if numbers.size == 4:
        order = "wxyz" if key.endswith("wxyz") else "xyzw" if key.endswith("xyzw") else ""
        return _quaternion(numbers, order, where)
    if numbers.size != 3:
        return None
    if key.startswith(("rpy", "euler")):
        R, unit = _euler(numbers, key)
        return R, f"its angles are read as roll, pitch, yaw [{unit}]"
    if np.abs(numbers).max() > 2.0 * math.pi:
        return _euler(numbers, key)[0], "its rotation is read as roll, pitch, yaw [deg]"
    R = Rotation.from_rotvec(numbers).as_matrix()
    is_said = key in ("rvec", "rotvec", "rotationvector")
    return R, "" if is_said else "its rotation is read as a rotation vector [rad]"


def _quaternion(numbers: Array, order: str, where: str) -> tuple[Array, str]:
    """Return the rotation (3, 3) of a quaternion (4,), and what was assumed about its order.

    order: "xyzw" or "wxyz"; "": unknown, read as xyzw, ROS' order.
    """
    length = float(np.linalg.norm(numbers))
    if abs(length - 1.0) > 0.02:
        raise CameraError(f"{where}: its quaternion has the length {length:.3g}, not 1")
    turn = np.roll(numbers, -1) if order == "wxyz" else numbers
    R = np.asarray(Rotation.from_quat(turn).as_matrix())
    return R, "" if order else "its quaternion is read as x, y, z, w"


def _euler(angles: Array, key: str) -> tuple[Array, str]:
    """Return the rotation (3, 3) of roll, pitch and yaw about fixed axes, and their unit.

    The unit is "deg" if the key says so or an angle is more than a turn in radians, else "rad".
    """
    in_degrees = "deg" in key or float(np.abs(angles).max()) > 2.0 * math.pi
    R = Rotation.from_euler("xyz", angles, degrees=in_degrees).as_matrix()
    return np.asarray(R), "deg" if in_degrees else "rad"


def _rigid(R: Array, translation: Array, where: str, most: float = 0.01) -> RecordedPose:
    """Return the pose of a rotation (3, 3) and a translation (3,) [m].

    A rotation with R R^T within `most` of the identity is rounded, and is replaced by the nearest
    exact one. Raises CameraError: it is not a rotation.
    """
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, translation
    if np.abs(R @ R.T - np.eye(3)).max() < most:
        U, _, Vt = np.linalg.svd(R)
        X[:3, :3] = U @ Vt
    return RecordedPose(np.array(check_pose(X, "pose", where)))


def recording_names(recording: Path | None) -> tuple[frozenset[str], dict[str, str]]:
    """Return an episode's names in files of many, and its cameras' serial numbers by DROID's role.

    Both are those of `metadata_<episode ID>.json` in a raw folder of DROID, with the folder's own
    names; the roles are ext1, ext2 and wrist.

    recording: the recording's folder or file; None: unknown.
    """
    if recording is None:
        return frozenset(), {}
    folder = recording if recording.is_dir() else recording.parent
    ids, serials = {recording.name, recording.stem, folder.name}, dict[str, str]()
    for file in sorted(folder.glob("metadata_*.json")):
        ids.add(file.stem.removeprefix("metadata_"))
        try:
            content = json.loads(read_regular(file, 1 << 20))
        except (OSError, ValueError):
            continue
        if isinstance(content, dict):
            ids |= {str(content[key]) for key in ("uuid", "relative_path") if key in content}
            for role in ("ext1", "ext2", "wrist"):
                if (serial := content.get(f"{role}_cam_serial")) is not None:
                    serials[role] = str(serial)
    return frozenset(ids), serials


def same_camera(pose: str, known: Sequence[str]) -> str | None:
    """Return the known camera that a pose's name means; None: none, or several.

    ``<serial>_left`` is DROID's left lens of ``<serial>``; ends such as ``_color_optical_frame``
    are ROS' frames of one camera.
    """
    for name in (pose, f"{pose}_left", pose.removesuffix("_left")):
        if name in known:
            return name
    ends = r"(_(color|rgb|depth|infra\d?|left|right))?(_optical)?(_frame|_link|_base)$"
    short = re.sub(ends, "", pose)
    alike = [one for one in known if short and _plain(re.sub(ends, "", one)) == _plain(short)]
    return alike[0] if len(alike) == 1 else None
