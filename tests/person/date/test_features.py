"""Skin, features in space, contours, recognition and faces, drawn by hand or by Drake."""

from itertools import product

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import FACE_CAMERA, circle_of_cameras
from drake_pose.errors import SceneError, SettingsError
from drake_pose.person.date import features
from drake_pose.person.views import meeting_points

SKIN = (217, 166, 135)
SHIRT = (31, 115, 128)


def disc(shape, center, radius):
    row, column = np.indices(shape)
    return (column - center[0]) ** 2 + (row - center[1]) ** 2 <= radius**2


class TestSkin:
    @pytest.mark.parametrize("shade", [1.0, 0.7, 0.45])
    def test_blobs_are_the_largest_skin_coloured_parts_of_the_region(self, shade):
        picture, region = np.full((120, 160, 3), SHIRT, np.uint8), np.zeros((120, 160), bool)
        region[10:110, 20:150] = True
        places = [((40.0, 30.0), 12), ((110.0, 80.0), 6), ((80.0, 50.0), 4), ((5.0, 60.0), 9)]
        discs = [disc((120, 160), *place) for place in places]
        for d in discs:
            picture[d] = np.array(SKIN) * shade
        picture[100:103, 60:63] = SKIN
        blobs = features.skin_blobs(picture, region)
        np.testing.assert_allclose(blobs.centroids, [[40, 30], [110, 80], [80, 50]], atol=0.2)
        assert blobs.areas.tolist() == [d.sum() for d in discs[:3]]
        assert blobs.boxes.tolist() == [[28, 18, 25, 25], [104, 74, 13, 13], [76, 46, 9, 9]]
        assert np.array_equal(blobs.mask, discs[0] | discs[1] | discs[2])
        assert len(features.skin_blobs(picture, region, max_count=2).areas) == 2
        assert len(features.skin_blobs(picture, region, min_area=discs[2].sum()).areas) == 3
        assert len(features.skin_blobs(picture, region, min_area=discs[2].sum() + 1).areas) == 2
        assert len(features.skin_blobs(picture, region, min_area=9).areas) == 4
        nothing = features.skin_blobs(picture, np.zeros_like(region))
        assert (len(nothing.areas), nothing.mask.any()) == (0, False)
        with pytest.raises(SettingsError, match=r"\(120, 160\), but the picture \(119, 160"):
            features.see_person(picture[1:], region)


class TestFeatures:
    places = np.array([[0, 0, 1.5], [0, 0.5, 1], [0, -0.5, 1], [0.1, 0.1, 0], [0, -0.1, 0]])

    def seen(self, places):
        """Cameras, and views of skin at places: discs of the silhouette, seen with noise."""
        generator, views = np.random.default_rng(0), []
        cameras = list(circle_of_cameras(8, face_camera=False).values())
        for camera in cameras:
            uv = camera.project(places)[0]
            region = np.zeros((camera.height, camera.width), bool)
            for middle in uv:
                region |= disc(region.shape, middle, 12)
            views.append(self.view(uv + generator.normal(0, 0.3, uv.shape), region))
        return cameras, views

    def view(self, centroids, region):
        count = len(centroids)
        blobs = features.Blobs(centroids, np.ones(count), np.ones((count, 4)), region)
        return features.PersonView(region, blobs, None)

    def test_accidental_meeting_points_are_dropped(self):
        cameras, views = self.seen(self.places)
        points = meeting_points(cameras, [view.blobs.centroids for view in views], 0.05)
        found = features.find_features(cameras, views, self.places)
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
        last, others = self.places + 0.01, np.delete(np.arange(5), 2)
        found = features.find_features(cameras, views, last)
        assert np.array_equal(found.positions[2], last[2])
        assert (found.support > 0).tolist() == [True, True, False, True, True]
        assert np.linalg.norm(found.positions - self.places, axis=1)[others].max() < 0.01


class TestContours:
    def star(self, size=1.0, turn=0.0, place=(200, 150)):
        angle = np.arange(10) * np.pi / 5 + turn
        reach = np.where(np.arange(10) % 2, 30, 90) * size
        points = np.column_stack([np.cos(angle) * reach, np.sin(angle) * reach]) + place
        mask = np.zeros((400, 500), np.uint8)
        return cv2.fillPoly(mask, [np.rint(points).astype(np.int32)], 1).astype(bool)

    def test_contour_has_the_farthest_edge_pixels_of_each_direction(self):
        """By brute force over the region's pixels, about its centroid."""
        region = self.star(1.0, 0.3, (210, 180))
        shape, middle = features.measure_contour(region)
        moved, _ = features.measure_contour(self.star(1.5, 0.3, (230, 210)))
        turned, _ = features.measure_contour(self.star(1.0, 0.8))
        assert features.similarity(shape, shape) == 1.0
        assert features.similarity(shape, turned) < 0.8 < 0.95 < features.similarity(shape, moved)
        off = np.abs(shape - turned).sum() / np.maximum(shape, turned).sum()
        assert features.similarity(shape, turned) == pytest.approx(1.0 - off)
        v, u = np.nonzero(region)
        np.testing.assert_allclose(middle, [(u.min() + u.max()) / 2, (v.min() + v.max()) / 2])
        x, y = u - u.mean(), v.mean() - v
        sector = (np.arctan2(y, x) // (2.0 * np.pi / len(shape))).astype(int) % len(shape)
        expected = [np.hypot(x, y)[sector == k].max() for k in range(len(shape))]
        np.testing.assert_allclose(shape * np.sqrt(len(u)), expected, rtol=0.02)
        square = np.zeros((40, 50), bool)
        square[10:21, 5:16] = True
        np.testing.assert_allclose(features.measure_contour(square)[1], [10, 15])
        for edge in (np.s_[0, 8], np.s_[-1, 8], np.s_[12, 0], np.s_[12, -1]):
            touching = square.copy()
            touching[edge] = True
            assert features.measure_contour(touching) is None
        assert features.measure_contour(np.zeros((20, 20), bool)) is None


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
            found, _ = features.recognise(studio.skeleton, registered, cameras, contours, 0.9)
            assert np.linalg.norm(found[:3] - q[:3]) < 0.06
            off = np.angle(np.exp(1j * (found[registered.heading_position] - heading)))
            assert abs(np.degrees(off)) < 5.0

    def test_registered_pose_is_placed_by_the_contours(self, studio):
        skeleton, cameras = studio.skeleton, list(studio.ring.values())
        middle = np.array([0.2, -0.1, 0.8])
        pixels = [one.project(middle[None])[0][0] for one in cameras]
        head, _, _, *feet = skeleton.features(features.place_registered(skeleton, cameras, pixels))
        np.testing.assert_allclose((head + np.mean(feet, axis=0)) / 2.0, middle, atol=1e-6)

    @pytest.mark.parametrize(
        "other", [{}, {"left_upper_arm_z": 80}, {"left_upper_arm_x": -90, "right_upper_arm_x": -90}]
    )
    def test_other_poses_are_not_recognised(self, studio, other):
        cameras, views = list(studio.ring.values()), studio.views(studio.posed(**other))
        contours = [view.contour for view in views.values()]
        for own, threshold in ((contours, 0.93), ([contours[0]] + [None] * 7, 0.0)):
            # One camera is not enough.
            found = features.recognise(studio.skeleton, studio.registered, cameras, own, threshold)
            assert found is None


class TestFaces:
    def test_template_finds_itself_and_other_pictures_have_a_large_residual(self, studio):
        q, templates = studio.posed(), studio.templates
        q[studio.skeleton.head_angles] = templates.directions[20]
        picture, view = studio.face(q)
        face = features.cut_face(picture, view.blobs)
        nearest, off = features.nearest_template(face, templates)
        assert nearest == 20
        noise = np.random.default_rng(2).integers(0, 255, face.shape).astype(np.uint8)
        assert features.nearest_template(noise, templates)[1] > 3 * off + 30
        np.testing.assert_array_equal(
            features.find_face(picture, view.blobs, templates, 30.0), templates.directions[20]
        )
        assert np.isnan(features.find_face(picture, view.blobs, templates, off - 1e-3)).all()

    def test_eigenspace_is_that_of_a_singular_value_decomposition(self):
        generator = np.random.default_rng(3)
        faces = list(generator.integers(0, 255, (12, 130, 80, 3)).astype(np.uint8))
        found = features.learn_faces(faces, np.zeros((12, 2)), 5)
        data = np.stack([face.ravel() for face in faces]).astype(float)
        _, _, rows = np.linalg.svd(data - data.mean(axis=0), full_matrices=False)
        np.testing.assert_allclose(np.abs(found.basis @ rows[:5].T), np.eye(5), atol=1e-3)

    def test_missing_or_cut_off_faces_and_too_few_templates_are_refused(self):
        picture = np.zeros((50, 60, 3), np.uint8)
        region = np.ones((50, 60), bool)
        assert features.cut_face(picture, features.skin_blobs(picture, region)) is None
        picture[0:20, 10:30] = SKIN
        assert features.cut_face(picture, features.skin_blobs(picture, region)) is None
        with pytest.raises(SettingsError, match="three faces"):
            features.learn_faces([np.zeros((130, 80, 3), np.uint8)] * 2, np.zeros((2, 2)))

    def test_head_angles_are_those_of_turns_in_the_world(self, studio):
        """Ahead is the camera: by its azimuth and elevation, then the face's turn and nod."""
        generator, camera = np.random.default_rng(4), studio.cameras[FACE_CAMERA]
        for head in generator.uniform([-1.5, -1.5, 0.5], [1.5, 1.5, 3.0], (20, 3)):
            direction = generator.uniform([-3.0, -1.5], [3.0, 1.5])
            x, y, z = camera.X_WC[:3, 3] - head
            ahead = Rotation.from_euler("ZY", [np.arctan2(y, x), -np.arctan2(z, np.hypot(x, y))])
            looking = ahead * Rotation.from_euler("ZY", direction)
            found = features.head_angles(direction, head, camera)
            assert np.abs(found).max() <= np.pi
            found = Rotation.from_euler("ZY", found).apply([1, 0, 0])
            np.testing.assert_allclose(found, looking.apply([1, 0, 0]), atol=1e-12)


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


def test_direction_of_a_face_is_that_of_the_nearest_recorded_one(studio, folder):
    faces = features.learn_recorded_faces(folder)
    assert faces.directions.shape == (10, 2)
    for direction in ([-37.0, 8.0], [16.0, -8.0]):
        q = studio.posed()
        q[studio.skeleton.head_angles] = np.radians(direction)
        picture, view = studio.face(q)
        found = np.degrees(features.find_face(picture, view.blobs, faces, 60.0))
        # Templates are 20 degrees apart.
        assert found == pytest.approx(np.round(np.divide(direction, 20)) * 20, abs=10.1)
        assert np.sign(found).tolist() == np.sign(direction).tolist()


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("+0_+10.png,1", "line 2 has 2 columns"),
        ("+0_+10.png,a,1", "line 2: expected a picture and two angles"),
        ("../x.png,1,1", r"line 2: '\.\./x\.png' is no picture"),
        ("x.gif,1,1", "line 2: 'x.gif' is no picture"),
        ("+0_+10.png,nan,1", "line 2: turn and nod"),
        ("+0_+10.png,181,1", "line 2: turn and nod"),
        ("+0_+10.png,1,-181", "line 2: turn and nod"),
        ("+0_+10.png,0,1\n+0_+10.png,0,1", "line 3: .* has a line already"),
        ("no.png,0,1", r"no\.png: cannot read"),
        ("grey.png,0,0", r"grey\.png: no face"),
        (None, "first line must be picture,turn,nod"),
    ],
)
def test_bad_tables_and_pictures_are_named(folder, tmp_path, rows, message):
    for path in folder.glob("*.png"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    text = "picture,turn\n" if rows is None else f"picture,turn,nod\n{rows}\n"
    (tmp_path / "directions.csv").write_text(text)
    with pytest.raises(SceneError, match=message):
        features.learn_recorded_faces(tmp_path)
