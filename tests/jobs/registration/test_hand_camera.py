"""`drake-pose register --on LINK`: a camera on a robot's hand, from masks of the robot's base."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from drake_pose.body.model import load_model
from drake_pose.camera.files import load_camera_file, load_cameras
from drake_pose.errors import CameraError
from tests.cli import run_command
from tests.jobs.registration.arm_scenes import ArmScene, pose_errors
from tests.jobs.registration.hand_camera import X_LC, write_hand_camera


@pytest.fixture(scope="module")
def hand_camera(tmp_path_factory: pytest.TempPathFactory) -> ArmScene:
    return write_hand_camera(tmp_path_factory.mktemp("hand"))


def arguments(scene: ArmScene, out: Path, *more: str) -> list[str]:
    given = ["--model", str(scene.model), "--joints", str(scene.joints), "--out", str(out)]
    return ["register", str(scene.folder), *given, *more]


def test_the_camera_is_found_on_its_link(hand_camera: ArmScene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run_command(arguments(hand_camera, out, "--on", "flange", "--json"))
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["warnings"] == []
    assert found["link"] == "flange"
    assert "X_WC" not in found
    millimetres, degrees = pose_errors(np.array(found["X_LC"]), X_LC)
    assert millimetres < 1.5
    assert degrees < 0.15
    assert millimetres < 4.0 * np.sqrt(3.0) * found["translation_sd_mm"]
    assert found["mean_iou"] > 0.98
    assert len(list((out / "overlay" / "wrist").iterdir())) == 6
    assert "wrist" in (out / "report.html").read_text()
    read = load_camera_file(out / "cameras.yaml")
    assert read.links == {"wrist": "flange"}
    assert read.unplaced == ()
    np.testing.assert_allclose(read.cameras["wrist"].X_WC, found["X_LC"], atol=1e-12)
    one = yaml.safe_load((out / "registration.yaml").read_text())["wrist"]
    assert one["link"] == "flange"
    # It stands elsewhere in each frame: who needs cameras that stand still says so.
    with pytest.raises(CameraError, match="'wrist' rides on link 'flange' of a robot"):
        load_cameras(out / "cameras.yaml")


@pytest.mark.slow
def test_lengths_between_the_base_and_the_camera(hand_camera: ArmScene, tmp_path: Path) -> None:
    right, short = hand_camera.model.read_text(), tmp_path / "short.urdf"
    assert right.count('"0 0 0.35"') == 1
    short.write_text(right.replace('"0 0 0.35"', '"0 0 0.34"'))
    given = ["--on", "flange", "--lengths", "shoulder", "--lengths", "elbow", "--json"]
    scene, out = replace(hand_camera, model=short), tmp_path / "out"
    result = run_command(arguments(scene, out, *given))
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    off = 100.0 * (0.35 / 0.34 - 1.0)
    one = found["lengths"]["shoulder"]
    assert one["low_percent"] < off < one["high_percent"]
    assert one["value_percent"] == pytest.approx(off, abs=1.0)
    assert one["significant"]
    assert not found["lengths"]["elbow"]["significant"]
    millimetres, degrees = pose_errors(np.array(found["X_LC"]), X_LC)
    assert millimetres < 3.0
    assert degrees < 0.3
    assert found["mean_iou"] > 0.98
    # Drake has the joint that the link carries where the right arm has it, but for what is left.
    places = []
    for path in (hand_camera.model, out / "short_calibrated.urdf"):
        joint = load_model(path, check=False).plant.GetJointByName("roll_turn")
        places.append(joint.frame_on_parent().GetFixedPoseInBodyFrame().translation()[2])
    assert places[1] - places[0] == pytest.approx(0.34e-2 * (one["value_percent"] - off), abs=1e-9)


@pytest.mark.slow
def test_lengths_that_no_picture_tells_apart(hand_camera: ArmScene, tmp_path: Path) -> None:
    # Shoulder and roll are in line, and neither is seen: only their sum is told.
    given = ["--on", "flange", "--lengths", "shoulder", "--lengths", "roll", "--json"]
    result = run_command(arguments(hand_camera, tmp_path / "out", *given))
    assert result.exit_code == 0, result.output
    lengths = json.loads(result.stdout)["lengths"]
    assert not lengths["shoulder"]["determined"]
    assert lengths["shoulder"]["gauge"] == ["length of roll"]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--on", "paw"], "no link 'paw'"),
        (["--on", "base"], "no joint moves link 'base'"),
        (["--on", "hand", "--lengths", "paw"], "no link with a length 'paw'"),
    ],
)
def test_what_is_refused_before_work(
    more: list[str], said: str, hand_camera: ArmScene, tmp_path: Path
) -> None:
    result = run_command(arguments(hand_camera, tmp_path / "out", *more))
    assert result.exit_code == 1
    assert said in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()


def test_a_base_without_looks_is_named(arm_scene: ArmScene, tmp_path: Path) -> None:
    result = run_command(arguments(arm_scene, tmp_path / "out", "--on", "hand"))
    assert result.exit_code == 1
    assert "no link that is seen stands still" in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"link": "hand"}, "link's name"),
        ({"X_LC": np.eye(4).tolist()}, "link's name"),
        ({"link": "hand", "X_LC": np.eye(4).tolist(), "X_WC": np.eye(4).tolist()}, "no X_WC"),
    ],
)
def test_half_a_link_is_refused(fields: dict[str, object], said: str, tmp_path: Path) -> None:
    sides = dict(width=8, height=6, focal_x=9, focal_y=9, center_x=3.5, center_y=2.5)
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump({"wrist": sides | fields}))
    with pytest.raises(CameraError, match=said):
        load_camera_file(tmp_path / "cameras.yaml")
