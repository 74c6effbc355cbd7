"""A refinement to a local optimum of silhouettes' difference J, drawn by pixels.

Levenberg and Marquardt's steps (H + d diag(H) + d0 I) x = -g on the distances between the body's
contour and the silhouette's border (see ``fit.raster_lines``). Passes look at few lines of the
raster first and let far distances count, then at all lines and near distances only.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.kernel import assemble_normal_equations
from drake_pose.fit.levenberg_marquardt import Equations, StepSettings, damped_step
from drake_pose.fit.parameters import BodyParameters, Placement
from drake_pose.fit.raster_lines import (
    Border,
    compare_raster,
    find_body_border,
    find_border,
)
from drake_pose.search.estimates import View, require_views
from drake_pose.search.settings import Pass
from drake_pose.silhouette.outline import PackedSurfaces, TreeSurfaces
from drake_pose.silhouette.scoring import draw_packed


class Freedom(NamedTuple):
    """The parameters that may change, columns (k,) int64, and which nodes moved (nodes,) bool."""

    columns: np.ndarray
    moved: np.ndarray


class RefinementBody:
    """A pose tree ready for refinement, made once and matched to many pictures.

    The parameters (m + 4,) are the tree's m values and, after them, ROOT_NAMES; their limits
    ``lower`` and ``upper`` are infinite where an angle turns around.
    """

    def __init__(self, tree: PoseTree) -> None:
        self.tree, self.kinematics = tree, TreeKinematics(tree)
        self.surfaces = surfaces = TreeSurfaces(tree)
        self._parameters = BodyParameters(self.kinematics, surfaces.rigid)
        middle = np.clip(0.0, self.kinematics.lower, self.kinematics.upper)
        moves = self.kinematics.motions(middle, translation=True, scale=True).moves
        # What follows a value hangs on what the value moves.
        self._moves = np.hstack([moves[:, : len(middle)], moves[:, -4:]])
        self._packed = PackedSurfaces(surfaces)
        shares = []
        for rigid, skin in zip(surfaces.rigid, surfaces.skins, strict=True):
            shares.append(np.ones(len(rigid.vertices)))
            if skin is not None:
                shares.append(1.0 - skin.weights if skin.inverted else skin.weights)
        parents = np.array([node.parent for node in tree.nodes], dtype=np.int64)
        self.skin = np.concatenate(shares), parents
        unlimited = np.full(4, np.inf)
        self.lower = np.concatenate([self.kinematics.lower, -unlimited])
        self.upper = np.concatenate([self.kinematics.upper, unlimited])

    def parameters(
        self, node_values: Sequence[np.ndarray], root_position: np.ndarray | None = None
    ) -> np.ndarray:
        """The parameters (m + 4,) of a pose of the body's own size.

        ``root_position``: (3,) where the first root is [m]; None: where the tree says.
        """
        parameters = np.append(self.kinematics.flatten(node_values), np.zeros(4))
        if root_position is not None:
            parameters[-4:-1] = root_position - self.poses(parameters)[0, :3, 3]
        return parameters

    def node_values(self, parameters: np.ndarray) -> tuple[np.ndarray, ...]:
        """Each node's values."""
        return self.kinematics.split(parameters[:-4])

    def nearest_turns(self, parameters: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """The same pose's parameters, angles in the turn nearest to others (m + 4,).

        Without others, where answers are given: see ``TreeKinematics.nearest_turns``.
        """
        values = None if near is None else near[:-4]
        turned = self.kinematics.nearest_turns(parameters[:-4], values)
        return np.concatenate([turned, parameters[-4:]])

    def freedom(self, nodes: Sequence[int] | None = None, extra: Sequence[int] = ()) -> Freedom:
        """The values of some nodes (None: all) that are not held, and some of ROOT_NAMES."""
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
        """The body at parameters (m + 4,), in arrays that the next call changes.

        ``bent``: else its skin stays; ``rooted``: whether it says how ROOT_NAMES move it, too.
        """
        rooted = rooted or bool(parameters[-4:].any())
        values = parameters if rooted else parameters[:-4]
        packed = self._packed.bend_to(parameters[:-4] if bent else None)
        return self._parameters.place(values)._replace(packed=packed)

    def poses(self, parameters: np.ndarray) -> np.ndarray:
        """Poses X_WN (nodes, 4, 4), scaled where the body has grown."""
        return self.place(parameters, bent=False).X_WN


class RefinementProblem:
    """The pose of one body in the silhouettes of one instant.

    ``area`` of the silhouettes, and about how long their borders are, ``border_length`` [pixel].

    Raises:
        SettingsError: if there is no view.
    """

    def __init__(self, body: RefinementBody, views: Sequence[View]) -> None:
        require_views(views)
        self.body, self.views = body, tuple(views)
        self.area = float(sum(np.count_nonzero(view.mask) for view in views))
        self._silhouettes = [find_border(view.mask) for view in views]
        self._cameras = [
            (np.ascontiguousarray(view.camera.X_CW), view.camera.kernel_parameters())
            for view in views
        ]
        self._nothing = [Border.nothing(*view.mask.shape) for view in views]
        self.border_length = sum(border.length for border in self._silhouettes)

    def wrong(self, parameters: np.ndarray) -> list[np.ndarray]:
        """In each view the pixels (H, W) bool that body or silhouette covers, but not both."""
        placed = self.body.place(parameters)
        return [
            draw_packed(placed.packed, view.camera.X_CW @ placed.X_WN, view.camera) != view.mask
            for view in self.views
        ]

    def J(self, parameters: np.ndarray) -> int:
        """Pixels that body or silhouette covers, but not both, in all views together (1)."""
        return sum(int(np.count_nonzero(wrong)) for wrong in self.wrong(parameters))

    def still(self, parameters: np.ndarray, moved: np.ndarray) -> list[Border]:
        """The border in each view of all nodes but some (nodes,) bool."""
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
        offset: int = 0,
        still: Sequence[Border] | None = None,
    ) -> tuple[Equations, float]:
        """The normal equations of some parameters at a pose (m + 4,).

        Args:
            offset: the first line that is looked at.
            still: the border in each view of what they do not move; None: made here.

        Returns:
            H (1, k, k) and g (1, k) of distances along raster lines, their cost about J [pixel];
                and the mean of weighted squared distances [pixel^2].
        """
        free, moved = freedom
        still = self.still(parameters, moved) if still is None else still
        rooted = bool((free >= len(parameters) - 4).any())
        placed = self.body.place(parameters, rooted=rooted)
        nodes = len(placed.X_WN)
        A, b, sums = np.zeros((nodes, 12, 12)), np.zeros((nodes, 12)), np.zeros(3)
        for camera, rest, border in zip(self._cameras, still, self._silhouettes, strict=True):
            sums += compare_raster(
                placed.packed, self.body.skin, placed.X_WN, moved, camera, rest, border,
                (part.stride, offset), part.scale, part.slack, A, b,
            )  # fmt: skip
        H, g = assemble_normal_equations(
            A, b, placed.motions, placed.starts, placed.owners, placed.parameters, len(parameters)
        )
        apart, weight, squares = sums.tolist()
        equations = Equations(H[np.ix_(free, free)][None], g[free][None], apart)
        return equations, squares / max(weight, 1e-9)


def descend(
    problem: RefinementProblem,
    parameters: np.ndarray,
    freedom: Freedom,
    passes: Sequence[Pass],
    still: Sequence[Border] | None = None,
    standstill: float = 5e-4,
    damping: float = 1e-3,
) -> tuple[np.ndarray, float, int]:
    """Refine some of the parameters (m + 4,), one pass after another.

    ``still``: the border in each view of what they do not move; None: made here. A step of less
    than ``standstill`` [rad or m] ends a pass; ``damping``: a share of the diagonal, which keeps
    the equations solvable.

    Returns:
        The parameters with the least difference met in the last pass, that difference as far as
            its lines show it [pixel], and the number of steps.
    """
    free = freedom.columns
    limits = problem.body.lower[free], problem.body.upper[free]
    still = problem.still(parameters, freedom.moved) if still is None else still
    steps, least = 0, np.inf
    for part in passes:
        settings = StepSettings(part.longest_step, damping, 0.0)
        best, least = parameters, np.inf
        for iteration in range(part.iterations + 1):
            offset = iteration % part.stride
            equations, _ = problem.equations(parameters, freedom, part, offset, still)
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
