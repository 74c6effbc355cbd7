"""Figure 9 of Shimada et al.: two hypotheses are born, the wrong one dies of a constraint."""

import numpy as np
import pytest

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.filtering.hand import (
    FLEXIONS,
    HAND_STATE,
    LENGTHS,
    PALM,
    QUATERNION,
    SPREADS,
    HandObservation,
)
from drake_pose.filtering.kalman.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncation.couplings import model_inequalities
from drake_pose.papers.shimada_motion import ACCELERATIONS

TIP = HAND_STATE.index("flexion_13")


def true_states(frames=8):
    """(frames, n) fingers that flex in a plane through the camera, tips a little behind.

    Finger 1's last segment is 7.5 degrees beyond the image plane and turns on by 2 degrees a frame;
    it looks as if it were as much before that plane, but then its joint would bend back more and
    more beside the one before it.
    """
    x = np.zeros((frames, len(HAND_STATE)))
    roll, turn = np.pi / 4, np.pi / 6
    x[:, HAND_STATE.indices(QUATERNION)] = [
        np.cos(turn) * np.cos(roll),
        np.cos(turn) * np.sin(roll),
        np.sin(turn) * np.cos(roll),
        -np.sin(turn) * np.sin(roll),
    ]
    x[:, HAND_STATE.indices(FLEXIONS)] = np.radians(20)
    t = np.arange(frames)
    x[:, HAND_STATE.index("flexion_12")] = np.radians(19.75 + t)
    x[:, TIP] = np.radians(27.75 + t)
    x[:, HAND_STATE.indices(LENGTHS)] = np.array([62, 41, 36, 60, 40, 37]) / 1000
    x[:, HAND_STATE.indices(PALM)] = (0.07, 0.08, 0.022)
    moving = len(HAND_STATE.moving)
    x[:, moving : 2 * moving] = np.gradient(x[:, :moving], axis=0)
    return x


def first_belief(x):
    """All is known well but two joints of finger 1: what a finger hidden before looks like."""
    deviations = np.full(len(HAND_STATE), 1e-4)
    deviations[HAND_STATE.indices(QUATERNION)] = 1e-3
    deviations[HAND_STATE.indices((*SPREADS, *FLEXIONS))] = np.radians(3)
    deviations[HAND_STATE.indices(("flexion_12", "flexion_13"))] = np.radians(12)
    moving = len(HAND_STATE.moving)
    deviations[moving : 2 * moving] = np.radians(1)
    deviations[:2], deviations[moving : moving + 2] = 1.0, 1.0
    deviations[moving + 2 : moving + 6] = 1e-3
    return Belief(x, np.diag(deviations**2))


def test_two_are_born_and_the_wrong_one_dies_of_a_constraint():
    states = true_states()
    observation = HandObservation(
        point_deviation=0.05,
        angle_deviation=np.radians(0.5),
        distance_deviation=0.1,
        mirror_reach=5.0,
    )
    model = load_model(bundled_model("two_finger_hand"), check=False)
    rows = model_inequalities(model).only_of(HAND_STATE.names)
    noise = HAND_STATE.process_noise(ACCELERATIONS)
    hand_filter = TruncatedFilter(
        HAND_STATE, observation, rows, noise, FilterSettings(smallest_weight=1e-9)
    )
    generator = np.random.default_rng(0)
    state = hand_filter.start(first_belief(states[0]))
    deaths = []
    for t, x in enumerate(states):
        y = observation.predict(x)[0]
        y += np.sqrt(observation.variances) * generator.normal(size=len(y))
        state = hand_filter.update(hand_filter.predict(state) if t else state, y)
        deaths += [r for r in state.rejections if r.reason == "constraint"]
        if t == 0:
            tips = np.degrees([h.belief.mean[TIP] for h in state.hypotheses])
            assert len(tips) >= 2
            assert tips[0] == pytest.approx(27.75, abs=4)
            # The mirrored segment is as far before the image plane as the right one is beyond.
            assert np.abs(tips[1:] - (27.75 - 15)).min() < 4
    assert {r.row.split(" <=")[0] for r in deaths} == {"flexion_12 - flexion_13"}
    assert all(r.c < -4 for r in deaths)
    assert max(r.step for r in deaths) > 1
    assert np.degrees(abs(state.best.mean[TIP] - states[-1, TIP])) < 2
