"""The commands `drake-pose estimate` and `drake-pose demo`, and what they print."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from drake_pose.commands.options import (
    SPREAD,
    Json,
    Model,
    Out,
    Overlay,
    Replay,
    Resume,
    Truth,
)
from drake_pose.commands.terminal import (
    FrameProgress,
    output_console,
    print_result,
    worst_frames,
)
from drake_pose.errors import SceneError
from drake_pose.files.options import percent
from drake_pose.files.settings import EstimateSettings

if TYPE_CHECKING:
    from drake_pose.files.records import SceneEstimate


def estimate(
    scene: Path,
    /,
    *,
    model: Model,
    out: Out,
    settings: Annotated[EstimateSettings | None, SPREAD] = None,
    truth: Truth = None,
    cameras: Path | None = None,
    resume: Resume = False,
    overlay: Overlay = True,
    replay: Replay = True,
    json: Json = False,
) -> None:
    r"""Estimate the joint angles in every frame of a scene.

    A beam search places the body link by link from the root outwards; the best poses are refined
    to continuous angles by fitting the body's contour to the silhouettes' edges. All cameras are
    used together. If scene.yaml has sequence: true, the pose is searched in the first frame and
    tracked from there on. A person before two or more calibrated cameras is followed by all
    silhouettes at once, lengths and girths too, where the model has a person's landmarks and no
    option of the search is given.

    Files in DIR: report.html, which shows all of it; poses.csv (a row a frame: every joint's
    position in rad or m, E_total, seconds); joints.csv (which joints the silhouettes determine,
    and their 95 % intervals); families.csv (poses that look the same); summary.json; overlay/;
    replay.html; of a sequence also a MOT file, and of a person or hand TRC and BVH files. E_total
    is the area where body and silhouettes differ, over the silhouettes' area. Ctrl-C keeps the
    finished frames.

    A robot arm whose base is at the world's origin, seen by two cameras:

        drake-pose estimate ../shared/data/arm_two_views --out results/arm \
          --model ../shared/data/arm_two_views/med7/med7.urdf

    Args:
        scene: Folder with cameras.yaml and masks/<camera>/<frame>.png; or with masks/<frame>.png
            alone, of a camera without calibration. A sequence may have
            images/<camera>/<frame>.png or .jpg, or videos/<camera>.mp4, and a mask of the first
            frame only. Or a robot's recorded episode: pictures or videos with a joint log, a
            LeRobot data set, DROID's raw folder or a bag; the body is followed by colour from where
            the log says that it begins.
        cameras: Camera file in place of the scene's or episode's own, as register writes it.
    """
    from drake_pose.jobs.estimate.compile_ahead import compiling_ahead
    from drake_pose.jobs.estimate.scene import estimate_scene

    with compiling_ahead(), FrameProgress() as progress:
        result = estimate_scene(
            scene, model, out, settings, truth=truth, cameras=cameras, resume=resume,
            replay=replay, overlay=overlay, on_frame=progress, on_stage=progress.show_stage,
        )  # fmt: skip
    print_result(result, json, print_estimate)
    if result.found_count == 0:
        raise SceneError("no pose was found in any frame")


def demo(
    *,
    out: Annotated[Path, Parameter(alias="-o")] = Path("results/demo"),
    json: Json = False,
) -> None:
    """Estimate the pose in a stored real mask: a man balancing on a beam, seen by one camera.

    Only the position of his right ankle is known. The search begins at that foot and finds all
    other joint angles, as in Kameda, Minoh and Ikeda's experiment with real people. The model is a
    man of average measures, not fitted to this man.

        drake-pose demo --out results/demo

    Args:
        out: Folder for the result.
    """
    from drake_pose.jobs.demo import run_demo
    from drake_pose.jobs.estimate.compile_ahead import compiling_ahead

    with compiling_ahead(), FrameProgress() as progress:
        result = run_demo(out, on_frame=progress)
    print_result(result, json, _print_demo)
    if result.found_count == 0:
        raise SceneError("no pose was found")


def print_estimate(result: SceneEstimate) -> None:
    """Prints a row a frame, of many the worst; joint errors if there is a truth; the files."""
    console = output_console()
    if result.summary["method"] == "person":
        console.print("One person was followed by all silhouettes at once (--method person).")
        table = Table("camera", "frames", "mean IoU")
        for camera, one in result.summary["cameras"].items():
            table.add_row(escape(camera), str(one["frames"]), percent(one["mean_iou"]))
        console.print(table)
    else:
        console.print(_frame_table(result))
    if any(record.joint_errors for record in result.records.values()):
        console.print(_error_table(result))
    _print_totals(console, result)


def _frame_table(result: SceneEstimate) -> Table:
    with_truth = any(record.joint_errors for record in result.records.values())
    errors = ["mean joint error"] if with_truth else []
    records = list(result.records.items())
    shown, which = worst_frames([record.E_total for _, record in records])
    table = Table(
        "frame", "E_total", "before", "runs", "seconds", *errors, title=f"Estimate{which}"
    )
    angles = set(_angles(result))
    for frame, record in (records[k] for k in shown):
        turns = [abs(e) for name, e in record.joint_errors.items() if name in angles]
        table.add_row(
            escape(frame),
            percent(record.E_total),
            percent(record.first_E_total),
            "" if record.runs is None else str(record.runs),
            f"{record.seconds:.2f}",
            *([f"{sum(turns) / len(turns):.1f} deg" if turns else "-"] if with_truth else []),
        )
    return table


def _print_demo(result: SceneEstimate) -> None:
    """The only frame's joint angles, the error, the seconds and where the picture is."""
    from drake_pose.files.folder import OVERLAY

    console = output_console()
    table = Table("joint", "value", title="Joint angles of the man in the picture")
    for name, kind, value in zip(
        result.position_names, result.position_kinds, result.rows[0].q, strict=True
    ):
        text = f"{value:.3f} m" if kind == "length" else f"{value:.4f}"
        text = f"{math.degrees(value):.1f} deg" if kind == "angle" else text
        table.add_row(escape(name), text if math.isfinite(value) else "-")
    console.print(table)
    _print_totals(console, result)
    if result.folder is not None:
        for overlay in sorted((result.folder / OVERLAY).glob("*/*.png")):
            console.print(f"overlay        {escape(str(overlay))}", soft_wrap=True)
    console.print(
        "The picture tells agreement (light grey), missing (blue) and excess (orange) apart. "
        "Kameda, Minoh and Ikeda report 22.3 % for six pictures of a woman, with a model of her."
    )


def _print_totals(console: Console, result: SceneEstimate) -> None:
    from drake_pose.files.folder import POSES, REPLAY, REPORT

    summary = result.summary
    console.print(f"found          {result.found_count} of {len(result.records)} frames")
    console.print(f"E_total        {percent(summary['mean_E_total'])} in the mean")
    console.print(f"seconds        {summary['median_seconds']:.2f} a frame in the median")
    if summary["mean_iou"] is not None:
        frames = f"{summary['compared_count']} of {len(result.records)} frames"
        console.print(f"IoU            {percent(summary['mean_iou'])} in the mean of {frames}")
    for label, file in (("poses", POSES), ("report", REPORT), ("replay", REPLAY)):
        if result.folder is not None and (result.folder / file).is_file():
            console.print(f"{label:<14} {escape(str(result.folder / file))}", soft_wrap=True)


def _angles(result: SceneEstimate) -> list[str]:
    kinds = zip(result.position_names, result.position_kinds, strict=True)
    return [name for name, kind in kinds if kind == "angle"]


def _error_table(result: SceneEstimate) -> Table:
    """Estimate minus truth: a row a joint, a column a frame."""
    angles = set(_angles(result))
    compared = {f: one.joint_errors for f, one in result.records.items() if one.joint_errors}
    shown = list(compared)[:8]
    table = Table("joint", "mean", "greatest", *map(escape, shown), title="Joint errors")
    for name, errors in result.summary["joint_errors"].items():
        unit, digits = ("deg", 1) if name in angles else ("m", 3)
        ends = (f"{errors[key]:.{digits}f} {unit}" for key in ("mean", "greatest"))
        each = (f"{compared[frame][name]:+.{digits}f}" for frame in shown)
        table.add_row(escape(name), *ends, *each)
    return table
