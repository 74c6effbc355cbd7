"""Skin in diagrams: sensors and Meshcat show it bent, and the matcher finds the pose."""

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams, Rgba
from pydrake.systems.analysis import Simulator

from drake_pose.body import ModelSkin
from drake_pose.camera.models import ParallelCamera
from drake_pose.search import PaperSearch, PaperSearchSettings
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.bodies import MeshcatSkin
from drake_pose.systems.diagrams import build_simulation
from drake_pose.systems.silhouette_matcher import SilhouetteMatcher
from tests.body.models import load_limb

X_WC = np.array([[0, 0, -1, 4.0], [1, 0, 0, 0], [0, -1, 0, 0.1], [0, 0, 0, 1.0]])
CAMERA = ParallelCamera("front", 200, 200, 180.0, 100.2, 100.1, X_WC)


@pytest.fixture
def limb(tmp_path):
    return load_limb(tmp_path)


class _Recorder:
    """Replaces Meshcat and records what it is sent."""

    def __init__(self) -> None:
        self.meshes: list[tuple[str, np.ndarray, np.ndarray]] = []
        self.visible: list[tuple[str, bool, float]] = []

    def SetTriangleMesh(self, path, vertices, faces, rgba):
        assert isinstance(rgba, Rgba)
        self.meshes.append((path, np.array(vertices), np.array(faces)))

    def SetProperty(self, path, name, value, time):
        assert name == "visible"
        self.visible.append((path, value, time))


@pytest.mark.parametrize("recorded", [False, True])
def test_meshcat_is_sent_the_bent_bands(limb, recorded):
    recorder = _Recorder()
    skin = ModelSkin(limb)
    drawer = MeshcatSkin(recorder, skin, 5, "body/skin", is_recorded=recorded)
    context = drawer.CreateDefaultContext()
    q = np.array([0.1, 1.2, 0.3, -0.4, 0.5])
    for time, positions in ((0.0, np.zeros(5)), (0.5, np.zeros(5)), (1.0, q)):
        context.SetTime(time)
        drawer.get_input_port().FixValue(context, positions)
        drawer.ForcedPublish(context)
    # Unchanged positions are not sent again.
    assert len(recorder.meshes) == 4
    for k, expected in enumerate([*skin.vertices(np.zeros(5)), *skin.vertices(q)]):
        path, vertices, faces = recorder.meshes[k]
        shape = f"/{k // 2}" if recorded else ""
        assert path == f"body/skin{shape}/{skin.bands[k % 2].child}"
        np.testing.assert_array_equal(vertices.T, expected)
        np.testing.assert_array_equal(faces.T, skin.bands[k % 2].mesh.triangles)
    assert len(recorder.visible) == (4 if recorded else 0)
    if recorded:
        seen = {(path, value) for path, value, time in recorder.visible if time == 1.0}
        assert seen == {("body/skin/0", False), ("body/skin/1", True)}


def test_a_simulated_camera_sees_the_skin(limb):
    """The matcher, whose bodies have skin, finds the true pose with E_total near 0."""
    search = PaperSearch(
        limb.pose_tree(), PaperSearchSettings(interval=0.6, outside_limit=3.0, candidate_limit=20)
    )
    truth = np.array([0.6, -1.2, 0.6, 0.0, -0.6])
    meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    matcher = SilhouetteMatcher(search, [CAMERA], 0.1)
    simulator = Simulator(build_simulation(matcher, limb, [CAMERA], truth, meshcat))
    simulator.AdvanceTo(0.15)
    context = simulator.get_context()
    sensor = simulator.get_system().GetSubsystemByName("camera_front")
    image = sensor.label_image_output_port().Eval(sensor.GetMyContextFromRoot(context))
    reference = LabelRenderer(limb, CAMERA).segments(truth)
    seen = image.data[..., 0]
    assert np.count_nonzero((seen < 32000) != (reference >= 0)) <= 3
    assert set(np.unique(seen[seen < 32000])) <= set(np.unique(reference))
    error = matcher.GetOutputPort("E_total").Eval(matcher.GetMyContextFromRoot(context))[0]
    assert error < 0.01
    for name in ("true", "estimated"):
        for child in ("lower", "hand"):
            assert meshcat.HasPath(f"{name}/skin/{child}")
