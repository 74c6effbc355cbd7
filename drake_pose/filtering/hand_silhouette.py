"""A hand measured in a silhouette that does not say which part of it is which."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.errors import MaskError
from drake_pose.filtering.axes import (
    GATES,
    SPACING,
    RoughBody,
    block_covariance,
    match_axes,
)
from drake_pose.filtering.hand import HandObservation, scaled_rotation
from drake_pose.filtering.hand_model import PALM, QUATERNION, WRIST, HandModel
from drake_pose.filtering.state import Belief, factor_of
from drake_pose.filtering.truncated_filter import TruncatedFilter
from drake_pose.fit.evidence import EdgePoints, find_edge_points

# Searches at most; a search's poses in a round, those that the next is drawn about, rounds, those
# that are followed.
_SEARCHES, _POSES, _ELITE, _SEARCH_ROUNDS, _FOLLOWED = 3, 120, 15, 5, 4
# Its widest deviations: wrist [pixel], quaternion, angles [rad], lengths [m]; and how much finer
# than the picture it draws.
_WIDEST_WRIST, _WIDEST_TURN, _WIDEST_ANGLE, _WIDEST_LENGTH = 8.0, 0.14, math.radians(18.0), 0.012
_ZOOM = 0.5
# How surely a joint or a tip lies inside the silhouette, and along its edge [radii].
_INSIDE, _ALONG = 0.5, 10.0
# A round end, drawn as a polygon.
_RIM = np.array([[math.cos(k * math.pi / 12), math.sin(k * math.pi / 12)] for k in range(24)])
# Gates and the wrist's search are for fingers of this radius [pixel].
_USUAL_RADIUS = 8.0


class HandMeasurement(NamedTuple):
    """What a silhouette shows of the hand.

    Attributes:
        y: (m,) as of ``HandObservation``, NaN where hidden; covariance: (m, m) of its noise.
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
        belief_filter: of a ``HandObservation`` and its hand's state.
        width, height: of the picture; center: (2,) where the state has its origin [pixel].
        well_matched: a rough pose whose silhouette differs by more of it is searched for.
        unmatched: one that differs by more says nothing: nothing is measured.
    """

    belief_filter: TruncatedFilter
    width: int
    height: int
    center: tuple[float, float]
    well_matched: float = 0.045
    unmatched: float = 0.25

    def draw(self, x: Array, zoom: float = 1.0) -> NDArray[np.uint8]:
        """(zoom H, zoom W) 1 where the hand of a state (n,) is seen: a hull, and round rods."""
        picture = np.zeros((round(zoom * self.height), round(zoom * self.width)), dtype=np.uint8)
        palm, points, radii = self._outline(x)
        # OpenCV takes sixteenths of pixels, and draws a quarter of a pixel more.
        palm, points = (16 * (zoom * (uv + 0.5) - 0.5) for uv in (palm, points))
        rims = 16 * zoom * (radii - 0.25)[..., None, None] * _RIM
        rims += points[: radii.size].reshape(*radii.shape, 1, 2)
        rods = np.concatenate([rims[:, :-1], rims[:, 1:]], axis=2).reshape(-1, 2 * len(_RIM), 2)
        for part in (palm, *rods):
            hull = cv2.convexHull(np.round(part).astype(np.int32))
            cv2.fillConvexPoly(picture, hull, 1, shift=4)
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
            nothing = np.full(len(self._observation.names), np.nan)
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
            return found._replace(y=np.full(len(found.y), np.nan))
        return found

    def _outline(self, x: Array) -> tuple[Array, Array, Array]:
        """The palm (2 K, 2), what is drawn (p, 2), the fingers' radii (F, J + 1), as seen."""
        observation, hand = self._observation, self._hand
        width, height, thickness = x[hand.layout.indices(PALM)]
        quaternion, center = x[hand.layout.indices(QUATERNION)], np.array(self.center)
        M = observation.pixels_per_metre * scaled_rotation(quaternion)[0]
        palm = (hand.rings.reshape(-1, 3) * (height, thickness, width)) @ M[:2].T
        size = observation.pixels_per_metre * float(np.sum(quaternion**2))
        wrist = x[hand.layout.indices(WRIST)] + center
        return palm + wrist, observation.drawing(x) + center, size * hand.radii

    @property
    def _hand(self) -> HandModel:
        return self._observation.hand

    @property
    def _observation(self) -> HandObservation:
        observation = self.belief_filter.observation
        assert isinstance(observation, HandObservation)
        return observation

    @property
    def _unit(self) -> float:
        """The thickness of fingers, over that which the widths of searches are made for."""
        return float(np.mean(self._hand.radii)) * self._observation.pixels_per_metre / _USUAL_RADIUS

    def _rough(self, x: Array) -> RoughBody:
        palm, points, radii = self._outline(x)
        ends = points[self._hand.line_ends]
        count = len(self._hand.lengths)
        along = ends[:, 1] - ends[:, 0]
        side = np.einsum("ij,ij->i", ends[:, 0] - palm.mean(axis=0), along[:, ::-1] * (-1, 1)) > 0
        is_finger = np.arange(len(ends)) < count
        sides = np.column_stack([side | is_finger, ~side | is_finger])
        widths = np.r_[0.5 * (radii[:, :-1] + radii[:, 1:]).ravel(), np.zeros(len(ends) - count)]
        tips = len(self._hand.joints) * np.arange(1, len(radii) + 1) - 1
        return RoughBody(ends, widths, sides, tips, self.draw(x))

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
        observation, names = self._observation, self._observation.names
        at, usual = names.index("scale"), self._hand.usual
        lines = slice(at - 2 * len(self._hand.line_ends), at)
        tips = [
            [names.index(f"point_{i}{self._hand.joints[-1]}_{axis}") for axis in "xy"]
            for i in self._hand.fingers
        ]
        for k, gate in enumerate(gates):
            axes = match_axes(edge, self._rough(x), self._unit * gate, self.center)
            y, R = np.full(len(names), np.nan), np.diag(observation.variances)
            y[lines], R[lines, lines] = axes.lines.ravel(), block_covariance(axes.line_covariances)
            for rows, tip, covariance in zip(tips, axes.tips, axes.tip_covariances, strict=True):
                y[rows], R[np.ix_(rows, rows)] = tip, covariance
            y[[names.index(name) for name in self._hand.hidden]] = np.nan
            self._draw_in(x, mask, edge, y, R)
            y[at] = math.nan if scale is None else scale
            if usual is not None:
                y[at + 1 :] = usual.mean
            if k < len(gates) - 1:
                x = self.belief_filter.corrected(prediction, y, R, x)
        wrong = np.count_nonzero(self.draw(x) != mask)
        return HandMeasurement(y, R, x, wrong / np.count_nonzero(mask))

    def _draw_in(self, x: Array, mask: Mask, edge: EdgePoints, y: Array, R: Array) -> None:
        """Adds that a finger's joints and tips which are not measured lie in the silhouette."""
        _, points, radii = self._outline(x)
        for k, (point, radius) in enumerate(zip(points, radii.ravel(), strict=False)):
            rows = slice(2 + 2 * k, 4 + 2 * k)
            u, v = np.clip(np.rint(point), 0, (self.width - 1, self.height - 1)).astype(int)
            if mask[v, u] or np.isfinite(y[rows]).any():
                continue
            nearest = edge.uv[np.argmin(np.sum((edge.uv - point) ** 2, axis=1))]
            away = (point - nearest) / max(float(np.linalg.norm(point - nearest)), 1.0)
            y[rows] = nearest - 0.5 * radius * away - self.center
            # Nothing is known of where along the edge.
            along = _ALONG**2 * np.eye(2) + (_INSIDE**2 - _ALONG**2) * np.outer(away, away)
            R[rows, rows] = radius**2 * along

    def _search(self, mask: Mask, prediction: Belief, seed: int) -> Array:
        """(k, n) poses around a prediction whose silhouettes are the most alike: cross-entropy."""
        size = (round(_ZOOM * self.width), round(_ZOOM * self.height))
        small = cv2.resize(mask.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        generator, mean = np.random.default_rng(seed), prediction.mean
        rows = self.belief_filter.inequalities
        seen, hand = self._hand.seen, self._hand
        turn = hand.layout.indices(QUATERNION)
        widest = np.repeat(
            (self._unit * _WIDEST_WRIST, _WIDEST_TURN, _WIDEST_ANGLE, _WIDEST_LENGTH),
            (2, 4, len(hand.angles), len(hand.layout.constant)),
        )
        narrowed = np.minimum(1.0, widest / np.maximum(prediction.deviations()[seen], 1e-12))
        P = prediction.covariance[np.ix_(seen, seen)] * np.outer(narrowed, narrowed)
        spread, elite = np.sqrt(np.diag(P)), mean[None]
        for k in range(_SEARCH_ROUNDS):
            poses = np.tile(mean, (_POSES, 1))
            poses[:, seen] += generator.normal(size=(_POSES, len(seen))) @ factor_of(P).T
            poses[: len(elite)] = elite
            norms = np.linalg.norm(poses[:, turn], axis=1, keepdims=True)
            poses[:, turn] *= np.linalg.norm(prediction.mean[turn]) / norms
            for phi, b in zip(rows.phi, rows.b, strict=True):
                beyond = np.maximum(poses @ phi - b, 0.0)
                poses -= np.outer(beyond, phi / (phi @ phi))
            wrong = [np.count_nonzero(self.draw(x, _ZOOM) != small) for x in poses]
            elite = poses[np.argsort(wrong)[:_ELITE]]
            mean = elite.mean(axis=0)
            off = (elite - mean)[:, seen]
            P = off.T @ off / len(off) + np.diag((0.15 * spread) ** 2) * 0.5**k
        return elite[:_FOLLOWED]
