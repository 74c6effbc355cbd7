"""Diagnosis of errors and outlier frames in Drake's masks of an arm, damaged and changed."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2
from scipy.stats import f as fisher

from drake_pose.body import ArticulatedModel
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.diagnosis import (
    DIAGNOSIS,
    Cause,
    Information,
    Residual,
    diagnose_frames,
    f_test,
    is_half_pixel,
    minimum_detectable_offsets,
    name_causes,
    weighted_square,
)
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


def information(scale: float = 1.0, freedom: float = 50.0, seed: int = 3) -> Information:
    """Return random information about five unknowns, the outlines of two nodes, and no surface."""
    rng = np.random.default_rng(seed)
    J = rng.normal(0.0, 3.0, (40, 5))
    outlines = np.zeros((2, 5, 5))
    for node, own in enumerate((slice(0, 3), slice(1, 5))):
        half = rng.normal(0.0, 5.0, (5, 5))
        half[:, [k for k in range(5) if k not in range(5)[own]]] = 0.0
        outlines[node] = half.T @ half
    N = J.T @ J
    lengths = np.array([100.0, 300.0])
    return Information(
        N, N @ rng.normal(size=5), np.zeros((5, 24)), outlines, lengths, scale, freedom
    )


def cause(name: str, *columns: int, rank: float = 1.0) -> Cause:
    return Cause("joint", name, np.eye(5)[:, [*columns]], np.ones(len(columns)), rank)


def residual_of(x: np.ndarray, seed: int = 5) -> Residual:
    """Return a residual that errors x (5,) cause, beside noise with the covariance N."""
    info = information()
    noise = np.linalg.cholesky(info.N) @ np.random.default_rng(seed).normal(size=5)
    return Residual(info, info.N, info.N @ x + noise, info.N)


def test_statistic_and_p_value_are_those_of_known_directions() -> None:
    """r^T Q^-1 r, whose ratio to its rank has an F distribution; weak directions are left out."""
    rng = np.random.default_rng(2)
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    N = turn @ np.diag([0.5, 2.0, 9.0, 30.0]) @ turn.T
    Q, r = 2.0 * N + np.eye(4), rng.normal(0.0, 5.0, 4)
    kept = turn[:, 1:]
    expected = (kept.T @ r) @ np.linalg.solve(kept.T @ Q @ kept, kept.T @ r)
    assert weighted_square(r, Q, N) == (pytest.approx(expected), 3)
    assert weighted_square(r, Q, 0.1 * np.eye(4)) == (0.0, 0)
    assert f_test(5.0, 0, 9.0) == 1.0
    assert f_test(-1e-9, 2, 9.0) == 1.0


def test_causes_are_estimated_by_least_squares() -> None:
    """Alone, or beside causes that were eliminated whatever their amount."""
    residual = residual_of(np.array([0.5, 0.0, 1.0, 0.0, -0.5]))
    residual = residual._replace(Q=2.0 * residual.N + np.eye(5))
    first, pair = cause("a", 0), cause("b", 2, 4)
    tested = residual.test(pair)
    M = pair.jacobian
    inverse = np.linalg.inv(M.T @ residual.N @ M)
    np.testing.assert_allclose(tested.amount, inverse @ M.T @ residual.r, rtol=1e-3)
    np.testing.assert_allclose(tested.x, M @ tested.amount)
    np.testing.assert_allclose(
        tested.covariance, inverse @ M.T @ residual.Q @ M @ inverse, rtol=1e-3
    )
    T = (M.T @ residual.r) @ np.linalg.solve(M.T @ residual.Q @ M, M.T @ residual.r)
    assert tested.p_value == pytest.approx(fisher.sf(T / 2, 2, 50.0))
    assert (tested.kind, tested.name) == ("joint", "b")
    # The gain is that of the likelihood, of generalised least squares.
    half = np.linalg.cholesky(residual.Q)
    A, z = (np.linalg.solve(half, one) for one in (residual.N @ M, residual.r))
    left = z - A @ np.linalg.lstsq(A, z)[0]
    assert tested.gain == pytest.approx(z @ z - left @ left - 4.0)
    whole = residual.r @ np.linalg.solve(residual.Q, residual.r)
    assert residual.p_value == pytest.approx(fisher.sf(whole / 5, 5, 50.0))
    left = residual.without(first)
    assert left.test(first).gain == -2.0
    both = np.eye(5)[:, [0, 2, 4]]
    joint = np.linalg.solve(both.T @ residual.N @ both, both.T @ residual.r)
    np.testing.assert_allclose(left.test(pair).amount, joint[1:], rtol=1e-3)
    np.testing.assert_allclose(left.Q @ first.jacobian, 0.0, atol=1e-9)
    np.testing.assert_allclose(
        residual.solved(residual.r), np.linalg.solve(residual.N + np.eye(5), residual.r)
    )
    assert residual.pixels() == pytest.approx(residual.info.pixels(residual.solved(residual.r)))
    assert residual.pixels(residual.solved(residual.r)) < 0.05 * residual.pixels()


def test_sufficient_causes_leave_little_and_the_simplest_comes_first() -> None:
    residual = residual_of(np.array([0.0, 0.0, 2.0, 0.0, 0.0]))
    causes = cause("camera", 0, 1, 2, rank=6.0), cause("right", 2), cause("other", 2, 3)
    tests = [residual.test(one) for one in (*causes, cause("wrong", 0))]
    residual = residual._replace(info=residual.info._replace(outlines=1e3 * residual.info.outlines))
    found = [one.name for one in residual.sufficient(tests)]
    gains = {one.name: one.gain for one in tests}
    assert gains["right"] > gains["other"]
    assert found == ["right", "other", "camera"]
    # With a limit above the whole residual, everything is enough.
    every = residual.sufficient(tests, 1e9)
    assert [one.name for one in every] == ["right", "other", "wrong", "camera"]


def test_causes_are_named_one_after_another_while_significant() -> None:
    causes = [cause(name, k) for k, name in enumerate("abcde")]
    residual = residual_of(np.array([0.0, 3.0, 0.0, 1.0, 0.0]))
    left, named, others = name_causes(residual, causes)
    assert [[one.name for one in some] for some in named] == [["b"], ["d"]]
    assert [one.name for one in others] == ["a", "c", "e"]
    expected = residual.without(causes[1]).without(causes[3])
    np.testing.assert_allclose(left.r, expected.r, atol=1e-9)
    # Causes that leave little explain as much; an insignificant one is not named.
    assert [one.name for one in name_causes(residual, causes, np.inf)[1][0]][:2] == ["b", "d"]
    assert name_causes(residual_of(np.zeros(5)), causes)[1] == []
    # Bonferroni's correction for their number: a p-value between a fifth of the level and it.
    alone = residual_of(np.zeros(5))
    for factor, count in ((0.5, 1), (0.1, 1), (0.5, 5), (0.1, 5)):
        N, r = np.diag(np.diag(alone.N)), np.zeros(5)
        r[0] = np.sqrt(chi2.isf(factor * DIAGNOSIS.significance, 1) * N[0, 0])
        one = Residual(alone.info._replace(freedom=1e9), N, r, N)
        assert len(name_causes(one, causes[:count])[1]) == (factor * count <= 1.0)


def test_minimum_detectable_offsets_are_detected_in_95_of_100_cases() -> None:
    """By Monte Carlo, with noise as large as the covariance says."""
    info = information()._replace(freedom=1e9, outlines=1e6 * information().outlines)
    residual = Residual(info, info.N, np.zeros(5), 3.0 * info.N)
    causes = [cause("a", 0)._replace(units=np.array([0.5])), cause("b", 3)]
    found, rng = minimum_detectable_offsets(residual, causes), np.random.default_rng(4)
    half = np.linalg.cholesky(residual.Q)
    for one in causes:
        x = one.jacobian[:, 0] * found[one.name] / one.units[0]
        hits = [
            residual._replace(r=info.N @ x + half @ rng.normal(size=5)).test(one).p_value
            <= DIAGNOSIS.significance / 2
            for _ in range(1500)
        ]
        assert np.mean(hits) == pytest.approx(0.95, abs=0.02)
    # At least what moves outlines by the least motion; without information: never.
    slow = residual._replace(info=info._replace(outlines=1e-9 * info.outlines))
    least = minimum_detectable_offsets(slow, causes[1:])["b"]
    assert slow.info.pixels(least * np.eye(5)[3]) == pytest.approx(DIAGNOSIS.min_common_pixels)
    weak = residual._replace(N=1e-4 * info.N)
    assert minimum_detectable_offsets(weak, causes) == {"a": np.inf, "b": np.inf}
    assert minimum_detectable_offsets(residual, ()) == {}
