"""Pictures of the papers' experiments: lines of figures, and colours of pixels."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from drake_pose.files.overlay import EXCESS_RGB, MISSING_RGB
from drake_pose.filtering.hand import HAND_STATE, HandObservation
from drake_pose.papers import pictures
from drake_pose.papers.kameda import Causes
from drake_pose.papers.shimada import CASES, HandsResult, angle_error
from drake_pose.papers.shimada_sequences import (
    HandTrack,
    RecordedHand,
    experiment_settings,
    true_states,
)
from tests.papers.hands import followed_hypotheses

OBSERVATION = HandObservation(pixels_per_metre=1000.0)


@pytest.fixture
def drawn(monkeypatch):
    """Axes of figures by the name of the file that they were saved as."""
    figures = {}
    monkeypatch.setattr(
        Figure, "savefig", lambda self, path, **_: figures.update({path: self.axes})
    )
    return figures


def lines_of(axes):
    """Return the points (n, 2) of an axes' lines."""
    return [np.column_stack(one.get_data()) for one in axes.lines]


def assert_shows(axes, title, *states):
    """Assert that axes show the fingers and palms of hands, each of two and four lines."""
    assert axes.get_title() == title
    for k, state in enumerate(states):
        lines = lines_of(axes)[6 * k : 6 * k + 6]
        np.testing.assert_allclose(np.concatenate(lines), OBSERVATION.drawing(state))


def test_hands_are_drawn_with_their_curves(tmp_path, drawn):
    states, rng = true_states(35.0, np.zeros(6)), np.random.default_rng(1)
    means, deviations = states + 0.01 * rng.normal(size=states.shape), np.abs(0.1 * states) + 0.01
    track = HandTrack((), np.zeros(55), states, kept={23: np.ones((40, 60), bool)})
    vars(track).update(means=means, deviations=deviations)
    result = HandsResult({key: (track,) for key in CASES}, 0, experiment_settings(), "lines")
    pictures.save_hands(result, tmp_path / "new")
    assert {path.stem for path in drawn} == set(CASES)
    first, seen, last, *curves = drawn[tmp_path / "new" / "r13_35.png"]
    assert_shows(first, "t = 8", states[7], means[7])
    assert_shows(seen, "t = 24", means[23])
    assert_shows(last, "t = 40", states[39], means[39])
    assert [np.diff(axes.get_ylim()) < 0 for axes in (first, seen, last)] == [True] * 3
    assert seen.images[0].get_extent() == [-30.0, 30.0, 20.0, -20.0]
    for axes, name, factor in zip(curves, ("palm_qx", "flexion_13", "length_13"),
                                  (1.0, 180.0 / np.pi, 1000.0), strict=True):  # fmt: skip
        k = HAND_STATE.index(name)
        estimate, *_, true = lines_of(axes)
        np.testing.assert_allclose(estimate[:, 1], factor * means[:, k])
        np.testing.assert_allclose(true, np.column_stack([range(1, 56), factor * states[:, k]]))
        ends = np.array([segment[:, 1] for segment in axes.collections[0].get_segments()])
        np.testing.assert_allclose(np.ptp(ends, axis=1), 4.0 * factor * deviations[:, k])
    kept = {2: np.ones((4, 6), bool), 9: np.zeros((4, 6), bool), 17: np.ones((4, 6), bool)}
    pictures.save_recorded_hand(RecordedHand("wave", {}, OBSERVATION, means, kept), tmp_path)
    for axes, frame in zip(drawn[tmp_path / "figure_17_wave.png"], kept, strict=True):
        assert_shows(axes, f"frame {frame + 1}", means[frame])
        assert len(axes.images) == 1


def test_rejected_hypotheses_are_drawn_beside_their_survivor(tmp_path, drawn):
    found = followed_hypotheses()
    removed, survivor = found.example()
    assert (removed.wrong, removed.reason, removed.lived > 1) == (True, "constraint", True)
    assert survivor.run == removed.run
    assert survivor.frames[0] < removed.frames[-1] < survivor.frames[-1]
    end, truths = int(removed.frames[-1]), found.sequences[removed.run].states
    off = [angle_error(one.at(end), truths[end - 1]) for one in (survivor, removed)]
    assert off[0] < off[1]
    assert pictures.save_hypotheses(found, tmp_path)
    first, last, angles, weights = drawn[tmp_path / "figure_09.png"]
    begin = max(int(removed.frames[0]), int(survivor.frames[0]))
    for axes, frame in ((first, begin), (last, end - 1)):
        hands = truths[frame - 1], survivor.at(frame), removed.at(frame)
        assert_shows(axes, f"t = {frame}", *hands)
    k = np.abs(removed.at(begin) - survivor.at(begin))[6:14].argmax() + 6
    assert angles.get_ylabel() == f"{HAND_STATE.names[k]} [deg]"
    true, rejected, kept = lines_of(angles)
    np.testing.assert_allclose(true[:, 1], np.degrees(truths[removed.frames - 1, k]))
    np.testing.assert_allclose(rejected[:, 1], np.degrees(removed.means[:, k]))
    assert kept[-1, 0] == rejected[-1, 0] == end
    np.testing.assert_allclose(lines_of(weights)[0][:-1, 1], removed.weights[:-1])
    assert not pictures.save_hypotheses(SimpleNamespace(example=lambda: None), tmp_path)


def test_captured_limbs_are_open_and_trunks_closed(tmp_path, monkeypatch):
    """The true skeleton is under the estimate's, here 6 pixels lower."""
    drawn = []
    monkeypatch.setattr(pictures, "draw_overlay", lambda one, *_: drawn.append(one) or one)
    # The roots of both arms, then of both legs; limbs go outwards, then down.
    limbs = np.array([
        [[u, v], [u + 40 * s, v], [u + 40 * s, v + 40]]
        for u, v, s in ((60, 60, -1), (140, 60, 1), (60, 160, -1), (140, 160, 1))
    ], float)  # fmt: skip
    body, picture = np.zeros((240, 200), bool), np.full((240, 200, 3), 128, np.uint8)
    samples = {"walk": (picture, limbs, {"silhouette": (limbs + np.array([0.0, 6.0]), body)})}
    pictures.save_captures(SimpleNamespace(samples=samples), tmp_path)
    for by, colour in ((0, MISSING_RGB), (6, EXCESS_RGB)):
        for u, v in ((100, 60), (100, 160), (40, 60), (160, 160), (140, 110), (60, 110)):
            # Sides of the trunk overlap: the estimate's are above.
            assert (drawn[0][v + by, u] == (EXCESS_RGB if v == 110 else colour)).all()
        # No line leads back from a limb's end to its root.
        assert (drawn[0][83 + by, 37] == 128).all()


def test_outcomes_sort_poses():
    found, lost = (SimpleNamespace(found=one) for one in (True, False))
    usual = {"pose_equal": False, "causes": None, "improved": False, "exact": True, "result": found}
    for changes, kinds in (
        ({}, []), ({"pose_equal": True}, ["07"]), ({"causes": Causes(True, False)}, ["08"]),
        ({"causes": Causes(False, True)}, ["09"]), ({"causes": Causes(False, False)}, []),
        ({"improved": True}, ["10"]), ({"exact": False}, ["12"]),
        ({"exact": False, "result": lost}, []),
    ):  # fmt: skip
        one = SimpleNamespace(**(usual | changes))
        assert [name[7:9] for name, is_kind in pictures.OUTCOMES.items() if is_kind(one)] == kinds
