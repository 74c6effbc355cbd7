"""Skin blobs, rays and features against scenes drawn by hand."""

import numpy as np
import pytest

from drake_pose.camera.models import ParallelCamera, circle_of_cameras, look_at
from drake_pose.person.date.features import (
    SkinColour,
    dense_mean,
    expect_features,
    find_features,
    inside_silhouettes,
    skin_blobs,
)
from drake_pose.person.views import meeting_points, nearest_points, viewing_rays

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
        blobs = skin_blobs(picture, np.ones((120, 160), bool), SkinColour())
        np.testing.assert_allclose(blobs.centroids, [[40, 30], [110, 80]], atol=0.2)
        assert blobs.areas.tolist() == [d.sum() for d in discs]
        assert blobs.boxes[0].tolist() == [28, 18, 25, 25]
        assert np.array_equal(blobs.mask, discs[0] | discs[1])

    def test_skin_outside_the_region_and_specks_do_not_count(self):
        picture = np.full((120, 160, 3), SHIRT, np.uint8)
        picture[disc((120, 160), (40, 30), 12)] = SKIN
        picture[60:63, 60:63] = SKIN
        region = np.ones((120, 160), bool)
        region[:, :60] = False
        assert not len(skin_blobs(picture, region, SkinColour()).areas)
        assert not len(skin_blobs(picture, np.zeros_like(region), SkinColour()).areas)


class TestRays:
    def test_rays_pass_through_what_was_projected(self):
        generator = np.random.default_rng(1)
        p_W = generator.uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 1.5], (20, 3))
        cameras = list(circle_of_cameras(3).values())
        cameras.append(
            ParallelCamera("flat", 300, 300, 226.0, 150, 150, look_at([2, 1, 1], [0, 0, 1]))
        )
        for camera in cameras:
            origins, directions = viewing_rays(camera, camera.project(p_W)[0])
            off = np.cross(p_W - origins, directions)
            assert np.abs(off).max() < 1e-12
            np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)

    def test_nearest_points_against_brute_force(self):
        generator = np.random.default_rng(2)
        for _ in range(10):
            a, b = generator.normal(size=(2, 1, 3))
            u, v = generator.normal(size=(2, 1, 3))
            u, v = u / np.linalg.norm(u), v / np.linalg.norm(v)
            middle, distance, _ = nearest_points(a, u, b, v)
            t = np.linspace(-20, 20, 801)
            on_a, on_b = a + t[:, None] * u, b + t[:, None] * v
            all_distances = np.linalg.norm(on_a[:, None] - on_b[None], axis=2)
            assert distance[0] <= all_distances.min() + 1e-9
            assert distance[0] >= all_distances.min() - 0.1
            across = np.cross(u, v)
            assert abs(abs((b - a) @ across.T / np.linalg.norm(across)).item() - distance[0]) < 1e-9
            assert np.isfinite(middle).all()

    def test_parallel_rays_and_points_behind_are_refused(self):
        o = np.zeros((1, 3))
        x, y = np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]])
        assert not nearest_points(o, x, o + y, x)[2][0]
        assert not nearest_points(o, x, np.array([[-1.0, -1.0, 0]]), y)[2][0]
        assert nearest_points(o, x, np.array([[1.0, -1.0, 0]]), y)[2][0]


class TestFeatures:
    places = np.array([[0, 0, 1.5], [0, 0.5, 1], [0, -0.5, 1], [0.1, 0.1, 0], [0, -0.1, 0]])

    def seen(self, places, noise=0.3, seed=0):
        generator = np.random.default_rng(seed)
        cameras = list(circle_of_cameras(8, face_camera=False).values())
        centroids = [
            camera.project(places)[0] + generator.normal(0, noise, (len(places), 2))
            for camera in cameras
        ]
        regions = []
        for camera in cameras:
            region = np.zeros((camera.height, camera.width), bool)
            for uv in camera.project(places)[0]:
                region |= disc(region.shape, uv, 12)
            regions.append(region)
        return cameras, centroids, regions

    def test_places_come_back(self):
        cameras, centroids, regions = self.seen(self.places)
        last = self.places + np.random.default_rng(3).normal(0, 0.03, self.places.shape)
        found = find_features(cameras, centroids, regions, last)
        assert np.linalg.norm(found.places - self.places, axis=1).max() < 0.01
        assert (found.support >= 20).all()

    def test_rays_that_meet_by_chance_are_dropped(self):
        cameras, centroids, regions = self.seen(self.places)
        points = meeting_points(cameras, centroids, 0.05)
        kept = inside_silhouettes(points, cameras, regions)
        away = np.linalg.norm(points[:, None] - self.places[None], axis=2).min(axis=1)
        assert (away > 0.15).sum() > 0  # There are some.
        assert away[kept].max() < 0.15

    def test_feature_that_nobody_sees_stays_and_a_camera_without_anybody_has_no_say(self):
        cameras, centroids, regions = self.seen(np.delete(self.places, 2, axis=0))
        regions[0], centroids[0] = np.zeros_like(regions[0]), np.empty((0, 2))
        last = self.places + 0.01
        found = find_features(cameras, centroids, regions, last)
        assert found.support[2] == 0
        assert np.array_equal(found.places[2], last[2])
        others = np.delete(np.arange(5), 2)
        assert (found.support[others] > 0).all()
        off = np.linalg.norm(found.places - self.places, axis=1)[others]
        assert off.max() < 0.01

    def walked(self, is_expecting):
        """The largest errors [m] of hands that meet, and of feet that pass each other.

        Each foot moves by 20 cm a frame, and they pass 13 cm from each other.
        """
        last, support = self.places, np.zeros(5, int)
        off = []
        for share in np.linspace(0.0, 1.0, 8):
            true = np.array(self.places)
            true[3:, 0] += np.array([1.4, -1.4]) * (share - 0.5)
            true[3:, 1] = 0.065, -0.065
            # They come to a rest beside each other.
            true[1:3, 1] = np.array([1, -1]) * max(0.06, 0.6 - 1.2 * share)
            if not len(off):
                last = expected = true
            cameras, centroids, regions = self.seen(true)
            given = expected if is_expecting else None
            found = find_features(cameras, centroids, regions, last, given)
            expected = expect_features(found.places, found.support, last, support)
            last, support = found.places, found.support
            off.append(np.linalg.norm(found.places - true, axis=1))
        hands, feet = np.max(off, axis=0)[1:3].max(), np.max(off, axis=0)[3:].max()
        return hands, feet

    def test_feet_that_pass_each_other_are_not_exchanged(self):
        assert self.walked(is_expecting=False)[1] > 0.5
        hands, feet = self.walked(is_expecting=True)
        assert feet < 0.03
        assert hands < 0.05

    def test_who_was_not_measured_is_expected_where_he_was(self):
        moved = self.places + 0.1
        seen, hidden = np.full(5, 9), np.zeros(5, int)
        both = expect_features(moved, seen, self.places, seen)
        np.testing.assert_allclose(both[3:], moved[3:] + 0.1)
        np.testing.assert_array_equal(both[:3], moved[:3])
        for now, before in ((seen, hidden), (hidden, seen)):
            np.testing.assert_array_equal(expect_features(moved, now, self.places, before), moved)

    def test_dense_part(self):
        generator = np.random.default_rng(0)
        points = np.concatenate(
            [generator.normal(0, 0.01, (12, 3)), generator.normal(1.0, 0.2, (12, 3))]
        )
        mean, count = dense_mean(points, 0.08)
        assert count == 12
        np.testing.assert_allclose(mean, points[:12].mean(axis=0))
