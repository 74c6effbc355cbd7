"""Reading a model that nobody has vouched for, first in a child process that may die instead."""

import faulthandler
import functools
import hashlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body.formats.parsing import captured_warnings
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.surfaces.meshes import TriangleMesh, read_meshes, workspace
from drake_pose.body.surfaces.visual_geometry import draws_given_files
from drake_pose.errors import DrakePoseError, ModelError

TIME_LIMIT_SECONDS = 60.0
MEMORY_LIMIT_BYTES = 2 * 2**30

Reader = Callable[[Path, Mapping[str, str], Mapping[str, tuple[float, float]]], ParsedModel]
"""Reads a model file: its path, its packages, and limits [rad or m] by position name."""


def check_in_child(
    read: Reader, path: Path, packages: Mapping[str, str], limits: Mapping[str, tuple[float, float]]
) -> None:
    """Read a model and prepare its drawing in a child process with a time and memory limit.

    Drawing is prepared where it takes files that were given; those written here Drake can draw.
    Drake 1.51 can crash on a broken glTF, a texture or a file that includes itself, and a YAML
    alias bomb takes all memory. A success is remembered while the file's content stays the same.
    A process of one thread forks the child, which has then imported everything; others start one.

    Raises ModelError: the model cannot be used, or reading it crashed, hung or took too much
    memory.
    """
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ModelError(f"model file {path} cannot be read: {error.strerror}") from error
    _check(read, str(path), json.dumps(dict(packages)), json.dumps(dict(limits)), digest)


@functools.lru_cache(maxsize=64)
def _check(read: Reader, path: str, packages: str, limits: str, digest: str) -> None:
    """Raise why the model cannot be used; digest only tells versions of the file apart."""
    try:
        if _may_fork():
            reason = _ask_fork(read, path, packages, limits)
        else:
            reason = _ask_process(path, packages, limits)
    except TimeoutError:
        raise ModelError(
            f"{path}: reading it takes more than {TIME_LIMIT_SECONDS:g} s; does it include itself?"
        ) from None
    except ChildProcessError as error:
        raise ModelError(
            f"{path}: reading it {error}; it or a file it names is broken, includes itself, or "
            f"needs more than {MEMORY_LIMIT_BYTES // 2**30} GiB of memory"
        ) from None
    if reason:
        raise ModelError(reason)


def why_unusable(read: Reader, path: str, packages: str, limits: str) -> str:
    """Why a model cannot be used ("": it can), in this process, which may die of it.

    ``packages`` and ``limits`` are JSON. From here on the process has MEMORY_LIMIT_BYTES more than
    it has now, and leaves no core.
    """
    with suppress(ImportError, ValueError, OSError):
        import resource  # Absent on Windows.

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + MEMORY_LIMIT_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    try:
        model = read(Path(path), json.loads(packages), json.loads(limits))
        scene_graph = SceneGraph()
        model.add_to(MultibodyPlant(time_step=0.0), scene_graph)
        if draws_given_files(scene_graph):
            with captured_warnings():
                scene_graph.AddRenderer("check", MakeRenderEngineVtk(RenderEngineVtkParams()))
    except DrakePoseError as error:
        return str(error)
    except RuntimeError as error:
        return f"{path}: {error}"
    except MemoryError:
        size = f"{MEMORY_LIMIT_BYTES // 2**30} GiB"
        return f"{path}: reading it needs more than {size} of memory; make its meshes smaller"
    return ""


def _may_fork() -> bool:
    """Whether nothing but this thread runs here, so that a fork lacks nothing."""
    try:
        alone = len(os.listdir("/proc/self/task")) == 1
    except OSError:  # Not on Linux, where alone forking is sound.
        return False
    return alone and not multiprocessing.current_process().daemon


def _ask_fork(read: Reader, path: str, packages: str, limits: str) -> str:
    """What a fork of this process answers; TimeoutError, or ChildProcessError for how it ended."""
    fork = multiprocessing.get_context("fork")
    receiver, sender = fork.Pipe(duplex=False)
    workspace()  # Here, for what the fork writes there to be removed at this process's end.
    with tempfile.TemporaryFile() as remarks:
        words = (sender, remarks.fileno(), read, path, packages, limits)
        child = fork.Process(target=_answer, args=words)
        child.start()
        sender.close()
        try:
            if not receiver.poll(TIME_LIMIT_SECONDS):
                raise TimeoutError
            with suppress(EOFError):  # It died.
                reason, meshes = receiver.recv()
                read_meshes.update({file: TriangleMesh(*mesh) for file, mesh in meshes.items()})
                return str(reason)
        finally:
            receiver.close()
            child.kill()
            child.join()
        remarks.seek(0)
        said = remarks.read().decode("utf-8", "replace")
        raise ChildProcessError(_ending(child.exitcode or 0, said))


def _answer(
    sender: Connection, remarks: int, read: Reader, path: str, packages: str, limits: str
) -> None:
    """What the fork does: it answers with the meshes that it read, too, and leaves at once."""
    faulthandler.disable()
    for descriptor in (1, 2):
        os.dup2(remarks, descriptor)
    reason = why_unusable(read, path, packages, limits)
    sender.send((reason, {f: (m.vertices, m.triangles) for f, m in read_meshes.items()}))
    os._exit(0)


def _ask_process(path: str, packages: str, limits: str) -> str:
    """What a process of its own answers, which takes longer; raises as _ask_fork."""
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
        raise TimeoutError from None
    said = end.stdout.strip().splitlines()
    if end.returncode == 0 and said:
        return str(json.loads(said[-1]))
    raise ChildProcessError(_ending(end.returncode, end.stderr))


def _ending(status: int, remarks: str) -> str:
    """How a process ended that did not answer."""
    if status < 0:
        return f"crashed Drake ({signal.Signals(-status).name})"
    return f"failed ({(remarks.strip().splitlines() or [f'exit status {status}'])[-1]})"
