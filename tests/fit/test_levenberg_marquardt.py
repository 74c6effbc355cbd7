"""One damped step against the full system, and the minimum against scipy's least squares."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.sparse import csr_array

from drake_pose.errors import SettingsError
from drake_pose.fit.levenberg_marquardt import (
    AnnealingStage,
    Equations,
    LinearPrior,
    StepSettings,
    minimise,
)


def random_frames(generator, frames, p, q):
    """Return A and b of each frame's residuals A x - b; x are own unknowns, then shared ones."""
    A = generator.normal(size=(frames, 3 * (p + q), p + q))
    return A, generator.normal(size=A.shape[:2])


def equations_at(A, b, own, shared):
    """Return the equations of the sum of squares, whose gradient is 2 g."""
    x = np.column_stack([own, np.tile(shared, (len(own), 1))])
    r = np.einsum("fij,fj->fi", A, x) - b
    H, g = np.einsum("fij,fik->fjk", A, A), np.einsum("fij,fi->fj", A, r)
    return Equations(H, g, float((r**2).sum()))


def full_system(A, b, p):
    """Return the same residuals in the unknowns of all frames (rows, frames * p + q)."""
    frames, rows, _ = A.shape
    matrix = np.zeros((frames * rows, frames * p + A.shape[2] - p))
    for f in range(frames):
        matrix[f * rows : (f + 1) * rows, f * p : (f + 1) * p] = A[f, :, :p]
        matrix[f * rows : (f + 1) * rows, frames * p :] = A[f, :, p:]
    return matrix, b.reshape(-1)


def found_by_steps(A, b, p, bound, stages, coupling=None, **settings):
    frames, q = len(A), A.shape[2] - p
    return minimise(
        lambda own, shared, _: equations_at(A, b, own, shared),
        np.zeros((frames, p)),
        np.zeros(q),
        (np.full(p + q, -bound), np.full(p + q, bound)),
        stages,
        StepSettings(uniform_damping=0.0, **settings),
        coupling,
    )


@pytest.mark.parametrize("bound", [np.inf, 0.05])
@pytest.mark.parametrize("couples", [False, True])
@pytest.mark.parametrize(("frames", "p", "q"), [(1, 7, 0), (4, 3, 2), (3, 0, 4), (1, 1, 1)])
def test_minimum_matches_linear_least_squares(frames, p, q, couples, bound):
    """With and without limits and coupling."""
    generator = np.random.default_rng(frames + 10 * p)
    A, b = random_frames(generator, frames, p, q)
    matrix, right = full_system(A, b, p)
    coupling = None
    if couples and p:
        rows, mean = generator.normal(size=(7, frames * p)), generator.normal(size=7)
        information = generator.uniform(0.5, 20.0, 7)
        coupling = LinearPrior(csr_array(rows), mean, information)
        root = np.sqrt(information)
        matrix = np.vstack([matrix, np.column_stack([root[:, None] * rows, np.zeros((7, q))])])
        right = np.r_[right, root * mean]
    stages = [AnnealingStage(1.0, 1.0, 40)] * 20
    own, shared, cost, _ = found_by_steps(
        A, b, p, bound, stages, coupling, max_step=10.0, damping=1e-4
    )
    expected = lsq_linear(matrix, right, (-bound, bound), tol=1e-14)
    np.testing.assert_allclose(cost, 2.0 * expected.cost, rtol=1e-4)
    if bound == np.inf:
        np.testing.assert_allclose(np.r_[own.ravel(), shared], expected.x, atol=1e-5)
    else:
        assert (np.abs(expected.x) > bound - 1e-6).any()


@pytest.mark.parametrize(("frames", "p", "q"), [(1, 7, 0), (4, 3, 2), (3, 0, 4)])
def test_step_matches_the_full_system(frames, p, q):
    """Each frame's diagonal and the shared one are damped by the same fraction."""
    A, b = random_frames(np.random.default_rng(5), frames, p, q)
    damping = 0.3
    stage = [AnnealingStage(1.0, 1.0)]
    own, shared, *_ = found_by_steps(A, b, p, np.inf, stage, max_step=1e3, damping=damping)
    matrix, right = full_system(A, b, p)
    H = matrix.T @ matrix
    step = np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-9), matrix.T @ right)
    np.testing.assert_allclose(own.reshape(-1), step[: frames * p], atol=1e-12)
    np.testing.assert_allclose(shared, step[frames * p :], atol=1e-12)


@pytest.mark.parametrize(("name", "value"), [("scale", 0.0), ("iterations", 0), ("spacing", 0.0)])
def test_stages_out_of_range_are_refused(name, value):
    with pytest.raises(SettingsError, match=name):
        AnnealingStage(**{"scale": 1.0, "iterations": 1, "spacing": 1.0, name: value})
