import csv
import json

import numpy as np
import pytest

from drake_pose.apps.capture import capture_scene
from drake_pose.body import bundled_model, load_model
from drake_pose.camera import save_cameras
from drake_pose.camera.rigs import circle_of_cameras
from drake_pose.errors import SceneError
from drake_pose.silhouette import LabelRenderer, write_mask

FRAMES = 3


def record(folder, moved=None):
    """A scene of a person who raises an arm; one camera may have moved after its calibration."""
    person = load_model(bundled_model("person"), check=False)
    cameras = circle_of_cameras(4, size=(160, 120), face_camera=False)
    save_cameras(folder / "cameras.yaml", cameras)
    (folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
    truth = []
    for k in range(FRAMES):
        q = np.zeros(len(person.position_names))
        q[person.position_index("position_z")] = 1.55
        q[person.position_index("left_upper_arm_z")] = np.radians(30.0 + 10.0 * k)
        q[person.position_index("right_upper_arm_z")] = np.radians(-30.0)
        truth.append(q)
        for name, camera in cameras.items():
            seen = camera
            if name == moved:
                X_WC = camera.X_WC.copy()
                X_WC[2, 3] += 0.35
                seen = camera.with_pose(X_WC)
            path = folder / "masks" / name / f"{k:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mask(path, LabelRenderer(person, seen).mask(q))
    return person, np.array(truth)


@pytest.mark.slow
def test_person_is_captured_and_a_corrupt_picture_costs_only_itself(tmp_path):
    scene, out = tmp_path / "scene", tmp_path / "out"
    scene.mkdir()
    person, truth = record(scene)
    (scene / "masks" / "camera_1" / "0001.png").write_bytes(b"no picture")
    captured = capture_scene(scene, out, person.path, replay=False)
    assert captured.summary["found_count"] == FRAMES
    assert captured.summary["mean_iou"] > 0.85
    assert any("camera_1" in text and "0001" in text for text in captured.warnings)
    summary = json.loads((out / "summary.json").read_text())
    assert "camera_1" not in summary["frames"]["0001"]["cameras"]
    with (out / "poses.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    found = np.degrees([float(row["left_upper_arm_z"]) for row in rows])
    np.testing.assert_allclose(
        found, np.degrees(truth[:, person.position_index("left_upper_arm_z")]), atol=8.0
    )
    assert {"joint_centres.csv", "joint_centres.trc", "positions.mot"} <= {
        path.name for path in out.iterdir()
    }


@pytest.mark.slow
def test_camera_that_moved_since_calibration_is_named(tmp_path):
    scene = tmp_path / "scene"
    scene.mkdir()
    person, _ = record(scene, moved="camera_2")
    captured = capture_scene(scene, tmp_path / "out", person.path, replay=False)
    assert [text for text in captured.warnings if "camera_2" in text and "moved" in text]
    assert not [text for text in captured.warnings if "camera_0" in text]


def test_one_camera_is_too_few(tmp_path):
    cameras = circle_of_cameras(1, size=(160, 120), face_camera=False)
    save_cameras(tmp_path / "cameras.yaml", cameras)
    path = tmp_path / "masks" / "camera_0" / "0000.png"
    path.parent.mkdir(parents=True)
    mask = np.zeros((120, 160), dtype=bool)
    mask[40:80, 60:90] = True
    write_mask(path, mask)
    with pytest.raises(SceneError, match="two calibrated cameras"):
        capture_scene(tmp_path, tmp_path / "out")
