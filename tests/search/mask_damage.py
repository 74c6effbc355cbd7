"""Clean silhouettes made like real ones: parts missing, holes, shadows, occluders, ragged edges.

Tests draw their masks with this, so that no parameter need be chosen on real pictures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.search.estimates import View


@dataclass(frozen=True)
class MaskDamage:
    """How much silhouettes are damaged; sizes are shares of the root of the silhouette's area.

    Args:
        missing: chance of a part of the body that is not segmented, in all views.
        missing_size: greatest radius of that part.
        occluder: chance of a rectangle in front of the body, in all views.
        occluder_size: greatest half side of the rectangle.
        shadow: chance of a blob attached to the body, in each view.
        shadow_size: greatest radius of the blob.
        holes: greatest number of small holes, in each view.
        hole_size: greatest radius of a hole.
        raggedness: how far the edge wanders, standard deviation [pixel].
        shift: how far the calibration is off, standard deviation [pixel].
    """

    missing: float = 0.6
    missing_size: float = 0.22
    occluder: float = 0.25
    occluder_size: float = 0.25
    shadow: float = 0.3
    shadow_size: float = 0.15
    holes: int = 3
    hole_size: float = 0.04
    raggedness: float = 0.7
    shift: float = 1.0


def damage_views(
    views: Sequence[View],
    p_W: np.ndarray,
    damage: MaskDamage,
    generator: np.random.Generator,
) -> list[View]:
    """Damage silhouettes of one instant.

    What is missing or in front of the body is at the same place of it in all views.
    ``p_W``: (n, 3) points of the body in the world [m]; what is missing is about one of them.
    """
    sizes = [math.sqrt(np.count_nonzero(view.mask)) for view in views]
    masks = [view.mask.astype(np.uint8) for view in views]
    if generator.random() < damage.missing:
        spot, radius = _spot(p_W, generator), generator.uniform(0.3, 1.0) * damage.missing_size
        for view, mask, size in zip(views, masks, sizes, strict=True):
            _draw_blob(mask, _pixel(view.camera, spot), radius * size, 0, generator)
    if generator.random() < damage.occluder:
        spot, turn = _spot(p_W, generator), generator.uniform(0.0, 180.0)
        sides = generator.uniform(0.4, 1.0, 2) * damage.occluder_size
        for view, mask, size in zip(views, masks, sizes, strict=True):
            corners = cv2.boxPoints((_pixel(view.camera, spot), tuple(2.0 * sides * size), turn))
            cv2.fillConvexPoly(mask, np.rint(corners).astype(np.int32), 0)
    damaged = []
    for view, mask, size in zip(views, masks, sizes, strict=True):
        if generator.random() < damage.shadow and mask.any():
            center = _edge_pixel(mask, generator)
            _draw_blob(
                mask, center, generator.uniform(0.3, 1.0) * damage.shadow_size * size, 1, generator
            )
        for _ in range(generator.integers(0, damage.holes + 1)):
            radius = generator.uniform(0.3, 1.0) * damage.hole_size * size
            center = _pixel(view.camera, _spot(p_W, generator))
            _draw_blob(mask, center, radius, 0, generator)
        ragged = _ragged(mask, damage.raggedness, generator)
        # A mask that is wholly lost tells nothing; the clean one stands in.
        damaged.append(View(view.camera, ragged if ragged.any() else view.mask))
    return damaged


def nudge_camera(camera: Camera, pixels: float, generator: np.random.Generator) -> Camera:
    """The camera turned a little (a parallel one: moved), as by an error of its calibration.

    ``pixels``: standard deviation of how far its picture moves along rows and columns [pixel].
    """
    shift = generator.normal(0.0, pixels, 2)
    roll = generator.normal(0.0, pixels / (0.25 * camera.width))
    X_CC = np.eye(4)
    if isinstance(camera, PinholeCamera):
        turn = [-shift[1] / camera.focal_y, shift[0] / camera.focal_x, roll]
        X_CC[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    else:
        X_CC[:2, 3] = shift / camera.pixels_per_metre
    return camera.with_pose(camera.X_WC @ X_CC)


def _spot(p_W: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return np.asarray(p_W[generator.integers(len(p_W))])


def _pixel(camera: Camera, p_W: np.ndarray) -> tuple[float, float]:
    u, v = camera.project(p_W[None])[0][0]
    return float(u), float(v)


def _edge_pixel(mask: np.ndarray, generator: np.random.Generator) -> tuple[float, float]:
    rows, columns = np.nonzero(mask > cv2.erode(mask, np.ones((3, 3), np.uint8)))
    chosen = generator.integers(len(rows))
    return float(columns[chosen]), float(rows[chosen])


def _draw_blob(
    mask: np.ndarray,
    center: tuple[float, float],
    radius: float,
    value: int,
    generator: np.random.Generator,
) -> None:
    """Fill a bumpy disc; one out of round by a third of its radius or so."""
    angles = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
    radii = np.full(48, radius)
    for wave in (2, 3, 5):
        phase = generator.uniform(0.0, 2.0 * math.pi)
        radii += radius * generator.uniform(0.0, 0.5 / wave) * np.cos(wave * angles + phase)
    points = np.column_stack([np.cos(angles), np.sin(angles)]) * radii[:, None] + center
    cv2.fillPoly(mask, [np.rint(points).astype(np.int32)], value)


def _ragged(mask: np.ndarray, raggedness: float, generator: np.random.Generator) -> np.ndarray:
    """The mask with its edge moved by a smooth random field [pixel]."""
    if raggedness == 0.0:
        return mask.astype(bool)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5)
    field = cv2.GaussianBlur(generator.standard_normal(mask.shape), (0, 0), 3.0)
    size = raggedness / max(float(field.std()), 1e-12)
    return np.asarray(inside - outside + size * field > 0.0)
