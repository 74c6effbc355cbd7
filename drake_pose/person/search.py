"""Search for a lost limb or a lost person: the best of many coarse guesses are fitted.

Guesses are ranked in subsampled silhouettes of at most five cameras; only the most promising ones
are fitted to all cameras.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from drake_pose.arrays import Array, Indices, Mask, halton_sequence
from drake_pose.body import landmarks_of_nodes, load_landmarks
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import ContourFit, PoseFit, Prior
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.judge import LEVEL
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.person.views import FrameViews, sum_at_points
from drake_pose.silhouette.scoring import draw_mask

SIGNIFICANT = float(ndtri(1.0 - LEVEL))
"""Number of standard deviations from which a difference is no noise."""

PERSON_LANDMARKS = (
    "neck",
    *(
        f"{side}_{joint}"
        for side in ("left", "right")
        for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    ),
)
"""The anatomical joint centres that landmarks.yaml of a person's model must have."""


@dataclass(frozen=True, kw_only=True)
class PersonSettings:
    """How a person is tracked, and searched where lost."""

    # follow, search: stages of a frame's fit from the predicted pose, and from a coarse guess.
    follow: tuple[AnnealingStage, ...]
    search: tuple[AnnealingStage, ...]
    persistence: float = 1.3  # Of a motion [frames].
    # angle_deviation, length_deviation: standard deviations of the prediction [rad, m]; the first
    # also of waist, clavicles, wrists and ankles about rest, in a search.
    angle_deviation: float = 0.3
    length_deviation: float = 0.15
    memory: float = 60.0  # Number of frames over which the usual misfit is averaged.
    headings: int = 12  # Number of headings, evenly spread, in which a person is searched.
    searched_starts: int = 6  # Number of them in which doubtful limbs are searched.
    # Poses are distinct if a landmark, or a limb's end, is farther apart than this [m].
    distinct_distance: float = 0.25


def _stages(*pairs: tuple[float, float]) -> tuple[AnnealingStage, ...]:
    """Return stages of (scale, spacing of contour points) [m]."""
    return tuple(AnnealingStage(scale, spacing) for scale, spacing in pairs)


EXACT = PersonSettings(
    follow=_stages((0.08, 0.06), (0.04, 0.06), (0.02, 0.05)),
    search=_stages(
        (0.15, 0.06), (0.1, 0.06), (0.07, 0.06), (0.05, 0.06), (0.03, 0.05), (0.02, 0.05)
    ),
)
"""For a model that is exactly the person's."""

LENIENT = PersonSettings(
    follow=_stages((0.1, 0.06), (0.07, 0.05), (0.05, 0.05), (0.04, 0.04)),
    search=_stages(
        (0.2, 0.06), (0.15, 0.06), (0.1, 0.06), (0.07, 0.05), (0.05, 0.05), (0.04, 0.04)
    ),
)
"""For a model that only resembles the person, to within centimetres."""


class PlannedLimb(NamedTuple):
    """An arm or leg of a pose tree."""

    base: int  # Index of the node that the limb hangs on.
    nodes: Indices  # (j,) indices of the nodes that only this limb has.
    # (k,) indices of the pose tree's angles that move the limb's end, but not its root.
    values: Indices
    joints: Indices  # (3,) indices of root, middle joint and end among the landmarks.
    poses: Array  # (n, k) these values in n poses between their limits; the first is at rest [rad].
    # (n, m, 3) points along the limb in each pose [m], from its root along the base's axes.
    samples_B: Array
    weights: Array  # (n, m) weights of the points.


class BodyPlan:
    """Limbs and trunk of a person's pose tree.

    Attributes:
        along: places of the points on a limb: 0 at the root, 1 at the middle joint, 2 at the end;
            the middle of a hand or foot lies beyond 2.
        heading: index of the value that turns the whole body about the vertical; None: none does.

    Raises:
        ModelError: the model lacks landmarks of trunk, arms or legs.
    """

    along = np.array([0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.25])

    def __init__(self, kinematics: TreeKinematics) -> None:
        self.kinematics = kinematics
        tree = kinematics.tree
        landmarks = load_landmarks(tree.model.path)
        missing = sorted(set(PERSON_LANDMARKS) - set(landmarks))
        if missing:
            raise ModelError(
                f"{tree.model.path}: landmarks.yaml lacks {', '.join(missing)}, which the capture "
                "of a person by its silhouettes needs"
            )
        self.landmarks = landmarks_of_nodes(tree, landmarks)
        # Whether each value bends the waist, a clavicle, wrist or ankle: no limb and no root (m,).
        motions = kinematics.motions(kinematics.flatten(tree.default_values()))
        neck = self.landmarks.nodes[self.landmarks.names.index("neck")]
        self.is_posture = kinematics.is_angle & ~motions.moves[neck]
        for limb in self.limbs.values():
            self.is_posture[limb.values] = False
        # Whether each angle tilts a part that is no limb (m,): its axis is horizontal at rest.
        self.tilts = kinematics.is_angle & (np.abs(motions.twists[: len(self.is_posture), 2]) < 0.5)
        for limb in self.limbs.values():
            self.tilts[limb.values] = False
        free = np.flatnonzero(kinematics.covers_full_turn)
        self.heading = int(free[0]) if len(free) else None

    def trunk_middle(self, X_WN: Array) -> Array:
        """Return the point (3,) half-way between neck and hips in the world [m]."""
        places = dict(zip(self.landmarks.names, self.landmarks.positions(X_WN), strict=True))
        hips = 0.5 * (places["left_hip"] + places["right_hip"])
        return np.asarray(0.5 * (places["neck"] + hips))

    @cached_property
    def limbs(self) -> dict[str, PlannedLimb]:
        """The four limbs by name: left_arm, right_arm, left_leg, right_leg."""
        kinds = {"arm": ("shoulder", "elbow", "wrist"), "leg": ("hip", "knee", "ankle")}
        return {
            f"{side}_{kind}": self._plan([f"{side}_{joint}" for joint in joints])
            for kind, joints in kinds.items()
            for side in ("left", "right")
        }

    def _plan(self, names: Sequence[str], count: int = 2048) -> PlannedLimb:
        """Plan a limb from its three landmarks' names, from root to end, in `count` poses.

        The middle joint is at rest, mostly stretched, in one of eight poses.
        """
        kinematics, tree = self.kinematics, self.kinematics.tree
        rest = kinematics.flatten(tree.default_values())
        lower, upper = kinematics.local_limits(rest)
        # At rest, stretched, an axis along the limb may not move its end.
        bent = kinematics.motions(np.where(kinematics.is_angle, 0.5 * (lower + upper), rest))
        joints = np.array([self.landmarks.names.index(name) for name in names])
        places = self.landmarks.positions(bent.X_WN)[joints]
        turning, shift = bent.twists[: len(rest), :3], bent.twists[: len(rest), 3:6]
        moves = bent.moves[:, : len(rest)]
        moved = [
            moves[node] & (np.linalg.norm(np.cross(turning, p) + shift, axis=1) > 1e-6)
            for node, p in zip(self.landmarks.nodes[joints], places, strict=True)
        ]
        own = moved[2] & ~moved[0] & kinematics.is_angle & (kinematics.upper > kinematics.lower)
        values = np.flatnonzero(own)
        nodes = np.flatnonzero((moves & own).any(axis=1))
        fractions = halton_sequence(count, len(values))
        poses = np.clip(rest[values], lower[values], upper[values]) * np.ones((count, 1))
        poses[1:] = lower[values] + fractions[1:] * (upper - lower)[values]
        # People stretch their limbs more often than uniformly drawn angles do.
        stretched = np.flatnonzero(~moved[1][values])
        poses[np.ix_(np.arange(count // 8), stretched)] = poses[0, stretched]
        posed = np.tile(rest, (count, 1))
        posed[:, values] = poses
        each = [own.T for own in kinematics.split(posed.T)]
        X_WN = np.tile(tree.node_poses(kinematics.split(rest)), (count, 1, 1, 1))
        for node in nodes.tolist():
            X_PN = tree.relative_transforms(node, each[tree.source(node)])
            X_WN[:, node] = X_WN[:, tree.nodes[node].parent] @ X_PN
        base = tree.nodes[nodes[0]].parent
        root = self.landmarks.positions(X_WN[0])[joints[0]]
        samples_B = (self._samples(joints, X_WN) - root) @ X_WN[0, base, :3, :3]
        return PlannedLimb(
            base, nodes, values, joints, poses, samples_B, crowding_weights(samples_B)
        )

    def frame(self, limb: PlannedLimb, X_WN: Array) -> tuple[Array, Array]:
        """Return R_WB (3, 3) of a limb's base and its root (3,) in the world [m]."""
        return X_WN[limb.base, :3, :3], self.landmarks.positions(X_WN)[limb.joints[0]]

    def samples(self, limb: PlannedLimb, X_WN: Array) -> Array:
        """Return points (m, 3) along a limb in the world [m], nodes at X_WN (nodes, 4, 4)."""
        return self._samples(limb.joints, X_WN[None])[0]

    def _samples(self, joints: Indices, X_WN: Array) -> Array:
        """Return points (n, m, 3) [m] along a limb of landmarks (3,), X_WN (n, nodes, 4, 4)."""
        a, b, c = np.moveaxis(self.landmarks.positions(X_WN)[:, joints], 1, 0)
        upper = np.minimum(self.along, 1.0)[:, None]
        lower = np.maximum(self.along - 1.0, 0.0)[:, None]
        steps = upper * (b - a)[:, None] + lower * (c - b)[:, None]
        return np.asarray(a[:, None] + steps)


def crowding_weights(samples: Array, apart: float = 0.08) -> Array:
    """Return weights (n, m) of m points along a limb in n poses: 1 / (m times the number nearby).

    `samples` (n, m, 3) [m] of a pose that are nearer than `apart` [m] fill the same space.
    """
    x, y, z = (own[:, :, None] - own[:, None] for own in np.moveaxis(samples, 2, 0))
    near = x * x + y * y + z * z < apart**2
    return np.asarray(1.0 / (near.sum(axis=2) * samples.shape[1]))


class PersonSearch:
    """Searches limbs and persons by fits from coarse guesses, and compares fits by likelihood.

    Args:
        fit: the person's body with the noise of its contours.
        plan: its limbs.
        information: (m,) inverse variances of the values about a prediction [1/rad^2, 1/m^2]; a
            tenth counts about a guess.
        held: (m,) which values stay fixed.
        rest: (m,) values of the person at rest, held values included [rad, m].
    """

    def __init__(
        self,
        fit: ContourFit,
        plan: BodyPlan,
        settings: PersonSettings,
        information: Array,
        held: Mask,
        rest: Array,
    ) -> None:
        self._fit, self._plan, self._settings = fit, plan, settings
        self._information, self._held, self._rest = information, held, rest

    def misfit(self, sums: Array) -> tuple[Array, Array]:
        """Return costs (...,) over what noise gives, and their standard deviations by noise.

        ``sums``: (..., 6) by ``Sum``. Along each of both contours, errors are independent at
        intervals of the correlation length, so costs have a chi-squared distribution.
        """
        count = 0.5 * sums[..., Sum.COMPARED] / np.mean(self._fit.noise.correlation)
        count = np.maximum(count, 1.0)
        return sums[..., Sum.COST] / count, np.sqrt(2.0 / count)

    def advantage(
        self,
        one: PoseFit,
        other: PoseFit,
        frame: FrameViews,
        expected: Array | None = None,
        own: "PersonSearch | None" = None,
    ) -> float:
        """Return by how many standard deviations of noise a fit explains a frame better than other.

        ``expected``: (m,) values that the last frames predict, which count, too; None: none.
        ``own``: has the other's shape; None: it is the same.
        """
        step, pairs = self._settings.search[-1], ((own or self, other), (self, one))
        more, less = (frame.tile_costs(s._fit, fit.values, step) for s, fit in pairs)
        known = 0.0
        if expected is not None:
            off = np.array([fit.values - expected for fit in (one, other)]) ** 2 @ self._information
            known = float(off[1] - off[0])
        scatter = math.sqrt(float(((more - less) ** 2).sum()))
        return vuong_statistic(more, less) + known / max(scatter, 1.0)

    def improve_limbs(self, fitted: PoseFit, frame: FrameViews, every: bool = False) -> PoseFit:
        """Refine a fit and search its doubtful limbs, or every one, again; keep what is better."""
        best = _better(fitted, self.refine(fitted.values, frame))
        misfit, whole = self.misfit(best.sums[:-1])[0], self.misfit(best.sums.sum(axis=0))[0]
        limbs = []
        for limb in self._plan.limbs.values():
            scores, now = self._score_poses(best.values, limb, frame)
            limbs.append((float(scores.max()) - now, misfit[limb.nodes].max() > whole, limb))
        limbs.sort(key=lambda one: -one[0])
        for k, (_, is_doubtful, limb) in enumerate(limbs):
            # The limb that would explain most elsewhere is always searched.
            if k and not every and not is_doubtful:
                continue
            scores, _ = self._score_poses(best.values, limb, frame)
            guesses = self._distinct_poses(best.values, limb, scores, 2)
            # It may be bent the wrong way: try it at rest, and the most relaxed pose nearby.
            X_WN = self._fit.kinematics.poses(best.values)
            distances = self._distances(best.values, limb, self._plan.samples(limb, X_WN))
            near = limb.poses[distances < 0.5 * self._settings.distinct_distance]
            effort = np.abs(near - limb.poses[0]).sum(axis=1)
            for pose in (limb.poses[0], *near[np.argsort(effort, kind="stable")[:1]]):
                guesses.append(best.values.copy())
                guesses[-1][limb.values] = pose
            for values in guesses:
                best = _better(best, self.refine(values, frame))
        return best

    def find_starts(self, frame: FrameViews, known: Array | None = None) -> list[PoseFit]:
        """Return distinct fits from all headings, after a search of the best ones' doubtful limbs.

        ``known``: (m,) values from which held ones are taken; None: the person's at rest. The list
        is empty where fewer than two cameras see a person.
        """
        middle = frame.middle()
        if middle is None:
            return []
        rest = self._rest if known is None else np.where(self._held, known, self._rest)
        headings = range(self._settings.headings)
        fits = [self.refine(self._guess(frame, k, middle, rest).values, frame) for k in headings]
        fits.sort(key=lambda one: -one.closeness)
        chosen = fits[: self._settings.searched_starts]
        return self.distinct(self.improve_limbs(one, frame) for one in chosen)

    def distinct(self, fits: Iterable[PoseFit]) -> list[PoseFit]:
        """Return the fits that differ from all better ones, best first."""
        found: list[PoseFit] = []
        kept: list[Array] = []
        for one in sorted(fits, key=lambda one: -one.closeness):
            places = self._plan.landmarks.positions(self._fit.kinematics.poses(one.values))
            off = [np.linalg.norm(places - other, axis=-1).max() for other in kept]
            if all(far > self._settings.distinct_distance for far in off):
                found.append(one)
                kept.append(places)
        return found

    def _guess(self, frame: FrameViews, heading: int, middle: Array, rest: Array) -> PoseFit:
        """Guess a pose in a heading: fit the trunk roughly, then place each limb.

        `heading` is its index out of `headings`; `middle` (3,) is where the trunk's middle is put
        first [m]; `rest` (m,) are the values at rest.
        """
        values = rest.copy()
        if self._plan.heading is not None:
            values[self._plan.heading] = 2.0 * np.pi * heading / self._settings.headings
        values = self._fit_coarsely(self._move_trunk(values, middle), frame).values
        placed = np.ones(len(self._fit.outlines), dtype=np.bool_)
        for limb in self._plan.limbs.values():
            placed[limb.nodes] = False
        for limb in self._plan.limbs.values():
            scores, _ = self._score_poses(values, limb, frame, placed)
            values = self._distinct_poses(values, limb, scores, 1)[0]
            placed[limb.nodes] = True
        return self._fit_coarsely(values, frame)

    def _fit_coarsely(self, values: Array, frame: FrameViews) -> PoseFit:
        """Fit from values (m,) to the scoring cameras, by the coarse half of the stages."""
        stages = self._settings.search[: len(self._settings.search) // 2]
        held = self._held | self._plan.is_posture
        return self._fit.fit(frame.scoring_edges, values, stages, self._prior(values), held)

    def refine(self, values: Array, frame: FrameViews) -> PoseFit:
        """Fit a frame from a coarse guess (m,); the last stage also bends waist and shoulders."""
        prior, stages = self._prior(values), self._settings.search
        compare, held = partial(frame.compare, self._fit), self._held | self._plan.is_posture
        if self._plan.is_posture.any():
            values = self._fit.fit(compare, values, stages[:-1], prior, held).values
            stages = stages[-1:]
        return self._fit.fit(compare, values, stages, prior, self._held)

    def _prior(self, guess: Array) -> Prior:
        """Return the prior about a coarse guess (m,), which says nothing of the posture."""
        mean = np.where(self._plan.is_posture, self._rest, guess)
        return Prior(mean, np.where(self._plan.is_posture, 1.0, 0.1) * self._information)

    def _score_poses(
        self, values: Array, limb: PlannedLimb, frame: FrameViews, placed: Mask | None = None
    ) -> tuple[Array, float]:
        """Score a limb's poses by the unexplained silhouette that they cover, -1 to 1.

        ``values``: (m,) pose of the rest of the body. ``placed``: (nodes,) nodes that explain
        silhouettes; None: all but the limb's. Returns (n,) scores of the limb's poses, and that in
        `values`.
        """
        X_WN = self._fit.kinematics.poses(values)
        others = np.ones(len(X_WN), dtype=np.bool_) if placed is None else placed.copy()
        others[limb.nodes] = False
        outlines = [self._fit.outlines[node] for node in np.flatnonzero(others)]
        R_WB, root = self._plan.frame(limb, X_WN)
        places = np.ascontiguousarray(limb.samples_B @ R_WB.T + root)
        here = self._plan.samples(limb, X_WN)[None]
        scores, now, weights = np.zeros(len(places)), 0.0, crowding_weights(here)
        for camera, region in zip(*frame.scoring_regions, strict=True):
            # 1 in the silhouette where no other node shows, 0 where one does, -1 outside.
            pixel_scores = np.where(region, 1, -1).astype(np.int8)
            pixel_scores[region & draw_mask(outlines, camera.X_CW @ X_WN[others], camera)] = 0
            scores += sum_at_points(camera, pixel_scores, places, limb.weights)[0]
            now += float(sum_at_points(camera, pixel_scores, here, weights)[0][0])
        count = max(len(frame.scoring), 1)
        return scores / count, now / count

    def _distinct_poses(
        self, values: Array, limb: PlannedLimb, scores: Array, count: int
    ) -> list[Array]:
        """Return values (m,) for the `count` distinct poses of a limb with the best scores (n,).

        Other values are those of `values` (m,). Fewer are returned if fewer are distinct.
        """
        found: list[Array] = []
        tips: list[Array] = []
        for index in np.argsort(-scores):
            tip = limb.samples_B[index, -1]
            distances = [np.linalg.norm(tip - other) for other in tips]
            if min(distances, default=math.inf) > self._settings.distinct_distance:
                tips.append(tip)
                found.append(values.copy())
                found[-1][limb.values] = limb.poses[index]
                if len(found) == count:
                    break
        return found

    def similar_poses(self, values: Array) -> list[Array]:
        """Return look-alikes (m,) of a pose: arms, legs, or front and back exchanged."""
        plan, found = self._plan, []
        X_WN = self._fit.kinematics.poses(values)
        for turn, parts in ((0.0, ("arm",)), (0.0, ("leg",)), (math.pi, ("arm", "leg"))):
            other = values.copy()
            if turn and plan.heading is not None:
                # Turned about its own axis, a leaning trunk leans to its other side.
                other[plan.heading] += turn
                other[plan.tilts] *= -1.0
                other = self._move_trunk(other, plan.trunk_middle(X_WN))
            for part in parts:
                for side, other_side in (("left", "right"), ("right", "left")):
                    limb, other_limb = (
                        plan.limbs[f"{side}_{part}"],
                        plan.limbs[f"{other_side}_{part}"],
                    )
                    distances = self._distances(other, limb, plan.samples(other_limb, X_WN))
                    other[limb.values] = limb.poses[np.argmin(distances)]
            found.append(other)
        return found

    def _distances(self, values: Array, limb: PlannedLimb, samples_W: Array) -> Array:
        """Return the largest distance (n,) [m] of points in each pose of a limb from given points.

        `values` is the pose that places the base; `samples_W` (m, 3) are the given points in the
        world, from the root to the end of any limb [m].
        """
        R_WB, root = self._plan.frame(limb, self._fit.kinematics.poses(values))
        samples_B = (samples_W - root) @ R_WB
        return np.asarray(np.linalg.norm(limb.samples_B - samples_B, axis=2).max(axis=1))

    def _move_trunk(self, values: Array, middle: Array) -> Array:
        """Shift and return values (m,), so that the trunk's middle is at `middle` (3,) [m]."""
        kinematics = self._fit.kinematics
        off = middle - self._plan.trunk_middle(kinematics.poses(values))
        motions = kinematics.motions(values)
        # The root's position is three translations along the world's axes.
        for index in np.flatnonzero(~kinematics.is_angle & motions.moves[0] & ~self._held):
            values[index] += float(motions.twists[index, 3:6] @ off)
        return values


def _better(one: PoseFit, other: PoseFit) -> PoseFit:
    """Return the fit with the higher closeness."""
    return other if other.closeness > one.closeness else one
