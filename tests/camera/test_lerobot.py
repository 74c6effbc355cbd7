"""LeRobot data sets as users have them: other words, names, clocks and pictures, and damage."""

import json
import re
import shutil

import cv2
import numpy as np
import pyarrow
import pytest

from drake_pose.camera.episode_files import open_episode
from drake_pose.camera.lerobot_tables import is_picture, row_times
from drake_pose.errors import DrakePoseError, SceneError, UnknownNameError
from tests.camera.recordings import number_of, numbered, png, write_table, write_video

COUNT, TOP = 10, "observation.images.top"
STATE_OF, TIME_OF, INDEX = "observation.state", "timestamp", "episode_index"
V2 = "chunk-{episode_chunk:03d}/episode_{episode_index:06d}"
V3 = "chunk-{chunk_index:03d}/file-{file_index:03d}"
TIMES = 0.1 * np.arange(COUNT)
STATES = [[0.1 * k, -1.0] for k in range(COUNT)]
STATE = {"dtype": "float32", "shape": [2], "names": ["pan", "lift"]}
MEDIA = {"video": {"dtype": "video"}, "image": {"dtype": "image", "shape": [64, 64, 3]}}


def write_set(
    folder, paths=None, *, version="v2.1", features=None, columns=None, info=None, episode=0,
    video="videos/chunk-000/" + TOP + "/episode_000000.mp4",
    data="data/chunk-000/episode_000000.parquet", start=0.0, numbers=range(COUNT),
):  # fmt: skip
    """Write a data set with one episode; ``paths``: templates; None in columns removes one."""
    features = {"observation.state": STATE, TOP: MEDIA["video"]} if features is None else features
    content = {"codebase_version": version, "fps": 10, "total_episodes": episode + 1}
    content |= {"chunks_size": 1000, "features": features} | (paths or {}) | (info or {})
    for name in ("meta", "data", "videos"):
        shutil.rmtree(folder / name, ignore_errors=True)
    (folder / "meta").mkdir(parents=True)
    content = {key: one for key, one in content.items() if one is not None}
    (folder / "meta" / "info.json").write_text(json.dumps(content))
    own = {"observation.state": STATES, "timestamp": TIMES, "episode_index": [episode] * COUNT}
    own |= {"frame_index": range(COUNT)} | (columns or {})
    write_table(folder / data, {key: one for key, one in own.items() if one is not None})
    if video:
        write_video(folder / video, numbers, start + 0.1 * np.arange(len(numbers)))
    return folder


def check(folder, shift=0.0, **more):
    """Check that picture k and row k have time 0.1 k [s]; return the episode."""
    episode = open_episode(folder, **more)
    (one,), joints = episode.cameras.values(), episode.joints
    assert [number_of(one.read(k)) for k in (0, len(one.times) - 1, 4)] == [0, COUNT - 1, 4]
    np.testing.assert_allclose(one.times, TIMES + shift, atol=1e-6)
    np.testing.assert_allclose(joints.times, TIMES, atol=1e-6)
    np.testing.assert_allclose(joints.positions[:, 0], 0.1 * np.arange(COUNT), atol=1e-6)
    return episode


@pytest.mark.parametrize(
    ("paths", "data", "video"),
    [
        ((V3, "{video_key}/" + V3), "chunk-000/file-000", f"{TOP}/chunk-000/file-000"),
        ((None, None), "chunk-000/episode_000000", f"chunk-000/{TOP}/episode_000000"),
        (("{chunk}/{episode}", "{key}/{episode_id:03d}"), "0/0", f"{TOP}/000"),
        ((V2, "chunk-{chunk_index:03d}/{video_key}/{episode_index}"), *2 * [None]),
    ],
)
@pytest.mark.parametrize("lines", [True, False])
def test_templates_of_any_version_are_filled_in(tmp_path, paths, data, video, lines):
    data, video = data or "chunk-000/episode_000000", video or f"chunk-000/{TOP}/0"
    given = {"data_path": f"data/{paths[0]}.parquet", "video_path": f"videos/{paths[1]}.mp4"}
    given = given if paths[0] else {}
    write_set(tmp_path, given, data=f"data/{data}.parquet", video=f"videos/{video}.mp4")
    if lines:
        (tmp_path / "meta/episodes.jsonl").write_text('{"episode_index": 0, "length": 10}\n\n')
    assert check(tmp_path, episode=0).joints.names == ("pan", "lift")
    assert check(tmp_path).warnings == ()


def test_version_2_files_are_numbered_on_or_in_each_chunk(tmp_path):
    for index in (7, 1):
        name = f"chunk-002/file-{index:03d}"
        paths = {"data_path": f"data/{V3}.parquet", "video_path": f"videos/{V3}.mp4"}
        files = {"data": f"data/{name}.parquet", "video": f"videos/{name}.mp4"}
        write_set(tmp_path, paths, **files, info={"chunks_size": 3}, episode=7)
        check(tmp_path, episode=7)
    # Version 3 with words of version 2, and without metadata.
    paths = {"data_path": f"data/{V2}.parquet", "video_path": "videos/{video_key}/" + V2 + ".mp4"}
    write_set(tmp_path, paths, version="3.0", video=f"videos/{TOP}/chunk-000/episode_000000.mp4")
    check(tmp_path)
    write_set(tmp_path, version="v3.0", data="data/chunk-000/file-000.parquet", video=None)
    with pytest.raises(SceneError, match=r"column data/file_index of meta/episodes.* is missing"):
        open_episode(tmp_path)
    write_set(tmp_path, {"data_path": "data/{what}.parquet"})
    with pytest.raises(SceneError, match=r"'data/\{what\}\.parquet' cannot be .*'what'.* known wo"):
        open_episode(tmp_path)


def test_a_video_begins_where_its_file_says(tmp_path):
    """Pictures of a whole video are the rows' in order; others have the times of the file."""
    write_set(tmp_path, start=0.2)
    text = "begins at 0.200 s, not at 0.000 s, but has as many pictures"
    assert text in "\n".join(check(tmp_path).warnings)
    write_set(tmp_path, start=0.2, numbers=range(2, COUNT))
    one = open_episode(tmp_path).camera("top")
    assert [number_of(one.read(k)) for k in range(8)] == [*range(2, COUNT)]
    np.testing.assert_allclose(one.times, TIMES[2:], atol=1e-6)
    for begin, start in ((0.2, 0.2), (0.0, 0.2), (0.2, 0.0), (33.4, 0.0)):
        path = f"videos/{TOP}/chunk-000/file-000.mp4"
        table = "data/chunk-000/file-000.parquet"
        write_set(tmp_path, version="v3.0", data=table, video=path, start=start)
        ends = {"from_timestamp": begin, "to_timestamp": begin + 1.0}
        meta = {"data/chunk_index": 0, "data/file_index": 0}
        meta |= {f"videos/{TOP}/{key}": one for key, one in ends.items()}
        meta |= {"episode_index": 0} | {f"videos/{TOP}/{k}_index": 0 for k in ("chunk", "file")}
        columns = {key: [one] for key, one in meta.items()}
        write_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet", columns)
        assert (check(tmp_path).warnings == ()) == (begin == start)


STORED = ["bytes", "struct", "text", "other", "folder", "HWC", "CHW", "flat"]


@pytest.mark.parametrize("kind", STORED)
@pytest.mark.parametrize("is_jpeg", [True, False])
def test_pictures_are_stored_in_many_ways(tmp_path, kind, is_jpeg):
    end, name = ".jpg" if is_jpeg else ".png", "wrist_image"
    files = [cv2.imencode(end, numbered(k)[:, :, ::-1])[1].tobytes() for k in range(COUNT)]
    folder = tmp_path / "images" / name / "episode_000000"
    folder.mkdir(parents=True)
    names = [f"frame_{k:06d}{end}" for k in range(COUNT)]
    for path, data in zip(names, files, strict=True):
        if kind in ("struct", "text", "other", "folder"):
            (folder / path).write_bytes(data)
    arrays = np.array([numbered(k) for k in range(COUNT)])
    if is_jpeg:
        arrays = (arrays / 255.0).astype(np.float32)
    cells = {
        "bytes": files,
        "struct": [{"bytes": None, "path": path} for path in names],
        "text": [f"images/{name}/episode_000000/{path}" for path in names],
        "other": [f"/home/me/sets/images/{name}/episode_000000/{path}" for path in names],
        "folder": None,
        "HWC": arrays.tolist(),
        "CHW": np.moveaxis(arrays, 3, 1).tolist(),
        "flat": arrays.reshape(COUNT, -1).tolist(),
    }[kind]
    if kind in ("HWC", "CHW"):
        inner = pyarrow.float32() if is_jpeg else pyarrow.uint8()
        cells = pyarrow.array(cells, pyarrow.list_(pyarrow.list_(pyarrow.list_(inner))))
    features = {"state": STATE, name: MEDIA["image"]}
    columns = {"observation.state": None, "state": STATES, name: cells}
    write_set(tmp_path, features=features, columns=columns, video=None)
    found = check(tmp_path).camera(name).read(5).astype(int)
    np.testing.assert_allclose(found, numbered(5), atol=40 if is_jpeg else 0)


@pytest.mark.parametrize("unit", [1, 10**3, 10**6, 10**9])
@pytest.mark.parametrize("is_video", [True, False])
def test_stamps_of_any_unit_since_1970_are_counted_from_the_start(tmp_path, unit, is_video):
    stamps = np.array([round((1_700_000_000 + time) * 1000) for time in TIMES]) * (unit / 1000)
    features = {"observation.state": STATE, TOP: MEDIA["video" if is_video else "image"]}
    columns = {"timestamp": stamps if unit < 10**9 else stamps.astype(np.int64)}
    columns |= {} if is_video else {TOP: [*map(png, range(COUNT))]}
    write_set(tmp_path, features=features, columns=columns)
    warnings = "\n".join(check(tmp_path).warnings)
    assert "the rows' times begin at 1.7e+09 s" in warnings
    assert ("is taken to be in" in warnings) == (unit > 1)
    # A table with the rows' clock is moved with them.
    table = tmp_path / "log.csv"
    table.write_text("time,pan\n" + "".join(f"{1.7e9 + t},{t}\n" for t in TIMES))
    check(tmp_path, joints=table)


def test_other_stamps(tmp_path):
    days = pyarrow.array([round(1e6 * (1.7e9 + t)) for t in TIMES], pyarrow.timestamp("us"))
    for stamps, text in (
        (days, "in microseconds"),
        (100.0 * np.arange(COUNT), "in ms"),
        ([[t] for t in TIMES], ""),
        ([t + 3.7 for t in TIMES], "the rows' times begin at 3.7 s"),
        (np.float32(1.7e9 + TIMES), "'timestamp' stands still"),
        (np.full(COUNT, np.nan), "'timestamp' stands still or is no number"),
        (None, "'timestamp' is missing: the times are frame_index divided by 10 Hz"),
    ):
        write_set(tmp_path, columns={"timestamp": stamps})
        warnings = check(tmp_path).warnings
        assert text in "\n".join(warnings)
        assert bool(text) == bool(warnings)
    write_set(tmp_path, columns={"timestamp": None}, info={"fps": None})
    with pytest.raises(SceneError, match=r"'timestamp' is missing, and meta/info.json has no fps"):
        open_episode(tmp_path)
    # A row that follows the first picture keeps its time.
    columns = {"timestamp": TIMES + 0.2}
    write_set(tmp_path, columns=columns, numbers=range(COUNT + 2))
    np.testing.assert_allclose(open_episode(tmp_path).joints.times, TIMES + 0.2)


def entries(*names):
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


@pytest.mark.parametrize(
    ("features", "expected"),
    [
        ({"state": ["a", "b"]}, ("a", "b")),
        ({"observation.joint_positions": None}, ("joint_positions_0", "joint_positions_1")),
        ({"observation.state": ["a", "b"], "observation.joint_position": ["c", "d"]}, ("a", "b")),
        ({"observation.state": ["x", "y"], "observation.joint_position": ["c", "d"]}, ("c", "d")),
        ({"state": ["state"], "observation.states.joint_state": ["c", "d"]}, ("c", "d")),
        ({"state": ["a", "b"], "observation.state": ["c", "d"]}, ("c", "d")),
        ({"observation.state.a": ["a", "b"], "qpos": ["c", "d"]}, ("a", "b")),
        ({f"{STATE_OF}.joint_position": ["c", "d"], f"{STATE_OF}.velocity": None}, ("c", "d")),
        (
            {"observation.left.joint_pos": ["c", "d"], "observation.right.joint_pos": ["c", "d"]},
            ("left.joint_pos.c", "left.joint_pos.d", "right.joint_pos.c", "right.joint_pos.d"),
        ),
        ({"observation/joint_position": ["a", "b"], "observation/joint_torque": None}, ("a", "b")),
        ({"action": ["a", "b"], "observation.velocity": ["a", "b"]}, None),
    ],
)
def test_joint_positions_have_many_names(tmp_path, features, expected):
    declared = {key: entries(*(names or ["?", "?"])) for key, names in features.items()}
    declared |= {key: {**declared[key], "names": None} for key, one in features.items() if not one}
    declared["state"] = {**declared["state"], "shape": [2]} if "state" in declared else STATE
    if "state" not in features:
        del declared["state"]
    columns = {"observation.state": None} | {key: STATES for key in features}
    write_set(tmp_path, features={**declared, TOP: MEDIA["video"]}, columns=columns)
    if expected:
        assert check(tmp_path).joints.names == expected
        return
    episode = open_episode(tmp_path)
    assert episode.joints is None
    for text in ("has no joint positions", "action (float32 [2])", "observation.velocity", TOP):
        assert text in episode.warnings[-1]
    assert "'action' is not used: it holds what was commanded" in episode.warnings[-1]


def rows(name, values):
    """Return the change of a column."""
    return {"columns": {name: values}}


def images(cell=None):
    """Return the change of the camera into one of image files, and of its column's cells."""
    columns = {} if cell is None else rows(TOP, [cell] * COUNT)
    return {"features": {TOP: MEDIA["image"]}} | columns


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (rows(INDEX, [4] * COUNT), "episode_index is 4, not 0; all its rows"),
        (rows(INDEX, [4] * 5 + [5] * 5), "is empty: it has no row of episode 0.* has 4, 5"),
        (rows(TIME_OF, ["now"] * COUNT), "'timestamp' holds string, but numbers"),
        (rows(STATE_OF, [[1.0, 2.0]] * 9 + [[1.0]]), "has 1 numbers in row 9"),
        (rows(STATE_OF, [None, *STATES[1:]]), "'pan' is not a number in 1 of"),
        (rows(STATE_OF, None), "has no joint positions.* the data set has"),
        (rows(TIME_OF, TIMES[::-1]), "rows: number 1 .* runs backwards"),
        ({"numbers": range(5)}, "has 5 pictures for 10 rows"),
        ({"features": {STATE_OF: STATE}}, r"no feature of colour pictures.*observation.st"),
        ({"info": {"features": None}}, r"info\.json: has no 'features'.* it has: codebase_version"),
        ({"version": "v3.0"}, ""),
        ({"paths": {"data_path": r"data\c-{chunk}\a.parquet"}, "data": "data/c-0/a.parquet"}, ""),
        ({"features": {STATE_OF: {**STATE, "shape": 2}, TOP: MEDIA["video"]}}, ""),
        (rows(INDEX, [[0]] * COUNT), ""),
        (rows(INDEX, [[3]] * COUNT), "episode_index is 3, not 0"),
        ({"info": {"total_episodes": None}}, ""),
        ({"info": {"total_episodes": "many"}}, r"info\.json: total_episodes must be a number, not"),
        (rows(TIME_OF, range(COUNT)), "'timestamp' counts rows and is divided by 10"),
        ({"info": {"codebase_version": "v1.6"}}, r"version v1\.6, but only 2\.0, 2\.1 and 3\.0"),
        *(
            ({"paths": {key: name}}, rf"info\.json: {key}: '.*' leads out of .*, and no other")
            for key in ("data_path", "video_path")
            for name in ("../a.mp4", "videos/../../a.mp4", r"..\a.mp4", "/tmp/a.mp4")
        ),
        (images("../a.png"), r"'observation.images.top', row 0: '\.\./a\.png' leads out of"),
        (images(__file__), "row 0: no such image file; tried"),
        ({"data": "data/elsewhere.parquet"}, r"present: none; expected, for one, .*e_000000.parq"),
        ({"video": None}, "camera 'top' is left out: .*mp4 is missing"),
        (images(), "no such image file; tried"),
        (images(3.0), "'observation.images.top', row 0: holds double, but an image file, its path"),
    ],
)
def test_careless_data_sets_are_read_or_named(tmp_path, change, message):
    write_set(tmp_path, **change)
    try:
        texts = "\n".join(open_episode(tmp_path).warnings)
    except DrakePoseError as error:
        texts = str(error)
        assert message
    assert re.search(message, texts), texts
    assert bool(message) == bool(texts)


TABLE, FILM = "data/chunk-000/episode_000000.parquet", f"videos/chunk-000/{TOP}/episode_000000.mp4"


@pytest.mark.parametrize("name", [TABLE, "meta/info.json", FILM])
def test_truncated_files_are_named(tmp_path, name):
    write_set(tmp_path)
    (tmp_path / "meta/episodes.jsonl").write_text('{"episode_index": 0}\n')
    path = tmp_path / name
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(SceneError, match=f"{path.name}: "):
        open_episode(tmp_path)
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    with pytest.raises(SceneError, match=r"no JSON|it is a pointer of Git LFS: git lfs pull fetc"):
        open_episode(tmp_path)
    shutil.rmtree(tmp_path / "meta")
    with pytest.raises(SceneError, match=r"LeRobot data set, but no meta/info\.json"):
        open_episode(tmp_path)


LENGTHS, WRIST = {0: 8, 1: 6, 2: 9}, "observation.images.wrist"


def write_shared_files(folder):
    """Write a data set of version 3: three episodes in one video and two tables."""
    names = {"motors": ["pan", "lift", "grip"]}
    features = {
        STATE_OF: {"dtype": "float32", "shape": [3], "names": names},
        TOP: {"dtype": "video", "info": {"video.is_depth_map": False}}, WRIST: {"dtype": "image"},
        "observation.images.depth": {"dtype": "video", "info": {"video.is_depth_map": True}},
    }  # fmt: skip
    numbers = [20 * n + k for n, count in LENGTHS.items() for k in range(count)]
    for file, own in enumerate(([0, 1], [2])):
        pairs = [(n, k) for n in own for k in range(LENGTHS[n])]
        columns = {
            STATE_OF: [[0.1 * k, -1.0, 10.0 * n] for n, k in pairs], "frame_index": None,
            WRIST: [{"bytes": png(50 + k), "path": None} for _, k in pairs],
            TIME_OF: [0.1 * k for _, k in pairs], INDEX: [n for n, _ in pairs],
        }  # fmt: skip
        if file == 0:
            write_set(
                folder, version="v3.0", features=features, columns=columns, numbers=numbers,
                data=f"data/{V3.format(chunk_index=0, file_index=0)}.parquet", episode=2,
                video=f"videos/{TOP}/chunk-000/file-000.mp4",
            )  # fmt: skip
        else:
            del columns["frame_index"]
            write_table(folder / "data/chunk-000/file-001.parquet", columns)
    # LeRobot sums rounded durations.
    begin = np.cumsum([0, *LENGTHS.values()]) * 0.1 + 1e-7
    meta = {"chunk_index": [0] * 3, "file_index": [0] * 3}
    meta |= {"from_timestamp": begin[:-1], "to_timestamp": begin[1:]}
    table = {INDEX: [0, 1, 2], "data/chunk_index": [0] * 3, "data/file_index": [0, 0, 1]}
    table |= {f"videos/{TOP}/{name}": values for name, values in meta.items()}
    write_table(folder / "meta/episodes/chunk-000/file-000.parquet", table)


def test_episodes_have_their_own_images_and_rows(tmp_path):
    write_shared_files(tmp_path)
    for n, count in LENGTHS.items():
        episode = open_episode(tmp_path, episode=n)
        assert (list(episode.cameras), episode.warnings) == (["top", "wrist"], ())
        top, wrist, joints = episode.camera("top"), episode.camera("wrist"), episode.joints
        for k in (count - 1, *range(count)):
            assert (number_of(top.read(k)), number_of(wrist.read(k))) == (20 * n + k, 50 + k)
        for times in (top.times, wrist.times, joints.times, joints.positions[:, 0]):
            np.testing.assert_allclose(times, 0.1 * np.arange(count), atol=1e-6)
        assert joints.names == ("pan", "lift", "grip")
        assert (joints.positions[:, 2] == 10.0 * n).all()
    with pytest.raises(UnknownNameError, match="has no episode '3'; it has: 0, 1, 2"):
        open_episode(tmp_path, episode=3)
    with pytest.raises(SceneError, match=r"--episode N\); of 3 these are present: 0, 1, 2"):
        open_episode(tmp_path)


def test_a_real_data_set_is_read(shared_data):
    folder = shared_data / "humanoid_head_camera"
    for n, count in ((10, 290), (20, 297)):
        episode = open_episode(folder, episode=n)
        one, joints = episode.camera("cam_high"), episode.joints
        assert (one.width, one.height, len(one.times), episode.warnings) == (640, 480, count, ())
        assert (len(joints.names), joints.names[3]) == (26, "kLeftElbow")
        assert np.abs(joints.times - one.times).max() < 1e-5
        np.testing.assert_array_equal(one.read(200), [one.read(k) for k in (199, 200)][1])
    with pytest.raises(SceneError, match="of 100 these are present: 10, 20"):
        open_episode(folder)


@pytest.mark.parametrize("stretch", [0.5, 0.75, 1.3, 2.0])
def test_times_at_another_rate_are_used_and_told(stretch):
    times, warnings = stretch * (3.0 + 0.1 * np.arange(9)), []
    found = row_times(pyarrow.table({"timestamp": times}), 10.0, "a.parquet", warnings)
    np.testing.assert_allclose(found, times)
    (text,) = warnings
    assert f"the rows' times are {0.1 * stretch:.4g} s apart, but at 10 Hz" in text
    assert "would be 0.1 s" in text


def test_colour_images_are_told_from_depth_and_numbers():
    depth, colour = ({"info": {"video.is_depth_map": is_depth}} for is_depth in (True, False))
    for key, kind, shape, more, found in (
        ("image", "image", [4, 4, 3], {}, True), ("top", "video", [4, 4, 3], {}, True),
        ("top", "uint8", [4, 4, 3], {}, True), ("top", "uint8", [3, 4, 4], {}, True),
        ("depth", "uint16", [4, 4, 1], {}, False), ("depth", "uint16", [1, 4, 4], {}, False),
        ("top", "video", [4, 4, 3], depth, False), ("top", "video", [4, 4, 3], colour, True),
        ("state", "float32", [7], {}, False),
    ):  # fmt: skip
        assert is_picture(key, {"dtype": kind, "shape": shape, **more}) == found
