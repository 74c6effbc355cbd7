"""report.html: what came out, on one page that needs nothing else to be read."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup
from numpy.typing import NDArray

from drake_pose.body.model import ArticulatedModel
from drake_pose.results.folder import OVERLAY, PoseRow
from drake_pose.results.report_plots import Grid, Plot, draw_grid, plot_curves
from drake_pose.results.summary import FrameRecord

Array = NDArray[np.float64]

USED, LEFT_OUT, NO_PICTURE = "used", "left-out", "no-picture"
FOUND, NOT_FOUND = "found", "not-found"

# A position that changes by less is said in a table.
_STAYS = 1e-9
_PICTURES = 6
_PICTURE_SIZE = 300
_METHODS = {
    "beam": "searched by many hypotheses side by side",
    "paper": "searched as published",
    "person": "one person followed by all silhouettes at once",
    "paper_capture": "one person followed by skin-coloured features, as published",
}
_ABOUT = {
    "poses.csv": "every position of every frame [rad or m]",
    "joints.csv": "what is known of each joint, and in what interval [deg or m]",
    "families.csv": "poses that look the same",
    "joint_centres.csv": "anatomical joint centres in the world [m]",
    "joint_centres.trc": "the same as markers [mm], for motion analysis",
    "positions.mot": "every position over time [deg or m], for motion analysis",
    "motion.bvh": "skeleton and motion [cm], for animation",
    "shapes.png": "the corrected shape of the body over that of the model's file",
    "replay.html": "plays the estimate in three dimensions",
    "summary.json": "settings, versions, and all figures of this page",
}


@dataclass(frozen=True, eq=False)
class ReportContent:
    """What a report tells of.

    Args:
        folder: the result's folder, whose files are linked.
        seen: (camera, frame) of every picture that there is.
        rows, records: the finished frames in order, and what is known of each, by name.
        joined: whether frames follow each other in time.
    """

    folder: Path
    model: ArticulatedModel
    cameras: tuple[str, ...]
    seen: frozenset[tuple[str, str]]
    rows: tuple[PoseRow, ...]
    records: Mapping[str, FrameRecord]
    summary: Mapping[str, Any]
    joined: bool


@dataclass(frozen=True)
class JointPlot:
    """A joint's plot. unit: of its values; low, high, lower, upper: its range and its limits."""

    name: str
    unit: str
    low: float
    high: float
    lower: float
    upper: float
    plot: Plot


@dataclass(frozen=True)
class Picture:
    """An overlay. uri: of its data; link: of its file."""

    camera: str
    frame: str
    E_total: float | None
    uri: str
    link: str


def make_report(content: ReportContent) -> str:
    """The page."""
    template = page_template("drake_pose.results", "report_template.html.j2")
    frames = [row.frame for row in content.rows]
    records = [content.records[frame] for frame in frames]
    errors = np.array([np.nan if r.E_total is None else 100.0 * r.E_total for r in records])
    moving, still = _joint_plots(content, frames, records)
    return template.render(
        summary=content.summary,
        title=Path(str(content.summary["scene"])).name or str(content.summary["scene"]),
        model=content.model.path.name,
        method=_METHODS[str(content.summary["method"])],
        rows=[(frame, content.records[frame]) for frame in frames],
        errors=plot_curves(frames, [("E_total", errors)], joined=content.joined, least=0.0),
        ious=_plot_ious(content, frames, records),
        cameras=_camera_rows(content),
        grid=_draw_use(content, frames, records),
        lost=[frame for frame in frames if not content.records[frame].found],
        moving=moving,
        still=still,
        pictures=_pick_pictures(content),
        files=[
            (name, about) for name, about in _ABOUT.items() if (content.folder / name).is_file()
        ],
    )


def page_template(package: str, name: str) -> Template:
    """A page's template, a file of a package, which may use the style of all pages."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.tests["infinite"] = math.isinf
    style = files("drake_pose.results").joinpath("report_style.css")
    environment.globals["style"] = Markup(style.read_text(encoding="utf-8").rstrip())
    source = files(package).joinpath(name)
    return environment.from_string(source.read_text(encoding="utf-8"))


def _joint_plots(
    content: ReportContent, frames: list[str], records: list[FrameRecord]
) -> tuple[list[JointPlot], list[JointPlot]]:
    """The plots of positions that change, and of those that stay the same."""
    model = content.model
    moving: list[JointPlot] = []
    still: list[JointPlot] = []
    q = np.array([row.q for row in content.rows]).reshape(len(frames), -1)
    for k, (name, kind) in enumerate(zip(model.position_names, model.position_kinds, strict=True)):
        scale, unit = (np.degrees(1.0), "deg") if kind == "angle" else (1.0, "m")
        values = scale * q[:, k]
        if not np.isfinite(values).any():
            continue
        limits = float(scale * model.lower[k]), float(scale * model.upper[k])
        known = [record.joints.get(name) for record in records]
        intervals = None
        if any(one is not None for one in known):
            intervals = (
                np.array([np.nan if one is None else one.low for one in known]),
                np.array([np.nan if one is None else one.high for one in known]),
                np.array([one is not None and one.determined for one in known]),
            )
        plot = plot_curves(
            frames,
            [(name, values)],
            joined=content.joined,
            limits=limits,
            intervals=intervals,
        )
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        joint = JointPlot(name, "" if kind == "quaternion" else unit, low, high, *limits, plot)
        stays = kind != "angle" and high - low < _STAYS
        (still if stays else moving).append(joint)
    return moving, still


def _plot_ious(content: ReportContent, frames: list[str], records: list[FrameRecord]) -> Plot:
    curves = [
        (camera, np.array([100.0 * record.ious.get(camera, np.nan) for record in records]))
        for camera in content.cameras
    ]
    return plot_curves(frames, curves, joined=content.joined)


def _camera_rows(content: ReportContent) -> list[dict[str, Any]]:
    """What the table of cameras says: pictures, those used, IoU, and whether it is suspicious."""
    rows = []
    for camera in content.cameras:
        ious = {
            frame: record.ious[camera]
            for frame, record in content.records.items()
            if camera in record.ious
        }
        worst = min(ious, key=lambda frame: ious[frame]) if ious else None
        rows.append(
            {
                "name": camera,
                "pictures": sum((camera, frame) in content.seen for frame in content.records),
                "used": len(ious),
                "mean": float(np.mean(list(ious.values()))) if ious else None,
                "least": None if worst is None else ious[worst],
                "worst": worst,
                "bad": any(f"'{camera}'" in text for text in content.summary["warnings"]),
            }
        )
    return rows


def _draw_use(content: ReportContent, frames: list[str], records: list[FrameRecord]) -> Grid:
    """Which camera was used in which frame, and where a pose was found."""

    def state(camera: str, frame: str, record: FrameRecord) -> str:
        if camera in record.ious:
            return USED
        return LEFT_OUT if (camera, frame) in content.seen else NO_PICTURE

    use = [
        (camera, [state(camera, f, r) for f, r in zip(frames, records, strict=True)])
        for camera in content.cameras
    ]
    found = [FOUND if record.found else NOT_FOUND for record in records]
    return draw_grid(frames, [*use, ("pose", found)])


def _pick_pictures(content: ReportContent) -> list[Picture]:
    """Overlays of the frames that fit worst, as usual and best, as far as they were written."""
    known = [row for row in content.rows if row.found] or list(content.rows)
    in_order = sorted(known, key=lambda row: -row.error if row.found else 0.0)
    chosen = list(dict.fromkeys([0, len(in_order) // 2, len(in_order) - 1])) if in_order else []
    each = max(1, _PICTURES // max(1, len(chosen)))
    pictures = []
    for place in chosen:
        row = in_order[place]
        ious = content.records[row.frame].ious
        cameras = sorted(content.cameras, key=lambda name: ious.get(name, 1.0))
        found = [camera for camera in cameras if (content.folder / _overlay(camera, row)).is_file()]
        for camera in found[:each]:
            data = (content.folder / _overlay(camera, row)).read_bytes()
            error = content.records[row.frame].E_total
            link = quote(_overlay(camera, row))
            uri = small_picture(data)
            if uri:
                pictures.append(Picture(camera, row.frame, error, uri, link))
    return pictures


def _overlay(camera: str, row: PoseRow) -> str:
    return f"{OVERLAY}/{camera}/{row.frame}.png"


def small_picture(data: bytes) -> str:
    """A PNG picture as the URI of a small JPEG picture; "" where it is none any more."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        return ""
    scale = min(1.0, _PICTURE_SIZE / picture.shape[0])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
