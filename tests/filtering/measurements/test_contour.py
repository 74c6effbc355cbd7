import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.errors import SettingsError
from drake_pose.filtering import contour_observation
from drake_pose.filtering.contour_observation import ROOT_SHIFT, ContourObservation, ContourSettings
from drake_pose.filtering.inequalities import from_model
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.body.models import LIMB_URDF, write_limb
from tests.jobs.scenes import camera
from tests.search.arms import crane
from tests.search.bodies import front_camera, near_camera


def descend(observation, seen, x, steps=5):
    """Make Gauss-Newton steps from a state."""
    moving, distance = len(observation.layout.moving), None
    for k in range(steps):
        measured = observation.measure(seen, x, distance, k)
        distance = measured.distance
        H = measured.H[:, :moving]
        step = np.linalg.solve(H.T @ H + 1e-3 * np.eye(moving), H.T @ measured.y)
        x = x.copy()
        x[:moving] += step
    return x, measured


def test_measurements_lead_to_the_pose_that_drake_rendered(body):
    camera = front_camera(200, shift=0.2)
    observation = ContourObservation(body.pose_tree(), [camera])
    truth = np.array([0.2, 0.9, -0.6])
    x_true = observation.state(truth)
    masks = [LabelRenderer(body, camera).mask(truth)]
    start = x_true + np.r_[0.12, -0.15, 0.1, np.zeros(3)]
    x, measured = descend(observation, observation.gather_evidence(masks), start)
    q, X_WB = observation.positions(x)
    # Segments have 12 to 24 pixels: a quarter of a pixel is a degree.
    np.testing.assert_allclose(q, truth, atol=np.radians(2.5))
    np.testing.assert_allclose(X_WB, np.eye(4), atol=1e-9)
    assert measured.distance < 0.6
    assert measured.is_explained
    drawn = observation.draw(x, camera)
    assert np.count_nonzero(drawn != masks[0]) < 0.02 * np.count_nonzero(masks[0])


def test_known_and_estimated_root_positions_agree(body):
    home, shift = np.array([0.0, 0.05, 0.04]), np.array([0.0, 0.03, -0.02])
    tree, there = body.pose_tree("trunk", root_position=home), home + shift
    camera = front_camera(200, shift=0.2)
    held, moves = (ContourObservation(tree, [camera], root_moves=one) for one in (False, True))
    q = np.array([0.2, 0.9, -0.6])
    x = moves.state(q)
    at_home = moves.draw(x, camera)
    x[moves.layout.indices(ROOT_SHIFT)] = shift
    np.testing.assert_allclose(moves.root_position(x), there)
    seen = held.seen_by(held.cameras, there).draw(held.state(q), camera)
    assert not np.array_equal(seen, at_home)
    np.testing.assert_array_equal(moves.draw(x, camera), seen)
    found, _ = descend(moves, moves.gather_evidence([seen]), moves.state(q), steps=8)
    np.testing.assert_allclose(found[moves.layout.indices(ROOT_SHIFT)][1:], shift[1:], atol=0.004)


def test_jacobian_equals_finite_differences_of_the_contour(body, monkeypatch):
    """Of the measured distances, without robust weights."""
    camera = front_camera(400, shift=0.2)
    plain = ContourSettings(spacing=1.0, deviation=30.0)
    monkeypatch.setattr(contour_observation, "CONTOUR", plain)
    observation = ContourObservation(body.pose_tree(), [camera])
    truth = observation.state(np.array([0.2, 0.9, -0.6]))
    mask = observation.draw(truth, camera)
    for element in range(3):
        for step in (0.1, -0.1):
            x = truth.copy()
            x[element] += step
            measured = observation.measure(observation.gather_evidence([mask]), x)
            expected = measured.H @ (truth - x)
            assert np.linalg.norm(measured.y - expected) < 0.4 * np.linalg.norm(measured.y)


def test_frames_without_evidence_and_invalid_arguments(body):
    observation = ContourObservation(body.pose_tree(), [front_camera(100)])
    x = observation.state(np.zeros(3))
    for mask in (None, np.zeros((100, 100), dtype=bool)):
        assert observation.measure(observation.gather_evidence([mask]), x) is None
    for masks, word in (([], "1 masks expected"), ([np.zeros((50, 50), bool)], "50 x 50")):
        with pytest.raises(SettingsError, match=word):
            observation.gather_evidence(masks)
    with pytest.raises(SettingsError, match="one camera"):
        ContourObservation(body.pose_tree(), [])


def test_skin_is_drawn_with_angles_wrapped_into_the_limits(tmp_path):
    """A full turn more is the same pose, but would bend a band of skin by a fraction of it."""
    model = load_model(write_limb(tmp_path, text=LIMB_URDF.replace("2.5", "3.2")), check=False)
    camera = near_camera()
    observation = ContourObservation(model.pose_tree(), [camera])
    inside = observation.state(np.array([0.2, 1.1, 0.4, 0.3, -0.5]))
    for name in ("elbow", "wrist_x"):
        beyond = inside.copy()
        beyond[observation.layout.index(name)] += 2.0 * np.pi
        np.testing.assert_array_equal(
            observation.draw(beyond, camera), observation.draw(inside, camera)
        )


def test_unwrapped_angles_are_in_the_turns_of_the_track(tmp_path):
    """A search returns angles within half a turn; the track is two turns further."""
    observation = ContourObservation(crane(tmp_path).pose_tree(), [camera("front")])
    names = observation.layout.names
    swing, luff = names.index("swing"), names.index("luff")
    last = observation.state(np.array([13.0, 3.0]))
    found = observation.unwrapped(observation.state(np.array([0.4, -2.0])), last)
    assert found[swing] == pytest.approx(0.4 + 4.0 * np.pi)
    # Its limits span two turns.
    assert found[luff] == pytest.approx(-2.0 + 2.0 * np.pi)
    assert np.all(found[len(observation.layout.moving) :] == 0.0)
    near = observation.unwrapped(observation.state(np.array([13.1, 3.1])), last)
    np.testing.assert_allclose(near[[swing, luff]], [13.1, 3.1])


def test_angles_that_turn_around_are_not_truncated(tmp_path):
    """The filter keeps the limits of other joints."""
    model = crane(tmp_path)
    assert from_model(model).rows == ("luff >= -6.28319", "luff <= 6.28319")
    observation = ContourObservation(model.pose_tree(), [camera("front")])
    with pytest.warns(UserWarning, match="no joint has a limit"):
        assert not len(observation.inequalities())
    for lower, upper in ((-1e16, 1e16), (-np.pi, np.pi)):
        assert not len(from_model(crane(tmp_path, f'lower="{lower}" upper="{upper}"')))
    for lower, upper in ((-1, 2), (4, 6), (-0.4, 0.1)):
        narrow = crane(tmp_path, f'lower="{lower}" upper="{upper}"')
        rows = ContourObservation(narrow.pose_tree(), [camera("front")]).inequalities()
        assert rows.rows == (f"luff >= {lower}", f"luff <= {upper}")
        np.testing.assert_allclose(sorted(rows.b), sorted([upper, -lower]))
