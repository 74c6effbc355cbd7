import math
import re

import cv2
import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.papers.date import (
    PERIOD,
    TITLES,
    DateResult,
    Studio,
    active_frames,
    command_seconds,
    draw_walk,
    noisy,
    one_core,
    run_experiment,
    walk_by,
    walk_table,
)
from drake_pose.person.date.features import skin_blobs
from drake_pose.person.date.walking import (
    COMMANDS,
    MOTIONS,
    REGISTERED,
    UPRIGHT,
    WALK,
    Motion,
    make_gestures,
    make_motion,
)


def test_motion_is_inside_the_limits_on_the_floor_and_without_jumps(skeleton):
    motion, short, again = (make_motion(skeleton, frames, 3) for frames in (240, 50, 120))
    assert motion.q.shape == (240, len(skeleton.lower))
    assert (motion.q >= skeleton.lower).all()
    assert (motion.q <= skeleton.upper).all()
    assert list(dict.fromkeys(motion.names)) == [REGISTERED, *MOTIONS]
    feet = np.array([skeleton.features(q)[3:, 2].min() for q in motion.q])
    assert 0.0 < feet.min() < feet.max() < 0.4
    assert np.degrees(np.abs(np.diff(motion.q[:, 3:], axis=0))).max() < 25.0
    # Fewer frames are not faster; seeds determine the motion.
    np.testing.assert_array_equal(short.q, again.q[:50])
    assert short.names == again.names[:50]
    assert np.abs(make_motion(skeleton, 50, 2).q - short.q).max() > 0.01
    with pytest.raises(SettingsError, match="40 frames"):
        make_motion(skeleton, 39, 0)


@pytest.fixture(scope="module")
def captured(skeleton) -> DateResult:
    """The registered pose, and three frames of each of two motions, in small pictures."""
    with one_core():
        studio = Studio.build(4, (240, 180), np.random.default_rng([1, 1]))
        motion = make_motion(skeleton, 60, 1)
        rows = [0, *range(8, 11), *range(40, 43)]
        some = Motion(motion.q[rows], tuple(motion.names[k] for k in rows))
        result = DateResult(studio, some, "silhouette")
        for k in range(len(rows)):
            result.step(k)
    return result


def test_errors_are_summed_up_over_motions_and_joints(captured):
    figures, names = captured.as_json(), np.array(captured.names)
    motions = captured.motions
    assert (len(names), len(motions), REGISTERED in motions) == (7, 2, False)
    errors = {key: np.array(one) for key, one in captured.errors.items()}
    assert set(errors) == {"ik_only", "paper", "silhouette"}
    moving = names != REGISTERED
    assert figures["joint_error_mm"] == pytest.approx(errors["silhouette"][moving].mean())
    assert 1.0 < figures["joint_error_mm"] < 40.0 < figures["paper_mm"] < 300.0
    assert figures["paper_mm"] == pytest.approx(errors["paper"][moving].mean())
    percentile = np.percentile(errors["silhouette"][moving], 95)
    assert figures["joint_error_p95_mm"] == pytest.approx(percentile)
    faces = np.array(captured.face_errors)
    assert figures["face_error_deg"] == pytest.approx(faces[moving].mean())
    assert 0.0 <= faces.min() <= faces.max() < 8.0
    for motion in motions:
        own = figures["motions"][motion]
        assert own["ik_only_mm"] == pytest.approx(errors["ik_only"][names == motion].mean())
    for joint, columns in (("elbows", (0, 1)), ("knees", (2, 3))):
        assert 1.0 < figures[joint]["silhouette_mm"] < 60.0
        assert figures[joint]["paper_mm"] > 20.0
        # As found, before the model was fitted; frames that recognised the pose do not count.
        for method, ending in (("ik_only", "ik_mm"), ("paper", "mm")):
            found = np.array(captured.found_errors[method])[np.isin(names, UPRIGHT)]
            found = found[np.isfinite(found).all(axis=1)][:, columns]
            expected = found.mean() if len(found) else math.nan
            value = figures[f"{joint[:-1]}_{ending}"]
            assert value == pytest.approx(expected, nan_ok=True)
    assert 3.0 < np.nanmedian(captured.found_errors["paper"]) < 400.0
    assert (figures["frames"], figures["cameras"], figures["method"]) == (7, 4, "silhouette")
    spent = captured.milliseconds("silhouette")
    assert spent["all"] == pytest.approx(sum(spent.values()) - spent["all"])
    assert 0.5 < spent["all"] < 3000.0
    whole, *_, rate = map(float, re.findall(r"[\d.]+(?= ms| frames)", captured.costs()))
    assert rate == pytest.approx(1000.0 / whole, abs=1.0)
    shape = [(table.row_count, len(table.columns)) for table in captured.tables()]
    assert shape == [(3, len(TITLES) + 2), (3, 5)]


def test_captured_silhouettes_cover_the_person(captured):
    assert set(captured.samples) == set(captured.motions)
    for motion, (picture, true, found) in captured.samples.items():
        assert set(found) == set(captured.errors), motion
        limbs, body = found["silhouette"]
        assert np.linalg.norm(limbs - true, axis=-1).max() < 12.0
        assert 0.01 < body.mean() < 0.3
        assert body.shape == picture.shape[:2] == (180, 240)
        for u, v in true.reshape(-1, 2):
            near = body[max(0, int(v) - 6) : int(v) + 7, max(0, int(u) - 6) : int(u) + 7]
            assert near.any()


def test_noise_is_normal_and_opencv_keeps_its_threads():
    picture = np.full((300, 400, 3), 100, np.uint8)
    drawn = noisy(picture, np.random.default_rng(1)).astype(float) - 100.0
    assert (drawn.mean(), drawn.std()) == pytest.approx((0.0, 3.0), abs=0.05)
    threads = cv2.getNumThreads()
    with one_core():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == threads


def test_each_gesture_gives_its_command_and_no_other(skeleton):
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


def test_commands_are_compared_frame_by_frame():
    true = np.array([[1, 0], [1, 0], [0, 0], [0, -1], [0, 1], [-1, 0]])
    found = np.array([[1, 0], [0, 0], [1, 1], [0, -1], [0, 1], [1, 0]])
    seconds = command_seconds(true, found)
    rows = {name: np.array([*one.values()]) / PERIOD for name, one in seconds.items()}
    expected = dict(zip(COMMANDS, ([2, 3, 2], [1, 0, 0], [1, 2, 1], [1, 1, 0]), strict=True))
    assert {name: row.tolist() for name, row in rows.items()} == expected
    figures = {"same_command": 0.5, "place_error_m": 0.25, "commands": seconds}
    table = walk_table(figures)
    assert "50.0%" in str(table.title)
    assert next(iter(table.columns[2].cells)) == f"{3 * PERIOD:.2f}"


def test_view_follows_the_walker(skeleton):
    """The avatar is in the picture's middle, seen from behind, wherever it walks."""
    q, rest = make_motion(skeleton, 40, 0).q[30], np.zeros(5)
    there, elsewhere = (
        draw_walk(skeleton.model, q, pose, rest) for pose in (np.zeros(3), np.array([2.0, 3, 2]))
    )
    same = (np.abs(there.astype(int) - elsewhere) <= 8).all(axis=2)[:, 190:290]
    assert 0.1 < same.mean() < 0.9
    assert (skin_blobs(there, np.ones(there.shape[:2], bool)).areas > 20).any()


@pytest.mark.parametrize(
    ("bad", "word"), [({"method": "magic"}, "silhouette, paper"), ({"cameras": 2}, "3 or more")]
)
def test_arguments_are_checked(bad, word):
    with pytest.raises(SettingsError, match=word):
        run_experiment(**{"cameras": 4, "frames": 40, "seed": 0} | bad)
