"""The beam search where the root's place, or the scale of a parallel camera, is not known.

Where the root can be follows from the silhouettes alone. One parallel camera of unknown scale: a
body twice as large looks like a camera with twice as many pixels a metre, so the scale is tried on
the camera and the body keeps its size. One pinhole: what is unknown beside the place in the picture
is the depth. Both are bounded by the silhouette's area, beside that of the body's own random poses,
and tried in geometric steps. Several calibrated cameras: a grid in space, of which every camera
leaves what lies in its silhouette.

The root's samples are the product of its rotations and of these positions. For every scale or depth
a beam of hypotheses is grown of which no root position may keep more than its quota: what covers
most at first is not what fits best at last. Whole poses compare fairly whatever their scale. The
best are refined with the root free; where the roots of the best of these are, the beam search is
run as with a known root; and in what comes of that what still fits badly is placed anew.
"""

import copy
import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.search.beam_search import BeamSearch, grow
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.partial_poses import PoseStore, SilhouetteBits, coarsen
from drake_pose.search.parts import NeighbourhoodSearch, PartSearch
from drake_pose.search.refinement import Pass, RefinementBody, RefinementProblem, descend
from drake_pose.search.sampled_body import SampledBody
from drake_pose.search.settings import PASSES, BeamSearchSettings, RootPlacementSettings, Stage
from drake_pose.silhouette.scoring import score_bodies
from drake_pose.workers import map_ordered


class RootPlaces(NamedTuple):
    """Root positions that are tried together.

    Attributes:
        views: the silhouettes, with a parallel camera's scale as it is tried.
        positions: (n, 3) of the root's origin in the world [m].
        scale: of the camera, times what it was given as.
    """

    views: tuple[View, ...]
    positions: np.ndarray
    scale: float = 1.0


def find_root_places(
    body: SampledBody, views: Sequence[View], scale_unknown: bool, known: np.ndarray | None
) -> list[RootPlaces]:
    """Where the root can be, the likeliest scales and depths first.

    Args:
        scale_unknown: the camera is parallel and its pixels_per_metre is not known.
        known: (3,) the root's position [m] if only the scale is unknown.

    Raises:
        SettingsError: the scale is unknown, but there is not just one parallel camera.
    """
    main, own = max(views, key=lambda view: int(view.mask.sum())), RootPlacementSettings()
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
        # The point nearest to the rays through all silhouettes' middles.
        A, b = np.zeros((3, 3)), np.zeros(3)
        for view in views:
            low, high = _box(view.mask)
            middle = 0.5 * (low + high)[None]
            ends = np.array([_lift(view.camera, middle, z)[0] for z in (1.0, 2.0)])
            along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
            across = np.eye(3) - np.outer(along, along)
            A += across
            b += across @ ends[0]
        # The smallest eigenvalue is about the squared sine of half the angle between two rays: 0 of
        # parallel ones.
        if np.linalg.eigvalsh(A)[0] >= 0.01:
            return [_places_in_space(views, main, np.linalg.solve(A, b), float(sizes[0]))]
    p_CR = _in_camera(camera, body.sampled.X_PN[0][0, :3, 3])
    # Places (n, 2) in the picture where the root can be seen, or beyond its edge [pixel].
    low, high = _box(main.mask)
    spacing = _extent(main.mask) / own.positions_across
    beyond = (own.cut_off - 1.0) * _extent(main.mask)
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

    Seen by a camera of ``factor`` times the scale, it keeps its place if it comes ``factor`` times
    nearer to the axis: a body and its root's place grow alike, or the camera's scale does.
    """
    p_CR = _in_camera(camera, p_WR)
    p_CR[:2] *= factor
    return np.asarray(camera.X_WC[:3, :3] @ p_CR + camera.X_WC[:3, 3])


def whereabouts(views: Sequence[View], p_WR: np.ndarray) -> np.ndarray:
    """(3 n,) where n views see a root (3,), and how large: 1 apart is one step of what is tried."""
    here, own = list[float](), RootPlacementSettings()
    for view in views:
        camera = view.camera
        place, depth = camera.project(p_WR[None])
        if isinstance(camera, ParallelCamera):
            size = camera.pixels_per_metre
        else:
            size = 1.0 / max(float(depth[0]), camera.near)
        spacing = _extent(view.mask) / own.positions_across
        here += [*(place[0] / spacing), np.log(size) / np.log(own.scale_ratio)]
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
    farthest: int = 60,
) -> np.ndarray:
    """At positions (n, 3) of one depth the rotations of the root whose pictures fit best.

    In one view the root looks nearly alike wherever it is in the picture: it is drawn once for each
    rotation and moved by whole pixels. In several views all rotations are taken.

    Args:
        count: the number of rotations at each.
        outside_weight: what a pixel outside counts; one covered counts one.
        farthest: the root is drawn no farther than this from its origin [pixel].

    Returns:
        (m,) the samples of ``place_body``, increasing.
    """
    rotations = len(body.sampled.X_PN[0])
    if len(views) > 1 or count >= rotations:
        return np.arange(len(positions) * rotations)
    (view,) = views
    places = np.atleast_2d(view.camera.project(positions)[0])
    middle = int(np.argmin(np.abs(places - places.mean(axis=0)).sum(axis=1)))
    # Pictures (r, side, side) of the root at its rotations, its place amidst.
    camera, ball, p_WR = view.camera, body.sampled.outlines[0].ball, positions[middle]
    depth = float(_in_camera(camera, p_WR)[2])
    scale = float(camera.kernel_parameters()[1])
    reach = float(np.linalg.norm(ball[:3]) + ball[3])
    if not isinstance(camera, ParallelCamera):
        scale /= max(depth - reach, 0.2 * depth)
    half = min(farthest, math.ceil(scale * reach) + 1)
    side, inner = 2 * half + 1, 2 * half - 1
    window = dataclasses.replace(
        camera,
        width=side,
        height=side,
        center_x=camera.center_x - float(places[middle, 0]) + half,
        center_y=camera.center_y - float(places[middle, 1]) + half,
    )
    everywhere = np.pad(np.ones((inner, inner), dtype=np.bool_), 1)
    placed = place_body(body, p_WR[None], np.arange(rotations))
    bits = SilhouetteBits(placed, [View(window, everywhere)], band=1)
    masks = np.zeros((rotations, int(bits.part_starts[-1])), dtype=np.uint64)
    bits.draw_node(0, np.arange(rotations), placed.sampled.X_PN[0], masks)
    pixels = np.unpackbits(masks.view(np.uint8), axis=1, count=inner**2, bitorder="little")
    pictures = np.zeros((rotations, side, side), dtype=np.float32)
    pictures[:, 1:-1, 1:-1] = pixels.reshape(rotations, inner, inner)
    # Beyond the picture's edge nothing counts.
    worth = np.pad(outside_weight - (1.0 + outside_weight) * view.mask, side).astype(np.float32)
    corners = np.rint(places).astype(np.int64) - side // 2 + side
    corners = np.clip(corners, 0, np.array(worth.shape)[::-1] - side)
    windows = np.lib.stride_tricks.sliding_window_view(worth, (side, side))
    seen = windows[corners[:, 1], corners[:, 0]].reshape(len(places), -1)
    costs = seen @ pictures.reshape(rotations, -1).T
    best = np.argpartition(costs, count - 1, axis=1)[:, :count]
    return np.sort((best + rotations * np.arange(len(places))[:, None]).ravel())


def _pixel_sizes(
    body: SampledBody, view: View, poses: int = 100, side: int = 240, rare: float = 0.03
) -> np.ndarray:
    """How many pixels a metre at the body may have (n,), the likeliest first.

    By areas of parallel projections of random ``poses`` of the grid, seen along the camera's axis
    in a picture of ``side`` pixels; of the smallest and the largest a share, ``rare``, is left out.
    """
    generator, sampled, own = np.random.default_rng(1), body.sampled, RootPlacementSettings()
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
        largest *= own.cut_off
    step = np.log(own.scale_ratio)
    steps = np.arange(
        np.floor(np.log(smallest / likely) / step), np.ceil(np.log(largest / likely) / step) + 1
    )
    steps = steps[np.argsort(np.abs(steps), kind="stable")]
    return np.asarray(likely * own.scale_ratio**steps)


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


def _near(view: View, places: np.ndarray) -> np.ndarray:
    """Which places (n, 2) [pixel] lie at the silhouette, or beyond it out of the picture."""
    extent, own = _extent(view.mask), RootPlacementSettings()
    distances = distance_transform_edt(~view.mask)
    inside = np.clip(places, 0, np.array(view.mask.shape)[::-1] - 1)
    column, row = np.rint(inside).astype(np.int64).T
    near = distances[row, column] <= 0.75 * extent / own.positions_across
    over = np.linalg.norm(places - inside, axis=1)
    return np.asarray(near & (over <= (own.cut_off - 1.0) * extent))


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


def _places_in_space(
    views: Sequence[View], main: View, middle: np.ndarray, size: float
) -> RootPlaces:
    """A grid in space about a point (3,), of which all views leave what lies in their silhouettes.

    ``size``: the likeliest number of pixels a metre in the largest silhouette, ``main``.
    """
    own, extent = RootPlacementSettings(), _extent(main.mask) / size
    half = 0.75 * extent * (own.cut_off if _touches_edge(main.mask) else 1.0)
    spacing = extent / own.positions_across
    steps = spacing * np.arange(-np.ceil(half / spacing), np.ceil(half / spacing) + 1)
    points = middle + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    for view in views:
        places, depth = view.camera.project(points)
        seen = np.ones(len(points), dtype=np.bool_)
        if not isinstance(view.camera, ParallelCamera):
            seen = depth > view.camera.near
        seen[seen] = _near(view, places[seen])
        points = points[seen]
    return RootPlaces(tuple(views), points)


@dataclass(frozen=True, eq=False)
class _Placed:
    """A pose somewhere: parameters of the refinement, the body of its own size, and J (1) [pixel].

    ``views``: the silhouettes, their camera scaled; ``scale``: times what it was given as.
    """

    views: tuple[View, ...]
    scale: float
    parameters: np.ndarray
    J: float


class RootPlacementSearch:
    """Matches silhouettes with a pose tree whose root can be anywhere.

    Args:
        tree: the pose tree; where its root is makes no difference.
        settings: the grids and the time limit; its stages are not used.
        scale_unknown: the camera is parallel and its pixels_per_metre is not known.

    Raises:
        SettingsError: if the tree has several roots.
        ModelError: if the model's joints do not let the root be anywhere.
    """

    def __init__(
        self,
        tree: PoseTree,
        settings: BeamSearchSettings | None = None,
        scale_unknown: bool = False,
    ) -> None:
        if sum(node.parent < 0 for node in tree.nodes) != 1:
            raise SettingsError("a root position can be searched only of a tree with one root")
        self.settings = settings or BeamSearchSettings()
        self.scale_unknown = scale_unknown
        p_WR = tree.node_poses(tree.default_values())[0, :3, 3]
        self.tree = tree.with_root_position(p_WR)
        self._grid = BeamSearch(
            self.tree,
            replace(
                self.settings, stages=(Stage(60, 1.0, 2),), research_hypotheses=0, time_limit=None
            ),
        )
        self.body = self._grid.body
        self.sampled = self.body.sampled
        self._refined = RefinementBody(self.tree)
        self._parts = PartSearch(self._refined, self.sampled.values)
        # Of the parameters after the tree's values: three of the translation, and growth.
        growth = (3,) if self.scale_unknown else ()
        self._free = {
            True: self._refined.freedom(extra=(0, 1, 2, *growth)),
            False: self._refined.freedom(extra=growth),
        }
        self._numbers = RootPlacementSettings()

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show, and where it is; see ``PoseSearch``.

        Raises:
            SettingsError: if there is no view, or a scale cannot be searched with these
                cameras.
        """
        if not views:
            raise SettingsError("a match needs at least one view, but none was given")
        begin = time.perf_counter()
        limit = self.settings.time_limit
        deadline = math.inf if limit is None else begin + limit
        layers = find_root_places(self.body, views, self.scale_unknown, root_position)
        placed: list[_Placed] = []
        own, width = self._numbers, math.ceil(self._numbers.hypotheses / len(layers))
        # How many poses each search of a layer has found.
        counts: list[int] = []

        def search(outside_fraction: float, layer: RootPlaces) -> list[_Placed]:
            if any(counts) and time.perf_counter() >= deadline:
                return []
            found = self._search_layer(layer, width, outside_fraction)
            counts.append(len(found))
            return found

        for outside_fraction in (own.outside_fraction, math.inf):
            if not placed:
                searched = map_ordered(partial(search, outside_fraction), layers)
                placed += itertools.chain.from_iterable(searched)
        runs = len(counts) * len(self.tree.nodes)
        if not placed:
            found = PoseEstimate.nothing(self.tree, stopped_by="end", runs=runs)
            return replace(found, seconds=time.perf_counter() - begin)
        placed.sort(key=attrgetter("J"))
        best = self._improve(placed[: own.starts], root_position is None, deadline)
        first_J = placed[0].J / _area(views) * _area(best.views)
        p_WR = self._root_of(best)
        tree = self.tree.with_root_position(p_WR)
        values = self._refined.node_values(self._refined.nearest_turns(best.parameters))
        # The plant's own joints hold the root where it is now.
        bounds = [tree.value_bounds(i) for i in range(len(tree.nodes))]
        held = [
            np.where(lower == upper, lower, one)
            for one, (lower, upper) in zip(values, bounds, strict=True)
        ]
        J = RefinementProblem(self._refined, best.views).J(best.parameters)
        now = time.perf_counter()
        return PoseEstimate.of_values(
            tree,
            held,
            J,
            _area(best.views),
            stopped_by="time_limit" if now >= deadline else "end",
            seconds=now - begin,
            root_position=p_WR,
            scale=best.scale,
            runs=runs,
            first_J=first_J,
        )

    def _search_layer(
        self, layer: RootPlaces, width: int, outside_fraction: float
    ) -> list[_Placed]:
        """The best whole poses of a scale or depth, of each root placement the best."""
        if len(layer.positions) == 0:
            return []
        own, views = (
            self._numbers,
            [coarsen(view, self._numbers.coarse_pixels) for view in layer.views],
        )
        quota, factor = math.ceil(own.quota * width), own.root_factor
        chosen = choose_root_samples(
            self.body, views, layer.positions, own.root_spare * factor * quota, own.outside_weight
        )
        body = place_body(self.body, layer.positions, chosen)
        store = PoseStore(body, SilhouetteBits(body, views), outside_fraction)
        # The position of each of the root's samples; none has more than its quota at any time.
        places, hypotheses = chosen // len(self.sampled.X_PN[0]), store.start()
        for node in self.body.order:
            spare = own.spare * factor * width
            grown, _ = grow(store, hypotheses, node, spare, own.outside_weight)
            if grown is None:
                return []
            groups = places[store.nodes[0].samples[grown.poses[:, 0]]]
            order = np.argsort(groups, kind="stable")
            ordered = groups[order]
            rank = np.empty(len(groups), dtype=np.int64)
            rank[order] = np.arange(len(groups)) - np.searchsorted(ordered, ordered)
            kept = np.flatnonzero(rank < factor * quota)[: factor * width]
            hypotheses, factor = grown.chosen(kept), 1
        # As many pixels as in the silhouettes themselves.
        Js = _area(layer.views) / store.bits.area * store.objectives(hypotheses)
        samples = store.samples(hypotheses.poses)
        order = np.argsort(Js, kind="stable")
        firsts = np.sort(np.unique(samples[order, 0], return_index=True)[1])[: own.starts]
        found = []
        for i in order[firsts]:
            p_WR = body.sampled.X_PN[0][samples[i, 0], :3, 3]
            parameters = self._refined.parameters(body.sampled.values_at(samples[i]), p_WR)
            found.append(_Placed(layer.views, layer.scale, parameters, float(Js[i])))
        return found

    def _improve(self, starts: Sequence[_Placed], moves: bool, deadline: float) -> _Placed:
        """The best pose reached from some; the root moves, too, if its position is unknown."""

        def before(step: Callable[[_Placed], Any], one: _Placed) -> Any:
            return step(one) if time.perf_counter() < deadline else None

        settle = partial(before, lambda one: self._settle(one, PASSES.coarse, moves))
        pool = [one for one in map_ordered(settle, starts) if one is not None]
        pool.sort(key=attrgetter("J"))

        def search_again(one: _Placed) -> list[_Placed]:
            # The beam search with the root where it is.
            p_WR, own = self._root_of(one), self._numbers
            starts = (
                replace(one, parameters=self._refined.parameters(values, p_WR))
                for values in self._grid.best_poses(one.views, p_WR, own.poses_again, own.overlap)
            )
            return [self._settle(start, PASSES.coarse, moves) for start in starts]

        again = partial(before, search_again)
        # Those whose root is not near that of one before them.
        elsewhere: list[tuple[_Placed, np.ndarray]] = []
        for one in pool:
            here = whereabouts(one.views, self._root_of(one))
            if all(np.abs(here - there).max() >= 1.0 for _, there in elsewhere):
                elsewhere.append((one, here))
        finalists = self._numbers.finalists
        for found in map_ordered(again, [one for one, _ in elsewhere[:finalists]]):
            pool += found or []
        pool.sort(key=attrgetter("J"))
        best = min([*pool, *starts], key=attrgetter("J"))
        enough, ends = self._numbers.good_E_total * _area(best.views), [best]

        def finish(one: _Placed) -> _Placed | None:
            # One that fits well enough ends it; what is finished beside that one is left out below.
            if min(end.J for end in ends) <= enough:
                return None
            # Not what is last in the list: another thread may have added its own.
            end = self._finish(one, moves, deadline)
            ends.append(end)
            return end

        for end in map_ordered(partial(before, finish), pool[:finalists]):
            if end is not None and best.J > enough:
                best = min(best, end, key=attrgetter("J"))
        return best

    def _settle(self, start: _Placed, passes: Sequence[Pass], moves: bool) -> _Placed:
        """The pose refined with its root free, growth turned into the camera's scale."""
        problem = RefinementProblem(self._refined, start.views)
        parameters, _, _ = descend(problem, start.parameters, self._free[moves], passes)
        refined = replace(start, parameters=parameters, J=float(problem.J(parameters)))
        growth, camera = math.exp(parameters[-1]), start.views[0].camera
        if growth == 1.0 or not isinstance(camera, ParallelCamera):
            return refined
        p_WR = slide_root(camera, self._root_of(refined), 1.0 / growth)
        values = self._refined.node_values(parameters)
        return _Placed(
            (View(scale_camera(camera, growth), start.views[0].mask),),
            start.scale * growth,
            self._refined.parameters(values, p_WR),
            refined.J,
        )

    def _root_of(self, placed: _Placed) -> np.ndarray:
        """(3,) where its root is [m]."""
        return np.array(self._refined.poses(placed.parameters)[0, :3, 3])

    def _finish(self, start: _Placed, moves: bool, deadline: float) -> _Placed:
        """The pose refined to the end, and what fits badly placed anew."""
        near = self._settle(start, PASSES.fine[:2], moves)
        problem = RefinementProblem(self._refined, near.views)
        enough = self._numbers.good_E_total * problem.area
        about = NeighbourhoodSearch(problem, self._parts)
        parameters, J = about.improve(near.parameters, enough, deadline)
        better = replace(near, parameters=parameters, J=float(J))
        end = self._settle(better, PASSES.fine, moves)
        return min(start, near, better, end, key=attrgetter("J"))


def _area(views: Sequence[View]) -> float:
    """The silhouettes' area [pixel]."""
    return float(sum(view.mask.sum() for view in views))
