"""Recordings with faults: each fault is named, and other frames do not suffer."""

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import Camera, circle_of_cameras
from tests.cli import run_to_end
from tests.jobs.scenes import read_rows
from tests.person.persons_in_view import see, stepping
from tests.written_files import write_mask

FRAMES = 8
PLACE = tuple(f"position_{axis}" for axis in "xyz")


@dataclass(frozen=True)
class Walk:
    """A person who walks through the view of four cameras: masks and true positions."""

    person: ArticulatedModel
    cameras: Mapping[str, Camera]
    masks: list[dict[str, np.ndarray]]
    truth: np.ndarray

    def write(self, folder: Path) -> Path:
        """Write the masks as a scene and return its folder."""
        (folder / "masks").mkdir(parents=True)
        save_cameras(folder / "cameras.yaml", self.cameras)
        (folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
        for k, own in enumerate(self.masks):
            for name, picture in own.items():
                (folder / "masks" / name).mkdir(parents=True, exist_ok=True)
                write_mask(folder / "masks" / name / f"{k:04d}.png", picture)
        return folder

    def capture(self, scene: Path, out: Path) -> tuple[list[str], np.ndarray]:
        """Run capture; return the summary's warnings and the largest errors (frames,) [m]."""
        given = ["--model", self.person.path, "--out", out, "--no-replay", "--no-overlay"]
        result = run_to_end("capture", scene, *given)
        warnings = json.loads((out / "summary.json").read_text())["warnings"]
        for text in warnings:
            assert text in result.stderr
        rows = read_rows(out / "poses.csv")
        found = np.array([[float(row[name] or "nan") for name in PLACE] for row in rows])
        places = [self.person.position_index(name) for name in PLACE]
        return warnings, np.abs(found - self.truth[:, places]).max(axis=1)


@pytest.fixture(scope="module")
def walk():
    person = load_model(bundled_model("person"), check=False)
    cameras = circle_of_cameras(4, size=(160, 120), face_camera=False)
    truth = np.array([stepping(person, 0.15 * k, -0.2 + 0.04 * k, 0.1) for k in range(FRAMES)])
    return Walk(person, cameras, see(person, cameras, truth), truth)


def test_each_damaged_file_is_named_and_others_are_used(walk, tmp_path, out):
    scene = walk.write(tmp_path / "scene")
    masks = scene / "masks"
    shutil.copytree(masks / "camera_0", masks / "camera_7")
    (masks / "camera_1" / "0001.png").write_bytes(b"no picture")
    write_mask(masks / "camera_2" / "0006.png", np.zeros((120, 160), bool))
    (masks / "camera_3" / "0002.png").unlink()
    (masks / "camera_3" / "Thumbs.db").write_bytes(b"what Windows leaves")
    warnings, off = walk.capture(scene, out)
    expected = [
        ("camera_7", "no camera", "8 masks"),
        ("0001", "camera_1", "not a PNG"),
        ("camera_2", "no person in frame 0006"),
        ("camera_3", "7 of 8 frames", "0002"),
        ("camera_3", "Thumbs.db"),
    ]
    for parts in expected:
        assert [text for text in warnings if all(part in text for part in parts)], parts
    assert len(warnings) == len(expected), warnings
    frames = json.loads((out / "summary.json").read_text())["frames"]
    assert "camera_1" not in frames["0001"]["ious"]
    assert off.max() < 0.03


def test_a_person_who_leaves_and_returns_elsewhere_is_found_again(walk, tmp_path, out):
    """First nobody, then a person, for a while before one camera only, then elsewhere."""
    truth = walk.truth.copy()
    truth[6:] = [stepping(walk.person, 2.0 + 0.1 * k, 0.4, -0.4) for k in range(FRAMES - 6)]
    masks = see(walk.person, walk.cameras, truth)
    for k in (0, 4, 5):
        for name in masks[k]:
            if k != 4 or name != "camera_1":
                masks[k][name] = np.zeros_like(masks[k][name])
    other = replace(walk, masks=masks, truth=truth)
    warnings, off = other.capture(other.write(tmp_path / "scene"), out)
    assert "frame 0000, 0004-0005: fewer than two cameras see the person" in warnings[0]
    np.testing.assert_array_equal(np.isnan(off), [k in (0, 4, 5) for k in range(FRAMES)])
    assert np.nanmax(off) < 0.03


def changed(**functions: object) -> Callable[[dict], None]:
    """Change fields of all cameras."""

    def spoil(cameras: dict) -> None:
        for camera in cameras.values():
            camera |= {name: change(camera) for name, change in functions.items()}

    return spoil


def mirrored(cameras: dict) -> None:
    X = np.array(cameras["camera_2"]["X_WC"])
    cameras["camera_2"]["X_WC"] = (X * [-1, 1, 1, 1]).tolist()


def alone(cameras: dict) -> None:
    for name in ("camera_0", "camera_2", "camera_3"):
        del cameras[name]


def in_millimetres(camera: dict) -> list:
    X = np.array(camera["X_WC"])
    X[:3, 3] *= 1e3
    return X.tolist()


halved = changed(focal_x=lambda one: one["focal_x"] / 2, focal_y=lambda one: one["focal_y"] / 2)
LACKS = "cameras.yaml lacks camera_0, camera_2, camera_3"
COLOURS = np.dstack([np.tile(np.arange(160, dtype=np.uint8), (120, 1)), *np.zeros((2, 120, 160))])


@pytest.mark.parametrize(
    ("spoiled", "parts"),
    [
        (mirrored, ("camera 'camera_2'", "reflection")),
        (changed(X_WC=in_millimetres), ("X_WC", "metres")),
        (halved, ("a person 3.", "m tall", "focal lengths")),
        (changed(width=lambda _: 120, height=lambda _: 160), ("none of", "160 x 120", "120 x 160")),
        (alone, ("masks exist only for camera_1", LACKS)),
        (lambda mask: 0 * mask, ("two cameras see no person in any of 2 frames",)),
        (lambda mask: 255 - mask, ("white before a black background",)),
        (lambda _: COLOURS, ("none of 8 masks", "two")),
    ],
)
def test_recordings_with_impossible_cameras_are_refused(spoiled, parts, walk, tmp_path, out):
    scene = replace(walk, masks=walk.masks[:2]).write(tmp_path / "scene")
    if spoiled.__name__ != "<lambda>":
        cameras = yaml.safe_load((scene / "cameras.yaml").read_text())
        spoiled(cameras)
        (scene / "cameras.yaml").write_text(yaml.safe_dump(cameras))
    else:
        for file in scene.glob("masks/*/*.png"):
            cv2.imwrite(str(file), spoiled(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)))
    result = run_to_end("capture", scene, "--model", walk.person.path, "--out", out, status=1)
    for part in parts:
        assert part in result.stderr
