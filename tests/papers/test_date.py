import math

import cv2
import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.papers.date import (
    active_frames,
    draw_walk,
    perturbed_frames,
    run_experiment,
    run_walk_through,
    save_pictures,
    save_walk,
    walk_by,
)
from drake_pose.papers.date_capture import PERIOD
from drake_pose.person.date.features import SkinColour, skin_blobs
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
        assert REGISTERED not in perturbed_frames(short).values()
        assert max(perturbed_frames(short)) < 40
        assert list(perturbed_frames(whole).values()) == [*MOTIONS, REGISTERED]

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
    assert figures["frames_to_recover"] <= 15
    assert figures["fps"] == pytest.approx(1e3 / figures["ms_per_frame"]["all"])
    assert set(figures["motions"]) == set(MOTIONS)
    names = {file.name for file in save_pictures(result, tmp_path / "new")}
    motions = {f"figure_{n}_{name}.png" for n in ("02", "03", "07") for name in MOTIONS}
    assert names == {*motions, "figure_04.png", "errors.png"}
    walk = cv2.imread(str(tmp_path / "new" / "figure_07_walk.png"))
    # The input and three estimates, each a person before the same background.
    parts = np.split(walk, 4, axis=1)
    for part in parts:
        assert (np.abs(part.astype(int) - part[0, 0]).max(axis=2) > 30).mean() > 0.01
    assert np.abs(parts[0].astype(int) - parts[3]).mean() < 3.0


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
        assert (skin_blobs(there, np.ones(there.shape[:2], bool), SkinColour()).areas > 20).any()

    @pytest.mark.slow
    def test_captured_turns_last_as_long_as_the_true_ones(self, tmp_path):
        """Only turns are compared: five small pictures do not always separate the feet."""
        figures, pictures = run_walk_through(5, size=(320, 240))
        assert figures["same_command"] > 0.7
        for name in COMMANDS[:2]:
            one = figures["commands"][name]
            assert one["captured_s"] == pytest.approx(one["true_s"], abs=0.1)
        assert figures["heading_error_deg"] < 5.0
        assert save_walk(pictures, tmp_path).name == "figure_08.png"


@pytest.mark.parametrize(
    ("bad", "word"), [({"method": "magic"}, "silhouette, paper"), ({"cameras": 2}, "3 or more")]
)
def test_arguments_are_checked(bad, word):
    with pytest.raises(SettingsError, match=word):
        run_experiment(**bad)
