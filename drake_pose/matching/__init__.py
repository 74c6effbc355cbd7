"""Silhouettes in, poses out: Kameda's search and wider ones, no Drake framework in them."""

from drake_pose.matching.continuous.equivalent_poses import RobustFamilySettings
from drake_pose.matching.continuous.multi_start import WholeSearch
from drake_pose.matching.continuous.multi_start_settings import WholeSearchSettings
from drake_pose.matching.continuous.root_placement_search import PlacedMatch, RootPlacementSearch
from drake_pose.matching.continuous.search import (
    ContinuousSearch,
    ContinuousSearchSettings,
    RefinedMatch,
    RefinementSettings,
)
from drake_pose.matching.grid.beam.search import WideSearch
from drake_pose.matching.grid.families.examination import ExaminationSettings
from drake_pose.matching.grid.families.search import FamilySettings
from drake_pose.matching.grid.settings import Stage, WideSearchSettings
from drake_pose.matching.kameda.search import PaperSearch
from drake_pose.matching.pose_families import JointEstimate, PoseFamily, PoseSet, PositionEstimates
from drake_pose.matching.pose_search import PoseSearch
from drake_pose.matching.result import Candidates, MatchResult, View
from drake_pose.matching.settings import PaperSearchSettings
from drake_pose.matching.starts.coarse_search import RoughSettings
from drake_pose.matching.starts.root_placement import PlacementSettings

__all__ = [
    "Candidates",
    "ContinuousSearch",
    "ContinuousSearchSettings",
    "ExaminationSettings",
    "FamilySettings",
    "JointEstimate",
    "MatchResult",
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
    "RoughSettings",
    "Stage",
    "View",
    "WholeSearch",
    "WholeSearchSettings",
    "WideSearch",
    "WideSearchSettings",
]
