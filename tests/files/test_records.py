"""Records of frames, summaries and warnings, from given numbers."""

import math

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import weight_of
from drake_pose.files import records as rec
from drake_pose.search import JointEstimate, PoseMode, PoseSet
from tests.body.models import joint, link, urdf, write


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A model with an angle from 1 to 2 rad, a length from 3 to 3.4 m, and a continuous angle."""
    parts = [link(name) for name in ("base", "arm", "slide", "wheel")]
    parts += [
        joint("weld", "fixed", "world", "base", limits=None),
        joint("bend", "revolute", "base", "arm", limits='lower="1" upper="2"'),
        joint("reach", "prismatic", "arm", "slide", limits='lower="3" upper="3.4"'),
        joint("turn", "continuous", "slide", "wheel", limits=None),
    ]
    path = write(tmp_path_factory.mktemp("model"), urdf(*parts))
    return load_model(path, check=False)


def record(E_total=0.1, **more):
    q = more.pop("q", np.zeros(3))
    return rec.FrameRecord("a", q, None, E_total, 2.0, **more)  # type: ignore[arg-type]


def test_intervals_end_at_limits_and_are_determined_below_half_the_range(model):
    q = np.array([1.9, 3.2, 3.0])
    told = rec.record_deviations(model, q, np.array([0.1, 0.06, 0.5]))
    assert told["bend"]["determined"]
    assert told["bend"]["low"] == pytest.approx(math.degrees(1.9 - 0.196))
    assert told["bend"]["high"] == pytest.approx(math.degrees(2.0))
    # 2 * 1.96 * .06 is more than half of .4.
    assert not told["reach"]["determined"]
    assert told["reach"]["low"] == pytest.approx(3.2 - 0.1176)
    assert told["reach"]["high"] == pytest.approx(3.2 + 0.1176)
    assert told["turn"]["determined"]
    # The interval of a continuous joint may go beyond half a turn.
    assert told["turn"]["high"] == pytest.approx(math.degrees(3.98))
    unknown = rec.record_deviations(model, q, np.full(3, np.nan))
    assert not any(one["determined"] for one in unknown.values())
    assert unknown["bend"]["low"] == pytest.approx(math.degrees(1.0))
    assert unknown["turn"]["high"] - unknown["turn"]["low"] == pytest.approx(360.0)
    assert rec.record_deviations(model, np.full(3, np.nan), np.zeros(3)) == {}


def test_measured_position_is_estimate_minus_error_within_limits(model):
    q = np.array([1.9, 3.2, 3.0])
    errors = {"bend": math.degrees(0.2), "reach": -0.1}
    measured = rec.measured_positions(model, [record(q=q, joint_errors=errors)])
    assert measured[0, :2] == pytest.approx([1.7, 3.3])
    assert np.isnan(measured[0, 2])
    a_turn_off = {"bend": math.degrees(0.2) + 360.0}
    again = rec.measured_positions(model, [record(q=q, joint_errors=a_turn_off)])
    assert again[0, 0] == pytest.approx(1.7)


def test_base_columns_and_pose_are_inverse():
    X_WB = np.eye(4)
    X_WB[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    X_WB[:3, 3] = [0.1, -0.2, 0.3]
    np.testing.assert_allclose(rec.base_pose(rec.base_cells(X_WB)), X_WB, atol=1e-8)
    np.testing.assert_array_equal(rec.base_pose(None), np.eye(4))
    # The quaternion need not be normalised.
    longer = rec.base_cells(X_WB) * [1.0, 1.0, 1.0, *[1.01] * 4]
    np.testing.assert_allclose(rec.base_pose(longer), X_WB, atol=1e-8)


def test_summary_counts_and_averages_frames_with_a_pose():
    records = {
        "a": record(0.1, ious={"left": 0.9, "right": 0.7}, joint_errors={"bend": -3.0}),
        "b": record(0.3, ious={"left": 0.5}, joint_errors={"bend": 1.0}),
        "c": record(None),
    }
    told = rec.summarize({"scene": "s"}, records, complete=False)
    assert (told["frame_count"], told["found_count"], told["compared_count"]) == (3, 2, 2)
    assert told["mean_E_total"] == pytest.approx(0.2)
    assert told["mean_iou"] == pytest.approx(0.7)
    assert told["joint_errors"] == {"bend": {"mean": 2.0, "largest": 3.0}}
    left, right = told["cameras"]["left"], told["cameras"]["right"]
    assert (left["frames"], right["frames"]) == (2, 1)
    assert (left["mean_iou"], right["mean_iou"]) == pytest.approx((0.7, 0.7))
    again = rec.FrameRecord.from_json("a", told["frames"]["a"], records["a"].q)
    assert again.as_json() == records["a"].as_json()


def test_a_camera_with_low_iou_is_named_once():
    records = {"a": record(ious={"left": 0.9, "right": 0.6, "top": 0.92, "back": 0.8})}
    (text,) = rec.camera_warnings(records)
    assert "'right'" in text
    assert "0.60" in text
    assert not rec.camera_warnings(records, ["camera 'right': it moved"])
    assert not rec.camera_warnings({"a": record(ious={"left": 0.9, "right": 0.1})})


def test_frames_without_a_pose_share_a_warning():
    records = {name: record() for name in ("0", "1", "2", "3", "4")}
    records |= {"1": record(None), "2": record(None), "4": record(stopped_by="run_limit")}
    # The method person warns of its frames without a pose itself.
    records["3"] = record(None, inlier_ratio=0.2)
    lost, stopped = rec.frame_warnings(records)
    assert lost.startswith("frame 1-2 (2 of 5): ")
    assert stopped.startswith("frame 4 (1 of 5): ")
    assert "limit of runs" in stopped


def test_warning_of_a_bad_fit_names_joints_at_limits_and_held_ones(model):
    def told(bend, error):
        known = {"a": record(error, q=np.array([bend, 3.2, -np.pi]))}
        return rec.poor_fit_warnings(known, model, ["reach"])

    assert not told(2.0, 0.249)
    assert weight_of(told(2.0, 0.25)[0]) == "wrong"
    assert "(bend at a limit)" in told(2.0, 0.25)[0]
    assert "(bend at a limit)" in told(1.0005, 0.4)[0]
    assert "at a limit" not in told(1.5, 0.4)[0]
    assert "the held positions (reach)" in told(1.5, 0.4)[0]


def test_modes_of_a_frame_are_united_in_user_units(model):
    """Angles in degrees, lengths in metres; a joint is determined if it is so in all modes."""
    np.testing.assert_allclose(rec.user_units(model), [math.degrees(1.0), 1.0, math.degrees(1.0)])
    first, second = np.array([1.4, 3.1, 0.2]), np.array([1.6, 3.3, 0.5])
    narrow, wide = np.array([0.01, 0.01, 0.02]), np.array([0.01, 0.2, 0.02])
    alone = rec.record_modes(model, [(first, narrow)])
    assert alone == {"joints": rec.record_deviations(model, first, narrow)}
    both = rec.record_modes(model, [(first, narrow), (second, wide)])
    one, other = (rec.record_deviations(model, *a) for a in ((first, narrow), (second, wide)))
    for name in ("bend", "reach", "turn"):
        assert both["joints"][name]["low"] == min(one[name]["low"], other[name]["low"])
        assert both["joints"][name]["high"] == max(one[name]["high"], other[name]["high"])
        assert both["joints"][name]["determined"] == (name != "reach")
        assert both["joints"][name]["value"] is None
    assert both["mode_count"] == 2
    values = [[mode[name]["value"] for name in ("bend", "reach", "turn")] for mode in both["modes"]]
    np.testing.assert_allclose(values, [rec.user_units(model) * q for q in (first, second)])
    # A joint without an interval in one mode has none; its limits are infinite.
    unsure = rec.record_modes(model, [(first, narrow), (np.full(3, np.nan), narrow)])
    assert unsure["joints"] == {}
    # Tables have a row for each frame, mode and joint.
    rows = rec.joint_table([record(**both), record()]).splitlines()
    assert rows[0] == "frame,joint,determined,low,high,modes"
    low, high = (f"{both['joints']['reach'][end]:.6g}" for end in ("low", "high"))
    assert rows[2] == f"a,reach,no,{low},{high},2"
    assert len(rows) == 4
    rows = rec.mode_table([record(**both)]).splitlines()
    assert rows[0] == "frame,mode,joint,value,determined,low,high"
    assert len(rows) == 7
    assert rows[4].startswith(f"a,2,bend,{math.degrees(1.6):.6g},yes,")
    assert rows[5].startswith("a,2,reach,3.3,no,")


def test_pose_sets_are_recorded_with_values_of_each_mode(model):
    tree = model.pose_tree()
    names = TreeKinematics(tree).names
    joints = tuple(JointEstimate(name, name != "reach", 0.1, 0.4) for name in names)
    values = [np.array([0.2]) for node in tree.nodes for _ in node.value_names]
    split = TreeKinematics(tree).split(np.concatenate(values))
    mode = PoseMode.of_values(tree, split, 1.0, joints, 1.0)
    told = rec.record_pose_set(PoseSet((mode,), joints, 0.0, False, 5), tree)
    assert told["mode_count"] == 5
    for name in ("bend", "reach", "turn"):
        unit = 1.0 if name == "reach" else math.degrees(1.0)
        for one, value in ((told["joints"], None), (told["modes"][0], 0.2 * unit)):
            assert one[name]["determined"] == (name != "reach")
            assert (one[name]["low"], one[name]["high"]) == pytest.approx((0.1 * unit, 0.4 * unit))
            assert one[name]["value"] == (None if value is None else pytest.approx(value))
    assert rec.record_pose_set(None, tree) == {}
