"""How points of a body move in a picture with the body's pose."""

from __future__ import annotations

import numpy as np

from drake_pose.body.tree.tree_kinematics import Motions
from drake_pose.camera import Camera
from drake_pose.compiled import compiled
from drake_pose.silhouette.contours.contour_points import ContourPoints


def world_points(p_N: np.ndarray, nodes: np.ndarray, X_WN: np.ndarray) -> np.ndarray:
    """Points (n, 3) in the world.

    Args:
        p_N: (n, 3) points, each in its node's frame N [m].
        nodes: (n,) their nodes.
        X_WN: (nodes, 4, 4) the nodes' poses.
    """
    X = X_WN[nodes]
    return np.asarray(np.einsum("nij,nj->ni", X[:, :3, :3], p_N) + X[:, :3, 3])


def image_jacobian(
    p_N: np.ndarray, nodes: np.ndarray, motions: Motions, camera: Camera
) -> np.ndarray:
    """How the pictures of body points move with the parameters, (n, 2, m) [pixel/rad, /m].

    Args:
        p_N: (n, 3) points, each in its node's frame N [m].
        nodes: (n,) their nodes.
        motions: poses and motions, of ``TreeKinematics.motions``.
        camera: the camera, which must see the points.
    """
    return _image_jacobian(
        world_points(p_N, nodes, motions.X_WN),
        nodes,
        motions.twists,
        motions.moves,
        np.ascontiguousarray(camera.X_CW),
        camera.kernel_parameters(),
    )


def normal_jacobian(points: ContourPoints, motions: Motions, camera: Camera) -> np.ndarray:
    """How fast contour points move outwards with the parameters, (n, m) [pixel/rad, /m].

    The point of the body that makes the contour changes with the pose, but it moves along the
    contour then: the contour's own speed along its normal is that of the body's point (Giblin and
    Weiss 1987), so that these are the contour's derivatives, too.

    Args:
        points: the contour's points in that camera at the motions' poses.
        motions: poses and motions, of ``TreeKinematics.motions``.
        camera: the camera.
    """
    return _normal_jacobian(
        world_points(points.p_N, points.nodes, motions.X_WN),
        points.nodes,
        points.normals,
        motions.twists,
        motions.moves,
        np.ascontiguousarray(camera.X_CW),
        camera.kernel_parameters(),
    )


@compiled
def picture_rows(p_W: np.ndarray, X_CW: np.ndarray, camera: np.ndarray, rows: np.ndarray) -> None:
    """Writes du/dp_W and dv/dp_W (2, 3) of a point."""
    x, y, z = X_CW[0, 3], X_CW[1, 3], X_CW[2, 3]
    for k in range(3):
        x += X_CW[0, k] * p_W[k]
        y += X_CW[1, k] * p_W[k]
        z += X_CW[2, k] * p_W[k]
    for k in range(3):
        if camera[0] == 1.0:
            rows[0, k] = camera[1] * X_CW[0, k]
            rows[1, k] = camera[2] * X_CW[1, k]
        else:
            rows[0, k] = camera[1] * (X_CW[0, k] - X_CW[2, k] * x / z) / z
            rows[1, k] = camera[2] * (X_CW[1, k] - X_CW[2, k] * y / z) / z


@compiled
def speed_along(row: np.ndarray, p: np.ndarray, twist: np.ndarray) -> float:
    """The speed of a point (3,) along a row (3,)."""
    s = twist[6]
    return (
        row[0] * (twist[1] * p[2] - twist[2] * p[1] + twist[3] + s * p[0])
        + row[1] * (twist[2] * p[0] - twist[0] * p[2] + twist[4] + s * p[1])
        + row[2] * (twist[0] * p[1] - twist[1] * p[0] + twist[5] + s * p[2])
    )


@compiled
def _image_jacobian(
    p_W: np.ndarray,
    nodes: np.ndarray,
    twists: np.ndarray,
    moves: np.ndarray,
    X_CW: np.ndarray,
    camera: np.ndarray,
) -> np.ndarray:
    """See image_jacobian."""
    J = np.zeros((p_W.shape[0], 2, twists.shape[0]))
    rows = np.empty((2, 3))
    for n in range(p_W.shape[0]):
        picture_rows(p_W[n], X_CW, camera, rows)
        for m in range(twists.shape[0]):
            if moves[nodes[n], m]:
                J[n, 0, m] = speed_along(rows[0], p_W[n], twists[m])
                J[n, 1, m] = speed_along(rows[1], p_W[n], twists[m])
    return J


@compiled
def _normal_jacobian(
    p_W: np.ndarray,
    nodes: np.ndarray,
    normals: np.ndarray,
    twists: np.ndarray,
    moves: np.ndarray,
    X_CW: np.ndarray,
    camera: np.ndarray,
) -> np.ndarray:
    """See normal_jacobian."""
    J = np.zeros((p_W.shape[0], twists.shape[0]))
    rows, row = np.empty((2, 3)), np.empty(3)
    for n in range(p_W.shape[0]):
        picture_rows(p_W[n], X_CW, camera, rows)
        for k in range(3):
            row[k] = normals[n, 0] * rows[0, k] + normals[n, 1] * rows[1, k]
        for m in range(twists.shape[0]):
            if moves[nodes[n], m]:
                J[n, m] = speed_along(row, p_W[n], twists[m])
    return J
