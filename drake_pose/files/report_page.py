"""report.html: what came out, on one page that needs nothing else to be read.

Its plots are paths of SVG pictures: numbers in, geometry out.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from drake_pose.arrays import Array, Indices
from drake_pose.body import ArticulatedModel
from drake_pose.files.folder import OVERLAY
from drake_pose.files.records import JointRecord, SceneEstimate, measured_positions, user_units
from drake_pose.silhouette.pictures.scenes import Scene

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
# A position that changes by less over the frames is said in a table.
_STAYS = 1e-9
_PICTURES = 6
_PICTURE_SIZE = 300
_METHODS = {
    "beam": "searched by many hypotheses side by side",
    "paper": "searched as published",
    "person": "one person followed by all silhouettes at once",
    "person_by_colour": "one person followed by colour",
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


class Picture(NamedTuple):
    """An overlay. uri: of its data; link: of its file."""

    camera: str
    frame: str
    E_total: float | None
    uri: str
    link: str


def make_report(
    folder: Path, model: ArticulatedModel, scene: Scene, estimate: SceneEstimate
) -> str:
    """The page of an estimate; files and overlays that lie in its folder are linked."""
    template = page_template("drake_pose.files")
    frames = [row.frame for row in estimate.rows]
    records, joined = list(estimate.records.values()), scene.sequence
    found = ["found" if record.found else "not-found" for record in records]
    use = {name: _use(scene, estimate, name) for name in scene.cameras}
    errors = np.array([100.0 * row.error for row in estimate.rows])
    ious = [
        (name, np.array([100.0 * record.ious.get(name, np.nan) for record in records]))
        for name in scene.cameras
    ]
    told = {*found}.union(*use.values()) != {"found", "used"}
    pictures = _pick_pictures(folder, scene, estimate)
    return template.render(
        summary=estimate.summary,
        title=Path(str(estimate.summary["scene"])).name or str(estimate.summary["scene"]),
        model=model.path.name,
        method=_describe_method(scene, estimate),
        by_colour=bool(scene.images),
        rows=list(zip(frames, records, strict=True)),
        errors=plot_curves(frames, [("E_total", errors)], joined=joined, least=0.0),
        ious=plot_curves(frames, ious, joined=joined),
        compared=sum(bool(record.ious) for record in records),
        cameras=[_camera_row(estimate, name, states) for name, states in use.items()],
        grid=draw_grid(frames, [*use.items(), ("pose", found)]) if told else None,
        joints=_describe_joints(model, estimate, joined),
        pictures=pictures,
        compared_pictures={(one.camera, one.frame) in scene.masks for one in pictures},
        files=[(name, text) for name, text in _ABOUT.items() if (folder / name).is_file()],
    )


def _describe_method(scene: Scene, estimate: SceneEstimate) -> str:
    """How the poses were found: searched, or tracked from frame to frame."""
    method, states = str(estimate.summary["method"]), estimate.records.values()
    if method == "person" and scene.images:
        method = "person_by_colour"
    tracked = sum(record.found and record.stopped_by == "tracked" for record in states)
    others = estimate.found_count - tracked
    if not tracked:
        return _METHODS[method]
    how = f"tracked {'by colour ' if scene.images else ''}in {tracked} frames"
    return f"{how}, {others} {_METHODS[method]}" if others else how


def page_template(package: str) -> Template:
    """The template of a package's page, which may use the style and macros of all pages."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        loader=PackageLoader("drake_pose.files", ""),
    )  # fmt: skip
    environment.tests |= {"infinite": math.isinf, "nan": math.isnan}
    style = files("drake_pose.files").joinpath("report_style.css")
    environment.globals["box"] = BOX
    environment.globals["style"] = Markup(style.read_text(encoding="utf-8").rstrip())
    source = files(package).joinpath("report_template.html.j2")
    return environment.from_string(source.read_text(encoding="utf-8"))


def _describe_joints(
    model: ArticulatedModel, estimate: SceneEstimate, joined: bool
) -> list[dict[str, Any]]:
    """All positions that are known in a frame; a plot of each that changes from frame to frame."""
    frames, records, unit = list(estimate.records), estimate.records.values(), user_units(model)
    of_kind = {"angle": "deg", "length": "m", "quaternion": ""}
    q = np.array([row.q for row in estimate.rows]).reshape(len(frames), -1)
    measured, limits = measured_positions(model, q, records), unit * [model.lower, model.upper]
    q, measured = unit * q, unit * measured
    nothing, joints = JointRecord(False, np.nan, np.nan), []
    for k, (name, kind) in enumerate(zip(model.position_names, model.position_kinds, strict=True)):
        ends, own, plot = _ends(q[:, k]), (float(limits[0, k]), float(limits[1, k])), None
        told = [record.joints.get(name, nothing) for record in records]
        low, high = np.array([(one.low, one.high) for one in told]).T
        determined = np.array([one.determined for one in told])
        if ends[1] - ends[0] >= _STAYS:
            plot = plot_curves(
                frames, [(name, q[:, k]), ("measured", measured[:, k])], joined=joined,
                limits=own, intervals=(low, high, determined),
            )  # fmt: skip
        # Of a base that stands nothing is asked.
        elif np.isnan(ends[0]) or (np.isnan(low).all() and math.isinf(own[0])):
            continue
        joints.append({
            "name": name, "unit": of_kind[kind], "ends": ends, "interval": _ends(low, high),
            "determined": determined[np.isfinite(low)].all(), "measured": _ends(measured[:, k]),
            "limits": own, "plot": plot,
        })  # fmt: skip
    return joints


def _ends(*values: Array) -> tuple[float, float]:
    """The least and the greatest of what is known; nan where nothing is."""
    known = np.concatenate(values)
    known = known[np.isfinite(known)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


def _camera_row(estimate: SceneEstimate, camera: str, states: Sequence[str]) -> dict[str, Any]:
    """What the table of cameras says: pictures, those used, IoU, and whether it is suspicious."""
    records = estimate.records
    ious = {f: one.ious[camera] for f, one in records.items() if camera in one.ious}
    worst = min(ious, key=lambda frame: ious[frame], default=None)
    return {
        "name": camera,
        "pictures": len(states) - states.count("no-picture"),
        "used": states.count("used"),
        "mean": float(np.mean(list(ious.values()))) if ious else None,
        "least": None if worst is None else ious[worst],
        "worst": worst,
        "bad": any(f"'{camera}'" in text for text in estimate.summary["warnings"]),
    }


def _use(scene: Scene, estimate: SceneEstimate, camera: str) -> list[str]:
    """In which frames a camera was used, or was there."""
    states = []
    for frame, record in estimate.records.items():
        has_mask, has_image = (camera, frame) in scene.masks, (camera, frame) in scene.images
        is_used = camera in record.ious or (has_image and not has_mask and record.found)
        states.append("used" if is_used else "left-out" if has_mask or has_image else "no-picture")
    return states


def _pick_pictures(folder: Path, scene: Scene, estimate: SceneEstimate) -> list[Picture]:
    """Overlays of the frames that fit worst, as usual and best, as far as they were written."""
    known = [row for row in estimate.rows if row.found] or list(estimate.rows)
    in_order = sorted(known, key=lambda row: -row.error if row.found else 0.0)
    last = len(in_order) - 1
    chosen = list(dict.fromkeys([0, (last + 1) // 2, last])) if in_order else []
    pictures = []
    for row in (in_order[place] for place in chosen):
        ious = estimate.records[row.frame].ious
        cameras = sorted(scene.cameras, key=lambda name: ious.get(name, 1.0))
        shown = [
            overlay_picture(folder, name, row.frame, row.error if row.found else None)
            for name in cameras
        ]
        pictures += [one for one in shown if one is not None][: max(1, _PICTURES // len(chosen))]
    return pictures


def overlay_picture(
    folder: Path, camera: str, frame: str, E_total: float | None, overlay: str = OVERLAY
) -> Picture | None:
    """An overlay in a result's folder, made small; None where it is no picture any more."""
    place = f"{overlay}/{camera}/{frame}.png"
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
