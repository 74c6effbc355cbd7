"""What the benchmark of registrations draws, damages and measures."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from drake_pose.registration.posed_frames import PosedFrame
from tests.benchmarks.registration import measure_camera, measure_zeros, pose_error
from tests.benchmarks.simulated_arms import damage, draw_arm, load_arm, write_box_arm


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return load_arm(write_box_arm(tmp_path_factory.mktemp("arm") / "boxes.urdf"))


def test_drawn_arms_are_seen_and_differ(arm):
    camera, frames = draw_arm(arm, 3, np.random.default_rng(5))
    assert len(frames) == 3
    assert all(frame.mask.shape == (camera.height, camera.width) for frame in frames)
    assert all(np.count_nonzero(frame.mask) >= 3000 for frame in frames)
    _, again = draw_arm(arm, 3, np.random.default_rng(5))
    np.testing.assert_array_equal(frames[2].mask, again[2].mask)
    assert np.abs(frames[0].values - frames[1].values).max() > 0.1


def test_damage_moves_the_edge_by_two_pixels_at_most_and_cuts_holes():
    mask = np.zeros((200, 300), dtype=bool)
    mask[50:150, 60:240] = True
    frame = PosedFrame("0000", np.zeros(1), mask)
    outside = ndimage.distance_transform_cdt(~mask, metric="chessboard")
    sizes = set()
    for seed in range(40):
        drawn = damage([frame], np.random.default_rng(seed))[0].mask
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
    np.testing.assert_allclose(pose_error(found, true), expected, atol=1e-12)


@pytest.mark.slow
def test_a_simulated_camera_and_zeros_are_found(arm):
    exact, damaged = measure_camera(arm, 1, damaged=False), measure_camera(arm, 1, damaged=True)
    for outcome in (exact, damaged):
        assert outcome.found
        assert outcome.named
    assert exact.millimetres < 5.0
    assert exact.seconds > 0.0
    zeros = measure_zeros(arm, 1, damaged=False)
    assert len(zeros.off) + zeros.undetermined == 3
    assert (zeros.off < 0.5).all()
