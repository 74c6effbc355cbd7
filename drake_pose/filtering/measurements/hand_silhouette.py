"""The two-finger hand measured in a silhouette that does not say which part of it is which."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import MaskError
from drake_pose.filtering.hand import (
    FINGERS,
    FLEXIONS,
    HAND_STATE,
    LINE_ENDS,
    LINE_STARTS,
    MEASURED,
    PALM,
    QUATERNION,
    SEEN,
    WRIST,
    HandObservation,
    scaled_rotation,
)
from drake_pose.filtering.kalman.truncated_filter import TruncatedFilter
from drake_pose.filtering.measurements.axes import (
    GATES,
    SPACING,
    RoughBody,
    block_covariance,
    match_axes,
)
from drake_pose.filtering.state import Belief, factor_of
from drake_pose.fit.evidence import EdgePoints, find_edge_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FINGER_RADIUS = 0.008
"""Of the bundled hand's fingers [m]."""

# Parts of the state; lines and tips among MEASURED; how many lines are
# fingers', and those that end in a tip.
_WRIST, _QUATERNION, _PALM = (HAND_STATE.indices(names) for names in (WRIST, QUATERNION, PALM))
_SCALE = MEASURED.index("scale")
_AXES, _FINGER_LINES = slice(MEASURED.index("alpha_11"), _SCALE), len(FLEXIONS)
_TIPS = np.array([[MEASURED.index(f"point_{i}3_{axis}") for axis in "xy"] for i in FINGERS])
_TIP_LINES = np.array([2, 5])
# Searches at most; a search's poses in a round, those that the next is drawn about, rounds, those
# that are followed.
_SEARCHES, _POSES, _ELITE, _SEARCH_ROUNDS, _FOLLOWED = 3, 120, 15, 5, 4
# Its widest deviations: wrist [pixel], quaternion, angles [rad], lengths [m]; and how much finer
# than the picture it draws.
_WIDEST = np.r_[[8.0] * 2, [0.14] * 4, [math.radians(18.0)] * 8, [0.012] * 9]
_ZOOM = 0.5
# Eight corners of the palm's box, as shares of its height, thickness and width.
_CORNERS = np.array([[a, b, c] for a in (0.0, 1.0) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])


class HandMeasurement(NamedTuple):
    """What a silhouette shows of the hand.

    Attributes:
        y: (39,) as of ``HandObservation``, NaN where hidden; covariance: (39, 39) of its noise.
        rough: (n,) the pose that the edge was matched to.
        difference: share of the silhouette by which it differs from that pose's.
    """

    y: Array
    covariance: Array
    rough: Array
    difference: float


@dataclass(frozen=True, eq=False)
class HandSilhouette:
    """Measures the hand in a silhouette, of which nothing says which part it is: figure 17.

    A rough pose, the prediction corrected by what it matches, says which points of the edge show
    which segment; where its own silhouette is another, poses around the prediction are searched.

    Args:
        belief_filter: of ``HAND_STATE`` and a ``HandObservation``.
        width, height: of the picture; center: (2,) where the state has its origin [pixel].
        radius: of a finger [m].
        well_matched: a rough pose whose silhouette differs by more of it is searched for.
        unmatched: one that differs by more says nothing: nothing is measured.
    """

    belief_filter: TruncatedFilter
    width: int
    height: int
    center: tuple[float, float]
    radius: float = FINGER_RADIUS
    well_matched: float = 0.045
    unmatched: float = 0.25

    def draw(self, x: Array, zoom: float = 1.0) -> NDArray[np.uint8]:
        """(zoom H, zoom W) 1 where the hand of a state (n,) is seen: a box and round rods."""
        picture = np.zeros((round(zoom * self.height), round(zoom * self.width)), dtype=np.uint8)
        *outline, radius = self._outline(x)
        # OpenCV takes sixteenths of pixels.
        box, points = (np.round(16 * (zoom * (uv + 0.5) - 0.5)).astype(np.int32) for uv in outline)
        thick = 16 * zoom * (radius - 0.25)
        cv2.fillConvexPoly(picture, cv2.convexHull(box), 1, shift=4)
        for finger in (points[:4], points[4:8]):
            along = np.diff(finger, axis=0).astype(np.float64)
            along *= thick / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
            across = np.round(along[:, ::-1] * (-1, 1)).astype(np.int32)
            a, b = finger[:-1], finger[1:]
            for rod in np.stack([a + across, b + across, b - across, a - across], axis=1):
                cv2.fillConvexPoly(picture, rod, 1, shift=4)
            for u, v in finger.tolist():
                cv2.circle(picture, (u, v), round(thick), 1, -1, shift=4)
        return picture

    def measure(
        self, mask: Mask, prediction: Belief, scale: float | None = None
    ) -> HandMeasurement:
        """Measure lines and tips in a silhouette (H, W), beside a prediction; scale: if known.

        Raises:
            MaskError: a mask of another size.
        """
        if mask.shape != (self.height, self.width):
            raise MaskError(
                f"a mask of {mask.shape[::-1]} pixels, {(self.width, self.height)} expected"
            )
        edge = find_edge_points(mask, SPACING)
        if not len(edge.uv):
            nothing = np.full(len(MEASURED), np.nan)
            return HandMeasurement(nothing, np.diag(nothing), prediction.mean, 1.0)
        found = self._follow(mask, edge, prediction, prediction.mean, GATES[2:], scale)
        if found.difference > self.well_matched:
            for seed in range(_SEARCHES):
                for x in self._search(mask, prediction, seed):
                    other = self._follow(mask, edge, prediction, x, GATES, scale)
                    found = min(found, other, key=lambda one: one.difference)
                if found.difference <= self.well_matched:
                    break
        if found.difference > self.unmatched:
            return found._replace(y=np.full(len(MEASURED), np.nan))
        return found

    def _outline(self, x: Array) -> tuple[Array, Array, float]:
        """The palm's corners (8, 2), what is drawn (16, 2), a finger's radius, in the picture."""
        observation, (width, height, thickness) = self._observation, x[_PALM]
        M = observation.pixels_per_metre * scaled_rotation(x[_QUATERNION])[0]
        # Along the hand's x, y and z.
        corners = (_CORNERS * (height, thickness, width)) @ M[:2].T + x[_WRIST]
        size = observation.pixels_per_metre * float(np.sum(x[_QUATERNION] ** 2))
        return corners + self.center, observation.drawing(x) + self.center, size * self.radius

    @property
    def _observation(self) -> HandObservation:
        observation = self.belief_filter.observation
        assert isinstance(observation, HandObservation)
        return observation

    def _rough(self, x: Array) -> RoughBody:
        box, points, radius = self._outline(x)
        ends = np.stack([points[LINE_STARTS], points[LINE_ENDS]], axis=1)
        along = ends[:, 1] - ends[:, 0]
        side = np.einsum("ij,ij->i", ends[:, 0] - box.mean(axis=0), along[:, ::-1] * (-1, 1)) > 0
        is_finger = np.arange(len(ends)) < _FINGER_LINES
        sides = np.column_stack([side | is_finger, ~side | is_finger])
        return RoughBody(ends, np.where(is_finger, radius, 0.0), sides, _TIP_LINES, self.draw(x))

    def _follow(
        self,
        mask: Mask,
        edge: EdgePoints,
        prediction: Belief,
        x: Array,
        gates: Sequence[float],
        scale: float | None,
    ) -> HandMeasurement:
        """Measure beside a rough state (n,), which what is measured corrects, again and again."""
        for k, gate in enumerate(gates):
            axes = match_axes(edge, self._rough(x), gate, self.center)
            y, R = np.full(len(MEASURED), np.nan), np.zeros((len(MEASURED), len(MEASURED)))
            y[_AXES], R[_AXES, _AXES] = axes.lines.ravel(), block_covariance(axes.line_covariances)
            for rows, tip, covariance in zip(_TIPS, axes.tips, axes.tip_covariances, strict=True):
                y[rows], R[np.ix_(rows, rows)] = tip, covariance
            if scale is not None:
                y[_SCALE], R[_SCALE, _SCALE] = scale, self._observation.scale_deviation**2
            if k < len(gates) - 1:
                x = self.belief_filter.corrected(prediction, y, R, x)
        wrong = np.count_nonzero(self.draw(x) != mask)
        return HandMeasurement(y, R, x, wrong / np.count_nonzero(mask))

    def _search(self, mask: Mask, prediction: Belief, seed: int) -> Array:
        """(k, n) poses around a prediction whose silhouettes are the most alike: cross-entropy."""
        size = (round(_ZOOM * self.width), round(_ZOOM * self.height))
        small = cv2.resize(mask.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        generator, mean = np.random.default_rng(seed), prediction.mean
        rows = self.belief_filter.inequalities
        narrowed = np.minimum(1.0, _WIDEST / np.maximum(prediction.deviations()[SEEN], 1e-12))
        P = prediction.covariance[np.ix_(SEEN, SEEN)] * np.outer(narrowed, narrowed)
        spread, elite = np.sqrt(np.diag(P)), mean[None]
        for k in range(_SEARCH_ROUNDS):
            poses = np.tile(mean, (_POSES, 1))
            poses[:, SEEN] += generator.normal(size=(_POSES, len(SEEN))) @ factor_of(P).T
            poses[: len(elite)] = elite
            norms = np.linalg.norm(poses[:, _QUATERNION], axis=1, keepdims=True)
            poses[:, _QUATERNION] *= np.linalg.norm(prediction.mean[_QUATERNION]) / norms
            for phi, b in zip(rows.phi, rows.b, strict=True):
                beyond = np.maximum(poses @ phi - b, 0.0)
                poses -= np.outer(beyond, phi / (phi @ phi))
            wrong = [np.count_nonzero(self.draw(x, _ZOOM) != small) for x in poses]
            elite = poses[np.argsort(wrong)[:_ELITE]]
            mean = elite.mean(axis=0)
            off = (elite - mean)[:, SEEN]
            P = off.T @ off / len(off) + np.diag((0.15 * spread) ** 2) * 0.5**k
        return elite[:_FOLLOWED]
