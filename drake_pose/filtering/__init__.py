"""Belief within limits: a Kalman filter whose estimates respect linear inequalities."""

from drake_pose.filtering.kalman.hypotheses import Hypothesis, Rejection
from drake_pose.filtering.kalman.repeated_views import RepeatedView, View
from drake_pose.filtering.kalman.truncated_filter import (
    FilterSettings,
    FilterState,
    TruncatedFilter,
)
from drake_pose.filtering.kalman.update import ObservationModel, Updated, update
from drake_pose.filtering.measurements.axes import AxisObservation
from drake_pose.filtering.measurements.contour import (
    ContourMeasurement,
    ContourObservation,
    ContourSettings,
)
from drake_pose.filtering.measurements.segment_axes import Axis, AxisObserver, AxisSettings
from drake_pose.filtering.state import Belief, StateLayout, make_belief
from drake_pose.filtering.tracking.contour_tracker import ContourTracker, Track, TrackingSettings
from drake_pose.filtering.tracking.match_and_track import TRACKED, Followed, MatchAndTrack
from drake_pose.filtering.truncation.couplings import (
    couplings_file,
    load_couplings,
    model_inequalities,
)
from drake_pose.filtering.truncation.inequalities import (
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
from drake_pose.filtering.truncation.normal_moments import interval_moments
from drake_pose.filtering.truncation.truncated_normal import (
    JointRows,
    Truncated,
    clip,
    join_rows,
    truncate_joint,
    truncate_sequential,
)

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
    "RepeatedView",
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
