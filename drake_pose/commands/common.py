"""Options that several commands share, and functions that print.

Results go to stdout; messages, warnings and progress bars to stderr.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from markupsafe import Markup
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from drake_pose.errors import weight_of
from drake_pose.files.settings import RUNNING, within

if TYPE_CHECKING:
    from drake_pose.files.records import FrameRecord
    from drake_pose.files.writer import OnFrame, OnStage

SPREAD = Parameter("*")
"""Makes each field of a settings class an option of its own."""

Model = Annotated[
    Path, Parameter(["--model", "-m"], help="Model file: URDF, SDFormat, MJCF or .dmd.yaml.")
]
Out = Annotated[
    Path, Parameter(["--out", "-o"], help="Folder for the result. It must be new or empty.")
]
Cameras = Annotated[
    Path | None, Parameter(help="Camera file to use instead of the scene's or episode's own.")
]
Joints = Annotated[
    Path | None,
    Parameter(
        ["--joints", "-j"],
        help="Joint positions in every frame [rad or m]: CSV file with the column frame (an "
        "episode may have time instead) and one for each joint. Default: the scene's "
        "joint_angles.csv or the episode's joint log.",
    ),
]
Truth = Annotated[
    Path | None,
    Parameter(
        help="Measured joint positions [rad or m] to compare with: CSV file with the column frame "
        "and one for each joint. Default: SCENE/joint_angles.csv, if it exists."
    ),
]
Pictures = Annotated[
    Path | None,
    Parameter(["--out", "-o"], help="Folder for pictures. Default: no pictures are written."),
]
Seed = Annotated[int, within(0), Parameter(help="Seed of the random numbers.")]
Resume = Annotated[bool, RUNNING, Parameter(help="Continue the interrupted result in --out.")]
Replay = Annotated[
    bool, RUNNING, Parameter(negative="--no-replay", help="Write replay.html. Default: yes.")
]
Overlay = Annotated[
    bool,
    RUNNING,
    Parameter(negative="--no-overlay", help="Write pictures into overlay/. Default: yes."),
]
Json = Annotated[bool, RUNNING, Parameter(help="Print the result as JSON.")]


class UsageError(Exception):
    """Options that exclude each other; exit status 2."""


def say(message: str) -> None:
    """Print a line to stderr; characters that are not printable are escaped."""
    safe = (c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in message)
    print("".join(safe), file=sys.stderr, flush=True)


def warn(*messages: str) -> None:
    """Print warnings to stderr, with their weights."""
    words = {"wrong": "warning: wrong answer likely", "check": "warning", "note": "note"}
    for message in messages:
        say(f"drake-pose: {words[weight_of(message)]}: {message}")


def print_json(value: Mapping[str, Any]) -> None:
    """Print JSON to stdout; numbers that are not finite become null."""
    from drake_pose.files.folder import without_nan

    print(json.dumps(without_nan(value), indent=2, ensure_ascii=False, allow_nan=False))


def print_result(result: Any, json: bool, print_text: Callable[[Any], None]) -> None:
    """Print a result's warnings to stderr, and its summary, or text and next steps, to stdout.

    Args:
        result: a job's result, with the attributes ``warnings``, ``summary`` and ``folder``.
        json: whether the summary is printed as JSON.
        print_text: prints the result as text, if ``json`` is False.
    """
    warn(*result.warnings)
    if json:
        print_json(result.summary)
        return
    print_text(result)
    print_next(result.folder, result.summary)


def print_line(text: str) -> None:
    """Print a text to stdout, unwrapped unless stdout is a terminal."""
    output_console().print(escape(text), soft_wrap=True)


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]], title: str = "") -> None:
    """Print a table to stdout, without the markup of its cells; nothing without rows."""
    table = Table(*map(escape, head), title=escape(title) or None)
    for row in rows:
        texts = (cell.striptags() if isinstance(cell, Markup) else cell for cell in row)
        table.add_row(*map(escape, texts))
    if table.row_count:
        output_console().print(table)


def output_console() -> Console:
    """Return the console for results; files and pipes get lines of 160 columns."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=160)


def print_next(folder: Path | None, summary: Mapping[str, Any]) -> None:
    """Print the files of a result folder, and what to do with each; nothing for None."""
    from drake_pose.files.folder import REPORT
    from drake_pose.files.page import next_steps

    if folder is None:
        return
    print_line(f"result               {folder}")
    files = [(REPORT, "start here: answer, warnings and pictures on one page")]
    for name, use in (*files, *next_steps(folder, summary)):
        if (folder / name).exists():
            print_line(f"{name:<20} {use}")


def progress_bar() -> Progress:
    """Return a progress bar on stderr, disabled if stderr is not a terminal."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        console=console, disable=not console.is_terminal,
    )  # fmt: skip


@contextmanager
def count_progress(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show a progress bar; yields a function to be called with the number of finished items.

    ``what`` labels the bar; ``total`` is the number of all items, None if unknown.
    """
    with progress_bar() as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


@contextmanager
def frame_progress() -> Iterator[tuple[OnFrame, OnStage]]:
    """Show a progress bar over frames that also counts the frames without a pose.

    Yields functions to be called with a finished frame, and with the progress of another stage of
    the work; each stage has its own bar.
    """
    with progress_bar() as progress:
        stage, lost, task = "reading", 0, progress.add_task("reading", total=None)

        def show_stage(name: str, done: int, total: int | None) -> None:
            nonlocal stage, task
            if name != stage:
                progress.remove_task(task)
                stage, task = name, progress.add_task(name, total=total)
            progress.update(task, completed=done, total=total)

        def show_frame(done: int, total: int, _: str, record: FrameRecord | None) -> None:
            nonlocal lost
            show_stage("frames", done, total)
            if record is not None and not record.found:
                lost += 1
                progress.update(task, description=f"frames ({lost} without a pose)")

        yield show_frame, show_stage
