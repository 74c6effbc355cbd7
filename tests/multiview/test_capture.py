"""Contours, recognition, faces and the whole capture, on pictures that Drake renders."""

import cv2
import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.rigs import FACE_CAMERA, circle_of_cameras
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.multiview.capture import (
    CaptureSettings,
    CaptureSetup,
    capture_frame,
    see_person,
    start_state,
)
from drake_pose.multiview.contours import measure_contour, similarity
from drake_pose.multiview.faces import cut_face, face_direction, head_angles, learn_faces
from drake_pose.multiview.features import find_features
from drake_pose.multiview.recognition import recognise, register_pose, registered_positions
from drake_pose.multiview.regions import learn_background
from drake_pose.multiview.skeleton import FEATURES, LIMBS, load_skeleton, rotation
from drake_pose.multiview.skin_blobs import SkinColour, skin_blobs
from drake_pose.systems.camera_rig import build_camera_rig

SETTINGS = CaptureSettings()


class Studio:
    """A simulated person before nine cameras."""

    def __init__(self):
        self.model = load_model(bundled_model("person"), check=False)
        self.skeleton = load_skeleton(self.model)
        self.cameras = circle_of_cameras(8, size=(320, 240))
        self.ring = {n: c for n, c in self.cameras.items() if n != FACE_CAMERA}
        self.rig = build_camera_rig(self.model, self.cameras)
        self.context = self.rig.diagram.CreateDefaultContext()

    def posed(self, **degrees):
        q = np.array(self.model.default_positions)
        q[self.skeleton.head_positions[2]] = 1.55
        for name, value in degrees.items():
            q[self.model.position_index(name)] = np.radians(value)
        return q

    def picture(self, q, name):
        self.rig.set_positions(self.context, q)
        return self.rig.picture(self.context, name)

    def mask(self, q, name):
        self.rig.set_positions(self.context, q)
        return self.rig.mask(self.context, name)

    def view(self, q, name):
        return see_person(self.picture(q, name), SETTINGS, self.mask(q, name))

    def views(self, q):
        return {name: self.view(q, name) for name in self.ring}

    def face(self, q):
        picture = self.picture(q, FACE_CAMERA)
        return picture, see_person(picture, SETTINGS, self.mask(q, FACE_CAMERA))


@pytest.fixture(scope="module")
def studio():
    return Studio()


@pytest.fixture(scope="module")
def registered(studio):
    q = registered_positions(studio.skeleton)
    q[2] = 1.55
    cameras = list(studio.ring.values())
    return register_pose(
        studio.skeleton, q, cameras, lambda camera, q: studio.mask(q, camera.name), 36
    )


@pytest.fixture(scope="module")
def calibrated(studio, registered):
    """The skeleton whose features are where the cameras see them."""
    views = studio.views(registered.q)
    found = find_features(
        list(studio.ring.values()),
        [view.blobs.centroids for view in views.values()],
        [view.region for view in views.values()],
        studio.skeleton.features(registered.q),
    )
    assert (found.support > 10).all()
    return studio.skeleton.with_features(registered.q, found.places)


@pytest.fixture(scope="module")
def templates(studio):
    turns, nods = np.radians(np.linspace(-60, 60, 9)), np.radians(np.linspace(-25, 35, 6))
    directions = np.array([(turn, nod) for turn in turns for nod in nods])
    faces = []
    for turn, nod in directions:
        q = studio.posed()
        q[studio.skeleton.head_angles] = turn, nod
        picture, view = studio.face(q)
        faces.append(cut_face(picture, view.blobs))
    return learn_faces(faces, directions)


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
    def test_registered_pose_is_found_wherever_it_stands(self, studio, registered):
        generator = np.random.default_rng(0)
        cameras = list(studio.ring.values())
        for _ in range(4):
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

    @pytest.mark.parametrize(
        "other", [{}, {"left_upper_arm_z": 80}, {"left_upper_arm_x": -90, "right_upper_arm_x": -90}]
    )
    def test_other_poses_are_not_taken_for_it(self, studio, registered, other):
        q = studio.posed(**other)
        contours = [view.contour for view in studio.views(q).values()]
        cameras = list(studio.ring.values())
        assert recognise(studio.skeleton, registered, cameras, contours, 0.93) is None

    def test_one_camera_is_not_enough(self, studio, registered):
        view = studio.view(registered.q, "camera_0")
        cameras = list(studio.ring.values())
        contours = [view.contour] + [None] * 7
        assert recognise(studio.skeleton, registered, cameras, contours, 0.1) is None


class TestFaces:
    def test_directions_between_the_templates(self, studio, templates):
        generator = np.random.default_rng(1)
        axes = studio.skeleton.head_axes
        errors = []
        for _ in range(25):
            q = studio.posed()
            direction = np.radians(generator.uniform([-50, -20], [50, 30]))
            q[studio.skeleton.head_angles] = direction
            q[:3] += generator.uniform(-0.05, 0.05, 3)
            picture, _ = studio.face(q)
            noisy = np.clip(picture + generator.normal(0, 3, picture.shape), 0, 255)
            noisy = noisy.astype(np.uint8)
            blobs = skin_blobs(noisy, studio.mask(q, FACE_CAMERA), SkinColour())
            found = face_direction(cut_face(noisy, blobs), templates)
            cosine = rotation(axes, direction)[:, 2] @ rotation(axes, found.direction)[:, 2]
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
        assert found.distance < 1.0
        noise = np.random.default_rng(2).integers(0, 255, face.shape).astype(np.uint8)
        assert face_direction(noise, templates).outside > 3 * found.outside + 30

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
    def setup_of(self, studio, calibrated, templates=None, registered=None, **settings):
        return CaptureSetup(
            calibrated,
            studio.ring,
            studio.cameras[FACE_CAMERA] if templates else None,
            templates,
            registered,
            CaptureSettings(**settings),
        )

    def test_features_are_measured_where_they_are(self, studio, calibrated):
        q = studio.posed(left_upper_arm_x=-60, left_upper_arm_z=20, right_upper_arm_z=-40)
        views = studio.views(q)
        last = calibrated.features(q) + np.random.default_rng(4).normal(0, 0.03, (5, 3))
        found = find_features(
            list(studio.ring.values()),
            [view.blobs.centroids for view in views.values()],
            [view.region for view in views.values()],
            last,
        )
        errors = np.linalg.norm(found.places - calibrated.features(q), axis=1)
        assert (found.support > 0).all()
        assert errors.max() < 0.03, dict(zip(FEATURES, errors, strict=True))

    def test_movement_is_followed(self, studio, calibrated, templates):
        setup = self.setup_of(studio, calibrated, templates)
        start = studio.posed(left_upper_arm_z=10, right_upper_arm_z=-10, left_forearm_x=-10)
        goal = studio.posed(
            left_upper_arm_x=-50, left_upper_arm_z=10, left_forearm_x=-50, right_upper_arm_z=-50,
            left_thigh_x=-25, left_shin_x=30, head_y=12,
        )  # fmt: skip
        state = start_state(calibrated, start)
        for share in np.linspace(0, 1, 8)[1:]:
            q = start + share * (goal - start)
            frame = capture_frame(setup, state, studio.views(q), studio.face(q))
            state = frame.state
            assert set(frame.milliseconds) == {"features", "face", "pose"}
        for name in LIMBS:
            errors = np.linalg.norm(
                frame.pose.limbs[name] - calibrated.limb_points(q, name), axis=1
            )
            assert errors[0] < 0.06
            assert errors[1] < 0.10
            assert errors[2] < 0.04
            ends = calibrated.limb_points(state.q, name)[2]
            assert np.linalg.norm(ends - calibrated.limb_points(q, name)[2]) < 0.05

    def test_lost_track_is_mended_by_the_registered_pose(self, studio, calibrated, registered):
        setup = self.setup_of(studio, calibrated, None, registered)
        wrong = start_state(calibrated, studio.posed(head_y=150, left_thigh_x=-90))
        moving = studio.views(studio.posed(left_upper_arm_z=45, right_upper_arm_x=-40))
        lost = capture_frame(setup, wrong, moving)
        assert lost.recognition is None
        q = np.array(registered.q)
        q[:2] = 0.15, -0.1
        mended = capture_frame(setup, lost.state, studio.views(q))
        assert mended.recognition is not None
        errors = [
            calibrated.limb_points(mended.state.q, n) - calibrated.limb_points(q, n) for n in LIMBS
        ]
        assert np.linalg.norm(errors, axis=-1).max() < 0.12

    def test_nobody_known_yet(self, studio, calibrated, registered):
        setup = self.setup_of(studio, calibrated, None, registered)
        assert capture_frame(setup, None, studio.views(studio.posed())) is None
        assert capture_frame(setup, None, studio.views(registered.q)) is not None

    def test_cameras_may_stop(self, studio, calibrated):
        setup = self.setup_of(studio, calibrated)
        q = studio.posed(left_upper_arm_z=30, right_upper_arm_z=-30)
        state = start_state(calibrated, q)
        views = studio.views(q)
        some = {name: view for name, view in views.items() if name in ("camera_1", "camera_6")}
        for seen in (some, dict(list(views.items())[:1]), {}):
            frame = capture_frame(setup, state, seen)
            assert np.isfinite(frame.state.q).all()
        assert not frame.features.support.any()
        with pytest.raises(UnknownNameError, match="camera_9"):
            capture_frame(setup, state, {"camera_9": views["camera_0"]})

    def test_background_instead_of_a_mask(self, studio):
        generator = np.random.default_rng(5)
        away = studio.posed()
        away[2] = -8.0
        empty = studio.picture(away, "camera_0").astype(float)
        shots = [
            np.clip(empty + generator.normal(0, 2, empty.shape), 0, 255).astype(np.uint8)
            for _ in range(5)
        ]
        q = studio.posed(left_upper_arm_z=60)
        background = learn_background(shots)
        found = see_person(studio.picture(q, "camera_0"), SETTINGS, background=background)
        true = studio.mask(q, "camera_0")
        assert (found.region & true).sum() / (found.region | true).sum() > 0.93
        with pytest.raises(SettingsError, match="background"):
            see_person(shots[0], SETTINGS)

    def test_too_few_cameras(self, studio, calibrated):
        with pytest.raises(SettingsError, match="two cameras"):
            CaptureSetup(calibrated, dict(list(studio.ring.items())[:1]))

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
