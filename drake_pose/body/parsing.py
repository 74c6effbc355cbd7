"""One model file, as a cured text, into one Drake plant; every failure is a ModelError."""

import copy
import faulthandler
import functools
import hashlib
import json
import logging
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import yaml
from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_pose.body.link_files import Limits, sanitise_sdf, sanitise_urdf
from drake_pose.body.meshes import TriangleMesh, draws_given_files, read_meshes, workspace
from drake_pose.body.mjcf import Couple, sanitise_mjcf
from drake_pose.body.model_files import FileFinder
from drake_pose.body.plant_source import add_coupler
from drake_pose.errors import DrakePoseError, ModelError


class ModelSource:
    """A model file and the cured text that Drake parses in its place.

    Attributes:
        kind: what Drake's parser calls that kind of text.
        warnings: what of the file is not read, or not enforced, each once.
        limits: limits (lower, upper) [rad] by position name that Drake's parser passes over.

    Raises ModelError: missing, unreadable, of an unknown kind, or it cannot be cured; the message
    names the file and the link, joint or mesh.
    """

    def __init__(self, path: Path, package_paths: Mapping[str, str]) -> None:
        if not path.exists():
            raise ModelError(f"model file {path} does not exist")
        if not path.is_file():
            raise ModelError(f"model file {path} is not a file")
        self.path = path
        self.warnings: list[str] = []
        self.limits: Limits = {}
        self._couples: list[Couple] = []
        self._finder = FileFinder(package_paths)
        self._stand_ins: dict[Path, Path] = {}
        self._under_way: list[Path] = []
        self.text, self.kind = self._sanitise(path)

    def with_text(self, text: str) -> "ModelSource":
        """The same file with another text."""
        other = copy.copy(self)
        other.text = text
        return other

    def parse(
        self, plant: MultibodyPlant, scene_graph: SceneGraph | None, prefix: str = ""
    ) -> tuple[list[ModelInstanceIndex], list[str]]:
        """Add the model to a plant; its new instances, and what is worth knowing of the file.

        Args:
            plant: a plant that is not finalized.
            scene_graph: to register geometry with; None where the plant is registered already.
            prefix: put before the model's name.

        Raises ModelError: Drake cannot read the model.
        """
        parser = (
            Parser(plant, prefix) if scene_graph is None else Parser(plant, scene_graph, prefix)
        )
        parser.SetAutoRenaming(True)
        with captured_warnings() as warnings:
            try:
                instances = parser.AddModelsFromString(self.text, self.kind)
                for one, other, *how in self._couples:
                    follower, leader = (
                        plant.GetJointByName(name, instances[0]) for name in (one, other)
                    )
                    add_coupler(plant, follower, leader, *how)
            # Drake ends the process, which Python sees as SystemExit, at some values.
            except (RuntimeError, ValueError, SystemExit) as error:
                # SDFormat's reader says where in its error, and what in a warning before it.
                where = [text.split("Msg: ")[-1] for text in warnings if "Error" in text]
                # Some of Drake's messages hold whole files.
                text = "; ".join([*where, str(error).strip()])[:1000]
                text = self._name_originals(text, self.path.name)
                raise ModelError(
                    f"{self.path}: {text or 'Drake refuses this model without saying why'}"
                ) from error
        # Inertias play no role in what is seen.
        about_inertia = ("invalid inertia", "parsing inertia matrix", "as central inertia")
        remarks = [
            self._name_originals(warning, str(self.path))
            for warning in warnings
            if not any(mark in warning for mark in about_inertia)
        ]
        return list(instances), [*self.warnings, *remarks]

    def _sanitise(self, path: Path) -> tuple[str, str]:
        """The text that is parsed in place of a file, and the kind of it."""
        # What Drake's parser calls each kind of file.
        kinds = {".urdf": "urdf", ".sdf": "sdf", ".xml": "xml", ".mjcf": "xml"}
        kinds |= dict.fromkeys((".yaml", ".yml"), "dmd.yaml")
        kind = kinds.get(path.suffix.lower())
        if kind is None:
            what = "use .urdf, .sdf, .xml (MJCF) or .dmd.yaml"
            if path.suffix.lower() == ".xacro":
                what = f"expand it first: xacro {path.name} > {path.stem} (PyPI: xacro)"
            raise ModelError(
                f"model file {path}: '{path.suffix}' is not a kind of file that Drake's Parser "
                f"reads; {what}"
            )
        if path in self._under_way or len(self._under_way) > 20:
            raise ModelError(f"{path} includes itself")
        self._under_way.append(path)
        try:
            if kind == "urdf":
                text = sanitise_urdf(path, self._finder, self._warn)
            elif kind == "xml":
                text, couples = sanitise_mjcf(path, self._warn)
                if len(self._under_way) == 1:
                    self._couples = couples
                elif couples:
                    self._warn(f"{path}: joints of an included MJCF follow no others")
            elif kind == "sdf":
                text, limits = sanitise_sdf(path, self._finder, self._warn, self._stand_in)
                if len(self._under_way) == 1:
                    self.limits = limits
            else:
                text = _sanitise_directives(path, self._finder, self._stand_in)
            return text, kind
        except ModelError as error:
            reason = str(error)
            raise ModelError(reason if str(path) in reason else f"{path}: {reason}") from error
        finally:
            self._under_way.pop()

    def _stand_in(self, path: Path) -> Path:
        """A file with the cured text of another one."""
        path = path.resolve()
        if path not in self._stand_ins:
            text, kind = self._sanitise(path)
            folder = Path(tempfile.mkdtemp(prefix="model_", dir=workspace()))
            stand_in = folder / f"{path.name.partition('.')[0]}.{kind}"
            stand_in.write_text(text, encoding="utf-8")
            self._stand_ins[path] = stand_in
        return self._stand_ins[path]

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def _name_originals(self, text: str, where: str) -> str:
        """A message of Drake's with the files' own names; ``where`` is the main file's."""
        for path, stand_in in self._stand_ins.items():
            text = re.sub(re.escape(str(stand_in)) + r"(:\d+)?", str(path).replace("\\", "/"), text)
        # Lines are those of the cured text, which help nobody.
        return re.sub(
            r"<(literal|data)-string>(\.[\w.]+\w)?(:\d+)?", where.replace("\\", "/"), text
        )


def limit_kinds(warnings: Sequence[str], most: int = 10) -> list[str]:
    """Warnings, at most ten of those that differ in names and numbers alone, and their count."""
    by_kind: dict[str, list[str]] = {}
    for warning in warnings:
        kind = re.sub(r"'[^']*'|-?\d[\d.e+-]*", "", warning)
        by_kind.setdefault(kind, []).append(warning)
    shown = []
    for alike in by_kind.values():
        shown += alike[:most]
        if len(alike) > most:
            shown[-1] += f" ... and {len(alike) - most} more of this kind"
    return shown


@contextmanager
def captured_warnings() -> Iterator[list[str]]:
    """Collect what Drake logs meanwhile instead of printing it; each text once, in order."""
    texts: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        text = record.getMessage().strip()
        if record.levelno >= logging.WARNING and text not in texts:
            texts.append(text)
        return False

    logger = logging.getLogger("drake")
    logger.addFilter(collect)
    try:
        yield texts
    finally:
        logger.removeFilter(collect)


def _sanitise_directives(
    path: Path, finder: FileFinder, sanitise_file: Callable[[Path], Path]
) -> str:
    """The text of model directives, tags and aliases kept, that name the files' stand-ins."""
    try:
        node = top = yaml.compose(path.read_bytes(), Loader=yaml.SafeLoader)
    except OSError as error:
        raise ModelError(f"it cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ModelError(f"it is no YAML: {' '.join(str(error).split())}") from error
    except RecursionError:
        raise ModelError("it is nested too deeply") from None
    if node is None:
        raise ModelError("it is empty; expected 'directives:'")
    # The scalars that name a file, each once, and the directive that they belong to.
    waiting, seen = [("", node)], set()
    while waiting:
        directive, node = waiting.pop()
        if id(node) in seen or isinstance(node, yaml.ScalarNode):
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            waiting += [(directive, one) for one in reversed(node.value)]
            continue
        for key, value in node.value:
            if key.value != "file" or not isinstance(value, yaml.ScalarNode):
                waiting.append((directive if key.value == "<<" else key.value, value))
            elif id(value) not in seen:
                seen.add(id(value))
                found = finder.resolve(value.value, path, directive)
                value.value = f"file://{sanitise_file(found)}"
    return yaml.serialize(top, Dumper=yaml.SafeDumper, allow_unicode=True)


TIME_LIMIT_SECONDS = 60.0
MEMORY_LIMIT_BYTES = 2 * 2**30

Reader = Callable[[Path, Mapping[str, str], Mapping[str, tuple[float, float]]], Any]
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
def _check(read: Reader, path: str, packages: str, limits: str, _digest: str) -> None:
    """Raise why the model cannot be used; the digest only tells versions of the file apart."""
    try:
        try:
            # Where nothing but this thread runs, a fork lacks nothing; so on Linux alone.
            may_fork = len(os.listdir("/proc/self/task")) == 1
        except OSError:
            may_fork = False
        if may_fork and not multiprocessing.current_process().daemon:
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
    # It leaves at once: what a broken file left behind may crash on the way out.
    program = (
        "import json, os, sys\n"
        "from drake_pose.body.model import read_model\n"
        "from drake_pose.body.parsing import why_unusable\n"
        "print('\\n' + json.dumps(why_unusable(read_model, *sys.argv[1:])), flush=True)\n"
        "os._exit(0)"
    )
    folders = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
    try:
        end = subprocess.run(
            [sys.executable, "-c", program, path, packages, limits],
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join(filter(None, folders)),
                # With threads of its own VTK takes twice as long.
                "LP_NUM_THREADS": "0",
                # What it leaves when it ends is removed at this process's end.
                "TMPDIR": str(workspace()),
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
