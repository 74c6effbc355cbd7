"""Bodies posed by positions, and positions as messages."""

import numpy as np
from pydrake.math import RigidTransform

from drake_pose.systems.bodies import RobotStateMessage, body_poses, held_positions
from tests.systems.bench import Bench


def test_positions_are_named_in_a_message(body):
    names = body.position_names
    run = Bench(RobotStateMessage(names)).give(positions=[0.1, 0.4, -0.4])
    for time in (0.0, 7 / 30):
        run.context.SetTime(time)
        message = run["lcmt_robot_state"]
        assert message.utime == round(1e6 * time)
        assert message.num_joints == 3
        assert message.joint_name == list(names)
        np.testing.assert_allclose(message.joint_position, [0.1, 0.4, -0.4], atol=1e-6)


def test_positions_are_held_around_their_time():
    q = np.array([[1.0, -1.0], [2.0, 5.0], [4.0, 0.0]])
    held = held_positions(q, 0.2)
    for k, row in enumerate(q):
        for fraction in (-0.49, 0.0, 0.49):
            np.testing.assert_array_equal(held.value(0.2 * (k + fraction)).ravel(), row)


def test_body_poses_move_with_the_base(body):
    plant, q = body.plant, np.array([0.1, 0.4, -0.4])
    X_WB = RigidTransform([1.0, 2.0, 3.0])
    for pose, moved in zip(body_poses(plant, q), body_poses(plant, q, X_WB), strict=True):
        assert moved.IsNearlyEqualTo(X_WB @ pose, 1e-12)
