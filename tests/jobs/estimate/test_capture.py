import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import ModelError, SceneError, SettingsError
from drake_pose.files.settings import EstimateSettings
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.jobs.estimate import inputs, person
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.person.capture import CheckedCapture, PersonCapture
from drake_pose.person.figures import ViewFaults
from tests.cli import run_to_end
from tests.jobs.scenes import read_rows, run_estimate, write_masks
from tests.person.persons_in_view import posed

FRAMES = 3
FILES = {
    "joint_centres.csv", "joint_centres.trc", "joints.csv", "poses.csv",
    "positions.mot", "report.html", "summary.json",
}  # fmt: skip


@dataclass(frozen=True)
class PersonScene:
    """A scene's folder, its model, and the true positions (frames, nq)."""

    folder: Path
    person: ArticulatedModel
    truth: np.ndarray

    def estimate(self, out: Path, command: str = "estimate") -> list[str]:
        """Return the words of an estimate or capture command."""
        model = str(self.person.path)
        return [command, str(self.folder), "--model", model, "--out", str(out), "--no-replay"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording of a person who raises an arm; shared, do not change it."""
    folder = tmp_path_factory.mktemp("person")
    person = load_model(bundled_model("person"), check=False)
    cameras = circle_of_cameras(4, size=(160, 120), face_camera=False)
    save_cameras(folder / "cameras.yaml", cameras)
    (folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
    arms = [(30.0 + 10.0 * k, -30.0) for k in range(FRAMES)]
    truth = np.array([posed(person, left_upper_arm_z=a, right_upper_arm_z=b) for a, b in arms])
    write_masks(folder, person, cameras.values(), truth)
    return PersonScene(folder, person, truth)


@pytest.fixture
def own_recording(recording, tmp_path):
    """A copy that may be changed."""
    shutil.copytree(recording.folder, tmp_path / "scene")
    return PersonScene(tmp_path / "scene", recording.person, recording.truth)


@pytest.fixture
def known(recording, monkeypatch):
    """Replace the capture, which takes seconds, by the truth; return the numbers of frames."""
    counts: list[int] = []

    def capture(tree, cameras, read, count, settings, on_frame):
        counts.append(count)
        q = recording.truth[:count].copy()
        for k in [*range(count), *range(count)]:
            read(k)
        for k in range(count):
            on_frame(k)
        captured = PersonCapture(
            q=q, inlier_ratios=np.ones(count), shape=None, outlines=ContourFit(tree).outlines,
            tree=tree, deviations=np.full_like(q, 0.01),
        )  # fmt: skip
        return CheckedCapture(captured, ViewFaults(), (), None, read)

    monkeypatch.setattr("drake_pose.jobs.estimate.person.capture_checked", capture)
    return counts


def test_stages_are_reported(recording, known):
    stages: list[tuple[str, int]] = []
    estimate_scene(
        recording.folder, recording.person.path, replay=False,
        on_stage=lambda stage, done, _: stages.append((stage, done)),
    )  # fmt: skip
    names = ("reading", "finding and measuring the person", "tracking")
    assert stages == [(name, k) for name in names for k in range(1, 1 + FRAMES)]


def test_estimate_chooses_the_method_person_and_says_so(recording, known, out):
    result, summary = run_estimate(recording, out)
    assert "Pose found in 3 of 3 frames" in result.stdout
    assert known == [FRAMES]
    assert {path.name for path in out.iterdir()} == FILES | {"overlay"}
    assert summary["complete"] is True
    assert summary["method"] == "person"
    assert summary["cameras"]["camera_3"]["frames"] == FRAMES
    # The masks agree with the truth, which replaces the capture.
    assert summary["mean_iou"] > 0.94
    assert {path.parent.name for path in out.glob("overlay/*/*.png")} == set(summary["cameras"])
    assert len(list(out.glob("overlay/*/*.png"))) == 4 * FRAMES
    # 95 % intervals from standard deviations end at limits.
    joints = {(row["frame"], row["joint"]): row for row in read_rows(out / "joints.csv")}
    row, half = joints["0001", "left_upper_arm_z"], np.degrees(1.96 * 0.01)
    assert float(row["low"]) == pytest.approx(40.0 - half, abs=1e-3)
    assert float(row["high"]) == pytest.approx(40.0 + half, abs=1e-3)
    assert row["determined"] == "yes"
    assert float(joints["0001", "left_forearm_x"]["high"]) == 0.0


def test_an_equally_good_pose_is_written_and_named_in_a_warning(recording, known, out, monkeypatch):
    follow = person.capture_checked

    def doubtful(*given):
        checked = follow(*given)
        other = recording.truth[1].copy()
        other[recording.person.position_index("left_upper_arm_z")] += np.radians(60.0)
        checked.captured.alternatives[1] = ((other, np.full(len(other), 0.01)),)
        return checked

    monkeypatch.setattr(person, "capture_checked", doubtful)
    _, summary = run_estimate(recording, out)
    (warning,) = [text for text in summary["warnings"] if "equally well" in text]
    assert "frame 0001" in warning
    assert "left_wrist" in warning
    assert "right" not in warning
    modes, joints = (
        [row for row in read_rows(out / file) if row["joint"] == "left_upper_arm_z"]
        for file in ("modes.csv", "joints.csv")
    )
    found = {row["mode"]: float(row["value"]) for row in modes}
    assert found == pytest.approx({"1": 40.0, "2": 100.0}, abs=1e-3)
    (row,) = (row for row in joints if row["frame"] == "0001")
    assert float(row["low"]) < 40.0 < 100.0 < float(row["high"])
    assert row["modes"] == "2"


def test_capture_is_an_estimate_of_a_sequence_unless_the_scene_says_otherwise(
    own_recording, known, tmp_path
):
    """It selects cameras and frames as an estimate does."""
    own_recording.folder.joinpath("scene.yaml").unlink()
    some = ("--frame", "0:1", "--camera", "camera_0", "--camera", "camera_2", "--no-overlay")
    for said in ("motion", "stills"):
        out = tmp_path / said
        run_to_end(*own_recording.estimate(out, "capture"), *some)
        summary = json.loads((out / "summary.json").read_text())
        assert list(summary["frames"]) == ["0000", "0001"]
        assert set(summary["cameras"]) == {"camera_0", "camera_2"}
        assert (out / "positions.mot").exists() == (said == "motion")
        assert len(read_rows(out / "joint_centres.csv")) == 2 * 14
        own_recording.folder.joinpath("scene.yaml").write_text("sequence: false\n")


def test_capture_uses_the_bundled_person(recording, out, monkeypatch):
    asked = {}

    def note(scene, model, out, settings, **options):
        asked.update(options, model=model, settings=settings)

    monkeypatch.setattr("drake_pose.commands.estimate.estimate", note)
    run_to_end("capture", recording.folder, "--out", out, "--no-overlay", "--frame", "1")
    assert asked["model"].name == "person_shape.urdf"
    assert asked["settings"] == EstimateSettings(method="person", frames=("1",))
    assert asked["overlay"] is False


def test_an_interrupted_capture_is_incomplete_and_resumes_without_loss(recording, known, out):
    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drake_pose.jobs.estimate.person.capture_checked", interrupt)
        result, summary = run_estimate(recording, out, "--frame", "0", status=1)
        assert "--resume" in result.stderr
        assert summary["complete"] is False
        assert read_rows(out / "poses.csv") == []
        assert not (out / "report.html").exists()
    for frames, finished, asked in (
        ("0", ["0000"], [1]),
        ("1:2", ["0000", "0001", "0002"], [1, FRAMES]),
        # No frame is missing.
        ("0:2", ["0000", "0001", "0002"], [1, FRAMES]),
    ):
        _, summary = run_estimate(recording, out, "--resume", "--frame", frames)
        assert summary["complete"] is True
        assert [row["frame"] for row in read_rows(out / "poses.csv")] == finished
        assert known == asked


@pytest.mark.parametrize(
    "more",
    [
        {"method": "beam"}, {"cameras": ("camera_0",)}, {"hold": {"left_forearm_x": -20.0}},
        {"root": "left_foot", "root_position": (0.0, 0.0, 0.0)},
    ],
)  # fmt: skip
def test_options_of_the_search_choose_the_search(recording, more, monkeypatch):
    monkeypatch.setattr(inputs, "make_tree", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        estimate_scene(recording.folder, recording.person.path, settings=EstimateSettings(**more))


def test_pictures_with_few_masks_are_refused(own_recording):
    folder = own_recording.folder
    for mask in sorted(folder.glob("masks/*/*.png")):
        picture = folder / "images" / mask.parent.name / mask.name
        picture.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(mask, picture)
        if mask.stem != "0000" and mask.parent.name != "camera_0":
            mask.unlink()
    for settings in (EstimateSettings(), EstimateSettings(start=folder / "start.csv")):
        with pytest.raises(SceneError, match=r"frame 0001-0002 has pictures, but masks of fewer"):
            estimate_scene(folder, own_recording.person.path, None, settings)


def test_scenes_and_options_unfit_for_the_method_person_are_refused(recording, out):
    person, alone = recording.person.path, {"cameras": ("camera_0",)}
    for model, more, error, words in (
        (person, {"hold": {"head_y": 1.0}}, SettingsError, "leave hold out"),
        (person, {"start": Path("start.csv")}, SettingsError, "leave start out"),
        (bundled_model("hand"), {}, ModelError, r"left_ankle.*landmarks\.yaml"),
        (person, alone, SceneError, "two or more calibrated cameras"),
    ):
        with pytest.raises(error, match=words):
            estimate_scene(recording.folder, model, out, EstimateSettings(method="person", **more))
    assert not out.exists()
