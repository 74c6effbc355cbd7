"""What is looked at: links, joints, limits and surfaces of an articulated object."""

from drake_pose.body.landmarks import (
    Landmark,
    NodeLandmarks,
    landmark_positions,
    landmarks_of_nodes,
    load_landmarks,
)
from drake_pose.body.mesh import TriangleMesh
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.packages import bundled_model, package_map
from drake_pose.body.pose_tree import PoseTree, PoseTreeNode
from drake_pose.body.report import (
    JointReport,
    ModelReport,
    NodeReport,
    describe_model,
    model_warnings,
)
from drake_pose.body.root import RootRotation
from drake_pose.body.skin import SkinBand
from drake_pose.body.skin_bands import ModelSkin
from drake_pose.body.skin_motion import NodeSkin

__all__ = [
    "ArticulatedModel",
    "JointReport",
    "Landmark",
    "ModelReport",
    "ModelSkin",
    "NodeLandmarks",
    "NodeReport",
    "NodeSkin",
    "PoseTree",
    "PoseTreeNode",
    "RootRotation",
    "SkinBand",
    "TriangleMesh",
    "bundled_model",
    "describe_model",
    "landmark_positions",
    "landmarks_of_nodes",
    "load_landmarks",
    "load_model",
    "model_warnings",
    "package_map",
]
