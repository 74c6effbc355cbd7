"""Proofs of optimality against the definition over whole grids: never a false one."""

import numpy as np
import pytest

from drake_pose.search.grid.branch_and_bound.bounded_poses import BoundLimits
from drake_pose.search.grid.families.examination import prove_optimal
from tests.search.bodies import forked_body, swinging_chain
from tests.search.grid_problems import ProblemMaker


@pytest.fixture(scope="module")
def makers(tmp_path_factory: pytest.TempPathFactory) -> list[ProblemMaker]:
    chain = swinging_chain(tmp_path_factory.mktemp("chain"), 3).pose_tree()
    fork = forked_body(tmp_path_factory.mktemp("fork")).pose_tree()
    return [ProblemMaker(chain, 0.5), ProblemMaker(fork, 0.4)]


@pytest.mark.parametrize(
    ("noise", "on_grid"), [(0.0, True), (0.0, False), (0.002, True), (0.03, False)]
)
@pytest.mark.parametrize("views", [1, 2])
def test_proves_what_brute_force_finds(
    makers: list[ProblemMaker], noise: float, on_grid: bool, views: int
) -> None:
    generator = np.random.default_rng(11)
    for number in range(8):
        problem = makers[number % 2].make(generator, views=views, noise=noise, on_grid=on_grid)
        # From the best pose, and from any.
        start = int(np.argmin(problem.Js)) if number % 4 < 2 else int(generator.integers(100))
        proof = prove_optimal(
            problem.body, problem.views, problem.choices[start], float(problem.Js[start])
        )
        best = float(problem.Js.min())
        assert proof.proved
        assert proof.J == best == proof.lower_bound
        assert tuple(proof.samples.tolist()) in problem.within(best)


@pytest.mark.parametrize(
    "limit", [{"states": 2}, {"pairs": 8}, {"poses": 1}, {"time_limit": 0}, {"memory": 20_000}]
)
def test_a_limit_leaves_a_true_bound_and_no_false_proof(
    makers: list[ProblemMaker], limit: dict[str, int]
) -> None:
    generator = np.random.default_rng(12)
    proved = 0
    for number in range(12):
        problem = makers[number % 2].make(generator, views=1, noise=0.01, on_grid=False)
        start = int(np.argsort(problem.Js)[number])
        proof = prove_optimal(
            problem.body,
            problem.views,
            problem.choices[start],
            float(problem.Js[start]),
            BoundLimits(**limit),
        )
        best = float(problem.Js.min())
        assert proof.lower_bound <= best <= proof.J <= problem.Js[start]
        assert tuple(proof.samples.tolist()) in problem.within(proof.J)
        assert proof.budget_spent != proof.proved
        if proof.proved:
            proved += 1
            assert proof.J == best
    assert proved < 12


def test_an_exact_pose_needs_no_search(makers: list[ProblemMaker]) -> None:
    problem = makers[0].make(np.random.default_rng(13), views=1, noise=0.0, on_grid=True)
    samples, J = problem.best
    assert J == 0.0
    proof = prove_optimal(problem.body, problem.views, samples, J, BoundLimits(time_limit=0.0))
    assert proof.proved
    assert proof.states == 0
