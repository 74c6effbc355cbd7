"""The contour of any model in any number of masks, as a measurement of its pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.errors import SettingsError
from drake_pose.filtering.body_state import BodyState
from drake_pose.filtering.update import LinearObservation
from drake_pose.fit.camera_sums import Views
from drake_pose.fit.colours import (
    COLOUR_CORRELATION,
    COLOUR_SPACING,
    Histograms,
    add_pictures,
    check_picture,
    learned,
    no_colours,
    part_distances,
    step_of_lines,
    weigh_parts,
)
from drake_pose.fit.contour_fit import (
    Comparison,
    Noise,
    camera_weights,
    compare_views,
    normal_equations,
    pack_cameras,
    pack_views,
)
from drake_pose.fit.covariance import distances, error_unit, estimate_sizes, values_covariance
from drake_pose.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.fit.kernel import COMPARED, FITTING, REACH, SQUARES, WEIGHT
from drake_pose.fit.levenberg_marquardt import AnnealingStage

# How a contour is measured [pixel]: the spacing of its points; how far a mask's edge is from the
# body's own contour at least; how much of it errs together: its points count as one; how far from
# the model's contour the mask's edge is looked for.
SPACING, DEVIATION, CORRELATION, FARTHEST = 3.0, 0.7, 12.0, 40.0
# Geman and McClure's weight has half its influence at about this many deviations.
_ROBUST_WIDTH = 2.5
# A pixel of contour has weight one.
_PLAIN = Noise(deviation=1.0, correlation=0.5)
# Directions about which so small a share of the most is told are not told about.
_NOTHING = 1e-12


class Seen(NamedTuple):
    """What a frame shows.

    views: the edges of masks; pictures: of cameras without a mask, else None; colours: what is
    known of the body's colours before the frame.
    """

    views: Views
    pictures: tuple[Picture | None, ...]
    colours: Histograms | None

    @property
    def has_pictures(self) -> bool:
        """Whether there is one to be compared."""
        return self.colours is not None and any(one is not None for one in self.pictures)


@dataclass(frozen=True, eq=False)
class ContourMeasurement(LinearObservation):
    """What masks say of a pose near one state, made for one frame.

    The distances of hundreds of contour points are summed to normal equations, and these are as
    many numbers with noise 1 as there are directions of the state that they tell something about.

    Attributes:
        y: (k,) what was measured, 0 at ``at``.
        share: of the contour that the model shows, what has an edge beside it.
        distance: root mean square of their distances, robustly weighted [pixel].
        part_distances: (nodes,) of each part in the pictures [pixel]; 0 where they say too little.
        compared: the contours, as they were compared at ``at``.
    """

    y: Array
    share: float
    distance: float
    part_distances: Array
    compared: Comparison


class ContourObservation(BodyState):
    """Turns masks and pictures into measurements of a pose tree's values."""

    def look(
        self,
        masks: Sequence[Mask | None],
        pictures: Sequence[Picture | None] | None = None,
        colours: Histograms | None = None,
    ) -> Seen:
        """What a frame shows: the points of masks' edges, found once for all its measurements.

        Args:
            masks: (H, W) of each camera, in their order; None where there is none.
            pictures: (H, W, 3 or 4) of each camera; None where there is none. They are compared
                where there is no mask.
            colours: what is known of the body's colours; None: nothing, and pictures say nothing.

        Raises:
            SettingsError: masks or pictures that do not fit the cameras.
        """
        pictures = [None] * len(masks) if pictures is None else pictures
        for what, given in (("masks", masks), ("pictures", pictures)):
            if len(given) != len(self.cameras):
                raise SettingsError(f"{len(self.cameras)} {what} expected, got {len(given)}")
        edges, compared = [], []
        for camera, mask, picture in zip(self.cameras, masks, pictures, strict=True):
            if mask is not None and mask.shape != (camera.height, camera.width):
                raise SettingsError(
                    f"camera '{camera.name}': mask of {mask.shape[1]} x {mask.shape[0]} pixels, "
                    f"{camera.width} x {camera.height} expected"
                )
            edges.append(NO_EDGE if mask is None else find_edge_points(mask, 0.5 * SPACING))
            compared.append(
                None if picture is None or mask is not None else check_picture(camera, picture)
            )
        return Seen(pack_views(self.cameras, edges), tuple(compared), colours)

    def is_finest(self, number: int) -> bool:
        """Whether no later measurement of a frame looks at pictures more closely than this one."""
        return step_of_lines(number) == step_of_lines(number + 9)

    def no_colours(self) -> Histograms:
        """What is known of a body's colours that was never seen."""
        return no_colours(len(self.cameras), len(self._body.outlines))

    def learn(
        self,
        pictures: Sequence[Picture | None],
        x: Array,
        colours: Histograms,
        surely: bool = False,
        without: Mask | None = None,
    ) -> Histograms:
        """What is known of the body's colours after a frame.

        Args:
            pictures: of each camera; None where there is none.
            x: (n,) the state in the frame.
            surely: whether the pose is known, so that old colours are forgotten.
            without: (nodes,) parts of which nothing is learned.

        Raises:
            SettingsError: pictures that do not fit the cameras.
        """
        checked = [
            None if picture is None else check_picture(camera, picture)
            for camera, picture in zip(self.cameras, pictures, strict=True)
        ]
        placed = self._body.place(self.parameters(x))
        known = learned(placed, self.cameras, checked, colours, surely)
        if without is not None:
            known[:, without] = colours[:, without]
        return known

    def measure(
        self,
        seen: Seen,
        x: Array,
        distance: float | None = None,
        number: int = 0,
        without: Mask | None = None,
    ) -> ContourMeasurement | None:
        """Compare the model's contour at a state with a frame.

        Args:
            distance: about how far they are apart [pixel], of the measurement before; None: as far
                as is looked.
            number: how many measurements of the frame were made before: lines in pictures are
                looked at more closely from one to the next.
            without: (nodes,) parts of which the pictures say nothing.

        Returns:
            The measurement; None where no edge is near the contour in any mask or picture.
        """
        width = FARTHEST / REACH
        if distance is not None:
            width = min(width, _ROBUST_WIDTH * max(DEVIATION, distance))
        found = self._compare(seen, x, width, number)
        if found is None:
            return None
        shown = np.array([picture is not None for picture in seen.pictures])
        if without is not None:
            off = np.ix_(shown, without)
            found[0].A[off], found[0].b[off] = 0.0, 0.0
        return self._compress(x, *found, part_distances(found[0].sums[shown]))

    def _compare(
        self, seen: Seen, x: Array, width: float, number: int
    ) -> tuple[Comparison, float] | None:
        """Contours compared with so wide a scale [pixel], and how far they are apart [pixel]."""
        step = AnnealingStage(width, SPACING)
        placed = self._body.place(self.parameters(x))
        weights = camera_weights(seen.views.cameras, placed, step, _PLAIN, 1.0)
        compared = compare_views(seen.views, placed, weights)
        if seen.colours is not None and seen.has_pictures:
            pixels = step_of_lines(number)
            # Coarse lines are so wide that they would say the same.
            lines = AnnealingStage(width, COLOUR_SPACING * min(pixels, 2))
            correlation = _PLAIN.correlation * COLOUR_CORRELATION / CORRELATION
            noise = replace(_PLAIN, correlation=correlation)
            add_pictures(compared, self.cameras, seen.pictures, seen.colours, lines, noise, pixels)
            weigh_parts(compared, DEVIATION, seen.pictures)
        squares, weight = compared.sums[:, :, [SQUARES, WEIGHT]].sum(axis=(0, 1))
        return None if weight <= 0.0 else (compared, math.sqrt(squares / weight))

    def _compress(
        self, x: Array, compared: Comparison, distance: float, parts: Array
    ) -> ContourMeasurement:
        """What the contours say as no more numbers than the state has elements, with noise 1."""
        H, g = normal_equations(compared.total, compared.placement, len(self._body.names))
        index = self._parameter_index
        scale = max(DEVIATION, distance)
        # Both contours say the same: together they count as one.
        worth = 0.5 / (scale**2 * CORRELATION)
        rest_curvature, rest_slope = self._rest
        slopes = worth * g[index] + rest_curvature @ x[self._state_index] - rest_slope
        curvature = worth * H[np.ix_(index, index)] + rest_curvature
        size, turns = np.linalg.eigh(curvature)
        told = size > _NOTHING * max(float(size[-1]), 1e-300)
        root, turns = np.sqrt(size[told]), turns[:, told]
        slope = np.zeros((len(root), len(self.layout)))
        slope[:, self._state_index] = root[:, None] * turns.T
        contour = compared.sums[:, :-1].sum(axis=(0, 1))
        return ContourMeasurement(
            names=tuple(f"contour_{k}" for k in range(len(root))),
            variances=np.ones(len(root)),
            wraps=np.zeros(len(root), dtype=np.bool_),
            h=np.zeros(len(root)),
            y=-(turns.T @ slopes) / root,
            H=slope,
            at=x,
            share=float(contour[FITTING] / max(contour[COMPARED], 1e-9)),
            distance=distance,
            part_distances=parts,
            compared=compared,
        )

    def covariance(self, measured: ContourMeasurement, area: float) -> Array:
        """(m, m) of the tree's values where they were measured, as if the instant stood alone.

        Surfaces, masks and cameras err together, see ``fit.covariance``; area: of all silhouettes.
        """
        unit = error_unit(math.sqrt(area / len(self.cameras)))
        index, size = self._parameter_index, len(self._body.names)
        is_angle = np.array([self.is_angle(name) for name in self._seen_names])
        moves = measured.compared.placement.dense(size)[:, index]
        cameras = pack_cameras(self.cameras)
        seen = distances(self._body.outlines, cameras, measured.compared, moves, unit)
        sizes = estimate_sizes(seen, is_angle)
        covariance, count = np.zeros((size, size)), len(self._kinematics.names)
        covariance[np.ix_(index, index)] = values_covariance(
            seen, sizes, np.arange(len(index)), is_angle
        )
        return covariance[:count, :count]
