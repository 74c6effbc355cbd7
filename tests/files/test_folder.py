import inspect
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drake_pose import audit_scene, estimate_scene, make_masks, register_scene
from drake_pose.errors import OutputError, SceneError
from drake_pose.files.folder import claimed, read_summary, write_file, write_summary, writes_folder
from drake_pose.jobs.batch import run_batch
from drake_pose.jobs.live import capture_live


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

    with pytest.raises(OutputError, match="not empty"):
        writes_folder(lambda out: None)(out=tmp_path)


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
            given = dict.fromkeys(inspect.signature(job).parameters) | {"out": place}
            with pytest.raises(OutputError, match="another run is writing its result there"):
                job(**(given | {"resume": True} if "resume" in given else given))
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


def test_a_damaged_summary_is_named(tmp_path):
    for text in ("", "{", "[]"):
        with pytest.raises(OutputError, match=r"summary\.json"):
            read_summary(tmp_path)
        (tmp_path / "summary.json").write_text(text)
