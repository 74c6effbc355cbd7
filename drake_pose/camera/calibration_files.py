"""Read cameras of calibration tools: ROS, Kalibr, OpenCV, anipose, DROID, easy_handeye, your own.

In all of them pixel centres are at integers. Each parser is a ``Parser``.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.models import Lens, check_pose, check_side, inverse_pose, numbers
from drake_pose.camera.pose_files import (
    END_EFFECTOR,
    Content,
    Entry,
    Parsed,
    optical,
    plain_key,
    pose_of,
    standing,
)
from drake_pose.errors import CameraError
from drake_pose.errors import listed as listed_names


def lens_of(
    size: Any, matrix: Any, distortion: Any, model: str, where: str, largest_skew: float = 1e-3
) -> Lens:
    """Return a lens by the name that ROS and Kalibr give to its distortion model.

    The first three arguments are checked; each may be a list, an array, or a mapping whose ``data``
    is a list.

    Args:
        size: width and height [pixel].
        matrix: (3, 3) camera matrix, or its 9 elements by rows [pixel].
        distortion: OpenCV's distortion coefficients; empty: none.
        model: name of the distortion model.
        where: start of error messages.
        largest_skew: maximum skew that is ignored [f_x]; it amounts to half a pixel at the edge of
            an image.

    Raises CameraError: the model is unknown, or a value is missing or invalid.
    """
    kinds = {"plumb_bob": False, "rational_polynomial": False, "radtan": False, "none": False}
    kinds |= {"equidistant": True, "fisheye": True}  # OpenCV's fisheye.
    if model not in kinds:
        raise CameraError(
            f"{where}: distortion_model '{model}' is unknown; known are {', '.join(kinds)}"
        )
    fisheye = kinds[model]
    sides, K, D = (numbers(one) for one in (size, matrix, distortion))
    if sides is None or sides.size != 2:
        raise CameraError(
            f"{where}: needs the pictures' width and height [pixel]: add image_width, image_height"
        )
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
    counts = (4,) if fisheye else (4, 5, 8, 12, 14)
    D = np.zeros(4) if D is not None and not D.any() else D
    D = D[:4] if D is not None and fisheye and not D[4:].any() else D
    if D is None or D.size not in counts:
        raise CameraError(
            f"{where}: has {0 if D is None else D.size} distortion coefficients that are numbers; "
            f"OpenCV's {'fisheye' if fisheye else 'lens'} has {' or '.join(map(str, counts))}"
        )
    return Lens(width, height, np.array([[K[0], 0, K[2]], [0, K[4], K[5]], [0, 0, 1]]), D, fisheye)


def matrix_of(fx: Any, fy: Any, cx: Any, cy: Any) -> list[Any]:
    """Return the elements (9) of a camera matrix, by rows [pixel]."""
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def _lens(
    entry: Mapping[Any, Any], where: str, is_needed: bool, own: Sequence[int] | None = None
) -> Lens | None:
    """Return the lens of a mapping, by the keys of any tool; None: it has none.

    A ROS CameraInfo has K or k, librealsense ppx and ppy for cx and cy, Kalibr [fx, fy, cx, cy].

    is_needed: whether a camera matrix without the pictures' width and height is an error. own:
    width and height [pixel] of the recording's pictures, if the mapping has none; None: unknown.
    """
    one = {plain_key(key): value for key, value in entry.items()}
    for key in ("intrinsics", "intrinsic"):
        if isinstance(one.get(key), dict):
            one |= {plain_key(k): value for k, value in one.pop(key).items()}

    def first(*keys: str) -> Any:
        return next((one[key] for key in keys if one.get(key) is not None), None)

    sides = [first("width", "imagewidth"), first("height", "imageheight")]
    size = first("size", "resolution") if None in sides else sides
    K = first("cameramatrix", "matrix", "k", "intrinsicmatrix", "intrinsics")
    focal = [first("fx"), first("fy"), first("cx", "ppx"), first("cy", "ppy")]
    four = numbers(K if None in focal else focal)
    K = K if four is None or four.size != 4 else matrix_of(*four.tolist())
    D = first(
        "distortioncoefficients", "distortioncoeffs", "distortions", "d", "coeffs", "distortion"
    )
    # A pose with the distortion of the original pictures may be meant for straight ones.
    if size is None and (is_needed or not np.any(numbers(D))):
        size = own
    if (given := numbers(K)) is None or given.size != 9 or (size is None and not is_needed):
        return None
    model = "fisheye" if one.get("fisheye") else first("distortionmodel") or "plumb_bob"
    return lens_of(size, K, () if D is None else D, str(model), where)


def _entry(name: str, value: Any, content: Content, farthest: float = 100.0) -> Entry | None:
    """Return a camera's lens, pose, or both, from plain values; None: they have neither.

    content: of the file. farthest: maximum distance from the world's origin [m]; beyond it lengths
    are taken to be in millimetres.
    """
    where, lens, four = f"{content.path}: camera '{name}'", None, numbers(value)
    given = value if isinstance(value, dict) else {}
    # OpenCV's R and T, and those of anipose, map the world to the camera.
    tools = {"camera_matrix": ("R", "T"), "distortions": ("rotation", "translation")}
    is_both = (keys for key, keys in tools.items() if {key, keys[1]} <= {*given})
    R, T = next(is_both, ("", ""))
    pose = pose_of({"rvec": given.get(R), "t": given.get(T)} if T else value, where)
    # The R of a ROS file rectifies images and is not a pose; it has no T.
    if T in given:
        if pose is None or pose.X is None:
            raise CameraError(
                f"{where}: {R} must be a 3 x 3 matrix or a rotation vector [rad], and {T} three "
                "numbers [m]"
            )
        away = float(np.linalg.norm(pose.X[:3, 3]))
        if away > farthest:
            raise CameraError(
                f"{where}: stands {away:.0f} m from the world's origin; are its lengths "
                f"millimetres? Give {T} in metres"
            )
        pose = Entry(inverse_pose(pose.X))
    if given:
        sizes = {*content.sizes.values()}
        own = content.sizes.get(name, *sizes) if len(sizes) == 1 else content.sizes.get(name)
        lens = _lens(given, where, pose is None or T != "", own)
    # DROID's pictures, HD720 [pixel]: [fx, cx, fy, cy].
    elif four is not None and four.size == 4 and four.min() >= 1.0:
        lens = lens_of([1280, 720], matrix_of(*four[[0, 2, 1, 3]]), (), "none", where)
    if lens is None:
        return pose
    return (pose or Entry())._replace(camera=lens.camera(name, np.eye(4)), lens=lens)


def kalibr(content: Content) -> Parsed:
    """Read Kalibr's camchain: its first camera is the world.

    Poses follow from T_cn_cnm1, the previous camera's pose in each camera. The pose is unknown for
    all cameras if none has it, and else for a later camera that lacks it and those after it.
    """
    entries = {str(key): one for key, one in content.mapping.items() if isinstance(one, dict)}
    chain = {key: one for key, one in entries.items() if "camera_model" in one}
    is_chain = any("T_cn_cnm1" in entry for entry in chain.values())
    X_CW: Array | None = np.eye(4) if is_chain else None
    found = dict[str, Entry]()
    for name, entry in chain.items():
        where = f"{content.path}: camera '{name}'"
        if entry["camera_model"] != "pinhole":
            raise CameraError(
                f"{where}: Kalibr's '{entry['camera_model']}' camera is not supported: calibrate "
                "it as a pinhole with radtan, equidistant or none"
            )
        lens = _lens(entry, where, is_needed=True)
        if lens is None:
            raise CameraError(f"{where}: intrinsics must be [f_x, f_y, c_x, c_y]")
        if found and X_CW is not None:
            step = entry.get("T_cn_cnm1")
            X_CW = None if step is None else check_pose(step, "T_cn_cnm1", where) @ X_CW
        X_WC = None if X_CW is None else inverse_pose(X_CW)
        found[name] = Entry(X_WC, camera=lens.camera(name, np.eye(4)), lens=lens)
    return found or "no camera_model"


def by_name(content: Content) -> Parsed:
    """Read lenses and poses below the cameras' names; other entries are left out.

    Such are the tables of anipose, Pose2Sim and Caliscope, whose names may be in ``name``.
    """
    found = dict[str, Entry]()
    for key, value in content.mapping.items():
        name = str(value.get("name", key) if isinstance(value, dict) else key)
        if (one := _entry(name, value, content)) is not None:
            if name in found:
                raise CameraError(f"{content.path}: camera '{name}' is given twice")
            found[name] = one
    return found or "no lens and no pose below a name"


def single(content: Content) -> Parsed:
    """Read one camera without a name, and hand-eye calibrations of easy_handeye."""
    given = content.mapping
    # The words of easy_handeye, ROS 1 and 2.
    more = given.get("parameters")
    words = given | (more if isinstance(more, dict) else {})
    name = str(words.get("tracking_base_frame") or words.get("camera_name") or content.path.stem)
    one = _entry(name, given, content) if given else None
    if one is None:
        return "no T_base_cam, transformation, or translation and rotation"
    if words.get("eye_on_hand") is True or words.get("calibration_type") == "eye_in_hand":
        one = one._replace(link=str(words.get("robot_effector_frame") or END_EFFECTOR))
    return {name: optical(name, one, is_turned=name.endswith("_link"))}


def listed(content: Content) -> Parsed:
    """Read an array or a list of poses: one, one of each frame, or each with its camera's name."""
    value, path = content.value, content.path
    if not isinstance(value, list | np.ndarray):
        return "no list or array"
    if (one := pose_of(value, str(path))) is not None:
        return {path.stem: one}
    named, found = dict[str, Entry](), list[Entry]()
    for k, item in enumerate(value):
        given = item if isinstance(item, dict) else {}
        keys = [key for key in given if re.fullmatch("name|.*(cam|serial).*", str(key))]
        names = [str(given[key]) for key in keys if isinstance(given[key], str | int)]
        if (entry := _entry(names[0] if names else str(k), item, content)) is not None:
            found.append(entry)
            named |= dict.fromkeys(names[:1], entry)
    return named if found and len(named) == len(found) else standing(found, path)


def episodes(content: Content) -> Parsed:
    """Read a file of many episodes, such as DROID's: poses or intrinsics by camera, by episode.

    DROID-3D has a line for each episode, with ``cameras`` (intrinsics) or ``T0_ext1_in_world``,
    which maps the world to the camera despite its name.
    """
    groups = content.mapping
    if isinstance(content.value, list):
        records = [one for one in content.value if isinstance(one, dict)]
        groups = {str(one.get("episode_uuid", k)): _droid_3d(one) for k, one in enumerate(records)}

    def read(key: str) -> dict[str, Entry]:
        found = by_name(content._replace(value=groups[key]))
        return {} if isinstance(found, str) else found

    own = [key for key in groups if key in content.episode_ids]
    held = own if len(own) == 1 else [key for key in groups if read(key)]
    if len(held) > 1:
        names = listed_names(sorted(content.episode_ids)) or "unknown (metadata_<episode ID>.json)"
        raise CameraError(
            f"{content.path}: has {len(held)} entries, from {held[0]} on; this recording's names "
            f"are {names}: keep only the entry of the episode in the file"
        )
    return (read(held[0]) if held else {}) or "no poses by episode"


def _droid_3d(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cameras of a line of DROID-3D's files: poses or intrinsics by name."""
    keys = {"ext1": "T0_ext1_in_world", "ext2": "T1_ext2_in_world"}
    found = {name: {"world_to_camera": record[key]} for name, key in keys.items() if key in record}
    cameras = record.get("cameras")
    for role, one in cameras.items() if isinstance(cameras, dict) else ():
        if isinstance(one, dict) and isinstance(one.get("left"), dict):
            # Its `disto` is not read: the recorded pictures are rectified.
            found[str(one.get("serial") or role)] = one["left"]
    return found
