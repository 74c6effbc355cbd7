"""Pictures of Date's experiment in the manner of the paper's figures 2, 3, 4 and 7."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from drake_pose.papers.date.experiment import TITLES, DateResult
from drake_pose.papers.date.stages import draw_faces, draw_points, draw_skin


def save_pictures(result: DateResult, folder: Path) -> list[Path]:
    """Draw, for each motion, the input and all estimates side by side, and the errors over time.

    For the same frames: skin in a picture, its points in space, and the faces.

    Args:
        result: the experiment.
        folder: where the PNG files go; made if it is not there.

    Returns:
        The files written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for motion, picture in result.pictures.items():
        files.append(folder / f"figure_07_{motion}.png")
        cv2.imwrite(str(files[-1]), np.ascontiguousarray(picture[:, :, ::-1]))
    files += _save_stages(result, folder)
    figure = Figure(figsize=(9.0, 3.5), layout="constrained")
    axes = figure.add_subplot()
    for way, errors in result.errors.items():
        axes.semilogy(errors.mean(axis=1), label=TITLES[way])
    starts = [k for k, n in enumerate(result.names) if k == 0 or n != result.names[k - 1]]
    for k in starts:
        axes.axvline(k, color="0.8", zorder=0)
        axes.text(k, 1.0, f" {result.names[k]}", transform=axes.get_xaxis_transform(), va="bottom")
    axes.set(xlabel="frame", ylabel="joint centres' mean error [mm]")
    axes.legend()
    files.append(folder / "errors.png")
    figure.savefig(files[-1], dpi=120)
    return files


def _save_stages(result: DateResult, folder: Path) -> list[Path]:
    """Figures 2 to 4; returns the files written."""
    files = []
    for motion, shown in result.stages.items():
        files.append(folder / f"figure_02_{motion}.png")
        cv2.imwrite(str(files[-1]), np.ascontiguousarray(draw_skin(shown)[:, :, ::-1]))
        files.append(folder / f"figure_03_{motion}.png")
        draw_points(shown, result.rig).savefig(files[-1], dpi=120)
    faces = draw_faces(result.stages)
    if faces is not None:
        files.append(folder / "figure_04.png")
        faces.savefig(files[-1], dpi=120)
    return files
