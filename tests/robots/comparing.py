"""Comparison of robot models from PyPI packages with other libraries' reading of them."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drake_pose.body import ArticulatedModel, PoseTree, load_model
from drake_pose.errors import ModelError
from tests.body.models import link_poses
from tests.robots.references import (
    MujocoReference,
    PinocchioReference,
    Poses,
    Reference,
    joint_values,
)

POSE_TOLERANCE = 1e-9
# Triangulated balls are smaller by at most half a percent.
BOX_TOLERANCE, BOX_PART = 1e-3, 0.005
# Bounding boxes are compared for smaller models only, because reading meshes again is slow.
MOST_TRIANGLES_FOR_BOXES = 40_000
DRAWS = 3

# Folder of each package's models, relative to its installation.
_FOLDERS = {
    "example-robot-data": "cmeel.prefix/share/example-robot-data/robots",
    "dm-control": "dm_control",
}
_MODEL_FILES = ("*.urdf", "*.sdf", "*.xml", "*.mjcf")
# Raw C++ or Python errors, which no message may contain.
_RAW = re.compile(r"condition '|failed\.$|Failure at|assert|Traceback|\.cc:", re.IGNORECASE)


@dataclass(frozen=True)
class Row:
    """A row of models.csv.

    Attributes:
        package: PyPI's name of the package.
        file: the model file in the package's folder of models.
        geometry: "yes"; "no": the file has no visual geometry, or is no model; "missing": it names
            files that the package lacks, or that the reference library refuses, too.
        verdict: "fit", or part of the error message.
    """

    package: str
    file: str
    geometry: str
    verdict: str

    @property
    def path(self) -> Path:
        """The installed file; skips the test if the package is not installed."""
        path = package_folder(self.package) / self.file
        assert path.is_file(), f"{path} is in the table, but not in the package"
        return path


def rows(*packages: str) -> list[Row]:
    """The rows of some packages."""
    with (Path(__file__).parent / "models.csv").open(encoding="utf-8", newline="") as file:
        table = [Row(**line) for line in csv.DictReader(file)]
    return [row for row in table if row.package in packages]


def cases(table: Sequence[Row]) -> list[object]:
    """One test case per row."""
    return [pytest.param(row, id=row.file) for row in table]


def package_folder(package: str) -> Path:
    """The folder of a package's models; skips the test if it is not installed."""
    for needed in (package, "pin", "mujoco"):
        try:
            found = metadata.distribution(needed)
        except metadata.PackageNotFoundError:
            pytest.skip(f"{needed} is not installed: `make robots` installs it")
        if needed == package:
            folder = Path(str(found.locate_file(_FOLDERS[package])))
    return folder


def model_files(package: str) -> list[str]:
    """All files of a package that could be models."""
    folder = package_folder(package)
    found = [path for kind in _MODEL_FILES for path in folder.rglob(kind)]
    return sorted(path.relative_to(folder).as_posix() for path in found)


def check_verdict(row: Row) -> None:
    """Read a model, and compare it with the reference library, or check the error message."""
    path = row.path
    if row.verdict != "fit":
        with pytest.raises(ModelError) as refusal:
            load_model(path, check=False).pose_tree()
        message = str(refusal.value)
        assert path.name in message
        assert row.verdict in message
        assert not _RAW.search(message), message
        return
    model = load_model(path, check=False)
    tree = model.pose_tree()
    if path.suffix == ".sdf":
        # No library but Drake's reads it.
        q = random_positions(model, np.random.default_rng(11))
        check_tree(tree, q, link_poses(model, q))
        return
    reference = reference_of(model)
    check_poses(model, tree, reference)
    check_limits(model, reference)
    if sum(len(mesh.triangles) for mesh in model.link_meshes.values()) < MOST_TRIANGLES_FOR_BOXES:
        check_boxes(model, reference)


def reference_of(model: ArticulatedModel) -> Reference:
    """The same file as read by the reference library."""
    if model.path.suffix != ".urdf":
        return MujocoReference(model.path)
    plant = model.plant
    kinds = [plant.get_joint(index).type_name() for index in plant.GetJointIndices()]
    folder = package_folder("example-robot-data").parents[1]
    return PinocchioReference(model.path, floating="quaternion_floating" in kinds, packages=folder)


def random_positions(model: ArticulatedModel, random: np.random.Generator) -> NDArray[np.float64]:
    """Positions (nq,) inside finite limits, else within 1 m or 1 rad; quaternions are arbitrary."""
    limited = model.upper - model.lower < 1e3
    q = random.uniform(np.where(limited, model.lower, -1.0), np.where(limited, model.upper, 1.0))
    quaternions = np.flatnonzero([kind == "quaternion" for kind in model.position_kinds])
    for start in quaternions[::4]:
        q[start : start + 4] = random.normal(size=4)
        q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    for follower, leader, multiplier, offset in model.couplings:
        q[follower] = multiplier * q[leader] + offset
    return q


def check_poses(model: ArticulatedModel, tree: PoseTree, reference: Reference) -> None:
    """Compare the poses of all links and of the pose tree's nodes."""
    random = np.random.default_rng(11)
    for _ in range(DRAWS):
        q = random_positions(model, random)
        for index, value in tree.held.items():
            q[index] = value
        expected = reference.poses(joint_values(model.plant, q))
        expected.setdefault("world", np.eye(4))
        ours = link_poses(model, q)
        missing = set(expected) - set(model.link_names)
        assert not missing, f"links that the reference has: {missing}"
        for link in expected.keys() & ours.keys():
            np.testing.assert_allclose(
                ours[link], expected[link], atol=POSE_TOLERANCE, err_msg=link
            )
        check_tree(tree, q, expected)


def check_tree(tree: PoseTree, q: NDArray[np.float64], expected: Poses) -> None:
    """Compare the poses of the tree's nodes, each relative to its root."""
    X_WN = tree.node_poses(tree.values_from_positions(q))
    roots: list[int] = []
    for index, (node, X) in enumerate(zip(tree.nodes, X_WN, strict=True)):
        roots.append(index if node.parent < 0 else roots[node.parent])
        root = roots[index]
        if node.name in expected and tree.nodes[root].name in expected:
            np.testing.assert_allclose(
                np.linalg.inv(X_WN[root]) @ X,
                np.linalg.inv(expected[tree.nodes[root].name]) @ expected[node.name],
                atol=POSE_TOLERANCE,
                err_msg=node.name,
            )


def check_limits(model: ArticulatedModel, reference: Reference) -> None:
    """Compare limits; limits wider than four turns count as none."""
    for name, (lower, upper) in reference.limits().items():
        if name not in model.position_names:
            # For example a joint that closes a loop of links.
            assert any(f"'{name}'" in warning for warning in model.warnings), name
            continue
        index = model.position_index(name)
        if lower == upper or upper - lower > 8.0 * np.pi:
            continue
        if any(index == one.follower for one in model.couplings):
            continue
        if any(index == one.leader for one in model.couplings):
            lower, upper = max(lower, model.lower[index]), min(upper, model.upper[index])
        np.testing.assert_allclose(
            (model.lower[index], model.upper[index]), (lower, upper), atol=1e-9, err_msg=name
        )


def check_boxes(model: ArticulatedModel, reference: Reference) -> None:
    """Compare the bounding boxes of each link's visual geometry."""
    expected = reference.boxes()
    assert set(model.link_meshes) == set(expected)
    for link, mesh in model.link_meshes.items():
        box = np.array([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
        tolerance = BOX_TOLERANCE + BOX_PART * np.ptp(expected[link], axis=0).max()
        np.testing.assert_allclose(box, expected[link], atol=tolerance, err_msg=link)
