"""Common mistakes in scenes, as corrections: misread poses, exchanges, mirrors, focal lengths."""

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, product
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, PinholeCamera, inverse_pose, pose_matrix
from drake_pose.fit.judge import LEVEL
from drake_pose.fit.parameters import CAMERA_NAMES
from drake_pose.registration.large_errors import Correction, unchanged
from drake_pose.registration.online_registration import pose_difference
from drake_pose.registration.posed_frames import MultiViewFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.scoring import draw_mask

T = TypeVar("T")

MIRRORED = (
    "they fit when they are mirrored: turn the pictures back, or change the sign of all joint "
    "positions"
)
"""What is wrong with the masks of a camera or of all, in words, as in `other_rows`."""


def scene_corrections(
    cameras: Sequence[Camera],
    values: Sequence[Array],
    frames: Sequence[str],
    *,
    focal: Sequence[float] = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.2, 1.4, 2.0),
    sizes: Sequence[float] = (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 1.5, 2.0, 3.0, 4.0),
) -> Iterator[Correction]:
    """Yield corrections of mistakes that users make; each is to be tried by itself.

    Args:
        cameras: the cameras at their given poses; at most ten pairs are exchanged.
        values: for each frame (m,) values of the pose tree [rad or m].
        frames: names of the frames, in order.
        focal: factors of focal lengths.
        sizes: of pictures for which intrinsics may be meant [size of the camera's pictures].
    """

    def mirrored(group: Collection[str], frame: MultiViewFrame) -> MultiViewFrame:
        masks = frame.masks.items()
        turned = {k: np.ascontiguousarray(v[:, ::-1]) if k in group else v for k, v in masks}
        return replace(frame, masks=turned)

    def with_row(rows: Mapping[str, Array], frame: MultiViewFrame) -> MultiViewFrame:
        return replace(frame, values=rows[frame.name])

    of_name = {camera.name: camera for camera in cameras}
    # All cameras, then each camera alone if there are several.
    groups = [[*of_name], *([name] for name in of_name if len(of_name) > 1)]
    for reading in readings():
        # Those of a misread rotation and a second mistake are for `likeliest_reading` alone.
        for group in () if reading.is_turned and reading.steps > 1 else groups:
            reread = {k: of_name[k].with_pose(reading.meant(of_name[k].X_WC)) for k in group}
            whose = "every X_WC" if len(group) > 1 else f"X_WC of camera '{group[0]}'"
            rank = reading.steps + 1 - len(group)
            text = f"{whose} seems to be {reading.text}"
            yield Correction("reading", text, _changed(cameras, reread), unchanged, 0.0, rank)
    for a, b in list(combinations(cameras, 2))[:10]:
        text = f"cameras '{a.name}' and '{b.name}' seem to be exchanged"
        swapped: dict[str, Camera] = {a.name: a.with_pose(b.X_WC), b.name: b.with_pose(a.X_WC)}
        yield Correction("reading", text, _changed(cameras, swapped), unchanged)
        if (a.width, a.height) == (b.width, b.height):
            # The same with their intrinsics: the folders of masks were exchanged.
            swapped = {a.name: replace(b, name=a.name), b.name: replace(a, name=b.name)}
            yield Correction("reading", text, _changed(cameras, swapped), unchanged)
    for group in groups:
        whose = "all cameras" if len(group) > 1 else f"camera '{group[0]}'"
        text = f"the masks of {whose}: {MIRRORED}"
        yield Correction("reading", text, tuple(cameras), partial(mirrored, group))
        own = [one for k in group if isinstance(one := of_name[k], PinholeCamera)]
        if len(own) < len(group):
            continue
        text = "focal lengths" if len(group) > 1 else f"focal length of {whose}"
        for factor in focal:
            longer = {
                one.name: replace(one, focal_x=factor * one.focal_x, focal_y=factor * one.focal_y)
                for one in own
            }
            fitted = tuple(f"{name}.{CAMERA_NAMES[6]}" for name in group)
            changed, amount = _changed(cameras, longer), float(np.log(factor))
            yield Correction("focal", text, changed, unchanged, amount, 1.0, fitted)
        for size in sizes:
            scaled = {k.name: k.with_scaled_intrinsics(1.0 / size, 1.0 / size) for k in own}
            shape = f"{size * own[0].width:.0f} x {size * own[0].height:.0f} pixels"
            text = (
                f"the intrinsics of {whose} seem to be those of pictures of {shape}: divide focal "
                f"lengths and principal point by {size:.4g}"
            )
            yield Correction("reading", text, _changed(cameras, scaled), unchanged)
        exchanged = {k.name: replace(k, center_x=k.center_y, center_y=k.center_x) for k in own}
        text = f"center_x and center_y of {whose} seem to be exchanged"
        yield Correction("reading", text, _changed(cameras, exchanged), unchanged)
    for text, rows in other_rows(values):
        shifted = dict(zip(frames, rows, strict=True))
        yield Correction(
            "reading", f"the masks: {text}", tuple(cameras), partial(with_row, shifted)
        )


def _changed(cameras: Sequence[Camera], changed: Mapping[str, Camera]) -> tuple[Camera, ...]:
    """Return the cameras with some of them, by name, replaced."""
    return tuple(changed.get(camera.name, camera) for camera in cameras)


def other_rows(rows: Sequence[T]) -> Iterator[tuple[str, list[T]]]:
    """Yield rows shifted by one frame to either side, with words; nothing for two frames or less.

    rows: joint positions, or what else the frames have, in order.
    """
    for which, by in (("next", 1), ("previous", -1)) if len(rows) > 2 else ():
        text = f"they fit with the joint positions of the {which} frame"
        yield text, [*rows[by:], *rows[:by]]


def joint_exchanges(
    cameras: Sequence[Camera], joints: Sequence[str], rows: Sequence[int]
) -> Iterator[Correction]:
    """Yield corrections that exchange the logged positions of two joints.

    Args:
        cameras: the cameras, which stay.
        joints: names of the joints.
        rows: for each joint its index in a frame's values.
    """

    def exchanged(a: int, b: int, frame: MultiViewFrame) -> MultiViewFrame:
        values = frame.values.copy()
        values[[a, b]] = values[[b, a]]
        return replace(frame, values=values)

    for (one, a), (other, b) in combinations(zip(joints, rows, strict=True), 2):
        text = f"the columns of joints '{one}' and '{other}' seem to be exchanged in the log"
        yield Correction("reading", text, tuple(cameras), partial(exchanged, a, b))


def shift_correction(
    body: RegistrationBody,
    cameras: Sequence[Camera],
    frames: Sequence[MultiViewFrame],
    least: float = 5.0,
) -> Correction | None:
    """Return a correction of principal points that brings the body to the masks' middles.

    Args:
        body: the robot's surfaces.
        cameras: the cameras; parallel ones stay.
        frames: with masks of the cameras.
        least: minimum shift of a camera's pictures [pixel]; smaller ones are left to fits.

    Returns the correction; None: no camera's pictures are shifted that far.
    """
    shifted, texts = list(cameras), list[str]()
    for k, camera in enumerate(cameras):
        shifts = []
        for frame in frames if isinstance(camera, PinholeCamera) else ():
            X_CN = camera.X_CW @ body.kinematics.poses(frame.values)
            drawn, mask = draw_mask(body.coarse, X_CN, camera), frame.masks.get(camera.name)
            if mask is not None and mask.any() and drawn.any():
                middle, of_mask = (np.argwhere(one).mean(axis=0) for one in (drawn, mask))
                shifts.append(of_mask - middle)
        y, x = np.median(shifts, axis=0) if shifts else (0.0, 0.0)
        if isinstance(camera, PinholeCamera) and max(abs(x), abs(y)) >= least:
            center = camera.center_x + x, camera.center_y + y
            shifted[k] = replace(camera, center_x=center[0], center_y=center[1])
            texts.append(f"to that of camera '{camera.name}' add {x:.0f}, {y:.0f} px")
    text = f"principal points seem to be off, or cameras turned: {'; '.join(texts)}"
    return Correction("reading", text, tuple(shifted), unchanged) if texts else None


class Reading(NamedTuple):
    """What a given X_WC may mean if its numbers were written by another convention.

    text: in words, after "X_WC seems to be". meant: returns X_WC (4, 4) for the given matrix
    (4, 4). steps: number of mistakes that the reading assumes. is_turned: whether a misread
    rotation is among the mistakes. of_world: whether the world is turned, not the camera.
    """

    text: str
    meant: Callable[[Array], Array]
    steps: int
    is_turned: bool = False
    of_world: bool = False


def readings() -> Iterator[Reading]:
    """Yield what a given X_WC may mean, for all commands.

    The readings are all combinations of a misread rotation, another unit, the inverse and another
    frame of the camera; and worlds turned about the robot's z axis.
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

    def about_base(R: Array, X: Array) -> Array:
        return np.vstack([R @ X[:3], X[3:]])

    for of_turn, of_unit, of_place, of_frame in product(turns, units, inverses, frames):
        words = [one for one in (of_place, of_frame, of_turn, of_unit) if one]
        if words:
            parts = turns[of_turn], units[of_unit], inverses[of_place], frames[of_frame]
            yield Reading(", and ".join(words), partial(_reread, *parts), len(words), bool(of_turn))
    for degrees in (90, 180, 270):
        R_turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        text = f"that of a world turned by {degrees} degrees about the z axis of the robot's"
        yield Reading(text, partial(about_base, R_turn), 1, of_world=True)


def _reread(
    turn: Callable[[Array], Array], unit: float, inverse: bool, R: Array, X: Array
) -> Array:
    """Return the pose (4, 4) that a matrix X (4, 4) means.

    Args:
        turn: returns the rotation (3, 3) that the matrix' rotation means.
        unit: of the matrix' lengths [m].
        inverse: whether the result is then inverted.
        R: (3, 3) rotation of the camera's axes, applied last.
        X: the matrix.
    """
    reread = pose_matrix(turn(X[:3, :3]), unit * X[:3, 3])
    reread = inverse_pose(reread) if inverse else reread
    reread[:3, :3] = reread[:3, :3] @ R
    return reread


def _rotations() -> dict[str, Callable[[Array], Array]]:
    """Return functions to what a rotation (3, 3) may mean, by words.

    Its numbers were read as one kind or order of Euler angles, quaternions or rotation vectors, but
    written as another. Euler angles read about fixed x, y, z axes are those about moving z, y, x
    axes: two orders of reading stand for four.
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
        """Return what R means; is_second: of its two triples of angles, that beyond 90 degrees."""
        vector = angles("xyz", R)
        if is_second:
            vector = np.array([0.0, np.pi, 0.0]) + [1.0, -1.0, 1.0] * vector + [np.pi, 0.0, np.pi]
            vector = (vector + np.pi) % (2.0 * np.pi) - np.pi
        return np.asarray(Rotation.from_rotvec(vector).as_matrix())

    def of_small_angles(R: Array) -> Array:
        """Return what R means if its angles are so small that radians were read as degrees."""
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
    meanings: dict[str, Callable[[Array], Array]] = {
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
            # Fixed z, y, x read as moving x, y, z is moving z, y, x read as fixed x, y, z.
            if meant != given and (given, meant) != ("XYZ", "zyx"):
                text = f"made of Euler angles about {words}, read as about {orders[given]}"
                meanings[text] = partial(of_euler, given, meant)
    return meanings


def likeliest_reading(
    given: Array, found: Array, distance: float, *, near: float = 0.15, least: float = 0.05
) -> tuple[str, float, float] | None:
    """Return the reading of a given pose that brings it near the pose that was found.

    A reading counts if it is three times nearer than the pose as given, and not as near by chance,
    that is, with a random rotation or position. Of the readings that count, the one with the fewest
    mistakes is returned, unless another reading is much nearer.

    The size of a difference is the norm of its angle [rad] and of its shift over `distance`.

    Args:
        given, found: (4, 4) X_WC as given, and as found [m].
        distance: from the camera to the body [m].
        near: maximum size of the reading's difference.
        least: size of the given pose's difference below which it needs no other reading.

    Returns the reading in words, and its difference from the pose found: angle [rad] and shift [m];
    None: no reading counts.
    """

    def difference_of(X: Array) -> tuple[float, float]:
        difference = pose_difference(found, X)
        return float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))

    def size(angle_and_shift: tuple[float, float]) -> float:
        return float(np.hypot(angle_and_shift[0], angle_and_shift[1] / distance))

    as_given = size(difference_of(given))
    if as_given < least:
        return None
    table = list(readings())
    counted = list[tuple[int, float, str, tuple[float, float]]]()
    for reading in table:
        X = reading.meant(given)
        angle, shift = difference_of(X)
        # The fraction of all rotations within the angle, and of positions within the shift.
        chance = (angle - np.sin(angle)) / np.pi if np.abs(X - given)[:3, :3].max() > 1e-9 else 1.0
        if reading.of_world:
            # Most cameras stand upright and look at the robot, so one angle decides.
            chance = angle / np.pi
        elif np.abs(X - given)[:3, 3].max() > 1e-9:
            chance *= (shift / (shift + distance)) ** 3
        alike = sum(other.steps <= reading.steps for other in table)
        its_size = size((angle, shift))
        if alike * chance < LEVEL and its_size < min(near, as_given / 3.0):
            counted.append((reading.steps, its_size, reading.text, (angle, shift)))
    if not counted:
        return None
    nearest = min(size for _, size, *_ in counted)
    _, _, text, (angle, shift) = min(one for one in counted if one[1] <= 2.0 * nearest + 0.01)
    return text, angle, shift
