"""What is said of a recording's faults."""

import numpy as np
import pytest

from drake_pose.jobs.estimate.person import (
    describe_camera,
    describe_fit,
    describe_rig,
    describe_views,
)
from drake_pose.person.recordings.camera_faults import CameraFault, CameraMotion
from drake_pose.person.recordings.figures import RigFault
from drake_pose.person.recordings.persons_in_view import ViewFaults

FRAMES = ("0", "1", "2", "3")


def test_who_was_in_view():
    views = ViewFaults((3,), {"a": (1,)}, {"a": (0, 1), "b": (1,)}, {"b": (1,)})
    nobody, blind, others = describe_views(views, FRAMES)
    assert nobody.startswith("frame 3: fewer than two cameras")
    assert "camera 'a' sees nobody in frame 1" in blind
    assert "frame 0-1: somebody else is in view of cameras 'a' and 'b'" in others
    assert "in camera 'b' both are one silhouette (frame 1)" in others


@pytest.mark.parametrize(
    ("mirrored", "exchanged", "what"),
    [
        (("a",), (), "until the masks of camera 'a' are mirrored"),
        ((), ("a", "b"), "until the masks of cameras 'a' and 'b' are exchanged"),
        ((), (), "are cameras.yaml, the folders' names or the masks wrong?"),
    ],
)
def test_a_rig_at_fault(mirrored, exchanged, what):
    (warning,) = describe_rig(RigFault(mirrored, exchanged, {"a": 0.6, "b": 0.8}))
    assert what in warning
    assert "60 % of camera 'a'" in warning


def test_a_camera_that_moved_or_contradicts():
    motion = CameraMotion(np.eye(4), np.array([3.0, -4.0]), 5.0, 0.07, 0.1, 0.5, 0.9)
    moved = CameraFault("a", motion, True, (), 0.95, 2, True)
    unclear = CameraFault("a", motion, False, ("b",), 0.95)
    first, second = (describe_camera(one, FRAMES) for one in (moved, unclear))
    assert first.startswith("camera 'a' has moved since frame 2 after it was calibrated")
    assert "5.0 pixels off in its pictures (3.0 to the right, 4.0 up" in first
    assert "left out since frame 2" in first
    assert second.startswith("camera 'a' or 'b' contradicts the others: 50 % of its")
    assert "used all the same" in second


def test_who_fits_badly():
    assert describe_fit([0.0, 0.9, 0.7]) == ()
    (warning,) = describe_fit([0.0, 0.5, 0.7, 0.3])
    assert "only 50 % of the contours fit" in warning
