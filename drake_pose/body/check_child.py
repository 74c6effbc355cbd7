"""The process behind safety.py: a line of JSON in, a child forked that reads a model, one out.

Only the children render: a process that forks after a render hangs.
"""

import json
import os
import select
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body.formats.parsing import captured_warnings
from drake_pose.body.formats.safety import MEMORY_LIMIT_BYTES
from drake_pose.body.model import read_model
from drake_pose.errors import DrakePoseError

_IDLE_SECONDS = 10.0
_POLL_SECONDS = 0.002


def main() -> None:
    """Answer questions until none comes for a while."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while select.select([sys.stdin], [], [], _IDLE_SECONDS)[0]:
        line = sys.stdin.readline()
        if not line:
            return
        print(json.dumps(_answer(json.loads(line))), flush=True)


def _answer(question: dict[str, Any]) -> dict[str, Any]:
    """Let a child read the model; how it ended, and what it said."""
    with tempfile.TemporaryFile("w+b") as said, tempfile.TemporaryFile("w+b") as remarks:
        child = os.fork()
        if child == 0:
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(said.fileno(), 1)
            os.dup2(remarks.fileno(), 2)
            _read(question)
        status = _wait(child, question["time_limit"])
        said.seek(0)
        lines = said.read().decode("utf-8", "replace").strip().splitlines()
        remarks.seek(0)
        last = remarks.read().decode("utf-8", "replace").strip().splitlines()[-1:]
    verdict = json.loads(lines[-1]) if status == 0 and lines else {}
    return {"status": status, "remark": "".join(last), **verdict}


def _wait(child: int, time_limit: float) -> int | None:
    """The child's exit status, negative for a signal; None: it took too long, and was killed."""
    end = time.monotonic() + time_limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(_POLL_SECONDS)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def _read(question: dict[str, Any]) -> NoReturn:
    """In the child: read the model, give it to a renderer, and print the verdict."""
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.environ.clear()
        os.environ.update(question["environment"])
        os.chdir(question["folder"])
        _limit_memory()
        verdict = _judge(Path(question["path"]), question["packages"], question["limits"])
        print("\n" + json.dumps(verdict), flush=True)
        status = 0
    finally:
        error = sys.exc_info()[1]
        if error is not None:  # A SystemExit, too: Drake's way to refuse.
            print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        os._exit(status)


def _limit_memory() -> None:
    """Let this process fail, rather than the machine, when a model takes too much memory."""
    with suppress(ImportError, ValueError, OSError):
        import resource  # Absent on Windows.

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_BYTES, MEMORY_LIMIT_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _judge(path: Path, packages: str, limits: str) -> dict[str, Any]:
    """Whether the model can be used, or why not."""
    try:
        model = read_model(path, json.loads(packages), json.loads(limits))
        plant = MultibodyPlant(time_step=0.0)
        scene_graph = SceneGraph()
        model.add_to(plant, scene_graph)
        with captured_warnings():
            scene_graph.AddRenderer("check", MakeRenderEngineVtk(RenderEngineVtkParams()))
        return {"usable": True, "reason": ""}
    except DrakePoseError as error:
        return {"usable": False, "reason": str(error)}
    except RuntimeError as error:
        return {"usable": False, "reason": f"{path}: {error}"}
    except MemoryError:
        limit = f"{MEMORY_LIMIT_BYTES // 2**30} GiB"
        reason = f"{path}: reading it needs more than {limit} of memory; make its meshes smaller"
        return {"usable": False, "reason": reason}


if __name__ == "__main__":
    main()
