"""Settings of the beam search."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from drake_pose.errors import SettingsError


@dataclass(frozen=True)
class Stage:
    """One pass of the beam search over all nodes.

    Args:
        hypotheses: how many are kept after each node.
        outside_share: the share of a node's mean projected area, both summed over the views, that
            may lie outside the silhouette; infinite: any.
        outside_weight: what a pixel outside counts in the ranking; a silhouette pixel newly
            covered counts one. J itself counts both alike, but what is outside stays outside,
            while what is not covered yet may be covered by a later node.
        limb_by_limb: place one limb after another, else the ends of all limbs last. What one order
            cannot find with few hypotheses, the other often can.
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


EXACT_STAGES = (
    Stage(40),
    Stage(160),
    Stage(640, limb_by_limb=True),
    Stage(2000),
    Stage(5000, limb_by_limb=True),
)
"""For a body that is the object itself: nothing lies outside. They end at once where it is not."""

TOLERANT_STAGES = (Stage(80, 0.3, 5), Stage(300, 1.0, 2))
"""For a body that fits badly."""


@dataclass(frozen=True)
class BeamSearchSettings:
    """Parameters of the beam search.

    Args:
        interval: sampling interval of every angle [rad].
        length_interval: sampling interval of every prismatic position [m].
        intervals: sampling intervals of single positions by name [rad or m], in place of the two
            above.
        stages: the passes, one after another until J = 0.
        node_order: the names of all nodes in the order in which they are placed, parents before
            children; empty: derived from the tree.
        band: how far around the silhouette the union of what lies outside is told from its sum
            [pixel].
        coarse_pixels: stages that let something lie outside see the silhouettes no finer than with
            about this many pixels; the best pose is then judged in full.
        research_hypotheses: how many hypotheses are kept when single limbs and pairs of limbs of
            the winner are searched again; 0: they are not.
        time_limit: the search returns its best pose so far after this time [s]; None: no limit.
        hypothesis_limit: the same after this many hypotheses; None: no limit.

    Raises:
        SettingsError: if a value is out of its range.
    """

    interval: float = math.radians(20.0)
    length_interval: float = 0.05
    intervals: Mapping[str, float] = field(default_factory=dict)
    stages: tuple[Stage, ...] = EXACT_STAGES + TOLERANT_STAGES
    node_order: tuple[str, ...] = ()
    band: int = 24
    coarse_pixels: int = 6000
    research_hypotheses: int = 30
    time_limit: float | None = None
    hypothesis_limit: int | None = None

    def __post_init__(self) -> None:
        named = {"interval": self.interval, "length_interval": self.length_interval}
        named |= {f"interval of {name}": value for name, value in self.intervals.items()}
        for name, value in named.items():
            if not (math.isfinite(value) and value > 0):
                raise SettingsError(f"{name} must be positive and finite, not {value}")
        if not self.stages:
            raise SettingsError("stages must hold at least one stage")
        if self.band < 1:
            raise SettingsError(f"band must be 1 pixel or more, not {self.band}")
        if self.coarse_pixels < 1:
            raise SettingsError(f"coarse_pixels must be 1 or more, not {self.coarse_pixels}")
        if self.research_hypotheses < 0:
            raise SettingsError(
                f"research_hypotheses must be 0 or more, not {self.research_hypotheses}"
            )
        if self.time_limit is not None and not self.time_limit >= 0.0:
            raise SettingsError(f"time_limit must be 0 s or more, not {self.time_limit}")
        if self.hypothesis_limit is not None and self.hypothesis_limit < 1:
            raise SettingsError(f"hypothesis_limit must be 1 or more, not {self.hypothesis_limit}")
