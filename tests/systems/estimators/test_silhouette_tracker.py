import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.errors import UnknownNameError
from drake_pose.filtering.contour_tracker import TrackingSettings
from drake_pose.search import PaperSearch, PaperSearchSettings
from drake_pose.silhouette.pictures.label_renderer import (
    EMPTY,
    LabelRenderer,
    label_image_to_mask,
    mask_to_label_image,
)
from drake_pose.systems.cameras import SilhouetteCamera, picture_to_colour_image
from drake_pose.systems.diagrams import build_simulation
from drake_pose.systems.silhouette_matcher import TRACK, SilhouetteTracker, _compare
from tests.search.arms import arm_cameras, gripper
from tests.search.bodies import front_camera
from tests.systems.bench import Bench

PERIOD = 1 / 30
CAMERA = front_camera(200, shift=0.2)


@pytest.fixture(scope="module")
def search(body):
    settings = PaperSearchSettings(interval=math.radians(20), outside_limit=60.0)
    return PaperSearch(body.pose_tree(), settings)


def motion():
    """Positions (20, 3), with a cut after the twelfth."""
    t = np.arange(20)[:, None] / 40
    swing = 0.25 * np.sin(2 * np.pi * t * np.array([1.0, 1.3, 0.8]) + np.array([0.0, 1.0, 2.0]))
    centre = np.where(t < 12 / 40, [[0.1, 0.4, -0.4]], [[-0.3, 1.7, -1.7]])
    return centre + swing


def test_velocities_and_body_poses_equal_the_plants(body, search):
    # With the default memory, rates are too small in steady motion.
    settings = TrackingSettings(memory=5.0)
    run = Bench(SilhouetteTracker(search, [CAMERA], PERIOD, tracking=settings))
    renderer = LabelRenderer(body, CAMERA)
    np.testing.assert_array_equal(run["estimated_state"][:3], body.default_positions)
    assert np.isnan(run["estimated_state"][3:]).all()
    speed = np.array([0.9, -0.6, 0.75])  # [rad/s]
    for k in range(12):
        q = np.array([-0.1, 0.5, -0.3]) + speed * PERIOD * k
        run.update(label_image=mask_to_label_image(renderer.mask(q)))
    found, poses = run["estimated_positions"], run["body_poses"]
    np.testing.assert_array_equal(run["estimated_state"][:3], found)
    np.testing.assert_allclose(run["estimated_state"][3:], speed, atol=0.15)
    for pose, expected in zip(poses, renderer.link_poses(found), strict=True):
        np.testing.assert_allclose(pose.GetAsMatrix4(), expected, atol=1e-12)
    # The port of the estimated body poses connects to a camera.
    seen = Bench(SilhouetteCamera(body.plant, body.scene_graph, CAMERA)).give(body_poses=poses)
    mask = label_image_to_mask(seen["label_image"])
    assert np.count_nonzero(mask != renderer.mask(found)) <= 0.002 * mask.sum()
    # A measurement for a filter: NaN while the pose is only predicted.
    sure = run["position_deviations"]
    np.testing.assert_allclose(np.diag(run["covariance"].reshape(3, 3)), sure**2)
    run.update(label_image=mask_to_label_image(0 * mask > 0))
    assert np.isnan([*run["estimated_positions"], *run["covariance"]]).all()
    np.testing.assert_array_equal(run["estimated_state"][:3], run["last_positions"])
    assert (run["position_deviations"] > sure).all()


def test_contexts_have_their_own_labels(body, search):
    """Labels changed in a context, compared with a system constructed with them."""
    renderer = LabelRenderer(body, CAMERA)
    varied = Bench(SilhouetteTracker(search, [CAMERA], PERIOD))
    plain = Bench(SilhouetteTracker(search, [CAMERA], PERIOD, labels={7}))
    varied.context.get_mutable_abstract_parameter(0).set_value(frozenset({7}))
    for q in motion()[:6]:
        image = mask_to_label_image(renderer.mask(q))
        data = image.mutable_data
        data[:40] = np.where(data[:40] != EMPTY, 7, data[:40])
        for run in (varied, plain):
            run.update(label_image=image)
    for port in ("last_positions", "covariance", "track"):
        np.testing.assert_allclose(varied[port], plain[port], atol=1e-12)


def test_a_copied_context_continues_as_the_original(body, search):
    """All state of the tracker is in the context."""
    renderer = LabelRenderer(body, CAMERA)
    images = [mask_to_label_image(renderer.mask(q)) for q in motion()[:6]]
    run = Bench(SilhouetteTracker(search, [CAMERA], PERIOD))
    assert np.isnan(run["position_deviations"]).all()
    for image in images[:3]:
        run.update(label_image=image)
    copy = Bench(run.system, run.context.Clone())
    for image in images[3:]:
        run.update(label_image=image)
        copy.update(label_image=image)
    for name in ("estimated_positions", "position_deviations", "track"):
        np.testing.assert_array_equal(run[name], copy[name])


def test_a_covered_lens_loses_the_track_until_positions_are_measured(body, search):
    run = Bench(SilhouetteTracker(search, [CAMERA], PERIOD, color_cameras=["front"]))
    mask, truth = LabelRenderer(body, CAMERA).mask(motion()[0]), motion()[0]
    picture = np.where(mask[..., None], (230, 130, 40), (60, 140, 60)).astype(np.uint8)
    lit, dark = picture_to_colour_image(picture), picture_to_colour_image(0 * picture)
    found = []
    for image, measured in ((lit, truth), (dark, truth * np.nan), (lit, truth)):
        run.update(color_image=image, measured_positions=measured)
        found.append(run["pose_estimate"].found)
    assert found == [True, False, True]
    # The search was not used, because there was no mask.
    assert run["track"][TRACK.index("matches")] == 0


def test_measured_positions_that_do_not_fit_the_masks_are_rejected(body, search):
    run, truth = Bench(SilhouetteTracker(search, [CAMERA], PERIOD)), motion()[0]
    image = mask_to_label_image(LabelRenderer(body, CAMERA).mask(truth))
    run.update(label_image=image, measured_positions=truth + 1.5)
    assert run["E_total"][0] < 0.1
    assert run["track"][TRACK.index("matches")] == 1


@pytest.mark.parametrize(
    ("moves", "stale", "late"),
    [
        # Whether the picture of "a" and of "b" changes in each update, and what is said of "b".
        ("ab ab ab", "...", "..."),
        ("ab - - ab", "....", "...."),  # The robot stands still.
        ("ab a a ab a", ".xx.x", "...x."),
        ("ab a a ab - - - -", ".xx.xx..", "...x...."),  # It stops while a picture may be held.
        ("ab a " + "ab " * 101, ".x" + 101 * ".", ".." + 100 * "x" + "."),  # Held long ago.
    ],
)
def test_pictures_that_are_held_are_stale_and_their_next_ones_late(moves, stale, late):
    pictures, shown = {name: np.zeros((2, 3), np.uint8) for name in "ab"}, {}
    for k, moving in enumerate(moves.split()):
        for name in moving.strip("-"):
            pictures[name] = pictures[name] + 1
        shown, *found = _compare(pictures, shown)
        expected = [said[k] == "x" for said in (stale, late)]
        assert [("b" in one) for one in found] == expected, k


def test_an_unknown_color_camera_is_refused_by_name(search):
    with pytest.raises(UnknownNameError, match=r"side.*front"):
        SilhouetteTracker(search, [front_camera()], PERIOD, color_cameras=["side"])


def test_mimic_joints_are_tracked_together(tmp_path):
    model = gripper(tmp_path, follows=True)
    t = np.arange(12) / 12
    fingers = 0.04 + 0.03 * np.sin(2 * np.pi * t)
    truth = np.column_stack([0.3 * t, -0.5 + 0.2 * t, fingers, fingers])
    search = PaperSearch(model.pose_tree(), PaperSearchSettings(interval=math.radians(10)))
    breaks = PERIOD * (np.arange(len(truth) + 1) - 0.3)
    path = PiecewisePolynomial.ZeroOrderHold(breaks, np.vstack([truth, truth[-1:]]).T)
    tracker = SilhouetteTracker(search, arm_cameras(), PERIOD)
    simulator = Simulator(build_simulation(tracker, model, arm_cameras(), path))
    own, rows = Bench(tracker, tracker.GetMyContextFromRoot(simulator.get_context())), []
    for k in range(len(truth)):
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        rows.append([own["estimated_positions"], own["position_deviations"]])
        assert k == 0 or own["track"][TRACK.index("tracked")] == 1.0
        np.testing.assert_array_equal(own["pose_estimate"].q, own["estimated_positions"])
    found, deviations = np.swapaxes(rows, 0, 1)
    errors = found - truth
    np.testing.assert_array_equal(errors[:, 2], errors[:, 3])
    np.testing.assert_array_equal(deviations[:, 2], deviations[:, 3])
    # Half a pixel is 3.5 mm.
    assert np.abs(errors[3:, 2:]).max() < 3e-3
