"""The flaw that Shimada et al. state: one view, stared at for thousands of frames."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand.observation import HAND_STATE, LENGTHS, MEASURED, HandObservation
from drake_pose.filtering.kalman.truncated_filter import FilterState, TruncatedFilter
from drake_pose.filtering.state import Belief
from drake_pose.papers.shimada.experiment import (
    PIXELS_PER_METRE,
    experiment_filter,
    experiment_settings,
)
from drake_pose.papers.shimada.motion import (
    SyntheticSequence,
    make_sequence,
    require_observed,
)

Array = NDArray[np.float64]

MARKS = (55, 500, 2000, 5000)
"""After this many static frames the belief is compared with the truth."""

STARTS = ("guess", "learned")
"""The static view comes first, or after the moving sequence."""

_LENGTHS = HAND_STATE.indices(LENGTHS)


@dataclass(frozen=True, eq=False)
class StaticResult:
    """What staring does to the six lengths.

    Attributes:
        marks: (k,) numbers of static frames.
        nees: (runs, k) normalised squared error per degree of freedom; 1 on average if honest.
        errors: (runs, k) mean absolute error [pixel].
        nees_after, errors_after: (runs,) the same when new views have followed; empty for the
            start "learned".
        settings: how it was made, for the JSON.
    """

    marks: tuple[int, ...]
    nees: Array
    errors: Array
    nees_after: Array
    errors_after: Array
    settings: dict[str, object]

    def as_json(self) -> dict[str, object]:
        """Means over the runs, by the number of static frames."""
        figures: dict[str, object] = {
            str(mark): {
                "nees_per_dof": float(self.nees[:, k].mean()),
                "length_error_mean": float(self.errors[:, k].mean()),
            }
            for k, mark in enumerate(self.marks)
        }
        if len(self.nees_after):
            figures["after_new_views"] = {
                "nees_per_dof": float(self.nees_after.mean()),
                "length_error_mean": float(self.errors_after.mean()),
            }
        return {"static_frames": figures, **self.settings}

    def table(self) -> Table:
        """The figures, a column for each number of static frames."""
        table = Table(title="Shimada, one static view")
        table.add_column("lengths")
        nees, errors = ["NEES per degree of freedom"], ["error, mean [pixel]"]
        for k, mark in enumerate(self.marks):
            table.add_column(f"{mark} frames", justify="right")
            nees.append(f"{self.nees[:, k].mean():.2f}")
            errors.append(f"{self.errors[:, k].mean():.2f}")
        if len(self.nees_after):
            table.add_column("then new views", justify="right")
            nees.append(f"{self.nees_after.mean():.2f}")
            errors.append(f"{self.errors_after.mean():.2f}")
        table.add_row(*nees)
        table.add_row(*errors)
        return table


def run_static_experiment(
    runs: int = 20,
    seed: int = 0,
    truncation: str = "joint",
    observed: str = "full",
    start: str = "guess",
    marks: tuple[int, ...] = MARKS,
    progress: Callable[[int], None] | None = None,
    iterations: int | None = None,
) -> StaticResult:
    """Show the filter one view for thousands of frames.

    Args:
        runs: how many; they take r_13 = 35 and 40 in turn.
        seed: another one draws other poses, noise and first guesses.
        truncation, observed: as for ``run_experiment``.
        start: "guess": the view is stared at from table 2's start on, then the moving sequence
            follows; "learned": the moving sequence comes first, its last view is stared at.
        marks: when to compare, in static frames.
        progress: called with the number of runs done after each.
        iterations: as for ``run_experiment``.

    Raises:
        SettingsError: if an argument is not one of these.
    """
    if runs < 1 or not marks or min(marks) < 1:
        raise SettingsError(f"runs and marks must be 1 or more, not {runs} and {marks}")
    require_observed(observed)
    if start not in STARTS:
        raise SettingsError(f"start must be one of {', '.join(STARTS)}, not '{start}'")
    hand_filter, observation = experiment_filter(experiment_settings(truncation, iterations))
    nees, errors = np.zeros((runs, len(marks))), np.zeros((runs, len(marks)))
    after = []
    for run in range(runs):
        generator = np.random.default_rng([seed, run])
        sequence = make_sequence((35.0, 40.0)[run % 2], observed, observation, generator)
        state = hand_filter.start(sequence.guess)
        if start == "learned":
            state = follow(hand_filter, state, sequence.measurements)
        x = at_rest(sequence.states[0 if start == "guess" else -1])
        for t in range(max(marks)):
            y = see(x, sequence, observation, generator, t == 0 and start == "guess")
            state = hand_filter.update(hand_filter.predict(state) if state.step else state, y)
            if t + 1 in marks:
                k = marks.index(t + 1)
                nees[run, k], errors[run, k] = compare_lengths(state.best, x)
        if start == "guess":
            state = follow(hand_filter, state, sequence.measurements[1:])
            after.append(compare_lengths(state.best, x))
        if progress is not None:
            progress(run + 1)
    later = np.array(after).reshape(-1, 2)
    made = {"runs": runs, "seed": seed, "truncation": truncation, "observed": observed}
    return StaticResult(marks, nees, errors, later[:, 0], later[:, 1], {**made, "start": start})


def follow(hand_filter: TruncatedFilter, state: FilterState, measurements: Array) -> FilterState:
    """The filter's state after further measurements (frames, m)."""
    for y in measurements:
        state = hand_filter.update(hand_filter.predict(state) if state.step else state, y)
    return state


def at_rest(x: Array) -> Array:
    """(n,) a state without its rates."""
    still = x.copy()
    moving = len(HAND_STATE.moving)
    still[moving : 2 * moving] = 0.0
    return still


def see(
    x: Array,
    sequence: SyntheticSequence,
    observation: HandObservation,
    generator: np.random.Generator,
    with_scale: bool,
) -> Array:
    """(m,) a measurement of the state x, hidden where the sequence hides; the scale once."""
    y = observation.predict(x)[0]
    y += np.sqrt(observation.variances) * generator.normal(size=len(y))
    y[np.isnan(sequence.measurements[0])] = np.nan
    y[MEASURED.index("scale")] = 1.0 if with_scale else np.nan
    return y


def compare_lengths(belief: Belief, x: Array) -> tuple[float, float]:
    """NEES per degree of freedom and mean absolute error [pixel] of the lengths."""
    error = (belief.mean - x)[_LENGTHS]
    covariance = belief.covariance[np.ix_(_LENGTHS, _LENGTHS)]
    nees = float(error @ np.linalg.solve(covariance, error)) / len(LENGTHS)
    return nees, PIXELS_PER_METRE * float(np.abs(error).mean())
