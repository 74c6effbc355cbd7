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

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.fit.surfaces import simplify_rigid_parts
from drake_pose.search.estimates import View
from drake_pose.search.refinement import Freedom, RefinementBody, RefinementProblem, descend
from drake_pose.search.settings import NeighbourhoodSettings
from drake_pose.silhouette.outline import pack
from drake_pose.silhouette.scoring import prefix_sums
from drake_pose.silhouette.span_kernel import score

# X_CW, kernel parameters and prefix sums (2, H, W + 1) of a coarse view.
_Region = tuple[np.ndarray, np.ndarray, np.ndarray]


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


def find_parts(tree: PoseTree, longest: int = 3) -> tuple[Part, ...]:
    """The ends of all limbs, one to ``longest`` nodes, and the nodes of the trunk one by one."""
    chains = []
    for leaf in tree.leaves:
        chain = [leaf]
        while len(chain) <= longest:
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
        self._outlines = simplify_rigid_parts(body.surfaces, 200).rigid
        nodes = body.kinematics.value_nodes
        self._columns = [np.flatnonzero(nodes == i) for i in range(len(grids))]
        self._balls = np.array([outline.ball for outline in body.surfaces.rigid])
        self._signs = self._mirror_signs()

    def _mirror_signs(self, count: int = 5, least: float = 0.01) -> dict[int, np.ndarray]:
        """By node the signs (k,) of its partner's values in the mirrored body.

        Left and right are along that axis of the nodes' frames along which most nodes mirror.

        Args:
            count: number of values at which relative transforms are compared.
            least: nodes whose transforms differ by more from the mirrored ones are left out [m, 1].
        """
        tree, best = self.body.tree, dict[int, np.ndarray]()
        pairs = {(n, s) for r in self.reflections for n, s in zip(r.nodes, r.sources, strict=True)}
        for axis in range(3):
            S, signs = np.diag(np.where(np.arange(4) == axis, -1.0, 1.0)), dict[int, np.ndarray]()
            for node, source in pairs:
                width = len(self._columns[node])
                if width != len(self._columns[source]) or tree.source(node) != node:
                    continue
                lower, upper = tree.value_bounds(source)
                mixed = np.linspace(0.2, 0.8, count)[:, None] * np.linspace(0.7, 1.2, width)
                values = lower + mixed * (upper - lower)
                wanted = S @ tree.relative_transforms(source, values) @ S
                for flips in itertools.product((1.0, -1.0), repeat=width):
                    off = tree.relative_transforms(node, values * np.array(flips)) - wanted
                    if np.abs(off).max() < least:
                        signs[node] = np.array(flips)
                        break
            best = max(best, signs, key=len)
        return best

    def propose(
        self,
        problem: RefinementProblem,
        parameters: np.ndarray,
        part: Part,
        count: int = 3,
        widths: tuple[int, ...] = (40, 12, 8),
        spare: int = 4,
        alike: float = 0.35,
        coarse_pixels: int = 3000,
    ) -> list[np.ndarray]:
        """At most ``count`` other placements of a part of a pose (m + 4,), the best first.

        Args:
            widths: hypotheses kept for the first, second, ... node of a part.
            spare: this many times more are scored with what the part itself hides.
            alike: placements whose nodes' middles are all nearer are one [node radii].
            coarse_pixels: approximate area of the silhouettes as they are looked at.
        """
        X_WN = self.body.poses(parameters)
        others = problem.still(parameters, np.isin(np.arange(len(X_WN)), part.nodes))
        # What the part may cover in each coarse view: silhouette and outside, less what others
        # cover; with the camera's X_CW and kernel parameters.
        regions: list[_Region] = []
        step = max(1, round((problem.area / (coarse_pixels * len(problem.views))) ** 0.5))
        for view, border in zip(problem.views, others, strict=True):
            mask = view.mask[::step, ::step]
            camera = view.camera.kernel_parameters()
            camera[1:5] /= step
            camera[6:] = mask.shape[1], mask.shape[0]
            free = ~border.covered(step, mask.shape)
            sets = np.array([prefix_sums(mask & free), prefix_sums(~mask & free)], dtype=np.int32)
            regions.append((np.asarray(view.camera.X_CW), camera, sets))
        samples = np.zeros((1, 0), dtype=np.int64)
        X_part, gains = np.zeros((1, 0, 4, 4)), np.zeros(1)
        parent = self.body.tree.nodes[part.nodes[0]].parent
        X_WP = np.eye(4) if parent < 0 else X_WN[parent]
        for place, node in enumerate(part.nodes):
            tried = self._X_PN[node]
            before = X_WP[None] if place == 0 else X_part[:, -1]
            X_new = (before[:, None] @ tried[None]).reshape(-1, 4, 4)
            width = widths[min(place, len(widths) - 1)]
            kept = np.repeat(np.arange(len(samples)), len(tried))
            which = np.tile(np.arange(len(tried)), len(samples))
            if self.body.tree.source(node) != node:
                same = which == samples[kept, -1]
                kept, which, X_new = kept[same], which[same], X_new[same]
            scores = gains[kept] + self._score(regions, [node], X_new[:, None])
            if place > 0:
                best = np.argsort(-scores, kind="stable")[: spare * width]
                kept, which, X_new = kept[best], which[best], X_new[best]
            X_part = np.concatenate([X_part[kept], X_new[:, None]], axis=1)
            samples = np.column_stack([samples[kept], which])
            if place > 0:
                scores = self._score(regions, part.nodes[: place + 1], X_part)
            best = np.argsort(-scores, kind="stable")[:width]
            samples, X_part, gains = samples[best], X_part[best], scores[best]
        proposed: list[np.ndarray] = []
        middles = self._middles(X_part, part.nodes)
        left = np.ones(len(X_part), dtype=np.bool_)
        while left.any() and len(proposed) < count:
            # The best one that differs in where some node is or how it is turned.
            i = int(np.argmax(left))
            turned = np.abs(X_part[:, :, :3, :3] - X_part[i, :, :3, :3]).max(axis=(2, 3))
            gaps = np.linalg.norm(middles - middles[i], axis=2)
            far = gaps > alike * self._balls[list(part.nodes), 3]
            left &= np.any(far | (turned > 2.0 * alike), axis=1)
            placed = parameters.copy()
            for node, sample in zip(part.nodes, samples[i], strict=True):
                placed[self._columns[node]] = self._grids[node][sample]
            proposed.append(self._hold(placed, X_WN, part.held))
        return proposed

    def errors_near(self, problem: RefinementProblem, parameters: np.ndarray) -> np.ndarray:
        """For each part the area (parts,) wrong in any view within the part's reach [pixel]."""
        # Areas are only compared: every second row will do.
        areas, stride = np.zeros(len(self.parts)), 2
        discs = self.reaches(problem, parameters)
        for wrong, places in zip(problem.wrong(parameters), discs, strict=True):
            v, u = np.nonzero(wrong[::stride])
            x, y, r = places.T[:, :, None]
            inside = (u - x) ** 2 + (stride * v - y) ** 2 < r**2
            areas += stride * np.count_nonzero(inside, axis=1)
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

    def mirror(self, parameters: np.ndarray, part: Part, view: View, steps: int = 20) -> np.ndarray:
        """The parameters with a part mirrored in a view's depth about its first joint, nearly.

        Seen by parallel rays, the middle of each node stays where it is seen.

        Args:
            steps: of Gauss and Newton's method, at most.
        """
        X_WN = self.body.poses(parameters)
        depth = view.camera.X_WC[:3, 2]
        middles = self._middles(X_WN[list(part.sources)], part.sources)
        away = (middles - X_WN[part.nodes[0], :3, 3]) @ depth
        wanted, nodes = middles - 2.0 * np.outer(away, depth), list(part.nodes)
        columns = np.concatenate([self._columns[node] for node in nodes])
        p_N = self._balls[nodes, :3]
        if part.exchanged:
            parameters = self._exchanged(parameters, part, wanted)
        moved = self._bring(parameters, nodes, p_N, wanted, columns, (steps, 0.5, 1e-4))
        return self._hold(moved, X_WN, part.held)

    def _exchanged(self, parameters: np.ndarray, part: Part, wanted: np.ndarray) -> np.ndarray:
        """The parameters with a part's left and right exchanged, its first node turned to fit.

        ``wanted``: (k, 3) where the middles of its nodes should be [m].
        """
        moved, first = parameters.copy(), part.nodes[0]
        for node, source in zip(part.nodes[1:], part.sources[1:], strict=True):
            if node in self._signs:
                moved[self._columns[node]] = self._signs[node] * parameters[self._columns[source]]
        moved = np.clip(moved, self.body.lower, self.body.upper)
        X_WN, parent = self.body.poses(moved), self.body.tree.nodes[first].parent
        X_1W = np.linalg.inv(X_WN[first])
        p_1 = self._middles(X_WN[list(part.nodes)], part.nodes) @ X_1W[:3, :3].T + X_1W[:3, 3]
        tried = (np.eye(4) if parent < 0 else X_WN[parent]) @ self._X_PN[first]
        placed = np.einsum("nij,kj->nki", tried[:, :3, :3], p_1) + tried[:, None, :3, 3]
        nearest = np.argmin(np.square(placed - wanted).sum(axis=(1, 2)))
        moved[self._columns[first]] = self._grids[first][nearest]
        return moved

    def _hold(self, parameters: np.ndarray, X_WN: np.ndarray, nodes: Sequence[int]) -> np.ndarray:
        """The parameters with nodes brought back to about X_WN by their own values."""
        for node in nodes:
            radius = max(float(self._balls[node, 3]), 1e-6)
            p_N = radius * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
            wanted = p_N @ X_WN[node, :3, :3].T + X_WN[node, :3, 3]
            columns, points = self._columns[node], [node] * len(p_N)
            parameters = self._bring(parameters, points, p_N, wanted, columns, (4, 1.0, 0.0))
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
        """The parameters, some columns changed so that points (n, 3) of nodes come to places.

        By Gauss and Newton's method; ``how``: the number of steps, the longest step [rad or m] and
        the damping [m^2]. A step of less than 0.002 ends it.
        """
        lower, upper = self.body.lower[columns], self.body.upper[columns]
        (steps, longest, damping), moved = how, parameters.copy()
        for _ in range(steps):
            placed = self.body.place(moved, bent=False)
            X = placed.X_WN[list(nodes)]
            p_W = np.einsum("kij,kj->ki", X[:, :3, :3], p_N) + X[:, :3, 3]
            # How the points move with the parameters (3 n, k).
            motions = placed.dense(len(placed.motions))[list(nodes)][:, columns]
            motions = motions.reshape(len(p_W), -1, 3, 4)
            A = np.einsum("nkij,nj->nik", motions[..., :3], p_W) + motions[..., 3].transpose(
                0, 2, 1
            )
            A, off = A.reshape(3 * len(p_W), -1), (wanted - p_W).ravel()
            if damping:
                step = np.linalg.solve(A.T @ A + damping * np.eye(len(columns)), A.T @ off)
            else:
                step = np.linalg.lstsq(A, off, rcond=1e-6)[0]
            before = moved[columns]
            moved[columns] = np.clip(before + np.clip(step, -longest, longest), lower, upper)
            if np.abs(moved[columns] - before).max(initial=0.0) < 2e-3:
                break
        return moved

    def _middles(self, X_WN: np.ndarray, nodes: Sequence[int]) -> np.ndarray:
        """The middles (..., k, 3) of some nodes at X_WN (..., k, 4, 4) in the world [m]."""
        p_N = self._balls[list(nodes), :3]
        return np.asarray(np.einsum("...kij,kj->...ki", X_WN[..., :3, :3], p_N) + X_WN[..., :3, 3])


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
        # Other placements: J, the freedom of what is placed, and where.
        self._others: list[tuple[float, Freedom, np.ndarray]] = []
        self._settings = NeighbourhoodSettings()

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
        J, own = float(self.problem.J(parameters)), self._settings
        rounds = own.rounds * (2 if everywhere else 1)
        same = own.least_decrease * self.problem.border_length
        least = own.least_error * self.problem.area
        last = np.inf if tries is None else int(self._tried.sum()) + tries
        while J > enough and self._tried.sum() < last and time.perf_counter() < deadline:
            errors = self._errors_near(parameters, J)
            # A part is tried again only where the error near it is not the one it left.
            worth = ((errors >= least) | everywhere) & (self._tried < rounds)
            worth &= np.abs(errors - self._seen) > np.maximum(own.same_error * errors, same)
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
        problem, own, J = self.problem, self._settings, float(self.problem.J(parameters))
        # The body's halves were mirrored in other poses, if at all.
        for k in range(len(self.search.parts), len(self._parts)):
            self._try(parameters, J, k, False)
        known, kept = [parameters], []
        spare = own.alternative_excess * problem.border_length
        everything = problem.body.freedom()

        def is_known(pose: np.ndarray, poses: Sequence[np.ndarray]) -> bool:
            # A pose is not another one for a full turn.
            gaps = [problem.body.nearest_turns(pose, other) - other for other in poses]
            return any(float(np.abs(gap).max()) <= same for gap in gaps)

        for _, freedom, values in sorted(self._others, key=lambda one: one[0]):
            start = parameters.copy()
            start[freedom.columns] = values
            if is_known(start, known):
                continue
            refined, _, _ = descend(problem, start, freedom, own.final)
            J = float(problem.J(refined))
            if limit < J <= limit + spare and not is_known(refined, known):
                refined, _, _ = descend(problem, refined, everything, own.final)
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

    def _try(
        self, parameters: np.ndarray, J: float, chosen: int, erring: bool
    ) -> tuple[np.ndarray, float]:
        """The best pose that a part leads to, and its J; what is nearly as good is kept."""
        problem, length, own = self.problem, self.problem.border_length, self._settings
        part, freedom = self._parts[chosen], self._freedoms[chosen]
        still = problem.still(parameters, freedom.moved)
        # Where no error is near, a part is only mirrored.
        starts = [self.search.mirror(parameters, part, view) for view in problem.views]
        if erring and not part.exchanged:
            starts += self.search.propose(problem, parameters, part)
        rough, near = [], J + own.second_excess * length
        for start in starts:
            if part.exchanged:
                refined, apart, _ = descend(problem, start, freedom, own.mirrored)
                if near < apart <= J + own.repaired_excess * length:
                    # Limits keep parts from being mirrored: without another place for them the
                    # whole mirrored body would be given up.
                    refined, _, _ = descend(problem, refined, freedom, own.whole)
                    mending = NeighbourhoodSearch(problem, self.search, reflections=False)
                    refined, apart = mending.improve(refined, near, tries=own.repair_tries)
            else:
                refined, apart, _ = descend(problem, start, freedom, own.placed, still)
            if apart <= J + own.first_excess * length:
                rough.append((apart, refined))
        rough.sort(key=lambda pair: pair[0])
        found: list[tuple[float, np.ndarray]] = []
        for _, start in rough[: own.refined]:
            refined, apart, _ = descend(problem, start, freedom, own.second, still)
            if apart <= near:
                refined, _, _ = descend(problem, refined, freedom, own.fine, still)
                found.append((float(problem.J(refined)), refined))
        columns = freedom.columns
        self._others += [
            (other_J, freedom, other[columns])
            for other_J, other in found
            if other_J <= J + own.stored_excess * length
        ]
        least, best = min(found, key=lambda pair: pair[0], default=(np.inf, parameters))
        if least > J + own.whole_excess * length:
            return parameters, np.inf
        whole, _, _ = descend(problem, best, problem.body.freedom(), own.whole)
        whole_J = float(problem.J(whole))
        best, least = (whole, whole_J) if whole_J < least else (best, least)
        if least > J - own.least_decrease * length:
            return parameters, np.inf
        self._others.append((J, freedom, parameters[columns]))
        return best, least
