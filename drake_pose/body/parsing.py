"""One model file into one Drake plant, with every failure turned into a ModelError."""

import logging
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_pose.body.mjcf import cure_mjcf, is_mjcf
from drake_pose.body.packages import package_map
from drake_pose.errors import ModelError

_EXTENSIONS = (".urdf", ".sdf", ".xml", ".mjcf", ".yaml", ".yml")


@dataclass(frozen=True)
class ModelSource:
    """A model file and, for MJCF, the cured text that is parsed in its place."""

    path: Path
    package_paths: Mapping[str, str]
    cured_text: str | None

    @staticmethod
    def open(path: Path, package_paths: Mapping[str, str]) -> "ModelSource":
        """Look at a file before Drake does.

        Raises:
            ModelError: missing, unreadable, of an unknown kind, or MJCF that cannot be cured.
        """
        if not path.exists():
            raise ModelError(f"model file {path} does not exist")
        if not path.is_file():
            raise ModelError(f"model file {path} is not a file")
        if path.suffix.lower() not in _EXTENSIONS:
            raise ModelError(
                f"model file {path}: '{path.suffix}' is not a kind of file that Drake's Parser "
                "reads; use .urdf, .sdf, .xml (MJCF) or .dmd.yaml"
            )
        try:
            with path.open("rb") as file:
                file.read(1)
        except OSError as error:
            raise ModelError(f"model file {path} cannot be read: {error.strerror}") from error
        cured_text = cure_mjcf(path) if is_mjcf(path) else None
        return ModelSource(path, package_paths, cured_text)

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
            The new model instances, and Drake's warnings.

        Raises:
            ModelError: Drake cannot read the model.
        """
        parser = (
            Parser(plant, prefix) if scene_graph is None else Parser(plant, scene_graph, prefix)
        )
        parser.SetAutoRenaming(True)
        parser.package_map().AddMap(package_map(self.package_paths))
        with captured_warnings() as warnings:
            try:
                if self.cured_text is None:
                    instances = parser.AddModels(self.path)
                else:
                    instances = parser.AddModelsFromString(self.cured_text, "xml")
            # Drake ends the process, which Python sees as SystemExit, on crossed limits.
            except (RuntimeError, ValueError, SystemExit) as error:
                raise ModelError(self._explain(str(error))) from error
        where = str(self.path)
        return list(instances), [_name_file(warning, where) for warning in warnings]

    def _explain(self, reason: str) -> str:
        """Why the file cannot be used, with the joint whose limits are at fault, if one is."""
        joint = find_bad_limits(self.path)
        if joint is not None:
            return f"{self.path}: {joint}"
        text = _name_file(reason, self.path.name)
        return f"{self.path}: {text or 'Drake refuses this model without saying why'}"


def _name_file(text: str, where: str) -> str:
    """Name the file instead of the text in memory, whose lines are those of the cured file."""
    return re.sub(r"<literal-string>\.\w+(:\d+)?", where, text)


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


def find_bad_limits(path: Path) -> str | None:
    """The first joint of a URDF, SDFormat or MJCF file whose limits are not a number or crossed.

    Returns:
        A sentence that names the joint, or None.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return None
    for joint in root.iter("joint"):
        for lower_text, upper_text in _limit_texts(joint):
            name = joint.get("name", "(unnamed)")
            try:
                lower, upper = float(lower_text), float(upper_text)
            except ValueError:
                return f"joint '{name}': limits '{lower_text}', '{upper_text}' are not numbers"
            if math.isnan(lower) or math.isnan(upper):
                return f"joint '{name}': a limit is NaN; give numbers, lower first"
            if lower > upper:
                return (
                    f"joint '{name}': lower limit {lower:g} is above upper limit {upper:g}; "
                    "exchange them"
                )
    return None


def _limit_texts(joint: ElementTree.Element) -> Iterator[tuple[str, str]]:
    """The (lower, upper) pairs written for a joint in URDF, SDFormat or MJCF."""
    for limit in joint.iter("limit"):
        lower = limit.get("lower") or limit.findtext("lower")
        upper = limit.get("upper") or limit.findtext("upper")
        if lower is not None and upper is not None:
            yield lower, upper
    values = joint.get("range", "").split()
    if len(values) == 2:
        yield values[0], values[1]


def unread_limits(path: Path) -> dict[str, tuple[float, float]]:
    """Limits of universal and screw joints of an SDFormat file, which Drake's parser passes over.

    Returns:
        (lower, upper) [rad] by position name.
    """
    if path.suffix.lower() != ".sdf":
        return {}
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return {}
    limits = {}
    suffixes = {"universal": (("axis", "_qx"), ("axis2", "_qy")), "screw": (("axis", ""),)}
    for joint in root.iter("joint"):
        for axis, suffix in suffixes.get(joint.get("type", ""), ()):
            lower, upper = (joint.findtext(f"{axis}/limit/{side}") for side in ("lower", "upper"))
            with suppress(ValueError, TypeError):
                limits[f"{joint.get('name')}{suffix}"] = (float(lower or ""), float(upper or ""))
    return limits


def count_mimic_joints(path: Path) -> int:
    """How many joints of a URDF or SDFormat file are written to follow another joint."""
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return 0
    return sum(1 for joint in root.iter("joint") for _ in joint.iter("mimic"))
