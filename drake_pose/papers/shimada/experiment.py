"""Shimada's synthetic experiment: a two-finger hand, 55 frames, lengths learned from one camera."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table
from scipy.special import chdtri

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.errors import SettingsError
from drake_pose.filtering.hand.observation import (
    FLEXIONS,
    HAND_STATE,
    LENGTHS,
    SPREADS,
    HandObservation,
)
from drake_pose.filtering.kalman.truncated_filter import (
    TRUNCATIONS,
    FilterSettings,
    TruncatedFilter,
)
from drake_pose.filtering.kalman.update import update
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncation.couplings import model_inequalities
from drake_pose.papers.shimada.motion import (
    ACCELERATIONS,
    FRAMES,
    SyntheticSequence,
    make_sequence,
    require_observed,
)

Array = NDArray[np.float64]

CASES = {"r13_35": 35.0, "r13_40": 40.0}
"""The two true lengths of finger 1's last segment [pixel at scale 1, mm]."""

PIXELS_PER_METRE = 1000.0
_LENGTHS = HAND_STATE.indices(LENGTHS)
_R_13 = HAND_STATE.index("length_13")
_ANGLES = HAND_STATE.indices((*SPREADS, *FLEXIONS))
_LOST_LENGTH_ERROR = 5.0
_LOST_ANGLE_ERROR = 20.0


@dataclass(frozen=True, eq=False)
class Trial:
    """One sequence, filtered.

    Attributes:
        sequence: truth, measurements and first guess.
        means: (55, n) of the best hypothesis after each frame.
        deviations: (55, n) its standard deviations.
        length_error: mean absolute error of the six lengths at the end [pixel].
        angle_errors: (55,) root mean square error of the eight joint angles [deg].
        inside: (14,) which lengths and angles are within 2 deviations of the truth at the end.
        nees: normalised squared error of the six lengths at the end; 6 on average if honest.
        milliseconds: (55,) of the processor for prediction and update.
        hypotheses: (55,) how many there were.
        bound_length_error: as length_error, for a filter linearised at the truth, without limits:
            what the measurements hold, if nobody had to guess.
    """

    sequence: SyntheticSequence
    means: Array
    deviations: Array
    length_error: float
    angle_errors: Array
    inside: NDArray[np.bool_]
    nees: float
    milliseconds: Array
    hypotheses: NDArray[np.int64]
    bound_length_error: float

    @property
    def lost(self) -> bool:
        """Whether the lengths or the angles are far off at the end."""
        good = self.length_error < _LOST_LENGTH_ERROR and self.angle_errors[-1] < _LOST_ANGLE_ERROR
        return not good


@dataclass(frozen=True)
class ExperimentResult:
    """All runs, by the keys of ``CASES``."""

    trials: dict[str, tuple[Trial, ...]]
    seed: int
    settings: FilterSettings
    observed: str

    def as_json(self) -> dict[str, object]:
        """The figures over the runs of each case, and how they were made."""
        figures: dict[str, object] = {key: _figures(case) for key, case in self.trials.items()}
        return {
            **figures,
            "runs": len(next(iter(self.trials.values()))),
            "seed": self.seed,
            "truncation": self.settings.truncation,
            "iterations": self.settings.iterations,
            "observed": self.observed,
        }

    def table(self) -> Table:
        """The figures of both cases, side by side."""
        table = Table(
            title=f"Shimada, synthetic hand: {self.settings.truncation} truncation, "
            f"{self.observed} observation, linearisations: {self.settings.iterations} at most"
        )
        table.add_column("figure (at t = 55 where nothing is said)")
        for key in CASES:
            table.add_column(key, justify="right")
        columns = [_figures(self.trials[key]) for key in CASES]
        for key, (label, form) in _LABELS.items():
            table.add_row(escape(label), *(form.format(column[key]) for column in columns))
        return table


@dataclass(frozen=True)
class ComparedTruncations:
    """The same sequences filtered with every truncation, by the names of ``TRUNCATIONS``."""

    results: Mapping[str, ExperimentResult]

    def as_json(self) -> dict[str, object]:
        """What each result says, by truncation."""
        return {name: result.as_json() for name, result in self.results.items()}

    def table(self) -> Table:
        """The figures of all truncations and both cases, side by side."""
        observed = next(iter(self.results.values())).observed
        table = Table(title=f"Shimada, synthetic hand: all truncations, {observed} observation")
        table.add_column("figure (at t = 55 where nothing is said)")
        columns = []
        for name, result in self.results.items():
            for key in CASES:
                table.add_column(f"{name}\n{key}", justify="right")
                columns.append(_figures(result.trials[key]))
        for key, (label, form) in _LABELS.items():
            table.add_row(escape(label), *(form.format(column[key]) for column in columns))
        return table


_LABELS = {
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


def run_experiment(
    runs: int = 50,
    seed: int = 0,
    truncation: str = "joint",
    observed: str = "lines",
    progress: Callable[[int], None] | None = None,
    iterations: int | None = None,
) -> ExperimentResult:
    """Run the synthetic experiment of section 6 for r_13 = 35 and r_13 = 40.

    The paper gives neither the motion nor the noise: here every run draws both (0.5 pixel for
    points, 1 pixel and 1 degree for lines).

    Args:
        runs: of each case.
        seed: another one draws other motions, noise and first guesses.
        truncation: "joint", "sequential" (the paper's), "clip" or "none".
        observed: "lines": knuckles hidden, as in the paper; or "full".
        progress: called with the number of sequences done after each.
        iterations: linearisations of an update at most; 1 is the paper's filter. The library's
            own default if not given.

    Raises:
        SettingsError: if an argument is not one of these.
    """
    if runs < 1:
        raise SettingsError(f"runs must be 1 or more, not {runs}")
    require_observed(observed)
    settings = experiment_settings(truncation, iterations)
    hand_filter, observation = experiment_filter(settings)
    # The first call of compiled code loads it, which belongs to no update.
    _filter_sequence(
        hand_filter, make_sequence(35.0, observed, observation, _generator(seed, 0, 35.0))
    )
    trials: dict[str, tuple[Trial, ...]] = {}
    for place, (key, r_13) in enumerate(CASES.items()):
        case = []
        for run in range(runs):
            sequence = make_sequence(r_13, observed, observation, _generator(seed, run, r_13))
            case.append(_run_one(hand_filter, sequence))
            if progress is not None:
                progress(place * runs + run + 1)
        trials[key] = tuple(case)
    return ExperimentResult(trials, seed, settings, observed)


def compare_truncations(
    runs: int = 50,
    seed: int = 0,
    observed: str = "lines",
    progress: Callable[[int], None] | None = None,
    iterations: int | None = None,
) -> ComparedTruncations:
    """Run the experiment with every truncation, on the same sequences.

    Args:
        runs: of each case and truncation; the others are those of ``run_experiment``.
        seed: as there.
        observed: as there.
        progress: called with the number of sequences done after each, all truncations counted.
        iterations: as there.

    Raises:
        SettingsError: if an argument is not one of these.
    """
    results: dict[str, ExperimentResult] = {}
    for place, truncation in enumerate(TRUNCATIONS):
        before = place * runs * len(CASES)

        def advance(done: int, before: int = before) -> None:
            if progress is not None:
                progress(before + done)

        results[truncation] = run_experiment(runs, seed, truncation, observed, advance, iterations)
    return ComparedTruncations(results)


def experiment_settings(truncation: str, iterations: int | None = None) -> FilterSettings:
    """The library's own settings, but for these.

    Raises:
        SettingsError: there is no such truncation, or there are no iterations.
    """
    for known in TRUNCATIONS:
        if truncation == known:
            settings = FilterSettings(truncation=known)
            return settings if iterations is None else replace(settings, iterations=iterations)
    raise SettingsError(f"truncation must be one of {', '.join(TRUNCATIONS)}, not '{truncation}'")


def experiment_filter(
    settings: FilterSettings | None = None,
) -> tuple[TruncatedFilter, HandObservation]:
    """The filter of the experiment: table 1's rows from the bundled hand, and its observation."""
    model = load_model(bundled_model("two_finger_hand"), check=False)
    rows = model_inequalities(model).only_of(HAND_STATE.names)
    observation = HandObservation(pixels_per_metre=PIXELS_PER_METRE)
    noise = HAND_STATE.process_noise(ACCELERATIONS)
    return TruncatedFilter(HAND_STATE, observation, rows, noise, settings), observation


def _generator(seed: int, run: int, r_13: float) -> np.random.Generator:
    return np.random.default_rng([seed, run, int(r_13)])


@dataclass(frozen=True, eq=False)
class _Track:
    means: Array
    deviations: Array
    last: Belief
    milliseconds: Array
    hypotheses: NDArray[np.int64]


def _filter_sequence(hand_filter: TruncatedFilter, sequence: SyntheticSequence) -> _Track:
    """Filter a sequence; a filter that breaks down keeps its last belief."""
    n = len(HAND_STATE)
    means, deviations = np.zeros((FRAMES, n)), np.zeros((FRAMES, n))
    milliseconds = np.full(FRAMES, math.nan)
    hypotheses = np.zeros(FRAMES, dtype=np.int64)
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
        hypotheses[t] = len(state.hypotheses)
    return _Track(means, deviations, state.best, milliseconds, hypotheses)


def _run_one(hand_filter: TruncatedFilter, sequence: SyntheticSequence) -> Trial:
    track = _filter_sequence(hand_filter, sequence)
    errors = track.means - sequence.states
    angles = np.degrees(np.sqrt(np.mean(errors[:, _ANGLES] ** 2, axis=1)))
    watched = np.concatenate([_LENGTHS, _ANGLES])
    inside = np.abs(errors[-1, watched]) < 2 * track.deviations[-1, watched]
    covariance = track.last.covariance[np.ix_(_LENGTHS, _LENGTHS)]
    lengths = errors[-1, _LENGTHS]
    return Trial(
        sequence=sequence,
        means=track.means,
        deviations=track.deviations,
        length_error=PIXELS_PER_METRE * float(np.mean(np.abs(lengths))),
        angle_errors=angles,
        inside=inside,
        nees=float(lengths @ np.linalg.pinv(covariance, hermitian=True) @ lengths),
        milliseconds=track.milliseconds,
        hypotheses=track.hypotheses,
        bound_length_error=_bound(hand_filter, sequence),
    )


def _bound(hand_filter: TruncatedFilter, sequence: SyntheticSequence) -> float:
    """The length error of a filter that linearises at the truth, without limits [pixel]."""
    A = HAND_STATE.transition()
    U = HAND_STATE.process_noise(ACCELERATIONS)
    belief = sequence.guess
    for t, (truth, y) in enumerate(zip(sequence.states, sequence.measurements, strict=True)):
        if t:
            belief = Belief(A @ belief.mean, A @ belief.covariance @ A.T + U)
        belief = update(belief, y, hand_filter.observation, 1, truth).belief
    errors = belief.mean[_LENGTHS] - sequence.states[-1, _LENGTHS]
    return PIXELS_PER_METRE * float(np.mean(np.abs(errors)))


def _figures(trials: tuple[Trial, ...]) -> dict[str, float | int]:
    errors = np.array([trial.length_error for trial in trials])
    angles = np.array([trial.angle_errors for trial in trials])
    low, high = chdtri(len(LENGTHS), [0.975, 0.025])
    nees = np.array([trial.nees for trial in trials])
    r_13 = PIXELS_PER_METRE * np.array([trial.means[-1, _R_13] for trial in trials])
    true_r_13 = PIXELS_PER_METRE * trials[0].sequence.states[-1, _R_13]
    return {
        "length_error_mean": float(errors.mean()),
        "length_error_p95": float(np.percentile(errors, 95)),
        "angle_rmse": float(np.sqrt(np.mean(angles**2))),
        "inside_2sigma": float(np.mean([trial.inside for trial in trials])),
        "nees_inside": float(np.mean((nees > low) & (nees < high))),
        "ms_per_update": float(np.nanmedian([trial.milliseconds for trial in trials])),
        "lost": sum(trial.lost for trial in trials),
        "angle_rmse_at_end": float(np.sqrt(np.mean(angles[:, -1] ** 2))),
        "r_13_mean": float(r_13.mean()),
        "r_13_rmse": float(np.sqrt(np.mean((r_13 - true_r_13) ** 2))),
        "bound_length_error_mean": float(np.mean([t.bound_length_error for t in trials])),
    }
