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
    """One part of a refinement.

    Args:
        iterations: at most so many steps.
        stride: every so many rows and columns are looked at.
        scale: distances beyond it lose weight [pixel].
        damping: added to the diagonal of the normal equations [pixel^3/rad^2]: what the silhouettes
            hardly show hardly moves.
        longest_step: steps are shortened so that no parameter changes by more [rad or m].
        slack: distances up to this along a line hardly count, those beyond it by what they are
            more; 0: all count [pixel].
    """

    iterations: int
    stride: int
    scale: float
    damping: float
    longest_step: float = 0.25
    slack: float = 0.0


class RefinementPasses(NamedTuple):
    """The passes of a refinement by pixels: from far, from near, and to the optimum itself.

    coarse: several nodes may be off by their own width. fine: to the local optimum. last: where
    directions count that the silhouettes hardly show.

    A pixel is wrong where the contour is more than half a pixel from the border on its line. What
    is less says nothing: the border lies anywhere between two pixel centres, alike likely. The mean
    of least squares leaves the share 0.02 to 0.03 of the border's pixels wrong; drawn into the
    bounds that all lines set together, a pose leaves 0.005 to 0.015 and is half as far from the
    true one, as an estimate from bounds is where noise is uniform. A slack of 0.4 instead of 0.5
    keeps it from resting on bounds.
    """

    coarse: tuple[Pass, ...] = (Pass(8, 4, 50.0, 300.0), Pass(8, 4, 10.0, 100.0))
    fine: tuple[Pass, ...] = (Pass(5, 2, 6.0, 30.0), Pass(6, 2, 3.0, 10.0), Pass(8, 1, 2.0, 5.0))
    last: tuple[Pass, ...] = (Pass(5, 2, 2.0, 5.0), Pass(15, 1, 1.0, 0.5, slack=0.4))


PASSES = RefinementPasses()


class NeighbourhoodSettings(NamedTuple):
    """Numbers of the search about a pose; J above the best one's: shares of the border's length.

    far, reflected, nearer, fine, end: passes from parts placed anew or mirrored to the optimum;
    whole: passes with all of the body. pursued: so many placements, the best after the first pass,
    are refined on; hopeful, near, kept: those with no more J after the first pass, after the
    second, and in the end. mended, mendings: mirrored poses with no more J are mended, by so many
    tries at most. equal: what is nearly as good is refined with all of the body before it is
    judged. better: what is better by less is the same, not quite refined. spare: other poses with
    no more J than this above the limit are refined with all parameters. same_error: errors that
    differ by a smaller share are the same. least_error: parts with a smaller share of the area
    wrong near them are left alone until all are tried. rounds: so often a part is tried at most
    before all are, and as often again then.
    """

    far: tuple[Pass, ...] = (Pass(4, 4, 30.0, 100.0),)
    reflected: tuple[Pass, ...] = (Pass(8, 4, 30.0, 100.0), Pass(6, 3, 6.0, 30.0))
    nearer: tuple[Pass, ...] = (Pass(5, 3, 6.0, 30.0),)
    fine: tuple[Pass, ...] = (Pass(6, 2, 2.0, 5.0),)
    end: tuple[Pass, ...] = (Pass(6, 1, 1.0, 0.5, slack=0.4),)
    whole: tuple[Pass, ...] = (Pass(3, 3, 6.0, 50.0), Pass(3, 2, 2.0, 5.0))
    pursued: int = 2
    hopeful: float = 0.15
    near: float = 0.03
    kept: float = 0.03
    mended: float = 0.35
    mendings: int = 6
    equal: float = 0.01
    better: float = 0.003
    spare: float = 0.015
    same_error: float = 0.1
    least_error: float = 0.001
    rounds: int = 2


class RootPlacementSettings(NamedTuple):
    """Numbers of the search for where the root is.

    across: so many positions are tried across the silhouette. ratio: of two scales or depths tried
    one after the other. cut_off: where the silhouette touches the picture's edge the body may be
    larger by this factor than it looks, and the root that share of the silhouette's extent, less
    one, beyond the edge. outside_share, outside_weight: as in the beam search's tolerant stages;
    the root is off by half a step. hypotheses: so many are kept, shared among the scales or depths;
    quota: the share of them that may have the root at one position. starts: so many poses are
    refined from far; finalists: at so many of the root positions reached the poses are searched
    again, ``again`` of each, and so many are refined to the end. pixels: silhouettes are looked at
    with about so many. root_factor: so many times the width are kept of the root alone; root_spare:
    so many times a position's quota of the root's rotations are grown at it; spare: so many times
    the width are grown, before the quota. alike: see ``BeamSearch.best_poses``. enough: the share
    of the silhouettes' area that may be wrong in a pose that is not searched on.
    """

    across: int = 12
    ratio: float = 1.12
    cut_off: float = 1.5
    outside_share: float = 0.6
    outside_weight: int = 2
    hypotheses: int = 500
    quota: float = 0.05
    starts: int = 24
    finalists: int = 3
    again: int = 4
    pixels: int = 1500
    root_factor: int = 2
    root_spare: int = 2
    spare: int = 8
    alike: float = 0.5
    enough: float = 0.004


@dataclass(frozen=True)
class ExactSearchSettings:
    """Numbers of the search where masks are exact; J is compared with the borders' length.

    Args:
        stages: the beam searches that begin, each on the grid of 20 (0) or 15 degrees (1). The next
            one searches only where none before has led to a good pose: what one grid and order of
            nodes misses, another often has.
        starts: so many poses of each that do not look alike are refined.
        alike: see ``BeamSearch.best_poses``.
        hopeless: masks are not exact where the first poses refined leave more wrong than this; a
            robust pose that leaves more is not improved by pixels.
        enough: a pose is not searched on with less wrong: a little more than the pixels' own noise.
        exact: a pose with less wrong is the answer, and no other grid is searched.
        plausible: what the robust search finds is improved by pixels where less is left wrong.
        agreeing: two grids agree where the worse one's J is no more than this many times the better
            one's: the body fits no better.
        better: how often another pose found may take the best one's place.
        tolerance: poses are as good as the best whose J is larger by no more.
        same: poses none of whose values differ by more are one [rad or m].
        confidence: how often the truth shall lie in a determined value's interval.
        noise_factor: how much larger the standard deviation is than of independent distances.
        misfit: where more is wrong nothing is determined: the pose may be another one altogether.
    """

    stages: tuple[tuple[int, Stage], ...] = (
        (0, Stage(60, 0.3, 5)),
        (1, Stage(60, 1.0, 2)),
        (1, Stage(60, 1.0, 2, limb_by_limb=True)),
        (1, Stage(60, 0.3, 5, limb_by_limb=True)),
    )
    starts: int = 4
    alike: float = 0.5
    hopeless: float = 1.5
    enough: float = 0.03
    exact: float = 0.18
    plausible: float = 0.5
    agreeing: float = 1.1
    better: int = 3
    tolerance: float = 0.03
    same: float = 0.1
    confidence: float = 0.95
    noise_factor: float = 1.4
    misfit: float = 0.025


_COARSE = (AnnealingStage(0.1, 0.04, 3), AnnealingStage(0.05, 0.04, 3))
_MEDIUM = (AnnealingStage(0.05, 0.026, 4), AnnealingStage(0.025, 0.026, 4))


@dataclass(frozen=True)
class MultiStartSettings:
    """Numbers of the multi-start search where masks are damaged; sizes: root of the mean area.

    Args:
        interval: of the angles of coarse poses [rad].
        coarse, medium, final: stages of the fit.
        starts, finalists: so many coarse poses are fitted, and so many are fitted to the end.
        passes: how many go on after which stages, in one view and in several. In several what is
            wrong costs more from the first stage on; in one view it may be the last that tells:
            there none ends after a first stage.
        following: the same of what is sought about a pose, in several views.
        apart: coarse poses differ where some part is seen so far away, as a share of the size.
        rounds, sought_about: so often other explanations are sought, about so many of the best.
        tried, flipped: of each so many are fitted, and so many more made by flips of its joints.
        better: of several views about no more poses are others sought where one leads to nothing
            that costs less by this factor.
        limbs: a disc of this radius, as a share of the size, is as thick as a limb that one view
            shows in part, or one of several in full.
        beam_starts, beam_views, beam_pixels: where such a disc fits into what is wrong, so many
            starts of the beam search are fitted, too, by so many masks, of about so many pixels.
    """

    interval: float = math.radians(15.0)
    coarse: tuple[AnnealingStage, ...] = _COARSE
    medium: tuple[AnnealingStage, ...] = _MEDIUM
    final: tuple[AnnealingStage, ...] = (AnnealingStage(0.0125, 0.0125, 6),)
    starts: int = 40
    finalists: int = 4
    passes: tuple[tuple[tuple[tuple[AnnealingStage, ...], int], ...], ...] = (
        ((_COARSE, 12), (_MEDIUM, 12)),
        ((_COARSE[:1], 20), (_COARSE[1:], 12), (_MEDIUM[:1], 6), (_MEDIUM[1:], 6)),
    )
    following: tuple[tuple[tuple[AnnealingStage, ...], int], ...] = (
        (_MEDIUM[:1], 4),
        (_MEDIUM[1:], 4),
    )
    apart: float = 0.13
    rounds: int = 2
    sought_about: int = 3
    tried: int = 6
    flipped: int = 3
    better: float = 0.98
    limbs: tuple[float, float] = (0.03, 0.04)
    beam_starts: int = 10
    beam_views: int = 2
    beam_pixels: int = 3000


class RobustSettings(NamedTuple):
    """Numbers of what silhouettes leave open where masks are damaged.

    Args:
        look: at which poses are compared; follow: how the others follow a value that is moved;
            fine: what errors are told by: distances that count less in the fit tell of them, too.
        significance: poses are as good as the best whose cost is larger by no more than so many
            standard deviations of the difference.
        families: at most so many are told apart.
        moved: a value that the covariance lets go so far, angle [rad] and length [m], is moved step
            by step: first as far as that.
        longest_steps: of such a value, angle [rad] and length [m].
        growth: by this factor each step is longer.
        one_sided: as often shall a value lie below the upper end of its interval, and above the
            lower one.
        camera_motions: how large errors are is told by so many motions of each camera.
    """

    look: AnnealingStage = AnnealingStage(0.0125, 0.026, 2)
    follow: tuple[AnnealingStage, ...] = (
        AnnealingStage(0.025, 0.026, 2),
        AnnealingStage(0.0125, 0.026, 2),
    )
    fine: AnnealingStage = AnnealingStage(0.025, 0.0125)
    significance: float = 1.96
    families: int = 8
    moved: tuple[float, float] = (math.radians(3.0), 0.01)
    longest_steps: tuple[float, float] = (0.5, 0.1)
    growth: float = 1.6
    one_sided: float = 0.975
    camera_motions: int = 6

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
