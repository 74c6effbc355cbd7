"""Rotation of a pose tree's root, and recovery of the plant's base pose from the root's pose."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import Frame, JointIndex

from drake_pose.arrays import Array
from drake_pose.body.link_graph import (
    JointEdge,
    JointMap,
    LinkGraph,
    PlantKinematics,
    chain_transforms,
    inverse_transforms,
)
from drake_pose.body.parsed_model import ParsedModel, nearest_turn, one_turn
from drake_pose.errors import ModelError, SettingsError

Axis = Literal["x", "y", "z"]


@dataclass(frozen=True, eq=False)
class RootRotation:
    """The rotation R_WR of the root link R in the world W: fixed, limited or free.

    The rotation has k values. A fixed rotation has none. The values of a free rotation are a
    rotation vector r [rad], R_WR = R_W0 exp([r]x). The values of a limited rotation are one angle
    [rad] for each axis, R_WR = R_W0 R(axis 1) R(axis 2) ...

    Attributes:
        kind: "fixed", "free" or "limited".
        R_W0: (3, 3) rotation at values of zero, read-only.
        axes: the axes of a limited rotation, in order of rotation.
        lower, upper: (k,) limits [rad], read-only.
        interval: sampling interval [rad]; None: the search's own interval.
    """

    kind: Literal["fixed", "free", "limited"]
    R_W0: Array
    axes: tuple[Axis, ...]
    lower: Array
    upper: Array
    interval: float | None

    @staticmethod
    def fixed(rotation: ArrayLike | None = None) -> "RootRotation":
        """Return the constant rotation R_W0 (3, 3), by default the identity.

        Raises SettingsError: ``rotation`` is no rotation matrix.
        """
        return _root_rotation("fixed", (), [], rotation, None)

    @staticmethod
    def free(
        interval_deg: float | None = None, rotation: ArrayLike | None = None
    ) -> "RootRotation":
        """Return a free rotation, which a search samples evenly over SO(3).

        ``interval_deg``: sampling interval [deg]; None: the search's own interval. ``rotation``:
        R_W0 (3, 3), which is one of the samples; None: the identity.

        Raises SettingsError: ``rotation`` is no rotation matrix, or the interval is not positive.
        """
        return _root_rotation("free", (), [(-180.0, 180.0)] * 3, rotation, interval_deg)

    @staticmethod
    def limited(
        ranges_deg: Sequence[tuple[Axis, float, float]],
        *,
        rotation: ArrayLike | None = None,
        interval_deg: float | None = None,
    ) -> "RootRotation":
        """Return rotations about one to three different axes, each within limits.

        ``ranges_deg``: (axis letter, lower, upper) [deg] in order of rotation, for example ``[("y",
        -180, 180), ("z", -10, 10)]``. Each axis is rotated by the preceding ones. ``rotation``:
        R_W0 (3, 3); None: the identity. ``interval_deg``: sampling interval [deg]; None: the
        search's own interval.

        Raises SettingsError: axes are repeated or unknown, limits are crossed, or ``rotation`` is
        no rotation matrix.
        """
        axes = tuple(axis for axis, _, _ in ranges_deg)
        if not axes or len(set(axes)) != len(axes) or not set(axes) <= {"x", "y", "z"}:
            raise SettingsError(
                f"root rotation axes {axes}: give one to three different axes of x, y, z"
            )
        for axis, lower, upper in ranges_deg:
            if not -360.0 <= lower <= upper <= 360.0:
                raise SettingsError(
                    f"root rotation axis {axis}: limits {lower:g}, {upper:g}: give the lower first,"
                    " in degrees between -360 and 360"
                )
        limits = [(low, high) for _, low, high in ranges_deg]
        return _root_rotation("limited", axes, limits, rotation, interval_deg)

    @property
    def value_names(self) -> tuple[str, ...]:
        """The name of each value."""
        if self.kind == "free":
            return ("root_rotation_x", "root_rotation_y", "root_rotation_z")
        return tuple(f"root_{axis}" for axis in self.axes)

    def rotations(self, values: Array) -> Array:
        """Return R_WR (n, 3, 3) at values (n, k) [rad]."""
        from scipy.spatial.transform import Rotation  # Slow to import.

        if self.kind == "free":
            return self.R_W0 @ Rotation.from_rotvec(values).as_matrix()
        if self.kind == "limited":
            return self.R_W0 @ Rotation.from_euler("".join(self.axes).upper(), values).as_matrix()
        return np.broadcast_to(self.R_W0, (len(values), 3, 3)).copy()

    def values_from(self, R_WR: Array) -> Array:
        """Return the values (k,) [rad] of a rotation R_WR (3, 3).

        A limited rotation has the Euler angles of its axes, moved by full turns towards the middle
        of its limits. Components about other axes are dropped.
        """
        from scipy.spatial.transform import Rotation  # Slow to import.

        rotation = Rotation.from_matrix(self.R_W0.T @ R_WR)
        if self.kind == "fixed":
            return np.zeros(0)
        if self.kind == "free":
            return np.asarray(rotation.as_rotvec())
        sequence = "".join(self.axes).upper()
        completed = sequence + "".join(axis for axis in "XYZ" if axis not in sequence)
        angles = np.asarray(rotation.as_euler(completed))[: len(sequence)]
        middle = 0.5 * (self.lower + self.upper)
        return nearest_turn(angles, middle, True)


def _root_rotation(
    kind: Literal["fixed", "free", "limited"],
    axes: tuple[Axis, ...],
    limits_deg: Sequence[tuple[float, float]],
    rotation: ArrayLike | None,
    interval_deg: float | None,
) -> RootRotation:
    """Check the arguments and return a RootRotation with read-only copies of the arrays.

    ``limits_deg``: (lower, upper) [deg] of each value. ``rotation``: R_W0 (3, 3); None: the
    identity. ``interval_deg``: sampling interval [deg]; None: the search's own interval.
    """
    R = np.eye(3) if rotation is None else np.array(rotation, dtype=np.float64)
    orthonormal = R.shape == (3, 3) and np.allclose(R @ R.T, np.eye(3), atol=1e-6)
    if not orthonormal or np.linalg.det(R) < 0.0:
        raise SettingsError(f"root rotation {R.tolist()} is not a 3 x 3 rotation matrix")
    if interval_deg is not None and not 0.0 < interval_deg <= 180.0:
        raise SettingsError(
            f"root rotation interval {interval_deg:g} deg: give 0 < interval <= 180"
        )
    limits = np.radians(np.array(limits_deg, dtype=np.float64).reshape(-1, 2))
    for array in (R, limits):
        array.setflags(write=False)
    interval = None if interval_deg is None else math.radians(interval_deg)
    return RootRotation(kind, R, axes, limits[:, 0], limits[:, 1], interval)


def even_rotations(interval: float) -> Array:
    """Return rotation vectors (n, 3) [rad] about ``interval`` [rad] apart, sorted by angle.

    The rotations are Rz(azimuth) Ry(polar) Rz(spin - azimuth). Directions lie on circles of
    latitude, spins are evenly spaced, and the identity is the first sample.
    """
    from scipy.spatial.transform import Rotation  # Slow to import.

    angles = []
    spins = _full_turn(2.0 * math.pi / interval)
    circles = max(1, round(math.pi / interval))
    for polar in np.linspace(0.0, math.pi, circles + 1):
        for azimuth in _full_turn(2.0 * math.pi * math.sin(polar) / interval):
            angles += [(azimuth, polar, spin - azimuth) for spin in spins]
    vectors = np.asarray(Rotation.from_euler("ZYZ", np.array(angles)).as_rotvec())
    order = np.argsort(np.round(np.linalg.norm(vectors, axis=1), 9), kind="stable")
    return vectors[order]


def _full_turn(count: float) -> Array:
    """Return about ``count`` (at least one) evenly spaced angles [rad] of a turn, zero first."""
    whole = max(1, round(count))
    return np.asarray(np.arange(whole) * (2.0 * math.pi / whole), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class BasePose:
    """How the plant takes up the pose of a tree that does not start at the plant's world."""

    # "constant": the plant's world stands at X_WB. "floating": a floating joint takes up the pose.
    # "joints": base joints are solved for. "placed": X_WB is solved for, because the plant's world
    # is part of the tree or the base joints cannot reach every pose and keep their values.
    kind: Literal["constant", "floating", "joints", "placed"]
    # (4, 4) pose of the plant's world, for "constant".
    X_WB: Array = field(default_factory=lambda: np.eye(4))
    node: int = -1  # Index of the anchor, the tree's node from which the base is solved.
    body: int = 0  # Index of the plant's body of the anchor.
    positions: tuple[int, ...] = ()  # Indices in q of the base positions that are solved for.
    steps: tuple[JointMap, ...] = ()  # For "joints", the base joints from the world outwards.
    # For "joints", the indices of their positions in q; those not in ``positions`` are held.
    chain: tuple[int, ...] = ()
    joint: int = -1  # For "floating", the index of the floating joint.

    def solve(self, model: ParsedModel, q: Array, X_WN: Array) -> tuple[Array, Array]:
        """Complete the base positions in q (nq,) and return q and X_WB (4, 4).

        ``model``: the model whose plant has the positions q. ``q``: (nq,) the plant's positions
        [rad or m]; the base positions are overwritten. ``X_WN``: (nodes, 4, 4) poses of all nodes
        in the world. Raises ModelError: no values of the base joints reach the root's pose.
        """
        if self.kind == "constant":
            return q, np.array(self.X_WB)
        X_WA = X_WN[self.node]
        if self.kind == "joints":
            q[list(self.positions)] = self._solve_joints(model, q, X_WA)
            return q, np.eye(4)
        kinematics = PlantKinematics(model)
        if self.kind == "placed":
            return q, X_WA @ inverse_transforms(kinematics.pose_at(self.body, q))
        # The floating joint puts the anchor body A at X_WA. Drake's type stubs lack SetPose and do
        # not accept numpy's array types.
        joint: Any = kinematics.plant.get_joint(JointIndex(self.joint))
        child = int(joint.child_body().index())
        X_CA = inverse_transforms(kinematics.pose_at(child, q)) @ kinematics.pose_at(self.body, q)
        X_WF = kinematics.pose_at(int(joint.parent_body().index()), q) @ _pose_in_body(
            joint.frame_on_parent()
        )
        X_WM = X_WA @ inverse_transforms(X_CA) @ _pose_in_body(joint.frame_on_child())
        X_FM: Any = inverse_transforms(X_WF) @ X_WM
        # Remove rounding errors.
        R_FM = RotationMatrix.ProjectToRotationMatrix(X_FM[:3, :3])
        joint.SetPose(kinematics.context, RigidTransform(R_FM, X_FM[:3, 3]))
        solved = kinematics.plant.GetPositions(kinematics.context)
        q[list(self.positions)] = solved[list(self.positions)]
        return q, np.eye(4)

    def _solve_joints(self, model: ParsedModel, q: Array, X_WA: Array) -> Array:
        """Return the base positions (n,) [rad or m] that put the anchor at X_WA (4, 4).

        They are within the limits if possible. q (nq,) holds the start and the held positions.
        """
        from scipy.optimize import least_squares  # Slow to import.

        index = list(self.positions)
        periodic = model.periodic[index]
        lower, upper = model.lower[index], model.upper[index]
        middle = np.mean(one_turn(lower, upper, model.default_positions[index]), axis=0)
        is_angle = np.array([model.position_kinds[i] == "angle" for i in index])

        solved = np.isin(self.chain, index)

        def completed(values: Array) -> Array:
            """Return the values of the whole chain, given the solved ones."""
            all_values = q[list(self.chain)]
            all_values[solved] = values
            return all_values

        def residual(values: Array) -> Array:
            """Return the error (12,) of the anchor's pose."""
            return (chain_transforms(self.steps, completed(values)[None])[0] - X_WA)[:3].reshape(12)

        def jacobian(values: Array) -> Array:
            """Return the derivative (12, n) of the error."""
            return chain_jacobian(self.steps, completed(values))[:, solved]

        # Three rotations reach an orientation in two ways; random starts find the one in limits.
        random = np.random.default_rng(0)
        starts = [q[index]] + [
            np.where(is_angle, random.uniform(-np.pi, np.pi, len(index)), q[index])
            for _ in range(8)
        ]
        outside_limits = None
        for start in starts:
            found = least_squares(
                residual, start, jacobian, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15
            )
            if np.abs(found.fun).max() > 1e-10:
                continue
            wrapped = nearest_turn(found.x, middle, periodic)
            if np.all((wrapped >= lower - 1e-9) & (wrapped <= upper + 1e-9)):
                return wrapped
            outside_limits = wrapped if outside_limits is None else outside_limits
        if outside_limits is None:
            raise ModelError(
                f"{model.path}: no values of the base joints "
                f"{[model.position_names[i] for i in index]} reach the root's pose"
            )
        return outside_limits


def chain_jacobian(steps: Sequence[JointMap], values: Array) -> Array:
    """Return the derivative (12, k) of a chain's end pose (upper rows) by positions, exactly."""
    step = 1e-30
    change = chain_transforms(steps, values + 1j * step * np.eye(len(values))).imag / step
    return np.asarray(change[:, :3].reshape(len(values), 12).T, dtype=np.float64)


def base_of_chain(
    model: ParsedModel,
    graph: LinkGraph,
    chain: list[JointEdge],
    node: int,
    held: Collection[int] = (),
) -> BasePose:
    """Return how the joints from the world outwards to a node take up that node's pose.

    They do by a floating joint if there is one, else by base joints if these are at most twelve
    positions that can move the node in six degrees of freedom; else the plant's world is placed.

    Args:
        graph: the model's link graph.
        chain: the joints from the world outwards to the node.
        node: index of the node in the tree.
        held: indices in q of positions that keep their values if the others can reach every pose.
    """
    body = graph.groups[chain[-1].outer].body if chain else graph.groups[0].body
    floating = [edge for edge in chain if edge.joint_map is None]
    if floating:
        edge = floating[0]
        return BasePose(
            "floating", node=node, body=body, positions=edge.positions, joint=edge.joint
        )
    positions = tuple(position for edge in chain for position in edge.positions)
    steps = tuple(e.joint_map for e in chain if e.joint_map is not None)
    values = model.default_positions[list(positions)] + 0.1
    if len(positions) <= 12:
        slopes = chain_jacobian(steps, values)
        for solved in (~np.isin(positions, list(held)), np.ones(len(positions), dtype=np.bool_)):
            if np.linalg.matrix_rank(slopes[:, solved], tol=1e-5) >= 6:
                solved_positions = tuple(
                    p for p, solvable in zip(positions, solved, strict=True) if solvable
                )
                return BasePose(
                    "joints", node=node, body=body, positions=solved_positions, steps=steps,
                    chain=positions,
                )  # fmt: skip
    return BasePose("placed", node=node, body=body)


def _pose_in_body(frame: Frame) -> Array:
    """Return a fixed frame's pose (4, 4) in its body."""
    return np.asarray(frame.GetFixedPoseInBodyFrame().GetAsMatrix4())
