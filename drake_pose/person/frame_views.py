"""What all cameras say in a frame, whether their edges are in this process or kept elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.fit.camera_sums import (
    AddUp,
    CameraSum,
    EdgeKeeper,
    SumRequest,
    Views,
    add_cameras,
    add_sums,
    compare_placed,
)
from drake_pose.fit.contour_fit import ContourFit, pack_cameras
from drake_pose.fit.evidence import EdgePoints, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement
from drake_pose.person.rays import meeting_of_all
from drake_pose.person.silhouette_view import SilhouetteView

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Guesses are judged by this many cameras, in pictures with about this many rows.
_JUDGES = 5
_ROWS = 120


@dataclass(frozen=True, eq=False)
class FrameViews:
    """What all cameras say in a frame, and small pictures of a few, for coarse judgement.

    Args:
        cameras: all that have a picture.
        views: what each of them says.
    """

    cameras: Sequence[Camera]
    views: Sequence[SilhouetteView]
    _packed: dict[tuple[int, ...], Views] = field(default_factory=dict, init=False, repr=False)

    def add_up(self, fit: ContourFit) -> AddUp:
        """What compares a body's contours with all cameras and adds up.

        Edges that are kept elsewhere are compared there. What does not come from there is compared
        here: the answer is the same, but for the order of the sum.

        Args:
            fit: says how cameras are weighed.
        """
        here = tuple(k for k, view in enumerate(self.views) if view.kept is None)

        def total(placement: Placement, step: AnnealingStage) -> CameraSum:
            weights = fit.weights(self._arrays, placement, step)
            asked = [
                (keeper, index, keeper.ask(self._request(index, placement, weights)))
                for keeper, index in self._kept
            ]
            parts = [self._compared(here, placement, weights)] if here or not asked else []
            for keeper, index, is_asked in asked:
                answer = keeper.answer() if is_asked else None
                parts.append(answer or self._compared(index, placement, weights))
            return parts[0] if len(parts) == 1 else add_sums(parts, len(placement.X_WN))

        return total

    @cached_property
    def _arrays(self) -> tuple[Array, Array]:
        """X_CW (c, 4, 4) and kernel parameters (c, 8)."""
        return pack_cameras(self.cameras)

    @cached_property
    def _kept(self) -> list[tuple[EdgeKeeper, tuple[int, ...]]]:
        """Who keeps edges elsewhere, and of which cameras."""
        found: dict[int, tuple[EdgeKeeper, list[int]]] = {}
        for k, view in enumerate(self.views):
            if view.kept is not None:
                keeper = view.kept.keeper
                found.setdefault(id(keeper), (keeper, []))[1].append(k)
        return [(keeper, tuple(index)) for keeper, index in found.values()]

    def _request(self, index: tuple[int, ...], placement: Placement, weights: Array) -> SumRequest:
        kept = [self.views[k].kept for k in index]
        chosen = list(index)
        return SumRequest(
            [one.camera for one in kept if one is not None],
            np.array([one.time for one in kept if one is not None]),
            (self._arrays[0][chosen], self._arrays[1][chosen]),
            weights[chosen],
            placement.packed,
            placement.X_WN,
        )

    def _compared(self, index: tuple[int, ...], placement: Placement, weights: Array) -> CameraSum:
        """Some cameras compared in this process, and added up."""
        chosen = list(index)
        if index not in self._packed:
            cameras = self._arrays[0][chosen], self._arrays[1][chosen]
            evidence = pack_evidence([self.views[k].edge for k in index])
            self._packed[index] = Views(cameras, evidence)
        packed, X_WN = placement.packed, placement.X_WN
        return add_cameras(*compare_placed(packed, X_WN, self._packed[index], weights[chosen]))

    @cached_property
    def seers(self) -> list[int]:
        """Which cameras see somebody."""
        return [k for k, view in enumerate(self.views) if len(view.edge.uv)]

    @cached_property
    def judges(self) -> list[int]:
        """Which of them judge guesses; a few, as far as possible all around."""
        count = min(_JUDGES, len(self.seers))
        chosen = np.linspace(0, len(self.seers), count, endpoint=False).astype(int)
        return [self.seers[k] for k in chosen]

    @cached_property
    def small(self) -> tuple[list[Camera], list[Mask]]:
        """The judges' cameras and regions with fewer pixels."""
        strides = [max(1, self.views[k].region.shape[0] // _ROWS) for k in self.judges]
        return (
            [_coarser(self.cameras[k], n) for k, n in zip(self.judges, strides, strict=True)],
            [self.views[k].region[::n, ::n] for k, n in zip(self.judges, strides, strict=True)],
        )

    @cached_property
    def coarse(self) -> tuple[list[Camera], list[EdgePoints]]:
        """The judges' cameras and every other point of their edges."""
        edges = [self.views[k].edge for k in self.judges]
        return [self.cameras[k] for k in self.judges], [
            EdgePoints(edge.uv[::2], edge.normals[::2], 2.0 * edge.lengths[::2], edge.middle)
            for edge in edges
        ]

    def middle(self) -> Array | None:
        """(3,) where somebody is [m]; None where fewer than two cameras see one."""
        if len(self.seers) < 2:
            return None
        return meeting_of_all(
            [self.cameras[k] for k in self.seers], [self.views[k].edge.middle for k in self.seers]
        )


def _coarser(camera: Camera, stride: int) -> Camera:
    """The camera of every so manieth pixel of every so manieth row."""
    smaller = replace(
        camera,
        width=-(-camera.width // stride),
        height=-(-camera.height // stride),
        center_x=camera.center_x / stride,
        center_y=camera.center_y / stride,
    )
    if isinstance(smaller, ParallelCamera):
        return replace(smaller, pixels_per_metre=smaller.pixels_per_metre / stride)
    return replace(smaller, focal_x=smaller.focal_x / stride, focal_y=smaller.focal_y / stride)
