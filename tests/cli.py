"""Runs the command line inside a test."""

import contextlib
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from unittest import mock

from drake_pose.commands.main import main


@dataclass(frozen=True)
class Result:
    """How it ended and what it wrote; `output` has both streams as they came."""

    exit_code: int
    stdout: str
    stderr: str
    output: str


class _Stream(io.StringIO):
    def __init__(self, both: io.StringIO) -> None:
        super().__init__()
        self._both = both

    def write(self, text: str) -> int:
        self._both.write(text)
        return super().write(text)


def run_command(words: Sequence[str], env: Mapping[str, str] | None = None) -> Result:
    """Runs `drake-pose` with these words."""
    both = io.StringIO()
    out, err, status = _Stream(both), _Stream(both), 0
    with (
        mock.patch.dict(os.environ, env or {}),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main(words)
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
    return Result(status, out.getvalue(), err.getvalue(), both.getvalue())


class CliRunner:
    """Runs commands; what tests call `runner`."""

    def invoke(
        self, app: object, words: Sequence[str], env: Mapping[str, str] | None = None
    ) -> Result:
        return run_command(words, env)
