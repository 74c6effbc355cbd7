"""Ways out of a bad match: parts of the body placed anew or mirrored in depth, the rest as it is.

A local refinement cannot turn a hand round or take a leg from behind the other. So parts of the
body - ends of limbs, whole limbs, single inner nodes - are searched again on their sampling grids,
hung on the continuous pose of the rest and scored by what they cover newly, rightly or wrongly.
Seen by one camera, a part mirrored in depth looks nearly the same, and so does half of the body if
its left and its right are exchanged: the mirror image of a body is a body again then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.fit.parameters import Placement
from drake_pose.fit.raster_lines import Border
from drake_pose.fit.surfaces import few_rigid_triangles
from drake_pose.search.estimates import View
from drake_pose.search.refinement import RefinementBody, RefinementProblem
from drake_pose.silhouette.areas.outline import pack
from drake_pose.silhouette.areas.scoring import prefix_sums
from drake_pose.silhouette.areas.span_kernel import score

_TRIANGLES = 200
# One row and column in so many is looked at that silhouettes have about this many pixels.
_COARSE_PIXELS = 3000
# Every so many rows are looked at where areas are only compared.
_NEAR_STRIDE = 2
# Hypotheses kept for the first, second, ... node of a part, and this many times more are scored
# with what the part itself hides taken into account.
_WIDTHS = (40, 12, 8)
_SPARE = 4
# Placements whose nodes' middles are all nearer than this are one [node radii].
_ALIKE = 0.35
_LONGEST_PART = 3
# How Gauss and Newton's method brings nodes to given places, and holds a node: so many steps, each
# no longer than so much, and damped by a share of a square metre.
_MOVE, _HOLD = (8, 0.5, 1e-4), (4, 1.0, 0.0)
# Steps smaller than this end it [rad or m].
_STANDSTILL = 2e-3


@dataclass(frozen=True)
class Part:
    """Nodes that are placed anew or mirrored together.

    Attributes:
        nodes: parents before children; the first one's joint stays.
        sources: for each the node whose mirror image it becomes.
        held: nodes that hang on these but stay as they are.
    """

    nodes: tuple[int, ...]
    sources: tuple[int, ...]
    held: tuple[int, ...] = ()

    @property
    def exchanged(self) -> bool:
        """Whether it is much of the body, left and right exchanged, which is only mirrored."""
        return self.nodes != self.sources


def find_parts(tree: PoseTree) -> tuple[Part, ...]:
    """The ends of all limbs, one to three nodes long, and the nodes of the trunk one by one."""
    chains = []
    for leaf in tree.leaves:
        chain = [leaf]
        while len(chain) <= _LONGEST_PART:
            if tree.source(chain[-1]) == chain[-1]:
                chains.append(tuple(reversed(chain)))
            parent = tree.nodes[chain[-1]].parent
            if parent < 0 or len(tree.nodes[parent].children) > 1:
                break
            chain.append(parent)
    moved = {node for chain in chains for node in chain}
    trunk = [i for i in range(len(tree.nodes)) if i not in moved and tree.source(i) == i]
    parts = [Part(chain, chain) for chain in chains]
    return (*parts, *(Part((i,), (i,), tuple(tree.nodes[i].children)) for i in trunk))


def find_reflections(tree: PoseTree) -> tuple[Part, ...]:
    """What may be mirrored: all that hangs on a node with pairs of limbs, and these limbs alone."""
    partners = dict(enumerate(range(len(tree.nodes))))
    limbs: dict[tuple[int, int], list[int]] = {}
    owners: set[int] = set()
    for leaf in tree.leaves:
        limb = [leaf]
        while (parent := tree.nodes[limb[0]].parent) >= 0 and len(tree.nodes[parent].children) == 1:
            limb.insert(0, parent)
        other = limbs.pop((parent, len(limb)), None)
        if other is None:
            limbs[parent, len(limb)] = limb
        elif parent >= 0:
            owners.add(parent)
            partners |= dict(zip(limb, other, strict=True)) | dict(zip(other, limb, strict=True))
    below = tree.subtrees
    reflections: list[tuple[Sequence[int], tuple[int, ...]]] = []
    for i in range(len(tree.nodes)):
        if owners & set(below[i]):
            reflections.append((below[i], ()))
        if i in owners:
            held = tuple(child for child in tree.nodes[i].children if partners[child] == child)
            left = set(below[i]).difference(*(below[child] for child in held))
            if held:
                reflections.append((sorted(left), held))
    return tuple(
        Part(tuple(nodes), tuple(partners[j] for j in nodes), held) for nodes, held in reflections
    )


class PartSearch:
    """Searches parts of a body again, on grids (n, k) of each node's values."""

    def __init__(self, body: RefinementBody, grids: Sequence[np.ndarray]) -> None:
        self.body = body
        self.parts, self.reflections = find_parts(body.tree), find_reflections(body.tree)
        self._grids = list(grids)
        sources = [grids[body.tree.source(i)] for i in range(len(grids))]
        self._X_PN = [body.tree.relative_transforms(i, grid) for i, grid in enumerate(sources)]
        # Bands of skin are small, and where they are depends on the sample.
        self._outlines = few_rigid_triangles(body.surfaces, _TRIANGLES).rigid
        nodes = body.kinematics.value_nodes
        self._columns = [np.flatnonzero(nodes == i) for i in range(len(grids))]
        self._balls = np.array([outline.ball for outline in body.surfaces.rigid])

    def propose(
        self,
        problem: RefinementProblem,
        parameters: np.ndarray,
        part: Part,
        count: int,
    ) -> list[np.ndarray]:
        """At most ``count`` other placements of a part of a pose (m + 4,), the best first."""
        X_WN = self.body.poses(parameters)
        others = problem.still(parameters, np.isin(np.arange(len(X_WN)), part.nodes))
        regions = _find_regions(problem, others)
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
            if self.body.tree.source(node) != node:
                same = which == samples[kept, -1]
                kept, which, X_new = kept[same], which[same], X_new[same]
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
        proposed = []
        for i in self._different(part, X_part, count):
            placed = parameters.copy()
            for node, sample in zip(part.nodes, samples[i], strict=True):
                placed[self._columns[node]] = self._grids[node][sample]
            proposed.append(self._hold(placed, X_WN, part.held))
        return proposed

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
        p_WN = self.body.poses(parameters)[:, :3, 3]
        origins = p_WN[[part.nodes[0] for part in self.parts]]
        # From joint to joint, and from the last one to the surface's end.
        ends = np.linalg.norm(self._balls[:, :3], axis=1) + self._balls[:, 3]
        radii = np.array([ends[part.nodes[-1]] for part in self.parts])
        for k, part in enumerate(self.parts):
            radii[k] += np.linalg.norm(np.diff(p_WN[list(part.nodes)], axis=0), axis=1).sum()
        discs = np.empty((len(problem.views), len(self.parts), 3))
        for view, disc in zip(problem.views, discs, strict=True):
            disc[:, :2], _ = view.camera.project(origins)
            sides, _ = view.camera.project(origins + radii[:, None] * view.camera.X_WC[:3, 0])
            disc[:, 2] = np.linalg.norm(sides - disc[:, :2], axis=1)
        return discs

    def _score(
        self, regions: Sequence[_Region], nodes: Sequence[int], X_WN: np.ndarray
    ) -> np.ndarray:
        """The area that nodes at poses X_WN (n, k, 4, 4) cover rightly less that wrongly, (n,)."""
        packed = pack(tuple(self._outlines[i] for i in nodes))
        total = np.zeros(len(X_WN))
        no_parts, no_bands = np.zeros((0, 4), dtype=np.int64), np.zeros((0, 0, 3))
        for X_CW, camera, sets in regions:
            X_CN = np.ascontiguousarray((X_CW @ X_WN)[:, :, :3])
            areas = score(packed, no_parts, no_bands, X_CN, camera, sets)
            total += areas[:, 1] - areas[:, 2]
        return total

    def _different(self, part: Part, X_part: np.ndarray, count: int) -> list[int]:
        """Placements (n, k, 4, 4) that differ in where some node is or how it is turned."""
        middles = self._middles(X_part, part.nodes)
        left = np.ones(len(X_part), dtype=np.bool_)
        chosen: list[int] = []
        while left.any() and len(chosen) < count:
            i = int(np.argmax(left))
            chosen.append(i)
            turned = np.abs(X_part[:, :, :3, :3] - X_part[i, :, :3, :3]).max(axis=(2, 3))
            far = np.linalg.norm(middles - middles[i], axis=2)
            far = far > _ALIKE * self._balls[list(part.nodes), 3]
            left &= np.any(far | (turned > 2.0 * _ALIKE), axis=1)
        return chosen

    def mirror(self, parameters: np.ndarray, part: Part, view: View) -> np.ndarray:
        """The parameters with a part mirrored in a view's depth about its first joint, nearly.

        Seen by parallel rays, the middle of each node stays where it is seen.
        """
        X_WN = self.body.poses(parameters)
        depth = view.camera.X_WC[:3, 2]
        middles = self._middles(X_WN[list(part.sources)], part.sources)
        away = (middles - X_WN[part.nodes[0], :3, 3]) @ depth
        wanted, nodes = middles - 2.0 * np.outer(away, depth), list(part.nodes)
        columns = np.concatenate([self._columns[node] for node in nodes])
        p_N = self._balls[nodes, :3]
        moved = self._bring(parameters, nodes, p_N, wanted, columns, _MOVE)
        return self._hold(moved, X_WN, part.held)

    def _hold(self, parameters: np.ndarray, X_WN: np.ndarray, nodes: Sequence[int]) -> np.ndarray:
        """The parameters with nodes brought back to about X_WN by their own values."""
        for node in nodes:
            radius = max(float(self._balls[node, 3]), 1e-6)
            p_N = radius * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
            wanted = p_N @ X_WN[node, :3, :3].T + X_WN[node, :3, 3]
            columns, points = self._columns[node], [node] * len(p_N)
            parameters = self._bring(parameters, points, p_N, wanted, columns, _HOLD)
        return parameters

    def _bring(
        self,
        parameters: np.ndarray,
        nodes: Sequence[int],
        p_N: np.ndarray,
        wanted: np.ndarray,
        columns: np.ndarray,
        how: tuple[int, float, float],
    ) -> np.ndarray:
        """The parameters, some columns changed so that points (n, 3) of nodes come to places."""
        lower, upper = self.body.lower[columns], self.body.upper[columns]
        (steps, longest, damping), moved = how, parameters.copy()
        for _ in range(steps):
            placed = self.body.place(moved, bent=False)
            X = placed.X_WN[list(nodes)]
            p_W = np.einsum("kij,kj->ki", X[:, :3, :3], p_N) + X[:, :3, 3]
            A, off = _velocities(placed, nodes, columns, p_W), (wanted - p_W).ravel()
            if damping:
                step = np.linalg.solve(A.T @ A + damping * np.eye(len(columns)), A.T @ off)
            else:
                step = np.linalg.lstsq(A, off, rcond=1e-6)[0]
            before = moved[columns]
            moved[columns] = np.clip(before + np.clip(step, -longest, longest), lower, upper)
            if np.abs(moved[columns] - before).max(initial=0.0) < _STANDSTILL:
                break
        return moved

    def _middles(self, X_WN: np.ndarray, nodes: Sequence[int]) -> np.ndarray:
        """The middles (..., k, 3) of some nodes at X_WN (..., k, 4, 4) in the world [m]."""
        p_N = self._balls[list(nodes), :3]
        return np.asarray(np.einsum("...kij,kj->...ki", X_WN[..., :3, :3], p_N) + X_WN[..., :3, 3])


def _velocities(
    placed: Placement, nodes: Sequence[int], columns: np.ndarray, p_W: np.ndarray
) -> np.ndarray:
    """How points (n, 3), each of a node, move with parameters (k,), by index: (3 n, k)."""
    dense = placed.dense(len(placed.motions))
    motions = dense[list(nodes)][:, columns].reshape(len(p_W), -1, 3, 4)
    moved = np.einsum("nkij,nj->nik", motions[..., :3], p_W) + motions[..., 3].transpose(0, 2, 1)
    return np.asarray(moved.reshape(3 * len(p_W), -1))


_Region = tuple[np.ndarray, np.ndarray, np.ndarray]


def _find_regions(problem: RefinementProblem, others: Sequence[Border]) -> list[_Region]:
    """What a part may cover in each coarse view: silhouette and outside, less what others cover.

    Returns X_CW and kernel parameters of the camera, and prefix sums of both sets.
    """
    regions = []
    step = max(1, round((problem.area / (_COARSE_PIXELS * len(problem.views))) ** 0.5))
    for view, border in zip(problem.views, others, strict=True):
        mask = view.mask[::step, ::step]
        camera = view.camera.kernel_parameters()
        camera[1:5] /= step
        camera[6:] = mask.shape[1], mask.shape[0]
        free = ~border.covered(step, mask.shape)
        sets = np.array([prefix_sums(mask & free), prefix_sums(~mask & free)], dtype=np.int32)
        regions.append((np.asarray(view.camera.X_CW), camera, sets))
    return regions
