"""The pages report.html of a registration and of an audit."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.errors import listed
from drake_pose.files.folder import AS_GIVEN, OVERLAY
from drake_pose.files.page import (
    BLUE,
    NORMAL,
    Band,
    Figure,
    Page,
    Table,
    bad,
    p_value,
    page_words,
    picture_files,
    plot,
    scene_title,
    share,
)
from drake_pose.jobs.registration.words import describe_reading
from drake_pose.registration.register import evenly_spaced
from drake_pose.silhouette.pictures.scene_checks import frame_ranges

DEVIATIONS = ("standard deviation", "of the rotation")
"""Headings of `_deviations`."""


def registration_page(folder: Path, summary: Mapping[str, Any]) -> Page:
    """Return the page of a registration.

    ``folder``: the result folder, with its pictures. ``summary``: content of summary.json.
    """
    cameras = summary["cameras"]
    # The robot's parameters are the same in the parts of all cameras.
    first = next(iter(cameras.values()))
    pairs, frames = list[Figure](), list[Table]()
    pictures: dict[str, list[Figure]] = {"points": [], "contours": [], "silhouettes": []}
    for name, one in cameras.items():
        # From the worst frame to the best; without a silhouette by the points that do not fit.
        fits = one["frames"]
        errors = {
            frame: 1.0 - fit["inlier_ratio"] if fit["E_total"] is None else fit["E_total"]
            for frame, fit in fits.items()
        }
        in_order = sorted(errors, key=lambda frame: -errors[frame])
        kinds = (OVERLAY, in_order), (AS_GIVEN, compared_frames(errors))
        own, given = (
            {
                f"{kind}/{name}/{f}.png": f"{name}, frame {f}, error {share(errors[f], '')}"
                for f in of
            }
            for kind, of in kinds
        )
        drawn = evenly_spaced([place for place in own if (folder / place).is_file()], 6)
        section = {"none": "points", "found": "contours"}.get(one["masks"], "silhouettes")
        pictures[section] += picture_files(folder, {place: own[place] for place in drawn})
        pairs += picture_files(folder, given)
        frames.append(Table(
            ["frame", "E_total", "IoU", "inlier ratio", "result"],
            [[frame, share(fit["E_total"], "no mask"), share(fit["iou"], "no mask"),
              share(fit["inlier_ratio"], "unknown"), "agrees" if fit["agrees"] else bad("outlier")]
             for frame, fit in fits.items()],
            f"{name}: {len(fits)} frames",
        ))  # fmt: skip
    clocks = [_clock(name, one) for name, one in cameras.items() if "time_offset_scores" in one]
    return Page(
        scene_title(summary),
        f"Camera poses of {scene_title(summary)}, model {Path(str(summary['model'])).name}, from "
        f"{'masks' if first['masks'] == 'given' else 'pictures'} and joint positions",
        registration_answer(cameras, summary.get("refused", ())),
        summary,
        {
            "as_given": [pairs],
            **{section: [own] for section, own in pictures.items()},
            "registered": [camera_table(cameras)],
            "parameters": robot_tables(cameras),
            "clocks": [clocks],
            "fits": frames,
        },
    )


def registration_answer(cameras: Mapping[str, Mapping[str, Any]], refused: Collection[str]) -> str:
    """Return the result in a few sentences.

    Args:
        cameras: the parts of summary.json by camera.
        refused: names of cameras without an accepted pose.
    """
    parts = list(cameras.values())
    shift, turn = (
        max(part[key] for part in parts) for key in ("translation_sd_mm", "rotation_sd_deg")
    )
    outliers, count = (sum(len(part[key]) for part in parts) for key in ("outliers", "frames"))
    words = f"Camera{'s' * (len(parts) > 1)} {listed([*cameras])} found, good to"
    texts = [f"{words} {shift:.1f} mm and {turn:.2f} deg (one standard deviation)."]
    if refused:
        texts.append(f"{len(refused)} refused, see the warnings: {listed([*refused])}.")
    if outliers:
        texts.append(f"{outliers} of {count} frames {'are' if outliers > 1 else 'is'} left out as "
                     f"outlier{'s' * (outliers > 1)}.")  # fmt: skip
    else:
        texts.append(f"All {count} frames agree.")
    if ambiguous := [name for name, camera in cameras.items() if len(camera["modes"]) > 1]:
        texts.append(f"Other poses fit equally well: {listed(ambiguous)}.")
    for key, name in (("zeros", "joint offsets"), ("lengths", "link scales")):
        if found := parts[0][key]:
            significant = sum(one["significant"] for one in found.values())
            texts.append(f"{significant} of {len(found)} {name} are significant.")
    return " ".join(texts)


def camera_table(cameras: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the table of registered cameras, given their parts of summary.json."""
    rows = []
    for name, one in cameras.items():
        modes, outliers = len(one["modes"]), f"{len(one['outliers'])} of {len(one['frames'])}"
        rows.append([
            name, f"link {one['link']}" if "link" in one else "the robot's world",
            _position(one["X_LC"] if "link" in one else one["X_WC"]),
            *_deviations(one),
            bad(str(modes)) if modes > 1 else "1", bad(outliers) if one["outliers"] else outliers,
            share(one["mean_iou"], "no masks"), f"{one['seconds']:.1f} s",
        ])  # fmt: skip
    return Table(
        ["camera", "in the frame of", "position", *DEVIATIONS, "poses", "outliers", "mean IoU",
         "time"], rows,
    )  # fmt: skip


def robot_tables(cameras: Mapping[str, Mapping[str, Any]]) -> list[Table]:
    """Return tables of the target, joint offsets and link scales, as far as they were estimated.

    They are the same in the parts of all cameras (of summary.json).
    """
    first = next(iter(cameras.values()))
    tables = [
        Table([of, what, "95 % interval", "significance"], parameter_rows(first[key]), title)
        for key, title, of, what in (
            ("zeros", "Joint offsets, to be added to positions", "joint", "offset"),
            ("lengths", "Link scales, relative changes of length", "link", "change"),
        )
        if first[key]
    ]
    if one := first.get("target"):
        row = [_position(one["X_WT"]), *_deviations(one), str(len(one["modes"]))]
        head = ["position", *DEVIATIONS, "poses that look the same"]
        tables.insert(0, Table(head, [row], "Target in the robot's world"))
    return tables


def _deviations(one: Mapping[str, Any]) -> tuple[str, str]:
    """Return the standard deviations of a pose's entry of summary.json as text."""
    return f"{one['translation_sd_mm']:.1f} mm", f"{one['rotation_sd_deg']:.2f} deg"


def _position(X: Sequence[Sequence[float]]) -> str:
    """Return the position of a pose X (4, 4) [m] as text in mm."""
    return ", ".join(f"{1e3 * row[3]:.1f}" for row in X[:3]) + " mm"


def _clock(name: str, one: Mapping[str, Any]) -> Figure:
    """Return the scanned time offsets of a camera, and in words its clock, lens and evidence."""
    bands, tried = list[Band](), np.array(one["time_offset_scores"] or np.zeros((0, 2)))
    if one["time_offset_s"] is not None:
        half = NORMAL * one["time_offset_sd_s"]
        inside = np.abs(tried[:, 0] - one["time_offset_s"]) <= half
        low, high = (np.where(inside, 100.0 * f(tried[:, 1]), np.nan) for f in (np.min, np.max))
        bands = [(BLUE, low, high)]
    labels = [f"{1e3 * offset:.0f} ms" for offset in tried[:, 0]]
    drawn = plot([("estimate", 100.0 * tried[:, 1])], labels, f"{name}: score [%]", bands=bands)
    return drawn, clock_text(one), name


def clock_text(one: Mapping[str, Any]) -> str:
    """Return in words the clock, lens and evidence of a camera's part of summary.json."""
    texts = ["The time offset is not determined."]
    if one["time_offset_s"] is not None:
        value, half = 1e3 * one["time_offset_s"], 1e3 * NORMAL * one["time_offset_sd_s"]
        word = "later" if value > 0.0 else "earlier"
        texts = [
            f"Offset {_interval(value, half, 'ms')}: its pictures show the joints "
            f"{abs(value):.0f} ms {word} than their time stamps say."
        ]
    focal = f"{one['focal_px']:.1f} pixels, as given"
    if one["focal_sd_px"] is not None:
        focal = _interval(one["focal_px"], NORMAL * one["focal_sd_px"], "pixels")
    texts.append(f"Focal length {focal}.")
    explained = share(one["explained"], "an unknown part")
    if "points" in one:
        texts.append(
            f"{share(one['sightings_that_fit'], 'none')} of {one['sightings']} sightings of "
            f"{one['points']} points of the scene fit; its pose explains {explained} of the "
            f"matches, and chance {share(one['explained_by_chance'], 'an unknown part')}."
        )
    else:
        texts.append(
            f"Its pose explains {explained} of the changes in its pictures (p-value "
            f"{p_value(one['p_value'])})."
        )
    if other := one.get("runner_up"):
        texts.append(
            f"The best other pose that was found is {other['distance_mm']:.0f} mm and "
            f"{other['rotation_deg']:.0f} degrees away; less of the contours fits there, by "
            f"{other['margin_sd']:.1f} standard deviations of the mean over frames."
        )
    return " ".join(texts)


def _interval(value: float, half: float, unit: str) -> str:
    """Return a value with its interval of a half-width, all in a unit."""
    return f"{value:.1f} {unit} ({value - half:.1f} to {value + half:.1f})"


def parameter_rows(parameters: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return rows of the report's table of joint offsets or link scales.

    parameters: entries by joint or link, see `describe_parameters`.

    A row has the name, the value with its unit, the 95 % interval, and its significance in words.
    """
    rows: list[tuple[str, ...]] = []
    for name, entry in parameters.items():
        if not entry["determined"]:
            gauge = f"correlated with {', '.join(entry['gauge'])}" if entry["gauge"] else "unseen"
            rows.append((name, "not determined", "any", gauge))
            continue
        key = next(key for key in entry if key.startswith("value_"))
        unit = key.removeprefix("value_")
        shown = "%" if unit == "percent" else unit
        interval = f"{entry[f'low_{unit}']:.2f} to {entry[f'high_{unit}']:.2f} {shown}"
        within = entry[f"low_{unit}"] <= 0.0 <= entry[f"high_{unit}"]
        word = "0 is in its interval" if within else "not significant at 5 % over all parameters"
        word = "significant" if entry["significant"] else f"{word}: not written into the URDF"
        if entry["significant"] and unit != "percent":
            word += f": {describe_reading(entry[key], entry[f'sd_{unit}'], unit)}"
        rows.append((name, f"{entry[key]:.2f} {shown}", interval, word))
    return rows


def compared_frames(errors: Mapping[str, float]) -> Sequence[str]:
    """Return the frames that are drawn to compare camera poses: the worst, and the median one.

    errors: E_total by frame; at least one.
    """
    in_order = sorted(errors, key=lambda frame: -errors[frame])
    return tuple(dict.fromkeys([in_order[0], in_order[len(in_order) // 2]]))


def audit_page(folder: Path, summary: Mapping[str, Any], kinds: Mapping[str, str]) -> Page:
    """Return the page of an audit.

    Args:
        folder: the result folder, with its pictures.
        summary: content of summary.json.
        kinds: kind of each position by name: "angle", "length" or "quaternion".
    """
    findings, frames = summary["findings"], summary["frames"]
    names = list(dict.fromkeys(name for one in frames.values() for name in one["fits"]))
    riding = [name for name, one in summary["found_cameras"].items() if "link" in one]
    wrong_first = sorted(frames, key=lambda frame: frames[frame]["agrees"])
    pictures: dict[str, list[Figure]] = {AS_GIVEN: [], OVERLAY: [], "points": []}
    for kind, name in product((AS_GIVEN, OVERLAY), names):
        places = {f"{kind}/{name}/{frame}.png": f"{name}, frame {frame}" for frame in wrong_first}
        section = "points" if kind == OVERLAY and name in riding else kind
        pictures[section] += picture_files(folder, places)
    offsets = summary["minimum_detectable"]
    joints = []
    for name in kinds:
        off = _errors_of(("joint", "sign", "log", "link"), name, findings)
        offset = offsets.get(name)
        least = "an error was found" if off else "not known"
        if not off and name in offsets:
            least = detectable_offset(offset, kinds[name]) if offset else "none: hardly visible"
        joints.append([name, off or "no error found", least])
    cameras = []
    for name in names:
        own = [one for one in frames.values() if name in one["fits"]]
        given, freed = (
            [one[key][name] for one in own if name in one[key]]
            for key in ("fits", "fits_when_freed")
        )
        cameras.append([
            name, str(len(own)), share(float(np.mean(given)), ""),
            share(float(np.mean(freed)) if freed else None, "not refined"),
            _errors_of(("camera", "clock", "rate", "moved"), name, findings) or "no error found",
        ])  # fmt: skip
    errors = [
        Table(["kind", "name", "correction", "shift", "p-value", "error"],
              [[one["what"], one["name"], correction(one), f"{one['pixels']:.1f} pixels",
                p_value(one["p_value"]), one["text"]] for one in findings])
    ] * bool(findings)  # fmt: skip
    causes = dict.fromkeys(
        ("frame", "") if one["what"] == "frame" else (one["cause"], one["cause_name"])
        for one in findings
    )
    advice = page_words()["advice"]
    return Page(
        scene_title(summary),
        f"Audit of {scene_title(summary)}, model {Path(str(summary['model'])).name}: "
        f"{summary['agreeing_count']} of {summary['frame_count']} frames are consistent",
        audit_answer(summary, kinds),
        summary,
        {
            "errors": errors,
            "as_given": [pictures[AS_GIVEN]],
            "outliers": [pictures[OVERLAY]],
            "points": [pictures["points"]],
            "audited_joints": [Table(
                ["joint", "correction, 95 % interval", "minimum detectable offset"], joints
            )],
            "audited_cameras": [Table(
                ["camera", "frames", "inlier ratio as given", "refined",
                 "correction, 95 % interval"], cameras,
            )],
            "shifts": [Table(
                ["frame", "shift", *(f"inlier ratio, {k}" for k in names), "result"],
                [[frame, f"{one['pixels']:.1f} pixels",
                  *(share(one["fits"].get(name), "no mask") for name in names),
                  "agrees" if one["agrees"] else bad("outlier")] for frame, one in frames.items()],
                f"{len(frames)} frames",
            )],
        },
        [advice[cause].format(name) for cause, name in causes if cause in advice],
    )  # fmt: skip


def audit_answer(summary: Mapping[str, Any], kinds: Mapping[str, str]) -> str:
    """Return the result in a few sentences.

    Args:
        summary: content of summary.json.
        kinds: kind of each position by name: "angle", "length" or "quaternion".
    """
    findings = summary["findings"]
    common = [finding for finding in findings if finding["what"] != "frame"]
    outliers = [finding["name"] for finding in findings if finding["what"] == "frame"]
    texts = []
    if len(common) == 1:
        texts.append(f"Error found: {common[0]['text']}.")
    elif common:
        named = listed([f"{finding['what']} '{finding['name']}'" for finding in common])
        texts.append(f"{len(common)} errors found: {named}.")
    if outliers:
        count, named = summary["frame_count"], frame_ranges(outliers, list(summary["frames"]))
        one_or_more = "is an outlier" if len(outliers) == 1 else "are outliers"
        texts.append(f"{len(outliers)} of {count} frames {one_or_more}: {named}.")
    if texts:
        return " ".join(texts)
    offsets, detectable = summary["minimum_detectable"], list[str]()
    for kind in ("angle", "length"):
        known = [x for name, x in offsets.items() if x is not None and kinds[name] == kind]
        detectable += [detectable_offset(max(known), kind)] if known else []
    if not detectable:
        return "No error found, but no joint offset could have been detected."
    hidden = [name for name, offset in offsets.items() if offset is None]
    but = f", except those of {listed(hidden)}" if hidden else ""
    return (
        f"No error found: joint offsets above {' or '.join(detectable)} would have been detected"
        f"{but}."
    )


def detectable_offset(offset: float, kind: str) -> str:
    """Return a joint offset, in deg or m as in summary.json, as text in deg or mm to two digits.

    kind: "angle" or "length".
    """
    return f"{offset:.2g} deg" if kind == "angle" else f"{1e3 * offset:.2g} mm"


def correction(finding: Mapping[str, Any]) -> str:
    """Return the angle and the shift of an entry of ``findings`` with their 95 % intervals.

    Those without a standard deviation are left out; "no single value" if none is left.
    """
    parts = []
    for key in (key for key in finding if key.startswith(("angle_deg", "shift_"))):
        # The standard deviation of "shift_mm" is "shift_sd_mm".
        name, _, unit = key.rpartition("_")
        deviation = finding.get(f"{name}_sd_{unit}")
        if deviation and np.isfinite(deviation):
            value, unit, half = finding[key], unit.replace("percent", "%"), NORMAL * deviation
            parts.append(f"{value:+z.2f} {unit} ({value - half:+z.2f} to {value + half:+z.2f})")
    return ", ".join(parts) or "no single value"


def _errors_of(kinds: Collection[str], name: str, findings: Iterable[Mapping[str, Any]]) -> str:
    """Return the corrections, common to all frames, of a joint or camera; "": there are none.

    kinds: kinds of errors, see ``Finding``. findings: of summary.json.
    """
    own = [
        correction(one)
        for one in findings
        if one["what"] != "frame" and one["cause"] in kinds and one["cause_name"] == name
    ]
    return bad(", ".join(own)) if own else ""
