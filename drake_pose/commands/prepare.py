"""The commands `drake-pose check` and `masks`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.markup import escape
from rich.table import Table

from drake_pose.commands.common import (
    SPREAD,
    Json,
    count_progress,
    output_console,
    print_files,
    print_json,
    print_result,
    say,
    warn,
)
from drake_pose.errors import ModelError
from drake_pose.files.settings import MaskSettings, Packages

if TYPE_CHECKING:
    from drake_pose.jobs.masks import SceneMasks


def check(file: Path, /, *, package: Packages | None = None, json: Json = False) -> None:
    """Check whether a model can be used for pose estimation, and if not, why.

    A usable model has visual geometry, and limits on every prismatic joint that is searched. The
    table shows the pose tree in the order of the search: each link, its parent, the joints between
    them in the order of rotation with their limits, and the number of triangles. Exit status 1: the
    model cannot be used.

    Collision geometry, transmissions and plugins are not read. A joint that mimics another one
    shares its unknown. Loops and gearboxes are named in a warning and not enforced. Expand xacro
    macros first.

        drake-pose check urdf/woman/woman.urdf
        drake-pose check arm.urdf --package arm_description=ros/arm_description

    Args:
        file: The model: URDF, SDFormat, MJCF or .dmd.yaml.
    """
    from drake_pose.body import describe_model

    report = describe_model(file, package_paths=package or {})
    if json:
        print_json({**asdict(report), "path": str(report.path), "usable": report.usable})
    elif report.usable:
        table = Table(
            "segment", "hangs on", "joints in the order of rotation", "triangles", "closed",
            title=escape(f"{report.name}: {len(report.nodes)} segments"),
        )  # fmt: skip
        units = {"angle": " deg", "length": " m"}
        for node in report.nodes:
            joints = [
                "{name}  {lower:g} .. {upper:g}".format(**joint)
                + units.get(joint["kind"], "")
                + (f"  (= {joint['follows']})" if joint["follows"] else "")
                for joint in node["joints"]
            ]
            texts = node["name"], node["parent"], "\n".join(joints) or "fixed"
            closed = "yes" if node["watertight"] else "no"
            table.add_row(*map(escape, texts), str(node["triangles"]), closed)
        output_console().print(table)
    for text in report.warnings:
        warn(text)
    if report.errors:
        raise ModelError("; ".join(report.errors))
    say("drake-pose: the model is fit for use")


def masks(
    source: Path,
    /,
    *,
    out: Annotated[Path, Parameter(alias="-o", metavar="SCENE")],
    settings: Annotated[MaskSettings | None, SPREAD] = None,
    overlay: Annotated[bool, Parameter(negative="--no-overlay")] = True,
    json: Json = False,
) -> None:
    """Make a scene of masks, from masks of other tools or from pictures.

    Masks of other tools are COCO files, black and white pictures, or black and white videos. In
    pictures and videos the object is what differs from a picture of the empty room (--background).
    --background median takes each pixel's median over the recording, which works only if the body
    does not stay in one place; the command warns if it does.

    Files in SCENE: masks/; cameras.yaml; scene.yaml; overlay/ (the pictures with the masks'
    contours: look at them); summary.json (area and warnings of each mask, and why it was rejected).

        drake-pose masks RECORDING --background median --out scene

    Args:
        source: Folder with images/<camera>/<frame>.png or .jpg, with videos/<camera>.mp4, or with
            pictures of a single camera; a picture; a video; a COCO file (.json); an episode of a
            LeRobot data set or DROID; or a ROS bag.
        out: Folder for the scene. It must be new or empty.
        overlay: Write the pictures with the masks' contours, overlay/<camera>/<frame>.jpg.
    """
    from drake_pose.jobs.masks import make_masks

    with count_progress("masks", None) as advance:
        result = make_masks(source, out, settings, overlay=overlay, on_mask=advance)
    print_result(result, json, _print_masks)


def _print_masks(result: SceneMasks) -> None:
    """Print the number and sizes of each camera's masks, and the scene's folder."""
    console = output_console()
    for name, frames in result.summary["cameras"].items():
        good = [one["area"] for one in frames.values() if "area" in one]
        text = f"{len(good)} masks of {len(frames)} pictures"
        text += f", {min(good)} to {max(good)} pixels" if good else ""
        console.print(f"{escape(name or 'camera'):<14} {text}")
    print_files(("scene", result.folder))
