"""What reports of registrations and audits say, against sentences and sizes worked out by hand."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from drake_pose.errors import RegistrationError, UnknownNameError, weight_of
from drake_pose.files.overlay import EXCESS_RGB
from drake_pose.files.settings import RegistrationSettings
from drake_pose.fit.judge import PairedEvidence
from drake_pose.jobs.registration.diagnosis import (
    compare_camera,
    compare_clock,
    lack_of_evidence,
    require_determined,
)
from drake_pose.jobs.registration.register import register_scene
from drake_pose.jobs.registration.tracks import draw_tracks
from drake_pose.jobs.registration.words import (
    common_outlier_warnings,
    describe_common_finding,
    describe_error,
    describe_frame_finding,
    few_frames_warning,
    mode_warnings,
    outlier_warnings,
    zero_warnings,
)
from drake_pose.registration.findings import Finding, FrameDiagnosis
from drake_pose.registration.picture_matches import Sightings
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.recording import Recording, TimeOffset
from drake_pose.registration.register import FrameMisfit, RegisteredCamera, RegistrationBody
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.jobs.registration.arm_scenes import write_arm_scene
from tests.registration.arm_pictures import errors, looking_at, shifted
from tests.search.arms import arm_cameras, arm_tree

DEGREE = np.radians(1.0)


@pytest.mark.parametrize(
    ("kind", "angle", "size", "below", "above"),
    [
        # The correction is to be added, so a positive one means too low, too short or too early.
        ("clock", 0.0, "30 +- 4 ms", "earlier", "later"),
        ("rate", 0.0, "3.00 +- 0.40 percent", "slower", "faster"),
        ("focal", 0.0, "3.0 +- 0.4 percent", "long", "short"),
        ("joint", 0.0, "30.0 +- 4.0 mm", "high", "low"),
        ("joint", 2 * DEGREE, "2.00 +- 1.00 degrees", "high", "low"),
    ],
)
def test_size_and_sign_of_an_error_are_told(kind, angle, size, below, above) -> None:
    deviations = (DEGREE, 0.0) if angle else (0.0, 0.004)
    for sign, word in ((1.0, above), (-1.0, below)):
        shift = 0.0 if angle else sign * 0.03
        one = Finding(kind, "a", sign * angle, shift, *deviations, 0.0, 0.0)
        assert re.search(rf"{re.escape(size)} .*{word}", describe_error(one))


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"kind": "sign", "link": "arm", "text": "so"}, "'a' .* other sign .*'arm' .*so, .* 2.5"),
        ({"kind": "log", "link": "arm", "text": "so"}, "'arm' .*'a' differs .*, so, .* 2.5"),
        ({"kind": "link", "link": "arm", "text": "so"}, "'arm' is not where the log says: so$"),
        ({"kind": "refused", "text": "so"}, "^so$"),
        ({"kind": "reading", "pixels": 0.0}, "^a$"),
        ({"kind": "moved", "text": "so", "angle": DEGREE}, "'a' so, .* turns of 1.00 .* 2.5"),
        ({"kind": "moved", "link": "base", "angle_sd": DEGREE}, "^the base was moved .* is off by"),
        ({"kind": "moved", "link": "camera", "shift_sd": 0.1}, "^camera 'a' was moved .* 100"),
        ({"kind": "camera", "shift": 0.03, "shift_sd": 0.004, "at_body": 0.01, "text": "; so",
          "alternatives": ("base",)}, r"'a' \(or base: .* off by 30.0 \+- 4.0 mm \(10.0 .*; so$"),
        ({"kind": "center", "shift": 3.0, "shift_sd": 0.4}, r"the a: off by 3.0 \+- 0.4 px in all"),
        ({"kind": "length", "shift": -0.1, "shift_sd": 0.01}, r"link 'a' is 10.0 \+- 1.0 .* long"),
    ],
)  # fmt: skip
def test_errors_of_all_frames_are_told(fields, said) -> None:
    one = Finding(**({"kind": "", "name": "a", "pixels": 2.5} | fields))
    assert re.search(said, describe_common_finding(one))


def test_errors_of_single_frames_are_told() -> None:
    frame = FrameDiagnosis("7", {"left": 0.4, "right": 0.2}, {"left": 0.4, "right": 0.2}, 1.0, None)
    for fields, said in (
        ({"kind": "unexplained"}, "camera 'right' 20.00 % of the contours"),
        ({"kind": "unexplained", "text": "so"}, "^so$"),
        ({"kind": "joint", "angle": -11 * DEGREE}, "'a' reads more than 10 degrees too high"),
        ({"kind": "joint", "angle": 9 * DEGREE, "angle_sd": DEGREE}, "'a' reads 9.00 .* too low"),
        ({"kind": "joints", "joints": {"b": 0.1, "c": -0.3}}, r"\(c, b most\), .* 2.5 pixels"),
        ({"kind": "joints"}, "other joint positions than given, which"),
    ):
        one = Finding(**({"kind": "", "name": "a", "pixels": 2.5} | fields))
        assert re.search(said, describe_frame_finding(frame, one))


def test_outliers_are_told_with_their_suspects() -> None:
    found = registered(0.9, 0.9, 0.9, -0.2, -0.2)
    for from_pictures, misplaced, said in (
        (False, (), "2 of 5 .* 3-4; .* explain 3-4: check their masks .* moved after frame '2'"),
        (True, ("3",), "explain 4: check what hides .* other frames explain 3 better"),
        (True, ("3", "4"), "count: 3-4; the joint positions of other frames explain 3-4 better"),
    ):
        (text,) = outlier_warnings(found, from_pictures, misplaced)
        assert re.search(said, text)
        assert weight_of(text) == "check"
    (text,) = outlier_warnings(registered(0.9, 0.9, -0.2, E=np.nan), True)
    assert "few points of the scene fit" in text
    assert "moved" not in text
    half = registered(0.9, 0.9, -0.2, -0.2)
    with pytest.raises(RegistrationError, match=r"half .* 2 of 4: 2-3.*the others, 0-1,"):
        outlier_warnings(half)
    (text,) = outlier_warnings(half, True)
    assert weight_of(text) == "wrong"
    assert "AGREE, 2 of 4: 0-1" in text
    assert outlier_warnings(registered(0.9)) == []
    for evidence, needed in ((None, 6), (PairedEvidence(0.5, 0.4, 0.02, 0.004, 6, 9), 9)):
        assert few_frames_warning(registered(0.9, evidence=evidence)).endswith(f" takes {needed}")


def registered(*agreeing: float, E: float = 0.1, **more: Any) -> RegisteredCamera:
    """Return a camera with frames of these inlier ratios; negative: an outlier's."""
    frames = tuple(
        FrameMisfit(f"{k}", E, 1.0 - E, abs(ratio), ratio >= 0.0)
        for k, ratio in enumerate(agreeing)
    )
    return RegisteredCamera(arm_cameras()[0], 1e-6 * np.eye(6), frames, **more)


def test_frames_that_fit_other_rows_are_no_evidence() -> None:
    """With too few frames for the judge, they must fit better than with random rows."""
    fits, frames = np.ones((1, 9, 9)), [PosedFrame("0", np.zeros(2), np.ones((4, 4), bool))]
    chance = registered(0.4, costs=3.0 * fits)
    search = SimpleNamespace(
        kinematics=SimpleNamespace(
            names=("a", "b"),
            lower=np.array([-np.inf, 0.1]),
            upper=np.array([np.inf, 0.1]),
            is_angle=np.ones(2, bool),
        )
    )
    search.rough = lambda: search
    search.register = lambda camera, frames: chance
    assert lack_of_evidence(search, registered(0.9, costs=fits), frames) is None
    assert "drawn at random" in lack_of_evidence(search, chance, frames)
    for p_value, needed, agrees, said in (
        (0.02, 5, True, "p-value 0.02"), (0.02, 6, True, ""), (0.004, 5, True, ""),
        (0.004, 5, False, "half of the frames"),
    ):  # fmt: skip
        evidence = PairedEvidence(0.5, 0.4, p_value, 0.004, 6, needed)
        found = registered(0.9, costs=fits, evidence=evidence, agrees=agrees)
        assert said in (told := lack_of_evidence(search, found, frames) or "")
        assert bool(told) == bool(said)


@pytest.mark.parametrize(
    ("left", "right", "misplaced", "said"),
    [
        # 1: an inlier, 0: an outlier.
        ("1000", "101", "", ["frames 1 .* all cameras.*masks", "frames 2 .* in camera 'left'"]),
        ("1000", "101", "1", ["frames 1 .* all cameras.*correct theirs", "frames 2 .*'left'"]),
        ("11101", "11111", "", ["frames 3 .*'left'.* are right"]),
        ("11101", "11111", "3", ["frames 3 .*'left'.*correct theirs"]),
        ("11100", "00011", "", ["no common frame: 'left' .*0-2, 'right' .*3-4", "", ""]),
        ("1000", "", "", []),
    ],
)
def test_outliers_of_several_cameras_are_distinguished(left, right, misplaced, said) -> None:
    cameras = []
    for name, agreeing in (("left", left), ("right", right)):
        one = registered(*(0.9 if k == "1" else -0.9 for k in agreeing))
        cameras.append(replace(one, camera=replace(one.camera, name=name)))
    texts = common_outlier_warnings(cameras if right else cameras[:1], misplaced=misplaced)
    for part, text in zip(said, texts, strict=True):
        assert re.search(part, text)


def test_wrong_rows_are_told_from_bad_masks(tmp_path: Path) -> None:
    """Frames 2 and 6 have each other's positions; of frame 4 half the mask is missing."""
    scene = write_arm_scene(tmp_path, count=12, seed=3)
    rows = scene.rows()
    rows[3][1:], rows[7][1:] = rows[7][1:], rows[3][1:]
    scene.write_rows(rows)
    path = scene.folder / "masks" / "left" / "0004.png"
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    mask[:, : int(np.median(np.nonzero(mask)[1]))] = 0
    cv2.imwrite(str(path), mask)
    told, *_ = register_scene(scene.folder, scene.model, scene.joints).warnings
    assert "explain 0004: check their masks" in told
    assert "explain 0002, 0006 better: are their joint positions" in told


@pytest.mark.parametrize("without", [(), ("hand",)])
def test_what_does_not_look_like_the_model_is_named_or_left_out(arm_scene, tmp_path, without):
    """The model has another hand, to which a tip is welded."""
    hand, text = '<box size="0.05 0.1 0.15"/>', arm_scene.model.read_text()
    assert text.count(hand) == 1
    tip = '<link name="tip"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>'
    tip += '<joint name="weld" type="fixed"><parent link="hand"/><child link="tip"/></joint>'
    other = text.replace(hand, '<box size="0.3 0.03 0.1"/>').replace("</robot>", f"{tip}</robot>")
    (model := tmp_path / "other.urdf").write_text(other)
    run = partial(register_scene, arm_scene.folder, model, arm_scene.joints)
    found = run(settings=RegistrationSettings(without=without))
    texts = [one for one in found.warnings if "of the contour of link" in one]
    assert any("'hand' (with tip)" in one for one in texts) == bool(texts) == (not without)
    off = errors(found.cameras["left"].X_WC, arm_scene.cameras["left"].X_WC)
    assert max(off) < 0.01
    with pytest.raises(UnknownNameError, match="gripper"):
        run(settings=RegistrationSettings(without=("gripper",)))


def test_poses_that_are_not_determined_are_refused() -> None:
    """By the largest deviation about, or along, any axis."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for turned, moved, told in (
        (0.039, 0.039, None), (0.05, 0.01, "of 2.9 degrees and 10 mm"), (0.01, 0.05, "and 50 mm"),
    ):  # fmt: skip
        C = np.zeros((6, 6))
        C[:3, :3] = turn @ np.diag([1e-6, turned**2, 1e-6]) @ turn.T
        C[3:, 3:] = turn @ np.diag([1e-6, 1e-6, moved**2]) @ turn.T
        one = replace(registered(0.9, 0.9), covariance=C)
        if told is None:
            require_determined(one)
            continue
        with pytest.raises(RegistrationError, match=told):
            require_determined(one)


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> RegistrationBody:
    return RegistrationBody(arm_tree(tmp_path_factory.mktemp("arm")))


def test_a_given_camera_is_compared_by_its_covariance(body: RegistrationBody) -> None:
    """The motion is that of points of the robot in its pictures, clipped at a diagonal."""
    given = arm_cameras()[0]
    found = replace(registered(0.9, 0.9), camera=shifted(given, 0.003, 0.0, 0.004))
    values = np.array([[0.1, 0.2, 0.3, 0.4, 0.5], [0.5, 0.0, 0.0, 0.3, 0.1]])
    for alone in (True, False):
        one = compare_camera(body, given, found, values, alone)
        assert (one.kind, one.name, one.text) == ("camera", "left", "")
        assert one.shift == pytest.approx(0.005)
        assert one.angle == pytest.approx(0.0, abs=1e-9)
        assert (one.angle_sd, one.shift_sd) == pytest.approx((1e-3, 1e-3))
        assert one.p_value == pytest.approx(chi2.sf(25.0, 6))
        assert one.alternatives == (("base",) if alone else ())
    shifts = []
    for row in values:
        for outline, X in zip(body.coarse, body.kinematics.poses(row), strict=True):
            p = outline.vertices @ X[:3, :3].T + X[:3, 3]
            shifts.append(found.camera.project(p)[0] - given.project(p)[0])
    expected = np.sqrt((np.concatenate(shifts) ** 2).sum(axis=1).mean())
    assert one.pixels == pytest.approx(expected)
    away = given.X_WC.copy()
    away[:3, 3] *= 1e3
    far = compare_camera(body, given.with_pose(away), found, values, True)
    assert far.pixels <= np.hypot(320, 240)
    assert "in millimetres" in far.text
    assert far.alternatives == ()


@pytest.mark.parametrize(
    ("value", "sd", "drift", "drift_sd", "kinds"),
    [
        (0.05, 0.002, 0.0, np.inf, ["clock"]),
        (0.05, 0.02, 0.0, np.inf, []),
        (0.0001, 1e-5, 0.0, np.inf, []),
        (0.0, np.inf, 0.0, np.inf, []),
        (0.3, 0.001, 0.05, 0.002, ["clock", "rate"]),
        # At the first picture there is no offset: it has grown since.
        (0.125, 0.001, 0.05, 0.002, ["rate"]),
    ],
)
def test_clocks_are_compared_at_the_first_picture(body, value, sd, drift, drift_sd, kinds):
    times = 10.0 + np.arange(6.0)

    def values_at(offset: float) -> np.ndarray:
        return np.outer(np.sin(times + offset), [1.0, 0.5, 0.3, 0.4, 0.2])

    names = tuple("012345")
    recording = Recording(names, values_at, lambda k: np.zeros((1, 1, 3)), times)
    clock = TimeOffset(value, sd, np.zeros((0, 2)), drift, drift_sd)
    result = SimpleNamespace(
        time_offset=clock, found=registered(0.9), recording=recording,
        frames=[SimpleNamespace(name=name) for name in names],
    )  # fmt: skip
    found = compare_clock(body, result, recording)
    assert [one.kind for one in found] == kinds
    for one in found:
        size, deviation, floor = drift, drift_sd, 0.0
        if one.kind == "clock":
            size, floor = value - 2.5 * drift, 0.002
            deviation = np.hypot(sd, 2.5 * drift_sd if drift else 0.0)
        assert (one.shift, one.shift_sd) == pytest.approx((size, deviation))
        assert one.p_value == pytest.approx(chi2.sf(size**2 / (deviation**2 + floor**2), 1))
        assert one.pixels > 0.3
    result.time_offset = None
    assert compare_clock(body, result, recording) == []


def test_points_are_drawn_in_the_worst_pictures(tmp_path: Any) -> None:
    seen = Sightings(
        np.array([0, 1, 1]), np.array([0, 0, 1]), np.array([[5.0, 6.0], [20, 9], [9, 20]])
    )
    tracked = SimpleNamespace(
        found=registered(0.9, 0.2, 0.6), seen=seen, inliers=np.array([True, True, False]),
        pictures={f"{k}": np.zeros((30, 40, 3), np.uint8) for k in range(3)},
    )  # fmt: skip
    draw_tracks(tmp_path, tracked)
    pictures = {
        path.stem: cv2.imread(str(path))[..., ::-1] for path in tmp_path.glob("overlay/left/*.png")
    }
    assert sorted(pictures) == ["0", "1", "2"]
    blue, orange = (0, 114, 178), EXCESS_RGB
    for name, uv, colour in (("0", (5, 6), blue), ("1", (20, 9), blue), ("1", (9, 20), orange)):
        ring = pictures[name][uv[1], uv[0] - 4]
        assert np.abs(ring.astype(int) - colour).max() < 60
        assert not pictures[name][uv[1], uv[0]].any()
    assert not pictures["2"].any()


def test_a_zero_that_nothing_shows_is_named(body: RegistrationBody) -> None:
    """A first joint, if half a degree of it is within the camera's standard deviation."""
    rng, names = np.random.default_rng(3), body.kinematics.names
    frames = [PosedFrame(f"{k}", rng.normal(size=len(names)), np.ones((2, 2), bool)) for k in "ab"]
    known, found = registered(), replace(registered(), covariance=np.eye(6))
    assert zero_warnings(body, known, frames) == []
    (text,) = zero_warnings(body, found, frames)
    assert re.search(rf"'left'.* zero of joint '{names[0]}'.* --zeros {names[0]} ", text)


def test_several_poses_name_the_joint_that_tells_them_apart_best(body: RegistrationBody) -> None:
    """From front and back the arm's zero pose looks the same, except for its boxes."""
    front, back = (
        looking_at(np.array([x, 0.0, 0.4]), np.array([0.0, 0.0, 0.4]), 0.0) for x in (1.8, -1.8)
    )
    kinematics, model = body.kinematics, body.tree.model
    frame = PosedFrame("7", np.zeros(len(kinematics.names)), np.ones((480, 640), bool))
    found = RegisteredCamera(front, np.eye(6), (), np.array([back.X_WC]))
    sizes = {}
    for k, name in enumerate(kinematics.names):
        for end in (kinematics.lower[k], kinematics.upper[k]):
            values = frame.values.copy()
            values[k] = np.clip(end, -np.pi, np.pi)
            q, X_WB = body.tree.positions_from(kinematics.split(values))
            a, b = (LabelRenderer(model, camera).mask(q, X_WB) for camera in (front, back))
            sizes[name, f"{np.degrees(values[k]):.0f}"] = 2.0 * (a ^ b).sum() / (a.sum() + b.sum())
    (name, degrees), size = max(sizes.items(), key=lambda item: item[1])
    (text,) = mode_warnings(body, found, [frame])
    said = rf"'eye': 1 .* joint '{name}' moves: at {degrees} degrees, .* '7', .* by (.*) %"
    assert float(re.search(said, text).group(1)) == pytest.approx(100.0 * size, abs=2.0)
    assert size > 0.3
    assert "add frames" in mode_warnings(body, found, [])[0]
    assert mode_warnings(body, replace(found, alternatives=np.zeros((0, 4, 4))), [frame]) == []
