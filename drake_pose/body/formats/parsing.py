"""One model file, as a cured text, into one Drake plant; every failure is a ModelError."""

import copy
import logging
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import yaml
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_pose.body.formats.link_files import Limits, cure_sdf, cure_urdf
from drake_pose.body.formats.mjcf import Couple, cure_mjcf
from drake_pose.body.formats.packages import FileFinder
from drake_pose.body.plant_source import add_coupler
from drake_pose.body.surfaces.meshes import workspace
from drake_pose.errors import ModelError

# What Drake's parser calls each kind of file.
_KINDS = {
    ".urdf": "urdf",
    ".sdf": "sdf",
    ".xml": "xml",
    ".mjcf": "xml",
    ".yaml": "dmd.yaml",
    ".yml": "dmd.yaml",
}
_MAXIMUM_DEPTH = 20
_MOST_ALIKE = 10
# Names in quotes, and numbers.
_VARIABLE = re.compile(r"'[^']*'|-?\d[\d.e+-]*")
# Inertias play no role in what is seen.
_ABOUT_INERTIA = ("invalid inertia", "parsing inertia matrix", "as central inertia")
# Some of Drake's messages hold whole files.
_LONGEST_REASON = 1000


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
        self.text, self.kind = self._cure(path)

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
                raise ModelError(self._explain(str(error), warnings)) from error
        remarks = [
            self._name_originals(warning, str(self.path))
            for warning in warnings
            if not any(mark in warning for mark in _ABOUT_INERTIA)
        ]
        return list(instances), [*self.warnings, *remarks]

    def _cure(self, path: Path) -> tuple[str, str]:
        """The text that is parsed in place of a file, and the kind of it."""
        kind = _KINDS.get(path.suffix.lower())
        if kind is None:
            what = "use .urdf, .sdf, .xml (MJCF) or .dmd.yaml"
            if path.suffix.lower() == ".xacro":
                what = f"expand it first: xacro {path.name} > {path.stem} (PyPI: xacro)"
            raise ModelError(
                f"model file {path}: '{path.suffix}' is not a kind of file that Drake's Parser "
                f"reads; {what}"
            )
        if path in self._under_way or len(self._under_way) > _MAXIMUM_DEPTH:
            raise ModelError(f"{path} includes itself")
        self._under_way.append(path)
        try:
            if kind == "urdf":
                text = cure_urdf(path, self._finder, self._warn)
            elif kind == "xml":
                text, couples = cure_mjcf(path, self._warn)
                if len(self._under_way) == 1:
                    self._couples = couples
                elif couples:
                    self._warn(f"{path}: joints of an included MJCF follow no others")
            elif kind == "sdf":
                text, limits = cure_sdf(path, self._finder, self._warn, self._stand_in)
                if len(self._under_way) == 1:
                    self.limits = limits
            else:
                text = _cure_directives(path, self._finder, self._stand_in)
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
            text, kind = self._cure(path)
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

    def _explain(self, reason: str, warnings: list[str]) -> str:
        """Why the file cannot be used."""
        # SDFormat's reader says where in its error, and what in a warning before it.
        remarks = [text.split("Msg: ")[-1] for text in warnings if "Error" in text]
        text = "; ".join([*remarks, reason.strip()])[:_LONGEST_REASON]
        text = self._name_originals(text, self.path.name)
        return f"{self.path}: {text or 'Drake refuses this model without saying why'}"


def limit_kinds(warnings: Sequence[str]) -> list[str]:
    """Warnings, at most ten of those that differ in names and numbers alone, and their count."""
    by_kind: dict[str, list[str]] = {}
    for warning in warnings:
        by_kind.setdefault(_VARIABLE.sub("", warning), []).append(warning)
    shown = []
    for alike in by_kind.values():
        shown += alike[:_MOST_ALIKE]
        if len(alike) > _MOST_ALIKE:
            shown[-1] += f" ... and {len(alike) - _MOST_ALIKE} more of this kind"
    return shown


@contextmanager
def captured_warnings() -> Iterator[list[str]]:
    """Collect what Drake logs meanwhile instead of printing it; each text once, in order."""
    texts: list[str] = []

    class _Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            text = record.getMessage().strip()
            if text not in texts:
                texts.append(text)

    logger = logging.getLogger("drake")
    handlers, propagate = logger.handlers[:], logger.propagate
    logger.handlers, logger.propagate = [_Collector(level=logging.WARNING)], False
    try:
        yield texts
    finally:
        logger.handlers, logger.propagate = handlers, propagate


def _cure_directives(path: Path, finder: FileFinder, cure_file: Callable[[Path], Path]) -> str:
    """The text of model directives, tags and aliases kept, that name the files' stand-ins."""
    try:
        node = yaml.compose(path.read_bytes(), Loader=yaml.SafeLoader)
    except OSError as error:
        raise ModelError(f"it cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ModelError(f"it is no YAML: {' '.join(str(error).split())}") from error
    except RecursionError:
        raise ModelError("it is nested too deeply") from None
    if node is None:
        raise ModelError("it is empty; expected 'directives:'")
    for what, file in list(_files(node)):
        found = finder.resolve(file.value, path, what)
        file.value = f"file://{cure_file(found)}"
    return yaml.serialize(node, Dumper=yaml.SafeDumper, allow_unicode=True)


def _files(node: yaml.Node) -> Iterator[tuple[str, yaml.ScalarNode]]:
    """The scalars that name a file, each once, and the directive that they belong to."""
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
                yield directive, value
