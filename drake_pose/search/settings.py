"""Settings of the searches on a grid: Kameda's and the beam search."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from drake_pose.errors import SettingsError


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
        outside_weight: what a pixel outside the silhouette costs where candidates are put in order:
            by e - outside_weight * (area outside). 0 is the paper's order, by e alone.
        candidate_limit: K, how many of a node's candidates are kept.
        run_limit: of runs of step 3; the answer is then the best pose so far.

    Raises:
        SettingsError: if a value is out of its range.
    """

    outside_limit: float | None = None
    outside_weight: float = 0.0
    candidate_limit: int = 5
    run_limit: int = 10_000

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(0, "outside_limit", "outside_weight")
        if math.isinf(self.outside_weight):
            raise SettingsError("outside_weight must be finite")
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
