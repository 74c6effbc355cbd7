"""Bad input on the command line: a message that names the culprit, exit status, no traceback."""

import json
import os
import re
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from drake_pose.commands.main import app
from tests.cli import CliRunner, Result
from tests.jobs.scenes import NAMES, URDF, TinyScene, read_rows

Spoil = Callable[[TinyScene], None]


def run(runner: CliRunner, scene: TinyScene, *more: str, model: Path | None = None) -> Result:
    given = ["--model", str(model or scene.model), "--interval", "20", "--frame", "0"]
    out = scene.folder.parent / "out"
    return runner.invoke(
        app, ["estimate", str(scene.folder), "--out", str(out), *given, "--no-replay", *more]
    )


def assert_refused(result: Result, *parts: str, status: int = 1) -> None:
    assert result.exit_code == status, result.output
    message = " ".join(result.stderr.split())
    for part in parts:
        assert part in message
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert "drake-pose: error: " in message


def edit_camera(scene: TinyScene, **fields: object) -> None:
    path = scene.folder / "cameras.yaml"
    cameras = yaml.safe_load(path.read_text())
    cameras["front"].update(fields)
    path.write_text(yaml.safe_dump(cameras))


def mask_path(scene: TinyScene) -> Path:
    return scene.folder / "masks" / "front" / "0000.png"


def write_picture(scene: TinyScene, picture: np.ndarray) -> None:
    cv2.imwrite(str(mask_path(scene)), picture)


def pose(*position: float) -> list[list[float]]:
    """The front camera's pose at another place."""
    x, y, z = position
    return [[0.0, 0.0, -1.0, x], [1.0, 0.0, 0.0, y], [0.0, -1.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]]


def grey() -> np.ndarray:
    picture = np.zeros((160, 200), np.uint8)
    picture[40:80] = 255
    picture[80:90] = 128
    return picture


SPOILT_SCENES: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "no folder": (lambda s: shutil.rmtree(s.folder), ("scene", "no such folder")),
    "no cameras": (lambda s: (s.folder / "cameras.yaml").unlink(), ("cameras.yaml",)),
    "cameras are not YAML": (
        lambda s: (s.folder / "cameras.yaml").write_text("{"),
        ("cameras.yaml", "not a YAML file"),
    ),
    "focal length missing": (
        lambda s: edit_camera(s, focal_x=None),
        ("camera 'front'", "focal_x"),
    ),
    "no rotation": (
        lambda s: edit_camera(s, X_WC=(2.0 * np.array(pose(3, 0, 0))).tolist()),
        ("camera 'front'", "X_WC"),
    ),
    "stretched": (
        lambda s: edit_camera(s, X_WC=(np.array(pose(3, 0, 0)) * [2, 1, 1, 1]).tolist()),
        ("camera 'front'", "not a rotation"),
    ),
    "mirrored": (
        lambda s: edit_camera(s, X_WC=(np.array(pose(3, 0, 0)) * [-1, 1, 1, 1]).tolist()),
        ("camera 'front'", "reflection"),
    ),
    "camera before the body": (
        lambda s: edit_camera(s, X_WC=pose(-3, 0, 0.3)),
        ("camera 'front'", "behind"),
    ),
    "camera inside the body": (
        lambda s: edit_camera(s, X_WC=pose(0, 0, 0)),
        ("camera 'front'", "inside the body"),
    ),
    "far too long a lens": (
        lambda s: edit_camera(s, focal_x=1e5, focal_y=1e5),
        ("camera 'front'", "larger than the picture", "focal length"),
    ),
    "no lens at all": (
        lambda s: edit_camera(s, focal_x=1e12, focal_y=1e12),
        ("camera 'front'", "larger than the picture"),
    ),
    "no masks": (lambda s: shutil.rmtree(s.folder / "masks"), ("masks",)),
    "mask is no picture": (
        lambda s: mask_path(s).write_text("PNG"),
        ("0000.png", "not a PNG"),
    ),
    "mask of the wrong size": (
        lambda s: write_picture(s, grey()[:, :100]),
        ("0000.png", "100 x 160", "200 x 160"),
    ),
    "empty mask": (lambda s: write_picture(s, 0 * grey()), ("0000.png", "empty")),
    "full mask": (lambda s: write_picture(s, 0 * grey() + 255), ("0000.png", "full")),
    "grey mask": (lambda s: write_picture(s, grey()), ("0000.png", "3 values")),
    "scene.yaml": (
        lambda s: (s.folder / "scene.yaml").write_text("sequence: 3"),
        ("scene.yaml", "sequence"),
    ),
}


@pytest.mark.parametrize("name", SPOILT_SCENES)
def test_scene(name: str, own_scene: TinyScene, runner: CliRunner) -> None:
    spoil, parts = SPOILT_SCENES[name]
    spoil(own_scene)
    assert_refused(run(runner, own_scene), *parts)
    assert not (own_scene.folder.parent / "out").exists()


def replace_by_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def replace_by_device(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")  # Reading it never ends.


def replace_by_socket(path: Path) -> None:
    path.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX) as listener:
        here = os.open(path.parent, os.O_RDONLY)
        try:  # A socket's path must be short.
            listener.bind(f"/proc/self/fd/{here}/{path.name}")
        finally:
            os.close(here)


def replace_by_folder(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.mkdir()


NO_FILES = {
    "named pipe": replace_by_pipe,
    "device": replace_by_device,
    "socket": replace_by_socket,
    "folder": replace_by_folder,
}


@pytest.mark.parametrize("place", ["masks/front/0000.png", "cameras.yaml", "joint_angles.csv"])
@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_file_is_never_opened(
    kind: str, place: str, own_scene: TinyScene, runner: CliRunner
) -> None:
    for mask in own_scene.folder.glob("masks/*/*.png"):
        if mask.name != "0000.png":
            mask.unlink()
    NO_FILES[kind](own_scene.folder / place)
    assert_refused(run(runner, own_scene), Path(place).name, kind)


def test_a_model_that_is_no_file_is_never_opened(
    own_scene: TinyScene, runner: CliRunner, tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "pipe.urdf")
    assert_refused(run(runner, own_scene, model=tmp_path / "pipe.urdf"), "pipe.urdf", "not a file")


SPOILT_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "not XML": ("<robot", ()),
    "nothing to see": (
        URDF.replace("<visual>", "<!--").replace("</visual>", "-->"),
        ("no visual geometry",),
    ),
    "mesh missing": (
        URDF.replace('<box size="0.1 0.08 0.4"/>', '<mesh filename="jib.obj"/>'),
        ("jib.obj",),
    ),
    "NaN limit": (URDF.replace('lower="-1.6"', 'lower="nan"'), ("joint 'lift'",)),
    "crossed limits": (URDF.replace('lower="-1.6"', 'lower="1.7"'), ("joint 'lift'", "1.7")),
    "no limit": (
        re.sub(r'(?s)("luff" type=)"revolute"(.*?)<limit[^>]*>', r'\1"prismatic"\2', URDF),
        ("joint 'luff'", "no limits", "--hold luff=VALUE"),
    ),
}


@pytest.mark.parametrize("name", SPOILT_MODELS)
def test_model(name: str, own_scene: TinyScene, runner: CliRunner, tmp_path: Path) -> None:
    text, parts = SPOILT_MODELS[name]
    path = tmp_path / "spoilt.urdf"
    path.write_text(text)
    assert_refused(run(runner, own_scene, model=path), "spoilt.urdf", *parts)
    checked = runner.invoke(app, ["check", str(path)])
    assert_refused(checked, "spoilt.urdf", *parts)


def test_damaged_mesh(own_scene: TinyScene, runner: CliRunner, tmp_path: Path) -> None:
    (tmp_path / "jib.obj").write_text("v 0 0 zero\n")
    path = tmp_path / "spoilt.urdf"
    path.write_text(URDF.replace('<box size="0.1 0.08 0.4"/>', '<mesh filename="jib.obj"/>'))
    assert_refused(run(runner, own_scene, model=path), "jib.obj")


@pytest.mark.parametrize("name", ["nowhere.urdf", "folder.urdf", "model.step"])
def test_model_file(name: str, own_scene: TinyScene, runner: CliRunner, tmp_path: Path) -> None:
    (tmp_path / "folder.urdf").mkdir()
    (tmp_path / "model.step").write_text("solid")
    assert_refused(run(runner, own_scene, model=tmp_path / name), name)


BAD_NAMES = {
    "link": (["--root", "hook"], ("'hook'", "base, boom, jib")),
    "held joint": (["--hold", "swing=3"], ("'swing'", "lift, luff")),
    "sampled joint": (["--joint-interval", "swing=3"], ("'swing'", "lift, luff")),
    "camera": (["--camera", "back"], ("'back'", "front")),
    "frame": (["--frame", "7"], ("'7'", "0000, 0001, 0002")),
    "joint centre": (["--root", "jib", "--root-position", "{0}:toe"], ("'toe'", "hook")),
    "joint centres": (["--root-position", "nowhere.csv:toe"], ("nowhere.csv",)),
    "frame of a centre": (
        ["--root", "jib", "--root-position", "{0}:hook", "--frame", "2"],
        ("centres.csv", "'0002'"),
    ),
    "truth": (["--truth", "nowhere.csv"], ("nowhere.csv",)),
    "truth of another model": (["--truth", "{0}"], ("'joint'", "lift, luff")),
}


@pytest.mark.parametrize("name", BAD_NAMES)
def test_names(name: str, own_scene: TinyScene, runner: CliRunner) -> None:
    options, parts = BAD_NAMES[name]
    centres = own_scene.folder / "centres.csv"
    centres.write_text("frame,joint,x,y,z\n0,hook,0,0,1\n1,hook,0,0,1\n")
    more = [option.format(centres) for option in options]
    assert_refused(run(runner, own_scene, *more), *parts)


BAD_VALUES = {
    "root position": (["--root-position", "1,2"], "--root-position", 2),
    "root rotation": (["--root-rotation", "upright"], "--root-rotation", 2),
    "hold": (["--hold", "lift"], "--hold", 2),
    "joint interval": (["--joint-interval", "lift=ten"], "--joint-interval", 2),
    "method": (["--method", "magic"], "magic", 2),
    "candidates": (["--candidates", "many"], "--candidates", 2),
    "unknown option": (["--speed", "3"], "--speed", 2),
    "root without a position": (["--root", "jib"], "root 'jib'", 1),
    "interval": (["--interval", "0"], "interval", 1),
    "interval NaN": (["--interval", "nan"], "interval", 1),
    "outside limit": (["--method", "paper", "--outside-limit", "-1"], "outside_limit", 1),
    "outside limit of the other method": (["--outside-limit", "9"], "outside limit", 2),
    "no candidates": (["--method", "paper", "--candidates", "0"], "candidates", 2),
    "no runs": (["--method", "paper", "--run-limit", "0"], "run_limit", 2),
    "angles": (["--angles", "round"], "angles", 2),
    "time limit of the other method": (["--method", "paper", "--time-limit", "9"], "time limit", 2),
    "negative time": (["--time-limit", "-1"], "time_limit", 2),
}


@pytest.mark.parametrize("name", BAD_VALUES)
def test_values(name: str, own_scene: TinyScene, runner: CliRunner) -> None:
    options, part, status = BAD_VALUES[name]
    assert_refused(run(runner, own_scene, *options), part, status=status)


def test_rotation_without_a_root(own_scene: TinyScene, runner: CliRunner, tmp_path: Path) -> None:
    path = tmp_path / "swivel.urdf"
    limits = '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    bolt = '<joint name="bolt" type="fixed"><parent link="world"/><child link="base"/>'
    path.write_text(URDF.replace(bolt + "</joint>", bolt.replace("fixed", "revolute") + limits))
    result = run(runner, own_scene, "--root-rotation", "free", model=path)
    assert_refused(result, "swivel.urdf", "base, boom, jib")


def test_missing_options_are_usage_errors(runner: CliRunner) -> None:
    assert_refused(runner.invoke(app, ["estimate", "scene"]), "--model", status=2)
    assert_refused(runner.invoke(app, ["judge"]), "judge", status=2)


def test_output_folder_that_exists(own_scene: TinyScene, runner: CliRunner) -> None:
    out = own_scene.folder.parent / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    assert_refused(run(runner, own_scene), str(out), "--resume")
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
    assert_refused(run(runner, own_scene, "--resume"), "summary.json")


def test_output_in_the_place_of_a_file(own_scene: TinyScene, runner: CliRunner) -> None:
    (own_scene.folder.parent / "out").write_text("mine")
    assert_refused(run(runner, own_scene), "out", "is a file")


def test_output_below_a_file(own_scene: TinyScene, runner: CliRunner) -> None:
    file = own_scene.folder.parent / "file"
    file.write_text("mine")
    assert_refused(run(runner, own_scene, "--out", str(file / "out")), "is a file")


@pytest.mark.slow
def test_resuming_another_job(own_scene: TinyScene, runner: CliRunner, tmp_path: Path) -> None:
    assert run(runner, own_scene).exit_code == 0
    assert_refused(run(runner, own_scene, "--resume", "--candidates", "4"), "candidates", "5")
    other = tmp_path / "other.urdf"
    other.write_text(URDF.replace("0.1 0.12 0.5", "0.1 0.13 0.5"))
    assert_refused(run(runner, own_scene, "--resume", model=other), "model")


def test_drakes_exit_becomes_a_message(
    own_scene: TinyScene, runner: CliRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise SystemExit("condition 'q.size() == 7' failed")

    monkeypatch.setattr("drake_pose.jobs.estimate.scene.read_inputs", fail)
    assert_refused(run(runner, own_scene), "q.size() == 7")


def test_ctrl_c_says_how_to_go_on(
    own_scene: TinyScene, runner: CliRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("drake_pose.jobs.estimate.scene.read_inputs", interrupt)
    assert_refused(run(runner, own_scene), "interrupted before anything was written")
    (own_scene.folder.parent / "out").mkdir()
    assert_refused(run(runner, own_scene), "interrupted", "out", "--resume")


def test_any_other_error_is_a_bug_and_stays_visible(
    own_scene: TinyScene, runner: CliRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("drake_pose.jobs.estimate.scene.read_inputs", fail)
    with pytest.raises(ZeroDivisionError):
        run(runner, own_scene)


@pytest.mark.slow
def test_a_mask_that_no_pose_explains(own_scene: TinyScene, runner: CliRunner) -> None:
    picture = np.zeros((160, 200), np.uint8)
    picture[:6] = 255
    write_picture(own_scene, picture)
    result = run(runner, own_scene)
    assert result.exit_code == 0, result.output
    assert "frame '0000': no pose explains the silhouettes" in result.stderr
    summary = json.loads((own_scene.folder.parent / "out" / "summary.json").read_text())
    assert summary["frames"]["0000"]["explained"] is False
    assert summary["frames"]["0000"]["E_total"] > 0.5


def test_no_time(own_scene: TinyScene, runner: CliRunner) -> None:
    result = run(runner, own_scene, "--time-limit", "0")
    assert result.exit_code == 0, result.output
    assert "stopped by the time limit" in result.stderr


def test_salt_noise(own_scene: TinyScene, runner: CliRunner) -> None:
    picture = cv2.imread(str(mask_path(own_scene)), cv2.IMREAD_GRAYSCALE)
    picture[np.random.default_rng(6).random(picture.shape) < 0.1] = 255
    write_picture(own_scene, picture)
    result = run(runner, own_scene)
    assert result.exit_code == 0, result.output
    (row,) = read_rows(own_scene.folder.parent / "out" / "poses.csv")
    found = [float(row[name]) for name in NAMES]
    np.testing.assert_allclose(found, own_scene.truth["0000"], atol=np.radians(5.0))
