"""Search a camera's pose in its pictures alone, without masks and without an initial guess.

The camera is static and the body's joint positions are known in each picture. A hypothesis X_CW
therefore implies in which frames the body covers each pixel, and the pixels' colours score it
(``fit.background``). Starts are rotations over the whole sphere, and more near upright, with the
body where pictures change. The best are improved coarse-to-fine on an image pyramid, and finally
fitted on search lines across the contour in the pixels' foreground log-odds.
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
    """Parameters of a search in pictures.

    Args:
        search_frames: number of frames in a search.
        triangles: number of triangles of a node in pyramid levels up to 64 and up to 120 pixels
            wide, and in wider ones.
        compare_width, background_width: width of the pictures in which poses are compared, and
            backgrounds are estimated [pixel].
        contour_weight: weight of edges along the contours beside the explained fraction.
        rate_step: half the interval of the differences that estimate joint velocities [s].
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
        name: of the frame.
        values: (m,) values of the body's pose tree [rad or m].
        picture: (H, W, 3) uint8 red, green, blue.
        rates: (m,) velocities of the values [rad/s or m/s]; None: unknown.
    """

    name: str
    values: Array
    picture: Picture
    rates: Array | None = None


@dataclass(frozen=True, eq=False)
class PictureFit:
    """A camera fitted to pictures.

    Args:
        fit: the fit of frames with foreground log-odds, and masks derived from these.
        found: the fitted values of its u shared unknowns.
        background: the estimated background, which segments further pictures.
        explained: explained fraction of the log-likelihood gain that is possible at most.
        contour: mean strength of edges along the outlines, beyond that of random lines.
    """

    fit: SharedFit
    found: SharedValues
    background: KnownBackground
    explained: float
    contour: float

    @property
    def camera(self) -> PinholeCamera:
        """The camera at its fitted pose."""
        return self.fit.cameras(self.found)[0]

    @cached_property
    def ratios(self) -> Array:
        """Inlier ratios (frames,)."""
        return self.fit.inlier_ratios(self.found)

    @cached_property
    def inliers(self) -> Mask:
        """Which frames (frames,) are inliers."""
        return self.fit.inliers(self.ratios)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (u, u) of the shared unknowns."""
        return np.asarray(np.sum(self.fit.covariances(self.found, self.inliers), axis=0))


def node_places(body: RegistrationBody, values: Array) -> Array:
    """Return the centres (f, n, 3) of the body's n visible nodes in the world [m].

    values: (f, m) values of the body's pose tree in f frames.
    """
    shown = [k for k, one in enumerate(body.coarse) if len(one.vertices)]
    X_WN = np.array([body.kinematics.poses(one)[shown] for one in values])
    middles = np.array([body.coarse[k].ball[:3] for k in shown])
    return np.asarray(np.einsum("fnij,nj->fni", X_WN[..., :3, :3], middles) + X_WN[..., :3, 3])


def choose_frames(places: Array, count: int) -> list[int]:
    """Return the indices of the most dissimilar frames, by farthest point sampling.

    The frame farthest from the mean comes first.

    places: (f, n, 3), see ``node_places``. count: maximum number of frames.
    """

    def off(other: Array) -> Array:
        """Return the mean distance (f,) of each frame's nodes from other places (n, 3) [m]."""
        return np.asarray(np.linalg.norm(places - other, axis=2).mean(axis=1))

    chosen = [int(np.argmax(off(places.mean(axis=0))))]
    nearest = off(places[chosen[0]])
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, off(places[chosen[-1]]))
    return chosen


class PictureSearch:
    """Searches a camera's pose in some of its pictures.

    Args:
        body: the robot's surfaces.
        camera: the camera; its pose is not used.
        frames: f pictures, the most dissimilar first.
    """

    def __init__(
        self, body: RegistrationBody, camera: PinholeCamera, frames: Sequence[PosedPicture]
    ) -> None:
        self._body, self._camera, self.frames = body, camera, tuple(frames)
        coarse, *finer = (simplify_or_hull(body.coarse, count) for count in PICTURES.triangles)
        # Small parts are invisible at the coarsest level.
        least = 0.25 * max(one.ball[3] for one in coarse)
        coarse = tuple(one if one.ball[3] >= least else EMPTY_OUTLINE for one in coarse)
        self._outlines = (coarse, *finer)
        self._X_WN = np.array([body.kinematics.poses(one.values) for one in frames])
        self._levels = dict[int, PyramidLevel]()

    @property
    def compared(self) -> "PyramidLevel":
        """The pyramid level in which poses are compared."""
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
        """Return pose hypotheses X_CW (4, 4), best first.

        Args:
            rounds: for each round of local search the width of the pictures [pixel], the number of
                hypotheses, the number of evaluations for each, and the first step's rotation [rad].
            rotations: number of rotations over the sphere, and again near upright.
        """
        level = self._level(rounds[0][0])
        found = level.starts(rotations)
        # The four most dissimilar frames select a quarter of the starts.
        for frames, fraction in ((4, 0.25), (len(self.frames), 1.0)):
            found = level.best(found, frames, fraction)
        after = (*(kept for _, kept, _, _ in rounds[1:]), rounds[-1][1])
        for (width, kept, evaluations, turn), most in zip(rounds, after, strict=True):
            level = self._level(width)
            improve = partial(level.improve, evaluations=evaluations, turn=turn)
            improved = map_ordered(improve, enumerate(found[:kept]))
            improved.sort(key=lambda one: -one[0])
            found = level.distinct([X for _, X in improved], most)
        return found

    def coarse_fit(self, X_CW: Array) -> tuple[PinholeCamera, tuple[float, float]] | None:
        """Fit a camera roughly from a pose X_CW (4, 4).

        Returns:
            the camera at the fitted pose, with its pictures' original size; and its scores in
            `compared` (see ``PyramidLevel.explained``). None: the body leaves the pictures.
        """
        frames, small = self._small
        stages = ((*(12.0,) * 4, *(8.0,) * 4, *(5.0,) * 4), (*(6.0,) * 3, *(4.0,) * 3))
        for scales in stages:
            camera = small.with_pose(np.linalg.inv(X_CW))
            known, covered = self._learn(camera, frames)
            posed = self._segment(camera, frames, known, covered, self._outlines[-1])
            if posed is None:
                return None
            fit = SharedFit([posed], [X_CW], fit_biases=False)
            X_CW = fit.cameras(fit.fit(_stages(scales, posed)))[0].X_CW
        return self._camera.with_pose(np.linalg.inv(X_CW)), self.compared.explained(X_CW)

    def fit(
        self, camera: PinholeCamera, constants: Sequence[str] = (), focal: bool = False
    ) -> PictureFit | None:
        """Fit a camera from near its pose, on search lines across the contours.

        Args:
            camera: at the start's pose, with the pictures' original size.
            constants: names of further unknowns shared by all frames, such as joints with an
                offset, or TIME_OFFSET; see ``SharedFit``.
            focal: whether the focal length is fitted.

        Returns:
            the fit; None if the body leaves the pictures.
        """
        camera_unknowns, posed = len(POSE_NAMES) + focal, None
        # The background is estimated again before each sequence of stages.
        for scales, outlines in (
            ((*(5.0,) * 4, *(3.0,) * 4), self._outlines[-1]),
            ((*(3.0,) * 2, *(2.0,) * 3, *(1.0,) * 3), self._body.medium),
        ):
            known, covered = self._learn(camera, self.frames)
            posed = self._segment(camera, self.frames, known, covered, outlines)
            if posed is None:
                return None
            fit = SharedFit(
                [posed], [camera.X_CW], constants, camera_unknowns=camera_unknowns, fit_biases=False
            )
            included = fit.inliers(fit.inlier_ratios(fit.start))
            found = fit.fit(_stages(scales, posed), included=included)
            camera = fit.cameras(found)[0]
        assert posed is not None
        full = PosedFrames(self._body.kinematics, self._body.full, camera, posed.frames)
        fit = SharedFit([full], [camera.X_CW], constants, camera_unknowns=camera_unknowns)
        # The new fit starts at the camera's fitted pose; only the constants keep their values.
        constant = np.arange(len(fit.names)) >= fit.per_camera
        found = fit.start._replace(shared=np.where(constant, found.shared, 0.0))
        included = fit.inliers(fit.inlier_ratios(found))
        found = fit.fit(_stages((0.75,) * 7, full), found, included)
        camera = fit.cameras(found)[0]
        return PictureFit(fit, found, known, *self.compared.explained(camera.X_CW))

    @cached_property
    def _small(self) -> tuple[list[PosedPicture], PinholeCamera]:
        """The frames at the size in which backgrounds are estimated, and a camera of that size."""
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
        """Return the background behind the body, and the pixels (f, H, W) that the body covers.

        Args:
            camera: at the pose from which the covered pixels follow.
            frames: all frames, in pictures of the camera's size H x W.
        """
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
        """Return the frames that show the body with masks; None if these are fewer than two.

        Args:
            camera: the camera, with pictures of the frames' size H x W.
            frames: all frames.
            known: the background.
            covered: (f, H, W) the pixels that the body covers approximately.
            outlines: a surface for each node, for later fits.
        """
        gains = self._level(PICTURES.background_width).backgrounds.gains

        def segment(k: int) -> PosedFrame | None:
            return segment_picture(frames[k], known, gains[k], covered[k])

        posed = [one for one in map_ordered(segment, range(len(frames))) if one is not None]
        if len(posed) < 2:
            return None
        return PosedFrames(self._body.kinematics, outlines, camera, posed)

    def _level(self, width: int) -> "PyramidLevel":
        """Return the pyramid level of a width [pixel], made when it is first used."""
        if width not in self._levels:
            k = (width > 64) + (width > 120)
            count = PICTURES.search_frames if width < PICTURES.compare_width else len(self.frames)
            pictures = [one.picture for one in self.frames[:count]]
            self._levels[width] = PyramidLevel(
                self._outlines[k], self._camera, pictures, self._X_WN[:count], width
            )
        return self._levels[width]


def _stages(scales: Sequence[float], posed: PosedFrames) -> list[AnnealingStage]:
    """Return stages of single steps at scales [pixel of a picture 320 wide].

    posed: the frames that are fitted, whose size converts the scales.

    Search lines are half a scale apart. Their costs are not comparable between poses, so each step
    is taken untried.
    """
    sizes = np.array(scales) * posed.camera.width / 320.0 / posed.size
    return [AnnealingStage(one, 0.5 * one) for one in sizes.tolist()]


def segment_picture(
    one: PosedPicture, known: KnownBackground, gain: Floats, covered: Mask
) -> PosedFrame | None:
    """Return the frame of a picture with log-odds and a mask; None where no body is visible.

    Args:
        one: the picture, with values and rates that the frame takes over.
        known: the background.
        gain: (3, 4) slopes and offset that map the picture's colours to the background's.
        covered: (H, W) the pixels that the body covers approximately.
    """
    if not covered.any():
        return None
    foreground = known.foreground(one.picture, gain)
    mask = mask_of_foreground(foreground, covered)
    if not mask.any():
        return None
    return PosedFrame(one.name, one.values, mask, foreground_picture(foreground), one.rates)


def evidence(explained: float, contour: float) -> float:
    """Return the score of a pose from its explained fraction and its edges' mean strength.

    Both are those of a ``PictureFit``. The mean over the contours is used: their sum would favour
    poses with longer contours.
    """
    return explained + PICTURES.contour_weight * contour


class PyramidLevel:
    """Pictures of one size, and scores of poses in them.

    Attributes:
        camera: the camera of these pictures.
        backgrounds: estimates of the background from all pictures.

    Args:
        outlines: a surface for each node.
        camera: the camera of the given pictures; its pose is not used.
        pictures: f pictures (H, W, 3).
        X_WN: (f, nodes, 4, 4) the nodes' poses.
        width: width of this level's pictures [pixel]; at most that of the given ones.
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
        # A node is static if its points move by less than 0.06 of the body's size.
        self._static = most < 0.06 * size
        moving = points[:, ~self._static[owners]]
        self._points = (moving if moving.size else points).reshape(-1, 3)
        self._middle = self._points.mean(axis=0)
        off = self._points - self._middle
        self._size = float(np.sqrt((off**2).sum(axis=1).mean()))

    def statistics(self, X_CW: Array, X_WN: Array | None = None) -> Array:
        """Return the sums (4,), see ``Explained``, over the pictures for a pose (4, 4).

        X_WN: (f, nodes, 4, 4) other poses of the nodes; None: those of the pictures' values.
        """
        X_CN = X_CW[:3] @ (self._X_WN if X_WN is None else X_WN)
        sums = self.backgrounds.sums
        return explain(self._packed, X_CN, self._static, self._parameters, sums, 1.0, 0)[0]

    def explained(self, X_CW: Array) -> tuple[float, float]:
        """Return the explained fraction and mean edge strength of a pose (4, 4).

        They are the `explained` and `contour` of a ``PictureFit``.
        """
        sums = self.statistics(X_CW)
        fraction = float(sums[Explained.GAIN]) / max(self.backgrounds.max_gain, 1e-9)
        return fraction, float(sums[Explained.CONTOUR]) / max(float(sums[Explained.OUTLINE]), 1.0)

    def score(self, X_CW: Array, frames: int | None = None) -> float:
        """Return the score, see `evidence`, of a pose (4, 4).

        A constant is added to the outlines' length. It limits the score of short outlines, whose
        edges are strong by chance.

        frames: number of frames that are used, from the first on; None: all.
        """
        X_WN = self._X_WN[:frames]
        sums = self.statistics(X_CW, X_WN)
        outline = sums[Explained.OUTLINE] + 0.3 * len(X_WN) * self.camera.width
        possible = self.backgrounds.max_gain * len(X_WN) / len(self._X_WN)
        return evidence(
            float(sums[Explained.GAIN]) / max(possible, 1e-9),
            float(sums[Explained.CONTOUR] / outline),
        )

    def best(self, X_CW: Sequence[Array], frames: int, fraction: float) -> list[Array]:
        """Return the given fraction of the poses (4, 4), those with the best scores, best first.

        frames: number of frames that are used, from the first on.
        """

        def scores(some: Sequence[Array]) -> list[float]:
            return [self.score(X, frames) for X in some]

        some = [X_CW[k : k + 200] for k in range(0, len(X_CW), 200)]
        order = np.argsort(-np.concatenate(map_ordered(scores, some)), kind="stable")
        return [X_CW[k] for k in order[: math.ceil(fraction * len(order))]]

    def tile_gains(self, X_CW: Array, squares: int = 16) -> Array:
        """Return the log-likelihood gain of a pose (4, 4) by square image tiles.

        The result is (squares, squares), with `squares` tiles along the picture's longer side.
        """
        side = max(self.camera.width, self.camera.height) / squares
        _, gains = explain(
            self._packed, X_CW[:3] @ self._X_WN, self._static, self._parameters,
            self.backgrounds.sums, side, squares,
        )  # fmt: skip
        return gains

    def starts(self, rotations: int = 1200) -> list[Array]:
        """Return poses X_CW (4, 4) that show the body where pictures change.

        rotations: number of rotations over the sphere, and again near upright.

        Each rotation is combined with three depths about that at which the body is as large as the
        changes, and with two positions in the picture: the changes' centre, and a random one.
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
        """Improve a pose by Nelder and Mead's simplex search.

        Args:
            numbered: a seed for the signs of the first simplex, and the pose (4, 4).
            evaluations: maximum number of scores.
            turn: rotation of the first simplex [rad]; its shifts [focal lengths] are 0.4 times, the
                step of the log depth 0.6 times as large.

        Returns:
            the best score and its pose.
        """
        key, X_CW = numbered
        signs = np.random.default_rng(key).choice([-1.0, 1.0], 6)
        # Rotation [rad], shift in the picture [focal lengths], logarithm of the depth.
        steps = turn * signs * np.array([1.0, 1.0, 1.0, 0.4, 0.4, 0.6])
        simplex = np.vstack([np.zeros(6), np.diag(steps)])
        options = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 0.0, "fatol": 0.0}

        def cost(x: Array) -> float:
            return -self.score(self._moved(X_CW, x))

        found = minimize(cost, np.zeros(6), method="Nelder-Mead", options=options)
        return -float(found.fun), self._moved(X_CW, found.x)

    def distinct(self, X_CW: Sequence[Array], most: int | None = None) -> list[Array]:
        """Return the poses (4, 4) that place the body apart from every pose kept before.

        most: maximum number of poses; None: no limit.
        """
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
        """Return a pose (4, 4) moved by x (6,) in the camera's frame.

        x: rotation vector about the body's middle [rad], shift of the middle in the picture along u
            and v [focal lengths], and change of the logarithm of the middle's depth.
        """
        p_CM = X_CW[:3, :3] @ self._middle + X_CW[:3, 3]
        depth = p_CM[2] * np.exp(x[5])
        place = np.array([p_CM[0] / p_CM[2] + x[3], p_CM[1] / p_CM[2] + x[4], 1.0])
        moved = np.eye(4)
        moved[:3, :3] = cv2.Rodrigues(x[:3])[0] @ X_CW[:3, :3]
        moved[:3, 3] = depth * place - moved[:3, :3] @ self._middle
        return moved


def upright_rotations(count: int) -> Array:
    """Return rotations R_CW (count, 3, 3) of nearly upright cameras in a world with z up.

    They look up by 30 degrees and down by 79 at most, with a roll of 0.15 rad standard deviation.
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
