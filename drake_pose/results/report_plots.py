"""Plots of the report page as paths of an SVG picture: numbers in, geometry out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Ticks = tuple[tuple[float, str], ...]

WIDTH, HEIGHT = 640, 150
"""Of a plot's picture."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 8, 8, 20
BOX = _LEFT, _TOP, WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
"""x, y, width and height of the frame around the curves."""
_GRID_LEFT, _GRID_ROW = 130, 18

# More points than this are thinned: the highest and lowest of this many neighbours stay.
_POINTS = 600
# Limits are in the picture where the curve takes up this share of them; else it is enlarged.
_SHARE = 0.2
# Half the width of the area about a frame that stands alone.
_DOT = 2.5


class Plot(NamedTuple):
    """A plot over frames of WIDTH by HEIGHT.

    Attributes:
        curves: label and path of each.
        dots: whether each point stands alone.
        bands: paths of areas: what is known, and what is not determined.
        limits: heights. Ticks: places and texts.
    """

    curves: tuple[tuple[str, str], ...]
    dots: bool
    bands: tuple[str, str]
    limits: tuple[float, ...]
    x_ticks: Ticks
    y_ticks: Ticks


class Grid(NamedTuple):
    """What was used in which frame: of each row name, y, and (x, width, state) of equal frames."""

    rows: tuple[tuple[str, int, list[tuple[float, float, str]]], ...]
    height: int
    x_ticks: Ticks


def plot_curves(
    frames: Sequence[str],
    values: Sequence[tuple[str, Array]],
    *,
    joined: bool,
    limits: tuple[float, float] | None = None,
    intervals: tuple[Array, Array, NDArray[np.bool_]] | None = None,
    least: float | None = None,
) -> Plot:
    """Plots curves over frames; nan leaves a gap.

    Args:
        values: label and (frames,) values of each curve.
        joined: whether neighbouring frames are joined by a line.
        limits: lower and upper, in the picture where they are near.
        intervals: low and high (frames,), and where they are what is known.
        least: the lowest value that the axis shows, such as 0.
    """
    ends = () if intervals is None else intervals[:2]
    low, high = _range(np.concatenate([*(v for _, v in values), *ends, []]), limits, least)
    ticks = MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    left, top, width, height = BOX
    count, order = len(frames), np.arange(len(frames))
    lines = joined and count > 1
    x = left + width * (order / (count - 1) if lines else (order + 0.5) / max(1, count))

    def y(value: ArrayLike) -> Array:
        share = (np.clip(value, low, high) - low) / (high - low)
        return np.asarray(top + height * (1.0 - share))

    def curve(value: Array) -> str:
        runs = [_thin(run, value) for run in _runs(np.isfinite(value), lines)]
        # A line of no length is shown as a dot.
        return "".join(_path(x[k], y(value[k])) + "h0" * (len(k) == 1) for k in runs)

    def band(low: Array, high: Array, where: NDArray[np.bool_]) -> str:
        parts = []
        for run in _runs(where & np.isfinite(low) & np.isfinite(high), lines):
            over, under = _thin(run, high), _thin(run, low)[::-1]
            places = np.concatenate([x[over], x[under]])
            heights = y(np.concatenate([high[over], low[under]]))
            if len(run) == 1:
                places = np.repeat(places, 2) + _DOT * np.array([-1.0, 1.0, 1.0, -1.0])
                heights = np.repeat(heights, 2)
            parts.append(_path(places, heights) + "Z")
        return "".join(parts)

    bands = ("", "")
    if intervals is not None:
        lower, upper, known = intervals
        bands = band(lower, upper, known), band(lower, upper, ~known)
    return Plot(
        tuple((label, curve(value)) for label, value in values),
        not joined,
        bands,
        tuple(float(y(limit)) for limit in limits or () if low <= limit <= high),
        _frame_ticks(frames, x),
        tuple((float(y(t)), f"{t:g}") for t in ticks if low - 1e-9 <= t <= high + 1e-9),
    )


def draw_grid(frames: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> Grid:
    """Draws what state each row, a name and (frames,) states, has; equal neighbours are a bar."""
    width = (WIDTH - _GRID_LEFT - _RIGHT) / max(1, len(frames))
    drawn = []
    for number, (name, states) in enumerate(rows):
        starts = [k for k in range(len(states)) if k == 0 or states[k] != states[k - 1]]
        runs = [
            (round(_GRID_LEFT + width * a, 2), round(width * (b - a), 2), states[a])
            for a, b in zip(starts, [*starts[1:], len(states)], strict=True)
        ]
        drawn.append((name, number * _GRID_ROW, runs))
    middles = np.asarray(_GRID_LEFT + width * (np.arange(len(frames)) + 0.5), np.float64)
    return Grid(tuple(drawn), _GRID_ROW * len(rows) + _BOTTOM, _frame_ticks(frames, middles))


def _path(x: Array, y: Array) -> str:
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))


def _runs(known: NDArray[np.bool_], joined: bool) -> list[Indices]:
    """The runs of frames that are known and joined."""
    places = np.flatnonzero(known)
    cuts = np.flatnonzero(np.diff(places) > (1 if joined else 0)) + 1
    return np.split(places, cuts) if len(places) else []


def _range(
    shown: Array, limits: tuple[float, float] | None, least: float | None
) -> tuple[float, float]:
    """The ends of the axis."""
    shown = shown[np.isfinite(shown)]
    if not len(shown):
        return 0.0, 1.0
    low, high = float(shown.min()), float(shown.max())
    if limits is not None and high - low >= _SHARE * (limits[1] - limits[0]):
        low, high = min(low, limits[0]), max(high, limits[1])
    low = low if least is None else min(low, least)
    span = high - low if high > low else max(1e-3, 0.02 * abs(high))
    return low - (0.0 if low == least else 0.08 * span), high + 0.08 * span


def _thin(run: Indices, values: Array) -> Indices:
    """At most about _POINTS frames of a run: the lowest and highest of each group."""
    if len(run) <= _POINTS:
        return run
    groups = np.array_split(run, _POINTS // 2)
    ends = [group[f(values[group])] for group in groups for f in (np.argmin, np.argmax)]
    return np.unique([run[0], run[-1], *ends])


def _frame_ticks(frames: Sequence[str], x: Array) -> Ticks:
    """Places and names of a few frames, evenly spread."""
    step = max(1, -(-len(frames) // 6))
    return tuple((round(float(x[k]), 1), frames[k]) for k in range(0, len(frames), step))
