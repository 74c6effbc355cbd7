"""What benchmarks draw, damage, count and measure."""

import os

import numpy as np
import psutil
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.commands.main import app
from tests.benchmarks import colour, memory, registration, scenes

MIB = 2**20


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory):
    return scenes.write_box_arm(tmp_path_factory.mktemp("arm") / "boxes.urdf")


@pytest.fixture(scope="module")
def arm(arm_file):
    return scenes.load_arm(arm_file)


def test_drawn_arms_are_seen_and_differ(arm):
    camera, frames = scenes.draw_arm(arm, 3, np.random.default_rng(5))
    assert all(frame.mask.shape == (camera.height, camera.width) for frame in frames)
    assert all(np.count_nonzero(frame.mask) >= 3000 for frame in frames)
    _, again = scenes.draw_arm(arm, 3, np.random.default_rng(5))
    np.testing.assert_array_equal(frames[2].mask, again[2].mask)
    assert np.abs(frames[0].values - frames[1].values).max() > 0.1


def test_damage_moves_the_edge_by_two_pixels_at_most_and_cuts_holes():
    mask = np.zeros((200, 300), dtype=bool)
    mask[50:150, 60:240] = True
    outside = ndimage.distance_transform_cdt(~mask, metric="chessboard")
    sizes = set()
    for seed in range(40):
        drawn = scenes.damaged(mask, np.random.default_rng(seed))
        assert outside[drawn].max() <= 2
        rows, columns = np.nonzero(drawn)
        width, height = np.ptp(columns) + 1, np.ptp(rows) + 1
        sizes.add(width - 180)
        # Holes of 3 %; the last one may cut more. What is dilated has round corners.
        assert 0.92 < np.count_nonzero(drawn) / (width * height) < 0.972
    assert sizes == {-4, -2, 0, 2, 4}


def test_pose_errors_are_those_that_were_made():
    true, turn = np.eye(4), Rotation.from_rotvec([0.01, -0.02, 0.03])
    true[:3, :3] = Rotation.from_euler("xyz", [0.3, 1.0, -2.0]).as_matrix()
    found = true.copy()
    found[:3, :3] = turn.as_matrix().T @ true[:3, :3]
    found[:3, 3] -= [0.1, 0.2, 0.3]
    expected = [0.01, -0.02, 0.03, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(registration.pose_error(found, true), expected, atol=1e-12)


@pytest.mark.slow
def test_a_simulated_camera_and_zeros_are_found(arm):
    exact, worn = (registration.measure_camera(arm, 1, worn) for worn in (False, True))
    assert all(outcome.found and outcome.named for outcome in (exact, worn))
    assert exact.millimetres < 5.0
    zeros = registration.measure_zeros(arm, 1, False)
    assert len(zeros.off) + zeros.undetermined == 3
    assert (zeros.off < 0.5).all()


@pytest.mark.slow
@pytest.mark.parametrize("person", [False, True])
def test_an_arm_and_a_person_are_followed_before_a_room(arm_file, person):
    model = load_model(bundled_model("person") if person else arm_file, check=False)
    room = colour.Room("all", noise=3.0, boxes=1, post=not person)
    masks, seen = colour.measure_room(model, room, 5, 6)
    for outcome in (masks, seen):
        # The last joint of an arm is left out.
        assert outcome.errors.shape[0] == 5
        assert person or outcome.errors.shape[1] == 4
        assert not outcome.lost.any()
        assert not outcome.wrong.any()
    assert seen.errors.mean() < 2.0 * masks.errors.mean() or np.median(seen.errors) < 2.0


def test_truths_inside_and_wrong_frames_are_counted():
    errors, lost = np.array([[1.0, 2.0], [11.0, 0.0]]), np.array([False, True])
    outcome = colour.Outcome(errors, np.full((2, 2), 0.9), lost, 1.0, 10.0)
    assert outcome.inside == (0.5, 0.5)
    np.testing.assert_array_equal(outcome.wrong, [False, True])


@pytest.mark.slow
def test_memory_is_that_of_the_process():
    for size in (200, 500):
        floor = psutil.Process(os.getpid()).memory_info().rss // MIB
        # Filled, because pages that nobody wrote take none.
        program = ("-c", f"import sys; b = b'x' * ({floor + size} * {MIB}); sys.exit(3)")
        status, peak, _ = memory.measure_memory(["word"], program)
        assert peak == pytest.approx(floor + size, abs=40)
        assert status == 3


def test_every_command_of_the_benchmark_is_one(tmp_path):
    for words in memory.benchmark_commands(tmp_path):
        # Parses without running it; an option that is none raises.
        app.parse_args(list(words), exit_on_error=False, print_error=False)
