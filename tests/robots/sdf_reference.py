"""Where the links of an SDFormat 1.6 file stand at zero: as the file says, in the model's frame."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .references import Boxes, JointValue, Poses


class SdfReference:
    """One model of an SDFormat 1.6 file without nested models; no library but Drake's reads it."""

    def __init__(self, path: Path) -> None:
        self._root = ElementTree.parse(path).getroot()

    def poses(self, values: list[JointValue]) -> Poses:
        """At zero, the floating base where its joint has it."""
        found = {}
        for link in self._root.iter("link"):
            numbers = [float(word) for word in (link.findtext("pose") or "0 " * 6).split()]
            X = np.eye(4)
            X[:3, :3] = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
            X[:3, 3] = numbers[:3]
            found[link.get("name", "")] = X
        X_MB = np.eye(4)
        for joint in values:
            if joint.kind == "quaternion_floating":
                w, x, y, z, *position = joint.values
                X_MB[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
                X_MB[:3, 3] = position
                X_MB = X_MB @ np.linalg.inv(found[joint.link])
        return {name: X_MB @ X for name, X in found.items()}

    def limits(self) -> Mapping[str, tuple[float, float]]:
        found = {}
        for joint in self._root.iter("joint"):
            lower, upper = (joint.findtext(f"axis/limit/{side}") for side in ("lower", "upper"))
            if joint.get("type") in ("revolute", "prismatic") and lower and upper:
                found[joint.get("name", "")] = (float(lower), float(upper))
        return found

    def boxes(self) -> Boxes | None:
        return None
