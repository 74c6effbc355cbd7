"""Parsing of a model file into a Drake plant, after its text is sanitised and checked.

Every failure is a ModelError that names the file.
"""

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

from drake_pose.body.link_files import (
    Limits,
    MjcfCoupling,
    sanitise_mjcf,
    sanitise_sdf,
    sanitise_urdf,
)
from drake_pose.body.meshes import TriangleMesh, draws_given_files, read_meshes, workspace
from drake_pose.body.model_files import FileFinder
from drake_pose.body.plant_source import add_coupler
from drake_pose.errors import DrakePoseError, ModelError, weight_of, weighted


class ModelSource:
    """A model file and the sanitised text that Drake parses in its place.

    Attributes:
        kind: the file type that Drake's parser expects: "urdf", "sdf", "xml" or "dmd.yaml".
        warnings: parts of the file that are not read or not enforced, each once.
        limits: limits (lower, upper) [rad] by position name that Drake's parser does not read.

    Args:
        path: the model file.
        package_paths: folders by package name.

    Raises ModelError: the file is missing, unreadable, of an unknown type, or cannot be sanitised;
    the message names the file and the link, joint or mesh.
    """

    def __init__(self, path: Path, package_paths: Mapping[str, str]) -> None:
        if not path.exists():
            raise ModelError(f"model file {path} does not exist")
        if not path.is_file():
            raise ModelError(f"model file {path} is not a file")
        self.path = path
        self.warnings: list[str] = []
        self.limits: Limits = {}
        self._couplings: list[MjcfCoupling] = []
        self._finder = FileFinder(package_paths)
        self._copies: dict[Path, Path] = {}
        self._open_files: list[Path] = []
        self.text, self.kind = self._sanitise(path)

    def parse(
        self, plant: MultibodyPlant, scene_graph: SceneGraph | None, prefix: str = ""
    ) -> tuple[list[ModelInstanceIndex], list[str]]:
        """Add the model to a plant; return its model instances and the warnings about the file.

        ``plant``: a plant that is not finalized. ``scene_graph``: the SceneGraph to register the
        plant with; None: the plant is registered already or gets no geometry. ``prefix``: put
        before the model's name. Raises ModelError: Drake cannot read the model.
        """
        parser = (
            Parser(plant, prefix) if scene_graph is None else Parser(plant, scene_graph, prefix)
        )
        parser.SetAutoRenaming(True)
        with captured_warnings() as warnings:
            try:
                instances = parser.AddModelsFromString(self.text, self.kind)
                for follower_name, leader_name, *relation in self._couplings:
                    follower, leader = (
                        plant.GetJointByName(name, instances[0])
                        for name in (follower_name, leader_name)
                    )
                    add_coupler(plant, follower, leader, *relation)
            # Drake aborts on some invalid values, which Python sees as SystemExit.
            except (RuntimeError, ValueError, SystemExit) as error:
                # SDFormat's error names the place; a warning before it names the reason.
                where = [text.split("Msg: ")[-1] for text in warnings if "Error" in text]
                # Some of Drake's messages contain whole files.
                text = "; ".join([*where, str(error).strip()])[:1000]
                text = self._restore_names(text, self.path.name)
                raise ModelError(
                    f"{self.path}: {text or 'Drake refuses this model without a reason'}"
                ) from error
        # Inertias have no effect on silhouettes.
        about_inertia = ("invalid inertia", "parsing inertia matrix", "as central inertia")
        kept = [one for one in warnings if not any(mark in one for mark in about_inertia)]
        remarks = [self._restore_names(one, str(self.path)) for one in kept]
        return list(instances), [*self.warnings, *remarks]

    def _sanitise(self, path: Path) -> tuple[str, str]:
        """Return the text that Drake parses in place of a file, and its file type (``kind``).

        Raises ModelError: the file is of an unknown type, includes itself, or cannot be sanitised.
        """
        # The file type of each extension, by the name that Drake's parser has for it.
        kinds = {".urdf": "urdf", ".sdf": "sdf", ".xml": "xml", ".mjcf": "xml"}
        kinds |= dict.fromkeys((".yaml", ".yml"), "dmd.yaml")
        kind = kinds.get(path.suffix.lower())
        if kind is None:
            what = "use .urdf, .sdf, .xml (MJCF) or .dmd.yaml"
            if path.suffix.lower() == ".xacro":
                what = f"expand it first: xacro {path.name} > {path.stem} (PyPI: xacro)"
            raise ModelError(
                f"model file {path}: '{path.suffix}' is not a file type that Drake's Parser "
                f"reads; {what}"
            )
        if path in self._open_files or len(self._open_files) > 20:
            raise ModelError(f"{path} includes itself")
        self._open_files.append(path)
        try:
            if kind == "urdf":
                text = sanitise_urdf(path, self._finder, self._warn)
            elif kind == "xml":
                text, couplings = sanitise_mjcf(path, self._warn)
                if len(self._open_files) == 1:
                    self._couplings = couplings
                elif couplings:
                    self._warn(f"{path}: couplings of joints in an included MJCF are not enforced")
            elif kind == "sdf":
                text, limits = sanitise_sdf(path, self._finder, self._warn, self._sanitised_copy)
                if len(self._open_files) == 1:
                    self.limits = limits
            else:
                text = _sanitise_directives(path, self._finder, self._sanitised_copy)
            return text, kind
        except ModelError as error:
            reason = str(error)
            raise ModelError(reason if str(path) in reason else f"{path}: {reason}") from error
        finally:
            self._open_files.pop()

    def _sanitised_copy(self, path: Path) -> Path:
        """Return a temporary file with the sanitised text of another file; make it once."""
        path = path.resolve()
        if path not in self._copies:
            text, kind = self._sanitise(path)
            folder = Path(tempfile.mkdtemp(prefix="model_", dir=workspace()))
            copied = folder / f"{path.name.partition('.')[0]}.{kind}"
            copied.write_text(text, encoding="utf-8")
            self._copies[path] = copied
        return self._copies[path]

    def _warn(self, text: str) -> None:
        """Add a warning unless it is there already."""
        if text not in self.warnings:
            self.warnings.append(text)

    def _restore_names(self, text: str, where: str) -> str:
        """Return Drake's message ``text`` with original file names instead of sanitised copies'.

        ``where``: the name of the main file.
        """
        for path, copied in self._copies.items():
            text = re.sub(re.escape(str(copied)) + r"(:\d+)?", str(path).replace("\\", "/"), text)
        # Line numbers are left out: they count lines of the sanitised text.
        return re.sub(
            r"<(literal|data)-string>(\.[\w.]+\w)?(:\d+)?", where.replace("\\", "/"), text
        )


def summarise_warnings(warnings: Sequence[str], max_count: int = 10) -> list[str]:
    """Return the warnings, at most ``max_count`` of each kind; the last one counts those left out.

    Warnings are of one kind if they differ in quoted names and numbers only.
    """
    by_kind: dict[str, list[str]] = {}
    for warning in warnings:
        kind = re.sub(r"'[^']*'|-?\d[\d.e+-]*", "", warning)
        by_kind.setdefault(kind, []).append(warning)
    shown = []
    for alike in by_kind.values():
        shown += alike[:max_count]
        if len(alike) > max_count:
            more = f" ... and {len(alike) - max_count} more of this kind"
            shown[-1] = weighted(shown[-1] + more, weight_of(shown[-1]))
    return shown


@contextmanager
def captured_warnings() -> Iterator[list[str]]:
    """Collect Drake's log messages inside the context, each once, instead of printing them."""
    texts: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        """Store a warning's text; suppress all records."""
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
    """Return the text of model directives in which every file is replaced by its sanitised copy.

    YAML tags and aliases are kept.

    ``path``: the file of model directives. ``finder``: finds the files that it names.
    ``sanitise_file``: returns the path of a file's sanitised copy.
    """
    try:
        node = top = yaml.compose(path.read_bytes(), Loader=yaml.SafeLoader)
    except OSError as error:
        raise ModelError(f"it cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ModelError(f"it is not YAML: {' '.join(str(error).split())}") from error
    except RecursionError:
        raise ModelError("it is nested too deeply") from None
    if node is None:
        raise ModelError("it is empty; expected 'directives:'")
    # Visit each YAML node once, together with the directive that it belongs to.
    stack, visited = [("", node)], set()
    while stack:
        directive, node = stack.pop()
        if id(node) in visited or isinstance(node, yaml.ScalarNode):
            continue
        visited.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            stack += [(directive, item) for item in reversed(node.value)]
            continue
        for key, value in node.value:
            if key.value != "file" or not isinstance(value, yaml.ScalarNode):
                stack.append((directive if key.value == "<<" else key.value, value))
            elif id(value) not in visited:
                visited.add(id(value))
                found = finder.resolve(value.value, path, directive)
                value.value = f"file://{sanitise_file(found)}"
    return yaml.serialize(top, Dumper=yaml.SafeDumper, allow_unicode=True)


TIME_LIMIT_SECONDS = 60.0
"""Timeout for reading a model in a child process."""

MEMORY_LIMIT_BYTES = 2 * 2**30
"""Memory that a child process may take for reading a model."""

Reader = Callable[[Path, Mapping[str, str], Mapping[str, tuple[float, float]]], Any]
"""Reads a model from its path, package folders, and limits [rad or m] by position name."""


def check_in_child(
    read: Reader, path: Path, packages: Mapping[str, str], limits: Mapping[str, tuple[float, float]]
) -> None:
    """Read a model and prepare its rendering in a child process with a time and a memory limit.

    Drake 1.51 can crash on a broken glTF file, a texture, or a file that includes itself, and a
    YAML alias bomb takes all memory. Rendering is prepared only where the renderer reads given
    files: files written by this package are known to be drawable. A success is remembered for the
    same file content.

    A process of one thread forks the child, which then needs no imports; others start a new
    process.

    ``read``: reads the model; its results in the child are discarded, except meshes. ``path``: the
    model file. ``packages``, ``limits``: passed to ``read``. Raises ModelError: the model cannot be
    used, or reading crashed, timed out or took too much memory.
    """
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ModelError(f"model file {path} cannot be read: {error.strerror}") from error
    _check_cached(read, str(path), json.dumps(dict(packages)), json.dumps(dict(limits)), digest)


@functools.lru_cache(maxsize=64)
def _check_cached(read: Reader, path: str, packages: str, limits: str, _digest: str) -> None:
    """Raise ModelError as ``check_in_child``, unless the check passed before.

    ``packages``, ``limits``: mappings as for ``Reader``, as JSON. ``_digest``: keys the cache by
    file content.
    """
    try:
        try:
            # Forking is safe in a process of one thread; threads can be counted on Linux only.
            may_fork = len(os.listdir("/proc/self/task")) == 1
        except OSError:
            may_fork = False
        if may_fork and not multiprocessing.current_process().daemon:
            reason = _check_in_fork(read, path, packages, limits)
        else:
            reason = _check_in_subprocess(path, packages, limits)
    except TimeoutError:
        raise ModelError(
            f"{path}: reading takes more than {TIME_LIMIT_SECONDS:g} s; does it include itself?"
        ) from None
    except ChildProcessError as error:
        raise ModelError(
            f"{path}: reading {error}; this file or one that it names is broken, includes itself, "
            f"or needs more than {MEMORY_LIMIT_BYTES // 2**30} GiB of memory"
        ) from None
    if reason:
        raise ModelError(reason)


def why_unusable(read: Reader, path: str, packages: str, limits: str) -> str:
    """Return why a model cannot be used, or "" if it can; call it in a process that may crash.

    The process may take MEMORY_LIMIT_BYTES more memory afterwards, and leaves no core dump.

    Args:
        read: the function that reads the model.
        path: the model file.
        packages: package folders by name, as JSON.
        limits: limits [rad or m] by position name, as JSON.
    """
    with suppress(ImportError, ValueError, OSError):
        import resource  # Absent on Windows.

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY_LIMIT_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
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
        return f"{path}: reading needs more than {size} of memory; make its meshes smaller"
    return ""


def _check_in_fork(read: Reader, path: str, packages: str, limits: str) -> str:
    """Return ``why_unusable`` from a fork of this process, and keep the meshes that it read.

    The arguments are those of ``why_unusable``: packages and limits are JSON.

    Raises TimeoutError: the fork did not answer in time; ChildProcessError: the fork ended without
    an answer; the message says how.
    """
    fork = multiprocessing.get_context("fork")
    receiver, sender = fork.Pipe(duplex=False)
    # Made before the fork, so that this process removes what the fork writes there.
    workspace()
    with tempfile.TemporaryFile() as output:
        arguments = (sender, output.fileno(), read, path, packages, limits)
        child = fork.Process(target=_run_check, args=arguments)
        child.start()
        sender.close()
        try:
            if not receiver.poll(TIME_LIMIT_SECONDS):
                raise TimeoutError
            with suppress(EOFError):  # The fork died.
                reason, meshes = receiver.recv()
                read_meshes.update({file: TriangleMesh(*mesh) for file, mesh in meshes.items()})
                return str(reason)
        finally:
            receiver.close()
            child.kill()
            child.join()
        output.seek(0)
        text = output.read().decode("utf-8", "replace")
        raise ChildProcessError(_describe_exit(child.exitcode or 0, text))


def _run_check(
    sender: Connection, output: int, read: Reader, path: str, packages: str, limits: str
) -> None:
    """Send the result of ``why_unusable`` and the meshes that were read, then exit the fork.

    ``sender``: receives (reason, {file: (vertices, triangles)}). ``output``: descriptor of the file
    that takes standard output and standard error. ``read``, ``path``, ``packages``, ``limits``:
    arguments of ``why_unusable``.
    """
    faulthandler.disable()
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    reason = why_unusable(read, path, packages, limits)
    sender.send((reason, {f: (m.vertices, m.triangles) for f, m in read_meshes.items()}))
    os._exit(0)


def _check_in_subprocess(path: str, packages: str, limits: str) -> str:
    """As ``_check_in_fork``, in a new process: it takes longer, and meshes are not kept."""
    # os._exit skips clean-up, which may crash after a broken file.
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
                # VTK takes twice as long with several threads.
                "LP_NUM_THREADS": "0",
                # This process removes the child's temporary files at exit.
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
    lines = end.stdout.strip().splitlines()
    if end.returncode == 0 and lines:
        return str(json.loads(lines[-1]))
    raise ChildProcessError(_describe_exit(end.returncode, end.stderr))


def _describe_exit(status: int, output: str) -> str:
    """Return how a process ended that sent no answer.

    ``status``: its exit status, negative for a signal. ``output``: what it printed.
    """
    if status < 0:
        return f"crashed Drake ({signal.Signals(-status).name})"
    return f"failed ({(output.strip().splitlines() or [f'exit status {status}'])[-1]})"
