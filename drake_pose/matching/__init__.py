"""Silhouettes in, poses out: Kameda's search and wider ones, no Drake framework in them."""

from drake_pose.matching.continuous.equivalent_poses import RobustFamilySettings
from drake_pose.matching.continuous.multi_start import MultiStartSearch
from drake_pose.matching.continuous.multi_start_settings import MultiStartSettings
from drake_pose.matching.continuous.root_placement_search import RootPlacementSearch
from drake_pose.matching.continuous.search import (
    ContinuousSearch,
    ContinuousSearchSettings,
    RefinedMatch,
    RefinementSettings,
)
from drake_pose.matching.grid.beam.search import BeamSearch
from drake_pose.matching.grid.families.examination import ExaminationSettings
from drake_pose.matching.grid.families.search import FamilySettings
from drake_pose.matching.grid.settings import BeamSearchSettings, Stage
from drake_pose.matching.kameda.search import PaperSearch
from drake_pose.matching.pose_families import JointEstimate, PoseFamily, PoseSet, PositionEstimates
from drake_pose.matching.pose_search import PoseSearch
from drake_pose.matching.result import Candidates, MatchResult, PlacedMatch, View
from drake_pose.matching.settings import PaperSearchSettings
from drake_pose.matching.starts.coarse_search import CoarseSettings
from drake_pose.matching.starts.root_placement import PlacementSettings

__all__ = [
    "BeamSearch",
    "BeamSearchSettings",
    "Candidates",
    "CoarseSettings",
    "ContinuousSearch",
    "ContinuousSearchSettings",
    "ExaminationSettings",
    "FamilySettings",
    "JointEstimate",
    "MatchResult",
    "MultiStartSearch",
    "MultiStartSettings",
    "PaperSearch",
    "PaperSearchSettings",
    "PlacedMatch",
    "PlacementSettings",
    "PoseFamily",
    "PoseSearch",
    "PoseSet",
    "PositionEstimates",
    "RefinedMatch",
    "RefinementSettings",
    "RobustFamilySettings",
    "RootPlacementSearch",
    "Stage",
    "View",
]
