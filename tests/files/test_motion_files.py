import csv
import io
import re

import numpy as np
import pytest

from drake_pose.body import bundled_model, load_landmarks, load_model
from drake_pose.errors import SettingsError
from drake_pose.files.motion_files import (
    centres_as_csv,
    centres_as_trc,
    joint_centres,
    motion_as_bvh,
    positions_as_mot,
    skeleton_of,
    write_motion,
)
from drake_pose.files.records import BASE_COLUMNS, FrameRecord
from tests.body.models import joint, link, link_poses, urdf, write
from tests.files.bvh_reader import read_bvh
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
    hanging, raised = (
        np.subtract(at[frame, "left_wrist"], at[frame, "left_elbow"]) for frame in ("0", "1")
    )
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
    (warning,) = write_motion(tmp_path / "out", model, frames, rows, 25.0)
    assert "1 of 3 frames" in warning
    jib = link_poses(model, q)["jib"]
    x, y, z = (jib @ [0.0, 0.0, 0.4, 1.0])[:3]
    written = list(csv.DictReader((tmp_path / "out" / "joint_centres.csv").open()))
    assert [row["frame"] for row in written] == ["0001", "0003"]
    found = [float(written[0][axis]) for axis in "xyz"]
    np.testing.assert_allclose(found, [1.0 - y, 2.0 + x, 3.0 + z], atol=1e-4)
    motion = read_bvh((tmp_path / "out" / "motion.bvh").read_text())
    assert motion.frame_time == pytest.approx(0.04)
    x, y, z = jib[:3, 3]
    place = [100 * (1.0 - y), 100 * (3.0 + z), -100 * (2.0 + x)]
    np.testing.assert_allclose(motion.places()["jib"], [place] * 3, atol=0.01)
    mot = (tmp_path / "out" / "positions.mot").read_text().splitlines()
    assert mot[mot.index("endheader") + 1].split("\t")[-7:] == list(BASE_COLUMNS)
    assert [float(cell) for cell in mot[-1].split("\t")[-7:]] == pytest.approx(base, abs=1e-5)
    # Without landmarks or a skin there is no BVH file.
    marks.unlink()
    assert not write_motion(tmp_path / "robot", model, frames, rows, 25.0)
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


FRAMES = 6
RATE_HZ = 50.0


def open_model(name):
    folder, file = name.split("/")
    return load_model(bundled_model(folder).with_name(file), check=False)


def random_positions(model, rng):
    """Random positions within the limits; lengths, except the root's, are constant."""
    lower = np.clip(model.lower, -3.0, 3.0)
    upper = np.clip(model.upper, -3.0, 3.0)
    q = rng.uniform(lower, upper, (FRAMES, len(lower)))
    for k, (name, kind) in enumerate(zip(model.position_names, model.position_kinds, strict=True)):
        if kind == "length" and not name.startswith("position_"):
            q[:, k] = q[0, k]
    return q


def link_places(model, link, q):
    """Return a link's origin (frames, 3) by the plant, in the file's axes [cm]."""
    x, y, z = 100.0 * np.array([link_poses(model, row)[link][:3, 3] for row in q]).T
    return np.column_stack([x, z, -y])


@pytest.mark.parametrize(
    "name", ["person/person.urdf", "person/person_shape.urdf", "hand/hand.urdf"]
)
def test_bvh_places_every_link_where_the_plant_does(name):
    model = open_model(name)
    q = random_positions(model, np.random.default_rng(5))
    text, filled = motion_as_bvh(model, q, None, RATE_HZ)
    motion = read_bvh(text)
    places = motion.places()
    assert filled == 0
    assert motion.frame_time == pytest.approx(1.0 / RATE_HZ)
    links = [link for link, _ in skeleton_of(model, q)]
    # All links with geometry, except lower halves of limbs, which share the upper halves' origin.
    assert set(links) == {link for link in model.link_meshes if not link.endswith("_end")}
    for part in links:
        error = places[part] - link_places(model, part, q)
        assert np.linalg.norm(error, axis=1).max() < 0.01, part
    levels = [len(tabs) for tabs in re.findall(r"^(\t*)(?:ROOT|JOINT) ", text, re.MULTILINE)]
    assert levels[0] == 0 < min(levels[1:])
    root, *others = [one for one in motion.joints if one.channels]
    assert root.channels == [
        "Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation"
    ]  # fmt: skip
    assert all(one.channels == ["Zrotation", "Xrotation", "Yrotation"] for one in others)


def test_bvh_rest_pose_is_the_default_pose_with_captured_lengths():
    model = open_model("person/person_shape.urdf")
    q = np.tile(model.default_positions, (2, 1))
    q[:, model.position_index("left_thigh_stretch")] = 0.05
    q[1, model.position_index("left_shin_x")] = 1.0
    motion = read_bvh(motion_as_bvh(model, q, None, RATE_HZ)[0])
    for one in motion.joints:
        if one.name in model.link_names and one.parent >= 0:
            parent = motion.joints[one.parent].name
            rest = link_places(model, one.name, q[:1]) - link_places(model, parent, q[:1])
            np.testing.assert_allclose(one.offset, rest[0], atol=1e-3)
    # y is up: the head is above the feet, and the toes are before the heels.
    places = motion.places()
    assert places["head"][0, 1] - places["left_foot"][0, 1] > 100.0
    assert places["left_foot_end"][0, 0] - places["left_foot"][0, 0] > 5.0


def test_a_sliding_part_has_position_channels_and_zero_offset(tmp_path):
    parts = map(link, ("mast", "carriage", "arm", "left_finger"))
    text = urdf(
        *parts,
        joint("bolt", "fixed", "world", "mast", limits=None),
        joint("height", "prismatic", "mast", "carriage", limits='lower="0" upper="0.5"'),
        joint("swing", "revolute", "carriage", "arm"),
        joint("grip", "prismatic", "arm", "left_finger", axis="0 1 0"),
    )
    model = load_model(write(tmp_path, text), check=False)
    q = np.array([[0.1, 0.5, 0.02], [0.3, -0.4, 0.02], [0.2, 0.1, 0.07]])
    motion = read_bvh(motion_as_bvh(model, q, None, RATE_HZ)[0])
    places = motion.places()
    by_name = {one.name: one for one in motion.joints}
    assert len(by_name["carriage"].channels) == len(by_name["left_finger"].channels) == 6
    assert not by_name["carriage"].offset.any()
    for name in ("mast", "carriage", "arm", "left_finger"):
        np.testing.assert_allclose(places[name], link_places(model, name, q), atol=0.01)


def test_several_roots_are_children_of_the_world(tmp_path):
    turn = {"axis": "0 1 0", "kind": "revolute", "parent": "world"}
    text = urdf(
        *map(link, "ab"),
        joint("turn_a", child="a", origin='xyz="0 0 1"', **turn),
        joint("turn_b", child="b", origin='xyz="1 0 1"', **turn),
    )
    model = load_model(write(tmp_path, text), check=False)
    q = np.array([[0.2, -0.3], [0.4, 0.1]])
    motion = read_bvh(motion_as_bvh(model, q, None, RATE_HZ)[0])
    assert [one.name for one in motion.joints if one.channels] == ["world", "a", "b"]
    np.testing.assert_allclose(motion.places()["b"], [[100.0, 100.0, 0.0]] * 2, atol=0.01)


def test_bvh_uses_the_base_pose():
    model = open_model("hand/hand.urdf")
    q = np.tile(model.default_positions, (2, 1))
    X_WB = np.tile(np.eye(4), (2, 1, 1))
    X_WB[1, :3, 3] = [0.1, 0.2, 0.3]
    X_WB[1, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    places = read_bvh(motion_as_bvh(model, q, X_WB, RATE_HZ)[0]).places()
    x, y, z = places["palm"][0]
    # A base pose of 90 degrees about the vertical and a translation; x forward, z right, y up.
    np.testing.assert_allclose(places["palm"][1], [z + 10.0, y + 30.0, -x - 20.0], atol=0.01)


def test_bvh_frames_without_a_pose_repeat_the_last_known_one():
    model = open_model("person/person.urdf")
    q = random_positions(model, np.random.default_rng(6))
    whole = read_bvh(motion_as_bvh(model, q, None, RATE_HZ)[0])
    q[[0, 3, 4]] = np.nan
    text, filled = motion_as_bvh(model, q, None, RATE_HZ)
    gaps = read_bvh(text)
    assert filled == 3
    for name, places in gaps.places().items():
        expected = whole.places()[name][[1, 1, 2, 2, 2, 5]]
        np.testing.assert_allclose(places, expected, atol=0.01)
    with pytest.raises(SettingsError, match="one frame with a pose"):
        motion_as_bvh(model, np.full_like(q, np.nan), None, RATE_HZ)


def test_bvh_angles_are_continuous_past_half_a_turn():
    model = open_model("person/person.urdf")
    q = np.tile(model.default_positions, (40, 1))
    q[:, model.position_index("head_y")] = np.linspace(2.0, 4.5, 40)
    q[:, model.position_index("head_x")] = np.linspace(-0.9, 0.9, 40)
    motion = read_bvh(motion_as_bvh(model, q, None, RATE_HZ)[0])
    assert np.abs(np.diff(motion.rows[:, 3:], axis=0)).max() < 15.0
