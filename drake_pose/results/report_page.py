"""report.html: what came out, on one page that needs nothing else to be read."""

from __future__ import annotations

import base64
import math
from collections.abc import Collection, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np
from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from drake_pose.body.model import ArticulatedModel
from drake_pose.results.folder import OVERLAY
from drake_pose.results.poses import PoseRow
from drake_pose.results.records import FrameRecord, user_units
from drake_pose.results.report_plots import BOX, Plot, draw_grid, plot_curves

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


class ReportContent(NamedTuple):
    """What a report tells of.

    Attributes:
        folder: the result's folder, whose files are linked.
        seen: (camera, frame) of every picture that there is.
        rows, records: the finished frames in order, and what is known of each, by name.
        joined: whether frames follow each other in time.
    """

    folder: Path
    model: ArticulatedModel
    cameras: tuple[str, ...]
    seen: Collection[tuple[str, str]]
    rows: tuple[PoseRow, ...]
    records: Mapping[str, FrameRecord]
    summary: Mapping[str, Any]
    joined: bool


class JointPlot(NamedTuple):
    """A joint's plot. unit: of its values; low, high, lower, upper: its range and its limits."""

    name: str
    unit: str
    low: float
    high: float
    lower: float
    upper: float
    plot: Plot


class Picture(NamedTuple):
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
    found = ["found" if record.found else "not-found" for record in records]
    use = [(name, _use(content, name)) for name in content.cameras]
    errors = np.array([100.0 * row.error for row in content.rows])
    ious = [
        (name, np.array([100.0 * record.ious.get(name, np.nan) for record in records]))
        for name in content.cameras
    ]
    joints = _joint_plots(content, frames)
    stay = {one.name for one in joints if one.unit != "deg" and one.high - one.low < _STAYS}
    return template.render(
        summary=content.summary,
        title=Path(str(content.summary["scene"])).name or str(content.summary["scene"]),
        model=content.model.path.name,
        method=_METHODS[str(content.summary["method"])],
        rows=list(zip(frames, records, strict=True)),
        box=BOX,
        errors=plot_curves(frames, [("E_total", errors)], joined=content.joined, least=0.0),
        ious=plot_curves(frames, ious, joined=content.joined),
        cameras=[_camera_row(content, name) for name in content.cameras],
        grid=draw_grid(frames, [*use, ("pose", found)]),
        lost=[row.frame for row in content.rows if not row.found],
        moving=[one for one in joints if one.name not in stay],
        still=[one for one in joints if one.name in stay],
        pictures=_pick_pictures(content),
        files=[(name, text) for name, text in _ABOUT.items() if (content.folder / name).is_file()],
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


def _joint_plots(content: ReportContent, frames: Sequence[str]) -> list[JointPlot]:
    """The plots of all positions that are known in a frame."""
    model, units = content.model, user_units(content.model)
    of_kind = {"angle": "deg", "length": "m", "quaternion": ""}
    q = np.array([row.q for row in content.rows]).reshape(len(frames), -1)
    plots = []
    for k, (name, kind) in enumerate(zip(model.position_names, model.position_kinds, strict=True)):
        values = units[k] * q[:, k]
        if not np.isfinite(values).any():
            continue
        lower, upper = float(units[k] * model.lower[k]), float(units[k] * model.upper[k])
        known = [content.records[frame].joints.get(name) for frame in frames]
        intervals = None
        if any(known):
            ends = [(np.nan, np.nan, False) if n is None else n.interval for n in known]
            low, high, determined = np.array(ends).T
            intervals = low, high, determined > 0.0
        plot = plot_curves(
            frames,
            [(name, values)],
            joined=content.joined,
            limits=(lower, upper),
            intervals=intervals,
        )
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        plots.append(JointPlot(name, of_kind[kind], low, high, lower, upper, plot))
    return plots


def _camera_row(content: ReportContent, camera: str) -> dict[str, Any]:
    """What the table of cameras says: pictures, those used, IoU, and whether it is suspicious."""
    records = content.records
    ious = {f: one.ious[camera] for f, one in records.items() if camera in one.ious}
    worst = min(ious, key=lambda frame: ious[frame], default=None)
    return {
        "name": camera,
        "pictures": sum((camera, frame) in content.seen for frame in records),
        "used": len(ious),
        "mean": float(np.mean(list(ious.values()))) if ious else None,
        "least": None if worst is None else ious[worst],
        "worst": worst,
        "bad": any(f"'{camera}'" in text for text in content.summary["warnings"]),
    }


def _use(content: ReportContent, camera: str) -> list[str]:
    """In which frames a camera was used, or was there."""
    states = []
    for row in content.rows:
        is_used = camera in content.records[row.frame].ious
        is_there = (camera, row.frame) in content.seen
        states.append("used" if is_used else "left-out" if is_there else "no-picture")
    return states


def _pick_pictures(content: ReportContent) -> list[Picture]:
    """Overlays of the frames that fit worst, as usual and best, as far as they were written."""
    known = [row for row in content.rows if row.found] or list(content.rows)
    in_order = sorted(known, key=lambda row: -row.error if row.found else 0.0)
    last = len(in_order) - 1
    chosen = list(dict.fromkeys([0, (last + 1) // 2, last])) if in_order else []
    pictures = []
    for row in (in_order[place] for place in chosen):
        ious = content.records[row.frame].ious
        cameras = sorted(content.cameras, key=lambda name: ious.get(name, 1.0))
        shown = [
            overlay_picture(content.folder, name, row.frame, row.error if row.found else None)
            for name in cameras
        ]
        pictures += [one for one in shown if one is not None][: max(1, _PICTURES // len(chosen))]
    return pictures


def overlay_picture(folder: Path, camera: str, frame: str, E_total: float | None) -> Picture | None:
    """An overlay in a result's folder, made small; None where it is no picture any more."""
    place = f"{OVERLAY}/{camera}/{frame}.png"
    if not (folder / place).is_file():
        return None
    uri = _small_picture((folder / place).read_bytes())
    return Picture(camera, frame, E_total, uri, quote(place)) if uri else None


def _small_picture(data: bytes) -> str:
    """A PNG picture as the URI of a small JPEG picture; "" where it is none any more."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        return ""
    scale = min(1.0, _PICTURE_SIZE / picture.shape[0])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
