"""Kameda's matching: silhouettes in, poses out, with no Drake framework in it."""

from drake_pose.matching.paper_search import PaperSearch
from drake_pose.matching.pose_search import PoseSearch
from drake_pose.matching.result import Candidates, MatchResult, View
from drake_pose.matching.settings import PaperSearchSettings

__all__ = ["Candidates", "MatchResult", "PaperSearch", "PaperSearchSettings", "PoseSearch", "View"]
