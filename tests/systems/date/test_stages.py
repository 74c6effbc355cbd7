"""The paper's stages as systems, before a person that Drake renders."""

import numpy as np
import pytest

from drake_pose.errors import CameraError, SettingsError, UnknownNameError
from drake_pose.person.date.features import SkinColour
from drake_pose.silhouette.pictures.label_images import mask_to_label_image
from drake_pose.silhouette.segmentation.background import learn_background, person_region
from drake_pose.systems.date import (
    FeatureFinder,
    HorizontalImage,
    PoseRecogniser,
    prepare_paper_capture,
    see_person,
)
from drake_pose.systems.images import colour_image_to_picture, picture_to_colour_image
from tests.person.studio import shared_studio
from tests.systems.bench import Bench


@pytest.fixture(scope="module")
def studio():
    return shared_studio()


@pytest.fixture(scope="module")
def backgrounds(studio):
    return studio.backgrounds


def evaluated(system, port="person_view", **values):
    """The value of a system's output at given inputs."""
    return Bench(system).give(**values)[port]


class TestColourImages:
    def test_there_and_back(self):
        picture = np.random.default_rng(0).integers(0, 255, (4, 6, 3)).astype(np.uint8)
        image = picture_to_colour_image(picture)
        assert (image.width(), image.height()) == (6, 4)
        np.testing.assert_array_equal(image.at(5, 3), [*picture[3, 5], 255])
        np.testing.assert_array_equal(colour_image_to_picture(image), picture)

    def test_nothing_to_show(self):
        assert colour_image_to_picture(picture_to_colour_image(None)).shape == (0, 0, 3)


class TestHorizontalImage:
    def test_person_by_background_or_by_mask(self, studio, backgrounds):
        camera, q = studio.ring["camera_1"], studio.posed(left_upper_arm_z=60)
        picture, mask = studio.picture(q, camera.name), studio.mask(q, camera.name)
        image = picture_to_colour_image(picture)
        by_background = HorizontalImage(camera, backgrounds[camera.name])
        view = evaluated(by_background, color_image=image)
        assert (view.region & mask).sum() / (view.region | mask).sum() > 0.93
        # Head, hands and feet: five patches at most, some of them hidden.
        assert 2 <= len(view.blobs.areas) <= 5
        label = mask_to_label_image(mask)
        given = evaluated(HorizontalImage(camera), color_image=image, label_image=label)
        np.testing.assert_array_equal(given.region, mask)
        region = evaluated(by_background, "region", color_image=image, label_image=label)
        np.testing.assert_array_equal(region, mask)
        assert given.contour is not None

    def test_camera_that_stopped(self, studio, backgrounds):
        system = HorizontalImage(studio.ring["camera_1"], backgrounds["camera_1"])
        assert evaluated(system) is None
        assert evaluated(system, color_image=picture_to_colour_image(None)) is None
        assert evaluated(system, "region") is None

    def test_bad_input_is_named(self, studio, backgrounds):
        camera = studio.ring["camera_1"]
        whole = picture_to_colour_image(np.zeros((240, 320, 3), np.uint8))
        small = picture_to_colour_image(np.zeros((120, 160, 3), np.uint8))
        with pytest.raises(SettingsError, match=r"camera 'camera_1'.*background"):
            evaluated(HorizontalImage(camera), color_image=whole)
        system = HorizontalImage(camera, backgrounds[camera.name])
        with pytest.raises(CameraError, match=r"camera 'camera_1'.*160 x 120.*320 x 240"):
            evaluated(system, color_image=small)
        label = mask_to_label_image(np.zeros((120, 160), bool))
        with pytest.raises(CameraError, match="'camera_1': its label image"):
            evaluated(system, color_image=whole, label_image=label)
        with pytest.raises(SettingsError, match=r"'camera_1'.*background 5 x 4"):
            HorizontalImage(camera, learn_background([np.zeros((4, 5, 3), np.uint8)]))


class TestFeatureFinder:
    def test_nothing_measured_and_nobody_known(self, studio):
        system = FeatureFinder(list(studio.ring.values()))
        last = np.arange(15.0)
        np.testing.assert_array_equal(evaluated(system, "features", last_features=last), last)
        assert not evaluated(system, "support", last_features=last).any()
        unknown = np.full(15, np.nan)
        assert np.isnan(evaluated(system, "features", last_features=unknown)).all()
        assert evaluated(system, "found", last_features=unknown) is None

    def test_cameras_are_checked(self, studio):
        camera = studio.ring["camera_0"]
        for cameras in ([camera], [camera, camera]):
            with pytest.raises(SettingsError, match="two or more different cameras"):
                FeatureFinder(cameras)


class TestPreparation:
    def test_skin_is_where_the_cameras_see_it(self, studio, backgrounds):
        q = studio.registered.q
        ring = {f"camera_{k}": studio.ring[f"camera_{k}"] for k in (0, 1, 3, 6)}
        pictures = {name: studio.picture(q, name) for name in ring}
        setup = prepare_paper_capture(studio.model, ring, None, q, pictures, backgrounds)
        assert setup.face_camera is None
        assert list(setup.cameras) == list(ring)
        views = {}
        for name, shot in pictures.items():
            region = person_region(shot, backgrounds[name])
            views[f"person_view_{name}"] = see_person(shot, region, SkinColour())
        last = studio.skeleton.features(q)
        finder = Bench(FeatureFinder(list(ring.values()))).give(**views, last_features=last.ravel())
        assert (finder["support"] > 0).all()
        off = [
            np.linalg.norm(one.features(q) - finder["features"].reshape(5, 3))
            for one in (setup.skeleton, studio.skeleton)
        ]
        assert off[0] < 0.25 * off[1]
        recogniser = PoseRecogniser(setup.skeleton, setup.registered, list(ring.values()))
        found = evaluated(recogniser, "recognised_positions", **views)
        np.testing.assert_allclose(found[:3], q[:3], atol=0.03)

    def test_face_camera_must_be_there(self, studio, backgrounds):
        with pytest.raises(UnknownNameError, match="camera 'nose'"):
            prepare_paper_capture(
                studio.model, studio.ring, "nose", studio.posed(), {}, backgrounds
            )
