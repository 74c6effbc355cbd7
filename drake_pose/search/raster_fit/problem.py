"""A refinement to a local optimum of silhouettes' difference J, drawn by pixels.

Levenberg and Marquardt's steps (H + d diag(H) + d0 I) x = -g on the distances between the body's
contour and the silhouette's border (see ``kernel``): a parameter that would leave its limits is
held there for the step. Passes look at few lines of the raster first and let far distances count,
then at all lines and near distances only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.errors import SettingsError
from drake_pose.fit.levenberg_marquardt import eliminate
from drake_pose.search.estimates import View
from drake_pose.search.raster_fit.body import Freedom, RefinementBody, place_surfaces
from drake_pose.search.raster_fit.kernel import (
    Movements,
    add_normal_equations,
    count_apart,
    find_contour_border,
)
from drake_pose.search.raster_fit.lines import (
    Border,
    add_apart_near,
    find_border,
)
from drake_pose.silhouette.contours.contour_body import ContourBody, contour_body

_AT_LIMIT = 1e-9
# Steps smaller than this [rad or m] end a pass.
_STANDSTILL = 5e-4
# A share of the diagonal, which keeps the equations solvable.
_RELATIVE_DAMPING = 1e-3
# Every so many rows are looked at where areas are only compared.
_NEAR_STRIDE = 2


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations H step = -g of the boundaries' distances, and what they come from.

    Attributes:
        H: (k, k) [pixel^3 per parameter^2].
        g: (k,) [pixel^3 per parameter].
        apart: about what J is [pixel].
        weight: the sum of all weights [pixel].
        squares: that of the weighted squares of all distances [pixel^3].
    """

    H: np.ndarray
    g: np.ndarray
    apart: float
    weight: float
    squares: float


@dataclass(frozen=True, eq=False)
class _ReadyView:
    """One view as the kernels take it."""

    body: ContourBody
    border: Border
    X_CW: np.ndarray
    camera: np.ndarray


class RefinementProblem:
    """The pose of one body in the silhouettes of one instant.

    Attributes:
        body: the body.
        views: the silhouettes.
        area: the silhouettes' area [pixel].
        border_length: about how long their borders are [pixel].

    Args:
        body: the body.
        views: the silhouettes, at least one.
        parameters: (m + 4,) about where the body is.

    Raises:
        SettingsError: if there is no view.
    """

    def __init__(self, body: RefinementBody, views: Sequence[View], parameters: np.ndarray) -> None:
        if not views:
            raise SettingsError("a refinement needs at least one view, but none was given")
        self.body = body
        self.views = tuple(views)
        self.area = float(sum(np.count_nonzero(view.mask) for view in views))
        X_WS = body.poses(parameters)[body.surface_nodes]
        rigid = len(body.outlines) - len(body.skins)
        bodies = [
            contour_body(body.outlines, view.camera.X_CW @ X_WS, view.camera, rigid)
            for view in self.views
        ]
        # Bands bend with the pose, alike for all views.
        self._points, self._planes = bodies[0].points.copy(), bodies[0].planes.copy()
        self._bent = np.full(len(parameters), np.nan)
        self._ready_views = [
            _ReadyView(
                made._replace(points=self._points, planes=self._planes, weights=body.weights),
                find_border(view.mask),
                np.ascontiguousarray(view.camera.X_CW),
                view.camera.kernel_parameters(),
            )
            for made, view in zip(bodies, self.views, strict=True)
        ]
        # A border crosses |cos| of its length in rows and |sin| in columns: 4 / pi on average.
        crossed = sum(
            len(view.border.row_places) + len(view.border.column_places)
            for view in self._ready_views
        )
        self.border_length = crossed * np.pi / 4.0

    def _placed(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The poses X_WS of all surfaces and the parameters' twists; bends the bands."""
        return place_surfaces(
            self.body.surfaces, parameters, self._bent, self._points, self._planes
        )

    def still(self, parameters: np.ndarray, nodes: Sequence[int]) -> list[Border]:
        """The border in each view of the union of all surfaces but those of some nodes."""
        return self._borders(parameters, ~np.isin(self.body.surface_nodes, nodes))

    def _borders(self, parameters: np.ndarray, wanted: np.ndarray) -> list[Border]:
        """The border in each view of the union of the surfaces that are wanted (surfaces,)."""
        X_WS = self._placed(parameters)[0]
        return [
            find_contour_border(view.body, view.X_CW, X_WS, view.camera, wanted, view.border)
            for view in self._ready_views
        ]

    def apart_near(self, parameters: np.ndarray, discs: np.ndarray) -> np.ndarray:
        """The area (n,) wrong in discs of all views together [pixel].

        Args:
            parameters: (m + 4,) the pose.
            discs: (views, n, 3) centres and radii [pixel].
        """
        areas = np.zeros(discs.shape[1])
        borders = self._borders(parameters, np.ones(len(self.body.surface_nodes), dtype=np.bool_))
        for view, border, places in zip(self._ready_views, borders, discs, strict=True):
            add_apart_near(border, view.border, places, _NEAR_STRIDE, areas)
        return areas

    def J(self, parameters: np.ndarray) -> int:
        """Pixels that body or silhouette covers, but not both, in all views together (1)."""
        X_WS = self._placed(parameters)[0]
        return sum(
            count_apart(view.body, view.X_CW, X_WS, view.camera, view.border)
            for view in self._ready_views
        )

    def equations(
        self,
        parameters: np.ndarray,
        freedom: Freedom,
        stride: int,
        offset: int,
        scale: float,
        still: Sequence[Border] | None = None,
        slack: float = 0.0,
    ) -> Equations:
        """The normal equations at a pose.

        Args:
            parameters: (m + 4,).
            freedom: which of them may change.
            stride, offset, scale: as in ``add_normal_equations``.
            still: the border in each view of what does not move; None: made here.
            slack: as in ``add_normal_equations``.
        """
        X_WS, twists = self._placed(parameters)
        movements = Movements(
            X_WS,
            twists,
            freedom.columns,
            freedom.movers,
            freedom.own,
            freedom.mover_starts,
            freedom.moved,
        )
        count = len(freedom.columns)
        H, g, sums = np.zeros((count, count)), np.zeros(count), np.zeros(3)
        borders = self._borders(parameters, ~freedom.moved) if still is None else still
        for view, border in zip(self._ready_views, borders, strict=True):
            sums += add_normal_equations(
                view.body, border, view.border, movements, view.X_CW, view.camera,
                stride, offset, scale, slack, H, g,
            )  # fmt: skip
        return Equations(H, g, *sums.tolist())


@dataclass(frozen=True)
class Pass:
    """One part of a refinement.

    Args:
        iterations: at most so many steps.
        stride: every so many rows and columns are looked at.
        scale: distances beyond it lose weight [pixel].
        damping: added to the diagonal of the normal equations [pixel^3/rad^2]: what the silhouettes
            hardly show hardly moves.
        longest_step: steps are shortened so that no parameter changes by more [rad or m].
        slack: distances up to this along a line hardly count, those beyond it by what they are
            more; 0: all count [pixel].
    """

    iterations: int
    stride: int
    scale: float
    damping: float
    longest_step: float = 0.25
    slack: float = 0.0

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.stride < 1:
            raise SettingsError(
                f"a pass needs 1 iteration and a stride of 1 or more, not {self.iterations} and "
                f"{self.stride}"
            )
        if not 0.0 <= self.slack <= 0.5:
            raise SettingsError(f"slack must lie between 0 and 0.5 pixel, not {self.slack}")
        for name in ("scale", "damping", "longest_step"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"{name} must be positive, not {getattr(self, name)}")


COARSE_PASSES = (Pass(8, 4, 50.0, 300.0), Pass(8, 4, 10.0, 100.0))
"""From far: several nodes may be off by their own width."""

FINE_PASSES = (Pass(5, 2, 6.0, 30.0), Pass(6, 2, 3.0, 10.0), Pass(8, 1, 2.0, 5.0))
"""From near, to the local optimum."""

LAST_PASSES = (Pass(5, 2, 2.0, 5.0), Pass(15, 1, 1.0, 0.5, slack=0.4))
"""To the optimum itself, where directions count that the silhouettes hardly show.

A pixel is wrong where the contour is more than half a pixel from the border on its line. What is
less says nothing: the border lies anywhere between two pixel centres, alike likely. The mean of
least squares leaves the share 0.02 to 0.03 of the border's pixels wrong; drawn into the bounds that
all lines set together, a pose leaves 0.005 to 0.015 and is half as far from the true one, as an
estimate from bounds is where noise is uniform. 0.4 instead of 0.5 keeps it from resting on bounds.
"""


def descend(
    problem: RefinementProblem,
    parameters: np.ndarray,
    freedom: Freedom,
    passes: Sequence[Pass],
    still: Sequence[Border] | None = None,
) -> tuple[np.ndarray, float, int]:
    """Refine some parameters.

    Args:
        problem: the body and the silhouettes.
        parameters: (m + 4,) to start from.
        freedom: which of them may change.
        passes: one after another.
        still: the border in each view of what they do not move; None: made here.

    Returns:
        The parameters with the least difference met in the last pass, that difference as far as
        its lines show it [pixel], and the number of steps.
    """
    lower = problem.body.lower[freedom.columns]
    upper = problem.body.upper[freedom.columns]
    steps = 0
    least = np.inf
    still = problem.still(parameters, freedom.nodes) if still is None else still
    for part in passes:
        best, least = parameters, np.inf
        for iteration in range(part.iterations + 1):
            offset = iteration % part.stride
            equations = problem.equations(
                parameters, freedom, part.stride, offset, part.scale, still, part.slack
            )
            if equations.apart < least:
                best, least = parameters, equations.apart
            if iteration == part.iterations:
                break
            current = parameters[freedom.columns]
            step = limited_step(
                equations.H, equations.g, current, lower, upper, part.damping, part.longest_step
            )
            steps += 1
            parameters = parameters.copy()
            parameters[freedom.columns] = np.clip(current + step, lower, upper)
            if np.abs(step).max(initial=0.0) < _STANDSTILL:
                break
        parameters = best
    return parameters, least, steps


@compiled
def limited_step(
    H: np.ndarray,
    g: np.ndarray,
    current: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    damping: float,
    longest: float,
) -> np.ndarray:
    """The damped step (k,) of normal equations H step = -g that stays inside limits.

    Args:
        H, g: (k, k) and (k,).
        current, lower, upper: (k,) where the parameters are, and their limits.
        damping: added to the diagonal.
        longest: no parameter changes by more.
    """
    count = len(current)
    step = np.zeros(count)
    active = np.arange(count)
    while len(active) > 0:
        step[:] = 0.0
        block = np.empty((len(active), len(active) + 1))
        for i in range(len(active)):
            block[i, -1] = -g[active[i]]
            for j in range(len(active)):
                block[i, j] = H[active[i], active[j]]
            block[i, i] += damping + _RELATIVE_DAMPING * block[i, i]
        eliminate(block)
        step[active] = block[:, -1]
        step *= min(1.0, longest / max(np.abs(step).max(), 1e-300))
        leaving = (step < 0.0) & (current <= lower + _AT_LIMIT)
        leaving |= (step > 0.0) & (current >= upper - _AT_LIMIT)
        if not leaving.any():
            break
        step[leaving] = 0.0
        active = active[~leaving[active]]
    return step
