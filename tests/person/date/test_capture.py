"""Contours, recognition, faces and one camera's share, on pictures that Drake renders."""

import cv2
import numpy as np
import pytest

from drake_pose.camera.models import FACE_CAMERA
from drake_pose.errors import SettingsError
from drake_pose.person.date.features import (
    SkinColour,
    cut_face,
    face_direction,
    find_face,
    head_angles,
    learn_faces,
    measure_contour,
    recognise,
    registered_positions,
    similarity,
    skin_blobs,
    stand_registered,
)
from drake_pose.systems.date import CaptureSetup
from tests.person.studio import shared_studio


@pytest.fixture(scope="module")
def studio():
    return shared_studio()


@pytest.fixture(scope="module")
def templates(studio):
    return studio.templates


class TestContours:
    def shape_of(self, mask):
        return measure_contour(mask).shape

    def star(self, size=1.0, turn=0.0, place=(200, 150)):
        angle = np.arange(10) * np.pi / 5 + turn
        reach = np.where(np.arange(10) % 2, 30, 90) * size
        points = np.column_stack([np.cos(angle) * reach, np.sin(angle) * reach]) + place
        mask = np.zeros((400, 500), np.uint8)
        return cv2.fillPoly(mask, [np.rint(points).astype(np.int32)], 1).astype(bool)

    def test_place_and_size_do_not_matter_but_shape_does(self):
        star = self.shape_of(self.star())
        moved = self.shape_of(self.star(1.5, 0.0, (230, 210)))
        turned = self.shape_of(self.star(1.0, 0.5))
        assert similarity(star, star) == 1.0
        assert similarity(star, moved) > 0.95
        assert similarity(star, turned) < 0.8

    def test_cut_off_or_empty_has_no_contour(self):
        assert measure_contour(np.zeros((20, 20), bool)) is None
        assert measure_contour(self.star(1.0, 0.0, (20, 100))) is None

    def test_middle_is_the_boxs(self):
        mask = np.zeros((40, 50), bool)
        mask[10:21, 5:16] = True
        np.testing.assert_allclose(measure_contour(mask).middle, [10, 15])


class TestRecognition:
    def test_registered_pose_is_found_wherever_it_stands(self, studio):
        registered = studio.registered
        generator = np.random.default_rng(0)
        cameras = list(studio.ring.values())
        for _ in range(2):
            q = np.array(registered.q)
            q[:3] += generator.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.0])
            heading = generator.uniform(-3.1, 3.1)
            q[registered.heading_position] = heading
            contours = [view.contour for view in studio.views(q).values()]
            found = recognise(studio.skeleton, registered, cameras, contours)
            assert found.cameras >= 6
            assert np.linalg.norm(found.q[:3] - q[:3]) < 0.06
            off = np.angle(np.exp(1j * (found.q[registered.heading_position] - heading)))
            assert abs(np.degrees(off)) < 5.0

    def test_registered_pose_is_upright_and_symmetric_and_stands_below_what_is_seen(self, studio):
        skeleton, cameras = studio.skeleton, list(studio.ring.values())
        spread = [skeleton.features(registered_positions(skeleton, by)) for by in (0.0, 30.0)]
        for head, left, right, *feet in spread:
            np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-9)
            np.testing.assert_allclose(np.mean(feet, axis=0)[:2], head[:2], atol=0.1)
        hanging, raised = (one[1] for one in spread)
        reach = np.linalg.norm(raised - hanging) / (2.0 * np.sin(np.radians(15.0)))
        assert reach == pytest.approx(sum(skeleton.limbs["left_arm"].lengths), rel=0.15)
        middle = np.array([0.2, -0.1, 0.8])
        q = stand_registered(
            skeleton, cameras, [one.project(middle[None])[0][0] for one in cameras]
        )
        head, _, _, *feet = skeleton.features(q)
        np.testing.assert_allclose((head + np.mean(feet, axis=0)) / 2.0, middle, atol=1e-6)

    @pytest.mark.parametrize(
        "other", [{}, {"left_upper_arm_z": 80}, {"left_upper_arm_x": -90, "right_upper_arm_x": -90}]
    )
    def test_other_poses_are_not_taken_for_it(self, studio, other):
        registered = studio.registered
        q = studio.posed(**other)
        contours = [view.contour for view in studio.views(q).values()]
        cameras = list(studio.ring.values())
        assert recognise(studio.skeleton, registered, cameras, contours, 0.93) is None

    def test_one_camera_is_not_enough(self, studio):
        registered = studio.registered
        view = studio.view(registered.q, "camera_0")
        cameras = list(studio.ring.values())
        contours = [view.contour] + [None] * 7
        assert recognise(studio.skeleton, registered, cameras, contours, 0.1) is None


class TestFaces:
    def test_directions_between_the_templates(self, studio, templates):
        generator = np.random.default_rng(1)

        def looks(direction):
            q = studio.posed()
            q[studio.skeleton.head_angles] = direction
            return studio.skeleton.head_rotation(q)[:, 2]

        errors = []
        for _ in range(12):
            q = studio.posed()
            direction = np.radians(generator.uniform([-50, -20], [50, 30]))
            q[studio.skeleton.head_angles] = direction
            q[:3] += generator.uniform(-0.05, 0.05, 3)
            picture, _ = studio.face(q)
            noisy = np.clip(picture + generator.normal(0, 3, picture.shape), 0, 255)
            noisy = noisy.astype(np.uint8)
            blobs = skin_blobs(noisy, studio.mask(q, FACE_CAMERA), SkinColour())
            found = face_direction(cut_face(noisy, blobs), templates)
            cosine = looks(direction) @ looks(found.direction)
            errors.append(np.degrees(np.arccos(min(1.0, cosine))))
        # The templates are 15 and 12 degrees apart: 7 on average for the nearest one.
        assert np.mean(errors) < 9.0

    def test_template_finds_itself_and_other_things_are_far(self, studio, templates):
        q = studio.posed()
        q[studio.skeleton.head_angles] = templates.directions[20]
        picture, view = studio.face(q)
        face = cut_face(picture, view.blobs)
        found = face_direction(face, templates)
        assert found.template == 20
        noise = np.random.default_rng(2).integers(0, 255, face.shape).astype(np.uint8)
        outside = face_direction(noise, templates).outside
        assert outside > 3 * found.outside + 30
        np.testing.assert_array_equal(
            find_face(picture, view.blobs, templates, 30.0), templates.directions[20]
        )
        patches = np.zeros((240, 320, 3), np.uint8)
        patches[50:180:20, 60:140] = patches[40:180, 60:140:20] = (217, 166, 135)
        blobs = skin_blobs(patches, np.ones((240, 320), bool), SkinColour())
        assert np.isnan(find_face(patches, blobs, templates, 30.0)).all()

    def test_eigenspace_is_that_of_a_singular_value_decomposition(self):
        generator = np.random.default_rng(3)
        faces = list(generator.integers(0, 255, (12, 130, 80, 3)).astype(np.uint8))
        found = learn_faces(faces, np.zeros((12, 2)), 5)
        data = np.stack([face.ravel() for face in faces]).astype(float)
        _, _, rows = np.linalg.svd(data - data.mean(axis=0), full_matrices=False)
        np.testing.assert_allclose(np.abs(found.basis @ rows[:5].T), np.eye(5), atol=1e-3)

    def test_no_face_where_skin_is_missing_or_cut_off(self):
        picture = np.zeros((50, 60, 3), np.uint8)
        region = np.ones((50, 60), bool)
        assert cut_face(picture, skin_blobs(picture, region, SkinColour())) is None
        picture[0:20, 10:30] = (217, 166, 135)
        assert cut_face(picture, skin_blobs(picture, region, SkinColour())) is None

    def test_too_few_faces(self):
        with pytest.raises(SettingsError, match="three faces"):
            learn_faces([np.zeros((130, 80, 3), np.uint8)] * 2, np.zeros((2, 2)))

    def test_head_angles_against_a_rotated_scene(self, studio):
        camera = studio.cameras[FACE_CAMERA]
        straight = np.array([0.0, 0.0, camera.X_WC[2, 3]])
        direction = np.array([0.3, 0.2])
        np.testing.assert_allclose(head_angles(direction, straight, camera), direction, atol=1e-12)
        # A person beside the axis who looks into the camera faces it.
        head = np.array([0.0, 0.8, camera.X_WC[2, 3] - 0.4])
        turn, nod = head_angles(np.zeros(2), head, camera)
        looking = [np.cos(nod) * np.cos(turn), np.cos(nod) * np.sin(turn), -np.sin(nod)]
        towards = camera.X_WC[:3, 3] - head
        np.testing.assert_allclose(looking, towards / np.linalg.norm(towards), atol=1e-12)


class TestCapture:
    def test_too_few_cameras(self, studio):
        with pytest.raises(SettingsError, match="two cameras"):
            CaptureSetup(studio.skeleton, dict(list(studio.ring.items())[:1]))
        with pytest.raises(SettingsError, match="face camera 'camera_3'"):
            CaptureSetup(studio.skeleton, studio.ring, studio.ring["camera_3"])

    def test_features_of_a_known_pose_change_the_skeleton_a_little_only(self, studio):
        skeleton = studio.skeleton
        q = studio.posed(left_forearm_x=-40, head_y=30)
        places = skeleton.features(q) + np.array([0.01, 0.0, 0.02])
        places[3] = np.nan
        places[4] += [0.0, 3.0, 0.0]
        other = skeleton.with_features(q, places)
        moved = other.features(q)
        np.testing.assert_allclose(moved[:3], places[:3], atol=1e-12)
        np.testing.assert_allclose(moved[3], skeleton.features(q)[3], atol=1e-12)
        assert np.linalg.norm(moved[4] - skeleton.features(q)[4]) == pytest.approx(0.05)
        assert other.limbs["left_arm"].lengths != skeleton.limbs["left_arm"].lengths
