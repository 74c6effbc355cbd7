"""`drake-pose register --on LINK`: a camera on a hand, from masks of the base or of a --target."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drake_pose.body.model import load_model
from drake_pose.camera.camera_files import load_camera_file, load_cameras
from drake_pose.errors import CameraError
from drake_pose.silhouette.pictures.masks import intersection_over_union, read_mask
from tests.cli import run_command
from tests.jobs.estimate.test_bad_input import assert_refused
from tests.jobs.registration.arm_scenes import ArmScene, pose_errors
from tests.jobs.registration.hand_scenes import (
    BOX,
    BRACKET,
    CAN,
    SIX,
    X_LC,
    TargetScene,
    damage_masks,
    paint_pictures,
    write_hand_scene,
)
from tests.search.arms import LINKS


def arguments(arm: ArmScene, out: Path, *more: str) -> list[str]:
    given = ["--model", str(arm.model), "--joints", str(arm.joints), "--out", str(out)]
    return ["register", str(arm.folder), *given, *more]


def of_target(scene: TargetScene, out: Path, *more: str) -> list[str]:
    return arguments(scene.arm, out, "--on", "flange", "--target", str(scene.target), *more)


def register(words: list[str]) -> dict[str, Any]:
    result = run_command([*words, "--json"])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def require_near(found: dict[str, Any], millimetres: float, degrees: float) -> None:
    """The camera is off by less, and by no more than four of its standard deviations."""
    off = pose_errors(np.array(found["X_LC"]), X_LC)
    assert off[0] < millimetres
    assert off[1] < degrees
    assert off[0] < 4.0 * np.sqrt(3.0) * found["translation_sd_mm"]


@pytest.fixture(scope="module")
def own_base(tmp_path_factory: pytest.TempPathFactory) -> ArmScene:
    return write_hand_scene(tmp_path_factory.mktemp("hand"), looks=None, count=6, seed=3).arm


@pytest.fixture(scope="module")
def bracket(tmp_path_factory: pytest.TempPathFactory) -> TargetScene:
    return write_hand_scene(tmp_path_factory.mktemp("bracket"), seed=1)


def test_the_camera_is_found_on_its_link(own_base: ArmScene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    found = register(arguments(own_base, out, "--on", "flange"))
    assert found["warnings"] == []
    assert found["link"] == "flange"
    assert "X_WC" not in found
    require_near(found, 1.5, 0.15)
    assert found["mean_iou"] > 0.98
    assert len(list((out / "overlay" / "wrist").iterdir())) == 6
    assert "wrist" in (out / "report.html").read_text()
    read = load_camera_file(out / "cameras.yaml")
    assert (read.links, read.unplaced) == ({"wrist": "flange"}, ())
    np.testing.assert_allclose(read.cameras["wrist"].X_WC, found["X_LC"], atol=1e-12)
    assert yaml.safe_load((out / "registration.yaml").read_text())["wrist"]["link"] == "flange"
    # It stands elsewhere in each frame: who needs cameras that stand still says so.
    with pytest.raises(CameraError, match="'wrist' rides on link 'flange' of a robot"):
        load_cameras(out / "cameras.yaml")


@pytest.mark.slow
def test_lengths_between_the_base_and_the_camera(own_base: ArmScene, tmp_path: Path) -> None:
    right, short = own_base.model.read_text(), tmp_path / "short.urdf"
    assert right.count('"0 0 0.35"') == 1
    short.write_text(right.replace('"0 0 0.35"', '"0 0 0.34"'))
    given = ["--on", "flange", "--lengths", "shoulder", "--lengths", "elbow"]
    found = register(arguments(replace(own_base, model=short), tmp_path / "out", *given))
    off, one = 100.0 * (0.35 / 0.34 - 1.0), found["lengths"]["shoulder"]
    assert one["low_percent"] < off < one["high_percent"]
    assert one["value_percent"] == pytest.approx(off, abs=1.0)
    assert one["significant"]
    assert not found["lengths"]["elbow"]["significant"]
    require_near(found, 3.0, 0.3)
    # Drake has the joint that the link carries where the right arm has it, but for what is left.
    places = []
    for path in (own_base.model, tmp_path / "out" / "short_calibrated.urdf"):
        joint = load_model(path, check=False).plant.GetJointByName("roll_turn")
        places.append(joint.frame_on_parent().GetFixedPoseInBodyFrame().translation()[2])
    assert places[1] - places[0] == pytest.approx(0.34e-2 * (one["value_percent"] - off), abs=1e-9)


@pytest.mark.slow
def test_lengths_that_no_picture_tells_apart(own_base: ArmScene, tmp_path: Path) -> None:
    # Shoulder and roll are in line, and neither is seen: only their sum is told.
    given = ["--on", "flange", "--lengths", "shoulder", "--lengths", "roll"]
    lengths = register(arguments(own_base, tmp_path / "out", *given))["lengths"]
    assert not lengths["shoulder"]["determined"]
    assert lengths["shoulder"]["gauge"] == ["length of roll"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("looks", "links", "alike"), [(BRACKET, LINKS, 1), (BRACKET, SIX, 1), (BOX, LINKS, 4)]
)
def test_camera_and_target_are_found(looks: str, links: tuple, alike: int, tmp_path: Path) -> None:
    """A box looks alike turned by half a turn about each of its axes."""
    scene, out = write_hand_scene(tmp_path, looks, links, seed=2), tmp_path / "out"
    found = register(of_target(scene, out))
    require_near(found, 1.0, 0.1)
    target = found["target"]
    assert target["determined"]
    assert (len(found["families"]), len(target["families"])) == (1, alike)
    errors = [pose_errors(np.array(one["X_WT"]), scene.X_WT) for one in target["families"]]
    millimetres, degrees = min(errors, key=lambda error: error[1])
    assert millimetres < 1.0
    assert degrees < 0.2
    assert millimetres < 4.0 * np.sqrt(3.0) * target["translation_sd_mm"]
    assert found["mean_iou"] > 0.98
    assert "The target stands at" in (out / "report.html").read_text()
    assert yaml.safe_load((out / "registration.yaml").read_text())["wrist"]["target"] == target


@pytest.mark.slow
def test_damaged_masks_and_a_wrong_one(tmp_path: Path) -> None:
    scene = write_hand_scene(tmp_path, BRACKET, SIX, seed=3, width=640)
    damage_masks(scene.arm.folder / "masks" / "wrist", 3, "0005.png")
    found = register(of_target(scene, tmp_path / "out", "--no-overlay"))
    assert found["contradictions"] == ["0005"]
    assert any("contradict the others" in text for text in found["warnings"])
    require_near(found, 5.0, 0.5)


@pytest.mark.slow
def test_a_round_target_leaves_its_own_turn_open_alone(tmp_path: Path) -> None:
    scene = write_hand_scene(tmp_path, CAN, SIX, seed=1)
    found = register(of_target(scene, tmp_path / "out", "--no-overlay"))
    require_near(found, 1.0, 0.1)
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
@pytest.mark.parametrize("looks", [BRACKET, BOX])
def test_pictures_are_enough_of_a_target(looks: str, tmp_path: Path) -> None:
    scene = write_hand_scene(tmp_path, looks, seed=4)
    masks = sorted((scene.arm.folder / "masks" / "wrist").glob("*.png"))
    drawn = {path.name: read_mask(path) for path in masks}
    paint_pictures(scene.arm.folder)
    found = register(of_target(scene, tmp_path / "out"))
    require_near(found, 2.0, 0.2)
    poses = [np.array(one["X_WT"]) for one in found["target"]["families"]]
    assert min(pose_errors(X, scene.X_WT)[0] for X in poses) < 2.0
    assert (found["masks"], found["contradictions"]) == ("found", [])
    # The result is a scene of the masks, as Drake has drawn them but for the noise of the pictures.
    for name, mask in drawn.items():
        own = read_mask(tmp_path / "out" / "masks" / "wrist" / name)
        assert intersection_over_union(own, mask) > 0.97
    arm = replace(scene.arm, folder=tmp_path / "out", joints=tmp_path / "out" / "joint_angles.csv")
    require_near(register(of_target(replace(scene, arm=arm), tmp_path / "again")), 2.0, 0.2)


@pytest.mark.slow
def test_pictures_that_do_not_show_the_target_are_refused(tmp_path: Path) -> None:
    scene = write_hand_scene(tmp_path, BOX, seed=4)
    paint_pictures(scene.arm.folder)
    other = replace(scene, target=tmp_path / "can.urdf")
    text = scene.target.read_text().replace(BOX, CAN)
    other.target.write_text(text)
    said = "no pose of the target explains its pictures"
    assert_refused(run_command(of_target(other, tmp_path / "out")), f"camera 'wrist': {said}")
    assert not (tmp_path / "out").exists()
    rows = scene.arm.joints.read_text().splitlines()
    numbers = [row.split(",", 1) for row in rows[1:]]
    # Each frame has the joints of the one three after it.
    moved = [f"{numbers[k][0]},{numbers[k - 3][1]}" for k in range(len(numbers))]
    scene.arm.joints.write_text("\n".join([rows[0], *moved]))
    assert_refused(run_command(of_target(scene, tmp_path / "out")), "camera 'wrist'")


@pytest.mark.slow
def test_zeros_beside_camera_and_target(bracket: TargetScene, tmp_path: Path) -> None:
    arm = bracket.arm.copy(tmp_path)
    header, *rows = bracket.arm.rows()
    column = header.index("elbow_turn")
    for row in rows:
        row[column] = str(float(row[column]) - np.radians(2.0))
    arm.write_rows([header, *rows])
    given = ["--zeros", "elbow_turn", "--zeros", "turret_turn"]
    found = register(of_target(replace(bracket, arm=arm), tmp_path / "out", *given))
    assert found["zeros"]["elbow_turn"]["value_deg"] == pytest.approx(2.0, abs=0.3)
    assert found["zeros"]["elbow_turn"]["significant"]
    # The first joint's zero turns with the target, which stands anywhere.
    assert not found["zeros"]["turret_turn"]["determined"]
    assert any(name.startswith("target_") for name in found["zeros"]["turret_turn"]["gauge"])
    require_near(found, 2.0, 0.3)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--on", "paw"], "no link 'paw'"),
        (["--on", "base"], "no joint moves link 'base'"),
        (["--on", "hand", "--lengths", "paw"], "no link with a length 'paw'"),
    ],
)
def test_what_is_refused_before_work(
    more: list[str], said: str, own_base: ArmScene, tmp_path: Path
) -> None:
    assert_refused(run_command(arguments(own_base, tmp_path / "out", *more)), said)
    assert not (tmp_path / "out").exists()


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
def test_what_is_refused_of_a_target(
    more: list[str], said: str, bracket: TargetScene, tmp_path: Path
) -> None:
    assert_refused(run_command(of_target(bracket, tmp_path / "out", *more)), said)
    assert not (tmp_path / "out").exists()


def test_other_bases_hands_and_targets_are_refused(
    bracket: TargetScene, arm_scene: ArmScene, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    stiff = write_hand_scene(tmp_path, links=SIX, seed=5, count=5, moving=5)
    jointed = replace(bracket, target=bracket.arm.model)
    for words, parts in (
        (arguments(arm_scene, out, "--on", "hand"), ["no link that is seen stands still"]),
        (of_target(stiff, out), ["about one axis", "not determined"]),
        (of_target(jointed, out), ["must be rigid"]),
        (arguments(bracket.arm, out, "--target", str(bracket.target)), ["--on LINK"]),
    ):
        assert_refused(run_command(words), *parts)
        assert not out.exists()


@pytest.mark.slow
def test_masks_of_another_target_are_refused(bracket: TargetScene, tmp_path: Path) -> None:
    other = tmp_path / "other.urdf"
    other.write_text(bracket.target.read_text().replace("0.05 0.08 0.12", "0.15 0.02 0.3"))
    words = of_target(replace(bracket, target=other), tmp_path / "out", "--frame", "0000:0003")
    assert_refused(run_command(words), "Nothing was written")
    assert not (tmp_path / "out").exists()


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
