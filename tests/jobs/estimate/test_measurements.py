import shutil
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
    is_episode,
    left_out_warnings,
    read_joint_centres,
    read_measured_positions,
    timed_positions,
)
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.camera.recordings import write_video
from tests.jobs.masks.rooms import moving, write_pictures
from tests.jobs.scenes import NAMES

ABC = SimpleNamespace(
    position_names=("a", "b", "c"), position_kinds=("length",) * 3, couplings=(),
    lower=np.full(3, -np.inf), upper=np.full(3, np.inf), is_unlimited_angle=np.zeros(3, bool),
)  # fmt: skip
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
    truth = read_measured_positions(path, ABC)
    assert truth.names == ("b", "a")
    assert truth.of_frames(["0003"]).tolist() == [[0.5, -1.0]]
    assert np.isnan(truth.of_frames(["0004", "still"])).all()
    rows = "".join(f"\n{k},{k if k else 1.5},0" for k in range(20))
    (late,) = read_measured_positions(written(path, f"frame,time,b{rows}"), ABC).warnings
    assert "rows: number 1 (counted from 0) has the time 1.0" in late
    # Too long for a number: compared as a name.
    long = written(path, f"frame,b\n{'9' * 5000},0\n")
    assert read_measured_positions(long, ABC).by_frame.get(9) is None
    with pytest.raises(UnknownNameError, match=r"angles.csv.*'d'.*a, b, c"):
        read_measured_positions(written(path, "frame,b,d\n3,0.5,-1\n"), ABC)


@pytest.mark.parametrize(("sign", "name"), [(";", "semicolons"), ("\t", "tabs")])
def test_tables_with_other_separators_are_refused_by_name(tmp_path, sign, name):
    file = written(tmp_path / "joint_angles.csv", f"frame{sign}A1\n0000{sign}0,5\n")
    with pytest.raises(SceneError, match=f"{name}; save the table with commas"):
        read_csv(file, SceneError)


MODEL = SimpleNamespace(
    position_names=("bend", "swing", "reach", "turn"),
    position_kinds=("angle", "angle", "length", "angle"),
    lower=np.array([-1.0, -2.0, 0.1, -3.1]), upper=np.array([2.0, 2.0, 0.3, 3.1]),
    is_unlimited_angle=np.array([False, False, False, True]), couplings=(),
)  # fmt: skip


@pytest.mark.parametrize(
    ("columns", "rows", "scale", "told"),
    [
        ("bend", [[0.0], [2.09], [-1.09]], 1.0, None),
        ("bend", [[0.0], [2.11]], 1.0, "gives 2.11 rad in frame 1, outside the joint's limits"),
        ("bend", [[-1.2], [0.0]], 1.0, "limits -1 to 2: is it the wrong column"),
        ("reach", [[0.1], [0.319], [0.081]], 1.0, None),
        ("reach", [[0.2], [0.33]], 1.0, "gives 0.33 m in frame 1"),
        ("turn", [[99.0]], 1.0, None),
        ("bend", [[0.0], [7.0]], 1.0, "a full turn off, 0.7168, it would not"),
        ("bend", [[-6.9]], 1.0, "a full turn off, -0.6168, it would not"),
        # The worst of several.
        ("bend", [[2.3], [2.9], [-1.2]], 1.0, "2.9 rad in frame 1"),
        # Out of reach in any unit.
        ("reach", [[0.2], [200.0]], 1.0, "gives 200 m in frame 1"),
        ("bend", [[0.0], [300.0]], 1.0, "gives 300 rad in frame 1"),
        ("bend,swing", [[30.0, 9.0], [90.0, -80.0]], np.pi / 180, "assumed to be in deg"),
        ("reach", [[150.0], [290.0]], 1e-3, "assumed to be in mm"),
        ("Bend.pos", [[0.5], [-0.9]], 1.0, "assumed to be in rad"),
        ("bend.pos,swing.pos", [[0.2, 0.3]], None, "could be radians or degrees"),
        ("bend,reach", [[0.1, np.nan]], None, "column 'reach', frame 0: nan is no joint"),
        ("turn", [[-2e6]], None, "column 'turn', frame 0: -2e.06 is no joint position"),
    ],
)
def test_tables_are_in_radians_and_metres_unless_limits_tell_another_unit(
    tmp_path, columns, rows, scale, told
):
    lines = [f"{k},{','.join(map(str, row))}" for k, row in enumerate(rows)]
    path = written(tmp_path / "t.csv", "\n".join([f"frame,{columns}", *lines]))
    if scale is None:
        with pytest.raises(SceneError, match=told):
            read_measured_positions(path, MODEL)
        return
    found = read_measured_positions(path, MODEL)
    np.testing.assert_allclose(found.positions, scale * np.array(rows), atol=1e-12)
    assert told in found.warnings[0] if told else found.warnings == ()


def test_a_table_of_estimates_is_read_with_its_base(tmp_path):
    """Rows without a pose are skipped; the base is apart from the positions."""
    base, fit = ",".join(BASE_COLUMNS), ",".join(FIT_COLUMNS)
    numbers = ",".join(str(k) for k in range(7))
    text = f"frame,a,b,{base},{fit}\n0,1,2,{numbers},0.1,3\n1,,,{',' * 6},,3\n"
    found = read_measured_positions(written(tmp_path / "poses.csv", text), ABC)
    assert found.names == ("a", "b")
    assert [*found.by_frame] == [0]
    np.testing.assert_array_equal(found.by_frame[0], [1.0, 2.0])
    assert 1 not in found.by_frame
    np.testing.assert_array_equal(found.bases[0], np.arange(7.0))
    assert found.is_estimate
    plain = read_measured_positions(
        written(tmp_path / "p.csv", f"frame,a,{fit}\n0,1,0.1,3\n2,4,nan,3\n"), ABC
    )
    assert (plain.names, plain.bases, [*plain.by_frame]) == (("a",), None, [0])
    alone = read_measured_positions(written(tmp_path / "q.csv", "frame,b\n3,4\n"), ABC)
    assert (alone.names, alone.is_estimate) == (("b",), False)
    for bad, told in (
        ("frame\n", "expected"),
        ("time,a\n0,1\n", "first"),
        ("frame,a,a\n0,1,1\n", "it has"),
    ):
        with pytest.raises(SceneError, match=told):
            read_measured_positions(written(tmp_path / "bad.csv", bad), ABC)


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
    monkeypatch.undo()
    for name, expected in (("images", True), ("masks", False)):
        (tmp_path / name).mkdir()
        assert is_episode(tmp_path, settings) == expected
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
    shutil.rmtree(filmed.folder / "masks")
    cameras = load_cameras(filmed.folder / "cameras.yaml")
    tree = make_tree(load_model(filmed.model), EstimateSettings())
    for path, late in ((filmed.folder, 0.0), (filmed.folder, 0.2), (film, 0.2)):
        if path is filmed.folder and late:
            stamped = [f"{k:04d},{late + 0.1 * k}" for k in range(8)]
            table = path / "images" / "front" / "timestamps.csv"
            written(table, "\n".join(["frame,time", *stamped]))
        scene = load_scene(path, cameras)
        np.testing.assert_allclose(scene.times, late + 0.1 * np.arange(8), atol=1e-6)
        found, _, warnings = timed_positions(start, scene, tree, EpisodeSettings())
        expected = np.radians(20.0 * (late + 0.1 * np.arange(8))[:, None] * [1.0, -2.0])
        np.testing.assert_allclose([found.by_frame[k] for k in range(8)], expected, atol=1e-6)
        assert any("assumed to be in deg" in text for text in warnings)
    with pytest.raises(SceneError, match="has times, but those of the pictures are not known"):
        timed_positions(start, replace(scene, times=np.zeros(0)), tree, EpisodeSettings())
    frames = [f"{k},{9 - k},{0.1 * k},0" for k in range(8)]
    written(start, "\n".join([f"frame,time,{NAMES[0]},{NAMES[1]}", *frames[::-1]]))
    found, _, _ = timed_positions(start, scene, tree, EpisodeSettings())
    np.testing.assert_allclose([found.by_frame[k][0] for k in range(8)], 0.1 * np.arange(8))
