"""Estimates of scenes: result folders, tracks, and doubts about tracks and cameras."""

import json
import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.errors import OutputError, SettingsError
from drake_pose.files.records import BADLY_EXPLAINED, FrameRecord
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.inputs import read_inputs
from drake_pose.jobs.estimate.scene import check_track, compare_cameras, estimate_scene
from drake_pose.search import TRACKED, PaperSearchSettings
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.jobs.scenes import NAMES, camera, read_rows, run_estimate, write_scene, write_truth
from tests.registration.episodes import painted_episode
from tests.registration.recordings import write_episode

# A swinging crane, with a cut before the last frames.
BEFORE = [(20 + 3 * k, -40 - 2 * k) for k in range(5)]
AFTER = [(-60 + 2 * k, -90 + 3 * k) for k in range(3)]
QUIET = {"replay": False, "overlay": False}


@pytest.fixture(scope="module")
def swinging(tmp_path_factory):
    """A sequence before two cameras, with the true positions."""
    scene = write_scene(
        tmp_path_factory.mktemp("swinging") / "scene", [*BEFORE, *AFTER], ("front", "side")
    )
    (scene.folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
    write_truth(scene)
    return scene


@pytest.fixture(scope="module")
def estimated(swinging, tmp_path_factory):
    """Its result folder, the result, and what was heard of the progress."""
    heard, out = [], tmp_path_factory.mktemp("estimated") / "out"
    result = estimate_scene(
        swinging.folder, swinging.model, out, on_frame=lambda *what: heard.append(what[:3])
    )
    return out, result, heard


def test_a_sequence_is_searched_then_tracked_and_searched_after_a_cut(estimated, swinging):
    _, result, heard = estimated
    frames = list(swinging.truth)
    assert heard == [(0, 8, ""), *((k + 1, 8, frame) for k, frame in enumerate(frames))]
    records = [result.records[frame] for frame in frames]
    assert [one.stopped_by == TRACKED for one in records] == [k not in (0, 5) for k in range(8)]
    inside, count = [], 0
    front = load_scene(swinging.folder)
    renderers = [LabelRenderer(load_model(swinging.model), c) for c in front.cameras.values()]
    for frame, record in result.records.items():
        truth = swinging.truth[frame]
        assert np.degrees(np.abs(record.q - truth)).max() < 2.5
        masks = [front.read(name, frame) for name in front.cameras]
        drawn = [one.mask(record.q) for one in renderers]
        wrong = sum(np.count_nonzero(a != b) for a, b in zip(masks, drawn, strict=True))
        E_total = wrong / sum(mask.sum() for mask in masks)
        assert record.E_total == pytest.approx(E_total, abs=0.003)
        off = np.degrees(record.q - truth)
        assert list(record.joint_errors.values()) == pytest.approx(off, abs=1e-6)
        for name, value in zip(NAMES, truth, strict=True):
            joint, count = record.joints[name], count + 1
            if joint["determined"]:
                inside.append(joint["low"] <= np.degrees(value) <= joint["high"])
                assert joint["high"] - joint["low"] <= 20.0
    assert len(inside) >= 0.8 * count
    assert np.mean(inside) >= 0.9
    assert not [text for text in result.warnings if "camera" in text]


def test_result_folder(estimated, swinging):
    out, result, _ = estimated
    assert {path.name for path in out.iterdir()} >= {
        "joints.csv", "modes.csv", "overlay", "overlay_modes", "poses.csv", "replay.html",
        "report.html", "summary.json",
    }  # fmt: skip
    rows = read_rows(out / "poses.csv")
    assert list(rows[0]) == ["frame", *NAMES, "error", "seconds"]
    assert [row["frame"] for row in rows] == list(swinging.truth)
    for row, record in zip(rows, result.records.values(), strict=True):
        assert float(row["error"]) == pytest.approx(record.E_total, rel=1e-6)
        np.testing.assert_allclose([float(row[name]) for name in NAMES], record.q, atol=1e-8)
    assert 'src="http' not in (out / "replay.html").read_text()
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["complete"], summary["frame_count"], summary["found_count"]) == (True, 8, 8)
    assert summary["method"] == "beam"
    # Other poses are drawn where the pose was searched.
    drawn = sorted(path.stem for path in (out / "overlay_modes").iterdir())
    assert drawn == ["0000", "0005"]


def test_an_interrupted_estimate_is_continued(estimated, swinging, out):
    """Finished frames stay as they are; the result is about that of an uninterrupted estimate."""

    def stop(done, total, frame, record):
        if done == 2 and frame:
            raise KeyboardInterrupt

    given = swinging.folder, swinging.model, out
    with pytest.raises(KeyboardInterrupt):
        estimate_scene(*given, on_frame=stop, **QUIET)
    before = (out / "poses.csv").read_text()
    assert len(before.splitlines()) == 3
    assert not json.loads((out / "summary.json").read_text())["complete"]
    with pytest.raises(OutputError, match="not empty"):
        estimate_scene(*given)
    with pytest.raises(OutputError, match="method"):
        estimate_scene(*given, EstimateSettings(method="paper"), resume=True)
    resumed = estimate_scene(*given, resume=True, **QUIET)
    assert (out / "poses.csv").read_text().startswith(before)
    assert not (out / "overlay").exists()
    for one, other in zip(resumed.records.values(), estimated[1].records.values(), strict=True):
        np.testing.assert_allclose(one.q, other.q, atol=np.radians(1.0))


def test_frames_without_a_pose(own_scene, out, monkeypatch):
    strict = partial(PaperSearchSettings, outside_limit=0.0)
    monkeypatch.setattr("drake_pose.jobs.estimate.inputs.PaperSearchSettings", strict)
    options = ["--method", "paper", "--no-replay", "--hold", "lift=-90"]
    lost, summary = run_estimate(own_scene, out, *options, status=1)
    (warning,) = summary["warnings"]
    assert "frame 0000-0002 (3 of 3): no pose was found" in warning
    assert lost.stderr.count(warning) == 1
    assert "no pose was found in any frame" in lost.stderr
    assert summary["found_count"] == 0
    assert (out / "overlay" / "front" / "0000.png").is_file()
    assert not (out / "overlay_modes").exists()


def test_pose_and_scale_without_cameras_or_without_the_root_position(own_scene, tiny_scene):
    """A parallel camera approximates the pinhole camera that drew the masks."""
    masks = own_scene.folder / "masks"
    (own_scene.folder / "cameras.yaml").unlink()
    for path in (masks / "front").iterdir():
        path.rename(masks / path.name)
    (masks / "front").rmdir()
    true_camera = camera("front")
    # The crane stands in the world's origin.
    scale = true_camera.focal_x / np.linalg.norm(true_camera.X_WC[:2, 3])
    for scene, root, most in ((own_scene, None, 0.08), (tiny_scene, "unknown", 0.03)):
        settings = EstimateSettings(method="beam", frames=("0",), root_position=root)
        found = estimate_scene(scene.folder, scene.model, None, settings)
        record = found.records["0000"]
        np.testing.assert_allclose(record.q, scene.truth["0000"], atol=np.radians(6.0))
        assert record.E_total < most
        if root is None:
            assert record.camera_scale == pytest.approx(scale, rel=0.06)
            # Without intervals each joint has the range of its limits.
            limits = load_model(scene.model, check=False)
            for k, joint in enumerate(record.joints.values()):
                ends = np.degrees([limits.lower[k], limits.upper[k]])
                assert not joint["determined"]
                assert [joint["low"], joint["high"]] == pytest.approx(ends)
        else:
            assert record.camera_scale is None
        wrong = replace(settings, method="paper")
        with pytest.raises(SettingsError, match="method beam"):
            estimate_scene(scene.folder, scene.model, None, wrong)


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    """Pictures and a joint log of an arm."""
    folder = tmp_path_factory.mktemp("episode")
    painted = painted_episode(folder, frames=6, size=(320, 240), every=0.1)
    write_episode(folder / "scene", painted)
    return folder / "scene", painted


def test_an_arm_is_tracked_by_colour_from_its_first_logged_positions(episode):
    scene, painted = episode
    result = estimate_scene(scene, painted.path, settings=EstimateSettings(every=2))
    assert list(result.records) == ["0000", "0002", "0004"]
    off = np.array([list(one.joint_errors.values()) for one in result.records.values()])
    # They are compared with the synchronised positions of the log.
    q = np.array([one.q for one in result.records.values()])
    np.testing.assert_allclose(q - np.radians(off), painted.values[:6:2], atol=5e-3)
    # The last link turns about its axis of symmetry.
    assert np.abs(off[:, :3]).max() < 4.0
    for one, values in zip(result.records.values(), painted.values[::2], strict=True):
        for joint, value in list(zip(one.joints.values(), np.degrees(values), strict=True))[:3]:
            assert joint["low"] < value < joint["high"]


def test_a_track_by_colour_is_continued_and_lost(episode, tmp_path, out):
    """What is finished stays; a frame that does not show the body has no pose."""
    scene, painted = shutil.copytree(episode[0], tmp_path / "scene"), episode[1]
    grey = scene / "images" / "camera" / "0003.png"
    cv2.imwrite(str(grey), np.full((240, 320, 3), 128, np.uint8))

    def stop(done, total, frame, record):
        if done == 2 and frame:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_scene(scene, painted.path, out, on_frame=stop, replay=False)
    resumed = estimate_scene(scene, painted.path, out, resume=True, replay=False)
    lost = [one.frame for one in resumed.records.values() if not one.found]
    assert lost == ["0003"]
    whole = estimate_scene(scene, painted.path, overlay=False)
    for one, other in zip(resumed.records.values(), whole.records.values(), strict=True):
        np.testing.assert_allclose(one.q, other.q, atol=1e-6)
    assert len([*(out / "overlay" / "camera").iterdir()]) == 6


class Judge:
    """A search that fits as well as the masks belong to the cameras; these are 3, 4, ... wide."""

    def __init__(self, fits):
        self.fits, self.asked = fits, []

    def match(self, views, root_position=None):
        owners = {view.camera.name: "abcd"[int(view.mask.sum()) - 1] for view in views}
        self.asked.append(owners)
        E_total = self.fits(owners)
        return SimpleNamespace(found=E_total is not None, E_total=E_total)


def rig_of(names, sizes=None, **more):
    """Return inputs of a scene whose masks of camera a have one pixel, of b two, ..."""
    cameras = {
        name: SimpleNamespace(name=name, width=(sizes or {}).get(name, 4), height=2)
        for name in names
    }

    def mask_of(name, frame):
        mask = np.zeros((2, cameras[name].width), bool)
        mask.flat[: 1 + "abcd".index(name)] = True
        return mask

    masks = {(name, frame): None for name in names for frame in "012"}
    scene = SimpleNamespace(cameras=cameras, masks=masks, images={}, read=mask_of)
    return SimpleNamespace(scene=SimpleNamespace(**(vars(scene) | more)), root_positions=None)


def right(owners):
    return all(name == owner for name, owner in owners.items())


EXCHANGED = {"a": "b", "b": "a"}


def without(name, at=0.4):
    """Fits where this camera is left out."""
    return lambda owners: at if name in owners else 0.1


@pytest.mark.parametrize(
    ("names", "fits", "words"),
    [
        ("ab", lambda own: 0.1 if own == EXCHANGED else 0.4, "cameras 'a' and 'b' seem to be"),
        (
            "abc", lambda own: 0.1 if own == {"a": "c", "b": "b", "c": "a"} else 0.4,
            "cameras 'a' and 'c' seem to be",
        ),
        ("ab", without("b"), "camera 'b' is inconsistent with the other one"),
        ("ab", lambda own: 0.1 if len(own) == 1 else 0.4, "cameras 'a' and 'b' are inconsistent"),
        ("abc", without("b"), "camera 'b' is inconsistent with the others"),
        (
            "abc", lambda own: 0.1 if len(own) == 1 else 0.4,
            "cameras 'a' and 'b' and 'c' are inconsistent",
        ),
        ("abc", lambda own: 0.3, None),
        ("ab", lambda own: None, None),
        # Not half of the error.
        ("ab", lambda own: 0.21 if own == EXCHANGED else 0.4, None),
    ],
)  # fmt: skip
def test_the_change_of_cameras_that_halves_the_error_is_told(names, fits, words):
    search, heard, inputs = Judge(fits), [], rig_of(names)
    ious = {name: 0.1 + 0.1 * k for k, name in enumerate(names)}
    records = {
        frame: FrameRecord(frame, np.zeros(1), None, E_total, 1.0, ious=ious)
        for frame, E_total in zip("012", (0.39, 0.41, 0.9), strict=True)
    }
    found = compare_cameras(inputs, search, records, lambda *given: heard.append(given))
    assert heard == [("comparing the cameras", 0, None)]
    assert len(found) == (words is not None)
    if words:
        assert found[0].startswith(words)
        assert "E_total is 40.00 %" in found[0]


def test_cameras_are_compared_only_if_most_poses_fit_badly():
    judge = Judge(lambda own: 0.01)

    def told(names, E_total, **more):
        ious = dict.fromkeys(names, 0.1)
        records = {
            frame: FrameRecord(frame, np.zeros(1), None, E_total, 1.0, ious=ious) for frame in "012"
        }
        return compare_cameras(rig_of(names, **more), judge, records, lambda *_: None)

    assert told("ab", 0.13)
    assert not told("ab", 0.11)
    assert not told("abc", BADLY_EXPLAINED - 0.01)
    assert told("abc", BADLY_EXPLAINED + 0.01)
    assert not told("a", 0.9)
    assert not told("ab", None)
    assert not told("ab", 0.3, images={("a", "0"): None})
    assert not told("ab", 0.3, masks={("a", "0"): None, ("b", "1"): None})
    # Masks of another size are not exchanged.
    judge.asked.clear()
    assert told("ab", 0.3, sizes={"a": 5})
    assert all(right(owners) for owners in judge.asked)


@pytest.mark.parametrize(
    ("left", "by_search", "is_told"),
    [(0.3, 0.05, True), (0.3, 0.29, False), (0.02, 0.01, False), (0.021, 0.001, True),
     (0.3, None, False), (0.3, 0.25, False)],
)  # fmt: skip
def test_a_track_of_a_wrong_pose_is_told(swinging, left, by_search, is_told):
    """Worse by a fifth and .01 than the best searched frame, and than a search of that frame."""
    inputs = read_inputs(swinging.folder, swinging.model, EstimateSettings(), None)
    wrong = swinging.truth["0001"] + [0.05, 0.5]
    records = {
        frame: FrameRecord(frame, wrong, None, E_total, 0.1, stopped_by=how)
        for frame, E_total, how in (
            ("0000", 0.01, "end"), ("0001", left, TRACKED), ("0002", 0.001, TRACKED),
            ("0003", 0.4, "end"), ("0004", None, TRACKED),
        )
    }  # fmt: skip
    asked = []

    def match(views, root_position):
        asked.append([view.camera.name for view in views])
        found, q = by_search is not None, swinging.truth["0001"] + [2 * np.pi, 0.0]
        return SimpleNamespace(found=found, E_total=by_search, q=q)

    texts = check_track(inputs, SimpleNamespace(match=match), records)
    assert len(texts) == is_told
    if is_told:
        assert f"frame '0001': E_total is {100 * left:.2f} % by tracking, but" in texts[0]
        assert "with other positions of luff" in texts[0]
        assert asked == [["front", "side"]]
    for gone in ("0000", "0001"):
        few = {frame: one for frame, one in records.items() if frame != gone}
        if gone == "0001" or by_search is None:
            few.pop("0003")
            assert check_track(inputs, SimpleNamespace(match=match), few) == []


@pytest.mark.slow
def test_estimates_of_a_real_arm_lie_in_their_intervals(shared_data):
    """From damaged masks, which do not determine the flange's angle."""
    scene, held = shared_data / "arm_two_views", []
    model = scene / "med7" / "med7.urdf"
    truth = read_inputs(scene, model, EstimateSettings(), None).truth
    for frame, record in estimate_scene(scene, model).records.items():
        joints, values = [*record.joints.values()], np.degrees(truth.of_frames([frame])[0])
        assert not joints[-1]["determined"]
        own = [j["low"] <= v <= j["high"] for j, v in zip(joints, values, strict=True)]
        assert all(own[:4]), (frame, own)
        held.append(own)
    assert np.mean(held) >= 0.95
