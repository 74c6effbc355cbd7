"""The command line `drake-pose`. Heavy modules are imported inside the commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_pose import __version__
from drake_pose.apps import help_texts
from drake_pose.apps.estimate_options import (
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
    ReplayOption,
    ResumeOption,
    RootOption,
    RootPositionOption,
    RootRotationOption,
    RunLimitOption,
    SceneArgument,
    TimeLimitOption,
    TruthOption,
)
from drake_pose.apps.options import (
    parse_assignments,
    parse_root_position,
    parse_root_rotation,
)
from drake_pose.apps.settings import EstimateSettings
from drake_pose.apps.terminal import (
    FAILED,
    errors_as_messages,
    print_json,
    say,
    usage_errors,
    warn,
)
from drake_pose.errors import ModelError

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
        typer.echo(f"drake-pose {__version__}")
        raise typer.Exit()


@app.callback()
def prepare(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print it."),
    ] = False,
) -> None:
    """Options of the program itself."""


@app.command(help=help_texts.ESTIMATE)
def estimate(
    scene: SceneArgument,
    model: ModelOption,
    out: OutOption,
    camera: CameraOption = None,
    frame: FrameOption = None,
    hold: HoldOption = None,
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
    method: MethodOption = "paper",
    resume: ResumeOption = False,
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
            method=method,
        )
    interrupted = f"interrupted; the finished frames are in {out}; go on with --resume"
    with errors_as_messages(interrupted):
        from drake_pose.apps.estimate import estimate_scene
        from drake_pose.apps.report import FrameProgress, print_estimate

        with FrameProgress() as progress:
            result = estimate_scene(
                scene, model, out, settings, truth=truth, resume=resume, replay=replay,
                on_frame=progress,
            )  # fmt: skip
        if json:
            print_json(result.summary)
        else:
            print_estimate(result)
        if result.found_count == 0:
            say("drake-pose: error: no pose was found in any frame")
            raise typer.Exit(FAILED)


@app.command(help=help_texts.DEMO)
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the result.")] = Path(
        "results/demo"
    ),
    json: JsonOption = False,
) -> None:
    """See help_texts.DEMO."""
    with errors_as_messages():
        from drake_pose.apps.demo import run_demo
        from drake_pose.apps.report import FrameProgress, print_demo

        with FrameProgress() as progress:
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
    json: JsonOption = False,
) -> None:
    """See help_texts.CHECK."""
    with errors_as_messages():
        from drake_pose.apps.check import report_as_json, report_as_table
        from drake_pose.apps.report import output_console
        from drake_pose.body import describe_model

        report = describe_model(file)
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
        Path, typer.Argument(help="Holds images/<camera>/<frame>.png; same frame, same instant.")
    ],
    board: Annotated[Path, typer.Option(help="The board's YAML file.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The camera file to write; the lenses go beside it.")
    ],
    world: Annotated[
        str, typer.Option(help="board:FRAME or camera:NAME; the first camera if not given.")
    ] = "",
    lens: Annotated[
        str, typer.Option(help="none, standard (k1, k2, p1, p2) or full (k3 too).")
    ] = "standard",
    leave_out: Annotated[
        list[str] | None, typer.Option(help="A camera, or a picture as CAMERA/FRAME; repeatable.")
    ] = None,
    drop_spoilt: Annotated[
        bool, typer.Option("--drop-spoilt", help="Go on without pictures that spoil it.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """See help_texts.CALIBRATE."""
    with errors_as_messages():
        from drake_pose.apps.calibrate import calibrate_folder
        from drake_pose.apps.report import output_console
        from drake_pose.camera.calibration import CalibrationSettings

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
    folder: Annotated[Path, typer.Argument(help="Holds images/<camera>/<frame>.png or .jpg.")],
    lenses: Annotated[Path, typer.Option(help="The lens file that calibrate wrote.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")],
) -> None:
    """See help_texts.UNDISTORT."""
    with errors_as_messages():
        from drake_pose.apps.calibrate import undistort_pictures
        from drake_pose.camera.calibration_lens import load_lenses

        written = undistort_pictures(folder, load_lenses(lenses), out)
        say(f"drake-pose: {len(written)} pictures written to {out}")


@reproduce_app.command(help=help_texts.KAMEDA)
def kameda(
    images: Annotated[int, typer.Option(min=1, help="How many silhouettes are drawn.")] = 219,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws other poses.")] = 0,
    method: Annotated[str, typer.Option(help="How to search: paper or wide.")] = "paper",
    angles: Annotated[
        str, typer.Option(help="lattice: multiples of 20 degrees, as in the paper; continuous.")
    ] = "lattice",
    outside_limit: Annotated[
        float, typer.Option(min=0.0, help=r"r \[pixel]; the paper's is 200.", metavar="R")
    ] = 200.0,
    candidates: Annotated[
        int,
        typer.Option(
            min=1, help="How many candidates a node keeps; the paper's is 5.", metavar="K"
        ),
    ] = 5,
    interval: Annotated[
        float, typer.Option(min=1.0, max=90.0, help=r"Sampling interval \[deg]; the paper's is 20.")
    ] = 20.0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for pictures; none without it.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.KAMEDA."""
    with usage_errors():
        EstimateSettings(method=method)
    if angles not in ("lattice", "continuous"):
        raise typer.BadParameter("must be lattice or continuous", param_hint="--angles")
    with errors_as_messages():
        from drake_pose.apps.kameda import (
            PAPER_IMAGES,
            experiment_search,
            run_experiment,
            wide_experiment_search,
        )
        from drake_pose.apps.kameda_pictures import save_pictures
        from drake_pose.apps.kameda_table import experiment_table
        from drake_pose.apps.report import count_progress, output_console
        from drake_pose.apps.result_folder import require_empty

        if out is not None:
            require_empty(out)
        paper_images = images if method == "paper" else min(images, PAPER_IMAGES)
        with count_progress("silhouettes, the paper's method", paper_images) as advance:
            search = experiment_search(outside_limit, candidates, interval)
            results = [run_experiment(search, paper_images, seed, angles, advance)]
        if method == "wide":
            with count_progress("silhouettes, wide search", images) as advance:
                wide = wide_experiment_search(interval)
                results.append(run_experiment(wide, images, seed, angles, advance))
        if out is not None:
            save_pictures(results[-1], out)
        if json:
            beside = {"paper_method": results[0].as_json()} if method == "wide" else {}
            print_json({**results[-1].as_json(), **beside})
        else:
            output_console().print(experiment_table(results))


@reproduce_app.command(help=help_texts.SHIMADA)
def shimada(
    runs: Annotated[
        int, typer.Option(min=1, help="Sequences for each of r_13 = 35 and 40, other noise each.")
    ] = 50,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws other sequences.")] = 0,
    truncation: Annotated[
        str, typer.Option(help="sequential (the paper's), joint, clip or none.")
    ] = "joint",
    observed: Annotated[
        str, typer.Option(help="full: all points and lines; lines: knuckles hidden.")
    ] = "full",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for plots; none without it.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.SHIMADA."""
    with errors_as_messages():
        from drake_pose.apps.report import count_progress, output_console
        from drake_pose.apps.result_folder import require_empty
        from drake_pose.apps.shimada import CASES, run_experiment
        from drake_pose.apps.shimada_pictures import save_pictures

        if out is not None:
            require_empty(out)
        with count_progress("sequences", runs * len(CASES)) as advance:
            result = run_experiment(runs, seed, truncation, observed, advance)
        if out is not None:
            save_pictures(result, out)
        if json:
            print_json(result.as_json())
        else:
            output_console().print(result.table())


if __name__ == "__main__":
    main()
