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
from typing import Any, NamedTuple

import numpy as np

from drake_pose.errors import RegistrationError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.register import register_scene
from tests.benchmarks.episodes import mirrored, of_another_arm, write_episode
from tests.benchmarks.registration import pose_error
from tests.benchmarks.rooms import LOG_HZ
from tests.benchmarks.tables import print_table
from tests.benchmarks.wrist_rooms import GRIPPERS, simulate_wrist


@dataclass(frozen=True)
class Kind:
    """A kind of episode.

    Args:
        name: in the table.
        room: arguments of ``simulate_wrist``.
        off: bound of the offsets of all joints but the first and the last [deg]; they are asked for
            if it is positive.
        wrong: what is wrong: "joints", "mirrored", "model" or "link"; "": nothing.
        right: whether a pose is to be accepted.
        arms: keys of GRIPPERS.
    """

    name: str
    room: dict[str, Any] = field(default_factory=dict)
    off: float = 0.0
    wrong: str = ""
    right: bool = True
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


class Decision(NamedTuple):
    """Result of one episode.

    Attributes:
        told: why it was refused; "": it was not.
        off: error of its position [mm] and of its orientation [deg]; NaN: refused.
        sds: root mean square standard deviation of position [mm] and of orientation [deg].
        inside: number of the pose's six coordinates inside their 95 % intervals.
        most: largest error of a coordinate [standard deviations].
        seconds: CPU time [s].
    """

    told: str
    off: tuple[float, float]
    sds: tuple[float, float]
    inside: int
    most: float
    seconds: float

    @property
    def accepted(self) -> bool:
        return bool(np.isfinite(self.most))


def decide(data: Path, name: str, kind: Kind, seed: int, codec: str) -> Decision:
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
            episode = mirrored(episode)
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
        start, nothing = time.process_time(), (np.nan, np.nan)
        try:
            found = register_scene(folder / "scene", path, settings=settings)
        except RegistrationError as error:
            seconds = time.process_time() - start
            return Decision(f"refused: {error}", nothing, nothing, 0, np.nan, seconds)
        seconds = time.process_time() - start
    camera = found.registered["wrist"]
    error = pose_error(camera.camera.X_WC, episode.camera.X_WC)
    sds = np.sqrt(np.diag(camera.covariance))
    sizes = [float(np.sqrt(np.mean(k**2))) for k in (sds[3:], sds[:3])]
    most = float(np.abs(error / sds).max())
    inside = int((np.abs(error) < 1.96 * sds).sum())
    off = 1e3 * float(np.linalg.norm(error[3:])), float(np.degrees(np.linalg.norm(error[:3])))
    sds_told = 1e3 * sizes[0], float(np.degrees(sizes[1]))
    return Decision("", off, sds_told, inside, most, seconds)


def _rows(data: Path, first: int, only: str) -> Iterator[list[str]]:
    """Yield a row for each kind, and print every episode's result."""
    for n, kind in enumerate(KINDS):
        if only not in kind.name:
            continue
        found = list[Decision]()
        for m, name in enumerate(GRIPPERS):
            if name not in kind.arms:
                continue
            seed = first + len(GRIPPERS) * n + m
            found.append(decide(data, name, kind, seed, "libx264" if seed % 2 else ""))
            print(kind.name, name, seed, found[-1], flush=True)
        accepted = [one for one in found if one.accepted]
        off = [
            f"{one.off[0]:.2g} ({one.sds[0]:.2g}), {one.off[1]:.2g} ({one.sds[1]:.2g})"
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
