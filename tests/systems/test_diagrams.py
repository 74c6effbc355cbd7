"""Registration of a camera as a system, and diagrams of recorded and of simulated scenes."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.body import load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import MaskError, SettingsError
from drake_pose.filtering.contour_tracker import TrackingSettings
from drake_pose.registration.online_registration import OnlineRegistration, pose_difference
from drake_pose.registration.register import RegistrationBody
from drake_pose.search import PaperSearch, PaperSearchSettings
from drake_pose.silhouette.pictures.label_renderer import mask_to_label_image
from drake_pose.silhouette.pictures.scenes import load_scene
from drake_pose.systems.diagrams import (
    REGISTRATION,
    CameraRegistration,
    build_recorded_matching,
    build_simulation,
)
from drake_pose.systems.silhouette_matcher import SilhouetteMatcher
from tests.registration.test_online_registration import bumped
from tests.registration.test_register import looking_at
from tests.search.arms import arm_tree
from tests.search.bodies import front_camera, swinging_chain
from tests.systems.bench import Bench

PERIOD = 0.5
CAMERA = looking_at(np.array([1.6, 0.4, 0.5]), np.array([0.0, 0.0, 0.4]), 0.1)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return arm_tree(tmp_path_factory.mktemp("arm")).model


@pytest.fixture(scope="module")
def online(model):
    return OnlineRegistration(RegistrationBody(model.pose_tree()), CAMERA.with_pose(np.eye(4)))


def test_a_registration_keeps_frames_and_has_no_pose_at_first(online):
    system = CameraRegistration(online, PERIOD)
    run = Bench(system).update(measured_positions=np.full(5, np.nan))
    mask = np.zeros((480, 640), dtype=bool)
    run.update(label_image=mask_to_label_image(mask))
    run.update(measured_positions=np.zeros(5))
    assert system.belief(run.context).keyframes == ()
    mask[100:200, 100:200] = True
    run.update(1.5, label_image=mask_to_label_image(mask))
    (kept,) = system.belief(run.context).keyframes
    assert kept.name == "1.5 s"
    np.testing.assert_array_equal(kept.mask, mask)
    assert run["status"] == [0.0]
    assert np.isnan(run["X_WC"].translation()).all()
    covariance = run["covariance"].reshape(6, 6)
    np.testing.assert_array_equal(covariance, np.where(np.eye(6), np.inf, 0.0))
    np.testing.assert_array_equal(run["registration"], [1.0, 0.0, 0.0, np.nan])
    assert system.registered_camera(run.context) is None
    # All state is in the context.
    run.context.SetStateAndParametersFrom(system.CreateDefaultContext())
    assert system.belief(run.context).keyframes == ()
    with pytest.raises(SettingsError, match="period"):
        CameraRegistration(online, 0.0)


def test_a_registration_uses_the_labels_of_a_model_made_of_a_plant(online):
    """A ground that fills the image does not belong to the robot."""
    labels = np.full((480, 640, 1), 9, np.int16)
    labels[100:200, 100:200] = 5
    image = mask_to_label_image(labels[..., 0] > 0)
    image.mutable_data[:] = labels
    model = replace(online.body.tree.model, labels=frozenset({5}))
    tree = replace(online.body.tree, model=model)
    system = CameraRegistration(OnlineRegistration(RegistrationBody(tree), online.camera), PERIOD)
    run = Bench(system).update(measured_positions=np.zeros(5), label_image=image)
    (kept,) = system.belief(run.context).keyframes
    np.testing.assert_array_equal(kept.mask, labels[..., 0] == 5)
    # A model of a file has no labels: its body may cover 60 % of the image.
    whole = Bench(CameraRegistration(online, PERIOD)).give(measured_positions=np.zeros(5))
    with pytest.raises(MaskError, match=r"cover 100% of the image.*from_plant"):
        whole.update(label_image=image)
    for covered, is_refused in ((0.59, False), (0.62, True)):
        part = mask_to_label_image(np.arange(480)[:, None] * np.ones(640) < covered * 480)
        if is_refused:
            with pytest.raises(MaskError, match="cover 62%"):
                whole.update(label_image=part)
        else:
            whole.update(label_image=part)


@pytest.mark.slow
def test_a_camera_is_found_and_found_again_after_it_was_moved(model, online):
    rng, kinematics, count = np.random.default_rng(5), online.body.kinematics, 18
    knots = rng.uniform(0.9 * kinematics.lower, 0.9 * kinematics.upper, (count, 5))
    motion = PiecewisePolynomial.CubicShapePreserving(
        PERIOD * np.arange(count), knots.T, zero_end_point_derivatives=True
    )
    registration = CameraRegistration(online, PERIOD)
    simulator = Simulator(build_simulation(registration, model, [CAMERA], motion))
    context = registration.GetMyContextFromRoot(simulator.get_context())
    run = Bench(registration, context)

    def check(X_WC: np.ndarray, moves: int) -> None:
        found = run["X_WC"].GetAsMatrix4()
        off = pose_difference(found, X_WC)
        assert run["status"] == [1.0]
        assert np.linalg.norm(off[:3]) < np.radians(0.1)
        assert np.linalg.norm(off[3:]) < 2e-3
        covariance = run["covariance"].reshape(6, 6)
        assert off @ np.linalg.solve(covariance, off) < 22.5
        named = dict(zip(REGISTRATION, run["registration"], strict=True))
        assert named["moves"] == moves
        assert named["mean_iou"] > 0.99
        np.testing.assert_array_equal(registration.registered_camera(context).X_WC, found)

    statuses = []
    for k in range(10):
        simulator.AdvanceTo((k + 0.9) * PERIOD)
        statuses.append(run["status"][0])
    assert statuses == [0] * 4 + [1] * 6
    check(CAMERA.X_WC, 0)
    sensor = simulator.get_system().GetSubsystemByName(f"camera_{CAMERA.name}")
    sensor_context = sensor.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    X_WC = bumped(CAMERA, 0.4, 0.006).X_WC
    sensor.SetX_PB(sensor_context, RigidTransform(X_WC))
    simulator.AdvanceTo(16.9 * PERIOD)
    check(X_WC, 1)


PINHOLE = PinholeCamera("front", 200, 200, 900.0, 900.0, 99.6234, 99.5, front_camera().X_WC)


@pytest.mark.parametrize("camera", [PINHOLE, front_camera(200, shift=0.1234)])
def test_poses_rendered_by_drake_are_found(tmp_path, camera):
    """Drake renders the true poses, near and far; the matcher scores with its own kernel."""
    chain, truth = swinging_chain(tmp_path, 3), np.radians([[30, -60, 0], [-30, 60, 90]])
    hold = PiecewisePolynomial.ZeroOrderHold([-0.01, 0.09, 0.2], np.vstack([*truth, truth[-1]]).T)
    settings = PaperSearchSettings(interval=np.radians(30), outside_limit=6.0)
    matcher = SilhouetteMatcher(PaperSearch(chain.pose_tree(), settings), [camera], 0.1)
    simulator = Simulator(build_simulation(matcher, chain, [camera], hold))
    run = Bench(matcher, matcher.GetMyContextFromRoot(simulator.get_context()))
    assert np.isinf(run["E_total"])
    assert np.isnan(run["estimated_positions"]).all()
    for k, q in enumerate(truth):
        simulator.AdvanceTo(0.1 * k + 0.05)
        np.testing.assert_allclose(run["estimated_positions"], q, atol=1e-9)
        assert run["E_total"] == run["error"] < 0.02


@pytest.mark.parametrize("tracking", [None, TrackingSettings()])
def test_recorded_masks_are_matched_or_tracked_from_known_positions(tiny_scene, tracking):
    """True positions are multiples of 20 degrees."""
    scene, truth = load_scene(tiny_scene.folder), tiny_scene.truth
    tree, away = load_model(tiny_scene.model).pose_tree(), PaperSearchSettings(interval=np.pi / 9)
    starts, cameras = truth if tracking else None, list(scene.cameras.values())
    search = PaperSearch(tree, away)
    diagram, matcher = build_recorded_matching(
        scene, search, cameras, tracking=tracking, starts=starts
    )
    simulator = Simulator(diagram)
    simulator.Initialize()
    run = Bench(matcher, matcher.GetMyContextFromRoot(simulator.get_context()))
    for k, q in enumerate(truth.values()):
        simulator.AdvanceTo(k + 0.01)
        atol = np.radians(2.0) if tracking else 1e-9
        np.testing.assert_allclose(run["last_positions"], q, atol=atol)
        assert not tracking or run["track"].tolist()[:2] == [1.0, 0.0]
