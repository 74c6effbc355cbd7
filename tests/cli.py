"""Run the command line inside a test."""

import contextlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from unittest import mock

from drake_pose.commands.main import main


@dataclass(frozen=True)
class Result:
    """Exit code and output of a command; `output` has both streams in order."""

    exit_code: int
    stdout: str
    stderr: str
    output: str


class _Stream(io.StringIO):
    """Writes to another stream, too."""

    def __init__(self, both: io.StringIO) -> None:
        super().__init__()
        self._both = both

    def write(self, text: str) -> int:
        self._both.write(text)
        return super().write(text)


def run_command(words: Sequence[str], env: Mapping[str, str] | None = None) -> Result:
    """Run `drake-pose` with arguments."""
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


def run_to_end(*words: object, status: int = 0) -> Result:
    """Run `drake-pose` with arguments, and assert its exit status."""
    result = run_command([str(word) for word in words])
    assert result.exit_code == status, result.output
    return result


def run_json(*words: object) -> dict[str, Any]:
    """Return the JSON output of a command."""
    found: dict[str, Any] = json.loads(run_to_end(*words, "--json").stdout)
    return found


def assert_refused(result: Result, *parts: str, status: int = 1) -> None:
    """Assert that a command failed with a one-line message that contains these parts."""
    assert result.exit_code == status, result.output
    message = " ".join(result.stderr.split())
    for part in ("drake-pose: error: ", *parts):
        assert part in message
    assert "Traceback" not in result.output
    assert result.stdout == ""
