"""Tracking of sequences, and warnings of poses and cameras that do not fit."""

import re
from pathlib import Path

import numpy as np
import pytest

from drake_pose.camera.episode import JointLog
from drake_pose.files.records import FrameRecord
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.inputs import EstimateInputs, read_inputs
from drake_pose.jobs.estimate.scene import check_track, estimate_scene
from drake_pose.search import TRACKED
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.jobs.scenes import URDF, TinyScene, camera, edit_camera, write_scene
from tests.search.arms import crane

# A swinging crane, with a cut before the last frames.
BEFORE = [(20 + 3 * k, -40 - 2 * k) for k in range(6)]
AFTER = [(-60 + 2 * k, -90 + 3 * k) for k in range(5)]


def write_sequence(folder: Path, text="sequence: true\nframe_rate_hz: 30\n") -> TinyScene:
    scene = write_scene(folder, [*BEFORE, *AFTER], ("front", "side"))
    (folder / "scene.yaml").write_text(text)
    return scene


def test_a_sequence_is_searched_then_tracked_and_searched_after_a_cut(tmp_path):
    scene = write_sequence(tmp_path / "scene")
    settings = EstimateSettings(method="paper")
    result = estimate_scene(scene.folder, scene.model, settings=settings, replay=False)
    records = [result.records[frame] for frame in scene.truth]
    # Tracked frames have no runs of the search.
    assert [one.stopped_by == TRACKED for one in records].count(True) >= 9
    assert [one.runs for one in records[1:6]] == [0] * 5
    truth = np.array(list(scene.truth.values()))
    errors = np.degrees(np.abs([one.q for one in records] - truth).max(axis=1))
    assert errors.max() < 2.5
    assert np.median(errors) < 1.0


def test_intervals_of_every_frame_contain_the_truth(tmp_path):
    scene = write_sequence(tmp_path / "scene")
    result = estimate_scene(scene.folder, scene.model, replay=False)
    inside, count = [], 0
    for frame, record in result.records.items():
        assert record.mode_count is not None, frame
        for name, truth in zip(result.position_names, scene.truth[frame], strict=True):
            joint, count = record.joints[name], count + 1
            if joint["determined"]:
                inside.append(joint["low"] <= np.degrees(truth) <= joint["high"])
                assert joint["high"] - joint["low"] <= 20.0
    assert len(inside) >= 0.8 * count
    assert np.mean(inside) >= 0.95


def test_without_track_every_frame_is_searched(tmp_path):
    """Unrelated stills that scene.yaml declares a sequence give the same poses as stills."""
    said = write_sequence(tmp_path / "said")
    stills = write_sequence(tmp_path / "stills", "sequence: false\n")
    found = []
    for scene, track in ((said, False), (stills, True)):
        settings = EstimateSettings(method="paper", frames=("0000", "0001"), track=track)
        result = estimate_scene(scene.folder, scene.model, settings=settings, replay=False)
        assert all(record.stopped_by != TRACKED for record in result.records.values())
        assert result.summary["settings"]["track"] is track
        found.append([record.q for record in result.records.values()])
    np.testing.assert_array_equal(found[0], found[1])


def test_joint_errors_are_modulo_full_turns(tiny_scene, tmp_path):
    """As for a UR5 with limits of 360 degrees: 331.5 degrees measured, -28.5 estimated."""
    model, scene = crane(tmp_path), load_scene(tiny_scene.folder)
    truth = JointLog(model.position_names, None, np.radians([[178.0, 331.5]]), ("0",))
    inputs = EstimateInputs(scene, model, scene.frames, False, None, truth)
    errors = inputs.joint_errors("0000", np.radians([177.0, -28.0]))
    assert errors == pytest.approx({"swing": -1.0, "luff": 0.5})
    assert inputs.joint_errors("0001", np.zeros(2)) == {}


ANGLES = ((20.0, -40.0), (-40.0, -80.0))


@pytest.fixture
def scene(tmp_path):
    return write_scene(tmp_path / "scene", ANGLES, ("front", "side"))


def warnings_of(scene: TinyScene, model: Path | None = None, **more: object) -> tuple[str, ...]:
    settings = EstimateSettings(**more)  # type: ignore[arg-type]
    return estimate_scene(scene.folder, model or scene.model, None, settings).warnings


def test_a_correct_scene_has_no_warning(scene):
    assert warnings_of(scene) == ()
    assert warnings_of(scene, cameras=("side",)) == ()


def test_exchanged_and_moved_cameras_are_warned_of(scene):
    masks = scene.folder / "masks"

    def exchange():
        for one, other in (("front", "other"), ("side", "front"), ("other", "side")):
            (masks / one).rename(masks / other)

    exchange()
    first, *_ = warnings_of(scene)
    assert re.match(r"cameras '(front|side)' and '(side|front)' seem to be exchanged", first)
    exchange()
    X_WC = camera("side", 20.0).X_WC.tolist()
    edit_camera(scene.folder / "cameras.yaml", "side", X_WC=X_WC)
    first, *_ = warnings_of(scene)
    assert re.match(r"camera(s 'front' and)? 'side' (is|are) inconsistent", first)


def test_a_wrong_held_joint_and_wrong_limits_are_warned_of(scene, tmp_path):
    (text,) = warnings_of(scene, hold={"lift": 80.0})
    assert "frame 0000-0001 (of 2, E_total " in text
    assert "the pose fits the pictures badly" in text
    assert "the held positions (lift)" in text
    model = tmp_path / "stiff.urdf"
    model.write_text(URDF.replace('lower="-1.6" upper="1.6"', 'lower="1.2" upper="1.6"'))
    *_, text = warnings_of(scene, model)
    assert "its limits (lift" in text


@pytest.mark.parametrize(("left", "is_told"), [(0.3, True), (0.02, False)])
def test_a_track_of_a_wrong_pose_is_warned_of(scene, left, is_told):
    """Frame 1 has a pose tracked half a radian off, with an E_total of ``left``."""
    inputs = read_inputs(scene.folder, scene.model, EstimateSettings(), None)
    wrong = np.radians(ANGLES[1]) + np.array([0.0, 0.5])
    records = {
        "0000": FrameRecord("0000", wrong, None, 0.01, 0.1, stopped_by="end"),
        "0001": FrameRecord("0001", wrong, None, left, 0.1, stopped_by=TRACKED),
    }
    texts = check_track(inputs, inputs.search, records)
    assert len(texts) == is_told
    if is_told:
        assert "frame '0001': E_total is 30.00 % by tracking" in texts[0]
        assert "with other positions of luff" in texts[0]
