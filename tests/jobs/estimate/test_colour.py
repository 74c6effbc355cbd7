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
from tests.filtering.tracks import make_background, painted, swings
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


@pytest.fixture
def copied(recording, tmp_path):
    """A copy of the scene with a mask of its first frame, which may be changed."""
    copy = shutil.copytree(recording[0], tmp_path / "scene")
    (copy / "masks" / "front").mkdir(parents=True)
    shutil.copy(recording[0].parent / "first.png", copy / "masks" / "front" / "0000.png")
    return copy


def test_a_video_gives_the_same_poses_as_pictures(recording, copied):
    scene, model, truth, start = recording
    pictures = [cv2.imread(str(file)) for file in sorted(scene.glob("images/front/*.png"))]
    height, width = pictures[0].shape[:2]
    (copied / "videos").mkdir()
    film = copied / "videos" / "front.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (width, height))
    for picture in pictures:
        writer.write(picture)
    writer.release()
    shutil.rmtree(copied / "images")
    (copied / "scene.yaml").write_text("sequence: true\n")
    loaded = load_scene(copied)
    # A frame has the name of its mask.
    assert loaded.frames == tuple(f"{k:04d}" if k == 0 else f"{k:06d}" for k in range(FRAMES))
    assert loaded.frame_rate_hz == pytest.approx(25.0)
    estimate = estimate_scene(copied, model, settings=EstimateSettings(start=start))
    assert estimate.found_count == FRAMES
    assert np.median(errors(estimate, truth)) < 3.0
    film.write_bytes(b"no video")
    with pytest.raises(SceneError, match=r"front\.avi.*not a video"):
        load_scene(copied)


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


def test_a_damaged_picture_is_refused_before_the_work_begins(recording, copied, out):
    small = cv2.imencode(".png", np.zeros((10, 20, 3), np.uint8))[1].tobytes()
    for data, words in ((small, r"0005\.png.*20 x 10"), (b"no picture", r"0005\.png")):
        (copied / "images" / "front" / "0005.png").write_bytes(data)
        with pytest.raises(SceneError, match=words):
            estimate_scene(copied, recording[1], out, EstimateSettings(start=recording[3]))
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
    for record, q in zip(whole.records.values(), recording[2], strict=True):
        for joint, value in zip(record.joints.values(), np.degrees(q), strict=True):
            assert joint["determined"]
            assert joint["low"] < value < joint["high"] < joint["low"] + 12.0
    # Overlays show an orange contour over pictures.
    shown = cv2.imread(str(out / "overlay" / "front" / "0001.png"))
    line = np.all(shown == (0, 94, 213), axis=-1)
    assert 100 < line.sum() < 0.1 * line.size


def test_frames_in_which_the_body_is_lost_have_no_pose(recording, copied, out):
    files = [copied / "images" / "front" / f"{k:04d}.png" for k in (3, 4)]
    # A grey picture, and one with the body elsewhere.
    picture = cv2.imread(str(files[1]))
    cv2.imwrite(str(files[0]), np.full_like(picture, 128))
    cv2.imwrite(str(files[1]), np.roll(picture, 150, axis=1))
    found = estimate_scene(copied, recording[1], out, EstimateSettings(start=recording[3]))
    lost = [one for one in found.records.values() if not one.found]
    assert [row.frame for row in lost] == ["0003", "0004"]
    assert np.isnan([row.q for row in lost]).all()
    assert any("frame 0003-0004 (2 of 8)" in text for text in found.summary["warnings"])
    assert found.summary["compared_count"] == 1
    rows = (out / "poses.csv").read_text().splitlines()[1:]
    assert [k for k, row in enumerate(rows) if ",,,," in row] == [3, 4]


def test_stills_have_no_pictures_and_full_masks_need_none(copied):
    masks = copied / "masks" / "front"
    assert load_scene(copied).images
    for k in range(1, FRAMES):
        shutil.copy(masks / "0000.png", masks / f"{k:04d}.png")
    assert not load_scene(copied).images
    (masks / "0007.png").unlink()
    (copied / "scene.yaml").write_text("sequence: false\n")
    found = load_scene(copied)
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
    for every in (1, 2):
        result = estimate_scene(scene, painted.path, settings=EstimateSettings(every=every))
        frames = range(0, 6, every)
        assert list(result.records) == [f"{k:04d}" for k in frames]
        off = np.array([list(one.joint_errors.values()) for one in result.records.values()])
        # They are compared with the synchronised positions of the log.
        q = np.array([one.q for one in result.records.values()])
        np.testing.assert_allclose(q - np.radians(off), painted.values[frames], atol=5e-3)
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


def test_cameras_of_another_file_are_used(episode, tmp_path):
    scene, painted = episode
    nowhere = edit_camera(scene / "cameras.yaml", "camera", tmp_path / "nowhere.yaml", X_WC=None)
    small = tmp_path / "small.yaml"
    save_cameras(small, [painted.camera.resized(160, 120)])
    for more, error, words in (
        ({"cameras": nowhere}, SceneError, "no camera has a pose X_WC; find"),
        ({"cameras": small}, CameraError, "has 160 x 120 pixels"),
        ({"settings": EstimateSettings(cameras=("left",))}, UnknownNameError, "no camera 'left'"),
    ):
        with pytest.raises(error, match=words):
            estimate_scene(scene, painted.path, **more)
