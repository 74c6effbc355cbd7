"""Areas of a sampled pose tree in several views: all that the search asks of the pictures."""

import copy
from collections.abc import Sequence

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.matching.result import View
from drake_pose.matching.settings import PaperSearchSettings
from drake_pose.silhouette import (
    draw_mask,
    outline_from_mesh,
    prefix_sums,
    score_bodies,
    score_candidates,
    subtract_body,
)


class SampledTree:
    """A pose tree with every node's sampling grid, made once and matched to many pictures.

    Args:
        tree: the pose tree.
        settings: gives the sampling intervals.
    """

    def __init__(self, tree: PoseTree, settings: PaperSearchSettings) -> None:
        self.tree = tree
        self._settings = settings
        samples = [self._sample(i) for i in range(len(tree.nodes))]
        self.values = [values for values, _ in samples]
        self.X_PN = [X_PN for _, X_PN in samples]
        self.outlines = [outline_from_mesh(node.mesh) for node in tree.nodes]

    def with_root_position(self, root_position: np.ndarray) -> "SampledTree":
        """The same with the root at another position (3,) [m]; all but the root is shared."""
        moved = copy.copy(self)
        moved.tree = self.tree.with_root_position(root_position)
        moved.values, moved.X_PN = list(self.values), list(self.X_PN)
        for i, node in enumerate(moved.tree.nodes):
            if node.parent < 0:
                moved.values[i], moved.X_PN[i] = moved._sample(i)
        return moved

    def _sample(self, node: int) -> tuple[np.ndarray, np.ndarray]:
        settings = self._settings
        values = self.tree.grid(
            node, settings.interval, settings.intervals, settings.length_interval
        )
        return values, self.tree.relative_transforms(node, values)


class Scoring:
    """Scores poses of a sampled tree against the silhouettes of one instant.

    Args:
        sampled: the sampled tree.
        views: the silhouettes, at least one.
    """

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
        self, node: int, X_WN: np.ndarray, regions: "Regions"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Areas of a node at poses X_WN (n, 4, 4) outside the silhouette and in a region of it.

        Returns:
            area(P_i minus S) in each view, (views, n) (4), and area(region and P_i) summed over
            the views, (n,) (5), (7).
        """
        outside, covered = [], np.zeros(len(X_WN))
        for view, prefixes, X_CW in zip(self.views, regions.prefixes, self.X_CW, strict=True):
            outline = self.sampled.outlines[node]
            areas = score_candidates(outline, X_CW @ X_WN, view.camera, prefixes)
            outside.append(areas[:, 0] - areas[:, 1])
            covered += areas[:, 2]
        return np.array(outside), covered

    def uncovered(self, nodes: Sequence[int], X_WN: np.ndarray) -> "Regions":
        """S minus the projections of some nodes at poses X_WN (all nodes, 4, 4) (3), (6)."""
        regions = Regions(self)
        if nodes:
            regions.subtract(nodes, X_WN[list(nodes)])
        return regions

    def J(self, X_WN: np.ndarray) -> np.ndarray:
        """The objective (1) of whole poses X_WN (n, nodes, 4, 4), (n,) [pixel]."""
        total = np.full(len(X_WN), self.silhouette_area)
        for view, prefixes, X_CW in zip(
            self.views, self.silhouette_prefixes, self.X_CW, strict=True
        ):
            areas = score_bodies(self.sampled.outlines, X_CW @ X_WN, view.camera, prefixes)
            total += areas[:, 0] - 2.0 * areas[:, 1]
        return total

    def draw(self, nodes: Sequence[int], X_WN: np.ndarray, view: int) -> np.ndarray:
        """The union of some nodes' projections in one view, bool; X_WN: (len(nodes), 4, 4)."""
        outlines = [self.sampled.outlines[node] for node in nodes]
        return draw_mask(outlines, self.X_CW[view] @ X_WN, self.views[view].camera)

    def mean_node_areas(self, X_WN: np.ndarray) -> list[float]:
        """Mean projected area of a node with geometry in each view [pixel], at one pose."""
        solid = [i for i, node in enumerate(self.sampled.tree.nodes) if len(node.mesh.triangles)]
        means = []
        for view, prefixes, X_CW in zip(
            self.views, self.silhouette_prefixes, self.X_CW, strict=True
        ):
            areas = [
                score_candidates(
                    self.sampled.outlines[i], X_CW @ X_WN[i : i + 1], view.camera, prefixes
                )[0, 0]
                for i in solid
            ]
            means.append(float(np.mean(areas)))
        return means


class Regions:
    """A region of the picture in each view that begins as the silhouette and only shrinks.

    Attributes:
        masks: for each view (H, W) uint8, the region.
        prefixes: for each view (2, H, W + 1), prefix sums of the silhouette and of the region.

    Args:
        scoring: the silhouettes.
    """

    def __init__(self, scoring: Scoring) -> None:
        self._scoring = scoring
        self.masks = [view.mask.astype(np.uint8) for view in scoring.views]
        self.prefixes = [np.repeat(sums, 2, axis=0) for sums in scoring.silhouette_prefixes]

    def subtract(self, nodes: Sequence[int], X_WN: np.ndarray) -> None:
        """Take the projections of nodes at poses X_WN (len(nodes), 4, 4) out of the region."""
        scoring = self._scoring
        outlines = [scoring.sampled.outlines[node] for node in nodes]
        for view, X_CW, mask, prefixes in zip(
            scoring.views, scoring.X_CW, self.masks, self.prefixes, strict=True
        ):
            subtract_body(mask, prefixes[1], outlines, X_CW @ X_WN, view.camera)
