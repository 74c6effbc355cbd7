"""Frames in which the joint positions of the body are known: of one camera, or of several."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from drake_pose.arrays import Array, Mask
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import MaskError
from drake_pose.fit.evidence import (
    NO_EDGE,
    EdgePoints,
    Evidence,
    Observation,
    find_edge_points,
    pack_evidence,
)
from drake_pose.fit.parameters import BodyParameters
from drake_pose.silhouette.outline import Outline
from drake_pose.silhouette.scoring import prefix_sums

LAST_SPACING = 1.0 / 300.0
"""Of the points of silhouettes' edges in the last parts of a fit [root of the area]."""


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """One picture of a body at known joint positions.

    Args:
        values: (m,) of the body's pose tree [rad or m].
        mask: (H, W) the silhouette.
        foreground: (H, W, 3) log-odds of each pixel to show the body (``fit.background``): a fit
            looks at these and not at the mask, where they are given.
        rates: (m,) velocities of the values [rad/s or m/s], where they are known.
    """

    name: str
    values: Array
    mask: Mask
    foreground: NDArray[np.uint8] | None = None
    rates: Array | None = None


class PosedFrames:
    """All that a camera sees, as a search and a fit take it.

    Args:
        camera: the camera; its pose is not used.
        spacing: from one point of a silhouette's edge to the next [root of the area].

    Attributes:
        X_WN: (frames, nodes, 4, 4) the nodes' poses.
        intrinsics: focal lengths (2,) and principal point (2,) [pixel].
        size: the root of the silhouettes' median area [pixel].

    Raises:
        MaskError: a mask of another size than the camera's picture, or an empty one.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: Sequence[Outline],
        camera: PinholeCamera,
        frames: Sequence[PosedFrame],
        spacing: float = LAST_SPACING,
    ) -> None:
        for frame in frames:
            require_size(camera, frame.name, frame.mask)
            if not frame.mask.any():
                where = f"camera '{camera.name}', frame '{frame.name}'"
                raise MaskError(f"{where}: the mask does not show the body")
        self.kinematics, self.outlines = kinematics, tuple(outlines)
        self.camera, self.frames, self.spacing = camera, tuple(frames), spacing
        self.intrinsics = (
            np.array([camera.focal_x, camera.focal_y]),
            np.array([camera.center_x, camera.center_y]),
        )
        self.X_WN = np.array([kinematics.poses(frame.values) for frame in frames])
        areas = [np.count_nonzero(frame.mask) for frame in frames]
        self.size = float(np.sqrt(np.median(areas)))

    @cached_property
    def points(self) -> list[Array]:
        """Corners (n, 3) of the body's convex hull in each frame, in the world [m]."""
        return self._corners(self.X_WN)

    @cached_property
    def some_points(self) -> Array:
        """(n, 3) the points of all frames, or of about five frames spread over many."""
        return np.concatenate(self._corners(self.X_WN[:: max(1, len(self.X_WN) // 5)]))

    def _corners(self, poses: Array) -> list[Array]:
        own = [_hull_of(outline) for outline in self.outlines]
        return [
            _hull(
                np.concatenate([p @ X[:3, :3].T + X[:3, 3] for p, X in zip(own, X_WN, strict=True)])
            )
            for X_WN in poses
        ]

    @cached_property
    def middle(self) -> Array:
        """(3,) of the bodies' points in the world [m]."""
        return np.asarray(self.some_points.mean(axis=0))

    @cached_property
    def extent(self) -> float:
        """How far the bodies' points are from their middle, root mean square [m]."""
        off = self.some_points - self.middle
        return float(np.sqrt((off**2).sum(axis=1).mean()))

    def observations(self, camera: int, count: int) -> list[Observation]:
        """The frames, the camera being that of an index among a number of cameras."""
        found = []
        for frame, edge in zip(self.frames, self._edges, strict=True):
            edges = pack_evidence([edge if c == camera else NO_EDGE for c in range(count)])
            foreground = tuple(frame.foreground if c == camera else None for c in range(count))
            found.append(Observation(edges, frame.values, foreground, frame.rates))
        return found

    @cached_property
    def body(self) -> BodyParameters:
        """The body's parameters."""
        return BodyParameters(self.kinematics, self.outlines)

    @cached_property
    def _edges(self) -> list[EdgePoints]:
        """Of the silhouettes that fits look at."""
        spacing = max(1.0, round(self.spacing * self.size))
        return [
            NO_EDGE if frame.foreground is not None else find_edge_points(frame.mask, spacing)
            for frame in self.frames
        ]

    def downscaled(self, side: float) -> PinholeCamera:
        """The camera, its pictures so small that the root of the silhouettes' area is a side."""
        camera, share = self.camera, min(1.0, side / self.size)
        width, height = (max(8, round(share * one)) for one in (camera.width, camera.height))
        return camera.resized(width, height)

    def sums(self, frame: int, camera: PinholeCamera) -> NDArray[np.int32]:
        """(H, W + 1) prefix sums of a frame's silhouette in a smaller camera's picture."""
        return reduced_sums(self.frames[frame].mask, camera)


def reduced_sums(mask: Mask, camera: Camera) -> NDArray[np.int32]:
    """(H, W + 1) prefix sums of a silhouette in the smaller pictures of a camera like its own."""
    size = (camera.width, camera.height)
    small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return prefix_sums(small > 0.5)


@lru_cache(maxsize=512)
def _hull_of(outline: Outline) -> Array:
    return _hull(outline.vertices)


def _hull(points: Array) -> Array:
    """Those of points (n, 3) that are corners of their convex hull; a flat body's are all."""
    with suppress(QhullError, ValueError):
        return np.asarray(points[ConvexHull(points).vertices])
    return points


def placed_points(outlines: Sequence[Outline], X_WN: Array) -> Array:
    """(n, 3) the vertices of nodes' surfaces in the world, the nodes at X_WN (nodes, 4, 4)."""
    placed = zip(outlines, X_WN, strict=True)
    return np.concatenate([one.vertices @ X[:3, :3].T + X[:3, 3] for one, X in placed])


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """A frame of several cameras: as ``PosedFrame``, masks and log-odds by the cameras' names."""

    name: str
    values: Array
    masks: Mapping[str, Mask]
    foreground: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    rates: Array | None = None

    def of(self, camera: str) -> PosedFrame:
        """What a camera sees that has a mask."""
        foreground = self.foreground.get(camera)
        return PosedFrame(self.name, self.values, self.masks[camera], foreground, self.rates)

    def edges(self, cameras: Sequence[Camera], spacing: float) -> Evidence:
        """The silhouettes' edges, by points at a spacing [pixel].

        Raises MaskError: a mask of another size than its camera's picture.
        """
        edges = [NO_EDGE] * len(cameras)
        for k, camera in enumerate(cameras):
            if (mask := self.masks.get(camera.name)) is not None:
                require_size(camera, self.name, mask)
                edges[k] = find_edge_points(mask, max(1.0, round(spacing)))
        return pack_evidence(edges)


def require_size(camera: Camera, frame: str, mask: Mask) -> None:
    """Refuses (MaskError) a mask of another size than its camera's picture."""
    if mask.shape != (camera.height, camera.width):
        raise MaskError(
            f"camera '{camera.name}', frame '{frame}': a mask of {camera.width} x {camera.height} "
            f"pixels is expected, not {mask.shape[1]} x {mask.shape[0]}"
        )


def common_size(cameras: Sequence[Camera], frames: Sequence[SeenFrame]) -> float:
    """The root of the silhouettes' median area [pixel].

    Raises MaskError: a mask of another size than its camera's picture, or no mask shows the body.
    """
    areas = []
    for frame in frames:
        for camera in (one for one in cameras if one.name in frame.masks):
            require_size(camera, frame.name, frame.masks[camera.name])
            areas.append(np.count_nonzero(frame.masks[camera.name]))
    if not any(areas):
        raise MaskError("no mask shows the body; give masks in which it is white")
    return float(np.sqrt(np.median([area for area in areas if area])))


def middle_of(kinematics: TreeKinematics, frames: Sequence[SeenFrame]) -> Array:
    """(3,) of the nodes' places in the world [m]."""
    places = [kinematics.poses(frame.values)[:, :3, 3].mean(axis=0) for frame in frames]
    return np.asarray(np.mean(places, axis=0))
