"""One static view from table 2's start: what other ways to begin would make of it.

Run as ``python -m tests.benchmarks.static_view [RUNS] [SEED]``. The filter linearises a
view in its first frame and keeps that tangent; here all frames of a view are at hand at once.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand.observation import HandObservation
from drake_pose.filtering.kalman.limited_update import limited_update
from drake_pose.filtering.kalman.repeated_views import measure_curvature
from drake_pose.filtering.kalman.truncated_filter import TruncatedFilter
from drake_pose.filtering.kalman.update import ObservationModel, difference, update, with_variances
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncation.inequalities import Inequalities
from drake_pose.filtering.truncation.truncated_normal import join_rows, truncate_joint
from drake_pose.papers.shimada.experiment import CASES, experiment_filter
from drake_pose.papers.shimada.motion import make_sequence
from drake_pose.papers.shimada.static_view import at_rest, compare_lengths, follow, see

Array = NDArray[np.float64]

FRAMES = 55
_LINEARISATIONS = 20
# The curvature is measured at what the curvature leads to.
_ROUNDS = 8
_PARTICLES, _DRAWS, _FEWEST = 200, 4000, 10
_NO_SITES = np.zeros((0, 2))


@dataclass(frozen=True, eq=False)
class StaticView:
    """A view and what may be known of it.

    Attributes:
        guess: table 2's start.
        y: (m,) the mean of all measurements.
        model: what is measured, with the noise of that mean.
        inequalities: table 1.
        truth: (n,).
        filtered: the filter's belief after the last frame.
    """

    guess: Belief
    y: Array
    model: ObservationModel
    inequalities: Inequalities
    truth: Array
    filtered: Belief

    def truncated(self, belief: Belief) -> Belief:
        """A belief inside the inequalities."""
        found = truncate_joint(belief.mean, belief.covariance, join_rows(self.inequalities))
        return Belief(found.mean, found.covariance)


def make_view(
    hand_filter: TruncatedFilter,
    observation: HandObservation,
    number: int,
    seed: int,
    frames: int = FRAMES,
) -> StaticView:
    """A static view of the experiment's hand, as ``run_static_experiment`` makes them."""
    generator = np.random.default_rng([seed, number])
    r_13 = tuple(CASES.values())[number % len(CASES)]
    sequence = make_sequence(r_13, "full", observation, generator)
    truth = at_rest(sequence.states[0])
    seen = np.array([see(truth, sequence, observation, generator, t == 0) for t in range(frames)])
    filtered = follow(hand_filter, hand_filter.start(sequence.guess), seen)
    change = difference(seen, seen[0], observation.wraps)
    # What is seen once, the scale, has its own noise.
    counts = np.maximum(np.isfinite(seen).sum(axis=0), 1)
    y = seen[0] + np.nansum(change, axis=0) / counts
    model = with_variances(observation, y, observation.variances / counts)
    return StaticView(sequence.guess, y, model, hand_filter.inequalities, truth, filtered.best)


def filtered(view: StaticView, _generator: np.random.Generator) -> Belief:
    """The filter, which keeps the tangent of the first frame."""
    return view.filtered


def linearised_at_truth(view: StaticView, _generator: np.random.Generator) -> Belief:
    """One update, linearised where nobody can know."""
    return view.truncated(update(view.guess, view.y, view.model, 1, view.truth).belief)


def smoothed(view: StaticView, _generator: np.random.Generator) -> Belief:
    """All frames at once, linearised anew where the truncated belief lies."""
    return _limited(view, view.model, view.truncated(view.guess).mean)


def smoothed_with_curvature(view: StaticView, _generator: np.random.Generator) -> Belief:
    """The same, with what a tangent leaves out as noise."""
    belief = view.filtered
    for _ in range(_ROUNDS):
        variances = view.model.variances + measure_curvature(view.model, belief)
        model = with_variances(view.model, view.y, variances)
        belief = _limited(view, model, belief.mean)
    return belief


def particles(view: StaticView, generator: np.random.Generator) -> Belief:
    """Draws from table 2's start inside table 1, each fitted to a draw of the measurement.

    Randomised maximum likelihood (Oliver, He, Reynolds 1996); fits that end outside of table 1
    are left out.
    """
    rows = view.inequalities
    start = view.truncated(view.guess)
    root = np.linalg.cholesky(start.covariance + 1e-18 * np.eye(len(start.mean)))
    draws: list[Array] = []
    while len(draws) < _PARTICLES:
        some = start.mean + generator.normal(size=(_DRAWS, len(root))) @ root.T
        draws += list(some[(rows.b - some @ rows.phi.T).min(axis=1) >= 0])
    fitted = []
    for x in draws[:_PARTICLES]:
        y = view.y + np.sqrt(view.model.variances) * generator.normal(size=len(view.y))
        try:
            prior = Belief(x, view.guess.covariance)
            fitted.append(update(prior, y, view.model, _LINEARISATIONS, x).belief.mean)
        except SettingsError:
            # A draw from which no fit leads anywhere.
            continue
    found = np.array(fitted)
    inside = (rows.b - found @ rows.phi.T).min(axis=1) >= 0
    chosen = found[inside] if np.count_nonzero(inside) >= _FEWEST else found
    return Belief(chosen.mean(axis=0), np.cov(chosen.T))


def _limited(view: StaticView, model: ObservationModel, start: Array) -> Belief:
    rows = join_rows(view.inequalities)
    found = limited_update(
        view.guess,
        view.y,
        model,
        lambda belief, sites: truncate_joint(
            belief.mean, belief.covariance, rows, start=sites if sites.size else None
        ),
        _LINEARISATIONS,
        start,
        _NO_SITES,
    ).truncated
    return Belief(found.mean, found.covariance)


WAYS: Mapping[str, Callable[[StaticView, np.random.Generator], Belief]] = {
    "the filter: the first frame's tangent": filtered,
    "iterated smoother": smoothed,
    "iterated smoother, curvature as noise": smoothed_with_curvature,
    "particles, each fitted": particles,
    "linearised at the truth": linearised_at_truth,
}
"""What is compared, by name."""


def compare_ways(runs: int = 20, seed: int = 0, frames: int = FRAMES) -> dict[str, Array]:
    """Errors, NEES and seconds of every way.

    Args:
        runs: static views.
        seed: another one draws others.
        frames: of each view.

    Returns:
        By the names of ``WAYS``: (runs, 3) the lengths' NEES per degree of freedom, their mean
        absolute error [pixel], and the processor's seconds (the filter's are not measured).
    """
    hand_filter, observation = experiment_filter()
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in WAYS}
    for number in range(runs):
        view = make_view(hand_filter, observation, number, seed, frames)
        for name, way in WAYS.items():
            begin = time.process_time()
            belief = way(view, np.random.default_rng([seed, number, 1]))
            seconds = time.process_time() - begin
            nees, error = compare_lengths(belief, view.truth)
            found[name].append((nees, error, seconds))
    return {name: np.array(values) for name, values in found.items()}


def main() -> None:
    """Print what each way reaches."""
    words = sys.argv[1:3]
    runs, seed = (int(word) for word in (*words, *("20", "0")[len(words) :]))
    table = Table(title=f"{runs} static views of {FRAMES} frames, all seen, seed {seed}")
    for heading in ("way", "length error [pixel]", "median", "NEES", "CPU seconds"):
        table.add_column(heading, justify="left" if heading == "way" else "right")
    for name, values in compare_ways(runs, seed).items():
        nees, error, seconds = values.mean(axis=0)
        cells = (error, float(np.median(values[:, 1])), nees, seconds)
        table.add_row(name, *(f"{cell:.2f}" for cell in cells))
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
