"""The page report.html of an estimate, in one file with all pictures, and parts of other pages."""

import base64
import io
import math
from collections.abc import Sequence
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from drake_pose.arrays import Array, Mask
from drake_pose.body import ArticulatedModel
from drake_pose.errors import listed
from drake_pose.files.folder import OVERLAY
from drake_pose.files.records import SceneEstimate, measured_positions, user_units
from drake_pose.silhouette.pictures.scenes import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def make_report(
    folder: Path, model: ArticulatedModel, scene: Scene, estimate: SceneEstimate
) -> str:
    """Return the HTML page of an estimate, with links to the files and overlays in its folder.

    Args:
        folder: the result folder, with its other files already written.
        model: the model of the positions.
        scene: the scene, with the cameras that were used.
        estimate: the estimate.
    """
    frames, records, joined = list(estimate.records), estimate.records.values(), scene.sequence
    found = ["found" if record.found else "not-found" for record in records]
    use: dict[str, list[str]] = {name: [] for name in scene.cameras}
    for (camera, states), record in product(use.items(), records):
        # A mask is used if it was compared with the body, a picture without mask if a pose was
        # found.
        has_mask, has_image = ((camera, record.frame) in x for x in (scene.masks, scene.images))
        is_used = camera in record.ious or (has_image and not has_mask and record.found)
        states.append("used" if is_used else "left-out" if has_mask or has_image else "no-picture")
    errors = [np.nan if one.E_total is None else 100.0 * one.E_total for one in records]
    ious = [
        (name, np.array([100.0 * record.ious.get(name, np.nan) for record in records]))
        for name in scene.cameras
    ]
    pictures = _pick_pictures(folder, scene, estimate)
    grid, plots = None, {}
    if {*found}.union(*use.values()) != {"found", "used"}:
        grid = plot_uri(draw_grid(frames, [*use.items(), ("pose", found)]))
    if len(frames) > 1 and estimate.found_count:
        curves = {"errors": [("E_total", np.array(errors))], "ious": ious}
        for name, values in curves.items():
            least = 0.0 if name == "errors" else None
            plots[name] = plot_uri(plot_curves(frames, values, joined=joined, least=least))
    about = {
        "poses.csv": "every position in every frame [rad or m]",
        "joints.csv": "95 % interval of each joint, and whether it is determined [deg or m]",
        "modes.csv": "other poses that fit equally well",
        "joint_centres.csv": "anatomical joint centres in the world [m]",
        "joint_centres.trc": "the same as markers [mm], for motion analysis",
        "positions.mot": "every position over time [deg or m], for motion analysis",
        "shapes.png": "the fitted shape of the body over the model file's",
        "replay.html": "the estimate in three dimensions",
        "summary.json": "settings, versions and all numbers of this page",
    }
    return page_template("drake_pose.files").render(
        summary=estimate.summary,
        answer=estimate_answer(model, estimate),
        kind="estimate",
        title=Path(str(estimate.summary["scene"])).name or str(estimate.summary["scene"]),
        model=model.path.name,
        method=_describe_method(scene, estimate),
        by_colour=bool(scene.images),
        records=list(records),
        plots=plots,
        compared=sum(bool(record.ious) for record in records),
        cameras=[_camera_row(estimate, name, states) for name, states in use.items()],
        grid=grid,
        joined=joined,
        joints=_joint_rows(model, estimate, joined),
        pictures=pictures,
        compared_pictures={(one["camera"], one["frame"]) in scene.masks for one in pictures},
        files=[(name, text) for name, text in about.items() if (folder / name).is_file()],
    )


def estimate_answer(model: ArticulatedModel, estimate: SceneEstimate) -> str:
    """Return the result in one or two sentences: poses found, error, and determined joints.

    A joint of ``model`` counts as determined if it is so in all frames of ``estimate`` with a pose.
    """
    found = [record for record in estimate.records.values() if record.found]
    count = len(estimate.records)
    of_frames = "" if count == 1 else f" in {len(found)} of {count} frames"
    if not found:
        return "No pose was found." if count == 1 else f"No pose was found in {count} frames."
    error = "error" if count == 1 else "mean error"
    error += f" {100.0 * estimate.summary['mean_E_total']:.1f} % of the silhouette"
    known = [record.joints for record in found]
    names = [name for name in model.position_names if any(name in one for one in known)]
    sure = [k for k in names if all(k in one and one[k]["determined"] for one in known)]
    open_joints = [name for name in names if name not in sure]
    determined = f"{len(names) - len(open_joints)} of {len(names)} joints determined"
    if not names:
        return f"Pose found{of_frames}; {error}."
    if not open_joints:
        return f"{determined}{of_frames}; {error}."
    always, not_always = ("", "not") if count == 1 else (" in all of them", "not always")
    return (
        f"Pose found{of_frames}; {error}. {determined}{always}; {not_always}: "
        f"{listed(open_joints)}."
    )


def _describe_method(scene: Scene, estimate: SceneEstimate) -> str:
    """Return how the poses of an estimate were found: ``tracked in 58 frames, 2 searched by ...``.

    Tracking is by colour if the scene has pictures (``scene.images``).
    """
    method, states = str(estimate.summary["method"]), estimate.records.values()
    text = {
        "beam": "searched by beam search and contour fits",
        "paper": "searched as published by Kameda et al.",
        "person": "one person, fitted to all silhouettes at once",
        "paper_capture": "one person, tracked by skin colour as published by Date et al.",
    }[method]
    tracked = sum(record.found and record.stopped_by == "tracked" for record in states)
    others = estimate.found_count - tracked
    if not tracked:
        return text
    how = f"tracked {'by colour ' if scene.images else ''}in {tracked} frames"
    return f"{how}, {others} {text}" if others else how


def page_template(package: str, name: str = "report_template.html.j2") -> Template:
    """Return the template in the file ``name`` of a package (dotted name).

    It may extend report_base.html.j2, and has the style sheet as the variable ``style``.
    """
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        loader=PackageLoader("drake_pose.files", ""),
    )  # fmt: skip
    style = files("drake_pose.files").joinpath("report_style.css")
    environment.globals["style"] = Markup(style.read_text(encoding="utf-8").rstrip())
    source = files(package).joinpath(name)
    return environment.from_string(source.read_text(encoding="utf-8"))


def _joint_rows(
    model: ArticulatedModel, estimate: SceneEstimate, joined: bool
) -> list[dict[str, Any]]:
    """Return the rows of the table of joints, with a bar and a plot of each joint.

    Positions are in degrees or mm. Joints without an estimate, and those of a fixed base, have no
    row; without records there is none.

    ``model``: the model of the positions. ``estimate``: the estimate. ``joined``: whether frames
    are a sequence, whose plots join neighbouring frames by a line. Returns the variables of each
    row for report_template.html.j2.
    """
    records, frames = list(estimate.records.values()), list(estimate.records)
    if not records:
        return []
    units = {"angle": ("deg", 1.0, 1), "length": ("mm", 1e3, 1), "quaternion": ("", 1.0, 3)}
    scale = np.array([units[kind][1] for kind in model.position_kinds])
    to_page = scale * user_units(model)
    q = to_page * np.array([record.q for record in records])
    measured = to_page * measured_positions(model, records)
    limits, rows = to_page * [model.lower, model.upper], list[dict[str, Any]]()
    drawn: Figure | None = None
    unknown = {"determined": False, "low": np.nan, "high": np.nan}
    for k, (name, kind) in enumerate(zip(model.position_names, model.position_kinds, strict=True)):
        ends, own, plot = _ends(q[:, k]), (float(limits[0, k]), float(limits[1, k])), None
        known = [record.joints.get(name, unknown) for record in records]
        low, high = scale[k] * np.array([(one["low"], one["high"]) for one in known]).T
        determined = np.array([one["determined"] for one in known])
        if ends[1] - ends[0] >= 1e-9:
            curves = [("measured", measured[:, k]), (name, q[:, k])]
            drawn = plot_curves(
                frames, curves, joined=joined, limits=own, intervals=(low, high, determined),
                onto=drawn,
            )  # fmt: skip
            plot = plot_uri(drawn)
        elif np.isnan(ends[0]) or (np.isnan(low).all() and math.isinf(own[0])):
            continue
        unit, _, digits = units[kind]
        has_interval, interval = np.isfinite(low), _range(_ends(low, high), digits)
        if len(records) > 1 and has_interval.any():
            half = 0.5 * float(np.median((high - low)[has_interval]))
            interval = f"± {half:.{digits}f}"
        errors = estimate.summary["joint_errors"].get(name)
        count, sure = estimate.found_count, int(determined.sum())
        of_frames = f"{sure} of {count}" if len(records) > 1 else "yes" if sure else "no"
        rows.append({
            "name": name, "unit": unit, "estimate": _range(ends, digits), "interval": interval,
            "determined": of_frames if has_interval.any() else "–",
            "any_determined": sure > 0, "any_open": has_interval.any() and sure < count,
            "measured": _range(_ends(measured[:, k]), digits),
            "limits": " to ".join("none" if math.isinf(x) else f"{round(x, 1):g}" for x in own),
            "mean_error": f"{scale[k] * errors['mean']:.{digits}f}" if errors else "–",
            "largest_error": f"{scale[k] * errors['largest']:.{digits}f}" if errors else "–",
            "bar": _bar(own, ends, _ends(low, high), is_open=sure < count),
            "plot": plot, "warnings": _warnings_of(estimate, name),
        })  # fmt: skip
    return rows


def _range(ends: tuple[float, float], digits: int) -> str:
    """Return ``low to high`` with this number of digits after the point; a dash for nan.

    ``ends`` is low and high: an infinite one becomes ``none``, equal ones a single number.
    """
    low, high = ("none" if math.isinf(one) else f"{one:z.{digits}f}" for one in ends)
    return "–" if math.isnan(ends[0]) else low if low == high else f"{low} to {high}"


def _bar(
    limits: tuple[float, float],
    estimate: tuple[float, float],
    interval: tuple[float, float],
    *,
    is_open: bool,
    least_width: float = 1.0,
) -> list[dict[str, Any]]:
    """Return the rectangles of a bar between a joint's limits, [] if its range is infinite or 0.

    ``limits``, ``estimate``, ``interval``: smallest and largest value in one unit; nan where
    unknown. ``is_open``: whether the joint is not determined in some frame. ``least_width``: width
    of a single value [percent of the bar].

    Returns ``kind`` ("open" or "interval", and "estimate"), ``left`` and ``width`` [percent of the
    bar] of each rectangle, for the template.
    """
    span = limits[1] - limits[0]
    if not (math.isfinite(span) and span > 0.0):
        return []
    parts = []
    for kind, ends in (("open" if is_open else "interval", interval), ("estimate", estimate)):
        if math.isnan(ends[0]):
            continue
        left, right = (min(max(100.0 * (x - limits[0]) / span, 0.0), 100.0) for x in ends)
        width = max(right - left, least_width)
        left = min(left, 100.0 - width)
        parts.append({"kind": kind, "left": f"{left:.1f}", "width": f"{width:.1f}"})
    return parts


def _warnings_of(estimate: SceneEstimate, name: str) -> list[int]:
    """Return the numbers, from 1, of an estimate's warnings that name the camera or joint."""
    texts = dict.fromkeys(estimate.summary["warnings"])
    return [number for number, text in enumerate(texts, 1) if f"'{name}'" in text]


def _ends(*values: Array) -> tuple[float, float]:
    """Return the smallest and the largest finite value of all arrays (n,); nan if there is none."""
    known = np.concatenate(values)
    known = known[np.isfinite(known)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


def _camera_row(estimate: SceneEstimate, camera: str, states: Sequence[str]) -> dict[str, Any]:
    """Return a row of the table of cameras: number of pictures, of those used, IoU, warnings.

    ``estimate``: the estimate. ``camera``: the camera's name. ``states``: (frames,) "used",
    "left-out" or "no-picture".
    """
    records = estimate.records
    ious = {f: one.ious[camera] for f, one in records.items() if camera in one.ious}
    worst = min(ious, key=lambda frame: ious[frame], default=None)
    return {
        "name": camera,
        "pictures": len(states) - states.count("no-picture"),
        "used": states.count("used"),
        "mean": float(np.mean(list(ious.values()))) if ious else None,
        "lowest": None if worst is None else ious[worst],
        "worst": worst,
        "warnings": _warnings_of(estimate, camera),
    }


def _pick_pictures(
    folder: Path, scene: Scene, estimate: SceneEstimate, most: int = 6
) -> list[dict[str, Any]]:
    """Return existing overlays of the frames with the largest, median and smallest error.

    The result is in this order, as `overlay_picture` returns it; of each frame the overlays with
    the lowest IoU are taken.

    ``folder``: the result folder. ``scene``: the scene, with the cameras that were used.
    ``estimate``: the estimate. ``most``: approximate maximum number of overlays.
    """
    records = estimate.records.values()
    known = [record for record in records if record.found] or list(records)
    in_order = sorted(known, key=lambda one: -(one.E_total or 0.0))
    last = len(in_order) - 1
    chosen = list(dict.fromkeys([0, (last + 1) // 2, last])) if in_order else []
    pictures = []
    for one in (in_order[place] for place in chosen):
        cameras = sorted(scene.cameras, key=lambda name: one.ious.get(name, 1.0))
        shown = [overlay_picture(folder, name, one.frame, one.E_total) for name in cameras]
        pictures += [own for own in shown if own is not None][: max(1, most // len(chosen))]
    return pictures


def overlay_picture(
    folder: Path,
    camera: str,
    frame: str,
    E_total: float | None,
    overlay: str = OVERLAY,
    height: int = 300,
) -> dict[str, Any] | None:
    """Return an overlay for a page, embedded as a smaller picture.

    Args:
        folder: the result folder.
        camera: the camera's name.
        frame: the frame's name.
        E_total: the frame's error, as a fraction; None if it has no pose.
        overlay: the overlays' folder in the result folder.
        height: maximum height of the embedded picture [pixel].

    Returns entries for a template: ``camera``, ``frame``, ``E_total``, ``uri`` (data URI) and
    ``link`` (to the file); None if the file does not exist or is not a picture.
    """
    place = f"{overlay}/{camera}/{frame}.png"
    if not (folder / place).is_file():
        return None
    data = np.frombuffer((folder / place).read_bytes(), np.uint8)
    if (picture := cv2.imdecode(data, cv2.IMREAD_COLOR)) is None:
        return None
    scale = min(1.0, height / picture.shape[0])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])
    uri = "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
    return {"camera": camera, "frame": frame, "E_total": E_total, "uri": uri, "link": quote(place)}


def new_plot(height: float = 1.5, left: float = 0.09) -> "tuple[Figure, Axes]":
    """Return an empty plot for a page.

    ``height``: height of the figure [inch]. ``left``: space left of the axes, as a fraction of the
    width.
    """
    from matplotlib.figure import Figure  # Slow to import, and many pages have no plot.

    figure = Figure(figsize=(6.4, height), dpi=120)
    axes = figure.add_axes((left, 0.3 / height, 0.985 - left, 1.0 - 0.38 / height))
    axes.tick_params(labelsize=8, length=2, colors="#57606a")
    for side in axes.spines.values():
        side.set_color("#d8dee4")
    _restart_colours(axes)
    return figure, axes


def _restart_colours(axes: "Axes") -> None:
    """Give the next curve of a plot the first of the colours."""
    colours = "#0072b2 #d55e00 #009e73 #b8468f #7a5c00 #2f8fc4 #666666 #8c2d04"
    axes.set_prop_cycle(color=colours.split())


def plot_uri(figure: "Figure") -> str:
    """Return a figure as the data URI of a PNG picture."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()


def plot_curves(
    frames: Sequence[str],
    values: Sequence[tuple[str, Array]],
    *,
    joined: bool,
    limits: tuple[float, float] | None = None,
    intervals: tuple[Array, Array, Mask] | None = None,
    least: float | None = None,
    onto: "Figure | None" = None,
) -> "Figure":
    """Plot curves over frames; nan leaves a gap.

    Args:
        frames: names of the frames.
        values: label and (frames,) values of each curve; the curve "measured" is wide.
        joined: whether neighbouring frames are joined by a line.
        limits: lower and upper limit, each drawn only if its distance to curves and intervals is at
            most their span; None: no limits.
        intervals: low and high (frames,), and whether the joint is determined (frames,), drawn as
            bars behind the curves; None: no bars, and a legend if there are several curves.
        least: lower end of the axis, such as 0; None: chosen from the curves.
        onto: plot of the same frames by an earlier call, without a legend. Its curves are replaced,
            which takes a third of the time of a new plot; None: a new one is made.
    """
    figure, axes = new_plot() if onto is None else (onto, onto.axes[0])
    for artist in (*axes.lines, *axes.collections):
        artist.remove()
    _restart_colours(axes)
    places = np.arange(len(frames))
    shown = np.concatenate([value for _, value in values])
    if intervals is not None:
        low, high, determined = intervals
        shown = np.concatenate([shown, low, high])
        # As wide as a frame, at most 1/40 of the axis [point].
        width = 1.1 * 420.0 / max(len(frames), 40)
        for where, colour in ((determined, "#c5dfee"), (~determined, "#e4e6e8")):
            axes.vlines(places[where], low[where], high[where], colour, linewidth=width)
    shown = shown[np.isfinite(shown)]
    bottom, top = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)
    near = top - bottom
    if limits is not None and bottom - near <= limits[0] < bottom:
        bottom = limits[0]
    if limits is not None and top < limits[1] <= top + near:
        top = limits[1]
    bottom = bottom if least is None else min(bottom, least)
    margin = 0.08 * (top - bottom if top > bottom else max(1e-3, 0.02 * abs(top)))
    axes.set_ylim(bottom - (0.0 if bottom == least else margin), top + margin)
    # Markers show single frames between gaps, where there is no line.
    style: dict[str, Any] = {"linestyle": "-" if joined else "", "marker": ".", "linewidth": 1.2}
    wide = {"color": "#009e7380", "linewidth": 4, "markersize": 4 if joined else 16, "zorder": 1.5}
    for label, value in values:
        own = wide if label == "measured" else {"markersize": 2 if joined else 8}
        axes.plot(places, value, label=label, **(style | own))
    for limit in limits or ():
        if bottom <= limit <= top:
            axes.axhline(limit, color="#b3400a", linestyle="--", linewidth=0.8)
    if len(values) > 1 and intervals is None:
        axes.legend(fontsize=7, loc="lower right", ncols=4, framealpha=0.8)
    if onto is None:
        axes.grid(axis="y", color="#d8dee4", linewidth=0.5)
        _mark_frames(axes, frames)
    return figure


def _mark_frames(axes: "Axes", frames: Sequence[str], count: int = 6) -> None:
    """Label the x axis with the names of about ``count`` frames."""
    step = max(1, -(-len(frames) // count))
    names = [name[:20] for name in frames[::step]]
    axes.set_xticks(range(0, len(frames), step), names, parse_math=False)
    axes.set_xlim(-0.5, max(len(frames), 1) - 0.5)


def draw_grid(frames: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> "Figure":
    """Plot states over frames: a row of bars for each name; equal neighbours are one bar.

    ``frames``: names of the frames. ``rows``: name and (frames,) states of each row. "used" and
    "found" are blue, "no-picture" is grey, other states are orange.
    """
    colours = {"used": "#0072b2", "found": "#0072b2", "no-picture": "#d8dee4"}
    figure, axes = new_plot(0.4 + 0.2 * len(rows), 0.2)
    for number, (_, states) in enumerate(rows):
        starts = [k for k in range(len(states)) if k == 0 or states[k] != states[k - 1]]
        runs = zip(starts, [*starts[1:], len(states)], strict=True)
        spans = [(start - 0.5, end - start) for start, end in runs]
        faces = [colours.get(states[start], "#d55e00") for start in starts]
        axes.broken_barh(spans, (number - 0.4, 0.8), facecolors=faces)
    names = [name if len(name) <= 20 else f"{name[:19]}…" for name, _ in rows]
    axes.set_yticks(range(len(rows)), names, parse_math=False)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    _mark_frames(axes, frames)
    return figure
