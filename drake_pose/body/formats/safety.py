"""Reading a model that nobody has vouched for, first in a child process that may die instead."""

import atexit
import functools
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

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
    end = _CHECKER.ask({"path": path, "packages": packages, "limits": limits})
    if end["status"] is None:
        raise ModelError(
            f"{path}: reading it takes more than {TIME_LIMIT_SECONDS:g} s; does it include itself?"
        )
    if end["status"] == 0 and "usable" in end:
        if end["usable"]:
            return
        raise ModelError(str(end["reason"]))
    if end["status"] < 0:
        what = f"crashed Drake ({signal.Signals(-end['status']).name})"
    else:
        what = f"failed ({end['remark'] or 'exit status ' + str(end['status'])})"
    raise ModelError(
        f"{path}: reading it {what}; it or a file it names is broken, includes itself, or needs "
        f"more than {MEMORY_LIMIT_BYTES // 2**30} GiB of memory"
    )


class _Checker:
    """A process that has loaded Drake and forks a child for each model, until idle too long."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._owner = 0
        atexit.register(self._close)

    def ask(self, question: dict[str, str]) -> dict[str, Any]:
        """How the child ended: status (None: out of time), its answer or its last remark."""
        environment = {**os.environ, "LP_NUM_THREADS": "0"}
        more = {"time_limit": TIME_LIMIT_SECONDS, "environment": environment, "folder": os.getcwd()}
        line = json.dumps(question | more)
        with self._lock:
            # One that has just ended, for want of questions, is asked in vain.
            return self._exchange(line) or self._exchange(line) or _NO_ANSWER

    def _exchange(self, line: str) -> dict[str, Any] | None:
        process = self._running()
        assert process.stdin is not None
        assert process.stdout is not None
        answer = ""
        try:
            process.stdin.write(line + "\n")
            process.stdin.flush()
            answer = process.stdout.readline()
        except BrokenPipeError:
            pass
        finally:
            if not answer:  # Interrupted, too: the answer must not be taken for the next one.
                self._close()
        return dict(json.loads(answer)) if answer else None

    def _close(self) -> None:
        """Let the process end, which it does when nobody can ask it any more."""
        if self._process is not None and self._owner == os.getpid():
            with suppress(BrokenPipeError), self._process:
                pass
        self._process = None

    def _running(self) -> subprocess.Popen[str]:
        # A process that was forked must not read its parent's answers.
        if self._process is None or self._owner != os.getpid():
            library_folder = str(Path(__file__).resolve().parents[3])
            paths = [library_folder, os.environ.get("PYTHONPATH", "")]
            search_path = os.pathsep.join(part for part in paths if part)
            self._process = subprocess.Popen(
                [sys.executable, "-m", "drake_pose.body.check_child"],
                env={**os.environ, "PYTHONPATH": search_path, "LP_NUM_THREADS": "0"},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            self._owner = os.getpid()
        return self._process


_NO_ANSWER: dict[str, Any] = {"status": 1, "remark": "the process that reads models cannot start"}
_CHECKER = _Checker()
