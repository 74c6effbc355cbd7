"""Options that several commands share, and functions that print.

Results go to stdout; messages, warnings and progress bars to stderr.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

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
Replay = Annotated[bool, RUNNING, Parameter(negative="--no-replay", help="Write replay.html.")]
Overlay = Annotated[
    bool, RUNNING, Parameter(negative="--no-overlay", help="Write overlay/<camera>/<frame>.png.")
]
Json = Annotated[bool, RUNNING, Parameter(help="Print the result as JSON.")]


class UsageError(Exception):
    """Options that exclude each other; exit status 2."""


def say(message: str) -> None:
    """Print a line to stderr; characters that are not printable are escaped."""
    safe = (c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in message)
    print("".join(safe), file=sys.stderr, flush=True)


def warn(*messages: str) -> None:
    """Print warnings to stderr."""
    for message in messages:
        say(f"drake-pose: warning: {message}")


def print_json(value: Mapping[str, Any]) -> None:
    """Print JSON to stdout; numbers that are not finite become null."""
    from drake_pose.files.folder import without_nan

    print(json.dumps(without_nan(value), indent=2, ensure_ascii=False, allow_nan=False))


def print_result(result: Any, json: bool, print_text: Callable[[Any], None]) -> None:
    """Print a result's warnings to stderr, and its summary or text to stdout.

    Args:
        result: a job's result, with the attributes ``warnings`` and ``summary``.
        json: whether the summary is printed as JSON.
        print_text: prints the result as text, if ``json`` is False.
    """
    warn(*result.warnings)
    if json:
        print_json(result.summary)
    else:
        print_text(result)


def output_console() -> Console:
    """Return the console for results; files and pipes get lines of 160 columns."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=160)


def print_files(*files: tuple[str, Path]) -> None:
    """Print label and path of each file that exists."""
    for label, path in files:
        if path.exists():
            output_console().print(f"{label:<14} {escape(str(path))}", soft_wrap=True)


def worst_frames(errors: Sequence[float | None], most: int = 30) -> tuple[list[int], str]:
    """Return the indices of the worst frames, ascending, and a text to append to a table's title.

    The text is "" if these are all frames.

    Args:
        errors: error of each frame; nan or None if no pose was found, which counts as worst.
        most: maximum number of frames.
    """
    badness = [math.inf if one is None or math.isnan(one) else one for one in errors]
    shown = sorted(sorted(range(len(errors)), key=lambda k: -badness[k])[:most])
    is_all = len(shown) == len(errors)
    return shown, "" if is_all else f": the worst {len(shown)} of {len(errors)} frames"


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
