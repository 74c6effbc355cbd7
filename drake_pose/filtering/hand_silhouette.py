"""Measurement of a hand in a silhouette: lines along segments, and fingertips.

Shimada et al., (11), (12) and figure 17. A silhouette does not say which part of it is which
segment. A rough pose does: each edge point is assigned to the nearest side of a segment or tip.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from drake_pose.arrays import Array, Mask
from drake_pose.errors import MaskError
from drake_pose.filtering.hand import HandObservation, scaled_rotation
from drake_pose.filtering.hand_model import PALM, QUATERNION, WRIST, HandModel
from drake_pose.filtering.state import Belief, factor_of
from drake_pose.filtering.truncated_filter import TruncatedFilter
from drake_pose.fit.evidence import EdgePoints, find_edge_points


@dataclass(frozen=True)
class HandSilhouetteSettings:
    """Settings of the search for a hand's pose, and of the match of edge points to its segments."""

    # The assignment of edge points to the segments of a rough pose.
    spacing: float = 2.0  # Distance between two edge points [pixel].
    # Largest distance between edge points and a rough side, by iteration [pixel].
    gates: tuple[float, ...] = (14.0, 9.0, 6.0, 4.0)
    # edge_deviation, correlation: standard deviation of an edge point, and edge length over which
    # errors are correlated, increased because they are also correlated between frames [pixel].
    edge_deviation: float = 0.35
    correlation: float = 8.0
    width_deviation: float = 0.4  # Standard deviation of half a segment's width [pixel].
    # min_offset_deviation, min_angle_deviation, min_tip_deviation: smallest standard deviation of a
    # line's offset [pixel] and direction [rad], and of a tip [pixel].
    min_offset_deviation: float = 0.1
    min_angle_deviation: float = math.radians(0.2)
    min_tip_deviation: float = 0.15
    # max_angle_deviation, max_tip_deviation: a line [rad] or tip [pixel] with a larger standard
    # deviation is not measured.
    max_angle_deviation: float = math.radians(10.0)
    max_tip_deviation: float = 3.0
    # facing, facing_tip: smallest cosine between the normals of an edge point and of a side, or
    # tip.
    facing: float = 0.85
    facing_tip: float = 0.7
    end: float = 0.08  # Fraction of a side at each end that is not matched.
    # Distance outside a side at which the rough body must be empty, else the side is hidden
    # [pixel].
    beside: float = 2.0
    rounds: int = 4  # Iterations of the robust fit.
    shortest: float = 5.0  # Segments shorter in the image have no line [pixel].

    # The cross-entropy search for a pose.
    searches: int = 3  # Largest number of searches.
    # poses, elite, search_rounds: number of poses of a round, of the best ones that define the next
    # round's distribution, and of rounds.
    poses: int = 120
    elite: int = 15
    search_rounds: int = 5
    tracked: int = 4  # Number of poses whose edges are matched.
    # wrist_deviation, turn_deviation, angle_deviation, length_deviation: largest standard
    # deviations of the first round: wrist [pixel], quaternion, angles [rad], lengths [m].
    wrist_deviation: float = 8.0
    turn_deviation: float = 0.14
    angle_deviation: float = math.radians(18.0)
    length_deviation: float = 0.012
    zoom: float = 0.5  # Size of the compared images relative to the mask.
    # inside, along: standard deviation of a hidden joint or tip across the silhouette's edge, and
    # along it [radii].
    inside: float = 0.5
    along: float = 10.0
    # Finger radius for which gates and ``wrist_deviation`` are given [pixel].
    reference_radius: float = 8.0


HAND = HandSilhouetteSettings()


class RoughBody(NamedTuple):
    """The image of a rough pose [pixel]."""

    ends: Array  # (L, 2, 2) start and end of each segment's axis, or of a palm edge.
    widths: Array  # (L,) half the width of a segment; 0 for a palm edge.
    sides: Mask  # (L, 2) whether a side may be visible: that of the normal (-y, x), and the other.
    tips: NDArray[np.intp]  # (T,) indices of the segments that end in a round tip of their width.
    drawn: NDArray[np.uint8] | Mask  # (H, W) the silhouette; 0 outside.


class Axes(NamedTuple):
    """Measured lines and tips, NaN where not visible, in the order of ``RoughBody``."""

    # (L, 2) alpha, the angle from start to end [rad], and rho [pixel]; a line's points (u, v)
    # satisfy rho = v cos(alpha) - u sin(alpha).
    lines: Array
    line_covariances: Array  # (L, 2, 2) covariances of alpha and rho.
    tips: Array  # (T, 2) centres of the tips [pixel].
    tip_covariances: Array  # (T, 2, 2) [pixel^2].


def match_axes(
    edge: EdgePoints, rough: RoughBody, gate: float, origin: tuple[float, float] = (0.0, 0.0)
) -> Axes:
    """Return the segments' axes and tips that a silhouette's edge shows, from both sides or one.

    Args:
        edge: edge points of the silhouette.
        rough: image of a rough pose.
        gate: largest distance between an edge point and a rough side [pixel].
        origin: (2,) image point that is (0, 0) for lines and tips [pixel].
    """
    count = len(rough.ends)
    along = rough.ends[:, 1] - rough.ends[:, 0]
    size = np.linalg.norm(along, axis=1)
    along = along / np.maximum(size, 1e-9)[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    matched = _match(edge, rough, gate, along, normal, size)
    solution, covariance, sides = _solve(*matched, count + len(rough.tips), gate)
    one_sided = (rough.widths > 0) & (sides[:count].min(axis=1) < 0.3 * sides[:count].max(axis=1))
    shift, turn = solution[:count].T
    C = covariance[:count]
    C[:, 0, 0] += np.where(one_sided, HAND.width_deviation**2, 0.0) + HAND.min_offset_deviation**2
    C[:, 1, 1] += HAND.min_angle_deviation**2
    middle = rough.ends.mean(axis=1) - origin + shift[:, None] * normal
    alpha = np.arctan2(along[:, 1], along[:, 0]) + np.arctan(turn)
    alpha = np.remainder(alpha + np.pi, 2 * np.pi) - np.pi
    c, s = np.cos(alpha), np.sin(alpha)
    lines = np.column_stack([alpha, c * middle[:, 1] - s * middle[:, 0]])
    # d rho / d alpha is minus the position along the axis.
    J = np.zeros((count, 2, 2))
    J[:, 0, 1], J[:, 1, 0], J[:, 1, 1] = 1.0, 1.0, -(c * middle[:, 0] + s * middle[:, 1])
    lines[(C[:, 1, 1] > HAND.max_angle_deviation**2) | (size < HAND.shortest)] = np.nan
    tips = rough.ends[rough.tips, 1] - origin + solution[count:]
    tip_covariances = covariance[count:] + HAND.min_tip_deviation**2 * np.eye(2)
    # The end of a segment that points at the camera may be its joint.
    unsure = np.linalg.eigvalsh(tip_covariances)[:, 1] > HAND.max_tip_deviation**2
    tips[unsure | (size < rough.widths)[rough.tips]] = np.nan
    return Axes(lines, J @ C @ J.transpose(0, 2, 1), tips, tip_covariances)


def _match(
    edge: EdgePoints, rough: RoughBody, gate: float, along: Array, normal: Array, size: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array, Array]:
    """Assign each edge point to the nearest visible side or tip within the gate [pixel].

    ``edge``: edge points of the silhouette. ``rough``: image of a rough pose with L lines.
    ``along``, ``normal``: (L, 2) unit vectors along each line and across it. ``size``: (L,) length
    of each line [pixel].

    Returns for the n assigned points: feature (n,), the index of a line, or L plus that of a tip;
    side (n,), 0 or 1 as in ``RoughBody.sides``; slope (n, 2), offset (n,) and weight (n,), where
    offset = slope @ (the two unknowns of the feature). A line's unknowns are its shift along the
    normal [pixel] and the tangent of its rotation, a tip's are its displacement [pixel].
    """
    line, side = np.nonzero(rough.sides)
    sign, uv = 1.0 - 2.0 * side, edge.uv
    relative = uv - rough.ends[line, :1]
    position = np.einsum("cnk,ck->cn", relative, along[line])
    across = np.einsum("cnk,ck->cn", relative, normal[line])
    outside = sign[:, None] * across - rough.widths[line, None]
    facing = sign[:, None] * (normal[line] @ edge.normals.T)
    fraction = position / np.maximum(size[line], 1e-9)[:, None]
    beside = uv + (sign[:, None] * (HAND.beside - outside))[..., None] * normal[line, None]
    is_candidate = (
        (np.abs(outside) < gate)
        & (facing > HAND.facing)
        & (np.abs(fraction - 0.5) < 0.5 - HAND.end)
    )
    is_candidate &= _is_empty(rough.drawn, beside)
    ends, widths = rough.ends[rough.tips, 1], rough.widths[rough.tips]
    radial = uv - ends[:, None]
    distance = np.linalg.norm(radial, axis=2)
    radial = radial / np.maximum(distance, 1e-9)[..., None]
    beyond = distance - widths[:, None]
    beside = ends[:, None] + (widths[:, None, None] + HAND.beside) * radial
    round_tip = (np.abs(beyond) < gate) & _is_empty(rough.drawn, beside)
    round_tip &= np.einsum("tnk,nk->tn", radial, edge.normals) > HAND.facing_tip
    round_tip &= np.einsum("tnk,tk->tn", radial, along[rough.tips]) > 0.1
    cost = np.abs(np.vstack([outside, beyond]))
    cost[~np.vstack([is_candidate, round_tip])] = np.inf
    nearest = np.argmin(cost, axis=0)
    points = np.flatnonzero(np.isfinite(cost[nearest, np.arange(len(uv))]))
    own = nearest[points]
    is_tip = own >= len(line)
    k, t = np.where(is_tip, 0, own), np.where(is_tip, own - len(line), 0)
    lever = (fraction[k, points] - 0.5) * size[line[k]]
    on_line = np.column_stack([np.ones(len(points)), lever])
    slope = on_line
    offset = sign[k] * outside[k, points]
    feature = line[k]
    if len(rough.tips):
        slope = np.where(is_tip[:, None], radial[t, points], on_line)
        offset = np.where(is_tip, beyond[t, points], offset)
        feature = np.where(is_tip, len(rough.ends) + t, feature)
    return feature, side[k], slope, offset, edge.lengths[points]


def _is_empty(drawn: NDArray[np.uint8] | Mask, uv: Array) -> Mask:
    """Return (...,) bool, whether an image (H, W) is 0 at uv (..., 2) [pixel], moved inside it."""
    size = (drawn.shape[1] - 1, drawn.shape[0] - 1)
    u, v = np.moveaxis(np.clip(np.rint(uv).astype(np.intp), 0, size), -1, 0)
    return np.asarray(drawn[v, u] == 0)


def _solve(
    f: NDArray[np.intp],
    side: NDArray[np.intp],
    g: Array,
    e: Array,
    weight: Array,
    count: int,
    gate: float,
) -> tuple[Array, Array, Array]:
    """Fit each feature's two unknowns by iteratively reweighted least squares.

    ``f``, ``side``: (n,) feature and side of each point, see ``_match``. ``g``, ``e``: (n, 2) slope
    and (n,) offset of each point, see ``_match``. ``weight``: (n,) weight of each point. ``count``:
    number F of features. ``gate``: initial scale of the Geman-McClure weight [pixel].

    Returns the unknowns (F, 2), their covariances (F, 2, 2), and the weights (F, 2) of both sides.
    """

    def total(values: Array) -> Array:
        """Return the sums (F,) over each feature's points of values (n,)."""
        return np.asarray(np.bincount(f, values, count), dtype=np.float64)

    solution = np.zeros((count, 2))
    for k in range(HAND.rounds):
        residual = e - np.einsum("nk,nk->n", g, solution[f])
        # Geman-McClure weight with a scale that shrinks to 2 pixels.
        w = weight / (1.0 + (residual / max(2.0, gate / 3.0**k)) ** 2) ** 2
        N = np.empty((count, 2, 2))
        N[:, 0, 0], N[:, 1, 1] = total(w * g[:, 0] ** 2) + 1e-9, total(w * g[:, 1] ** 2) + 1e-9
        N[:, 0, 1] = N[:, 1, 0] = total(w * g[:, 0] * g[:, 1])
        right = np.column_stack([total(w * e * g[:, 0]), total(w * e * g[:, 1])])
        solution[:] = np.linalg.solve(N, right[..., None])[..., 0]
    residual = e - np.einsum("nk,nk->n", g, solution[f])
    variance = total(w * residual**2) / np.maximum(total(w), 1e-9)
    noise = np.maximum(variance, HAND.edge_deviation**2) * HAND.correlation
    sides = np.column_stack([total(w * (side == one)) for one in range(2)])
    return solution, noise[:, None, None] * np.linalg.inv(N), sides


class HandMeasurement(NamedTuple):
    """The measurement of a hand in a silhouette."""

    y: Array  # (m,) as in ``HandObservation``, NaN where hidden.
    covariance: Array  # (m, m) of its noise.
    rough: Array  # (n,) the pose to which the edge was matched.
    # Area in which the silhouette differs from this pose's, as a fraction of its own.
    difference: float


@dataclass(frozen=True, eq=False)
class HandSilhouette:
    """Measures a hand in an unlabelled silhouette: figure 17.

    A rough pose (the prediction, corrected by the measurements it leads to) assigns edge points to
    segments. If its silhouette differs too much, poses around the prediction are searched.
    """

    belief_filter: TruncatedFilter  # A filter of a ``HandObservation`` and its hand's state.
    # width, height: of the image [pixel].
    width: int
    height: int
    center: tuple[float, float]  # (2,) image point that is the origin of the state [pixel].
    # Largest difference of a rough pose without search, as a fraction of the silhouette.
    well_matched: float = 0.045
    unmatched: float = 0.25  # Largest difference of a rough pose at which anything is measured.

    def draw(self, x: Array, zoom: float = 1.0) -> NDArray[np.uint8]:
        """Return (zoom H, zoom W), 1 in the hand at x (n,): a convex palm and round-ended rods."""
        picture = np.zeros((round(zoom * self.height), round(zoom * self.width)), dtype=np.uint8)
        palm, points, radii = self._outline(x)
        # OpenCV takes sixteenths of pixels, and draws a quarter of a pixel too much.
        palm, points = (16 * (zoom * (uv + 0.5) - 0.5) for uv in (palm, points))
        # A round end is a polygon.
        angles = np.arange(24) * (np.pi / 12.0)
        rim = np.column_stack([np.cos(angles), np.sin(angles)])
        rims = 16 * zoom * (radii - 0.25)[..., None, None] * rim
        rims += points[: radii.size].reshape(*radii.shape, 1, 2)
        rods = np.concatenate([rims[:, :-1], rims[:, 1:]], axis=2).reshape(-1, 2 * len(rim), 2)
        for part in (palm, *rods):
            hull = cv2.convexHull(np.round(part).astype(np.int32))
            cv2.fillConvexPoly(picture, hull, 1, shift=4)
        return picture

    def measure(
        self, mask: Mask, prediction: Belief, scale: float | None = None
    ) -> HandMeasurement:
        """Measure lines and tips in a silhouette, near a prediction.

        All measurements are NaN if the mask is empty or differs too much from the best rough pose.

        ``mask``: (H, W) the hand's silhouette. ``prediction``: belief of the state before the
        measurement. ``scale``: known image scale, the squared norm of the quaternion; None:
        unknown. Raises MaskError: the mask has another size.
        """
        if mask.shape != (self.height, self.width):
            raise MaskError(
                f"a mask of {mask.shape[::-1]} pixels, {(self.width, self.height)} expected"
            )
        edge = find_edge_points(mask, HAND.spacing)
        if not len(edge.uv):
            nothing = np.full(len(self._observation.names), np.nan)
            return HandMeasurement(nothing, np.diag(nothing), prediction.mean, 1.0)
        found = self._follow(mask, edge, prediction, prediction.mean, HAND.gates[2:], scale)
        if found.difference > self.well_matched:
            for seed in range(HAND.searches):
                for x in self._search(mask, prediction, seed):
                    other = self._follow(mask, edge, prediction, x, HAND.gates, scale)
                    found = min(found, other, key=lambda one: one.difference)
                if found.difference <= self.well_matched:
                    break
        if found.difference > self.unmatched:
            return found._replace(y=np.full(len(found.y), np.nan))
        return found

    def _outline(self, x: Array) -> tuple[Array, Array, Array]:
        """Return palm (2 K, 2), points (p, 2) and fingers' radii (F, J + 1) in the image [pixel].

        ``x``: (n,) the state. The points are those of ``HandObservation.drawing``.
        """
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
        """The hand's fingers and palm."""
        return self._observation.hand

    @property
    def _observation(self) -> HandObservation:
        """The filter's observation."""
        observation = self.belief_filter.observation
        assert isinstance(observation, HandObservation)
        return observation

    @property
    def _unit(self) -> float:
        """Ratio of the fingers' mean radius to ``reference_radius``."""
        radius = float(np.mean(self._hand.radii))
        return radius * self._observation.pixels_per_metre / HAND.reference_radius

    def _rough(self, x: Array) -> RoughBody:
        """Return the image of the hand at a state x (n,)."""
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
        """Measure near a rough state x (n,).

        The measurements of each gate but the last correct x; those of the last are returned.

        ``mask``: (H, W) the silhouette. ``edge``: its edge points. ``prediction``: belief of the
        state before the measurement. ``gates``: largest distance between edge points and the rough
        body, by iteration [pixel at ``reference_radius``]. ``scale``: known image scale; None:
        unknown.
        """
        observation, names = self._observation, self._observation.names
        at, prior = names.index("scale"), self._hand.prior
        lines = slice(at - 2 * len(self._hand.line_ends), at)
        tips = [
            [names.index(f"point_{i}{self._hand.joints[-1]}_{axis}") for axis in "xy"]
            for i in self._hand.fingers
        ]
        for k, gate in enumerate(gates):
            axes = match_axes(edge, self._rough(x), self._unit * gate, self.center)
            y, R = np.full(len(names), np.nan), np.diag(observation.variances)
            y[lines], R[lines, lines] = axes.lines.ravel(), block_diag(*axes.line_covariances)
            for rows, tip, covariance in zip(tips, axes.tips, axes.tip_covariances, strict=True):
                y[rows], R[np.ix_(rows, rows)] = tip, covariance
            y[[names.index(name) for name in self._hand.hidden]] = np.nan
            self._add_hidden_points(x, mask, edge, y, R)
            y[at] = math.nan if scale is None else scale
            if prior is not None:
                y[at + 1 :] = prior.mean
            if k < len(gates) - 1:
                x = self.belief_filter.estimate_roughly(prediction, y, R, x)
        wrong = np.count_nonzero(self.draw(x) != mask)
        return HandMeasurement(y, R, x, wrong / np.count_nonzero(mask))

    def _add_hidden_points(
        self, x: Array, mask: Mask, edge: EdgePoints, y: Array, R: Array
    ) -> None:
        """Add measurements to y (m,) and R (m, m) that keep hidden joints inside the silhouette.

        Joints and tips of the hand at x (n,) that are outside the mask and not measured yet are
        measured inside its nearest edge point.
        """
        _, points, radii = self._outline(x)
        for k, (point, radius) in enumerate(zip(points, radii.ravel(), strict=False)):
            rows = slice(2 + 2 * k, 4 + 2 * k)
            u, v = np.clip(np.rint(point), 0, (self.width - 1, self.height - 1)).astype(int)
            if mask[v, u] or np.isfinite(y[rows]).any():
                continue
            nearest = edge.uv[np.argmin(np.sum((edge.uv - point) ** 2, axis=1))]
            away = (point - nearest) / max(float(np.linalg.norm(point - nearest)), 1.0)
            y[rows] = nearest - 0.5 * radius * away - self.center
            # The position along the edge is unknown.
            along = HAND.along**2 * np.eye(2) + (HAND.inside**2 - HAND.along**2) * np.outer(
                away, away
            )
            R[rows, rows] = radius**2 * along

    def _search(self, mask: Mask, prediction: Belief, seed: int) -> Array:
        """Return states (k, n) near a prediction with the best silhouettes: cross-entropy search.

        At most ``HAND.tracked`` states, best first, with the prediction's scale.

        ``mask``: (H, W) the silhouette. ``prediction``: belief of the state, from which the first
        poses are drawn. ``seed``: seed of the random numbers.
        """
        size = (round(HAND.zoom * self.width), round(HAND.zoom * self.height))
        small = cv2.resize(mask.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        generator, mean = np.random.default_rng(seed), prediction.mean
        rows = self.belief_filter.inequalities
        visible, hand = self._hand.visible, self._hand
        turn = hand.layout.indices(QUATERNION)
        widest = np.repeat(
            (
                self._unit * HAND.wrist_deviation,
                HAND.turn_deviation,
                HAND.angle_deviation,
                HAND.length_deviation,
            ),
            (2, 4, len(hand.angles), len(hand.layout.constant)),
        )
        narrowed = np.minimum(1.0, widest / np.maximum(prediction.deviations()[visible], 1e-12))
        P = prediction.covariance[np.ix_(visible, visible)] * np.outer(narrowed, narrowed)
        spread, elite = np.sqrt(np.diag(P)), mean[None]
        for k in range(HAND.search_rounds):
            poses = np.tile(mean, (HAND.poses, 1))
            poses[:, visible] += generator.normal(size=(HAND.poses, len(visible))) @ factor_of(P).T
            poses[: len(elite)] = elite
            norms = np.linalg.norm(poses[:, turn], axis=1, keepdims=True)
            poses[:, turn] *= np.linalg.norm(prediction.mean[turn]) / norms
            for phi, b in zip(rows.phi, rows.b, strict=True):
                beyond = np.maximum(poses @ phi - b, 0.0)
                poses -= np.outer(beyond, phi / (phi @ phi))
            wrong = [np.count_nonzero(self.draw(x, HAND.zoom) != small) for x in poses]
            elite = poses[np.argsort(wrong)[: HAND.elite]]
            mean = elite.mean(axis=0)
            off = (elite - mean)[:, visible]
            P = off.T @ off / len(off) + np.diag((0.15 * spread) ** 2) * 0.5**k
        return elite[: HAND.tracked]
