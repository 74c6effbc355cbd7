"""Agreement between the span kernel and Drake's label images."""

from collections.abc import Mapping

import numpy as np

from drake_pose.body import ArticulatedModel, ModelSkin, TriangleMesh
from drake_pose.camera.models import Camera
from drake_pose.silhouette.outline import BendingOutline, outline_from_mesh
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.scoring import draw_mask

MAX_DIFFERENCE = 0.002
"""Largest fraction of a mask's pixels that may differ."""

# Number of pixels that may differ, however small the mask is.
_SLACK = 2


def measure_agreement(
    model: ArticulatedModel,
    camera: Camera,
    poses: int = 200,
    seed: int = 0,
    held: Mapping[str, float] | None = None,
) -> tuple[float, float, np.ndarray]:
    """Draw a model at random positions within limits, by the kernel and by Drake.

    Positions without limits keep their defaults; positions in ``held`` keep the given values.

    Returns:
        The largest fraction of a mask's pixels that differ (0 for at most two pixels); the fraction
        over all poses, without that tolerance; and the areas (n,) of Drake's masks [pixel].
    """
    renderer, skin = LabelRenderer(model, camera), ModelSkin(model)
    outlines = {name: outline_from_mesh(mesh) for name, mesh in model.link_meshes.items()}
    links = {name: label for label, name in renderer.link_names.items()}
    nothing = outline_from_mesh(TriangleMesh.empty())
    bands = [BendingOutline(nothing, mesh) for mesh in skin.meshes]
    limited = np.isfinite(model.lower) & np.isfinite(model.upper)
    lower = np.where(limited, model.lower, model.default_positions)
    upper = np.where(limited, model.upper, model.default_positions)
    for name, value in (held or {}).items():
        lower[model.position_index(name)] = upper[model.position_index(name)] = value
    differing, areas = np.zeros(poses), np.zeros(poses)
    positions = np.random.default_rng(seed).uniform(lower, upper, (poses, len(lower)))
    for n, q in enumerate(positions):
        reference = renderer.mask(q)
        bent = [band.at(p_W) for band, p_W in zip(bands, skin.vertices(q), strict=True)]
        X_WL = [*renderer.link_poses(q)[[links[name] for name in outlines]]]
        X_WL += [np.eye(4)] * len(bent)
        mask = draw_mask([*outlines.values(), *bent], camera.X_CW @ np.array(X_WL), camera)
        differing[n], areas[n] = np.count_nonzero(mask != reference), reference.sum()
    fractions = np.where(differing <= _SLACK, 0.0, differing / np.maximum(areas, 1))
    return float(fractions.max()), float(differing.sum() / max(areas.sum(), 1)), areas
