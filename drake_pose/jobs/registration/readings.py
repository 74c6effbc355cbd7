"""Common mistakes in scenes, as corrections: conventions, exchanges, mirrors, focal lengths."""

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, PinholeCamera, inverse_pose
from drake_pose.registration.large_errors import Correction, unchanged
from drake_pose.registration.online_registration import pose_difference
from drake_pose.registration.posed_frames import MultiViewFrame


def scene_corrections(
    cameras: Sequence[Camera],
    values: Sequence[Array],
    frames: Sequence[str],
    *,
    pairs: int = 10,
    factors: Sequence[float] = (
        0.5,
        0.6,
        0.7,
        0.8,
        0.85,
        0.9,
        0.95,
        1.05,
        1.1,
        1.15,
        1.2,
        1.4,
        2.0,
    ),
) -> Iterator[Correction]:
    """Yield corrections of mistakes that users make, each to be tried by itself.

    Args:
        cameras: the cameras at their given poses.
        values: for each frame (m,) values of the pose tree [rad or m].
        frames: names of the frames, in order.
        pairs: maximum number of camera pairs that are exchanged.
        factors: factors of focal lengths.
    """
    for reading in readings():
        # A misread rotation with another mistake is compared with registered poses only.
        for group in () if reading.is_turned and reading.steps > 1 else _groups(cameras):
            moved = [
                one.with_pose(reading.meant(one.X_WC)) if one.name in group else one
                for one in cameras
            ]
            whose = "every X_WC" if len(group) > 1 else f"X_WC of camera '{group[0]}'"
            text = f"{whose} seems to be {reading.text}"
            rank = reading.steps + 1 - len(group)
            yield Correction("reading", text, tuple(moved), unchanged, 0.0, rank)
    for a, b in list(combinations(range(len(cameras)), 2))[:pairs]:
        other = list(cameras)
        other[a] = cameras[a].with_pose(cameras[b].X_WC)
        other[b] = cameras[b].with_pose(cameras[a].X_WC)
        text = f"cameras '{cameras[a].name}' and '{cameras[b].name}' seem to be exchanged"
        yield Correction("reading", text, tuple(other), unchanged)
    for group in _groups(cameras):
        whose = "all cameras" if len(group) > 1 else f"camera '{group[0]}'"
        text = f"the masks of {whose} seem to be mirrored: turn the pictures back"
        yield Correction("reading", text, tuple(cameras), _mirrored(group))
        if not all(isinstance(one, PinholeCamera) for one in cameras if one.name in group):
            continue
        text = "focal lengths" if len(cameras) > 1 and len(group) > 1 else "focal length of camera"
        text += "" if len(group) > 1 else f" '{group[0]}'"
        for factor in factors:
            yield focal_correction(cameras, group, text, factor)
    for which, by in (("next", 1), ("previous", -1)) if len(frames) > 2 else ():
        rows = dict(zip(frames, np.roll(np.array(values), -by, axis=0), strict=True))
        text = f"the masks fit with the joint positions of the {which} frame"
        yield Correction("reading", text, tuple(cameras), partial(_with_row, rows))


def focal_correction(
    cameras: Sequence[Camera], group: Collection[str], text: str, factor: float
) -> Correction:
    """Return a correction that multiplies focal lengths by a factor.

    Args:
        cameras: all cameras.
        group: names of the cameras that are corrected; empty: all. Parallel ones stay.
        text: the correction's name.
    """
    changed = [
        replace(one, focal_x=factor * one.focal_x, focal_y=factor * one.focal_y)
        if isinstance(one, PinholeCamera) and (not group or one.name in group)
        else one
        for one in cameras
    ]
    return Correction("focal", text, tuple(changed), unchanged, factor - 1.0)


def _groups(cameras: Sequence[Camera]) -> list[tuple[str, ...]]:
    """Return groups of cameras' names: all together first, then each if there are several."""
    names = tuple(one.name for one in cameras)
    return [names, *((name,) for name in names if len(names) > 1)]


def _mirrored(group: Collection[str]) -> Callable[[MultiViewFrame], MultiViewFrame]:
    """Return a function that mirrors a frame's masks of the named cameras left to right."""

    def change(frame: MultiViewFrame) -> MultiViewFrame:
        masks = {
            name: np.ascontiguousarray(mask[:, ::-1]) if name in group else mask
            for name, mask in frame.masks.items()
        }
        return replace(frame, masks=masks)

    return change


def _with_row(rows: Mapping[str, Array], frame: MultiViewFrame) -> MultiViewFrame:
    """Return a frame with other values of the pose tree; rows: (m,) by the frame's name."""
    return replace(frame, values=rows[frame.name])


class Reading(NamedTuple):
    """Another meaning of the X_WC that is given.

    text: in words, after "X_WC seems to be". meant: function from the given (4, 4) to X_WC. steps:
    number of mistakes that it takes. is_turned: whether one of them is a misread rotation.
    of_world: whether the world is turned, not the camera.
    """

    text: str
    meant: Callable[[Array], Array]
    steps: int
    is_turned: bool = False
    of_world: bool = False


def readings() -> Iterator[Reading]:
    """Yield other meanings of a given X_WC, one table for all commands.

    They are combinations of a misread rotation, another unit, the inverse and another frame of the
    camera; and a world turned about the robot's z axis.
    """
    frames = {
        "": np.eye(3),
        "that of ROS' camera_link (x forward, y left, z up)":
            np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
        "in the convention of OpenGL (x right, y up, z back)": np.diag([1.0, -1.0, -1.0]),
        "an optical frame that was turned like ROS' camera_link":
            np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    }  # fmt: skip
    units = {"": 1.0, "in millimetres": 1e-3, "in centimetres": 1e-2}
    turns = {"": np.asarray} | _rotations()
    inverses = {"": False, "the inverse of the camera's pose in the world": True}
    for of_turn, of_unit, of_place, of_frame in product(turns, units, inverses, frames):
        words = [one for one in (of_place, of_frame, of_turn, of_unit) if one]
        if words:
            parts = turns[of_turn], units[of_unit], inverses[of_place], frames[of_frame]
            yield Reading(", and ".join(words), partial(_reread, *parts), len(words), bool(of_turn))
    for degrees in (90, 180, 270):
        R_turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        text = f"that of a world turned by {degrees} degrees about the z axis of the robot's"
        yield Reading(text, partial(_about_base, R_turn), 1, of_world=True)


def _reread(
    turn: Callable[[Array], Array], unit: float, inverse: bool, R: Array, X: Array
) -> Array:
    """Return X (4, 4) with its rotation reread and lengths times `unit`, perhaps inverted.

    R: (3, 3) turns the camera's axes at last.
    """
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turn(X[:3, :3]), unit * X[:3, 3]
    found = inverse_pose(found).copy() if inverse else found
    found[:3, :3] = found[:3, :3] @ R
    return found


def _about_base(R: Array, X: Array) -> Array:
    """Return X (4, 4) turned by R (3, 3) about the world's origin."""
    return np.vstack([R @ X[:3], X[3:]])


def _rotations() -> dict[str, Callable[[Array], Array]]:
    """Return other meanings of a rotation (3, 3), by words.

    Its numbers were read in one order or form of Euler angles, quaternions or rotation vectors, but
    are meant in another. xyz read as fixed axes is zyx read as moving axes, so two orders as read
    stand for four.
    """

    def angles(order: str, R: Array) -> Array:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Gimbal lock.
            return np.asarray(Rotation.from_matrix(R).as_euler(order))

    def of_euler(given: str, meant: str, R: Array) -> Array:
        return np.asarray(Rotation.from_euler(meant, angles(given, R)).as_matrix())

    def of_quaternion(shift: int, R: Array) -> Array:
        turned = np.roll(Rotation.from_matrix(R).as_quat(), shift)
        return np.asarray(Rotation.from_quat(turned).as_matrix())

    def of_vector(is_second: bool, R: Array) -> Array:
        """The same rotation has a second triple of angles, beyond a quarter turn about y."""
        vector = angles("xyz", R)
        if is_second:
            vector = np.array([0.0, np.pi, 0.0]) + [1.0, -1.0, 1.0] * vector + [np.pi, 0.0, np.pi]
            vector = (vector + np.pi) % (2.0 * np.pi) - np.pi
        return np.asarray(Rotation.from_rotvec(vector).as_matrix())

    def of_small_angles(R: Array) -> Array:
        """Radians that were read as degrees are small."""
        small = angles("xyz", R)
        scale = np.degrees(1.0) if np.abs(small).max() <= np.radians(np.pi) else 1.0
        return np.asarray(Rotation.from_euler("xyz", scale * small).as_matrix())

    def euler_of_vector(R: Array) -> Array:
        vector = Rotation.from_matrix(R).as_rotvec()
        return np.asarray(Rotation.from_euler("xyz", vector).as_matrix())

    orders = {
        "xyz": "fixed x, y, z axes", "XYZ": "moving x, y, z axes",
        "zyx": "fixed z, y, x axes", "ZYX": "moving z, y, x axes",
    }  # fmt: skip
    found: dict[str, Callable[[Array], Array]] = {
        "one with the inverse of its rotation": np.transpose,
        "made of a quaternion in the order w, x, y, z, read as x, y, z, w": partial(
            of_quaternion, -1
        ),
        "made of a quaternion in the order x, y, z, w, read as w, x, y, z": partial(
            of_quaternion, 1
        ),
        "made of a rotation vector, read as Euler angles": partial(of_vector, False),
        "made of a rotation vector, read as Euler angles beyond 90 degrees": partial(
            of_vector, True
        ),
        "made of Euler angles, read as a rotation vector": euler_of_vector,
        "made of Euler angles in radians, read as degrees": of_small_angles,
    }
    for given in ("xyz", "XYZ"):
        for meant, words in orders.items():
            # What fixed z, y, x, read as moving x, y, z, means is among the others already.
            if meant != given and (given, meant) != ("XYZ", "zyx"):
                text = f"made of Euler angles about {words}, read as about {orders[given]}"
                found[text] = partial(of_euler, given, meant)
    return found


def likeliest_reading(
    given: Array,
    found: Array,
    distance: float,
    *,
    significance: float = 0.01,
    much_nearer: float = 3.0,
    near: float = 0.15,
    least: float = 0.05,
) -> tuple[str, float, float] | None:
    """Return the reading of a given pose that brings it near to the pose that was found.

    A reading counts if it is much nearer than the pose as given, and would hardly be as near by
    chance: random rotations are within an angle, and random positions within a distance, with known
    probability. Of those that count the one with the fewest mistakes is returned, unless another is
    much nearer.

    Args:
        given, found: (4, 4) X_WC as given, and as found [m].
        distance: from the camera to the body [m].
        significance: maximum probability that one of the readings is as near by chance.
        much_nearer: minimum factor between the differences from the pose found.
        near: maximum difference of a reading from the pose found, by angle [rad] and shift
            [distance].
        least: the same of a pose that needs no other reading.

    Returns:
        The reading in words, and its difference from the pose found: angle [rad] and shift [m];
        None: no reading counts.
    """

    def off(X: Array) -> tuple[float, float]:
        by = pose_difference(found, X)
        return float(np.linalg.norm(by[:3])), float(np.linalg.norm(by[3:]))

    def size(one: tuple[float, float]) -> float:
        return float(np.hypot(one[0], one[1] / distance))

    as_given = size(off(given))
    if as_given < least:
        return None
    table = list(readings())
    counted = list[tuple[int, float, str, tuple[float, float]]]()
    for one in table:
        X = one.meant(given)
        angle, shift = off(X)
        # The part of all rotations within an angle, and of a ball around the camera.
        chance = (angle - np.sin(angle)) / np.pi if np.abs(X - given)[:3, :3].max() > 1e-9 else 1.0
        if one.of_world:
            # Most cameras stand upright and look at the robot, so one angle decides.
            chance = angle / np.pi
        elif np.abs(X - given)[:3, 3].max() > 1e-9:
            chance *= (shift / (shift + distance)) ** 3
        alike = sum(other.steps <= one.steps for other in table)
        now = size((angle, shift))
        if alike * chance < significance and now < min(near, as_given / much_nearer):
            counted.append((one.steps, now, one.text, (angle, shift)))
    if not counted:
        return None
    nearest = min(size for _, size, *_ in counted)
    _, _, text, (angle, shift) = min(one for one in counted if one[1] <= 2.0 * nearest + 0.01)
    return text, angle, shift
