"""Benchmark of the truncated filter on a custom system (``python -m tests.benchmarks.filters``).

A planar arm has three links of unknown length and joints with limits. A camera measures elbow and
tip, or elbow, wrist and tip, with noise. 16 arms move for 120 frames by the filter's motion model
and stay within their limits. Arguments: [FIRST seed [number of ARMS]].
"""

import sys
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from drake_pose.filtering.inequalities import from_bounds
from drake_pose.filtering.motion import LinearMotion, constant_velocity
from drake_pose.filtering.state import Belief, StateLayout
from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.filtering.update import FunctionObservation
from tests.benchmarks.tables import print_table

JOINTS, LINKS = ("shoulder", "elbow", "wrist"), ("upper", "fore", "hand")
LAYOUT = StateLayout(JOINTS, LINKS)
LIMITS = from_bounds((*JOINTS, *LINKS), [-1.5, 0, 0, 0.1, 0.1, 0.1], [1.5, 2.4, 1.6, 0.5, 0.5, 0.5])
"""Limits of the angles [rad] and the lengths [m]."""

OBSERVED = {"elbow, tip": (1, 3), "elbow, wrist, tip": (1, 2, 3)}
PERIOD, FRAMES, ARMS = 1 / 30, 120, 16
USUAL, RELATIVE_DEVIATION = np.array([0.30, 0.25, 0.20]), 0.2
"""Prior mean of the lengths [m], and its relative standard deviation."""

RATE_CHANGE, NOISE, ANGLE, RATE = 0.75, 0.02, 0.3, 0.5
"""Standard deviations: change of rates in a second [rad/s], measured points [m], initial angles
[rad] and initial rates [rad/s]."""


class Run(NamedTuple):
    """True states (frames, 9), measurements (frames, m), and the initial belief."""

    states: np.ndarray
    measured: np.ndarray
    initial: Belief


class Found(NamedTuple):
    """Means (frames, 9) and covariances (frames, 9, 9)."""

    means: np.ndarray
    covariances: np.ndarray


Filter = Callable[[FunctionObservation, LinearMotion, Run], Found]


def link_ends(x: np.ndarray, ends: tuple[int, ...]) -> np.ndarray:
    """Return (2 k,) the ends of links [m] at a state (9,)."""
    angles, lengths = np.cumsum(x[:3]), x[6:]
    steps = lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.cumsum(steps, axis=0)[np.array(ends) - 1].ravel()


def link_ends_jacobian(x: np.ndarray, ends: tuple[int, ...]) -> np.ndarray:
    """Return (2 k, 9) the Jacobian of ``link_ends``."""
    angles, lengths = np.cumsum(x[:3]), x[6:]
    along = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    across = lengths[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=1)
    J = np.zeros((len(ends), 2, 9))
    for row, end in enumerate(ends):
        for joint in range(end):
            J[row, :, joint] = across[joint:end].sum(axis=0)
            J[row, :, 6 + joint] = along[joint]
    return J.reshape(-1, 9)


def observe(ends: tuple[int, ...]) -> FunctionObservation:
    """Return the observation of these links' ends, with noise."""
    names = tuple(f"{('elbow', 'wrist', 'tip')[end - 1]}_{axis}" for end in ends for axis in "xy")
    return FunctionObservation(
        names, NOISE, lambda x: link_ends(x, ends), lambda x: link_ends_jacobian(x, ends)
    )


def motion() -> LinearMotion:
    """Return the motion model of the arms and the filters."""
    return constant_velocity(LAYOUT, dict.fromkeys(JOINTS, RATE_CHANGE), PERIOD)


def draw_run(seed: int, ends: tuple[int, ...]) -> Run:
    """Simulate an arm within its limits; joint motions that would leave them are redrawn."""
    rng, step = np.random.default_rng([seed, len(ends)]), motion()
    low, high = -LIMITS.b[::2], LIMITS.b[1::2]
    states = np.zeros((FRAMES, 9))
    states[:, 6:] = np.clip(
        USUAL * (1 + RELATIVE_DEVIATION * rng.normal(size=3)), low[3:], high[3:]
    )
    for joint in range(3):
        pair = [joint, 3 + joint]
        A, root = (
            step.transition[np.ix_(pair, pair)],
            np.linalg.cholesky(step.noise[np.ix_(pair, pair)]),
        )
        while True:
            path = [np.array([rng.uniform(low[joint], high[joint]), RATE * rng.normal()])]
            while len(path) < FRAMES and low[joint] <= path[-1][0] <= high[joint]:
                path.append(A @ path[-1] + root @ rng.normal(size=2))
            if len(path) == FRAMES and low[joint] <= path[-1][0] <= high[joint]:
                break
        states[:, pair] = path
    true = np.array([link_ends(x, ends) for x in states])
    measured = true + NOISE * rng.normal(size=true.shape)
    first = np.clip(states[0, :3] + ANGLE * rng.normal(size=3), low[:3], high[:3])
    deviations = np.r_[np.full(3, ANGLE), np.full(3, RATE), RELATIVE_DEVIATION * USUAL]
    initial = Belief(np.r_[first, np.zeros(3), USUAL], np.diag(deviations**2))
    return Run(states, measured, initial)


def ours(settings: FilterSettings) -> Filter:
    """Return the truncated filter."""

    def follow(observation: FunctionObservation, step: LinearMotion, run: Run) -> Found:
        belief_filter = TruncatedFilter(LAYOUT, observation, LIMITS, step, settings)
        state, beliefs = belief_filter.start(run.initial), []
        for t, y in enumerate(run.measured):
            state = belief_filter.update(belief_filter.predict(state) if t else state, y)
            beliefs.append(state.best)
        return Found(
            np.array([one.mean for one in beliefs]), np.array([one.covariance for one in beliefs])
        )

    return follow


def clipped_ekf(observation: FunctionObservation, step: LinearMotion, run: Run) -> Found:
    """An extended Kalman filter whose mean is clipped to the limits."""
    low, high = np.full(9, -np.inf), np.full(9, np.inf)
    limited = LAYOUT.indices(LIMITS.columns)
    low[limited], high[limited] = -LIMITS.b[::2], LIMITS.b[1::2]
    x, P, R = run.initial.mean, run.initial.covariance, np.diag(observation.variances)
    means, covariances = [], []
    for t, y in enumerate(run.measured):
        if t:
            x, P = step.transition @ x, step.transition @ P @ step.transition.T + step.noise
        h, H = observation.predict(x)
        gain = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        x, left = np.clip(x + gain @ (y - h), low, high), np.eye(9) - gain @ H
        P = left @ P @ left.T + gain @ R @ gain.T
        means.append(x)
        covariances.append(P)
    return Found(np.array(means), np.array(covariances))


def evaluate(found: Found, run: Run) -> tuple[float, float, float]:
    """Return mean squares of angle errors [deg^2] and final length errors [mm^2], and NEES / 9."""
    error = found.means - run.states
    nees = np.einsum(
        "ti,ti->t", error, np.linalg.solve(found.covariances, error[..., None])[..., 0]
    )
    angles, lengths = np.degrees(error[:, :3]), 1e3 * error[-1, 6:]
    return float(np.mean(angles**2)), float(np.mean(lengths**2)), float(nees.mean() / 9)


FILTERS: dict[str, Filter] = {
    "ours, defaults": ours(FilterSettings()),
    "ours, tangents, once": ours(FilterSettings(linearisation="tangent")),
    "ours, tangents, 20 times": ours(FilterSettings(linearisation="tangent", iterations=20)),
    "plain EKF, clipped to the limits": clipped_ekf,
}


def measure(follow: Filter, ends: tuple[int, ...], seeds: range) -> tuple[float, ...]:
    """Return RMS of angles [deg] and final lengths [mm], NEES per unknown, and ms per update."""
    runs, observation, step = [draw_run(seed, ends) for seed in seeds], observe(ends), motion()
    begun = time.perf_counter()
    found = [follow(observation, step, run) for run in runs]
    cost = 1e3 * (time.perf_counter() - begun) / (len(runs) * FRAMES)
    squares = np.mean([evaluate(one, run) for one, run in zip(found, runs, strict=True)], axis=0)
    return float(squares[0] ** 0.5), float(squares[1] ** 0.5), float(squares[2]), cost


def rows(seeds: range) -> Iterator[tuple[str, ...]]:
    """Yield each filter's figures for both observations."""
    for name, follow in FILTERS.items():
        cells = [name]
        for ends in OBSERVED.values():
            angle, length, nees, cost = measure(follow, ends, seeds)
            cells += [f"{angle:.1f}", f"{length:.1f}", f"{nees:.2f}", f"{cost:.2f}"]
        yield tuple(cells)


if __name__ == "__main__":
    first, arms = (int(word) for word in [*sys.argv[1:], *["0", str(ARMS)][len(sys.argv) - 1 :]])
    seeds = range(first, first + arms)
    figures = ("deg", "mm", "NEES", "ms") * len(OBSERVED)
    title = f"Angles, lengths at the end, NEES of a degree of freedom: {' | '.join(OBSERVED)} seen"
    print_table(f"{title}; seeds {first} to {seeds[-1]}", ("filter", *figures), rows(seeds))
