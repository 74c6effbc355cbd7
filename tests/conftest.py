"""Fixtures for all tests."""

import os

# Set before pydrake is imported; otherwise a process that forks after rendering hangs.
os.environ.setdefault("LP_NUM_THREADS", "0")
# Set before numpy is imported: on small matrices BLAS's threads only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import shutil
from pathlib import Path

import pytest

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.person.date.skeleton import Skeleton, load_skeleton
from tests.jobs.scenes import TinyScene, write_scene
from tests.person.studio import Studio
from tests.search.bodies import forked_body


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of recorded scenes beside the checkout; tests that need it are skipped without it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no ../shared/data beside this checkout")
    return folder


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> TinyScene:
    """Three frames of one camera; shared, so do not modify it."""
    return write_scene(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture
def own_scene(tiny_scene: TinyScene, tmp_path: Path) -> TinyScene:
    """A copy of tiny_scene that the test may modify."""
    shutil.copytree(tiny_scene.folder, tmp_path / "scene")
    return TinyScene(tmp_path / "scene", tiny_scene.model, tiny_scene.truth)


@pytest.fixture(scope="session")
def person() -> ArticulatedModel:
    """The bundled person, whose link lengths are fixed; shared, so do not modify it."""
    return load_model(bundled_model("person"), check=False)


@pytest.fixture(scope="session")
def shaped_person() -> ArticulatedModel:
    """The bundled person with joints for its link lengths; shared, so do not modify it."""
    return load_model(bundled_model("person").with_name("person_shape.urdf"), check=False)


@pytest.fixture(scope="session")
def skeleton(person: ArticulatedModel) -> Skeleton:
    return load_skeleton(person)


@pytest.fixture(scope="session")
def body(tmp_path_factory: pytest.TempPathFactory) -> ArticulatedModel:
    """A rotating trunk with two arms; shared, so do not modify it."""
    return forked_body(tmp_path_factory.mktemp("body"))


@pytest.fixture(scope="session")
def studio() -> Studio:
    """A simulated person and nine small simulated cameras."""
    return Studio()
