from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.camera.camera_files import load_cameras
from drake_pose.errors import SceneError, UnknownNameError
from drake_pose.files.records import BASE_COLUMNS, FIT_COLUMNS
from drake_pose.files.settings import EpisodeSettings, EstimateSettings
from drake_pose.input_files import read_csv
from drake_pose.jobs.estimate.inputs import make_tree
from drake_pose.jobs.estimate.measurements import (
    check_units,
    frame_times,
    has_times,
    is_episode,
    left_out_warnings,
    read_joint_centres,
    read_measured_positions,
    timed_positions,
)
from drake_pose.silhouette.pictures.scenes import find_images, load_scene
from tests.camera.recordings import write_video
from tests.jobs.masks.rooms import moving, write_pictures
from tests.jobs.scenes import NAMES

CENTRES = "frame,joint,x,y,z\n0,ankle,1,2,3\n0,knee,4,5,6\n7,ankle,-1,-2,-3\n"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_joint_centres_compare_frames_as_numbers(tmp_path):
    path = written(tmp_path / "centres.csv", CENTRES)
    positions = read_joint_centres(path, "ankle", ["0000", "0007"])
    assert positions["0000"].tolist() == [1, 2, 3]
    assert positions["0007"].tolist() == [-1, -2, -3]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("a,b\n", "first line"),
        ("frame,joint,x,y,z\n0,ankle,1,2\n", "line 2 has 4 columns"),
        ("frame,joint,x,y,z\n0,ankle,1,2,here\n", "line 2"),
        ("frame,joint,x,y,z\n0,ankle,1,2,nan\n", "not finite"),
        ("frame,joint,x,y,z\n1,ankle,1,2,3\n", "'ankle'.*'0000'"),
        ("frame,joint,x,y,z\n0.5,ankle,1,2,3\n", "'ankle'.*'0000'"),
        ("frame,joint,x,y,z\n0,ankle,1,2,3\n00,ankle,1,2,3\n", "line 3: frame '00' .* twice"),
    ],
)
def test_damaged_joint_centres(tmp_path, text, message):
    path = written(tmp_path / "centres.csv", text)
    with pytest.raises(SceneError, match=rf"centres\.csv.*{message}"):
        read_joint_centres(path, "ankle", ["0000"])
    path.write_text(CENTRES)
    with pytest.raises(UnknownNameError, match="ankle, knee"):
        read_joint_centres(path, "elbow", ["0000"])


def test_measured_positions_are_read_by_frame(tmp_path):
    path = written(tmp_path / "angles.csv", "frame,b,a\n3,0.5,-1\n")
    truth = read_measured_positions(path, ["a", "b", "c"])
    assert truth.names == ("b", "a")
    assert truth.of("0003").tolist() == [0.5, -1.0]
    assert truth.of("0004") is None
    assert truth.of("still") is None
    # Too long for a number: compared as a name.
    long = written(path, f"frame,b\n{'9' * 5000},0\n")
    assert read_measured_positions(long, ["b"]).of("9") is None
    with pytest.raises(UnknownNameError, match=r"angles.csv.*'d'.*a, b, c"):
        read_measured_positions(written(path, "frame,b,d\n3,0.5,-1\n"), ["a", "b", "c"])


@pytest.mark.parametrize(("sign", "name"), [(";", "semicolons"), ("\t", "tabs")])
def test_tables_with_other_separators_are_refused_by_name(tmp_path, sign, name):
    file = written(tmp_path / "joint_angles.csv", f"frame{sign}A1\n0000{sign}0,5\n")
    with pytest.raises(SceneError, match=f"{name}; save the table with commas"):
        read_csv(file, SceneError)


def units_of(name: str, *values: float) -> tuple[str, ...]:
    """Of an angle of -1 to 2 rad, a length of 0.1 to 0.3 m, or an angle without limits."""
    limited = SimpleNamespace(
        lower=np.array([-1.0, 0.1, -np.inf]), upper=np.array([2.0, 0.3, np.inf]),
        position_kinds=("angle", "length", "angle"), position_index=("bend", "reach", "turn").index,
    )  # fmt: skip
    known = {f"{k}": np.array([value]) for k, value in enumerate(values)}
    return check_units(Path("t.csv"), limited, [name], known)


@pytest.mark.parametrize(
    ("name", "values", "told"),
    [
        ("bend", (0.0, 2.09, -1.09), None), ("bend", (0.0, 2.11), "frame 1: 2.11 rad lies outside"),
        ("bend", (-1.2, 0.0), "-1.2 rad lies outside the joint's limits, -1 to 2 rad; check"),
        ("reach", (0.1, 0.319, 0.081), None), ("reach", (0.2, 0.33), "0.33 m lies outside"),
        ("turn", (99.0,), None),
        ("bend", (0.0, 7.0), "a full turn off, 0.7168 rad, it would not"),
        ("bend", (-6.9,), "a full turn off, -0.6168 rad, it would not"),
        ("bend", (4.0,), "check the column's joint"),
        # The worst of several.
        ("bend", (2.3, 2.9, -1.2), "frame 1: 2.9 rad"),
        # Out of reach in any unit.
        ("reach", (0.2, 200.0), "200 m lies outside"),
        ("bend", (0.0, 300.0), "300 rad lies outside"),
    ],
)  # fmt: skip
def test_positions_outside_their_limits_are_told(name, values, told):
    found = units_of(name, *values)
    assert len(found) == (told is not None)
    assert all(f"t.csv: column '{name}', " in text and told in text for text in found)


@pytest.mark.parametrize(
    ("name", "values", "told"),
    [
        ("bend", (30.0, 90.0), "not in degrees: .* write every angle in radians"),
        ("reach", (150.0, 290.0), "not in millimetres: .* write every length in metres"),
        ("bend", (1.1e6,), "too large for a joint position"),
        ("turn", (-2e6,), "too large for a joint position"),
    ],
)
def test_columns_in_other_units_are_refused(name, values, told):
    with pytest.raises(SceneError, match=told):
        units_of(name, *values)


def test_a_table_of_estimates_is_read_with_its_base(tmp_path):
    """Rows without a pose are skipped; the base is apart from the positions."""
    base, fit = ",".join(BASE_COLUMNS), ",".join(FIT_COLUMNS)
    numbers = ",".join(str(k) for k in range(7))
    text = f"frame,a,b,{base},{fit}\n0,1,2,{numbers},0.1,3\n1,,,{',' * 6},,3\n"
    found = read_measured_positions(written(tmp_path / "poses.csv", text), ("a", "b", "c"))
    assert found.names == ("a", "b")
    assert [*found.values] == [0]
    np.testing.assert_array_equal(found.of("0000"), [1.0, 2.0])
    assert found.of("0001") is None
    np.testing.assert_array_equal(found.bases[0], np.arange(7.0))
    assert found.is_estimate
    plain = read_measured_positions(
        written(tmp_path / "p.csv", f"frame,a,{fit}\n0,1,0.1,3\n2,4,nan,3\n"), ("a", "b")
    )
    assert (plain.names, plain.bases, [*plain.values]) == (("a",), {}, [0])
    alone = read_measured_positions(written(tmp_path / "q.csv", "frame,b\n3,4\n"), ("a", "b"))
    assert (alone.names, alone.is_estimate) == (("b",), False)
    for bad, told in (("frame\n", "first line"), ("time,a\n", "first"), ("frame,a,a\n", "twice")):
        with pytest.raises(SceneError, match=told):
            read_measured_positions(written(tmp_path / "bad.csv", bad), ("a",))
    assert has_times(written(tmp_path / "t.csv", "time,a\n0,1\n"))
    assert not has_times(tmp_path / "q.csv")


def test_a_folder_is_an_episode_unless_it_has_masks(tmp_path, monkeypatch):
    monkeypatch.setattr("drake_pose.jobs.estimate.measurements.recording_format", lambda _: "droid")
    settings = SimpleNamespace(episode=None)
    assert is_episode(tmp_path, settings)
    file = written(tmp_path / "a.mcap", "")
    (tmp_path / "masks").mkdir()
    assert not is_episode(tmp_path, settings)
    assert is_episode(tmp_path, SimpleNamespace(episode=0))
    assert is_episode(file, settings)
    monkeypatch.setattr("drake_pose.jobs.estimate.measurements.recording_format", lambda _: "")
    (tmp_path / "masks").rmdir()
    assert not is_episode(tmp_path, settings)
    told = left_out_warnings(["a", "b"], {"a"})
    assert len(told) == 1
    assert "camera 'b' has no X_WC" in told[0]


def test_a_table_with_times_is_read_at_the_times_of_the_pictures(tmp_path):
    """In degrees and by similar names; times by rate, by time stamps and of a video."""
    filmed, film, start = write_pictures(tmp_path / "a", moving(8)), tmp_path / "b", tmp_path / "c"
    rows = [f"{0.05 * k},{k},{-2 * k}" for k in range(40)]
    written(start, "\n".join([f"time,{NAMES[0]}_joint,{NAMES[1].upper()}", *rows]))
    written(filmed.folder / "scene.yaml", "sequence: true\nframe_rate_hz: 10\n")
    write_video(film / "videos/front.mp4", range(8), 0.2 + 0.1 * np.arange(8))
    written(film / "scene.yaml", "sequence: true")
    cameras = load_cameras(filmed.folder / "cameras.yaml")
    tree = make_tree(load_model(filmed.model), EstimateSettings())
    for path, late in ((filmed.folder, 0.0), (filmed.folder, 0.2), (film, 0.2)):
        if path is filmed.folder and late:
            stamped = [f"{k:04d},{late + 0.1 * k}" for k in range(8)]
            table = path / "images" / "front" / "timestamps.csv"
            written(table, "\n".join(["frame,time", *stamped]))
        times = frame_times(replace(load_scene(path, cameras), images=find_images(path, ["front"])))
        np.testing.assert_allclose([*times.values()], late + 0.1 * np.arange(8), atol=1e-6)
        found, _, warnings = timed_positions(start, times, tree, EpisodeSettings())
        expected = np.radians(20.0 * (late + 0.1 * np.arange(8))[:, None] * [1.0, -2.0])
        np.testing.assert_allclose([found.values[k] for k in range(8)], expected, atol=1e-6)
        assert any("assumed to be in deg" in text for text in warnings)
    with pytest.raises(SceneError, match="has times, but those of the pictures are not known"):
        timed_positions(start, {"0": np.nan}, tree, EpisodeSettings())
    frames = [f"{k},{9 - k},{0.1 * k},0" for k in range(8)]
    written(start, "\n".join([f"frame,time,{NAMES[0]},{NAMES[1]}", *frames[::-1]]))
    times = {f"{k:04d}": 0.0 for k in range(8)}
    found, _, _ = timed_positions(start, times, tree, EpisodeSettings())
    np.testing.assert_allclose([found.values[k][0] for k in range(8)], 0.1 * np.arange(8))
