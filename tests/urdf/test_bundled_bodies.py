"""The bundled models: reproducible, closed, mirrored, with the papers' joints, without gaps."""

import itertools
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from drake_pose.body import load_model, model_warnings
from tests.urdf.surfaces import URDF, Silhouettes, assert_closed, committed, read_obj, written_again
from tests.written_files import assert_same_files

BODIES = ("woman", "man")
# Total mass [kg], and width of the picture that shows every pose [m].
MODELS = {
    "woman/woman": (67.76, 3.2),
    "man/man": (85.52, 3.2),
    "hand/hand": (1.804, 0.7),
    "hand/right_hand": (1.804, 0.7),
    "person/person": (76.64, 3.6),
    "person/person_shape": (76.64, 3.6),
}
MESHES = sorted(URDF.glob("*/meshes/*.obj"))

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
LIMBS = ("chest upper_arm forearm hand", "waist thigh shin foot")
PARENTS = {"chest": "head", "waist": "chest"} | {
    f"{side}_{child}": parent if parent in ("chest", "waist") else f"{side}_{parent}"
    for side in ("left", "right")
    for limb in LIMBS
    for parent, child in itertools.pairwise(limb.split())
}


@cache
def load(name):
    return load_model(URDF / f"{name}.urdf", check=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*BODIES, "hand", "person", "two_finger_hand"])
def test_script_writes_the_committed_files(name, tmp_path):
    by_hand = {Path("landmarks.yaml")} if name in BODIES else set()
    assert set(written_again(name, tmp_path)) == set(committed(name)) - by_hand
    assert_same_files(tmp_path, URDF / name)


@pytest.mark.parametrize("path", MESHES, ids=lambda path: f"{path.parts[-3]}-{path.stem}")
def test_surfaces_are_closed_have_few_triangles_and_are_mirrored(path):
    mesh = read_obj(path)
    assert_closed(mesh)
    if path.parts[-3] != "person":
        assert (100 if path.stem.endswith("_skin") else 200) <= len(mesh.faces) <= 1500
        if path.stem.startswith("left_"):
            right = read_obj(path.with_name(path.name.replace("left_", "right_")))
            np.testing.assert_array_equal(right.vertices, mesh.vertices * [-1.0, 1.0, 1.0])
            assert right.volume == pytest.approx(mesh.volume)


@pytest.mark.parametrize("name", MODELS)
def test_masses_are_valid_and_silhouettes_are_connected_in_every_pose(name):
    model, (mass, size) = load(name), MODELS[name]
    context = model.plant.CreateDefaultContext()
    assert model.plant.CalcTotalMass(context) == pytest.approx(mass, rel=0.01)
    model.plant.SetPositions(context, np.zeros(len(model.position_names)))
    assert np.linalg.eigvalsh(model.plant.CalcMassMatrix(context))[0] > 0.0
    silhouettes = Silhouettes(model)
    target = np.array([0.0, 0.0, 0.0 if "hand" in name else -0.5])
    rng = np.random.default_rng(7)
    stretched = [one.endswith("_stretch") for one in model.position_names]
    for index in range(12):
        q = rng.uniform(model.lower, model.upper)
        if index < 4:  # The ends of what is said of lengths, one way and the other.
            q = np.where(stretched, model.upper if index % 2 else model.lower, q)
        q[: 6 if "hand" in name else 3] = 0.0
        mask = silhouettes.mask(q, rng.normal(size=3) * [1, 1, 0.3], target, size)
        assert cv2.connectedComponents(mask.astype(np.uint8))[0] == 2
        assert not np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).any()


@pytest.mark.parametrize("name", BODIES)
def test_limits_are_those_of_table_2(name):
    plant = load(f"{name}/{name}").plant
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
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.zeros(plant.num_positions()))
    for link in TABLE_2:  # The links' axes are the paper's.
        R_WL = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(link)).rotation().matrix()
        np.testing.assert_allclose(R_WL, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)
    model = load(f"{name}/{name}")
    assert not any("symmetry" in one for one in model_warnings(model, model.pose_tree()))
