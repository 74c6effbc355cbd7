"""A rigid object that stands somewhere in a robot's world, and how its look repeats."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body.model import OBJECT, OBJECT_POSITIONS, ArticulatedModel
from drake_pose.body.surfaces.meshes import TriangleMesh, join_meshes
from drake_pose.body.tree.link_graph import inverse_transforms
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.root import RootRotation
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.errors import RegistrationError, SettingsError
from drake_pose.fit.surfaces import FEW, few_triangles, surface_distance
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import ObjectPose, RegistrationBody
from drake_pose.registration.start_poses import apart_from_before
from drake_pose.silhouette.areas.bending import TreeSurfaces
from drake_pose.silhouette.areas.outline import outline_from_mesh

# A hand that turns by less about a second axis tells nothing of where along the first one it is.
_LEAST_TURN = np.radians(4.0)
# A surface looks alike that is no farther off, root mean square, than this share of its radius.
_ALIKE = 0.005
# What turns onto itself by so many parts of a turn is looked for, and what does so by an angle that
# is no part of one.
_PARTS, _NO_PART = (2, 3, 4, 5, 6, 8), 1.0
# An object that looks alike turned by any angle is tried at so many.
_ROUND = 24


class Symmetry(NamedTuple):
    """About what an object looks alike.

    turns: (n, 4, 4) motions in frame T after which it looks alike, the identity first; of an
    object that is round about axes, a turn about these every 15 degrees. axes: (k, 3) about which
    it is round, in frame T.
    """

    turns: Array
    axes: Array

    @property
    def told_apart(self) -> Array:
        """(n, 4, 4) those of the turns that differ in more than a turn about such axes."""
        if not len(self.axes):
            return self.turns
        points = self.axes @ np.swapaxes(self.turns[:, :3, :3], 1, 2)
        # Where the axes point is all that is seen of a round object's turn.
        pointing = apart_from_before(
            range(len(self.turns)), lambda i, j: bool(np.abs(points[i] - points[j]).max() > 0.1)
        )
        return self.turns[pointing]


class StandingObject:
    """An object that stands in the world, where it is not known, before a link of a robot.

    Its frame T is the world of its own model file: of a URDF the frame of its root link.

    Attributes:
        alone: its surfaces, T being the world.
        middle: (3,) of its surface in frame T [m].
        radius: of a ball about its middle [m].

    Args:
        link: of the robot, whose frame L is the world of poses with it.
        held: positions of the robot that are held [rad or m].

    Raises:
        SettingsError: the object has joints that are not held, or no joint moves the link.
    """

    def __init__(
        self, robot: ArticulatedModel, link: str, held: Mapping[str, float], tree: PoseTree
    ) -> None:
        path, kinematics = tree.model.path, TreeKinematics(tree)
        moving = np.flatnonzero(kinematics.lower < kinematics.upper)
        if len(moving):
            raise SettingsError(
                f"{path}: joint '{kinematics.names[moving[0]]}' moves, but what a camera on a link "
                "sees must be rigid: make the joint fixed at its value, or take another object"
            )
        self._robot, self._link, self._held = robot, link, dict(held)
        # An object in several pieces is not itself any more with very few triangles.
        self.alone = RegistrationBody(tree, fewest=FEW)
        X_TN = kinematics.poses(kinematics.lower)
        placed = zip(tree.nodes, X_TN, strict=True)
        self._mesh = join_meshes([node.mesh.transformed(X) for node, X in placed])
        vertices = self._mesh.vertices
        self.middle = np.asarray(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
        self.radius = float(np.linalg.norm(vertices - self.middle, axis=1).max())
        self._X_TO = np.eye(4)
        self._X_TO[:3, 3] = self.middle
        self._bodies = RegistrationBody(self.tree(np.eye(4)), (OBJECT,), FEW)

    def before(self, robot: ArticulatedModel) -> StandingObject:
        """The same before the same robot whose joints may stand elsewhere on their links."""
        other = copy.copy(self)
        other._robot = robot
        return other

    def tree(self, X_WT: Array) -> PoseTree:
        """The tree from the link to the object, which stands at a pose (4, 4) in the world.

        Raises SettingsError: no joint moves the link.
        """
        mesh = self._mesh.transformed(inverse_transforms(self._X_TO))
        model = self._robot.before_object(self._link, mesh, X_WT @ self._X_TO)
        tree = model.pose_tree(
            self._link,
            root_position=np.zeros(3),
            root_rotation=RootRotation.fixed(),
            held={**self._held, **dict.fromkeys(OBJECT_POSITIONS, 0.0)},
        )
        if len(tree.nodes) < 3:
            raise stands_still(self._robot, self._link)
        return tree

    def body(self, X_WT: Array) -> RegistrationBody:
        """The object's surfaces in the tree in which it stands at a pose (4, 4) in the world."""
        return self._bodies.with_tree(self.tree(X_WT))

    def hand_poses(self, values: Array) -> Array:
        """(frames, 4, 4) X_WL at values (frames, m) of the tree."""
        kinematics, world = self._bodies.kinematics, self._bodies.tree.model.link_names[0]
        node = self._bodies.tree.node_index(world)
        return inverse_transforms(np.array([kinematics.poses(one)[node] for one in values]))

    def moved(self, X_WT: Array, by: Array) -> Array:
        """The object's pose (4, 4) at OBJECT_POSITIONS (6,), which are 0 at X_WT (4, 4)."""
        X = np.eye(4)
        X[:3, 3] = by[:3]
        X[:3, :3] = Rotation.from_euler("XYZ", by[3:]).as_matrix()
        return np.asarray(X_WT @ self._X_TO @ X @ inverse_transforms(self._X_TO))

    def pose_covariance(self, X_WT: Array, covariance: Array) -> Array:
        """(6, 6) of the pose's error in the world: a rotation vector [rad] and a shift [m].

        Args:
            covariance: (6, 6) of OBJECT_POSITIONS.
        """
        R = X_WT[:3, :3]
        covariance = covariance.copy()
        for axis in self.symmetry.axes:
            # Nothing says how a round object is turned.
            covariance[3:, 3:] += np.pi**2 / 3.0 * np.outer(axis, axis)
        J = np.zeros((6, 6))
        J[:3, 3:] = J[3:, :3] = R
        # The object turns about its middle, which is not its frame's origin.
        J[3:, 3:] = np.cross(R.T, -R @ self.middle).T
        return J @ covariance @ J.T

    def moved_pose(self, seen: ObjectPose, by: Array, covariance: Array) -> ObjectPose:
        """A pose with its alternatives after OBJECT_POSITIONS (6,), given their covariance."""
        X_WT = self.moved(seen.X_WT, by)
        others = X_WT @ np.linalg.inv(seen.X_WT) @ seen.alternatives
        return replace(
            seen,
            X_WT=X_WT,
            covariance=self.pose_covariance(X_WT, covariance),
            alternatives=others,
        )

    @cached_property
    def symmetry(self) -> Symmetry:
        """About which of the main axes of its surface it looks alike."""
        few = few_triangles(TreeSurfaces(self._bodies.tree), FEW)
        outline = few[self._bodies.tree.node_index(OBJECT)]
        corners = outline.vertices[outline.triangles]
        weights = np.linalg.norm(outline.planes[:, :3], axis=1)
        spread = np.einsum("t,tci,tcj->ij", weights, corners, corners)
        middles = corners.mean(axis=1)
        spread += 9.0 * np.einsum("t,ti,tj->ij", weights, middles, middles)

        def alike(R: Array) -> bool:
            turned = TriangleMesh(outline.vertices @ R.T, outline.triangles)
            off = surface_distance(outline, outline_from_mesh(turned))
            return off <= _ALIKE * self.radius

        rotations, axes = [np.eye(3)], []
        for axis in np.linalg.eigh(spread)[1].T:
            if alike(_turn(_NO_PART * axis)):
                axes.append(axis)
                found = [_ROUND]
            else:
                found = [one for one in _PARTS if alike(_turn(2.0 * np.pi / one * axis))]
            own = [_turn(2.0 * np.pi * k / n * axis) for n in found for k in range(1, n)]
            rotations = _with_products(rotations, own)
        turns = np.tile(np.eye(4), (len(rotations), 1, 1))
        turns[:, :3, :3] = rotations
        return Symmetry(
            self._X_TO @ turns @ inverse_transforms(self._X_TO), np.array(axes).reshape(-1, 3)
        )


def stands_still(robot: ArticulatedModel, link: str) -> SettingsError:
    """What is said of a link that no joint moves."""
    return SettingsError(
        f"{robot.path}: no joint moves link '{link}', so a camera on it stands still: leave "
        "--on out"
    )


def _turn(by: Array) -> Array:
    return Rotation.from_rotvec(by).as_matrix()


def _with_products(rotations: list[Array], own: list[Array]) -> list[Array]:
    """Rotations (3, 3), and those after each of some others; each of them once."""
    products = [*rotations, *(one @ R for R in rotations for one in own)]
    return apart_from_before(products, lambda R, other: bool(np.trace(R.T @ other) < 2.999))


def turns_between(R_WL: Array) -> Array:
    """(3,) how far a hand turns about its three main axes, from picture to picture [rad].

    Root mean squares of the turns between all pairs of its rotations R_WL (n, 3, 3), the largest
    first. Where the second one is 0 the hand turns about one axis alone.
    """
    pairs = list(combinations(range(len(R_WL)), 2))
    if not pairs:
        return np.zeros(3)
    i, j = np.array(pairs).T
    turns = Rotation.from_matrix(np.swapaxes(R_WL[i], 1, 2) @ R_WL[j]).as_rotvec()
    spread = np.sqrt(np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1].clip(min=0.0))
    return np.asarray(spread)


def require_turns(
    camera: str, standing: StandingObject, frames: Sequence[PosedFrame], which: str = ""
) -> None:
    """Refuses frames from which a camera on a link cannot be told, whatever they show.

    Raises RegistrationError: says about what the link must turn.
    """
    what, values = "are too few", np.array([one.values for one in frames])
    if len(frames) >= 3:
        turns = np.degrees(turns_between(standing.hand_poses(values)[:, :3, :3]))
        if turns[1] >= np.degrees(_LEAST_TURN):
            return
        what = (
            f"turn the link that it rides on by {turns[0]:.0f} degrees about one axis, and by "
            f"{turns[1]:.1f} about others"
        )
    raise RegistrationError(
        f"camera '{camera}': its {len(frames)} frames {which}{what}: where it is on the link, and "
        "where the object stands, is not determined by them; take three or more, five better, "
        "between which the link turns by 20 degrees and more about at least two axes. Nothing was "
        "written"
    )
