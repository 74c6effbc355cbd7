"""Figure 9 of Shimada et al.: hypotheses are born, and inequalities reject the wrong ones."""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand.observation import FLEXIONS, HAND_STATE, SPREADS
from drake_pose.filtering.kalman.truncated_filter import FilterState
from drake_pose.filtering.truncation.inequalities import Inequalities
from drake_pose.papers.shimada.experiment import experiment_filter, experiment_settings
from drake_pose.papers.shimada.motion import (
    SyntheticSequence,
    make_sequence,
    require_observed,
)

Array = NDArray[np.float64]

OBLIQUENESS = math.radians(60)
"""How far the fingers point out of the image plane, so that segments bend back through it."""

_ANGLES = HAND_STATE.indices((*SPREADS, *FLEXIONS))
# Rows of table 1 about two joints of one finger.
_COUPLED = ("flexion_12 - flexion_13", "flexion_22 - flexion_23")
# The paper has no weights: only inequalities end a hypothesis, another that is the same, or 8.
_CAP = 8
# A hypothesis that lives so long has been believed beside the other [frames].
_LONG = 2
_LOST_ANGLE_ERROR = 20.0

Identity = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Fate:
    """A hypothesis from its birth to its end.

    Attributes:
        run: number of the sequence.
        frames: (k,) the frames it lived in, from 1; the last is that of its end.
        means: (k, n) what it believed, in the end without the limits.
        weights: (k,) between 0 and 1; NaN in the end.
        reason, row, c: as for ``Rejection``; the reason is "" where it outlived the sequence.
        error: of its joint angles in the last frame that it was believed in, or in its only one
            [deg], root mean square.
        kept_error: that of the heaviest hypothesis in the frame of its end.
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
    """What became of all hypotheses.

    Attributes:
        fates: of those that were made by mirroring, and of the first ones.
        sequences: the truths.
        final_errors: (runs,) of the heaviest hypothesis' joint angles in the last frame [deg].
        inequalities: of the filter.
        settings: how it was made, for the JSON.
    """

    fates: tuple[Fate, ...]
    sequences: tuple[SyntheticSequence, ...]
    final_errors: Array
    inequalities: Inequalities
    settings: Mapping[str, object]

    def shown(self) -> tuple[Fate, Fate] | None:
        """A wrong one that an inequality rejected, as in figure 9, and its survivor.

        Of those believed in several frames it is the one with the largest weight before its end,
        where possible rejected by the paper's inequality: two joints of a finger bend about
        alike. The survivor is the nearest to the truth of those beside it that live on. None where
        there is none.
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
                return dead, min(beside, key=lambda one: _error(one.at(end), truth))
        return None

    def as_json(self) -> dict[str, object]:
        """Counts over all sequences, and how it was made."""
        rejected = [one for one in self.fates if one.reason == "constraint"]
        later = [one for one in rejected if one.lived]
        coupled = [one for one in later if one.row.startswith(_COUPLED)]
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
            "of_these_by_coupled_joints": len(coupled),
            "frames_lived_median": float(np.median([f.lived for f in later])) if later else None,
            "inequalities": dict(Counter(one.row for one in later).most_common()),
            "angle_error_at_end": float(np.median(self.final_errors)),
            "lost": int(np.count_nonzero(self.final_errors > _LOST_ANGLE_ERROR)),
            **self.settings,
        }

    def table(self) -> Table:
        """The counts, and which inequalities rejected."""
        figures = self.as_json()
        table = Table(
            title=f"Shimada, figure 9: {figures['truncation']} truncation, {figures['observed']} "
            f"observation, {figures['iterations']} linearisations at most"
        )
        table.add_column(f"hypotheses in {figures['runs']} sequences")
        table.add_column("ours", justify="right")
        for key, label in _LABELS.items():
            value = figures[key]
            table.add_row(label, f"{value:.1f}" if isinstance(value, float) else str(value or 0))
        return table


_LABELS = {
    "mirrored": "made by mirroring",
    "became_another": "the same as another, sooner or later",
    "too_many": "given up as more than eight",
    "too_light": "given up for their weight",
    "alive_at_the_end": "alive at the end",
    "rejected_by_an_inequality": "rejected by an inequality",
    "rejected_later_than_made": "  of these believed for a frame or more",
    "of_these_wrong": "    of these further from the truth than what was kept",
    "of_these_by_coupled_joints": "    of these as two joints of a finger did not bend alike",
    "frames_lived_median": "    frames believed, median",
    "angle_error_at_end": "joint angles at the end, RMS error, median [deg]",
    "lost": "sequences that end more than 20 degrees off",
}


def run_hypotheses_experiment(
    runs: int = 50,
    seed: int = 0,
    truncation: str = "sequential",
    observed: str = "lines",
    progress: Callable[[int], None] | None = None,
    iterations: int = 1,
) -> HypothesesResult:
    """Follow every hypothesis while fingers bend through the image plane.

    The paper's figure 9 shows the third segment ambiguous in depth in frame 18, and the wrong
    hypothesis rejected in frame 20, as two joints bend about alike. The motion is that of
    ``run_experiment``, the hand turned so that its fingers point out of the image plane. Weights,
    which the paper does not have, reject nothing.

    Args:
        runs, seed, truncation, observed, progress, iterations: as for ``run_experiment``; the
            defaults are the paper's.

    Raises:
        SettingsError: if an argument is not one of these.
    """
    if runs < 1:
        raise SettingsError(f"runs must be 1 or more, not {runs}")
    require_observed(observed)
    settings = replace(
        experiment_settings(truncation, iterations), hypothesis_cap=_CAP, smallest_weight=0.0
    )
    hand_filter, observation = experiment_filter(settings)
    fates: list[Fate] = []
    sequences, final_errors = [], []
    for run in range(runs):
        generator = np.random.default_rng([seed, run])
        sequence = make_sequence(35.0, observed, observation, generator, OBLIQUENESS)
        sequences.append(sequence)
        state, paths = hand_filter.start(sequence.guess), _Paths(run, sequence)
        for t, y in enumerate(sequence.measurements):
            state = hand_filter.update(hand_filter.predict(state) if t else state, y)
            paths.add(state)
        fates += paths.finished(state)
        final_errors.append(_error(state.best.mean, sequence.states[-1]))
        if progress is not None:
            progress(run + 1)
    made = {"runs": runs, "seed": seed, "observed": observed}
    made |= {"truncation": settings.truncation, "iterations": settings.iterations}
    return HypothesesResult(
        tuple(fates), tuple(sequences), np.array(final_errors), hand_filter.inequalities, made
    )


class _Paths:
    """The hypotheses of one sequence, frame by frame."""

    def __init__(self, run: int, sequence: SyntheticSequence) -> None:
        self._run, self._sequence = run, sequence
        self._open: dict[Identity, list[tuple[int, Array, float]]] = {}
        self._fates: list[Fate] = []

    def add(self, state: FilterState) -> None:
        """A frame more."""
        for rejection in state.rejections:
            gone = rejection.hypothesis
            path = self._open.pop((gone.born, gone.place), [])
            path.append((state.step, gone.belief.mean, math.nan))
            self._close(path, state, rejection.reason, rejection.row, rejection.c)
        for h in state.hypotheses:
            path = self._open.setdefault((h.born, h.place), [])
            path.append((state.step, h.belief.mean, h.weight))

    def finished(self, state: FilterState) -> list[Fate]:
        """All fates, those that outlived the sequence last."""
        for path in self._open.values():
            self._close(path, state, "", "", math.nan)
        return self._fates

    def _close(
        self,
        path: list[tuple[int, Array, float]],
        state: FilterState,
        reason: str,
        row: str,
        c: float,
    ) -> None:
        frames, means, weights = zip(*path, strict=True)
        truths = self._sequence.states[np.array(frames) - 1]
        last = -2 if reason and len(frames) > 1 else -1
        fate = Fate(
            self._run,
            np.array(frames),
            np.array(means),
            np.array(weights),
            reason,
            row,
            c,
            _error(means[last], truths[last]),
            _error(state.best.mean, truths[-1]),
        )
        self._fates.append(fate)


def _error(mean: Array, truth: Array) -> float:
    """Of the joint angles, root mean square [deg]."""
    return math.degrees(float(np.sqrt(np.mean((mean - truth)[_ANGLES] ** 2))))
