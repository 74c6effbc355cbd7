"""Calibration of joint offsets and link scales."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, UnknownNameError
from drake_pose.fit.base_edges import joint_rotation
from drake_pose.fit.covariance import round_parts
from drake_pose.jobs.registration.words import fit_of_inliers, likely_offset_warnings
from drake_pose.registration.joint_offsets import (
    calibrate_joints,
    require_fit_kept,
    require_frame_count,
    shrink_constants,
    with_measured,
)
from drake_pose.registration.online_registration import pose_difference
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import CameraSearch, RegisteredCamera, RegistrationBody
from drake_pose.registration.shared_fit import SharedFit, SharedValues
from tests.body.models import joint, link
from tests.registration.arm_pictures import MIDDLE, PLACE, assert_close, looking_at, see
from tests.search.arms import LINKS, arm_urdf

NAMES = ("shoulder_turn", "roll_turn", "elbow_turn")


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
            assert zero.value == pytest.approx(true, abs=np.radians(0.03))
            assert abs(zero.value - true) < 4.0 * zero.deviation
            assert zero.significant == (true != 0.0)
            assert zero.low <= zero.value <= zero.high
        assert_close(found.cameras[0].X_WC, camera.X_WC, 1e-3, 0.04)

    @pytest.mark.parametrize("base", ["", '<cylinder radius="0.1" length="0.1"/>'])
    def test_an_unobservable_offset_widens_the_camera(self, tmp_path, camera, base: str) -> None:
        """All visible parts of this arm move with its first joint, but for a round base."""
        by, path = np.radians(15.0), tmp_path / "arm.urdf"
        shape = link("base", f"<visual><geometry>{base}</geometry></visual>" if base else "")
        shape += joint("weld", "fixed", "world", "base", origin="")
        path.write_text(arm_urdf().replace("</robot>", f"{shape}</robot>"))
        model = load_model(path)
        body = RegistrationBody(model.pose_tree())
        assert len(round_parts(body.kinematics, tuple(body.full))) == bool(base)
        frames = misread(see(model, body, camera, 4, 4), {"turret_turn": by})
        X_WW = joint_rotation(body.kinematics, frames[0].values, 0, by)
        turned = known(camera.with_pose(np.linalg.inv(camera.X_CW @ X_WW)))
        found = calibrate_joints(body, [turned], [frames], ["turret_turn", "elbow_turn"])
        first, elbow = found.offsets
        assert (first.determined, first.significant) == (False, False)
        assert any("turn" in name or "shift" in name for name in first.gauge)
        assert elbow.low < 0.0 < elbow.high
        assert np.radians(0.003) < elbow.deviation < np.radians(0.03)
        off = pose_difference(camera.X_WC, found.cameras[0].X_WC)
        assert np.linalg.norm(off[3:]) > 0.3
        assert (np.abs(off) < 1.96 * np.sqrt(np.diag(found.covariances[0]))).all()

    def test_wrong_names_and_too_few_frames_are_refused(self, model, body, camera) -> None:
        frames, registered = see(model, body, camera, 1, 4), known(camera)
        for error, said, joints, links in (
            (UnknownNameError, "knee", ["knee"], []),
            (UnknownNameError, r"'hand'.*turret", [], ["hand"]),
            (RegistrationError, "more frames", NAMES, []),
        ):
            with pytest.raises(error, match=said):
                calibrate_joints(body, [registered], [frames], joints, links=links)


@pytest.mark.parametrize("degrees", [3.0, -3.0, 0.0, 0.4])
def test_a_missing_offset_is_suspected_from_common_residuals(model, body, camera, degrees):
    """The camera absorbs the offset, and its standard deviation does not show that."""
    frames = misread(see(model, body, camera, 6, 4), {"elbow_turn": np.radians(degrees)})
    found = CameraSearch(body).refine(camera, frames)
    texts = likely_offset_warnings(body, found.camera.name, fit_of_inliers(body, found, frames))
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
        drawn = shrink_constants(fit, SharedValues(seen, np.zeros(0)), A @ A.T, names).shared
        errors.append([np.square(drawn - true), np.square(seen - true)])
    after, before = np.mean(errors, axis=0)
    for ratio in (after[0] / before[0], after[1:].sum() / before[1:].sum()):
        assert least <= ratio < most


def test_cameras_follow_held_constants_back_to_the_contours(model, body, camera) -> None:
    """A camera that a wrong covariance moved returns; the constants stay."""
    frames = see(model, body, camera, 4, 6)
    views = [PosedFrames(body.kinematics, body.full, camera, frames)]
    fit = SharedFit(views, [camera.X_CW], NAMES)
    shared = np.zeros(len(fit.names))
    shared[:6] = [0.012, -0.009, 0.006, 0.009, -0.006, 0.03]
    moved = fit.start._replace(shared=shared)
    found = fit.fitted_cameras(moved, np.ones(len(frames), bool))
    assert fit.inlier_ratios(found).mean() > fit.inlier_ratios(moved).mean() + 0.1
    assert_close(fit.cameras(found)[0].X_WC, camera.X_WC, 2e-3, 0.1)
    np.testing.assert_array_equal(found.shared[6:], 0.0)


def test_a_measured_constant_is_combined_by_its_information() -> None:
    J = np.random.default_rng(3).normal(size=(4, 4)) * [0.01, 0.01, 0.01, 0.002]
    C, e, names = J @ J.T, np.eye(4)[2], ("eye.turn_y", "eye.turn_x", "first", "second")
    fit = SimpleNamespace(names=names)
    seen = SharedValues(np.array([1, -2, 5, 3]) / 100, np.zeros(0))
    for deviation in (0.001, 0.03):
        measured = {"first": (0.02, deviation), "gone": (9.0, 1.0)}
        found, after = with_measured(fit, seen, C, measured)
        information = np.linalg.inv(C) + np.outer(e, e) / deviation**2
        np.testing.assert_allclose(after, np.linalg.inv(information), rtol=1e-6, atol=1e-12)
        right = np.linalg.solve(C, seen.shared) + e * 0.02 / deviation**2
        np.testing.assert_allclose(found.shared, np.linalg.solve(information, right), rtol=1e-6)
    same, unchanged = with_measured(fit, seen, C, {"first": (0.2, np.inf)})
    np.testing.assert_array_equal(same.shared, seen.shared)
    np.testing.assert_array_equal(unchanged, C)


def test_lost_fits_and_few_frames_are_refused() -> None:
    require_fit_kept(0.76, 0.8)
    require_fit_kept(0.9, 0.8)
    with pytest.raises(RegistrationError, match=r"74% of the contours fit .* 80% at its start"):
        require_fit_kept(0.74, 0.8)
    for count, joints, links in ((2, 1, 0), (2, 1, 1), (5, 3, 2)):
        require_frame_count(count, joints, links)
        said = f"{joints} joints .* {links} links .* {count - 1}"
        with pytest.raises(RegistrationError, match=said):
            require_frame_count(count - 1, joints, links)


@pytest.mark.slow
def test_cameras_share_offsets_and_link_scales(model, body):
    """Two cameras together estimate a robot's offset better than each alone."""
    places = (np.array([1.6, 0.4, 0.5]), np.array([0.3, -1.6, 0.7]))
    registered, frames, alone = [], [], []
    elbow = {"elbow_turn": np.radians(2.0)}
    for seed, place in enumerate(places):
        camera = replace(looking_at(place, MIDDLE, 0.1), name=f"eye {seed}")
        frames.append(misread(see(model, body, camera, 4, seed), elbow))
        registered.append(CameraSearch(body).refine(camera, frames[-1]))
        alone.append(calibrate_joints(body, registered[-1:], frames[-1:], ["elbow_turn"]))
    found = calibrate_joints(body, registered, frames, ["elbow_turn"], links=["shoulder", "elbow"])
    (zero,) = found.offsets
    assert zero.low < np.radians(2.0) < zero.high
    assert zero.significant
    assert zero.deviation < max(one.offsets[0].deviation for one in alone)
    for one in found.link_scales:
        assert one.low < 0.0 < one.high
        assert not one.significant
    for camera, place in zip(found.cameras, places, strict=True):
        assert_close(camera.X_WC, looking_at(place, MIDDLE, 0.1).X_WC, 4e-3, 0.15)
