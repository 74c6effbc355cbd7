"""Laws of the parts that a registration is made of; each is a matter of milliseconds."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.tree.root import RootRotation
from drake_pose.errors import MaskError
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.registration import bundle_adjustment
from drake_pose.registration.object_search import ObjectSearch, hand_eye_starts
from drake_pose.registration.online_registration import pose_difference
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames, SeenFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.registration.shared_fit import (
    CONSTANT_DEVIATION,
    FOCAL_DEVIATION,
    Shared,
    SharedFit,
)
from drake_pose.registration.standing_object import StandingObject, Symmetry
from drake_pose.registration.start_poses import add_bound_equations, place_by_bounds
from drake_pose.silhouette.areas.scoring import draw_mask
from tests.registration.arm_pictures import errors, looking_at, see
from tests.search.arms import arm_cameras

MIDDLE = np.array([0.0, 0.0, 0.4])
PLACE = np.array([1.6, 0.4, 0.5])
STEP = AnnealingStage(0.02, 0.02)


@pytest.fixture(scope="module")
def posed(model: ArticulatedModel, body: RegistrationBody) -> PosedFrames:
    camera = looking_at(PLACE, MIDDLE, 0.1)
    frames = see(model, body, camera, 2, 4)
    return PosedFrames(body.kinematics, body.very_few, camera, frames, 0.02)


def with_zero(posed: PosedFrames) -> SharedFit:
    """A fit of a camera, its focal length and a joint's zero."""
    return SharedFit([posed], [posed.camera.X_CW], posed.kinematics.names[3:4], looks=7)


def test_what_is_known_beforehand_pulls_by_what_it_says(posed: PosedFrames) -> None:
    fit, free = with_zero(posed), with_zero(posed)
    nothing = np.zeros_like(free._fit.unknowns.information)
    free._fit.unknowns = replace(free._fit.unknowns, information=nothing)
    shared = np.array([0.01, 0.0, -0.01, 0.002, 0.003, 0.0, 0.04, -0.03])
    with_prior, without = (one.equations(Shared(shared, np.zeros(2)), STEP) for one in (fit, free))
    known = np.array([0.0] * 6 + [FOCAL_DEVIATION**-2, CONSTANT_DEVIATION**-2])
    H, g = with_prior.H - without.H, with_prior.g - without.g
    np.testing.assert_allclose(H.sum(axis=0)[1:, 1:], np.diag(known), atol=1e-6)
    np.testing.assert_allclose(g.sum(axis=0)[1:], known * shared, atol=1e-6)
    assert with_prior.cost - without.cost == pytest.approx(known @ shared**2)


def test_slopes_of_the_cost_are_those_of_the_equations(posed: PosedFrames) -> None:
    """g is half the derivative of the cost: of a pose, the focal length, a zero and a width."""
    fit, own = with_zero(posed), np.zeros(2)
    at = np.array([0.02, -0.01, 0.02, 0.01, 0.01, 0.01, 0.02, 0.03])
    wide = AnnealingStage(0.2, 0.01)
    g = fit.equations(Shared(at, own), wide).g.sum(axis=0)[1:]
    for k, slope in enumerate(g):
        by = 2e-3 * np.eye(8)[k]
        more, less = (fit.equations(Shared(at + s * by, own), wide).cost for s in (1.0, -1.0))
        assert (more - less) / 8e-3 == pytest.approx(slope, abs=0.1 * np.abs(g).max()), k
    wider, narrower = (fit.equations(Shared(at, own + w), wide).cost for w in (0.25, -0.25))
    widths = fit.equations(Shared(at, own), wide).g[:, 0]
    assert (wider - narrower) / 1.0 == pytest.approx(float(widths.sum()))


def test_a_camera_s_covariance_is_that_of_its_moves(posed: PosedFrames) -> None:
    """J sigma J^T, J the derivative of X_WC by POSE_NAMES."""
    fit = SharedFit([posed], [posed.camera.X_CW])
    at = np.array([0.1, -0.2, 0.3, 0.02, 0.03, -0.01])
    X_WC, J = fit.cameras(Shared(at, np.zeros(2)))[0].X_WC, np.zeros((6, 6))
    for k in range(6):
        X = fit.cameras(Shared(at + 1e-6 * np.eye(6)[k], np.zeros(2)))[0].X_WC
        turn = X[:3, :3] @ X_WC[:3, :3].T
        J[:, k] = [turn[2, 1], turn[0, 2], turn[1, 0], *(X[:3, 3] - X_WC[:3, 3])]
    covariance = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
    found = fit.camera_covariances(Shared(at, np.zeros(2)), covariance)[0]
    np.testing.assert_allclose(found, (J / 1e-6) @ covariance @ (J / 1e-6).T, atol=1e-4)


def test_a_wider_mask_is_told_from_a_nearer_camera(posed: PosedFrames) -> None:
    """The width that is found is that of the mask, whatever the camera's distance takes of it."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    frames = [
        replace(one, mask=cv2.dilate(one.mask.view(np.uint8), disc).view(bool))
        for one in posed.frames
    ]
    wide = PosedFrames(posed.kinematics, posed.outlines, posed.camera, frames, posed.spacing)
    fits = [SharedFit([one], [posed.camera.X_CW]) for one in (posed, wide)]
    exact, wider = (fit.fit([AnnealingStage(0.02, 0.01, 6)]).widths for fit in fits)
    np.testing.assert_allclose(wider - exact, 2.0, atol=0.4)


def test_bounds_pull_along_the_derivative_of_how_far_they_are_off(posed: PosedFrames) -> None:
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
    # Of four sides three unknowns follow.
    assert np.linalg.matrix_rank(H) == 3


def test_a_body_is_placed_where_its_bounds_are_the_silhouettes(posed: PosedFrames) -> None:
    camera = posed.camera
    p_CW = place_by_bounds(posed, camera.X_CW[None, :3, :3])[0]
    assert np.linalg.norm(p_CW - camera.X_CW[:3, 3]) < 0.03


SIDES = "0.2 0.12 0.08"
LOOKS = {
    "box": (f'<box size="{SIDES}"/>', 4, 0, 4),
    "square": ('<box size="0.1 0.1 0.2"/>', 8, 0, 8),
    "can": ('<cylinder radius="0.06" length="0.18"/>', 48, 1, 2),
}


@pytest.fixture
def standing(model: ArticulatedModel, tmp_path: Path) -> Callable[[str], StandingObject]:
    def stand(looks: str) -> StandingObject:
        path = tmp_path / "thing.urdf"
        shape = f'<visual><origin xyz="0.3 0 0.1"/><geometry>{looks}</geometry></visual>'
        path.write_text(f'<robot name="thing"><link name="thing">{shape}</link></robot>')
        tree = load_model(path, check=False).pose_tree(
            "thing", root_position=np.zeros(3), root_rotation=RootRotation.fixed()
        )
        return StandingObject(model, "roll", {}, tree)

    return stand


@pytest.mark.parametrize("name", LOOKS)
def test_turns_after_which_an_object_looks_alike(
    name: str, standing: Callable[[str], StandingObject]
) -> None:
    looks, turns, axes, apart = LOOKS[name]
    thing = standing(looks)
    found = thing.symmetry
    assert (len(found.turns), len(found.axes), len(found.told_apart)) == (turns, axes, apart)
    np.testing.assert_allclose(found.turns[0], np.eye(4), atol=1e-12)
    points = thing.alone.all[0].vertices
    corners = np.abs(points - thing.middle).max(axis=0)
    for X in found.turns:
        turned = points @ X[:3, :3].T + X[:3, 3] - thing.middle
        # About its middle, and no corner leaves the box around it.
        assert (np.abs(turned) < corners + 0.02 * thing.radius).all()


def test_turns_of_a_round_object_differ_where_its_axis_points_elsewhere() -> None:
    rotvecs = np.radians([[0, 0, 0], [0, 0, 15], [30, 0, 0], [30, 0, 0], [0, 8, 0], [180, 0, 0]])
    turns = np.tile(np.eye(4), (6, 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(rotvecs).as_matrix()
    round_about_z = Symmetry(turns, np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(round_about_z.told_apart, turns[[0, 2, 4, 5]])


def test_an_object_that_is_round_may_be_turned_about_its_axis_by_anything(
    standing: Callable[[str], StandingObject],
) -> None:
    X_WT = looking_at(PLACE, MIDDLE, 0.4).X_WC
    box, can = (
        standing(LOOKS[name][0]).pose_covariance(X_WT, 1e-6 * np.eye(6)) for name in ("box", "can")
    )
    axis = X_WT[:3, 2]
    assert axis @ box[:3, :3] @ axis == pytest.approx(1e-6)
    assert axis @ can[:3, :3] @ axis == pytest.approx(np.pi**2 / 3.0, rel=1e-3)
    others = np.linalg.svd(axis[None])[2][1:]
    np.testing.assert_allclose(np.diag(others @ can[:3, :3] @ others.T), 1e-6, rtol=1e-3)


def test_an_object_s_covariance_is_that_of_its_moves(
    standing: Callable[[str], StandingObject],
) -> None:
    """J sigma J^T, J the derivative of the pose by OBJECT_POSITIONS."""
    thing, X_WT = standing(LOOKS["box"][0]), looking_at(PLACE, MIDDLE, 0.4).X_WC
    J = np.zeros((6, 6))
    for k in range(6):
        X = thing.moved(X_WT, 1e-6 * np.eye(6)[k])
        turn = X[:3, :3] @ X_WT[:3, :3].T
        J[:, k] = [turn[2, 1], turn[0, 2], turn[1, 0], *(X[:3, 3] - X_WT[:3, 3])]
    covariance = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
    expected = (J / 1e-6) @ covariance @ (J / 1e-6).T
    np.testing.assert_allclose(thing.pose_covariance(X_WT, covariance), expected, atol=1e-4)


def test_masks_of_another_size_and_empty_ones_are_refused(
    body: RegistrationBody, posed: PosedFrames
) -> None:
    for mask in (np.ones((10, 10), bool), np.zeros((480, 640), bool)):
        frame = PosedFrame("0007", posed.frames[0].values, mask)
        with pytest.raises(MaskError, match="camera 'eye', frame '0007'"):
            PosedFrames(body.kinematics, body.few, posed.camera, [frame])


def test_poses_of_an_object_are_one_that_show_it_alike(
    standing: Callable[[str], StandingObject],
) -> None:
    """Nearer to each other than a share of its radius, or turned as its looks repeat."""
    thing = standing(LOOKS["box"][0])
    search, X = ObjectSearch(thing), looking_at(PLACE, MIDDLE, 0.4).X_WC
    near, far = X.copy(), X.copy()
    near[0, 3] += 0.1 * thing.radius
    far[0, 3] += 0.3 * thing.radius
    poses = [one[None] for one in (X, X, near, X @ thing.symmetry.turns[2], far)]
    kept = search._apart(poses, thing.symmetry.turns)
    np.testing.assert_array_equal(kept, [X[None], far[None]])


def random_poses(rng: np.random.Generator, count: int, turn: float = 1.0) -> np.ndarray:
    """(count, 4, 4)."""
    X = np.tile(np.eye(4), (count, 1, 1))
    X[:, :3, :3] = Rotation.from_rotvec(rng.normal(0.0, turn, (count, 3))).as_matrix()
    X[:, :3, 3] = rng.normal(0.0, 0.5, (count, 3))
    return X


def test_three_pictures_tell_camera_and_object() -> None:
    """A X = X B exactly, however the object looks alike, beside poses that are wrong."""
    rng = np.random.default_rng(2)
    X_WL, (X_LC, X_WT) = random_poses(rng, 4), random_poses(rng, 2)
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    true = np.linalg.inv(X_WL @ X_LC) @ X_WT
    seen = [np.concatenate([X[None] @ half, random_poses(rng, 1)]) for X in true]
    found = hand_eye_starts(X_WL, seen, np.array([np.eye(4), half]))
    off = np.abs(found[:, 0] - X_LC).max(axis=(1, 2))
    best = found[off.argmin()]
    np.testing.assert_allclose(best[0], X_LC, atol=1e-9)
    # Which of its looks the object has nobody knows.
    assert min(np.abs(best[1] - X_WT @ turn).max() for turn in (np.eye(4), half)) < 1e-9


def test_a_bundle_finds_poses_and_a_camera_together(
    body: RegistrationBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From positions that are off, and a camera that stands elsewhere; another one holds both."""
    monkeypatch.setattr(bundle_adjustment, "_TELLING_FRAMES", 1)
    cameras = [replace(one, name=n) for one, n in zip(arm_cameras(), ("a", "b"), strict=True)]
    rng, kinematics, frames = np.random.default_rng(3), body.kinematics, []
    true = rng.uniform(-0.8, 0.8, (3, len(kinematics.names)))
    for k, values in enumerate(true):
        X_WN = kinematics.poses(values)
        masks = {one.name: draw_mask(body.few, one.X_CW @ X_WN, one) for one in cameras}
        frames.append(SeenFrame(f"{k}", values + rng.normal(0.0, 0.02, len(values)), masks))
    X_WC = cameras[1].X_WC.copy()
    X_WC[:3, 3] += [0.02, -0.02, 0.02]
    given = [cameras[0], cameras[1].with_pose(X_WC)]
    nothing = np.zeros(len(kinematics.names), bool)
    found = bundle_adjustment.adjust_bundle(kinematics, body.few, given, ("b",), frames, nothing)
    (camera,), (covariance,) = found.cameras, found.covariances
    shift, turn = errors(camera.X_WC, cameras[1].X_WC)
    assert shift < 0.012
    assert turn < np.radians(0.4)
    assert np.abs(found.values - true).max() < 0.03
    np.testing.assert_array_equal(found.girths, 1.0)
    off = pose_difference(camera.X_WC, cameras[1].X_WC)
    assert off @ np.linalg.solve(covariance, off) < 22.5


def test_edges_are_as_fine_as_they_are_asked_for_and_a_pixel_at_most(posed: PosedFrames) -> None:
    mask, camera = posed.frames[0].mask, posed.camera
    frame = SeenFrame("0", posed.frames[0].values, {camera.name: mask})
    counts = [len(frame.edges([camera], spacing).uv) for spacing in (0.2, 1.0, 2.0, 6.0)]
    assert counts[0] == counts[1]
    np.testing.assert_allclose(np.divide(counts[1], counts[2:]), [2.0, 6.0], rtol=0.05)
