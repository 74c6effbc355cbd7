"""How well the span kernel agrees with Drake's own label images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.tree.node_skin import ModelSkin
from drake_pose.camera.models import Camera
from drake_pose.silhouette.areas.bending import BendingOutline
from drake_pose.silhouette.areas.outline import outline_from_mesh
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

if TYPE_CHECKING:
    from drake_pose.body.model import ArticulatedModel

LARGEST_SHARE = 0.002
"""The largest part of a mask that may differ."""

SLACK = 2
"""How many pixels may differ however small the mask is."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Masks of the same poses, by the kernel and by Drake.

    Args:
        differing: (n,) pixels in one mask only, for each pose.
        areas: (n,) pixels in Drake's mask.
        positions: (n, nq) the poses.
    """

    differing: np.ndarray
    areas: np.ndarray
    positions: np.ndarray

    @property
    def shares(self) -> np.ndarray:
        """(n,) differing pixels over the mask's; 0 where no more than SLACK pixels differ."""
        return np.where(self.differing <= SLACK, 0.0, self.differing / np.maximum(self.areas, 1))

    @property
    def worst(self) -> float:
        """The greatest of shares."""
        return float(self.shares.max())

    @property
    def mean(self) -> float:
        """All differing pixels over all masks' pixels, without any slack."""
        return float(self.differing.sum() / max(int(self.areas.sum()), 1))

    @property
    def holds(self) -> bool:
        """Whether no mask differs by more than LARGEST_SHARE (or SLACK pixels)."""
        return self.worst <= LARGEST_SHARE


def measure_agreement(
    model: ArticulatedModel,
    camera: Camera,
    poses: int = 200,
    seed: int = 0,
    held: Mapping[str, float] | None = None,
) -> Agreement:
    """Draws a model in random poses inside its limits, by the kernel and by Drake.

    Positions without limits (the pose of a floating body) keep their default.

    Args:
        model: the model.
        camera: the camera.
        poses: how many poses.
        seed: of the random numbers.
        held: positions that are not drawn, by name, with their value [rad or m].

    Raises:
        UnknownNameError: when the model has no position of a name in held.
    """
    renderer = LabelRenderer(model, camera)
    outlines = {name: outline_from_mesh(mesh) for name, mesh in model.link_meshes.items()}
    links = {name: label for label, name in renderer.link_names.items()}
    bodies = [links[name] for name in outlines]
    skin = ModelSkin(model)
    nothing = outline_from_mesh(TriangleMesh.empty())
    bands = [BendingOutline(nothing, mesh) for mesh in skin.meshes]
    limited = np.isfinite(model.lower) & np.isfinite(model.upper)
    lower = np.where(limited, model.lower, model.default_positions)
    upper = np.where(limited, model.upper, model.default_positions)
    for name, value in (held or {}).items():
        lower[model.position_index(name)] = upper[model.position_index(name)] = value
    positions = np.random.default_rng(seed).uniform(lower, upper, (poses, len(lower)))
    differing, areas = np.zeros(poses, dtype=np.int64), np.zeros(poses, dtype=np.int64)
    for n, q in enumerate(positions):
        reference = renderer.mask(q)
        bent = [band.at(p_W) for band, p_W in zip(bands, skin.vertices(q), strict=True)]
        X_WL = [*renderer.link_poses(q)[bodies], *([np.eye(4)] * len(bent))]
        mask = draw_mask([*outlines.values(), *bent], camera.X_CW @ np.array(X_WL), camera)
        differing[n], areas[n] = np.count_nonzero(mask != reference), reference.sum()
    return Agreement(differing, areas, positions)
