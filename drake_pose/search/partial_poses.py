"""Store the partial poses of the searches on grids, and extend them by one node.

Each pose of a node is drawn once per search, as a bit mask, and shared by all hypotheses. The
further course of the search depends only on the pixels that a partial pose covers, its area outside
the silhouettes, and the poses of the nodes with children still to be placed. Partial poses that are
equal in these are merged; they are recognised by hashes (``pair_kernel``).
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SettingsError, require_at_least
from drake_pose.search.estimates import View
from drake_pose.search.pair_kernel import (
    ReachablePixels,
    choose_pairs,
    hash_mask,
    random_keys,
    score_pairs,
    unite_poses,
)
from drake_pose.search.sampled_body import SampledBody
from drake_pose.silhouette.bit_kernel import (
    WORD,
    BitView,
    draw_bits,
    draw_discs,
    make_bit_view,
    prune_by_balls,
)


@dataclass(frozen=True)
class BoundLimits:
    """Limits of a branch and bound.

    Raises:
        SettingsError: if a value is out of its range.
    """

    states: int = 40_000  # Greatest number of partial poses kept after each node.
    # Greatest number of pairs of a partial pose and a pose of the next node that are evaluated for
    # one node.
    pairs: int = 1_500_000
    poses: int = 1_000_000  # Number of drawn poses of nodes after which the search stops.
    # The search stops before the drawn poses and the areas that they reach take more than this, and
    # it keeps fewer partial poses if all would take more than a quarter of this [byte]. Temporary
    # arrays take about as much again.
    memory: int = 400_000_000
    time_limit: float | None = None  # Time after which the search stops [s]; None: no limit.

    def __post_init__(self) -> None:
        sizes = {"states": self.states, "pairs": self.pairs, "poses": self.poses}
        require_at_least(1, **sizes, memory=self.memory)
        if self.time_limit is not None and not 0.0 <= self.time_limit < math.inf:
            raise SettingsError(f"time_limit must be 0 s or more, not {self.time_limit}")

    @property
    def deadline(self) -> float:
        """The time.perf_counter() at which a search that starts now must stop [s]."""
        return math.inf if self.time_limit is None else time.perf_counter() + self.time_limit


class LimitReached(Exception):
    """Raised when a search has reached its limit of time, memory or drawn poses."""


def coarsen(view: View, pixels: int) -> View:
    """Return the view, reduced by an integer factor to a silhouette of about ``pixels`` pixels.

    A pixel belongs to the silhouette if at least half of the pixels that it replaces do. A view for
    which the factor would be 1 is returned unchanged.
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


class SilhouetteBits:
    """The silhouettes of one frame, and bands around them, as parts of one bit mask.

    A mask is W words of 64 bits, one bit for each pixel. Its parts are the silhouettes of all
    views, and after them their bands, if there are any. In the silhouettes and bands the area of
    several nodes is that of their union; beyond the bands areas of nodes are added.

    Attributes:
        has_bands: whether there are bands.
        coarse: whether surfaces of many triangles may be simplified.
        part_starts: (parts + 1,) first word of each part, and the number of words of the mask.
        area: total area of the silhouettes [pixel].
        all_pixels: (w,) uint64 bit mask of all pixels of the silhouettes.

    Args:
        body: the body that is drawn.
        views: the silhouettes, one per camera.
        band: width of the bands [pixel]; 0: no bands.
        in_full: whether surfaces are never simplified, so that areas are exact.
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
        # Each silhouette fills its words from the first bit; the remaining bits are zero.
        ones = [np.arange((count // WORD + 1) * WORD) < count for count in pixels]
        self.all_pixels = np.packbits(np.concatenate(ones), bitorder="little").view(np.uint64)
        if self.has_bands:
            pixels += [int(view.margin[-1, -1]) for view in self.bit_views]
        self.part_starts = np.concatenate([[0], np.cumsum([n // WORD + 1 for n in pixels])])

    def draw_node(
        self, node: int, samples: np.ndarray, X_WN: np.ndarray, masks: np.ndarray
    ) -> np.ndarray:
        """Draw a node at n poses into masks (n, W) uint64, which are changed in place.

        There must be bands.

        Args:
            node: index of the node.
            samples: (n,) its samples.
            X_WN: (n, 4, 4) its poses at these samples.
            masks: (n, W) bit masks to which the node's pixels are added.

        Returns:
            (n, 3) int64 the node's area in the silhouettes, in the bands and beyond them [pixel].
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
    """A table of rows of ``width`` integers that are computed when they are first needed."""

    def __init__(self, width: int) -> None:
        self.rows = np.zeros((0, width), dtype=np.int64)
        self._made = np.zeros(0, dtype=np.bool_)

    def missing(self, indices: np.ndarray) -> np.ndarray:
        """Return the distinct indices whose rows ``make`` must store; the table grows by them."""
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
        """Store rows (n, k) at indices (n,)."""
        self.rows[indices], self._made[indices] = rows, True


@dataclass
class _Poses:
    """Drawn poses of one node, in groups with the same pose of the parent."""

    samples: np.ndarray  # (n,) int32 the node's sample at each pose.
    X_WN: np.ndarray  # (n, 4, 4) the poses in the world.
    areas: np.ndarray  # (n, 3) int32 area in the silhouettes, in the bands and beyond [pixel].
    # runs, words: bit masks of the poses, as in ``score_pairs``.
    runs: np.ndarray
    words: np.ndarray


@dataclass(frozen=True)
class PartialPoses:
    """B partial poses in which the same nodes are placed."""

    masks: np.ndarray  # (B, W) uint64 bit masks of the covered pixels.
    # (B, nodes) int32 index of each node's pose in the PoseStore; -1: not placed.
    poses: np.ndarray
    hashes: np.ndarray  # (B,) uint64 hashes of the masks.
    covered: np.ndarray  # (B,) int64 covered area of the silhouettes [pixel].
    # (B,) int64 area outside the silhouettes, beyond the bands a sum over nodes [pixel].
    outside: np.ndarray
    # (B, 2) int64 greatest and summed area of the nodes beyond the bands [pixel].
    beyond: np.ndarray
    # (B,) int64 area of the silhouettes that no later node can cover [pixel].
    unreachable: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)

    def chosen(self, kept: np.ndarray) -> "PartialPoses":
        """Return the partial poses chosen by indices (n,) or by (B,) bool."""
        return PartialPoses(*[array[kept] for array in vars(self).values()])

    @property
    def least_outside(self) -> np.ndarray:
        """(B,) int64 lower bound of the area outside of all completions [pixel]."""
        return np.asarray(self.outside - self.beyond[:, 1] + self.beyond[:, 0])

    @property
    def bounds(self) -> np.ndarray:
        """(B,) float64 lower bound of the objective of all completions [pixel]."""
        return np.asarray(self.least_outside + self.unreachable, dtype=np.float64)

    def costs(self, outside_weight: int) -> np.ndarray:
        """Return (B,) int64 the costs by which partial poses are ranked [pixel].

        ``outside_weight``: cost of a pixel outside or unreachable; a covered pixel gains one.
        """
        return np.asarray(outside_weight * (self.outside + self.unreachable) - self.covered)


class PoseStore:
    """The poses of nodes whose area outside is within a limit, drawn when first needed.

    A pose of a node is given by its index in the store. The methods ``pairs``, ``score``, ``place``
    and ``with_masks``, in this order, place one node in partial poses.

    Attributes:
        nodes: for each node its drawn poses.
        reach_runs, reach_words: reachable pixels, as in ``ReachablePixels``.
        words: number of words W of a bit mask.

    Args:
        body: the body that is searched.
        bits: the silhouettes.
        outside_fraction: greatest area of a node outside the silhouettes, all views together, as a
            fraction of its mean projected area.
        outside_limit: the same area [pixel]; it replaces the fraction. None: the fraction holds.
        limits: limits of time, memory and drawn poses; None: no limits. The methods that draw raise
            LimitReached when one is reached.
    """

    def __init__(
        self,
        body: SampledBody,
        bits: SilhouetteBits,
        outside_fraction: float = np.inf,
        outside_limit: float | None = None,
        limits: BoundLimits | None = None,
    ) -> None:
        self.body, self.bits, self.limits = body, bits, limits
        self.tree_nodes = body.sampled.tree.nodes
        self.deadline = np.inf if limits is None else limits.deadline
        self._outside_fraction, self._outside_limit = outside_fraction, outside_limit
        self._reserved = 0
        parts = len(bits.part_starts) - 1
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
        # For each node and pose of its parent: first and end of the node's poses; and the row of
        # ``reach_runs`` with the pixels that the node and its descendants can reach.
        self._groups = [RowTable(2) for _ in self.nodes]
        self._reach_rows = [RowTable(1) for _ in self.nodes]
        self.reach_runs = np.empty((0, len(bits.views), 3), dtype=np.int64)
        self.reach_words = np.empty(0, dtype=np.uint64)
        self.words = int(bits.part_starts[-1])
        keys = random_keys(2 * self.words + len(self.nodes) + 2)
        self._mask_keys = keys[: 2 * self.words]
        self._node_keys = keys[2 * self.words : -2]
        self._beyond_keys = keys[-2:]

    def reserve(self, size: int) -> None:
        """Add ``size`` [byte] to the memory in use, and check the limits.

        Raises LimitReached: if memory, time or the number of drawn poses exceeds its limit.
        """
        self._reserved += size
        if self.limits is None:
            return
        used = self.reach_runs.nbytes + self.reach_words.nbytes + self._reserved
        used += sum(array.nbytes for poses in self.nodes for array in vars(poses).values())
        drawn = sum(len(poses.samples) for poses in self.nodes)
        late = time.perf_counter() >= self.deadline
        if late or used > self.limits.memory or drawn > self.limits.poses:
            raise LimitReached

    def _batches(
        self, missing: np.ndarray, samples: int, most: int = 100_000
    ) -> Iterator[np.ndarray]:
        """Yield ``missing`` poses (n,) of a parent in parts, until LimitReached.

        ``samples``: number of poses drawn for each. ``most``: number drawn between checks.
        """
        batch = max(1, most // samples)
        for begin in range(0, len(missing), batch):
            self.reserve(0)
            yield missing[begin : begin + batch]

    def pose_groups(self, node: int, parents: np.ndarray) -> np.ndarray:
        """Return (n, 2) the range [first, end) of the node's poses for each pose of its parent.

        Missing ones are drawn. ``parents``: (n,); zeros: a root.
        """
        known, samples = self._groups[node], len(self.body.sampled.X_PN[node])
        for missing in self._batches(known.missing(parents), samples):
            counts = self._draw(node, missing)
            ends = len(self.nodes[node].samples) - counts.sum() + np.cumsum(counts)
            known.make(missing, np.column_stack([ends - counts, ends]))
        return known.rows[parents]

    def samples(self, poses: np.ndarray) -> np.ndarray:
        """Return the samples (..., nodes) of the nodes' poses (..., nodes)."""
        return np.stack(
            [stored.samples[poses[..., i]] for i, stored in enumerate(self.nodes)], axis=-1
        )

    def reach_rows(self, node: int, parents: np.ndarray) -> np.ndarray:
        """Return (n,) rows of ``reach_runs`` of a node, for poses ``parents`` (n,) of its parent.

        A row has the pixels in the projection of a ball that contains the node and its descendants
        at all samples.
        """
        known, views = self._reach_rows[node], self.bits.bit_views
        ball = self.body.reach_balls[node]
        for missing in self._batches(known.missing(parents), 1):
            runs = np.empty((len(missing), len(views), 3), dtype=np.int64)
            used, pieces = len(self.reach_words), [self.reach_words]
            X_WP = self._parent_poses(node, missing)
            for index, view in enumerate(views):
                view_runs, words = draw_discs(view, X_WP, ball[:3], ball[3])
                runs[:, index] = view_runs + np.array([self.bits.part_starts[index], 0, used])
                used += len(words)
                pieces.append(words)
            known.make(missing, len(self.reach_runs) + np.arange(len(missing))[:, None])
            self.reach_runs = np.concatenate([self.reach_runs, runs])
            self.reach_words = np.concatenate(pieces)
        return known.rows[parents, 0]

    def parents(self, poses: np.ndarray, node: int) -> np.ndarray:
        """Return (B,) the poses of a node's parent, from poses (B, nodes); 0 for a root."""
        parent = self.tree_nodes[node].parent
        if parent < 0:
            return np.zeros(len(poses), dtype=np.int32)
        return np.asarray(poses[:, parent])

    def _parent_poses(self, node: int, parents: np.ndarray) -> np.ndarray:
        """Return X_WP (n, 4, 4) of poses (n,) of the node's parent; a root's: (1, 4, 4), I."""
        parent = self.tree_nodes[node].parent
        return np.eye(4)[None] if parent < 0 else self.nodes[parent].X_WN[parents]

    def _draw(self, node: int, parents: np.ndarray) -> np.ndarray:
        """Draw the node at all samples for poses ``parents`` (n,) of its parent, and store it.

        Returns:
            (n,) number of the node's poses within the limit of the area outside, for each parent.
        """
        X_WP = self._parent_poses(node, parents)
        X_PN = self.body.sampled.X_PN[node]
        pairs = np.empty((len(X_WP) * len(X_PN), 2), dtype=np.int32)
        pairs[:, 0] = np.repeat(np.arange(len(X_WP)), len(X_PN))
        pairs[:, 1] = np.tile(np.arange(len(X_PN)), len(X_WP))
        if self.body.sampled.tree.source(node) != node:
            taken = self.nodes[self.tree_nodes[node].parent].samples[parents]
            pairs = pairs[pairs[:, 1] == taken[pairs[:, 0]]]
        views = self.bits.bit_views
        # Greatest area outside the silhouettes in all views together [pixel].
        limit = self._outside_fraction if self._outside_limit is None else self._outside_limit
        if self._outside_limit is None and 0.0 < limit < np.inf:
            areas = [self.body.mean_area(node, view.camera) for view in self.bits.views]
            limit *= sum(areas)
        for view in views:
            left = prune_by_balls(
                view, X_WP, self.body.p_PB[node], self.body.ball_radii[node], pairs, limit
            )
            pairs = pairs[left]
        drawn: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for index, view in enumerate(views):
            celled = self.body.celled_outline(node, self.bits.views[index].camera, self.bits.coarse)
            kept, view_areas, view_runs, words = draw_bits(celled, view, X_WP, X_PN, pairs, limit)
            pairs = pairs[kept]
            drawn = [(a[kept], r[kept], w) for a, r, w in drawn] + [(view_areas, view_runs, words)]
        if len(views) > 1:
            kept = sum(one[:, 1:].sum(axis=1) for one, _, _ in drawn) <= limit
            pairs = pairs[kept]
            drawn = [(a[kept], r[kept], w) for a, r, w in drawn]
        poses, starts = self.nodes[node], self.bits.part_starts
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
        """Return the one partial pose in which no node is placed."""
        zero = np.zeros(1, dtype=np.int64)
        return PartialPoses(
            np.zeros((1, self.words), dtype=np.uint64),
            np.full((1, len(self.nodes)), -1, dtype=np.int32),
            np.zeros(1, dtype=np.uint64),
            zero, zero.copy(), np.zeros((1, 2), dtype=np.int64), zero.copy(),
        )  # fmt: skip

    def without(self, poses: np.ndarray, nodes: frozenset[int]) -> PartialPoses:
        """Return the partial pose with poses (nodes,) from which some nodes are removed.

        Its areas ``beyond`` and ``unreachable`` are 0.

        ``poses``: (nodes,) index of each node's pose in the store; -1: not placed. ``nodes``: the
        nodes that are removed, with all their descendants.
        """
        start = self.start()
        start.poses[0] = poses
        start.poses[0, list(nodes)] = -1
        for node in np.flatnonzero(start.poses[0] >= 0):
            stored, pose = self.nodes[node], start.poses[0, node : node + 1]
            unite_poses(start.masks, pose, stored.runs, stored.words)
            start.outside[0] += int(stored.areas[pose[0], 2])
        silhouettes = int(self.bits.part_starts[len(self.bits.views)])
        ones = np.bitwise_count(start.masks[0])
        start.covered[0] = ones[:silhouettes].sum()
        start.outside[0] += ones[silhouettes:].sum()
        start.hashes[0] = hash_mask(start.masks[0], self._mask_keys)
        return start

    def objectives(self, whole: PartialPoses) -> np.ndarray:
        """Return (B,) the objective of whole poses at the resolution of the bit masks [pixel]."""
        return np.asarray(self.bits.area - whole.covered + whole.outside)

    def groups(self, partial: PartialPoses, node: int) -> np.ndarray:
        """Return (B, 2) the range [first, end) of the node's poses for each of B partial poses."""
        if len(partial) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        return self.pose_groups(node, self.parents(partial.poses, node))

    def pairs(self, partial: PartialPoses, node: int) -> np.ndarray:
        """Return (p, 2) int32 pairs of each partial pose and each pose that the node can take.

        A pair is the index of the partial pose, and the index of the node's pose in the store.
        """
        groups = self.groups(partial, node)
        return np.column_stack(expand_groups(groups[:, 0], groups[:, 1])).astype(np.int32)

    def score(
        self, partial: PartialPoses, node: int, pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the areas added by pairs (p, 2) (see ``pairs``) of partial pose and node's pose.

        Returns (p, 2) newly covered area of silhouettes and of bands [pixel]; (p,) uint64 the
        increase of the hash.
        """
        stored, views = self.nodes[node], len(self.bits.views)
        return score_pairs(partial.masks, pairs, stored.runs, stored.words, views, self._mask_keys)

    def place(
        self,
        partial: PartialPoses,
        node: int,
        pairs: np.ndarray,
        scores: tuple[np.ndarray, np.ndarray],
        width: int,
        keep_beyond: bool = False,
    ) -> tuple[np.ndarray, PartialPoses, np.ndarray]:
        """Place a node at pairs, and choose the first distinct partial poses.

        Args:
            partial: the partial poses before the node is placed.
            node: index of the node.
            pairs: (p, 2) pairs of partial pose and node's pose, as ``pairs`` returns, best first.
            scores: the pairs' result of ``score``.
            width: greatest number that is chosen.
            keep_beyond: whether partial poses that differ only in the area beyond the bands are
                kept apart.

        Returns indices (n,) of the chosen pairs; their partial poses, with masks (n, 0); and for
        each examined pair its index among the chosen ones.
        """
        areas, added = scores
        origins, own = pairs[:, 0], self.nodes[node].areas[pairs[:, 1], 2]
        poses, beyond = partial.poses[origins], partial.beyond[origins]
        poses[:, node] = pairs[:, 1]
        beyond = np.column_stack([np.maximum(beyond[:, 0], own), beyond[:, 1] + own])
        made = PartialPoses(
            masks=np.zeros((len(pairs), 0), dtype=np.uint64),
            poses=poses,
            hashes=partial.hashes[origins] + added,
            covered=partial.covered[origins] + areas[:, 0],
            outside=partial.outside[origins] + areas[:, 1] + own,
            beyond=beyond,
            unreachable=np.zeros(len(pairs), dtype=np.int64),
        )
        placed = np.flatnonzero(partial.poses[0] >= 0).tolist() if len(partial) else ()
        open_nodes, waiting = self.body.frontier(frozenset((*placed, node)))
        # Partial poses with equal sums of hashes go on alike.
        states = made.hashes + poses[:, open_nodes].astype(np.uint64) @ self._node_keys[open_nodes]
        if keep_beyond:
            states += beyond.astype(np.uint64) @ self._beyond_keys
        # The pixels that later nodes can reach.
        rows = np.empty((len(waiting), len(pairs)), dtype=np.int64)
        for i, other in enumerate(waiting if len(pairs) else ()):
            rows[i] = self.reach_rows(other, self.parents(poses, other))
        stored = self.nodes[node]
        reachable = ReachablePixels(self.reach_runs, self.reach_words, rows)
        chosen, unreachable, places = choose_pairs(
            partial.masks, pairs, stored.runs, stored.words, self.bits.all_pixels, reachable,
            width, states,
        )  # fmt: skip
        return chosen, replace(made.chosen(chosen), unreachable=unreachable), places

    def with_masks(
        self, partial: PartialPoses, made: PartialPoses, node: int, pairs: np.ndarray
    ) -> PartialPoses:
        """Return ``made``, the partial poses made of ``partial`` by pairs (n, 2), with masks."""
        masks, stored = partial.masks[pairs[:, 0]], self.nodes[node]
        unite_poses(masks, pairs[:, 1], stored.runs, stored.words)
        return replace(made, masks=masks)


def expand_groups(begins: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices in all of n groups, the ranges [begins (n,), ends (n,)).

    Returns (m,) the number of the group of each index, and (m,) the indices, group after group.
    """
    counts = ends - begins
    groups = np.repeat(np.arange(len(counts)), counts)
    return groups, np.arange(len(groups)) + (begins - np.cumsum(counts) + counts)[groups]
