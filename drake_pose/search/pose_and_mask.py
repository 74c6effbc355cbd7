"""Estimate a body's pose and its masks alternately, in the images of static cameras.

1. The foreground probability at each pixel is the frequency with which the body covers the pixel in
   poses drawn from the uncertainty of the current pose.
2. Pixels where other images show the background get a log-likelihood ratio of foreground and
   background by their colour. The rest is decided by GrabCut; the result is a mask.
3. In the first rounds the pose that covers the most foreground is searched by the cross-entropy
   method (Rubinstein 1999), because errors of a few degrees in all joints move a hand far away.
4. The contour of the body is fitted to the edge of the mask.

The returned mask is the silhouette of the model, except near its edge, where it is the mask by
colours.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.fit.contour_fit import ContourFit, Prior, pack_views
from drake_pose.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.scoring import draw_mask, prefix_sums, score_bodies
from drake_pose.silhouette.segmentation import foreground_log_ratios, grab_cut
from drake_pose.workers import map_ordered


@dataclass(frozen=True)
class PoseAndMaskSettings:
    """Parameters of the alternating estimation of pose and mask.

    The size of a silhouette is the square root of its area. The error of a pose is given as a
    fraction of the standard deviations of the initial poses.
    """

    # Standard deviation of the initial poses: of each angle [rad], of each length with limits, as a
    # fraction of its range, and of each length without limits [m].
    angle: float = math.radians(5.0)
    length_fraction: float = 0.5
    length: float = 0.05
    rounds: int = 7  # Greatest number of rounds.
    coarse_rounds: int = 3  # Number of first rounds with reduced images,
    coarse_side: float = 100.0  # in which silhouettes have this size [pixel].
    searched_rounds: int = 2  # Number of first rounds with a cross-entropy search.
    triangles: int = 600  # Triangles of a part in the contour fit.
    samples: int = 32  # Number of poses drawn to estimate foreground probabilities.
    surface_error: float = 0.02  # Error of the surface itself [silhouette sizes].
    probabilities: tuple[float, float] = (0.01, 0.99)  # Least and greatest probability.
    iterations: int = 5  # Iterations of the cross-entropy search,
    iteration_poses: int = 60  # number of poses drawn in each,
    elite_poses: int = 8  # and number of the best, whose mean and spread define the next.
    spread_factor: float = 1.1  # Factor of the spread of the best poses,
    least_spread: float = 0.15  # and its minimum, as a fraction of the spread at the start.
    searched_error: float = 0.4  # Error of a pose after a search.
    finest_error: float = 0.14  # Error at which rounds end.
    first_scale: float = 0.25  # First scale of the contour fit at error 1 [silhouette sizes],
    last_scale: float = 0.03  # its last scale,
    spacing: float = 0.05  # and its spacing.
    # A frame is settled if the IoU of its silhouettes in successive rounds exceeds this.
    settled: float = 0.995


@dataclass(frozen=True, eq=False)
class FoundPose:
    """The estimated pose of one frame, and its masks.

    Args:
        values: (m,) values of the pose tree [rad or m].
        masks: for each camera (H, W) the mask; None where it has no image of the frame.
        agreements: for each camera the IoU of the model's silhouette and the mask by colours; nan
            where there is no image.
        deviations: (m,) difference of the values from the initial ones, in standard deviations of
            the initial ones.
    """

    values: Array
    masks: tuple[Mask | None, ...]
    agreements: tuple[float, ...]
    deviations: Array


class PictureLevel(NamedTuple):
    """A pyramid level: cameras, and for each frame each camera's image (H, W, 3) or None."""

    cameras: tuple[Camera, ...]
    pictures: Sequence[Sequence[Picture | None]]

    def downscaled(self, factor: float) -> "PictureLevel":
        """Return the level with images of pinhole cameras reduced by a factor below 1."""
        cameras = tuple(
            camera.resized(
                max(8, round(factor * camera.width)), max(8, round(factor * camera.height))
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
    """The current estimate of one frame."""

    values: Array  # (m,) current values [rad or m].
    start: Array  # (m,) initial values [rad or m].
    rng: np.random.Generator  # The frame's generator of random numbers.
    error: float = 1.0  # Error of the pose, as a fraction of the initial standard deviations.
    # For each camera (H, W) the foreground probability at the round's level.
    probabilities: Sequence[Floats] = ()
    # For each camera (H, W) the mask by colours; None where there is no image.
    cuts: Sequence[Mask | None] = ()
    # For each camera (H, W) the model's silhouette; empty before the first round.
    drawn: Sequence[Mask] = ()
    agreements: tuple[float, ...] = ()  # As in ``FoundPose``.
    unchanged: bool = False  # Whether the silhouettes are those of the previous round.
    settled: bool = False  # Whether the frame is finished.


class PoseAndMask:
    """Estimates poses and masks of a body in the images of static cameras.

    Args:
        kinematics: kinematics of the pose tree, with m values.
        cameras: the static cameras.
        settings: parameters of the estimation; None: the defaults.
        seed: seed of the random poses.
    """

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
            np.isfinite(ranges), self._settings.length_fraction * ranges, self._settings.length
        )
        spread = np.where(kinematics.is_angle, self._settings.angle, lengths)
        self._spread = np.where(ranges > 0.0, spread, 0.0)

    def run(
        self,
        pictures: Sequence[Sequence[Picture | None]],
        starts: Sequence[Array],
        on_round: Callable[[int], None] = lambda _: None,
    ) -> list[FoundPose]:
        """Estimate the poses and masks of all frames, and return those of each frame.

        Args:
            pictures: for each frame and camera the image (H, W, 3); None where there is none.
            starts: for each frame (m,) values of an approximate pose [rad or m].
            on_round: called after each round with the number of rounds done.
        """
        values = [np.clip(one, self._kinematics.lower, self._kinematics.upper) for one in starts]
        whole = PictureLevel(self._cameras, pictures)
        settings = self._settings
        drawn = [self._draw(one, camera, few=True) for one in values for camera in self._cameras]
        size = math.sqrt(float(np.mean([np.count_nonzero(one) for one in drawn])))
        factor = settings.coarse_side / max(1.0, size)
        level = whole if factor >= 1.0 else whole.downscaled(factor)
        # Each frame has its own generator, so results do not depend on the order of parallel tasks.
        rngs = np.random.default_rng(self._seed).spawn(len(values))
        frames = [_Progress(*one) for one in zip(values, starts, rngs, strict=True)]
        for k in range(settings.rounds):
            if k == min(settings.coarse_rounds, settings.rounds - 1):
                level = whole
                for one in frames:
                    one.drawn = [self._draw(one.values, camera) for camera in self._cameras]
            self._round(level, frames, searches=k < settings.searched_rounds)
            on_round(k + 1)
            for one in frames:
                one.settled = (
                    level is whole and one.unchanged and one.error <= settings.finest_error
                )
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

    def _round(self, level: PictureLevel, frames: Sequence[_Progress], searches: bool) -> None:
        """Run one round: update pose, masks and error of all frames that are not settled.

        ``level``: the pyramid level whose images are used. ``frames``: the estimates of all frames,
        changed in place. ``searches``: whether the cross-entropy search is run before the fit.
        """
        moving = [k for k, one in enumerate(frames) if not one.settled]

        def sample(k: int) -> None:
            frames[k].probabilities = self._probabilities(level, frames[k])

        map_ordered(sample, moving)
        log_ratios = self._log_ratios(level, frames)

        def improve(k: int) -> None:
            frame, settings = frames[k], self._settings
            if searches:
                frame.values = self._search(level, frame, log_ratios[k])
                frame.error = min(frame.error, settings.searched_error)
                frame.probabilities = self._probabilities(level, frame)
            frame.cuts = [
                None if picture is None else cut_by_foreground(picture, probability, log_ratio)
                for picture, probability, log_ratio in zip(
                    level.pictures[k], frame.probabilities, log_ratios[k], strict=True
                )
            ]
            before, frame.values = frame.drawn, self._refine(level, frame)
            frame.drawn = [self._draw(frame.values, camera) for camera in level.cameras]
            frame.unchanged = bool(before) and all(
                intersection_over_union(*pair) > settings.settled
                for pair in zip(frame.drawn, before, strict=True)
            )
            frame.agreements = tuple(
                math.nan if mask is None else intersection_over_union(silhouette, mask)
                for silhouette, mask in zip(frame.drawn, frame.cuts, strict=True)
            )
            frame.error = next_error(frame.error, frame.agreements, settings)

        map_ordered(improve, moving)

    def _draw(self, values: Array, camera: Camera, few: bool = False) -> Mask:
        """Return the silhouette (H, W) at values (m,); ``few``: of few triangles, without skin."""
        X_CN = camera.X_CW @ self._kinematics.poses(values)
        if few:
            return draw_mask(self._few, X_CN, camera)
        return draw_mask(self._surfaces.at(self._kinematics.split(values)), X_CN, camera)

    def _sample(self, rng: np.random.Generator, values: Array, spread: Array, count: int) -> Array:
        """Draw (count, m) normal values of means and deviations (m,) [rad or m], within limits."""
        drawn = values + spread * rng.standard_normal((count, len(values)))
        return np.clip(drawn, self._kinematics.lower, self._kinematics.upper)

    def _probabilities(self, level: PictureLevel, frame: _Progress) -> list[Floats]:
        """Return for each camera (H, W) a frame's foreground probability at a pyramid level.

        It is the fraction of random poses, spread by the frame's error, whose silhouettes cover a
        pixel, blurred by the error of the surface and clipped to ``settings.probabilities``.
        """
        spread, found, count = frame.error * self._spread, [], self._settings.samples
        poses = self._sample(frame.rng, frame.values, spread, count)
        for camera in level.cameras:
            total = np.zeros((camera.height, camera.width), dtype=np.float32)
            for pose in poses:
                total += self._draw(pose, camera, few=True)
            blur = max(1.0, self._settings.surface_error * math.sqrt(float(total.sum()) / count))
            blurred = cv2.GaussianBlur(total / count, (0, 0), blur)
            found.append(np.clip(blurred, *self._settings.probabilities).astype(np.float32))
        return found

    def _log_ratios(self, level: PictureLevel, frames: Sequence[_Progress]) -> list[list[Floats]]:
        """Return for each frame and camera (H, W) log-likelihood ratios by colour.

        They are of foreground against background, in the images of ``level``, and 0 where there is
        no image, and in settled frames.
        """
        found = [[np.zeros_like(one) for one in frame.probabilities] for frame in frames]
        for c in range(len(level.cameras)):
            own = [(f, pictures[c]) for f, pictures in enumerate(level.pictures)]
            there = [(f, picture) for f, picture in own if picture is not None]
            moving = [k for k, (f, _) in enumerate(there) if not frames[f].settled]
            if moving:
                log_ratios = foreground_log_ratios(
                    [picture for _, picture in there],
                    [frames[f].probabilities[c] for f, _ in there],
                    moving,
                )
                for k, log_ratio in zip(moving, log_ratios, strict=True):
                    found[there[k][0]][c] = log_ratio
        return found

    def _search(self, level: PictureLevel, frame: _Progress, log_ratios: Sequence[Floats]) -> Array:
        """Return values (m,) near a frame's whose silhouette has the greatest sum of log ratios.

        ``log_ratios``: for each camera (H, W), as ``_log_ratios`` returns for the frame; if all are
        zero, the frame's values are returned.
        """
        # Log ratios are summed as integers, in units of 1/64.
        parts, settings = 64.0, self._settings
        shown = [
            (camera, prefix_sums(np.rint(parts * one).astype(np.int32))[None])
            for camera, one in zip(level.cameras, log_ratios, strict=True)
            if one.any()
        ]
        if not shown:
            return frame.values
        first = frame.error * self._spread
        mean, spread, best, most = frame.values, first, frame.values, -math.inf
        for _ in range(settings.iterations):
            poses = self._sample(frame.rng, mean, spread, settings.iteration_poses)
            poses[0] = mean
            X_WN = np.array([self._kinematics.poses(pose) for pose in poses])
            scores = np.zeros(len(poses))
            for camera, sums in shown:
                scores += score_bodies(self._few, camera.X_CW @ X_WN, camera, sums)[:, 1]
            order = np.argsort(-scores, kind="stable")[: settings.elite_poses]
            if scores[order[0]] > most:
                best, most = poses[order[0]], scores[order[0]]
            mean = poses[order].mean(axis=0)
            wider = settings.spread_factor * poses[order].std(axis=0)
            spread = np.maximum(wider, settings.least_spread * first)
        return best

    def _refine(self, level: PictureLevel, frame: _Progress) -> Array:
        """Return values (m,) fitted to a frame's ``cuts``; its own if no mask shows the body."""
        masks, settings = frame.cuts, self._settings
        areas = [np.count_nonzero(mask) for mask in masks if mask is not None and mask.any()]
        if not areas:
            return frame.values
        size = math.sqrt(float(np.mean(areas)))
        edges = [NO_EDGE if mask is None else find_edge_points(mask, 2.0) for mask in masks]
        # The fit's unit of length is 100 pixels.
        first = max(settings.spacing, settings.first_scale * frame.error)
        stages = [
            AnnealingStage(one * size / 200.0, settings.spacing, 8)
            for one in np.geomspace(first, settings.last_scale, 4)
        ]
        held = self._spread <= 0.0
        prior = Prior(frame.start, np.where(held, 0.0, 1.0 / np.maximum(self._spread, 1e-9) ** 2))
        views = pack_views(level.cameras, edges)
        return self._fit.fit(views, frame.values, stages, prior, held).values


def cut_by_foreground(
    picture: Picture,
    probability: Floats,
    log_ratio: Floats,
    sure: float = 4.0,
    least: float = PoseAndMaskSettings.probabilities[0],
) -> Mask:
    """Return the mask (H, W) of the foreground, by GrabCut where the log-odds are not decisive.

    The log-odds are log(p / (1 - p)) + log_ratio, with the foreground probability p by the pose.

    Args:
        picture: (H, W, 3) the image.
        probability: (H, W) the foreground probability p.
        log_ratio: (H, W) log-likelihood ratio of foreground and background, by colour.
        sure: log-odds above this are certainly foreground, below minus this background; GrabCut
            decides between, starting from the sign.
        least: pixels with a probability up to this are certainly background, whatever the log-odds.
    """
    log_odds = np.log(probability / (1.0 - probability)) + log_ratio
    labels = np.where(log_odds > 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[log_odds > sure] = cv2.GC_FGD
    labels[(log_odds < -sure) | (probability <= least)] = cv2.GC_BGD
    # GrabCut learns colours in two iterations, from images in which the body is about 30 pixels
    # large. The median filter removes specks.
    every = max(1, int(math.sqrt(np.count_nonzero(log_odds > 0.0)) / 30.0))
    found = grab_cut(picture, labels, 2, every)
    return np.asarray(cv2.medianBlur(found.astype(np.uint8), 5) > 0)


def follow_colours(silhouette: Mask, mask: Mask, band: float = 0.01) -> Mask:
    """Return a silhouette (H, W) whose edge is replaced by that of a mask (H, W) near to it.

    ``band``: half width of the band along the edge in which the mask decides, as a fraction of the
    square root of the silhouette's area.
    """
    size = math.sqrt(max(1, int(np.count_nonzero(silhouette))))
    reach = max(1, round(band * size))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    inside = silhouette.astype(np.uint8)
    inner = cv2.erode(inside, disc, borderType=cv2.BORDER_REPLICATE) > 0
    outer = cv2.dilate(inside, disc) > 0
    return np.asarray(inner | (outer & mask))


def next_error(error: float, agreements: Sequence[float], settings: PoseAndMaskSettings) -> float:
    """Return the error of a pose after a round, from the error before and the round's agreements.

    It is max(error / 2, ``finest_error``) if the least agreement is above 0.9,
    max(0.7 error, ``searched_error``) if it is above 0.8, and unchanged otherwise.

    Args:
        error: as a fraction of the standard deviations of the initial poses.
        agreements: IoU of silhouette and mask by colours in each camera; NaN is ignored.
        settings: the minima of the error.
    """
    agreement = float(np.nanmin(np.array(agreements)))
    if agreement > 0.9:
        return max(0.5 * error, settings.finest_error)
    return max(0.7 * error, settings.searched_error) if agreement > 0.8 else error
