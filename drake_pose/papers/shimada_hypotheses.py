"""Figure 9 of Shimada et al.: hypotheses are born, and inequalities reject the wrong ones."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from drake_pose.arrays import Array
from drake_pose.filtering.inequalities import Inequalities
from drake_pose.filtering.truncated_filter import FilterState
from drake_pose.papers.shimada import (
    LOST_ANGLE_ERROR,
    angle_error,
    experiment_filter,
    experiment_settings,
)
from drake_pose.papers.shimada_motion import OBSERVED, SyntheticSequence, make_sequence
from drake_pose.papers.tables import Count, figure_table, require_choice, require_counts, uncounted

OBLIQUENESS = math.radians(60)
"""How far the fingers point out of the image plane, so that segments bend back through it."""

# Rows of table 1 about two joints of one finger.
_COUPLED = ("flexion_12 - flexion_13", "flexion_22 - flexion_23")
# The paper has no weights: only inequalities end a hypothesis, another that is the same, or 8.
_CAP = 8
# What is drawn was believed beside another for so many frames.
_LONG = 2
_ROWS = {
    "mirrored": ("made by mirroring", "{}"),
    "became_another": ("the same as another, sooner or later", "{}"),
    "too_many": ("given up as more than eight", "{}"),
    "too_light": ("given up for their weight", "{}"),
    "alive_at_the_end": ("alive at the end", "{}"),
    "rejected_by_an_inequality": ("rejected by an inequality", "{}"),
    "rejected_later_than_made": ("  of these believed for a frame or more", "{}"),
    "of_these_wrong": ("    of these further from the truth than what was kept", "{}"),
    "of_these_by_coupled_joints": (
        "    of these as two joints of a finger did not bend alike",
        "{}",
    ),
    "frames_lived_median": ("    frames believed, median", "{:.1f}"),
    "angle_error_at_end": ("joint angles at the end, RMS error, median [deg]", "{:.1f}"),
    "lost": ("sequences that end more than 20 degrees off", "{}"),
}


@dataclass(frozen=True, eq=False)
class Fate:
    """A hypothesis of one run from its birth to its end.

    Attributes:
        frames: (k,) the frames it lived in, from 1; the last is that of its end.
        means: (k, n) what it believed, in the end without the limits.
        weights: (k,) between 0 and 1; NaN in the end.
        reason, row, c: as for ``Rejection``; the reason is "" where it outlived the sequence.
        error, kept_error: of the joint angles [deg], RMS: its own when it was last believed, and
            that of the heaviest hypothesis in the frame of its end.
    """

    run: int
    frames: NDArray[np.int64]
    means: Array
    weights: Array
    reason: str
    row: str
    c: float
    error: float
    kept_error: float

    def at(self, frame: int) -> Array:
        """(n,) what it believed in a frame that it lived in."""
        return np.asarray(self.means[frame - self.frames[0]])

    @property
    def lived(self) -> int:
        """In how many frames it was believed."""
        return len(self.frames) - (1 if self.reason else 0)

    @property
    def wrong(self) -> bool:
        """Whether it was further from the truth than what was kept."""
        return self.error > self.kept_error


@dataclass(frozen=True, eq=False)
class HypothesesResult:
    """All hypotheses' fates, and final errors (runs,) of the heaviest one's joint angles [deg]."""

    fates: tuple[Fate, ...]
    sequences: tuple[SyntheticSequence, ...]
    final_errors: Array
    inequalities: Inequalities
    settings: Mapping[str, object]

    def shown(self) -> tuple[Fate, Fate] | None:
        """A wrong one that an inequality rejected, as in figure 9, and its survivor; None: none.

        It had the largest weight of those that lived several frames, by the paper's inequality if
        possible; its survivor is the nearest to the truth.
        """
        rejected = [
            one
            for one in self.fates
            if one.reason == "constraint" and one.wrong and one.lived >= _LONG
        ]
        rejected.sort(key=lambda one: (one.row.startswith(_COUPLED), one.weights[-2]), reverse=True)
        for dead in rejected:
            end = int(dead.frames[-1])
            beside = [
                one
                for one in self.fates
                if one.run == dead.run and one.frames[0] < end < one.frames[-1]
            ]
            truth = self.sequences[dead.run].states[end - 1]
            if beside:
                return dead, min(beside, key=lambda one: float(angle_error(one.at(end), truth)))
        return None

    def as_json(self) -> dict[str, object]:
        """Counts over all sequences, and how it was made."""
        rejected = [one for one in self.fates if one.reason == "constraint"]
        later = [one for one in rejected if one.lived]
        counts = Counter(one.reason for one in self.fates)
        return {
            "mirrored": len(self.fates) - len(self.sequences),
            "became_another": counts["twin"],
            "too_light": counts["weight"],
            "too_many": counts["cap"],
            "alive_at_the_end": counts[""],
            "rejected_by_an_inequality": len(rejected),
            "rejected_later_than_made": len(later),
            "of_these_wrong": sum(one.wrong for one in later),
            "of_these_by_coupled_joints": sum(one.row.startswith(_COUPLED) for one in later),
            "frames_lived_median": float(np.median([f.lived for f in later])) if later else None,
            "inequalities": dict(Counter(one.row for one in later).most_common()),
            "angle_error_at_end": float(np.median(self.final_errors)),
            "lost": int(np.count_nonzero(self.final_errors > LOST_ANGLE_ERROR)),
            **self.settings,
        }

    def table(self) -> Table:
        """The counts, and which inequalities rejected."""
        figures = self.as_json()
        title = (
            f"Shimada, figure 9: {figures['truncation']} truncation, {figures['observed']} "
            f"observation, {figures['iterations']} linearisations at most"
        )
        heading = f"hypotheses in {figures['runs']} sequences"
        return figure_table(title, _ROWS, {"ours": figures}, heading)


def run_hypotheses_experiment(
    runs: int = 50,
    seed: int = 0,
    truncation: str = "sequential",
    observed: str = "lines",
    count: Count = uncounted,
    iterations: int = 1,
) -> HypothesesResult:
    """Follow every hypothesis while fingers bend through the image plane, as in figure 9.

    There frame 18's third segment is ambiguous in depth, the wrong hypothesis rejected in frame 20.
    The motion is that of ``run_experiment`` with fingers out of the image plane; weights, which the
    paper does not have, reject nothing. Arguments and errors as of ``run_experiment``.
    """
    require_counts(runs=runs)
    require_choice("observed", observed, OBSERVED)
    settings = replace(
        experiment_settings(truncation, iterations), hypothesis_cap=_CAP, smallest_weight=0.0
    )
    hand_filter, observation = experiment_filter(settings)
    advance = count("sequences", runs)
    fates: list[Fate] = []
    sequences, final_errors = [], []
    for run in range(runs):
        generator = np.random.default_rng([seed, run])
        sequence = make_sequence(35.0, observed, observation, generator, OBLIQUENESS)
        state, states = hand_filter.start(sequence.guess), []
        for t, y in enumerate(sequence.measurements):
            state = hand_filter.update(hand_filter.predict(state) if t else state, y)
            states.append(state)
        fates += _fates(run, sequence.states, states)
        sequences.append(sequence)
        final_errors.append(angle_error(state.best.mean, sequence.states[-1]))
        advance(run + 1)
    made = {"runs": runs, "seed": seed, "observed": observed}
    made |= {"truncation": settings.truncation, "iterations": settings.iterations}
    return HypothesesResult(
        tuple(fates), tuple(sequences), np.array(final_errors), hand_filter.inequalities, made
    )


def _fates(run: int, truths: Array, states: Sequence[FilterState]) -> list[Fate]:
    """All hypotheses of one sequence, those that outlived it last."""
    fates: list[Fate] = []
    believed: dict[tuple[int, int], list[tuple[int, Array, float]]] = {}

    def close(path: Sequence[tuple[int, Array, float]], kept: Array,
              reason: str = "", row: str = "", c: float = math.nan) -> None:  # fmt: skip
        frames, means, weights = (np.array(one) for one in zip(*path, strict=True))
        own = truths[frames - 1]
        last = -2 if reason and len(frames) > 1 else -1
        error, kept_error = angle_error(means[last], own[last]), angle_error(kept, own[-1])
        fates.append(
            Fate(run, frames, means, weights, reason, row, c, float(error), float(kept_error))
        )

    for state in states:
        for end in state.rejections:
            path = believed.pop((end.hypothesis.born, end.hypothesis.place), [])
            path.append((state.step, end.hypothesis.belief.mean, math.nan))
            close(path, state.best.mean, end.reason, end.row, end.c)
        for one in state.hypotheses:
            path = believed.setdefault((one.born, one.place), [])
            path.append((state.step, one.belief.mean, one.weight))
    for path in believed.values():
        close(path, states[-1].best.mean)
    return fates
