"""Commands hand their options to jobs and print what these return."""

from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.errors import weighted
from drake_pose.files.settings import EstimateSettings, LiveSettings, MaskSettings
from tests.cli import run_command, run_json, run_to_end

RECORD = SimpleNamespace(q=np.array([np.pi / 2, 0.25]))


@pytest.fixture
def jobs(monkeypatch, tmp_path):
    """Stand in for all jobs; their calls by name, and what they return."""
    errors = {"lift": {"mean": 1.25, "largest": 2.0}, "slide": {"mean": 0.01, "largest": 0.02}}
    summary = {
        "joint_errors": errors, "findings": [], "found_cameras": {"a": 1, "b": 2},
        "agreeing_count": 3, "frame_count": 4, "nothing": np.nan,
        "sources": {"a": {"used": 7, "dropped": 8, "late": 9, "changes": [
            {"what": "stopped", "time": 1.5}, {"what": "returned", "time": None}]}},
        "cameras": {"": {"0": {"area": 5}, "1": {"area": 9}, "2": {"refusal": "x"}}},
    }  # fmt: skip
    result = SimpleNamespace(
        warnings=("odd", weighted("bad", "wrong")), summary=summary, folder=None, found_count=1,
        position_names=("lift", "slide"), position_kinds=("angle", "length"),
        records={"0": RECORD}, answer="Audited.", refused={}, registered=("a",), live=False,
        interrupted=False,
    )  # fmt: skip
    calls = {}

    def stand_in(place, name, answer):
        def job(*given, **more):
            calls[name] = given, more
            return answer() if callable(answer) else answer

        monkeypatch.setattr(f"drake_pose.{place}.{name}", job)

    table = SimpleNamespace(head=["h"], rows=[["r"]], closed="")
    specification = SimpleNamespace(specifications={"a": result})
    for place, name, answer in (
        ("jobs.estimate.scene", "estimate_scene", result), ("jobs.demo", "run_demo", result),
        ("jobs.registration.register", "register_scene", result),
        ("jobs.masks", "make_masks", result),
        ("jobs.registration.audit", "audit_scene", result),
        ("files.page", "estimate_answer", ("Found.", [])),
        ("jobs.registration.pages", "registration_answer", "Registered."),
        ("jobs.registration.pages", "camera_table", table),
        ("jobs.registration.pages", "robot_tables", []),
        ("jobs.live", "load_live_scene", specification),
        ("jobs.live", "capture_live", lambda: (result, result.interrupted, ("late",))),
        ("jobs.live", "take_empty_room", {"a": tmp_path}),
    ):  # fmt: skip
        stand_in(place, name, answer)
    return calls, result


def test_options_have_the_defaults_that_the_help_says(jobs, tmp_path):
    calls, _ = jobs
    plain = ["scene", "--model", "m", "--out", tmp_path / "a"]
    for command, name, on in (
        ("estimate", "estimate_scene", {"overlay": True, "replay": True, "resume": False}),
        ("register", "register_scene", {"overlay": True}),
        ("audit", "audit_scene", {"overlay": True}),
    ):  # fmt: skip
        run_to_end(command, *plain)
        assert {key: calls[name][1][key] for key in on} == on
        assert calls[name][1]["cameras"] is None
        off = [f"--no-{key}" if value else f"--{key}" for key, value in on.items()]
        run_to_end(command, *plain, *off, "--cameras", "c.yaml")
        assert {key: calls[name][1][key] for key in on} == {key: not one for key, one in on.items()}
        assert calls[name][1]["cameras"].name == "c.yaml"
    run_to_end("masks", "scene", "--out", tmp_path, "--largest", "--no-overlay")
    assert calls["make_masks"][0][2] == MaskSettings(largest=True)
    assert calls["make_masks"][1]["overlay"] is False
    run_to_end("empty-room", tmp_path, "--pictures", "4")
    assert calls["take_empty_room"][0] == (tmp_path, 4)
    for words in (["empty-room", tmp_path, "--pictures", "0"], ["batch", "j", "--workers", "-1"]):
        assert run_command([str(word) for word in words]).exit_code == 2


def test_results_are_printed_as_tables_or_json(jobs, tmp_path):
    plain = ["scene", "--model", "m", "--out", tmp_path]
    done = run_to_end("estimate", *plain)
    assert (
        done.stderr == "drake-pose: warning: odd\ndrake-pose: warning: wrong answer likely: bad\n"
    )
    for text in ("Found.", "1.2 deg", "2.0 deg", "0.010 m", "0.020 m"):
        assert text in done.stdout
    printed = run_json("estimate", *plain)
    assert (printed["agreeing_count"], printed["nothing"]) == (3, None)
    shown = run_to_end("demo", "--out", tmp_path).stdout
    assert "90.0 deg" in shown
    assert "0.250 m" in shown
    assert "Registered." in run_to_end("register", *plain).stdout
    shown = run_to_end("audit", *plain).stdout
    assert "Audited." in shown
    assert "3 of 4 frames are consistent" in shown
    shown = run_to_end("masks", "a", "--out", tmp_path).stdout
    assert "camera               2 masks of 3 pictures, 5 to 9 pixels" in shown


def test_commands_fail_where_nothing_was_found(jobs, tmp_path):
    _, result = jobs
    plain = ["scene", "--model", "m", "--out", str(tmp_path)]
    result.found_count, result.refused = 0, {"b": "why"}
    result.summary["findings"] = [{"what": "refused", "name": "b", "text": "why"}]
    for words, text in (
        (["estimate", *plain], "no pose was found in any frame"), (["demo"], "no pose was found"),
        (["register", *plain], "1 of 2 cameras refused: b"),
        (["audit", *plain], "1 of 3 cameras refused: b"),
    ):  # fmt: skip
        done = run_command(words)
        assert done.exit_code == 1
        assert text in done.stderr


def test_a_capture_is_an_estimate_of_masks_or_live(jobs, tmp_path):
    calls, result = jobs
    words = ["capture", tmp_path, "--out", tmp_path / "out"]
    done = run_to_end(*words, "--frame", "1", "--no-overlay")
    (scene, model, out, settings), more = calls["estimate_scene"]
    assert (scene, model.name, out) == (tmp_path, "person_shape.urdf", tmp_path / "out")
    assert settings == EstimateSettings(method="person", frames=("1",))
    assert (more["overlay"], more["replay"], more["resume"]) == (False, True, False)
    usage = (
        ["--seconds", "3"], ["--face-camera", "a", "--faces", "f"],
        ["--method", "paper", "--resume"], ["--method", "paper", "--frame", "3"],
    )  # fmt: skip
    for wrong in usage:
        assert run_command([str(word) for word in (*words, *wrong)]).exit_code == 2
    (tmp_path / "sources.yaml").touch()
    for wrong in (["--frame", "3"], ["--resume"], *usage[1:]):
        assert run_command([str(word) for word in (*words, *wrong)]).exit_code == 2
    done = run_to_end(*words, "--seconds", "3", "--package", f"a={tmp_path}")
    given, more = calls["capture_live"]
    assert given[1:] == (tmp_path / "out", None, LiveSettings(seconds=3.0), "person")
    assert (more["replay"], [*more["packages"]]) == (True, ["a"])
    assert "stopped at 1.50 s, gave none" in done.stdout
    assert "late" in done.stderr
    assert "Ctrl-C" not in done.stderr
    assert "stand upright" not in done.stderr
    result.live = result.interrupted = True
    done = run_to_end(*words, "--method", "paper", "--json")
    assert "stand upright" in done.stderr
    assert "stopped by Ctrl-C" in done.stderr
    assert '"frame_count": 4' in done.stdout
    for change, text in (("found_count", "no person was found"), ("records", "gave a picture")):
        setattr(result, change, 0)
        assert text in run_to_end(*words, status=1).stderr
