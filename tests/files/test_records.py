"""Records of frames, summaries and warnings, from given numbers."""

import hashlib
import math
import time

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import OutputError, SettingsError, weight_of
from drake_pose.files import records as rec
from drake_pose.files.folder import write_summary
from drake_pose.files.settings import SceneSettings
from drake_pose.search import JointEstimate, PoseMode, PoseSet
from tests.files.bodies import record, three_joints


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return three_joints(tmp_path_factory.mktemp("model"))


def test_intervals_end_at_limits_and_are_determined_below_half_the_range(model):
    q = np.array([1.9, 3.2, 3.0])
    told = rec.record_deviations(model, q, np.array([0.1, 0.06, 0.5]))
    ends = {name: (one["low"], one["high"]) for name, one in told.items()}
    assert ends["bend"] == pytest.approx(np.degrees([1.9 - 0.196, 2.0]))
    assert ends["reach"] == pytest.approx((3.2 - 0.1176, 3.2 + 0.1176))
    # The interval of a continuous joint may go beyond half a turn.
    assert ends["turn"] == pytest.approx(np.degrees([3.0 - 0.98, 3.98]))
    # 2 * 1.96 * .06 is more than half of .4.
    assert [one["determined"] for one in told.values()] == [True, False, True]
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
    X_WB = RigidTransform(RollPitchYaw(0.3, -2.0, 1.0), np.array([0.1, -0.2, 0.3])).GetAsMatrix4()
    # The quaternion need not be normalised.
    longer = rec.base_cells(X_WB) * [1.0, 1.0, 1.0, *[1.01] * 4]
    np.testing.assert_allclose(rec.base_pose(longer), X_WB, atol=1e-8)
    np.testing.assert_array_equal(rec.base_pose(None), np.eye(4))


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
    for bend, error in ((2.0, 0.25), (1.0005, 0.4), (1.5, 0.4)):
        (text,) = told(bend, error)
        assert ("(bend at a limit)" in text) == ("limit)" in text) == (bend != 1.5)
        assert (weight_of(text), "held positions (reach)" in text) == ("wrong", True)
    # Half of the bad frames at a limit is not most; frames of the method person do not count.
    q = [np.array([2.0 - 0.1 * (k % 2), 3.2, 0.0]) for k in range(5)]
    some = {f"{k}": record(0.1 * k, q=q[k]) for k in range(5)}
    some["6"] = record(0.9, inlier_ratio=0.2)
    (text,) = rec.poor_fit_warnings(some, model, [])
    assert "frame 3-4 (of 5, E_total 35.00 %)" in text
    assert "limit)" not in text


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


def test_jobs_name_the_digests_of_their_files(tmp_path):
    for name, content in (("model.urdf", b"a"), ("cameras.yaml", b"b"), ("mine.yaml", b"c")):
        (tmp_path / name).write_bytes(content)
    given = tmp_path, tmp_path / "model.urdf", SceneSettings(every=2)
    digests = [hashlib.sha256(one).hexdigest() for one in (b"a", b"b", b"c")]
    for cameras, used in (
        (None, digests[1]),
        (tmp_path / "mine.yaml", digests[2]),
        (tmp_path / "no", None),
    ):
        job = rec.describe_job(*given, cameras)
        assert job["sha256"] == {"model": digests[0], "cameras": used}
        assert (job["scene"], job["settings"]["every"]) == (str(tmp_path), 2)
    assert {"drake_pose", "python", "drake", "numpy"} <= {*rec.versions()}


def test_summaries_of_running_jobs_take_a_twentieth_of_the_time():
    for spent, wait in ((0.0, 2.0), (0.05, 2.0), (1.0, 20.0)):
        now = time.monotonic()
        assert rec.next_summary(now - spent) == pytest.approx(now + wait, abs=0.5)


def test_appended_rows_are_on_disk_and_read_back(tmp_path):
    base, q = np.array([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.5, -1.25])
    rows = [rec.FrameRecord("0001", q, base, 0.25, 1.5)]
    rows += [rec.FrameRecord("0002", np.full(2, np.nan), None, None, 1.5)]
    for with_base, cells in ((False, ""), (True, ",1,2,3,1,0,0,0")):
        table = rec.PoseTable(tmp_path, ("a", "b"), with_base)
        table.write([])
        for row in rows:
            table.append(row)
        header, *lines = (tmp_path / "poses.csv").read_text().splitlines()
        assert header.split(",") == table.header
        lost = f"0002,{',' * (2 + 7 * with_base)},1.5000"
        assert lines == [f"0001,0.5,-1.25{cells},0.25,1.5000", lost]
        # An incomplete last row is dropped.
        with (tmp_path / "poses.csv").open("a") as file:
            file.write("0003,0.5,")
        first, second = table.read()
        assert (first.base is not None and first.base.tolist() == base.tolist()) is with_base
        assert (first.found, second.found, second.base) == (True, False, None)
        assert table.read({"0001": {"E_total": 0.5, "seconds": 1.0}})[0].E_total == 0.5
    for text, message in (
        ("frame,a,c,error,seconds\n", "another model"),
        ("frame,a,b,error,seconds\n1,2\n", "line 2 has 2 columns"),
        ("frame,a,b,error,seconds\n1,x,2,3,4\n", "line 2 is damaged"),
    ):
        (tmp_path / "poses.csv").write_text(text)
        with pytest.raises(OutputError, match=message):
            rec.PoseTable(tmp_path, ("a", "b"), False).read()
    assert rec.PoseTable(tmp_path / "none", ("a", "b"), False).read() == []


def test_only_the_same_job_is_resumed(tmp_path):
    settings = {"interval": 20.0, "frames": ["0000"]}
    job = {"sha256": {"model": "m", "cameras": "c"}, "settings": settings}
    assert rec.read_earlier_summary(tmp_path, job, resume=False) is None
    with pytest.raises(SettingsError, match="needs the folder"):
        rec.read_earlier_summary(None, job, resume=True)
    write_summary(tmp_path, job)
    other_frames = {"settings": settings | {"frames": []}}
    assert rec.read_earlier_summary(tmp_path, job | other_frames, resume=True) == job
    for other, message in (
        ({"sha256": {"model": "m", "cameras": "d"}}, "with another cameras file"),
        ({"sha256": {"model": "n", "cameras": "c"}}, "with another model file"),
        ({"settings": settings | {"interval": 9.0}}, r"with interval = 20\.0, not 9\.0"),
    ):
        with pytest.raises(OutputError, match=message):
            rec.read_earlier_summary(tmp_path, job | other, resume=True)
