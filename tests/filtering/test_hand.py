"""The observation of a hand, compared with differences and with Drake's kinematics."""

import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import HAND_STATE, HandObservation, plant_positions, scaled_rotation
from drake_pose.filtering.hand_model import TWO_FINGERS
from drake_pose.filtering.state import Belief, numerical_jacobian
from tests.filtering.hands import hand_at, random_hand, right_hand

OBSERVATION = HandObservation()


@pytest.mark.parametrize("seed", range(5))
def test_jacobian_equals_central_differences(seed):
    for observation in (OBSERVATION, HandObservation(hand=right_hand()[1])):
        x = random_hand(observation.hand, seed, 0.3)
        h, H = observation.predict(x)
        numeric = numerical_jacobian(
            lambda z, model=observation: model.predict(z)[0], x, observation.wraps, 1.0
        )
        defined = np.isfinite(h)
        np.testing.assert_allclose(H[defined], numeric[defined], rtol=1e-5, atol=3e-4)


@pytest.mark.parametrize("distance", [None, 0.8])
def test_points_equal_drakes_kinematics_of_the_two_finger_hand(distance):
    """In the image of a parallel camera, or of a pinhole camera for which only depth differs."""
    model = load_model(bundled_model("two_finger_hand"), check=False)
    plant, context = model.plant, model.plant.CreateDefaultContext()
    names = [f"end_{i}{j}" if j else f"base_side_{i}" for i in (1, 2) for j in range(4)]
    for seed in range(5):
        x = random_hand(TWO_FINGERS, seed, 0.3)
        plant.SetPositions(context, plant_positions(x, model.position_names, 1000.0, distance))
        frames = [plant.GetFrameByName(name) for name in names]
        p_W = np.array([frame.CalcPoseInWorld(context).translation() for frame in frames])
        scale = np.sum(x[2:6] ** 2)
        if distance is None:
            expected = x[:2] + 1000.0 * scale * (p_W[:, :2] - x[:2] / 1000.0)
        else:
            wrist = plant.GetFrameByName("palm").CalcPoseInWorld(context).translation()
            np.testing.assert_allclose(1000.0 * distance * wrist[:2] / (distance + wrist[2]), x[:2])
            assert distance + wrist[2] == pytest.approx(distance / scale)
            expected = x[:2] + 1000.0 * scale * (p_W - wrist)[:, :2]
        h, _ = OBSERVATION.predict(x)
        np.testing.assert_allclose(h[2:18].reshape(-1, 2), expected, atol=1e-9)
        assert h[-1] == pytest.approx(scale)


def test_lines_pass_through_their_ends_and_palm_edges_are_outermost():
    for seed in range(10):
        x = random_hand(TWO_FINGERS, seed, 0.3)
        h, (M, _) = OBSERVATION.predict(x)[0], scaled_rotation(x[2:6])
        points = OBSERVATION.drawing(x)
        ends = [(4 * i + j, 4 * i + j + 1) for i in range(2) for j in range(3)]
        ends += [(k, k + 1) for k in range(8, 16, 2)]
        for (alpha, rho), pair in zip(h[18:38].reshape(-1, 2), ends, strict=True):
            normal = np.array([-np.sin(alpha), np.cos(alpha)])
            along = points[pair[1]] - points[pair[0]]
            if np.isfinite(alpha):
                np.testing.assert_allclose(points[[*pair]] @ normal, rho, atol=1e-9)
                assert np.arctan2(along[1], along[0]) == pytest.approx(alpha)
            else:
                assert np.linalg.norm(along) < 5.0
        width, height, thickness = x[34:]
        corners = np.stack(np.meshgrid([0, 1], [-0.5, 0.5], [-0.5, 0.5]), axis=-1).reshape(-1, 3)
        pixels = 1000 * (corners * [height, thickness, width]) @ M[:2].T + x[:2]
        across = np.array([-M[1, 0], M[0, 0]])
        seen = points[8:12] @ across
        assert seen.max() == pytest.approx((pixels @ across).max())
        assert seen.min() == pytest.approx((pixels @ across).min())
        assert (points[12:] @ M[:2, 0]).max() == pytest.approx((pixels @ M[:2, 0]).max())


def test_mirrored_states_project_alike_and_change_one_angle():
    # The image plane is perpendicular to the flexion plane: flexion moves fingers in depth.
    flexed = [0.0, 0.0, 0.3, 0.2, 0.2, 0.3, 0.2, 0.2]
    x = hand_at(TWO_FINGERS, [np.sqrt(0.5), np.sqrt(0.5), 0, 0], flexed)
    belief = Belief(x, np.diag(np.full(len(x), 0.5**2)))
    mirrored = HandObservation(mirror_slope=0.9).mirrors(belief)
    h, _ = OBSERVATION.predict(x)
    for other in mirrored:
        (changed,) = np.flatnonzero(other != x)
        assert HAND_STATE.names[changed].startswith("flexion")
        joint = changed - 8
        start = 2 + 2 * (4 * (joint // 3) + joint % 3 + 1)
        end = slice(start, start + 2)
        np.testing.assert_allclose(OBSERVATION.predict(other)[0][end], h[end], atol=1e-9)
    assert 0 < len(OBSERVATION.mirrors(belief)) < len(mirrored) == 6
    assert not HandObservation(mirror_slope=0.9, smallest_change=3.0).mirrors(belief)
    assert not HandObservation(mirror_slope=0.9).mirrors(Belief(x, 1e-4 * np.eye(len(x))))


def test_noise_is_that_of_points_lines_scale_and_prior():
    hand = right_hand()[1]
    names = HandObservation(hand=hand).names
    model = HandObservation(1.0, 2.0, 3.0, 4.0, scale_deviation=5.0, prior_frames=9.0, hand=hand)
    kinds = {"wrist": 2.0, "point": 2.0, "alpha": 3.0, "rho": 4.0, "scale": 5.0}
    expected = [kinds.get(name.split("_")[0], 0.0) for name in names[: -len(hand.prior.mean)]]
    found = np.sqrt(model.variances)
    np.testing.assert_allclose(found, [*expected, *(3.0 * hand.prior.deviation)])
    assert model.wraps.sum() == len(hand.line_ends)
    with pytest.raises(SettingsError, match="angle_deviation"):
        HandObservation(angle_deviation=0.0)
