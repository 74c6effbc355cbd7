"""Read and write this program's camera files; read those of Drake and of calibration tools."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drake_pose.camera.calibration_files import FORMATS, calibrated_cameras, read_camera_content
from drake_pose.camera.models import (
    HALF_PIXEL,
    Camera,
    Lens,
    ParallelCamera,
    PinholeCamera,
    camera_tuple,
    check_number,
    check_pose,
)
from drake_pose.camera.pose_files import RecordedPose, recorded_poses, recording_names, same_camera
from drake_pose.errors import CameraError, listed
from drake_pose.input_files import named_fields

_COMMON = ("width", "height", "center_x", "center_y")
_REQUIRED = {
    "pinhole": (*_COMMON, "focal_x", "focal_y"),
    "parallel": (*_COMMON, "pixels_per_metre"),
}
_OPTIONAL = {
    "pinhole": (
        "X_WC", "link", "X_LC", "projection", "clipping_near", "pixel_centers", "distortion",
    ),
    "parallel": ("X_WC", "projection", "pixel_centers"),
}  # fmt: skip
_FIELDS = {
    field for fields in (_REQUIRED, _OPTIONAL) for names in fields.values() for field in names
}


def load_cameras(
    path: str | Path,
    known: "Known | None" = None,
    recording: Path | None = None,
    warnings: list[str] | None = None,
) -> dict[str, Camera]:
    """Return the cameras of a file by name, in the file's order.

    A pinhole camera has `width height focal_x focal_y center_x center_y` [pixel, pixel centres at
    integers, or at i + 0.5 with `pixel_centers: drake`] and `X_WC` (4 x 4) [m]; `projection:
    pinhole` and `clipping_near` [m] are optional. A parallel camera has `projection: parallel` and
    `pixels_per_metre` instead of focal lengths.

    Drake's files are recognised by their fields: a Scenario (``cameras:``, possibly below one
    name), a mapping of CameraConfigs, or a single one; their principal points are converted. Files
    of ROS, Kalibr, OpenCV, anipose, Pose2Sim and Caliscope are recognised likewise.

    ``known``, ``recording``: as in ``load_camera_file``. ``warnings``: list to which warnings are
    appended; None: they are dropped.

    Raises CameraError: names the file, the camera and the field at fault. Cameras without a pose,
    on moving links, or with distortion are refused.
    """
    found = load_camera_file(path, known=known, recording=recording)
    if warnings is not None:
        warnings += found.warnings
    for name, link in found.links.items():
        raise CameraError(
            f"{path}: camera '{name}' rides on link '{link}' of a robot (link, X_LC), so its pose "
            "changes from frame to frame, but static cameras (X_WC) are needed here; remove it, or "
            "for a single frame give X_WC = X_WL X_LC with the link's pose X_WL in that frame"
        )
    for name in found.unplaced:
        kind = "parallel" if isinstance(found.cameras[name], ParallelCamera) else "pinhole"
        raise CameraError(
            f"{path}: camera '{name}': a {kind} camera needs X_WC; drake-pose register estimates "
            "it from masks of a robot with known joint positions, and a calibration tool from "
            "pictures of a board"
        )
    return found.cameras


@dataclass(frozen=True)
class CameraFile:
    """Content of a camera file, in which poses are optional."""

    # Pinhole or parallel cameras by name, in the file's order, for undistorted images. A camera
    # without pose is at the world's origin.
    cameras: dict[str, Camera]
    unplaced: tuple[str, ...]  # Names of the cameras without pose.
    # Link of each camera that is mounted on one, by the camera's name, or END_EFFECTOR; its X_WC
    # holds X_LC, the pose in the link.
    links: Mapping[str, str] = field(default_factory=dict)
    # Lens of each camera with distortion, for the images as taken.
    lenses: Mapping[str, Lens] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # How the file was read where it does not say so itself.


Known = Callable[[], CameraFile | None]
"""Returns cameras with intrinsics, by the recording's names; None: they are unknown."""


def intrinsics_of(
    own: Path, intrinsics: Path | None, wanted: Collection[str] = (), *, distorted: bool = False
) -> Known:
    """Return a function that reads the intrinsics of a recording's cameras.

    Args:
        own: the recording's camera file, which may be missing.
        intrinsics: a camera file to read instead; None: the recording's.
        wanted: names of the cameras that are used; empty: all.
        distorted: as in ``load_camera_file``.
    """

    def read() -> CameraFile | None:
        file = intrinsics or own
        if not (intrinsics or file.is_file()):
            return None
        found = load_camera_file(file, distorted=distorted, recording=own.parent)
        kept = {name: one for name, one in found.cameras.items() if not wanted or name in wanted}
        return CameraFile(kept, tuple(kept), {}, found.lenses)

    return read


def load_camera_file(
    path: str | Path,
    *,
    distorted: bool = False,
    known: Known | None = None,
    recording: Path | None = None,
) -> CameraFile:
    """Read a camera file as load_cameras does, but allow cameras without X_WC.

    ``distorted``: allow cameras with `distortion`, which the caller removes from images; else they
    are refused. ``known``: called for a file of poses alone, see ``Known``; None: such a file is
    refused. ``recording``: the recording, which says what episode it is in DROID's files of many;
    None: unknown.

    Raises CameraError: names the file, the camera and the field at fault.
    """
    path = Path(path)
    episode_ids, serials = recording_names(recording)
    content = read_camera_content(path, episode_ids=episode_ids)
    if not isinstance(content, dict | list) or not content:
        raise CameraError(f"{path}: expected a mapping from camera names to their parameters")
    calibrated = calibrated_cameras(content, path, episode_ids)
    poses = {} if calibrated else recorded_poses(content, path, episode_ids)
    if poses:
        named = {serials.get(name, name): one for name, one in poses.items()}
        return _placed(path, named, None if known is None else known())
    if isinstance(content, list):
        if not calibrated:
            raise CameraError(
                f"{path}: expected a mapping from camera names to their parameters, but it has a "
                "list that is no pose"
            )
        content = {}
    configs = None if calibrated else _find_configs(content, path)
    if configs is not None:
        # Import Drake only if needed, because it loads slowly.
        from drake_pose.camera.exchange import read_configs

        read = read_configs(configs, path)
        return CameraFile({_check_name(name, path): read[name] for name in read}, ())
    entries = [entry for entry in content.values() if isinstance(entry, dict)]
    if not (calibrated or any(_FIELDS & {*entry} for entry in entries)):
        found = ", ".join(map(str, content))
        raise CameraError(
            f"{path}: is not a camera file: it has {found[:200]}; supported are {FORMATS}"
        )
    cameras, lenses = dict[str, Camera](), dict[str, Lens]()
    links, unplaced = dict[str, str](), list[str]()
    for key in calibrated or content:
        name = _check_name(key, path)
        if name in cameras:
            raise CameraError(f"{path}: camera '{name}' is given twice")
        lens: Lens | None
        if calibrated:
            lens, X_WC = calibrated[name]
            cameras[name] = lens.camera(name, np.eye(4) if X_WC is None else X_WC)
            is_placed = X_WC is not None
        else:
            entry = content[key]
            camera = _read_camera(name, entry, path)
            lens = _read_lens(camera, entry.get("distortion"), f"{path}: camera '{name}'")
            cameras[name] = camera if lens is None else lens.camera(name, camera.X_WC)
            links |= {name: entry["link"]} if "link" in entry else {}
            is_placed = "X_WC" in entry or "link" in entry
        unplaced += [] if is_placed else [name]
        lenses |= {name: lens} if lens is not None and lens.distortion.any() else {}
    if lenses and not distorted:
        raise CameraError(
            f"{path}: camera '{next(iter(lenses))}' has distortion, but undistorted pictures and "
            "masks are needed here: straighten the pictures with cv2.undistort, and give the "
            "camera matrix of the straight ones (tutorials/commands.md)"
        )
    return CameraFile(cameras, tuple(unplaced), links, lenses)


def _placed(path: Path, poses: Mapping[str, RecordedPose], known: CameraFile | None) -> CameraFile:
    """Return the known cameras at the poses of a file (``path``) that has no intrinsics.

    ``poses``: by the file's names. ``known``: by the recording's names; None: there are none.
    Raises CameraError: there are no intrinsics, or no pose is one of a known camera.
    """
    names = listed(sorted(poses))
    if known is None or not known.cameras:
        raise CameraError(
            f"{path}: has poses ({names}) but no intrinsics: give a file with the pictures' width "
            "and height, focal lengths and principal point, too (--intrinsics FILE, such as ROS' "
            "camera_info or this program's cameras.yaml)"
        )
    own = [*known.cameras]
    meant = {name: same_camera(name, own) for name in poses}
    if len(poses) == len(own) == 1:
        meant = {next(iter(poses)): own[0]}
    found = {camera: poses[name] for name, camera in meant.items() if camera is not None}
    if not found:
        raise CameraError(
            f"{path}: has poses of {names}, but the recording's cameras are {listed(own)}: name "
            "them alike in the file, or name the one camera that it is for (--camera NAME)"
        )
    cameras = {name: known.cameras[name].with_pose(one.X) for name, one in found.items()}
    links = {name: one.link for name, one in found.items() if one.link}
    lenses = {name: lens for name, lens in known.lenses.items() if name in found}
    assumed = dict.fromkeys(one.assumed for one in found.values() if one.assumed)
    warnings = tuple(f"{path}: {text}; audit tests other readings" for text in assumed)
    return CameraFile(cameras, (), links, lenses, warnings)


def save_cameras(path: str | Path, cameras: Mapping[str, Camera] | Iterable[Camera]) -> None:
    """Write cameras, given by name or in sequence, to a YAML file for load_cameras.

    Numbers are not rounded. An existing file is replaced.

    Raises:
        CameraError: the file cannot be written.
    """
    try:
        Path(path).write_text(dump_cameras(cameras), encoding="utf-8")
    except OSError as error:
        raise CameraError(f"{path}: cannot write the cameras: {error.strerror}") from error


def dump_cameras(
    cameras: Mapping[str, Camera] | Iterable[Camera], links: Mapping[str, str] | None = None
) -> str:
    """Return the text of a camera file.

    ``cameras``: the cameras, by name or in sequence. ``links``: link of each camera that is mounted
    on one, by the camera's name, whose X_WC is written as X_LC; None: no camera is.
    """
    content = {camera.name: describe_camera(camera) for camera in camera_tuple(cameras)}
    for name, link in (links or {}).items():
        if name in content:
            content[name] |= {"link": link, "X_LC": content[name].pop("X_WC")}
    return yaml.safe_dump(content, sort_keys=False)


def _find_configs(content: dict[Any, Any], path: Path) -> dict[str, Any] | None:
    """Return unchecked CameraConfigs of a file's content by name; None if it is not one of Drake's.

    Raises CameraError: there are several scenarios, or one without a mapping of cameras.
    """
    if _is_config(content):
        # Drake's default name of a camera.
        return {str(content.get("name", "preview_camera")): content}
    scenarios = (
        {"": content}
        if _is_scenario(content)
        else {key: entry for key, entry in content.items() if _is_scenario(entry)}
    )
    if len(scenarios) > 1:
        raise CameraError(
            f"{path}: holds several scenarios ({', '.join(map(str, scenarios))}); keep only the "
            "one with the cameras"
        )
    for scenario in scenarios.values():
        cameras = scenario["cameras"]
        if not isinstance(cameras, dict) or not cameras:
            raise CameraError(f"{path}: cameras must be a mapping from names to CameraConfigs")
        return cameras
    if any(isinstance(entry, dict) and _is_config(entry) for entry in content.values()):
        return content
    return None


def _is_scenario(entry: Any) -> bool:
    """Return whether an entry is a Drake Scenario: a mapping with `cameras`, no camera of ours."""
    if not isinstance(entry, dict) or "cameras" not in entry:
        return False
    cameras = entry["cameras"]
    return not isinstance(cameras, dict) or not {"X_WC", "width"} & set(cameras)


def _is_config(entry: dict[Any, Any]) -> bool:
    """Return whether an entry has a CameraConfig's fields, and none that only our cameras have."""
    drake_fields = {
        *("focal", "X_PB", "X_BC", "X_BD", "name", "fps", "rgb", "depth", "label", "show_rgb"),
        *("clipping_far", "z_near", "z_far", "renderer_name", "renderer_class", "background"),
        *("capture_offset", "output_delay", "do_compress", "lcm_bus"),
    }
    return bool(drake_fields & set(entry)) and not set(entry) & (
        _FIELDS - {*_COMMON, "clipping_near"}
    )


def _check_name(key: Any, path: Path) -> str:
    """Return a key of a camera file as a camera's name; CameraError if no folder can have it."""
    name = str(key)
    if not isinstance(key, str | int) or name in ("", ".", "..") or set(name) & set("/\\\0"):
        raise CameraError(f"{path}: {name[:40]!r} is not a valid camera name")
    return name


def _read_camera(name: str, entry: Any, path: Path) -> Camera:
    """Return the camera of one entry of a file, ignoring its distortion.

    Its X_WC is the entry's X_WC or X_LC, or else the identity.

    ``name``: the camera's name. ``entry``: the entry, not yet checked. ``path``: the file, for
    messages. Raises CameraError: a field is missing, unknown or invalid.
    """
    where = f"{path}: camera '{name}'"
    if not isinstance(entry, dict):
        raise CameraError(f"{where}: expected a mapping from field names to values")
    projection = entry.get("projection", "pinhole")
    if not isinstance(projection, str) or projection not in _REQUIRED:
        raise CameraError(f"{where}: projection must be pinhole or parallel")
    required, optional = _REQUIRED[projection], _OPTIONAL[projection]
    missing = [field for field in required if field not in entry]
    if missing:
        raise CameraError(f"{where}: a {projection} camera needs {', '.join(missing)}")
    named_fields(entry, (*required, *optional), f"{where} ({projection})", CameraError)
    pose = "X_WC"
    if "link" in entry or "X_LC" in entry:
        if not isinstance(entry.get("link"), str) or "X_LC" not in entry or "X_WC" in entry:
            raise CameraError(
                f"{where}: a camera that rides on a link has the link's name (link) and its pose "
                "there (X_LC), and no X_WC"
            )
        pose = "X_LC"
    values: dict[str, Any] = {"name": name, "X_WC": entry.get(pose, np.eye(4))}
    values |= {field: entry[field] for field in required}
    check_pose(values["X_WC"], pose, where)
    pixel_centers = entry.get("pixel_centers", "integers")
    if pixel_centers not in ("integers", "drake"):
        raise CameraError(
            f"{where}: pixel_centers must be integers (OpenCV's convention, the default) or drake "
            f"(at i + 0.5), not {pixel_centers!r}"
        )
    if pixel_centers == "drake":
        for field in ("center_x", "center_y"):
            values[field] = check_number(values[field], field, where) - HALF_PIXEL
    if "clipping_near" in entry:
        values["near"] = check_number(entry["clipping_near"], "clipping_near", where, positive=True)
    try:
        return ParallelCamera(**values) if projection == "parallel" else PinholeCamera(**values)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error


def _read_lens(camera: Camera, value: Any, where: str) -> Lens | None:
    """Return the lens of a camera with distortion; None if there is none.

    The camera's intrinsics are those of the distorted images. ``value``: OpenCV's coefficients, not
    yet checked; None or all 0: no distortion. Raises CameraError, begun by ``where``: they are
    invalid.
    """
    if value is None:
        return None
    counts = (4, 5, 8, 12, 14)
    if not isinstance(value, list) or len(value) not in counts:
        raise CameraError(
            f"{where}: distortion must be a list of OpenCV's coefficients: k1, k2, p1, p2, then k3 "
            f"and more ({', '.join(map(str, counts))} numbers in all)"
        )
    D = np.array([check_number(one, "distortion", where) for one in value])
    fx, fy, cx, cy = camera.kernel_parameters()[1:5]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Lens(camera.width, camera.height, K, D) if D.any() else None


def describe_camera(camera: Camera) -> dict[str, Any]:
    """Return a camera's entry in a camera file, from field names to numbers, lists and texts."""
    is_parallel = isinstance(camera, ParallelCamera)
    focal = ("pixels_per_metre",) if is_parallel else ("focal_x", "focal_y")
    fields = ("width", "height", *focal, "center_x", "center_y")
    entry: dict[str, Any] = {"projection": "parallel"} if is_parallel else {}
    entry |= {field: getattr(camera, field) for field in fields}
    if isinstance(camera, PinholeCamera):
        entry["clipping_near"] = camera.near
    return entry | {"X_WC": camera.X_WC.tolist()}
