"""Check the motions of nodes against finite differences."""

import numpy as np

STEP = 1e-6


def world_points(placed):
    """Return (2, nodes, 3) two points of each node's rigid surface in the world [m]."""
    starts = placed.packed.starts[:-1, 0]
    p_N = placed.packed.points.T[np.array([starts, starts + 1])]
    X_WN = placed.X_WN
    return np.einsum("nij,pnj->pni", X_WN[:, :3, :3], p_N) + X_WN[:, :3, 3]


def assert_motions_are_derivatives(body, theta):
    """Assert that a body's motions are the derivatives by all its parameters."""
    placed = body.place(theta)
    motions = placed.dense(len(theta)).reshape(len(placed.X_WN), len(theta), 3, 4)
    p_W = world_points(placed)
    for k, step in enumerate(STEP * np.eye(len(theta))):
        above, below = (world_points(body.place(theta + by)) for by in (step, -step))
        A, b = motions[:, k, :, :3], motions[:, k, :, 3]
        found = np.einsum("nij,pnj->pni", A, p_W) + b
        np.testing.assert_allclose(found, (above - below) / (2 * STEP), atol=1e-7, err_msg=str(k))
