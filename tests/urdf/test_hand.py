"""The bundled hands: reproducible, closed, of published size, jointed like a hand, no gaps."""

from pathlib import Path

import numpy as np
import pytest

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.filtering.truncation.couplings import model_inequalities
from tests.urdf.surfaces import (
    URDF,
    Silhouettes,
    assert_closed,
    committed,
    pieces,
    read_obj,
    spans,
    sphere_points,
    winding_numbers,
    written_again,
)
from tests.written_files import assert_same_files

FINGERS = ("index", "middle", "ring", "little")
HANDS = ("hand", "right_hand")
HAND_LENGTH, HAND_BREADTH = 0.1872, 0.08325  # ANSUR II, mean of women's and men's means [m]
LIMITS = {
    "forearm_z": (-180, 180),
    "forearm_x": (-90, 90),
    "forearm_y": (-180, 180),
    "wrist_flexion": (-70, 80),
    "wrist_deviation": (-20, 35),
    "thumb_cmc_flexion": (-40, 40),
    "thumb_cmc_abduction": (-35, 40),
    "thumb_mcp_flexion": (-10, 55),
    "thumb_ip_flexion": (-50, 80),
    "index_mcp_abduction": (-15, 30),
    "middle_mcp_abduction": (-20, 20),
    "ring_mcp_abduction": (-15, 25),
    "little_mcp_abduction": (-15, 45),
    **{f"{finger}_mcp_flexion": (-30, 90) for finger in FINGERS},
    **{f"{finger}_pip_flexion": (-10, 110) for finger in FINGERS},
    **{f"{finger}_dip_flexion": (-10, 90) for finger in FINGERS},
}
# Child -> parent, radius [m] of a ball round the joint that lies in both.
JOINTS = {
    "palm": ("forearm", 0.017),
    "thumb_metacarpal": ("palm", 0.010),
    "thumb_proximal": ("thumb_metacarpal", 0.009),
    "thumb_distal": ("thumb_proximal", 0.009),
    **{f"{finger}_proximal": ("palm", 0.004) for finger in FINGERS},
    **{f"{finger}_middle": (f"{finger}_proximal", 0.006) for finger in FINGERS},
    **{f"{finger}_distal": (f"{finger}_middle", 0.005) for finger in FINGERS},
}
SPREAD = {
    "index_mcp_abduction": 15,
    "ring_mcp_abduction": 10,
    "little_mcp_abduction": 28,
    "thumb_cmc_flexion": -20,
}


@pytest.fixture(scope="module", params=HANDS)
def hand(request: pytest.FixtureRequest) -> ArticulatedModel:
    return load_model(URDF / "hand" / f"{request.param}.urdf", check=False)


@pytest.fixture(scope="module")
def both() -> tuple[ArticulatedModel, ArticulatedModel]:
    left, right = (load_model(URDF / "hand" / f"{name}.urdf", check=False) for name in HANDS)
    return left, right


def posed(model: ArticulatedModel, degrees: dict[str, float]) -> np.ndarray:
    q = np.zeros(len(model.position_names))
    for name, value in degrees.items():
        q[model.position_index(name)] = np.radians(value)
    return q


def tip(model: ArticulatedModel, finger: str, q: np.ndarray) -> np.ndarray:
    """The fingertip (3,) in the palm's frame."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, q)
    link = model.plant.GetBodyByName(f"{finger}_distal").body_frame()
    palm = model.plant.GetBodyByName("palm").body_frame()
    point = np.array([0.0, model.link_meshes[f"{finger}_distal"].vertices[:, 1].max(), 0.0])
    return model.plant.CalcPointsPositions(context, link, point, palm).ravel()


def test_script_writes_the_committed_files(tmp_path: Path) -> None:
    written = written_again("hand", tmp_path)
    assert written == committed("hand")
    assert_same_files(tmp_path, URDF / "hand")


@pytest.mark.slow
def test_hand_length_scales_everything(tmp_path: Path) -> None:
    written_again("hand", tmp_path, "--handlength", "0.21")
    large = read_obj(tmp_path / "meshes" / "left_palm.obj").vertices
    mean = read_obj(URDF / "hand" / "meshes" / "left_palm.obj").vertices
    np.testing.assert_allclose(large, mean * 0.21 / HAND_LENGTH, atol=2e-5)


@pytest.mark.parametrize("link", ["forearm", *JOINTS])
def test_surfaces_are_closed_and_mirrored(link: str) -> None:
    left = read_obj(URDF / "hand" / "meshes" / f"left_{link}.obj")
    right = read_obj(URDF / "hand" / "meshes" / f"right_{link}.obj")
    for mesh in (left, right):
        assert 200 <= len(mesh.faces) <= 800
        assert_closed(mesh)
    np.testing.assert_array_equal(right.vertices, left.vertices * [-1.0, 1.0, 1.0])
    assert right.volume == pytest.approx(left.volume)


def test_joints_and_limits(hand: ArticulatedModel) -> None:
    assert set(hand.position_names) == {"position_x", "position_y", "position_z", *LIMITS}
    for name, (lower, upper) in LIMITS.items():
        index = hand.position_index(name)
        limits = np.degrees([hand.lower[index], hand.upper[index]])
        np.testing.assert_allclose(limits, [lower, upper], atol=1e-12)
    for child, (parent, _) in JOINTS.items():
        tree = hand.pose_tree()
        node = tree.nodes[tree.node_index(child)]
        assert tree.nodes[node.parent].name == parent


def test_size_is_the_published_one(both: tuple[ArticulatedModel, ArticulatedModel]) -> None:
    left = both[0]
    zero = posed(left, {})
    tips = {finger: tip(left, finger, zero)[1] for finger in FINGERS}
    assert tips["middle"] == pytest.approx(HAND_LENGTH, rel=0.002)
    # Index and ring end near the middle finger's last joint's end, the little one well below.
    assert 0.92 <= tips["index"] / HAND_LENGTH <= 0.96
    assert 0.91 <= tips["ring"] / HAND_LENGTH <= 0.96
    assert 0.76 <= tips["little"] / HAND_LENGTH <= 0.83
    # Breadth over the knuckles, thumb left out.
    knuckles = [left.link_meshes["palm"].vertices]
    height = np.abs(knuckles[0][:, 1] - 0.38 * HAND_LENGTH) < 0.012
    assert np.ptp(knuckles[0][height, 0]) == pytest.approx(HAND_BREADTH, rel=0.05)
    # Pheasant: breadth at the index finger's middle joint is 0.24 of the hand's breadth.
    middle = left.link_meshes["index_middle"].vertices
    assert np.ptp(middle[np.abs(middle[:, 1]) < 0.006, 0]) == pytest.approx(
        0.24 * HAND_BREADTH, rel=0.12
    )


def test_positive_angles_bend_towards_the_palm_and_away_from_the_middle_finger(
    hand: ArticulatedModel,
) -> None:
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


def test_right_hand_mirrors_the_left(both: tuple[ArticulatedModel, ArticulatedModel]) -> None:
    left, right = both
    rng = np.random.default_rng(11)
    for _ in range(5):
        q = rng.uniform(left.lower, left.upper)
        for finger in (*FINGERS, "thumb"):
            np.testing.assert_allclose(
                tip(right, finger, q), tip(left, finger, q) * [-1, 1, 1], atol=1e-6
            )


def test_thumb_reaches_the_index_and_the_little_finger(
    both: tuple[ArticulatedModel, ArticulatedModel],
) -> None:
    left = both[0]
    pinch = {"thumb_cmc_flexion": 25, "thumb_cmc_abduction": 25, "thumb_mcp_flexion": 25}
    rng = np.random.default_rng(2)
    names = [n for n in left.position_names if n.startswith("thumb")]
    for finger, curl in (("index", 60), ("little", 75)):
        fist = {f"{finger}_{joint}_flexion": curl for joint in ("mcp", "pip")}
        target = tip(left, finger, posed(left, fist))
        nearest = np.inf
        for _ in range(1000):
            q = posed(left, pinch)
            for name in names:
                index = left.position_index(name)
                q[index] = rng.uniform(left.lower[index], left.upper[index])
            nearest = min(nearest, float(np.linalg.norm(tip(left, "thumb", q) - target)))
        assert nearest < 0.025, finger


@pytest.mark.parametrize("child", JOINTS)
def test_a_ball_round_each_joint_is_in_both_links(
    both: tuple[ArticulatedModel, ArticulatedModel], child: str
) -> None:
    left = both[0]
    parent, radius = JOINTS[child]
    context = left.plant.CreateDefaultContext()
    left.plant.SetPositions(context, posed(left, {}))
    frame = left.plant.GetBodyByName(parent).body_frame()
    X_PC = left.plant.GetBodyByName(child).body_frame().CalcPose(context, frame)
    ball = sphere_points(radius)
    meshes = URDF / "hand" / "meshes"
    assert winding_numbers(read_obj(meshes / f"left_{child}.obj"), ball).min() > 0.5
    in_parent = ball + X_PC.translation()
    assert winding_numbers(read_obj(meshes / f"left_{parent}.obj"), in_parent).min() > 0.5


def test_no_pose_falls_apart(hand: ArticulatedModel) -> None:
    silhouettes = Silhouettes(hand)
    rng = np.random.default_rng(4)
    for _ in range(40):
        q = rng.uniform(hand.lower, hand.upper)
        q[:6] = 0.0
        mask = silhouettes.mask(q, rng.normal(size=3), np.zeros(3), 0.7)
        assert mask.any()
        assert pieces(mask) == 1


def test_spread_fingers_are_seen_apart_down_to_the_webs(hand: ArticulatedModel) -> None:
    mask = Silhouettes(hand).mask(
        posed(hand, SPREAD), np.array([1.0, 0, 0]), np.array([0, 0, 0.1]), 0.25, 500
    )
    rows = {share: 250 - round((share * HAND_LENGTH - 0.1) / 0.25 * 500) for share in (0.5, 0.66)}
    assert spans(mask[rows[0.66]]) >= 4
    assert spans(mask[rows[0.5]]) <= 2  # below the webs: the palm, and perhaps the thumb
    assert pieces(mask) == 1


def test_couplings_allow_a_fist_and_forbid_what_no_hand_does(hand: ArticulatedModel) -> None:
    inequalities = model_inequalities(hand)

    def allowed(degrees: dict[str, float]) -> bool:
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


def test_masses_make_a_valid_simulation(hand: ArticulatedModel) -> None:
    context = hand.plant.CreateDefaultContext()
    assert 1.2 < hand.plant.CalcTotalMass(context) < 2.6  # forearm and hand [kg]
    hand.plant.SetPositions(context, posed(hand, {}))
    assert np.linalg.eigvalsh(hand.plant.CalcMassMatrix(context))[0] > 0.0
