"""Episodes of an arm of boxes, painted over Drake's label images."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import PinholeCamera, look_at
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks.registration import load_arm, write_box_arm

LATE = 0.06
"""Time offset of the shared episode's pictures [s]."""


@dataclass(frozen=True, eq=False)
class PaintedEpisode:
    """Pictures (f, H, W, 3) of a swinging arm with values (f, m) at times (f,) [s]."""

    path: Path
    model: ArticulatedModel
    body: RegistrationBody
    camera: PinholeCamera
    times: np.ndarray
    values: np.ndarray
    pictures: np.ndarray
    background: np.ndarray

    def values_at(self, times: np.ndarray) -> np.ndarray:
        """Return the true values (n, m) at times (n,) [s]."""
        return swinging(np.asarray(times), self.values.shape[1])


def swinging(times: np.ndarray, count: int) -> np.ndarray:
    """Return positions (n, count) of joints that swing, each at its own rate."""
    k = np.arange(count)
    return 0.9 * np.sin(2.0 * k + (1.1 + 0.25 * k) * times[:, None]) + 0.15 * (k - 2)


def painted_episode(
    folder: Path, frames: int = 16, size: tuple[int, int] = (160, 120), late: float = 0.0,
    every: float = 0.4,
) -> PaintedEpisode:  # fmt: skip
    """Return an episode with a picture `every` [s], of the arm `late` [s] after its time."""
    path = write_box_arm(folder / "boxes.urdf")
    body = load_arm(path)
    width, height = size
    middle, forward = np.array([0.0, 0.0, 0.45]), np.array([-0.85, 0.35, -0.25])
    eye = middle - 1.6 * forward / np.linalg.norm(forward)
    X_WC = look_at(eye, middle, up=(0.1, 0.0, 1.0))
    focal = 0.95 * width
    camera = PinholeCamera(
        "camera", width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), X_WC
    )
    rng = np.random.default_rng(3)
    patches = rng.uniform(20.0, 235.0, (9, 12, 3)).astype(np.float32)
    background = cv2.resize(patches, size, interpolation=cv2.INTER_CUBIC).clip(0.0, 255.0)
    times = np.arange(frames) * every
    values = swinging(times + late, len(body.kinematics.names))
    renderer, pictures = LabelRenderer(body.tree.model, camera), []
    colours = rng.uniform(30.0, 225.0, (20, 3))
    for row in values:
        segments = renderer.segments(*body.tree.positions_from(body.kinematics.split(row)))
        painted = np.where((segments >= 0)[..., None], colours[segments], background)
        noisy = painted + rng.normal(0.0, 2.0, painted.shape)
        pictures.append(np.clip(noisy, 0.0, 255.0).astype(np.uint8))
    return PaintedEpisode(
        path, body.tree.model, body, camera, times, values, np.array(pictures), background
    )
