"""Calibration of known cameras, from detections and pictures made by formulas of our own."""

import dataclasses

import cv2
import numpy as np
import pytest

from drake_pose.camera.board import (
    Board,
    Detection,
    find_boards,
    find_pictures,
    load_board,
)
from drake_pose.camera.calibrate import CalibrationSettings, calibrate
from drake_pose.camera.rig import (
    Lens,
    _vector,
    corner_residuals,
    load_lenses,
    save_lenses,
)
from drake_pose.errors import CameraError, UnknownNameError
from tests.camera.boards import (
    CHARUCO,
    CHECKERBOARD,
    drawn_board,
    facing,
    inside,
    photograph,
    poses_for_pairs,
    ring,
    sightings_of,
)


def pose_error(X_true, X):
    """Distance [mm] and angle [deg] between two poses."""
    D = np.linalg.inv(X_true) @ X
    turn = np.linalg.norm(cv2.Rodrigues(D[:3, :3])[0])
    return 1e3 * np.linalg.norm(D[:3, 3]), np.degrees(turn)


def rig(count, pictures, noise=0.1, seed=0, board=CHECKERBOARD):
    generator = np.random.default_rng(seed)
    cameras = ring(count, generator, spread=360.0 if count > 5 else 45.0 * count)
    poses = poses_for_pairs(cameras, board, generator, pictures)
    return cameras, poses, sightings_of(cameras, board, poses, generator, noise)


def replaced(seen, camera, frames):
    """The detections with other ones in some of a camera's frames; None takes one out."""
    new = {**seen.detections[camera], **frames}
    new = {frame: detection for frame, detection in new.items() if detection is not None}
    return dataclasses.replace(seen, detections={**seen.detections, camera: new})


def bent(detection):
    uv = detection.uv + 8 * np.sin(detection.uv[:, ::-1] / 30)
    return Detection(detection.corners, uv)


def late_picture(seen, camera, seers):
    """A frame that so many cameras saw, and the detections where this one's is another's."""
    frames = seen.detections[camera]
    frame = next(f for f in frames if sum(f in o for o in seen.detections.values()) == seers)
    other = next(f for f in frames if f != frame)
    return frame, replaced(seen, camera, {frame: frames[other]})


class TestKnownCameras:
    def test_derivatives_are_those_of_differences(self):
        cameras, poses, seen = rig(3, 9)
        lens = calibrate(seen).lenses
        X_CW = [np.linalg.inv(camera.X_WC) for camera in cameras.values()]
        x = np.concatenate(
            [np.array([*lens[name].numbers().values()]) for name in cameras]
            + [_vector(X) for X in X_CW + list(poses.values())]
        )

        def residuals(x):
            return corner_residuals(seen, x, list(poses))

        _, J = residuals(x)
        for along in np.random.default_rng(4).normal(size=(12, len(x))):
            ends = [residuals(x + step * along)[0] for step in (1e-7, -1e-7)]
            np.testing.assert_allclose(J @ along, (ends[0] - ends[1]) / 2e-7, rtol=1e-5, atol=1e-2)

    @pytest.mark.parametrize("count", [1, 4])
    def test_without_noise_everything_is_found_exactly(self, count):
        cameras, poses, seen = rig(count, 6 * max(count, 2), noise=0.0)
        frame = next(iter(seen.detections["c0"]))
        found = calibrate(seen, CalibrationSettings(world=f"board:{frame}"))
        assert pose_error(np.eye(4), found.X_WB[frame])[0] < 1e-6
        X_BW = np.linalg.inv(poses[frame])
        p_W = poses[frame][:3, 3] + np.random.default_rng(1).uniform(-0.2, 0.2, (20, 3))
        p_B = p_W @ X_BW[:3, :3].T + X_BW[:3, 3]
        for name, true in cameras.items():
            lens = found.lenses[name]
            assert lens.focal_x == pytest.approx(true.focal, rel=1e-6)
            assert (lens.center_x, lens.center_y) == pytest.approx(tuple(true.center), abs=1e-3)
            assert lens.distortion[:4] == pytest.approx(true.distortion, abs=1e-5)
            distance, angle = pose_error(X_BW @ true.X_WC, found.cameras[name].X_WC)
            assert distance < 0.01
            assert angle < 1e-3
            assert found.camera_errors[name] < 1e-4
            # The undistorted cameras see points where undistorted pictures show them.
            straight = cv2.undistortPoints(
                true.project(p_W)[:, None], lens.matrix, lens.distortion, P=lens.straight_matrix
            )[:, 0]
            np.testing.assert_allclose(found.cameras[name].project(p_B)[0], straight, atol=0.05)

    def test_noise_is_reported_and_does_little_harm(self):
        cameras, _, seen = rig(8, 48, noise=0.1)
        found = calibrate(seen)
        assert found.world == "camera:c0"
        X_W0 = np.linalg.inv(cameras["c0"].X_WC)
        for name, true in cameras.items():
            # Two coordinates of 0.1 pixel, less what the unknowns take up.
            assert found.camera_errors[name] == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
            distance, angle = pose_error(X_W0 @ true.X_WC, found.cameras[name].X_WC)
            assert distance < 25.0
            assert angle < 0.6
        assert not found.left_out

    def test_lens_without_distortion_is_left_alone(self):
        generator = np.random.default_rng(3)
        cameras = ring(2, generator, spread=90.0, distorted=False)
        poses = poses_for_pairs(cameras, CHECKERBOARD, generator, 12)
        seen = sightings_of(cameras, CHECKERBOARD, poses, generator, 0.05)
        found = calibrate(seen, CalibrationSettings(lens="none"))
        for name, true in cameras.items():
            lens = found.lenses[name]
            assert not lens.distortion.any()
            assert lens.focal_x == pytest.approx(true.focal, rel=0.01)
            assert found.cameras[name].focal_x == lens.focal_x


class TestSpoiltPictures:
    @staticmethod
    def left_out(seen, words=None):
        """What is dropped of spoilt pictures, which are refused with these words otherwise."""
        with pytest.raises(CameraError, match=words):
            calibrate(seen)
        return calibrate(seen, CalibrationSettings(drop_spoilt=True))

    def test_picture_that_contradicts_its_own_lens_is_named(self):
        _, _, seen = rig(1, 12)
        frame = list(seen.detections["c0"])[3]
        spoilt = replaced(seen, "c0", {frame: bent(seen.detections["c0"][frame])})
        words = f"camera 'c0', picture '{frame}'.*leave out c0/{frame}"
        found = self.left_out(spoilt, words)
        clean = calibrate(seen, CalibrationSettings(leave_out=[f"c0/{frame}"]))
        assert found.lenses["c0"].matrix == pytest.approx(clean.lenses["c0"].matrix, rel=1e-9)

    def test_picture_of_another_instant_is_named_where_a_third_camera_tells(self):
        _, _, seen = rig(4, 20)
        frame, late = late_picture(seen, "c1", 3)
        found = self.left_out(late, f"camera 'c1', picture '{frame}'.*same instant")
        asked = calibrate(late, CalibrationSettings(leave_out=[f"c1/{frame}"]))
        assert set(found.left_out) == set(asked.left_out) == {("c1", frame)}
        for name, camera in found.cameras.items():
            np.testing.assert_allclose(camera.X_WC, asked.cameras[name].X_WC, atol=1e-5)

    def test_two_cameras_that_disagree_are_both_named(self):
        _, _, seen = rig(3, 15)
        frame, late = late_picture(seen, "c2", 2)
        pair = {name for name, frames in seen.detections.items() if frame in frames}
        found = self.left_out(late, "no third camera tells")
        assert set(found.left_out) == {(name, frame) for name in pair}


class TestCamerasThatDoNotFit:
    def test_camera_that_shares_no_picture_is_named(self):
        _, _, seen = rig(3, 15)
        own = seen.detections["c2"]
        alone = {f"alone_{frame}": one for frame, one in own.items()} | dict.fromkeys(own)
        apart = replaced(seen, "c2", alone)
        with pytest.raises(CameraError, match="camera 'c2' shares no picture"):
            calibrate(apart)
        found = calibrate(apart, CalibrationSettings(leave_out=["c2"]))
        assert set(found.cameras) == {"c0", "c1"}

    def test_camera_with_too_few_pictures_is_named(self):
        _, _, seen = rig(2, 12)
        few = replaced(seen, "c1", dict.fromkeys(list(seen.detections["c1"])[2:]))
        with pytest.raises(CameraError, match="camera 'c1': the board was found in 2 pictures"):
            calibrate(few)

    @pytest.mark.parametrize("board", [CHECKERBOARD, Board("checkerboard", 7, 6, 0.12)])
    def test_mirrored_checkerboard_pictures_are_recognised(self, board):
        _, _, seen = rig(3, 15, board=board)
        numbers = np.arange(len(board.points)).reshape(board.rows - 1, -1)
        # A mirror image of the board is the board with rows (or columns) exchanged: the colours
        # of the squares decide which.
        numbers = numbers[::-1] if board.rows % 2 == 1 else numbers[:, ::-1]
        mirrored = {
            frame: Detection(one.corners, ([639, 0] + one.uv * [-1, 1])[numbers.ravel()])
            for frame, one in seen.detections["c2"].items()
        }
        with pytest.raises(CameraError, match="camera 'c2': its pictures are mirrored"):
            calibrate(replaced(seen, "c2", mirrored))

    def test_camera_that_was_moved_meanwhile_is_named(self):
        cameras, poses, seen = rig(5, 30, seed=6)
        shift = np.eye(4)
        shift[0, 3] = 0.3
        moved = {"c2": dataclasses.replace(cameras["c2"], X_WC=cameras["c2"].X_WC @ shift)}
        late = sightings_of(moved, CHECKERBOARD, poses, np.random.default_rng(0)).detections["c2"]
        with pytest.raises(CameraError, match=r"Camera 'c2' takes part in all.*was it moved"):
            calibrate(replaced(seen, "c2", {f: late.get(f) for f in poses if f >= "0022"}))

    def test_camera_with_pictures_of_other_instants_is_named(self):
        _, _, seen = rig(4, 20)
        frames, old = list(seen.detections["c2"]), list(seen.detections["c2"].values())
        with pytest.raises(CameraError, match="camera 'c2' contradicts the others"):
            calibrate(replaced(seen, "c2", dict(zip(frames, old[1:] + old[:1], strict=True))))

    def test_pictures_too_much_alike_are_refused(self):
        cameras, poses, _ = rig(1, 4)
        still = {f"{k}": next(iter(poses.values())) for k in range(4)}
        seen = sightings_of(cameras, CHECKERBOARD, still, np.random.default_rng(0))
        with pytest.raises(CameraError, match=r"camera 'c0'.*tilt the board"):
            calibrate(seen)

    def test_ambiguous_board_is_refused_for_several_cameras(self):
        board = Board("checkerboard", 8, 6, 0.1)
        _, _, seen = rig(3, 9, board=board)
        with pytest.raises(CameraError, match="looks the same"):
            calibrate(seen)

    def test_unknown_names(self):
        _, _, seen = rig(2, 12)
        for settings, name in (
            ({"leave_out": ["c9"]}, "c9"),
            ({"world": "camera:c9"}, "c9"),
            ({"world": "board:0099"}, "0099"),
        ):
            with pytest.raises(UnknownNameError, match=name):
                calibrate(seen, CalibrationSettings(**settings))
        for wrong in ({"world": "left"}, {"lens": "fisheye"}, {"largest_error": 0.0}):
            with pytest.raises(CameraError):
                CalibrationSettings(**wrong)


class TestPictures:
    @pytest.mark.parametrize("board", [CHECKERBOARD, CHARUCO], ids=["checkerboard", "charuco"])
    def test_corners_are_found_in_drawn_pictures(self, board):
        generator = np.random.default_rng(2)
        cameras = ring(4, generator, radius=1.9)
        errors = []
        for X_WB in poses_for_pairs(cameras, board, generator, 4).values():
            for camera in cameras.values():
                uv = camera.project(board.points @ X_WB[:3, :3].T + X_WB[:3, 3])
                if not (facing(X_WB, camera, 0.6) and inside(uv, camera)):
                    continue
                detection = board.find(photograph(camera, board, X_WB, generator))
                if detection is None:
                    assert board.kind == "charuco"  # Small markers may escape.
                    continue
                errors.append(np.linalg.norm(detection.uv - uv[detection.corners], axis=1))
        assert len(errors) >= 4
        everything = np.concatenate(errors)
        assert np.sqrt(np.mean(everything**2)) < 0.4
        assert everything.max() < 2.0

    def test_turned_mirrored_and_colour_pictures(self):
        picture = cv2.resize(drawn_board(CHECKERBOARD), None, fx=0.5, fy=0.5)
        upright, down = (CHECKERBOARD.find(one) for one in (picture, picture[::-1, ::-1]))
        height, width = picture.shape
        np.testing.assert_allclose(down.uv, [width - 1, height - 1] - upright.uv, atol=0.05)
        picture = cv2.cvtColor(drawn_board(CHARUCO), cv2.COLOR_GRAY2BGR)
        assert len(CHARUCO.find(picture).corners) == len(CHARUCO.points)
        assert CHARUCO.find(picture[:, ::-1]) is None
        noise = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
        assert CHECKERBOARD.find(noise) is None

    def test_mirrored_pictures_of_markers_are_told(self, tmp_path):
        picture, files = drawn_board(CHARUCO), {}
        for name, shown in (("right", picture), ("mirror", picture[:, ::-1])):
            files[name] = {"1": tmp_path / f"{name}.png"}
            cv2.imwrite(str(files[name]["1"]), shown)
        seen = find_boards(files, CHARUCO)
        assert (seen.mirrored, seen.not_found) == (("mirror",), (("mirror", "1"),))
        with pytest.raises(CameraError, match="'mirror': its pictures are mirrored"):
            calibrate(seen)

    def test_pictures_of_one_camera_are_of_one_size(self, tmp_path):
        files = {frame: tmp_path / f"{frame}.png" for frame in ("1", "2")}
        for path, shape in zip(files.values(), ((20, 30), (30, 20)), strict=True):
            cv2.imwrite(str(path), np.zeros(shape, np.uint8))
        with pytest.raises(CameraError, match=r"2\.png: 20 x 30 pixels.*began with 30 x 20"):
            find_boards({"c": files}, CHECKERBOARD)
        seen = find_boards({"c": {"1": files["1"], "3": tmp_path / "3.png"}}, CHECKERBOARD)
        assert seen.sizes == {"c": (30, 20)}
        assert (seen.not_found, set(seen.unreadable)) == ((("c", "1"),), {("c", "3")})

    def test_folders_without_pictures_are_named(self, tmp_path):
        with pytest.raises(CameraError, match="no such folder"):
            find_pictures(tmp_path / "gone")
        (tmp_path / "images" / "left").mkdir(parents=True)
        with pytest.raises(CameraError, match="holds no picture"):
            find_pictures(tmp_path)


class TestLens:
    BARREL = Lens(640, 480, 500.0, 510.0, 310.0, 250.0, np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0]))

    def test_lenses_are_read_back(self, tmp_path):
        path = tmp_path / "lenses.yaml"
        save_lenses(path, {"a": self.BARREL})
        lens = load_lenses(path)["a"]
        assert lens.matrix.tolist() == self.BARREL.matrix.tolist()
        assert lens.distortion.tolist() == self.BARREL.distortion.tolist()
        path.write_text(path.read_text().replace("k3", "k4"))
        with pytest.raises(CameraError, match=r"lenses\.yaml: camera 'a': a lens has exactly"):
            load_lenses(path)

    def test_undistorted_picture_was_seen_to_its_edges(self):
        lens = calibrate(rig(2, 12)[2]).lenses["c0"]
        assert lens.distortion[0] < 0  # A barrel.
        white = np.full((480, 640), 255, np.uint8)
        assert lens.undistort(white).min() == 255
        with pytest.raises(CameraError, match="480 x 640"):
            lens.undistort(white.T)


CHECKER = "kind: checkerboard\nsquares: [9, 6]\nsquare_length: 0.03\n"
MARKERS = (
    "kind: charuco\nsquares: [7, 5]\nsquare_length: 0.04\nmarker_length: 0.03\n"
    "dictionary: DICT_5X5_100\n"
)


class TestBoardFiles:
    def test_good_files(self, tmp_path):
        path = tmp_path / "board.yaml"
        path.write_text(CHECKER)
        assert load_board(path) == Board("checkerboard", 9, 6, 0.03)
        path.write_text(MARKERS)
        np.testing.assert_allclose(
            load_board(path).points[[0, -1]], [[0.04, 0.16, 0], [0.24, 0.04, 0]]
        )

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("kind: circles\n", "kind"),
            (CHECKER.replace("square_length: 0.03", ""), "lacks square_length"),
            (CHECKER.replace("[9, 6]", "9"), "squares"),
            (CHECKER.replace("[9, 6]", "[9, 2]"), "squares"),
            (CHECKER.replace("0.03", "-1"), "square_length"),
            (CHECKER + "colour: red\n", "colour"),
            (MARKERS.replace("0.03", "0.05"), "marker_length"),
            (MARKERS.replace("5X5", "3X3"), "dictionary"),
            (MARKERS + "legacy_pattern: 3\n", "legacy_pattern"),
        ],
    )
    def test_bad_files_are_named(self, tmp_path, text, message):
        path = tmp_path / "board.yaml"
        path.write_text(text)
        with pytest.raises(CameraError, match=message) as caught:
            load_board(path)
        assert str(path) in str(caught.value)
