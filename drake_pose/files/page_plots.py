"""Plots of HTML pages as SVG drawings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from markupsafe import Markup, escape

from drake_pose.arrays import Array, Mask


@dataclass(eq=False)
class PagePlot:
    """A plot of curves, bars and lines.

    Args:
        x, y: smallest and largest value of the axes.
        left: space left of the axes [pixel].
        height, width: size of the drawing [pixel]; 36 pixels below the axes are for their labels.
        ticks: value and label of each tick of the x axis; None: round values.
        rows: value and label of each tick of the y axis; None: round values, with lines.
        most: maximum number of bars, and half that of a curve's points. More values are grouped:
            each group has one bar, or its smallest and its largest point.
        drawn: the elements so far.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    left: float = 69.0
    height: float = 180.0
    width: float = 768.0
    ticks: Sequence[tuple[float, str]] | None = None
    rows: Sequence[tuple[float, str]] | None = None
    most: int = 700
    drawn: list[str] = field(default_factory=list)

    def columns(self, x: Array) -> Array:
        """Return the horizontal places (n,) of values (n,) in the drawing [pixel]."""
        span = self.width - 12.0 - self.left
        return np.asarray(self.left + span * (x - self.x[0]) / (self.x[1] - self.x[0]))

    def levels(self, y: Array) -> Array:
        """Return the vertical places (n,) of values (n,) in the drawing, downwards [pixel]."""
        span = self.height - 46.0
        return np.asarray(10.0 + span * (self.y[1] - y) / (self.y[1] - self.y[0]))

    def curve(self, x: Array, y: Array, colour: str, width: float, joined: bool = True) -> None:
        """Draw a curve through points (n,); nan leaves a gap, and single points are dots.

        ``width`` is in pixels; ``joined``: whether there is a line, else all points are dots.
        """
        if len(y) > 2 * self.most:
            groups = _grouped(y, self.most)
            known = np.isfinite(groups)
            ends = (
                np.where(known, groups, np.inf).argmin(axis=1),
                np.where(known, groups, -np.inf).argmax(axis=1),
            )
            starts = np.arange(len(groups)) * groups.shape[1]
            chosen = np.unique(
                np.minimum(np.concatenate([starts + end for end in ends]), len(y) - 1)
            )
            x, y = x[chosen], y[chosen]
        finite, places = np.isfinite(y), zip(self.columns(x), self.levels(y), strict=True)
        starts_run = finite & ~np.concatenate([[False], joined & finite[:-1]])
        path = "".join(
            f"{f'M{u:.1f} {v:.1f}h0' if starts else f'L{u:.1f} {v:.1f}'}"
            for (u, v), starts, known in zip(places, starts_run, finite, strict=True)
            if known
        )
        self._add_path(path, colour, width, ' stroke-linecap="round" stroke-linejoin="round"')

    def bars(self, x: Array, low: Array, high: Array, colour: str, width: float) -> None:
        """Draw upright bars at x (n,) between two values (n,), ``width`` pixels wide."""
        if len(x) > self.most:
            low, high = (_grouped(one, self.most) for one in (low, high))
            width *= low.shape[1]
            x = np.nanmean(_grouped(x, self.most), axis=1)
            low, high = np.nanmin(low, axis=1), np.nanmax(high, axis=1)
        places = zip(self.columns(x), self.levels(low), self.levels(high), strict=True)
        path = "".join(f"M{u:.1f} {v:.1f}V{end:.1f}" for u, v, end in places)
        self._add_path(path, colour, width)

    def line(self, colour: str, *, x: float | None = None, y: float | None = None) -> None:
        """Draw an upright line at x, or a dashed level line at y."""
        if x is not None:
            u = float(self.columns(np.array(x)))
            self._add_path(f"M{u:.1f} 10V{self.height - 36.0:g}", colour, 1.5)
        if y is not None:
            v = float(self.levels(np.array(y)))
            path = f"M{self.left:g} {v:.1f}H{self.width - 12.0:g}"
            self._add_path(path, colour, 1.3, ' stroke-dasharray="5 3"')

    def legend(self, entries: Sequence[tuple[str, str]], in_a_row: int = 4) -> None:
        """Write the label of each (colour, label) in its colour at the lower right."""
        groups = [entries[k : k + in_a_row] for k in range(0, len(entries), in_a_row)]
        for number, own in enumerate(reversed(groups)):
            spans = "   ".join(
                f'<tspan fill="{colour}">{escape(what)}</tspan>' for colour, what in own
            )
            self.drawn.append(
                f'<text x="{self.width - 18.0:g}" y="{self.height - 42.0 - 14.0 * number:g}" '
                'text-anchor="end" stroke="#fff" stroke-width="3" paint-order="stroke" '
                f'font-size="12" xml:space="preserve">{spans}</text>'
            )

    def svg(self, label: str) -> Markup:
        """Return the drawing; ``label`` describes it for readers who do not see it."""
        right, base = self.width - 12.0, self.height - 36.0
        parts = [
            f'<svg class="plot" viewBox="0 0 {self.width:g} {self.height:g}" role="img" '
            f'aria-label="{escape(label)}"><g font-size="13" fill="#57606a">'
        ]
        rows = _round_values(*self.y) if self.rows is None else self.rows
        for value, name in rows:
            v = float(self.levels(np.array(value)))
            if self.rows is None:
                parts.append(f'<path stroke="#d8dee4" d="M{self.left:g} {v:.1f}H{right:g}"/>')
            place = f'x="{self.left - 6.0:g}" y="{v + 4.5:.1f}"'
            parts.append(f'<text {place} text-anchor="end">{escape(name)}</text>')
        for value, name in _round_values(*self.x, 8) if self.ticks is None else self.ticks:
            u = float(self.columns(np.array(value)))
            parts.append(f'<path stroke="#57606a" d="M{u:.1f} {base:g}v4"/>')
            place = f'x="{u:.1f}" y="{base + 18.0:g}"'
            parts.append(f'<text {place} text-anchor="middle">{escape(name)}</text>')
        size = f'width="{right - self.left:g}" height="{base - 10.0:g}"'
        frame = f'<rect x="{self.left:g}" y="10" {size} fill="none" stroke="#d8dee4"/>'
        return Markup("".join([*parts, "</g>", *self.drawn, frame, "</svg>"]))

    def _add_path(self, path: str, colour: str, width: float, more: str = "") -> None:
        """Add a stroke of this colour and width [pixel]; none if the path is empty."""
        if path:
            style = f'fill="none" stroke="{colour}" stroke-width="{width:.3g}"{more}'
            self.drawn.append(f'<path {style} d="{path}"/>')


def _grouped(values: Array, most: int) -> Array:
    """Return values (n,) as at most ``most`` rows of successive ones, filled up with nan."""
    size = -(-len(values) // most)
    filled = np.full(-(-len(values) // size) * size, np.nan)
    filled[: len(values)] = values
    return filled.reshape(-1, size)


def _round_values(low: float, high: float, about: int = 6) -> list[tuple[float, str]]:
    """Return about this number of round values between two values, each with its text."""
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * one for one in (1.0, 2.0, 5.0, 10.0) if power * one > 0.999 * raw)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    numbers = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return [(step * one, f"{step * one:z.{digits}f}") for one in numbers]


def plot_curves(
    frames: Sequence[str],
    values: Sequence[tuple[str, Array]],
    *,
    joined: bool,
    limits: tuple[float, float] | None = None,
    intervals: tuple[Array, Array, Mask] | None = None,
    least: float | None = None,
    limits_within: float = 0.3,
) -> PagePlot:
    """Plot curves over frames; nan leaves a gap.

    Args:
        frames: names of the frames.
        values: label and (frames,) values of each curve; the curve "measured" is wide.
        joined: whether neighbouring frames are joined by a line.
        limits: lower and upper limit, each drawn only if it is near; None: no limits.
        intervals: low and high (frames,), and whether the joint is determined (frames,), drawn as
            bars behind the curves; None: no bars, and a legend if there are several curves.
        least: lower end of the axis, such as 0; None: chosen from the curves.
        limits_within: a limit is near if its distance to curves and intervals is at most this
            fraction of their span.
    """
    shown = np.concatenate([value for _, value in values])
    if intervals is not None:
        shown = np.concatenate([shown, *intervals[:2]])
    shown = shown[np.isfinite(shown)]
    bottom, top = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)
    near = limits_within * (top - bottom)
    if limits is not None and bottom - near <= limits[0] < bottom:
        bottom = limits[0]
    if limits is not None and top < limits[1] <= top + near:
        top = limits[1]
    bottom = bottom if least is None else min(bottom, least)
    margin = 0.08 * (top - bottom if top > bottom else max(1e-3, 0.02 * abs(top)))
    ends = bottom - (0.0 if bottom == least else margin), top + margin
    plot = PagePlot((-0.5, max(len(frames), 1) - 0.5), ends, ticks=_frame_ticks(frames))
    places = np.arange(len(frames), dtype=np.float64)
    if intervals is not None:
        low, high, determined = intervals
        # As wide as a frame, at most 1/40 of the axis.
        width = 1.1 * 700.0 / max(len(frames), 40)
        for where, colour in ((determined, "#c5dfee"), (~determined, "#e4e6e8")):
            own = where & np.isfinite(low) & np.isfinite(high)
            plot.bars(places[own], low[own], high[own], colour, width)
    colours = [
        "#0072b2",
        "#d55e00",
        "#009e73",
        "#b8468f",
        "#7a5c00",
        "#2f8fc4",
        "#666666",
        "#8c2d04",
    ]
    wide = [value for name, value in values if name == "measured"]
    others = [one for one in values if one[0] != "measured"]
    named = [(colours[k % len(colours)], name) for k, (name, _) in enumerate(others)]
    for value in wide:
        plot.curve(places, value, "#009e7380", 6.7 if joined else 13.0, joined)
    for (colour, _), (_, value) in zip(named, others, strict=True):
        plot.curve(places, value, colour, 2.0 if joined else 6.7, joined)
    for limit in limits or ():
        if bottom <= limit <= top:
            plot.line("#b3400a", y=limit)
    if len(values) > 1 and intervals is None:
        plot.legend(named)
    return plot


def _frame_ticks(frames: Sequence[str], count: int = 6) -> list[tuple[float, str]]:
    """Return place and name of about ``count`` frames."""
    step = max(1, -(-len(frames) // count))
    return [(k, frames[k][:20]) for k in range(0, len(frames), step)]


def draw_grid(frames: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> PagePlot:
    """Plot states over frames: a row of bars for each name; equal neighbours are one bar.

    Args:
        frames: names of the frames.
        rows: name and (frames,) states of each row. "used" and "found" are blue, "no-picture" is
            grey, other states are orange.
    """
    colours = {"used": "#0072b2", "found": "#0072b2", "no-picture": "#d8dee4"}
    names = [name if len(name) <= 20 else f"{name[:19]}…" for name, _ in rows]
    plot = PagePlot(
        (-0.5, max(len(frames), 1) - 0.5), (len(rows) - 0.5, -0.5), left=154.0,
        height=46.0 + 24.0 * len(rows), ticks=_frame_ticks(frames),
        rows=[*enumerate(names)],
    )  # fmt: skip
    for number, (_, states) in enumerate(rows):
        starts = [k for k in range(len(states)) if k == 0 or states[k] != states[k - 1]]
        edges = plot.columns(np.array([*starts, len(states)]) - 0.5)
        level = float(plot.levels(np.array(number - 0.4)))
        for start, left, right in zip(starts, edges, edges[1:], strict=False):
            place = f'x="{left:.2f}" y="{level:.1f}" width="{right - left:.2f}" height="19.2"'
            colour = colours.get(states[start], "#d55e00")
            plot.drawn.append(f'<rect {place} fill="{colour}"/>')
    return plot
