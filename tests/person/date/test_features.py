"""Skin, features in space, contours, recognition and faces, drawn by hand or by Drake."""

from itertools import product

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import FACE_CAMERA, ParallelCamera, circle_of_cameras, look_at
from drake_pose.errors import SceneError, SettingsError
from drake_pose.person.date.features import (
    Blobs,
    PersonView,
    cut_face,
    find_face,
    find_features,
    head_angles,
    learn_faces,
    learn_recorded_faces,
    measure_contour,
    nearest_template,
    place_registered,
    recognise,
    similarity,
    skin_blobs,
)
from drake_pose.person.date.skeleton import registered_positions
from drake_pose.person.views import meeting_points, viewing_rays

SKIN = (217, 166, 135)
SHIRT = (31, 115, 128)


def disc(shape, center, radius):
    row, column = np.indices(shape)
    return (column - center[0]) ** 2 + (row - center[1]) ** 2 <= radius**2


class TestSkin:
    @pytest.mark.parametrize("shade", [1.0, 0.7, 0.45])
    def test_blobs_are_found_in_light_and_shade(self, shade):
        picture = np.full((120, 160, 3), SHIRT, np.uint8)
        discs = [disc((120, 160), (40.0, 30.0), 12), disc((120, 160), (110.0, 80.0), 6)]
        for d in discs:
            picture[d] = np.array(SKIN) * shade
        blobs = skin_blobs(picture, np.ones((120, 160), bool))
        np.testing.assert_allclose(blobs.centroids, [[40, 30], [110, 80]], atol=0.2)
        assert blobs.areas.tolist() == [d.sum() for d in discs]
        assert blobs.boxes[0].tolist() == [28, 18, 25, 25]
        assert np.array_equal(blobs.mask, discs[0] | discs[1])

    def test_skin_outside_the_region_and_specks_are_ignored(self):
        picture = np.full((120, 160, 3), SHIRT, np.uint8)
        picture[disc((120, 160), (40, 30), 12)] = SKIN
        picture[60:63, 60:63] = SKIN
        region = np.ones((120, 160), bool)
        region[:, :60] = False
        assert not len(skin_blobs(picture, region).areas)
        assert not len(skin_blobs(picture, np.zeros_like(region)).areas)


class TestRays:
    cameras = (
        *circle_of_cameras(3).values(),
        ParallelCamera("flat", 300, 300, 226.0, 150, 150, look_at([2, 1, 1], [0, 0, 1])),
    )

    def test_rays_pass_through_projected_points(self):
        p_W = np.random.default_rng(1).uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 1.5], (20, 3))
        for camera in self.cameras:
            origins, directions = viewing_rays(camera, camera.project(p_W)[0])
            np.testing.assert_allclose(np.cross(p_W - origins, directions), 0.0, atol=1e-12)
            np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)

    @pytest.mark.parametrize("apart", [0.03, 0.06])
    def test_meeting_point_is_half_way_between_close_rays(self, apart):
        """Rays along x and along y: their distance is along z."""
        point = np.array([0.2, -0.1, 1.0])
        poses = [look_at([4.0, 0, 1], [0, 0, 1]), look_at([0, 4.0, 1], [0, 0, 1])]
        cameras = [ParallelCamera(str(k), 300, 300, 90.0, 150, 150, X) for k, X in enumerate(poses)]
        moved = point + apart * np.eye(3)[2]
        pixels = [cameras[0].project(point[None])[0], cameras[1].project(moved[None])[0]]
        found = meeting_points(cameras, pixels, 0.05)
        expected = [0.5 * (point + moved)] if apart < 0.05 else np.empty((0, 3))
        np.testing.assert_allclose(found, expected, atol=1e-9)
        assert not len(meeting_points(cameras, pixels, 0.05, [np.array([False])] * 2))

    def test_parallel_rays_and_points_behind_do_not_meet(self):
        pose = look_at([4.0, 0, 1], [0, 0, 1])
        behind = look_at([5.0, -1.0, 1], [5.0, -2.0, 1])
        for other in (pose, behind):
            cameras = [
                ParallelCamera(n, 9, 9, 9.0, 4, 4, X) for n, X in (("a", pose), ("b", other))
            ]
            middle = np.array([[4.0, 4.0]])
            assert not len(meeting_points(cameras, [middle, middle], 9.0))


class TestFeatures:
    places = np.array([[0, 0, 1.5], [0, 0.5, 1], [0, -0.5, 1], [0.1, 0.1, 0], [0, -0.1, 0]])

    def seen(self, places):
        generator = np.random.default_rng(0)
        cameras = list(circle_of_cameras(8, face_camera=False).values())
        centroids = [
            camera.project(places)[0] + generator.normal(0, 0.3, (len(places), 2))
            for camera in cameras
        ]
        views = []
        for camera, uv in zip(cameras, centroids, strict=True):
            region = np.zeros((camera.height, camera.width), bool)
            for middle in camera.project(places)[0]:
                region |= disc(region.shape, middle, 12)
            views.append(self.view(uv, region))
        return cameras, views

    def view(self, centroids, region):
        blobs = Blobs(centroids, np.ones(len(centroids)), np.ones((len(centroids), 4)), region)
        return PersonView(region, blobs, None)

    def test_positions_are_recovered(self):
        cameras, views = self.seen(self.places)
        last = self.places + np.random.default_rng(3).normal(0, 0.03, self.places.shape)
        found = find_features(cameras, views, last)
        assert np.linalg.norm(found.positions - self.places, axis=1).max() < 0.01
        assert (found.support >= 20).all()

    def test_accidental_meeting_points_are_dropped(self):
        cameras, views = self.seen(self.places)
        points = meeting_points(cameras, [view.blobs.centroids for view in views], 0.05)
        found = find_features(cameras, views, self.places)
        for some, wrong in ((points, True), (found.points, False)):
            away = np.linalg.norm(some[:, None] - self.places[None], axis=2).min(axis=1)
            assert (away > 0.15).any() == wrong
        # A position is the mean of the densest points only.
        for k, place in enumerate(found.positions):
            mine = found.points[found.owners == k]
            near = np.linalg.norm(mine[:, None] - mine[None], axis=2) <= 0.08
            assert found.support[k] == near.sum(axis=1).max()
            means = [mine[row].mean(axis=0) for row in near]
            assert np.linalg.norm(means - place, axis=1).min() < 1e-12

    def test_unseen_feature_stays_and_camera_with_an_empty_region_is_ignored(self):
        cameras, views = self.seen(np.delete(self.places, 2, axis=0))
        views[0] = self.view(np.empty((0, 2)), np.zeros_like(views[0].region))
        last = self.places + 0.01
        found = find_features(cameras, views, last)
        assert found.support[2] == 0
        assert np.array_equal(found.positions[2], last[2])
        others = np.delete(np.arange(5), 2)
        assert (found.support[others] > 0).all()
        off = np.linalg.norm(found.positions - self.places, axis=1)[others]
        assert off.max() < 0.01


class TestContours:
    def star(self, size=1.0, turn=0.0, place=(200, 150)):
        angle = np.arange(10) * np.pi / 5 + turn
        reach = np.where(np.arange(10) % 2, 30, 90) * size
        points = np.column_stack([np.cos(angle) * reach, np.sin(angle) * reach]) + place
        mask = np.zeros((400, 500), np.uint8)
        return cv2.fillPoly(mask, [np.rint(points).astype(np.int32)], 1).astype(bool)

    def test_contour_is_invariant_to_position_and_size(self):
        stars = self.star(), self.star(1.5, 0.0, (230, 210)), self.star(1.0, 0.5)
        star, moved, turned = (measure_contour(one)[0] for one in stars)
        assert similarity(star, star) == 1.0
        assert similarity(star, moved) > 0.95
        assert similarity(star, turned) < 0.8

    def test_middle_is_the_boxs_and_cut_off_or_empty_regions_have_no_contour(self):
        mask = np.zeros((40, 50), bool)
        mask[10:21, 5:16] = True
        np.testing.assert_allclose(measure_contour(mask)[1], [10, 15])
        assert measure_contour(np.zeros((20, 20), bool)) is None
        assert measure_contour(self.star(1.0, 0.0, (20, 100))) is None


class TestRecognition:
    def test_registered_pose_is_recognised_anywhere(self, studio):
        registered = studio.registered
        generator = np.random.default_rng(0)
        cameras = list(studio.ring.values())
        for _ in range(2):
            q = np.array(registered.q)
            q[:3] += generator.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.0])
            heading = generator.uniform(-3.1, 3.1)
            q[registered.heading_position] = heading
            contours = [view.contour for view in studio.views(q).values()]
            found, _ = recognise(studio.skeleton, registered, cameras, contours, 0.9)
            assert np.linalg.norm(found[:3] - q[:3]) < 0.06
            off = np.angle(np.exp(1j * (found[registered.heading_position] - heading)))
            assert abs(np.degrees(off)) < 5.0

    def test_registered_pose_is_upright_symmetric_and_placed_by_the_contours(self, studio):
        skeleton, cameras = studio.skeleton, list(studio.ring.values())
        spread = [skeleton.features(registered_positions(skeleton, by)) for by in (0.0, 30.0)]
        for head, left, right, *feet in spread:
            np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-9)
            np.testing.assert_allclose(np.mean(feet, axis=0)[:2], head[:2], atol=0.1)
        hanging, raised = (one[1] for one in spread)
        reach = np.linalg.norm(raised - hanging) / (2.0 * np.sin(np.radians(15.0)))
        assert reach == pytest.approx(sum(skeleton.limbs["left_arm"].lengths), rel=0.15)
        middle = np.array([0.2, -0.1, 0.8])
        q = place_registered(
            skeleton, cameras, [one.project(middle[None])[0][0] for one in cameras]
        )
        head, _, _, *feet = skeleton.features(q)
        np.testing.assert_allclose((head + np.mean(feet, axis=0)) / 2.0, middle, atol=1e-6)

    @pytest.mark.parametrize(
        "other", [{}, {"left_upper_arm_z": 80}, {"left_upper_arm_x": -90, "right_upper_arm_x": -90}]
    )
    def test_other_poses_are_not_recognised(self, studio, other):
        cameras, views = list(studio.ring.values()), studio.views(studio.posed(**other))
        contours = [view.contour for view in views.values()]
        assert recognise(studio.skeleton, studio.registered, cameras, contours, 0.93) is None
        # One camera is not enough.
        alone = [contours[0]] + [None] * 7
        assert recognise(studio.skeleton, studio.registered, cameras, alone, 0.0) is None


class TestFaces:
    def test_directions_between_the_templates(self, studio):
        templates = studio.templates
        generator, errors = np.random.default_rng(1), []
        for _ in range(12):
            q, direction = studio.posed(), np.radians(generator.uniform([-50, -20], [50, 30]))
            q[studio.skeleton.head_angles] = direction
            q[:3] += generator.uniform(-0.05, 0.05, 3)
            picture, _ = studio.face(q)
            noisy = np.clip(picture + generator.normal(0, 3, picture.shape), 0, 255)
            noisy = noisy.astype(np.uint8)
            blobs = skin_blobs(noisy, studio.mask(q, FACE_CAMERA))
            nearest, _ = nearest_template(cut_face(noisy, blobs), templates)
            # Turn about the vertical, then nod.
            ways = Rotation.from_euler("ZY", [direction, templates.directions[nearest]])
            errors.append(np.degrees(np.arccos(min(1.0, np.prod(ways.apply([1, 0, 0]), 0).sum()))))
        # Templates are 15 and 12 degrees apart, the nearest one 7 degrees on average.
        assert np.mean(errors) < 9.0

    def test_template_finds_itself_and_other_pictures_have_a_large_residual(self, studio):
        q, templates = studio.posed(), studio.templates
        q[studio.skeleton.head_angles] = templates.directions[20]
        picture, view = studio.face(q)
        face = cut_face(picture, view.blobs)
        nearest, off = nearest_template(face, templates)
        assert nearest == 20
        noise = np.random.default_rng(2).integers(0, 255, face.shape).astype(np.uint8)
        assert nearest_template(noise, templates)[1] > 3 * off + 30
        np.testing.assert_array_equal(
            find_face(picture, view.blobs, templates, 30.0), templates.directions[20]
        )
        patches = np.zeros((240, 320, 3), np.uint8)
        patches[50:180:20, 60:140] = patches[40:180, 60:140:20] = SKIN
        blobs = skin_blobs(patches, np.ones((240, 320), bool))
        assert np.isnan(find_face(patches, blobs, templates, 30.0)).all()

    def test_eigenspace_is_that_of_a_singular_value_decomposition(self):
        generator = np.random.default_rng(3)
        faces = list(generator.integers(0, 255, (12, 130, 80, 3)).astype(np.uint8))
        found = learn_faces(faces, np.zeros((12, 2)), 5)
        data = np.stack([face.ravel() for face in faces]).astype(float)
        _, _, rows = np.linalg.svd(data - data.mean(axis=0), full_matrices=False)
        np.testing.assert_allclose(np.abs(found.basis @ rows[:5].T), np.eye(5), atol=1e-3)

    def test_missing_or_cut_off_faces_and_too_few_templates_are_refused(self):
        picture = np.zeros((50, 60, 3), np.uint8)
        region = np.ones((50, 60), bool)
        assert cut_face(picture, skin_blobs(picture, region)) is None
        picture[0:20, 10:30] = SKIN
        assert cut_face(picture, skin_blobs(picture, region)) is None
        with pytest.raises(SettingsError, match="three faces"):
            learn_faces([np.zeros((130, 80, 3), np.uint8)] * 2, np.zeros((2, 2)))

    def test_head_angles_against_a_rotated_scene(self, studio):
        camera = studio.cameras[FACE_CAMERA]
        straight = np.array([0.0, 0.0, camera.X_WC[2, 3]])
        direction = np.array([0.3, 0.2])
        np.testing.assert_allclose(head_angles(direction, straight, camera), direction, atol=1e-12)
        # A person beside the optical axis who looks into the camera has direction 0.
        head = np.array([0.0, 0.8, camera.X_WC[2, 3] - 0.4])
        turn, nod = head_angles(np.zeros(2), head, camera)
        looking = [np.cos(nod) * np.cos(turn), np.cos(nod) * np.sin(turn), -np.sin(nod)]
        towards = camera.X_WC[:3, 3] - head
        np.testing.assert_allclose(looking, towards / np.linalg.norm(towards), atol=1e-12)


class TestSkeleton:
    def test_measured_features_change_the_skeleton_by_a_bounded_distance(self, studio):
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


@pytest.fixture(scope="module")
def folder(studio, tmp_path_factory):
    """Faces recorded by the face camera."""
    root = tmp_path_factory.mktemp("faces")
    lines = ["picture,turn,nod"]
    for turn, nod in product((-40.0, -20.0, 0.0, 20.0, 40.0), (-10.0, 10.0)):
        q = studio.posed()
        q[studio.skeleton.head_angles] = np.radians([turn, nod])
        name = f"{turn:+.0f}_{nod:+.0f}.png"
        cv2.imwrite(str(root / name), studio.picture(q, FACE_CAMERA)[:, :, ::-1])
        lines.append(f"{name},{turn},{nod}")
    cv2.imwrite(str(root / "grey.png"), np.full((240, 320, 3), 128, np.uint8))
    (root / "directions.csv").write_text("\n".join(lines) + "\n\n")
    return root


class TestRecordedFaces:
    def test_direction_of_another_picture(self, studio, folder):
        faces = learn_recorded_faces(folder)
        assert faces.directions.shape == (10, 2)
        for direction in ([-37.0, 8.0], [16.0, -8.0]):
            q = studio.posed()
            q[studio.skeleton.head_angles] = np.radians(direction)
            picture, view = studio.face(q)
            found = np.degrees(find_face(picture, view.blobs, faces, 60.0))
            # The nearest template's direction; templates are 20 degrees apart.
            assert found == pytest.approx(np.round(np.divide(direction, 20)) * 20, abs=10.1)
            assert np.sign(found).tolist() == np.sign(direction).tolist()

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "is empty"),
            ("picture,turn\n", "first line must be picture,turn,nod"),
            ("picture,turn,nod\n+0_+10.png,1\n", "line 2 has 2 columns"),
            ("picture,turn,nod\n+0_+10.png,a,1\n", "line 2: expected a picture and two angles"),
            ("picture,turn,nod\n../x.png,1,1\n", r"line 2: '\.\./x\.png' is no picture"),
            ("picture,turn,nod\n+0_+10.png,nan,1\n", "line 2: turn and nod"),
            ("picture,turn,nod\n+0_+10.png,0,1\n+0_+10.png,0,1\n", "line 3: .* has a line already"),
            ("picture,turn,nod\nno.png,0,1\n", r"no\.png: cannot read"),
            ("picture,turn,nod\ngrey.png,0,0\n", r"grey\.png: no face"),
            (None, r"directions\.csv: cannot read"),
        ],
    )
    def test_bad_tables_and_pictures_are_named(self, folder, tmp_path, text, message):
        for path in folder.glob("*.png"):
            (tmp_path / path.name).write_bytes(path.read_bytes())
        if text is not None:
            (tmp_path / "directions.csv").write_text(text)
        with pytest.raises(SceneError, match=message):
            learn_recorded_faces(tmp_path)
