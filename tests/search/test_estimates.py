"""Views, joint intervals, and pose estimates with full turns and widened intervals."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import MaskError, SettingsError
from drake_pose.search import (
    JointEstimate,
    MultiStartSearch,
    PoseEstimate,
    PoseMode,
    PoseSet,
    View,
    covariance_pose_set,
)
from drake_pose.search.estimates import require_views
from tests.search.arms import crane, views_of
from tests.search.bodies import front_camera

TURN = 2.0 * math.pi
CAMERA = ParallelCamera("front", 6, 4, 10.0, 3.0, 2.0, np.eye(4))


def test_any_array_of_two_values_is_a_mask():
    """A mask of one value is full, if that is not 0."""
    inside = np.arange(24).reshape(4, 6) % 5 == 0
    for largest in (1, 255, np.uint8(255), 0.5, True):
        view = View(CAMERA, inside * largest)
        assert view.mask.dtype == np.bool_
        np.testing.assert_array_equal(view.mask, inside)
        assert View(CAMERA, np.full((4, 6), largest)).mask.all()
    for mask, reason in (
        (np.arange(24).reshape(4, 6), "24 values from 0 to 23"),
        (np.where(inside, np.nan, 1.0), "values from"),
        (np.zeros((4, 6), int), "empty"),
        (np.ones((6, 4), int), "size the camera was calibrated for"),
    ):
        with pytest.raises(MaskError, match=f"'front'.*{reason}"):
            View(CAMERA, mask)
    with pytest.raises(SettingsError, match="one View"):
        require_views(View(CAMERA, inside))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return crane(tmp_path_factory.mktemp("crane"))


@pytest.fixture(scope="module")
def tree(model):
    return model.pose_tree()


def test_masks_are_cut_at_straight_lines_alone():
    y, x = np.mgrid[:200, :200]
    camera = front_camera(200)
    disc = (x - 90) ** 2 + (y - 100) ** 2 < 50**2
    box = (abs(x + 0.3 * y - 110) < 40) & (abs(y - 0.3 * x - 50) < 60)
    for mask in (disc, box, disc | box):
        assert View(camera, mask).cut().mask.shape == (200, 200)
        # Half of the picture is empty; what is seen of the body stays where it is.
        for side, shape in (
            (np.s_[:, 110:], (200, 110)),
            (np.s_[:, :70], (200, 130)),
            (np.s_[:120], (80, 200)),
        ):
            half = mask.copy()
            half[side] = False
            cut = View(camera, half).cut()
            assert cut.mask.shape == shape
            assert cut.mask.sum() == half.sum()
            p_W = np.array([[0.1, 0.2, 0.3]])
            gone = np.array([200, 200]) - shape[::-1]
            moved = camera.project(p_W)[0] - cut.camera.project(p_W)[0]
            assert moved == pytest.approx(gone[None] * (side in (np.s_[:, :70], np.s_[:120])))
    # A cut has at least eight pixels.
    for width, rows in ((7, 200), (8, 150)):
        bar = (abs(x - 100) <= width // 2) & (x < 100 + (width + 1) // 2) & (y >= 50)
        assert View(camera, bar & (y < 199)).cut().mask.shape[0] == rows - (rows == 150)


@pytest.mark.parametrize("around", [0.0, TURN, -2.0 * TURN])
def test_a_widened_interval_contains_both(around):
    """The other interval is shifted by the motion; full turns of an angle make no difference."""
    now = JointEstimate("a", True, 1.0, 1.4, covers_full_turn=around != 0.0)
    then = replace(now, low=0.4 + around, high=0.9 + around, determined=False)
    both = now.widened(then, 0.2)
    assert (both.low, both.high) == pytest.approx((0.6, 1.4))
    assert not both.determined
    assert now.widened(replace(then, determined=True), 0.2).determined
    earlier = replace(now, low=1.0 + around, high=1.1 + around)
    assert (now.widened(earlier, 0.5).high, now.widened(earlier, 0.5).low) == pytest.approx(
        (1.6, 1)
    )


def estimate(tree, values, modes):
    """Return a pose with intervals of +-0.1 about its values; ``modes``: the number of modes."""
    kinematics = TreeKinematics(tree)
    own = kinematics.split(np.array(values))
    joints = tuple(
        JointEstimate(name, True, value - 0.1, value + 0.1)
        for name, value in zip(kinematics.names, values, strict=True)
    )
    mode = PoseMode.of_values(tree, own, 7.0, joints, 1.0)
    known = PoseSet((mode,), joints, 0.0, False, modes)
    return PoseEstimate.of_values(tree, own, 7.0, 100.0, stopped_by="end", pose_set=known)


def test_tracked_intervals_include_the_modes_of_the_first_pose(tree):
    now, begun = estimate(tree, [0.5, 0.2], 1), estimate(tree, [0.3, 0.3], 2)
    wide = [replace(one, low=one.low - 1.0) for one in begun.pose_set.joints]
    begun = replace(begun, pose_set=replace(begun.pose_set, joints=tuple(wide)))
    widened = now.widened(begun).pose_set
    assert widened.mode_count == 2
    ends = [(one.low, one.high) for one in widened.joints]
    # Since then the values have changed by 0.2 and -0.1.
    np.testing.assert_allclose(ends, [(-0.6, 0.6), (-0.9, 0.3)])
    single = estimate(tree, [0.3, 0.3], 1)
    for nothing in (None, replace(begun, pose_set=None), single):
        assert now.widened(nothing) is now


def test_full_turns_do_not_change_a_pose(tree):
    pose = estimate(tree, [0.5, 0.2], 1)
    turns = [
        np.array([TURN]) if k == 1 else np.zeros(len(node.value_names))
        for k, node in enumerate(tree.nodes)
    ]
    by = np.concatenate(turns)
    turned = pose.turned(tree, turns)
    (mode,) = turned.pose_set.modes
    for one in (turned, mode):
        np.testing.assert_allclose(np.concatenate(one.node_values), by + np.array([0.5, 0.2]))
        q, X_WB = tree.positions_from(one.node_values)
        np.testing.assert_allclose(one.q, q)
        np.testing.assert_allclose(one.X_WB, X_WB)
    before, after = (tree.node_poses(list(one.node_values)) for one in (pose, turned))
    np.testing.assert_allclose(after, before, atol=1e-12)
    for joints in (turned.pose_set.joints, mode.joints):
        np.testing.assert_allclose([one.low for one in joints], by + np.array([0.4, 0.1]))
        np.testing.assert_allclose([one.high for one in joints], by + np.array([0.6, 0.3]))


def test_errors_are_fractions_of_the_silhouettes_area(tree):
    pose = estimate(tree, [0.5, 0.2], 1)
    assert (pose.E_total, pose.first_E_total) == (0.07, 0.07)
    assert replace(pose, first_J=9.0).first_E_total == 0.09
    assert pose.explained
    assert not replace(pose, J=70.0).explained
    assert not replace(pose, found=False).explained
    assert [replace(pose, lower_bound=b).proved_optimal for b in (6.9, 7.0)] == [False, True]
    assert not PoseEstimate.nothing(tree, stopped_by="end").found
    intervals = pose.pose_set.position_intervals(tree)
    np.testing.assert_allclose(intervals, [[1.0, 1.0], [0.4, 0.1], [0.6, 0.3]])


def test_covariance_gives_student_intervals_within_limits(tree):
    """Student's quantile has six degrees of freedom for each camera; limits cut the interval."""
    kinematics = TreeKinematics(tree)
    pose = replace(estimate(tree, [0.5, 0.2], 1), q=np.array([7.0, 8.0]))
    deviations = np.array([0.02, 0.05])
    one, other = (
        covariance_pose_set(tree, pose, np.diag(deviations**2), count) for count in (1, 4)
    )
    for pose_set, count in ((one, 1), (other, 4)):
        widths = student.ppf(0.975, 6 * count) * deviations
        ends = [(joint.low, joint.high) for joint in pose_set.joints]
        np.testing.assert_allclose(ends, np.array([[0.5], [0.2]]) + widths[:, None] * [-1, 1])
        np.testing.assert_array_equal(pose_set.modes[0].q, [7.0, 8.0])
        assert pose_set.modes[0].J == 7.0
    wide = covariance_pose_set(tree, pose, 100.0 * np.eye(2), 1)
    lower, upper = kinematics.local_limits(np.array([0.5, 0.2]))
    np.testing.assert_allclose([joint.low for joint in wide.joints], lower)
    np.testing.assert_allclose([joint.high for joint in wide.joints], upper)


@pytest.mark.parametrize("truth", [(178.0, 331.5), (-181.0, -28.5), (-100.0, 190.0)])
def test_angles_are_returned_in_the_turn_around_the_default(model, truth):
    """The limits of the second joint contain the true angle in two turns."""
    result = MultiStartSearch(model.pose_tree()).match(views_of(model, np.radians(truth)))
    nearest = [math.degrees(math.remainder(math.radians(angle), 2 * math.pi)) for angle in truth]
    assert np.abs(np.degrees(result.q)).max() <= 180.0 + 1e-6
    errors = np.remainder(np.degrees(result.q) - nearest + 180.0, 360.0) - 180.0
    # A pixel is about a degree of the jib.
    assert np.abs(errors).max() < 2.0
    answer = result.pose_set
    keys = [tuple(np.round(np.degrees(one.q) % 360.0, 1)) for one in answer.modes]
    assert len(set(keys)) == len(keys)
    for mode in answer.modes:
        for joint, value in zip(mode.joints, np.concatenate(mode.node_values), strict=True):
            assert joint.low <= value <= joint.high
            assert joint.high - joint.low <= 2 * math.pi + 1e-9
    swing = answer.joints[0]
    assert swing.determined
    assert swing.holds(math.radians(truth[0]))
    assert swing.holds(math.radians(truth[0] + 720.0))
    assert not swing.holds(math.radians(truth[0] + 90.0))
