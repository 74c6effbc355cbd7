"""Benchmark of cameras on a wrist, registered from pictures alone: what is accepted, how far off.

Run as ``python -m tests.benchmarks.wrists DATA [--first K] [--only TEXT]``, see
``tests.benchmarks.episodes``. Each arm has an episode of each kind, with its own seed from K on.
Every second episode's pictures are those of a video (H.264), the others' are PNG files.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.errors import RegistrationError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.register import register_scene
from tests.benchmarks.episodes import Outcome, of_another_arm, write_episode
from tests.benchmarks.registration import CameraError
from tests.benchmarks.rooms import LOG_HZ
from tests.benchmarks.tables import print_table
from tests.benchmarks.wrist_rooms import GRIPPERS, simulate_wrist


@dataclass(frozen=True)
class Kind:
    """A kind of episode."""

    name: str
    room: dict[str, Any] = field(default_factory=dict)  # Arguments of ``simulate_wrist``.
    # Bound of the offsets of all joints but the first and the last, asked for if positive [deg].
    off: float = 0.0
    wrong: str = ""  # What is wrong: "joints", "mirrored", "model" or "link"; "": nothing.
    right: bool = True  # Whether a pose is to be accepted.
    arms: tuple[str, ...] = tuple(GRIPPERS)


FEW = {"contrast": 0.1, "things": 4}
KINDS = (
    Kind("textured table, 14 things"),
    Kind("the same, no gripper in view", {"away": True}),
    Kind("the same, a thing held", {"held": True}, arms=("robotiq", "so101")),
    Kind("the same, joints off by up to 2 degrees, --zeros all", off=2.0, arms=("panda", "so101")),
    Kind("faint table, 4 things", FEW),
    Kind("faint table, 4 things, no gripper in view", FEW | {"away": True}),
    Kind("faint table, hand turns about the vertical", FEW | {"motion": "upright"}),
    Kind("textured table, hand turns about the vertical", {"motion": "upright"}),
    Kind("joints of another episode", wrong="joints", right=False, arms=("panda", "so101")),
    Kind("mirrored pictures", wrong="mirrored", right=False, arms=("panda", "robotiq")),
    Kind("model of another arm", wrong="model", right=False, arms=("panda", "so101")),
    Kind("a camera that stands", {"stands": True}, right=False, arms=("panda", "robotiq")),
    Kind("the link before", wrong="link", right=False),
    Kind("the link before, faint table", FEW, wrong="link", right=False, arms=("so101",)),
)
BEFORE = {"panda": "panda_link6", "robotiq": "panda_link6", "so101": "wrist_link"}


def decide(data: Path, name: str, kind: Kind, seed: int, codec: str) -> Outcome:
    """Simulate an episode of an arm, spoil it as the kind says, and register its camera.

    Args:
        data: folder of the models.
        name: of the arm, a key of GRIPPERS.
        kind: of the episode.
        seed: of the episode.
        codec: as of ``write_episode``.
    """
    one, rng = GRIPPERS[name], np.random.default_rng([15, seed])
    path, link = data / one.file, one.link
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        model, episode = simulate_wrist(data, folder, one, seed, **kind.room)
        if kind.wrong == "mirrored":
            episode = replace(episode, pictures=episode.pictures[:, :, ::-1])
        elif kind.wrong == "joints":
            _, other = simulate_wrist(data, folder, one, seed + 1000, **kind.room)
            episode = replace(episode, positions=other.positions)
        elif kind.wrong == "model":
            other_name = "panda" if name == "so101" else "so101"
            path, link = data / GRIPPERS[other_name].file, GRIPPERS[other_name].link
            model, episode = of_another_arm(model, episode, path)
        elif kind.wrong == "link":
            link = BEFORE[name]
        arm = [*one.arm][1:-1]
        turned = {k: float(rng.uniform(-kind.off, kind.off)) for k in arm} if kind.off else {}
        write_episode(folder / "scene", model, episode, LOG_HZ, turned, (0.0, 0.0), codec)
        settings = RegistrationSettings(on=link, zeros=("all",) if kind.off else ())
        start = time.process_time()
        try:
            found = register_scene(folder / "scene", path, settings=settings)
        except RegistrationError as error:
            return Outcome(str(error), time.process_time() - start)
        seconds = time.process_time() - start
    return Outcome("", seconds, CameraError.of(found.registered["wrist"], episode.camera.X_WC))


def _rows(data: Path, first: int, only: str) -> Iterator[list[str]]:
    """Yield a row for each kind, and print every episode's result."""
    for n, kind in enumerate(KINDS):
        if only not in kind.name:
            continue
        found = list[Outcome]()
        for m, name in enumerate(GRIPPERS):
            if name not in kind.arms:
                continue
            seed = first + len(GRIPPERS) * n + m
            found.append(decide(data, name, kind, seed, "libx264" if seed % 2 else ""))
            print(kind.name, name, seed, found[-1], flush=True)
        accepted = [one.error for one in found if not one.refusal]
        off = [
            f"{one.millimetres:.2g} ({one.sd[0]:.2g}), {one.degrees:.2g} ({one.sd[1]:.2g})"
            for one in accepted
        ]
        yield [
            kind.name,
            f"{len(accepted)} of {len(found)}",
            "; ".join(off) if kind.right and off else "-",
            f"{sum(one.inside for one in accepted)} of {6 * len(accepted)}" if kind.right else "-",
            f"{np.median([one.seconds for one in found]):.0f}",
        ]


def main() -> None:
    """Print a row for each kind of episode."""
    parser = argparse.ArgumentParser(description="Cameras on a wrist, from pictures alone.")
    parser.add_argument("data", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    headings = (
        "episodes of three arms", "accepted", "mm (sd), degrees (sd)", "inside 95 %", "CPU s",
    )  # fmt: skip
    print_table("Cameras on a wrist", headings, _rows(given.data, given.first, given.only))


if __name__ == "__main__":
    main()
