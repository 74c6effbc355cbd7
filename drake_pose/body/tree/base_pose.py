"""The plant's base: which base positions, or which pose of the plant, put the root where it is."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame, JointIndex
from scipy.optimize import least_squares

from drake_pose.body.limits import nearest_turn, one_turn
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.tree.joint_map import ChainStep, chain_transforms, inverse_transforms
from drake_pose.body.tree.link_graph import JointEdge, LinkGraph, PlantKinematics
from drake_pose.errors import ModelError

_EXACT = 1e-10
# Three turns reach a rotation in two ways, so a few starts find the one inside the limits.
_RANDOM_STARTS = 8
_COMPLEX_STEP = 1e-30


@dataclass(frozen=True, eq=False)
class BasePose:
    """What takes up the pose of a pose tree that does not start at the plant's world.

    Attributes:
        kind: "constant": the plant stands at X_WB; "floating": a floating joint takes the pose;
            "joints": base joints are solved for; "placed": X_WB moves, for the plant's world is
            part of the tree, or base joints cannot reach every pose and keep their values.
        X_WB: (4, 4) for "constant".
        node: the tree's node that the base positions or the world are known from.
        body: the plant's body of that node.
        positions: the base positions in q that are solved for.
        steps: for "joints", the base joints from the world outwards.
        chain: for "joints", their positions in q; those that are not solved for are held.
        joint: for "floating", the joint's index.
    """

    kind: Literal["constant", "floating", "joints", "placed"]
    X_WB: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    node: int = -1
    body: int = 0
    positions: tuple[int, ...] = ()
    steps: tuple[ChainStep, ...] = ()
    chain: tuple[int, ...] = ()
    joint: int = -1

    def solve(
        self, model: ParsedModel, q: NDArray[np.float64], X_WN: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Complete q (nq,) and find X_WB (4, 4), given all node poses X_WN (n_nodes, 4, 4).

        Raises ModelError where no base positions give the root's pose.
        """
        if self.kind == "constant":
            return q, np.array(self.X_WB)
        X_WA = X_WN[self.node]
        if self.kind == "joints":
            q[list(self.positions)] = self._solve_joints(model, q, X_WA)
            return q, np.eye(4)
        kinematics = PlantKinematics(model)
        if self.kind == "floating":
            self._set_floating(kinematics, q, X_WA)
            return q, np.eye(4)
        return q, X_WA @ inverse_transforms(kinematics.pose_at(self.body, q))

    def _set_floating(
        self, kinematics: PlantKinematics, q: NDArray[np.float64], X_WA: NDArray[np.float64]
    ) -> None:
        """Set the floating joint's positions in q so that the anchor body A is at X_WA."""
        # Drake's type stubs know neither SetPose nor numpy's array types.
        joint: Any = kinematics.plant.get_joint(JointIndex(self.joint))
        X_FM: Any
        child = int(joint.child_body().index())
        X_WC_now = kinematics.pose_at(child, q)
        X_CA = inverse_transforms(X_WC_now) @ kinematics.pose_at(self.body, q)
        X_WF = kinematics.pose_at(int(joint.parent_body().index()), q) @ _pose_in_body(
            joint.frame_on_parent()
        )
        X_WM = X_WA @ inverse_transforms(X_CA) @ _pose_in_body(joint.frame_on_child())
        X_FM = _orthonormal(inverse_transforms(X_WF) @ X_WM)
        joint.SetPose(kinematics.context, RigidTransform(X_FM))
        solved = kinematics.plant.GetPositions(kinematics.context)
        q[list(self.positions)] = solved[list(self.positions)]

    def _solve_joints(
        self, model: ParsedModel, q: NDArray[np.float64], X_WA: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Base positions (n,) that put the anchor at X_WA, inside their limits if possible."""
        index = list(self.positions)
        periodic = model.periodic[index]
        lower, upper = model.lower[index], model.upper[index]
        middle = np.mean(one_turn(lower, upper, model.default_positions[index]), axis=0)
        turns = np.array([model.position_kinds[i] == "angle" for i in index])

        solved = np.isin(self.chain, index)

        def completed(values: NDArray[np.float64]) -> NDArray[np.float64]:
            every = q[list(self.chain)]
            every[solved] = values
            return every

        def residual(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return (chain_transforms(self.steps, completed(values)[None])[0] - X_WA)[:3].reshape(12)

        def jacobian(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return chain_jacobian(self.steps, completed(values))[:, solved]

        random = np.random.default_rng(0)
        starts = [q[index]] + [
            np.where(turns, random.uniform(-np.pi, np.pi, len(index)), q[index])
            for _ in range(_RANDOM_STARTS)
        ]
        outside = None
        for start in starts:
            found = least_squares(
                residual, start, jacobian, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15
            )
            if np.abs(found.fun).max() > _EXACT:
                continue
            wrapped = nearest_turn(found.x, middle, periodic)
            if np.all((wrapped >= lower - 1e-9) & (wrapped <= upper + 1e-9)):
                return wrapped
            outside = wrapped if outside is None else outside
        if outside is None:
            raise ModelError(
                f"{model.path}: no values of the base joints "
                f"{[model.position_names[i] for i in index]} put the root where it should be"
            )
        return outside


def chain_jacobian(steps: Sequence[ChainStep], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative (12, k) of the upper rows of a chain's end pose, exact, by complex steps."""
    stepped = values + 1j * _COMPLEX_STEP * np.eye(len(values))
    change = chain_transforms(steps, stepped).imag / _COMPLEX_STEP
    return np.asarray(change[:, :3].reshape(len(values), 12).T, dtype=np.float64)


def base_of_chain(
    model: ParsedModel,
    graph: LinkGraph,
    chain: list[JointEdge],
    node: int,
    held: Collection[int] = (),
) -> BasePose:
    """How the joints from the world outwards to a node of the tree can take up the node's pose.

    ``held`` positions stay as they are if the others suffice.
    """
    body = graph.groups[chain[-1].outer].body if chain else graph.groups[0].body
    floating = [edge for edge in chain if edge.joint_map is None]
    if floating:
        edge = floating[0]
        return BasePose(
            "floating", node=node, body=body, positions=edge.positions, joint=edge.joint
        )
    positions = tuple(position for edge in chain for position in edge.positions)
    steps = tuple(ChainStep(e.joint_map, inverted=False) for e in chain if e.joint_map is not None)
    values = model.default_positions[list(positions)] + 0.1
    if len(positions) <= 12:
        slopes = chain_jacobian(steps, values)
        for solved in (~np.isin(positions, list(held)), np.ones(len(positions), dtype=np.bool_)):
            if np.linalg.matrix_rank(slopes[:, solved], tol=1e-5) >= 6:
                taken = tuple(
                    p for p, is_solved in zip(positions, solved, strict=True) if is_solved
                )
                return BasePose(
                    "joints", node=node, body=body, positions=taken, steps=steps, chain=positions
                )
    return BasePose("placed", node=node, body=body)


def _pose_in_body(frame: Frame) -> NDArray[np.float64]:
    """A fixed frame's pose (4, 4) in its body."""
    return np.asarray(frame.GetFixedPoseInBodyFrame().GetAsMatrix4())


def _orthonormal(X: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transform with its rotation freed from rounding errors."""
    u, _, vt = np.linalg.svd(X[:3, :3])
    cleaned = np.array(X)
    cleaned[:3, :3] = u @ vt
    return cleaned
