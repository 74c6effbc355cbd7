"""Files that a job writes, and what is kept when it is interrupted."""

import csv
import io
import shutil
from unittest.mock import Mock

import numpy as np
import pytest

from drake_pose.body import load_landmarks, load_model
from drake_pose.errors import OutputError
from drake_pose.files.folder import read_summary
from drake_pose.files.records import BASE_COLUMNS, FrameRecord, PoseTable
from drake_pose.files.writer import (
    ResultWriter,
    centres_as_csv,
    centres_as_trc,
    joint_centres,
    positions_as_mot,
    write_motion,
)
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.body.models import link_poses
from tests.files.replays import played, tracks_of
from tests.jobs.scenes import URDF, read_rows


def test_motion_of_a_person_is_in_the_units_of_its_files(person):
    """Frames without a pose have no row, and empty fields in a TRC file."""
    q = np.zeros((3, len(person.position_names)))
    q[:, person.position_index("position_z")] = 1.5
    q[1, person.position_index("left_forearm_x")] = np.radians(-90.0)
    q[2] = np.nan
    landmarks = load_landmarks(person.path)
    names, places = list(landmarks), joint_centres(person, landmarks, q)
    rows = list(csv.DictReader(io.StringIO(centres_as_csv(["0", "1", "2"], names, places))))
    assert len(rows) == 2 * len(names)
    at = {(row["frame"], row["joint"]): [float(row[axis]) for axis in "xyz"] for row in rows}
    wrist, elbow = (np.array([at[f, f"left_{one}"] for f in "01"]) for one in ("wrist", "elbow"))
    hanging, raised = wrist - elbow
    # The forearm points forward, along the world's x.
    assert raised[2] == pytest.approx(0.0, abs=0.03)
    assert raised[0] > 0.2
    assert hanging[2] < -0.2
    # Millimetres with y up.
    cells = [line.split("\t") for line in centres_as_trc(names, places, 60.0).splitlines()]
    assert cells[0][:3] == ["PathFileType", "4", "(X/Y/Z)"]
    header = dict(zip(cells[1], cells[2], strict=True))
    assert (header["NumFrames"], header["NumMarkers"]) == ("3", str(len(names)))
    assert (header["Units"], cells[3][2::3], cells[4][-1]) == ("mm", names, f"Z{len(names)}")
    x, y, z = np.array(cells[6][2:], dtype=float).reshape(-1, 3).T
    np.testing.assert_allclose(np.column_stack([x, -z, y]), 1e3 * places[0], atol=1e-3)
    assert (cells[7][0], float(cells[7][1])) == ("2", pytest.approx(1 / 60.0, abs=1e-6))
    assert cells[8][2:] == [""] * (3 * len(names))
    # Degrees and metres.
    lines = positions_as_mot(person, q, 50.0).splitlines()
    begin = lines.index("endheader")
    columns = lines[begin + 1].split("\t")
    assert {"nRows=2", f"nColumns={len(columns)}", "inDegrees=yes"} <= {*lines[:begin]}
    row = dict(zip(columns, map(float, lines[begin + 3].split("\t")), strict=True))
    found = [row[name] for name in ("left_forearm_x", "position_z", "time")]
    assert found == pytest.approx([-90.0, 1.5, 0.02])


def test_motion_files_use_the_base_pose_and_skip_frames_without_a_pose(tmp_path):
    (tmp_path / "crane.urdf").write_text(URDF)
    marks = tmp_path / "landmarks.yaml"
    marks.write_text("landmarks:\n  hook: {link: jib, point: [0, 0, 0.4]}\n")
    model = load_model(tmp_path / "crane.urdf", check=False)
    base = np.array([1.0, 2.0, 3.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # 90 degrees about z.
    q, frames = np.array([0.5, -1.0]), ("0001", "0002", "0003")
    poses = [q, np.full(2, np.nan), q]
    bases = [base, None, base]
    rows = [FrameRecord(*one, 0.1, 0.1) for one in zip(frames, poses, bases, strict=True)]
    write_motion(tmp_path / "out", model, frames, rows, 25.0)
    jib = link_poses(model, q)["jib"]
    x, y, z = (jib @ [0.0, 0.0, 0.4, 1.0])[:3]
    written = list(csv.DictReader((tmp_path / "out" / "joint_centres.csv").open()))
    assert [row["frame"] for row in written] == ["0001", "0003"]
    found = [float(written[0][axis]) for axis in "xyz"]
    np.testing.assert_allclose(found, [1.0 - y, 2.0 + x, 3.0 + z], atol=1e-4)
    mot = (tmp_path / "out" / "positions.mot").read_text().splitlines()
    assert mot[mot.index("endheader") + 1].split("\t")[-7:] == list(BASE_COLUMNS)
    assert [float(cell) for cell in mot[-1].split("\t")[-7:]] == pytest.approx(base, abs=1e-5)
    # Without landmarks there are no joint centres.
    marks.unlink()
    write_motion(tmp_path / "robot", model, frames, rows, 25.0)
    assert {file.name for file in (tmp_path / "robot").iterdir()} == {"positions.mot"}


def begun(own_scene, out, **more):
    scene, model = load_scene(own_scene.folder), load_model(own_scene.model)
    job = {"scene": "s", "settings": {}, "method": "beam"}
    made = ResultWriter(scene, model, job, out, **more)
    made.begin()
    return made


def test_finished_frames_with_changed_masks_are_estimated_again(own_scene, tmp_path):
    scene, out = load_scene(own_scene.folder), tmp_path / "out"
    first = begun(own_scene, out)
    for frame, q in own_scene.truth.items():
        first.add(FrameRecord(frame, q, None, 0.01, 1.0))
    first.write_summary()
    assert read_summary(out)["complete"] is False
    path = scene.masks["front", "0001"]
    path.write_bytes(path.read_bytes())
    again = begun(own_scene, out, earlier=read_summary(out), frames=["0000"])
    assert (list(again.records), again.warnings) == (list(own_scene.truth), [])
    shutil.copy(scene.masks["front", "0000"], path)
    with pytest.raises(OutputError, match=r"frame 0001: the masks were replaced"):
        begun(own_scene, out, earlier=read_summary(out), frames=["0000", "0002"])
    again = begun(own_scene, out, earlier=read_summary(out), frames=["0001", "0002"])
    assert list(again.records) == ["0000", "0002"]
    assert again.warnings[0].startswith("frame 0001: estimated again")


def test_ctrl_c_while_a_row_is_appended_leaves_files_that_agree(own_scene, tmp_path, monkeypatch):
    result = begun(own_scene, tmp_path)
    (first, q), (second, p), *_ = own_scene.truth.items()
    result.add(FrameRecord(first, q, None, 0.01, 1.0))
    monkeypatch.setattr(PoseTable, "append", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        result.add(FrameRecord(second, p, None, 0.01, 1.0))
    result.end()
    rows = [one["frame"] for one in read_rows(tmp_path / "poses.csv")]
    assert rows == list(read_summary(tmp_path)["frames"]) == [first, second]


@pytest.mark.parametrize(("rate", "fps"), [(None, 10.0), (25.0, 25.0)])
def test_finished_jobs_have_all_files_and_warnings(own_scene, tmp_path, rate, fps):
    """Of a sequence, at its rate, and of single frames, a second each."""
    if rate:
        (own_scene.folder / "scene.yaml").write_text(f"sequence: true\nframe_rate_hz: {rate}\n")
    result = begun(own_scene, tmp_path / "out", warnings=["earlier"])
    (_, q), *_ = own_scene.truth.items()
    made = (
        FrameRecord("0002", q, None, 0.01, 1.0, ious={"front": 0.9}),
        FrameRecord("0000", q, None, 0.4, 1.0, stopped_by="run_limit"),
        FrameRecord("0001", np.full(2, np.nan), None, None, 1.0),
    )
    told = []
    pictures = {"overlay/front/0002.png": np.zeros((3, 4, 3), np.uint8)}
    result.add_all(
        [(one, pictures if one is made[0] else {}) for one in made], [*own_scene.truth],
        lambda *done: told.append(done[:3]),
    )  # fmt: skip
    assert told == [(0, 3, ""), (1, 3, "0002"), (2, 3, "0000"), (3, 3, "0001")]
    assert (tmp_path / "out/overlay/front/0002.png").read_bytes().startswith(b"\x89PNG")
    result.finish(replay=True)
    result.end()
    summary = read_summary(tmp_path / "out")
    assert (summary["complete"], [*summary["frames"]]) == (True, ["0000", "0001", "0002"])
    assert summary.get("frame_rate_hz") == rate
    earlier, stopped, lost, poor = sorted(summary["warnings"], key=lambda text: "fits" in text)
    assert (earlier, "no pose" in lost, "limit of runs" in stopped) == ("earlier", True, True)
    assert "frame 0000 (E_total 40.00 %)" in poor
    files = {one.name for one in (tmp_path / "out").iterdir()}
    motion = {"positions.mot"} if rate else set()
    assert files == {"overlay", "poses.csv", "summary.json", "replay.html", "report.html"} | motion
    assert tracks_of(played((tmp_path / "out/replay.html").read_text()))[1] == pytest.approx(fps)
    again = begun(own_scene, tmp_path / "more")
    again.add(made[2])
    again.finish(replay=True)
    assert not (tmp_path / "more/replay.html").exists()
    assert not begun(own_scene, None, earlier=summary).records
