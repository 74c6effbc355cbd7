"""One damped step against the whole system solved at once, and a minimum against least squares."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.sparse import csr_array

from drake_pose.fit.levenberg_marquardt import (
    AnnealingStage,
    Coupling,
    Equations,
    StepSettings,
    minimise,
)

LIMIT = 0.05


def random_frames(generator, frames, p, q):
    """Residuals A x - b of each frame, x its own unknowns and then the shared ones."""
    A = generator.normal(size=(frames, 3 * (p + q), p + q))
    return A, generator.normal(size=A.shape[:2])


def equations_at(A, b, own, shared):
    x = np.column_stack([own, np.tile(shared, (len(own), 1))])
    r = np.einsum("fij,fj->fi", A, x) - b
    return Equations(
        np.einsum("fij,fik->fjk", A, A), np.einsum("fij,fi->fj", A, r), 0.5 * float((r**2).sum())
    )


def whole(A, b):
    """The same residuals in the unknowns of all frames (rows, frames * p + q)."""

    def build(p):
        frames, rows, _ = A.shape
        matrix = np.zeros((frames * rows, frames * p + A.shape[2] - p))
        for f in range(frames):
            matrix[f * rows : (f + 1) * rows, f * p : (f + 1) * p] = A[f, :, :p]
            matrix[f * rows : (f + 1) * rows, frames * p :] = A[f, :, p:]
        return matrix, b.reshape(-1)

    return build


@pytest.mark.parametrize(("frames", "p", "q"), [(1, 7, 0), (4, 3, 2), (3, 0, 4), (1, 1, 1)])
def test_minimum_of_a_linear_problem_inside_limits(frames, p, q):
    A, b = random_frames(np.random.default_rng(frames + 10 * p), frames, p, q)
    limits = np.full(p + q, -LIMIT), np.full(p + q, LIMIT)
    found = minimise(
        lambda own, shared, _: equations_at(A, b, own, shared),
        np.zeros((frames, p)),
        np.zeros(q),
        limits,
        [AnnealingStage(1.0, 1.0, 40)] * 20,
        StepSettings(damping=1e-4, even_damping=0.0),
    )
    matrix, right = whole(A, b)(p)
    expected = lsq_linear(matrix, right, (-LIMIT, LIMIT), tol=1e-14)
    assert (np.abs(expected.x) > LIMIT - 1e-6).any()
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-4)


@pytest.mark.parametrize(("frames", "p", "q"), [(1, 7, 0), (4, 3, 2), (3, 0, 4)])
def test_step_of_all_frames_is_that_of_the_whole_system(frames, p, q):
    """Of free unknowns, damped alike: by a share of the diagonal of each frame's and the shared."""
    A, b = random_frames(np.random.default_rng(5), frames, p, q)
    share = 0.3
    found = minimise(
        lambda own, shared, _: equations_at(A, b, own, shared),
        np.zeros((frames, p)),
        np.zeros(q),
        (np.full(p + q, -np.inf), np.full(p + q, np.inf)),
        [AnnealingStage(1.0, 1.0)],
        StepSettings(longest=1e3, damping=share, even_damping=0.0),
    )
    matrix, right = whole(A, b)(p)
    H = matrix.T @ matrix
    step = np.linalg.solve(H + np.diag(share * np.diag(H) + 1e-9), matrix.T @ right)
    np.testing.assert_allclose(found.own.reshape(-1), step[: frames * p], atol=1e-12)
    np.testing.assert_allclose(found.shared, step[frames * p :], atol=1e-12)


@pytest.mark.parametrize("bound", [np.inf, LIMIT])
@pytest.mark.parametrize("q", [0, 2])
def test_minimum_of_frames_whose_own_unknowns_couple(q, bound):
    generator = np.random.default_rng(8)
    frames, p = 5, 3
    A, b = random_frames(generator, frames, p, q)
    rows, mean = generator.normal(size=(7, frames * p)), generator.normal(size=7)
    information = generator.uniform(0.5, 20.0, 7)

    def evaluate(own, shared, _):
        found = equations_at(A, b, own, shared)
        # The cost of which g is half the slope.
        return Equations(found.H, found.g, 2.0 * found.cost)

    limits = np.full(p + q, -bound), np.full(p + q, bound)
    found = minimise(
        evaluate,
        np.zeros((frames, p)),
        np.zeros(q),
        limits,
        [AnnealingStage(1.0, 1.0, 40)] * 20,
        StepSettings(longest=10.0, damping=1e-4, even_damping=0.0),
        Coupling(csr_array(rows), mean, information),
    )
    matrix, right = whole(A, b)(p)
    root = np.sqrt(information)
    matrix = np.vstack([matrix, np.column_stack([root[:, None] * rows, np.zeros((7, q))])])
    expected = lsq_linear(matrix, np.r_[right, root * mean], (-bound, bound), tol=1e-14)
    np.testing.assert_allclose(found.cost, 2.0 * expected.cost, rtol=1e-4)
    if bound == np.inf:
        np.testing.assert_allclose(np.r_[found.own.ravel(), found.shared], expected.x, atol=1e-5)
