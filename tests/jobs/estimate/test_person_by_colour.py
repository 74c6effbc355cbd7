"""Tracking of a person by colour in pictures without masks, painted over Drake's label images."""

import shutil

import cv2
import numpy as np
import pytest

from drake_pose.body import bundled_model
from drake_pose.camera.camera_files import load_cameras
from drake_pose.errors import SceneError
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.cli import run_to_end
from tests.jobs.persons import record_person
from tests.jobs.scenes import write_joints

FRAMES = 5


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A scene of pictures, masks in another folder, the model, true positions, and a start file."""
    folder = tmp_path_factory.mktemp("person")
    scene = record_person(folder / "scene", FRAMES, size=(240, 180))
    shutil.move(folder / "scene" / "masks", folder / "masks")
    generator = np.random.default_rng(2)
    for name, camera in load_cameras(folder / "scene" / "cameras.yaml").items():
        renderer = LabelRenderer(scene.person, camera)
        room = generator.integers(0, 120, (12, 16, 3)).repeat(15, axis=0).repeat(15, axis=1)
        (folder / "scene" / "images" / name).mkdir(parents=True)
        for k, q in enumerate(scene.truth):
            clothes = np.where(renderer.segments(q)[..., None] % 2, (40, 90, 240), (120, 220, 250))
            picture = np.where(renderer.mask(q)[..., None], clothes, room)
            picture = picture + generator.normal(0.0, 4.0, picture.shape)
            file = folder / "scene" / "images" / name / f"{k:04d}.png"
            cv2.imwrite(str(file), np.clip(picture, 0, 255).astype(np.uint8))
    start = folder / "start.csv"
    write_joints(start, scene.person.position_names, {"0000": scene.truth[0]})
    return folder / "scene", folder / "masks", scene.truth, start


def moved(estimate, truth):
    """Return the errors of the moving arm's joints [deg]."""
    k = list(estimate.position_names).index("left_upper_arm_z")
    return np.abs(np.degrees([one.q[k] for one in estimate.records.values()] - truth[:, k]))


def test_a_person_is_tracked_by_colour_from_a_start(recording, out):
    scene, _, truth, start = recording
    settings = EstimateSettings(start=start, method="person")
    model = bundled_model("person")

    def stop(done, total, frame, record):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_scene(scene, model, out, settings, on_frame=stop)
    words = ["capture", scene, "--out", out, "--start", start, "--model", model]
    run_to_end(*words, "--resume", "--no-replay")
    # No frame is missing.
    found = estimate_scene(scene, model, out, settings, resume=True, replay=False)
    assert found.summary["method"] == "person"
    assert found.found_count == FRAMES
    assert not any("lost" in text for text in found.warnings)
    # The arm is raised by 40 degrees; a pixel is 1.6 cm.
    assert moved(found, truth).max() < 3.0
    assert all(0.0 < one.E_total < 0.6 for one in found.records.values())
    overlays = list((out / "overlay").glob("*/*.png"))
    assert len(overlays) == 4 * FRAMES


def test_a_lost_person_is_reported(recording, tmp_path):
    scene, _, _, start = recording
    copy = shutil.copytree(scene, tmp_path / "scene")
    for file in copy.glob("images/*/0003.png"):
        cv2.imwrite(str(file), np.full((180, 240, 3), 200, np.uint8))
    settings = EstimateSettings(start=start)
    found = estimate_scene(copy, bundled_model("person"), settings=settings)
    assert not found.records["0003"].found
    assert any("frame 0003" in text and "is lost" in text for text in found.warnings)


def test_a_person_with_a_single_mask_is_refused(recording, tmp_path):
    scene, masks, _, _ = recording
    copy = shutil.copytree(scene, tmp_path / "scene")
    (copy / "masks" / "camera_0").mkdir(parents=True)
    shutil.copy(masks / "camera_0" / "0000.png", copy / "masks" / "camera_0" / "0000.png")
    with pytest.raises(SceneError, match=r"'0000'.*fewer than two cameras.*start"):
        estimate_scene(copy, bundled_model("person"))


@pytest.mark.slow
def test_a_person_is_tracked_by_colour_from_masks_of_the_first_frame(recording, tmp_path):
    scene, masks, truth, _ = recording
    copy = shutil.copytree(scene, tmp_path / "scene")
    for folder in masks.iterdir():
        (copy / "masks" / folder.name).mkdir(parents=True)
        shutil.copy(folder / "0000.png", copy / "masks" / folder.name / "0000.png")
    found = estimate_scene(copy, bundled_model("person"))
    assert found.found_count == FRAMES
    assert found.records["0000"].ious
    assert not found.records["0004"].ious
    assert moved(found, truth).max() < 6.0
