"""Warnings of Drake, and reading of files in a process that may crash, hang or take all memory."""

import json
import logging
import os
import time

import pytest
import trimesh

from drake_pose.body import captured_warnings, load_model, parsing
from drake_pose.errors import ModelError, weight_of, weighted
from tests.body.models import write
from tests.body.test_meshes import mesh_urdf


def test_drakes_warnings_are_collected_once_and_not_printed(caplog):
    with captured_warnings() as texts:
        for level in (logging.INFO, logging.WARNING, logging.ERROR, logging.WARNING):
            record = logging.makeLogRecord({"levelno": level, "msg": f" {level}\n"})
            logging.getLogger("drake").handle(record)
    assert texts == [str(logging.WARNING), str(logging.ERROR)]
    assert not caplog.records


def test_warnings_of_a_kind_are_counted_beyond_the_most():
    """A kind is what remains without quoted names and numbers."""
    loud = [f"joint 'j{k}' is {k / 2:.1e} m long" for k in range(5)]
    found = parsing.summarise_warnings([*loud[:2], weighted("other", "note"), *loud[2:]], 3)
    assert found == [*loud[:2], loud[2] + " ... and 2 more of this kind", "other"]
    assert [weight_of(one) for one in found[2:]] == [weight_of(loud[2]), "note"]
    assert parsing.summarise_warnings(loud, 5) == loud


def _raise(error):
    raise error


READERS = {
    "crash": (lambda *_: os.abort(), r"crashed Drake \(SIGABRT\)"),
    "words": (lambda *_: (os.write(2, b"one\ntwo\n"), os._exit(3)), r"failed \(two\)"),
    "refusal": (lambda *_: _raise(ModelError("link 'a' is odd")), "^link 'a' is odd$"),
    "drake": (lambda *_: _raise(RuntimeError("odd")), r"thing\.urdf: odd"),
    "memory": (lambda *_: bytearray(3 * 2**30), "more than 2 GiB"),
    "hang": (lambda *_: time.sleep(60.0), "more than 0.5 s"),
}


@pytest.fixture
def one_thread(monkeypatch):
    """Let a process fork that has threads, as those of pytest-xdist have."""
    listed = os.listdir
    monkeypatch.setattr(os, "listdir", lambda at=".": ["1"] if "task" in str(at) else listed(at))


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("kind", READERS)
def test_what_a_child_process_does_is_told(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(parsing, "TIME_LIMIT_SECONDS", 0.5 if kind == "hang" else 20.0)
    read, words = READERS[kind]
    with pytest.raises(ModelError, match=words):
        parsing.check_in_child(read, write(tmp_path, ""), {}, {})


@pytest.mark.usefixtures("one_thread")
def test_a_file_is_checked_once_for_each_content(tmp_path):
    def read(path, packages, limits):
        with (tmp_path / "calls").open("a") as file:
            file.write(json.dumps([path.read_text(), packages, limits]) + "\n")
        return load_model(bundled, check=False)

    bundled = parsing.Path(parsing.__file__).parents[2] / "urdf" / "hand" / "hand.urdf"
    for text in ("one", "one", "two"):
        parsing.check_in_child(read, write(tmp_path, text), {"p": "f"}, {"j": (0.0, 1.0)})
    calls = [json.loads(line) for line in (tmp_path / "calls").read_text().splitlines()]
    assert calls == [[text, {"p": "f"}, {"j": [0.0, 1.0]}] for text in ("one", "two")]
    with pytest.raises(ModelError, match="gone cannot be read"):
        parsing.check_in_child(read, tmp_path / "gone", {}, {})


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]\n" for level in range(1, 10)
)
LOOP = '<sdf version="1.9"><model name="m"><include><uri>package://mine/loop.sdf</uri></include>'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("loop.sdf", f"{LOOP}</model></sdf>"),
        ("bomb.dmd.yaml", BOMB + "directives: []\n"),
        ("thing.urdf", mesh_urdf("cube.gltf")),
    ],
    ids=["SDFormat", "aliases", "accessor out of bounds"],
)
def test_files_that_crash_drake_raise_model_error(tmp_path, name, text):
    trimesh.creation.box().export(tmp_path / "cube.gltf")
    document = json.loads((tmp_path / "cube.gltf").read_text())
    document["accessors"] = [one | {"count": 100_000_000} for one in document["accessors"]]
    (tmp_path / "cube.gltf").write_text(json.dumps(document))
    with pytest.raises(ModelError, match=name):
        load_model(write(tmp_path, text, name), package_paths={"mine": tmp_path})
