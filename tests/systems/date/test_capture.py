"""The paper's ready diagram, before a person that Drake renders."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.camera.models import FACE_CAMERA
from drake_pose.errors import SettingsError
from drake_pose.person.date.features import (
    expect_features,
    find_face,
    find_features,
    head_angles,
    recognise,
)
from drake_pose.person.date.pose import estimate_pose, uncross_feet, waist_of
from drake_pose.person.date.skeleton import LIMBS
from drake_pose.silhouette.segmentation.background import person_region
from drake_pose.systems.date import (
    CAPTURE_METHODS,
    CaptureSetup,
    PaperPoseEstimator,
    build_paper_capture,
    see_person,
)
from drake_pose.systems.images import picture_to_colour_image
from drake_pose.systems.pictures.camera_rig import build_camera_rig
from tests.person.studio import shared_studio
from tests.systems.bench import Bench

PERIOD = 0.1


@pytest.fixture(scope="module")
def studio():
    return shared_studio()


@pytest.fixture(scope="module")
def setup(studio):
    return CaptureSetup(
        studio.calibrated,
        studio.ring,
        studio.cameras[FACE_CAMERA],
        studio.templates,
        studio.registered,
        studio.backgrounds,
    )


@pytest.fixture(scope="module")
def film(studio):
    """Positions of a person who shows the registered pose, then moves; and the pictures."""
    start = studio.posed(left_upper_arm_z=80, right_upper_arm_z=-80)
    goal = studio.posed(
        left_upper_arm_x=-50, left_upper_arm_z=30, left_forearm_x=-50, right_upper_arm_z=-50,
        left_thigh_x=-25, left_shin_x=30, head_y=12,
    )  # fmt: skip
    path = [start] * 2 + [start + share * (goal - start) for share in np.linspace(0.25, 1, 6)]
    return path, [{n: studio.picture(q, n) for n in studio.cameras} for q in path]


class Run(Bench):
    """The diagram, frame by frame, in a context of its own."""

    def __init__(self, capture):
        super().__init__(capture.diagram)
        self.simulator, self.frames = Simulator(capture.diagram, self.context), 0

    def step(self, pictures):
        if self.frames:
            self.simulator.AdvanceTo(PERIOD * self.frames)
        self.frames += 1
        self.give(**{f"color_image_{n}": picture_to_colour_image(p) for n, p in pictures.items()})
        self.simulator.AdvancePendingEvents()
        return self["estimated_positions"]


class Core:
    """The same by the plain functions alone, one after the other."""

    def __init__(self, setup):
        self.setup, self.q, self.features, self.seen = setup, None, None, None
        self.waist = setup.settings.waist or waist_of(setup.skeleton)

    def step(self, pictures):
        setup, settings = self.setup, self.setup.settings
        views = {
            name: see_person(shot, person_region(shot, setup.backgrounds[name]), settings.skin)
            for name, shot in pictures.items()
            if shot is not None
        }
        names = [name for name in setup.cameras if name in views]
        cameras, seen = [setup.cameras[n] for n in names], [views[n] for n in names]
        found = recognise(
            setup.skeleton, setup.registered, cameras, [view.contour for view in seen],
            settings.recognition,
        )  # fmt: skip
        if found is not None:
            self.q, self.features = found.q, setup.skeleton.features(found.q)
            self.seen, self.expected = np.zeros(5, int), self.features
            return self.q
        regions = [view.region for view in seen]
        centroids = [view.blobs.centroids for view in seen]
        before, expected = self.features, self.expected if settings.track_feet else None
        measured = find_features(cameras, centroids, regions, before, expected)
        self.features, support = measured.places, measured.support
        if settings.track_feet:
            order = uncross_feet(setup.skeleton, self.q, self.features)
            self.features, support = self.features[order], support[order]
        self.expected = expect_features(self.features, support, before, self.seen)
        self.seen = support
        angles = None
        if FACE_CAMERA in views:
            blobs = views[FACE_CAMERA].blobs
            direction = find_face(pictures[FACE_CAMERA], blobs, setup.faces, settings.farthest_face)
            if np.isfinite(direction).all():
                angles = head_angles(direction, self.features[0], setup.face_camera)
        pose = estimate_pose(
            setup.skeleton, self.q, self.features, angles, cameras, regions,
            search=settings.search, waist=self.waist,
        )  # fmt: skip
        self.q = pose.q
        return self.q


class TestPaperCapture:
    @pytest.mark.parametrize("method", CAPTURE_METHODS)
    def test_diagram_is_the_core_bit_for_bit_and_near_the_truth(self, setup, film, method):
        setup = replace(setup, settings=CAPTURE_METHODS[method])
        capture = build_paper_capture(setup, period=PERIOD)
        assert list(capture.stages) == ["region", "skin", "recognition", "features", "face"]
        run, core = Run(capture), Core(setup)
        path, pictures = film
        last = len(pictures)
        # In the end the registered pose is shown again, which overwrites whatever was believed.
        for k, shots in enumerate([*pictures, pictures[0]]):
            if k == last:
                limbs = run["limb_points"].reshape(4, 3, 3)
                assert (run["last_support"] > 0).all()
            shots = dict(shots)
            if k in (4, 5):
                # Two cameras stop, and return.
                shots["camera_2"] = shots[FACE_CAMERA] = None
            np.testing.assert_array_equal(run.step(shots), core.step(shots))
            for stage in capture.stages:
                capture.evaluate(run.context, stage)
            np.testing.assert_array_equal(run["last_features"], core.features.ravel())
            assert (run["similarity"][0] > 0) == (k < 2 or k == last)
            assert np.isnan(run["face_direction"]).all() == (k in (4, 5))
        assert np.isnan(run["limb_points"]).all()
        true = np.array([setup.skeleton.limb_points(path[-1], name) for name in LIMBS])
        errors = np.linalg.norm(limbs - true, axis=2).max(axis=0)
        assert (errors < [0.06, 0.10, 0.04]).all()

    def test_nobody_known_yet_and_all_cameras_gone(self, studio, setup, film):
        run = Run(build_paper_capture(setup, period=PERIOD))
        _, pictures = film
        assert np.isnan(run.step(pictures[-1])).all()
        known = run.step(pictures[0])
        silent = run.step(dict.fromkeys(studio.cameras))
        # Head, hands and feet stay where they were.
        np.testing.assert_allclose(silent[:3], known[:3], atol=1e-3)
        assert not run["last_support"].any()

    def test_images_that_are_not_fresh_are_passed_over(self, setup, film):
        _, pictures = film
        run = Run(build_paper_capture(setup, period=PERIOD))
        estimator = run.system.GetSubsystemByName("pose")
        known = run.step(pictures[0])
        fresh = estimator.GetInputPort("fresh")
        own = estimator.GetMyMutableContextFromRoot(run.context)
        fresh.FixValue(own, [0.0])
        np.testing.assert_array_equal(run.step(pictures[-1]), known)
        fresh.FixValue(own, [1.0])
        assert np.abs(run.step(pictures[2]) - known).max() > 0.05

    def test_simulated_rig_and_avatar(self, studio):
        registered = studio.registered
        end = np.array(registered.q)
        end[studio.model.position_index("left_upper_arm_z")] = np.radians(20.0)
        breaks, samples = [0.0, 0.15, 0.75], np.column_stack([registered.q, registered.q, end])
        path = PiecewisePolynomial.FirstOrderHold(breaks, samples)
        ring = {name: studio.ring[name] for name in ("camera_0", "camera_2", "camera_5")}
        setup = CaptureSetup(studio.calibrated, ring, registered=registered)
        meshcat = Meshcat(MeshcatParams(host="localhost"))
        rig = build_camera_rig(studio.model, ring, path)
        capture = build_paper_capture(setup, rig.diagram, 0.15, meshcat)
        simulator = Simulator(capture.diagram)
        simulator.Initialize()
        assert meshcat.HasPath("avatar")
        simulator.AdvanceTo(0.76)
        found = capture.diagram.GetOutputPort("last_features").Eval(simulator.get_context())
        true = studio.calibrated.features(end)
        assert np.linalg.norm(found.reshape(5, 3) - true, axis=1).max() < 0.06
        view = capture.diagram.GetOutputPort("person_view_camera_2").Eval(simulator.get_context())
        assert view.region.any()

    def test_rig_without_a_camera_is_refused(self, studio, setup):
        rig = build_camera_rig(studio.model, {"camera_0": studio.ring["camera_0"]})
        with pytest.raises(SettingsError, match=r"color_image_camera_1.*it has: color_image_cam"):
            build_paper_capture(setup, rig.diagram)

    def test_arguments_are_checked(self, setup):
        with pytest.raises(SettingsError, match="period"):
            PaperPoseEstimator(setup, 0.0)
        estimator = PaperPoseEstimator(setup, PERIOD)
        context, q = estimator.CreateDefaultContext(), np.zeros(len(setup.skeleton.lower))
        for positions, features in ((q[1:], None), (np.nan * q, None), (q, np.zeros((4, 3)))):
            with pytest.raises(SettingsError, match=r"must be .* finite numbers"):
                estimator.set_person(context, positions, features)
