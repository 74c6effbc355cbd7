"""Where a camera is on a robot's link, told by silhouettes of an object that stands somewhere.

Neither pose need be known nor guessed. The object's poses are searched in each picture by itself.
Of two pictures the hand's motion A and the object's B in the camera go with A X = X B, where X is
the camera's pose on the hand: both turn by the same angle, and A's axis is B's, turned by X (Park
and Martin 1994). Three pictures whose motions turn about two axes tell X; the best are fitted to
all pictures at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body.model import OBJECT_POSITIONS
from drake_pose.body.tree.link_graph import inverse_transforms
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.registration.posed_frames import LAST_SPACING, PosedFrame, PosedFrames
from drake_pose.registration.register import (
    COARSE,
    COARSE_SPACING,
    FINE,
    FINE_SPACING,
    FIRST_SIDE,
    SECOND_SIDE,
    CameraSearch,
    ObjectPose,
    RegisteredCamera,
    describe_fitted,
    spread,
    with_widths,
)
from drake_pose.registration.shared_fit import SHARED, Shared, SharedFit
from drake_pose.registration.standing_object import StandingObject, require_turns, turns_between
from drake_pose.registration.start_poses import E_total, apart_from_before, areas

Look = Array
"""(2, 4, 4): the camera's pose X_LC in the hand's frame, and the object's, X_WT."""

# Of each picture so many poses of the object are kept; and so many starts and looks of all.
_OF_A_PICTURE, _STARTS, _LOOKS = 8, 12, 4
# Of a picture's regions so many may be the object: those of less E_total than this.
_REGIONS, _EXPLAINS = 3, 0.15
# Looks are one whose object is seen nearer to each other than this [its radius].
_APART = 0.15
# A look whose mean E_total is larger by so much than so many times the best one's is none.
_WORSE_BY, _WORSE_TIMES = 0.02, 2.0
# The angles by which hand and object turn differ by no more [rad].
_SAME_ANGLE = np.radians(20.0)
# So many threes of pictures are looked at, and of each so many of the object's poses.
_THREES, _MOST_OF_ONE = 24, 500


class ObjectSearch:
    """Finds where a camera is on a link of the robot, and where the object stands that it sees.

    standing: the object, and the robot before which it stands; alone: finds it in one picture.
    """

    def __init__(self, standing: StandingObject, alone: CameraSearch | None = None) -> None:
        self._standing, self._alone = standing, alone or CameraSearch(standing.alone)

    def rough(self) -> ObjectSearch:
        """A search that is faster, and less sure."""
        return ObjectSearch(self._standing, self._alone.rough())

    def register(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Finds the camera's pose in the link's frame, and the object's in the world.

        Args:
            camera: its pose is not used.
            frames: at values of the object's tree.

        Raises:
            MaskError: a mask of another size than the camera's picture, or an empty one.
            RegistrationError: the frames that agree, or all, turn the link about one axis alone.
        """
        require_turns(camera.name, self._standing, frames)
        looks = self._search(camera, [[one] for one in spread(frames)])
        for rounds, spacing, surfaces in (
            (FINE, FINE_SPACING, "few"),
            (SHARED.rounds_with_constants, LAST_SPACING, "all"),
        ):
            fits = [self._fit(camera, frames, look, spacing, surfaces) for look in looks]
            fitted = [
                self._look(fit, fit.fit(rounds), look)
                for fit, look in zip(fits, looks, strict=True)
            ]
            looks = self._distinct(fitted, frames)
        last = []
        for k, look in enumerate(looks):
            fit = self._fit(camera, frames, look)
            now = with_widths(fit)
            # Where it stands now is where a last fit finds it.
            looks[k] = self._look(fit, now, look)
            at = now._replace(shared=0.0 * now.shared)
            last.append((self._fit(camera, frames, looks[k]), at))
        found, covariance, as_good = describe_fitted(last)
        X_LC, X_WT = looks[as_good[0]]
        others = [X_WT @ turn for turn in self._standing.symmetry.told_apart[1:]]
        # Where the camera would be elsewhere, too, that is told with the camera.
        as_well = [looks[k] for k in as_good[1:]]
        others += [one[1] for one in as_well if not self._differ(one[:1], X_LC[None])]
        apart = [X[0] for X in self._apart([X[None] for X in (X_WT, *others)], np.eye(4)[None])]
        seen = ObjectPose(
            X_WT,
            self._standing.pose_covariance(X_WT, covariance[6:, 6:]),
            np.array(apart[1:]).reshape(-1, 4, 4),
            self._standing.symmetry.axes,
        )
        agreeing = [one for one, fit in zip(frames, found.frames, strict=True) if fit.agrees]
        require_turns(camera.name, self._standing, agreeing, "that agree ")
        return replace(found, seen_object=seen)

    def choose(
        self, camera: PinholeCamera, choices: Sequence[Sequence[PosedFrame]]
    ) -> tuple[Look, int]:
        """Where camera and object are about, and of how many pictures this explains a region.

        Args:
            choices: of each picture regions any of which may be the object.

        Raises RegistrationError: in no three pictures one of them turns as the link does.
        """
        look = self._search(camera, choices)[0]
        seen = [own for own in choices if own]
        off = [self._misfits(camera, [own], look[None], SECOND_SIDE)[0] for own in seen]
        return look, int(np.count_nonzero(np.array(off) < _EXPLAINS))

    def _search(self, camera: PinholeCamera, choices: Sequence[Sequence[PosedFrame]]) -> list[Look]:
        """Where the best one may be near, best first.

        choices: of each picture masks, one of which may be the object's.
        """
        turns = self._standing.symmetry.turns
        kept, X_CT = list[list[PosedFrame]](), list[Array]()
        for own in choices:
            likely = self._likely(camera, own)
            if likely:
                kept.append([one for one, _ in likely])
                alike = [self._apart([X[None] for X in found], turns) for _, found in likely]
                X_CT.append(np.concatenate([X for found in alike for X in found]))
        some = [own[0] for own in kept]
        X_WL = self._standing.hand_poses(np.array([one.values for one in some]))
        starts = hand_eye_starts(X_WL, X_CT, turns)
        if not len(starts):
            raise RegistrationError(
                f"camera '{camera.name}': in no three of its frames the object turns before the "
                "camera as the link does: are these masks of this object, did it stand still, are "
                "the joint positions those of these frames, and is it this link that the camera "
                "rides on? Nothing was written"
            )
        order = np.argsort(self._misfits(camera, kept, starts, FIRST_SIDE), kind="stable")
        fitted = []
        for look in self._distinct(starts[order[: 10 * _STARTS]], some)[:_STARTS]:
            chosen = [self._nearest(camera, own, look) for own in kept]
            fit = self._fit(camera, chosen, look, COARSE_SPACING, "very_few")
            fitted.append(self._look(fit, fit.fit(COARSE), look))
        off = self._misfits(camera, kept, np.array(fitted), SECOND_SIDE)
        limit = _WORSE_BY + _WORSE_TIMES * float(off.min())
        order = np.argsort(off, kind="stable")
        return self._distinct([fitted[k] for k in order if off[k] <= limit], some)[:_LOOKS]

    def _likely(
        self, camera: PinholeCamera, own: Sequence[PosedFrame]
    ) -> list[tuple[PosedFrame, list[Array]]]:
        """Of a picture's masks those that some pose of the object explains best, and its poses.

        A single one is known to be the object's.
        """
        told, body = [], self._standing.alone
        for one in own:
            alone = [PosedFrame(one.name, np.zeros(0), one.mask)]
            found = self._alone.search(camera, alone, _OF_A_PICTURE)
            posed = PosedFrames(body.kinematics, body.very_few, camera, alone)
            off = float(E_total(areas(posed, np.array(found), SECOND_SIDE)).min())
            if len(own) == 1 or off < _EXPLAINS:
                told.append((off, one, found))
        told.sort(key=lambda each: each[0])
        return [(one, found) for _, one, found in told[:_REGIONS]]

    def _misfits(
        self,
        camera: PinholeCamera,
        choices: Sequence[Sequence[PosedFrame]],
        looks: Array,
        side: float,
    ) -> Array:
        """(n,) E_total of looks (n, 2, 4, 4) in the mean of pictures, each by its best mask."""
        off = [
            np.min([self._misfit(camera, one, looks, side) for one in own], axis=0)
            for own in choices
        ]
        return np.asarray(np.mean(off, axis=0))

    def _nearest(self, camera: PinholeCamera, own: Sequence[PosedFrame], look: Look) -> PosedFrame:
        """Of a picture's masks that which a look explains best."""
        return min(own, key=lambda one: self._misfit(camera, one, look[None])[0])

    def _misfit(
        self, camera: PinholeCamera, one: PosedFrame, looks: Array, side: float = SECOND_SIDE
    ) -> Array:
        """(n,) E_total of looks (n, 2, 4, 4) in a frame, one at most."""
        body = self._standing.alone
        alone = PosedFrame(one.name, np.zeros(0), one.mask)
        posed = PosedFrames(body.kinematics, body.very_few, camera, [alone])
        X_CT = self.seen_from(looks, one.values)
        return np.minimum(E_total(areas(posed, X_CT, side))[:, 0], 1.0)

    def seen_from(self, looks: Array, values: Array) -> Array:
        """(n, 4, 4) the object's poses X_CT in a camera at values (m,), of looks (n, 2, 4, 4)."""
        X_WL = self._standing.hand_poses(values[None])[0]
        return np.asarray(inverse_transforms(X_WL @ looks[:, 0]) @ looks[:, 1])

    def _fit(
        self,
        camera: PinholeCamera,
        frames: Sequence[PosedFrame],
        look: Look,
        spacing: float = LAST_SPACING,
        surfaces: str = "all",
    ) -> SharedFit:
        """A fit of camera and object that begins where a look has them."""
        body = self._standing.body(look[1])
        seen = PosedFrames(body.kinematics, getattr(body, surfaces), camera, frames, spacing)
        return SharedFit([seen], [inverse_transforms(look[0])], OBJECT_POSITIONS)

    def _look(self, fit: SharedFit, found: Shared, look: Look) -> Look:
        """What was found from where a look has camera and object."""
        moved = self._standing.moved(look[1], found.shared[fit.per_camera :])
        return np.array([fit.cameras(found)[0].X_WC, moved])

    def _distinct(self, looks: Sequence[Look] | Array, frames: Sequence[PosedFrame]) -> list[Look]:
        """Those of some looks that see the object otherwise than all before them.

        An object that looks alike after a turn is the same.
        """
        X_WL = self._standing.hand_poses(np.array([one.values for one in frames]))
        X_CT = [inverse_transforms(X_WL @ X_LC) @ X_WT for X_LC, X_WT in looks]
        kept = self._apart(X_CT, self._standing.symmetry.turns)
        return [look for look, X in zip(looks, X_CT, strict=True) if any(X is one for one in kept)]

    def _apart(self, poses: Sequence[Array], turns: Array) -> list[Array]:
        """Those of some poses (n, 4, 4) of the object that are apart from all before them.

        turns: (t, 4, 4) after which they are the same.
        """
        return apart_from_before(
            poses, lambda X, other: all(self._differ(X, other @ turn) for turn in turns)
        )

    def _differ(self, X: Array, others: Array) -> bool:
        """Whether poses (n, 4, 4) put the object's ball elsewhere, root mean square."""
        by = np.asarray(X - others)[:, :3]
        shift = by[:, :, :3] @ self._standing.middle + by[:, :, 3]
        turn = (by[:, :, :3] ** 2).sum(axis=(1, 2)) / 3.0 * self._standing.radius**2
        off = np.sqrt(((shift**2).sum(axis=1) + turn).mean())
        return bool(off > _APART * self._standing.radius)


def hand_eye_starts(X_WL: Array, X_CT: Sequence[Array], turns: Array) -> Array:
    """(n, 2, 4, 4) looks that three pictures each say, those that turn the hand most first.

    Args:
        X_WL: (frames, 4, 4) the hand's poses.
        X_CT: for each frame (k, 4, 4) poses of the object in the camera, one of them about right.
        turns: (t, 4, 4) motions in the object's frame after which it looks alike.
    """
    threes = list(combinations(range(len(X_WL)), 3))
    if len(threes) > _THREES:
        drawn = np.random.default_rng(0).permutation(len(threes))
        # Threes of which nothing is told are drawn too often otherwise.
        threes = [threes[k] for k in drawn[: 4 * _THREES]]
    told = [turns_between(X_WL[list(three), :3, :3])[1] for three in threes]
    chosen = [threes[k] for k in np.argsort(told)[::-1][:_THREES]]
    turned = [(one[:, None] @ turns).reshape(-1, 4, 4) for one in X_CT]
    # The object's frame is as it is in the first one, however it looks.
    found = [_of_three(X_WL[[i, j, k]], (X_CT[i], turned[j], turned[k])) for i, j, k in chosen]
    return np.concatenate(found)


def _of_three(X_WL: Array, X_CT: Sequence[Array]) -> Array:
    """What three pictures say: for those of the object's poses that turn as the hand does."""
    pairs = ((0, 1), (0, 2), (1, 2))
    A = np.array([np.linalg.inv(X_WL[j]) @ X_WL[i] for i, j in pairs])
    a = Rotation.from_matrix(A[:, :3, :3]).as_rotvec()
    offs = [
        np.abs(_angles(X_CT[i], X_CT[j]) - angle)
        for (i, j), angle in zip(pairs, np.linalg.norm(a, axis=1), strict=True)
    ]
    off = np.maximum(np.maximum(offs[0][:, :, None], offs[1][:, None]), offs[2][None])
    kept = np.argsort(off, axis=None)[: min(_MOST_OF_ONE, np.count_nonzero(off <= _SAME_ANGLE))]
    rows = np.unravel_index(kept, off.shape)
    poses = np.stack([one[row] for one, row in zip(X_CT, rows, strict=True)], axis=1)
    B = np.stack([poses[:, j] @ inverse_transforms(poses[:, i]) for i, j in pairs], axis=1)
    b = Rotation.from_matrix(B[:, :, :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 3, 3)
    # Rotations R with a = R b in least squares.
    R_LC = _nearest_rotations(np.einsum("pi,npj->nij", a, b))
    M = np.broadcast_to((A[:, :3, :3] - np.eye(3)).reshape(9, 3), (len(kept), 9, 3))
    t = (np.einsum("nij,npj->npi", R_LC, B[:, :, :3, 3]) - A[:, :3, 3]).reshape(-1, 9)
    X_LC = np.tile(np.eye(4), (len(kept), 1, 1))
    X_LC[:, :3, :3] = R_LC
    X_LC[:, :3, 3] = np.einsum("nij,nj->ni", np.linalg.pinv(M, rcond=1e-3), t)
    return np.stack([X_LC, _mean_poses(X_WL @ X_LC[:, None] @ poses)], axis=1)


def _angles(X: Array, others: Array) -> Array:
    """(n, m) by how much poses (n, 4, 4) are turned from others (m, 4, 4) [rad]."""
    traces = np.einsum("nij,mij->nm", X[:, :3, :3], others[:, :3, :3])
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))


def _mean_poses(X: Array) -> Array:
    """(n, 4, 4) the means of poses (n, k, 4, 4): places, and rotations nearest to the mean's."""
    mean = X.mean(axis=1)
    mean[:, :3, :3] = _nearest_rotations(mean[:, :3, :3])
    return np.asarray(mean)


def _nearest_rotations(M: Array) -> Array:
    """(n, 3, 3) the rotations nearest to matrices (n, 3, 3)."""
    U, _, V = np.linalg.svd(M)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ V))[:, None]
    return np.asarray(U @ V)
