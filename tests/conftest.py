"""Fixtures for all tests."""

import os

# Before pydrake is imported: without it a process that forks after a render hangs.
os.environ.setdefault("LP_NUM_THREADS", "0")
# And before numpy is: matrices are small, and threads wait for each other where cores are busy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import shutil
from pathlib import Path

import pytest

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.person.date.skeleton import Skeleton, load_skeleton
from tests.cli import CliRunner
from tests.jobs.scenes import TinyScene, write_scene
from tests.person.studio import Studio
from tests.search.bodies import forked_body


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded scenes beside the checkout; tests that need it are skipped without."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no ../shared/data beside this checkout")
    return folder


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> TinyScene:
    """Three frames of one camera; shared, so do not change it."""
    return write_scene(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture
def own_scene(tiny_scene: TinyScene, tmp_path: Path) -> TinyScene:
    """A copy to be spoilt."""
    shutil.copytree(tiny_scene.folder, tmp_path / "scene")
    return TinyScene(tmp_path / "scene", tiny_scene.model, tiny_scene.truth)


@pytest.fixture(scope="session")
def runner() -> CliRunner:
    return CliRunner()


@pytest.fixture(scope="session")
def person() -> ArticulatedModel:
    """The bundled person, whose links have any lengths; shared, so do not change it."""
    return load_model(bundled_model("person"), check=False)


@pytest.fixture(scope="session")
def shaped_person() -> ArticulatedModel:
    """The bundled person whose joints say how long links are; shared, so do not change it."""
    return load_model(bundled_model("person").with_name("person_shape.urdf"), check=False)


@pytest.fixture(scope="session")
def skeleton(person: ArticulatedModel) -> Skeleton:
    return load_skeleton(person)


@pytest.fixture(scope="session")
def body(tmp_path_factory: pytest.TempPathFactory) -> ArticulatedModel:
    """A trunk that turns, and two arms on it; shared, so do not change it."""
    return forked_body(tmp_path_factory.mktemp("body"))


@pytest.fixture(scope="session")
def studio() -> Studio:
    """A simulated person before nine small simulated cameras."""
    return Studio()
