"""Pictures of the tiny crane in a textured room, from Drake's silhouettes."""

from pathlib import Path

import cv2
import numpy as np

from drake_pose.silhouette.pictures.scenes import load_scene
from tests.jobs.scenes import TinyScene, write_scene


def texture(rng, shape=(160, 200)):
    """Return a smooth random picture (H, W, 3)."""
    values = cv2.GaussianBlur(rng.integers(0, 256, (*shape, 3)).astype(np.float32), (0, 0), 4.0)
    return 20.0 + 200.0 * (values - values.min()) / np.ptp(values)


def write_pictures(
    folder: Path, angles, cameras=("front",), noise: float = 3.0, seed: int = 0
) -> TinyScene:
    """Write a scene with images/<camera>/<frame>.png and background/<camera>.png."""
    scene, rng = write_scene(folder, angles, cameras), np.random.default_rng(seed)
    loaded = load_scene(folder)
    skin = texture(rng)
    for camera in cameras:
        room = texture(rng)

        def save(path, picture):
            path.parent.mkdir(parents=True, exist_ok=True)
            noisy = picture + noise * rng.standard_normal(picture.shape)
            cv2.imwrite(str(path), noisy.clip(0, 255).astype(np.uint8))

        save(folder / "background" / f"{camera}.png", room)
        for frame in loaded.frames:
            mask = loaded.read(camera, frame)[:, :, None]
            save(folder / "images" / camera / f"{frame}.png", np.where(mask, skin, room))
    return scene


def moving(count=40):
    """Return joint angles [deg] of a moving crane."""
    t = np.linspace(0.0, 4.0 * np.pi, count)
    return np.column_stack([60.0 * np.sin(t), -60.0 + 50.0 * np.cos(1.7 * t)])
