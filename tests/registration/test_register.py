"""A camera is found without an initial guess from Drake's masks of an arm at known positions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.errors import RegistrationError
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import CameraSearch, RegistrationBody, uniform_rotations
from tests.registration.arm_pictures import MIDDLE, PLACE, errors, looking_at, see


class TestCameraSearch:
    def test_finds_a_camera_below_the_arm_and_upside_down(self, model, body):
        camera = looking_at(np.array([-0.9, 1.0, -0.6]), MIDDLE, 3.1)
        frames = see(model, body, camera, 5, 1)
        found = CameraSearch(body).register(camera.with_pose(np.eye(4)), frames)
        shift, turn = errors(found.camera.X_WC, camera.X_WC)
        assert shift < 2e-3
        assert turn < np.radians(0.05)
        assert (found.outliers, len(found.alternatives)) == ((), 0)
        own = replace(found, covariance=found.covariance - found.common)
        assert shift < 4.0 * np.sqrt(3.0) * own.translation_sd < 0.01
        # All that is seen of this arm turns with its first joint.
        assert found.rotation_sd * np.sqrt(3.0) == pytest.approx(np.radians(0.5), rel=0.2)
        assert all(frame.iou > 0.99 for frame in found.frames)

    def test_a_wrong_frame_is_an_outlier(self, model, body):
        camera = looking_at(PLACE, MIDDLE, 0.1)
        frames = see(model, body, camera, 5, 2)
        frames[3] = PosedFrame("0003", -frames[3].values, frames[3].mask)
        found = CameraSearch(body).register(camera, frames)
        shift, turn = errors(found.camera.X_WC, camera.X_WC)
        assert found.outliers == ("0003",)
        assert shift < 6e-4
        assert turn < np.radians(0.015)

    def test_a_search_without_frames_is_refused(self, body: RegistrationBody) -> None:
        with pytest.raises(RegistrationError, match="'eye': no frame"):
            CameraSearch(body).register(looking_at(PLACE, MIDDLE, 0.1), [])


class TestUniformRotations:
    def test_every_rotation_is_near_one_of_them(self) -> None:
        R = uniform_rotations(3000)
        assert np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-12)
        others = Rotation.random(500, random_state=3).as_matrix()
        trace_parts = np.einsum("nij,kij->kn", R, others)
        nearest = np.arccos(np.clip(0.5 * (trace_parts.max(axis=1) - 1.0), -1.0, 1.0))
        # Balls of this radius about all rotations would cover them about twice.
        assert np.degrees(nearest.max()) < 16.0
