"""What calibration tools write: ROS, Kalibr, OpenCV, and the TOML of anipose and Pose2Sim.

The formats are told apart by their content, not by the file's name. All of them count pixel
centres at integers. Their poses take points of the world to the camera, p_C = R p_W + T [m].
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.models import Lens, check_number, check_pose, check_side, inverse_pose
from drake_pose.errors import CameraError
from drake_pose.regular_files import read_regular
from drake_pose.yaml_files import read_yaml

FORMATS = (
    "this program's cameras.yaml, Drake's CameraConfig or Scenario, ROS camera_info, Kalibr's "
    "camchain, OpenCV's FileStorage (camera_matrix, distortion_coefficients, image_width, "
    "image_height, R, T), and the TOML of anipose, Pose2Sim or Caliscope"
)
"""The camera files that are read."""

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "K", "k")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "d")
# Distortion models of ROS and Kalibr: OpenCV's own, and OpenCV's fisheye.
_RADIAL = {"plumb_bob", "rational_polynomial", "radtan", "none", ""}
_FISHEYE = {"equidistant", "fisheye"}


class CalibratedCamera(NamedTuple):
    """A camera as a calibration tool wrote it; X_WC (4, 4) is None where it has no pose."""

    lens: Lens
    X_WC: Array | None


def read_camera_content(path: Path, largest: int = 1 << 20) -> Any:
    """The content of a YAML, JSON, TOML or FileStorage file as plain values and arrays.

    largest: size of a file that is read [byte].

    Raises CameraError: it cannot be read.
    """
    try:
        data = read_regular(path, largest + 1)
    except OSError as error:
        raise CameraError(f"{path}: cannot read it: {error.strerror}") from error
    text = data.decode("utf-8", errors="replace")
    if len(data) <= largest and text.startswith(("<?xml", "<opencv_storage", "%YAML:1.0")):
        try:
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            return _plain(storage.root())
        # OpenCV's bindings raise the second where a file ends too early.
        except (cv2.error, SystemError) as error:
            raise CameraError(f"{path}: not a file of OpenCV's FileStorage: {error}") from error
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith("#")), "")
    if len(data) <= largest and re.fullmatch(r"\[[^\[\],{}]+\]|[\w.-]+\s*=.*", first):
        try:
            return tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise CameraError(f"{path}: not a TOML file: {error}") from error
    return read_yaml(path, CameraError, tags=True)


def calibrated_cameras(content: Mapping[Any, Any], path: Path) -> dict[str, CalibratedCamera]:
    """The cameras of a calibration tool's file by name; none: it is no such file.

    Of Kalibr's chain the first camera is the world. A file of one camera that has no name is called
    as the file is.

    Raises CameraError: a field is missing or wrong, a lens is of a kind that OpenCV does not know,
    or a camera stands so far away that lengths are no metres.
    """
    if any(_matrix(content.get(name)) is not None for name in _MATRIX):
        name = str(content.get("camera_name", path.stem))
        return {name: _one_camera(content, f"{path}: camera '{name}'")}
    entries = {str(key): one for key, one in content.items() if isinstance(one, dict)}
    chain = {k: one for k, one in entries.items() if {"camera_model", "intrinsics"} <= {*one}}
    if chain:
        return dict(_kalibr(chain, path))
    tables = {k: one for k, one in entries.items() if {"matrix", "distortions"} & {*one}}
    found = dict[str, CalibratedCamera]()
    for key, table in tables.items():
        name, where = str(table.get("name", key)), f"{path}: camera '{key}'"
        if name in found:
            raise CameraError(f"{where}: the name '{name}' is given twice")
        lens = _lens(
            _pair(table.get("size"), where),
            _matrix(table.get("matrix")),
            table.get("distortions", ()),
            bool(table.get("fisheye", False)),
            where,
        )
        found[name] = CalibratedCamera(lens, _pose(table, "rotation", "translation", where))
    return found


def _plain(node: Any) -> Any:
    """A node of OpenCV's FileStorage: mappings, lists, arrays, texts and numbers."""
    if node.isMap():
        if {"rows", "cols", "data"} <= {*node.keys()}:
            return np.asarray(node.mat(), dtype=np.float64)
        return {name: _plain(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_plain(node.at(k)) for k in range(node.size())]
    return node.string() if node.isString() else node.real()


def _numbers(value: Any) -> Array | None:
    """(n,) numbers of an array, a list, or a mapping with ``data``; None: it is none of these."""
    if isinstance(value, dict):
        value = value.get("data")
    if not isinstance(value, list | tuple | np.ndarray):
        return None
    try:
        found = np.asarray(value, dtype=np.float64).ravel()
    except (ValueError, TypeError):
        return None
    return found if np.isfinite(found).all() else None


def _matrix(value: Any) -> Array | None:
    """A camera matrix (3, 3), or None."""
    found = _numbers(value)
    return found.reshape(3, 3) if found is not None and found.size == 9 else None


def _pair(value: Any, where: str) -> tuple[int, int]:
    """A width and a height [pixel]."""
    found = _numbers(value)
    if found is None or found.size != 2:
        raise CameraError(f"{where}: needs the pictures' width and height [pixel]")
    return check_side(found[0], "width", where), check_side(found[1], "height", where)


def _first(content: Mapping[Any, Any], names: Sequence[str]) -> Any:
    """The first of some fields that is there; an empty tuple where there is none."""
    return next((content[name] for name in names if name in content), ())


def _one_camera(content: Mapping[Any, Any], where: str) -> CalibratedCamera:
    """The camera of a ROS camera_info, or of OpenCV's FileStorage."""
    sides = [_first(content, (f"image_{side}", side)) for side in ("width", "height")]
    if () in sides:
        raise CameraError(f"{where}: needs image_width and image_height [pixel]: add them")
    model = str(content.get("distortion_model", ""))
    if model not in _RADIAL | _FISHEYE:
        raise CameraError(
            f"{where}: distortion_model '{model}' is not known; it may be "
            f"{', '.join(sorted((_RADIAL | _FISHEYE) - {''}))}"
        )
    matrix = next(one for one in (_matrix(content.get(n)) for n in _MATRIX) if one is not None)
    lens = _lens(
        _pair(sides, where), matrix, _first(content, _DISTORTION), model in _FISHEYE, where
    )
    rotation = "R" if "R" in content else "rvec"
    # A camera_info's R rectifies pictures; it has no T.
    has_pose = "T" in content or "tvec" in content
    pose = _pose(content, rotation, "T" if "T" in content else "tvec", where) if has_pose else None
    return CalibratedCamera(lens, pose)


def _kalibr(
    chain: Mapping[str, Mapping[str, Any]], path: Path
) -> Iterator[tuple[str, CalibratedCamera]]:
    """The cameras of Kalibr's camchain: T_cn_cnm1 takes points of the camera before to each."""
    is_chain = any("T_cn_cnm1" in entry for entry in chain.values())
    X_CW: Array | None = np.eye(4) if is_chain else None
    for k, (name, entry) in enumerate(chain.items()):
        where = f"{path}: camera '{name}'"
        model, distortion = entry["camera_model"], str(entry.get("distortion_model", "none"))
        if model != "pinhole" or distortion not in _RADIAL | _FISHEYE:
            raise CameraError(
                f"{where}: Kalibr's '{model}' camera with '{distortion}' distortion is not read, "
                "but pinhole with radtan, equidistant or none; calibrate it as one of these"
            )
        numbers = _numbers(entry["intrinsics"])
        if numbers is None or numbers.size != 4:
            raise CameraError(f"{where}: intrinsics must be [f_x, f_y, c_x, c_y]")
        fx, fy, cx, cy = numbers
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        size = _pair(entry.get("resolution"), where)
        coefficients = entry.get("distortion_coeffs", ())
        lens = _lens(size, matrix, coefficients, distortion in _FISHEYE, where)
        if k and X_CW is not None:
            step = entry.get("T_cn_cnm1")
            X_CW = None if step is None else check_pose(step, "T_cn_cnm1", where) @ X_CW
        yield name, CalibratedCamera(lens, None if X_CW is None else inverse_pose(X_CW))


def _lens(
    size: tuple[int, int], matrix: Array | None, distortion: Any, fisheye: bool, where: str
) -> Lens:
    """A lens from a camera matrix (3, 3) and OpenCV's coefficients."""
    if matrix is None or not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0 and matrix[2, 2] == 1.0):
        raise CameraError(
            f"{where}: its camera matrix must be [[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]] [pixel]"
        )
    found = _numbers(distortion)
    if found is None:
        raise CameraError(f"{where}: its distortion coefficients are no list of finite numbers")
    found = found if found.size else np.zeros(4)
    counts = (4,) if fisheye else (4, 5, 8, 12, 14)
    if fisheye and not found[4:].any():
        found = found[:4]
    if found.size not in counts:
        raise CameraError(
            f"{where}: has {found.size} distortion coefficients; OpenCV's "
            f"{'fisheye' if fisheye else 'lens'} has {' or '.join(map(str, counts))}"
        )
    (fx, _, cx), (_, fy, cy), _ = matrix
    return Lens(*size, float(fx), float(fy), float(cx), float(cy), found, fisheye)


def _pose(
    content: Mapping[Any, Any], rotation: str, translation: str, where: str, farthest: float = 100.0
) -> Array | None:
    """X_WC (4, 4) of p_C = R p_W + T, R a matrix or a rotation vector; None: it has neither.

    farthest: of a camera from the world's origin, beyond which lengths are taken for millimetres
    [m].
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
