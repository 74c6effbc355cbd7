"""Errors that are too large for fits of single frames: what is wrong in all frames, by search.

A fit near to what is given drops a link that is far from its silhouette as damage, in every frame
alike. Here the areas of body and silhouettes are compared over each joint's whole range, and with
the scene read otherwise: other signs, conventions, focal lengths, cameras exchanged.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.registration.per_frame_fit import FrameFit
from drake_pose.registration.posed_frames import MultiViewFrame, common_size, reduced_sums
from drake_pose.registration.register import RegistrationBody, evenly_spaced
from drake_pose.silhouette.scoring import draw_mask, score_bodies
from drake_pose.workers import map_ordered


class LargeErrorSettings(NamedTuple):
    """How large errors are searched, and when one is named.

    Args:
        side: root of the silhouettes' area in the pictures that are compared [pixel].
        step: from one tried angle of a joint to the next [deg]; fine_step: about the best one.
        places: number of tried positions of a joint that slides.
        left: a reading of the scene is named that leaves less than this fraction of the area that
            is in body or silhouette alone.
        left_of_one: the same where single links do not fit, the rest does.
        mended: what single links lack of fitting outlines must be this many times as much before.
        improved: and that does so in at least this share of the frames.
        as_good: a simpler reading is preferred that gains this share of the most that one gains.
        constant: positions that differ from the log by another amount in each frame are named only
            where no constant gains this share of what they gain.
        again, again_focal: fits are begun anew from where they found a joint, or focal lengths,
            that are off by more [deg, share].
        near_angle, near_place, near_focal: what is off by less is left to fits [deg, m, share].
        frames: number of frames that are compared, spread over all.
        seen: a joint is looked at where less of the outlines of all links that it moves fits.
        unseen: a link is elsewhere than the log says where less of its outline fits.
        least_shown: of all outlines; a link that shows less is not judged.

    Chosen on drawn arms of four and seven joints, one wrong at a time. Of outlines of links that
    are where the log says .9 fit and more (.51 of a real flange that hardly shows), of others .47.
    """

    side: float = 100.0
    coarse_step: float = 5.0
    fine_step: float = 1.0
    slide_steps: int = 13
    max_remaining: float = 0.8
    max_remaining_of_joint: float = 0.97
    min_mending: float = 2.0
    min_improved_frames: float = 0.7
    equivalent_gain: float = 0.85
    constant_gain: float = 0.8
    restart_angle: float = 2.0
    restart_focal: float = 0.02
    reach_angle: float = 6.0
    reach_shift: float = 0.01
    reach_focal: float = 0.04
    frame_count: int = 10
    min_joint_inlier_ratio: float = 0.8
    max_misplaced_inlier_ratio: float = 0.35
    min_outline_fraction: float = 0.02


LARGE = LargeErrorSettings()


@dataclass(frozen=True, eq=False)
class Correction:
    """What may be wrong with a whole scene, and how it reads once that is put right.

    Args:
        kind: "offset", "sign" or "log" of a joint (in the log's place: what is seen), "focal" of
            cameras, or "reading", of which the name is a sentence.
        name: of the joint, of the focal lengths' cameras, or what is wrong.
        cameras: as they are then.
        of: a frame as it is then.
        amount: what must be added: to a joint's positions [rad or m], to focal lengths [share].
        rank: of readings that explain equally well, the one with the lowest rank is named.
    """

    kind: str
    name: str
    cameras: tuple[Camera, ...]
    of: Callable[[MultiViewFrame], MultiViewFrame]
    amount: float = 0.0
    rank: float = 1.0


def unchanged(frame: MultiViewFrame) -> MultiViewFrame:
    """A frame of which nothing is changed."""
    return frame


def apply_corrections(readings: Sequence[Correction], frame: MultiViewFrame) -> MultiViewFrame:
    """A frame with what some readings put right, one after the other."""
    for one in readings:
        frame = one.of(frame)
    return frame


class LargeErrorSearch:
    """Compares body and silhouettes in some frames, as they are given and otherwise.

    Args:
        frames: all frames, of which some are compared.

    Raises:
        MaskError: a mask of another size than its camera's picture, or no mask shows the body.
    """

    def __init__(
        self, body: RegistrationBody, cameras: Sequence[Camera], frames: Sequence[MultiViewFrame]
    ) -> None:
        self._body, self._cameras = body, tuple(cameras)
        self._frames = evenly_spaced(frames, LARGE.frame_count)
        self._share = min(1.0, LARGE.side / common_size(cameras, self._frames))
        self._sums = dict[int, tuple[Mask, NDArray[np.int32]]]()

    def find(
        self,
        readings: Sequence[Correction],
        joints: Sequence[str],
        left: float = LARGE.max_remaining,
        likely: Collection[str] = (),
    ) -> Correction | None:
        """What explains the silhouettes much better than what is given; None: nothing does.

        Args:
            readings: of the scene.
            joints: whose positions may be wrong as well.
            left: largest share of what is not explained that is left.
            likely: joints that fits say are off: of these it may be all of it, and half of the
                frames need not gain.
        """
        given = self.misfits(Correction("", "", self._cameras, unchanged))
        told = [(one, self.misfits(one)) for one in readings]
        for name in joints:
            told += self._of_joint(name)
        explained = [
            (one, own.sum())
            for one, own in told
            if own.sum() <= (1.0 if one.name in likely else left) * given.sum()
            and np.mean(own < given) >= (0.5 if one.name in likely else LARGE.min_improved_frames)
            and not _is_near(self._body, one)
        ]
        alike = [one for one in explained if one[0].kind != "log"]
        free = min((left for one, left in explained if one.kind == "log"), default=np.inf)
        most = min((left for _, left in alike), default=np.inf)
        if given.sum() - most < LARGE.constant_gain * (given.sum() - free) or not alike:
            alike, most = [one for one in explained if one[0].kind == "log"], free
        enough = given.sum() - LARGE.equivalent_gain * (given.sum() - most)
        best = [one for one in alike if one[1] <= enough]
        return min(best, key=lambda one: (one[0].rank, one[1]))[0] if best else None

    def misfits(self, reading: Correction) -> Array:
        """(frames,) area that is in body or silhouette alone, of all cameras [pixel]."""
        frames = map(reading.of, self._frames)
        rows = [self._compare(one, one.values[None], reading.cameras)[0] for one in frames]
        return np.array(rows)

    def _compare(
        self, frame: MultiViewFrame, values: Array, cameras: Sequence[Camera] | None = None
    ) -> Array:
        """(n,) as misfits, of a frame at other values (n, m)."""
        kinematics, left = self._body.kinematics, np.zeros(len(values))
        X_WN = np.array([kinematics.poses(one) for one in values])
        for camera in self._cameras if cameras is None else cameras:
            if camera.name in frame.masks:
                mask, small = frame.masks[camera.name], downscaled(camera, self._share)
                if id(mask) not in self._sums:
                    # The mask is kept, so that no other one has its place in memory.
                    self._sums[id(mask)] = mask, reduced_sums(mask, small)
                sums = self._sums[id(mask)][1]
                X_CN = camera.X_CW @ X_WN
                found = score_bodies(self._body.coarse, X_CN, small, sums[None])
                left += found[:, 0] + float(sums[:, -1].sum()) - 2.0 * found[:, 1]
        return left

    def _of_joint(self, name: str) -> list[tuple[Correction, Array]]:
        """What may be wrong with a joint's positions, and the misfits that it leaves."""
        kinematics = self._body.kinematics
        j, frames = kinematics.names.index(name), self._frames
        angle, q = bool(kinematics.is_angle[j]), np.array([one.values[j] for one in frames])
        low, high = float(kinematics.lower[j]), float(kinematics.upper[j])
        step, fine = np.radians([LARGE.coarse_step, LARGE.fine_step])
        if not angle:
            step = (high - low) / (LARGE.slide_steps - 1)
            fine = step / LARGE.coarse_step * LARGE.fine_step
        grid = (
            np.arange(-np.pi, np.pi, step) if angle else np.linspace(low, high, LARGE.slide_steps)
        )
        beside = np.arange(-4, 5) * fine
        near = np.radians(LARGE.reach_angle) if angle else LARGE.reach_shift

        def compare(k: int, places: Array) -> Array:
            values = np.tile(frames[k].values, (len(places), 1))
            values[:, j] = places
            return self._compare(frames[k], values)

        profile = np.array(map_ordered(lambda k: compare(k, grid), range(len(frames))))

        def at(places: Array) -> Array:
            """(frames,) about the misfits at a place of each frame."""
            period = 2.0 * np.pi if angle else None
            rows = zip(places, profile, strict=True)
            return np.array([np.interp(one, grid, own, period=period) for one, own in rows])

        told, tried = list[tuple[Correction, Array]](), np.arange(-np.pi, np.pi, fine)
        if not angle:
            tried = np.linspace(low - high, high - low, 8 * LARGE.slide_steps)
        for sign, kind in ((1.0, "offset"), (-1.0, "sign")):
            costs = [at(sign * q + by).sum() for by in tried]
            about = tried[int(np.argmin(costs))]
            every = [(k, sign * q[k] + about + beside) for k in range(len(frames))]
            exact = np.array(map_ordered(lambda one: compare(*one), every))
            best = int(np.argmin(exact.sum(axis=0)))
            by = float(about + beside[best])
            if sign < 0.0:
                plain = np.array([compare(k, -q[[k]])[0] for k in range(len(frames))])
                told.append((self.joint_correction("sign", name, -1.0, 0.0, 0.0), plain))
            rank = 1.0 if sign > 0.0 else 2.0
            reading = self.joint_correction(kind, name, sign, by, rank)
            told.append((reading, exact[:, best]))
        inside = np.ones(len(grid), bool)
        if angle and high - low < 2.0 * np.pi:
            middle = 0.5 * (low + high)
            off = np.abs((grid - middle + np.pi) % (2.0 * np.pi) - np.pi)
            inside = off <= 0.5 * (high - low) + step
        seen = grid[np.argmin(np.where(inside, profile, np.inf), axis=1)]
        exact = np.array(map_ordered(lambda k: compare(k, seen[k] + beside), range(len(frames))))
        off = seen + beside[np.argmin(exact, axis=1)] - q
        if angle:
            # About the middle of the smaller side, as a turn may be counted more or less.
            middle = np.angle(np.exp(1j * off).mean())
            off = (off - middle + np.pi) % (2.0 * np.pi) - np.pi
        if np.median(np.abs(off - np.median(off))) <= near:
            # A constant, as well as single frames tell.
            return told
        free = Correction(
            "log", name, self._cameras, self._refound(j, grid[inside], beside), 0.0, 3.0
        )  # fmt: skip
        return [*told, (free, exact.min(axis=1))]

    def joint_correction(
        self, kind: str, name: str, sign: float, by: float, rank: float
    ) -> Correction:
        """Another sign of a joint's positions (sign -1), and what is added then [rad or m]."""
        j = self._body.kinematics.names.index(name)

        def changed(frame: MultiViewFrame) -> MultiViewFrame:
            values = frame.values.copy()
            values[j] = sign * values[j] + by
            return replace(frame, values=values)

        return Correction(kind, name, self._cameras, changed, by, rank)

    def _refound(
        self, j: int, grid: Array, beside: Array
    ) -> Callable[[MultiViewFrame], MultiViewFrame]:
        """A frame with a joint where it is seen."""

        def changed(frame: MultiViewFrame) -> MultiViewFrame:
            values = frame.values
            for turn in range(2):
                places = values[j] + beside if turn else grid
                tried = np.tile(values, (len(places), 1))
                tried[:, j] = places
                values = tried[int(np.argmin(self._compare(frame, tried)))]
            return replace(frame, values=values)

        return changed


def downscaled(camera: Camera, share: float) -> Camera:
    """A camera of pictures that are a share as large; a parallel one as it is."""
    if not isinstance(camera, PinholeCamera):
        return camera
    width, height = (max(8, round(share * side)) for side in (camera.width, camera.height))
    return camera.resized(width, height)


def mask_excess_and_lack(
    body: RegistrationBody,
    camera: Camera,
    values: Array,
    mask: Mask,
    size: float,
    band: float = 2.5,
) -> tuple[float, float]:
    """How much more than the body a silhouette shows, and how much of the body it lacks.

    Args:
        size: the root of the silhouettes' usual area [pixel]; both are shares of that of this one,
            of one that shows nothing of the usual one.
        band: what is nearer to the outlines [pixel] is none of it.
    """
    small = downscaled(camera, min(1.0, LARGE.side / size))
    share = small.width / camera.width
    seen = np.diff(reduced_sums(mask, small), axis=1).astype(np.uint8)
    drawn = draw_mask(body.medium, camera.X_CW @ body.kinematics.poses(values), small)
    side = 2 * max(1, round(band * share)) + 1
    ball = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    wide, wide_seen = (cv2.dilate(one.astype(np.uint8), ball) for one in (drawn, seen))
    area = float(seen.sum()) or (share * size) ** 2
    more, less = (seen > wide).sum(), (drawn > wide_seen).sum()
    return float(more) / area, float(less) / area


def _is_near(body: RegistrationBody, one: Correction) -> bool:
    """Whether fits reach what is off."""
    if one.kind == "offset":
        j = body.kinematics.names.index(one.name)
        near = np.radians(LARGE.reach_angle) if body.kinematics.is_angle[j] else LARGE.reach_shift
        return abs(one.amount) <= near
    return one.kind == "focal" and abs(one.amount) <= LARGE.reach_focal


def joint_inlier_ratios(fits: Sequence[FrameFit], joints: Sequence[str]) -> dict[str, float]:
    """By joint, what share fits of the outlines of all links that it moves, in all frames."""
    moves = [picture.moves.any(axis=2) for one in fits for picture in one.compared_masks]
    if not moves:
        return {}
    moved = np.any(moves, axis=0)[:, : len(joints)].astype(float)
    lengths, fit = np.sum([one.matched_lengths for one in fits], axis=0).T @ moved
    shares = fit / np.maximum(lengths, 1e-9)
    return {name: float(shares[k]) for k, name in enumerate(joints) if lengths[k] > 0.0}


def mismatched_links(fits: Sequence[FrameFit]) -> list[tuple[int, float]]:
    """Nodes of whose outlines hardly anything fits in all frames, and what share."""
    lengths, fitting = np.sum([one.matched_lengths for one in fits], axis=0).T
    shares = fitting / np.maximum(lengths, 1e-9)
    shown = lengths >= LARGE.min_outline_fraction * max(float(lengths.sum()), 1e-9)
    return [
        (int(k), float(shares[k]))
        for k in np.flatnonzero(shown & (shares < LARGE.max_misplaced_inlier_ratio))
    ]
