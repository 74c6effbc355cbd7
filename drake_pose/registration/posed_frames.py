"""Frames of one or several cameras in which the body's joint positions are known."""

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
from drake_pose.workers import map_ordered

LAST_SPACING = 1.0 / 300.0
"""Spacing of silhouettes' edge points in the last stages of a fit [square root of the area]."""


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """One camera's frame of a body at known joint positions."""

    name: str  # The frame's name.
    values: Array  # (m,) values of the body's pose tree [rad or m].
    mask: Mask  # (H, W) the silhouette.
    # (H, W, 3) log-odds of each pixel to show the body, coded as colours (``fit.background``),
    # which fits use in place of the mask; None: they use the mask.
    foreground: NDArray[np.uint8] | None = None
    rates: Array | None = None  # (m,) velocities of the values [rad/s or m/s]; None: unknown.

    def mirrored(self) -> "PosedFrame":
        """Return the frame with its mask mirrored left-right, without log-odds."""
        return PosedFrame(self.name, self.values, np.ascontiguousarray(self.mask[:, ::-1]))


class PosedFrames:
    """All frames of one camera, prepared for searches and fits.

    Args:
        kinematics: of the body's pose tree.
        outlines: a surface for each node.
        camera: its intrinsics; its pose is not used.
        frames: the frames.
        spacing: distance of the silhouettes' edge points [`size`].

    Attributes:
        X_WN: (frames, nodes, 4, 4) the nodes' poses.
        intrinsics: focal lengths (2,) and principal point (2,) [pixel].
        size: square root of the silhouettes' median area [pixel].

    Raises:
        MaskError: a mask is empty, or its size differs from the camera's.
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
        """Corners (n, 3) of the convex hulls in at most nine of the frames, in the world [m]."""
        return np.concatenate(self._corners(self.X_WN[:: max(1, len(self.X_WN) // 5)]))

    def _corners(self, poses: Array) -> list[Array]:
        """Return each frame's corners (n, 3) of the body's hull in the world [m], of X_WN poses."""
        return map_ordered(lambda X_WN: _placed_hull(self.outlines, X_WN.tobytes()), poses)

    @cached_property
    def middle(self) -> Array:
        """Mean (3,) of the hulls' corners in the world [m]."""
        return np.asarray(self.some_points.mean(axis=0))

    @cached_property
    def extent(self) -> float:
        """Root mean square distance of the hulls' corners from their mean [m]."""
        off = self.some_points - self.middle
        return float(np.sqrt((off**2).sum(axis=1).mean()))

    def observations(self, camera: int, count: int) -> list[Observation]:
        """Return frames as observations by `count` cameras; only number `camera` has evidence."""
        observations = []
        for frame, edge in zip(self.frames, self._edges, strict=True):
            edges = pack_evidence([edge if c == camera else NO_EDGE for c in range(count)])
            foreground = tuple(frame.foreground if c == camera else None for c in range(count))
            observations.append(Observation(edges, frame.values, foreground, frame.rates))
        return observations

    @cached_property
    def body(self) -> BodyParameters:
        """The body's parameters in a fit."""
        return BodyParameters(self.kinematics, self.outlines)

    @cached_property
    def _edges(self) -> list[EdgePoints]:
        """Edge points of each frame's mask; none (NO_EDGE) for frames with foreground log-odds."""
        spacing = max(1.0, round(self.spacing * self.size))
        return [
            NO_EDGE if frame.foreground is not None else find_edge_points(frame.mask, spacing)
            for frame in self.frames
        ]

    def downscaled(self, side: float) -> Camera:
        """Return the camera with `size` at most `side` [pixel]; at least 8 x 8, never enlarged."""
        return downscaled(self.camera, min(1.0, side / self.size))

    def sums(self, frame: int, camera: Camera) -> NDArray[np.int32]:
        """Return prefix sums (H, W + 1) of a frame's mask in a small camera: ``reduced_sums``."""
        return reduced_sums(self.frames[frame].mask, camera)


def downscaled(camera: Camera, scale: float) -> Camera:
    """Return a camera with pictures scaled, to 8 x 8 pixels at least; a parallel one unchanged."""
    if not isinstance(camera, PinholeCamera):
        return camera
    width, height = (max(8, round(scale * side)) for side in (camera.width, camera.height))
    return camera.resized(width, height)


def reduced_sums(mask: Mask, camera: Camera) -> NDArray[np.int32]:
    """Return prefix sums (H, W + 1) along the rows of a mask scaled to a camera's H x W pixels."""
    size = (camera.width, camera.height)
    small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return prefix_sums(small > 0.5)


@lru_cache(maxsize=512)
def _hull_of(outline: Outline) -> Array:
    """Return the corners (n, 3) of a surface's convex hull in the surface's frame [m]."""
    return _hull(outline.vertices)


@lru_cache(maxsize=256)
def _placed_hull(outlines: tuple[Outline, ...], X_WN: bytes) -> Array:
    """Return a body's convex hull (n, 3) in the world [m]; X_WN: bytes of (nodes, 4, 4). Cached."""
    poses = np.frombuffer(X_WN).reshape(-1, 4, 4)
    hulls = zip(map(_hull_of, outlines), poses, strict=True)
    return _hull(np.concatenate([p @ X[:3, :3].T + X[:3, 3] for p, X in hulls]))


def _hull(points: Array) -> Array:
    """Return the points (n, 3) that are corners of the convex hull; all points of a flat body."""
    with suppress(QhullError, ValueError):
        return np.asarray(points[ConvexHull(points).vertices])
    return points


def placed_points(outlines: Sequence[Outline], X_WN: Array) -> Array:
    """Return the vertices (n, 3) [m] of all surfaces, placed at X_WN (nodes, 4, 4), in order."""
    placed = zip(outlines, X_WN, strict=True)
    return np.concatenate([outline.vertices @ X[:3, :3].T + X[:3, 3] for outline, X in placed])


@dataclass(frozen=True, eq=False)
class MultiViewFrame:
    """Synchronised pictures of several cameras of a body at known joint positions."""

    name: str  # The frame's name.
    values: Array  # (m,) values of the body's pose tree [rad or m].
    # Silhouettes (H, W) by camera name; a camera without a mask has no entry.
    masks: Mapping[str, Mask]
    # Coded log-odds (H, W, 3) by camera name, see ``PosedFrame``.
    foreground: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    rates: Array | None = None  # (m,) velocities of the values [rad/s or m/s]; None: unknown.

    @classmethod
    def alone(cls, camera: str, frame: PosedFrame) -> "MultiViewFrame":
        """Return the frame of a single camera, named `camera`."""
        foreground = {} if frame.foreground is None else {camera: frame.foreground}
        return cls(frame.name, frame.values, {camera: frame.mask}, foreground, frame.rates)

    def of(self, camera: str) -> PosedFrame:
        """Return the frame of the camera named `camera`; KeyError: it has no mask."""
        foreground = self.foreground.get(camera)
        return PosedFrame(self.name, self.values, self.masks[camera], foreground, self.rates)

    def edges(self, cameras: Sequence[Camera], spacing: float) -> Evidence:
        """Return the edge points of each camera's mask; none for a camera without a mask.

        ``spacing``: rounded, 1 or more [pixel]. Raises MaskError: a mask has a wrong size.
        """
        edges = [NO_EDGE] * len(cameras)
        for k, camera in enumerate(cameras):
            if (mask := self.masks.get(camera.name)) is not None:
                require_size(camera, self.name, mask)
                edges[k] = find_edge_points(mask, max(1.0, round(spacing)))
        return pack_evidence(edges)


def require_size(camera: Camera, frame: str, mask: Mask) -> None:
    """Raise MaskError, which names ``frame``, if a mask (H, W) is not of the camera's size."""
    if mask.shape != (camera.height, camera.width):
        raise MaskError(
            f"camera '{camera.name}', frame '{frame}': a mask of {camera.width} x {camera.height} "
            f"pixels is expected, not {mask.shape[1]} x {mask.shape[0]}"
        )


def common_size(cameras: Sequence[Camera], frames: Sequence[MultiViewFrame]) -> float:
    """Return the square root of the silhouettes' median area [pixel].

    Masks of cameras that are not among `cameras`, and empty masks, are ignored.

    Raises MaskError: a mask's size differs from its camera's, or no mask shows the body.
    """
    areas = []
    for frame in frames:
        for camera in (camera for camera in cameras if camera.name in frame.masks):
            require_size(camera, frame.name, frame.masks[camera.name])
            areas.append(np.count_nonzero(frame.masks[camera.name]))
    if not any(areas):
        raise MaskError("no mask shows the body; give masks in which it is white")
    return float(np.sqrt(np.median([area for area in areas if area])))


def middle_of(kinematics: TreeKinematics, frames: Sequence[MultiViewFrame]) -> Array:
    """Return the mean position (3,) of the nodes' origins in all frames, in the world [m]."""
    places = [kinematics.poses(frame.values)[:, :3, 3].mean(axis=0) for frame in frames]
    return np.asarray(np.mean(places, axis=0))


def joints_like_cameras(kinematics: TreeKinematics, values: Array, shown: Mask) -> tuple[str, ...]:
    """Return names of joints whose offset looks like a rotation of the camera about the robot.

    Such a joint, usually the first, moves all parts that move at all, about an axis that is fixed
    in the world. Only static parts then separate its offset from the camera's pose.

    ``kinematics``: of the body's pose tree. ``values``: (f, m) values in f frames [rad or m].
    ``shown``: (nodes,) which nodes are visible.
    """
    motions = [kinematics.motions(one) for one in values]
    count = len(kinematics.names)
    twists = np.array([one.twists[:count] for one in motions])
    still = np.ptp(twists, axis=0).max(axis=1) < 1e-6
    moves = motions[0].moves[shown][:, :count]
    # Nodes that no value moves between the frames are static.
    changing = np.ptp(values, axis=0) > 1e-3
    moving = moves[:, changing].any(axis=1)
    return tuple(
        name
        for k, name in enumerate(kinematics.names)
        if still[k] and moving.any() and moves[moving, k].all()
    )
