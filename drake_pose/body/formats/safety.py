"""Reading a model that nobody has vouched for, first in a child process that may die instead."""

import functools
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from drake_pose.errors import ModelError

TIME_LIMIT_SECONDS = 60.0
MEMORY_LIMIT_BYTES = 2 * 2**30


def check_in_child(
    path: Path, packages: Mapping[str, str], limits: Mapping[str, tuple[float, float]]
) -> None:
    """Read a model and prepare its drawing in a child process with a time and memory limit.

    Drake 1.51 can crash on a broken glTF, a texture or a file that includes itself, and a YAML
    alias bomb takes all memory. A success is remembered while the file's content stays the same.

    Raises ModelError: the model cannot be used, or reading it crashed, hung or took too much
    memory.
    """
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ModelError(f"model file {path} cannot be read: {error.strerror}") from error
    _check(str(path), json.dumps(dict(packages)), json.dumps(dict(limits)), digest)


@functools.lru_cache(maxsize=64)
def _check(path: str, packages: str, limits: str, digest: str) -> None:
    """Raise why the model cannot be used; digest only tells versions of the file apart."""
    folders = [str(Path(__file__).resolve().parents[3]), os.environ.get("PYTHONPATH", "")]
    try:
        end = subprocess.run(
            [sys.executable, "-m", "drake_pose.body.check_child", path, packages, limits],
            # With threads of its own VTK takes twice as long.
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join(filter(None, folders)),
                "LP_NUM_THREADS": "0",
            },
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=TIME_LIMIT_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ModelError(
            f"{path}: reading it takes more than {TIME_LIMIT_SECONDS:g} s; does it include itself?"
        ) from None
    said = end.stdout.strip().splitlines()
    if end.returncode == 0 and said:
        if reason := json.loads(said[-1]):
            raise ModelError(reason)
        return
    if end.returncode < 0:
        what = f"crashed Drake ({signal.Signals(-end.returncode).name})"
    else:
        remarks = end.stderr.strip().splitlines() or [f"exit status {end.returncode}"]
        what = f"failed ({remarks[-1]})"
    raise ModelError(
        f"{path}: reading it {what}; it or a file it names is broken, includes itself, or needs "
        f"more than {MEMORY_LIMIT_BYTES // 2**30} GiB of memory"
    )
