"""A body whose links may be longer than its model's: unknowns of where its joints stand.

A link is longer by a factor where the joints that it carries are farther from its own, along their
offsets from it; its surface stays what it is. All behind such a joint is shifted.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.model import OBJECT_POSITIONS
from drake_pose.body.tree.link_graph import chain_transforms
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import JointOffset, TreeKinematics, joint_offsets
from drake_pose.fit.parameters import BodyParameters, Placement, affine_motions, owners_of
from drake_pose.silhouette.areas.outline import Outline


class LengthenedBody(BodyParameters):
    """A body's parameters: its tree's values, then the logarithms of how much longer links are.

    Attributes:
        links: the links with a length, in the order of their parameters.

    Args:
        kinematics: the pose tree's.
        outlines: a surface for each node.
        offsets: the joints whose origins move.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: Sequence[Outline],
        offsets: Sequence[JointOffset],
    ) -> None:
        super().__init__(kinematics, outlines)
        self.links = tuple(dict.fromkeys(one.link for one in offsets))
        self.names = (*kinematics.names, *(length_name(link) for link in self.links))
        self._offsets = tuple(offsets)
        self._lengths = np.array([self.links.index(one.link) for one in offsets], dtype=np.intp)
        nodes, count = kinematics.tree.nodes, len(kinematics.names)
        self._behind = np.zeros((len(nodes), len(offsets)), dtype=np.bool_)
        for i, node in enumerate(nodes):
            if node.parent >= 0:
                self._behind[i] = self._behind[node.parent]
            self._behind[i] |= [one.node == i for one in offsets]
        # A joint whose origin is shifted turns about another axis.
        self._shifted = np.zeros((len(kinematics.parameters), len(offsets)), dtype=np.bool_)
        for i, placement in enumerate(kinematics.tree.placements):
            first = kinematics.packed.value_starts[i]
            for k, step in enumerate(placement.steps):
                last = first + step.joint_map.position_count
                # Walked inwards, a joint comes before its offset.
                before = [one.node != i or one.step + one.inverted <= k for one in offsets]
                self._shifted[first:last] = self._behind[i] & before
                first = last
        moves = kinematics.motions(kinematics.flatten(kinematics.tree.default_values())).moves
        parameters = np.concatenate([kinematics.parameters, count + self._lengths])
        self._owners = owners_of(np.hstack([moves, self._behind]), parameters)

    def place(self, theta: Array) -> Placement:
        """The body at its tree's values (m,), or at all parameters (n,)."""
        count = len(self.kinematics.names)
        if len(theta) == count:
            return super().place(theta)
        at_rest = self.kinematics.motions(theta[:count])
        offsets = self._offsets_in_world(theta[:count], at_rest.X_WN)
        growth = np.exp(theta[count:])[self._lengths][:, None]
        shifts = (growth - 1.0) * offsets
        X_WN, twists = at_rest.X_WN.copy(), at_rest.twists.copy()
        X_WN[:, :3, 3] += self._behind @ shifts
        twists[:, 3:6] -= np.cross(twists[:, :3], self._shifted @ shifts)
        moved = np.zeros((len(offsets), 7))
        moved[:, 3:6] = growth * offsets
        motions = affine_motions(np.vstack([twists, moved]))
        return Placement(self._at(theta[:count]), X_WN, motions, *self._owners)

    def _offsets_in_world(self, values: Array, X_WN: Array) -> Array:
        """(offsets, 3) at the tree's values (m,), nothing lengthened."""
        tree, split = self.kinematics.tree, self.kinematics.split(values)
        found = np.zeros((len(self._offsets), 3))
        for k, one in enumerate(self._offsets):
            placement, parent = tree.placements[one.node], tree.nodes[one.node].parent
            R_WA = placement.X_PA[:3, :3] if parent < 0 else X_WN[parent, :3, :3]
            if one.step + one.inverted > 0:
                values = tree.step_values(one.node, split[tree.source(one.node)][None])
                steps = placement.steps[: one.step + one.inverted]
                R_WA = R_WA @ chain_transforms(steps, values)[0, :3, :3]
            found[k] = R_WA @ one.p_A
        return found


def length_name(link: str) -> str:
    """The name of a link's length among the parameters."""
    return f"length of {link}"


def lengthened_joints(tree: PoseTree, links: Collection[str] | None = None) -> list[JointOffset]:
    """The robot's joints that links, all where None, carry at a distance from their own."""
    return [
        one
        for one in joint_offsets(tree)
        if (links is None or one.link in links) and one.joint not in OBJECT_POSITIONS
    ]
