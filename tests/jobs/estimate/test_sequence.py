from pathlib import Path

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.body_fit import _StartedSearch
from drake_pose.jobs.estimate.inputs import EstimateInputs
from drake_pose.jobs.estimate.measurements import TrueAngles
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.search import TRACKED, RootPlacementSearch
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.jobs.scenes import TinyScene, write_scene
from tests.search.turning import crane

# A crane that swings, and stands otherwise after a cut.
BEFORE = [(20 + 3 * k, -40 - 2 * k) for k in range(6)]
AFTER = [(-60 + 2 * k, -90 + 3 * k) for k in range(5)]


def write_sequence(folder: Path, text: str) -> TinyScene:
    scene = write_scene(folder, [*BEFORE, *AFTER], ("front", "side"))
    (folder / "scene.yaml").write_text(text)
    return scene


def test_a_sequence_is_matched_first_tracked_and_matched_after_a_cut(tmp_path: Path) -> None:
    scene = write_sequence(tmp_path / "scene", "sequence: true\nframe_rate_hz: 30\n")
    settings = EstimateSettings(method="paper")
    result = estimate_scene(scene.folder, scene.model, settings=settings, replay=False)
    how = [result.records[frame].stopped_by == TRACKED for frame in scene.truth]
    runs = [result.records[frame].runs for frame in scene.truth]
    # A matched frame is refined by its contour; a tracked one has asked no search.
    assert how.count(True) >= 9
    assert runs[1:6] == [0] * 5
    errors = np.degrees(
        [np.abs(one.q - scene.truth[frame]).max() for frame, one in result.records.items()]
    )
    assert errors.max() < 2.5
    assert np.median(errors) < 1.0


def test_every_frame_of_a_sequence_has_intervals_that_hold_the_truth(tmp_path: Path) -> None:
    scene = write_sequence(tmp_path / "scene", "sequence: true\nframe_rate_hz: 30\n")
    result = estimate_scene(scene.folder, scene.model, replay=False)
    names, inside = result.position_names, []
    for frame, record in result.records.items():
        assert record.family_count is not None, frame
        truth = dict(zip(names, np.degrees(scene.truth[frame]), strict=True))
        assert truth.keys() <= record.joints.keys()
        known = [
            (joint, truth[name]) for name, joint in record.joints.items() if joint["determined"]
        ]
        inside += [joint["low"] <= true <= joint["high"] for joint, true in known]
        assert all(joint["high"] - joint["low"] <= 20.0 for joint, _ in known)
    assert len(inside) >= 0.8 * len(names) * len(scene.truth)
    assert np.mean(inside) >= 0.95


def test_a_sequence_need_not_be_tracked(tmp_path: Path) -> None:
    """Unrelated stills whose scene.yaml says otherwise: as if it did not."""
    said = write_sequence(tmp_path / "said", "sequence: true\nframe_rate_hz: 30\n")
    stills = write_sequence(tmp_path / "stills", "sequence: false\n")
    found = []
    for scene, track in ((said, False), (stills, True)):
        settings = EstimateSettings(method="paper", frames=("0000", "0001"), track=track)
        result = estimate_scene(scene.folder, scene.model, settings=settings, replay=False)
        assert all(record.stopped_by != TRACKED for record in result.records.values())
        assert result.summary["settings"]["track"] is track
        found.append([record.q for record in result.records.values()])
    np.testing.assert_array_equal(found[0], found[1])


def test_how_a_scene_is_tracked(tiny_scene: TinyScene) -> None:
    model, scene = load_model(tiny_scene.model), load_scene(tiny_scene.folder)
    for search in (None, RootPlacementSearch.__new__(RootPlacementSearch)):
        assert EstimateInputs(scene, model, scene.frames, False, search, None).tracking() is None
        tracking = EstimateInputs(scene, model, scene.frames, True, search, None).tracking()
        assert tracking is not None
        assert tracking.root_moves is (search is not None)
        assert not tracking.scale_unknown


def test_an_encoder_that_has_turned_once_more_is_no_error(
    tiny_scene: TinyScene, tmp_path: Path
) -> None:
    """As a UR5: measured 331.5 degrees inside limits of 360, which looks like -28.5."""
    model, scene = crane(tmp_path), load_scene(tiny_scene.folder)
    truth = TrueAngles(tmp_path, model.position_names, {0: np.radians([178.0, 331.5])})
    inputs = EstimateInputs(scene, model, scene.frames, False, None, truth)
    errors = inputs.joint_errors("0000", np.radians([177.0, -28.0]))
    assert errors == pytest.approx({"swing": -1.0, "luff": 0.5})
    assert inputs.joint_errors("0001", np.zeros(2)) == {}


def test_a_track_goes_on_from_what_is_known_and_searches_after_a_loss() -> None:
    search, known = _StartedSearch.__new__(_StartedSearch), object()
    search.first = known
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RootPlacementSearch, "match", lambda *_: "searched")
        assert search.match([]) is known
        assert search.match([]) == "searched"
