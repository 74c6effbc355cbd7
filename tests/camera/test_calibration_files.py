"""Cameras of calibration tools' files, against OpenCV's own projection."""

import cv2
import numpy as np
import pytest
import yaml

from drake_pose.camera.camera_files import load_camera_file
from drake_pose.errors import CameraError

SIZE = (640, 480)
K = np.array([[500.0, 0.0, 310.0], [0.0, 505.0, 250.0], [0.0, 0.0, 1.0]])
RADIAL = np.array([-0.2, 0.05, 1e-3, -1e-3, 0.01])
FISHEYE = np.array([0.02, -0.01, 0.004, -0.001])
RVEC, T = np.array([0.3, -0.2, 0.9]), np.array([0.1, -0.2, 2.5])
R = cv2.Rodrigues(RVEC)[0]
POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (30, 3))


def matrix(values):
    return {
        "rows": len(values),
        "cols": values.size // len(values),
        "data": values.ravel().tolist(),
    }


def camera_info(model="plumb_bob", coefficients=RADIAL):
    return yaml.safe_dump({
        "image_width": SIZE[0], "image_height": SIZE[1], "camera_name": "left",
        "camera_matrix": matrix(K), "distortion_model": model,
        "distortion_coefficients": matrix(np.array([coefficients])),
        "rectification_matrix": matrix(np.eye(3)),
    }, default_flow_style=None)  # fmt: skip


def opencv(pose=True):
    file = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    content = {"image_width": SIZE[0], "image_height": SIZE[1], "camera_matrix": K}
    content |= {"distortion_coefficients": RADIAL[:, None]}
    for name, value in (content | ({"R": R, "T": T[:, None]} if pose else {})).items():
        file.write(name, value)
    return file.releaseAndGetString()


def toml(rotation=RVEC, distortions=RADIAL, fisheye=False, translation=T):
    return (
        f'[cam_0]\nname = "left"\nsize = [{SIZE[0]}.0, {SIZE[1]}.0]\nmatrix = {K.tolist()}\n'
        f"distortions = {distortions.tolist()}\nrotation = {rotation.tolist()}\n"
        f"translation = {translation.tolist()}\nfisheye = {str(fisheye).lower()}\n"
        "\n[metadata]\nadjusted = false\nerror = 0.3\n"
    )


def kalibr(model="pinhole"):
    X_10 = np.vstack([np.column_stack([R, T]), [0.0, 0.0, 0.0, 1.0]]).tolist()
    both = {"intrinsics": [500.0, 505.0, 310.0, 250.0], "resolution": list(SIZE)}
    fisheye = {"distortion_model": "equidistant", "distortion_coeffs": FISHEYE.tolist()}
    radial = {"distortion_model": "radtan", "distortion_coeffs": RADIAL[:4].tolist()}
    first = {"camera_model": "pinhole", "rostopic": "/left/image_raw"}
    second = {"camera_model": model, "T_cn_cnm1": X_10}
    return yaml.safe_dump({"cam0": first | fisheye | both, "cam1": second | radial | both})


def load(tmp_path, text, name="any.txt"):
    path = tmp_path / name
    path.write_text(text)
    return load_camera_file(path, distorted=True)


def test_projections_match_opencv(tmp_path):
    """Through the lens, and through the camera of undistorted images."""
    for text, name, placed, coefficients in (
        (camera_info(), "left", False, RADIAL),
        # A skew of half a pixel at the edge of a picture is ignored.
        (camera_info().replace("[500.0, 0.0,", "[500.0, 0.4,"), "left", False, RADIAL),
        (camera_info("rational_polynomial", np.r_[RADIAL, 0.1, 0.02, 0]), "left", False, None),
        (opencv(), "any", True, RADIAL),
        (opencv().replace("%YAML 1.2", "%YAML:1.0"), "any", True, RADIAL),  # OpenCV 4.
        (opencv(pose=False), "any", False, RADIAL),
        (toml(), "left", True, RADIAL),
        (toml(rotation=R), "left", True, RADIAL),
        (kalibr(), "cam1", True, RADIAL[:4]),
    ):
        found = load(tmp_path, text)
        assert (name not in found.unplaced) == placed
        lens, camera = found.lenses[name], found.cameras[name]
        assert (camera.width, camera.height) == SIZE
        np.testing.assert_array_equal(lens.matrix, K)
        if coefficients is not None:
            np.testing.assert_array_equal(lens.distortion, coefficients)
        pose = (RVEC, T) if placed else (np.zeros(3), np.zeros(3))
        points = POINTS if placed else POINTS + np.array([0, 0, 3])
        uv = cv2.projectPoints(points, *pose, K, lens.distortion)[0]
        undistorted = cv2.undistortPoints(uv, K, lens.distortion, P=lens.undistorted_matrix)
        np.testing.assert_allclose(camera.project(points)[0], undistorted[:, 0], atol=0.01)
        exact = cv2.projectPoints(points, *pose, lens.undistorted_matrix, None)[0].reshape(-1, 2)
        np.testing.assert_allclose(camera.project(points)[0], exact, atol=1e-9)


def test_pictures_are_straightened_as_by_opencv(tmp_path):
    for text, name, D in (
        (kalibr(), "cam0", FISHEYE),
        (camera_info("equidistant", FISHEYE), "left", FISHEYE),
        (toml(distortions=FISHEYE, fisheye=True), "left", FISHEYE),
        (toml(), "left", RADIAL),
    ):
        lens = load(tmp_path, text).lenses[name]
        assert lens.fisheye == (D is FISHEYE)
        picture = np.random.default_rng(1).integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8)
        if lens.fisheye:
            picture = cv2.GaussianBlur(picture, (0, 0), 3)
            expected = cv2.fisheye.undistortImage(picture, K, D, Knew=lens.undistorted_matrix)
        else:
            expected = cv2.undistort(picture, K, D, None, lens.undistorted_matrix)
            # Undistorted images have no black rim.
            assert lens.undistort(np.full((*SIZE[::-1], 3), 255, np.uint8)).min() > 200
        assert np.percentile(np.abs(lens.undistort(picture).astype(int) - expected), 99) <= 1
        with pytest.raises(CameraError, match="640 x 9"):
            lens.undistort(picture[:9])


def test_unusable_files_are_named_with_the_supported_formats(tmp_path):
    for text, messages in (
        (camera_info("omnidirectional"), ["'left'", "distortion_model 'omnidirectional'"]),
        (camera_info("plumb_bob", RADIAL[:3]), ["'left'", "3 distortion coefficients"]),
        (camera_info().replace("image_width", "wide"), ["add image_width, image_height"]),
        (camera_info().replace("500", "-500"), ["camera matrix"]),
        (camera_info().replace("[500.0, 0.0,", "[500.0, 3.0,"), ["'left'", "skew of 3 pixels"]),
        (opencv().replace("image_height: 480\n", ""), ["image_height"]),
        (opencv()[:200], ["distortion coefficients"]),
        (kalibr("omni"), ["'cam1'", "Kalibr's 'omni'"]),
        (toml(translation=50 * T), ["'left'", "125 m", "millimetres"]),
        (toml(rotation=RVEC[:2]), ["rotation vector"]),
        (toml().replace("matrix = [[", "matrix = [["[:-1]), ["not a TOML file"]),
        (toml() + toml().replace("cam_0", "cam_1").split("[metadata]")[0], ["given twice"]),
        ('{"left": [0.71, -0.97]}', ["it has left.", "camera_info", "TOML"]),
    ):
        with pytest.raises(CameraError) as caught:
            load(tmp_path, text)
        for word in ["any.txt", *messages]:
            assert word in str(caught.value)
