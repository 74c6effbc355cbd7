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
    from drake_pose.filtering.inequalities import from_bounds, model_inequalities
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

_NAMES = {
    "body.model": "ArticulatedModel load_model",
    "body.model_files": "bundled_model",
    "body.root": "RootRotation",
    "camera.camera_files": "load_cameras save_cameras",
    "camera.exchange": "camera_to_drake",
    "camera.models": "PinholeCamera look_at",
    "errors": "DrakePoseError",
    "files.overlay": "paint_agreement",
    "files.settings": "AuditSettings EstimateSettings MaskSettings RegistrationSettings",
    "filtering.contour_tracker": "TrackingSettings",
    "filtering.inequalities": "from_bounds model_inequalities",
    "filtering.motion": "constant_velocity",
    "filtering.state": "Belief StateLayout",
    "filtering.truncated_filter": "FilterSettings TruncatedFilter",
    "filtering.update": "FunctionObservation",
    "jobs.estimate.scene": "estimate_scene",
    "jobs.masks": "make_masks",
    "jobs.registration.audit": "audit_scene",
    "jobs.registration.register": "register_scene",
    "registration.online_registration": "OnlineRegistration",
    "registration.register": "RegistrationBody",
    "search": "MultiStartSearch View",
    "silhouette.pictures.label_renderer": "LabelRenderer label_image_to_mask",
    "silhouette.pictures.scenes": "load_scene",
    "systems.bodies": "RobotStateMessage",
    "systems.cameras": "MaskPlayer SilhouetteCamera cameras_from_drake",
    "systems.diagrams": "CameraRegistration",
    "systems.person": "PersonTracker Walker",
    "systems.silhouette_matcher": "SilhouetteMatcher SilhouetteTracker",
    "systems.truncated_ekf": "TruncatedEkf plant_motion",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_HOMES)

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
