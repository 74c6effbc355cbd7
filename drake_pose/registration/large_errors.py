"""Find errors common to all frames that are too large for fits of single frames.

A fit near the given values treats a link far from its silhouette as damage to the mask. This search
compares the areas of body and silhouettes instead: over each joint's whole range, and with the
scene corrected in other ways (signs, conventions, focal lengths, exchanged cameras).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import Camera
from drake_pose.registration.per_frame_fit import FrameFit
from drake_pose.registration.posed_frames import (
    MultiViewFrame,
    common_size,
    downscaled,
    reduced_sums,
)
from drake_pose.registration.register import SEARCH, RegistrationBody, evenly_spaced
from drake_pose.silhouette.scoring import draw_mask, score_bodies
from drake_pose.workers import map_ordered


class LargeErrorSettings(NamedTuple):
    """Parameters of the search for large errors.

    Args:
        coarse_step, fine_step: steps of a joint's angle over its range, and about the best [deg].
        slide_steps: number of positions of a prismatic joint.
        max_remaining: a correction is accepted if at most this fraction of the area in body or
            silhouette alone remains.
        max_remaining_of_joint: the same where only single links fit badly.
        outlier_reduction: minimum factor by which a correction reduces the fraction of a joint's
            outlines that does not fit, where only single links fit badly.
        min_improved_frames: minimum fraction of the frames that a correction improves.
        equivalent_gain: a simpler correction is preferred if it gains this fraction of the best.
        constant_gain: positions that differ from the log by another amount in each frame are
            accepted only if no constant gains this fraction of what they gain.
        reach_angle, reach_shift, reach_focal: smaller errors are left to fits [deg, m, relative].
        frame_count: number of frames that are compared, evenly spaced.
        min_joint_inlier_ratio: a joint is searched if a smaller fraction of the outlines of all
            links that it moves fits.
        max_misplaced_inlier_ratio: a link is misplaced if a smaller fraction of its outline fits.
        min_outline_fraction: links with a smaller fraction of all outlines are not evaluated.

    Chosen on drawn arms of four and seven joints with one wrong joint each. Of the outlines of
    links in their logged positions, 0.9 or more fits (0.51 of a real, hardly visible flange); of
    others 0.47.
    """

    coarse_step: float = 5.0
    fine_step: float = 1.0
    slide_steps: int = 13
    max_remaining: float = 0.8
    max_remaining_of_joint: float = 0.97
    outlier_reduction: float = 2.0
    min_improved_frames: float = 0.7
    equivalent_gain: float = 0.85
    constant_gain: float = 0.8
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
    """A possible large error of a scene, and its correction.

    Args:
        kind: "offset" or "sign" of a joint; "log": the joint's positions are searched in each frame
            in place of the log's; "focal": focal lengths; "reading": see the name.
        name: of the joint, or words for the cameras or for what is wrong.
        cameras: the corrected cameras.
        apply: returns the corrected frame of a given one, which it leaves unchanged.
        amount: what is added to a joint's positions [rad or m] or the logarithms of focal lengths.
        rank: of corrections that explain equally well, the one with the lowest rank is chosen.
        fitted: names of the ``PerFrameFit``'s corrections that have this amount; (): none has.
    """

    kind: str
    name: str
    cameras: tuple[Camera, ...]
    apply: Callable[[MultiViewFrame], MultiViewFrame]
    amount: float = 0.0
    rank: float = 1.0
    fitted: tuple[str, ...] = ()


def unchanged(frame: MultiViewFrame) -> MultiViewFrame:
    """Return the frame itself."""
    return frame


def apply_corrections(corrections: Sequence[Correction], frame: MultiViewFrame) -> MultiViewFrame:
    """Return a frame with corrections applied one after another."""
    for one in corrections:
        frame = one.apply(frame)
    return frame


class LargeErrorSearch:
    """Compares body and silhouettes in some frames, with and without corrections.

    Args:
        body: the robot's surfaces.
        cameras: the cameras at their given poses.
        frames: all frames; at most LARGE.frame_count of them, evenly spaced, are compared.

    Raises:
        MaskError: a mask's size differs from its camera's, or no mask shows the body.
    """

    def __init__(
        self, body: RegistrationBody, cameras: Sequence[Camera], frames: Sequence[MultiViewFrame]
    ) -> None:
        self._body, self._cameras = body, tuple(cameras)
        self._frames = evenly_spaced(frames, LARGE.frame_count)
        self._scale = min(1.0, SEARCH.refined_side / common_size(cameras, self._frames))
        # By identity of a mask or camera; it is kept alive, so that its id is not reused.
        self._sums = dict[int, tuple[Mask, NDArray[np.int32]]]()
        self._small = dict[int, tuple[Camera, Camera]]()

    def find(
        self,
        corrections: Sequence[Correction],
        joints: Sequence[str],
        max_remaining: float = LARGE.max_remaining,
    ) -> Correction | None:
        """Return the simplest correction that explains the silhouettes much better; None: none.

        Args:
            corrections: candidates beside those of joints' positions, such as other cameras.
            joints: names of the joints whose positions may be wrong.
            max_remaining: maximum fraction of the area in body or silhouette alone that remains.
        """
        given = self.misfits(Correction("", "", self._cameras, unchanged))
        tried = [(one, self.misfits(one)) for one in corrections]
        for name in joints:
            tried += self._of_joint(name)
        explained = [
            (one, own.sum())
            for one, own in tried
            if own.sum() <= max_remaining * given.sum()
            and np.mean(own < given) >= LARGE.min_improved_frames
            and not _is_near(self._body, one)
        ]
        constant = [one for one in explained if one[0].kind != "log"]
        free = min((left for one, left in explained if one.kind == "log"), default=np.inf)
        most = min((left for _, left in constant), default=np.inf)
        if given.sum() - most < LARGE.constant_gain * (given.sum() - free) or not constant:
            constant, most = [one for one in explained if one[0].kind == "log"], free
        enough = given.sum() - LARGE.equivalent_gain * (given.sum() - most)
        best = [one for one in constant if one[1] <= enough]
        return min(best, key=lambda one: (one[0].rank, one[1]))[0] if best else None

    def misfits(self, correction: Correction) -> Array:
        """Return the area (frames,) in body or silhouette alone, over cameras [small pixel]."""
        frames = map(correction.apply, self._frames)
        rows = [self._compare(one, one.values[None], correction.cameras)[0] for one in frames]
        return np.array(rows)

    def _compare(
        self, frame: MultiViewFrame, values: Array, cameras: Sequence[Camera] | None = None
    ) -> Array:
        """Return the misfits (n,) at values (n, m), by corrected cameras; None: those given."""
        kinematics, left = self._body.kinematics, np.zeros(len(values))
        X_WN = np.array([kinematics.poses(one) for one in values])
        for camera in self._cameras if cameras is None else cameras:
            if camera.name in frame.masks:
                mask = frame.masks[camera.name]
                if id(camera) not in self._small:
                    self._small[id(camera)] = camera, downscaled(camera, self._scale)
                small = self._small[id(camera)][1]
                if id(mask) not in self._sums:
                    self._sums[id(mask)] = mask, reduced_sums(mask, small)
                sums = self._sums[id(mask)][1]
                X_CN = camera.X_CW @ X_WN
                found = score_bodies(self._body.coarse, X_CN, small, sums[None])
                left += found[:, 0] + float(sums[:, -1].sum()) - 2.0 * found[:, 1]
        return left

    def _of_joint(self, name: str) -> list[tuple[Correction, Array]]:
        """Return candidate corrections of joint `name`, each with its misfits (frames,).

        These are an offset, a sign, and a sign with an offset; and other positions in each frame
        ("log"), if these do not differ from the log by a constant.
        """
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
            """Return the misfits (n,) of frame k with the joint at n places [rad or m]."""
            values = np.tile(frames[k].values, (len(places), 1))
            values[:, j] = places
            return self._compare(frames[k], values)

        profile = np.array(map_ordered(lambda k: compare(k, grid), range(len(frames))))

        def at(places: Array) -> Array:
            """Interpolate the misfits (frames,) at one position in each frame."""
            period = 2.0 * np.pi if angle else None
            rows = zip(places, profile, strict=True)
            return np.array([np.interp(one, grid, own, period=period) for one, own in rows])

        found, shifts = list[tuple[Correction, Array]](), np.arange(-np.pi, np.pi, fine)
        if not angle:
            shifts = np.linspace(low - high, high - low, 8 * LARGE.slide_steps)
        for sign, kind in ((1.0, "offset"), (-1.0, "sign")):
            costs = [at(sign * q + by).sum() for by in shifts]
            about = shifts[int(np.argmin(costs))]
            every = [(k, sign * q[k] + about + beside) for k in range(len(frames))]
            exact = np.array(map_ordered(lambda one: compare(*one), every))
            best = int(np.argmin(exact.sum(axis=0)))
            by = float(about + beside[best])
            if sign < 0.0:
                plain = np.array([compare(k, -q[[k]])[0] for k in range(len(frames))])
                found.append((self.joint_correction("sign", name, -1.0, 0.0, 0.0), plain))
            rank = 1.0 if sign > 0.0 else 2.0
            correction = self.joint_correction(kind, name, sign, by, rank)
            found.append((correction, exact[:, best]))
        inside = np.ones(len(grid), bool)
        if angle and high - low < 2.0 * np.pi:
            middle = 0.5 * (low + high)
            off = np.abs((grid - middle + np.pi) % (2.0 * np.pi) - np.pi)
            inside = off <= 0.5 * (high - low) + step
        visible = grid[np.argmin(np.where(inside, profile, np.inf), axis=1)]
        exact = np.array(map_ordered(lambda k: compare(k, visible[k] + beside), range(len(frames))))
        off = visible + beside[np.argmin(exact, axis=1)] - q
        if angle:
            # Differences are angles: wrap them about their circular mean.
            middle = np.angle(np.exp(1j * off).mean())
            off = (off - middle + np.pi) % (2.0 * np.pi) - np.pi
        if np.median(np.abs(off - np.median(off))) <= near:
            # The differences from the log are constant.
            return found
        free = Correction(
            "log", name, self._cameras, self._refound(j, grid[inside], beside), 0.0, 3.0
        )  # fmt: skip
        return [*found, (free, exact.min(axis=1))]

    def joint_correction(
        self, kind: str, name: str, sign: float, by: float, rank: float
    ) -> Correction:
        """Return a ``Correction`` of a kind and rank to sign * q + by [rad or m] of a joint's q."""
        j = self._body.kinematics.names.index(name)

        def changed(frame: MultiViewFrame) -> MultiViewFrame:
            values = frame.values.copy()
            values[j] = sign * values[j] + by
            return replace(frame, values=values)

        fitted = (name,) if kind == "offset" else ()
        return Correction(kind, name, self._cameras, changed, by, rank, fitted)

    def _refound(
        self, j: int, grid: Array, beside: Array
    ) -> Callable[[MultiViewFrame], MultiViewFrame]:
        """Return a function that moves value j of a frame to where its silhouettes show it.

        The positions `grid` (k,) are tried, then those that differ from the best by `beside` (b,).
        """

        def changed(frame: MultiViewFrame) -> MultiViewFrame:
            values = frame.values
            for turn in range(2):
                places = values[j] + beside if turn else grid
                tried = np.tile(values, (len(places), 1))
                tried[:, j] = places
                values = tried[int(np.argmin(self._compare(frame, tried)))]
            return replace(frame, values=values)

        return changed


def mask_excess_and_lack(
    body: RegistrationBody,
    camera: Camera,
    values: Array,
    mask: Mask,
    size: float,
    band: float = 2.5,
) -> tuple[float, float]:
    """Return the areas in the silhouette alone and in the body alone, over the silhouette's area.

    Args:
        values: (m,) of the pose tree [rad or m].
        mask: (H, W) the silhouette in the camera's picture.
        size: square root of the silhouettes' usual area [pixel]; sets the scale of the compared
            pictures, and stands for the size of an empty mask.
        band: pixels nearer to the other's outline do not count [pixel].
    """
    small = downscaled(camera, min(1.0, SEARCH.refined_side / size))
    scale = small.width / camera.width
    shown = np.diff(reduced_sums(mask, small), axis=1).astype(np.uint8)
    drawn = draw_mask(body.medium, camera.X_CW @ body.kinematics.poses(values), small)
    side = 2 * max(1, round(band * scale)) + 1
    ball = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    wide, wide_shown = (cv2.dilate(one.astype(np.uint8), ball) for one in (drawn, shown))
    area = float(shown.sum()) or (scale * size) ** 2
    more, less = (shown > wide).sum(), (drawn > wide_shown).sum()
    return float(more) / area, float(less) / area


def _is_near(body: RegistrationBody, one: Correction) -> bool:
    """Return whether a correction is an offset or focal length so small that fits find it."""
    if one.kind == "offset":
        j = body.kinematics.names.index(one.name)
        near = np.radians(LARGE.reach_angle) if body.kinematics.is_angle[j] else LARGE.reach_shift
        return abs(one.amount) <= near
    return one.kind == "focal" and abs(one.amount) <= LARGE.reach_focal


def joint_inlier_ratios(fits: Sequence[FrameFit], joints: Sequence[str]) -> dict[str, float]:
    """Return, by joint, the inlier ratio of the compared outlines of all links that it moves.

    ``joints``: names of the fits' first unknowns, see ``PerFrameFit.joints``.
    """
    moves = [mask.moves.any(axis=2) for one in fits for mask in one.compared_masks]
    if not moves:
        return {}
    moved = np.any(moves, axis=0)[:, : len(joints)].astype(float)
    lengths, fitting = np.sum([one.matched_lengths for one in fits], axis=0).T @ moved
    ratios = fitting / np.maximum(lengths, 1e-9)
    return {name: float(ratios[k]) for k, name in enumerate(joints) if lengths[k] > 0.0}


def mismatched_links(fits: Sequence[FrameFit]) -> list[tuple[int, float]]:
    """Return index and inlier ratio of the nodes that hardly fit, over all frames together.

    Limits are those of LARGE; nodes with a small fraction of all outlines are left out.
    """
    lengths, fitting = np.sum([one.matched_lengths for one in fits], axis=0).T
    ratios = fitting / np.maximum(lengths, 1e-9)
    shown = lengths >= LARGE.min_outline_fraction * max(float(lengths.sum()), 1e-9)
    return [
        (int(k), float(ratios[k]))
        for k in np.flatnonzero(shown & (ratios < LARGE.max_misplaced_inlier_ratio))
    ]
