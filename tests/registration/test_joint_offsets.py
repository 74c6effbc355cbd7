"""Calibration of joint offsets and link scales."""

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, UnknownNameError
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.jobs.registration.words import likely_offset_warnings
from drake_pose.registration.hand_eye import motion
from drake_pose.registration.joint_offsets import (
    _unknown_rotations,
    ambiguous_constants,
    calibrate_joints,
    fit_cameras_alone,
    require_fit_kept,
    require_frame_count,
    shrink_constants,
    shrink_measured,
    unseen_rotations,
)
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import CameraSearch, RegisteredCamera
from drake_pose.registration.shared_fit import SHARED, SharedFit, SharedValues
from tests.registration.arm_pictures import MIDDLE, PLACE, errors, looking_at, see
from tests.search.arms import LINKS

NAMES = ("shoulder_turn", "roll_turn", "elbow_turn")


ELBOW = {"elbow_turn": np.radians(2.0)}


def misread(frames: list[PosedFrame], zeros: dict[str, float]) -> list[PosedFrame]:
    """Return frames as encoders read them that lack offsets by joint."""
    off = np.array([zeros.get(f"{name}_turn", 0.0) for name, *_ in LINKS])
    return [PosedFrame(one.name, one.values - off, one.mask) for one in frames]


def known(camera: PinholeCamera) -> RegisteredCamera:
    return RegisteredCamera(camera, 1e-6 * np.eye(6), ())


@pytest.fixture(scope="module")
def camera() -> PinholeCamera:
    return looking_at(PLACE, MIDDLE, 0.1)


class TestCalibrateJoints:
    @pytest.mark.parametrize("off", [np.radians([2.0, 0.0, -2.0]), np.zeros(3)])
    def test_offsets_are_estimated(self, model, body, camera, off: np.ndarray) -> None:
        frames = misread(see(model, body, camera, 4, 4), dict(zip(NAMES, off, strict=True)))
        registered = known(camera)
        found = calibrate_joints(body, [registered], [frames], NAMES)
        for zero, true in zip(found.offsets, off, strict=True):
            assert zero.value == pytest.approx(true, abs=np.radians(0.2))
            assert abs(zero.value - true) < 4.0 * zero.deviation
            assert zero.significant == (true != 0.0)
            assert zero.low <= zero.value <= zero.high
        shift, turn = errors(found.cameras[0].X_WC, camera.X_WC)
        assert shift < 3e-3
        assert turn < np.radians(0.15)

    @pytest.mark.slow
    def test_cameras_share_offsets_and_link_scales(self, model, body) -> None:
        """Two cameras together estimate a robot's offset better than each alone."""
        places = (np.array([1.6, 0.4, 0.5]), np.array([0.3, -1.6, 0.7]))
        registered, frames, alone = [], [], []
        for seed, place in enumerate(places):
            camera = replace(looking_at(place, MIDDLE, 0.1), name=f"eye {seed}")
            frames.append(misread(see(model, body, camera, 4, seed), ELBOW))
            registered.append(CameraSearch(body).refine(camera, frames[-1]))
            alone.append(calibrate_joints(body, registered[-1:], frames[-1:], ["elbow_turn"]))
        found = calibrate_joints(
            body, registered, frames, ["elbow_turn"], links=["shoulder", "elbow"]
        )
        (zero,) = found.offsets
        assert zero.low < np.radians(2.0) < zero.high
        assert zero.significant
        assert zero.deviation < max(one.offsets[0].deviation for one in alone)
        for one in found.link_scales:
            assert one.low < 0.0 < one.high
            assert not one.significant
        for camera, place in zip(found.cameras, places, strict=True):
            shift, turn = errors(camera.X_WC, looking_at(place, MIDDLE, 0.1).X_WC)
            assert shift < 4e-3
            assert turn < np.radians(0.15)

    def test_an_unobservable_offset_is_listed_with_its_gauge(self, model, body, camera):
        """All visible parts of this arm move with its first joint."""
        frames = see(model, body, camera, 3, 4)
        found = calibrate_joints(body, [known(camera)], [frames], ["turret_turn"])
        assert not found.offsets[0].determined
        assert not found.offsets[0].significant
        assert any("turn" in name or "shift" in name for name in found.offsets[0].gauge)

    def test_wrong_names_and_too_few_frames_are_refused(self, model, body, camera) -> None:
        frames, registered = see(model, body, camera, 1, 4), known(camera)
        for error, said, joints, links in (
            (UnknownNameError, "knee", ["knee"], []),
            (UnknownNameError, r"'hand'.*turret", [], ["hand"]),
            (RegistrationError, "more frames", NAMES, []),
        ):
            with pytest.raises(error, match=said):
                calibrate_joints(body, [registered], [frames], joints, links=links)


def test_cost_curvature_matches_normal_equations_and_cost_differences(model, body, camera) -> None:
    frames = see(model, body, camera, 4, 4)
    seen = PosedFrames(body.kinematics, body.full, camera, frames)
    fit = SharedFit([seen], [camera.X_CW], ["elbow_turn"])
    by = np.append(np.zeros(6), np.radians(0.1))
    step = AnnealingStage(0.005, 0.005)
    bends, said = fit.cost_curvature(fit.start, by, step)
    assert said > 0.0
    assert bends == pytest.approx(said, rel=0.5)
    # Second differences of the cost, without the prior.
    less, here, more = (
        fit.equations(fit.start._replace(shared=sign * by), step).cost for sign in (-1.0, 0.0, 1.0)
    )
    known = (by[-1] / SHARED.constant_deviation) ** 2
    assert bends == pytest.approx(0.5 * (more + less) - here - known, rel=0.2)


@pytest.mark.parametrize("degrees", [3.0, -3.0, 0.0, 0.4])
def test_a_missing_offset_is_suspected_from_common_residuals(model, body, camera, degrees):
    """The camera absorbs the offset, and its standard deviation does not show that."""
    frames = misread(see(model, body, camera, 6, 4), {"elbow_turn": np.radians(degrees)})
    found = CameraSearch(body).refine(camera, frames)
    texts = likely_offset_warnings(body, found, frames)
    assert len(texts) == (abs(degrees) > 1.0)
    word = "low" if degrees > 0.0 else "high"
    for text in texts:
        assert re.search(rf"'elbow_turn' reads [23]\.\d+ .* {word};.*--zeros all", text)


@pytest.mark.parametrize(
    ("size", "least", "most"), [(0.0, 0.0, 0.3), (0.01, 0.3, 0.8), (0.15, 0.9, 1.05)]
)
def test_shrinkage_reduces_the_mean_squared_error(size: float, least: float, most: float) -> None:
    """Monte Carlo, against the unshrunk errors of six offsets and of a pose."""
    rng, names = np.random.default_rng(2), tuple("abcdef")
    kinematics = SimpleNamespace(names=names, is_angle=np.ones(6, bool))
    fit = SimpleNamespace(names=("pose", *names), views=[SimpleNamespace(kinematics=kinematics)])
    # The pose absorbs the error of the first offset.
    A = np.diag([0.002, *([0.01] * 6)])
    A[0, 1] = -0.02
    errors = []
    for _ in range(200):
        true = np.append(0.0, size * rng.normal(size=6))
        seen = true + A @ rng.normal(size=7)
        drawn = shrink_constants(fit, SharedValues(seen, np.zeros(0)), A @ A.T, names)
        errors.append([np.square(drawn - true), np.square(seen - true)])
    after, before = np.mean(errors, axis=0)
    for ratio in (after[0] / before[0], after[1:].sum() / before[1:].sum()):
        assert least <= ratio < most


def test_first_offsets_that_no_edges_determine_are_not_fitted(model, body, camera) -> None:
    frames = see(model, body, camera, 4, 6)
    views = [PosedFrames(body.kinematics, body.full, camera, frames)]
    first, second = body.kinematics.names[:2]
    unknown = unseen_rotations({first: (0.2, 0.3), second: (0.1, 0.01)}, views)
    assert [*unknown] == [first]
    assert not unknown[first].determined
    assert f"{camera.name}.turn_y" in unknown[first].gauge


def test_a_significant_offset_never_has_zero_in_its_interval(model, body, camera) -> None:
    """Masks show an offset of 2 degrees that edges contradict."""
    frames = misread(see(model, body, camera, 4, 4), ELBOW)
    how = body, [known(camera)], [frames], NAMES
    elbow = calibrate_joints(*how).offsets[2]
    assert elbow.significant
    contradicted = calibrate_joints(*how, static={"elbow_turn": (0.0, 0.001)}).offsets[2]
    assert contradicted.deviation > 2.0 * elbow.deviation
    assert contradicted.low < 0.0 < contradicted.high
    assert not contradicted.significant


def test_cameras_follow_held_constants_back_to_the_contours(model, body, camera) -> None:
    """A camera that a wrong covariance moved returns; the constants stay."""
    frames = see(model, body, camera, 4, 6)
    views = [PosedFrames(body.kinematics, body.full, camera, frames)]
    fit = SharedFit(views, [camera.X_CW], NAMES)
    shared = np.zeros(len(fit.names))
    shared[:6] = [0.012, -0.009, 0.006, 0.009, -0.006, 0.03]
    moved = fit.start._replace(shared=shared)
    found = fit_cameras_alone(fit, moved, np.ones(len(frames), bool))
    assert fit.inlier_ratios(found).mean() > fit.inlier_ratios(moved).mean() + 0.1
    shift, turn = errors(fit.cameras(found)[0].X_WC, camera.X_WC)
    assert shift < 2e-3
    assert turn < np.radians(0.1)
    np.testing.assert_array_equal(found.shared[6:], 0.0)


@pytest.mark.parametrize("value", [0.02, 0.3])
def test_a_measured_constant_is_combined_by_its_information(monkeypatch, value):
    """Its covariance grows along it first; a contradiction makes both less certain."""
    monkeypatch.setattr(
        "drake_pose.registration.joint_offsets.shrink_constants", lambda _, found, *__: found.shared
    )
    rng, names = np.random.default_rng(3), ("eye.turn_y", "eye.turn_x", "first", "second")
    J = rng.normal(size=(4, 4)) * [0.01, 0.01, 0.01, 0.002]
    J[0] = 0.9 * J[2] + 0.0004 * rng.normal(size=4)
    C = J @ J.T
    fit = SimpleNamespace(names=names, constants=names[2:])
    seen = SharedValues(np.array([0.01, -0.02, 0.05, 0.03]), np.zeros(0))
    for deviation in (0.001, 0.03):
        found, after, gauges = shrink_measured(
            fit, seen, C, names[2:], {"first": (value, deviation), "gone": (9.0, 1.0)}
        )
        own = C[2, 2] * 2.5**2 + max(0.014, deviation) ** 2
        wide = C + (own / C[2, 2] ** 2 - 1.0 / C[2, 2]) * np.outer(C[2], C[2])
        assert wide[2, 2] == pytest.approx(own)
        noise = max(deviation**2, 0.25 * (value - 0.05) ** 2 - own)
        e = np.eye(4)[2]
        information = np.linalg.inv(wide) + np.outer(e, e) / noise
        np.testing.assert_allclose(after, np.linalg.inv(information), rtol=1e-6, atol=1e-12)
        posterior = np.linalg.solve(
            information, np.linalg.solve(wide, seen.shared) + e * value / noise
        )
        np.testing.assert_allclose(found.shared, posterior, rtol=1e-6)
        assert gauges == {"first": ("eye.turn_y",)}
    same, unchanged, nothing = shrink_measured(fit, seen, C, names[2:], {})
    assert nothing == {}
    np.testing.assert_array_equal(same.shared, seen.shared)
    np.testing.assert_array_equal(unchanged, C)


def test_an_unknown_first_offset_turns_the_camera_about_its_axis(model, body, camera) -> None:
    views = [PosedFrames(body.kinematics, body.full, camera, see(model, body, camera, 3, 6))]
    first, second = body.kinematics.names[:2]
    assert not _unknown_rotations(views, [camera], {second}).any()
    (found,) = _unknown_rotations(views, [camera], {first, second})
    by = 1e-6
    X = motion(by * np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])) @ camera.X_WC
    moved = np.append([0.0, 0.0, 1.0], (X[:3, 3] - camera.X_WC[:3, 3]) / by)
    expected = SHARED.constant_deviation**2 * np.outer(moved, moved)
    np.testing.assert_allclose(found, expected, atol=1e-5 * expected.max())


def test_lost_fits_and_few_frames_are_refused() -> None:
    require_fit_kept(0.76, 0.8)
    require_fit_kept(0.9, 0.8)
    with pytest.raises(RegistrationError, match=r"74% of the contours fit .* 80% at its start"):
        require_fit_kept(0.74, 0.8)
    for count, joints, links in ((2, 1, 0), (2, 1, 1), (5, 3, 2)):
        require_frame_count(count, joints, links)
        with pytest.raises(
            RegistrationError, match=f"{joints} joints .* {links} links .* {count - 1}"
        ):
            require_frame_count(count - 1, joints, links)


def two_minima(other: float, noise: float) -> Callable[[float], np.ndarray]:
    """Return costs of five frames with minima near 0 and another place."""
    return lambda x: 100.0 * (x * (x - other)) ** 2 + noise * (np.arange(5) - 1.75) * x


@pytest.mark.parametrize(
    ("name", "cost", "doubtful"),
    [
        # The masks' costs as a function of the offset's difference.
        ("hand_turn", lambda x: 100.0 * x**2 + np.zeros(5), False),
        ("hand_turn", lambda x: 0.01 * (x != 0.0) + np.array([1.0, -1.0, 0, 0, 0]) * x, True),
        # Another minimum, to one side or the other, and one as near as the interval.
        ("hand_turn", two_minima(0.3, 0.1), True),
        ("hand_turn", two_minima(-0.5, 0.1), True),
        ("hand_turn", two_minima(0.1, 1e-3), False),
        # Another link is moved by it, too.
        ("elbow_turn", lambda x: 0.0 * x + np.zeros(5), False),
        ("scale", lambda x: 0.0 * x + np.zeros(5), False),
    ],
)
def test_offsets_of_a_link_that_looks_alike_are_doubtful(model, body, camera, name, cost, doubtful):
    """A difference counts if the costs' sum is within two standard deviations of its scatter."""
    views = [PosedFrames(body.kinematics, body.full, camera, see(model, body, camera, 1, 6))]
    names = ("pose", name)
    included = np.array([True, True, True, False, True])
    found = SharedValues(np.array([9.0, 0.05]), np.zeros(0))

    def costs(at: SharedValues) -> np.ndarray:
        assert at.shared[0] == 9.0
        return np.where(included, cost(at.shared[1] - 0.05), 1e9 * (at.shared[1] - 0.05))

    fit = SimpleNamespace(views=views, names=names, costs=costs)
    covariance = np.diag([1.0, 0.03**2])
    assert ambiguous_constants(fit, found, included, covariance, [name]) == [name] * doubtful
