"""Edges inside the silhouette choose among poses that the silhouette cannot tell apart.

Where one limb passes in front of another, a label or colour image shows an edge that the silhouette
does not (Kameda, Minoh, Ikeda, section 7, name this as future work). A pose is judged by how well
the edges between its visible segments agree with those of the picture: the F measure of boundaries
(Martin, Fowlkes, Malik 2004), edges matched within a few pixels.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.matching.grid.branch_and_bound.partial_pose_graph import PartialPoseGraph
from drake_pose.matching.grid.families.joint_estimates import estimate_joints
from drake_pose.matching.grid.families.search import GridPoseSet
from drake_pose.matching.pose_families import JointEstimate, PoseSet

RenderSegments = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Draws a pose, q (nq,) and X_WB (4, 4): (H, W) int the segment seen at each pixel, -1 for none.
``LabelRenderer.segments`` is one."""

_TOLERANCE = 2.0
_ALIKE = 0.005
# Of what even the best pose lacks, so much may be chance between it and another.
_CHANCE = 0.1
_CANNY = (50, 150)
# Colours change at the silhouette's edge, too: so near to it no edge counts.
_RIM = 3


@dataclass(frozen=True)
class InnerEdges:
    """The edges that one camera's picture shows inside its silhouette.

    Args:
        edges: (H, W) bool.
        window: first row, row after the last, first column and column after the last of the
            silhouette's surroundings.
        rim: so near to the silhouette's edge no edge counts [pixel].
    """

    edges: np.ndarray
    window: tuple[int, int, int, int]
    mask: np.ndarray
    rim: int

    @cached_property
    def _seen_distances(self) -> np.ndarray:
        """The distance of each pixel of the window to the nearest edge [pixel]."""
        top, bottom, left, right = self.window
        return _distances(self.edges[top:bottom, left:right])

    @cached_property
    def _inside(self) -> np.ndarray:
        """The pixels of the window at which edges count."""
        top, bottom, left, right = self.window
        return _interior(self.mask[top:bottom, left:right], self.rim)

    def agreement(self, segments: np.ndarray, tolerance: float = _TOLERANCE) -> float:
        """How well the borders between visible segments (H, W) int agree with the edges: 0 to 1.

        Args:
            segments: the segment seen at each pixel, -1 where none is.
            tolerance: edges so near to each other match [pixel].
        """
        top, bottom, left, right = self.window
        window = (slice(top, bottom), slice(left, right))
        expected = find_borders(segments[window]) & self._inside
        seen = self.edges[window]
        if not expected.any() or not seen.any():
            return float(not expected.any() and not seen.any())
        found = float((_distances(expected)[seen] <= tolerance).mean())
        explained = float((self._seen_distances[expected] <= tolerance).mean())
        return 2.0 * found * explained / (found + explained) if found + explained else 0.0


def edges_of_labels(labels: np.ndarray, mask: np.ndarray) -> InnerEdges:
    """The borders between the labels inside a silhouette.

    Args:
        labels: (H, W) int, a label for each segment; negative: none.
        mask: (H, W) bool, the silhouette.

    Raises:
        SettingsError: if the shapes differ or the silhouette is empty.
    """
    window = _window(labels.shape[:2], mask)
    edges = find_borders(np.where(mask, labels, -1))
    return InnerEdges(edges, window, mask, 0)


def edges_of_colours(
    picture: np.ndarray, mask: np.ndarray, thresholds: tuple[int, int] = _CANNY
) -> InnerEdges:
    """Canny's edges inside a silhouette, a little away from its own edge.

    Args:
        picture: (H, W, 3) or (H, W) uint8.
        mask: (H, W) bool, the silhouette.
        thresholds: Canny's lower and upper one.

    Raises:
        SettingsError: if the shapes differ or the silhouette is empty.
    """
    window = _window(picture.shape[:2], mask)
    edges = cv2.Canny(np.ascontiguousarray(picture), *thresholds) > 0
    return InnerEdges(edges & _interior(mask, _RIM), window, mask, _RIM)


def find_borders(segments: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool of a segment whose right or lower neighbour is of another segment."""
    borders = np.zeros(segments.shape, dtype=np.bool_)
    right, lower = segments[:, 1:], segments[1:]
    here = segments[:, :-1]
    borders[:, :-1] |= (here >= 0) & (right >= 0) & (here != right)
    here = segments[:-1]
    borders[:-1] |= (here >= 0) & (lower >= 0) & (here != lower)
    return borders


@dataclass(frozen=True)
class EdgeChoice:
    """What inner edges leave of a set of poses.

    Attributes:
        samples: (n, nodes) the poses judged, best first.
        agreements: (n,) their agreement, 0 to 1, the mean over the cameras.
        left: how many of the first agree as well as the best.
        joints: each value of the pose tree, over those left.
        exhaustive: whether all poses of the set were judged.
    """

    samples: np.ndarray
    agreements: np.ndarray
    left: int
    joints: tuple[JointEstimate, ...]
    exhaustive: bool

    @property
    def settled(self) -> bool:
        """Whether one pose is left, and no other of the set can be as good."""
        return self.left == 1 and self.exhaustive

    def rules_out(self, samples: np.ndarray) -> bool:
        """Whether a pose of the set, samples (nodes,), was judged and agrees worse than the best.

        Of a large set not all poses are judged: one that was not is not ruled out.
        """
        return bool((self.samples[self.left :] == samples).all(axis=1).any())


def rank_families(
    answer: PoseSet, edges: Sequence[InnerEdges], renders: Sequence[RenderSegments]
) -> np.ndarray:
    """The agreement (families,), 0 to 1, of each family's representative.

    Args:
        answer: the families.
        edges: of each camera.
        renders: one for each camera.
    """
    return np.array(
        [
            _mean_agreement([render(family.q, family.X_WB) for render in renders], edges)
            for family in answer.families
        ]
    )


def choose_by_edges(
    answer: GridPoseSet,
    edges: Sequence[InnerEdges],
    renders: Sequence[RenderSegments],
    most: int = 300,
    alike: float = _ALIKE,
) -> EdgeChoice:
    """Judge the poses of a set by inner edges.

    Args:
        answer: the set.
        edges: of each camera.
        renders: one for each camera.
        most: a set of more poses is judged by this many random ones; from the best of them, one
            node and all that hangs on it is then turned in as many ways while that helps.
        alike: poses whose agreement is no more below the best one's count as equally good; where
            the best one's is below 1, as edges are missing or wrong, a tenth of that more. Where a
            pose agrees to the pixel, only such poses do.
    """
    tree = answer.sampled.tree
    known: dict[tuple[int, ...], tuple[float, float]] = {}

    def judge(samples: np.ndarray) -> float:
        key = tuple(samples.tolist())
        if key not in known:
            values = [grid[t] for grid, t in zip(answer.sampled.values, samples, strict=True)]
            q, X_WB = tree.positions_from(values)
            images = [render(q, X_WB) for render in renders]
            known[key] = _mean_agreement(images, edges), _mean_agreement(images, edges, 0.0)
        return known[key][0]

    exhaustive = answer.size <= most
    random = np.random.default_rng(0)
    members = _members(answer.graph, most, random)
    agreements = [judge(samples) for samples in members]
    if not exhaustive:
        _turn_subtrees(answer, members[int(np.argmax(agreements))], judge, most, random)
    samples = np.array(list(known))
    found, to_the_pixel = np.array(list(known.values())).T
    is_left = found >= found.max() - alike - _CHANCE * (1.0 - found.max())
    if to_the_pixel.max() == 1.0:
        # Edges without any noise: who differs by a pixel is not the one.
        is_left &= to_the_pixel == 1.0
    order = np.lexsort((-found, ~is_left))
    samples, found, left = samples[order], found[order], int(is_left.sum())
    seen = [np.unique(column) for column in samples[:left].T]
    best = [grid[t] for grid, t in zip(answer.sampled.values, samples[0], strict=True)]
    complete = answer.complete and exhaustive
    joints = estimate_joints(answer.sampled, seen, best, complete=complete)
    return EdgeChoice(samples, found, left, joints, exhaustive)


def _turn_subtrees(
    answer: GridPoseSet,
    samples: np.ndarray,
    judge: Callable[[np.ndarray], float],
    most: int,
    random: np.random.Generator,
) -> None:
    """Judge what can be reached from a pose by turning one node and all that hangs on it.

    The best found is followed until nothing is better; the smallest subtrees come first.
    """
    nodes = answer.sampled.tree.nodes
    subtrees = [{i} for i in range(len(nodes))]
    for i in reversed(range(len(nodes))):
        if nodes[i].parent >= 0:
            subtrees[nodes[i].parent] |= subtrees[i]
    order = sorted(subtrees, key=len)
    best, unchanged = judge(samples), 0
    for subtree in itertools.cycle(order):
        allowed = [
            None if node in subtree else np.arange(len(grid)) == samples[node]
            for node, grid in enumerate(answer.sampled.values)
        ]
        members = _members(answer.graph.restricted(allowed), most, random)
        agreements = [judge(member) for member in members]
        unchanged += 1
        if max(agreements) > best:
            place = int(np.argmax(agreements))
            best, samples, unchanged = agreements[place], members[place], 0
        if unchanged >= len(order):
            return


def _members(graph: PartialPoseGraph, most: int, random: np.random.Generator) -> np.ndarray:
    """All poses (n, nodes) of a graph, or this many of them drawn at random."""
    if graph.size <= most:
        return graph.members()
    return graph.draw(most, random)


def _mean_agreement(
    images: Sequence[np.ndarray], edges: Sequence[InnerEdges], tolerance: float = _TOLERANCE
) -> float:
    """The mean agreement of segments (H, W) in each camera's picture with its edges."""
    pairs = zip(images, edges, strict=True)
    return float(np.mean([edge.agreement(image, tolerance) for image, edge in pairs]))


def _window(shape: tuple[int, ...], mask: np.ndarray) -> tuple[int, int, int, int]:
    """The rows and columns of a silhouette."""
    if shape != mask.shape:
        raise SettingsError(
            f"the picture for inner edges is {shape[::-1]} pixels (width, height), but the "
            f"silhouette is {mask.shape[::-1]}: give both of the same camera and size"
        )
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        raise SettingsError("the silhouette is empty: it has no inner edges")
    return int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1


def _interior(mask: np.ndarray, rim: int) -> np.ndarray:
    """Pixels of a mask (H, W) bool that are farther than this many pixels from its edge."""
    if rim == 0:
        return mask
    padded = np.pad(mask.astype(np.uint8), 1)
    distances = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distances[1:-1, 1:-1] > rim)


def _distances(edges: np.ndarray) -> np.ndarray:
    """The distance (H, W) of each pixel to the nearest edge [pixel]."""
    away = (~edges).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
