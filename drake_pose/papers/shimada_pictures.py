"""Pictures of Shimada's experiments, as the paper's figures 9 to 18."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drake_pose.arrays import Array
from drake_pose.filtering.hand import FLEXIONS, HAND_STATE, SPREADS, HandObservation
from drake_pose.filtering.hand_model import QUATERNION, TWO_FINGERS, HandModel
from drake_pose.papers.shimada import (
    CASES,
    PICTURES,
    PIXELS_PER_METRE,
    FilteredHand,
    HandsResult,
    HypothesesResult,
)
from drake_pose.papers.shimada_sequences import FRAMES, HandTrack, SequenceResult
from drake_pose.papers.tables import save_figure

_OBSERVATION = HandObservation(pixels_per_metre=PIXELS_PER_METRE)
_TRUE, _ESTIMATE, _REJECTED = "0.35", "#0072b2", "#d55e00"
_DEGREES = 180 / np.pi


def save_pictures(result: HandsResult, folder: Path) -> list[Path]:
    """Draw the first run of each case into files of a folder; return the PNG files."""
    first = {key: trials[0] for key, trials in result.trials.items()}
    trial = first["r13_35"]
    curves = (
        ("figure_13_palm_rotation", QUATERNION[1], trial, 1.0, "q_1"),
        ("figure_14_joint_angle", "flexion_13", trial, _DEGREES, "theta_13 [deg]"),
        ("figure_15_length_r13_35", "length_13", first["r13_35"], PIXELS_PER_METRE, "r_13 [pixel]"),
        ("figure_16_length_r13_40", "length_13", first["r13_40"], PIXELS_PER_METRE, "r_13 [pixel]"),
    )
    # The scale is the quaternion's squared norm. Its deviation is propagated as if elements were
    # independent: an upper bound where errors of rotation dominate.
    elements, track = HAND_STATE.indices(QUATERNION), trial.track
    true, estimate = (
        np.sum(one[:, elements] ** 2, axis=1) for one in (trial.sequence.states, track.means)
    )
    slopes = 2 * track.means[:, elements] * track.deviations[:, elements]
    scale = _draw_curve("scale", true, estimate, np.linalg.norm(slopes, axis=1))
    figures = {"figure_12_scale": scale}
    if result.observed == PICTURES:
        figures["figure_17_pictures"] = _draw_matches(trial.track)
        figures["figure_18_shapes"] = _draw_shapes(first)
    else:
        figures["figure_10_sequence"] = _draw_sequence(trial)
        figures["figure_11_shapes"] = _draw_shapes(first)
    for name, element, shown, factor, label in curves:
        index = HAND_STATE.index(element)
        values = shown.sequence.states, shown.track.means, shown.track.deviations
        figures[name] = _draw_curve(label, *(factor * one[:, index] for one in values))
    return [save_figure(figure, folder / f"{name}.png") for name, figure in figures.items()]


def save_hypotheses(result: HypothesesResult, folder: Path) -> list[Path]:
    """Draw a hypothesis that an inequality rejected, and its survivor; return the PNG files.

    There are none if no hypothesis was rejected so. Above: both with the truth. Below: the joint
    that differs most, the inequality, the weights.
    """
    shown = result.example()
    if shown is None:
        return []
    rejected, survivor = shown
    truths, begin, end = (
        result.sequences[rejected.run].states,
        int(rejected.frames[0]),
        int(rejected.frames[-1]),
    )
    figure = Figure(figsize=(13, 7.5))
    figure.suptitle(
        f"sequence {rejected.run}: made in frame {begin}, rejected in frame {end} by "
        f"{rejected.row} (c = {rejected.c:.1f})\ngrey: true, blue: kept, orange: rejected",
        fontsize=10,
    )
    grid = figure.subplots(2, 3)
    both = max(begin, int(survivor.frames[0]))
    for axes, frame in zip(grid[0], (both, end - 1, end), strict=True):
        _draw_hand(axes, truths[frame - 1], _TRUE)
        _draw_hand(axes, survivor.at(frame), _ESTIMATE)
        _draw_hand(axes, rejected.at(frame), _REJECTED)
        axes.invert_yaxis()
        axes.set_title(f"t = {frame}" + (" (rejected)" if frame == end else ""), fontsize=9)
    k = result.inequalities.rows.index(rejected.row)
    phi, b = result.inequalities.phi[k], float(result.inequalities.b[k])
    apart = np.where(phi != 0, np.abs(rejected.at(both) - survivor.at(both)), -1.0)
    widest = int(np.argmax(apart))
    name = HAND_STATE.names[widest]
    factor, unit = (
        (_DEGREES, "deg") if name in (*SPREADS, *FLEXIONS) else (PIXELS_PER_METRE, "pixel")
    )
    side, sign = (">=", -1.0) if ">=" in rejected.row else ("<=", 1.0)
    row = f"{rejected.row.split(side)[0]}{side} {sign * factor * b:.0f} {unit}"
    curves = ((np.eye(len(HAND_STATE))[widest], f"{name} [{unit}]"), (sign * phi, row))
    frames = np.arange(begin, min(FRAMES, end + 6) + 1)
    for axes, (direction, label) in zip(grid[1], curves, strict=False):
        axes.plot(frames, factor * truths[frames - 1] @ direction, color=_TRUE)
        for one, colour in ((rejected, _REJECTED), (survivor, _ESTIMATE)):
            path = factor * one.means @ direction
            axes.plot(one.frames, path, "-o", color=colour, mfc="white", ms=4)
        axes.plot(end, factor * rejected.means[-1] @ direction, "x", color=_REJECTED, ms=12)
        axes.set_ylabel(label)
    grid[1, 1].axhline(sign * factor * b, color="black", linestyle="--")
    for one, colour in ((survivor, _ESTIMATE), (rejected, _REJECTED)):
        grid[1, 2].semilogy(one.frames, one.weights, "-o", color=colour, ms=4)
    grid[1, 2].set_ylabel("weight (rejects nothing here)")
    for axes in grid[1]:
        axes.set(xlabel="t", xlim=(frames[0] - 0.5, frames[-1] + 0.5))
    return [save_figure(figure, folder / "figure_9_hypotheses.png")]


def _draw_hand(
    axes: Axes, state: Array, colour: str, observation: HandObservation = _OBSERVATION
) -> None:
    """Draw the fingers' axes and joints and the palm's outline for a state (n,) [pixel]."""
    points, shape = observation.drawing(state), observation.hand.radii.shape
    for finger in points[: shape[0] * shape[1]].reshape(*shape, 2):
        axes.plot(finger[:, 0], finger[:, 1], "-o", color=colour, markersize=3, linewidth=2)
    for edge in points[-8:].reshape(-1, 2, 2):
        axes.plot(edge[:, 0], edge[:, 1], color=colour, linewidth=1)
    axes.set_aspect("equal")


def _draw_sequence(trial: FilteredHand) -> Figure:
    """Draw figure 10: true and estimated hands in six frames."""
    figure = Figure(figsize=(15, 5.2))
    frames = (1, 8, 16, 32, 40, 55)
    grid = figure.subplots(2, len(frames), sharex=True, sharey=True)
    rows = (("true", trial.sequence.states, _TRUE), ("estimate", trial.track.means, _ESTIMATE))
    for line, (label, states, colour) in zip(grid, rows, strict=True):
        for axes, frame in zip(line, frames, strict=True):
            _draw_hand(axes, states[frame - 1], colour)
            axes.set_title(f"{label}, t = {frame}", fontsize=9)
    # Pixel rows count downwards.
    grid[0, 0].invert_yaxis()
    return figure


def _draw_matches(track: HandTrack, observation: HandObservation = _OBSERVATION) -> Figure:
    """Draw figure 17: silhouettes, matched rough poses, measured axes and tips, and estimates."""
    kept = track.kept
    figure = Figure(figsize=(3.6 * len(kept), 11))
    grid = figure.subplots(4, len(kept))
    axis_rows = _rows_of(observation, "alpha_", "rho_")
    tips = _rows_of(observation, "_x", "_y")[:, 4::4]
    for column, (frame, (mask, y, rough)) in zip(grid.T, kept.items(), strict=True):
        rows, cols = np.nonzero(mask)
        height, width = mask.shape
        # The state's origin is the picture's middle.
        extent = (-0.5 * width, 0.5 * width, 0.5 * height, -0.5 * height)
        u, v = cols - 0.5 * (width - 1), rows - 0.5 * (height - 1)
        for axes in column:
            axes.imshow(mask, cmap="gray_r", alpha=0.35, extent=extent, vmin=0, vmax=1)
            axes.set(xlim=(u.min() - 15, u.max() + 15), ylim=(v.max() + 15, v.min() - 15))
            axes.set(xticks=[], yticks=[])
        column[0].set_title(f"t = {frame + 1}", fontsize=9)
        _draw_hand(column[1], rough, _REJECTED, observation)
        for alpha, rho in y[axis_rows].T:
            direction = np.array([np.cos(alpha), np.sin(alpha)])
            foot, reach = rho * np.array([-direction[1], direction[0]]), 1e3
            ends = foot + np.outer((-reach, reach), direction)
            column[2].plot(ends[:, 0], ends[:, 1], color=_REJECTED, linewidth=0.8)
        column[2].plot(*y[tips], "o", color=_ESTIMATE, markersize=4)
        _draw_hand(column[3], track.means[frame], _ESTIMATE, observation)
    for axes, label in zip(
        grid[:, 0], ("picture", "rough pose", "measured", "estimate"), strict=True
    ):
        axes.set_ylabel(label)
    return figure


def _rows_of(observation: HandObservation, first: str, second: str) -> NDArray[np.intp]:
    """Return the indices (2, k) of measurements whose names contain `first`, and `second`."""
    names = list(enumerate(observation.names))
    kinds = [[k for k, name in names if part in name] for part in (first, second)]
    return np.array(kinds, dtype=np.intp)


def save_sequence(result: SequenceResult, folder: Path) -> list[Path]:
    """Draw figures 17 and 18 of a recorded sequence into a folder; return the PNG files."""
    observation = result.observation
    figures = {
        "figure_17": _draw_matches(result.track, observation),
        "figure_18": Figure(figsize=(11, 5)),
    }
    grid = figures["figure_18"].subplots(1, 2, sharex=True, sharey=True)
    panels = ("(a) first guess", result.guess.mean), ("(b) estimate", result.track.means[-1])
    for axes, (title, state) in zip(grid, panels, strict=True):
        _draw_hand(axes, _flat(state, observation.hand), _ESTIMATE, observation)
        axes.set_title(f"{title}, pixels at the first frame's scale", fontsize=9)
    return [
        save_figure(figure, folder / f"{name}_{result.name}.png")
        for name, figure in figures.items()
    ]


def _draw_shapes(first: dict[str, FilteredHand]) -> Figure:
    """Draw the hand laid flat: first guess, estimates and true shapes of each case's first run."""
    figure = Figure(figsize=(12, 4))
    grid = figure.subplots(1, 3, sharex=True, sharey=True)
    sequence = first["r13_35"].sequence
    panels = [("(a) first guess", sequence.states[0], sequence.guess.mean)]
    for label, (key, shown) in zip("bc", first.items(), strict=True):
        title = f"({label}) at t = {FRAMES}, r_13 = {CASES[key]:.0f}"
        panels.append((title, shown.sequence.states[-1], shown.track.means[-1]))
    for axes, (title, true, estimate) in zip(grid, panels, strict=True):
        _draw_hand(axes, _flat(true), _TRUE)
        _draw_hand(axes, _flat(estimate), _ESTIMATE)
        axes.set_title(title, fontsize=9)
    figure.suptitle("grey: true, blue: estimate", fontsize=9)
    return figure


def _flat(state: Array, hand: HandModel = TWO_FINGERS) -> Array:
    """Return the state (n,) of a hand with the sizes in `state` (n,), laid flat: all angles 0."""
    flat = np.zeros_like(state)
    shape = hand.layout.indices(hand.layout.constant)
    flat[shape] = state[shape]
    # A quarter turn about the fingers' axis makes the palm face the camera.
    flat[hand.layout.indices(QUATERNION)] = np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0
    return flat


def _draw_curve(label: str, true: Array, estimate: Array, deviation: Array) -> Figure:
    """Draw true and estimated values (frames,) with 2 deviations, in the unit of `label`."""
    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    frames = np.arange(1, len(true) + 1)
    axes.errorbar(frames, estimate, 2 * deviation, fmt="o", color=_ESTIMATE, mfc="white", ms=4)
    axes.plot(frames, true, color=_TRUE)
    # Limit the axis, because early bars may reach far beyond all later values.
    middle, reach = true.mean(), max(np.ptp(true), np.percentile(2 * deviation, 90), 1e-3)
    axes.set(xlabel="t", ylabel=label, ylim=(middle - 1.6 * reach, middle + 1.6 * reach))
    axes.set_title("line: true; circles: estimate; bars: 2 standard deviations", fontsize=9)
    return figure
