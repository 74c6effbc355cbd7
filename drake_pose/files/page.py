"""Pages of results: the answer, what to do next, warnings by weight, then tables and pictures.

A page is one file without scripts, with all its pictures. The page of an estimate stands here.
"""

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

import cv2
import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel
from drake_pose.errors import listed
from drake_pose.files.folder import OVERLAY, OVERLAY_MODES, REPORT, write_file
from drake_pose.files.records import FrameRecord, SceneEstimate, measured_positions, user_units
from drake_pose.silhouette.pictures.scenes import Scene

_FILES = files("drake_pose.files")

BLUE, GREY = "known", "open"
"""Classes of bars and bands: what is determined, and what is not."""

NORMAL = 1.96
"""Half-width of a 95 % interval in standard deviations."""

Curve = tuple[str, Array]
"""Class in the style sheet ("estimate", "measured", or a number), and (n,) values; nan: a gap."""

Band = tuple[str, Array, Array]
"""Class in the style sheet, and lower and upper ends (n,) of an interval; nan: no interval."""


@dataclass(frozen=True)
class Table:
    """A table of a page; a cell is text, or markup of `bad`."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    closed: str = ""  # A line below which the table is hidden until it is opened; "": none.


Figure = tuple[Markup, str, str]
"""An <img> or <svg> of a page, its caption, and its title or ""."""


@dataclass(frozen=True)
class Page:
    """The page report.html of a result."""

    title: str  # Name of the scene.
    about: str  # What was done, in a line.
    answer: str  # The result in one or two sentences, with numbers and units.
    summary: Mapping[str, Any]  # Content of summary.json; its warnings are shown.
    # Parts by key of page_words.yaml, or by a heading without text; empty ones are left out.
    sections: Mapping[str, Sequence[Table | Sequence[Figure]]]
    advice: Sequence[str] = ()  # What to do next, beside using the files.

    def write(self, folder: Path) -> None:
        """Write the page into a result folder, whose files it names.

        No path of the machine is shown: files are named without their folders.
        """
        environment = Environment(
            autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
            loader=PackageLoader("drake_pose.files", ""),
        )  # fmt: skip
        style = _FILES.joinpath("page.css").read_text(encoding="utf-8")
        texts = [without_folders(text) for text in self.summary.get("warnings", ())]
        weights = self.summary.get("warning_weights", len(texts) * ["check"])
        kinds = {"wrong": "Wrong answer likely", "check": "To check", "note": "Notes"}
        weighed = dict(zip(texts, weights, strict=True))
        answer = f"{kinds['wrong']}: see below. " if "wrong" in weights else ""
        text = environment.get_template("page.html.j2").render(
            page=self,
            style=Markup(style.rstrip()),
            answer=answer + without_folders(self.answer),
            about=without_folders(self.about),
            advice=[*[page_words()["advice"]["wrong"]] * ("wrong" in weights), *self.advice],
            steps=next_steps(folder, self.summary),
            warnings={
                title: (kind, [text for text, own in weighed.items() if own == kind])
                for kind, title in kinds.items()
                if kind in weights
            },
            sections=[
                (*page_words()["sections"].get(name, (name, "")), name, parts)
                for name, parts in self.sections.items()
                if any(parts)
            ],
        )
        write_file(folder, REPORT, text)


@cache
def page_words() -> dict[str, dict[str, Any]]:
    """Return the content of page_words.yaml: ``sections``, ``files`` and ``advice`` by key."""
    text = _FILES.joinpath("page_words.yaml").read_text(encoding="utf-8")
    return cast(dict[str, dict[str, Any]], yaml.safe_load(text))


def next_steps(folder: Path, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return name and use of each file or folder of a result that a user goes on with.

    ``folder``: the result folder. ``summary``: content of summary.json, which names the links that
    carry cameras.
    """
    cameras = summary.get("cameras")
    entries = list(cameras.values()) if isinstance(cameras, Mapping) else []
    links = list(dict.fromkeys(str(one["link"]) for one in entries if "link" in one))
    frames = [f"the frame of link {link}" for link in links]
    bodies = [f"body {link}" for link in links]
    read = ": give them to audit (--cameras)"
    if not links or not all("link" in one for one in entries):
        frames, bodies = ["the robot's world", *frames], ["the worldbody", *bodies]
        read = ": give them to estimate and audit (--cameras), or copy the file into the scene"
    frame, body = " or ".join(frames), " or ".join(bodies)
    # Masks are made with the cameras as given, which may have no poses.
    read = " as they were given" if "mask_count" in summary else f", with poses in {frame}{read}"
    return [
        (path.name + "/" * path.is_dir(), use.format(frame=frame, body=body, use=read))
        for pattern, use in page_words()["files"].items()
        for path in sorted(folder.glob(pattern))
    ]


def without_folders(text: str) -> str:
    """Return a text in which absolute paths are replaced by the files' names."""
    return re.sub(r"(?<![\w.:/<])/(?:[^\s/:;,'\"]+/)+", "", text)


def scene_title(summary: Mapping[str, Any]) -> str:
    """Return the name of the scene of a summary.json."""
    return Path(str(summary["scene"])).resolve().name


def bad(text: str) -> Markup:
    """Return a text of a table that stands out, without the folders of paths."""
    return Markup('<span class="bad">{}</span>').format(without_folders(text))


def share(fraction: float | None, unknown: str) -> str:
    """Return a fraction in percent; ``unknown`` for None or nan."""
    return unknown if fraction is None or np.isnan(fraction) else f"{100.0 * fraction:.1f} %"


def p_value(p: float) -> str:
    """Return a p-value as text."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def picture(data: bytes, about: str, link: str = "", side: int = 900) -> Markup:
    """Return an encoded picture as <img>, not larger than ``side`` [pixel]; "": it is damaged.

    ``about``: what it shows. ``link``: file that is opened by a click; "": none.
    """
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if found is None:
        return Markup("")
    scale = min(1.0, side / max(found.shape))
    small = cv2.resize(found, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])
    uri = "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
    image = Markup('<img src="{}" alt="{}">').format(uri, about)
    return Markup('<a href="{}">{}</a>').format(link, image) if link else image


def picture_files(
    folder: Path, places: Mapping[str, str], side: int = 480, most: int = 8
) -> list[Figure]:
    """Return figures of the first ``most`` picture files that a result folder has.

    ``places``: caption by path in the folder. ``side``: as of `picture`.
    """
    names = [name for name in places if (folder / name).is_file()][:most]
    files = [(picture((folder / x).read_bytes(), places[x], quote(x), side), x) for x in names]
    return [(image, places[name], "") for image, name in files if image]


def plot(
    curves: Sequence[Curve],
    labels: Sequence[str],
    about: str,
    *,
    bands: Sequence[Band] = (),
    limits: Iterable[float] = (),
    joined: bool = True,
    least: float = np.inf,
) -> Markup:
    """Return curves over n equal steps as <svg>.

    Args:
        curves: the curves; dots if they are not joined.
        labels: (n,) names of the steps, at least one; some are written below the axis.
        about: what the plot shows.
        bands: intervals, drawn behind the curves.
        limits: values of dashed lines; those farther away than the curves span are not drawn.
        joined: whether neighbouring values are joined by a line.
        least: the axis includes it, such as 0; inf: nothing in particular.
    """
    width, height, left, top = 640.0, 130.0, 60.0, 8.0
    shown = np.concatenate([*(y for _, y in curves), *(y for _, *ends in bands for y in ends)])
    shown = shown[np.isfinite(shown)]
    low, high = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)
    low = min(low, least)
    near = [x for x in limits if low - (high - low) <= x <= high + (high - low)]
    low, high = min([low, *near]), max([high, *near])
    ticks, margin = np.unique(np.linspace(low, high, 3)), 0.06 * (high - low or max(abs(high), 1.0))
    low, high = low - (0.0 if low == least else margin), high + margin
    step = (width - left - top) / len(labels)
    x = left + step * (np.arange(len(labels)) + 0.5)

    def y(value: Any) -> Any:
        return top + (height - 30.0) * (high - value) / (high - low)

    marks = [
        Markup('<path class="axis" d="M{0:.0f} {1:.1f}H{2:.0f}"/><text x="{3:.0f}" y="{4:.1f}" '
               'text-anchor="end">{5:.3g}</text>').format(
            left, y(value), width - top, left - 5.0, y(value) + 4.0, value)
        for value in ticks
    ]  # fmt: skip
    for name, *ends in bands:
        lines = zip(x, *(y(one) for one in ends), strict=True)
        path = "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in lines if np.isfinite(b + c))
        thick = max(1.0, min(step, 10.0))
        marks.append(
            Markup('<path class="{}" stroke-width="{:.1f}" d="{}"/>').format(name, thick, path)
        )
    for value in near:
        marks.append(Markup('<path class="limit" d="M{:.0f} {:.1f}H{:.0f}"/>').format(
            left, y(value), width - top))  # fmt: skip
    for name, values in curves:
        path, before = "", False
        for a, b in zip(x, y(values), strict=True):
            if known := bool(np.isfinite(b)):
                path += f"{'L' if before and joined else 'M'}{a:.1f} {b:.1f}"
                path += "" if before and joined else "h0"
            before = known
        kind = "" if joined else " dots"
        marks.append(Markup('<path class="curve c{}{}" d="{}"/>').format(name, kind, path))
    for k in sorted({0, len(labels) // 2, len(labels) - 1}):
        place = Markup('<text x="{:.1f}" y="{:.0f}" text-anchor="middle">{}</text>')
        marks.append(place.format(x[k], height - 6.0, labels[k][:20]))
    head = Markup('<svg class="plot" viewBox="0 0 {:.0f} {:.0f}" role="img" aria-label="{}">')
    return head.format(width, height, about) + Markup("").join(marks) + Markup("</svg>")


def bar(limits: Array, parts: Sequence[tuple[str, float, float]], unit: str) -> Markup:
    """Return a joint's limits with parts between them as a <svg>, which needs a finite range.

    ``limits``: (2,) lower and upper limit. ``parts``: class in the style sheet, and lower and upper
    end in the limits' unit; nan: left out. ``unit``: of the limits, after a space.
    """
    span, drawn = limits[1] - limits[0], Markup("")
    low, high = ("none" if np.isinf(x) else f"{round(x, 1):g}" for x in limits)
    if not (np.isfinite(span) and span > 0.0):
        return Markup(low if low == high else f"{low} to {high}") + unit
    for name, *ends in parts:
        if np.isfinite(ends).all():
            left, right = np.clip(100.0 * (np.array(ends) - limits[0]) / span, 0.0, 100.0)
            wide = max(right - left, 1.0)
            drawn += Markup('<rect class="{}" x="{:.1f}" width="{:.1f}" height="8"/>').format(
                name, min(left, 100.0 - wide), wide
            )
    head = Markup('<svg class="bar" viewBox="0 0 100 8" preserveAspectRatio="none">')
    return Markup("{}{}{}</svg>{}{}").format(low, head, drawn, high, unit)


def estimate_page(
    folder: Path, model: ArticulatedModel, scene: Scene, estimate: SceneEstimate
) -> Page:
    """Return the page of an estimate.

    Args:
        folder: the result folder, with its other files already written.
        model: the model of the positions.
        scene: the scene, with the cameras that were used.
        estimate: the estimate.
    """
    records, summary, cameras = list(estimate.records.values()), estimate.summary, scene.cameras
    table, plots = _joints(model, estimate, scene.sequence)
    answer, open_joints = estimate_answer(estimate)
    errors = np.array([np.nan if x.E_total is None else 100.0 * x.E_total for x in records])
    ious = [
        (f"{k % 5}", np.array([100.0 * record.ious.get(name, np.nan) for record in records]))
        for k, name in enumerate(cameras)
    ]
    curves, names = list[Figure](), list(estimate.records)
    if len(records) > 1 and estimate.found_count:
        for title, own, mean, least in (
            ("E_total [%]", [("estimate", errors)], summary["mean_E_total"], 0.0),
            ("IoU [%]", ious, summary["mean_iou"], np.inf),
        ):
            if title[0] == "E" or summary["compared_count"] > 1:
                told = f"Mean {share(mean, 'unknown')}"
                drawn = plot(own, names, f"{title} by frame", least=least, joined=scene.sequence)
                curves.append((drawn, told, title))
    seconds = summary["median_seconds"]
    return Page(
        scene_title(summary),
        f"Estimate of {scene_title(summary)}, model {model.path.name}, {len(cameras)} camera"
        f"{'s' * (len(cameras) != 1)}, {_describe_method(scene, estimate)}"
        + ("" if seconds is None else f", {seconds:.2f} s per frame"),
        answer,
        summary,
        {
            **_pictures(folder, scene, estimate),
            "joints": [table],
            "joints_by_frame": [plots],
            "errors_by_frame": [curves],
            "cameras": [_cameras(scene, records)],
            "frames": [Table(
                ["frame", "pose", "E_total", "cameras compared"],
                [[x.frame, "found" if x.found else bad("none"), share(x.E_total, "no pose"),
                  ", ".join(x.ious) or "none"] for x in records],
                f"{len(records)} frames",
            )],
        },
        [page_words()["advice"]["open"]] * bool(open_joints),
    )  # fmt: skip


def estimate_answer(estimate: SceneEstimate) -> tuple[str, list[str]]:
    """Return the result in two sentences, and the joints that are not determined.

    A joint counts as determined if it is so in all frames with a pose.
    """
    found = [record for record in estimate.records.values() if record.found]
    count = len(estimate.records)
    of_frames = "" if count == 1 else f" in {len(found)} of {count} frames"
    if not found:
        return f"No pose was found{f' in {count} frames' * (count > 1)}.", []
    error = share(estimate.summary["mean_E_total"], "an unknown part")
    answer = f"Pose found{of_frames}; body and silhouettes differ by {error} of their area."
    known = [record.joints for record in found]
    names = [name for name in estimate.position_names if any(name in one for one in known)]
    left = [k for k in names if not all(k in one and one[k]["determined"] for one in known)]
    if not names:
        return f"{answer} Which joints are determined was not computed.", []
    always = "" if count == 1 else " in all frames"
    if not left:
        return f"{answer} All {len(names)} joints are determined{always}.", []
    told = f": {listed(left)}" if len(left) <= 5 else f" ({len(left)} joints)"
    return (
        f"{answer} {len(names) - len(left)} of {len(names)} joints are determined{always}; do not "
        f"rely on the others{told}."
    ), left


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


def _pictures(folder: Path, scene: Scene, estimate: SceneEstimate) -> dict[str, list[list[Figure]]]:
    """Return a section with the frame of the median error and its modes, and one of other frames.

    Of frames with drawn modes the first section shows that with the median error; the second shows
    those with the largest and the smallest error. The cameras with the lowest IoU come first.
    """
    records = [one for one in estimate.records.values() if one.found]
    in_order = sorted(records or estimate.records.values(), key=lambda one: -(one.E_total or 0.0))
    drawn = [x for x in in_order if (folder / OVERLAY_MODES / f"{x.frame}.png").is_file()]
    if not in_order:
        return {}

    def figures(one: FrameRecord, side: int, most: int) -> list[Figure]:
        error = f"frame {one.frame}, E_total {share(one.E_total, 'unknown: no pose')}"
        names = sorted(scene.cameras, key=lambda name: one.ious.get(name, 1.0))
        places = {f"{OVERLAY}/{name}/{one.frame}.png": f"{name}, {error}" for name in names}
        return picture_files(folder, places, side, most)

    usual = (drawn or in_order)[len(drawn or in_order) // 2]
    others = [x for x in dict.fromkeys((in_order[0], in_order[-1])) if x is not usual]
    count, most = usual.mode_count or 1, min(usual.mode_count or 1, 3)
    several = f"{most} of {count} poses that fit equally well" if count > 1 else "the pose"
    modes = {
        f"{OVERLAY_MODES}/{usual.frame}.png": f"Frame {usual.frame}, {several}. Blue: parts whose "
        "own joints are determined; grey: parts whose own joints are not."
    }
    hero = [*figures(usual, 900, 2), *picture_files(folder, modes, 900)]
    return {"pose": [hero], "extremes": [[x for one in others for x in figures(one, 480, 3)]]}


def _joints(
    model: ArticulatedModel, estimate: SceneEstimate, joined: bool
) -> tuple[Table, list[Figure]]:
    """Return the table of joints, and plots of those that differ between frames.

    Joints without an estimate, and those of a fixed base, have no row. ``joined``: whether frames
    are a sequence, whose plots join neighbouring frames by a line.
    """
    records, errors_of = list(estimate.records.values()), estimate.summary["joint_errors"]
    units = {"angle": (" deg", 1.0, 1), "length": (" mm", 1e3, 1), "quaternion": ("", 1.0, 3)}
    scale = np.array([units[kind][1] for kind in model.position_kinds])
    to_page = scale * user_units(model)
    q = to_page * np.array([record.q for record in records]).reshape(-1, len(scale))
    measured = to_page * measured_positions(model, records) if records else q
    limits, rows, plots = to_page * [model.lower, model.upper], list[list[str]](), list[Figure]()
    unknown = {"determined": False, "low": np.nan, "high": np.nan}
    for k, (name, kind) in enumerate(zip(model.position_names, model.position_kinds, strict=True)):
        unit, _, digits = units[kind]
        known = [record.joints.get(name, unknown) for record in records]
        low, high = scale[k] * np.array([(x["low"], x["high"]) for x in known]).reshape(-1, 2).T
        sure = np.array([one["determined"] for one in known], bool)
        ends, spans, own = _ends(q[:, k]), _ends(low, high), limits[:, k]
        moves = ends[1] - ends[0] >= 1e-9
        if math.isnan(ends[0]) or (math.isnan(spans[0]) and math.isinf(own[0]) and not moves):
            continue
        interval = _range(spans, digits, unit)
        if len(records) > 1 and sure.any():
            interval = f"± {0.5 * float(np.median((high - low)[sure])):.{digits}f}{unit}"
        count, found = int(sure.sum()), estimate.found_count
        determined = f"{count} of {found} frames" if len(records) > 1 else "yes" if count else "no"
        told = determined if count == found else bad(determined)
        row = [name, _range(ends, digits, unit)]
        row += ["not computed"] * 2 if math.isnan(spans[0]) else [interval, told]
        colour = BLUE if count == found else GREY
        row.append(bar(own, [(colour, *spans), ("estimate", *ends)], unit))
        if errors_of:
            off = errors_of.get(name, {})
            row += [_range(_ends(measured[:, k]), digits, unit)]
            sizes = (f"{scale[k] * x:.{digits}f}" for x in off.values())
            row.append(f"{', max. '.join(sizes)}{unit}" if off else "not measured")
        rows.append(row)
        if moves:
            bands = [
                (place, np.where(of, low, np.nan), np.where(of, high, np.nan))
                for place, of in ((BLUE, sure), (GREY, ~sure))
            ]
            curves = [("measured", measured[:, k]), ("estimate", q[:, k])]
            told = f"{name} by frame: {row[1]}"
            drawn = plot(
                curves, list(estimate.records), told, bands=bands, limits=own, joined=joined
            )
            plots.append((drawn, row[1], name))
    head = ["joint", "estimate", "95 % interval", "determined", "between its limits"]
    return Table(head + ["measured", "mean error"] * bool(errors_of), rows), plots


def _range(ends: tuple[float, float], digits: int, unit: str) -> str:
    """Return ``low to high`` with this number of digits after the point, and the unit.

    ``ends`` is low and high: an infinite one becomes ``none``, equal ones a single number, nan "not
    known".
    """
    low, high = ("none" if math.isinf(one) else f"{one:z.{digits}f}" for one in ends)
    if math.isnan(ends[0]):
        return "not known"
    return (low if low == high else f"{low} to {high}") + unit


def _ends(*values: Array) -> tuple[float, float]:
    """Return the smallest and the largest finite value of all arrays (n,); nan if there is none."""
    known = np.concatenate(values)
    known = known[np.isfinite(known)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


def _cameras(scene: Scene, records: Sequence[FrameRecord]) -> Table:
    """Return the table of cameras: number of pictures, and of those that were used, and IoU.

    A mask is used if it was compared with the body, a picture without mask if a pose was found.
    """
    rows = []
    for name in scene.cameras:
        ious = {one.frame: one.ious[name] for one in records if name in one.ious}
        masked = [one for one in records if (name, one.frame) in scene.masks]
        seen = [one for one in records if (name, one.frame) in scene.images]
        pictured = [one for one in seen if (name, one.frame) not in scene.masks]
        used = len(ious) + sum(one.found for one in pictured)
        worst = min(ious, key=lambda frame: ious[frame], default="")
        mean = float(np.mean(list(ious.values()))) if ious else None
        lowest = f"{share(ious[worst], '')} in frame {worst}" if ious else "no mask compared"
        counts = str(len(masked) + len(pictured)), str(used)
        rows.append([name, *counts, share(mean, "no mask compared"), lowest])
    return Table(["camera", "pictures", "used", "mean IoU", "lowest IoU"], rows)
