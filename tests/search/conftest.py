"""Four bodies whose grids are small enough for brute force, and a robot arm."""

import pytest

from tests.body.models import load_limb
from tests.search.arms import arm_tree, gripper
from tests.search.bodies import forked_body, swinging_chain
from tests.search.grid_problems import ProblemMaker

MAKERS = {
    "chain": lambda folder: ProblemMaker(swinging_chain(folder, 3).pose_tree(), interval=0.4),
    "fork": lambda folder: ProblemMaker(forked_body(folder).pose_tree(), interval=0.4),
    # One finger follows the other.
    "gripper": lambda folder: ProblemMaker(
        gripper(folder, follows=True).pose_tree(), side=100, interval=0.4, length_interval=0.02
    ),
    # With a band of skin at each joint.
    "limb": lambda folder: ProblemMaker(load_limb(folder).pose_tree(), side=100, interval=1.2),
}


@pytest.fixture(scope="session", params=MAKERS)
def maker(request, tmp_path_factory):
    return MAKERS[request.param](tmp_path_factory.mktemp("body"))


@pytest.fixture(scope="session")
def tree(tmp_path_factory):
    """The arm of ``tests.search.arms``."""
    return arm_tree(tmp_path_factory.mktemp("arm"))
