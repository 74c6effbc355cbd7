import csv
import io

import numpy as np
import pytest

from drake_pose.apps.motion_files import (
    centres_as_csv,
    centres_as_trc,
    joint_centres,
    positions_as_mot,
)
from drake_pose.body import bundled_model, load_model
from drake_pose.body.landmarks import load_landmarks


@pytest.fixture(scope="module")
def person():
    return load_model(bundled_model("person"), check=False)


@pytest.fixture(scope="module")
def q(person):
    rows = np.zeros((3, len(person.position_names)))
    rows[:, person.position_index("position_z")] = 1.5
    rows[1, person.position_index("left_forearm_x")] = np.radians(-90.0)
    rows[2] = np.nan
    return rows


def test_csv_has_the_joint_centres_of_frames_with_a_pose(person, q):
    landmarks = load_landmarks(person.path)
    places = joint_centres(person, landmarks, q)
    text = centres_as_csv(["0", "1", "2"], list(landmarks), places)
    rows = list(csv.DictReader(io.StringIO(text)))
    assert len(rows) == 2 * len(landmarks)
    wrists = {row["frame"]: row for row in rows if row["joint"] == "left_wrist"}
    elbow = next(row for row in rows if row["frame"] == "1" and row["joint"] == "left_elbow")
    # The forearm points forward, along the world's x.
    assert float(wrists["1"]["z"]) == pytest.approx(float(elbow["z"]), abs=0.03)
    assert float(wrists["1"]["x"]) - float(elbow["x"]) > 0.2
    assert float(wrists["0"]["z"]) < float(elbow["z"]) - 0.2


def test_trc_is_in_millimetres_with_y_up(person, q):
    landmarks = load_landmarks(person.path)
    places = joint_centres(person, landmarks, q)
    lines = centres_as_trc(list(landmarks), places, 60.0).splitlines()
    assert lines[0].startswith("PathFileType\t4\t(X/Y/Z)")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert header["NumFrames"] == "3"
    assert header["NumMarkers"] == str(len(landmarks))
    assert header["Units"] == "mm"
    first = lines[6].split("\t")
    k = list(landmarks).index("left_hip")
    x, y, z = (float(cell) for cell in first[2 + 3 * k : 5 + 3 * k])
    np.testing.assert_allclose([x, -z, y], 1e3 * places[0, k], atol=1e-3)
    assert float(lines[7].split("\t")[1]) == pytest.approx(1 / 60.0, abs=1e-6)
    assert all(cell == "" for cell in lines[8].split("\t")[2:])
    assert {len(line.split("\t")) for line in lines[6:9]} == {2 + 3 * len(landmarks)}


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
