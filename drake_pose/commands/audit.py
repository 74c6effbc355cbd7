"""The command `drake-pose audit`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_pose.commands.estimate_options import (
    CameraOption,
    FrameOption,
    HoldOption,
    JsonOption,
    ModelOption,
    OverlayOption,
    PackageOption,
)
from drake_pose.commands.register import JointsOption
from drake_pose.commands.terminal import (
    errors_as_messages,
    print_result,
    say,
    usage_errors,
)
from drake_pose.results.options import parse_assignments, parse_packages

if TYPE_CHECKING:
    from drake_pose.jobs.registration.audit import SceneAudit


def audit(
    scene: Annotated[
        Path, typer.Argument(help="Folder with cameras.yaml and masks/<camera>/<frame>.png.")
    ],
    model: ModelOption,
    joints: JointsOption,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Folder for the result; new or empty."),
    ] = None,
    package: PackageOption = None,
    camera: CameraOption = None,
    cameras: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Camera file in place of the scene's cameras.yaml.",
            rich_help_panel="Input",
        ),
    ] = None,
    frame: FrameOption = None,
    hold: HoldOption = None,
    overlay: OverlayOption = True,
    json: JsonOption = False,
) -> None:
    """See help_texts.AUDIT."""
    with usage_errors():
        packages = parse_packages(package or ())
        held = parse_assignments(hold or (), "--hold")
    with errors_as_messages():
        from drake_pose.commands.report import count_progress
        from drake_pose.jobs.registration.audit import audit_scene
        from drake_pose.jobs.registration.inputs import RegistrationSettings

        settings = RegistrationSettings(
            tuple(camera or ()), tuple(frame or ()), hold=held, packages=packages
        )
        with count_progress("frames", None) as advance:
            result = audit_scene(
                scene, model, joints, out, settings, cameras=cameras, overlay=overlay,
                on_frame=advance,
            )  # fmt: skip
        print_result(result, json, _print)


def _print(result: SceneAudit) -> None:
    """A row for each contradiction, then how many frames agree."""
    from rich.markup import escape
    from rich.table import Table

    from drake_pose.commands.report import output_console

    console = output_console()
    contradictions = result.summary["contradictions"]
    if contradictions:
        table = Table("contradicts the rest", title="Masks, cameras and joint positions")
        for one in contradictions:
            table.add_row(escape(one["text"]))
        console.print(table)
    count, agree = result.summary["frame_count"], result.summary["agreeing_count"]
    console.print(f"{agree} of {count} frames agree")
    if not contradictions:
        say("drake-pose: nothing contradicts the rest")
    if result.folder is not None:
        console.print(f"result         {escape(str(result.folder))}", soft_wrap=True)
