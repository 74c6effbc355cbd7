"""Convert cameras to and from Drake's; write them for ROS and MuJoCo.

All describe undistorted images. Drake puts pixel centres at i + 0.5 and drake_pose at i, so
principal points differ by half a pixel. ROS has them at integers, and its optical frame is our
camera frame. MuJoCo's principal point is an offset from the image centre, and its camera looks
along -z with y up.
"""

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping

import numpy as np
import yaml
from pydrake.common.schema import Transform
from pydrake.common.yaml import yaml_dump, yaml_dump_typed, yaml_load, yaml_load_typed
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraConfig, CameraInfo
from scipy.spatial.transform import Rotation as Turn

from drake_pose.arrays import Array
from drake_pose.camera.models import HALF_PIXEL, Camera, PinholeCamera, camera_tuple
from drake_pose.camera.pose_files import Content, Entry, Parsed
from drake_pose.errors import CameraError


def camera_to_drake(
    camera: Camera, *, renderer_name: str, depth_range: tuple[float, float] | None = None
) -> tuple[ColorRenderCamera, DepthRenderCamera, RigidTransform]:
    """Return Drake's colour and depth render cameras, and the pose X_WC of the sensor.

    Drake has pinhole cameras only, so a parallel camera becomes a telephoto camera 30 km behind the
    middle of the depth range.

    ``camera``: the camera. ``renderer_name``: name of the renderer in the SceneGraph.
    ``depth_range``: minimum and maximum visible depth [m]; None: `near` to 1 km. For a parallel
    camera: depths of the body in the camera's frame, possibly negative and as tight as possible,
    because of the depth buffer's resolution; None: -2 to 2 m.

    Raises CameraError: the principal point of a pinhole lies outside the image (Drake refuses it),
    or the depth range is not finite, positive and increasing.
    """
    X_CT = RigidTransform()
    if isinstance(camera, PinholeCamera):
        near, far = depth_range or (camera.near, max(1000.0, 2.0 * camera.near))
        center_x, center_y = camera.center_x + HALF_PIXEL, camera.center_y + HALF_PIXEL
        if not (0.0 < center_x < camera.width and 0.0 < center_y < camera.height):
            raise CameraError(
                f"camera '{camera.name}': Drake's renderer needs the principal point inside the "
                f"picture, but it is at ({camera.center_x:g}, {camera.center_y:g}) of "
                f"{camera.width} x {camera.height}"
            )
        numbers = camera.focal_x, camera.focal_y, center_x, center_y
    else:
        nearest, farthest = depth_range or (-2.0, 2.0)
        middle, half = 0.5 * (nearest + farthest), 0.5 * (farthest - nearest)
        # At smaller distances rays are less parallel, at larger ones 32-bit floats are too coarse.
        # Masks differ least at 30 to 100 km.
        distance = max(3.0e4, 10.0 * half)
        near, far = distance - half, distance + half
        focal = camera.pixels_per_metre * distance
        # Drake needs the principal point inside the image: move the camera behind its centre.
        center_x, center_y = 0.5 * camera.width, 0.5 * camera.height
        aside = np.array([center_x - camera.center_x, center_y - camera.center_y]) - HALF_PIXEL
        X_CT = RigidTransform(np.array([*(aside / camera.pixels_per_metre), middle - distance]))
        numbers = focal, focal, center_x, center_y
    if not (math.isfinite(far) and 0.0 < near < far):
        raise CameraError(
            f"camera '{camera.name}': the depth range must be finite, positive and increasing, "
            f"not {near:g} to {far:g} m"
        )
    intrinsics = CameraInfo(camera.width, camera.height, *numbers)
    core = RenderCameraCore(renderer_name, intrinsics, ClippingRange(near, far), RigidTransform())
    depth = DepthRenderCamera(core, DepthRange(near, far))
    return ColorRenderCamera(core), depth, _rigid_transform(camera.X_WC) @ X_CT


def camera_from_drake(
    name: str, source: CameraInfo | RenderCameraCore, X_WC: np.ndarray | RigidTransform
) -> PinholeCamera:
    """Return the camera of a Drake CameraInfo or RenderCameraCore.

    ``name``: name of the returned camera. ``source``: the intrinsics; a RenderCameraCore also
    provides the near plane and the sensor's pose X_BS in its body. ``X_WC``: pose of the camera in
    the world; with a RenderCameraCore the pose of its body B.
    """
    pose = X_WC.GetAsMatrix4() if isinstance(X_WC, RigidTransform) else np.asarray(X_WC)
    near = PinholeCamera.near
    if isinstance(source, RenderCameraCore):
        pose = pose @ source.sensor_pose_in_camera_body().GetAsMatrix4()
        near, source = source.clipping().near(), source.intrinsics()
    centre = source.center_x() - HALF_PIXEL, source.center_y() - HALF_PIXEL
    size, focal = (source.width(), source.height()), (source.focal_x(), source.focal_y())
    return PinholeCamera(name, *size, *focal, *centre, pose, near)


def camera_to_config(camera: Camera) -> CameraConfig:
    """Return the CameraConfig of a pinhole camera, with label images enabled.

    Its depth range and far clipping plane are Drake's defaults, or larger if the near plane is far
    away; all else that a camera does not say is Drake's default.

    Raises CameraError: a parallel camera, or a principal point outside the image.
    """
    camera = _require_pinhole(camera, "a CameraConfig")
    camera_to_drake(camera, renderer_name="any")
    config = CameraConfig(
        name=camera.name,
        width=camera.width,
        height=camera.height,
        focal=CameraConfig.FocalLength(x=camera.focal_x, y=camera.focal_y),
        center_x=camera.center_x + HALF_PIXEL,
        center_y=camera.center_y + HALF_PIXEL,
        clipping_near=camera.near,
        X_PB=Transform(_rigid_transform(camera.X_WC)),
        label=True,
    )
    # Drake refuses a depth range beyond the clipping planes.
    config.clipping_far = max(config.clipping_far, 2.0 * camera.near)
    config.z_near = max(config.z_near, camera.near)
    config.z_far = max(config.z_far, 2.0 * camera.near)
    return config


def drake_cameras(content: Content) -> Parsed:
    """Read a Scenario of Drake (possibly below one name), a mapping of CameraConfigs, or one.

    A camera's name is its ``name``, or else the entry's key. It is that of the colour and label
    sensor, with the pose X_PB X_BC, which must be known, in the world or on a link.

    Raises CameraError: names the file, the camera and the problem; there are several scenarios, or
    one without a mapping of cameras.
    """
    given, path, found = content.mapping, content.path, dict[str, Entry]()
    levels = [one for one in (given, *given.values()) if isinstance(one, dict)]
    scenarios = [one["cameras"] for one in levels if "cameras" in one]
    names = {one.name for one in CameraConfig.__fields__} - {"width", "height"}
    if len(scenarios) > 1:
        raise CameraError(f"{path}: holds several scenarios; keep only the one with the cameras")
    configs = scenarios[0] if scenarios else given
    if scenarios and not (isinstance(configs, dict) and configs):
        raise CameraError(f"{path}: cameras must be a mapping from names to CameraConfigs")
    if not scenarios and names & {*given}:
        # Drake's default name of a camera.
        configs = {str(given.get("name", "preview_camera")): given}
    elif not scenarios and not any(names & {*one} for one in levels):
        return "no CameraConfig"
    for key, entry in configs.items():
        where = f"{path}: camera '{key}'"
        if not isinstance(entry, dict | None):
            raise CameraError(f"{where}: expected the fields of a CameraConfig")
        try:
            config = yaml_load_typed(
                schema=CameraConfig, data=yaml_dump({"name": str(key), **(entry or {})})
            )
            # Drake writes a link's name after that of its model: arm::hand.
            link = (config.X_PB.base_frame or "world").split("::")[-1]
            is_known = config.X_PB.IsDeterministic() and config.X_BC.IsDeterministic()
            if config.X_BC.base_frame or not is_known:
                raise CameraError("X_PB or X_BC is stochastic, or X_BC has a base_frame")
            core = config.MakeCameras()[0].core()
            X_PB = config.X_PB.GetDeterministicValue()
            camera = camera_from_drake(config.name, core, X_PB)
        # yaml_load_typed raises many types, even SystemExit.
        except (Exception, SystemExit) as error:
            # Drake's assertion that a field is a mapping only shows the value.
            bare = "expected NAME: VALUE fields, not " if isinstance(error, AssertionError) else ""
            why = " ".join(str(error).split())
            raise CameraError(f"{where}: invalid CameraConfig: {bare}{why}") from error
        if config.name in found:
            raise CameraError(f"{path}: camera '{config.name}' is given twice")
        found[config.name] = Entry(camera.X_WC, "" if link == "world" else link, camera=camera)
    return found


def dump_scenario(
    cameras: Mapping[str, Camera] | Iterable[Camera], links: Mapping[str, str] | None = None
) -> str:
    """Return the text of a Scenario, for ``LoadScenario``, with cameras that render label images.

    ``cameras``: the cameras, by name or in sequence. ``links``: link of each camera that is mounted
    on one, by the camera's name; its pose is in the link's frame. None: all poses are in the world.
    Raises CameraError: a parallel camera, or a principal point outside the image.
    """
    content = {}
    for camera in camera_tuple(cameras):
        config = camera_to_config(camera)
        config.X_PB.base_frame = (links or {}).get(camera.name)
        content[camera.name] = yaml_load(
            data=yaml_dump_typed(config, schema=CameraConfig, defaults=CameraConfig())
        )
    return str(yaml_dump({"cameras": content}))


def _rigid_transform(X_AB: np.ndarray) -> RigidTransform:
    """Return a pose (4, 4) as Drake's type, with its rotation orthonormalised."""
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(X_AB[:3, :3]), X_AB[:3, 3])


def ros_camera_info(camera: Camera) -> str:
    """Return a CameraInfo in the YAML format of ROS's camera_calibration_parsers.

    The images have no distortion: D is 0, R the identity, and P is K.

    Raises CameraError: a parallel camera.
    """
    one = _require_pinhole(camera, "a CameraInfo")
    K = np.array([[one.focal_x, 0.0, one.center_x], [0.0, one.focal_y, one.center_y], [0, 0, 1.0]])
    content = {
        "image_width": one.width,
        "image_height": one.height,
        "camera_name": _ros_name(one.name),
        "camera_matrix": _matrix(K),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": _matrix(np.zeros((1, 5))),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.column_stack([K, np.zeros(3)])),
    }
    return str(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def ros_transforms(
    cameras: Mapping[str, Camera] | Iterable[Camera], frames: Mapping[str, str]
) -> str:
    """Return a launch file (XML) of ROS 2 with a static_transform_publisher for each optical frame.

    ``cameras``: the cameras, by name or in sequence. ``frames``: parent frame of each pose X_WC
    [m], by the camera's name.
    """
    launch = ElementTree.Element("launch")
    for camera in camera_tuple(cameras):
        name, (x, y, z) = _ros_name(camera.name), camera.X_WC[:3, 3].tolist()
        qx, qy, qz, qw = Turn.from_matrix(camera.X_WC[:3, :3]).as_quat().tolist()
        numbers = {"x": x, "y": y, "z": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw}
        words = [f"--{key} {value!r}" for key, value in numbers.items()]
        words += [f"--frame-id {frames[camera.name]}", f"--child-frame-id {name}_optical_frame"]
        node = {"pkg": "tf2_ros", "exec": "static_transform_publisher", "name": f"pose_of_{name}"}
        ElementTree.SubElement(launch, "node", node | {"args": " ".join(words)})
    return _xml(launch)


def mujoco_cameras(
    cameras: Mapping[str, Camera] | Iterable[Camera], links: Mapping[str, str] | None = None
) -> str:
    """Return XML with MuJoCo's <camera> elements, to be included in <worldbody>.

    ``cameras``: the cameras, by name or in sequence. ``links``: link of each camera that is mounted
    on one, by the camera's name; it stands in a <body> of that name, in whose frame its pose is.
    None: all poses are in the world. Raises CameraError: a parallel camera.
    """
    root = ElementTree.Element("mujocoinclude")
    text = " Include in <worldbody>; what is in a <body>, put into the robot's body of that name "
    root.append(ElementTree.Comment(text))
    bodies = {"": root}
    pixel = 1e-5  # Size of a sensor pixel [m]; arbitrary, because focal lengths are in pixels.
    R_CM = np.diag([1.0, -1.0, -1.0])  # From MuJoCo's frame, y up and z backward, to ours.
    for camera in camera_tuple(cameras):
        one = _require_pinhole(camera, "a camera of MuJoCo here")
        if (link := (links or {}).get(camera.name, "")) not in bodies:
            bodies[link] = ElementTree.SubElement(root, "body", {"name": link})
        turn = Turn.from_matrix(one.X_WC[:3, :3] @ R_CM).as_quat()
        middle = 0.5 * np.array([one.width - 1, one.height - 1])
        size = np.array([one.width, one.height])
        fields = {
            "pos": one.X_WC[:3, 3],
            "quat": np.roll(turn, 1),
            "resolution": size,
            "sensorsize": pixel * size,
            "focalpixel": np.array([one.focal_x, one.focal_y]),
            "principalpixel": middle - [one.center_x, one.center_y],
        }
        texts = {key: " ".join(map(repr, value.tolist())) for key, value in fields.items()}
        ElementTree.SubElement(bodies[link], "camera", {"name": one.name} | texts)
    return _xml(root)


def _require_pinhole(camera: Camera, what: str) -> PinholeCamera:
    """Return the camera if it is a pinhole, else raise CameraError.

    ``what``: what needs a pinhole, for the message.
    """
    if isinstance(camera, PinholeCamera):
        return camera
    raise CameraError(
        f"camera '{camera.name}': {what} is a pinhole, not parallel; leave the camera out"
    )


def _matrix(values: Array) -> dict[str, object]:
    """Return a matrix as ROS's YAML mapping of rows, cols, and data by rows."""
    rows, cols = values.shape
    return {"rows": rows, "cols": cols, "data": values.ravel().tolist()}


def _ros_name(name: str) -> str:
    """Return a name with all but letters, digits and underscores replaced, as ROS requires."""
    return re.sub(r"[^A-Za-z0-9_]", "_", name)


def _xml(root: ElementTree.Element) -> str:
    """Return an element as indented text."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
