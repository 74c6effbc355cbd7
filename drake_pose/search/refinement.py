"""Refine a pose to a local optimum of the area J in which drawn body and silhouette differ.

The Levenberg-Marquardt steps x solve

    (H + d diag(H) + d0 I) x = -g

with H, g the normal equations of the distances between the body's contour and the silhouette's
border along raster lines (``fit.raster_lines``), and the damping d (relative), d0 [pixel^2/rad^2].
The first passes use few lines and a large scale of distances, the last ones all lines and a small
scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.kernel import assemble_normal_equations
from drake_pose.fit.levenberg_marquardt import Equations, StepSettings, damped_step
from drake_pose.fit.parameters import BodyParameters, Placement
from drake_pose.fit.raster_lines import Border, compare_raster, find_body_border, find_border
from drake_pose.search.estimates import View
from drake_pose.silhouette.outline import PackedSurfaces, TreeSurfaces
from drake_pose.silhouette.scoring import draw_packed


@dataclass(frozen=True)
class Pass:
    """One pass of a refinement by pixels (see ``refinement``)."""

    iterations: int  # Greatest number of steps.
    stride: int  # Every stride-th row and column is compared.
    scale: float  # Scale of the robust cost: larger distances lose weight [pixel].
    damping: float  # Added to the diagonal of the normal equations [pixel^2/rad^2].
    longest_step: float = 0.25  # Greatest change of a parameter in a step [rad or m].
    slack: float = 0.0  # Dead zone: distances up to this have hardly any weight [pixel].


# Passes of a refinement by pixels: from a coarse pose, from a near one, and to the optimum.
#
# A pixel is wrong if the contour is more than half a pixel from the border on the pixel's raster
# line. A smaller distance carries no information: the border is uniformly distributed between two
# pixel centres. A least-squares pose leaves 0.02 to 0.03 of the border's pixels wrong. A pose
# within half a pixel on all lines leaves 0.005 to 0.015 wrong and is half as far from the true
# pose. The slack of the last passes is 0.4 instead of 0.5 pixels, so that the pose does not end on
# the bounds of this region.
COARSE_PASSES = (Pass(8, 4, 50.0, 300.0), Pass(8, 4, 10.0, 100.0))
FINE_PASSES = (Pass(5, 2, 6.0, 30.0), Pass(6, 2, 3.0, 10.0), Pass(8, 1, 2.0, 5.0))
LAST_PASSES = (Pass(5, 2, 2.0, 5.0), Pass(15, 1, 1.0, 0.5, slack=0.4))


class Freedom(NamedTuple):
    """The parameters of a refinement that may change."""

    columns: np.ndarray  # (k,) int64 their indices.
    moved: np.ndarray  # (nodes,) bool whether they move each node.


class RefinementBody:
    """A pose tree prepared for refinement.

    The parameters (m + 4,) of a pose are the tree's m values [rad or m] and ROOT_NAMES: the shift
    of the root [m] and the body's log scale.

    Attributes:
        tree, kinematics: the pose tree and its kinematics.
        surfaces: the surfaces of all nodes.
        skin: (vertices,) for each packed vertex the fraction of its motion that is its own node's
            (the rest is that of the node's parent), and (nodes,) int64 the nodes' parents.
        lower, upper: (m + 4,) limits of the parameters, infinite where an angle turns around.
    """

    def __init__(self, tree: PoseTree) -> None:
        self.tree, self.kinematics = tree, TreeKinematics(tree)
        self.surfaces = surfaces = TreeSurfaces(tree)
        self._parameters = BodyParameters(self.kinematics, surfaces.rigid)
        middle = np.clip(0.0, self.kinematics.lower, self.kinematics.upper)
        moves = self.kinematics.motions(middle, translation=True, scale=True).moves
        # Mimic joints move only nodes that their leading value moves, too.
        self._moves = np.hstack([moves[:, : len(middle)], moves[:, -4:]])
        self._packed = PackedSurfaces(surfaces)
        weights = []
        for rigid, skin in zip(surfaces.rigid, surfaces.skins, strict=True):
            weights.append(np.ones(len(rigid.vertices)))
            if skin is not None:
                weights.append(1.0 - skin.weights if skin.inverted else skin.weights)
        parents = np.array([node.parent for node in tree.nodes], dtype=np.int64)
        self.skin = np.concatenate(weights), parents
        unlimited = np.full(4, np.inf)
        self.lower = np.concatenate([self.kinematics.lower, -unlimited])
        self.upper = np.concatenate([self.kinematics.upper, unlimited])

    def parameters(
        self, node_values: Sequence[np.ndarray], root_position: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the parameters (m + 4,) of node values (k,), at the model's own scale.

        ``root_position``: (3,) position of the first root [m]; None: that of the tree.
        """
        parameters = np.append(self.kinematics.flatten(node_values), np.zeros(4))
        if root_position is not None:
            parameters[-4:-1] = root_position - self.poses(parameters)[0, :3, 3]
        return parameters

    def node_values(self, parameters: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return each node's values (k,) [rad or m] at parameters (m + 4,)."""
        return self.kinematics.split(parameters[:-4])

    def nearest_turns(self, parameters: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return parameters (m + 4,) in the turns nearest to ``near``, see ``TreeKinematics``."""
        values = None if near is None else near[:-4]
        turned = self.kinematics.nearest_turns(parameters[:-4], values)
        return np.concatenate([turned, parameters[-4:]])

    def freedom(self, nodes: Sequence[int] | None = None, extra: Sequence[int] = ()) -> Freedom:
        """Return the parameters that may change: some nodes' values that are not fixed by limits.

        ``nodes``: indices of these nodes; None: all nodes. ``extra``: indices into ROOT_NAMES of
        further parameters.
        """
        kinematics = self.kinematics
        chosen = kinematics.upper > kinematics.lower
        if nodes is not None:
            chosen &= np.isin(kinematics.value_nodes, list(nodes))
        columns = [*np.flatnonzero(chosen), *(len(chosen) + k for k in extra)]
        return Freedom(
            np.array(columns, dtype=np.int64), np.asarray(self._moves[:, columns].any(axis=1))
        )

    def place(
        self, parameters: np.ndarray, *, bent: bool = True, rooted: bool = False
    ) -> Placement:
        """Return the body placed at parameters (m + 4,), in arrays that the next call overwrites.

        ``parameters``: (m + 4,) the pose, as in ``RefinementBody``. ``bent``: whether the skin is
        deformed to the pose; else it keeps its last shape. ``rooted``: whether derivatives by
        ROOT_NAMES are included even if these are zero.
        """
        rooted = rooted or bool(parameters[-4:].any())
        values = parameters if rooted else parameters[:-4]
        packed = self._packed.bend_to(parameters[:-4] if bent else None)
        return self._parameters.place(values)._replace(packed=packed)

    def poses(self, parameters: np.ndarray) -> np.ndarray:
        """Return X_WN (nodes, 4, 4) at parameters (m + 4,), scaled by the log scale."""
        return self.place(parameters, bent=False).X_WN


class RefinementProblem:
    """One body and the silhouettes of one frame, compared pixel by pixel.

    Args:
        body: the body.
        views: the silhouettes, one per camera; at least one.

    Attributes:
        area: total area of the silhouettes [pixel].
        border_length: approximate length of their borders [pixel].
    """

    def __init__(self, body: RefinementBody, views: Sequence[View]) -> None:
        self.body, self.views = body, tuple(views)
        self.area = float(sum(np.count_nonzero(view.mask) for view in views))
        self._silhouettes = [find_border(view.mask) for view in views]
        cameras = [view.camera for view in views]
        self._cameras = [(np.ascontiguousarray(k.X_CW), k.kernel_parameters()) for k in cameras]
        self._nothing = [Border.empty(*view.mask.shape) for view in views]
        self.border_length = sum(border.length for border in self._silhouettes)

    def mismatch(self, parameters: np.ndarray) -> list[np.ndarray]:
        """Return by view (H, W) bool where body at parameters (m + 4,) and silhouette differ."""
        placed = self.body.place(parameters)
        return [
            draw_packed(placed.packed, view.camera.X_CW @ placed.X_WN, view.camera) != view.mask
            for view in self.views
        ]

    def J(self, parameters: np.ndarray) -> int:
        """Return the objective J at parameters (m + 4,): the area of the mismatch [pixel]."""
        return sum(int(np.count_nonzero(one)) for one in self.mismatch(parameters))

    def fixed_borders(self, parameters: np.ndarray, moved: np.ndarray) -> list[Border]:
        """Return for each view the border of all nodes that are not ``moved`` (nodes,), or none."""
        if moved.all():
            return self._nothing
        placed = self.body.place(parameters)
        return [
            find_body_border(placed.packed, placed.X_WN, ~moved, camera) for camera in self._cameras
        ]

    def equations(
        self,
        parameters: np.ndarray,
        freedom: Freedom,
        part: Pass,
        offset: int,
        fixed_borders: Sequence[Border] | None = None,
    ) -> tuple[Equations, float]:
        """Return the normal equations of the distances along raster lines.

        Args:
            parameters: (m + 4,) the pose, as in ``RefinementBody``.
            freedom: the k parameters that may change.
            part: stride, scale and slack of the comparison.
            offset: first raster line that is compared, below the stride.
            fixed_borders: the border in each view of the nodes that do not move; None: computed
                here.

        Returns the equations, H (1, k, k) and g (1, k), whose cost is approximately J [pixel]; and
        the mean of the weighted squared distances [pixel^2].
        """
        free, moved = freedom
        if fixed_borders is None:
            fixed_borders = self.fixed_borders(parameters, moved)
        rooted = bool((free >= len(parameters) - 4).any())
        placed = self.body.place(parameters, rooted=rooted)
        nodes = len(placed.X_WN)
        A, b, sums = np.zeros((nodes, 12, 12)), np.zeros((nodes, 12)), np.zeros(3)
        for camera, fixed, border in zip(
            self._cameras, fixed_borders, self._silhouettes, strict=True
        ):
            sums += compare_raster(
                placed.packed, self.body.skin, placed.X_WN, moved, camera, fixed, border,
                (part.stride, offset), part.scale, part.slack, A, b,
            )  # fmt: skip
        H, g = assemble_normal_equations(
            A, b, placed.motions, placed.starts, placed.owners, placed.parameters, len(parameters)
        )
        cost, weight, squares = sums.tolist()
        equations = Equations(H[np.ix_(free, free)][None], g[free][None], cost)
        return equations, squares / max(weight, 1e-9)


def descend(
    problem: RefinementProblem,
    parameters: np.ndarray,
    freedom: Freedom,
    passes: Sequence[Pass],
    fixed_borders: Sequence[Border] | None = None,
    standstill: float = 5e-4,
    damping: float = 1e-3,
) -> tuple[np.ndarray, float, int]:
    """Refine some of the parameters of a pose by passes of Levenberg-Marquardt steps.

    Args:
        problem: the silhouettes and the body.
        parameters: (m + 4,) the start, as in ``RefinementBody``.
        freedom: the parameters that may change.
        passes: the passes, run one after another.
        fixed_borders: the border in each view of the nodes that do not move; None: computed here.
        standstill: a pass ends when no parameter changes by more in a step [rad or m].
        damping: relative damping d of the normal equations, which makes them solvable.

    Returns the parameters (m + 4,) of least cost in the last pass; this cost, an estimate of J from
    the compared lines [pixel]; and the number of steps of all passes.
    """
    free = freedom.columns
    limits = problem.body.lower[free], problem.body.upper[free]
    if fixed_borders is None:
        fixed_borders = problem.fixed_borders(parameters, freedom.moved)
    steps, least = 0, np.inf
    for part in passes:
        settings = StepSettings(part.longest_step, damping, 0.0)
        best, least = parameters, np.inf
        for iteration in range(part.iterations + 1):
            offset = iteration % part.stride
            equations, _ = problem.equations(parameters, freedom, part, offset, fixed_borders)
            if equations.cost < least:
                best, least = parameters, equations.cost
            if iteration == part.iterations:
                break
            equations.H[0][np.diag_indices(len(free))] += part.damping
            after, _ = damped_step(
                equations, parameters[free][None], np.zeros(0), limits, damping, settings
            )
            steps += 1
            change = np.abs(after[0] - parameters[free]).max(initial=0.0)
            parameters = parameters.copy()
            parameters[free] = after[0]
            if change < standstill:
                break
        parameters = best
    return parameters, least, steps
