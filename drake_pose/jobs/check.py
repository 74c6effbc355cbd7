"""`drake-pose check`: is this model fit for use, and if not, why."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rich.markup import escape
from rich.table import Table

from drake_pose.body.report import JointReport, ModelReport
from drake_pose.results.folder import without_nan

_UNITS = {"angle": " deg", "length": " m"}


def report_as_json(report: ModelReport) -> dict[str, Any]:
    """Returns a report as plain JSON values; limits in degrees and metres."""
    values = {**asdict(report), "path": str(report.path), "usable": report.usable}
    plain: dict[str, Any] = without_nan(values)
    return plain


def report_as_table(report: ModelReport) -> Table:
    """Returns the segments of a model's pose tree."""
    table = Table(
        "segment",
        "hangs on",
        "joints in the order of rotation",
        "triangles",
        "closed",
        title=escape(f"{report.name}: {len(report.nodes)} segments"),
    )
    for node in report.nodes:
        table.add_row(
            escape(node.name),
            escape(node.parent),
            escape("\n".join(_joint_text(joint) for joint in node.joints) or "fixed"),
            str(node.triangles),
            "yes" if node.watertight else "no",
        )
    return table


def _joint_text(joint: JointReport) -> str:
    return f"{joint.name}  {joint.lower:g} .. {joint.upper:g}{_UNITS.get(joint.kind, '')}"
