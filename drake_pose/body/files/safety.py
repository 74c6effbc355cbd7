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

    Drake 1.51 can crash on a broken glTF, a texture, a file that includes itself, and a YAML alias
    bomb takes all memory; in the child none of these harms the caller. That it can be used is
    remembered for as long as the file's content stays the same.

    Raises:
        ModelError: the model cannot be used, or reading it crashed, hung or took too much memory.
    """
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ModelError(f"model file {path} cannot be read: {error.strerror}") from error
    arguments = (str(path), json.dumps(dict(packages)), json.dumps(dict(limits)))
    _ask_child(arguments, digest)


@functools.lru_cache(maxsize=64)
def _ask_child(arguments: tuple[str, ...], digest: str) -> None:
    """Raise why the model cannot be used; digest only tells versions of the file apart.

    A refusal is not remembered: a missing mesh or package may have been put in place since.
    """
    library_folder = str(Path(__file__).resolve().parents[3])
    environment = dict(os.environ)
    search_path = [library_folder, environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(part for part in search_path if part)
    environment["LP_NUM_THREADS"] = "0"
    command = [sys.executable, "-m", "drake_pose.body.check_child", *arguments]
    path = arguments[0]
    try:
        child = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=TIME_LIMIT_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ModelError(
            f"{path}: reading it takes more than {TIME_LIMIT_SECONDS:g} s; does it include itself?"
        ) from None
    lines = child.stdout.decode("utf-8", "replace").strip().splitlines()
    if child.returncode == 0 and lines:
        answer = json.loads(lines[-1])
        if answer["usable"]:
            return
        raise ModelError(str(answer["reason"]))
    if child.returncode < 0:
        what = f"crashed Drake ({signal.Signals(-child.returncode).name})"
    else:
        remarks = child.stderr.decode("utf-8", "replace").strip().splitlines()
        what = f"failed ({remarks[-1] if remarks else f'exit status {child.returncode}'})"
    raise ModelError(
        f"{path}: reading it {what}; it or a file it names is broken, includes itself, or needs "
        f"more than {MEMORY_LIMIT_BYTES // 2**30} GiB of memory"
    )
