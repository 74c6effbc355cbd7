"""The paper's stages as systems, and their diagram, with a person that Drake renders."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.camera.models import FACE_CAMERA
from drake_pose.errors import CameraError, SettingsError, UnknownNameError
from drake_pose.person.date.features import (
    find_face,
    find_features,
    head_angles,
    recognise,
    see_person,
)
from drake_pose.person.date.pose import estimate_pose
from drake_pose.person.date.skeleton import LIMBS
from drake_pose.silhouette.pictures.label_renderer import mask_to_label_image
from drake_pose.silhouette.segmentation import learn_background, person_region
from drake_pose.systems.cameras import build_camera_rig, picture_to_colour_image
from drake_pose.systems.date import (
    CaptureSetup,
    FeatureFinder,
    HorizontalImage,
    PaperPoseEstimator,
    PoseRecogniser,
    build_paper_capture,
    prepare_paper_capture,
)
from tests.systems.bench import Bench

PERIOD = 0.1


@pytest.fixture(scope="module")
def setup(studio):
    return CaptureSetup(
        studio.calibrated, studio.ring, studio.cameras[FACE_CAMERA], studio.templates,
        studio.registered, studio.backgrounds,
    )  # fmt: skip


@pytest.fixture(scope="module")
def film(studio):
    """Positions of a person who shows the registered pose and then moves, and the pictures."""
    start = studio.posed(left_upper_arm_z=80, right_upper_arm_z=-80)
    goal = studio.posed(
        left_upper_arm_x=-50, left_upper_arm_z=30, left_forearm_x=-50, right_upper_arm_z=-50,
        left_thigh_x=-25, left_shin_x=30, head_y=12,
    )  # fmt: skip
    path = [start] * 2 + [start + fraction * (goal - start) for fraction in np.linspace(0.25, 1, 6)]
    return path, [{n: studio.picture(q, n) for n in studio.cameras} for q in path]


def show(run, pictures):
    """Return the diagram's estimate after an update with pictures, half a period later."""
    time = run.context.get_time()
    images = {f"color_image_{n}": picture_to_colour_image(p) for n, p in pictures.items()}
    run.advance(time + PERIOD if time else 0.5 * PERIOD, **images)
    return run["estimated_positions"]


class Core:
    """The same computation by plain functions."""

    def __init__(self, setup):
        self.setup, self.q, self.features = setup, None, None

    def step(self, pictures):
        setup = self.setup
        views = {
            name: see_person(shot, person_region(shot, setup.backgrounds[name]))
            for name, shot in pictures.items()
            if shot is not None
        }
        names = [name for name in setup.cameras if name in views]
        cameras, seen = [setup.cameras[n] for n in names], [views[n] for n in names]
        found = recognise(
            setup.skeleton, setup.registered, cameras, [view.contour for view in seen],
            setup.recognition,
        )  # fmt: skip
        if found is not None:
            self.q, _ = found
            self.features = setup.skeleton.features(self.q)
            return self.q
        self.features = find_features(cameras, seen, self.features).positions
        angles = None
        if FACE_CAMERA in views:
            blobs = views[FACE_CAMERA].blobs
            direction = find_face(pictures[FACE_CAMERA], blobs, setup.faces, setup.farthest_face)
            if np.isfinite(direction).all():
                angles = head_angles(direction, self.features[0], setup.face_camera)
        regions = [view.region for view in seen]
        self.q, _ = estimate_pose(setup.skeleton, self.q, self.features, angles, cameras, regions)
        return self.q


class TestPaperCapture:
    def test_diagram_equals_the_plain_functions_and_is_near_the_truth(self, setup, film):
        capture = build_paper_capture(setup, period=PERIOD)
        assert list(capture.stages) == ["region", "skin", "recognition", "features", "face"]
        run, core = Bench(capture.diagram), Core(setup)
        path, pictures = film
        last = len(pictures)
        # At the end the registered pose is shown again, which replaces the estimate.
        for k, shots in enumerate([*pictures, pictures[0]]):
            if k == last:
                limbs = run["limb_points"].reshape(4, 3, 3)
                assert (run["last_support"] > 0).all()
            shots = dict(shots)
            if k in (4, 5):
                # Two cameras stop and return.
                shots["camera_2"] = shots[FACE_CAMERA] = None
            np.testing.assert_array_equal(show(run, shots), core.step(shots))
            for stage in capture.stages:
                capture.evaluate(run.context, stage)
            np.testing.assert_array_equal(run["last_features"], core.features.ravel())
            assert (run["similarity"][0] > 0) == (k < 2 or k == last)
            assert np.isnan(run["face_direction"]).all() == (k in (4, 5))
        assert np.isnan(run["limb_points"]).all()
        true = np.array([setup.skeleton.limb_points(path[-1], name) for name in LIMBS])
        errors = np.linalg.norm(limbs - true, axis=2).max(axis=0)
        assert (errors < [0.06, 0.10, 0.04]).all()

    def test_an_unknown_person_gives_nan_and_missing_images_keep_the_pose(
        self, studio, setup, film
    ):
        run = Bench(build_paper_capture(setup, period=PERIOD).diagram)
        _, pictures = film
        assert np.isnan(show(run, pictures[-1])).all()
        known = show(run, pictures[0])
        silent = show(run, dict.fromkeys(studio.cameras))
        # Head, hands and feet do not move.
        np.testing.assert_allclose(silent[:3], known[:3], atol=1e-3)
        assert not run["last_support"].any()

    def test_images_that_are_not_fresh_are_ignored(self, setup, film):
        _, pictures = film
        run = Bench(build_paper_capture(setup, period=PERIOD).diagram)
        estimator = run.system.GetSubsystemByName("pose")
        known = show(run, pictures[0])
        fresh = estimator.GetInputPort("fresh")
        own = estimator.GetMyMutableContextFromRoot(run.context)
        fresh.FixValue(own, [0.0])
        np.testing.assert_array_equal(show(run, pictures[-1]), known)
        fresh.FixValue(own, [1.0])
        assert np.abs(show(run, pictures[2]) - known).max() > 0.05

    def test_a_simulated_rig_is_captured(self, studio):
        registered = studio.registered
        end = np.array(registered.q)
        end[studio.model.position_index("left_upper_arm_z")] = np.radians(20.0)
        breaks, samples = [0.0, 0.15, 0.75], np.column_stack([registered.q, registered.q, end])
        path = PiecewisePolynomial.FirstOrderHold(breaks, samples)
        ring = {name: studio.ring[name] for name in ("camera_0", "camera_2", "camera_5")}
        setup = CaptureSetup(studio.calibrated, ring, registered=registered)
        rig = build_camera_rig(studio.model, ring, path)
        capture = build_paper_capture(setup, rig.diagram, 0.15)
        simulator = Simulator(capture.diagram)
        simulator.AdvanceTo(0.76)
        found = capture.diagram.GetOutputPort("last_features").Eval(simulator.get_context())
        true = studio.calibrated.features(end)
        assert np.linalg.norm(found.reshape(5, 3) - true, axis=1).max() < 0.06
        view = capture.diagram.GetOutputPort("person_view_camera_2").Eval(simulator.get_context())
        assert view.region.any()

    def test_invalid_arguments_are_refused_by_name(self, studio, setup):
        camera, other = studio.ring["camera_0"], learn_background([np.zeros((4, 5, 3), np.uint8)])
        rig = build_camera_rig(studio.model, {"camera_0": camera})
        unknown = studio.model, studio.ring, "nose", studio.posed(), {}, studio.backgrounds
        for make, given, word in (
            (build_paper_capture, (setup, rig.diagram), r"color_image_camera_1.*color_image_cam"),
            (PaperPoseEstimator, (setup, 0.0), "period"),
            (FeatureFinder, ([camera],), "two or more different cameras"),
            (FeatureFinder, ([camera, camera],), "two or more different cameras"),
            (HorizontalImage, (camera, other), r"'camera_0'.*background 5 x 4"),
            (prepare_paper_capture, unknown, "camera 'nose'"),
        ):
            with pytest.raises((SettingsError, UnknownNameError), match=word):
                make(*given)


def evaluated(system, port="person_view", **values):
    """Return a system's output at given inputs."""
    return Bench(system).give(**values)[port]


class TestHorizontalImage:
    def test_the_region_comes_from_the_background_or_the_mask(self, studio):
        camera, q = studio.ring["camera_1"], studio.posed(left_upper_arm_z=60)
        picture, mask = studio.picture(q, camera.name), studio.mask(q, camera.name)
        image = picture_to_colour_image(picture)
        by_background = HorizontalImage(camera, studio.backgrounds[camera.name])
        view = evaluated(by_background, color_image=image)
        assert (view.region & mask).sum() / (view.region | mask).sum() > 0.93
        # Head, hands and feet are at most five blobs; some may be hidden.
        assert 2 <= len(view.blobs.areas) <= 5
        label = mask_to_label_image(mask)
        given = evaluated(HorizontalImage(camera), color_image=image, label_image=label)
        np.testing.assert_array_equal(given.region, mask)
        region = evaluated(by_background, "region", color_image=image, label_image=label)
        np.testing.assert_array_equal(region, mask)
        assert given.contour is not None

    def test_a_stopped_camera_gives_none(self, studio):
        system = HorizontalImage(studio.ring["camera_1"], studio.backgrounds["camera_1"])
        assert evaluated(system) is None
        assert evaluated(system, color_image=picture_to_colour_image(None)) is None
        assert evaluated(system, "region") is None

    def test_invalid_inputs_are_refused_by_name(self, studio):
        camera = studio.ring["camera_1"]
        whole = picture_to_colour_image(np.zeros((240, 320, 3), np.uint8))
        small = picture_to_colour_image(np.zeros((120, 160, 3), np.uint8))
        with pytest.raises(SettingsError, match=r"camera 'camera_1'.*background"):
            evaluated(HorizontalImage(camera), color_image=whole)
        system = HorizontalImage(camera, studio.backgrounds[camera.name])
        with pytest.raises(CameraError, match=r"camera 'camera_1'.*160 x 120.*320 x 240"):
            evaluated(system, color_image=small)
        label = mask_to_label_image(np.zeros((120, 160), bool))
        with pytest.raises(CameraError, match="'camera_1': its label image"):
            evaluated(system, color_image=whole, label_image=label)


class TestFeatureFinder:
    def test_without_measurements_features_stay_and_without_a_person_are_nan(self, studio):
        system = FeatureFinder(list(studio.ring.values()))
        last = np.arange(15.0)
        np.testing.assert_array_equal(evaluated(system, "features", last_features=last), last)
        assert not evaluated(system, "support", last_features=last).any()
        unknown = np.full(15, np.nan)
        assert np.isnan(evaluated(system, "features", last_features=unknown)).all()
        assert evaluated(system, "found", last_features=unknown) is None


class TestPreparation:
    def test_the_prepared_skeleton_has_its_features_where_skin_is_visible(self, studio):
        q, backgrounds = studio.registered.q, studio.backgrounds
        ring = {f"camera_{k}": studio.ring[f"camera_{k}"] for k in (0, 1, 3, 6)}
        pictures = {name: studio.picture(q, name) for name in ring}
        setup = prepare_paper_capture(studio.model, ring, None, q, pictures, backgrounds)
        assert setup.face_camera is None
        assert list(setup.cameras) == list(ring)
        views = {}
        for name, shot in pictures.items():
            region = person_region(shot, backgrounds[name])
            views[f"person_view_{name}"] = see_person(shot, region)
        last = studio.skeleton.features(q)
        finder = Bench(FeatureFinder(list(ring.values()))).give(**views, last_features=last.ravel())
        assert (finder["support"] > 0).all()
        off = [
            np.linalg.norm(one.features(q) - finder["features"].reshape(5, 3))
            for one in (setup.skeleton, studio.skeleton)
        ]
        assert off[0] < 0.25 * off[1]
        recogniser = PoseRecogniser(setup.skeleton, setup.registered, list(ring.values()), 0.93)
        found = evaluated(recogniser, "recognised_positions", **views)
        np.testing.assert_allclose(found[:3], q[:3], atol=0.03)
