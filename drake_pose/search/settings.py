"""Settings of the searches."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from drake_pose.errors import SettingsError


@dataclass(frozen=True)
class PaperSearchSettings:
    """Parameters of Kameda's search (sections 5.1, 5.2 and 6.1 of the paper).

    Args:
        interval: sampling interval of every angle [rad]; the paper's is 20 degrees.
        length_interval: sampling interval of every prismatic position [m].
        intervals: sampling interval of single positions by name [rad or m], in place of the two
            above.
        outside_limit: the threshold r of (4) [pixel]: the area of a segment that may lie outside
            the silhouette, in each view. None: begin with 12.6 % of the mean projected area of a
            segment (what the paper's 200 pixels are for its body) and double until a pose is found.
        outside_weight: what a pixel outside the silhouette costs where candidates are put in order:
            by e - outside_weight * (area outside). 0 is the paper's order, by e alone.
        candidate_limit: K, how many of a node's candidates are kept; the paper's is 5.
        run_limit: the search stops after this many runs of step 3 and answers with the best pose
            that it has; the paper knows no such limit.
        leaf_combination_limit: up to this many combinations of the leaves' candidates are tried one
            by one (section 5.2.1); beyond, each leaf's candidates are tried in turn until no
            change of one leaf is an improvement.

    Raises:
        SettingsError: if a value is out of its range.
    """

    interval: float = math.radians(20.0)
    length_interval: float = 0.05
    intervals: Mapping[str, float] = field(default_factory=dict)
    outside_limit: float | None = None
    outside_weight: float = 0.0
    candidate_limit: int = 5
    run_limit: int = 10_000
    leaf_combination_limit: int = 100_000

    def __post_init__(self) -> None:
        named = {"interval": self.interval, "length_interval": self.length_interval}
        named |= {f"interval of {name}": value for name, value in self.intervals.items()}
        for name, value in named.items():
            if not (math.isfinite(value) and value > 0):
                raise SettingsError(f"{name} must be positive and finite, not {value}")
        if self.outside_limit is not None and not self.outside_limit >= 0:
            raise SettingsError(f"outside_limit (r) must be 0 or more, not {self.outside_limit}")
        if not (math.isfinite(self.outside_weight) and self.outside_weight >= 0.0):
            raise SettingsError(f"outside_weight must be 0 or more, not {self.outside_weight}")
        for name in ("candidate_limit", "run_limit", "leaf_combination_limit"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be 1 or more, not {getattr(self, name)}")
