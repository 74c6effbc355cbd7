"""Pose estimation of articulated objects from silhouettes, as Drake systems.

The names that most programs need are here; each is loaded when it is first used. The packages are
``drake_pose.body``, ``camera``, ``silhouette``, ``matching``, ``filtering``, ``multiview``,
``systems`` and ``apps``.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from drake_pose.version import VERSION

if TYPE_CHECKING:
    from drake_pose.apps.estimate.scene import SceneEstimate, estimate_scene
    from drake_pose.apps.masks.masks import SceneMasks, make_masks
    from drake_pose.apps.masks.settings import MaskSettings
    from drake_pose.apps.settings import EstimateSettings
    from drake_pose.body import bundled_model, load_model
    from drake_pose.camera import load_cameras
    from drake_pose.silhouette import load_scene

__version__ = VERSION

_HOMES = {
    "EstimateSettings": "apps.settings",
    "MaskSettings": "apps.masks.settings",
    "SceneEstimate": "apps.estimate.scene",
    "SceneMasks": "apps.masks.masks",
    "bundled_model": "body",
    "estimate_scene": "apps.estimate.scene",
    "load_cameras": "camera",
    "load_model": "body",
    "load_scene": "silhouette",
    "make_masks": "apps.masks.masks",
}

__all__ = [
    "EstimateSettings",
    "MaskSettings",
    "SceneEstimate",
    "SceneMasks",
    "bundled_model",
    "estimate_scene",
    "load_cameras",
    "load_model",
    "load_scene",
    "make_masks",
]

# Read by Drake's renderer when pydrake is first imported: without it a process that forks after a
# render hangs for ever, and processes that render side by side fight for the cores.
os.environ.setdefault("LP_NUM_THREADS", "0")


def __getattr__(name: str) -> Any:
    """Loads a public name from its room."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
