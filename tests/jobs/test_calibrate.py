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
    return folder, cameras, poses


@pytest.fixture(scope="module")
def report(taken, tmp_path_factory):
    folder = taken[0]
    out = tmp_path_factory.mktemp("out") / "cameras.yaml"
    settings = CalibrationSettings(leave_out=["c1/9998", f"c0/{first_frame(folder)}"])
    return calibrate_folder(folder, folder / "board.yaml", out, settings)


def first_frame(folder):
    return min(path.stem for path in (folder / "images" / "c0").iterdir())


def test_known_cameras_come_back_from_pictures(taken, report):
    _, cameras, _ = taken
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


def test_undistorted_pictures_fit_the_written_cameras(taken, report, tmp_path):
    folder, cameras, poses = taken
    shutil.copytree(folder, tmp_path / "own")
    (tmp_path / "own" / "images" / "c2" / "9999.png").unlink()
    written = undistort_pictures(tmp_path / "own", load_lenses(report.files[1]), tmp_path)
    straight = load_cameras(report.files[0])
    X_0W = np.linalg.inv(cameras["c0"].X_WC)
    checked = 0
    for (name, frame), path in list(written.items())[::3]:
        if frame not in poses:
            continue
        detection = CHECKERBOARD.find(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        if detection is None:
            continue  # Cut off by the undistorted picture's edge.
        X_0B = X_0W @ poses[frame]
        uv, _ = straight[name].project(CHECKERBOARD.points @ X_0B[:3, :3].T + X_0B[:3, 3])
        difference = detection.uv - uv
        # The shape must fit; how far off the whole lies is the poses' error.
        assert np.abs(difference - difference.mean(axis=0)).max() < 1.5
        checked += 1
    assert checked >= 4


def test_folders_that_cannot_be_used(taken, tmp_path):
    folder, _, _ = taken
    (tmp_path / "images" / "c0").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "images" / "c0" / "1.png"), np.zeros((20, 30), np.uint8))
    with pytest.raises(CameraError, match="found in 0 pictures"):
        calibrate_folder(tmp_path, folder / "board.yaml")
    with pytest.raises(CameraError, match="no such folder"):
        calibrate_folder(tmp_path / "nowhere", folder / "board.yaml")
    settings = CalibrationSettings(leave_out=["c7"])
    with pytest.raises(UnknownNameError, match="c7"):
        calibrate_folder(folder, folder / "board.yaml", settings=settings)
