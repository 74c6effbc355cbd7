"""Silhouettes: projected areas by the span kernel, Drake label images, masks and scenes.

Names are loaded when they are first used: the kernel needs numba, label images need Drake, and
programs that use neither start fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drake_pose.silhouette.areas.agreement import Agreement, measure_agreement
    from drake_pose.silhouette.areas.bending import BendingOutline, TreeSurfaces, score_bending
    from drake_pose.silhouette.areas.outline import Outline, outline_from_mesh
    from drake_pose.silhouette.areas.scoring import (
        draw_labels,
        draw_mask,
        prefix_sums,
        score_bodies,
        score_candidates,
        subtract_body,
    )
    from drake_pose.silhouette.areas.visibility import require_visible
    from drake_pose.silhouette.pictures.label_images import label_image_to_mask, mask_to_label_image
    from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
    from drake_pose.silhouette.pictures.masks import read_mask, write_mask
    from drake_pose.silhouette.pictures.scenes import Scene, load_scene

_HOMES = {
    "Agreement": "areas.agreement",
    "BendingOutline": "areas.bending",
    "LabelRenderer": "pictures.label_renderer",
    "Outline": "areas.outline",
    "Scene": "pictures.scenes",
    "TreeSurfaces": "areas.bending",
    "draw_labels": "areas.scoring",
    "draw_mask": "areas.scoring",
    "label_image_to_mask": "pictures.label_images",
    "load_scene": "pictures.scenes",
    "mask_to_label_image": "pictures.label_images",
    "measure_agreement": "areas.agreement",
    "outline_from_mesh": "areas.outline",
    "prefix_sums": "areas.scoring",
    "read_mask": "pictures.masks",
    "require_visible": "areas.visibility",
    "score_bending": "areas.bending",
    "score_bodies": "areas.scoring",
    "score_candidates": "areas.scoring",
    "subtract_body": "areas.scoring",
    "write_mask": "pictures.masks",
}

__all__ = [
    "Agreement",
    "BendingOutline",
    "LabelRenderer",
    "Outline",
    "Scene",
    "TreeSurfaces",
    "draw_labels",
    "draw_mask",
    "label_image_to_mask",
    "load_scene",
    "mask_to_label_image",
    "measure_agreement",
    "outline_from_mesh",
    "prefix_sums",
    "read_mask",
    "require_visible",
    "score_bending",
    "score_bodies",
    "score_candidates",
    "subtract_body",
    "write_mask",
]


def __getattr__(name: str) -> Any:
    """Loads a public name from its module."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
