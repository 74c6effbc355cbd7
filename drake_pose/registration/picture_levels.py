"""What camera poses explain of small pictures of one camera, and where better poses are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.background import Backgrounds, Explained, explain
from drake_pose.registration.posed_frames import placed_points
from drake_pose.registration.start_poses import spread_rotations
from drake_pose.silhouette.areas.outline import Outline, pack
from drake_pose.workers import map_ordered

CONTOURS = 4.0
"""What contours' edges count beside the share that is explained."""

# Rotations that are tried: over all, and near upright. The body is tried so many times as far away
# as it would be if it changed all that does, and aside by about so many times the size of that.
_ALL, _UPRIGHT = 1200, 1200
_DISTANCES, _ASIDE = (0.7, 1.0, 1.5), 0.5
# Upright cameras look up or down by these sines at most, and are rolled by about so much [rad].
_PITCHES, _ROLL = (-0.98, 0.5), 0.15
# A node stands still that moves by less than this share of the body's size; nothing is nearer to
# the camera than this share.
_STILL, _NEAREST = 0.06, 0.05
# Steps of a simplex: turns [rad], shifts of the middle in the picture [focal lengths], log depth.
_STEPS = np.array([1.0, 1.0, 1.0, 0.4, 0.4, 0.6])
# Poses are apart whose bodies are by more of the body's size.
_APART = 0.08
# What a pose explains is told apart by so many squares of the picture's longer side.
_SQUARES = 16
# By how much of the picture's width a frame's outline counts as longer in a search.
_SHORT = 0.3
# So many poses are scored by a worker at once.
_AT_ONCE = 200


@dataclass(frozen=True)
class SearchRound:
    """So many poses are improved in pictures of a width [pixel] by so many evaluations.

    step: of the first simplex, of a turn [rad]; the other steps follow.
    """

    width: int
    kept: int
    evaluations: int
    step: float


def evidence(explained: float, contour: float) -> float:
    """How much speaks for a pose, of the share that it explains and its contours' edges.

    Sums over contours are misled: a wrong pose that shows more of the body has longer ones.
    """
    return explained + CONTOURS * contour


class PictureLevel:
    """Pictures of one size, and what poses explain in them.

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
        self.backgrounds = Backgrounds.of(np.array(small))
        self._packed = pack(tuple(outlines))
        self._parameters = self.camera.kernel_parameters()
        points = np.array([placed_points(outlines, X) for X in X_WN])
        size = float(np.sqrt(((points - points.mean(axis=(0, 1))) ** 2).sum(axis=2).mean()))
        moves = np.linalg.norm(np.ptp(points, axis=0), axis=1)
        owners = np.repeat(np.arange(len(outlines)), [len(one.vertices) for one in outlines])
        most = np.zeros(len(outlines))
        np.maximum.at(most, owners, moves)
        self._still = most < _STILL * size
        moving = points[:, ~self._still[owners]]
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
        return explain(self._packed, X_CN, self._still, self._parameters, sums, 1.0, 0)[0]

    def explained(self, X_CW: Array) -> tuple[float, float]:
        """Of a pose (4, 4) the share of all that could be explained, and edges beyond chance."""
        told = self.told(X_CW)
        share = float(told[Explained.GAIN]) / max(self.backgrounds.possible, 1e-9)
        return share, float(told[Explained.CONTOUR]) / max(float(told[Explained.OUTLINE]), 1.0)

    def score(self, X_CW: Array, frames: int | None = None) -> float:
        """How much speaks for a pose; short outlines, which say little by chance, count as longer.

        frames: so many count, the first ones; None: all.
        """
        X_WN = self._X_WN[:frames]
        told = self.told(X_CW, X_WN)
        outline = told[Explained.OUTLINE] + _SHORT * len(X_WN) * self.camera.width
        possible = self.backgrounds.possible * len(X_WN) / len(self._X_WN)
        return evidence(
            float(told[Explained.GAIN]) / max(possible, 1e-9),
            float(told[Explained.CONTOUR] / outline),
        )

    def best(self, X_CW: Sequence[Array], frames: int, share: float) -> list[Array]:
        """A share of some poses (4, 4): those with the best scores, best first."""

        def scores(some: Sequence[Array]) -> list[float]:
            return [self.score(X, frames) for X in some]

        some = [X_CW[k : k + _AT_ONCE] for k in range(0, len(X_CW), _AT_ONCE)]
        order = np.argsort(-np.concatenate(map_ordered(scores, some)), kind="stable")
        return [X_CW[k] for k in order[: math.ceil(share * len(order))]]

    def pieces(self, X_CW: Array) -> Array:
        """(k, k) what a pose (4, 4) explains, by squares of the picture."""
        X_CN = X_CW[:3] @ self._X_WN
        side = max(self.camera.width, self.camera.height) / _SQUARES
        sums = self.backgrounds.sums
        return explain(self._packed, X_CN, self._still, self._parameters, sums, side, _SQUARES)[1]

    def starts(self) -> list[Array]:
        """Poses X_CW (4, 4) that show the body where pictures change, and about as large."""
        changes = self.backgrounds.changes()
        v, u = np.mgrid[: changes.shape[0], : changes.shape[1]]
        total = max(float(changes.sum()), 1e-9)
        middle = np.array([float((changes * one).sum()) / total for one in (u, v)])
        squares = (u - middle[0]) ** 2 + (v - middle[1]) ** 2
        spread = max(float(np.sqrt((changes * squares).sum() / total)), 2.0)
        R_CW = np.concatenate([spread_rotations(_ALL), _upright_rotations(_UPRIGHT)])
        points = self._points[:: max(1, len(self._points) // 200)] - self._middle
        p_C = np.einsum("nij,pj->npi", R_CW, points)
        sizes = np.sqrt((p_C[..., :2] ** 2).sum(axis=2).mean(axis=1))
        nearest = _NEAREST * self._size - 0.7 * p_C[..., 2].min(axis=1)
        rng = np.random.default_rng(0)
        focal, centre = self._parameters[1:3], self._parameters[3:5]
        found = []
        for times in _DISTANCES:
            depth = np.maximum(focal[0] * sizes / spread * times, nearest)
            for aside in (np.zeros((len(R_CW), 2)), rng.normal(0.0, _ASIDE, (len(R_CW), 2))):
                X = np.tile(np.eye(4), (len(R_CW), 1, 1))
                X[:, :3, :3] = R_CW
                place = (middle + spread * aside - centre) / focal
                p_CM = np.column_stack([place, np.ones(len(R_CW))]) * depth[:, None]
                X[:, :3, 3] = p_CM - R_CW @ self._middle
                found += list(X)
        return found

    def improve(self, numbered: tuple[int, Array], step: SearchRound) -> tuple[float, Array]:
        """The best score near a pose (4, 4), and that pose (Nelder and Mead's simplex).

        numbered: the pose, and a number that says which way the simplex begins.
        """
        key, X_CW = numbered
        signs = np.random.default_rng(key).choice([-1.0, 1.0], 6)
        simplex = np.vstack([np.zeros(6), np.diag(step.step * signs * _STEPS)])
        options = {
            "maxfev": step.evaluations, "initial_simplex": simplex, "xatol": 0.0, "fatol": 0.0,
        }  # fmt: skip

        def cost(x: Array) -> float:
            return -self.score(self._moved(X_CW, x))

        found = minimize(cost, np.zeros(6), method="Nelder-Mead", options=options)
        return -float(found.fun), self._moved(X_CW, found.x)

    def distinct(self, X_CW: Sequence[Array], most: int | None = None) -> list[Array]:
        """Those of some poses that show the body elsewhere than all before; so many at most."""
        some = self._points[:: max(1, len(self._points) // 50)]
        kept, places = list[Array](), np.zeros((0, *some.shape))
        for X in X_CW:
            p_C = some @ X[:3, :3].T + X[:3, 3]
            apart = np.linalg.norm(places - p_C, axis=2).mean(axis=1)
            if (apart > _APART * self._size).all():
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


def _upright_rotations(count: int) -> Array:
    """(count, 3, 3) rotations R_CW of cameras about upright in a world whose z is up."""
    k = np.arange(count) + 0.5
    rng = np.random.default_rng(1)
    heading = 2.0 * np.pi * k * (0.5 * (np.sqrt(5.0) - 1.0))
    pitch = np.arcsin(np.linspace(*_PITCHES, count))
    roll = rng.normal(0.0, _ROLL, count)
    forward = np.column_stack(
        [np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)]
    )
    right = np.column_stack([np.sin(heading), -np.cos(heading), np.zeros(count)])
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * right + s * down, -s * right + c * down, forward], axis=1)
