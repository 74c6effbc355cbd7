"""Where a body's root can be, told from silhouettes alone: positions, depths and scales to try.

One parallel camera of unknown scale: a body twice as large looks like a camera with twice as many
pixels a metre, so the scale is tried on the camera and the body keeps its size. One pinhole: what
is unknown beside the place in the picture is the depth. Both are bounded by the silhouette's area,
beside that of the body's own random poses, and tried in geometric steps. Several calibrated
cameras: a grid in space, of which every camera leaves what lies in its silhouette.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import View
from drake_pose.search.partial_poses import Pictures
from drake_pose.search.sampled_body import SampledBody
from drake_pose.silhouette.areas.scoring import score_bodies

# The picture in which random poses are measured [pixel], and how many.
_SIDE, _POSES = 240, 100
# Shares of the random poses whose area is smaller and larger than what is reckoned with.
_RARE = 0.03
# Half the cube in space that the root is looked for in [the silhouette's extent].
_HALF_CUBE = 0.75
# The root is drawn no farther than this from its origin [pixel].
_FARTHEST = 60


# How many positions are tried across the silhouette, and the ratio of two scales or depths tried
# one after the other.
_POSITIONS_ACROSS, _RATIO = 12, 1.12
# Where the silhouette touches the picture's edge the body may be larger by this factor than it
# looks, and the root that share of the silhouette's extent, less one, beyond the edge.
_CUT_OFF = 1.5


@dataclass(frozen=True, eq=False)
class Layer:
    """Root positions that are tried together.

    Attributes:
        views: the silhouettes, with a parallel camera's scale as it is tried.
        positions: (n, 3) of the root's origin in the world [m].
        scale: of the camera, times what it was given as.
    """

    views: tuple[View, ...]
    positions: np.ndarray
    scale: float


def find_layers(
    body: SampledBody, views: Sequence[View], scale_unknown: bool, known: np.ndarray | None
) -> list[Layer]:
    """Where the root can be, the likeliest scales and depths first.

    Args:
        scale_unknown: the camera is parallel and its pixels_per_metre is not known.
        known: (3,) the root's position [m] if only the scale is unknown.

    Raises:
        SettingsError: the scale is unknown, but there is not just one parallel camera.
    """
    main = max(views, key=lambda view: int(view.mask.sum()))
    camera = main.camera
    if scale_unknown and (len(views) > 1 or not isinstance(camera, ParallelCamera)):
        raise SettingsError(
            "an unknown scale needs one parallel camera, but there are: "
            f"{', '.join(view.camera.name for view in views)}; a pinhole's or several cameras' "
            "scale follows from their calibration"
        )
    if known is not None and not scale_unknown:
        return [Layer(tuple(views), known[None], 1.0)]
    sizes = _pixel_sizes(body, main)
    if len(views) > 1:
        middle = _meeting_point(views)
        if middle is not None:
            return [_space_layer(views, middle, sizes)]
    p_CR = _in_camera(camera, body.sampled.X_PN[0][0, :3, 3])
    places = _picture_grid(main)
    if not isinstance(camera, ParallelCamera):
        focal = 0.5 * (camera.focal_x + camera.focal_y)
        return [Layer(tuple(views), _lift(camera, places, focal / size), 1.0) for size in sizes]
    scales = sizes / camera.pixels_per_metre if scale_unknown else np.ones(1)
    layers = []
    for scale in scales:
        scaled = scale_camera(camera, float(scale))
        positions = _lift(scaled, places, p_CR[2]) if known is None else known[None]
        layers.append(Layer((View(scaled, main.mask),), positions, float(scale)))
    return layers


def hub(tree: PoseTree) -> str:
    """The name of the node with geometry that has the most neighbours, the first of equals."""
    counts = [
        len(node.children) + (node.parent >= 0) if len(node.mesh.triangles) else -1
        for node in tree.nodes
    ]
    return tree.nodes[int(np.argmax(counts))].name


def turns_freely(tree: PoseTree) -> bool:
    """Whether the plant's own joints at the tree's only root turn it in all ways."""
    if sum(node.parent < 0 for node in tree.nodes) != 1 or not tree.nodes[0].positions:
        return False
    kinds = [tree.model.position_kinds[position] for position in tree.nodes[0].positions]
    lower, upper = tree.value_bounds(0)
    ranges = np.sort((upper - lower)[[kind == "angle" for kind in kinds]])
    # Joints that are held do not turn it.
    ranges = ranges[ranges > 0.0]
    wanted = np.array([np.pi, 2.0 * np.pi, 2.0 * np.pi])
    return len(ranges) == 3 and bool(np.all(ranges >= wanted - 1e-6))


def scale_camera(camera: ParallelCamera, scale: float) -> ParallelCamera:
    """The camera with this many times its pixels a metre."""
    return dataclasses.replace(camera, pixels_per_metre=scale * camera.pixels_per_metre)


def slide_root(camera: ParallelCamera, p_WR: np.ndarray, factor: float) -> np.ndarray:
    """(3,) where a root at (3,) [m] comes to lie that is moved across a parallel camera's axis.

    Seen by a camera of so many times the scale, it keeps its place if it comes so many times
    nearer to the axis: a body and its root's place grow alike, or the camera's scale does.
    """
    p_CR = _in_camera(camera, p_WR)
    p_CR[:2] *= factor
    return np.asarray(camera.X_WC[:3, :3] @ p_CR + camera.X_WC[:3, 3])


def whereabouts(views: Sequence[View], p_WR: np.ndarray) -> np.ndarray:
    """(3 n,) where n views see a root (3,), and how large: 1 apart is one step of what is tried."""
    here: list[float] = []
    for view in views:
        camera = view.camera
        place, depth = camera.project(p_WR[None])
        if isinstance(camera, ParallelCamera):
            size = camera.pixels_per_metre
        else:
            size = 1.0 / max(float(depth[0]), camera.near)
        spacing = _extent(view.mask) / _POSITIONS_ACROSS
        here += [*(place[0] / spacing), np.log(size) / np.log(_RATIO)]
    return np.array(here)


def place_body(body: SampledBody, positions: np.ndarray, chosen: np.ndarray) -> SampledBody:
    """The body whose root is sampled at combinations of positions (n, 3) [m] and its r rotations.

    ``chosen``: (m,) the samples that it has: i is rotation i % r at position i // r.
    """
    placed, sampled = copy.copy(body), copy.copy(body.sampled)
    places, turns = np.divmod(chosen, len(sampled.X_PN[0]))
    shifts = positions[places] - sampled.X_PN[0][0, :3, 3]
    X_WR = sampled.X_PN[0][turns]
    X_WR[:, :3, 3] += shifts
    sampled.X_PN = [X_WR, *sampled.X_PN[1:]]
    sampled.values = [sampled.values[0][turns], *sampled.values[1:]]
    if sampled.bands[0] is not None:
        sampled.bands = [sampled.bands[0][turns], *sampled.bands[1:]]
    placed.sampled = sampled
    placed.p_PB = [np.ascontiguousarray(body.p_PB[0][turns] + shifts[:, None]), *body.p_PB[1:]]
    return placed


def choose_root_samples(
    body: SampledBody,
    views: Sequence[View],
    positions: np.ndarray,
    count: int,
    outside_weight: float,
) -> np.ndarray:
    """At positions (n, 3) of one depth the rotations of the root whose pictures fit best.

    In one view the root looks nearly alike wherever it is in the picture: it is drawn once for each
    rotation and moved by whole pixels. In several views all rotations are taken.

    Args:
        count: so many rotations at each.
        outside_weight: what a pixel outside counts; one covered counts one.

    Returns:
        (m,) the samples of ``place_body``, increasing.
    """
    rotations = len(body.sampled.X_PN[0])
    if len(views) > 1 or count >= rotations:
        return np.arange(len(positions) * rotations)
    (view,) = views
    places = np.atleast_2d(view.camera.project(positions)[0])
    middle = int(np.argmin(np.abs(places - places.mean(axis=0)).sum(axis=1)))
    pictures = _draw_root(body, view.camera, positions[middle], places[middle])
    side = pictures.shape[1]
    # Beyond the picture's edge nothing counts.
    worth = np.pad(outside_weight - (1.0 + outside_weight) * view.mask, side).astype(np.float32)
    corners = np.rint(places).astype(np.int64) - side // 2 + side
    corners = np.clip(corners, 0, np.array(worth.shape)[::-1] - side)
    windows = np.lib.stride_tricks.sliding_window_view(worth, (side, side))
    seen = windows[corners[:, 1], corners[:, 0]].reshape(len(places), -1)
    costs = seen @ pictures.reshape(rotations, -1).T
    best = np.argpartition(costs, count - 1, axis=1)[:, :count]
    return np.sort((best + rotations * np.arange(len(places))[:, None]).ravel())


def _draw_root(
    body: SampledBody, camera: Camera, p_WR: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Pictures (r, side, side) float32 of the root at its rotations, its place (2,) amidst."""
    rotations = len(body.sampled.X_PN[0])
    ball = body.sampled.outlines[0].ball
    depth = float(_in_camera(camera, p_WR)[2])
    scale = float(camera.kernel_parameters()[1])
    reach = float(np.linalg.norm(ball[:3]) + ball[3])
    if not isinstance(camera, ParallelCamera):
        scale /= max(depth - reach, 0.2 * depth)
    half = min(_FARTHEST, math.ceil(scale * reach) + 1)
    side, inner = 2 * half + 1, 2 * half - 1
    window = dataclasses.replace(
        camera,
        width=side,
        height=side,
        center_x=camera.center_x - float(place[0]) + half,
        center_y=camera.center_y - float(place[1]) + half,
    )
    everywhere = np.pad(np.ones((inner, inner), dtype=np.bool_), 1)
    placed = place_body(body, p_WR[None], np.arange(rotations))
    bits = Pictures(placed, [View(window, everywhere)], band=1)
    masks = np.zeros((rotations, int(bits.part_starts[-1])), dtype=np.uint64)
    bits.draw_node(0, np.arange(rotations), placed.sampled.X_PN[0], masks)
    pixels = np.unpackbits(masks.view(np.uint8), axis=1, count=inner**2, bitorder="little")
    pictures = np.zeros((rotations, side, side), dtype=np.float32)
    pictures[:, 1:-1, 1:-1] = pixels.reshape(rotations, inner, inner)
    return pictures


def _pixel_sizes(body: SampledBody, view: View) -> np.ndarray:
    """How many pixels a metre at the body may have (n,), the likeliest first."""
    area = float(view.mask.sum())
    low, middle, high = np.quantile(_random_areas(body, view.camera), [_RARE, 0.5, 1.0 - _RARE])
    smallest, likely, largest = np.sqrt(area / np.array([high, middle, low]))
    if _touches_edge(view.mask):
        largest *= _CUT_OFF
    step = np.log(_RATIO)
    steps = np.arange(
        np.floor(np.log(smallest / likely) / step), np.ceil(np.log(largest / likely) / step) + 1
    )
    steps = steps[np.argsort(np.abs(steps), kind="stable")]
    return np.asarray(likely * _RATIO**steps)


def _random_areas(body: SampledBody, camera: Camera) -> np.ndarray:
    """Areas of parallel projections of random poses of the grid, seen along the camera's axis."""
    generator, sampled = np.random.default_rng(1), body.sampled
    samples = np.column_stack([generator.integers(len(X_PN), size=_POSES) for X_PN in sampled.X_PN])
    balls = np.array([outline.ball for outline in sampled.outlines])
    X_CN = camera.X_CW @ sampled.poses(samples)
    centers = np.einsum("nkij,kj->nki", X_CN[..., :3, :3], balls[:, :3]) + X_CN[..., :3, 3]
    low = (centers - balls[:, 3:]).min(axis=1)
    high = (centers + balls[:, 3:]).max(axis=1)
    X_CN[..., :3, 3] -= 0.5 * (low + high)[:, None]
    scale = _SIDE / float((high - low)[:, :2].max())
    middle = 0.5 * (_SIDE - 1)
    measuring = ParallelCamera("", _SIDE, _SIDE, scale, middle, middle, np.eye(4))
    nothing = np.zeros((0, _SIDE, _SIDE + 1), dtype=np.int32)
    areas = score_bodies(
        sampled.outlines_at(range(samples.shape[1]), samples[0]), X_CN, measuring, nothing
    )
    return np.asarray(areas[:, 0] / scale**2)


def _touches_edge(mask: np.ndarray) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def _box(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least and greatest u and v of a silhouette, (2,) each."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    low = np.array([left, top], float)
    return low, low + np.array([width - 1, height - 1])


def _extent(mask: np.ndarray) -> float:
    """The silhouette's extent [pixel]: of a square as large as its bounding box."""
    low, high = _box(mask)
    return float(np.sqrt(np.prod(high - low + 1.0)))


def _picture_grid(view: View) -> np.ndarray:
    """Places (n, 2) in the picture where the root can be seen, or beyond its edge [pixel]."""
    low, high = _box(view.mask)
    extent = _extent(view.mask)
    spacing = extent / _POSITIONS_ACROSS
    beyond = (_CUT_OFF - 1.0) * extent
    size = np.array([view.camera.width, view.camera.height])
    low = np.where(low < 1, -beyond, low - 0.5 * spacing)
    high = np.where(high > size - 2, size - 1 + beyond, high + 0.5 * spacing)
    axes = [low[k] + spacing * np.arange(int((high[k] - low[k]) / spacing) + 1) for k in range(2)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return places[_near(view, places)]


def _near(view: View, places: np.ndarray) -> np.ndarray:
    """Which places (n, 2) [pixel] lie at the silhouette, or beyond it out of the picture."""
    extent = _extent(view.mask)
    distances = distance_transform_edt(~view.mask)
    inside = np.clip(places, 0, np.array(view.mask.shape)[::-1] - 1)
    column, row = np.rint(inside).astype(np.int64).T
    near = distances[row, column] <= 0.75 * extent / _POSITIONS_ACROSS
    over = np.linalg.norm(places - inside, axis=1)
    return np.asarray(near & (over <= (_CUT_OFF - 1.0) * extent))


def _lift(camera: Camera, places: np.ndarray, depth: float) -> np.ndarray:
    """The points (n, 3) of the world that are seen at places (n, 2) [pixel] in a depth [m]."""
    if isinstance(camera, ParallelCamera):
        scale = np.full(2, 1.0 / camera.pixels_per_metre)
    else:
        scale = depth / np.array([camera.focal_x, camera.focal_y])
    p_C = np.empty((len(places), 3))
    p_C[:, :2] = (places - [camera.center_x, camera.center_y]) * scale
    p_C[:, 2] = depth
    return np.asarray(p_C @ camera.X_WC[:3, :3].T + camera.X_WC[:3, 3])


def _in_camera(camera: Camera, p_W: np.ndarray) -> np.ndarray:
    return np.asarray(camera.X_CW[:3, :3] @ p_W + camera.X_CW[:3, 3])


def _meeting_point(views: Sequence[View]) -> np.ndarray | None:
    """The point (3,) nearest to the rays through all silhouettes' middles; None: parallel ones."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        low, high = _box(view.mask)
        ends = np.array([_lift(view.camera, 0.5 * (low + high)[None], z)[0] for z in (1.0, 2.0)])
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        across = np.eye(3) - np.outer(along, along)
        A += across
        b += across @ ends[0]
    # The smallest eigenvalue is about the squared sine of half the angle between two rays.
    if np.linalg.eigvalsh(A)[0] < 0.01:
        return None
    return np.asarray(np.linalg.solve(A, b))


def _space_layer(views: Sequence[View], middle: np.ndarray, sizes: np.ndarray) -> Layer:
    """A grid in space about a point (3,), of which all views leave what lies in their silhouettes.

    ``sizes``: the pixels a metre in the largest silhouette, the likeliest first.
    """
    main = max(views, key=lambda view: int(view.mask.sum()))
    extent = _extent(main.mask) / float(sizes[0])
    half = _HALF_CUBE * extent * (_CUT_OFF if _touches_edge(main.mask) else 1.0)
    spacing = extent / _POSITIONS_ACROSS
    steps = spacing * np.arange(-np.ceil(half / spacing), np.ceil(half / spacing) + 1)
    points = middle + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    for view in views:
        places, depth = view.camera.project(points)
        seen = np.ones(len(points), dtype=np.bool_)
        if not isinstance(view.camera, ParallelCamera):
            seen = depth > view.camera.near
        seen[seen] = _near(view, places[seen])
        points = points[seen]
    return Layer(tuple(views), points, 1.0)
