"""Fixtures for tests of several jobs."""

import pytest

from drake_pose.jobs.cluster import open_cluster


@pytest.fixture(scope="module")
def cluster():
    """A client of two workers, which come back when they are killed.

    No longer than a module: its threads would take apart what Drake made in this one.
    """
    with open_cluster(2) as client:
        yield client


@pytest.fixture
def out(tmp_path):
    """The result folder of a job."""
    return tmp_path / "out"
