"""Experiments of Shimada, Shirai, Kuno and Miura (section 6): a synthetic hand of two fingers.

A truncated extended Kalman filter corrects joint angles and segment lengths over 55 frames of one
camera. Measured are numbers with noise, or silhouettes that Drake renders (figures 17 and 18).
"""

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.special import chdtri

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import SettingsError, require_at_least, require_choice
from drake_pose.filtering.hand import (
    FLEXIONS,
    HAND_STATE,
    LENGTHS,
    SPREADS,
    HandObservation,
    plant_positions,
)
from drake_pose.filtering.hand_model import TWO_FINGERS
from drake_pose.filtering.hand_silhouette import HandSilhouette
from drake_pose.filtering.inequalities import Inequalities, model_inequalities
from drake_pose.filtering.motion import LinearMotion
from drake_pose.filtering.truncated_filter import FilterSettings, FilterState, TruncatedFilter
from drake_pose.filtering.update import make_measurement, update
from drake_pose.papers.shimada_sequences import (
    ACCELERATIONS,
    FRAMES,
    OBSERVED,
    HandTrack,
    SyntheticSequence,
    experiment_settings,
    make_sequence,
    run_frames,
)
from drake_pose.papers.tables import Count, figure_table, uncounted
from drake_pose.systems.bodies import held_positions
from drake_pose.systems.truncated_ekf import build_hand_estimation

CASES = {"r13_35": 35.0, "r13_40": 40.0}
"""True lengths r_13 of finger 1's last segment, in two cases [pixel at scale 1, mm]."""

PIXELS_PER_METRE = 1000.0
LOST_ANGLE_ERROR = 20.0
"""A sequence is lost if the RMS error of its joint angles at the end exceeds this [deg]."""

PICTURES = "pictures"
"""Value of `observed`, besides OBSERVED, for silhouettes by Drake's renderer, parts unlabelled."""


@dataclass(frozen=True)
class HandsResult:
    """All runs of both cases, by the keys of ``CASES``, and the arguments of `run_experiment`."""

    trials: Mapping[str, tuple[HandTrack, ...]]
    seed: int
    settings: FilterSettings
    observed: str

    def as_json(self) -> dict[str, object]:
        """Return the figures of each case over its runs, and the settings."""
        return {
            **{key: _figures(case) for key, case in self.trials.items()},
            "runs": len(next(iter(self.trials.values()))),
            "seed": self.seed,
            "truncation": self.settings.truncation,
            "iterations": self.settings.iterations,
            "observed": self.observed,
        }


def result_table(result: HandsResult) -> Table:
    """Tabulate the figures of both cases."""
    rows = {
        "length_error_mean": ("length error, mean [pixel]", "{:.2f}"),
        "length_error_p95": ("  95th percentile", "{:.2f}"),
        "bound_length_error_mean": ("  bound: linearised at the truth", "{:.2f}"),
        "angle_rmse": ("joint angles over all frames, RMS error [deg]", "{:.2f}"),
        "angle_rmse_at_end": ("  at the end", "{:.2f}"),
        "length_error_largest": ("largest relative error of a length", "{:.1%}"),
        "inside_2sigma": ("true values within 2 sigma", "{:.1%}"),
        "inside_2sigma_all": ("  in all frames", "{:.1%}"),
        "nees_inside": ("runs with the lengths' NEES in its 95 % band", "{:.1%}"),
        "ms_per_update": ("milliseconds an update, median", "{:.2f}"),
        "ms_per_update_p95": ("  95th percentile", "{:.2f}"),
        "silhouette_difference": ("difference of silhouette and matched pose, median", "{:.1%}"),
        "mirrored": ("hypotheses made by mirroring", "{}"),
        "rejected_by_an_inequality": ("  rejected by an inequality", "{}"),
        "lost": ("lost", "{}"),
    }
    settings = result.settings
    return figure_table(
        f"Shimada, synthetic hand: {settings.truncation} truncation, {result.observed} "
        f"observation, linearisations: {settings.iterations} at most",
        rows,
        {key: _figures(case) for key, case in result.trials.items()},
        "figure (at t = 55 unless stated)",
    )


def run_experiment(
    runs: int,
    seed: int,
    settings: FilterSettings,
    observed: str = "lines",
    count: Count = uncounted,
) -> HandsResult:
    """Run the experiment of section 6 for r_13 = 35 and r_13 = 40.

    The paper does not give motion and noise; they are drawn, with standard deviations of 0.5 pixel
    for points, 1 pixel and 1 degree for lines. With pictures, Drake renders the same motions.

    Args:
        runs: number of runs of each case.
        seed: of the motions, the noise and the first guesses.
        settings: of the filter, as of ``experiment_settings``.
        observed: "lines": axes, tips and the palm's outline, as in the paper; "full": all; or
            PICTURES.
        count: reports progress.

    Raises SettingsError: an argument is not one of these.
    """
    require_at_least(1, runs=runs)
    require_choice("observed", observed, (*OBSERVED, PICTURES))
    hand_filter, observation = experiment_filter(settings)
    seen = "lines" if observed == PICTURES else observed
    follow = _filter_pictures if observed == PICTURES else _filter_sequence

    def filtered(run: int, r_13: float) -> HandTrack:
        generator = np.random.default_rng([seed, run, int(r_13)])
        return follow(hand_filter, make_sequence(r_13, seen, observation, generator))

    # The first call loads compiled code, which must not count as an update's time.
    filtered(0, min(CASES.values()))
    advance = count(f"sequences, {settings.truncation} truncation", runs * len(CASES))
    trials = {}
    for place, (key, r_13) in enumerate(CASES.items()):
        case = []
        for run in range(runs):
            case.append(filtered(run, r_13))
            advance(place * runs + run + 1)
        trials[key] = tuple(case)
    return HandsResult(trials, seed, settings, observed)


def experiment_filter(
    settings: FilterSettings | None = None,
) -> tuple[TruncatedFilter, HandObservation]:
    """Return the experiment's filter and its observation model.

    The filter's inequalities are table 1's, read from the bundled hand. ``settings``: None: those
    of ``experiment_settings``.
    """
    settings = settings or experiment_settings()
    rows = model_inequalities(_hand()).restricted_to(HAND_STATE.names)
    observation = HandObservation(pixels_per_metre=PIXELS_PER_METRE)
    motion = LinearMotion(HAND_STATE.transition(), HAND_STATE.process_noise(ACCELERATIONS), None)
    return TruncatedFilter(HAND_STATE, observation, rows, motion, settings), observation


def _hand() -> ArticulatedModel:
    """Return the bundled model of the two-finger hand."""
    return load_model(bundled_model("two_finger_hand"), check=False)


def angle_error(means: Array, truths: Array) -> Array:
    """Return the RMS errors (...) [deg] of joint angles, in estimated and true states (..., n)."""
    errors = (means - truths)[..., HAND_STATE.indices((*SPREADS, *FLEXIONS))]
    return np.asarray(np.degrees(np.sqrt(np.mean(errors**2, axis=-1))))


def _filter_sequence(hand_filter: TruncatedFilter, sequence: SyntheticSequence) -> HandTrack:
    """Filter a sequence, also without limits and at the truth; a failure keeps the last belief."""
    states, times, broken = [], [], False
    state = hand_filter.start(sequence.guess)
    for t, y in enumerate(sequence.measurements):
        begin = time.thread_time()
        milliseconds = math.nan
        if not broken:
            try:
                state = hand_filter.update(hand_filter.predict(state) if t else state, y)
                milliseconds = 1e3 * (time.thread_time() - begin)
            except SettingsError:
                # A filter without limits that has diverged has no valid covariance: it is lost.
                broken = True
        states.append(state)
        times.append(milliseconds)
    # The bound: a filter that linearises at the truth and has no limits.
    belief = sequence.guess
    for t, (truth, y) in enumerate(zip(sequence.states, sequence.measurements, strict=True)):
        if t:
            belief = hand_filter.predict_belief(belief)
        belief = update(belief, make_measurement(hand_filter.observation, y), 1, truth).belief
    return HandTrack(states, np.array(times), sequence.states, belief.mean)


def _filter_pictures(hand_filter: TruncatedFilter, sequence: SyntheticSequence) -> HandTrack:
    """Filter a sequence's silhouettes in a diagram of plant, renderer, sensor and filter."""
    # The focal length is so long that perspective is weak: half the picture is 0.3 degrees wide.
    width, height, distance, period = 480, 400, 50.0, 1.0 / 30.0
    center = (0.5 * (width - 1), 0.5 * (height - 1))
    focal, X_WC = PIXELS_PER_METRE * distance, np.eye(4)
    X_WC[2, 3] = -distance
    camera = PinholeCamera(
        "camera", width, height, focal, focal, *center, X_WC, near=0.5 * distance
    )
    # The palm's sizes along the axes of its frame.
    names = ("palm_height", "palm_thickness", "palm_width")
    sizes = sequence.states[0, HAND_STATE.indices(names)]
    factors = sizes / [TWO_FINGERS.sizes[name] for name in names]
    model = _hand().reshaped(link_scales={"palm": factors})
    joints = model.position_names
    q = [plant_positions(x, joints, PIXELS_PER_METRE, distance) for x in sequence.states]
    positions = held_positions(np.array(q), period)
    silhouette = HandSilhouette(hand_filter, width, height, center)
    parts = build_hand_estimation(model, camera, silhouette, sequence.guess, positions, period)
    # Keep three frames for the pictures.
    track = run_frames(parts, period, FRAMES, (7, 23, 39), lambda _done: None)
    return replace(track, truths=sequence.states)


def _figures(tracks: Sequence[HandTrack]) -> dict[str, float | int]:
    """Return the figures of a case by key, from all its runs.

    The NEES of the six lengths is 6 on average if the filter's covariance is consistent.
    """
    lengths_of, angles_of = HAND_STATE.indices(LENGTHS), HAND_STATE.indices((*SPREADS, *FLEXIONS))
    truths = np.array([track.truths for track in tracks])
    means = np.array([track.means for track in tracks])
    errors = (means - truths)[:, -1]
    lengths = PIXELS_PER_METRE * np.mean(np.abs(errors[:, lengths_of]), axis=1)
    angles = angle_error(means, truths)
    watched = np.concatenate([lengths_of, angles_of])
    own_lengths = np.ix_(lengths_of, lengths_of)
    nees = np.array([
        off @ np.linalg.pinv(track.states[-1].best.covariance[own_lengths], hermitian=True) @ off
        for track, off in zip(tracks, errors[:, lengths_of], strict=True)
    ])  # fmt: skip
    low, high = chdtri(len(LENGTHS), [0.975, 0.025])
    lost = ~((lengths < 5.0) & (angles[:, -1] < LOST_ANGLE_ERROR))
    milliseconds = np.array([track.milliseconds for track in tracks])
    inside = np.abs(means - truths) < 2 * np.array([track.deviations for track in tracks])
    shares = np.abs(errors[:, lengths_of]) / truths[:, -1, lengths_of]
    own: dict[str, float | int] = {}
    if len(tracks[0].differences):
        own["silhouette_difference"] = float(np.median([track.differences for track in tracks]))
    else:
        bounds = (np.array([track.bound for track in tracks]) - truths[:, -1])[:, lengths_of]
        own["bound_length_error_mean"] = float(PIXELS_PER_METRE * np.mean(np.abs(bounds)))
    return {
        "length_error_mean": float(lengths.mean()),
        "length_error_p95": float(np.percentile(lengths, 95)),
        "angle_rmse": float(np.sqrt(np.mean(angles**2))),
        "inside_2sigma": float(np.mean(inside[:, -1, watched])),
        "nees_inside": float(np.mean((nees > low) & (nees < high))),
        "inside_2sigma_all": float(np.mean(inside[:, :, watched])),
        "length_error_largest": float(shares.max()),
        "ms_per_update": float(np.nanmedian(milliseconds)),
        "ms_per_update_p95": float(np.nanpercentile(milliseconds, 95)),
        "mirrored": sum(track.mirrored for track in tracks),
        "rejected_by_an_inequality": sum(track.rejected for track in tracks),
        "lost": int(np.count_nonzero(lost)),
        "angle_rmse_at_end": float(np.sqrt(np.mean(angles[:, -1] ** 2))),
        **own,
    }


OBLIQUENESS = math.radians(60)
"""Angle of the fingers out of the image plane, so that segments bend back through it [rad]."""

COUPLED = ("flexion_12 - flexion_13", "flexion_22 - flexion_23")
"""Rows of table 1 that couple two joints of one finger."""


@dataclass(frozen=True, eq=False)
class HypothesisHistory:
    """A hypothesis of one run, from the frame in which it was made to its end."""

    run: int  # Index of the run.
    # (k,) frames in which it lived, counted from 1; in the last one it ended.
    frames: NDArray[np.int64]
    means: Array  # (k, n) mean states; the last one before truncation if it was rejected.
    weights: Array  # (k,) between 0 and 1; NaN in the last frame if it was rejected.
    # reason, row, c: as of ``Rejection``; the reason is "" if it outlived the sequence.
    reason: str
    row: str
    c: float
    error: float  # RMS error of its joint angles in its last valid frame [deg].
    kept_error: float  # That of the heaviest hypothesis in the frame of its end [deg].

    def at(self, frame: int) -> Array:
        """Return the mean state (n,) in a frame in which it lived."""
        return np.asarray(self.means[frame - self.frames[0]])

    @property
    def lived(self) -> int:
        """Number of frames in which it was valid."""
        return len(self.frames) - (1 if self.reason else 0)

    @property
    def wrong(self) -> bool:
        """Whether its error is larger than that of the hypothesis that was kept."""
        return self.error > self.kept_error


@dataclass(frozen=True, eq=False)
class HypothesesResult:
    """All hypotheses of all runs."""

    histories: tuple[HypothesisHistory, ...]
    sequences: tuple[SyntheticSequence, ...]  # Of each run.
    final_errors: Array  # (runs,) RMS errors of the heaviest hypothesis's angles at the end [deg].
    inequalities: Inequalities  # Of the filter.
    settings: Mapping[str, object]  # Arguments of the experiment by name.

    def example(self) -> tuple[HypothesisHistory, HypothesisHistory] | None:
        """Return a wrong hypothesis that an inequality rejected, and its survivor (figure 9).

        Of those that lived longer than a frame, one that the paper's inequality rejected is
        preferred, then the largest weight. Its survivor is the one nearest to the truth. None:
        there is no such hypothesis.
        """
        rejected = [one for one in self.histories if one.reason == "constraint" and one.wrong]
        rejected = [one for one in rejected if one.lived > 1]
        rejected.sort(key=lambda one: (one.row.startswith(COUPLED), one.weights[-2]), reverse=True)
        for removed in rejected:
            end = int(removed.frames[-1])
            own = [one for one in self.histories if one.run == removed.run]
            beside = [one for one in own if one.frames[0] < end < one.frames[-1]]
            truth = self.sequences[removed.run].states[end - 1]
            if beside:
                return removed, min(beside, key=lambda one: float(angle_error(one.at(end), truth)))
        return None

    def as_json(self) -> dict[str, object]:
        """Return counts over all runs, and the settings."""
        rejected = [one for one in self.histories if one.reason == "constraint"]
        later = [one for one in rejected if one.lived]
        counts = Counter(one.reason for one in self.histories)
        return {
            "mirrored": len(self.histories) - len(self.sequences),
            "became_another": counts["twin"],
            "too_many": counts["cap"],
            "alive_at_the_end": counts[""],
            "rejected_by_an_inequality": len(rejected),
            "rejected_later_than_made": len(later),
            "of_these_wrong": sum(one.wrong for one in later),
            "of_these_by_coupled_joints": sum(one.row.startswith(COUPLED) for one in later),
            "frames_lived_median": float(np.median([f.lived for f in later])) if later else None,
            "angle_error_at_end": float(np.median(self.final_errors)),
            "lost": int(np.count_nonzero(self.final_errors > LOST_ANGLE_ERROR)),
            **self.settings,
        }

    def table(self) -> Table:
        """Tabulate the counts of `as_json`."""
        rows = {
            "mirrored": ("made by mirroring", "{}"),
            "became_another": ("dropped as equal to another", "{}"),
            "too_many": ("dropped as more than eight", "{}"),
            "alive_at_the_end": ("alive at the end", "{}"),
            "rejected_by_an_inequality": ("rejected by an inequality", "{}"),
            "rejected_later_than_made": ("  of these valid for a frame or more", "{}"),
            "of_these_wrong": ("    of these with a larger error than the kept one", "{}"),
            "of_these_by_coupled_joints": ("    of these by a coupling of two joints", "{}"),
            "frames_lived_median": ("    frames valid, median", "{:.1f}"),
            "angle_error_at_end": ("joint angles at the end, RMS error, median [deg]", "{:.1f}"),
            "lost": ("sequences with an error above 20 degrees at the end", "{}"),
        }
        figures = self.as_json()
        title = (
            f"Shimada, figure 9: {figures['truncation']} truncation, lines observation, "
            f"{figures['iterations']} linearisations at most"
        )
        heading = f"hypotheses in {figures['runs']} sequences"
        return figure_table(title, rows, {"ours": figures}, heading)


def run_hypotheses_experiment(
    runs: int, seed: int, settings: FilterSettings, count: Count = uncounted
) -> HypothesesResult:
    """Follow every hypothesis while fingers bend through the image plane, as in figure 9.

    In figure 9 the depth of a third segment is ambiguous in frame 18, and the wrong hypothesis is
    rejected in frame 20. The motion is that of ``run_experiment``, with the fingers pointing out of
    the image plane, and lines are observed. Arguments and errors are those of ``run_experiment``.
    """
    require_at_least(1, runs=runs)
    # A hypothesis ends only by an inequality, by being equal to another, or as one of more than 8.
    settings = replace(settings, hypothesis_cap=8)
    hand_filter, observation = experiment_filter(settings)
    advance = count("sequences", runs)
    histories: list[HypothesisHistory] = []
    sequences, final_errors = [], []
    for run in range(runs):
        generator = np.random.default_rng([seed, run])
        sequence = make_sequence(35.0, "lines", observation, generator, OBLIQUENESS)
        state, states = hand_filter.start(sequence.guess), []
        for t, y in enumerate(sequence.measurements):
            state = hand_filter.update(hand_filter.predict(state) if t else state, y)
            states.append(state)
        histories += _histories(run, sequence.states, states)
        sequences.append(sequence)
        final_errors.append(angle_error(state.best.mean, sequence.states[-1]))
        advance(run + 1)
    made = {"runs": runs, "seed": seed, "observed": "lines"}
    made |= {"truncation": settings.truncation, "iterations": settings.iterations}
    return HypothesesResult(
        tuple(histories), tuple(sequences), np.array(final_errors), hand_filter.inequalities, made
    )


def _histories(run: int, truths: Array, states: Sequence[FilterState]) -> list[HypothesisHistory]:
    """Return all hypotheses of one run; those that outlived the sequence come last.

    ``run``: index of the run. ``truths``: (frames, n) true states. ``states``: of the filter after
    each frame.
    """
    histories: list[HypothesisHistory] = []
    believed: dict[tuple[int, int], list[tuple[int, Array, float]]] = {}

    def close(path: Sequence[tuple[int, Array, float]], kept: Array,
              reason: str = "", row: str = "", c: float = math.nan) -> None:  # fmt: skip
        """Store the history of a path of (frame, mean, weight).

        `kept` (n,) is the mean of the heaviest hypothesis in the last frame; `reason`, `row` and
        `c` are those of its rejection, if it was rejected.
        """
        frames, means, weights = (np.array(one) for one in zip(*path, strict=True))
        own = truths[frames - 1]
        last = -2 if reason and len(frames) > 1 else -1
        error, kept_error = angle_error(means[last], own[last]), angle_error(kept, own[-1])
        told = reason, row, c, float(error), float(kept_error)
        histories.append(HypothesisHistory(run, frames, means, weights, *told))

    for state in states:
        for end in state.rejections:
            path = believed.pop((end.hypothesis.born, end.hypothesis.number), [])
            path.append((state.step, end.hypothesis.belief.mean, math.nan))
            close(path, state.best.mean, end.reason, end.row, end.c)
        for one in state.hypotheses:
            path = believed.setdefault((one.born, one.number), [])
            path.append((state.step, one.belief.mean, one.weight))
    for path in believed.values():
        close(path, states[-1].best.mean)
    return histories
