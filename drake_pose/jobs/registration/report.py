"""report.html of a registration: cameras, clocks, frames and pictures on one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from drake_pose.files.folder import OVERLAY
from drake_pose.files.report_page import (
    BOX,
    Picture,
    Plot,
    overlay_picture,
    page_template,
    plot_curves,
)

AS_GIVEN = "overlay_as_given"
"""The folder of pictures of cameras as given beside those that were found."""

# So many pictures of each camera are shown: those that fit worst and best, and some between.
_PICTURES = 6
PARAMETERS = (
    ("zeros", "Zeros, to be added to positions", "joint", "zero"),
    ("lengths", "Lengths, by how much links are longer", "link", "length"),
)
"""Keys of the summary that hold parameters of the robot: title, what they are of, what they are."""

# Standard deviations to either side that a 95 % interval has.
_NORMAL = 1.96


def parameter_rows(parameters: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Zeros or lengths of a camera's part of summary.json as they are shown.

    Of each the name, the value with its unit, the interval, and what to make of it.
    """
    rows: list[tuple[str, ...]] = []
    for name, one in parameters.items():
        if not one["determined"]:
            goes_with = f", goes with {', '.join(one['gauge'])}" if one["gauge"] else ""
            rows.append((name, "", "", f"not determined{goes_with}"))
            continue
        key = next(key for key in one if key.startswith("value_"))
        unit = key.removeprefix("value_")
        value = f"{one[key]:.3f} {'%' if unit == 'percent' else unit}"
        interval = f"{one[f'low_{unit}']:.3f} to {one[f'high_{unit}']:.3f}"
        word = "as good as 0" if one[f"low_{unit}"] <= 0.0 <= one[f"high_{unit}"] else "doubtful"
        word = "significant" if one["significant"] else f"{word}: held at 0"
        if one["significant"] and unit != "percent":
            word += f": {say_reading(one[key], one[f'sd_{unit}'], unit)}"
        rows.append((name, value, interval, word))
    return rows


def say_reading(value: float, deviation: float, unit: str) -> str:
    """That a joint's encoder reads too high or too low.

    Args:
        value: what must be added to its readings, and deviation: its standard deviation, in
            unit: `deg` or `mm`.
    """
    word, digits = "low" if value > 0.0 else "high", 2 if unit == "deg" else 1
    size = f"{abs(value):.{digits}f} +- {deviation:.{digits}f}"
    return f"reads {size} {'degrees' if unit == 'deg' else unit} too {word}"


def make_registration_report(folder: Path, summary: Mapping[str, Any]) -> str:
    """The page report.html, with the overlays in the result's folder."""
    # Cameras see one robot: its zeros and lengths are the same in all their parts.
    first = next(iter(summary["cameras"].values()))
    pictures, pairs = list[Picture | None](), list[Picture | None]()
    for camera, one in summary["cameras"].items():
        # From the worst to the best, as far as they were written.
        errors = {frame: float(told["E_total"]) for frame, told in one["frames"].items()}
        shown = (
            frame for frame in errors if (folder / OVERLAY / camera / f"{frame}.png").is_file()
        )
        in_order = sorted(shown, key=lambda frame: -errors[frame])
        count = min(_PICTURES, len(in_order))
        for k in np.linspace(0, len(in_order) - 1, count).round().astype(int):
            frame = in_order[k]
            pictures.append(overlay_picture(folder, camera, frame, errors[frame]))
        for frame in compared_frames(errors):
            pairs.append(overlay_picture(folder, camera, frame, errors[frame], AS_GIVEN))
    return page_template("drake_pose.jobs.registration").render(
        summary=summary,
        title=Path(str(summary["scene"])).name or str(summary["scene"]),
        model=Path(str(summary["model"])).name,
        target=first.get("target"),
        parameters=[
            (title, of, what, parameter_rows(first[key]))
            for key, title, of, what in PARAMETERS
            if first[key]
        ],
        by_pictures=first["masks"] == "found",
        # A target tells nothing of clocks.
        clocks=first["masks"] == "found" and "time_offset_scores" in first,
        offsets={name: _plot_offset(one) for name, one in summary["cameras"].items()},
        normal=_NORMAL,
        pictures=[picture for picture in pictures if picture is not None],
        pairs=[picture for picture in pairs if picture is not None],
    )


def compared_frames(errors: Mapping[str, float]) -> Sequence[str]:
    """The frames in which a camera as given is shown: the worst and the median one."""
    in_order = sorted(errors, key=lambda frame: -errors[frame])
    return tuple(dict.fromkeys([in_order[0], in_order[len(in_order) // 2]]))


def _plot_offset(camera: Mapping[str, Any]) -> Plot | None:
    """What was explained at each offset of a camera's clock that was tried; None: none was.

    A vertical line is the offset that was found, in its 95 % interval.
    """
    tried = np.array(camera.get("time_offset_scores") or ()).reshape(-1, 2)
    if len(tried) < 2:
        return None
    offsets = 1e3 * tried[:, 0]
    first, step = offsets[0], np.diff(offsets).min()
    places = np.rint((offsets - first) / step).astype(int)
    scores = np.full(places[-1] + 1, np.nan)
    scores[places] = 100.0 * tried[:, 1]
    last = first + step * (len(scores) - 1)
    left, top, width, height = BOX

    def x(offset: float) -> float:
        return left + width * float((np.clip(offset, first, last) - first) / (last - first))

    plot = plot_curves([""] * len(scores), [("explained", scores)], joined=True)
    ticks = [one for one in MaxNLocator(6).tick_values(first, last) if first <= one <= last]
    plot = plot._replace(x_ticks=tuple((round(x(one), 1), f"{one:g}") for one in ticks))
    if camera["time_offset_s"] is None:
        return plot
    value, margin = 1e3 * camera["time_offset_s"], 1e3 * _NORMAL * camera["time_offset_sd_s"]
    low, high = x(value - margin), x(value + margin)
    line = f"M{x(value):.1f} {top}v{height}"
    band = f"M{low:.1f} {top}H{high:.1f}v{height}H{low:.1f}Z"
    return plot._replace(curves=(*plot.curves, ("offset", line)), bands=(band, ""))
