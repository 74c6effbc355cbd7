"""`drake-pose register --on LINK --target FILE`: a camera on a hand, from masks of an object."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from drake_pose.camera.files import load_camera_file
from tests.cli import run_command
from tests.jobs.registration.arm_scenes import pose_errors
from tests.jobs.registration.hand_camera import X_LC
from tests.jobs.registration.target_scenes import (
    BOX,
    BRACKET,
    CAN,
    SIX,
    TargetScene,
    damage_masks,
    write_target_scene,
)
from tests.search.arms import LINKS


def arguments(scene: TargetScene, out: Path, *more: str) -> list[str]:
    given = ["--model", str(scene.arm.model), "--joints", str(scene.arm.joints)]
    given += ["--on", "flange", "--target", str(scene.target), "--out", str(out)]
    return ["register", str(scene.arm.folder), *given, *more]


def register(scene: TargetScene, out: Path, *more: str) -> dict:
    result = run_command(arguments(scene, out, "--json", "--no-overlay", *more))
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def nearest(found: dict, X_WT: np.ndarray) -> tuple[float, float]:
    """How far the target is off, of the poses at which it looks alike the nearest [mm, deg]."""
    errors = [pose_errors(np.array(one["X_WT"]), X_WT) for one in found["target"]["families"]]
    return min(errors, key=lambda error: error[1])


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> TargetScene:
    return write_target_scene(tmp_path_factory.mktemp("bracket"), seed=1, size=(320, 240))


@pytest.mark.slow
def test_camera_and_target_are_found(bracket: TargetScene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run_command(arguments(bracket, out, "--json"))
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["warnings"] == []
    assert found["link"] == "flange"
    millimetres, degrees = pose_errors(np.array(found["X_LC"]), X_LC)
    assert millimetres < 1.0
    assert degrees < 0.1
    assert millimetres < 4.0 * np.sqrt(3.0) * found["translation_sd_mm"]
    target = found["target"]
    assert target["determined"]
    assert len(target["families"]) == 1
    millimetres, degrees = pose_errors(np.array(target["X_WT"]), bracket.X_WT)
    assert millimetres < 1.0
    assert degrees < 0.15
    assert millimetres < 4.0 * np.sqrt(3.0) * target["translation_sd_mm"]
    assert found["mean_iou"] > 0.98
    assert len(list((out / "overlay" / "wrist").iterdir())) == 8
    assert "The target stands at" in (out / "report.html").read_text()
    read = load_camera_file(out / "cameras.yaml")
    assert read.links == {"wrist": "flange"}
    np.testing.assert_allclose(read.cameras["wrist"].X_WC, found["X_LC"], atol=1e-12)
    one = yaml.safe_load((out / "registration.yaml").read_text())["wrist"]
    assert one["target"] == target


@pytest.mark.slow
@pytest.mark.parametrize(("looks", "links"), [(BRACKET, SIX), (BOX, LINKS)])
def test_two_arms_and_two_targets(looks: str, links: tuple, tmp_path: Path) -> None:
    scene = write_target_scene(tmp_path, looks, links, seed=2, size=(320, 240))
    found = register(scene, tmp_path / "out")
    millimetres, degrees = pose_errors(np.array(found["X_LC"]), X_LC)
    assert millimetres < 1.0
    assert degrees < 0.1
    # A box looks alike turned by half a turn about each of its axes.
    assert len(found["target"]["families"]) == (4 if looks == BOX else 1)
    assert len(found["families"]) == 1
    millimetres, degrees = nearest(found, scene.X_WT)
    assert millimetres < 1.0
    assert degrees < 0.2


@pytest.mark.slow
def test_damaged_masks_and_a_wrong_one(tmp_path: Path) -> None:
    scene = write_target_scene(tmp_path, BRACKET, SIX, seed=3)
    damage_masks(scene.arm.folder / "masks" / "wrist", 3, "0005.png")
    found = register(scene, tmp_path / "out")
    assert found["contradictions"] == ["0005"]
    assert any("contradict the others" in text for text in found["warnings"])
    millimetres, degrees = pose_errors(np.array(found["X_LC"]), X_LC)
    assert millimetres < 5.0
    assert degrees < 0.5
    assert millimetres < 3.0 * np.sqrt(3.0) * found["translation_sd_mm"]


@pytest.mark.slow
def test_a_round_target_leaves_its_own_turn_open_alone(tmp_path: Path) -> None:
    scene = write_target_scene(tmp_path, CAN, SIX, seed=1, size=(320, 240))
    found = register(scene, tmp_path / "out")
    millimetres, degrees = pose_errors(np.array(found["X_LC"]), X_LC)
    assert millimetres < 1.0
    assert degrees < 0.1
    target = found["target"]
    assert not target["determined"]
    assert target["rotation_sd_deg"] > 30.0
    np.testing.assert_allclose(np.abs(target["round_about"]), [[0.0, 0.0, 1.0]], atol=1e-6)
    # Upside down it looks alike, too.
    assert len(target["families"]) == 2
    axis = np.array(target["X_WT"])[:3, 2]
    assert abs(axis @ scene.X_WT[:3, 2]) > np.cos(np.radians(0.2))
    assert any("not determined" in text for text in found["warnings"])


@pytest.mark.slow
def test_zeros_beside_camera_and_target(bracket: TargetScene, tmp_path: Path) -> None:
    rows = bracket.arm.rows()
    column = rows[0].index("elbow_turn")
    arm = bracket.arm.copy(tmp_path)
    off = np.radians(2.0)
    arm.write_rows(
        [
            rows[0],
            *([*row[:column], float(row[column]) - off, *row[column + 1 :]] for row in rows[1:]),
        ]
    )
    scene = TargetScene(arm, bracket.target, bracket.X_WT)
    given = ["--zeros", "elbow_turn", "--zeros", "turret_turn"]
    found = register(scene, tmp_path / "out", *given)
    zero = found["zeros"]["elbow_turn"]
    assert zero["value_deg"] == pytest.approx(2.0, abs=0.3)
    assert zero["significant"]
    # The first joint's zero turns with the target, which stands anywhere.
    assert not found["zeros"]["turret_turn"]["determined"]
    assert any(name.startswith("target_") for name in found["zeros"]["turret_turn"]["gauge"])
    assert pose_errors(np.array(found["X_LC"]), X_LC)[0] < 2.0


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--frame", "0000", "--frame", "0001"], "are too few"),
        (["--on", "turret"], "about one axis"),
        (["--on", "paw"], "no link 'paw'"),
        (["--on", "world"], "no joint moves link 'world'"),
        (["--zeros", "target_turn_x"], "no joint 'target_turn_x'"),
    ],
)
def test_what_is_refused_before_work(
    more: list[str], said: str, bracket: TargetScene, tmp_path: Path
) -> None:
    result = run_command(arguments(bracket, tmp_path / "out", *more))
    assert result.exit_code == 1, result.output
    assert said in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()


def test_a_hand_that_turns_about_one_axis_is_refused(tmp_path: Path) -> None:
    scene = write_target_scene(tmp_path, links=SIX, seed=5, count=5, size=(320, 240), moving=5)
    result = run_command(arguments(scene, tmp_path / "out"))
    assert result.exit_code == 1
    said = " ".join(result.stderr.split())
    assert "about one axis" in said
    assert "not determined" in said
    assert not (tmp_path / "out").exists()


def test_a_target_with_joints_is_refused(bracket: TargetScene, tmp_path: Path) -> None:
    scene = TargetScene(bracket.arm, bracket.arm.model, bracket.X_WT)
    result = run_command(arguments(scene, tmp_path / "out"))
    assert result.exit_code == 1
    assert "must be rigid" in " ".join(result.stderr.split())


def test_a_target_needs_a_link(bracket: TargetScene, tmp_path: Path) -> None:
    given = [one for one in arguments(bracket, tmp_path / "out") if one not in ("--on", "flange")]
    result = run_command(given)
    assert result.exit_code == 1
    assert "--on LINK" in " ".join(result.stderr.split())


@pytest.mark.slow
def test_masks_of_another_target_are_refused(bracket: TargetScene, tmp_path: Path) -> None:
    other = tmp_path / "other.urdf"
    other.write_text(bracket.target.read_text().replace("0.05 0.08 0.12", "0.15 0.02 0.3"))
    scene = TargetScene(bracket.arm, other, bracket.X_WT)
    result = run_command(arguments(scene, tmp_path / "out", "--frame", "0000:0003"))
    assert result.exit_code == 1, result.output
    assert "Nothing was written" in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()
