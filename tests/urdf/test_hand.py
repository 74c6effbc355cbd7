"""The bundled hands: published sizes, directions of the joints, and couplings."""

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.filtering.inequalities import model_inequalities
from tests.urdf.surfaces import URDF

FINGERS = ("index", "middle", "ring", "little")
HAND_LENGTH = 0.1872  # ANSUR II, mean of women's and men's means [m]
SPREAD = {
    "index_mcp_abduction": 15, "ring_mcp_abduction": 10, "little_mcp_abduction": 28,
    "thumb_cmc_flexion": -20,
}  # fmt: skip


@pytest.fixture(scope="module")
def both():
    return [load_model(URDF / f"hand/{name}.urdf", check=False) for name in ("hand", "right_hand")]


def posed(model, degrees):
    q = np.zeros(len(model.position_names))
    for name, value in degrees.items():
        q[model.position_index(name)] = np.radians(value)
    return q


def tip(model, finger, q):
    """The fingertip (3,) in the palm's frame."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, q)
    link = model.plant.GetBodyByName(f"{finger}_distal").body_frame()
    palm = model.plant.GetBodyByName("palm").body_frame()
    point = np.array([0.0, model.link_meshes[f"{finger}_distal"].vertices[:, 1].max(), 0.0])
    return model.plant.CalcPointsPositions(context, link, point, palm).ravel()


def test_joints_and_size_are_the_published_ones(both):
    hand, zero = both[0], posed(both[0], {})
    fingers = [f"{f}_{joint}" for f in FINGERS for joint in ("mcp", "pip", "dip")]
    thumb = ("thumb_cmc", "thumb_mcp", "thumb_ip")
    flexions = [f"{joint}_flexion" for joint in (*fingers, *thumb, "wrist")]
    others = [f"{f}_mcp_abduction" for f in FINGERS] + ["thumb_cmc_abduction", "wrist_deviation"]
    places = [f"{part}_{axis}" for part in ("forearm", "position") for axis in "xyz"]
    assert set(hand.position_names) == {*flexions, *others, *places}
    for name in flexions:  # Every joint bends both ways, and farther towards the palm.
        index = hand.position_index(name)
        assert -hand.upper[index] <= hand.lower[index] < 0.0
    tips = {finger: tip(hand, finger, zero)[1] for finger in FINGERS}
    assert tips["middle"] == pytest.approx(HAND_LENGTH, rel=0.002)
    # Index and ring finger end near the middle finger's last segment, the little one well below.
    for finger, low, high in (("index", 0.92, 0.96), ("ring", 0.91, 0.96), ("little", 0.76, 0.83)):
        assert low <= tips[finger] / HAND_LENGTH <= high


def test_positive_angles_bend_towards_the_palm_and_away_from_the_middle_finger(both):
    hand = both[0]
    rest = {finger: tip(hand, finger, posed(hand, {})) for finger in (*FINGERS, "thumb")}

    def moved(finger, joint, degrees):
        return tip(hand, finger, posed(hand, {f"{finger}_{joint}": degrees})) - rest[finger]

    for finger in FINGERS:
        for joint in ("mcp", "pip", "dip"):
            bent = moved(finger, f"{joint}_flexion", 30)
            assert bent[2] > 0.009
            assert bent[0] == pytest.approx(0.0, abs=1e-9)
        side = -1.0 if finger in ("index", "middle") else 1.0
        assert moved(finger, "mcp_abduction", 15)[0] * side > 0.015
    assert rest["thumb"][0] - rest["index"][0] < -0.02
    assert moved("thumb", "cmc_flexion", 35)[0] > 0.03
    assert moved("thumb", "cmc_abduction", 35)[2] > 0.03


def test_right_hand_mirrors_the_left(both):
    left, right = both
    assert left.position_names == right.position_names
    rng = np.random.default_rng(11)
    for _ in range(5):
        q = rng.uniform(left.lower, left.upper)
        for finger in (*FINGERS, "thumb"):
            mirrored = tip(left, finger, q) * [-1, 1, 1]
            np.testing.assert_allclose(tip(right, finger, q), mirrored, atol=1e-6)


def test_couplings_allow_a_fist_and_refuse_impossible_poses(both):
    flexed = {"mcp": 80, "pip": 100, "dip": 65}
    fist = {f"{f}_{joint}_flexion": angle for f in FINGERS for joint, angle in flexed.items()}
    pointing = {name: value for name, value in fist.items() if not name.startswith("index")}
    allowed = ({}, fist, SPREAD, {**pointing, "index_mcp_flexion": 15})
    spread = {"index_mcp_abduction": -10, "middle_mcp_abduction": 10}
    refused = ({"index_dip_flexion": 60}, spread, {"ring_mcp_flexion": 85})
    for hand in both:
        inequalities = model_inequalities(hand)
        for degrees in (*allowed, *refused):
            inside = np.all(inequalities.phi @ posed(hand, degrees) <= inequalities.b + 1e-9)
            assert inside == (degrees in allowed)
