"""`drake-pose calibrate`'s function: pictures in a folder to camera files."""

import json
import shutil

import cv2
import numpy as np
import pytest

from drake_pose.camera.calibrate import CalibrationSettings
from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.rig import load_lenses
from drake_pose.errors import CameraError, UnknownNameError
from drake_pose.jobs.calibrate import calibrate_folder, undistort_pictures
from tests.camera.boards import CHECKERBOARD, facing, inside, photograph, poses_for_pairs, ring

BOARD_YAML = "kind: checkerboard\nsquares: [8, 5]\nsquare_length: 0.12\n"


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Pictures of a board by three known cameras, one of them of nothing, and one damaged."""
    folder = tmp_path_factory.mktemp("taken")
    generator = np.random.default_rng(4)
    cameras = ring(3, generator, radius=2.0, spread=75.0)
    poses = poses_for_pairs(cameras, CHECKERBOARD, generator, 14)
    (folder / "board.yaml").write_text(BOARD_YAML)
    for name, camera in cameras.items():
        (folder / "images" / name).mkdir(parents=True)
        for frame, X_WB in poses.items():
            uv = camera.project(CHECKERBOARD.points @ X_WB[:3, :3].T + X_WB[:3, 3])
            if facing(X_WB, camera) and inside(uv, camera):
                picture = photograph(camera, CHECKERBOARD, X_WB, generator)
                cv2.imwrite(str(folder / "images" / name / f"{frame}.png"), picture)
    cv2.imwrite(str(folder / "images" / "c1" / "9998.png"), np.full((480, 640), 90, np.uint8))
    (folder / "images" / "c2" / "9999.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    return folder, cameras


@pytest.fixture(scope="module")
def report(taken, tmp_path_factory):
    folder = taken[0]
    out = tmp_path_factory.mktemp("out") / "cameras.yaml"
    settings = CalibrationSettings(leave_out=["c1/9998", f"c0/{first_frame(folder)}"])
    return calibrate_folder(folder, folder / "board.yaml", out, settings)


def first_frame(folder):
    return min(path.stem for path in (folder / "images" / "c0").iterdir())


def test_known_cameras_come_back_from_pictures(taken, report):
    _, cameras = taken
    written = load_cameras(report.files[0])
    assert list(written) == list(cameras)
    for name, true in cameras.items():
        X_0C = np.linalg.inv(cameras["c0"].X_WC) @ true.X_WC
        D = np.linalg.inv(X_0C) @ written[name].X_WC
        assert np.linalg.norm(D[:3, 3]) < 0.04
        assert report.calibration.camera_errors[name] < 0.4
        assert report.calibration.lenses[name].focal_x == pytest.approx(true.focal, rel=0.02)


def test_bad_pictures_are_named_and_harm_nothing(taken, report):
    assert report.seen.not_found == (("c1", "9998"),)
    assert set(report.seen.unreadable) == {("c2", "9999")}
    text = "\n".join(report.warnings)
    assert "'9998'" in text
    assert "9999.png" in text
    assert f"camera 'c0', picture '{first_frame(taken[0])}' left out: left out on request" in text
    values = json.loads(json.dumps(report.as_json(), allow_nan=False))
    assert set(values["cameras"]) == {"c0", "c1", "c2"}
    assert 0.0 < values["error_pixels"] < 0.4
    assert values["world"] == "camera:c0"
    assert values["not_found"] == [["c1", "9998"]]
    assert report.table().row_count == 3


def test_pictures_are_undistorted_by_their_cameras_lenses(taken, report, tmp_path):
    shutil.copytree(taken[0] / "images", tmp_path / "images")
    (tmp_path / "images" / "c2" / "9999.png").unlink()
    lenses = load_lenses(report.files[1])
    written = undistort_pictures(tmp_path, lenses, tmp_path / "straight")
    assert len(written) == len(list(tmp_path.glob("images/*/*.png")))
    for (name, frame), path in written.items():
        assert path == tmp_path / "straight" / "images" / name / f"{frame}.png"
        own = cv2.imread(str(tmp_path / "images" / name / f"{frame}.png"))
        np.testing.assert_array_equal(cv2.imread(str(path)), lenses[name].undistort(own))
    del lenses["c1"]
    with pytest.raises(CameraError, match="camera 'c1' has no lens; there are: c0, c2"):
        undistort_pictures(tmp_path, lenses, tmp_path / "again")


def test_folders_that_cannot_be_used(taken, tmp_path):
    folder, _ = taken
    (tmp_path / "images" / "c0").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "images" / "c0" / "1.png"), np.zeros((20, 30), np.uint8))
    with pytest.raises(CameraError, match="found in 0 pictures"):
        calibrate_folder(tmp_path, folder / "board.yaml")
    with pytest.raises(CameraError, match="no such folder"):
        calibrate_folder(tmp_path / "nowhere", folder / "board.yaml")
    settings = CalibrationSettings(leave_out=["c7"])
    with pytest.raises(UnknownNameError, match="c7"):
        calibrate_folder(folder, folder / "board.yaml", settings=settings)
