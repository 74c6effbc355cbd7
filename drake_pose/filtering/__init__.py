"""Belief within limits: a Kalman filter whose estimates respect linear inequalities."""

from drake_pose.filtering.axis_observation import AxisObservation
from drake_pose.filtering.contour_observation import (
    ContourMeasurement,
    ContourObservation,
    ContourSettings,
)
from drake_pose.filtering.contour_tracking import ContourTracker, Track, TrackingSettings
from drake_pose.filtering.couplings import (
    couplings_file,
    load_couplings,
    model_inequalities,
)
from drake_pose.filtering.hypotheses import Hypothesis, Rejection
from drake_pose.filtering.inequalities import (
    Inequalities,
    from_bounds,
    from_model,
    from_plant,
    from_program,
    inner_point,
    make_inequalities,
    stack,
    two_sided,
)
from drake_pose.filtering.match_and_track import TRACKED, Followed, MatchAndTrack
from drake_pose.filtering.normal_moments import interval_moments
from drake_pose.filtering.segment_axes import Axis, AxisObserver, AxisSettings
from drake_pose.filtering.state import Belief, StateLayout, make_belief
from drake_pose.filtering.truncated_filter import FilterSettings, FilterState, TruncatedFilter
from drake_pose.filtering.truncation import (
    JointRows,
    Truncated,
    clip,
    join_rows,
    truncate_joint,
    truncate_sequential,
)
from drake_pose.filtering.update import ObservationModel, Updated, update
from drake_pose.filtering.views import Stare, View

__all__ = [
    "TRACKED",
    "Axis",
    "AxisObservation",
    "AxisObserver",
    "AxisSettings",
    "Belief",
    "ContourMeasurement",
    "ContourObservation",
    "ContourSettings",
    "ContourTracker",
    "FilterSettings",
    "FilterState",
    "Followed",
    "Hypothesis",
    "Inequalities",
    "JointRows",
    "MatchAndTrack",
    "ObservationModel",
    "Rejection",
    "Stare",
    "StateLayout",
    "Track",
    "TrackingSettings",
    "Truncated",
    "TruncatedFilter",
    "Updated",
    "View",
    "clip",
    "couplings_file",
    "from_bounds",
    "from_model",
    "from_plant",
    "from_program",
    "inner_point",
    "interval_moments",
    "join_rows",
    "load_couplings",
    "make_belief",
    "make_inequalities",
    "model_inequalities",
    "stack",
    "truncate_joint",
    "truncate_sequential",
    "two_sided",
    "update",
]
