"""Silhouettes in, poses out: Kameda's search and the wide search, no Drake framework in them."""

from drake_pose.matching.examination import ExaminationSettings
from drake_pose.matching.families import JointEstimate, PoseFamily, PoseSet
from drake_pose.matching.paper_search import PaperSearch
from drake_pose.matching.pose_search import PoseSearch
from drake_pose.matching.result import Candidates, MatchResult, View
from drake_pose.matching.settings import PaperSearchSettings
from drake_pose.matching.whole_search import WholeSearch
from drake_pose.matching.whole_settings import WholeSearchSettings
from drake_pose.matching.wide_search import WideSearch
from drake_pose.matching.wide_settings import WideSearchSettings

__all__ = [
    "Candidates",
    "ExaminationSettings",
    "JointEstimate",
    "MatchResult",
    "PaperSearch",
    "PaperSearchSettings",
    "PoseFamily",
    "PoseSearch",
    "PoseSet",
    "View",
    "WholeSearch",
    "WholeSearchSettings",
    "WideSearch",
    "WideSearchSettings",
]
