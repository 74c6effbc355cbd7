"""Small random problems with the objective of every pose of the grid, counted in drawn masks."""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.camera.models import ParallelCamera
from drake_pose.search import View, samples_at
from drake_pose.search.sampled_body import GridSettings, SampledBody
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.scoring import draw_mask

from .bodies import front_camera


@dataclass(frozen=True)
class GridProblem:
    """Views of a body, with the objective of every pose of its grid."""

    body: SampledBody
    views: list[View]
    choices: np.ndarray  # (poses, nodes) samples.
    Js: np.ndarray  # (poses,) objectives [pixel].

    @property
    def best(self) -> tuple[np.ndarray, float]:
        """Samples (nodes,) and objective of a best pose."""
        return self.choices[int(np.argmin(self.Js))], float(self.Js.min())

    def within(self, J: float) -> set[tuple[int, ...]]:
        """Return the samples of all poses with an objective up to J."""
        return {tuple(row) for row in self.choices[self.Js <= J].tolist()}

    def objective(self, node_values: tuple[np.ndarray, ...]) -> float:
        """Return J of a pose of the grid."""
        samples = samples_at(self.body.sampled, node_values)
        return float(self.Js[(self.choices == samples).all(axis=1)].item())


class ProblemMaker:
    """Makes problems of one body, in square pictures of ``side`` pixels.

    ``grid``: the sampling intervals [rad, m].
    """

    def __init__(self, tree: PoseTree, side: int = 70, **grid: float) -> None:
        self.tree, self.side, self.grid = tree, side, grid
        self.body = SampledBody(tree, GridSettings(**grid))
        ranges = [range(len(values)) for values in self.body.sampled.values]
        choices = np.array([*itertools.product(*ranges)], dtype=np.int64)
        # A node whose joints mimic its parent's takes the parent's sample.
        sources = [tree.source(i) for i in range(len(ranges))]
        self.choices = choices[(choices == choices[:, sources]).all(axis=1)]
        self._surfaces, self._masks = TreeSurfaces(tree), dict[int, np.ndarray]()

    @property
    def cameras(self) -> list[ParallelCamera]:
        """Two cameras, at 0 and 60 degrees about the vertical."""
        front = front_camera(self.side, shift=0.137)
        turn = np.eye(4)
        c, s = math.cos(math.radians(60)), math.sin(math.radians(60))
        turn[:2, :2] = [[c, -s], [s, c]]
        return [front, front.with_pose(turn @ np.array(front.X_WC))]

    def draw(self, values: list[np.ndarray], camera: ParallelCamera) -> np.ndarray:
        """Return the silhouette at each node's values, skin included."""
        X_CN = camera.X_CW @ self.tree.node_poses(values)
        return draw_mask(self._surfaces.at(values), X_CN, camera)

    def draw_node(self, node: int, values: list[np.ndarray], views: int) -> np.ndarray:
        """Return the silhouettes (views, H, W) of one node."""
        X_WN, surface = self.tree.node_poses(values), self._surfaces.node_at(node, values[node])
        cameras = self.cameras[:views]
        return np.array([draw_mask([surface], k.X_CW @ X_WN[[node]], k) for k in cameras])

    def make(
        self,
        generator: np.random.Generator,
        *,
        views: int,
        noise: float = 0.0,
        on_grid: bool = False,
    ) -> GridProblem:
        """Make a problem with a random pose; ``noise``: fraction of pixels that are inverted."""
        if on_grid:
            row = self.choices[generator.integers(len(self.choices))]
            values = self.body.sampled.values_at(row)
        else:
            bounds = [self.tree.value_bounds(i) for i in range(len(self.tree.nodes))]
            values = [generator.uniform(*bound) for bound in bounds]
        masks = [self.draw(values, camera) for camera in self.cameras[:views]]
        return self.problem(*(one ^ (generator.random(one.shape) < noise) for one in masks))

    def show(self, values: list[np.ndarray]) -> GridProblem:
        """Make the problem of one view of a pose, given by each node's values."""
        return self.problem(self.draw(values, self.cameras[0]))

    def problem(self, *masks: np.ndarray) -> GridProblem:
        """Make the problem of masks of the first cameras."""
        views = [View(camera, one) for camera, one in zip(self.cameras, masks, strict=False)]
        Js = np.zeros(len(self.choices))
        for k, view in enumerate(views):
            if k not in self._masks:
                rows = map(self.body.sampled.values_at, self.choices)
                self._masks[k] = np.array([self.draw(values, view.camera) for values in rows])
            Js += np.count_nonzero(self._masks[k] ^ view.mask, axis=(1, 2))
        return GridProblem(self.body, views, self.choices, Js)
