"""Pictures of Date's experiment in the manner of the paper's figure 7."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from drake_pose.apps.experiments.date.experiment import TITLES, DateResult


def save_pictures(result: DateResult, folder: Path) -> list[Path]:
    """Draw, for each motion, the input and all estimates side by side, and the errors over time.

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
