"""Reference link poses, limits and bounding boxes: pinocchio for URDF, MuJoCo for MJCF.

Inputs are Drake's positions by joint name; outputs are by link name. Conventions:

- pinocchio fixes a URDF's outermost link to its universe; Drake lets it float unless it is named
  "world". A floating base becomes pinocchio's free flyer (x y z, then the quaternion x y z w).
- pinocchio joins welded links into one body; every link is still a frame of type BODY.
- pinocchio describes a joint without limits by cosine and sine. ``mimic`` is off: every joint has
  its own value.
- MuJoCo's free joint is x y z, then the quaternion w x y z; Drake has the quaternion first. A hinge
  or slide has the same value in both. Drake's ball joint has roll, pitch and yaw, MuJoCo's a
  quaternion w x y z. An unnamed free joint is found by its body.
- A body with several joints becomes nested bodies in Drake. The innermost has MuJoCo's name; the
  others are not compared. Bodies without a name are body1, body2 ... in the order of the file.
- Visual geometry is pinocchio's visual geometry, and MuJoCo's geoms of groups 0 to 2 that are not
  fully transparent; planes and height fields are ground and left out.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from scipy.spatial.transform import Rotation

Poses = dict[str, NDArray[np.float64]]
Boxes = dict[str, NDArray[np.float64]]

# The default colour, which means that the material's colour counts (XMLreference, geom rgba).
_NO_COLOUR = (0.5, 0.5, 0.5, 1.0)


@dataclass(frozen=True)
class JointValue:
    """Values of one joint of Drake's plant; ``kind``: Drake's type, ``link``: its child link."""

    name: str
    kind: str
    link: str
    values: NDArray[np.float64]


def joint_values(plant: MultibodyPlant, q: NDArray[np.float64]) -> list[JointValue]:
    """Split q (nq,) by joints."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    return [
        JointValue(
            joint.name(),
            joint.type_name(),
            joint.child_body().name(),
            q[joint.position_start() :][: joint.num_positions()],
        )
        for joint in joints
        if joint.num_positions()
    ]


class PinocchioReference:
    """A URDF file as read by pinocchio."""

    def __init__(self, path: Path, *, floating: bool, packages: Path) -> None:
        import pinocchio

        self._pin: Any = pinocchio
        self._path, self._packages = path, packages
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

    def boxes(self) -> Boxes:
        pin, model = self._pin, self._model
        visual = pin.buildGeomFromUrdf(
            model, str(self._path), pin.GeometryType.VISUAL, package_dirs=[str(self._packages)]
        )
        boxes: dict[str, list[NDArray[np.float64]]] = {}
        for geometry in visual.geometryObjects:
            frame = model.frames[geometry.parentFrame]
            X_LG = (frame.placement.inverse() * geometry.placement).homogeneous
            boxes.setdefault(frame.name, []).append(_coal_box(geometry.geometry, X_LG))
        return {link: _joined(found) for link, found in boxes.items()}


def _coal_box(shape: Any, X_LG: NDArray[np.float64]) -> NDArray[np.float64]:
    """The bounding box (2, 3) of a shape of pinocchio's geometry library."""
    if hasattr(shape, "vertices"):
        return _points_box(np.asarray(shape.vertices()), X_LG)
    if hasattr(shape, "halfSide"):
        return _shape_box("box", np.asarray(shape.halfSide), X_LG)
    kind = type(shape).__name__.lower()
    return _shape_box(kind, np.array([shape.radius, getattr(shape, "halfLength", 0.0)]), X_LG)


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

    def boxes(self) -> Boxes:
        model, types = self._model, self._mujoco.mjtGeom
        boxes: dict[str, list[NDArray[np.float64]]] = {}
        for geom in range(model.ngeom):
            kind = types(model.geom_type[geom])
            material = model.geom_matid[geom]
            colour = model.geom_rgba[geom]
            if material >= 0 and np.allclose(colour, _NO_COLOUR):
                colour = model.mat_rgba[material]
            is_ground = kind in (types.mjGEOM_PLANE, types.mjGEOM_HFIELD)
            if is_ground or model.geom_group[geom] > 2 or colour[3] == 0.0:
                continue
            X_LG = np.eye(4)
            w, *xyz = model.geom_quat[geom]
            X_LG[:3, :3] = Rotation.from_quat([*xyz, w]).as_matrix()
            X_LG[:3, 3] = model.geom_pos[geom]
            if kind == types.mjGEOM_MESH:
                mesh = model.geom_dataid[geom]
                start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
                box = _points_box(model.mesh_vert[start : start + count], X_LG)
            else:
                name = kind.name.removeprefix("mjGEOM_").lower()
                box = _shape_box(name, model.geom_size[geom], X_LG)
            link = self._links[model.geom_bodyid[geom]]
            boxes.setdefault(link, []).append(box)
        return {link: _joined(found) for link, found in boxes.items()}


def _points_box(points: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
    """The bounding box (2, 3) of points (n, 3) after a rigid transform."""
    moved = points @ X[:3, :3].T + X[:3, 3]
    return np.array([moved.min(axis=0), moved.max(axis=0)])


def _shape_box(kind: str, size: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
    """The bounding box (2, 3) of a shape; ``size``: half lengths, or radius and half length."""
    R, axis = X[:3, :3], np.abs(X[:3, 2])
    if kind == "box":
        reach = np.abs(R) @ size[:3]
    elif kind == "ellipsoid":
        reach = np.linalg.norm(R * size[:3], axis=1)
    elif kind == "sphere":
        reach = np.full(3, size[0])
    elif kind == "capsule":
        reach = size[0] + axis * size[1]
    else:
        assert kind == "cylinder", kind
        reach = axis * size[1] + size[0] * np.sqrt(np.maximum(1.0 - axis**2, 0.0))
    return np.array([X[:3, 3] - reach, X[:3, 3] + reach])


def _joined(boxes: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """The box (2, 3) around boxes."""
    return np.array([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])


Reference = PinocchioReference | MujocoReference
