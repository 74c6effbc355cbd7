"""Where joints stand on the links that carry them: how long these links are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from pydrake.multibody.tree import Joint, RigidBody

from drake_pose.arrays import Array
from drake_pose.body.tree.link_graph import PlantKinematics, chain_transforms
from drake_pose.body.tree.pose_tree import PoseTree

# A joint stands on its link's own joint that is no farther off than this [m].
_NO_LENGTH = 1e-3


class JointOffset(NamedTuple):
    """How far a joint's origin is from the joint before it.

    joint: its name; link: its parent link's; node: the pose tree's node that it moves; step: its
    place among that node's joints; inverted: whether the tree walks it inwards, from its child link
    to its parent; p_A: (3,) by how far what is behind it in the tree is shifted, in frame A of the
    parent link, which is the parent node's where step is 0 and it is walked outwards: the offset,
    or walked inwards its negative; p_L: (3,) the offset in the parent link's frame [m].
    """

    joint: str
    link: str
    node: int
    step: int
    inverted: bool
    p_A: Array
    p_L: Array


def joint_offsets(tree: PoseTree) -> tuple[JointOffset, ...]:
    """Each joint's offset from the joint (or the world) that places the part that carries it.

    Joints without an offset are left out.
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
            end = at + step.joint_map.position_count
            X_BC = X_BA @ chain_transforms([step], values[None, at:end])[0]
            if np.linalg.norm(p_B) > _NO_LENGTH:
                link = joint.parent_body()
                p_A = -X_BC[:3, :3].T @ p_B if step.inverted else X_BA[:3, :3].T @ p_B
                p_L = pose(link)[:3, :3].T @ p_B
                found.append(
                    JointOffset(joint.name(), link.name(), i, k, bool(step.inverted), p_A, p_L)
                )
            X_BA = X_BC
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
