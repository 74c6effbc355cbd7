from pathlib import Path

import pytest

from tests.jobs.registration.arm_scenes import ArmScene, write_arm_scene


@pytest.fixture(scope="session")
def arm_scene(tmp_path_factory: pytest.TempPathFactory) -> ArmScene:
    """Five frames of two cameras, one without X_WC; shared by tests, so do not change it."""
    return write_arm_scene(tmp_path_factory.mktemp("arm"))


@pytest.fixture
def own_arm(arm_scene: ArmScene, tmp_path: Path) -> ArmScene:
    """A copy that may be changed."""
    return arm_scene.copy(tmp_path)
