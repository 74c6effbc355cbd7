"""Read camera files: this program's, Drake's, and those of other tools; write this program's.

``PARSERS`` has a function for each format. They are tried in order.
"""

import io
import json
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from drake_pose.camera import calibration_files, pose_files
from drake_pose.camera.calibration_files import lens_of, matrix_of
from drake_pose.camera.models import (
    HALF_PIXEL,
    Camera,
    Lens,
    ParallelCamera,
    PinholeCamera,
    camera_tuple,
    check_pose,
)
from drake_pose.camera.picture_files import SUFFIXES, picture_size
from drake_pose.camera.pose_files import Content, Entry, Parsed, Parser, choose_frames
from drake_pose.errors import CameraError, SceneError, listed
from drake_pose.input_files import named_fields, read_regular, read_yaml


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

    ``PARSERS`` lists the other formats, which are recognised by their content. Principal points of
    Drake's files are converted.

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
    content = _read(path, episode_ids)._replace(sizes=_picture_sizes(recording))
    missed = dict[str, list[str]]()
    for format_name, parser in PARSERS.items():
        parsed = parser(content)
        if not isinstance(parsed, str):
            break
        missed.setdefault(parsed, []).append(format_name)
    else:
        has = f": it has {', '.join(map(str, content.mapping))[:200]}" if content.mapping else ""
        tried = "; ".join(f"{', '.join(names)} ({why})" for why, names in missed.items())
        why = content.fault or f"is no camera file{has}"
        raise CameraError(f"{path}: {why}. Tried: {tried}")
    if [*parsed] == [path.stem] and parsed[path.stem].camera and len(content.sizes) == 1:
        # The file does not name its camera, and the recording has one alone.
        serials[path.stem] = next(iter(content.sizes)) or path.stem
    entries = {serials.get(name, name): one for name, one in parsed.items()}
    if all(one.camera is None for one in entries.values()):
        entries = _placed(path, entries, None if known is None else known())
    cameras: dict[str, Camera] = {
        name: replace(one.camera, name=name) for name, one in entries.items() if one.camera
    }
    for name in cameras:
        if name in ("", ".", "..") or set(name) & set("/\\\0"):
            raise CameraError(f"{path}: {name[:40]!r} is not a valid camera name")
    found = {name: entries[name] for name in cameras}
    lenses = {k: v.lens for k, v in found.items() if v.lens is not None and v.lens.distortion.any()}
    if lenses and not distorted:
        raise CameraError(
            f"{path}: camera '{next(iter(lenses))}' has distortion, but undistorted pictures and "
            "masks are needed here: straighten the pictures with cv2.undistort, and give the "
            "camera matrix of the straight ones (tutorials/commands.md)"
        )
    left_out = [name for name in entries if name not in cameras]
    texts = [f"camera '{name}' is left out, as it has no intrinsics" for name in left_out]
    assumed = [one.assumed for one in found.values() if one.assumed]
    texts += [f"{text}; audit tests other readings" for text in dict.fromkeys(assumed)]
    return CameraFile(
        {k: v if (X := found[k].X) is None else v.with_pose(X) for k, v in cameras.items()},
        tuple(name for name, one in found.items() if one.X is None),
        {name: one.link for name, one in found.items() if one.link},
        lenses,
        tuple(f"{path}: {text}" for text in texts),
    )


def _placed(path: Path, entries: Mapping[str, Entry], known: CameraFile | None) -> dict[str, Entry]:
    """Return the known cameras at the poses of a file (``path``) that has no intrinsics.

    ``entries``: by the file's names. ``known``: by the recording's names; None: there are none.
    Raises CameraError: there are no intrinsics, no pose is one of a known camera, or several are.
    """
    names = listed(sorted(entries))
    if known is None or not known.cameras:
        raise CameraError(
            f"{path}: has poses ({names}) but no intrinsics: give a file with the pictures' width "
            "and height, focal lengths and principal point, too (--intrinsics FILE, such as ROS' "
            "camera_info or this program's cameras.yaml)"
        )
    own = [*known.cameras]
    meant = choose_frames(entries, own, path)
    if not meant:
        raise CameraError(
            f"{path}: has poses of {names}, but the recording's cameras are {listed(own)}: name "
            "them alike in the file, or name the one camera that it is for (--camera NAME)"
        )
    return {
        name: entries[frame]._replace(camera=known.cameras[name], lens=known.lenses.get(name))
        for name, frame in meant.items()
    }


def _read(path: Path, episode_ids: frozenset[str]) -> Content:
    """Return the content of a file, read by the library for its kind.

    ``episode_ids``: of a `.jsonl`, only the lines that hold one of these names are read, if any do.

    Raises CameraError: the file cannot be read, or is damaged (text that is no YAML: a fault).
    """
    try:
        data = read_regular(path)
    except OSError as error:
        raise CameraError(f"{path}: cannot read it: {error.strerror}") from error
    text, fault = data.decode("utf-8-sig", errors="replace"), ""
    value: Any = None
    lines = (line.strip() for line in io.StringIO(text))
    first = next((line for line in lines if line and not line.startswith("#")), "")
    try:
        if data.startswith((b"\x93NUMPY", b"PK")):
            kind = "NumPy"
            loaded = np.load(io.BytesIO(data), allow_pickle=False)
            value = np.atleast_1d(loaded) if isinstance(loaded, np.ndarray) else dict(loaded)
        elif "!!opencv-" in text or text.startswith("%YAML:1.0") or "<opencv_storage" in text[:200]:
            kind = "FileStorage"
            mode = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
            storage = cv2.FileStorage(text, mode)
            value = _plain(storage.root())
        elif first.startswith("<"):
            kind = "XML"
            value = ElementTree.fromstring(data.lstrip())
        elif path.suffix == ".json":
            kind = "JSON"
            value = json.loads(text, object_pairs_hook=_unique)
        elif path.suffix == ".jsonl":
            kind = "JSON"
            records = [line for line in text.splitlines() if line.strip()]
            own = [line for line in records if any(f'"{one}"' in line for one in episode_ids)]
            value = [json.loads(line) for line in own or records]
        elif re.fullmatch(r"\[[^\[\],{}]+\]|[\w.-]+\s*=.*", first):
            kind = "TOML"
            value = tomllib.loads(text)
        elif re.fullmatch(r"[-+.,eE\d\s]+", first):
            kind = "text"
            value = np.loadtxt(io.StringIO(text.replace(",", " ")), ndmin=1)
        else:
            kind = "YAML"
            value = read_yaml(path, CameraError)
    # A launch file in Python, and what tf2_echo prints, are read as text.
    except CameraError as error:
        fault = str(error).removeprefix(f"{path}: ")
    # What the libraries raise for damaged files is not documented. OpenCV's texts name its source.
    except Exception as error:
        why = "it is damaged" if kind == "FileStorage" else str(error)
        raise CameraError(f"{path}: not a {kind} file: {why}") from error
    return Content(path, value, text, fault, episode_ids)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a mapping of JSON; ValueError: a key is given twice."""
    if len(dict(pairs)) < len(pairs):
        raise ValueError("a key is given twice")
    return dict(pairs)


def _plain(node: Any) -> Any:
    """Return a node of OpenCV's FileStorage as mappings, lists, arrays, texts and numbers."""
    if node.isMap():
        if {"rows", "cols", "data"} <= {*node.keys()}:
            return np.asarray(node.mat(), dtype=np.float64)
        return {name: _plain(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_plain(node.at(k)) for k in range(node.size())]
    return node.string() if node.isString() else node.real()


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
        try:
            content = dict(json.loads(read_regular(file, 1 << 20)))
        except (OSError, ValueError, TypeError):
            content = {}
        names = [content[key] for key in ("uuid", "relative_path") if key in content]
        ids |= {file.stem.removeprefix("metadata_"), *map(str, names)}
        roles = {role: content.get(f"{role}_cam_serial") for role in ("ext1", "ext2", "wrist")}
        serials |= {role: str(one) for role, one in roles.items() if one is not None}
    return frozenset(ids), serials


def _picture_sizes(recording: Path | None) -> dict[str, tuple[int, int]]:
    """Return width and height [pixel] of the masks or pictures in a recording's folder, by camera.

    They are those of each camera's first readable file; "" is a camera without a folder of its own.
    """
    found = dict[str, tuple[int, int]]()
    for pattern in ("masks", "masks/*", "images/*"):
        for folder in () if recording is None else recording.glob(pattern):
            files = (one for one in folder.glob("[!.]*") if one.suffix.lower() in SUFFIXES)
            with suppress(SceneError):
                if (file := min(files, default=None)) and (size := picture_size(file)):
                    found.setdefault("" if folder.name == pattern else folder.name, size)
    return found


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
    links = links or {}
    content = {one.name: describe_camera(one, links.get(one.name)) for one in camera_tuple(cameras)}
    return yaml.safe_dump(content, sort_keys=False)


def _drake_cameras(content: Content) -> Parsed:
    """Read Drake's cameras."""
    # Import Drake only if needed, because it loads slowly.
    from drake_pose.camera.exchange import drake_cameras

    return drake_cameras(content)


def _own_cameras(content: Content) -> Parsed:
    """Read this program's cameras, of which one has a field that others' cameras do not have."""
    own = {"focal_x", "focal_y", "pixels_per_metre", "projection", "pixel_centers", "X_LC"}
    entries = [one for one in content.mapping.values() if isinstance(one, dict)]
    if not any(own & {*one} or {"X_WC", "center_x"} <= {*one} for one in entries):
        return "no focal_x or pixels_per_metre"
    if len({*map(str, content.mapping)}) < len(content.mapping):
        raise CameraError(f"{content.path}: a camera is given twice, as a number and as a text")
    return {
        str(key): _read_camera(str(key), entry, content.path)
        for key, entry in content.mapping.items()
    }


def _read_camera(name: str, entry: Any, path: Path) -> Entry:
    """Return the camera of one entry of a file.

    ``name``: the camera's name. ``entry``: the entry, not yet checked. ``path``: the file, for
    messages. Raises CameraError: a field is missing, unknown or invalid.
    """
    where = f"{path}: camera '{name}'"
    if not isinstance(entry, dict):
        raise CameraError(f"{where}: expected a mapping from field names to values")
    kinds: dict[Any, Any] = {"pinhole": PinholeCamera, "parallel": ParallelCamera}
    projection = str(entry.get("projection", "pinhole"))
    if projection not in kinds:
        raise CameraError(f"{where}: projection must be pinhole or parallel")
    kind = kinds[projection]
    required = [one.name for one in fields(kind) if one.name not in ("name", "X_WC", "near")]
    missing = [name for name in required if name not in entry]
    if missing:
        raise CameraError(f"{where}: a {projection} camera needs {', '.join(missing)}")
    of_pinholes = ["link", "X_LC", "clipping_near", "distortion"] * (kind is PinholeCamera)
    optional = ["X_WC", "projection", "pixel_centers", *of_pinholes]
    named_fields(entry, (*required, *optional), f"{where} ({projection})", CameraError)
    pose, link = "X_LC" if {"link", "X_LC"} & {*entry} else "X_WC", entry.get("link", "")
    if pose == "X_LC" and (
        "X_WC" in entry or "X_LC" not in entry or not isinstance(link, str) or not link
    ):
        raise CameraError(
            f"{where}: a camera that rides on a link has the link's name (link) and its pose "
            "there (X_LC), and no X_WC"
        )
    centers = entry.get("pixel_centers", "integers")
    if centers not in ("integers", "drake"):
        raise CameraError(
            f"{where}: pixel_centers must be integers (OpenCV's convention, the default) or drake "
            f"(at i + 0.5), not {centers!r}"
        )
    values = {name: entry[name] for name in required}
    values |= {"near": entry["clipping_near"]} if "clipping_near" in entry else {}
    X = check_pose(entry[pose], pose, where) if pose in entry else None
    try:
        camera: Camera = kind(name=name, X_WC=np.eye(4), **values)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error
    if centers == "drake":
        x, y = camera.center_x - HALF_PIXEL, camera.center_y - HALF_PIXEL
        camera = replace(camera, center_x=x, center_y=y)
    if entry.get("distortion") is None:
        return Entry(X, link, camera=camera)
    K = matrix_of(*camera.kernel_parameters()[1:5])
    lens = lens_of([camera.width, camera.height], K, entry["distortion"], "plumb_bob", where)
    seen = lens.camera(name, np.eye(4)) if lens.distortion.any() else camera
    return Entry(X, link, camera=seen, lens=lens)


def describe_camera(camera: Camera, link: str | None = None) -> dict[str, Any]:
    """Return a camera's entry in a camera file, from field names to numbers, lists and texts.

    ``link``: the link that carries the camera, in whose frame its pose is; None: the world.
    """
    entry = {"projection": "parallel"} if isinstance(camera, ParallelCamera) else {}
    names = [one.name for one in fields(camera) if one.name not in ("name", "X_WC")]
    entry |= {"clipping_near" if one == "near" else one: getattr(camera, one) for one in names}
    X = camera.X_WC.tolist()
    return entry | ({"X_WC": X} if link is None else {"link": link, "X_LC": X})


PARSERS: Mapping[str, Parser] = {
    "this program's cameras.yaml": _own_cameras,
    "Kalibr": calibration_files.kalibr,
    "URDF": pose_files.urdf,
    "MuJoCo": pose_files.mujoco,
    "launch file": pose_files.static_publishers,
    "TransformStamped": pose_files.transforms,
    "tf2_echo": pose_files.tf2_echo,
    "OpenCV, ROS' camera_info, easy_handeye, a pose without a name": calibration_files.single,
    "NAME: POSE, NAME: CameraInfo, TOML of anipose, Pose2Sim, Caliscope": calibration_files.by_name,
    "NumPy array, list of poses": calibration_files.listed,
    "DROID's files of many episodes": calibration_files.episodes,
    "Drake": _drake_cameras,
}
"""Parsers of camera files, by the formats that they read, in the order in which they are tried."""
