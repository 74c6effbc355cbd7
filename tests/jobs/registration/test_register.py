"""`drake-pose register`: a camera file with poses, from masks and joint positions."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from drake_pose.body.model import load_model
from drake_pose.body.tree.root import RootRotation
from drake_pose.camera.camera_files import load_cameras
from drake_pose.files.overlay import EXCESS_RGB, MISSING_RGB
from drake_pose.jobs.registration.register import register_scene, say_common
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.registration.register import CameraSearch, FrameMisfit, RegisteredCamera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.cli import Result, run_command
from tests.jobs.registration.arm_scenes import ArmScene, pose_errors
from tests.jobs.scenes import TinyScene, write_truth
from tests.search.arms import arm_cameras


def run(scene: ArmScene, out: Path, *more: str) -> Result:
    given = ["--model", str(scene.model), "--joints", str(scene.joints), "--out", str(out)]
    return run_command(["register", str(scene.folder), *given, *more])


@pytest.fixture(scope="module")
def registered(
    arm_scene: ArmScene, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any], Result]:
    """The camera without X_WC, found on the command line: folder, JSON, all that was said."""
    out = tmp_path_factory.mktemp("registered") / "out"
    result = run(arm_scene, out, "--json")
    assert result.exit_code == 0, result.output
    return out, json.loads(result.stdout), result


class TestRegister:
    def test_the_camera_is_found_and_the_other_one_held(self, arm_scene, registered) -> None:
        out, found, result = registered
        assert result.stderr == ""
        assert found["warnings"] == []
        written = load_scene_cameras(arm_scene, out)
        assert list(written) == ["left", "right"]
        millimetres, degrees = pose_errors(written["left"].X_WC, arm_scene.cameras["left"].X_WC)
        # Two metres before a camera of 320 x 240 pixels.
        assert millimetres < min(8.0, 4.0 * np.sqrt(3.0) * found["translation_sd_mm"])
        assert degrees < min(0.2, 4.0 * np.sqrt(3.0) * found["rotation_sd_deg"])
        np.testing.assert_array_equal(written["right"].X_WC, arm_scene.cameras["right"].X_WC)
        for name in ("width", "focal_x", "focal_y", "center_x", "center_y", "near"):
            assert getattr(written["left"], name) == getattr(arm_scene.cameras["left"], name)

    def test_json(self, registered) -> None:
        out, found, _ = registered
        assert found == json.loads((out / "summary.json").read_text())
        assert list(found["cameras"]) == ["left"]
        for name in ("X_WC", "translation_sd_mm", "rotation_sd_deg", "families", "mean_iou"):
            assert found[name] == found["cameras"]["left"][name]
        assert found["families"] == [{"X_WC": found["X_WC"]}]
        assert found["mean_iou"] > 0.98
        assert (found["zeros"], found["lengths"], found["contradictions"]) == ({}, {}, [])
        assert 0.0 < found["rotation_sd_deg"] < 1.5
        assert 0.0 < found["seconds"]
        assert list(found["frames"]) == [f"{k:04d}" for k in range(5)]

    def test_covariance(self, registered) -> None:
        out, found, _ = registered
        one = yaml.safe_load((out / "registration.yaml").read_text())["left"]
        covariance = np.array(one["covariance"])
        assert one["errors"] == ["turn_x", "turn_y", "turn_z", "x", "y", "z"]
        assert (np.linalg.eigvalsh(covariance) > 0.0).all()
        turn = np.degrees(np.sqrt(np.trace(covariance[:3, :3]) / 3.0))
        assert found["rotation_sd_deg"] == pytest.approx(turn)
        assert one["X_WC"] == found["X_WC"]

    def test_overlays_and_report(self, registered) -> None:
        pictures = sorted((registered[0] / "overlay" / "left").glob("*.png"))
        assert [path.stem for path in pictures] == [f"{k:04d}" for k in range(5)]
        picture = cv2.imread(str(pictures[0]))[:, :, ::-1]
        assert picture.shape[1] >= 560
        # But for the legend's squares, body and mask are one.
        wrong = [(picture == rgb).all(axis=2).mean() for rgb in (MISSING_RGB, EXCESS_RGB)]
        assert max(wrong) < 0.005
        page = (registered[0] / "report.html").read_text()
        assert page.count("data:image/jpeg;base64,") == 5
        assert page.count("<tr><td>000") == 5
        assert "contradicts" not in page
        assert "Zeros and lengths" not in page
        assert "from masks and joint positions" in page
        assert not (registered[0] / "overlay_as_given").exists()
        for name in ("cameras.yaml", "registration.yaml", "summary.json", "overlay/left/0003.png"):
            assert f'href="{name}"' in page
            assert (registered[0] / name).is_file()


def load_scene_cameras(scene: ArmScene, out: Path) -> dict[str, Any]:
    """The cameras as an estimate of the scene reads them from a result's camera file."""
    cameras = load_cameras(out / "cameras.yaml")
    return dict(load_scene(scene.folder, cameras).cameras)


def test_estimate_says_how_a_missing_pose_is_found(arm_scene: ArmScene, tmp_path: Path) -> None:
    given = ["--model", str(arm_scene.model), "--out", str(tmp_path / "out")]
    result = run_command(["estimate", str(arm_scene.folder), *given])
    assert result.exit_code == 1
    assert "camera 'left': a pinhole camera needs X_WC; drake-pose register" in result.stderr


@pytest.mark.slow
class TestOnTheTerminal:
    def test_a_camera_that_has_a_pose_is_found_anew(
        self, own_arm: ArmScene, tmp_path: Path
    ) -> None:
        wrong = np.eye(4)
        wrong[:3, 3] = [1.0, 0.3, -0.4]
        own_arm.edit_cameras("right", X_WC=wrong.tolist())
        result = run(own_arm, tmp_path / "out", "--camera", "right", "--no-overlay")
        assert result.exit_code == 0, result.output
        # Nobody knows where the other one stands, and nobody asked.
        assert "camera 'left' has no X_WC" in result.stderr
        written = load_cameras(tmp_path / "out" / "cameras.yaml")
        assert list(written) == ["right"]
        assert pose_errors(written["right"].X_WC, own_arm.cameras["right"].X_WC)[0] < 8.0
        assert not (tmp_path / "out" / "overlay").exists()
        assert "5 of 5" in result.stdout
        assert "cameras.yaml" in result.stdout

    def test_one_pose_and_a_held_camera_that_looks_elsewhere_are_warned_of(
        self, own_arm: ArmScene, tmp_path: Path
    ) -> None:
        elsewhere = np.array(own_arm.cameras["right"].X_WC)
        elsewhere[:3, 3] += [0.0, 0.8, 0.0]
        own_arm.edit_cameras("right", X_WC=elsewhere.tolist())
        result = run(own_arm, tmp_path / "out", "--frame", "2", "--json")
        assert result.exit_code == 0, result.output
        assert "camera 'right' is held at its X_WC, but the robot is not seen" in result.stderr
        assert "--camera right" in result.stderr
        assert "camera 'left': there is one frame, '0002'" in result.stderr
        assert list(json.loads(result.stdout)["frames"]) == ["0002"]


def mean_iou(scene: Path, model_path: Path, joints: dict[str, list[float]], camera: Any) -> float:
    """Of Drake's own pictures of the robot at its encoders' angles with the masks."""
    model = load_model(model_path, check=False)
    tree = model.pose_tree(root_position=np.zeros(3), root_rotation=RootRotation.fixed(np.eye(3)))
    renderer, read = LabelRenderer(model, camera), load_scene(scene, {camera.name: camera})
    found = []
    for frame, values in joints.items():
        q, X_WB = tree.positions_from([np.zeros(0), *np.array(values)[:, None]])
        mask, body = read.read(camera.name, frame), renderer.mask(q, X_WB)
        found.append((mask & body).sum() / (mask | body).sum())
    return float(np.mean(found))


def encoders(path: Path) -> dict[str, list[float]]:
    lines = [line.split(",") for line in path.read_text().split()[1:]]
    return {f"{int(line[0]):04d}": [float(cell) for cell in line[1:]] for line in lines}


@pytest.mark.slow
class TestRecordedArms:
    def test_two_cameras_whose_poses_are_withheld(self, shared_data: Path) -> None:
        scene = shared_data / "arm_two_views"
        model, joints = scene / "med7" / "med7.urdf", scene / "joint_angles.csv"
        both = RegistrationSettings(cameras=("left", "right"))
        found = register_scene(scene, model, joints, settings=both)
        positions = encoders(joints)
        for name, reference in load_cameras(scene / "cameras.yaml").items():
            millimetres, degrees = pose_errors(found.cameras[name].X_WC, reference.X_WC)
            assert millimetres < 10.0
            assert degrees < 0.5
            ious = [
                mean_iou(scene, model, positions, one) for one in (found.cameras[name], reference)
            ]
            assert ious[0] >= ious[1]
        assert not any(one.contradictions for one in found.registered.values())

    def test_a_tool_that_the_model_lacks(self, shared_data: Path) -> None:
        scene = shared_data / "arm_one_view"
        model = shared_data / "arm_two_views" / "med7" / "med7.urdf"
        found = register_scene(scene, model, scene / "joint_angles.csv")
        one = found.registered["camera"]
        assert not one.contradictions
        assert not len(one.alternatives)
        # What the reference leaves: raw IoU 0.87 0.94 0.92 0.95 0.93, its README says.
        for frame, iou in zip(one.frames, (0.87, 0.94, 0.92, 0.95, 0.93), strict=True):
            assert frame.iou == pytest.approx(iou, abs=0.01)

    def test_frames_that_contradict_their_angles(self, shared_data: Path, tmp_path: Path) -> None:
        folder = shared_data / "franka_one_view"
        panda = folder / "panda" / "panda.urdf"
        scene = ArmScene(folder, panda, folder / "joint_angles.csv", {})
        result = run(scene, tmp_path / "out", "--json")
        assert result.exit_code == 0, result.output
        found = json.loads(result.stdout)
        assert found["contradictions"] == [f"{k:04d}" for k in range(2, 10)]
        assert "8 of 10 frames contradict the others and did not count: 0002-0009" in result.stderr
        assert "FEWER THAN HALF" in result.stderr
        reference = load_cameras(folder / "cameras_reference.yaml")["camera"]
        assert pose_errors(np.array(found["X_WC"]), reference.X_WC)[0] < 24.0


def registered_camera(name: str, frames: dict[str, bool]) -> RegisteredCamera:
    camera = arm_cameras()[0]
    misfits = tuple(FrameMisfit(frame, 0.0, 1.0, 1.0, agrees) for frame, agrees in frames.items())
    return RegisteredCamera(replace(camera, name=name), np.eye(6), misfits)


def test_cameras_tell_together_whose_fault_a_frame_is() -> None:
    left = registered_camera("left", {"0000": True, "0001": False, "0002": False, "0003": False})
    right = registered_camera("right", {"0000": True, "0001": False, "0002": True})
    common, alone = say_common([left, right])
    assert "frames 0001 contradict the others in all cameras" in common
    assert "joint positions are not those of the pictures" in common
    assert "frames 0002 contradict the others in camera 'left'" in alone
    assert "masks are not" in alone
    # One camera alone cannot tell.
    assert say_common([left]) == []


@pytest.mark.slow
def test_zeros_and_lengths_are_found_and_written_to_a_urdf(
    own_arm: ArmScene, tmp_path: Path
) -> None:
    """Drake poses the corrected robot at the encoders' readings as the right one at the truth."""
    header, *rows = own_arm.rows()
    column = header.index("elbow_turn")
    for row in rows:
        row[column] = str(float(row[column]) - np.radians(3.0))
    own_arm.write_rows([header, *rows])
    short, out = tmp_path / "short.urdf", tmp_path / "out"
    short.write_text(own_arm.model.read_text().replace('"0 0 0.35"', '"0 0 0.34"'))
    given = ["--zeros", "shoulder_turn", "--zeros", "elbow_turn"]
    given += ["--lengths", "shoulder", "--lengths", "turret", "--json"]
    result = run(replace(own_arm, model=short), out, *given)
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    zeros, lengths, off = summary["zeros"], summary["lengths"], 100.0 * (0.35 / 0.34 - 1.0)
    assert zeros["elbow_turn"]["value_deg"] == pytest.approx(3.0, abs=0.3)
    assert lengths["shoulder"]["value_percent"] == pytest.approx(off, abs=0.7)
    assert lengths["shoulder"]["low_percent"] < off < lengths["shoulder"]["high_percent"]
    for found, other in ((zeros["elbow_turn"], zeros["shoulder_turn"]), lengths.values()):
        assert found["significant"]
        assert not other["significant"]
    assert summary["mean_iou"] > 0.98
    one = yaml.safe_load((out / "registration.yaml").read_text())["left"]
    assert (one["zeros"], one["lengths"]) == (zeros, lengths)
    page = (out / "report.html").read_text()
    value, low, high = (lengths["shoulder"][f"{key}_percent"] for key in ("value", "low", "high"))
    row = f"<td>shoulder</td><td>{value:.3f} %</td><td>{low:.3f} to {high:.3f}</td>"
    assert f"{row}<td>significant</td>" in page
    assert "<td>elbow_turn</td><td>3." in page or "<td>elbow_turn</td><td>2.9" in page
    # What it read is the truth and three degrees less.
    zero = zeros["elbow_turn"]
    size = f"{zero['value_deg']:.2f} +- {zero['sd_deg']:.2f}"
    assert f"<td>significant: reads {size} degrees too low</td>" in page
    assert "as good as 0" in page
    # The shorter robot at the truth, its joints shifted by the lengths that were found.
    right, corrected = load_model(short), load_model(out / "short_calibrated.urdf")
    read = np.array([float(one) for one in rows[0][1:]])
    # What is not significant was held where it was.
    written = {name: one["value_deg"] for name, one in zeros.items() if one["significant"]}
    shifts = np.radians([written.get(name, 0.0) for name in header[1:]])
    longer = {k: 0.01 * one["value_percent"] for k, one in lengths.items() if one["significant"]}
    np.testing.assert_allclose(corrected.lower + shifts, right.lower)
    places = []
    for model, q in ((right, read + shifts), (corrected, read)):
        context = model.plant.CreateDefaultContext()
        model.plant.SetPositions(context, q)
        frames = {
            name: model.plant.GetBodyByName(name).EvalPoseInWorld(context).GetAsMatrix4()
            for name in ("turret", "shoulder", "roll", "hand")
        }
        places.append(frames)
    moved = {
        "shoulder": 0.2 * longer.get("turret", 0.0) * places[0]["turret"][:3, 2],
        "roll": 0.34 * longer["shoulder"] * places[0]["shoulder"][:3, 2],
    }
    np.testing.assert_allclose(places[1]["hand"][:3, :3], places[0]["hand"][:3, :3], atol=1e-9)
    shift = places[1]["hand"][:3, 3] - places[0]["hand"][:3, 3]
    np.testing.assert_allclose(shift, moved["shoulder"] + moved["roll"], atol=1e-9)


def test_too_few_frames_for_all_zeros(
    own_arm: ArmScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing is searched for first."""
    monkeypatch.setattr(CameraSearch, "register", None)
    result = run(own_arm, tmp_path / "out", "--zeros", "all", "--frame", "0000")
    assert result.exit_code == 1
    assert "more frames" in result.stderr
    assert not (tmp_path / "out").exists()


def test_that_no_picture_can_be_suggested_is_said(tiny_scene: TinyScene, tmp_path: Path) -> None:
    """An arm in a plane looks the same from two places, and is nowhere outside the box."""
    joints = write_truth(tiny_scene, tmp_path / "joints.csv")
    words = ["register", str(tiny_scene.folder), "--model", str(tiny_scene.model), "--no-overlay"]
    words += ["--joints", str(joints), "--out", str(tmp_path / "out"), "--camera", "front"]
    words += ["--keep-out", "-9,-9,-9:9,9,9"]
    refused = run_command(words)
    assert refused.exit_code == 2
    assert "--keep-out is for --suggest" in refused.stderr
    found = run_command([*words, "--suggest", "--json"])
    assert len(json.loads(found.stdout)["families"]) > 1
    assert "no picture is suggested; is --keep-out too large?" in found.stderr
