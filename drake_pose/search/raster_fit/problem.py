"""A pose's refinement as a problem of least squares: poses, normal equations, J."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.search.estimates import View
from drake_pose.search.raster_fit.body import Freedom, RefinementBody
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
from drake_pose.search.raster_fit.placing import place_surfaces
from drake_pose.silhouette.contours.contour_body import ContourBody, contour_body

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
