"""Bodies posed by positions, their skin in sensors and Meshcat, and positions as messages."""

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from drake_pose.body import ModelSkin
from drake_pose.camera.models import ParallelCamera
from drake_pose.search import PaperSearch, PaperSearchSettings
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.bodies import MeshcatSkin, RobotStateMessage, body_poses, held_positions
from drake_pose.systems.diagrams import build_simulation
from drake_pose.systems.silhouette_matcher import SilhouetteMatcher
from tests.body.models import load_limb
from tests.systems.bench import Bench

X_WC = np.array([[0, 0, -1, 4.0], [1, 0, 0, 0], [0, -1, 0, 0.1], [0, 0, 0, 1.0]])
CAMERA = ParallelCamera("front", 200, 200, 180.0, 100.2, 100.1, X_WC)


def test_positions_are_named_in_a_message(body):
    names = body.position_names
    run = Bench(RobotStateMessage(names)).give(positions=[0.1, 0.4, -0.4])
    for time in (0.0, 7 / 30):
        run.context.SetTime(time)
        message = run["lcmt_robot_state"]
        assert (message.utime, message.num_joints) == (round(1e6 * time), 3)
        assert message.joint_name == list(names)
        np.testing.assert_allclose(message.joint_position, [0.1, 0.4, -0.4], atol=1e-6)


def test_positions_are_held_around_their_time():
    q = np.array([[1.0, -1.0], [2.0, 5.0], [4.0, 0.0]])
    held = held_positions(q, 0.2)
    for k, row in enumerate(q):
        for fraction in (-0.49, 0.0, 0.49):
            np.testing.assert_array_equal(held.value(0.2 * (k + fraction)).ravel(), row)


def test_body_poses_move_with_the_base(body):
    plant, q, X_WB = body.plant, np.array([0.1, 0.4, -0.4]), RigidTransform([1.0, 2.0, 3.0])
    for pose, moved in zip(body_poses(plant, q), body_poses(plant, q, X_WB), strict=True):
        assert moved.IsNearlyEqualTo(X_WB @ pose, 1e-12)


class Recorder:
    """Replaces Meshcat and records what it is sent."""

    def __init__(self):
        self.meshes, self.visible = [], []

    def SetTriangleMesh(self, path, vertices, faces, rgba):
        self.meshes.append((path, np.array(vertices), np.array(faces)))

    def SetProperty(self, path, name, value, time):
        self.visible.append((path, name, value, time))


@pytest.mark.parametrize("recorded", [False, True])
def test_meshcat_is_sent_the_bent_bands(tmp_path, recorded):
    recorder, skin = Recorder(), ModelSkin(load_limb(tmp_path))
    drawer = MeshcatSkin(recorder, skin, 5, "body/skin", is_recorded=recorded)
    run, q = Bench(drawer), np.array([0.1, 1.2, 0.3, -0.4, 0.5])
    for time, positions in ((0.0, 0.0 * q), (0.5, 0.0 * q), (1.0, q)):
        run.update(time, positions=positions)
    # Unchanged positions are not sent again.
    assert len(recorder.meshes) == 4
    for k, expected in enumerate([*skin.vertices(0.0 * q), *skin.vertices(q)]):
        path, vertices, faces = recorder.meshes[k]
        shape = f"/{k // 2}" if recorded else ""
        assert path == f"body/skin{shape}/{skin.bands[k % 2].child}"
        np.testing.assert_array_equal(vertices.T, expected)
        np.testing.assert_array_equal(faces.T, skin.bands[k % 2].mesh.triangles)
    # In a recording a shape is visible from its time to that of the next.
    zero, one = "body/skin/0", "body/skin/1"
    shown = [(zero, True, 0.0), (zero, False, 1.0), (one, False, 0.0), (one, True, 1.0)]
    expected = [(path, "visible", value, time) for path, value, time in shown]
    assert recorder.visible == (expected if recorded else [])


def test_a_simulated_camera_sees_the_skin(tmp_path):
    """The matcher, whose bodies have skin, finds the true pose with E_total near 0."""
    limb = load_limb(tmp_path)
    settings = PaperSearchSettings(interval=0.6, outside_limit=3.0, candidate_limit=20)
    matcher = SilhouetteMatcher(PaperSearch(limb.pose_tree(), settings), [CAMERA], 0.1)
    truth, meshcat = np.array([0.6, -1.2, 0.6, 0.0, -0.6]), Meshcat(MeshcatParams(port=0))
    simulator = Simulator(build_simulation(matcher, limb, [CAMERA], truth, meshcat))
    simulator.AdvanceTo(0.15)
    context = simulator.get_context()
    sensor = simulator.get_system().GetSubsystemByName("camera_front")
    image = sensor.label_image_output_port().Eval(sensor.GetMyContextFromRoot(context))
    reference, seen = LabelRenderer(limb, CAMERA).segments(truth), image.data[..., 0]
    assert np.count_nonzero((seen < 32000) != (reference >= 0)) <= 3
    assert set(np.unique(seen[seen < 32000])) <= set(np.unique(reference))
    assert Bench(matcher, matcher.GetMyContextFromRoot(context))["E_total"] < 0.01
    assert all(meshcat.HasPath(f"{name}/skin/hand") for name in ("true", "estimated"))
    opacity = meshcat._GetPackedProperty("estimated", "modulated_opacity")
    assert np.frombuffer(opacity[-8:], ">f8") == 0.5
