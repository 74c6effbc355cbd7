"""Hands read from models, compared with Drake's kinematics and renderer."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import load_model
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import ModelError, UnknownNameError
from drake_pose.filtering.hand import HandObservation, scaled_rotation
from drake_pose.filtering.hand_model import palm_rotation, read_hand
from drake_pose.filtering.hand_silhouette import HandSilhouette
from drake_pose.filtering.inequalities import from_bounds
from drake_pose.filtering.motion import LinearMotion
from drake_pose.filtering.truncated_filter import TruncatedFilter
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.body.models import joint, link, urdf, write
from tests.filtering.hands import hand_at, random_hand, right_hand


def test_projected_joints_equal_drakes_kinematics():
    """Tips are one radius before the ends of the meshes."""
    model, hand = right_hand()
    plant, context = model.plant, model.plant.CreateDefaultContext()
    observation, fingers = HandObservation(hand=hand), len(hand.fingers)
    assert hand.fingers == ("thumb", "index", "middle", "ring", "little")
    for seed in range(3):
        x = random_hand(hand, seed)
        q = plant.GetPositions(context).copy()
        for name in hand.angles:
            q[model.position_index(name)] = x[hand.layout.index(name)]
        plant.SetPositions(context, q)
        palm, M = plant.GetFrameByName("palm"), scaled_rotation(x[2:6])[0]
        drawn = observation.drawing(x)[: 4 * fingers].reshape(fingers, 4, 2)
        for finger, points, radii in zip(hand.fingers, drawn, hand.radii, strict=True):
            parts = "metacarpal proximal" if finger == "thumb" else "proximal middle"
            links = [f"{finger}_{part}" for part in (*parts.split(), "distal")]
            end = model.link_meshes[links[2]].vertices[:, 1].max() - radii[-1]
            ends = [(name, np.zeros(3)) for name in links] + [(links[2], [0.0, end, 0.0])]
            for (name, p), point in zip(ends, points, strict=True):
                frame = plant.GetFrameByName(name)
                p_P = plant.CalcPointsPositions(context, frame, p, palm)[:, 0]
                # In the palm's link y points to the fingers and z out of the palm.
                expected = x[:2] + 1000.0 * (M @ p_P[[1, 2, 0]])[:2]
                np.testing.assert_allclose(point, expected, atol=1e-6)


# The camera looks along -x: the picture's right is the world's y, its up the world's z.
_FRONT = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@pytest.mark.parametrize("turn", [(0.0, 0.0), (0.5, 0.6), (-0.5, 2.6), (0.2, 4.0)])
def test_the_drawn_hand_equals_drakes(turn):
    """Spread fingers, without the forearm; the palm is a convex body, fingers are rods."""
    model, hand = right_hand()
    X_WC = np.eye(4)
    X_WC[:3, :3] = Rotation.from_euler("yz", turn).as_matrix() @ _FRONT
    camera = ParallelCamera("above", 240, 240, 800.0, 119.5, 180.5, X_WC)
    q = np.where(
        [kind == "quaternion" for kind in model.position_kinds], model.default_positions, 0.0
    )
    renderer = LabelRenderer(model, camera)
    X_WL = dict(zip(model.link_names, renderer.link_poses(q), strict=True))["palm"]
    X_CL = camera.X_CW @ X_WL
    quaternion = Rotation.from_matrix(palm_rotation(X_CL[:3, :3])).as_quat(scalar_first=True)
    x = hand_at(hand, quaternion)
    x[:2] = 800.0 * X_CL[:2, 3]
    n = len(x)
    rows = from_bounds(hand.layout.names[:1], [-np.inf], [np.inf])
    still = LinearMotion(np.eye(n), np.zeros((n, n)), None)
    observation = HandObservation(800.0, hand=hand)
    whole = TruncatedFilter(hand.layout, observation, rows, still)
    drawn = HandSilhouette(whole, 240, 240, (119.5, 180.5)).draw(x) > 0
    seen = renderer.segments(q)
    mask = (seen >= 0) & (seen != model.link_index("forearm"))
    assert np.count_nonzero(drawn & (seen < 0)) < 0.03 * mask.sum()
    assert np.count_nonzero(mask & ~drawn) < 0.06 * mask.sum()


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
