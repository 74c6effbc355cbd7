"""The memory that commands take on the project's own data (`make bench`)."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

LIMIT_MIB = 1536
"""No command takes more on the project's own data [MiB]."""


@dataclass(frozen=True)
class PeakMemory:
    """What one command took.

    Args:
        words: the command line, without the program.
        exit_code: 0 if it did its work.
        mebibytes: the most memory that its process had, or one of its workers [MiB].
        seconds: of the processor, with the workers [s].
    """

    words: tuple[str, ...]
    exit_code: int
    mebibytes: float
    seconds: float


def measure_memory(
    words: Sequence[str], program: Sequence[str] = ("-m", "drake_pose.commands.main")
) -> PeakMemory:
    """Runs a command in a process of its own.

    Linux never counts less than what the process that measures had, so that this one should have
    little.

    Args:
        words: as on the command line, without the program.
        program: what Python runs.
    """
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(
        [sys.executable, *program, *words], stdin=quiet, stdout=quiet, stderr=quiet
    )
    # Of this child alone, and of the workers that it waited for.
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    # macOS counts bytes, Linux kibibytes.
    unit = 1024**2 if sys.platform == "darwin" else 1024
    seconds = usage.ru_utime + usage.ru_stime
    return PeakMemory(tuple(words), process.returncode, usage.ru_maxrss / unit, seconds)


def benchmark_commands(folder: Path) -> list[list[str]]:
    """Command lines that need no data but the project's own.

    Args:
        folder: for their results.
    """
    kameda = ["reproduce", "kameda", "--images"]
    return [
        ["demo", "--out", str(folder / "demo")],
        [*kameda, "10"],
        [*kameda, "10", "--method", "beam"],
        [*kameda, "3", "--angles", "continuous"],
        [*kameda, "3", "--angles", "continuous", "--views", "4"],
        ["reproduce", "shimada", "--runs", "5"],
        ["reproduce", "date", "--frames", "60"],
        ["walk", "--simulate", "--no-browser", "--seconds", "20", "--speed", "0"],
    ]


def memory_table() -> Table:
    """What each of the commands takes."""
    table = Table(title=f"Peak memory of a process (limit: {LIMIT_MIB} MiB)")
    table.add_column("drake-pose ...")
    for heading in ("peak", "CPU", "exit"):
        table.add_column(heading, justify="right")
    with tempfile.TemporaryDirectory(prefix="drake_pose_") as folder:
        for words in benchmark_commands(Path(folder)):
            took = measure_memory(words)
            shown = " ".join(words).replace(f"{folder}{os.sep}", "")
            beyond = " (too much)" if took.mebibytes > LIMIT_MIB else ""
            table.add_row(
                shown,
                f"{took.mebibytes:.0f} MiB{beyond}",
                f"{took.seconds:.0f} s",
                str(took.exit_code),
            )
    return table


def main() -> None:
    """Print the table."""
    Console().print(memory_table())


if __name__ == "__main__":
    main()
