"""Where a camera stands, told by its pictures alone: no masks, no guess.

The body's positions are known in each picture, and the camera stands still: so a pose of the camera
says in which frames the body covers each pixel, and the pixels' colours say how well that fits
(``fit.background``). Rotations spread over all, and more of them near upright, are tried with the
bodies where pictures change; the best are improved step by step, in larger and larger pictures, and
in the end by the one fit, on lines across the contour in the odds of pixels to show the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.background import KnownBackground, Light, mask_of_odds, odds_picture
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.fit.surfaces import hull_of_few
from drake_pose.registration.picture_levels import PictureLevel, SearchRound
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import RegistrationBody
from drake_pose.registration.shared_fit import Shared, SharedFit
from drake_pose.silhouette.areas.outline import NOTHING, Outline
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.workers import map_ordered

SEARCHED = 12
"""So many pictures carry a search."""

_ROUNDS = (
    SearchRound(64, 250, 24, 0.25),
    SearchRound(64, 80, 30, 0.15),
    SearchRound(80, 30, 50, 0.1),
    SearchRound(160, 10, 80, 0.06),
)
# So many frames, those that differ most, say which share of the starts is looked at in all.
_FIRST, _GOOD = 4, 0.25
ABOUT = 100
"""Triangles of a node where a body is about."""

# Triangles of a node, up to which width of pictures [pixel].
_TRIANGLES, _WIDTHS = (12, 40, ABOUT), (64, 120)
# Parts that are smaller than so many times the largest one do not show in the smallest pictures.
_SMALL = 0.25
# Poses are compared in pictures so wide, and backgrounds learned in these.
_COMPARED, _LEARNED = 160, 320
# Fits on lines: scales of steps [pixel of a picture _SCALED wide], and from line to line [scale];
# backgrounds are learned anew before each row. What lines cost does not compare from place to
# place, so each step is taken.
_SCALED, _SPACING = 320.0, 0.5
_ROUGH = ((*(12.0,) * 4, *(8.0,) * 4, *(5.0,) * 4), (*(6.0,) * 3, *(4.0,) * 3))
_FINE = ((*(5.0,) * 4, *(3.0,) * 4), (*(3.0,) * 2, *(2.0,) * 3, *(1.0,) * 3))
_LAST = (0.75,) * 7


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """One picture of a body at known joint positions.

    Args:
        values: (m,) of the body's pose tree [rad or m].
        picture: (H, W, 3) red, green, blue.
        rates: (m,) how fast the values change [rad/s or m/s]; None: nobody knows.
    """

    name: str
    values: Array
    picture: Picture
    rates: Array | None = None


@dataclass(frozen=True, eq=False)
class PictureFit:
    """A camera that was fitted to pictures.

    Args:
        fit: the fit of its frames, which have the odds of their pixels, and masks of these.
        found: by it.
        background: what is behind the body, by which odds of other pictures are told.
        explained: share of what could be explained at most, that the pose explains.
        contour: how strong edges are along the outlines, beyond chance.
    """

    fit: SharedFit
    found: Shared
    background: KnownBackground
    explained: float
    contour: float

    @property
    def camera(self) -> PinholeCamera:
        """Where it was found."""
        return self.fit.cameras(self.found)[0]


def node_places(body: RegistrationBody, values: Array) -> Array:
    """(f, n, 3) the middles of the nodes that show, in frames with values (f, m) [m]."""
    shown = [k for k, one in enumerate(body.very_few) if len(one.vertices)]
    X_WN = np.array([body.kinematics.poses(one)[shown] for one in values])
    middles = np.array([body.very_few[k].ball[:3] for k in shown])
    return np.asarray(np.einsum("fnij,nj->fni", X_WN[..., :3, :3], middles) + X_WN[..., :3, 3])


def choose_frames(places: Array, count: int) -> list[int]:
    """Which of frames differ most, best first (farthest point sampling).

    Args:
        places: (f, n, 3) as of ``node_places``.
    """

    def off(other: Array) -> Array:
        return np.asarray(np.linalg.norm(places - other, axis=2).mean(axis=1))

    chosen = [int(np.argmax(off(places.mean(axis=0))))]
    nearest = off(places[chosen[0]])
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, off(places[chosen[-1]]))
    return chosen


class PictureSearch:
    """Finds where a camera stands in some of its pictures.

    Args:
        camera: its pose is not used.
        frames: those that tell most first.
    """

    def __init__(
        self, body: RegistrationBody, camera: PinholeCamera, frames: Sequence[PosedPicture]
    ) -> None:
        self._body, self._camera, self.frames = body, camera, tuple(frames)
        coarse = hull_of_few(body.very_few, _TRIANGLES[0])
        least = _SMALL * max(one.ball[3] for one in coarse)
        coarse = tuple(one if one.ball[3] >= least else NOTHING for one in coarse)
        finer = (hull_of_few(body.very_few, count) for count in _TRIANGLES[1:])
        self._outlines = (coarse, *finer)
        self._X_WN = np.array([body.kinematics.poses(one.values) for one in frames])
        self._levels = dict[int, PictureLevel]()

    @property
    def compared(self) -> PictureLevel:
        """In which poses are compared."""
        return self._level(_COMPARED)

    def search(self) -> list[Array]:
        """Poses X_CW (4, 4) near which the camera's may be, best first."""
        level = self._level(_ROUNDS[0].width)
        found = level.starts()
        for frames, share in ((_FIRST, _GOOD), (len(self.frames), 1.0)):
            found = level.best(found, frames, share)
        after = (*(one.kept for one in _ROUNDS[1:]), _ROUNDS[-1].kept)
        for step, most in zip(_ROUNDS, after, strict=True):
            level = self._level(step.width)
            improve = partial(level.improve, step=step)
            improved = map_ordered(improve, enumerate(found[: step.kept]))
            improved.sort(key=lambda one: -one[0])
            found = level.distinct([X for _, X in improved], most)
        return found

    def approach(self, X_CW: Array) -> tuple[PinholeCamera, tuple[float, float]] | None:
        """A camera fitted roughly from where it stands, and what it explains in `compared`.

        None where the body leaves the pictures.
        """
        frames, small = self._small
        for scales in _ROUGH:
            camera = small.with_pose(np.linalg.inv(X_CW))
            known, covered = self._learn(camera, frames)
            seen = self._see(camera, frames, known, covered, self._outlines[-1])
            if seen is None:
                return None
            fit = SharedFit([seen], [X_CW], widths=False)
            X_CW = fit.cameras(fit.fit(_stages(scales, seen)))[0].X_CW
        return self._camera.with_pose(np.linalg.inv(X_CW)), self.compared.explained(X_CW)

    def fit(
        self, camera: PinholeCamera, constants: Sequence[str] = (), focal: bool = False
    ) -> PictureFit | None:
        """A camera fitted on lines across the contour in the frames, from near where it stands.

        None where the body leaves the pictures.

        Args:
            constants: what else of all frames is fitted, as of ``SharedFit``.
            focal: whether its focal length is, too.
        """
        looks, seen = len(POSE_NAMES) + focal, None
        for scales, outlines in zip(_FINE, (self._outlines[-1], self._body.few), strict=True):
            known, covered = self._learn(camera, self.frames)
            seen = self._see(camera, self.frames, known, covered, outlines)
            if seen is None:
                return None
            fit = SharedFit([seen], [camera.X_CW], constants, looks=looks, widths=False)
            which = fit.agreeing(fit.inlier_ratios(fit.start))
            found = fit.fit(_stages(scales, seen), which=which)
            camera = fit.cameras(found)[0]
        assert seen is not None
        whole = PosedFrames(self._body.kinematics, self._body.all, camera, seen.frames)
        fit = SharedFit([whole], [camera.X_CW], constants, looks=looks)
        found = fit.start._replace(shared=_constants_of(fit, found))
        which = fit.agreeing(fit.inlier_ratios(found))
        found = fit.fit(_stages(_LAST, whole), found, which)
        camera = fit.cameras(found)[0]
        return PictureFit(fit, found, known, *self.compared.explained(camera.X_CW))

    @cached_property
    def _small(self) -> tuple[list[PosedPicture], PinholeCamera]:
        """The frames with pictures as backgrounds are learned in, and their camera."""
        camera = self._level(_LEARNED).camera
        size = camera.width, camera.height
        return [
            replace(
                one,
                picture=np.asarray(
                    cv2.resize(one.picture, size, interpolation=cv2.INTER_AREA), np.uint8
                ),
            )
            for one in self.frames
        ], camera

    def _learn(
        self, camera: PinholeCamera, frames: Sequence[PosedPicture]
    ) -> tuple[KnownBackground, Mask]:
        """What is behind the body before a camera, and where that is (f, H, W)."""
        level = self._level(_LEARNED)
        small = camera.resized(level.camera.width, level.camera.height)
        poses = camera.X_CW @ self._X_WN
        both = [
            np.array([draw_mask(self._outlines[-1], X_CN, one) for X_CN in poses])
            for one in (small, camera)
        ]
        pictures, lights = [one.picture for one in frames], level.backgrounds.lights
        showing = level.backgrounds.showing(both[0])
        return KnownBackground.of(pictures, lights, showing, both[1]), both[1]

    def _see(
        self,
        camera: PinholeCamera,
        frames: Sequence[PosedPicture],
        known: KnownBackground,
        covered: Mask,
        outlines: Sequence[Outline],
    ) -> PosedFrames | None:
        """Frames with the odds of their pixels and masks of these; None: fewer than two show it.

        Args:
            covered: (f, H, W) where the body is about; frames that do not show it tell nothing.
            outlines: the surfaces that are compared.
        """
        lights = self._level(_LEARNED).backgrounds.lights

        def see(k: int) -> PosedFrame | None:
            return see_picture(frames[k], known, lights[k], covered[k])

        posed = [one for one in map_ordered(see, range(len(frames))) if one is not None]
        if len(posed) < 2:
            return None
        return PosedFrames(self._body.kinematics, outlines, camera, posed)

    def _level(self, width: int) -> PictureLevel:
        if width not in self._levels:
            k = sum(width > one for one in _WIDTHS)
            count = SEARCHED if width < _COMPARED else len(self.frames)
            pictures = [one.picture for one in self.frames[:count]]
            self._levels[width] = PictureLevel(
                self._outlines[k], self._camera, pictures, self._X_WN[:count], width
            )
        return self._levels[width]


def _stages(scales: Sequence[float], seen: PosedFrames) -> list[AnnealingStage]:
    """Steps at some scales, of pictures that are not so wide."""
    sizes = np.array(scales) * seen.camera.width / _SCALED / seen.size
    return [AnnealingStage(one, _SPACING * one) for one in sizes.tolist()]


def _constants_of(fit: SharedFit, found: Shared) -> Array:
    """(u,) what was found of all but the camera, which a fit has where it was found."""
    shared = found.shared.copy()
    shared[: fit.per_camera] = 0.0
    return shared


def see_picture(
    one: PosedPicture, known: KnownBackground, light: Light, covered: Mask
) -> PosedFrame | None:
    """A picture with the odds of its pixels and a mask of these; None where no body shows.

    covered: (H, W) where the body is about.
    """
    if not covered.any():
        return None
    odds = known.odds(one.picture, light)
    mask = mask_of_odds(odds, covered)
    if not mask.any():
        return None
    return PosedFrame(one.name, one.values, mask, odds_picture(odds), one.rates)
