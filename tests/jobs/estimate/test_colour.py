"""Tracking by colour in pictures without masks, painted over Drake's label images."""

import shutil

import cv2
import numpy as np
import pytest

from drake_pose.camera.camera_files import save_cameras
from drake_pose.errors import CameraError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate import inputs
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.files.test_report_page import Page
from tests.filtering.tracking.test_colours import make_background, painted
from tests.filtering.tracking.test_match_and_track import swings
from tests.jobs.scenes import edit_camera, write_joints
from tests.registration.episodes import painted_episode
from tests.registration.recordings import write_episode
from tests.search.bodies import forked_body, near_camera

FRAMES = 8


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A scene of pictures, the model file, the true positions, and a start file."""
    folder = tmp_path_factory.mktemp("recording")
    model, camera = forked_body(folder), near_camera()
    generator = np.random.default_rng(9)
    background = make_background(generator)
    truth = swings(FRAMES, np.array([0.1, 0.9, -0.8]), 0.25, generator)
    scene = folder / "scene"
    (scene / "images" / "front").mkdir(parents=True)
    renderer = LabelRenderer(model, camera)
    for k, q in enumerate(truth):
        picture = painted(renderer.mask(q), background, generator)
        cv2.imwrite(str(scene / "images" / "front" / f"{k:04d}.png"), picture[..., ::-1])
    save_cameras(scene / "cameras.yaml", [camera])
    (scene / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
    start = folder / "start.csv"
    write_joints(start, model.position_names, {"0": truth[0]})
    cv2.imwrite(str(folder / "first.png"), 255 * renderer.mask(truth[0]).astype(np.uint8))
    return scene, model.path, truth, start


def errors(estimate, truth):
    """Return the largest joint error (frames,) of each frame [deg]."""
    found = np.array([one.q for one in estimate.records.values()])
    return np.degrees(np.abs(found - truth).max(axis=1))


@pytest.fixture(scope="module")
def filmed(recording, tmp_path_factory):
    """The same scene with a video instead of pictures."""
    scene = recording[0]
    copy = tmp_path_factory.mktemp("filmed")
    shutil.copy(scene / "cameras.yaml", copy)
    (copy / "scene.yaml").write_text("sequence: true\n")
    (copy / "videos").mkdir()
    pictures = [cv2.imread(str(file)) for file in sorted(scene.glob("images/front/*.png"))]
    height, width = pictures[0].shape[:2]
    kind = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(copy / "videos" / "front.avi"), kind, 25.0, (width, height))
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return copy


def test_a_video_gives_the_same_poses_as_pictures(recording, filmed):
    scene, model, truth, start = recording
    loaded = load_scene(filmed)
    assert loaded.frames == tuple(f"{k:06d}" for k in range(FRAMES))
    assert loaded.frame_rate_hz == pytest.approx(25.0)
    # Frames are read in order, backwards and with gaps; compression changes little.
    still = load_scene(scene)
    for k in (0, 1, 5, 2, 7):
        off = loaded.read_image("front", f"{k:06d}").astype(float)
        off -= still.read_image("front", f"{k:04d}")
        assert np.abs(off).mean() < 12.0
    estimate = estimate_scene(filmed, model, settings=EstimateSettings(start=start))
    assert estimate.found_count == FRAMES
    assert np.median(errors(estimate, truth)) < 3.0


def test_intervals_of_frames_by_colour_contain_the_truth(recording):
    scene, model, truth, start = recording
    records = estimate_scene(scene, model, None, EstimateSettings(start=start)).records
    assert len(records) == FRAMES
    for record, q in zip(records.values(), truth, strict=True):
        told = zip(record.joints.values(), np.degrees(q), strict=True)
        assert all(joint["low"] < value < joint["high"] for joint, value in told)
        assert all(joint["determined"] for joint in record.joints.values())
        assert max(joint["high"] - joint["low"] for joint in record.joints.values()) < 12.0


def test_frames_of_a_video_have_the_names_of_its_masks(recording, filmed, tmp_path):
    copy = shutil.copytree(filmed, tmp_path / "scene")
    (copy / "masks" / "front").mkdir(parents=True)
    shutil.copy(recording[0].parent / "first.png", copy / "masks" / "front" / "0.png")
    loaded = load_scene(copy)
    assert loaded.frames == ("0", *(f"{k:06d}" for k in range(1, FRAMES)))
    assert ("front", "0") in loaded.images
    (copy / "videos" / "front.avi").write_bytes(b"no video")
    with pytest.raises(SceneError, match=r"front\.avi.*not a video"):
        load_scene(copy)


@pytest.mark.parametrize(
    ("with_start", "more", "words"),
    [
        (False, {}, r"'0000'.*masks/front/0000\.png.*start="),
        (True, {"frames": ("0003:0005",)}, r"start\.csv.*'0003'"),
        (True, {"track": False}, "sequence: true"),
        (False, {"track": False}, "leave track=False out"),
    ],
)
def test_a_sequence_of_pictures_without_a_start_is_refused(recording, with_start, more, words):
    scene, model, _, start = recording
    settings = EstimateSettings(start=start if with_start else None, **more)
    with pytest.raises((SceneError, SettingsError), match=words):
        estimate_scene(scene, model, settings=settings)


def test_a_damaged_picture_is_refused_before_the_work_begins(recording, tmp_path, out):
    scene, model, _, start = recording
    copy = shutil.copytree(scene, tmp_path / "scene")
    cv2.imwrite(str(copy / "images" / "front" / "0005.png"), np.zeros((10, 20, 3), np.uint8))
    with pytest.raises(SceneError, match=r"0005\.png.*20 x 10"):
        estimate_scene(copy, model, out, EstimateSettings(start=start))
    (copy / "images" / "front" / "0005.png").write_bytes(b"no picture")
    with pytest.raises(SceneError, match=r"0005\.png"):
        estimate_scene(copy, model, out, EstimateSettings(start=start))
    assert not (out / "poses.csv").exists()


def test_a_resumed_sequence_of_pictures_equals_an_uninterrupted_one(recording, out):
    scene, model, _, start = recording
    settings, heard = EstimateSettings(start=start), []

    def stop(done, total, frame, record):
        heard.append((done, frame))
        if done == 3 and frame:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_scene(scene, model, out, settings, on_frame=stop)
    resumed = estimate_scene(scene, model, out, settings, resume=True, on_frame=stop, replay=False)
    assert heard[4:] == [(3, ""), *((k + 1, f"{k:04d}") for k in range(3, FRAMES))]
    whole = estimate_scene(scene, model, settings=settings)
    for one, other in zip(resumed.records.values(), whole.records.values(), strict=True):
        np.testing.assert_allclose(one.q, other.q, atol=1e-6)
    assert whole.found_count == FRAMES
    assert np.median(errors(whole, recording[2])) < 1.5
    # Overlays show an orange contour over pictures.
    shown = cv2.imread(str(out / "overlay" / "front" / "0001.png"))
    line = np.all(shown == (0, 94, 213), axis=-1)
    assert 100 < line.sum() < 0.1 * line.size


def test_frames_in_which_the_body_is_lost_have_no_pose(recording, tmp_path, out):
    scene, model, _, start = recording
    copy = shutil.copytree(scene, tmp_path / "scene")
    picture = cv2.imread(str(copy / "images" / "front" / "0003.png"))
    for k, grey in ((3, 128), (4, None)):
        # A grey picture, and one with the body elsewhere.
        seen = np.full_like(picture, 128) if grey else np.roll(picture, 150, axis=1)
        cv2.imwrite(str(copy / "images" / "front" / f"{k:04d}.png"), seen)
    (copy / "masks" / "front").mkdir(parents=True)
    shutil.copy(scene.parent / "first.png", copy / "masks" / "front" / "0000.png")
    found = estimate_scene(copy, model, out, EstimateSettings(start=start))
    lost = [one for one in found.records.values() if not one.found]
    assert [row.frame for row in lost] == ["0003", "0004"]
    assert np.isnan([row.q for row in lost]).all()
    assert any("frame 0003-0004 (2 of 8)" in text for text in found.summary["warnings"])
    assert found.summary["compared_count"] == 1
    rows = (out / "poses.csv").read_text().splitlines()[1:]
    assert [k for k, row in enumerate(rows) if ",,,," in row] == [3, 4]
    text = (out / "report.html").read_text()
    assert "0003-0004 (2 of 8): no pose was found" in text
    # The page counts pictures instead of masks; a single IoU has no plot.
    page = Page(text)
    cameras = next(table for table in page.tables if table[0][0] == "camera")
    assert cameras[1][:3] == ["front", "8", "6"]
    assert "tracked by colour in " in text
    assert "IoU of each camera" not in text
    assert "Pictures used in each frame" in text


def test_stills_have_no_pictures_and_full_masks_need_none(recording, tmp_path):
    scene, _, _, _ = recording
    copy = shutil.copytree(scene, tmp_path / "scene")
    (copy / "masks" / "front").mkdir(parents=True)
    for k in range(FRAMES):
        shutil.copy(scene.parent / "first.png", copy / "masks" / "front" / f"{k:04d}.png")
    assert not load_scene(copy).images
    (copy / "masks" / "front" / "0007.png").unlink()
    assert load_scene(copy).images
    (copy / "scene.yaml").write_text("sequence: false\n")
    found = load_scene(copy)
    assert not found.images
    assert len(found.frames) == FRAMES - 1


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    folder = tmp_path_factory.mktemp("episode")
    painted = painted_episode(folder, frames=6, size=(320, 240), every=0.1)
    write_episode(folder / "scene", painted)
    return folder / "scene", painted


def test_an_arm_is_tracked_from_its_first_logged_positions(episode):
    scene, painted = episode
    result = estimate_scene(scene, painted.path)
    assert list(result.records) == [f"{k:04d}" for k in range(6)]
    off = np.array([list(one.joint_errors.values()) for one in result.records.values()])
    assert off.shape == painted.values.shape
    # The last link turns about its axis of symmetry.
    assert np.median(np.abs(off[:, :3])) < 1.0
    assert np.abs(off[:, :3]).max() < 4.0


def test_cameras_must_show_the_arm_at_its_first_logged_positions(episode, monkeypatch):
    scene, painted = episode
    checked = []
    monkeypatch.setattr(inputs, "require_visible", lambda _, X_CN, __: checked.append(X_CN))
    found = inputs.read_inputs(scene, painted.path, EstimateSettings(), None)
    tree = found.search.tree
    X_WN = tree.node_poses(tree.values_from_positions(found.starts["0000"]))
    np.testing.assert_allclose(checked, [painted.camera.X_CW @ X_WN])


def test_selected_frames_are_compared_with_synchronised_positions(episode):
    scene, painted = episode
    result = estimate_scene(scene, painted.path, settings=EstimateSettings(every=2))
    assert list(result.records) == ["0000", "0002", "0004"]
    for k, record in zip((0, 2, 4), result.records.values(), strict=True):
        truth = record.q - np.radians(list(record.joint_errors.values()))
        np.testing.assert_allclose(truth, painted.values[k], atol=5e-3)


def test_cameras_of_another_file_are_used(episode, tmp_path):
    scene, painted = episode
    nowhere = edit_camera(scene / "cameras.yaml", "camera", tmp_path / "nowhere.yaml", X_WC=None)
    with pytest.raises(SceneError, match="no camera has a pose X_WC; find"):
        estimate_scene(scene, painted.path, cameras=nowhere)
    save_cameras(tmp_path / "small.yaml", [painted.camera.resized(160, 120)])
    with pytest.raises(CameraError, match="has 160 x 120 pixels"):
        estimate_scene(scene, painted.path, cameras=tmp_path / "small.yaml")
    with pytest.raises(UnknownNameError, match="no camera 'left'"):
        estimate_scene(scene, painted.path, settings=EstimateSettings(cameras=("left",)))
