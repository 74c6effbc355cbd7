"""`drake-pose register --on LINK`: a camera on a hand, from masks of the base or of a --target."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drake_pose.camera.camera_files import load_camera_file, load_cameras
from drake_pose.errors import CameraError
from drake_pose.silhouette.pictures.masks import intersection_over_union, read_mask
from tests.cli import assert_refused, run_command, run_json
from tests.jobs.registration.arm_scenes import ArmScene, pose_errors
from tests.jobs.registration.hand_scenes import (
    BOX,
    BRACKET,
    SIX,
    X_LC,
    TargetScene,
    paint_pictures,
    write_hand_scene,
)


def require_near(found: dict[str, Any], millimetres: float, degrees: float) -> None:
    """Require a camera pose within limits and within four of its standard deviations."""
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


def test_the_camera_is_found_on_its_link(own_base: ArmScene, out: Path) -> None:
    found = run_json(*own_base.register(out), "--on", "flange")
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
    # The camera's pose in the world differs between frames, so load_cameras refuses the file.
    with pytest.raises(CameraError, match="'wrist' rides on link 'flange' of a robot"):
        load_cameras(out / "cameras.yaml")


@pytest.mark.slow
@pytest.mark.parametrize(("looks", "alike"), [(BRACKET, 1), (BOX, 4)])
def test_camera_and_target_are_found(looks, alike, tmp_path, out):
    """A box looks the same after half a turn about each of its axes."""
    scene = write_hand_scene(tmp_path, looks, SIX, seed=2)
    found = run_json(*scene.register(out))
    require_near(found, 1.0, 0.1)
    target = found["target"]
    assert target["determined"]
    assert (len(found["modes"]), len(target["modes"])) == (1, alike)
    errors = [pose_errors(np.array(one["X_WT"]), scene.X_WT) for one in target["modes"]]
    millimetres, degrees = min(errors, key=lambda error: error[1])
    assert millimetres < min(1.0, 4.0 * np.sqrt(3.0) * target["translation_sd_mm"])
    assert degrees < 0.2
    assert found["mean_iou"] > 0.98
    assert "Target in the robot&#39;s world" in (out / "report.html").read_text()
    assert yaml.safe_load((out / "registration.yaml").read_text())["wrist"]["target"] == target


@pytest.mark.slow
def test_pictures_of_a_target_are_segmented(tmp_path: Path, out: Path) -> None:
    scene = write_hand_scene(tmp_path, BRACKET, seed=4)
    masks = sorted((scene.arm.folder / "masks" / "wrist").glob("*.png"))
    drawn = {path.name: read_mask(path) for path in masks}
    paint_pictures(scene.arm.folder)
    found = run_json(*scene.register(out))
    require_near(found, 2.0, 0.2)
    poses = [np.array(one["X_WT"]) for one in found["target"]["modes"]]
    assert min(pose_errors(X, scene.X_WT)[0] for X in poses) < 2.0
    assert (found["masks"], found["outliers"]) == ("found", [])
    # The result is a scene of masks like Drake's, except for the noise of the pictures.
    for name, mask in drawn.items():
        assert intersection_over_union(read_mask(out / "masks" / "wrist" / name), mask) > 0.97
    again = replace(scene, arm=replace(scene.arm, folder=out, joints=out / "joint_angles.csv"))
    require_near(run_json(*again.register(tmp_path / "again")), 2.0, 0.2)


@pytest.mark.parametrize(
    ("seen", "more", "said"),
    [
        ("base", "--on paw", "no link 'paw'"),
        ("base", "--on base", "no joint moves link 'base'"),
        ("base", "--on hand --lengths paw", "no link with a length 'paw'"),
        ("target", "--frame 0000 --frame 0001", "are too few"),
        ("target", "--on turret", "about one axis"),
        ("target", "--on paw", "no link 'paw'"),
        ("target", "--on world", "no joint moves link 'world'"),
        ("target", "--zeros target_turn_x", "no joint 'target_turn_x'"),
    ],
)
def test_wrong_names_and_too_few_frames_are_refused(seen, more, said, own_base, bracket, out):
    words = own_base.register(out) if seen == "base" else bracket.register(out)
    assert_refused(run_command([*words, *more.split()]), said)
    assert not out.exists()


def test_other_bases_hands_and_targets_are_refused(bracket, arm_scene, tmp_path, out):
    stiff = write_hand_scene(tmp_path, links=SIX, seed=5, count=5, moving=5)
    jointed = replace(bracket, target=bracket.arm.model)
    for words, parts in (
        ([*arm_scene.register(out), "--on", "hand"], ["no visible link stands still"]),
        (stiff.register(out), ["about one axis", "do not determine"]),
        (jointed.register(out), ["must be rigid"]),
        ([*bracket.arm.register(out), "--target", str(bracket.target)], ["--on LINK"]),
    ):
        assert_refused(run_command(words), *parts)
        assert not out.exists()
