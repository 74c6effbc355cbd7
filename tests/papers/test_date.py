import cv2
import numpy as np
import pytest

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.errors import SettingsError
from drake_pose.papers.date import frames_of_destruction, run_experiment
from drake_pose.papers.date_pictures import save_pictures
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.person.date.walking_motion import MOTIONS, REGISTERED, make_motion

KEYS = {
    "joint_error_mm",
    "joint_error_p95_mm",
    "ik_only_mm",
    "paper_mm",
    "face_error_deg",
    "frames_to_recover",
    "ms_per_frame",
    "fps",
}


@pytest.fixture(scope="module")
def skeleton():
    return load_skeleton(load_model(bundled_model("person"), check=False))


@pytest.fixture(scope="module")
def result():
    return run_experiment(cameras=4, frames=120, seed=1, size=(480, 360))


class TestMotion:
    def test_motion_is_inside_the_limits_on_the_floor_and_without_jumps(self, skeleton):
        motion = make_motion(skeleton, 240, 3)
        assert motion.q.shape == (240, len(skeleton.lower))
        assert (motion.q >= skeleton.lower).all()
        assert (motion.q <= skeleton.upper).all()
        assert list(dict.fromkeys(motion.names)) == [REGISTERED, *MOTIONS]
        feet = np.array([skeleton.features(q)[3:, 2].min() for q in motion.q])
        assert feet.min() > 0.0
        assert feet.max() < 0.4
        assert np.degrees(np.abs(np.diff(motion.q[:, 3:], axis=0))).max() < 25.0

    def test_other_seed_other_motion(self, skeleton):
        first, again, other = (make_motion(skeleton, 60, seed).q for seed in (1, 1, 2))
        np.testing.assert_array_equal(first, again)
        assert np.abs(first - other).max() > 0.01

    def test_fewer_frames_are_not_faster(self, skeleton):
        short, whole = (make_motion(skeleton, frames, 3) for frames in (50, 120))
        np.testing.assert_array_equal(short.q, whole.q[:50])
        assert short.names == whole.names[:50]
        assert REGISTERED not in frames_of_destruction(short).values()
        assert max(frames_of_destruction(short)) < 40
        assert list(frames_of_destruction(whole).values()) == [*MOTIONS, REGISTERED]

    def test_too_few_frames(self, skeleton):
        with pytest.raises(SettingsError, match="40 frames"):
            make_motion(skeleton, 39, 0)


@pytest.mark.slow
class TestExperiment:
    def test_figures(self, result):
        figures = result.as_json()
        assert set(figures) >= KEYS
        assert figures["joint_error_mm"] < 40.0
        assert figures["face_error_deg"] < 6.0
        assert figures["paper_mm"] < figures["ik_only_mm"]
        # The search moves elbows and knees alone; the paper's waist holds the knees back.
        assert figures["elbows"]["paper_mm"] < 0.7 * figures["elbows"]["ik_only_mm"]
        assert set(figures["knees"]) == {"ik_only_mm", "paper_mm", "silhouette_mm"}
        assert figures["frames_to_recover"] is not None
        assert figures["frames_to_recover"] <= 15
        assert figures["fps"] == pytest.approx(1e3 / figures["ms_per_frame"]["all"])
        assert set(figures["motions"]) == set(MOTIONS)

    def test_pictures(self, result, tmp_path):
        files = save_pictures(result, tmp_path / "new")
        names = {file.name for file in files}
        assert names == {
            *(f"figure_{number}_{name}.png" for number in ("02", "03", "07") for name in MOTIONS),
            "figure_04.png",
            "errors.png",
        }
        walk = cv2.imread(str(tmp_path / "new" / "figure_07_walk.png"))
        # The input and three estimates, all of which show a person before the same background.
        parts = np.split(walk, 4, axis=1)
        for part in parts:
            assert (np.abs(part.astype(int) - part[0, 0]).max(axis=2) > 30).mean() > 0.01
        assert np.abs(parts[0].astype(int) - parts[3]).mean() < 3.0


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        ({"method": "magic"}, "silhouette, paper"),
        ({"waist": "magic"}, "reach, person, paper"),
        ({"search": "magic"}, "surfaces, rectangles"),
        ({"cameras": 2}, "3 or more"),
    ],
)
def test_arguments_are_checked(bad, word):
    with pytest.raises(SettingsError, match=word):
        run_experiment(**bad)
