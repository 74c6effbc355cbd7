"""Job files, and the tasks of their scenes: chunks, joined scenes, audits."""

import dataclasses
import json

import numpy as np
import pytest

from drake_pose.body import bundled_model
from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.errors import SettingsError
from drake_pose.files.settings import GONE, AuditSettings, EstimateSettings
from drake_pose.jobs.batch_tasks import (
    SceneJob,
    Task,
    camera_set,
    describe_failure,
    perform,
    plan_scene,
    read_job,
)
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.estimate.scene import estimate_scene
from tests.jobs.batches import STILLS, finish, jobs_of, rows
from tests.registration.episodes import painted_episode
from tests.registration.recordings import write_episode


def test_job_file_gives_the_settings(tmp_path):
    entry = {
        "scene": "a", "cameras": ["left"], "frames": "0:9", "root": "base", "hold": {"lift": 10},
        "root_position": [1, 2, 3], "root_rotation": "y=-180:180", "method": "beam",
        "overlay": None, "truth": "t.csv", "replay": False, "packages": {"arms": "robots"},
        "start": "first.csv", "track": False,
    }  # fmt: skip
    centres = {"scene": "b", "root": "toe", "root_position": "centres.csv:toe", "model": "/m.urdf"}
    defaults = {"model": "m.urdf", "overlay": False}
    first, second = jobs_of(tmp_path, {"a": entry, "b": centres}, 7, defaults)
    settings = EstimateSettings(
        cameras=("left",), frames=("0:9",), root="base", root_position=(1.0, 2.0, 3.0),
        root_rotation={"y": (-180.0, 180.0)}, hold={"lift": 10.0}, method="beam",
        packages={"arms": tmp_path / "robots"}, start=tmp_path / "first.csv", track=False,
    )  # fmt: skip
    assert first == SceneJob(
        "a", tmp_path / "a", tmp_path / "m.urdf", settings, tmp_path / "t.csv", replay=False,
        chunk=7,
    )  # fmt: skip
    assert second.settings.root_position == (tmp_path / "centres.csv", "toe")
    assert (str(second.model), second.overlay, second.chunk) == ("/m.urdf", False, 7)
    audits = {"data": {"scene": "set", "audit": True, "episodes": "8:10", "units": "rad"}}
    audits["one"] = {"scene": "a", "audit": "j.csv", "camera_file": "c.yaml", "every": 2}
    *data, one = jobs_of(tmp_path, audits, defaults=None)
    assert [job.name for job in data] == ["data_000008", "data_000009", "data_000010"]
    assert [job.settings for job in data] == [
        AuditSettings(episode=k, units="rad") for k in (8, 9, 10)
    ]
    assert (data[0].audit, one.audit, one.camera_file) == (
        True, tmp_path / "j.csv", tmp_path / "c.yaml",
    )  # fmt: skip
    assert one.settings.every == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("scenes: {}", "has no scenes"),
        ("scenes: [a]", "has no scenes"),
        ("scenes: {a: {}}", "scene 'a': 'scene' is missing"),
        *(
            (f"scenes: {{{name}: {{scene: a}}}}", "its name becomes a folder's")
            for name in ("../a", "a\\b", "1", '""', ".a")
        ),
        ("scenes: {a: {scene: a, methode: beam}}", "unknown field methode; there are: scene"),
        ("scenes: {a: {scene: a, every: wide}}", "every: must be a whole number"),
        ("scenes: {a: {scene: a, time_limit: 5}}", f"--time-limit is gone: {GONE['--time-limit']}"),
        ("scenes: {a: {scene: a, track: 1}}", "track: must be true or false"),
        ("scenes: {a: {scene: a, hold: {lift: low}}}", "hold: lift: must be a number"),
        ("scenes: {a: {scene: a, hold: {lift: true}}}", "hold: lift: must be a number"),
        ("scenes: {a: {scene: a, packages: [b]}}", "packages: expected NAME: VALUE"),
        ("scenes: {a: {scene: a, frames: [1]}}", "put numbers in quotes"),
        ("scenes: {a: {scene: a, method: best}}", "scene 'a': there is no method 'best'"),
        ("scenes: {a: {scene: a, root_position: here}}", "scene 'a': root_position"),
        ("scenes: {a: {scene: a, root_position: 3}}", "root_position: must be a text"),
        *(
            (f"scenes: {{a: {{scene: a}}}}\nchunk: {number}", "chunk: must be a whole number")
            for number in ("0", "true", "many")
        ),
        ("scenes: {a: {scene: a}}\ndefaults: {model: 3}", "model: must be a text"),
        ("scene: {a: {scene: a}}", "unknown field scene"),
        ("scenes: {a: {scene: a, audit: j.csv, root: a}}", "an audit has no setting root"),
        ("scenes: {a: {scene: a, audit: j.csv, truth: j.csv}}", "an audit has no setting truth"),
        ("scenes: {a: {scene: a, camera_file: c.yaml}}", "an estimate has no setting camera_file"),
        ("scenes: {a: {scene: a, units: rad}}", "an estimate has no setting units"),
        ("scenes: {a: {scene: a}, a: {scene: b}}", "given twice"),
        *(
            (f"scenes: {{a: {{scene: a, audit: true, episodes: {of}}}}}", "scene 'a': episodes")
            for of in ('"8"', '"9:8"', "3", '"a:9"', '"1:b"')
        ),
    ],
)
def test_job_file_is_checked(text, words, tmp_path):
    path = tmp_path / "jobs.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=r"jobs\.yaml") as caught:
        read_job(path)
    assert words in str(caught.value)


def test_scenes_are_cut_into_chunks(scenes, out):
    (job,) = jobs_of(scenes, STILLS)
    tasks = plan_scene(job, out)
    assert [task.frames for task in tasks] == [("0000", "0001"), ("0002", "0003"), ("0004",)]
    assert len({task.place for task in tasks}) == 3
    # Chunks of other frames have other folders.
    some = dataclasses.replace(
        job, settings=dataclasses.replace(job.settings, frames=("1:4",), every=2)
    )
    (other,) = plan_scene(some, out)
    assert other.frames == ("0001", "0003")
    assert other.place not in [task.place for task in tasks]
    audit = dataclasses.replace(job, audit=True, settings=AuditSettings())
    (task,) = plan_scene(audit, out)
    assert (task.index, len(task.frames), camera_set(audit)) == (None, 5, None)


def test_recordings_of_persons_and_episodes_are_not_cut(scenes, tmp_path, out):
    """A person by the model's landmarks before two cameras, not in a single view."""
    (job,) = jobs_of(scenes, STILLS)
    alone = dataclasses.replace(job, model=bundled_model("person"), settings=EstimateSettings())
    assert len(plan_scene(alone, out)) == 3
    front = load_cameras(scenes / "stills" / "cameras.yaml")["front"]
    several = tmp_path / "several"
    for name in ("a", "b"):
        (several / "masks" / name).mkdir(parents=True)
        for path in (scenes / "stills" / "masks" / "front").iterdir():
            (several / "masks" / name / path.name).write_bytes(path.read_bytes())
    rig = [dataclasses.replace(front, name=name) for name in ("a", "b")]
    save_cameras(several / "cameras.yaml", rig)
    for model, method, count in (
        (bundled_model("person"), "auto", 1), (bundled_person(), "person", 1),
        (bundled_model("person"), "beam", 3), (job.model, "beam", 3),
    ):  # fmt: skip
        settings = EstimateSettings(method=method)
        together = dataclasses.replace(alone, scene=several, model=model, settings=settings)
        assert len(plan_scene(together, out)) == count
    painted = painted_episode(tmp_path, frames=6)
    write_episode(tmp_path / "set" / "one", painted)
    entry = {"scene": "set/one", "model": "boxes.urdf", "audit": True, "every": 2}
    (episode,) = jobs_of(tmp_path, {"one": entry}, defaults=None)
    (task,) = plan_scene(episode, out)
    assert (task.index, task.frames) == (None, ("0", "2", "4"))
    assert camera_set(episode) == (tmp_path / "set", tmp_path / "boxes.urdf", None, ())
    numbered = dataclasses.replace(episode, settings=AuditSettings(episode=3, cameras=("left",)))
    assert camera_set(numbered) == (
        tmp_path / "set" / "one", tmp_path / "boxes.urdf", None, ("left",)
    )  # fmt: skip


def test_joined_chunks_equal_the_whole_scene(scenes, tmp_path, out):
    (job,) = jobs_of(scenes, {"some": STILLS["stills"] | {"frames": "0:2", "overlay": True}})
    wide = dataclasses.replace(job, replay=True)
    chunks = plan_scene(wide, out)
    outcomes = [perform(task) for task in chunks]
    assert [one.error for one in outcomes] == [None, None]
    assert [one.totals for one in outcomes] == [None, None]
    assert all(0.0 < one.seconds < 600.0 for one in outcomes)
    assert not [*out.rglob("replay.html")]
    frames, places = ("0000", "0001", "0002"), tuple(task.place for task in chunks)
    whole = Task(wide, out, None, frames, places)
    outcome = perform(whole)
    assert outcome.totals["frame_count"] == outcome.totals["found_count"] == 3
    estimate_scene(
        job.scene, job.model, tmp_path / "plain", job.settings, replay=False, overlay=False
    )
    assert rows(tmp_path / "plain") == rows(out / "some")
    summaries = [
        json.loads((folder / "summary.json").read_text())
        for folder in (out / "some", tmp_path / "plain")
    ]
    assert summaries[0]["complete"]
    assert outcome.totals["mean_E_total"] == summaries[0]["mean_E_total"]
    for one in summaries:
        assert list(one["frames"]) == list(frames)
        for frame in one["frames"].values():
            frame.pop("seconds")
    assert summaries[0]["frames"] == summaries[1]["frames"]
    assert len(list((out / "some" / "overlay" / "front").iterdir())) == 3
    assert (out / "some" / "replay.html").exists()
    assert not [*out.rglob("*.part-*")]
    # It is not done again, and refused if a mask has changed.
    again = perform(whole)
    assert (again.seconds, again.totals) == (0.0, outcome.totals)
    mask = job.scene / "masks" / "front" / "0001.png"
    before, other = mask.read_bytes(), mask.with_name("0002.png").read_bytes()
    mask.write_bytes(other)
    assert "masks of frame 0001 were replaced" in perform(whole).error
    assert perform(dataclasses.replace(whole, frames=frames[:1])).error is None
    assert perform(chunks[0]).error is None
    mask.write_bytes(before)


@pytest.fixture
def audited(monkeypatch):
    """Stand in for the audit by a summary; the keywords of the calls."""
    calls = []
    camera = {"X_WC": np.eye(4).tolist(), "translation_sd_mm": 2.0}
    wrist = {"X_LC": np.eye(4).tolist()}
    texts = [
        {"what": "camera", "name": "left", "shift_mm": 12.0, "angle_deg": 3.0},
        {"what": "joint", "name": "A1", "angle_deg": 4.0, "angle_sd_deg": 0.5, "shift_sd_mm": None},
        {"what": "joint", "name": "B", "shift_mm": 7.0, "shift_sd_mm": 0.2, "angle_sd_deg": None},
        {"what": "joint", "name": "C", "shift_sd_mm": None, "angle_sd_deg": None},
    ]
    summary = {
        "frame_count": 8, "agreeing_count": 7, "unseen": ["3", "4"], "frames": {},
        "findings": [{"text": "t"} | one for one in texts],
        "found_cameras": {"left": camera, "right": camera, "wrist": wrist},
    }  # fmt: skip

    def audit_scene(scene, model, joints, part, settings, **more):
        calls.append(more | {"joints": joints})
        part.mkdir()
        (part / "summary.json").write_text(json.dumps(summary))

    monkeypatch.setattr("drake_pose.jobs.batch_tasks.audit_scene", audit_scene)
    return calls


def test_audits_have_totals_of_their_summaries(scenes, tmp_path, out, audited):
    entry = {"scene": "stills", "audit": "j.csv", "model": "crane.urdf", "overlay": False}
    (job,) = jobs_of(scenes, {"a": entry}, defaults=None)
    (task,) = plan_scene(job, out)
    outcome = perform(dataclasses.replace(task, near=tmp_path))
    assert outcome.error is None, outcome.error
    own = {"cameras": None, "overlay": False, "near": tmp_path, "joints": scenes / "j.csv"}
    assert audited == [own]
    totals = outcome.totals
    assert (totals["frame_count"], totals["agreeing_count"]) == (10, 7)
    assert totals["joint_offsets"] == {"A1": ("deg", 4.0, 0.5), "B": ("mm", 7.0, 0.2)}
    assert [one["name"] for one in totals["findings"]] == ["left", "A1", "B", "C"]
    cameras = totals["cameras"]
    assert [(one["off_mm"], one["off_deg"]) for one in cameras.values()] == [
        (12.0, 3.0), (None, None), (None, None),
    ]  # fmt: skip
    assert cameras["wrist"]["X_WC"] == cameras["left"]["X_WC"] == np.eye(4).tolist()


def test_failures_are_told(scenes, out, monkeypatch):
    (job,) = jobs_of(scenes, STILLS)
    task = plan_scene(job, out)[0]
    for error, text in (
        (ZeroDivisionError("no"), "ZeroDivisionError: no"),
        (SystemExit("q.size() == 7"), "a DRAKE_DEMAND failed in Drake: q.size() == 7"),
        (SettingsError("leave --no-track out"), "leave track: false out"),
    ):

        def fail(*_, error=error, **__):
            raise error

        monkeypatch.setattr("drake_pose.jobs.batch_tasks.estimate_scene", fail)
        assert describe_failure(error) == text
        assert perform(task).error == text

    def elsewhere(*given, **_):
        """As if another worker had finished the task meanwhile, or a file were in the way."""
        finish(task)
        (task.place / "theirs").touch()
        (task.place / "summary.json").write_text("{}")
        given[2].mkdir()

    monkeypatch.setattr("drake_pose.jobs.batch_tasks.estimate_scene", elsewhere)
    assert perform(task).error is None
    assert (task.place / "theirs").exists()
    assert [path.name for path in task.work.iterdir()] == [task.place.name]
