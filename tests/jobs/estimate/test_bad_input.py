"""Bad input on the command line: one message with the cause, an exit status, no traceback."""

import os
import re
import shutil
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli import Result, assert_refused, run_command
from tests.jobs.scenes import URDF, TinyScene, edit_camera


def run(scene: TinyScene, *more: str, model: Path | None = None) -> Result:
    words = replace(scene, model=model or scene.model).estimate(scene.folder.parent / "out")
    return run_command([*words, "--frame", "0", "--no-replay", *more])


FRONT = np.array([[0.0, 0.0, -1.0, 3.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0, 0, 0, 1]])
GREY = np.zeros((160, 200), np.uint8)
GREY[40:80], GREY[80:90] = 255, 128


def camera(**fields: object) -> Callable[[Path], object]:
    """Change fields of the front camera."""
    return lambda folder: edit_camera(folder / "cameras.yaml", "front", **fields)


def placed(*place: float) -> Callable[[Path], object]:
    """Move the front camera."""
    X_WC = FRONT.copy()
    X_WC[:3, 3] = place
    return camera(X_WC=X_WC.tolist())


def mask(picture: np.ndarray) -> Callable[[Path], object]:
    """Replace the first mask."""
    data = cv2.imencode(".png", picture)[1].tobytes()
    return lambda folder: (folder / "masks" / "front" / "0000.png").write_bytes(data)


def file(name: str, text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(text)


SPOILT_SCENES = [
    (shutil.rmtree, ("scene", "no such folder")),
    (lambda folder: (folder / "cameras.yaml").unlink(), ("cameras.yaml",)),
    (camera(X_WC=(FRONT * [2, 1, 1, 1]).tolist()), ("camera 'front'", "not a rotation")),
    (placed(-3, 0, 0.3), ("camera 'front'", "behind")),
    (placed(0, 0, 0), ("camera 'front'", "inside the body")),
    (camera(focal_x=1e5, focal_y=1e5), ("camera 'front'", "larger than the", "focal length")),
    (camera(focal_x=1e12, focal_y=1e12), ("camera 'front'", "larger than the picture")),
    (lambda folder: shutil.rmtree(folder / "masks"), ("masks",)),
    (mask(GREY[:, :100]), ("0000.png", "100 x 160", "200 x 160")),
    (mask(GREY), ("0000.png", "3 values")),
    (file("scene.yaml", "sequence: 3"), ("scene.yaml", "sequence")),
    (file("scene.yaml", 'sequence: "\\0"'), ("scene.yaml", "NUL")),
    (lambda folder: (folder / "scene.yaml").symlink_to("gone"), ("scene.yaml", "No such file")),
    (
        lambda folder: (folder / "masks/front" / os.fsdecode(b"\xfc.png")).touch(),
        ("masks/front", r"'\udcfc.png' is not UTF-8 text"),
    ),
    (file("joint_angles.csv", "frame,lift\n0,1e308\n"), ("'lift', frame 0", "no joint position")),
]


@pytest.mark.parametrize(("spoil", "parts"), SPOILT_SCENES)
def test_scene(spoil, parts, own_scene):
    spoil(own_scene.folder)
    assert_refused(run(own_scene), *parts)
    assert not (own_scene.folder.parent / "out").exists()


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        here = os.open(path.parent, os.O_RDONLY)
        try:  # A socket's path must be short.
            listener.bind(f"/proc/self/fd/{here}/{path.name}")
        finally:
            os.close(here)


NO_FILES = {
    "named pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),  # An endless file.
    "socket": make_socket,
    "folder": Path.mkdir,
}


@pytest.mark.parametrize("place", ["masks/front/0000.png", "cameras.yaml", "joint_angles.csv"])
@pytest.mark.parametrize("kind", NO_FILES)
def test_devices_and_sockets_are_never_opened(kind, place, own_scene):
    for other in own_scene.folder.glob("masks/*/000[12].png"):
        other.unlink()
    path = own_scene.folder / place
    path.unlink(missing_ok=True)
    NO_FILES[kind](path)
    assert_refused(run(own_scene), path.name, kind)


MESH = URDF.replace('<box size="0.1 0.08 0.4"/>', '<mesh filename="jib.obj"/>')
SPOILT_MODELS = [
    ("<robot", ("spoilt.urdf",)),
    (MESH, ("spoilt.urdf", "jib.obj")),
    (URDF.replace('lower="-1.6"', 'lower="1.7"'), ("spoilt.urdf", "joint 'lift'", "1.7")),
    (
        re.sub(r'(?s)("luff" type=)"revolute"(.*?)<limit[^>]*>', r'\1"prismatic"\2', URDF),
        ("spoilt.urdf", "joint 'luff'", "no limits", "--hold luff=VALUE"),
    ),
]


@pytest.mark.parametrize(("text", "parts"), SPOILT_MODELS)
def test_model(text, parts, own_scene, tmp_path):
    path = tmp_path / "spoilt.urdf"
    path.write_text(text)
    assert_refused(run(own_scene, model=path), *parts)
    assert_refused(run_command(["check", str(path)]), *parts)
    if text == MESH:
        (tmp_path / "jib.obj").write_text("v 0 0 zero\n")
        assert_refused(run(own_scene, model=path), "jib.obj")


def test_model_file(own_scene, tmp_path):
    (tmp_path / "folder.urdf").mkdir()
    (tmp_path / "model.step").write_text("solid")
    os.mkfifo(tmp_path / "pipe.urdf")
    for name in ("nowhere.urdf", "folder.urdf", "model.step", "pipe.urdf"):
        assert_refused(run(own_scene, model=tmp_path / name), name)


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ("--root hook", ("'hook'", "base, boom, jib")),
        ("--hold swing=3", ("'swing'", "lift, luff")),
        ("--camera back", ("'back'", "front")),
        ("--frame 7", ("'7'", "0000, 0001, 0002")),
        ("--root jib --root-position {0}:toe", ("'toe'", "hook")),
        ("--root-position nowhere.csv:toe", ("nowhere.csv",)),
        ("--root jib --root-position {0}:hook --frame 2", ("centres.csv", "'0002'")),
        ("--truth nowhere.csv", ("nowhere.csv",)),
        ("--truth {0}", ("'joint'", "not a number")),
        ("--root jib", ("root 'jib'",)),
        # Wrong usage: parts of the message.
        ("--root-position 1,2", "--root-position"),
        ("--root-rotation upright", "--root-rotation"),
        ("--hold lift", "--hold"),
        ("--method magic", "magic"),
        ("--speed 3", "--speed"),
        ("--every many", "--every"),
    ],
)
def test_unknown_names_and_wrong_usage_are_refused(options, parts, own_scene):
    centres = own_scene.folder / "centres.csv"
    centres.write_text("frame,joint,x,y,z\n0,hook,0,0,1\n1,hook,0,0,1\n")
    is_usage = isinstance(parts, str)
    done = run(own_scene, *options.format(centres).split())
    assert_refused(done, *([parts] if is_usage else parts), status=1 + is_usage)


def test_rotation_without_a_root(own_scene, tmp_path):
    path = tmp_path / "swivel.urdf"
    limits = '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    bolt = '<joint name="bolt" type="fixed"><parent link="world"/><child link="base"/>'
    path.write_text(URDF.replace(bolt + "</joint>", bolt.replace("fixed", "revolute") + limits))
    result = run(own_scene, "--root-rotation", "free", model=path)
    assert_refused(result, "swivel.urdf", "base, boom, jib")


def test_output_folder_with_other_files_is_refused(own_scene):
    out = own_scene.folder.parent / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    assert_refused(run(own_scene), str(out), "--resume")
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
    assert_refused(run(own_scene, "--resume"), "summary.json")
    below = str(out / "mine.txt" / "out")
    assert_refused(run(own_scene, "--out", below), "mine.txt", "is a file")


def test_expected_errors_are_one_line_and_bugs_keep_their_traceback(own_scene, monkeypatch):
    ends: list[BaseException] = []

    def fail(*_: object, **__: object) -> None:
        raise ends[-1]

    monkeypatch.setattr("drake_pose.jobs.estimate.scene.read_inputs", fail)
    ends.append(SystemExit("condition 'q.size() == 7' failed"))  # A failed DRAKE_DEMAND.
    assert_refused(run(own_scene), "q.size() == 7")
    ends.append(KeyboardInterrupt())
    assert_refused(run(own_scene), "interrupted before anything was written")
    (own_scene.folder.parent / "out").mkdir()
    assert_refused(run(own_scene), "interrupted", "out", "--resume")
    ends.append(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        run(own_scene)
