"""The moving hand of Shimada's synthetic experiment: truth, measurements, first guess."""

import math
from dataclasses import dataclass

import numpy as np

from drake_pose.arrays import Array
from drake_pose.filtering.hand import (
    FLEXIONS,
    HAND_STATE,
    LENGTHS,
    MEASURED,
    SPREADS,
    HandObservation,
)
from drake_pose.filtering.hand_model import PALM, QUATERNION, WRIST
from drake_pose.filtering.state import Belief

FRAMES = 55
# What is hidden, by what is observed.
_KNUCKLES = tuple(f"point_{i}{j}_{axis}" for i in (1, 2) for j in (0, 1, 2) for axis in "xy")
_HIDDEN = {"full": (), "lines": (*_KNUCKLES, *WRIST), "lines_wrist": _KNUCKLES}
OBSERVED = tuple(_HIDDEN)
"""What is seen: everything; the fingers' axes and tips and the palm's outline; the wrist, too."""

ACCELERATIONS = {
    **dict.fromkeys(WRIST, 0.8),
    **dict.fromkeys(QUATERNION, 0.004),
    **dict.fromkeys((*SPREADS, *FLEXIONS), math.radians(0.8)),
}
"""Standard deviations of the accelerations per frame^2: [pixel], -, [rad]."""


@dataclass(frozen=True, eq=False)
class SyntheticSequence:
    """True states (55, n), measurements (55, m) with noise, NaN: hidden, and table 2's guess."""

    states: Array
    measurements: Array
    guess: Belief


def true_states(r_13: float, phase: Array, yaw_middle: float = 0.0) -> Array:
    """(55, n) a hand that moves, turns, flexes and comes closer and goes away.

    `r_13` is finger 1's last segment [mm], `phase` (6,) shifts of the swings [rad], `yaw_middle`
    about what fingers swing away from the camera [rad]; negative: towards it.
    """
    frames = np.arange(FRAMES)
    turn = 2 * np.pi * frames / FRAMES
    states = np.zeros((FRAMES, len(HAND_STATE)))

    def put(name: str, values: Array | float) -> None:
        states[:, HAND_STATE.index(name)] = values

    put("wrist_x", -50 + 30 * np.sin(turn + phase[0]))
    put("wrist_y", 20 * np.sin(1.3 * turn + phase[1]))
    # Starts seen from the back, fingers to the right; rolls about the fingers' axis, pitches, yaws.
    roll = math.radians(65) + math.radians(40) * np.sin(1.1 * turn + phase[2])
    yaw = yaw_middle + math.radians(25) * np.sin(0.9 * turn + phase[3])
    pitch = math.radians(20) * np.sin(1.2 * turn + phase[4])
    scale = 1.0 + 0.15 * np.sin(turn)
    quaternions = _product(_about("z", pitch), _product(_about("y", yaw), _about("x", roll)))
    for k, name in enumerate(QUATERNION):
        put(name, np.sqrt(scale) * quaternions[:, k])
    put("spread_1", np.radians(-10 + 5 * np.sin(turn + phase[5])))
    put("spread_2", np.radians(10 + 5 * np.sin(1.4 * turn + phase[5])))
    for i, shift in ((1, 0.0), (2, 0.5)):
        wave = np.sin(1.2 * turn + phase[5] + shift)
        put(f"flexion_{i}1", np.radians(40 + 28 * np.sin(turn + phase[4] + shift)))
        put(f"flexion_{i}2", np.radians(38 + 28 * wave))
        put(f"flexion_{i}3", np.radians(36 + 25 * np.sin(1.2 * turn + phase[5] + shift - 0.1)))
    # Table 1 holds for r_13 = 35 and 40.
    for name, length in zip(LENGTHS, (62.0, 41.0, r_13, 60.0, 40.0, 38.0), strict=True):
        put(name, length / 1000.0)
    for name, size in zip(PALM, (0.070, 0.080, 0.022), strict=True):
        put(name, size)
    moving = len(HAND_STATE.moving)
    states[:, moving : 2 * moving] = np.gradient(states[:, :moving], axis=0)
    return states


def make_sequence(
    r_13: float,
    observed: str,
    observation: HandObservation,
    generator: np.random.Generator,
    yaw_middle: float = 0.0,
) -> SyntheticSequence:
    """Draw a sequence: its motion's phases, its noise, and table 2's first guess.

    `observed` is one of ``OBSERVED``; the rest as for ``true_states``.
    """
    states = true_states(r_13, generator.uniform(-0.6, 0.6, 6), yaw_middle)
    deviations = np.sqrt(observation.variances)
    measurements = np.array([observation.predict(x)[0] for x in states])
    measurements += deviations * generator.normal(size=measurements.shape)
    # Table 2 gives the scale of the first frame, and of no other.
    measurements[1:, MEASURED.index("scale")] = np.nan
    measurements[0, MEASURED.index("scale")] = 1.0
    measurements[:, [MEASURED.index(name) for name in _HIDDEN[observed]]] = np.nan
    return SyntheticSequence(states, measurements, first_guess(states[0], generator))


def first_guess(x: Array, generator: np.random.Generator) -> Belief:
    """Table 2 around a true state: errors up to the values given there, its variances.

    The palm's rotation is an angle; the scale, 1 with variance 0, is no part of the covariance.
    """
    mean = x.copy()
    moving = len(HAND_STATE.moving)

    def shift(names: tuple[str, ...], reach: float) -> None:
        mean[HAND_STATE.indices(names)] += generator.uniform(-reach, reach, len(names))

    shift(WRIST, 5.0)
    shift((*SPREADS, *FLEXIONS), math.radians(15))
    shift((*LENGTHS, *PALM), 0.010)
    axis = generator.normal(size=3)
    axis *= math.radians(generator.uniform(-15, 15)) / np.linalg.norm(axis)
    start = HAND_STATE.indices(QUATERNION)
    half = 0.5 * np.linalg.norm(axis)
    turn = np.r_[math.cos(half), 0.5 * axis * np.sinc(half / np.pi)]
    mean[start] = _product(turn[None], x[start][None])[0] / np.linalg.norm(x[start])
    mean[moving : 2 * moving] = 0.0
    variances = np.zeros(len(mean))
    variances[HAND_STATE.indices(WRIST)] = 50.0
    variances[start] = (0.5 * math.radians(40)) ** 2
    variances[HAND_STATE.indices((*SPREADS, *FLEXIONS))] = math.radians(40) ** 2
    variances[HAND_STATE.indices((*LENGTHS, *PALM))] = 800e-6
    rates = {**dict.fromkeys(WRIST, 5.0), **dict.fromkeys(QUATERNION, 0.06)}
    for k, name in enumerate(HAND_STATE.moving):
        variances[moving + k] = rates.get(name, math.radians(5)) ** 2
    return Belief(mean, np.diag(variances))


def _about(axis: str, angles: Array) -> Array:
    quaternions = np.zeros((len(angles), 4))
    quaternions[:, 0] = np.cos(0.5 * angles)
    quaternions[:, 1 + "xyz".index(axis)] = np.sin(0.5 * angles)
    return quaternions


def _product(a: Array, b: Array) -> Array:
    """Quaternion products, row by row."""
    w, v, s, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    vector = w * u + s * v + np.cross(v, u)
    return np.hstack([w * s - np.sum(v * u, axis=1, keepdims=True), vector])
