"""`drake-pose register` without measured joint positions."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.camera_files import load_cameras
from drake_pose.registration.hand_eye import motion
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks.registration import pose_error
from tests.cli import assert_refused, run_command, run_json
from tests.jobs.registration.arm_scenes import JOINTS, ArmScene, pose_errors
from tests.written_files import write_mask

BASE = ("base_x", "base_y", "base_z", "base_qw", "base_qx", "base_qy", "base_qz")
PERSON = bundled_model("person").with_name("person_shape.urdf")


def register_near(
    words: Sequence[str], out: Path, name: str, true: np.ndarray, *limits: float
) -> dict[str, Any]:
    """Register a camera, and require errors below limits [mm, deg, standard deviations]."""
    told = run_json(*words)
    found = yaml.safe_load((out / "registration.yaml").read_text())[name]
    X_WC = load_cameras(out / "cameras.yaml")[name].X_WC
    np.testing.assert_allclose(X_WC, found["X_WC"], atol=1e-9)
    off = pose_error(true, X_WC)
    deviations = np.abs(off / np.sqrt(np.diag(found["covariance"]))).max()
    assert np.all(np.array([*pose_errors(X_WC, true), deviations]) < limits)
    return told


def write_free_arm(scene: ArmScene, seed: int = 7) -> None:
    """Write frames in which the whole arm moves, and a poses.csv with small errors."""
    model, rng = load_model(scene.model), np.random.default_rng(seed)
    rows = [["frame", *JOINTS, *BASE, "error", "seconds"]]
    for k in range(6):
        q = rng.uniform(-1.0, 1.0, len(JOINTS))
        X_WB = motion(np.append(rng.normal(0.0, 0.5, 3), rng.normal(0.0, 0.1, 3)))
        for name, camera in scene.cameras.items():
            path = scene.folder / "masks" / name / f"{k:04d}.png"
            write_mask(path, LabelRenderer(model, camera).mask(q, X_WB))
        turn = Rotation.from_rotvec(rng.normal(0.0, 0.01, 3)) * Rotation.from_matrix(X_WB[:3, :3])
        base = [*(X_WB[:3, 3] + rng.normal(0.0, 0.005, 3)), *turn.as_quat(scalar_first=True)]
        noisy = q + rng.normal(0.0, 0.02, len(q))
        rows.append([k, *noisy, *base, 0.02, 1.0])
    rows.append([6, *(["nan"] * (len(JOINTS) + len(BASE))), "nan", 1.0])
    scene.write_rows(rows)


@pytest.mark.slow
class TestFound:
    def test_positions_are_estimated_by_the_other_camera(self, arm_scene, out) -> None:
        true = arm_scene.cameras["left"].X_WC
        words = arm_scene.register(out, with_joints=False)
        assert register_near(words, out, "left", true, 25.0, 0.8, 4.0)["joints"] is None

    def test_moving_base_from_an_estimate(self, own_arm, out) -> None:
        write_free_arm(own_arm)
        true = own_arm.cameras["left"].X_WC
        # Without adjustment of the positions, the error would be 10 mm or more.
        found = register_near(own_arm.register(out), out, "left", true, 15.0, 0.5, 4.0)
        assert "0006" not in found["frames"]

    def test_a_recorded_person(self, shared_data: Path, out: Path) -> None:
        source = shared_data / "human_four_views"
        words = ArmScene(source, PERSON, out, {}).register(out, with_joints=False)
        true = load_cameras(source / "cameras.yaml")["cam03"].X_WC
        words += ["--camera", "cam03", "--frame", "0:19"]
        # The person is four metres away, and the surface is known to a centimetre or two.
        register_near(words, out, "cam03", true, 100.0, 2.5, 5.0)


class TestRefused:
    def test_nothing_known(self, own_arm: ArmScene, out: Path) -> None:
        own_arm.edit_cameras("right", X_WC=None)
        result = run_command(own_arm.register(out, with_joints=False))
        assert_refused(result, "neither a camera's pose nor", "X_WC of one camera", "--joints")
        assert not out.exists()

    def test_person_with_one_known_camera(self, arm_scene: ArmScene, out: Path) -> None:
        words = replace(arm_scene, model=PERSON).register(out, with_joints=False)
        assert_refused(run_command(words), "right is the only camera", "two cameras or more")

    @pytest.mark.parametrize("more", [["--zeros", "all"], ["--focal"], ["--on", "hand"]])
    def test_options_that_need_measured_positions(self, more, arm_scene, out: Path) -> None:
        words = arm_scene.register(out, with_joints=False)
        assert_refused(run_command([*words, *more]), f"{more[0]} needs measured joint positions")

    @pytest.mark.parametrize(
        ("missing", "said"), [("frame", "'left' has no mask"), ("masks", "no camera with an X_WC")]
    )
    def test_estimate_without_masks(self, missing, said, own_arm: ArmScene, out: Path) -> None:
        rows = [[*JOINTS, "error", "seconds"], [*([0.1] * 5), 0.1, 1.0]]
        own_arm.write_rows([["frame", *rows[0]], [7 if missing == "frame" else 0, *rows[1]]])
        if missing == "masks":
            shutil.rmtree(own_arm.folder / "masks" / "right")
        assert_refused(run_command(own_arm.register(out)), said)
