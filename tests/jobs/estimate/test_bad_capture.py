"""Recordings with faults: each is named, and the other frames are as good as without it."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.landmarks import landmark_positions, load_landmarks
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.camera.models import Camera, circle_of_cameras
from drake_pose.commands.main import app
from drake_pose.jobs.estimate.person import (
    describe_camera,
    describe_fit,
    describe_rig,
    describe_views,
)
from drake_pose.person.camera_faults import CameraFault, CameraMotion
from drake_pose.person.figures import RigFault
from drake_pose.person.persons_in_view import ViewFaults
from drake_pose.silhouette.pictures.masks import write_mask
from tests.cli import CliRunner
from tests.jobs.scenes import read_rows
from tests.person.persons_in_view import see, stepping

FRAMES = 8
Masks = dict[str, list[np.ndarray]]


@dataclass(frozen=True)
class Walk:
    """A person who steps through the picture: what four cameras see, and the truth."""

    person: ArticulatedModel
    cameras: Mapping[str, Camera]
    masks: Masks
    truth: np.ndarray

    def errors_mm(self, out: Path) -> np.ndarray:
        """The mean error of the joint centres in each frame; nan where there is no pose."""
        landmarks = load_landmarks(self.person.path)
        errors = []
        for row, q in zip(read_rows(out / "poses.csv"), self.truth, strict=True):
            found = np.array([float(row[name] or "nan") for name in self.person.position_names])
            if not np.isfinite(found).all():
                errors.append(np.nan)
                continue
            places = [landmark_positions(self.person, landmarks, one) for one in (found, q)]
            errors.append(1e3 * np.linalg.norm(places[0] - places[1], axis=1).mean())
        return np.array(errors)


@pytest.fixture(scope="module")
def walk() -> Walk:
    person = load_model(bundled_model("person"), check=False)
    cameras = circle_of_cameras(4, size=(160, 120), face_camera=False)
    truth = np.array([stepping(person, 0.15 * k, -0.2 + 0.04 * k, 0.1) for k in range(FRAMES)])
    masks = {name: draw(person, camera, truth) for name, camera in cameras.items()}
    return Walk(person, cameras, masks, truth)


def draw(person: ArticulatedModel, camera: Camera, poses: np.ndarray) -> list[np.ndarray]:
    return [own[camera.name] for own in see(person, {camera.name: camera}, poses)]


def write(folder: Path, walk: Walk, masks: Masks) -> Path:
    folder.mkdir()
    save_cameras(folder / "cameras.yaml", walk.cameras)
    (folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
    for name, pictures in masks.items():
        (folder / "masks" / name).mkdir(parents=True)
        for k, picture in enumerate(pictures):
            write_mask(folder / "masks" / name / f"{k:04d}.png", picture)
    return folder


def capture(runner: CliRunner, walk: Walk, scene: Path, out: Path) -> list[str]:
    """Captures on the command line; returns the warnings, which are the summary's, too."""
    given = ["capture", str(scene), "--model", str(walk.person.path), "--out", str(out)]
    result = runner.invoke(app, [*given, "--no-replay", "--no-overlay"])
    assert result.exit_code == 0, result.output
    warnings = json.loads((out / "summary.json").read_text())["warnings"]
    for text in warnings:
        assert f"warning: {text}" in result.stderr
    return warnings


def spoil(scene: Path) -> None:
    """All faults at once that cost a camera no more than some frames."""
    masks = scene / "masks"
    shutil.copytree(masks / "camera_0", masks / "camera_7")
    (masks / "camera_1" / "0001.png").write_bytes(b"no picture")
    (masks / "camera_3" / "0002.png").unlink()
    shutil.copy(masks / "camera_0" / "0003.png", masks / "camera_0" / "0004.png")
    (masks / "camera_2" / "0005.png").rename(masks / "camera_2" / "5.png")
    shutil.copy(masks / "camera_3" / "0006.png", masks / "camera_3" / "06.png")
    (masks / "camera_3" / "._0001.png").write_bytes(b"what macOS leaves")
    (masks / "camera_3" / "Thumbs.db").write_bytes(b"what Windows leaves")
    cameras = load_cameras(scene / "cameras.yaml")
    cameras["camera_8"] = replace(cameras["camera_0"], name="camera_8")
    save_cameras(scene / "cameras.yaml", cameras)


def test_each_fault_of_the_files_is_named_and_costs_only_itself(
    walk: Walk, runner: CliRunner, tmp_path: Path
) -> None:
    masks = {name: list(pictures) for name, pictures in walk.masks.items()}
    masks["camera_2"][6] = np.zeros_like(masks["camera_2"][6])
    scene = write(tmp_path / "scene", walk, masks)
    spoil(scene)
    out = tmp_path / "out"
    warnings = capture(runner, walk, scene, out)
    expected = [
        ("camera_7", "no camera", "8 masks"),
        ("camera_8", "no masks"),
        ("0001", "camera_1", "not a PNG"),
        ("camera_3", "7 of 8 frames", "0002"),
        ("camera_0", "again in frame 0004"),
        ("camera_3", "0006.png is used", "06.png"),
        ("camera_3", "Thumbs.db"),
        ("camera_2", "nobody in frame 0006"),
    ]
    for parts in expected:
        assert [text for text in warnings if all(part in text for part in parts)], parts
    assert len(warnings) == len(expected), warnings
    frames = json.loads((out / "summary.json").read_text())["frames"]
    assert "camera_1" not in frames["0001"]["ious"]
    assert "camera_2" in frames["0005"]["ious"]
    assert walk.errors_mm(out).max() < 20.0


def test_nobody_in_view_and_back_elsewhere(walk: Walk, runner: CliRunner, tmp_path: Path) -> None:
    """First nobody, then the person, whom one camera alone sees for a while; then elsewhere."""
    truth = walk.truth.copy()
    truth[6:] = [stepping(walk.person, 2.0 + 0.1 * k, 0.4, -0.4) for k in range(FRAMES - 6)]
    masks = {name: draw(walk.person, camera, truth) for name, camera in walk.cameras.items()}
    for name, pictures in masks.items():
        for k in (0, 4, 5):
            if k != 4 or name != "camera_1":
                pictures[k] = np.zeros_like(pictures[k])
    scene = write(tmp_path / "scene", walk, masks)
    out = tmp_path / "out"
    warnings = capture(runner, walk, scene, out)
    assert "frame 0000, 0004-0005: fewer than two cameras see the person" in warnings[0]
    errors = replace(walk, truth=truth).errors_mm(out)
    np.testing.assert_array_equal(np.isnan(errors), [k in (0, 4, 5) for k in range(FRAMES)])
    assert np.nanmax(errors) < 20.0


@pytest.mark.slow
def test_camera_that_moved_in_the_middle(walk: Walk, runner: CliRunner, tmp_path: Path) -> None:
    camera = walk.cameras["camera_2"]
    X_WC = camera.X_WC.copy()
    X_WC[:3, :3] = Rotation.from_euler("z", 4, degrees=True).as_matrix() @ X_WC[:3, :3]
    since = 4
    seen = draw(walk.person, camera.with_pose(X_WC), walk.truth)
    masks = {name: list(pictures) for name, pictures in walk.masks.items()}
    masks["camera_2"][since:] = seen[since:]
    scene = write(tmp_path / "scene", walk, masks)
    out = tmp_path / "out"
    (text,) = capture(runner, walk, scene, out)
    assert text.startswith("camera 'camera_2' has moved since frame 0004")
    # What is 4 degrees in a picture is known without the person.
    pixels = camera.kernel_parameters()[1] * np.tan(np.radians(4.0))
    assert float(text.split(" pixels off")[0].split()[-1]) == pytest.approx(pixels, abs=1.5)
    frames = json.loads((out / "summary.json").read_text())["frames"]
    assert ["camera_2" in frames[f"{k:04d}"]["ious"] for k in range(FRAMES)] == [
        k < since for k in range(FRAMES)
    ]
    assert walk.errors_mm(out).max() < 20.0


def mirrored(cameras: dict) -> None:
    X = np.array(cameras["camera_2"]["X_WC"])
    cameras["camera_2"]["X_WC"] = (X * [-1, 1, 1, 1]).tolist()


def in_millimetres(cameras: dict) -> None:
    for camera in cameras.values():
        X = np.array(camera["X_WC"]) * [1.0, 1.0, 1.0, 1000.0]
        camera["X_WC"] = [*X[:3].tolist(), [0.0, 0.0, 0.0, 1.0]]


def halved(cameras: dict) -> None:
    for camera in cameras.values():
        camera |= {"focal_x": camera["focal_x"] / 2.0, "focal_y": camera["focal_y"] / 2.0}


def swapped(cameras: dict) -> None:
    for camera in cameras.values():
        camera |= {"width": camera["height"], "height": camera["width"]}


def alone(cameras: dict) -> None:
    for name in ("camera_0", "camera_2", "camera_3"):
        del cameras[name]


LACKS = "cameras.yaml lacks camera_0, camera_2, camera_3"
COLOURS = np.dstack([np.tile(np.arange(160, dtype=np.uint8), (120, 1)), *np.zeros((2, 120, 160))])


@pytest.mark.parametrize(
    ("spoiled", "parts"),
    [
        (mirrored, ("camera 'camera_2'", "reflection")),
        (in_millimetres, ("X_WC", "metres")),
        (halved, ("a person 3.", "m tall", "focal lengths")),
        (swapped, ("none of", "160 x 120", "120 x 160")),
        (alone, ("masks are there of camera_1 alone", LACKS)),
        (lambda mask: 0 * mask, ("in none of 2 frames two cameras see a person",)),
        (lambda mask: 255 - mask, ("white before a black background",)),
        (lambda _: COLOURS, ("none of 8 masks", "two")),
    ],
)
def test_recordings_that_cannot_be_right_are_refused(
    spoiled, parts, walk: Walk, runner: CliRunner, tmp_path: Path
) -> None:
    scene = write(tmp_path / "scene", walk, {n: own[:2] for n, own in walk.masks.items()})
    if spoiled.__name__ != "<lambda>":
        cameras = yaml.safe_load((scene / "cameras.yaml").read_text())
        spoiled(cameras)
        (scene / "cameras.yaml").write_text(yaml.safe_dump(cameras))
    else:
        for file in scene.glob("masks/*/*.png"):
            cv2.imwrite(str(file), spoiled(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)))
    given = ["--model", str(walk.person.path), "--out", str(tmp_path / "out")]
    result = runner.invoke(app, ["capture", str(scene), *given])
    assert result.exit_code == 1
    for part in parts:
        assert part in result.stderr


NAMED = ("0", "1", "2", "3")


def test_who_was_in_view():
    views = ViewFaults((3,), {"a": (1,)}, {"a": (0, 1), "b": (1,)}, {"b": (1,)})
    nobody, blind, others = describe_views(views, NAMED)
    assert nobody.startswith("frame 3: fewer than two cameras")
    assert "camera 'a' sees nobody in frame 1" in blind
    assert "frame 0-1: somebody else is in view of cameras 'a' and 'b'" in others
    assert "in camera 'b' both are one silhouette (frame 1)" in others


@pytest.mark.parametrize(
    ("mirrored", "exchanged", "what"),
    [
        (("a",), (), "until the masks of camera 'a' are mirrored"),
        ((), ("a", "b"), "until the masks of cameras 'a' and 'b' are exchanged"),
        ((), (), "are cameras.yaml, the folders' names or the masks wrong?"),
    ],
)
def test_a_rig_at_fault(mirrored, exchanged, what):
    (warning,) = describe_rig(RigFault(mirrored, exchanged, {"a": 0.6, "b": 0.8}))
    assert what in warning
    assert "60 % of camera 'a'" in warning


def test_a_camera_that_moved_or_contradicts():
    motion = CameraMotion(np.eye(4), np.array([3.0, -4.0]), 5.0, 0.07, 0.1, 0.5, 0.9)
    moved = CameraFault("a", motion, True, (), 0.95, 2, True)
    unclear = CameraFault("a", motion, False, ("b",), 0.95)
    first, second = (describe_camera(one, NAMED) for one in (moved, unclear))
    assert first.startswith("camera 'a' has moved since frame 2 after it was calibrated")
    assert "5.0 pixels off in its pictures (3.0 to the right, 4.0 up" in first
    assert "left out since frame 2" in first
    assert second.startswith("camera 'a' or 'b' contradicts the others: 50 % of its")
    assert "used all the same" in second


def test_who_fits_badly():
    assert describe_fit([0.0, 0.9, 0.7]) == ()
    (warning,) = describe_fit([0.0, 0.5, 0.7, 0.3])
    assert "only 50 % of the contours fit" in warning
