"""Fit the proportions of a body: its parts may be longer and wider than the model's.

Each part is stretched along one axis of its frame, towards the parts that it carries, and
scaled across that axis. So bones get individual lengths and flesh individual widths. Where a limb
begins, its joint may also move along the part, inside its flesh: the rest pose is unchanged, but
the limb bends elsewhere. The values of the model's joints keep their meaning.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel
from drake_pose.body.tree_kinematics import TreeKinematics, link_vectors
from drake_pose.camera.models import Camera
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import Noise
from drake_pose.fit.evidence import EdgePoints, Observation, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage, LinearPrior
from drake_pose.fit.parameters import (
    ROOT_NAMES,
    BodyParameters,
    Placement,
    affine_motions,
    affine_of,
    owners_of,
    scale_surfaces,
)
from drake_pose.fit.problem import Problem, Solution, Unknowns
from drake_pose.silhouette.outline import TreeSurfaces


class ProportionedBody(BodyParameters):
    """Parameters of a body: tree values, ROOT_NAMES, log lengths, log widths, and joint shifts.

    A limb is a chain of nodes that each carry only the next one. There is one length factor per
    node, one width factor per limb, and one shift [part's length] per joint at which a limb begins.

    Attributes:
        axes: (nodes,) axis 0, 1 or 2 of each node's frame along which its length is scaled.
        limbs: (nodes,) index of each node's limb.
        movable: (k,) indices of nodes at which limbs begin and whose joints may move.
        length_names, width_names, joint_shift_names: names of the last three groups of parameters.

    Args:
        kinematics: kinematics of the pose tree.
        surfaces: surfaces of the pose tree.

    Raises:
        ModelError: the model has mimic joints.
    """

    def __init__(self, kinematics: TreeKinematics, surfaces: TreeSurfaces) -> None:
        super().__init__(kinematics, surfaces.rigid, surfaces=surfaces)
        nodes, model = kinematics.tree.nodes, kinematics.tree.model
        if len(kinematics.motion_values) > len(kinematics.names):
            name = model.position_names[kinematics.tree.followers[0].leader]
            raise ModelError(
                f"{model.path}: joints mimic '{name}' (<mimic>), and the proportions of such a "
                f"body cannot be estimated; hold it: --hold {name}=VALUE [deg or m]"
            )
        self.limbs = np.zeros(len(nodes), dtype=np.int64)
        firsts: list[str] = []
        for i, node in enumerate(nodes):
            if node.parent >= 0 and len(nodes[node.parent].children) == 1:
                self.limbs[i] = self.limbs[node.parent]
            else:
                self.limbs[i] = len(firsts)
                firsts.append(node.name)
        self.length_names = tuple(f"log_length_{node.name}" for node in nodes)
        self.width_names = tuple(f"log_width_{name}" for name in firsts)
        self._joints = {
            offset.node: offset.joint
            for offset in link_vectors(kinematics.tree)
            if offset.step == 0
            and not offset.inverted
            and offset.link == nodes[nodes[offset.node].parent].name
            and nodes[offset.node].name in firsts
        }
        self.movable = np.array(sorted(self._joints), dtype=np.intp)
        self.joint_shift_names = tuple(f"joint_shift_{nodes[i].name}" for i in self.movable)
        self.names = (
            *kinematics.names,
            *ROOT_NAMES,
            *self.length_names,
            *self.width_names,
            *self.joint_shift_names,
        )
        values = kinematics.flatten(kinematics.tree.default_values())
        X_WN = kinematics.poses(values)
        # Each node's axis, its length vector [m], and the same vector at rest in the parent.
        self.axes = np.zeros(len(nodes), dtype=np.int64)
        self._length_vectors, self._rest_vectors = np.zeros((2, len(nodes), 3))
        for i, node in enumerate(nodes):
            carried = (X_WN[list(node.children), :3, 3] - X_WN[i, :3, 3]) @ X_WN[i, :3, :3]
            along = np.abs(carried).sum(axis=0)
            vertices = node.mesh.vertices
            middle = vertices.mean(axis=0) if len(vertices) else np.ones(3)
            if not np.any(along > 0.0):
                along = np.abs(middle)
            axis = self.axes[i] = int(np.argmax(along))
            ends = carried[:, axis] if len(carried) else middle[[axis]]
            self._length_vectors[i, axis] = ends[np.argmax(np.abs(ends))]
            self._rest_vectors[i] = X_WN[i, :3, :3] @ self._length_vectors[i]
            if node.parent >= 0:
                self._rest_vectors[i] = X_WN[node.parent, :3, :3].T @ self._rest_vectors[i]
        self._parents = np.array([node.parent for node in nodes])
        # Which nodes each motion of `place` moves, in its order, and which parameter causes it.
        count, every = len(kinematics.names) + len(ROOT_NAMES), np.arange(len(nodes))
        below = np.eye(len(nodes), dtype=np.bool_)
        for i, parent in enumerate(self._parents):
            below[i] |= (parent >= 0) & below[parent]
        carried_nodes = np.flatnonzero(self._parents >= 0)
        lengths, widths = count + every, count + len(nodes) + self.limbs
        by = self._parents[carried_nodes]
        places = len(self.names) - len(self.movable) + np.arange(len(self.movable))
        own, below_carried = every[:, None] == every, below[:, carried_nodes]
        moves = (
            kinematics.motions(values).moves, np.ones((len(nodes), 4), np.bool_), own, own,
            below_carried, below_carried, below[:, self.movable],
        )  # fmt: skip
        caused_by = np.arange(count), lengths, widths, lengths[by], widths[by], places
        self._owners = owners_of(np.hstack(moves), np.concatenate(caused_by))

    def factors(self, theta: Array) -> Array:
        """Return (nodes, 3) the scale of each node along the axes of its frame.

        Args:
            theta: (n,) all parameters.
        """
        count = len(self.kinematics.names) + len(ROOT_NAMES)
        nodes = len(self.limbs)
        lengths = theta[count : count + nodes]
        widths = theta[count + nodes :][: len(self.width_names)]
        logs = np.repeat(widths[self.limbs][:, None], 3, axis=1)
        logs[np.arange(nodes), self.axes] = lengths
        return np.asarray(np.exp(logs))

    def applied_to(self, model: ArticulatedModel, theta: Array) -> ArticulatedModel:
        """Return a model with the proportions of all parameters.

        ``model``: the tree's model, or another one with the same links and joints. ``theta``: (n,)
        all parameters; only the proportions are used. Raises ModelError: the model's file is not a
        URDF.
        """
        nodes, joint_shifts = self.kinematics.tree.nodes, self.relative_joint_shifts(theta)
        factors = zip(nodes, self.factors(theta).tolist(), strict=True)
        return model.reshaped(
            link_scales={node.name: tuple(row) for node, row in factors},
            joint_shifts={
                joint: tuple(joint_shifts[i] * self._rest_vectors[i])
                for i, joint in self._joints.items()
            },
            link_shifts={
                nodes[i].name: tuple(-joint_shifts[i] * self._length_vectors[i])
                for i in self._joints
            },
        )

    def relative_joint_shifts(self, theta: Array) -> Array:
        """Return (nodes,) shift of parts' joints along the part [its length], 0 if not moved."""
        joint_shifts = np.zeros(len(self.limbs))
        joint_shifts[self.movable] = theta[len(self.names) - len(self.movable) : len(self.names)]
        return joint_shifts

    def place(self, theta: Array) -> Placement:
        """Return the body, with its proportions and their motions, at all parameters theta (n,)."""
        kinematics = self.kinematics
        count = len(kinematics.names)
        at_rest = kinematics.motions(theta[:count])
        scale, joint_shifts = self.factors(theta), self.relative_joint_shifts(theta)
        R = at_rest.X_WN[:, :3, :3]
        # Stretch of each node as a linear map of vectors in the world.
        maps = np.einsum("nik,nk,njk->nij", R, scale, R)
        places = at_rest.X_WN[:, :3, 3].copy()
        # Offset of a part's flesh from its joint, and offset of the joint from its model position.
        back = -np.einsum("nik,nk,n->ni", R, self._length_vectors, joint_shifts)
        carried = np.zeros_like(places)
        for i, node in enumerate(kinematics.tree.nodes):
            if node.parent >= 0:
                offset = at_rest.X_WN[i, :3, 3] - at_rest.X_WN[node.parent, :3, 3]
                carried[i] = maps[node.parent] @ offset
                places[i] = places[node.parent] + back[node.parent] + carried[i]
                places[i] += joint_shifts[i] * (R[node.parent] @ self._rest_vectors[i])
        shift, root_scale = theta[count : count + 3], float(np.exp(theta[count + 3]))
        moved = places[0] + shift - root_scale * places[0]
        # M (k, 3, 3) and v (k, 3) of values, root translation and root scale. M p + v applies to
        # points before the root's scaling and translation.
        nodes = kinematics.value_nodes
        affine = affine_motions(at_rest.twists).reshape(-1, 3, 4)
        turned = affine[:, :, :3]
        velocity = np.einsum("kij,kj->ki", turned, at_rest.X_WN[nodes, :3, 3]) + affine[:, :, 3]
        # The first root has no parent that stretches its motion.
        by = np.concatenate([maps, np.eye(3)[None]])[self._parents[nodes]]
        velocity = np.einsum("kij,kj->ki", by, velocity)
        of_values = velocity - np.einsum("kij,kj->ki", turned, places[nodes])
        # Values that move the root also move the centre of the root's scaling.
        of_values += (1.0 / root_scale - 1.0) * velocity * (nodes == 0)[:, None]
        M = [turned, np.zeros((3, 3, 3)), np.eye(3)[None]]
        v = [of_values, np.eye(3) / root_scale, -places[:1]]
        carried_nodes = np.flatnonzero(self._parents >= 0)
        along = R[np.arange(len(R)), :, self.axes]
        long = along[:, :, None] * along[:, None]
        for stretch in (long, np.eye(3) - long):
            M.append(stretch)
            v.append(-np.einsum("nij,nj->ni", stretch, places + back))
        for stretch in (long, np.eye(3) - long):
            v.append(np.einsum("nij,nj->ni", stretch[self._parents], carried)[carried_nodes])
        beside = np.einsum("nij,nj->ni", R[self._parents], self._rest_vectors)
        v.append((beside - np.einsum("nij,nj->ni", R, self._length_vectors))[self.movable])
        all_v = np.concatenate(v)
        all_M = np.zeros((len(all_v), 3, 3))
        turning = np.concatenate(M)
        all_M[: len(turning)] = turning
        X_WN = at_rest.X_WN.copy()
        X_WN[:, :3, :3] *= root_scale
        X_WN[:, :3, 3] = moved + root_scale * places
        packed = scale_surfaces(self._at(theta[:count]), scale)
        # A node's rigid surface moves with its joint's position; skin bands stay at the joints.
        flesh = -self._length_vectors * joint_shifts[:, None]
        for i in self.movable.tolist():
            vertices = packed.starts[i, 0] + np.arange(len(self.outlines[i].vertices))
            triangles = packed.starts[i, 1] + np.arange(len(self.outlines[i].triangles))
            packed.points[:, vertices] += flesh[i][:, None]
            packed.planes[3, triangles] += flesh[i] @ packed.planes[:3, triangles]
            packed.balls[i, :3] += flesh[i]
            packed.balls[i, 3] += np.linalg.norm(flesh[i])
        motions = affine_of(all_M, root_scale * all_v - all_M @ moved)
        return Placement(packed, X_WN, motions, *self._owners)


def sequence_prior(
    frames: int, usual: tuple[Array, Array, Array], acceleration: Array
) -> LinearPrior:
    """Return the prior of p unknowns in successive frames: usual values and smooth motion.

    Args:
        frames: number of frames, at least three.
        usual: phi (k, p), mean (k,) and information (k,), the inverse variance, of the k linear
            combinations phi x of each frame's unknowns x (p,).
        acceleration: (p,) standard deviation of an unknown about its linear extrapolation from the
            two preceding frames.
    """
    phi, mean, information = usual
    motion = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(frames - 2, frames))
    rows = vstack([kron(eye_array(frames), phi), kron(motion, eye_array(len(acceleration)))])
    still = np.tile(acceleration**-2.0, frames - 2)
    return LinearPrior(
        csr_array(rows),
        np.r_[np.tile(mean, frames), np.zeros(len(still))],
        np.r_[np.tile(information, frames), still],
    )


def fit_proportions(
    body: ProportionedBody,
    camera: Camera,
    frames: Sequence[EdgePoints],
    starts: Array,
    stages: Sequence[AnnealingStage],
    noise: Noise,
    limits: tuple[Array, Array],
    prior: LinearPrior,
) -> tuple[Solution, Array]:
    """Fit a body's proportions, and its pose in each frame, to several frames of one camera.

    Args:
        body: parameters of the body.
        camera: the camera.
        frames: edges of the silhouettes of three or more frames.
        starts: (frames, k) initial guess of the tree's values and ROOT_NAMES, or (frames, n) of all
            parameters, with the proportions taken from the first frame; else they are the model's.
        stages: annealing stages in order, coarse to fine [pixel].
        noise: errors of the silhouettes [pixel].
        limits: lower and upper (p,) limits of the free tree values, then of ROOT_NAMES.
        prior: prior of these p unknowns in all frames, see ``sequence_prior``.

    Returns the solution, whose own unknowns are the free tree values and ROOT_NAMES, and whose
    shared ones are the proportions; and the standard deviations (frames, k) of the tree's values
    and ROOT_NAMES, 0 for fixed values.
    """
    kinematics = body.kinematics
    moving = np.array(kinematics.names)[kinematics.lower < kinematics.upper].tolist()
    # Standard deviations of the variation between people.
    problem = Problem(
        body,
        [camera],
        [
            Unknowns([*moving, *ROOT_NAMES], lower=limits[0], upper=limits[1]),
            Unknowns(body.length_names, True, deviation=0.15),
            Unknowns(body.width_names, True, deviation=0.1),
            Unknowns(body.joint_shift_names, True, deviation=0.15),
        ],
        noise=noise,
        pixels=1.0,
    )
    held = np.zeros((len(frames), len(body.names)))
    held[:, : starts.shape[1]] = starts
    own, common = np.split(problem.entries, [problem.own_count])
    first, shared = held[:, own].copy(), held[0, common].copy()
    held[:, problem.entries] = 0.0
    seen = [Observation(pack_evidence([e]), row) for e, row in zip(frames, held, strict=True)]
    found = problem.solve(
        seen, stages, (first, shared), expected=(first, np.zeros(len(common))), coupling=prior
    )
    deviations = np.zeros((len(frames), len(kinematics.names) + len(ROOT_NAMES)))
    deviations[:, own] = found.own_deviations()
    return found, deviations
