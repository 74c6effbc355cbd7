"""Settings of the searches on a grid: Kameda's and the beam search."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.fit.levenberg_marquardt import AnnealingStage


@dataclass(frozen=True)
class GridSettings:
    """How the values of a pose tree are sampled.

    Args:
        interval: of every angle [rad]; the paper's is 20 degrees.
        length_interval: of every prismatic position [m].
        intervals: of single positions by name [rad or m], in place of the two above.

    Raises:
        SettingsError: if a value is out of its range.
    """

    interval: float = math.radians(20.0)
    length_interval: float = 0.05
    intervals: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        named = {"interval": self.interval, "length_interval": self.length_interval}
        named |= {f"interval of {name}": value for name, value in self.intervals.items()}
        for name, value in named.items():
            if not (math.isfinite(value) and value > 0):
                raise SettingsError(f"{name} must be positive and finite, not {value}")

    def _require(self, least: float, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            if value is not None and not value >= least:
                raise SettingsError(f"{name} must be {least:g} or more, not {value}")


@dataclass(frozen=True)
class PaperSearchSettings(GridSettings):
    """Parameters of Kameda's search (sections 5.1, 5.2 and 6.1 of the paper).

    Args:
        outside_limit: the threshold r of (4) [pixel]: the area of a segment that may lie outside
            the silhouette, in each view. None: begin with 12.6 % of the mean projected area of a
            segment (what the paper's 200 pixels are for its body) and double until a pose is found.
        candidate_limit: K, how many of a node's candidates are kept.
        run_limit: of runs of step 3; the answer is then the best pose so far.

    Raises:
        SettingsError: if a value is out of its range.
    """

    outside_limit: float | None = None
    candidate_limit: int = 5
    run_limit: int = 10_000

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(0, "outside_limit")
        self._require(1, "candidate_limit", "run_limit")


@dataclass(frozen=True)
class Stage:
    """One pass of the beam search over all nodes.

    Args:
        hypotheses: how many are kept after each node.
        outside_share: the share of a node's mean projected area, both summed over the views, that
            may lie outside the silhouette; infinite: any.
        outside_weight: what a pixel outside counts in the ranking; one newly covered counts one.
        limb_by_limb: place one limb after another, else the ends of all limbs last.
    """

    hypotheses: int
    outside_share: float = 0.0
    outside_weight: int = 1
    limb_by_limb: bool = False

    def __post_init__(self) -> None:
        if self.hypotheses < 1:
            raise SettingsError(f"a stage needs 1 hypothesis or more, not {self.hypotheses}")
        if not self.outside_share >= 0.0:
            raise SettingsError(f"outside_share must be 0 or more, not {self.outside_share}")
        if self.outside_weight < 1:
            raise SettingsError(f"outside_weight must be 1 or more, not {self.outside_weight}")


EXACT_STAGES = (Stage(20), Stage(160))
"""For a body that is the object itself. They end at once where it is not; where they fail, one
branch and bound looks for all poses within the tolerance."""

TOLERANT_STAGES = (Stage(80, 0.3, 5), Stage(300, 1.0, 2))
"""For a body that fits badly."""


@dataclass(frozen=True)
class BeamSearchSettings(GridSettings):
    """Parameters of the beam search.

    Args:
        tolerance: a pose whose silhouettes differ by no more [pixel] counts as exact; None: what
            two renderers differ by (``renderer_tolerance``).
        stages: the passes, one after another until J is within the tolerance. Of those with no
            outside share the tolerance is the limit; after them all poses within it are looked for.
        research_hypotheses: kept while limbs of the winner are searched again; 0: they are not.
        time_limit: the search returns its best pose so far after this time [s]; None: no limit.

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
        self._require(0, "research_hypotheses", "time_limit")


@dataclass(frozen=True)
class Pass:
    """One part of a refinement by pixels."""

    iterations: int  # The greatest number of steps.
    stride: int  # One row and one column in this many is looked at.
    scale: float  # Distances beyond it lose weight [pixel].
    damping: float  # Added to the diagonal of the normal equations [pixel^2/rad^2].
    longest_step: float = 0.25  # No parameter changes by more in a step [rad or m].
    slack: float = 0.0  # Distances up to this hardly count [pixel].


class RefinementPasses(NamedTuple):
    """The passes of a refinement by pixels: from far, from near, and to the optimum itself.

    A pixel is wrong where the contour is more than half a pixel from the border on its line. A
    smaller distance says nothing: the border lies anywhere between two pixel centres, with equal
    probability. The mean of least squares leaves 0.02 to 0.03 of the border's pixels wrong; a pose
    within the bounds that all lines set together leaves 0.005 to 0.015 and is half as far from the
    true one. The last passes' slack of 0.4 instead of 0.5 keeps it from resting on bounds.
    """

    coarse: tuple[Pass, ...] = (Pass(8, 4, 50.0, 300.0), Pass(8, 4, 10.0, 100.0))
    fine: tuple[Pass, ...] = (Pass(5, 2, 6.0, 30.0), Pass(6, 2, 3.0, 10.0), Pass(8, 1, 2.0, 5.0))
    last: tuple[Pass, ...] = (Pass(5, 2, 2.0, 5.0), Pass(15, 1, 1.0, 0.5, slack=0.4))


PASSES = RefinementPasses()


class NeighbourhoodSettings(NamedTuple):
    """Numbers of the search about a pose; limits on J are fractions of the borders' length."""

    far: tuple[Pass, ...] = (Pass(4, 4, 30.0, 100.0),)  # From a part placed anew.
    reflected: tuple[Pass, ...] = (Pass(8, 4, 30.0, 100.0), Pass(6, 3, 6.0, 30.0))  # Mirrored.
    nearer: tuple[Pass, ...] = (Pass(5, 3, 6.0, 30.0),)  # After these.
    fine: tuple[Pass, ...] = (Pass(6, 2, 2.0, 5.0),)  # To the part's optimum.
    end: tuple[Pass, ...] = (Pass(6, 1, 1.0, 0.5, slack=0.4),)  # Of other poses that are kept.
    whole: tuple[Pass, ...] = (Pass(3, 3, 6.0, 50.0), Pass(3, 2, 2.0, 5.0))  # All parts move.
    pursued: int = 2  # The number of placements refined after the first pass.
    hopeful: float = 0.15  # The greatest excess over the best J after the first pass,
    near: float = 0.03  # after the second,
    kept: float = 0.03  # and of poses that are kept.
    mended: float = 0.35  # Mirrored poses up to this excess are mended,
    mendings: int = 6  # with this many tries.
    equal: float = 0.01  # Poses up to this excess are refined with all of the body.
    better: float = 0.003  # A smaller decrease of J is no improvement.
    spare: float = 0.015  # Others up to this above their limit are refined with all of the body.
    same_error: float = 0.1  # Errors whose ratio differs from 1 by less are the same.
    least_error: float = 0.001  # Parts with less error are left for later [fraction of the area].
    rounds: int = 2  # How often a part is tried; twice as often where all parts are to be tried.


class RootPlacementSettings(NamedTuple):
    """Numbers of the search for the root's place."""

    across: int = 12  # Positions tried across the silhouette.
    ratio: float = 1.12  # Of neighbouring scales or depths.
    cut_off: float = 1.5  # A body cut off by the picture may be larger than it looks by this.
    outside_share: float = (
        0.6  # Of a node's area that may lie outside: the root is half a step off.
    )
    outside_weight: int = 2  # Cost of a pixel outside; one newly covered gains one.
    hypotheses: int = 500  # Shared among the scales or depths.
    quota: float = 0.05  # The largest fraction of them with the root at one position.
    starts: int = 24  # Poses refined from far.
    finalists: int = 3  # Root positions searched again, and poses refined to the end.
    again: int = 4  # Poses of each search again.
    pixels: int = 1500  # Of a coarse silhouette.
    root_factor: int = 2  # Hypotheses of the root alone, times the width.
    root_spare: int = 2  # Rotations tried at a position, times its quota.
    spare: int = 8  # Hypotheses grown before the quota, times the width.
    alike: float = 0.5  # See ``BeamSearch.best_poses``.
    enough: float = 0.004  # A pose with a smaller E_total is not searched on.


@dataclass(frozen=True)
class ExactSearchSettings:
    """Numbers of the search of exact masks; limits on J are fractions of the borders' length.

    Of the beam searches on the grids of 20 (0) and 15 degrees (1) each runs only where none before
    it has led to a good pose: what one grid and order of nodes misses, another often has.
    """

    stages: tuple[tuple[int, Stage], ...] = (
        (0, Stage(60, 0.3, 5)),
        (1, Stage(60, 1.0, 2)),
        (1, Stage(60, 1.0, 2, limb_by_limb=True)),
        (1, Stage(60, 0.3, 5, limb_by_limb=True)),
    )
    # Masks may be exact if this fraction of their border's pixels is a fitted pose's: .54 to .99 of
    # bodies that Drake drew (``tests/silhouettes``), .1 to .51 of real arms and people.
    coinciding: float = 0.53
    starts: int = 4  # Poses of each beam search that are refined.
    alike: float = 0.5  # See ``BeamSearch.best_poses``.
    # Give up above this J after coarse passes, or where larger, above this times the root of the
    # mean area [pixel].
    hopeless: float = 1.5
    hopeless_share: float = 0.017
    enough: float = 0.03  # A pose with a smaller J is not searched on: it is the pixels' noise.
    exact: float = 0.18  # A pose with a smaller J is the answer.
    plausible: float = 0.5  # Above this J the robust pose is the answer.
    agreeing: float = 1.1  # Two grids agree if the ratio of their Js is smaller: the body misfits.
    better: int = 3  # How often another pose may replace the best one.
    tolerance: float = 0.03  # Poses are as good as the best up to this excess.
    same: float = 0.1  # Poses whose values differ by less are one [rad or m].
    confidence: float = 0.95  # Probability that an interval holds the true value.
    noise_factor: float = 1.4  # Standard deviation relative to that of independent distances.
    misfit: float = 0.025  # Above this J nothing is determined: another pose may be right.


_COARSE = (AnnealingStage(0.1, 0.04, 3), AnnealingStage(0.05, 0.04, 3))
_MEDIUM = (AnnealingStage(0.05, 0.026, 4), AnnealingStage(0.025, 0.026, 4))


@dataclass(frozen=True)
class MultiStartSettings:
    """Numbers of the search of damaged masks; sizes are fractions of the root of the mean area.

    In several views a wrong pose costs more from the first stage on. In one view the last stage may
    decide: there no start is dropped after the first stage.
    """

    interval: float = math.radians(15.0)  # Of the angles of coarse poses [rad].
    coarse: tuple[AnnealingStage, ...] = _COARSE
    medium: tuple[AnnealingStage, ...] = _MEDIUM
    final: tuple[AnnealingStage, ...] = (AnnealingStage(0.0125, 0.0125, 6),)
    starts: int = 40  # Coarse poses that are fitted.
    finalists: int = 4  # Poses that are fitted to the end.
    # Stages, and the number of poses that go on after them, in one view and in several.
    passes: tuple[tuple[tuple[tuple[AnnealingStage, ...], int], ...], ...] = (
        ((_COARSE, 12), (_MEDIUM, 12)),
        ((_COARSE[:1], 20), (_COARSE[1:], 12), (_MEDIUM[:1], 6), (_MEDIUM[1:], 6)),
    )
    # The same of other explanations, in several views.
    following: tuple[tuple[tuple[AnnealingStage, ...], int], ...] = (
        (_MEDIUM[:1], 4),
        (_MEDIUM[1:], 4),
    )
    apart: float = 0.13  # Coarse poses differ if a part is seen this far away.
    rounds: int = 2  # Of searches for other explanations,
    sought_about: int = 3  # about this many poses,
    tried: int = 6  # of which this many are fitted each,
    flipped: int = 3  # and this many made by flips.
    better: float = 0.98  # In several views they end if costs do not fall to this fraction.
    limbs: tuple[float, float] = (0.03, 0.04)  # Radius of a limb's disc, in one and several views.
    beam_starts: int = 10  # If such a disc fits into what is wrong, poses of the beam search,
    beam_views: int = 2  # in this many views,
    beam_pixels: int = 3000  # with this many pixels each.


class RobustSettings(NamedTuple):
    """Numbers of the intervals and modes of damaged masks."""

    look: AnnealingStage = AnnealingStage(0.0125, 0.026, 2)  # Compares poses.
    follow: tuple[AnnealingStage, ...] = (  # The others follow a value that is moved.
        AnnealingStage(0.025, 0.026, 2),
        AnnealingStage(0.0125, 0.026, 2),
    )
    fine: AnnealingStage = AnnealingStage(0.025, 0.0125)  # Measures errors, large ones too.
    significance: float = 1.96  # Standard deviations of the costs' difference that matter.
    modes: int = 8  # The greatest number.
    moved: tuple[float, float] = (math.radians(3.0), 0.01)  # Wider intervals are searched [rad, m].
    longest_steps: tuple[float, float] = (0.5, 0.1)  # Of this search [rad, m],
    growth: float = 1.6  # each step longer by this factor.
    one_sided: float = 0.975  # Probability that a value lies below its interval's upper end.
    camera_motions: int = 6  # Degrees of freedom of a camera's error.

    @staticmethod
    def widest(is_angle: np.ndarray) -> np.ndarray:
        """(m,) how wide intervals of determined values are at most: 10 degrees or 2 cm a side."""
        return 2.0 * np.where(is_angle, math.radians(10.0), 0.02)


@dataclass(frozen=True)
class BoundLimits:
    """How much a branch and bound may look at.

    Args:
        states: how many partial poses are kept after each node.
        pairs: how many pairs of a partial pose and a pose of the next node are looked at.
        poses: after this many poses of nodes are drawn it stops.
        memory: it stops before drawn poses and what they reach take more than this, and keeps fewer
            partial poses where all would take more than a quarter of it [byte]. What it needs for a
            moment comes on top, about as much again.
        time_limit: it stops after this time [s]; None: no limit.

    Raises:
        SettingsError: if a value is out of its range.
    """

    states: int = 20_000
    pairs: int = 1_000_000
    poses: int = 1_000_000
    memory: int = 400_000_000
    time_limit: float | None = None

    def __post_init__(self) -> None:
        for name in ("states", "pairs", "poses", "memory"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be 1 or more, not {getattr(self, name)}")
        if self.time_limit is not None and not 0.0 <= self.time_limit < math.inf:
            raise SettingsError(f"time_limit must be 0 s or more, not {self.time_limit}")

    @property
    def deadline(self) -> float:
        """The value of time.perf_counter() at which a search that begins now stops [s]."""
        return math.inf if self.time_limit is None else time.perf_counter() + self.time_limit
