"""Batches of scenes: which tasks are run, in which order, and what is written about them."""

import dataclasses
import json
import os
import signal

import pytest

from drake_pose.errors import OutputError
from drake_pose.jobs.batch import run_batch
from drake_pose.jobs.batch_tasks import Outcome, Task, perform, plan_scene
from tests.files.test_page import require_plain_page
from tests.jobs.batches import BOTH, STILLS, finish, jobs_of, rows
from tests.jobs.scenes import read_rows
from tests.registration.episodes import painted_episode
from tests.registration.recordings import write_episode


@pytest.fixture(scope="module")
def jobs(scenes):
    return jobs_of(scenes, BOTH)


@pytest.fixture
def job(scenes):
    return jobs_of(scenes, STILLS)[0]


def test_chunks_are_run_in_order_and_joined(job, out):
    tasks, done, heard = plan_scene(job, out), [], []
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
    assert 0.0 <= told["seconds"] < 60.0
    state = told["scenes"]["stills"]
    assert (state["state"], state["chunks"], state["chunks_done"]) == ("finished", 3, 3)
    assert (state["frame_count"], state["found_count"], state["worker_seconds"]) == (5, 5, 8.0)
    assert not result.failed
    assert not (out / ".chunks").exists()
    page = require_plain_page((out / "report.html").read_text())
    assert page.by_id["answer"] == "1 of 1 scenes finished."
    assert "stills/report.html" in page.links


def test_finished_tasks_are_not_repeated(job, out):
    first, *_ = plan_scene(job, out)
    part = first.work / f"{first.place.name}.part-1"
    part.mkdir(parents=True)
    finish(first)
    (out / "batch.json").write_text(json.dumps({"scenes": {}}))
    done = []

    def work(task):
        assert not part.exists()
        done.append(task.index)
        return finish(task)

    run_batch([job], out, resume=True, work=work)
    assert done == [1, 2, None]
    # A joined scene that lacks a frame has failed.
    lacking = Outcome(None, 0.0, {"frame_count": 4})
    result = run_batch([job], out, resume=True, work=lambda _: lacking)
    assert result.failed == ("stills",)
    ((error, _),) = result.scenes["stills"].errors.items()
    assert "has 4 frames, but the scene has 5 now" in error


@pytest.mark.parametrize("wrong", [{0}, {0, 1, 2}])
def test_failed_chunks_do_not_stop_the_others_until_three_have_failed(scenes, out, wrong):
    jobs, asked, heard = jobs_of(scenes, BOTH, chunk=1), [], []

    def work(task: Task) -> Outcome:
        asked.append((task.job.name, task.index))
        is_wrong = task.job.name == "stills" and task.index in wrong
        return Outcome(f"broken {task.index}") if is_wrong else finish(task)

    result = run_batch(jobs, out, work=work, on_progress=lambda *given: heard.append(given[2]))
    tried = [index for name, index in asked if name == "stills"]
    assert tried == ([0, 1, 2] if len(wrong) == 3 else [0, 1, 2, 3, 4])
    assert [index for name, index in asked if name == "motion"] == [0, 1, 2, None]
    assert result.failed == ("stills",)
    assert result.scenes["stills"].errors == {
        f"broken {k}": [f"frames {k:04d} to {k:04d}"] for k in sorted(wrong)
    }
    assert heard[1] == "scene 'stills', frames 0000 to 0000: broken 0"
    told = json.loads((out / "batch.json").read_text())
    assert not told["complete"]
    assert told["scenes"]["stills"]["state"] == "failed"
    assert told["scenes"]["stills"]["frame_count"] == 5
    page = require_plain_page((out / "report.html").read_text())
    assert "1 of 2 scenes finished." in page.by_id["answer"]
    # What failed is tried again.
    assert not run_batch(jobs, out, resume=True, work=finish).failed


def test_a_changed_job_is_not_resumed(job, out):
    with pytest.raises(OutputError, match="there is no batch to resume"):
        run_batch([job], out, resume=True)
    run_batch([job], out, work=finish)
    with pytest.raises(OutputError, match=r"'stills' was started with chunk = 2, not 3"):
        run_batch([dataclasses.replace(job, chunk=3)], out, resume=True)
    new = dataclasses.replace(job, name="new")
    assert not run_batch([job, new], out, resume=True, work=finish).failed
    for text in ("{", "[]", '{"scenes": []}', '{"scenes": {"a": 3}}'):
        (out / "batch.json").write_text(text)
        with pytest.raises(OutputError, match="damaged"):
            run_batch([job], out, resume=True)


def test_audits_list_their_errors_and_start_at_the_cameras_of_the_first(tmp_path, out):
    """Also if the first fails; and in a resumed batch, whose first episode is done already."""
    painted, scenes = painted_episode(tmp_path, frames=6), ("one", "two", "three", "gone")
    for name in scenes[:3]:
        write_episode(tmp_path / "set" / name, painted)
    entry = {"model": "boxes.urdf", "audit": True}
    jobs = jobs_of(tmp_path, {name: {"scene": f"set/{name}"} for name in scenes}, defaults=entry)
    found = [
        {"what": "joint", "name": "A1", "text": "off"},
        {"what": "frame", "name": "3", "text": ""},
    ]
    done = []

    def work(task):
        done.append((task.job.name, task.near))
        # The frames of two cameras, one of which does not show the body in one picture.
        totals = {"frame_count": 11, "agreeing_count": 8, "findings": found}
        return Outcome("lost") if task.job.name == "one" else Outcome(None, 0.0, totals)

    batch = run_batch(jobs, out, work=work)
    assert batch.failed == ("one", "gone")
    assert batch.scenes["two"].frame_count == 11
    first = out / "one"
    assert done == [("one", None), ("two", first), ("three", first)]
    told = json.loads((out / "batch.json").read_text())["scenes"]
    assert [one["state"] for one in told.values()] == ["failed", "finished", "finished", "failed"]
    assert (told["two"]["agreeing_count"], told["two"]["findings"]) == (8, found)
    assert [tuple(row.values()) for row in read_rows(out / "findings.csv")] == [
        (name, *one.values()) for name in ("two", "three") for one in found
    ]
    page = require_plain_page((out / "report.html").read_text())
    assert page.by_id["answer"] == (
        "2 of 4 scenes finished. In 2 of them: joint A1. In 2 of them: frame 3."
    )
    assert ["two", "finished", "8 of 11", "joint A1, frame 3"] in page.tables[0]


def die_on_second_chunk(task: Task) -> Outcome:
    """Perform a task, but kill the process at the second chunk."""
    if task.index == 1 and task.job.name == "stills":
        with (task.out / "deaths").open("a") as file:
            file.write("x")
        os.kill(os.getpid(), signal.SIGKILL)
    return perform(task)


@pytest.mark.slow
def test_workers_give_the_same_results_and_may_die(jobs, cluster, tmp_path, out):
    """A worker that is killed comes back; a chunk that kills its process is given up."""
    alone = tmp_path / "alone"
    run_batch(jobs, alone)
    victims = list(cluster.run(os.getpid).values())[:1]

    def kill(done: int, total: int, message: str) -> None:
        if done and victims:
            os.kill(victims.pop(), signal.SIGKILL)

    result = run_batch(jobs, out, cluster, work=die_on_second_chunk, tries=2, on_progress=kill)
    assert not victims
    assert result.failed == ("stills",)
    ((error, where),) = result.scenes["stills"].errors.items()
    assert "given up after 2 tries" in error
    assert "SIGKILL" in error
    assert where == ["frames 0002 to 0003"]
    assert (out / "deaths").read_text() == "xx"
    assert rows(out / "motion") == rows(alone / "motion")
    cluster.wait_for_workers(2, timeout=30)
    again = []
    resumed = run_batch(
        jobs, out, resume=True, work=lambda task: again.append(task) or perform(task)
    )
    assert not resumed.failed
    assert [task.index for task in again if task.job.name == "stills"] == [1, None]
    assert rows(out / "stills") == rows(alone / "stills")
    assert not (out / ".chunks").exists()
