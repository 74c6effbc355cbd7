"""Registered cameras are checked against the true ones, by Drake's masks."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.errors import CameraError, weight_of
from drake_pose.jobs.registration.diagnosis import (
    base_motion,
    check_focal_length,
    known_camera_warnings,
    require_seen_by,
)
from drake_pose.registration.hand_eye import motion
from drake_pose.registration.posed_frames import MultiViewFrame
from drake_pose.registration.register import FrameMisfit, RegisteredCamera, RegistrationBody
from tests.search.arms import arm_cameras


@pytest.fixture(scope="module")
def seen(arm_scene):
    """The robot's surfaces, the true camera 'left', and its frames."""
    inputs = arm_scene.read()
    return RegistrationBody(inputs.tree), arm_scene.cameras["left"], inputs.of("left")


def test_motions_of_all_cameras_are_the_bases() -> None:
    """X_WC as given is the base's motion times X_WC as found."""
    X, sd = motion(np.array([0.1, 0.0, 0.0, 0.0, 0.03, 0.04])), 1e-4
    placed = [
        (one.with_pose(X @ one.X_WC), RegisteredCamera(one, sd**2 * np.eye(6), ()))
        for one in arm_cameras()
    ]
    found = base_motion(placed)
    assert (found.kind, found.angle, found.shift) == (
        "base",
        pytest.approx(0.1),
        pytest.approx(0.05),
    )
    assert (found.angle_sd, found.shift_sd) == (pytest.approx(sd), pytest.approx(sd))
    assert base_motion(placed[:1]) is None
    (given, one), other = placed
    for off, same in (
        ([0.004, 0, 0, 0, 0, 0], True), ([0.006, 0, 0, 0, 0, 0], False),
        ([0, 0, 0, 0, 0.003, 0], True), ([0, 0, 0, 0, 0.004, 0], False),
    ):  # fmt: skip
        # About the camera's own centre, so that a turn does not shift it.
        nudge = motion(np.array(off, float))
        moved = given.X_WC @ one.camera.X_CW
        again = given.with_pose(nudge @ moved @ one.camera.X_WC)
        assert (base_motion([(again, one), other]) is not None) == same


def test_the_robot_must_be_seen(seen) -> None:
    body, camera, frames = seen
    assert known_camera_warnings(body, camera, []) == []
    assert known_camera_warnings(body, camera, frames) == []
    X_WC = camera.X_WC.copy()
    X_WC[:3, 3] += [0.0, 0.8, 0.0]
    (text,) = known_camera_warnings(body, camera.with_pose(X_WC), frames)
    assert "--camera left" in text
    assert weight_of(text) == "wrong"
    behind = camera.with_pose(camera.X_WC @ np.diag([1.0, -1.0, -1.0, 1.0]))
    views = [MultiViewFrame.alone("left", one) for one in frames]
    require_seen_by(body, [camera], views)
    require_seen_by(body, [replace(behind, name="other")], views)
    with pytest.raises(CameraError, match="'left'"):
        require_seen_by(body, [behind], views)


@pytest.mark.parametrize(
    ("factor", "is_told", "is_new"), [(1.0, False, False), (0.955, True, False), (1.12, True, True)]
)
def test_a_wrong_focal_length_is_told_or_corrected(seen, factor, is_told, is_new) -> None:
    body, camera, frames = seen
    given = replace(camera, focal_x=factor * camera.focal_x, focal_y=factor * camera.focal_y)
    misfits = tuple(FrameMisfit(one.name, 0.0, 1.0, 1.0, True) for one in frames)
    found = RegisteredCamera(given, 1e-8 * np.eye(6), misfits)
    checked, deviation, texts = check_focal_length(body, found, frames)
    assert (len(texts), deviation > 0.0) == (is_told, is_new)
    if is_new:
        assert checked.camera.focal_x == pytest.approx(camera.focal_x, rel=0.01)
        assert np.linalg.norm(checked.camera.X_WC[:3, 3] - camera.X_WC[:3, 3]) < 0.02
        assert max(one.E_total for one in checked.frames) < 0.05
    else:
        assert checked.camera is given
    for text in texts:
        assert f"but {given.focal_x:.0f} is given" in text
        assert ("was written" in text) == is_new
        assert checked.translation_sd > found.translation_sd
    assert check_focal_length(body, replace(found, frames=misfits[:1]), frames[:1])[1:] == (0.0, [])
