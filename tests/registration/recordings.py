"""Painted episodes as folders of pictures with a joint log."""

import csv

import cv2
import numpy as np

from drake_pose.camera.camera_files import save_cameras

NAMES = tuple(f"joint{k}" for k in range(5))


def write_log(path, times, values, names=NAMES):
    """Write joint positions by time (CSV)."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", *names])
        writer.writerows([t, *row] for t, row in zip(times, values, strict=True))


def write_images(folder, pictures, times):
    """Write pictures (n, H, W, 3) and their times [s]."""
    folder.mkdir(parents=True)
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{k:04d}.png"), picture[..., ::-1])
    rows = [f"{k:04d},{t}" for k, t in enumerate(times)]
    (folder / "timestamps.csv").write_text("\n".join(["frame,time", *rows]))


def write_episode(scene, painted):
    """Write a folder of pictures with times, a joint log at another rate, and the camera."""
    write_images(scene / "images" / "camera", painted.pictures, painted.times)
    save_cameras(scene / "cameras.yaml", [painted.camera])
    times = np.arange(-0.5, painted.times[-1] + 0.5, 0.05)
    write_log(scene / "joint_angles.csv", times, painted.values_at(times))
