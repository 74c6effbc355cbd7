"""Drake's primitive shapes as triangles, with the vertices that its VTK renderer draws.

Sources: RobotLocomotion/drake ``geometry/render_vtk/internal_render_engine_vtk_base.cc``
(resolutions), Kitware/VTK ``vtkTexturedSphereSource`` and ``vtkCylinderSource`` (vertices).
"""

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.surfaces.mesh import TriangleMesh, merge_duplicate_vertices

_VTK_RESOLUTION = 50


def box_mesh(width: float, depth: float, height: float) -> TriangleMesh:
    """A box centred at the origin, with edges [m] along x, y and z."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [(a, b, c) for a, b, c, _ in faces] + [(a, c, d) for a, _, c, d in faces]
    return TriangleMesh(corners * (width, depth, height), np.array(triangles, dtype=np.int32))


def sphere_mesh(radius: float) -> TriangleMesh:
    """A sphere of the given radius [m] centred at the origin."""
    return ellipsoid_mesh(radius, radius, radius)


def ellipsoid_mesh(a: float, b: float, c: float) -> TriangleMesh:
    """An ellipsoid with half axes a, b, c [m] along x, y and z."""
    polar = np.linspace(0.0, np.pi, _VTK_RESOLUTION + 1)
    azimuth = np.arange(_VTK_RESOLUTION) * (2.0 * np.pi / _VTK_RESOLUTION)
    return _closed_rings(_sphere_points(polar, azimuth) * (a, b, c))


def cylinder_mesh(radius: float, length: float) -> TriangleMesh:
    """A cylinder along z, centred at the origin, of the given radius and length [m]."""
    # Drake turns VTK's cylinder a quarter about its axis, so the first vertex lies on y.
    angle = np.pi / 2.0 + np.arange(_VTK_RESOLUTION) * (2.0 * np.pi / _VTK_RESOLUTION)
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(angle)], axis=-1)
    half = np.array([0.0, 0.0, length / 2.0])
    top, bottom = rim + half, rim - half
    # A ring that is one single vertex of the rim turns the quads next to it into the cap's fan.
    fans = (np.broadcast_to(top[0], top.shape), np.broadcast_to(bottom[0], bottom.shape))
    return _closed_rings(np.stack([fans[0], top, bottom, fans[1]]))


def capsule_mesh(radius: float, length: float) -> TriangleMesh:
    """A capsule along z, centred at the origin; length [m] is that of its cylindrical part."""
    quarter = np.linspace(0.0, np.pi / 2.0, _VTK_RESOLUTION - 1)
    azimuth = np.pi / 2.0 + np.arange(_VTK_RESOLUTION) * (2.0 * np.pi / _VTK_RESOLUTION)
    upper = radius * _sphere_points(quarter, azimuth) + (0.0, 0.0, length / 2.0)
    lower = (upper * (1.0, 1.0, -1.0))[::-1]
    return _closed_rings(np.concatenate([upper, lower]))


def _sphere_points(
    polar: NDArray[np.float64], azimuth: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Points (polar, azimuth, 3) of the unit sphere; both poles are exact."""
    sine = np.where(np.isin(polar, (0.0, np.pi)), 0.0, np.sin(polar))
    height = np.broadcast_to(np.cos(polar)[:, None], (len(polar), len(azimuth)))
    return np.stack([np.outer(sine, np.cos(azimuth)), np.outer(sine, np.sin(azimuth)), height], -1)


def _closed_rings(points: NDArray[np.float64]) -> TriangleMesh:
    """Triangles between rings of points (rings, points of a ring, 3); each ring is closed."""
    rings, count, _ = points.shape
    index = np.arange(rings * count).reshape(rings, count)
    above, below = index[:-1], index[1:]
    above_next, below_next = np.roll(above, -1, axis=1), np.roll(below, -1, axis=1)
    triangles = np.concatenate(
        [
            np.stack([above, below, below_next], axis=-1).reshape(-1, 3),
            np.stack([above, below_next, above_next], axis=-1).reshape(-1, 3),
        ]
    )
    return merge_duplicate_vertices(TriangleMesh(points.reshape(-1, 3), triangles.astype(np.int32)))
