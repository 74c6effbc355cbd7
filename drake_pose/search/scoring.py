"""Areas of a sampled pose tree in several views: all that the search asks of the pictures."""

import copy
from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.settings import GridSettings
from drake_pose.silhouette.areas.bending import TreeSurfaces
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.areas.scoring import draw_mask, prefix_sums, score_bodies, subtract_body

_BENT_OUTLINES = 256


class SampledTree:
    """A pose tree with every node's sampling grid, made once and matched to many pictures.

    Attributes:
        values: for each node (n, k) its values at its samples [rad or m].
        X_PN: for each node (n, 4, 4) its poses in its parent at its samples: at the parent's where
            its joints follow the parent's, so that it takes the sample that the parent takes.
        outlines: the rigid part of each node's surface: all of it where the model has no skin.
        bands: for each node (n, v, 3) the vertices of its band of skin at its samples, in the
            node's frame [m]; None for a node without one.
    """

    def __init__(self, tree: PoseTree, settings: GridSettings) -> None:
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
        # The same few samples are drawn again and again.
        self._bent_outline = lru_cache(maxsize=_BENT_OUTLINES)(self._bend)

    def outlines_at(self, nodes: Sequence[int], samples: np.ndarray) -> list[Outline]:
        """The whole surfaces of nodes at their samples (len(nodes),), each in its node's frame."""
        return [
            self.outlines[node]
            if self.bands[node] is None
            else self._bent_outline(int(node), int(sample))
            for node, sample in zip(nodes, samples, strict=True)
        ]

    def _bend(self, node: int, sample: int) -> Outline:
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
        """Areas of the union of nodes at many poses: (n, 1 + k) int64, as score_bodies.

        At samples (n, nodes) and poses X_CN (n, nodes, 4, 4), with prefix sums (k, H, W + 1) of
        sets.
        """
        bands = [(column, self.bands[node]) for column, node in enumerate(nodes)]
        placed = [band[samples[:, column]] for column, band in bands if band is not None]
        if not placed:
            return score_bodies([self.outlines[node] for node in nodes], X_CN, camera, prefixes)
        surfaces = [self.surfaces.whole(node) for node in nodes]
        return score_bodies(surfaces, X_CN, camera, prefixes, placed)

    def with_root_position(self, root_position: np.ndarray) -> "SampledTree":
        """The same with the root at another position (3,) [m]; all but the root is shared."""
        moved = copy.copy(self)
        moved.tree = self.tree.with_root_position(root_position)
        moved.values, moved.X_PN = list(self.values), list(self.X_PN)
        for i, node in enumerate(moved.tree.nodes):
            if node.parent < 0:
                moved.values[i], moved.X_PN[i] = moved._sample(i)
        return moved

    def poses(self, samples: np.ndarray) -> np.ndarray:
        """X_WN (n, nodes, 4, 4) at samples (n, nodes)."""
        X_WN = np.empty((*samples.shape, 4, 4))
        for i, node in enumerate(self.tree.nodes):
            X_PN = self.X_PN[i][samples[:, self.tree.source(i)]]
            X_WN[:, i] = X_PN if node.parent < 0 else X_WN[:, node.parent] @ X_PN
        return X_WN

    def values_at(self, samples: np.ndarray) -> list[np.ndarray]:
        """The values of each node at samples (nodes,)."""
        return [grid[t] for grid, t in zip(self.values, samples, strict=True)]

    def _sample(self, node: int) -> tuple[np.ndarray, np.ndarray]:
        settings, source = self._settings, self.tree.source(node)
        values = self.tree.grid(
            source, settings.interval, settings.intervals, settings.length_interval
        )
        own = values if source == node else values[:, :0]
        return own, self.tree.relative_transforms(node, values)


class Scoring:
    """Scores poses of a sampled tree against the silhouettes of one instant, one or more."""

    def __init__(self, sampled: SampledTree, views: Sequence[View]) -> None:
        self.sampled = sampled
        self.views = tuple(views)
        self.silhouette_prefixes = [prefix_sums(view.mask)[None] for view in self.views]
        self.silhouette_area = float(sum(int(view.mask.sum()) for view in self.views))
        self.X_CW = [np.asarray(view.camera.X_CW) for view in self.views]

    def candidate_poses(self, node: int, X_WP: np.ndarray) -> np.ndarray:
        """Poses X_WN of a node at all its samples, (n, 4, 4), for a pose of its parent."""
        return X_WP @ self.sampled.X_PN[node]

    def candidate_areas(
        self, node: int, samples: np.ndarray, X_WN: np.ndarray, regions: "Regions"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Areas of a node at samples (n,) and their poses X_WN (n, 4, 4).

        Returns:
            area(P_i minus S) in each view, (views, n) (4), and area(region and P_i) summed over
            the views, (n,) (5), (7).
        """
        outside, covered = [], np.zeros(len(X_WN))
        for view, prefixes, X_CW in zip(self.views, regions.prefixes, self.X_CW, strict=True):
            X_CN = (X_CW @ X_WN)[:, None]
            areas = self.sampled.areas([node], samples[:, None], X_CN, view.camera, prefixes)
            outside.append(areas[:, 0] - areas[:, 1])
            covered += areas[:, 2]
        return np.array(outside), covered

    def uncovered(self, nodes: Sequence[int], samples: np.ndarray, X_WN: np.ndarray) -> "Regions":
        """S minus the projections of some nodes (3), (6); samples and X_WN are of all nodes."""
        regions = Regions(self)
        if nodes:
            regions.subtract(nodes, samples[list(nodes)], X_WN[list(nodes)])
        return regions

    def J(self, samples: np.ndarray) -> np.ndarray:
        """The objective (1) [pixel] (n,) of poses at samples (n, nodes)."""
        total, X_WN = np.full(len(samples), self.silhouette_area), self.sampled.poses(samples)
        everything = range(len(self.sampled.outlines))
        for view, prefixes, X_CW in zip(
            self.views, self.silhouette_prefixes, self.X_CW, strict=True
        ):
            areas = self.sampled.areas(everything, samples, X_CW @ X_WN, view.camera, prefixes)
            total += areas[:, 0] - 2.0 * areas[:, 1]
        return total

    def draw(
        self, nodes: Sequence[int], samples: np.ndarray, X_WN: np.ndarray, view: int
    ) -> np.ndarray:
        """The union of nodes' projections, (H, W) bool, in the view of an index."""
        outlines = self.sampled.outlines_at(nodes, samples)
        return draw_mask(outlines, self.X_CW[view] @ X_WN, self.views[view].camera)

    def mean_node_areas(self, X_WN: np.ndarray) -> list[float]:
        """Mean area of a node with geometry in each view [pixel], at the first samples' poses."""
        first = np.zeros((1, 1), dtype=np.int64)
        solid = [i for i, node in enumerate(self.sampled.tree.nodes) if len(node.mesh.triangles)]
        means = []
        for view, prefixes, X_CW in zip(
            self.views, self.silhouette_prefixes, self.X_CW, strict=True
        ):
            areas = [
                self.sampled.areas([i], first, (X_CW @ X_WN[i])[None, None], view.camera, prefixes)[
                    0, 0
                ]
                for i in solid
            ]
            means.append(float(np.mean(areas)))
        return means


class Regions:
    """A region of the picture in each view that begins as the silhouette and only shrinks.

    Attributes:
        masks: for each view (H, W) uint8, the region.
        prefixes: for each view (2, H, W + 1), prefix sums of the silhouette and of the region.
    """

    def __init__(self, scoring: Scoring) -> None:
        self._scoring = scoring
        self.masks = [view.mask.astype(np.uint8) for view in scoring.views]
        self.prefixes = [np.repeat(sums, 2, axis=0) for sums in scoring.silhouette_prefixes]

    def subtract(self, nodes: Sequence[int], samples: np.ndarray, X_WN: np.ndarray) -> None:
        """Take the projections of nodes at samples (k,), poses (k, 4, 4), out of the region."""
        scoring = self._scoring
        outlines = scoring.sampled.outlines_at(nodes, samples)
        for view, X_CW, mask, prefixes in zip(
            scoring.views, scoring.X_CW, self.masks, self.prefixes, strict=True
        ):
            subtract_body(mask, prefixes[1], outlines, X_CW @ X_WN, view.camera)


class PoseSearch(Protocol):
    """A search for the pose that silhouettes show: what systems and programs need of any."""

    @property
    def tree(self) -> PoseTree:
        """The pose tree that is searched."""

    @property
    def sampled(self) -> SampledTree:
        """The pose tree with its sampling grids."""

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose; ``root_position``: (3,) [m] where it is not the tree's own."""
