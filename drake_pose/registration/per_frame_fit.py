"""Each frame fitted by itself, its joints and cameras free to move a little from where they are.

What is given is where a fit begins, and its prior. What is left of the distances is linear in what
is given about where the fit ends.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.fit.contour_fit import Comparison, inlier_ratio_of
from drake_pose.fit.covariance import ComparedMask
from drake_pose.fit.evidence import Observation
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.fit.parameters import POSE_NAMES, BodyParameters
from drake_pose.fit.problem import Problem, Unknowns
from drake_pose.registration.posed_frames import SeenFrame, common_size, middle_of
from drake_pose.registration.shared_fit import SHARED
from drake_pose.silhouette.outline import Outline


@dataclass(frozen=True, eq=False)
class FrameFit:
    """A frame whose joints and cameras were fitted.

    Args:
        pictures: the contours compared with each camera's silhouette where the fit ended, and told
            as distances from what is given; their values are the joints' and POSE_NAMES of each
            camera.
        inlier_ratios: before and after, by camera.
        weights: (nodes,) how much of the contours of each node was compared [pixel].
        fitting: (nodes, 2) lengths of each node's contours that were compared and that fit.
    """

    name: str
    compared_masks: tuple[ComparedMask, ...]
    inlier_ratios: tuple[Mapping[str, float], Mapping[str, float]]
    outline_lengths: Array
    matched_lengths: Array


class PerFrameFit:
    """Fits frames, each by itself, with all that is given free to move.

    Attributes:
        outlines: all of the surfaces.
        cameras: where they are said to stand.
        size: the root of the silhouettes' median area [pixel].
        names: of the p values that move: the joints, and POSE_NAMES of each camera.
        deviations: (p,) how far what is given may be off: standard deviations [rad or m].

    Args:
        outlines: a surface for each node: of few triangles, with which frames are fitted, and all,
            with which they are compared in the end.
        cameras: the cameras, where they are said to stand.
        frames: some frames, which tell how large silhouettes are, and where the body is.

    Raises:
        MaskError: a mask of another size than its camera's picture, or no mask shows the body.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: tuple[Sequence[Outline], Sequence[Outline]],
        cameras: Sequence[Camera],
        frames: Sequence[SeenFrame],
    ) -> None:
        self.cameras, self.outlines = tuple(cameras), outlines[1]
        self.size = common_size(cameras, frames)
        joints = np.flatnonzero(kinematics.lower < kinematics.upper)
        self.camera_names = tuple(camera.name for camera in cameras)
        self.joints = tuple(kinematics.names[k] for k in joints)
        looks = tuple(f"{camera.name}.{name}" for camera in cameras for name in POSE_NAMES)
        self.names = (*self.joints, *looks)
        turns = np.tile([name.startswith("turn") for name in POSE_NAMES], len(cameras))
        self.is_angle = np.concatenate([kinematics.is_angle[joints], turns])
        # How far joints, and cameras about the body, may be off: standard deviations [rad, m].
        of_joints = np.where(kinematics.is_angle[joints], 0.1, 0.02)
        self.deviations = np.concatenate([of_joints, np.full(len(turns), 0.05)])
        worth = SHARED.point_error * np.sqrt(SHARED.error_length)
        self._middle = middle_of(kinematics, frames)
        self._few, self._all = (
            Problem(
                BodyParameters(kinematics, one), cameras,
                [Unknowns(self.names, deviation=self.deviations / worth)], pivot=self._middle,
                steps=StepSettings(longest=0.2, damping=1e-3, even_damping=1e-6),
                pixels=self.size,
            )
            for one in outlines
        )  # fmt: skip

    def fit(
        self,
        frame: SeenFrame,
        scales: Sequence[float] = (0.12, 0.09, 0.07, 0.05, 0.04, 0.03, 0.025),
        already: float = 1.3,
    ) -> FrameFit:
        """Fits a frame.

        Args:
            frame: the frame.
            scales: of the rounds [root of the silhouettes' area].
            already: where given values cost at most this multiple of the fitted ones' cost,
                distances are linear about them: what hardly shows may have moved far.

        Raises MaskError: a mask of another size than its camera's picture.
        """
        edges = frame.edges(self.cameras, 0.01 * self.size)
        start, count = (np.zeros((1, len(self.names))), np.zeros(0)), len(self.cameras)
        given = Observation(edges, frame.values)
        change, base = start, given
        rounds = [AnnealingStage(scale, 0.02) for scale in scales]
        for part in (rounds, rounds[-2:]):
            found = self._few.solve([base], part, change, expected=start)
            change = found.own, found.shared
            theta = self.with_boundary_biases(base, found.parameters[0])
            held = self._all.parameters([given], *start)[0]
            base = given._replace(values=np.append(held[:-count], theta[-count:]))
        held = self.with_boundary_biases(given, held)
        before, after = (
            self._all.compare(given, one, SHARED.inlier_stage)[0] for one in (held, theta)
        )
        told = after
        costs = [float(one.sums[:, :, Sum.COST].sum()) for one in (before, after)]
        if costs[0] <= already * costs[1]:
            theta, told, change = held, before, start
        weights = told.sums[:, :, Sum.WEIGHT].sum(axis=0)
        return FrameFit(
            frame.name,
            tuple(
                one._replace(b=one.b + np.einsum("nkl,npl,p->nk", one.A, one.moves, change[0][0]))
                for one in self._all.compared_masks([given], theta[None], SHARED.inlier_stage)
            ),
            (self._inlier_ratios(before, frame), self._inlier_ratios(after, frame)),
            # Edges are shared out among the nodes.
            weights[:-1] * weights.sum() / max(float(weights[:-1].sum()), 1e-9),
            told.sums[:, :-1, [Sum.COMPARED, Sum.FITTING]].sum(axis=0),
        )

    def _inlier_ratios(self, compared: Comparison, frame: SeenFrame) -> dict[str, float]:
        sums = zip(self.camera_names, compared.sums, strict=True)
        return {name: inlier_ratio_of(one) for name, one in sums if name in frame.masks}

    def with_boundary_biases(self, seen: Observation, theta: Array) -> Array:
        """All parameters (n,), the silhouettes as much wider on all sides as fits best [pixel]."""
        widths, count = np.linspace(-3.0, 3.0, 5), len(self.cameras)
        found, costs = theta.copy(), np.full((len(widths), count), np.inf)
        # The narrowest and the widest are looked at where the cost goes on falling that way.
        for k, beside in ((1, None), (2, None), (3, None), (0, 1), (4, 3)):
            if beside is None or (np.argmin(costs, axis=0) == beside).any():
                found[-count:] = widths[k]
                compared, _ = self._few.compare(seen, found, SHARED.inlier_stage)
                costs[k] = compared.sums[:, :, Sum.COST].sum(axis=1)
        best = np.clip(np.argmin(costs, axis=0), 1, len(widths) - 2)
        low, middle, high = (np.choose(best + k, costs) for k in (-1, 0, 1))
        bend = low - 2.0 * middle + high
        step = np.where(bend > 0.0, 0.5 * (low - high) / np.where(bend > 0.0, bend, 1.0), 0.0)
        found[-count:] = widths[best] + np.clip(step, -1.0, 1.0) * (widths[1] - widths[0])
        return found

    def base_jacobian(self) -> Array:
        """(p, 6) how what is free follows a turn [rad] and shift [m] of the base, in deviations.

        All cameras see the base move about their common pivot.
        """
        moves = np.zeros((len(self.names), 6))
        for c, camera in enumerate(self.cameras):
            first = len(self.joints) + 6 * c
            R_CW = camera.X_CW[:3, :3]
            moves[first : first + 3, :3] = R_CW
            moves[first + 3 : first + 6, 3:] = R_CW
        return np.asarray(moves / self.deviations[:, None])

    def center_jacobian(self, cameras: Sequence[int]) -> Array:
        """(p, 2) as base_moves, of a pixel by which principal points are shifted along x and y.

        At depth z a body is seen shifted by z over the focal length: a shift, and a turn, but for
        what the turn changes of the depth.
        """
        moves = np.zeros((len(self.names), 2))
        for c in cameras:
            kind, focal_x, focal_y = self.cameras[c].kernel_parameters()[:3]
            first, z = len(self.joints) + 6 * c, self._depth(c)
            of_x, of_y = moves[first : first + 6].T
            of_x[3], of_y[4] = ((1.0 if kind == 1.0 else z) / focal for focal in (focal_x, focal_y))
            of_x[1], of_y[0] = (0.0, 0.0) if kind == 1.0 else (1.0 / focal_x, -1.0 / focal_y)
        return np.asarray(moves / self.deviations[:, None])

    def focal_jacobian(self, cameras: Sequence[int]) -> Array:
        """(p, 1) as base_moves, of focal lengths that are larger by all of themselves.

        A body is seen as it would be if it were nearer by that share of its depth; to a parallel
        camera it is as near as ever.
        """
        moves = np.zeros((len(self.names), 1))
        for c in cameras:
            if self.cameras[c].kernel_parameters()[0] != 1.0:
                moves[len(self.joints) + 6 * c + 5] = -self._depth(c)
        return np.asarray(moves / self.deviations[:, None])

    def camera_jacobian(self, camera: str) -> Array:
        """(3, 6) how a camera itself moves along its axes [m] by what its POSE_NAMES say it is off.

        These turn and shift the body about its middle, as the camera sees it.
        """
        X_CW = self.cameras[self.camera_names.index(camera)].X_CW
        middle = X_CW[:3, :3] @ self._middle + X_CW[:3, 3]
        return np.hstack([np.cross(np.eye(3), middle).T, -np.eye(3)])

    def _depth(self, camera: int) -> float:
        """How far the body's middle is before a camera [m]."""
        X_CW = self.cameras[camera].X_CW
        return float(X_CW[2, :3] @ self._middle + X_CW[2, 3])
