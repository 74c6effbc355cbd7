"""Where the links of an SDFormat 1.6 file are, straight from the format's specification.

A link's <pose> is in the model's frame, a joint's in its child's; an axis is in the joint's frame,
or in the model's where <use_parent_model_frame> says so. A joint moves its child about or along the
axis through the joint's origin. No package of PyPI reads SDFormat beside Drake, so this is here.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .references import Boxes, JointValue, Poses


def _transform(rotation: Rotation, position: NDArray[np.float64]) -> NDArray[np.float64]:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rotation.as_matrix(), position
    return X


def _numbers(element: ElementTree.Element, name: str, default: str) -> NDArray[np.float64]:
    return np.array([float(word) for word in (element.findtext(name) or default).split()])


def _pose(element: ElementTree.Element) -> NDArray[np.float64]:
    values = _numbers(element, "pose", "0 0 0 0 0 0")
    return _transform(Rotation.from_euler("xyz", values[3:]), values[:3])


class SdfReference:
    """One model of an SDFormat 1.6 file without nested models."""

    def __init__(self, path: Path) -> None:
        model = ElementTree.parse(path).getroot().find("model")
        assert model is not None
        self._X_ML = {"world": np.eye(4)}
        self._X_ML |= {link.get("name", ""): _pose(link) for link in model.iter("link")}
        self._joints = {joint.get("name", ""): joint for joint in model.iter("joint")}

    def poses(self, values: list[JointValue]) -> Poses:
        found: Poses = {"world": np.eye(4)}
        steps = []
        for joint in values:
            if joint.kind == "quaternion_floating":
                w, x, y, z, *position = joint.values
                rotation = Rotation.from_quat([x, y, z, w])
                found[joint.link] = _transform(rotation, np.array(position))
            else:
                steps.append(self._step(joint))
        steps += [self._fixed(element) for element in self._joints.values()]
        for _ in range(len(steps)):
            for parent, child, X_PC in steps:
                if parent in found and child not in found:
                    found[child] = found[parent] @ X_PC
        return found

    def _step(self, joint: JointValue) -> tuple[str, str, NDArray[np.float64]]:
        """Parent, child, and the child's pose in the parent."""
        element = self._joints[joint.name]
        parent, child = element.findtext("parent", ""), element.findtext("child", "")
        X_CJ = _pose(element)
        if joint.kind == "ball_rpy":
            X_move = _transform(Rotation.from_euler("xyz", joint.values), np.zeros(3))
        elif joint.kind == "prismatic":
            X_move = _transform(Rotation.identity(), self._axis(element) * joint.values[0])
        else:
            assert joint.kind == "revolute", joint
            turn = Rotation.from_rotvec(self._axis(element) * joint.values[0])
            X_move = _transform(turn, np.zeros(3))
        X_PC = np.linalg.inv(self._X_ML[parent]) @ self._X_ML[child]
        return parent, child, X_PC @ X_CJ @ X_move @ np.linalg.inv(X_CJ)

    def _axis(self, joint: ElementTree.Element) -> NDArray[np.float64]:
        """The joint's axis (3,) in the joint's frame."""
        element = joint.find("axis")
        assert element is not None
        axis = _numbers(element, "xyz", "0 0 1")
        if element.findtext("use_parent_model_frame") in ("1", "true"):
            X_MJ = self._X_ML[joint.findtext("child", "")] @ _pose(joint)
            axis = X_MJ[:3, :3].T @ axis
        return axis / np.linalg.norm(axis)

    def _fixed(self, joint: ElementTree.Element) -> tuple[str, str, NDArray[np.float64]]:
        """As _step, for a joint that does not move; others go nowhere."""
        parent, child = joint.findtext("parent", ""), joint.findtext("child", "")
        if joint.get("type") != "fixed":
            return "", child, np.eye(4)
        return parent, child, np.linalg.inv(self._X_ML[parent]) @ self._X_ML[child]

    def limits(self) -> Mapping[str, tuple[float, float]]:
        found = {}
        for name, joint in self._joints.items():
            lower, upper = (joint.findtext(f"axis/limit/{side}") for side in ("lower", "upper"))
            if joint.get("type") in ("revolute", "prismatic") and lower and upper:
                found[name] = (float(lower), float(upper))
        return found

    def boxes(self) -> Boxes | None:
        return None
