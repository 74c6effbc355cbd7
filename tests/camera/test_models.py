"""Camera models: projections, parameters, and conversion to Drake."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydrake.geometry import ClippingRange, RenderCameraCore
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraInfo

from drake_pose.camera.exchange import camera_from_drake, camera_to_drake
from drake_pose.camera.models import (
    FACE_CAMERA,
    ParallelCamera,
    PinholeCamera,
    circle_of_cameras,
    intrinsics_warnings,
    look_at,
)
from drake_pose.errors import CameraError

X_WC = RigidTransform(RollPitchYaw(0.3, -0.8, 1.1), np.array([0.5, -2.0, 1.5])).GetAsMatrix4()
PINHOLE = PinholeCamera("cam", 640, 480, 600.0, 610.0, 300.0, 250.0, X_WC)
PARALLEL = ParallelCamera("flat", 700, 500, 226.0, 350.0, 200.0, X_WC)
POINTS = np.array([[0.1, -0.2, 1.3], [-0.4, 0.3, 2.0]])


def points_before_camera(rng, low, high):
    """Return points (50, 3) in the camera's frame, and the same points in the world."""
    p_C = rng.uniform(low, high, (50, 3))
    return p_C, p_C @ X_WC[:3, :3].T + X_WC[:3, 3]


def test_pinhole_projection_matches_opencv():
    p_C, p_W = points_before_camera(np.random.default_rng(0), [-1, -1, 0.5], [1, 1, 4])
    K = np.array([[600.0, 0, 300], [0, 610, 250], [0, 0, 1]])
    rotation, _ = cv2.Rodrigues(X_WC[:3, :3].T)
    expected, _ = cv2.projectPoints(p_W, rotation, -X_WC[:3, :3].T @ X_WC[:3, 3], K, None)
    uv, depth = PINHOLE.project(p_W)
    np.testing.assert_allclose(uv, expected[:, 0], atol=1e-8)
    np.testing.assert_allclose(depth, p_C[:, 2], atol=1e-12)


def test_resized_and_mirrored_cameras():
    """Image corners, half a pixel outside the outermost centres, stay corners.

    A scene is mirrored in the plane x = 0 of the camera; mirroring twice is the identity.
    """
    camera = replace(PINHOLE, X_WC=np.eye(4))
    before, after = camera.project(POINTS)[0], camera.resized(160, 240).project(POINTS)[0]
    np.testing.assert_allclose((after + 0.5) * [4.0, 2.0], before + 0.5)
    seen = camera.mirrored().project(POINTS * [-1, 1, 1])[0]
    np.testing.assert_allclose(seen, [camera.width - 1, 0] + before * [-1, 1])
    again = camera.mirrored().mirrored()
    np.testing.assert_array_equal(again.kernel_parameters(), camera.kernel_parameters())


def test_depth_is_along_the_optical_axis():
    points = np.array([[0.5, 0.5, -7.0], [0.0, 0.0, 2.0], [0.5, 0.5, 9.0]])
    uv, depth = replace(PINHOLE, X_WC=np.eye(4)).project(points)
    assert np.isnan(uv[0]).all(), "points behind the camera have no pixel"
    np.testing.assert_allclose(uv[1], [300.0, 250.0])
    np.testing.assert_array_equal(depth, points[:, 2])
    uv, depth = replace(PARALLEL, X_WC=np.eye(4)).project(points)
    np.testing.assert_allclose(uv[[0, 2]], [[463.0, 313.0]] * 2)
    np.testing.assert_array_equal(depth, points[:, 2])


def test_poses_and_kernel_parameters():
    for camera, expected in (
        (replace(PINHOLE, near=0.2), [0, 600, 610, 300, 250, 0.2, 640, 480]),
        (PARALLEL, [1, 226, 226, 350, 200, 0, 700, 500]),
    ):
        np.testing.assert_array_equal(camera.kernel_parameters(), expected)
        np.testing.assert_allclose(camera.X_CW @ camera.X_WC, np.eye(4), atol=1e-14)
        assert not camera.X_WC.flags.writeable
        # A rounded rotation becomes exact.
        R = camera.with_pose(np.round(X_WC, 6)).X_WC[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(R, X_WC[:3, :3], atol=2e-6)
        moved = camera.with_pose(np.eye(4))
        np.testing.assert_array_equal(moved.kernel_parameters(), camera.kernel_parameters())


def test_invalid_parameters_are_named():
    nest = [1.0]  # As aliases of YAML nest; it has 9 to the power of 40 entries.
    for _ in range(40):
        nest = 9 * [nest]
    for field, values in (
        ("width", [0, 12.5]),
        ("height", [-3, 10**9]),
        ("focal_x", [0.0, float("nan")]),
        ("focal_y", [-1.0]),
        ("center_x", [float("inf")]),
        ("center_y", ["here"]),
        ("near", [0.0, True]),
        ("X_WC", [nest, np.eye(3), np.full((4, 4), np.nan), np.array([["a"] * 4] * 4)]),
        ("X_WC", [np.diag([1.0, 1.0, *two]) for two in [(1.001, 1.0), (-1.0, 1.0), (1.0, 1.01)]]),
    ):
        for value in values:
            with pytest.raises(CameraError, match=f"'cam'.*{field}"):
                replace(PINHOLE, **{field: value})
        with pytest.raises(CameraError, match=r"'flat'.*pixels_per_metre"):
            replace(PARALLEL, pixels_per_metre=-1.0)


def test_conversion_to_drake_and_back():
    camera = replace(PINHOLE, near=0.05)
    color, depth, X_WS = camera_to_drake(camera, renderer_name="vtk")
    info = color.core().intrinsics()
    assert (info.center_x(), info.center_y()) == (300.5, 250.5)
    assert color.core().renderer_name() == depth.core().renderer_name() == "vtk"
    assert color.core().clipping().near() == 0.05
    again = camera_from_drake("again", color.core(), X_WS)
    np.testing.assert_array_equal(again.kernel_parameters(), camera.kernel_parameters())
    np.testing.assert_allclose(again.X_WC, camera.X_WC, atol=1e-14)
    plain = camera_from_drake("plain", CameraInfo(100, 80, 1.0), np.eye(4))
    assert (plain.center_x, plain.center_y) == (49.0, 39.0)
    with pytest.raises(CameraError, match=r"'cam'.*depth range"):
        camera_to_drake(PINHOLE, renderer_name="vtk", depth_range=(2.0, 1.0))
    # The sensor's offset in its body.
    X_BS = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), np.array([0.1, 0.0, -0.2]))
    core = RenderCameraCore("vtk", CameraInfo(100, 80, 1.0), ClippingRange(0.3, 9.0), X_BS)
    X_WB = RigidTransform(X_WC)
    camera = camera_from_drake("c", core, X_WB)
    np.testing.assert_allclose(camera.X_WC, (X_WB @ X_BS).GetAsMatrix4(), atol=1e-14)
    assert camera.near == 0.3


def test_telephoto_camera_approximates_the_parallel_one():
    for camera in (PARALLEL, replace(PARALLEL, center_x=-40.0, center_y=900.0)):
        color, _, X_WS = camera_to_drake(camera, renderer_name="vtk", depth_range=(-1.0, 3.0))
        tele = camera_from_drake("tele", color.core(), X_WS)
        _, p_W = points_before_camera(np.random.default_rng(1), [-1, -1, -1], [1, 1, 3])
        uv, depth = tele.project(p_W)
        # 2 m from the middle depth at 30 km: an error of 7e-5 times at most 700 pixels.
        np.testing.assert_allclose(uv, camera.project(p_W)[0], atol=0.1)
        clipping = color.core().clipping()
        assert clipping.near() <= depth.min() <= depth.max() <= clipping.far()
    color, _, _ = camera_to_drake(PARALLEL, renderer_name="vtk", depth_range=(-1e4, 1e4))
    clipping = color.core().clipping()
    assert clipping.near() > 0.8 * clipping.far(), "far enough away for deep scenes, too"


def test_cameras_on_a_circle_look_at_its_centre_and_the_face():
    middle, face_target = (0.1, 0.2, 0.9), (0.1, 0.2, 1.6)
    cameras = circle_of_cameras(8, radius=2.5, height=1.1, target=middle, size=(64, 48))
    *circle, face = cameras.values()
    assert face.name == FACE_CAMERA
    x, y, z = np.array([camera.X_WC[:3, 3] for camera in circle]).T
    angles = np.degrees(np.arctan2(y, x)) % 360.0
    np.testing.assert_allclose(angles, 22.5 + 45.0 * np.arange(8))
    np.testing.assert_allclose(np.hypot(x, y), 2.5)
    np.testing.assert_allclose(z, 1.1)
    for camera in cameras.values():
        target = np.array([face_target if camera is face else middle])
        np.testing.assert_allclose(camera.project(target)[0], [[31.5, 23.5]], atol=1e-9)
        assert camera.X_WC[2, 1] < 0.0, "up is up"
    np.testing.assert_allclose(face.X_WC[:3, 3], [2.6, 0.2, 1.6])
    views = [2.0 * np.degrees(np.arctan(24.0 / camera.focal_y)) for camera in cameras.values()]
    np.testing.assert_allclose(views, [46.0] * 8 + [22.0])
    first, face = circle_of_cameras(1).values()
    for camera, place, point in ((first, [-3.0, 0, 1.3], 0.95), (face, [3.0, 0, 1.6], 1.6)):
        np.testing.assert_allclose(camera.X_WC[:3, 3], place, atol=1e-12)
        np.testing.assert_allclose(camera.project([0, 0, point])[0], [[319.5, 239.5]])
    assert [*circle_of_cameras(1, face_camera=False), *circle_of_cameras(0)] == ["camera_0", "face"]
    # A camera may look steeply down, but not along the direction that is up in its picture.
    assert look_at([0.0, 0.1, 2.0], np.zeros(3))[2, 1] < 0.0
    with pytest.raises(CameraError, match="up"):
        look_at([0.0, 0.0, 2.0], np.zeros(3))
    with pytest.raises(CameraError, match="at least one camera"):
        circle_of_cameras(0, face_camera=False)
    with pytest.raises(CameraError, match="radius must be positive"):
        circle_of_cameras(1, radius=0.0)


def test_principal_points_far_from_the_middle_are_warned_of():
    """Those of pictures of twice the size, exchanged, and of 1920 x 1080 pixels."""

    def said(center_x, center_y, width=640, height=480):
        camera = PinholeCamera("eye", width, height, 600.0, 600.0, center_x, center_y, np.eye(4))
        return "".join(intrinsics_warnings([camera]))

    for x, y in ((639.5, 479.5), (238.0, 322.0), (959.5, 539.5)):
        assert f"pictures of {2 * x + 1:.0f} x {2 * y + 1:.0f}" in said(x, y)
    # Lenses are within a tenth of the pictures' size of the middle, in square pictures, too.
    rng = np.random.default_rng(5)
    for size in ((640, 480), (320, 180), (224, 224), (480, 640), (1920, 1080)):
        for _ in range(50):
            assert not said(*(rng.uniform(0.4, 0.6, 2) * size - 0.5), *size)
    assert not intrinsics_warnings([PARALLEL])
