"""Write cameras for ROS and MuJoCo; drake_pose.camera.drake writes Drake's.

All describe undistorted images. ROS has pixel centres at integers and its optical frame is our
camera frame. MuJoCo's principal point is an offset from the image centre, and its camera looks
along -z with y up.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, PinholeCamera, camera_tuple
from drake_pose.errors import CameraError


def ros_camera_info(camera: Camera) -> str:
    """Return a CameraInfo in the YAML format of ROS's camera_calibration_parsers.

    The images have no distortion: D is 0, R the identity, and P is K.

    Raises CameraError: a parallel camera.
    """
    one = _pinhole(camera, "a CameraInfo")
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

    Args:
        cameras: the cameras, by name or in sequence.
        frames: parent frame of each pose X_WC [m], by the camera's name.
    """
    launch = ElementTree.Element("launch")
    for camera in camera_tuple(cameras):
        name, (x, y, z) = _ros_name(camera.name), camera.X_WC[:3, 3].tolist()
        qx, qy, qz, qw = Rotation.from_matrix(camera.X_WC[:3, :3]).as_quat().tolist()
        numbers = {"x": x, "y": y, "z": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw}
        words = [f"--{key} {value!r}" for key, value in numbers.items()]
        words += [f"--frame-id {frames[camera.name]}", f"--child-frame-id {name}_optical_frame"]
        node = {"pkg": "tf2_ros", "exec": "static_transform_publisher", "name": f"pose_of_{name}"}
        ElementTree.SubElement(launch, "node", node | {"args": " ".join(words)})
    return _xml(launch)


def mujoco_cameras(cameras: Mapping[str, Camera] | Iterable[Camera]) -> str:
    """Return XML with MuJoCo's <camera> elements, to be included in <worldbody>.

    Cameras whose X_WC is the pose in a link belong into that link's <body> instead.

    Raises CameraError: a parallel camera.
    """
    root = ElementTree.Element("mujocoinclude")
    pixel = 1e-5  # Size of a sensor pixel [m]; arbitrary, because focal lengths are in pixels.
    R_CM = np.diag([1.0, -1.0, -1.0])  # From MuJoCo's frame, y up and z backward, to ours.
    for camera in camera_tuple(cameras):
        one = _pinhole(camera, "a camera of MuJoCo here")
        turn = Rotation.from_matrix(one.X_WC[:3, :3] @ R_CM).as_quat()
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
        ElementTree.SubElement(root, "camera", {"name": one.name} | texts)
    return _xml(root)


def _pinhole(camera: Camera, what: str) -> PinholeCamera:
    """Return the camera if it is a pinhole, else raise CameraError.

    Args:
        what: what needs a pinhole, for the message.
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
