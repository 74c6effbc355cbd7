"""Silhouettes: projected areas by the span kernel, Drake label images, masks and scenes.

Names are loaded when they are first used: the kernel needs numba, label images need Drake, and
programs that use neither start fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drake_pose.silhouette.agreement import Agreement, measure_agreement
    from drake_pose.silhouette.bending import BendingOutline, TreeSurfaces, score_bending
    from drake_pose.silhouette.label_images import label_image_to_mask, mask_to_label_image
    from drake_pose.silhouette.label_renderer import LabelRenderer
    from drake_pose.silhouette.masks import read_mask, write_mask
    from drake_pose.silhouette.outline import Outline, outline_from_mesh
    from drake_pose.silhouette.scenes import Scene, load_scene
    from drake_pose.silhouette.scoring import (
        draw_mask,
        draw_segments,
        prefix_sums,
        score_bodies,
        score_candidates,
        subtract_body,
    )
    from drake_pose.silhouette.visibility import require_visible

_HOMES = {
    "Agreement": "agreement",
    "BendingOutline": "bending",
    "LabelRenderer": "label_renderer",
    "Outline": "outline",
    "Scene": "scenes",
    "TreeSurfaces": "bending",
    "draw_mask": "scoring",
    "draw_segments": "scoring",
    "label_image_to_mask": "label_images",
    "load_scene": "scenes",
    "mask_to_label_image": "label_images",
    "measure_agreement": "agreement",
    "outline_from_mesh": "outline",
    "prefix_sums": "scoring",
    "read_mask": "masks",
    "require_visible": "visibility",
    "score_bending": "bending",
    "score_bodies": "scoring",
    "score_candidates": "scoring",
    "subtract_body": "scoring",
    "write_mask": "masks",
}

__all__ = [
    "Agreement",
    "BendingOutline",
    "LabelRenderer",
    "Outline",
    "Scene",
    "TreeSurfaces",
    "draw_mask",
    "draw_segments",
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
