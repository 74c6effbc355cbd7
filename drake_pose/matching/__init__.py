"""Silhouettes in, poses out: Kameda's search and wider ones, no Drake framework in them."""

from drake_pose.matching.examination import ExaminationSettings
from drake_pose.matching.families import JointEstimate, PoseFamily, PoseSet
from drake_pose.matching.paper_search import PaperSearch
from drake_pose.matching.pose_search import PoseSearch
from drake_pose.matching.refinement_search import (
    ContinuousSearch,
    ContinuousSearchSettings,
    RefinedMatch,
)
from drake_pose.matching.result import Candidates, MatchResult, View
from drake_pose.matching.root_placement import PlacementSettings
from drake_pose.matching.root_placement_search import PlacedMatch, RootPlacementSearch
from drake_pose.matching.settings import PaperSearchSettings
from drake_pose.matching.whole_search import WholeSearch
from drake_pose.matching.whole_settings import WholeSearchSettings
from drake_pose.matching.wide_search import WideSearch
from drake_pose.matching.wide_settings import WideSearchSettings

__all__ = [
    "Candidates",
    "ContinuousSearch",
    "ContinuousSearchSettings",
    "ExaminationSettings",
    "JointEstimate",
    "MatchResult",
    "PaperSearch",
    "PaperSearchSettings",
    "PlacedMatch",
    "PlacementSettings",
    "PoseFamily",
    "PoseSearch",
    "PoseSet",
    "RefinedMatch",
    "RootPlacementSearch",
    "View",
    "WholeSearch",
    "WholeSearchSettings",
    "WideSearch",
    "WideSearchSettings",
]
