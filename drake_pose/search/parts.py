"""Ways out of a bad match: parts of the body placed anew or mirrored in depth, the rest as it is.

A local refinement cannot turn a hand round or take a leg from behind the other. So parts of the
body - ends of limbs, whole limbs, single inner nodes - are searched again on their sampling grids,
hung on the continuous pose of the rest and scored by what they cover newly, rightly or wrongly.
Seen by one camera, a part mirrored in depth looks nearly the same, and so does half of the body if
its left and its right are exchanged: the mirror image of a body is a body again then.

The search about a pose is a variable neighbourhood descent (Mladenovic and Hansen 1997): what comes
near the pose's J is refined, and the pose moves there where that is better. It ends where each part
near an error was tried with that error. Poses found that are nearly as good are kept.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.fit.parameters import Placement
from drake_pose.fit.raster_lines import Border
from drake_pose.fit.surfaces import few_rigid_triangles
from drake_pose.search.estimates import View
from drake_pose.search.refinement import Freedom, Pass, RefinementBody, RefinementProblem, descend
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


# From nodes mirrored or placed anew to the local optimum: what is far after a pass is left.
_FAR_PASSES = (Pass(4, 4, 30.0, 100.0),)
_REFLECTED_PASSES = (Pass(8, 4, 30.0, 100.0), Pass(6, 3, 6.0, 30.0))
_NEAR_PASSES = (Pass(5, 3, 6.0, 30.0),)
_FINE_PASSES = (Pass(6, 2, 2.0, 5.0),)
_END_PASSES = (Pass(6, 1, 1.0, 0.5, slack=0.4),)
_WHOLE_PASSES = (Pass(3, 3, 6.0, 50.0), Pass(3, 2, 2.0, 5.0))
# What has no more J than this above what may be, as a share of the border's length, with its own
# parameters refined alone, is refined with all.
_SPARE_J = 0.015
# How many placements of a part, the best after the first pass, are refined on.
_PURSUED = 2
# Poses are refined on after the first pass, after the second, and kept, whose J is above the best
# one's by no more than these shares of the border's length.
_HOPEFUL, _NEAR, _KEPT = 0.15, 0.03, 0.03
# Mirrored poses with no more than this above are mended, by at most this many tries.
_MENDED, _MENDINGS = 0.35, 6
# What is nearly as good is refined with all of the body before it is judged.
_EQUAL = 0.01
# What is better by a smaller share is the same, not quite refined.
_BETTER = 0.003
# Errors that differ by a smaller share are the same.
_SAME_ERROR = 0.1
# How many placements of a part are refined.
_PROPOSALS = 3
# Parts with less wrong area near them are left alone until all are tried [share of the area].
_LEAST_ERROR = 0.001
# How often a part is tried at most before all are, and as often again then.
_ROUNDS = 2


class _Other(NamedTuple):
    """Another placement: its J, the parameters that are placed and where, and their freedom."""

    J: float
    freedom: Freedom
    values: np.ndarray


class NeighbourhoodSearch:
    """Searches about a pose for placements of parts; ``reflections``: half of the body, too."""

    def __init__(
        self, problem: RefinementProblem, search: PartSearch, *, reflections: bool = True
    ) -> None:
        self.problem, self.search = problem, search
        # What is mirrored in the depth of one camera another one sees.
        mirrored = search.reflections if reflections and len(problem.views) == 1 else ()
        self._parts = (*search.parts, *mirrored)
        self._freedoms = [
            problem.body.freedom(None if part.exchanged else (*part.nodes, *part.held))
            for part in self._parts
        ]
        self._sizes = np.array([len(part.nodes) for part in self._parts])
        self._seen = np.full(len(self._parts), np.inf)
        self._tried = np.zeros(len(self._parts), dtype=np.int64)
        self._others: list[_Other] = []

    def improve(
        self,
        parameters: np.ndarray,
        enough: float,
        deadline: float = np.inf,
        *,
        everywhere: bool = False,
        tries: int | None = None,
    ) -> tuple[np.ndarray, float]:
        """Better parameters than those (m + 4,) of a refined pose, and their J.

        Args:
            enough: J with which it ends [pixel].
            deadline: it ends when ``time.perf_counter`` says so.
            everywhere: try each part at least once.
            tries: it ends after this many; None: no limit.
        """
        J = float(self.problem.J(parameters))
        rounds = _ROUNDS * (2 if everywhere else 1)
        same = _BETTER * self.problem.border_length
        least = _LEAST_ERROR * self.problem.area
        last = np.inf if tries is None else int(self._tried.sum()) + tries
        while J > enough and self._tried.sum() < last and time.perf_counter() < deadline:
            errors = self._errors_near(parameters, J)
            # A part is worth another try only where the error near it is not the one it left.
            worth = ((errors >= least) | everywhere) & (self._tried < rounds)
            worth &= np.abs(errors - self._seen) > np.maximum(_SAME_ERROR * errors, same)
            if not worth.any():
                break
            # Half a body is mirrored after its parts.
            parts = len(self.search.parts)
            if worth[:parts].any():
                worth[parts:] = False
            chosen = int(np.argmax(np.where(worth, errors / self._sizes, -1.0)))
            self._tried[chosen] += 1
            better, better_J = self._try(parameters, J, chosen, bool(errors[chosen] >= least))
            if better_J < J:
                parameters, J = better, better_J
                errors = self._errors_near(parameters, J)
            self._seen[chosen] = errors[chosen]
        return parameters, J

    def others(self, parameters: np.ndarray, limit: float, same: float) -> list[np.ndarray]:
        """Other poses than the best (m + 4,) up to a limit of J, refined to the end, best first.

        ``same``: poses none of whose values differ by more are one [rad or m].
        """
        problem = self.problem
        known, kept = [parameters], []
        spare = _SPARE_J * problem.border_length
        everything = problem.body.freedom()

        def is_known(pose: np.ndarray, poses: Sequence[np.ndarray]) -> bool:
            # A pose is not another one for a full turn.
            gaps = [problem.body.nearest_turns(pose, other) - other for other in poses]
            return any(float(np.abs(gap).max()) <= same for gap in gaps)

        for other in sorted(self._others, key=lambda one: one.J):
            start = parameters.copy()
            start[other.freedom.columns] = other.values
            if is_known(start, known):
                continue
            refined, _, _ = descend(problem, start, other.freedom, _END_PASSES)
            J = float(problem.J(refined))
            if limit < J <= limit + spare and not is_known(refined, known):
                refined, _, _ = descend(problem, refined, everything, _END_PASSES)
                J = float(problem.J(refined))
            if J <= limit and not is_known(refined, known):
                kept.append((J, refined))
                known.append(refined)
            known.append(start)
        kept.sort(key=lambda pair: pair[0])
        return [pose for _, pose in kept]

    def _errors_near(self, parameters: np.ndarray, J: float) -> np.ndarray:
        """For each part the area (parts,) wrong within its reach [pixel]."""
        errors = self.search.errors_near(self.problem, parameters)
        return np.append(errors, np.full(len(self._parts) - len(errors), J))

    def _starts(self, parameters: np.ndarray, part: Part, erring: bool) -> list[np.ndarray]:
        """Poses to refine from; where no error is near, a part is only mirrored."""
        search = self.search
        starts = [search.mirror(parameters, part, view) for view in self.problem.views]
        if part.exchanged or not erring:
            return starts
        return starts + search.propose(self.problem, parameters, part, _PROPOSALS)

    def _try(
        self, parameters: np.ndarray, J: float, chosen: int, erring: bool
    ) -> tuple[np.ndarray, float]:
        """The best pose that a part leads to, and its J; what is nearly as good is kept."""
        problem, length = self.problem, self.problem.border_length
        part, freedom = self._parts[chosen], self._freedoms[chosen]
        still = problem.still(parameters, freedom.moved)
        rough = []
        for start in self._starts(parameters, part, erring):
            if part.exchanged:
                refined, apart = self._settle_reflected(start, J, freedom)
            else:
                refined, apart, _ = descend(problem, start, freedom, _FAR_PASSES, still)
            if apart <= J + _HOPEFUL * length:
                rough.append((apart, refined))
        rough.sort(key=lambda pair: pair[0])
        found: list[tuple[float, np.ndarray]] = []
        for _, start in rough[:_PURSUED]:
            refined, apart, _ = descend(problem, start, freedom, _NEAR_PASSES, still)
            if apart <= J + _NEAR * length:
                refined, _, _ = descend(problem, refined, freedom, _FINE_PASSES, still)
                found.append((float(problem.J(refined)), refined))
        columns = freedom.columns
        self._others += [
            _Other(other_J, freedom, other[columns])
            for other_J, other in found
            if other_J <= J + _KEPT * length
        ]
        least, best = min(found, key=lambda pair: pair[0], default=(np.inf, parameters))
        if least > J + _EQUAL * length:
            return parameters, np.inf
        whole, _, _ = descend(problem, best, problem.body.freedom(), _WHOLE_PASSES)
        whole_J = float(problem.J(whole))
        best, least = (whole, whole_J) if whole_J < least else (best, least)
        if least > J - _BETTER * length:
            return parameters, np.inf
        self._others.append(_Other(J, freedom, parameters[columns]))
        return best, least

    def _settle_reflected(
        self, start: np.ndarray, J: float, freedom: Freedom
    ) -> tuple[np.ndarray, float]:
        """A mirrored pose refined, single parts that could not be mirrored placed anew, and its J.

        Limits keep parts from being mirrored; without another place for them the whole mirrored
        body would be given up.
        """
        problem, length = self.problem, self.problem.border_length
        refined, apart, _ = descend(problem, start, freedom, _REFLECTED_PASSES)
        near = J + _NEAR * length
        if near < apart <= J + _MENDED * length:
            refined, _, _ = descend(problem, refined, freedom, _WHOLE_PASSES)
            mending = NeighbourhoodSearch(problem, self.search, reflections=False)
            refined, apart = mending.improve(refined, near, tries=_MENDINGS)
        return refined, apart
