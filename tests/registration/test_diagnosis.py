"""Diagnosis of errors and outlier frames in Drake's masks of an arm, damaged and changed."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2, f, norm

from drake_pose.body import ArticulatedModel
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration import diagnosis
from drake_pose.registration.diagnosis import Cause, Residual, diagnose_frames, is_half_pixel
from drake_pose.registration.findings import Diagnosis, Finding
from drake_pose.registration.per_frame_fit import (
    FrameFit,
    PerFrameFit,
    explained_frames,
    likeliest_inliers,
)
from drake_pose.registration.posed_frames import MultiViewFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.registration.arm_pictures import damaged, shifted
from tests.search.arms import arm_cameras

COUNT = 8
WRONG = 3


@pytest.fixture(scope="module")
def cameras() -> tuple[PinholeCamera, ...]:
    return arm_cameras(640, 480)


@pytest.fixture(scope="module")
def poses(body: RegistrationBody) -> np.ndarray:
    """Joint positions (frames, joints) in which every joint is observable."""
    generator = np.random.default_rng(5)
    middle = np.radians([0.0, 50.0, 20.0, 60.0, 40.0])
    return middle + np.radians(25.0) * generator.uniform(-1.0, 1.0, (COUNT, 5))


@pytest.mark.parametrize(
    ("shift", "kept"), [(1.0, slice(0, 4)), (20.0, slice(4, 6)), (0.0, slice(6))]
)
def test_the_likeliest_set_of_inliers_is_chosen(shift: float, kept: slice) -> None:
    """Four frames with a common error outvote two correct ones unless the error is improbable.

    The frames are numbers with standard deviation 0.02; their common mean explains none of them.
    """
    off = np.array([shift, shift + 0.01, shift - 0.01, shift, 0.0, 0.01])

    def evaluate(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weight = 1.0 / 0.02**2
        # Without frames, the given values are right to within a tolerance.
        variance = 1.0 / ((1.0 if chosen.any() else 1e4) + weight * chosen.sum())
        x = weight * off[chosen].sum() * variance
        return chi2.sf((off - x) ** 2 / (0.02**2 + variance), 1) > 1e-4, np.array([x])

    expected = np.zeros(6, bool)
    expected[kept] = True
    np.testing.assert_array_equal(likeliest_inliers(np.ones(6, bool), evaluate, 0.4), expected)


@pytest.mark.parametrize("ratio", [0.49, 0.51, 0.74, 0.76])
def test_a_frame_is_explained_relative_to_its_cameras_best(ratio: float) -> None:
    """At least 0.75 of the best frames' inlier ratio, and 0.5, in all its pictures."""
    best = 1.0 if ratio > 0.6 else 0.6
    ratios = [{"left": best, "right": 0.9}, {"left": best}, {"left": ratio, "right": 0.9}]
    found = explained_frames([*ratios, {"left": best, "right": 0.4}])
    np.testing.assert_array_equal(found, [True, True, ratio in (0.51, 0.76), False])


def test_half_a_pixel_along_both_axes_is_reported_if_significant() -> None:
    for u, v, sd, is_half in (
        (0.5, 0.5, 0.05, True), (-0.7, -0.3, 0.05, True), (0.5, -0.5, 0.05, False),
        (0.5, 0.8, 0.05, False), (0.5, 0.5, 0.3, False),
    ):  # fmt: skip
        assert is_half_pixel(np.array([u, v]), sd**2 * np.eye(2)) == is_half


def cause(M: np.ndarray, name: str = "", rank: float = 1.0) -> Cause:
    return Cause("joint", name, M, np.full(M.shape[1], 0.1), rank)


def residual_of(x: Sequence[float], N: np.ndarray, factor: float = 1.0) -> Residual:
    """Return the residual of errors x with a covariance of so many N, and 40 degrees of freedom.

    Two outlines of lengths 2 and 3 move by |x|, a third stands still.
    """
    outlines = np.array([2.0, 3.0, 0.0])[:, None, None] * np.eye(len(x))
    info = diagnosis.Information(N, N @ x, N[:, :2], outlines, np.array([2.0, 3.0, 4.0]), 2.0, 40.0)
    return Residual(info, N, N @ x, factor * N)


@pytest.mark.parametrize(("seed", "factor"), [(0, 1.0), (1, 1.0), (2, 3.0), (3, 3.0)])
def test_causes_are_tested_and_estimated_as_by_least_squares(seed: int, factor: float) -> None:
    rng = np.random.default_rng(seed)
    A, M = 30.0 * rng.normal(size=(5, 9)), rng.normal(size=(5, 3))
    residual = residual_of(rng.normal(0.0, 0.1, 5), A @ A.T, factor)
    L = np.linalg.cholesky(residual.Q)
    D, y = np.linalg.solve(L, residual.N @ M), np.linalg.solve(L, residual.r)
    two, three = (y @ y - np.linalg.lstsq(D[:, :k], y)[1][0] for k in (2, 3))
    own, third = cause(M[:, :2]), cause(M[:, 2:])
    found = residual.test(own)
    np.testing.assert_allclose(found.amount, np.linalg.lstsq(D[:, :2], y)[0], rtol=1e-4)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(D[:, :2].T @ D[:, :2]), 1e-4)
    np.testing.assert_allclose(found.x, M[:, :2] @ found.amount)
    assert residual.info.pixels(np.array([3.0, 0.0, 4.0, 0.0, 0.0])) == pytest.approx(5.0)
    assert found.gain == pytest.approx(two - 4.0)
    assert found.p_value == pytest.approx(f.sf(two / 2.0, 2, 40))
    assert residual.p_value == pytest.approx(f.sf(y @ y / 5.0, 5, 40))
    assert residual.explained(M) == (pytest.approx(three), 3)
    assert residual.explained(M[:, [0, 1, 1]]) == (pytest.approx(two), 2)
    assert residual.is_explained_by(own, third) == (f.sf(three - two, 1, 40) > 1e-4)
    # A cause is eliminated with what it shares with the others: Schur's complement.
    left = residual.without(cause(np.eye(5)[:, 3:]))
    N, r, Q = left.N[:3, :3], left.r[:3], left.Q[:3, :3]
    np.testing.assert_allclose(np.linalg.inv(N), np.linalg.inv(residual.N)[:3, :3])
    np.testing.assert_allclose(np.linalg.solve(N, r), np.linalg.solve(residual.N, residual.r)[:3])
    np.testing.assert_allclose(Q, factor * N)
    np.testing.assert_allclose(left.N[3:], 0.0, atol=1e-6)
    # Cameras' poses are as if each was measured to be right, with an error of 0.3 pixels.
    prior = np.array([0.0, 0.0, np.linalg.norm(M[:, 2]) * np.sqrt(5.0) / 0.9])
    K = np.linalg.pinv(np.vstack([np.sqrt(factor) * D, prior]))
    (beside,) = residual.together([own], [third])
    np.testing.assert_allclose(beside.amount, (K[:, :-1] @ y * np.sqrt(factor))[:2], rtol=1e-4)
    errors = np.diag([factor] * 5 + [1.0])
    np.testing.assert_allclose(beside.covariance, (K @ errors @ K.T)[:2, :2], rtol=1e-4)


@pytest.mark.parametrize(
    ("x", "found"), [((3.0, 0.99), "a"), ((3.0, 1.01), ""), ((8.0, 1.9), "a"), ((0.9, 0.8), "ab")]
)
def test_sufficient_causes_leave_less_than_a_pixel_or_a_quarter(x, found: str) -> None:
    residual = residual_of(x, 1e6 * np.eye(2))
    tests = [residual.test(cause(np.eye(2)[:, [k]], "ab"[k])) for k in (1, 0)]
    assert [one.name for one in residual.sufficient(tests)] == [*found]


@pytest.mark.parametrize(
    ("x", "known", "slack", "expected"),
    [
        ((0.5, 0.29), 1e6, 0.0, ["da"]), ((0.5, 0.31), 1e6, 0.0, ["da", "b"]),
        ((0.5, 0.31), 1e6, 0.52, ["dab", "b"]), ((0.5, 0.0), 1e2, 0.0, ["da"]),
        # Bonferroni: four tests.
        ((float(np.sqrt(f.isf(2e-4, 1, 40))) / 10.0, 0.0), 1e2, 0.0, []),
    ],
)  # fmt: skip
def test_causes_are_named_if_significant_and_visible(x, known, slack, expected) -> None:
    """The largest first; of equal ones the lowest rank; with slack those that leave little."""
    a, b, c = np.eye(3)[:, :, None]
    causes = [cause(a, "a"), cause(b, "b"), cause(c, "c"), cause(a, "d", 0.5)]
    residual = residual_of([*x, 0.0], known * np.eye(3))
    _, named, left = diagnosis.name_causes(residual, causes, slack)
    assert ["".join(one.name for one in group) for group in named] == expected
    assert {one.name for one in left} == {*"abcd"} - {one[0] for one in expected}


@pytest.mark.parametrize(("known", "sd"), [(30.0, 2.0), (1.01, 1.0), (0.99, 1.0), (1e6, 1.0)])
def test_offsets_above_the_minimum_are_detected_with_a_probability_of_95_percent(known, sd):
    residual = residual_of([0.0, 0.0], 0.25 * known * np.eye(2), sd**2)
    causes = [cause(2.0 * one, name) for name, one in zip("ab", np.eye(2)[:, :, None], strict=True)]
    detected = np.sqrt(f.isf(0.5e-4, 1, 40)) + norm.ppf(0.95)
    amount = detected * sd / np.sqrt(known) if known > 1.0 else np.inf
    # An offset must move outlines by 0.3 pixels, too.
    least = pytest.approx(0.1 * max(amount, 0.15), rel=1e-4)
    assert diagnosis.minimum_detectable_offsets(residual, causes) == {"a": least, "b": least}
    # Where next to nothing is known, nothing is significant.
    assert (residual_of([9.0, 9.0], known * np.eye(2)).p_value == 1.0) == (known < 1.0)


Frames = Sequence[tuple[np.ndarray, np.ndarray, Sequence[PinholeCamera]]]


def seen(model: ArticulatedModel, body: RegistrationBody, frames: Frames) -> list[MultiViewFrame]:
    """Return damaged masks of frames: (true pose, given values, cameras that took the pictures)."""
    generator, found = np.random.default_rng(1), []
    for k, (pose, values, taken) in enumerate(frames):
        q, X_WB = body.tree.positions_from(body.kinematics.split(pose))
        masks = {
            one.name: damaged(LabelRenderer(model, one).mask(q, X_WB), generator) for one in taken
        }
        found.append(MultiViewFrame(f"{k:04d}", values, masks))
    return found


def audit(
    model: ArticulatedModel, body: RegistrationBody, poses: np.ndarray, given: np.ndarray,
    taken: Sequence[PinholeCamera], told: Sequence[PinholeCamera] | None = None, turns: int = 2,
) -> Diagnosis:  # fmt: skip
    """Return the audit of pictures taken by some cameras, with given values and given cameras.

    turns: number of fits, each at the corrections that the one before it found.
    """
    frames = seen(model, body, [(*one, taken) for one in zip(poses, given, strict=True)])
    fit = PerFrameFit(body.kinematics, (body.medium, body.full), told or taken, frames)
    at = np.zeros(len(fit.names))
    for _ in range(turns):
        found = diagnose_frames(fit, [fit.fit(frame, at) for frame in frames], at)
        at = found.corrections
    return found


@pytest.fixture(scope="module")
def right(model, body, poses, cameras) -> Callable[[int], tuple[PerFrameFit, list[FrameFit]]]:
    """Return a function that fits correct frames of a number of cameras, once."""

    @cache
    def fitted(count: int) -> tuple[PerFrameFit, list[FrameFit]]:
        frames = seen(model, body, [(pose, pose, cameras[:count]) for pose in poses])
        fit = PerFrameFit(body.kinematics, (body.medium, body.full), cameras[:count], frames)
        return fit, [fit.fit(frame) for frame in frames]

    return fitted


@pytest.fixture
def with_wrong(model, body, poses, right) -> Callable[..., Finding]:
    """Return the finding of frame WRONG with other values, or pictures by other cameras."""

    def wrong(values: np.ndarray, taken: Sequence[PinholeCamera]) -> Finding:
        fit, fits = right(len(taken))
        frames = seen(model, body, [(poses[WRONG], values, taken)] * (WRONG + 1))
        found = diagnose_frames(fit, [*fits[:WRONG], fit.fit(frames[WRONG]), *fits[WRONG + 1 :]])
        assert (found.outliers, found.common) == ((f"{WRONG:04d}",), ())
        assert found.frames[WRONG].finding is not None
        return found.frames[WRONG].finding

    return wrong


def joint_off(poses: np.ndarray, joint: int, frames: slice, degrees: float) -> np.ndarray:
    given = poses.copy()
    given[frames, joint] += np.radians(degrees)
    return given


class TestAuditFrames:
    def test_correct_frames_and_the_minimum_detectable_offset(
        self, model, body, poses, cameras, right
    ):
        found = diagnose_frames(*right(1))
        assert (found.outliers, found.common) == ((), ())
        least = found.minimum_detectable
        assert least.keys() == {*TreeKinematics(body.tree).names}
        assert 0.0 < least["elbow_turn"] < np.radians(1.0)
        by = 1.2 * np.degrees(least["elbow_turn"])
        found = audit(model, body, poses, joint_off(poses, 3, slice(None), by), cameras[:1])
        assert [(one.kind, one.name) for one in found.common] == [("joint", "elbow_turn")]

    def test_joint_offset_in_one_frame(self, poses, cameras, with_wrong) -> None:
        finding = with_wrong(joint_off(poses, 1, slice(None), 2.0)[WRONG], cameras[:1])
        assert (finding.kind, finding.name) == ("joint", "shoulder_turn")
        # The finding's angle is the correction of the given value.
        assert np.degrees(finding.angle) == pytest.approx(-2.0, abs=0.3)
        assert abs(finding.angle - np.radians(-2.0)) < 4.0 * finding.angle_sd

    def test_positions_of_another_frame(self, poses, cameras, with_wrong) -> None:
        assert with_wrong(poses[WRONG + 2], cameras[:1]).pixels > 5.0

    def test_base_motion_in_one_frame(self, poses, cameras, with_wrong) -> None:
        """Both cameras see the motion, so it is not a camera's."""
        away = [shifted(camera, 0.0, -0.01, 0.0) for camera in cameras]
        finding = with_wrong(poses[WRONG], away)
        assert finding.kind == "base"
        assert finding.shift == pytest.approx(0.01, abs=0.002)

    def test_camera_pose_error_in_all_frames(self, model, body, poses, cameras) -> None:
        for count, by in ((2, [0.0, 0.0, 0.01]), (1, [0.0, 0.01, 0.005])):
            told = [*cameras[: count - 1], shifted(cameras[count - 1], *by)]
            found = audit(model, body, poses, poses, cameras[:count], told)
            assert found.outliers == ()
            assert [(one.kind, one.name) for one in found.common] == [("camera", told[-1].name)]
            assert found.common[0].shift == pytest.approx(np.linalg.norm(by), abs=0.003)
        # With a single camera, the base is an alternative cause.
        assert "base" in found.common[0].alternatives

    def test_intrinsics_errors_in_all_frames(self, model, body, poses, cameras) -> None:
        """Both cameras have the same error; findings are corrections."""
        longer = [
            replace(one, focal_x=1.04 * one.focal_x, focal_y=1.04 * one.focal_y) for one in cameras
        ]
        found = audit(model, body, poses, poses, cameras, longer)
        assert found.outliers == ()
        (first, *_) = found.common
        assert (first.kind, first.name) == ("focal", "focal lengths")
        assert first.shift == pytest.approx(-0.04, abs=0.006)
        aside = [replace(one, center_x=one.center_x + 5.0) for one in cameras]
        found = audit(model, body, poses, poses, cameras, aside)
        assert [one.kind for one in found.common] == ["center"]
        assert found.common[0].shift == pytest.approx(5.0, abs=0.7)
