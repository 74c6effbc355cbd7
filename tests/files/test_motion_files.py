import csv
import io

import numpy as np
import pytest

from drake_pose.body import load_landmarks, load_model
from drake_pose.files.records import BASE_COLUMNS, FrameRecord
from drake_pose.files.writer import (
    centres_as_csv,
    centres_as_trc,
    joint_centres,
    positions_as_mot,
    write_motion,
)
from tests.body.models import link_poses
from tests.jobs.scenes import URDF


@pytest.fixture(scope="module")
def q(person):
    rows = np.zeros((3, len(person.position_names)))
    rows[:, person.position_index("position_z")] = 1.5
    rows[1, person.position_index("left_forearm_x")] = np.radians(-90.0)
    rows[2] = np.nan
    return rows


@pytest.fixture(scope="module")
def centres(person, q):
    """Names and positions of the person's joint centres."""
    landmarks = load_landmarks(person.path)
    return list(landmarks), joint_centres(person, landmarks, q)


def test_csv_has_the_joint_centres_of_frames_with_a_pose(centres):
    names, places = centres
    rows = list(csv.DictReader(io.StringIO(centres_as_csv(["0", "1", "2"], names, places))))
    assert len(rows) == 2 * len(names)
    at = {(row["frame"], row["joint"]): [float(row[axis]) for axis in "xyz"] for row in rows}
    wrist, elbow = (np.array([at[f, f"left_{one}"] for f in "01"]) for one in ("wrist", "elbow"))
    hanging, raised = wrist - elbow
    # The forearm points forward, along the world's x.
    assert raised[2] == pytest.approx(0.0, abs=0.03)
    assert raised[0] > 0.2
    assert hanging[2] < -0.2


def test_trc_is_in_millimetres_with_y_up(centres):
    names, places = centres
    cells = [line.split("\t") for line in centres_as_trc(names, places, 60.0).splitlines()]
    assert cells[0][:3] == ["PathFileType", "4", "(X/Y/Z)"]
    header = dict(zip(cells[1], cells[2], strict=True))
    assert (header["NumFrames"], header["NumMarkers"]) == ("3", str(len(names)))
    assert header["Units"] == "mm"
    x, y, z = np.array(cells[6][2:], dtype=float).reshape(-1, 3).T
    np.testing.assert_allclose(np.column_stack([x, -z, y]), 1e3 * places[0], atol=1e-3)
    assert float(cells[7][1]) == pytest.approx(1 / 60.0, abs=1e-6)
    assert cells[8][2:] == [""] * (3 * len(names))


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


def test_mot_is_in_degrees(person, q):
    lines = positions_as_mot(person, q, 50.0).splitlines()
    begin = lines.index("endheader")
    assert "nRows=2" in lines[:begin]
    assert "inDegrees=yes" in lines[:begin]
    names = lines[begin + 1].split("\t")
    row = dict(zip(names, lines[begin + 3].split("\t"), strict=True))
    assert float(row["left_forearm_x"]) == pytest.approx(-90.0)
    assert float(row["position_z"]) == pytest.approx(1.5)
    assert float(row["time"]) == pytest.approx(0.02)
