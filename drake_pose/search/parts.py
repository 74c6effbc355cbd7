"""Escape from local optima: place parts of the body anew, or mirror them in depth.

A local refinement cannot turn a hand around or move a leg from behind the other. Parts of the body
(ends of limbs, whole limbs, single inner nodes) are therefore searched again on their sampling
grids, with the other nodes at their continuous pose, and scored by the silhouette that they newly
cover minus the area newly covered outside. In a single view a part mirrored in depth has nearly the
same projection, and so has half of the body with left and right exchanged.

The search around a pose is a variable neighbourhood descent (Mladenovic and Hansen 1997): poses
with J near that of the current pose are refined, and the best becomes the current pose if its J is
smaller. The search ends when each part near an error has been tried. Poses that are nearly as good
are stored.
"""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.fit.surfaces import simplify_rigid_parts
from drake_pose.search.estimates import View
from drake_pose.search.refinement import Freedom, Pass, RefinementBody, RefinementProblem, descend
from drake_pose.silhouette.outline import pack
from drake_pose.silhouette.scoring import prefix_sums
from drake_pose.silhouette.span_kernel import score

# For a coarse view: X_CW (4, 4), the camera's kernel parameters (8,), and prefix sums (2, H, W + 1)
# of the silhouette and of the area outside it, both without the pixels that other nodes cover.
_Region = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class NeighbourhoodSettings:
    """Parameters of the search around a pose; excesses of J are fractions of the border length."""

    placed: tuple[Pass, ...] = (Pass(4, 4, 30.0, 100.0),)  # First passes of a part placed anew.
    # First passes of a mirrored part of the body.
    mirrored: tuple[Pass, ...] = (Pass(8, 4, 30.0, 100.0), Pass(6, 3, 6.0, 30.0))
    second: tuple[Pass, ...] = (Pass(5, 3, 6.0, 30.0),)  # Passes after the first ones.
    fine: tuple[Pass, ...] = (Pass(6, 2, 2.0, 5.0),)  # Passes to the optimum of the part alone.
    final: tuple[Pass, ...] = (Pass(6, 1, 1.0, 0.5, slack=0.4),)  # Passes of alternative poses.
    whole: tuple[Pass, ...] = (Pass(3, 3, 6.0, 50.0), Pass(3, 2, 2.0, 5.0))  # All parts move.
    refined: int = 2  # Number of placements that get the second passes.
    noise: float = 0.03  # Pixel noise: poses whose J exceeds another's by less are as good.
    first_excess: float = 0.15  # Greatest excess over the current J after the first passes.
    repaired_excess: float = 0.35  # Mirrored poses up to this excess have their parts placed anew,
    repair_tries: int = 6  # with this number of tries.
    whole_excess: float = 0.01  # Poses up to this excess are refined with all parts moving.
    # Alternative poses up to this above their limit are refined with all parts moving.
    alternative_excess: float = 0.015
    least_decrease: float = 0.003  # A smaller decrease of J is no improvement.
    same_error: float = 0.1  # Errors of a part are equal if they differ by a smaller fraction.
    least_error: float = 0.001  # Parts with less error are not placed anew [fraction of the area].
    rounds: int = 2  # Number of tries of each part; doubled where all parts must be tried.


@dataclass(frozen=True)
class Part:
    """A part of the body that is placed anew or mirrored."""

    nodes: tuple[int, ...]  # Its nodes, parents before children.
    # For each node the node whose mirror image it becomes, usually itself.
    sources: tuple[int, ...]
    held: tuple[int, ...] = ()  # Children of these nodes that keep their pose.

    @property
    def exchanged(self) -> bool:
        """Whether left and right are exchanged; such a part is mirrored, but not placed anew."""
        return self.nodes != self.sources


def find_parts(tree: PoseTree, longest: int = 3) -> tuple[Part, ...]:
    """Return the parts that are placed anew.

    They are the ends of all limbs with one to ``longest`` nodes, and each other node alone, with
    its children held. Nodes that follow their parent neither start an end nor are parts alone.
    """
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
    """Return the parts that are mirrored with left and right exchanged.

    They are, for each node with a pair of limbs of equal length below it, its whole subtree; and
    for the node that has the pair, its subtree without the children that are in no pair.
    """
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
    """Searches and mirrors parts of a body.

    Attributes:
        parts: the parts that are placed anew.
        reflections: the parts that are mirrored with left and right exchanged.

    Args:
        body: the body.
        grids: for each node (n, k) its values at its samples [rad or m].
    """

    def __init__(self, body: RefinementBody, grids: Sequence[np.ndarray]) -> None:
        self.body = body
        self.parts, self.reflections = find_parts(body.tree), find_reflections(body.tree)
        self._grids = list(grids)
        sources = [grids[body.tree.source(i)] for i in range(len(grids))]
        self._X_PN = [body.tree.relative_transforms(i, grid) for i, grid in enumerate(sources)]
        # Bands of skin are left out: they are small, and their shape depends on the sample.
        self._outlines = simplify_rigid_parts(body.surfaces, 200).rigid
        nodes = body.kinematics.value_nodes
        self._columns = [np.flatnonzero(nodes == i) for i in range(len(grids))]
        self._balls = np.array([outline.ball for outline in body.surfaces.rigid])
        self._signs = self._mirror_signs()

    def _mirror_signs(self, count: int = 5, least: float = 0.01) -> dict[int, np.ndarray]:
        """Return by node the signs (k,), 1 or -1, of its values from its partner's in a mirror.

        The mirror plane is perpendicular to that axis of the nodes' frames for which most nodes
        have such signs.

        ``count``: number of values at which relative transforms are compared. ``least``: greatest
        difference of a node's transforms from the mirrored ones, in entries of the matrix [m or 1];
        nodes with a greater one are left out.
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
        same: float = 0.35,
        coarse_pixels: int = 3000,
    ) -> list[np.ndarray]:
        """Return other placements of a part, the best first.

        Args:
            problem: the silhouettes and the body.
            parameters: (m + 4,) the pose, as in ``RefinementBody``; its other nodes stay.
            part: the part that is placed anew.
            count: greatest number of placements.
            widths: number of hypotheses kept after the first, second, ... node of the part.
            spare: number of hypotheses that are scored as the union of the part's nodes, as a
                multiple of the width.
            same: placements are equal if the centres of all nodes are nearer than this [radii of
                the nodes] and the entries of their rotation matrices than twice this.
            coarse_pixels: approximate area of the reduced silhouettes [pixel].

        Returns (m + 4,) parameters of each placement.
        """
        X_WN = self.body.poses(parameters)
        others = problem.fixed_borders(parameters, np.isin(np.arange(len(X_WN)), part.nodes))
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
                # A node whose joints mimic its parent's takes the parent's sample.
                mimics = which == samples[kept, -1]
                kept, which, X_new = kept[mimics], which[mimics], X_new[mimics]
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
        centers = self._centers(X_part, part.nodes)
        left = np.ones(len(X_part), dtype=np.bool_)
        while left.any() and len(proposed) < count:
            # The best of the placements that differ from all chosen ones.
            i = int(np.argmax(left))
            turned = np.abs(X_part[:, :, :3, :3] - X_part[i, :, :3, :3]).max(axis=(2, 3))
            gaps = np.linalg.norm(centers - centers[i], axis=2)
            far = gaps > same * self._balls[list(part.nodes), 3]
            left &= np.any(far | (turned > 2.0 * same), axis=1)
            placed = parameters.copy()
            for node, sample in zip(part.nodes, samples[i], strict=True):
                placed[self._columns[node]] = self._grids[node][sample]
            proposed.append(self._restore(placed, X_WN, part.held))
        return proposed

    def errors_near(self, problem: RefinementProblem, parameters: np.ndarray) -> np.ndarray:
        """Return (parts,) the area of the mismatch within reach of each part, over all views.

        The areas [pixel] of ``problem`` at parameters (m + 4,) are estimated from every second row.
        """
        areas, stride = np.zeros(len(self.parts)), 2
        discs = self.reaches(problem, parameters)
        for wrong, places in zip(problem.mismatch(parameters), discs, strict=True):
            v, u = np.nonzero(wrong[::stride])
            x, y, r = places.T[:, :, None]
            inside = (u - x) ** 2 + (stride * v - y) ** 2 < r**2
            areas += stride * np.count_nonzero(inside, axis=1)
        return areas

    def reaches(self, problem: RefinementProblem, parameters: np.ndarray) -> np.ndarray:
        """Return discs that contain each part whatever its joint values, (views, parts, 3) [pixel].

        A disc is given by the u and v of its centre and its radius. It is about the part's first
        joint at parameters (m + 4,), in the views of ``problem``.
        """
        p_WN = self.body.poses(parameters)[:, :3, 3]
        origins = p_WN[[part.nodes[0] for part in self.parts]]
        # The distances from joint to joint, and from the last joint to the end of the surface.
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
        """Return (n,) silhouette minus outside area, in coarse pixels, newly covered by k nodes.

        ``nodes``: (k,) indices of the nodes. ``X_WN``: (n, k, 4, 4) n placements of them.
        """
        packed = pack(tuple(self._outlines[i] for i in nodes))
        total = np.zeros(len(X_WN))
        no_parts, no_bands = np.zeros((0, 4), dtype=np.int64), np.zeros((0, 0, 3))
        for X_CW, camera, sets in regions:
            X_CN = np.ascontiguousarray((X_CW @ X_WN)[:, :, :3])
            areas = score(packed, no_parts, no_bands, X_CN, camera, sets)
            total += areas[:, 1] - areas[:, 2]
        return total

    def mirror(self, parameters: np.ndarray, part: Part, view: View, steps: int = 20) -> np.ndarray:
        """Return parameters (m + 4,) with a part mirrored in a view's depth about its first joint.

        The centre of each node is brought near to its mirror image, which under parallel projection
        is at the same place in the image.

        ``parameters``: (m + 4,) the pose, as in ``RefinementBody``. ``view``: the view whose
        optical axis is the direction of depth. ``steps``: greatest number of Gauss-Newton steps.
        """
        X_WN = self.body.poses(parameters)
        depth = view.camera.X_WC[:3, 2]
        centers = self._centers(X_WN[list(part.sources)], part.sources)
        depths = (centers - X_WN[part.nodes[0], :3, 3]) @ depth
        wanted, nodes = centers - 2.0 * np.outer(depths, depth), list(part.nodes)
        columns = np.concatenate([self._columns[node] for node in nodes])
        p_N = self._balls[nodes, :3]
        if part.exchanged:
            parameters = self._exchanged(parameters, part, wanted)
        moved = self._move_points(parameters, nodes, p_N, wanted, columns, (steps, 0.5, 1e-4))
        return self._restore(moved, X_WN, part.held)

    def _exchanged(self, parameters: np.ndarray, part: Part, wanted: np.ndarray) -> np.ndarray:
        """Return parameters (m + 4,) with a part's sides exchanged, and its first node turned.

        ``wanted``: (k, 3) wanted centres of the part's k nodes in the world [m]. The first node
        takes the sample that comes nearest to these.
        """
        moved, first = parameters.copy(), part.nodes[0]
        for node, source in zip(part.nodes[1:], part.sources[1:], strict=True):
            if node in self._signs:
                moved[self._columns[node]] = self._signs[node] * parameters[self._columns[source]]
        moved = np.clip(moved, self.body.lower, self.body.upper)
        X_WN, parent = self.body.poses(moved), self.body.tree.nodes[first].parent
        X_1W = np.linalg.inv(X_WN[first])
        p_1 = self._centers(X_WN[list(part.nodes)], part.nodes) @ X_1W[:3, :3].T + X_1W[:3, 3]
        tried = (np.eye(4) if parent < 0 else X_WN[parent]) @ self._X_PN[first]
        placed = np.einsum("nij,kj->nki", tried[:, :3, :3], p_1) + tried[:, None, :3, 3]
        nearest = np.argmin(np.square(placed - wanted).sum(axis=(1, 2)))
        moved[self._columns[first]] = self._grids[first][nearest]
        return moved

    def _restore(
        self, parameters: np.ndarray, X_WN: np.ndarray, nodes: Sequence[int]
    ) -> np.ndarray:
        """Return parameters (m + 4,) with ``nodes`` moved back to X_WN by their own values."""
        for node in nodes:
            radius = max(float(self._balls[node, 3]), 1e-6)
            p_N = radius * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
            wanted = p_N @ X_WN[node, :3, :3].T + X_WN[node, :3, 3]
            columns, points = self._columns[node], [node] * len(p_N)
            parameters = self._move_points(parameters, points, p_N, wanted, columns, (4, 1.0, 0.0))
        return parameters

    def _move_points(
        self,
        parameters: np.ndarray,
        nodes: Sequence[int],
        p_N: np.ndarray,
        wanted: np.ndarray,
        columns: np.ndarray,
        how: tuple[int, float, float],
    ) -> np.ndarray:
        """Return parameters (m + 4,) that bring points of nodes to wanted positions.

        They are found by Gauss-Newton steps.

        ``parameters``: (m + 4,) the start, as in ``RefinementBody``. ``nodes``: (n,) the node of
        each point. ``p_N``: (n, 3) the points in the nodes' frames [m]. ``wanted``: (n, 3) wanted
        positions in the world [m]. ``columns``: indices of the parameters that change. A step in
        which all change by less than 0.002 [rad or m] is the last. ``how``: number of steps,
        longest step [rad or m] and damping [m^2].
        """
        lower, upper = self.body.lower[columns], self.body.upper[columns]
        (steps, longest, damping), moved = how, parameters.copy()
        for _ in range(steps):
            placed = self.body.place(moved, bent=False)
            X = placed.X_WN[list(nodes)]
            p_W = np.einsum("kij,kj->ki", X[:, :3, :3], p_N) + X[:, :3, 3]
            # Jacobian of the points with respect to the parameters, (3 n, k).
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

    def _centers(self, X_WN: np.ndarray, nodes: Sequence[int]) -> np.ndarray:
        """Return centres (..., k, 3) of k nodes at X_WN (..., k, 4, 4), in the world [m]."""
        p_N = self._balls[list(nodes), :3]
        return np.asarray(np.einsum("...kij,kj->...ki", X_WN[..., :3, :3], p_N) + X_WN[..., :3, 3])


class NeighbourhoodSearch:
    """Searches around a pose for other placements of parts, and stores alternative poses.

    ``problem``: the silhouettes and the body. ``search``: the parts of the body. ``reflections``:
    whether, in a single view, parts are mirrored with left and right exchanged.
    """

    def __init__(
        self, problem: RefinementProblem, search: PartSearch, *, reflections: bool = True
    ) -> None:
        self.problem, self.search = problem, search
        # In several views a part mirrored in the depth of one is visible in another.
        mirrored = search.reflections if reflections and len(problem.views) == 1 else ()
        self._parts = (*search.parts, *mirrored)
        moved = [None if one.exchanged else (*one.nodes, *one.held) for one in self._parts]
        self._freedoms = [problem.body.freedom(nodes) for nodes in moved]
        self._sizes = np.array([len(part.nodes) for part in self._parts])
        # The error near each part after its last try, and the number of its tries.
        self._left_error = np.full(len(self._parts), np.inf)
        self._tried = np.zeros(len(self._parts), dtype=np.int64)
        # Alternative placements: J [pixel], the placed part's freedom, and its parameters.
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
        """Place parts of a refined pose anew while J decreases.

        Args:
            parameters: (m + 4,) the pose, as in ``RefinementBody``.
            enough: the search ends when J is at most this [pixel].
            deadline: time.perf_counter() at which the search ends [s].
            everywhere: whether each part is tried at least once, even without an error near it.
            tries: greatest number of tries; None: no limit.

        Returns parameters (m + 4,) of the best pose, and its J [pixel].
        """
        J, settings = float(self.problem.J(parameters)), self._settings
        rounds = settings.rounds * (2 if everywhere else 1)
        same = settings.least_decrease * self.problem.border_length
        least = settings.least_error * self.problem.area
        last = np.inf if tries is None else int(self._tried.sum()) + tries
        errors = self._errors_near(parameters, J)
        while J > enough and self._tried.sum() < last and time.perf_counter() < deadline:
            # A part is tried again only if the error near it has changed since its last try.
            due = ((errors >= least) | everywhere) & (self._tried < rounds)
            due &= np.abs(errors - self._left_error) > np.maximum(
                settings.same_error * errors, same
            )
            if not due.any():
                break
            # Half of the body is mirrored only after single parts.
            parts = len(self.search.parts)
            if due[:parts].any():
                due[parts:] = False
            chosen = int(np.argmax(np.where(due, errors / self._sizes, -1.0)))
            self._tried[chosen] += 1
            better, better_J = self._try(parameters, J, chosen, bool(errors[chosen] >= least))
            if better_J < J:
                parameters, J = better, better_J
                errors = self._errors_near(parameters, J)
            self._left_error[chosen] = errors[chosen]
        return parameters, J

    def consider(self, poses: Sequence[np.ndarray], J: float) -> None:
        """Store poses (m + 4,) that come near to ``J`` [pixel] as alternatives."""
        everything = self.problem.body.freedom()
        most = J + self._settings.first_excess * self.problem.border_length
        tried = [(float(self.problem.J(pose)), pose[everything.columns]) for pose in poses]
        self._others += [(cost, everything, values) for cost, values in tried if cost <= most]

    def others(self, parameters: np.ndarray, limit: float, same: float) -> list[np.ndarray]:
        """Return alternative poses with J up to a limit, refined to the end, best first.

        ``parameters``: (m + 4,) the best pose, as in ``RefinementBody``. ``limit``: greatest J
        [pixel]. ``same``: poses are equal if no parameter differs by more [rad or m].
        """
        problem, settings = self.problem, self._settings
        known, kept = [parameters], []
        spare = settings.alternative_excess * problem.border_length
        everything = problem.body.freedom()

        def is_known(pose: np.ndarray, poses: Sequence[np.ndarray]) -> bool:
            # Poses that differ by full turns are equal.
            gaps = [problem.body.nearest_turns(pose, other) - other for other in poses]
            return any(float(np.abs(gap).max()) <= same for gap in gaps)

        for _, freedom, values in sorted(self._others, key=lambda one: one[0]):
            start = parameters.copy()
            start[freedom.columns] = values
            if is_known(start, known):
                continue
            refined, _, _ = descend(problem, start, freedom, settings.final)
            J = float(problem.J(refined))
            if limit < J <= limit + spare and not is_known(refined, known):
                refined, _, _ = descend(problem, refined, everything, settings.final)
                J = float(problem.J(refined))
            if J <= limit and not is_known(refined, known):
                kept.append((J, refined))
                known.append(refined)
            known.append(start)
        kept.sort(key=lambda pair: pair[0])
        return [pose for _, pose in kept]

    def _errors_near(self, parameters: np.ndarray, J: float) -> np.ndarray:
        """Return (parts,) the mismatch [pixel] near each part, or ``J`` for reflections."""
        errors = self.search.errors_near(self.problem, parameters)
        return np.append(errors, np.full(len(self._parts) - len(errors), J))

    def _try(
        self, parameters: np.ndarray, J: float, chosen: int, erring: bool
    ) -> tuple[np.ndarray, float]:
        """Mirror a part, and place it anew, and store the alternatives that are nearly as good.

        ``parameters``: (m + 4,) the current pose, as in ``RefinementBody``. ``J``: its objective
        [pixel]. ``chosen``: index of the part. ``erring``: whether there is an error near the part;
        if not, the part is only mirrored.

        Returns the parameters of the best pose and its J [pixel]; the given parameters and infinity
        if J does not decrease by more than ``least_decrease``.
        """
        problem, length, settings = self.problem, self.problem.border_length, self._settings
        part, freedom = self._parts[chosen], self._freedoms[chosen]
        fixed_borders = problem.fixed_borders(parameters, freedom.moved)
        starts = [self.search.mirror(parameters, part, view) for view in problem.views]
        if erring and not part.exchanged:
            starts += self.search.propose(problem, parameters, part)
        rough, near = [], J + settings.noise * length
        for start in starts:
            if part.exchanged:
                refined, cost, _ = descend(problem, start, freedom, settings.mirrored)
                if near < cost <= J + settings.repaired_excess * length:
                    # Joint limits may prevent some nodes from being mirrored. They are placed anew,
                    # so that the mirrored body is not rejected because of them.
                    refined, _, _ = descend(problem, refined, freedom, settings.whole)
                    repair = NeighbourhoodSearch(problem, self.search, reflections=False)
                    refined, cost = repair.improve(refined, near, tries=settings.repair_tries)
            else:
                refined, cost, _ = descend(problem, start, freedom, settings.placed, fixed_borders)
            if cost <= J + settings.first_excess * length:
                rough.append((cost, refined))
        rough.sort(key=lambda pair: pair[0])
        found: list[tuple[float, np.ndarray]] = []
        for _, start in rough[: settings.refined]:
            refined, cost, _ = descend(problem, start, freedom, settings.second, fixed_borders)
            if cost <= near:
                refined, _, _ = descend(problem, refined, freedom, settings.fine, fixed_borders)
                found.append((float(problem.J(refined)), refined))
        columns = freedom.columns
        self._others += [
            (other_J, freedom, other[columns]) for other_J, other in found if other_J <= near
        ]
        least, best = min(found, key=lambda pair: pair[0], default=(np.inf, parameters))
        if least > J + settings.whole_excess * length:
            return parameters, np.inf
        whole, _, _ = descend(problem, best, problem.body.freedom(), settings.whole)
        whole_J = float(problem.J(whole))
        best, least = (whole, whole_J) if whole_J < least else (best, least)
        if least > J - settings.least_decrease * length:
            return parameters, np.inf
        self._others.append((J, freedom, parameters[columns]))
        return best, least
