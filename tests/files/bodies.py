"""A small model of each kind of position, and records of its frames."""

from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body import ArticulatedModel, load_model
from drake_pose.files.records import FrameRecord
from tests.body.models import joint, link, urdf, write


def three_joints(folder: Path) -> ArticulatedModel:
    """Return a model of an angle, 1 to 2 rad, a length, 3 to 3.4 m, and a continuous angle."""
    parts = [link(name) for name in ("base", "arm", "slide", "wheel")]
    parts += [
        joint("weld", "fixed", "world", "base", limits=None),
        joint("bend", "revolute", "base", "arm", limits='lower="1" upper="2"'),
        joint("reach", "prismatic", "arm", "slide", limits='lower="3" upper="3.4"'),
        joint("turn", "continuous", "slide", "wheel", limits=None),
    ]
    return load_model(write(folder, urdf(*parts)), check=False)


def record(E_total: float | None = 0.1, frame: str = "a", **more: Any) -> FrameRecord:
    """Return the record of a frame, at the positions 0 unless others are given."""
    return FrameRecord(frame, more.pop("q", np.zeros(3)), None, E_total, 2.0, **more)


def interval(determined: bool, low: float, high: float) -> dict[str, Any]:
    """Return the estimate of a joint."""
    return {"determined": determined, "low": low, "high": high, "value": None}
