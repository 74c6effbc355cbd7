"""Conventions of a recorded camera pose are told from the pose that the pictures show."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import load_model
from drake_pose.camera.models import ParallelCamera, inverse_pose
from drake_pose.jobs.registration.readings import (
    focal_correction,
    joint_exchanges,
    likeliest_reading,
    readings,
    scene_corrections,
    shift_correction,
)
from drake_pose.registration.posed_frames import MultiViewFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.scoring import draw_mask
from tests.benchmarks.rooms import _around
from tests.search.arms import arm_cameras, arm_urdf


def upright(rng):
    """A camera that looks at a robot's middle from any side: X_WC, and its distance [m]."""
    away = rng.uniform(0.7, 1.7) * _around(rng, rng.uniform(-0.1, 0.8))
    forward = -away / np.linalg.norm(away)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    X = np.eye(4)
    X[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    X[:3, :3] = X[:3, :3] @ Rotation.from_rotvec(rng.normal(0.0, 0.1, 3)).as_matrix()
    X[:3, 3] = away
    X[2, 3] += 0.4
    return X, float(np.linalg.norm(away))


def off_by_a_bit(rng, X):
    """Return X as a good calibration has it: two degrees and 20 mm off."""
    X = X.copy()
    X[:3, :3] = X[:3, :3] @ Rotation.from_rotvec(rng.normal(0.0, 0.02, 3)).as_matrix()
    X[:3, 3] += rng.normal(0.0, 0.012, 3)
    return X


def rotated(change, X):
    X = X.copy()
    X[:3, :3] = change(Rotation.from_matrix(X[:3, :3])).as_matrix()
    return X


def euler(meant, read):
    return partial(rotated, lambda R: Rotation.from_euler(read, R.as_euler(meant)))


def quaternion(shift):
    return partial(rotated, lambda R: Rotation.from_quat(np.roll(R.as_quat(), shift)))


def link(X):
    X = X.copy()
    X[:3, :3] = X[:3, :3] @ np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    return X


def scaled(by, X):
    X = X.copy()
    X[:3, 3] *= by
    return X


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (inverse_pose, ["the inverse of the camera's pose"]),
        (link, ["ROS' camera_link"]),
        (lambda X: X @ np.diag([1.0, -1.0, -1.0, 1.0]), ["OpenGL"]),
        (partial(scaled, 1e3), ["in millimetres"]),
        (euler("XYZ", "xyz"), ["moving x, y, z axes, read as about fixed x, y, z"]),
        (euler("ZYX", "xyz"), ["moving z, y, x axes, read as about fixed x, y, z"]),
        (euler("zyx", "xyz"), ["fixed z, y, x axes, read as about fixed x, y, z"]),
        (euler("xyz", "XYZ"), ["fixed x, y, z axes, read as about moving x, y, z"]),
        (quaternion(1), ["in the order w, x, y, z"]),
        (quaternion(-1), ["in the order x, y, z, w"]),
        (
            partial(rotated, lambda R: Rotation.from_euler("xyz", R.as_rotvec())),
            ["made of a rotation vector"],
        ),
        (
            partial(rotated, lambda R: Rotation.from_euler("xyz", np.radians(R.as_euler("xyz")))),
            ["in radians, read as degrees"],
        ),
        (lambda X: scaled(1e3, inverse_pose(link(X))), ["inverse", "camera_link", "millimetres"]),
        (lambda X: quaternion(1)(inverse_pose(X)), ["inverse", "in the order w, x, y, z"]),
    ],
)
def test_a_convention_is_named(wrong, words):
    rng = np.random.default_rng(45)
    for _ in range(5):
        X, distance = upright(rng)
        found = likeliest_reading(wrong(off_by_a_bit(rng, X)), X, distance)
        assert found is not None
        text, angle, shift = found
        for word in words:
            assert word in text
        assert angle < np.radians(8.0)
        assert shift < 0.08


def test_no_convention_is_named_for_a_camera_elsewhere():
    rng = np.random.default_rng(46)
    for _ in range(60):
        X, distance = upright(rng)
        other, _ = upright(rng)
        assert likeliest_reading(other, X, distance) is None
        turned = X.copy()
        turned[:3, :3] = Rotation.random(random_state=rng.integers(1 << 30)).as_matrix()
        assert likeliest_reading(turned, X, distance) is None
        assert likeliest_reading(off_by_a_bit(rng, X), X, distance) is None


LEFT, RIGHT = arm_cameras()
SMALL = RIGHT.resized(160, 120)


def frames_of(count: int) -> tuple[list[np.ndarray], list[MultiViewFrame]]:
    """Return values, and frames whose masks of both cameras are distinct."""
    rng = np.random.default_rng(2)
    values = [rng.normal(size=3) for _ in range(count)]
    masks = [
        {"left": rng.random((240, 320)) < 0.5, "right": rng.random((240, 320)) < 0.5}
        for _ in values
    ]
    return values, [
        MultiViewFrame(f"{k}", q, own) for k, (q, own) in enumerate(zip(values, masks, strict=True))
    ]


def test_corrections_of_exchanged_mirrored_and_shifted_input() -> None:
    values, frames = frames_of(4)
    names = [one.name for one in frames]
    found = list(scene_corrections((LEFT, RIGHT), values, names))
    swapped = [one for one in found if one.name.startswith("cameras '")]
    poses, cameras = swapped
    np.testing.assert_array_equal(poses.cameras[0].X_WC, RIGHT.X_WC)
    np.testing.assert_array_equal(poses.cameras[1].X_WC, LEFT.X_WC)
    assert [one.name for one in cameras.cameras] == ["left", "right"]
    np.testing.assert_array_equal(cameras.cameras[0].X_WC, RIGHT.X_WC)
    # Cameras of other sizes cannot have exchanged folders of masks.
    other = list(scene_corrections((LEFT, SMALL), values, names))
    assert sum(one.name.startswith("cameras '") for one in other) == 1
    mirrored = [one for one in found if "mirrored" in one.name]
    whose = [("left", "right"), ("left",), ("right",)]
    assert ["all cameras" in one.name for one in mirrored] == [True, False, False]
    for one, group in zip(mirrored, whose, strict=True):
        changed = one.apply(frames[1])
        for name, mask in frames[1].masks.items():
            expected = mask[:, ::-1] if name in group else mask
            np.testing.assert_array_equal(changed.masks[name], expected)
    for which, shift in (("next", 1), ("previous", -1)):
        (one,) = (one for one in found if f"of the {which} frame" in one.name)
        for k in (1, 2):
            np.testing.assert_array_equal(one.apply(frames[k]).values, values[k + shift])
    few = list(scene_corrections((LEFT,), values[:2], names[:2]))
    assert not any("frame" in one.name and "joint positions" in one.name for one in few)
    assert not any("exchanged" in one.name and "cameras '" in one.name for one in few)


def test_corrections_of_intrinsics() -> None:
    """Focal lengths by factors; intrinsics of pictures of other sizes; exchanged centres."""
    values, frames = frames_of(3)
    names = [one.name for one in frames]
    found = list(scene_corrections((LEFT, RIGHT), values, names, focal=(0.5, 1.2), sizes=(2.0,)))
    focal = [one for one in found if one.kind == "focal"]
    assert [one.name for one in focal] == [
        *["focal lengths"] * 2, *["focal length of camera 'left'"] * 2,
        *["focal length of camera 'right'"] * 2,
    ]  # fmt: skip
    for k, one in enumerate(focal):
        factor = (0.5, 1.2)[k % 2]
        assert one.amount == pytest.approx(factor - 1.0)
        for camera, given, group in zip(one.cameras, (LEFT, RIGHT), ((0, 1), (0, 2)), strict=True):
            by = factor if k // 2 in group else 1.0
            assert camera.focal_x == pytest.approx(by * given.focal_x)
            assert camera.focal_y == pytest.approx(by * given.focal_y)
    sized = [one for one in found if "of pictures of 640 x 480" in one.name]
    assert len(sized) == 3
    # Intrinsics of pictures of twice the size: a resized camera gives them back.
    twice = LEFT.resized(640, 480)
    wrong = replace(twice, width=320, height=240)
    (one, *_) = (
        one for one in scene_corrections((wrong,), values, names, sizes=(2.0,))
        if "divide focal lengths and principal point by 2" in one.name
    )  # fmt: skip
    (camera,) = one.cameras
    np.testing.assert_allclose(
        [camera.focal_x, camera.focal_y, camera.center_x, camera.center_y],
        [LEFT.focal_x, LEFT.focal_y, LEFT.center_x, LEFT.center_y],
    )
    exchanged = [one for one in found if "center_x and center_y" in one.name]
    assert len(exchanged) == 3
    assert (exchanged[1].cameras[0].center_x, exchanged[1].cameras[1].center_x) == (
        LEFT.center_y, RIGHT.center_x,
    )  # fmt: skip
    flat = ParallelCamera("flat", 320, 240, 100.0, 159.5, 119.5, LEFT.X_WC)
    assert not any(one.kind == "focal" for one in scene_corrections((flat,), values, names))
    changed = focal_correction((flat, LEFT), (), "text", 2.0)
    assert changed.cameras[0] is flat
    assert changed.cameras[1].focal_x == 2.0 * LEFT.focal_x


def test_columns_of_two_joints_are_exchanged() -> None:
    _, frames = frames_of(1)
    found = list(joint_exchanges((LEFT,), ("a", "b", "c"), (0, 1, 2)))
    assert len(found) == 3
    q = frames[0].values
    for one, order in zip(found, ([1, 0, 2], [2, 1, 0], [0, 2, 1]), strict=True):
        np.testing.assert_array_equal(one.apply(frames[0]).values, q[order])
    assert "'a' and 'b' seem to be exchanged" in found[0].name


def test_pose_corrections_are_ranked_by_their_mistakes() -> None:
    """Of all cameras before one; those of two mistakes with a misread rotation are left out."""
    values, frames = frames_of(1)
    found = [one for one in scene_corrections((LEFT, RIGHT), values, ["0"]) if "X_WC" in one.name]
    single = [one for one in readings() if not (one.is_turned and one.steps > 1)]
    assert len(found) == 3 * len(single)
    for one, reading in zip(found[::3], single, strict=True):
        assert one.rank == reading.steps - 1
        assert one.name == f"every X_WC seems to be {reading.text}"
        np.testing.assert_allclose(one.cameras[1].X_WC, reading.meant(RIGHT.X_WC))
    for one, reading in zip(found[1::3], single, strict=True):
        assert one.rank == reading.steps
        assert one.name == f"X_WC of camera 'left' seems to be {reading.text}"
        np.testing.assert_allclose(one.cameras[0].X_WC, reading.meant(LEFT.X_WC))
        assert one.cameras[1] is RIGHT
    assert frames[0].values is values[0]


def test_shifted_masks_shift_principal_points(tmp_path) -> None:
    """By the median over frames of the distance of body and mask; small ones are left to fits."""
    path = tmp_path / "arm.urdf"
    path.write_text(arm_urdf())
    body = RegistrationBody(load_model(path, check=False).pose_tree())
    rng, frames = np.random.default_rng(1), []
    for k in range(5):
        values = rng.uniform(0.4 * body.kinematics.lower, 0.4 * body.kinematics.upper)
        X_WN, masks = body.kinematics.poses(values), {}
        for camera in (LEFT, RIGHT):
            by = np.array([12, -9]) if camera is LEFT else np.array([3, 2])
            mask = draw_mask(body.coarse, camera.X_CW @ X_WN, camera)
            masks[camera.name] = np.roll(mask, by if k else 5 * by, axis=(1, 0))
        frames.append(MultiViewFrame(f"{k}", values, masks))
    found = shift_correction(body, (LEFT, RIGHT), frames)
    assert found is not None
    assert found.cameras[1] is RIGHT
    assert found.cameras[0].center_x - LEFT.center_x == pytest.approx(12.0, abs=1.0)
    assert found.cameras[0].center_y - LEFT.center_y == pytest.approx(-9.0, abs=1.0)
    assert "to that of camera 'left' add 12, -9 px" in found.name
    assert shift_correction(body, (RIGHT,), frames) is None
    black = [replace(one, masks={"left": one.masks["left"] & False}) for one in frames]
    assert shift_correction(body, (LEFT, RIGHT), black) is None
