import math

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.search import (
    BeamSearch,
    BeamSearchSettings,
    ExaminationSettings,
    PaperSearch,
    PaperSearchSettings,
)
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer, mask_to_label_image
from drake_pose.silhouette.pictures.scenes import load_scene
from drake_pose.systems.cameras import MaskPlayer
from drake_pose.systems.diagrams import build_recorded_matching, build_simulation
from drake_pose.systems.silhouette_matcher import STATISTICS, SilhouetteMatcher, SilhouetteTracker
from tests.jobs.scenes import write_masks
from tests.search.bodies import box_link, front_camera, joint, load_body, swinging_chain
from tests.systems.bench import Bench

PERIOD = 0.1
TRUTH = np.radians([[30.0, -60.0, 0.0], [-30.0, 60.0, 90.0], [60.0, 30.0, -30.0]])


@pytest.fixture
def chain(tmp_path):
    return swinging_chain(tmp_path, 3)


def search_for(model, outside_limit=6.0):
    settings = PaperSearchSettings(interval=math.radians(30), outside_limit=outside_limit)
    return PaperSearch(model.pose_tree(), settings)


PINHOLE = PinholeCamera("front", 200, 200, 900.0, 900.0, 99.6234, 99.5, front_camera().X_WC)


@pytest.mark.parametrize("camera", [PINHOLE, front_camera(200, shift=0.1234)])
def test_poses_rendered_by_drake_are_found(chain, camera):
    """Drake renders the true pose; the matcher scores with its own kernel."""
    trajectory = PiecewisePolynomial.ZeroOrderHold(
        PERIOD * np.arange(4) - 0.01, np.vstack([TRUTH, TRUTH[-1:]]).T
    )
    matcher = SilhouetteMatcher(search_for(chain), [camera], PERIOD)
    simulator = Simulator(build_simulation(matcher, chain, [camera], trajectory))
    run = Bench(matcher, matcher.GetMyContextFromRoot(simulator.get_context()))
    assert np.isinf(run["E_total"])
    assert np.isnan(run["estimated_positions"]).all()
    for k, truth in enumerate(TRUTH):
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        np.testing.assert_allclose(run["estimated_positions"], truth, atol=1e-9)
        assert run["E_total"] < 0.02


def test_one_camera_of_two_is_enough(chain):
    cameras = [front_camera(200, "left", 0.12), front_camera(200, "right", 0.34)]
    run, truth = Bench(SilhouetteMatcher(search_for(chain), cameras, PERIOD)), TRUTH[0]
    mask = LabelRenderer(chain, cameras[1]).mask(truth)
    run.update(label_image_right=mask_to_label_image(mask))
    np.testing.assert_allclose(run["estimated_positions"], truth, atol=1e-9)


def test_without_a_pose_the_last_estimate_is_kept_and_reported(chain):
    search = search_for(chain, outside_limit=0.0)
    run = Bench(SilhouetteMatcher(search, [front_camera()], PERIOD))
    blot = np.zeros((100, 100), dtype=bool)
    blot[:2, :2] = True
    run.update(label_image=mask_to_label_image(blot))
    assert np.isnan([*run["estimated_positions"], *run["covariance"]]).all()
    np.testing.assert_array_equal(run["last_positions"], chain.default_positions)
    statistics = dict(zip(STATISTICS, run["statistics"], strict=True))
    assert (statistics["found"], statistics["runs"]) == (0, 1)
    assert np.isinf(run["E_total"]).all()


def test_labels_select_the_body(chain):
    """Other labels in the image are ignored."""
    camera = front_camera(200, shift=0.12)
    labels = LabelRenderer(chain, camera).label_image(TRUTH[0])
    own = {int(label) for label in np.unique(labels)} - {32766}
    labels[5:60, 5:60] = 999
    image = mask_to_label_image(np.ones((200, 200), dtype=bool))
    image.mutable_data[..., 0] = labels
    run = Bench(SilhouetteMatcher(search_for(chain), [camera], PERIOD, labels=own))
    run.update(label_image=image)
    np.testing.assert_allclose(run["estimated_positions"], TRUTH[0], atol=1e-9)


def write_scene(folder, model, camera, poses):
    folder.mkdir()
    save_cameras(folder / "cameras.yaml", {camera.name: camera})
    (folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
    write_masks(folder, model, [camera], poses)
    return load_scene(folder)


def test_recorded_masks_with_a_root_position_for_each_frame(tmp_path):
    """A slider on rails carries a turning box; the rails' position is given for each frame."""
    model = load_body(
        tmp_path,
        "".join(f'<link name="rail_{i}"/>' for i in range(2)),
        joint("along_x", "prismatic", "world", "rail_0", (-1, 1), axis="1 0 0"),
        joint("along_y", "prismatic", "rail_0", "rail_1", (-1, 1), axis="0 1 0"),
        box_link("box", 12, 30, y=3.0),
        '<link name="carriage"/>',
        joint("along_z", "prismatic", "rail_1", "carriage", (-1, 1), axis="0 0 1"),
        joint("turn", "revolute", "carriage", "box", (-1.5, 1.5)),
    )
    camera = front_camera(200, shift=0.12)
    poses = np.array([[0, y, 0, turn] for y, turn in ((-0.3, 0.5), (0.0, -1.0), (0.35, 1.5))])
    scene = write_scene(tmp_path / "scene", model, camera, poses)
    tree = model.pose_tree(root_position=np.zeros(3))
    search = PaperSearch(tree, PaperSearchSettings(interval=0.5, outside_limit=5.0))
    roots = {f"{k:04d}": pose[:3] for k, pose in enumerate(poses)}
    diagram, matcher = build_recorded_matching(scene, search, [camera], root_positions=roots)
    simulator = Simulator(diagram)
    simulator.Initialize()
    run = Bench(matcher, matcher.GetMyContextFromRoot(simulator.get_context()))
    for k, pose in enumerate(poses):
        simulator.AdvanceTo(k / 30 + 1e-4)
        np.testing.assert_allclose(run["estimated_positions"], pose, atol=1e-9)
        assert run["base_pose"].IsExactlyEqualTo(RigidTransform())


def test_the_mask_player_plays_frame_by_frame(tmp_path, chain):
    camera = front_camera()
    scene = write_scene(tmp_path / "scene", chain, camera, TRUTH[:2])
    player = Bench(MaskPlayer(scene, [camera]))
    for time, frame in ((-1.0, 0), (0.0, 0), (0.02, 0), (1 / 30, 1), (5.0, 1)):
        player.context.SetTime(time)
        assert player["frame_index"][0] == frame
        labels = player["label_image"].data[..., 0]
        np.testing.assert_array_equal(labels == 1, scene.read("front", f"{frame:04d}"))


@pytest.mark.parametrize("system", [SilhouetteMatcher, SilhouetteTracker])
def test_invalid_settings_are_refused(chain, system):
    search, camera = search_for(chain), front_camera()
    for given, said in (
        ((search, [camera], 0.0), "period"),
        ((search, [], PERIOD), "cameras"),
        ((search, [camera, camera], PERIOD), r"front.*front"),
        ((chain.pose_tree(), [camera], PERIOD), r"needs a search, as MultiStartSearch\(tree\)"),
    ):
        with pytest.raises(SettingsError, match=said):
            system(*given)


def test_pose_sets_are_output(tmp_path):
    """A lever has the same silhouette turned towards the camera and away from it."""
    model = load_body(
        tmp_path,
        joint("swing", "revolute", "world", "lever", (-1.0, 1.0), axis="0 1 0"),
        box_link("lever", 8, 30),
    )
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
    assert np.isnan(run["estimated_positions"])
    np.testing.assert_allclose([run["lower"][0], run["upper"][0]], [-0.5, 0.5], atol=1e-9)
    # NaN without a body in the image, and if the search does not examine its result.
    run.update(label_image=mask_to_label_image(0 * mask > 0))
    assert np.isnan(run["mode_positions"]).all()
    with pytest.raises(SettingsError, match="mode_limit"):
        SilhouetteMatcher(search, [camera], PERIOD, mode_limit=0)
