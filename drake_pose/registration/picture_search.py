"""Where a camera stands, told by its pictures alone: no masks, no guess.

The body's positions are known in each picture, and the camera stands still: so a pose of the camera
says in which frames the body covers each pixel, and the pixels' colours say how well that fits
(``fit.background``). Rotations spread over all, and more of them near upright, are tried with the
bodies where pictures change; the best are improved step by step, in larger and larger pictures, and
in the end by the one fit, on lines across the contour in the log-odds of pixels to show the body.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.background import (
    Backgrounds,
    Explained,
    KnownBackground,
    explain,
    foreground_picture,
    mask_of_foreground,
)
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.fit.surfaces import simplify_or_hull
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames, placed_points
from drake_pose.registration.register import RegistrationBody, uniform_rotations
from drake_pose.registration.shared_fit import SharedFit, SharedValues
from drake_pose.silhouette.outline import EMPTY_OUTLINE, Outline, pack
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.workers import map_ordered


class PictureSettings(NamedTuple):
    """Numbers of a search in pictures.

    searched: number of pictures that carry a search. triangles: of a node, in levels of pictures up
    to 64 and up to 120 pixels wide, and beyond; the last ones also show where a body is about.
    compared, learned: width of the pictures in which poses are compared, and in which backgrounds
    are learned [pixel]. contours: weight of contours' edges beside the share that is explained.
    rate_step: rates are differences of positions this long before and after [s].
    """

    search_frames: int = 12
    triangles: tuple[int, int, int] = (12, 40, 100)
    compare_width: int = 160
    background_width: int = 320
    contour_weight: float = 4.0
    rate_step: float = 0.05


PICTURES = PictureSettings()


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """One picture of a body at known joint positions.

    Args:
        values: (m,) of the body's pose tree [rad or m].
        picture: (H, W, 3) red, green, blue.
        rates: (m,) how fast the values change [rad/s or m/s]; None: unknown.
    """

    name: str
    values: Array
    picture: Picture
    rates: Array | None = None


@dataclass(frozen=True, eq=False)
class PictureFit:
    """A camera that was fitted to pictures.

    Args:
        fit: the fit of its frames, which have foreground probabilities, and masks of these.
        found: by it.
        background: what is behind the body; it gives foreground probabilities of other pictures.
        explained: share of what could be explained at most, that the pose explains.
        contour: how strong edges are along the outlines, beyond chance.
    """

    fit: SharedFit
    found: SharedValues
    background: KnownBackground
    explained: float
    contour: float

    @property
    def camera(self) -> PinholeCamera:
        """Where it was found."""
        return self.fit.cameras(self.found)[0]

    @cached_property
    def ratios(self) -> Array:
        """(frames,) of the contours, what fits."""
        return self.fit.inlier_ratios(self.found)

    @cached_property
    def inliers(self) -> Mask:
        """(frames,) which frames fit nearly as well as the best."""
        return self.fit.inliers(self.ratios)

    @cached_property
    def covariance(self) -> Array:
        """(u, u) of the errors of all that the frames share."""
        return np.asarray(np.sum(self.fit.covariances(self.found, self.inliers), axis=0))


def node_places(body: RegistrationBody, values: Array) -> Array:
    """(f, n, 3) the middles of the nodes that show, in frames with values (f, m) [m]."""
    shown = [k for k, one in enumerate(body.coarse) if len(one.vertices)]
    X_WN = np.array([body.kinematics.poses(one)[shown] for one in values])
    middles = np.array([body.coarse[k].ball[:3] for k in shown])
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
        coarse, *finer = (simplify_or_hull(body.coarse, count) for count in PICTURES.triangles)
        # Smaller parts do not show in the smallest pictures.
        least = 0.25 * max(one.ball[3] for one in coarse)
        coarse = tuple(one if one.ball[3] >= least else EMPTY_OUTLINE for one in coarse)
        self._outlines = (coarse, *finer)
        self._X_WN = np.array([body.kinematics.poses(one.values) for one in frames])
        self._levels = dict[int, PyramidLevel]()

    @property
    def compared(self) -> "PyramidLevel":
        """In which poses are compared."""
        return self._level(PICTURES.compare_width)

    def search(
        self,
        rounds: Sequence[tuple[int, int, int, float]] = (
            (64, 250, 24, 0.25),
            (64, 80, 30, 0.15),
            (80, 30, 50, 0.1),
            (160, 10, 80, 0.06),
        ),
        rotations: int = 1200,
    ) -> list[Array]:
        """Poses X_CW (4, 4) near which the camera's may be, best first.

        Args:
            rounds: width of the pictures [pixel], number of poses that are improved, evaluations of
                each, and the first simplex's turn [rad].
            rotations: number of rotations that are tried, over all and again near upright.
        """
        level = self._level(rounds[0][0])
        found = level.starts(rotations)
        # A few frames, those that differ most, rank all starts.
        for frames, share in ((4, 0.25), (len(self.frames), 1.0)):
            found = level.best(found, frames, share)
        after = (*(kept for _, kept, _, _ in rounds[1:]), rounds[-1][1])
        for (width, kept, evaluations, turn), most in zip(rounds, after, strict=True):
            level = self._level(width)
            improve = partial(level.improve, evaluations=evaluations, turn=turn)
            improved = map_ordered(improve, enumerate(found[:kept]))
            improved.sort(key=lambda one: -one[0])
            found = level.distinct([X for _, X in improved], most)
        return found

    def coarse_fit(self, X_CW: Array) -> tuple[PinholeCamera, tuple[float, float]] | None:
        """A camera fitted roughly from where it stands, and what it explains in `compared`.

        None where the body leaves the pictures.
        """
        frames, small = self._small
        rough = ((*(12.0,) * 4, *(8.0,) * 4, *(5.0,) * 4), (*(6.0,) * 3, *(4.0,) * 3))
        for scales in rough:
            camera = small.with_pose(np.linalg.inv(X_CW))
            known, covered = self._learn(camera, frames)
            seen = self._segment(camera, frames, known, covered, self._outlines[-1])
            if seen is None:
                return None
            fit = SharedFit([seen], [X_CW], fit_biases=False)
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
        # Backgrounds are learned anew before each row of steps.
        for scales, outlines in (
            ((*(5.0,) * 4, *(3.0,) * 4), self._outlines[-1]),
            ((*(3.0,) * 2, *(2.0,) * 3, *(1.0,) * 3), self._body.medium),
        ):
            known, covered = self._learn(camera, self.frames)
            seen = self._segment(camera, self.frames, known, covered, outlines)
            if seen is None:
                return None
            fit = SharedFit(
                [seen], [camera.X_CW], constants, camera_unknowns=looks, fit_biases=False
            )
            included = fit.inliers(fit.inlier_ratios(fit.start))
            found = fit.fit(_stages(scales, seen), included=included)
            camera = fit.cameras(found)[0]
        assert seen is not None
        whole = PosedFrames(self._body.kinematics, self._body.full, camera, seen.frames)
        fit = SharedFit([whole], [camera.X_CW], constants, camera_unknowns=looks)
        # The camera is where it was found now; the constants are not.
        constant = np.arange(len(fit.names)) >= fit.per_camera
        found = fit.start._replace(shared=np.where(constant, found.shared, 0.0))
        included = fit.inliers(fit.inlier_ratios(found))
        found = fit.fit(_stages((0.75,) * 7, whole), found, included)
        camera = fit.cameras(found)[0]
        return PictureFit(fit, found, known, *self.compared.explained(camera.X_CW))

    @cached_property
    def _small(self) -> tuple[list[PosedPicture], PinholeCamera]:
        """The frames with pictures as backgrounds are learned in, and their camera."""
        camera = self._level(PICTURES.background_width).camera
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
        level = self._level(PICTURES.background_width)
        small = camera.resized(level.camera.width, level.camera.height)
        poses = camera.X_CW @ self._X_WN
        both = [
            np.array([draw_mask(self._outlines[-1], X_CN, one) for X_CN in poses])
            for one in (small, camera)
        ]
        pictures, gains = [one.picture for one in frames], level.backgrounds.gains
        showing = level.backgrounds.shows_background(both[0])
        return KnownBackground.estimate(pictures, gains, showing, both[1]), both[1]

    def _segment(
        self,
        camera: PinholeCamera,
        frames: Sequence[PosedPicture],
        known: KnownBackground,
        covered: Mask,
        outlines: Sequence[Outline],
    ) -> PosedFrames | None:
        """Frames with foreground probabilities and masks of these; None: fewer than two show it.

        Args:
            covered: (f, H, W) where the body is about; frames that do not show it tell nothing.
            outlines: the surfaces that are compared.
        """
        gains = self._level(PICTURES.background_width).backgrounds.gains

        def see(k: int) -> PosedFrame | None:
            return segment_picture(frames[k], known, gains[k], covered[k])

        posed = [one for one in map_ordered(see, range(len(frames))) if one is not None]
        if len(posed) < 2:
            return None
        return PosedFrames(self._body.kinematics, outlines, camera, posed)

    def _level(self, width: int) -> "PyramidLevel":
        if width not in self._levels:
            k = (width > 64) + (width > 120)
            count = PICTURES.search_frames if width < PICTURES.compare_width else len(self.frames)
            pictures = [one.picture for one in self.frames[:count]]
            self._levels[width] = PyramidLevel(
                self._outlines[k], self._camera, pictures, self._X_WN[:count], width
            )
        return self._levels[width]


def _stages(scales: Sequence[float], seen: PosedFrames) -> list[AnnealingStage]:
    """Steps at some scales [pixel of a picture 320 wide]; lines are half a scale apart.

    What lines cost does not compare from place to place, so each step is taken.
    """
    sizes = np.array(scales) * seen.camera.width / 320.0 / seen.size
    return [AnnealingStage(one, 0.5 * one) for one in sizes.tolist()]


def segment_picture(
    one: PosedPicture, known: KnownBackground, light: Floats, covered: Mask
) -> PosedFrame | None:
    """A picture with its log-odds and a mask of these; None where no body shows.

    covered: (H, W) where the body is about.
    """
    if not covered.any():
        return None
    foreground = known.foreground(one.picture, light)
    mask = mask_of_foreground(foreground, covered)
    if not mask.any():
        return None
    return PosedFrame(one.name, one.values, mask, foreground_picture(foreground), one.rates)


def evidence(explained: float, contour: float) -> float:
    """How much speaks for a pose, of the share that it explains and its contours' edges.

    Sums over contours are misled: a wrong pose that shows more of the body has longer ones.
    """
    return explained + PICTURES.contour_weight * contour


class PyramidLevel:
    """Pictures of one size (a pyramid level), and what poses explain in them.

    Attributes:
        camera: of these pictures.
        backgrounds: what may be behind the body in them.

    Args:
        outlines: the body's surfaces.
        camera: of the pictures that are given; its pose is not used.
        pictures: (f, H, W, 3).
        X_WN: (f, nodes, 4, 4) where the body is in each.
        width: of the smaller pictures [pixel].
    """

    def __init__(
        self,
        outlines: Sequence[Outline],
        camera: PinholeCamera,
        pictures: Sequence[Picture],
        X_WN: Array,
        width: int,
    ) -> None:
        width = min(width, camera.width)
        height = max(8, round(camera.height * width / camera.width))
        self.camera, self._X_WN = camera.resized(width, height), X_WN
        small = [cv2.resize(one, (width, height), interpolation=cv2.INTER_AREA) for one in pictures]
        self.backgrounds = Backgrounds.estimate(np.array(small))
        self._packed = pack(tuple(outlines))
        self._parameters = self.camera.kernel_parameters()
        points = np.array([placed_points(outlines, X) for X in X_WN])
        size = float(np.sqrt(((points - points.mean(axis=(0, 1))) ** 2).sum(axis=2).mean()))
        moves = np.linalg.norm(np.ptp(points, axis=0), axis=1)
        owners = np.repeat(np.arange(len(outlines)), [len(one.vertices) for one in outlines])
        most = np.zeros(len(outlines))
        np.maximum.at(most, owners, moves)
        # What hardly moves beside the body's size stands still.
        self._static = most < 0.06 * size
        moving = points[:, ~self._static[owners]]
        self._points = (moving if moving.size else points).reshape(-1, 3)
        self._middle = self._points.mean(axis=0)
        off = self._points - self._middle
        self._size = float(np.sqrt((off**2).sum(axis=1).mean()))

    def told(self, X_CW: Array, X_WN: Array | None = None) -> Array:
        """(4,) what a pose (4, 4) explains, as of `explain`.

        X_WN: (f, nodes, 4, 4) where the body is, if it is elsewhere than it was said to be.
        """
        X_CN = X_CW[:3] @ (self._X_WN if X_WN is None else X_WN)
        sums = self.backgrounds.sums
        return explain(self._packed, X_CN, self._static, self._parameters, sums, 1.0, 0)[0]

    def explained(self, X_CW: Array) -> tuple[float, float]:
        """Of a pose (4, 4) the share of all that could be explained, and edges beyond chance."""
        told = self.told(X_CW)
        share = float(told[Explained.GAIN]) / max(self.backgrounds.max_gain, 1e-9)
        return share, float(told[Explained.CONTOUR]) / max(float(told[Explained.OUTLINE]), 1.0)

    def score(self, X_CW: Array, frames: int | None = None) -> float:
        """How much speaks for a pose; short outlines, which say little by chance, count as longer.

        frames: number of frames that count, from the first on; None: all.
        """
        X_WN = self._X_WN[:frames]
        told = self.told(X_CW, X_WN)
        outline = told[Explained.OUTLINE] + 0.3 * len(X_WN) * self.camera.width
        possible = self.backgrounds.max_gain * len(X_WN) / len(self._X_WN)
        return evidence(
            float(told[Explained.GAIN]) / max(possible, 1e-9),
            float(told[Explained.CONTOUR] / outline),
        )

    def best(self, X_CW: Sequence[Array], frames: int, share: float) -> list[Array]:
        """A share of some poses (4, 4): those with the best scores, best first."""

        def scores(some: Sequence[Array]) -> list[float]:
            return [self.score(X, frames) for X in some]

        some = [X_CW[k : k + 200] for k in range(0, len(X_CW), 200)]
        order = np.argsort(-np.concatenate(map_ordered(scores, some)), kind="stable")
        return [X_CW[k] for k in order[: math.ceil(share * len(order))]]

    def pieces(self, X_CW: Array, squares: int = 16) -> Array:
        """(k, k) what a pose (4, 4) explains, by squares, `squares` along its longer side."""
        side = max(self.camera.width, self.camera.height) / squares
        pieces = explain(
            self._packed, X_CW[:3] @ self._X_WN, self._static, self._parameters,
            self.backgrounds.sums, side, squares,
        )  # fmt: skip
        return pieces[1]

    def starts(self, rotations: int = 1200) -> list[Array]:
        """Poses X_CW (4, 4) that show the body where pictures change, and about as large.

        Each rotation comes at three distances, in the middle of the changes and beside it.
        """
        changes = self.backgrounds.changed_frames()
        v, u = np.mgrid[: changes.shape[0], : changes.shape[1]]
        total = max(float(changes.sum()), 1e-9)
        middle = np.array([float((changes * one).sum()) / total for one in (u, v)])
        squares = (u - middle[0]) ** 2 + (v - middle[1]) ** 2
        spread = max(float(np.sqrt((changes * squares).sum() / total)), 2.0)
        R_CW = np.concatenate([uniform_rotations(rotations), upright_rotations(rotations)])
        points = self._points[:: max(1, len(self._points) // 200)] - self._middle
        p_C = np.einsum("nij,pj->npi", R_CW, points)
        sizes = np.sqrt((p_C[..., :2] ** 2).sum(axis=2).mean(axis=1))
        nearest = 0.05 * self._size - 0.7 * p_C[..., 2].min(axis=1)
        rng = np.random.default_rng(0)
        focal, centre = self._parameters[1:3], self._parameters[3:5]
        found = []
        for times in (0.7, 1.0, 1.5):
            depth = np.maximum(focal[0] * sizes / spread * times, nearest)
            for aside in (np.zeros((len(R_CW), 2)), rng.normal(0.0, 0.5, (len(R_CW), 2))):
                X = np.tile(np.eye(4), (len(R_CW), 1, 1))
                X[:, :3, :3] = R_CW
                place = (middle + spread * aside - centre) / focal
                p_CM = np.column_stack([place, np.ones(len(R_CW))]) * depth[:, None]
                X[:, :3, 3] = p_CM - R_CW @ self._middle
                found += list(X)
        return found

    def improve(
        self, numbered: tuple[int, Array], evaluations: int, turn: float
    ) -> tuple[float, Array]:
        """The best score near a pose (4, 4), and that pose (Nelder and Mead's simplex).

        Args:
            numbered: a number that says which way the simplex begins, and the pose.
            evaluations: maximum number of scores.
            turn: of the first simplex [rad]; its other steps follow.
        """
        key, X_CW = numbered
        signs = np.random.default_rng(key).choice([-1.0, 1.0], 6)
        # Turns [rad], shifts of the middle in the picture [focal lengths], log depth.
        steps = turn * signs * np.array([1.0, 1.0, 1.0, 0.4, 0.4, 0.6])
        simplex = np.vstack([np.zeros(6), np.diag(steps)])
        options = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 0.0, "fatol": 0.0}

        def cost(x: Array) -> float:
            return -self.score(self._moved(X_CW, x))

        found = minimize(cost, np.zeros(6), method="Nelder-Mead", options=options)
        return -float(found.fun), self._moved(X_CW, found.x)

    def distinct(self, X_CW: Sequence[Array], most: int | None = None) -> list[Array]:
        """Those of some poses that show the body elsewhere than all before; `most` at most."""
        some = self._points[:: max(1, len(self._points) // 50)]
        kept, places = list[Array](), np.zeros((0, *some.shape))
        for X in X_CW:
            p_C = some @ X[:3, :3].T + X[:3, 3]
            apart = np.linalg.norm(places - p_C, axis=2).mean(axis=1)
            if (apart > 0.08 * self._size).all():
                kept.append(X)
                places = np.concatenate([places, p_C[None]])
            if len(kept) == most:
                break
        return kept

    def _moved(self, X_CW: Array, x: Array) -> Array:
        """A pose (4, 4) by a turn about the body's middle, its shift in the picture, log depth."""
        p_CM = X_CW[:3, :3] @ self._middle + X_CW[:3, 3]
        depth = p_CM[2] * np.exp(x[5])
        place = np.array([p_CM[0] / p_CM[2] + x[3], p_CM[1] / p_CM[2] + x[4], 1.0])
        moved = np.eye(4)
        moved[:3, :3] = cv2.Rodrigues(x[:3])[0] @ X_CW[:3, :3]
        moved[:3, 3] = depth * place - moved[:3, :3] @ self._middle
        return moved


def upright_rotations(count: int) -> Array:
    """(count, 3, 3) rotations R_CW of cameras about upright in a world whose z is up.

    They look up by 30 degrees and down by 79 at most, and are rolled by about 0.15 rad.
    """
    k = np.arange(count) + 0.5
    rng = np.random.default_rng(1)
    heading = 2.0 * np.pi * k * (0.5 * (np.sqrt(5.0) - 1.0))
    pitch = np.arcsin(np.linspace(-0.98, 0.5, count))
    roll = rng.normal(0.0, 0.15, count)
    forward = np.column_stack(
        [np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)]
    )
    right = np.column_stack([np.sin(heading), -np.cos(heading), np.zeros(count)])
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * right + s * down, -s * right + c * down, forward], axis=1)
