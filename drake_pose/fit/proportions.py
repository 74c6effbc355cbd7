"""A body whose parts may be longer and wider than its model's: unknowns of its proportions.

Each part is stretched along one axis of its frame, that along which it carries what hangs on it,
and widened across it. So bones get their own lengths and flesh its own radius scale, which
silhouettes of somebody else than the model's measures show. Where a limb begins, its joint may lie
further out in the flesh than the model's: at rest nothing changes, but the limb bends elsewhere.
The model's joints keep their meaning.
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
    stretched,
)
from drake_pose.fit.problem import Problem, Solution, Unknowns
from drake_pose.silhouette.outline import TreeSurfaces


class ProportionedBody(BodyParameters):
    """A body's parameters: its tree's values, ROOT_NAMES, lengths, widths, places of joints.

    A limb is a chain of nodes of which each carries the next alone. Lengths are those of nodes,
    widths those of limbs, and places those of the joints with which limbs begin.

    Attributes:
        axes: (nodes,) the axis 0, 1 or 2 of its frame along which each node is long.
        limbs: (nodes,) the limb that each node belongs to.
        placed: the nodes whose joints, with which limbs begin, may lie elsewhere in the flesh.

    Args:
        kinematics: the pose tree's.
        surfaces: the pose tree's.

    Raises ModelError: joints follow others.
    """

    def __init__(self, kinematics: TreeKinematics, surfaces: TreeSurfaces) -> None:
        super().__init__(kinematics, surfaces.rigid, surfaces=surfaces)
        nodes, model = kinematics.tree.nodes, kinematics.tree.model
        if len(kinematics.parameters) > len(kinematics.names):
            name = model.position_names[kinematics.tree.followers[0].leader]
            raise ModelError(
                f"{model.path}: joints follow '{name}' (<mimic>): the lengths of such a body "
                f"cannot be estimated; hold it: --hold {name}=VALUE [deg or m]"
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
        self.placed = np.array(sorted(self._joints), dtype=np.intp)
        self.place_names = tuple(f"joint_place_{nodes[i].name}" for i in self.placed)
        self.names = (
            *kinematics.names,
            *ROOT_NAMES,
            *self.length_names,
            *self.width_names,
            *self.place_names,
        )
        values = kinematics.flatten(kinematics.tree.default_values())
        X_WN = kinematics.poses(values)
        # Of each node the axis, how long it is along it [m], and the same at rest in the parent.
        self.axes = np.zeros(len(nodes), dtype=np.int64)
        self._along, self._rest = np.zeros((2, len(nodes), 3))
        for i, node in enumerate(nodes):
            carried = (X_WN[list(node.children), :3, 3] - X_WN[i, :3, 3]) @ X_WN[i, :3, :3]
            along = np.abs(carried).sum(axis=0)
            vertices = node.mesh.vertices
            middle = vertices.mean(axis=0) if len(vertices) else np.ones(3)
            if not np.any(along > 0.0):
                along = np.abs(middle)
            axis = self.axes[i] = int(np.argmax(along))
            ends = carried[:, axis] if len(carried) else middle[[axis]]
            self._along[i, axis] = ends[np.argmax(np.abs(ends))]
            self._rest[i] = X_WN[i, :3, :3] @ self._along[i]
            if node.parent >= 0:
                self._rest[i] = X_WN[node.parent, :3, :3].T @ self._rest[i]
        self._parents = np.array([node.parent for node in nodes])
        # Which nodes each motion of `place` moves, in its order, and which parameter makes it.
        count, every = len(kinematics.names) + len(ROOT_NAMES), np.arange(len(nodes))
        below = np.eye(len(nodes), dtype=np.bool_)
        for i, parent in enumerate(self._parents):
            below[i] |= (parent >= 0) & below[parent]
        hanging = np.flatnonzero(self._parents >= 0)
        lengths, widths = count + every, count + len(nodes) + self.limbs
        by = self._parents[hanging]
        places = len(self.names) - len(self.placed) + np.arange(len(self.placed))
        own, hung = every[:, None] == every, below[:, hanging]
        moves = (
            kinematics.motions(values).moves, np.ones((len(nodes), 4), np.bool_), own, own,
            hung, hung, below[:, self.placed],
        )  # fmt: skip
        made_by = np.arange(count), lengths, widths, lengths[by], widths[by], places
        self._owners = owners_of(np.hstack(moves), np.concatenate(made_by))

    def factors(self, theta: Array) -> Array:
        """(nodes, 3) scale of each node along its frame's axes."""
        count = len(self.kinematics.names) + len(ROOT_NAMES)
        nodes = len(self.limbs)
        lengths = theta[count : count + nodes]
        widths = theta[count + nodes :][: len(self.width_names)]
        logs = np.repeat(widths[self.limbs][:, None], 3, axis=1)
        logs[np.arange(nodes), self.axes] = lengths
        return np.asarray(np.exp(logs))

    def applied_to(self, model: ArticulatedModel, theta: Array) -> ArticulatedModel:
        """A model, the tree's or one like it, with the proportions of all parameters (n,).

        Raises:
            ModelError: its file is no URDF.
        """
        nodes, shares = self.kinematics.tree.nodes, self.joint_places(theta)
        factors = zip(nodes, self.factors(theta).tolist(), strict=True)
        return model.reshaped(
            link_scales={node.name: tuple(row) for node, row in factors},
            joint_shifts={
                joint: tuple(shares[i] * self._rest[i]) for i, joint in self._joints.items()
            },
            link_shifts={nodes[i].name: tuple(-shares[i] * self._along[i]) for i in self._joints},
        )

    def joint_places(self, theta: Array) -> Array:
        """(nodes,) how far along each part its joint is moved, over the part's length."""
        shares = np.zeros(len(self.limbs))
        shares[self.placed] = theta[len(self.names) - len(self.placed) : len(self.names)]
        return shares

    def place(self, theta: Array) -> Placement:
        """The body at all parameters (n,)."""
        kinematics = self.kinematics
        count = len(kinematics.names)
        at_rest = kinematics.motions(theta[:count])
        scale, shares = self.factors(theta), self.joint_places(theta)
        R = at_rest.X_WN[:, :3, :3]
        # How a node's frame, stretched, maps a vector in the world.
        maps = np.einsum("nik,nk,njk->nij", R, scale, R)
        places = at_rest.X_WN[:, :3, 3].copy()
        # Where a part's flesh is beside its joint, and where the joint is beside the file's.
        back = -np.einsum("nik,nk,n->ni", R, self._along, shares)
        carried = np.zeros_like(places)
        for i, node in enumerate(kinematics.tree.nodes):
            if node.parent >= 0:
                apart = at_rest.X_WN[i, :3, 3] - at_rest.X_WN[node.parent, :3, 3]
                carried[i] = maps[node.parent] @ apart
                places[i] = places[node.parent] + back[node.parent] + carried[i]
                places[i] += shares[i] * (R[node.parent] @ self._rest[i])
        shift, growth = theta[count : count + 3], float(np.exp(theta[count + 3]))
        moved = places[0] + shift - growth * places[0]
        # M (k, 3, 3) and v (k, 3) that values, the root's shift and its growth make: what is moved
        # by M p + v has not grown about the root yet, nor is it shifted.
        nodes = kinematics.value_nodes
        affine = affine_motions(at_rest.twists).reshape(-1, 3, 4)
        turned = affine[:, :, :3]
        velocity = np.einsum("kij,kj->ki", turned, at_rest.X_WN[nodes, :3, 3]) + affine[:, :, 3]
        # The first root is what carries nothing stretched.
        by = np.concatenate([maps, np.eye(3)[None]])[self._parents[nodes]]
        velocity = np.einsum("kij,kj->ki", by, velocity)
        of_values = velocity - np.einsum("kij,kj->ki", turned, places[nodes])
        # What moves the root moves the point about which the body has grown.
        of_values += (1.0 / growth - 1.0) * velocity * (nodes == 0)[:, None]
        M = [turned, np.zeros((3, 3, 3)), np.eye(3)[None]]
        v = [of_values, np.eye(3) / growth, -places[:1]]
        hanging = np.flatnonzero(self._parents >= 0)
        along = R[np.arange(len(R)), :, self.axes]
        long = along[:, :, None] * along[:, None]
        for stretch in (long, np.eye(3) - long):
            M.append(stretch)
            v.append(-np.einsum("nij,nj->ni", stretch, places + back))
        for stretch in (long, np.eye(3) - long):
            v.append(np.einsum("nij,nj->ni", stretch[self._parents], carried)[hanging])
        beside = np.einsum("nij,nj->ni", R[self._parents], self._rest)
        v.append((beside - np.einsum("nij,nj->ni", R, self._along))[self.placed])
        all_v = np.concatenate(v)
        all_M = np.zeros((len(all_v), 3, 3))
        turning = np.concatenate(M)
        all_M[: len(turning)] = turning
        X_WN = at_rest.X_WN.copy()
        X_WN[:, :3, :3] *= growth
        X_WN[:, :3, 3] = moved + growth * places
        packed = stretched(self._at(theta[:count]), scale)
        # A node's rigid part moves with its joint's place; bands stay at the joints.
        flesh = -self._along * shares[:, None]
        for i in self.placed.tolist():
            vertices = packed.starts[i, 0] + np.arange(len(self.outlines[i].vertices))
            triangles = packed.starts[i, 1] + np.arange(len(self.outlines[i].triangles))
            packed.points[:, vertices] += flesh[i][:, None]
            packed.planes[3, triangles] += flesh[i] @ packed.planes[:3, triangles]
            packed.balls[i, :3] += flesh[i]
            packed.balls[i, 3] += np.linalg.norm(flesh[i])
        motions = affine_of(all_M, growth * all_v - all_M @ moved)
        return Placement(packed, X_WN, motions, *self._owners)


def sequence_prior(
    frames: int, usual: tuple[Array, Array, Array], acceleration: Array
) -> LinearPrior:
    """What is known without pictures of p unknowns of frames that follow one another.

    Args:
        frames: their number, three or more.
        usual: phi (k, p) of which phi x has the mean (k,), with the information (k,), one over the
            variance.
        acceleration: (p,) standard deviation of an unknown about where the two frames before it
            lead.
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
    rounds: Sequence[AnnealingStage],
    noise: Noise,
    limits: tuple[Array, Array],
    prior: LinearPrior,
) -> tuple[Solution, Array]:
    """The proportions of a body that several frames of one camera show, its pose near in each.

    Args:
        body: the body.
        camera: the camera.
        frames: the edges that it sees, of three frames or more.
        starts: (frames, k) about what the tree's values and ROOT_NAMES are; or (frames, n) all
            parameters, those of proportions as in the first frame.
        rounds: the parts of the fit [pixel].
        noise: of contours [pixel].
        limits: lower and upper (p,) of the tree's values that are free, then of ROOT_NAMES.
        prior: of the same unknowns of all frames.

    Returns:
        the solution, and standard deviations (frames, k) of the tree's values and ROOT_NAMES, 0
        where they were held.
    """
    kinematics = body.kinematics
    moving = np.array(kinematics.names)[kinematics.lower < kinematics.upper].tolist()
    # Standard deviations: as people differ.
    problem = Problem(
        body,
        [camera],
        [
            Unknowns([*moving, *ROOT_NAMES], lower=limits[0], upper=limits[1]),
            Unknowns(body.length_names, True, deviation=0.15),
            Unknowns(body.width_names, True, deviation=0.1),
            Unknowns(body.place_names, True, deviation=0.15),
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
        seen, rounds, (first, shared), expected=(first, np.zeros(len(common))), coupling=prior
    )
    off = np.zeros((len(frames), len(kinematics.names) + len(ROOT_NAMES)))
    off[:, own] = found.own_deviations()
    return found, off
