"""Small random problems with the objective of every pose of the grid."""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.camera.models import ParallelCamera
from drake_pose.search import BeamSearchSettings, SampledTree, Scoring, View, samples_at
from drake_pose.search.sampled_body import SampledBody
from drake_pose.silhouette.outline import Outline, outline_from_mesh
from drake_pose.silhouette.scoring import draw_mask

from .bodies import front_camera


@dataclass(frozen=True)
class GridProblem:
    """Views of a body, with the objective of every pose of its grid.

    ``choices``: (poses, nodes) samples; ``Js``: (poses,) objectives [pixel].
    """

    body: SampledBody
    views: list[View]
    choices: np.ndarray
    Js: np.ndarray

    @property
    def best(self) -> tuple[np.ndarray, float]:
        """Samples (nodes,) and objective of a best pose."""
        return self.choices[int(np.argmin(self.Js))], float(self.Js.min())

    def within(self, J: float) -> set[tuple[int, ...]]:
        """Return the samples of all poses with an objective up to J."""
        return {tuple(row) for row in self.choices[self.Js <= J].tolist()}


class ProblemMaker:
    """Makes problems of one body, on a grid with an interval [rad]."""

    def __init__(self, tree: PoseTree, interval: float) -> None:
        self.tree = tree
        self.body = SampledBody(tree, BeamSearchSettings(interval=interval))
        values = self.body.sampled.values
        choices = itertools.product(*(range(len(grid)) for grid in values))
        self.choices = np.array(list(choices), dtype=np.int64)
        batch = [grid[self.choices[:, i]] for i, grid in enumerate(values)]
        self.X_WN = tree.node_poses_batch(batch)

    def make(
        self,
        generator: np.random.Generator,
        *,
        views: int,
        noise: float,
        on_grid: bool,
        side: int = 70,
    ) -> GridProblem:
        """Make a problem with a random pose; ``noise``: fraction of pixels that are inverted."""
        if on_grid:
            X_WN = self.X_WN[generator.integers(len(self.X_WN))]
        else:
            bounds = [self.tree.value_bounds(i) for i in range(len(self.tree.nodes))]
            X_WN = self.tree.node_poses([generator.uniform(*bound) for bound in bounds])
        shown = []
        for camera in cameras(views, side):
            mask = draw_mask(self._outlines(), camera.X_CW @ X_WN, camera)
            shown.append(View(camera, mask ^ (generator.random(mask.shape) < noise)))
        return self.problem(shown)

    def show(self, values: list[np.ndarray]) -> GridProblem:
        """Make the problem of one view of a pose, given by each node's values."""
        camera = cameras(1, 70)[0]
        X_CN = camera.X_CW @ self.tree.node_poses(values)
        return self.problem([View(camera, draw_mask(self._outlines(), X_CN, camera))])

    def problem(self, shown: list[View]) -> GridProblem:
        """Make the problem of given views."""
        Js = Scoring(self.body.sampled, shown).J(self.choices)
        return GridProblem(self.body, shown, self.choices, Js)

    def _outlines(self) -> list[Outline]:
        return [outline_from_mesh(node.mesh) for node in self.tree.nodes]


def show_pose(sampled: SampledTree, values: list[np.ndarray], camera: ParallelCamera) -> View:
    """Return the silhouette of a pose of the grid, given by each node's values."""
    samples = samples_at(sampled, values)
    outlines = sampled.outlines_at(range(len(values)), samples)
    return View(camera, draw_mask(outlines, camera.X_CW @ sampled.tree.node_poses(values), camera))


def cameras(count: int, side: int) -> list[ParallelCamera]:
    """Return one or two cameras, at 0 and 60 degrees about the vertical."""
    front = front_camera(side, shift=0.137)
    turn = np.eye(4)
    c, s = math.cos(math.radians(60)), math.sin(math.radians(60))
    turn[:2, :2] = [[c, -s], [s, c]]
    return [front, front.with_pose(turn @ np.array(front.X_WC))][:count]
