"""`drake-pose register` without measured joint positions."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drake_pose.body import bundled_model
from drake_pose.camera.camera_files import load_cameras
from tests.benchmarks.registration import pose_error
from tests.cli import assert_refused, run_command, run_json
from tests.jobs.registration.arm_scenes import ArmScene, pose_errors

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


@pytest.mark.slow
class TestFound:
    def test_positions_are_estimated_by_the_other_camera(self, arm_scene, out) -> None:
        true = arm_scene.cameras["left"].X_WC
        words = arm_scene.register(out, with_joints=False)
        assert register_near(words, out, "left", true, 25.0, 0.8, 4.0)["joints"] is None

    def test_a_recorded_person(self, shared_data: Path, out: Path) -> None:
        source = shared_data / "human_four_views"
        words = ArmScene(source, PERSON, out, {}).register(out, with_joints=False)
        true = load_cameras(source / "cameras.yaml")["cam03"].X_WC
        words += ["--camera", "cam03", "--frame", "0:19"]
        # The person is four metres away, and the surface is known to a centimetre or two.
        register_near(words, out, "cam03", true, 100.0, 2.5, 5.0)


class TestRefused:
    @pytest.mark.parametrize(
        ("model", "right", "more", "said"),
        [
            (None, None, [], ["neither a camera's pose nor", "X_WC of one camera", "--joints"]),
            (PERSON, [], [], ["right is the only camera", "two cameras or more"]),
            (None, [], ["--zeros", "all"], ["--zeros needs measured joint positions"]),
            (None, [], ["--focal"], ["--focal needs measured joint positions"]),
            (None, [], ["--on", "hand"], ["--on needs measured joint positions"]),
        ],
    )
    def test_what_is_not_known(
        self, model, right, more, said, own_arm: ArmScene, out: Path
    ) -> None:
        if right is None:
            own_arm.edit_cameras("right", X_WC=None)
        scene = replace(own_arm, model=model or own_arm.model)
        assert_refused(run_command([*scene.register(out, with_joints=False), *more]), *said)
        assert not out.exists()
