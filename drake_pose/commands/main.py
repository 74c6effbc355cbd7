"""The command line `drake-pose`. Heavy modules are imported inside the commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_pose.commands import help_texts
from drake_pose.commands.audit import audit
from drake_pose.commands.batch import batch
from drake_pose.commands.capture import capture
from drake_pose.commands.estimate import run_estimate
from drake_pose.commands.estimate_options import (
    AnglesOption,
    CameraOption,
    CandidatesOption,
    FrameOption,
    HoldOption,
    IntervalOption,
    JointIntervalOption,
    JsonOption,
    LengthIntervalOption,
    MethodOption,
    ModelOption,
    OutOption,
    OutsideLimitOption,
    OverlayOption,
    PackageOption,
    ReplayOption,
    ResumeOption,
    RootOption,
    RootPositionOption,
    RootRotationOption,
    RunLimitOption,
    SceneArgument,
    StartOption,
    TimeLimitOption,
    TrackOption,
    TruthOption,
    UnseenOption,
)
from drake_pose.commands.live import empty_room
from drake_pose.commands.masks import masks
from drake_pose.commands.papers.date import date
from drake_pose.commands.papers.kameda import kameda
from drake_pose.commands.papers.reproduce_all import reproduce_all
from drake_pose.commands.papers.shimada import shimada
from drake_pose.commands.register import register
from drake_pose.commands.terminal import (
    FAILED,
    errors_as_messages,
    print_json,
    say,
    usage_errors,
    warn,
)
from drake_pose.commands.walk import walk
from drake_pose.errors import ModelError
from drake_pose.results.options import (
    parse_assignments,
    parse_packages,
    parse_root_position,
    parse_root_rotation,
)
from drake_pose.results.settings import EstimateSettings
from drake_pose.version import VERSION

app = typer.Typer(
    name="drake-pose",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help=help_texts.PROGRAM,
)
reproduce_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="rich", help=help_texts.REPRODUCE
)
app.add_typer(reproduce_app, name="reproduce")


def main() -> None:
    """Run the command line."""
    app()


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"drake-pose {VERSION}")
        raise typer.Exit()


@app.callback()
def prepare(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options of the program itself."""


@app.command(help=help_texts.ESTIMATE)
def estimate(
    scene: SceneArgument,
    model: ModelOption,
    out: OutOption,
    package: PackageOption = None,
    camera: CameraOption = None,
    frame: FrameOption = None,
    hold: HoldOption = None,
    unseen: UnseenOption = None,
    truth: TruthOption = None,
    root: RootOption = None,
    root_position: RootPositionOption = None,
    root_rotation: RootRotationOption = None,
    interval: IntervalOption = 10.0,
    length_interval: LengthIntervalOption = 0.05,
    joint_interval: JointIntervalOption = None,
    outside_limit: OutsideLimitOption = None,
    candidates: CandidatesOption = 5,
    run_limit: RunLimitOption = 10_000,
    time_limit: TimeLimitOption = None,
    method: MethodOption = "auto",
    angles: AnglesOption = "continuous",
    track: TrackOption = True,
    start: StartOption = None,
    resume: ResumeOption = False,
    overlay: OverlayOption = True,
    replay: ReplayOption = True,
    json: JsonOption = False,
) -> None:
    """See help_texts.ESTIMATE."""
    with usage_errors():
        settings = EstimateSettings(
            cameras=tuple(camera or ()),
            frames=tuple(frame or ()),
            root=root,
            root_position=None if root_position is None else parse_root_position(root_position),
            root_rotation=None if root_rotation is None else parse_root_rotation(root_rotation),
            interval=interval,
            length_interval=length_interval,
            joint_intervals=parse_assignments(joint_interval or (), "--joint-interval"),
            outside_limit=outside_limit,
            candidates=candidates,
            run_limit=run_limit,
            time_limit=time_limit,
            hold=parse_assignments(hold or (), "--hold"),
            unseen=tuple(unseen or ()),
            method=method,
            angles=angles,
            track=track,
            start=start,
            packages=parse_packages(package or ()),
        )
    run_estimate(
        scene, model, out, settings, truth=truth, resume=resume, overlay=overlay, replay=replay,
        json=json,
    )  # fmt: skip


@app.command(help=help_texts.DEMO)
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the result.")] = Path(
        "results/demo"
    ),
    json: JsonOption = False,
) -> None:
    """See help_texts.DEMO."""
    with errors_as_messages():
        from drake_pose.commands.report import FrameProgress, print_demo
        from drake_pose.jobs.demo import run_demo
        from drake_pose.jobs.estimate.compile_ahead import compiling_ahead

        with compiling_ahead(), FrameProgress() as progress:
            result = run_demo(out, on_frame=progress)
        if json:
            print_json(result.summary)
        else:
            print_demo(result)
        if result.found_count == 0:
            raise typer.Exit(FAILED)


@app.command(help=help_texts.CHECK)
def check(
    file: Annotated[Path, typer.Argument(help="The model: URDF, SDFormat, MJCF or .dmd.yaml.")],
    package: PackageOption = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.CHECK."""
    with usage_errors():
        packages = parse_packages(package or ())
    with errors_as_messages():
        from drake_pose.body.report import describe_model
        from drake_pose.commands.report import output_console
        from drake_pose.jobs.check import report_as_json, report_as_table

        report = describe_model(file, package_paths=packages)
        if json:
            print_json(report_as_json(report))
        elif report.usable:
            output_console().print(report_as_table(report))
        for text in report.warnings:
            warn(text)
        if report.errors:
            raise ModelError("; ".join(report.errors))
        say("drake-pose: fit for use")


@app.command(help=help_texts.CALIBRATE)
def calibrate(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder with images/<camera>/<frame>.png; the same frame is the same instant."
        ),
    ],
    board: Annotated[Path, typer.Option(help="The board's YAML file.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Camera file to write; the lens file is written beside it."
        ),
    ],
    world: Annotated[
        str,
        typer.Option(help="World frame: board:FRAME or camera:NAME. Default: the first camera."),
    ] = "",
    lens: Annotated[
        str, typer.Option(help="Distortion: none, standard (k1, k2, p1, p2) or full (also k3).")
    ] = "standard",
    leave_out: Annotated[
        list[str] | None,
        typer.Option(help="Leave out a camera, or a picture CAMERA/FRAME; repeat for several."),
    ] = None,
    drop_spoilt: Annotated[
        bool, typer.Option("--drop-spoilt", help="Leave out pictures that spoil the calibration.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """See help_texts.CALIBRATE."""
    with errors_as_messages():
        from drake_pose.camera.calibration.calibrate import CalibrationSettings
        from drake_pose.commands.report import output_console
        from drake_pose.jobs.calibrate import calibrate_folder

        settings = CalibrationSettings(
            world=world, lens=lens, drop_spoilt=drop_spoilt, leave_out=tuple(leave_out or ())
        )
        report = calibrate_folder(folder, board, out, settings)
        if json:
            print_json(report.as_json())
        else:
            output_console().print(report.table())
        for text in report.warnings:
            warn(text)
        say(f"drake-pose: wrote {', '.join(str(path) for path in report.files)}")


@app.command(help=help_texts.UNDISTORT)
def undistort(
    folder: Annotated[
        Path, typer.Argument(help="Folder with images/<camera>/<frame>.png or .jpg.")
    ],
    lenses: Annotated[Path, typer.Option(help="The lens file that calibrate wrote.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")],
) -> None:
    """See help_texts.UNDISTORT."""
    with errors_as_messages():
        from drake_pose.camera.calibration.lens import load_lenses
        from drake_pose.jobs.calibrate import undistort_pictures

        written = undistort_pictures(folder, load_lenses(lenses), out)
        say(f"drake-pose: {len(written)} pictures written to {out}")


app.command(name="audit", help=help_texts.AUDIT)(audit)
app.command(name="batch", help=help_texts.BATCH)(batch)
app.command(name="capture", help=help_texts.CAPTURE)(capture)
app.command(name="empty-room", help=help_texts.EMPTY_ROOM)(empty_room)
app.command(name="masks", help=help_texts.MASKS)(masks)
app.command(name="register", help=help_texts.REGISTER)(register)
app.command(name="walk", help=help_texts.WALK)(walk)
reproduce_app.command(name="kameda", help=help_texts.KAMEDA)(kameda)
reproduce_app.command(name="shimada", help=help_texts.SHIMADA)(shimada)
reproduce_app.command(name="date", help=help_texts.DATE)(date)
reproduce_app.command(name="all", help=help_texts.REPRODUCE_ALL)(reproduce_all)


if __name__ == "__main__":
    main()
