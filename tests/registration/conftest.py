"""A small arm that stands on a plate in the world."""

import pytest

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.registration.register import RegistrationBody
from tests.search.arms import arm_urdf


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ArticulatedModel:
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(arm_urdf())
    return load_model(path, check=False)


@pytest.fixture(scope="module")
def body(model: ArticulatedModel) -> RegistrationBody:
    return RegistrationBody(model.pose_tree())
