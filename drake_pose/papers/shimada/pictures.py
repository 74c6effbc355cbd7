"""Pictures of Shimada's synthetic experiment in the manner of the paper's figures 9 to 16."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drake_pose.filtering.hand.observation import (
    FLEXIONS,
    HAND_STATE,
    LENGTHS,
    PALM,
    QUATERNION,
    SPREADS,
    HandObservation,
)
from drake_pose.papers.shimada.experiment import (
    CASES,
    PIXELS_PER_METRE,
    ExperimentResult,
    Trial,
)
from drake_pose.papers.shimada.hypotheses import Fate, HypothesesResult
from drake_pose.papers.shimada.motion import FRAMES

Array = NDArray[np.float64]

_SHOWN_FRAMES = (1, 8, 16, 32, 40, 55)
_TRUE, _ESTIMATE, _REJECTED = "0.35", "#0072b2", "#d55e00"
# So many frames are drawn after a hypothesis is rejected.
_AFTERWARDS = 6


def save_pictures(result: ExperimentResult, folder: Path) -> list[Path]:
    """Draw the first run of each case.

    Args:
        result: the experiment.
        folder: where the PNG files go; made if it is not there.

    Returns:
        The files written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    first = {key: trials[0] for key, trials in result.trials.items()}
    trial = first["r13_35"]
    files = [
        _save_hands(folder / "figure_10_sequence.png", trial),
        _save_shapes(folder / "figure_11_shapes.png", first),
        _save_scale(folder / "figure_12_scale.png", trial),
    ]
    curves = (
        ("figure_13_palm_rotation", QUATERNION[1], trial, 1.0, "q_1"),
        ("figure_14_joint_angle", "flexion_13", trial, 180 / np.pi, "theta_13 [deg]"),
        ("figure_15_length_r13_35", "length_13", first["r13_35"], PIXELS_PER_METRE, "r_13 [pixel]"),
        ("figure_16_length_r13_40", "length_13", first["r13_40"], PIXELS_PER_METRE, "r_13 [pixel]"),
    )
    for name, element, shown, factor, label in curves:
        index = HAND_STATE.index(element)
        files.append(
            _save_curve(
                folder / f"{name}.png",
                label,
                factor * shown.sequence.states[:, index],
                factor * shown.means[:, index],
                factor * shown.deviations[:, index],
            )
        )
    return files


def save_hypotheses(result: HypothesesResult, folder: Path) -> list[Path]:
    """Draw the hypothesis that an inequality rejected, and the one that it left.

    Args:
        result: what became of all.
        folder: where the PNG file goes; made if it is not there.

    Returns:
        The file written; none where no inequality rejected a wrong one.
    """
    shown = result.shown()
    if shown is None:
        return []
    dead, survivor = shown
    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(13, 7.5))
    figure.suptitle(
        f"sequence {dead.run}: made in frame {dead.frames[0]}, rejected in frame "
        f"{dead.frames[-1]} by {dead.row} (c = {dead.c:.1f})\ngrey: true, blue: kept, orange: "
        "rejected",
        fontsize=10,
    )
    grid = figure.subplots(2, 3)
    _draw_moments(list(grid[0]), result, dead, survivor)
    states = result.sequences[dead.run].states
    k = result.inequalities.rows.index(dead.row)
    phi, b = result.inequalities.phi[k], float(result.inequalities.b[k])
    last = min(FRAMES, int(dead.frames[-1]) + _AFTERWARDS)
    ends = int(dead.frames[0]), last
    both = max(int(dead.frames[0]), int(survivor.frames[0]))
    apart = np.where(phi != 0, np.abs(dead.at(both) - survivor.at(both)), -1.0)
    name = HAND_STATE.names[int(np.argmax(apart))]
    one_element = np.zeros(len(HAND_STATE))
    one_element[HAND_STATE.index(name)] = 1.0
    angles = name in (*SPREADS, *FLEXIONS)
    factor, unit = (180 / np.pi, "deg") if angles else (PIXELS_PER_METRE, "pixel")
    side = ">=" if ">=" in dead.row else "<="
    sign = -1.0 if side == ">=" else 1.0
    row = f"{dead.row.split(side)[0]}{side} {sign * factor * b:.0f} {unit}"
    curves = ((one_element, f"{name} [{unit}]"), (sign * phi, row))
    for axes, (direction, label) in zip(grid[1], curves, strict=False):
        _draw_paths(axes, states, (dead, survivor), factor * direction, ends)
        axes.set_ylabel(label)
    grid[1, 1].axhline(sign * factor * b, color="black", linestyle="--")
    for one, colour in ((survivor, _ESTIMATE), (dead, _REJECTED)):
        grid[1, 2].semilogy(one.frames, one.weights, "-o", color=colour, ms=4)
    grid[1, 2].set_xlim(ends[0] - 0.5, ends[1] + 0.5)
    grid[1, 2].set_ylabel("weight (rejects nothing here)")
    for axes in grid[1]:
        axes.set_xlabel("t")
    return [_finish(figure, folder / "figure_9_hypotheses.png")]


def _draw_moments(line: list[Axes], result: HypothesesResult, dead: Fate, survivor: Fate) -> None:
    """Both hypotheses and the truth: when both are there, before the end, and in the end."""
    end = int(dead.frames[-1])
    frames = (max(int(dead.frames[0]), int(survivor.frames[0])), end - 1, end)
    for axes, frame in zip(line, frames, strict=True):
        _draw_hand(axes, result.sequences[dead.run].states[frame - 1], _TRUE)
        _draw_hand(axes, survivor.at(frame), _ESTIMATE)
        _draw_hand(axes, dead.at(frame), _REJECTED)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.set_title(f"t = {frame}" + (" (rejected)" if frame == end else ""), fontsize=9)


def _draw_paths(
    axes: Axes, states: Array, fates: tuple[Fate, Fate], direction: Array, ends: tuple[int, int]
) -> None:
    """What a direction of the state is in truth and to both hypotheses, over the frames."""
    frames = np.arange(ends[0], ends[1] + 1)
    axes.plot(frames, states[frames - 1] @ direction, color=_TRUE)
    for one, colour in zip(fates, (_REJECTED, _ESTIMATE), strict=True):
        axes.plot(one.frames, one.means @ direction, "-o", color=colour, mfc="white", ms=4)
    axes.plot(fates[0].frames[-1], fates[0].means[-1] @ direction, "x", color=_REJECTED, ms=12)
    axes.set_xlim(ends[0] - 0.5, ends[1] + 0.5)


def _draw_hand(axes: Axes, state: Array, colour: str) -> None:
    points = HandObservation(pixels_per_metre=PIXELS_PER_METRE).drawing(state)
    for finger in (points[:4], points[4:8]):
        axes.plot(finger[:, 0], finger[:, 1], "-o", color=colour, markersize=3, linewidth=2)
    for edge in (points[8:10], points[10:12], points[12:14]):
        axes.plot(edge[:, 0], edge[:, 1], color=colour, linewidth=1)


def _save_hands(path: Path, trial: Trial) -> Path:
    figure = Figure(figsize=(15, 5.2))
    grid = figure.subplots(2, len(_SHOWN_FRAMES), sharex=True, sharey=True)
    rows = (("true", trial.sequence.states, _TRUE), ("estimate", trial.means, _ESTIMATE))
    for line, (label, states, colour) in zip(grid, rows, strict=True):
        for axes, frame in zip(line, _SHOWN_FRAMES, strict=True):
            _draw_hand(axes, states[frame - 1], colour)
            axes.set_aspect("equal")
            axes.set_title(f"{label}, t = {frame}", fontsize=9)
    # Pixels count downwards.
    grid[0, 0].invert_yaxis()
    return _finish(figure, path)


def _save_shapes(path: Path, first: dict[str, Trial]) -> Path:
    """The hand laid flat: the first guess, the estimates and the truths."""
    figure = Figure(figsize=(12, 4))
    grid = figure.subplots(1, 3, sharex=True, sharey=True)
    trial = first["r13_35"]
    _draw_hand(grid[0], _flat(trial.sequence.guess.mean), _ESTIMATE)
    _draw_hand(grid[0], _flat(trial.sequence.states[0]), _TRUE)
    grid[0].set_title("(a) first guess", fontsize=9)
    for axes, label, (key, shown) in zip(grid[1:], "bc", first.items(), strict=True):
        _draw_hand(axes, _flat(shown.sequence.states[-1]), _TRUE)
        _draw_hand(axes, _flat(shown.means[-1]), _ESTIMATE)
        axes.set_title(f"({label}) at t = {FRAMES}, r_13 = {CASES[key]:.0f}", fontsize=9)
    for axes in grid:
        axes.set_aspect("equal")
    figure.suptitle("grey: true, blue: estimate", fontsize=9)
    return _finish(figure, path)


def _flat(state: Array) -> Array:
    flat = np.zeros_like(state)
    shape = HAND_STATE.indices((*LENGTHS, *PALM))
    flat[shape] = state[shape]
    # A quarter turn about the fingers' axis: the palm faces the camera.
    flat[HAND_STATE.indices(QUATERNION)] = np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0
    return flat


def _save_scale(path: Path, trial: Trial) -> Path:
    """The scale is the quaternion's squared norm; its deviation by linear propagation."""
    indices = HAND_STATE.indices(QUATERNION)
    true = np.sum(trial.sequence.states[:, indices] ** 2, axis=1)
    estimate = np.sum(trial.means[:, indices] ** 2, axis=1)
    # Elements taken as independent: an upper bound where errors of rotation dominate.
    slopes = 2 * trial.means[:, indices] * trial.deviations[:, indices]
    return _save_curve(path, "scale", true, estimate, np.linalg.norm(slopes, axis=1))


def _save_curve(path: Path, label: str, true: Array, estimate: Array, deviation: Array) -> Path:
    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    frames = np.arange(1, len(true) + 1)
    axes.errorbar(frames, estimate, 2 * deviation, fmt="o", color=_ESTIMATE, mfc="white", ms=4)
    axes.plot(frames, true, color=_TRUE)
    # Early bars may reach far beyond all that comes later.
    middle, reach = true.mean(), max(np.ptp(true), np.percentile(2 * deviation, 90), 1e-3)
    axes.set_ylim(middle - 1.6 * reach, middle + 1.6 * reach)
    axes.set_xlabel("t")
    axes.set_ylabel(label)
    axes.set_title("line: true; circles: estimate; bars: 2 standard deviations", fontsize=9)
    return _finish(figure, path)


def _finish(figure: Figure, path: Path) -> Path:
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    return path
