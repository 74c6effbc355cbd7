"""Small models that the tests of this folder share."""

import pytest

from drake_pose.body import ArticulatedModel, load_model
from tests.body import models as bodies
from tests.body.models import write


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ArticulatedModel]:
    """A floating body, one on base joints, a welded one, and one with all types of joints."""
    texts = {"floating": bodies.FLOATING_URDF, "jointed": bodies.JOINTED_BASE_URDF}
    texts["welded"] = bodies.WELDED_URDF
    folder = tmp_path_factory.mktemp("models")
    files = {name: write(folder, text, f"{name}.urdf") for name, text in texts.items()}
    files["all_joints"] = write(folder, bodies.JOINTS_SDF, "all_joints.sdf")
    return {name: load_model(file, check=False) for name, file in files.items()}
