"""Plots of the report page as paths of an SVG picture: numbers in, geometry out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDTH, HEIGHT = 640, 150
"""Of a plot's picture."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 8, 8, 20
_GRID_LEFT, _GRID_ROW = 130, 18

# More points than this are thinned: the highest and lowest of this many neighbours stay.
_POINTS = 600
# Limits are in the picture where the curve takes up this share of them; else it is enlarged.
_SHARE = 0.2


@dataclass(frozen=True)
class Curve:
    """A curve: its label, the path of the SVG picture, and whether each point stands alone."""

    label: str
    path: str
    dots: bool = False


@dataclass(frozen=True)
class Plot:
    """A plot over frames of WIDTH by HEIGHT: curves, heights of limits, ticks' places and texts.

    `bands` are paths of areas: what is known, and what is not determined.
    """

    curves: tuple[Curve, ...]
    bands: tuple[str, str]
    limits: tuple[float, ...]
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]

    @property
    def box(self) -> tuple[int, int, int, int]:
        """x, y, width and height of the frame around the curves."""
        return _LEFT, _TOP, WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM


@dataclass(frozen=True)
class GridRow:
    """A row of the grid of frames: its name, and (x, width, state) of runs of one state."""

    name: str
    y: int
    runs: tuple[tuple[float, float, str], ...]


@dataclass(frozen=True)
class Grid:
    """What was used in which frame, in a picture of WIDTH by ``height``."""

    rows: tuple[GridRow, ...]
    height: int
    x_ticks: tuple[tuple[float, str], ...]


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
    shown = [value[np.isfinite(value)] for _, value in values]
    if intervals is not None:
        shown += [ends[np.isfinite(ends)] for ends in intervals[:2]]
    low, high = _range(np.concatenate(shown) if shown else np.zeros(0), limits, least)
    ticks = MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    ticks = [tick for tick in ticks if low - 1e-9 <= tick <= high + 1e-9]
    scale = _Scale(len(frames), low, high, joined)
    bands = ("", "")
    if intervals is not None:
        low_ends, high_ends, determined = intervals
        bands = (
            scale.band(low_ends, high_ends, determined),
            scale.band(low_ends, high_ends, ~determined),
        )
    return Plot(
        tuple(Curve(label, scale.curve(value), not joined) for label, value in values),
        bands,
        tuple(float(scale.y(limit)) for limit in limits or () if low <= limit <= high),
        _frame_ticks(frames, scale.x(np.arange(len(frames)))),
        tuple((float(scale.y(tick)), f"{tick:g}") for tick in ticks),
    )


def draw_grid(frames: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> Grid:
    """Draws what state each row, a name and (frames,) states, has; equal neighbours are a bar."""
    width = (WIDTH - _GRID_LEFT - _RIGHT) / max(1, len(frames))
    drawn = []
    for number, (name, states) in enumerate(rows):
        starts = [k for k in range(len(states)) if k == 0 or states[k] != states[k - 1]]
        ends = [*starts[1:], len(states)]
        runs = tuple(
            (round(_GRID_LEFT + width * a, 2), round(width * (b - a), 2), states[a])
            for a, b in zip(starts, ends, strict=True)
        )
        drawn.append(GridRow(name, number * _GRID_ROW, runs))
    middles = _GRID_LEFT + width * (np.arange(len(frames)) + 0.5)
    return Grid(tuple(drawn), _GRID_ROW * len(rows) + _BOTTOM, _frame_ticks(frames, middles))


class _Scale:
    """Frames and values to places in the picture; frames that stand alone have room around."""

    def __init__(self, count: int, low: float, high: float, joined: bool) -> None:
        self._count, self._low, self._high = count, low, high
        self._joined = joined and count > 1

    def x(self, frame: Array | NDArray[np.int64]) -> Array:
        share = frame / (self._count - 1) if self._joined else (frame + 0.5) / self._count
        return np.asarray(_LEFT + (WIDTH - _LEFT - _RIGHT) * share)

    def y(self, value: Array | float) -> Array:
        share = (np.asarray(value) - self._low) / (self._high - self._low)
        return np.asarray(HEIGHT - _BOTTOM - (HEIGHT - _TOP - _BOTTOM) * share)

    def curve(self, values: Array) -> str:
        """The path of a curve; a frame that stands alone is a line of no length, shown as a dot."""
        parts = []
        for run in self._runs(np.isfinite(values)):
            kept = _thin(run, values)
            parts += [self._at(k, values[k], "M" if n == 0 else "L") for n, k in enumerate(kept)]
            if len(kept) == 1:
                parts.append("h0")
        return "".join(parts)

    def band(self, low: Array, high: Array, where: NDArray[np.bool_]) -> str:
        """The path of the area between two curves."""
        low, high = np.clip([low, high], self._low, self._high)
        parts = []
        for run in self._runs(where & np.isfinite(low) & np.isfinite(high)):
            over, under = _thin(run, high), _thin(run, low)[::-1]
            # A frame that stands alone is as wide as a dot.
            side = 2.5 if len(run) == 1 else 0.0
            corners = [(k, high[k], -side) for k in over] + [(k, low[k], side) for k in under]
            if side:
                corners = [(k, v, s) for k, v, _ in corners for s in (side, -side)]
                corners[:2] = corners[1::-1]
            parts += [
                self._at(k, v, "M" if n == 0 else "L", s) for n, (k, v, s) in enumerate(corners)
            ]
            parts.append("Z")
        return "".join(parts)

    def _runs(self, known: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
        """The runs of frames that are known and joined."""
        places = np.flatnonzero(known)
        if not len(places):
            return []
        cuts = np.diff(places) > (1 if self._joined else 0)
        return np.split(places, np.flatnonzero(cuts) + 1)

    def _at(self, frame: int, value: float, command: str, shift: float = 0.0) -> str:
        return f"{command}{float(self.x(np.array(frame))) + shift:.1f} {float(self.y(value)):.1f}"


def _range(
    shown: Array, limits: tuple[float, float] | None, least: float | None
) -> tuple[float, float]:
    """The ends of the axis."""
    if not len(shown):
        return 0.0, 1.0
    low, high = float(shown.min()), float(shown.max())
    bounded = limits is not None and np.isfinite(limits).all()
    if limits is not None and bounded and high - low >= _SHARE * (limits[1] - limits[0]):
        low, high = min(low, limits[0]), max(high, limits[1])
    if least is not None:
        low = min(low, least)
    span = high - low if high > low else max(1e-3, 0.02 * abs(high))
    low = low - (0.0 if least is not None and low == least else 0.08 * span)
    return low, high + 0.08 * span


def _thin(run: NDArray[np.intp], values: Array) -> list[int]:
    """At most about _POINTS frames of a run: the lowest and highest of each group."""
    if len(run) <= _POINTS:
        return [int(k) for k in run]
    kept = {int(run[0]), int(run[-1])}
    for group in np.array_split(run, _POINTS // 2):
        kept |= {int(group[np.argmin(values[group])]), int(group[np.argmax(values[group])])}
    return sorted(kept)


def _frame_ticks(frames: Sequence[str], x: NDArray[Any]) -> tuple[tuple[float, str], ...]:
    """Places and names of a few frames, evenly spread."""
    step = max(1, -(-len(frames) // 6))
    return tuple((round(float(x[k]), 1), frames[k]) for k in range(0, len(frames), step))
