"""The estimators as Drake systems, and ready diagrams of them."""

from drake_pose.systems.axis_sensor import AxisSensor, BodyBelief, StateMatcher
from drake_pose.systems.diagrams import (
    MatchingDiagram,
    build_recorded_matching,
    build_simulated_matching,
)
from drake_pose.systems.face_direction_finder import FaceDirectionFinder
from drake_pose.systems.feature_finder import FeatureFinder
from drake_pose.systems.hand_tracking import (
    HandTracking,
    add_hand_tracking,
    build_hand_tracking,
)
from drake_pose.systems.horizontal_image import HorizontalImage
from drake_pose.systems.live_capture import EyePorts, LiveEyes, LocalEyes, build_live_capture
from drake_pose.systems.mask_player import MaskPlayer
from drake_pose.systems.paper_capture import PaperCapture, build_paper_capture
from drake_pose.systems.paper_pose_estimator import PaperPoseEstimator
from drake_pose.systems.person_tracker import PersonTracker, build_person_capture
from drake_pose.systems.picture_capture import PictureCapture
from drake_pose.systems.pose_recogniser import PoseRecogniser
from drake_pose.systems.silhouette_capture import SilhouetteCapture, build_silhouette_capture
from drake_pose.systems.silhouette_eye import SilhouetteEye
from drake_pose.systems.silhouette_matcher import STATISTICS, SilhouetteMatcher
from drake_pose.systems.silhouette_tracker import TRACK, SilhouetteTracker
from drake_pose.systems.skin import MeshcatSkin, SkinPoser, add_meshcat_skin, add_skin
from drake_pose.systems.truncated_ekf import TruncatedEkf
from drake_pose.systems.walk import Walker, WalkKeys, WalkView, build_walk

__all__ = [
    "STATISTICS",
    "TRACK",
    "AxisSensor",
    "BodyBelief",
    "EyePorts",
    "FaceDirectionFinder",
    "FeatureFinder",
    "HandTracking",
    "HorizontalImage",
    "LiveEyes",
    "LocalEyes",
    "MaskPlayer",
    "MatchingDiagram",
    "MeshcatSkin",
    "PaperCapture",
    "PaperPoseEstimator",
    "PersonTracker",
    "PictureCapture",
    "PoseRecogniser",
    "SilhouetteCapture",
    "SilhouetteEye",
    "SilhouetteMatcher",
    "SilhouetteTracker",
    "SkinPoser",
    "StateMatcher",
    "TruncatedEkf",
    "WalkKeys",
    "WalkView",
    "Walker",
    "add_hand_tracking",
    "add_meshcat_skin",
    "add_skin",
    "build_hand_tracking",
    "build_live_capture",
    "build_paper_capture",
    "build_person_capture",
    "build_recorded_matching",
    "build_silhouette_capture",
    "build_simulated_matching",
    "build_walk",
]
