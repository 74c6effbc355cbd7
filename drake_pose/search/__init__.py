"""Search a body's pose in silhouettes without an initial guess.

The objective J is the area of the exclusive or of projected body and silhouette, summed over the
views [pixel]; E_total is J divided by the silhouettes' area.

``PaperSearch`` (Kameda's method) and ``BeamSearch`` search grids of joint values. The multi-start
search (``MultiStartSearch``) returns continuous values, and ``RootPlacementSearch`` also the root's
position or the camera's scale.
"""

from drake_pose.search.beam_search import BeamSearch, BeamSearchSettings
from drake_pose.search.estimates import (
    TRACKED,
    UNEXPLAINED,
    JointEstimate,
    PoseEstimate,
    PoseMode,
    PoseSet,
    View,
    joint_estimates,
    mimic_joints,
)
from drake_pose.search.kameda import PaperSearch, PaperSearchSettings
from drake_pose.search.multi_start import MultiStartSearch
from drake_pose.search.pose_modes import (
    ExaminationSettings,
    GridPoseSet,
    examine,
    renderer_tolerance,
    samples_at,
)
from drake_pose.search.root_placement import (
    RootPlacementSearch,
    most_connected_node,
    root_rotates_freely,
)
from drake_pose.search.root_places import scale_camera, slide_root
from drake_pose.search.sampled_body import PoseSearch, SampledTree, Scoring
from drake_pose.search.views_fit import RobustSettings, ViewsFit, covariance_pose_set
