"""Cameras registered from pictures alone, of an arm of boxes painted over Drake's label images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from drake_pose.camera.picture_files import Video
from drake_pose.errors import RegistrationError
from drake_pose.fit.background import COLOURS, KnownBackground, foreground_picture
from drake_pose.fit.explain_kernel import Explained
from drake_pose.fit.problem import TIME_OFFSET
from drake_pose.registration.hand_eye import motion
from drake_pose.registration.picture_acceptance import (
    PictureRegistration,
    PictureStart,
    accept_fit,
    best_first,
    evaluate_pictures,
    opposite_pose,
)
from drake_pose.registration.picture_registration import (
    fit_pictures,
    register_pictures,
    squeezed_cameras,
)
from drake_pose.registration.picture_search import (
    PictureSearch,
    PosedPicture,
    RoughPose,
    choose_frames,
    node_places,
    ratio_margin,
    rotation_between,
    segment_picture,
)
from drake_pose.registration.pyramid_level import PyramidLevel, evidence, upright_rotations
from drake_pose.registration.recording import (
    Recording,
    TimeOffset,
    choose_pictures,
    posed_pictures,
    scan_time_offsets,
    stuck_pictures,
)
from tests.benchmarks.registration import pose_error
from tests.camera.recordings import write_pictures
from tests.registration.arm_pictures import assert_close
from tests.registration.episodes import LATE, PaintedEpisode

LEVEL_FRAMES = 6


@pytest.fixture(scope="module")
def level(episode: PaintedEpisode) -> PyramidLevel:
    X_WN = np.array([episode.body.kinematics.poses(one) for one in episode.values[:LEVEL_FRAMES]])
    pictures = episode.pictures[:LEVEL_FRAMES]
    return PyramidLevel(episode.body.coarse, episode.camera, pictures, X_WN, 80)


def test_starts_show_the_body_where_pictures_change(level: PyramidLevel) -> None:
    """Positions and sizes match the moments of the changes, with the intended variation."""
    starts = np.array(level.starts(1200)).reshape(3, 2, -1, 4, 4)
    moments = cv2.moments(level.backgrounds.changed_frames())
    middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    spread = np.sqrt((moments["mu20"] + moments["mu02"]) / moments["m00"])
    p_C = starts[..., :3, :3] @ level.middle + starts[..., :3, 3]
    uv = level.camera.with_pose(np.eye(4)).project(p_C.reshape(-1, 3))[0].reshape(*p_C.shape[:3], 2)
    np.testing.assert_allclose(uv[:, 0], np.broadcast_to(middle, uv[:, 0].shape), atol=1e-3)
    aside = (uv[:, 1] - middle) / spread
    np.testing.assert_allclose(aside.mean(axis=1), 0.0, atol=0.05)
    np.testing.assert_allclose(aside.std(axis=1), 0.5, atol=0.05)
    # At a single depth, the body is as large as the changes.
    across = (level.points - level.middle) @ np.swapaxes(starts[0, 0, :, :2, :3], 1, 2)
    sizes = np.sqrt((across**2).sum(axis=2).mean(axis=1))
    for times, depths in zip((0.7, 1.0, 1.5), p_C[:, 0, :, 2], strict=True):
        seen = level.camera.focal_x * sizes / depths / spread
        assert np.median(seen) == pytest.approx(1.0 / times, rel=0.03)
    R_CW = upright_rotations(1000)
    np.testing.assert_allclose(np.linalg.det(R_CW), 1.0)
    right, down, forward = R_CW.transpose(1, 0, 2)
    assert np.arctan2(right[:, 2], -down[:, 2]).std() == pytest.approx(0.15, rel=0.1)
    assert (forward[:, 2].min(), forward[:, 2].max()) == pytest.approx((-0.98, 0.5))
    # Every octant of headings is covered evenly.
    headings = np.arctan2(forward[:, 1], forward[:, 0])
    np.testing.assert_allclose(np.histogram(headings, 8, (-np.pi, np.pi))[0], 125, atol=3)


def test_moved_poses_separate_rotation_shift_and_depth(level: PyramidLevel, episode) -> None:
    X_CW, x = episode.camera.X_CW, np.array([0.3, -0.2, 0.5, 0.04, -0.07, 0.2])
    moved = level.moved(X_CW, x)
    before, after = (X[:3, :3] @ level.middle + X[:3, 3] for X in (X_CW, moved))
    np.testing.assert_allclose(after[:2] / after[2], before[:2] / before[2] + x[3:5])
    assert after[2] == pytest.approx(before[2] * np.exp(x[5]))
    turn = Rotation.from_matrix(moved[:3, :3] @ X_CW[:3, :3].T).as_rotvec()
    np.testing.assert_allclose(turn, x[:3])


def test_score_increases_towards_the_true_pose(level: PyramidLevel, episode) -> None:
    true = episode.camera.X_CW
    aside = level.moved(true, np.array([0.06, -0.05, 0.04, 0.02, -0.02, 0.03]))
    poses = [aside, true, *level.starts(1200)[::1200]]
    scores = [level.score(X) for X in poses]
    assert np.argmax(scores) == 1
    improved, found = level.improve([poses[2], aside], evaluations=60, turn=0.1)
    np.testing.assert_allclose(improved, level.scores(found))
    assert scores[0] + 0.5 * (scores[1] - scores[0]) < improved[0]
    assert improved[1] >= scores[2]
    best = level.best(poses, LEVEL_FRAMES, 0.4)
    assert len(best) == np.ceil(0.4 * len(poses))
    assert [level.score(X) for X in best] == sorted(scores, reverse=True)[: len(best)]
    # The possible gain is proportional to the number of frames; an explained fraction is at most 1.
    assert level.score(true, 3) == pytest.approx(scores[1], rel=0.3)
    share, contour = level.explained(true)
    assert 0.5 < share < 1.0
    assert contour > level.explained(aside)[1]
    told = level.statistics(true)
    assert share == pytest.approx(told[Explained.GAIN] / level.backgrounds.max_gain)
    assert contour == pytest.approx(told[Explained.CONTOUR] / told[Explained.OUTLINE])


@pytest.mark.parametrize("evaluations", [24, 61])
def test_many_simplexes_are_searched_as_scipy_searches_one(level: PyramidLevel, evaluations):
    poses = level.starts(50)[::60]
    scores, found = level.improve(poses, evaluations, turn=0.2)
    np.testing.assert_allclose(level.scores(found), scores)
    expected = []
    for k, X_CW in enumerate(poses):
        signs = np.random.default_rng(k).choice([-1.0, 1.0], 6)
        steps = 0.2 * signs * np.array([1.0, 1.0, 1.0, 0.4, 0.4, 0.6])
        simplex = np.vstack([np.zeros(6), np.diag(steps)])
        options = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 0.0, "fatol": 0.0}

        def cost(x, X_CW=X_CW):
            return -level.score(level.moved(X_CW, x))

        expected.append(-minimize(cost, np.zeros(6), method="Nelder-Mead", options=options).fun)
    np.testing.assert_allclose(scores, sorted(expected, reverse=True))


def test_tile_gains_sum_to_the_gain(level: PyramidLevel, episode) -> None:
    X_CW = episode.camera.X_CW
    pieces = level.tile_gains(X_CW)
    assert pieces.sum() == pytest.approx(level.statistics(X_CW)[Explained.GAIN])
    # 80 x 60 pixels, in tiles of 5.
    assert pieces.shape == (16, 16)
    assert (pieces[12:] == 0.0).all()
    v, u = np.unravel_index(pieces.argmax(), pieces.shape)
    covered = level.backgrounds.changed_frames()[5 * v : 5 * v + 5, 5 * u : 5 * u + 5]
    assert covered.mean() > level.backgrounds.changed_frames().mean()


def test_search_frames_are_slow_and_the_fastest_are_added(episode, recording) -> None:
    given = recording()
    chosen, moving = choose_pictures(episode.body, episode.camera, given, 5)
    assert not set(chosen) & set(moving)
    X = [node_places(episode.body, episode.values_at(given.times + by)) for by in (1e-3, -1e-3)]
    order = np.linalg.norm(X[0] - X[1], axis=2).mean(axis=1).argsort()
    # Of 16 frames: the slowest 60 %; the eight fastest, without these.
    assert set(chosen) <= set(order[:10].tolist())
    assert set(moving) == set(order[-8:].tolist()) - set(chosen)
    unknown = order[[0, -1]]

    def values_at(offset: float) -> np.ndarray:
        values = episode.values_at(given.times + offset)
        values[unknown] = np.nan
        return values

    both = choose_pictures(episode.body, episode.camera, recording(values_at=values_at), 5)
    assert len(both[0]) == 5
    assert not set(unknown.tolist()) & {*both[0], *both[1]}
    still = choose_pictures(episode.body, episode.camera, recording(times=None), 16)
    assert (sorted(still[0]), still[1]) == (list(range(16)), [])


def test_recording_with_drift_and_offsets(episode, recording) -> None:
    given: Recording = recording()
    drifting = given.with_drift(0.1, 2.0)
    at = 1.1 * given.times - 0.2
    np.testing.assert_allclose(drifting.values_at(0.3), episode.values_at(at + 0.3))
    np.testing.assert_allclose(
        given.with_offsets(np.arange(5.0)).values_at(0.0) - given.values_at(0.0),
        np.tile(np.arange(5.0), (16, 1)),
    )
    slopes = (episode.values_at(at + 1e-4) - episode.values_at(at - 1e-4)) / 2e-4
    np.testing.assert_allclose(drifting.rates_at(0.0), slopes, atol=0.01)
    np.testing.assert_array_equal(given.mirrored().picture("0002"), episode.pictures[2][:, ::-1])
    poses = posed_pictures(given, [4, 1], 0.2)
    assert [one.name for one in poses] == ["0004", "0001"]
    np.testing.assert_allclose(poses[1].values, episode.values_at(given.times + 0.2)[1])


def scanned(episode: PaintedEpisode, given: Recording) -> TimeOffset:
    """Return the time offset of every second picture."""
    frames = posed_pictures(given, range(0, 16, 2), 0.0)
    search = PictureSearch(episode.body, episode.camera, frames)
    return scan_time_offsets(search, episode.camera, given)


def test_time_offset_is_scanned(episode, recording) -> None:
    clock = scanned(episode, recording())
    offset, scores = clock.value, clock.scores
    assert (offset, clock.drift) == (pytest.approx(LATE, abs=0.012), 0.0)
    assert scores[:, 1].max() == 1.0
    assert scores[scores[:, 1].argmax(), 0] == pytest.approx(LATE, abs=0.0126)
    assert scores[0, 0] == -1.0

    def logged(by: float | np.ndarray) -> np.ndarray:
        before = np.min(by) <= -0.31
        return np.full((16, 5), np.nan) if before else episode.values_at(episode.times + by)

    told = scanned(episode, recording(values_at=logged))
    assert told.value == offset
    assert told.scores[0, 0] == pytest.approx(-0.3)


@pytest.mark.parametrize("rate", [0.1, -0.15])
def test_drift_is_scanned_with_the_offset_at_the_mean_time(episode, recording, rate) -> None:
    """The log's clock is faster by a rate, and both start with the first picture."""
    first = episode.times[0]

    def logged(offset: float) -> np.ndarray:
        since = episode.times + offset - first
        return episode.values_at(first + since / (1.0 + rate) + LATE)

    shown = range(0, 16, 2)
    told = scanned(episode, recording(values_at=logged))
    assert told.drift == pytest.approx(rate)
    middle = float(np.mean(episode.times[list(shown)] - first))
    assert told.value == pytest.approx(rate * middle, abs=0.051)


def test_search_and_coarse_fit_approach_the_camera(episode) -> None:
    """With fewer starts and rounds than usual."""
    shown = range(0, 16, 2)
    frames = [PosedPicture(f"{k}", episode.values[k], episode.pictures[k]) for k in shown]
    search = PictureSearch(episode.body, episode.camera.with_pose(np.eye(4)), frames)
    rounds = ((64, 40, 24, 0.25), (64, 10, 50, 0.1))
    found = search.search(rounds, rotations=300, others=0)
    # Poses from starts far from the best one come last.
    again = search.search(rounds, rotations=300)
    np.testing.assert_array_equal(again[: len(found)], found)
    assert len(again) - len(found) in (1, 2)
    assert_close(np.linalg.inv(found[0]), episode.camera.X_WC, 0.08, 3.0)
    camera, explained = search.coarse_fit(found[0])[1:3]
    assert_close(camera.X_WC, episode.camera.X_WC, 0.005, 0.3)
    told = search.compared.explained(camera.X_CW)
    assert explained == told[0]
    assert evidence(*told) == pytest.approx(told[0] + 4.0 * told[1])
    # A body outside the pictures is not fitted.
    assert search.coarse_fit(np.diag([-1.0, 1.0, -1.0, 1.0]) @ found[0]) is None


def near(camera, degrees):
    """Return a camera that is rotated a little about the arm."""
    turn = np.radians(degrees) * np.array([0.5, -0.6, 0.6, 0.0, 0.0, 0.0])
    return camera.with_pose(motion(turn) @ camera.X_WC)


@pytest.fixture(scope="module")
def registered(episode, recording) -> PictureRegistration:
    """From a camera rotated by a degree, and a time offset wrong by ten milliseconds."""
    clock = TimeOffset(LATE - 0.01, np.inf, np.zeros((0, 2)))
    start = PictureStart(near(episode.camera, 1.0), range(0, 16, 3), clock, ())
    return fit_pictures(episode.body, start, recording(), 0.0, ())


def test_time_offset_and_camera_are_fitted_within_their_deviations(registered, episode) -> None:
    assert_close(registered.found.camera.X_WC, episode.camera.X_WC, 0.006, 0.15)
    clock = registered.time_offset
    assert clock.determined
    assert abs(clock.value - LATE) < 4.0 * clock.deviation
    assert 0.0004 < clock.deviation < 0.0014
    assert clock.drift == 0.0
    assert all(one.is_inlier for one in registered.found.frames)
    # Masks and log-odds belong to the joint values before the last step.
    values = episode.values_at(episode.times[::3] + LATE - 0.01)
    np.testing.assert_allclose([one.values for one in registered.frames], values)
    np.testing.assert_array_equal(registered.pictures["0003"], episode.pictures[3])
    assert registered.focal_deviation == 0.0
    # A registration has the logged values, without the offsets that its frames were fitted with.
    offsets = np.arange(5.0)
    values_at = registered.recording.values_at
    logged = replace(registered.recording, values_at=lambda offset: values_at(offset) - offsets)
    start = PictureStart.of(registered)._replace(evidence=None)
    again = accept_fit(episode.body, registered.fit, logged, start, offsets, 0.0)
    np.testing.assert_allclose([one.values for one in again.frames], values - offsets)
    assert again.evidence == registered.evidence
    # A fit in which no more than half of the frames agree is refused; so is one to other rows.
    doubtful = replace(registered.fit)
    vars(doubtful)["inliers"] = np.arange(6) < 3
    with pytest.raises(RegistrationError, match="fit, in 3 of 6 frames"):
        accept_fit(episode.body, doubtful, logged, start, offsets, 0.0)
    other = replace(logged, values_at=lambda offset: logged.values_at(offset)[::-1])
    with pytest.raises(RegistrationError, match=r"about as well: p-value 0\.|explained better"):
        accept_fit(episode.body, registered.fit, other, start, offsets, 0.0)
    vague = replace(registered.fit)
    vars(vague)["covariance"] = 0.09 * np.eye(len(vague.fit.names))
    said = r"m away, has a standard deviation of \d\d\d mm and 17.2 degrees"
    with pytest.raises(RegistrationError, match=said):
        accept_fit(episode.body, vague, logged, start, offsets, 0.0)


def test_pictures_are_evaluated_with_the_registered_camera(registered, episode) -> None:
    """A picture without the body is lost, one of another frame an outlier; the rest are inliers."""
    pictures = [*episode.pictures]
    pictures[5], pictures[9] = episode.background.astype(np.uint8), pictures[2]
    zeros = np.arange(5.0)
    shown = replace(
        registered.recording,
        read=lambda k: pictures[k],
        values_at=lambda offset: registered.recording.values_at(offset) - zeros,
    )
    one = replace(registered, recording=shown, joint_offsets=zeros)
    frames, misfits, lost = evaluate_pictures(episode.body, one, registered.found)
    told = {one.frame: one for one in misfits}
    assert {name for name, one in told.items() if not one.is_inlier} | {*lost} == {"0005", "0009"}
    assert min(one.iou for one in told.values() if one.is_inlier) > 0.9
    expected = {f"{k:04d}": row - zeros for k, row in enumerate(episode.values)}
    for frame in frames:
        np.testing.assert_allclose(frame.values, expected[frame.name], atol=0.01)
        assert frame.foreground is None
    # Pictures that should not show the body are skipped.
    away = registered.found.camera.X_WC @ np.diag([-1.0, 1.0, -1.0, 1.0])
    behind = registered.found.camera.with_pose(away)
    nothing = evaluate_pictures(episode.body, one, replace(registered.found, camera=behind))
    assert nothing == ((), (), ())


def test_chosen_frames_are_the_most_dissimilar(episode):
    places = node_places(episode.body, episode.values)
    chosen = choose_frames(places, 4)
    assert len(set(chosen)) == 4
    apart = np.linalg.norm(places[:, None] - places, axis=-1).mean(axis=-1)
    for k in range(1, 4):
        nearest = apart[:, chosen[:k]].min(axis=1)
        assert nearest[chosen[k]] == nearest.max()


def test_drift_and_focal_length_are_fitted(episode, recording):
    rates = recording().rates_at(0.0)
    # The slope of the time offset is the drift.
    later = episode.times[:12] - episode.times[:12].mean()
    drifting = episode.values_at(episode.times[:12] + LATE - 0.005 * later)

    def search(values):
        frames = [PosedPicture(f"{k}", values[k], episode.pictures[k], rates[k]) for k in range(12)]
        return PictureSearch(episode.body, episode.camera, frames)

    fitted = search(drifting).fit(near(episode.camera, 0.5), (TIME_OFFSET,), 0.0)
    every = np.ones(len(later), bool)
    covariance = sum(fitted.fit.covariances(fitted.found, every))
    drift, deviation = fitted.fit.fit_slope(fitted.found, TIME_OFFSET, later, every, covariance)
    assert drift == pytest.approx(0.005, abs=0.002)
    assert 0.0 < deviation < 0.004
    # A wrong focal length is corrected.
    focal = 1.04 * episode.camera.focal_x
    wide = replace(episode.camera, focal_x=focal, focal_y=focal)
    values = episode.values_at(episode.times + LATE - 0.015)
    again = search(values).fit(near(wide, 0.5), (TIME_OFFSET,), focal=True)
    assert again.camera.focal_x == pytest.approx(episode.camera.focal_x, rel=0.02)
    k = again.fit.names.index(TIME_OFFSET)
    assert again.found.shared[k] == pytest.approx(0.015, abs=0.004)
    assert min(again.fit.inlier_ratios(again.found)) > 0.9


def test_uninformative_recordings_are_refused_before_the_search(episode, recording):
    still = 0.02 * episode.values
    moved = np.linalg.norm(np.ptp(node_places(episode.body, still), axis=0), axis=1).max()
    for values, words in (
        (np.full((16, 5), np.nan), "0 of its 16 pictures"),
        (still, f"hardly moves, by {1e3 * moved:.0f} mm"),
    ):
        given = recording(values_at=lambda _, values=values: values)
        with pytest.raises(RegistrationError, match=words):
            register_pictures(episode.body, episode.camera, given)


def test_a_recording_that_is_stuck_is_named(episode, recording):
    assert stuck_pictures(recording()) == ""
    stuck = recording(read=lambda k: episode.pictures[min(k, 9)])
    assert stuck_pictures(stuck).startswith("pictures '0009' to '0015' are the same picture")


@pytest.mark.slow
def test_camera_is_found_without_initial_guess_within_its_deviations(episode, recording):
    nowhere = episode.camera.with_pose(np.eye(4))
    found = register_pictures(episode.body, nowhere, recording())
    error = pose_error(found.found.camera.X_WC, episode.camera.X_WC)
    deviations = np.sqrt(np.diag(found.found.covariance))
    assert (np.abs(error) < 3.0 * deviations).all()
    assert np.linalg.norm(error[3:]) < 0.012
    clock = found.time_offset
    assert clock.value == pytest.approx(LATE, abs=4.0 * clock.deviation + 1e-3)
    assert found.time_offset.deviation < 0.02
    # The best scanned offset is next to the fitted one.
    offsets, scores = found.time_offset.scores.T
    assert offsets[scores.argmax()] == pytest.approx(LATE, abs=0.03)


def test_the_margin_of_inlier_ratios_holds_its_level():
    """Over pairs of equally good poses, whose frames differ more from each other than the poses."""
    rng = np.random.default_rng(5)
    margins = []
    for better in (0.0, 0.1):
        for _ in range(400):
            frames = rng.uniform(0.3, 0.8, 12)
            ratios, others = frames + rng.normal(0.0, 0.05, (2, 12))
            named = [dict(enumerate(one)) for one in (ratios + better, others)]
            margins.append(ratio_margin(*named))
    margins = np.array(margins).reshape(2, 400)
    assert np.mean(margins[0] > 1.96) < 0.025
    assert np.mean(margins[1] > 1.96) > 0.9
    # Only frames of both poses count, and one alone tells nothing.
    assert ratio_margin({1: 0.9, 2: 0.8}, {2: 0.1, 3: 0.9}) == 0.0


def test_the_rotation_between_poses_is_that_of_their_relative_rotation():
    X, axis = motion(np.array([0.4, -1.0, 0.2, 0, 0, 0])), np.array([1.0, 2.0, -2.0, 0, 0, 0]) / 3.0
    for angle in (0.0, 0.3, 3.0):
        assert rotation_between(X, motion(angle * axis) @ X) == pytest.approx(angle, abs=1e-7)


@pytest.mark.parametrize("mirrored", [False, True])
def test_mirrored_pictures_are_distinguished_at_the_opposite_pose(episode, recording, mirrored):
    """In mirrored pictures the search finds the camera on the body's other side."""
    own, camera = recording(), episode.camera
    search = PictureSearch(episode.body, camera, posed_pictures(own, range(0, 16, 2), LATE))
    if mirrored:
        X_CW = search.compared.opposite(camera.X_CW)
        pictures = posed_pictures(own.mirrored(), range(0, 16, 2), LATE)
        camera = camera.mirrored().with_pose(np.linalg.inv(X_CW))
        search = PictureSearch(episode.body, camera, pictures)
        X_CW = search.compared.improve([X_CW], evaluations=150, turn=0.08)[1][0]
        camera = camera.with_pose(np.linalg.inv(X_CW))
    best = search.coarse_fit(camera.X_CW)
    margin = ratio_margin(opposite_pose(best).ratios, best.ratios)
    assert margin > 1.96 if mirrored else margin < -3.0


def test_pictures_of_unusual_proportions_may_be_squeezed(episode):
    for *size, ratios in ((640, 480, [1]), (1280, 720, [1]), (224, 224, [1, 4 / 3, 16 / 9])):
        cameras = squeezed_cameras(replace(episode.camera, width=size[0], height=size[1]))
        assert [one.focal_y / one.focal_x for one in cameras] == pytest.approx(ratios)


def test_poses_are_ranked_by_what_they_explain_and_by_their_contours() -> None:
    """A wrong pose may explain more."""
    right = RoughPose(None, None, 0.10, {"a": 0.6, "b": 0.8})
    poor = RoughPose(None, None, 0.05, {"a": 0.2, "b": 0.4})
    wide = RoughPose(None, None, 0.40, {"a": 0.1, "b": 0.3})
    blind = RoughPose(None, None, 0.00, {"a": 0.1})
    assert right.agreement == pytest.approx(0.8)
    assert best_first([blind, poor, right, wide]) == [right, wide, poor, blind]


def test_pictures_are_segmented_up_to_a_distance_from_the_body() -> None:
    """The distance is a fraction of the square root of the body's area, here 0.5 times 20."""
    covered = np.zeros((80, 80), bool)
    covered[30:50, 30:50] = True
    colours, deviations = np.full((80, 80, 3), 60.0, np.float32), np.ones((80, 80), np.float32)
    alike = np.zeros(COLOURS)
    known = KnownBackground(colours, deviations, np.zeros((80, 80), bool), alike, alike)
    posed = PosedPicture("a", np.zeros(1), np.full((80, 80, 3), 200, np.uint8))
    frame = segment_picture(posed, known, np.eye(3, 4, dtype=np.float32), covered, around=0.5)
    unknown = foreground_picture(np.zeros((1, 1), np.float32))[0, 0]
    known_rows, known_columns = np.nonzero((frame.foreground != unknown).any(axis=2))
    for places in (known_rows, known_columns):
        assert (places.min(), places.max()) == (20, 59)


@pytest.mark.slow
def test_camera_is_found_in_compressed_pictures(episode, recording, tmp_path):
    path = tmp_path / "camera.mp4"
    write_pictures(path, episode.pictures, episode.times, "libx264", crf="33")
    found = register_pictures(episode.body, episode.camera, recording(read=Video(path).read))
    error = pose_error(found.found.camera.X_WC, episode.camera.X_WC)
    assert (np.abs(error) < 3.0 * np.sqrt(np.diag(found.found.covariance))).all()
    assert np.linalg.norm(error[3:]) < 0.025


@pytest.mark.slow
def test_drift_is_corrected(episode, recording):
    faster = recording(values_at=lambda offset: episode.values_at(0.97 * episode.times + offset))
    found = register_pictures(episode.body, episode.camera, faster)
    # Pictures show later poses, increasingly so.
    assert found.time_offset.drift == pytest.approx(0.03 / 0.97, abs=0.003)
    assert found.time_offset.drift_deviation < 0.003
    assert np.linalg.norm(pose_error(found.found.camera.X_WC, episode.camera.X_WC)[3:]) < 0.012


@pytest.mark.slow
@pytest.mark.parametrize("said", ["its pictures are mirrored", "no pose explains its pictures"])
def test_mirrored_pictures_and_joints_of_another_episode_are_refused(episode, recording, said):
    if "mirrored" in said:
        wrong = recording(read=lambda k: np.ascontiguousarray(episode.pictures[k][:, ::-1]))
    else:
        wrong = recording(values_at=lambda offset: -0.7 * episode.values_at(2.0 * episode.times))
    with pytest.raises(RegistrationError, match=said):
        register_pictures(episode.body, episode.camera, wrong)


@pytest.mark.slow
def test_unknown_lens_of_squeezed_pictures_is_found(episode, recording):
    """Pictures of 4:3 are squeezed to squares, and no focal length is known."""
    camera, side = episode.camera, 120

    def read(k: int) -> np.ndarray:
        return cv2.resize(episode.pictures[k], (side, side), interpolation=cv2.INTER_AREA)

    guess = replace(camera.resized(side, side), focal_x=0.65 * side, focal_y=0.65 * side)
    found = register_pictures(
        episode.body, guess, recording(read=read), focal=0.5, guessed_lens=True
    ).found
    true = camera.focal_x * side / camera.width
    assert found.camera.focal_x == pytest.approx(true, rel=0.05)
    assert found.camera.focal_y == pytest.approx(camera.focal_y * side / camera.height, rel=0.05)
    error = pose_error(found.camera.X_WC, camera.X_WC)
    assert np.linalg.norm(error[3:]) < 3.0 * found.translation_sd
