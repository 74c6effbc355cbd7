"""Pictures of the papers' experiments, in the colours of the overlays of result folders.

Kameda: true poses and estimates over their silhouettes, by outcome (figures 7 to 12). Shimada:
true and estimated hands, angles and lengths over time (figures 10 to 18), and a rejected hypothesis
(figure 9). Date: true and captured persons (figure 7), and the walk through a place (figure 8).
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.files.folder import write_file
from drake_pose.files.overlay import (
    BACKGROUND_RGB,
    EXCESS_RGB,
    MISSING_RGB,
    PALETTE,
    draw_overlay,
    draw_shapes,
    encode_png,
)
from drake_pose.filtering.hand import FLEXIONS, HAND_STATE, SPREADS, HandObservation
from drake_pose.filtering.hand_model import QUATERNION
from drake_pose.papers.date import TITLES, DateResult
from drake_pose.papers.kameda import RandomPose, RandomPoses, experiment_camera
from drake_pose.papers.shimada import PIXELS_PER_METRE, HandsResult, HypothesesResult
from drake_pose.papers.shimada_sequences import FRAMES, RecordedHand
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

_TWO_FINGERS = HandObservation(pixels_per_metre=PIXELS_PER_METRE)
_TRUE, _ESTIMATE, _REJECTED = "0.35", "#0072b2", "#d55e00"

OUTCOMES: Mapping[str, Callable[[RandomPose], bool]] = {
    "figure_07_pose_right": lambda one: one.pose_equal,
    "figure_08_wrong_part_hidden": lambda one: one.causes is not None and one.causes.hidden,
    "figure_09_inner_edges_differ": lambda one: one.causes == (False, True),
    "figure_10_improved": lambda one: one.improved,
    "figure_12_not_matched": lambda one: one.result.found and not one.exact,
}
"""Whether a pose of Kameda's experiment A belongs into a picture, by the picture's name."""


def save_poses(result: RandomPoses, folder: Path, most: int = 4) -> None:
    """Draw up to ``most`` poses of each outcome of Kameda's experiment A into PNG files.

    A row is a pose: the true one, the estimate, and both from the body's left. The silhouette is
    the true pose's; borders are those between the segments of the pose that is named.
    """
    tree = result.search.tree
    front, side = (LabelRenderer(tree.model, one) for one in (
        result.cameras[0], experiment_camera(0.5 * np.pi)
    ))  # fmt: skip
    for name, is_kind in OUTCOMES.items():
        rows = []
        for trial in [one for one in result.trials if is_kind(one)][:most]:
            poses = tree.positions_from(trial.true_values)[0], trial.result.q
            true, found, true_side, found_side = (
                one.segments(q) for one in (front, side) for q in poses
            )
            said = f"estimate: E_total {trial.result.E_total:.2%}, {trial.result.runs} runs"
            panels = ((true, true, "true pose"), (true, found, said),
                      (true_side, found_side, "estimate from the side"))  # fmt: skip
            rows.append([PALETTE[draw_overlay(a >= 0, b >= 0, b, title)] for a, b, title in panels])
        _save_rows(rows, folder, name)


def save_captures(result: DateResult, folder: Path) -> None:
    """Draw the middle frame of each of Date's motions, a row each, a column for each method.

    The true skeleton is blue; the captured person's contour and skeleton are orange.
    """
    rows = []
    for motion, (picture, true_limbs, captured) in result.samples.items():
        row = []
        for method, (limbs, body) in captured.items():
            drawn = picture.copy()
            for ends, colour in ((true_limbs, MISSING_RGB), (limbs, EXCESS_RGB)):
                lines = [*np.rint(ends).astype(np.int32)]
                cv2.polylines(drawn, lines, False, colour, 2, cv2.LINE_AA)
                # The trunk is drawn from shoulder to shoulder and hip to hip.
                trunk = np.rint(ends[[0, 1, 3, 2], 0]).astype(np.int32)
                cv2.polylines(drawn, [trunk], True, colour, 2, cv2.LINE_AA)
            row.append(draw_overlay(drawn, body, None, f"{motion}: {TITLES[method]}"))
        rows.append(row)
    _save_rows(rows, folder, "figure_07")


def save_walk(pictures: Mapping[str, tuple[Picture, Picture]], folder: Path) -> None:
    """Draw Date's figure 8 from the pictures of a walk: the input, and the walk through a place."""
    rows = [[draw_shapes(seen, (), (), command), draw_shapes(walk, (), (), "virtual walk")]
            for command, (seen, walk) in pictures.items()]  # fmt: skip
    _save_rows(rows, folder, "figure_08")


def _save_rows(rows: Sequence[Sequence[Picture]], folder: Path, name: str) -> None:
    """Write rows of pictures (H, W, 3) of any sizes as a PNG file; no file if there are none."""
    if not rows:
        return
    widths = [max(one.shape[1] for one in column) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        height = max(one.shape[0] for one in row)
        lines.append(np.hstack([
            cv2.copyMakeBorder(
                one, 0, height - one.shape[0], 0, width - one.shape[1],
                cv2.BORDER_CONSTANT, value=BACKGROUND_RGB,
            )
            for one, width in zip(row, widths, strict=True)
        ]))  # fmt: skip
    write_file(folder, f"{name}.png", encode_png(np.vstack(lines)))


def save_hands(result: HandsResult, folder: Path) -> None:
    """Draw the first run of each of Shimada's cases into a PNG file named after the case.

    Above: true hands (grey, or their silhouettes) and estimates (blue). Below: the palm's rotation,
    a joint angle, and the length in question, with two standard deviations.
    """
    for case, (track, *_) in result.trials.items():
        figure = Figure(figsize=(13.0, 7.0), layout="tight")
        grid, states = figure.subplots(2, 3), track.truths
        for axes, frame in zip(grid[0], (7, 23, 39), strict=True):
            if frame in track.kept:
                _draw_silhouette(axes, track.kept[frame])
            else:
                _draw_hand(axes, states[frame], _TRUE)
                axes.invert_yaxis()
            _draw_hand(axes, track.means[frame], _ESTIMATE)
            axes.set(title=f"t = {frame + 1}", aspect="equal")
        curves = ((QUATERNION[1], 1.0, "q_1"), ("flexion_13", np.degrees(1.0), "theta_13 [deg]"),
                  ("length_13", PIXELS_PER_METRE, "r_13 [pixel]"))  # fmt: skip
        for axes, (element, factor, label) in zip(grid[1], curves, strict=True):
            k, frames = HAND_STATE.index(element), np.arange(1, FRAMES + 1)
            estimate, bars = factor * track.means[:, k], 2.0 * factor * track.deviations[:, k]
            axes.errorbar(frames, estimate, bars, fmt="o", color=_ESTIMATE, mfc="white", ms=4)
            axes.plot(frames, factor * states[:, k], color=_TRUE)
            axes.set(xlabel="t", ylabel=label)
        _save_figure(figure, folder, case)


def save_hypotheses(result: HypothesesResult, folder: Path) -> bool:
    """Draw a hypothesis that an inequality rejected, and its survivor; return whether there is one.

    Above: the true hand (grey), the survivor (blue) and the rejected hand (orange). Below: the
    element in which they differ most, and the weights.
    """
    shown = result.example()
    if shown is None:
        return False
    rejected, survivor = shown
    truths, end = result.sequences[rejected.run].states, int(rejected.frames[-1])
    first = max(int(rejected.frames[0]), int(survivor.frames[0]))
    figure = Figure(figsize=(13.0, 7.0), layout="tight")
    figure.suptitle(f"sequence {rejected.run}: rejected at t = {end} by {rejected.row}")
    grid = figure.subplots(2, 2)
    for axes, frame in zip(grid[0], (first, end - 1), strict=True):
        _draw_hand(axes, truths[frame - 1], _TRUE)
        _draw_hand(axes, survivor.at(frame), _ESTIMATE)
        _draw_hand(axes, rejected.at(frame), _REJECTED)
        axes.invert_yaxis()
        axes.set(title=f"t = {frame}", aspect="equal")
    angles = HAND_STATE.indices((*SPREADS, *FLEXIONS))
    k = int(angles[np.argmax(np.abs(rejected.at(first) - survivor.at(first))[angles])])
    frames = np.arange(rejected.frames[0], end + 1)
    grid[1, 0].plot(frames, np.degrees(truths[frames - 1, k]), color=_TRUE)
    for one, colour in ((rejected, _REJECTED), (survivor, _ESTIMATE)):
        until = one.frames <= end
        grid[1, 0].plot(one.frames[until], np.degrees(one.means[until, k]), "-o", color=colour)
        grid[1, 1].semilogy(one.frames[until], one.weights[until], "-o", color=colour)
    grid[1, 0].set(xlabel="t", ylabel=f"{HAND_STATE.names[k]} [deg]")
    grid[1, 1].set(xlabel="t", ylabel="weight (rejects nothing here)")
    _save_figure(figure, folder, "figure_09")
    return True


def save_recorded_hand(result: RecordedHand, folder: Path) -> None:
    """Draw three frames of a recorded hand: its silhouette (grey) and the estimate (blue)."""
    figure = Figure(figsize=(13.0, 4.5), layout="tight")
    for axes, (frame, mask) in zip(figure.subplots(1, 3), result.kept.items(), strict=True):
        _draw_silhouette(axes, mask)
        _draw_hand(axes, result.means[frame], _ESTIMATE, result.observation)
        axes.set(title=f"frame {frame + 1}", aspect="equal")
    _save_figure(figure, folder, f"figure_17_{result.name}")


def _draw_silhouette(axes: Axes, mask: Mask) -> None:
    """Draw a mask (H, W) in grey; the state's origin is the picture's middle."""
    half = 0.5 * np.array(mask.shape)
    extent = (-half[1], half[1], half[0], -half[0])
    axes.imshow(mask, cmap="gray_r", alpha=0.35, extent=extent)


def _draw_hand(
    axes: Axes, state: Array, colour: str, observation: HandObservation = _TWO_FINGERS
) -> None:
    """Draw the fingers' axes and joints and the palm's outline for a state (n,) [pixel]."""
    points, shape = observation.drawing(state), observation.hand.radii.shape
    for finger in points[: shape[0] * shape[1]].reshape(*shape, 2):
        axes.plot(*finger.T, "-o", color=colour, markersize=3, linewidth=2)
    for edge in points[-8:].reshape(-1, 2, 2):
        axes.plot(*edge.T, color=colour, linewidth=1)


def _save_figure(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure as a PNG file."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.png", dpi=90)
