"""Search for a lost limb or a lost person: the best of many coarse guesses are fitted.

Guesses are ranked in subsampled silhouettes of at most five cameras; only the most promising ones
are fitted to all cameras.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Indices, Mask, halton_sequence
from drake_pose.body import landmarks_of_nodes, load_landmarks
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import ContourFit, PoseFit, Prior
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.person.views import FrameViews, sum_at_points
from drake_pose.silhouette.scoring import draw_mask

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
    step_fraction: float = 0.7  # Fraction of the last frame's step that is predicted for the next.
    # angle_deviation, length_deviation: standard deviations of the prediction [rad, m].
    angle_deviation: float = 0.3
    length_deviation: float = 0.15
    # Limbs are searched again where the inlier ratio is below the usual one by this.
    retry_below: float = 0.03
    lost_below: float = 0.75  # The person is lost below this fraction of the usual inlier ratio.
    memory: float = 60.0  # Number of frames over which the usual inlier ratio is averaged.
    usual_ratio: float = 0.95  # Usual inlier ratio at the start.
    shape_frames: int = 40  # Number of first frames from which a person's shape is fitted.
    headings: int = 12  # Number of headings, evenly spread, in which a lost person is searched.
    headings_per_frame: int = 3  # Number of them in each frame of a sequence.
    limbs_per_frame: int = 2  # Number of doubtful limbs searched in each frame of a sequence.
    min_limb_ratio: float = 0.8  # A limb is doubtful below this inlier ratio of its contour.
    # Fraction of the fresh starts that is fitted, the most promising first.
    fitted_fraction: float = 0.5
    searched_starts: int = 3  # Number of fresh starts whose doubtful limbs are searched.
    # Limb poses with tips farther apart than this are distinct [m].
    distinct_distance: float = 0.25
    # Limb poses with no point farther apart than this are about the same [m].
    same_distance: float = 0.15
    # The limbs of an alternative pose are searched before it is compared if its closeness is lower
    # by at most this.
    alternative_margin: float = 0.15
    # An alternative pose is as good if its closeness is lower by at most this; chosen on 36 drawn
    # persons of other measures and clothes before four cameras.
    ambiguity_margin: float = 0.02
    ranking_stages: int = 3  # Number of fit stages after which guesses are ranked.
    ranking_spacing: float = 1.5  # Factor on the spacing of contour points in these stages.

    @property
    def cycle(self) -> int:
        """Number of frames in which all headings are tried."""
        return self.headings // self.headings_per_frame

    def headings_of(self, frame: int) -> list[int]:
        """Return the indices of headings tried in troubled `frame` (modulo `cycle`), all around."""
        # The bit-reversed order puts neighbouring headings late.
        order = sorted(range(self.cycle), key=lambda k: f"{k:032b}"[::-1])
        return list(range(order[frame % self.cycle], self.headings, self.cycle))


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

    nodes: Indices  # (j,) indices of the nodes that only this limb has.
    values: Indices  # (k,) indices of the pose tree's values that move these nodes alone.
    joints: Indices  # (3,) indices of root, middle joint and end among the landmarks.
    poses: Array  # (n, k) these values in n poses between their limits; the first is at rest [rad].
    samples_T: Array  # (n, m, 3) points along the limb in the trunk's frame in each pose [m].
    weights: Array  # (n, m) weights of the points.


class BodyPlan:
    """Limbs and trunk of a person's pose tree.

    Attributes:
        along: places of the points on a limb: 0 at the root, 1 at the middle joint, 2 at the end;
            the middle of a hand or foot lies beyond 2.
        trunk: index of the node that the limbs hang on.
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
        self.trunk = self._node("neck")
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

    def _node(self, landmark: str) -> int:
        """Return the index of a landmark's node."""
        return int(self.landmarks.nodes[self.landmarks.names.index(landmark)])

    def _plan(self, names: Sequence[str], count: int = 2048) -> PlannedLimb:
        """Plan a limb from its three landmarks' names, from root to end, in `count` poses.

        The middle joint is at rest, mostly stretched, in one of eight poses.
        """
        kinematics, tree = self.kinematics, self.kinematics.tree
        rest = kinematics.flatten(tree.default_values())
        moves = kinematics.motions(rest).moves
        end = self._node(names[2])
        own = moves[end] & ~moves[self._node("neck")]
        free = kinematics.is_angle & (kinematics.upper > kinematics.lower)
        values = np.flatnonzero(own & free)
        nodes = np.flatnonzero((moves & own).any(axis=1))
        fractions = halton_sequence(count, len(values))
        lower, upper = (ends[values] for ends in kinematics.local_limits(rest))
        poses = np.clip(rest[values], lower, upper) * np.ones((count, 1))
        poses[1:] = lower + fractions[1:] * (upper - lower)
        # People stretch their limbs more often than uniformly drawn angles do.
        stretched = np.flatnonzero(kinematics.value_nodes[values] == end)
        poses[np.ix_(np.arange(count // 8), stretched)] = poses[0, stretched]
        joints = np.array([self.landmarks.names.index(name) for name in names])
        posed = np.tile(rest, (count, 1))
        posed[:, values] = poses
        each = [own.T for own in kinematics.split(posed.T)]
        X_WN = np.tile(tree.node_poses(kinematics.split(rest)), (count, 1, 1, 1))
        for node in nodes.tolist():
            X_PN = tree.relative_transforms(node, each[tree.source(node)])
            X_WN[:, node] = X_WN[:, tree.nodes[node].parent] @ X_PN
        X_WT = X_WN[0, self.trunk]
        samples_W = self._samples(joints, X_WN).reshape(-1, 3)
        samples_T = ((samples_W - X_WT[:3, 3]) @ X_WT[:3, :3]).reshape(count, -1, 3)
        weights = crowding_weights(samples_T)
        return PlannedLimb(nodes, values, joints, poses, samples_T, weights)

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
    """Searches limbs and persons by fits from coarse guesses.

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

    def improve_limbs(
        self,
        fitted: PoseFit,
        frame: FrameViews,
        enough: float = math.inf,
        first: int = 0,
        limbs: int | None = None,
    ) -> PoseFit:
        """Refine a fit and search its doubtful limbs again; keep what is better.

        Args:
            fitted, frame: fit to begin with, and the silhouettes.
            enough: the search ends at this inlier ratio.
            first: index of the doubtful limb to begin with, modulo their number; 0 is the worst.
            limbs: number of limbs searched; None: all doubtful ones.
        """
        best = _better(fitted, self.refine(fitted.values, frame))
        if best.inlier_ratio >= enough:
            return best
        doubtful = self._doubtful_limbs(best, frame)
        begin = first % len(doubtful)
        chosen = (doubtful[begin:] + doubtful[:begin])[:limbs]
        return self._search_limbs(best, chosen, frame, enough)

    def _search_limbs(
        self, best: PoseFit, limbs: Iterable[PlannedLimb], frame: FrameViews, enough: float
    ) -> PoseFit:
        """Search limbs again, one after another, until the inlier ratio is `enough`.

        `best` is the fit to begin with; the fit with the highest closeness is returned.
        """
        for limb in limbs:
            scores, _ = self._score_poses(best.values, limb, frame)
            guesses = self._distinct_poses(best.values, limb, scores, 2)
            # It may be bent the wrong way: try it at rest, and the most relaxed pose nearby.
            X_WN = self._fit.kinematics.poses(best.values)
            distances = self._distances(best.values, limb, self._plan.samples(limb, X_WN))
            near = limb.poses[distances < self._settings.same_distance]
            effort = np.abs(near - limb.poses[0]).sum(axis=1)
            for pose in (limb.poses[0], *near[np.argsort(effort, kind="stable")[:1]]):
                guesses.append(best.values.copy())
                guesses[-1][limb.values] = pose
            for values in guesses:
                best = _better(best, self.refine(values, frame))
            if best.inlier_ratio >= enough:
                break
        return best

    def find_person(
        self,
        frame: FrameViews,
        headings: Sequence[int],
        known: Array | None = None,
        enough: float = math.inf,
    ) -> PoseFit | None:
        """Return the best fit from fresh starts; None where fewer than two cameras see a person.

        Args:
            frame: silhouettes.
            headings: indices of headings, out of the settings' number evenly spread. If not all,
                only the best start's limbs are searched, and no similar poses.
            known: (m,) values from which held ones are taken; None: the person's at rest.
            enough: inlier ratio at which no more limbs are searched, if not all headings are.
        """
        if len(headings) == self._settings.headings:
            return next(iter(self.find_explanations(frame, known)), None)
        starts = self._fresh_starts(frame, headings, known)
        limbs = self._settings.limbs_per_frame
        return self.improve_limbs(starts[0], frame, enough, limbs=limbs) if starts else None

    def find_explanations(self, frame: FrameViews, known: Array | None = None) -> list[PoseFit]:
        """Return distinct poses that explain a frame, best first.

        The doubtful limbs of each are searched before they are compared. Empty where fewer than
        two cameras see a person; `known` as in `find_person`.
        """
        found, best = self.find_starts(frame, known), None
        while found and best is not (leading := max(found, key=lambda one: one.closeness)):
            best = leading
            others = [self.refine(values, frame) for values in self._similar_poses(best.values)]
            least = best.closeness - self._settings.alternative_margin
            found += [self.improve_limbs(one, frame) for one in others if one.closeness > least]
        if best is not None:
            found.append(self._search_limbs(best, self._plan.limbs.values(), frame, math.inf))
        return self.distinct(found)

    def find_starts(self, frame: FrameViews, known: Array | None = None) -> list[PoseFit]:
        """Return the best fresh starts of all headings, after a search of their doubtful limbs.

        At most `searched_starts`; [] where fewer than two cameras see a person.
        """
        starts = self._fresh_starts(frame, range(self._settings.headings), known)
        return [self.improve_limbs(one, frame) for one in starts[: self._settings.searched_starts]]

    def distinct(self, fits: Iterable[PoseFit]) -> list[PoseFit]:
        """Return the fits that differ from all better ones, best first.

        From each better one some landmark must be more than `distinct_distance` away.
        """
        found: list[PoseFit] = []
        kept: list[Array] = []
        for one in sorted(fits, key=lambda one: -one.closeness):
            places = self._plan.landmarks.positions(self._fit.kinematics.poses(one.values))
            off = [np.linalg.norm(places - other, axis=-1).max() for other in kept]
            if all(far > self._settings.distinct_distance for far in off):
                found.append(one)
                kept.append(places)
        return found

    def _fresh_starts(
        self, frame: FrameViews, headings: Sequence[int], known: Array | None
    ) -> list[PoseFit]:
        """Fit the most promising fresh starts with some headings (indices), best first.

        Arguments as of `find_person`. [] where fewer than two cameras see a person.
        """
        middle = frame.middle()
        if middle is None:
            return []
        guesses = [self._guess(frame, heading, middle, known) for heading in headings]
        guesses.sort(key=lambda one: -one.closeness)
        promising = guesses[: math.ceil(self._settings.fitted_fraction * len(guesses))]
        fitted = [self.refine(one.values, frame) for one in promising]
        return sorted(fitted, key=lambda one: -one.closeness)

    def _guess(
        self, frame: FrameViews, heading: int, middle: Array, known: Array | None
    ) -> PoseFit:
        """Guess a pose in a heading: fit the trunk roughly, then place each limb.

        `heading` is its index out of `headings`; `middle` (3,) is where the trunk's middle is put
        first [m]; `known` as in `find_person`.
        """
        values = self._rest.copy() if known is None else np.where(self._held, known, self._rest)
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
        """Fit from values (m,) to the scoring cameras, by a few stages with fewer points."""
        prior, coarser = Prior(values, 0.1 * self._information), self._settings.ranking_spacing
        ranking = self._settings.search[: self._settings.ranking_stages]
        stages = [replace(one, spacing=coarser * one.spacing) for one in ranking]
        return self._fit.fit(frame.scoring_edges, values, stages, prior, self._held)

    def refine(self, values: Array, frame: FrameViews) -> PoseFit:
        """Fit a frame from a coarse guess (m,), with a weak prior about it."""
        prior, stages = Prior(values, 0.1 * self._information), self._settings.search
        return self._fit.fit(partial(frame.compare, self._fit), values, stages, prior, self._held)

    def _doubtful_limbs(self, fitted: PoseFit, frame: FrameViews) -> list[PlannedLimb]:
        """Return the limbs that fit badly, those that would cover more elsewhere first.

        The worst limb is always among them. `fitted` is a fit to `frame`.
        """
        lengths, fitting = fitted.sums[:, [Sum.COMPARED, Sum.FITTING]].T
        ratios = np.where(lengths > 0.0, fitting / np.maximum(lengths, 1e-9), 1.0)
        found = []
        for limb in self._plan.limbs.values():
            ratio = ratios[limb.nodes].min()
            scores, now = self._score_poses(fitted.values, limb, frame)
            gain = float(scores.max() - now)
            found.append((ratio >= self._settings.min_limb_ratio, ratio - gain, limb))
        found.sort(key=lambda one: one[:2])
        return [limb for k, (good, _, limb) in enumerate(found) if k == 0 or not good]

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
        X_WT = X_WN[self._plan.trunk]
        placed = limb.samples_T.reshape(-1, 3) @ X_WT[:3, :3].T + X_WT[:3, 3]
        places = np.asarray(placed.reshape(limb.samples_T.shape))
        here = self._plan.samples(limb, X_WN)[None]
        scores, now, weights = np.zeros(len(places)), 0.0, crowding_weights(here)
        for camera, region in zip(*frame.scoring_regions, strict=True):
            # 1 in the silhouette where no other node shows, 0 where one does, -1 outside.
            pixel_scores = np.where(region, 1, -1).astype(np.int8)
            pixel_scores[region & draw_mask(outlines, camera.X_CW @ X_WN[others], camera)] = 0
            scores += sum_at_points(camera, pixel_scores, places, limb.weights)[0]
            now += float(sum_at_points(camera, pixel_scores, here, weights)[0][0])
        return scores / len(frame.scoring), now / len(frame.scoring)

    def _distinct_poses(
        self, values: Array, limb: PlannedLimb, scores: Array, count: int
    ) -> list[Array]:
        """Return values (m,) for the `count` distinct poses of a limb with the best scores (n,).

        Other values are those of `values` (m,). Fewer are returned if fewer are distinct.
        """
        found: list[Array] = []
        tips: list[Array] = []
        for index in np.argsort(-scores):
            tip = limb.samples_T[index, -1]
            distances = [np.linalg.norm(tip - other) for other in tips]
            if min(distances, default=math.inf) > self._settings.distinct_distance:
                tips.append(tip)
                found.append(values.copy())
                found[-1][limb.values] = limb.poses[index]
                if len(found) == count:
                    break
        return found

    def _similar_poses(self, values: Array) -> list[Array]:
        """Return values (m,) of similar silhouettes: arms, legs, or front and back exchanged."""
        plan, found = self._plan, []
        X_WN = self._fit.kinematics.poses(values)
        for turn, parts in ((0.0, ("arm",)), (0.0, ("leg",)), (math.pi, ("arm", "leg"))):
            other = values.copy()
            if turn and plan.heading is not None:
                other[plan.heading] += turn
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

        `values` is the pose that places the trunk; `samples_W` (m, 3) are the given points in the
        world, from the root to the end of any limb [m].
        """
        X_WT = self._fit.kinematics.poses(values)[self._plan.trunk]
        samples_T = (samples_W - X_WT[:3, 3]) @ X_WT[:3, :3]
        return np.asarray(np.linalg.norm(limb.samples_T - samples_T, axis=2).max(axis=1))

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
