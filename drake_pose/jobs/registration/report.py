"""report.html of a registration: what came out, on one page that needs nothing else to be read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from drake_pose.results.folder import OVERLAY
from drake_pose.results.report_page import Picture, page_template, small_picture

# So many pictures of each camera are shown: those that fit worst and best, and some between.
_PICTURES = 6
PARAMETERS = (
    ("zeros", "Zeros, to be added to positions", "joint", "zero"),
    ("lengths", "Lengths, by how much links are longer", "link", "length"),
)
"""Keys of the summary that hold parameters of the robot: title, what they are of, what they are."""


class ParameterRow(NamedTuple):
    """A zero or a length as it is shown.

    name: of the joint or link; value, interval: with their unit; word: what to make of it.
    """

    name: str
    value: str
    interval: str
    word: str


def parameter_rows(parameters: Mapping[str, Mapping[str, Any]]) -> list[ParameterRow]:
    """The zeros or the lengths of a camera's part of summary.json, as they are shown."""
    rows = []
    for name, one in parameters.items():
        if not one["determined"]:
            goes_with = f", goes with {', '.join(one['gauge'])}" if one["gauge"] else ""
            rows.append(ParameterRow(name, "", "", f"not determined{goes_with}"))
            continue
        key = next(key for key in one if key.startswith("value_"))
        unit = key.removeprefix("value_")
        rows.append(
            ParameterRow(
                name,
                f"{one[key]:.3f} {'%' if unit == 'percent' else unit}",
                f"{one[f'low_{unit}']:.3f} to {one[f'high_{unit}']:.3f}",
                "significant" if one["significant"] else "as good as 0",
            )
        )
    return rows


def make_registration_report(folder: Path, summary: Mapping[str, Any]) -> str:
    """The page.

    Args:
        folder: the result's folder, whose overlays are shown.
        summary: the content of summary.json.
    """
    # Cameras see one robot: its zeros and lengths are the same in all their parts.
    first = next(iter(summary["cameras"].values()))
    return page_template("drake_pose.jobs.registration", "report_template.html.j2").render(
        summary=summary,
        title=Path(str(summary["scene"])).name or str(summary["scene"]),
        model=Path(str(summary["model"])).name,
        target=first.get("target"),
        parameters=[
            (title, of, what, parameter_rows(first[key]))
            for key, title, of, what in PARAMETERS
            if first[key]
        ],
        pictures=[
            picture
            for camera, one in summary["cameras"].items()
            for picture in _pick_pictures(folder, camera, one["frames"])
        ],
    )


def _pick_pictures(folder: Path, camera: str, frames: Mapping[str, Any]) -> list[Picture]:
    """Overlays of a camera's frames from the worst to the best, as far as they were written."""
    in_order = sorted(frames, key=lambda frame: float(-frames[frame]["E_total"]))
    count = min(_PICTURES, len(in_order))
    chosen = [in_order[k] for k in np.linspace(0, len(in_order) - 1, count).round().astype(int)]
    pictures = []
    for frame in chosen:
        place = f"{OVERLAY}/{camera}/{frame}.png"
        if (folder / place).is_file():
            uri = small_picture((folder / place).read_bytes())
            if uri:
                error = float(frames[frame]["E_total"])
                pictures.append(Picture(camera, frame, error, uri, quote(place)))
    return pictures
