"""Estimates of one person from masks: stages, files, interruptions, and warnings."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.body import load_landmarks
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SceneError
from drake_pose.files.settings import EstimateSettings
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.jobs.estimate.person import (
    describe_camera,
    describe_fit,
    describe_rig,
    describe_views,
)
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.person.capture import CheckedCapture, PersonCapture
from drake_pose.person.faults import CameraFault, RigFault
from drake_pose.person.figures import ViewFaults
from tests.cli import run_to_end
from tests.jobs.scenes import read_rows, write_masks
from tests.person.persons_in_view import stepping
from tests.written_files import write_mask

FRAMES = 6


@pytest.fixture(scope="module")
def walk(tmp_path_factory, person):
    """A scene of a person who walks through the view of four cameras, and the true positions."""
    folder = tmp_path_factory.mktemp("walk")
    cameras = circle_of_cameras(4, size=(160, 120), face_camera=False)
    save_cameras(folder / "cameras.yaml", cameras)
    (folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
    truth = np.array([stepping(person, 0.15 * k, -0.2 + 0.04 * k, 0.1) for k in range(FRAMES)])
    write_masks(folder, person, cameras.values(), truth)
    return folder, truth


@pytest.fixture
def own_walk(walk, tmp_path):
    """A copy of the scene that may be changed."""
    return shutil.copytree(walk[0], tmp_path / "scene")


@pytest.fixture
def known(walk, monkeypatch):
    """Replace the capture, which takes seconds, by the truth with another pose in frame 1.

    In the last frame nobody is found. Returns the numbers of frames of the calls.
    """
    counts = []

    def capture(tree, cameras, read, count, settings, on_frame):
        counts.append(count)
        q = walk[1][:count].copy()
        other = q[min(1, count - 1)].copy()
        other[tree.model.position_index("left_upper_arm_z")] += np.radians(60.0)
        if count == FRAMES:
            q[-1] = np.nan
        for k in [*range(count), *range(count)]:
            read(k)
        for k in range(count):
            on_frame(k)
        read(0)
        deviations = np.full_like(q, 0.01)
        captured = PersonCapture(
            q=q, inlier_ratios=np.where(np.isnan(q[:, 0]), 0.0, 0.5), shape=None, tree=tree,
            outlines=ContourFit(tree).outlines, deviations=deviations,
            alternatives={k: ((other, deviations[0]),) for k in (1, count - 1) if 0 < k < count},
        )  # fmt: skip
        without = {"camera_3": (0,)} if count == FRAMES else {}
        views = ViewFaults(blind=without)

        def shown(k):
            return {name: mask for name, mask in read(k).items() if k not in without.get(name, ())}

        return CheckedCapture(captured, views, (), None, shown)

    monkeypatch.setattr("drake_pose.jobs.estimate.person.capture_checked", capture)
    return counts


def test_a_captured_person_is_written_and_doubts_are_told(walk, known, person, out):
    stages = []
    result = estimate_scene(
        walk[0], person.path, out, replay=False, on_stage=lambda *stage: stages.append(stage)
    )
    first, found = "reading", "finding and measuring the person"
    counts = range(1, 1 + FRAMES)
    assert stages == [
        *((first, k, FRAMES) for k in counts), *((found, k, None) for k in counts),
        *(("tracking", k, FRAMES) for k in counts), ("comparing the cameras", FRAMES + 1, None),
    ]  # fmt: skip
    assert (result.summary["method"], result.found_count) == ("person", FRAMES - 1)
    assert {path.name for path in out.iterdir()} == {
        "joint_centres.csv", "joint_centres.trc", "joints.csv", "modes.csv", "overlay", "poses.csv",
        "positions.mot", "report.html", "summary.json",
    }  # fmt: skip
    for k, record in enumerate(result.records.values()):
        assert 0.0 < record.seconds < 60.0
        # The masks agree with the truth, which replaces the capture.
        assert len(record.ious) == (0 if k == FRAMES - 1 else 3 if k == 0 else 4)
        assert all(iou > 0.9 for iou in record.ious.values())
        assert record.found == (k < FRAMES - 1)
    # Overlays show cameras that were left out, too.
    assert len([*out.glob("overlay/*/*.png")]) == 4 * FRAMES
    # 95 % intervals from standard deviations end at limits; those of modes are united.
    joints = {(row["frame"], row["joint"]): row for row in read_rows(out / "joints.csv")}
    name, half = "left_upper_arm_z", np.degrees(1.96 * 0.01)
    index = person.position_index(name)
    for k, reach, modes in ((2, 0.0, ""), (1, 60.0, "2")):
        row, value = joints[f"{k:04d}", name], np.degrees(walk[1][k, index])
        assert float(row["low"]) == pytest.approx(value - half, abs=1e-3)
        assert float(row["high"]) == pytest.approx(value + reach + half, abs=1e-3)
        assert row["modes"] == modes
    doubts = [text for text in result.warnings if "equally well" in text]
    assert len(doubts) == 1
    assert "frame 0001" in doubts[0]
    assert "left_wrist" in doubts[0]
    assert "right" not in doubts[0]
    assert "left_ankle" in load_landmarks(person.path)
    assert "only 50 % of the contours fit" in " ".join(result.warnings)
    assert "'camera_3' sees no person in frame 0000" in " ".join(result.warnings)


def test_an_interrupted_capture_is_incomplete_and_resumes_as_a_whole(walk, known, person, out):
    def interrupt(*_):
        raise KeyboardInterrupt

    words = ["estimate", walk[0], "--model", person.path, "--out", out, "--no-replay"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drake_pose.jobs.estimate.person.capture_checked", interrupt)
        result = run_to_end(*words, "--frame", "0", status=1)
    assert "--resume" in result.stderr
    assert not json.loads((out / "summary.json").read_text())["complete"]
    assert read_rows(out / "poses.csv") == []
    assert not (out / "report.html").exists()
    for frames, finished, asked in (
        ("0", 1, [1]), ("1:2", 3, [1, 3]),
        # No frame is missing.
        ("0:2", 3, [1, 3]),
    ):  # fmt: skip
        run_to_end(*words, "--no-overlay", "--resume", "--frame", frames)
        assert json.loads((out / "summary.json").read_text())["complete"]
        assert len(read_rows(out / "poses.csv")) == finished
        assert known == asked
    assert not (out / "overlay").exists()


def test_damaged_masks_are_named_and_others_are_used(walk, own_walk, person, out):
    masks = own_walk / "masks"
    (masks / "camera_1" / "0001.png").write_bytes(b"no picture")
    write_mask(masks / "camera_2" / "0004.png", np.zeros((120, 160), bool))
    result = estimate_scene(own_walk, person.path, out, replay=False, overlay=False)
    for parts in (("0001", "camera_1", "not a PNG"), ("camera_2", "no person in frame 0004")):
        assert [text for text in result.warnings if all(part in text for part in parts)], parts
    assert len(result.warnings) == 2
    assert "camera_1" not in result.records["0001"].ious
    places = [person.position_index(f"position_{axis}") for axis in "xyz"]
    found = np.array([one.q[places] for one in result.records.values()])
    assert np.abs(found - walk[1][:, places]).max() < 0.03
    for file in masks.glob("*/*.png"):
        file.write_bytes(b"no picture")
    with pytest.raises(SceneError, match="none of 24 masks"):
        estimate_scene(own_walk, person.path, settings=EstimateSettings(method="person"))


def motion(**more):
    known = {"shift": (-3.0, 4.0), "pixels": 5.0, "metres": 0.12, "turn": np.radians(2.0)}
    return SimpleNamespace(**known, inlier_ratio_before=0.4, inlier_ratio_after=0.9, **more)


def test_faults_are_told():
    frames = [f"f{k}" for k in range(9)]
    assert describe_views(ViewFaults(), frames) == ()
    views = ViewFaults(
        no_person=(0, 1, 4), blind={"a": (2,)}, others={"b": (3,), "c": (5,)}, merged={"c": (5,)}
    )
    nobody, blind, others = describe_views(views, frames)
    assert nobody.startswith("frame f0-f1, f4: fewer than two cameras")
    assert blind.startswith("camera 'a' sees no person in frame f2")
    assert others.startswith("frame f3, f5: somebody else is in view of cameras 'b' and 'c'")
    assert others.endswith("in camera 'c' both share a silhouette (frame f5)")
    assert "share" not in describe_views(ViewFaults(others={"b": (3,)}), frames)[0]
    for ratios, words in (
        ([0.61, 0.0, 0.0], ()), ([0.59, 0.59, 0.9], ("59 %",)), ([0.0], ()), ([0.3], ("30 %",))
    ):  # fmt: skip
        texts = describe_fit(ratios)
        assert len(texts) == len(words)
        assert all(word in text for word, text in zip(words, texts, strict=True))
    assert describe_rig(None) == ()
    filled = {"a": 0.5, "b": 0.25}
    for mirrored, exchanged, words in (
        ((), (), "check cameras.yaml"), (("a",), (), "of camera 'a' are mirrored"),
        ((), ("a", "b"), "of cameras 'a' and 'b' are exchanged"),
    ):  # fmt: skip
        (text,) = describe_rig(RigFault(mirrored, exchanged, filled))
        assert "(25 % of camera 'b')" in text
        assert words in text
    moved = CameraFault("a", motion(), True, ("b",), 0.8, first=3, is_left_out=True)
    text = describe_camera(moved, frames)
    assert text.startswith("camera 'a' or 'b' has moved since frame f3 after")
    for part in (
        "5.0 pixels",
        "3.0 to the left, 4.0 down, rotated by 2.0",
        "12 cm",
        "left out since",
    ):
        assert part in text
    up = SimpleNamespace(**vars(motion()) | {"shift": (3.0, -4.0)})
    text = describe_camera(CameraFault("a", up, True, (), 0.8), frames)
    assert "camera 'a' has moved after its" in text
    assert "3.0 to the right, 4.0 up" in text
    assert "it is still used" in text
    text = describe_camera(CameraFault("a", motion(), False, (), 0.8), frames)
    assert "inconsistent with the others: 40 % of its contours fit the body, 80 % of" in text
