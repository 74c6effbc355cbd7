"""`drake-pose register`: a camera file with poses, from masks and joint positions."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from drake_pose.body import load_model
from drake_pose.camera.camera_files import load_cameras
from drake_pose.files.overlay import EXCESS_RGB, MISSING_RGB
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.positions import joint_shifts
from drake_pose.jobs.registration.register import register_scene
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.cli import Result, run_json, run_to_end
from tests.files.test_page import require_plain_page
from tests.jobs.registration.arm_scenes import pose_errors
from tests.search.arms import arm_tree


@pytest.fixture(scope="module")
def registered(arm_scene, tmp_path_factory) -> tuple[Path, dict[str, Any], Result]:
    """The camera without X_WC, registered by the command: folder, JSON, and its output."""
    out = tmp_path_factory.mktemp("registered") / "out"
    result = run_to_end(*arm_scene.register(out), "--json")
    return out, json.loads(result.stdout), result


class TestRegister:
    def test_camera_is_registered_and_the_known_one_kept(self, arm_scene, registered) -> None:
        out, found, result = registered
        # All of this arm turns with its first joint.
        (said,) = found["warnings"]
        assert "relative to the zero of joint 'turret_turn'" in said
        assert found["warning_weights"] == ["note"]
        assert result.stderr == f"drake-pose: note: {said}\n"
        # The camera file is readable for an estimate.
        written = load_scene(arm_scene.folder, load_cameras(out / "cameras.yaml")).cameras
        assert list(written) == ["left", "right"]
        true = arm_scene.cameras["left"]
        millimetres, degrees = pose_errors(written["left"].X_WC, true.X_WC)
        # The robot is two metres from a camera of 320 x 240 pixels.
        assert millimetres < min(8.0, 4.0 * np.sqrt(3.0) * found["translation_sd_mm"])
        assert degrees < min(0.2, 4.0 * np.sqrt(3.0) * found["rotation_sd_deg"])
        np.testing.assert_array_equal(written["right"].X_WC, arm_scene.cameras["right"].X_WC)
        assert (written["left"].kernel_parameters() == true.kernel_parameters()).all()

    def test_summary_and_registration_file(self, registered) -> None:
        out, found, _ = registered
        assert found == json.loads((out / "summary.json").read_text())
        assert list(found["cameras"]) == ["left"]
        for name in ("X_WC", "translation_sd_mm", "rotation_sd_deg", "modes", "mean_iou"):
            assert found[name] == found["cameras"]["left"][name]
        assert found["mean_iou"] > 0.98
        assert (found["zeros"], found["lengths"], found["outliers"]) == ({}, {}, [])
        assert list(found["frames"]) == [f"{k:04d}" for k in range(5)]
        one = yaml.safe_load((out / "registration.yaml").read_text())["left"]
        covariance = np.array(one["covariance"])
        assert one["errors"] == ["turn_x", "turn_y", "turn_z", "x", "y", "z"]
        assert (np.linalg.eigvalsh(covariance) > 0.0).all()
        turn, shift = np.sqrt(np.diag(covariance).reshape(2, 3).mean(axis=1))
        assert found["rotation_sd_deg"] == pytest.approx(np.degrees(turn))
        assert found["translation_sd_mm"] == pytest.approx(1e3 * shift)
        assert 0.0 < np.degrees(turn) < 1.5
        assert one["X_WC"] == found["X_WC"]

    def test_overlays_and_report(self, registered) -> None:
        pictures = sorted((registered[0] / "overlay" / "left").glob("*.png"))
        assert [path.stem for path in pictures] == [f"{k:04d}" for k in range(5)]
        picture = cv2.imread(str(pictures[0]))[:, :, ::-1]
        # Except for the legend, body and mask coincide.
        wrong = [(picture == rgb).all(axis=2).mean() for rgb in (MISSING_RGB, EXCESS_RGB)]
        assert max(wrong) < 0.005
        page = (registered[0] / "report.html").read_text()
        answer = require_plain_page(page, registered[1]["warnings"]).by_id["answer"]
        assert re.fullmatch("Camera left found, good to .* All 5 frames agree.", answer)
        assert page.count("data:image/jpeg;base64,") == page.count("<tr><td>000") == 5


@pytest.mark.slow
class TestRecordedArms:
    def test_two_cameras_whose_poses_are_withheld(self, shared_data: Path) -> None:
        scene = shared_data / "arm_two_views"
        model, joints = scene / "med7" / "med7.urdf", scene / "joint_angles.csv"
        both = RegistrationSettings(cameras=("left", "right"))
        found = register_scene(scene, model, joints, settings=both)
        for name, reference in load_cameras(scene / "cameras.yaml").items():
            assert np.less(pose_errors(found.cameras[name].X_WC, reference.X_WC), (10.0, 0.5)).all()
        assert not any(one.outliers for one in found.registered.values())

    def test_tool_missing_in_the_model(self, shared_data: Path) -> None:
        scene = shared_data / "arm_one_view"
        model = shared_data / "arm_two_views" / "med7" / "med7.urdf"
        one = register_scene(scene, model, scene / "joint_angles.csv").registered["camera"]
        assert not one.outliers
        assert not len(one.alternatives)
        # The reference has IoU 0.87 0.94 0.92 0.95 0.93 (its README).
        ious = [frame.iou for frame in one.frames]
        np.testing.assert_allclose(ious, (0.87, 0.94, 0.92, 0.95, 0.93), atol=0.01)


def body_poses(path: Path, q: np.ndarray) -> dict[str, np.ndarray]:
    """Return Drake's poses (4, 4) of links by name."""
    plant = load_model(path).plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    return {
        name: plant.GetBodyByName(name).EvalPoseInWorld(context).GetAsMatrix4()
        for name in ("turret", "shoulder", "hand")
    }


def test_link_scale_shifts_the_next_joint(tmp_path: Path) -> None:
    """A scale of 1.1 on 0.35 m between two joints; a link with scale 1 has no shift."""
    lengths = [SimpleNamespace(name="shoulder", value=0.1), SimpleNamespace(name="elbow", value=0)]
    shifts = joint_shifts(arm_tree(tmp_path), lengths)
    assert shifts == {"roll_turn": pytest.approx([0.0, 0.0, 0.035])}


@pytest.mark.slow
def test_offsets_and_scales_are_estimated_and_written_to_a_urdf(own_arm, tmp_path, out):
    """Drake poses the corrected robot at the readings like the true robot at the true positions."""
    rows = own_arm.add_to("elbow_turn", -np.radians(3.0))
    short = tmp_path / "short.urdf"
    short.write_text(own_arm.model.read_text().replace('"0 0 0.35"', '"0 0 0.34"'))
    given = ["--zeros", "shoulder_turn", "--zeros", "elbow_turn"]
    given += ["--lengths", "shoulder", "--lengths", "turret"]
    summary = run_json(*replace(own_arm, model=short).register(out), *given)
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
    assert "too low</td>" in (out / "report.html").read_text()
    # The shorter robot at the true positions, with joints shifted by the estimated scales.
    read = np.array([float(one) for one in rows[1][1:]])
    # Insignificant parameters are not written.
    written = {name: one["value_deg"] for name, one in zeros.items() if one["significant"]}
    shifts = np.radians([written.get(name, 0.0) for name in rows[0][1:]])
    corrected = out / "short_calibrated.urdf"
    np.testing.assert_allclose(load_model(corrected).lower + shifts, load_model(short).lower)
    right, found = body_poses(short, read + shifts), body_poses(corrected, read)
    longer = {k: 0.01 * one["value_percent"] for k, one in lengths.items() if one["significant"]}
    moved = 0.2 * longer.get("turret", 0.0) * right["turret"][:3, 2]
    moved += 0.34 * longer["shoulder"] * right["shoulder"][:3, 2]
    np.testing.assert_allclose(found["hand"][:3, :3], right["hand"][:3, :3], atol=1e-9)
    np.testing.assert_allclose(found["hand"][:3, 3], right["hand"][:3, 3] + moved, atol=1e-9)
