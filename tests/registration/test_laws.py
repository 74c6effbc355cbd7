"""Laws of the parts of a registration, each tested in milliseconds."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import t as scipy_t

from drake_pose.body import TARGET_POSITIONS, RootRotation, load_model
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import MaskError, RegistrationError
from drake_pose.fit.covariance import estimate_sizes, nuisance_covariance
from drake_pose.fit.evidence import Observation
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import CAMERA_NAMES, affine_motions
from drake_pose.fit.problem import parameter_names
from drake_pose.registration.hand_eye import hand_eye_starts, motion, rotation_spread
from drake_pose.registration.joint_offsets import describe_constants, significant_constants
from drake_pose.registration.online_registration import pose_difference
from drake_pose.registration.per_frame_fit import PerFrameFit, adjust_bundle
from drake_pose.registration.posed_frames import MultiViewFrame, PosedFrame, PosedFrames
from drake_pose.registration.register import (
    CameraSearch,
    E_total,
    RegistrationBody,
    add_bound_equations,
    distinct_poses,
    frame_misfits,
    intersection_over_union,
    keep_distinct,
    overlap_areas,
    positions_from_bounds,
    uniform_rotations,
)
from drake_pose.registration.shared_fit import (
    SHARED,
    SharedFit,
    SharedValues,
    pose_covariance,
    scatter_factor,
)
from drake_pose.registration.standing_object import (
    CalibrationTarget,
    TargetSearch,
    distinct_motions,
    require_detections,
    require_rotation,
)
from drake_pose.silhouette.scoring import draw_mask
from tests.registration.arm_pictures import MIDDLE, PLACE, assert_close, looking_at, shifted
from tests.search.arms import arm_cameras

STEP = AnnealingStage(0.02, 0.02)


def with_zero(posed: PosedFrames) -> SharedFit:
    """Return a fit of a camera, its focal length and a joint offset."""
    return SharedFit([posed], [posed.camera.X_CW], posed.kinematics.names[3:4], camera_unknowns=7)


def test_priors_add_their_information_to_the_normal_equations(posed: PosedFrames) -> None:
    fit, free = with_zero(posed), with_zero(posed)
    free.problem.information = np.zeros_like(free.problem.information)
    shared = np.array([0.01, 0.0, -0.01, 0.002, 0.003, 0.0, 0.04, -0.03])
    values = SharedValues(shared, np.zeros(2))
    with_prior, without = (one.equations(values, STEP) for one in (fit, free))
    known = np.array([0.0] * 6 + [SHARED.focal_deviation**-2, SHARED.constant_deviation**-2])
    H, g = with_prior.H - without.H, with_prior.g - without.g
    np.testing.assert_allclose(H.sum(axis=0)[1:, 1:], np.diag(known), atol=1e-6)
    np.testing.assert_allclose(g.sum(axis=0)[1:], known * shared, atol=1e-6)
    assert with_prior.cost - without.cost == pytest.approx(known @ shared**2)


SOME = 1e-8 * np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])


def by_differences(pose: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the covariance of a pose (4, 4) of six values around 0 with the covariance SOME."""
    X_0, J, by = pose(np.zeros(6)), np.zeros((6, 6)), 1e-6
    for k in range(6):
        X = pose(by * np.eye(6)[k])
        turn = X[:3, :3] @ X_0[:3, :3].T
        J[:, k] = [turn[2, 1], turn[0, 2], turn[1, 0], *(X[:3, 3] - X_0[:3, 3])]
    return (J / by) @ SOME @ (J / by).T


def test_camera_covariance_matches_derivatives(posed: PosedFrames) -> None:
    """It is J sigma J^T, with the derivative J of X_WC by POSE_NAMES."""
    fit = SharedFit([posed], [posed.camera.X_CW])
    at = np.array([0.1, -0.2, 0.3, 0.02, 0.03, -0.01])
    found = fit.camera_covariances(SharedValues(at, np.zeros(2)), SOME)[0]
    expected = by_differences(lambda x: fit.cameras(SharedValues(at + x, np.zeros(2)))[0].X_WC)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_camera_that_may_turn_moves_on_an_arc() -> None:
    """Monte Carlo of a rotation about the z axis, 1.5 m from the camera."""
    X_WC = looking_at(np.array([1.5, 0.0, 0.5]), np.zeros(3), 0.0).X_WC
    X_CW, about = np.linalg.inv(X_WC), affine_motions(np.array([[0.0, 0, 1, 0, 0, 0, 0]] * 6))
    C = pose_covariance(X_CW, about, np.diag([0.2**2, 0, 0, 0, 0, 0]))
    by = np.random.default_rng(0).normal(0.0, 0.2, 100_000)
    off = 1.5 * np.column_stack([np.cos(by) - 1.0, np.sin(by)])
    np.testing.assert_allclose(np.sqrt(np.diag(C)[3:5]), np.sqrt((off**2).mean(axis=0)), rtol=0.05)
    assert np.sqrt(C[2, 2]) == pytest.approx(0.2)


def test_errors_of_intrinsics_move_the_outline_alike_as_rotation_shift_and_depth(posed):
    """They are added to what nuisance parameters cause."""
    fit = SharedFit([posed], [posed.camera.X_CW])
    distances = fit.distances_with_nuisances(fit.start, SHARED.final_stage, None)
    angles = np.zeros(distances.X.shape[1], bool)
    sizes = estimate_sizes(distances, angles, 0.0, SHARED.prior_deviation)
    without, _, _ = nuisance_covariance(distances, sizes, angles)
    added = np.sqrt(np.diag(fit.covariances(fit.start)[1] - without[:6, :6]))
    depth = float(posed.camera.X_CW[2, :3] @ posed.middle + posed.camera.X_CW[2, 3])
    # A pixel at most, seen at the body's distance.
    assert 0.0 < added[3] <= depth / posed.camera.focal_x
    turn = added[3] / posed.extent
    np.testing.assert_allclose(added, [turn] * 3 + [added[3]] * 2 + [turn * depth])


def test_scatter_measures_disagreement_of_frames_only(posed: PosedFrames) -> None:
    fit = SharedFit([posed], [posed.camera.X_CW])
    seen, rng = fit.distances(fit.start, STEP), np.random.default_rng(3)
    sizes = estimate_sizes(seen, np.zeros(seen.X.shape[1], bool), 0.0)

    def scatter(y: np.ndarray) -> float:
        return scatter_factor(seen._replace(y=y), sizes, 6)

    apart = seen.X[:, :6] @ rng.normal(0.0, 0.05, (6, 2))
    apart = np.where(seen.pictures == seen.pictures[0], *apart.T)
    assert scatter(0.0 * apart) == 1.0
    assert scatter(apart) > 2.0
    # Boundary biases and a common error do not scatter. Errors k times as large have k^2 times the
    # variance, apart from the prior.
    widths, alike = seen.X[:, 6:] @ [3.0, -2.0], seen.X[:, :6] @ rng.normal(0.0, 0.05, 6)
    assert scatter(apart + widths + alike) == pytest.approx(scatter(apart), rel=1e-6)
    first, twice, thrice = (scatter(k * apart) for k in (1.0, 2.0, 3.0))
    assert (thrice - first) / (twice - first) == pytest.approx(8.0 / 3.0)


def test_bound_gradient_matches_cost_differences(posed: PosedFrames) -> None:
    bound = (np.array([[200.0, 100.0], [400.0, 380.0]]), np.ones((2, 2), bool))
    X_CW = posed.camera.X_CW
    p_C = (posed.points[0] @ X_CW[:3, :3].T + X_CW[:3, 3])[None]

    def equations(shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        H, g = np.zeros((1, 3, 3)), np.zeros((1, 3))
        add_bound_equations(posed, p_C + shift, bound, False, H, g)
        return H[0], g[0]

    def cost(shift: np.ndarray) -> float:
        uv, _ = posed.camera.with_pose(np.eye(4)).project(p_C[0] + shift)
        off = np.array([uv.min(axis=0), uv.max(axis=0)]) - bound[0]
        return 0.5 * float((off**2).sum())

    H, g = equations(np.zeros(3))
    steps = 1e-5 * np.eye(3)
    slopes = [(cost(one) - cost(-one)) / 2e-5 for one in steps]
    np.testing.assert_allclose(g, slopes, rtol=1e-4)
    # Four bounds determine three unknowns.
    assert np.linalg.matrix_rank(H) == 3


def test_rotation_spread_about_one_axis_or_two(make_target):
    """Rotations about known axes; frames with too little rotation are refused."""
    small = 1e-4 * np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    for vectors, expected in (
        (np.outer([0.0, 0.3, 0.9], [0.6, 0.0, 0.8]), [np.sqrt(0.42), 0.0, 0.0]),
        (small, [1e-4, 1e-4 / np.sqrt(3.0), 0.0]),
        (small[:1], [0.0, 0.0, 0.0]),
    ):
        found = rotation_spread(Rotation.from_rotvec(vectors).as_matrix())
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-7)
    thing = make_target("box")
    values = np.zeros((3, len(thing.body(np.eye(4)).kinematics.names)))
    turning = values + np.random.default_rng(1).uniform(-0.8, 0.8, values.shape)
    for some, refused in ((values, "by 0 degrees"), (turning[:2], "too few"), (turning, None)):
        frames = [PosedFrame("", one, np.ones((2, 2), bool)) for one in some]
        with nullcontext() if refused is None else pytest.raises(RegistrationError, match=refused):
            require_rotation("eye", thing, frames)


def test_positions_match_the_silhouettes_bounds(posed: PosedFrames) -> None:
    camera = posed.camera
    p_CW = positions_from_bounds(posed, camera.X_CW[None, :3, :3])[0]
    assert np.linalg.norm(p_CW - camera.X_CW[:3, 3]) < 0.03
    # For every rotation, the body is in front of the camera.
    R_CW = uniform_rotations(200)
    depths = (positions_from_bounds(posed, R_CW) + R_CW @ posed.middle)[:, 2]
    assert depths.min() >= 0.5 * posed.extent - 1e-9


def test_poses_are_distinct_if_points_are_apart_in_pictures(posed: PosedFrames) -> None:
    """By more than 3 % of the silhouettes' size, from all that were kept before."""
    X_CW, size = posed.camera.X_CW, posed.size
    depth = float((X_CW[:3, :3] @ posed.middle + X_CW[:3, 3])[2])

    def moved(pixels: float) -> np.ndarray:
        X = X_CW.copy()
        X[0, 3] += pixels * depth / posed.camera.focal_x
        return X

    poses = [moved(k * size) for k in (0.0, 0.025, 0.036, 0.05, 0.08, -0.02)]
    found = distinct_poses(posed, poses)
    assert [any(one is pose for one in found) for pose in poses] == [
        True, False, True, False, True, False
    ]  # fmt: skip
    assert len(distinct_poses(posed, poses, apart=0.0)) == 6
    assert [*keep_distinct([1, 5, 2, 9, 6], lambda a, b: abs(a - b) > 1)] == [1, 5, 9]


def test_overlaps_count_pixels_of_scaled_pictures(posed: PosedFrames) -> None:
    X_CW = posed.camera.X_CW
    other = X_CW.copy()
    other[:3, 3] += [0.05, -0.03, 0.1]
    for side in (60.0, np.inf):
        camera = posed.downscaled(side)
        scale = min(1.0, side / posed.size)
        size = round(scale * 640), round(scale * 480)
        assert (camera.width, camera.height) == size
        found = overlap_areas(posed, np.array([X_CW, other]), side)
        for i, X in enumerate((X_CW, other)):
            for k, frame in enumerate(posed.frames):
                drawn = draw_mask(posed.outlines, X @ posed.X_WN[k], camera)
                mask = frame.mask.astype(np.float32)
                shown = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 0.5
                counts = [np.count_nonzero(one) for one in (drawn, shown, drawn & shown)]
                assert found[i, k].tolist() == counts
                assert E_total(found[i, k]) == np.count_nonzero(drawn ^ shown) / shown.sum()
                iou = np.count_nonzero(drawn & shown) / np.count_nonzero(drawn | shown)
                assert intersection_over_union(found[i, k]) == iou
    ratios, inliers = np.array([0.9, 0.3]), np.array([True, False])
    first, second = frame_misfits(posed, X_CW, ratios, inliers)
    assert (first.frame, first.inlier_ratio, first.is_inlier) == (posed.frames[0].name, 0.9, True)
    assert not second.is_inlier
    assert first.E_total < 0.05 < 0.9 < first.iou


SIDES = "0.2 0.12 0.08"
LOOKS = {
    "box": (f'<box size="{SIDES}"/>', 4, 0, 4),
    "square": ('<box size="0.1 0.1 0.2"/>', 8, 0, 8),
    "can": ('<cylinder radius="0.06" length="0.18"/>', 48, 1, 2),
}


@pytest.fixture(scope="module")
def make_target(model, tmp_path_factory) -> Callable[[str], CalibrationTarget]:
    @cache
    def stand(name: str) -> CalibrationTarget:
        path = tmp_path_factory.mktemp("thing") / "thing.urdf"
        looks = f"<geometry>{LOOKS[name][0]}</geometry>"
        shape = f'<visual><origin xyz="0.3 0 0.1"/>{looks}</visual>'
        path.write_text(f'<robot name="thing"><link name="thing">{shape}</link></robot>')
        tree = load_model(path, check=False).pose_tree(
            "thing", root_position=np.zeros(3), root_rotation=RootRotation.fixed()
        )
        return CalibrationTarget(model, "roll", {}, tree)

    return stand


@pytest.mark.parametrize("name", LOOKS)
def test_target_symmetries_are_found(name, make_target):
    _, turns, axes, apart = LOOKS[name]
    thing = make_target(name)
    found, about = thing.symmetry
    assert (len(found), len(about), len(distinct_motions(found, about))) == (turns, axes, apart)
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
    points = thing.in_own_frame.full[0].vertices
    assert np.linalg.norm(points - [0.3, 0.0, 0.1], axis=1).max() == pytest.approx(thing.radius)
    corners = np.abs(points - thing.middle).max(axis=0)
    for X in found:
        turned = points @ X[:3, :3].T + X[:3, 3] - thing.middle
        # The rotation is about the target's middle, and no corner leaves the bounding box.
        assert (np.abs(turned) < corners + 0.02 * thing.radius).all()


def test_motions_of_a_round_target_differ_by_the_direction_of_its_axis() -> None:
    rotvecs = np.radians([[0, 0, 0], [0, 0, 15], [30, 0, 0], [30, 0, 0], [0, 8, 0], [180, 0, 0]])
    turns = motion(np.column_stack([rotvecs, np.zeros((6, 3))]))
    round_about_z = distinct_motions(turns, np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(round_about_z, turns[[0, 2, 4, 5]])


def test_rotation_of_a_round_target_about_its_axis_is_uncertain(make_target):
    X_WT = looking_at(PLACE, MIDDLE, 0.4).X_WC
    things = make_target("box"), make_target("can")
    box, can = (thing.pose_covariance(X_WT, 1e-6 * np.eye(6)) for thing in things)
    axis = X_WT[:3, 2]
    assert axis @ box[:3, :3] @ axis == pytest.approx(1e-6)
    assert axis @ can[:3, :3] @ axis == pytest.approx(np.pi**2 / 3.0, rel=1e-3)
    others = np.linalg.svd(axis[None])[2][1:]
    np.testing.assert_allclose(np.diag(others @ can[:3, :3] @ others.T), 1e-6, rtol=1e-3)


def test_target_covariance_matches_derivatives(make_target):
    """It is J sigma J^T, with the derivative J of the pose by TARGET_POSITIONS."""
    thing, X_WT = make_target("box"), looking_at(PLACE, MIDDLE, 0.4).X_WC
    expected = by_differences(lambda x: thing.moved(X_WT, x))
    np.testing.assert_allclose(thing.pose_covariance(X_WT, SOME), expected, atol=1e-4)


def test_a_target_must_be_detected_in_four_pictures_and_half_of_them() -> None:
    require_detections("hand", 4, 8)
    for count, of in ((3, 4), (4, 9)):
        with pytest.raises(RegistrationError, match=f"{count} of {of}"):
            require_detections("hand", count, of)


def test_hand_eye_fit_finds_camera_and_target(make_target):
    """From a start near both; a mask that does not show the target is not chosen."""
    thing = make_target("box")
    search, rng = TargetSearch(thing), np.random.default_rng(6)
    camera, still = looking_at(PLACE, MIDDLE, 0.1).resized(160, 120), np.eye(4)
    X_LC = random_poses(rng, 1)[0]
    values = rng.uniform(-0.12, 0.12, (5, len(thing.body(still).kinematics.names)))
    values[:, [name in TARGET_POSITIONS for name in thing.body(still).kinematics.names]] = 0.0
    still[:3, 3] = [0.0, 0.0, 0.9] - thing.middle
    X_WT = thing.link_poses(values).mean(axis=0)
    X_WT[:3, :3] = Rotation.from_matrix(X_WT[:3, :3]).as_matrix()
    true = np.array([X_LC, X_WT @ X_LC @ still])

    def mask(X_CT: np.ndarray) -> np.ndarray:
        return draw_mask(thing.in_own_frame.full, X_CT[None], camera)

    frames = [
        PosedFrame(f"{k}", row, mask(search.poses_in_camera(true[None], row)[0]))
        for k, row in enumerate(values)
    ]
    other = PosedFrame("0", values[0], np.roll(frames[0].mask, 30, axis=1))
    off = true.copy()
    off[0] = X_LC @ motion(np.array([0.02, -0.02, 0.02, 0.01, -0.01, 0.01]))
    off[1] = thing.moved(true[1], np.array([0.01, 0.01, -0.01, 0.02, 0.02, -0.02]))
    poses = np.array([true, off])
    wrong, right = (search.misfits(camera, [[one]], poses) for one in (other, frames[0]))
    assert right[0] < 0.05 < right[1] < wrong[0]
    assert search.misfits(camera, [[other, frames[0]], [frames[1]]], true[None], 100.0)[0] < 0.05
    # Errors are clipped at one.
    aside = replace(frames[0], mask=np.roll(frames[0].mask, 80, axis=1))
    assert search.misfits(camera, [[aside]], true[None])[0] == 1.0
    fit = search.fit_from(camera, frames, off)
    found = search.fitted(fit, fit.fit([STEP] * 12), off)
    began, ended = search.misfits(camera, [[one] for one in frames], np.array([off, found]), 100.0)
    assert ended < 0.3 * began
    # Fewer than three frames with a likely mask are refused.
    quick = TargetSearch(thing, CameraSearch(thing.in_own_frame, rotations=20, fitted=2))
    with pytest.raises(RegistrationError, match="in no three of its frames"):
        quick.choose(camera, [[other, frames[0]]] * 3, explained=-1.0)
    # Poses related by a symmetry of the target are the same, others are not.
    alike = np.array([true[0], true[1] @ thing.symmetry[0][1]])
    far = np.array([true[0], thing.moved(true[1], np.array([0.2, 0, 0, 0, 0, 0]))])
    np.testing.assert_array_equal(search.distinct([true, alike, far], frames), [true, far])


NAMED = SimpleNamespace(
    names=("pose", "elbow", "length of arm"),
    views=[SimpleNamespace(kinematics=SimpleNamespace(names=("elbow",)))],
    constants=("elbow", "length of arm"),
)


def shared(*values: float) -> SharedValues:
    return SharedValues(np.array(values), np.zeros(0))


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_significance_matches_the_interval_and_scales_have_log_intervals(share: float) -> None:
    covariance = np.diag([1.0, 0.01**2, 0.01**2])
    value = share * 0.01 * float(scipy_t.ppf(0.975, 20))
    told = describe_constants(NAMED, shared(0, value, value), 20, 0.05, covariance, NAMED.names[1:])
    zero, length = told.values()
    assert zero.value == value
    assert (zero.low + zero.high) / 2 == pytest.approx(value)
    assert zero.significant == length.significant == (zero.low > 0.0) == (share > 1.0)
    for end in ("low", "value", "high"):
        assert getattr(length, end) == pytest.approx(np.expm1(getattr(zero, end)))
    assert (zero.deviation, length.deviation) == pytest.approx((0.01, 0.01 * np.exp(value)))


def test_gauge_lists_correlated_unknowns() -> None:
    by = 0.8 * SHARED.constant_deviation
    covariance = np.diag([0.01, by**2, 1e-8])
    covariance[0, 1] = covariance[1, 0] = 0.095 * by
    told = describe_constants(NAMED, shared(0, 0.1, 0.1), 20, 0.05, covariance, NAMED.names[1:])
    assert not told["elbow"].determined
    assert (told["elbow"].value, told["elbow"].gauge) == (0.0, ("pose",))
    assert told["length of arm"].determined


@pytest.mark.parametrize("elbow", [0.02, 0.035, 0.06])
def test_significant_constants_match_conditional_distributions(elbow: float) -> None:
    """Backward elimination equals conditioning of the normal distribution on constants at 0."""
    x, limit = np.array([elbow, 0.045]), 3.0
    C = np.array([[1.0, 0.8], [0.8, 1.0]]) * 0.01**2
    covariance = np.zeros((3, 3))
    covariance[1:, 1:] = C
    kept = significant_constants(NAMED, shared(0, *x), covariance, NAMED.names[1:], limit)
    off = np.abs(x) / 0.01
    expected = list(NAMED.names[1:])
    if off.min() < limit:
        k = int(off.argmin())
        P = np.linalg.inv(C)
        rest = x[1 - k] + P[1 - k, k] / P[1 - k, 1 - k] * x[k]
        is_off = abs(rest) * np.sqrt(P[1 - k, 1 - k]) >= limit
        expected = [NAMED.names[2 - k]] if is_off else []
    assert kept == expected


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return random poses (count, 4, 4)."""
    turns = rng.normal(0.0, 1.0, (count, 3))
    return motion(np.column_stack([turns, rng.normal(0.0, 0.5, (count, 3))]))


def test_hand_eye_starts_solve_AX_XB_exactly() -> None:
    """With symmetric and wrong candidate poses of the target beside the true ones."""
    rng = np.random.default_rng(2)
    X_WL, (X_LC, X_WT) = random_poses(rng, 4), random_poses(rng, 2)
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    true = np.linalg.inv(X_WL @ X_LC) @ X_WT
    seen = [np.concatenate([X[None] @ half, random_poses(rng, 1)]) for X in true]
    found = hand_eye_starts(X_WL, seen, np.array([np.eye(4), half]))
    off = np.abs(found[:, 0] - X_LC).max(axis=(1, 2))
    best = found[off.argmin()]
    np.testing.assert_allclose(best[0], X_LC, atol=1e-9)
    # The target's pose is known up to its symmetry.
    assert min(np.abs(best[1] - X_WT @ turn).max() for turn in (np.eye(4), half)) < 1e-9
    # The three frames that turn most about a second axis come first; the fourth one's is wrong.
    threes = [[*range(k), *range(k + 1, 4)] for k in range(4)]
    wrong = int(np.argmax([rotation_spread(X_WL[three, :3, :3])[1] for three in threes]))
    seen = [X[None] for X in true]
    seen[wrong] = random_poses(rng, 1)
    for found in (hand_eye_starts(X_WL, seen, np.eye(4)[None], triples=k) for k in (1, 4)):
        np.testing.assert_allclose(found[0], [X_LC, X_WT], atol=1e-9)


def test_hand_eye_starts_about_one_axis_hold_the_position_along_it_at_zero() -> None:
    rng, about = np.random.default_rng(2), np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    X_WL = random_poses(rng, 1) @ motion(np.outer([0.0, 0.4, 1.1, 1.7], about))
    X_LC, X_WT = random_poses(rng, 2)
    seen = np.linalg.inv(X_WL @ X_LC) @ X_WT
    for found, target in hand_eye_starts(X_WL, [X[None] for X in seen], np.eye(4)[None]):
        np.testing.assert_allclose(X_WL @ found @ seen, [target] * 4, atol=1e-7)
        assert found[2, 3] == pytest.approx(0.0, abs=1e-7)


def test_bundle_adjustment_corrects_camera_and_positions(body: RegistrationBody) -> None:
    """From wrong positions and a wrong camera; another camera with a known pose fixes the world."""
    cameras = [replace(one, name=n) for one, n in zip(arm_cameras(), ("a", "b"), strict=True)]
    rng, kinematics, frames = np.random.default_rng(3), body.kinematics, []
    true = rng.uniform(-0.8, 0.8, (3, len(kinematics.names)))
    for k, values in enumerate(true):
        X_WN = kinematics.poses(values)
        masks = {one.name: draw_mask(body.medium, one.X_CW @ X_WN, one) for one in cameras}
        frames.append(MultiViewFrame(f"{k}", values + rng.normal(0.0, 0.02, len(values)), masks))
    given = [cameras[0], shifted(cameras[1], 0.02, -0.02, 0.02)]
    nothing = np.zeros(len(kinematics.names), bool)
    (camera,), (covariance,), values, radius_scales = adjust_bundle(
        kinematics, body.medium, given, ("b",), frames, nothing
    )
    assert_close(camera.X_WC, cameras[1].X_WC, 0.0105, 0.3)
    assert np.abs(values - true).max() < 0.02
    np.testing.assert_array_equal(radius_scales, 1.0)
    off = pose_difference(camera.X_WC, cameras[1].X_WC)
    assert off @ np.linalg.solve(covariance, off) < 22.5


def test_edge_points_have_the_requested_spacing_but_at_least_a_pixel(posed: PosedFrames) -> None:
    mask, camera = posed.frames[0].mask, posed.camera
    frame = MultiViewFrame("0", posed.frames[0].values, {camera.name: mask})
    counts = [len(frame.edges([camera], spacing).uv) for spacing in (0.2, 1.0, 2.0, 6.0)]
    assert counts[0] == counts[1]
    np.testing.assert_allclose(np.divide(counts[1], counts[2:]), [2.0, 6.0], rtol=0.05)


@pytest.fixture
def per_frame(body, posed) -> tuple[PerFrameFit, list[MultiViewFrame]]:
    """A fit with a pinhole camera and a parallel camera at its pose, and frames of the former."""
    camera = posed.camera
    flat = ParallelCamera("flat", 640, 480, 300.0, camera.center_x, camera.center_y, camera.X_WC)
    frames = [MultiViewFrame(one.name, one.values, {"eye": one.mask}) for one in posed.frames]
    surfaces = (body.medium, body.full)
    return PerFrameFit(body.kinematics, surfaces, [camera, flat], frames), frames


def test_masks_of_wrong_size_and_empty_masks_are_refused(body, posed, per_frame):
    (fit, (frame, *_)), surfaces = per_frame, (body.medium, body.full)
    for mask, said in ((np.zeros((480, 640)) > 0, "no mask"), (np.ones((9, 9)) > 0, "640 x 480")):
        one = replace(posed.frames[0], name="0007", mask=mask)
        with pytest.raises(MaskError, match="camera 'eye', frame '0007'"):
            PosedFrames(body.kinematics, body.medium, posed.camera, [one])
        several = replace(frame, name="0007", masks={"eye": mask})
        with pytest.raises(MaskError, match=said):
            PerFrameFit(body.kinematics, surfaces, fit.cameras, [several])
    with pytest.raises(MaskError, match=r"camera 'eye', frame '0007'.*640 x 480"):
        fit.fit(several)


@pytest.mark.parametrize("wider", [-2, 1, 2])
def test_boundary_bias_matches_dilation_and_erosion(per_frame, wider: int) -> None:
    fit, (frame, *_) = per_frame
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(wider) + 1,) * 2)
    widths = []
    for by in (0, wider):
        change = {0: lambda mask: mask, 1: cv2.dilate, -1: cv2.erode}[int(np.sign(by))]
        mask = frame.masks["eye"].astype(np.uint8)
        mask = (change(mask, disc) if by else mask).astype(bool)
        made = replace(frame, masks={"eye": mask})
        seen = Observation(made.edges(fit.cameras, fit.size / 100.0))
        theta = np.zeros(len(parameter_names(fit.problem.body, fit.cameras)))
        theta[: len(frame.values)] = frame.values
        widths.append(fit.with_boundary_biases(seen, theta)[-2])
    assert widths[1] - widths[0] == pytest.approx(wider, abs=0.35)


def test_corrections_of_the_base_and_of_lenses_match_projections(per_frame) -> None:
    """The base turns by 20 degrees; focal length and principal point change, too."""
    (fit, _), points = per_frame, np.random.default_rng(3).uniform(-0.1, 0.1, (9, 3))
    of_cameras = ([0.05] * 7 + [0.05 * fit.size] * 2) * 2
    assert fit.deviations.tolist() == [0.1] * 5 + of_cameras + [0.05] * len(fit.links)
    turn, shift, lens = np.array([0.2, -0.2, 0.2]), [0.02, 0.01, -0.03], [0.1, 3.0, -2.0]
    at, rows = fit.base_jacobian() @ [*turn, *shift], fit.rows(CAMERA_NAMES[6:], ["eye"])
    at[rows] = lens / fit.deviations[rows]
    moved = (points - fit.middle) @ Rotation.from_rotvec(turn).as_matrix().T + fit.middle + shift
    for given, corrected in zip(fit.cameras, fit.cameras_at(at), strict=True):
        expected = given.project(moved)[0]
        if given.name == "eye":
            centre = np.array([given.center_x, given.center_y])
            expected = np.exp(0.1) * (expected - centre) + centre + lens[1:]
        np.testing.assert_allclose(corrected.project(points)[0], expected, atol=1e-6)
