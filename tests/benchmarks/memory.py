"""Benchmark of the memory of commands on the project's own data (`make bench`)."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.benchmarks.tables import print_table

LIMIT_MIB = 1536
"""Maximum memory of a command on the project's own data [MiB]."""

COMMANDS = (
    "demo --out demo",
    "reproduce kameda --images 10",
    "reproduce kameda --images 10 --method beam",
    "reproduce kameda --images 3 --angles continuous",
    "reproduce kameda --images 3 --angles continuous --views 4",
    "reproduce shimada --runs 5",
    "reproduce date --frames 60",
)
"""Command lines that need only the project's own data; results go to the current folder."""


def measure_memory(
    words: Sequence[str], folder: Path, program: Sequence[str] = ("-m", "drake_pose.commands.main")
) -> tuple[int, float, float]:
    """Run a command in a child process; return its exit status, peak memory [MiB] and CPU time [s].

    The memory is the maximum over the process and its workers. Linux never reports less than the
    measuring process had, so that process should be small.
    """
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(
        [sys.executable, *program, *words], stdin=quiet, stdout=quiet, stderr=quiet, cwd=folder
    )
    # Usage of this child only, and of the workers that it waited for.
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    # macOS counts bytes, Linux kibibytes.
    unit = 1024**2 if sys.platform == "darwin" else 1024
    return process.returncode, usage.ru_maxrss / unit, usage.ru_utime + usage.ru_stime


def _rows(folder: Path) -> Iterator[tuple[str, ...]]:
    for line in COMMANDS:
        status, peak, seconds = measure_memory(line.split(), folder)
        beyond = " (too much)" if peak > LIMIT_MIB else ""
        yield line, f"{peak:.0f} MiB{beyond}", f"{seconds:.0f} s", str(status)


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory(prefix="drake_pose_") as folder:
        title = f"Peak memory of a process (limit: {LIMIT_MIB} MiB)"
        print_table(title, ("drake-pose ...", "peak", "CPU", "exit"), _rows(Path(folder)))


if __name__ == "__main__":
    main()
