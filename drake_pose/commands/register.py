"""The command `drake-pose register`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drake_pose.commands.estimate_options import (
    FrameOption,
    HoldOption,
    JsonOption,
    ModelOption,
    OutOption,
    OverlayOption,
    PackageOption,
)
from drake_pose.commands.terminal import (
    errors_as_messages,
    print_result,
    usage_errors,
)
from drake_pose.results.options import parse_assignments, parse_box, parse_packages

if TYPE_CHECKING:
    from drake_pose.jobs.registration.register import SceneRegistration

RegisteredSceneArgument = Annotated[
    Path,
    typer.Argument(
        help="Folder with cameras.yaml, in which X_WC may be missing, and "
        "masks/<camera>/<frame>.png."
    ),
]
_OF_FRAMES = (
    r"Joint positions of every frame \[rad or m]: a CSV file with the column frame and one for "
    "each joint."
)
JointsOption = Annotated[Path, typer.Option("--joints", "-j", metavar="FILE", help=_OF_FRAMES)]
MeasuredJointsOption = Annotated[
    Path | None,
    typer.Option(
        "--joints",
        "-j",
        metavar="FILE",
        help=f"{_OF_FRAMES} Default: they are estimated from the cameras that have an X_WC.",
    ),
]
SearchedCameraOption = Annotated[
    list[str] | None,
    typer.Option(
        "--camera",
        metavar="NAME",
        help="Find this camera, and do not use its X_WC if it has one; repeat for several. "
        "Default: all without X_WC.",
        rich_help_panel="Input",
    ),
]
ZerosOption = Annotated[
    list[str] | None,
    typer.Option(
        "--zeros",
        metavar="NAME",
        help="Find the zero of this joint, too, a constant that is added to its positions in all "
        "frames; all: of every joint; repeat for several. A URDF with the zeros is written.",
        rich_help_panel="Estimation",
    ),
]
LengthsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--lengths",
        metavar="LINK",
        help="Find how long this link is, too: a factor, the same in all frames, of the distances "
        "of the joints that it carries from its own; all: of every link; repeat for several. A "
        "URDF with the lengths is written.",
        rich_help_panel="Estimation",
    ),
]
FocalOption = Annotated[
    bool,
    typer.Option(
        "--focal",
        help="Find the cameras' focal lengths, too.",
        rich_help_panel="Estimation",
    ),
]
OnOption = Annotated[
    str | None,
    typer.Option(
        "--on",
        metavar="LINK",
        help="The cameras to be found ride on this link (eye in hand): their pose X_LC in its "
        "frame is found, from masks of the robot's base, which is what no joint moves, or of a "
        "--target.",
        rich_help_panel="Input",
    ),
]
TargetOption = Annotated[
    Path | None,
    typer.Option(
        "--target",
        metavar="FILE",
        help="With --on: the masks show another, rigid object (URDF, SDFormat, MJCF), which stands "
        "anywhere in the world; where is found, too.",
        rich_help_panel="Input",
    ),
]
SuggestOption = Annotated[
    bool,
    typer.Option(
        "--suggest",
        help="Where several poses of a camera fit equally well: joint positions inside the limits "
        "that would tell them apart.",
        rich_help_panel="Estimation",
    ),
]
KeepOutOption = Annotated[
    list[str] | None,
    typer.Option(
        "--keep-out",
        metavar="X,Y,Z:X,Y,Z",
        help=r"With --suggest: the corners of a box in the world that the robot must not touch "
        r"\[m]; repeat for several.",
        rich_help_panel="Estimation",
    ),
]


def register(
    scene: RegisteredSceneArgument,
    model: ModelOption,
    out: OutOption,
    joints: MeasuredJointsOption = None,
    package: PackageOption = None,
    camera: SearchedCameraOption = None,
    on: OnOption = None,
    target: TargetOption = None,
    frame: FrameOption = None,
    hold: HoldOption = None,
    zeros: ZerosOption = None,
    lengths: LengthsOption = None,
    focal: FocalOption = False,
    suggest: SuggestOption = False,
    keep_out: KeepOutOption = None,
    overlay: OverlayOption = True,
    json: JsonOption = False,
) -> None:
    """See help_texts.REGISTER."""
    with usage_errors():
        packages = parse_packages(package or ())
        held = parse_assignments(hold or (), "--hold")
        corners = [parse_box(text) for text in keep_out or ()]
    with errors_as_messages():
        from drake_pose.commands.report import count_progress
        from drake_pose.jobs.registration.inputs import RegistrationSettings
        from drake_pose.jobs.registration.register import register_scene
        from drake_pose.registration.suggestions import Box

        settings = RegistrationSettings(
            tuple(camera or ()),
            tuple(frame or ()),
            on,
            target,
            held,
            tuple(zeros or ()),
            tuple(lengths or ()),
            focal,
            suggest,
            tuple(Box(*ends) for ends in corners),
            packages,
        )
        with count_progress("cameras", None) as advance:
            result = register_scene(
                scene, model, joints, out, settings, overlay=overlay, on_camera=advance
            )
        print_result(result, json, _print)


def _print(result: SceneRegistration) -> None:
    """A row a frame and camera, then where each camera stands and how sure that is."""
    from rich.markup import escape
    from rich.table import Table

    from drake_pose.commands.report import output_console
    from drake_pose.jobs.registration.report import PARAMETERS, parameter_rows
    from drake_pose.jobs.registration.result import CAMERAS
    from drake_pose.results.folder import REPORT
    from drake_pose.results.texts import percent

    console = output_console()
    frames = Table("camera", "frame", "E_total", "IoU", "", title="Masks and robot")
    table = Table(
        "camera", "place [m]", "sd [mm]", "sd [deg]", "poses", "frames", "mean IoU", "seconds",
        title="Cameras in the robot's world",
    )  # fmt: skip
    for name, found in result.registered.items():
        one = result.summary["cameras"][name]
        for misfit in found.frames:
            word = "" if misfit.agrees else "contradicts the others"
            frames.add_row(
                escape(name), escape(misfit.frame), percent(misfit.E_total),
                percent(misfit.iou), word,
            )  # fmt: skip
        agreeing = len(found.frames) - len(found.contradictions)
        table.add_row(
            escape(name),
            ", ".join(f"{p:.4f}" for p in found.camera.X_WC[:3, 3]),
            f"{one['translation_sd_mm']:.2f}",
            f"{one['rotation_sd_deg']:.3f}",
            str(len(one["families"])),
            f"{agreeing} of {len(found.frames)}",
            percent(one["mean_iou"]),
            f"{one['seconds']:.1f}",
        )
    console.print(frames)
    console.print(table)
    first = next(iter(result.summary["cameras"].values()))
    for key, title, of, what in PARAMETERS:
        if first[key]:
            parameters = Table(of, what, "95 % interval", "", title=title)
            for row in parameter_rows(first[key]):
                parameters.add_row(*map(escape, row))
            console.print(parameters)
    if "target" in first:
        console.print(_say_target(first["target"]))
    for name, one in result.summary["cameras"].items():
        if one["suggestion"]:
            values = ", ".join(f"{k}={v:.3f}" for k, v in one["suggestion"]["positions"].items())
            console.print(
                escape(f"camera '{name}': a picture at {values} would tell its poses apart")
            )
    if result.folder is not None:
        for label, file in (("cameras", CAMERAS), ("report", REPORT)):
            console.print(f"{label:<14} {escape(str(result.folder / file))}", soft_wrap=True)


def _say_target(target: Mapping[str, Any]) -> str:
    """Where an object was found."""
    place = ", ".join(f"{row[3]:.4f}" for row in target["X_WT"][:3])
    return (
        f"target at {place} m in the robot's world, sd {target['translation_sd_mm']:.2f} mm, "
        f"{target['rotation_sd_deg']:.3f} deg; poses that look alike: {len(target['families'])}"
    )
