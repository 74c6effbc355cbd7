"""Edges inside the silhouette choose among poses that the silhouette cannot tell apart.

Poses under which the edges of a label image are far too unlikely, as edges are missed, displaced or
wrong, are ruled out (Kameda, Minoh, Ikeda, section 7, name this as future work).
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.special import logsumexp

from drake_pose.errors import SettingsError
from drake_pose.search.branch_and_bound import PartialPoseGraph
from drake_pose.search.estimates import JointEstimate
from drake_pose.search.pose_families import GridPoseSet, estimate_joints

RenderSegments = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Draws a pose, q (nq,) and X_WB (4, 4): (H, W) int the segment seen at each pixel, -1 for none.
``LabelRenderer.segments`` is one."""

# Where no wrong edge passes, so few pixels are wrong nevertheless.
_WRONG_PIXEL = 1e-3
# Errors reach beyond a patch into its neighbours, but seldom farther. In each of four classes of
# patches none touches another: by Hoelder's inequality the fourth root of the product over all
# patches exaggerates nothing, as if each class alone had been looked at.
_CLASSES = 4


@dataclass(frozen=True)
class EdgeErrors:
    """How the edges of a picture may be wrong; all of them are up to a pixel off besides.

    Args:
        missing: the share that is not seen.
        wrong: the length of those that are none, as a share of the true ones'.
        patch: edges are missing in squares of this side, and so long is a wrong one [pixel].

    Raises:
        SettingsError: if a value is out of its range.
    """

    missing: float = 0.2
    wrong: float = 0.05
    patch: int = 5

    def __post_init__(self) -> None:
        if not 0.0 < self.missing < 1.0:
            raise SettingsError(f"missing must be above 0 and below 1, not {self.missing}")
        if not 0.0 < self.wrong < np.inf:
            raise SettingsError(f"wrong must be above 0 and finite, not {self.wrong}")
        if self.patch < 1:
            raise SettingsError(f"patch must be 1 pixel or more, not {self.patch}")

    @cached_property
    def log_pixel(self) -> np.ndarray:
        """The log probability (4, 2, 10) of a pixel.

        By what its patch holds (0: nothing, 1: the true edges, 2: a wrong one, 3: both), by whether
        an edge is seen there, and by how many of it and its neighbours the pose expects one at.
        """
        expected = np.arange(10)
        table = np.empty((4, 2, 10))
        for state in range(4):
            unexplained = 1.0 / (1 + self.patch) if state >= 2 else _WRONG_PIXEL
            # Each expected pixel is displaced to any of the nine around it.
            missed = (1.0 - unexplained) * (8.0 / 9.0) ** (expected * (state % 2))
            table[state] = np.log([missed, 1.0 - missed])
        return table

    def log_patch(self, seen: int, patches: float) -> np.ndarray:
        """The log probability (4,) of what a patch holds, of ``seen`` pixels in ``patches``."""
        # A line as long as a patch is wide lies in two of them, mostly.
        wrong = np.clip(2.0 * self.wrong * seen / (self.patch * patches), _WRONG_PIXEL, 0.5)
        missing = self.missing
        return np.log(np.outer([1.0 - wrong, wrong], [missing, 1.0 - missing]).ravel())


@dataclass(frozen=True)
class InnerEdges:
    """The edges (H, W) bool that one camera's picture shows inside its silhouette, the mask."""

    edges: np.ndarray
    mask: np.ndarray
    errors: EdgeErrors = EdgeErrors()

    @cached_property
    def _window(self) -> tuple[slice, slice]:
        """The rows and columns of the silhouette."""
        left, top, width, height = cv2.boundingRect(self.mask.astype(np.uint8))
        return slice(top, top + height), slice(left, left + width)

    @cached_property
    def _inside(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where edges count in the window, (pixels,) 1 where one is seen, and each one's patch."""
        mask = self.mask[self._window]
        rows, columns = (places // self.errors.patch for places in np.nonzero(mask))
        patches = np.unique(rows * (1 + int(columns.max())) + columns, return_inverse=True)[1]
        return mask, self.edges[self._window][mask].astype(np.int64), patches

    def log_likelihood(self, segments: np.ndarray) -> float:
        """The log probability of the edges if a pose's picture is segments (H, W) int.

        That the edges are without any error counts as likely beforehand as that they have the
        errors which ``errors`` describes.
        """
        mask, seen, patches = self._inside
        borders = find_borders(np.where(mask, segments[self._window], -1))
        near = cv2.boxFilter(
            borders.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        expected = np.rint(near[mask]).astype(np.int64)
        sums = [np.bincount(patches, table[seen, expected]) for table in self.errors.log_pixel]
        count = max(1.0, len(expected) / self.errors.patch**2)
        weights = self.errors.log_patch(int(seen.sum()), count)
        damaged = float(logsumexp(np.array(sums) + weights[:, None], axis=0).sum()) / _CLASSES
        flawless = 0.0 if np.array_equal(borders[mask], seen > 0) else -np.inf
        return float(np.logaddexp(flawless, damaged) + np.log(0.5))


def edges_of_labels(labels: np.ndarray, mask: np.ndarray) -> InnerEdges:
    """The borders between labels (H, W) int, negative for none, inside a silhouette.

    Raises:
        SettingsError: if the shapes differ or the silhouette is empty.
    """
    if labels.shape != mask.shape:
        raise SettingsError(
            f"the picture for inner edges is {labels.shape[::-1]} pixels (width, height), but the "
            f"silhouette is {mask.shape[::-1]}: give both of the same camera and size"
        )
    if not mask.any():
        raise SettingsError("the silhouette is empty: it has no inner edges")
    return InnerEdges(find_borders(np.where(mask, labels, -1)), mask)


def find_borders(segments: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool of a segment whose right or lower neighbour is of another segment."""
    borders = np.zeros(segments.shape, dtype=np.bool_)
    for own, here, other in (
        (borders[:, :-1], segments[:, :-1], segments[:, 1:]),
        (borders[:-1], segments[:-1], segments[1:]),
    ):
        own |= (here >= 0) & (other >= 0) & (here != other)
    return borders


@dataclass(frozen=True)
class EdgeChoice:
    """What inner edges leave of a set of poses.

    Attributes:
        samples: (n, nodes) the poses judged, best first.
        probabilities: (n,) of each, if one of these is true and all are as likely beforehand.
        left: how many of the first are not ruled out.
        joints: each value of the pose tree, over those left.
        exhaustive: whether all poses of the set were judged.
    """

    samples: np.ndarray
    probabilities: np.ndarray
    left: int
    joints: tuple[JointEstimate, ...]
    exhaustive: bool

    @property
    def settled(self) -> bool:
        """Whether one pose is left, and no other of the set can be as good."""
        return self.left == 1 and self.exhaustive

    def rules_out(self, samples: np.ndarray) -> bool:
        """Whether a pose of the set, samples (nodes,), was judged and is ruled out."""
        return bool((self.samples[self.left :] == samples).all(axis=1).any())


def choose_by_edges(
    answer: GridPoseSet,
    edges: Sequence[InnerEdges],
    renders: Sequence[RenderSegments],
    most: int = 1000,
    risk: float = 1e-3,
) -> EdgeChoice:
    """Judge the poses of a set by inner edges.

    A pose is ruled out where the edges are far less likely under it than under the mean of all.
    That ratio's expectation is 1 under the true pose, so that by Markov's inequality the true one
    is ruled out with probability ``risk`` at most, however many poses there are and whatever they
    look like, as long as the edges are no worse than their ``errors`` say.

    Args:
        most: a set of more poses is judged by this many random ones; from the best of them, one
            node and all that hangs on it is then turned in a tenth as many ways while that helps.
        risk: the probability that the true pose may be ruled out with.

    Raises:
        SettingsError: if the risk is not above 0 and below 1.
    """
    if not 0.0 < risk < 1.0:
        raise SettingsError(f"risk must be above 0 and below 1, not {risk}")
    tree = answer.sampled.tree
    known: dict[tuple[int, ...], float] = {}

    def judge(samples: np.ndarray) -> float:
        key = tuple(samples.tolist())
        if key not in known:
            q, X_WB = tree.positions_from(answer.sampled.values_at(samples))
            known[key] = sum(
                edge.log_likelihood(render(q, X_WB))
                for edge, render in zip(edges, renders, strict=True)
            )
        return known[key]

    exhaustive = answer.size <= most
    random = np.random.default_rng(0)
    members = _members(answer.graph, most, random)
    found = [judge(samples) for samples in members]
    if not exhaustive:
        _turn_subtrees(answer, members[int(np.argmax(found))], judge, 1 + most // 10, random)
    log_likelihoods = np.array(list(known.values()))
    log_probabilities = log_likelihoods - logsumexp(log_likelihoods)
    order = np.argsort(-log_probabilities, kind="stable")
    samples, log_probabilities = np.array(list(known))[order], log_probabilities[order]
    # Half of the probability beforehand is that of edges without error, in each camera's picture.
    allowed = np.log(risk) - len(edges) * np.log(2.0) - np.log(answer.size)
    left = max(1, int((log_probabilities >= allowed).sum()))
    seen = [np.unique(column) for column in samples[:left].T]
    best = answer.sampled.values_at(samples[0])
    complete = answer.complete and exhaustive
    joints = estimate_joints(answer.sampled, seen, best, complete=complete)
    return EdgeChoice(samples, np.exp(log_probabilities), left, joints, exhaustive)


def _turn_subtrees(
    answer: GridPoseSet,
    samples: np.ndarray,
    judge: Callable[[np.ndarray], float],
    most: int,
    random: np.random.Generator,
) -> None:
    """Judge what can be reached from a pose by turning one node and all that hangs on it."""
    order = sorted(answer.sampled.tree.subtrees, key=len)
    best, unchanged = judge(samples), 0
    for subtree in itertools.cycle(order):
        allowed = [
            None if node in subtree else np.arange(len(grid)) == samples[node]
            for node, grid in enumerate(answer.sampled.values)
        ]
        members = _members(answer.graph.restricted(allowed), most, random)
        found = [judge(member) for member in members]
        unchanged += 1
        if max(found) > best:
            place = int(np.argmax(found))
            best, samples, unchanged = found[place], members[place], 0
        if unchanged >= len(order):
            return


def _members(graph: PartialPoseGraph, most: int, random: np.random.Generator) -> np.ndarray:
    """All poses (n, nodes) of a graph, or this many of them drawn at random."""
    return graph.members() if graph.size <= most else graph.draw(most, random)
