"""A suggested pose is inside the limits, touches nothing, and Drake sees the difference."""

import numpy as np

from drake_pose.body import ArticulatedModel
from drake_pose.registration.register import RegistrationBody, suggest_pose
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.registration.arm_pictures import looking_at

MIDDLE = np.array([0.0, 0.0, 0.4])
BEHIND = ((-2.0, -2.0, -1.0), (-0.2, 2.0, 2.0))


class TestSuggestPose:
    def test_tells_two_sides_of_the_arm_apart(
        self, model: ArticulatedModel, body: RegistrationBody
    ) -> None:
        """From the front and from behind the arm's zero pose looks the same but for its boxes."""
        places = [np.array([1.8, 0.0, 0.4]), np.array([-1.8, 0.0, 0.4])]
        cameras = [looking_at(place, MIDDLE, 0.0) for place in places]
        poses = [camera.X_WC for camera in cameras]
        found = suggest_pose(body, cameras[0], poses, [BEHIND], seed=1)
        assert found is not None
        values, told = found
        kinematics = body.kinematics
        assert np.all((values >= kinematics.lower) & (values <= kinematics.upper))
        X_WN = kinematics.poses(values)
        for outline, X in zip(body.all, X_WN, strict=True):
            # Its surfaces' points, but for what the coarse ones leave out.
            assert (outline.vertices @ X[0, :3] + X[0, 3]).min() > BEHIND[1][0] - 0.02
        q, X_WB = body.tree.positions_from(kinematics.split(values))
        masks = [LabelRenderer(model, camera).mask(q, X_WB) for camera in cameras]
        area = np.mean([np.count_nonzero(mask) for mask in masks])
        difference = np.count_nonzero(masks[0] != masks[1]) / area
        assert abs(difference - told) < 0.1
        assert difference > 0.5

    def test_no_room_no_pose(self, body: RegistrationBody) -> None:
        camera = looking_at(np.array([1.8, 0.0, 0.4]), MIDDLE, 0.0)
        everywhere = ((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))
        assert suggest_pose(body, camera, [camera.X_WC] * 2, [everywhere], tried=5) is None
