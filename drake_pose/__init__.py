"""Pose estimation of articulated objects from silhouettes, as Drake systems.

This module exports the names that programs need; each is imported when it is first used. The
subpackages, in the order in which they build on each other, are ``body``, ``camera``,
``silhouette``, ``fit``, ``search``, ``registration``, ``filtering``, ``person``, ``systems``,
``files``, ``jobs``, ``papers`` and ``commands``.
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
    from drake_pose.camera.camera_files import load_cameras, save_cameras
    from drake_pose.camera.exchange import camera_to_drake
    from drake_pose.camera.models import PinholeCamera, look_at
    from drake_pose.errors import DrakePoseError
    from drake_pose.files.overlay import paint_agreement
    from drake_pose.files.settings import (
        AuditSettings,
        EstimateSettings,
        MaskSettings,
        RegistrationSettings,
    )
    from drake_pose.filtering.contour_tracker import TrackingSettings
    from drake_pose.filtering.inequalities import from_bounds
    from drake_pose.filtering.motion import constant_velocity
    from drake_pose.filtering.state import Belief, StateLayout
    from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
    from drake_pose.filtering.update import FunctionObservation
    from drake_pose.jobs.estimate.scene import estimate_scene
    from drake_pose.jobs.masks import make_masks
    from drake_pose.jobs.registration.audit import audit_scene
    from drake_pose.jobs.registration.register import register_scene
    from drake_pose.registration.online_registration import OnlineRegistration
    from drake_pose.registration.register import RegistrationBody
    from drake_pose.search import MultiStartSearch, View
    from drake_pose.silhouette.pictures.label_renderer import LabelRenderer, label_image_to_mask
    from drake_pose.silhouette.pictures.scenes import load_scene
    from drake_pose.systems.bodies import RobotStateMessage
    from drake_pose.systems.cameras import MaskPlayer, SilhouetteCamera, cameras_from_drake
    from drake_pose.systems.diagrams import CameraRegistration
    from drake_pose.systems.person import PersonTracker, Walker
    from drake_pose.systems.silhouette_matcher import SilhouetteMatcher, SilhouetteTracker
    from drake_pose.systems.truncated_ekf import TruncatedEkf, plant_motion

__version__ = VERSION

_HOMES = {
    "ArticulatedModel": "body.model",
    "AuditSettings": "files.settings",
    "Belief": "filtering.state",
    "CameraRegistration": "systems.diagrams",
    "DrakePoseError": "errors",
    "EstimateSettings": "files.settings",
    "FilterSettings": "filtering.truncated_filter",
    "FunctionObservation": "filtering.update",
    "LabelRenderer": "silhouette.pictures.label_renderer",
    "MaskPlayer": "systems.cameras",
    "MaskSettings": "files.settings",
    "MultiStartSearch": "search",
    "OnlineRegistration": "registration.online_registration",
    "PersonTracker": "systems.person",
    "PinholeCamera": "camera.models",
    "RegistrationBody": "registration.register",
    "RegistrationSettings": "files.settings",
    "RobotStateMessage": "systems.bodies",
    "RootRotation": "body.root",
    "SilhouetteCamera": "systems.cameras",
    "SilhouetteMatcher": "systems.silhouette_matcher",
    "SilhouetteTracker": "systems.silhouette_matcher",
    "StateLayout": "filtering.state",
    "TrackingSettings": "filtering.contour_tracker",
    "TruncatedEkf": "systems.truncated_ekf",
    "TruncatedFilter": "filtering.truncated_filter",
    "View": "search",
    "Walker": "systems.person",
    "audit_scene": "jobs.registration.audit",
    "bundled_model": "body.model_files",
    "camera_to_drake": "camera.exchange",
    "cameras_from_drake": "systems.cameras",
    "constant_velocity": "filtering.motion",
    "estimate_scene": "jobs.estimate.scene",
    "from_bounds": "filtering.inequalities",
    "label_image_to_mask": "silhouette.pictures.label_renderer",
    "load_cameras": "camera.camera_files",
    "load_model": "body.model",
    "load_scene": "silhouette.pictures.scenes",
    "look_at": "camera.models",
    "make_masks": "jobs.masks",
    "paint_agreement": "files.overlay",
    "plant_motion": "systems.truncated_ekf",
    "register_scene": "jobs.registration.register",
    "save_cameras": "camera.camera_files",
}

__all__ = list(_HOMES)

# Drake's renderer reads this when pydrake is first imported. Without it a process that forks after
# rendering hangs, and processes that render side by side compete for the cores.
os.environ.setdefault("LP_NUM_THREADS", "0")


def __getattr__(name: str) -> Any:
    """Import a public name from its subpackage when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*__all__, "__version__"])
