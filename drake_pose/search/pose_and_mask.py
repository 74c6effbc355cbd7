"""Pose and mask in turn: a rough pose tells where to look for the mask, the mask tells the pose.

How likely the body is at each pixel is sampled from the pose's uncertainty. Pictures of a camera
that stands still show the background beside the body; where they do, colours tell the body from it,
elsewhere GrabCut does. The first poses are searched by the cross-entropy method (Rubinstein 1999),
since joints that are all a few degrees off put a hand far beside its picture; then the one fit
draws the contour to the mask's edge. The last mask is the model's silhouette, along whose edge the
colours decide.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.fit.contour_fit import ContourFit, Prior, pack_views
from drake_pose.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.scoring import (
    draw_mask,
    prefix_sums,
    score_bodies,
)
from drake_pose.silhouette.segmentation import foreground_log_ratios, grab_cut
from drake_pose.workers import map_ordered

Likelihood = NDArray[np.float32]


@dataclass(frozen=True)
class PoseAndMaskSettings:
    """How far off the first poses may be, and how long they are improved.

    Sizes of silhouettes are roots of their areas. A pose's error is a fraction of the standard
    deviations of the first ones.
    """

    angle: float = math.radians(5.0)  # Standard deviation of each angle of the first poses [rad],
    length_share: float = 0.5  # of each length, as a fraction of its range,
    length: float = 0.05  # and of each length without limits [m].
    rounds: int = 7  # The greatest number.
    coarse_rounds: int = 3  # The first rounds look at smaller pictures,
    coarse_side: float = 100.0  # in which silhouettes have this size [pixel].
    searching: int = 2  # The first rounds search; later ones fit alone.
    triangles: int = 600  # Of a part in the contour fit.
    samples: int = 32  # Poses drawn to estimate the body's probability at each pixel.
    surface: float = 0.02  # Error of the surface itself [silhouette sizes].
    chances: tuple[float, float] = (0.01, 0.99)  # The least and the greatest probability.
    search_rounds: int = 5  # Of the cross-entropy search,
    searched: int = 60  # poses in each,
    kept: int = 8  # and poses that shape the next.
    widened: float = 1.1  # Factor on the spread of these,
    least_spread: float = 0.15  # which stays above this fraction of the first one.
    searched_share: float = 0.4  # Error of a pose that was searched.
    finest_share: float = 0.14  # Error at which rounds end.
    wide: float = 0.25  # The contour fit's first scale [silhouette sizes],
    narrow: float = 0.03  # its last one,
    spacing: float = 0.05  # and its spacing.
    settled: float = 0.995  # IoU of silhouettes of two rounds that are settled.


@dataclass(frozen=True, eq=False)
class FoundPose:
    """One frame's pose, and its masks.

    Args:
        values: (m,) of the pose tree [rad or m].
        masks: (H, W) of each camera; None where it has no picture of the frame.
        agreements: of each camera, IoU of the model's silhouette and of the mask that colours give
            by themselves; nan where there is no picture.
        deviations: (m,) how far the values are off the first ones, in their standard deviations.
    """

    values: Array
    masks: tuple[Mask | None, ...]
    agreements: tuple[float, ...]
    deviations: Array


class PictureLevel(NamedTuple):
    """Cameras, and of each frame each one's picture (H, W, 3), or None."""

    cameras: tuple[Camera, ...]
    pictures: Sequence[Sequence[Picture | None]]

    def smaller(self, share: float) -> "PictureLevel":
        """The same with pictures smaller by a share; a parallel camera has them as they are."""
        cameras = tuple(
            camera.resized(
                max(8, round(share * camera.width)), max(8, round(share * camera.height))
            )
            if isinstance(camera, PinholeCamera)
            else camera
            for camera in self.cameras
        )
        pictures: list[list[Picture | None]] = []
        for row in self.pictures:
            resized: list[Picture | None] = []
            for one, camera in zip(row, cameras, strict=True):
                size = camera.width, camera.height
                smaller = (
                    None if one is None else cv2.resize(one, size, interpolation=cv2.INTER_AREA)
                )
                resized.append(None if smaller is None else np.asarray(smaller, np.uint8))
            pictures.append(resized)
        return PictureLevel(cameras, pictures)


@dataclass(eq=False)
class _Progress:
    """A frame under way: what is known of it by now, as of ``FoundPose``."""

    values: Array
    start: Array
    rng: np.random.Generator
    share: float = 1.0
    chances: Sequence[Likelihood] = ()
    cuts: Sequence[Mask | None] = ()
    drawn: Sequence[Mask] = ()
    agreements: tuple[float, ...] = ()
    stays: bool = False
    settled: bool = False


class PoseAndMask:
    """Finds poses and masks of a body in the pictures of cameras that stand still."""

    def __init__(
        self,
        kinematics: TreeKinematics,
        cameras: Sequence[Camera],
        settings: PoseAndMaskSettings | None = None,
        seed: int = 0,
    ) -> None:
        self._kinematics, self._cameras = kinematics, tuple(cameras)
        self._settings = settings or PoseAndMaskSettings()
        self._seed = seed
        self._surfaces = TreeSurfaces(kinematics.tree)
        fitted = simplify_surfaces(self._surfaces, self._settings.triangles)
        self._few = simplify_surfaces(self._surfaces, VERY_FEW)
        self._fit = ContourFit(kinematics, fitted, pixels=100.0)
        ranges = kinematics.upper - kinematics.lower
        lengths = np.where(
            np.isfinite(ranges), self._settings.length_share * ranges, self._settings.length
        )
        spread = np.where(kinematics.is_angle, self._settings.angle, lengths)
        self._spread = np.where(ranges > 0.0, spread, 0.0)

    def run(
        self,
        pictures: Sequence[Sequence[Picture | None]],
        starts: Sequence[Array],
        on_round: Callable[[int], None] = lambda _: None,
    ) -> list[FoundPose]:
        """Finds all frames' poses and masks.

        Args:
            pictures: of each frame, each camera's (H, W, 3); None where it has none.
            starts: of each frame, (m,) a rough pose of the tree [rad or m].
            on_round: is called with the number of rounds done.
        """
        values = [np.clip(one, self._kinematics.lower, self._kinematics.upper) for one in starts]
        whole = PictureLevel(self._cameras, pictures)
        own = self._settings
        drawn = [self._draw(one, camera, few=True) for one in values for camera in self._cameras]
        size = math.sqrt(float(np.mean([np.count_nonzero(one) for one in drawn])))
        share = own.coarse_side / max(1.0, size)
        level = whole if share >= 1.0 else whole.smaller(share)
        # Each frame draws its own poses: frames are looked at side by side.
        rngs = np.random.default_rng(self._seed).spawn(len(values))
        frames = [_Progress(*one) for one in zip(values, starts, rngs, strict=True)]
        for k in range(own.rounds):
            if k == min(own.coarse_rounds, own.rounds - 1):
                level = whole
                for one in frames:
                    one.drawn = [self._draw(one.values, camera) for camera in self._cameras]
            self._round(level, frames, searching=k < own.searching)
            on_round(k + 1)
            for one in frames:
                one.settled = level is whole and one.stays and one.share <= own.finest_share
            if all(one.settled for one in frames):
                break
        spread = np.where(self._spread > 0.0, self._spread, np.inf)
        return [
            FoundPose(
                one.values,
                tuple(
                    None if mask is None else follow_colours(silhouette, mask)
                    for silhouette, mask in zip(one.drawn, one.cuts, strict=True)
                ),
                one.agreements,
                (one.values - one.start) / spread,
            )
            for one in frames
        ]

    def _round(self, level: PictureLevel, frames: Sequence[_Progress], searching: bool) -> None:
        """Betters the frames that are not settled."""
        moving = [k for k, one in enumerate(frames) if not one.settled]

        def likely(k: int) -> None:
            frames[k].chances = self._chances(level, frames[k])

        map_ordered(likely, moving)
        ratios = self._ratios(level, frames)

        def better(k: int) -> None:
            frame, own = frames[k], self._settings
            if searching:
                frame.values = self._search(level, frame, ratios[k])
                frame.share = min(frame.share, own.searched_share)
                frame.chances = self._chances(level, frame)
            frame.cuts = [
                None if picture is None else cut_by_foreground(picture, chance, told)
                for picture, chance, told in zip(
                    level.pictures[k], frame.chances, ratios[k], strict=True
                )
            ]
            before, frame.values = frame.drawn, self._refine(level, frame)
            frame.drawn = [self._draw(frame.values, camera) for camera in level.cameras]
            frame.stays = bool(before) and all(
                intersection_over_union(*pair) > own.settled
                for pair in zip(frame.drawn, before, strict=True)
            )
            frame.agreements = tuple(
                math.nan if mask is None else intersection_over_union(silhouette, mask)
                for silhouette, mask in zip(frame.drawn, frame.cuts, strict=True)
            )
            frame.share = narrowed(frame.share, frame.agreements, own)

        map_ordered(better, moving)

    def _draw(self, values: Array, camera: Camera, few: bool = False) -> Mask:
        """The body's silhouette (H, W)."""
        X_CN = camera.X_CW @ self._kinematics.poses(values)
        if few:
            return draw_mask(self._few, X_CN, camera)
        return draw_mask(self._surfaces.at(self._kinematics.split(values)), X_CN, camera)

    def _sample(self, rng: np.random.Generator, values: Array, spread: Array, count: int) -> Array:
        """(count, m) values about some, inside the limits."""
        drawn = values + spread * rng.standard_normal((count, len(values)))
        return np.clip(drawn, self._kinematics.lower, self._kinematics.upper)

    def _chances(self, level: PictureLevel, frame: _Progress) -> list[Likelihood]:
        """How likely the body is at each pixel, of each camera."""
        spread, found, count = frame.share * self._spread, [], self._settings.samples
        poses = self._sample(frame.rng, frame.values, spread, count)
        for camera in level.cameras:
            total = np.zeros((camera.height, camera.width), dtype=np.float32)
            for pose in poses:
                total += self._draw(pose, camera, few=True)
            blur = max(1.0, self._settings.surface * math.sqrt(float(total.sum()) / count))
            chance = cv2.GaussianBlur(total / count, (0, 0), blur)
            found.append(np.clip(chance, *self._settings.chances).astype(np.float32))
        return found

    def _ratios(self, level: PictureLevel, frames: Sequence[_Progress]) -> list[list[Likelihood]]:
        """What the background says, of each frame and camera.

        Nothing where there is no picture, or of settled frames.
        """
        found = [[np.zeros_like(chance) for chance in one.chances] for one in frames]
        for c in range(len(level.cameras)):
            seen = [(f, own[c]) for f, own in enumerate(level.pictures)]
            there = [(f, picture) for f, picture in seen if picture is not None]
            moving = [k for k, (f, _) in enumerate(there) if not frames[f].settled]
            if moving:
                told = foreground_log_ratios(
                    [picture for _, picture in there],
                    [frames[f].chances[c] for f, _ in there],
                    moving,
                )
                for k, ratio in zip(moving, told, strict=True):
                    found[there[k][0]][c] = ratio
        return found

    def _search(self, level: PictureLevel, frame: _Progress, ratios: Sequence[Likelihood]) -> Array:
        """The pose near a frame's that covers most of what is not background."""
        # Log-odds are summed as integers, in units of 1/64.
        parts, own = 64.0, self._settings
        told = [
            (camera, prefix_sums(np.rint(parts * one).astype(np.int32))[None])
            for camera, one in zip(level.cameras, ratios, strict=True)
            if one.any()
        ]
        if not told:
            return frame.values
        first = frame.share * self._spread
        middle, spread, best, most = frame.values, first, frame.values, -math.inf
        for _ in range(own.search_rounds):
            poses = self._sample(frame.rng, middle, spread, own.searched)
            poses[0] = middle
            X_WN = np.array([self._kinematics.poses(pose) for pose in poses])
            scores = np.zeros(len(poses))
            for camera, sums in told:
                scores += score_bodies(self._few, camera.X_CW @ X_WN, camera, sums)[:, 1]
            order = np.argsort(-scores, kind="stable")[: own.kept]
            if scores[order[0]] > most:
                best, most = poses[order[0]], scores[order[0]]
            middle = poses[order].mean(axis=0)
            wider = own.widened * poses[order].std(axis=0)
            spread = np.maximum(wider, own.least_spread * first)
        return best

    def _refine(self, level: PictureLevel, frame: _Progress) -> Array:
        """The pose whose contour lies along the masks' edges."""
        masks, own = frame.cuts, self._settings
        areas = [np.count_nonzero(mask) for mask in masks if mask is not None and mask.any()]
        if not areas:
            return frame.values
        size = math.sqrt(float(np.mean(areas)))
        edges = [NO_EDGE if mask is None else find_edge_points(mask, 2.0) for mask in masks]
        # Rounds are in hundreds of pixels.
        rounds = [
            AnnealingStage(one * size / 200.0, own.spacing, 8)
            for one in np.geomspace(max(own.spacing, own.wide * frame.share), own.narrow, 4)
        ]
        held = self._spread <= 0.0
        prior = Prior(frame.start, np.where(held, 0.0, 1.0 / np.maximum(self._spread, 1e-9) ** 2))
        views = pack_views(level.cameras, edges)
        return self._fit.fit(views, frame.values, rounds, prior, held).values


def cut_by_foreground(
    picture: Picture,
    chance: Likelihood,
    ratio: Likelihood,
    sure: float = 4.0,
    least: float = PoseAndMaskSettings.chances[0],
) -> Mask:
    """The object (H, W) in a picture (H, W, 3), by GrabCut where neither pose nor colour is sure.

    Args:
        chance: (H, W) of the object, by its pose; ``least``: where it is surely not.
        ratio: (H, W) log-odds by its colour.
        sure: by such log-odds a pixel is surely the object, or surely not.
    """
    foreground = np.log(chance / (1.0 - chance)) + ratio
    labels = np.where(foreground > 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[foreground > sure] = cv2.GC_FGD
    labels[(foreground < -sure) | (chance <= least)] = cv2.GC_BGD
    # GrabCut's two rounds learn colours of bodies 30 pixels large; a median filter takes specks
    # away.
    every = max(1, int(math.sqrt(np.count_nonzero(foreground > 0.0)) / 30.0))
    found = grab_cut(picture, labels, 2, every)
    return np.asarray(cv2.medianBlur(found.astype(np.uint8), 5) > 0)


def follow_colours(silhouette: Mask, mask: Mask, band: float = 0.01) -> Mask:
    """A silhouette (H, W) that is as a mask (H, W) is along its edge.

    ``band``: how far from the edge, as a share of the silhouette's size.
    """
    size = math.sqrt(max(1, int(np.count_nonzero(silhouette))))
    reach = max(1, round(band * size))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    own = silhouette.astype(np.uint8)
    inner = cv2.erode(own, disc, borderType=cv2.BORDER_REPLICATE) > 0
    outer = cv2.dilate(own, disc) > 0
    return np.asarray(inner | (outer & mask))


def narrowed(share: float, agreements: Sequence[float], settings: PoseAndMaskSettings) -> float:
    """How far off a pose may still be, as a share, after a round that agreed so well."""
    agreed = float(np.nanmin(np.array(agreements)))
    if agreed > 0.9:
        return max(0.5 * share, settings.finest_share)
    return max(0.7 * share, settings.searched_share) if agreed > 0.8 else share
