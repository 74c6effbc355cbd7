"""First contact: public names, help texts, and errors for single values given as collections."""

from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import drake_pose
from drake_pose import (
    MultiStartSearch,
    PinholeCamera,
    SilhouetteMatcher,
    TruncatedEkf,
    TruncatedFilter,
    View,
    bundled_model,
    load_model,
    look_at,
    save_cameras,
)
from drake_pose.camera.episode import JointLog
from drake_pose.camera.servo_readings import Column
from drake_pose.errors import CameraError, SettingsError, for_caller, messages_for, noted_warnings
from drake_pose.jobs.batch_tasks import describe_failure
from drake_pose.jobs.registration.positions import still_joints
from drake_pose.registration.register import RegistrationBody

ROOT = Path(__file__).resolve().parents[1]
CAMERA = PinholeCamera("c", 64, 48, 60.0, 60.0, 32.0, 24.0, look_at([3, 0, 1], [0, 0, 1]))


@pytest.fixture(scope="module")
def model():
    return load_model(bundled_model("two_finger_hand"), check=False)


def test_every_public_name_can_be_imported():
    assert None not in [getattr(drake_pose, name) for name in drake_pose.__all__]


def test_a_model_a_camera_or_a_tuple_where_others_are_expected_is_refused(model, tmp_path):
    search, view = MultiStartSearch(model.pose_tree()), View(CAMERA, np.ones((48, 64), bool))
    a_model, a_camera = r"model\.pose_tree\(\).*ArticulatedModel, '", "one camera where"
    start, filtered = (np.zeros(3), np.eye(3)), object.__new__(TruncatedFilter)
    for words, call in (
        (a_model, lambda: MultiStartSearch(model)),
        (a_model, lambda: RegistrationBody(model)),
        (a_camera, lambda: SilhouetteMatcher(search, CAMERA, 1.0)),
        (a_camera, lambda: save_cameras(tmp_path / "cameras.yaml", CAMERA)),
        (r"\[view\]", lambda: search.match(view)),
        ("start must be a Belief.*not a tuple", lambda: TruncatedEkf(filtered, start, 0.1)),
    ):
        with pytest.raises((CameraError, SettingsError), match=words):
            call()


MESSAGES = (
    ("name those: --camera NAME", "name those: cameras=NAME", "name those: cameras: NAME"),
    (
        "(--joints FILE): --hold elbow=VALUE", "(joints=FILE): hold={'elbow': VALUE}",
        "(audit: FILE): hold: {elbow: VALUE}",
    ),
    ("(--zeros all)?", "(zeros='all')?", None),
    ("leave --no-track out (--joint-map)", "leave track=False out (joint_map)", None),
    ("(--cameras FILE)", None, "(camera_file: FILE)"),
    ("(drake-pose masks --largest) or --out", "(drake-pose masks --largest) or out", None),
    ("(drake-pose register --zeros all)", None, "(drake-pose register --zeros all)"),
)  # fmt: skip


@pytest.mark.parametrize(("cli_text", "python_text", "job_text"), MESSAGES)
def test_messages_name_arguments_options_or_keys(cli_text, python_text, job_text):
    """In Python, on the command line, and in a batch, whose settings are in a job file."""
    with messages_for("command line"):
        assert for_caller(cli_text) == cli_text
        with messages_for("job file"):
            assert job_text is None or for_caller(cli_text) == job_text
    assert python_text is None or for_caller(cli_text) == python_text


def test_an_error_carries_what_was_assumed_before():
    """Warnings of a result that was refused are printed, too."""
    error = CameraError("lost")
    with suppress(CameraError), noted_warnings() as noted:
        noted += ["readings were taken for degrees", "readings were taken for degrees"]
        raise error
    assert error.__notes__ == ["warning: readings were taken for degrees"]
    assert describe_failure(error) == "lost; warning: readings were taken for degrees"


def test_joints_that_stand_still_while_others_move_are_named():
    """But not a gripper, which may stay as it is."""
    names = ("j0", "j1", "j2", "j3")
    kinds = ("angle", "angle", "angle", "length")
    model = SimpleNamespace(position_kinds=kinds, position_index=names.index)
    for ranges, told in (
        ([0.5, 1.0, 0.0, 0.7], "joint 'j2' reads 0.5 in all rows"), ([0.5, 0.0, 0.0, 0.7], None),
        ([0.5, 1.0, 1e-3, 0.7], None), ([0.5, 1.0, 0.7, 0.0], None),
    ):  # fmt: skip
        rows = np.linspace(0.0, 1.0, 9)[:, None] * ranges + 0.5
        log = JointLog(names, None, rows, columns=dict.fromkeys(names, Column("")))
        texts = still_joints(log, model)
        assert [text.startswith(str(told)) for text in texts] == [True] * (told is not None)
