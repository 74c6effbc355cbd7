"""`drake-pose calibrate`: cameras from pictures of a board, and how well they fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.markup import escape
from rich.table import Table

from drake_pose.camera.board import (
    BoardDetections,
    Picture,
    find_boards,
    find_pictures,
    load_board,
    read_board_picture,
)
from drake_pose.camera.calibrate import Calibration, CalibrationSettings, calibrate
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.rig import Lens, save_lenses
from drake_pose.errors import CameraError, listed
from drake_pose.files.folder import write_file


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """A calibration, in which pictures the board was found, and the files that were written."""

    calibration: Calibration
    seen: BoardDetections
    files: tuple[Path, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """What the user should look at, a line each."""
        lines = list(self.seen.unreadable.values())
        for camera in self.seen.detections:
            blank = [f"'{frame}'" for name, frame in self.seen.not_found if name == camera]
            if blank:
                lines.append(f"camera '{camera}': no board found in {listed(blank)}")
        for (camera, frame), reason in self.calibration.left_out.items():
            lines.append(f"camera '{camera}', picture '{frame}' left out: {reason}")
        return lines

    def errors(self, camera: str) -> dict[str, float]:
        """The errors of a camera's pictures by frame [pixel]."""
        errors = self.calibration.errors
        return {frame: error for (name, frame), error in errors.items() if name == camera}

    def as_json(self) -> dict[str, Any]:
        """Everything as plain values: errors in pixels, lengths in metres."""
        found = self.calibration
        cameras = {
            name: {
                "error_pixels": found.camera_errors[name],
                "pictures": self.errors(name),
                "as_taken": lens.numbers(),
                "X_WC": found.cameras[name].X_WC.tolist(),
            }
            for name, lens in found.lenses.items()
        }
        return {
            "world": found.world,
            "error_pixels": float(np.sqrt(np.mean(np.square(list(found.errors.values()))))),
            "cameras": cameras,
            "not_found": [list(picture) for picture in self.seen.not_found],
            "unreadable": [list(picture) for picture in self.seen.unreadable],
            "left_out": [
                {"camera": camera, "picture": frame, "reason": reason}
                for (camera, frame), reason in found.left_out.items()
            ],
            "files": [str(path) for path in self.files],
        }

    def table(self) -> Table:
        """One row a camera, the worst picture named."""
        found = self.calibration
        table = Table(
            "camera",
            "pictures",
            "error [pixel]",
            "worst picture",
            "focal length [pixel]",
            "k1, k2, p1, p2, k3",
            "place in the world [m]",
            title=escape(f"{len(found.cameras)} cameras, world = {found.world}"),
        )
        for name, lens in found.lenses.items():
            errors = self.errors(name)
            worst = max(errors, key=lambda frame: errors[frame])
            table.add_row(
                escape(name),
                str(len(errors)),
                f"{found.camera_errors[name]:.3f}",
                escape(f"{worst} ({errors[worst]:.3f})"),
                f"{lens.focal_x:.1f}, {lens.focal_y:.1f}",
                ", ".join(f"{k:.4f}" for k in lens.distortion),
                ", ".join(f"{p:.3f}" for p in found.cameras[name].X_WC[:3, 3]),
            )
        return table


def calibrate_folder(
    folder: str | Path,
    board: str | Path,
    out: str | Path | None = None,
    settings: CalibrationSettings | None = None,
) -> CalibrationReport:
    """Calibrates the cameras of a folder of pictures.

    Args:
        folder: holds `images/<camera>/<frame>.png` (or .jpg); same frame, same instant.
        board: the board's YAML file, see load_board.
        out: the camera file to write; the lenses go beside it, `<stem>_lenses.yaml`, for
            undistort_pictures. Nothing is written where not given.
        settings: how to calibrate; the defaults where not given.

    Raises:
        CameraError: names the file, camera or picture at fault, and what to do.
        UnknownNameError: the settings name a camera or frame that is not there.
    """
    seen = find_boards(find_pictures(folder), load_board(board))
    calibration = calibrate(seen, settings)
    if out is None:
        return CalibrationReport(calibration, seen)
    cameras = Path(out)
    lenses = cameras.with_name(f"{cameras.stem}_lenses.yaml")
    cameras.parent.mkdir(parents=True, exist_ok=True)
    save_cameras(cameras, calibration.cameras)
    save_lenses(lenses, calibration.lenses)
    return CalibrationReport(calibration, seen, (cameras, lenses))


def undistort_pictures(
    folder: str | Path, lenses: dict[str, Lens], out: str | Path
) -> dict[Picture, Path]:
    """Writes a folder's pictures free of distortion, as the calibrated cameras see them.

    Args:
        folder: holds `images/<camera>/<frame>.png` (or .jpg).
        lenses: from load_lenses, by camera.
        out: a folder; the pictures go to `images/<camera>/<frame>.png` in it.

    Returns:
        The files by (camera, frame).

    Raises:
        CameraError: a camera has no lens, or a picture cannot be read or has another size.
        OutputError: a picture cannot be written.
    """
    pictures = find_pictures(folder)
    for name in pictures:
        if name not in lenses:
            raise CameraError(f"camera '{name}' has no lens; there are: {', '.join(lenses)}")
    written = {}
    for name, frames in pictures.items():
        for frame, path in frames.items():
            straight = lenses[name].undistort(read_board_picture(path))
            place = f"images/{name}/{frame}.png"
            write_file(Path(out), place, cv2.imencode(".png", straight)[1].tobytes())
            written[name, frame] = Path(out) / place
    return written
