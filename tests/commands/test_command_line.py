"""The command line: start, help, Ctrl-C, check."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.cli import run_command
from tests.jobs.scenes import TinyScene, read_rows, write_scene

PROGRAM = [sys.executable, "-m", "drake_pose.commands.main"]
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("commands.main", "numpy numba cv2 pydrake"),
        ("jobs.estimate.scene", "matplotlib trimesh scipy.optimize scipy.stats"),
        ("jobs.registration.register", "matplotlib trimesh scipy.optimize scipy.stats"),
    ],
)
def test_help_and_jobs_import_nothing_heavy(module: str, heavy: str) -> None:
    script = (
        f"import sys; import drake_pose.{module}; "
        f"print([m for m in {heavy.split()} if m in sys.modules])"
    )
    finished = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert finished.stdout.strip() == "[]"


@pytest.mark.parametrize("while_parsing", [False, True])
@pytest.mark.parametrize(
    ("ending", "message"),
    [
        (signal.SIGTERM, "interrupted before anything was written"),
        (signal.SIGHUP, "interrupted before anything was written"),
        (PermissionError(13, "denied", "a/\x1b[31mb"), r"a/\x1b[31mb: denied"),
        (UnicodeEncodeError("utf-8", "a/\udcfc", 2, 3, "no"), r"'a/\udcfc': the name of this file"),
    ],
)
def test_every_failure_is_reported_in_one_line(while_parsing, ending, message, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        if isinstance(ending, Exception):
            raise ending
        os.kill(os.getpid(), ending)
        time.sleep(10.0)

    if while_parsing and not isinstance(ending, Exception):
        monkeypatch.setattr("drake_pose.commands.main.app", SimpleNamespace(parse_args=fail))
    else:
        monkeypatch.setattr("drake_pose.jobs.batch_tasks.read_job", fail)
    result = run_command(["batch", "jobs.yaml", "--out", "nowhere"])
    assert result.exit_code == 1
    assert result.output.startswith(f"drake-pose: error: {message}")
    assert result.output.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "instead"),
    [
        ("walk results/person", "Walker"),
        ("masks a --out b --box=1,2,3,4", "masks --box is gone: take the masks"),
        ("reproduce all --out results", "tutorials/figures.md"),
        ("register scene --model arm.urdf --out out --export=rerun", "load_cameras"),
        ("batch jobs.yaml --out b --chunk=3", "job file"),
    ],
)
def test_what_is_gone_names_what_to_use_instead(line: str, instead: str) -> None:
    result = run_command(line.split())
    assert result.exit_code == 2
    assert " is gone: " in result.stderr
    assert instead in result.stderr
    assert result.stderr.count("\n") == 1


def test_check_of_a_model(tiny_scene: TinyScene, tmp_path: Path) -> None:
    result = run_command(["check", str(tiny_scene.model)])
    assert result.exit_code == 0, result.output
    assert "crane: 3 segments" in result.stdout
    assert re.search(r"lift +-91\.67\d* \.\. 91\.67\d* deg", result.stdout)
    assert "fit for use" in result.stderr
    report = json.loads(run_command(["check", str(tiny_scene.model), "--json"]).stdout)
    assert report["usable"] is True
    assert [node["name"] for node in report["nodes"]] == ["base", "boom", "jib"]
    result = run_command(["check", str(tmp_path / "nowhere.urdf"), "--json"])
    assert result.exit_code == 1
    assert "nowhere.urdf" in json.loads(result.stdout)["errors"][0]


@pytest.mark.slow
def test_ctrl_c_keeps_finished_frames_and_the_job_can_be_resumed(tmp_path: Path) -> None:
    angles = [(20.0 * (index % 5 - 2), -20.0 * (index % 7)) for index in range(60)]
    scene = write_scene(tmp_path / "scene", angles, ("front", "side"))
    out = tmp_path / "out"
    command = [*PROGRAM, "estimate", str(scene.folder), "--model", str(scene.model)]
    command += ["--out", str(out), "--method", "paper", "--no-replay"]
    environment = {**os.environ, "COLUMNS": "200"}
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # Background jobs ignore SIGINT, which children inherit.
        env=environment, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    poses = out / "poses.csv"
    deadline = time.monotonic() + 120.0
    while process.poll() is None and time.monotonic() < deadline:
        if poses.is_file() and len(poses.read_text().splitlines()) > 3:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 1, stderr
    assert stdout == ""
    assert re.fullmatch(
        rf"drake-pose: error: interrupted.*{re.escape(str(out))}.*--resume.*\n", stderr
    )
    finished = poses.read_text().splitlines()
    assert 3 < len(finished) < 61
    summary = json.loads((out / "summary.json").read_text())
    assert summary["complete"] is False
    assert list(summary["frames"]) == [line.split(",")[0] for line in finished[1:]]

    resumed = subprocess.run(
        [*command, "--resume", "--json"], cwd=ROOT, capture_output=True, text=True, env=environment
    )
    assert resumed.returncode == 0, resumed.stderr
    assert poses.read_text().splitlines()[: len(finished)] == finished
    assert [row["frame"] for row in read_rows(poses)] == list(scene.truth)
    summary = json.loads(resumed.stdout)
    assert summary["complete"] is True
    assert summary["found_count"] == 60
    assert not list(out.rglob("*.part"))
