"""Read the files of calibration tools: ROS, Kalibr, OpenCV, and the TOML of anipose and Pose2Sim.

The format is recognised by the content, not by the file's name. In all of them pixel centres are at
integers, and poses map points of the world to the camera, p_C = R p_W + T [m].
"""

import json
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.models import Lens, check_number, check_pose, check_side, inverse_pose
from drake_pose.camera.pose_files import episode_entry, finite_numbers, read_launch, recorded_poses
from drake_pose.errors import CameraError
from drake_pose.input_files import read_regular, read_yaml

FORMATS = (
    "this program's cameras.yaml, Drake's CameraConfig or Scenario, ROS camera_info, Kalibr's "
    "camchain, OpenCV's FileStorage (camera_matrix, distortion_coefficients, image_width, "
    "image_height, R, T), and the TOML of anipose, Pose2Sim or Caliscope; and, beside a file with "
    "intrinsics, the poses of easy_handeye (.yaml, .calib), MoveIt's and other launch files of "
    "static transforms, TransformStamped, DROID's cam2base_extrinsics.json, DROID-3D's "
    "extrinsics.jsonl, and NAME: POSE, where POSE is a 4 x 4 matrix, [x, y, z, roll, pitch, yaw], "
    "[x, y, z, qx, qy, qz, qw], or translation and rotation"
)
"""Supported formats of camera files, for messages."""


def read_camera_content(
    path: Path,
    largest: int = 1 << 20,
    largest_json: int = 1 << 29,
    episode_ids: Collection[str] = (),
) -> Any:
    """Return the content of a YAML, JSON, TOML, FileStorage or launch file as plain values.

    Matrices of a FileStorage are arrays. A launch file is a list of its static transforms.

    ``largest``: maximum size of the file [byte]. ``largest_json``: the same for `.json` and
    `.jsonl` [byte]. ``episode_ids``: of a `.jsonl`, only the lines that hold one of these names are
    read, if any do. Raises CameraError: the file cannot be read.
    """
    is_json = path.suffix in (".json", ".jsonl")
    try:
        data = read_regular(path, (largest_json if is_json else largest) + 1)
    except OSError as error:
        raise CameraError(f"{path}: cannot read it: {error.strerror}") from error
    text = data.decode("utf-8", errors="replace")
    if path.suffix == ".jsonl" or (is_json and len(data) > largest):
        try:
            if path.suffix == ".json":
                return json.loads(text)
            records = [line for line in text.splitlines() if line.strip()]
            own = [line for line in records if any(f'"{one}"' in line for one in episode_ids)]
            return [json.loads(line) for line in own or records]
        except ValueError as error:
            raise CameraError(f"{path}: not a JSON file: {error}") from error
    if len(data) <= largest and (launched := read_launch(text)) is not None:
        return launched
    if len(data) <= largest and text.startswith(("<?xml", "<opencv_storage", "%YAML:1.0")):
        try:
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            return _plain(storage.root())
        # OpenCV raises SystemError if the file is truncated.
        except (cv2.error, SystemError) as error:
            raise CameraError(f"{path}: not a file of OpenCV's FileStorage: {error}") from error
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith("#")), "")
    if len(data) <= largest and re.fullmatch(r"\[[^\[\],{}]+\]|[\w.-]+\s*=.*", first):
        try:
            return tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise CameraError(f"{path}: not a TOML file: {error}") from error
    return read_yaml(path, CameraError)


def calibrated_cameras(
    content: Any, path: Path, episode_ids: Collection[str] = ()
) -> dict[str, tuple[Lens, Array | None]]:
    """Return the cameras in a calibration tool's file, by name; empty if it is not such a file.

    In Kalibr's camchain the first camera is the world. A single camera without a name gets the
    file's.

    ``content``: content of the file, as from ``read_camera_content``. ``path``: the file, for
    messages and a camera without a name. ``episode_ids``: names by which the recording may be known
    in DROID's files of many episodes.

    Returns the lens and the pose X_WC (4, 4) [m] of each camera by name; None: the file has no
    pose.

    Raises CameraError: a field is missing or invalid, OpenCV does not have the lens model, or a
    camera is so far away that lengths cannot be in metres.
    """
    if isinstance(content, list):
        return _droid_3d(content, path)
    if "camera_matrix" in content:
        name = str(content.get("camera_name", path.stem))
        where = f"{path}: camera '{name}'"
        size = [content.get(f"image_{side}") for side in ("width", "height")]
        if None in size:
            raise CameraError(f"{where}: needs image_width and image_height [pixel]: add them")
        numbers = content["camera_matrix"], content.get("distortion_coefficients", ())
        lens = lens_of(size, *numbers, str(content.get("distortion_model", "plumb_bob")), where)
        # The R of a camera_info rectifies images and is not a pose; it has no T.
        return {name: (lens, _pose(content, "R", "T", where) if "T" in content else None)}
    entries = {str(key): one for key, one in content.items() if isinstance(one, dict)}
    chain = {k: one for k, one in entries.items() if {"camera_model", "intrinsics"} <= {*one}}
    if chain:
        return dict(_kalibr(chain, path))
    tables = {k: one for k, one in entries.items() if {"matrix", "distortions"} & {*one}}
    found = dict[str, tuple[Lens, Array | None]]()
    for key, table in tables.items():
        name, where = str(table.get("name", key)), f"{path}: camera '{key}'"
        if name in found:
            raise CameraError(f"{where}: the name '{name}' is given twice")
        numbers = table.get("matrix"), table.get("distortions", ())
        lens = _lens(table.get("size"), *numbers, bool(table.get("fisheye", False)), where)
        found[name] = lens, _pose(table, "rotation", "translation", where)
    if not found and (single := _camera_info(content, f"{path}: camera '{path.stem}'")):
        return {str(content.get("camera_name", path.stem)): (single, None)}
    for key, entry in () if found else entries.items():
        if (own := _camera_info(entry, f"{path}: camera '{key}'")) is not None:
            poses = recorded_poses({key: entry}, path)
            found[key] = own, poses[key].X if key in poses else None
    return found or _droid_intrinsics(entries, path, episode_ids)


def _camera_info(entry: Mapping[Any, Any], where: str) -> Lens | None:
    """Return the lens of a ROS CameraInfo message, or of width, height and fx, fy, cx, cy.

    A CameraInfo has K or k; librealsense says ppx and ppy for cx and cy. None: it is neither.
    """
    one = {str(key).lower(): value for key, value in entry.items()}
    if isinstance(one.get("intrinsics"), dict):
        one |= {str(key).lower(): value for key, value in one["intrinsics"].items()}
    numbers = [one.get(key, one.get(other)) for key, other in
               (("fx", "fx"), ("fy", "fy"), ("cx", "ppx"), ("cy", "ppy"))]  # fmt: skip
    matrix = next((one[key] for key in ("k", "intrinsic_matrix", "intrinsics") if key in one), None)
    if None not in numbers:
        matrix = [numbers[0], 0.0, numbers[2], 0.0, numbers[1], numbers[3], 0.0, 0.0, 1.0]
    found = _numbers(matrix)
    if found is None or found.size != 9 or not {"width", "height"} <= {*one}:
        return None
    distortion = next((one[key] for key in ("d", "coeffs", "distortion") if key in one), ())
    model = str(one.get("distortion_model", "plumb_bob")) or "plumb_bob"
    return lens_of([one["width"], one["height"]], matrix, distortion or (), model, where)


def _droid_intrinsics(
    entries: Mapping[str, Mapping[Any, Any]],
    path: Path,
    episode_ids: Collection[str],
    size: tuple[int, int] = (1280, 720),
) -> dict[str, tuple[Lens, Array | None]]:
    """Return the lenses of DROID's intrinsics.json, by serial number; empty if it is none.

    Its entries are [fx, cx, fy, cy] by serial number, by episode.

    size: width and height of the pictures to which they apply: HD720 [pixel].
    """
    rows = [_numbers(value) for one in entries.values() for value in one.values()]
    if not rows or any(one is None or one.shape != (4,) or one.min() < 1.0 for one in rows):
        return {}
    found = dict[str, tuple[Lens, Array | None]]()
    for serial, (fx, cx, fy, cy) in (episode_entry(entries, path, episode_ids) or {}).items():
        matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        found[str(serial)] = _lens(size, matrix, (), False, f"{path}: camera '{serial}'"), None
    return found


def _droid_3d(records: Sequence[Any], path: Path) -> dict[str, tuple[Lens, Array | None]]:
    """Return the lenses of DROID-3D's camera_intrinsics.jsonl, by serial number, of one episode.

    Empty if it is not such a file. Raises CameraError: it holds several episodes.
    """
    held = [
        one for one in records if isinstance(one, dict) and isinstance(one.get("cameras"), dict)
    ]
    if not held:
        return {}
    if len(held) > 1:
        raise CameraError(
            f"{path}: has {len(held)} episodes, and this recording does not say which is its own: "
            "keep only its line"
        )
    found = dict[str, tuple[Lens, Array | None]]()
    for role, one in held[0]["cameras"].items():
        where = f"{path}: camera '{role}'"
        left = one.get("left") if isinstance(one, dict) else None
        # The recorded pictures are rectified: their distortion is removed.
        lens = None if not isinstance(left, dict) else _camera_info(left | {"disto": ()}, where)
        if lens is not None:
            found[str(one.get("serial") or role)] = lens, None
    return found


def _plain(node: Any) -> Any:
    """Return a node of OpenCV's FileStorage as mappings, lists, arrays, texts and numbers."""
    if node.isMap():
        if {"rows", "cols", "data"} <= {*node.keys()}:
            return np.asarray(node.mat(), dtype=np.float64)
        return {name: _plain(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_plain(node.at(k)) for k in range(node.size())]
    return node.string() if node.isString() else node.real()


def _numbers(value: Any) -> Array | None:
    """Return the finite numbers (n,), by rows, of an array, list or mapping ``data``; or None."""
    if isinstance(value, dict):
        value = value.get("data")
    return finite_numbers(value)


def lens_of(size: Any, matrix: Any, distortion: Any, model: str, where: str) -> Lens:
    """Return a lens by the name that ROS and Kalibr give to its distortion model.

    The first three arguments are checked; each may be a list, an array, or a mapping whose ``data``
    is a list.

    Args:
        size: width and height [pixel].
        matrix: (3, 3) camera matrix, or its 9 elements by rows [pixel].
        distortion: OpenCV's distortion coefficients; empty: none.
        model: name of the distortion model.
        where: start of error messages.

    Raises CameraError: the model is unknown, or a value is invalid.
    """
    kinds = {"plumb_bob": False, "rational_polynomial": False, "radtan": False, "none": False}
    kinds |= {"equidistant": True, "fisheye": True}  # OpenCV's fisheye.
    if model not in kinds:
        raise CameraError(
            f"{where}: distortion_model '{model}' is unknown; known are {', '.join(kinds)}"
        )
    return _lens(size, matrix, distortion, kinds[model], where)


def _kalibr(
    chain: Mapping[str, Mapping[str, Any]], path: Path
) -> Iterator[tuple[str, tuple[Lens, Array | None]]]:
    """Yield the name, lens and pose X_WC (4, 4) [m] of each camera of Kalibr's camchain.

    The first camera is the world. Poses follow from T_cn_cnm1, the previous camera's pose in each
    camera. The pose is None for all cameras if none has it, and else for a later camera that lacks
    it and those after it.

    ``chain``: entries of the file by camera, in order. ``path``: the file, for messages.
    """
    is_chain = any("T_cn_cnm1" in entry for entry in chain.values())
    X_CW: Array | None = np.eye(4) if is_chain else None
    for k, (name, entry) in enumerate(chain.items()):
        where, numbers = f"{path}: camera '{name}'", _numbers(entry["intrinsics"])
        if entry["camera_model"] != "pinhole":
            raise CameraError(
                f"{where}: Kalibr's '{entry['camera_model']}' camera is not supported: calibrate "
                "it as a pinhole with radtan, equidistant or none"
            )
        if numbers is None or numbers.size != 4:
            raise CameraError(f"{where}: intrinsics must be [f_x, f_y, c_x, c_y]")
        fx, fy, cx, cy = numbers.tolist()
        matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        model, coefficients = str(entry.get("distortion_model")), entry.get("distortion_coeffs", ())
        lens = lens_of(entry.get("resolution"), matrix, coefficients, model, where)
        if k and X_CW is not None:
            step = entry.get("T_cn_cnm1")
            X_CW = None if step is None else check_pose(step, "T_cn_cnm1", where) @ X_CW
        yield name, (lens, None if X_CW is None else inverse_pose(X_CW))


def _lens(
    size: Any, matrix: Any, distortion: Any, fisheye: bool, where: str, largest_skew: float = 1e-3
) -> Lens:
    """Return a lens from a size [pixel], a camera matrix (3, 3) [pixel] and OpenCV's coefficients.

    ``size``, ``matrix``, ``distortion``: values of the file, not yet checked. ``fisheye``: whether
    the coefficients are those of OpenCV's fisheye. ``where``: start of error messages.
    ``largest_skew``: maximum skew that is ignored [f_x]; it amounts to half a pixel at the edge of
    an image.

    Raises CameraError: a value is missing or invalid.
    """
    sides, K, D = (_numbers(one) for one in (size, matrix, distortion))
    if sides is None or sides.size != 2:
        raise CameraError(f"{where}: needs the pictures' width and height [pixel]")
    width, height = (
        check_side(side, name, where) for side, name in zip(sides, ("width", "height"), strict=True)
    )
    if K is None or K.size != 9 or not (K[0] > 0.0 and K[4] > 0.0 and K[8] == 1.0):
        raise CameraError(
            f"{where}: its camera matrix must be [[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]] [pixel]"
        )
    if abs(K[1]) > largest_skew * K[0]:
        raise CameraError(
            f"{where}: its camera matrix has a skew of {K[1]:g} pixels, which is not modelled: "
            "calibrate without skew, or set it to 0 if it is negligible"
        )
    if D is None:
        raise CameraError(f"{where}: its distortion coefficients must be a list of finite numbers")
    D = D if D.size else np.zeros(4)
    counts = (4,) if fisheye else (4, 5, 8, 12, 14)
    D = D[:4] if fisheye and not D[4:].any() else D
    if D.size not in counts:
        raise CameraError(
            f"{where}: has {D.size} distortion coefficients; OpenCV's "
            f"{'fisheye' if fisheye else 'lens'} has {' or '.join(map(str, counts))}"
        )
    return Lens(width, height, np.array([[K[0], 0, K[2]], [0, K[4], K[5]], [0, 0, 1]]), D, fisheye)


def _pose(
    content: Mapping[Any, Any], rotation: str, translation: str, where: str, farthest: float = 100.0
) -> Array | None:
    """Return X_WC (4, 4) of p_C = R p_W + T; None if there is neither R nor T.

    ``content``: a camera's entry in the file. ``rotation``, ``translation``: keys of R, a matrix or
    a rotation vector [rad], and T [m]. ``where``: start of error messages. ``farthest``: maximum
    distance from the world's origin [m]; beyond it lengths are taken to be in millimetres.
    """
    if rotation not in content and translation not in content:
        return None
    R, T = _numbers(content.get(rotation)), _numbers(content.get(translation))
    if R is None or T is None or R.size not in (3, 9) or T.size != 3:
        raise CameraError(
            f"{where}: {rotation} must be a 3 x 3 matrix or a rotation vector [rad], and "
            f"{translation} three numbers [m]"
        )
    X_CW = np.eye(4)
    X_CW[:3, :3] = R.reshape(3, 3) if R.size == 9 else cv2.Rodrigues(R)[0]
    X_CW[:3, 3] = [check_number(one, translation, where) for one in T]
    away = float(np.linalg.norm(T))
    if away > farthest:
        raise CameraError(
            f"{where}: stands {away:.0f} m from the world's origin; are its lengths millimetres? "
            f"Give {translation} in metres"
        )
    return inverse_pose(check_pose(X_CW, rotation, where))
