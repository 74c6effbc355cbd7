"""Shimada's synthetic experiment: a two-finger hand, 55 frames, lengths learned from one camera."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.special import chdtri

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import (
    FLEXIONS,
    HAND_STATE,
    LENGTHS,
    SPREADS,
    HandObservation,
)
from drake_pose.filtering.kalman.truncated_filter import FilterSettings, TruncatedFilter, Truncation
from drake_pose.filtering.kalman.update import make_evidence, update
from drake_pose.filtering.truncation.couplings import model_inequalities
from drake_pose.papers.shimada_motion import (
    ACCELERATIONS,
    FRAMES,
    OBSERVED,
    SyntheticSequence,
    make_sequence,
)
from drake_pose.papers.tables import Count, figure_table, require_choice, require_counts, uncounted

Array = NDArray[np.float64]

CASES = {"r13_35": 35.0, "r13_40": 40.0}
"""The two true lengths of finger 1's last segment [pixel at scale 1, mm]."""

PIXELS_PER_METRE = 1000.0
LOST_ANGLE_ERROR = 20.0
"""A sequence is lost that ends with a larger error of its joint angles [deg]."""

_LOST_LENGTH_ERROR = 5.0
_LENGTHS = HAND_STATE.indices(LENGTHS)
_R_13 = HAND_STATE.index("length_13")
_ANGLES = HAND_STATE.indices((*SPREADS, *FLEXIONS))
_ROWS = {
    "length_error_mean": ("length error, mean [pixel]", "{:.2f}"),
    "length_error_p95": ("  95th percentile", "{:.2f}"),
    "bound_length_error_mean": ("  linearised at the truth (a bound)", "{:.2f}"),
    "angle_rmse": ("joint angles over all frames, RMS error [deg]", "{:.2f}"),
    "angle_rmse_at_end": ("  at the end", "{:.2f}"),
    "inside_2sigma": ("truths within 2 sigma", "{:.1%}"),
    "nees_inside": ("runs with the lengths' NEES in its 95 % band", "{:.1%}"),
    "ms_per_update": ("milliseconds an update, median", "{:.2f}"),
    "lost": ("lost", "{}"),
}


class Trial(NamedTuple):
    """One sequence, filtered.

    Attributes:
        means, deviations: (55, n) of the best hypothesis after each frame.
        covariance: (n, n) of the last.
        milliseconds: (55,) of the processor for prediction and update; nan once it broke down.
        bound: (n,) deviations at the end of a filter linearised at the truth, without limits.
    """

    sequence: SyntheticSequence
    means: Array
    deviations: Array
    covariance: Array
    milliseconds: Array
    bound: Array


@dataclass(frozen=True)
class ExperimentResult:
    """All runs, by the keys of ``CASES``."""

    trials: Mapping[str, tuple[Trial, ...]]
    seed: int
    settings: FilterSettings
    observed: str

    def as_json(self) -> dict[str, object]:
        """The figures over the runs of each case, and how they were made."""
        return {
            **{key: _figures(case) for key, case in self.trials.items()},
            "runs": len(next(iter(self.trials.values()))),
            "seed": self.seed,
            "truncation": self.settings.truncation,
            "iterations": self.settings.iterations,
            "observed": self.observed,
        }


def result_table(*results: ExperimentResult) -> Table:
    """The figures of both cases side by side, of one result or of several truncations."""
    first = results[0]
    one = len(results) == 1
    which = f"{first.settings.truncation} truncation" if one else "all truncations"
    more = f", linearisations: {first.settings.iterations} at most" if one else ""
    return figure_table(
        f"Shimada, synthetic hand: {which}, {first.observed} observation{more}",
        _ROWS,
        {
            key if one else f"{result.settings.truncation}\n{key}": _figures(case)
            for result in results
            for key, case in result.trials.items()
        },
        "figure (at t = 55 where nothing is said)",
    )


def run_experiment(
    runs: int = 50,
    seed: int = 0,
    truncation: str = "joint",
    observed: str = "lines",
    count: Count = uncounted,
    iterations: int | None = None,
) -> ExperimentResult:
    """Run the synthetic experiment of section 6 for r_13 = 35 and r_13 = 40.

    Motion and noise, which the paper does not give, are drawn: 0.5 pixel for points, 1 pixel and
    1 degree for lines.

    Args:
        runs: of each case.
        seed: another one draws other motions, noise and first guesses.
        truncation: "joint", "sequential" (the paper's), "clip" or "none".
        observed: "lines": knuckles hidden, as in the paper; or "full".
        iterations: linearisations of an update at most; 1 is the paper's filter, None the default.

    Raises:
        SettingsError: if an argument is not one of these.
    """
    require_counts(runs=runs)
    require_choice("observed", observed, OBSERVED)
    settings = experiment_settings(truncation, iterations)
    hand_filter, observation = experiment_filter(settings)
    # The first call of compiled code loads it, which belongs to no update.
    _filter_sequence(
        hand_filter, make_sequence(35.0, observed, observation, _generator(seed, 0, 35.0))
    )
    advance = count(f"sequences, {truncation} truncation", runs * len(CASES))
    trials = {}
    for place, (key, r_13) in enumerate(CASES.items()):
        case = []
        for run in range(runs):
            sequence = make_sequence(r_13, observed, observation, _generator(seed, run, r_13))
            case.append(_filter_sequence(hand_filter, sequence))
            advance(place * runs + run + 1)
        trials[key] = tuple(case)
    return ExperimentResult(trials, seed, settings, observed)


def experiment_settings(truncation: str, iterations: int | None = None) -> FilterSettings:
    """The library's own settings, but for these; SettingsError where they are impossible."""
    settings = FilterSettings(truncation=cast(Truncation, truncation))
    return settings if iterations is None else replace(settings, iterations=iterations)


def experiment_filter(
    settings: FilterSettings | None = None,
) -> tuple[TruncatedFilter, HandObservation]:
    """The filter of the experiment: table 1's rows from the bundled hand, and its observation."""
    model = load_model(bundled_model("two_finger_hand"), check=False)
    rows = model_inequalities(model).only_of(HAND_STATE.names)
    observation = HandObservation(pixels_per_metre=PIXELS_PER_METRE)
    noise = HAND_STATE.process_noise(ACCELERATIONS)
    return TruncatedFilter(HAND_STATE, observation, rows, noise, settings), observation


def angle_error(means: Array, truths: Array) -> Array:
    """Root mean square error [deg] of the joint angles of states (..., n)."""
    errors = (means - truths)[..., _ANGLES]
    return np.asarray(np.degrees(np.sqrt(np.mean(errors**2, axis=-1))))


def _generator(seed: int, run: int, r_13: float) -> np.random.Generator:
    return np.random.default_rng([seed, run, int(r_13)])


def _filter_sequence(hand_filter: TruncatedFilter, sequence: SyntheticSequence) -> Trial:
    """Filter a sequence; a filter that breaks down keeps its last belief."""
    means, deviations = np.zeros((2, FRAMES, len(HAND_STATE)))
    milliseconds = np.full(FRAMES, math.nan)
    state = hand_filter.start(sequence.guess)
    broken = False
    for t, y in enumerate(sequence.measurements):
        begin = time.thread_time()
        if not broken:
            try:
                state = hand_filter.update(hand_filter.predict(state) if t else state, y)
                milliseconds[t] = 1e3 * (time.thread_time() - begin)
            except SettingsError:
                # A plain filter that has run away has no covariance any more: it is lost.
                broken = True
        means[t], deviations[t] = state.best.mean, state.best.deviations()
    covariance, bound = state.best.covariance, _bound(hand_filter, sequence)
    return Trial(sequence, means, deviations, covariance, milliseconds, bound)


def _bound(hand_filter: TruncatedFilter, sequence: SyntheticSequence) -> Array:
    """(n,) what a filter believes at the end that linearises at the truth, without limits."""
    A = HAND_STATE.transition()
    U = HAND_STATE.process_noise(ACCELERATIONS)
    belief = sequence.guess
    for t, (truth, y) in enumerate(zip(sequence.states, sequence.measurements, strict=True)):
        if t:
            belief = belief.moved(A, U)
        belief = update(belief, make_evidence(hand_filter.observation, y), 1, truth).belief
    return belief.mean


def _figures(trials: Sequence[Trial]) -> dict[str, float | int]:
    """Figures of a case; a run's NEES of the six lengths is 6 on average if it is honest."""
    truths = np.array([trial.sequence.states for trial in trials])
    means = np.array([trial.means for trial in trials])
    errors = (means - truths)[:, -1]
    lengths, bounds = (
        PIXELS_PER_METRE * np.mean(np.abs(off[:, _LENGTHS]), axis=1)
        for off in (errors, [trial.bound for trial in trials] - truths[:, -1])
    )
    angles = angle_error(means, truths)
    watched = np.concatenate([_LENGTHS, _ANGLES])
    sigma = np.array([trial.deviations[-1] for trial in trials])
    nees = np.array(
        [
            off @ np.linalg.pinv(trial.covariance[np.ix_(_LENGTHS, _LENGTHS)], hermitian=True) @ off
            for trial, off in zip(trials, errors[:, _LENGTHS], strict=True)
        ]
    )
    low, high = chdtri(len(LENGTHS), [0.975, 0.025])
    r_13 = PIXELS_PER_METRE * np.array([means[:, -1, _R_13], truths[:, -1, _R_13]])
    lost = ~((lengths < _LOST_LENGTH_ERROR) & (angles[:, -1] < LOST_ANGLE_ERROR))
    return {
        "length_error_mean": float(lengths.mean()),
        "length_error_p95": float(np.percentile(lengths, 95)),
        "angle_rmse": float(np.sqrt(np.mean(angles**2))),
        "inside_2sigma": float(np.mean((np.abs(errors) < 2 * sigma)[:, watched])),
        "nees_inside": float(np.mean((nees > low) & (nees < high))),
        "ms_per_update": float(np.nanmedian([trial.milliseconds for trial in trials])),
        "lost": int(np.count_nonzero(lost)),
        "angle_rmse_at_end": float(np.sqrt(np.mean(angles[:, -1] ** 2))),
        "r_13_mean": float(r_13[0].mean()),
        "r_13_rmse": float(np.sqrt(np.mean((r_13[0] - r_13[1]) ** 2))),
        "bound_length_error_mean": float(bounds.mean()),
    }
