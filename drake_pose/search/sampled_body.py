"""Sample a pose tree's joint values on a grid and score the poses against silhouettes.

``SampledTree`` holds the grid of each node, ``Scoring`` computes areas and the objective J in the
views, and ``SampledBody`` adds bounding and inscribed balls by which nodes are rejected quickly.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from drake_pose.body import PoseTree, require_tree
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import require_positive
from drake_pose.fit.surfaces import collapse_edges
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.silhouette.contour_points import CelledOutline, divide_outline
from drake_pose.silhouette.outline import Outline, TreeSurfaces
from drake_pose.silhouette.scoring import (
    VisualHull,
    draw_mask,
    prefix_sums,
    score_bodies,
    subtract_body,
)

# For each view: (H, W) uint8 mask of the part of the silhouette that no placed node covers, and
# (2, H, W + 1) row-wise prefix sums of the silhouette and of that part.
Regions = list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class GridSettings:
    """Sampling intervals of a pose tree's values.

    ``interval``: sampling interval of every angle [rad]; the paper's is 20 degrees.
    ``length_interval``: sampling interval of every prismatic position [m].

    Raises SettingsError: if a value is out of its range.
    """

    interval: float = math.radians(20.0)
    length_interval: float = 0.05

    def __post_init__(self) -> None:
        require_positive(interval=self.interval, length_interval=self.length_interval)


class SampledTree:
    """A pose tree with a sampling grid for each node.

    A grid pose is given by its samples (nodes,): the index of each node's sample.

    Attributes:
        values: for each node (n, k) its k values at its n samples [rad or m].
        X_PN: for each node (n, 4, 4) its poses in its parent's frame P at its samples. A node whose
            joints mimic its parent's has a pose for each of the parent's samples, and always takes
            the parent's sample.
        surfaces: the surfaces of all nodes.
        outlines: the rigid part of each node's surface; the whole surface if the model has no skin.
        bands: for each node (n, v, 3) the vertices of its deformable band of skin at its samples,
            in the node's frame [m]; None for a node without one.
    """

    def __init__(self, tree: PoseTree, settings: GridSettings) -> None:
        require_tree(tree)
        self.tree = tree
        self._settings = settings
        samples = [self._sample(i) for i in range(len(tree.nodes))]
        self.values = [values for values, _ in samples]
        self.X_PN = [X_PN for _, X_PN in samples]
        self.surfaces = TreeSurfaces(tree)
        self.outlines = self.surfaces.rigid
        self.bands = [
            None if node.skin is None else node.skin.vertices(values)
            for node, values in zip(tree.nodes, self.values, strict=True)
        ]
        # A search draws few different samples many times.
        self._bent_outline = lru_cache(maxsize=256)(self._bend)

    def outlines_at(self, nodes: Sequence[int], samples: np.ndarray) -> list[Outline]:
        """Return the whole surfaces of nodes (k,) at samples (k,), each in its node's frame."""
        return [
            self.outlines[node]
            if self.bands[node] is None
            else self._bent_outline(int(node), int(sample))
            for node, sample in zip(nodes, samples, strict=True)
        ]

    def _bend(self, node: int, sample: int) -> Outline:
        """Return a node's surface with its band of skin deformed as at a sample."""
        bending, bands = self.surfaces.bending[node], self.bands[node]
        return (
            self.outlines[node] if bending is None or bands is None else bending.at(bands[sample])
        )

    def areas(
        self,
        nodes: Sequence[int],
        samples: np.ndarray,
        X_CN: np.ndarray,
        camera: Camera,
        prefixes: np.ndarray,
    ) -> np.ndarray:
        """Return areas of the union of some nodes' projections, for many poses.

        Args:
            nodes: indices of these nodes.
            samples: (n, len(nodes)) their samples; they place the skin bands only.
            X_CN: (n, len(nodes), 4, 4) their poses in the camera.
            camera: the camera onto whose image the nodes are projected.
            prefixes: (k, H, W + 1) row-wise prefix sums of k sets of pixels.

        Returns:
            (n, 1 + k) int64 the area of the union, and of its intersection with each set [pixel].
        """
        bands = [(column, self.bands[node]) for column, node in enumerate(nodes)]
        placed = [band[samples[:, column]] for column, band in bands if band is not None]
        if not placed:
            return score_bodies([self.outlines[node] for node in nodes], X_CN, camera, prefixes)
        surfaces = [self.surfaces.whole(node) for node in nodes]
        return score_bodies(surfaces, X_CN, camera, prefixes, placed)

    def with_root_position(self, root_position: np.ndarray) -> "SampledTree":
        """Return a copy with the root at (3,) [m]; the data of all other nodes is shared."""
        moved = copy.copy(self)
        moved.tree = self.tree.with_root_position(root_position)
        moved.values, moved.X_PN = list(self.values), list(self.X_PN)
        for i, node in enumerate(moved.tree.nodes):
            if node.parent < 0:
                moved.values[i], moved.X_PN[i] = moved._sample(i)
        return moved

    def poses(self, samples: np.ndarray) -> np.ndarray:
        """Return X_WN (n, nodes, 4, 4) at samples (n, nodes)."""
        X_WN = np.empty((*samples.shape, 4, 4))
        for i, node in enumerate(self.tree.nodes):
            X_PN = self.X_PN[i][samples[:, self.tree.source(i)]]
            X_WN[:, i] = X_PN if node.parent < 0 else X_WN[:, node.parent] @ X_PN
        return X_WN

    def values_at(self, samples: np.ndarray) -> list[np.ndarray]:
        """Return each node's values (k,) at samples (nodes,) [rad or m]."""
        return [grid[t] for grid, t in zip(self.values, samples, strict=True)]

    def _sample(self, node: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a node's values (n, k) and poses X_PN (n, 4, 4) at its n grid samples.

        For a node whose joints mimic its parent's, k is 0 and n the parent's number of samples.
        """
        settings, source = self._settings, self.tree.source(node)
        values = self.tree.grid(source, settings.interval, settings.length_interval)
        own = values if source == node else values[:, :0]
        return own, self.tree.relative_transforms(node, values)


class Scoring:
    """Scores poses of a sampled tree against the silhouettes of one frame, in one or more views.

    S is the silhouette, P_i the projection of node i; equation numbers are those of Kameda's paper.

    Attributes:
        silhouette_prefixes: for each view (1, H, W + 1) row-wise prefix sums of the silhouette.
        silhouette_area: total area of the silhouettes [pixel].
        X_CW: (4, 4) pose of the world in each view's camera.
    """

    def __init__(self, sampled: SampledTree, views: Sequence[View]) -> None:
        self.sampled = sampled
        self.views = tuple(views)
        self.silhouette_prefixes = [prefix_sums(view.mask)[None] for view in self.views]
        self.silhouette_area = float(sum(int(view.mask.sum()) for view in self.views))
        self.X_CW = [np.asarray(view.camera.X_CW) for view in self.views]

    def candidate_areas(
        self, node: int, samples: np.ndarray, X_WN: np.ndarray, regions: Regions
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return areas of a node outside the silhouette and in the uncovered part of it.

        Args:
            node: the node i.
            samples: (n,) its samples.
            X_WN: (n, 4, 4) its poses at these samples.
            regions: the uncovered part of the silhouette in each view.

        Returns (views, n) area of P_i outside S in each view, equation (4) [pixel]; and (n,) area
        of P_i in the uncovered part of S, summed over the views, equations (5) and (7) [pixel].
        """
        outside, covered = [], np.zeros(len(X_WN))
        for view, (_, prefixes), X_CW in zip(self.views, regions, self.X_CW, strict=True):
            X_CN = (X_CW @ X_WN)[:, None]
            areas = self.sampled.areas([node], samples[:, None], X_CN, view.camera, prefixes)
            outside.append(areas[:, 0] - areas[:, 1])
            covered += areas[:, 2]
        return np.array(outside), covered

    def uncovered(self, nodes: Sequence[int], samples: np.ndarray, X_WN: np.ndarray) -> Regions:
        """Return S minus the projections of some nodes, equations (3) and (6); none: all of S.

        ``samples``, ``X_WN``: (all nodes,) samples and (all nodes, 4, 4) poses of the whole tree.
        """
        regions = [
            (view.mask.astype(np.uint8), np.repeat(sums, 2, axis=0))
            for view, sums in zip(self.views, self.silhouette_prefixes, strict=True)
        ]
        if nodes:
            self.subtract(regions, nodes, samples[list(nodes)], X_WN[list(nodes)])
        return regions

    def subtract(
        self, regions: Regions, nodes: Sequence[int], samples: np.ndarray, X_WN: np.ndarray
    ) -> None:
        """Remove k nodes at samples (k,), X_WN (k, 4, 4) from each view's ``regions``, in place."""
        outlines = self.sampled.outlines_at(nodes, samples)
        for view, X_CW, (mask, prefixes) in zip(self.views, self.X_CW, regions, strict=True):
            subtract_body(mask, prefixes[1], outlines, X_CW @ X_WN, view.camera)

    def J(self, samples: np.ndarray) -> np.ndarray:
        """Return (n,) the objective J of the poses at samples (n, nodes), equation (1) [pixel]."""
        total, X_WN = np.full(len(samples), self.silhouette_area), self.sampled.poses(samples)
        everything = range(len(self.sampled.outlines))
        views = zip(self.views, self.silhouette_prefixes, self.X_CW, strict=True)
        for view, prefixes, X_CW in views:
            areas = self.sampled.areas(everything, samples, X_CW @ X_WN, view.camera, prefixes)
            total += areas[:, 0] - 2.0 * areas[:, 1]
        return total

    def draw(
        self, nodes: Sequence[int], samples: np.ndarray, X_WN: np.ndarray, view: int
    ) -> np.ndarray:
        """Return the union (H, W) of k nodes at samples (k,), X_WN (k, 4, 4), in one view."""
        outlines = self.sampled.outlines_at(nodes, samples)
        return draw_mask(outlines, self.X_CW[view] @ X_WN, self.views[view].camera)

    def mean_node_areas(self, X_WN: np.ndarray) -> list[float]:
        """Return by view the mean area [pixel] of nodes with geometry, at X_WN (nodes, 4, 4)."""
        first = np.zeros((1, 1), dtype=np.int64)
        solid = [i for i, node in enumerate(self.sampled.tree.nodes) if len(node.mesh.triangles)]
        means = []
        views = zip(self.views, self.silhouette_prefixes, self.X_CW, strict=True)
        for view, prefixes, X_CW in views:
            X_CN, own = {i: (X_CW @ X_WN[i])[None, None] for i in solid}, (view.camera, prefixes)
            areas = [self.sampled.areas([i], first, X, *own) for i, X in X_CN.items()]
            means.append(float(np.mean([one[0, 0] for one in areas])))
        return means


class PoseSearch(Protocol):
    """Interface of all searches for the pose of a body in silhouettes."""

    @property
    def tree(self) -> PoseTree:
        """The pose tree whose values are searched."""

    @property
    def sampled(self) -> SampledTree:
        """The pose tree with its sampling grids."""

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose of the body in one frame's views, one per camera.

        ``root_position``: (3,) in the world [m]; None: that of the tree.
        """


class SampledBody:
    """A sampled tree with precomputed balls and orders for the searches on grids.

    A node's projection contains that of each of its inscribed balls, so a ball outside the
    silhouette rejects a pose.

    Attributes:
        surface_areas: for each node the mean area of its parallel projections over all directions
            [m^2].
        order: the nodes in the order in which they are placed, ends of limbs last.
        limb_order: the nodes in the order in which they are placed limb by limb.
        ball_radii: for each node (k,) radii of its inscribed balls [m]. They lie in the node's
            visual hull, or in a child's around a point that the child's joint does not move.
        p_PB: for each node (n, k, 3) the balls' centres in its parent's frame at each sample [m].
        forked: for each node whether it or a descendant has several children.
        reach_balls: (nodes, 4) centre in the parent's frame, and radius, of a ball that contains
            the node and its descendants at all samples [m].
    """

    def __init__(self, tree: PoseTree, settings: GridSettings) -> None:
        self.sampled = SampledTree(tree, settings)
        # The mean projected area of a convex surface is a quarter of its area (Cauchy). The length
        # of each plane's normal is twice the area of its triangle.
        self.surface_areas = [
            0.125 * float(np.linalg.norm(outline.planes[:, :3], axis=1).sum())
            for outline in self.sampled.outlines
        ]
        hulls = [VisualHull(outline) for outline in self.sampled.outlines]
        balls = [self._find_balls(node, hulls) for node in range(len(tree.nodes))]
        self._p_NB = [ball[:, :3] for ball in balls]
        self.ball_radii = [np.ascontiguousarray(ball[:, 3]) for ball in balls]
        self.p_PB = [self._place_balls(node) for node in range(len(tree.nodes))]
        self.reach_balls = self._find_reaches()
        self._celled: dict[tuple[int, float, bool], CelledOutline] = {}
        self._frontiers: dict[frozenset[int], tuple[np.ndarray, list[int]]] = {}
        self.forked = [
            any(len(tree.nodes[j].children) > 1 for j in below) for below in tree.subtrees
        ]
        self.order = self._find_order(limb_by_limb=False)
        self.limb_order = self._find_order(limb_by_limb=True)

    def with_root_position(self, root_position: np.ndarray) -> "SampledBody":
        """Return a copy with the root at (3,) [m]; the data of all other nodes is shared."""
        moved = copy.copy(self)
        moved.sampled = self.sampled.with_root_position(root_position)
        moved.p_PB = list(self.p_PB)
        for i, node in enumerate(moved.sampled.tree.nodes):
            if node.parent < 0:
                moved.p_PB[i] = moved._place_balls(i)
        moved.reach_balls = moved._find_reaches()
        return moved

    def frontier(self, placed: frozenset[int]) -> tuple[np.ndarray, list[int]]:
        """Return the open nodes, and the nodes that can be placed next, for a set of placed nodes.

        Returns (m,) int64 indices of placed nodes with a child that is not placed; and the indices
        of the nodes that are not placed and are roots or have a placed parent.
        """
        if placed not in self._frontiers:
            nodes = self.sampled.tree.nodes
            open_nodes = [i for i in sorted(placed) if not placed.issuperset(nodes[i].children)]
            waiting = [
                i
                for i, node in enumerate(nodes)
                if i not in placed and (node.parent < 0 or node.parent in placed)
            ]
            self._frontiers[placed] = np.array(open_nodes, dtype=np.int64), waiting
        return self._frontiers[placed]

    def celled_outline(self, node: int, camera: Camera, coarse: bool) -> CelledOutline:
        """Return the node's surface, divided into cells that suit a camera's distance.

        ``coarse``: whether a surface of more than 400 triangles is simplified to 300.
        """
        spread, outline = 0.0, self.sampled.outlines[node]
        if not isinstance(camera, ParallelCamera):
            # Greatest angle between the rays to the node's points and to its centre [rad]. A node
            # nearer to the camera than 0.8 of the nearest root's distance is drawn without a table.
            nearest = 0.8 * self.root_distances(camera).min()
            needed = outline.ball[3] / max(1e-6, nearest)
            spreads = [0.02 * 1.3**k for k in range(13)]
            spread = next((one for one in spreads if one >= needed), spreads[-1])
        coarse = coarse and len(outline.triangles) > 400
        key = (node, spread, coarse)
        if key not in self._celled:
            if coarse:
                outline = collapse_edges(outline, 300)
            skin, bands = self.sampled.tree.nodes[node].skin, self.sampled.bands[node]
            mesh = None if skin is None else skin.mesh
            self._celled[key] = divide_outline(outline, spread, mesh, bands)
        return self._celled[key]

    def mean_area(self, node: int, camera: Camera) -> float:
        """Return the node's projected area in a camera, averaged over all directions [pixel].

        In a pinhole camera the node is at the mean distance of the roots' samples.
        """
        scale = float(camera.kernel_parameters()[1])
        if not isinstance(camera, ParallelCamera):
            scale /= float(self.root_distances(camera).mean())
        return self.surface_areas[node] * scale**2

    def root_distances(self, camera: Camera) -> np.ndarray:
        """Return the distances (n,) from the camera to the roots at all their samples [m]."""
        nodes = zip(self.sampled.X_PN, self.sampled.tree.nodes, strict=True)
        roots = [X_PN[:, :3, 3] for X_PN, node in nodes if node.parent < 0]
        return np.asarray(np.linalg.norm(np.vstack(roots) - camera.X_WC[:3, 3], axis=1))

    def _find_balls(self, node: int, hulls: list[VisualHull]) -> np.ndarray:
        """Return balls (k, 4) in a node: up to ten, and one at each child's joint [m], in N."""
        balls = [hulls[node].spread_balls(10)]
        # A ball far from the parent's joint is most likely outside the silhouette: test it first.
        balls[0] = balls[0][np.argsort(-np.linalg.norm(balls[0][:, :3], axis=1), kind="stable")]
        for child in self.sampled.tree.nodes[node].children:
            X_NC = self.sampled.X_PN[child]
            p_CF = _fixed_points(X_NC, self.sampled.outlines[child].ball)
            if len(p_CF):
                radii = hulls[child].radii(p_CF)
                best = int(np.argmax(np.round(radii, 9)))
                if radii[best] > 0.0:
                    p_N = X_NC[0, :3, :3] @ p_CF[best] + X_NC[0, :3, 3]
                    balls.append(np.append(p_N, radii[best])[None])
        return np.vstack(balls)

    def _place_balls(self, node: int) -> np.ndarray:
        """Return (n, k, 3) centres of a node's balls in its parent's frame at all samples [m]."""
        X_PN = self.sampled.X_PN[node]
        placed = self._p_NB[node] @ np.swapaxes(X_PN[:, :3, :3], 1, 2) + X_PN[:, None, :3, 3]
        return np.ascontiguousarray(placed)

    def _find_reaches(self) -> np.ndarray:
        """Return (nodes, 4) the balls ``reach_balls``."""
        nodes = self.sampled.tree.nodes
        reaches = np.zeros((len(nodes), 4))
        for i in reversed(range(len(nodes))):
            # A ball that contains the node's surface, with its band of skin at all samples.
            ball, bands = self.sampled.outlines[i].ball, self.sampled.bands[i]
            if bands is not None:
                farthest = float(np.linalg.norm(bands - ball[:3], axis=-1).max())
                ball = np.append(ball[:3], max(ball[3], farthest))
            balls = np.vstack([ball, reaches[list(nodes[i].children)]])
            X_PN = self.sampled.X_PN[i]
            centers = balls[:, :3] @ np.swapaxes(X_PN[:, :3, :3], 1, 2) + X_PN[:, None, :3, 3]
            reaches[i] = _ball_around(centers.reshape(-1, 3), np.tile(balls[:, 3], len(X_PN)))
        return reaches

    def _find_order(self, limb_by_limb: bool) -> tuple[int, ...]:
        """Return the nodes in placement order: the trunk, then limbs, larger ones first.

        ``limb_by_limb``: True: each limb is placed to its end before the next; False: leaves, the
        ends of limbs, are placed after all other nodes of the limbs.
        """
        nodes, subtrees = self.sampled.tree.nodes, self.sampled.tree.subtrees
        sizes = [round(sum(self.surface_areas[j] for j in below), 5) for below in subtrees]
        placed: list[int] = []
        while len(placed) < len(nodes):
            last = placed[-1] if placed else -1

            def rank(i: int, last: int = last) -> tuple[bool, bool, bool, float, int]:
                is_end = not nodes[i].children and not limb_by_limb
                follows = not is_end and nodes[i].parent == last
                return not self.forked[i], is_end, not follows, -sizes[i], i

            placed.append(min(self.frontier(frozenset(placed))[1], key=rank))
        return tuple(placed)


def _fixed_points(X_PN: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """Return points (n, 3) in frame N that have the same position in the parent's frame P [m].

    ``X_PN``: (samples, 4, 4) poses of the node in its parent at all samples. ``ball``: (4,) centre
    and radius of the node's bounding ball in frame N [m].

    Returns 61 points of the axis over the ball's diameter if the rotations have a common one;
    otherwise one fixed point; (0, 3) if no point is fixed.
    """
    A = (X_PN[:, :3, :3] - X_PN[0, :3, :3]).reshape(-1, 3)
    b = (X_PN[0, :3, 3] - X_PN[:, :3, 3]).reshape(-1)
    _, sizes, Vt = np.linalg.svd(A, full_matrices=False)
    solid = sizes > 1e-9 * max(1.0, float(sizes[0]))
    point = np.linalg.lstsq(A, b, rcond=1e-9)[0]
    if np.abs(A @ point - b).max() > 1e-9:
        return np.zeros((0, 3))
    if solid.sum() != 2:
        return point[None]
    along = Vt[2] @ (ball[:3] - point) + np.linspace(-ball[3], ball[3], 61)
    return np.asarray(point + along[:, None] * Vt[2])


def _ball_around(centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return a small ball (4,), centre and radius, around balls (n, 3), (n,) [m].

    It is nearly the smallest one, found by the iteration of Badoiu and Clarkson.
    """
    center = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
    best, best_radius = center, np.inf
    for step in range(2, 50):
        distances = np.linalg.norm(centers - center, axis=1) + radii
        farthest = int(np.argmax(distances))
        if distances[farthest] < best_radius:
            best, best_radius = center, distances[farthest]
        center = center + (centers[farthest] - center) / step
    return np.append(best, best_radius)
