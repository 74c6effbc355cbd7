"""How commands speak: results on stdout, all else on stderr, exit status 0, 1 or 2."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn, Protocol, TypeVar

import typer

from drake_pose.errors import DrakePoseError

FAILED = 1


class _Result(Protocol):
    """What a command's work comes to."""

    @property
    def warnings(self) -> Sequence[str]: ...

    @property
    def summary(self) -> Mapping[str, Any]: ...


_R = TypeVar("_R", bound=_Result)


@contextmanager
def errors_as_messages(folder: Path | None = None) -> Iterator[None]:
    """Turns what may go wrong inside a command into a message and exit status 1.

    Args:
        folder: where --resume goes on after Ctrl-C; None: there is nothing to go on with.
    """
    try:
        yield
    except DrakePoseError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        if folder is None:
            _fail("interrupted")
        if not folder.is_dir():
            _fail("interrupted before anything was written")
        _fail(f"interrupted; what is finished is in {folder}; go on with --resume")
    except SystemExit as error:
        # Drake raises SystemExit where one of its C++ demands fails, and exits without a word.
        _fail(f"Drake stopped with a failed demand: {error}")


@contextmanager
def usage_errors() -> Iterator[None]:
    """Turns errors in the texts of options into usage errors, exit status 2."""
    try:
        yield
    except DrakePoseError as error:
        raise typer.BadParameter(str(error)) from None


def finite(number: float | None) -> float | None:
    """Refuses nan and inf, which an option's range lets pass; its callback."""
    if number is not None and not math.isfinite(number):
        raise typer.BadParameter(f"{number} is not a finite number")
    return number


def say(message: str) -> None:
    """Writes a line to stderr."""
    typer.echo(message, err=True)


def warn(message: str) -> None:
    """Writes a warning to stderr."""
    say(f"drake-pose: warning: {message}")


def print_json(value: Mapping[str, Any]) -> None:
    """Writes JSON to stdout; numbers that are not finite become null."""
    from drake_pose.results.folder import without_nan

    typer.echo(json.dumps(without_nan(value), indent=2, ensure_ascii=False, allow_nan=False))


def print_result(result: _R, json: bool, print_text: Callable[[_R], None]) -> None:
    """Writes a result's warnings to stderr and, to stdout, its summary as JSON or its text."""
    for text in result.warnings:
        warn(text)
    if json:
        print_json(result.summary)
    else:
        print_text(result)


def _fail(message: str) -> NoReturn:
    say(f"drake-pose: error: {message}")
    raise typer.Exit(FAILED)
