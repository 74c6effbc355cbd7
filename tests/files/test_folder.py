import inspect
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drake_pose import audit_scene, estimate_scene, make_masks, register_scene
from drake_pose.body import load_model
from drake_pose.errors import OutputError, SceneError, SettingsError
from drake_pose.files.folder import claimed, read_summary, write_file, write_summary, writes_folder
from drake_pose.files.records import FrameRecord, PoseTable, read_earlier_summary
from drake_pose.files.writer import ResultWriter
from drake_pose.jobs.batch import run_batch
from drake_pose.jobs.live import capture_live
from drake_pose.silhouette.pictures.scenes import load_scene

NAMES = ("a", "b")


def row(frame, *q, base=None, error=0.25):
    return FrameRecord(frame, np.array(q), base, error, 1.5)


LOST = row("0002", np.nan, np.nan, error=None)


def test_appended_rows_are_on_disk_and_read_back(tmp_path):
    base = np.array([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0])
    for with_base, cells in ((False, ""), (True, ",1,2,3,1,0,0,0")):
        table = PoseTable(tmp_path, NAMES, with_base)
        table.write([])
        table.append(row("0001", 0.5, -1.25, base=base))
        table.append(LOST)
        header, *lines = (tmp_path / "poses.csv").read_text().splitlines()
        assert header.split(",") == table.header
        assert lines == [
            f"0001,0.5,-1.25{cells},0.25,1.5000",
            f"0002,{',' * (2 + 7 * with_base)},1.5000",
        ]
        first, second = table.read()
        assert (first.base is not None and first.base.tolist() == base.tolist()) is with_base
        assert second.base is None
        assert (first.found, second.found) == (True, False)


def test_reading_drops_an_incomplete_last_row(tmp_path):
    table = PoseTable(tmp_path, NAMES, False)
    assert table.read() == []
    table.write([row("0001", 0.5, -1.25)])
    with (tmp_path / "poses.csv").open("a") as file:
        file.write("0002,0.5,")
    assert [one.frame for one in table.read()] == ["0001"]


def test_a_damaged_table_or_one_of_another_model_is_refused(tmp_path):
    for text, message in (
        ("frame,a,c,error,seconds\n", "another model"),
        ("frame,a,b,error,seconds\n1,2\n", "line 2 has 2 columns"),
        ("frame,a,b,error,seconds\n1,x,2,3,4\n", "line 2 is damaged"),
    ):
        (tmp_path / "poses.csv").write_text(text)
        with pytest.raises(OutputError, match=message):
            PoseTable(tmp_path, NAMES, False).read()


def test_a_folder_that_is_not_empty_or_cannot_exist_is_refused(tmp_path):
    (tmp_path / "out").write_text("mine")
    (tmp_path / "link").symlink_to("nowhere")
    for place, message in (
        (tmp_path, "not empty.*--resume"),
        (tmp_path / "out", "out: is a file"),
        (tmp_path / "out" / "deeper", "out: is a file"),
        (tmp_path / "link", "link: is a broken link"),
        (tmp_path / ("a" * 300), "aaa: cannot be written: File name too long"),
    ):
        with pytest.raises(OutputError, match=message), claimed(place):
            pass
    assert {path.name for path in tmp_path.iterdir()} == {"link", "out"}

    @writes_folder
    def job(out):
        """A job without resume."""

    with pytest.raises(OutputError, match="not empty"):
        job(out=tmp_path)


HOLD = """
import sys
from pathlib import Path
from drake_pose.files.folder import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_folder_is_locked_until_its_process_ends(tmp_path):
    place = tmp_path / "new" / "out"
    jobs = (estimate_scene, register_scene, audit_scene, make_masks, run_batch, capture_live)
    command = [sys.executable, "-c", HOLD, str(place)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        for job in jobs:
            given = dict.fromkeys(inspect.signature(job).parameters)
            for resume in (False, True):
                arguments = {**given, "out": place, "resume": resume}
                arguments = {name: value for name, value in arguments.items() if name in given}
                with pytest.raises(OutputError, match="another run is writing its result there"):
                    job(**arguments)
        other.kill()
    # No job wrote a file; the killed process left its empty folders.
    assert not list(place.iterdir())
    with claimed(place):
        pass
    shutil.rmtree(tmp_path / "new")
    with pytest.raises(SceneError), claimed(place):
        raise SceneError("nothing came of it")
    assert not list(tmp_path.iterdir())


def test_files_are_written_atomically(tmp_path, monkeypatch):
    write_file(tmp_path / "out", "overlay/cam/1.png", b"first")

    def full_disk(path, data):
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OutputError, match=r"1\.png.*No space left"):
        write_file(tmp_path / "out", "overlay/cam/1.png", b"second")
    assert (tmp_path / "out" / "overlay" / "cam" / "1.png").read_bytes() == b"first"
    assert [path.name for path in (tmp_path / "out" / "overlay" / "cam").iterdir()] == ["1.png"]


def test_summary_has_no_nan_and_a_line_for_each_frame(tmp_path):
    write_summary(tmp_path, {"a": float("nan"), "b": [np.float64(1.5), np.inf], "c": np.arange(2)})
    text = (tmp_path / "summary.json").read_text()
    assert json.loads(text) == {"a": None, "b": [1.5, None], "c": [0, 1]}
    assert read_summary(tmp_path) == json.loads(text)
    frames = {"0000": {"found": True, "joints": {"a\n": {"low": 1.0}}}, "0001": {}}
    told = {"frames": frames, "warnings": ["ä"], "settings": {}}
    write_summary(tmp_path, told)
    lines = (tmp_path / "summary.json").read_text().splitlines()
    assert read_summary(tmp_path) == told
    assert [line.split('"')[1] for line in lines if line.startswith("    ")] == ["0000", "0001"]


def test_only_the_same_job_is_resumed(tmp_path):
    settings = {"interval": 20.0, "frames": ["0000"]}
    job = {"sha256": {"model": "m", "cameras": "c"}, "settings": settings}
    assert read_earlier_summary(tmp_path, job, resume=False) is None
    with pytest.raises(SettingsError, match="needs the folder"):
        read_earlier_summary(None, job, resume=True)
    write_summary(tmp_path, job)
    other_frames = {"settings": settings | {"frames": []}}
    assert read_earlier_summary(tmp_path, job | other_frames, resume=True) == job
    for other, message in (
        ({"sha256": {"model": "m", "cameras": "d"}}, "with another cameras file"),
        ({"sha256": {"model": "n", "cameras": "c"}}, "with another model file"),
        ({"settings": settings | {"interval": 9.0}}, r"with interval = 20\.0, not 9\.0"),
    ):
        with pytest.raises(OutputError, match=message):
            read_earlier_summary(tmp_path, job | other, resume=True)


def begun(own_scene, out, **more):
    scene, model = load_scene(own_scene.folder), load_model(own_scene.model)
    made = ResultWriter(scene, model, {"scene": "s", "settings": {}}, out, **more)
    made.begin()
    return made


def test_finished_frames_with_changed_masks_are_estimated_again(own_scene, tmp_path):
    scene, out = load_scene(own_scene.folder), tmp_path / "out"

    def writer(**more):
        return begun(own_scene, out, **more)

    first = writer()
    for frame, q in own_scene.truth.items():
        first.add(FrameRecord(frame, q, None, 0.01, 1.0))
    first.write_summary()
    assert read_summary(out)["complete"] is False
    path = scene.masks["front", "0001"]
    path.write_bytes(path.read_bytes())
    again = writer(earlier=read_summary(out), frames=["0000"])
    assert (list(again.records), again.warnings) == (list(own_scene.truth), [])
    shutil.copy(scene.masks["front", "0000"], path)
    with pytest.raises(OutputError, match=r"frame 0001: the masks were replaced"):
        writer(earlier=read_summary(out), frames=["0000", "0002"])
    again = writer(earlier=read_summary(out), frames=["0001", "0002"])
    assert list(again.records) == ["0000", "0002"]
    assert again.warnings[0].startswith("frame 0001: estimated again")


@pytest.mark.parametrize("row_is_written", [False, True])
def test_ctrl_c_leaves_files_that_agree(own_scene, tmp_path, monkeypatch, row_is_written):
    """While a row is appended."""
    result = begun(own_scene, tmp_path)
    (first, q), (second, p), *_ = own_scene.truth.items()
    result.add(FrameRecord(first, q, None, 0.01, 1.0))
    append = PoseTable.append

    def interrupted(table, record):
        if row_is_written:
            append(table, record)
        raise KeyboardInterrupt

    monkeypatch.setattr(PoseTable, "append", interrupted)
    with pytest.raises(KeyboardInterrupt):
        result.add(FrameRecord(second, p, None, 0.01, 1.0))
    result.end()
    rows = (tmp_path / "poses.csv").read_text().splitlines()[1:]
    assert [one.split(",")[0] for one in rows] == list(read_summary(tmp_path)["frames"])
    assert [one.split(",")[0] for one in rows] == [first, second]


@pytest.mark.parametrize("text", [None, "{", "[]"])
def test_a_damaged_summary_is_named(tmp_path, text):
    if text is not None:
        (tmp_path / "summary.json").write_text(text)
    with pytest.raises(OutputError, match=r"summary\.json"):
        read_summary(tmp_path)
