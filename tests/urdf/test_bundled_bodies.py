"""The bundled woman and man: reproducible, closed, mirrored, jointed as in table 2, no gaps."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
    RenderLabel,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from tests.urdf.surfaces import winding_numbers
from tests.written_files import assert_same_files

URDF = Path(__file__).resolve().parents[2] / "urdf"
BODIES = ("woman", "man")
PIXELS_PER_METRE = 226.0  # Kameda: 1 cm = 2.26 pixels

# Kameda, Minoh and Ikeda, table 2: axes in order of rotation, limits in degrees.
TABLE_2 = {
    "head": "Y -90 90 Z -30 30 X -30 30",
    "chest": "Y -60 60 Z -30 30 X -30 30",
    "right_upper_arm": "X -180 20 Z -90 20 Y -20 90",
    "right_forearm": "X -160 0",
    "right_hand": "Y -90 90 Z -45 40 X -10 30",
    "left_upper_arm": "X -180 20 Z -20 90 Y -90 20",
    "left_forearm": "X -160 0",
    "left_hand": "Y -90 90 Z -40 45 X -10 30",
    "waist": "Y -50 50 Z -30 30 X -20 20",
    "right_thigh": "Y -50 20 Z -40 0 X -100 10",
    "right_shin": "X 0 120",
    "right_foot": "X -40 40 Y -40 0 Z -20 50",
    "left_thigh": "Y -20 50 Z 0 40 X -100 10",
    "left_shin": "X 0 120",
    "left_foot": "X -40 40 Y 0 40 Z -50 20",
}
PARENTS = {
    "chest": "head",
    "right_upper_arm": "chest",
    "right_forearm": "right_upper_arm",
    "right_hand": "right_forearm",
    "left_upper_arm": "chest",
    "left_forearm": "left_upper_arm",
    "left_hand": "left_forearm",
    "waist": "chest",
    "right_thigh": "waist",
    "right_shin": "right_thigh",
    "right_foot": "right_shin",
    "left_thigh": "waist",
    "left_shin": "left_thigh",
    "left_foot": "left_shin",
}
# A ball of this radius [m] round each joint lies in the parent and in the child: whatever the
# joint's angles, the ball joins the two.
JOINT_BALLS = {
    "chest": 0.010,
    "upper_arm": 0.015,
    "forearm": 0.028,
    "hand": 0.013,
    "waist": 0.045,
    "thigh": 0.055,
    "shin": 0.042,
    "foot": 0.022,
}


class Figure:
    """A body in a scene graph with a renderer."""

    def __init__(self, name: str):
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        Parser(self.plant).AddModels(str(URDF / name / f"{name}.urdf"))
        self.plant.Finalize()
        self.scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        self.plant_context = self.plant.GetMyContextFromRoot(self.context)

    def labels(self, q: np.ndarray, towards: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return labels (500, 500), seen from far away in direction towards (3,), 160 px/m."""
        self.plant.SetPositions(self.plant_context, q)
        z = -towards / np.linalg.norm(towards)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        X_WC = RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])))
        X_WC.set_translation(target - 1000.0 * z)
        info = CameraInfo(500, 500, 160e3, 160e3, 249.5, 249.5)
        core = RenderCameraCore("vtk", info, ClippingRange(998.0, 1002.0), RigidTransform())
        query = self.scene_graph.get_query_output_port().Eval(
            self.scene_graph.GetMyContextFromRoot(self.context)
        )
        image = query.RenderLabelImage(
            ColorRenderCamera(core), self.scene_graph.world_frame_id(), X_WC
        )
        return image.data[:, :, 0].copy()


@pytest.fixture(scope="module", params=BODIES)
def figure(request: pytest.FixtureRequest) -> tuple[str, Figure]:
    return request.param, Figure(request.param)


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, normals and triangles of an OBJ that indexes both alike."""
    vertices, normals, triangles = [], [], []
    for line in path.read_text().splitlines():
        kind, *rest = line.split()
        if kind == "v":
            vertices.append([float(value) for value in rest])
        elif kind == "vn":
            normals.append([float(value) for value in rest])
        elif kind == "f":
            corners = [corner.split("//") for corner in rest]
            assert all(vertex == normal for vertex, normal in corners)
            triangles.append([int(vertex) - 1 for vertex, _ in corners])
    return np.array(vertices), np.array(normals), np.array(triangles)


def mesh_of(name: str, link: str) -> trimesh.Trimesh:
    vertices, _, triangles = read_obj(URDF / name / "meshes" / f"{link}.obj")
    return trimesh.Trimesh(vertices, triangles, process=False)


def silhouette_area_changed(mesh: trimesh.Trimesh, first: float, second: float) -> float:
    """Return the XOR [pixels] of two silhouettes seen along z, turned by degrees about y."""
    fine = 4
    masks = []
    for degrees in (first, second):
        turn = RotationMatrix.MakeYRotation(np.radians(degrees)).matrix()
        points = mesh.vertices @ turn.T * PIXELS_PER_METRE * fine + [300.0, 500.0, 0.0]
        mask = np.zeros((640, 600), np.uint8)
        for triangle in np.round(points[mesh.faces][:, :, :2]).astype(np.int32):
            cv2.fillConvexPoly(mask, triangle, 1)
        masks.append(mask)
    return float(np.count_nonzero(masks[0] != masks[1])) / fine**2


@pytest.mark.parametrize("name", BODIES)
def test_script_writes_the_committed_files(name: str, tmp_path: Path) -> None:
    script = URDF / name / f"make_{name}.py"
    subprocess.run([sys.executable, "-B", str(script), "--out", str(tmp_path)], check=True)
    written = {p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file()}
    committed = {p.relative_to(URDF / name) for p in (URDF / name).glob(f"{name}.*")}
    committed |= {p.relative_to(URDF / name) for p in (URDF / name / "meshes").iterdir()}
    assert written == committed
    assert_same_files(tmp_path, URDF / name)


@pytest.mark.slow
def test_stature_scales_the_body(tmp_path: Path) -> None:
    script = URDF / "woman" / "make_woman.py"
    command = [sys.executable, "-B", str(script), "--out", str(tmp_path), "--stature", "1.8"]
    subprocess.run(command, check=True)
    tall = read_obj(tmp_path / "meshes" / "left_shin.obj")[0]
    mean = read_obj(URDF / "woman" / "meshes" / "left_shin.obj")[0]
    np.testing.assert_allclose(tall, mean * 1.8 / 1.6285, atol=2e-5)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("link", TABLE_2)
def test_shells_are_closed_and_face_outwards(name: str, link: str) -> None:
    vertices, normals, triangles = read_obj(URDF / name / "meshes" / f"{link}.obj")
    assert 300 <= len(triangles) <= 1500
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=2e-3)
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    assert np.all(mesh.area_faces > 0.0)
    for shell in mesh.split(only_watertight=False):
        assert shell.is_watertight
        assert shell.is_winding_consistent
        assert shell.volume > 0.0
    corner_normals = normals[triangles].mean(axis=1)
    agree = np.einsum("ij,ij->i", corner_normals, mesh.face_normals) > 0.0
    assert agree.mean() > 0.99


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("link", [link for link in TABLE_2 if link.startswith("left_")])
def test_right_is_the_mirror_image_of_left(name: str, link: str) -> None:
    left = mesh_of(name, link)
    right = mesh_of(name, link.replace("left_", "right_"))
    np.testing.assert_array_equal(right.vertices, left.vertices * [-1.0, 1.0, 1.0])
    assert right.volume == pytest.approx(left.volume)


def test_limits_are_those_of_table_2(figure: tuple[str, Figure]) -> None:
    plant = figure[1].plant
    assert plant.num_positions() == 3 + sum(len(row.split()) // 3 for row in TABLE_2.values())
    for link, row in TABLE_2.items():
        words = row.split()
        parent = PARENTS.get(link, "root_axes_link")
        for index in range(0, len(words), 3):
            axis, lower, upper = words[index], float(words[index + 1]), float(words[index + 2])
            joint = plant.GetJointByName(f"{link}_{axis.lower()}")
            assert joint.parent_body().name() == parent
            parent = joint.child_body().name()
            limits = np.degrees([joint.position_lower_limit(), joint.position_upper_limit()])
            np.testing.assert_allclose(limits, [lower, upper], atol=1e-12)
            np.testing.assert_array_equal(joint.revolute_axis(), np.eye(3)["XYZ".index(axis)])
        assert parent == link


def test_link_axes_are_the_papers_when_standing(figure: tuple[str, Figure]) -> None:
    name, body = figure
    plant, context = body.plant, body.plant_context
    plant.SetPositions(context, np.zeros(plant.num_positions()))
    for link in TABLE_2:
        R_WL = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(link)).rotation().matrix()
        np.testing.assert_allclose(R_WL, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)
    points = []
    for link in TABLE_2:
        X_WL = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(link))
        points.append(X_WL.multiply(mesh_of(name, link).vertices.T).T)
    height = np.ptp(np.concatenate(points)[:, 2])
    stature = {"woman": 1.6285, "man": 1.7562}[name]
    assert stature <= height <= stature + 0.02  # the hair stands above the crown
    assert np.max(points[0][:, 0]) > 0.10  # the nose points along the world's x
    left_hand = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("left_hand"))
    assert left_hand.translation()[1] > 0.15


def test_masses_make_a_valid_simulation(figure: tuple[str, Figure]) -> None:
    name, body = figure
    mass = body.plant.CalcTotalMass(body.plant_context)
    assert mass == pytest.approx({"woman": 67.76, "man": 85.52}[name], rel=0.01)
    for link in TABLE_2:
        inertia = body.plant.GetBodyByName(link).default_spatial_inertia()
        assert inertia.IsPhysicallyValid()
    body.plant.SetPositions(body.plant_context, np.zeros(body.plant.num_positions()))
    mass_matrix = body.plant.CalcMassMatrix(body.plant_context)
    assert np.linalg.eigvalsh(mass_matrix)[0] > 0.0


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("link", PARENTS)
def test_a_ball_round_each_joint_is_in_both_segments(name: str, link: str) -> None:
    plant = Figure(name).plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.zeros(plant.num_positions()))
    parent = plant.GetBodyByName(PARENTS[link]).body_frame()
    X_PL = plant.GetBodyByName(link).body_frame().CalcPose(context, parent)
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ball = JOINT_BALLS[link.removeprefix("left_").removeprefix("right_")] * directions
    assert np.min(winding_numbers(mesh_of(name, link), ball)) > 0.5
    in_parent = winding_numbers(mesh_of(name, PARENTS[link]), ball + X_PL.translation())
    assert np.min(in_parent) > 0.5


def test_no_pose_falls_apart(figure: tuple[str, Figure]) -> None:
    _, body = figure
    rng = np.random.default_rng(5)
    lower, upper = body.plant.GetPositionLowerLimits(), body.plant.GetPositionUpperLimits()
    for _ in range(25):
        q = rng.uniform(lower, upper)
        q[:3] = 0.0
        towards = rng.normal(size=3) * [1.0, 1.0, 0.3]
        labels = body.labels(q, towards, np.array([0.0, 0.0, -0.5]))
        assert len(np.unique(labels)) > 5
        mask = (labels != int(RenderLabel.kEmpty)).astype(np.uint8)
        assert not mask[0].any()
        assert not mask[-1].any()
        count, _ = cv2.connectedComponents(mask, connectivity=8)
        assert count == 2  # the background and one body


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("link", ["upper_arm", "forearm", "hand", "thigh", "shin", "foot"])
def test_no_limb_is_rotationally_symmetric(name: str, link: str) -> None:
    mesh = mesh_of(name, f"left_{link}")
    changes = [silhouette_area_changed(mesh, turn, turn + 20.0) for turn in range(0, 180, 20)]
    assert min(changes) >= 10.0
    assert float(np.mean(changes)) >= 20.0


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("link", ["head", "chest", "waist"])
def test_front_and_back_differ(name: str, link: str) -> None:
    mesh = mesh_of(name, link)
    assert silhouette_area_changed(mesh, 90.0, 270.0) >= 50.0


def test_files_stay_small() -> None:
    total = sum(p.stat().st_size for name in BODIES for p in (URDF / name).rglob("*.*"))
    assert total < 3e6
