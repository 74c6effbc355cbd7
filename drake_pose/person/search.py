"""Where a lost limb or a lost person is: coarse guesses all over, the best of them fitted.

Guesses are judged in small pictures of a few cameras; only what is promising is fitted to all.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.body import landmarks_of_nodes, load_landmarks
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import ModelError, SettingsError
from drake_pose.fit.colours import colour_numbers
from drake_pose.fit.contour_fit import ContourFit, PoseFit, Prior
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.person.views import ColourViews, FrameViews, sum_at_points
from drake_pose.silhouette.scoring import draw_mask

PERSON_LANDMARKS = (
    "neck",
    *(
        f"{side}_{joint}"
        for side in ("left", "right")
        for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    ),
)
"""The anatomical joint centres that a model of a person has in its landmarks.yaml."""


@dataclass(frozen=True, kw_only=True)
class PersonSettings:
    """How a person is followed, and searched where he is lost.

    Args:
        follow, search: the steps of a frame's fit from where the last ones point to, and from a
            coarse guess.
        carry: the fraction of the last frame's step that is expected again.
        angle_deviation, length_deviation: how far that is off [rad, m].
        retry_below, lost_below: limbs are searched again where this much less of the contours fits
            than usual; the whole person where less than this fraction of the usual does.
        part_lost_below: a person followed by colour is lost where less of a part fits.
        memory, usual: for how many frames the usual fraction is remembered, and what it is at
            first.
        telling: parts with less contour in all cameras together do not say that they are off [m].
        headings, headings_a_frame: into how many directions a lost person is turned, and how many
            of them in each frame of a sequence.
        limbs_a_frame: how many doubtful limbs are searched again in each frame of a sequence.
        limb_fits, limb_gain, limb_shows: a limb is doubtful where less of its own contour fits;
            where elsewhere this much more of it would lie in unexplained pixels; or where it shows
            less contour than this fraction of its length.
        fitted, mended: the fraction of the fresh starts, the most promising ones, that is fitted;
            and where nothing is known yet, for how many of these all doubtful limbs are searched.
        placements: in how many ways a limb is placed by its colours.
        unalike, near: limbs whose tips are farther apart are not alike; limbs that are nearer are
            about the same [m].
        rival: another pose that fits worse by this much closeness at most is mended, too, before
            both are compared.
        alike: another pose that fits worse by this much closeness at most is as good; chosen on 36
            drawn persons of other measures and clothes before four cameras.
        judged, rougher: how many of the steps of a fit tell which guess is promising, with points
            of the contour as much farther apart.
    """

    follow: tuple[AnnealingStage, ...]
    search: tuple[AnnealingStage, ...]
    carry: float = 0.7
    angle_deviation: float = 0.3
    length_deviation: float = 0.15
    retry_below: float = 0.03
    lost_below: float = 0.75
    part_lost_below: float = 0.4
    memory: float = 60.0
    usual: float = 0.95
    telling: float = 0.3
    headings: int = 12
    headings_a_frame: int = 3
    limbs_a_frame: int = 2
    limb_fits: float = 0.8
    limb_gain: float = 0.15
    limb_shows: float = 0.5
    fitted: float = 0.5
    mended: int = 3
    placements: int = 3
    unalike: float = 0.25
    near: float = 0.15
    rival: float = 0.15
    alike: float = 0.02
    judged: int = 3
    rougher: float = 1.5

    def __post_init__(self) -> None:
        if not self.follow or not self.search:
            raise SettingsError("a tracker and its search need one round or more")

    @property
    def cycle(self) -> int:
        """In how many frames all headings are tried."""
        return self.headings // self.headings_a_frame

    def headings_of(self, frame: int) -> list[int]:
        """The headings tried in a frame of trouble, all around first."""
        # Bits in reverse order make neighbours late.
        order = sorted(range(self.cycle), key=lambda k: f"{k:032b}"[::-1])
        return list(range(order[frame % self.cycle], self.headings, self.cycle))


def _stages(*pairs: tuple[float, float]) -> tuple[AnnealingStage, ...]:
    """Stages of a scale [m] and a spacing of points [m]."""
    return tuple(AnnealingStage(scale, spacing) for scale, spacing in pairs)


EXACT = PersonSettings(
    follow=_stages((0.08, 0.06), (0.04, 0.06), (0.02, 0.05)),
    search=_stages(
        (0.15, 0.06), (0.1, 0.06), (0.07, 0.06), (0.05, 0.06), (0.03, 0.05), (0.02, 0.05)
    ),
)
"""For a model that is the person."""

LENIENT = PersonSettings(
    follow=_stages((0.1, 0.06), (0.07, 0.05), (0.05, 0.05), (0.04, 0.04)),
    search=_stages(
        (0.2, 0.06), (0.15, 0.06), (0.1, 0.06), (0.07, 0.05), (0.05, 0.05), (0.04, 0.04)
    ),
)
"""For a model that is only like the person: it fits to within centimetres."""


class PlannedLimb(NamedTuple):
    """An arm or leg of a pose tree.

    Args:
        nodes, values: those that move it alone; k values.
        joints: (3,) its root, middle joint and end among the landmarks.
        poses: (n, k) values all over its limits; the first is at rest.
        samples_T, weights: (n, m, 3) points along it in the trunk's frame [m], and theirs (n, m).
        length: from its root to its end, stretched out [m].
    """

    nodes: Indices
    values: Indices
    joints: Indices
    poses: Array
    samples_T: Array
    weights: Array
    length: float

    def places(self, X_WT: Array) -> Array:
        """(n, m, 3) its points in the world [m] where the trunk is at X_WT (4, 4)."""
        placed = self.samples_T.reshape(-1, 3) @ X_WT[:3, :3].T + X_WT[:3, 3]
        return np.asarray(placed.reshape(self.samples_T.shape))


class BodyPlan:
    """A person's limbs and trunk in a pose tree.

    Attributes:
        along: where points are put on a limb: so far from root to middle joint, and on to the end;
            a hand's or foot's middle lies farther.
        upper_samples: how many of a limb's points are on its first half; the others follow.
        trunk: the node that the limbs hang on.
        heading: the value that turns all of the body freely, about the vertical; None: no such.

    Raises:
        ModelError: the model has no landmarks, or not those of trunk, arms and legs.
    """

    along = np.array([0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.25])
    upper_samples = int(np.count_nonzero(along <= 1.0))

    def __init__(self, kinematics: TreeKinematics) -> None:
        self.kinematics = kinematics
        tree = kinematics.tree
        known = load_landmarks(tree.model.path)
        missing = sorted(set(PERSON_LANDMARKS) - set(known))
        if missing:
            raise ModelError(
                f"{tree.model.path}: landmarks.yaml lacks {', '.join(missing)}, which the capture "
                "of a person by its silhouettes needs"
            )
        self.landmarks = landmarks_of_nodes(tree, known)
        self.trunk = self._node("neck")
        free = np.flatnonzero(kinematics.turns_around)
        self.heading = int(free[0]) if len(free) else None

    def trunk_middle(self, X_WN: Array) -> Array:
        """(3,) the trunk's middle [m], half-way between neck and hips."""
        places = dict(zip(self.landmarks.names, self.landmarks.positions(X_WN), strict=True))
        hips = 0.5 * (places["left_hip"] + places["right_hip"])
        return np.asarray(0.5 * (places["neck"] + hips))

    @cached_property
    def limbs(self) -> dict[str, PlannedLimb]:
        """The limbs, by name."""
        kinds = {"arm": ("shoulder", "elbow", "wrist"), "leg": ("hip", "knee", "ankle")}
        return {
            f"{side}_{kind}": self._plan([f"{side}_{joint}" for joint in joints])
            for kind, joints in kinds.items()
            for side in ("left", "right")
        }

    def _node(self, landmark: str) -> int:
        return int(self.landmarks.nodes[self.landmarks.names.index(landmark)])

    def _plan(self, names: Sequence[str], count: int = 2048) -> PlannedLimb:
        """A limb by its three landmarks, in this many poses; one in eight is stretched."""
        from scipy.stats import qmc  # Slow to import, and needed for persons alone.

        kinematics, tree = self.kinematics, self.kinematics.tree
        rest = kinematics.flatten(tree.default_values())
        moves = kinematics.motions(rest).moves
        end = self._node(names[2])
        own = moves[end] & ~moves[self._node("neck")]
        free = kinematics.is_angle & (kinematics.upper > kinematics.lower)
        values = np.flatnonzero(own & free)
        nodes = np.flatnonzero((moves & own).any(axis=1))
        share = qmc.Halton(len(values), scramble=False).random(count)
        lower, upper = (ends[values] for ends in kinematics.reach(rest))
        poses = np.clip(rest[values], lower, upper) * np.ones((count, 1))
        poses[1:] = lower + share[1:] * (upper - lower)
        # People stretch their limbs more often than chance would.
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
        a, b, c = self.landmarks.positions(X_WN[0])[joints]
        length = float(np.linalg.norm(b - a) + np.linalg.norm(c - b))
        weights = crowding(samples_T)
        return PlannedLimb(nodes, values, joints, poses, samples_T, weights, length)

    def samples(self, limb: PlannedLimb, X_WN: Array) -> Array:
        """(m, 3) points along a limb in the world [m] where the nodes are at X_WN."""
        return self._samples(limb.joints, X_WN[None])[0]

    def _samples(self, joints: Indices, X_WN: Array) -> Array:
        """(n, m, 3) points along a limb, given its three landmarks and X_WN (n, nodes, 4, 4)."""
        a, b, c = np.moveaxis(self.landmarks.positions(X_WN)[:, joints], 1, 0)
        upper = np.minimum(self.along, 1.0)[:, None]
        lower = np.maximum(self.along - 1.0, 0.0)[:, None]
        steps = upper * (b - a)[:, None] + lower * (c - b)[:, None]
        return np.asarray(a[:, None] + steps)


def crowding(samples: Array, apart: float = 0.08) -> Array:
    """(n, m) weights of points (n, m, 3): one over the points about each, over m.

    Points of a limb that are nearer to each other than `apart` [m] fill the same space.
    """
    x, y, z = (own[:, :, None] - own[:, None] for own in np.moveaxis(samples, 2, 0))
    near = x * x + y * y + z * z < apart**2
    return np.asarray(1.0 / (near.sum(axis=2) * samples.shape[1]))


class PersonSearch:
    """Searches limbs and persons by fits of some rounds from coarse guesses.

    `information`, `held` and `rest` (m,) are what is known of values near a guess, which of them
    stay, and those of a person at rest.
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

    def mended(
        self,
        fitted: PoseFit,
        frame: FrameViews,
        enough: float = math.inf,
        first: int = 0,
        limbs: int | None = None,
    ) -> PoseFit:
        """A fit whose doubtful limbs were searched again, where that is better.

        Args:
            enough: where this much of the contours fits, the search ends.
            first: the doubtful limb to begin with; the worst is 0.
            limbs: how many limbs are searched; None: all that are doubtful.
        """
        best = _better(fitted, self.refined(fitted.values, frame))
        if best.inlier_ratio >= enough:
            return best
        doubtful = self._doubtful(best, frame)
        begin = first % len(doubtful)
        chosen = (doubtful[begin:] + doubtful[:begin])[:limbs]
        return self._searched(best, chosen, frame, enough)

    def _searched(
        self, best: PoseFit, limbs: Iterable[PlannedLimb], frame: FrameViews, enough: float
    ) -> PoseFit:
        """A fit whose limbs were searched again, until enough of the contours fits."""
        for limb in limbs:
            scores, _ = self._scores(best.values, limb, frame)
            guesses = self._unalike(best.values, limb, scores, 2)
            # It may be bent the wrong way: at rest, or the most relaxed about where it is.
            X_WN = self._fit.kinematics.poses(best.values)
            off = self._off(best.values, limb, self._plan.samples(limb, X_WN))
            near = limb.poses[off < self._settings.near]
            effort = np.abs(near - limb.poses[0]).sum(axis=1)
            for pose in (limb.poses[0], *near[np.argsort(effort, kind="stable")[:1]]):
                guesses.append(best.values.copy())
                guesses[-1][limb.values] = pose
            for values in guesses:
                best = _better(best, self.refined(values, frame))
            if best.inlier_ratio >= enough:
                break
        return best

    def found(
        self,
        frame: FrameViews,
        headings: Sequence[int],
        known: Array | None = None,
        enough: float = math.inf,
    ) -> PoseFit | None:
        """The best of fresh starts with some headings; None where not two cameras see a person.

        Args:
            headings: where not all, only the best start's limbs are searched.
            known: (m,) where held values are taken from; None: the person at rest.
            enough: where this much of the contours fits, no more limbs are searched.
        """
        if len(headings) == self._settings.headings:
            return next(iter(self.explanations(frame, known)), None)
        begun = self._begun(frame, headings, known)
        limbs = self._settings.limbs_a_frame
        return self.mended(begun[0], frame, enough, limbs=limbs) if begun else None

    def explanations(self, frame: FrameViews, known: Array | None = None) -> list[PoseFit]:
        """All that a person who is seen so may be: poses that are unlike each other, best first.

        Before they are compared, the doubtful limbs of each are searched. None where not two
        cameras see a person; `known` is as of `found`.
        """
        found, best = self.started(frame, known), None
        while found and best is not (leading := max(found, key=lambda one: one.closeness)):
            best = leading
            others = [self.refined(values, frame) for values in self._exchanged(best.values)]
            least = best.closeness - self._settings.rival
            found += [self.mended(one, frame) for one in others if one.closeness > least]
        if best is not None:
            found.append(self._searched(best, self._plan.limbs.values(), frame, math.inf))
        return self.unlike(found)

    def started(self, frame: FrameViews, known: Array | None = None) -> list[PoseFit]:
        """The most promising fresh starts of all headings, their doubtful limbs searched."""
        begun = self._begun(frame, range(self._settings.headings), known)
        return [self.mended(one, frame) for one in begun[: self._settings.mended]]

    def unlike(self, fits: Iterable[PoseFit]) -> list[PoseFit]:
        """Fits of which no two are alike in all joints' places, best first."""
        found: list[PoseFit] = []
        kept: list[Array] = []
        for one in sorted(fits, key=lambda one: -one.closeness):
            places = self._plan.landmarks.positions(self._fit.kinematics.poses(one.values))
            off = [np.linalg.norm(places - other, axis=-1).max() for other in kept]
            if all(far > self._settings.unalike for far in off):
                found.append(one)
                kept.append(places)
        return found

    def _begun(
        self, frame: FrameViews, headings: Sequence[int], known: Array | None
    ) -> list[PoseFit]:
        """Fresh starts with some headings, the promising ones fitted, best first."""
        middle = frame.middle()
        if middle is None:
            return []
        guesses = [self._guess(frame, heading, middle, known) for heading in headings]
        guesses.sort(key=lambda one: -one.closeness)
        promising = guesses[: math.ceil(self._settings.fitted * len(guesses))]
        fitted = [self.refined(one.values, frame) for one in promising]
        return sorted(fitted, key=lambda one: -one.closeness)

    def _guess(
        self, frame: FrameViews, heading: int, middle: Array, known: Array | None
    ) -> PoseFit:
        """A person turned somewhere, the trunk fitted roughly, then each limb placed."""
        values = self._rest.copy() if known is None else np.where(self._held, known, self._rest)
        if self._plan.heading is not None:
            values[self._plan.heading] = 2.0 * np.pi * heading / self._settings.headings
        values = self._judged(self._stand_at(values, middle), frame).values
        placed = np.ones(len(self._fit.outlines), dtype=np.bool_)
        for limb in self._plan.limbs.values():
            placed[limb.nodes] = False
        for limb in self._plan.limbs.values():
            scores, _ = self._scores(values, limb, frame, placed)
            values = self._unalike(values, limb, scores, 1)[0]
            placed[limb.nodes] = True
        return self._judged(values, frame)

    def _judged(self, values: Array, frame: FrameViews) -> PoseFit:
        """A few steps of a fit to a few cameras."""
        prior, rougher = Prior(values, 0.1 * self._information), self._settings.rougher
        rounds = [
            replace(one, spacing=rougher * one.spacing)
            for one in self._settings.search[: self._settings.judged]
        ]
        return self._fit.fit(frame.coarse, values, rounds, prior, self._held)

    def refined(self, values: Array, frame: FrameViews | ColourViews) -> PoseFit:
        """A fit from a coarse guess, which is trusted little."""
        prior, rounds = Prior(values, 0.1 * self._information), self._settings.search
        return self._fit.fit(partial(frame.compare, self._fit), values, rounds, prior, self._held)

    def _doubtful(self, fitted: PoseFit, frame: FrameViews) -> list[PlannedLimb]:
        """The limbs that fit badly, hardly show, or would fill more elsewhere; always the worst."""
        settings = self._settings
        lengths, fitting = fitted.sums[:, [Sum.COMPARED, Sum.FITTING]].T
        shares = np.where(lengths > 0.0, fitting / np.maximum(lengths, 1e-9), 1.0)
        found = []
        for limb in self._plan.limbs.values():
            share = shares[limb.nodes].min()
            shown = lengths[limb.nodes].sum() / (limb.length * len(frame.cameras))
            scores, now = self._scores(fitted.values, limb, frame)
            gain = float(scores.max() - now)
            doubtful = share < settings.limb_fits or shown < settings.limb_shows
            found.append((not (doubtful or gain > settings.limb_gain), share - gain, limb))
        found.sort(key=lambda one: one[:2])
        return [limb for k, (good, _, limb) in enumerate(found) if k == 0 or not good]

    def _scores(
        self, values: Array, limb: PlannedLimb, frame: FrameViews, placed: Mask | None = None
    ) -> tuple[Array, float]:
        """How much each pose of a limb would fill that nothing else explains, and it fills now."""
        X_WN = self._fit.kinematics.poses(values)
        others = np.ones(len(X_WN), dtype=np.bool_) if placed is None else placed.copy()
        others[limb.nodes] = False
        outlines = [self._fit.outlines[node] for node in np.flatnonzero(others)]
        places = limb.places(X_WN[self._plan.trunk])
        here = self._plan.samples(limb, X_WN)[None]
        scores, now, weights = np.zeros(len(places)), 0.0, crowding(here)
        for camera, region in zip(*frame.small, strict=True):
            # 1 in the region where the others do not show, 0 where they do, -1 outside of it.
            worth = np.where(region, 1, -1).astype(np.int8)
            worth[region & draw_mask(outlines, camera.X_CW @ X_WN[others], camera)] = 0
            scores += sum_at_points(camera, worth, places, limb.weights)[0]
            now += float(sum_at_points(camera, worth, here, weights)[0][0])
        return scores / len(frame.judges), now / len(frame.judges)

    def _unalike(self, values: Array, limb: PlannedLimb, scores: Array, count: int) -> list[Array]:
        """Values (m,) with the limb's best poses by scores (n,) that are not alike."""
        found: list[Array] = []
        tips: list[Array] = []
        for index in np.argsort(-scores):
            tip = limb.samples_T[index, -1]
            if all(np.linalg.norm(tip - other) > self._settings.unalike for other in tips):
                tips.append(tip)
                found.append(values.copy())
                found[-1][limb.values] = limb.poses[index]
                if len(found) == count:
                    break
        return found

    def placed_by_colour(
        self, values: Array, limb: PlannedLimb, views: ColourViews, own: Mask
    ) -> list[PoseFit]:
        """Fits whose limb was placed where its own colours (nodes, COLOURS) are seen most."""
        places = limb.places(self._fit.kinematics.poses(values)[self._plan.trunk])
        half, first, scores = len(limb.nodes) // 2, self._plan.upper_samples, np.zeros(len(places))
        for camera, picture in zip(views.cameras, views.pictures, strict=True):
            colours = colour_numbers(picture)
            for nodes, points in (
                (limb.nodes[:half], np.s_[:, :first]),
                (limb.nodes[half:], np.s_[:, first:]),
            ):
                worth = np.where(own[nodes].any(axis=0), 1, -1).astype(np.int8)[colours]
                weights = np.ascontiguousarray(limb.weights[points])
                here = np.ascontiguousarray(places[points])
                scores += sum_at_points(camera, worth, here, weights)[0]
        chosen = self._unalike(values, limb, scores, self._settings.placements)
        return [self.refined(one, views) for one in chosen]

    def _exchanged(self, values: Array) -> list[Array]:
        """Values (m,) that look much alike: both arms or legs exchanged; turned about."""
        plan, found = self._plan, []
        X_WN = self._fit.kinematics.poses(values)
        for turn, parts in ((0.0, ("arm",)), (0.0, ("leg",)), (math.pi, ("arm", "leg"))):
            other = values.copy()
            if turn and plan.heading is not None:
                other[plan.heading] += turn
                other = self._stand_at(other, plan.trunk_middle(X_WN))
            for part in parts:
                for side, its in (("left", "right"), ("right", "left")):
                    limb, there = plan.limbs[f"{side}_{part}"], plan.limbs[f"{its}_{part}"]
                    off = self._off(other, limb, plan.samples(there, X_WN))
                    other[limb.values] = limb.poses[np.argmin(off)]
            found.append(other)
        return found

    def _off(self, values: Array, limb: PlannedLimb, samples_W: Array) -> Array:
        """(n,) how far each pose of a limb is from points (m, 3) along one, at most [m]."""
        X_WT = self._fit.kinematics.poses(values)[self._plan.trunk]
        samples_T = (samples_W - X_WT[:3, 3]) @ X_WT[:3, :3]
        return np.asarray(np.linalg.norm(limb.samples_T - samples_T, axis=2).max(axis=1))

    def _stand_at(self, values: Array, middle: Array) -> Array:
        """Values (m,) with the trunk's middle at a place (3,) [m]."""
        kinematics = self._fit.kinematics
        off = middle - self._plan.trunk_middle(kinematics.poses(values))
        motions = kinematics.motions(values)
        # The root's place is three lengths along the world's axes.
        for index in np.flatnonzero(~kinematics.is_angle & motions.moves[0] & ~self._held):
            values[index] += float(motions.twists[index, 3:6] @ off)
        return values


def _better(one: PoseFit, other: PoseFit) -> PoseFit:
    return other if other.closeness > one.closeness else one
