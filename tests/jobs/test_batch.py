"""Batches of scenes by any number of workers."""

import dataclasses
import gc
import inspect
import json
import os
import pickle
import signal
import socket
import sys
import textwrap
import threading
import time
from pathlib import Path

import psutil
import pytest
import yaml

from drake_pose.commands.estimate import batch
from drake_pose.errors import ClusterError, OutputError, SettingsError
from drake_pose.files.settings import GONE, EstimateSettings
from drake_pose.jobs.batch import run_batch
from drake_pose.jobs.batch_tasks import Outcome, SceneJob, Task, perform, plan_scene, read_job
from drake_pose.jobs.cluster import call_in_child, open_cluster, require_fit_workers
from drake_pose.jobs.estimate.scene import estimate_scene
from tests.cli import run_to_end
from tests.files.test_report_page import require_plain_page
from tests.jobs.scenes import write_scene

MOTION = [(20.0 + 5.0 * k, -40.0 - 4.0 * k) for k in range(5)]
QUICK = {"method": "paper", "replay": False, "overlay": False}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A folder with scenes of five stills and of a sequence of three frames."""
    base = tmp_path_factory.mktemp("scenes")
    write_scene(base / "stills", MOTION)
    write_scene(base / "motion", MOTION[:3])
    (base / "motion" / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 30\n")
    return base


def write_job(
    folder: Path, scenes: dict[str, dict], name: str = "jobs.yaml", chunk: int = 2
) -> Path:
    path = folder / name
    content = {"chunk": chunk, "defaults": {"model": "crane.urdf", **QUICK}, "scenes": scenes}
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def jobs(scenes):
    both = {"stills": {"scene": "stills"}, "motion": {"scene": "motion", "overlay": True}}
    return read_job(write_job(scenes, both))


@pytest.fixture(scope="module")
def alone(jobs, tmp_path_factory):
    """The result of a batch without workers."""
    out = tmp_path_factory.mktemp("alone") / "out"
    run_batch(jobs, out)
    return out


def rows(folder: Path) -> list[list[str]]:
    """Return the rows of poses.csv without the seconds."""
    return [line.split(",")[:-1] for line in (folder / "poses.csv").read_text().splitlines()]


def same_results(one: Path, other: Path) -> bool:
    return all(rows(one / name) == rows(other / name) for name in ("stills", "motion"))


def slow(task: Task) -> Outcome:
    time.sleep(0.4)
    return perform(task)


def test_joined_chunks_equal_the_whole_scene(jobs, alone, scenes, tmp_path):
    names = ["batch.json", "motion", "report.html", "stills"]
    assert sorted(path.name for path in alone.iterdir()) == names
    page = require_plain_page((alone / "report.html").read_text())
    assert page.by_id["answer"] == "2 of 2 scenes finished."
    for name in ("stills", "motion"):
        assert f"{name}/report.html" in page.links
    plain = tmp_path / "plain"
    estimate_scene(
        scenes / "stills", scenes / "crane.urdf", plain, jobs[0].settings, replay=False,
        overlay=False,
    )  # fmt: skip
    for file in ("joints.csv", "modes.csv"):
        assert (plain / file).exists() == (alone / "stills" / file).exists()
    assert rows(plain) == rows(alone / "stills")
    summary = json.loads((alone / "motion" / "summary.json").read_text())
    assert summary["complete"]
    assert list(summary["frames"]) == ["0000", "0001", "0002"]
    assert len(list((alone / "motion" / "overlay" / "front").iterdir())) == 3


@pytest.mark.slow
def test_results_are_independent_of_workers_and_their_deaths(jobs, alone, cluster, tmp_path):
    victims, out = list(cluster.run(os.getpid).values())[:1], tmp_path / "two"

    def kill(done: int, total: int, message: str) -> None:
        if done and victims:
            os.kill(victims.pop(), signal.SIGKILL)

    result = run_batch(jobs, out, cluster, work=slow, on_progress=kill)
    assert not victims
    assert not result.failed
    assert same_results(alone, out)
    cluster.wait_for_workers(2, timeout=30)


def die_on_second_chunk(task: Task) -> Outcome:
    """Perform a task, but kill the process at the second chunk."""
    if task.index == 1 and task.job.name == "stills":
        with (task.out / "deaths").open("a") as file:
            file.write("x")
        os.kill(os.getpid(), signal.SIGKILL)
    return perform(task)


@pytest.mark.slow
def test_a_chunk_that_kills_workers_is_given_up_and_others_are_kept(jobs, alone, cluster, out):
    heard = []
    result = run_batch(
        jobs, out, cluster, work=die_on_second_chunk, tries=2,
        on_progress=lambda done, total, message: heard.append((done, total, message)),
    )  # fmt: skip
    assert result.failed == ("stills",)
    ((error, where),) = result.scenes["stills"].errors.items()
    assert "given up after 2 tries" in error
    assert "SIGKILL" in error
    assert where == ["frames 0002 to 0003"]
    assert [message for *_, message in heard if "frames 0002 to 0003" in message]
    assert (out / "deaths").read_text() == "xx"
    assert rows(out / "motion") == rows(alone / "motion")
    assert not (out / "stills").exists()
    assert len(list((out / ".chunks" / "stills").iterdir())) == 2
    again = []
    resumed = run_batch(
        jobs, out, resume=True, work=lambda task: again.append(task) or perform(task)
    )
    assert not resumed.failed
    assert [task.index for task in again if task.job.name == "stills"] == [1, None]
    assert same_results(alone, out)
    assert not (out / ".chunks").exists()


def test_scheduler_and_workers_listen_on_the_loopback_address(cluster):
    this = psutil.Process()
    listening = [
        connection.laddr.ip
        for process in [this, *this.children(recursive=True)]
        for connection in process.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    ]
    assert len(listening) >= 3
    assert all(ip.startswith("127.") for ip in listening)


def test_workers_of_another_version_are_refused(cluster, tmp_path, monkeypatch):
    require_fit_workers(cluster, tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []
    monkeypatch.setattr("drake_pose.version.VERSION", "99.0")
    with pytest.raises(ClusterError, match=r"here is 99\.0"):
        require_fit_workers(cluster, tmp_path)


@pytest.mark.parametrize("words", [b"", b"HTTP/1.0 400 Bad request\r\n\r\n" * 8])
def test_a_server_that_is_not_a_scheduler_is_refused_in_time(words, caplog, capfd):
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def talk():
            while True:
                try:
                    talked.append(listening.accept()[0])
                    talked[-1].sendall(words)
                except OSError:
                    return

        talked = []
        threading.Thread(target=talk, daemon=True).start()
        address = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        begin = time.monotonic()
        with (
            pytest.raises(ClusterError, match=address),
            open_cluster(scheduler=address, timeout=0.5),
        ):
            pass
        assert time.monotonic() - begin < 5.0
        listening.shutdown(socket.SHUT_RDWR)
    assert talked
    for connection in talked:
        connection.close()
    gc.collect()
    assert caplog.text == capfd.readouterr().err == ""


@pytest.mark.parametrize("address", ["foo", "10.0.0.7:8786", "tcp://foo", "htp://x:1"])
def test_a_bad_scheduler_address_is_named(address):
    message = f"'{address}' is not a scheduler's address"
    with pytest.raises(ClusterError, match=message), open_cluster(scheduler=address):
        pass


def test_without_dask_one_process_works_and_workers_are_refused(tmp_path, out, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    path = tmp_path / "jobs.yaml"
    path.write_text("scenes: {gone: {scene: gone}}")
    words = ["batch", path, "--out", out]
    refused = run_to_end(*words, "--workers", "2", status=1)
    assert 'pip install "drake_pose[cluster]"' in refused.stderr
    assert not out.exists()
    done = run_to_end(*words, status=1)
    assert 'one process does all the work; to use all cores: pip install "dr' in done.stderr
    assert "scene 'gone'" in done.stderr
    assert json.loads((out / "batch.json").read_text())["scenes"]["gone"]["state"] == "failed"


def test_example_of_the_help_is_a_job_file(tmp_path):
    example = inspect.getdoc(batch).partition("    chunk:")[2].partition("\n\n")[0]
    path = tmp_path / "jobs.yaml"
    path.write_text(textwrap.dedent("    chunk:" + example))
    assert [(job.name, job.audit is not None) for job in read_job(path)] == [
        ("monday", False), ("walker", False), ("robot", True),
    ]  # fmt: skip


def test_job_file_gives_the_settings(tmp_path):
    entry = {
        "scene": "a", "model": "m.urdf", "cameras": ["left"], "frames": "0:9", "root": "base",
        "root_position": [1, 2, 3], "root_rotation": "y=-180:180",
        "hold": {"lift": 10}, "method": "beam", "truth": "t.csv", "replay": False,
        "packages": {"arms": "robots"}, "start": "first.csv", "track": False,
    }  # fmt: skip
    path = tmp_path / "jobs.yaml"
    path.write_text(yaml.safe_dump({"chunk": 7, "scenes": {"a": entry}}))
    (job,) = read_job(path)
    settings = EstimateSettings(
        cameras=("left",), frames=("0:9",), root="base", root_position=(1.0, 2.0, 3.0),
        root_rotation={"y": (-180.0, 180.0)}, hold={"lift": 10.0}, method="beam",
        packages={"arms": tmp_path / "robots"}, start=tmp_path / "first.csv", track=False,
    )  # fmt: skip
    truth = tmp_path / "t.csv"
    assert job == SceneJob(
        "a", tmp_path / "a", tmp_path / "m.urdf", settings, truth, replay=False, chunk=7
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("scenes: {}", "has no scenes"),
        ("scenes: {a: {}}", "scene 'a': 'scene' is missing"),
        ("scenes: {../a: {scene: a}}", "slashes"),
        ("scenes: {1: {scene: a}}", "quotes"),
        ("scenes: {a: {scene: a, methode: beam}}", "unknown field methode; there are: scene"),
        ("scenes: {a: {scene: a, every: wide}}", "every: must be a whole number"),
        ("scenes: {a: {scene: a, every: true}}", "every: must be a whole number"),
        ("scenes: {a: {scene: a, time_limit: 5}}", f"--time-limit is gone: {GONE['--time-limit']}"),
        ("scenes: {a: {}}\ndefaults: {time_limit: 1}", "--time-limit is gone: "),
        ("scenes: {a: {scene: a, track: 1}}", "track: must be true or false"),
        ("scenes: {a: {scene: a, hold: {lift: low}}}", "hold: lift: must be a number"),
        ("scenes: {a: {scene: a, packages: [b]}}", "packages: expected NAME: VALUE"),
        ("scenes: {a: {scene: a, frames: [1]}}", "put numbers in quotes"),
        ("scenes: {a: {scene: a, method: best}}", "scene 'a': there is no method 'best'"),
        ("scenes: {a: {scene: a, root_position: here}}", "scene 'a': root_position"),
        ("scenes: {a: {scene: a}}\nchunk: 0", "chunk: must be a whole number"),
        ("scenes: {a: {scene: a}}\ndefaults: {model: 3}", "model: must be a text"),
        ("scene: {a: {scene: a}}", "unknown field scene"),
        ("scenes: {a: {scene: a, audit: j.csv, root: a}}", "no setting root"),
        ("scenes: {a: {scene: a, audit: j.csv, truth: j.csv}}", "an audit has no setting truth"),
        ("scenes: {a: {scene: a, camera_file: c.yaml}}", "an estimate has no setting camera_file"),
        ("scenes: {a: {scene: a}, a: {scene: b}}", "given twice"),
    ],
)
def test_job_file_is_checked(text, words, tmp_path):
    path = tmp_path / "jobs.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=r"jobs\.yaml") as caught:
        read_job(path)
    assert words in str(caught.value)


def finish(task: Task) -> Outcome:
    """Create a task's folder and return its outcome without work."""
    task.place.mkdir(parents=True)
    totals = {"frame_count": len(task.frames), "found_count": len(task.frames)}
    return Outcome(None, 2.0, None if task.index is not None else totals)


def test_a_scene_is_cut_into_chunks_and_joined(scenes, out):
    one = {"stills": {"scene": "stills"}}
    (job,) = read_job(write_job(scenes, one, "one.yaml"))
    tasks = plan_scene(job, out)
    assert [task.frames for task in tasks] == [("0000", "0001"), ("0002", "0003"), ("0004",)]
    assert len({task.place for task in tasks}) == 3
    done, heard = [], []
    result = run_batch(
        [job], out, work=lambda task: done.append(task) or finish(task),
        on_progress=lambda *progress: heard.append(progress),
    )  # fmt: skip
    assert [task.index for task in done] == [0, 1, 2, None]
    assert done[-1].frames == tuple(f"{k:04d}" for k in range(5))
    assert [path.name for path in done[-1].chunks] == [task.place.name for task in tasks]
    assert heard == [(k, 5, "") for k in (0, 2, 4, 5, 5)]
    told = json.loads((out / "batch.json").read_text())
    assert told["complete"]
    state = told["scenes"]["stills"]
    assert (state["state"], state["chunks"], state["chunks_done"]) == ("finished", 3, 3)
    assert (state["frame_count"], state["found_count"]) == (5, 5)
    assert result.scenes["stills"].seconds == 8.0
    assert not (out / ".chunks").exists()
    # Chunks of other frames have other folders.
    settings = dataclasses.replace(job.settings, frames=("0001:0004",))
    longer = dataclasses.replace(job, settings=settings)
    assert not {task.place for task in plan_scene(longer, out)} & {task.place for task in tasks}


def test_finished_tasks_are_not_repeated(scenes, out):
    (job,) = read_job(write_job(scenes, {"stills": {"scene": "stills"}}, "one.yaml"))
    first, *_ = plan_scene(job, out)
    (first.work / f"{first.place.name}.part-1").mkdir(parents=True)
    finish(first)
    (out / "batch.json").write_text(json.dumps({"scenes": {}}))
    done = []
    run_batch([job], out, resume=True, work=lambda task: done.append(task.index) or finish(task))
    assert done == [1, 2, None]
    # A joined scene that lacks a frame has failed.
    lacking = Outcome(None, 0.0, {"frame_count": 4})
    assert run_batch([job], out, resume=True, work=lambda _: lacking).failed == ("stills",)


@pytest.mark.parametrize("wrong", [{0}, {0, 1, 2}])
def test_failed_chunks_do_not_stop_the_others_until_three_have_failed(scenes, out, wrong):
    entry = {"stills": {"scene": "stills"}, "motion": {"scene": "motion"}}
    jobs = read_job(write_job(scenes, entry, "two.yaml", chunk=1))
    asked = []

    def work(task: Task) -> Outcome:
        asked.append((task.job.name, task.index))
        is_wrong = task.job.name == "stills" and task.index in wrong
        return Outcome(f"broken {task.index}") if is_wrong else finish(task)

    result = run_batch(jobs, out, work=work)
    tried = [index for name, index in asked if name == "stills"]
    assert tried == ([0, 1, 2] if len(wrong) == 3 else [0, 1, 2, 3, 4])
    assert [index for name, index in asked if name == "motion"] == [0, 1, 2, None]
    assert result.failed == ("stills",)
    assert result.scenes["stills"].errors == {
        f"broken {k}": [f"frames {k:04d} to {k:04d}"] for k in sorted(wrong)
    }
    assert not json.loads((out / "batch.json").read_text())["complete"]


def test_a_changed_job_is_not_resumed(scenes, out):
    (job,) = read_job(write_job(scenes, {"stills": {"scene": "stills"}}, "one.yaml"))
    with pytest.raises(OutputError, match="there is no batch to resume"):
        run_batch([job], out, resume=True)
    run_batch([job], out, work=finish)
    with pytest.raises(OutputError, match=r"'stills' was started with chunk = 2, not 3"):
        run_batch([dataclasses.replace(job, chunk=3)], out, resume=True)
    (out / "batch.json").write_text("{")
    with pytest.raises(OutputError, match="damaged"):
        run_batch([job], out, resume=True)


def test_a_crash_ends_the_child_and_not_the_worker():
    def call(function, argument):
        return pickle.loads(call_in_child(pickle.dumps((function, argument))))

    child = call(os.getpgid, 0), call(eval, "__import__('os').getpid()")
    assert child == (os.getpgid(0), call(eval, "__import__('os').getpid()"))
    assert child[1] != os.getpid()
    for function, argument, how in (
        (os._exit, 3, "exit status 3"),
        (eval, "__import__('os').kill(__import__('os').getpid(), 9)", "SIGKILL"),
    ):
        with pytest.raises(ClusterError, match=how):
            call(function, argument)
    assert call(eval, "__import__('os').getpid()") not in (os.getpid(), child[1])
