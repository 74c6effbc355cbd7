"""The bundled hands: published sizes, joints, limits and couplings."""

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.filtering.inequalities import model_inequalities
from tests.urdf.surfaces import URDF

FINGERS = ("index", "middle", "ring", "little")
HANDS = ("hand", "right_hand")
HAND_LENGTH = 0.1872  # ANSUR II, mean of women's and men's means [m]
THUMB = ("thumb_cmc", "thumb_mcp", "thumb_ip")
SPREAD = {
    "index_mcp_abduction": 15,
    "ring_mcp_abduction": 10,
    "little_mcp_abduction": 28,
    "thumb_cmc_flexion": -20,
}


@pytest.fixture(scope="module", params=HANDS)
def hand(request):
    return load_model(URDF / "hand" / f"{request.param}.urdf", check=False)


@pytest.fixture(scope="module")
def both():
    left, right = (load_model(URDF / "hand" / f"{name}.urdf", check=False) for name in HANDS)
    return left, right


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


def test_joints_and_limits(hand):
    fingers = [f"{f}_{joint}" for f in FINGERS for joint in ("mcp", "pip", "dip")]
    flexions = [f"{joint}_flexion" for joint in (*fingers, *THUMB, "wrist")]
    others = [f"{f}_mcp_abduction" for f in FINGERS] + ["thumb_cmc_abduction", "wrist_deviation"]
    places = [f"{part}_{axis}" for part in ("forearm", "position") for axis in "xyz"]
    assert set(hand.position_names) == {*flexions, *others, *places}
    for name in flexions:  # Every joint bends both ways, and farther towards the palm.
        index = hand.position_index(name)
        assert -hand.upper[index] <= hand.lower[index] < 0.0
    tree = hand.pose_tree()
    for finger in FINGERS:
        for outer, inner in (("distal", "middle"), ("middle", "proximal")):
            node = tree.nodes[tree.node_index(f"{finger}_{outer}")]
            assert tree.nodes[node.parent].name == f"{finger}_{inner}"


def test_size_is_the_published_one(both):
    left = both[0]
    zero = posed(left, {})
    tips = {finger: tip(left, finger, zero)[1] for finger in FINGERS}
    assert tips["middle"] == pytest.approx(HAND_LENGTH, rel=0.002)
    # Index and ring finger end near the middle finger's last segment, the little one well below.
    assert 0.92 <= tips["index"] / HAND_LENGTH <= 0.96
    assert 0.91 <= tips["ring"] / HAND_LENGTH <= 0.96
    assert 0.76 <= tips["little"] / HAND_LENGTH <= 0.83


def test_positive_angles_bend_towards_the_palm_and_away_from_the_middle_finger(
    hand,
):
    thumb_side = -1.0 if hand.name == "hand" else 1.0
    rest = {finger: tip(hand, finger, posed(hand, {})) for finger in (*FINGERS, "thumb")}
    for finger in FINGERS:
        for joint in ("mcp", "pip", "dip"):
            bent = tip(hand, finger, posed(hand, {f"{finger}_{joint}_flexion": 30}))
            assert bent[2] > rest[finger][2] + 0.009
            assert bent[0] == pytest.approx(rest[finger][0], abs=1e-9)
        spread = tip(hand, finger, posed(hand, {f"{finger}_mcp_abduction": 15}))
        side = thumb_side if finger in ("index", "middle") else -thumb_side
        assert (spread[0] - rest[finger][0]) * side > 0.015
    assert (rest["thumb"][0] - rest["index"][0]) * thumb_side > 0.02
    closed = tip(hand, "thumb", posed(hand, {"thumb_cmc_flexion": 35}))
    assert (closed[0] - rest["thumb"][0]) * thumb_side < -0.03
    raised = tip(hand, "thumb", posed(hand, {"thumb_cmc_abduction": 35}))
    assert raised[2] > rest["thumb"][2] + 0.03


def test_right_hand_mirrors_the_left(both):
    left, right = both
    rng = np.random.default_rng(11)
    for _ in range(5):
        q = rng.uniform(left.lower, left.upper)
        for finger in (*FINGERS, "thumb"):
            np.testing.assert_allclose(
                tip(right, finger, q), tip(left, finger, q) * [-1, 1, 1], atol=1e-6
            )


def test_couplings_allow_a_fist_and_refuse_impossible_poses(hand):
    inequalities = model_inequalities(hand)

    def allowed(degrees):
        return bool(np.all(inequalities.phi @ posed(hand, degrees) <= inequalities.b + 1e-9))

    fist = {
        f"{finger}_{joint}_flexion": angle
        for finger in FINGERS
        for joint, angle in (("mcp", 80), ("pip", 100), ("dip", 65))
    }
    assert allowed({})
    assert allowed(fist)
    assert allowed(SPREAD)
    pointing = {name: value for name, value in fist.items() if not name.startswith("index")}
    assert allowed({**pointing, "index_mcp_flexion": 15})
    assert not allowed({"index_dip_flexion": 60})
    assert not allowed({"index_mcp_abduction": -10, "middle_mcp_abduction": 10})
    assert not allowed({"ring_mcp_flexion": 85})
