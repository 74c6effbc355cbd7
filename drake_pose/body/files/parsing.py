"""One model file into one Drake plant, with every failure turned into a ModelError."""

import logging
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_pose.body.files.curing import Curing
from drake_pose.body.files.xml_checks import read_limits
from drake_pose.errors import ModelError

_MOST_ALIKE = 10
# Names in quotes, and numbers.
_VARIABLE = re.compile(r"'[^']*'|-?\d[\d.e+-]*")
# Inertias play no role in what is seen.
_ABOUT_INERTIA = ("invalid inertia", "parsing inertia matrix", "as central inertia")
# Some of Drake's messages hold whole files.
_LONGEST_REASON = 1000


@dataclass(frozen=True)
class ModelSource:
    """A model file and the cured text that is parsed in its place.

    Attributes:
        path: the file.
        text: what Drake parses.
        kind: what Drake's parser calls that kind of text.
        warnings: what of the file is not read, or not enforced.
        limits: limits (lower, upper) [rad] by position name that Drake's parser passes over.
    """

    path: Path
    text: str
    kind: str
    warnings: tuple[str, ...]
    limits: Mapping[str, tuple[float, float]]
    _curing: Curing

    @staticmethod
    def open(path: Path, package_paths: Mapping[str, str]) -> "ModelSource":
        """Look at a file before Drake does.

        Raises:
            ModelError: missing, unreadable, of an unknown kind, or it cannot be cured; the message
                names link, joint or mesh.
        """
        if not path.exists():
            raise ModelError(f"model file {path} does not exist")
        if not path.is_file():
            raise ModelError(f"model file {path} is not a file")
        curing = Curing(package_paths)
        text, kind = curing.cure(path)
        return ModelSource(path, text, kind, tuple(curing.warnings), curing.limits, curing)

    def parse(
        self, plant: MultibodyPlant, scene_graph: SceneGraph | None, prefix: str = ""
    ) -> tuple[list[ModelInstanceIndex], list[str]]:
        """Add the model to a plant.

        Args:
            plant: a plant that is not finalized.
            scene_graph: the SceneGraph to register geometry with; None where the plant is
                registered already.
            prefix: put before the model's name.

        Returns:
            The new model instances, and what is worth knowing of the file, Drake's warnings among
            it.

        Raises:
            ModelError: Drake cannot read the model.
        """
        parser = (
            Parser(plant, prefix) if scene_graph is None else Parser(plant, scene_graph, prefix)
        )
        parser.SetAutoRenaming(True)
        with captured_warnings() as warnings:
            try:
                instances = parser.AddModelsFromString(self.text, self.kind)
            # Drake ends the process, which Python sees as SystemExit, at some values.
            except (RuntimeError, ValueError, SystemExit) as error:
                raise ModelError(self._explain(str(error), warnings)) from error
        where = str(self.path)
        remarks = [
            self._curing.name_originals(warning, where)
            for warning in warnings
            if not any(mark in warning for mark in _ABOUT_INERTIA)
        ]
        return list(instances), [*self.warnings, *remarks]

    def _explain(self, reason: str, warnings: list[str]) -> str:
        """Why the file cannot be used, with the joint whose limits are at fault, if one is."""
        if self.kind == "xml":
            joint = find_bad_limits(self.text)
            if joint is not None:
                return f"{self.path}: {joint}"
        # SDFormat's reader says where in its error, and what in a warning before it.
        remarks = [text.split("Msg: ")[-1] for text in warnings if "Error" in text]
        text = "; ".join([*remarks, reason.strip()])[:_LONGEST_REASON]
        text = self._curing.name_originals(text, self.path.name)
        return f"{self.path}: {text or 'Drake refuses this model without saying why'}"


def limit_kinds(warnings: Sequence[str]) -> list[str]:
    """Warnings of which those that differ in names and numbers alone are at most ten.

    The last of ten says how many more there are.
    """
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


def find_bad_limits(text: str) -> str | None:
    """The first joint of an MJCF file's text whose limits are not numbers or crossed.

    Returns:
        A sentence that names the joint, or None.
    """
    for joint in ElementTree.fromstring(text).iter("joint"):
        values = joint.get("range", "").split()
        if len(values) != 2:
            continue
        try:
            read_limits(values[0], values[1], joint.get("name", "(unnamed)"))
        except ModelError as error:
            return str(error)
    return None
