"""Fixtures for all tests."""

import os

# Before pydrake is imported: without it a process that forks after a render hangs.
os.environ.setdefault("LP_NUM_THREADS", "0")

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded scenes beside the checkout; tests that need it are skipped without."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no ../shared/data beside this checkout")
    return folder
