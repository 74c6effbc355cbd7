import numpy as np
import pytest
from scipy.spatial import ConvexHull

from drake_pose.body import bundled_model, load_model
from drake_pose.errors import ModelError, SettingsError, UnknownNameError
from drake_pose.filtering.hand import HAND_STATE, HandObservation, plant_positions, scaled_rotation
from drake_pose.filtering.hand_model import read_hand
from drake_pose.filtering.state import Belief
from tests.body.models import joint, link, urdf, write

OBSERVATION = HandObservation()


def random_state(seed):
    generator = np.random.default_rng(seed)
    x = np.zeros(len(HAND_STATE))
    x[:2] = generator.uniform(-60, 60, 2)
    quaternion = generator.normal(size=4)
    x[2:6] = quaternion / np.linalg.norm(quaternion) * generator.uniform(0.8, 1.2)
    x[6:8] = generator.uniform(-0.3, 0.3, 2)
    x[8:14] = generator.uniform(0, 1.2, 6)
    x[14:28] = generator.normal(size=14)
    x[28:34] = generator.uniform(0.03, 0.07, 6)
    x[34:] = generator.uniform(0.02, 0.1, 3)
    return x


@pytest.fixture(scope="module")
def right_hand():
    """The model of the bundled right hand, and its HandModel."""
    model = load_model(bundled_model("hand").with_name("right_hand.urdf"), check=False)
    return model, read_hand(model)


def five_fingers(hand, seed):
    """Return a random state of a five-finger hand with the model's sizes."""
    generator, layout = np.random.default_rng(seed), hand.layout
    x = np.zeros(len(layout))
    quaternion = generator.normal(size=4)
    x[:2] = generator.uniform(-60, 60, 2)
    x[2:6] = quaternion / np.linalg.norm(quaternion) * generator.uniform(0.8, 1.2)
    x[layout.indices(hand.angles)] = generator.uniform(-0.1, 0.8, len(hand.angles))
    x[layout.indices(layout.constant)] = [hand.sizes[name] for name in layout.constant]
    return x


@pytest.mark.parametrize("seed", range(5))
def test_jacobian_equals_central_differences(seed, right_hand):
    own = HandObservation(hand=right_hand[1])
    for observation, x in (
        (OBSERVATION, random_state(seed)),
        (own, five_fingers(right_hand[1], seed)),
    ):
        h, H = observation.predict(x)
        step, wraps = 1e-6, observation.wraps
        for e in range(len(x)):
            d = np.zeros_like(x)
            d[e] = step
            change = observation.predict(x + d)[0] - observation.predict(x - d)[0]
            change[wraps] = np.remainder(change[wraps] + np.pi, 2 * np.pi) - np.pi
            numeric = change / (2 * step)
            defined = np.isfinite(h)
            np.testing.assert_allclose(H[defined, e], numeric[defined], rtol=1e-5, atol=3e-4)


def test_projected_joints_equal_drakes_kinematics(right_hand):
    """For the joints of the bundled five-finger hand, and tips one radius before their end."""
    model, hand = right_hand
    plant, context = model.plant, model.plant.CreateDefaultContext()
    observation, fingers = HandObservation(hand=hand), len(hand.fingers)
    assert hand.fingers == ("thumb", "index", "middle", "ring", "little")
    for seed in range(5):
        x = five_fingers(hand, seed)
        q = plant.GetPositions(context).copy()
        angles = dict(zip(hand.angles, x[hand.layout.indices(hand.angles)], strict=True))
        for name, angle in angles.items():
            q[model.position_index(name)] = angle
        plant.SetPositions(context, q)
        palm, M = plant.GetFrameByName("palm"), scaled_rotation(x[2:6])[0]
        drawn = observation.drawing(x)[: 4 * fingers].reshape(fingers, 4, 2)
        for finger, points in zip(hand.fingers, drawn, strict=True):
            links = [f"{finger}_{part}" for part in ("proximal", "middle", "distal")]
            if finger == "thumb":
                links = ["thumb_metacarpal", "thumb_proximal", "thumb_distal"]
            length = x[hand.layout.index(f"length_{links[2]}")]
            ends = [(name, np.zeros(3)) for name in links] + [(links[2], [0.0, length, 0.0])]
            for (name, p), point in zip(ends, points, strict=True):
                frame = plant.GetFrameByName(name)
                p_P = plant.CalcPointsPositions(context, frame, p, palm)[:, 0]
                # In the palm's link y points to the fingers and z out of the palm.
                expected = x[:2] + 1000.0 * (M @ p_P[[1, 2, 0]])[:2]
                np.testing.assert_allclose(point, expected, atol=1e-6)


def test_palm_lies_in_its_mesh_and_has_half_its_volume(right_hand):
    model, hand = right_hand
    mesh = ConvexHull(model.link_meshes["palm"].vertices[:, [1, 2, 0]])
    sizes = [hand.sizes[name] for name in ("palm_height", "palm_thickness", "palm_width")]
    drawn = (hand.rings * sizes).reshape(-1, 3)
    beyond = drawn @ mesh.equations[:, :3].T + mesh.equations[:, 3]
    assert beyond.max() < 0.06 * sizes[0]
    assert ConvexHull(drawn).volume > 0.5 * mesh.volume


@pytest.mark.parametrize("seed", range(5))
def test_two_finger_points_equal_drakes_kinematics(seed):
    """For joints and tips of urdf/two_finger_hand at a state's positions."""
    model = load_model(bundled_model("two_finger_hand"), check=False)
    plant, context = model.plant, model.plant.CreateDefaultContext()
    x = random_state(seed)
    plant.SetPositions(context, plant_positions(x, model.position_names, 1000.0))
    names = [f"end_{i}{j}" if j else f"base_side_{i}" for i in (1, 2) for j in range(4)]
    frames = [plant.GetFrameByName(name) for name in names]
    p_W = np.array([frame.CalcPoseInWorld(context).translation() for frame in frames])
    scale = 1000.0 * np.sum(x[2:6] ** 2)
    expected = x[:2] + scale * (p_W[:, :2] - x[:2] / 1000.0)
    h, _ = OBSERVATION.predict(x)
    np.testing.assert_allclose(h[2:18].reshape(-1, 2), expected, atol=1e-9)


def test_lines_pass_through_their_end_points():
    x = random_state(1)
    h, _ = OBSERVATION.predict(x)
    points = OBSERVATION.drawing(x)
    for i in range(2):
        for j in range(3):
            alpha, rho = h[18 + 2 * (3 * i + j) : 20 + 2 * (3 * i + j)]
            normal = np.array([-np.sin(alpha), np.cos(alpha)])
            for point in (points[4 * i + j], points[4 * i + j + 1]):
                assert normal @ point == pytest.approx(rho, abs=1e-9)


def test_palm_edges_are_its_outermost_points():
    for seed in range(20):
        x = random_state(seed)
        points, (M, _) = OBSERVATION.drawing(x), scaled_rotation(x[2:6])
        width, height, thickness = x[34:]
        corners = np.stack(np.meshgrid([0, 1], [-0.5, 0.5], [-0.5, 0.5]), axis=-1).reshape(-1, 3)
        pixels = 1000 * (corners * [height, thickness, width]) @ M[:2].T + x[:2]
        across = np.array([-M[1, 0], M[0, 0]])
        seen = points[8:12] @ across
        assert seen.max() == pytest.approx((pixels @ across).max())
        assert seen.min() == pytest.approx((pixels @ across).min())
        assert (points[12:] @ M[:2, 0]).max() == pytest.approx((pixels @ M[:2, 0]).max())


def hand_at(quaternion, flexions):
    x = np.zeros(len(HAND_STATE))
    x[2:6], x[8:14] = quaternion, flexions
    x[28:34] = 0.06, 0.04, 0.035, 0.06, 0.04, 0.035
    x[34:] = 0.06, 0.08, 0.02
    return x


def test_segments_along_the_optical_axis_have_no_line():
    # Rotated by 90 degrees about the image's vertical: the hand points along the optical axis.
    h, _ = OBSERVATION.predict(hand_at([np.sqrt(0.5), 0, np.sqrt(0.5), 0], 0.0))
    assert np.isnan(h[18:30]).all()
    assert np.isfinite(h[:18]).all()


def test_mirrored_state_projects_alike_and_changes_one_angle():
    # The image plane is perpendicular to the flexion plane: flexion moves fingers in depth.
    x = hand_at([np.sqrt(0.5), np.sqrt(0.5), 0, 0], [0.3, 0.2, 0.2, 0.3, 0.2, 0.2])
    belief = Belief(x, np.diag(np.full(len(x), 0.5**2)))
    mirrored = HandObservation(mirror_slope=0.9).mirrors(belief)
    assert mirrored
    h, _ = OBSERVATION.predict(x)
    for other in mirrored:
        (changed,) = np.flatnonzero(other != x)
        assert HAND_STATE.names[changed].startswith("flexion")
        joint = changed - 8
        start = 2 + 2 * (4 * (joint // 3) + joint % 3 + 1)
        end = slice(start, start + 2)
        np.testing.assert_allclose(OBSERVATION.predict(other)[0][end], h[end], atol=1e-9)
    sure = Belief(x, np.diag(np.full(len(x), 1e-4)))
    assert not HandObservation(mirror_slope=0.9).mirrors(sure)


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ([], "'palm' has no fingers"),
        ([joint("slide", "prismatic", "palm", "one")], "'slide' on 'palm' begins no finger"),
        ([joint("bend", "revolute", "palm", "unseen")], "'bend' on 'palm' begins no finger"),
        ([joint("bend", "revolute", "palm", "one")], "link 'one' has no vertex -3 to 3 mm"),
    ],
)
def test_models_without_a_hand_are_refused(tmp_path, joints, message):
    """The palm floats, as links without a joint do."""
    text = urdf(*(link(name) for name in ("palm", "one")), link("unseen", ""), *joints)
    model = load_model(write(tmp_path, text), check=False)
    with pytest.raises(ModelError, match=message):
        read_hand(model)
    with pytest.raises(UnknownNameError, match="'paw'"):
        read_hand(model, "paw")


def test_zero_noise_is_refused():
    with pytest.raises(SettingsError, match="angle_deviation"):
        HandObservation(angle_deviation=0.0)
