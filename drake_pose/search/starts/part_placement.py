"""Ways out of a bad match: parts of the body placed anew, the rest as it is.

A local refinement cannot turn a hand round or take a leg from behind the other. So parts of the
body - ends of limbs, whole limbs, single inner nodes - are searched again on their sampling grids,
hung on the continuous pose of the rest and scored by what they cover newly, rightly or wrongly;
what looks best is refined.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import fast_simplification
import numpy as np

from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.fit.parameters import Placement
from drake_pose.fit.raster_lines import Border
from drake_pose.search.estimates import View
from drake_pose.search.refinement import RefinementBody, RefinementProblem
from drake_pose.search.starts.depth_reflections import Reflection, find_reflections
from drake_pose.silhouette.areas.outline import Outline, outline_from_mesh, pack
from drake_pose.silhouette.areas.scoring import prefix_sums
from drake_pose.silhouette.areas.span_kernel import score

_TRIANGLES = 200
# One row and column in so many is looked at that silhouettes have about this many pixels.
_COARSE_PIXELS = 3000
# Hypotheses kept for the first, second, ... node of a part, and this many times more are scored
# with what the part itself hides taken into account.
_WIDTHS = (40, 12, 8)
_SPARE = 4
# Placements whose nodes' middles are all nearer than this are one [node radii].
_ALIKE = 0.35
_LONGEST_PART = 3
# Every so many rows are looked at where areas are only compared.
_NEAR_STRIDE = 2
# Steps of Gauss and Newton's method that bring nodes to given places.
_MOVES = 12
# Steps smaller than this end it [rad or m].
_STANDSTILL = 2e-3


@dataclass(frozen=True)
class Part:
    """Nodes that are placed anew together.

    Attributes:
        nodes: each the child of the one before.
        held: whether what hangs on the last one stays where it is; else nothing hangs on it.
    """

    nodes: tuple[int, ...]
    held: bool


def find_parts(tree: PoseTree) -> tuple[Part, ...]:
    """The ends of all limbs, one to three nodes long, and the nodes of the trunk one by one."""
    parts = []
    for leaf in tree.leaves:
        chain = [leaf]
        while len(chain) <= _LONGEST_PART:
            parts.append(Part(tuple(reversed(chain)), held=False))
            parent = tree.nodes[chain[-1]].parent
            if parent < 0 or len(tree.nodes[parent].children) > 1:
                break
            chain.append(parent)
    moved = {node for part in parts for node in part.nodes}
    parts += [Part((i,), held=True) for i in range(len(tree.nodes)) if i not in moved]
    return tuple(parts)


@dataclass(frozen=True, eq=False)
class _Regions:
    """One view without the part, coarse: its camera and prefix sums of what the part may cover."""

    X_CW: np.ndarray
    camera: np.ndarray
    sets: np.ndarray


class PartSearch:
    """Searches parts of a body again.

    Attributes:
        parts: the parts.
        reflections: what may be mirrored in depth together.

    Args:
        body: the body.
        grids: for each node its values (n, k) that are tried.
    """

    def __init__(self, body: RefinementBody, grids: Sequence[np.ndarray]) -> None:
        self.body = body
        self.parts = find_parts(body.tree)
        self.reflections = find_reflections(body.tree)
        self._grids = list(grids)
        self._X_PN = [body.tree.relative_transforms(i, grid) for i, grid in enumerate(grids)]
        # Bands of skin are small, and where they are depends on the sample.
        rigid = body.surfaces.rigid
        self._outlines = tuple(_coarsen(outline) for outline in rigid)
        nodes = body.kinematics.value_nodes
        self._columns = [np.flatnonzero(nodes == i) for i in range(len(grids))]
        self._balls = np.array([outline.ball for outline in rigid])
        self._firsts = [part.nodes[0] for part in self.parts]
        # How far a part reaches: from joint to joint, and from the last one to the surface's end.
        reaches = np.linalg.norm(self._balls[:, :3], axis=1) + self._balls[:, 3]
        self._ends = reaches[[part.nodes[-1] for part in self.parts]]
        pairs = [
            (i, *pair)
            for i, part in enumerate(self.parts)
            for pair in zip(part.nodes, part.nodes[1:], strict=False)
        ]
        steps = np.array(pairs, dtype=np.int64).reshape(-1, 3)
        self._owners, self._chains = steps[:, 0], steps[:, 1:]

    def propose(
        self,
        problem: RefinementProblem,
        parameters: np.ndarray,
        part: Part,
        count: int,
        still: Sequence[Border] | None = None,
    ) -> list[np.ndarray]:
        """Other placements of a part that suit the silhouettes, the best first.

        Args:
            problem: the silhouettes.
            parameters: (m + 4,) the pose.
            part: the part.
            count: at most this many.
            still: of ``RefinementProblem.still`` for all nodes but the part's; None: made here.

        Returns:
            The parameters of each.
        """
        X_WN = self.body.poses(parameters)
        if still is None:
            moved = np.isin(np.arange(len(X_WN)), part.nodes)
            still = problem.still(parameters, moved)
        regions = _find_regions(problem, still)
        samples = np.zeros((1, 0), dtype=np.int64)
        X_part, gains = np.zeros((1, 0, 4, 4)), np.zeros(1)
        parent = self.body.tree.nodes[part.nodes[0]].parent
        X_WP = np.eye(4) if parent < 0 else X_WN[parent]
        for place, node in enumerate(part.nodes):
            tried = self._X_PN[node]
            before = X_WP[None] if place == 0 else X_part[:, -1]
            X_new = (before[:, None] @ tried[None]).reshape(-1, 4, 4)
            width = _WIDTHS[min(place, len(_WIDTHS) - 1)]
            kept = np.repeat(np.arange(len(samples)), len(tried))
            which = np.tile(np.arange(len(tried)), len(samples))
            scores = gains[kept] + self._score(regions, [node], X_new[:, None])
            if place > 0:
                best = np.argsort(-scores, kind="stable")[: _SPARE * width]
                kept, which, X_new = kept[best], which[best], X_new[best]
            X_part = np.concatenate([X_part[kept], X_new[:, None]], axis=1)
            samples = np.column_stack([samples[kept], which])
            if place > 0:
                scores = self._score(regions, part.nodes[: place + 1], X_part)
            best = np.argsort(-scores, kind="stable")[:width]
            samples, X_part, gains = samples[best], X_part[best], scores[best]
        chosen = self._different(part, X_part, count)
        return [self._placed(parameters, X_WN, part, samples[i]) for i in chosen]

    def errors_near(self, problem: RefinementProblem, parameters: np.ndarray) -> np.ndarray:
        """For each part the area (parts,) wrong in any view within the part's reach [pixel]."""
        areas = np.zeros(len(self.parts))
        discs = self.reaches(problem, parameters)
        for wrong, places in zip(problem.wrong(parameters), discs, strict=True):
            v, u = np.nonzero(wrong[::_NEAR_STRIDE])
            x, y, r = places.T[:, :, None]
            inside = (u - x) ** 2 + (_NEAR_STRIDE * v - y) ** 2 < r**2
            areas += _NEAR_STRIDE * np.count_nonzero(inside, axis=1)
        return areas

    def reaches(self, problem: RefinementProblem, parameters: np.ndarray) -> np.ndarray:
        """For each view a disc in the picture that each part stays in (views, parts, 3) [pixel]."""
        X_WN = self.body.poses(parameters)
        origins = X_WN[self._firsts, :3, 3]
        steps = np.linalg.norm(
            X_WN[self._chains[:, 1], :3, 3] - X_WN[self._chains[:, 0], :3, 3], axis=1
        )
        radii = self._ends + np.bincount(self._owners, steps, len(self.parts))
        discs = np.empty((len(problem.views), len(self.parts), 3))
        for view, disc in zip(problem.views, discs, strict=True):
            disc[:, :2], _ = view.camera.project(origins)
            sides, _ = view.camera.project(origins + radii[:, None] * view.camera.X_WC[:3, 0])
            disc[:, 2] = np.linalg.norm(sides - disc[:, :2], axis=1)
        return discs

    def _score(
        self, regions: Sequence[_Regions], nodes: Sequence[int], X_WN: np.ndarray
    ) -> np.ndarray:
        """The area that nodes at poses X_WN (n, k, 4, 4) cover rightly less that wrongly, (n,)."""
        packed = pack(tuple(self._outlines[i] for i in nodes))
        total = np.zeros(len(X_WN))
        no_parts, no_bands = np.zeros((0, 4), dtype=np.int64), np.zeros((0, 0, 3))
        for region in regions:
            X_CN = np.ascontiguousarray((region.X_CW @ X_WN)[:, :, :3])
            areas = score(packed, no_parts, no_bands, X_CN, region.camera, region.sets)
            total += areas[:, 1] - areas[:, 2]
        return total

    def _different(self, part: Part, X_part: np.ndarray, count: int) -> list[int]:
        """Placements (n, k, 4, 4) that differ in where some node is or how it is turned."""
        balls = self._balls[list(part.nodes)]
        middles = np.einsum("nkij,kj->nki", X_part[..., :3, :3], balls[:, :3])
        middles += X_part[..., :3, 3]
        left = np.ones(len(X_part), dtype=np.bool_)
        chosen: list[int] = []
        while left.any() and len(chosen) < count:
            i = int(np.argmax(left))
            chosen.append(i)
            turned = np.abs(X_part[:, :, :3, :3] - X_part[i, :, :3, :3]).max(axis=(2, 3))
            far = np.linalg.norm(middles - middles[i], axis=2) > _ALIKE * balls[:, 3]
            left &= np.any(far | (turned > 2.0 * _ALIKE), axis=1)
        return chosen

    def _placed(
        self, parameters: np.ndarray, X_WN: np.ndarray, part: Part, samples: np.ndarray
    ) -> np.ndarray:
        """The parameters with the part at samples (k,) of its grids."""
        placed = parameters.copy()
        for node, sample in zip(part.nodes, samples, strict=True):
            placed[self._columns[node]] = self._grids[node][sample]
        return self._hold_children(placed, X_WN, part)

    def moving(self, part: Part) -> tuple[int, ...]:
        """The part's nodes and those that are held by their own values."""
        children = self.body.tree.nodes[part.nodes[-1]].children
        return (*part.nodes, *(children if part.held else ()))

    def _hold_children(self, parameters: np.ndarray, X_WN: np.ndarray, part: Part) -> np.ndarray:
        """The parameters with what hangs on a part held about where it is in X_WN."""
        for child in self.moving(part)[len(part.nodes) :]:
            parameters = self._hold(parameters, X_WN, child)
        return parameters

    def mirror(self, parameters: np.ndarray, part: Part, view: View) -> np.ndarray:
        """The parameters with a part mirrored in depth about its first joint, nearly.

        Seen by parallel rays, the middle of each node stays where it is seen. What the part holds
        stays as it is.

        Args:
            parameters: (m + 4,) the pose.
            part: the part.
            view: in whose depth it is mirrored.
        """
        X_WN = self.body.poses(parameters)
        middles, depth = self._middles(X_WN, part.nodes), view.camera.X_WC[:3, 2]
        away = (middles - X_WN[part.nodes[0], :3, 3]) @ depth
        wanted = middles - 2.0 * np.outer(away, depth)
        return self._hold_children(self._move(parameters, part.nodes, wanted), X_WN, part)

    def reflect(self, parameters: np.ndarray, reflection: Reflection, view: View) -> np.ndarray:
        """The parameters with much of the body mirrored in depth, nearly.

        Args:
            parameters: (m + 4,) the pose.
            reflection: one of ``reflections``.
            view: in whose depth.
        """
        X_WN = self.body.poses(parameters)
        middles, depth = self._middles(X_WN, reflection.sources), view.camera.X_WC[:3, 2]
        away = (middles - X_WN[reflection.nodes[0], :3, 3]) @ depth
        reflected = self._move(parameters, reflection.nodes, middles - 2.0 * np.outer(away, depth))
        for node in reflection.held:
            reflected = self._hold(reflected, X_WN, node)
        return reflected

    def _middles(self, X_WN: np.ndarray, nodes: Sequence[int]) -> np.ndarray:
        """The middles (k, 3) of some nodes in the world [m]."""
        X = X_WN[list(nodes)]
        return np.asarray(
            np.einsum("kij,kj->ki", X[:, :3, :3], self._balls[list(nodes), :3]) + X[:, :3, 3]
        )

    def _move(self, parameters: np.ndarray, nodes: Sequence[int], wanted: np.ndarray) -> np.ndarray:
        """The parameters with nodes' middles moved towards places (k, 3) by their own values."""
        body = self.body
        columns = np.concatenate([self._columns[node] for node in nodes])
        lower, upper = body.lower[columns], body.upper[columns]
        moved = parameters.copy()
        for _ in range(_MOVES):
            placed = body.place(moved, bent=False)
            p_W = self._middles(placed.X_WN, nodes)
            A = _velocities(placed, nodes, columns, p_W)
            step = np.linalg.solve(
                A.T @ A + 1e-4 * np.eye(len(columns)), A.T @ (wanted - p_W).ravel()
            )
            before = moved[columns]
            after = np.clip(before + np.clip(step, -0.5, 0.5), lower, upper)
            moved[columns] = after
            if np.abs(after - before).max() < _STANDSTILL:
                break
        return moved

    def _hold(self, parameters: np.ndarray, X_WN: np.ndarray, node: int) -> np.ndarray:
        """The parameters with a node brought back to about X_WN by its own values."""
        columns = self._columns[node]
        lower, upper = self.body.lower[columns], self.body.upper[columns]
        radius = max(float(self._balls[node, 3]), 1e-6)
        p_N = radius * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
        wanted = p_N @ X_WN[node, :3, :3].T + X_WN[node, :3, 3]
        held = parameters.copy()
        for _ in range(4):
            placed = self.body.place(held, bent=False)
            X = placed.X_WN[node]
            p_W = p_N @ X[:3, :3].T + X[:3, 3]
            A = _velocities(placed, [node] * len(p_N), columns, p_W)
            step = np.linalg.lstsq(A, (wanted - p_W).ravel(), rcond=1e-6)[0]
            before = held[columns]
            held[columns] = np.clip(before + np.clip(step, -1.0, 1.0), lower, upper)
            if np.abs(held[columns] - before).max() < _STANDSTILL:
                break
        return held


def _velocities(
    placed: Placement, nodes: Sequence[int], columns: np.ndarray, p_W: np.ndarray
) -> np.ndarray:
    """How points (n, 3), each of a node, move with parameters (k,), by index: (3 n, k)."""
    dense = placed.dense(len(placed.motions))
    motions = dense[list(nodes)][:, columns].reshape(len(p_W), -1, 3, 4)
    moved = np.einsum("nkij,nj->nik", motions[..., :3], p_W) + motions[..., 3].transpose(0, 2, 1)
    return moved.reshape(3 * len(p_W), -1)


def _find_regions(problem: RefinementProblem, still: Sequence[Border]) -> list[_Regions]:
    """What a part may cover in each view: silhouette and outside, less what others cover.

    Args:
        problem: the silhouettes.
        still: the border of all that is not of the part in each view.
    """
    regions = []
    pixels = problem.area / (_COARSE_PIXELS * len(problem.views))
    step = max(1, round(math.sqrt(pixels)))
    for view, border in zip(problem.views, still, strict=True):
        mask = np.ascontiguousarray(view.mask[::step, ::step])
        camera = view.camera.kernel_parameters()
        camera[1:5] /= step
        camera[6:] = mask.shape[1], mask.shape[0]
        free = ~border.covered(step, mask.shape)
        sets = np.empty((2, mask.shape[0], mask.shape[1] + 1), dtype=np.int32)
        for index, region in enumerate((mask & free, ~mask & free)):
            sets[index] = prefix_sums(region)
        regions.append(_Regions(np.asarray(view.camera.X_CW), camera, sets))
    return regions


@lru_cache(maxsize=256)
def _coarsen(outline: Outline) -> Outline:
    """The surface with fewer triangles (Garland and Heckbert's quadric error metric)."""
    if len(outline.triangles) <= _TRIANGLES:
        return outline
    points, triangles = fast_simplification.simplify(
        np.array(outline.vertices), np.array(outline.triangles), target_count=_TRIANGLES
    )
    return outline_from_mesh(TriangleMesh(np.asarray(points, dtype=np.float64), triangles))
