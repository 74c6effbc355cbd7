"""The matcher and the tracker as systems, with masks that Drake renders."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.geometry import Box, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.body import ArticulatedModel
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.contour_tracker import TrackingSettings
from drake_pose.search import (
    BeamSearch,
    BeamSearchSettings,
    ExaminationSettings,
    PaperSearch,
    PaperSearchSettings,
)
from drake_pose.silhouette.pictures.label_renderer import EMPTY, LabelRenderer, mask_to_label_image
from drake_pose.systems.bodies import body_poses
from drake_pose.systems.cameras import SilhouetteCamera, picture_to_colour_image
from drake_pose.systems.diagrams import build_simulation
from drake_pose.systems.silhouette_matcher import (
    STATISTICS,
    TRACK,
    SilhouetteMatcher,
    SilhouetteTracker,
)
from tests.search.arms import arm_cameras, gripper
from tests.search.bodies import box_link, front_camera, joint, load_body, swinging_chain
from tests.systems.bench import Bench

PERIOD = 1 / 30
CAMERA = front_camera(200, shift=0.2)
Q = np.array([0.2, 0.6, -0.3])


def search_for(model, degrees=20.0, outside_limit=60.0):
    settings = PaperSearchSettings(interval=math.radians(degrees), outside_limit=outside_limit)
    return PaperSearch(model.pose_tree(), settings)


@pytest.fixture(scope="module")
def search(body):
    return search_for(body)


@pytest.fixture(scope="module")
def renderer(body):
    return LabelRenderer(body, CAMERA)


def named(names, values):
    return dict(zip(names, values, strict=True))


def test_without_a_pose_the_last_estimate_is_kept_and_reported(body):
    search = search_for(body, outside_limit=0.0)
    run = Bench(SilhouetteMatcher(search, [front_camera()], PERIOD))
    assert run["pose_estimate"] is None
    blot = np.zeros((100, 100), dtype=bool)
    blot[:2, :2] = True
    run.update(label_image=mask_to_label_image(blot))
    assert np.isnan([*run["estimated_positions"], *run["covariance"]]).all()
    np.testing.assert_array_equal(run["last_positions"], body.default_positions)
    statistics = named(STATISTICS, run["statistics"])
    assert (statistics["found"], statistics["runs"], statistics["stale"]) == (0, 1, 0)
    assert all(np.isinf(statistics[one]) for one in ("J", "E_total", "first_E_total"))


class Seen:
    """A search that records the cameras of each match, and finds nothing."""

    def __init__(self, search):
        self.tree, self._search, self.cameras = search.tree, search, []

    def match(self, views, root_position=None):
        self.cameras.append("".join(view.camera.name for view in views))
        return self._search.match(views, root_position)


@pytest.mark.parametrize(
    ("moves", "used"),
    [
        # Whose picture changes in each update, and whose is used.
        ("ab ab ab", "ab ab ab"),
        ("ab - - ab", "ab ab ab ab"),  # The robot stands still.
        ("ab a a ab a", "ab a a a a"),  # After it was held, a new picture may be late.
        ("ab a a ab - - - -", "ab a a a a a ab ab"),  # It stops while a picture may be held.
        ("ab a " + "ab " * 102, "ab a " + "a " * 100 + "ab ab"),  # Held long ago.
    ],
)
def test_pictures_that_are_held_are_not_used(body, moves, used):
    search = Seen(search_for(body, outside_limit=0.0))
    cameras = [front_camera(8, "a"), front_camera(8, "b")]
    run = Bench(SilhouetteMatcher(search, cameras, PERIOD))
    masks = {name: np.arange(64).reshape(8, 8) < 8 for name in "ab"}
    for k, moving in enumerate(moves.split()):
        for name in moving.strip("-"):
            masks[name] = np.arange(64).reshape(8, 8) == k % 50
        images = {f"label_image_{name}": mask_to_label_image(mask) for name, mask in masks.items()}
        run.update(**images)
        assert run["statistics"][STATISTICS.index("stale")] == 2 - len(used.split()[k])
    assert search.cameras == used.split()


def test_a_tracker_uses_late_pictures_but_is_less_sure(search, renderer):
    """What was held in one run was not there in the other, until it changes."""
    cameras, deviations = [CAMERA, front_camera(200, "side", 0.2)], []
    masks = [renderer.mask(Q + 0.03 * k) for k in range(4)]
    for held in (masks[0], masks[0] & False):
        run = Bench(SilhouetteTracker(search, cameras, PERIOD))
        for pair in zip(masks, [masks[0], held, held, masks[3]], strict=True):
            front, side = map(mask_to_label_image, pair)
            run.update(label_image_front=front, label_image_side=side, first_positions=Q)
        assert run["statistics"][STATISTICS.index("stale")] == 0
        deviations.append(run["position_deviations"])
    assert (deviations[0] > deviations[1]).all()


def test_a_plant_before_a_wall_and_behind_a_plate_is_found(tmp_path):
    """Both have labels; the wall fills the picture, and the plate hides 13 of 237 pixels."""
    plant, scene_graph, front = MultibodyPlant(0.0), SceneGraph(), front_camera(shift=0.1234)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instances = swinging_chain(tmp_path, 3).add_to(plant, scene_graph)
    for name, place, side in (("wall", [-1, 0, 0], 9.0), ("plate", [1, 0, -0.15], 0.05)):
        X_WG, box = RigidTransform(place), Box(0.1, side, side)
        plant.RegisterVisualGeometry(plant.world_body(), X_WG, box, name, np.ones(4))
    plant.Finalize()
    search = search_for(ArticulatedModel.from_plant(plant, scene_graph, instances), 30.0, 30.0)
    truth = np.radians([30.0, -60.0, 0.0])
    seen = Bench(SilhouetteCamera(plant, scene_graph, front))
    seen.give(body_poses=body_poses(plant, truth))
    run = Bench(SilhouetteMatcher(search, [front], 0.1)).update(label_image=seen["label_image"])
    np.testing.assert_allclose(run["estimated_positions"], truth, atol=1e-9)
    assert run["E_total"] == 13 / 224


def test_one_camera_of_two_is_enough_and_labels_select_the_body(search, renderer):
    """Labels are of the system, of the body's model, or changed in a context."""
    q = np.radians([20.0, 40.0, -20.0])
    labels = renderer.label_image(q)
    own = frozenset(int(label) for label in np.unique(labels)) - {EMPTY}
    labels[5:60, 5:60] = 999
    image = mask_to_label_image(np.ones((200, 200), dtype=bool))
    image.mutable_data[..., 0] = labels
    cameras = {"left": front_camera(200, "left", 0.12), "front": CAMERA}
    tree = replace(search.tree, model=replace(search.tree.model, labels=own))
    whose = PaperSearch(tree, search.settings)
    given = Bench(SilhouetteMatcher(search, cameras, PERIOD, labels=own))
    varied = Bench(SilhouetteMatcher(search, cameras, PERIOD))
    varied.context.get_mutable_abstract_parameter(0).set_value(own)
    for run in (given, varied, Bench(SilhouetteMatcher(whose, cameras, PERIOD))):
        run.update(label_image_front=image)
        np.testing.assert_allclose(run["estimated_positions"], q, atol=1e-9)
        assert run["E_total"] < 0.02
        assert run.system.with_intervals(run.context) is run["pose_estimate"]


def lever(folder, limit, axis="1 0 0"):
    turn = joint("swing", "revolute", "world", "lever", (-limit, limit), axis)
    return load_body(folder, turn, box_link("lever", 8, 30))


def test_pose_sets_are_output(tmp_path):
    """A lever has the same silhouette turned towards the camera and away from it."""
    model = lever(tmp_path, 1.0, "0 1 0")
    camera = front_camera(160, shift=0.1234)
    search = BeamSearch(model.pose_tree(), BeamSearchSettings(interval=0.25), ExaminationSettings())
    run = Bench(SilhouetteMatcher(search, [camera], PERIOD, mode_limit=3))
    assert np.isnan(run["proved_optimal"]).all()
    mask = LabelRenderer(model, camera).mask(np.array([0.5]))
    run.update(label_image=mask_to_label_image(mask))
    assert run["proved_optimal"] == 1.0
    np.testing.assert_allclose(np.sort(run["mode_positions"][:2]), [-0.5, 0.5], atol=1e-9)
    assert np.isnan(run["mode_positions"][2])
    assert run["determined"] == 0.0
    assert np.isnan([*run["estimated_positions"], *run["covariance"]]).all()
    np.testing.assert_allclose([run["lower"][0], run["upper"][0]], [-0.5, 0.5], atol=1e-9)
    # NaN without a body in the image.
    run.update(label_image=mask_to_label_image(0 * mask > 0))
    assert np.isnan(run["mode_positions"]).all()
    with pytest.raises(SettingsError, match="mode_limit"):
        SilhouetteMatcher(search, [camera], PERIOD, mode_limit=0)
    # A track keeps what its search did not determine.
    run = Bench(SilhouetteTracker(search, [camera], PERIOD))
    for _ in range(3):
        run.update(label_image=mask_to_label_image(mask))
    assert run["track"][0] == 1.0
    assert np.isnan(run["estimated_positions"])
    assert abs(run["last_positions"]) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("limit", "is_shown"), [(0.145, False), (0.158, True)])
def test_a_position_is_shown_if_its_interval_is_below_half_of_its_limits(tmp_path, limit, is_shown):
    model = lever(tmp_path, limit)
    image = mask_to_label_image(LabelRenderer(model, CAMERA).mask(np.zeros(1)))
    run = Bench(SilhouetteTracker(search_for(model), [CAMERA], PERIOD))
    run.update(label_image=image, first_positions=np.zeros(1))
    assert run["track"][:2].tolist() == [1.0, 0.0]
    H = run.system.belief(run.context).memory.tracker_state.track.measurement.H[:, 0]
    # The interval in the pictures, beside a prior as wide as the limits.
    interval = 2.0 * 1.96 / np.sqrt(H @ H + limit**-2)
    assert np.isfinite(run["estimated_positions"]) == (interval < limit) == is_shown
    # A matcher's interval is 1.96 deviations on either side.
    settings = BeamSearchSettings(interval=0.5 * limit), ExaminationSettings()
    run = Bench(SilhouetteMatcher(BeamSearch(model.pose_tree(), *settings), [CAMERA], PERIOD))
    q = run.update(label_image=image)["estimated_positions"]
    off = np.abs([run["lower"] - q, run["upper"] - q]).max()
    assert run["covariance"] == pytest.approx((off / 1.96) ** 2)


def test_velocities_and_body_poses_equal_the_plants(body, search, renderer):
    # With the default memory, rates are too small in steady motion.
    settings = TrackingSettings(memory=5.0)
    run = Bench(SilhouetteTracker(search, [CAMERA], PERIOD, tracking=settings))
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
    assert named(TRACK, run["track"])["tracked"] == run.system.belief(run.context).was_tracked == 1
    intervals = run.system.with_intervals(run.context).pose_set.joints
    assert all(joint.holds(value) for joint, value in zip(intervals, q, strict=True))
    # A measurement for a filter: NaN while the pose is only predicted.
    sure = run["position_deviations"]
    np.testing.assert_allclose(np.diag(run["covariance"].reshape(3, 3)), sure**2)
    run.update(label_image=mask_to_label_image(renderer.mask(q) & False))
    assert np.isnan([*run["estimated_positions"], *run["covariance"]]).all()
    np.testing.assert_array_equal(run["estimated_state"][:3], run["last_positions"])
    assert ((run["last_positions"] - found) * speed > 0.0).all()
    assert (run["position_deviations"] > sure).all()
    assert named(TRACK, run["track"])["tracked"] == run.system.belief(run.context).was_tracked == 0


def test_all_state_is_in_the_context(search, renderer):
    run = Bench(SilhouetteTracker(search, [CAMERA], PERIOD))
    images = [mask_to_label_image(renderer.mask(Q + 0.02 * k)) for k in range(3)]
    run.update(label_image=images[0])
    copy = Bench(run.system, run.context.Clone())
    for k in (1, 2):
        for one in (run, copy):
            one.update(k * PERIOD, label_image=images[k])
    for name in ("estimated_positions", "position_deviations", "track"):
        np.testing.assert_array_equal(run[name], copy[name])
    with pytest.raises(SettingsError, match="backwards"):
        run.update(PERIOD, label_image=images[0])


def test_a_covered_lens_loses_the_track_until_positions_are_measured(search, renderer):
    run = Bench(SilhouetteTracker(search, [CAMERA], PERIOD, color_cameras=["front"]))
    picture = np.where(renderer.mask(Q)[..., None], (230, 130, 40), (60, 140, 60)).astype(np.uint8)
    lit, dark = picture_to_colour_image(picture), picture_to_colour_image(0 * picture)
    found = []
    for image, measured in ((lit, Q), (dark, Q * np.nan), (lit, Q)):
        run.update(color_image=image, measured_positions=measured)
        found.append(run["pose_estimate"].found)
    assert found == [True, False, True]
    # The search was not used, because there was no mask.
    assert named(TRACK, run["track"])["matches"] == 0


def test_mimic_joints_are_tracked_together(tmp_path):
    model, t = gripper(tmp_path, follows=True), np.arange(8) / 12
    fingers = 0.04 + 0.03 * np.sin(2 * np.pi * t)
    truth = np.column_stack([0.3 * t, -0.5 + 0.2 * t, fingers, fingers])
    breaks = PERIOD * (np.arange(len(truth) + 1) - 0.3)
    path = PiecewisePolynomial.ZeroOrderHold(breaks, np.vstack([truth, truth[-1:]]).T)
    tracker = SilhouetteTracker(search_for(model, 10.0), arm_cameras(), PERIOD)
    simulator = Simulator(build_simulation(tracker, model, arm_cameras(), path))
    run = Bench(tracker, tracker.GetMyContextFromRoot(simulator.get_context()))
    for k, q in enumerate(truth):
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        found = run["estimated_positions"]
        assert named(TRACK, run["track"])["tracked"] == (k > 0)
        np.testing.assert_array_equal(run["pose_estimate"].q, found)
        assert found[2] == found[3]
        assert run["position_deviations"][2] == run["position_deviations"][3]
        # Half a pixel is 3.5 mm.
        assert k < 3 or np.abs(found - q)[2:].max() < 3e-3


@pytest.mark.parametrize("system", [SilhouetteMatcher, SilhouetteTracker])
def test_invalid_arguments_are_refused(search, system):
    camera = front_camera()
    for given, said in (
        ((search, [camera], 0.0), "period"),
        ((search, [], PERIOD), "cameras"),
        ((search, [camera, camera], PERIOD), r"front.*front"),
        ((search.tree, [camera], PERIOD), r"needs a search, as MultiStartSearch\(tree\)"),
    ):
        with pytest.raises(SettingsError, match=said):
            system(*given)
    with pytest.raises(UnknownNameError, match=r"side.*front"):
        SilhouetteTracker(search, [camera], PERIOD, color_cameras=["side"])
