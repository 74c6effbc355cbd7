"""Which of several poses that look alike a sequence bears out."""

import numpy as np
import pytest

from drake_pose.body.tree.root import RootRotation
from drake_pose.errors import SettingsError
from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.contour_tracker import ContourTracker
from drake_pose.filtering.sequence_fit import (
    find_start,
    tilted,
)
from tests.filtering.tracking.test_match_and_track import PERIOD
from tests.filtering.tracking.test_unknown_scale import SETTINGS
from tests.search.bodies import forked_body, front_camera


@pytest.fixture
def observation(tmp_path):
    tree = forked_body(tmp_path).pose_tree(
        "trunk", root_position=np.zeros(3), root_rotation=RootRotation.free()
    )
    return ContourObservation(tree, [front_camera(200, shift=0.2)], True, True, rest=0.03)


def test_a_tilt_turns_the_root_alone(observation):
    x = np.zeros(len(observation.layout))
    turned = tilted(observation, x, (0.3, -0.2))
    R_WC = observation.cameras[0].X_WC[:3, :3]
    R = observation.node_poses(turned)[0, :3, :3] @ observation.node_poses(x)[0, :3, :3].T
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    along = R_WC.T @ axis / np.linalg.norm(axis)
    np.testing.assert_allclose(along, np.array([0.3, -0.2, 0.0]) / np.hypot(0.3, 0.2), atol=1e-9)
    moved = np.flatnonzero(turned != x)
    assert {observation.layout.names[i] for i in moved} <= {
        "root_rotation_x", "root_rotation_y", "root_rotation_z"
    }  # fmt: skip


def test_the_true_start_is_among_those_followed_and_not_worse_than_what_was_given(observation):
    camera = observation.cameras[0]
    moving = len(observation.layout.moving)
    truth = []
    for k in range(12):
        x = np.zeros(len(observation.layout))
        names = observation.layout.moving
        x[names.index("left_turn")] = 0.6 + 0.05 * k
        x[names.index("right_turn")] = -0.5 - 0.03 * k
        x[names.index("root_rotation_z")] = 0.5
        truth.append(x)
    masks = [[observation.draw(x, camera)] for x in truth]
    given = truth[0].copy()
    given[:moving] += 0.05
    tracker = ContourTracker(observation, PERIOD, SETTINGS)
    found = find_start(tracker, given, masks)
    assert [one.cost for one in found] == sorted(one.cost for one in found)
    assert len(found[0].states) == len(found[0].errors) == 12


def test_a_root_that_does_not_turn_freely_is_refused(tmp_path):
    body = forked_body(tmp_path)
    limited = RootRotation.limited([("x", -30.0, 30.0)])
    for tree in (
        body.pose_tree(),
        body.pose_tree("trunk", root_position=np.zeros(3), root_rotation=limited),
    ):
        observation = ContourObservation(tree, [front_camera()])
        with pytest.raises(SettingsError, match="freely"):
            tilted(observation, np.zeros(len(observation.layout)), (0.1, 0.1))
