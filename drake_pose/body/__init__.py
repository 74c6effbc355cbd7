"""What is looked at: links, joints, limits and surfaces of an articulated object."""

from drake_pose.body.mesh import TriangleMesh
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.packages import bundled_model, package_map
from drake_pose.body.pose_tree import PoseTree, PoseTreeNode
from drake_pose.body.report import JointReport, ModelReport, NodeReport, describe_model
from drake_pose.body.root import RootRotation

__all__ = [
    "ArticulatedModel",
    "JointReport",
    "ModelReport",
    "NodeReport",
    "PoseTree",
    "PoseTreeNode",
    "RootRotation",
    "TriangleMesh",
    "bundled_model",
    "describe_model",
    "load_model",
    "package_map",
]
