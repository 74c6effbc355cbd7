import math

import cv2
import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.files.overlay import EXCESS_RGB, MISSING_RGB
from drake_pose.papers.date import (
    PERIOD,
    active_frames,
    draw_walk,
    run_experiment,
    run_walk_through,
    walk_by,
)
from drake_pose.papers.pictures import save_captures, save_walk
from drake_pose.person.date.features import skin_blobs
from drake_pose.person.date.walking import (
    COMMANDS,
    MOTIONS,
    REGISTERED,
    WALK,
    make_gestures,
    make_motion,
)


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

    def test_seeds_determine_the_motion(self, skeleton):
        first, again, other = (make_motion(skeleton, 60, seed).q for seed in (1, 1, 2))
        np.testing.assert_array_equal(first, again)
        assert np.abs(first - other).max() > 0.01

    def test_fewer_frames_are_not_faster(self, skeleton):
        short, whole = (make_motion(skeleton, frames, 3) for frames in (50, 120))
        np.testing.assert_array_equal(short.q, whole.q[:50])
        assert short.names == whole.names[:50]

    def test_too_few_frames(self, skeleton):
        with pytest.raises(SettingsError, match="40 frames"):
            make_motion(skeleton, 39, 0)


@pytest.mark.slow
def test_fit_to_all_silhouettes_is_more_accurate_and_pictures_are_saved(tmp_path):
    result = run_experiment(cameras=4, frames=120, seed=1, size=(480, 360))
    figures = result.as_json()
    assert figures["joint_error_mm"] < 40.0
    assert figures["face_error_deg"] < 6.0
    assert figures["paper_mm"] < figures["ik_only_mm"]
    assert figures["method"] == "silhouette"
    # The search moves elbows and knees only; errors of the paper's waist limit the knees'.
    assert figures["elbows"]["paper_mm"] < 0.7 * figures["elbows"]["ik_only_mm"]
    assert figures["elbows"]["silhouette_mm"] < 0.5 * figures["elbows"]["paper_mm"]
    assert set(figures["as_found"]) == set(MOTIONS)
    assert set(figures["motions"]) == set(MOTIONS)
    # The captured silhouette covers the person in the picture.
    for _, true, captured in result.samples.values():
        limbs, body = captured["silhouette"]
        assert np.linalg.norm(limbs - true, axis=-1).max() < 5.0
        assert 0.01 < body.mean() < 0.3
    save_captures(result, tmp_path)
    drawn = cv2.imread(str(tmp_path / "figure_07.png"))[..., ::-1]
    for colour in (MISSING_RGB, EXCESS_RGB):
        assert (drawn == colour).all(axis=-1).sum() > 1000


class TestWalkThrough:
    def test_each_gesture_gives_its_command_and_no_other(self, skeleton):
        """With the true poses; the walk integrates the rates over the commanded frames."""
        motion = make_gestures(skeleton)
        commands, poses, _ = walk_by(skeleton.model, motion.q)
        names = np.array(motion.names)
        for name, own in active_frames(commands).items():
            assert set(names[own]) == {name}
            assert own.sum() > 0.4 * (names == name).sum()
        turns, ways = commands.sum(axis=0)
        assert math.isclose(poses[-1, 2], turns * WALK.turn_rate * PERIOD, abs_tol=1e-9)
        way = poses[-1, 0] - WALK.start[0]
        np.testing.assert_allclose(way, ways * WALK.speed * PERIOD, atol=0.01)

    def test_view_follows_the_walker(self, skeleton):
        """The avatar is in the picture's middle, seen from behind, wherever it walks."""
        q, rest = make_motion(skeleton, 40, 0).q[30], np.zeros(5)
        there, elsewhere = (
            draw_walk(skeleton.model, q, pose, rest)
            for pose in (np.zeros(3), np.array([2.0, 3, 2]))
        )
        same = (np.abs(there.astype(int) - elsewhere) <= 8).all(axis=2)[:, 190:290]
        assert 0.1 < same.mean() < 0.9
        assert (skin_blobs(there, np.ones(there.shape[:2], bool)).areas > 20).any()

    @pytest.mark.slow
    def test_captured_turns_last_as_long_as_the_true_ones(self, tmp_path):
        """Only turns are compared: five small pictures do not always separate the feet."""
        figures, pictures = run_walk_through(5, 0, size=(320, 240))
        assert figures["same_command"] > 0.7
        for name in COMMANDS[:2]:
            one = figures["commands"][name]
            assert one["captured_s"] == pytest.approx(one["true_s"], abs=0.1)
        assert figures["heading_error_deg"] < 5.0
        save_walk(pictures, tmp_path)
        assert cv2.imread(str(tmp_path / "figure_08.png")).shape[0] > 4 * 240


@pytest.mark.parametrize(
    ("bad", "word"), [({"method": "magic"}, "silhouette, paper"), ({"cameras": 2}, "3 or more")]
)
def test_arguments_are_checked(bad, word):
    with pytest.raises(SettingsError, match=word):
        run_experiment(**{"cameras": 4, "frames": 40, "seed": 0} | bad)
