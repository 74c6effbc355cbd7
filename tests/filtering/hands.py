"""Poses of the two-finger hand's plant."""

import numpy as np

from drake_pose.filtering.hand import FINGERS, HAND_STATE, QUATERNION


def plant_positions(x, names, pixels_per_metre):
    """(nq,) positions of ``urdf/two_finger_hand`` for a state (n,) as in ``HAND_STATE``.

    The palm's quaternion is normalised; its position is the wrist's pixel at scale 1, its depth 0.
    """
    value = dict(zip(HAND_STATE.names, x, strict=True))
    quaternion = np.array([value[name] for name in QUATERNION])
    value.update(zip(QUATERNION, quaternion / np.linalg.norm(quaternion), strict=True))
    value["palm_x"] = value["wrist_x"] / pixels_per_metre
    value["palm_y"] = value["wrist_y"] / pixels_per_metre
    value["palm_z"] = 0.0
    for i in FINGERS:
        value[f"base_height_{i}"] = value["palm_height"]
        value[f"base_side_{i}"] = 0.25 * value["palm_width"]
    return np.array([value[name] for name in names])
