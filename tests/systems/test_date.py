"""The paper's stages as systems, and their diagram, with a person that Drake renders."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.camera.models import FACE_CAMERA
from drake_pose.errors import SettingsError, UnknownNameError
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
from drake_pose.silhouette.segmentation import person_region
from drake_pose.systems.cameras import build_camera_rig, picture_to_colour_image
from drake_pose.systems.date import (
    FARTHEST_FACE,
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
    path = [start, *(start + fraction * (goal - start) for fraction in np.linspace(0.2, 1, 5))]
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
        own, face = self.setup, None
        views = {
            name: see_person(shot, person_region(shot, own.backgrounds[name]))
            for name, shot in pictures.items()
            if shot is not None
        }
        cameras = [camera for name, camera in own.cameras.items() if name in views]
        seen = [views[camera.name] for camera in cameras]
        contours = [view.contour for view in seen]
        found = recognise(own.skeleton, own.registered, cameras, contours, own.recognition)
        if found is not None:
            self.q, self.features = found[0], own.skeleton.features(found[0])
            return self.q
        self.features = find_features(cameras, seen, self.features).positions
        if FACE_CAMERA in views:
            blobs = views[FACE_CAMERA].blobs
            direction = find_face(pictures[FACE_CAMERA], blobs, own.faces, FARTHEST_FACE)
            if np.isfinite(direction).all():
                face = head_angles(direction, self.features[0], own.face_camera)
        regions = [view.region for view in seen]
        self.q, _ = estimate_pose(own.skeleton, self.q, self.features, face, cameras, regions)
        return self.q


def test_a_diagram_equals_the_plain_functions_and_is_near_the_truth(setup, film):
    capture = build_paper_capture(setup, period=PERIOD)
    assert list(capture.stages) == ["region", "skin", "recognition", "features", "face"]
    run, core, (path, pictures) = Bench(capture.diagram), Core(setup), film
    last = len(pictures)
    # At the end the registered pose is shown again, which replaces the estimate.
    for k, shots in enumerate([*pictures, pictures[0]]):
        if k == last:
            limbs = run["limb_points"].reshape(4, 3, 3)
            assert (run["last_support"] > 0).all()
        shots = dict(shots)
        if k in (2, 3):
            # Two cameras stop and return.
            shots["camera_2"] = shots[FACE_CAMERA] = None
        np.testing.assert_array_equal(show(run, shots), core.step(shots))
        for stage in capture.stages:
            capture.evaluate(run.context, stage)
        np.testing.assert_array_equal(run["last_features"], core.features.ravel())
        assert (run["similarity"][0] > 0) == (k in (0, last))
        assert np.isnan(run["face_direction"]).all() == (k in (2, 3))
    assert np.isnan(run["limb_points"]).all()
    true = np.array([setup.skeleton.limb_points(path[-1], name) for name in LIMBS])
    errors = np.linalg.norm(limbs - true, axis=2).max(axis=0)
    assert (errors < [0.06, 0.10, 0.04]).all()


def test_unknown_persons_missing_images_and_old_ones(studio, setup, film):
    """NaN before the registered pose is seen; then features stay where nothing is measured."""
    run, (_, pictures) = Bench(build_paper_capture(setup, period=PERIOD).diagram), film
    assert np.isnan(show(run, pictures[-1])).all()
    known = show(run, pictures[0])
    fresh = run.system.GetSubsystemByName("pose").GetInputPort("fresh")
    own = fresh.get_system().GetMyMutableContextFromRoot(run.context)
    fresh.FixValue(own, [0.0])
    np.testing.assert_array_equal(show(run, pictures[-1]), known)
    fresh.FixValue(own, [1.0])
    silent = show(run, dict.fromkeys(studio.cameras))
    # Head, hands and feet do not move.
    np.testing.assert_allclose(silent[:3], known[:3], atol=1e-3)
    assert not run["last_support"].any()


def test_a_simulated_rig_is_captured(studio):
    registered = studio.registered
    end = np.array(registered.q)
    end[studio.model.position_index("left_upper_arm_z")] = np.radians(20.0)
    breaks, samples = [0.0, 0.15, 0.75], np.column_stack([registered.q, registered.q, end])
    path = PiecewisePolynomial.FirstOrderHold(breaks, samples)
    ring = {name: studio.ring[name] for name in ("camera_0", "camera_2", "camera_5")}
    setup = CaptureSetup(studio.calibrated, ring, registered=registered)
    capture = build_paper_capture(setup, build_camera_rig(studio.model, ring, path).diagram, 0.15)
    simulator = Simulator(capture.diagram)
    simulator.AdvanceTo(0.76)
    run = Bench(capture.diagram, simulator.get_context())
    off = run["last_features"].reshape(5, 3) - studio.calibrated.features(end)
    assert np.linalg.norm(off, axis=1).max() < 0.06
    assert run["person_view_camera_2"].region.any()


def test_a_horizontal_image_sees_skin_in_the_region_of_background_or_mask(studio):
    camera, q = studio.ring["camera_1"], studio.posed(left_upper_arm_z=60)
    picture, mask = studio.picture(q, camera.name), studio.mask(q, camera.name)
    own = Bench(HorizontalImage(camera, studio.backgrounds[camera.name]))
    assert own["person_view"] is None
    view = own.give(color_image=picture_to_colour_image(picture))["person_view"]
    assert (view.region & mask).sum() / (view.region | mask).sum() > 0.93
    # Head, hands and feet are at most five blobs; some may be hidden.
    assert 2 <= len(view.blobs.areas) <= 5
    given = Bench(HorizontalImage(camera)).give(label_image=mask_to_label_image(mask))
    assert given["person_view"] is None
    assert given.system.wanted == ("color_image", "label_image")
    given.give(color_image=picture_to_colour_image(picture))
    np.testing.assert_array_equal(given["person_view"].region, mask)
    assert given["person_view"].contour is not None


def test_a_prepared_skeleton_has_its_features_where_skin_is_visible(studio):
    q, backgrounds = studio.registered.q, studio.backgrounds
    ring = {f"camera_{k}": studio.ring[f"camera_{k}"] for k in (0, 1, 3, 6)}
    pictures = {name: studio.picture(q, name) for name in ring}
    setup = prepare_paper_capture(studio.model, ring, None, q, pictures, backgrounds)
    assert setup.face_camera is None
    assert list(setup.cameras) == list(ring)
    views = {
        f"person_view_{name}": see_person(shot, person_region(shot, backgrounds[name]))
        for name, shot in pictures.items()
    }
    last = studio.skeleton.features(q)
    finder = Bench(FeatureFinder(list(ring.values()))).give(last_features=last.ravel())
    # Without measurements features stay, and without a person they are unknown.
    np.testing.assert_array_equal(finder["features"], last.ravel())
    assert not finder["support"].any()
    finder.give(**views)
    assert (finder["support"] > 0).all()
    found = finder["features"].reshape(5, 3)
    off = [np.linalg.norm(one.features(q) - found) for one in (setup.skeleton, studio.skeleton)]
    assert off[0] < 0.25 * off[1]
    finder.give(last_features=np.full(15, np.nan))
    assert np.isnan(finder["features"]).all()
    assert finder["found"] is None
    recogniser = PoseRecogniser(setup.skeleton, setup.registered, list(ring.values()), 0.93)
    known = Bench(recogniser).give(**views)["recognised_positions"]
    np.testing.assert_allclose(known[:3], q[:3], atol=0.03)


def test_invalid_arguments_are_refused_by_name(studio, setup):
    camera = studio.ring["camera_0"]
    rig = build_camera_rig(studio.model, {"camera_0": camera})
    unknown = studio.model, studio.ring, "nose", studio.posed(), {}, studio.backgrounds
    for make, given, word in (
        (build_paper_capture, (setup, rig.diagram), r"color_image_camera_1.*color_image_cam"),
        (PaperPoseEstimator, (setup, 0.0), "period"),
        (FeatureFinder, ([camera],), "two or more different cameras"),
        (FeatureFinder, ([camera, camera],), "two or more different cameras"),
        (CaptureSetup, (setup.skeleton, {"camera_0": camera}), "two cameras"),
        (CaptureSetup, (setup.skeleton, studio.ring, camera), "'camera_0' is also one"),
        (prepare_paper_capture, unknown, "camera 'nose'"),
    ):
        with pytest.raises((SettingsError, UnknownNameError), match=word):
            make(*given)
