import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import HAND_STATE, HandObservation, plant_positions, scaled_rotation
from drake_pose.filtering.state import Belief

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


@pytest.mark.parametrize("seed", range(5))
def test_jacobian_equals_central_differences(seed):
    x = random_state(seed)
    h, H = OBSERVATION.predict(x)
    step, wraps, defined = 1e-6, OBSERVATION.wraps, np.isfinite(h)
    for e in range(len(x)):
        d = np.zeros_like(x)
        d[e] = step
        change = OBSERVATION.predict(x + d)[0] - OBSERVATION.predict(x - d)[0]
        change[wraps] = np.remainder(change[wraps] + np.pi, 2 * np.pi) - np.pi
        numeric = change / (2 * step)
        np.testing.assert_allclose(H[defined, e], numeric[defined], rtol=1e-5, atol=3e-4)


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


def test_segments_along_the_optical_axis_have_no_line():
    x = np.zeros(len(HAND_STATE))
    x[2] = 1.0
    x[28:34] = 0.04
    x[34:] = 0.06, 0.08, 0.02
    # Rotated by 90 degrees about the image's vertical: the hand points along the optical axis.
    x[2:6] = np.sqrt(0.5), 0, np.sqrt(0.5), 0
    h, _ = OBSERVATION.predict(x)
    assert np.isnan(h[18:30]).all()
    assert np.isfinite(h[:18]).all()


def test_mirrored_state_projects_alike_and_changes_one_angle():
    x = np.zeros(len(HAND_STATE))
    # The image plane is perpendicular to the flexion plane: flexion moves fingers in depth.
    x[2:6] = np.sqrt(0.5), np.sqrt(0.5), 0, 0
    x[8:14] = 0.3, 0.2, 0.2, 0.3, 0.2, 0.2
    x[28:34] = 0.06, 0.04, 0.035, 0.06, 0.04, 0.035
    x[34:] = 0.06, 0.08, 0.02
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


def test_zero_noise_is_refused():
    with pytest.raises(SettingsError, match="angle_deviation"):
        HandObservation(angle_deviation=0.0)
