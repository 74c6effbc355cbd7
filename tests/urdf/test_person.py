"""The bundled person: 23 degrees of freedom, coloured for skin blobs, and its shape joints."""

import itertools

import numpy as np
import pytest

from drake_pose.body import landmark_positions, load_landmarks, load_model
from drake_pose.filtering.inequalities import model_inequalities
from tests.urdf.surfaces import URDF, Silhouettes, read_obj, written_again

PERSON = URDF / "person" / "person.urdf"
SHAPE = URDF / "person" / "person_shape.urdf"
SIDES = ("left_", "right_")
PARTS = (
    ("upper_arm", "shoulder", "elbow"),
    ("forearm", "elbow", "wrist"),
    ("thigh", "hip", "knee"),
    ("shin", "knee", "ankle"),
)


@pytest.fixture(scope="module")
def shape():
    return load_model(SHAPE, check=False)


def same_angles(person, shape, q):
    """The shape model's positions at the plain model's q, its own at zero."""
    whole = np.zeros(len(shape.position_names))
    for name, value in zip(person.position_names, q, strict=True):
        whole[shape.position_index(name)] = value
    return whole


def random_pose(model, rng):
    q = rng.uniform(model.lower, model.upper)
    q[:3] = 0.0
    q[[name.endswith("_stretch") for name in model.position_names]] = 0.0
    return q


def marks(model, q):
    landmarks = load_landmarks(model.path)
    return dict(zip(landmarks, landmark_positions(model, landmarks, q), strict=True))


def test_script_changes_lengths_and_girths(person, tmp_path):
    written_again("person", tmp_path, "--lengths", "thigh=1.1", "--girths", "thigh=0.9")
    other = load_model(tmp_path / "person.urdf", check=False)
    zero = np.zeros(23)
    before, after = marks(person, zero), marks(other, zero)

    def distance(found, a, b):
        return float(np.linalg.norm(found[a] - found[b]))

    for side in ("left", "right"):
        for a, b, factor in (("hip", "knee", 1.1), ("knee", "ankle", 1.0)):
            names = (f"{side}_{a}", f"{side}_{b}")
            assert distance(after, *names) == pytest.approx(factor * distance(before, *names))
    sizes = [
        np.ptp(read_obj(folder / "meshes" / "left_thigh.obj").vertices, axis=0)
        for folder in (URDF / "person", tmp_path)
    ]
    np.testing.assert_allclose(sizes[1] / sizes[0], [0.9, 1.1, 0.9], atol=0.01)


def test_degrees_of_freedom_are_those_of_figure_5_and_limits_are_mirrored(
    person,
):
    """Date et al., figure 5: head 3 + 2, neck base 2, shoulders 3, elbows 1, hips 3, knees 1."""
    rows = ["position x y z", "head y x", "neck_base x z"]
    for side in ("left", "right"):
        rows += [f"{side}_upper_arm x z y", f"{side}_forearm x", f"{side}_thigh y z x"]
        rows += [f"{side}_shin x"]
    split = [row.split() for row in rows]
    wanted = {f"{part}_{axis}" for part, *axes in split for axis in axes}
    assert (len(person.position_names), set(person.position_names)) == (23, wanted)
    for name in wanted:
        left, right = person.position_index(name), person.position_index(name.replace(*SIDES))
        ends = [person.lower[left], person.upper[left]]
        if name.startswith("left_") and not name.endswith("_x"):
            ends = [-ends[1], -ends[0]]
        np.testing.assert_allclose([person.lower[right], person.upper[right]], ends)
    assert not person.upper[person.position_index("left_forearm_x")]
    assert not person.lower[person.position_index("left_shin_x")]


def test_directions_of_positive_angles(person):
    rest = marks(person, np.zeros(23))

    def moved(name, degrees, landmark):
        q = np.zeros(23)
        q[person.position_index(name)] = np.radians(degrees)
        return np.asarray(marks(person, q)[landmark] - rest[landmark])

    assert moved("left_upper_arm_x", -60, "left_wrist")[0] > 0.3  # forward
    assert moved("left_upper_arm_z", 60, "left_wrist")[1] > 0.3  # out to the left
    assert moved("right_upper_arm_z", -60, "right_wrist")[1] < -0.3
    assert moved("left_forearm_x", -90, "left_wrist")[0] > 0.15
    assert moved("left_thigh_x", -60, "left_knee")[0] > 0.25
    assert moved("left_shin_x", 90, "left_ankle")[0] < -0.25
    assert moved("neck_base_x", 40, "left_hip")[0] < -0.2  # the hips go back: leaning forward
    assert moved("head_x", 40, "head_top")[0] > 0.05  # looking down


def test_shape_model_at_zero_is_the_plain_person(person, shape):
    rng = np.random.default_rng(5)
    pictures = Silhouettes(person), Silhouettes(shape)
    for _ in range(6):
        q = random_pose(person, rng)
        whole = same_angles(person, shape, q)
        for name, point in marks(person, q).items():
            np.testing.assert_allclose(marks(shape, whole)[name], point, atol=1e-6)
        towards = rng.normal(size=3) * [1, 1, 0.3]
        view = (towards, np.array([0, 0, -0.6]), 2.6)
        masks = [pictures[0].mask(q, *view), pictures[1].mask(whole, *view)]
        assert np.count_nonzero(masks[0] != masks[1]) <= 0.002 * np.count_nonzero(masks[0])


def test_joints_of_the_shape_model_are_mirrored_and_turn_the_right_way(shape):
    rest = marks(shape, np.zeros(len(shape.position_names)))

    def moved(name, degrees, landmark):
        q = np.zeros(len(shape.position_names))
        q[shape.position_index(name)] = np.radians(degrees)
        return np.asarray(marks(shape, q)[landmark] - rest[landmark])

    assert moved("waist_x", -40, "left_hip")[0] > 0.1  # forward: the spine bends forward
    assert moved("waist_x", -40, "left_shoulder") == pytest.approx(0.0)
    for side, sign in zip(SIDES, (1, -1), strict=True):
        assert moved(f"{side}clavicle_z", 20 * sign, f"{side}shoulder")[2] > 0.04  # shrugged
        assert moved(f"{side}clavicle_y", -20 * sign, f"{side}shoulder")[0] > 0.03  # forward
        assert moved(f"{side}hand_z", 60, f"{side}wrist") == pytest.approx(0.0)


def test_shape_joints_change_the_lengths_by_their_values(shape):
    rng = np.random.default_rng(6)
    q = random_pose(shape, rng)
    before = marks(shape, q)
    for side, (part, begin, close) in itertools.product(SIDES, PARTS):
        start, end = side + begin, side + close
        longer = q.copy()
        longer[shape.position_index(f"{side}{part}_stretch")] = 0.02
        after = marks(shape, longer)
        change = np.linalg.norm(after[end] - after[start])
        change -= np.linalg.norm(before[end] - before[start])
        assert change == pytest.approx(0.02, abs=1e-6)


def test_couplings_bound_the_difference_of_both_sides(shape):
    inequalities = model_inequalities(shape)
    q = np.zeros(len(shape.position_names))
    assert np.all(inequalities.margins(q) >= 0.0)
    q[shape.position_index("left_thigh_stretch")] = 0.012
    assert np.any(inequalities.margins(q) < 0.0)
    q[shape.position_index("right_thigh_stretch")] = 0.005
    assert np.all(inequalities.margins(q) >= 0.0)
