"""Masks of a small arm at known joint positions, rendered by Drake."""

import cv2
import numpy as np

from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import PinholeCamera, look_at
from drake_pose.registration.hand_eye import motion
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

# A camera's place, and the point in the arm at which it looks [m].
PLACE, MIDDLE = np.array([1.6, 0.4, 0.5]), np.array([0.0, 0.0, 0.4])


def looking_at(place: np.ndarray, middle: np.ndarray, roll: float) -> PinholeCamera:
    """Return a camera at a place (3,) that looks at a point (3,), rolled about its axis [rad]."""
    X_WC = look_at(place, middle) @ motion(np.array([0.0, 0.0, roll, 0.0, 0.0, 0.0]))
    return PinholeCamera("eye", 640, 480, 600.0, 600.0, 319.5, 239.5, X_WC)


def shifted(camera: PinholeCamera, *by: float) -> PinholeCamera:
    """Return a camera that is moved along the world's axes [m]."""
    return camera.with_pose(motion(np.array([0.0, 0.0, 0.0, *by])) @ camera.X_WC)


def see(
    model: ArticulatedModel, body: RegistrationBody, camera: PinholeCamera, count: int, seed: int
) -> list[PosedFrame]:
    """Return frames with Drake's masks of random joint positions."""
    rng, kinematics = np.random.default_rng(seed), body.kinematics
    renderer = LabelRenderer(model, camera)
    frames = []
    for k in range(count):
        values = rng.uniform(kinematics.lower, kinematics.upper)
        q, X_WB = body.tree.positions_from(kinematics.split(values))
        frames.append(PosedFrame(f"{k:04d}", values, renderer.mask(q, X_WB)))
    return frames


def damaged(mask: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return a mask dilated or eroded by up to two pixels, with holes of 3 % of its area."""
    by = int(generator.integers(-2, 3))
    ball = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(by) + 1,) * 2)
    change = cv2.dilate if by > 0 else cv2.erode
    return with_holes(change(mask.astype(np.uint8), ball), generator)


def with_holes(mask: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return a mask with round holes of 3 % of its area."""
    drawn = mask.astype(np.uint8)
    at = np.argwhere(drawn)
    while drawn.sum() > 0.97 * len(at):
        v, u = at[generator.integers(len(at))].tolist()
        cv2.circle(drawn, (u, v), int(generator.integers(3, 9)), 0, -1)
    return drawn > 0


def errors(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Return the errors of a pose (4, 4): translation [m] and rotation [rad]."""
    cosine = 0.5 * (np.trace(found[:3, :3].T @ true[:3, :3]) - 1.0)
    shift = float(np.linalg.norm(found[:3, 3] - true[:3, 3]))
    return shift, float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def assert_close(found: np.ndarray, true: np.ndarray, metres: float, degrees: float) -> None:
    """Assert that a pose (4, 4) errs by less than so many metres and degrees."""
    shift, turn = errors(found, true)
    assert shift < metres
    assert turn < np.radians(degrees)
