"""Recordings of a textured square in a textured room, with the masks known."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import PinholeCamera

WIDTH, HEIGHT, SIDE = 80, 60, 16
"""Size of the pictures, and side of the square [pixel]."""


def texture(rng, shape=(160, 200)):
    """Return a smooth random picture (H, W, 3)."""
    values = cv2.GaussianBlur(rng.integers(0, 256, (*shape, 3)).astype(np.float32), (0, 0), 4.0)
    return 20.0 + 200.0 * (values - values.min()) / np.ptp(values)


def square(left: int, top: int = 20, side: int = SIDE) -> np.ndarray:
    """Return the mask (H, W) of a square."""
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[top : top + side, left : left + side] = True
    return mask


def save(path: Path, picture: np.ndarray) -> Path:
    """Write a picture (H, W) or (H, W, 3) and its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture.clip(0, 255).astype(np.uint8))
    return path


def save_rig(path: Path, names: Sequence[str] = ("front", "side")) -> Path:
    """Write a camera file for the pictures."""
    place = 50.0, 50.0, WIDTH / 2, HEIGHT / 2
    save_cameras(path, [PinholeCamera(k, WIDTH, HEIGHT, *place, np.eye(4)) for k in names])
    return path


def write_room(
    folder: Path, masks: Sequence[np.ndarray], cameras: Sequence[str] = ("front",), seed: int = 0
) -> Path:
    """Write images/<camera>/<frame>.png, background/<camera>.png and cameras.yaml."""
    rng = np.random.default_rng(seed)
    skin = 235.0 - 0.3 * texture(rng, (HEIGHT, WIDTH))
    for camera in cameras:
        room = 0.4 * texture(rng, (HEIGHT, WIDTH))
        for name, mask in ((f"background/{camera}", square(0, side=0)), *(
            (f"images/{camera}/{k:04d}", mask) for k, mask in enumerate(masks)
        )):  # fmt: skip
            seen = np.where(mask[:, :, None], skin, room)
            save(folder / f"{name}.png", seen + 2.0 * rng.standard_normal(seen.shape))
    save_rig(folder / "cameras.yaml", cameras)
    return folder


def write_masks(folder: Path, masks: Mapping[str, np.ndarray]) -> Path:
    """Write black and white pictures by path below a folder, without suffix."""
    for name, mask in masks.items():
        save(folder / f"{name}.png", 255 * mask)
    return folder


def write_coco(
    path: Path, annotations: Mapping[str, Sequence[tuple[int, Any]]], **size: int
) -> Path:
    """Write a COCO file: (class, segmentation) pairs by picture; classes are 3: arm, 4: tool."""
    size = {"width": WIDTH, "height": HEIGHT} | size
    images = [{"id": k, "file_name": name} | size for k, name in enumerate(annotations)]
    areas = [
        {"id": 100 * k + n, "image_id": k, "category_id": number, "segmentation": area}
        for k, own in enumerate(annotations.values())
        for n, (number, area) in enumerate(own)
    ]
    names = [{"id": 3, "name": "arm"}, {"id": 4, "name": "tool"}]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"images": images, "annotations": areas, "categories": names}))
    return path


def box(left: int, top: int = 20, side: int = SIDE) -> list[list[float]]:
    """Return the square as a COCO polygon."""
    right, bottom = left + side, top + side
    return [[left, top, right, top, right, bottom, left, bottom]]
