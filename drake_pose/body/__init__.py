"""What is looked at: links, joints, limits and surfaces of an articulated object."""

from drake_pose.body.files.packages import bundled_model, package_map
from drake_pose.body.landmarks import (
    Landmark,
    NodeLandmarks,
    landmark_positions,
    landmarks_of_nodes,
    load_landmarks,
)
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.report import (
    JointReport,
    ModelReport,
    NodeReport,
    describe_model,
    model_warnings,
)
from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.surfaces.skin_file import SkinBand
from drake_pose.body.tree.node_skin import ModelSkin
from drake_pose.body.tree.pose_tree import PoseTree, PoseTreeNode
from drake_pose.body.tree.root import RootRotation
from drake_pose.body.tree.skin_motion import NodeSkin
from drake_pose.body.tree.tree_builder import build_pose_tree

__all__ = [
    "ArticulatedModel",
    "JointReport",
    "Landmark",
    "ModelReport",
    "ModelSkin",
    "NodeLandmarks",
    "NodeReport",
    "NodeSkin",
    "ParsedModel",
    "PoseTree",
    "PoseTreeNode",
    "RootRotation",
    "SkinBand",
    "TriangleMesh",
    "build_pose_tree",
    "bundled_model",
    "describe_model",
    "landmark_positions",
    "landmarks_of_nodes",
    "load_landmarks",
    "load_model",
    "model_warnings",
    "package_map",
]
