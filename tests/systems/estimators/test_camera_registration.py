"""A camera of unknown pose is found in a diagram, and found again after it was moved."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.errors import MaskError
from drake_pose.registration.online_registration import OnlineRegistration, pose_difference
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.pictures.label_renderer import mask_to_label_image
from drake_pose.systems.diagrams import REGISTRATION, CameraRegistration, build_simulation
from tests.registration.test_online_registration import bumped
from tests.registration.test_register import looking_at
from tests.search.arms import arm_tree
from tests.systems.bench import Bench

PERIOD = 0.5
CAMERA = looking_at(np.array([1.6, 0.4, 0.5]), np.array([0.0, 0.0, 0.4]), 0.1)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return arm_tree(tmp_path_factory.mktemp("arm")).model


@pytest.fixture(scope="module")
def online(model):
    return OnlineRegistration(RegistrationBody(model.pose_tree()), CAMERA.with_pose(np.eye(4)))


class TestCameraRegistration:
    def test_no_pose_at_first(self, online):
        run = Bench(CameraRegistration(online, PERIOD))
        assert run["status"] == [0.0]
        assert np.isnan(run["X_WC"].translation()).all()
        assert np.isinf(np.diag(run["covariance"].reshape(6, 6))).all()
        named = dict(zip(REGISTRATION, run["registration"], strict=True))
        assert named["keyframes"] == 0
        assert np.isnan(named["mean_iou"])
        assert run.system.registered_camera(run.context) is None

    def test_ignores_missing_images_and_positions(self, online):
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
        # All state is in the context.
        run.context.SetStateAndParametersFrom(system.CreateDefaultContext())
        assert system.belief(run.context).keyframes == ()

    def test_uses_the_labels_of_a_model_made_of_a_plant(self, online):
        """A ground that fills the image does not belong to the robot."""
        labels = np.full((480, 640, 1), 9, np.int16)
        labels[100:200, 100:200] = 5
        image = mask_to_label_image(labels[..., 0] > 0)
        image.mutable_data[:] = labels
        model = replace(online.body.tree.model, labels=frozenset({5}))
        tree = replace(online.body.tree, model=model)
        known = OnlineRegistration(RegistrationBody(tree), online.camera)
        system = CameraRegistration(known, PERIOD)
        run = Bench(system).update(measured_positions=np.zeros(5), label_image=image)
        (kept,) = system.belief(run.context).keyframes
        np.testing.assert_array_equal(kept.mask, labels[..., 0] == 5)
        # A model of a file has no labels.
        with pytest.raises(MaskError, match=r"cover 100% of the image.*from_plant"):
            Bench(CameraRegistration(online, PERIOD)).update(
                measured_positions=np.zeros(5), label_image=image
            )


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "metres"), [(0.4, 0.006), (6.0, 0.08)])
def test_a_camera_is_found_and_found_again_after_it_was_moved(model, online, degrees, metres):
    rng = np.random.default_rng(5)
    kinematics = online.body.kinematics
    count = 18
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
        # 99.9 % quantile of a chi-squared distribution with six degrees of freedom.
        assert off @ np.linalg.solve(covariance, off) < 22.5
        # A huge covariance would pass this check; half a degree of the first joint is 16 mm.
        assert np.sqrt(np.diag(covariance)).max() < 0.02
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
    X_WC = bumped(CAMERA, degrees, metres).X_WC
    sensor.SetX_PB(sensor_context, RigidTransform(X_WC))
    simulator.AdvanceTo(16.9 * PERIOD)
    check(X_WC, 1)
