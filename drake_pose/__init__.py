"""Pose estimation of articulated objects from silhouettes, as Drake systems.

The names that programs need are here; each is loaded when it is first used. Everything else is in
the rooms, in the order in which they build on each other: ``body``, ``camera``, ``silhouette``,
``fit``, ``search``, ``registration``, ``filtering``, ``person``, ``systems``, ``files``,
``jobs``, ``papers`` and ``commands``.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from drake_pose.version import VERSION

if TYPE_CHECKING:
    from drake_pose.body.model import ArticulatedModel, load_model
    from drake_pose.body.model_files import bundled_model
    from drake_pose.body.root import RootRotation
    from drake_pose.body.tree_builder import build_pose_tree
    from drake_pose.camera.camera_files import load_cameras, save_cameras
    from drake_pose.camera.drake import camera_from_drake, camera_to_drake
    from drake_pose.camera.models import ParallelCamera, PinholeCamera, look_at
    from drake_pose.errors import DrakePoseError
    from drake_pose.files.records import SceneEstimate
    from drake_pose.files.settings import EstimateSettings, MaskSettings
    from drake_pose.filtering.contour_tracker import TrackingSettings
    from drake_pose.filtering.inequalities import from_bounds
    from drake_pose.filtering.motion import FunctionMotion, LinearMotion, constant_velocity
    from drake_pose.filtering.state import Belief, StateLayout, make_belief
    from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
    from drake_pose.filtering.update import FunctionObservation
    from drake_pose.jobs.estimate.scene import estimate_scene
    from drake_pose.jobs.masks import SceneMasks, make_masks
    from drake_pose.jobs.registration.audit import SceneAudit, audit_scene
    from drake_pose.jobs.registration.register import SceneRegistration, register_scene
    from drake_pose.jobs.registration.settings import AuditSettings, RegistrationSettings
    from drake_pose.search import BeamSearch, MultiStartSearch, View
    from drake_pose.silhouette.pictures.label_images import label_image_to_mask
    from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
    from drake_pose.silhouette.pictures.scenes import Scene, load_scene
    from drake_pose.systems.cameras import SilhouetteCamera, cameras_from_drake
    from drake_pose.systems.diagrams import CameraRegistration
    from drake_pose.systems.images import MaskPlayer
    from drake_pose.systems.person import PersonTracker
    from drake_pose.systems.silhouette_matcher import SilhouetteMatcher, SilhouetteTracker
    from drake_pose.systems.truncated_ekf import TruncatedEkf, plant_motion

__version__ = VERSION

_HOMES = {
    "ArticulatedModel": "body.model",
    "AuditSettings": "jobs.registration.settings",
    "BeamSearch": "search",
    "Belief": "filtering.state",
    "CameraRegistration": "systems.diagrams",
    "DrakePoseError": "errors",
    "EstimateSettings": "files.settings",
    "FilterSettings": "filtering.truncated_filter",
    "FunctionMotion": "filtering.motion",
    "FunctionObservation": "filtering.update",
    "LabelRenderer": "silhouette.pictures.label_renderer",
    "LinearMotion": "filtering.motion",
    "MaskPlayer": "systems.images",
    "MaskSettings": "files.settings",
    "MultiStartSearch": "search",
    "ParallelCamera": "camera.models",
    "PersonTracker": "systems.person",
    "PinholeCamera": "camera.models",
    "RegistrationSettings": "jobs.registration.settings",
    "RootRotation": "body.root",
    "Scene": "silhouette.pictures.scenes",
    "SceneAudit": "jobs.registration.audit",
    "SceneEstimate": "files.records",
    "SceneMasks": "jobs.masks",
    "SceneRegistration": "jobs.registration.register",
    "SilhouetteCamera": "systems.cameras",
    "SilhouetteMatcher": "systems.silhouette_matcher",
    "SilhouetteTracker": "systems.silhouette_matcher",
    "StateLayout": "filtering.state",
    "TrackingSettings": "filtering.contour_tracker",
    "TruncatedEkf": "systems.truncated_ekf",
    "TruncatedFilter": "filtering.truncated_filter",
    "View": "search",
    "audit_scene": "jobs.registration.audit",
    "build_pose_tree": "body.tree_builder",
    "bundled_model": "body.model_files",
    "camera_from_drake": "camera.drake",
    "camera_to_drake": "camera.drake",
    "cameras_from_drake": "systems.cameras",
    "constant_velocity": "filtering.motion",
    "estimate_scene": "jobs.estimate.scene",
    "from_bounds": "filtering.inequalities",
    "label_image_to_mask": "silhouette.pictures.label_images",
    "load_cameras": "camera.camera_files",
    "load_model": "body.model",
    "load_scene": "silhouette.pictures.scenes",
    "look_at": "camera.models",
    "make_belief": "filtering.state",
    "make_masks": "jobs.masks",
    "plant_motion": "systems.truncated_ekf",
    "register_scene": "jobs.registration.register",
    "save_cameras": "camera.camera_files",
}

__all__ = list(_HOMES)

# Read by Drake's renderer when pydrake is first imported: without it a process that forks after a
# render hangs for ever, and processes that render side by side fight for the cores.
os.environ.setdefault("LP_NUM_THREADS", "0")


def __getattr__(name: str) -> Any:
    """Loads a public name from its room."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted({*globals(), *__all__})
