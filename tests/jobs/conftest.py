"""Fixtures for tests of several jobs."""

import pytest

from drake_pose.jobs.cluster import open_cluster
from tests.jobs.batches import write_scenes


@pytest.fixture(scope="module")
def cluster():
    """A client of two workers, which come back when they are killed.

    No longer than a module: its threads would take apart what Drake made in this one.
    """
    with open_cluster(2) as client:
        yield client


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """A folder of scenes for batches; shared, so do not modify it."""
    return write_scenes(tmp_path_factory.mktemp("scenes"))


@pytest.fixture
def out(tmp_path):
    """The result folder of a job."""
    return tmp_path / "out"
