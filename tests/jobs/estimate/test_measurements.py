"""Joint positions and joint centres from tables and logs, and which pictures they belong to."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.camera.episode import Episode, JointLog, Stream
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import SceneError, UnknownNameError
from drake_pose.files.records import BASE_COLUMNS, FIT_COLUMNS
from drake_pose.files.settings import EpisodeSettings, EstimateSettings
from drake_pose.jobs.estimate import measurements
from drake_pose.jobs.estimate.inputs import make_tree
from drake_pose.jobs.estimate.measurements import (
    cameras_of,
    is_episode,
    is_timed,
    kept_pictures,
    left_out_warnings,
    logged_positions,
    map_log,
    posed_nodes,
    read_episode_scene,
    read_joint_centres,
    read_measured_positions,
    rows_of,
    timed_positions,
    with_leaders,
)
from drake_pose.silhouette.pictures.scenes import Scene
from tests.jobs.scenes import JOINT, LINK, NAMES, URDF

ABC = SimpleNamespace(
    position_names=("a", "b", "c"), position_kinds=("length",) * 3, couplings=(),
    lower=np.full(3, -np.inf), upper=np.full(3, np.inf), is_unlimited_angle=np.zeros(3, bool),
)  # fmt: skip
CENTRES = "frame,joint,x,y,z\n0,ankle,1,2,3\n0,knee,4,5,6\n7,ankle,-1,-2,-3\n"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n", "first line"),
        ("frame,joint,x,y,z\n0,ankle,1,2,here\n", "line 2"),
        ("frame,joint,x,y,z\n0,ankle,1,2,nan\n", "not finite"),
        ("frame,joint,x,y,z\n0.5,ankle,1,2,3\n", "'ankle'.*'0000'"),
        ("frame,joint,x,y,z\n0,ankle,1,2,3\n00,ankle,1,2,3\n", "line 3: frame '00' .* twice"),
    ],
)
def test_damaged_joint_centres(tmp_path, text, message):
    path = written(tmp_path / "centres.csv", text)
    with pytest.raises(SceneError, match=rf"centres\.csv.*{message}"):
        read_joint_centres(path, "ankle", ["0000"])


def test_joint_centres_compare_frames_as_numbers(tmp_path):
    path = written(tmp_path / "centres.csv", CENTRES)
    positions = read_joint_centres(path, "ankle", ["0000", "0007"])
    assert [one.tolist() for one in positions.values()] == [[1, 2, 3], [-1, -2, -3]]
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


def test_a_table_of_estimates_is_read_with_its_base(tmp_path):
    """Rows without a pose are skipped; the base is apart from the positions."""
    base, fit = ",".join(BASE_COLUMNS), ",".join(FIT_COLUMNS)
    numbers = ",".join(str(k) for k in range(7))
    text = f"frame,a,b,{base},{fit}\n0,1,2,{numbers},0.1,3\n1,,,{',' * 6},,3\n"
    found = read_measured_positions(written(tmp_path / "poses.csv", text), ABC)
    assert found.names == ("a", "b")
    np.testing.assert_array_equal(found.by_frame[0], [1.0, 2.0])
    np.testing.assert_array_equal(found.bases[0], np.arange(7.0))
    assert found.is_estimate
    plain = read_measured_positions(
        written(tmp_path / "p.csv", f"frame,a,{fit}\n0,1,0.1,3\n2,4,nan,3\n"), ABC
    )
    assert (plain.names, plain.bases, [*plain.by_frame]) == (("a",), None, [0])
    for bad, told in (
        ("frame\n", "expected"),
        ("time,a\n0,1\n", "first"),
        ("frame,a,a\n0,1,1\n", "it has"),
    ):
        with pytest.raises(SceneError, match=told):
            read_measured_positions(written(tmp_path / "bad.csv", bad), ABC)


def test_a_folder_is_an_episode_unless_it_has_masks(tmp_path):
    settings, numbered = EpisodeSettings(), EpisodeSettings(episode=0)
    assert not is_episode(tmp_path, settings)
    assert is_episode(tmp_path, numbered)
    assert is_episode(written(tmp_path / "a.mcap", ""), settings)
    (tmp_path / "a.mcap").unlink()
    (tmp_path / "images").mkdir()
    assert is_episode(tmp_path, settings)
    (tmp_path / "masks").mkdir()
    assert not is_episode(tmp_path, settings)
    (text,) = left_out_warnings(["a", "b"], {"a"})
    assert "camera 'b' has no X_WC" in text


@pytest.fixture(scope="module")
def tree(tiny_scene):
    return make_tree(load_model(tiny_scene.model), EstimateSettings())


def test_a_table_with_times_is_read_at_the_times_of_the_pictures(tmp_path, tree):
    """In degrees and by similar names; by the frames' names if it has any."""
    late = 0.2 + 0.1 * np.arange(8)
    scene = Scene(tmp_path, {}, tuple(f"{k:04d}" for k in range(8)), {}, times=late)
    rows = [f"{0.05 * k},{k},{-2 * k}" for k in range(40)]
    start = written(tmp_path / "c", "\n".join([f"time,{NAMES[0]}_joint,{NAMES[1].upper()}", *rows]))
    found, starts, warnings = timed_positions(start, scene, tree, EpisodeSettings())
    expected = np.radians(20.0 * late[:, None] * [1.0, -2.0])
    np.testing.assert_allclose([found.by_frame[k] for k in range(8)], expected, atol=1e-6)
    np.testing.assert_allclose([*starts.values()], expected, atol=1e-6)
    assert any("assumed to be in deg" in text for text in warnings)
    # Beyond the log there are no positions.
    early = replace(scene, times=late - 0.5)
    assert {*timed_positions(start, early, tree, EpisodeSettings())[1]} == {*scene.frames[3:]}
    for times in (np.zeros(0), np.full(8, np.nan)):
        with pytest.raises(SceneError, match="has times, but those of the pictures are not known"):
            timed_positions(start, replace(scene, times=times), tree, EpisodeSettings())
    frames = [f"{k},{9 - k},{0.1 * k},0" for k in range(8)]
    written(start, "\n".join([f"frame,time,{NAMES[0]},{NAMES[1]}", *frames[::-1]]))
    found, _, _ = timed_positions(start, scene, tree, EpisodeSettings())
    np.testing.assert_allclose([found.by_frame[k][0] for k in range(8)], 0.1 * np.arange(8))


def test_joints_that_are_not_logged_have_the_defaults(tmp_path, tree):
    log = JointLog(("luff",), np.arange(3.0), np.array([[-0.1], [-0.2], [0.05]]))
    mapped = map_log(tmp_path, log, tree, EpisodeSettings())
    assert (mapped.names, mapped.not_logged, [*mapped.columns]) == (NAMES, ("lift",), ["luff"])
    np.testing.assert_allclose(mapped.positions[:, 0], tree.model.default_positions[0])
    np.testing.assert_allclose(mapped.positions[:, 1], log.positions[:, 0])
    assert any("joints that are not logged: lift" in text for text in mapped.warnings)
    assert posed_nodes(tree, mapped) == ("base",)
    held = make_tree(tree.model, EstimateSettings(hold={"lift": 10.0}))
    mapped = map_log(tmp_path, log, held, EpisodeSettings())
    assert (mapped.names, mapped.not_logged) == (("luff",), ())
    assert posed_nodes(held, mapped) == ("base", "boom", "jib")
    bare = Scene(tmp_path, {}, ("0", "1"), {}, times=np.array([0.5, 9.0]), joints=log)
    truth, starts, _ = logged_positions(bare, tree, EpisodeSettings())
    assert (truth.names, [*starts]) == (("luff",), ["0"])
    np.testing.assert_allclose(starts["0"], [tree.model.default_positions[0], -0.15])
    assert logged_positions(replace(bare, joints=None), tree, EpisodeSettings()) == (None, {}, ())
    table = written(tmp_path / "map.yaml", "luff: {column: a, scale: 2.0}\n")
    other = replace(log, names=("a",))
    mapped = map_log(tmp_path, other, tree, EpisodeSettings(joint_map=table, units="rad"))
    np.testing.assert_allclose(mapped.positions[:, 1], 2.0 * log.positions[:, 0])


def test_followers_give_the_positions_of_their_leaders(tmp_path):
    """Of a gripper whose finger moves by -.5 times the other, plus .1."""
    moving = JOINT.format(name="twin", parent="boom", child="tool", z=0.1, lower=-2, upper=2)
    moving = moving.replace(
        "</joint>", '<mimic joint="luff" multiplier="-0.5" offset="0.1"/></joint>'
    )
    path = tmp_path / "gripper.urdf"
    tool = LINK.format(name="tool", z=0.1, size="0.1 0.1 0.2")
    path.write_text(URDF.replace("</robot>", f"{tool}{moving}</robot>"))
    model = load_model(path)
    luff, twin = np.array([-0.4, -0.2]), 0.1 - 0.5 * np.array([-0.4, -0.2])
    q, couplings, texts = with_leaders(model, model.couplings, ("twin",), twin[:, None])
    np.testing.assert_allclose(q[:, model.position_index("luff")], luff)
    assert [*couplings] == ["luff"]
    assert "follows from 'twin', which is -0.5 x 'luff' +0.1" in texts[0]
    q, couplings, texts = with_leaders(
        model, model.couplings, ("luff", "twin"), np.column_stack([luff, twin])
    )
    assert (couplings, texts) == ({}, [])
    _, _, texts = with_leaders(
        model, model.couplings, ("luff", "twin"), np.column_stack([luff, twin + np.arange(2.0)])
    )
    assert len(texts) == 1
    log = JointLog(("twin",), np.arange(2.0), twin[:, None])
    mapped = map_log(tmp_path, log, model.pose_tree(), EpisodeSettings())
    np.testing.assert_allclose(mapped.positions[:, mapped.names.index("luff")], luff)
    column = mapped.columns["luff"]
    np.testing.assert_allclose(column.scale * twin + column.offset, luff)


def stream(name, times, frames=()):
    """Return a stream of pictures whose first pixel is their number."""
    camera = PinholeCamera(name, 4, 2, 5.0, 5.0, 1.5, 0.5, np.eye(4))
    times = np.array(times, float)
    names = frames or tuple(f"{k:04d}" for k in range(len(times)))
    return Stream(
        name, 4, 2, times, camera, None, lambda k: np.full((2, 4, 3), k, np.uint8), names,
        is_posed=True,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("times", "others", "expected", "rate"),
    [
        ([0.0, 0.1, 0.2], [0.04, 0.16, 0.22], {0: 0, 1: None, 2: 2}, 10.0),
        ([0.0, 0.1, 0.2], [0.16], {0: None, 1: None, 2: 0}, 10.0),
        ([0.0], [9.0], {0: 0}, None),
        ([np.nan] * 3, [np.nan] * 2, {0: 0, 1: 1, 2: None}, None),
        ([0.0, 0.1], [np.nan] * 2, {0: 0, 1: 1}, 10.0),
    ],
)
def test_pictures_of_other_cameras_are_synchronised(
    tmp_path, monkeypatch, times, others, expected, rate
):
    """By time to half a period, else by name."""
    cameras = {"a": stream("a", times), "b": stream("b", others)}
    episode = Episode(tmp_path, cameras, None)
    monkeypatch.setattr(measurements, "open_episode", lambda *_, **__: episode)
    scene = read_episode_scene(tmp_path, EpisodeSettings(), None, None)
    assert scene.sequence
    assert scene.frame_rate_hz == (None if rate is None else pytest.approx(rate))
    for k, number in expected.items():
        assert (("b", f"{k:04d}") in scene.images) == (number is not None)
        assert scene.read_image("a", f"{k:04d}")[0, 0, 0] == k
        if number is not None:
            assert scene.read_image("b", f"{k:04d}")[0, 0, 0] == number
    if len(times) == 3:
        some = EpisodeSettings(frames=("1:2",), every=2)
        assert kept_pictures(cameras["a"], some).tolist() == [1]
    cameras["a"] = replace(cameras["a"], is_posed=False)
    scene = read_episode_scene(tmp_path, EpisodeSettings(), None, None)
    assert [*scene.cameras] == ["b"]
    assert "'a' has no X_WC" in scene.warnings[0]
    chosen, placed, texts = cameras_of(episode, None, EpisodeSettings(cameras=("b",)))
    assert ([one.name for one in chosen], placed, texts) == (["b"], {"b"}, ())
    with pytest.raises(UnknownNameError, match="'c'"):
        cameras_of(episode, None, EpisodeSettings(cameras=("c",)))
    cameras.pop("b")
    with pytest.raises(SceneError, match="no camera has a pose"):
        read_episode_scene(tmp_path, EpisodeSettings(), None, None)


def test_rows_belong_to_pictures_by_time_or_name():
    timed = JointLog(("a",), np.arange(3.0), np.array([[0.0], [1.0], [4.0]]))
    named, camera = replace(timed, times=None, frames=("0", "1", "2")), stream("a", [0.0, 1.0, 2.0])
    untimed, kept = stream("a", [np.nan] * 3), np.array([0, 1])
    pairs = ((timed, camera), (named, camera), (timed, untimed))
    assert [is_timed(*pair) for pair in pairs] == [True, False, False]
    rows = [rows_of(log, camera, kept, np.array(0.5)).ravel().tolist() for log in (timed, named)]
    assert rows == [[0.5, 2.5], [0.0, 1.0]]
