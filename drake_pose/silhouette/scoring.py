"""Areas and masks of projected surfaces, and the visual hull of a surface.

Areas and masks come from the span kernel. A ball lies in the visual hull if every line that meets
the ball meets the surface; the distance of a projected point to the silhouette's edge in images
from many directions bounds the ball's radius. Meshes may have holes and inner parts.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np

from drake_pose.camera.models import Camera, ParallelCamera, PinholeCamera
from drake_pose.errors import CameraError
from drake_pose.silhouette.outline import (
    BendingOutline,
    Outline,
    PackedOutlines,
    mutable_copy,
    pack,
)
from drake_pose.silhouette.span_kernel import paint, paint_labels, score


def prefix_sums(weights: np.ndarray) -> np.ndarray:
    """Return (H, W + 1) int32 row-wise sums left of each pixel (H, W), then of the whole row."""
    prefix = np.zeros((weights.shape[0], weights.shape[1] + 1), dtype=np.int32)
    np.cumsum(weights, axis=1, dtype=np.int32, out=prefix[:, 1:])
    return prefix


def score_bodies(
    surfaces: Sequence[Outline | BendingOutline],
    X_CN: np.ndarray,
    camera: Camera,
    prefixes: np.ndarray,
    bands: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Return the areas of a body at many poses, and of its intersections with pixel sets.

    The body's area is that of the exact union of its surfaces.

    Args:
        surfaces: (nodes,) the body's surfaces, one per node, each in its node's frame N.
        X_CN: (n, nodes, 4, 4) poses of the nodes in the camera.
        camera: the camera; the areas are of its image.
        prefixes: (k, H, W + 1) int32 ``prefix_sums`` of the pixel sets' masks, or of integer
            weights of the pixels; k may be 0.
        bands: for each BendingOutline, (n, v, 3) vertices of its band in its frame N at each pose
            [m]; empty if there is none.

    Returns (n, 1 + k) int64 the body's area inside the image, then its area (or the sum of weights)
    in each set [pixel].

    Raises ValueError: poses, bands or sums have the wrong shape or are not finite.
    """
    packed, poses = _check_body(surfaces, X_CN)
    parts, sizes = [], [0]
    for node, surface in enumerate(surfaces):
        if isinstance(surface, BendingOutline):
            rigid = surface.rigid
            parts.append((node, len(rigid.vertices), len(rigid.triangles), sum(sizes)))
            sizes.append(len(surface.rest.vertices) - len(rigid.vertices))
    given = [band.shape for band in bands]
    if given != [(len(poses), size, 3) for size in sizes[1:]]:
        raise ValueError(f"bands of {sizes[1:]} vertices at {len(poses)} poses, not {given}")
    vertices = np.concatenate([np.empty((len(poses), 0, 3)), *bands], axis=1)
    if not np.all(np.isfinite(vertices)):
        raise ValueError("bands must be finite")
    sums = np.require(prefixes, dtype=np.int32, requirements=["C", "W"])
    if sums.ndim != 3 or sums.shape[1:] != (camera.height, camera.width + 1):
        raise ValueError(
            f"prefixes of camera '{camera.name}' must be (k, {camera.height}, {camera.width + 1}), "
            f"not {sums.shape}"
        )
    numbers = np.array(parts, dtype=np.int64).reshape(-1, 4)
    packed = mutable_copy(packed) if len(parts) else packed
    return score(packed, numbers, vertices, poses, camera.kernel_parameters(), sums)


def draw_mask(outlines: Sequence[Outline], X_CN: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the mask (H, W) bool of surfaces, one per node, at X_CN (nodes, 4, 4) in a camera."""
    packed, poses = _check_body(outlines, np.asarray(X_CN)[None])
    return draw_packed(packed, poses[0], camera)


def draw_packed(packed: PackedOutlines, X_CN: np.ndarray, camera: Camera) -> np.ndarray:
    """As ``draw_mask``, for packed surfaces of all nodes, such as ``PackedSurfaces`` returns."""
    poses = np.ascontiguousarray(X_CN[:, :3], dtype=np.float64)
    mask = np.zeros((camera.height, camera.width), dtype=np.uint8)
    paint(packed, poses, camera.kernel_parameters(), mask, 1)
    return mask.view(np.bool_)


def draw_labels(
    outlines: Sequence[Outline],
    labels: Sequence[int] | np.ndarray,
    X_CN: np.ndarray,
    camera: Camera,
) -> np.ndarray:
    """Return the label (H, W) int16 of the nearest surface in each pixel; 0 where there is none.

    Args:
        outlines: the surfaces, one per node, each in its node's frame N.
        X_CN: (nodes, 4, 4) poses of the nodes in the camera.
        camera: the camera whose image is drawn.
        labels: (nodes,) positive labels of the surfaces.
    """
    packed, poses = _check_body(outlines, np.asarray(X_CN)[None])
    image = np.empty((camera.height, camera.width), dtype=np.int16)
    numbers = np.asarray(labels, dtype=np.int16)
    closed = np.array([outline.is_closed for outline in outlines], dtype=np.bool_)
    paint_labels(packed, numbers, closed, poses[0], camera.kernel_parameters(), 0, image)
    return image


def subtract_body(
    mask: np.ndarray,
    prefix: np.ndarray,
    outlines: Sequence[Outline],
    X_CN: np.ndarray,
    camera: Camera,
) -> None:
    """Remove a body's silhouette from a mask (H, W) and its ``prefix_sums``, in place.

    ``outlines``: one per node. ``X_CN``: (nodes, 4, 4) poses of the nodes in the camera.
    """
    packed, poses = _check_body(outlines, np.asarray(X_CN)[None])
    first, end = paint(packed, poses[0], camera.kernel_parameters(), mask.view(np.uint8), 0)
    prefix[first:end] = prefix_sums(mask[first:end])


def _check_body(
    surfaces: Sequence[Outline | BendingOutline], X_CN: np.ndarray
) -> tuple[PackedOutlines, np.ndarray]:
    """Check poses X_CN (n, nodes, 4, 4) of a body's surfaces.

    Returns the packed surfaces, with bands at rest, and the poses (n, nodes, 3, 4).

    Raises ValueError: the poses have another shape or are not finite.
    """
    poses = np.asarray(X_CN)
    if poses.ndim != 4 or poses.shape[1] != len(surfaces) or poses.shape[2:] != (4, 4):
        raise ValueError(f"poses must be (n, {len(surfaces)}, 4, 4), not {poses.shape}")
    if not np.all(np.isfinite(poses)):
        raise ValueError("poses must be finite")
    outlines = tuple(s.rest if isinstance(s, BendingOutline) else s for s in surfaces)
    return pack(outlines), np.array(poses[:, :, :3], dtype=np.float64, order="C")


class VisualHull:
    """A surface's visual hull, as images of distances to the silhouette's edge; may be empty."""

    def __init__(self, outline: Outline, side: int = 96, directions: int = 72) -> None:
        """Draw the images of a surface.

        ``outline``: the surface, in its frame N. ``side``: width and height of each image [pixel].
        ``directions``: number of viewing directions.
        """
        self._center, self._side = outline.ball[:3], side
        self._size = float(outline.ball[3])
        # Axes (2, 3) of each image in frame N [pixel/m], and its pixels' distances to the edge.
        self._views: list[tuple[np.ndarray, np.ndarray]] = []
        if self._size > 0.0 and len(outline.triangles):
            scale, middle = 0.46 * side / self._size, 0.5 * (side - 1)
            camera = ParallelCamera("hull", side, side, scale, middle, middle, np.eye(4))
            self._scale = scale
            for R_CN in _rotations(directions):
                X_CN = np.eye(4)
                X_CN[:3, :3], X_CN[:3, 3] = R_CN, -R_CN @ self._center
                mask = draw_mask([outline], X_CN[None], camera).astype(np.uint8)
                distances = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
                # Squared distances are integers; OpenCV's rounding depends on the image's memory
                # alignment.
                exact = np.sqrt(np.rint(np.square(distances, dtype=np.float64)))
                self._views.append((scale * R_CN[:2], exact))

    def radii(self, p_N: np.ndarray, shrink: float = 0.97) -> np.ndarray:
        """Return radii (n,) [m] of the largest balls inside the hull around points; 0 outside it.

        ``p_N``: (n, 3) the points in frame N [m]. ``shrink``: factor that allows for the hull's
        extent between the viewing directions.
        """
        if not self._views:
            return np.zeros(len(p_N))
        smallest, active = np.full(len(p_N), np.inf), np.arange(len(p_N))
        for rows, distances in self._views:
            uv = (p_N[active] - self._center) @ rows.T + 0.5 * (self._side - 1)
            # Round first, so that rounding errors do not decide between two pixels.
            uv = np.rint(np.round(uv, 6)).astype(int)
            inside = np.all((uv >= 0) & (uv < self._side), axis=1)
            u, v = np.clip(uv, 0, self._side - 1).T
            found = np.where(inside, distances[v, u], 0.0)
            smallest[active] = np.minimum(smallest[active], found)
            active = active[found > 0.0]
        # Distance [pixel] from a point to its pixel's centre, and from there to the pixel's edge.
        rounding = 0.75 + 0.5
        return np.maximum(0.0, shrink * (smallest - rounding) / self._scale)

    def spread_balls(self, count: int, points_per_side: int = 15) -> np.ndarray:
        """Return (k, 4) centres and radii [m] of at most ``count`` balls spread over the hull.

        ``points_per_side``: number of candidate centres along each side of a cubic grid.
        """
        if not self._views:
            return np.zeros((0, 4))
        steps = np.linspace(-self._size, self._size, points_per_side)
        grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        points = grid + self._center
        radii = self.radii(points)
        points, radii = points[radii > 0.0], radii[radii > 0.0]
        if len(points) == 0:
            return np.zeros((0, 4))
        # Round, so that rounding errors do not decide between equal points of symmetric bodies.
        chosen = [int(np.argmax(np.round(radii, 9)))]
        beyond = np.full(len(points), np.inf)
        while len(chosen) < min(count, len(points)):
            last = chosen[-1]
            gap = np.linalg.norm(points - points[last], axis=1) - radii[last]
            beyond = np.minimum(beyond, gap)
            # Choose the ball that reaches farthest beyond the chosen ones.
            chosen.append(int(np.argmax(np.round(beyond + radii, 9))))
        return np.column_stack([points, radii])[chosen]


def _rotations(count: int) -> np.ndarray:
    """Return R_CN (count, 3, 3) whose viewing directions fill half a sphere evenly."""
    index = np.arange(count) + 0.5
    z = index / count
    azimuth = index * np.pi * (1.0 + 5.0**0.5)
    flat = np.sqrt(1.0 - z**2)
    forward = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z])
    right = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def require_visible(
    outlines: Sequence[Outline], X_CN: np.ndarray, camera: Camera, max_pictures: float = 10.0
) -> None:
    """Raise CameraError, which names the camera, for a camera that cannot show a body.

    The camera is refused if the whole body is behind it, if it is inside a surface, if the body is
    far larger than the image, or if the body is outside the image.

    Args:
        outlines: the body's surfaces, one per node, each in its node's frame N.
        X_CN: (nodes, 4, 4) poses of the nodes in the camera.
        camera: the camera.
        max_pictures: largest size of the body, as a multiple of the image's diagonal.
    """
    pairs = zip(outlines, X_CN, strict=True)
    solid = [(outline, np.asarray(X)) for outline, X in pairs if len(outline.triangles)]
    where = f"camera '{camera.name}'"
    placed = [(outline, outline.vertices @ X[:3, :3].T + X[:3, 3]) for outline, X in solid]
    if isinstance(camera, PinholeCamera):
        if all((p_C[:, 2] < camera.near).all() for _, p_C in placed):
            raise CameraError(
                f"{where} has the whole body behind it (z forward is the viewing direction); "
                "check X_WC, which is the camera's pose in the world and not its inverse"
            )
        if any(_winding_number(p_C[outline.triangles]) > 0.5 for outline, p_C in placed):
            raise CameraError(f"{where} is inside the body; check X_WC and the body's position")
    # Diagonal of the body's box, projected at the depth of its farthest point [pixel].
    corners, scale = np.vstack([p_C for _, p_C in placed]), float(camera.kernel_parameters()[1])
    if isinstance(camera, PinholeCamera):
        scale /= float(corners[:, 2].max())
    size = scale * float(np.linalg.norm(np.ptp(corners, axis=0)))
    picture = math.hypot(camera.width, camera.height)
    if size > max_pictures * picture:
        raise CameraError(
            f"{where}: the body is larger than the picture: at least {size:.3g} pixels across, "
            f"the picture {picture:.0f}; check the focal length [pixel], X_WC and the model's "
            "scale [m]"
        )
    mask = draw_mask([outline for outline, _ in solid], np.array([X for _, X in solid]), camera)
    if not mask.any():
        raise CameraError(
            f"{where} shows nothing of the body: it lies outside the picture of "
            f"{camera.width} x {camera.height} pixels; check X_WC and the body's position"
        )


def _winding_number(corners: np.ndarray) -> float:
    """Return how often triangles (m, 3, 3) enclose the origin: 1 inside a closed surface."""
    # Solid angles after van Oosterom and Strackee (1983), equation 8.
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = (
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb
    )
    return float(abs(np.arctan2(numerator, denominator).sum()) / (2.0 * np.pi))
