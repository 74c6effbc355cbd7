"""Benchmark of what a registration from pictures accepts and refuses.

Run as ``python -m tests.benchmarks.acceptance DATA [--rooms N] [--first K] [--only TEXT]``, see
``tests.benchmarks.episodes``. Positives are episodes as recorded; negatives have the joint
positions of another episode, mirrored pictures, or the model of another arm. The pictures are those
of videos (H.264).
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, load_model
from drake_pose.camera.picture_files import TimedVideo
from drake_pose.errors import RegistrationError
from drake_pose.registration.picture_registration import register_pictures
from drake_pose.registration.recording import Recording
from drake_pose.registration.register import RegistrationBody
from tests.benchmarks.episodes import ARMS, FAR, GREY
from tests.benchmarks.registration import pose_error
from tests.benchmarks.rooms import SimulatedEpisode, simulate
from tests.benchmarks.tables import print_table
from tests.camera.recordings import write_pictures

KINDS = ("as recorded", "joints of another episode", "mirrored pictures", "model of another arm")


class Decision(NamedTuple):
    """Result of one episode.

    Attributes:
        accepted: whether a camera was written.
        off: error of its position [mm]; NaN for negatives and refusals.
        p_value: NaN for refusals.
        seconds: CPU time [s].
    """

    accepted: bool
    off: float
    p_value: float
    seconds: float


def decide(data: Path, name: str, kind: str, seed: int) -> Decision:
    """Simulate an episode of an arm, spoil it, and register its camera.

    Args:
        data: folder of the models.
        name: of the arm, a key of ARMS.
        kind: one of KINDS.
        seed: of the episode.
    """
    model, episode = load_model(data / ARMS[name].file, check=False), _episode(data, name, seed)
    logged = episode.positions
    if kind == KINDS[1]:
        logged = _episode(data, name, seed + 1000).positions
    names = list(ARMS)
    shown = model
    if kind == KINDS[3]:
        after = (names * 2)[names.index(name) + 1 :]
        # A Panda with another gripper is the same arm.
        other = next(one for one in after if not ("Panda" in one and "Panda" in name))
        shown = load_model(data / ARMS[other].file, check=False)
        logged = as_positions(model, logged, shown)
    body = RegistrationBody(shown.pose_tree())
    columns = [shown.position_names.index(one) for one in body.kinematics.names]

    def values_at(offset: float | Array) -> Array:
        times = episode.times + offset
        rows = [np.interp(times, episode.log_times, logged[:, k]) for k in columns]
        return np.column_stack(rows)

    count = len(episode.times)
    recording = Recording(
        tuple(f"{k:04d}" for k in range(count)), values_at, episode.pictures.__getitem__,
        episode.times,
    )  # fmt: skip
    camera = episode.camera.with_pose(np.eye(4))
    if kind == KINDS[2]:
        recording = recording.mirrored()
        camera = camera.mirrored()
    start = time.process_time()
    try:
        one = register_pictures(body, camera, recording)
    except RegistrationError:
        return Decision(False, np.nan, np.nan, time.process_time() - start)
    error = pose_error(one.found.camera.X_WC, episode.camera.X_WC)
    off = 1e3 * float(np.linalg.norm(error[3:])) if kind == KINDS[0] else np.nan
    return Decision(True, off, one.p_value, time.process_time() - start)


def _episode(data: Path, name: str, seed: int) -> SimulatedEpisode:
    """Return a simulated episode of an arm, see ``simulate``, with pictures from a video."""
    arm = ARMS[name]
    model, grey = load_model(data / arm.file, check=False), seed % GREY == GREY - 1
    with tempfile.TemporaryDirectory() as folder:
        drawn = simulate(
            model, Path(folder), seed, grey=grey, distance=arm.distance, middle=arm.middle
        )
        path = Path(folder) / "camera.mp4"
        write_pictures(path, drawn.pictures, drawn.times, "libx264", crf="23")
        video = TimedVideo(path)
        pictures = [video.read(k) for k in range(len(drawn.times))]
    return replace(drawn, pictures=np.array(pictures))


def as_positions(model: ArticulatedModel, logged: Array, other: ArticulatedModel) -> Array:
    """Return positions (n, nq) of a model as those of another one, joint by joint in order."""
    moving = [
        np.flatnonzero(np.isfinite(one.lower) & (one.upper - one.lower > 0.1))
        for one in (model, other)
    ]
    count = min(len(one) for one in moving)
    positions = np.tile(other.default_positions, (len(logged), 1))
    positions[:, moving[1][:count]] = logged[:, moving[0][:count]]
    return np.clip(positions, other.lower, other.upper)


def _rows(data: Path, rooms: range, only: str) -> Iterator[list[str]]:
    for kind in KINDS:
        for name in ARMS:
            if only not in f"{kind}, {name}":
                continue
            found = []
            for seed in rooms:
                found.append(decide(data, name, kind, seed))
                print(kind, name, seed, found[-1], flush=True)
            accepted = [one for one in found if one.accepted]
            off = [one.off for one in accepted]
            yield [
                f"{kind}, {name}",
                f"{len(accepted)} of {len(found)}",
                f"{sum(one > FAR for one in off)}" if kind == KINDS[0] else "-",
                f"{np.median(off):.2g}" if off and kind == KINDS[0] else "-",
                f"{max(one.p_value for one in accepted):.1g}" if accepted else "-",
                f"{np.median([one.seconds for one in found]):.0f}",
            ]


def main() -> None:
    """Print a row for each kind and arm."""
    parser = argparse.ArgumentParser(description="What a registration from pictures accepts.")
    parser.add_argument("data", type=Path)
    parser.add_argument("--rooms", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    headings = "episodes, arm", "accepted", f"over {FAR:g} mm off", "mm", "largest p-value", "CPU s"
    rooms = range(given.first, given.first + given.rooms)
    print_table("Accepted and refused episodes", headings, _rows(given.data, rooms, given.only))


if __name__ == "__main__":
    main()
