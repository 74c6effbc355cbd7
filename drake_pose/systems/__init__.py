"""The estimators as Drake systems, and ready diagrams of them."""

from drake_pose.systems.bodies.skin import MeshcatSkin, SkinPoser, add_meshcat_skin, add_skin
from drake_pose.systems.date.capture import PaperCapture, build_paper_capture
from drake_pose.systems.date.face_direction_finder import FaceDirectionFinder
from drake_pose.systems.date.feature_finder import FeatureFinder
from drake_pose.systems.date.horizontal_image import HorizontalImage
from drake_pose.systems.date.pose_estimator import PaperPoseEstimator
from drake_pose.systems.date.pose_recogniser import PoseRecogniser
from drake_pose.systems.estimators.axis_sensor import AxisSensor, BodyBelief, StateMatcher
from drake_pose.systems.estimators.camera_registration import REGISTRATION, CameraRegistration
from drake_pose.systems.estimators.diagrams import (
    MatchingDiagram,
    build_recorded_matching,
    build_simulated_matching,
)
from drake_pose.systems.estimators.hand_tracking import (
    HandTracking,
    add_hand_tracking,
    build_hand_tracking,
)
from drake_pose.systems.estimators.mask_player import MaskPlayer
from drake_pose.systems.estimators.registration_diagram import (
    RegistrationDiagram,
    build_simulated_registration,
)
from drake_pose.systems.estimators.robot_state import RobotStateMessage
from drake_pose.systems.estimators.silhouette_matcher import STATISTICS, SilhouetteMatcher
from drake_pose.systems.estimators.silhouette_tracker import TRACK, SilhouetteTracker
from drake_pose.systems.estimators.truncated_ekf import TruncatedEkf
from drake_pose.systems.person.live_capture import (
    LiveSensors,
    LocalSensors,
    SensorPorts,
    build_live_capture,
)
from drake_pose.systems.person.person_tracker import PersonTracker, build_person_capture
from drake_pose.systems.person.silhouette_capture import SilhouetteCapture, build_silhouette_capture
from drake_pose.systems.person.silhouette_sensor import SilhouetteSensor
from drake_pose.systems.pictures.picture_capture import CameraCount, PictureCapture
from drake_pose.systems.pictures.silhouette_camera import SilhouetteCamera
from drake_pose.systems.walk.walk import Walker, WalkKeys, WalkView, build_walk

__all__ = [
    "REGISTRATION",
    "STATISTICS",
    "TRACK",
    "AxisSensor",
    "BodyBelief",
    "CameraCount",
    "CameraRegistration",
    "FaceDirectionFinder",
    "FeatureFinder",
    "HandTracking",
    "HorizontalImage",
    "LiveSensors",
    "LocalSensors",
    "MaskPlayer",
    "MatchingDiagram",
    "MeshcatSkin",
    "PaperCapture",
    "PaperPoseEstimator",
    "PersonTracker",
    "PictureCapture",
    "PoseRecogniser",
    "RegistrationDiagram",
    "RobotStateMessage",
    "SensorPorts",
    "SilhouetteCamera",
    "SilhouetteCapture",
    "SilhouetteMatcher",
    "SilhouetteSensor",
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
    "build_simulated_registration",
    "build_walk",
]
