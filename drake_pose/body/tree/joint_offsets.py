"""Where joints stand on the links that carry them: how long these links are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import Joint, RigidBody

from drake_pose.body.tree.joint_map import chain_transforms
from drake_pose.body.tree.link_graph import PlantKinematics
from drake_pose.body.tree.pose_tree import PoseTree

Array = NDArray[np.float64]

# A joint stands on its link's own joint that is no farther off than this [m].
_NO_LENGTH = 1e-3


class JointOffset(NamedTuple):
    """How far a joint's origin is from the joint before it.

    joint: its name; link: its parent link's; node: the pose tree's node that it moves; step: its
    place among that node's joints; p_A: (3,) the offset in frame A of the link, which is the
    parent node's where step is 0; p_L: (3,) the same in the parent link's frame [m].
    """

    joint: str
    link: str
    node: int
    step: int
    p_A: Array
    p_L: Array


def joint_offsets(tree: PoseTree) -> tuple[JointOffset, ...]:
    """Each joint's offset from the origin of the rigid part that carries it.

    That origin is where the part's own joint stands, or the world's. Joints without an offset are
    left out, and so are those that the tree walks inwards.

    Args:
        tree: the pose tree.
    """
    model, plant, kinematics = tree.model, tree.model.plant, PlantKinematics(tree.model)

    def pose(link: RigidBody) -> Array:
        return kinematics.pose(int(link.index()), tree.held)

    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    moving = {joint.position_start(): joint for joint in joints if joint.num_positions() > 0}
    inboard = {int(joint.child_body().index()): joint for joint in joints}
    found = []
    for i, (node, placement) in enumerate(zip(tree.nodes, tree.placements, strict=True)):
        X_BA, values, at = np.eye(4), tree.default_values()[i], 0
        if node.parent >= 0:
            parent = model.link_index(tree.nodes[node.parent].name)
            X_BA = kinematics.pose(parent, tree.held)
        for k, step in enumerate(placement.steps):
            joint = moving[node.positions[at]]
            p_B = _offset(joint, inboard, pose)
            if not step.inverted and np.linalg.norm(p_B) > _NO_LENGTH:
                link = joint.parent_body()
                p_A, p_L = X_BA[:3, :3].T @ p_B, pose(link)[:3, :3].T @ p_B
                found.append(JointOffset(joint.name(), link.name(), i, k, p_A, p_L))
            end = at + step.joint_map.position_count
            X_BA = X_BA @ chain_transforms([step], values[None, at:end])[0]
            at = end
    return tuple(found)


def _offset(
    joint: Joint, inboard: Mapping[int, Joint], pose: Callable[[RigidBody], Array]
) -> Array:
    """(3,) to a joint from the origin of the rigid part that carries it, in the plant's world."""
    link = first = joint.parent_body()
    while (before := inboard.get(int(first.index()))) and before.num_positions() == 0:
        first = before.parent_body()
    X_LJ = joint.frame_on_parent().GetFixedPoseInBodyFrame().GetAsMatrix4()
    return np.asarray((pose(link) @ X_LJ - pose(first))[:3, 3])
