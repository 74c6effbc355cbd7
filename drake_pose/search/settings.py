"""Settings of all searches.

Unless a unit is given, lengths and excesses of J are fractions of the quantity that the class's
docstring names, so that settings do not depend on the size of the images.
"""

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_pose.errors import SettingsError, require_at_least, require_positive
from drake_pose.fit.levenberg_marquardt import AnnealingStage


@dataclass(frozen=True)
class GridSettings:
    """Sampling intervals of a pose tree's values.

    Args:
        interval: sampling interval of every angle [rad]; the paper's is 20 degrees.
        length_interval: sampling interval of every prismatic position [m].

    Raises:
        SettingsError: if a value is out of its range.
    """

    interval: float = math.radians(20.0)
    length_interval: float = 0.05

    def __post_init__(self) -> None:
        require_positive(interval=self.interval, length_interval=self.length_interval)


@dataclass(frozen=True)
class PaperSearchSettings(GridSettings):
    """Parameters of Kameda's search (sections 5.1, 5.2 and 6.1 of the paper).

    Args:
        outside_limit: the threshold r of (4) [pixel]: greatest area of a segment outside the
            silhouette, in each view. None: start with 12.6 % of the mean projected area of a
            segment (200 pixels for the paper's body) and double until a pose is found.
        candidate_limit: K, the number of candidates kept for each node.
        run_limit: greatest number of runs of step 3; the best pose found until then is returned.

    Raises:
        SettingsError: if a value is out of its range.
    """

    outside_limit: float | None = None
    candidate_limit: int = 5
    run_limit: int = 10_000

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(0, outside_limit=self.outside_limit)
        require_at_least(1, candidate_limit=self.candidate_limit, run_limit=self.run_limit)


@dataclass(frozen=True)
class Stage:
    """One pass of the beam search over all nodes.

    Args:
        hypotheses: beam width: number of hypotheses kept after each node.
        outside_fraction: greatest area of a node outside the silhouette, as a fraction of the
            node's mean projected area, both summed over the views; infinite: no limit.
        outside_weight: cost of a pixel outside the silhouette, relative to the gain of a newly
            covered pixel.
        limb_by_limb: True: place one limb after another; False: place the ends of all limbs last.
    """

    hypotheses: int
    outside_fraction: float = 0.0
    outside_weight: int = 1
    limb_by_limb: bool = False

    def __post_init__(self) -> None:
        require_at_least(1, hypotheses=self.hypotheses, outside_weight=self.outside_weight)
        require_at_least(0, outside_fraction=self.outside_fraction)


EXACT_STAGES = (Stage(20), Stage(160))
"""Stages for a model that fits the object exactly. If no pose fits exactly, they end early; if they
find none, a branch and bound enumerates all poses within the tolerance."""

TOLERANT_STAGES = (Stage(80, 0.3, 5), Stage(300, 1.0, 2))
"""Stages for a model that fits the object only approximately."""


@dataclass(frozen=True)
class BeamSearchSettings(GridSettings):
    """Parameters of the beam search.

    Args:
        tolerance: a pose with J up to this counts as exact [pixel]; None: the difference between
            two renderers (``renderer_tolerance``).
        stages: the passes, run one after another until J is within the tolerance. Where
            ``outside_fraction`` is 0 the tolerance limits the area outside; after these stages a
            branch and bound enumerates all poses within the tolerance.
        research_hypotheses: beam width when limbs of the best pose are searched again; 0: limbs are
            not searched again.
        time_limit: time after which the best pose found is returned [s]; None: no limit.

    Raises:
        SettingsError: if a value is out of its range.
    """

    tolerance: float | None = None
    stages: tuple[Stage, ...] = EXACT_STAGES + TOLERANT_STAGES
    research_hypotheses: int = 30
    time_limit: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stages:
            raise SettingsError("stages must hold at least one stage")
        hypotheses = self.research_hypotheses
        require_at_least(0, research_hypotheses=hypotheses, time_limit=self.time_limit)


@dataclass(frozen=True)
class Pass:
    """One pass of a refinement by pixels (see ``refinement``)."""

    iterations: int  # Greatest number of steps.
    stride: int  # Every stride-th row and column is compared.
    scale: float  # Scale of the robust cost: larger distances lose weight [pixel].
    damping: float  # Added to the diagonal of the normal equations [pixel^2/rad^2].
    longest_step: float = 0.25  # Greatest change of a parameter in a step [rad or m].
    slack: float = 0.0  # Dead zone: distances up to this have hardly any weight [pixel].


# Passes of a refinement by pixels: from a coarse pose, from a near one, and to the optimum.
#
# A pixel is wrong if the contour is more than half a pixel from the border on the pixel's raster
# line. A smaller distance carries no information: the border is uniformly distributed between two
# pixel centres. A least-squares pose leaves 0.02 to 0.03 of the border's pixels wrong. A pose
# within half a pixel on all lines leaves 0.005 to 0.015 wrong and is half as far from the true
# pose. The slack of the last passes is 0.4 instead of 0.5 pixels, so that the pose does not end on
# the bounds of this region.
COARSE_PASSES = (Pass(8, 4, 50.0, 300.0), Pass(8, 4, 10.0, 100.0))
FINE_PASSES = (Pass(5, 2, 6.0, 30.0), Pass(6, 2, 3.0, 10.0), Pass(8, 1, 2.0, 5.0))
LAST_PASSES = (Pass(5, 2, 2.0, 5.0), Pass(15, 1, 1.0, 0.5, slack=0.4))


class NeighbourhoodSettings(NamedTuple):
    """Parameters of the search around a pose; excesses of J are fractions of the border length."""

    placed: tuple[Pass, ...] = (Pass(4, 4, 30.0, 100.0),)  # First passes of a part placed anew.
    # First passes of a mirrored part of the body.
    mirrored: tuple[Pass, ...] = (Pass(8, 4, 30.0, 100.0), Pass(6, 3, 6.0, 30.0))
    second: tuple[Pass, ...] = (Pass(5, 3, 6.0, 30.0),)  # Passes after the first ones.
    fine: tuple[Pass, ...] = (Pass(6, 2, 2.0, 5.0),)  # Passes to the optimum of the part alone.
    final: tuple[Pass, ...] = (Pass(6, 1, 1.0, 0.5, slack=0.4),)  # Passes of alternative poses.
    whole: tuple[Pass, ...] = (Pass(3, 3, 6.0, 50.0), Pass(3, 2, 2.0, 5.0))  # All parts move.
    refined: int = 2  # Number of placements that get the second passes.
    first_excess: float = 0.15  # Greatest excess over the current J after the first passes.
    whole_excess: float = 0.01  # Poses up to this excess are refined with all parts moving.
    least_decrease: float = 0.003  # A smaller decrease of J is no improvement.
    same_error: float = 0.1  # Errors of a part are equal if they differ by a smaller fraction.
    least_error: float = 0.001  # Parts with less error are not placed anew [fraction of the area].
    rounds: int = 2  # Number of tries of each part; doubled where all parts must be tried.


class RootPlacementSettings(NamedTuple):
    """Parameters of the search for the root's position."""

    positions_across: int = 12  # Positions tried across the silhouette.
    scale_ratio: float = 1.12  # Ratio of neighbouring scales or depths.
    # Factor by which a body cut off by the image border may be larger than its silhouette.
    cut_off: float = 1.5
    # Greatest area outside the silhouette [fraction of a node's mean projected area]. It is large
    # because the root may be half a grid step off.
    outside_fraction: float = 0.6
    outside_weight: int = 2  # Cost of a pixel outside, relative to the gain of one newly covered.
    hypotheses: int = 500  # Beam width, shared among the scales or depths.
    quota: float = 0.05  # Greatest fraction of the hypotheses with the same root position.
    starts: int = 24  # Number of poses refined by the coarse passes.
    finalists: int = 3  # Number of root positions searched again, and of poses refined to the end.
    coarse_pixels: int = 1500  # Area of a silhouette in the coarse images [pixel].
    root_factor: int = 2  # Beam width after the root, as a multiple of the beam width.
    root_spare: int = 2  # Rotations tried at each position, as a multiple of its quota.
    spare: int = 8  # Hypotheses made before the quota is applied, as a multiple of the beam width.
    good_E_total: float = 0.004  # The search ends at a pose with a smaller E_total.


@dataclass(frozen=True)
class ExactSearchSettings:
    """Parameters of the search in exact masks; limits of J are fractions of the border length.

    The beam searches use grids of 20 degrees (index 0) and 15 degrees (index 1). Each runs only if
    those before it found no good pose: a pose missed on one grid or in one order of nodes is often
    found on another.
    """

    stages: tuple[tuple[int, Stage], ...] = (
        (0, Stage(60, 0.3, 5)),
        (1, Stage(60, 1.0, 2)),
        (1, Stage(60, 1.0, 2, limb_by_limb=True)),
        (1, Stage(60, 0.3, 5, limb_by_limb=True)),
    )
    # Masks may be exact if at least this fraction of their border pixels coincides with the border
    # of a fitted pose. Bodies drawn by Drake have .54 to .99 (``tests/silhouettes``), real arms and
    # people .1 to .51.
    coinciding: float = 0.53
    # The search gives up if J after the coarse passes exceeds the larger of these two: the second
    # is a fraction of the square root of the mean silhouette area [pixel].
    hopeless: float = 1.5
    hopeless_fraction: float = 0.017
    # Pixel noise: the search ends at a pose with a smaller J, and poses whose J exceeds the best by
    # less are as good.
    noise: float = 0.03
    exact: float = 0.18  # A pose with a smaller J is the answer.
    plausible: float = 0.5  # Above this J the pose of the robust fit is the answer.
    # Two grids agree if the ratio of their Js is smaller: the model itself does not fit.
    agreement: float = 1.1
    replacements: int = 3  # Greatest number of times that an alternative replaces the best pose.
    same: float = 0.1  # Poses are equal if no value differs by more [rad or m].
    confidence: float = 0.95  # Probability that an interval contains the true value.
    # Ratio of the actual standard deviation to that of statistically independent distances.
    noise_factor: float = 1.4
    misfit: float = 0.025  # Above this J no value is determined: another pose may be right.


COARSE_STAGES = (AnnealingStage(0.1, 0.04, 3), AnnealingStage(0.05, 0.04, 3))
MEDIUM_STAGES = (AnnealingStage(0.05, 0.026, 4), AnnealingStage(0.025, 0.026, 4))


@dataclass(frozen=True)
class MultiStartSettings:
    """Parameters of the search in damaged masks.

    Lengths are fractions of the size: the square root of the silhouettes' mean area.
    In several views the cost of a wrong pose is higher from the first stage on, so starts are
    dropped early. In a single view the last stage may decide.
    """

    interval: float = math.radians(15.0)  # Sampling interval of angles in the coarse search [rad].
    final: tuple[AnnealingStage, ...] = (AnnealingStage(0.0125, 0.0125, 6),)
    starts: int = 40  # Number of coarse poses that are fitted.
    finalists: int = 4  # Number of poses that are fitted to the end.
    # Stages, and the number of poses kept after them: in one view, and in several.
    passes: tuple[tuple[tuple[tuple[AnnealingStage, ...], int], ...], ...] = (
        ((COARSE_STAGES, 12), (MEDIUM_STAGES, 12)),
        (
            (COARSE_STAGES[:1], 20),
            (COARSE_STAGES[1:], 12),
            (MEDIUM_STAGES[:1], 6),
            (MEDIUM_STAGES[1:], 6),
        ),
    )
    # Stages of alternative poses in several views, and the number kept after them.
    alternative_passes: tuple[tuple[tuple[AnnealingStage, ...], int], ...] = (
        (MEDIUM_STAGES[:1], 4),
        (MEDIUM_STAGES[1:], 4),
    )
    # Coarse poses differ if some node's image is at least this far away.
    separation: float = 0.13
    rounds: int = 2  # Rounds of the search for alternative poses,
    explored: int = 3  # number of poses around which alternatives are searched in a round,
    alternatives: int = 6  # and number of alternatives of each pose that are fitted,
    flipped: int = 3  # besides this number of flipped poses.
    # In several views a round ends if no alternative costs less than this fraction of the best.
    improvement: float = 0.98
    # Radius of a disc as thick as a limb, in one and in several views.
    limb_radii: tuple[float, float] = (0.03, 0.04)
    beam_starts: int = 10  # If a wrong region holds such a disc: number of poses of a beam search,
    beam_views: int = 2  # number of views that it uses,
    beam_pixels: int = 3000  # and area of their silhouettes [pixel].


class RobustSettings(NamedTuple):
    """Parameters of the intervals and modes computed from damaged masks."""

    # Stage at which costs of poses are compared.
    comparison: AnnealingStage = AnnealingStage(0.0125, 0.026, 2)
    measure: AnnealingStage = AnnealingStage(0.025, 0.0125)  # Stage at which errors are measured.
    # Difference of costs that is significant [standard deviations].
    significance: float = 1.96
    modes: int = 8  # Greatest number of modes.
    # Values whose interval by covariance is wider on a side are moved step by step [rad, m].
    moved: tuple[float, float] = (math.radians(3.0), 0.01)
    longest_steps: tuple[float, float] = (0.5, 0.1)  # Longest step of a moved value [rad, m].
    step_factor: float = 1.6  # Ratio of successive steps.
    camera_freedom: int = 6  # Degrees of freedom of a camera's error.

    @staticmethod
    def widest(is_angle: np.ndarray) -> np.ndarray:
        """Return (m,) the greatest width of a determined value's interval [rad or m].

        It is 10 degrees, or 2 cm, on each side. ``is_angle``: (m,) bool whether each of the pose
        tree's m values is an angle.
        """
        return 2.0 * np.where(is_angle, math.radians(10.0), 0.02)


@dataclass(frozen=True)
class BoundLimits:
    """Limits of a branch and bound.

    Raises:
        SettingsError: if a value is out of its range.
    """

    states: int = 20_000  # Greatest number of partial poses kept after each node.
    # Greatest number of pairs of a partial pose and a pose of the next node that are evaluated for
    # one node.
    pairs: int = 1_000_000
    poses: int = 1_000_000  # Number of drawn poses of nodes after which the search stops.
    # The search stops before the drawn poses and the areas that they reach take more than this, and
    # it keeps fewer partial poses if all would take more than a quarter of this [byte]. Temporary
    # arrays take about as much again.
    memory: int = 400_000_000
    time_limit: float | None = None  # Time after which the search stops [s]; None: no limit.

    def __post_init__(self) -> None:
        sizes = {"states": self.states, "pairs": self.pairs, "poses": self.poses}
        require_at_least(1, **sizes, memory=self.memory)
        if self.time_limit is not None and not 0.0 <= self.time_limit < math.inf:
            raise SettingsError(f"time_limit must be 0 s or more, not {self.time_limit}")

    @property
    def deadline(self) -> float:
        """The time.perf_counter() at which a search that starts now must stop [s]."""
        return math.inf if self.time_limit is None else time.perf_counter() + self.time_limit
