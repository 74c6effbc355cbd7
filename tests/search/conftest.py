"""Two bodies whose grids are small enough for brute force, and a robot arm."""

import pytest

from tests.search.arms import arm_tree
from tests.search.bodies import forked_body, swinging_chain
from tests.search.grid_problems import ProblemMaker


@pytest.fixture(scope="session", params=["chain", "fork"])
def maker(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("body")
    model = swinging_chain(folder, 3) if request.param == "chain" else forked_body(folder)
    return ProblemMaker(model.pose_tree(), 0.4)


@pytest.fixture(scope="session")
def tree(tmp_path_factory):
    """The arm of ``tests.search.arms``."""
    return arm_tree(tmp_path_factory.mktemp("arm"))
