"""Articulated models and pose trees: links, joints, limits, surfaces and kinematics.

The compiled modules ``joint_kernel`` and ``tree_kinematics`` are not imported here: importing numba
is slow, and reading a model does not need it.
"""

from drake_pose.body.landmarks import (
    Landmark,
    landmark_positions,
    landmarks_file,
    landmarks_of_nodes,
    load_landmarks,
)
from drake_pose.body.link_graph import PlantKinematics, chain_transforms, inverse_transforms
from drake_pose.body.meshes import TriangleMesh, join_meshes, labelled_meshes
from drake_pose.body.model import (
    BASE_JOINTS,
    TARGET,
    TARGET_POSITIONS,
    ArticulatedModel,
    load_model,
    require_registered,
    reshaped,
)
from drake_pose.body.model_files import bundled_model, package_folder, xml_element
from drake_pose.body.node_skin import ModelSkin
from drake_pose.body.parsed_model import ParsedModel, link_names, nearest_turn
from drake_pose.body.parsing import ModelSource, captured_warnings
from drake_pose.body.pose_tree import PoseTree, require_tree
from drake_pose.body.report import ModelReport, describe_model, model_warnings
from drake_pose.body.root import RootRotation
from drake_pose.body.tree_builder import build_pose_tree
