"""The command line `drake-pose`.

Commands import heavy modules inside their functions, so that `--help` starts quickly.
"""

import inspect
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NoReturn

from cyclopts import App, CycloptsError, Group, Parameter
from cyclopts.help import DefaultFormatter, HelpPanel
from rich.console import Console, ConsoleOptions
from rich.text import Text

from drake_pose.commands.common import UsageError, say
from drake_pose.commands.estimate import batch, capture, demo, empty_room, estimate
from drake_pose.commands.papers import date, kameda, shimada
from drake_pose.commands.register import audit, check, masks, register
from drake_pose.errors import DrakePoseError, SettingsError, messages_for
from drake_pose.files.settings import say_gone
from drake_pose.version import VERSION


def _unfold(text: str) -> str:
    """Join the lines of each paragraph; indented examples keep their lines."""
    return re.sub(r"(?<=\S)\n(?=\S)", " ", inspect.cleandoc(text))


class _Formatter(DefaultFormatter):
    """Joins the lines of an option's help, which the terminal then wraps."""

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        for entry in panel.entries:
            about = getattr(entry.description, "primary_renderable", None)
            if isinstance(about, Text):
                about.plain = " ".join(about.plain.split())
        super().__call__(console, options, panel)


def _program(name: str, help: str, *commands: Callable[..., None]) -> App:
    """Return a program whose commands are functions; help texts are their docstrings before Args.

    Args:
        name: the program's name.
        help: its help text, before the list of commands.
        commands: functions; a command has its function's name, with hyphens for underscores.
    """

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
        group_parameters=Group("Options", sort_key=-1),
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
        name = command.__name__.replace("_", "-")
        program.command(command, name=name, help=_unfold(about))
    return program


app = _program(
    "drake-pose",
    """Estimate joint angles of articulated objects from silhouettes.

    Input: a model file that Drake reads (URDF, SDFormat, MJCF) and a scene, which is a folder with
    cameras.yaml and black and white masks/<camera>/<frame>.png. Output: the joint angles in each
    frame, their 95 % intervals, which of them the silhouettes determine, and other poses that fit
    equally well. No training and no GPU are needed. For a first result run drake-pose demo.

    Exit status: 0 success, 1 failure (the message names the cause), 2 wrong usage.""",
    estimate, capture, register, audit, masks, batch, demo, check, empty_room,
)  # fmt: skip
app.command(
    _program(
        "reproduce",
        "Run a paper's experiment and show its published results beside ours.",
        *(kameda, shimada, date),
    )
)


def main(words: Sequence[str] | None = None) -> None:
    """Run the command line.

    Args:
        words: arguments after the program's name; None: those of this process.

    Raises:
        SystemExit: with the exit status, if it is not 0.
    """
    # OpenBLAS reads this when numpy is first imported. Its threads slow products of small matrices
    # down by up to ten times while other processes, such as a batch's workers, use the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # SIGTERM and SIGHUP, as a service manager sends them, act like Ctrl-C.
    for ending in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(ending) is signal.SIG_DFL:
            signal.signal(ending, signal.default_int_handler)
    # Results name these joints themselves.
    warnings.filterwarnings("ignore", ".*(have no limits: they place|joints leave one value)")
    with messages_for("command line"):
        _run(words)


def _run(words: Sequence[str] | None) -> None:
    """Parse arguments (as in `main`) and run the command; errors become a line and SystemExit."""
    try:
        command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    except (CycloptsError, SettingsError) as error:
        given = " ".join(sys.argv[1:] if words is None else words).replace("=", " ").split()
        heads = [one for k, one in enumerate(given) if k == 0 or one.startswith("--")]
        pairs = [f"{one} {then}" for one, then in pairwise(given) if one in heads]
        pairs += [f"{given[0]} {one}" for one in heads[1:]]
        _stop(say_gone([*heads, *pairs]) or str(error), 2)
    except KeyboardInterrupt:
        # Parsing imports modules, which may compile kernels.
        _stop("interrupted before anything was written")
    try:
        command(*bound.args, **bound.kwargs)
    except UsageError as error:
        _stop(str(error), 2)
    except DrakePoseError as error:
        for note in getattr(error, "__notes__", ()):
            say(f"drake-pose: {note}")
        _stop(str(error))
    except KeyboardInterrupt:
        if "resume" not in inspect.signature(command).parameters:
            _stop("interrupted")
        out = bound.arguments["out"]
        if not out.is_dir():
            _stop("interrupted before anything was written")
        _stop(f"interrupted; the finished part is in {out}; continue with --resume")
    except OSError as error:
        # An error that no command handles, such as a folder without search permission.
        _stop(f"{error.filename or 'the system'}: {error.strerror or error}")
    except UnicodeEncodeError as error:
        near = error.object[max(0, error.start - 40) : error.end + 40]
        _stop(f"{near!r}: the name of this file or folder is not UTF-8; rename it")
    except SystemExit as error:
        # Drake raises SystemExit where DRAKE_DEMAND fails.
        _stop(f"a DRAKE_DEMAND failed in Drake: {error}")


def _stop(message: str, status: int = 1) -> NoReturn:
    """Print an error message to stderr, and exit with a status."""
    say(f"drake-pose: error: {message}")
    sys.exit(status)


if __name__ == "__main__":
    main()
