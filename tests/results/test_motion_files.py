import csv
import io

import numpy as np
import pytest

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.landmarks import load_landmarks
from drake_pose.body.model import load_model
from drake_pose.results.motion_files import (
    centres_as_csv,
    centres_as_trc,
    joint_centres,
    positions_as_mot,
    write_motion,
)
from drake_pose.results.records import BASE_COLUMNS, PoseRow
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.jobs.bvh_reader import read_bvh
from tests.jobs.scenes import write_scene


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


def test_a_results_files_honour_the_base_and_leave_out_what_is_not_known(tmp_path):
    scene = write_scene(tmp_path / "scene", [(20, -40)] * 4)
    (scene.folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 25\n")
    (scene.model.parent / "landmarks.yaml").write_text(
        "landmarks:\n  hook: {link: jib, point: [0, 0, 0.4]}\n"
    )
    model = load_model(scene.model, check=False)
    base = np.array([1.0, 2.0, 3.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # 90 degrees about z.
    q = np.array([0.5, -1.0])
    lost = PoseRow("0002", np.full(2, np.nan), None, np.nan, 0.1)
    rows = [PoseRow("0001", q, base, 0.1, 0.1), lost, PoseRow("0003", q, base, 0.1, 0.1)]
    warnings = write_motion(tmp_path / "out", model, load_scene(scene.folder).frames, rows, 25.0)
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, q)
    jib = model.plant.GetBodyByName("jib").EvalPoseInWorld(context)
    x, y, z = jib.multiply(np.array([0.0, 0.0, 0.4]))
    written = list(csv.DictReader((tmp_path / "out" / "joint_centres.csv").open()))
    assert [row["frame"] for row in written] == ["0001", "0003"]
    found = [float(written[0][axis]) for axis in "xyz"]
    np.testing.assert_allclose(found, [1.0 - y, 2.0 + x, 3.0 + z], atol=1e-4)
    motion = read_bvh((tmp_path / "out" / "motion.bvh").read_text())
    assert motion.frame_time == pytest.approx(0.04)
    p_WJ = jib.translation()
    place = [100 * (1.0 - p_WJ[1]), 100 * (3.0 + p_WJ[2]), -100 * (2.0 + p_WJ[0])]
    np.testing.assert_allclose(motion.places()["jib"], [place] * 3, atol=0.01)
    assert "1 of 3 frames" in warnings[0]
    mot = (tmp_path / "out" / "positions.mot").read_text().splitlines()
    header = mot[mot.index("endheader") + 1].split("\t")
    assert header[-7:] == list(BASE_COLUMNS)
    assert [float(cell) for cell in mot[-1].split("\t")[-7:]] == pytest.approx(base, abs=1e-5)


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
