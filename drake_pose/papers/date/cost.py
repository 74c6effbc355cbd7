"""What a frame costs with more and more cameras, all silhouettes at once, on one core."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from drake_pose.papers.date.studio import Studio
from drake_pose.papers.date.tracks import SilhouetteTrack, see
from drake_pose.person.date.walking_motion import FEWEST_FRAMES, MOTIONS, make_motion

Array = NDArray[np.float64]

CAMERAS = (4, 8, 16)
_FRAMES = 12


def measure_cost(cameras: int, size: tuple[int, int] = (640, 480), seed: int = 0) -> Array:
    """Processor time of region and edge, and of the pose (2,), a frame [ms], the medians.

    The person walks, and is known where the measurement begins.

    Args:
        cameras: how many, the face camera included.
        size: width and height of the pictures [pixel].
        seed: of noise and motion.
    """
    studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
    motion = make_motion(studio.skeleton, 4 * FEWEST_FRAMES, seed)
    begin = motion.names.index(MOTIONS[0])
    track = SilhouetteTrack.build(studio.model, studio.cameras, studio.backgrounds)
    track.place(motion.q[begin])
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for q in motion.q[begin : begin + _FRAMES]:
            track.step(see(studio.pictures(q)))
    finally:
        cv2.setNumThreads(threads)
    laps = [(lap["region"] + lap["edge"], lap["pose"]) for lap in track.milliseconds]
    return np.asarray(np.median(laps, axis=0))


def cost_table(counts: Sequence[int] = CAMERAS) -> Table:
    """The cost for each number of cameras, and for each camera."""
    table = Table(title="Date, all silhouettes, 640 x 480, one core: milliseconds a frame")
    for heading in ("cameras", "region and edge", "pose", "all", "a camera"):
        table.add_column(heading, justify="right")
    for cameras in counts:
        seen, pose = measure_cost(cameras)
        whole = seen + pose
        each = whole / cameras
        table.add_row(str(cameras), *(f"{cost:.1f}" for cost in (seen, pose, whole, each)))
    return table
