"""Robot models of PyPI packages, against pinocchio (URDF) and MuJoCo (MJCF).

Conventions:

- pinocchio fixes a URDF's outermost link to its universe; Drake lets it float unless it is named
  "world". A floating base becomes pinocchio's free flyer (x y z, then the quaternion x y z w).
- pinocchio describes a joint without limits by cosine and sine. ``mimic`` is off: every joint has
  its own value.
- MuJoCo's free joint is x y z, then the quaternion w x y z; Drake has the quaternion first. A hinge
  or slide has the same value in both. Drake's ball joint has roll, pitch and yaw, MuJoCo's a
  quaternion w x y z. An unnamed free joint is found by its body.
- A body with several joints becomes nested bodies in Drake. The innermost has MuJoCo's name; the
  others are not compared. Bodies without a name are body1, body2 ... in the order of the file.
"""

import csv
import itertools
import re
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from scipy.spatial.transform import Rotation

from drake_pose.body import ArticulatedModel, PoseTree, load_model
from drake_pose.errors import ModelError
from tests.body.models import link_poses

# Folder of each package's models, relative to its installation.
_FOLDERS = {
    "example-robot-data": "cmeel.prefix/share/example-robot-data/robots",
    "dm-control": "dm_control",
}
_MODEL_FILES = ("*.urdf", "*.sdf", "*.xml", "*.mjcf")
# Raw C++ or Python errors, which no message may contain.
_RAW = re.compile(r"condition '|failed\.$|Failure at|assert|Traceback|\.cc:", re.IGNORECASE)


class Row(NamedTuple):
    """A row of models.csv."""

    package: str  # PyPI's name of the package.
    file: str  # The model file in the package's folder of models.
    # "yes"; "no": the file has no visual geometry, or is no model; "missing": it names files that
    # the package lacks, or that the reference library refuses, too.
    geometry: str
    verdict: str  # "fit", or part of the error message.

    @property
    def path(self) -> Path:
        """The installed file; skips the test if the package is not installed."""
        path = package_folder(self.package) / self.file
        assert path.is_file(), f"{path} is in the table, but not in the package"
        return path


with (Path(__file__).parent / "models.csv").open(encoding="utf-8", newline="") as file:
    TABLE = [Row(**line) for line in csv.DictReader(file)]


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


Poses = dict[str, NDArray[np.float64]]


class JointValue(NamedTuple):
    """Values of one joint of Drake's plant; ``kind``: Drake's type, ``link``: its child link."""

    name: str
    kind: str
    link: str
    values: NDArray[np.float64]


def joint_values(plant: MultibodyPlant, q: NDArray[np.float64]) -> list[JointValue]:
    """Split q (nq,) by joints."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    parts = [q[joint.position_start() :][: joint.num_positions()] for joint in joints]
    return [
        JointValue(joint.name(), joint.type_name(), joint.child_body().name(), own)
        for joint, own in zip(joints, parts, strict=True)
        if joint.num_positions()
    ]


class PinocchioReference:
    """A URDF file as read by pinocchio."""

    def __init__(self, path: Path, *, floating: bool) -> None:
        import pinocchio

        self._pin: Any = pinocchio
        root = (pinocchio.JointModelFreeFlyer(),) if floating else ()
        self._model = pinocchio.buildModelFromUrdf(str(path), *root)
        self._data = self._model.createData()

    def poses(self, values: list[JointValue]) -> Poses:
        pin, model = self._pin, self._model
        q = pin.neutral(model)
        for joint in values:
            is_root = joint.kind == "quaternion_floating"
            entry = model.joints[1 if is_root else model.getJointId(joint.name)]
            start = entry.idx_q
            if is_root:
                w, x, y, z, *position = joint.values
                q[start : start + 7] = [*position, x, y, z, w]
            elif entry.nq == 2:
                q[start : start + 2] = np.cos(joint.values[0]), np.sin(joint.values[0])
            else:
                assert entry.nq == len(joint.values), joint
                q[start : start + entry.nq] = joint.values
        pin.framesForwardKinematics(model, self._data, q)
        return {
            frame.name: self._data.oMf[index].homogeneous.copy()
            for index, frame in enumerate(model.frames)
            if frame.type == pin.FrameType.BODY
        }

    def limits(self) -> Mapping[str, tuple[float, float]]:
        model = self._model
        joints = [(name, model.joints[i]) for i, name in enumerate(model.names) if i > 0]
        return {
            name: (
                float(model.lowerPositionLimit[joint.idx_q]),
                float(model.upperPositionLimit[joint.idx_q]),
            )
            for name, joint in joints
            if joint.nq == 1
        }


class MujocoReference:
    """An MJCF file as read by MuJoCo."""

    def __init__(self, path: Path) -> None:
        import mujoco

        self._mujoco: Any = mujoco
        self._model = mujoco.MjModel.from_xml_path(str(path))
        self._data = mujoco.MjData(self._model)
        numbers = itertools.count(1)
        names = [self._model.body(body).name for body in range(self._model.nbody)]
        self._links = [name or f"body{next(numbers)}" for name in names]

    def poses(self, values: list[JointValue]) -> Poses:
        model, data = self._model, self._data
        for joint in values:
            floats = joint.kind == "quaternion_floating"
            if floats:
                index = model.body_jntadr[self._links.index(joint.link)]
            else:
                index = model.joint(joint.name).id
            start = model.jnt_qposadr[index]
            if floats:
                data.qpos[start : start + 7] = np.roll(joint.values, 3)
            elif joint.kind == "ball_rpy":
                quaternion = Rotation.from_euler("xyz", joint.values).as_quat()
                data.qpos[start : start + 4] = np.roll(quaternion, 1)
            else:
                data.qpos[start : start + 1] = joint.values
        self._mujoco.mj_kinematics(model, data)
        found = {}
        for body in range(1, model.nbody):
            X = np.eye(4)
            X[:3, :3], X[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            found[self._links[body]] = X
        return found

    def limits(self) -> Mapping[str, tuple[float, float]]:
        model = self._model
        return {
            model.joint(i).name: tuple(model.jnt_range[i])
            for i in range(model.njnt)
            if model.jnt_limited[i] and model.jnt_type[i] >= 2
        }


Reference = PinocchioReference | MujocoReference


@pytest.mark.parametrize("row", [pytest.param(row, id=row.file) for row in TABLE])
def test_model_matches_reference_or_is_refused_with_reason(row: Row) -> None:
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


def reference_of(model: ArticulatedModel) -> Reference:
    """The same file as read by the reference library."""
    if model.path.suffix != ".urdf":
        return MujocoReference(model.path)
    plant = model.plant
    kinds = [plant.get_joint(index).type_name() for index in plant.GetJointIndices()]
    return PinocchioReference(model.path, floating="quaternion_floating" in kinds)


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
    for _ in range(3):
        q = random_positions(model, random)
        for index, value in tree.held.items():
            q[index] = value
        expected = reference.poses(joint_values(model.plant, q))
        expected.setdefault("world", np.eye(4))
        ours = link_poses(model, q)
        missing = set(expected) - set(model.link_names)
        assert not missing, f"links that the reference has: {missing}"
        for link in expected.keys() & ours.keys():
            np.testing.assert_allclose(ours[link], expected[link], atol=1e-9, err_msg=link)
        check_tree(tree, q, expected)


def check_tree(tree: PoseTree, q: NDArray[np.float64], expected: Poses) -> None:
    """Compare the poses of the tree's nodes, each relative to its root."""
    X_WN = tree.node_poses(tree.values_from_positions(q))
    roots: list[int] = []
    for index, (node, X) in enumerate(zip(tree.nodes, X_WN, strict=True)):
        roots.append(index if node.parent < 0 else roots[node.parent])
        root = roots[index]
        if node.name in expected and tree.nodes[root].name in expected:
            X_RN = np.linalg.inv(expected[tree.nodes[root].name]) @ expected[node.name]
            found = np.linalg.inv(X_WN[root]) @ X
            np.testing.assert_allclose(found, X_RN, atol=1e-9, err_msg=node.name)


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


@pytest.mark.parametrize("package", _FOLDERS)
def test_table_lists_every_model_file(package: str) -> None:
    folder = package_folder(package)
    found = [path for kind in _MODEL_FILES for path in folder.rglob(kind)]
    listed = sorted(row.file for row in TABLE if row.package == package)
    assert sorted(path.relative_to(folder).as_posix() for path in found) == listed
