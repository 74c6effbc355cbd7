"""The command line `drake-pose`. Heavy modules are imported inside the commands."""

import inspect
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from cyclopts import App, CycloptsError, Parameter
from cyclopts.help import DefaultFormatter, HelpPanel
from rich.console import Console, ConsoleOptions
from rich.text import Text

from drake_pose.commands.batch import batch
from drake_pose.commands.common import UsageError, say
from drake_pose.commands.estimate import capture, demo, empty_room, estimate
from drake_pose.commands.papers import date, kameda, reproduce_all, shimada
from drake_pose.commands.prepare import check, masks, undistort
from drake_pose.commands.register import audit, register
from drake_pose.commands.walk import walk
from drake_pose.errors import DrakePoseError, SettingsError, options_in_messages
from drake_pose.version import VERSION


def _unfold(text: str) -> str:
    """Paragraphs in one line each; examples, which are indented, stay line by line."""
    return re.sub(r"(?<=\S)\n(?=\S)", " ", inspect.cleandoc(text))


class _Formatter(DefaultFormatter):
    """Joins the lines of a docstring that is an option's help, which are then folded anew."""

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        for entry in panel.entries:
            about = getattr(entry.description, "primary_renderable", None)
            if isinstance(about, Text):
                about.plain = " ".join(about.plain.split())
        super().__call__(console, options, panel)


def _program(name: str, help: str, *commands: Callable[..., None]) -> App:
    """A program of commands: functions, which their docstrings describe."""

    def show_default(value: object) -> str | None:
        return None if value in (None, (), {}) or isinstance(value, bool) else str(value)

    program = App(
        name,
        help=_unfold(help),
        help_format="plaintext",
        help_formatter=_Formatter(),
        help_flags="--help",
        version=f"drake-pose {VERSION}",
        version_flags="--version",
        default_parameter=Parameter(
            allow_repeating=True,
            negative=(),
            show_default=show_default,
            show_env_var=False,
            show_choices=False,
        ),
    )
    for command in commands:
        about, _, _ = (command.__doc__ or "").partition("    Args:\n")
        name = command.__name__.removeprefix("reproduce_").replace("_", "-")
        program.command(command, name=name, help=_unfold(about))
    return program


app = _program(
    "drake-pose",
    """Joint angles of articulated objects from silhouettes.

    Input: any model file that Drake reads (URDF, SDFormat, MJCF), and a scene: a folder with
    cameras.yaml and black and white masks/<camera>/<frame>.png. Output: the joint angles in each
    frame, which of them the silhouettes determine and how well, and other poses that look the same.
    No training, no GPU. For a first result run drake-pose demo.

    Exit status: 0 done, 1 failed (the message says what is at fault), 2 wrong usage.""",
    estimate, capture, register, audit, masks, batch, walk, demo, check, undistort, empty_room,
)  # fmt: skip
app.command(
    _program(
        "reproduce",
        "Run a paper's experiment and show its figures beside ours.",
        *(kameda, shimada, date, reproduce_all),
    )
)


def main(words: Sequence[str] | None = None) -> None:
    """Runs the command line.

    Args:
        words: what follows the program's name; those it was started with where not given.

    Raises:
        SystemExit: the exit status, if it is not 0.
    """
    # Read when numpy is first imported: of small matrices, threads that wait for each other cost up
    # to ten times the product where other processes want the cores, as a batch's do.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Whoever stops the program otherwise, such as a service's manager, means what Ctrl-C means.
    for ending in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(ending) is signal.SIG_DFL:
            signal.signal(ending, signal.default_int_handler)
    with options_in_messages():
        _run(words)


def _run(words: Sequence[str] | None) -> None:
    """Reads the command line and does what it says."""
    try:
        command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    except (CycloptsError, SettingsError) as error:
        _stop(str(error), 2)
    except KeyboardInterrupt:
        # What a command needs is imported, and compiled, while its words are read.
        _stop("interrupted before anything was written")
    try:
        command(*bound.args, **bound.kwargs)
    except UsageError as error:
        _stop(str(error), 2)
    except DrakePoseError as error:
        _stop(str(error))
    except KeyboardInterrupt:
        if "resume" not in inspect.signature(command).parameters:
            _stop("interrupted")
        out = bound.arguments["out"]
        if not out.is_dir():
            _stop("interrupted before anything was written")
        _stop(f"interrupted; what is finished is in {out}; go on with --resume")
    except OSError as error:
        # Where no command expects it, such as in a folder that may not be searched.
        _stop(f"{error.filename or 'the system'}: {error.strerror or error}")
    except UnicodeEncodeError as error:
        near = error.object[max(0, error.start - 40) : error.end + 40]
        _stop(f"{near!r}: the name of this file or folder is no UTF-8 text; rename it")
    except SystemExit as error:
        # Drake raises SystemExit where one of its C++ demands fails, and exits without a word.
        _stop(f"Drake stopped with a failed demand: {error}")


def _stop(message: str, status: int = 1) -> NoReturn:
    say(f"drake-pose: error: {message}")
    sys.exit(status)


if __name__ == "__main__":
    main()
