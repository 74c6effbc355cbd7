"""The bundled person: 23 degrees of freedom, coloured for skin blobs, and its shape joints."""

import itertools

import numpy as np
import pytest

from drake_pose.body import landmark_positions, load_landmarks, load_model
from tests.urdf.surfaces import URDF, Silhouettes, read_obj, written_again

SIDES = ("left_", "right_")
PARTS = (
    ("upper_arm", "shoulder", "elbow"),
    ("forearm", "elbow", "wrist"),
    ("thigh", "hip", "knee"),
    ("shin", "knee", "ankle"),
)


def random_pose(model, rng):
    q = rng.uniform(model.lower, model.upper)
    q[:3] = 0.0
    q[[name.endswith("_stretch") for name in model.position_names]] = 0.0
    return q


def marks(model, q):
    landmarks = load_landmarks(model.path)
    return dict(zip(landmarks, landmark_positions(model, landmarks, q), strict=True))


def distance(found, a, b):
    return float(np.linalg.norm(found[a] - found[b]))


def moved(model, name, degrees, landmark):
    """By how much a joint moves a landmark of the upright person."""
    q = np.zeros(len(model.position_names))
    q[model.position_index(name)] = np.radians(degrees)
    return np.asarray(marks(model, q)[landmark] - marks(model, 0.0 * q)[landmark])


@pytest.mark.slow
def test_script_changes_lengths_and_girths(person, tmp_path):
    written_again("person", tmp_path, "--lengths", "thigh=1.1", "--girths", "thigh=0.9")
    other = load_model(tmp_path / "person.urdf", check=False)
    before, after = marks(person, np.zeros(23)), marks(other, np.zeros(23))
    for side, (a, b, factor) in itertools.product(
        SIDES, (("hip", "knee", 1.1), ("knee", "ankle", 1.0))
    ):
        names = (side + a, side + b)
        assert distance(after, *names) == pytest.approx(factor * distance(before, *names))
    sizes = [
        np.ptp(read_obj(folder / "meshes" / "left_thigh.obj").vertices, axis=0)
        for folder in (URDF / "person", tmp_path)
    ]
    np.testing.assert_allclose(sizes[1] / sizes[0], [0.9, 1.1, 0.9], atol=0.01)


def test_degrees_of_freedom_are_those_of_figure_5_and_limits_are_mirrored(person):
    """Date et al., figure 5: head 3 + 2, neck base 2, shoulders 3, elbows 1, hips 3, knees 1."""
    rows = ["position x y z", "head y x", "neck_base x z"]
    for side in SIDES:
        rows += [
            f"{side}upper_arm x z y",
            f"{side}forearm x",
            f"{side}thigh y z x",
            f"{side}shin x",
        ]
    split = [row.split() for row in rows]
    wanted = {f"{part}_{axis}" for part, *axes in split for axis in axes}
    assert (len(person.position_names), set(person.position_names)) == (23, wanted)
    for name in wanted:
        left, right = person.position_index(name), person.position_index(name.replace(*SIDES))
        ends = [person.lower[left], person.upper[left]]
        if name.startswith("left_") and not name.endswith("_x"):
            ends = [-ends[1], -ends[0]]
        np.testing.assert_allclose([person.lower[right], person.upper[right]], ends)


def test_directions_of_positive_angles(person, shaped_person):
    for name, degrees, landmark, axis, least in (
        ("left_upper_arm_x", -60, "left_wrist", 0, 0.3),  # forward
        ("left_upper_arm_z", 60, "left_wrist", 1, 0.3),  # out to the left
        ("right_upper_arm_z", -60, "right_wrist", 1, -0.3),
        ("left_forearm_x", -90, "left_wrist", 0, 0.15),
        ("left_thigh_x", -60, "left_knee", 0, 0.25),
        ("left_shin_x", 90, "left_ankle", 0, -0.25),
        ("neck_base_x", 40, "left_hip", 0, -0.2),  # the hips go back: leaning forward
        ("head_x", 40, "head_top", 0, 0.05),  # looking down
        ("waist_x", -40, "left_hip", 0, 0.1),  # the spine bends forward
        ("left_clavicle_z", 20, "left_shoulder", 2, 0.04),  # shrugged
        ("right_clavicle_z", -20, "right_shoulder", 2, 0.04),
        ("left_clavicle_y", -20, "left_shoulder", 0, 0.03),  # forward
        ("right_clavicle_y", 20, "right_shoulder", 0, 0.03),
    ):
        model = person if name in person.position_names else shaped_person
        assert moved(model, name, degrees, landmark)[axis] / least > 1.0, name
    for name, landmark in (("waist_x", "left_shoulder"), ("left_hand_z", "left_wrist")):
        assert moved(shaped_person, name, -40, landmark) == pytest.approx(0.0)


def test_shape_model_at_zero_is_the_plain_person(person, shaped_person):
    rng = np.random.default_rng(5)
    pictures = Silhouettes(person), Silhouettes(shaped_person)
    for _ in range(6):
        q, whole = random_pose(person, rng), np.zeros(len(shaped_person.position_names))
        for name, value in zip(person.position_names, q, strict=True):
            whole[shaped_person.position_index(name)] = value
        for name, point in marks(person, q).items():
            np.testing.assert_allclose(marks(shaped_person, whole)[name], point, atol=1e-6)
        view = rng.normal(size=3) * [1, 1, 0.3], np.array([0, 0, -0.6]), 2.6
        masks = [pictures[0].mask(q, *view), pictures[1].mask(whole, *view)]
        assert np.count_nonzero(masks[0] != masks[1]) <= 0.002 * np.count_nonzero(masks[0])


def test_shape_joints_change_the_lengths_by_their_values(shaped_person):
    q = random_pose(shaped_person, np.random.default_rng(6))
    before = marks(shaped_person, q)
    for side, (part, begin, close) in itertools.product(SIDES, PARTS):
        ends, longer = (side + begin, side + close), q.copy()
        longer[shaped_person.position_index(f"{side}{part}_stretch")] = 0.02
        change = distance(marks(shaped_person, longer), *ends) - distance(before, *ends)
        assert change == pytest.approx(0.02, abs=1e-6)
