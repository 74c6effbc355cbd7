"""Find the candidate positions of a body's root, and scales of a parallel camera.

They follow from the silhouettes:

- One parallel camera of unknown scale: a body twice as large looks as in a camera with twice the
  pixels per metre, so scales of the camera are tried, and the body keeps its size.
- One pinhole camera: depths are tried.
- Several cameras: a grid in space, reduced to the points that project into all silhouettes.

Scales and depths form a geometric sequence. Its range follows from the silhouette's area and the
areas of random poses of the body.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import View
from drake_pose.search.sampled_body import SampledBody
from drake_pose.silhouette.scoring import score_bodies


class RootPlacementSettings(NamedTuple):
    """Parameters of the search for the root's position."""

    positions_across: int = 12  # Positions tried across the silhouette.
    scale_ratio: float = 1.12  # Ratio of neighbouring scales or depths.
    # Factor by which a body cut off by the image border may be larger than its silhouette.
    cut_off: float = 1.5
    # Greatest area outside the silhouette [fraction of a node's mean projected area]. It is large
    # because the root may be half a grid step off.
    outside_fraction: float = 0.6
    outside_weight: int = 2  # Cost of a pixel outside, relative to the gain of one newly covered.
    hypotheses: int = 500  # Beam width, shared among the scales or depths.
    quota: float = 0.05  # Greatest fraction of the hypotheses with the same root position.
    starts: int = 24  # Number of poses refined by the coarse passes.
    finalists: int = 3  # Number of root positions searched again, and of poses refined to the end.
    coarse_pixels: int = 1500  # Area of a silhouette in the coarse images [pixel].
    root_factor: int = 2  # Beam width after the root, as a multiple of the beam width.
    root_spare: int = 2  # Rotations tried at each position, as a multiple of its quota.
    spare: int = 8  # Hypotheses made before the quota is applied, as a multiple of the beam width.
    good_E_total: float = 0.004  # The search ends at a pose with a smaller E_total.


class RootPlaces(NamedTuple):
    """Root positions of one scale or depth."""

    views: tuple[View, ...]  # The silhouettes; a parallel camera has the scale that is tried.
    positions: np.ndarray  # (n, 3) positions of the root's origin in the world [m].
    scale: float = 1.0  # Ratio of the camera's tried to its given ``pixels_per_metre``.


def find_root_places(
    body: SampledBody, views: Sequence[View], scale_unknown: bool, known: np.ndarray | None
) -> list[RootPlaces]:
    """Return the candidate positions of the root, the likeliest scale or depth first.

    Args:
        body: the sampled body.
        views: the silhouettes, one per camera.
        scale_unknown: whether the ``pixels_per_metre`` of the one parallel camera is unknown.
        known: (3,) the root's position in the world [m]; None: it is unknown.

    Returns:
        One entry for each scale or depth; a single one if neither is unknown.

    Raises SettingsError: if the scale is unknown, but the views are not one parallel view.
    """
    main, settings = max(views, key=lambda view: int(view.mask.sum())), RootPlacementSettings()
    camera = main.camera
    if scale_unknown and (len(views) > 1 or not isinstance(camera, ParallelCamera)):
        raise SettingsError(
            "an unknown scale needs one parallel camera, but there are: "
            f"{', '.join(view.camera.name for view in views)}; a pinhole's or several cameras' "
            "scale follows from their calibration"
        )
    if known is not None and not scale_unknown:
        return [RootPlaces(tuple(views), known[None])]
    sizes = _pixel_sizes(body, main)
    if len(views) > 1:
        # The point nearest to the rays through the centres of all silhouettes' bounding boxes.
        A, b = np.zeros((3, 3)), np.zeros(3)
        for view in views:
            low, high = _box(view.mask)
            middle = 0.5 * (low + high)[None]
            ends = np.array([_lift(view.camera, middle, z)[0] for z in (1.0, 2.0)])
            along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
            across = np.eye(3) - np.outer(along, along)
            A += across
            b += across @ ends[0]
        # The smallest eigenvalue is about the squared sine of half the angle between two rays; it
        # is 0 for parallel rays.
        if np.linalg.eigvalsh(A)[0] >= 0.01:
            # The points of a grid in space that project into or near all silhouettes.
            extent = _extent(main.mask) / float(sizes[0])
            half = 0.75 * extent * (settings.cut_off if _touches_edge(main.mask) else 1.0)
            spacing = extent / settings.positions_across
            steps = spacing * np.arange(-np.ceil(half / spacing), np.ceil(half / spacing) + 1)
            grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
            points = np.linalg.solve(A, b) + grid
            for view in views:
                places, depth = view.camera.project(points)
                visible = np.ones(len(points), dtype=np.bool_)
                if not isinstance(view.camera, ParallelCamera):
                    visible = depth > view.camera.near
                visible[visible] = _near(view, places[visible])
                points = points[visible]
            return [RootPlaces(tuple(views), points)]
    p_CR = in_camera(camera, body.sampled.X_PN[0][0, :3, 3])
    # Places (n, 2) of the root in the image, or beyond its border if the mask touches that [pixel].
    low, high = _box(main.mask)
    spacing = _extent(main.mask) / settings.positions_across
    beyond = (settings.cut_off - 1.0) * _extent(main.mask)
    size = np.array([camera.width, camera.height])
    low = np.where(low < 1, -beyond, low - 0.5 * spacing)
    high = np.where(high > size - 2, size - 1 + beyond, high + 0.5 * spacing)
    axes = [low[k] + spacing * np.arange(int((high[k] - low[k]) / spacing) + 1) for k in range(2)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    places = places[_near(main, places)]
    if not isinstance(camera, ParallelCamera):
        focal = 0.5 * (camera.focal_x + camera.focal_y)
        return [RootPlaces(tuple(views), _lift(camera, places, focal / one)) for one in sizes]
    scales = sizes / camera.pixels_per_metre if scale_unknown else np.ones(1)
    layers: list[RootPlaces] = []
    for scale in scales:
        scaled = scale_camera(camera, float(scale))
        positions = _lift(scaled, places, p_CR[2]) if known is None else known[None]
        layers.append(RootPlaces((View(scaled, main.mask),), positions, float(scale)))
    return layers


def scale_camera(camera: ParallelCamera, scale: float) -> ParallelCamera:
    """Return a camera with ``pixels_per_metre`` multiplied by ``scale``."""
    return dataclasses.replace(camera, pixels_per_metre=scale * camera.pixels_per_metre)


def slide_root(camera: Camera, p_WR: np.ndarray, factor: float) -> np.ndarray:
    """Return a root position (3,) [m] with its distance from a parallel camera's axis multiplied.

    A camera whose scale is divided by the same factor sees the root at the same place.
    """
    p_CR = in_camera(camera, p_WR)
    p_CR[:2] *= factor
    return np.asarray(camera.X_WC[:3, :3] @ p_CR + camera.X_WC[:3, 3])


def root_steps(views: Sequence[View], p_WR: np.ndarray) -> np.ndarray:
    """Return place and scale of a root in n views, in steps of the candidate positions: (3 n,).

    For each view: u and v in units of the spacing of positions, and the logarithm of pixels per
    metre in units of that of the ratio of scales. ``p_WR``: (3,) the root's position [m].
    """
    here, settings = list[float](), RootPlacementSettings()
    for view in views:
        camera = view.camera
        place, depth = camera.project(p_WR[None])
        if isinstance(camera, ParallelCamera):
            size = camera.pixels_per_metre
        else:
            size = 1.0 / max(float(depth[0]), camera.near)
        spacing = _extent(view.mask) / settings.positions_across
        here += [*(place[0] / spacing), np.log(size) / np.log(settings.scale_ratio)]
    return np.array(here)


def _pixel_sizes(
    body: SampledBody, view: View, poses: int = 100, side: int = 240, rare: float = 0.03
) -> np.ndarray:
    """Return possible numbers of pixels per metre at the body in a view (n,), the likeliest first.

    They are a geometric sequence. Its range follows from the silhouette's area and the areas of
    parallel projections of random poses of the grid along the camera's axis.

    ``body``: the sampled body. ``view``: the silhouette. ``poses``: number of random poses.
    ``side``: side of the image in which they are drawn [pixel]. ``rare``: fraction of the smallest,
    and of the largest, areas that are disregarded.
    """
    generator, sampled, settings = np.random.default_rng(1), body.sampled, RootPlacementSettings()
    samples = np.column_stack([generator.integers(len(X_PN), size=poses) for X_PN in sampled.X_PN])
    balls = np.array([outline.ball for outline in sampled.outlines])
    X_CN = view.camera.X_CW @ sampled.poses(samples)
    centers = np.einsum("nkij,kj->nki", X_CN[..., :3, :3], balls[:, :3]) + X_CN[..., :3, 3]
    least, most = (centers - balls[:, 3:]).min(axis=1), (centers + balls[:, 3:]).max(axis=1)
    X_CN[..., :3, 3] -= 0.5 * (least + most)[:, None]
    scale, middle = side / float((most - least)[:, :2].max()), 0.5 * (side - 1)
    measuring = ParallelCamera("", side, side, scale, middle, middle, np.eye(4))
    nothing = np.zeros((0, side, side + 1), dtype=np.int32)
    outlines = sampled.outlines_at(range(samples.shape[1]), samples[0])
    areas = score_bodies(outlines, X_CN, measuring, nothing)[:, 0] / scale**2
    low, middle, high = np.quantile(areas, [rare, 0.5, 1.0 - rare])
    smallest, likely, largest = np.sqrt(float(view.mask.sum()) / np.array([high, middle, low]))
    if _touches_edge(view.mask):
        largest *= settings.cut_off
    step = np.log(settings.scale_ratio)
    steps = np.arange(
        np.floor(np.log(smallest / likely) / step), np.ceil(np.log(largest / likely) / step) + 1
    )
    steps = steps[np.argsort(np.abs(steps), kind="stable")]
    return np.asarray(likely * settings.scale_ratio**steps)


def _touches_edge(mask: np.ndarray) -> bool:
    """Return whether a mask touches the image border."""
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def _box(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest u and v of a silhouette, (2,) each [pixel]."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    low = np.array([left, top], float)
    return low, low + np.array([width - 1, height - 1])


def _extent(mask: np.ndarray) -> float:
    """Return the side of a square with the area of the silhouette's bounding box [pixel]."""
    low, high = _box(mask)
    return float(np.sqrt(np.prod(high - low + 1.0)))


def _near(view: View, places: np.ndarray) -> np.ndarray:
    """Return (n,) bool whether the root may be at each of n places (n, 2) in a view [pixel].

    A place must be near the silhouette; or, if it is outside the image, within the distance that a
    cut-off body may extend, and nearest to a border pixel that is near the silhouette.
    """
    extent, settings = _extent(view.mask), RootPlacementSettings()
    distances = distance_transform_edt(~view.mask)
    inside = np.clip(places, 0, np.array(view.mask.shape)[::-1] - 1)
    column, row = np.rint(inside).astype(np.int64).T
    near = distances[row, column] <= 0.75 * extent / settings.positions_across
    over = np.linalg.norm(places - inside, axis=1)
    return np.asarray(near & (over <= (settings.cut_off - 1.0) * extent))


def _lift(camera: Camera, places: np.ndarray, depth: float) -> np.ndarray:
    """Return points (n, 3) [m] at depth z_C [m] that a camera sees at places (n, 2) [pixel]."""
    if isinstance(camera, ParallelCamera):
        scale = np.full(2, 1.0 / camera.pixels_per_metre)
    else:
        scale = depth / np.array([camera.focal_x, camera.focal_y])
    p_C = np.empty((len(places), 3))
    p_C[:, :2] = (places - [camera.center_x, camera.center_y]) * scale
    p_C[:, 2] = depth
    return np.asarray(p_C @ camera.X_WC[:3, :3].T + camera.X_WC[:3, 3])


def in_camera(camera: Camera, p_W: np.ndarray) -> np.ndarray:
    """Return the point p_W (3,) of the world in the camera's frame [m]."""
    return np.asarray(camera.X_CW[:3, :3] @ p_W + camera.X_CW[:3, 3])
