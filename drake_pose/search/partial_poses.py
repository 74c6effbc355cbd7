"""Partial poses of the searches on a grid, and the one expansion: one more node is placed.

The poses that a node takes in one search are drawn once and shared by all hypotheses. What matters
of a partial pose for all that is still to come is what it covers, what it leaves outside, and the
poses of the nodes that have children to come. Partial poses equal in this are one; those are known
by sums of random numbers modulo 2^64 (``pair_kernel``).
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_pose.camera.models import ParallelCamera
from drake_pose.search.estimates import View
from drake_pose.search.pair_kernel import (
    Reaches,
    choose_pairs,
    hash_mask,
    random_keys,
    score_pairs,
    unite_poses,
)
from drake_pose.search.sampled_body import SampledBody
from drake_pose.search.settings import BoundLimits
from drake_pose.silhouette.bit_kernel import (
    WORD,
    BitView,
    draw_bits,
    draw_discs,
    make_bit_view,
    prune_by_balls,
)


class LimitReached(Exception):
    """Raised to leave a search that has no time or no room left."""


def coarsen(view: View, pixels: int) -> View:
    """The view at the whole fraction of its size that shows about this many silhouette pixels.

    A pixel is in the silhouette if at least half of those that it replaces are.
    """
    factor, camera = round(float(np.sqrt(view.mask.sum() / pixels))), view.camera
    if factor < 2:
        return view
    height, width = (-(-side // factor) for side in view.mask.shape)
    padded = np.zeros((height * factor, width * factor), dtype=np.uint8)
    padded[: view.mask.shape[0], : view.mask.shape[1]] = view.mask
    counts = padded.reshape(height, factor, width, factor).sum(axis=(1, 3), dtype=np.int64)
    parallel = isinstance(camera, ParallelCamera)
    scales = ("pixels_per_metre",) if parallel else ("focal_x", "focal_y")
    coarse: dict[str, Any] = {name: getattr(camera, name) / factor for name in scales}
    # Pixel centres are at integers.
    for name in ("center_x", "center_y"):
        coarse[name] = (getattr(camera, name) + 0.5) / factor - 0.5
    return View(replace(camera, width=width, height=height, **coarse), 2 * counts >= factor**2)


class Pictures:
    """The silhouettes of one instant as bits: parts of one long mask, silhouettes before bands.

    Attributes:
        has_bands: whether pixels outside the silhouettes have bits, too.
        coarse: whether surfaces of many triangles may be simplified.
        part_starts: (parts + 1,) where each part begins, and the mask's length [word].
        area: the silhouettes' area [pixel].
        everything: (w,) uint64 all pixels of the silhouettes.

    Args:
        band: distance from a silhouette up to which areas outside are a union, not a sum [pixel];
            0: none.
        in_full: never simplify a surface, so that areas are those of the definition.
    """

    def __init__(
        self, body: SampledBody, views: Sequence[View], band: int = 24, in_full: bool = False
    ) -> None:
        self.body, self.views = body, tuple(views)
        self.has_bands = band > 0
        self.coarse = self.has_bands and not in_full
        self.bit_views: list[BitView] = [
            make_bit_view(view.mask, view.camera.kernel_parameters(), view.camera.X_CW, band)
            for view in views
        ]
        pixels = [int(view.inside[-1, -1]) for view in self.bit_views]
        self.area = float(sum(pixels))
        # In as many words as each part has.
        ones = [np.arange((count // WORD + 1) * WORD) < count for count in pixels]
        self.everything = np.packbits(np.concatenate(ones), bitorder="little").view(np.uint64)
        if self.has_bands:
            pixels += [int(view.band[-1, -1]) for view in self.bit_views]
        self.part_starts = np.concatenate([[0], np.cumsum([n // WORD + 1 for n in pixels])])

    def draw_node(
        self, node: int, samples: np.ndarray, X_WN: np.ndarray, masks: np.ndarray
    ) -> np.ndarray:
        """Add a node's pictures at samples (n,), poses X_WN (n, 4, 4), to masks (n, W) uint64.

        Returns:
            (n, 3) int64 areas in the silhouettes, the bands, which there must be, and beyond.
        """
        starts, views = self.part_starts, len(self.views)
        total = np.zeros((len(X_WN), 3), dtype=np.int64)
        pairs = np.column_stack([np.arange(len(X_WN)), samples]).astype(np.int32)
        in_place = np.tile(np.eye(4), (len(self.body.sampled.values[node]), 1, 1))
        for index, view in enumerate(self.bit_views):
            celled = self.body.celled_outline(node, self.views[index].camera, self.coarse)
            _, areas, runs, words = draw_bits(celled, view, X_WN, in_place, pairs, np.inf)
            runs[:, :, 0] += np.array([starts[index], starts[views + index]])
            unite_poses(masks, np.arange(len(masks)), runs, words)
            total += areas
        return total


class RowTable:
    """Rows of numbers (k,) by index, made where they are first asked for."""

    def __init__(self, width: int) -> None:
        self.rows = np.zeros((0, width), dtype=np.int64)
        self._made = np.zeros(0, dtype=np.bool_)

    def missing(self, indices: np.ndarray) -> np.ndarray:
        """Of indices those, each once, whose rows are not made; they count as made from now."""
        size = int(indices.max(initial=0)) + 1
        if len(self.rows) < size:
            more = np.zeros((size - len(self.rows) + 64, self.rows.shape[1]), dtype=np.int64)
            self.rows = np.concatenate([self.rows, more])
            self._made = np.concatenate([self._made, np.zeros(len(more), dtype=np.bool_)])
        if self._made[indices].all():
            return np.zeros(0, dtype=np.int64)
        wanted = np.zeros_like(self._made)
        wanted[indices] = True
        return np.flatnonzero(wanted & ~self._made)

    def make(self, indices: np.ndarray, rows: np.ndarray) -> None:
        """Take in rows (n, k)."""
        self.rows[indices], self._made[indices] = rows, True


@dataclass
class _Poses:
    """Poses of one node: arrays that grow by whole groups."""

    samples: np.ndarray
    X_WN: np.ndarray
    areas: np.ndarray
    runs: np.ndarray
    words: np.ndarray


@dataclass(frozen=True)
class PartialPoses:
    """Poses of the same nodes.

    Attributes:
        masks: (B, W) uint64 the pixels covered.
        poses: (B, nodes) int32 the pose of each node in the PoseStore; -1: not placed.
        hashes: (B,) uint64 of the masks.
        covered: (B,) int64 the silhouettes' area covered [pixel].
        outside: (B,) int64 the area outside [pixel]; beyond the bands a sum over the nodes.
        far: (B, 2) int64 the greatest and the summed area of a node beyond the bands [pixel].
        lost: (B,) int64 the silhouettes' area that no later node can reach [pixel].
    """

    masks: np.ndarray
    poses: np.ndarray
    hashes: np.ndarray
    covered: np.ndarray
    outside: np.ndarray
    far: np.ndarray
    lost: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)

    def chosen(self, kept: np.ndarray) -> "PartialPoses":
        """Some of them, by their indices or by (B,) bool."""
        return PartialPoses(*[array[kept] for array in vars(self).values()])

    @property
    def least_outside(self) -> np.ndarray:
        """(B,) int64 no completion leaves a smaller area outside [pixel]."""
        return np.asarray(self.outside - self.far[:, 1] + self.far[:, 0])

    @property
    def bounds(self) -> np.ndarray:
        """(B,) int64 no completion has a smaller objective [pixel]."""
        return np.asarray(self.least_outside + self.lost)

    def costs(self, outside_weight: int) -> np.ndarray:
        """(B,) int64 to rank by: what is covered already counts one a pixel."""
        return np.asarray(outside_weight * (self.outside + self.lost) - self.covered)


class PoseStore:
    """All poses of nodes whose area outside is within a limit, and what they make together.

    The one expansion of all searches: it places nodes in partial poses.

    Args:
        outside_share: of a node's mean projected area.
        outside_limit: instead of a share of it, this area [pixel].
        limits: on what is drawn; methods raise LimitReached where one is reached. None: none.
    """

    def __init__(
        self,
        body: SampledBody,
        pictures: Pictures,
        outside_share: float = np.inf,
        outside_limit: float | None = None,
        limits: BoundLimits | None = None,
    ) -> None:
        self.body, self.pictures, self.limits = body, pictures, limits
        self.tree_nodes = body.sampled.tree.nodes
        self.deadline = np.inf if limits is None else limits.deadline
        self._outside_share, self._outside_limit = outside_share, outside_limit
        self._reserved = 0
        parts = len(pictures.part_starts) - 1
        self.nodes = [
            _Poses(
                np.empty(0, dtype=np.int32),
                np.empty((0, 4, 4)),
                np.empty((0, 3), dtype=np.int32),
                np.empty((0, parts, 3), dtype=np.int64),
                np.empty(0, dtype=np.uint64),
            )
            for _ in self.tree_nodes
        ]
        # For each node and pose of its parent: where its poses begin and end; and what it reaches.
        self._groups = [RowTable(2) for _ in self.nodes]
        self._reach_rows = [RowTable(1) for _ in self.nodes]
        self.reach_runs = np.empty((0, len(pictures.views), 3), dtype=np.int64)
        self.reach_words = np.empty(0, dtype=np.uint64)
        self.words = int(pictures.part_starts[-1])
        keys = random_keys(2 * self.words + len(self.nodes) + 2)
        self._mask_keys = keys[: 2 * self.words]
        self._node_keys = keys[2 * self.words : -2]
        self._far_keys = keys[-2:]

    def reserve(self, size: int = 0) -> None:
        """Notes memory [byte]; raises LimitReached where it is too much, or the time is over."""
        self._reserved += size
        if self.limits is None:
            return
        used = self.reach_runs.nbytes + self.reach_words.nbytes + self._reserved
        used += sum(array.nbytes for poses in self.nodes for array in vars(poses).values())
        drawn = sum(len(poses.samples) for poses in self.nodes)
        late = time.perf_counter() >= self.deadline
        if late or used > self.limits.memory or drawn > self.limits.poses:
            raise LimitReached

    def _in_turn(self, missing: np.ndarray, together: int) -> Iterator[np.ndarray]:
        """Poses (n,) of a parent, ``together`` at a time, within the limits."""
        for begin in range(0, len(missing), together):
            self.reserve()
            yield missing[begin : begin + together]

    def pose_groups(self, node: int, parents: np.ndarray, together: int = 100_000) -> np.ndarray:
        """Where the node's poses, drawn where missing, begin and end (n, 2) by parent (n,).

        ``together``: the number tried before the limits are looked at again.
        """
        known = self._groups[node]
        together = max(1, together // len(self.body.sampled.X_PN[node]))
        for missing in self._in_turn(known.missing(parents), together):
            counts = self._draw(node, missing)
            ends = len(self.nodes[node].samples) - counts.sum() + np.cumsum(counts)
            known.make(missing, np.column_stack([ends - counts, ends]))
        return known.rows[parents]

    def samples(self, poses: np.ndarray) -> np.ndarray:
        """The samples (..., nodes) that the nodes take at poses (..., nodes)."""
        return np.stack(
            [stored.samples[poses[..., i]] for i, stored in enumerate(self.nodes)], axis=-1
        )

    def reach_rows(self, node: int, parents: np.ndarray, together: int = 20_000) -> np.ndarray:
        """For poses (n,) of the node's parent the rows of ``reach_runs`` of what it can reach.

        ``together``: the number drawn before the limits are looked at again.
        """
        known, views = self._reach_rows[node], self.pictures.bit_views
        ball = self.body.reach_balls[node]
        for missing in self._in_turn(known.missing(parents), together):
            runs = np.empty((len(missing), len(views), 3), dtype=np.int64)
            used, pieces = len(self.reach_words), [self.reach_words]
            X_WP = self._parent_poses(node, missing)
            for index, view in enumerate(views):
                view_runs, words = draw_discs(view, X_WP, ball[:3], ball[3])
                runs[:, index] = view_runs + np.array([self.pictures.part_starts[index], 0, used])
                used += len(words)
                pieces.append(words)
            known.make(missing, len(self.reach_runs) + np.arange(len(missing))[:, None])
            self.reach_runs = np.concatenate([self.reach_runs, runs])
            self.reach_words = np.concatenate(pieces)
        return known.rows[parents, 0]

    def parents(self, poses: np.ndarray, node: int) -> np.ndarray:
        """The poses (B,) of a node's parent among poses (B, nodes); 0 for a root."""
        parent = self.tree_nodes[node].parent
        if parent < 0:
            return np.zeros(len(poses), dtype=np.int32)
        return np.asarray(poses[:, parent])

    def _parent_poses(self, node: int, parents: np.ndarray) -> np.ndarray:
        """X_WP (n, 4, 4) of poses (n,) of the node's parent."""
        parent = self.tree_nodes[node].parent
        return np.eye(4)[None] if parent < 0 else self.nodes[parent].X_WN[parents]

    def _draw(self, node: int, parents: np.ndarray) -> np.ndarray:
        """Draw the node for poses of its parent; returns how many poses each adds."""
        X_WP = self._parent_poses(node, parents)
        X_PN = self.body.sampled.X_PN[node]
        pairs = np.empty((len(X_WP) * len(X_PN), 2), dtype=np.int32)
        pairs[:, 0] = np.repeat(np.arange(len(X_WP)), len(X_PN))
        pairs[:, 1] = np.tile(np.arange(len(X_PN)), len(X_WP))
        if self.body.sampled.tree.source(node) != node:
            taken = self.nodes[self.tree_nodes[node].parent].samples[parents]
            pairs = pairs[pairs[:, 1] == taken[pairs[:, 0]]]
        views = self.pictures.bit_views
        # The area that may lie outside the silhouettes in all views together [pixel].
        limit = self._outside_share if self._outside_limit is None else self._outside_limit
        if self._outside_limit is None and 0.0 < limit < np.inf:
            areas = [self.body.mean_area(node, view.camera) for view in self.pictures.views]
            limit *= sum(areas)
        for view in views:
            left = prune_by_balls(
                view, X_WP, self.body.p_PB[node], self.body.ball_radii[node], pairs, limit
            )
            pairs = pairs[left]
        drawn: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for index, view in enumerate(views):
            celled = self.body.celled_outline(
                node, self.pictures.views[index].camera, self.pictures.coarse
            )
            kept, view_areas, view_runs, words = draw_bits(celled, view, X_WP, X_PN, pairs, limit)
            pairs = pairs[kept]
            drawn = [(a[kept], r[kept], w) for a, r, w in drawn] + [(view_areas, view_runs, words)]
        if len(views) > 1:
            kept = sum(one[:, 1:].sum(axis=1) for one, _, _ in drawn) <= limit
            pairs = pairs[kept]
            drawn = [(a[kept], r[kept], w) for a, r, w in drawn]
        poses, starts = self.nodes[node], self.pictures.part_starts
        runs = np.empty((len(pairs), len(starts) - 1, 3), dtype=np.int64)
        total = np.zeros((len(pairs), 3), dtype=np.int32)
        used = len(poses.words)
        for index, (view_areas, view_runs, words) in enumerate(drawn):
            total += view_areas
            for kind, part in enumerate(range(index, len(starts) - 1, len(drawn))):
                runs[:, part] = view_runs[:, kind] + np.array([starts[part], 0, used])
            used += len(words)
        poses.samples = np.concatenate([poses.samples, pairs[:, 1]])
        poses.X_WN = np.concatenate([poses.X_WN, X_WP[pairs[:, 0]] @ X_PN[pairs[:, 1]]])
        poses.areas = np.concatenate([poses.areas, total])
        poses.runs = np.concatenate([poses.runs, runs])
        poses.words = np.concatenate([poses.words, *(words for _, _, words in drawn)])
        return np.bincount(pairs[:, 0], minlength=len(X_WP))

    def start(self) -> PartialPoses:
        """The partial pose that has placed nothing."""
        zero = np.zeros(1, dtype=np.int64)
        return PartialPoses(
            np.zeros((1, self.words), dtype=np.uint64),
            np.full((1, len(self.nodes)), -1, dtype=np.int32),
            np.zeros(1, dtype=np.uint64),
            zero, zero.copy(), np.zeros((1, 2), dtype=np.int64), zero.copy(),
        )  # fmt: skip

    def without(self, poses: np.ndarray, nodes: frozenset[int]) -> PartialPoses:
        """One with poses (nodes,) but of some nodes, given with all their descendants."""
        start = self.start()
        start.poses[0] = poses
        start.poses[0, list(nodes)] = -1
        for node in np.flatnonzero(start.poses[0] >= 0):
            stored, pose = self.nodes[node], start.poses[0, node : node + 1]
            unite_poses(start.masks, pose, stored.runs, stored.words)
            start.outside[0] += int(stored.areas[pose[0], 2])
        silhouettes = int(self.pictures.part_starts[len(self.pictures.views)])
        ones = np.bitwise_count(start.masks[0])
        start.covered[0] = ones[:silhouettes].sum()
        start.outside[0] += ones[silhouettes:].sum()
        start.hashes[0] = hash_mask(start.masks[0], self._mask_keys)
        return start

    def objectives(self, whole: PartialPoses) -> np.ndarray:
        """(B,) what the objective of whole poses is, as far as the pictures show [pixel]."""
        return np.asarray(self.pictures.area - whole.covered + whole.outside)

    def groups(self, partial: PartialPoses, node: int) -> np.ndarray:
        """Where the node's poses begin and end (B, 2) that each may take."""
        if len(partial) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        return self.pose_groups(node, self.parents(partial.poses, node))

    def pairs(self, partial: PartialPoses, node: int) -> np.ndarray:
        """(p, 2) int32 each partial pose with each pose that it may take."""
        groups = self.groups(partial, node)
        return np.column_stack(expand_groups(groups[:, 0], groups[:, 1])).astype(np.int32)

    def score(
        self, partial: PartialPoses, node: int, pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Areas newly covered (p, 2) of silhouette and band [pixel], and what hashes gain (p,)."""
        stored, views = self.nodes[node], len(self.pictures.views)
        return score_pairs(partial.masks, pairs, stored.runs, stored.words, views, self._mask_keys)

    def make(
        self,
        partial: PartialPoses,
        node: int,
        pairs: np.ndarray,
        scores: tuple[np.ndarray, np.ndarray],
    ) -> PartialPoses:
        """What pairs (p, 2), scored, make, without their masks; ``lost`` is not known."""
        areas, added = scores
        origins, beyond = pairs[:, 0], self.nodes[node].areas[pairs[:, 1], 2]
        poses = partial.poses[origins]
        poses[:, node] = pairs[:, 1]
        far = partial.far[origins]
        np.maximum(far[:, 0], beyond, out=far[:, 0])
        far[:, 1] += beyond
        return PartialPoses(
            masks=np.zeros((len(pairs), 0), dtype=np.uint64),
            poses=poses,
            hashes=partial.hashes[origins] + added,
            covered=partial.covered[origins] + areas[:, 0],
            outside=partial.outside[origins] + areas[:, 1] + beyond,
            far=far,
            lost=np.zeros(len(pairs), dtype=np.int64),
        )

    def choose(
        self,
        partial: PartialPoses,
        made: PartialPoses,
        node: int,
        pairs: np.ndarray,
        width: int,
        limit: float = np.inf,
        far_matters: bool = False,
    ) -> tuple[np.ndarray, PartialPoses, np.ndarray]:
        """The first of what pairs (p, 2) made that are not equal, at most ``width``.

        Args:
            limit: where it is finite, the greatest sum of what is outside and what no later node
                can reach [pixel]; and where the nodes with children to come stand alike, none is
                chosen that covers less than another.
            far_matters: those are not equal that differ beyond the bands.

        Returns:
            Their indices; themselves, without masks; of each pair looked at the place among
                them, or -1.
        """
        placed = np.flatnonzero(partial.poses[0] >= 0).tolist() if len(partial) else ()
        is_open, waiting = self.body.frontier(frozenset((*placed, node)))
        openings = made.poses[:, is_open].astype(np.uint64) @ self._node_keys[is_open]
        codes = made.hashes + openings
        if far_matters:
            codes += made.far.astype(np.uint64) @ self._far_keys
        # What later nodes can reach.
        rows = np.empty((len(waiting), len(pairs)), dtype=np.int64)
        for i, other in enumerate(waiting if len(pairs) else ()):
            own = self.tree_nodes[other].parent == node
            parents = pairs[:, 1] if own else self.parents(partial.poses, other)[pairs[:, 0]]
            rows[i] = self.reach_rows(other, parents)
        stored = self.nodes[node]
        chosen, lost, places = choose_pairs(
            partial.masks, pairs, stored.runs, stored.words, self.pictures.everything,
            Reaches(self.reach_runs, self.reach_words, rows), width, codes,
            openings if limit < np.inf else openings[:0], made.least_outside, limit,
        )  # fmt: skip
        return chosen, replace(made.chosen(chosen), lost=lost), places

    def with_masks(
        self, partial: PartialPoses, made: PartialPoses, node: int, pairs: np.ndarray
    ) -> PartialPoses:
        """What pairs made, with the masks."""
        masks, stored = partial.masks[pairs[:, 0]], self.nodes[node]
        unite_poses(masks, pairs[:, 1], stored.runs, stored.words)
        return replace(made, masks=masks)


def expand_groups(begins: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The places of groups, given by where they begin and end (n,), and before them the groups."""
    counts = ends - begins
    groups = np.repeat(np.arange(len(counts)), counts)
    return groups, np.arange(len(groups)) + (begins - np.cumsum(counts) + counts)[groups]
