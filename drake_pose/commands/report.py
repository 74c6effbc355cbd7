"""What commands show on the terminal: progress on stderr, tables on stdout."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from drake_pose.commands.terminal import warn
from drake_pose.results.folder import OVERLAY, POSES, REPLAY, REPORT
from drake_pose.results.summary import FrameRecord
from drake_pose.results.texts import percent

if TYPE_CHECKING:
    from drake_pose.jobs.estimate.scene import SceneEstimate


_LIMITS = {"run_limit": "run limit", "time_limit": "time limit"}


def output_console() -> Console:
    """Returns the console for results; a file or pipe gets lines that are not folded."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=160)


def progress_bar() -> Progress:
    """A bar on stderr; nothing where stderr is no terminal."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )


@contextmanager
def count_progress(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A progress bar; the value is a function to call with how many are done."""
    with progress_bar() as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


class FrameProgress:
    """A progress bar over frames that also says where no pose was found."""

    def __init__(self) -> None:
        self._progress = progress_bar()
        self._stage = "reading"
        self._task = self._progress.add_task(self._stage, total=None)

    def __enter__(self) -> FrameProgress:
        """Show the bar."""
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the bar away."""
        self._progress.stop()

    def show_stage(self, stage: str, done: int, total: int | None) -> None:
        """Show what is done before the first frame is finished, each stage by a bar of its own."""
        if stage != self._stage:
            self._progress.remove_task(self._task)
            self._task = self._progress.add_task(stage, total=total)
            self._stage = stage
        self._progress.update(self._task, completed=done, total=total)

    def __call__(self, finished: int, total: int, frame: str, record: FrameRecord | None) -> None:
        """Show that a frame is finished."""
        self.show_stage("frames", finished, total)
        if record is None:
            return
        if not record.found:
            warn(f"frame '{frame}': no pose was found")
        elif not record.explained:
            warn(
                f"frame '{frame}': no pose explains the silhouettes: E_total is "
                f"{percent(record.E_total)} at best"
            )
        elif record.stopped_by in _LIMITS:
            warn(f"frame '{frame}': the search was stopped by the {_LIMITS[record.stopped_by]}")


def print_estimate(result: SceneEstimate) -> None:
    """Prints a row a frame, the joint errors where the truth is known, and where the result is."""
    console = output_console()
    with_truth = any(record.joint_errors for record in result.records.values())
    if result.summary["method"] == "person":
        console.print("One person was followed by all silhouettes at once (--method person).")
        console.print(_camera_table(result))
    else:
        console.print(_frame_table(result, with_truth))
    if with_truth:
        console.print(_error_table(result))
    _print_totals(console, result)


def _camera_table(result: SceneEstimate) -> Table:
    """A row a camera: how many frames it had a say in, and how well it agrees."""
    table = Table("camera", "frames", "mean IoU")
    for camera, one in result.summary["cameras"].items():
        table.add_row(escape(camera), str(one["frames"]), percent(one["mean_iou"]))
    return table


def _frame_table(result: SceneEstimate, with_truth: bool) -> Table:
    table = Table("frame", "E_total", "before", "runs", "seconds", title="Estimate")
    if with_truth:
        table.add_column("mean joint error")
    for frame, record in result.records.items():
        cells = [
            escape(frame),
            percent(record.E_total),
            percent(record.first_E_total),
            "" if record.runs is None else str(record.runs),
            f"{record.seconds:.2f}",
        ]
        if with_truth:
            cells.append(_mean_angle_error(result, record))
        table.add_row(*cells)
    return table


def print_demo(result: SceneEstimate) -> None:
    """Prints the only frame's joint angles, the error, the seconds and where the picture is."""
    console = output_console()
    row = result.rows[0]
    table = Table("joint", "value", title="Joint angles of the man in the picture")
    for name, kind, value in zip(result.position_names, result.position_kinds, row.q, strict=True):
        table.add_row(escape(name), position_text(kind, value))
    console.print(table)
    _print_totals(console, result)
    if result.folder is not None:
        for overlay in sorted((result.folder / OVERLAY).glob("*/*.png")):
            console.print(f"overlay        {escape(str(overlay))}", soft_wrap=True)
    console.print(
        "The picture tells agreement (light grey), missing (blue) and excess (orange) apart. "
        "Kameda, Minoh and Ikeda report 22.3 % for six pictures of a woman, with a model of her."
    )


def position_text(kind: str, value: float) -> str:
    """Returns a position in degrees or metres."""
    if not np.isfinite(value):
        return "-"
    if kind == "angle":
        return f"{math.degrees(value):.1f} deg"
    return f"{value:.3f} m" if kind == "length" else f"{value:.4f}"


def _print_totals(console: Console, result: SceneEstimate) -> None:
    summary = result.summary
    console.print(f"found          {result.found_count} of {len(result.records)} frames")
    console.print(f"E_total        {percent(summary['mean_E_total'])} in the mean")
    console.print(f"seconds        {summary['median_seconds']:.2f} a frame in the median")
    if summary["mean_iou"] is not None:
        console.print(f"IoU            {percent(summary['mean_iou'])} in the mean")
    if result.folder is None:
        return
    for label, file in (("poses", POSES), ("report", REPORT), ("replay", REPLAY)):
        if (result.folder / file).is_file():
            console.print(f"{label:<14} {escape(str(result.folder / file))}", soft_wrap=True)


def _angle_errors(result: SceneEstimate, record: FrameRecord) -> list[float]:
    kinds = dict(zip(result.position_names, result.position_kinds, strict=True))
    return [abs(e) for name, e in record.joint_errors.items() if kinds[name] == "angle"]


def _mean_angle_error(result: SceneEstimate, record: FrameRecord) -> str:
    errors = _angle_errors(result, record)
    return f"{np.mean(errors):.1f} deg" if errors else "-"


def _error_table(result: SceneEstimate) -> Table:
    """Estimate minus truth: a row a joint, a column a frame."""
    kinds = dict(zip(result.position_names, result.position_kinds, strict=True))
    compared = {
        frame: record.joint_errors
        for frame, record in result.records.items()
        if record.joint_errors
    }
    shown = list(compared)[:8]
    table = Table("joint", "mean", "greatest", *map(escape, shown), title="Joint errors")
    for name, errors in result.summary["joint_errors"].items():
        unit, digits = ("deg", 1) if kinds[name] == "angle" else ("m", 3)
        each = [f"{compared[frame][name]:+.{digits}f}" for frame in shown]
        table.add_row(
            escape(name),
            f"{errors['mean']:.{digits}f} {unit}",
            f"{errors['greatest']:.{digits}f} {unit}",
            *each,
        )
    return table
