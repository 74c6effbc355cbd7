"""A body whose parts may be longer and wider than its model's: unknowns of its proportions.

Each part is stretched along one axis of its frame, that along which it carries what hangs on it,
and widened across it. So bones get their own lengths and flesh its own girth, which silhouettes of
somebody else than the model's measures show. The model's joints keep their meaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.tree_kinematics import Motions, TreeKinematics
from drake_pose.camera import Camera
from drake_pose.matching.fit.contour_fit import Noise
from drake_pose.matching.fit.evidence import EdgePoints, pack_evidence
from drake_pose.matching.fit.frames_fit import FramesFit
from drake_pose.matching.fit.levenberg_marquardt import Round
from drake_pose.matching.fit.parameters import (
    ROOT_NAMES,
    BodyParameters,
    Placement,
    affine_motions,
)
from drake_pose.matching.fit.unknowns import choose, join
from drake_pose.silhouette import TreeSurfaces
from drake_pose.silhouette.areas.outline import PackedOutlines

Array = NDArray[np.float64]

LENGTH_PREFIX, WIDTH_PREFIX = "log_length_", "log_width_"
"""Begin the names of the logarithms of how much longer a part is, and of how much wider a part or
all parts of a limb are."""


class _MotionList:
    """Affine motions of nodes, collected; the whole body has grown about its root and is shifted.

    Args:
        nodes: how many there are.
        growth: of the whole.
        moved: (3,) where the world's origin comes to lie by growth and shift [m].
    """

    def __init__(self, nodes: int, growth: float, moved: Array) -> None:
        self._growth, self._moved = growth, moved
        self._motions: list[Array] = []
        self._parameters: list[int] = []
        self._owners: list[list[int]] = [[] for _ in range(nodes)]

    def add(self, parameter: int, nodes: Sequence[int], M: Array, v: Array) -> None:
        """A parameter moves some nodes by M (3, 3) p + v (3,) before the whole grows."""
        for node in nodes:
            self._owners[node].append(len(self._motions))
        self._parameters.append(parameter)
        self._motions.append(np.column_stack([M, self._growth * v - M @ self._moved]).reshape(12))

    def placement(self, packed: PackedOutlines, X_WN: Array) -> Placement:
        """The body with these motions."""
        starts = np.cumsum([0, *(len(owned) for owned in self._owners)])
        owners = np.array([one for owned in self._owners for one in owned], dtype=np.int64)
        parameters = np.array(self._parameters, dtype=np.int64)[owners]
        return Placement(packed, X_WN, np.array(self._motions), starts, owners, parameters)


class ProportionedBody(BodyParameters):
    """A body's parameters: its tree's values, ROOT_NAMES, then lengths of nodes, widths of limbs.

    A limb is a chain of nodes of which each carries the next alone.

    Attributes:
        axes: (nodes,) the axis 0, 1 or 2 of its frame along which each node is long.
        limbs: (nodes,) the limb that each node belongs to.

    Args:
        kinematics: the pose tree's.
        surfaces: the pose tree's.
    """

    def __init__(self, kinematics: TreeKinematics, surfaces: TreeSurfaces) -> None:
        super().__init__(kinematics, surfaces.rigid, surfaces=surfaces)
        nodes = kinematics.tree.nodes
        self.limbs = np.zeros(len(nodes), dtype=np.int64)
        firsts: list[str] = []
        for i, node in enumerate(nodes):
            if node.parent >= 0 and len(nodes[node.parent].children) == 1:
                self.limbs[i] = self.limbs[node.parent]
            else:
                self.limbs[i] = len(firsts)
                firsts.append(node.name)
        self.length_names = tuple(f"{LENGTH_PREFIX}{node.name}" for node in nodes)
        self.width_names = tuple(f"{WIDTH_PREFIX}{name}" for name in firsts)
        self.names = (*kinematics.names, *ROOT_NAMES, *self.length_names, *self.width_names)
        self.axes = self._find_axes()

    def _find_axes(self) -> NDArray[np.int64]:
        X_WN = self.kinematics.poses(self.kinematics.flatten(self.kinematics.tree.default_values()))
        axes = np.zeros(len(X_WN), dtype=np.int64)
        for i, node in enumerate(self.kinematics.tree.nodes):
            places = X_WN[list(node.children), :3, 3] - X_WN[i, :3, 3]
            along = np.abs(places @ X_WN[i, :3, :3]).sum(axis=0)
            if not np.any(along > 0.0):
                vertices = node.mesh.vertices
                along = np.abs(vertices.mean(axis=0)) if len(vertices) else np.ones(3)
            axes[i] = int(np.argmax(along))
        return axes

    def factors(self, theta: Array) -> Array:
        """(nodes, 3) so many times its size each node has along its frame's axes."""
        count = len(self.kinematics.names) + len(ROOT_NAMES)
        nodes = len(self.limbs)
        lengths, widths = theta[count : count + nodes], theta[count + nodes :]
        logs = np.repeat(widths[self.limbs][:, None], 3, axis=1)
        logs[np.arange(nodes), self.axes] = lengths
        return np.asarray(np.exp(logs))

    def place(self, theta: Array) -> Placement:
        """The body at all parameters (n,)."""
        kinematics = self.kinematics
        count = len(kinematics.names)
        at_rest = kinematics.motions(theta[:count], translation=True, scale=True)
        scale = self.factors(theta)
        R = at_rest.X_WN[:, :3, :3]
        # How a node's frame, stretched, maps a vector in the world.
        maps = np.einsum("nik,nk,njk->nij", R, scale, R)
        places = at_rest.X_WN[:, :3, 3].copy()
        for i, node in enumerate(kinematics.tree.nodes):
            if node.parent >= 0:
                carried = at_rest.X_WN[i, :3, 3] - at_rest.X_WN[node.parent, :3, 3]
                places[i] = places[node.parent] + maps[node.parent] @ carried
        shift, growth = theta[count : count + 3], float(np.exp(theta[count + 3]))
        moved = places[0] + shift - growth * places[0]
        motions = _MotionList(len(places), growth, moved)
        self._add_values(motions, at_rest, maps, places, growth)
        everything = list(range(len(places)))
        for k in range(3):
            motions.add(count + k, everything, np.zeros((3, 3)), np.eye(3)[k] / growth)
        motions.add(count + 3, everything, np.eye(3), -places[0])
        self._add_proportions(motions, R, places)
        X_WN = at_rest.X_WN.copy()
        X_WN[:, :3, :3] *= growth
        X_WN[:, :3, 3] = moved + growth * places
        return motions.placement(_stretched(self._at(theta[:count]), scale), X_WN)

    def _add_values(
        self, motions: _MotionList, at_rest: Motions, maps: Array, places: Array, growth: float
    ) -> None:
        """The motions that the tree's values make."""
        X0, twists = at_rest.X_WN, at_rest.twists
        cross = affine_motions(np.pad(twists[:, :3], ((0, 0), (0, 4)))).reshape(-1, 3, 4)[:, :, :3]
        for k, i in enumerate(self.kinematics.value_nodes.tolist()):
            velocity = cross[k] @ X0[i, :3, 3] + twists[k, 3:6]
            parent = self.kinematics.tree.nodes[i].parent
            if parent >= 0:
                velocity = maps[parent] @ velocity
            v = velocity - cross[k] @ places[i]
            if i == 0:
                # What moves the root moves the point about which the body has grown.
                v = v + (1.0 / growth - 1.0) * velocity
            motions.add(k, np.flatnonzero(at_rest.moves[:, k]).tolist(), cross[k], v)

    def _add_proportions(self, motions: _MotionList, R: Array, places: Array) -> None:
        """The motions that lengths and widths make: of each node, and of what hangs on it."""
        first, nodes = len(self.kinematics.names) + len(ROOT_NAMES), self.kinematics.tree.nodes
        for i, node in enumerate(nodes):
            axis = R[i][:, self.axes[i]]
            long = np.outer(axis, axis)
            width = first + len(nodes) + int(self.limbs[i])
            for parameter, M in ((first + i, long), (width, np.eye(3) - long)):
                motions.add(parameter, [i], M, -M @ places[i])
                for child in node.children:
                    carried = M @ (places[child] - places[i])
                    motions.add(parameter, self._below(child), np.zeros((3, 3)), carried)

    def _below(self, node: int) -> list[int]:
        """A node and all that hang on it."""
        found = [node]
        for one in found:
            found.extend(self.kinematics.tree.nodes[one].children)
        return found


@dataclass(frozen=True, eq=False)
class FittedProportions:
    """A body's proportions and its pose in the frames that they were fitted to.

    Args:
        factors: (nodes, 3) so many times its size each node has along its frame's axes.
        parameters: (frames, k) the tree's values and ROOT_NAMES.
    """

    factors: Array
    parameters: Array


@dataclass(frozen=True)
class ProportionSettings:
    """How proportions are fitted.

    Args:
        length_deviation, width_deviation: standard deviations of the logarithms of lengths and
            widths, as people differ.
        angle_deviation, shift_deviation, growth_deviation: how far each frame's angles [rad], other
            values and root [m] and the logarithm of its scale may be off where the fit starts.
        rounds: the parts of the fit [pixel].
        noise: what a point of contour is worth [pixel].
    """

    length_deviation: float = 0.15
    width_deviation: float = 0.1
    angle_deviation: float = 0.3
    shift_deviation: float = 0.03
    growth_deviation: float = 0.02
    rounds: tuple[Round, ...] = (Round(15.0, 3.0, 6), Round(6.0, 3.0, 6), Round(3.0, 3.0, 8))
    noise: Noise = field(default_factory=lambda: Noise(2.0, 12.0))


def fit_proportions(
    body: ProportionedBody,
    camera: Camera,
    frames: Sequence[EdgePoints],
    starts: Array,
    settings: ProportionSettings | None = None,
) -> FittedProportions:
    """The proportions of a body that several frames of one camera show, its pose near in each.

    Args:
        body: the body.
        camera: the camera.
        frames: the edges that it sees.
        starts: (frames, k) about what the tree's values and ROOT_NAMES are.
        settings: how.
    """
    settings = settings or ProportionSettings()
    kinematics = body.kinematics
    free = kinematics.lower < kinematics.upper
    values = [name for name, is_free in zip(kinematics.names, free, strict=True) if is_free]
    # A fit's unknown is what is added; limits are those of the values, about each frame's start.
    deviations = np.where(
        kinematics.is_angle[free], settings.angle_deviation, settings.shift_deviation
    )
    moving = np.array([*[settings.shift_deviation] * 3, settings.growth_deviation])
    lower = np.r_[kinematics.lower[free], np.full(4, -np.inf)]
    upper = np.r_[kinematics.upper[free], np.full(4, np.inf)]
    names = [*values, *ROOT_NAMES]
    own = choose(body.names, names, lower=lower, upper=upper, deviation=np.r_[deviations, moving])
    lengths = choose(
        body.names, body.length_names, shared=True, deviation=settings.length_deviation
    )
    widths = choose(body.names, body.width_names, shared=True, deviation=settings.width_deviation)
    unknowns = join(own, lengths, widths)
    fit = FramesFit(body, [camera], unknowns, noise=settings.noise, pixels=1.0)
    held = np.zeros((len(frames), len(body.names)))
    held[:, : starts.shape[1]] = starts
    first = held[:, own.entries].copy()
    held[:, own.entries] = 0.0
    shared = np.zeros(len(unknowns.names) - len(names))
    evidence = [pack_evidence([edge]) for edge in frames]
    found = fit.fit(evidence, held, first, shared, settings.rounds)
    parameters = found.parameters[:, : starts.shape[1]]
    return FittedProportions(body.factors(found.parameters[0][: len(body.names)]), parameters)


def _stretched(packed: PackedOutlines, scale: Array) -> PackedOutlines:
    """Surfaces, each node's so many times (nodes, 3) as large along its frame's axes."""
    points, planes, balls = packed.points.copy(), packed.planes.copy(), packed.balls.copy()
    for node, s in enumerate(scale):
        vertices = slice(packed.starts[node, 0], packed.starts[node + 1, 0])
        triangles = slice(packed.starts[node, 1], packed.starts[node + 1, 1])
        points[:, vertices] *= s[:, None]
        volume = float(np.prod(s))
        planes[:3, triangles] *= (volume / s)[:, None]
        planes[3, triangles] *= volume
    balls[:, :3] *= scale
    balls[:, 3] *= scale.max(axis=1)
    return packed._replace(points=points, planes=planes, balls=balls)
