"""Common mistakes in scenes, as corrections: conventions, exchanges, mirrors, focal lengths."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.registration.large_errors import Correction, unchanged
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
    for text, change in _conventions():
        for group in _groups(cameras):
            moved = [
                one.with_pose(change(one.X_WC)) if one.name in group else one for one in cameras
            ]
            whose = "every X_WC" if len(group) > 1 else f"X_WC of camera '{group[0]}'"
            yield Correction(
                "reading", f"{whose} {text}", tuple(moved), unchanged, 0.0, 2 - len(group)
            )
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


def _conventions() -> Iterator[tuple[str, Callable[[Array], Array]]]:
    """Yield other meanings of a given X_WC: words, and a function from the given (4, 4) to X_WC."""
    axes = {
        "": np.eye(3),
        "that of ROS' camera_link (x forward, y left, z up)":
            np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
        "in the convention of OpenGL (x right, y up, z back)": np.diag([1.0, -1.0, -1.0]),
    }  # fmt: skip

    def convert(unit: float, inverse: bool, R: Array, X: Array) -> Array:
        """Return X (4, 4) with lengths times `unit`, perhaps inverted, on axes rotated by R."""
        scaled = X * np.array([1.0, 1.0, 1.0, unit])
        scaled[3, 3] = 1.0
        found = np.array(np.linalg.inv(scaled) if inverse else scaled)
        found[:3, :3] = found[:3, :3] @ R
        return found

    for unit, of_unit in ((1.0, ""), (1e-3, "in millimetres"), (1e-2, "in centimetres")):
        for is_inverse in (False, True):
            for of_axes, R in axes.items():
                of_place = "the inverse of the camera's pose in the world" if is_inverse else ""
                words = [one for one in (of_place, of_axes, of_unit) if one]
                if words:
                    text = f"seems to be {', and '.join(words)}"
                    yield text, partial(convert, unit, is_inverse, R)

    def change_rotation(change: Callable[[Array], Array], X: Array) -> Array:
        X = X.copy()
        X[:3, :3] = change(X[:3, :3])
        return X

    yield "seems to hold the inverse of its rotation", partial(change_rotation, np.transpose)

    def reordered(given: str, meant_by: str, R: Array) -> Array:
        """Return the rotation of R's (3, 3) Euler angles in order `given`, read as `meant_by`."""
        angles = Rotation.from_matrix(R).as_euler(given)
        return np.asarray(Rotation.from_euler(meant_by, angles).as_matrix())

    for orders in ("xyz", "XYZ"), ("XYZ", "xyz"):
        text = "seems to be made of Euler angles in another order"
        yield text, partial(change_rotation, partial(reordered, *orders))
    for degrees in (90, 180, 270):
        R_turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()

        def about_base(R: Array, X: Array) -> Array:
            return np.vstack([R @ X[:3], X[3:]])

        text = f"is of a world turned by {degrees} degrees about the z axis of the robot's"
        yield text, partial(about_base, R_turn)
