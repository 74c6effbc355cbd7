"""Settings of the multi-start search."""

import math
from dataclasses import dataclass, field

from drake_pose.errors import SettingsError
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.search.continuous.equivalent_poses import RobustFamilySettings
from drake_pose.search.grid.families.examination import ExaminationSettings
from drake_pose.search.settings import BeamSearchSettings
from drake_pose.search.starts.coarse_search import CoarseSettings

COARSE = (AnnealingStage(0.1, 0.04, 3), AnnealingStage(0.05, 0.04, 3))
MEDIUM = (AnnealingStage(0.05, 0.026, 4), AnnealingStage(0.025, 0.026, 4))
FINAL = (AnnealingStage(0.0125, 0.0125, 6),)


@dataclass(frozen=True)
class MultiStartSettings:
    """Parameters of the multi-start search.

    Args:
        beam: of the search on the grid. Its time limit is that of the multi-start search.
        continuous: False: nothing but the search on the grid is run.
        coarse: of the search for coarse poses.
        starts: how many coarse poses are refined.
        apart: coarse poses differ where some part of the body is seen so far away, as a share of
            the root of the silhouettes' mean area.
        survivors: how many of them are refined further.
        finalists: how many are refined to the end.
        rounds: how often other explanations are sought about the best poses.
        sought_about: about how many of them.
        tried: how many other explanations of each are refined.
        flipped: how many more, made by flips of its joints, are refined.
        families: of the answer as a set; None: only the best pose is wanted.
        examination: of an answer on the grid.

    Raises:
        SettingsError: if a value is out of its range.
    """

    beam: BeamSearchSettings = field(default_factory=BeamSearchSettings)
    continuous: bool = True
    coarse: CoarseSettings = field(default_factory=CoarseSettings)
    starts: int = 40
    apart: float = 0.13
    survivors: int = 12
    finalists: int = 4
    rounds: int = 2
    sought_about: int = 3
    tried: int = 6
    flipped: int = 3
    families: RobustFamilySettings | None = field(default_factory=RobustFamilySettings)
    examination: ExaminationSettings | None = field(default_factory=ExaminationSettings)

    def __post_init__(self) -> None:
        for name in ("starts", "survivors", "finalists", "sought_about", "tried", "flipped"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be 1 or more, not {getattr(self, name)}")
        if self.rounds < 0:
            raise SettingsError(f"rounds must be 0 or more, not {self.rounds}")
        if not (math.isfinite(self.apart) and self.apart >= 0.0):
            raise SettingsError(f"apart must be 0 or more, not {self.apart}")
