"""Benchmark of whole estimates: errors, and CPU time per frame relative to Drake's label images.

Run as ``python -m tests.benchmarks.estimates [DATA] [--hands]``; DATA is a folder with the scenes
``arm_two_views``, ``human_four_views``, ``hand_photos`` and ``hand_sequences``; without it only the
demonstration is estimated. ``--hands``: instead, hands with an uncalibrated camera.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drake_pose.body import bundled_model, load_model
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.demo import demo_settings, stored_scene
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.benchmarks.coverage import draw_scene, true_positions
from tests.benchmarks.speed import measure_kernel
from tests.benchmarks.tables import print_table

_FRAMES = 24
_RIGHT_HAND = bundled_model("hand").with_name("right_hand.urdf")
_ARM_JOINTS = ("A1", "A2", "A3", "A4")
_FLEXIONS = tuple(
    f"{finger}_{joint}_flexion"
    for finger in ("index", "middle", "ring", "little")
    for joint in ("mcp", "pip", "dip")
)


class Work(NamedTuple):
    """An estimate of a scene, one row of the table."""

    name: str
    scene: Path
    model: Path
    settings: EstimateSettings = EstimateSettings()
    uncounted: int = 0  # Number of initial frames that include the search, and do not count.
    joints: tuple[str, ...] = ()  # Whose errors are evaluated, by joint_angles.csv in the scene.


def works(data: Path | None, folder: Path) -> Iterator[Work]:
    """Yield the rows; rendered scenes are written to a folder."""
    man, demo = bundled_model("man"), stored_scene("human")
    yield Work("demo: man, one view", demo, man, demo_settings(demo))
    if data is None:
        return
    arm, human = data / "arm_two_views", data / "human_four_views"
    model = arm / "med7" / "med7.urdf"
    yield Work("arm, two views, one pose", arm, model, joints=_ARM_JOINTS)
    drawn = draw_arm_sequence(arm, folder / "arm_sequence")
    yield Work("arm, two views, sequence", drawn, model, uncounted=2, joints=_ARM_JOINTS)
    settings = EstimateSettings(
        frames=("0010", "0011"),
        root="right_foot",
        root_position=(human / "joint_centres.csv", "right_ankle"),
        root_rotation={"y": (-180.0, 180.0), "x": (-20.0, 20.0), "z": (-20.0, 20.0)},
        track=False,
    )
    yield Work("man, four views, one frame", human, man, settings)
    yield Work("hand photograph", data / "hand_photos", bundled_model("hand"))
    sequence = data / "hand_sequences" / "count"
    frames = EstimateSettings(frames=(f"0000:{_FRAMES - 1:04d}",))
    yield Work("hand, sequence, no camera known", sequence, _RIGHT_HAND, frames, uncounted=1)


def draw_arm_sequence(arm: Path, out: Path, frames: int = _FRAMES) -> Path:
    """Write a scene of the recorded arm moving from its first to its second pose, by Drake."""
    model, scene = load_model(arm / "med7" / "med7.urdf", check=False), load_scene(arm)
    truth = true_positions(arm)
    first, second = (np.array([*truth[k].values()]) for k in (0, 1))
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, frames))
    q = np.tile(model.default_positions, (frames, 1))
    moving = [model.position_index(name) for name in truth[0]]
    q[:, moving] = first + share[:, None] * (second - first)
    return draw_scene(out, model, scene.cameras, q, np.random.default_rng(0))


def measure(work: Work) -> tuple[float, float, str]:
    """Return CPU seconds per frame, mean E_total, and the error as text; the first run warms up."""
    ends: list[float] = []
    for _ in range(2 if work.uncounted == 0 else 1):
        ends.clear()
        found = estimate_scene(
            work.scene, work.model, None, work.settings,
            on_frame=lambda *_: ends.append(time.process_time()),
        )  # fmt: skip
    rows, error = list(found.records.values())[work.uncounted :], ""
    if work.joints:
        truth, names = true_positions(work.scene), found.position_names
        pairs = [(row, name) for row in rows for name in work.joints]
        off = np.abs([r.q[names.index(n)] - truth[int(r.frame)][n] for r, n in pairs])
        # Larger errors are mirrored poses with the same silhouette; they are left out.
        median = np.degrees(np.median(off[off < 0.5]))
        error = f"{work.joints[0]} to {work.joints[-1]}: {median:.2f} deg in the median"
    seconds = float(np.median(np.diff(ends)[work.uncounted :]))
    return seconds, float(np.mean([row.E_total for row in rows])), error


def _rows(data: Path | None, folder: Path) -> Iterator[tuple[str, ...]]:
    label_image = measure_kernel().label_image_microseconds * 1e-6
    for work in works(data, folder):
        seconds, E_total, error = measure(work)
        yield work.name, f"{seconds:.3f} s", f"{seconds / label_image:.0f}", f"{E_total:.2%}", error


def _hand_rows(data: Path) -> Iterator[tuple[str, ...]]:
    """Yield for each sequence: errors of flexions, coverage and widths of intervals [deg]."""
    for scene in sorted(path.parent for path in data.glob("*/scene.yaml")):
        begin = time.process_time()
        found = estimate_scene(scene, _RIGHT_HAND, None, EstimateSettings(), overlay=False)
        seconds, truth = time.process_time() - begin, true_positions(scene)
        off, inside, widths = [], [], []
        for row in found.records.values():
            known, true = row.joints, truth[int(row.frame)]
            for name in _FLEXIONS:
                value = np.degrees(row.q[found.position_names.index(name)])
                off.append(abs(value - true[name]))
                low, high = (known.get(name, {}).get(end, np.nan) for end in ("low", "high"))
                inside.append(low <= true[name] <= high)
                widths.append(high - low)
        counts = [one.mode_count or 1 for one in found.records.values()]
        yield (
            scene.name,
            f"{np.median(off):.1f} ({np.mean(off):.1f})",
            f"{np.mean(inside):.0%}",
            f"{np.nanmedian(widths):.0f}",
            f"{np.mean([row.E_total for row in found.records.values()]):.1%}",
            f"{np.median(counts):.0f}",
            f"{seconds / len(found.records):.2f} s",
        )


def main() -> None:
    """Print the costs and errors of estimates."""
    parser = argparse.ArgumentParser(description="Whole estimates: times and errors.")
    parser.add_argument("data", nargs="?", type=Path, help="a folder of recorded scenes")
    parser.add_argument("--hands", action="store_true", help="sequences of hands alone")
    asked = parser.parse_args()
    if asked.hands:
        headings: tuple[str, ...] = (
            *("sequence", "flexions off, median (mean)", "inside", "intervals", "E_total"),
            *("explanations", "CPU a frame"),
        )
        print_table("Hands, camera unknown", headings, _hand_rows(asked.data / "hand_sequences"))
        return
    with tempfile.TemporaryDirectory() as folder:
        headings = ("work", "a frame", "label images", "E_total", "error")
        title = "Estimates: CPU time a frame, one core"
        print_table(title, headings, _rows(asked.data, Path(folder)))


if __name__ == "__main__":
    main()
